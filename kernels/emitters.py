"""Direct light from emissive triangles and punctual lights; path_samplers.py says which to sample."""

import warp as wp

from warp_gi.kernels.bvh import coverage, is_masked
from warp_gi.kernels.emission_grids import emitter_point, emitter_point_density
from warp_gi.kernels.surface import emitted_radiance
from warp_gi.kernels.types import (
    EMITTER_DIRECTIONAL,
    EMITTER_SPOT,
    EMITTER_TRIANGLE,
    Emitter,
    Emitters,
    SceneData,
)

wp.set_module_options({"enable_backward": False})

INFINITE_DISTANCE = wp.constant(wp.float32(1.0e30))


# An emitter to sample.
@wp.struct
class LightChoice:
    item: wp.int32  # -1: none
    pdf: wp.float32  # expected number of times that it is selected: a probability, where one choice is made
    weight: wp.float32  # factor of what it brings; 1, where one choice is made
    explores: wp.int32  # found by exploring: 1; 2, where the cache selects the light more often than that
    alone: wp.int32  # 1: by exploring, as the only choice there is
    other: wp.float32  # probability of it by exploring alone; if `alone`, by the cache, below 0 where nobody asked
    selected: wp.float32  # part of selecting it in the density of the direction, the rest being the direction sampler's


# radiance is over pdf already for lights without size (delta = 1), whose pdf is the
# probability of selecting them; else pdf is per solid angle. pdf 0: no sample.
@wp.struct
class LightSample:
    direction: wp.vec3  # unit, towards the light
    distance: wp.float32
    radiance: wp.vec3
    pdf: wp.float32
    delta: wp.int32


# Whether a ray can meet an emissive triangle at all: whether it meets the box around them.
@wp.func
def may_hit_emitter(emitters: Emitters, origin: wp.vec3, direction: wp.vec3) -> wp.bool:
    enter = float(0.0)
    leave = float(wp.inf)
    for axis in range(3):
        d = direction[axis]
        if wp.abs(d) < 1.0e-12:
            d = 1.0e-12
        a = (emitters.lower[axis] - origin[axis]) / d
        b = (emitters.upper[axis] - origin[axis]) / d
        enter = wp.max(enter, wp.min(a, b))
        leave = wp.min(leave, wp.max(a, b))
    return enter <= leave and emitters.lower[0] <= emitters.upper[0]


# Solid-angle pdf of a point uniform on an emissive triangle.
@wp.func
def triangle_light_pdf(scene: SceneData, face: wp.int32, direction: wp.vec3, distance: wp.float32) -> wp.float32:
    ids = scene.geometry.indices[face]
    p0 = scene.geometry.points[ids[0]]
    normal = wp.cross(scene.geometry.points[ids[1]] - p0, scene.geometry.points[ids[2]] - p0)
    # |normal| is twice the area, so |n . d| / 2 is area times cosine
    projected = 0.5 * wp.abs(wp.dot(normal, direction))
    if projected <= 0.0:
        return 0.0
    return distance * distance / projected


# Solid-angle pdf with which the point (u, v) of an emissive triangle is sampled once its emitter is selected.
@wp.func
def hit_light_pdf(
    scene: SceneData,
    emitter: wp.int32,
    face: wp.int32,
    u: wp.float32,
    v: wp.float32,
    direction: wp.vec3,
    distance: wp.float32,
) -> wp.float32:
    pdf = triangle_light_pdf(scene, face, direction, distance)
    return pdf * emitter_point_density(scene, emitter, u, v)


# Falloff of KHR_lights_punctual: inverse square, ended smoothly at `range`.
@wp.func
def distance_falloff(distance: wp.float32, range: wp.float32) -> wp.float32:
    falloff = 1.0 / (distance * distance)
    if range > 0.0:
        r = distance / range
        falloff = falloff * wp.clamp(1.0 - r * r * r * r, 0.0, 1.0)
    return falloff


# The light of a punctual emitter at `position`; pdf 1, or 0 where there is none.
@wp.func
def punctual_light(light: Emitter, position: wp.vec3) -> LightSample:
    r = LightSample()
    r.delta = 1
    r.pdf = 1.0
    if light.kind == EMITTER_DIRECTIONAL:
        r.direction = -light.direction
        r.distance = INFINITE_DISTANCE
        r.radiance = light.intensity
        return r
    to_light = light.position - position
    r.distance = wp.length(to_light)
    if r.distance <= 0.0:
        r.pdf = 0.0
        return r
    r.direction = to_light / r.distance
    strength = distance_falloff(r.distance, light.range)
    if light.kind == EMITTER_SPOT:
        cone = (-wp.dot(r.direction, light.direction) - light.cos_outer) / wp.max(
            light.cos_inner - light.cos_outer, 1.0e-4
        )
        cone = wp.clamp(cone, 0.0, 1.0)
        strength = strength * cone * cone
    r.radiance = light.intensity * strength
    return r


# One sample of the emitter that was chosen, as seen from `position`.
@wp.func
def sample_emitter(scene: SceneData, position: wp.vec3, choice: LightChoice, u: wp.vec2) -> LightSample:
    r = LightSample()
    if choice.item < 0:
        return r
    light = scene.emitters.emitters[choice.item]
    if light.kind == EMITTER_TRIANGLE:
        point = emitter_point(scene, choice.item, u)
        b = point.b
        ids = scene.geometry.indices[light.triangle]
        p0 = scene.geometry.points[ids[0]]
        p1 = scene.geometry.points[ids[1]]
        p2 = scene.geometry.points[ids[2]]
        to_light = p0 * (1.0 - b[0] - b[1]) + p1 * b[0] + p2 * b[1] - position
        r.distance = wp.length(to_light)
        if r.distance <= 0.0:
            return r
        r.direction = to_light / r.distance
        material = scene.materials[scene.geometry.materials[light.triangle]]
        if material.double_sided == 0 and wp.dot(wp.cross(p1 - p0, p2 - p0), r.direction) >= 0.0:
            return r
        covered = float(1.0)
        if is_masked(scene.bvh, light.triangle):  # no ray meets it where it has a hole
            covered = coverage(scene.bvh, light.triangle, b[0], b[1])
            if covered <= 0.0:
                return r
        r.pdf = choice.pdf * point.density * triangle_light_pdf(scene, light.triangle, r.direction, r.distance)
        r.radiance = emitted_radiance(scene, light.triangle, b[0], b[1]) * covered
        return r
    r = punctual_light(light, position)
    r.pdf = r.pdf * choice.pdf
    r.radiance = r.radiance / choice.pdf
    return r
