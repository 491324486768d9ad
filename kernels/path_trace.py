"""The reference: unidirectional path tracing with next-event estimation at every vertex.

Each path samples the sky and one emitter as well as the BSDF at every vertex, combined by
the balance heuristic. Of a strategy pair with pdfs p (light) and q (BSDF) the light sample
counts (f L / p) * p / (p + q) = f L / (p + q), the BSDF sample (f L / q) * q / (p + q).
One launch serves every term that a pipeline leaves to path tracing: the ray that continues
a path is also the BSDF sample of the direct terms. A constant sky is left to BSDF sampling
alone, which is better than any mixture for it.

Which light to sample and which way to go on is up to samplers (path_samplers.py), and so is what
the sky does with a path that leaves, and whether a path may end in what is known of the light at a
vertex; for each combination there is a kernel, in a Warp module of its own. Where a sampler is
better than the BSDF at choosing directions, read "direction sample" for "BSDF sample" above.
"""

import functools
from typing import Any, NamedTuple

import warp as wp

from warp_gi.kernels.bsdf import diffuse_part, luminance
from warp_gi.kernels.bvh import BvhHit, bvh_intersect, bvh_occluded
from warp_gi.kernels.denoise import LEAST_REFLECTANCE, divided
from warp_gi.kernels.emitters import hit_light_pdf, may_hit_emitter
from warp_gi.kernels.gbuffer import CameraData, PassSettings, PrimaryHits, tiled_pixel
from warp_gi.kernels.light_connections import (
    connect_direction,
    connect_emitter,
    connect_light,
    explore_2d,
    explore_3d,
    light_1d,
    light_2d,
)
from warp_gi.kernels.panes import glass_tint, has_panes
from warp_gi.kernels.path_samplers import (
    ALIAS_LIGHTS,
    BSDF_DIRECTIONS,
    NO_CACHE,
    NO_REGIONS,
    SCENE_SKY,
    DirectionSampler,
    LightSampler,
    PathCache,
    Regions,
    Sky,
    no_light,
    no_lobe,
    sample_weight,
)
from warp_gi.kernels.sampling import (
    APART_DIMENSION,
    CACHE_DIMENSION,
    CACHE_LOBE_DIMENSION,
    CACHE_PLACE_DIMENSION,
    DIRECTION_DIMENSION,
    EMITTER_DIMENSION,
    LIGHT_DIMENSION,
    PATH_DIMENSION,
    ROULETTE_DIMENSION,
    SKY_DIGITS_DIMENSION,
    SKY_DIMENSION,
    VERTEX_DIMENSIONS,
    balance,
    pixel_sample_index,
    pixel_seed,
    random_1d,
    sample_2d,
)
from warp_gi.kernels.surface import (
    Surface,
    bare_surface,
    ray_origin,
    shading_frame,
    surface_at,
    surface_emission,
    surface_prefetch,
    surface_shape,
    with_color,
)
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

TERM_ENVIRONMENT = wp.constant(1)
TERM_EMITTERS = wp.constant(2)
TERM_INDIRECT = wp.constant(4)
NO_PATH = wp.constant(wp.int64(-1))  # number of a path of which nothing is kept
SURVIVAL = wp.constant(wp.float32(1.4))  # of roulette, times the reflectance that a path met after its first vertex
LEAST_SURVIVAL = wp.constant(wp.float32(0.05))
CACHE_VERTEX = wp.constant(2)  # PathSettings.cache_vertex unless asked for another one: after one traced bounce


@wp.struct
class PathSettings:
    terms: wp.int32  # TERM_* to estimate
    max_depth: wp.int32  # edges of the longest path, camera to light: 2 is direct light
    roulette_depth: wp.int32  # depth from which paths end at random
    sky_probability: wp.float32  # of sampling the sky, not an emitter, where a vertex samples one of the two
    clamp: wp.float32  # largest component of a path's indirect radiance; 0: no limit
    spp: wp.int32  # paths of a pixel in all of the frame
    lobes: wp.int32  # 1: light is parted by the lobe of the first vertex that reflects it
    cache_vertex: wp.int32  # from which on paths may end in a radiance cache: 1 is the first hit; unused without one
    hides_sky: wp.float32  # 1: pictures have no background


