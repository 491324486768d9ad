"""Baking a visibility field (dvf.txt, Algorithm 1): surface samples, their rays, and the masks of cells.

A cell's samples are worked off in chunks, each with masks of its own, so no two threads write one place; merging
(Eq. 5 and 6) then ORs the chunks into the cell and dilates once a cell, which is the same as dilating every sample,
since dilation commutes with OR. Between rounds of chunks a cell learns which texels need no more rays. A texel is
settled when all that it dilates to hold both bits: no ray through it can change anything. It is quiet when it and all
around it hold the same single bit: few rays there find anything new, and only one in QUIET_SHARE is traced.
"""

import warp as wp

from warp_gi.kernels.bvh import bvh_intersect
from warp_gi.kernels.gbuffer import CameraData, camera_ray, tiled_pixel
from warp_gi.kernels.sampling import (
    SURFACE_PIECE_DIMENSION,
    SURFACE_POINT_DIMENSION,
    SURFACE_TURN_DIMENSION,
    frame_of,
    hash_uint,
    random_1d,
    sample_2d,
)
from warp_gi.kernels.surface import ray_offset, ray_origin, surface_shape
from warp_gi.kernels.types import Bvh, Geometry, SceneData
from warp_gi.kernels.visibility_field import (
    OCCLUDED,
    SLOT_LABEL,
    TEXELS_A_WORD,
    VISIBLE,
    FieldQuery,
    VisibilityGrid,
    cell_of,
    cosine_octet,
    hinted_occluded,
    lowest_bit,
    octet_bits,
    octet_direction,
    octet_texel,
    state_in,
    turned_frame,
)

wp.set_module_options({"enable_backward": False})


QUIET_SHARE = wp.constant(8)  # one octet of rays in so many is traced in full

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


# The cells of one batch and the pieces in them.
@wp.struct
class CellSurfaces:
    search: PieceSearch
    seed: wp.uint32
    cell: wp.array(dtype=wp.int32)  # [slot] number in the grid
    piece_start: wp.array(dtype=wp.int32)  # [slot + 1] first piece of each cell, and the number of pieces
    side: wp.array(dtype=wp.int32)  # [piece] number of the side: 2 * triangle + side
    area: wp.array(dtype=wp.float32)  # [piece] area, m^2, cumulative in the cell
    edges: wp.array(dtype=wp.int32)  # [piece] samples on edges, cumulative in the cell
    area_count: wp.array(dtype=wp.int32)  # [slot] samples by area; those on edges come after them
    step: wp.array(dtype=wp.int32)  # [slot] step between samples, without a divisor in common with area_count


@wp.struct
class SurfaceSample:
    origin: wp.vec3
    normal: wp.vec3
    hash: wp.uint32


# Sample k of a cell. Samples by area are stratified over the cell's pieces, and taken in steps of a golden section of
# their number, so that the first few are spread over all pieces.
@wp.func
def surface_sample(geometry: Geometry, cells: CellSurfaces, slot: wp.int32, k: wp.int32) -> SurfaceSample:
    cell = cells.cell[slot]
    x = cell % cells.search.nx
    y = (cell / cells.search.nx) % cells.search.ny
    z = cell / (cells.search.nx * cells.search.ny)
    low = cell_low(cells.search, x, y, z)
    high = cell_low(cells.search, x + 1, y + 1, z + 1)
    begin = cells.piece_start[slot]
    last = cells.piece_start[slot + 1] - 1
    count = cells.area_count[slot]
    seed = hash_uint(cells.seed ^ hash_uint(wp.uint32(cell)))
    s = SurfaceSample()
    s.hash = hash_uint(seed + wp.uint32(k))
    lower = int(begin)
    upper = int(last)
    if k < count:
        i = wp.int32(wp.int64(k) * wp.int64(cells.step[slot]) % wp.int64(count))
        share = (wp.float32(i) + random_1d(wp.uint32(i), seed, SURFACE_PIECE_DIMENSION)) / wp.float32(count)
        wanted = share * cells.area[last]
        while lower < upper:
            middle = (lower + upper) / 2
            if cells.area[middle] > wanted:
                upper = middle
            else:
                lower = middle + 1
        t = side_triangle(geometry, cells.side[lower], cells.search.radius)
        u = sample_2d(wp.uint32(i), seed, SURFACE_POINT_DIMENSION)
        s.origin = piece_point(t.p0, t.p1, t.p2, low, high, u[0], u[1])
        s.normal = t.normal
    else:
        j = k - count
        while lower < upper:
            middle = (lower + upper) / 2
            if cells.edges[middle] > j:
                upper = middle
            else:
                lower = middle + 1
        if lower > begin:
            j = j - cells.edges[lower - 1]
        t = side_triangle(geometry, cells.side[lower], cells.search.radius)
        s.origin = piece_edge_point(t.p0, t.p1, t.p2, low, high, cells.search.spacing, j)
        s.normal = t.normal
    return s


