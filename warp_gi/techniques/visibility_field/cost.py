"""What baking a field will cost, and what it can save in a frame at most: both measured on a small share."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from warp_gi import launch
from warp_gi.scene.camera import Camera, CameraPath
from warp_gi.techniques.visibility_field.settings import MaskSettings
from warp_gi.techniques.visibility_field.state import FieldState, cells_on_path

if TYPE_CHECKING:
    import warp as wp

    from warp_gi.scene.scene import Scene

TRIED_CELLS = 96
"""Cells that are baked to learn what all of them cost."""
FEW_CELLS = 10 * TRIED_CELLS
TOLD_SECONDS = 10.0
"""CPU seconds of a bake from which on it is said what it costs."""
TRIED_RAYS = 16384
"""Camera rays from whose hits rays into the hemisphere are timed."""


def bake_seconds(
    scene: Scene, device: wp.Device, settings: MaskSettings, seed: int, camera: Camera | CameraPath | None
) -> float:
    """Return about how many CPU seconds it takes to bake the cells that a camera sees, None being every cell.

    Of ``FEW_CELLS`` or less it returns 0: they are baked soon.
    """
    state = FieldState(scene, device, settings, seed)
    cells = np.arange(state.grid.cell_count) if camera is None else cells_on_path(state, camera)
    if len(cells) <= FEW_CELLS:
        return 0.0
    some = cells[np.linspace(0, len(cells) - 1, TRIED_CELLS).astype(int)]
    state.bake(some[:1])  # loads kernels
    started = _cpu()
    state.bake(some[1:])
    return (_cpu() - started) * len(cells) / (len(some) - 1)


def traced_seconds(scene: Scene, device: wp.Device, camera: Camera, rays: float, seed: int) -> float:
    """Return the CPU seconds in which a frame traces ``rays`` rays a pixel from what it sees into the hemisphere."""
    rng, bvh = np.random.default_rng(seed), scene.bvh(device)
    width, height = camera.resolution
    pixels = rng.uniform(size=(TRIED_RAYS, 2)) * (width, height)
    ways, origins = (rays(pixels).astype(np.float32) for rays in (camera.directions, camera.origins))
    hits = bvh.intersect(origins, ways)
    faces, t = hits.face.numpy(), hits.t.numpy()
    seen = faces >= 0
    if not seen.any():
        return 0.0
    points = origins[seen] + ways[seen] * (t[seen] * np.float32(0.9999))[:, None]
    spread = rng.normal(size=points.shape)
    spread /= np.linalg.norm(spread, axis=1, keepdims=True)
    directions = (spread - 1.0001 * ways[seen]).astype(np.float32)  # about the way back, which no surface hides
    bvh.occluded(points[:1], directions[:1])
    started = _cpu()
    bvh.occluded(points, directions)
    return (_cpu() - started) / len(points) * rays * seen.mean() * width * height


def _cpu() -> float:
    """Return the CPU seconds of this process, without those of compiling."""
    return time.process_time() - launch.compile_cpu_seconds
