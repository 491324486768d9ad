"""Crease-aware vertex normals for meshes that have none."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from warp_gi.errors import OptionError
from warp_gi.scene.model import Mesh, MorphTarget

NORMAL_STEPS = 511
"""Steps per unit to which components of normals are rounded, to tell which corners of a vertex can share one."""


def smooth_mesh(mesh: Mesh, angle: float) -> Mesh:
    """Return the mesh with shading normals, its vertices split along creases.

    A corner's normal is the mean of the normals of the faces around its vertex (vertices
    at equal positions are one) that lean less than ``angle`` degrees away from the corner's
    own face, weighted by the faces' angles there. Faces without area have no say.

    Raises OptionError unless 0 <= angle <= 180.
    """
    if not 0.0 <= angle <= 180.0:
        raise OptionError(f"smooth must be an angle from 0 to 180 degrees, got {angle}")
    indices = np.asarray(mesh.indices, np.int64)
    if not indices.size:
        return mesh
    face_normals, corner_angles = _face_normals(np.asarray(mesh.points, np.float64)[indices])
    position = np.unique(np.asarray(mesh.points), axis=0, return_inverse=True)[1].reshape(-1)[indices].reshape(-1)
    normals = _corner_normals(position, np.repeat(face_normals, 3, axis=0), corner_angles.reshape(-1), angle)

    # one vertex for all corners that had one (without uvs and colours: one position) and agree on the normal
    steps = np.round((normals + 1.0) * NORMAL_STEPS).astype(np.int64)
    labels = ("uvs", "further_uvs", "colors", "joints", "joint_weights")
    parts: dict[str, Any] = {label: getattr(mesh, label) for label in labels}
    is_bare = all(part is None for part in parts.values()) and not mesh.targets
    vertex = position if is_bare else indices.reshape(-1)
    key = ((vertex * 1024 + steps[:, 0]) * 1024 + steps[:, 1]) * 1024 + steps[:, 2]
    _, first, corner_vertex = np.unique(key, return_index=True, return_inverse=True)
    source = indices.reshape(-1)[first]
    split: dict[str, Any] = {label: None if part is None else np.asarray(part)[source] for label, part in parts.items()}
    return replace(
        mesh,
        points=np.asarray(mesh.points)[source],
        normals=normals[first].astype(np.float32),
        indices=corner_vertex.reshape(-1, 3).astype(np.int32),
        targets=[MorphTarget(None if t.points is None else np.asarray(t.points)[source]) for t in mesh.targets],
        **split,
    )


def _face_normals(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return unit normals [face, 3] (zero without area) and the angles at the corners [face, 3] in radians."""
    edges = np.roll(corners, -1, axis=1) - corners
    normals = np.cross(edges[:, 0], edges[:, 1])
    edges /= np.maximum(np.linalg.norm(edges, axis=2, keepdims=True), 1e-300)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    cosines = -np.einsum("fcx,fcx->fc", edges, np.roll(edges, 1, axis=1))
    return normals, np.arccos(np.clip(cosines, -1.0, 1.0))


def _corner_normals(position: np.ndarray, normals: np.ndarray, weights: np.ndarray, angle: float) -> np.ndarray:
    """Return unit normals [corner, 3] from those of the corners' faces; ``position`` numbers the welded vertices."""
    order = np.argsort(position, kind="stable")
    ends = np.searchsorted(position[order], position[order], side="right")  # end of the run of corners at one position
    sorted_normals = normals[order]
    weighted = sorted_normals * weights[order, None]
    total = weighted.copy()
    limit = np.cos(np.radians(angle)) - 1e-9
    near = np.arange(len(order))
    step = 0
    while len(near):  # every pair of corners at one position, by their distance in the run
        step += 1
        near = near[near + step < ends[near]]
        far = near + step
        alike = np.einsum("cx,cx->c", sorted_normals[near], sorted_normals[far]) >= limit
        total[near[alike]] += weighted[far[alike]]
        total[far[alike]] += weighted[near[alike]]
    length = np.linalg.norm(total, axis=1, keepdims=True)
    total = np.where(length > 1e-12, total / np.maximum(length, 1e-300), sorted_normals)
    result = np.empty_like(total)
    result[order] = total
    return result
