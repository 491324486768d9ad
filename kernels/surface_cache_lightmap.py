"""Light maps: irradiance at texels of surfaces, gathered by paths that end in a surface cache.

A path is one of the path tracer's that begins at the texel, as if its first hit were there, on a white surface without
a glossy lobe. Such a surface sends 1 / pi of its irradiance in every direction, so irradiance is pi times the radiance
of the path. The cache is read one bounce later, by the rules of all paths: its cells do not show in the map.
"""

import warp as wp

from warp_gi.kernels.atlas_slots import are_parted
from warp_gi.kernels.bsdf import lambert
from warp_gi.kernels.bvh import BvhHit
from warp_gi.kernels.path_samplers import ALIAS_LIGHTS, BSDF_DIRECTIONS, NO_REGIONS, SCENE_SKY
from warp_gi.kernels.path_trace import NO_PATH, PathSettings, path_tracer
from warp_gi.kernels.sampling import frame_of, hash_uint
from warp_gi.kernels.surface import Surface, ray_offset, ray_origin, shading_normal
from warp_gi.kernels.surface_cache import SURFACE_CACHE
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

TRACER = path_tracer(ALIAS_LIGHTS, BSDF_DIRECTIONS, NO_REGIONS, SCENE_SKY, SURFACE_CACHE)
LightMapSamplers = TRACER.samplers
trace_path = TRACER.trace_path


# Where the light of texels is gathered: each has places on the surface, among which its samples are shared out.
@wp.struct
class LightMapPlaces:
    starts: wp.array(dtype=wp.int32)  # [texel + 1] first place of each texel
    faces: wp.array(dtype=wp.int32)  # [place]
    points: wp.array(dtype=wp.vec2)  # [place] u, v
    samples: wp.int32  # of a texel
    seed: wp.uint32


# The front of a face at (u, v) as a white surface under its interpolated normal: engines lay normal maps over the map.
@wp.func
def white_front(scene: SceneData, face: wp.int32, u: wp.float32, v: wp.float32) -> Surface:
    s = Surface()
    g = scene.geometry
    ids = g.indices[face]
    p0 = g.points[ids[0]]
    p1 = g.points[ids[1]]
    p2 = g.points[ids[2]]
    w = 1.0 - u - v
    s.position = p0 * w + p1 * u + p2 * v
    s.offset = ray_offset(s.position, scene.radius)
    s.normal = wp.normalize(wp.cross(p1 - p0, p2 - p0))
    shading = g.normals[ids[0]] * w + g.normals[ids[1]] * u + g.normals[ids[2]] * v
    length = wp.length(shading)
    if length <= 1.0e-6:
        shading = s.normal
    elif wp.dot(shading, s.normal) >= 0.0:
        shading = shading / length
    else:  # files whose normals point to the back of their triangles
        shading = shading / -length
    s.shading = frame_of(shading)
    s.bsdf = lambert(wp.vec3(1.0, 1.0, 1.0))
    s.base_color = wp.vec3(1.0, 1.0, 1.0)
    s.texture = -1
    return s


@wp.func
def white_at(scene: SceneData, places: LightMapPlaces, place: wp.int32) -> Surface:
    return white_front(scene, places.faces[place], places.points[place][0], places.points[place][1])


# First sample of place number k among `count` of a texel: consecutive samples go to one place, as each aligned block
# of them is spread over the hemisphere by itself.
@wp.func
def first_sample(places: LightMapPlaces, k: wp.int32, count: wp.int32) -> wp.int32:
    return k * places.samples / count


# Thread: a texel, from texel `start` on. Its irradiance [W/m^2] by all light. Places that get no light at all, and that
# a surface parts from others that do, lie behind what cuts the texel's surface, and are left out.
@wp.kernel
def gather_light(
    first: wp.int32,
    start: wp.int32,
    scene: SceneData,
    samplers: LightMapSamplers,
    paths: PathSettings,
    places: LightMapPlaces,
    irradiance: wp.array(dtype=wp.vec3),
):
    texel = start + first + wp.tid()
    begin = places.starts[texel]
    count = places.starts[texel + 1] - begin
    seed = hash_uint(wp.uint32(texel) ^ hash_uint(places.seed))
    sum = wp.vec3(0.0, 0.0, 0.0)
    taken = int(0)
    lit = int(-1)
    dark = int(0)
    for place in range(count):
        s = white_at(scene, places, begin + place)
        hit = BvhHit()
        hit.face = places.faces[begin + place]
        hit.u = places.points[begin + place][0]
        hit.v = places.points[begin + place][1]
        light = wp.vec3(0.0, 0.0, 0.0)
        for k in range(first_sample(places, place, count), first_sample(places, place + 1, count)):
            r = trace_path(scene, samplers, hit, s, shading_normal(s), paths, wp.uint32(k), seed, NO_PATH)
            light = light + r.environment + r.emitters + r.indirect
        if wp.max(light) > 0.0:
            sum = sum + light
            taken += first_sample(places, place + 1, count) - first_sample(places, place, count)
            lit = place
        else:
            dark = dark | (1 << place)
    for place in range(count):
        if (dark & (1 << place)) != 0:
            is_behind = wp.bool(False)
            if lit >= 0:
                here = ray_origin(white_at(scene, places, begin + place))
                is_behind = are_parted(scene, here, ray_origin(white_at(scene, places, begin + lit)))
            if not is_behind:
                taken += first_sample(places, place + 1, count) - first_sample(places, place, count)
    irradiance[texel] = sum * (wp.pi / wp.float32(wp.max(taken, 1)))
