"""The reference: unidirectional path tracing with next-event estimation at every vertex.

Each path samples the sky and one emitter as well as the BSDF at every vertex, combined by
the balance heuristic. Of a strategy pair with pdfs p (light) and q (BSDF) the light sample
counts (f L / p) * p / (p + q) = f L / (p + q), the BSDF sample (f L / q) * q / (p + q).
One launch serves every term that a pipeline leaves to path tracing: the ray that continues
a path is also the BSDF sample of the direct terms. A constant sky is left to BSDF sampling
alone, which is better than any mixture for it.
"""

import warp as wp

from warp_gi.kernels.bsdf import bsdf_evaluate, bsdf_sample, bsdf_weight
from warp_gi.kernels.bvh import BvhHit, bvh_intersect, bvh_occluded
from warp_gi.kernels.emitters import may_hit_emitter, sample_emitter, triangle_light_pdf
from warp_gi.kernels.environment import (
    environment_lookup,
    environment_prefetch,
    environment_radiance,
    environment_sample,
)
from warp_gi.kernels.gbuffer import CameraData, PassSettings, PrimaryHits, tiled_pixel
from warp_gi.kernels.sampling import balance, pixel_sample_index, pixel_seed, random_1d, sample_1d, sample_2d
from warp_gi.kernels.surface import (
    Surface,
    ray_origin,
    surface_at,
    surface_emission,
    surface_prefetch,
    surface_shape,
    with_color,
)
from warp_gi.kernels.types import ENVIRONMENT_MAP, ENVIRONMENT_NONE, SceneData

wp.set_module_options({"enable_backward": False})

TERM_ENVIRONMENT = wp.constant(1)
TERM_EMITTERS = wp.constant(2)
TERM_INDIRECT = wp.constant(4)
SHADOW_END = wp.constant(wp.float32(0.9999))  # share of the way to an emitter that must be free
DIMENSIONS = wp.constant(8)  # dimension pairs a vertex may use; pair 0 is the camera's


@wp.struct
class PathSettings:
    terms: wp.int32  # TERM_* to estimate
    max_depth: wp.int32  # edges of the longest path, camera to light: 2 is direct light
    roulette_depth: wp.int32  # depth from which paths end at random
    sky_probability: wp.float32  # of sampling the sky, not an emitter, where a vertex samples one of the two
    clamp: wp.float32  # largest component of a path's indirect radiance; 0: no limit


# Radiance of one path, by term.
@wp.struct
class PathRadiance:
    environment: wp.vec3
    emitters: wp.vec3
    indirect: wp.vec3


# Sums over samples, [height * width].
@wp.struct
class PathBuffers:
    environment: wp.array(dtype=wp.vec3)
    emitters: wp.array(dtype=wp.vec3)
    indirect: wp.array(dtype=wp.vec3)
    moment1: wp.array(dtype=wp.vec3)  # of the samples of beauty
    moment2: wp.array(dtype=wp.vec3)  # of their squares


# Light sample of the sky, weighted; `share` is the probability that it is taken.
@wp.func
def sky_light(scene: SceneData, s: Surface, wo: wp.vec3, u: wp.vec3, share: wp.float32) -> wp.vec3:
    e = environment_sample(scene.environment, u)
    if e.pdf <= 0.0 or wp.dot(e.direction, s.normal) <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    f = bsdf_evaluate(s.bsdf, wo, wp.transpose(s.shading) * e.direction)
    if f.pdf <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    if bvh_occluded(scene.bvh, ray_origin(s), e.direction, float(wp.inf)):
        return wp.vec3(0.0, 0.0, 0.0)
    return wp.cw_mul(f.value, environment_radiance(scene.environment, e.direction)) / (e.pdf * share + f.pdf)


# Light sample of one emitter, weighted; `share` is the probability that it is taken.
@wp.func
def emitter_light(
    scene: SceneData, s: Surface, wo: wp.vec3, u_select: wp.vec2, u: wp.vec2, share: wp.float32
) -> wp.vec3:
    origin = ray_origin(s)
    e = sample_emitter(scene, origin, u_select, u)
    if e.pdf <= 0.0 or wp.dot(e.direction, s.normal) <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    f = bsdf_evaluate(s.bsdf, wo, wp.transpose(s.shading) * e.direction)
    if f.pdf <= 0.0 or wp.max(e.radiance) <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    if bvh_occluded(scene.bvh, origin, e.direction, e.distance * SHADOW_END):
        return wp.vec3(0.0, 0.0, 0.0)
    if e.delta != 0:
        return wp.cw_mul(f.value, e.radiance) / share
    return wp.cw_mul(f.value, e.radiance) / (e.pdf * share + f.pdf)


