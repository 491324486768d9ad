"""The registry: which estimators there are, by name, and what each claims. It imports none of their code."""

from __future__ import annotations

import importlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Claim:
    """What an estimator claims of its pictures, which the truth tests check."""

    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings under which the claim holds, where they are not the defaults."""
    unbiased: bool = True
    """Whether the mean over seeds is exact; a z-test checks it."""
    bound: float = 0.0
    """For a biased one: largest relative error of a picture's mean."""
    resolution: tuple[Mapping[str, Any], ...] = ()
    """For a biased one: settings from coarse to fine, along which the error falls."""


_UNBIASED: dict[str, Claim] = {"": Claim()}
_COARSE_FIELD = {"samples": 30, "rays": 16, "dilation": 0, "cell_size": 0.6, "resolution": 16}
_PROBES = {"counts": (3, 3, 3), "resolution": 32}
_PROBE_RESOLUTION = (
    {"counts": (2, 2, 2), "resolution": 16, "irradiance_resolution": 4, "rays": 1},
    {"counts": (2, 2, 2)},
    {"counts": (3, 3, 3)},
)
_ESTIMATORS: dict[str, tuple[str, dict[str, Claim]]] = {
    "TracedEnvironment": ("paths.estimators", _UNBIASED),
    "UniformLights": ("paths.estimators", _UNBIASED),
    "PowerLights": ("paths.estimators", _UNBIASED),
    "BsdfPaths": ("paths.estimators", _UNBIASED),
    "LightHierarchy": ("light_hierarchy.estimator", _UNBIASED),
    "VisibilityLightCache": ("reuse.light_cache", _UNBIASED),
    "GuidedPaths": ("reuse.guided_paths", _UNBIASED),
    "VisibilityField": (
        "visibility_field.estimator",
        {
            "": Claim(unbiased=False, bound=0.01, resolution=(_COARSE_FIELD, {})),
            "unbiased": Claim({"mode": "unbiased", **_COARSE_FIELD}),
            "traced": Claim({"mode": "traced"}),
            "harmonics": Claim({"sky": "harmonics"}, unbiased=False, bound=0.01),
            "paper": Claim({"mode": "paper", "sky": "harmonics"}, unbiased=False, bound=0.01),
        },
    ),
    "LightFieldProbes": (
        "light_field.estimator",
        {
            "": Claim(_PROBES, unbiased=False, bound=0.08, resolution=_PROBE_RESOLUTION),
            "irradiance": Claim({**_PROBES, "mode": "irradiance"}, unbiased=False, bound=0.08),
            "traced": Claim({**_PROBES, "mode": "traced"}, unbiased=False, bound=0.03),
        },
    ),
}


def claims() -> Iterator[tuple[str, str, Claim]]:
    """Yield class name, variant and claim of every estimator."""
    for name, (_, variants) in _ESTIMATORS.items():
        yield from ((name, variant, claim) for variant, claim in variants.items())


def find(name: str) -> Any:
    """Return a class of a technique by name; raises KeyError for an unknown one."""
    return getattr(importlib.import_module(f"warp_gi.techniques.{_ESTIMATORS[name][0]}"), name)
