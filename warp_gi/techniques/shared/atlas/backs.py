"""Which surfaces of an atlas are seen from behind: those need slots on both sides."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.kernels import atlas_texels as kernels
from warp_gi.launch import on_device
from warp_gi.scene.scene import Scene
from warp_gi.techniques.shared.atlas.texels import CoveredTexels

RAYS = 4
"""Rays from the back of each slot."""
LEAST_OPEN = 0.002
"""Share of a chart's rays that have to reach the open before its backs get slots: a few slip through where surfaces
touch or cross each other."""


def open_charts(scene: Scene, covered: CoveredTexels, charts: np.ndarray, device: wp.Device) -> np.ndarray:
    """Return whether the back of each chart is in the open, bool [chart].

    A back is in the open where a ray from it meets the sky, or the front of a face: within a closed surface there are
    backs alone. ``charts`` int32 [face] is that of an ``Atlas``; what moves blocks no ray.
    """
    scene.update(0.0, device=device)
    bvh = scene.static_bvh(device)
    objects = scene._flat.objects
    resting = np.flatnonzero(~np.isin(objects, list(scene.moving_objects))).astype(np.int32)
    looks = kernels.BackLooks()
    looks.faces = on_device(covered.faces, wp.int32, device)
    looks.points = on_device(covered.points, wp.vec2, device)
    looks.faces_of_bvh = on_device(resting, wp.int32, device)
    looks.rays = RAYS
    looks.open = wp.empty(len(covered.faces), dtype=wp.int32, device=device)
    launch.launch(kernels.look_behind, len(covered.faces), [scene.data(device), bvh.data, looks], device)
    count = int(charts.max(initial=-1)) + 1
    owner = charts[covered.faces]
    opened = np.bincount(owner, looks.open.numpy(), count)
    return opened > LEAST_OPEN * RAYS * np.bincount(owner, minlength=count)
