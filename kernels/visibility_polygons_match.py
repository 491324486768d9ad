"""Which points of the contours of a triangle's corners belong together (visibility_correspondence.txt, section 4).

Anchors are triples of points that are mutual nearest on all three edges, each edge judged at its middle, so that both
triangles at an edge agree; those nearest together come first, and one that would cross others is left out. Between
anchors a path goes through the three contours, each step of which advances one, two or all three of them; the path
with the smallest sum of distances is found exactly (dynamic programming), in parts where it is long.
"""

import warp as wp

from warp_gi.kernels.visibility_polygons import MATCHED, MOST_LISTS, TRACED, PolygonSets, synthesized

wp.set_module_options({"enable_backward": False})

MOST_POINTS = wp.constant(256)  # of a contour; triangles with longer ones are traced
MOST_CELLS = wp.constant(2048)  # of a part of the path
MOST_STEPS = wp.constant(1024)  # of a triangle's lists together
VIEWS = wp.constant(9)  # contours as seen from elsewhere: see `seen_row`


# Some records at a time, room for what is found, and scratch.
@wp.struct
class MatchBatch:
    start: wp.int32  # first record of `records`
    records: wp.array(dtype=wp.vec3i)  # [record] sets of corners
    seen: wp.array(dtype=wp.vec3)  # [item * VIEWS * MOST_POINTS] directions
    mates: wp.array(dtype=wp.int32)  # [item * 3 * MOST_POINTS] mutual nearest of A in B, A in C, B in C, or -1
    anchors: wp.array(dtype=wp.vec3i)  # [item * MOST_POINTS]
    costs: wp.array(dtype=wp.float32)  # [item * MOST_CELLS]
    moves: wp.array(dtype=wp.uint8)  # [item * MOST_CELLS]
    counts: wp.array(dtype=wp.vec3i)  # [item] lists, steps, TRACED or MATCHED
    contours: wp.array(dtype=wp.vec3i)  # [item * MOST_LISTS]
    starts: wp.array(dtype=wp.vec3i)  # [item * MOST_LISTS]
    ends: wp.array(dtype=wp.int32)  # [item * MOST_LISTS] among steps
    steps: wp.array(dtype=wp.uint8)  # [item * MOST_STEPS]


# Points of three contours.
@wp.struct
class Triple:
    first: wp.vec3i
    count: wp.vec3i


@wp.struct
class Outline:
    center: wp.vec3
    length: wp.float32


@wp.func
def outline(sets: PolygonSets, contour: wp.int32, away: wp.vec3) -> Outline:
    r = Outline()
    begin = sets.point_starts[contour]
    end = sets.point_starts[contour + 1]
    before = synthesized(sets.points[end - 1], away)
    for k in range(begin, end):
        d = synthesized(sets.points[k], away)
        r.center = r.center + d / wp.float32(end - begin)
        r.length = r.length + wp.length(d - before)
        before = d
    return r


# Contour of a set that is most like an outline, among those whose bits are not in `used`.
@wp.func
def likest(sets: PolygonSets, s: wp.int32, away: wp.vec3, like: Outline, used: wp.int32) -> wp.int32:
    found = int(-1)
    least = float(wp.inf)
    begin = sets.contour_starts[s]
    for k in range(begin, sets.contour_starts[s + 1]):
        if ((used >> (k - begin)) & 1) == 0:
            other = outline(sets, k, away)
            cost = wp.length(other.center - like.center) + 0.3 * wp.abs(other.length - like.length)
            if cost < least:
                least = cost
                found = k
    return found


# Row of `seen` with contour `corner` as the middle of edge `view` sees it (AB 0, BC 1, CA 2), or the triangle's (3).
@wp.func
def seen_row(item: wp.int32, corner: wp.int32, view: wp.int32) -> wp.int32:
    row = 6 + corner
    if view < 3:
        row = 2 * view
        if corner != view:
            row += 1
    return (item * VIEWS + row) * MOST_POINTS


