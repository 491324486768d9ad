"""Native code of the CPU's traversals of the eight-wide tree (bvh_native.py): any hit and closest hit.

What the CPU has is known when the code is compiled, on the machine that runs it: with AVX2 (and AVX-512's compression)
rays are set up by tables, children pushed and sorted as vectors; elsewhere the same is done one by one.
"""

from warp_gi.kernels.bvh_native import TRANSPARENT


def _table(rows: list[list[int]]) -> str:
    return ", ".join("{" + ", ".join(map(str, row)) + "}" for row in rows)


# By the signs of a direction, bits x, y, z: byte offsets in a node of the near rows and of the far ones.
ROW_TABLE = _table(
    [
        [
            32 * axis + (96 if (signs >> axis & 1) != far else 0) if axis < 3 else 0
            for far in (0, 1)
            for axis in range(4)
        ]
        for signs in range(8)
    ]
)


def _axes(larger: int) -> list[int]:
    x_y, x_z, y_z = (larger >> bit & 1 for bit in range(3))
    k = (0 if x_z else 2) if x_y else (1 if y_z else 2)
    return [(k + 1) % 3, (k + 2) % 3, k, 3]


# By which sizes are larger, bits x > y, x > z, y > z: the other axes, the dominant one, and the fourth lane.
AXIS_TABLE = _table([_axes(larger) for larger in range(8)])
# By a set of lanes: those lanes in order, a byte each.
CHOSEN_TABLE = ", ".join(
    hex(sum(lane << 8 * at for at, lane in enumerate(lane for lane in range(8) if chosen >> lane & 1))) + "ull"
    for chosen in range(256)
)

# AMD's are left out: there the vectors made rays 3 to 8 % slower (bench/NOTES.md).
_ZEN = " && ".join(f"!defined(__znver{generation}__)" for generation in range(1, 7))
VECTORS_PAY = f"""
#undef VECTORS_PAY
#if defined(__AVX2__) && {_ZEN}
#define VECTORS_PAY 1
#else
#define VECTORS_PAY 0
#endif
"""

