"""Pipelines as the command line names them."""

from __future__ import annotations

from dataclasses import replace

from warp_gi.errors import unknown_name
from warp_gi.pipeline import TERMS, Estimator, Pipeline


def pipeline_named(text: str) -> Pipeline:
    """Return the pipeline of "path" or "path,indirect=none,emitters=UniformLights,denoise=SpatioTemporal".

    Raises OptionError for unknown presets, terms, estimators and denoisers.
    """
    name, *changes = text.split(",")
    pipeline = Pipeline.preset(name.strip())
    known = {estimator.__name__: estimator for estimator in _subclasses(Estimator)}
    for change in changes:
        term, _, estimator = (part.strip() for part in change.partition("="))
        if term == "denoise":
            pipeline = replace(pipeline, denoise=denoiser_named(estimator))
            continue
        if term not in TERMS:
            raise unknown_name("term of a pipeline", term, (*TERMS, "denoise"))
        if estimator.lower() == "none":
            pipeline = replace(pipeline, **{term: None})
        elif estimator in known:
            pipeline = replace(pipeline, **{term: known[estimator]()})
        else:
            raise unknown_name(f"{term} estimator", estimator, [k for k, v in known.items() if v.term == term])
    return pipeline


def denoiser_named(name: str) -> str | None:
    """Return what a pipeline takes for "none", "oidn", "SpatioTemporal"."""
    return None if name.lower() == "none" else name.lower()


def _subclasses(base: type) -> list[type]:
    direct = base.__subclasses__()
    return [c for c in direct if not c.__name__.startswith("_")] + [c for d in direct for c in _subclasses(d)]