@wp.func
def see_contours(sets: PolygonSets, batch: MatchBatch, item: wp.int32, corners: wp.vec3i, triple: Triple):
    a = sets.positions[corners[0]]
    b = sets.positions[corners[1]]
    c = sets.positions[corners[2]]
    for corner in range(3):
        position = sets.positions[corners[corner]]
        for view in range(4):
            point = (a + b + c) / 3.0
            if view == 0:
                point = (a + b) * 0.5
            elif view == 1:
                point = (b + c) * 0.5
            elif view == 2:
                point = (c + a) * 0.5
            if view == 3 or corner == view or corner == (view + 1) % 3:
                row = seen_row(item, corner, view)
                for k in range(triple.count[corner]):
                    batch.seen[row + k] = synthesized(sets.points[triple.first[corner] + k], position - point)


@wp.func
def nearest(batch: MatchBatch, row: wp.int32, count: wp.int32, direction: wp.vec3) -> wp.int32:
    found = int(0)
    least = float(wp.inf)
    for k in range(count):
        d = wp.length_sq(batch.seen[row + k] - direction)
        if d < least:
            least = d
            found = k
    return found


# For each point of contour `from_corner` its mutual nearest in the other at the middle of edge `view`, or -1.
@wp.func
def find_mates(
    batch: MatchBatch,
    item: wp.int32,
    triple: Triple,
    from_corner: wp.int32,
    to_corner: wp.int32,
    view: wp.int32,
    row: wp.int32,
):
    mine = seen_row(item, from_corner, view)
    other = seen_row(item, to_corner, view)
    for k in range(triple.count[from_corner]):
        j = nearest(batch, other, triple.count[to_corner], batch.seen[mine + k])
        back = nearest(batch, mine, triple.count[from_corner], batch.seen[other + j])
        if back != k:
            j = -1
        batch.mates[(item * 3 + row) * MOST_POINTS + k] = j


# Sum of the distances between three points, at the triangle's centre. Indices may be past the end of a contour, once.
@wp.func
def spread(batch: MatchBatch, item: wp.int32, triple: Triple, at: wp.vec3i) -> wp.float32:
    a = batch.seen[seen_row(item, 0, 3) + at[0] % triple.count[0]]
    b = batch.seen[seen_row(item, 1, 3) + at[1] % triple.count[1]]
    c = batch.seen[seen_row(item, 2, 3) + at[2] % triple.count[2]]
    return wp.length(a - b) + wp.length(b - c) + wp.length(c - a)


# Place among `count` anchors, in cyclic order, after which a triple fits in without crossing any, or -1.
@wp.func
def anchor_place(batch: MatchBatch, item: wp.int32, triple: Triple, candidate: wp.vec3i, count: wp.int32) -> wp.int32:
    place = int(-1)
    for j in range(count):
        low = batch.anchors[item * MOST_POINTS + j]
        high = batch.anchors[item * MOST_POINTS + (j + 1) % count]
        fits = int(1)
        for q in range(3):
            n = triple.count[q]
            ahead = (candidate[q] - low[q] + n) % n
            whole = (high[q] - low[q] + n) % n
            if whole == 0:
                whole = n
            if ahead == 0 or ahead >= whole:
                fits = 0
        if fits == 1:
            place = j
    return place


