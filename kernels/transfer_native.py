"""Native code of the bake of transfer: sums of spherical harmonics over rays, and means of rows of halves over hits.

On the CPU it works on eight numbers at a time in clang's portable vector types, and on halves where the processor
converts them; CUDA, and other processors, run the same formulas one number at a time.
"""

import warp as wp

from warp_gi.kernels.transfer_snippets import COSINE, HARMONICS, HAS_VECTOR_HALVES, MOST_NUMBERS

wp.set_module_options({"enable_backward": False})

ROW_NUMBERS = 80  # a row of bounces: three channels of 25 numbers, and five zeros
BLOCK_RAYS = wp.constant(64)  # rays whose visibility one word holds
Numbers = wp.types.vector(length=MOST_NUMBERS, dtype=wp.float32)


# Sums of the harmonics over those of `count` (at most 64) directions from `start` on whose bits are set in `chosen`.
# directions [axis, item] are local, and have eight items more than anyone asks for; `frame` is world_from_local.
@wp.func_native(
    snippet="wp::vec_t<36, float> result;\n"
    + HARMONICS
    + """
#if defined(__CUDA_ARCH__)
    const int stride = directions.strides[0] / (int)sizeof(float);
    for (int i = 0; i < count; ++i) {
        if (!((chosen >> i) & 1ull)) continue;
        const float* at = directions.data + start + i;
        const wp::vec3 d = wp::mul(frame, wp::vec3(at[0], at[stride], at[2 * stride]));
        harmonics(d[0], d[1], d[2], order, [&](int k, float value) { result[k] += value; });
    }
#else
    typedef float f8 __attribute__((vector_size(32)));
    typedef int i8 __attribute__((vector_size(32)));
    const int stride = directions.strides[0] / (int)sizeof(float);
    const i8 lanes = {1, 2, 4, 8, 16, 32, 64, 128};
    f8 sums[36] = {};
    for (int i = 0; i < count; i += 8) {
        int bits = (int)(chosen >> i) & 255;
        if (count - i < 8) bits &= (1 << (count - i)) - 1;
        if (!bits) continue;
        const f8 weight = (((bits - (i8) {}) & lanes) != 0) ? 1.0f - (f8) {} : (f8) {};
        f8 local[3], d[3];
        for (int axis = 0; axis < 3; ++axis)
            __builtin_memcpy(&local[axis], directions.data + axis * stride + start + i, sizeof(f8));
        for (int axis = 0; axis < 3; ++axis)
            d[axis] = frame.data[axis][0] * local[0] + frame.data[axis][1] * local[1] + frame.data[axis][2] * local[2];
        harmonics(d[0], d[1], d[2], order, [&](int k, f8 value) {
            #pragma clang fp contract(fast)
            sums[k] += weight * value;
        });
    }
    for (int k = 0; k < (order > 5 ? 36 : 25); ++k)
        result[k] = ((sums[k][0] + sums[k][4]) + (sums[k][1] + sums[k][5]))
            + ((sums[k][2] + sums[k][6]) + (sums[k][3] + sums[k][7]));
#endif
    return result;
"""
)
def harmonic_sums(
    directions: wp.array2d(dtype=wp.float32),
    start: wp.int32,
    count: wp.int32,
    chosen: wp.uint64,
    frame: wp.mat33,
    order: wp.int32,
) -> Numbers: ...


# The harmonics at one direction.
@wp.func_native(
    snippet=HARMONICS
    + """
    wp::vec_t<36, float> result;
    harmonics(d[0], d[1], d[2], order, [&](int k, float value) { result[k] = value; });
    return result;
"""
)
def harmonics_at(d: wp.vec3, order: wp.int32) -> Numbers: ...


