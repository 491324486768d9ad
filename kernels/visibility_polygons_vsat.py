"""The paper's way to the light through polygons, of two boxes an edge, kept to compare with.

An edge's part lies between two integrals of a summed-area table, up to its lower and its upper polar angle. The paper
blends them by a sigmoid of the place of the box's light: north of the edge, or south of it
(visibility_correspondence.txt, Eq. 10 to 12). Edges are not halved.
"""

import warp as wp

from warp_gi.kernels.bsdf import luminance
from warp_gi.kernels.visibility_polygons import covers
from warp_gi.kernels.visibility_polygons_sky import (
    PI,
    TWO_PI,
    EdgeSum,
    PlainPolygons,
    PolygonSky,
    azimuth,
    not_negative,
    polar,
    polygon_light,
    wrapped,
)

wp.set_module_options({"enable_backward": False})


# A node of the table: a row for each of x, y and z.
@wp.func
def vsat_node(sky: PolygonSky, row: wp.int32, column: wp.int32) -> wp.mat33:
    at = (row * (sky.columns + 1) + column) * 3
    return wp.matrix_from_rows(sky.table[at], sky.table[at + 1], sky.table[at + 2])


# Integral of H over azimuths from 0 to p, at polar angle t; p up to a turn below 0 or above 2 pi.
@wp.func
def vsat_at(sky: PolygonSky, p: wp.float32, t: wp.float32) -> wp.mat33:
    turns = wp.floor(p / TWO_PI)
    x = (p / TWO_PI - turns) * wp.float32(sky.columns)
    y = wp.clamp(t / PI, 0.0, 1.0) * wp.float32(sky.rows)
    i = wp.min(wp.int32(x), sky.columns - 1)
    j = wp.min(wp.int32(y), sky.rows - 1)
    fx = x - wp.float32(i)
    fy = y - wp.float32(j)
    upper = vsat_node(sky, j, i) * (1.0 - fx) + vsat_node(sky, j, i + 1) * fx
    lower = vsat_node(sky, j + 1, i) * (1.0 - fx) + vsat_node(sky, j + 1, i + 1) * fx
    result = upper * (1.0 - fy) + lower * fy
    if turns != 0.0:
        whole = vsat_node(sky, j, sky.columns) * (1.0 - fy) + vsat_node(sky, j + 1, sky.columns) * fy
        result = result + whole * turns
    return result


# Adds an edge from a to b. `slope` is that of the sigmoid, per radian.
@wp.func
def with_vsat_edge(sky: PolygonSky, slope: wp.float32, sum: EdgeSum, a: wp.vec3, b: wp.vec3) -> EdgeSum:
    r = sum
    if wp.length_sq(b - a) < 1.0e-14:
        return r
    p = azimuth(a)
    t1 = polar(a)
    t2 = polar(b)
    turn = wrapped(azimuth(b) - p)
    upper = vsat_at(sky, p + turn, t1) - vsat_at(sky, p, t1)
    lower = vsat_at(sky, p + turn, t2) - vsat_at(sky, p, t2)
    box = (lower - upper) * wp.sign(turn * (t2 - t1))
    middle = wp.vec3(luminance(box[0]), luminance(box[1]), luminance(box[2]))
    g = wp.normalize(wp.cross(a, b - a))
    north = wp.dot(middle, g) / wp.max(wp.length(middle), 1.0e-20)
    if g[1] < 0.0:
        north = -north
    beta = 0.5 + 0.5 * wp.tanh(slope * north)
    if t2 <= t1:
        beta = 1.0 - beta
    r.light = r.light - wp.transpose(upper * (1.0 - beta) + lower * beta) * sum.normal
    r.turn = r.turn + turn
    r.covered = r.covered + covers(sum.center, a, b, wp.vec3(0.0, -1.0, 0.0))
    return r


# Thread: a polygon. Writes its irradiance.
@wp.kernel
def integrate_vsat(first: wp.int32, sky: PolygonSky, slope: wp.float32, polygons: PlainPolygons):
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
            sum = with_vsat_edge(sky, slope, sum, before, next)
            before = next
    polygons.light[polygon] = not_negative(polygon_light(sky, sum))
