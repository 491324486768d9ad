"""Ray queries: any hit and closest hit, usable in every kernel.

On the CPU a ray walks an eight-wide tree whose child boxes are quantised to eight bits (bvh_build.py), written
in native code with clang's portable vector types; on CUDA it asks the ``wp.Mesh``. Both count hits with
0 < t < t_max on either side of a triangle, t in units of the direction's length, and pass through alpha-masked
texels. The triangle test is Woop, Benthin, Wald: "Watertight Ray/Triangle Intersection" (JCGT 2013), so no ray
slips through an edge or vertex that triangles share.

Node, 32 words (128 bytes): for x, y, z three rows of eight bytes, the low, high and again low sides of the children
(so that one load finds near and far side in either order); base and span, three floats each, where byte q stands for
base + span (1 + q / 32768); eight children. A child is a node's index, or the complement of a block's; block 0 is
empty and stands for no child. Block, 40 words (160 bytes): nine rows of four floats (x, y, z of vertex 0, 1, 2),
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


# Whether the alpha of `face` at barycentrics u, v is below the cutoff of its mask. Needs the arrays of Bvh in scope.
TRANSPARENT = """
    const auto& mask = masks[face_masks[face]];
    float alpha = mask.factor;
    if (mask.texture >= 0) {
        const auto& texture = textures[mask.texture];
        const wp::vec3i corner = indices[face];
        const wp::vec2 uv0 = uvs[corner[0]], uv1 = uvs[corner[1]], uv2 = uvs[corner[2]];
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
            sum += weight * (float)(texels[at] >> 24);
        }
        alpha *= sum * (1.0f / 255.0f);
    }
    return alpha < mask.cutoff;
