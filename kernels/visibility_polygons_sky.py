"""Light of the sky through polygons, from tables: integrals along their edges (Green).

In the sky's space a direction is l = (sin t sin p, cos t, -sin t cos p), t from the zenith. With what is visible to the
left of edges, seen from outside, the integral of l L over a polygon is

    I = - sum over edges of the integral of H(p, t(p)) dp,    H(p, t) = integral from 0 to t of l L sin t' dt',

plus that over the whole sphere if the nadir is inside (visibility_correspondence.txt, Eq. 10). Texels are patches
between four nodes of the map, at their mean. H is exact in columns of texels. A summed-area table, the integral of H
from 0 to p, gives an edge's part between two bounds, at its lower and at its upper polar angle; an edge is halved until
these agree, and their mean is taken.
"""

import warp as wp

from warp_gi.kernels.bsdf import luminance
from warp_gi.kernels.visibility_polygons import (
    PolygonLists,
    PolygonSets,
    covers,
    record_normal,
    walk_begun,
    walk_direction,
    walk_stepped,
)

wp.set_module_options({"enable_backward": False})

SKY_NONE = wp.constant(0)
SKY_CONSTANT = wp.constant(1)
SKY_MAP = wp.constant(2)

PI = wp.constant(wp.float32(3.141592653589793))
TWO_PI = wp.constant(wp.float32(6.283185307179586))
LONGEST_ARC = wp.constant(
    wp.float32(0.17453292519943295)
)  # 10 degrees: longer arcs leave the box of their ends too far
PARTS = wp.constant(1024)  # of an edge at most


@wp.struct
class PolygonSky:
    kind: wp.int32  # SKY_*
    radiance: wp.vec3  # of a constant sky; of a map the scale of its tables
    sky_from_world: wp.mat33
    tolerance: wp.float32  # luminance of irradiance, of the tables, by which an edge's two bounds may differ, halved
    rows: wp.int32  # cells of the summed-area table, 0 if there is none
    columns: wp.int32
    # [((rows + 1) * (columns + 1)) * 3] integrals of l_x L, l_y L, l_z L over polar angles and azimuths below a node
    table: wp.array(dtype=wp.vec3)
    height: wp.int32  # texels
    width: wp.int32
    row_areas: wp.array(dtype=wp.vec2)  # [height + 1] (t - sin t cos t) / 2 and sin^2 t / 2 between rows of texels
    bands: wp.array(dtype=wp.vec3i)  # [band] first column, the one after the last, and where the first is in band_sums
    band_sums: wp.array(dtype=wp.vec3)  # [(column * (height + 1) + row) * 2] sums of L times areas above the row
    total_x: wp.vec3  # integrals of l L over the sphere
    total_y: wp.vec3
    total_z: wp.vec3


# What is known of a polygon after some edges, in the sky's space.
@wp.struct
class EdgeSum:
    normal: wp.vec3  # light is dotted with it
    center: wp.vec3  # about which the polygon lies
    light: wp.vec3
    turn: wp.float32  # radians about the zenith
    covered: wp.int32  # signed number of times that the nadir is covered


@wp.func
def azimuth(d: wp.vec3) -> wp.float32:
    p = wp.atan2(d[0], -d[2])
    if p < 0.0:
        p = p + TWO_PI
    return p


@wp.func
def polar(d: wp.vec3) -> wp.float32:
    return wp.atan2(wp.sqrt(d[0] * d[0] + d[2] * d[2]), d[1])


# A node of the table, dotted with n.
@wp.func
def table_node(sky: PolygonSky, row: wp.int32, column: wp.int32, n: wp.vec3) -> wp.vec3:
    at = (row * (sky.columns + 1) + column) * 3
    return sky.table[at] * n[0] + sky.table[at + 1] * n[1] + sky.table[at + 2] * n[2]


