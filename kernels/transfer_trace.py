"""Light of pixels for which transfer textures are not enough: lobes too sharp for them, and surfaces without texels.

What moves has no texels; its light is path traced, and paths end in the textures after one bounce. Of a sharp lobe
rays are traced: what they meet is lit by the textures.
"""

import warp as wp

from warp_gi.kernels.atlas import SlotFetch
from warp_gi.kernels.bsdf import average_reflectance, diffuse_share, lambert, specular_sample
from warp_gi.kernels.bvh import BvhHit, bvh_intersect
from warp_gi.kernels.gbuffer import PassSettings, PrimaryHits, tiled_pixel
from warp_gi.kernels.path_samplers import ALIAS_LIGHTS, BSDF_DIRECTIONS, NO_REGIONS, SCENE_SKY
from warp_gi.kernels.path_trace import (
    NO_PATH,
    TERM_EMITTERS,
    TERM_ENVIRONMENT,
    TERM_INDIRECT,
    PathSettings,
    path_tracer,
)
from warp_gi.kernels.sampling import (
    TRANSFER_HIT_SUN_DIMENSION,
    TRANSFER_LOBE_DIMENSION,
    pixel_sample_index,
    pixel_seed,
    sample_2d,
)
from warp_gi.kernels.surface import Surface, ray_origin, surface_at
from warp_gi.kernels.transfer_light import (
    TRANSFER_CACHE,
    TransferCache,
    bounced_irradiance,
    diffuse_radiance,
    is_kept,
    sky_irradiance,
    sun_radiance,
    surface_slots,
)
from warp_gi.kernels.transfer_shade import (
    WANTS_ENVIRONMENT,
    WANTS_INDIRECT,
    TransferBuffers,
    TransferQuery,
    add_equal,
    is_traced,
    sun_point,
)
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

TRACER = path_tracer(ALIAS_LIGHTS, BSDF_DIRECTIONS, NO_REGIONS, SCENE_SKY, TRANSFER_CACHE, tints=True)
TransferSamplers = TRACER.samplers
trace_path = TRACER.trace_path

UP = wp.constant(wp.vec3(0.0, 0.0, 1.0))


# Light of one sample.
@wp.struct
class TracedLight:
    environment: wp.vec3
    indirect: wp.vec3


# Radiance that leaves what a ray meets: light of the sky and of lamps that was reflected there. Suns are discs if soft.
@wp.func
def leaving_radiance(
    scene: SceneData,
    samplers: TransferSamplers,
    paths: PathSettings,
    hit: BvhHit,
    direction: wp.vec3,
    soft: wp.int32,
    index: wp.uint32,
    seed: wp.uint32,
) -> wp.vec3:
    s = surface_at(scene, hit.face, hit.u, hit.v, -direction)
    at = surface_slots(samplers.cache.rows, scene, s, hit.face, hit.u, hit.v)
    wanted = paths
    wanted.terms = TERM_EMITTERS
    if not is_kept(at):
        wanted.terms = TERM_ENVIRONMENT | TERM_EMITTERS | TERM_INDIRECT
    light = wp.vec3(0.0, 0.0, 0.0)
    if scene.emitters.count > 0 or not is_kept(at):
        r = trace_path(scene, samplers, hit, s, -direction, wanted, index, seed, NO_PATH)
        light = r.environment + r.emitters + r.indirect
    if not is_kept(at):
        return light
    sky = samplers.cache.sky
    rows = samplers.cache.rows
    irradiance = sky_irradiance(rows, sky, at) + bounced_irradiance(rows, sky, at)
    light = light + wp.cw_mul(average_reflectance(s.bsdf), irradiance) / wp.pi
    if sky.sun_count > 0:
        u = wp.vec2(0.0, 0.0)
        if soft != 0:
            u = sample_2d(index, seed, TRANSFER_HIT_SUN_DIMENSION)
        light = light + sun_radiance(scene, sky, s, lambert(average_reflectance(s.bsdf)), UP, u)
    return light


# Light over other surfaces that a ray of the glossy lobe brings.
@wp.func
def lobe_light(
    scene: SceneData,
    samplers: TransferSamplers,
    paths: PathSettings,
    s: Surface,
    wo: wp.vec3,
    soft: wp.int32,
    index: wp.uint32,
    seed: wp.uint32,
) -> wp.vec3:
    b = specular_sample(s.bsdf, wo, sample_2d(index, seed, TRANSFER_LOBE_DIMENSION))
    if b.pdf <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    wi = s.shading * b.wi
    if wp.dot(wi, s.normal) <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    hit = bvh_intersect(scene.bvh, ray_origin(s), wi, float(wp.inf))
    if hit.face < 0:
        return wp.vec3(0.0, 0.0, 0.0)
    return wp.cw_mul(b.weight, leaving_radiance(scene, samplers, paths, hit, wi, soft, index, seed))