"""

# Ray set-up, box test and triangle test, then the start of the query's struct. Rounding: boxes are enlarged when
# they are quantised, and the ray's far side moves out and its near side in by a bound on the error of
# slope * plane + offset, so a box never loses a ray that its triangles would keep. 256-bit vectors: 512-bit ones
# ran at half the speed.
TRAVERSAL = """
    typedef float f4 __attribute__((vector_size(16)));
    typedef float f8 __attribute__((vector_size(32)));
    typedef int i4 __attribute__((vector_size(16)));
    typedef int i8 __attribute__((vector_size(32)));
    typedef char c8 __attribute__((vector_size(8)));
    typedef char c32 __attribute__((vector_size(32)));
    typedef bool b4 __attribute__((ext_vector_type(4)));
    typedef bool b8 __attribute__((ext_vector_type(8)));
    typedef unsigned long long Entry;  // entry distance in the high half, child in the low half

    struct Ray {
        f8 near_slope[3], near_offset[3], far_slope[3], far_offset[3];  // t = slope * plane + offset
        int row[3];  // byte offset in a node of the near side's row, which the far side's follows
        int kx, ky, kz;  // float offsets in a block; kz is the dominant axis
        float shear_x, shear_y, origin_x, origin_y, origin_z, inverse_z;
        float scale;  // of the direction, 1 but for extreme lengths

        static inline f4 low(f4 a, f4 b) { return a < b ? a : b; }
        static inline f4 high(f4 a, f4 b) { return a > b ? a : b; }
        static inline f8 low(f8 a, f8 b) { return a < b ? a : b; }
        static inline f8 high(f8 a, f8 b) { return a > b ? a : b; }

        inline bool setup(f4 start, f4 d) {
            f4 size = high(d, -d);
            const int k = size[0] > size[1] ? (size[0] > size[2] ? 0 : 2) : (size[1] > size[2] ? 1 : 2);
            const float sum = size[0] + size[1] + size[2];
            scale = 1.0f;
            if (__builtin_expect(!(size[k] >= 1e-6f && sum <= 1e6f), 0)) {
                if (!(size[k] > 1e-36f && sum <= 3e38f)) return false;
                scale = 1.0f / size[k];
                d *= scale;
                size *= scale;
            }
            const f4 least = d < 0.0f ? -1e-20f - (f4) {} : 1e-20f - (f4) {};
            const f4 inverse = 1.0f / (size > 1e-20f ? d : least);
            for (int axis = 0; axis < 3; ++axis) {
                const float slope = inverse[axis], offset = -start[axis] * slope;
                const float error = __builtin_fabsf(offset) * 2e-7f, outwards = 1.000001f;
                near_slope[axis] = slope - (f8) {};
                near_offset[axis] = (offset - error) - (f8) {};
                far_slope[axis] = slope * outwards - (f8) {};
                far_offset[axis] = (offset + error) * outwards - (f8) {};
                row[axis] = 24 * axis + (d[axis] < 0.0f ? 8 : 0);
            }
            const int i = k == 2 ? 0 : k + 1, j = k == 0 ? 2 : k - 1;
            kx = 4 * i, ky = 4 * j, kz = 4 * k;
            origin_x = start[i], origin_y = start[j], origin_z = start[k];
            inverse_z = inverse[k];
            const f4 shear = d / d[k];
            shear_x = shear[i], shear_y = shear[j];
            return true;
        }

        // Bits of the children that the ray enters before the limit, and their entry distances.
        inline unsigned boxes(const unsigned char* node, float limit, f8& entry) const {
#pragma clang fp contract(fast)
            const float* frame = (const float*)(node + 72);
            f8 near[3], far[3];
            for (int axis = 0; axis < 3; ++axis) {
                decode(node + row[axis], near[axis], far[axis]);
                near[axis] = near[axis] * (frame[3 + axis] * near_slope[axis])
                    + (frame[axis] * near_slope[axis] + near_offset[axis]);
                far[axis] = far[axis] * (frame[3 + axis] * far_slope[axis])
                    + (frame[axis] * far_slope[axis] + far_offset[axis]);
            }
            entry = high(high(near[0], near[1]), high(near[2], (f8) {}));
            const f8 leave = low(low(far[0], far[1]), low(far[2], limit * 1.000001f - (f8) {}));
            return __builtin_bit_cast(unsigned char, __builtin_convertvector(entry <= leave, b8));
        }

        // Two rows of eight bytes as floats 1 + byte / 32768.
        static inline void decode(const unsigned char* rows, f8& near, f8& far) {
#if defined(__AVX2__)
            typedef long long l2 __attribute__((vector_size(16), aligned(8)));
            const l2 both = *(const l2*)rows;
            const c32 wide = (c32)__builtin_shufflevector(both, both, 0, 1, 0, 1);
            const c32 pick_near = {%s};
            const c32 pick_far = {%s};
            const i8 a = (i8)__builtin_ia32_pshufb256(wide, pick_near), b = (i8)__builtin_ia32_pshufb256(wide, pick_far);
#else
            typedef unsigned char u8 __attribute__((vector_size(8)));
            const i8 a = __builtin_convertvector(*(const u8*)rows, i8) << 8;
            const i8 b = __builtin_convertvector(*(const u8*)(rows + 8), i8) << 8;
#endif
            near = (f8)(a | 0x3f800000);
            far = (f8)(b | 0x3f800000);
        }

        static inline f4 edge(f4 ax, f4 by, f4 ay, f4 bx) {
#pragma clang fp contract(off)
            return ax * by - ay * bx;  // exactly antisymmetric, so both sides of a shared edge agree
        }

        static inline unsigned bits(i4 mask) {
            return __builtin_bit_cast(unsigned char, __builtin_convertvector(mask, b4)) & 15u;
        }

        // Bits of the triangles hit with 0 < t < limit, their t and barycentrics of vertex 1 and 2.
        inline unsigned triangles(const float* block, float limit, f4& t, f4& u, f4& v) const {
#pragma clang fp contract(fast)
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
            const i4 inside = (low(low(wa, wb), wc) >= 0.0f) | (high(high(wa, wb), wc) <= 0.0f);
            if (!bits(inside)) return 0;
            const f4 inverse = 1.0f / (wa + wb + wc);  // infinite where edge-on: then t is infinite or NaN, no hit
            t = (wa * az + wb * bz + wc * cz) * inverse * inverse_z;
            u = wb * inverse;
            v = wc * inverse;
            return bits(inside & (t > 0.0f) & (t < limit));
        }
    };
    struct Query {
        const unsigned char* nodes;
        const float* blocks;
        decltype(bvh.face_masks.data) face_masks;
        decltype(bvh.masks.data) masks;
        decltype(bvh.indices.data) indices;
        decltype(bvh.uvs.data) uvs;
        decltype(bvh.textures.data) textures;
        decltype(bvh.texels.data) texels;

        __attribute__((noinline, cold, preserve_all)) bool transparent(int face, float u, float v) const {%s}
        inline bool passes(int face, float u, float v) const {
            return __builtin_expect(face & %d, 0) && transparent(face & ~%d, u, v);
        }
""" % (
    ", ".join(f"-1, {i}, -1, -1" for i in range(8)),
    ", ".join(f"-1, {8 + i}, -1, -1" for i in range(8)),
    TRANSPARENT,
    FACE_MASKED,
    FACE_MASKED,
)

QUERY = """{
        (const unsigned char*)bvh.nodes.data, bvh.blocks.data, bvh.face_masks.data, bvh.masks.data,
        bvh.indices.data, bvh.uvs.data, bvh.textures.data, bvh.texels.data
    }"""

OCCLUDED = """
#if defined(__CUDA_ARCH__)
    return 0;
#else
    %s
        __attribute__((noinline)) int run(float ox, float oy, float oz, float dx, float dy, float dz, float t_max) const {
            Ray ray;
            if (!ray.setup((f4) {ox, oy, oz, 0.0f}, (f4) {dx, dy, dz, 1.0f})) return 0;
            const float limit = t_max / ray.scale;
            int stack[%d];
            int size = 0, child = 0;
            while (true) {
                if (child >= 0) {
                    const unsigned char* node = nodes + 128ll * child;
                    f8 entry;
                    unsigned hits = ray.boxes(node, limit, entry);
                    if (hits) {
                        const int* children = (const int*)(node + 96);
                        child = children[__builtin_ctz(hits)];  // the most promising, see bvh_build.py
                        hits &= hits - 1;
                        while (hits) {
                            const int last = 31 - __builtin_clz(hits);
                            stack[size++] = children[last];
                            hits ^= 1u << last;
                        }
                        continue;
                    }
                } else {
                    const float* block = blocks + 40ll * ~child;
                    f4 t, u, v;
                    unsigned hits = ray.triangles(block, limit, t, u, v);
                    while (hits) {
                        const int lane = __builtin_ctz(hits);
                        if (!passes(((const int*)block)[36 + lane], u[lane], v[lane])) return 1;
                        hits &= hits - 1;
                    }
                }
                if (!size) return 0;
                child = stack[--size];
            }
        }
    };
    const Query query = %s;
    return query.run(origin[0], origin[1], origin[2], direction[0], direction[1], direction[2], t_max);
