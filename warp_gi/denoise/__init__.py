"""Denoisers: what turns a composed, noisy frame into the picture that is shown."""

from __future__ import annotations

from warp_gi.denoise.base import Denoiser
from warp_gi.denoise.oidn import Oidn
from warp_gi.denoise.spatiotemporal import SpatioTemporal
from warp_gi.errors import unknown_name

__all__ = ["DENOISERS", "Denoiser", "Oidn", "SpatioTemporal", "denoiser_named"]

DENOISERS: dict[str, type[Denoiser]] = {"oidn": Oidn, "spatiotemporal": SpatioTemporal}
"""Classes that a pipeline's ``denoise`` may name."""


def denoiser_named(name: str) -> Denoiser:
    """Return the denoiser of that name with its defaults; raises OptionError for an unknown name."""
    if name not in DENOISERS:
        raise unknown_name("denoiser", name, DENOISERS)
    return DENOISERS[name]()
