"""Building the eight-wide tree of bvh.py on the CPU.

Four stages, each a kernel: triangle bounds (`bound_triangles`); a binary tree down to single triangles by binned
surface-area heuristic, in disjoint subtrees that threads share (`split_top`, `build_subtrees`), with the cost of
the best eight-wide tree over each binary node by dynamic programming (Ylitie, Karras, Laine: "Efficient
Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs", HPG 2017, section 3.1); the wide tree's topology
(`widen`); its geometry (`fill_blocks`, `fill_nodes`), which is all that a refit repeats.

Scratch, eight 32-bit words each. Reference: low x, y, z, triangle, high x, y, z, 0. Binary node: low x, y, z,
triangle count, high x, y, z, triangle count of the left child (0 in a leaf, whose triangle it holds). A node over
n references lies before its left subtree's 2 n_left - 1 nodes and those before the right one's.
"""

import warp as wp

from warp_gi.kernels.bvh import BLOCK_WORDS, FACE_MASKED, NODE_WORDS

wp.set_module_options({"enable_backward": False})

BOX_WORDS = 8  # exact bounds of a wide node while nodes are filled
NODE_COST = 1.0  # visiting a node, relative to ...
BLOCK_COST = 0.9  # ... testing a block of up to four triangles


def cpu_only(snippet: str) -> str:
    """Return the snippet so that CUDA compilers, which lack clang's vector types, skip it."""
    return f"#if !defined(__CUDA_ARCH__)\n{snippet}\n#endif\n;"


