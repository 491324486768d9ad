"""Indirect light of a frame from light field probes: filtered irradiance, and rays that end in what probes know.

What probes hold is reflected light; what a ray sees of the sky and of emitters belongs to other terms. Rays are traced
through the scene, and what they meet is lit by its own direct light and the probes' irradiance; or they are marched
through the probes' maps. Where too few probes see what a pixel shows, rays of the whole BSDF stand for them; where too
few see what a ray meets, a path goes on from there.
"""

import warp as wp

from warp_gi.kernels.bsdf import (
    BsdfSample,
    average_specular,
    bsdf_sample,
    diffuse_share,
    fresnel,
    specular_sample,
)
from warp_gi.kernels.bvh import BvhHit, bvh_intersect
from warp_gi.kernels.gbuffer import (
    CameraData,
    PassSettings,
    PrimaryHits,
    camera_origin,
    camera_ray,
    primary_sample,
    tiled_pixel,
)
from warp_gi.kernels.light_field import (
    NOTHING,
    PROBE_USABLE,
    LightField,
    surfel_distance,
    surfel_normal,
    texel_emission,
    unpack_radiance,
)
from warp_gi.kernels.light_field_cache import SeenLight, cached_radiance, seen_light
from warp_gi.kernels.light_field_march import MISS, march
from warp_gi.kernels.octahedral import octahedral_encode, octahedral_texel
from warp_gi.kernels.path_trace import (
    NO_PATH,
    TERM_EMITTERS,
    TERM_ENVIRONMENT,
    TERM_INDIRECT,
    PathSamplers,
    PathSettings,
    trace_path,
)
from warp_gi.kernels.sampling import (
    PROBE_HIT_DIMENSION,
    PROBE_LOBE_DIMENSION,
    PROBE_PIXEL_DIMENSION,
    PROBE_RAY_DIMENSION,
    pixel_sample_index,
    pixel_seed,
    random_1d,
    sample_1d,
    sample_2d,
)
from warp_gi.kernels.surface import Surface, ray_origin, shading_normal, surface_at
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

MODE_IRRADIANCE = wp.constant(0)
MODE_HYBRID = wp.constant(1)
MODE_TRACED = wp.constant(2)
MOST_STEPS = wp.constant(1 << 20)
RAYS_GEOMETRY = wp.constant(0)
RAYS_PROBES = wp.constant(1)


@wp.struct
class ProbeQuery:
    mode: wp.int32  # MODE_*
    through: wp.int32  # RAYS_*: what rays are traced through
    visibility: wp.int32  # VISIBILITY_*: how probes that see a point are found
    rays: wp.int32  # rays a pixel in the current camera sample
    first_ray: wp.int32  # number of the first of them among all rays of the pixel
    ray_bits: wp.int32  # bits that number all rays of a pixel
    unseen_rays: wp.int32  # this and the next two: the same where too few probes see the pixel's surface
    first_unseen_ray: wp.int32
    unseen_ray_bits: wp.int32
    paths: PathSettings  # settings of paths that go on where no probe sees a point


# Sums over samples, [height * width].
@wp.struct
class ProbeBuffers:
    indirect: wp.array(dtype=wp.vec3)
    moment1: wp.array(dtype=wp.vec3)
    moment2: wp.array(dtype=wp.vec3)
    diffuse: wp.array(dtype=wp.vec3)  # light that the diffuse lobe receives, for a denoiser; empty if there is none
    glossy: wp.array(dtype=wp.vec3)  # light that the glossy lobe reflects, for a denoiser; empty if there is none


# Sums over camera samples, [height * width], of a picture whose camera rays go through probes.
@wp.struct
class ProbeView:
    emission: wp.array(dtype=wp.vec3)
    alpha: wp.array(dtype=wp.float32)  # number of samples that hit
    indirect: wp.array(dtype=wp.vec3)
    normal: wp.array(dtype=wp.vec3)
    position: wp.array(dtype=wp.vec3)  # this and the next three: of the first camera sample alone
    depth: wp.array(dtype=wp.float32)
    object_id: wp.array(dtype=wp.int32)
    material_id: wp.array(dtype=wp.int32)
    moment1: wp.array(dtype=wp.vec3)
    moment2: wp.array(dtype=wp.vec3)


# Radiance that surfaces in a direction reflect towards `origin`, as far as the probes' maps know.
@wp.func
def reflected_radiance(field: LightField, origin: wp.vec3, direction: wp.vec3) -> wp.vec3:
    hit = march(field, origin, direction, 0.0, float(wp.inf), MOST_STEPS)
    if hit.result == MISS or hit.probe < 0:
        return wp.vec3(0.0, 0.0, 0.0)
    return unpack_radiance(field.radiance[hit.probe * field.resolution * field.resolution + hit.texel])


# Light of a sample, in two parts for a denoiser.
@wp.struct
class Lobes:
    diffuse: wp.vec3  # light as the diffuse lobe receives it: without its colour
    glossy: wp.vec3  # light as the glossy lobe reflects it


