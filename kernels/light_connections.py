"""Light samples of a path's vertices: their random numbers, and what arrives of the sky and of an emitter."""

import warp as wp

from warp_gi.kernels.bsdf import bsdf_evaluate
from warp_gi.kernels.bvh import bvh_occluded
from warp_gi.kernels.emitters import LightChoice, LightSample, sample_emitter
from warp_gi.kernels.environment import EnvironmentSample, environment_arrival
from warp_gi.kernels.sampling import (
    EXPLORE_DIGITS_DIMENSION,
    EXPLORE_DIMENSION,
    EXPLORE_POINT_DIMENSION,
    FURTHER_DIMENSIONS,
    FURTHER_SECOND_DIMENSIONS,
    random_1d,
    sample_1d,
    sample_2d,
)
from warp_gi.kernels.surface import Surface, ray_origin
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

SHADOW_END = wp.constant(wp.float32(0.9999))  # share of the way to an emitter that must be free


# A light sample that arrives: nothing in between, and the surface reflects some of it.
@wp.struct
class LightConnection:
    arrives: wp.int32  # 1; 0 or, of an emitter with something in between, -1: it does not, and nothing else is set
    direction: wp.vec3
    distance: wp.float32  # to the light; not of a mere direction
    reflected: wp.vec3  # f cos(wi) times the radiance (over the pdf already where `delta`); not of a mere direction
    scattered: wp.vec3  # f cos(wi); not of emitters
    pdf: wp.float32  # of the light sample; not of a mere direction
    bsdf_pdf: wp.float32
    delta: wp.int32


# Whether light from far away arrives from a unit direction. What it is needs to be known of the few alone that do.
@wp.func
def connect_direction(scene: SceneData, s: Surface, wo: wp.vec3, direction: wp.vec3) -> LightConnection:
    r = LightConnection()
    if wp.dot(direction, s.normal) <= 0.0:
        return r
    f = bsdf_evaluate(s.bsdf, wo, wp.transpose(s.shading) * direction)
    if f.pdf <= 0.0:
        return r
    if bvh_occluded(scene.bvh, ray_origin(s), direction, float(wp.inf)):
        return r
    r.arrives = 1
    r.direction = direction
    r.scattered = f.value
    r.bsdf_pdf = f.pdf
    return r


@wp.func
def connect_sky(scene: SceneData, s: Surface, wo: wp.vec3, drawn: EnvironmentSample) -> LightConnection:
    r = connect_direction(scene, s, wo, drawn.direction)
    if r.arrives != 0:
        source = environment_arrival(scene.environment, drawn)
        if source.pdf <= 0.0:
            return LightConnection()
        r.reflected = wp.cw_mul(r.scattered, source.radiance)
        r.pdf = source.pdf
    return r


@wp.func
def connect_emitter(scene: SceneData, s: Surface, wo: wp.vec3, choice: LightChoice, u: wp.vec2) -> LightConnection:
    origin = ray_origin(s)
    return connect_light(scene, s, wo, origin, sample_emitter(scene, origin, choice, u))


# Whether a sample of a light, taken at `origin`, arrives.
@wp.func
def connect_light(scene: SceneData, s: Surface, wo: wp.vec3, origin: wp.vec3, drawn: LightSample) -> LightConnection:
    r = LightConnection()
    if drawn.pdf <= 0.0 or wp.dot(drawn.direction, s.normal) <= 0.0:
        return r
    f = bsdf_evaluate(s.bsdf, wo, wp.transpose(s.shading) * drawn.direction)
    if f.pdf <= 0.0 or wp.max(drawn.radiance) <= 0.0:
        return r
    if bvh_occluded(scene.bvh, origin, drawn.direction, drawn.distance * SHADOW_END):
        r.arrives = -1
        return r
    r.arrives = 1
    r.direction = drawn.direction
    r.distance = drawn.distance
    r.reflected = wp.cw_mul(f.value, drawn.radiance)
    r.pdf = drawn.pdf
    r.bsdf_pdf = f.pdf
    r.delta = drawn.delta
    return r


# Numbers for light samples: stratified where the camera looks, merely random further along a path,
# where directions that scatter leave little of a stratification to keep.
@wp.func
def light_1d(index: wp.uint32, seed: wp.uint32, dimension: wp.int32, at_first: wp.bool) -> wp.float32:
    if at_first:
        return sample_1d(index, seed, dimension)
    return random_1d(index, seed, dimension + FURTHER_DIMENSIONS)


@wp.func
def light_2d(index: wp.uint32, seed: wp.uint32, dimension: wp.int32, at_first: wp.bool) -> wp.vec2:
    if at_first:
        return sample_2d(index, seed, dimension)
    first = random_1d(index, seed, dimension + FURTHER_DIMENSIONS)
    return wp.vec2(first, random_1d(index, seed, dimension + FURTHER_SECOND_DIMENSIONS))


# Numbers for the choice of another light, and for the point on it.
@wp.func
def explore_3d(index: wp.uint32, seed: wp.uint32, dimension: wp.int32) -> wp.vec3:
    u = explore_2d(index, seed, dimension + EXPLORE_DIGITS_DIMENSION)
    return wp.vec3(random_1d(index, seed, dimension + EXPLORE_DIMENSION), u[0], u[1])


@wp.func
def explore_2d(index: wp.uint32, seed: wp.uint32, dimension: wp.int32) -> wp.vec2:
    first = random_1d(index, seed, dimension + EXPLORE_POINT_DIMENSION)
    return wp.vec2(first, random_1d(index, seed, dimension + EXPLORE_POINT_DIMENSION + 1))
