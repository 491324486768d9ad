"""The G-buffer of an atlas: which face lies nearest to each texel, where on it, and whether its back is in the open.

Faces are binned on the host into tiles of TILE x TILE texels. A texel takes the nearest point that the faces of its
tile have at most a texel away along each axis: just those texels are touched by bilinear fetches inside faces.
"""

import warp as wp

from warp_gi.kernels.atlas import FRONT, side_seen
from warp_gi.kernels.bvh import bvh_intersect
from warp_gi.kernels.sampling import OWN_DIMENSION, cosine_direction, frame_of, sample_2d
from warp_gi.kernels.surface import ray_offset
from warp_gi.kernels.types import Bvh, SceneData

wp.set_module_options({"enable_backward": False})

TILE = wp.constant(8)  # texels along a side
INSIDE = wp.constant(0.1)  # share of the way to the centre of its face from which a slot's rays leave


@wp.struct
class AtlasTiles:
    pages: wp.array(dtype=wp.vec4i)  # [tile] page's width and height in texels, and the tile's first texel in the page
    starts: wp.array(dtype=wp.int32)  # [tile + 1] first entry of each tile in faces
    faces: wp.array(dtype=wp.int32)  # rising in each tile
    corners: wp.array2d(dtype=wp.vec2)  # [face, 3] in texels of the face's page


@wp.struct
class AtlasTexels:
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
def find_texel_faces(first: wp.int32, tiles: AtlasTiles, texels: AtlasTexels):
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


@wp.struct
class BackLooks:
    faces: wp.array(dtype=wp.int32)  # [slot] on the fronts
    points: wp.array(dtype=wp.vec2)  # [slot] barycentric coordinates u, v
    faces_of_bvh: wp.array(dtype=wp.int32)  # [triangle of the tree] face of the scene
    rays: wp.int32  # a slot
    open: wp.array(dtype=wp.int32)  # [slot] rays from the back that met the sky, or the front of a face


# Thread: a slot. Looks from the back of its face, a little inside its edges, and counts the rays that meet the sky or a
# front: no ray does within a closed surface.
@wp.kernel
def look_behind(first: wp.int32, scene: SceneData, bvh: Bvh, looks: BackLooks):
    slot = first + wp.tid()
    face = looks.faces[slot]
    ids = scene.geometry.indices[face]
    a = scene.geometry.points[ids[0]]
    b = scene.geometry.points[ids[1]]
    c = scene.geometry.points[ids[2]]
    back = -wp.normalize(wp.cross(wp.normalize(b - a), wp.normalize(c - a)))
    at = looks.points[slot] * (1.0 - INSIDE) + wp.vec2(1.0, 1.0) * (INSIDE / 3.0)
    position = a * (1.0 - at[0] - at[1]) + b * at[0] + c * at[1]
    origin = position + back * ray_offset(position, scene.radius)
    frame = frame_of(back)
    count = int(0)
    for k in range(looks.rays):
        index = wp.uint32(slot) * wp.uint32(looks.rays) + wp.uint32(k)
        direction = frame * cosine_direction(sample_2d(index, wp.uint32(0), OWN_DIMENSION))
        hit = bvh_intersect(bvh, origin, direction, wp.inf)
        if hit.face < 0:
            count += 1
        elif side_seen(scene, looks.faces_of_bvh[hit.face], direction) == FRONT:
            count += 1
    looks.open[slot] = count
