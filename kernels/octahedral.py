"""The sphere on a square: octahedral maps (Cigolle et al. 2014), +y in the middle, -y at the corners.

A unit direction is divided by |x| + |y| + |z|; the upper half of that octahedron lies on the diamond in the middle of
the square, seen from above with x to the right and z up, and the lower half is folded out over the diamond's edges.
Crossing an edge of the square at height h comes back in through the same edge at height 1 - h.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def sign_of(x: wp.float32) -> wp.float32:
    return wp.where(x < 0.0, -1.0, 1.0)


# Coordinates in [0, 1]^2 of a direction of any length above zero.
@wp.func
def octahedral_encode(direction: wp.vec3) -> wp.vec2:
    scale = 0.5 / (wp.abs(direction[0]) + wp.abs(direction[1]) + wp.abs(direction[2]))
    x = direction[0] * scale
    z = direction[2] * scale
    if direction[1] < 0.0:
        folded = (0.5 - wp.abs(z)) * sign_of(x)
        z = (0.5 - wp.abs(x)) * sign_of(z)
        x = folded
    return wp.vec2(x + 0.5, z + 0.5)


# Inverse of octahedral_encode; unit length.
@wp.func
def octahedral_decode(uv: wp.vec2) -> wp.vec3:
    x = 2.0 * uv[0] - 1.0
    z = 2.0 * uv[1] - 1.0
    y = 1.0 - wp.abs(x) - wp.abs(z)
    if y < 0.0:
        unfolded = (1.0 - wp.abs(z)) * sign_of(x)
        z = (1.0 - wp.abs(x)) * sign_of(z)
        x = unfolded
    return wp.normalize(wp.vec3(x, y, z))


# Texel of coordinates in [0, 1]^2 in a map of `resolution` x `resolution`, row by row.
@wp.func
def octahedral_texel(uv: wp.vec2, resolution: wp.int32) -> wp.int32:
    column = wp.clamp(wp.int32(uv[0] * wp.float32(resolution)), 0, resolution - 1)
    row = wp.clamp(wp.int32(uv[1] * wp.float32(resolution)), 0, resolution - 1)
    return row * resolution + column


# Texel at (column, row), which may lie up to `resolution` outside of the square: across its edges.
@wp.func
def octahedral_wrap(column: wp.int32, row: wp.int32, resolution: wp.int32) -> wp.int32:
    i = column
    j = row
    if i < 0 or i >= resolution:
        i = wp.where(i < 0, -1 - i, 2 * resolution - 1 - i)
        j = resolution - 1 - j
    if j < 0 or j >= resolution:
        j = wp.where(j < 0, -1 - j, 2 * resolution - 1 - j)
        i = resolution - 1 - i
    return j * resolution + i


# The four texels around a point of a map and how far it is past the first, for bilinear reading across the edges.
@wp.struct
class OctahedralTaps:
    texels: wp.vec4i  # at (column, row), (column + 1, row), (column, row + 1), (column + 1, row + 1)
    x: wp.float32
    y: wp.float32


@wp.func
def octahedral_taps(uv: wp.vec2, resolution: wp.int32) -> OctahedralTaps:
    taps = OctahedralTaps()
    x = uv[0] * wp.float32(resolution) - 0.5
    y = uv[1] * wp.float32(resolution) - 0.5
    column = wp.int32(wp.floor(x))
    row = wp.int32(wp.floor(y))
    taps.x = x - wp.float32(column)
    taps.y = y - wp.float32(row)
    if column >= 0 and row >= 0 and column + 1 < resolution and row + 1 < resolution:
        texel = row * resolution + column
        taps.texels = wp.vec4i(texel, texel + 1, texel + resolution, texel + resolution + 1)
    else:
        taps.texels = wp.vec4i(
            octahedral_wrap(column, row, resolution),
            octahedral_wrap(column + 1, row, resolution),
            octahedral_wrap(column, row + 1, resolution),
            octahedral_wrap(column + 1, row + 1, resolution),
        )
    return taps