# Transfer where nothing is in the way: A_l y(n).
@wp.func_native(
    snippet=HARMONICS
    + COSINE
    + """
    wp::vec_t<36, float> result;
    harmonics(n[0], n[1], n[2], order, [&](int k, float value) { result[k] = value; });
    for (int l = 0, k = 0; l < order; ++l) for (int m = 0; m < 2 * l + 1; ++m, ++k) result[k] *= cosine[l];
    return result;
"""
)
def open_transfer(n: wp.vec3, order: wp.int32) -> Numbers: ...


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    return __popcll(word);
#else
    return __builtin_popcountll(word);
#endif
"""
)
def bit_count(word: wp.uint64) -> wp.int32: ...


# Gathers at a slot what its hits reflect, the mean of rows [slot, 80] over hits [slot, ray], with nothing from those
# below 0. Writes it to bounces [slot, 75], and what the slot reflects of it and of direct light itself to next.
# Returns the means of the first number of each channel.
@wp.func_native(
    snippet=f"""
    float mean[80] = {{}};
    const int* hit = hits.data + (long long)slot * hits.shape[1];
    const float scale = count ? 1.0f / (float)count : 0.0f;
#if {HAS_VECTOR_HALVES}
    typedef float f8 __attribute__((vector_size(32)));
    typedef _Float16 h8 __attribute__((vector_size(16)));
    f8 sums[10] = {{}};
    const int ahead = 8;
    for (int i = 0; i < count; ++i) {{
        if (i + ahead < count && hit[i + ahead] >= 0) {{
            const char* later = (const char*)(rows.data + (long long)hit[i + ahead] * 80);
            for (int line = 0; line < 3; ++line) __builtin_prefetch(later + 64 * line);
        }}
        if (hit[i] < 0) continue;
        h8 row[10];
        __builtin_memcpy(row, rows.data + (long long)hit[i] * 80, sizeof(row));
        for (int k = 0; k < 10; ++k) sums[k] += __builtin_convertvector(row[k], f8);
    }}
    for (int k = 0; k < 10; ++k) {{
        const f8 value = sums[k] * scale;
        __builtin_memcpy(mean + 8 * k, &value, sizeof(f8));
    }}
#else
    for (int i = 0; i < count; ++i) {{
        if (hit[i] < 0) continue;
        const auto* row = rows.data + (long long)hit[i] * 80;
        for (int k = 0; k < 75; ++k) mean[k] += (float)row[k];
    }}
    for (int k = 0; k < 75; ++k) mean[k] *= scale;
#endif
    float reflected[80] = {{}};
    const auto* direct = transfer.data + (long long)slot * transfer.shape[1];
    for (int k = 0; k < 75; ++k) reflected[k] = albedo[k / 25] * ((float)direct[k % 25] + mean[k]);
    auto* kept = bounces.data + (long long)slot * 75;
    auto* target = next.data + (long long)slot * 80;
#if {HAS_VECTOR_HALVES}
    h8 halves[10];
    for (int k = 0; k < 10; ++k) {{
        f8 value;
        __builtin_memcpy(&value, reflected + 8 * k, sizeof(f8));
        halves[k] = __builtin_convertvector(value, h8);
    }}
    __builtin_memcpy(target, halves, sizeof(halves));
    for (int k = 0; k < 10; ++k) {{
        f8 value;
        __builtin_memcpy(&value, mean + 8 * k, sizeof(f8));
        halves[k] = __builtin_convertvector(value, h8);
    }}
    __builtin_memcpy(kept, halves, 75 * sizeof(_Float16));
#else
    for (int k = 0; k < 80; ++k) target[k] = wp::half(reflected[k]);
    for (int k = 0; k < 75; ++k) kept[k] = wp::half(mean[k]);
#endif
    return wp::vec3(mean[0], mean[25], mean[50]);
"""
)
def gather_row(
    slot: wp.int32,
    hits: wp.array2d(dtype=wp.int32),
    count: wp.int32,
    rows: wp.array2d(dtype=wp.float16),
    transfer: wp.array2d(dtype=wp.float16),
    albedo: wp.vec3,
    bounces: wp.array2d(dtype=wp.float16),
    next: wp.array2d(dtype=wp.float16),
) -> wp.vec3: ...
