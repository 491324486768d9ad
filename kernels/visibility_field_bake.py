"""Baking a visibility field (dvf.txt, Algorithm 1): surface samples, their rays, and the masks of cells.

A cell's samples are worked off in chunks, each with masks of its own, so no two threads write one place; merging
(Eq. 5 and 6) then ORs the chunks into the cell and dilates once a cell, which is the same as dilating every sample,
since dilation commutes with OR. Between rounds of chunks a cell learns which texels need no more rays. A texel is
settled when all that it dilates to hold both bits: no ray through it can change anything. It is quiet when it and all
around it hold the same single bit: few rays there find anything new, and only one in QUIET_SHARE is traced.
"""

import warp as wp

from warp_gi.kernels.bvh import bvh_intersect
from warp_gi.kernels.gbuffer import CameraData, camera_origin, camera_ray, tiled_pixel
from warp_gi.kernels.sampling import (
    SURFACE_PIECE_DIMENSION,
    SURFACE_POINT_DIMENSION,
    SURFACE_TURN_DIMENSION,
    frame_of,
    hash_uint,
    random_1d,
    sample_2d,
)
from warp_gi.kernels.surface import ray_origin, surface_shape
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
from warp_gi.kernels.visibility_field_pieces import (
    PieceSearch,
    cell_low,
    piece_edge_point,
    piece_point,
    side_triangle,
)

wp.set_module_options({"enable_backward": False})


QUIET_SHARE = wp.constant(8)  # one octet of rays in so many is traced in full


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
    at = wp.vec2(wp.float32(x) + 0.5, wp.float32(y) + 0.5)
    direction = camera_ray(camera, at[0], at[1])
    hit = bvh_intersect(scene.bvh, camera_origin(camera, at[0], at[1]), direction, float(wp.inf))
    cell = int(-1)
    if hit.face >= 0:
        s = surface_shape(scene, hit.face, hit.u, hit.v, -direction)
        cell = cell_of(grid, ray_origin(s))
    cells[p[1] * width + p[0]] = cell
