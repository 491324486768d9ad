"""Compressed directional quadtrees: sampling densities over the sphere in 32 to 128 bits.

After Dittebrandt, Hanika and Dachsbacher, "Temporal Sample Reuse for Next Event Estimation and Path Guiding for
Real-Time Path Tracing" (2020), section 5. A quadtree divides the octahedral map of the sphere; every leaf is sampled
with the same probability, so the density is high where the tree is fine.

A tree is `bits` (32, 64, 96 or 128) nodes in breadth-first order, one bit each, 1 for an inner node; words that are
not needed are 0. The root is always inner and not stored. The root is inner node 0, the others follow in the order of
their bits, and the children of inner node j are nodes 4 j to 4 j + 3: child 4 j + q lies at +x where q & 1, at +y
where q >> 1. So a tree has bits / 4 inner nodes, counting the root, and 3 bits / 4 + 1 leaves, always.
"""

import warp as wp

from warp_gi.kernels.octahedral import octahedral_decode, octahedral_encode

wp.set_module_options({"enable_backward": False})

# Leaves have edges of at least 2^-LEVELS, so that corners, and points inside of leaves, are exact in float32.
QUADTREE_LEVELS = wp.constant(12)
FIXED_POINT = wp.constant(wp.float32(16777216.0))  # 2^24: what a float32 below 1 can hold
FIXED_POINT_SHIFT = wp.constant(wp.uint32(8))
LARGEST_FLOAT_BELOW_ONE = wp.constant(wp.float32(0.99999994))  # 1 - 2^-24
SMALLEST_STEP = wp.constant(wp.float32(5.9604644775390625e-8))  # 2^-24

_TREE_CODE = """
typedef unsigned long long Word;
struct Tree {
    Word low, high;
    CUDA_CALLABLE inline Tree(const wp::vec_t<4, unsigned int>& t)
        : low(t.c[0] | (Word)t.c[1] << 32), high(t.c[2] | (Word)t.c[3] << 32) {}
    static CUDA_CALLABLE inline int count(Word x) {
#if defined(__CUDA_ARCH__)
        return __popcll(x);
#else
        return __builtin_popcountll(x);
#endif
    }
    static CUDA_CALLABLE inline Word below(int k) { return ((Word)1 << k) - 1; }
    CUDA_CALLABLE inline int rank(int k) const {
        return k < 64 ? count(low & below(k)) : count(low) + count(high & below(k - 64));
    }
    CUDA_CALLABLE inline int bit(int k) const { return (int)((k < 64 ? low >> k : high >> (k - 64)) & 1); }
    // Place of one number i of a word that has more than i.
    static CUDA_CALLABLE inline int select_in_word(Word x, int i) {
#if !defined(__CUDA_ARCH__) && defined(__BMI2__)
        return __builtin_ctzll(__builtin_ia32_pdep_di((Word)1 << i, x));
#else
        return select_by_halves(x, i);
#endif
    }
    static CUDA_CALLABLE inline int select_by_halves(Word x, int i) {
        int place = 0;
        for (int half = 32; half > 0; half >>= 1) {
            const int ones = count(x & below(half));
            const int upper = i >= ones;
            i -= upper ? ones : 0;
            x >>= upper ? half : 0;
            place += upper ? half : 0;
        }
        return place;
    }
    CUDA_CALLABLE inline int select(int i) const {
        const int ones = count(low);
        return i < ones ? select_in_word(low, i) : 64 + select_in_word(high, i - ones);
    }
    static CUDA_CALLABLE inline Word low_below(int k) { return k < 64 ? below(k) : ~(Word)0; }
    static CUDA_CALLABLE inline Word high_below(int k) { return k <= 64 ? 0 : k < 128 ? below(k - 64) : ~(Word)0; }
    CUDA_CALLABLE inline void flip(int k) {
        low ^= k < 64 ? (Word)1 << k : 0;
        high ^= k < 64 ? 0 : (Word)1 << (k - 64);
    }
    CUDA_CALLABLE inline void remove_block(int k) {
        const Word low_kept = low_below(k), high_kept = high_below(k);
        low = (low & low_kept) | ((low >> 4 | high << 60) & ~low_kept);
        high = (high & high_kept) | (high >> 4 & ~high_kept);
    }
    CUDA_CALLABLE inline void insert_block(int k) {
        const Word low_kept = low_below(k), high_kept = high_below(k);
        const Word low_moved = low & ~low_kept, high_moved = high & ~high_kept;
        low = (low & low_kept) | low_moved << 4;
        high = (high & high_kept) | high_moved << 4 | low_moved >> 60;
    }
    CUDA_CALLABLE inline wp::vec_t<4, unsigned int> words() const {
        return wp::vec_t<4, unsigned int>((unsigned int)low, (unsigned int)(low >> 32), (unsigned int)high,
                                          (unsigned int)(high >> 32));
    }
};
"""


