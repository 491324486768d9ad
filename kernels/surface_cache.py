"""A radiance cache of surface cells in a hash grid: what irradiance a cell gets, and what paths read of it.

A cell is a cube of a regular grid, seen on one side of one axis: surfaces that face another way have cells of their
own. Cells are small near the camera's path, and double in size with the distance from it; every point lies in cells of
several sizes, of which paths read the finest that enough samples fell into. An object that moves has a grid of its own,
in the pose in which it was at time 0, and takes its cells along. The table is an open-addressed one with linear
probing; slots after the last keep those that overflow, and the very last one is empty.
"""

import warp as wp

from warp_gi.kernels.bsdf import Bsdf, diffuse_share, specular_probability
from warp_gi.kernels.bvh import BvhHit
from warp_gi.kernels.path_samplers import KnownRadiance, PathCache
from warp_gi.kernels.sampling import frame_of
from warp_gi.kernels.surface import Surface
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

LEVELS = wp.constant(5)  # sizes of cells that a point lies in, each twice the one before
READ_LEVELS = wp.constant(2)  # that paths of a picture read: wider cells reach through walls; those are for fills
LARGEST_LEVEL = wp.constant(10)  # of the smallest of them, so that the key has room for all
LARGEST_COORDINATE = wp.constant((1 << 16) - 1)  # of a cell of level 0, along an axis
MOST_OBJECTS = wp.constant((1 << 9) - 1)  # that have a grid of their own; others share grids
NEAR = wp.constant(wp.float32(1.0))  # sides of a cell below which matt surfaces are too near to each other to read one
LEAST_LOBE = wp.constant(wp.float32(0.3))  # probability, at least, of tracing a lobe that is not read


# Grid of an object.
@wp.struct
class ObjectGrid:
    number: wp.int32  # in keys, 1 to MOST_OBJECTS; 0: the grid of all that is at rest
    rest_from_world: wp.mat44  # from the pose of this frame to that at time 0, for numbers above 0


# What paths read. A cell is two rows of `values`: irradiance [W/m^2] by all light, and the number of samples; then the
# exitance [W/m^2] by the GGX lobe.
@wp.struct
class SurfaceCells:
    low: wp.vec3  # corner of the first cell, metres
    side: wp.float32  # of a cell of level 0, metres
    growth: wp.float32  # largest side of a cell over its distance from the camera's path, above level 0
    traced_below: wp.float32  # roughness below which the GGX lobe is traced, and not read
    residual: wp.float32  # share of paths that go on and correct what cells say
    objects: wp.array(dtype=ObjectGrid)  # [object]; empty where nothing moves
    boxes: wp.array(dtype=wp.vec3)  # [2 * box] low and high corners around pieces of the camera's path, metres
    bits: wp.int32  # the table has 2^bits slots, and a few more
    keys: wp.array(dtype=wp.uint64)  # [slot]; 0: empty
    values: wp.array(dtype=wp.vec4)  # [2 * slot]


# Level of the smallest cells at a point.
@wp.func
def cell_level(cells: SurfaceCells, position: wp.vec3) -> wp.int32:
    nearest = float(wp.inf)
    for k in range(cells.boxes.shape[0] / 2):
        low = cells.boxes[2 * k] - position
        high = position - cells.boxes[2 * k + 1]
        away = wp.max(wp.max(low, high), wp.vec3(0.0, 0.0, 0.0))
        nearest = wp.min(nearest, wp.dot(away, away))
    most = cells.growth * wp.sqrt(nearest)
    level = int(0)
    side = 2.0 * cells.side
    while side <= most and level < LARGEST_LEVEL:
        side *= 2.0
        level += 1
    return level


# Key of 64 bits from the grid's number, coordinates of a cell of level 0 around a point, the side that is seen and the
# level: 9 bits of the number, 16 a coordinate, 3 of axis and sign, 4 of the level + 1, so that no key is 0.
@wp.func_native(
    snippet="""
    typedef unsigned long long Word;
    return ((Word)number << 55) | ((Word)(x >> level) << 39) | ((Word)(y >> level) << 23) | ((Word)(z >> level) << 7)
        | ((Word)side << 4) | (Word)(level + 1);
"""
)
def packed_key(
    number: wp.int32, x: wp.int32, y: wp.int32, z: wp.int32, side: wp.int32, level: wp.int32
) -> wp.uint64: ...


# Key of the cell of the next level around a cell.
@wp.func_native(
    snippet="""
    typedef unsigned long long Word;
    return (((Word)key >> 1) & 0x003fffbfffbfff80ull) + ((Word)key & 0xff8000000000007full) + 1ull;
"""
)
def coarser_key(key: wp.uint64) -> wp.uint64: ...


# First slot in which a key may be.
@wp.func_native(
    snippet="""
    typedef unsigned long long Word;
    Word k = (Word)key * 0x9e3779b97f4a7c15ull;
    k ^= k >> 29;
    k *= 0xbf58476d1ce4e5b9ull;
    return (int)(k >> (64 - bits));
"""
)
def first_slot(key: wp.uint64, bits: wp.int32) -> wp.int32: ...


# Which of the six sides a unit normal looks to: axis times two, plus one where it is negative.
@wp.func
def side_of(normal: wp.vec3) -> wp.int32:
    axis = int(0)
    if wp.abs(normal[1]) > wp.abs(normal[0]):
        axis = 1
    if wp.abs(normal[2]) > wp.abs(normal[axis]):
        axis = 2
    return 2 * axis + wp.where(normal[axis] < 0.0, 1, 0)


@wp.func
def cell_coordinate(offset: wp.float32, side: wp.float32) -> wp.int32:
    return wp.int32(wp.clamp(wp.floor(offset / side), 0.0, wp.float32(LARGEST_COORDINATE)))


