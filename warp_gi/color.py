"""What numbers of a color mean: luminance and primaries of linear Rec. 709, and the sRGB coding (IEC 61966-2-1)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear Rec. 709 red, green and blue in the luminance, as in ``kernels.bsdf.luminance``; float64 [3]."""

RGB_FROM_XYZ = np.array(
    [[3.2404542, -1.5371385, -0.4985314], [-0.9692660, 1.8760108, 0.0415560], [0.0556434, -0.2040259, 1.0572252]]
)
"""Linear Rec. 709 of CIE XYZ; white is D65. float64 [3, 3]."""
BRADFORD = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
"""Cone responses of XYZ, in which white is adapted (Lam 1985; the ICC's choice). float64 [3, 3]."""


BAND = 1 << 20
"""Values of an image that are computed with at once in float64: a whole one would take many times its memory."""


def bands(height: int, width: int) -> Iterator[slice]:
    """Yield slices of the rows of an image, in order, of at most ``BAND`` pixels each or one row."""
    rows = max(BAND // max(width, 1), 1)
    for row in range(0, height, rows):
        yield slice(row, min(row + rows, height))


def luminance_of(pixels: np.ndarray) -> np.ndarray:
    """Return the luminance of linear Rec. 709 pixels [height, width, 3], float64 [height, width]."""
    result = np.empty(pixels.shape[:2])
    for rows in bands(*pixels.shape[:2]):
        np.matmul(pixels[rows], LUMINANCE, out=result[rows])
    return result


def rgb_from_primaries(chromaticities: Sequence[float]) -> np.ndarray | None:
    """Return linear Rec. 709 of RGB in other primaries, float64 [3, 3]; their white becomes white (Bradford).

    ``chromaticities`` are x and y of red, green, blue and white, as in OpenEXR. None if they span no colors.
    """
    xy = np.array(chromaticities, np.float64).reshape(4, 2)
    if not np.isfinite(xy).all() or (xy[:, 1] == 0).any():
        return None
    xyz = np.stack([xy[:, 0] / xy[:, 1], np.ones(4), (1 - xy.sum(axis=1)) / xy[:, 1]])
    primaries, white = xyz[:, :3], xyz[:, 3]
    if abs(np.linalg.det(primaries)) < 1e-9:
        return None
    xyz_from_other = primaries * np.linalg.solve(primaries, white)
    gains = (BRADFORD @ np.linalg.inv(RGB_FROM_XYZ).sum(axis=1)) / (BRADFORD @ white)
    return RGB_FROM_XYZ @ np.linalg.solve(BRADFORD, gains[:, None] * BRADFORD) @ xyz_from_other


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """Return linear values, clipped to 0..1, in sRGB coding; the inverse of ``decode_srgb``."""
    x = np.clip(linear, 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def decode_srgb(coded: np.ndarray) -> np.ndarray:
    """Return sRGB-coded values 0..1 as linear ones; the inverse of ``encode_srgb``.

    float32 values are computed in float32, all others in float64.
    """
    x = np.asarray(coded)
    if x.dtype != np.float32:
        x = x.astype(np.float64)
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


SRGB_TO_LINEAR = decode_srgb(np.arange(256) / 255.0).astype(np.float32)
"""Linear value of each 8-bit sRGB code, float32 [256]."""
