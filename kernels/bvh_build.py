"""Building the eight-wide tree of bvh.py on the CPU.

Four stages, each a kernel: triangle bounds (`bound_triangles`); a binary tree down to single triangles by binned
surface-area heuristic, in disjoint subtrees that threads share (`split_top`, `build_subtrees`), with the cost of
the best eight-wide tree over each binary node by dynamic programming (Ylitie, Karras, Laine: "Efficient
Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs", HPG 2017, section 3.1); the wide tree's topology
(`widen`); its geometry (`fill_blocks`, `fill_nodes`), which is all that a refit repeats.

Scratch, eight 32-bit words each. Reference: low x, y, z, triangle, high x, y, z, area. Binary node: low x, y, z,
triangle count, high x, y, z, triangle count of the left child (0 in a leaf, whose triangle it holds). A node over
n references lies before its left subtree's 2 n_left - 1 nodes and those before the right one's.
"""

import warp as wp

from warp_gi.kernels.bvh_build_native import BLOCK_COST, BUILD_SUBTREE, FILL_NODES, NODE_COST, SPLIT_TOP, WIDEN
from warp_gi.kernels.bvh_native import BLOCK_WORDS, FACE_MASKED, FACE_WORD, LANES, NODE_WORDS, cpu_only

wp.set_module_options({"enable_backward": False, "max_unroll": 1})  # unrolled, it compiles for 1.2 s longer

BOX_WORDS = 8  # of the scratch in which bounds travel upwards


@wp.func_native(cpu_only(SPLIT_TOP, NODE_COST=NODE_COST, BLOCK_COST=BLOCK_COST))
def split_top_native(
    refs: wp.array(dtype=wp.float32),
    nodes: wp.array(dtype=wp.float32),
    costs: wp.array(dtype=wp.float32),
    tasks: wp.array(dtype=wp.int32),
    top: wp.array(dtype=wp.int32),
    counts: wp.array(dtype=wp.int32),
    count: wp.int32,
    largest: wp.int32,
): ...


@wp.func_native(cpu_only(BUILD_SUBTREE, NODE_COST=NODE_COST, BLOCK_COST=BLOCK_COST))
def build_subtree_native(
    refs: wp.array(dtype=wp.float32),
    nodes: wp.array(dtype=wp.float32),
    tasks: wp.array(dtype=wp.int32),
    costs: wp.array(dtype=wp.float32),
    choices: wp.array(dtype=wp.uint8),
    index: wp.int32,
): ...


@wp.func_native(cpu_only(WIDEN, NODE_COST=NODE_COST, BLOCK_COST=BLOCK_COST))
def widen_native(
    nodes: wp.array(dtype=wp.float32),
    top: wp.array(dtype=wp.int32),
    counts: wp.array(dtype=wp.int32),
    costs: wp.array(dtype=wp.float32),
    choices: wp.array(dtype=wp.uint8),
    wide: wp.array(dtype=wp.uint32),
    blocks: wp.array(dtype=wp.float32),
): ...


@wp.func_native(cpu_only(FILL_NODES))
def fill_nodes_native(
    nodes: wp.array(dtype=wp.uint32),
    block_boxes: wp.array(dtype=wp.float32),
    node_boxes: wp.array(dtype=wp.float32),
    count: wp.int32,
): ...


# Scratch of a build; see the module's head. Arrays are flat.
@wp.struct
class BuildData:
    refs: wp.array(dtype=wp.float32)  # [8 * triangle]
    nodes: wp.array(dtype=wp.float32)  # [8 * binary node]
    tasks: wp.array(dtype=wp.int32)  # [4 * subtree] references from, to, first node, depth
    top: wp.array(dtype=wp.int32)  # [node] binary nodes above the subtrees, parents first
    counts: wp.array(dtype=wp.int32)  # [4] subtrees, top nodes, wide nodes (-1: not counted yet), blocks
    costs: wp.array(dtype=wp.float32)  # [8 * binary node]
    choices: wp.array(dtype=wp.uint8)  # [8 * binary node]


