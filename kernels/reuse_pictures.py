"""What pictures of sample reuse show: the octree leaf that a pixel sees, the light that comes there, a quadtree.

The light is path traced and counts as guided directions learn it: what an emitter sends straight to the point is left
out, for that is sampled by light samplers.
"""

import warp as wp

from warp_gi.kernels.bsdf import luminance
from warp_gi.kernels.bvh import bvh_intersect
from warp_gi.kernels.environment import environment_radiance
from warp_gi.kernels.gbuffer import CameraData, camera_origin, camera_ray
from warp_gi.kernels.octahedral import octahedral_decode, octahedral_encode
from warp_gi.kernels.octree import Octree, cell_code, octree_leaf
from warp_gi.kernels.parallax import seen_from_anchor
from warp_gi.kernels.path_trace import (
    NO_PATH,
    TERM_EMITTERS,
    TERM_ENVIRONMENT,
    TERM_INDIRECT,
    PathSamplers,
    PathSettings,
    trace_path,
)
from warp_gi.kernels.quadtree import quadtree_locate, quadtree_pdf
from warp_gi.kernels.sampling import CAMERA_DIMENSION, morton_code, sample_2d
from warp_gi.kernels.surface import ray_origin, surface_at
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})


# What rays through the middles of pixels meet, [item]; each thread writes its own item.
@wp.struct
class LeafView:
    leaves: wp.array(dtype=wp.int32)  # leaf of the octree; -1: no surface
    origins: wp.array(dtype=wp.vec3)  # points from which rays leave the surface, metres
    normals: wp.array(dtype=wp.vec3)  # geometric, unit, towards the camera


# An octahedral map of the light that comes to a point.
@wp.struct
class IncidentMap:
    origin: wp.vec3
    normal: wp.vec3  # directions below the surface get 0
    resolution: wp.int32
    rays: wp.int32  # rays of a texel, anywhere in it
    seed: wp.uint32
    max_depth: wp.int32  # edges of the longest path that is seen, that to the point included; below 2: none
    roulette_depth: wp.int32  # edges from which paths end at random, that to the point included
    sky_probability: wp.float32  # PathSettings
    sees_sky: wp.int32  # 1: count the sky's light that comes straight
    light: wp.array(dtype=wp.float32)  # [resolution^2] luminance of the mean radiance


# Thread: a pixel; item 0 is pixel number `begin`, row by row.
@wp.kernel
def view_leaves(first: wp.int32, scene: SceneData, camera: CameraData, begin: wp.int32, octree: Octree, view: LeafView):
    item = first + wp.tid()
    row = (begin + item) / camera.width
    column = begin + item - row * camera.width
    x = wp.float32(column) + 0.5
    y = wp.float32(row) + 0.5
    direction = camera_ray(camera, x, y)
    hit = bvh_intersect(scene.bvh, camera_origin(camera, x, y), direction, float(wp.inf))
    view.leaves[item] = -1
    if hit.face >= 0:
        s = surface_at(scene, hit.face, hit.u, hit.v, -direction)
        view.leaves[item] = octree_leaf(octree.nodes, cell_code(octree, s.position))
        view.origins[item] = ray_origin(s)
        view.normals[item] = s.normal


# Luminance of the radiance that comes to the point from a direction.
@wp.func
def incident_luminance(scene: SceneData, incident: IncidentMap, direction: wp.vec3, index: wp.uint32) -> wp.float32:
    if wp.dot(direction, incident.normal) <= 0.0:
        return 0.0
    hit = bvh_intersect(scene.bvh, incident.origin, direction, float(wp.inf))
    if hit.face < 0:
        if incident.sees_sky == 0:
            return 0.0
        return luminance(environment_radiance(scene.environment, direction))
    paths = PathSettings()
    paths.terms = TERM_ENVIRONMENT | TERM_EMITTERS | TERM_INDIRECT
    paths.max_depth = incident.max_depth
    paths.roulette_depth = incident.roulette_depth
    paths.sky_probability = incident.sky_probability
    s = surface_at(scene, hit.face, hit.u, hit.v, -direction)
    path = trace_path(scene, PathSamplers(), hit, s, -direction, paths, index, incident.seed, NO_PATH)
    return luminance(path.environment + path.emitters + path.indirect)


# Thread: a texel. Writes the mean luminance of the light that comes from its directions.
@wp.kernel
def map_incident_light(first: wp.int32, scene: SceneData, incident: IncidentMap):
    texel = first + wp.tid()
    row = texel / incident.resolution
    column = texel - row * incident.resolution
    begin = morton_code(column, row) * wp.uint32(incident.rays)
    total = float(0.0)
    for ray in range(incident.rays):
        index = begin + wp.uint32(ray)
        u = sample_2d(index, incident.seed, CAMERA_DIMENSION)
        uv = wp.vec2(wp.float32(column) + u[0], wp.float32(row) + u[1]) / wp.float32(incident.resolution)
        total += incident_luminance(scene, incident, octahedral_decode(uv), index)
    incident.light[texel] = total / wp.float32(incident.rays)


# Thread: a pixel of an octahedral map. Writes the density [1/sr] that a region's tree has at a position in the
# direction of the pixel's middle, and the node of the quadtree's leaf there.
@wp.kernel
def map_quadtree(
    first: wp.int32,
    tree: wp.vec4ui,
    bits: wp.int32,
    anchor: wp.vec4,
    position: wp.vec3,
    resolution: wp.int32,
    densities: wp.array(dtype=wp.float32),
    leaves: wp.array(dtype=wp.int32),
):
    pixel = first + wp.tid()
    row = pixel / resolution
    column = pixel - row * resolution
    uv = wp.vec2(wp.float32(column) + 0.5, wp.float32(row) + 0.5) / wp.float32(resolution)
    seen = seen_from_anchor(anchor, position, octahedral_decode(uv))
    densities[pixel] = quadtree_pdf(tree, bits, seen.direction) * seen.stretch
    leaves[pixel] = quadtree_locate(tree, bits, octahedral_encode(seen.direction)).node
