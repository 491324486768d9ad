"""Transfer at the vertices of meshes instead of texels: the baseline, with the same rays."""

from __future__ import annotations

import numpy as np

from warp_gi.scene.scene import Scene
from warp_gi.techniques.shared.atlas.atlas import Atlas
from warp_gi.techniques.shared.atlas.build import can_be_charted, scene_parts

INWARDS = 1e-3
"""Weights of a face's other corners in the place of a slot: exactly at the foot of a wall rays would miss the wall."""
NORMAL_STEPS = 1e3
"""Steps of a component of a normal within which faces without shading normals share a slot at a vertex."""


def vertex_atlas(scene: Scene) -> Atlas:
    """Return slots at each vertex of surfaces that rest, on both sides.

    A slot lies in the first face of its vertex, a thousandth of the way to each of the other corners. Where vertices
    have no shading normals, each normal of the faces around one has slots of its own. Faces that move, and those
    without an area, have none.
    """
    flat = scene._flat
    points = flat.points[flat.indices].astype(np.float64)
    faces = np.flatnonzero(can_be_charted(points) & (scene_parts(scene)[0] >= 0))
    sides = points[faces, 1:] - points[faces, :1]
    normals = np.cross(sides[:, 0], sides[:, 1])
    steps = np.round(normals / np.linalg.norm(normals, axis=1, keepdims=True) * NORMAL_STEPS)
    vertices = flat.indices[faces].reshape(-1)
    is_flat = np.linalg.norm(flat.normals, axis=1)[vertices] < 1e-6
    keys = np.column_stack([vertices, np.repeat(steps, 3, axis=0) * is_flat[:, None]]).astype(np.int64)
    _, owners, numbers = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    count = len(owners)
    corner_slots = np.full((2, len(points), 3), -1, np.int32)
    corner_slots[0, faces] = numbers.reshape(-1, 3)
    corner_slots[1, faces] = numbers.reshape(-1, 3) + count
    weights = np.full((3, 3), INWARDS)
    np.fill_diagonal(weights, 1.0 - 2.0 * INWARDS)
    slot_points = weights[owners % 3, 1:].astype(np.float32)
    return Atlas(
        corners=np.zeros((0, 3, 2), np.float32),
        face_pages=np.full(len(points), -1, np.int32),
        charts=np.full(len(points), -1, np.int32),
        pages=np.zeros((0, 3), np.int32),
        slots=np.zeros((2, 0), np.int32),
        corner_slots=corner_slots,
        slot_faces=np.tile(faces[owners // 3].astype(np.int32), 2),
        slot_points=np.tile(slot_points, (2, 1)),
        slot_sides=np.repeat(np.arange(2, dtype=np.uint8), count),
    )