# Ray set-up, box test and triangle test, then the start of the query's struct. Rounding: boxes are enlarged when
# they are filled in, the ray's far side moves out and its near side in by a bound on the error of
# slope * plane + offset, so a box never loses a ray that its triangles would keep. Vectors of 256 bits: on the
# machine this was tuned on 512-bit ones ran at half the speed, and boxes of 8-bit integers lost a tenth to a fifth.
TRAVERSAL = (
    VECTORS_PAY
    + """
    typedef float f4 __attribute__((vector_size(16)));
    typedef float f8 __attribute__((vector_size(32)));
    typedef double d4 __attribute__((vector_size(32)));
    typedef int i4 __attribute__((vector_size(16)));
    typedef int i8 __attribute__((vector_size(32)));
    typedef unsigned char byte8 __attribute__((vector_size(8)));
    typedef bool b8 __attribute__((ext_vector_type(8)));
    typedef unsigned long long Entry;  // entry distance in the high half, child in the low half

    struct Ray {
        f8 near_slope[3], near_offset[3], far_slope[3], far_offset[3];  // t = slope * plane + offset
        int near_row[3], far_row[3];  // byte offsets in a node
        int kx, ky, kz;  // float offsets in a block; kz is the dominant axis
        float shear_x, shear_y, origin_x, origin_y, origin_z, inverse_z;
        float scale;  // of the direction, 1 but for extreme lengths

        static inline f4 low(f4 a, f4 b) { return a < b ? a : b; }
        static inline f4 high(f4 a, f4 b) { return a > b ? a : b; }
        static inline f8 low(f8 a, f8 b) { return a < b ? a : b; }
        static inline f8 high(f8 a, f8 b) { return a > b ? a : b; }

#if VECTORS_PAY
        // Where rows of boxes are by the signs of the direction: bits x, y, z.
        static inline const int* rows(unsigned signs) {
            static const int table[8][8] = {ROW_TABLE};
            return table[signs];
        }

        // Lanes of a vector in the order of the shear: the dominant axis last; by x > y, x > z, y > z of its size.
        static inline const int* axes(unsigned larger) {
            static const int table[8][4] = {AXIS_TABLE};
            return table[larger];
        }

        inline bool setup(f4 start, f4 d) {
            f4 size = high(d, -d);
            const unsigned larger = (unsigned)__builtin_ia32_movmskps((f4)(
                __builtin_shufflevector(size, size, 0, 0, 1, 1) > __builtin_shufflevector(size, size, 1, 2, 2, 1)
            ));
            const float largest = wp::max(wp::max(size[0], size[1]), size[2]), sum = size[0] + size[1] + size[2];
            scale = 1.0f;
            if (__builtin_expect(!(largest >= 1e-6f && sum <= 1e6f), 0)) {
                if (!(largest > 1e-36f && sum <= 3e38f)) return false;
                scale = 1.0f / largest;
                d *= scale;
                size *= scale;
            }
            const f4 least = d < 0.0f ? -1e-20f - (f4) {} : 1e-20f - (f4) {};
            const f4 inverse = 1.0f / (size > 1e-20f ? d : least);
            const f4 offset = -start * inverse, error = high(offset, -offset) * 2e-7f;
            const f4 outwards = 1.000001f - (f4) {}, far = inverse * outwards;
            const f4 near_side = offset - error, far_side = (offset + error) * outwards;
            const int* row = rows((unsigned)__builtin_ia32_movmskps(inverse) & 7);
            for (int axis = 0; axis < 3; ++axis) {
                near_slope[axis] = inverse[axis] - (f8) {}, near_offset[axis] = near_side[axis] - (f8) {};
                far_slope[axis] = far[axis] - (f8) {}, far_offset[axis] = far_side[axis] - (f8) {};
                near_row[axis] = row[axis], far_row[axis] = row[4 + axis];
            }
            const int* axis = axes(larger & 7);
            const i4 lanes = *(const i4*)axis;
            const f4 origin = __builtin_ia32_vpermilvarps(start, lanes), way = __builtin_ia32_vpermilvarps(d, lanes);
            kx = 8 * axis[0], ky = 8 * axis[1], kz = 8 * axis[2];
            origin_x = origin[0], origin_y = origin[1], origin_z = origin[2];
            inverse_z = __builtin_ia32_vpermilvarps(inverse, lanes)[2];
            const f4 shear = way / __builtin_shufflevector(way, way, 2, 2, 2, 2);
            shear_x = shear[0], shear_y = shear[1];
            return true;
        }
#else
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
                near_row[axis] = 32 * axis + (d[axis] < 0.0f ? 96 : 0);
                far_row[axis] = 32 * axis + (d[axis] < 0.0f ? 0 : 96);
            }
            const int i = k == 2 ? 0 : k + 1, j = k == 0 ? 2 : k - 1;
            kx = 8 * i, ky = 8 * j, kz = 8 * k;
            origin_x = start[i], origin_y = start[j], origin_z = start[k];
            inverse_z = inverse[k];
            const f4 shear = d / d[k];
            shear_x = shear[i], shear_y = shear[j];
            return true;
        }
#endif

        // Bits of the children that the ray enters before the limit, and their entry distances.
        inline unsigned boxes(const char* node, float limit, f8& entry) const {
#pragma clang fp contract(fast)
            f8 near[3], far[3];
            for (int axis = 0; axis < 3; ++axis) {
                near[axis] = *(const f8*)(node + near_row[axis]) * near_slope[axis] + near_offset[axis];
                far[axis] = *(const f8*)(node + far_row[axis]) * far_slope[axis] + far_offset[axis];
            }
            entry = high(high(near[0], near[1]), high(near[2], (f8) {}));
            const f8 leave = low(low(far[0], far[1]), low(far[2], limit * 1.000001f - (f8) {}));
            return __builtin_bit_cast(unsigned char, __builtin_convertvector(entry <= leave, b8));
        }

        static inline f8 edge(f8 ax, f8 by, f8 ay, f8 bx) {
#pragma clang fp contract(off)
            return ax * by - ay * bx;  // exactly antisymmetric, so both sides of a shared edge agree
        }

        static inline unsigned bits(i8 mask) {
            return __builtin_bit_cast(unsigned char, __builtin_convertvector(mask, b8));
        }

        // Bits of the triangles hit with 0 < t < limit, their t and barycentrics of vertex 1 and 2.
        inline unsigned triangles(const float* block, float limit, f8& t, f8& u, f8& v) const {
#pragma clang fp contract(fast)
            const f8 az = *(const f8*)(block + kz) - origin_z;
            const f8 bz = *(const f8*)(block + 24 + kz) - origin_z;
            const f8 cz = *(const f8*)(block + 48 + kz) - origin_z;
            const f8 ax = (*(const f8*)(block + kx) - origin_x) - shear_x * az;
            const f8 ay = (*(const f8*)(block + ky) - origin_y) - shear_y * az;
            const f8 bx = (*(const f8*)(block + 24 + kx) - origin_x) - shear_x * bz;
            const f8 by = (*(const f8*)(block + 24 + ky) - origin_y) - shear_y * bz;
            const f8 cx = (*(const f8*)(block + 48 + kx) - origin_x) - shear_x * cz;
            const f8 cy = (*(const f8*)(block + 48 + ky) - origin_y) - shear_y * cz;
            const f8 wa = edge(cx, by, cy, bx), wb = edge(ax, cy, ay, cx), wc = edge(bx, ay, by, ax);
            const i8 inside = (low(low(wa, wb), wc) >= 0.0f) | (high(high(wa, wb), wc) <= 0.0f);
            if (!bits(inside)) return 0;
            const f8 inverse = 1.0f / (wa + wb + wc);  // infinite where edge-on: then t is infinite or NaN, no hit
            t = (wa * az + wb * bz + wc * cz) * inverse * inverse_z;
            u = wb * inverse;
            v = wc * inverse;
            return bits(inside & (t > 0.0f) & (t < limit));
        }
    };
    struct Query {
        const char *nodes, *blocks;
        decltype(bvh.face_masks.data) face_masks;
        decltype(bvh.masks.data) masks;
        decltype(bvh.indices.data) indices;
        decltype(bvh.uvs.data) uvs;
        decltype(bvh.alphas.data) alphas;
        decltype(bvh.textures.data) textures;
        decltype(bvh.texels.data) texels;
        decltype(bvh.points.data) points;
        unsigned salt;
        int chance;
        f4 start, way;

        __attribute__((noinline, cold)) bool transparent(int face, float u, float v) const {%s}
        inline bool passes(int face, float u, float v) const {
            return __builtin_expect(face & FACE_MASKED, 0) && transparent(face & ~FACE_MASKED, u, v);
        }
#if VECTORS_PAY
        struct __attribute__((packed)) Unaligned { i8 lanes; };
        // The chosen lanes first, in their order.
        static inline Unaligned packed(i8 lanes, unsigned chosen) {
#if defined(__AVX512VL__)
            return {(i8)__builtin_ia32_compresssi256_mask(lanes, lanes, (unsigned char)chosen)};
#else
            static const unsigned long long orders[256] = {CHOSEN_TABLE};  // lanes, a byte each
            const byte8 bytes = __builtin_bit_cast(byte8, orders[chosen]);
            return {(i8)__builtin_ia32_permvarsi256(lanes, __builtin_convertvector(bytes, i8))};
#endif
        }
#endif
        inline void prefetch(int child) const {
            const char* at = child >= 0 ? node_at(child) : (const char*)block_at(child);
            for (int line = 0; line < 3; ++line) __builtin_prefetch(at + 64 * line);
        }
        inline const char* node_at(int child) const { return nodes + ((long long)child << 5); }
        inline const float* block_at(int child) const { return (const float*)(blocks + ((long long)~child << 5)); }
"""
    % TRANSPARENT
)
for _name, _text in {"ROW_TABLE": ROW_TABLE, "AXIS_TABLE": AXIS_TABLE, "CHOSEN_TABLE": CHOSEN_TABLE}.items():
    TRAVERSAL = TRAVERSAL.replace(_name, _text)

