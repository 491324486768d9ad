"""Ray queries: any hit and closest hit, usable in every kernel.

On the CPU a ray walks an eight-wide tree whose child boxes are quantised to eight bits (bvh_build.py), written
in native code with clang's portable vector types; on CUDA it asks the ``wp.Mesh``. Both count hits with
0 < t < t_max on either side of a triangle, t in units of the direction's length, and pass through alpha-masked
texels. The triangle test is Woop, Benthin, Wald: "Watertight Ray/Triangle Intersection" (JCGT 2013), so no ray
slips through an edge or vertex that triangles share.

Node, 32 words (128 bytes): six rows of eight bytes (low x, y, z, high x, y, z of the children, in steps from the
node's origin), origin (3 floats), step (3 floats), 6 spare, eight children. A child is a node's index, or the
complement of a block's index. Block, 40 words (160 bytes): nine rows of four floats (x, y, z of vertex 0, 1, 2),
then four face words.
"""

import warp as wp

from warp_gi.kernels.types import Bvh

wp.set_module_options({"enable_backward": False})

NODE_WORDS = 32
BLOCK_WORDS = 40
FACE_MASKED = 1 << 30  # flag in a face word; -1 marks an empty lane
STACK_SIZE = 512  # 7 for each level of a tree that is at most 70 deep


# A closest hit. The point is (1 - u - v) p0 + u p1 + v p2, vertices in index-buffer order.
@wp.struct
class BvhHit:
    t: wp.float32  # in units of the direction's length
    u: wp.float32
    v: wp.float32
    face: wp.int32  # -1 on a miss


# Closest hits of a batch, each array [ray].
@wp.struct
class RayHits:
    t: wp.array(dtype=wp.float32)
    face: wp.array(dtype=wp.int32)
    u: wp.array(dtype=wp.float32)
    v: wp.array(dtype=wp.float32)


# Whether the alpha of `face` at barycentrics u, v is below the cutoff of its mask. Needs `bvh` and these in scope.
TRANSPARENT = """
    const auto& mask = bvh.masks.data[bvh.face_masks.data[face]];
    float alpha = mask.factor;
    if (mask.texture >= 0) {
        const auto& texture = bvh.textures.data[mask.texture];
        const wp::vec3i corner = bvh.indices.data[face];
        const wp::vec2 uv0 = bvh.uvs.data[corner[0]], uv1 = bvh.uvs.data[corner[1]], uv2 = bvh.uvs.data[corner[2]];
        int texel[2][2];  // axis, lower and upper neighbour
        float fraction[2];
        for (int axis = 0; axis < 2; ++axis) {
            const int count = axis ? texture.height : texture.width;
            const int wrap = axis ? texture.wrap_v : texture.wrap_u;
            float at = (1.0f - u - v) * uv0[axis] + u * uv1[axis] + v * uv2[axis];
            if (wrap == 0) at -= wp::floor(at);
            else if (wrap == 1) at = at < 0.0f ? 0.0f : (at > 1.0f ? 1.0f : at);
            else at -= 2.0f * wp::floor(0.5f * at);
            at = at * (float)count - 0.5f;
            const float low = wp::floor(at);
            fraction[axis] = at - low;
            for (int side = 0; side < 2; ++side) {
                int i = (int)low + side;
                if (wrap == 0) i = i < 0 ? i + count : (i >= count ? i - count : i);
                else if (wrap == 2) i = i < 0 ? 0 : (i >= 2 * count ? 0 : (i >= count ? 2 * count - 1 - i : i));
                texel[axis][side] = i < 0 ? 0 : (i >= count ? count - 1 : i);
            }
        }
        float sum = 0.0f;
        for (int corner_index = 0; corner_index < 4; ++corner_index) {
            const int right = corner_index & 1, up = corner_index >> 1;
            const float weight = (right ? fraction[0] : 1.0f - fraction[0]) * (up ? fraction[1] : 1.0f - fraction[1]);
            const int at = texture.start + texel[1][up] * texture.width + texel[0][right];
            sum += weight * (float)(bvh.texels.data[at] >> 24);
        }
        alpha *= sum * (1.0f / 255.0f);
    }
    return alpha < mask.cutoff;
"""