# Numbers for light samples: stratified where the camera looks, merely random further along a path,
# where directions that scatter leave little of a stratification to keep.
@wp.func
def light_1d(index: wp.uint32, seed: wp.uint32, dimension: wp.int32, at_first: wp.bool) -> wp.float32:
    if at_first:
        return sample_1d(index, seed, dimension)
    return random_1d(index, seed, dimension + 4096)


@wp.func
def light_2d(index: wp.uint32, seed: wp.uint32, dimension: wp.int32, at_first: wp.bool) -> wp.vec2:
    if at_first:
        return sample_2d(index, seed, dimension)
    return wp.vec2(random_1d(index, seed, dimension + 4096), random_1d(index, seed, dimension + 8192))


# Follows one path from the first hit `surface`, seen from direction `towards_camera`.
@wp.func
def trace_path(
    scene: SceneData, surface: Surface, towards_camera: wp.vec3, paths: PathSettings, index: wp.uint32, seed: wp.uint32
) -> PathRadiance:
    r = PathRadiance()
    s = surface
    view = towards_camera
    throughput = wp.vec3(1.0, 1.0, 1.0)
    has_sky_map = scene.environment.kind == ENVIRONMENT_MAP
    for depth in range(2, paths.max_depth + 1):
        at_first = depth == 2
        d = 1 + (depth - 2) * DIMENSIONS
        wo = wp.transpose(s.shading) * view
        # which lights to sample: both at the first vertex, where they are two terms; else one of them
        sky_share = paths.sky_probability
        emitter_share = 1.0 - sky_share
        wants_sky = has_sky_map
        wants_emitter = scene.emitters.count > 0
        u_select = wp.vec2(0.0, 0.0)
        if wants_emitter:
            u_select = wp.vec2(light_1d(index, seed, d, at_first), random_1d(index, seed, d))
        if at_first:
            sky_share = 1.0
            emitter_share = 1.0
            wants_sky = has_sky_map and (paths.terms & TERM_ENVIRONMENT) != 0
            wants_emitter = wants_emitter and (paths.terms & TERM_EMITTERS) != 0
        elif u_select[0] < sky_share:
            wants_emitter = False
        else:
            wants_sky = False
            u_select = wp.vec2((u_select[0] - sky_share) / emitter_share, u_select[1])
        u_sky = wp.vec3(0.0, 0.0, 0.0)
        if wants_sky:
            u2 = light_2d(index, seed, d + 1, at_first)
            u_sky = wp.vec3(u2[0], u2[1], random_1d(index, seed, d + 2))
            environment_prefetch(scene.environment, u_sky)

        # BSDF sampling: ends the path at a light, or continues it
        is_last = depth == paths.max_depth or (at_first and (paths.terms & TERM_INDIRECT) == 0)
        sees_sky = scene.environment.kind != ENVIRONMENT_NONE
        sees_emitters = scene.emitters.count > 0
        if at_first:
            sees_sky = sees_sky and (paths.terms & TERM_ENVIRONMENT) != 0
            sees_emitters = sees_emitters and (paths.terms & TERM_EMITTERS) != 0
        u_lobe = float(0.0)
        if s.bsdf.f90 > 0.0:
            u_lobe = sample_1d(index, seed, d + 4)
        b = bsdf_sample(s.bsdf, wo, u_lobe, sample_2d(index, seed, d + 5))
        wi = s.shading * b.wi
        goes_on = b.pdf > 0.0 and wp.dot(wi, s.normal) > 0.0
        hit = BvhHit()
        hit.face = -1
        if goes_on:
            origin = ray_origin(s)
            if is_last and sees_emitters:
                sees_emitters = may_hit_emitter(scene.emitters, origin, wi)
            if is_last and not sees_sky and not sees_emitters:
                goes_on = False
            elif is_last and not sees_emitters:
                goes_on = not bvh_occluded(scene.bvh, origin, wi, float(wp.inf))
            else:
                hit = bvh_intersect(scene.bvh, origin, wi, float(wp.inf))
                if hit.face >= 0:
                    surface_prefetch(scene.geometry, hit.face)

        if goes_on or wants_sky or wants_emitter:
            s = with_color(scene, s)
        # light sampling; after the ray above, which gives memory the time to answer the prefetches
        if wants_sky:
            light = sky_light(scene, s, wo, u_sky, sky_share)
            if at_first:
                r.environment = light
            else:
                r.indirect = r.indirect + wp.cw_mul(throughput, light)
        if wants_emitter:
            light = emitter_light(scene, s, wo, u_select, light_2d(index, seed, d + 3, at_first), emitter_share)
            if at_first:
                r.emitters = light
            else:
                r.indirect = r.indirect + wp.cw_mul(throughput, light)
        if not goes_on:
            break
        throughput = wp.cw_mul(throughput, bsdf_weight(s.bsdf, b))
        if hit.face < 0:
            if sees_sky:
                sky = environment_lookup(scene.environment, wi)
                light = wp.cw_mul(throughput, sky.radiance)
                if has_sky_map:
                    light = light * balance(b.pdf, sky_share * sky.pdf)
                if at_first:
                    r.environment = r.environment + light
                else:
                    r.indirect = r.indirect + light
            break
        emitter = scene.geometry.emitters[hit.face]
        if sees_emitters and emitter >= 0:
            light = wp.cw_mul(throughput, surface_emission(scene, hit.face, hit.u, hit.v, -wi))
            pdf = triangle_light_pdf(scene, emitter, hit.face, wi, hit.t)
            light = light * balance(b.pdf, emitter_share * pdf)
            if at_first:
                r.emitters = r.emitters + light
            else:
                r.indirect = r.indirect + light
        if is_last:
            break
        if depth >= paths.roulette_depth:
            survival = wp.min(wp.max(throughput), 0.95)
            if random_1d(index, seed, d + 6) >= survival:
                break
            throughput = throughput / survival
        view = -wi
        s = surface_shape(scene, hit.face, hit.u, hit.v, view)
    return r


