"""Kernels of the suite ``rays``: Warp's own mesh queries, one a thread; native loops that call Embree, on the CPU."""

import warp as wp

from warp_gi.kernels.bvh_native import cpu_only


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


# RTCRayHit and RTCRayHit16 of Embree 4, with room for the ids of instances.
SINGLE = """
    struct __attribute__((aligned(16))) RayHit {
        float origin[3], near, direction[3], time, far;
        unsigned mask, id, flags;
        float normal[3], u, v;
        unsigned face, geometry, instances[9];
    };
    typedef void (*Query)(void*, RayHit*, void*);
    const Query query = (Query)function;
    const int count = (int)origins.shape[0], end = (item + 1) * 256 < count ? (item + 1) * 256 : count;
    for (int i = item * 256; i < end; ++i) {
        RayHit ray;
        for (int k = 0; k < 3; ++k) ray.origin[k] = origins.data[i][k], ray.direction[k] = directions.data[i][k];
        ray.near = 0.0f, ray.far = t_max.data[i], ray.time = 0.0f;
        ray.mask = ~0u, ray.id = 0, ray.flags = 0;
        ray.geometry = ray.face = ray.instances[0] = ~0u;
        query((void*)scene, &ray, nullptr);
        found.data[i] = closest ? (int)(ray.geometry == ~0u ? ~0u : ray.face) : ray.far < 0.0f;
    }
"""
PACKETS = """
    struct __attribute__((aligned(64))) RayHits {
        float origin[3][16], near[16], direction[3][16], time[16], far[16];
        unsigned mask[16], id[16], flags[16];
        float normal[3][16], u[16], v[16];
        unsigned face[16], geometry[16], instances[9][16];
    };
    struct Arguments { unsigned flags, features; void* rest[6]; } arguments = {1u << 16, ~0u, {}};  // coherent
    typedef void (*Query)(const int*, void*, RayHits*, void*);
    const Query query = (Query)function;
    const int count = (int)origins.shape[0], end = (item + 1) * 256 < count ? (item + 1) * 256 : count;
    for (int first = item * 256; first < end; first += 16) {
        RayHits rays;
        __attribute__((aligned(64))) int valid[16];
        for (int lane = 0; lane < 16; ++lane) {
            const int i = first + lane < end ? first + lane : end - 1;
            valid[lane] = first + lane < end ? -1 : 0;
            for (int k = 0; k < 3; ++k)
                rays.origin[k][lane] = origins.data[i][k], rays.direction[k][lane] = directions.data[i][k];
            rays.near[lane] = 0.0f, rays.far[lane] = t_max.data[i], rays.time[lane] = 0.0f;
            rays.mask[lane] = ~0u, rays.id[lane] = 0, rays.flags[lane] = 0;
            rays.geometry[lane] = rays.face[lane] = rays.instances[0][lane] = ~0u;
        }
        query(valid, (void*)scene, &rays, &arguments);
        for (int lane = 0; lane < 16 && first + lane < end; ++lane)
            found.data[first + lane] = closest
                ? (int)(rays.geometry[lane] == ~0u ? ~0u : rays.face[lane]) : rays.far[lane] < 0.0f;
    }
"""


@wp.func_native(cpu_only(SINGLE))
def single_rays(
    function: wp.uint64,
    scene: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    t_max: wp.array(dtype=wp.float32),
    closest: wp.int32,
    found: wp.array(dtype=wp.int32),
    item: wp.int32,
): ...


@wp.func_native(cpu_only(PACKETS))
def packets_of_rays(
    function: wp.uint64,
    scene: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    t_max: wp.array(dtype=wp.float32),
    closest: wp.int32,
    found: wp.array(dtype=wp.int32),
    item: wp.int32,
): ...


# Thread: 256 rays, one after the other.
@wp.kernel
def trace_rays(
    first: wp.int32,
    function: wp.uint64,
    scene: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    t_max: wp.array(dtype=wp.float32),
    closest: wp.int32,
    found: wp.array(dtype=wp.int32),
):
    single_rays(function, scene, origins, directions, t_max, closest, found, first + wp.tid())


# Thread: 256 rays, in packets of 16.
@wp.kernel
def trace_packets(
    first: wp.int32,
    function: wp.uint64,
    scene: wp.uint64,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    t_max: wp.array(dtype=wp.float32),
    closest: wp.int32,
    found: wp.array(dtype=wp.int32),
):
    packets_of_rays(function, scene, origins, directions, t_max, closest, found, first + wp.tid())
