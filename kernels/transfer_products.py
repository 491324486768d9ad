"""Products of rows of transfer, eight numbers at a time on the CPU; on CUDA, whose threads are lanes already, a loop.

A row of transfer has 25 numbers padded to 32, or 36 padded to 40, as halves: 32 are one cache line. Rows are read,
blended and multiplied in registers. Loops in Warp itself, over vectors of 25, were 28 times slower.
"""

import math

import warp as wp

wp.set_module_options({"enable_backward": False})

ORDERS = (5, 6)
WIDTHS = {5: 32, 6: 40}  # numbers in a row, with padding
LIGHT_WIDTH = WIDTHS[5]  # of the sky's own numbers, and of what bounces: always order 5
LARGEST_ORDER = 6
vec6 = wp.types.vector(length=6, dtype=wp.float32)


def harmonics_code(order: int) -> str:
    """Return C++ that sets y[0 .. order^2) from a unit direction x, y_, z: real spherical harmonics of any order.

    Y_lm = K_lm P_l^|m|(z) times sqrt(2) Re or Im of (x + i y)^|m|, without the Condon-Shortley sign; index l l + l + m.
    The polynomials follow (l - m) P_l = (2 l - 1) z P_(l-1) - (l + m - 1) P_(l-2), with P_m^m = (2 m - 1)!!.
    """
    lines = ["float re = 1.0f, im = 0.0f, next = 0.0f;"]
    for m in range(order):
        last = f"p{m}_{m}"
        lines.append(f"const float {last} = {math.prod(range(1, 2 * m, 2))}.0f;")
        for l in range(m, order):
            name = f"p{l}_{m}"
            if l == m + 1:
                lines.append(f"const float {name} = {2 * m + 1}.0f * z * {last};")
            elif l > m + 1:
                lines.append(
                    f"const float {name} = ({2 * l - 1}.0f * z * p{l - 1}_{m} - {l + m - 1}.0f * p{l - 2}_{m}) "
                    f"* {1 / (l - m)!r}f;"
                )
            scale = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - m) / math.factorial(l + m))
            if m == 0:
                lines.append(f"y[{l * l + l}] = {scale!r}f * {name};")
            else:
                scale *= math.sqrt(2)
                lines.append(f"y[{l * l + l + m}] = {scale!r}f * {name} * re;")
                lines.append(f"y[{l * l + l - m}] = {scale!r}f * {name} * im;")
        lines.append("next = re * x - im * y_; im = re * y_ + im * x; re = next;")
    return "\n        ".join(lines)


# What every product starts with: vectors of eight, and how a blend of rows gets into registers. `four` and `five` are
# their number in a row. Without instructions for halves the compiler would call a library that is not there.
_VECTORS = """
#if !defined(__CUDA_ARCH__) && (defined(__F16C__) || defined(__aarch64__))
    typedef float Eight __attribute__((vector_size(32)));
    typedef _Float16 Halves __attribute__((vector_size(16)));
    struct Four { enum { N = 4 }; };
    struct Five { enum { N = 5 }; };
    auto load = [](const float* at) { Eight v; __builtin_memcpy(&v, at, 32); return v; };
    auto row_part = [](const wp::half* at) {
        Halves h; __builtin_memcpy(&h, at, 16); return __builtin_convertvector(h, Eight);
    };
    auto total = [](Eight v) {
        return ((v[0] + v[4]) + (v[2] + v[6])) + ((v[1] + v[5]) + (v[3] + v[7]));
    };
"""