# Radiance of one path, by term; and by the lobe of the first vertex that reflects it, if asked for, but for what a
# radiance cache knows there. Diffuse light of lights that are apart is in `apart` only.
@wp.struct
class PathRadiance:
    environment: wp.vec3
    emitters: wp.vec3
    indirect: wp.vec3
    diffuse: wp.vec3
    glossy: wp.vec3
    apart: wp.vec3


# Tint of a camera ray that has come a way of `t` to a point.
@wp.func
def tint_before(scene: SceneData, position: wp.vec3, direction: wp.vec3, t: wp.float32) -> wp.vec3:
    if not has_panes(scene.panes):
        return wp.vec3(1.0, 1.0, 1.0)
    return glass_tint(scene, position - direction * t, direction, t)


# The same where there is no coloured glass.
@wp.func
def no_tint(scene: SceneData, position: wp.vec3, direction: wp.vec3, t: wp.float32) -> wp.vec3:
    return wp.vec3(1.0, 1.0, 1.0)


@wp.func
def untinted(radiance: PathRadiance, scene: SceneData, tint: wp.vec3) -> PathRadiance:
    return radiance


# The radiance of a path whose first vertex is seen through coloured glass.
@wp.func
def tinted(radiance: PathRadiance, scene: SceneData, tint: wp.vec3) -> PathRadiance:
    if not has_panes(scene.panes):
        return radiance
    r = PathRadiance()
    r.environment = wp.cw_mul(radiance.environment, tint)
    r.emitters = wp.cw_mul(radiance.emitters, tint)
    r.indirect = wp.cw_mul(radiance.indirect, tint)
    r.diffuse = wp.cw_mul(radiance.diffuse, tint)
    r.glossy = wp.cw_mul(radiance.glossy, tint)
    r.apart = wp.cw_mul(radiance.apart, tint)
    return r


# Sums over samples, [height * width].
@wp.struct
class PathBuffers:
    environment: wp.array(dtype=wp.vec3)
    emitters: wp.array(dtype=wp.vec3)
    indirect: wp.array(dtype=wp.vec3)
    lobe_diffuse: wp.array(dtype=wp.vec3)  # as Frame.lobes, or empty
    lobe_glossy: wp.array(dtype=wp.vec3)
    lobe_apart: wp.array(dtype=wp.vec3)
    moment1: wp.array(dtype=wp.vec3)  # of the samples of beauty
    moment2: wp.array(dtype=wp.vec3)  # of their squares
    layer_emission: wp.array(dtype=wp.vec3)  # of this camera sample, as a mean over its layers; or empty


# The emission of the layers of a camera ray, or else that of what it met.
@wp.func
def of_layers(buffers: PathBuffers, pixel: wp.int32, drawn: wp.vec3) -> wp.vec3:
    if buffers.layer_emission.shape[0] > 0:
        return buffers.layer_emission[pixel]
    return drawn


# Adds the moments of equal samples of beauty.
@wp.func
def add_moments(buffers: PathBuffers, pixel: wp.int32, beauty: wp.vec3, count: wp.float32):
    buffers.moment1[pixel] = buffers.moment1[pixel] + beauty * count
    buffers.moment2[pixel] = buffers.moment2[pixel] + wp.cw_mul(beauty, beauty) * count


# Adds the light of a path, parted by lobes: diffuse light as it comes in.
@wp.func
def add_lobes(buffers: PathBuffers, pixel: wp.int32, s: Surface, r: PathRadiance):
    incident = divided(r.diffuse, s.bsdf.diffuse, LEAST_REFLECTANCE)
    buffers.lobe_diffuse[pixel] = buffers.lobe_diffuse[pixel] + incident
    buffers.lobe_glossy[pixel] = buffers.lobe_glossy[pixel] + r.glossy
    if buffers.lobe_apart.shape[0] > 0:
        direct = divided(r.apart, s.bsdf.diffuse, LEAST_REFLECTANCE)
        buffers.lobe_apart[pixel] = buffers.lobe_apart[pixel] + direct


class PathTracer(NamedTuple):
    """What is made for one combination of samplers."""

    samplers: Any
    """Struct of the samplers' data: lights, directions, regions, sky, cache."""
    trace_path: wp.Function
    trace_paths: wp.Kernel


