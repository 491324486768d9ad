"""Indirect light of a frame from light field probes: filtered irradiance, and rays traced through the probes.

What probes hold is reflected light; what a ray sees of the sky and of emitters belongs to other terms.
"""

import warp as wp

from warp_gi.kernels.bsdf import BsdfSample, average_specular, bsdf_sample, diffuse_share, fresnel, specular_sample
from warp_gi.kernels.gbuffer import CameraData, PassSettings, PrimaryHits, primary_direction, tiled_pixel
from warp_gi.kernels.light_field import (
    NOTHING,
    PROBE_USABLE,
    LightField,
    irradiance_at,
    surfel_distance,
    surfel_normal,
    texel_emission,
    unpack_radiance,
)
from warp_gi.kernels.light_field_march import MISS, march
from warp_gi.kernels.octahedral import octahedral_encode, octahedral_texel
from warp_gi.kernels.sampling import pixel_sample_index, pixel_seed, sample_1d, sample_2d
from warp_gi.kernels.surface import Surface, ray_origin, shading_normal, surface_at
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
    first_ray: wp.int32  # of the current camera sample, among those of the pixel
    ray_bits: wp.int32  # bits that count the rays of a pixel


# Sums over samples, [height * width].
@wp.struct
class ProbeBuffers:
    indirect: wp.array(dtype=wp.vec3)
    moment1: wp.array(dtype=wp.vec3)
    moment2: wp.array(dtype=wp.vec3)
    diffuse: wp.array(dtype=wp.vec3)  # light as the diffuse lobe receives it, for a denoiser; or empty
    glossy: wp.array(dtype=wp.vec3)  # what the glossy lobe reflects


# Sums over camera samples, [height * width], of a picture that is all seen through probes.
@wp.struct
class ProbeView:
    emission: wp.array(dtype=wp.vec3)
    indirect: wp.array(dtype=wp.vec3)
    normal: wp.array(dtype=wp.vec3)
    position: wp.array(dtype=wp.vec3)  # this and the following: of the first camera sample
    depth: wp.array(dtype=wp.float32)
    object_id: wp.array(dtype=wp.int32)
    material_id: wp.array(dtype=wp.int32)
    moment1: wp.array(dtype=wp.vec3)
    moment2: wp.array(dtype=wp.vec3)


# What surfaces reflect towards `origin` from a direction, as far as the probes know.
@wp.func
def reflected_radiance(field: LightField, origin: wp.vec3, direction: wp.vec3) -> wp.vec3:
    hit = march(field, origin, direction, 0.0, float(wp.inf), MOST_STEPS)
    if hit.result == MISS or hit.probe < 0:
        return wp.vec3(0.0, 0.0, 0.0)
    return unpack_radiance(field.radiance[hit.probe * field.resolution * field.resolution + hit.texel])


# Light of a sample, apart for a denoiser.
@wp.struct
class Lobes:
    diffuse: wp.vec3  # as it comes in
    glossy: wp.vec3  # as it goes out


# Light that the filtered irradiance of the probes gives a surface: to its diffuse lobe, and in the mode without rays
# to the glossy one as if that were Lambert too.
@wp.func
def steady_light(field: LightField, s: Surface, mode: wp.int32) -> Lobes:
    r = Lobes()
    if mode == MODE_TRACED or (mode == MODE_HYBRID and wp.max(s.bsdf.diffuse) <= 0.0):
        return r
    normal = shading_normal(s)
    arriving = irradiance_at(field, s.position, normal) / wp.pi
    r.diffuse = wp.cw_mul(diffuse_share(s.bsdf), arriving)
    if mode == MODE_IRRADIANCE:
        r.glossy = wp.cw_mul(average_specular(s.bsdf), arriving)
    return r


