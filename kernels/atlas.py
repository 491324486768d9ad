"""The atlas of transfer textures: from a hit to the slots in which transfer is stored there.

A texel that a surface covers has a slot for each side on which light is kept; arrays of transfer have a row a slot. So
what no triangle covers, and backs that nobody sees, take no memory. Texel (i, j) of a page is centred at
(i + 0.5, j + 0.5), in units of texels. At vertices instead of texels, each corner of a face names its slots itself.
"""

import warp as wp

from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

FRONT = wp.constant(0)  # sides of a triangle: its corners run counter-clockwise, seen from the front
BACK = wp.constant(1)


@wp.struct
class SurfaceAtlas:
    corners: wp.array2d(dtype=wp.vec2)  # [face, 3] in texels of the face's page
    face_pages: wp.array(dtype=wp.int32)  # [face], -1 for faces without texels
    pages: wp.array(dtype=wp.vec3i)  # first texel, width, height
    slots: wp.array2d(dtype=wp.int32)  # [side, texel], -1 where nothing is kept
    corner_slots: wp.array2d(dtype=wp.vec3i)  # [side, face] where transfer is kept at vertices; else empty


# Slots around a point and their shares. Shares add up to 1, or are all 0 where nothing is kept; where one is 0 its slot
# may be any, so that it can be read: 0.
@wp.struct
class SlotFetch:
    slots: wp.vec4i
    shares: wp.vec4


# Side of a triangle from which a ray in `direction` meets it.
@wp.func
def side_seen(scene: SceneData, face: wp.int32, direction: wp.vec3) -> wp.int32:
    ids = scene.geometry.indices[face]
    p0 = scene.geometry.points[ids[0]]
    normal = wp.cross(scene.geometry.points[ids[1]] - p0, scene.geometry.points[ids[2]] - p0)
    if wp.dot(normal, direction) > 0.0:
        return BACK
    return FRONT


# The point (u, v) of a face in texels of its page.
@wp.func
def atlas_point(atlas: SurfaceAtlas, face: wp.int32, u: wp.float32, v: wp.float32) -> wp.vec2:
    return atlas.corners[face, 0] * (1.0 - u - v) + atlas.corners[face, 1] * u + atlas.corners[face, 2] * v


# Slots with shares whose slots are missing left out, and the others' made to add up to 1.
@wp.func
def kept_slots(slots: wp.vec4i, shares: wp.vec4) -> SlotFetch:
    r = SlotFetch(slots, shares)
    sum = float(0.0)
    for k in range(4):
        if slots[k] < 0:
            r.slots[k] = 0
            r.shares[k] = 0.0
        sum += r.shares[k]
    if sum > 0.0:
        r.shares = r.shares / sum
    return r


# Where to read transfer at the point (u, v) of a face: bilinear between texels, or linear between vertices.
@wp.func
def atlas_fetch(atlas: SurfaceAtlas, face: wp.int32, u: wp.float32, v: wp.float32, side: wp.int32) -> SlotFetch:
    if atlas.corner_slots.shape[0] > 0:
        c = atlas.corner_slots[side, face]
        return kept_slots(wp.vec4i(c[0], c[1], c[2], -1), wp.vec4(1.0 - u - v, u, v, 0.0))
    if atlas.face_pages[face] < 0:
        return SlotFetch()
    page = atlas.pages[atlas.face_pages[face]]
    p = atlas_point(atlas, face, u, v)
    x = wp.clamp(p[0] - 0.5, 0.0, wp.float32(page[1] - 1))
    y = wp.clamp(p[1] - 0.5, 0.0, wp.float32(page[2] - 1))
    i = wp.int32(x)
    j = wp.int32(y)
    right = wp.min(i + 1, page[1] - 1) - i
    row = page[0] + j * page[1] + i
    above = row + (wp.min(j + 1, page[2] - 1) - j) * page[1]
    fx = x - wp.float32(i)
    fy = y - wp.float32(j)
    slots = wp.vec4i(
        atlas.slots[side, row],
        atlas.slots[side, row + right],
        atlas.slots[side, above],
        atlas.slots[side, above + right],
    )
    shares = wp.vec4((1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy)
    return kept_slots(slots, shares)


# The one slot nearest to the point (u, v) of a face, or -1 where nothing is kept.
@wp.func
def atlas_nearest(atlas: SurfaceAtlas, face: wp.int32, u: wp.float32, v: wp.float32, side: wp.int32) -> wp.int32:
    if atlas.corner_slots.shape[0] > 0:
        c = atlas.corner_slots[side, face]
        w = 1.0 - u - v
        if w >= u and w >= v:
            return c[0]
        if u >= v:
            return c[1]
        return c[2]
    if atlas.face_pages[face] < 0:
        return -1
    page = atlas.pages[atlas.face_pages[face]]
    p = atlas_point(atlas, face, u, v)
    i = wp.clamp(wp.int32(p[0]), 0, page[1] - 1)
    j = wp.clamp(wp.int32(p[1]), 0, page[2] - 1)
    return atlas.slots[side, page[0] + j * page[1] + i]
