"""The bake of visibility polygons: contours of vertices, what of them belongs together, and its check."""

from __future__ import annotations

import hashlib
import math
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.baking import Bake
from warp_gi.errors import SceneError
from warp_gi.kernels import types
from warp_gi.kernels import visibility_polygons as kernels
from warp_gi.kernels import visibility_polygons_audit as audit_kernels
from warp_gi.kernels import visibility_polygons_bake as contour_kernels
from warp_gi.kernels import visibility_polygons_match as match_kernels
from warp_gi.launch import get_device, on_device
from warp_gi.scene.scene import Scene
from warp_gi.techniques.visibility_polygons.arrays import TECHNIQUE, check_arrays
from warp_gi.techniques.visibility_polygons.settings import PolygonSettings
from warp_gi.techniques.visibility_polygons.vertices import CornerSets, corner_sets

Progress = Callable[[float], None]
"""Called with the share of the work that is done."""
OFFSET = 1e-4
"""Share of the scene's radius by which rays start above vertices."""
MOST_POINTS, MOST_CONTOURS = 2048, 64
"""Room for the points and contours of a set before they are simplified; above, its triangles are traced."""
BATCH_SETS, BATCH_RECORDS = 1024, 512
"""Sets and records at a time, which bounds the memory of a bake."""
SHARES = (0.6, 0.75, 1.0)
"""Shares of the work that are done after contours, correspondence and the check; for progress alone."""


@dataclass(frozen=True, eq=False)
class Contours:
    """Contours of all sets, as ``kernels.visibility_polygons.PolygonSets`` has them."""

    contour_starts: np.ndarray
    """First contour of each set, and the number of contours, int32 [set + 1]."""
    point_starts: np.ndarray
    """First point of each contour, and the number of points, int32 [contour + 1]."""
    points: np.ndarray
    """Points (d, w): unit directions, and one over the distance of the occluder there in metres, float32 [point, 4]."""
    states: np.ndarray
    """SET_SEES, SET_BLIND or SET_COMPLEX of each set, uint8 [set]."""


def polygon_key(scene: Scene) -> str:
    """Return the hash of what a bake depends on: the geometry and its normals, and never the sky."""
    digest = hashlib.sha256(b"warp_gi polygons 1" + scene.geometry_hash.encode())
    digest.update(scene._flat.normals.tobytes())
    return digest.hexdigest()


def check_rests(scene: Scene) -> None:
    """Raise SceneError where something moves."""
    moving = [scene.nodes[index].name for index in scene.moving_objects.values()]
    if moving:
        raise SceneError(
            f"visibility polygons are of scenes at rest, and {', '.join(map(repr, moving[:5]))} move here: take "
            "VisibilityField, which traces around what moves, or TracedEnvironment"
        )