# Sum over the numbers of a row of T, blended, times the light's, for red, green and blue.
_ENVIRONMENT = (
    "    wp::vec_t<3, float> result;\n"
    + _VECTORS
    + """
    auto run = [&](auto tag) {
        enum { N = decltype(tag)::N };
        Eight sum[N];
        for (int v = 0; v < N; ++v) sum[v] = Eight{};
        for (int k = 0; k < 4; ++k) {
            if (shares[k] == 0.0f) continue;
            const wp::half* row = transfer.data + (size_t)slots[k] * (8 * N);
            for (int v = 0; v < N; ++v) sum[v] += row_part(row + 8 * v) * shares[k];
        }
        for (int c = 0; c < 3; ++c) {
            Eight product = Eight{};
            for (int v = 0; v < N; ++v) product += sum[v] * load(light.data + (c * N + v) * 8);
            result[c] = total(product);
        }
    };
    if (width == 32) run(Four()); else run(Five());
#else
    for (int k = 0; k < 4; ++k) {
        if (shares[k] == 0.0f) continue;
        const wp::half* row = transfer.data + (size_t)slots[k] * width;
        for (int c = 0; c < 3; ++c) {
            float product = 0.0f;
            for (int i = 0; i < width; ++i) product += float(row[i]) * light.data[c * width + i];
            result[c] += product * shares[k];
        }
    }
#endif
    return result;
"""
)

# The same where each channel has a row of its own: what bounces.
_BOUNCED = (
    "    wp::vec_t<3, float> result;\n"
    + _VECTORS
    + """
    for (int c = 0; c < 3; ++c) {
        Eight product = Eight{};
        for (int k = 0; k < 4; ++k) {
            if (shares[k] == 0.0f) continue;
            const wp::half* row = bounces.data + ((size_t)slots[k] * 3 + c) * 32;
            Eight one = Eight{};
            for (int v = 0; v < 4; ++v) one += row_part(row + 8 * v) * load(light.data + (c * 4 + v) * 8);
            product += one * shares[k];
        }
        result[c] = total(product);
    }
#else
    for (int k = 0; k < 4; ++k) {
        if (shares[k] == 0.0f) continue;
        const wp::half* row = bounces.data + (size_t)slots[k] * 96;
        for (int c = 0; c < 3; ++c) {
            float product = 0.0f;
            for (int i = 0; i < 32; ++i) product += float(row[c * 32 + i]) * light.data[c * 32 + i];
            result[c] += product * shares[k];
        }
    }
#endif
    return result;
"""
)

# A lobe, of factors lobe[l] about a direction and normal_lobe[l - 1] about the normal, times the light's matrix, and
# that times T, blended: the triple product with fixed light. W_cj = sum_k M_ckj F_k comes first, so that the same W
# serves T and the transfer of a point that nothing shades, A_l y(n) by band: results 0 to 2, and 3 to 5.
_GLOSSY = (
    "    wp::vec_t<6, float> result;\n"
    + _VECTORS
    + """
    auto run = [&](auto tag) {
        enum { N = decltype(tag)::N, COUNT = decltype(tag)::N == 4 ? 25 : 36 };
        const int order = N == 4 ? 5 : 6;
        float about[40] = {}, up[40] = {};
        auto functions = [&](wp::vec3 d, float* y) {
            const float x = d[0], y_ = d[1], z = d[2];
            if (N == 4) {
        ORDER_FIVE
            } else {
        ORDER_SIX
            }
        };
        functions(direction, about);
        functions(normal, up);
        Eight product[3][N];
        for (int c = 0; c < 3; ++c) for (int v = 0; v < N; ++v) product[c][v] = Eight{};
        int k = 0;
        for (int l = 0; l < order; ++l) {
            for (int m = 0; m < 2 * l + 1; ++m, ++k) {
                const float factor = lobe[l] * about[k] + (l > 0 && l < 5 ? normal_lobe[l - 1] * up[k] : 0.0f);
                const float* rows = matrix.data + k * (24 * N);
                for (int c = 0; c < 3; ++c)
                    for (int v = 0; v < N; ++v) product[c][v] += load(rows + (c * N + v) * 8) * factor;
            }
        }
        Eight sum[N];
        for (int v = 0; v < N; ++v) sum[v] = Eight{};
        for (int k = 0; k < 4; ++k) {
            if (shares[k] == 0.0f) continue;
            const wp::half* row = transfer.data + (size_t)slots[k] * (8 * N);
            for (int v = 0; v < N; ++v) sum[v] += row_part(row + 8 * v) * shares[k];
        }
        const float cosine[6] = {COSINE};
        for (int l = 0, i = 0; l < order; ++l) for (int m = 0; m < 2 * l + 1; ++m, ++i) up[i] *= cosine[l];
        for (int c = 0; c < 3; ++c) {
            Eight shaded = Eight{}, open = Eight{};
            for (int v = 0; v < N; ++v) {
                shaded += product[c][v] * sum[v];
                open += product[c][v] * load(up + 8 * v);
            }
            result[c] = total(shaded);
            result[3 + c] = total(open);
        }
    };
    if (width == 32) run(Four()); else run(Five());
#else
    const int order = width == 32 ? 5 : 6;
    float about[40] = {}, up[40] = {}, sum[40] = {};
    auto functions = [&](wp::vec3 d, float* y) {
        const float x = d[0], y_ = d[1], z = d[2];
        if (order == 5) {
        ORDER_FIVE
        } else {
        ORDER_SIX
        }
    };
    const float cosine[6] = {COSINE};
    functions(normal, up);
    functions(direction, about);
    for (int k = 0; k < 4; ++k) {
        if (shares[k] == 0.0f) continue;
        const wp::half* row = transfer.data + (size_t)slots[k] * width;
        for (int i = 0; i < width; ++i) sum[i] += float(row[i]) * shares[k];
    }
    for (int l = 0, k = 0; l < order; ++l) {
        for (int m = 0; m < 2 * l + 1; ++m, ++k) {
            const float factor = lobe[l] * about[k] + (l > 0 && l < 5 ? normal_lobe[l - 1] * up[k] : 0.0f);
            for (int c = 0; c < 3; ++c) {
                const float* row = matrix.data + (k * 3 + c) * width;
                for (int band = 0, i = 0; band < order; ++band) {
                    for (int n = 0; n < 2 * band + 1; ++n, ++i) {
                        result[c] += factor * row[i] * sum[i];
                        result[3 + c] += factor * row[i] * cosine[band] * up[i];
                    }
                }
            }
        }
    }
#endif
    return result;
"""
)