# n . integral of H over azimuths from 0 to p, at polar angle t; p in [0, 2 pi].
@wp.func
def table_at(sky: PolygonSky, p: wp.float32, t: wp.float32, n: wp.vec3) -> wp.vec3:
    x = wp.clamp(p / TWO_PI, 0.0, 1.0) * wp.float32(sky.columns)
    y = wp.clamp(t / PI, 0.0, 1.0) * wp.float32(sky.rows)
    i = wp.min(wp.int32(x), sky.columns - 1)
    j = wp.min(wp.int32(y), sky.rows - 1)
    fx = x - wp.float32(i)
    fy = y - wp.float32(j)
    upper = table_node(sky, j, i, n) * (1.0 - fx) + table_node(sky, j, i + 1, n) * fx
    lower = table_node(sky, j + 1, i, n) * (1.0 - fx) + table_node(sky, j + 1, i + 1, n) * fx
    return upper * (1.0 - fy) + lower * fy


# The same for p up to a turn below 0 or above 2 pi.
@wp.func
def table_around(sky: PolygonSky, p: wp.float32, t: wp.float32, n: wp.vec3) -> wp.vec3:
    if p < 0.0:
        return table_at(sky, p + TWO_PI, t, n) - table_at(sky, TWO_PI, t, n)
    if p > TWO_PI:
        return table_at(sky, p - TWO_PI, t, n) + table_at(sky, TWO_PI, t, n)
    return table_at(sky, p, t, n)


# n . H of a column of a band, times d p: azimuth p, polar angle t.
@wp.func
def column_part(sky: PolygonSky, column: wp.int32, p: wp.float32, t: wp.float32, n: wp.vec3) -> wp.vec3:
    row = wp.clamp(wp.int32(t / PI * wp.float32(sky.height)), 0, sky.height - 1)
    sine = wp.sin(t)
    above = sky.row_areas[row]
    below = sky.row_areas[row + 1]
    s = wp.clamp((0.5 * (t - sine * wp.cos(t)) - above[0]) / (below[0] - above[0]), 0.0, 1.0)
    at = (column * (sky.height + 1) + row) * 2
    within = (sky.band_sums[at + 2] - sky.band_sums[at]) / (below[0] - above[0])  # radiance of the texel
    a = sky.band_sums[at] * (1.0 - s) + sky.band_sums[at + 2] * s
    b = sky.band_sums[at + 1] + within * (0.5 * sine * sine - above[1])
    return a * (n[0] * wp.sin(p) - n[2] * wp.cos(p)) + b * n[1]


# n . integral of H along an arc within a column: from azimuth p1 to p2 and polar angle t1 to t2, straight between.
@wp.func
def column_light(
    sky: PolygonSky, column: wp.int32, p1: wp.float32, t1: wp.float32, p2: wp.float32, t2: wp.float32, n: wp.vec3
) -> wp.vec3:
    scale = wp.float32(sky.height) / PI
    from_row = wp.clamp(wp.int32(wp.min(t1, t2) * scale), 0, sky.height - 1)
    to_row = wp.clamp(wp.int32(wp.max(t1, t2) * scale), 0, sky.height - 1)
    if from_row == to_row:
        return column_part(sky, column, 0.5 * (p1 + p2), 0.5 * (t1 + t2), n) * (p2 - p1)
    sum = wp.vec3(0.0, 0.0, 0.0)
    low = wp.min(t1, t2)
    for row in range(from_row, to_row + 1):
        high = wp.min(wp.float32(row + 1) / scale, wp.max(t1, t2))
        t = 0.5 * (low + high)
        p = p1 + (p2 - p1) * (t - t1) / (t2 - t1)
        sum = sum + column_part(sky, column, p, t, n) * ((p2 - p1) * (high - low) / wp.abs(t2 - t1))
        low = high
    return sum


