"""Kernels of the suite ``probes``: irradiance where camera rays end, by paths and by probes."""

import warp as wp

from warp_gi.kernels.bsdf import lambert
from warp_gi.kernels.bvh import BvhHit
from warp_gi.kernels.gbuffer import PrimaryHits
from warp_gi.kernels.light_field import LightField
from warp_gi.kernels.light_field_cache import seen_light
from warp_gi.kernels.path_trace import NO_PATH, PathSamplers, PathSettings, trace_path
from warp_gi.kernels.sampling import pixel_sample_index, pixel_seed
from warp_gi.kernels.surface import ray_origin, shading_normal, surface_at
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})


# Thread: a pixel. Writes the irradiance [W/m^2] by reflected light at its first hit, from `paths.spp` paths.
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


# Thread: a pixel. Writes the irradiance [W/m^2] that probes know at its first hit, and how many probes see it.
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
