"""Vertices that get polygons: a set for each position and normal, and others for surfaces seen from behind."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_gi.scene.geometry import FlatGeometry
from warp_gi.techniques.shared.atlas.islands import equal_rows, islands

NORMAL_STEPS = 1e4
"""Steps of a component of a normal within which corners share a set."""


@dataclass(frozen=True, eq=False)
class CornerSets:
    """Sets of the corners of triangles."""

    positions: np.ndarray
    """Where the vertex is, float32 [set, 3], metres."""
    normals: np.ndarray
    """Unit normal on the side that is seen, float32 [set, 3]."""
    lengths: np.ndarray
    """Mean and longest edge of the triangles around, float32 [set, 2], metres."""
    corner_sets: np.ndarray
    """Set of each corner of a side of a triangle, int32 [2 * triangles, 3]: fronts, then backs. -1 where there is none:
    backs of closed surfaces, and triangles without an area."""


def corner_sets(flat: FlatGeometry) -> CornerSets:
    """Return the sets of a scene's vertices. Corners at one place with one normal share theirs, welded or not.

    A surface is seen from behind if it is open: if any of its edges has not exactly two triangles. Its corners have a
    second set, with the normal turned around.
    """
    points = flat.points[flat.indices].astype(np.float64)
    across = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    areas = np.linalg.norm(across, axis=1)
    sized = areas > 0
    faces = across / np.where(sized, areas, 1.0)[:, None]
    normals = flat.normals[flat.indices].astype(np.float64)
    is_flat = np.linalg.norm(normals, axis=2) < 1e-6
    normals = np.where(is_flat[:, :, None], faces[:, None], normals)
    normals *= np.where((normals * faces[:, None]).sum(-1) < 0, -1.0, 1.0)[:, :, None]
    normals /= np.maximum(np.linalg.norm(normals, axis=2), 1e-12)[:, :, None]
    places = equal_rows(flat.points)[1][flat.indices]
    backs = sized & _is_open(places, sized)
    chosen = np.concatenate([np.flatnonzero(sized), np.flatnonzero(backs) + len(points)])
    triangles = chosen % len(points)
    turned = np.where(chosen < len(points), 1.0, -1.0)[:, None, None] * normals[triangles]
    steps = np.round(turned.reshape(-1, 3) * NORMAL_STEPS).astype(np.int64)
    numbers = equal_rows(np.column_stack([places[triangles].reshape(-1), steps]))[1]
    owners = np.unique(numbers, return_index=True)[1]
    edges = np.linalg.norm(points - np.roll(points, -1, axis=1), axis=2)[triangles]
    around = np.stack([edges, np.roll(edges, 1, axis=1)], axis=2)  # the two edges at each corner
    longest = np.zeros(len(owners))
    np.maximum.at(longest, numbers, around.max(axis=2).reshape(-1))
    mean = np.bincount(numbers, around.mean(axis=2).reshape(-1)) / np.bincount(numbers)
    sets = np.full((2 * len(points), 3), -1, np.int32)
    sets[chosen] = numbers.reshape(-1, 3)
    return CornerSets(
        points[triangles].reshape(-1, 3)[owners].astype(np.float32),
        turned.reshape(-1, 3)[owners].astype(np.float32),
        np.stack([mean, longest], axis=1).astype(np.float32),
        sets,
    )


def _is_open(places: np.ndarray, sized: np.ndarray) -> np.ndarray:
    """Return whether each triangle is of a surface with an edge that has not two triangles, bool [triangle]."""
    triangles = np.flatnonzero(sized)
    corners = places[triangles]
    edges = np.sort(np.stack([corners, np.roll(corners, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    numbers = equal_rows(edges)[1]
    is_border = (np.bincount(numbers)[numbers] != 2).reshape(-1, 3).any(axis=1)
    part = islands(corners[:, :, None])
    result = np.zeros(len(places), bool)
    result[triangles] = np.isin(part, part[is_border])
    return result