# n . integral of H over the bands, along the arc from a to b, which begins at azimuth p and goes on by `turn`.
@wp.func
def band_light(sky: PolygonSky, a: wp.vec3, b: wp.vec3, p: wp.float32, turn: wp.float32, n: wp.vec3) -> wp.vec3:
    sum = wp.vec3(0.0, 0.0, 0.0)
    if wp.abs(turn) < 1.0e-9:
        return sum
    g = wp.normalize(wp.cross(a, b - a))
    if g[1] * turn > -1.0e-9:  # through a pole, or too short to tell: the turn says on which side the arc passes
        g[1] = -1.0e-9 * wp.sign(turn)
    scale = wp.float32(sky.width) / TWO_PI
    low = wp.min(p, p + turn) * scale
    high = wp.max(p, p + turn) * scale
    for band in range(sky.bands.shape[0]):
        columns = sky.bands[band]
        for lap in range(3):
            shift = (lap - 1) * sky.width
            from_column = wp.max(wp.int32(wp.floor(low)), columns[0] + shift)
            to_column = wp.min(wp.int32(wp.floor(high)), columns[1] + shift - 1)
            for column in range(from_column, to_column + 1):
                p1 = wp.max(low, wp.float32(column)) / scale
                p2 = wp.min(high, wp.float32(column + 1)) / scale
                t1 = wp.atan2(1.0, (g[2] * wp.cos(p1) - g[0] * wp.sin(p1)) / g[1])
                t2 = wp.atan2(1.0, (g[2] * wp.cos(p2) - g[0] * wp.sin(p2)) / g[1])
                stored = columns[2] + column - shift - columns[0]
                sum = sum + column_light(sky, stored, p1, t1, p2, t2, n)
    return sum * wp.sign(turn)


@wp.func
def wrapped(turn: wp.float32) -> wp.float32:
    if turn > PI:
        return turn - TWO_PI
    if turn < -PI:
        return turn + TWO_PI
    return turn


# Adds an edge of the polygon under a map; it is halved where the table's two bounds differ.
@wp.func
def map_edge(sky: PolygonSky, sum: EdgeSum, a: wp.vec3, b: wp.vec3) -> EdgeSum:
    r = sum
    n = sum.normal
    arc = wp.atan2(wp.length(wp.cross(a, b)), wp.dot(a, b))
    along = wp.normalize(b - a * wp.dot(a, b))
    at = int(0)
    size = int(PARTS)
    begin = a
    p1 = azimuth(a)
    t1 = polar(a)
    here = wp.vec3(0.0, 0.0, 0.0)
    if sky.rows > 0:
        here = table_at(sky, p1, t1, n)
    while at < PARTS:
        end = b
        if at + size < PARTS:
            angle = arc * wp.float32(at + size) / wp.float32(PARTS)
            end = a * wp.cos(angle) + along * wp.sin(angle)
        p2 = azimuth(end)
        t2 = polar(end)
        turn = wrapped(p2 - p1)
        upper = wp.vec3(0.0, 0.0, 0.0)
        lower = wp.vec3(0.0, 0.0, 0.0)
        there = wp.vec3(0.0, 0.0, 0.0)
        if sky.rows > 0:
            upper = table_around(sky, p1 + turn, t1, n) - here
            there = table_at(sky, p2, t2, n)
            shift = table_around(sky, p1 + turn, t2, n) - there  # whole turns
            lower = there + shift - table_at(sky, p1, t2, n)
        is_long = arc * wp.float32(size) > LONGEST_ARC * wp.float32(PARTS)
        if size > 1 and (is_long or 0.5 * wp.abs(luminance(upper - lower)) > sky.tolerance):
            size = size / 2
        else:
            r.light = r.light - (upper + lower) * 0.5 - band_light(sky, begin, end, p1, turn, n)
            r.turn = r.turn + turn
            at = at + size
            begin = end
            p1 = p2
            t1 = t2
            here = there
            size = at & (-at)  # the next part in the tree of halves
    return r


