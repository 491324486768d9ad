"""Kernels that trace batches of rays."""

import warp as wp

from warp_gi.kernels.bvh import bvh_intersect, bvh_occluded
from warp_gi.kernels.types import Bvh

wp.set_module_options({"enable_backward": False})


# Closest hits of a batch, each array [ray].
@wp.struct
class RayHits:
    t: wp.array(dtype=wp.float32)
    face: wp.array(dtype=wp.int32)
    u: wp.array(dtype=wp.float32)
    v: wp.array(dtype=wp.float32)


# Thread: one ray. Its origin's cell along a Morton curve through 32 x 32 x 32 cells.
@wp.kernel
def order_keys(
    first: wp.int32,
    origins: wp.array(dtype=wp.vec3),
    low: wp.vec3,
    cells_per_metre: wp.float32,
    keys: wp.array(dtype=wp.uint16),
):
    i = first + wp.tid()
    cell = (origins[i] - low) * cells_per_metre
    key = int(0)
    for axis in range(3):
        x = int(wp.clamp(cell[axis], 0.0, 31.0))
        for bit in range(5):
            key = key | (((x >> bit) & 1) << (3 * bit + axis))
    keys[i] = wp.uint16(key)


# A batch of rays. The limit of ray i is t_max[i], or t_max[0] where there is only one. They are traced in the
# order given, or as they come where it is empty.
@wp.struct
class RayBatch:
    origins: wp.array(dtype=wp.vec3)
    directions: wp.array(dtype=wp.vec3)
    t_max: wp.array(dtype=wp.float32)
    order: wp.array(dtype=wp.int64)


# The ray of a thread; asks for that of a later one ahead of time.
@wp.func_native(
    """
    if (!rays.order.shape[0]) return item;
#if !defined(__CUDA_ARCH__)
    if (item + 12 < rays.order.shape[0]) {
        const long long later = rays.order.data[item + 12];
        __builtin_prefetch(rays.origins.data + later);
        __builtin_prefetch(rays.directions.data + later);
    }
#endif
    return (int)rays.order.data[item];
    """
)
def ray_index(rays: RayBatch, item: wp.int32) -> wp.int32: ...


# Thread: one ray.
@wp.kernel
def occluded_rays(first: wp.int32, bvh: Bvh, rays: RayBatch, occluded: wp.array(dtype=wp.uint8)):
    i = ray_index(rays, first + wp.tid())
    t_max = rays.t_max[wp.min(i, rays.t_max.shape[0] - 1)]
    occluded[i] = wp.uint8(bvh_occluded(bvh, rays.origins[i], rays.directions[i], t_max))


# Thread: one ray.
@wp.kernel
def intersect_rays(first: wp.int32, bvh: Bvh, rays: RayBatch, hits: RayHits):
    i = ray_index(rays, first + wp.tid())
    t_max = rays.t_max[wp.min(i, rays.t_max.shape[0] - 1)]
    hit = bvh_intersect(bvh, rays.origins[i], rays.directions[i], t_max)
    hits.t[i] = hit.t
    hits.face[i] = hit.face
    hits.u[i] = hit.u
    hits.v[i] = hit.v
