"""The bake of visibility polygons: contours of what vertices see, from maps of rays.

The hemisphere about the normal is a square (hemi-octahedral), whose border is the horizon. Nodes of a grid have a ray
each; a ring of further nodes on the border counts as occluded, so that all contours are closed. Marching squares find
the edges of the grid that contours cross, and more rays where on the edge: by halving it.
"""

import warp as wp

from warp_gi.kernels.bvh import bvh_intersect, runs_on_cuda
from warp_gi.kernels.bvh_packets_native import FAN_DISTANCES
from warp_gi.kernels.sampling import frame_of
from warp_gi.kernels.types import Bvh, SceneData

wp.set_module_options({"enable_backward": False})

BAND = 4  # rows of a map that go together on the CPU, see FAN_DISTANCES
HALVINGS = wp.constant(9)
SMALLEST_CONTOUR = wp.constant(wp.float32(2.0e-4))  # sr: smaller contours are left out
HORIZON = wp.constant(wp.float32(-1.0))  # "distance" of nodes on the border

# Why a set has no contours.
SET_SEES = wp.constant(0)
SET_BLIND = wp.constant(1)
SET_COMPLEX = wp.constant(2)  # more points or contours than there is room for


# Some sets at a time, and room for what is found.
@wp.struct
class ContourBatch:
    start: wp.int32  # first set
    resolution: wp.int32  # nodes along a side of the map
    most_points: wp.int32  # of a set, before they are simplified
    most_contours: wp.int32
    offset: wp.float32  # metres by which rays start above the vertex
    tolerance: wp.float32  # radians, of simplified contours
    positions: wp.array(dtype=wp.vec3)  # [set]
    normals: wp.array(dtype=wp.vec3)  # [set]
    lengths: wp.array(dtype=wp.vec2)  # [set] mean and longest edge of triangles around, metres
    distances: wp.array(dtype=wp.float32)  # [set of the batch * resolution^2] metres, inf where the sky is seen
    visited: wp.array(dtype=wp.uint8)  # [set of the batch * (resolution + 1)^2] bits of edges
    points: wp.array(dtype=wp.vec4)  # [set of the batch * most_points]
    kept: wp.array(dtype=wp.uint8)  # [set of the batch * most_points]
    ends: wp.array(dtype=wp.int32)  # [set of the batch * most_contours] of contours among points
    counts: wp.array(dtype=wp.vec3i)  # [set of the batch] points, contours, SET_*


# Distance to what a ray meets, inf if it is the sky.
@wp.func(inline=False)
def ray_distance(scene: SceneData, origin: wp.vec3, direction: wp.vec3) -> wp.float32:
    hit = bvh_intersect(scene.bvh, origin, direction, float(wp.inf))
    if hit.face < 0:
        return float(wp.inf)
    return hit.t


# Direction about z of a point of the square; counter-clockwise in the square is so on the sphere, seen from outside.
@wp.func
def hemisphere_decode(p: wp.vec2) -> wp.vec3:
    x = 0.5 * (p[0] - p[1])
    y = 0.5 * (p[0] + p[1])
    return wp.normalize(wp.vec3(x, y, wp.max(1.0 - wp.abs(x) - wp.abs(y), 0.0)))


# Place in the square of a node; those with an index of -1 or `resolution` lie on the border.
@wp.func
def node_place(x: wp.int32, y: wp.int32, resolution: wp.int32) -> wp.vec2:
    scale = 2.0 / wp.float32(resolution)
    return wp.vec2(
        wp.clamp((wp.float32(x) + 0.5) * scale - 1.0, -1.0, 1.0),
        wp.clamp((wp.float32(y) + 0.5) * scale - 1.0, -1.0, 1.0),
    )


# Thread: a node. Its direction about z.
@wp.kernel
def map_directions(first: wp.int32, resolution: wp.int32, directions: wp.array(dtype=wp.vec3)):
    node = first + wp.tid()
    y = node / resolution
    directions[node] = hemisphere_decode(node_place(node - y * resolution, y, resolution))


