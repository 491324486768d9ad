"""Where light field probes stand: the box that the grid fills, and the way out of walls and into the light.

The box is that of what paths from the camera reach, over the whole of its path: all that a picture shows, and what
lights that over one more surface. Bounds of a scene reach behind its walls, to lamps above the ceiling and to the end
of its ground; and what is brightly lit may be nowhere near the camera.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.errors import OptionError
from warp_gi.kernels import light_field_place as kernels
from warp_gi.kernels import types
from warp_gi.kernels.light_field import LightField
from warp_gi.paths import sky_probability
from warp_gi.scene.camera import Camera, CameraPath
from warp_gi.scene.pinhole import camera_data
from warp_gi.scene.scene import Scene
from warp_gi.techniques.light_field.settings import FEW_PROBES, MOST_PROBES, ProbeSettings
from warp_gi.techniques.shared.lamps import lamps_move, lit_data
from warp_gi.techniques.shared.views import cameras_of

AUTOMATIC_PROBES = 440
"""Largest number of probes where neither counts nor spacing are given."""
ROOM_PROBES, UNSEEN_PROBES = 100, FEW_PROBES
"""Largest number of probes, without counts and spacing, in rooms, where more probes make the picture darker
(`bench/NOTES.md`), and where no camera says what is seen."""
ROOM_SHARE = 0.06
"""Share of path edges out of the scene below which a camera counts as in a room, among the edges that leave what it
sees and what is lit from there."""
AUTOMATIC_STEPS = 12
"""Distances between probes along the longest side of the box, if that does not make too many of them."""
REACH_PATHS, LEAST_REACHED = 40_000, 400
"""Paths that find what a camera reaches, and number of points that they must find: with fewer, nearly all paths left
the scene, and the result is not used."""
REACH_QUANTILE, REACH_MORE = 0.005, 0.1
"""Share of the points that may lie outside of the box on each side, as windows may show what is far away; and how much
wider first hits among those points make the box, as a share of its size."""
INSET = 0.3
"""Distance of the outermost probes from the border of the box, in distances between probes. It leaves points by a wall
a probe nearby that has the light of the room. At 0.5 rooms come out 5 to 10 % too bright; at 0.2 light is lost in
niches and behind curtains."""
MOST_TEXELS = (1 << 31) - 1
"""Largest number of texels of all maps together, which kernels count in 32 bits."""
CLEARANCE = 0.1
"""Distance that a moved probe keeps from walls, as a share of the smallest distance between probes."""
SLABS, LOOKS = 24, 24
"""Points along each axis, and directions from each point, that are tried to find out where light is."""
FREE_SHARE, LIT_SHARE, SLAB_SHARE = 0.25, 0.05, 0.1
"""Limits by which the lit space is found: largest share of a point's directions that meet back faces; least light of a
point, as a share of that of brighter points; least number of such points in a slab, as a share of the best slab's."""
PLACE_LOOKS = 256
"""Directions in which a probe looks for walls before it moves."""
INWARD_STEPS = (0.0, 0.25, 0.5)
"""Distances between probes that one at the border may move inward along an axis."""


@dataclass(frozen=True)
class ProbeGrid:
    """Where probes stand: on a regular grid over the scene."""

    low: np.ndarray
    """float64 [3], metres: position of probe (0, 0, 0)."""
    spacing: np.ndarray
    """float64 [3], metres: distance between probes along x, y, z."""
    counts: tuple[int, int, int]
    """Probes along x, y, z."""

    @property
    def probe_count(self) -> int:
        """Number of probes."""
        return math.prod(self.counts)

    def positions(self) -> np.ndarray:
        """Return the positions of all probes, float64 [probe, 3], metres; x changes fastest, then y."""
        z, y, x = np.meshgrid(*(np.arange(n) for n in self.counts[::-1]), indexing="ij")
        return self.low + np.stack([x, y, z], axis=-1).reshape(-1, 3) * self.spacing


