"""Ray queries: any hit and closest hit, usable in every kernel.

On the CPU a ray walks an eight-wide tree (built by bvh_build.py) in native code with clang's portable vector types;
on CUDA it asks the ``wp.Mesh``. Both count hits with 0 < t < t_max on either side of a triangle, t in units of the
direction's length, and pass through triangles where alpha lets them; only CUDA's any-hit query counts t = 0 as well.
"""

import warp as wp

from warp_gi.kernels.bvh_native import ALPHA, BLOCK_STEPS, THROUGH, TRANSPARENT, cpu_only
from warp_gi.kernels.bvh_queries_native import INTERSECT, OCCLUDED
from warp_gi.kernels.types import Bvh

wp.set_module_options({"enable_backward": False})


# A closest hit. The point is (1 - u - v) p0 + u p1 + v p2, vertices in index-buffer order.
@wp.struct
class BvhHit:
    t: wp.float32  # in units of the direction's length
    u: wp.float32
    v: wp.float32
    face: wp.int32  # -1 on a miss


@wp.func_native("#if defined(__CUDA_ARCH__)\n    return 1;\n#else\n    return 0;\n#endif\n;")
def runs_on_cuda() -> wp.int32: ...


ARRAYS = """
    const auto* face_masks = bvh.face_masks.data;
    const auto* masks = bvh.masks.data;
    const auto* indices = bvh.indices.data;
    const auto* uvs = bvh.uvs.data;
    const auto* alphas = bvh.alphas.data;
    const auto* textures = bvh.textures.data;
    const auto* texels = bvh.texels.data;
    const auto* points = bvh.points.data;
"""


# Whether a ray that meets the masked triangle `face` at u, v passes through it.
@wp.func_native(ARRAYS + "const unsigned salt = bvh.salt;\nconst int chance = bvh.chance;\n" + TRANSPARENT)
def is_transparent(bvh: Bvh, face: wp.int32, u: wp.float32, v: wp.float32, start: wp.vec3, way: wp.vec3) -> wp.bool: ...


# Share of the masked triangle `face` that is there at u, v, from 0 to 1.
@wp.func_native(ARRAYS + ALPHA + "    return alpha;\n")
def coverage(bvh: Bvh, face: wp.int32, u: wp.float32, v: wp.float32) -> wp.float32: ...


GLASS = ARRAYS + ALPHA + THROUGH + "    return alpha > 0.0f ? wp::vec2(through, entering) : wp::vec2();\n"


# Share of the light which meets the triangle `face` along `way` that goes straight through it, and what that would be
# without a reflection; 0 if it is no glass. A call on the CPU, as most scenes have no glass.
@wp.func_native(
    "if (!bvh.chance || bvh.face_masks.data[face] < 0) return wp::vec2();\n"
    + cpu_only(
        """
    struct Rare {
        static __attribute__((noinline, cold)) wp::vec2 run(
            const wp::remove_reference<decltype(bvh)>::type& bvh, int face, float u, float v, const wp::vec3& way
        ) {%s}
    };
    return Rare::run(bvh, face, u, v, way);
"""
        % GLASS,
        GLASS,
    )
)
def transmitted(bvh: Bvh, face: wp.int32, u: wp.float32, v: wp.float32, way: wp.vec3) -> wp.vec2: ...


@wp.func_native(cpu_only(OCCLUDED, "return 0;"))
def wide_occluder(bvh: Bvh, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32, hint: wp.int32) -> wp.int32: ...


