"""The pieces of surfaces that a visibility field's samples lie on: parts of triangles' sides in cells of a grid."""

import warp as wp

from warp_gi.kernels.surface import ray_offset
from warp_gi.kernels.types import Geometry

wp.set_module_options({"enable_backward": False})

# The part of a triangle in a box: a polygon of n <= 9 corners, relative to the box's middle (Sutherland and Hodgman).
_CLIP = """
    float polygon[2][10][3];
    float extent[3];
    int n = 3, now = 0;
    for (int k = 0; k < 3; ++k) {
        const float middle = 0.5f * (low[k] + high[k]);
        extent[k] = 0.5f * (high[k] - low[k]);
        polygon[0][0][k] = p0[k] - middle, polygon[0][1][k] = p1[k] - middle, polygon[0][2][k] = p2[k] - middle;
    }
    for (int plane = 0; plane < 6; ++plane) {
        const int axis = plane >> 1;
        const float side = (plane & 1) ? -1.0f : 1.0f;
        int kept = 0;
        for (int i = 0; i < n; ++i) {
            const float* a = polygon[now][i];
            const float* b = polygon[now][i + 1 < n ? i + 1 : 0];
            const float da = extent[axis] - side * a[axis], db = extent[axis] - side * b[axis];
            if (da >= 0.0f) {
                for (int k = 0; k < 3; ++k) polygon[1 - now][kept][k] = a[k];
                ++kept;
            }
            if ((da >= 0.0f) != (db >= 0.0f)) {
                const float t = da / (da - db);
                for (int k = 0; k < 3; ++k) polygon[1 - now][kept][k] = a[k] + t * (b[k] - a[k]);
                ++kept;
            }
        }
        n = kept;
        now = 1 - now;
    }
    auto corner = polygon[now];
    float areas[10], area = 0.0f, edges[10], middle[3] = {0.0f, 0.0f, 0.0f};
    for (int i = 0; i < n; ++i) {
        float e1[3], e2[3], length = 0.0f;
        for (int k = 0; k < 3; ++k) {
            const float e = corner[i + 1 < n ? i + 1 : 0][k] - corner[i][k];
            length += e * e;
            middle[k] += corner[i][k] / (float)n;
            e1[k] = corner[i][k] - corner[0][k], e2[k] = corner[i + 1 < n ? i + 1 : 0][k] - corner[0][k];
        }
        edges[i] = wp::sqrt(length);
        const float x = e1[1] * e2[2] - e1[2] * e2[1], y = e1[2] * e2[0] - e1[0] * e2[2];
        const float z = e1[0] * e2[1] - e1[1] * e2[0];
        areas[i] = 0.5f * wp::sqrt(x * x + y * y + z * z);
        area += areas[i];
    }
"""


# Area of the polygon, m^2.
@wp.func_native(_CLIP + "return area;")
def piece_area(p0: wp.vec3, p1: wp.vec3, p2: wp.vec3, low: wp.vec3, high: wp.vec3) -> wp.float32: ...


# Number of samples on the polygon's edges at a spacing in metres, corners among them.
@wp.func_native(
    _CLIP
    + """
    int count = 0;
    for (int i = 0; i < n; ++i) count += (int)(edges[i] / spacing);
    return count;
"""
)
def piece_edge_count(
    p0: wp.vec3, p1: wp.vec3, p2: wp.vec3, low: wp.vec3, high: wp.vec3, spacing: wp.float32
) -> wp.int32: ...


# A point of the polygon, uniform in area for u and v uniform in [0, 1).
@wp.func_native(
    _CLIP
    + """
    float left = u * area, x = 0.5f;
    int i = 1;
    for (; i + 2 < n && left >= areas[i]; ++i) left -= areas[i];
    if (areas[i] > 0.0f) x = left / areas[i];
    x = x < 0.0f ? 0.0f : (x > 1.0f ? 1.0f : x);
    const float root = wp::sqrt(x);
    wp::vec3 point;
    for (int k = 0; k < 3; ++k)
        point[k] = 0.5f * (low[k] + high[k]) + corner[0][k] * (1.0f - root) + corner[i][k] * (root * (1.0f - v))
            + corner[i + 1][k] * (root * v);
    return point;
"""
)
def piece_point(
    p0: wp.vec3, p1: wp.vec3, p2: wp.vec3, low: wp.vec3, high: wp.vec3, u: wp.float32, v: wp.float32
) -> wp.vec3: ...


