"""Native code that the CPU's ray queries (bvh_queries_native.py) share: ray set-up, box test, triangle test, packing.

What the CPU has is known when the code is compiled, on the machine that runs it: with AVX2 (and AVX-512's compression)
rays are set up by tables, children pushed and sorted as vectors; elsewhere, and on CPUs of AMD, it is done one by one.
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
