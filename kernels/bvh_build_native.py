"""Native code that builds the CPU's eight-wide tree; bvh_build.py describes the stages and the scratch arrays."""

NODE_COST = 1.0  # visiting a node, relative to ...
BLOCK_COST = 1.0  # ... testing a block of triangles
CHUNK_NODES = 1 << 14  # binary nodes whose costs one thread finds


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
        static f4 with_word(f4 a, int w) {
            i4 b = __builtin_bit_cast(i4, a);
            b[3] = w;
            return __builtin_bit_cast(f4, b);
        }
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
                    while (at > 0 && sorted[at - 1].low[axis] + sorted[at - 1].high[axis] > key) {
                        sorted[at] = sorted[at - 1];
                        --at;
                    }
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
                    if (count && count < end - begin && cost < best_cost)
                        best_cost = cost, best_axis = axis, best_bin = b;
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
        static int node(Reference* refs, Reference* nodes, const Task& task) {
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
        static void cost(
            const Reference* nodes, const float* surfaces, float* all_costs, unsigned char* all_choices, int n
        ) {
            float* costs = all_costs + 8ll * n;
            unsigned char* choice = all_choices + 8ll * n;
            const int left_count = word(nodes[n].high);
            const float area = half_area(nodes[n].low, nodes[n].high);
            if (!left_count) {
                for (int i = 0; i < 7; ++i) costs[i] = area * BLOCK_COST;
                costs[7] = surfaces[word(nodes[n].low)];
                for (int i = 0; i < 8; ++i) choice[i] = 0;
                return;
            }
            const float* left = all_costs + 8ll * (n + 1);
            const float* right = all_costs + 8ll * (n + 2 * left_count);
            for (int roots = 2; roots <= 8; ++roots) {
                float best = 3.4e38f;
                choice[roots - 1] = 1;  // where no cost is finite
                for (int k = 1; k < roots; ++k) {
                    const float c = left[k - 1] + right[roots - k - 1];
                    if (c < best) best = c, choice[roots - 1] = (unsigned char)k;
                }
                costs[roots - 1] = best;  // that of 8 roots only until the surface takes its place
            }
            const int count = word(nodes[n].low);
            const float block = count <= LANES ? area * BLOCK_COST : 3.4e38f, inner = area * NODE_COST + costs[7];
            choice[0] = count > LANES || inner < block;
            costs[0] = choice[0] ? inner : block;
            costs[7] = left[7] + right[7];
            for (int i = 1; i < 7; ++i) if (!(costs[i] < costs[i - 1])) costs[i] = costs[i - 1], choice[i] = 0;
        }
    };
"""

SPLIT_TOP = (
    BINARY
    + """
    Reference* references = (Reference*)refs.data;
    Reference* tree = (Reference*)nodes.data;
    Task* list = (Task*)tasks.data;
    const int most = (int)(tasks.shape[0] / 4);
    Task stack[128];
    int waiting = 0, task_count = 0;
    stack[waiting++] = {0, count, 0, 0};
    while (waiting) {
        const Task task = stack[--waiting];
        if (task.end - task.begin <= largest || task_count + waiting + 2 > most) {
            list[task_count++] = task;
            continue;
        }
        const int middle = Builder::node(references, tree, task);
        Builder::children(task, middle, stack[waiting + 1], stack[waiting]);
        waiting += 2;
    }
    counts.data[0] = task_count;
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
        const int middle = Builder::node((Reference*)refs.data, tree, task);
        if (!middle) continue;
        Builder::children(task, middle, stack[waiting + 1], stack[waiting]);
        waiting += 2;
    }
"""
)

# Costs of the nodes of a chunk whose subtrees end in it; those of all others where `chunk` is -1.
COST_NODES = (
    BINARY
    + """
    const Reference* tree = (const Reference*)nodes.data;
    const int count = (int)(nodes.shape[0] / 8), begin = chunk < 0 ? 0 : chunk * CHUNK_NODES;
    const int end = chunk < 0 || begin + CHUNK_NODES > count ? count : begin + CHUNK_NODES;
    for (int n = end - 1; n >= begin; --n) {
        const int last = Builder::word(tree[n].high) ? n + 2 * Builder::word(tree[n].low) - 2 : n;
        if ((chunk < 0) == (last / CHUNK_NODES != n / CHUNK_NODES))
            Builder::cost(tree, surfaces.data, costs.data, choices.data, n);
    }