#endif
    ;
""" % (TRAVERSAL, STACK_SIZE, QUERY)

# The stack holds what is left to visit, each node's children from far to near.
INTERSECT = """
#if defined(__CUDA_ARCH__)
    return wp::vec4();
#else
    %s
        __attribute__((noinline)) wp::vec4 run(float ox, float oy, float oz, float dx, float dy, float dz, float t_max) const {
            Ray ray;
            wp::vec4 hit(t_max, 0.0f, 0.0f, __builtin_bit_cast(float, -1));
            if (!ray.setup((f4) {ox, oy, oz, 0.0f}, (f4) {dx, dy, dz, 1.0f})) return hit;
            float limit = t_max / ray.scale;
            Entry stack[%d];
            int size = 0, child = 0;
            while (true) {
                if (child >= 0) {
                    const unsigned char* node = nodes + 128ll * child;
                    alignas(32) f8 entry;
                    unsigned hits = ray.boxes(node, limit, entry);
                    const unsigned* children = (const unsigned*)(node + 96);
                    const unsigned* keys = (const unsigned*)&entry;  // not negative: ordered like their bits
                    if (hits) {
                        int i = __builtin_ctz(hits);
                        hits &= hits - 1;
                        if (!hits) { child = (int)children[i]; continue; }
                        const Entry a = (Entry)keys[i] << 32 | children[i];
                        i = __builtin_ctz(hits);
                        hits &= hits - 1;
                        const Entry b = (Entry)keys[i] << 32 | children[i];
                        const int first = size;
                        stack[size++] = a < b ? b : a;
                        Entry nearest = a < b ? a : b;
                        while (hits) {
                            i = __builtin_ctz(hits);
                            hits &= hits - 1;
                            Entry item = (Entry)keys[i] << 32 | children[i];
                            if (item < nearest) { const Entry other = nearest; nearest = item; item = other; }
                            int at = size++;
                            while (at > first && stack[at - 1] < item) { stack[at] = stack[at - 1]; --at; }
                            stack[at] = item;
                        }
                        child = (int)(unsigned)nearest;
                        continue;
                    }
                } else {
                    const float* block = blocks + 40ll * ~child;
                    f4 t, u, v;
                    unsigned hits = ray.triangles(block, limit, t, u, v);
                    while (hits) {
                        const int lane = __builtin_ctz(hits);
                        hits &= hits - 1;
                        const int face = ((const int*)block)[36 + lane];
                        if (t[lane] >= limit || passes(face, u[lane], v[lane])) continue;
                        limit = t[lane];
                        hit = wp::vec4(limit * ray.scale, u[lane], v[lane], __builtin_bit_cast(float, face & ~%d));
                    }
                }
                Entry top;
                do {
                    if (!size) return hit;
                    top = stack[--size];
                } while (__builtin_bit_cast(float, (unsigned)(top >> 32)) > limit * 1.000001f);
                child = (int)(unsigned)top;
            }
        }
    };
    const Query query = %s;
    return query.run(origin[0], origin[1], origin[2], direction[0], direction[1], direction[2], t_max);
#endif
    ;
""" % (TRAVERSAL, STACK_SIZE, FACE_MASKED, QUERY)


@wp.func_native("#if defined(__CUDA_ARCH__)\n    return 1;\n#else\n    return 0;\n#endif\n;")
def runs_on_cuda() -> wp.int32: ...


@wp.func_native(
    """
    const auto* face_masks = bvh.face_masks.data;
    const auto* masks = bvh.masks.data;
    const auto* indices = bvh.indices.data;
    const auto* uvs = bvh.uvs.data;
    const auto* textures = bvh.textures.data;
    const auto* texels = bvh.texels.data;
    """
    + TRANSPARENT
)
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