# Light of a sharp surface's diffuse lobe, which needs no ray but to suns.
@wp.func
def diffuse_light(scene: SceneData, cache: TransferCache, s: Surface, at: SlotFetch, u: wp.vec2) -> TracedLight:
    r = TracedLight()
    r.environment = diffuse_radiance(cache.rows, cache.sky, s, at)
    diffuse = wp.cw_mul(diffuse_share(s.bsdf), s.bsdf.diffuse)
    if cache.sky.sun_count > 0:
        r.environment = r.environment + sun_radiance(scene, cache.sky, s, lambert(diffuse), UP, u)
    r.indirect = wp.cw_mul(diffuse, bounced_irradiance(cache.rows, cache.sky, at)) / wp.pi
    return r


# One sample of a pixel where rays are traced. The glossy lobe's own light from the sky is that of a path of one bounce
# on a surface without the diffuse lobe: sky samples and directions of the lobe share it.
@wp.func
def traced_light(
    scene: SceneData,
    samplers: TransferSamplers,
    paths: PathSettings,
    query: TransferQuery,
    hit: BvhHit,
    s: Surface,
    view: wp.vec3,
    index: wp.uint32,
    seed: wp.uint32,
) -> TracedLight:
    r = TracedLight()
    start = s
    wanted = paths
    if query.sharp != 0:
        start.bsdf.diffuse = wp.vec3(0.0, 0.0, 0.0)
        start.base_color = wp.vec3(0.0, 0.0, 0.0)
        wanted.terms = TERM_ENVIRONMENT
    if query.sharp == 0 or (query.terms & WANTS_ENVIRONMENT) != 0:
        path = trace_path(scene, samplers, hit, start, view, wanted, index, seed, NO_PATH)
        r.environment = path.environment
        r.indirect = path.indirect
    if query.sharp != 0 and (query.terms & WANTS_INDIRECT) != 0:
        r.indirect = lobe_light(scene, samplers, paths, s, wp.transpose(s.shading) * view, query.soft, index, seed)
    return r


# Thread: a pixel. Adds the samples of the current camera sample, where rays are traced.
@wp.kernel
def trace_transfer(
    first: wp.int32,
    scene: SceneData,
    settings: PassSettings,
    samplers: TransferSamplers,
    paths: PathSettings,
    query: TransferQuery,
    hits: PrimaryHits,
    buffers: TransferBuffers,
):
    p = tiled_pixel(first + wp.tid(), buffers.width)
    if p[0] >= buffers.width or p[1] >= buffers.height:
        return
    pixel = p[1] * buffers.width + p[0]
    hit = BvhHit()
    hit.face = hits.face[pixel]
    if hit.face < 0:
        return
    hit.u = hits.u[pixel]
    hit.v = hits.v[pixel]
    view = -hits.direction[pixel]
    s = surface_at(scene, hit.face, hit.u, hit.v, view)
    at = surface_slots(samplers.cache.rows, scene, s, hit.face, hit.u, hit.v)
    if not is_traced(query, s, at):
        return
    known = TracedLight()
    wanted = query
    wanted.sharp = int(is_kept(at))
    if wanted.sharp != 0:
        known = diffuse_light(scene, samplers.cache, s, at, sun_point(settings, p, query.soft))
    seed = pixel_seed(p[0], p[1], settings.sample_bits, settings.seed)
    b = buffers
    for i in range(settings.sample_count):
        index = pixel_sample_index(p[0], p[1], settings.first_sample + i, settings.sample_bits)
        light = traced_light(scene, samplers, paths, wanted, hit, s, view, index, seed)
        if (query.terms & WANTS_ENVIRONMENT) != 0:
            sum = known.environment + light.environment
            add_equal(b.environment, b.environment_moment1, b.environment_moment2, pixel, sum, 1.0)
        if (query.terms & WANTS_INDIRECT) != 0:
            sum = known.indirect + light.indirect
            add_equal(b.indirect, b.indirect_moment1, b.indirect_moment2, pixel, sum, 1.0)
