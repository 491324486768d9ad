"""Samples of glossy surfaces for a visibility field, eight at a time: those of kernels.bsdf, by the same numbers."""

import warp as wp

from warp_gi.kernels.bsdf import Bsdf
from warp_gi.kernels.visibility_field import LANES, LANES_END, OCTET_TEXELS, VisibilityGrid, vec6, vec33

wp.set_module_options({"enable_backward": False})

vec32 = wp.types.vector(length=32, dtype=wp.float32)

_REVERSE = """
#if defined(__CUDA_ARCH__)
    #define REVERSE(x) __brev(x)
#else
    #define REVERSE(x) __builtin_elementwise_bitreverse(x)
#endif
    #define UNIT(x) (TO_F((I)((x) >> 8)) * 5.9604644775390625e-8f)
"""
_REVERSE_END = """
    #undef REVERSE
    #undef UNIT
"""


# Eight BSDF samples (bsdf_sample) from number `index` of the sequence on, as cosine_octet returns its rays; those that
# do not leave the surface are below the plane. `keys` are those of the pair of numbers (pair_keys), `lobe` that of the
# choice of the lobe (random_key) for samples from number `sample` on, `specular` the probability of GGX.
@wp.func_native(
    LANES
    + _REVERSE
    + """
    wp::vec_t<33, float> result;
    unsigned visible = 0, occluded = 0, above = 0;
    const float ax = bsdf.alpha * wo[0], ay = bsdf.alpha * wo[1];
    const float stretched = 1.0f / wp::sqrt(ax * ax + ay * ay + wo[2] * wo[2]);
    const float wx = ax * stretched, wy = ay * stretched, wz = wo[2] * stretched;
    for (int lane = 0; lane < 8; lane += lanes) {
        CONTRACT
#if defined(__CUDA_ARCH__)
        const U item = lane;
#else
        const U item = {0, 1, 2, 3, 4, 5, 6, 7};
#endif
        // random_1d
        U h = (item + (unsigned)sample) ^ (unsigned)lobe;
        h ^= h >> 16; h *= 0x21f0aaadu; h ^= h >> 15; h *= 0x735a2d97u; h ^= h >> 15;
        const F u_lobe = UNIT(h);
        // sample_2d; Bits::scramble and Bits::pascal of kernels.sampling
        auto scramble = [](U v, unsigned seed) {
            v ^= v * 0x3d20adeau; v += seed; v *= (seed >> 16) | 1u;
            v ^= v * 0x05526c56u; v ^= v * 0x53a22864u;
            return v;
        };
        const U order = REVERSE(scramble(REVERSE(item + (unsigned)index), keys[0]));
        U p = order;
        p ^= p >> 16; p ^= (p & 0xff00ff00u) >> 8; p ^= (p & 0xf0f0f0f0u) >> 4;
        p ^= (p & 0xccccccccu) >> 2; p ^= (p & 0xaaaaaaaau) >> 1;
        const U first = REVERSE(scramble(order, keys[1])), second = REVERSE(scramble(p, keys[2]));
        const F u0 = UNIT(first), u1 = UNIT(second);
        // the point on a circle that both lobes need: circle(u0) for GGX, circle(u1) for the cosine
        const F turn = u_lobe < specular ? u0 : u1;
        const I quarter = TO_I(4.0f * turn + 0.5f);
        const F a = (turn - 0.25f * TO_F(quarter)) * 6.283185307f, a2 = a * a;
        const F c = 1.0f + a2 * (-0.5f + a2 * (4.166664568e-2f + a2 * (-1.388731625e-3f + a2 * 2.443315711e-5f)));
        const F s = a * (1.0f + a2 * (-1.666666546e-1f + a2 * (8.332160873e-3f + a2 * -1.951529589e-4f)));
        const F cu = (quarter & 1) != 0 ? s : c, cv = (quarter & 1) != 0 ? c : s;
        const F cx = ((quarter + 1) & 2) != 0 ? -cu : cu, cy = (quarter & 2) != 0 ? -cv : cv;
        // ggx_visible_normal and the reflection about it
        const F cap = (1.0f - u1) * (1.0f + wz) - wz;
        F around = 1.0f - cap * cap;
        around = ROOT(around < 0.0f ? 0.0f * around : around);
        F hx = bsdf.alpha * (cx * around + wx), hy = bsdf.alpha * (cy * around + wy), hz = cap + wz;
        hz = hz < 1e-6f ? 0.0f * hz + 1e-6f : hz;
        const F twice = 2.0f * (wo[0] * hx + wo[1] * hy + wo[2] * hz) / (hx * hx + hy * hy + hz * hz);
        // cosine_direction
        const F radius = ROOT(u0), height = ROOT(1.0f - u0);
        const F lx = u_lobe < specular ? hx * twice - wo[0] : cx * radius;
        const F ly = u_lobe < specular ? hy * twice - wo[1] : cy * radius;
        const F lz = u_lobe < specular ? hz * twice - wo[2] : height;
        const F x = frame.data[0][0] * lx + frame.data[0][1] * ly + frame.data[0][2] * lz;
        const F y = frame.data[1][0] * lx + frame.data[1][1] * ly + frame.data[1][2] * lz;
        const F z = frame.data[2][0] * lx + frame.data[2][1] * ly + frame.data[2][2] * lz;
        COPY(&result.c[lane], &x, sizeof(F));
        COPY(&result.c[8 + lane], &y, sizeof(F));
        COPY(&result.c[16 + lane], &z, sizeof(F));
"""
    + OCTET_TEXELS
    + """
        const F plane = x * normal[0] + y * normal[1] + z * normal[2];
        const F least = plane < lz ? plane : lz;
#if defined(__CUDA_ARCH__)
        above |= (unsigned)(least > 0.0f) << lane;
#else
        above = __builtin_bit_cast(unsigned char, __builtin_convertvector(least > 0.0f, B8));
#endif
    }
    const unsigned bits = visible | occluded << 8 | above << 16;
    COPY(&result.c[32], &bits, 4);
    return result;
"""
    + _REVERSE_END
    + LANES_END
)
def glossy_octet(
    grid: VisibilityGrid,
    slot: wp.int32,
    bsdf: Bsdf,
    specular: wp.float32,
    wo: wp.vec3,
    frame: wp.mat33,
    normal: wp.vec3,
    keys: wp.vec3ui,
    index: wp.uint32,
    lobe: wp.uint32,
    sample: wp.int32,
) -> vec33: ...


