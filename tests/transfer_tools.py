"""Settings, atlases made by hand and slow integrals, for tests of radiance transfer."""

from __future__ import annotations

from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi.scene.harmonics import basis
from warp_gi.techniques.radiance_transfer.settings import TransferSettings
from warp_gi.techniques.shared.atlas.atlas import Atlas

SETTINGS: dict[str, Any] = {
    "storage": "texture",
    "resolution": 64,
    "texel_sets": "auto",
    "charts": "auto",
    "chart_seconds": 0.0,
    "order": 5,
    "first_rays": 64,
    "rays": 512,
    "bounce_rays": 64,
    "bounces": 16,
    "tolerance": 0.002,
}


def transfer_settings(**changes: Any) -> TransferSettings:
    """Return settings of a small bake."""
    return TransferSettings(**{**SETTINGS, **changes})


def face_atlas(scene: gi.Scene, places: dict[int, tuple[float, float]] | None = None) -> Atlas:
    """Return an atlas with a slot on each side of each face: at its centre, or at the u, v of ``places``, by face."""
    count = scene.triangle_count
    slots = np.arange(2 * count, dtype=np.int32).reshape(2, count)
    points = np.full((count, 2), 1 / 3, np.float32)
    for face, place in (places or {}).items():
        points[face] = place
    return Atlas(
        corners=np.zeros((0, 3, 2), np.float32),
        face_pages=np.full(count, -1, np.int32),
        charts=np.full(count, -1, np.int32),
        pages=np.zeros((0, 3), np.int32),
        slots=np.zeros((2, 0), np.int32),
        corner_slots=np.repeat(slots[:, :, None], 3, axis=2),
        slot_faces=np.tile(np.arange(count, dtype=np.int32), 2),
        slot_points=np.tile(points, (2, 1)),
        slot_sides=np.repeat(np.arange(2, dtype=np.uint8), count),
    )


def sphere_grid(rows: int = 300, columns: int = 600) -> tuple[np.ndarray, np.ndarray]:
    """Return directions [n, 3] over the whole sphere and their solid angles [n], float64."""
    z, weights = np.polynomial.legendre.leggauss(rows)
    phi = 2 * np.pi * (np.arange(columns) + 0.5) / columns
    ring = np.sqrt(1 - z * z)[:, None]
    directions = np.stack([ring * np.cos(phi), ring * np.sin(phi), z[:, None] + 0 * phi], axis=-1).reshape(-1, 3)
    return directions, np.repeat(weights, columns) * 2 * np.pi / columns


def slow_transfer(visible: np.ndarray, normal: Any, order: int = 5) -> np.ndarray:
    """Return T_j = int V max(n.w, 0) y_j dw, float64 [order^2], for V [n] at the directions of ``sphere_grid``."""
    directions, weights = sphere_grid()
    weights = weights * visible * np.maximum(directions @ np.asarray(normal, np.float64), 0.0)
    return weights @ basis(directions, order)


def open_transfer(normal: Any, order: int = 5) -> np.ndarray:
    """Return A_l y(n), float64 [..., order^2]: transfer where nothing is in the way."""
    factors = [np.pi, 2 * np.pi / 3, np.pi / 4, 0.0, -np.pi / 24, 0.0][:order]
    return np.repeat(factors, 2 * np.arange(order) + 1) * basis(np.asarray(normal, np.float64), order)


def face_normals(scene: gi.Scene) -> np.ndarray:
    """Return the unit normals of all faces, float64 [face, 3]."""
    geometry = scene.data("cpu").geometry
    points = geometry.points.numpy()[geometry.indices.numpy()].astype(np.float64)
    normals = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)
