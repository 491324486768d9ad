"""Slots of an atlas as places on surfaces: the surface there, what its rays meet, and what lies between two of them.

Some slots lie inside of other objects, or behind surfaces that cut theirs. Their rays meet backs of surfaces, and a
surface parts them from their neighbours outside: these stand in for them.
"""

import warp as wp

from warp_gi.kernels.atlas import BACK, SurfaceAtlas, atlas_nearest, side_seen
from warp_gi.kernels.bvh import bvh_intersect, bvh_occluded
from warp_gi.kernels.light_connections import SHADOW_END
from warp_gi.kernels.sampling import OWN_DIMENSION, cosine_direction, hash_uint, sample_2d
from warp_gi.kernels.surface import Surface, ray_origin, surface_shape
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})


# Where the slots are: see warp_gi/techniques/shared/atlas/atlas.py.
@wp.struct
class AtlasSlots:
    faces: wp.array(dtype=wp.int32)  # [slot]
    points: wp.array(dtype=wp.vec2)  # [slot] u, v
    sides: wp.array(dtype=wp.uint8)  # [slot]


# The surface at a slot, seen from its side.
@wp.func
def slot_surface(scene: SceneData, slots: AtlasSlots, slot: wp.int32) -> Surface:
    face = slots.faces[slot]
    ids = scene.geometry.indices[face]
    p0 = scene.geometry.points[ids[0]]
    normal = wp.normalize(wp.cross(scene.geometry.points[ids[1]] - p0, scene.geometry.points[ids[2]] - p0))
    if wp.int32(slots.sides[slot]) == BACK:
        normal = -normal
    return surface_shape(scene, face, slots.points[slot][0], slots.points[slot][1], normal)


# Whether a surface lies between two points, which are a little above their own.
@wp.func
def are_parted(scene: SceneData, a: wp.vec3, b: wp.vec3) -> wp.bool:
    way = b - a
    length = wp.length(way)
    return length > 0.0 and bvh_occluded(scene.bvh, a, way / length, length * SHADOW_END) != 0


# Thread: a pair of slots. Tells whether a surface lies between them, a little above their own.
@wp.kernel
def part_slots(
    first: wp.int32,
    scene: SceneData,
    slots: AtlasSlots,
    ones: wp.array(dtype=wp.int32),
    others: wp.array(dtype=wp.int32),
    parted: wp.array(dtype=wp.uint8),
):
    pair = first + wp.tid()
    one = ray_origin(slot_surface(scene, slots, ones[pair]))
    other = ray_origin(slot_surface(scene, slots, others[pair]))
    parted[pair] = wp.uint8(wp.where(are_parted(scene, one, other), 1, 0))


# What rays from slots meet, in numbers of rays.
@wp.struct
class SlotLooks:
    rays: wp.int32  # a slot
    inside: wp.array(dtype=wp.int32)  # [slot] that meet a side on which nothing is kept: backs of closed objects
    backs: wp.array(dtype=wp.int32)  # [slot] that meet such a side or any other back


# Thread: a slot. Counts what its rays meet; nothing of the scene moves.
@wp.kernel
def look_around(first: wp.int32, scene: SceneData, atlas: SurfaceAtlas, slots: AtlasSlots, looks: SlotLooks):
    slot = first + wp.tid()
    s = slot_surface(scene, slots, slot)
    origin = ray_origin(s)
    seed = hash_uint(wp.uint32(slot))
    inside = int(0)
    backs = int(0)
    for k in range(looks.rays):
        direction = s.shading * cosine_direction(sample_2d(wp.uint32(k), seed, OWN_DIMENSION))
        if wp.dot(direction, s.normal) > 0.0:
            hit = bvh_intersect(scene.bvh, origin, direction, float(wp.inf))
            if hit.face >= 0:
                side = side_seen(scene, hit.face, direction)
                if atlas_nearest(atlas, hit.face, hit.u, hit.v, side) < 0:
                    inside += 1
                    backs += 1
                elif side == BACK:
                    backs += 1
    looks.inside[slot] = inside
    looks.backs[slot] = backs
