"""Random numbers, warps of the unit square, frames.

Samples come from the first two Sobol dimensions, shuffled and scrambled by hashes
(Burley 2020, "Practical Hash-based Owen Scrambling"; constants by Vegdahl), one
independent shuffle for each dimension pair. The sequence runs along the Morton
curve of the pixels, so that every aligned power-of-two block of pixels and samples
is itself a (0, 2)-net and the error is blue noise over the picture (Ahmed and Wonka
2020, "Screen-Space Blue-Noise Diffusion of Monte Carlo Sampling Error via
Hierarchical Ordering of Pixels"). A number depends on the seed (which holds the
frame), the pixel, the sample and the dimension only.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

# ---- dimensions: who draws which random numbers ----
#
# A number is stratified (sample_1d, sample_2d) or only random (random_1d); the two kinds never meet, whatever their
# dimensions. Within a kind, numbers of one index and one seed are independent if their dimensions differ. So whatever
# one launch draws by one index and seed needs dimensions of its own; all of them are named here, launch by launch, and
# tests/kernels/test_dimensions.py holds the launches against each other.

# Camera rays and whatever else starts before a path: the point in a pixel or in a texel.
CAMERA_DIMENSION = wp.constant(0)

# Paths. Vertex k (0 is the first hit) has the dimensions PATH_DIMENSION + k VERTEX_DIMENSIONS and so many after it.
# Numbers that are only random stand apart by thousands; they leave room for 511 vertices.
PATH_DIMENSION = wp.constant(1)
VERTEX_DIMENSIONS = wp.constant(8)
LIGHT_DIMENSION = wp.constant(0)  # offsets at a vertex, from here on: which light to sample (1d; its digits random)
SKY_DIMENSION = wp.constant(1)  # the direction of the sky sample (2d)
SKY_DIGITS_DIMENSION = wp.constant(2)  # further digits of the first of the two (random)
EMITTER_DIMENSION = wp.constant(3)  # the point on the emitter (2d)
DIRECTION_DIMENSION = wp.constant(4)  # direction samplers: the lobe (1d) here, the direction (2d) in the one after
ROULETTE_DIMENSION = wp.constant(6)  # whether the path goes on (random)
CACHE_DIMENSION = wp.constant(7)  # whether the path ends in a radiance cache that is valid in part (random)
CACHE_PLACE_DIMENSION = wp.constant(4)  # where a radiance cache is read (random): this one and the one after
CACHE_LOBE_DIMENSION = wp.constant(3)  # whether the path goes on by the lobe that the cache does not know (random)
FURTHER_DIMENSIONS = wp.constant(4096)  # added to those of light samples beyond the first vertex, which are random:
FURTHER_SECOND_DIMENSIONS = wp.constant(8192)  # to that of a number or of the first of a pair; to that of the second
GUIDE_DIMENSIONS = wp.constant(8192)  # the leaf of a guide's quadtree (random); added to DIRECTION_DIMENSION
EXPLORE_DIMENSION = wp.constant(12288)  # which other light to explore (random),
EXPLORE_POINT_DIMENSION = wp.constant(12289)  # a pair for the point on it (random),
EXPLORE_DIGITS_DIMENSION = wp.constant(2)  # and how far from that pair is another one, for the choice

# Lights that have a ray of their own at the first vertex of a path: the point on it (2d), so many as there may be.
APART_DIMENSION = wp.constant(2009)

# Rays from pixels that end in light field probes, beside the path that may go on from where they end: its vertices
# stay below, as it has BsdfPaths' default depth.
PROBE_LOBE_DIMENSION = wp.constant(2000)
PROBE_RAY_DIMENSION = wp.constant(2001)
PROBE_PIXEL_DIMENSION = wp.constant(2002)  # whether the pixel goes by the probes (random)
PROBE_HIT_DIMENSION = wp.constant(2003)  # whether the end of the ray does (random)

# Paths that tell where a camera's light goes over (light_field_place): so many dimensions a vertex, the lobe and the
# direction, after CAMERA_DIMENSION.
REACH_DIMENSION = wp.constant(1)
REACH_VERTEX_DIMENSIONS = wp.constant(3)

# A visibility field's bake, by surface sample.
SURFACE_PIECE_DIMENSION = wp.constant(1)  # random
SURFACE_POINT_DIMENSION = wp.constant(2)
SURFACE_TURN_DIMENSION = wp.constant(3)  # random

# A visibility field's sets of directions, by sample of a set, and the turn of a pixel's set.
SET_TURN_DIMENSION = wp.constant(0)
SET_SKY_DIMENSION = wp.constant(1)
SET_SKY_DIGITS_DIMENSION = wp.constant(2)  # random
SET_COSINE_DIMENSION = wp.constant(3)

# A bake of radiance transfer: the directions of a set by their number in it, the others by slot (lamps by sample).
TRANSFER_DIRECTION_DIMENSION = wp.constant(0)
TRANSFER_TURN_DIMENSION = wp.constant(1)  # turn of the slot's set about the normal (random)
TRANSFER_LAMP_DIMENSION = wp.constant(2)  # which lamp, and its further digits (random),
TRANSFER_POINT_DIMENSION = wp.constant(3)  # and the point on it
TRANSFER_RAY_DIMENSION = wp.constant(4)  # ray that may find a lamp

# Pixels lit by transfer textures, beside paths from there and from what their rays meet.
TRANSFER_LOBE_DIMENSION = wp.constant(2004)  # the ray of a sharp lobe
TRANSFER_SUN_DIMENSION = wp.constant(2005)  # the place on the discs of suns, by camera sample
TRANSFER_HIT_SUN_DIMENSION = wp.constant(2006)  # and for what the ray of a sharp lobe meets

# Pixels lit by a visibility field.
FIELD_BSDF_DIMENSION = wp.constant(101)  # the direction by the BSDF; random: which of these samples are verified
FIELD_LIGHT_DIMENSION = wp.constant(102)  # which light samples are verified (random)
FIELD_LOBE_DIMENSION = wp.constant(103)  # which lobe of a glossy surface (random)
FIELD_SET_DIMENSION = wp.constant(104)  # which set of light samples a pixel takes (random)

# Pixels on which visibility polygons leave light to rays.
POLYGON_SKY_DIMENSION = wp.constant(105)  # the sky sample; random: its further digits
POLYGON_DIRECTION_DIMENSION = wp.constant(106)  # the direction by the BSDF
POLYGON_LOBE_DIMENSION = wp.constant(107)  # and its lobe (1d)
POLYGON_PATCH_DIMENSION = wp.constant(108)  # the point in the sky sample's patch (random): this one and the one after
POLYGON_EXACT_DIMENSION = wp.constant(110)  # whether a pixel's light is integrated exactly, too (random)

# Launches of techniques that have no lines here: from this dimension on, up to 999 of them.
OWN_DIMENSION = wp.constant(3000)

# ---- numbers ----

_INTEGER_CODE = """
typedef unsigned int Word;
struct Bits {
    static CUDA_CALLABLE inline Word reverse(Word x) {
#if defined(__CUDA_ARCH__)
        return __brev(x);
#else
        return __builtin_bitreverse32(x);
#endif
    }
    static CUDA_CALLABLE inline Word hash(Word x) {
        x ^= x >> 16; x *= 0x21f0aaadu; x ^= x >> 15; x *= 0x735a2d97u; x ^= x >> 15;
        return x;
    }
    // Laine-Karras permutation: flips each bit by a hash of the bits below it.
    static CUDA_CALLABLE inline Word scramble(Word x, Word seed) {
        x ^= x * 0x3d20adeau; x += seed; x *= (seed >> 16) | 1u;
        x ^= x * 0x05526c56u; x ^= x * 0x53a22864u;
        return x;
    }
    // Second Sobol dimension, bit-reversed: the Pascal matrix modulo 2 in five steps.
    static CUDA_CALLABLE inline Word pascal(Word x) {
        x ^= (x >> 16); x ^= (x & 0xff00ff00u) >> 8; x ^= (x & 0xf0f0f0f0u) >> 4;
        x ^= (x & 0xccccccccu) >> 2; x ^= (x & 0xaaaaaaaau) >> 1;
        return x;
    }
    static CUDA_CALLABLE inline float unit(Word x) { return (float)(x >> 8) * 5.9604644775390625e-8f; }
};
"""


# A well-mixed 32-bit hash (lowbias32 by Wellons).
@wp.func_native(snippet=_INTEGER_CODE + "return Bits::hash(value);")
def hash_uint(value: wp.uint32) -> wp.uint32: ...


# Morton code of a pixel: x in the even bits, y in the odd bits.
@wp.func_native(
    snippet="""
    typedef unsigned int Word;
    Word code = 0;
    for (int i = 0; i < 16; ++i)
        code |= ((Word(x) >> i) & 1u) << (2 * i) | ((Word(y) >> i) & 1u) << (2 * i + 1);
    return code;
