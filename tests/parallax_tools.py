"""Directions as a region's anchor sees them, in float64: where a ray meets the sphere around the anchor."""

from __future__ import annotations

import numpy as np
from scene_tools import unit

NEAREST = 0.95
"""Distance from the anchor, over the sphere's radius, beyond which there is no parallax."""


def random_directions(count: int, seed: int = 1) -> np.ndarray:
    """Return float32 unit vectors [count, 3]."""
    return unit(np.random.default_rng(seed).standard_normal((count, 3))).astype(np.float32)


def has_parallax(anchors: np.ndarray, positions: np.ndarray) -> np.ndarray:
    """Return which positions are well inside of their anchors' spheres."""
    distances = np.linalg.norm(positions - anchors[..., :3], axis=-1)
    return (anchors[..., 3] > 0) & (distances * anchors[..., 3] < NEAREST)


def meet(anchors: np.ndarray, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return how far rays go until they meet the sphere: the positive root of |x + t w - c|^2 = R^2."""
    away, radii = positions - anchors[..., :3], 1 / anchors[..., 3]
    square = (directions**2).sum(-1)
    half = (away * directions).sum(-1)
    constant = (away**2).sum(-1) - radii**2
    return (np.sqrt(half**2 - square * constant) - half) / square


def as_seen(anchors: np.ndarray, positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return directions [..., 3] at the anchor, of rays that set out inside of its sphere."""
    t = meet(anchors, positions, directions)[..., None]
    return (positions + t * directions - anchors[..., :3]) * anchors[..., 3:]


def seen_from_anchor(
    anchors: np.ndarray, positions: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return directions at the anchor, and solid angle there per solid angle at the position, by differences.

    Anchors [..., 4], positions and directions [..., 3], which broadcast.
    """
    shape = np.broadcast_shapes(anchors.shape[:-1], positions.shape[:-1], directions.shape[:-1])
    anchors, positions, directions = (
        np.broadcast_to(np.asarray(x, np.float64), (*shape, x.shape[-1])) for x in (anchors, positions, directions)
    )
    inside = has_parallax(anchors, positions)
    seen, stretch = directions.copy(), np.ones(shape)
    a, x, w = anchors[inside], positions[inside], unit(directions[inside])
    seen[inside] = as_seen(a, x, w)
    helper = np.where(np.abs(w[..., :1]) < 0.6, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])
    u = unit(np.cross(w, helper))
    v, h = np.cross(w, u), 1e-5
    du, dv = ((as_seen(a, x, unit(w + h * e)) - as_seen(a, x, unit(w - h * e))) / (2 * h) for e in (u, v))
    stretch[inside] = np.linalg.norm(np.cross(du, dv), axis=-1)
    return seen, stretch
