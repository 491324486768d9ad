"""The state of a visibility field while it renders: masks of cells, what moves, and what is baked on the way.

There are two layers of cells. The static layer is baked without the objects that can move. It stays right wherever
they are: what it calls occluded is, and what it calls visible is unless the ray meets one of their boxes, and then the
ray is traced. Their own surfaces are not in it, so their pixels trace. While nothing moves from one frame to the next,
cells in view are baked again with every object where it is: the settled layer, which is dropped at the next motion.
"""

from __future__ import annotations

import copy
import hashlib
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Literal

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.baking import Bake, Setting
from warp_gi.errors import BakeError
from warp_gi.kernels import gbuffer
from warp_gi.kernels import visibility_field as field_kernels
from warp_gi.kernels import visibility_field_bake as bake_kernels
from warp_gi.kernels import visibility_field_trace as trace_kernels
from warp_gi.layout import Layout, check_layout, misfit
from warp_gi.scene.camera import Camera, CameraPath
from warp_gi.scene.pinhole import camera_data
from warp_gi.scene.scene import Scene
from warp_gi.techniques.visibility_field.bake import FieldBaker, Grid, grid_of, grid_struct, words_of
from warp_gi.techniques.visibility_field.settings import MaskSettings

RAYS_A_MILLISECOND = 20_000
"""Rays that a millisecond of a budget pays for on every machine, so that pictures do not depend on its speed."""

Layer = Literal["static", "settled"]


@dataclass(frozen=True, eq=False)
class SettledLayer:
    """Cells that were baked with every object where it has been since the last motion."""

    cells: np.ndarray
    """int32 [slot]: numbers in the grid of the cells that hold surfaces, in the order they were baked."""
    masks: np.ndarray
    """uint32 [slot, words]: masks of those cells."""
    flags: np.ndarray
    """int32 [slot]: occlusion labels of those cells, SLOT_LABEL or 0."""
    empty: np.ndarray
    """int32 [number]: numbers in the grid of cells in which no surface was found."""

    @classmethod
    def nothing(cls, words: int) -> SettledLayer:
        """Return a layer without cells, whose masks would have so many words."""
        none = np.empty(0, np.int32)
        return cls(none, np.empty((0, words), np.uint32), none, none)

    @property
    def known(self) -> np.ndarray:
        """int32 [number]: all cells that were looked at, those without a surface last."""
        return np.concatenate([self.cells, self.empty])