# Thread: a pixel. Adds `sample_count` paths from its current camera sample.
@wp.kernel
def trace_paths(
    first: wp.int32,
    scene: SceneData,
    camera: CameraData,
    settings: PassSettings,
    paths: PathSettings,
    hits: PrimaryHits,
    buffers: PathBuffers,
):
    p = tiled_pixel(first + wp.tid(), camera.width)
    if p[0] >= camera.width or p[1] >= camera.height:
        return
    pixel = p[1] * camera.width + p[0]
    face = hits.face[pixel]
    direction = hits.direction[pixel]
    count = wp.float32(settings.sample_count)
    if face < 0:
        sky = environment_radiance(scene.environment, direction)
        buffers.moment1[pixel] = buffers.moment1[pixel] + sky * count
        buffers.moment2[pixel] = buffers.moment2[pixel] + wp.cw_mul(sky, sky) * count
        return
    emission = surface_emission(scene, face, hits.u[pixel], hits.v[pixel], -direction)
    if paths.terms == 0:
        buffers.moment1[pixel] = buffers.moment1[pixel] + emission * count
        buffers.moment2[pixel] = buffers.moment2[pixel] + wp.cw_mul(emission, emission) * count
        return
    s = surface_at(scene, face, hits.u[pixel], hits.v[pixel], -direction)
    seed = pixel_seed(p[0], p[1], settings.sample_bits, settings.seed)
    environment = wp.vec3(0.0, 0.0, 0.0)
    emitters = wp.vec3(0.0, 0.0, 0.0)
    indirect = wp.vec3(0.0, 0.0, 0.0)
    moment1 = wp.vec3(0.0, 0.0, 0.0)
    moment2 = wp.vec3(0.0, 0.0, 0.0)
    first_index = pixel_sample_index(p[0], p[1], settings.first_sample, settings.sample_bits)
    for i in range(settings.sample_count):
        r = trace_path(scene, s, -direction, paths, first_index + wp.uint32(i), seed)
        brightest = wp.max(r.indirect)
        if paths.clamp > 0.0 and brightest > paths.clamp:
            r.indirect = r.indirect * (paths.clamp / brightest)
        environment = environment + r.environment
        emitters = emitters + r.emitters
        indirect = indirect + r.indirect
        beauty = emission + r.environment + r.emitters + r.indirect
        moment1 = moment1 + beauty
        moment2 = moment2 + wp.cw_mul(beauty, beauty)
    buffers.environment[pixel] = buffers.environment[pixel] + environment
    buffers.emitters[pixel] = buffers.emitters[pixel] + emitters
    buffers.indirect[pixel] = buffers.indirect[pixel] + indirect
    buffers.moment1[pixel] = buffers.moment1[pixel] + moment1
    buffers.moment2[pixel] = buffers.moment2[pixel] + moment2
