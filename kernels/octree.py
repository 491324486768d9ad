"""An octree over the samples of a frame, whose leaves hold what is learnt of the light there.

Layout of temporal_reuse.txt, section 6.1: an inner node is one word, the index of its first inner child (24 bits)
above a mask of its children that are leaves (8 bits); inner children lie side by side without gaps; leaf `octant`
of node `node` has the index 8 node + octant. Node 0 is the root, always inner.

Cells are addressed by Morton codes of 30 bits: the topmost three name the octant of the root. Samples are sorted by
the code of their point, so any cell, of any size, of this tree or of the previous one, is a range of them. That
replaces the paper's counters and lets a tree grow by as many levels in a frame as there are samples for: a cell is
an inner node if it holds more than `split` samples, or if it was one and still holds `collapse` (section 6.2).
Passes: `mark_children` and `place_children` for each level (mark, rebuild), `augment_leaves` (neighbours),
`find_origins` (correspondence with the previous tree).
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

LEVELS = 10  # levels of cells below the root's; codes have three bits for each
SIDE = wp.constant(1 << LEVELS)  # finest cells along an edge
TOP_SHIFT = wp.constant(3 * (LEVELS - 1))
EMPTY_CODE = wp.constant(wp.uint32(0xFFFFFFFF))
NEIGHBOURS = wp.constant(6)


@wp.struct
class Octree:
    nodes: wp.array(dtype=wp.uint32)  # [node] first inner child << 8 | mask of leaves
    low: wp.vec3  # corner of the cube
    scale: wp.float32  # finest cells per metre


# What is known of a tree while and after it is built.
@wp.struct
class OctreeNodes:
    nodes: wp.array(dtype=wp.uint32)  # [node] Octree.nodes
    prefixes: wp.array(dtype=wp.uint32)  # [node] lowest code of a point in its cell
    levels: wp.array(dtype=wp.int32)  # [node] level of its cell; the root has 0
    parents: wp.array(dtype=wp.int32)  # [node] 8 * parent + octant; -1 for the root
    previous: wp.array(dtype=wp.int32)  # [node] the same cell's node in the previous tree; or -1 - its leaf there
    inner: wp.array(dtype=wp.int32)  # [node] number of inner children, then their running sum within a level
    starts: wp.array(dtype=wp.int32)  # [8 * node + octant] first sample in the child's cell
    counts: wp.array(dtype=wp.int32)  # [8 * node + octant] number of samples in the child's cell


# Every third bit of ten, for Morton codes.
@wp.func
def spread_bits(x: wp.uint32) -> wp.uint32:
    b = (x | (x << wp.uint32(16))) & wp.uint32(0x030000FF)
    b = (b | (b << wp.uint32(8))) & wp.uint32(0x0300F00F)
    b = (b | (b << wp.uint32(4))) & wp.uint32(0x030C30C3)
    return (b | (b << wp.uint32(2))) & wp.uint32(0x09249249)


# Inverse of spread_bits.
@wp.func
def gather_bits(x: wp.uint32) -> wp.uint32:
    b = x & wp.uint32(0x09249249)
    b = (b | (b >> wp.uint32(2))) & wp.uint32(0x030C30C3)
    b = (b | (b >> wp.uint32(4))) & wp.uint32(0x0300F00F)
    b = (b | (b >> wp.uint32(8))) & wp.uint32(0x030000FF)
    return (b | (b >> wp.uint32(16))) & wp.uint32(0x000003FF)


@wp.func
def morton_code_3d(x: wp.int32, y: wp.int32, z: wp.int32) -> wp.uint32:
    code = spread_bits(wp.uint32(x)) | (spread_bits(wp.uint32(y)) << wp.uint32(1))
    return code | (spread_bits(wp.uint32(z)) << wp.uint32(2))


# Code of the finest cell that holds a point; points outside of the cube belong to the nearest cell.
@wp.func
def cell_code(octree: Octree, position: wp.vec3) -> wp.uint32:
    p = (position - octree.low) * octree.scale
    last = wp.float32(SIDE - 1)
    x = wp.int32(wp.clamp(p[0], 0.0, last))
    y = wp.int32(wp.clamp(p[1], 0.0, last))
    z = wp.int32(wp.clamp(p[2], 0.0, last))
    return morton_code_3d(x, y, z)


# Middle of the finest cell with a code.
@wp.func
def code_position(octree: Octree, code: wp.uint32) -> wp.vec3:
    x = gather_bits(code)
    y = gather_bits(code >> wp.uint32(1))
    z = gather_bits(code >> wp.uint32(2))
    cell = wp.vec3(wp.float32(x) + 0.5, wp.float32(y) + 0.5, wp.float32(z) + 0.5)
    return octree.low + cell / octree.scale


@wp.func_native(
    snippet="""