# Ray set-up, box test and triangle test. The ray's parameter inside is the distance along its dominant axis, so
# that no direction is too short or too long. Rounding: boxes are enlarged when quantised and SLACK widens the far
# side, so a box never loses a ray that its triangles would keep.
TRAVERSAL = """
    typedef float f4 __attribute__((vector_size(16)));
    typedef float f8 __attribute__((vector_size(32)));
    typedef int i4 __attribute__((vector_size(16)));
    typedef unsigned char u8 __attribute__((vector_size(8)));
    typedef bool b4 __attribute__((ext_vector_type(4)));
    typedef bool b8 __attribute__((ext_vector_type(8)));
    typedef unsigned long long Entry;  // entry distance in the high half, child in the low half
    typedef decltype(bvh) Tree;

    struct Ray {
        float origin[3], reciprocal[3];
        int near_row[3], far_row[3];  // byte offsets in a node
        int kx, ky, kz;  // float offsets in a block; kz is the dominant axis
        float shear_x, shear_y, origin_x, origin_y, origin_z, sign, length;

        bool setup(const wp::vec3& start, const wp::vec3& direction) {
            const float x = __builtin_fabsf(direction[0]), y = __builtin_fabsf(direction[1]);
            const float z = __builtin_fabsf(direction[2]);
            const int k = x > y ? (x > z ? 0 : 2) : (y > z ? 1 : 2);
            length = __builtin_fabsf(direction[k]);
            if (!(x + y + z > 0.0f && x + y + z <= 3e38f)) return false;
            for (int axis = 0; axis < 3; ++axis) {
                const float d = direction[axis] / length;
                const float least = direction[axis] < 0.0f ? -1e-18f : 1e-18f;
                reciprocal[axis] = 1.0f / (__builtin_fabsf(d) < 1e-18f ? least : d);
                origin[axis] = start[axis];
                near_row[axis] = 8 * axis + (direction[axis] < 0.0f ? 24 : 0);
                far_row[axis] = 8 * axis + (direction[axis] < 0.0f ? 0 : 24);
            }
            const int i = k == 2 ? 0 : k + 1, j = k == 0 ? 2 : k - 1;
            kx = 4 * i, ky = 4 * j, kz = 4 * k;
            origin_x = start[i], origin_y = start[j], origin_z = start[k];
            shear_x = direction[i] / direction[k], shear_y = direction[j] / direction[k];
            sign = direction[k] < 0.0f ? -1.0f : 1.0f;
            return true;
        }

        // Bits of the children that the ray enters before `limit`, and their entry distances.
        inline unsigned boxes(const unsigned char* node, float limit, f8& entry) const {
            const float* frame = (const float*)(node + 48);
            f8 near = {}, far = limit - (f8) {};
            for (int axis = 0; axis < 3; ++axis) {
                const float base = (frame[axis] - origin[axis]) * reciprocal[axis];
                const float step = frame[3 + axis] * reciprocal[axis];
                const f8 low = __builtin_convertvector(*(const u8*)(node + near_row[axis]), f8) * step + base;
                const f8 high = __builtin_convertvector(*(const u8*)(node + far_row[axis]), f8) * step + base;
                near = low > near ? low : near;
                far = high < far ? high : far;
            }
            entry = near;
            const float slack = 1.000001f;
            return __builtin_bit_cast(unsigned char, __builtin_convertvector(near <= far * slack, b8));
        }

        static inline f4 edge(f4 ax, f4 by, f4 ay, f4 bx) {
#pragma clang fp contract(off)
            return ax * by - ay * bx;  // exactly antisymmetric, so both sides of a shared edge agree
        }

        // Bits of the triangles hit with 0 < t < limit, their t and barycentrics of vertex 1 and 2.
        inline unsigned triangles(const float* block, float limit, f4& t, f4& u, f4& v) const {
            const f4 az = *(const f4*)(block + kz) - origin_z;
            const f4 bz = *(const f4*)(block + 12 + kz) - origin_z;
            const f4 cz = *(const f4*)(block + 24 + kz) - origin_z;
            const f4 ax = (*(const f4*)(block + kx) - origin_x) - shear_x * az;
            const f4 ay = (*(const f4*)(block + ky) - origin_y) - shear_y * az;
            const f4 bx = (*(const f4*)(block + 12 + kx) - origin_x) - shear_x * bz;
            const f4 by = (*(const f4*)(block + 12 + ky) - origin_y) - shear_y * bz;
            const f4 cx = (*(const f4*)(block + 24 + kx) - origin_x) - shear_x * cz;
            const f4 cy = (*(const f4*)(block + 24 + ky) - origin_y) - shear_y * cz;
            const f4 wa = edge(cx, by, cy, bx), wb = edge(ax, cy, ay, cx), wc = edge(bx, ay, by, ax);
            const i4 inside = ((wa >= 0.0f) & (wb >= 0.0f) & (wc >= 0.0f)) | ((wa <= 0.0f) & (wb <= 0.0f) & (wc <= 0.0f));
            if (!(bits(inside))) return 0;
            const f4 scale = 1.0f / (wa + wb + wc);  // infinite where edge-on: then t is infinite or NaN, no hit
            t = (wa * az + wb * bz + wc * cz) * scale * sign;
            u = wb * scale;
            v = wc * scale;
            return bits(inside & (t > 0.0f) & (t < limit));
        }

        static inline unsigned bits(i4 mask) {
            return __builtin_bit_cast(unsigned char, __builtin_convertvector(mask, b4)) & 15u;
        }
    };
    struct Query {
        static __attribute__((noinline)) bool transparent(const Tree& bvh, int face, float u, float v) {%s}
        static bool passes(const Tree& bvh, int face, float u, float v) {
            return (face & %d) && transparent(bvh, face & ~%d, u, v);
        }
""" % (TRANSPARENT, FACE_MASKED, FACE_MASKED)

