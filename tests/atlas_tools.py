"""Atlases of transfer textures, read on the host."""

from __future__ import annotations

import numpy as np
from transfer_tools import transfer_settings

import warp_gi as gi
from warp_gi.scene.scene import Scene
from warp_gi.techniques.radiance_transfer.settings import TransferSettings
from warp_gi.techniques.shared.atlas.atlas import Atlas


def settings(**changes) -> TransferSettings:
    """Return settings of a small atlas."""
    base = {"resolution": 128, "texel_sets": "one", "charts": "xatlas", "bounces": 4}
    return transfer_settings(**{**base, **changes})


def fetched(atlas: Atlas, faces: np.ndarray, u: np.ndarray, v: np.ndarray, side: int = 0):
    """Return the four slots [n, 4] around points of faces, and their bilinear shares, of which none is left out."""
    page = atlas.pages[atlas.face_pages[faces]].astype(np.int64)
    weights = np.stack([1.0 - u - v, u, v], axis=1)
    at = (atlas.corners[faces] * weights[..., None]).sum(axis=1) - 0.5
    at = np.clip(at, 0.0, page[:, 1:] - 1.0)
    low = np.floor(at).astype(np.int64)
    high = np.minimum(low + 1, page[:, 1:] - 1)
    f = at - low
    slots, shares = [], []
    for y, fy in ((low[:, 1], 1 - f[:, 1]), (high[:, 1], f[:, 1])):
        for x, fx in ((low[:, 0], 1 - f[:, 0]), (high[:, 0], f[:, 0])):
            slots.append(atlas.slots[side, page[:, 0] + y * page[:, 1] + x])
            shares.append(fx * fy)
    return np.stack(slots, axis=1), np.stack(shares, axis=1)


def slot_positions(scene: Scene, atlas: Atlas) -> np.ndarray:
    """Return where slots lie, float64 [slot, 3]."""
    return points_of(scene, atlas.slot_faces, *atlas.slot_points.T.astype(np.float64))


def points_of(scene: Scene, faces: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return points of faces, float64 [n, 3]."""
    corners = scene._flat.points[scene._flat.indices[faces]].astype(np.float64)
    return (corners * np.stack([1.0 - u - v, u, v], axis=1)[..., None]).sum(axis=1)


def random_points(faces: np.ndarray, each: int, seed: int = 0):
    """Return random points of faces: face, u and v of each."""
    rng = np.random.default_rng(seed)
    u, v = rng.random((2, len(faces) * each))
    fold = u + v > 1.0
    u, v = np.where(fold, 1.0 - u, u), np.where(fold, 1.0 - v, v)
    return np.repeat(faces, each), u, v


def texel_sizes(scene: Scene, atlas: Atlas) -> np.ndarray:
    """Return the length in metres of a texel on each face along its longest direction, float64 [face]; 0 off pages."""
    points = scene._flat.points[scene._flat.indices].astype(np.float64)
    sides, flat = points[:, 1:] - points[:, :1], (atlas.corners[:, 1:] - atlas.corners[:, :1]).astype(np.float64)
    sizes = np.zeros(len(points))
    good = np.abs(np.linalg.det(flat)) > 1e-9
    sizes[good] = np.linalg.norm(np.linalg.inv(flat[good]) @ sides[good], axis=(1, 2), ord=2)
    return sizes


def box(low, size, inwards: bool = False):
    """Return a closed box from its lowest corner on, whose fronts look outwards unless told."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * size + low
    sides = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    indices = np.array([[s[0], s[k], s[k + 1]] for s in sides for k in (1, 2)])
    return gi.Mesh(corners.astype(np.float32), indices[:, ::-1].copy() if inwards else indices, name="box")


def clipped_nearest(corners: np.ndarray) -> np.ndarray | None:
    """Return the point nearest to the origin of a triangle [3, 2] cut off at the square from -1 to 1, or None."""
    polygon = list(corners)
    for axis in range(2):
        for sign in (1.0, -1.0):
            kept = []
            for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True):
                da, db = 1.0 - sign * a[axis], 1.0 - sign * b[axis]
                if da >= 0.0:
                    kept.append(a)
                if da * db < 0.0:
                    kept.append(a + (b - a) * da / (da - db))
            polygon = kept
    if not polygon:
        return None
    if covered_by(corners[None]):
        return np.zeros(2)
    candidates = []
    for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        size = (b - a) @ (b - a)
        candidates.append(a + (b - a) * np.clip(-(a @ (b - a)) / size if size > 0.0 else 0.0, 0.0, 1.0))
    return min(candidates, key=np.linalg.norm)


def covered_by(triangles: np.ndarray) -> bool:
    """Return whether the origin is well within any of the triangles [n, 3, 2]."""
    turned = np.roll(triangles, -1, axis=1)
    crosses = triangles[..., 0] * turned[..., 1] - triangles[..., 1] * turned[..., 0]
    return bool(((crosses > 1e-6).all(axis=1) | (crosses < -1e-6).all(axis=1)).any())