def bake_polygons(
    scene: Scene, settings: PolygonSettings, device: str, seed: int = 0, progress: Progress | None = None
) -> Bake:
    """Return the polygons of all vertices of a scene, and what of them belongs together over each triangle.

    Counts are sets; sets that see nothing ("blind"), and those with too many contours ("complex"); points; rays of
    contours' maps; sides of triangles ("sides") and those that are traced or flagged; the mean error of those that are
    not; and seconds of contours, correspondence and the check. One seed gives one result, on any number of threads.

    Raises SceneError where something moves, or nothing has an area.
    """
    target = get_device(device)
    with scene.lock:
        scene.check_unchanged()
        check_rests(scene)
        corners = corner_sets(scene._flat)
        if not len(corners.positions):
            raise SceneError("no triangle of this scene has an area, so there is nothing to bake")
        data = launch.copied(scene.data(target), types.SceneData)
        data.bvh = scene.static_bvh(target).data
        counts: dict[str, int | float] = {}
        tell = progress or (lambda share: None)
        clock = _clock(counts)
        offset = OFFSET * scene.radius
        contours = find_contours(data, corners, settings, offset, target, lambda done: tell(SHARES[0] * done))
        clock("contours")
        sets = sets_on(corners.positions, corners.normals, contours, target)
        arrays = match_triangles(
            sets, corners.corner_sets, target, lambda done: tell(SHARES[0] + (SHARES[1] - SHARES[0]) * done)
        )
        clock("correspondence")
        lists = lists_on(arrays, target)
        errors = audit(data, sets, lists, seed, target, lambda done: tell(SHARES[1] + (SHARES[2] - SHARES[1]) * done))
        clock("check")
    states = arrays["states"]
    matched = states == int(kernels.MATCHED)
    states[matched & (errors > settings.flagged_above)] = int(kernels.FLAGGED)
    arrays |= {
        "positions": corners.positions,
        "normals": corners.normals,
        "contour_starts": contours.contour_starts,
        "point_starts": contours.point_starts,
        "points": contours.points,
        "set_states": contours.states,
        "errors": errors.astype(np.float16),
    }
    sides = corners.corner_sets[:, 0] >= 0
    kept = states == int(kernels.MATCHED)
    counts |= {
        "sets": len(corners.positions),
        "blind": int((contours.states == int(contour_kernels.SET_BLIND)).sum()),
        "complex": int((contours.states == int(contour_kernels.SET_COMPLEX)).sum()),
        "points": len(contours.points),
        "rays": len(corners.positions) * settings.resolution**2,
        "sides": int(sides.sum()),
        "traced": int((sides & (states == int(kernels.TRACED))).sum()),
        "flagged": int((states == int(kernels.FLAGGED)).sum()),
        "mean_error": float(errors[kept].mean()) if kept.any() else 0.0,
    }
    _warn_of_little(counts)
    return Bake(TECHNIQUE, polygon_key(scene), settings.stored(), arrays, counts, scene.name)


def _warn_of_little(counts: dict[str, int | float]) -> None:
    """Warn where most vertices have no polygons."""
    sets, blind, entangled = (int(counts[name]) for name in ("sets", "blind", "complex"))
    if 2 * (blind + entangled) <= sets:
        return
    why = f"{blind:,} of {sets:,} vertices see no sky"
    if entangled > blind:
        why = f"{entangled:,} of {sets:,} vertices see it through too many gaps, as among leaves"
    warnings.warn(f"{why}: their pixels are traced; VisibilityField is faster here", stacklevel=3)


def _clock(counts: dict[str, int | float]) -> Callable[[str], None]:
    """Return a function that counts the seconds since its last call, by the clock and of this process's CPU."""
    last = [time.perf_counter(), time.process_time()]

    def note(name: str) -> None:
        now = [time.perf_counter(), time.process_time()]
        counts[f"{name}_seconds"], counts[f"{name}_cpu_seconds"] = now[0] - last[0], now[1] - last[1]
        last[:] = now

    return note


def _starts(counts: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)


