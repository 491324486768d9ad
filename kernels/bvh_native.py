"""Native code of the CPU's ray queries (bvh.py): the alpha test, the traversals of the eight-wide tree.

Node, 56 words: six rows of eight floats, the low x, y, z and high x, y, z of its children's boxes; eight children.
Block, 80 words: nine rows of eight floats, the x, y, z of vertices 0, 1, 2 of its triangles; eight face words. A child
is where a node starts or the complement of where a block starts, in steps of 32 bytes. Block 0 is empty and stands
for no child. The triangle test is Woop, Benthin, Wald: "Watertight Ray/Triangle Intersection" (JCGT 2013), so no ray
slips through an edge or vertex that triangles share.
"""

STEP_WORDS = 8  # 32 bytes
NODE_STEPS = 7
BLOCK_STEPS = 10
NODE_WORDS = NODE_STEPS * STEP_WORDS
BLOCK_WORDS = BLOCK_STEPS * STEP_WORDS
LANES = 8  # triangles in a block
FACE_WORD = 9 * LANES  # of a block, the first
FACE_MASKED = 1 << 30  # flag in a face word; -1 marks an empty lane
STACK_SIZE = 512  # 7 for each level of a tree that is at most 70 deep
LAYOUT = {
    "NODE_STEPS": NODE_STEPS,
    "BLOCK_STEPS": BLOCK_STEPS,
    "NODE_WORDS": NODE_WORDS,
    "BLOCK_WORDS": BLOCK_WORDS,
    "LANES": LANES,
    "FACE_WORD": FACE_WORD,
    "FACE_MASKED": FACE_MASKED,
    "STACK_SIZE": STACK_SIZE,
}


def cpu_only(snippet: str, otherwise: str = "", **constants: float) -> str:
    """Return the snippet with named constants filled in; CUDA, without clang's vector types, sees ``otherwise``."""
    constants = {**LAYOUT, **constants}
    for name, value in constants.items():
        snippet = snippet.replace(name, repr(value) + ("f" if isinstance(value, float) else ""))
    return f"#if !defined(__CUDA_ARCH__)\n{snippet}\n#else\n{otherwise}\n#endif\n;"


# The coverage of `face` at barycentrics u, v: its alpha, or 0 or 1 where its mask has a cutoff. Needs the arrays of Bvh
# in scope.
ALPHA = """
    const auto& mask = masks[face_masks[face]];
    const wp::vec3i corner = indices[face];
    const auto texture_alpha = [&](int index) -> float {
        const auto& texture = textures[index];
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
            if (texture.nearest) at = wp::floor(at + 0.5f);
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
        return sum * (1.0f / 255.0f);
    };
    float alpha = mask.factor;
    if (alphas) alpha *= (1.0f - u - v) * alphas[corner[0]] + u * alphas[corner[1]] + v * alphas[corner[2]];
    if (mask.texture >= 0) alpha *= texture_alpha(mask.texture);
    if (mask.cutoff >= 0.0f) alpha = alpha < mask.cutoff ? 0.0f : 1.0f;
"""

# What goes straight through glass in the direction `way`, of the light that meets its surface: what its one interface
# does not reflect (Schlick's Fresnel term on the triangle's plane), times its transmission and the luminance of its
# tint, as in KHR_materials_transmission; and `entering`, the same without Fresnel's term. Follows ALPHA.
THROUGH = """
    float through = mask.through, entering = 0.0f;
    if (through > 0.0f) {
        if (mask.through_texture >= 0) through *= texture_alpha(mask.through_texture);
        entering = through;
        const wp::vec3 p0 = points[corner[0]], p1 = points[corner[1]], p2 = points[corner[2]];
        const float ax = p1[0] - p0[0], ay = p1[1] - p0[1], az = p1[2] - p0[2];
        const float bx = p2[0] - p0[0], by = p2[1] - p0[1], bz = p2[2] - p0[2];
        const float nx = ay * bz - az * by, ny = az * bx - ax * bz, nz = ax * by - ay * bx;
        const float facing = nx * way[0] + ny * way[1] + nz * way[2];
        const float length = (nx * nx + ny * ny + nz * nz) * (way[0] * way[0] + way[1] * way[1] + way[2] * way[2]);
        const float cosine = wp::min(wp::abs(facing) / wp::sqrt(wp::max(length, 1e-37f)), 1.0f);
        const float m = 1.0f - cosine, m2 = m * m, s = m2 * m2 * m;
        through *= 1.0f - wp::min(mask.f0 + (mask.f90 - mask.f0) * s, 1.0f);
    }
"""