# Adds an edge from a to b, unit directions in the sky's space. The nadir is looked for in fans from the centre.
@wp.func
def with_edge(sky: PolygonSky, sum: EdgeSum, a: wp.vec3, b: wp.vec3) -> EdgeSum:
    r = sum
    if wp.length_sq(b - a) < 1.0e-14:
        return r
    if sky.kind == SKY_MAP:
        r = map_edge(sky, sum, a, b)
        r.covered = r.covered + covers(sum.center, a, b, wp.vec3(0.0, -1.0, 0.0))
    else:  # the integral of l over a polygon in closed form (Lambert)
        across = wp.cross(a, b - a)
        size = wp.length(across)
        if size > 0.0:
            angle = wp.atan2(size, wp.dot(a, b))
            share = 0.5 * angle * wp.dot(across, sum.normal) / size
            r.light = r.light + wp.vec3(share, share, share)
    return r


# n . integral of l L over the polygon, W/m^2. Which of zenith and nadir are inside: `turn` tells one from the other;
# whether none or both are is looked up. May be an error of edges below 0.
@wp.func
def polygon_light(sky: PolygonSky, sum: EdgeSum) -> wp.vec3:
    light = sum.light
    if sky.kind == SKY_MAP:
        inside = wp.int32(wp.round(sum.turn / TWO_PI))
        if inside == 0:
            inside = sum.covered
        if inside > 0:
            n = sum.normal
            light = light + sky.total_x * n[0] + sky.total_y * n[1] + sky.total_z * n[2]
    return wp.cw_mul(light, sky.radiance)


# Light that may be a rounding below 0, as an edge's error is.
@wp.func
def not_negative(light: wp.vec3) -> wp.vec3:
    return wp.vec3(wp.max(light[0], 0.0), wp.max(light[1], 0.0), wp.max(light[2], 0.0))


# Irradiance [W/m^2] of a point of a record by the sky that its polygon shows, on a plane with a unit normal.
@wp.func
def record_light(
    sets: PolygonSets, lists: PolygonLists, sky: PolygonSky, record: wp.int32, weights: wp.vec3, normal: wp.vec3
) -> wp.vec3:
    sum = EdgeSum()
    if sky.kind == SKY_NONE:
        return sum.light
    corners = lists.corner_sets[record]
    sum.normal = sky.sky_from_world * normal
    sum.center = sky.sky_from_world * record_normal(sets, corners, weights)
    for list in range(lists.list_starts[record], lists.list_starts[record + 1]):
        walk = walk_begun(sets, lists, list, corners, weights)
        before = sky.sky_from_world * walk_direction(walk)
        for k in range(lists.step_starts[list], lists.step_starts[list + 1]):
            walk = walk_stepped(sets, walk, wp.int32(lists.steps[k]))
            next = sky.sky_from_world * walk_direction(walk)
            sum = with_edge(sky, sum, before, next)
            before = next
    return polygon_light(sky, sum)


# Polygons as they are, in the sky's space.
@wp.struct
class PlainPolygons:
    starts: wp.array(dtype=wp.int32)  # [polygon + 1] contours
    contour_starts: wp.array(dtype=wp.int32)  # [contour + 1]
    points: wp.array(dtype=wp.vec3)  # [point] unit
    normals: wp.array(dtype=wp.vec3)  # [polygon] unit; about them they lie, and irradiance is with them
    light: wp.array(dtype=wp.vec3)  # [polygon] irradiance, W/m^2


# Thread: a polygon. Writes its irradiance.
@wp.kernel
def integrate_polygons(first: wp.int32, sky: PolygonSky, polygons: PlainPolygons):
    polygon = first + wp.tid()
    sum = EdgeSum()
    sum.normal = polygons.normals[polygon]
    sum.center = sum.normal
    for contour in range(polygons.starts[polygon], polygons.starts[polygon + 1]):
        begin = polygons.contour_starts[contour]
        end = polygons.contour_starts[contour + 1]
        before = polygons.points[end - 1]
        for k in range(begin, end):
            next = polygons.points[k]
            sum = with_edge(sky, sum, before, next)
            before = next
    polygons.light[polygon] = not_negative(polygon_light(sky, sum))
