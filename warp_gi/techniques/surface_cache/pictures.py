"""What a surface cache looks like: its cells on the scene, their samples, and the irradiance that they hold."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import warp as wp

from warp_gi.baking import Bake
from warp_gi.kernels import surface_cache_view as kernels
from warp_gi.pipeline import Pipeline
from warp_gi.scene.camera import Camera
from warp_gi.scene.scene import Scene
from warp_gi.scheduler import FrameScheduler
from warp_gi.sequence.preview import tone_map, write_pngs
from warp_gi.techniques.paths.estimators import BsdfPaths
from warp_gi.techniques.shared.legends import exposure_of, with_keys, with_scale
from warp_gi.techniques.surface_cache.cache import SurfaceCache

NOTHING, UNKNOWN = (0, 0, 0), (204, 121, 167)
"""Colours of pixels that see no surface, and of those where no cell is known (from the palette of Okabe and Ito)."""


def write_pictures(
    scene: Scene,
    camera: Camera,
    bake: Bake,
    settings: SurfaceCache,
    folder: str | Path,
    device: str = "cpu",
    seed: int = 0,
) -> list[Path]:
    """Write pictures of the cells that a camera sees, and return their paths.

    cells.png: each cell in a colour of its own. samples.png: the logarithm of their samples. irradiance.png: the
    irradiance that cells hold, by all light. ``seed`` is unused: pictures have no noise.
    """
    pipeline = Pipeline(environment=None, emitters=None, indirect=BsdfPaths(ends_in=settings), spp=1, camera_samples=1)
    scheduler = FrameScheduler(scene, camera, pipeline, device, seed, bakes=[bake])
    frame, cells = scheduler.frame(0), scheduler.state("indirect.ends_in").cells
    width, height = camera.resolution
    slots = wp.empty(width * height, dtype=wp.int32, device=frame.device)
    frame.launch(kernels.view_slots, [frame.data, cells, frame.hits, slots])
    at = slots.numpy().reshape(height, width)
    known = at >= 0
    rows = cells.values.numpy().reshape(-1, 8)[np.maximum(at, 0)]
    light = np.where(known[..., None], rows[..., :3], 0)
    keys = cells.keys.numpy()[np.maximum(at, 0)]
    samples = np.where(known, np.log10(np.maximum(rows[..., 3], 1)), 0)
    exposure = exposure_of(light[known] / math.pi) if known.any() else 0.0
    pictures = {
        "cells": with_keys(_marked(_colors(keys), at), _KEYS, "cells: a colour each, of whatever size"),
        "samples": with_scale(samples, max(float(samples.max()), 1.0), "samples of the cell, as a power of ten"),
        "irradiance": with_keys(
            _marked(tone_map(light.astype(np.float32) / math.pi, exposure), at),
            _KEYS,
            f"irradiance / pi by all light, exposure {exposure:+.1f}",
        ),
    }
    return write_pngs(folder, pictures)


_KEYS = ((UNKNOWN, "no cell: paths go on"), (NOTHING, "no surface"))


def _marked(image: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Return a picture uint8 [height, width, 3] with the colours of pixels without a cell."""
    image = image.copy()
    image[at == -1], image[at == -2] = UNKNOWN, NOTHING
    return image


def _colors(keys: np.ndarray) -> np.ndarray:
    """Return a colour for each key, uint8 [..., 3], none of them dark."""
    mixed = keys * np.uint64(0x9E3779B97F4A7C15)
    return np.stack([80 + (mixed >> np.uint64(shift) & np.uint64(127)) for shift in (57, 50, 43)], -1).astype(np.uint8)