def probe_grid(
    bounds: np.ndarray, counts: Sequence[int], spacing: float, resolution: int, most: int = AUTOMATIC_PROBES
) -> ProbeGrid:
    """Return the grid over ``bounds`` [2, 3] with so many probes along each axis, or so many metres between them.

    Counts of 0 follow from the spacing; without one that is a twelfth of the longest side, or as much more as it takes
    for no more than ``most`` probes. Raises OptionError for more probes than can be held.
    """
    low, high = bounds.astype(np.float64)
    extent = np.maximum(high - low, 1e-3 * max(float((high - low).max()), 1e-3))  # a flat scene has a little height
    least = 1 if spacing else 2  # eight probes around every point, unless told otherwise
    step = spacing or float(extent.max()) / AUTOMATIC_STEPS

    def along(step: float) -> tuple[int, int, int]:
        rounded = round if spacing else math.ceil
        steps = np.minimum(extent / step, 1e9)
        x, y, z = (int(n) or max(least, rounded(e)) for n, e in zip(counts, steps, strict=True))
        return x, y, z

    if not spacing and not all(counts):
        while math.prod(along(step)) > most and step < extent.max():
            step *= 1.01
    found = along(step)
    texels = math.prod(found) * resolution**2
    if math.prod(found) > MOST_PROBES or texels > MOST_TEXELS:
        raise OptionError(
            f"{' x '.join(map(str, found))} probes of {resolution} x {resolution} texels are more than the "
            f"{MOST_PROBES:,} probes or {MOST_TEXELS:,} texels that are supported; use fewer or smaller ones"
        )
    numbers = np.array(found)
    cells = extent / np.where(numbers > 1, numbers - 1 + 2 * INSET, 1.0)
    return ProbeGrid((low + high) / 2 - cells * (numbers - 1) / 2, cells, found)


def place_grid(
    scene: Scene, settings: ProbeSettings, camera: Camera | CameraPath | None, device: wp.Device
) -> ProbeGrid:
    """Return the grid over what a camera reaches; the scene's own cameras stand for one that is None.

    Without any camera that sees something, the grid lies over the space that light reaches (``lit_bounds``), and has
    fewer probes. Raises OptionError for more probes than can be held.
    """
    seen = seen_space(scene, cameras_of(camera) or list(scene.cameras.values()), device)
    if seen is None:
        box, most = lit_bounds(scene, device), UNSEEN_PROBES
    else:
        box, most = seen.bounds, ROOM_PROBES if seen.leaving < ROOM_SHARE else AUTOMATIC_PROBES
    return probe_grid(box, settings.counts, settings.spacing, settings.largest_map, most)


class Space(NamedTuple):
    """What paths from a camera reach."""

    bounds: np.ndarray
    """Box around the points that paths meet: float64 [2, 3], metres."""
    leaving: float
    """Share of the edges that lead out of the scene, among those from points that the paths met."""


def seen_space(scene: Scene, cameras: Sequence[Camera], device: wp.Device) -> Space | None:
    """Return the box around what paths from cameras meet; None if that is nothing.

    Points count by one over their distance from the camera: a surface twice as far shows half the detail, and a plane
    to the horizon, which fills a tenth of a picture, does not stretch the box to a hundred times what stands on it.
    """
    along, points, weights, first = int(kernels.REACH_VERTICES), [], [], []
    ways = left = 0
    for number, camera in enumerate(cameras):
        size = REACH_PATHS // len(cameras)
        at = wp.zeros(size * along, dtype=wp.vec3, device=device)
        found = wp.zeros(size * along, dtype=wp.uint8, device=device)
        inputs = [scene.data(device), camera_data(camera), number + 1, at, found]
        launch.launch(kernels.follow_paths, size, inputs, device)
        met = found.numpy().astype(bool)
        here, then = met.reshape(size, along)[:, :-1], met.reshape(size, along)[:, 1:]
        ways, left = ways + int(here.sum()), left + int((here & ~then).sum())
        points.append(at.numpy().astype(np.float64)[met])
        weights.append(1 / np.maximum(np.linalg.norm(points[-1] - camera.position, axis=1), 1e-3 * scene.radius))
        first.append((np.arange(len(met)) % along == 0)[met])
    if sum(map(len, points)) < LEAST_REACHED:
        return None
    places, weight, is_first = np.concatenate(points), np.concatenate(weights), np.concatenate(first)
    box = np.stack([_quantiles(places[:, axis], weight) for axis in range(3)], axis=1)
    more = REACH_MORE * (box[1] - box[0])
    seen = places[is_first]
    low, high = np.maximum(seen.min(axis=0), box[0] - more), np.minimum(seen.max(axis=0), box[1] + more)
    return Space(np.stack([np.minimum(box[0], low), np.maximum(box[1], high)]), left / max(ways, 1))


