"""Discrete visibility fields (dvf.txt): what the surfaces in a grid cell see of the sky, and the rays that ask it.

A cell holds two bits for each texel of an octahedral map: whether some surface sample in the cell saw the sky
through the texel (the visibility mask, Eq. 5), and whether some sample found it occluded (the occlusion mask, Eq. 6).
Eq. 1 and 2 say "all samples", but the OR of Eq. 5 and 6 is what makes a cleared bit a promise: a texel with one bit
is surely visible or surely occluded, one with both is mixed, one with none was never looked at; the last two are
traced.

Rays come eight at a time, an octet: their directions, texels and bits are worked out in vectors of eight on the CPU,
one by one on CUDA, from the same text.
"""

import warp as wp

from warp_gi.kernels.bvh import bvh_occluded, bvh_occluder
from warp_gi.kernels.octahedral import octahedral_encode, octahedral_texel
from warp_gi.kernels.sampling import (
    SET_COSINE_DIMENSION,
    SET_TURN_DIMENSION,
    circle,
    cosine_direction,
    hash_uint,
    sample_1d,
    sample_2d,
)
from warp_gi.kernels.types import Bvh

wp.set_module_options({"enable_backward": False})

VISIBLE = wp.constant(1)  # bit of a texel: some sample saw the sky; and the next: some sample did not
OCCLUDED = wp.constant(2)
TEXELS_A_WORD = wp.constant(16)
SLOT_BITS = wp.constant(0x1FFFFFFF)
SLOT_BOXED = wp.constant(0x40000000)  # the cell was baked without the boxes of moving objects
SLOT_LABEL = wp.constant(0x20000000)  # the occlusion label, Eq. 8
NO_SLOT = wp.constant(-1)
HASH_FACTOR = wp.constant(wp.uint32(2654435769))

MODE_THREE_STATE = wp.constant(0)
MODE_UNBIASED = wp.constant(1)
MODE_PAPER = wp.constant(2)

vec33 = wp.types.vector(length=33, dtype=wp.float32)
vec6 = wp.types.vector(length=6, dtype=wp.float32)


@wp.struct
class VisibilityGrid:
    low: wp.vec3  # corner of cell 0, metres
    cell_size: wp.float32  # metres
    nx: wp.int32  # cells along x; and the next two along y and z
    ny: wp.int32
    nz: wp.int32
    resolution: wp.int32  # texels along a side of a map
    words: wp.int32  # 32-bit words of a cell's map
    slots: wp.array(dtype=wp.int32)  # [cell], x fastest: slot in `masks` with SLOT_* flags; -1: not baked
    masks: wp.array(dtype=wp.uint32)  # [slot * words] two bits a texel


# What goes with a grid into kernels: how it is used, samples, boxes of movers, and hints for the rays that are traced.
@wp.struct
class FieldQuery:
    mode: wp.int32  # MODE_*
    verify: wp.float32  # share of sure rays that MODE_UNBIASED traces
    cosines: wp.array2d(dtype=wp.float32)  # [3, sets * set_size + 8] cosine-weighted directions about +z, set by set
    set_size: wp.int32
    set_count: wp.int32
    hints: wp.array(dtype=wp.int32)  # [power of two] for hinted_occluded, any thread may write; empty: no hints
    boxes: wp.array(dtype=wp.vec3)  # [2 * box] low and high corner of each object that moves, metres
    moving: wp.array(dtype=wp.int32)  # [object] 1 if cells with SLOT_BOXED do not know its surfaces; empty if none


# Cell of a point, or -1 outside of the grid.
@wp.func
def cell_of(grid: VisibilityGrid, point: wp.vec3) -> wp.int32:
    p = (point - grid.low) / grid.cell_size
    if p[0] < 0.0 or p[1] < 0.0 or p[2] < 0.0:
        return -1
    x = wp.int32(p[0])
    y = wp.int32(p[1])
    z = wp.int32(p[2])
    if x >= grid.nx or y >= grid.ny or z >= grid.nz:
        return -1
    return (z * grid.ny + y) * grid.nx + x


