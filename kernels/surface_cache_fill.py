"""Paths from a camera's pixels that fill the cells of a surface cache with the light that arrives at their vertices.

Directions are sampled as if every surface were white and matt: a vertex samples the sky and one emitter, both combined
with the direction of the way on by the balance heuristic, and so knows an irradiance E and an exitance S of the GGX
lobe, whose directional albedo for the light's direction is rho. Backwards along the path

    E_k = D_k + M_{k+1},   S_k = D_k rho + rho M_{k+1},   M_k = (1 - F) diffuse E_k + S_k,

where D_k is the direct light, M / pi the radiance that leaves, and behind the last vertex M comes from the cells as
those paths left them that went before.
"""

import warp as wp

from warp_gi.kernels.bsdf import Bsdf, diffuse_share, lambert
from warp_gi.kernels.bvh import BvhHit, bvh_intersect
from warp_gi.kernels.emitters import LightChoice, hit_light_pdf
from warp_gi.kernels.environment import environment_lookup, environment_sample
from warp_gi.kernels.gbuffer import CameraData, camera_origin, camera_ray
from warp_gi.kernels.light_connections import connect_emitter, connect_sky, light_1d, light_2d
from warp_gi.kernels.light_hierarchy import LightTree, hierarchy_light, hierarchy_light_pdf
from warp_gi.kernels.ltc import LtcTable, lobe_albedo
from warp_gi.kernels.panes import glass_tint, has_panes
from warp_gi.kernels.path_samplers import AliasLights, alias_light, alias_light_pdf
from warp_gi.kernels.sampling import (
    CACHE_PLACE_DIMENSION,
    CAMERA_DIMENSION,
    DIRECTION_DIMENSION,
    EMITTER_DIMENSION,
    LIGHT_DIMENSION,
    PATH_DIMENSION,
    SKY_DIGITS_DIMENSION,
    SKY_DIMENSION,
    VERTEX_DIMENSIONS,
    balance,
    cosine_direction,
    random_1d,
    sample_2d,
)
from warp_gi.kernels.surface import Surface, ray_origin, shading_normal, surface_at, surface_emission
from warp_gi.kernels.surface_cache import (
    LEVELS,
    SurfaceCells,
    cell_exitance,
    cell_key,
    cell_level,
    known_slot,
    object_grid,
)
from warp_gi.kernels.types import ENVIRONMENT_MAP, ENVIRONMENT_NONE, SceneData

wp.set_module_options({"enable_backward": False})


# Where paths begin, and how long they are.
@wp.struct
class FillSettings:
    cameras: wp.array(dtype=CameraData)  # of the frames of the camera's path
    first_path: wp.int32  # of this launch, among the paths of its pass, which are spread over all cameras
    pass_paths: wp.int32
    index: wp.uint32  # of the random numbers of the first path of the pass
    seed: wp.uint32
    vertices: wp.int32  # of a path
    by_tree: wp.int32  # 1: emitters are selected by `tree`, 0: by power
    tree: LightTree


# One record for each vertex, [path * FillSettings.vertices]. The path's thread writes them.
@wp.struct
class FillRecords:
    keys: wp.array(dtype=wp.uint64)  # of the smallest cell around the vertex; 0: there is no vertex
    irradiance: wp.array(dtype=wp.vec3)  # E, W/m^2
    exitance: wp.array(dtype=wp.vec3)  # S, W/m^2
    diffuse: wp.array(dtype=wp.vec3)  # share of E that the diffuse lobe reflects
    along: wp.array(dtype=wp.vec3)  # rho for the direction in which the path went on


# Direct light at a vertex, and the way on.
@wp.struct
class FillStep:
    irradiance: wp.vec3
    exitance: wp.vec3
    rho: wp.vec3  # of the way on
    direction: wp.vec3
    hit: BvhHit  # face -1: the path ends


# Share of light from a direction, with a cosine, that a GGX lobe reflects.
@wp.func
def lobe_reflectance(table: LtcTable, b: Bsdf, cosine: wp.float32) -> wp.vec3:
    if b.f90 <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    a = lobe_albedo(table, b.alpha, cosine)
    offset = b.f90 * a[1]
    return b.f0 * a[0] + wp.vec3(offset, offset, offset)