OCCLUDED = """
#if defined(__CUDA_ARCH__)
    return 0;
#else
    %s
        static __attribute__((noinline)) int run(const Tree& bvh, const wp::vec3& origin, const wp::vec3& direction, float t_max) {
            Ray ray;
            if (!ray.setup(origin, direction)) return 0;
            const unsigned char* nodes = (const unsigned char*)bvh.nodes.data;
            const float limit = t_max * ray.length;
            int stack[%d];
            int size = 0, child = 0;
            while (true) {
                if (child >= 0) {
                    const unsigned char* node = nodes + 128ll * child;
                    f8 entry;
                    unsigned hits = ray.boxes(node, limit, entry);
                    const int* children = (const int*)(node + 96);
                    while (hits) {
                        stack[size++] = children[__builtin_ctz(hits)];
                        hits &= hits - 1;
                    }
                } else {
                    const float* block = bvh.blocks.data + 40ll * ~child;
                    f4 t, u, v;
                    unsigned hits = ray.triangles(block, limit, t, u, v);
                    while (hits) {
                        const int lane = __builtin_ctz(hits);
                        if (!passes(bvh, ((const int*)block)[36 + lane], u[lane], v[lane])) return 1;
                        hits &= hits - 1;
                    }
                }
                if (!size) return 0;
                child = stack[--size];
            }
        }
    };
    return Query::run(bvh, origin, direction, t_max);
#endif
    ;
""" % (TRAVERSAL, STACK_SIZE)