# CPU: the distances of 4 x 4 nodes from x, y on, of the map that starts at `start`.
@wp.func_native(FAN_DISTANCES)
def fan_distances(
    bvh: Bvh,
    origin: wp.vec3,
    frame: wp.mat33,
    local: wp.array(dtype=wp.vec3),
    x: wp.int32,
    y: wp.int32,
    side: wp.int32,
    start: wp.int32,
    distances: wp.array(dtype=wp.float32),
): ...


# Thread: `share` rows of the map of a set of the batch, BAND on the CPU and one on CUDA. Writes the distances at its
# nodes.
@wp.kernel
def trace_maps(
    first: wp.int32, scene: SceneData, batch: ContourBatch, share: wp.int32, directions: wp.array(dtype=wp.vec3)
):
    item = first + wp.tid()
    side = batch.resolution
    bands = (side + share - 1) / share
    local = item / bands
    y = (item - local * bands) * share
    normal = batch.normals[batch.start + local]
    frame = frame_of(normal)
    origin = batch.positions[batch.start + local] + normal * batch.offset
    start = local * side * side
    if runs_on_cuda() != 0:
        for x in range(side):
            node = y * side + x
            batch.distances[start + node] = ray_distance(scene, origin, frame * directions[node])
    else:
        for x in range(0, side, 4):
            fan_distances(scene.bvh, origin, frame, directions, x, y, side, start, batch.distances)


@wp.func
def node_distance(batch: ContourBatch, local: wp.int32, x: wp.int32, y: wp.int32) -> wp.float32:
    if x < 0 or y < 0 or x >= batch.resolution or y >= batch.resolution:
        return HORIZON
    return batch.distances[(local * batch.resolution + y) * batch.resolution + x]


# Node at corner `k` of a cell, counter-clockwise from its lower left one.
@wp.func
def cell_corner(x: wp.int32, y: wp.int32, k: wp.int32) -> wp.vec2i:
    corner = wp.vec2i(x - 1, y - 1)
    if k == 1 or k == 2:
        corner[0] = x
    if k >= 2:
        corner[1] = y
    return corner


# Bit k: corner k of a cell sees the sky.
@wp.func
def cell_bits(batch: ContourBatch, local: wp.int32, x: wp.int32, y: wp.int32) -> wp.int32:
    bits = int(0)
    for k in range(4):
        corner = cell_corner(x, y, k)
        if node_distance(batch, local, corner[0], corner[1]) == float(wp.inf):
            bits = bits | (1 << k)
    return bits


@wp.func
def has_corner(bits: wp.int32, k: wp.int32) -> wp.bool:
    return ((bits >> (k & 3)) & 1) != 0


# Point where a contour crosses edge `k` of a cell, from its corner k that sees the sky to the next that does not.
@wp.func
def crossing(scene: SceneData, batch: ContourBatch, local: wp.int32, x: wp.int32, y: wp.int32, k: wp.int32) -> wp.vec4:
    near = cell_corner(x, y, k)
    far = cell_corner(x, y, (k + 1) & 3)
    seen = node_place(near[0], near[1], batch.resolution)
    blocked = node_place(far[0], far[1], batch.resolution)
    t = node_distance(batch, local, far[0], far[1])
    normal = batch.normals[batch.start + local]
    frame = frame_of(normal)
    origin = batch.positions[batch.start + local] + normal * batch.offset
    for _i in range(int(HALVINGS)):
        middle = (seen + blocked) * 0.5
        found = ray_distance(scene, origin, frame * hemisphere_decode(middle))
        if found == float(wp.inf):
            seen = middle
        else:
            blocked = middle
            t = found
    place = (seen + blocked) * 0.5
    w = float(0.0)
    if t == HORIZON:
        place = node_place(far[0], far[1], batch.resolution)
    else:
        w = 1.0 / wp.max(t, wp.max(batch.lengths[batch.start + local][1], 1.0e-12))
    d = frame * hemisphere_decode(place)
    return wp.vec4(d[0], d[1], d[2], w)