# The slot, with flags, of the cell around a ray's origin; bake and lookup both ask with the offset origin.
@wp.func
def slot_at(grid: VisibilityGrid, point: wp.vec3) -> wp.int32:
    cell = cell_of(grid, point)
    if cell < 0 or grid.slots.shape[0] == 0:
        return NO_SLOT
    return grid.slots[cell]


# VISIBLE | OCCLUDED bits of a texel of the map that starts at word `start`.
@wp.func
def state_in(masks: wp.array(dtype=wp.uint32), start: wp.int32, texel: wp.int32) -> wp.uint32:
    return (masks[start + texel / TEXELS_A_WORD] >> wp.uint32(2 * (texel % TEXELS_A_WORD))) & wp.uint32(3)


# VISIBLE | OCCLUDED bits of a texel; 0 in a cell without a slot.
@wp.func
def texel_state(grid: VisibilityGrid, slot: wp.int32, texel: wp.int32) -> wp.int32:
    if slot < 0:
        return 0
    return wp.int32(state_in(grid.masks, (slot & SLOT_BITS) * grid.words, texel))


# Whether the ray meets the box of something that moves.
@wp.func
def meets_box(query: FieldQuery, origin: wp.vec3, direction: wp.vec3) -> wp.bool:
    for i in range(query.boxes.shape[0] / 2):
        low = query.boxes[2 * i] - origin
        high = query.boxes[2 * i + 1] - origin
        enter = float(0.0)
        leave = float(wp.inf)
        for axis in range(3):
            d = direction[axis]
            if wp.abs(d) < 1.0e-9:
                d = 1.0e-9
            a = low[axis] / d
            b = high[axis] / d
            enter = wp.max(enter, wp.min(a, b))
            leave = wp.min(leave, wp.max(a, b))
        if enter <= leave * 1.00001 + 1.0e-6:
            return True
    return False


# Whether the sky is occluded, tracing the ray, after what was in the way of the last ray with this key. Threads share
# the hints and may overwrite each other's: that changes what an answer costs, never the answer.
@wp.func
def hinted_occluded(bvh: Bvh, query: FieldQuery, key: wp.int32, origin: wp.vec3, direction: wp.vec3) -> wp.bool:
    if query.hints.shape[0] == 0:
        return bvh_occluded(bvh, origin, direction, float(wp.inf)) != 0
    index = wp.int32((wp.uint32(key) * HASH_FACTOR) >> wp.uint32(8)) & (query.hints.shape[0] - 1)
    hint = query.hints[index]
    found = bvh_occluder(bvh, origin, direction, float(wp.inf), hint)
    if found != 0 and found != hint + 1:
        query.hints[index] = found - 1
    return found != 0


# Eight lanes of native code at once, or one after the other on CUDA.
LANES = """
#if defined(__CUDA_ARCH__)
    typedef float F;
    typedef int I;
    typedef unsigned int U;
    const int lanes = 1;
    #define TO_F(x) ((float)(x))
    #define TO_I(x) ((int)(x))
    #define ROOT(x) sqrtf(x)
    #define AT(x, lane) (x)
    #define CONTRACT
    #define COPY memcpy
#else
    typedef float F __attribute__((vector_size(32)));
    typedef int I __attribute__((vector_size(32)));
    typedef unsigned int U __attribute__((vector_size(32)));
    typedef bool B8 __attribute__((ext_vector_type(8)));
    const int lanes = 8;
    #define TO_F(x) __builtin_convertvector(x, F)
    #define TO_I(x) __builtin_convertvector(x, I)
    #define ROOT(x) __builtin_elementwise_sqrt(x)
    #define AT(x, lane) ((x)[lane])
    #define COPY __builtin_memcpy
    #define CONTRACT _Pragma("clang fp contract(fast)")
#endif
    #define ABS(x) ((x) < 0.0f ? -(x) : (x))
"""
LANES_END = """
    #undef TO_F
    #undef TO_I
    #undef ROOT
    #undef AT
    #undef COPY
    #undef CONTRACT
    #undef ABS
    ;
"""


