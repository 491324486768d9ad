"""Faces with any number of corners as triangles."""

from __future__ import annotations

import numpy as np


def triangulate(points: np.ndarray, corners: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return faces as triangles: indices into ``corners`` int64 [triangle, 3], and the face of each [triangle].

    ``points`` [point, 3] are positions; ``corners`` [corner] number them, face after face; ``sizes`` [face] are the
    numbers of corners, 3 or more. Triangles stand in the order of their faces and turn the way these do. Convex faces
    become fans; the others are cut by ear clipping in the plane of their Newell normal.
    """
    starts = np.cumsum(sizes) - sizes
    triangles, faces = [], []
    for size in np.unique(sizes).tolist():
        chosen = np.flatnonzero(sizes == size)
        rows = starts[chosen, None] + np.arange(size)
        if size == 3:
            triangles.append(rows)
            faces.append(chosen)
            continue
        flat, convex = _flattened(np.asarray(points[corners[rows]], np.float64))
        fans = rows[convex]
        steps = np.arange(1, size - 1)
        fan = np.stack(
            [np.broadcast_to(fans[:, :1], (len(fans), size - 2)), fans[:, steps], fans[:, steps + 1]], axis=2
        )
        triangles.append(fan.reshape(-1, 3))
        faces.append(np.repeat(chosen[convex], size - 2))
        for face in np.flatnonzero(~convex).tolist():
            ears = rows[face][_ears(flat[face])]
            triangles.append(ears)
            faces.append(np.full(len(ears), chosen[face]))
    if not triangles:
        return np.empty((0, 3), np.int64), np.empty(0, np.int64)
    owner = np.concatenate(faces)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(triangles)[order], owner[order]


def _flattened(polygons: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return polygons [n, corner, 3] in the plane of their Newell normal [n, corner, 2], and which are convex [n]."""
    polygons = polygons - polygons[:, :1]
    following = np.roll(polygons, -1, axis=1)
    normals = np.cross(polygons, following).sum(axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    least = np.eye(3)[np.argmin(np.abs(normals), axis=1)]
    across = np.cross(normals, least)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
    up = np.cross(normals, across)
    flat = np.stack([np.einsum("ncx,nx->nc", polygons, axis) for axis in (across, up)], axis=2)
    edges = np.roll(flat, -1, axis=1) - flat
    after = np.roll(edges, -1, axis=1)
    turns = edges[..., 0] * after[..., 1] - edges[..., 1] * after[..., 0]
    size = np.square(edges).sum(axis=2).max(axis=1, keepdims=True)
    convex = (turns >= -1e-9 * size).all(axis=1)
    if flat.shape[1] > 4:  # a star turns one way, too, but more than once around
        angles = np.arctan2(turns, (edges * after).sum(axis=2)).sum(axis=1)
        convex &= np.abs(angles) < 3.0 * np.pi
    return flat, convex


def _ears(polygon: np.ndarray) -> np.ndarray:
    """Return the triangles [n, 3] of a polygon [corner, 2], counter-clockwise; a fan if it has no inside."""
    from mapbox_earcut import triangulate_float64

    found = triangulate_float64(np.ascontiguousarray(polygon), np.array([len(polygon)], np.uint32))
    ears = found.astype(np.int64).reshape(-1, 3)
    if not len(ears):
        steps = np.arange(1, len(polygon) - 1)
        return np.stack([np.zeros_like(steps), steps, steps + 1], axis=1)
    a, b, c = (polygon[ears[:, corner]] for corner in range(3))
    area = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    return np.where(area[:, None] < 0.0, ears[:, ::-1], ears)
