"""The irradiance where camera rays end, by paths and as light field probes have it.

In a picture errors of the irradiance and of the reflectance may cancel. This is the diffuse term alone: W/m^2 by
reflected light, as if a Lambert surface of albedo 1 were there, while all others keep their materials.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_gi.bench.harness.scenes import REFERENCE_DEPTH
from warp_gi.bench.harness.stages import Stage
from warp_gi.kernels.bsdf import lambert
from warp_gi.kernels.bvh import BvhHit
from warp_gi.kernels.gbuffer import PrimaryHits
from warp_gi.kernels.light_field import LightField
from warp_gi.kernels.light_field_cache import seen_light
from warp_gi.kernels.path_trace import NO_PATH, TERM_INDIRECT, PathSamplers, PathSettings, trace_path
from warp_gi.kernels.sampling import pixel_sample_index, pixel_seed
from warp_gi.kernels.surface import ray_origin, shading_normal, surface_at
from warp_gi.kernels.types import SceneData
from warp_gi.techniques.light_field.estimator import VISIBILITIES
from warp_gi.techniques.light_field.state import path_settings

wp.set_module_options({"enable_backward": False})


def path_traced(stage: Stage, spp: int, seed: int) -> np.ndarray:
    """Return the irradiance by ``spp`` paths a pixel, float32 [height, width, 3]; 0 where nothing is hit.

    ``stage`` is one of LightFieldProbes; paths start at the first hits of its frame.
    """
    frame = stage.frame
    width, height = frame.camera.resolution
    paths = path_settings(frame.scene)
    paths.terms, paths.max_depth, paths.spp = int(TERM_INDIRECT), REFERENCE_DEPTH, spp
    found = wp.zeros(width * height, dtype=wp.vec3, device=frame.device)
    bits = (spp - 1).bit_length()
    data = stage.state.lit_data(frame.scene)
    frame.launch(gather_irradiance, [data, width, paths, bits, wp.uint32(seed), frame.hits, found])
    return found.numpy().reshape(height, width, 3)


def of_probes(stage: Stage, visibility: str) -> tuple[np.ndarray, np.ndarray]:
    """Return what the stage's probes say, float32 [height, width, 3], and how many see a point, int32 [height, width].

    -1 probes where there is no surface, 0 where too few see it.
    """
    frame = stage.frame
    width, height = frame.camera.resolution
    found = wp.zeros(width * height, dtype=wp.vec3, device=frame.device)
    probes = wp.empty(width * height, dtype=wp.int32, device=frame.device)
    inputs = [frame.data, stage.state.field, VISIBILITIES[visibility], frame.hits, found, probes]
    frame.launch(read_irradiance, inputs)
    return found.numpy().reshape(height, width, 3), probes.numpy().reshape(height, width)


# Thread: a pixel.
@wp.kernel(enable_backward=False)
def gather_irradiance(
    first: wp.int32,
    scene: SceneData,
    width: wp.int32,
    paths: PathSettings,
    sample_bits: wp.int32,
    seed: wp.uint32,
    hits: PrimaryHits,
    irradiance: wp.array(dtype=wp.vec3),
):
    pixel = first + wp.tid()
    if hits.face[pixel] < 0:
        return
    hit = BvhHit()
    hit.face = hits.face[pixel]
    hit.t = hits.t[pixel]
    hit.u = hits.u[pixel]
    hit.v = hits.v[pixel]
    towards = -hits.direction[pixel]
    s = surface_at(scene, hit.face, hit.u, hit.v, towards)
    s.bsdf = lambert(wp.vec3(1.0, 1.0, 1.0))
    x = pixel % width
    y = pixel // width
    index = pixel_sample_index(x, y, 0, sample_bits)
    of_pixel = pixel_seed(x, y, sample_bits, seed)
    total = wp.vec3(0.0, 0.0, 0.0)
    for i in range(paths.spp):
        light = trace_path(scene, PathSamplers(), hit, s, towards, paths, index + wp.uint32(i), of_pixel, NO_PATH)
        total = total + light.indirect
    irradiance[pixel] = total * (wp.pi / wp.float32(paths.spp))


# Thread: a pixel.
@wp.kernel(enable_backward=False)
def read_irradiance(
    first: wp.int32,
    scene: SceneData,
    field: LightField,
    visibility: wp.int32,
    hits: PrimaryHits,
    irradiance: wp.array(dtype=wp.vec3),
    probes: wp.array(dtype=wp.int32),
):
    pixel = first + wp.tid()
    probes[pixel] = -1
    if hits.face[pixel] >= 0:
        s = surface_at(scene, hits.face[pixel], hits.u[pixel], hits.v[pixel], -hits.direction[pixel])
        seen = seen_light(scene, field, visibility, s.position, shading_normal(s), ray_origin(s))
        probes[pixel] = seen.probes
        irradiance[pixel] = seen.irradiance
