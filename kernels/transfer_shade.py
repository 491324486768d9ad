"""Light of a frame from transfer textures: no ray but one to each sun."""

import warp as wp

from warp_gi.kernels.atlas import SlotFetch
from warp_gi.kernels.gbuffer import PassSettings, PrimaryHits, tiled_pixel
from warp_gi.kernels.sampling import TRANSFER_SUN_DIMENSION, pixel_sample_index, pixel_seed, sample_2d
from warp_gi.kernels.surface import Surface, surface_at
from warp_gi.kernels.transfer_light import (
    TransferRows,
    TransferSky,
    bounced_irradiance,
    diffuse_radiance,
    glossy_radiance,
    is_kept,
    sun_radiance,
    surface_slots,
    view_reflectance,
)
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

WANTS_ENVIRONMENT = wp.constant(1)
WANTS_INDIRECT = wp.constant(2)


# What a launch is asked for.
@wp.struct
class TransferQuery:
    terms: wp.int32  # WANTS_*
    traced_below: wp.float32  # roughness below which rays are traced for the glossy lobe
    ratio_below: wp.float32  # roughness below which glossy light is the prefiltered sky's, shaded by transfer
    sharp: wp.int32  # of a pixel, in transfer_trace.py: 1 if it is there for its glossy lobe alone
    soft: wp.int32  # 1: suns are discs, by one point of each a camera sample; 0: their middles
    traces: wp.int32  # 1: a launch of transfer_trace.py serves these pixels, and those where no transfer is kept


# Sums over samples, [height * width], of each term, of its samples and of their squares.
@wp.struct
class TransferBuffers:
    width: wp.int32
    height: wp.int32
    environment: wp.array(dtype=wp.vec3)
    environment_moment1: wp.array(dtype=wp.vec3)
    environment_moment2: wp.array(dtype=wp.vec3)
    indirect: wp.array(dtype=wp.vec3)
    indirect_moment1: wp.array(dtype=wp.vec3)
    indirect_moment2: wp.array(dtype=wp.vec3)


# Whether rays are traced for the light of a surface.
@wp.func
def is_traced(query: TransferQuery, s: Surface, at: SlotFetch) -> wp.bool:
    return not is_kept(at) or (s.bsdf.f90 > 0.0 and wp.sqrt(s.bsdf.alpha) < query.traced_below)


# Place on the discs of suns in a camera sample of a pixel.
@wp.func
def sun_point(settings: PassSettings, p: wp.vec2i, soft: wp.int32) -> wp.vec2:
    if soft == 0:
        return wp.vec2(0.0, 0.0)
    index = pixel_sample_index(p[0], p[1], settings.camera_sample, settings.camera_bits)
    seed = pixel_seed(p[0], p[1], settings.camera_bits, settings.seed)
    return sample_2d(index, seed, TRANSFER_SUN_DIMENSION)


# Adds radiance that stands for `count` equal samples.
@wp.func
def add_equal(
    sums: wp.array(dtype=wp.vec3),
    moment1: wp.array(dtype=wp.vec3),
    moment2: wp.array(dtype=wp.vec3),
    pixel: wp.int32,
    radiance: wp.vec3,
    count: wp.float32,
):
    light = radiance * count
    sums[pixel] = sums[pixel] + light
    moment1[pixel] = moment1[pixel] + light
    moment2[pixel] = moment2[pixel] + wp.cw_mul(light, radiance)


# Thread: a pixel. Adds the light that its surface reflects in the current camera sample.
@wp.kernel
def shade_transfer(
    first: wp.int32,
    scene: SceneData,
    settings: PassSettings,
    rows: TransferRows,
    sky: TransferSky,
    query: TransferQuery,
    hits: PrimaryHits,
    buffers: TransferBuffers,
):
    p = tiled_pixel(first + wp.tid(), buffers.width)
    if p[0] >= buffers.width or p[1] >= buffers.height:
        return
    pixel = p[1] * buffers.width + p[0]
    face = hits.face[pixel]
    if face < 0:
        return
    direction = hits.direction[pixel]
    s = surface_at(scene, face, hits.u[pixel], hits.v[pixel], -direction)
    at = surface_slots(rows, scene, s, face, hits.u[pixel], hits.v[pixel])
    if query.traces != 0 and is_traced(query, s, at):
        return
    count = wp.float32(settings.sample_count)
    if (query.terms & WANTS_ENVIRONMENT) != 0:
        light = diffuse_radiance(rows, sky, s, at)
        if s.bsdf.f90 > 0.0:
            light = light + glossy_radiance(rows, sky, query.ratio_below, s, at, -direction)
        light = wp.max(light, wp.vec3(0.0, 0.0, 0.0))
        if sky.sun_count > 0:
            u = sun_point(settings, p, query.soft)
            light = light + sun_radiance(scene, sky, s, s.bsdf, wp.transpose(s.shading) * -direction, u)
        b = buffers
        add_equal(b.environment, b.environment_moment1, b.environment_moment2, pixel, light, count)
    if (query.terms & WANTS_INDIRECT) != 0:
        light = wp.cw_mul(view_reflectance(sky, s, -direction), bounced_irradiance(rows, sky, at)) / wp.pi
        add_equal(buffers.indirect, buffers.indirect_moment1, buffers.indirect_moment2, pixel, light, count)
