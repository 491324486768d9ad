"""The state of a surface cache: the cells that paths read, and in scenes that move the sums that they are made of."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_gi import launch
from warp_gi.color import LUMINANCE
from warp_gi.frame import Frame
from warp_gi.kernels.surface_cache import SurfaceCells
from warp_gi.layout import Layout, misfit
from warp_gi.scene.baked import BakedScene, whole_scene
from warp_gi.techniques.surface_cache.cells import NOTHING, Sums, coarser
from warp_gi.techniques.surface_cache.fill import (
    FillSettings,
    add_pass,
    empty_grid,
    fill,
    fill_lights,
    holds,
    object_grids,
    table_of,
)

if TYPE_CHECKING:
    from warp_gi.scene.scene import Scene

LEAST_LEFT = 0.1
"""Share of the samples' weight below which what is left of earlier frames is dropped, and all cells are filled anew."""
LEAST_WEIGHT = 0.3
"""Weight of a cell's samples, in samples, below which it is forgotten."""
LEAST_ERRORS = 3.0
"""Standard errors of the difference that a change of the light makes, at least."""
LEAST_CHANGE = {2: 0.15, 3: 0.3, 4: 0.5}
"""The least share of the light that a change is, by levels above the smallest cells at which it is looked for. Single
cells have too few samples; for all of a large one to be forgotten, most of its light must be another."""
MORE_PASSES, MUCH_CHANGED = 2, 0.25
"""Where such a share of the samples' weight is of light that has changed, so many more passes replace the first: its
paths ended in the light before."""


@dataclass(frozen=True, eq=False)
class CacheState:
    """Cells of one moment. No call changes a state; each returns a new one."""

    cells: SurfaceCells = field(metadata={"derived": True})
    """Cells as kernels read them."""
    follows: bool = field(default=False, metadata={"derived": True})
    """Whether the scene or its sky moves, so that cells follow from frame to frame."""
    geometry: str = field(default="", metadata={"derived": True})
    """``Scene.geometry_hash`` of what the cells lie on."""
    keys: np.ndarray = field(default_factory=lambda: NOTHING.keys)
    """Keys of the smallest cells, uint64 [cell]; none in a scene at rest, whose cells never change."""
    light: np.ndarray = field(default_factory=lambda: NOTHING.light)
    """Weighted sums of their samples, float64 [cell, 7], in the columns of ``Sums``."""
    weights: np.ndarray = field(default_factory=lambda: NOTHING.counts.astype(np.float64))
    """Sums of the samples' weights, float64 [cell]."""
    frame: np.ndarray = field(default_factory=lambda: np.array([-1]))
    """Number of the frame that the cells are of, int64 [1]; -1 before the first one."""
    tabled: np.ndarray | None = field(default=None, metadata={"derived": True})
    """The array ``keys`` that the table of ``cells`` is of: another one in a state that was loaded from a file."""

    def fault(self, before: CacheState, states: Mapping[str, Any]) -> str:
        """Return why a state that was read from a file cannot be; "" if it can."""
        count, most = len(self.keys), 1e37
        layouts = {
            "keys": Layout("uint64", (count,), 1),
            "light": Layout("float64", (count, 7), -most, most),
            "weights": Layout("float64", (count,), 1e-30, most),
            "frame": Layout("int64", (1,), -1, 1 << 31),
        }
        arrays = {name: getattr(self, name) for name in layouts}
        problem = misfit(arrays, layouts)
        return problem or ("its keys are not in order" if (self.keys[1:] <= self.keys[:-1]).any() else "")


@dataclass(frozen=True)
class Refresh:
    """How cells follow what moves; the fields of a SurfaceCache of these names."""

    refresh: int
    """Number of paths of a frame."""
    memory: float
    """Weight of a sample one frame later."""


def is_moving(scene: Scene | BakedScene) -> str:
    """Return what moves in a scene, for messages: \"'crate' moves\", "the sky changes over time", or ""."""
    moving = [] if isinstance(scene, BakedScene) else [n.name for k, n in enumerate(scene.nodes) if scene.moves(k)]
    if moving:
        return f"{moving[0]!r} moves"
    return "the sky changes over time" if scene.is_sky_animated else ""


