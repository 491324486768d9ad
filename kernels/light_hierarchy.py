"""Selecting a light by walking a tree of lights: a node's child is taken with the probability of its importance.

Conty Estevez and Kulla 2018, "Importance Sampling of Many Lights with Adaptive Tree Splitting", without splitting, and
eight children wide. The lights of one or more triangles, points or spots below a child are known by the sphere around
their box, a cone that holds the directions they face (half angle theta_o), how far beyond it they shine (theta_e), and
their power: the sum of their peak intensities (luminance, W/sr). Directional lights stand beside the tree, in a list.
Trees come from ``warp_gi.techniques.light_hierarchy.tree``.
"""

import warp as wp

from warp_gi.kernels.alias import alias_choice
from warp_gi.kernels.emitters import LightChoice
from warp_gi.kernels.path_samplers import LightSampler
from warp_gi.kernels.surface import Surface, ray_origin, shading_normal
from warp_gi.kernels.types import AliasBucket, SceneData

wp.set_module_options({"enable_backward": False})

# A node is rows of eight 32-bit words, one a child. A child below 0 is the complement of an emitter's index; an empty
# lane has power 0.
ROWS = {
    "CENTER": 0,  # x, y, z of the box
    "HALF": 3,  # its extents from there
    "RADIUS": 6,  # half its diagonal
    "AXIS": 7,  # x, y, z, unit: the way the lights face
    "COS_FACING": 10,  # theta_o
    "SIN_FACING": 11,
    "COS_FALLOFF": 12,  # theta_e
    "POWER": 13,
    "CHILD": 14,
}
LANES = 8
NODE_WORDS = 16 * LANES  # whole cache lines; the last row is unused
MOST_LEVELS = 21  # three bits of a path for each

NO_PATH = -1
DIRECTIONAL_PATH = -2


@wp.struct
class LightTree:
    node_count: wp.int32  # 0: no light has a place
    nodes: wp.array(dtype=wp.float32)  # [node * NODE_WORDS], node 0 is the root
    paths: wp.array(dtype=wp.int64)  # [emitter] lanes from the root down, three bits each, the first lowest;
    # NO_PATH: never selected; DIRECTIONAL_PATH - k: number k of `directional`
    directional: wp.array(dtype=wp.int32)  # [number] emitter
    directional_alias: wp.array(dtype=AliasBucket)  # [number]
    directional_count: wp.int32
    directional_probability: wp.float32  # of selecting any of them


@wp.struct
class TreeChoice:
    item: wp.int32  # emitter; -1 where no light can be seen from the point
    pdf: wp.float32  # probability of selecting it
    remainder: wp.float32  # what is left of the random numbers: uniform in [0, 1), free for another use