# One round: chunk c takes samples begin[c] to end[c] - 1 of the cell of slot[c].
@wp.struct
class BakeChunks:
    slot: wp.array(dtype=wp.int32)
    begin: wp.array(dtype=wp.int32)
    end: wp.array(dtype=wp.int32)
    rays: wp.int32  # rays of a sample, a multiple of 8
    partial: wp.array(dtype=wp.uint32)  # [chunk * words] masks of each chunk
    traced: wp.array(dtype=wp.int32)  # [chunk] rays that were traced


# Thread: a chunk. Writes its own masks and count to `chunks.partial` and `chunks.traced`. In `settled`, which it only
# reads, bit 0 marks texels that are settled, bit 1 texels that are quiet.
@wp.kernel
def bake_masks(
    first: wp.int32,
    bvh: Bvh,
    geometry: Geometry,
    cells: CellSurfaces,
    settled: VisibilityGrid,
    query: FieldQuery,
    chunks: BakeChunks,
):
    chunk = first + wp.tid()
    slot = chunks.slot[chunk]
    start = chunk * settled.words
    for word in range(settled.words):
        chunks.partial[start + word] = wp.uint32(0)
    traced = int(0)
    for k in range(chunks.begin[chunk], chunks.end[chunk]):
        s = surface_sample(geometry, cells, slot, k)
        frame = turned_frame(frame_of(s.normal), random_1d(s.hash, cells.seed, SURFACE_TURN_DIMENSION))
        rays = wp.int32(s.hash % wp.uint32(query.set_count)) * query.set_size
        for ray in range(0, chunks.rays, 8):
            octet = cosine_octet(settled, query.cosines, slot, rays + ray, frame, s.normal)
            bits = octet_bits(octet)
            todo = (bits >> 16) & ~bits & 255
            if (k + ray / 8) % QUIET_SHARE != 0:
                todo = todo & ~(bits >> 8)
            while todo != 0:
                lane = lowest_bit(todo)
                todo = todo & (todo - 1)
                texel = octet_texel(octet, lane)
                at = start + texel / TEXELS_A_WORD
                shift = wp.uint32(2 * (texel % TEXELS_A_WORD))
                known = chunks.partial[at]
                if ((known >> shift) & wp.uint32(3)) != wp.uint32(3):
                    traced += 1
                    state = wp.uint32(VISIBLE)
                    if hinted_occluded(bvh, query, slot * 1337 + texel, s.origin, octet_direction(octet, lane)):
                        state = wp.uint32(OCCLUDED)
                    chunks.partial[at] = known | (state << shift)
    chunks.traced[chunk] = traced


# Cells being baked, slots counted from 0.
@wp.struct
class MergeCells:
    chunk_start: wp.array(dtype=wp.int32)  # [slot + 1] chunks of this round by slot
    partial: wp.array(dtype=wp.uint32)
    raw: wp.array(dtype=wp.uint32)  # [slot * words] OR of all samples so far, not dilated
    masks: wp.array(dtype=wp.uint32)  # [slot * words] `raw`, dilated
    settled: wp.array(dtype=wp.uint32)  # [slot * words] two bits a texel: settled, quiet
    neighbors: wp.array(dtype=wp.int32)  # [texel * neighbor_count] texels that a texel dilates to, itself among them
    neighbor_count: wp.int32
    quiet_neighbors: wp.array(dtype=wp.int32)  # [texel * quiet_count] the same, one texel further
    quiet_count: wp.int32
    resolution: wp.int32
    words: wp.int32
    flags: wp.array(dtype=wp.int32)  # [slot] SLOT_LABEL or 0, by Eq. 7 and 8
    last: wp.int32  # 1 in the last round, which need not find what is settled