# Light that a surface has from irradiance: its diffuse lobe's, and in the mode without rays the glossy lobe's, as if
# that were Lambert too.
@wp.func
def steady_light(irradiance: wp.vec3, s: Surface, mode: wp.int32) -> Lobes:
    r = Lobes()
    if mode == MODE_TRACED:
        return r
    arriving = irradiance / wp.pi
    r.diffuse = wp.cw_mul(diffuse_share(s.bsdf), arriving)
    if mode == MODE_IRRADIANCE:
        r.glossy = wp.cw_mul(average_specular(s.bsdf), arriving)
    return r


# Direction of a ray, by the glossy lobe alone or by the whole BSDF.
@wp.func
def ray_direction(s: Surface, wo: wp.vec3, mode: wp.int32, index: wp.uint32, seed: wp.uint32) -> BsdfSample:
    u = sample_2d(index, seed, PROBE_RAY_DIMENSION)
    if mode == MODE_HYBRID:
        return specular_sample(s.bsdf, wo, u)
    u_lobe = float(0.0)
    if s.bsdf.f90 > 0.0:
        u_lobe = sample_1d(index, seed, PROBE_LOBE_DIMENSION)
    return bsdf_sample(s.bsdf, wo, u_lobe, u)


# Parts of both lobes in the light of a ray. A ray of the mode "hybrid" is all of the glossy lobe's; one
# of the mode "traced" was drawn from both: weight = f cos / pdf, of which the diffuse lobe has
# (1 - F) cos / (pi pdf) times its colour.
@wp.func
def lobes_of(s: Surface, wo: wp.vec3, sample: BsdfSample, light: wp.vec3, mode: wp.int32) -> Lobes:
    r = Lobes()
    r.glossy = wp.cw_mul(sample.weight, light)
    if mode == MODE_TRACED:
        f = wp.vec3(0.0, 0.0, 0.0)
        if s.bsdf.f90 > 0.0:
            f = fresnel(s.bsdf, wp.dot(wo, wp.normalize(wo + sample.wi)))
        share = sample.wi[2] / (wp.pi * sample.pdf)
        r.diffuse = wp.cw_mul(wp.vec3(1.0, 1.0, 1.0) - f, light) * share
        r.glossy = r.glossy - wp.cw_mul(s.bsdf.diffuse, r.diffuse)
    return r


# Whether a sample takes its light from the probes, or from a ray. A random number decides, so that there is no edge
# between points where probes are trusted and points where they are not.
@wp.func
def trusts(seen: SeenLight, index: wp.uint32, seed: wp.uint32, dimension: wp.int32) -> wp.bool:
    return seen.trust >= 1.0 or random_1d(index, seed, dimension) < seen.trust


# Radiance that a surface which a ray meets reflects back along it: direct light, which is sampled, and the probes'
# irradiance; where they know nothing, a path goes on from there.
@wp.func
def reflected_light(
    scene: SceneData,
    field: LightField,
    query: ProbeQuery,
    hit: BvhHit,
    towards: wp.vec3,
    index: wp.uint32,
    seed: wp.uint32,
) -> wp.vec3:
    s = surface_at(scene, hit.face, hit.u, hit.v, towards)
    seen = seen_light(scene, field, query.visibility, s.position, shading_normal(s), ray_origin(s))
    paths = query.paths
    paths.terms = TERM_ENVIRONMENT | TERM_EMITTERS
    known = wp.vec3(0.0, 0.0, 0.0)
    if trusts(seen, index, seed, PROBE_HIT_DIMENSION):
        known = cached_radiance(s, seen)
    else:
        paths.terms = TERM_ENVIRONMENT | TERM_EMITTERS | TERM_INDIRECT
    light = trace_path(scene, PathSamplers(), hit, s, towards, paths, index, seed, NO_PATH)
    return known + light.environment + light.emitters + light.indirect


# Light that one ray of a pixel brings.
@wp.func
def ray_light(
    scene: SceneData,
    field: LightField,
    query: ProbeQuery,
    s: Surface,
    towards: wp.vec3,
    mode: wp.int32,
    through: wp.int32,
    index: wp.uint32,
    seed: wp.uint32,
) -> Lobes:
    wo = wp.transpose(s.shading) * towards
    sample = ray_direction(s, wo, mode, index, seed)
    wi = s.shading * sample.wi
    if sample.pdf <= 0.0 or wp.dot(wi, s.normal) <= 0.0:
        return Lobes()
    if through == RAYS_PROBES:
        return lobes_of(s, wo, sample, reflected_radiance(field, ray_origin(s), wi), mode)
    hit = bvh_intersect(scene.bvh, ray_origin(s), wi, float(wp.inf))
    if hit.face < 0:
        return Lobes()
    return lobes_of(s, wo, sample, reflected_light(scene, field, query, hit, -wi, index, seed), mode)


