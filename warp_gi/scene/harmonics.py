"""Low frequencies of a sky: nine coefficients of real spherical harmonics a channel (kernels/harmonics.py)."""

from __future__ import annotations

import math

import numpy as np

from warp_gi.scene.sky import node_solid_angles


def basis(directions: np.ndarray) -> np.ndarray:
    """Return the nine functions, float64 [..., 9], at unit ``directions`` [..., 3]."""
    x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
    a, b, c = math.sqrt(3 / (4 * math.pi)), 0.5 * math.sqrt(15 / math.pi), 0.25 * math.sqrt(5 / math.pi)
    rows = [0.5 / math.sqrt(math.pi) + 0 * x, a * y, a * z, a * x]
    rows += [b * x * y, b * y * z, c * (3 * z * z - 1), b * x * z, 0.5 * b * (x * x - y * y)]
    return np.stack(rows, axis=-1)


def project(pixels: np.ndarray) -> np.ndarray:
    """Return the coefficients, float64 [3, 9], of a latitude-longitude map [height, width, 3] in its own space."""
    height, width = pixels.shape[:2]
    theta = np.arange(height) * math.pi / (height - 1)
    phi = (np.arange(width) + 0.5) * 2 * math.pi / width
    weighted = pixels.astype(np.float64) * node_solid_angles(height, width)[:, None, None]
    result = np.zeros((3, 9))
    for row in range(height):  # a row at a time: a large map times nine functions would not fit the cache
        ring = np.full(width, math.sin(theta[row]))
        up = np.full(width, math.cos(theta[row]))
        directions = np.stack([ring * np.sin(phi), up, -ring * np.cos(phi)], axis=-1)
        result += weighted[row].T @ basis(directions)
    return result


def rotate(coefficients: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return the coefficients [3, 9] of a sky turned by ``rotation`` [3, 3] (new from old directions); exact."""
    rng = np.random.default_rng(9)
    directions = rng.normal(size=(32, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    values = basis(directions @ rotation) @ coefficients.T  # the old sky in the old direction: rotation^T d
    return np.linalg.lstsq(basis(directions), values, rcond=None)[0].T