# Thread: a cell. ORs the chunks of a round into its masks, dilates them, labels the cell, and finds texels that are
# settled or quiet. Writes its own slot of `raw`, `masks`, `settled` and `flags`.
@wp.kernel
def merge_masks(first: wp.int32, cells: MergeCells):
    slot = first + wp.tid()
    start = slot * cells.words
    for word in range(cells.words):
        merged = cells.raw[start + word]
        for chunk in range(cells.chunk_start[slot], cells.chunk_start[slot + 1]):
            merged = merged | cells.partial[chunk * cells.words + word]
        cells.raw[start + word] = merged
    texels = cells.resolution * cells.resolution
    occluded = int(0)
    for word in range(cells.words):
        dilated = wp.uint32(0)
        for i in range(wp.min(TEXELS_A_WORD, texels - word * TEXELS_A_WORD)):
            texel = word * TEXELS_A_WORD + i
            state = wp.uint32(0)
            for k in range(cells.neighbor_count):
                state = state | state_in(cells.raw, start, cells.neighbors[texel * cells.neighbor_count + k])
            dilated = dilated | (state << wp.uint32(2 * i))
            occluded += wp.int32(state >> wp.uint32(1))
        cells.masks[start + word] = dilated
    # Eq. 7 and 8. N_vis counts what is not occluded, unknown directions among them, as the paper does
    if 2 * occluded > texels:
        cells.flags[slot] = SLOT_LABEL
    else:
        cells.flags[slot] = 0
    if cells.last != 0:
        return
    for word in range(cells.words):
        done = wp.uint32(0)
        for i in range(wp.min(TEXELS_A_WORD, texels - word * TEXELS_A_WORD)):
            texel = word * TEXELS_A_WORD + i
            if state_in(cells.masks, start, texel) == wp.uint32(3):
                settled = wp.uint32(1)
                for k in range(cells.neighbor_count):
                    near = state_in(cells.masks, start, cells.neighbors[texel * cells.neighbor_count + k])
                    if near != wp.uint32(3):
                        settled = wp.uint32(0)
                        break
                done = done | (settled << wp.uint32(2 * i))
            else:
                seen = wp.uint32(0)
                for k in range(cells.quiet_count):
                    near = state_in(cells.masks, start, cells.quiet_neighbors[texel * cells.quiet_count + k])
                    if near == wp.uint32(0):
                        near = wp.uint32(3)
                    seen = seen | near
                    if seen == wp.uint32(3):
                        break
                if seen != wp.uint32(3):
                    done = done | (wp.uint32(2) << wp.uint32(2 * i))
        cells.settled[start + word] = done


# Thread: a block of 2 x 2 pixels. Writes the cell of the surface that pixel number `corner` of it sees; -1: none.
@wp.kernel
def find_cells(
    first: wp.int32,
    scene: SceneData,
    camera: CameraData,
    corner: wp.int32,
    grid: VisibilityGrid,
    cells: wp.array(dtype=wp.int32),
):
    width = (camera.width + 1) / 2
    p = tiled_pixel(first + wp.tid(), width)
    x = 2 * p[0] + corner % 2
    y = 2 * p[1] + corner / 2
    if p[0] >= width or 2 * p[1] >= camera.height:
        return
    direction = camera_ray(camera, wp.float32(x) + 0.5, wp.float32(y) + 0.5)
    hit = bvh_intersect(scene.bvh, camera.position, direction, float(wp.inf))
    cell = int(-1)
    if hit.face >= 0:
        s = surface_shape(scene, hit.face, hit.u, hit.v, -direction)
        cell = cell_of(grid, ray_origin(s))
    cells[p[1] * width + p[0]] = cell