INTERSECT = """
#if defined(__CUDA_ARCH__)
    return wp::vec4();
#else
    %s
        static __attribute__((noinline)) wp::vec4 run(const Tree& bvh, const wp::vec3& origin, const wp::vec3& direction, float t_max) {
            Ray ray;
            wp::vec4 hit(t_max, 0.0f, 0.0f, __builtin_bit_cast(float, -1));
            if (!ray.setup(origin, direction)) return hit;
            const unsigned char* nodes = (const unsigned char*)bvh.nodes.data;
            float limit = t_max * ray.length;
            Entry stack[%d];
            int size = 0;
            Entry top = 0;
            while (true) {
                const int child = (int)(unsigned)top;
                if (child >= 0) {
                    const unsigned char* node = nodes + 128ll * child;
                    alignas(32) f8 entry;
                    unsigned hits = ray.boxes(node, limit, entry);
                    const unsigned* children = (const unsigned*)(node + 96);
                    const unsigned* keys = (const unsigned*)&entry;  // not negative: ordered like their bits
                    const int first = size;
                    while (hits) {
                        const int i = __builtin_ctz(hits);
                        const Entry item = (Entry)keys[i] << 32 | children[i];
                        int at = size++;
                        while (at > first && stack[at - 1] < item) { stack[at] = stack[at - 1]; --at; }
                        stack[at] = item;
                        hits &= hits - 1;
                    }
                } else {
                    const float* block = bvh.blocks.data + 40ll * ~child;
                    f4 t, u, v;
                    unsigned hits = ray.triangles(block, limit, t, u, v);
                    while (hits) {
                        const int lane = __builtin_ctz(hits);
                        hits &= hits - 1;
                        const int face = ((const int*)block)[36 + lane];
                        if (t[lane] >= limit || passes(bvh, face, u[lane], v[lane])) continue;
                        limit = t[lane];
                        hit = wp::vec4(limit / ray.length, u[lane], v[lane], __builtin_bit_cast(float, face & ~%d));
                    }
                }
                do {
                    if (!size) return hit;
                    top = stack[--size];
                } while (__builtin_bit_cast(float, (unsigned)(top >> 32)) > limit * 1.000001f);
            }
        }
    };
    return Query::run(bvh, origin, direction, t_max);
#endif
    ;
""" % (TRAVERSAL, STACK_SIZE, FACE_MASKED)


@wp.func_native("#if defined(__CUDA_ARCH__)\n    return 1;\n#else\n    return 0;\n#endif\n;")
def runs_on_cuda() -> wp.int32: ...


@wp.func_native(TRANSPARENT)
def is_transparent(bvh: Bvh, face: wp.int32, u: wp.float32, v: wp.float32) -> wp.bool: ...


@wp.func_native(OCCLUDED)
def wide_occluded(bvh: Bvh, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> wp.int32: ...


@wp.func_native(INTERSECT)
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
    return wp.vec3((wa * a[k] + wb * b[k] + wc * c[k]) / (total * direction[k]), wb / total, wc / total)


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
                passed = is_transparent(bvh, face, h[1], h[2])
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
    return wide_occluded(bvh, origin, direction, t_max)


# The closest hit on origin + t direction with 0 < t < t_max.
@wp.func
def bvh_intersect(bvh: Bvh, origin: wp.vec3, direction: wp.vec3, t_max: wp.float32) -> BvhHit:
    if runs_on_cuda() != 0:
        return mesh_intersect(bvh, origin, direction, t_max)
    hit = wide_intersect(bvh, origin, direction, t_max)
    return BvhHit(hit[0], hit[1], hit[2], wp.cast(hit[3], wp.int32))


# Thread: one ray. The limit of ray i is t_max[i], or t_max[0] where there is only one.
@wp.kernel
def occluded_rays(
    first: wp.int32,
    bvh: Bvh,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    t_max: wp.array(dtype=wp.float32),
    occluded: wp.array(dtype=wp.uint8),
):
    i = first + wp.tid()
    limit = t_max[wp.min(i, t_max.shape[0] - 1)]
    occluded[i] = wp.uint8(bvh_occluded(bvh, origins[i], directions[i], limit))


# Thread: one ray; see occluded_rays.
@wp.kernel
def intersect_rays(
    first: wp.int32,
    bvh: Bvh,
    origins: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    t_max: wp.array(dtype=wp.float32),
    hits: RayHits,
):
    i = first + wp.tid()
    hit = bvh_intersect(bvh, origins[i], directions[i], t_max[wp.min(i, t_max.shape[0] - 1)])
    hits.t[i] = hit.t
    hits.face[i] = hit.face
    hits.u[i] = hit.u
    hits.v[i] = hit.v