def _quantiles(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return two values, float64 [2]: below the first and above the second lies ``REACH_QUANTILE`` of the weight."""
    order = np.argsort(values, kind="stable")
    share = np.cumsum(weights[order])
    return np.interp([REACH_QUANTILE * share[-1], (1 - REACH_QUANTILE) * share[-1]], share, values[order])


def lit_bounds(scene: Scene, device: wp.Device) -> np.ndarray:
    """Return the box around the space that light reaches, float64 [2, 3], for scenes that no camera looks at.

    Bounds of a room reach behind its walls, to lamps above the ceiling and trees before the window, where probes would
    be of no use. Points on a regular grid in the bounds count as lit if they see few back faces, and a good share of
    the light that the scene's brighter points see; the box is that of the slabs in which enough points are lit. It is
    the scene's bounds if nothing is lit, or if emitters move.
    """
    bounds = scene.bounds.astype(np.float64)
    if lamps_move(scene):
        return bounds
    at = (np.arange(SLABS) + 0.5) / SLABS
    share = np.stack(np.meshgrid(at, at, at, indexing="ij"), axis=-1).reshape(-1, 3)
    points = bounds[0] + share * (bounds[1] - bounds[0])
    light = _light_at(scene, lit_data(scene, device), points, device)
    typical = _typical(light)
    if typical <= 0:
        return bounds
    useful = _is_lit(light, typical)
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


def _light_at(scene: Scene, data: types.SceneData, points: np.ndarray, device: wp.Device) -> np.ndarray:
    """Return the light from each of some directions, float64 [point, LOOKS]; -1 for those that meet back faces."""
    array: wp.array = wp.array(points.astype(np.float32), dtype=wp.vec3, device=device)
    light = wp.empty(len(points) * LOOKS, dtype=wp.float32, device=device)
    inputs = [data, array, LOOKS, sky_probability(scene), light]
    launch.launch(kernels.measure_light, len(light), inputs, device)
    return light.numpy().reshape(-1, LOOKS).astype(np.float64)


def _is_free(light: np.ndarray) -> np.ndarray:
    """Return whether points see few back faces, bool [point]."""
    return (light < 0).mean(axis=1) < FREE_SHARE


def _typical(light: np.ndarray) -> float:
    """Return the mean light of the brighter points."""
    free = np.maximum(light[_is_free(light)], 0).mean(axis=1)
    return float(np.quantile(free, 0.9)) if len(free) else 0.0


def _is_lit(light: np.ndarray, typical: float) -> np.ndarray:
    """Return whether points are lit, bool [point]; a single bright direction counts no more than others."""
    return _is_free(light) & (np.clip(light, 0, typical).mean(axis=1) > LIT_SHARE * typical)


def relocate(scene: Scene, data: types.SceneData, grid: ProbeGrid, field: LightField, device: wp.Device) -> None:
    """Move probes of a field out of walls and away from them, by up to half the distance to the next probe.

    Probes at the border of the grid that no light reaches, in a niche or behind a wall, move inward to a place that is
    lit, if there is one near enough. ``field`` gets new positions.
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
