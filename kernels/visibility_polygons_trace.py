"""Light of the sky that polygons do not know, by rays: all on flagged triangles, elsewhere that of glossy lobes."""

import warp as wp

from warp_gi.kernels.bsdf import Bsdf, bsdf_evaluate, bsdf_sample, diffuse_share
from warp_gi.kernels.bvh import bvh_occluded
from warp_gi.kernels.environment import environment_lookup, environment_sample
from warp_gi.kernels.gbuffer import PassSettings, PrimaryHits, tiled_pixel
from warp_gi.kernels.sampling import (
    POLYGON_DIRECTION_DIMENSION,
    POLYGON_LOBE_DIMENSION,
    POLYGON_SKY_DIMENSION,
    pixel_sample_index,
    pixel_seed,
    random_1d,
    sample_1d,
    sample_2d,
)
from warp_gi.kernels.surface import Surface, ray_origin, surface_at
from warp_gi.kernels.types import ENVIRONMENT_MAP, Geometry, SceneData
from warp_gi.kernels.visibility_polygons import MATCHED, PolygonLists

wp.set_module_options({"enable_backward": False})


@wp.struct
class PolygonBuffers:
    width: wp.int32  # pixels
    height: wp.int32
    unbiased: wp.int32  # 1: samples correct what polygons are wrong by
    environment: wp.array(dtype=wp.vec3)  # sums over samples, W/(m^2 sr), [height * width]
    moment1: wp.array(dtype=wp.vec3)  # of samples, for the variance buffer
    moment2: wp.array(dtype=wp.vec3)  # of their squares
    known: wp.array(dtype=wp.vec3)  # light of this camera sample that is in each of its samples, beside traced light


# Adds radiance that stands for `count` equal samples.
@wp.func
def add_equal(buffers: PolygonBuffers, pixel: wp.int32, radiance: wp.vec3, count: wp.float32):
    light = radiance * count
    buffers.environment[pixel] = buffers.environment[pixel] + light
    buffers.moment1[pixel] = buffers.moment1[pixel] + light
    buffers.moment2[pixel] = buffers.moment2[pixel] + wp.cw_mul(light, radiance)


# The side of a triangle that a ray hits.
@wp.func
def seen_record(geometry: Geometry, face: wp.int32, direction: wp.vec3) -> wp.int32:
    ids = geometry.indices[face]
    p0 = geometry.points[ids[0]]
    if wp.dot(wp.cross(geometry.points[ids[1]] - p0, geometry.points[ids[2]] - p0), direction) > 0.0:
        return face + geometry.indices.shape[0]
    return face


# Whether a surface reflects more than polygons know.
@wp.func
def needs_rays(b: Bsdf) -> wp.bool:
    return b.f90 > 0.0


# One sample of the light that a surface reflects, but for `share` times cosine: a direction by the sky and one by the
# BSDF `lobe`, weighted by the balance heuristic. The rest may be negative; its mean is right.
@wp.func
def traced_sample(
    scene: SceneData, s: Surface, lobe: Bsdf, share: wp.vec3, view: wp.vec3, index: wp.uint32, seed: wp.uint32
) -> wp.vec3:
    light = wp.vec3(0.0, 0.0, 0.0)
    wo = wp.transpose(s.shading) * view
    is_map = scene.environment.kind == ENVIRONMENT_MAP
    for strategy in range(2):
        direction = wp.vec3(0.0, 0.0, 0.0)
        if strategy == 0:
            if is_map:
                u = sample_2d(index, seed, POLYGON_SKY_DIMENSION)
                digits = random_1d(index, seed, POLYGON_SKY_DIMENSION)
                direction = environment_sample(scene.environment, wp.vec3(u[0], u[1], digits)).direction
        else:
            b = bsdf_sample(
                lobe,
                wo,
                sample_1d(index, seed, POLYGON_LOBE_DIMENSION),
                sample_2d(index, seed, POLYGON_DIRECTION_DIMENSION),
            )
            if b.pdf > 0.0:
                direction = s.shading * b.wi
        wi = wp.transpose(s.shading) * direction
        if wp.dot(direction, s.normal) > 0.0 and wi[2] > 0.0:
            sky = environment_lookup(scene.environment, direction)
            pdf = bsdf_evaluate(lobe, wo, wi).pdf
            if is_map:
                pdf += sky.pdf
            if pdf > 0.0 and wp.max(sky.radiance) > 0.0:
                if bvh_occluded(scene.bvh, ray_origin(s), direction, float(wp.inf)) == 0:
                    value = bsdf_evaluate(s.bsdf, wo, wi).value - share * wi[2]
                    light = light + wp.cw_mul(value, sky.radiance) / pdf
    return light


# The value of the diffuse lobe, by which polygons' light is reflected, 1/sr.
@wp.func
def diffuse_value(bsdf: Bsdf) -> wp.vec3:
    return wp.cw_mul(diffuse_share(bsdf), bsdf.diffuse) / wp.pi


# Thread: a pixel. Adds the samples of the current camera sample, where rays are traced.
@wp.kernel
def trace_polygons(
    first: wp.int32,
    scene: SceneData,
    settings: PassSettings,
    lists: PolygonLists,
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
    record = seen_record(scene.geometry, face, hits.direction[pixel])
    is_known = lists.states[record] == wp.uint8(MATCHED)
    s = surface_at(scene, face, hits.u[pixel], hits.v[pixel], -hits.direction[pixel])
    if is_known and (buffers.unbiased != 0 or not needs_rays(s.bsdf)):
        return
    share = wp.vec3(0.0, 0.0, 0.0)
    lobe = s.bsdf
    if is_known:
        share = diffuse_value(s.bsdf)
        lobe.diffuse = wp.vec3(0.0, 0.0, 0.0)
    seed = pixel_seed(p[0], p[1], settings.sample_bits, settings.seed)
    for k in range(settings.sample_count):
        index = pixel_sample_index(p[0], p[1], settings.first_sample + k, settings.sample_bits)
        light = traced_sample(scene, s, lobe, share, -hits.direction[pixel], index, seed)
        add_equal(buffers, pixel, buffers.known[pixel] + light, 1.0)