"""
)
def morton_code(x: wp.int32, y: wp.int32) -> wp.uint32: ...


# Point of one dimension pair in [0, 1)^2: `index` counts samples along the Morton
# curve of the pixels (pixel_sample_index), `dimension` names the pair.
@wp.func_native(
    snippet=_INTEGER_CODE
    + """
    const Word key = Bits::hash(seed ^ Bits::hash(Word(dimension) + 0x9e3779b9u));
    const Word i = Bits::reverse(Bits::scramble(Bits::reverse(index), key));
    const Word a = Bits::reverse(Bits::scramble(i, Bits::hash(key + 1u)));
    const Word b = Bits::reverse(Bits::scramble(Bits::pascal(i), Bits::hash(key + 2u)));
    return wp::vec_t<2, float>(Bits::unit(a), Bits::unit(b));
"""
)
def sample_2d(index: wp.uint32, seed: wp.uint32, dimension: wp.int32) -> wp.vec2: ...


# Number of one dimension in [0, 1).
@wp.func_native(
    snippet=_INTEGER_CODE
    + """
    const Word key = Bits::hash(seed ^ Bits::hash(Word(dimension) + 0x9e3779b9u));
    const Word i = Bits::reverse(Bits::scramble(Bits::reverse(index), key));
    return Bits::unit(Bits::reverse(Bits::scramble(i, Bits::hash(key + 1u))));