# A node's place in the unit square.
@wp.struct
class QuadtreeCell:
    node: wp.int32
    x: wp.float32  # lower corner
    y: wp.float32
    size: wp.float32  # edge


# A point in a leaf.
@wp.struct
class QuadtreePoint:
    uv: wp.vec2  # in [0, 1)^2
    level: wp.int32  # the leaf's edge is 2^-level


@wp.struct
class QuadtreeSample:
    direction: wp.vec3  # unit
    pdf: wp.float32  # per solid angle


def quadtree_uniform(bits: int) -> tuple[int, int, int, int]:
    """Return the most even tree as four 32-bit words: the first nodes in breadth-first order are inner.

    Raises ValueError unless ``bits`` is 32, 64, 96 or 128.
    """
    if bits not in (32, 64, 96, 128):
        raise ValueError(f"a quadtree has 32, 64, 96 or 128 bits, got {bits!r}")
    tree = (1 << (bits // 4 - 1)) - 1
    return tree & 0xFFFFFFFF, tree >> 32, 0, 0


@wp.func
def quadtree_leaf_count(bits: wp.int32) -> wp.int32:
    return 3 * (bits >> 2) + 1


# Inner nodes among those before node k.
@wp.func_native(_TREE_CODE + "return Tree(tree).rank(k);")
def quadtree_rank(tree: wp.vec4ui, k: wp.int32) -> wp.int32: ...


# Whether node k is an inner one (1) or a leaf (0).
@wp.func_native(_TREE_CODE + "return Tree(tree).bit(k);")
def quadtree_is_inner(tree: wp.vec4ui, k: wp.int32) -> wp.int32: ...


# Node that is leaf number i in breadth-first order.
@wp.func_native(
    _TREE_CODE
    + """
    Tree leaves(tree);
    leaves.low = ~leaves.low & Tree::low_below(bits);
    leaves.high = ~leaves.high & Tree::high_below(bits);
    return leaves.select(i);
"""
)
def quadtree_select0(tree: wp.vec4ui, bits: wp.int32, i: wp.int32) -> wp.int32: ...


# Node that is stored inner node number i, which is inner node i + 1 counting the root.
@wp.func_native(_TREE_CODE + "return Tree(tree).select(i);")
def quadtree_select1(tree: wp.vec4ui, i: wp.int32) -> wp.int32: ...


# Place of one number i in a word of which more than i bits are set, by popcounts of halves alone: what
# quadtree_select1 does within a word where the processor has no instruction for it.
@wp.func_native(_TREE_CODE + "return Tree::select_by_halves(word, i);")
def select_by_halves(word: wp.uint64, i: wp.int32) -> wp.int32: ...


# First child of inner node k.
@wp.func
def quadtree_children(tree: wp.vec4ui, k: wp.int32) -> wp.int32:
    return 4 * (quadtree_rank(tree, k) + 1)


# First node of a level, of edge 2^-level, or `bits` where the tree ends above it; the root alone is level 0.
# Levels follow each other in the bits, so leaves that may be split are those before level QUADTREE_LEVELS.
@wp.func
def quadtree_level_start(tree: wp.vec4ui, bits: wp.int32, level: wp.int32) -> wp.int32:
    start = int(0)
    for _i in range(1, level):
        if start < bits:
            start = quadtree_children(tree, start)
    return wp.min(start, bits)


# Leaf that holds a point, given in units of 2^-32: the node in bits 0 to 7, its level (edge 2^-level) in 8 to 15,
# and in 16 and 17 the quadrant of the leaf.
@wp.func_native(
    _TREE_CODE
    + """
    const Tree t(tree);
    const int ones = 1 + Tree::count(t.low);
    int node = 0, inner = 0, level = 0;
    while (true) {
        node = 4 * inner + (int)(x >> 31 | y >> 31 << 1);
        x <<= 1;
        y <<= 1;
        ++level;
        const Word word = node < 64 ? t.low : t.high;
        const int place = node & 63;
        if (!(word >> place & 1))
            break;
        inner = (node < 64 ? 1 : ones) + Tree::count(word & Tree::below(place));
    }
    return node | level << 8 | (int)(x >> 31 | y >> 31 << 1) << 16;
"""
)
def quadtree_descend(tree: wp.vec4ui, x: wp.uint32, y: wp.uint32) -> wp.int32: ...


# Column, row and level (edge 2^-level) of a node, from the bottom up.
@wp.func_native(
    _TREE_CODE
    + """
    const Tree t(tree);
    const int ones = Tree::count(t.low);
    int x = 0, y = 0, level = 0;
    while (true) {
        x |= (node & 1) << level;
        y |= (node >> 1 & 1) << level;
        ++level;
        const int i = (node >> 2) - 1;
        if (i < 0)
            break;
        node = i < ones ? Tree::select_in_word(t.low, i) : 64 + Tree::select_in_word(t.high, i - ones);
    }
    return wp::vec_t<3, int>(x, y, level);
"""
)
def quadtree_ascend(tree: wp.vec4ui, node: wp.int32) -> wp.vec3i: ...


# A coordinate in [0, 1] in units of 2^-32; 1 belongs to the last cell.
@wp.func
def quadtree_coordinate(u: wp.float32) -> wp.uint32:
    return wp.uint32(wp.clamp(u, 0.0, LARGEST_FLOAT_BELOW_ONE) * FIXED_POINT) << FIXED_POINT_SHIFT


@wp.func
def level_size(level: wp.int32) -> wp.float32:
    return 1.0 / wp.float32(1 << level)


# The leaf that holds a point of the unit square.
@wp.func
def quadtree_locate(tree: wp.vec4ui, bits: wp.int32, uv: wp.vec2) -> QuadtreeCell:
    x = quadtree_coordinate(uv[0])
    y = quadtree_coordinate(uv[1])
    leaf = quadtree_descend(tree, x, y)
    level = (leaf >> 8) & 255
    shift = wp.uint32(32 - level)
    cell = QuadtreeCell()
    cell.node = leaf & 255
    cell.size = level_size(level)
    cell.x = wp.float32(x >> shift) * cell.size
    cell.y = wp.float32(y >> shift) * cell.size
    return cell


# What turns a density over the unit square into one per solid angle. A direction meets the octahedron in
# q = d / (|dx| + |dy| + |dz|). A face, of normal n = (1, 1, 1) / sqrt(3) up to signs, projects along y onto the map
# of [-1, 1]^2: dA_face = sqrt(3) dA_map, and folding out the lower half changes no areas. Seen from the middle it is
# dw = dA_face (n . q / |q|) / |q|^2 with n . q = 1 / sqrt(3), so dw = dA_map / |q|^3, and dA_map = 4 du dv.
@wp.func
def octahedral_density(direction: wp.vec3) -> wp.float32:
    sum = wp.abs(direction[0]) + wp.abs(direction[1]) + wp.abs(direction[2])
    square = wp.dot(direction, direction) / (sum * sum)
    return 0.25 * square * wp.sqrt(square)


# Density over the unit square in a leaf of edge 2^-level.
@wp.func
def leaf_density(bits: wp.int32, level: wp.int32) -> wp.float32:
    return wp.float32(1 << (2 * level)) / wp.float32(quadtree_leaf_count(bits))


# Density per solid angle with which both samplers choose a direction.
@wp.func
def quadtree_pdf(tree: wp.vec4ui, bits: wp.int32, direction: wp.vec3) -> wp.float32:
    uv = octahedral_encode(direction)
    leaf = quadtree_descend(tree, quadtree_coordinate(uv[0]), quadtree_coordinate(uv[1]))
    return leaf_density(bits, (leaf >> 8) & 255) * octahedral_density(direction)


# The point at (u, v) in [0, 1)^2 of the leaf at a column and row of a level; rounding takes it over no border.
@wp.func
def point_in_leaf(column: wp.int32, row: wp.int32, level: wp.int32, u: wp.float32, v: wp.float32) -> QuadtreePoint:
    size = level_size(level)
    x = wp.min((wp.float32(column) + u) * size, wp.float32(column + 1) * size - SMALLEST_STEP)
    y = wp.min((wp.float32(row) + v) * size, wp.float32(row + 1) * size - SMALLEST_STEP)
    point = QuadtreePoint()
    point.uv = wp.vec2(x, y)
    point.level = level
    return point


@wp.func
def sample_of(bits: wp.int32, point: QuadtreePoint) -> QuadtreeSample:
    sample = QuadtreeSample()
    sample.direction = octahedral_decode(point.uv)
    sample.pdf = leaf_density(bits, point.level) * octahedral_density(sample.direction)
    return sample


# A point from a number that selects the leaf and two that select the point in it, all in [0, 1).
@wp.func
def quadtree_leaf_point(tree: wp.vec4ui, bits: wp.int32, u: wp.float32, u2: wp.vec2) -> QuadtreePoint:
    leaves = quadtree_leaf_count(bits)
    i = wp.min(wp.int32(u * wp.float32(leaves)), leaves - 1)
    place = quadtree_ascend(tree, quadtree_select0(tree, bits, i))
    return point_in_leaf(place[0], place[1], place[2], u2[0], u2[1])


# A direction, as quadtree_leaf_point.
@wp.func
def quadtree_sample_leaf(tree: wp.vec4ui, bits: wp.int32, u: wp.float32, u2: wp.vec2) -> QuadtreeSample:
    return sample_of(bits, quadtree_leaf_point(tree, bits, u, u2))


# Fills counts[base + j] for every inner node j, the root first: four bytes, leaves below child q in byte q.
@wp.func
def quadtree_counts(tree: wp.vec4ui, bits: wp.int32, counts: wp.array(dtype=wp.uint32), base: wp.int32):
    inner = bits >> 2  # number of the next inner child, which children in descending order meet in descending order
    for j in range((bits >> 2) - 1, -1, -1):
        word = wp.uint32(0)
        for q in range(3, -1, -1):
            leaves = wp.uint32(1)
            if quadtree_is_inner(tree, 4 * j + q) != 0:
                inner -= 1
                leaves = (counts[base + inner] * wp.uint32(0x01010101)) >> wp.uint32(24)  # sum of its bytes
            word |= leaves << wp.uint32(8 * q)
        counts[base + j] = word


# Number of an inner node, by its place in the tree, or -1 of a leaf.
@wp.func_native(
    _TREE_CODE
    + """
    const Tree t(tree);
    const Word word = node < 64 ? t.low : t.high;
    const int before = node < 64 ? 1 : 1 + Tree::count(t.low);
    const Word rest = word >> (node & 63);
    return rest & 1 ? before + Tree::count(word & Tree::below(node & 63)) : -1;
"""
)
def quadtree_inner_number(tree: wp.vec4ui, node: wp.int32) -> wp.int32: ...


# What is left of a number in [0, 1) whose product with the whole lies in [start, start + part), in [0, 1). Rounding
# keeps the order; clamped since it may reach 1, or fall below 0 where subtracting is fused with the multiplication.
@wp.func
def rescaled(product: wp.float32, start: wp.int32, part: wp.int32) -> wp.float32:
    return wp.clamp((product - wp.float32(start)) / wp.float32(part), 0.0, LARGEST_FLOAT_BELOW_ONE)


# A point from two numbers in [0, 1): at each inner node x selects the column and then y the row, in proportion
# to leaves. So the points that reach a leaf are a rectangle of area 1 / leaves, and are stretched over the leaf in
# order: a stratified set of points remains one. `counts` is what quadtree_counts wrote.
@wp.func
def quadtree_warp_point(
    tree: wp.vec4ui, bits: wp.int32, counts: wp.array(dtype=wp.uint32), base: wp.int32, u2: wp.vec2
) -> QuadtreePoint:
    u = u2[0]
    v = u2[1]
    inner = int(0)
    column = int(0)
    row = int(0)
    level = int(0)
    leaves = quadtree_leaf_count(bits)
    while inner >= 0:
        # selections instead of branches, which no processor could predict
        word = counts[base + inner]
        lefts = wp.int32(word & wp.uint32(0x00FF00FF))  # of the lower row in the low half, of the upper in the high one
        left = (lefts + (lefts >> 16)) & 255
        product = u * wp.float32(leaves)
        i = wp.where(product < wp.float32(left), 0, 1)
        part = wp.where(i == 0, left, leaves - left)
        u = rescaled(product, wp.where(i == 0, 0, left), part)
        low = wp.int32(word >> wp.uint32(8 * i)) & 255
        product = v * wp.float32(part)
        j = wp.where(product < wp.float32(low), 0, 1)
        leaves = wp.where(j == 0, low, part - low)
        v = rescaled(product, wp.where(j == 0, 0, low), leaves)
        column = 2 * column + i
        row = 2 * row + j
        level += 1
        inner = quadtree_inner_number(tree, 4 * inner + i + 2 * j)
    return point_in_leaf(column, row, level, u, v)


# A direction, as quadtree_warp_point.
@wp.func
def quadtree_sample_warp(
    tree: wp.vec4ui, bits: wp.int32, counts: wp.array(dtype=wp.uint32), base: wp.int32, u2: wp.vec2
) -> QuadtreeSample:
    return sample_of(bits, quadtree_warp_point(tree, bits, counts, base, u2))


# First child that leaf `leaf` will have in the tree that quadtree_migrate returns.
@wp.func
def quadtree_migrated_children(tree: wp.vec4ui, leaf: wp.int32, inner: wp.int32) -> wp.int32:
    return 4 * (quadtree_rank(tree, leaf) + 1 - wp.where(inner < leaf, 1, 0))


# The tree with `inner`, whose children are all leaves, made a leaf, and `leaf`, none of those children, split.
# `removed` and `inserted` are the first child of the one before and of the other after it.
@wp.func_native(
    _TREE_CODE
    + """
    Tree t(tree);
    t.flip(inner);
    t.remove_block(removed);
    t.flip(leaf > removed ? leaf - 4 : leaf);
    t.insert_block(inserted);
    return t.words();
"""
)
def migrate_block(
    tree: wp.vec4ui, leaf: wp.int32, inner: wp.int32, removed: wp.int32, inserted: wp.int32
) -> wp.vec4ui: ...


@wp.func
def quadtree_migrate(tree: wp.vec4ui, bits: wp.int32, leaf: wp.int32, inner: wp.int32) -> wp.vec4ui:
    removed = quadtree_children(tree, inner)
    return migrate_block(tree, leaf, inner, removed, quadtree_migrated_children(tree, leaf, inner))
