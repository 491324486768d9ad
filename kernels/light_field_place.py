"""Where light field probes stand: what points in a scene see all around them, and the way out of walls."""

import warp as wp

from warp_gi.kernels.bsdf import bsdf_sample
from warp_gi.kernels.bvh import bvh_intersect
from warp_gi.kernels.environment import environment_radiance
from warp_gi.kernels.gbuffer import CameraData, camera_origin, camera_ray
from warp_gi.kernels.light_field import LightField
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
    CAMERA_DIMENSION,
    REACH_DIMENSION,
    REACH_VERTEX_DIMENSIONS,
    hash_uint,
    sample_1d,
    sample_2d,
)
from warp_gi.kernels.surface import ray_origin, surface_at, surface_emission
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

PLACE_STEPS = wp.constant(6)  # largest number of moves of a probe
PLACE_BACK = wp.constant(wp.float32(0.25))  # share of back faces above which a probe leaves through one
LIGHT_DEPTH = wp.constant(6)  # edges of the longest path that finds where light is
REACH_VERTICES = wp.constant(3)  # vertices of a path that finds what a camera reaches: the first hit and two more
PROBE_FACTOR = wp.constant(wp.uint32(2654435769))


# 1 where a ray meets the back of a triangle.
@wp.func
def sees_back(scene: SceneData, face: wp.int32, direction: wp.vec3) -> wp.int32:
    ids = scene.geometry.indices[face]
    p0 = scene.geometry.points[ids[0]]
    front = wp.cross(scene.geometry.points[ids[1]] - p0, scene.geometry.points[ids[2]] - p0)
    return wp.where(wp.dot(front, direction) > 0.0, 1, 0)


# Direction k of `count`, unit, on a spiral from pole to pole that covers the sphere evenly.
@wp.func
def spiral_direction(k: wp.int32, count: wp.int32) -> wp.vec3:
    y = 1.0 - (2.0 * wp.float32(k) + 1.0) / wp.float32(count)
    angle = wp.float32(k) * 2.399963229728653
    across = wp.sqrt(1.0 - y * y)
    return wp.vec3(across * wp.cos(angle), y, across * wp.sin(angle))


# What a point sees in all directions.
@wp.struct
class Outlook:
    back: wp.float32  # share of directions that meet the back of a triangle
    nearest: wp.float32  # metres to the nearest front
    towards: wp.vec3  # unit direction of the nearest front
    nearest_back: wp.float32  # metres to the nearest back
    towards_back: wp.vec3  # unit direction of the nearest back


@wp.func
def look_around(scene: SceneData, at: wp.vec3, directions: wp.int32) -> Outlook:
    r = Outlook()
    r.nearest = wp.inf
    r.nearest_back = wp.inf
    for k in range(directions):
        direction = spiral_direction(k, directions)
        hit = bvh_intersect(scene.bvh, at, direction, float(wp.inf))
        if hit.face >= 0:
            if sees_back(scene, hit.face, direction) != 0:
                r.back += 1.0 / wp.float32(directions)
                if hit.t < r.nearest_back:
                    r.nearest_back = hit.t
                    r.towards_back = direction
            elif hit.t < r.nearest:
                r.nearest = hit.t
                r.towards = direction
    return r


