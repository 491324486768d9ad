"""Light through polygons without their bias: they are the control variate of samples of the sky.

A sample adds what a ray finds in a direction d, minus what polygons say of a direction d' beside it. Their integral is
over a map of patches, each at its mean, and this is the sky that d' sees: d' is anywhere in d's patch, with a density
in proportion to the patch's luminance. So the mean of what is taken away is the integral, which a pixel has once; and
as a patch is small, the difference is noise only where polygons are wrong or a patch is cut. The integral is by the
evaluator; where that is an approximation, one pixel in a few adds its difference from the exact one, so many times.
"""

import warp as wp

from warp_gi.kernels.bsdf import Bsdf, bsdf_evaluate, bsdf_sample, luminance
from warp_gi.kernels.bvh import bvh_occluded
from warp_gi.kernels.environment import (
    environment_lookup,
    environment_sample,
    patch_nodes,
    patch_pdf,
    polar_angle,
)
from warp_gi.kernels.gbuffer import PassSettings, PrimaryHits, tiled_pixel
from warp_gi.kernels.sampling import (
    POLYGON_DIRECTION_DIMENSION,
    POLYGON_EXACT_DIMENSION,
    POLYGON_LOBE_DIMENSION,
    POLYGON_PATCH_DIMENSION,
    POLYGON_SKY_DIMENSION,
    circle,
    cosine_direction,
    frame_of,
    pixel_sample_index,
    pixel_seed,
    random_1d,
    sample_1d,
    sample_2d,
)
from warp_gi.kernels.surface import Surface, ray_origin, shading_normal, surface_at
from warp_gi.kernels.types import ENVIRONMENT_MAP, Environment, SceneData
from warp_gi.kernels.visibility_polygons import (
    MATCHED,
    PolygonLists,
    PolygonSets,
    record_normal,
    walk_begun,
    walk_direction,
    walk_stepped,
)
from warp_gi.kernels.visibility_polygons_sky import PolygonSky, record_light
from warp_gi.kernels.visibility_polygons_trace import PolygonBuffers, add_equal, diffuse_value, needs_rays, seen_record

wp.set_module_options({"enable_backward": False})

GROUP = wp.constant(8)  # samples that share a walk along the polygons
EXACT_IN = wp.constant(8)  # one camera sample of a pixel in so many is integrated exactly
GroupDirections = wp.types.matrix(shape=(8, 3), dtype=wp.float32)
GroupCounts = wp.types.vector(length=8, dtype=wp.int32)


# A direction of the control variate, and of the ray beside it.
@wp.struct
class ControlSample:
    traced: wp.vec3  # unit, world space
    control: wp.vec3
    weight: wp.vec3  # radiance that polygons integrate from `control`, over its density


# The sample of an index: of a map by its luminance, of a constant sky by the cosine.
@wp.func
def control_sample(
    env: Environment, sky: PolygonSky, shading: wp.mat33, index: wp.uint32, seed: wp.uint32
) -> ControlSample:
    r = ControlSample()
    u = sample_2d(index, seed, POLYGON_SKY_DIMENSION)
    if env.kind != ENVIRONMENT_MAP:
        local = cosine_direction(u)
        r.traced = shading * local
        r.control = r.traced
        r.weight = env.radiance * (wp.pi / wp.max(local[2], 1.0e-6))
        return r
    digits = random_1d(index, seed, POLYGON_SKY_DIMENSION)
    drawn = environment_sample(env, wp.vec3(u[0], u[1], digits))
    r.traced = drawn.direction
    s = random_1d(index, seed, POLYGON_PATCH_DIMENSION)
    t = random_1d(index, seed, POLYGON_PATCH_DIMENSION + 1)
    polar = polar_angle(drawn.row, t, env.height)
    around = circle((wp.float32(drawn.column) + s) / wp.float32(env.width)) * polar[1]
    r.control = wp.transpose(sky.sky_from_world) * wp.vec3(around[1], polar[0], -around[0])
    patch = patch_nodes(env, drawn.row, drawn.column)
    mean = (patch.upper_left + patch.upper_right + patch.lower_left + patch.lower_right) * 0.25
    if luminance(mean) > 0.0:
        r.weight = wp.cw_mul(mean, env.radiance) / patch_pdf(env, drawn.row, mean, polar[1])
    return r


