"""Kernels of the suite ``rays``: Warp's own mesh queries, one a thread."""

import warp as wp


# Thread: a ray. Writes 1 if Warp's mesh query finds any hit, else 0.
@wp.kernel(enable_backward=False)
def warp_any(
    first: wp.int32,
    mesh: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    faces[i] = wp.int32(wp.mesh_query_ray_anyhit(mesh, origins[i], directions[i], wp.inf))


# Thread: a ray. Writes the triangle of the closest hit that Warp's mesh query finds, -1 for none.
@wp.kernel(enable_backward=False)
def warp_closest(
    first: wp.int32,
    mesh: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    faces: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    query = wp.mesh_query_ray(mesh, origins[i], directions[i], wp.inf)
    faces[i] = wp.where(query.result, query.face, -1)
