"""Real spherical harmonics of skies: order n has n^2 functions, the low frequencies.

Functions are orthonormal, without the Condon-Shortley sign, and their polar axis is z. Function l * l + l + m is
that of band l and degree m from -l to l; kernels/harmonics.py writes out the first nine.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cache

import numpy as np

from warp_gi.scene.sky import node_solid_angles

# Polar coordinates of a map's own space, y up, as directions with z up: its azimuth runs from -z to +x. A reflection.
_POLAR_FROM_MAP = np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])

_POINTS = 3  # between two rows, by which a map is integrated


def basis(directions: np.ndarray, order: int = 3) -> np.ndarray:
    """Return the order^2 functions, float64 [..., order^2], at unit ``directions`` [..., 3]."""
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    if order == 3:  # closed formulas: what other techniques store and show depends on their last bits
        a, b, c = math.sqrt(3 / (4 * math.pi)), 0.5 * math.sqrt(15 / math.pi), 0.25 * math.sqrt(5 / math.pi)
        rows = [0.5 / math.sqrt(math.pi) + 0 * x, a * y, a * z, a * x]
        rows += [b * x * y, b * y * z, c * (3 * z * z - 1), b * x * z, 0.5 * b * (x * x - y * y)]
        return np.stack(rows, axis=-1)
    result = np.empty((order * order, *x.shape))
    cosine, sine = np.ones_like(x), np.zeros_like(x)  # of m times the azimuth, times sin(polar angle)^m
    for m in range(order):
        for l, value in enumerate(_legendre(m, order, z, np.ones_like(z)), m):
            if m == 0:
                result[l * l + l] = value
            else:
                result[l * l + l + m] = math.sqrt(2) * value * cosine
                result[l * l + l - m] = math.sqrt(2) * value * sine
        cosine, sine = cosine * x - sine * y, cosine * y + sine * x
    return np.moveaxis(result, 0, -1)


def by_coefficient(factors: np.ndarray) -> np.ndarray:
    """Return factors of bands [..., order] for each function, [..., order^2]."""
    return np.repeat(factors, 2 * np.arange(np.shape(factors)[-1]) + 1, axis=-1)


def sphere(degree: int) -> tuple[np.ndarray, np.ndarray]:
    """Return directions [n, 3] and weights [n], sr, that integrate polynomials up to ``degree`` exactly (Gauss)."""
    z, weights = np.polynomial.legendre.leggauss(degree // 2 + 1)
    count = degree + 1
    phi = (np.arange(count) + 0.5) * (2 * math.pi / count)
    ring = np.sqrt(1 - z * z)[:, None]
    directions = np.stack([ring * np.cos(phi), ring * np.sin(phi), z[:, None] + 0 * phi], axis=-1).reshape(-1, 3)
    return directions, np.repeat(weights * (2 * math.pi / count), count)


def project(pixels: np.ndarray, order: int = 3) -> np.ndarray:
    """Return the coefficients, float64 [3, order^2], of a latitude-longitude map [height, width, 3] in its own space.

    At order 3 a sum over nodes, with errors of second order in their distance; else exact for the bilinear map.
    """
    height, width = pixels.shape[:2]
    if order != 3:
        return rotate(_from_rings(ring_coefficients(pixels, order)), _POLAR_FROM_MAP.T)
    theta = np.arange(height) * math.pi / (height - 1)
    phi = (np.arange(width) + 0.5) * 2 * math.pi / width
    areas = node_solid_angles(height, width)
    result = np.zeros((3, 9))
    for row in range(height):  # a row at a time: a large map times nine functions would not fit the cache
        ring = np.full(width, math.sin(theta[row]))
        up = np.full(width, math.cos(theta[row]))
        directions = np.stack([ring * np.sin(phi), up, -ring * np.cos(phi)], axis=-1)
        result += (pixels[row].astype(np.float64) * areas[row]).T @ basis(directions)
    return result


def rotate(coefficients: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return the coefficients [3, order^2] of a sky turned by ``rotation`` [3, 3] (new from old directions); exact.

    About 0.2 ms at order 5.
    """
    order = math.isqrt(np.shape(coefficients)[-1])
    if order == 3:
        rng = np.random.default_rng(9)
        directions = rng.normal(size=(32, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        values = basis(directions @ rotation) @ coefficients.T  # the old sky in the old direction: rotation^T d
        return np.linalg.lstsq(basis(directions), values, rcond=None)[0].T
    directions, projection = _projection(order)
    return coefficients @ basis(directions @ rotation, order).T @ projection


def ring_coefficients(pixels: np.ndarray, order: int) -> np.ndarray:
    """Return complex coefficients [order (degree m), order (band l), 3] of a map, about its own up axis; 0 for l < m.

    The map is sum_m Re((2 - [m = 0]) c_m P_lm(cos polar angle) exp(i m azimuth)) with orthonormal P_lm, azimuth 2 pi u
    as ``Environment`` has it. Exact for radiance that is bilinear between nodes, and fast at high orders.
    """
    height, width = pixels.shape[:2]
    order_seen = min(order, width // 2)  # of higher degrees a map knows nothing
    rings = np.empty((order_seen, height, 3), np.complex128)
    for rows in np.array_split(np.arange(height), max(1, height * width // 65536)):  # so many as fit the cache
        spectrum = np.fft.rfft(pixels[rows].astype(np.float64), axis=1)[:, :order_seen]
        rings[:, rows] = spectrum.transpose(1, 0, 2)
    degrees, step = np.arange(order_seen), math.pi / (height - 1)
    around = np.sinc(degrees / width) ** 2 * (2 * math.pi / width)  # the integral of what is linear between columns
    rings *= (around * np.exp(-1j * degrees * math.pi / width))[:, None, None]  # the first column: half a texel in
    points, weights = np.polynomial.legendre.leggauss(_POINTS)
    share = (points + 1) / 2  # of the way from a row to the next
    theta = (np.arange(height - 1)[:, None] + share) * step
    values = rings[:, :-1, None] * (1 - share)[:, None] + rings[:, 1:, None] * share[:, None]
    values *= (np.sin(theta) * weights * step / 2)[..., None]
    values = values.reshape(order_seen, -1, 3)
    result = np.zeros((order, order, 3), np.complex128)
    for m, functions in enumerate(_ring_functions(theta.ravel(), order, order_seen)):
        result[m, m:] = (functions @ values[m].view(np.float64)).view(np.complex128)  # real and imaginary parts apart
    return result


def ring_pixels(coefficients: np.ndarray, height: int) -> np.ndarray:
    """Return the map float64 [height, 2 * height, 3] of ``ring_coefficients`` [order, order, 3], at its nodes."""
    order, width = len(coefficients), 2 * height
    rings = np.zeros((height, height + 1, 3), np.complex128)
    theta = np.arange(height) * (math.pi / (height - 1))
    for m, functions in enumerate(_ring_functions(theta, order, min(order, height))):
        rings[:, m] = functions.T @ coefficients[m, m:]
    rings *= np.exp(1j * np.arange(height + 1) * math.pi / width)[:, None]
    return np.fft.irfft(rings, width, axis=1) * width


def _ring_functions(theta: np.ndarray, order: int, degrees: int) -> Iterator[np.ndarray]:
    """Yield the functions of the polar angle ``theta`` [n] of each degree m, float64 [order - m, n]."""
    z, ring = np.cos(theta), np.sin(theta)
    for m in range(degrees):
        yield np.stack(_legendre(m, order, z, ring))


def _from_rings(rings: np.ndarray) -> np.ndarray:
    """Return ring coefficients [order, order, 3] as real ones [3, order^2], z up."""
    order = len(rings)
    result = np.empty((3, order * order))
    for l in range(order):
        result[:, l * l + l] = rings[0, l].real
        for m in range(1, l + 1):
            result[:, l * l + l + m] = math.sqrt(2) * rings[m, l].real
            result[:, l * l + l - m] = -math.sqrt(2) * rings[m, l].imag
    return result


def _legendre(m: int, order: int, z: np.ndarray, ring: np.ndarray) -> list[np.ndarray]:
    """Return orthonormal associated Legendre functions of bands m to order - 1 at z, times (ring / sin)^m.

    So ``ring`` is sin(polar angle) for the functions, or 1 to leave that factor to the azimuth.
    """
    factor = math.sqrt(1 / (4 * math.pi))
    for k in range(1, m + 1):
        factor *= math.sqrt((2 * k + 1) / (2 * k))
    rows = [factor * ring**m]
    for l in range(m + 1, order):
        a = math.sqrt((4 * l * l - 1) / (l * l - m * m))
        row = a * z * rows[-1]
        if l > m + 1:
            row -= a * math.sqrt(((l - 1) ** 2 - m * m) / (4 * (l - 1) ** 2 - 1)) * rows[-2]
        rows.append(row)
    return rows


@cache
def _projection(order: int) -> tuple[np.ndarray, np.ndarray]:
    """Return directions [n, 3] and the matrix [n, order^2] that projects values there on the functions exactly."""
    directions, weights = sphere(2 * order - 2)
    return directions, weights[:, None] * basis(directions, order)