def clamped_cosine(order: int) -> list[float]:
    """Return A_l, the zonal factors of max(0, cos): pi, 2 pi/3, pi/4, 0, -pi/24, 0, ... (Ramamoorthi 2001, Eq. 8)."""
    result = []
    for l in range(order):
        if l == 1:
            result.append(2 * math.pi / 3)
        elif l % 2:
            result.append(0.0)
        else:
            half = l // 2
            choose = math.factorial(l) / (2.0**l * math.factorial(half) ** 2)
            result.append(2 * math.pi * (-1.0) ** (half + 1) * choose / ((l + 2) * (l - 1)))
    return result


def _filled(snippet: str) -> str:
    cosine = ", ".join(f"{value!r}f" for value in clamped_cosine(LARGEST_ORDER))
    parts = {"ORDER_FIVE": harmonics_code(5), "ORDER_SIX": harmonics_code(6), "COSINE": cosine}
    for name, text in parts.items():
        snippet = snippet.replace(name, text)
    return snippet


# Light that arrives through a blend of rows `slots`, by `light` [3, width].
@wp.func_native(snippet=_ENVIRONMENT)
def environment_product(
    transfer: wp.array(dtype=wp.float16),
    width: wp.int32,
    slots: wp.vec4i,
    shares: wp.vec4,
    light: wp.array(dtype=wp.float32),
) -> wp.vec3: ...


# Light that arrives over other surfaces, by rows of red, green and blue, and `light` [3, 32].
@wp.func_native(snippet=_BOUNCED)
def bounced_product(
    bounces: wp.array(dtype=wp.float16), slots: wp.vec4i, shares: wp.vec4, light: wp.array(dtype=wp.float32)
) -> wp.vec3: ...


# Light that a lobe reflects which is zonal about a direction and about the normal: with transfer, and as if nothing
# shaded the point. `matrix` is [k, channel, width].
@wp.func_native(snippet=_filled(_GLOSSY))
def glossy_product(
    transfer: wp.array(dtype=wp.float16),
    width: wp.int32,
    slots: wp.vec4i,
    shares: wp.vec4,
    matrix: wp.array(dtype=wp.float32),
    direction: wp.vec3,
    lobe: vec6,
    normal: wp.vec3,
    normal_lobe: wp.vec4,
) -> vec6: ...
