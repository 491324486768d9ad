"""The state of a visibility field while it renders: masks of cells, what moves, and what is baked on the way.

Two layers. The lasting one is baked without the objects that can move. It stays right wherever they are: what it calls
occluded is, and what it calls visible is unless the ray meets one of their boxes, and then the ray is traced. Their own
surfaces are not in it, so their pixels trace. Once everything has come to rest, cells in view are baked again with all
that is there; this second layer is dropped at the next motion.

A frame works on a shallow copy: every method puts new arrays in the place of those that it changes.
"""

from __future__ import annotations

import copy
import hashlib
import time
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.baking import Bake
from warp_gi.errors import BakeError
from warp_gi.kernels import gbuffer
from warp_gi.kernels import visibility_field as field_kernels
from warp_gi.kernels import visibility_field_bake as bake_kernels
from warp_gi.scene.camera import Camera, CameraPath
from warp_gi.scene.pinhole import camera_data
from warp_gi.scene.scene import Scene
from warp_gi.techniques.visibility_field.bake import FieldBaker, Grid, grid_of, grid_struct, words_of

RAYS_A_MILLISECOND = 20_000
"""What a budget of milliseconds is reckoned with on every machine, so that pictures do not depend on its speed."""


class FieldState:
    """Masks of a field on a device, growing as cells come into view.

    Args:
        scene: What is rendered.
        device: Where.
        settings: The VisibilityField.
        seed: Of all baking.
    """

    def __init__(self, scene: Scene, device: wp.Device, settings: Any, seed: int) -> None:
        self.scene, self.device, self.settings, self.seed = scene, device, settings, seed
        self.grid: Grid = grid_of(scene.bounds, settings.cell_size)
        self.words = words_of(settings.resolution)
        self.slots = np.full(self.grid.cell_count, field_kernels.NO_SLOT, np.int32)
        self.masks = np.empty((0, self.words), np.uint32)
        self.cells = np.empty(0, np.int32)
        """int32 [slot]: the cell of each slot of the lasting layer, in the order they were baked."""
        self.seconds = 0.0
        self.counts: dict[str, int] = {"samples": 0, "rays": 0, "rays_traced": 0}
        self.movers = scene.moving_objects
        self.poses: list[np.ndarray] | None = None
        self.rests = False
        """Whether nothing moved between the last two frames."""
        self.rest: dict[int, tuple[np.ndarray, int] | None] = {}
        """Cells of the layer that is baked with everything at rest: masks and flags, None without any surface."""
        self.empty = np.zeros(self.grid.cell_count, bool)
        """[cell] True where no surface was found, and nothing is left to bake."""
        self.data: Any = None
        self.query: Any = None
        self.sky: Any = None
        self.transfer: Any = None
        """float32 [27 * pixel] what each harmonic adds, of the frame that ``transfer_key`` is of; None if not kept."""
        self.transfer_key: tuple[Any, ...] | None = None
        self.relights = False
        """Whether the frame has its light from ``transfer``, which is known then; else it fills that."""
        self._start_count, self._start_empty = 0, self.empty
        self._bakers: dict[str, FieldBaker] = {}
        self._dirty = True

    @property
    def flags(self) -> np.ndarray:
        """int32 [slot]: the occlusion label of each slot of the lasting layer, as SLOT_LABEL or 0."""
        return self.slots[self.cells] & field_kernels.SLOT_LABEL

    # ---- to and from a bake ----

    @classmethod
    def from_bake(cls, scene: Scene, device: wp.Device, settings: Any, seed: int, bake: Bake) -> FieldState:
        """Return the state that a bake holds. Raises BakeError if it is not whole."""
        state = cls(scene, device, settings, seed)
        try:
            cells, flags = bake.arrays["cells"].astype(np.int32), bake.arrays["flags"].astype(np.int32)
            masks, empty = bake.arrays["masks"], bake.arrays["empty_cells"]
        except KeyError as missing:
            raise BakeError(f"this bake of a visibility field has no array {missing}; bake it again") from None
        named = np.concatenate([cells, empty])
        in_grid = ((named >= 0) & (named < state.grid.cell_count)).all() and len(np.unique(cells)) == len(cells)
        if masks.shape != (len(cells), state.words) or flags.shape != cells.shape or not in_grid:
            raise BakeError(
                f"this bake of a visibility field holds masks {masks.shape} for {len(cells)} cells of a grid of "
                f"{state.grid.cell_count}, expected {state.words} words each; bake it again"
            )
        state._add(cells, masks.astype(np.uint32), flags)
        state.empty[empty] = True
        state._start_count, state._start_empty = len(cells), state.empty
        state.counts |= {name: int(bake.counts.get(name, 0)) for name in state.counts}
        state.seconds = float(bake.counts.get("seconds", 0.0))
        return state

    def to_bake(self) -> Bake:
        """Return the lasting layer as a bake, the cells that frames added among it."""
        low, shape = self.grid.low, np.array(self.grid.shape, np.int32)
        counts = {**self.counts, "cells": len(self.cells), "seconds": round(self.seconds, 3)}
        arrays = {"cells": self.cells, "flags": self.flags, "masks": self.masks, "grid_low": low, "grid_shape": shape}
        arrays["empty_cells"] = np.flatnonzero(self.empty).astype(np.int32)
        arrays["grid_cell_size"] = np.array([self.grid.cell_size])
        settings = self.settings.bake_settings(self.scene)
        key = self.settings.bake_key(self.scene)
        return Bake(type(self.settings).__name__, key, settings, arrays, counts, self.scene.name)

    # ---- to and from what frames leave behind ----

    def saved_arrays(self) -> dict[str, np.ndarray]:
        """Return what frames added to the state before the first one: cells of both layers, and poses."""
        added, first = slice(self._start_count, None), np.zeros((0, self.words), np.uint32)
        rest = {cell: entry for cell, entry in self.rest.items() if entry is not None}
        return {
            "start": np.frombuffer(self._start_digest().digest(), np.uint8),
            "cells": self.cells[added],
            "flags": self.flags[added],
            "masks": self.masks[added],
            "empty_cells": np.flatnonzero(self.empty & ~self._start_empty).astype(np.int32),
            "rest_cells": np.array(list(rest), np.int32),
            "rest_flags": np.array([flags for _, flags in rest.values()], np.int32),
            "rest_masks": np.stack([masks for masks, _ in rest.values()]) if rest else first,
            "rest_empty_cells": np.array([cell for cell, entry in self.rest.items() if entry is None], np.int32),
            "poses": np.array(self.poses or np.zeros((0, 4, 4)), np.float64),
        }

    def with_saved_arrays(self, arrays: Mapping[str, np.ndarray]) -> FieldState:
        """Return the state before the first frame with what ``saved_arrays`` holds.

        Raises KeyError where one is missing, ValueError if they are of a field that began with other cells.
        """
        if arrays["start"].tobytes() != self._start_digest().digest():
            raise ValueError("the field began with other cells")
        state, count = copy.copy(self), self._start_count
        state.slots = self.slots.copy()
        state.slots[self.cells[count:]] = field_kernels.NO_SLOT
        state.cells, state.masks = self.cells[:count], self.masks[:count]
        state._add(arrays["cells"], arrays["masks"], arrays["flags"])
        state.empty = self._start_empty.copy()
        state.empty[arrays["empty_cells"]] = True
        state.rest = dict.fromkeys(arrays["rest_empty_cells"].tolist())
        rest = zip(arrays["rest_masks"], arrays["rest_flags"].tolist(), strict=True)
        state.rest |= dict(zip(arrays["rest_cells"].tolist(), rest, strict=True))
        state.poses = list(arrays["poses"]) or None
        state.transfer, state.transfer_key = None, None
        return state

    def _start_digest(self) -> Any:
        start = np.concatenate([self.cells[: self._start_count], np.flatnonzero(self._start_empty)])
        return hashlib.sha256(start.astype(np.int64).tobytes())

    # ---- baking ----

    def baker(self, layer: str) -> FieldBaker:
        """Return what bakes the "lasting" layer, or the one where everything is "at rest"."""
        if layer not in self._bakers:
            data = self.scene.data(self.device)
            if layer == "lasting":
                bvh = self.scene.resting_bvh(self.device).data
                left_out = np.zeros(len(self.scene.object_names), np.int32)
                left_out[list(self.movers)] = 1
            else:
                bvh, left_out = data.bvh, None
            place = (self.scene.radius, self.grid, self.settings, self.device, self.seed)
            self._bakers[layer] = FieldBaker(data.geometry, bvh, *place, left_out, self.scene.surface_area)
        return self._bakers[layer]

    def bake(self, cells: np.ndarray | None = None, progress: Any = None, most_rays: float = np.inf) -> None:
        """Add ``cells`` (all if None) to the lasting layer; of those, the first that ``most_rays`` pays for."""
        started, baker = time.perf_counter(), self.baker("lasting")
        if cells is not None:
            cells = cells[(self.slots[cells] < 0) & ~self.empty[cells]]
            if len(cells) == 0:
                return
            cells = self._affordable(baker, cells, most_rays)
        pieces = baker.find(cells)
        before = baker.counts
        masks, flags = baker.bake(pieces, progress)
        self.counts = {name: count + baker.counts[name] - before[name] for name, count in self.counts.items()}
        nothing = np.ones(self.grid.cell_count, bool) if cells is None else np.zeros(self.grid.cell_count, bool)
        if cells is not None:
            nothing[cells] = True
        nothing[pieces.cells] = False
        self.empty = self.empty | nothing
        self._add(pieces.cells, masks, flags)
        self.seconds += time.perf_counter() - started

    def _affordable(self, baker: FieldBaker, cells: np.ndarray, most_rays: float) -> np.ndarray:
        if not np.isfinite(most_rays):
            return np.sort(cells)
        a_cell = 2 * baker.density * self.grid.cell_size**2 * baker.rays / 4  # about what is traced of a flat wall's
        return np.sort(cells[: max(int(most_rays / a_cell), 1)])

    def _add(self, cells: np.ndarray, masks: np.ndarray, flags: np.ndarray) -> None:
        boxed = field_kernels.SLOT_BOXED if self.movers else 0
        self.slots = self.slots.copy()
        self.slots[cells] = np.arange(len(self.cells), len(self.cells) + len(cells), dtype=np.int32) | flags | boxed
        self.cells = np.concatenate([self.cells, cells.astype(np.int32)])
        self.masks = np.concatenate([self.masks, masks])
        self._dirty = True

    def bake_rest(self, cells: np.ndarray, most_rays: float) -> None:
        """Bake ``cells`` with everything where it is now, the first that ``most_rays`` pays for."""
        cells = np.array([cell for cell in cells.tolist() if cell not in self.rest], np.int32)
        if len(cells) == 0:
            return
        baker = self.baker("at rest")
        cells = self._affordable(baker, cells, most_rays)
        pieces = baker.find(cells)
        masks, flags = baker.bake(pieces)
        found = {int(cell): (masks[i], int(flags[i])) for i, cell in enumerate(pieces.cells)}
        self.rest = self.rest | dict.fromkeys(cells.tolist(), None) | found
        self._dirty = True

    # ---- a frame ----

    def move(self, now: float) -> None:
        """Take note of where everything is at ``now`` [s]; what was baked at rest is dropped if anything moved."""
        poses = [self.scene.world_from_node(node, now) for node in self.movers.values()]
        moved = self.poses is None or any(not np.array_equal(a, b) for a, b in zip(poses, self.poses, strict=True))
        if moved and self.movers:
            self.rest = {}
            self._dirty = True
        self.rests = not moved
        self.poses = poses
        if self.query is not None and self.movers:
            boxes = [self.scene.node_box(node, now) for node in self.movers.values()]
            margin = 1e-4 * self.scene.radius
            corners = np.concatenate([np.stack([low - margin, high + margin]) for low, high in boxes])
            self.query.boxes = wp.array(corners.astype(np.float32), dtype=wp.vec3, device=self.device)
            moving = np.zeros(len(self.scene.object_names), np.int32)
            moving[list(self.movers)] = 1
            self.query.moving = wp.array(moving, dtype=wp.int32, device=self.device)

    def upload(self) -> None:
        """Bring ``data``, the grid as kernels read it, up to date."""
        if not self._dirty:
            return
        slots, masks = self.slots, self.masks
        rest = {cell: entry for cell, entry in self.rest.items() if entry is not None}
        if rest:
            slots = slots.copy()
            cells = np.fromiter(rest, np.int32, len(rest))
            flags = np.array([flag for _, flag in rest.values()], np.int32)
            slots[cells] = np.arange(len(masks), len(masks) + len(rest), dtype=np.int32) | flags
            masks = np.concatenate([masks, np.stack([mask for mask, _ in rest.values()])])
        slots_array = wp.array(slots, dtype=wp.int32, device=self.device)
        masks_array = wp.array(masks.reshape(-1), dtype=wp.uint32, device=self.device)
        self.data = grid_struct(self.grid, self.settings.resolution, slots_array, masks_array)
        self._dirty = False

    def lacks(self, views: Iterable[tuple[int, Camera]]) -> bool:
        """Return whether one of these frames, by number and camera, sees cells that are still to be baked."""
        for view, corners in distinct_views(views):
            cells = self.cells_in_view(view, sorted(corners))
            if ((self.slots[cells] < 0) & ~self.empty[cells]).any():
                return True
        return False

    def cells_in_view(self, camera: Camera, corners: Sequence[int] = range(4)) -> np.ndarray:
        """Return the cells that a camera sees, int32, those seen most first.

        It looks through those pixels of each block of 2 x 2 that ``corners`` name, 0 to 3.
        """
        width, height = (-(-size // 2) for size in camera.resolution)
        tiles = -(-width // gbuffer.TILE) * -(-height // gbuffer.TILE) * gbuffer.TILE**2
        place = grid_struct(self.grid, self.settings.resolution, None, None)
        views = []
        for corner in corners:
            seen = wp.empty(width * height, dtype=wp.int32, device=self.device)
            inputs = [self.scene.data(self.device), camera_data(camera), corner, place, seen]
            launch.launch(bake_kernels.find_cells, tiles, inputs, self.device)
            views.append(seen.numpy())
        cells, counts = np.unique(np.concatenate(views), return_counts=True)
        order = np.lexsort((cells, -counts))
        return cells[order][cells[order] >= 0]


def corners_of(frame: int) -> tuple[int]:
    """Return the pixel of each block that is looked through at a frame: all four take turns along a path."""
    return (frame % 4,)


def cells_on_path(state: FieldState, camera: Camera | CameraPath) -> np.ndarray:
    """Return all cells that a camera, or a path in any of its frames, sees; with animation, of a scene at time 0."""
    if isinstance(camera, Camera):
        return np.sort(state.cells_in_view(camera))
    views = distinct_views((index, camera.camera(index)) for index in range(camera.frame_count))
    whole = len(views) <= 4
    found = [state.cells_in_view(view, range(4) if whole else sorted(corners)) for view, corners in views]
    return np.unique(np.concatenate(found))


def distinct_views(frames: Iterable[tuple[int, Camera]]) -> list[tuple[Camera, set[int]]]:
    """Return the cameras of frames, equal ones once, with the corners that those frames look through."""
    views: dict[bytes, tuple[Camera, set[int]]] = {}
    for index, view in frames:
        key = view.world_from_camera.tobytes() + repr((view.hfov, view.resolution)).encode()
        views.setdefault(key, (view, set()))[1].update(corners_of(index))
    return list(views.values())