# Layers of a sorting network for eight lanes, each a list of pairs.
NETWORK = (
    ((0, 2), (1, 3), (4, 6), (5, 7)),
    ((0, 4), (1, 5), (2, 6), (3, 7)),
    ((0, 1), (2, 3), (4, 5), (6, 7)),
    ((2, 4), (3, 5)),
    ((1, 4), (3, 6)),
    ((1, 2), (3, 4), (5, 6)),
)


def _layer(pairs: tuple[tuple[int, int], ...]) -> str:
    """Return code that puts the larger of each pair of lanes of `a` first."""
    partner = list(range(8))
    for i, j in pairs:
        partner[i], partner[j] = j, i
    firsts = {i for i, _ in pairs}
    order = ", ".join(str(i if i in firsts else 8 + i) for i in range(8))
    return f"""{{
            const i8 b = __builtin_shufflevector(a, a, {", ".join(map(str, partner))});
            const i8 low = a < b ? a : b, high = a < b ? b : a;
            a = __builtin_shufflevector(high, low, {order});
        }}"""


SORT = "\n".join(_layer(pairs) for pairs in NETWORK)

BVH = """
        (const char*)bvh.nodes.data, (const char*)bvh.blocks.data, bvh.face_masks.data, bvh.masks.data,
        bvh.indices.data, bvh.uvs.data, bvh.alphas.data, bvh.textures.data, bvh.texels.data,
        bvh.points.data, bvh.salt, bvh.chance,
"""

