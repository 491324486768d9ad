"""Octahedral maps for other programs: their padding and formula, and EXR files of many maps."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from warp_gi.techniques.shared.exr_parts import Part, write_exr_parts
from warp_gi.techniques.shared.octahedral import wrapped_texels

PADDING = 1
"""Texels around each map that repeat what lies across its edge."""
GPU_TEXELS = 16384
"""Largest number of texels along a side of a texture that graphics hardware takes."""

MAPPING = (
    "Octahedral, seen from above: +y in the middle, -y in the corners, +x towards higher columns, +z towards higher "
    "rows. Of a direction d: s = 0.5 / (|d.x| + |d.y| + |d.z|); a = d.x * s; b = d.z * s; if d.y < 0: (a, b) = ((0.5 "
    "- |b|) * sign(a), (0.5 - |a|) * sign(b)), where sign(0) is 1; column = min(floor((a + 0.5) * resolution), "
    "resolution - 1), row the same of b."
)
PADDING_TEXT = "One texel around each map repeats what lies across its edge on the sphere"


def padded_texels(resolution: int) -> np.ndarray:
    """Return the index of the texel that each texel of a padded map repeats, int64 [resolution + 2, resolution + 2]."""
    at = np.arange(-PADDING, resolution + PADDING)
    return wrapped_texels(*np.meshgrid(at, at), resolution)


def padded(maps: np.ndarray) -> np.ndarray:
    """Return maps [..., resolution, resolution] with a border of one texel that repeats what lies across the edge."""
    return maps.reshape(*maps.shape[:-2], -1)[..., padded_texels(maps.shape[-1])]


def warn_if_too_large(name: str, width: int, height: int, advice: str) -> None:
    """Warn if a texture has more texels along a side than GPUs take."""
    if max(width, height) > GPU_TEXELS:
        warnings.warn(
            f"{name}: {width} x {height} texels are more than the {GPU_TEXELS} a side that GPUs take; {advice}",
            stacklevel=3,
        )


def write_parts(
    part: Path,
    path: Path,
    pixels: Callable[[int], np.ndarray],
    channels: Sequence[str],
    names: Sequence[str] = ("",),
) -> None:
    """Write ``pixels(0)``, ``pixels(1)`` ... as the parts of an EXR file, one for each of ``names``.

    Args:
        part: File that is written.
        path: Path that errors name.
        pixels: Returns the pixels of a part by its index, float16 or float32 [height, width, channel], all alike.
        channels: Names of the channels.
        names: Names of the parts; "" is no name.

    Raises OSError.
    """
    first = pixels(0)
    height, width, _ = first.shape
    kind = "half" if first.dtype == np.float16 else "float"
    parts = [
        Part(name, channels, (width, height), partial(pixels, index) if index else lambda: first, kind)
        for index, name in enumerate(names)
    ]
    write_exr_parts(part, path, parts)
