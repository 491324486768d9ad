"""Measures of how far an image is from its reference.

Images are NumPy arrays, Warp arrays or anything with ``__dlpack__``, [height, width]
or [height, width, channels]. Floats are linear and taken as they are; uint8 and uint16
are sRGB-coded and scaled to 0..1. All raise OptionError when the shapes differ, when a
value is NaN or infinite, or when an input is no image.
"""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np

from warp_gi.color import LUMINANCE, decode_srgb
from warp_gi.errors import OptionError, one_line


class Image(Protocol):
    """An array of NumPy, Warp, PyTorch, JAX or another library that shares its memory by DLPack."""

    def __dlpack__(self) -> Any:
        """Return the memory as a DLPack capsule."""
        ...


RELATIVE_EPSILON = 1e-2
PIXELS_PER_DEGREE = 67.02064
"""Pixels a degree of FLIP's default viewer: 0.7 m from a 0.7 m wide screen of 3840 pixels."""


def rmse(image: Image, reference: Image) -> float:
    """Return the root of the mean squared difference over pixels and channels."""
    a, r = _pair(image, reference)
    return math.sqrt(np.mean((a - r) ** 2))


def psnr(image: Image, reference: Image, peak: float = 1.0) -> float:
    """Return the peak signal-to-noise ratio, 10 log10(peak^2 / MSE), in dB; inf for equal images."""
    if not peak > 0:
        raise OptionError(f"psnr: peak must be above 0, got {peak}")
    error = rmse(image, reference)
    return math.inf if error == 0 else 20 * math.log10(peak / error)


def rel_mse(image: Image, reference: Image, epsilon: float = RELATIVE_EPSILON) -> float:
    """Return the mean of (image - reference)^2 / (reference^2 + epsilon) over pixels and channels.

    The convention of Rousselle et al. 2011, "Adaptive Sampling and Reconstruction using Greedy Error
    Minimization", there with epsilon 0.01.
    """
    if not epsilon > 0:
        raise OptionError(f"rel_mse: epsilon must be above 0, got {epsilon}")
    a, r = _pair(image, reference)
    return float(np.mean((a - r) ** 2 / (r**2 + epsilon)))


def flip(
    image: Image, reference: Image, hdr: bool | None = None, pixels_per_degree: float = PIXELS_PER_DEGREE
) -> float:
    """Return the mean of ``flip_map``: 0 for images that look the same, at most 1."""
    return float(np.mean(flip_map(image, reference, hdr, pixels_per_degree), dtype=np.float64))


def flip_map(
    image: Image, reference: Image, hdr: bool | None = None, pixels_per_degree: float = PIXELS_PER_DEGREE
) -> np.ndarray:
    """Return the FLIP difference of each pixel as seen when alternating the images, float32 [height, width], 0..1.

    ``hdr`` None takes float images as HDR and integer images as LDR. LDR-FLIP (Andersson et al.
    2020) clips linear values to 0..1. HDR-FLIP (Andersson et al. 2021) is the largest LDR-FLIP over
    exposures from the one that keeps the reference's brightest pixel to the one that shows its median.
    Takes 1 or 3 channels.
    """
    is_coded = np.issubdtype(_array(reference).dtype, np.integer)
    a, r = (_linear_rgb(x) for x in (image, reference))
    _check_pair(a, r)
    if not (hdr if hdr is not None else not is_coded):
        return _ldr_flip(a, r, pixels_per_degree)
    start, stop = _exposure_range(r)
    count = max(2, math.ceil(stop - start))
    result = np.zeros(r.shape[:2], np.float32)
    for exposure in np.linspace(start, stop, count):
        scale = 2.0**exposure
        result = np.maximum(result, _ldr_flip(_aces(a * scale), _aces(r * scale), pixels_per_degree))
    return result