# Thread: one triangle.
@wp.kernel
def bound_triangles(
    first: wp.int32,
    points: wp.array(dtype=wp.vec3),
    indices: wp.array(dtype=wp.vec3i),
    refs: wp.array(dtype=wp.float32),
):
    face = first + wp.tid()
    corner = indices[face]
    p0 = points[corner[0]]
    p1 = points[corner[1]]
    p2 = points[corner[2]]
    low = wp.min(p0, wp.min(p1, p2))
    high = wp.max(p0, wp.max(p1, p2))
    for k in range(3):
        refs[8 * face + k] = low[k]
        refs[8 * face + 4 + k] = high[k]
    refs[8 * face + 3] = wp.cast(face, wp.float32)
    refs[8 * face + 7] = 0.5 * wp.length(wp.cross(p1 - p0, p2 - p0))


# One thread: splits until no range has more than `largest` triangles, and lists the ranges as tasks.
@wp.kernel
def split_top(first: wp.int32, build: BuildData, largest: wp.int32):
    split_top_native(
        build.refs,
        build.nodes,
        build.costs,
        build.tasks,
        build.top,
        build.counts,
        build.refs.shape[0] // 8,
        largest,
    )


# Thread: one task of split_top.
@wp.kernel
def build_subtrees(first: wp.int32, build: BuildData):
    build_subtree_native(
        build.refs,
        build.nodes,
        build.tasks,
        build.costs,
        build.choices,
        first + wp.tid(),
    )


# One thread: counts wide nodes and blocks in the first call, writes children and faces in the second.
@wp.kernel
def widen(
    first: wp.int32,
    build: BuildData,
    nodes: wp.array(dtype=wp.uint32),
    blocks: wp.array(dtype=wp.float32),
):
    widen_native(build.nodes, build.top, build.counts, build.costs, build.choices, nodes, blocks)


@wp.func
def has_area(p0: wp.vec3, p1: wp.vec3, p2: wp.vec3) -> wp.bool:
    a = wp.vec3d(p1) - wp.vec3d(p0)
    b = wp.vec3d(p2) - wp.vec3d(p0)
    return wp.length_sq(wp.cross(a, b)) > wp.float64(0.0)


# Thread: one block: its vertices and bounds. Zero-area triangles shrink to a point, which no ray hits.
@wp.kernel
def fill_blocks(
    first: wp.int32,
    points: wp.array(dtype=wp.vec3),
    indices: wp.array(dtype=wp.vec3i),
    face_masks: wp.array(dtype=wp.int32),
    blocks: wp.array(dtype=wp.float32),
    block_boxes: wp.array(dtype=wp.float32),
):
    block = first + wp.tid()
    start = block * BLOCK_WORDS
    low = wp.vec3(3.4e38)
    high = wp.vec3(-3.4e38)
    for lane in range(LANES):
        face = wp.cast(blocks[start + FACE_WORD + lane], wp.int32)
        p0 = wp.vec3()
        p1 = wp.vec3()
        p2 = wp.vec3()
        if face != -1:
            face = face & (FACE_MASKED - 1)
            corner = indices[face]
            p0 = points[corner[0]]
            p1 = points[corner[1]]
            p2 = points[corner[2]]
            if not has_area(p0, p1, p2):
                p1 = p0
                p2 = p0
            low = wp.min(low, wp.min(p0, wp.min(p1, p2)))
            high = wp.max(high, wp.max(p0, wp.max(p1, p2)))
            if face_masks.shape[0] > 0:
                if face_masks[face] >= 0:
                    face = face | FACE_MASKED
            blocks[start + FACE_WORD + lane] = wp.cast(face, wp.float32)
        for k in range(3):
            blocks[start + LANES * k + lane] = p0[k]
            blocks[start + LANES * (3 + k) + lane] = p1[k]
            blocks[start + LANES * (6 + k) + lane] = p2[k]
    for k in range(3):
        block_boxes[block * BOX_WORDS + k] = low[k]
        block_boxes[block * BOX_WORDS + 3 + k] = high[k]


# One thread: boxes of all nodes.
@wp.kernel
def fill_nodes(
    first: wp.int32,
    nodes: wp.array(dtype=wp.uint32),
    block_boxes: wp.array(dtype=wp.float32),
    node_boxes: wp.array(dtype=wp.float32),
):
    fill_nodes_native(nodes, block_boxes, node_boxes, nodes.shape[0] // NODE_WORDS)
