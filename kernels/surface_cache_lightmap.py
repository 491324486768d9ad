"""Light maps: irradiance at texels of surfaces, gathered by paths that end in a surface cache.

A path is one of the path tracer's that begins at the texel, as if its first hit were there, on a white surface without
a glossy lobe. Such a surface sends 1 / pi of its irradiance in every direction, so irradiance is pi times the radiance
of the path. The cache is read one bounce later, by the rules of all paths: its cells do not show in the map.
"""

import warp as wp

from warp_gi.kernels.atlas_slots import are_parted
from warp_gi.kernels.bsdf import lambert, luminance
from warp_gi.kernels.bvh import BvhHit
from warp_gi.kernels.light_hierarchy import HIERARCHY_LIGHTS
from warp_gi.kernels.path_samplers import BSDF_DIRECTIONS, NO_REGIONS, SCENE_SKY
from warp_gi.kernels.path_trace import NO_PATH, PathSettings, path_tracer
from warp_gi.kernels.sampling import frame_of, hash_uint
from warp_gi.kernels.surface import Surface, ray_offset, ray_origin, shading_normal
from warp_gi.kernels.surface_cache import SURFACE_CACHE
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

SIDE = wp.constant(2)  # places along a side of a texel, which smooths the edges of shadows
MOST_PLACES = wp.constant(SIDE * SIDE)  # of a texel
DARKER = wp.constant(wp.float32(0.1))  # share of the light of the brightest place, below which another may be behind

TRACER = path_tracer(HIERARCHY_LIGHTS, BSDF_DIRECTIONS, NO_REGIONS, SCENE_SKY, SURFACE_CACHE, tints=True)
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


# Light of the samples of place number k among `count` of a texel, their sum.
@wp.func
def place_light(
    scene: SceneData,
    samplers: LightMapSamplers,
    paths: PathSettings,
    places: LightMapPlaces,
    place: wp.int32,
    begin: wp.int32,
    end: wp.int32,
    seed: wp.uint32,
) -> wp.vec3:
    s = white_at(scene, places, place)
    hit = BvhHit()
    hit.face = places.faces[place]
    hit.u = places.points[place][0]
    hit.v = places.points[place][1]
    light = wp.vec3(0.0, 0.0, 0.0)
    for k in range(begin, end):
        r = trace_path(scene, samplers, hit, s, shading_normal(s), paths, wp.uint32(k), seed, NO_PATH)
        light = light + r.environment + r.emitters + r.indirect
    return light


# Thread: a texel, from texel `start` on. Its irradiance [W/m^2] by all light. Places that are much darker than the
# brightest, and that a surface parts from it, lie behind what cuts the texel's surface, and are left out.
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
    lights = wp.matrix(shape=(MOST_PLACES, 3), dtype=wp.float32)
    brightest = int(0)
    most = float(-1.0)
    for place in range(count):
        low = first_sample(places, place, count)
        high = first_sample(places, place + 1, count)
        light = place_light(scene, samplers, paths, places, begin + place, low, high, seed)
        lights[place] = light
        mean = luminance(light) / wp.float32(wp.max(high - low, 1))
        if mean > most:
            most = mean
            brightest = place
    sum = wp.vec3(0.0, 0.0, 0.0)
    taken = int(0)
    lit = ray_origin(white_at(scene, places, begin + brightest))
    for place in range(count):
        samples = first_sample(places, place + 1, count) - first_sample(places, place, count)
        light = wp.vec3(lights[place, 0], lights[place, 1], lights[place, 2])
        is_behind = bool(False)
        if luminance(light) < DARKER * most * wp.float32(samples):
            is_behind = are_parted(scene, ray_origin(white_at(scene, places, begin + place)), lit)
        if not is_behind:
            sum = sum + light
            taken += samples
    irradiance[texel] = sum * (wp.pi / wp.float32(wp.max(taken, 1)))