"""
)

WIDEN = (
    BINARY
    + """
    struct Item { int node, wide; };
    Reference* tree = (Reference*)nodes.data;
    const bool dry = counts.data[2] < 0;  // the first call only counts
    Item stack[1024];
    int waiting = 0, wide_count = 1, block_count = 1;  // block 0 is empty
    stack[waiting++] = {0, 0};
    if (!dry) for (int lane = FACE_WORD; lane < BLOCK_WORDS; ++lane) ((int*)blocks.data)[lane] = -1;
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
                pending[pending_count] = n + 2 * Builder::word(tree[n].high);
                budget[pending_count++] = roots - choice[roots - 1];
                pending[pending_count] = n + 1;
                budget[pending_count++] = choice[roots - 1];
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
        unsigned* wide_node = wide.data + NODE_WORDS * (long long)item.wide;
        for (int c = 0; c < child_count; ++c) {
            const int n = roots_found[c], lane = child_count - 1 - c;  // the most promising last
            if (choices.data[8ll * n]) {
                if (!dry) wide_node[48 + lane] = NODE_STEPS * wide_count;
                stack[waiting++] = {n, wide_count++};
                continue;
            }
            if (!dry) {
                wide_node[48 + lane] = ~(BLOCK_STEPS * block_count);
                int* faces = (int*)blocks.data + BLOCK_WORDS * (long long)block_count + FACE_WORD;
                int lanes = 0;
                const int left = Builder::word(tree[n].high), last = left ? n + 2 * Builder::word(tree[n].low) - 2 : n;
                for (int m = n; m <= last; ++m)
                    if (!Builder::word(tree[m].high)) faces[lanes++] = Builder::word(tree[m].low);
                while (lanes < LANES) faces[lanes++] = -1;
            }
            ++block_count;
        }
        if (!dry) while (child_count < 8) wide_node[48 + child_count++] = ~0;
    }
    counts.data[2] = wide_count;
    counts.data[3] = block_count;
"""
)

# Bounds from the blocks up; children come after their parents. A child's box is enlarged by a millionth of the
# node, which covers every rounding in the traversal that does not shrink with the distance to the ray's origin.
FILL_NODES = """
    for (int n = count - 1; n >= 0; --n) {
        float* node = (float*)nodes.data + NODE_WORDS * (long long)n;
        const int* children = (const int*)node + 48;
        float* box = node_boxes.data + 8ll * n;
        for (int k = 0; k < 3; ++k) box[k] = 3.4e38f, box[3 + k] = -3.4e38f;
        for (int c = 0; c < 8; ++c) {
            const int child = children[c];
            const float* from = child >= 0 ? node_boxes.data + 8ll * (child / NODE_STEPS)
                : block_boxes.data + 8ll * (~child / BLOCK_STEPS);  // that of the empty block is inside out
            for (int k = 0; k < 3; ++k) {
                node[8 * k + c] = from[k], node[24 + 8 * k + c] = from[3 + k];
                box[k] = from[k] < box[k] ? from[k] : box[k];
                box[3 + k] = from[3 + k] > box[3 + k] ? from[3 + k] : box[3 + k];
            }
        }
        float widest = 1e-30f;
        for (int k = 0; k < 3; ++k) widest = box[3 + k] - box[k] > widest ? box[3 + k] - box[k] : widest;
        for (int i = 0; i < 24; ++i) {
            node[i] -= 1e-6f * widest + 2.4e-7f * __builtin_fabsf(node[i]);
            node[24 + i] += 1e-6f * widest + 2.4e-7f * __builtin_fabsf(node[24 + i]);
        }
    }
"""
