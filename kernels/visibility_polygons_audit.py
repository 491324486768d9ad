"""How wrong interpolated visibility is: polygons at points of every triangle against rays from there."""

import warp as wp

from warp_gi.kernels.bvh import bvh_occluded
from warp_gi.kernels.sampling import OWN_DIMENSION, cosine_direction, frame_of, hash_uint, random_1d
from warp_gi.kernels.surface import ray_offset
from warp_gi.kernels.types import SceneData
from warp_gi.kernels.visibility_polygons import (
    MATCHED,
    PolygonLists,
    PolygonSets,
    record_normal,
    record_point,
    walk_begun,
    walk_direction,
    walk_stepped,
)

wp.set_module_options({"enable_backward": False})

AUDIT_POINTS = wp.constant(4)
AUDIT_SIDE = wp.constant(16)  # rays of a point are so many times so many, in strata
MOST_EDGES = wp.constant(1040)  # of a polygon: MOST_STEPS, and a start and an end for each of MOST_LISTS


# Some records at a time, room for polygons, and what is found.
@wp.struct
class AuditBatch:
    start: wp.int32  # first record
    triangles: wp.int32
    seed: wp.uint32
    directions: wp.array(dtype=wp.vec3)  # [item * AUDIT_POINTS * MOST_EDGES] about the normal; (0, 0, 0) ends a contour
    errors: wp.array(dtype=wp.float32)  # [record * AUDIT_POINTS] shares of light that is wrongly seen or hidden


# Weights of a point within a triangle: the centre, and three towards the corners.
@wp.func
def audit_weights(k: wp.int32) -> wp.vec3:
    if k == 3:
        return wp.vec3(1.0 / 3.0, 1.0 / 3.0, 1.0 / 3.0)
    r = wp.vec3(0.15, 0.15, 0.15)
    r[k] = 0.7
    return r


# Writes the polygon at a point of a record, in the frame of its normal; returns the number of directions.
@wp.func
def write_polygon(
    sets: PolygonSets,
    lists: PolygonLists,
    batch: AuditBatch,
    record: wp.int32,
    weights: wp.vec3,
    frame: wp.mat33,
    base: wp.int32,
) -> wp.int32:
    count = int(0)
    corners = lists.corner_sets[record]
    for list in range(lists.list_starts[record], lists.list_starts[record + 1]):
        walk = walk_begun(sets, lists, list, corners, weights)
        batch.directions[base + count] = wp.transpose(frame) * walk_direction(walk)
        count += 1
        for k in range(lists.step_starts[list], lists.step_starts[list + 1]):
            walk = walk_stepped(sets, walk, wp.int32(lists.steps[k]))
            batch.directions[base + count] = wp.transpose(frame) * walk_direction(walk)
            count += 1
        batch.directions[base + count] = wp.vec3(0.0, 0.0, 0.0)
        count += 1
    return count


# How often the written polygon covers a direction about z.
@wp.func
def coverage(batch: AuditBatch, base: wp.int32, count: wp.int32, direction: wp.vec3) -> wp.int32:
    sum = int(0)
    a = batch.directions[base]
    from_a = a[0] * direction[1] - a[1] * direction[0]
    for k in range(1, count):
        b = batch.directions[base + k]
        from_b = b[0] * direction[1] - b[1] * direction[0]
        if from_a * from_b < 0.0 and wp.length_sq(a) > 0.0 and wp.length_sq(b) > 0.0:
            side = a[0] * b[1] - a[1] * b[0]
            if from_a * side > 0.0 and wp.dot(direction, wp.cross(a, b)) * side > 0.0:
                if side > 0.0:
                    sum += 1
                else:
                    sum -= 1
        a = b
        from_a = from_b
    return sum


# Thread: a point of a record of the batch. Writes the share of light under a uniform sky that is wrong there.
@wp.kernel
def audit_polygons(first: wp.int32, scene: SceneData, sets: PolygonSets, lists: PolygonLists, batch: AuditBatch):
    thread = first + wp.tid()
    item = thread / AUDIT_POINTS
    record = batch.start + item
    batch.errors[record * AUDIT_POINTS + thread % AUDIT_POINTS] = 1.0
    if lists.states[record] != wp.uint8(MATCHED):
        return
    weights = audit_weights(thread % AUDIT_POINTS)
    corners = lists.corner_sets[record]
    frame = frame_of(record_normal(sets, corners, weights))
    base = thread * MOST_EDGES
    count = write_polygon(sets, lists, batch, record, weights, frame, base)
    g = scene.geometry
    ids = g.indices[record % batch.triangles]
    normal = wp.normalize(wp.cross(g.points[ids[1]] - g.points[ids[0]], g.points[ids[2]] - g.points[ids[0]]))
    if record >= batch.triangles:
        normal = -normal
    point = record_point(sets, corners, weights)
    origin = point + normal * ray_offset(point, scene.radius)
    seed = hash_uint(batch.seed ^ hash_uint(wp.uint32(record * AUDIT_POINTS + thread % AUDIT_POINTS)))
    wrong = int(0)
    for k in range(AUDIT_SIDE * AUDIT_SIDE):
        u = wp.vec2(wp.float32(k % AUDIT_SIDE), wp.float32(k / AUDIT_SIDE))
        u = u + wp.vec2(random_1d(wp.uint32(k), seed, OWN_DIMENSION), random_1d(wp.uint32(k), seed, OWN_DIMENSION + 1))
        local = cosine_direction(u / wp.float32(AUDIT_SIDE))
        direction = frame * local
        seen = int(0)
        if wp.dot(direction, normal) > 0.0:
            seen = 1 - bvh_occluded(scene.bvh, origin, direction, float(wp.inf))
        if (coverage(batch, base, count, local) > 0) != (seen == 1):
            wrong += 1
    batch.errors[record * AUDIT_POINTS + thread % AUDIT_POINTS] = wp.float32(wrong) / wp.float32(
        AUDIT_SIDE * AUDIT_SIDE
    )
