"""Lights far brighter than they are large: suns of a sky map, and lights without size. Each gets a ray of its own.

A sun is what the nodes of a bright blob have above a limit; the rest of the sky has them cut off there. A map is linear
in its nodes, so both add up to it. A sun is sampled as the map is (environment.py), from its few nodes alone.
"""

import warp as wp

from warp_gi.kernels.alias import LARGEST_FLOAT_BELOW_ONE
from warp_gi.kernels.emitters import LightSample, punctual_light
from warp_gi.kernels.environment import (
    EnvironmentLookup,
    EnvironmentSample,
    Patch,
    environment_arrival,
    environment_lookup,
    environment_prefetch,
    environment_radiance,
    environment_sample,
    lat_long_encode,
    node_sample,
    patch_at,
    patch_nodes,
    patch_pdf,
    patch_texel,
    polar_angle,
)
from warp_gi.kernels.path_samplers import ApartLights, Sky, leave_no_record
from warp_gi.kernels.types import ENVIRONMENT_MAP, ENVIRONMENT_NONE, Environment, SceneData

wp.set_module_options({"enable_backward": False})

INFINITELY_FAR = wp.constant(wp.float32(1.0e30))  # metres


# A blob of bright nodes.
@wp.struct
class Sun:
    direction: wp.vec3  # unit, in the map's own space
    cos_cone: wp.float32  # of a cone about it that holds all of its light
    start: wp.int32  # in ApartData.nodes
    stop: wp.int32
    density: wp.float32  # luminance of the rest of the map over that of this sun: densities are larger by so much


@wp.struct
class ApartData:
    rest: Environment  # the sky without its suns; unused where there are none
    sun_count: wp.int32
    suns: wp.array(dtype=Sun)
    nodes: wp.array(dtype=wp.int32)  # of the map, sun by sun
    sums: wp.array(dtype=wp.float32)  # [node] probability of a node of the sun up to this one
    light_count: wp.int32  # of emitters: all, if they are few and without size, or none


@wp.func
def apart_count(data: ApartData) -> wp.int32:
    return data.sun_count + data.light_count


@wp.func
def apart_is_sky(data: ApartData, light: wp.int32) -> wp.bool:
    return light < data.sun_count


@wp.func
def apart_holds_emitters(data: ApartData) -> wp.bool:
    return data.light_count > 0


# Radiance of suns at a place in a patch of nodes, and the density of samples of the one sun.
@wp.func
def sun_light(
    data: ApartData, whole: Environment, all: Patch, sine: wp.float32, density: wp.float32
) -> EnvironmentLookup:
    rest = patch_nodes(data.rest, all.row, all.column)
    rest.s = all.s
    rest.t = all.t
    texel = wp.max(patch_texel(all) - patch_texel(rest), wp.vec3(0.0, 0.0, 0.0))
    r = EnvironmentLookup()
    r.radiance = wp.cw_mul(texel, whole.radiance)
    r.pdf = patch_pdf(data.rest, all.row, texel, sine) * density
    return r


# The node of a sun at which the running sum passes u.
@wp.func
def sun_node(data: ApartData, sun: Sun, u: wp.float32) -> wp.int32:
    low = int(sun.start)
    high = int(sun.stop - 1)
    while low < high:
        middle = (low + high) / 2
        if u < data.sums[middle]:
            high = middle
        else:
            low = middle + 1
    return low


@wp.func
def sun_sample(data: ApartData, scene: SceneData, sun: Sun, u: wp.vec2) -> LightSample:
    at = sun_node(data, sun, u[0])
    below = float(0.0)
    if at > sun.start:
        below = data.sums[at - 1]
    across = wp.clamp((u[0] - below) / (data.sums[at] - below), 0.0, LARGEST_FLOAT_BELOW_ONE)
    rest = node_sample(data.rest, data.nodes[at], across, u[1])
    all = patch_nodes(scene.environment, rest.row, rest.column)
    all.s = rest.s
    all.t = rest.t
    found = sun_light(data, scene.environment, all, polar_angle(rest.row, rest.t, data.rest.height)[1], sun.density)
    r = LightSample()
    r.direction = rest.direction
    r.distance = INFINITELY_FAR
    r.pdf = found.pdf
    if found.pdf > 0.0:
        r.radiance = found.radiance / found.pdf
    return r