def _ldr_flip(a: np.ndarray, r: np.ndarray, pixels_per_degree: float) -> np.ndarray:
    import OpenImageIO as oiio

    seen, wanted = (oiio.ImageBuf(np.ascontiguousarray(np.clip(x, 0, 1), np.float32)) for x in (a, r))
    result = oiio.ImageBufAlgo.FLIP_diff(wanted, seen, hdr=0, ppd=pixels_per_degree)
    if result.has_error:
        raise OptionError(f"FLIP: {one_line(result.geterror())}")
    return np.ascontiguousarray(np.asarray(result.get_pixels(oiio.FLOAT))[:, :, 0])


# Narkowicz's fit of the ACES curve with FLIP's exposure of 0.6 folded in: (x(ax + b)) / (x(dx + e) + f)
_A, _B, _D, _E, _F = 0.6 * 0.6 * 2.51, 0.6 * 0.03, 0.6 * 0.6 * 2.43, 0.6 * 0.59, 0.14


def _aces(x: np.ndarray) -> np.ndarray:
    x = np.maximum(x, 0)
    return np.clip(x * (_A * x + _B) / (x * (_D * x + _E) + _F), 0, 1)


def _exposure_range(reference: np.ndarray) -> tuple[float, float]:
    """First and last exposure in stops: luminance maximum and median are mapped to 0.85 (Andersson et al. 2021)."""
    goal = 0.85
    a, b, c = _A - goal * _D, _B - goal * _E, -goal * _F
    x = (-b + math.sqrt(b * b - 4 * a * c)) / (2 * a)
    luminance = np.maximum(reference, 0) @ LUMINANCE
    if not luminance.max() > 0:
        return 0.0, 0.0
    median = np.median(luminance) or np.median(luminance[luminance > 0])
    return math.log2(x / luminance.max()), math.log2(x / median)


def _linear_rgb(image: Image) -> np.ndarray:
    array = _array(image)
    is_coded = np.issubdtype(array.dtype, np.integer)
    values = _float(array)
    if values.ndim == 2:
        values = values[:, :, None]
    if values.shape[2] == 1:
        values = np.repeat(values, 3, axis=2)
    if values.shape[2] != 3:
        raise OptionError(f"FLIP takes images of 1 or 3 channels, got {values.shape[2]}")
    return decode_srgb(values) if is_coded else values


def _pair(image: Image, reference: Image) -> tuple[np.ndarray, np.ndarray]:
    a, r = _float(_array(image)), _float(_array(reference))
    _check_pair(a, r)
    return a, r


def _check_pair(a: np.ndarray, r: np.ndarray) -> None:
    if a.shape != r.shape:
        raise OptionError(f"image is {_size(a)} and reference {_size(r)}; give images of the same size")
    for name, values in (("image", a), ("reference", r)):
        bad = np.count_nonzero(~np.isfinite(values))
        if bad:
            raise OptionError(f"the {name} has {bad} values that are NaN or infinite; mend or mask them first")


def _size(array: np.ndarray) -> str:
    channels = array.shape[2] if array.ndim == 3 else 1
    return f"{array.shape[1]}x{array.shape[0]} with {channels} channel{'s' * (channels != 1)}"


def _array(image: Image) -> np.ndarray:
    given: Any = image
    if not isinstance(given, np.ndarray):
        import warp as wp

        if not isinstance(given, wp.array) and hasattr(given, "__dlpack__"):
            given = wp.from_dlpack(given)
        if isinstance(given, wp.array):
            given = given.numpy()
            if given.ndim == 3 and given.shape[2] == 1:
                given = given[:, :, 0]
    array = np.asarray(given)
    if array.ndim not in (2, 3) or array.size == 0 or array.dtype.kind not in "fiu":
        raise OptionError(
            f"expected an image [height, width] or [height, width, channels], got {array.dtype} {array.shape}"
        )
    return array


def _float(array: np.ndarray) -> np.ndarray:
    if array.dtype.kind == "f":
        return array.astype(np.float64)
    if array.dtype in (np.uint8, np.uint16):
        return array.astype(np.float64) / np.iinfo(array.dtype).max
    raise OptionError(f"an image of {array.dtype} has no scale; convert it to float, uint8 or uint16")
