"""The registry of techniques, by name. It imports none of their code.

``warp_gi.techniques.TECHNIQUES`` lists folders. Each has a module ``technique`` with one ``Technique``, whose values
are names and numbers.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from warp_gi import techniques as folders
from warp_gi.errors import unknown_name


@dataclass(frozen=True)
class Claim:
    """A claim about the pictures of an estimator, which the truth tests check."""

    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings under which the claim holds, where they are not the defaults."""
    unbiased: bool = True
    """Whether the mean over seeds is exact; a z-test checks it."""
    bound: float = 0.0
    """Largest relative error of a picture's mean, for an estimator that is not unbiased."""
    resolution: tuple[Mapping[str, Any], ...] = ()
    """Settings from coarse to fine, along which the error of an estimator that is not unbiased falls."""


@dataclass(frozen=True)
class Entry:
    """A class of a technique: its module, and its claims."""

    module: str
    """Name of the module that defines the class, relative to the technique's folder."""
    claims: Mapping[str, Claim] = field(default_factory=lambda: {"": Claim()})
    """Claims by variant; "" is the claim of the default settings."""


@dataclass(frozen=True)
class Technique:
    """A technique, described by names and numbers alone."""

    name: str
    """Long name of the technique, as in ``--technique``: "visibility-field"."""
    short: str
    """Short name, for its preset, its suite and the suffix of its bakes: "dvf"."""
    estimators: Mapping[str, Entry] = field(default_factory=dict)
    """Estimators by class name."""
    services: Mapping[str, Entry] = field(default_factory=dict)
    """Services by class name."""
    caches: Mapping[str, Entry] = field(default_factory=dict)
    """Radiance caches by class name, beside estimators that are caches, too."""
    functions: Mapping[str, str] = field(default_factory=dict)
    """Public functions by name, with the module below the folder that defines them."""
    presets: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """Pipelines by name: fields where they differ from the default pipeline's.

    A value is the name of a class, a pair of that and its settings, or what it is: ``pipeline.made``.
    """
    qualities: Mapping[str, Mapping[str, Mapping[str, Any]]] = field(default_factory=dict)
    """Fields by preset and quality, "draft" and "high", where they differ from the preset's own."""
    samplers: tuple[str, ...] = ()
    """Light samplers, direction samplers, skies and caches of path tracers: "module.NAME" below warp_gi.kernels."""
    bake_tool: str = ""
    """Module below the folder with ``TOOL``, by which ``warp-gi bake`` bakes it; "" if it has none."""
    suite: str = ""
    """Name of the benchmark suite; "" if it has none."""
    page: str = ""
    """Page of the documentation, relative to docs/."""


@cache
def techniques() -> dict[str, Technique]:
    """Return all techniques by the names of their folders."""
    return {
        name: importlib.import_module(f"{folders.__name__}.{name}.technique").TECHNIQUE for name in folders.TECHNIQUES
    }


def folder_of(technique: Technique) -> str:
    """Return the package of a technique."""
    return next(f"{folders.__name__}.{name}" for name, one in techniques().items() if one is technique)


def technique_named(name: str, among: Iterable[Technique] | None = None) -> Technique:
    """Return the technique of a long or short name, of all or of some; raises OptionError for an unknown one."""
    known = list(techniques().values() if among is None else among)
    for one in known:
        if name in (one.name, one.short):
            return one
    raise unknown_name("technique", name, [one.name for one in known])


def bakeable() -> dict[str, Technique]:
    """Return the techniques that ``warp-gi bake`` can bake, by long name."""
    return {one.name: one for one in techniques().values() if one.bake_tool}


def bake_tool(name: str) -> Any:
    """Return the ``BakeTool`` of a technique that has one; raises OptionError for another name."""
    one = technique_named(name, bakeable().values())
    return importlib.import_module(f"{folder_of(one)}.{one.bake_tool}").TOOL


def presets() -> dict[str, Mapping[str, Any]]:
    """Return the fields of every named pipeline, where they differ from the default's."""
    return {name: preset for one in techniques().values() for name, preset in one.presets.items()}


def qualities(preset: str) -> Mapping[str, Mapping[str, Any]]:
    """Return the fields of a preset by quality, where they differ from its own."""
    return next((one.qualities[preset] for one in techniques().values() if preset in one.qualities), {})


def public() -> dict[str, str]:
    """Return the modules of all classes and functions of techniques that users see, by name."""
    found = {}
    for one in techniques().values():
        for name, entry in {**one.estimators, **one.services, **one.caches}.items():
            found[name] = f"{folder_of(one)}.{entry.module}"
        found |= {name: f"{folder_of(one)}.{module}" for name, module in one.functions.items()}
    return found


def find(name: str) -> Any:
    """Return a class or function of a technique by name; raises KeyError for an unknown one."""
    return getattr(importlib.import_module(public()[name]), name)


def claims() -> Iterator[tuple[str, str, Claim]]:
    """Yield class name, variant and claim of every estimator, and of every radiance cache that is none."""
    for one in techniques().values():
        for name, entry in {**one.estimators, **one.caches}.items():
            yield from ((name, variant, claim) for variant, claim in entry.claims.items())


def samplers() -> dict[str, Any]:
    """Return light samplers, direction samplers, skies and radiance caches of every technique, by "module.NAME"."""
    found = {}
    for one in techniques().values():
        for path in one.samplers:
            module, _, name = path.rpartition(".")
            found[path] = getattr(importlib.import_module(f"warp_gi.kernels.{module}"), name)
    return found