ONE_RAY = (
    "const Query query = {"
    + BVH
    + """
        {origin[0], origin[1], origin[2], 0.0f}, {direction[0], direction[1], direction[2], 0.0f}
    };
    return query.run(origin[0], origin[1], origin[2], direction[0], direction[1], direction[2], t_max%s);
"""
)

# Rays `begin` to `end` - 1 of a batch, in its order; asks for a later one's origin and direction ahead of time.
RAYS = (
    "Query query = {"
    + BVH
    + """
        {}, {}
    };
    const bool ordered = rays.order.shape[0] > 0;
    const int last_limit = (int)rays.t_max.shape[0] - 1;
    for (int item = begin; item < end; ++item) {
        const int i = ordered ? (int)rays.order.data[item] : item;
        if (ordered && item + 12 < rays.order.shape[0]) {
            const long long later = rays.order.data[item + 12];
            __builtin_prefetch(rays.origins.data + later);
            __builtin_prefetch(rays.directions.data + later);
        }
        const wp::vec3 o = rays.origins.data[i], d = rays.directions.data[i];
        const long long limit_at = (long long)(i < last_limit ? i : last_limit) * rays.t_max.strides[0];
        const float t_max = *(const float*)((const char*)rays.t_max.data + limit_at);
        query.start = (f4) {o[0], o[1], o[2], 0.0f}, query.way = (f4) {d[0], d[1], d[2], 0.0f};
        %s
    }
"""
)