# Counts the directions about z that the triangle (z, a, b) covers.
@wp.func
def group_covered(counts: GroupCounts, directions: GroupDirections, a: wp.vec3, b: wp.vec3) -> GroupCounts:
    r = counts
    side = a[0] * b[1] - a[1] * b[0]
    across = wp.cross(a, b)
    for j in range(GROUP):
        x = directions[j, 0]
        y = directions[j, 1]
        from_a = (a[0] * y - a[1] * x) * side
        from_b = (b[0] * y - b[1] * x) * side
        if from_a > 0.0 and from_b < 0.0:
            if (x * across[0] + y * across[1] + directions[j, 2] * across[2]) * side > 0.0:
                if side > 0.0:
                    r[j] = r[j] + 1
                else:
                    r[j] = r[j] - 1
    return r


# How often the polygons at a point of a record cover each of a group's directions, which are about its normal.
@wp.func
def group_coverage(
    sets: PolygonSets,
    lists: PolygonLists,
    record: wp.int32,
    weights: wp.vec3,
    local: wp.mat33,
    directions: GroupDirections,
) -> GroupCounts:
    counts = GroupCounts()
    corners = lists.corner_sets[record]
    for list in range(lists.list_starts[record], lists.list_starts[record + 1]):
        walk = walk_begun(sets, lists, list, corners, weights)
        before = local * walk_direction(walk)
        for k in range(lists.step_starts[list], lists.step_starts[list + 1]):
            walk = walk_stepped(sets, walk, wp.int32(lists.steps[k]))
            next = local * walk_direction(walk)
            counts = group_covered(counts, directions, before, next)
            before = next
    return counts


# What a BSDF reflects beyond `share` times cosine, over the density of its lobe's samples and the sky's.
@wp.func
def rest_weight(bsdf: Bsdf, lobe: Bsdf, share: wp.vec3, wo: wp.vec3, wi: wp.vec3, sky_pdf: wp.float32) -> wp.vec3:
    pdf = bsdf_evaluate(lobe, wo, wi).pdf + sky_pdf
    if pdf <= 0.0:
        return wp.vec3(0.0, 0.0, 0.0)
    return (bsdf_evaluate(bsdf, wo, wi).value - share * wi[2]) / pdf


# Light that a surface reflects by rays: `share` times cosine by the sample's ray alone, the rest of its BSDF by that
# and one by the lobe, weighted by the balance heuristic.
@wp.func
def surface_sample(
    scene: SceneData, s: Surface, share: wp.vec3, view: wp.vec3, traced: wp.vec3, index: wp.uint32, seed: wp.uint32
) -> wp.vec3:
    light = wp.vec3(0.0, 0.0, 0.0)
    wo = wp.transpose(s.shading) * view
    is_map = scene.environment.kind == ENVIRONMENT_MAP
    lobe = s.bsdf
    lobe.diffuse = wp.vec3(0.0, 0.0, 0.0)
    strategies = int(1)
    if needs_rays(s.bsdf):
        strategies = 2
    for strategy in range(strategies):
        direction = traced
        if strategy == 1:
            direction = wp.vec3(0.0, 0.0, 0.0)
            u = sample_2d(index, seed, POLYGON_DIRECTION_DIMENSION)
            b = bsdf_sample(lobe, wo, sample_1d(index, seed, POLYGON_LOBE_DIMENSION), u)
            if b.pdf > 0.0:
                direction = s.shading * b.wi
        wi = wp.transpose(s.shading) * direction
        if wp.dot(direction, s.normal) > 0.0 and wi[2] > 0.0:
            sky = environment_lookup(scene.environment, direction)
            weight = wp.vec3(0.0, 0.0, 0.0)
            if strategies == 2 and (is_map or strategy == 1):
                weight = rest_weight(s.bsdf, lobe, share, wo, wi, wp.where(is_map, sky.pdf, 0.0))
            if strategy == 0:
                pdf = wp.where(is_map, sky.pdf, wi[2] / wp.pi)
                if pdf > 0.0:
                    weight = weight + share * (wi[2] / pdf)
            if wp.length_sq(wp.cw_mul(weight, sky.radiance)) > 0.0:
                if bvh_occluded(scene.bvh, ray_origin(s), direction, float(wp.inf)) == 0:
                    light = light + wp.cw_mul(weight, sky.radiance)
    return light


