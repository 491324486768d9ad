"""Pipelines as the command line names them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

from warp_gi import registry
from warp_gi.denoise import Denoiser, denoiser_named
from warp_gi.errors import OptionError, unknown_name
from warp_gi.frame import TERMS
from warp_gi.pipeline import NORMAL, Pipeline, estimator_named
from warp_gi.radiance_cache import RadianceCache


def pipeline_named(text: str, quality: str = NORMAL) -> Pipeline:
    """Return the pipeline of "path" or "path,indirect=none,emitters=UniformLights,denoise=SpatioTemporal".

    "indirect.ends_in=LightFieldProbes" lets the paths of a term end in a radiance cache. Raises OptionError for
    unknown presets, terms, estimators, caches and denoisers.
    """
    name, *changes = text.split(",")
    pipeline = Pipeline.preset(name.strip(), quality=quality)
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


def with_settings_shared(pipeline: Pipeline, arguments: Sequence[str]) -> Pipeline:
    """Return a pipeline in which estimators of one class, in several terms, share the settings that were given.

    A setting that ``arguments`` give for one of the terms alone holds for the others, too: such estimators share
    their bake. Where they give it for several, each keeps its own.
    """
    given = [argument.partition("=")[0].replace("_", "-") for argument in arguments]
    changed: dict[str, dict[str, Any]] = {}
    for term, estimator in pipeline.estimators():
        others = [other for other, one in pipeline.estimators() if other != term and type(one) is type(estimator)]
        for name in (one.name for one in fields(estimator) if one.name != "term"):
            if others and not _is_given(term, name, given):
                source = next((other for other in others if _is_given(other, name, given)), term)
                changed.setdefault(term, {})[name] = getattr(getattr(pipeline, source), name)
    shared: dict[str, Any] = {}
    for term, settings in changed.items():
        try:
            shared[term] = replace(getattr(pipeline, term), **settings)
        except OptionError as error:
            raise OptionError(
                f"settings that are given for one term hold for {term}, too, which is of the same class: {error}; "
                f"give --{term}.NAME as well, or leave the term out by --pipeline ...,{term}=none"
            ) from None
    return replace(pipeline, **shared)


def _is_given(term: str, name: str, given: Sequence[str]) -> bool:
    """Return whether a flag sets a term's setting, or one within it."""
    name = name.replace("_", "-")
    flags = f"--{term}.{name}", f"--{term}.no-{name}"
    return any(flag in flags or flag.startswith(f"{flags[0]}.") for flag in given)


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
