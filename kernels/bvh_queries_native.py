"""Native code of the CPU's ray queries (bvh.py): any hit and closest hit, of a ray and of a batch."""

from warp_gi.kernels.bvh_traversal_native import TRAVERSAL

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
ANY_METHODS = (
    TRAVERSAL
    + """
        // Of a ray that is set up: what lies below `child`, then below the root if asked for.
        inline __attribute__((always_inline)) int below(
            const Ray& ray, float limit, int child, bool and_root
        ) const {
            int stack[STACK_SIZE];
            int size = 0;
            if (and_root) stack[size++] = 0;
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
        __attribute__((noinline)) int run(
            float ox, float oy, float oz, float dx, float dy, float dz, float t_max, int hint
        ) const {
            Ray ray;
            if (!ray.setup((f4) {ox, oy, oz, 0.0f}, (f4) {dx, dy, dz, 1.0f})) return 0;
            return below(ray, t_max / ray.scale, hint, hint != 0);  // the root, should the hint be in nobody's way
        }
"""
)
ANY = ANY_METHODS + "    };\n"

# The triangle test's t is the less exact the more edge-on a triangle is: it is found anew, in double precision, and so
# are u, v. What rounding would put out of its range stays in. The stack holds what is left to visit, each
# node's children from far to near.
CLOSEST_METHODS = (
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
        // Of a ray that is set up: the closest hit below `child`, if nearer than the limit, which it becomes.
        inline __attribute__((always_inline)) void below(
            const Ray& ray, float& limit, int child, const float*& nearest_at, wp::vec4& hit
        ) const {
#if VECTORS_PAY
            int stack[STACK_SIZE], distances[STACK_SIZE];  // children, and the bits of their entry distances
#else
            Entry stack[STACK_SIZE];
#endif
            int size = 0;
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
                    if (!size) return;
                } while (__builtin_bit_cast(float, distances[--size]) > limit * 1.000001f);
                child = stack[size];
#else
                Entry top;
                do {
                    if (!size) return;
                    top = stack[--size];
                } while (__builtin_bit_cast(float, (unsigned)(top >> 32)) > limit * 1.000001f);
                child = (int)(unsigned)top;
#endif
            }
        }
        __attribute__((noinline)) wp::vec4 run(
            float ox, float oy, float oz, float dx, float dy, float dz, float t_max
        ) const {
            Ray ray;
            wp::vec4 hit(t_max, 0.0f, 0.0f, __builtin_bit_cast(float, -1));
            if (!ray.setup((f4) {ox, oy, oz, 0.0f}, (f4) {dx, dy, dz, 1.0f})) return hit;
            float limit = t_max / ray.scale;
            const float* nearest_at = nullptr;  // the vertices of the triangle hit, one number in LANES
            below(ray, limit, 0, nearest_at, hit);
            return nearest_at ? exact(nearest_at, t_max, hit) : hit;
        }
"""
    % SORT
)
CLOSEST = CLOSEST_METHODS + "    };\n"

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
