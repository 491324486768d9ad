"""Triangles, rays and a float64 oracle for tests of ray queries."""

from __future__ import annotations

import numpy as np


def oracle(points, indices, origins, directions, t_max=np.inf):
    """Return t [ray, triangle] in float64, infinite where there is no hit at 0 < t < t_max (Moeller, Trumbore)."""
    a, b, c = (points[indices[:, k]].astype(np.float64) for k in range(3))
    o, d = origins.astype(np.float64)[:, None], directions.astype(np.float64)[:, None]
    e1, e2 = b - a, c - a
    with np.errstate(all="ignore"):
        h = np.cross(d, e2[None])
        det = (h * e1).sum(-1)
        u = ((o - a) * h).sum(-1) / det
        q = np.cross(o - a, e1[None])
        v = (d * q).sum(-1) / det
        t = (e2 * q).sum(-1) / det
        inside = (det != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0) & (t < t_max)
    return np.where(inside, t, np.inf)


def soup(rng, count, size=0.2):
    """Return ``count`` separate random triangles of about ``size`` in the unit cube."""
    corners = rng.normal(size=(count, 3, 3)) * size + rng.random((count, 1, 3))
    return corners.reshape(-1, 3).astype(np.float32), np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


def rays(rng, count, scale=1.0):
    """Return origins in and around the unit cube times ``scale``, and directions of mixed lengths."""
    origins = (rng.random((count, 3)) * 2.0 - 0.5) * scale
    directions = rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-3, 3, (count, 1))
    return origins.astype(np.float32), directions.astype(np.float32)
