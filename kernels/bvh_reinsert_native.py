"""Native code that improves the binary tree of bvh_build.py by reinsertion, before it is widened.

Bittner, Hapala, Havran: "Fast Insertion-Based Optimization of Bounding Volume Hierarchies" (CGF 2013), a batch at a
time as Meister and Bittner: "Parallel Reinsertion for Bounding Volume Hierarchy Optimization" (CGF 2018). While this
goes on a node's words hold its children in place of counts: left and right in an inner node, its triangle and -1 in a
leaf; nodes keep their places, and FLATTEN puts them in the order of bvh_build.py again.
"""

from warp_gi.kernels.bvh_build_native import BINARY

# Counts become children; writes the parents of a node's children.
LINK_NODE = (
    BINARY
    + """
    Reference& one = ((Reference*)nodes.data)[node];
    const int left_count = Builder::word(one.high);
    if (!node) parents.data[0] = -1;
    if (!left_count) {
        one.high = Builder::with_word(one.high, -1);
        return;
    }
    const int left = node + 1, right = node + 2 * left_count;
    one.low = Builder::with_word(one.low, left);
    one.high = Builder::with_word(one.high, right);
    parents.data[left] = parents.data[right] = node;
"""
)

# Where node `start` lowers the sum of the areas of inner nodes most, and by how much: it is taken out with its parent,
# and the parent becomes the parent of `start` and of the target. Branch and bound below the siblings of all nodes on
# the way to the root. What a target costs is at least the area of `start`.
FIND_TARGET = (
    BINARY
    + """
    struct Place { float gain; int node; };
    const Reference* tree = (const Reference*)nodes.data;
    const auto other = [&](int above, int child) {
        const int left = Builder::word(tree[above].low);
        return left == child ? Builder::word(tree[above].high) : left;
    };
    const f4 low = tree[start].low, high = tree[start].high;
    const float area = Builder::half_area(low, high);
    const int parent = parents.data[start];
    float best = 0.0f;
    int target = -1;
    if (parent >= 0) {
        Place stack[256];
        int pivot = parent, sibling = other(parent, start), size = 0;
        f4 pivot_low = tree[sibling].low, pivot_high = tree[sibling].high;
        float gain = Builder::half_area(tree[parent].low, tree[parent].high);
        while (true) {
            stack[size++] = {gain, sibling};
            while (size) {
                const Place top = stack[--size];
                if (!(top.gain - area > best)) continue;
                const Reference& place = tree[top.node];
                const float here = top.gain
                    - Builder::half_area(Builder::low(place.low, low), Builder::high(place.high, high));
                if (here > best) best = here, target = top.node;
                const int right = Builder::word(place.high);
                const float below = here + Builder::half_area(place.low, place.high);
                if (right >= 0 && below - area > best && size < 254) {
                    stack[size++] = {below, right};
                    stack[size++] = {below, Builder::word(place.low)};
                }
            }
            const int above = parents.data[pivot];
            if (pivot != parent) {
                pivot_low = Builder::low(pivot_low, tree[sibling].low);
                pivot_high = Builder::high(pivot_high, tree[sibling].high);
                const float old_area = Builder::half_area(tree[pivot].low, tree[pivot].high);
                gain += old_area - Builder::half_area(pivot_low, pivot_high);
                if (gain - old_area > best) best = gain - old_area, target = pivot;
            }
            if (above < 0) break;
            sibling = other(above, pivot);
            pivot = above;
        }
    }
    gains.data[index] = best;
    targets.data[index] = target;
"""
)

# Moves nodes to their targets, in the order given, unless another move of this pass has touched the nodes around.
MOVE_NODES = (
    BINARY
    + """
    Reference* tree = (Reference*)nodes.data;
    int* above = parents.data;
    const auto put = [&](int parent, int old_child, int child) {
        above[child] = parent;
        if (parent < 0) { counts.data[4] = child; return; }
        Reference& one = tree[parent];
        if (Builder::word(one.low) == old_child) one.low = Builder::with_word(one.low, child);
        else one.high = Builder::with_word(one.high, child);
    };
    const auto fit = [&](int n) {
        while (n >= 0) {
            Reference& one = tree[n];
            const Reference &a = tree[Builder::word(one.low)], &b = tree[Builder::word(one.high)];
            const f4 low = Builder::with_word(Builder::low(a.low, b.low), Builder::word(one.low));
            const f4 high = Builder::with_word(Builder::high(a.high, b.high), Builder::word(one.high));
            bool same = true;
            for (int k = 0; k < 3; ++k) same = same && low[k] == one.low[k] && high[k] == one.high[k];
            if (same) return;
            one.low = low, one.high = high;
            n = above[n];
        }
    };
    for (int i = 0; i < order.shape[0]; ++i) {
        const int from = candidates.data[order.data[i]], target = targets.data[order.data[i]];
        const int parent = above[from];
        if (target < 0 || parent < 0) continue;
        const int left = Builder::word(tree[parent].low);
        const int sibling = left == from ? Builder::word(tree[parent].high) : left;
        if (target == sibling || target == parent) continue;
        const int around[5] = {from, target, sibling, parent, above[target]};
        bool is_free = true;
        for (int k = 0; k < 5; ++k) is_free = is_free && (around[k] < 0 || touched.data[around[k]] != pass_number);
        for (int n = target; n >= 0 && is_free; n = above[n]) is_free = n != from;  // an earlier move put it there
        if (!is_free) continue;
        for (int k = 0; k < 5; ++k) if (around[k] >= 0) touched.data[around[k]] = pass_number;
        const int grandparent = above[parent];
        put(grandparent, parent, sibling);
        put(above[target], target, parent);
        tree[parent].low = Builder::with_word(tree[parent].low, target);
        tree[parent].high = Builder::with_word(tree[parent].high, from);
        above[target] = above[from] = parent;
        fit(parent);
        fit(above[parent]);
        fit(grandparent);
    }
"""
)

# Copies the tree to `flat` in depth-first order, with counts again; `waiting` is scratch. Writes the depth.
FLATTEN = (
    BINARY
    + """
    const Reference* tree = (const Reference*)nodes.data;
    Reference* out = (Reference*)flat.data;
    int size = 0, count = 0, deepest = 0;
    int* stack = waiting.data;  // node and depth, by turns
    stack[size++] = counts.data[4], stack[size++] = 0;
    while (size) {
        const int depth = stack[--size], n = stack[--size];
        deepest = depth > deepest ? depth : deepest;
        const int right = Builder::word(tree[n].high);
        out[count] = tree[n];
        out[count].high = Builder::with_word(out[count].high, right < 0 ? 0 : 1);
        ++count;
        if (right < 0) continue;
        stack[size++] = right, stack[size++] = depth + 1;
        stack[size++] = Builder::word(tree[n].low), stack[size++] = depth + 1;
    }
    for (int n = count - 1; n >= 0; --n) {
        if (!Builder::word(out[n].high)) continue;
        const auto size_of = [&](int m) { return Builder::word(out[m].high) ? Builder::word(out[m].low) : 1; };
        const int left_count = size_of(n + 1);
        out[n].low = Builder::with_word(out[n].low, left_count + size_of(n + 2 * left_count));
        out[n].high = Builder::with_word(out[n].high, left_count);
    }
    counts.data[1] = deepest;
"""
)