# Light of a ray through the probes, by the glossy lobe alone or by the whole BSDF.
@wp.func
def ray_light(field: LightField, s: Surface, wo: wp.vec3, mode: wp.int32, index: wp.uint32, seed: wp.uint32) -> Lobes:
    r = Lobes()
    u = sample_2d(index, seed, DIRECTION_DIMENSION)
    sample = BsdfSample()
    if mode == MODE_HYBRID:
        sample = specular_sample(s.bsdf, wo, u)
    else:
        u_lobe = float(0.0)
        if s.bsdf.f90 > 0.0:
            u_lobe = sample_1d(index, seed, LOBE_DIMENSION)
        sample = bsdf_sample(s.bsdf, wo, u_lobe, u)
    wi = s.shading * sample.wi
    if sample.pdf <= 0.0 or wp.dot(wi, s.normal) <= 0.0:
        return r
    light = reflected_radiance(field, ray_origin(s), wi)
    r.glossy = wp.cw_mul(sample.weight, light)
    if mode == MODE_TRACED:
        f = wp.vec3(0.0, 0.0, 0.0)
        if s.bsdf.f90 > 0.0:
            f = fresnel(s.bsdf, wp.dot(wo, wp.normalize(wo + sample.wi)))
        share = sample.wi[2] / (wp.pi * sample.pdf)
        r.diffuse = wp.cw_mul(wp.vec3(1.0, 1.0, 1.0) - f, light) * share
        r.glossy = r.glossy - wp.cw_mul(s.bsdf.diffuse, r.diffuse)
    return r


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
    s = surface_at(scene, face, hits.u[pixel], hits.v[pixel], -hits.direction[pixel])
    wo = wp.transpose(s.shading) * -hits.direction[pixel]
    steady = steady_light(field, s, query.mode)
    rays = int(0)
    if query.mode == MODE_TRACED or (query.mode == MODE_HYBRID and s.bsdf.f90 > 0.0):
        rays = query.rays
    share = wp.float32(settings.sample_count)  # samples that one evaluation stands for
    if rays > 0:
        share = share / wp.float32(rays)
    seed = pixel_seed(p[0], p[1], query.ray_bits, settings.seed)
    first_index = pixel_sample_index(p[0], p[1], query.first_ray, query.ray_bits)
    diffuse = wp.vec3(0.0, 0.0, 0.0)
    glossy = wp.vec3(0.0, 0.0, 0.0)
    moment2 = wp.vec3(0.0, 0.0, 0.0)
    for i in range(wp.max(rays, 1)):
        light = steady
        if rays > 0:
            by_ray = ray_light(field, s, wo, query.mode, first_index + wp.uint32(i), seed)
            light.diffuse = light.diffuse + by_ray.diffuse
            light.glossy = light.glossy + by_ray.glossy
        leaving = wp.cw_mul(s.bsdf.diffuse, light.diffuse) + light.glossy
        diffuse = diffuse + light.diffuse
        glossy = glossy + light.glossy
        moment2 = moment2 + wp.cw_mul(leaving, leaving)
    count = wp.float32(settings.sample_count)
    total = (wp.cw_mul(s.bsdf.diffuse, diffuse) + glossy) * share
    mean = total / count
    buffers.indirect[pixel] = buffers.indirect[pixel] + total
    buffers.moment1[pixel] = buffers.moment1[pixel] + total
    # the variance of the mean is taken for that of `sample_count` samples, and there were count / share
    spread = moment2 * (share / count) - wp.cw_mul(mean, mean)
    buffers.moment2[pixel] = buffers.moment2[pixel] + (wp.cw_mul(mean, mean) + spread * share) * count
    if buffers.diffuse.shape[0] > 0:
        buffers.diffuse[pixel] = buffers.diffuse[pixel] + diffuse * share
        buffers.glossy[pixel] = buffers.glossy[pixel] + glossy * share


# What the sky sends against a direction, from the first probe that sees it there.
@wp.func
def sky_radiance(field: LightField, direction: wp.vec3) -> wp.vec3:
    texel = octahedral_texel(octahedral_encode(direction), field.resolution)
    size = field.resolution * field.resolution
    for probe in range(field.states.shape[0]):
        if field.states[probe] == PROBE_USABLE and surfel_distance(field.surfels[probe * size + texel]) >= NOTHING:
            return unpack_radiance(field.radiance[probe * size + texel])
    return wp.vec3(0.0, 0.0, 0.0)


# Thread: a pixel. What the camera sees of the probes' surfels and of the sky behind them.
@wp.kernel
def view_probes(first: wp.int32, camera: CameraData, settings: PassSettings, field: LightField, view: ProbeView):
    p = tiled_pixel(first + wp.tid(), camera.width)
    if p[0] >= camera.width or p[1] >= camera.height:
        return
    pixel = p[1] * camera.width + p[0]
    direction = primary_direction(camera, settings, p)
    hit = march(field, camera.position, direction, 0.0, float(wp.inf), MOST_STEPS)
    position = wp.vec3(0.0, 0.0, 0.0)
    depth = float(wp.inf)
    reflected = wp.vec3(0.0, 0.0, 0.0)
    emitted = wp.vec3(0.0, 0.0, 0.0)
    if hit.probe < 0:
        emitted = sky_radiance(field, direction)
    else:
        texel = hit.probe * field.resolution * field.resolution + hit.texel
        surfel = field.surfels[texel]
        if hit.result != MISS:
            reflected = unpack_radiance(field.radiance[texel])
            emitted = texel_emission(field, texel)
            position = camera.position + direction * hit.t
            depth = wp.dot(position - camera.position, camera.forward)
            view.normal[pixel] = view.normal[pixel] + surfel_normal(surfel)
        elif surfel_distance(surfel) >= NOTHING:
            emitted = unpack_radiance(field.radiance[texel])
    count = wp.float32(settings.sample_count)
    radiance = reflected + emitted
    view.emission[pixel] = view.emission[pixel] + emitted
    view.indirect[pixel] = view.indirect[pixel] + reflected * count
    view.moment1[pixel] = view.moment1[pixel] + radiance * count
    view.moment2[pixel] = view.moment2[pixel] + wp.cw_mul(radiance, radiance) * count
    if settings.camera_sample == 0:
        view.position[pixel] = position
        view.depth[pixel] = depth
        view.object_id[pixel] = -1
        view.material_id[pixel] = -1