# Sample `index` on the polygon's edges, a thousandth of the way inside.
@wp.func_native(
    _CLIP
    + """
    int left = index, i = 0;
    while (i + 1 < n && left >= (int)(edges[i] / spacing)) left -= (int)(edges[i++] / spacing);
    const int count = (int)(edges[i] / spacing);
    const float along = count ? (float)left / (float)count : 0.0f;
    wp::vec3 point;
    for (int k = 0; k < 3; ++k) {
        const float at = corner[i][k] + along * (corner[i + 1 < n ? i + 1 : 0][k] - corner[i][k]);
        point[k] = 0.5f * (low[k] + high[k]) + at + 1e-3f * (middle[k] - at);
    }
    return point;
"""
)
def piece_edge_point(
    p0: wp.vec3,
    p1: wp.vec3,
    p2: wp.vec3,
    low: wp.vec3,
    high: wp.vec3,
    spacing: wp.float32,
    index: wp.int32,
) -> wp.vec3: ...


# One side of a triangle (number 2 triangle + side), moved off the surface as rays leave it.
@wp.struct
class SideTriangle:
    p0: wp.vec3
    p1: wp.vec3
    p2: wp.vec3
    normal: wp.vec3  # zero where the triangle has no area


@wp.func
def side_triangle(geometry: Geometry, side: wp.int32, radius: wp.float32) -> SideTriangle:
    ids = geometry.indices[side / 2]
    t = SideTriangle()
    t.p0 = geometry.points[ids[0]]
    t.p1 = geometry.points[ids[1]]
    t.p2 = geometry.points[ids[2]]
    t.normal = wp.normalize(wp.cross(t.p1 - t.p0, t.p2 - t.p0))
    if side % 2 != 0:
        t.normal = -t.normal
    t.p0 = t.p0 + t.normal * ray_offset(t.p0, radius)
    t.p1 = t.p1 + t.normal * ray_offset(t.p1, radius)
    t.p2 = t.p2 + t.normal * ray_offset(t.p2, radius)
    return t


# A search for pieces, the parts of sides of triangles in cells of a grid.
@wp.struct
class PieceSearch:
    low: wp.vec3  # corner of cell 0 of the grid, metres
    cell_size: wp.float32
    nx: wp.int32
    ny: wp.int32
    nz: wp.int32
    radius: wp.float32  # radius of the scene, metres
    spacing: wp.float32  # distance between samples on edges, metres
    wanted: wp.array(dtype=wp.uint8)  # [cell] 1 where pieces are looked for
    left_out: wp.array(dtype=wp.int32)  # [object] 1 for objects that are not sampled; empty if none
    start: wp.array(dtype=wp.int64)  # [side] where the side's pieces go; empty while pieces are counted


@wp.func
def cell_low(search: PieceSearch, x: wp.int32, y: wp.int32, z: wp.int32) -> wp.vec3:
    return search.low + wp.vec3(wp.float32(x), wp.float32(y), wp.float32(z)) * search.cell_size


# Thread: a side. Counts the cells that its box meets, which may hold a piece; or writes for each of them cell, area in
# m^2 (0 if the triangle passes by) and number of samples on edges.
@wp.kernel
def find_pieces(
    first: wp.int32,
    geometry: Geometry,
    search: PieceSearch,
    counts: wp.array(dtype=wp.int32),
    cells: wp.array(dtype=wp.int32),
    areas: wp.array(dtype=wp.float32),
    edge_counts: wp.array(dtype=wp.int32),
):
    side = first + wp.tid()
    found = int(0)
    t = side_triangle(geometry, side, search.radius)
    rests = wp.length_sq(t.normal) > 0.0
    if search.left_out.shape[0] > 0:
        rests = rests and search.left_out[geometry.objects[side / 2]] == 0
    if rests:
        low = (wp.min(t.p0, wp.min(t.p1, t.p2)) - search.low) / search.cell_size
        high = (wp.max(t.p0, wp.max(t.p1, t.p2)) - search.low) / search.cell_size
        for z in range(wp.max(wp.int32(low[2]), 0), wp.min(wp.int32(high[2]), search.nz - 1) + 1):
            for y in range(wp.max(wp.int32(low[1]), 0), wp.min(wp.int32(high[1]), search.ny - 1) + 1):
                for x in range(wp.max(wp.int32(low[0]), 0), wp.min(wp.int32(high[0]), search.nx - 1) + 1):
                    cell = (z * search.ny + y) * search.nx + x
                    if search.wanted[cell] != wp.uint8(0):
                        if search.start.shape[0] > 0:
                            at = wp.int32(search.start[side]) + found
                            a = cell_low(search, x, y, z)
                            b = cell_low(search, x + 1, y + 1, z + 1)
                            cells[at] = cell
                            areas[at] = piece_area(t.p0, t.p1, t.p2, a, b)
                            edge_counts[at] = piece_edge_count(t.p0, t.p1, t.p2, a, b, search.spacing)
                        found += 1
    if search.start.shape[0] == 0:
        counts[side] = found