@wp.func_native(cpu_only(INTERSECT, "return wp::vec4();"))
def wide_intersect(bvh: Bvh, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.vec4: ...


# t, u (of vertex 1), v (of vertex 2); t is infinite on a miss. Woop, Benthin, Wald 2013.
@wp.func
def triangle_hit(origin: wp.vec3, direction: wp.vec3, p0: wp.vec3, p1: wp.vec3, p2: wp.vec3) -> wp.vec3:
    size = wp.abs(direction)
    k = int(2)
    if size[0] > size[1] and size[0] > size[2]:
        k = 0
    elif size[1] > size[2]:
        k = 1
    i = (k + 1) % 3
    j = (k + 2) % 3
    a = p0 - origin
    b = p1 - origin
    c = p2 - origin
    shear_x = direction[i] / direction[k]
    shear_y = direction[j] / direction[k]
    ax = wp.float64(a[i] - shear_x * a[k])
    ay = wp.float64(a[j] - shear_y * a[k])
    bx = wp.float64(b[i] - shear_x * b[k])
    by = wp.float64(b[j] - shear_y * b[k])
    cx = wp.float64(c[i] - shear_x * c[k])
    cy = wp.float64(c[j] - shear_y * c[k])
    wa = wp.float32(cx * by - cy * bx)
    wb = wp.float32(ax * cy - ay * cx)
    wc = wp.float32(bx * ay - by * ax)
    total = wa + wb + wc
    if (wp.min(wa, wp.min(wb, wc)) < 0.0 and wp.max(wa, wp.max(wb, wc)) > 0.0) or total == 0.0:
        return wp.vec3(wp.inf, 0.0, 0.0)
    return wp.vec3(
        (wa * a[k] + wb * b[k] + wc * c[k]) / (total * direction[k]),
        wb / total,
        wc / total,
    )


@wp.func
def is_masked(bvh: Bvh, face: wp.int32) -> wp.bool:
    if bvh.face_masks.shape[0] == 0:
        return False
    return bvh.face_masks[face] >= 0


# Closest (or, where `any_hit` is set, some) hit that no mask lets through, by visiting every box on the ray:
# nothing is lost where triangles coincide.
@wp.func
def masked_mesh_intersect(
    bvh: Bvh, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32, any_hit: wp.int32
) -> BvhHit:
    hit = BvhHit(t_max, 0.0, 0.0, -1)
    query = wp.bvh_query_ray(wp.mesh_get_bvh(bvh.mesh), origin, direction)
    face = int(0)
    while wp.bvh_query_next(query, face, hit.t):
        p0 = wp.mesh_get_point(bvh.mesh, 3 * face)
        p1 = wp.mesh_get_point(bvh.mesh, 3 * face + 1)
        p2 = wp.mesh_get_point(bvh.mesh, 3 * face + 2)
        h = triangle_hit(origin, direction, p0, p1, p2)
        if h[0] > 0.0 and h[0] < hit.t:
            passed = bool(False)
            if is_masked(bvh, face):
                passed = is_transparent(bvh, face, h[1], h[2], origin, direction)
            if not passed:
                hit = BvhHit(h[0], h[1], h[2], face)
                if any_hit != 0:
                    return hit
    return hit


# The CUDA path. An opaque closest hit of the built-in query is the answer; else every box is visited.
@wp.func
def mesh_intersect(bvh: Bvh, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> BvhHit:
    query = wp.mesh_query_ray(bvh.mesh, origin, direction, t_max)
    if not query.result:
        return BvhHit(t_max, 0.0, 0.0, -1)
    if is_masked(bvh, query.face) or query.t <= 0.0:
        return masked_mesh_intersect(bvh, origin, direction, t_max, 0)
    return BvhHit(query.t, query.v, 1.0 - query.u - query.v, query.face)


@wp.func
def mesh_occluded(bvh: Bvh, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.int32:
    if bvh.face_masks.shape[0] == 0:
        return wp.int32(wp.mesh_query_ray_anyhit(bvh.mesh, origin, direction, t_max))
    return wp.int32(masked_mesh_intersect(bvh, origin, direction, t_max, 1).face >= 0)


# Whether anything lies on origin + t direction with 0 < t < t_max: 1 or 0.
@wp.func
def bvh_occluded(bvh: Bvh, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.int32:
    if runs_on_cuda() != 0:
        return mesh_occluded(bvh, origin, direction, t_max)
    return wp.int32(wide_occluder(bvh, origin, direction, t_max, 0) != 0)


# As bvh_occluded, for rays like others before: tries first what lies below the node `hint`, where the last such ray
# ended, and returns 0 if nothing is in the way, else the hint for the next ray plus 1. Boxes nest, so a ray that meets
# a block meets every box above it too, and a hint never changes whether it is occluded. CUDA has no use for hints.
@wp.func
def bvh_occluder(bvh: Bvh, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32, hint: wp.int32) -> wp.int32:
    if runs_on_cuda() != 0:
        return mesh_occluded(bvh, origin, direction, t_max)
    block = wide_occluder(bvh, origin, direction, t_max, hint)
    if block == 0:
        return 0
    return bvh.parents[(-1 - block) / BLOCK_STEPS] + 1


# The closest hit on origin + t direction with 0 < t < t_max.
@wp.func
def bvh_intersect(bvh: Bvh, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> BvhHit:
    if runs_on_cuda() != 0:
        return mesh_intersect(bvh, origin, direction, t_max)
    hit = wide_intersect(bvh, origin, direction, t_max)
    return BvhHit(hit[0], hit[1], hit[2], wp.cast(hit[3], wp.int32))