# Grid of the object that a triangle belongs to.
@wp.func
def object_grid(cells: SurfaceCells, scene: SceneData, face: wp.int32) -> ObjectGrid:
    grid = ObjectGrid()
    if cells.objects.shape[0] > 0:
        grid = cells.objects[scene.geometry.objects[face]]
    return grid


# Key of the cell of a level at a point of an object that is seen from the side of the unit normal.
@wp.func
def cell_key(cells: SurfaceCells, grid: ObjectGrid, position: wp.vec3, normal: wp.vec3, level: wp.int32) -> wp.uint64:
    p = position
    n = normal
    if grid.number > 0:
        p = wp.transform_point(grid.rest_from_world, p)
        n = wp.transform_vector(grid.rest_from_world, n)
    p = p - cells.low
    x = cell_coordinate(p[0], cells.side)
    y = cell_coordinate(p[1], cells.side)
    z = cell_coordinate(p[2], cells.side)
    return packed_key(grid.number, x, y, z, side_of(n), level)


# Slot of a cell; -1: it is not in the table.
@wp.func
def cell_slot(cells: SurfaceCells, key: wp.uint64) -> wp.int32:
    slot = first_slot(key, cells.bits)
    found = cells.keys[slot]
    while found != key:
        if found == wp.uint64(0):
            return -1
        slot += 1
        found = cells.keys[slot]
    return slot


# Starts fetching a slot.
@wp.func_native(
    snippet="""
#if !defined(__CUDA_ARCH__)
    __builtin_prefetch(&keys.data[slot]);
    __builtin_prefetch(&values.data[2 * slot]);
#endif
"""
)
def slot_prefetch(keys: wp.array(dtype=wp.uint64), values: wp.array(dtype=wp.vec4), slot: wp.int32): ...


# Slot of the finest cell of `levels` sizes that is known around a point, read at a random place in the tangent plane
# within a cell of it, which hides the cells' borders, or else at the point itself; -1: none is known.
@wp.func
def known_slot(
    cells: SurfaceCells, grid: ObjectGrid, s: Surface, level: wp.int32, levels: wp.int32, u: wp.vec2
) -> wp.int32:
    side = cells.side * wp.float32(1 << level)
    across = frame_of(s.normal) * wp.vec3((u[0] - 0.5) * side, (u[1] - 0.5) * side, 0.0)
    beside = cell_key(cells, grid, s.position + across, s.normal, level)
    here = cell_key(cells, grid, s.position, s.normal, level)
    slot_prefetch(cells.keys, cells.values, first_slot(beside, cells.bits))
    slot_prefetch(cells.keys, cells.values, first_slot(here, cells.bits))
    slot = int(-1)
    for _k in range(levels):
        if slot < 0:
            slot = cell_slot(cells, beside)
        if slot < 0:
            slot = cell_slot(cells, here)
        beside = coarser_key(beside)
        here = coarser_key(here)
    return slot


# Side in metres of the cell in a slot.
@wp.func
def side_in_slot(cells: SurfaceCells, slot: wp.int32) -> wp.float32:
    level = wp.int32(cells.keys[slot] & wp.uint64(15)) - 1
    return cells.side * wp.float32(1 << level)


# Exitance [W/m^2] of a cell at a point with this material; `with_lobe` 0 leaves the GGX lobe out.
@wp.func
def cell_exitance(cells: SurfaceCells, slot: wp.int32, b: Bsdf, with_lobe: wp.int32) -> wp.vec3:
    e = cells.values[2 * slot]
    light = wp.cw_mul(wp.cw_mul(diffuse_share(b), b.diffuse), wp.vec3(e[0], e[1], e[2]))
    if with_lobe != 0 and b.f90 > 0.0:
        g = cells.values[2 * slot + 1]
        light = light + wp.vec3(g[0], g[1], g[2])
    return light


# Probability of tracing a lobe that is too smooth to be read.
@wp.func
def surface_lobe(cells: SurfaceCells, s: Surface, wo: wp.vec3) -> wp.float32:
    if s.bsdf.f90 <= 0.0 or s.bsdf.alpha >= cells.traced_below * cells.traced_below:
        return 0.0
    return wp.max(specular_probability(s.bsdf, wo[2]), LEAST_LOBE)


# Radiance of all light that a surface reflects towards wo, but for a lobe that is traced. Nothing is known where cells
# would show: in corners, whose light differs within a cell, and in mirrors. A sample of direction stands for the solid
# angle 1 / pdf, which a ray of length t widens to an area of t^2 / pdf; cells are read where that is as large as it is
# at NEAR sides of a cell from a matt surface, whose pdf is up to 1 / pi, and no nearer.
@wp.func
def surface_lookup(
    cells: SurfaceCells, scene: SceneData, s: Surface, wo: wp.vec3, hit: BvhHit, pdf: wp.float32, u: wp.vec2
) -> KnownRadiance:
    known = KnownRadiance()
    grid = object_grid(cells, scene, hit.face)
    slot = known_slot(cells, grid, s, cell_level(cells, s.position), READ_LEVELS, u)
    if slot < 0:
        return known
    nearest = NEAR * side_in_slot(cells, slot)
    if hit.t * hit.t >= wp.max(wp.pi * pdf, 1.0) * nearest * nearest:
        reads_lobe = wp.where(surface_lobe(cells, s, wo) > 0.0, 0, 1)
        known.radiance = cell_exitance(cells, slot, s.bsdf, reads_lobe) / wp.pi
        known.validity = 1.0
        known.follow = cells.residual
    return known


SURFACE_CACHE = PathCache("surface", SurfaceCells, surface_lookup, holds_direct=True, lobe=surface_lobe, by_place=True)
"""Cells of surfaces, which know all light that arrives there."""