BINARY = """
    typedef float f4 __attribute__((vector_size(16)));
    typedef int i4 __attribute__((vector_size(16)));
    struct Reference { f4 low, high; };
    struct Task { int begin, end, base, depth; };  // references, first node
    struct Builder {
        enum { BINS = 32, SWEEP = 12, DEEP = 40 };
        static f4 low(f4 a, f4 b) { return a < b ? a : b; }
        static f4 high(f4 a, f4 b) { return a > b ? a : b; }
        static int word(f4 a) { return __builtin_bit_cast(i4, a)[3]; }
        static f4 with_word(f4 a, int w) { i4 b = __builtin_bit_cast(i4, a); b[3] = w; return __builtin_bit_cast(f4, b); }
        static f4 xyz(f4 a) { a[3] = 0.0f; return a; }
        static float half_area(f4 l, f4 h) { const f4 e = h - l; return e[0] * e[1] + e[1] * e[2] + e[2] * e[0]; }

        // Reorders small ranges to the best of all splits along the three axes; returns the middle.
        static int sweep(Reference* refs, int begin, int end) {
            const int count = end - begin;
            Reference sorted[SWEEP], best[SWEEP];
            float right[SWEEP], best_cost = 3.4e38f;
            int middle = 0;
            for (int axis = 0; axis < 3; ++axis) {
                for (int i = 0; i < count; ++i) {
                    const Reference r = refs[begin + i];
                    const float key = r.low[axis] + r.high[axis];
                    int at = i;
                    while (at > 0 && sorted[at - 1].low[axis] + sorted[at - 1].high[axis] > key) { sorted[at] = sorted[at - 1]; --at; }
                    sorted[at] = r;
                }
                f4 l = sorted[count - 1].low, h = sorted[count - 1].high;
                for (int i = count - 1; i > 0; --i) {
                    l = low(l, sorted[i].low), h = high(h, sorted[i].high);
                    right[i] = half_area(l, h) * (float)(count - i);
                }
                l = sorted[0].low, h = sorted[0].high;
                bool improved = false;
                for (int i = 1; i < count; ++i) {
                    const float cost = half_area(l, h) * (float)i + right[i];
                    if (cost < best_cost) best_cost = cost, middle = i, improved = true;
                    l = low(l, sorted[i].low), h = high(h, sorted[i].high);
                }
                if (improved) for (int i = 0; i < count; ++i) best[i] = sorted[i];
            }
            if (!middle) return begin + count / 2;
            for (int i = 0; i < count; ++i) refs[begin + i] = best[i];
            return begin + middle;
        }

        // Reorders a range by the best binned split of its centroids; returns the middle.
        static int bin(Reference* refs, int begin, int end, f4 first, f4 last) {
            const f4 extent = last - first;
            f4 scale;
            for (int k = 0; k < 4; ++k) scale[k] = k < 3 && extent[k] > 0.0f ? 0.9999f * (float)BINS / extent[k] : 0.0f;
            for (int k = 0; k < 3; ++k) if (!(scale[k] < 3e38f)) scale[k] = 0.0f;
            f4 lows[3][BINS], highs[3][BINS];
            int counts[3][BINS];
            for (int axis = 0; axis < 3; ++axis) for (int b = 0; b < BINS; ++b) {
                lows[axis][b] = 3.4e38f - (f4) {}, highs[axis][b] = -3.4e38f - (f4) {}, counts[axis][b] = 0;
            }
            for (int i = begin; i < end; ++i) {
                const Reference r = refs[i];
                const i4 b = __builtin_convertvector((xyz(r.low) + r.high - first) * scale, i4);
                for (int axis = 0; axis < 3; ++axis) {
                    lows[axis][b[axis]] = low(lows[axis][b[axis]], r.low);
                    highs[axis][b[axis]] = high(highs[axis][b[axis]], r.high);
                    ++counts[axis][b[axis]];
                }
            }
            float best_cost = 3.4e38f;
            int best_axis = -1, best_bin = 0;
            for (int axis = 0; axis < 3; ++axis) {
                if (scale[axis] == 0.0f) continue;
                float right[BINS];
                f4 l = lows[axis][BINS - 1], h = highs[axis][BINS - 1];
                int count = 0;
                for (int b = BINS - 1; b > 0; --b) {
                    l = low(l, lows[axis][b]), h = high(h, highs[axis][b]), count += counts[axis][b];
                    right[b] = count ? half_area(l, h) * (float)count : 0.0f;
                }
                l = lows[axis][0], h = highs[axis][0], count = 0;
                for (int b = 1; b < BINS; ++b) {
                    l = low(l, lows[axis][b - 1]), h = high(h, highs[axis][b - 1]), count += counts[axis][b - 1];
                    const float cost = half_area(l, h) * (float)count + right[b];
                    if (count && count < end - begin && cost < best_cost) best_cost = cost, best_axis = axis, best_bin = b;
                }
            }
            if (best_axis < 0) return begin + (end - begin) / 2;
            int i = begin, j = end - 1;
            while (true) {
                while (i <= j && below(refs[i], first, scale, best_axis, best_bin)) ++i;
                while (i <= j && !below(refs[j], first, scale, best_axis, best_bin)) --j;
                if (i >= j) break;
                const Reference r = refs[i];
                refs[i++] = refs[j], refs[j--] = r;
            }
            return i;
        }

        static bool below(const Reference& r, f4 first, f4 scale, int axis, int b) {
            return (int)((r.low[axis] + r.high[axis] - first[axis]) * scale[axis]) < b;
        }

        // Writes the node over a task's references; splits them and returns their middle, or 0 for a leaf.
        static int node(Reference* refs, Reference* nodes, float* surface, const Task& task) {
            f4 l = refs[task.begin].low, h = refs[task.begin].high, first = xyz(l) + h, last = first;
            for (int i = task.begin + 1; i < task.end; ++i) {
                const f4 center = xyz(refs[i].low) + refs[i].high;
                l = low(l, refs[i].low), h = high(h, refs[i].high);
                first = low(first, center), last = high(last, center);
            }
            const int count = task.end - task.begin;
            int middle = 0;
            if (count == 2) middle = task.begin + 1;
            else if (count > 2 && task.depth > DEEP) middle = task.begin + count / 2;
            else if (count > 2 && count <= SWEEP) middle = sweep(refs, task.begin, task.end);
            else if (count > 2) middle = bin(refs, task.begin, task.end, first, last);
            if (!middle) surface[8ll * task.base + 7] = refs[task.begin].high[3];
            nodes[task.base].low = with_word(l, count == 1 ? word(refs[task.begin].low) : count);
            nodes[task.base].high = with_word(h, middle ? middle - task.begin : 0);
            return middle;
        }

        static void children(const Task& task, int middle, Task& left, Task& right) {
            left = {task.begin, middle, task.base + 1, task.depth + 1};
            right = {middle, task.end, task.base + 2 * (middle - task.begin), task.depth + 1};
        }

        // costs[7]: of the subtree as at most 1..7 wide roots. choice[i]: how many of i + 1 roots go to the left
        // child, 0 to use one root less; choice[0]: 1 for a wide node, 0 for a leaf block.
        static void cost(const Reference* nodes, float* all_costs, unsigned char* all_choices, int n) {
            float* costs = all_costs + 8ll * n;
            unsigned char* choice = all_choices + 8ll * n;
            const int left_count = word(nodes[n].high);
            const float area = half_area(nodes[n].low, nodes[n].high);
            if (!left_count) {
                for (int i = 0; i < 7; ++i) costs[i] = area * BLOCK_COST;
                for (int i = 0; i < 8; ++i) choice[i] = 0;
                return;
            }
            const float* left = all_costs + 8ll * (n + 1);
            const float* right = all_costs + 8ll * (n + 2 * left_count);
            for (int roots = 2; roots <= 8; ++roots) {
                float best = 3.4e38f;
                for (int k = 1; k < roots; ++k) {
                    const float c = left[k - 1] + right[roots - k - 1];
                    if (c < best) best = c, choice[roots - 1] = (unsigned char)k;
                }
                costs[roots - 1] = best;  // that of 8 roots only until the surface takes its place
            }
            const int count = word(nodes[n].low);
            const float block = count <= 4 ? area * BLOCK_COST : 3.4e38f, inner = area * NODE_COST + costs[7];
            choice[0] = inner < block;
            costs[0] = inner < block ? inner : block;
            costs[7] = left[7] + right[7];
            for (int i = 1; i < 7; ++i) if (!(costs[i] < costs[i - 1])) costs[i] = costs[i - 1], choice[i] = 0;
        }
    };
""".replace("NODE_COST", f"{NODE_COST}f").replace("BLOCK_COST", f"{BLOCK_COST}f")

