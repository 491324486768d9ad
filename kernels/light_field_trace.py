"""Indirect light of a frame from light field probes: filtered irradiance, and rays traced through the probes.

What probes hold is reflected light; what a ray sees of the sky and of emitters belongs to other terms.
"""

import warp as wp

from warp_gi.kernels.bsdf import Bsdf, average_fresnel, average_reflectance, bsdf_sample, specular_sample
from warp_gi.kernels.gbuffer import CameraData, PassSettings, PrimaryHits, tiled_pixel
from warp_gi.kernels.light_field import LightField, irradiance_at, unpack_radiance
from warp_gi.kernels.light_field_march import MISS, march
from warp_gi.kernels.sampling import pixel_sample_index, pixel_seed, sample_1d, sample_2d
from warp_gi.kernels.surface import ray_origin, surface_at
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

MODE_IRRADIANCE = wp.constant(0)
MODE_HYBRID = wp.constant(1)
MODE_TRACED = wp.constant(2)
MOST_STEPS = wp.constant(1 << 20)
LOBE_DIMENSION = wp.constant(40)  # dimension pairs that the path tracer does not use at its first vertex
DIRECTION_DIMENSION = wp.constant(41)


@wp.struct
class ProbeQuery:
    mode: wp.int32  # MODE_*
    rays: wp.int32  # of the current camera sample
    share: wp.float32  # samples that a ray stands for


# Sums over samples, [height * width].
@wp.struct
class ProbeBuffers:
    indirect: wp.array(dtype=wp.vec3)
    moment1: wp.array(dtype=wp.vec3)
    moment2: wp.array(dtype=wp.vec3)


# What surfaces reflect towards `origin` from a direction, as far as the probes know.
@wp.func
def reflected_radiance(field: LightField, origin: wp.vec3, direction: wp.vec3) -> wp.vec3:
    hit = march(field, origin, direction, 0.0, float(wp.inf), MOST_STEPS)
    if hit.result == MISS or hit.probe < 0:
        return wp.vec3(0.0, 0.0, 0.0)
    return unpack_radiance(field.radiance[hit.probe * field.resolution * field.resolution + hit.texel])


# Share of light from everywhere that leaves as if from Lambert.
@wp.func
def diffuse_reflectance(b: Bsdf, mode: wp.int32) -> wp.vec3:
    if mode == MODE_IRRADIANCE:
        return average_reflectance(b)
    if mode == MODE_TRACED:
        return wp.vec3(0.0, 0.0, 0.0)
    return wp.cw_mul(b.diffuse, wp.vec3(1.0, 1.0, 1.0) - average_fresnel(b))


# Thread: a pixel.
@wp.kernel
def trace_probes(
    first: wp.int32,
    scene: SceneData,
    camera: CameraData,
    settings: PassSettings,
    field: LightField,
    query: ProbeQuery,
    hits: PrimaryHits,
    buffers: ProbeBuffers,
):
    p = tiled_pixel(first + wp.tid(), camera.width)
    if p[0] >= camera.width or p[1] >= camera.height:
        return
    pixel = p[1] * camera.width + p[0]
    face = hits.face[pixel]
    if face < 0:
        return
    direction = hits.direction[pixel]
    s = surface_at(scene, face, hits.u[pixel], hits.v[pixel], -direction)
    wo = wp.transpose(s.shading) * -direction
    count = wp.float32(settings.sample_count)
    steady = wp.vec3(0.0, 0.0, 0.0)  # light without noise
    diffuse = diffuse_reflectance(s.bsdf, query.mode)
    if wp.max(diffuse) > 0.0:
        normal = wp.vec3(s.shading[0, 2], s.shading[1, 2], s.shading[2, 2])
        steady = wp.cw_mul(diffuse, irradiance_at(field, s.position, normal)) / wp.pi
    total = steady * count
    moment1 = steady * count
    moment2 = wp.cw_mul(steady, steady) * count
    if query.mode == MODE_TRACED or (query.mode == MODE_HYBRID and s.bsdf.f90 > 0.0):
        seed = pixel_seed(p[0], p[1], settings.sample_bits, settings.seed)
        first_index = pixel_sample_index(p[0], p[1], settings.first_sample, settings.sample_bits)
        origin = ray_origin(s)
        total = wp.vec3(0.0, 0.0, 0.0)
        moment2 = wp.vec3(0.0, 0.0, 0.0)
        for i in range(query.rays):
            index = first_index + wp.uint32(i)
            u = sample_2d(index, seed, DIRECTION_DIMENSION)
            sample = specular_sample(s.bsdf, wo, u)
            if query.mode == MODE_TRACED:
                u_lobe = float(0.0)
                if s.bsdf.f90 > 0.0:
                    u_lobe = sample_1d(index, seed, LOBE_DIMENSION)
                sample = bsdf_sample(s.bsdf, wo, u_lobe, u)
            light = steady
            wi = s.shading * sample.wi
            if sample.pdf > 0.0 and wp.dot(wi, s.normal) > 0.0:
                light = light + wp.cw_mul(sample.weight, reflected_radiance(field, origin, wi))
            total = total + light
            moment2 = moment2 + wp.cw_mul(light, light)
        total = total * query.share
        moment1 = total
        moment2 = moment2 * query.share
    buffers.indirect[pixel] = buffers.indirect[pixel] + total
    buffers.moment1[pixel] = buffers.moment1[pixel] + moment1
    buffers.moment2[pixel] = buffers.moment2[pixel] + moment2
