"""Polygons of what vertices see of the sky, and those of points between them, by interpolation.

A set of a vertex is what it sees on one side of its surface: closed contours of points (d, w), d a unit direction from
the vertex and w one over the distance of the occluder there, 0 for the horizon. What is visible lies to the left of a
contour, seen from outside the sphere. From a point s a contour's point lies in direction d + w (p - s), p the vertex
(visibility_correspondence.txt, Eq. 3): a segment that is straight in (d, w) is an arc of a great circle from every s.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

MOST_LISTS = wp.constant(8)  # contours of a vertex that are followed over a triangle; above, the triangle is traced

# State of a side of a triangle.
TRACED = wp.constant(0)  # a corner sees nothing or has no set, or contours do not match
MATCHED = wp.constant(1)  # polygons are interpolated
FLAGGED = wp.constant(2)  # contours match, yet interpolation was found too wrong: traced


@wp.struct
class PolygonSets:
    positions: wp.array(dtype=wp.vec3)  # [set] metres
    normals: wp.array(dtype=wp.vec3)  # [set] unit, on the side that sees
    contour_starts: wp.array(dtype=wp.int32)  # [set + 1]
    point_starts: wp.array(dtype=wp.int32)  # [contour + 1]
    points: wp.array(dtype=wp.vec4)  # [point] (d, w), w in 1/m


# Which points of three contours belong together: from points `starts` on, each step advances the contours whose bits
# (1, 2, 4) are set by one point; the last step comes back to the start.
@wp.struct
class PolygonLists:
    corner_sets: wp.array(dtype=wp.vec3i)  # [record] a record is a side of a triangle: side * triangles + triangle
    states: wp.array(dtype=wp.uint8)  # [record] TRACED, MATCHED or FLAGGED
    list_starts: wp.array(dtype=wp.int32)  # [record + 1]
    contours: wp.array(dtype=wp.vec3i)  # [list] one of each corner
    starts: wp.array(dtype=wp.vec3i)  # [list] points within the contours
    step_starts: wp.array(dtype=wp.int32)  # [list + 1]
    steps: wp.array(dtype=wp.uint8)  # [step]


# Three contours as a point of the triangle sees them, and where in their list we are.
@wp.struct
class ContourWalk:
    first: wp.vec3i  # points of the contours
    count: wp.vec3i
    at: wp.vec3i  # within the contours
    to_a: wp.vec3  # from the point to the corners, metres
    to_b: wp.vec3
    to_c: wp.vec3
    weights: wp.vec3  # barycentric
    a: wp.vec3  # unit directions of the three
    b: wp.vec3
    c: wp.vec3


# Unit direction in which a point of a contour lies, `away` metres from the vertex: the vertex minus the point.
@wp.func
def synthesized(q: wp.vec4, away: wp.vec3) -> wp.vec3:
    return wp.normalize(wp.vec3(q[0], q[1], q[2]) + away * q[3])


# Direction between three, by unit vectors (Eq. 21).
@wp.func
def walk_direction(walk: ContourWalk) -> wp.vec3:
    return wp.normalize(walk.a * walk.weights[0] + walk.b * walk.weights[1] + walk.c * walk.weights[2])


# Point of the triangle of a record with these barycentric weights.
@wp.func
def record_point(sets: PolygonSets, corners: wp.vec3i, weights: wp.vec3) -> wp.vec3:
    p = sets.positions
    return p[corners[0]] * weights[0] + p[corners[1]] * weights[1] + p[corners[2]] * weights[2]


@wp.func
def record_normal(sets: PolygonSets, corners: wp.vec3i, weights: wp.vec3) -> wp.vec3:
    n = sets.normals
    return wp.normalize(n[corners[0]] * weights[0] + n[corners[1]] * weights[1] + n[corners[2]] * weights[2])


# The start of a list, as the point with these weights sees it.
@wp.func
def walk_begun(
    sets: PolygonSets, lists: PolygonLists, list: wp.int32, corners: wp.vec3i, weights: wp.vec3
) -> ContourWalk:
    r = ContourWalk()
    contours = lists.contours[list]
    r.at = lists.starts[list]
    for k in range(3):
        r.first[k] = sets.point_starts[contours[k]]
        r.count[k] = sets.point_starts[contours[k] + 1] - r.first[k]
    r.weights = weights
    point = record_point(sets, corners, weights)
    r.to_a = sets.positions[corners[0]] - point
    r.to_b = sets.positions[corners[1]] - point
    r.to_c = sets.positions[corners[2]] - point
    r.a = synthesized(sets.points[r.first[0] + r.at[0]], r.to_a)
    r.b = synthesized(sets.points[r.first[1] + r.at[1]], r.to_b)
    r.c = synthesized(sets.points[r.first[2] + r.at[2]], r.to_c)
    return r


@wp.func
def next_of(at: wp.int32, count: wp.int32) -> wp.int32:
    if at + 1 == count:
        return 0
    return at + 1


# One step on.
@wp.func
def walk_stepped(sets: PolygonSets, walk: ContourWalk, step: wp.int32) -> ContourWalk:
    r = walk
    if (step & 1) != 0:
        r.at[0] = next_of(r.at[0], r.count[0])
        r.a = synthesized(sets.points[r.first[0] + r.at[0]], r.to_a)
    if (step & 2) != 0:
        r.at[1] = next_of(r.at[1], r.count[1])
        r.b = synthesized(sets.points[r.first[1] + r.at[1]], r.to_b)
    if (step & 4) != 0:
        r.at[2] = next_of(r.at[2], r.count[2])
        r.c = synthesized(sets.points[r.first[2] + r.at[2]], r.to_c)
    return r


# The signed number of times that the triangle (center, a, b) on the sphere covers a direction: 1, -1 or 0.
@wp.func
def covers(center: wp.vec3, a: wp.vec3, b: wp.vec3, direction: wp.vec3) -> wp.int32:
    side = wp.dot(center, wp.cross(a, b))
    from_a = wp.dot(direction, wp.cross(center, a)) * side
    from_b = wp.dot(direction, wp.cross(b, center)) * side
    if from_a <= 0.0 or from_b <= 0.0 or wp.dot(direction, wp.cross(a, b)) * side <= 0.0:
        return 0
    if side > 0.0:
        return 1
    return -1