# Texels of the directions x, y, z, into `result`, and which of them are known to be visible or occluded.
OCTET_TEXELS = """
        // octahedral_encode and octahedral_texel
        const float half = 0.5f * (float)grid.resolution;
        const F scale = half / (ABS(x) + ABS(y) + ABS(z));
        const F px = x * scale, pz = z * scale;
        const F fx = half - ABS(pz), fz = half - ABS(px);
        const F column = half + (y < 0.0f ? (x < 0.0f ? -fx : fx) : px);
        const F row = half + (y < 0.0f ? (z < 0.0f ? -fz : fz) : pz);
        const int last = grid.resolution - 1;
        I i = TO_I(column), j = TO_I(row);
        i = i > last ? last + (i & 0) : i;
        j = j > last ? last + (j & 0) : j;
        i = i < 0 ? (i & 0) : i;
        j = j < 0 ? (j & 0) : j;
        const I texel = j * grid.resolution + i;
        const F number = TO_F(texel);
        COPY(&result.c[24 + lane], &number, sizeof(F));
        if (slot >= 0) {
            const unsigned* map = grid.masks.data + (long long)(slot & 0x1fffffff) * grid.words;
            const I word = texel >> 4;
            U state;
#if defined(__CUDA_ARCH__)
            state = map[word] >> (U)(2 * (texel & 15));
            visible |= (state & 1u) << lane;
            occluded |= ((state >> 1) & 1u) << lane;
#else
            for (int k = 0; k < 8; ++k) state[k] = map[word[k]];
            state >>= (U)(2 * (texel & 15));
            visible = __builtin_bit_cast(unsigned char, __builtin_convertvector((state & 1u) != 0, B8));
            occluded = __builtin_bit_cast(unsigned char, __builtin_convertvector((state & 2u) != 0, B8));
#endif
        }
"""


# Eight cosine-weighted rays, from number `start` of the sets on, turned by `frame`: x, y and z of their directions,
# their texels (as floats), and, as the bits of the last float, which are visible (bits 0 to 7), occluded (8 to 15),
# and above the plane of `normal` (16 to 23).
@wp.func_native(
    LANES
    + """
    wp::vec_t<33, float> result;
    const float* sets = cosines.data + start;
    const int rows = cosines.shape[1];
    unsigned visible = 0, occluded = 0, above = 0;
    for (int lane = 0; lane < 8; lane += lanes) {
        CONTRACT
        F lx, ly, lz;
        COPY(&lx, sets + lane, sizeof(F));
        COPY(&ly, sets + rows + lane, sizeof(F));
        COPY(&lz, sets + 2 * rows + lane, sizeof(F));
        const F x = frame.data[0][0] * lx + frame.data[0][1] * ly + frame.data[0][2] * lz;
        const F y = frame.data[1][0] * lx + frame.data[1][1] * ly + frame.data[1][2] * lz;
        const F z = frame.data[2][0] * lx + frame.data[2][1] * ly + frame.data[2][2] * lz;
        COPY(&result.c[lane], &x, sizeof(F));
        COPY(&result.c[8 + lane], &y, sizeof(F));
        COPY(&result.c[16 + lane], &z, sizeof(F));
"""
    + OCTET_TEXELS
    + """
        const F height = x * normal[0] + y * normal[1] + z * normal[2];
#if defined(__CUDA_ARCH__)
        above |= (unsigned)(height > 0.0f) << lane;
#else
        above = __builtin_bit_cast(unsigned char, __builtin_convertvector(height > 0.0f, B8));
#endif
    }
    const unsigned bits = visible | occluded << 8 | above << 16;
    COPY(&result.c[32], &bits, 4);
    return result;
"""
    + LANES_END
)
def cosine_octet(
    grid: VisibilityGrid,
    cosines: wp.array2d(dtype=wp.float32),
    slot: wp.int32,
    start: wp.int32,
    frame: wp.mat33,
    normal: wp.vec3,
) -> vec33: ...