# An emitter, for the point of a white surface.
@wp.func
def fill_light(settings: FillSettings, scene: SceneData, white: Surface, wo: wp.vec3, u: wp.vec2) -> LightChoice:
    if settings.by_tree != 0:
        return hierarchy_light(settings.tree, scene, -1, white, wo, u)
    return alias_light(AliasLights(), scene, -1, white, wo, u)


# Probability of selecting it.
@wp.func
def fill_light_pdf(
    settings: FillSettings, scene: SceneData, white: Surface, wo: wp.vec3, emitter: wp.int32
) -> wp.float32:
    if settings.by_tree != 0:
        return hierarchy_light_pdf(settings.tree, scene, -1, white, wo, emitter)
    return alias_light_pdf(AliasLights(), scene, -1, white, wo, emitter)


# Irradiance [W/m^2] by one sample of the sky and one of an emitter, added to a step. `white` is the surface `s` with
# the BSDF 1 / pi; index and dimension are those of the vertex.
@wp.func
def add_lights(
    step: FillStep,
    scene: SceneData,
    table: LtcTable,
    settings: FillSettings,
    s: Surface,
    white: Surface,
    wo: wp.vec3,
    index: wp.uint32,
    d: wp.int32,
) -> FillStep:
    r = step
    seed = settings.seed
    if scene.environment.kind == ENVIRONMENT_MAP:
        u = light_2d(index, seed, d + SKY_DIMENSION, False)
        digits = random_1d(index, seed, d + SKY_DIGITS_DIMENSION)
        sky = connect_sky(scene, white, wo, environment_sample(scene.environment, wp.vec3(u[0], u[1], digits)))
        if sky.arrives > 0:
            light = sky.reflected * (wp.pi / (sky.pdf + sky.bsdf_pdf))
            if has_panes(scene.panes):
                light = wp.cw_mul(light, glass_tint(scene, ray_origin(s), sky.direction, float(wp.inf)))
            rho = lobe_reflectance(table, s.bsdf, wp.dot(shading_normal(s), sky.direction))
            r.irradiance = r.irradiance + light
            r.exitance = r.exitance + wp.cw_mul(rho, light)
    if scene.emitters.count > 0:
        first = light_1d(index, seed, d + LIGHT_DIMENSION, False)
        u_choice = wp.vec2(first, random_1d(index, seed, d + LIGHT_DIMENSION))
        choice = fill_light(settings, scene, white, wo, u_choice)
        sample = connect_emitter(scene, white, wo, choice, light_2d(index, seed, d + EMITTER_DIMENSION, False))
        if sample.arrives > 0:
            light = sample.reflected * wp.pi
            if sample.delta == 0:
                light = light / (sample.pdf + sample.bsdf_pdf)
            if has_panes(scene.panes):
                light = wp.cw_mul(light, glass_tint(scene, ray_origin(s), sample.direction, sample.distance))
            rho = lobe_reflectance(table, s.bsdf, wp.dot(shading_normal(s), sample.direction))
            r.irradiance = r.irradiance + light
            r.exitance = r.exitance + wp.cw_mul(rho, light)
    return r


# Irradiance by what the way on meets of sky and emitters, weighed against the samples of `add_lights`.
@wp.func
def met_light(
    scene: SceneData,
    settings: FillSettings,
    white: Surface,
    wo: wp.vec3,
    wi: wp.vec3,
    pdf: wp.float32,
    hit: BvhHit,
) -> wp.vec3:
    if hit.face < 0:
        if scene.environment.kind == ENVIRONMENT_NONE:
            return wp.vec3(0.0, 0.0, 0.0)
        sky = environment_lookup(scene.environment, wi)
        if scene.environment.kind == ENVIRONMENT_MAP:
            return sky.radiance * (wp.pi * balance(pdf, sky.pdf))
        return sky.radiance * wp.pi
    emitter = scene.geometry.emitters[hit.face]
    if emitter < 0:
        return wp.vec3(0.0, 0.0, 0.0)
    light_pdf = hit_light_pdf(scene, emitter, hit.face, hit.u, hit.v, wi, hit.t)
    light_pdf = light_pdf * fill_light_pdf(settings, scene, white, wo, emitter)
    return surface_emission(scene, hit.face, hit.u, hit.v, -wi) * (wp.pi * balance(pdf, light_pdf))