# Of eight directions that leave the surface f cos(wi) / pdf by red, green and blue, and the pdf [1/sr] of the BSDF
# (bsdf_evaluate).
@wp.func_native(
    LANES
    + """
    wp::vec_t<32, float> result;
    const float alpha2 = bsdf.alpha * bsdf.alpha, rest = 1.0f - alpha2;
    const float root_o = wp::sqrt(alpha2 + rest * wo[2] * wo[2]), by_pi = 0.318309886f;
    for (int lane = 0; lane < 8; lane += lanes) {
        CONTRACT
        F x, y, z;
        COPY(&x, &octet.c[lane], sizeof(F));
        COPY(&y, &octet.c[8 + lane], sizeof(F));
        COPY(&z, &octet.c[16 + lane], sizeof(F));
        const F ix = frame.data[0][0] * x + frame.data[1][0] * y + frame.data[2][0] * z;
        const F iy = frame.data[0][1] * x + frame.data[1][1] * y + frame.data[2][1] * z;
        const F iz = frame.data[0][2] * x + frame.data[1][2] * y + frame.data[2][2] * z;
        const F hx = ix + wo[0], hy = iy + wo[1], hz = iz + wo[2];
        const F across = hx * hx + hy * hy, length2 = across + hz * hz;
        F m = 1.0f - (wo[0] * hx + wo[1] * hy + wo[2] * hz) / ROOT(length2);
        m = m < 0.0f ? 0.0f * m : m;
        const F m5 = m * m * m * m * m;
        const F d = across + alpha2 * hz * hz;  // times length2, as the density's square has length2 squared
        const F distribution = alpha2 * by_pi * length2 * length2 / (d * d);
        const F shadowed = 0.5f * distribution / (wo[2] * ROOT(alpha2 + rest * iz * iz) + iz * root_o);
        const F pdf = specular * distribution / (2.0f * (wo[2] + root_o)) + (1.0f - specular) * by_pi * iz;
        const F scale = iz / pdf;
        for (int channel = 0; channel < 3; ++channel) {
            const F fresnel = bsdf.f0[channel] * (1.0f - m5) + bsdf.f90 * m5;
            const F weight = ((1.0f - fresnel) * (bsdf.diffuse[channel] * by_pi) + fresnel * shadowed) * scale;
            COPY(&result.c[8 * channel + lane], &weight, sizeof(F));
        }
        COPY(&result.c[24 + lane], &pdf, sizeof(F));
    }
    return result;
"""
    + LANES_END
)
def octet_weights(octet: vec33, bsdf: Bsdf, specular: wp.float32, wo: wp.vec3, frame: wp.mat33) -> vec32: ...


# Sums over the lanes in `bits` of weights by red, green and blue, then of their squares.
@wp.func_native(
    LANES
    + """
    wp::vec_t<6, float> result;
    for (int lane = 0; lane < 8; lane += lanes) {
#if defined(__CUDA_ARCH__)
        const float keep = (float)((bits >> lane) & 1);
#else
        const I lights = {1, 2, 4, 8, 16, 32, 64, 128};
        const F keep = (lights & bits) != 0 ? 1.0f + (F) {} : (F) {};
#endif
        for (int channel = 0; channel < 3; ++channel) {
            F weight;
            COPY(&weight, &weights.c[8 * channel + lane], sizeof(F));
            for (int i = 0; i < lanes; ++i) {
                const float kept = AT(keep, i) > 0.0f ? AT(weight, i) : 0.0f;
                result.c[channel] += kept;
                result.c[3 + channel] += kept * kept;
            }
        }
    }
    return result;
"""
    + LANES_END
)
def octet_sums(weights: vec32, bits: wp.int32) -> vec6: ...


@wp.func
def octet_weight(weights: vec32, lane: wp.int32) -> wp.vec3:
    return wp.vec3(weights[lane], weights[8 + lane], weights[16 + lane])


@wp.func
def octet_pdf(weights: vec32, lane: wp.int32) -> wp.float32:
    return weights[24 + lane]