def path_tracer(
    lights: LightSampler,
    directions: DirectionSampler,
    regions: Regions,
    sky: Sky = SCENE_SKY,
    cache: PathCache = NO_CACHE,
    tints: bool = False,
) -> PathTracer:
    """Return the path tracer that uses these samplers, this sky and this radiance cache; made once.

    The regions follow from the samplers (``uses_regions``). Nothing is compiled of a cache that is NO_CACHE, nor of
    records that SCENE_SKY does not keep. ``tints`` is whether the scene may have panes of coloured glass: the code for
    them costs paths that meet none 1 % of their time, and every module a fifth of its compilation.
    """
    return _made(lights, directions, regions, sky, cache, tints)


def _module_name(lights: LightSampler, directions: DirectionSampler, sky: Sky, cache: PathCache, tints: bool) -> str:
    """Return the name of a tracer's Warp module: by its samplers, and the hooks that are in use."""
    hooks = [f"sky_{sky.name}"] if sky is not SCENE_SKY else []
    hooks += [f"cache_{cache.name}"] if cache is not NO_CACHE else []
    hooks += ["tints"] if tints else []
    return "_".join([f"{__name__}.{lights.name}", directions.name, *hooks])


@functools.cache
def _made(
    lights: LightSampler, directions: DirectionSampler, regions: Regions, sky: Sky, cache: PathCache, tints: bool
) -> PathTracer:
    light_data, direction_data, region_data = lights.data, directions.data, regions.data
    holds_direct, lobe_probability = cache.holds_direct, cache.lobe or no_lobe
    sky_data, cache_data, has_cache = sky.data, cache.data, cache is not NO_CACHE
    apart, parts_lights = sky.apart, sky.apart is not None
    shades_late = cache.by_place and regions is NO_REGIONS
    first_tint, with_tint = (tint_before, tinted) if tints else (no_tint, untinted)
    explore, choices = (no_light, 1) if lights.explore is None else (lights.explore, 2)

    @wp.struct
    class Samplers:
        lights: light_data
        directions: direction_data
        regions: region_data
        sky: sky_data
        cache: cache_data

    # Follows one path from the first hit, the point `surface`, seen from direction `towards_camera`. By its number
    # `path` regions and the sky know where to keep what they record of it; NO_PATH: nowhere.
    @wp.func
    def trace_path(
        scene: SceneData,
        samplers: Samplers,
        first_hit: BvhHit,
        surface: Surface,
        towards_camera: wp.vec3,
        paths: PathSettings,
        index: wp.uint32,
        seed: wp.uint32,
        path: wp.int64,
    ) -> PathRadiance:
        r = PathRadiance()
        slot = int(-1)
        if path >= wp.int64(0):
            slot = regions.slot(samplers.regions, path)
        hit = first_hit
        s = surface
        view = towards_camera
        vertices = int(0)
        throughput = wp.vec3(1.0, 1.0, 1.0)
        # the same by the BSDF alone: roulette must not end paths for going where light was expected, which lowers it
        reflected = wp.vec3(1.0, 1.0, 1.0)
        first_reflected = float(1.0)
        samples_sky = sky.is_sampled(samplers.sky, scene)
        sharpness = float(wp.inf)
        corrects = bool(False)
        is_bare = bool(False)  # without its frame of shading yet
        # light before the way on from the first vertex, and the diffuse lobe's share of what comes from there
        before = wp.vec3(0.0, 0.0, 0.0)
        diffuse_share = wp.vec3(0.0, 0.0, 0.0)
        for depth in range(2, paths.max_depth + 1):
            at_first = depth == 2
            d = PATH_DIMENSION + (depth - 2) * VERTEX_DIMENSIONS
            wo = wp.transpose(s.shading) * view
            region = regions.find(samplers.regions, scene, s, hit.face, hit.u, hit.v)
            at = regions.at(samplers.regions, slot, vertices)
            if at >= 0:
                regions.begin(samplers.regions, at, s)
            # All but the direct light may be known here; then the path ends, whatever edges it has left. Where direct
            # light is known as well the path ends without samples of lights, or goes on by a lobe alone, or goes on to
            # correct what is known: K + (Y - K) / q for a share q of paths, else K, has the mean of Y. Learners get
            # the vertex and its light samples as ever. Of its direction they get none, not even of one that leaves for
            # the sky: nobody knows how much of what is known came from there, and skies alone would seem to be all.
            # Where direct light is known they get `begin` alone, even if a lobe is traced, whose light is not all that
            # the surface reflects; of a path that corrects what is known they get all. The vertices before it learn
            # what is known here as light that came their way, as `end` tells them all that came after their direction.
            ends = bool(False)
            if has_cache:
                if not corrects and depth > paths.cache_vertex and (not at_first or (paths.terms & TERM_INDIRECT) != 0):
                    s = with_color(scene, s)
                    u_first = random_1d(index, seed, d + CACHE_PLACE_DIMENSION)
                    u_place = wp.vec2(u_first, random_1d(index, seed, d + CACHE_PLACE_DIMENSION + 1))
                    known = cache.lookup(samplers.cache, scene, s, wo, hit, sharpness, u_place)
                    ends = known.validity >= 1.0
                    if known.validity > 0.0 and not ends:
                        ends = random_1d(index, seed, d + CACHE_DIMENSION) < known.validity
                    if ends:
                        r.indirect = r.indirect + wp.cw_mul(throughput, known.radiance)
                    if shades_late:
                        is_read = ends and known.follow <= 0.0 and lobe_probability(samplers.cache, s, wo) <= 0.0
                        if is_bare and not is_read:
                            s.shading = shading_frame(scene, hit.face, hit.u, hit.v, s.uv, view)
                            wo = wp.transpose(s.shading) * view
                        is_bare = False
                    if holds_direct:
                        if ends:
                            goes = lobe_probability(samplers.cache, s, wo)
                            corrects = known.follow > 0.0
                            if corrects:
                                goes = wp.max(goes, known.follow)
                            if random_1d(index, seed, d + CACHE_LOBE_DIMENSION) >= goes:
                                vertices += 1
                                break
                            ends = False
                            throughput = throughput / goes
                            reflected = reflected / goes
                            if corrects:
                                r.indirect = r.indirect - wp.cw_mul(throughput, known.radiance)
                            else:
                                s.bsdf.diffuse = wp.vec3(0.0, 0.0, 0.0)
                                at = -1
            # which lights to sample: both at the first vertex, where they are two terms; else one of them
            sky_share = paths.sky_probability
            emitter_share = 1.0 - sky_share
            wants_sky = samples_sky
            wants_emitter = scene.emitters.count > 0
            u_select = wp.vec2(0.0, 0.0)
            if wants_emitter:
                u_choice = light_1d(index, seed, d + LIGHT_DIMENSION, at_first)
                u_select = wp.vec2(u_choice, random_1d(index, seed, d + LIGHT_DIMENSION))
            if at_first:
                sky_share = 1.0
                emitter_share = 1.0
                wants_sky = samples_sky and (paths.terms & TERM_ENVIRONMENT) != 0
                wants_emitter = wants_emitter and (paths.terms & TERM_EMITTERS) != 0
                if parts_lights:
                    wants_emitter = wants_emitter and not apart.holds_emitters(samplers.sky)
            elif u_select[0] < sky_share:
                wants_emitter = False
            else:
                wants_sky = False
                u_select = wp.vec2((u_select[0] - sky_share) / emitter_share, u_select[1])
            u_sky = wp.vec3(0.0, 0.0, 0.0)
            if wants_sky:
                u2 = light_2d(index, seed, d + SKY_DIMENSION, at_first)
                u_sky = wp.vec3(u2[0], u2[1], random_1d(index, seed, d + SKY_DIGITS_DIMENSION))
                sky.prefetch(samplers.sky, scene, u_sky, at_first)

            # the way on: ends the path at a light, or continues it
            is_last = ends or depth == paths.max_depth or (at_first and (paths.terms & TERM_INDIRECT) == 0)
            sees_sky = sky.is_lit(samplers.sky, scene)
            sees_emitters = scene.emitters.count > 0
            if at_first:
                sees_sky = sees_sky and (paths.terms & TERM_ENVIRONMENT) != 0
                sees_emitters = sees_emitters and (paths.terms & TERM_EMITTERS) != 0
            b = directions.sample(samplers.directions, region, s, wo, index, seed, d + DIRECTION_DIMENSION)
            wi = b.wi
            goes_on = b.pdf > 0.0 and wp.dot(wi, s.normal) > 0.0
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
            if parts_lights:
                if at_first:
                    for k in range(apart.count(samplers.sky)):
                        from_sky = apart.is_sky(samplers.sky, k)
                        u_apart = wp.vec2(0.0, 0.0)
                        if from_sky:
                            u_apart = sample_2d(index, seed, APART_DIMENSION + k)
                        beam = apart.sample(samplers.sky, scene, ray_origin(s), k, u_apart)
                        ray = connect_light(scene, s, wo, ray_origin(s), beam)
                        if ray.arrives > 0:
                            if tints:
                                if has_panes(scene.panes):
                                    tint = glass_tint(scene, ray_origin(s), ray.direction, ray.distance)
                                    ray.reflected = wp.cw_mul(ray.reflected, tint)
                            part = diffuse_part(s.bsdf, wo, wp.transpose(s.shading) * ray.direction)
                            by_diffuse = wp.cw_mul(part, ray.reflected)
                            by_glossy = ray.reflected - by_diffuse
                            if ray.delta == 0:
                                pdf = directions.pdf(samplers.directions, region, s, ray.direction, ray.bsdf_pdf)
                                by_glossy = by_glossy * balance(ray.pdf, pdf)
                            r.apart = r.apart + by_diffuse
                            r.glossy = r.glossy + by_glossy
                            if from_sky:
                                r.environment = r.environment + by_diffuse + by_glossy
                            else:
                                r.emitters = r.emitters + by_diffuse + by_glossy
            if wants_sky:
                sky_sample = sky.sample(samplers.sky, scene, u_sky, at_first)
                way = connect_direction(scene, s, wo, sky_sample.direction)
                if way.arrives != 0:
                    if tints:
                        if has_panes(scene.panes):
                            tint = glass_tint(scene, ray_origin(s), way.direction, float(wp.inf))
                            way.scattered = wp.cw_mul(way.scattered, tint)
                    source = sky.arrival(samplers.sky, scene, sky_sample, at_first)
                    if source.pdf > 0.0:
                        pdf = directions.pdf(samplers.directions, region, s, way.direction, way.bsdf_pdf)
                        scattered = way.scattered / (source.pdf * sky_share + pdf)
                        light = wp.cw_mul(scattered, source.radiance)
                        if path >= wp.int64(0):
                            sky.leave(samplers.sky, path, depth, way.direction, wp.cw_mul(throughput, scattered))
                        if at_first:
                            r.environment = r.environment + light
                            if paths.lobes != 0:
                                part = diffuse_part(s.bsdf, wo, wp.transpose(s.shading) * way.direction)
                                r.diffuse = r.diffuse + wp.cw_mul(part, light)
                                r.glossy = r.glossy + light - wp.cw_mul(part, light)
                        else:
                            r.indirect = r.indirect + wp.cw_mul(throughput, light)
            if wants_emitter:
                choice = lights.choose(samplers.lights, scene, region, s, wo, u_select)
                u_point = light_2d(index, seed, d + EMITTER_DIMENSION, at_first)
                for turn in range(int(choices)):
                    if turn > 0:
                        u_explore = explore_3d(index, seed, d)
                        choice = explore(samplers.lights, scene, region, s, wo, u_explore)
                        u_point = explore_2d(index, seed, d)
                    if choice.item >= 0:
                        sample = connect_emitter(scene, s, wo, choice, u_point)
                        light = wp.vec3(0.0, 0.0, 0.0)
                        if sample.arrives > 0:
                            if tints:
                                if has_panes(scene.panes):
                                    tint = glass_tint(scene, ray_origin(s), sample.direction, sample.distance)
                                    sample.reflected = wp.cw_mul(sample.reflected, tint)
                            light = sample.reflected * (choice.weight / emitter_share)
                            choice.selected = 1.0
                            if sample.delta == 0:
                                pdf = directions.pdf(samplers.directions, region, s, sample.direction, sample.bsdf_pdf)
                                by_light = sample.pdf * emitter_share
                                light = sample.reflected * (choice.weight / (by_light + pdf))
                                choice.selected = by_light / (by_light + pdf)
                        if at_first:
                            r.emitters = r.emitters + light
                            if paths.lobes != 0:
                                part = diffuse_part(s.bsdf, wo, wp.transpose(s.shading) * sample.direction)
                                r.diffuse = r.diffuse + wp.cw_mul(part, light)
                                r.glossy = r.glossy + light - wp.cw_mul(part, light)
                        else:
                            light = wp.cw_mul(throughput, light)
                            r.indirect = r.indirect + light
                        if at >= 0:
                            regions.light(samplers.regions, at, choice, sample.arrives, luminance(light))
            if at_first and paths.lobes != 0:
                before = r.environment + r.emitters + r.indirect
                if goes_on:
                    diffuse_share = diffuse_part(s.bsdf, wo, wp.transpose(s.shading) * wi)
            if not goes_on:
                vertices += 1
                break
            carried = luminance(throughput)
            throughput = wp.cw_mul(throughput, sample_weight(s.bsdf, b.weight))
            if tints:
                if has_panes(scene.panes):
                    t_hit = float(wp.inf)
                    if hit.face >= 0:
                        t_hit = hit.t
                    throughput = wp.cw_mul(throughput, glass_tint(scene, ray_origin(s), wi, t_hit))
            reflected = wp.cw_mul(reflected, sample_weight(s.bsdf, b.reflected))
            if at_first:
                first_reflected = wp.max(reflected)
            if hit.face < 0:
                if at >= 0 and not ends:
                    regions.direction(samplers.regions, at, b, 0.0, carried, luminance(r.environment + r.indirect))
                vertices += 1
                if sees_sky:
                    beyond = sky.lookup(samplers.sky, scene, wi, at_first)
                    light = wp.cw_mul(throughput, beyond.radiance)
                    share = float(1.0)
                    if samples_sky:
                        share = balance(b.pdf, sky_share * beyond.pdf)
                        light = light * share
                    if path >= wp.int64(0):
                        sky.leave(samplers.sky, path, depth, wi, throughput * share)
                    if at_first:
                        r.environment = r.environment + light
                        if parts_lights:
                            lamp = apart.lookup(samplers.sky, scene, wi)
                            if lamp.pdf > 0.0:
                                light = wp.cw_mul(throughput, lamp.radiance) * balance(b.pdf, lamp.pdf)
                                light = light - wp.cw_mul(diffuse_share, light)
                                r.environment = r.environment + light
                                r.glossy = r.glossy + light
                                before = before + light
                    else:
                        r.indirect = r.indirect + light
                break
            emitter = scene.geometry.emitters[hit.face]
            if sees_emitters and emitter >= 0:
                light = wp.cw_mul(throughput, surface_emission(scene, hit.face, hit.u, hit.v, -wi))
                pdf = hit_light_pdf(scene, emitter, hit.face, hit.u, hit.v, wi, hit.t)
                pdf = pdf * lights.pdf(samplers.lights, scene, region, s, wo, emitter)
                light = light * balance(b.pdf, emitter_share * pdf)
                if at_first:
                    r.emitters = r.emitters + light
                else:
                    r.indirect = r.indirect + light
            if at >= 0 and not is_last:
                light = r.environment + r.indirect
                regions.direction(samplers.regions, at, b, 1.0 / hit.t, carried, luminance(light))
            vertices += 1
            if is_last:
                break
            # A pixel is as bright as its first vertex reflects, and noise counts by that: so the first vertex cancels.
            if depth >= paths.roulette_depth:
                survival = SURVIVAL * wp.max(reflected) / wp.max(first_reflected, 1.0e-30)
                survival = wp.clamp(survival, LEAST_SURVIVAL, 1.0)
                if random_1d(index, seed, d + ROULETTE_DIMENSION) >= survival:
                    break
                throughput = throughput / survival
                reflected = reflected / survival
            if has_cache:
                sharpness = wp.min(sharpness, b.pdf)
            view = -wi
            if shades_late:
                is_bare = not corrects and depth >= paths.cache_vertex
            if is_bare:
                s = bare_surface(scene, hit.face, hit.u, hit.v, view, 0)
            else:
                s = surface_shape(scene, hit.face, hit.u, hit.v, view)
        if slot >= 0:
            regions.end(samplers.regions, slot, vertices, luminance(r.environment + r.indirect))
        if paths.lobes != 0:
            after = r.environment + r.emitters + r.indirect - before
            by_diffuse = wp.cw_mul(diffuse_share, after)
            r.diffuse = r.diffuse + by_diffuse
            r.glossy = r.glossy + after - by_diffuse
        return r

    # Thread: a pixel. Adds `sample_count` paths from its current camera sample.
    @wp.kernel(module=wp.get_module(_module_name(lights, directions, sky, cache, tints)), enable_backward=False)
    def trace_paths(
        first: wp.int32,
        scene: SceneData,
        camera: CameraData,
        settings: PassSettings,
        paths: PathSettings,
        hits: PrimaryHits,
        buffers: PathBuffers,
        samplers: Samplers,
    ):
        p = tiled_pixel(first + wp.tid(), camera.width)
        if p[0] >= camera.width or p[1] >= camera.height:
            return
        pixel = p[1] * camera.width + p[0]
        face = hits.face[pixel]
        direction = hits.direction[pixel]
        count = wp.float32(settings.sample_count)
        if face < 0:
            background = sky.radiance(samplers.sky, scene, direction) * (1.0 - paths.hides_sky)
            add_moments(buffers, pixel, of_layers(buffers, pixel, background), count)
            return
        drawn = surface_emission(scene, face, hits.u[pixel], hits.v[pixel], -direction)
        emission = of_layers(buffers, pixel, drawn)
        if paths.terms == 0:
            add_moments(buffers, pixel, emission, count)
            return
        hit = BvhHit()
        hit.face = face
        hit.u = hits.u[pixel]
        hit.v = hits.v[pixel]
        s = surface_at(scene, face, hit.u, hit.v, -direction)
        seed = pixel_seed(p[0], p[1], settings.sample_bits, settings.seed)
        environment = wp.vec3(0.0, 0.0, 0.0)
        emitters = wp.vec3(0.0, 0.0, 0.0)
        indirect = wp.vec3(0.0, 0.0, 0.0)
        moment1 = wp.vec3(0.0, 0.0, 0.0)
        moment2 = wp.vec3(0.0, 0.0, 0.0)
        tint = first_tint(scene, s.position, direction, hits.t[pixel])
        first_index = pixel_sample_index(p[0], p[1], settings.first_sample, settings.sample_bits)
        for i in range(settings.sample_count):
            path = wp.int64(first + wp.tid()) * wp.int64(paths.spp) + wp.int64(settings.first_sample + i)
            r = trace_path(scene, samplers, hit, s, -direction, paths, first_index + wp.uint32(i), seed, path)
            r = with_tint(r, scene, tint)
            brightest = wp.max(r.indirect)
            if paths.clamp > 0.0 and brightest > paths.clamp:
                r.indirect = r.indirect * (paths.clamp / brightest)
            environment = environment + r.environment
            emitters = emitters + r.emitters
            indirect = indirect + r.indirect
            if paths.lobes != 0:
                add_lobes(buffers, pixel, s, r)
            beauty = emission + r.environment + r.emitters + r.indirect
            moment1 = moment1 + beauty
            moment2 = moment2 + wp.cw_mul(beauty, beauty)
        buffers.environment[pixel] = buffers.environment[pixel] + environment
        buffers.emitters[pixel] = buffers.emitters[pixel] + emitters
        buffers.indirect[pixel] = buffers.indirect[pixel] + indirect
        buffers.moment1[pixel] = buffers.moment1[pixel] + moment1
        buffers.moment2[pixel] = buffers.moment2[pixel] + moment2

    return PathTracer(Samplers, trace_path, trace_paths)


REFERENCE = path_tracer(ALIAS_LIGHTS, BSDF_DIRECTIONS, NO_REGIONS)
PathSamplers = REFERENCE.samplers
trace_path = REFERENCE.trace_path
