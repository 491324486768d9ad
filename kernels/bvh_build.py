"""Building the eight-wide tree of bvh.py on the CPU.

Stages, each a kernel or two: triangle bounds (`bound_triangles`); a binary tree down to single triangles by binned
surface-area heuristic, in disjoint subtrees that threads share (`split_top`, `build_subtrees`); its improvement by
reinsertion, where it is asked for (`link_nodes`, `node_areas`, `find_targets`, `move_nodes`, `flatten`); the cost of
the best eight-wide tree over each binary node by dynamic programming (`cost_nodes`; Ylitie, Karras, Laine: "Efficient
Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs", HPG 2017, section 3.1); the wide tree's topology
(`widen`); its geometry (`fill_blocks`, `fill_nodes`), which is all that a refit repeats.

Scratch, eight 32-bit words each. Reference: low x, y, z, triangle, high x, y, z, 0. Binary node: low x, y, z,
triangle count, high x, y, z, triangle count of the left child (0 in a leaf, whose triangle it holds). A node over
n references lies before its left subtree's 2 n_left - 1 nodes and those before the right one's.
"""

import warp as wp

from warp_gi.kernels.bvh_build_native import (
    BLOCK_COST,
    BUILD_SUBTREE,
    CHUNK_NODES,
    COST_NODES,
    FILL_NODES,
    NODE_COST,
    SPLIT_TOP,
    WIDEN,
)
from warp_gi.kernels.bvh_native import BLOCK_WORDS, FACE_MASKED, FACE_WORD, LANES, NODE_WORDS, cpu_only
from warp_gi.kernels.bvh_reinsert_native import FIND_TARGET, FLATTEN, LINK_NODE, MOVE_NODES

wp.set_module_options({"enable_backward": False, "max_unroll": 1})  # unrolled, it compiles for 1.2 s longer

COSTS = {"NODE_COST": NODE_COST, "BLOCK_COST": BLOCK_COST, "CHUNK_NODES": CHUNK_NODES}
BOX_WORDS = 8  # of the scratch in which bounds travel upwards


@wp.func_native(cpu_only(SPLIT_TOP, **COSTS))
def split_top_native(
    refs: wp.array(dtype=wp.float32),
    nodes: wp.array(dtype=wp.float32),
    tasks: wp.array(dtype=wp.int32),
    counts: wp.array(dtype=wp.int32),
    count: wp.int32,
    largest: wp.int32,
): ...


@wp.func_native(cpu_only(BUILD_SUBTREE, **COSTS))
def build_subtree_native(
    refs: wp.array(dtype=wp.float32),
    nodes: wp.array(dtype=wp.float32),
    tasks: wp.array(dtype=wp.int32),
    index: wp.int32,
): ...


@wp.func_native(cpu_only(LINK_NODE, **COSTS))
def link_node_native(nodes: wp.array(dtype=wp.float32), parents: wp.array(dtype=wp.int32), node: wp.int32): ...


@wp.func_native(cpu_only(FIND_TARGET, **COSTS))
def find_target_native(
    nodes: wp.array(dtype=wp.float32),
    parents: wp.array(dtype=wp.int32),
    gains: wp.array(dtype=wp.float32),
    targets: wp.array(dtype=wp.int32),
    index: wp.int32,
    start: wp.int32,
): ...


@wp.func_native(cpu_only(MOVE_NODES, **COSTS))
def move_nodes_native(
    nodes: wp.array(dtype=wp.float32),
    parents: wp.array(dtype=wp.int32),
    counts: wp.array(dtype=wp.int32),
    touched: wp.array(dtype=wp.int32),
    candidates: wp.array(dtype=wp.int32),
    targets: wp.array(dtype=wp.int32),
    order: wp.array(dtype=wp.int32),
    pass_number: wp.int32,
): ...


@wp.func_native(cpu_only(FLATTEN, **COSTS))
def flatten_native(
    nodes: wp.array(dtype=wp.float32),
    flat: wp.array(dtype=wp.float32),
    waiting: wp.array(dtype=wp.int32),
    counts: wp.array(dtype=wp.int32),
): ...


@wp.func_native(cpu_only(COST_NODES, **COSTS))
def cost_nodes_native(
    nodes: wp.array(dtype=wp.float32),
    surfaces: wp.array(dtype=wp.float32),
    costs: wp.array(dtype=wp.float32),
    choices: wp.array(dtype=wp.uint8),
    chunk: wp.int32,
): ...


