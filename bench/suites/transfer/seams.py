"""Seams: how far light jumps where charts meet on a smooth surface, beside its change over half a texel inside one."""

from __future__ import annotations

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness.measure import Row
from warp_gi.bench.suites.transfer import shapes
from warp_gi.bench.suites.transfer.views import smooth_sky
from warp_gi.techniques.radiance_transfer.textures import TransferTextures, transfer_textures
from warp_gi.techniques.shared.atlas.atlas import Atlas

TABLE = "seams"
RESOLUTIONS, QUICK_RESOLUTIONS = (64, 128, 256, 512), (64, 128)
MOST = 1.0
"""Largest jump in changes over half a texel, at every size from 128."""
POINTS = 4
"""Points on each edge between charts."""


def seam_rows(quick: bool, device: str) -> list[Row]:
    """Return a row for each size of the atlas of balls in a room, and of heads."""
    rows: list[Row] = []
    cases = {"room": shapes.room(12 if quick else 24), "heads": shapes.heads(8 if quick else 24)}
    for name, scene in cases.items():
        for resolution in QUICK_RESOLUTIONS if quick else RESOLUTIONS:
            estimator = gi.RadianceTransfer(bounces=0, resolution=resolution, charts="xatlas")
            textures = transfer_textures(gi.bake(scene, estimator, device))
            row: Row = {"table": TABLE, "case": name, "resolution": resolution, **jumps(scene, textures)}
            rows.append(row | {"target": MOST if resolution >= 128 else 0.0})
    return rows


def jumps(scene: gi.Scene, textures: TransferTextures, seed: int = 0) -> Row:
    """Return RMS differences of irradiance over its mean: across seams, and over half a texel inside charts."""
    light = smooth_sky().harmonics_of(5)
    irradiance = textures.transfer[:, :25].astype(np.float64) @ light.T
    rng, atlas = np.random.default_rng(seed), textures.atlas
    one, other = seam_edges(scene, atlas)
    along = (np.arange(POINTS) + 0.5) / POINTS
    t, sides = along[:, None], []
    for edge in (one, other):
        corners = atlas.corners[edge[:, 0, None], edge[:, 1:]].astype(np.float64)  # [edge, end, xy]
        points = corners[:, None, 0] * (1 - t) + corners[:, None, 1] * t
        sides.append(fetched(atlas, irradiance, np.repeat(edge[:, 0], POINTS), points.reshape(-1, 2)))
    faces, inside = inner_points(atlas, is_smooth(scene), rng, 20_000)
    angles = rng.uniform(0, 2 * np.pi, len(faces))
    step = 0.5 * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    here, there = (fetched(atlas, irradiance, faces, inside + way * step / 2) for way in (-1, 1))
    kept = here[1] & there[1]
    mean = float(irradiance[atlas.slot_sides == 0].mean())
    both = sides[0][1] & sides[1][1]
    jump = float(np.sqrt(np.mean((sides[0][0] - sides[1][0])[both] ** 2))) / mean
    change = float(np.sqrt(np.mean((here[0] - there[0])[kept] ** 2))) / mean
    return {"seams": len(one), "jump": jump, "change over half a texel": change, "jump over change": jump / change}


def seam_edges(scene: gi.Scene, atlas: Atlas) -> tuple[np.ndarray, np.ndarray]:
    """Return edges where two charts meet with one normal, as face and two corners on either side, int [edge, 3] each.

    Corners of the second are in the order of the first.
    """
    geometry = scene.data("cpu").geometry
    ids = geometry.indices.numpy().reshape(-1, 3)
    points, normals = geometry.points.numpy(), geometry.normals.numpy()
    places = np.unique(np.round(np.column_stack([points, normals]), 4), axis=0, return_inverse=True)[1].reshape(-1)
    faces = np.repeat(np.flatnonzero(atlas.charts >= 0), 3)
    first = np.tile(np.arange(3), len(faces) // 3)
    second = (first + 1) % 3
    smooth = np.linalg.norm(normals[ids[faces, first]], axis=1) > 0.5
    faces, first, second = faces[smooth], first[smooth], second[smooth]
    ends = np.stack([places[ids[faces, first]], places[ids[faces, second]]], axis=1)
    turned = ends[:, 0] > ends[:, 1]
    first, second = np.where(turned, second, first), np.where(turned, first, second)
    order = np.lexsort(np.sort(ends, axis=1).T)
    keys, edges = np.sort(ends, axis=1)[order], np.stack([faces, first, second], axis=1)[order]
    same = (keys[1:] == keys[:-1]).all(axis=1) & (keys[1:, 0] != keys[1:, 1])
    pair = np.flatnonzero(same & (atlas.charts[edges[1:, 0]] != atlas.charts[edges[:-1, 0]]))
    return edges[pair], edges[pair + 1]


def is_smooth(scene: gi.Scene) -> np.ndarray:
    """Return which faces have shading normals, as seams are looked for between those, bool [face]."""
    geometry = scene.data("cpu").geometry
    first = geometry.indices.numpy().reshape(-1, 3)[:, 0]
    return np.asarray(np.linalg.norm(geometry.normals.numpy()[first], axis=1) > 0.5)


def inner_points(
    atlas: Atlas, chosen: np.ndarray, rng: np.random.Generator, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return faces of those ``chosen``, by their texels, and points inside of them, float64 [count, 2]."""
    edges = (atlas.corners[:, 1:] - atlas.corners[:, :1]).astype(np.float64)
    areas = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0]) * (chosen & (atlas.charts >= 0))
    faces = rng.choice(len(areas), count, p=areas / areas.sum())
    u, v = rng.random((2, count))
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return faces, atlas.corners[faces, 0] + u[:, None] * edges[faces, 0] + v[:, None] * edges[faces, 1]


def fetched(atlas: Atlas, values: np.ndarray, faces: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return values [slot, n] of fronts, bilinear at points in texels, and where all four texels are kept."""
    first, width, height = atlas.pages[atlas.face_pages[faces]].T
    x = np.clip(points[:, 0] - 0.5, 0, width - 1)
    y = np.clip(points[:, 1] - 0.5, 0, height - 1)
    i, j = x.astype(int), y.astype(int)
    found, kept = np.zeros((len(faces), values.shape[1])), np.ones(len(faces), bool)
    for right in (0, 1):
        for up in (0, 1):
            share = np.abs(1 - right - (x - i)) * np.abs(1 - up - (y - j))
            texel = first + np.minimum(j + up, height - 1) * width + np.minimum(i + right, width - 1)
            slot = atlas.slots[0, texel]
            kept &= (slot >= 0) | (share < 1e-3)
            found += values[np.maximum(slot, 0)] * (share * (slot >= 0))[:, None]
    return found, kept