# The importance is power * cos(theta_i') * cos(theta') / distance^2 (their Eq. 3; Moreau and Clarberg 2019). Over the
# distance of the centre, cos(theta_i') is the height of the box's highest corner above the horizon, at most 1. theta'
# is the least angle between a way the cone faces and a direction from the sphere back to the point; for lights that all
# face one way, the box tells more, as at the horizon. (In the warehouse, boxes brought the variance from 0.52 to 0.33.)
# The distance is at least 0.84 radii, with which it was least: 0.21. The importance is zero only where all lights are
# below the horizon or turned away: SLACK is above the rounding of a cosine. Sines and cosines here carry a factor:
# `square`, the distance^2, or `root`, its root.
#
# The eight lanes are one vector on the CPU. Contraction is decided by the source alone, so choice and pdf agree to the
# last bit.
_NODE = """
#if defined(__CUDA_ARCH__)
    typedef float Lanes;
    #define ROOT(x) sqrtf(x)
    #define COPY memcpy
    #define CONTRACT
#else
    typedef float Lanes __attribute__((vector_size(32)));
    #define ROOT(x) __builtin_elementwise_sqrt(x)
    #define COPY __builtin_memcpy
    #define CONTRACT _Pragma("clang fp contract(on)")
#endif
    struct Node {
        const float* words;
        float weights[8], sums[9];  // of the children: importance, and what that of the first 0 to 8 adds up to

        static CUDA_CALLABLE inline Lanes low(Lanes a, Lanes b) { return a < b ? a : b; }
        static CUDA_CALLABLE inline Lanes high(Lanes a, Lanes b) { return a > b ? a : b; }
        CUDA_CALLABLE inline Lanes row(int index, int lane) const {
            Lanes values;
            COPY(&values, words + 8 * index + lane, sizeof(Lanes));
            return values;
        }
        CUDA_CALLABLE inline int child(int lane) const {
            int value;
            COPY(&value, words + 8 * CHILD + lane, sizeof(int));
            return value;
        }
        CUDA_CALLABLE inline void weigh(float px, float py, float pz, float nx, float ny, float nz) {
            CONTRACT
            const float size_x = nx < 0.0f ? -nx : nx, size_y = ny < 0.0f ? -ny : ny, size_z = nz < 0.0f ? -nz : nz;
            const int width = (int)(sizeof(Lanes) / sizeof(float));
            for (int lane = 0; lane < 8; lane += width) {
                const Lanes dx = row(CENTER, lane) - px;
                const Lanes dy = row(CENTER + 1, lane) - py;
                const Lanes dz = row(CENTER + 2, lane) - pz;
                const Lanes hx = row(HALF, lane), hy = row(HALF + 1, lane), hz = row(HALF + 2, lane);
                const Lanes ax = row(AXIS, lane), ay = row(AXIS + 1, lane), az = row(AXIS + 2, lane);
                const Lanes radius = row(RADIUS, lane), falloff = row(COS_FALLOFF, lane);
                const Lanes facing = row(COS_FACING, lane), facing_sine = row(SIN_FACING, lane);
                const Lanes zero = radius * 0.0f;
                const Lanes radius2 = radius * radius + 1e-20f;
                const Lanes distance2 = dx * dx + dy * dy + dz * dz;
                const Lanes square = high(distance2, 0.7f * radius2);
                const Lanes root = ROOT(square), inverse = 1.0f / square;

                Lanes incidence = (nx * dx + ny * dy + nz * dz) + (size_x * hx + size_y * hy + size_z * hz);
                incidence = low(incidence, root) * root;

                const Lanes back = -(ax * dx + ay * dy + az * dz);
                const Lanes back_sine = ROOT(high(square - back * back, zero));
                const Lanes sphere = ROOT(high(square - radius2, zero));  // cosine of its half angle; sine: radius
                const Lanes outer = back * sphere + back_sine * radius;  // theta less that half angle
                const Lanes outer_sine = back_sine * sphere - back * radius;
                Lanes emission = outer * facing + outer_sine * facing_sine;
                emission = outer >= square * facing ? square : emission;
                emission = back >= sphere ? square : emission;
                emission = distance2 <= radius2 ? square : emission;
                const Lanes flat = (back + (high(ax, -ax) * hx + high(ay, -ay) * hy + high(az, -az) * hz)) * root;
                emission = facing - (facing_sine + falloff) >= 0.999999f ? low(emission, flat) : emission;

                incidence = incidence * inverse + SLACK;
                emission = emission * inverse + SLACK;
                Lanes weight = row(POWER, lane) * inverse * incidence * emission;
                weight = emission > falloff ? weight : zero;
                weight = incidence > 0.0f ? weight : zero;
                COPY(weights + lane, &weight, sizeof(Lanes));
            }
        }
        CUDA_CALLABLE inline void add() {
            sums[0] = 0.0f;
#if defined(__CUDA_ARCH__)
            float sum = 0.0f;
            for (int lane = 0; lane < 8; ++lane) sums[lane + 1] = sum += weights[lane];
#else
            const Lanes zero = {};
            Lanes sum;
            COPY(&sum, weights, sizeof(Lanes));
            sum += __builtin_shufflevector(sum, zero, 8, 0, 1, 2, 3, 4, 5, 6);
            sum += __builtin_shufflevector(sum, zero, 8, 8, 0, 1, 2, 3, 4, 5);
            sum += __builtin_shufflevector(sum, zero, 8, 8, 8, 8, 0, 1, 2, 3);
            COPY(sums + 1, &sum, sizeof(Lanes));
#endif
        }
        // Whether there is anything to choose. Where a node has importance and none of its children has, powers decide,
        // so that the probabilities of all lights add up to 1.
        CUDA_CALLABLE inline bool open(
            const float* nodes, int index, float px, float py, float pz, float nx, float ny, float nz
        ) {
            words = nodes + (long long)index * NODE_WORDS;
            weigh(px, py, pz, nx, ny, nz);
            add();
            if (sums[8] > 0.0f) return true;
            if (index == 0) return false;
            COPY(weights, words + 8 * POWER, sizeof(weights));
            add();
            return true;
        }
        // The first child with a share that reaches beyond `at`; where rounding leaves none, the last with a share.
        CUDA_CALLABLE inline int find(float at) const {
#if defined(__CUDA_ARCH__)
            int last = 0;
            for (int lane = 0; lane < 8; ++lane) {
                if (!(weights[lane] > 0.0f)) continue;
                if (sums[lane + 1] > at) return lane;
                last = lane;
            }
            return last;
#else
            typedef bool Mask __attribute__((ext_vector_type(8)));
            Lanes share, sum;
            COPY(&share, weights, sizeof(Lanes));
            COPY(&sum, sums + 1, sizeof(Lanes));
            const unsigned with = __builtin_bit_cast(unsigned char, __builtin_convertvector(share > 0.0f, Mask));
            const unsigned beyond = __builtin_bit_cast(unsigned char, __builtin_convertvector(sum > at, Mask)) & with;
            return beyond ? __builtin_ctz(beyond) : 31 - __builtin_clz(with);
#endif
        }
    };
"""
_END = """
    #undef ROOT
    #undef COPY
    #undef CONTRACT
    ;
"""


