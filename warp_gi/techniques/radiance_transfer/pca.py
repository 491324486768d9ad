"""Bounces in fewer numbers: 75 of a slot (three colours of 25) as a few principal components.

There is no mean apart: what sees nothing stays exactly 0, and components may be blended between texels and expanded
then. Measured on a court, a mean of its own gains nothing, nor does a weight on bands as skies have them: 16 components
have .039 of error under six photographed skies in each case.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from warp_gi.errors import OptionError, check_whole
from warp_gi.kernels.transfer_snippets import LIGHT_ORDER
from warp_gi.scene import harmonics
from warp_gi.techniques.radiance_transfer.textures import LIGHT_NUMBERS

CHANNELS = 3 * LIGHT_NUMBERS
"""Numbers of a slot: those of red first, then green, blue."""
SUN = 60.0
"""Sharpness of the suns of ``example_skies``."""
BLOCK = 1 << 16
"""Slots that are looked at together, so that no copy of them all in float64 is made."""


class CompressedBounces(NamedTuple):
    """Bounces as principal components: a slot's 75 numbers are ``coefficients @ basis``."""

    basis: np.ndarray
    """Orthonormal components, the largest first, float32 [component, 75]."""
    coefficients: np.ndarray
    """Coordinates of each slot, float16 [slot, component]."""
    error: float
    """Error of the light that is reflected, as RMS over its mean: the mean of that under ``example_skies``."""


def compress_bounces(bounces: np.ndarray, components: int) -> CompressedBounces:
    """Return the principal components of bounces, float16 [slot, 3, 25].

    Slots that see nothing, whose numbers are all 0, count for nothing, neither in the components nor in the error.
    Raises OptionError unless ``components`` is from 1 to 75 and there are bounces.
    """
    check_whole("components", components, 1, CHANNELS)
    if not len(bounces):
        raise OptionError("this bake has no bounces to compress; bake some, or export without components")
    rows = bounces.reshape(len(bounces), CHANNELS)
    seeing = np.flatnonzero(rows.any(axis=1))
    products = np.zeros((CHANNELS, CHANNELS))
    for block in _blocks(seeing):
        values = rows[block].astype(np.float64)
        products += values.T @ values
    basis = _signed(np.linalg.eigh(products)[1].T[::-1][:components]).astype(np.float32)
    coefficients = np.empty((len(rows), components), np.float16)
    for block in _blocks(np.arange(len(rows))):
        coefficients[block] = rows[block].astype(np.float32) @ basis.T
    return CompressedBounces(basis, coefficients, _error(rows, seeing, basis, coefficients))


def expand_bounces(basis: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
    """Return bounces, float32 [..., 3, 25], of coordinates [..., component]."""
    values = coefficients.astype(np.float32) @ basis.astype(np.float32)
    return values.reshape(*values.shape[:-1], 3, LIGHT_NUMBERS)


def example_skies() -> np.ndarray:
    """Return the skies that errors are stated for, as harmonics, float64 [sky, 3, 25].

    Suns above a blue sky: at the zenith, low in two directions, and none. Suns are lobes exp(SUN (cos - 1)) that bring
    about half as much light as the sky: errors are then much as under photographed skies, .03 and .09 where those
    have .04 and .08 (a court and a living room, 16 components).
    """
    x, weights = np.polynomial.legendre.leggauss(64)
    bands = (weights * np.exp(SUN * (x - 1.0))) @ np.polynomial.legendre.legvander(x, LIGHT_ORDER - 1)
    bands *= 4 * np.pi / bands[0]
    blue = np.zeros((3, LIGHT_NUMBERS))
    blue[:, 0] = np.array([0.5, 0.7, 1.0]) * np.sqrt(4 * np.pi)
    skies = [blue]
    for direction in ((0.0, 1.0, 0.0), (0.8, 0.5, 0.33), (-0.6, 0.3, -0.74)):
        axis = np.array(direction) / np.linalg.norm(direction)
        lobe = harmonics.by_coefficient(bands) * harmonics.basis(axis, LIGHT_ORDER)
        skies.append(blue + np.array([0.5, 0.4, 0.3])[:, None] * lobe)
    return np.array(skies)


def _error(rows: np.ndarray, seeing: np.ndarray, basis: np.ndarray, coefficients: np.ndarray) -> float:
    """Return the RMS error of reflected light over its mean, of slots that see anything: the mean over skies."""
    skies = example_skies()
    light = np.zeros((CHANNELS, 3 * len(skies)), np.float32)  # from a slot's numbers to red, green, blue of each sky
    for color in range(3):
        light[color * LIGHT_NUMBERS : (color + 1) * LIGHT_NUMBERS, color::3] = skies[:, color].T
    squares, sums, count = np.zeros(light.shape[1]), np.zeros(light.shape[1]), 3 * max(len(seeing), 1)
    for block in _blocks(seeing):
        true = rows[block].astype(np.float32)
        squares += (((coefficients[block].astype(np.float32) @ basis - true) @ light) ** 2).sum(
            axis=0, dtype=np.float64
        )
        sums += (true @ light).sum(axis=0, dtype=np.float64)
    squares, sums = (one.reshape(-1, 3).sum(axis=1) / count for one in (squares, sums))
    return float(np.mean(np.sqrt(squares) / np.maximum(sums, 1e-30)))


def _blocks(indices: np.ndarray) -> list[np.ndarray]:
    return [indices[start : start + BLOCK] for start in range(0, len(indices), BLOCK)]


def _signed(basis: np.ndarray) -> np.ndarray:
    """Return rows with the sign that makes their largest number positive: an eigenvector has none of its own."""
    largest = np.take_along_axis(basis, np.abs(basis).argmax(axis=1)[:, None], axis=1)
    return basis * np.where(largest < 0, -1.0, 1.0)