SPLIT_TOP = (
    BINARY
    + """
    Reference* references = (Reference*)refs.data;
    Reference* tree = (Reference*)nodes.data;
    Task* list = (Task*)tasks.data;
    const int most = (int)(tasks.shape[0] / 4);
    Task stack[128];
    int waiting = 0, top_count = 0, task_count = 0;
    stack[waiting++] = {0, count, 0, 0};
    while (waiting) {
        const Task task = stack[--waiting];
        if (task.end - task.begin <= largest || task_count + waiting + 2 > most) { list[task_count++] = task; continue; }
        const int middle = Builder::node(references, tree, costs.data, task);
        top.data[top_count++] = task.base;
        Builder::children(task, middle, stack[waiting + 1], stack[waiting]);
        waiting += 2;
    }
    counts.data[0] = task_count;
    counts.data[1] = top_count;
"""
)

BUILD_SUBTREE = (
    BINARY
    + """
    Reference* tree = (Reference*)nodes.data;
    const Task subtree = ((const Task*)tasks.data)[index];
    Task stack[128];
    int waiting = 0;
    stack[waiting++] = subtree;
    while (waiting) {
        const Task task = stack[--waiting];
        const int middle = Builder::node((Reference*)refs.data, tree, costs.data, task);
        if (!middle) continue;
        Builder::children(task, middle, stack[waiting + 1], stack[waiting]);
        waiting += 2;
    }
    for (int n = subtree.base + 2 * (subtree.end - subtree.begin) - 2; n >= subtree.base; --n)
        Builder::cost(tree, costs.data, choices.data, n);
"""
)

