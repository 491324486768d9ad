"""Octahedral maps of directions in NumPy, the same as in ``warp_gi.kernels.octahedral``: +y is in the middle."""

from __future__ import annotations

import numpy as np


def encode(directions: np.ndarray) -> np.ndarray:
    """Return coordinates in [0, 1], float [..., 2], of directions [..., 3] of any length above zero."""
    x, y, z = np.moveaxis(0.5 * directions / np.abs(directions).sum(-1, keepdims=True), -1, 0)
    folded = ((0.5 - np.abs(z)) * np.where(x < 0, -1, 1), (0.5 - np.abs(x)) * np.where(z < 0, -1, 1))
    return np.stack(list(np.where(y < 0, folded, (x, z))), axis=-1) + 0.5


def unfolded(coordinates: np.ndarray) -> np.ndarray:
    """Return points (x, y, z) of the octahedron |x| + |y| + |z| = 1, float [..., 3], of coordinates [..., 2]."""
    a, b = np.moveaxis(2 * np.asarray(coordinates) - 1, -1, 0)
    y = 1 - np.abs(a) - np.abs(b)
    x = np.where(y < 0, (1 - np.abs(b)) * np.where(a < 0, -1, 1), a)
    z = np.where(y < 0, (1 - np.abs(a)) * np.where(b < 0, -1, 1), b)
    return np.stack([x, y, z], axis=-1)


def decode(coordinates: np.ndarray) -> np.ndarray:
    """Return unit directions, float [..., 3], of coordinates [..., 2] in [0, 1]; the inverse of ``encode``."""
    points = unfolded(coordinates)
    return points / np.linalg.norm(points, axis=-1, keepdims=True)


def texels_of(directions: np.ndarray, resolution: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the column and row, int [...], of the texel that directions [..., 3] fall in."""
    at = np.clip((encode(directions) * resolution).astype(int), 0, resolution - 1)
    return at[..., 0], at[..., 1]


def wrapped_texels(columns: np.ndarray, rows: np.ndarray, resolution: int) -> np.ndarray:
    """Return the indices of texels, row by row, int [...], at ``columns`` and ``rows`` that may lie past an edge.

    They lie up to ``resolution`` past it. On the sphere, what leaves the square over an edge comes back over the same
    edge, as far from its middle on the other side.
    """

    def reflected(at: np.ndarray) -> np.ndarray:
        return np.where(at < 0, -1 - at, np.where(at >= resolution, 2 * resolution - 1 - at, at))

    rows = np.where(columns != reflected(columns), resolution - 1 - rows, rows)
    columns = reflected(columns)
    columns = np.where(rows != reflected(rows), resolution - 1 - columns, columns)
    return reflected(rows) * resolution + columns