def followed(frame: Frame, state: CacheState, settings: FillSettings, refresh: Refresh) -> CacheState:
    """Return the cells of a frame: what earlier frames left, of less weight, and samples of this one.

    After a gap of many frames, and in the first one, all cells are filled anew, by all paths. So they are in the first
    frame after an edit of a scene at rest moved something, and when something is moved past the grid.
    """
    scene, device = whole_scene(frame.scene), frame.device
    grid = launch.copied(state.cells, SurfaceCells)
    grid.objects = object_grids(scene, frame.time, device)
    last = int(state.frame[0])
    is_edited = scene.geometry_hash != state.geometry
    if frame.index == last and not is_edited:
        return state
    if is_edited and not holds(grid, scene):
        grid, last = empty_grid(scene, settings, grid.boxes.numpy(), device), -1
        grid.traced_below, grid.residual = state.cells.traced_below, state.cells.residual
        grid.objects = object_grids(scene, frame.time, device)
    left = refresh.memory ** abs(frame.index - last) if last >= 0 and frame.index != last else 0.0
    if left < LEAST_LEFT:
        sums, _ = fill(scene, settings, grid, [frame.camera], device, frame.seed)
    else:
        known = Sums(state.keys, state.light, state.weights)
        if state.tabled is state.keys:
            cells = launch.copied(state.cells, SurfaceCells)
            cells.objects = grid.objects
        else:
            cells = table_of(grid, known, settings.capacity, device)
        known = Sums(state.keys, left * state.light, left * state.weights).above(LEAST_WEIGHT)
        lights = fill_lights(scene, device)
        new = add_pass(scene, settings, cells, [frame.camera], 0, refresh.refresh, frame.seed, device, lights)
        valid = still_valid(known, new)
        sums = valid + new
        if valid.counts.sum() < (1.0 - MUCH_CHANGED) * known.counts.sum():
            for number in range(1, 1 + MORE_PASSES):
                cells, done = table_of(grid, sums, settings.capacity, device), number * refresh.refresh
                sums = valid + add_pass(
                    scene, settings, cells, [frame.camera], done, refresh.refresh, frame.seed, device, lights
                )
    cells = table_of(grid, sums, settings.capacity, device, tells=last < 0)
    weights, index = 1.0 * sums.counts, np.array([frame.index])
    return CacheState(cells, True, scene.geometry_hash, sums.keys, sums.light, weights, index, sums.keys)


def still_valid(old: Sums, new: Sums) -> Sums:
    """Return what was known before a frame, but for where the frame's samples say that the light is another.

    In every large cell each sample is compared with the mean of its own small cell, as the camera may look at other
    parts of it now. The sum of n differences d has n times the variance of d, by the samples themselves, or by the old
    ones if those varied more: samples that all miss a rare light seem sure of its absence. The error of the old means
    comes on top.
    """
    _, at, by = np.intersect1d(new.keys, old.keys, assume_unique=True, return_indices=True)
    if not len(at):
        return old
    count, weight = new.counts[at].astype(np.float64), old.counts[by]
    sums, mean = new.light[at, :3] @ LUMINANCE, old.light[by, :3] @ LUMINANCE / weight
    spread = np.maximum(old.light[by, 6] / weight - mean**2, 0.0) / weight
    difference = sums - count * mean
    variance = np.maximum(new.light[at, 6] - 2 * mean * sums + count * mean**2, count * weight * spread)
    variance = variance + count**2 * spread
    light = np.maximum(sums, count * mean)
    is_valid, around, every = np.ones(len(old.keys), bool), new.keys[at], old.keys
    for level in range(1, max(LEAST_CHANGE) + 1):
        around, every = coarser(around), coarser(every)
        if level in LEAST_CHANGE:
            names, group = np.unique(around, return_inverse=True)
            d, v, most = (np.bincount(group, values) for values in (difference, variance, light))
            is_changed = (np.abs(d) > LEAST_ERRORS * np.sqrt(v)) & (np.abs(d) > LEAST_CHANGE[level] * most)
            is_valid &= ~np.isin(every, names[is_changed])
    return Sums(old.keys[is_valid], old.light[is_valid], old.counts[is_valid])
