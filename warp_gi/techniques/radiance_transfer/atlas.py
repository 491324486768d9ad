"""The atlas of a scene: charts of its surfaces on a page, and the slots of the texels that they cover."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from warp_gi.launch import get_device
from warp_gi.scene.scene import Scene
from warp_gi.techniques.radiance_transfer.charts import ChartJob, cut_charts, packed, surface_sized
from warp_gi.techniques.radiance_transfer.settings import TransferSettings
from warp_gi.techniques.radiance_transfer.texels import covered_texels
from warp_gi.techniques.radiance_transfer.textures import Atlas


def make_atlas(
    scene: Scene, settings: TransferSettings, device: str, progress: Callable[[float], None] | None = None
) -> Atlas:
    """Return the atlas of the surfaces that rest, as they are at time 0, with about ``resolution``^2 texels.

    Faces that move, and those without an area, are on no page. ``progress`` is called with the share that is done.
    Raises OptionError where charts take longer than ``chart_seconds`` or do not fit.
    """
    flat = scene._flat
    points = flat.points[flat.indices].astype(np.float64)
    parts = part_numbers(scene)
    job = ChartJob(settings.chart_seconds)
    kept = np.flatnonzero(can_be_charted(points) & (parts >= 0))
    numbers = np.unique(parts[kept], return_inverse=True)[1]
    uvs, charts = cut_charts(points[kept], numbers, job, progress)
    uvs, charts = surface_sized(points[kept], uvs, charts)
    page = packed(uvs, charts, settings.resolution, job, None)
    corners = np.zeros((len(points), 3, 2), np.float32)
    corners[kept] = page.corners
    face_pages = np.full(len(points), -1, np.int32)
    face_pages[kept] = np.where(page.charts >= 0, 0, -1)
    face_charts = np.full(len(points), -1, np.int32)
    face_charts[kept] = page.charts
    pages = np.array([[0, page.width, page.height]], np.int32)
    covered = covered_texels(corners, face_pages, pages, get_device(device))
    slots = np.full((2, page.width * page.height), -1, np.int32)
    slots[0, covered.texels] = np.arange(len(covered.texels), dtype=np.int32)
    return Atlas(
        corners=corners,
        face_pages=face_pages,
        charts=face_charts,
        pages=pages,
        slots=slots,
        corner_slots=np.zeros((0, 0, 3), np.int32),
        slot_faces=covered.faces,
        slot_points=covered.points,
        slot_sides=np.zeros(len(covered.faces), np.uint8),
    )


def can_be_charted(points: np.ndarray) -> np.ndarray:
    """Return which of the faces [face, 3, 3] have finite corners and an area, bool [face].

    An area counts that is above the rounding of float32 coordinates relative to the face's own longest side.
    """
    sides = points[:, 1:] - points[:, :1]
    normal = np.cross(sides[:, 0], sides[:, 1])
    longest = np.maximum((sides**2).sum(axis=2).max(axis=1), ((sides[:, 1] - sides[:, 0]) ** 2).sum(axis=1))
    return np.isfinite(points).all(axis=(1, 2)) & (np.linalg.norm(normal, axis=1) > 1e-7 * longest)


def part_numbers(scene: Scene) -> np.ndarray:
    """Return the part of each face, int32 [face]: meshes of nodes, one after another; -1 for those that move."""
    parts, number = [np.zeros(0, np.int32)], 0
    for index, node in enumerate(scene.nodes):
        for mesh in node.meshes:
            parts.append(np.full(len(mesh.indices), -1 if scene.moves(index) else number, np.int32))
            number += 1
    return np.concatenate(parts)