#if defined(__CUDA_ARCH__)
    return __popc(value);
#else
    return __builtin_popcount(value);
#endif
"""
)
def count_ones(value: wp.uint32) -> wp.int32: ...


@wp.func
def is_leaf(node: wp.uint32, octant: wp.int32) -> wp.bool:
    return ((node >> wp.uint32(octant)) & wp.uint32(1)) != wp.uint32(0)


# Node of an inner child.
@wp.func
def inner_child(node: wp.uint32, octant: wp.int32) -> wp.int32:
    before = (~node) & ((wp.uint32(1) << wp.uint32(octant)) - wp.uint32(1))
    return wp.int32(node >> wp.uint32(8)) + count_ones(before & wp.uint32(255))


# Leaf that holds a code.
@wp.func
def octree_leaf(nodes: wp.array(dtype=wp.uint32), code: wp.uint32) -> wp.int32:
    index = int(0)
    shift = int(TOP_SHIFT)
    while True:
        octant = wp.int32((code >> wp.uint32(shift)) & wp.uint32(7))
        node = nodes[index]
        if shift == 0 or is_leaf(node, octant):
            return index * 8 + octant
        index = inner_child(node, octant)
        shift -= 3
    return -1


# First of sorted codes in [begin, end) that is not below `code`.
@wp.func
def lower_bound(codes: wp.array(dtype=wp.int32), begin: wp.int32, end: wp.int32, code: wp.uint32) -> wp.int32:
    low = begin
    high = end
    while low < high:
        middle = (low + high) / 2
        if wp.uint32(codes[middle]) < code:
            low = middle + 1
        else:
            high = middle
    return low


# Thread: an inner node of the level that begins at node `begin`. Counts the samples of its children, and decides
# which of them are leaves.
@wp.kernel
def mark_children(
    first: wp.int32,
    tree: OctreeNodes,
    previous: wp.array(dtype=wp.uint32),
    codes: wp.array(dtype=wp.int32),
    begin: wp.int32,
    split: wp.int32,
    collapse: wp.int32,
):
    index = begin + first + wp.tid()
    level = tree.levels[index]
    shift = wp.uint32(TOP_SHIFT - 3 * level)
    start = int(0)
    end = codes.shape[0]
    parent = tree.parents[index]
    if parent >= 0:
        start = tree.starts[parent]
        end = start + tree.counts[parent]
    was = wp.uint32(255)
    if tree.previous[index] >= 0:
        was = previous[tree.previous[index]]
    mask = wp.uint32(0)
    for octant in range(8):
        stop = end
        if octant < 7:
            stop = lower_bound(codes, start, end, tree.prefixes[index] + (wp.uint32(octant + 1) << shift))
        count = stop - start
        tree.starts[index * 8 + octant] = start
        tree.counts[index * 8 + octant] = count
        stays = not is_leaf(was, octant) and count >= collapse
        if level == LEVELS - 1 or not (stays or count > split):
            mask = mask | (wp.uint32(1) << wp.uint32(octant))
        start = stop
    tree.nodes[index] = mask
    tree.inner[index] = 8 - count_ones(mask)


# Thread: an inner node of the level of nodes [begin, end). Places its inner children in the next level.
@wp.kernel
def place_children(
    first: wp.int32, tree: OctreeNodes, previous: wp.array(dtype=wp.uint32), begin: wp.int32, end: wp.int32
):
    index = begin + first + wp.tid()
    mask = tree.nodes[index]
    child = end
    if index > begin:
        child = end + tree.inner[index - 1]
    tree.nodes[index] = (wp.uint32(child) << wp.uint32(8)) | mask
    level = tree.levels[index]
    shift = wp.uint32(TOP_SHIFT - 3 * level)
    was = tree.previous[index]
    for octant in range(8):
        if not is_leaf(mask, octant):
            tree.prefixes[child] = tree.prefixes[index] + (wp.uint32(octant) << shift)
            tree.levels[child] = level + 1
            tree.parents[child] = index * 8 + octant
            origin = was  # a leaf of the previous tree holds all of the node
            if was >= 0:
                node = previous[was]
                origin = -1 - (was * 8 + octant)
                if not is_leaf(node, octant):
                    origin = inner_child(node, octant)
            tree.previous[child] = origin
            child += 1


# Centre of a leaf's cell, and half of its diagonal, metres.
@wp.func
def leaf_cell(octree: Octree, tree: OctreeNodes, leaf: wp.int32) -> wp.vec4:
    index = leaf / 8
    level = tree.levels[index]
    prefix = tree.prefixes[index] + (wp.uint32(leaf - index * 8) << wp.uint32(TOP_SHIFT - 3 * level))
    half = 0.5 * wp.float32(1 << (LEVELS - 1 - level))
    x = wp.float32(gather_bits(prefix)) + half
    y = wp.float32(gather_bits(prefix >> wp.uint32(1))) + half
    z = wp.float32(gather_bits(prefix >> wp.uint32(2))) + half
    center = octree.low + wp.vec3(x, y, z) / octree.scale
    return wp.vec4(center[0], center[1], center[2], half * 1.7320508 / octree.scale)


# Thread: a leaf (or the place of one). Finds the leaves beyond its six faces, x- x+ y- y+ z- z+: -1 where there is
# none, where cells are smaller, and for places without a leaf.
@wp.kernel
def augment_leaves(first: wp.int32, tree: OctreeNodes, neighbours: wp.array(dtype=wp.int32)):
    leaf = first + wp.tid()
    index = leaf / 8
    octant = leaf - index * 8
    level = tree.levels[index]
    is_there = is_leaf(tree.nodes[index], octant)
    prefix = tree.prefixes[index] + (wp.uint32(octant) << wp.uint32(TOP_SHIFT - 3 * level))
    edge = 1 << (LEVELS - 1 - level)
    for face in range(6):
        x = wp.int32(gather_bits(prefix))
        y = wp.int32(gather_bits(prefix >> wp.uint32(1)))
        z = wp.int32(gather_bits(prefix >> wp.uint32(2)))
        step = wp.where(face % 2 == 0, -edge, edge)
        if face / 2 == 0:
            x += step
        elif face / 2 == 1:
            y += step
        else:
            z += step
        found = int(-1)
        if is_there and wp.min(x, wp.min(y, z)) >= 0 and wp.max(x, wp.max(y, z)) < SIDE:
            found = octree_leaf(tree.nodes, morton_code_3d(x, y, z))
            if tree.levels[found / 8] > level:
                found = -1
        neighbours[leaf * NEIGHBOURS + face] = found


# Thread: a leaf (or the place of one). Finds the leaf of the previous tree whose knowledge it takes over: the one
# that holds it, or of those that it holds the one with the most samples now; -1 for places without a leaf. And sets
# the samples of leaves, none for such places.
@wp.kernel
def find_origins(
    first: wp.int32,
    tree: OctreeNodes,
    previous: wp.array(dtype=wp.uint32),
    codes: wp.array(dtype=wp.int32),
    origins: wp.array(dtype=wp.int32),
    counts: wp.array(dtype=wp.int32),
):
    leaf = first + wp.tid()
    index = leaf / 8
    octant = leaf - index * 8
    if not is_leaf(tree.nodes[index], octant):
        origins[leaf] = -1
        counts[leaf] = 0
        return
    counts[leaf] = tree.counts[leaf]
    was = tree.previous[index]
    if was < 0:
        origins[leaf] = -1 - was
        return
    shift = int(TOP_SHIFT - 3 * tree.levels[index])
    prefix = tree.prefixes[index] + (wp.uint32(octant) << wp.uint32(shift))
    start = tree.starts[leaf]
    end = start + tree.counts[leaf]
    best = octant
    while not is_leaf(previous[was], best):
        was = inner_child(previous[was], best)
        shift -= 3
        most = int(-1)
        from_here = start
        best_start = start
        best_end = end
        for child in range(8):
            stop = end
            if child < 7:
                stop = lower_bound(codes, from_here, end, prefix + (wp.uint32(child + 1) << wp.uint32(shift)))
            if stop - from_here > most:
                most = stop - from_here
                best = child
                best_start = from_here
                best_end = stop
            from_here = stop
        prefix = prefix + (wp.uint32(best) << wp.uint32(shift))
        start = best_start
        end = best_end
    origins[leaf] = was * 8 + best