# Whether the ray passes through `face`: by chance, unless its coverage is 0, or is 1 and it is no glass. Chance is a
# hash of the ray's own bits, of the triangle and of Bvh.salt. So queries for closest and for any hit agree, triangles
# along a ray are independent, and no ray needs a state. Needs ALPHA's arrays in scope, the ray's `start` and `way`, and
# of Bvh `points`, `salt` and `chance`.
TRANSPARENT = (
    ALPHA
    + """
    if (chance == 2) return alpha < 1e-4f;
    if (chance == 3) return alpha < 1.0f || mask.through > 0.0f;
    if (alpha <= 0.0f) return true;
    float stops = alpha;
    if (mask.through > 0.0f) {
"""
    + THROUGH
    + """
        stops *= 1.0f - through;
    }
    if (stops >= 1.0f) return false;
    union { float number; unsigned bits; } words[6];
    for (int axis = 0; axis < 3; ++axis) {
        words[axis].number = start[axis];
        words[3 + axis].number = way[axis];
    }
    unsigned long long hash = (unsigned long long)salt << 32 | (unsigned)face;
    for (int pair = 0; pair < 3; ++pair) {
        hash ^= hash >> 29;
        hash = hash * 0xBF58476D1CE4E5B9ull + ((unsigned long long)words[pair].bits << 32 | words[3 + pair].bits);
    }
    hash = (hash ^ hash >> 30) * 0xBF58476D1CE4E5B9ull;  // splitmix64
    hash = (hash ^ hash >> 27) * 0x94D049BB133111EBull;
    return (float)(unsigned)(hash >> 40) * 0x1p-24f >= stops;
"""
)

# Ray set-up, box test and triangle test, then the start of the query's struct. Rounding: boxes are enlarged when
# they are filled in, the ray's far side moves out and its near side in by a bound on the error of
# slope * plane + offset, so a box never loses a ray that its triangles would keep. Vectors of 256 bits: on the
# machine this was tuned on 512-bit ones ran at half the speed, and boxes of 8-bit integers lost a tenth to a fifth.
TRAVERSAL = (
    """
    typedef float f4 __attribute__((vector_size(16)));
    typedef float f8 __attribute__((vector_size(32)));
    typedef int i8 __attribute__((vector_size(32)));
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
        float start[3], way[3];

        __attribute__((noinline, cold)) bool transparent(int face, float u, float v) const {%s}
        inline bool passes(int face, float u, float v) const {
            return __builtin_expect(face & FACE_MASKED, 0) && transparent(face & ~FACE_MASKED, u, v);
        }
        inline void prefetch(int child) const {
            const char* at = child >= 0 ? node_at(child) : (const char*)block_at(child);
            for (int line = 0; line < 3; ++line) __builtin_prefetch(at + 64 * line);
        }
        inline const char* node_at(int child) const { return nodes + ((long long)child << 5); }
        inline const float* block_at(int child) const { return (const float*)(blocks + ((long long)~child << 5)); }
"""
    % TRANSPARENT
)

QUERY = """
    const Query query = {
        (const char*)bvh.nodes.data, (const char*)bvh.blocks.data, bvh.face_masks.data, bvh.masks.data,
        bvh.indices.data, bvh.uvs.data, bvh.alphas.data, bvh.textures.data, bvh.texels.data,
        bvh.points.data, bvh.salt, bvh.chance,
        {origin[0], origin[1], origin[2]}, {direction[0], direction[1], direction[2]}
    };
    return query.run(origin[0], origin[1], origin[2], direction[0], direction[1], direction[2], t_max%s);
"""

# Returns the child (a block) that is in the ray's way, or 0. What lies below the node `hint` is tried first.
OCCLUDED = (
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
    + QUERY % ", hint"
)

# The triangle test's t is the less exact the more edge-on a triangle is: it is found anew, in double precision, and so
# are u, v. What rounding would put out of its range stays in. The stack holds what is left to visit, each
# node's children from far to near.
INTERSECT = (
    TRAVERSAL
    + """
        inline wp::vec4 exact(const float* at, float t_max, wp::vec4 hit) const {
            double a[3], b[3], c[3], d[3];  // edges, from the origin to vertex 0, direction
            for (int k = 0; k < 3; ++k) {
                const double p0 = at[LANES * k];
                a[k] = at[LANES * (3 + k)] - p0;
                b[k] = at[LANES * (6 + k)] - p0;
                c[k] = p0 - start[k];
                d[k] = way[k];
            }
            const double n[3] = {a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]};
            const double r[3] = {c[1] * d[2] - c[2] * d[1], c[2] * d[0] - c[0] * d[2], c[0] * d[1] - c[1] * d[0]};
            const double inverse = 1.0 / (n[0] * d[0] + n[1] * d[1] + n[2] * d[2]);
            const float t = (float)((n[0] * c[0] + n[1] * c[1] + n[2] * c[2]) * inverse);
            const float u = (float)((r[0] * b[0] + r[1] * b[1] + r[2] * b[2]) * inverse);
            const float v = (float)((r[0] * a[0] + r[1] * a[1] + r[2] * a[2]) * -inverse);
            if (t > 0.0f && t < t_max) hit[0] = t;
            if (u > -1e-3f && v > -1e-3f && u + v < 1.001f) {
                hit[1] = u < 0.0f ? 0.0f : (u > 1.0f ? 1.0f : u);
                hit[2] = v < 0.0f ? 0.0f : (v > 1.0f - hit[1] ? 1.0f - hit[1] : v);
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
            Entry stack[STACK_SIZE];
            int size = 0, child = 0;
            while (true) {
                if (child >= 0) {
                    const char* node = node_at(child);
                    alignas(32) f8 entry;
                    unsigned hits = ray.boxes(node, limit, entry);
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
                Entry top;
                do {
                    if (!size) return nearest_at ? exact(nearest_at, t_max, hit) : hit;
                    top = stack[--size];
                } while (__builtin_bit_cast(float, (unsigned)(top >> 32)) > limit * 1.000001f);
                child = (int)(unsigned)top;
            }
        }
    };
"""
    + QUERY % ""
)
