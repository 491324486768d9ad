"""Pipelines as the command line names them."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

from warp_gi import registry
from warp_gi.denoise import Denoiser, denoiser_named
from warp_gi.errors import OptionError, unknown_name
from warp_gi.frame import TERMS
from warp_gi.pipeline import Pipeline, estimator_named
from warp_gi.radiance_cache import RadianceCache


def pipeline_named(text: str) -> Pipeline:
    """Return the pipeline of "path" or "path,indirect=none,emitters=UniformLights,denoise=SpatioTemporal".

    "indirect.ends_in=LightFieldProbes" lets the paths of a term end in a radiance cache. Raises OptionError for
    unknown presets, terms, estimators, caches and denoisers.
    """
    name, *changes = text.split(",")
    pipeline = Pipeline.preset(name.strip())
    for change in changes:
        place, _, value = (part.strip() for part in change.partition("="))
        term, _, inner = place.partition(".")
        if place == "denoise":
            pipeline = replace(pipeline, denoise=find_denoiser(value))
        elif term not in TERMS or inner not in ("", "ends_in"):
            raise unknown_name("term of a pipeline", place, (*TERMS, "indirect.ends_in", "denoise"))
        elif inner:
            pipeline = _ending(pipeline, term, value)
        else:
            estimator = None if value.lower() == "none" else estimator_named(term, value)
            changed: dict[str, Any] = {term: estimator}
            pipeline = replace(pipeline, **changed)
    return pipeline


def _ending(pipeline: Pipeline, term: str, name: str) -> Pipeline:
    """Return a pipeline whose paths of a term end in the radiance cache of that name, or in none."""
    estimator = getattr(pipeline, term)
    if estimator is None or "ends_in" not in {one.name for one in fields(estimator)}:
        kind = "none" if estimator is None else type(estimator).__name__
        raise OptionError(f"{term}.ends_in needs an estimator that traces paths, as BsdfPaths does, got {term}={kind}")
    cache = None if name.lower() == "none" else _cache_named(name)
    return replace(pipeline, **{term: replace(estimator, ends_in=cache)})


def _cache_named(name: str) -> RadianceCache:
    names = [known for one in registry.techniques().values() for known in (*one.estimators, *one.caches)]
    classes = {known: registry.find(known) for known in names}
    caches = {known: kind for known, kind in classes.items() if issubclass(kind, RadianceCache)}
    if name not in caches:
        raise unknown_name("radiance cache", name, caches)
    return caches[name]()


def find_denoiser(name: str) -> Denoiser | None:
    """Return the denoiser of a name as "none", "oidn" or "SpatioTemporal"; raises OptionError for an unknown one."""
    return None if name.lower() == "none" else denoiser_named(name.lower())
