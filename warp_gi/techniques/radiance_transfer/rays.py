"""Rays of the bake: transfer of the sky at each slot, and the slots that its rays hit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.kernels import atlas as atlas_kernels
from warp_gi.kernels import transfer_bake as kernels
from warp_gi.kernels import types
from warp_gi.kernels.atlas_slots import AtlasSlots
from warp_gi.launch import on_device
from warp_gi.scene.scene import Scene
from warp_gi.techniques.radiance_transfer.settings import TransferSettings
from warp_gi.techniques.shared.atlas.atlas import Atlas

Progress = Callable[[float], None]
"""Called with the share of the work that is done."""
BATCH_SLOTS = 1 << 16
"""Slots between two reports of progress."""


@dataclass(frozen=True, eq=False)
class TransferWork:
    """A scene and its slots as the kernels of the bake read them."""

    data: types.SceneData
    """The scene, but rays meet only what never moves."""
    atlas: atlas_kernels.SurfaceAtlas
    """Where the slots are on surfaces."""
    slots: AtlasSlots
    """The surfaces at the slots."""
    rays: kernels.TransferRays
    """Directions of rays, and how many there are."""
    count: int
    """Number of slots."""
    device: wp.Device
    """Where kernels run."""

    def each_batch(self, run: Callable[[int, int], None], progress: Progress | None) -> None:
        """Call ``run(start, count)`` for all slots, some at a time."""
        for start in range(0, self.count, BATCH_SLOTS):
            run(start, min(BATCH_SLOTS, self.count - start))
            if progress is not None:
                progress(min(start + BATCH_SLOTS, self.count) / self.count)


@dataclass(frozen=True, eq=False)
class TracedTransfer:
    """What the rays of a bake find."""

    transfer: np.ndarray
    """T_j = int V max(n.w, 0) y_j dw [sr], float16 [slots, order^2]."""
    hits: np.ndarray
    """Slot that each of the first rays of a slot hits, int32 [slots, bounce_rays]; -1 for the sky, -2 for what
    has no slot, -3 for rays that start below the surface."""
    rays: np.ndarray
    """Rays traced for each slot, int32 [slots]."""


def transfer_work(scene: Scene, atlas: Atlas, settings: TransferSettings, device: wp.Device, seed: int) -> TransferWork:
    """Return what kernels need for a bake of the scene.

    Raises SceneError if everything in the scene moves.
    """
    bvh = scene.static_bvh(device)
    data = launch.copied(scene.data(device), types.SceneData)
    data.bvh = bvh.data
    rays = transfer_rays(scene, settings, device, seed)
    return TransferWork(data, atlas.on(device), atlas.slots_on(device), rays, atlas.count, device)


def transfer_rays(scene: Scene, settings: TransferSettings, device: wp.Device, seed: int) -> kernels.TransferRays:
    """Return the sets of directions of a bake, and how many rays slots have."""
    rays = kernels.TransferRays()
    rays.bounce_rays = settings.bounce_rays  # without bounces, too: they tell which slots are inside objects
    rays.first_rays = max(min(settings.first_rays, settings.rays), rays.bounce_rays)
    rays.rays = max(settings.rays, rays.first_rays)
    rays.order, rays.seed = settings.order, seed & 0xFFFFFFFF
    rays.set_size = rays.rays
    count = int(kernels.SETS) * rays.set_size
    rays.directions = wp.zeros((3, count + 8), dtype=wp.float32, device=device)
    rays.faces = wp.empty(0, dtype=wp.int32, device=device)
    if scene.is_animated:
        objects = scene.data(device).geometry.objects.numpy()
        faces = np.flatnonzero(~np.isin(objects, list(scene.moving_objects))).astype(np.int32)
        rays.faces = on_device(faces, wp.int32, device)
    launch.launch(kernels.draw_directions, count, [rays], device)
    return rays


def trace_slots(work: TransferWork, progress: Progress | None = None) -> TracedTransfer:
    """Trace the rays of all slots; the same, to the bit, on any number of threads."""
    count, rays, device = work.count, work.rays, work.device
    results = kernels.TransferResults()
    results.transfer = filled((count, rays.order**2), wp.float16, device)
    results.hits = filled((count, rays.bounce_rays), wp.int32, device)
    results.rays = filled((count,), wp.int32, device)

    def run(start: int, slots: int) -> None:
        inputs = [start, work.data, work.atlas, work.slots, rays, results]
        launch.launch(kernels.trace_transfer, slots, inputs, device, smallest_slice=16)

    work.each_batch(run, progress)
    return TracedTransfer(results.transfer.numpy(), results.hits.numpy(), results.rays.numpy())


def filled(shape: tuple[int, ...], dtype: Any, device: wp.Device) -> wp.array:
    """Return zeros [shape] of ``dtype``, on the CPU in memory that NumPy allocated: see ``on_device``."""
    scalar, size = (wp.float32, (dtype._length_,)) if dtype in (wp.vec2, wp.vec3) else (dtype, ())
    return on_device(np.zeros((*shape, *size), wp.dtype_to_numpy(scalar)), dtype, device)