# Edge by which the contour leaves a cell that it enters by edge `k`. Where opposite corners see the sky a ray decides.
@wp.func
def exit_edge(
    scene: SceneData, batch: ContourBatch, local: wp.int32, x: wp.int32, y: wp.int32, k: wp.int32, bits: wp.int32
) -> wp.int32:
    if bits == 5 or bits == 10:
        low = node_place(x - 1, y - 1, batch.resolution)
        high = node_place(x, y, batch.resolution)
        normal = batch.normals[batch.start + local]
        origin = batch.positions[batch.start + local] + normal * batch.offset
        direction = frame_of(normal) * hemisphere_decode((low + high) * 0.5)
        if ray_distance(scene, origin, direction) == float(wp.inf):
            return (k + 1) & 3
        return (k + 3) & 3
    found = int(0)
    for j in range(4):
        if not has_corner(bits, j) and has_corner(bits, j + 1):
            found = j
    return found


# Follows the contour that enters a cell by an edge; returns the number of points with its own.
@wp.func
def followed(
    scene: SceneData, batch: ContourBatch, local: wp.int32, x0: wp.int32, y0: wp.int32, k0: wp.int32, start: wp.int32
) -> wp.int32:
    x = int(x0)
    y = int(y0)
    k = int(k0)
    count = int(start)
    side = batch.resolution + 1
    done = int(0)
    while done == 0:
        cell = (local * side + y) * side + x
        batch.visited[cell] = wp.uint8(wp.int32(batch.visited[cell]) | (1 << k))
        batch.points[local * batch.most_points + count] = crossing(scene, batch, local, x, y, k)
        count += 1
        leave = exit_edge(scene, batch, local, x, y, k, cell_bits(batch, local, x, y))
        if leave == 0:
            y -= 1
        elif leave == 1:
            x += 1
        elif leave == 2:
            y += 1
        else:
            x -= 1
        k = (leave + 2) & 3
        if (x == x0 and y == y0 and k == k0) or count == batch.most_points:
            done = 1
    return count


# Thread: a set of the batch. Finds its contours.
@wp.kernel
def find_contours(first: wp.int32, scene: SceneData, batch: ContourBatch):
    local = first + wp.tid()
    side = batch.resolution + 1
    for cell in range(side * side):
        batch.visited[local * side * side + cell] = wp.uint8(0)
    points = int(0)
    contours = int(0)
    state = int(SET_BLIND)
    for cell in range(side * side):
        y = cell / side
        x = cell - y * side
        bits = cell_bits(batch, local, x, y)
        if bits != 0 and bits != 15 and state != SET_COMPLEX:
            for k in range(4):
                is_new = ((wp.int32(batch.visited[local * side * side + cell]) >> k) & 1) == 0
                if has_corner(bits, k) and not has_corner(bits, k + 1) and is_new and state != SET_COMPLEX:
                    if contours == batch.most_contours:
                        state = SET_COMPLEX
                    else:
                        points = followed(scene, batch, local, x, y, k, points)
                        batch.ends[local * batch.most_contours + contours] = points
                        contours += 1
                        state = SET_SEES
                        if points == batch.most_points:
                            state = SET_COMPLEX
    batch.counts[local] = wp.vec3i(points, contours, state)


# Squared distance of a point from the segment between two others, with w in mean edges.
@wp.func
def chord_distance(q: wp.vec4, a: wp.vec4, b: wp.vec4, length: wp.float32) -> wp.float32:
    scale = wp.vec4(1.0, 1.0, 1.0, length)
    to_q = wp.cw_mul(q - a, scale)
    to_b = wp.cw_mul(b - a, scale)
    size = wp.dot(to_b, to_b)
    along = float(0.0)
    if size > 0.0:
        along = wp.clamp(wp.dot(to_q, to_b) / size, 0.0, 1.0)
    rest = to_q - to_b * along
    return wp.dot(rest, rest)