"""
)
def sample_1d(index: wp.uint32, seed: wp.uint32, dimension: wp.int32) -> wp.float32: ...


# Number in [0, 1) that is only random: for decisions that gain nothing from being stratified.
@wp.func_native(
    snippet=_INTEGER_CODE
    + """
    return Bits::unit(Bits::hash(index ^ Bits::hash(seed + Bits::hash((Word)dimension + 0x85ebca6bu))));
"""
)
def random_1d(index: wp.uint32, seed: wp.uint32, dimension: wp.int32) -> wp.float32: ...


PAIR_SALT = wp.constant(wp.uint32(0x9E3779B9))
NUMBER_SALT = wp.constant(wp.uint32(0x85EBCA6B))


# The hashes of seed and dimension within sample_2d, and within random_1d, for code that draws many numbers.
@wp.func
def pair_keys(seed: wp.uint32, dimension: wp.int32) -> wp.vec3ui:
    key = hash_uint(seed ^ hash_uint(wp.uint32(dimension) + PAIR_SALT))
    return wp.vec3ui(key, hash_uint(key + wp.uint32(1)), hash_uint(key + wp.uint32(2)))


@wp.func
def random_key(seed: wp.uint32, dimension: wp.int32) -> wp.uint32:
    return hash_uint(seed + hash_uint(wp.uint32(dimension) + NUMBER_SALT))


# (cos, sin) of 2 pi u for u in [0, 1]; polynomials, so no call breaks a loop, and every machine agrees.
@wp.func
def circle(u: wp.float32) -> wp.vec2:
    quarter = wp.floor(4.0 * u + 0.5)
    a = (u - 0.25 * quarter) * (2.0 * wp.pi)  # in [-pi/4, pi/4]
    a2 = a * a
    c = 1.0 + a2 * (-0.5 + a2 * (4.166664568e-2 + a2 * (-1.388731625e-3 + a2 * 2.443315711e-5)))
    s = a * (1.0 + a2 * (-1.666666546e-1 + a2 * (8.332160873e-3 + a2 * -1.951529589e-4)))
    k = wp.int32(quarter) & 3
    if k == 0:
        return wp.vec2(c, s)
    if k == 1:
        return wp.vec2(-s, c)
    if k == 2:
        return wp.vec2(-c, -s)
    return wp.vec2(s, -c)


# Index in the sequence of sample `sample` of a pixel with 2^sample_bits samples reserved.
# Pixels 2^((32 - sample_bits) / 2) apart share indices; `pixel_seed` tells them apart.
@wp.func
def pixel_sample_index(x: wp.int32, y: wp.int32, sample: wp.int32, sample_bits: wp.int32) -> wp.uint32:
    return (morton_code(x, y) << wp.uint32(sample_bits)) + wp.uint32(sample)


@wp.func
def pixel_seed(x: wp.int32, y: wp.int32, sample_bits: wp.int32, seed: wp.uint32) -> wp.uint32:
    if sample_bits == 0:
        return seed
    overflow = morton_code(x, y) >> wp.uint32(32 - sample_bits)
    if overflow == wp.uint32(0):
        return seed
    return hash_uint(seed + overflow)


# Cosine-weighted direction about +z (Malley's method); pdf = z / pi.
@wp.func
def cosine_direction(u: wp.vec2) -> wp.vec3:
    c = circle(u[1]) * wp.sqrt(u[0])
    return wp.vec3(c[0], c[1], wp.sqrt(wp.max(0.0, 1.0 - u[0])))


# Barycentric weights of the second and third corner, uniform over the triangle.
@wp.func
def triangle_barycentrics(u: wp.vec2) -> wp.vec2:
    root = wp.sqrt(u[0])
    return wp.vec2(root * (1.0 - u[1]), root * u[1])


# Offset in pixels from the centre: a box filter is uniform in [-0.5, 0.5), a tent has radius 1.
@wp.func
def filter_offset(tent: wp.int32, u: wp.float32) -> wp.float32:
    if tent == 0:
        return u - 0.5
    if u < 0.5:
        return wp.sqrt(2.0 * u) - 1.0
    return 1.0 - wp.sqrt(2.0 * (1.0 - u))


# Rotation whose third column is the unit vector n (Duff et al. 2017).
@wp.func
def frame_of(n: wp.vec3) -> wp.mat33:
    sign = float(1.0)
    if n[2] < 0.0:
        sign = -1.0
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    s = wp.vec3(1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0])
    t = wp.vec3(b, sign + n[1] * n[1] * a, -n[1])
    return wp.matrix_from_cols(s, t, n)


# Number k of `looks` places that are spread evenly over `count`, of which there are no fewer.
@wp.func
def spread_place(k: wp.int32, looks: wp.int32, count: wp.int32) -> wp.int32:
    return wp.int32(wp.int64(k) * wp.int64(count) / wp.int64(looks))


# Balance heuristic for one sample of each of two strategies.
@wp.func
def balance(pdf: wp.float32, other_pdf: wp.float32) -> wp.float32:
    return pdf / (pdf + other_pdf)
