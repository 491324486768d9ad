"""Lobes that stand for GGX in spherical harmonics, from a table by roughness and view angle, and the sky through them.

Tables are fitted on the host (techniques/radiance_transfer/lobes.py and prefiltered.py).
"""

import warp as wp

from warp_gi.kernels.environment import lat_long_encode
from warp_gi.kernels.transfer_products import vec6

wp.set_module_options({"enable_backward": False})

HEAD = wp.constant(4)  # numbers of an entry before its factors
NORMAL_BANDS = wp.constant(4)  # factors about the normal, at its end


@wp.struct
class LobeTable:
    entries: wp.array3d(dtype=wp.float32)  # [roughness, column, 8 + order]: sine, cosine, A, B, factors
    is_white: wp.int32  # 1: lobes reflect all of a white sky; 0: as much as the entries say
    smallest: wp.float32  # roughness of the first row; the last is 1
    lookups: wp.array3d(dtype=wp.float32)  # [roughness, column, 3]: sine, cosine and level of a map of the sky


# Maps of the sky, prefiltered by roughness, in its own space.
@wp.struct
class PrefilteredSky:
    texels: wp.array(dtype=wp.vec3)  # [level, row, column]
    levels: wp.int32
    rows: wp.int32  # of a map, which has twice as many columns


# Place between four entries of a table: the upper left one, and shares of rows and columns behind it.
@wp.struct
class TablePlace:
    row: wp.int32
    column: wp.int32
    down: wp.float32
    right: wp.float32


# A lobe in the plane of normal and view, of albedo 1. GGX is that times f0 A + f90 B, numbers 2 and 3 of an entry.
@wp.struct
class Lobe:
    direction: wp.vec3  # world space, unit
    factors: vec6  # about the direction
    normal_factors: wp.vec4  # about the normal, of bands 1 to 4


@wp.func
def table_place(table: LobeTable, roughness: wp.float32, cosine: wp.float32) -> TablePlace:
    rows = table.entries.shape[0] - 1
    columns = table.entries.shape[1] - 1
    r = TablePlace()
    x = wp.clamp((roughness - table.smallest) / (1.0 - table.smallest), 0.0, 1.0) * wp.float32(rows)
    y = wp.sqrt(1.0 - wp.sqrt(wp.clamp(cosine, 0.0, 1.0))) * wp.float32(columns)
    r.row = wp.min(wp.int32(x), rows - 1)
    r.column = wp.min(wp.int32(y), columns - 1)
    r.down = x - wp.float32(r.row)
    r.right = y - wp.float32(r.column)
    return r


@wp.func
def table_entry(table: wp.array3d(dtype=wp.float32), at: TablePlace, k: wp.int32) -> wp.float32:
    above = wp.lerp(table[at.row, at.column, k], table[at.row, at.column + 1, k], at.right)
    below = wp.lerp(table[at.row + 1, at.column, k], table[at.row + 1, at.column + 1, k], at.right)
    return wp.lerp(above, below, at.down)


# Unit direction of a sine and a cosine in the plane of normal and view; the sine is 0 where they are one.
@wp.func
def in_plane(n: wp.vec3, view: wp.vec3, sine: wp.float32, cosine: wp.float32) -> wp.vec3:
    across = view - n * wp.dot(n, view)
    length = wp.length(across)
    return wp.normalize(across * (sine / wp.max(length, 1.0e-6)) + n * cosine)


# The lobe about the unit normal n, seen from the unit direction `view`. What its factors reflect without occluders,
# sum_l A_l (2 l + 1) / (4 pi) (about d P_l(c) + about n), is made 1: entries between those of the table do not add up.
@wp.func
def lobe_at(table: LobeTable, at: TablePlace, n: wp.vec3, view: wp.vec3) -> Lobe:
    r = Lobe()
    entries = table.entries
    order = entries.shape[2] - HEAD - NORMAL_BANDS
    side = wp.vec2(table_entry(entries, at, 0), table_entry(entries, at, 1))
    side = side / wp.length(side)
    r.direction = in_plane(n, view, side[0], side[1])
    for l in range(order):
        r.factors[l] = table_entry(entries, at, HEAD + l)
    for l in range(NORMAL_BANDS):
        r.normal_factors[l] = table_entry(entries, at, HEAD + order + l)
    c = side[1]
    c2 = c * c
    f = r.factors
    m = r.normal_factors
    white = 0.25 * f[0] + 0.5 * (f[1] * c + m[0]) + 0.3125 * (f[2] * (1.5 * c2 - 0.5) + m[1])
    white = white - 0.09375 * (f[4] * ((4.375 * c2 - 3.75) * c2 + 0.375) + m[3])
    if table.is_white != 0:
        r.factors = f / white
        r.normal_factors = m / white
    return r


# Radiance of the sky through the lobe of GGX, without occluders, for an albedo of 1.
@wp.func
def unshaded_radiance(
    table: LobeTable,
    sky: PrefilteredSky,
    environment_from_world: wp.mat33,
    at: TablePlace,
    n: wp.vec3,
    view: wp.vec3,
) -> wp.vec3:
    direction = in_plane(n, view, table_entry(table.lookups, at, 0), table_entry(table.lookups, at, 1))
    uv = lat_long_encode(environment_from_world * direction)
    level = wp.clamp(table_entry(table.lookups, at, 2), 0.0, wp.float32(sky.levels - 1))
    k = wp.min(wp.int32(level), sky.levels - 2)
    share = level - wp.float32(k)
    return map_radiance(sky, k, uv) * (1.0 - share) + map_radiance(sky, k + 1, uv) * share


# Bilinear lookup in one map, whose nodes lie as those of an environment's.
@wp.func
def map_radiance(sky: PrefilteredSky, level: wp.int32, uv: wp.vec2) -> wp.vec3:
    columns = 2 * sky.rows
    x = uv[0] * wp.float32(columns) - 0.5
    y = wp.clamp(uv[1], 0.0, 1.0) * wp.float32(sky.rows - 1)
    left = wp.int32(wp.floor(x))
    row = wp.min(wp.int32(y), sky.rows - 2)
    s = x - wp.float32(left)
    t = y - wp.float32(row)
    right = (left + 1) % columns
    left = (left + columns) % columns
    start = (level * sky.rows + row) * columns
    upper = sky.texels[start + left] * (1.0 - s) + sky.texels[start + right] * s
    lower = sky.texels[start + columns + left] * (1.0 - s) + sky.texels[start + columns + right] * s
    return upper * (1.0 - t) + lower * t