# Index from i + 1 to j - 1 that is farthest from the chord, or -1 if none is farther than the tolerance.
@wp.func
def farthest(
    batch: ContourBatch, base: wp.int32, i: wp.int32, j: wp.int32, chord_end: wp.int32, length: wp.float32
) -> wp.int32:
    found = int(-1)
    most = batch.tolerance * batch.tolerance
    for k in range(i + 1, j):
        d = chord_distance(batch.points[base + k], batch.points[base + i], batch.points[base + chord_end], length)
        if d > most:
            most = d
            found = k
    return found


# Marks the points of a contour that stay (Douglas and Peucker), from `begin` to the one before `end`.
@wp.func
def mark_kept(batch: ContourBatch, base: wp.int32, begin: wp.int32, end: wp.int32, length: wp.float32):
    for k in range(begin, end):
        batch.kept[base + k] = wp.uint8(0)
    batch.kept[base + begin] = wp.uint8(1)
    opposite = farthest(batch, base, begin, end, begin, length)
    if opposite >= 0:
        batch.kept[base + opposite] = wp.uint8(1)
    i = int(begin)
    while i < end:
        j = i + 1
        while j < end and batch.kept[base + wp.min(j, end - 1)] == wp.uint8(0):
            j += 1
        k = int(i)
        while k >= 0:
            chord_end = j
            if j == end:
                chord_end = begin
            k = farthest(batch, base, i, j, chord_end, length)
            if k >= 0:
                batch.kept[base + k] = wp.uint8(1)
                j = k
        i = j


# Signed solid angle of the triangle from z to two unit directions (van Oosterom and Strackee 1983).
@wp.func
def fan_angle(normal: wp.vec3, a: wp.vec3, b: wp.vec3) -> wp.float32:
    below = 1.0 + wp.dot(normal, a) + wp.dot(normal, b) + wp.dot(a, b)
    return 2.0 * wp.atan2(wp.dot(normal, wp.cross(a, b)), below)


# Thread: a set of the batch. Drops points and contours that are not needed; `points` and `ends` have the rest.
@wp.kernel
def simplify_contours(first: wp.int32, batch: ContourBatch):
    local = first + wp.tid()
    found = batch.counts[local]
    base = local * batch.most_points
    normal = batch.normals[batch.start + local]
    begin = int(0)
    points = int(0)
    contours = int(0)
    state = found[2]
    if state == SET_SEES:
        for contour in range(found[1]):
            end = batch.ends[local * batch.most_contours + contour]
            mark_kept(batch, base, begin, end, batch.lengths[batch.start + local][0])
            size = int(0)
            for k in range(begin, end):
                if batch.kept[base + k] != wp.uint8(0):
                    batch.points[base + points + size] = batch.points[base + k]
                    size += 1
            angle = float(0.0)
            for k in range(size):
                a = batch.points[base + points + k]
                b = batch.points[base + points + (k + 1) % size]
                angle += fan_angle(normal, wp.vec3(a[0], a[1], a[2]), wp.vec3(b[0], b[1], b[2]))
            if size >= 3 and wp.abs(angle) > SMALLEST_CONTOUR:
                points += size
                batch.ends[local * batch.most_contours + contours] = points
                contours += 1
            begin = end
        if contours == 0:
            state = SET_BLIND
    batch.counts[local] = wp.vec3i(points, contours, state)


# Thread: a set of the batch. Copies its points to where they stay: from item `starts[set of the batch]` on.
@wp.kernel
def gather_points(first: wp.int32, batch: ContourBatch, starts: wp.array(dtype=wp.int32), out: wp.array(dtype=wp.vec4)):
    local = first + wp.tid()
    for k in range(batch.counts[local][0]):
        out[starts[local] + k] = batch.points[local * batch.most_points + k]