# A query for any hit: the child (a block) that is in the ray's way, or 0. What lies below the node `hint` is tried
# first.
ANY = (
    TRAVERSAL
    + """
        __attribute__((noinline)) int run(
            float ox, float oy, float oz, float dx, float dy, float dz, float t_max, int hint
        ) const {
            Ray ray;
            if (!ray.setup((f4) {ox, oy, oz, 0.0f}, (f4) {dx, dy, dz, 1.0f})) return 0;
            const float limit = t_max / ray.scale;
            int stack[STACK_SIZE];
            int size = 0, child = hint;
            if (hint) stack[size++] = 0;  // the root, should nothing below the hint be in the way
            while (true) {
                if (child >= 0) {
                    const char* node = node_at(child);
                    f8 entry;
                    unsigned hits = ray.boxes(node, limit, entry);
                    if (hits) {
                        const int* children = (const int*)(node + 192);
                        const int last = 31 - __builtin_clz(hits);  // the most promising, see bvh_build.py
                        child = children[last];
                        hits ^= 1u << last;
#if VECTORS_PAY
                        *(Unaligned*)(stack + size) = packed(*(const i8*)children, hits);
                        size += __builtin_popcount(hits);
#else
                        for (; hits; hits &= hits - 1) stack[size++] = children[__builtin_ctz(hits)];
#endif
                        continue;
                    }
                } else {
                    const float* block = block_at(child);
                    f8 t, u, v;
                    unsigned hits = ray.triangles(block, limit, t, u, v);
                    if (hits) {
                        const int* faces = (const int*)block + FACE_WORD;
                        if (hits & ~Ray::bits((*(const i8*)faces & FACE_MASKED) != 0)) return child;
                        do {
                            const int lane = __builtin_ctz(hits);
                            if (!transparent(faces[lane] & ~FACE_MASKED, u[lane], v[lane])) return child;
                            hits &= hits - 1;
                        } while (hits);
                    }
                }
                if (!size) return 0;
                child = stack[--size];
            }
        }
    };
"""
)

