"""The path tracer without a frame around it: for tests of its hooks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import warp as wp
from statistics_tools import device

import warp_gi as gi
from warp_gi import launch
from warp_gi.kernels import camera_rays, gbuffer, path_trace, types
from warp_gi.kernels.path_trace import TERM_EMITTERS, TERM_ENVIRONMENT, TERM_INDIRECT
from warp_gi.paths import sky_probability
from warp_gi.scene.pinhole import camera_data

EVERYTHING = TERM_ENVIRONMENT | TERM_EMITTERS | TERM_INDIRECT


def scene_data(scene: gi.Scene) -> Any:
    """Return the scene as kernels read it on `device`, with emitters sampled by their power."""
    data = launch.copied(scene.data(device()), types.SceneData)
    data.emitters = launch.copied(data.emitters, types.Emitters)
    if scene.emitter_count:
        data.emitters.alias = scene.light_table(device())
    return data


def path_settings(scene: gi.Scene, spp: int, **settings: Any) -> Any:
    """Return settings of paths that trace every term; ``settings`` replace any of them."""
    paths = path_trace.PathSettings()
    defaults = {"terms": EVERYTHING, "max_depth": 64, "roulette_depth": 2, "sky_probability": sky_probability(scene)}
    for name, value in {**defaults, "cache_vertex": path_trace.CACHE_VERTEX, "spp": spp, **settings}.items():
        setattr(paths, name, value)
    return paths


def trace(
    scene: gi.Scene,
    camera: gi.Camera,
    tracer: path_trace.PathTracer,
    fill: Callable[[Any, int], None] | None = None,
    spp: int = 16,
    seed: int = 1,
    **settings: Any,
) -> dict[str, np.ndarray]:
    """Return the pictures of a path tracer through pixel centres, by term, float64 [height, width, 3].

    ``fill(samplers, items)`` sets the samplers' data; a launch has so many items. ``settings`` are of PathSettings.
    """
    width, height = camera.resolution
    tiles = -(-width // gbuffer.TILE) * -(-height // gbuffer.TILE)
    items = tiles * gbuffer.TILE**2
    data, view = scene_data(scene), camera_data(camera)
    passes = gbuffer.PassSettings()
    passes.seed, passes.camera_samples, passes.sample_count = seed, 1, spp
    passes.sample_bits = (spp - 1).bit_length()
    hits = _filled(gbuffer.PrimaryHits, width * height)
    buffers = _filled(path_trace.PathBuffers, width * height)
    share = camera_rays.PACKET if device().is_cpu else 1
    launch.launch(camera_rays.trace_primary, items // share, [data, view, passes, share, hits], device())
    samplers = tracer.samplers()
    if fill is not None:
        fill(samplers, items)
    inputs = [data, view, passes, path_settings(scene, spp, **settings), hits, buffers, samplers]
    launch.launch(tracer.trace_paths, items, inputs, device())
    return {
        name: getattr(buffers, name).numpy().astype(np.float64).reshape(height, width, 3) / spp
        for name in ("environment", "emitters", "indirect")
    }


def _filled(struct: Any, count: int) -> Any:
    """Return a struct of arrays of ``count`` zeros."""
    filled = struct()
    for name, field in struct.vars.items():
        setattr(filled, name, wp.zeros(count, dtype=field.type.dtype, device=device()))
    return filled
