"""Octahedral maps for other programs: their padding and formula in NumPy, and EXR files of many maps."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from warp_gi.errors import one_line

PADDING = 1
GPU_TEXELS = 16384
"""Along a side of a texture; what graphics hardware takes."""

MAPPING = (
    "Octahedral, seen from above: +y in the middle, -y in the corners, +x towards higher columns, +z towards higher "
    "rows. Of a direction d: s = 0.5 / (|d.x| + |d.y| + |d.z|); a = d.x * s; b = d.z * s; if d.y < 0: (a, b) = ((0.5 "
    "- |b|) * sign(a), (0.5 - |a|) * sign(b)), where sign(0) is 1; column = min(floor((a + 0.5) * resolution), "
    "resolution - 1), row the same of b."
)
PADDING_TEXT = "One texel around each map repeats what lies across its edge on the sphere"


def padded_texels(resolution: int) -> np.ndarray:
    """Return int64 [resolution + 2, resolution + 2]: the texel, row by row, that each texel of a padded map repeats."""
    inner = np.arange(resolution**2).reshape(resolution, resolution)
    source = np.empty((resolution + 2, resolution + 2), np.int64)
    source[1:-1, 1:-1] = inner
    for edge in (0, -1):
        source[edge, 1:-1], source[1:-1, edge] = inner[edge, ::-1], inner[::-1, edge]
        source[edge, 0], source[edge, -1] = inner[-1 - edge, -1], inner[-1 - edge, 0]
    return source


def padded(maps: np.ndarray) -> np.ndarray:
    """Return maps [..., resolution, resolution] with a border of one texel that repeats what lies across the edge."""
    return maps.reshape(*maps.shape[:-2], -1)[..., padded_texels(maps.shape[-1])]


def encode(directions: np.ndarray) -> np.ndarray:
    """Return coordinates in [0, 1], float [..., 2], of directions [..., 3] of any length above zero."""
    x, y, z = np.moveaxis(0.5 * directions / np.abs(directions).sum(-1, keepdims=True), -1, 0)
    folded = ((0.5 - np.abs(z)) * np.where(x < 0, -1, 1), (0.5 - np.abs(x)) * np.where(z < 0, -1, 1))
    return np.stack(np.where(y < 0, folded, (x, z)), axis=-1) + 0.5


def decode(coordinates: np.ndarray) -> np.ndarray:
    """Return unit directions, float [..., 3], of coordinates [..., 2] in [0, 1]; the inverse of ``encode``."""
    a, b = np.moveaxis(2 * np.asarray(coordinates) - 1, -1, 0)
    y = 1 - np.abs(a) - np.abs(b)
    x = np.where(y < 0, (1 - np.abs(b)) * np.where(a < 0, -1, 1), a)
    z = np.where(y < 0, (1 - np.abs(a)) * np.where(b < 0, -1, 1), b)
    d = np.stack([x, y, z], axis=-1)
    return d / np.linalg.norm(d, axis=-1, keepdims=True)


def texels_of(directions: np.ndarray, resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the column and row, int [...], of the texel that directions [..., 3] fall in."""
    at = np.clip((encode(directions) * resolution).astype(int), 0, resolution - 1)
    return at[..., 0], at[..., 1]


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
        part: The file to write to.
        path: What errors call it.
        pixels: Return float16 or float32 [height, width, channel], all alike.
        channels: Their names.
        names: Of the parts; "" for none.

    Raises OSError.
    """
    import OpenImageIO as oiio

    first = pixels(0)
    height, width, count = first.shape
    specs = []
    for name in names:
        spec = oiio.ImageSpec(width, height, count, "half" if first.dtype == np.float16 else "float")
        spec.channelnames = tuple(channels)
        spec.attribute("compression", "zip")
        spec.attribute("DateTime", "")  # else the time of day goes into every file
        if name:
            spec.attribute("oiio:subimagename", name)
        specs.append(spec)
    output = oiio.ImageOutput.create("exr")
    done = output.open(str(part), tuple(specs)) if len(specs) > 1 else output.open(str(part), specs[0])
    for index, spec in enumerate(specs):
        if index:
            done = done and output.open(str(part), spec, "AppendSubimage")
        done = done and output.write_image(np.ascontiguousarray(pixels(index) if index else first))
    done = output.close() and done
    if not done or output.has_error:
        problem = one_line(output.geterror(), "unknown failure")
        raise OSError(f"cannot write {path}: {problem.replace(str(part), str(path))}")