@wp.func_native(cpu_only(WIDEN, **COSTS))
def widen_native(
    nodes: wp.array(dtype=wp.float32),
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
    surfaces: wp.array(dtype=wp.float32)  # [triangle] areas
    nodes: wp.array(dtype=wp.float32)  # [8 * binary node]
    tasks: wp.array(dtype=wp.int32)  # [4 * subtree] references from, to, first node, depth
    # [5] subtrees, depth after reinsertion, wide nodes (-1: not counted yet), blocks, root while nodes are linked
    counts: wp.array(dtype=wp.int32)
    costs: wp.array(dtype=wp.float32)  # [8 * binary node]
    choices: wp.array(dtype=wp.uint8)  # [8 * binary node]


# Scratch of reinsertion; see bvh_reinsert_native.py.
@wp.struct
class ReinsertData:
    nodes: wp.array(dtype=wp.float32)  # those of BuildData
    counts: wp.array(dtype=wp.int32)  # those of BuildData
    parents: wp.array(dtype=wp.int32)  # [binary node]
    touched: wp.array(dtype=wp.int32)  # [binary node + 1] the last pass that changed what is around a node
    candidates: wp.array(dtype=wp.int32)  # [candidate] nodes to move
    gains: wp.array(dtype=wp.float32)  # [candidate]
    targets: wp.array(dtype=wp.int32)  # [candidate] nodes beside which they would be, -1 for none


# Thread: one triangle.
@wp.kernel
def bound_triangles(
    first: wp.int32,
    points: wp.array(dtype=wp.vec3),
    indices: wp.array(dtype=wp.vec3i),
    refs: wp.array(dtype=wp.float32),
    surfaces: wp.array(dtype=wp.float32),
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
    refs[8 * face + 7] = 0.0
    surfaces[face] = 0.5 * wp.length(wp.cross(p1 - p0, p2 - p0))


# One thread: splits until no range has more than `largest` triangles, and lists the ranges as tasks.
@wp.kernel
def split_top(first: wp.int32, build: BuildData, largest: wp.int32):
    split_top_native(build.refs, build.nodes, build.tasks, build.counts, build.refs.shape[0] // 8, largest)


# Thread: one task of split_top.
@wp.kernel
def build_subtrees(first: wp.int32, build: BuildData):
    build_subtree_native(build.refs, build.nodes, build.tasks, first + wp.tid())


# Thread: one binary node.
@wp.kernel
def link_nodes(first: wp.int32, data: ReinsertData):
    link_node_native(data.nodes, data.parents, first + wp.tid())


# Thread: one binary node: half the area of its box.
@wp.kernel
def node_areas(first: wp.int32, nodes: wp.array(dtype=wp.float32), areas: wp.array(dtype=wp.float32)):
    n = first + wp.tid()
    x = nodes[8 * n + 4] - nodes[8 * n]
    y = nodes[8 * n + 5] - nodes[8 * n + 1]
    z = nodes[8 * n + 6] - nodes[8 * n + 2]
    areas[n] = x * y + y * z + z * x


# Thread: one candidate: its best target.
@wp.kernel
def find_targets(first: wp.int32, data: ReinsertData):
    i = first + wp.tid()
    find_target_native(data.nodes, data.parents, data.gains, data.targets, i, data.candidates[i])


# One thread: moves candidates to their targets, in order.
@wp.kernel
def move_nodes(first: wp.int32, data: ReinsertData, order: wp.array(dtype=wp.int32), pass_number: wp.int32):
    move_nodes_native(
        data.nodes, data.parents, data.counts, data.touched, data.candidates, data.targets, order, pass_number
    )


# One thread: writes the nodes in depth-first order.
@wp.kernel
def flatten(first: wp.int32, data: ReinsertData, flat: wp.array(dtype=wp.float32)):
    flatten_native(data.nodes, flat, data.touched, data.counts)


# Thread: CHUNK_NODES binary nodes, those whose subtrees lie among them; `rest` takes those of all others, one thread.
@wp.kernel
def cost_nodes(first: wp.int32, build: BuildData, rest: wp.int32):
    chunk = first + wp.tid()
    if rest != 0:
        chunk = -1
    cost_nodes_native(build.nodes, build.surfaces, build.costs, build.choices, chunk)


# One thread: counts wide nodes and blocks in the first call, writes children and faces in the second.
@wp.kernel
def widen(
    first: wp.int32,
    build: BuildData,
    nodes: wp.array(dtype=wp.uint32),
    blocks: wp.array(dtype=wp.float32),
):
    widen_native(build.nodes, build.counts, build.costs, build.choices, nodes, blocks)


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
