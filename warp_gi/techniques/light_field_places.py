"""Where light field probes stand: the box that the grid fills, and the way out of walls and into the light."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.alias import AliasTable
from warp_gi.errors import OptionError
from warp_gi.kernels import light_field_place as kernels
from warp_gi.kernels import types
from warp_gi.techniques.baselines import sky_probability

AUTOMATIC_PROBES = 64
"""About as many as there are where neither counts nor spacing are given; the paper's living room has 4 x 4 x 4."""
INSET = 0.3
"""Distance of the outermost probes from the border, in distances between probes: where points by a wall have a probe
near and light is as it is in the room. At 0.5 rooms come out 5 to 10 % too bright; at 0.2 grids lose
light in niches and behind curtains."""
MOST_PROBES = 1 << 20
MOST_TEXELS = (1 << 31) - 1
"""Of all maps together: kernels count them in 32 bits."""
CLEARANCE = 0.1
"""Share of the smallest distance between probes that a moved probe keeps from walls."""
SLABS, LOOKS = 24, 24
"""Points along each axis, and directions from each, that find out where light is."""
FREE_SHARE, LIT_SHARE, SLAB_SHARE = 0.25, 0.05, 0.1
"""A point counts if it sees fewer back faces, and this share of the light of the brighter ones; a slab, with this share
of the points of the best one."""
PLACE_LOOKS = 256
INWARD_STEPS = (0.0, 0.25, 0.5)
"""Distances between probes that one at the border may move inward along an axis."""


@dataclass(frozen=True)
class ProbeGrid:
    """Where probes stand: on a regular grid over the scene."""

    low: np.ndarray
    """float64 [3], metres: probe (0, 0, 0)."""
    spacing: np.ndarray
    """float64 [3], metres."""
    counts: tuple[int, int, int]
    """Probes along x, y, z."""

    @property
    def probe_count(self) -> int:
        """Number of probes."""
        return math.prod(self.counts)

    def positions(self) -> np.ndarray:
        """Return float64 [probe, 3], x fastest, then y."""
        z, y, x = np.meshgrid(*(np.arange(n) for n in self.counts[::-1]), indexing="ij")
        return self.low + np.stack([x, y, z], axis=-1).reshape(-1, 3) * self.spacing


def probe_grid(bounds: np.ndarray, counts: Sequence[int], spacing: float, resolution: int) -> ProbeGrid:
    """Return the grid over ``bounds`` [2, 3] with so many probes along each axis, or so many metres between them.

    Counts of 0 follow from the spacing; without either there are about 64 probes, as evenly spaced as possible.
    Raises OptionError for more probes than can be held.
    """
    low, high = bounds.astype(np.float64)
    extent = np.maximum(high - low, 1e-3 * max(float((high - low).max()), 1e-3))  # a flat scene has a little height
    step = spacing or float(np.prod(extent) / AUTOMATIC_PROBES) ** (1 / 3)
    least = 1 if spacing else 2  # eight probes around every point, unless told otherwise
    found = tuple(int(n) or max(least, round(min(e / step, 1e9))) for n, e in zip(counts, extent, strict=True))
    texels = math.prod(found) * resolution**2
    if math.prod(found) > MOST_PROBES or texels > MOST_TEXELS:
        raise OptionError(
            f"{' x '.join(map(str, found))} probes of {resolution} x {resolution} texels are more than the "
            f"{MOST_PROBES:,} probes or {MOST_TEXELS:,} texels that are supported; use fewer or smaller ones"
        )
    along = np.array(found)
    cells = extent / np.where(along > 1, along - 1 + 2 * INSET, 1.0)
    return ProbeGrid((low + high) / 2 - cells * (along - 1) / 2, cells, found)


def lit_bounds(scene: Any, device: wp.Device) -> np.ndarray:
    """Return the box around the space that light reaches or a camera of the scene sees, float64 [2, 3].

    Bounds of a room reach behind its walls, to lamps above the ceiling and trees before the window, where probes would
    be of no use. Of points in them, on a regular grid, those that see few back faces and a good share of the light
    that points of the same scene see count, and the box is that of the slabs in which there are enough. It is the
    scene's bounds if nothing is lit, or if there are emitters that move.
    """
    bounds = scene.bounds.astype(np.float64)
    if _lights_move(scene):
        return bounds
    at = (np.arange(SLABS) + 0.5) / SLABS
    share = np.stack(np.meshgrid(at, at, at, indexing="ij"), axis=-1).reshape(-1, 3)
    points = bounds[0] + share * (bounds[1] - bounds[0])
    light = _light_at(scene, lit_data(scene, device), points, device)
    typical = _typical(light)
    if typical <= 0:
        return bounds
    useful = _is_lit(light, typical) | _seen_by_cameras(scene, points, device)
    if not useful.any():
        return bounds
    useful = useful.reshape(SLABS, SLABS, SLABS)
    box = bounds.copy()
    for axis in range(3):
        slab = useful.sum(axis=tuple(other for other in range(3) if other != axis))
        used = np.flatnonzero(slab >= max(SLAB_SHARE * slab.max(), 1))
        size = (bounds[1, axis] - bounds[0, axis]) / SLABS
        box[:, axis] = bounds[0, axis] + size * np.array([used[0], used[-1] + 1])
    return box


