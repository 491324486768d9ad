"""Kernels that trace batches of rays."""

import warp as wp

from warp_gi.kernels.bvh import mesh_intersect, mesh_occluded, runs_on_cuda
from warp_gi.kernels.bvh_native import cpu_only
from warp_gi.kernels.bvh_queries_native import INTERSECT_RAYS, OCCLUDED_RAYS
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


# CPU: rays begin to end - 1 in native code, which saves a launch's cost a ray.
@wp.func_native(cpu_only(OCCLUDED_RAYS))
def occluded_rays_native(
    bvh: Bvh, rays: RayBatch, begin: wp.int32, end: wp.int32, occluded: wp.array(dtype=wp.uint8)
): ...


@wp.func_native(cpu_only(INTERSECT_RAYS))
def intersect_rays_native(bvh: Bvh, rays: RayBatch, begin: wp.int32, end: wp.int32, hits: RayHits): ...


# Thread: `share` rays on the CPU, one on CUDA, where they come in no order but their own.
@wp.kernel
def occluded_rays(first: wp.int32, bvh: Bvh, rays: RayBatch, share: wp.int32, occluded: wp.array(dtype=wp.uint8)):
    i = first + wp.tid()
    if runs_on_cuda() != 0:
        t_max = rays.t_max[wp.min(i, rays.t_max.shape[0] - 1)]
        occluded[i] = wp.uint8(mesh_occluded(bvh, rays.origins[i], rays.directions[i], t_max))
    else:
        occluded_rays_native(bvh, rays, i * share, wp.min((i + 1) * share, rays.origins.shape[0]), occluded)


# Thread: as occluded_rays.
@wp.kernel
def intersect_rays(first: wp.int32, bvh: Bvh, rays: RayBatch, share: wp.int32, hits: RayHits):
    i = first + wp.tid()
    if runs_on_cuda() != 0:
        t_max = rays.t_max[wp.min(i, rays.t_max.shape[0] - 1)]
        hit = mesh_intersect(bvh, rays.origins[i], rays.directions[i], t_max)
        hits.t[i] = hit.t
        hits.face[i] = hit.face
        hits.u[i] = hit.u
        hits.v[i] = hit.v
    else:
        intersect_rays_native(bvh, rays, i * share, wp.min((i + 1) * share, rays.origins.shape[0]), hits)
