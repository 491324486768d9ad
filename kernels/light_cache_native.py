"""Weights of a bucket's triangles, eight at a time on the CPU: the same formulas as ltc.py, which explains them.

Triangles that cross the horizon, of the surface or of its GGX lobe, are few; they are left to ltc.py, and so are all
lights on CUDA, whose threads are lanes already.
"""

import warp as wp

from warp_gi.kernels.ltc import LobeWeights

wp.set_module_options({"enable_backward": False})

CAPACITY = 32  # lights a bucket at most
BucketWeights = wp.types.vector(length=CAPACITY, dtype=wp.float32)
LEFT_OUT = wp.constant(wp.float32(-1.0))


# An emissive triangle, as its weight needs it.
@wp.struct
class LightShape:
    p0: wp.vec3
    p1: wp.vec3
    p2: wp.vec3
    luminance: wp.float32  # of the mean radiance; 0 for lights without size
    two_sided: wp.int32
    unused: wp.float32  # makes it twelve words


# Weights of the lights items[begin ... begin + count) times their rates, LEFT_OUT for those that ltc.py has to weigh.
@wp.func_native(
    snippet="""
    wp::vec_t<32, float> result;
#if defined(__CUDA_ARCH__)
    for (int k = 0; k < count; ++k) result[k] = -1.0f;
#else
    typedef float Lanes __attribute__((vector_size(32)));
    typedef int Flags __attribute__((vector_size(32)));
    typedef float Half __attribute__((vector_size(16)));
    struct Rotation { float m[3][3]; };
    // Of each half of four rows the 4 x 4 transpose.
    auto transpose_halves = [](Lanes* row) {
        const Lanes a = __builtin_shufflevector(row[0], row[1], 0, 8, 1, 9, 4, 12, 5, 13);
        const Lanes b = __builtin_shufflevector(row[0], row[1], 2, 10, 3, 11, 6, 14, 7, 15);
        const Lanes c = __builtin_shufflevector(row[2], row[3], 0, 8, 1, 9, 4, 12, 5, 13);
        const Lanes d = __builtin_shufflevector(row[2], row[3], 2, 10, 3, 11, 6, 14, 7, 15);
        row[0] = __builtin_shufflevector(a, c, 0, 1, 8, 9, 4, 5, 12, 13);
        row[1] = __builtin_shufflevector(a, c, 2, 3, 10, 11, 6, 7, 14, 15);
        row[2] = __builtin_shufflevector(b, d, 0, 1, 8, 9, 4, 5, 12, 13);
        row[3] = __builtin_shufflevector(b, d, 2, 3, 10, 11, 6, 7, 14, 15);
    };
    auto transpose = [&](Lanes* row) {
        transpose_halves(row);
        transpose_halves(row + 4);
        for (int i = 0; i < 4; ++i) {
            const Lanes upper = row[i], lower = row[i + 4];
            row[i] = __builtin_shufflevector(upper, lower, 0, 1, 2, 3, 8, 9, 10, 11);
            row[i + 4] = __builtin_shufflevector(upper, lower, 4, 5, 6, 7, 12, 13, 14, 15);
        }
    };
    struct Triangle {
        Lanes x[3], y[3], z[3];

        static inline Lanes low(Lanes a, Lanes b) { return a < b ? a : b; }
        static inline Lanes high(Lanes a, Lanes b) { return a > b ? a : b; }
        inline Lanes lowest() const { return low(low(z[0], z[1]), z[2]); }
        inline Lanes highest() const { return high(high(z[0], z[1]), z[2]); }
        inline Triangle rotated(const Rotation& by) const {
            Triangle r;
            const auto& m = by.m;
            for (int i = 0; i < 3; ++i) {
                r.x[i] = m[0][0] * x[i] + m[0][1] * y[i] + m[0][2] * z[i];
                r.y[i] = m[1][0] * x[i] + m[1][1] * y[i] + m[1][2] * z[i];
                r.z[i] = m[2][0] * x[i] + m[2][1] * y[i] + m[2][2] * z[i];
            }
            return r;
        }
        // (theta / sin(theta) - 1) * (u x v).z
        static inline Lanes edge_excess(Lanes ux, Lanes uy, Lanes uz, Lanes vx, Lanes vy, Lanes vz) {
            const Lanes cross_x = uy * vz - uz * vy, cross_y = uz * vx - ux * vz, cross_z = ux * vy - uy * vx;
            const Lanes cosine = ux * vx + uy * vy + uz * vz;
            const Lanes t = 1.0f - high(cosine, -cosine);
            const Lanes excess = t * (0.33338689f + t * (0.13081335f + t * (0.07560758f
                + t * (-0.01950102f + t * 0.05041562f))));
            if (!__builtin_reduce_or(cosine < 0.0f)) return excess * cross_z;
            const Lanes square = cross_x * cross_x + cross_y * cross_y + cross_z * cross_z;
            const Lanes sine = __builtin_elementwise_sqrt(high(square, t * 0.0f + 1e-24f));
            const Lanes obtuse = 3.14159265f / sine - 2.0f - excess;
            return (cosine < 0.0f ? obtuse : excess) * cross_z;
        }
        // Six times the volume that the triangle spans with the point, positive where it is seen from its back.
        inline Lanes volume() const {
            const Lanes bx = x[1] - x[0], by = y[1] - y[0], bz = z[1] - z[0];
            const Lanes cx = x[2] - x[0], cy = y[2] - y[0], cz = z[2] - z[0];
            return x[0] * (by * cz - bz * cy) + y[0] * (bz * cx - bx * cz) + z[0] * (bx * cy - by * cx);
        }
        // Integral of cos(theta) / pi of a triangle that is nowhere below the horizon.
        inline Lanes cosine() const {
            Lanes square[3], edge = z[0] * 0.0f;
            const Lanes zero = edge, least = zero + 1e-18f;
            for (int i = 0; i < 3; ++i) {
                const int j = (i + 1) % 3;
                const Lanes dx = x[j] - x[i], dy = y[j] - y[i], dz = z[j] - z[i];
                square[i] = x[i] * x[i] + y[i] * y[i] + z[i] * z[i];
                edge = high(edge, dx * dx + dy * dy + dz * dz);
            }
            const Flags is_small = edge < 0.01f * square[0];
            Lanes value = zero;
            if (__builtin_reduce_or(is_small)) {
                const Lanes spanned = volume();
                const Lanes least_volume = 1e-7f * edge * __builtin_elementwise_sqrt(square[0]);
                Lanes sum = zero;
                for (int i = 0; i < 3; ++i) {
                    const int j = (i + 1) % 3;
                    const Lanes px = x[i] + x[j], py = y[i] + y[j], pz = z[i] + z[j];
                    const Lanes weight = 1.0f / high(px * px + py * py + pz * pz, least);
                    sum += pz * weight * weight;
                }
                value = high(high(spanned, -spanned), least_volume) * sum * 1.33333333f;
            }
            if (__builtin_reduce_or(~is_small)) {
                Lanes ux[3], uy[3], uz[3];
                for (int i = 0; i < 3; ++i) {
                    const Lanes inverse = 1.0f / __builtin_elementwise_sqrt(high(square[i], least));
                    ux[i] = x[i] * inverse;
                    uy[i] = y[i] * inverse;
                    uz[i] = z[i] * inverse;
                }
                Lanes total = (ux[2] - ux[0]) * (uy[2] - uy[1]) - (uy[2] - uy[0]) * (ux[2] - ux[1]);
                for (int i = 0; i < 3; ++i) {
                    const int j = (i + 1) % 3;
                    total += edge_excess(ux[i], uy[i], uz[i], ux[j], uy[j], uz[j]);
                }
                const Lanes large = high(0.5f * high(total, -total), zero + 1e-7f);
                value = is_small ? value : large;
            }
            return low(high(value * 0.318309886f, zero + 1e-30f), zero + 1.0f);
        }
    };
    const float* floats = reinterpret_cast<const float*>(shapes.data);
    const int stride = sizeof(*shapes.data) / sizeof(float);
    Rotation to_shading, to_lobe;
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {
            to_shading.m[i][j] = shading.data[j][i];
            to_lobe.m[i][j] = w.matrix.data[i][j];
        }
    for (int start = 0; start < count; start += 8) {
        Lanes corner[12];  // rows of eight shapes, then columns: nine coordinates, luminance, two_sided
        Half more[8];
        for (int lane = 0; lane < 8; ++lane) {
            const int k = start + lane < count ? start + lane : count - 1;
            const float* shape = floats + (long long)stride * items.data[begin + k];
            __builtin_memcpy(&corner[lane], shape, sizeof(Lanes));
            __builtin_memcpy(&more[lane], shape + 8, sizeof(Half));
        }
        transpose(corner);
        for (int i = 0; i < 4; ++i)
            corner[8 + i] = __builtin_shufflevector(more[i], more[i + 4], 0, 1, 2, 3, 4, 5, 6, 7);
        transpose_halves(corner + 8);
        const Lanes luminance = corner[9];
        const Flags two_sided = __builtin_bit_cast(Flags, corner[10]);
        Triangle world;
        for (int i = 0; i < 3; ++i) {
            world.x[i] = corner[3 * i] - origin[0];
            world.y[i] = corner[3 * i + 1] - origin[1];
            world.z[i] = corner[3 * i + 2] - origin[2];
        }
        const Triangle local = world.rotated(to_shading);
        const Lanes zero = luminance * 0.0f;
        Flags left_out = (luminance <= 0.0f) | ((local.lowest() <= 0.0f) & (local.highest() > 0.0f));
        const Flags dark = (local.highest() <= 0.0f) | ((world.volume() >= 0.0f) & (two_sided == 0));
        Lanes weight = zero;
        if (__builtin_reduce_or(~dark & ~left_out)) {
            const Lanes cosine = local.cosine();
            weight = w.diffuse * cosine;
            if (w.has_specular) {
                const Triangle lobe = local.rotated(to_lobe);
                const Flags crosses = (lobe.lowest() <= 0.0f) & (lobe.highest() > 0.0f);
                const Lanes specular = lobe.highest() <= 0.0f ? zero : lobe.cosine();
                weight += w.specular * specular;
                left_out |= crosses;
            }
        }
        weight = dark ? zero : luminance * weight;
        weight = left_out & (~dark | (luminance <= 0.0f)) ? zero - 1.0f : weight;
        for (int lane = 0; lane < 8 && start + lane < count; ++lane) {
            const float rate = weight[lane] < 0.0f ? 1.0f : rates.data[begin + start + lane];
            result[start + lane] = weight[lane] * rate;
        }
    }
#endif
    return result;
"""
)
def weigh_triangles(
    shapes: wp.array(dtype=LightShape),
    items: wp.array(dtype=wp.int32),
    rates: wp.array(dtype=wp.float32),
    begin: wp.int32,
    count: wp.int32,
    origin: wp.vec3,
    shading: wp.mat33,
    w: LobeWeights,
) -> BucketWeights: ...