WIDEN = (
    BINARY
    + """
    struct Item { int node, wide; };
    Reference* tree = (Reference*)nodes.data;
    const bool dry = counts.data[2] < 0;  // the first call only counts
    if (dry) for (int i = counts.data[1] - 1; i >= 0; --i) Builder::cost(tree, costs.data, choices.data, top.data[i]);
    Item stack[1024];
    int waiting = 0, wide_count = 1, block_count = 1;  // block 0 is empty
    stack[waiting++] = {0, 0};
    if (!dry) for (int lane = 36; lane < 40; ++lane) ((int*)blocks.data)[lane] = -1;
    while (waiting) {
        const Item item = stack[--waiting];
        int pending[8], budget[8], pending_count = 0, child_count = 0;
        const unsigned char* choice = choices.data + 8ll * item.node;
        if (choice[0]) {
            pending[0] = item.node + 2 * Builder::word(tree[item.node].high), budget[0] = 8 - choice[7];
            pending[1] = item.node + 1, budget[1] = choice[7];
            pending_count = 2;
        } else {
            pending[0] = item.node, budget[0] = 1, pending_count = 1;
        }
        int roots_found[8];
        float rank[8];
        while (pending_count) {
            const int n = pending[--pending_count];
            int roots = budget[pending_count];
            choice = choices.data + 8ll * n;
            while (roots > 1 && !choice[roots - 1]) --roots;
            if (roots > 1) {
                pending[pending_count] = n + 2 * Builder::word(tree[n].high), budget[pending_count++] = roots - choice[roots - 1];
                pending[pending_count] = n + 1, budget[pending_count++] = choice[roots - 1];
                continue;
            }
            // Any-hit rays visit first what most likely stops them for its cost.
            const float area = Builder::half_area(tree[n].low, tree[n].high), surface = costs.data[8ll * n + 7];
            const float stopped = area > 0.0f ? surface / (area + surface) : 1.0f;
            const float r = stopped / (costs.data[8ll * n] / (area > 0.0f ? area : 1.0f));
            int at = child_count++;
            while (at > 0 && rank[at - 1] < r) { rank[at] = rank[at - 1], roots_found[at] = roots_found[at - 1]; --at; }
            rank[at] = r, roots_found[at] = n;
        }
        unsigned* wide_node = wide.data + 32ll * item.wide;
        for (int c = 0; c < child_count; ++c) {
            const int n = roots_found[c];
            if (choices.data[8ll * n]) {
                if (!dry) wide_node[24 + c] = wide_count;
                stack[waiting++] = {n, wide_count++};
                continue;
            }
            if (!dry) {
                wide_node[24 + c] = ~block_count;
                int* faces = (int*)blocks.data + 40ll * block_count + 36;
                int lanes = 0;
                const int left = Builder::word(tree[n].high), last = left ? n + 2 * Builder::word(tree[n].low) - 2 : n;
                for (int m = n; m <= last; ++m)
                    if (!Builder::word(tree[m].high)) faces[lanes++] = Builder::word(tree[m].low);
                while (lanes < 4) faces[lanes++] = -1;
            }
            ++block_count;
        }
        if (!dry) while (child_count < 8) wide_node[24 + child_count++] = ~0;
    }
    counts.data[2] = wide_count;
    counts.data[3] = block_count;
"""
)

# Bounds from the blocks up; children come after their parents. A child's box is enlarged by a millionth of the
# node, which covers every rounding in the traversal that does not shrink with the distance to the ray's origin.
FILL_NODES = """
    for (int n = count - 1; n >= 0; --n) {
        unsigned* node = nodes.data + 32ll * n;
        unsigned char* rows = (unsigned char*)node;
        int child_count = 0;
        while (child_count < 8 && (int)node[24 + child_count] != -1) ++child_count;
        float* box = boxes.data + 8ll * n;
        float child_boxes[8][6];
        for (int k = 0; k < 6; ++k) box[k] = k < 3 ? 3.4e38f : -3.4e38f;
        for (int c = 0; c < child_count; ++c) {
            const int child = (int)node[24 + c];
            float* b = child_boxes[c];
            for (int k = 0; k < 6; ++k) b[k] = child >= 0 ? boxes.data[8ll * child + k] : (k < 3 ? 3.4e38f : -3.4e38f);
            if (child < 0) {
                const float* block = blocks.data + 40ll * ~child;
                for (int lane = 0; lane < 4; ++lane) {
                    if (((const int*)block)[36 + lane] == -1) continue;
                    for (int row = 0; row < 9; ++row) {
                        const float x = block[4 * row + lane];
                        const int k = row - row / 3 * 3;
                        b[k] = x < b[k] ? x : b[k];
                        b[3 + k] = x > b[3 + k] ? x : b[3 + k];
                    }
                }
            }
            for (int k = 0; k < 3; ++k) {
                box[k] = b[k] < box[k] ? b[k] : box[k];
                box[3 + k] = b[3 + k] > box[3 + k] ? b[3 + k] : box[3 + k];
            }
        }
        double widest = 1e-30;
        for (int k = 0; k < 3; ++k) widest = (double)box[3 + k] - box[k] > widest ? (double)box[3 + k] - box[k] : widest;
        const double pad = 1e-6 * widest;
        float* frame = (float*)(rows + 72);
        for (int k = 0; k < 3; ++k) {
            const double low = box[k], high = box[3 + k], size = -low > high ? -low : high;
            const double margin = 2e-5 * (high - low) + 2.0 * pad + 5e-7 * size;  // keeps rounded base and span outside
            frame[3 + k] = (float)((high - low + 2.0 * margin) * (32768.0 / 253.0));
            frame[k] = (float)(low - margin - frame[3 + k]);
            const double origin = (double)frame[k] + frame[3 + k], step = frame[3 + k] / 32768.0;
            for (int c = 0; c < 8; ++c) {
                unsigned char* row = rows + 24 * k + c;
                row[0] = row[16] = 255, row[8] = 0;
                if (c >= child_count || child_boxes[c][k] > child_boxes[c][3 + k]) continue;
                const double lower = (child_boxes[c][k] - pad - origin) / step - 0.02;
                const double upper = (child_boxes[c][3 + k] + pad - origin) / step + 0.02;
                row[0] = row[16] = (unsigned char)(lower < 0.0 ? 0 : (int)lower);
                row[8] = (unsigned char)(upper > 254.0 ? 255 : (int)upper + 1);
            }
        }
    }
"""


