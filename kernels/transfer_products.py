"""Products of rows of transfer, eight numbers at a time on the CPU; on CUDA, whose threads are lanes already, a loop.

A row of transfer has 25 numbers padded to 32, or 36 padded to 40, as halves: 32 are one cache line. Rows are read,
blended and multiplied in registers. Loops in Warp itself, over vectors of 25, were 28 times slower.
"""

import warp as wp

from warp_gi.kernels.transfer_snippets import COSINE, HARMONICS, HAS_VECTOR_HALVES, LIGHT_ORDER

wp.set_module_options({"enable_backward": False})

WIDTHS = {5: 32, 6: 40}  # numbers in a row, with padding
LIGHT_WIDTH = wp.constant(WIDTHS[LIGHT_ORDER])  # of the sky's own numbers, and of what bounces
vec6 = wp.types.vector(length=6, dtype=wp.float32)


# What every product starts with: vectors of eight, and how a blend of rows gets into registers. `four` and `five` are
# their number in a row.
_VECTORS = f"""
#if {HAS_VECTOR_HALVES}"""
_VECTORS += """
    typedef float Eight __attribute__((vector_size(32)));
    typedef _Float16 Halves __attribute__((vector_size(16)));
    struct Four { enum { N = 4 }; };
    struct Five { enum { N = 5 }; };
    auto load = [](const float* at) { Eight v; __builtin_memcpy(&v, at, 32); return v; };
    auto row_part = [](const wp::half* at) {
        Halves h; __builtin_memcpy(&h, at, 16); return __builtin_convertvector(h, Eight);
    };
    auto blend = [&](auto tag, const wp::half* rows, Eight* sum) {
        enum { N = decltype(tag)::N };
        for (int v = 0; v < N; ++v) sum[v] = Eight{};
        for (int k = 0; k < 4; ++k) {
            if (shares[k] == 0.0f) continue;
            const wp::half* row = rows + (size_t)slots[k] * (8 * N);
            for (int v = 0; v < N; ++v) sum[v] += row_part(row + 8 * v) * shares[k];
        }
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
        blend(tag, transfer.data, sum);
        for (int c = 0; c < 3; ++c) {
            Eight product = Eight{};
            for (int v = 0; v < N; ++v) product += sum[v] * load(light.data + (c * N + v) * 8);
            result[c] = total(product);
        }
    };
    if (transfer.shape[1] == 32) run(Four()); else run(Five());
#else
    const int width = transfer.shape[1];
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
    + HARMONICS
    + COSINE
    + """
    auto functions = [&](wp::vec3 d, int order, float* y) {
        harmonics(d[0], d[1], d[2], order, [&](int k, float value) { y[k] = value; });
    };
"""
    + _VECTORS
    + """
    auto run = [&](auto tag) {
        enum { N = decltype(tag)::N };
        const int order = N == 4 ? 5 : 6;
        float about[40] = {}, up[40] = {};
        functions(direction, order, about);
        functions(normal, order, up);
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
        blend(tag, transfer.data, sum);
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
    if (transfer.shape[1] == 32) run(Four()); else run(Five());
#else
    const int width = transfer.shape[1], order = width == 32 ? 5 : 6;
    float about[40] = {}, up[40] = {}, sum[40] = {};
    functions(normal, order, up);
    functions(direction, order, about);
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


# Light that arrives through a blend of rows `slots` of transfer [slot, width], by `light` [3, width].
@wp.func_native(snippet=_ENVIRONMENT)
def environment_product(
    transfer: wp.array2d(dtype=wp.float16),
    slots: wp.vec4i,
    shares: wp.vec4,
    light: wp.array(dtype=wp.float32),
) -> wp.vec3: ...


# Light that arrives over other surfaces, by rows [slot, 3 * 32] of red, green and blue, and `light` [3, 32].
@wp.func_native(snippet=_BOUNCED)
def bounced_product(
    bounces: wp.array2d(dtype=wp.float16), slots: wp.vec4i, shares: wp.vec4, light: wp.array(dtype=wp.float32)
) -> wp.vec3: ...


# Light that a lobe reflects which is zonal about a direction and about the normal: with transfer, and as if nothing
# shaded the point. `matrix` is [k, channel, width].
@wp.func_native(snippet=_GLOSSY)
def glossy_product(
    transfer: wp.array2d(dtype=wp.float16),
    slots: wp.vec4i,
    shares: wp.vec4,
    matrix: wp.array(dtype=wp.float32),
    direction: wp.vec3,
    lobe: vec6,
    normal: wp.vec3,
    normal_lobe: wp.vec4,
) -> vec6: ...