# Writes the anchors in cyclic order and returns how many; without any, one: the closest triple with point 0 of A.
@wp.func
def find_anchors(batch: MatchBatch, item: wp.int32, triple: Triple) -> wp.int32:
    find_mates(batch, item, triple, 0, 1, 0, 0)
    find_mates(batch, item, triple, 0, 2, 2, 1)
    find_mates(batch, item, triple, 1, 2, 1, 2)
    base = item * 3 * MOST_POINTS
    count = int(0)
    searching = int(1)
    while searching == 1:
        least = float(wp.inf)
        best = int(-1)
        for k in range(triple.count[0]):
            b = batch.mates[base + k]
            c = batch.mates[base + MOST_POINTS + k]
            if b >= 0 and c >= 0:
                if batch.mates[base + 2 * MOST_POINTS + b] == c:
                    d = spread(batch, item, triple, wp.vec3i(k, b, c))
                    if d < least:
                        least = d
                        best = k
        if best < 0:
            searching = 0
        else:
            candidate = wp.vec3i(best, batch.mates[base + best], batch.mates[base + MOST_POINTS + best])
            batch.mates[base + best] = -1  # it has had its turn
            place = int(-1)
            if count > 0:
                place = anchor_place(batch, item, triple, candidate, count)
            if count == 0 or place >= 0:
                for j in range(count - 1 - place):
                    to = item * MOST_POINTS + count - j
                    batch.anchors[to] = batch.anchors[to - 1]
                batch.anchors[item * MOST_POINTS + place + 1] = candidate
                count += 1
    if count == 0:
        a = batch.seen[seen_row(item, 0, 3)]
        b = nearest(batch, seen_row(item, 1, 3), triple.count[1], a)
        c = nearest(batch, seen_row(item, 2, 3), triple.count[2], a)
        batch.anchors[item * MOST_POINTS] = wp.vec3i(0, b, c)
        count = 1
    return count


# A triple between two, at the middle of the longest way: the nearest points of the other contours go with it.
@wp.func
def triple_between(batch: MatchBatch, item: wp.int32, triple: Triple, low: wp.vec3i, high: wp.vec3i) -> wp.vec3i:
    column = int(0)
    if high[1] - low[1] > high[0] - low[0]:
        column = 1
    if high[2] - low[2] > high[column] - low[column]:
        column = 2
    r = wp.vec3i(0, 0, 0)
    r[column] = (low[column] + high[column]) / 2
    middle = batch.seen[seen_row(item, column, 3) + r[column] % triple.count[column]]
    for q in range(3):
        if q != column:
            least = float(wp.inf)
            for k in range(low[q], high[q] + 1):
                d = wp.length_sq(batch.seen[seen_row(item, q, 3) + k % triple.count[q]] - middle)
                if d < least:
                    least = d
                    r[q] = k
    return r


@wp.func
def cell_of(at: wp.vec3i, size: wp.vec3i) -> wp.int32:
    return (at[0] * size[1] + at[1]) * size[2] + at[2]


@wp.func
def move_of(bits: wp.int32) -> wp.vec3i:
    return wp.vec3i(bits & 1, (bits >> 1) & 1, (bits >> 2) & 1)


# Appends the cheapest steps from one triple to another; returns the number of steps with them.
@wp.func
def path_between(
    batch: MatchBatch, item: wp.int32, triple: Triple, low: wp.vec3i, high: wp.vec3i, steps: wp.int32
) -> wp.int32:
    size = high - low + wp.vec3i(1, 1, 1)
    base = item * MOST_CELLS
    for cell in range(size[0] * size[1] * size[2]):
        i = cell / (size[1] * size[2])
        rest = cell - i * size[1] * size[2]
        at = wp.vec3i(i, rest / size[2], rest % size[2])
        least = float(0.0)
        best = int(0)
        if cell > 0:
            least = float(wp.inf)
            for k in range(7):
                bits = 7 - k  # of equal ways the one that advances most
                before = at - move_of(bits)
                if before[0] >= 0 and before[1] >= 0 and before[2] >= 0:
                    cost = batch.costs[base + cell_of(before, size)]
                    if cost < least:
                        least = cost
                        best = bits
        batch.costs[base + cell] = least + spread(batch, item, triple, low + at)
        batch.moves[base + cell] = wp.uint8(best)
    at_end = high - low
    count = int(0)
    while at_end[0] + at_end[1] + at_end[2] > 0:
        at_end = at_end - move_of(wp.int32(batch.moves[base + cell_of(at_end, size)]))
        count += 1
    if steps + count > MOST_STEPS:
        return MOST_STEPS + 1
    at_end = high - low
    for k in range(count):
        bits = wp.int32(batch.moves[base + cell_of(at_end, size)])
        batch.steps[item * MOST_STEPS + steps + count - 1 - k] = wp.uint8(bits)
        at_end = at_end - move_of(bits)
    return steps + count