@wp.func_native(cpu_only(SPLIT_TOP))
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


@wp.func_native(cpu_only(BUILD_SUBTREE))
def build_subtree_native(
    refs: wp.array(dtype=wp.float32),
    nodes: wp.array(dtype=wp.float32),
    tasks: wp.array(dtype=wp.int32),
    costs: wp.array(dtype=wp.float32),
    choices: wp.array(dtype=wp.uint8),
    index: wp.int32,
): ...


@wp.func_native(cpu_only(WIDEN))
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
    blocks: wp.array(dtype=wp.float32),
    boxes: wp.array(dtype=wp.float32),
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
        build.refs, build.nodes, build.costs, build.tasks, build.top, build.counts, build.refs.shape[0] // 8, largest
    )


# Thread: one task of split_top.
@wp.kernel
def build_subtrees(first: wp.int32, build: BuildData):
    build_subtree_native(build.refs, build.nodes, build.tasks, build.costs, build.choices, first + wp.tid())


# One thread: counts wide nodes and blocks in the first call, writes children and faces in the second.
@wp.kernel
def widen(first: wp.int32, build: BuildData, nodes: wp.array(dtype=wp.uint32), blocks: wp.array(dtype=wp.float32)):
    widen_native(build.nodes, build.top, build.counts, build.costs, build.choices, nodes, blocks)


@wp.func
def has_area(p0: wp.vec3, p1: wp.vec3, p2: wp.vec3) -> wp.bool:
    a = wp.vec3d(p1) - wp.vec3d(p0)
    b = wp.vec3d(p2) - wp.vec3d(p0)
    return wp.length_sq(wp.cross(a, b)) > wp.float64(0.0)


# Thread: one block. Zero-area triangles shrink to a point, which no ray hits.
@wp.kernel
def fill_blocks(
    first: wp.int32,
    points: wp.array(dtype=wp.vec3),
    indices: wp.array(dtype=wp.vec3i),
    face_masks: wp.array(dtype=wp.int32),
    blocks: wp.array(dtype=wp.float32),
):
    start = (first + wp.tid()) * BLOCK_WORDS
    for lane in range(4):
        face = wp.cast(blocks[start + 36 + lane], wp.int32)
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
            if face_masks.shape[0] > 0:
                if face_masks[face] >= 0:
                    face = face | FACE_MASKED
            blocks[start + 36 + lane] = wp.cast(face, wp.float32)
        for k in range(3):
            blocks[start + 4 * k + lane] = p0[k]
            blocks[start + 12 + 4 * k + lane] = p1[k]
            blocks[start + 24 + 4 * k + lane] = p2[k]


# One thread: boxes of all nodes.
@wp.kernel
def fill_nodes(
    first: wp.int32,
    nodes: wp.array(dtype=wp.uint32),
    blocks: wp.array(dtype=wp.float32),
    boxes: wp.array(dtype=wp.float32),
):
    fill_nodes_native(nodes, blocks, boxes, nodes.shape[0] // NODE_WORDS)