@wp.func
def apart_sample(data: ApartData, scene: SceneData, position: wp.vec3, light: wp.int32, u: wp.vec2) -> LightSample:
    if light < data.sun_count:
        return sun_sample(data, scene, data.suns[light], u)
    return punctual_light(scene.emitters.emitters[light - data.sun_count], position)


# Whether one of the four nodes of a patch is of a sun.
@wp.func
def sun_has(data: ApartData, sun: Sun, patch: Patch) -> wp.bool:
    width = data.rest.width
    for k in range(sun.start, sun.stop):
        row = data.nodes[k] / width
        across = data.nodes[k] - row * width - patch.column  # columns are one more than patches, and go around
        if row - patch.row == 0 or row - patch.row == 1:
            if across == 0 or across == 1 or across == width or across == 1 - width:
                return True
    return False


# What suns send from a direction: that of one, as no two reach the same patch. Few directions are in a cone.
@wp.func
def apart_lookup(data: ApartData, scene: SceneData, direction: wp.vec3) -> EnvironmentLookup:
    r = EnvironmentLookup()
    local = data.rest.environment_from_world * direction
    for k in range(data.sun_count):
        sun = data.suns[k]
        if wp.dot(local, sun.direction) >= sun.cos_cone:
            patch = patch_at(scene.environment, lat_long_encode(local))
            if sun_has(data, sun, patch):
                sine = wp.sqrt(local[0] * local[0] + local[2] * local[2])
                return sun_light(data, scene.environment, patch, sine, sun.density)
    return r


@wp.func
def apart_sky_is_lit(data: ApartData, scene: SceneData) -> wp.bool:
    return scene.environment.kind != ENVIRONMENT_NONE


@wp.func
def apart_sky_is_sampled(data: ApartData, scene: SceneData) -> wp.bool:
    return scene.environment.kind == ENVIRONMENT_MAP


@wp.func
def apart_sky_prefetch(data: ApartData, scene: SceneData, u: wp.vec3, first: wp.bool):
    if first and data.sun_count > 0:
        environment_prefetch(data.rest, u)
    else:
        environment_prefetch(scene.environment, u)


@wp.func
def apart_sky_sample(data: ApartData, scene: SceneData, u: wp.vec3, first: wp.bool) -> EnvironmentSample:
    if first and data.sun_count > 0:
        return environment_sample(data.rest, u)
    return environment_sample(scene.environment, u)


@wp.func
def apart_sky_arrival(data: ApartData, scene: SceneData, e: EnvironmentSample, first: wp.bool) -> EnvironmentLookup:
    if first and data.sun_count > 0:
        return environment_arrival(data.rest, e)
    return environment_arrival(scene.environment, e)


@wp.func
def apart_sky_lookup(data: ApartData, scene: SceneData, direction: wp.vec3, first: wp.bool) -> EnvironmentLookup:
    if first and data.sun_count > 0:
        return environment_lookup(data.rest, direction)
    return environment_lookup(scene.environment, direction)


@wp.func
def apart_sky_radiance(data: ApartData, scene: SceneData, direction: wp.vec3) -> wp.vec3:
    return environment_radiance(scene.environment, direction)


APART_LIGHTS = Sky(
    "apart",
    ApartData,
    apart_sky_is_lit,
    apart_sky_is_sampled,
    apart_sky_prefetch,
    apart_sky_sample,
    apart_sky_arrival,
    apart_sky_lookup,
    apart_sky_radiance,
    leave_no_record,
    ApartLights(apart_count, apart_is_sky, apart_sample, apart_lookup, apart_holds_emitters),
)
"""The scene's sky and lights, with those apart that are far brighter than they are large."""