# The steps of one triple of contours, from its first anchor once around; returns the number of steps with them.
@wp.func
def list_steps(batch: MatchBatch, item: wp.int32, triple: Triple, anchors: wp.int32, start: wp.int32) -> wp.int32:
    steps = int(start)
    zero = batch.anchors[item * MOST_POINTS]
    low = zero
    for j in range(anchors):
        goal = zero + triple.count
        if j + 1 < anchors:
            next = batch.anchors[item * MOST_POINTS + j + 1]
            for q in range(3):
                goal[q] = zero[q] + (next[q] - zero[q] + triple.count[q]) % triple.count[q]
        while wp.length_sq(goal - low) > 0 and steps <= MOST_STEPS:
            high = goal
            gap = high - low + wp.vec3i(1, 1, 1)
            while gap[0] * gap[1] * gap[2] > MOST_CELLS:
                high = triple_between(batch, item, triple, low, high)
                gap = high - low + wp.vec3i(1, 1, 1)
            steps = path_between(batch, item, triple, low, high, steps)
            low = high
    return steps


# Thread: a record of the batch. Writes its lists, if all three corners have equally many contours.
@wp.kernel
def match_contours(first: wp.int32, sets: PolygonSets, batch: MatchBatch):
    item = first + wp.tid()
    corners = batch.records[batch.start + item]
    batch.counts[item] = wp.vec3i(0, 0, TRACED)
    if corners[0] < 0:
        return
    begin = sets.contour_starts[corners[0]]
    count = sets.contour_starts[corners[0] + 1] - begin
    for k in range(2):
        other = corners[k + 1]
        if sets.contour_starts[other + 1] - sets.contour_starts[other] != count:
            return
    if count == 0 or count > MOST_LISTS:
        return
    p = sets.positions
    point = (p[corners[0]] + p[corners[1]] + p[corners[2]]) / 3.0
    used_b = int(0)
    used_c = int(0)
    steps = int(0)
    for j in range(count):
        like = outline(sets, begin + j, p[corners[0]] - point)
        b = likest(sets, corners[1], p[corners[1]] - point, like, used_b)
        c = likest(sets, corners[2], p[corners[2]] - point, like, used_c)
        used_b = used_b | (1 << (b - sets.contour_starts[corners[1]]))
        used_c = used_c | (1 << (c - sets.contour_starts[corners[2]]))
        contours = wp.vec3i(begin + j, b, c)
        triple = Triple()
        for q in range(3):
            triple.first[q] = sets.point_starts[contours[q]]
            triple.count[q] = sets.point_starts[contours[q] + 1] - triple.first[q]
        if triple.count[0] > MOST_POINTS or triple.count[1] > MOST_POINTS or triple.count[2] > MOST_POINTS:
            return
        see_contours(sets, batch, item, corners, triple)
        anchors = find_anchors(batch, item, triple)
        steps = list_steps(batch, item, triple, anchors, steps)
        if steps > MOST_STEPS:
            return
        batch.contours[item * MOST_LISTS + j] = contours
        batch.starts[item * MOST_LISTS + j] = batch.anchors[item * MOST_POINTS]
        batch.ends[item * MOST_LISTS + j] = steps
    batch.counts[item] = wp.vec3i(count, steps, MATCHED)


# Thread: a record of the batch. Copies its steps to where they stay: from item `starts[record of the batch]` on.
@wp.kernel
def gather_steps(first: wp.int32, batch: MatchBatch, starts: wp.array(dtype=wp.int32), out: wp.array(dtype=wp.uint8)):
    item = first + wp.tid()
    for k in range(batch.counts[item][1]):
        out[starts[item] + k] = batch.steps[item * MOST_STEPS + k]