class FieldState:
    """Masks of a field on a device, growing as cells come into view.

    A frame's state is a shallow copy (``copied``) of the one that the last frame left. ``bake``, ``bake_settled``,
    ``move``, ``upload`` and ``upload_nothing`` change the state that they are called on, so call them on a copy, or on
    a state that no frame has yet. They put new arrays and structs in the place of those that they change, and the
    state that was copied stays as it is. ``trace`` changes nothing but ``transfer``, which ``preprocess`` made for the
    frame.

    Args:
        scene: Scene that is rendered.
        device: Where masks are baked and looked up.
        settings: What decides the masks.
        seed: Seed of all samples and rays of baking.
    """

    def __init__(self, scene: Scene, device: wp.Device, settings: MaskSettings, seed: int) -> None:
        self.scene, self.device, self.settings, self.seed = scene, device, settings, seed
        self.grid: Grid = grid_of(scene.bounds, settings.cell_size)
        self.words = words_of(settings.resolution)
        """32-bit words of a cell's masks."""
        self.slots = np.full(self.grid.cell_count, field_kernels.NO_SLOT, np.int32)
        """int32 [cell]: slot of each cell of the grid in the static layer, with its flags; NO_SLOT where none is."""
        self.masks = np.empty((0, self.words), np.uint32)
        """uint32 [slot, words]: masks of the static layer."""
        self.cells = np.empty(0, np.int32)
        """int32 [slot]: number in the grid of each cell of the static layer, in the order they were baked."""
        self.seconds = 0.0
        """Wall seconds spent on baking the static layer."""
        self.counts: dict[str, int] = {"samples": 0, "rays": 0, "rays_traced": 0}
        """Surface samples of the static layer, their rays, and how many of those were traced."""
        self.movers = scene.moving_objects
        """Node of each object that can move, by the object's number."""
        self.poses: np.ndarray | None = None
        """What decides where vertices of movers were in the last frame, float64 [n]; None before the first one."""
        self.is_still = False
        """Whether nothing moved between the last two frames."""
        self.settled = SettledLayer.nothing(self.words)
        """Cells that were baked since the last motion; without any unless ``is_still``."""
        self.empty = np.zeros(self.grid.cell_count, bool)
        """bool [cell]: cells in which baking the static layer found no surface."""
        self.data = grid_struct(self.grid, settings.resolution, None, None)
        """Grid of this frame as kernels read it; without cells before the first frame."""
        self.query = field_kernels.FieldQuery()
        """Directions and boxes of movers of this frame as kernels read them; empty before the first frame."""
        self.sky = trace_kernels.FieldSky()
        """Sky of this frame as kernels read it; empty before the first frame."""
        self.transfer: wp.array | None = None
        """float32 [27 * pixel]: what each harmonic of a white sky adds to a pixel, in the frame that ``transfer_key``
        belongs to; None unless the field relights."""
        self.transfer_key: tuple[object, ...] | None = None
        """Camera, poses and number of cells that ``transfer`` belongs to; None if there is none."""
        self.relights = False
        """Whether ``transfer`` is known, and this frame's light comes from it; else the frame fills it."""
        self._start_count, self._start_empty = 0, self.empty
        self._bakers: dict[Layer, FieldBaker] = {}
        """Made when first used, and shared by all copies: they hold nothing that a frame leaves behind."""
        self._is_stale = True
        """Whether the grid on the device lacks cells that the state has."""

    @property
    def flags(self) -> np.ndarray:
        """int32 [slot]: occlusion label of each cell of the static layer, SLOT_LABEL or 0."""
        return self.slots[self.cells] & field_kernels.SLOT_LABEL

    def copied(self) -> FieldState:
        """Return a shallow copy for a frame to change."""
        return copy.copy(self)

    # ---- to and from a bake ----

    @classmethod
    def from_bake(cls, scene: Scene, device: wp.Device, settings: MaskSettings, seed: int, bake: Bake) -> FieldState:
        """Return the state that a bake holds. Raises BakeError if it is not whole."""
        state = cls(scene, device, settings, seed)
        what = f"this bake of a visibility field in {bake.scene_name!r}"
        check_layout(what, bake.arrays, state.layout(np.shape(bake.arrays.get("cells", ()))[:1] or (0,)))
        cells, flags = (bake.arrays[name].astype(np.int32) for name in ("cells", "flags"))
        masks, empty = bake.arrays["masks"], bake.arrays["empty_cells"]
        if len(np.unique(cells)) != len(cells):
            raise BakeError(f"{what} names a cell twice; bake it again")
        state._add(cells, masks.astype(np.uint32), flags)
        state.empty[empty] = True
        state._start_count, state._start_empty = len(cells), state.empty
        state.counts |= {name: int(bake.counts.get(name, 0)) for name in state.counts}
        state.seconds = float(bake.counts.get("seconds", 0.0))
        return state

    def layout(self, cells: tuple[int, ...], prefix: str = "") -> dict[str, Layout]:
        """Return what the arrays of so many cells have to be; ``prefix`` is that of their names."""
        last, whole = self.grid.cell_count - 1, "int32 int64 uint32"
        return {
            f"{prefix}cells": Layout(whole, cells, 0, last),
            f"{prefix}flags": Layout(whole, cells, 0, int(field_kernels.SLOT_LABEL)),
            f"{prefix}masks": Layout("uint32", (*cells, self.words)),
            f"{prefix}empty_cells": Layout(whole, (None,), 0, last),
        }

    def to_bake(self) -> Bake:
        """Return the static layer as a bake, with the cells that frames added."""
        low, shape = self.grid.low, np.array(self.grid.shape, np.int32)
        counts = {**self.counts, "cells": len(self.cells), "seconds": round(self.seconds, 3)}
        arrays = {"cells": self.cells, "flags": self.flags, "masks": self.masks, "grid_low": low, "grid_shape": shape}
        arrays["empty_cells"] = np.flatnonzero(self.empty).astype(np.int32)
        arrays["grid_cell_size"] = np.array([self.grid.cell_size])
        settings = stored_settings(self.settings, self.grid)
        return Bake("VisibilityField", self.scene.geometry_hash, settings, arrays, counts, self.scene.name)

    # ---- to and from what frames leave behind ----

    def saved_arrays(self) -> dict[str, np.ndarray]:
        """Return what frames added to the state before the first one: cells of both layers, and poses."""
        added = slice(self._start_count, None)
        return {
            "start": np.frombuffer(self._start_digest(), np.uint8),
            "cells": self.cells[added],
            "flags": self.flags[added],
            "masks": self.masks[added],
            "empty_cells": np.flatnonzero(self.empty & ~self._start_empty).astype(np.int32),
            "settled_cells": self.settled.cells,
            "settled_flags": self.settled.flags,
            "settled_masks": self.settled.masks,
            "settled_empty_cells": self.settled.empty,
            "poses": np.zeros(0) if self.poses is None else self.poses,
        }

    def with_saved_arrays(self, arrays: Mapping[str, np.ndarray]) -> FieldState:
        """Return the state before the first frame with what ``saved_arrays`` holds.

        Raises KeyError where one is missing, ValueError if they are of a field that began with other cells.
        """
        if arrays["start"].tobytes() != self._start_digest():
            raise ValueError("the field began with other cells")
        wanted = self.layout(arrays["cells"].shape[:1]) | self.layout(arrays["settled_cells"].shape[:1], "settled_")
        wanted["poses"] = Layout("float64", np.shape(arrays["poses"]))
        if problem := misfit(arrays, wanted):
            raise ValueError(problem)
        state, count = self.copied(), self._start_count
        state.slots = self.slots.copy()
        state.slots[self.cells[count:]] = field_kernels.NO_SLOT
        state.cells, state.masks = self.cells[:count], self.masks[:count]
        state._add(arrays["cells"], arrays["masks"], arrays["flags"])
        state.empty = self._start_empty.copy()
        state.empty[arrays["empty_cells"]] = True
        names = ("cells", "masks", "flags", "empty_cells")
        state.settled = SettledLayer(*(arrays[f"settled_{name}"] for name in names))
        state.poses = arrays["poses"] if len(arrays["poses"]) else None
        state.transfer, state.transfer_key = None, None
        return state

    def _start_digest(self) -> bytes:
        """Return a SHA-256 over the cells that were known before the first frame."""
        start = np.concatenate([self.cells[: self._start_count], np.flatnonzero(self._start_empty)])
        return hashlib.sha256(start.astype(np.int64).tobytes()).digest()

    # ---- baking ----

    def baker(self, layer: Layer) -> FieldBaker:
        """Return what bakes a layer: "static" without the objects that can move, "settled" with them."""
        if layer not in self._bakers:
            data = self.scene.data(self.device)
            if layer == "static":
                bvh = self.scene.static_bvh(self.device).data
                left_out = np.zeros(len(self.scene.object_names), np.int32)
                left_out[list(self.movers)] = 1
            else:
                bvh, left_out = data.bvh, None
            place = (self.scene.radius, self.grid, self.settings, self.device, self.seed)
            self._bakers[layer] = FieldBaker(data.geometry, bvh, *place, left_out, self.scene.surface_area)
        return self._bakers[layer]

    def bake(
        self,
        cells: np.ndarray | None = None,
        progress: Callable[[float], None] | None = None,
        most_rays: float = np.inf,
    ) -> None:
        """Add cells to the static layer.

        Args:
            cells: int32 [number], numbers in the grid, the most wanted first; None is all of them.
            progress: Called with the share done in [0, 1].
            most_rays: Rays that are traced at most, about; cells for which they do not suffice are left out.
        """
        started, baker = time.perf_counter(), self.baker("static")
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
        a_cell = 2 * baker.density * self.grid.cell_size**2 * baker.rays / 4  # rays traced for a flat wall, about
        return np.sort(cells[: max(int(most_rays / a_cell), 1)])

    def _add(self, cells: np.ndarray, masks: np.ndarray, flags: np.ndarray) -> None:
        boxed = field_kernels.SLOT_BOXED if self.movers else 0
        self.slots = self.slots.copy()
        self.slots[cells] = np.arange(len(self.cells), len(self.cells) + len(cells), dtype=np.int32) | flags | boxed
        self.cells = np.concatenate([self.cells, cells.astype(np.int32)])
        self.masks = np.concatenate([self.masks, masks])
        self._is_stale = True

    def bake_settled(self, cells: np.ndarray, most_rays: float) -> None:
        """Bake cells, int32 [number], with every object where it is now; the first ones that ``most_rays`` pays for."""
        known = self.settled
        cells = cells[~np.isin(cells, known.known)]
        if len(cells) == 0:
            return
        baker = self.baker("settled")
        cells = self._affordable(baker, cells, most_rays)
        pieces = baker.find(cells)
        masks, flags = baker.bake(pieces)
        self.settled = SettledLayer(
            np.concatenate([known.cells, pieces.cells.astype(np.int32)]),
            np.concatenate([known.masks, masks]),
            np.concatenate([known.flags, flags]),
            np.concatenate([known.empty, cells[~np.isin(cells, pieces.cells)]]),
        )
        self._is_stale = True

    # ---- a frame ----

    def move(self, now: float) -> None:
        """Take note of where everything is at ``now`` [s], and drop the settled layer if anything moved."""
        poses = self.scene.shape_key(self.movers.values(), now)
        moved = self.poses is None or not np.array_equal(poses, self.poses)
        if moved and self.movers:
            self.settled = SettledLayer.nothing(self.words)
            self._is_stale = True
        self.is_still = not moved
        self.poses = poses
        if self.movers:
            boxes = [self.scene.node_box(node, now) for node in self.movers.values()]
            margin = 1e-4 * self.scene.radius
            corners = np.concatenate([np.stack([low - margin, high + margin]) for low, high in boxes])
            self.query.boxes = wp.array(corners.astype(np.float32), dtype=wp.vec3, device=self.device)
            moving = np.zeros(len(self.scene.object_names), np.int32)
            moving[list(self.movers)] = 1
            self.query.moving = wp.array(moving, dtype=wp.int32, device=self.device)

    def upload(self) -> None:
        """Bring ``data``, the grid as kernels read it, up to date; settled cells take the place of static ones."""
        if not self._is_stale:
            return
        slots, masks, settled = self.slots, self.masks, self.settled
        if len(settled.cells):
            slots = slots.copy()
            new = np.arange(len(masks), len(masks) + len(settled.cells), dtype=np.int32)
            slots[settled.cells] = new | settled.flags
            masks = np.concatenate([masks, settled.masks])
        slots_array: wp.array = wp.array(slots, dtype=wp.int32, device=self.device)
        masks_array: wp.array = wp.array(masks.reshape(-1), dtype=wp.uint32, device=self.device)
        self.data = grid_struct(self.grid, self.settings.resolution, slots_array, masks_array)
        self._is_stale = False

    def upload_nothing(self) -> None:
        """Make ``data`` a grid without any cell, so that kernels trace every ray."""
        slots = wp.empty(0, dtype=wp.int32, device=self.device)
        masks = wp.empty(0, dtype=wp.uint32, device=self.device)
        self.data = grid_struct(self.grid, self.settings.resolution, slots, masks)

    def lacks(self, views: Iterable[tuple[int, Camera]]) -> bool:
        """Return whether one of these frames, by number and camera, sees cells that are still to be baked."""
        for view, corners in distinct_views(views):
            cells = self.cells_in_view(view, sorted(corners))
            if ((self.slots[cells] < 0) & ~self.empty[cells]).any():
                return True
        return False

    def cells_in_view(self, camera: Camera, corners: Sequence[int] = range(4)) -> np.ndarray:
        """Return the cells that a camera sees, int32 [number], those seen most first.

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


def stored_settings(settings: MaskSettings, grid: Grid) -> dict[str, Setting]:
    """Return the settings that a bake stores and is checked by, with the cell size in metres."""
    return {**asdict(settings), "cell_size": grid.cell_size}


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
        key = view.world_from_camera.tobytes() + repr(view.lens).encode()
        views.setdefault(key, (view, set()))[1].update(corners_of(index))
    return list(views.values())