# The triangle test's t is the less exact the more edge-on a triangle is: it is found anew, in double precision, and so
# are u, v. What rounding would put out of its range stays in. The stack holds what is left to visit, each
# node's children from far to near.
CLOSEST = (
    TRAVERSAL
    + """
#if VECTORS_PAY
        static inline int least(i8 keys) {
            i4 a = __builtin_shufflevector(keys, keys, 0, 1, 2, 3), b = __builtin_shufflevector(keys, keys, 4, 5, 6, 7);
            a = a < b ? a : b;
            b = __builtin_shufflevector(a, a, 2, 3, 0, 1);
            a = a < b ? a : b;
            b = __builtin_shufflevector(a, a, 1, 0, 3, 2);
            a = a < b ? a : b;
            return a[0];
        }

        // Sorts by the network of 19 comparators in six layers.
        static inline i8 descending(i8 a) {
        %s
            return a;
        }
#endif
        static inline d4 turned(d4 a) { return __builtin_shufflevector(a, a, 1, 2, 0, 3); }
        static inline d4 cross(d4 a, d4 b) { return turned(a * turned(b) - turned(a) * b); }
        static inline d4 vertex(const float* at) {
            return __builtin_convertvector(((f4) {at[0], at[LANES], at[2 * LANES], 0.0f}), d4);
        }
        inline wp::vec4 exact(const float* at, float t_max, wp::vec4 hit) const {
            const d4 p0 = vertex(at), a = vertex(at + 3 * LANES) - p0, b = vertex(at + 6 * LANES) - p0;
            const d4 c = p0 - __builtin_convertvector(start, d4), d = __builtin_convertvector(way, d4);
            const d4 n = cross(a, b), r = cross(c, d);
            const d4 nd = n * d, nc = n * c, rb = r * b, ra = r * a;  // sums of their lanes:
            const d4 e = __builtin_shufflevector(nd, nc, 0, 4, 2, 6) + __builtin_shufflevector(nd, nc, 1, 5, 3, 7);
            const d4 f = __builtin_shufflevector(rb, ra, 0, 4, 2, 6) + __builtin_shufflevector(rb, ra, 1, 5, 3, 7);
            const d4 all = __builtin_shufflevector(e, f, 0, 1, 4, 5) + __builtin_shufflevector(e, f, 2, 3, 6, 7);
            const f4 tuv = __builtin_convertvector(all / __builtin_shufflevector(all, all, 0, 0, 0, 0), f4);
            if (tuv[1] > 0.0f && tuv[1] < t_max) {  // else the test's own are kept
                const float u = wp::min(wp::max(tuv[2], 0.0f), 1.0f);
                hit[0] = tuv[1], hit[1] = u, hit[2] = wp::min(wp::max(-tuv[3], 0.0f), 1.0f - u);
            }
            hit[3] = __builtin_bit_cast(float, ((const int*)at)[FACE_WORD] & ~FACE_MASKED);
            return hit;
        }
        __attribute__((noinline)) wp::vec4 run(
            float ox, float oy, float oz, float dx, float dy, float dz, float t_max
        ) const {
            Ray ray;
            wp::vec4 hit(t_max, 0.0f, 0.0f, __builtin_bit_cast(float, -1));
            if (!ray.setup((f4) {ox, oy, oz, 0.0f}, (f4) {dx, dy, dz, 1.0f})) return hit;
            float limit = t_max / ray.scale;
            const float* nearest_at = nullptr;  // the vertices of the triangle hit, one number in LANES
#if VECTORS_PAY
            int stack[STACK_SIZE], distances[STACK_SIZE];  // children, and the bits of their entry distances
#else
            Entry stack[STACK_SIZE];
#endif
            int size = 0, child = 0;
            while (true) {
                if (child >= 0) {
                    const char* node = node_at(child);
                    alignas(32) f8 entry;
                    unsigned hits = ray.boxes(node, limit, entry);
#if VECTORS_PAY
                    if (hits) {
                        const int* children = (const int*)(node + 192);
                        if (!(hits & (hits - 1))) { child = children[__builtin_ctz(hits)]; continue; }
                        const i8 lanes = {0, 1, 2, 3, 4, 5, 6, 7}, none = {};
                        const i8 is_hit = ((int)hits & (i8) {1, 2, 4, 8, 16, 32, 64, 128}) != none;
                        const i8 keys = ((i8)entry & ~7) | lanes;  // not negative: ordered like their bits
                        child = children[least(is_hit ? keys : 0x7fffffff - none) & 7];
                        const i8 sorted = descending(is_hit ? keys : none - 1);  // the nearest is the last of the hits
                        *(Unaligned*)(distances + size) = {sorted & ~7};
                        *(Unaligned*)(stack + size) = {(i8)__builtin_ia32_permvarsi256(*(const i8*)children, sorted)};
                        size += __builtin_popcount(hits) - 1;
                        continue;
                    }
#else
                    const unsigned* children = (const unsigned*)(node + 192);
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
                        prefetch((int)(unsigned)stack[size - 1]);
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
#endif
                } else {
                    const float* block = block_at(child);
                    f8 t, u, v;
                    unsigned hits = ray.triangles(block, limit, t, u, v);
                    while (hits) {
                        const int lane = __builtin_ctz(hits);
                        hits &= hits - 1;
                        const int face = ((const int*)block)[FACE_WORD + lane];
                        if (t[lane] >= limit || passes(face, u[lane], v[lane])) continue;
                        limit = t[lane];
                        nearest_at = block + lane;
                        hit = wp::vec4(limit * ray.scale, u[lane], v[lane], 0.0f);
                    }
                }
#if VECTORS_PAY
                do {
                    if (!size) return nearest_at ? exact(nearest_at, t_max, hit) : hit;
                } while (__builtin_bit_cast(float, distances[--size]) > limit * 1.000001f);
                child = stack[size];
#else
                Entry top;
                do {
                    if (!size) return nearest_at ? exact(nearest_at, t_max, hit) : hit;
                    top = stack[--size];
                } while (__builtin_bit_cast(float, (unsigned)(top >> 32)) > limit * 1.000001f);
                child = (int)(unsigned)top;
#endif
            }
        }
    };
"""
    % SORT
)

OCCLUDED = ANY + ONE_RAY % ", hint"
INTERSECT = CLOSEST + ONE_RAY % ""
OCCLUDED_RAYS = ANY + RAYS % "occluded.data[i] = query.run(o[0], o[1], o[2], d[0], d[1], d[2], t_max, 0) != 0;"
INTERSECT_RAYS = (
    CLOSEST
    + RAYS
    % """const wp::vec4 hit = query.run(o[0], o[1], o[2], d[0], d[1], d[2], t_max);
        hits.t.data[i] = hit[0], hits.u.data[i] = hit[1], hits.v.data[i] = hit[2];
        hits.face.data[i] = __builtin_bit_cast(int, hit[3]);"""
)