# Thread: a direction from a point, item `point * directions + direction` of `light`. Writes the radiance that a path
# finds there, W/(m^2 sr), as the mean over the channels; -1 where it meets the back of a triangle. `points` are
# [point] in metres; `sky_probability` is that of PathSettings, in [0, 1].
@wp.kernel
def measure_light(
    first: wp.int32,
    scene: SceneData,
    points: wp.array(dtype=wp.vec3),
    directions: wp.int32,
    sky_probability: wp.float32,
    light: wp.array(dtype=wp.float32),
):
    i = first + wp.tid()
    point = i / directions
    direction = spiral_direction(i - point * directions, directions)
    hit = bvh_intersect(scene.bvh, points[point], direction, float(wp.inf))
    if hit.face < 0:
        sky = environment_radiance(scene.environment, direction)
        light[i] = (sky[0] + sky[1] + sky[2]) / 3.0
        return
    if sees_back(scene, hit.face, direction) != 0:
        light[i] = -1.0
        return
    paths = PathSettings()
    paths.terms = TERM_ENVIRONMENT | TERM_EMITTERS | TERM_INDIRECT
    paths.max_depth = LIGHT_DEPTH
    paths.roulette_depth = LIGHT_DEPTH
    paths.sky_probability = sky_probability
    s = surface_at(scene, hit.face, hit.u, hit.v, -direction)
    seed = hash_uint(wp.uint32(point) * PROBE_FACTOR)
    index = wp.uint32(i - point * directions)
    path = trace_path(scene, PathSamplers(), hit, s, -direction, paths, index, seed, NO_PATH)
    total = path.environment + path.emitters + path.indirect
    total = total + surface_emission(scene, hit.face, hit.u, hit.v, -direction)
    light[i] = (total[0] + total[1] + total[2]) / 3.0


# Thread: a path from the camera through a random point of the picture, by the BSDF. Writes the points that it meets,
# in metres, to its own items of `points`, [path * REACH_VERTICES], and 1 to those of `found` for each that it meets;
# the others keep the 0 that the caller set.
@wp.kernel
def follow_paths(
    first: wp.int32,
    scene: SceneData,
    camera: CameraData,
    seed: wp.uint32,
    points: wp.array(dtype=wp.vec3),
    found: wp.array(dtype=wp.uint8),
):
    path = first + wp.tid()
    index = wp.uint32(path)
    u = sample_2d(index, seed, CAMERA_DIMENSION)
    x = u[0] * wp.float32(camera.width)
    y = u[1] * wp.float32(camera.height)
    origin = camera_origin(camera, x, y)
    direction = camera_ray(camera, x, y)
    vertices = int(REACH_VERTICES)
    for k in range(vertices):
        hit = bvh_intersect(scene.bvh, origin, direction, float(wp.inf))
        if hit.face < 0:
            break
        s = surface_at(scene, hit.face, hit.u, hit.v, -direction)
        points[path * vertices + k] = s.position
        found[path * vertices + k] = wp.uint8(1)
        d = REACH_DIMENSION + k * REACH_VERTEX_DIMENSIONS
        wo = wp.transpose(s.shading) * -direction
        b = bsdf_sample(s.bsdf, wo, sample_1d(index, seed, d), sample_2d(index, seed, d + 1))
        direction = s.shading * b.wi
        if b.pdf <= 0.0 or wp.dot(direction, s.normal) <= 0.0:
            break
        origin = ray_origin(s)


# Thread: a probe. Moves it out of what it is inside of, through the nearest back face, or away from a front face that
# is nearer than `clearance` (metres). It moves by at most `most` (metres) along each axis, and tries `directions` of
# them at each place. Writes its own item of `field.positions`; nothing else in `field` is read or written.
@wp.kernel
def place_probes(
    first: wp.int32, scene: SceneData, field: LightField, most: wp.vec3, clearance: wp.float32, directions: wp.int32
):
    probe = first + wp.tid()
    home = field.positions[probe]
    at = home
    best = home
    best_back = float(2.0)
    best_room = float(0.0)
    steps = int(PLACE_STEPS)
    for _step in range(steps):
        view = look_around(scene, at, directions)
        room = wp.min(view.nearest, clearance)
        if view.back < best_back - 0.05 or (view.back < best_back + 0.05 and room > best_room):
            best = at
            best_back = view.back
            best_room = room
        if view.back > PLACE_BACK and view.nearest_back < wp.inf:
            at = at + view.towards_back * (view.nearest_back + clearance)
        elif view.nearest < clearance:
            at = at - view.towards * (clearance - view.nearest)
        else:
            break
        for axis in range(3):
            at[axis] = wp.clamp(at[axis], home[axis] - most[axis], home[axis] + most[axis])
    field.positions[probe] = best