def find_contours(
    data: types.SceneData,
    corners: CornerSets,
    settings: PolygonSettings,
    offset: float,
    device: wp.Device,
    progress: Progress = lambda share: None,
) -> Contours:
    """Return the contours of what all sets see, traced in the geometry of ``data``."""
    total, side = len(corners.positions), settings.resolution
    size = min(BATCH_SETS, total)
    batch = contour_kernels.ContourBatch()
    batch.resolution, batch.most_points, batch.most_contours = side, MOST_POINTS, MOST_CONTOURS
    batch.offset, batch.tolerance = offset, math.radians(settings.simplified)
    batch.positions = on_device(corners.positions, wp.vec3, device)
    batch.normals = on_device(corners.normals, wp.vec3, device)
    batch.lengths = on_device(corners.lengths, wp.vec2, device)
    batch.distances = wp.empty(size * side * side, dtype=wp.float32, device=device)
    batch.visited = wp.empty(size * (side + 1) ** 2, dtype=wp.uint8, device=device)
    batch.points = wp.empty(size * MOST_POINTS, dtype=wp.vec4, device=device)
    batch.kept = wp.empty(size * MOST_POINTS, dtype=wp.uint8, device=device)
    batch.ends = wp.zeros(size * MOST_CONTOURS, dtype=wp.int32, device=device)
    batch.counts = wp.empty(size, dtype=wp.vec3i, device=device)
    share = contour_kernels.BAND if device.is_cpu else 1
    directions = wp.empty(side * side, dtype=wp.vec3, device=device)
    launch.launch(contour_kernels.map_directions, side * side, [side, directions], device)
    found: list[tuple[np.ndarray, ...]] = []
    for start in range(0, total, size):
        batch.start, count = start, min(size, total - start)
        launch.launch(contour_kernels.trace_maps, count * -(-side // share), [data, batch, share, directions], device)
        launch.launch(contour_kernels.find_contours, count, [data, batch], device, smallest_slice=8)
        launch.launch(contour_kernels.simplify_contours, count, [batch], device, smallest_slice=8)
        counts = batch.counts.numpy()[:count]
        ends = batch.ends.numpy().reshape(size, MOST_CONTOURS)[:count]
        counts[counts[:, 2] != int(contour_kernels.SET_SEES), :2] = 0
        batch.counts.assign(np.concatenate([counts, np.zeros((size - count, 3), np.int32)]))
        sizes = np.diff(ends, axis=1, prepend=0)[np.arange(MOST_CONTOURS) < counts[:, 1:2]]
        starts = on_device(_starts(counts[:, 0]), wp.int32, device)
        points = wp.empty(int(counts[:, 0].sum()), dtype=wp.vec4, device=device)
        launch.launch(contour_kernels.gather_points, count, [batch, starts, points], device)
        found.append((counts[:, 1].copy(), sizes, points.numpy().copy(), counts[:, 2].copy()))
        progress((start + count) / total)
    contours, sizes, all_points, states = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return Contours(_starts(contours), _starts(sizes), all_points, states.astype(np.uint8))


def sets_on(positions: np.ndarray, normals: np.ndarray, contours: Contours, device: wp.Device) -> kernels.PolygonSets:
    """Return sets as kernels read them."""
    sets = kernels.PolygonSets()
    sets.positions = on_device(positions, wp.vec3, device)
    sets.normals = on_device(normals, wp.vec3, device)
    sets.contour_starts = on_device(contours.contour_starts, wp.int32, device)
    sets.point_starts = on_device(contours.point_starts, wp.int32, device)
    sets.points = on_device(contours.points, wp.vec4, device)
    return sets


def match_triangles(
    sets: kernels.PolygonSets, records: np.ndarray, device: wp.Device, progress: Progress = lambda share: None
) -> dict[str, np.ndarray]:
    """Return which points of the contours of corners belong together, by the names of ``PolygonLists``.

    Args:
        sets: Contours of the vertices.
        records: Sets of corners, int32 [record, 3]; -1 where a record has none.
        device: Where kernels run.
        progress: Called with the share that is done.
    """
    total = len(records)
    size = min(BATCH_RECORDS, total)
    points, lists, most = (int(getattr(match_kernels, name)) for name in ("MOST_POINTS", "MOST_LISTS", "MOST_STEPS"))
    batch = match_kernels.MatchBatch()
    batch.records = on_device(records, wp.vec3i, device)
    batch.seen = wp.empty(size * int(match_kernels.VIEWS) * points, dtype=wp.vec3, device=device)
    batch.mates = wp.empty(size * 3 * points, dtype=wp.int32, device=device)
    batch.anchors = wp.empty(size * points, dtype=wp.vec3i, device=device)
    batch.costs = wp.empty(size * int(match_kernels.MOST_CELLS), dtype=wp.float32, device=device)
    batch.moves = wp.empty(size * int(match_kernels.MOST_CELLS), dtype=wp.uint8, device=device)
    batch.counts = wp.empty(size, dtype=wp.vec3i, device=device)
    batch.contours = wp.zeros(size * lists, dtype=wp.vec3i, device=device)
    batch.starts = wp.zeros(size * lists, dtype=wp.vec3i, device=device)
    batch.ends = wp.zeros(size * lists, dtype=wp.int32, device=device)
    batch.steps = wp.empty(size * most, dtype=wp.uint8, device=device)
    found: list[tuple[np.ndarray, ...]] = []
    for start in range(0, total, size):
        batch.start, count = start, min(size, total - start)
        launch.launch(match_kernels.match_contours, count, [sets, batch], device, smallest_slice=8)
        counts = batch.counts.numpy()[:count].copy()
        used = np.arange(lists) < counts[:, :1]
        sizes = np.diff(batch.ends.numpy().reshape(size, lists)[:count], axis=1, prepend=0)[used]
        corners, starts = (one.numpy().reshape(size, lists, 3)[:count][used] for one in (batch.contours, batch.starts))
        steps = wp.empty(int(counts[:, 1].sum()), dtype=wp.uint8, device=device)
        step_starts = on_device(_starts(counts[:, 1]), wp.int32, device)
        launch.launch(match_kernels.gather_steps, count, [batch, step_starts, steps], device)
        found.append((counts, sizes, corners, starts, steps.numpy().copy()))
        progress((start + count) / total)
    counts, sizes, corners, starts, all_steps = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return {
        "corner_sets": records,
        "states": counts[:, 2].astype(np.uint8),
        "list_starts": _starts(counts[:, 0]),
        "list_contours": corners,
        "list_first": starts,
        "step_starts": _starts(sizes),
        "steps": all_steps,
    }


def lists_on(arrays: dict[str, np.ndarray], device: wp.Device) -> kernels.PolygonLists:
    """Return lists as kernels read them."""
    lists = kernels.PolygonLists()
    lists.corner_sets = on_device(arrays["corner_sets"], wp.vec3i, device)
    lists.states = on_device(arrays["states"].copy(), wp.uint8, device)
    lists.list_starts = on_device(arrays["list_starts"], wp.int32, device)
    lists.contours = on_device(arrays["list_contours"], wp.vec3i, device)
    lists.starts = on_device(arrays["list_first"], wp.vec3i, device)
    lists.step_starts = on_device(arrays["step_starts"], wp.int32, device)
    lists.steps = on_device(arrays["steps"], wp.uint8, device)
    return lists


def audit(
    data: types.SceneData,
    sets: kernels.PolygonSets,
    lists: kernels.PolygonLists,
    seed: int,
    device: wp.Device,
    progress: Progress = lambda share: None,
) -> np.ndarray:
    """Return the largest error at points of each record, float32 [record]; 1 where contours do not match.

    It is the share of all light of a uniform sky that a point wrongly sees or does not see, by rays in strata.
    """
    total, per_point = len(lists.corner_sets), int(audit_kernels.AUDIT_POINTS)
    size = min(BATCH_RECORDS, total)
    batch = audit_kernels.AuditBatch()
    batch.triangles, batch.seed = total // 2, seed & 0xFFFFFFFF
    batch.directions = wp.empty(size * per_point * int(audit_kernels.MOST_EDGES), dtype=wp.vec3, device=device)
    batch.errors = wp.empty(total * per_point, dtype=wp.float32, device=device)
    for start in range(0, total, size):
        batch.start, count = start, min(size, total - start)
        inputs = [data, sets, lists, batch]
        launch.launch(audit_kernels.audit_polygons, count * per_point, inputs, device, smallest_slice=32)
        progress((start + count) / total)
    return batch.errors.numpy().reshape(total, per_point).max(axis=1)


def contours_of(bake: Bake) -> Contours:
    """Return the contours that a bake keeps; raises BakeError for another technique's, and a damaged one."""
    check_arrays(bake)
    arrays = bake.arrays
    return Contours(arrays["contour_starts"], arrays["point_starts"], arrays["points"], arrays["set_states"])
