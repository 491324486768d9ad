"""The atlas of a scene: charts of its surfaces on a page, and the slots of the texels that they cover."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, Protocol

import numpy as np
import warp as wp

from warp_gi.errors import OptionError, SceneError
from warp_gi.launch import get_device
from warp_gi.scene.model import Mesh
from warp_gi.scene.scene import Scene
from warp_gi.techniques.shared.atlas.atlas import Atlas
from warp_gi.techniques.shared.atlas.backs import open_charts
from warp_gi.techniques.shared.atlas.buried import off_edges
from warp_gi.techniques.shared.atlas.charts import ChartJob, Page, cut_charts, packed, surface_sized
from warp_gi.techniques.shared.atlas.densities import density_factors
from warp_gi.techniques.shared.atlas.islands import islands
from warp_gi.techniques.shared.atlas.own_uvs import why_unfit
from warp_gi.techniques.shared.atlas.texels import covered_texels

Progress = Callable[[float], None]

NO_SURFACE = "no surface in this scene rests and has an area, so nothing can be baked; give one with triangles that do"
CUT_SHARE, PACKED_SHARE, COVERED_SHARE = 0.8, 0.9, 0.95
"""Shares of the whole that are done when charts are cut, packed, and their texels known."""


class AtlasSettings(Protocol):
    """What decides an atlas; techniques have it among their settings."""

    @property
    def resolution(self) -> int:
        """Texels along the longer side of the page."""

    @property
    def texel_sets(self) -> str:
        """Densities of meshes: "auto", "one" density for all, or "NAME=FACTOR,..." by name of node or mesh."""

    @property
    def charts(self) -> Literal["auto", "xatlas", "own"]:
        """Where uv come from: "auto" takes a mesh's own where they are fit, "own" demands it."""

    @property
    def chart_seconds(self) -> float:
        """Seconds of CPU time that xatlas may take; 0 is no limit."""


def make_atlas(
    scene: Scene, settings: AtlasSettings, device: str, progress: Progress | None = None, otherwise: str = ""
) -> Atlas:
    """Return the atlas of the surfaces that rest, as they are at time 0: one page of about ``resolution``^2 texels.

    Faces that move, and those without an area, are on no page. Each texel that a bilinear fetch inside a face touches
    has a slot, on the nearest point of the chart; and another on the back where the chart's back is in the open.
    ``progress`` is called with the share that is done; ``otherwise`` is what can be done without an atlas, for errors.
    The same scene and settings give the same atlas, bit by bit.

    Raises OptionError where charts take longer than ``chart_seconds`` or do not fit, for meshes whose own uv are
    demanded and unfit, and for unknown names in ``texel_sets``; SceneError where everything moves.
    """
    flat = scene._flat
    points = flat.points[flat.indices].astype(np.float64)
    parts, meshes = scene_parts(scene)
    kept = np.flatnonzero(can_be_charted(points) & (parts >= 0))
    page = _page(scene, settings, points[kept], parts[kept], flat.uvs[flat.indices[kept]], meshes, progress, otherwise)
    on_page = kept[page.charts >= 0]
    corners = np.zeros((len(points), 3, 2), np.float32)
    corners[on_page] = page.corners[page.charts >= 0]
    face_pages, charts = np.full((2, len(points)), -1, np.int32)
    face_pages[on_page] = 0
    charts[on_page] = np.unique(page.charts[page.charts >= 0], return_inverse=True)[1]
    pages = np.array([[0, page.width, page.height]], np.int32)
    return _with_slots(scene, corners, face_pages, charts, pages, get_device(device), progress)


def _page(
    scene: Scene,
    settings: AtlasSettings,
    points: np.ndarray,
    parts: np.ndarray,
    uvs: np.ndarray,
    meshes: list[tuple[str, Mesh]],
    progress: Progress | None,
    otherwise: str,
) -> Page:
    """Return the charts of the faces with corners ``points`` [face, 3, 3] and ``uvs`` [face, 3, 2] on a page."""
    sides = points[:, 1:] - points[:, :1]
    areas = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    factors = density_factors(
        scene,
        settings.texel_sets,
        np.bincount(parts, areas, len(meshes)),
        np.bincount(parts, minlength=len(meshes)),
        settings.resolution**2,
    )
    job = ChartJob(settings.chart_seconds, otherwise)
    has_own = _own_charts(settings.charts, parts, uvs, areas, meshes)[parts]
    charts = np.empty(len(points), np.int32)
    uvs = uvs.copy()
    uvs[~has_own], charts[~has_own] = cut_charts(
        points[~has_own], parts[~has_own], job, _share_of(progress, 0.0, CUT_SHARE)
    )
    if has_own.any():
        part = np.repeat(parts[has_own], 3).reshape(-1, 3, 1)
        charts[has_own] = (
            islands(np.concatenate([points[has_own], uvs[has_own], part], axis=2))
            + charts[~has_own].max(initial=-1)
            + 1
        )
    uvs, charts = surface_sized(points, uvs, charts)
    uvs *= factors[parts].astype(np.float32)[:, None, None]
    return packed(uvs, charts, settings.resolution, job, _share_of(progress, CUT_SHARE, PACKED_SHARE))