def _light_at(scene: Any, data: types.SceneData, points: np.ndarray, device: wp.Device) -> np.ndarray:
    """Return the light from each of some directions [point, LOOKS]; -1 for those that meet back faces."""
    array = wp.array(points.astype(np.float32), dtype=wp.vec3, device=device)
    light = wp.empty(len(points) * LOOKS, dtype=wp.float32, device=device)
    inputs = [data, array, LOOKS, sky_probability(scene), light]
    launch.launch(kernels.measure_light, len(light), inputs, device)
    return light.numpy().reshape(-1, LOOKS).astype(np.float64)


def _is_free(light: np.ndarray) -> np.ndarray:
    return (light < 0).mean(axis=1) < FREE_SHARE


def _typical(light: np.ndarray) -> float:
    """Return the mean light of the brighter points."""
    free = np.maximum(light[_is_free(light)], 0).mean(axis=1)
    return float(np.quantile(free, 0.9)) if len(free) else 0.0


def _is_lit(light: np.ndarray, typical: float) -> np.ndarray:
    """Return bool [point]; a single bright direction, which another point may miss, counts no more than others."""
    return _is_free(light) & (np.clip(light, 0, typical).mean(axis=1) > LIT_SHARE * typical)


def _seen_by_cameras(scene: Any, points: np.ndarray, device: wp.Device) -> np.ndarray:
    """Return bool [point]: whether there is nothing between it and one of the scene's cameras."""
    seen = np.zeros(len(points), bool)
    for camera in scene.cameras.values():
        origins = np.broadcast_to(camera.position, points.shape).astype(np.float32)
        ways = points.astype(np.float32) - origins
        seen |= scene.bvh(device).occluded(origins, ways, t_max=1.0).numpy() == 0
    return seen


def relocate(scene: Any, data: types.SceneData, grid: ProbeGrid, field: Any, device: wp.Device) -> None:
    """Move probes of a LightField out of walls and away from them, by up to half the distance to the next probe.

    Those at the border of the grid that no light reaches, in a niche or behind a wall, move inward to where some does,
    if it does so near enough.
    """
    most, clearance = wp.vec3(*(0.5 * grid.spacing)), CLEARANCE * float(grid.spacing.min())
    inputs = [data, field, most, clearance, PLACE_LOOKS]
    launch.launch(kernels.place_probes, grid.probe_count, inputs, device, smallest_slice=1)
    positions = field.positions.numpy().astype(np.float64)
    light = _light_at(scene, data, positions, device)
    typical = _typical(light)
    counts = np.array(grid.counts)
    index = np.stack(np.unravel_index(np.arange(grid.probe_count), counts[::-1])[::-1], axis=1)
    inward = np.where(index == 0, 1, np.where(index == counts - 1, -1, 0)) * (counts > 1)
    dark = np.flatnonzero(~_is_lit(light, typical) & inward.any(axis=1))
    steps = np.stack(np.meshgrid(*[INWARD_STEPS] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    steps = steps[np.argsort(np.linalg.norm(steps, axis=1), kind="stable")]
    if typical <= 0 or not len(dark):
        return
    homes = grid.positions()[dark]
    candidates = homes[:, None] + steps * (inward[dark] * grid.spacing)[:, None]
    lit = _is_lit(_light_at(scene, data, candidates.reshape(-1, 3), device), typical).reshape(len(dark), -1)
    moved = lit.any(axis=1)
    positions[dark[moved]] = candidates[moved, lit[moved].argmax(axis=1)]
    field.positions = wp.array(positions.astype(np.float32), dtype=wp.vec3, device=device)


def _lights_move(scene: Any) -> bool:
    """Return whether an emitter moves."""
    emits = [any(max(mesh.material.emission) > 0 for mesh in node.meshes) for node in scene.nodes]
    carried = {light.node for light in scene.lights}
    return any(scene.moves(index) and (emits[index] or index in carried) for index in range(len(scene.nodes)))


def lit_data(scene: Any, device: wp.Device) -> types.SceneData:
    """Return the scene's buffers with emitters picked by power, whatever the pipeline's estimator of them does."""
    data = launch.copied(scene.data(device), types.SceneData)
    data.emitters = launch.copied(data.emitters, types.Emitters)
    if scene.emitter_count:
        data.emitters.alias = AliasTable.build(scene.emitter_powers()).on(device)
    return data