# Thread: a pixel. One in a few adds the difference of the exact light through its polygons, so many times.
@wp.kernel
def correct_polygons(
    first: wp.int32,
    scene: SceneData,
    settings: PassSettings,
    sets: PolygonSets,
    lists: PolygonLists,
    sky: PolygonSky,
    hits: PrimaryHits,
    buffers: PolygonBuffers,
):
    p = tiled_pixel(first + wp.tid(), buffers.width)
    if p[0] >= buffers.width or p[1] >= buffers.height:
        return
    pixel = p[1] * buffers.width + p[0]
    face = hits.face[pixel]
    if face < 0:
        return
    seed = pixel_seed(p[0], p[1], settings.sample_bits, settings.seed)
    index = pixel_sample_index(p[0], p[1], settings.first_sample, settings.sample_bits)
    record = seen_record(scene.geometry, face, hits.direction[pixel])
    if lists.states[record] != wp.uint8(MATCHED):
        return
    if random_1d(index, seed, POLYGON_EXACT_DIMENSION) * wp.float32(EXACT_IN) >= 1.0:
        return
    u = hits.u[pixel]
    v = hits.v[pixel]
    s = surface_at(scene, face, u, v, -hits.direction[pixel])
    normal = shading_normal(s)
    share = diffuse_value(s.bsdf)
    light = wp.cw_mul(share, record_light(sets, lists, sky, record, wp.vec3(1.0 - u - v, u, v), normal))
    known = buffers.known[pixel]
    buffers.known[pixel] = known + (light - known) * wp.float32(EXACT_IN)


# Thread: a pixel whose polygons are known. Adds the samples of the current camera sample.
@wp.kernel
def trace_unbiased(
    first: wp.int32,
    scene: SceneData,
    settings: PassSettings,
    sets: PolygonSets,
    lists: PolygonLists,
    sky: PolygonSky,
    hits: PrimaryHits,
    buffers: PolygonBuffers,
):
    p = tiled_pixel(first + wp.tid(), buffers.width)
    if p[0] >= buffers.width or p[1] >= buffers.height:
        return
    pixel = p[1] * buffers.width + p[0]
    face = hits.face[pixel]
    if face < 0:
        return
    view = -hits.direction[pixel]
    record = seen_record(scene.geometry, face, hits.direction[pixel])
    if lists.states[record] != wp.uint8(MATCHED):
        return
    weights = wp.vec3(1.0 - hits.u[pixel] - hits.v[pixel], hits.u[pixel], hits.v[pixel])
    s = surface_at(scene, face, hits.u[pixel], hits.v[pixel], view)
    share = diffuse_value(s.bsdf)
    local = wp.transpose(frame_of(record_normal(sets, lists.corner_sets[record], weights)))
    seed = pixel_seed(p[0], p[1], settings.sample_bits, settings.seed)
    start = settings.first_sample
    while start < settings.first_sample + settings.sample_count:
        count = wp.min(GROUP, settings.first_sample + settings.sample_count - start)
        directions = GroupDirections()
        for j in range(count):
            index = pixel_sample_index(p[0], p[1], start + j, settings.sample_bits)
            d = local * control_sample(scene.environment, sky, s.shading, index, seed).control
            directions[j, 0] = d[0]
            directions[j, 1] = d[1]
            directions[j, 2] = d[2]
        counts = group_coverage(sets, lists, record, weights, local, directions)
        for j in range(count):
            index = pixel_sample_index(p[0], p[1], start + j, settings.sample_bits)
            drawn = control_sample(scene.environment, sky, s.shading, index, seed)
            cosine = s.shading[0, 2] * drawn.control[0]
            cosine += s.shading[1, 2] * drawn.control[1] + s.shading[2, 2] * drawn.control[2]
            light = surface_sample(scene, s, share, view, drawn.traced, index, seed)
            light = light - wp.cw_mul(share, drawn.weight) * (cosine * wp.float32(counts[j]))
            add_equal(buffers, pixel, buffers.known[pixel] + light, 1.0)
        start += count
