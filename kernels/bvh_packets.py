"""Kernels that trace batches of coherent rays, sixteen at once on the CPU."""

import warp as wp

from warp_gi.kernels.bvh import mesh_intersect, mesh_occluded, runs_on_cuda
from warp_gi.kernels.bvh_packets_native import INTERSECT_PACKETS, OCCLUDED_PACKETS
from warp_gi.kernels.bvh_rays import RayBatch, RayHits
from warp_gi.kernels.types import Bvh

wp.set_module_options({"enable_backward": False})


# CPU: rays begin to end - 1.
@wp.func_native(OCCLUDED_PACKETS)
def occluded_packets_native(
    bvh: Bvh, rays: RayBatch, begin: wp.int32, end: wp.int32, occluded: wp.array(dtype=wp.uint8)
): ...


@wp.func_native(INTERSECT_PACKETS)
def intersect_packets_native(bvh: Bvh, rays: RayBatch, begin: wp.int32, end: wp.int32, hits: RayHits): ...


# Thread: as bvh_rays.occluded_rays.
@wp.kernel
def occluded_packets(first: wp.int32, bvh: Bvh, rays: RayBatch, share: wp.int32, occluded: wp.array(dtype=wp.uint8)):
    i = first + wp.tid()
    if runs_on_cuda() != 0:
        t_max = rays.t_max[wp.min(i, rays.t_max.shape[0] - 1)]
        occluded[i] = wp.uint8(mesh_occluded(bvh, rays.origins[i], rays.directions[i], t_max))
    else:
        occluded_packets_native(bvh, rays, i * share, wp.min((i + 1) * share, rays.origins.shape[0]), occluded)


# Thread: as bvh_rays.intersect_rays.
@wp.kernel
def intersect_packets(first: wp.int32, bvh: Bvh, rays: RayBatch, share: wp.int32, hits: RayHits):
    i = first + wp.tid()
    if runs_on_cuda() != 0:
        t_max = rays.t_max[wp.min(i, rays.t_max.shape[0] - 1)]
        hit = mesh_intersect(bvh, rays.origins[i], rays.directions[i], t_max)
        hits.t[i] = hit.t
        hits.face[i] = hit.face
        hits.u[i] = hit.u
        hits.v[i] = hit.v
    else:
        intersect_packets_native(bvh, rays, i * share, wp.min((i + 1) * share, rays.origins.shape[0]), hits)