def _snippet(code: str) -> str:
    constants = {**ROWS, "NODE_WORDS": NODE_WORDS, "SLACK": "1e-6f"}
    for name in sorted(constants, key=len, reverse=True):
        code = code.replace(name, str(constants[name]))
    return code


# Emitter (as bits), probability, remainder. A float32 holds 24 bits, too few for a small light in a large tree, so
# the digits of v follow those of u.
@wp.func_native(
    _snippet(
        _NODE
        + """
    struct Walk {
        static CUDA_CALLABLE NOT_INLINE wp::vec3 run(
            const float* nodes, float px, float py, float pz, float nx, float ny, float nz, float u, float v
        ) {
            Node node;
            double left = (double)u + (double)v * 5.9604644775390625e-8;
            float pdf = 1.0f;
            int index = 0;
            do {
                if (!node.open(nodes, index, px, py, pz, nx, ny, nz)) { index = -1; pdf = 0.0f; break; }
                const double at = left * (double)node.sums[8];
                const int lane = node.find((float)left * node.sums[8]);
                const double weight = node.weights[lane];
                left = (at - (double)node.sums[lane]) / weight;
                left = left < 0.0 ? 0.0 : (left > 0.99999994 ? 0.99999994 : left);
                pdf *= node.weights[lane] / node.sums[8];
                index = node.child(lane);
            } while (index >= 0);
            float item;
            const int emitter = pdf > 0.0f ? ~index : -1;
            COPY(&item, &emitter, sizeof(int));
            return wp::vec3(item, pdf, (float)left);
        }
    };
    return Walk::run(
        nodes.data, position[0], position[1], position[2], normal[0], normal[1], normal[2], u, v
    );
"""
        + _END
    ).replace("NOT_INLINE", "__attribute__((noinline))")
)
def _tree_choice(
    nodes: wp.array(dtype=wp.float32), position: wp.vec3, normal: wp.vec3, u: wp.float32, v: wp.float32
) -> wp.vec3: ...


