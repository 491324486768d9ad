"""Zonal lobes that stand for GGX in spherical harmonics, from a table by roughness and view angle.

The table is fitted on the host (techniques/radiance_transfer/lobes.py).
"""

import warp as wp

from warp_gi.kernels.transfer_products import vec6

wp.set_module_options({"enable_backward": False})

HEAD = wp.constant(4)  # numbers of an entry before its factors


@wp.struct
class LobeTable:
    entries: wp.array3d(dtype=wp.float32)  # [roughness, cosine, 4 + order]: sine, cosine, A, B, factors
    smallest: wp.float32  # roughness of the first row; the last is 1


# A lobe about a direction in the plane of normal and view. It reflects f0 A + f90 B of light from everywhere, times
# what its factors, of albedo 1, reflect of the light that there is.
@wp.struct
class Lobe:
    direction: wp.vec3  # world space, unit
    scale: wp.float32  # A
    offset: wp.float32  # B
    factors: vec6


# The lobe of a roughness about the unit normal n, seen from the unit direction `view`; cosines and roughness between
# entries are interpolated.
@wp.func
def lobe_at(table: LobeTable, roughness: wp.float32, n: wp.vec3, view: wp.vec3) -> Lobe:
    last = table.entries.shape[0] - 1
    columns = table.entries.shape[1] - 1
    cosine = wp.clamp(wp.dot(n, view), 0.0, 1.0)
    x = wp.clamp((roughness - table.smallest) / (1.0 - table.smallest), 0.0, 1.0) * wp.float32(last)
    y = cosine * wp.float32(columns)
    i = wp.min(wp.int32(x), last - 1)
    j = wp.min(wp.int32(y), columns - 1)
    fx = x - wp.float32(i)
    fy = y - wp.float32(j)
    w00 = (1.0 - fx) * (1.0 - fy)
    w10 = fx * (1.0 - fy)
    w01 = (1.0 - fx) * fy
    w11 = fx * fy
    r = Lobe()
    e = table.entries
    sine = e[i, j, 0] * w00 + e[i + 1, j, 0] * w10 + e[i, j + 1, 0] * w01 + e[i + 1, j + 1, 0] * w11
    cos_d = e[i, j, 1] * w00 + e[i + 1, j, 1] * w10 + e[i, j + 1, 1] * w01 + e[i + 1, j + 1, 1] * w11
    r.scale = e[i, j, 2] * w00 + e[i + 1, j, 2] * w10 + e[i, j + 1, 2] * w01 + e[i + 1, j + 1, 2] * w11
    r.offset = e[i, j, 3] * w00 + e[i + 1, j, 3] * w10 + e[i, j + 1, 3] * w01 + e[i + 1, j + 1, 3] * w11
    for l in range(table.entries.shape[2] - HEAD):
        k = HEAD + l
        r.factors[l] = e[i, j, k] * w00 + e[i + 1, j, k] * w10 + e[i, j + 1, k] * w01 + e[i + 1, j + 1, k] * w11
    tangent = view - n * wp.dot(n, view)
    length = wp.length(tangent)
    if length > 1.0e-6:
        tangent = tangent / length
    else:  # seen along the normal; the sine is 0 there
        tangent = wp.vec3(0.0, 0.0, 0.0)
    r.direction = wp.normalize(tangent * sine + n * cos_d)
    return r