# Sums over the octet's rays in `bits` of the light of a low-frequency sky (rows of `sky`: nine coefficients each of
# red, green and blue): radiance, then its squares.
@wp.func_native(
    LANES
    + """
    wp::vec_t<6, float> result;
    for (int lane = 0; lane < 8; lane += lanes) {
        CONTRACT
        F x, y, z;
        COPY(&x, &octet.c[lane], sizeof(F));
        COPY(&y, &octet.c[8 + lane], sizeof(F));
        COPY(&z, &octet.c[16 + lane], sizeof(F));
#if defined(__CUDA_ARCH__)
        const float keep = (float)((bits >> lane) & 1);
#else
        const I weights = {1, 2, 4, 8, 16, 32, 64, 128};
        const F keep = (weights & bits) != 0 ? 1.0f + (F) {} : (F) {};
#endif
        for (int channel = 0; channel < 3; ++channel) {
            const auto& k = sky.data[channel];
            const F light = keep * (0.282094792f * k[0] + 0.488602512f * (k[1] * y + k[2] * z + k[3] * x)
                + 1.092548431f * (k[4] * x * y + k[5] * y * z + k[7] * x * z)
                + 0.315391565f * k[6] * (3.0f * z * z - 1.0f) + 0.546274215f * k[8] * (x * x - y * y));
            for (int i = 0; i < lanes; ++i) {
                result.c[channel] += AT(light, i);
                result.c[3 + channel] += AT(light, i) * AT(light, i);
            }
        }
    }
    return result;
"""
    + LANES_END
)
def harmonic_light(sky: wp.types.matrix(shape=(3, 9), dtype=wp.float32), octet: vec33, bits: wp.int32) -> vec6: ...


@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    return __popc(bits);
#else
    return __builtin_popcount(bits);
#endif
    ;
"""
)
def bit_count(bits: wp.int32) -> wp.int32: ...


# Index of the lowest bit that is set; bits is not 0.
@wp.func_native(
    """
#if defined(__CUDA_ARCH__)
    return __ffs(bits) - 1;
#else
    return __builtin_ctz(bits);
#endif
    ;
"""
)
def lowest_bit(bits: wp.int32) -> wp.int32: ...


@wp.func
def octet_bits(octet: vec33) -> wp.int32:
    return wp.cast(octet[32], wp.int32)


@wp.func
def octet_direction(octet: vec33, lane: wp.int32) -> wp.vec3:
    return wp.vec3(octet[lane], octet[8 + lane], octet[16 + lane])


@wp.func
def octet_texel(octet: vec33, lane: wp.int32) -> wp.int32:
    return wp.int32(octet[24 + lane])


@wp.func
def direction_texel(grid: VisibilityGrid, direction: wp.vec3) -> wp.int32:
    return octahedral_texel(octahedral_encode(direction), grid.resolution)


# The set that a pixel takes, and where a sample of a set (or, past its end, of the sets after it) lies.
@wp.func
def pixel_set(query: FieldQuery, seed: wp.uint32) -> wp.int32:
    return wp.int32(seed % wp.uint32(query.set_count))


@wp.func
def set_sample(query: FieldQuery, chosen: wp.int32, sample: wp.int32) -> wp.int32:
    return (chosen + sample / query.set_size) % query.set_count * query.set_size + sample % query.set_size


# A frame turned about its third column, `turn` in [0, 1). That of pixels is spread over neighbours, not just random.
@wp.func
def turned_frame(frame: wp.mat33, turn: wp.float32) -> wp.mat33:
    c = circle(turn)
    return frame * wp.mat33(c[0], -c[1], 0.0, c[1], c[0], 0.0, 0.0, 0.0, 1.0)


@wp.func
def pixel_turn(morton: wp.uint32, seed: wp.uint32) -> wp.float32:
    return sample_1d(morton, seed, SET_TURN_DIMENSION)


# The seed of a pixel's own random numbers.
@wp.func
def own_seed(morton: wp.uint32, seed: wp.uint32) -> wp.uint32:
    return hash_uint(seed ^ hash_uint(morton))


# Thread: a sample of a set. A pixel takes one set, so each set is well spread.
@wp.kernel
def draw_cosines(first: wp.int32, seed: wp.uint32, query: FieldQuery):
    k = first + wp.tid()
    d = cosine_direction(sample_2d(wp.uint32(k), seed, SET_COSINE_DIMENSION))
    for row in range(3):
        query.cosines[row, k] = d[row]