@wp.func_native(
    _snippet(
        _NODE
        + """
    struct Walk {
        static CUDA_CALLABLE NOT_INLINE float run(
            const float* nodes, float px, float py, float pz, float nx, float ny, float nz, long long path
        ) {
            Node node;
            float pdf = 1.0f;
            int index = 0;
            do {
                if (!node.open(nodes, index, px, py, pz, nx, ny, nz)) return 0.0f;
                const int lane = (int)(path & 7);
                if (!(node.weights[lane] > 0.0f)) return 0.0f;
                pdf *= node.weights[lane] / node.sums[8];
                index = node.child(lane);
                path >>= 3;
            } while (index >= 0);
            return pdf;
        }
    };
    return Walk::run(nodes.data, position[0], position[1], position[2], normal[0], normal[1], normal[2], path);
"""
        + _END
    ).replace("NOT_INLINE", "__attribute__((noinline))")
)
def _tree_pdf(nodes: wp.array(dtype=wp.float32), position: wp.vec3, normal: wp.vec3, path: wp.int64) -> wp.float32: ...


# A light for the point `position` of a surface that faces `normal` (unit), from two uniform
# numbers in [0, 1): u decides, as stratified as it is, and v adds digits.
@wp.func
def hierarchy_choice(tree: LightTree, position: wp.vec3, normal: wp.vec3, u: wp.float32, v: wp.float32) -> TreeChoice:
    choice = TreeChoice()
    choice.item = -1
    share = tree.directional_probability
    rest = u
    digits = v  # of u, as far as it is stretched
    if u < share:
        drawn = alias_choice(tree.directional_alias, tree.directional_count, u / share, v / share)
        choice.item = tree.directional[drawn.item]
        choice.pdf = share * drawn.pdf
        choice.remainder = drawn.remainder
        return choice
    if tree.node_count == 0:
        return choice
    if share > 0.0:
        rest = wp.min((u - share) / (1.0 - share), 0.99999994)
        digits = v / (1.0 - share)
    found = _tree_choice(tree.nodes, position, normal, rest, digits)
    choice.item = wp.cast(found[0], wp.int32)
    choice.pdf = (1.0 - share) * found[1]
    choice.remainder = found[2]
    return choice


# The probability with which hierarchy_choice selects the emitter `item` there, equal to its pdf in every bit.
@wp.func
def hierarchy_pdf(tree: LightTree, position: wp.vec3, normal: wp.vec3, item: wp.int32) -> wp.float32:
    path = tree.paths[item]
    if path >= wp.int64(0):
        return (1.0 - tree.directional_probability) * _tree_pdf(tree.nodes, position, normal, path)
    if path == wp.int64(NO_PATH):
        return 0.0
    number = wp.int32(wp.int64(DIRECTIONAL_PATH) - path)
    return tree.directional_probability * tree.directional_alias[number].pdf


# The normal is that of shading: what is below its horizon is not reflected.
@wp.func
def hierarchy_light(
    data: LightTree, scene: SceneData, region: wp.int32, s: Surface, wo: wp.vec3, u: wp.vec2
) -> LightChoice:
    choice = hierarchy_choice(data, ray_origin(s), shading_normal(s), u[0], u[1])
    light = LightChoice()
    light.weight = 1.0
    light.item = choice.item
    light.pdf = choice.pdf
    return light


@wp.func
def hierarchy_light_pdf(
    data: LightTree, scene: SceneData, region: wp.int32, s: Surface, wo: wp.vec3, emitter: wp.int32
) -> wp.float32:
    return hierarchy_pdf(data, ray_origin(s), shading_normal(s), emitter)


HIERARCHY_LIGHTS = LightSampler("hierarchy", LightTree, hierarchy_light, hierarchy_light_pdf)