def _own_charts(
    wanted: str, parts: np.ndarray, uvs: np.ndarray, areas: np.ndarray, meshes: list[tuple[str, Mesh]]
) -> np.ndarray:
    """Return which parts have their own uv for charts, bool [part]; raises OptionError where they must and cannot."""
    fit = np.zeros(len(meshes), bool)
    if wanted == "xatlas":
        return fit
    known: dict[int, str | None] = {}
    order = np.argsort(parts, kind="stable")
    for faces in np.split(order, np.flatnonzero(np.diff(parts[order])) + 1) if len(order) else ():
        part = int(parts[faces[0]])
        node, mesh = meshes[part]
        if id(mesh) not in known:
            known[id(mesh)] = why_unfit(None if mesh.uvs is None else uvs[faces], areas[faces])
        reason = known[id(mesh)]
        if reason is not None and wanted == "own":
            raise OptionError(
                f'charts="own": mesh {mesh.name!r} of node {node!r} {reason}; give it uv in 0..1 without overlaps, or'
                ' take charts="auto"'
            )
        fit[part] = reason is None
    return fit


def _with_slots(
    scene: Scene,
    corners: np.ndarray,
    face_pages: np.ndarray,
    charts: np.ndarray,
    pages: np.ndarray,
    device: wp.Device,
    progress: Progress | None,
) -> Atlas:
    covered = covered_texels(corners, face_pages, pages, device)
    tell = progress or (lambda share: None)
    tell(COVERED_SHARE)
    has_back = open_charts(scene, covered, charts, device)[charts[covered.faces]]
    points = off_edges(corners[covered.faces].astype(np.float64), covered.points.astype(np.float64))
    fronts, backs = len(covered.faces), int(np.count_nonzero(has_back))
    slots = np.full((2, int((pages[:, 1] * pages[:, 2]).sum())), -1, np.int32)
    slots[0, covered.texels] = np.arange(fronts, dtype=np.int32)
    slots[1, covered.texels[has_back]] = np.arange(fronts, fronts + backs, dtype=np.int32)
    tell(1.0)
    return Atlas(
        corners=corners,
        face_pages=face_pages,
        charts=charts,
        pages=pages,
        slots=slots,
        corner_slots=np.zeros((0, 0, 3), np.int32),
        slot_faces=np.concatenate([covered.faces, covered.faces[has_back]]),
        slot_points=np.concatenate([points, points[has_back]]),
        slot_sides=np.repeat(np.array([0, 1], np.uint8), (fronts, backs)),
    )


def can_be_charted(points: np.ndarray) -> np.ndarray:
    """Return which of the faces [face, 3, 3] have finite corners and an area, bool [face].

    An area counts that is above the rounding of float32 coordinates relative to the face's own longest side.
    """
    sides = points[:, 1:] - points[:, :1]
    normal = np.cross(sides[:, 0], sides[:, 1])
    longest = np.maximum((sides**2).sum(axis=2).max(axis=1), ((sides[:, 1] - sides[:, 0]) ** 2).sum(axis=1))
    return np.isfinite(points).all(axis=(1, 2)) & (np.linalg.norm(normal, axis=1) > 1e-7 * longest)


def check_surfaces(scene: Scene) -> None:
    """Raise SceneError unless a surface of the scene rests and has an area."""
    flat = scene._flat
    rests = scene_parts(scene)[0] >= 0
    if not (can_be_charted(flat.points[flat.indices].astype(np.float64)) & rests).any():
        raise SceneError(NO_SURFACE)


def scene_parts(scene: Scene) -> tuple[np.ndarray, list[tuple[str, Mesh]]]:
    """Return the part of each face, int32 [face], -1 for those that move, and node and mesh of each part.

    Parts are the meshes of nodes, one after another.
    """
    parts = [np.zeros(0, np.int32)]
    meshes: list[tuple[str, Mesh]] = []
    for index, node in enumerate(scene.nodes):
        for mesh in node.meshes:
            parts.append(np.full(len(mesh.indices), -1 if scene.moves(index) else len(meshes), np.int32))
            meshes.append((node.name, mesh))
    return np.concatenate(parts), meshes


def _share_of(progress: Progress | None, begin: float, end: float) -> Progress | None:
    """Return a progress whose 0 and 1 are ``begin`` and ``end`` of the whole."""
    if progress is None:
        return None
    return lambda share: progress(begin + share * (end - begin))
