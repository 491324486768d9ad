"""Native code of the bake of transfer: sums of spherical harmonics over rays, and means of rows of halves over hits.

On the CPU it works on eight numbers at a time in clang's portable vector types, and on halves where the processor
converts them; CUDA, and other processors, run the same formulas one number at a time.
"""

import math

import warp as wp

wp.set_module_options({"enable_backward": False})

MOST_NUMBERS = 36  # order 6
LIGHT_NUMBERS = wp.constant(25)
ROW_NUMBERS = 80  # a row of bounces: three channels of 25 numbers, and five zeros
BLOCK_RAYS = wp.constant(64)  # rays whose visibility one word holds
Numbers = wp.types.vector(length=MOST_NUMBERS, dtype=wp.float32)


def _factor(degree: int, power: int) -> float:
    ratio = math.factorial(degree - power) / math.factorial(degree + power)
    return math.sqrt((2 * degree + 1) / (4 * math.pi) * ratio * (1 if power == 0 else 2))


# d^m P_l / dz^m of the Legendre polynomials, by degree l and order m: harmonics divided by their factor and by
# Re or Im (x + i y)^m.
_POLYNOMIALS = {
    (0, 0): "one",
    (1, 0): "z",
    (1, 1): "one",
    (2, 0): "0.5f * (3.0f * z2 - 1.0f)",
    (2, 1): "3.0f * z",
    (2, 2): "3.0f * one",
    (3, 0): "0.5f * z * (5.0f * z2 - 3.0f)",
    (3, 1): "1.5f * (5.0f * z2 - 1.0f)",
    (3, 2): "15.0f * z",
    (3, 3): "15.0f * one",
    (4, 0): "0.125f * ((35.0f * z2 - 30.0f) * z2 + 3.0f)",
    (4, 1): "2.5f * z * (7.0f * z2 - 3.0f)",
    (4, 2): "7.5f * (7.0f * z2 - 1.0f)",
    (4, 3): "105.0f * z",
    (4, 4): "105.0f * one",
    (5, 0): "0.125f * z * ((63.0f * z2 - 70.0f) * z2 + 15.0f)",
    (5, 1): "1.875f * ((21.0f * z2 - 14.0f) * z2 + 1.0f)",
    (5, 2): "52.5f * z * (3.0f * z2 - 1.0f)",
    (5, 3): "52.5f * (9.0f * z2 - 1.0f)",
    (5, 4): "945.0f * z",
    (5, 5): "945.0f * one",
}


def _degree(degree: int) -> str:
    lines = []
    for power in range(degree + 1):
        center = degree * degree + degree
        name = f"p{degree}{power}"
        lines.append(f"const auto {name} = {_factor(degree, power)!r}f * ({_POLYNOMIALS[degree, power]});")
        if power == 0:
            lines.append(f"add({center}, {name});")
        else:
            lines.append(f"add({center + power}, {name} * c{power});")
            lines.append(f"add({center - power}, {name} * s{power});")
    return "\n        ".join(lines)


# Hands each real spherical harmonic at a unit direction to `add(index, value)`: 25 of them, or 36 where order > 5.
# Index l^2 + l + m, orthonormal, without the Condon-Shortley sign, polar axis z, as kernels/harmonics.py.
_HARMONICS = """
    auto harmonics = [](auto x, auto y, auto z, int order, auto add) {
        #pragma clang fp contract(fast)
        const auto one = z * 0.0f + 1.0f, z2 = z * z;
        const auto c1 = x, s1 = y;
        const auto c2 = x * c1 - y * s1, s2 = x * s1 + y * c1;
        const auto c3 = x * c2 - y * s2, s3 = x * s2 + y * c2;
        const auto c4 = x * c3 - y * s3, s4 = x * s3 + y * c3;
        LOW
        if (order <= 5) return;
        const auto c5 = x * c4 - y * s4, s5 = x * s4 + y * c4;
        HIGH
    };
"""
_HARMONICS = _HARMONICS.replace("LOW", "\n        ".join(_degree(degree) for degree in range(5)))
_HARMONICS = _HARMONICS.replace("HIGH", _degree(5))
_PRAGMA = "#pragma clang fp contract(fast)"
_PORTABLE_HARMONICS = _HARMONICS.replace(_PRAGMA, "")


# Sums of the harmonics over those of `count` (at most 64) directions from `start` on whose bits are set in `chosen`.
# directions [axis, item] are local, and have eight items more than anyone asks for; `frame` is world_from_local.
@wp.func_native(
    snippet="wp::vec_t<36, float> result;\n#if defined(__CUDA_ARCH__)\n"
    + _PORTABLE_HARMONICS
    + """
    const int stride = directions.strides[0] / (int)sizeof(float);
    for (int i = 0; i < count; ++i) {
        if (!((chosen >> i) & 1ull)) continue;
        const float* at = directions.data + start + i;
        const wp::vec3 d = wp::mul(frame, wp::vec3(at[0], at[stride], at[2 * stride]));
        harmonics(d[0], d[1], d[2], order, [&](int k, float value) { result[k] += value; });
    }
#else
"""
    + _HARMONICS
    + """
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
    snippet=_PORTABLE_HARMONICS
    + """
    wp::vec_t<36, float> result;
    harmonics(d[0], d[1], d[2], order, [&](int k, float value) { result[k] = value; });
    return result;
"""
)
def harmonics_at(d: wp.vec3, order: wp.int32) -> Numbers: ...


# Transfer where nothing is in the way: A_l y(n), A = pi, 2 pi/3, pi/4, 0, -pi/24, 0.
@wp.func
def open_transfer(n: wp.vec3, order: wp.int32) -> Numbers:
    y = harmonics_at(n, order)
    y[0] = y[0] * wp.pi
    for k in range(1, 4):
        y[k] = y[k] * (2.0 * wp.pi / 3.0)
    for k in range(4, 9):
        y[k] = y[k] * (wp.pi / 4.0)
    for k in range(9, 16):
        y[k] = 0.0
    for k in range(16, 25):
        y[k] = y[k] * (-wp.pi / 24.0)
    for k in range(25, 36):
        y[k] = 0.0
    return y


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


_VECTOR_HALVES = "!defined(__CUDA_ARCH__) && (defined(__F16C__) || defined(__aarch64__))"


# Gathers at a slot what its hits reflect, the mean of rows [slot, 80] over hits [slot, ray], with nothing from those
# below 0. Writes it to bounces [slot, 75], and what the slot reflects of it and of direct light itself to next.
# Returns the means of the first number of each channel.
@wp.func_native(
    snippet=f"""
    float mean[80] = {{}};
    const int* hit = hits.data + (long long)slot * hits.shape[1];
    const float scale = count ? 1.0f / (float)count : 0.0f;
#if {_VECTOR_HALVES}
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
#if {_VECTOR_HALVES}
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
