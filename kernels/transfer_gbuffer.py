"""The G-buffer of an atlas: which face lies nearest to each texel, and where on it.

Faces are binned on the host into tiles of TILE x TILE texels. A texel takes the nearest point that the faces of its tile
have at most a texel away along each axis: just those texels are touched by bilinear fetches inside faces.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

TILE = wp.constant(8)  # texels along a side


@wp.struct
class TransferTiles:
    pages: wp.array(dtype=wp.vec4i)  # [tile] page's width and height in texels, and the tile's first texel in the page
    starts: wp.array(dtype=wp.int32)  # [tile + 1] first entry of each tile in faces
    faces: wp.array(dtype=wp.int32)  # rising in each tile
    corners: wp.array2d(dtype=wp.vec2)  # [face, 3] in texels of the face's page


@wp.struct
class TransferTexels:
    faces: wp.array(dtype=wp.int32)  # [tile * TILE * TILE] nearest face, -1 where none is near
    points: wp.array(dtype=wp.vec2)  # barycentric coordinates u, v of the nearest point


# Share of the way from a to b at which a segment, cut off at the square, is nearest to the origin; -1 if it is outside.
@wp.func
def nearest_share(a: wp.vec2, b: wp.vec2) -> wp.float32:
    d = b - a
    low = float(0.0)
    high = float(1.0)
    for axis in range(2):
        if d[axis] != 0.0:
            s = (-1.0 - a[axis]) / d[axis]
            t = (1.0 - a[axis]) / d[axis]
            low = wp.max(low, wp.min(s, t))
            high = wp.min(high, wp.max(s, t))
        elif wp.abs(a[axis]) > 1.0:
            return -1.0
    if low > high:
        return -1.0
    size = wp.dot(d, d)
    if size == 0.0:
        return 0.0
    return wp.clamp(-wp.dot(a, d) / size, low, high)


# Of a triangle in the plane and the square of two texels a side around the origin, the barycentric coordinates u, v of
# the common point that is nearest to the origin, and the square of its distance; that is infinite if there is none.
@wp.func
def nearest_point(a: wp.vec2, b: wp.vec2, c: wp.vec2) -> wp.vec3:
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    u = c[0] * a[1] - c[1] * a[0]
    v = a[0] * b[1] - a[1] * b[0]
    w = area - u - v
    if area != 0.0 and u * area >= 0.0 and v * area >= 0.0 and w * area >= 0.0:
        return wp.vec3(u / area, v / area, 0.0)
    best = wp.vec3(0.0, 0.0, wp.inf)
    s = nearest_share(a, b)
    p = a + (b - a) * s
    if s >= 0.0:
        best = wp.vec3(s, 0.0, wp.dot(p, p))
    s = nearest_share(b, c)
    p = b + (c - b) * s
    if s >= 0.0 and wp.dot(p, p) < best[2]:
        best = wp.vec3(1.0 - s, s, wp.dot(p, p))
    s = nearest_share(c, a)
    p = c + (a - c) * s
    if s >= 0.0 and wp.dot(p, p) < best[2]:
        best = wp.vec3(0.0, 1.0 - s, wp.dot(p, p))
    return best


# Thread: a texel, TILE * TILE of them a tile, row by row. Writes the nearest face and the point on it; of faces equally
# near the lowest.
@wp.kernel
def find_texel_faces(first: wp.int32, tiles: TransferTiles, texels: TransferTexels):
    item = first + wp.tid()
    tile = item / (TILE * TILE)
    place = item % (TILE * TILE)
    page = tiles.pages[tile]
    x = page[2] + place % TILE
    y = page[3] + place / TILE
    texels.faces[item] = -1
    texels.points[item] = wp.vec2(0.0, 0.0)
    if x >= page[0] or y >= page[1]:
        return
    center = wp.vec2(wp.float32(x) + 0.5, wp.float32(y) + 0.5)
    nearest = float(wp.inf)
    for k in range(tiles.starts[tile], tiles.starts[tile + 1]):
        face = tiles.faces[k]
        a = tiles.corners[face, 0] - center
        b = tiles.corners[face, 1] - center
        c = tiles.corners[face, 2] - center
        at = nearest_point(a, b, c)
        if at[2] < nearest:
            nearest = at[2]
            texels.faces[item] = face
            texels.points[item] = wp.vec2(at[0], at[1])