# Light of one sample of a pixel: that of the probes' irradiance and, if the mode `traces`, that of a ray. Where too few
# probes see the point, a ray by the whole BSDF stands for both.
@wp.func
def sample_light(
    scene: SceneData,
    field: LightField,
    query: ProbeQuery,
    s: Surface,
    towards: wp.vec3,
    seen: SeenLight,
    traces: wp.bool,
    index: wp.uint32,
    seed: wp.uint32,
) -> Lobes:
    light = Lobes()
    mode = query.mode
    through = query.through
    trusted = trusts(seen, index, seed, PROBE_PIXEL_DIMENSION)
    if trusted:
        light = steady_light(seen.irradiance, s, mode)
    else:
        mode = MODE_TRACED
        through = RAYS_GEOMETRY
    if traces or not trusted:
        by_ray = ray_light(scene, field, query, s, towards, mode, through, index, seed)
        light.diffuse = light.diffuse + by_ray.diffuse
        light.glossy = light.glossy + by_ray.glossy
    return light


# Number of a pixel's rays in the current camera sample, the number of the first, and the bits that number all.
@wp.func
def ray_numbers(query: ProbeQuery, trust: wp.float32, traces: wp.bool) -> wp.vec3i:
    if trust < 1.0:
        return wp.vec3i(query.unseen_rays, query.first_unseen_ray, query.unseen_ray_bits)
    return wp.vec3i(wp.where(traces, query.rays, 0), query.first_ray, query.ray_bits)


# Thread: a pixel. Adds the indirect light of the current camera sample to its own items of `buffers`.
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
    if hits.face[pixel] < 0:
        return
    towards = -hits.direction[pixel]
    s = surface_at(scene, hits.face[pixel], hits.u[pixel], hits.v[pixel], towards)
    seen = SeenLight()
    seen.trust = 1.0
    if query.mode != MODE_TRACED and (query.mode == MODE_IRRADIANCE or wp.max(s.bsdf.diffuse) > 0.0):
        seen = seen_light(scene, field, query.visibility, s.position, shading_normal(s), ray_origin(s))
    traces = query.mode == MODE_TRACED or (query.mode == MODE_HYBRID and s.bsdf.f90 > 0.0)
    numbers = ray_numbers(query, seen.trust, traces)
    rays = numbers[0]
    share = wp.float32(settings.sample_count)  # samples that one evaluation stands for
    if rays > 0:
        share = share / wp.float32(rays)
    seed = pixel_seed(p[0], p[1], numbers[2], settings.seed)
    first_index = pixel_sample_index(p[0], p[1], numbers[1], numbers[2])
    diffuse = wp.vec3(0.0, 0.0, 0.0)
    glossy = wp.vec3(0.0, 0.0, 0.0)
    moment2 = wp.vec3(0.0, 0.0, 0.0)
    for i in range(wp.max(rays, 1)):
        index = first_index + wp.uint32(i)
        light = sample_light(scene, field, query, s, towards, seen, traces, index, seed)
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


# Thread: a pixel of a first hit. How many of the probes around it see it, 1 to 8; 0 where too few do and rays are
# traced, -1 where nothing was hit.
@wp.kernel
def count_probes(
    first: wp.int32,
    scene: SceneData,
    field: LightField,
    visibility: wp.int32,
    hits: PrimaryHits,
    counts: wp.array(dtype=wp.int32),
):
    pixel = first + wp.tid()
    counts[pixel] = -1
    if hits.face[pixel] >= 0:
        s = surface_at(scene, hits.face[pixel], hits.u[pixel], hits.v[pixel], -hits.direction[pixel])
        seen = seen_light(scene, field, visibility, s.position, shading_normal(s), ray_origin(s))
        counts[pixel] = wp.where(seen.trust >= 1.0, wp.max(seen.probes, 1), 0)


# Radiance of the sky in a direction, from the first probe that sees it there.
@wp.func
def sky_radiance(field: LightField, direction: wp.vec3) -> wp.vec3:
    texel = octahedral_texel(octahedral_encode(direction), field.resolution)
    size = field.resolution * field.resolution
    for probe in range(field.states.shape[0]):
        if field.states[probe] == PROBE_USABLE and surfel_distance(field.surfels[probe * size + texel]) >= NOTHING:
            return unpack_radiance(field.radiance[probe * size + texel])
    return wp.vec3(0.0, 0.0, 0.0)


# Thread: a pixel. Adds what the camera sees of the probes' surfels, and of the sky behind them, to `view`.
@wp.kernel
def view_probes(first: wp.int32, camera: CameraData, settings: PassSettings, field: LightField, view: ProbeView):
    p = tiled_pixel(first + wp.tid(), camera.width)
    if p[0] >= camera.width or p[1] >= camera.height:
        return
    pixel = p[1] * camera.width + p[0]
    at = primary_sample(settings, p)
    origin, direction = camera_origin(camera, at[0], at[1]), camera_ray(camera, at[0], at[1])
    hit = march(field, origin, direction, 0.0, float(wp.inf), MOST_STEPS)
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
            position = origin + direction * hit.t
            depth = wp.dot(position - camera.position, camera.forward)
            view.alpha[pixel] = view.alpha[pixel] + 1.0
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