@wp.func
def fill_step(
    scene: SceneData,
    table: LtcTable,
    settings: FillSettings,
    s: Surface,
    view: wp.vec3,
    index: wp.uint32,
    d: wp.int32,
) -> FillStep:
    r = FillStep()
    r.hit.face = -1
    white = s
    white.bsdf = lambert(wp.vec3(1.0, 1.0, 1.0))
    wo = wp.transpose(s.shading) * view
    r = add_lights(r, scene, table, settings, s, white, wo, index, d)
    local = cosine_direction(sample_2d(index, settings.seed, d + DIRECTION_DIMENSION + 1))
    r.direction = s.shading * local
    if local[2] > 0.0 and wp.dot(r.direction, s.normal) > 0.0:
        r.rho = lobe_reflectance(table, s.bsdf, local[2])
        r.hit = bvh_intersect(scene.bvh, ray_origin(s), r.direction, float(wp.inf))
        light = met_light(scene, settings, white, wo, r.direction, local[2] / wp.pi, r.hit)
        if has_panes(scene.panes):
            t_hit = float(wp.inf)
            if r.hit.face >= 0:
                t_hit = r.hit.t
            light = wp.cw_mul(light, glass_tint(scene, ray_origin(s), r.direction, t_hit))
        r.irradiance = r.irradiance + light
        r.exitance = r.exitance + wp.cw_mul(r.rho, light)
    return r


# Thread: a path. Writes the records of its vertices; those of vertices that it does not reach get the key 0.
@wp.kernel
def fill_cells(
    first: wp.int32,
    scene: SceneData,
    table: LtcTable,
    cells: SurfaceCells,
    settings: FillSettings,
    records: FillRecords,
):
    item = first + wp.tid()
    path = settings.first_path + item
    index = settings.index + wp.uint32(path)
    start = item * settings.vertices
    number = wp.int32(wp.int64(path) * wp.int64(settings.cameras.shape[0]) / wp.int64(settings.pass_paths))
    camera = settings.cameras[number]
    u = sample_2d(index, settings.seed, CAMERA_DIMENSION)
    x = u[0] * wp.float32(camera.width)
    y = u[1] * wp.float32(camera.height)
    direction = camera_ray(camera, x, y)
    hit = bvh_intersect(scene.bvh, camera_origin(camera, x, y), direction, float(wp.inf))
    met = int(0)
    while hit.face >= 0 and met < settings.vertices:
        s = surface_at(scene, hit.face, hit.u, hit.v, -direction)
        d = PATH_DIMENSION + met * VERTEX_DIMENSIONS
        step = fill_step(scene, table, settings, s, -direction, index, d)
        at = start + met
        grid = object_grid(cells, scene, hit.face)
        records.keys[at] = cell_key(cells, grid, s.position, s.normal, cell_level(cells, s.position))
        records.irradiance[at] = step.irradiance
        records.exitance[at] = step.exitance
        records.diffuse[at] = wp.cw_mul(diffuse_share(s.bsdf), s.bsdf.diffuse)
        records.along[at] = step.rho
        direction = step.direction
        hit = step.hit
        met += 1
    arrives = wp.vec3(0.0, 0.0, 0.0)
    if hit.face >= 0:
        s = surface_at(scene, hit.face, hit.u, hit.v, -direction)
        d = PATH_DIMENSION + met * VERTEX_DIMENSIONS + CACHE_PLACE_DIMENSION
        place = wp.vec2(random_1d(index, settings.seed, d), random_1d(index, settings.seed, d + 1))
        grid = object_grid(cells, scene, hit.face)
        slot = known_slot(cells, grid, s, cell_level(cells, s.position), LEVELS, place)
        if slot >= 0:
            arrives = cell_exitance(cells, slot, s.bsdf, 1)
    for k in range(met):
        at = start + met - 1 - k
        irradiance = records.irradiance[at] + arrives
        exitance = records.exitance[at] + wp.cw_mul(records.along[at], arrives)
        records.irradiance[at] = irradiance
        records.exitance[at] = exitance
        arrives = wp.cw_mul(records.diffuse[at], irradiance) + exitance
    for k in range(met, settings.vertices):
        records.keys[start + k] = wp.uint64(0)
