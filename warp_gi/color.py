"""What numbers of a color mean: the luminance of linear Rec. 709, and the sRGB coding (IEC 61966-2-1)."""

from __future__ import annotations

import numpy as np

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Weights of linear Rec. 709 red, green and blue in the luminance, as in ``kernels.bsdf.luminance``; float64 [3]."""


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
