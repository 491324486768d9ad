"""Builds of the CPU's tree: reinsertion against all of its choices, and what a tree of either quality keeps."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
import warp as wp
from ray_tools import oracle, rays, soup

import warp_gi as gi
from warp_gi import launch, wide_tree
from warp_gi.bvh import TriangleBvh
from warp_gi.kernels import bvh_build as building
from warp_gi.kernels import bvh_native as layout

CPU = wp.get_device("cpu")


def mixed_soup(seed=3, count=3000):
    """Return triangles of all sizes: many small ones, some that reach through everything."""
    rng = np.random.default_rng(seed)
    points, indices = soup(rng, count, 0.02)
    large, _ = soup(rng, count // 30, 0.6)
    points[: len(large)] = large
    return points, indices


def children_of(tree):
    """Return low, high [node, child, axis], and children [node, child]."""
    words = tree.data.nodes.numpy().reshape(-1, layout.NODE_WORDS)
    rows = words[:, :48].view(np.float32).reshape(-1, 2, 3, 8).transpose(1, 0, 3, 2)
    return rows[0], rows[1], words[:, 48:].view(np.int32)


def surface_cost(tree):
    """Return the expected cost of a ray through the root's box: areas of nodes and blocks over the root's."""
    low, high, children = children_of(tree)
    used = children != -1
    sides = np.where(used[..., None], high.astype(np.float64) - low, 0.0)
    areas = sides[..., 0] * sides[..., 1] + sides[..., 1] * sides[..., 2] + sides[..., 2] * sides[..., 0]
    x, y, z = high[0][used[0]].max(0).astype(np.float64) - low[0][used[0]].min(0)
    return 1.0 + areas[used].sum() / (x * y + y * z + z * x)


def half_area(low, high):
    x, y, z = (high - low).astype(np.float64)
    return x * y + y * z + z * x


class LinkedTree:
    """A binary tree by links, as kernels/bvh_reinsert_native.py keeps it, with its boxes found anew."""

    def __init__(self, nodes, parents, root):
        words = nodes.reshape(-1, 8).view(np.int32)
        self.low, self.high = nodes.reshape(-1, 8)[:, :3], nodes.reshape(-1, 8)[:, 4:7]
        self.children = {n: [int(words[n, 3]), int(words[n, 7])] for n in range(len(words)) if words[n, 7] >= 0}
        self.parents, self.root = dict(enumerate(parents.tolist())), root

    def cost(self):
        """Return half the area of all inner nodes' boxes."""
        total, boxes = 0.0, {}
        order = [self.root]
        for n in order:
            order += self.children.get(n, [])
        for n in reversed(order):
            boxes[n] = self.low[n], self.high[n]
            if n in self.children:
                (low, high), (other_low, other_high) = (boxes[c] for c in self.children[n])
                boxes[n] = np.minimum(low, other_low), np.maximum(high, other_high)
                total += half_area(*boxes[n])
        return total

    def below(self, n):
        """Return the nodes of a subtree."""
        found = [n]
        for one in found:
            found += self.children.get(one, [])
        return found

    def put(self, parent, old_child, child):
        self.parents[child] = parent
        if parent < 0:
            self.root = child
        else:
            self.children[parent] = [child if one == old_child else one for one in self.children[parent]]

    def moved(self, start, target):
        """Return the tree's cost after ``start`` has become the sibling of ``target``; the tree stays as it was."""
        kept = {n: list(two) for n, two in self.children.items()}, dict(self.parents), self.root
        parent = self.parents[start]
        sibling = next(one for one in self.children[parent] if one != start)
        self.put(self.parents[parent], parent, sibling)
        self.put(self.parents[target], target, parent)
        self.children[parent] = [target, start]
        self.parents[target] = self.parents[start] = parent
        cost = self.cost()
        self.children, self.parents, self.root = kept
        return cost


def linked(count, seed):
    """Return the scratch of reinsertion over a small tree, every node a candidate, and what it would build on."""
    points, indices = soup(np.random.default_rng(seed), count, 0.3)
    build = wide_tree._binary_tree(
        wp.array(points, dtype=wp.vec3, device=CPU), wp.array(indices, dtype=wp.vec3i, device=CPU)
    )
    nodes = len(build.nodes) // 8
    data = building.ReinsertData()
    data.nodes, data.counts = build.nodes, build.counts
    data.parents = wp.empty(nodes, dtype=wp.int32, device=CPU)
    data.touched = wp.zeros(nodes + 1, dtype=wp.int32, device=CPU)
    data.candidates = wp.array(np.arange(nodes), dtype=wp.int32, device=CPU)
    data.gains = wp.empty(nodes, dtype=wp.float32, device=CPU)
    data.targets = wp.empty(nodes, dtype=wp.int32, device=CPU)
    launch.launch(building.link_nodes, nodes, [data], CPU)
    return data


def tree_of(data):
    return LinkedTree(data.nodes.numpy(), data.parents.numpy(), int(data.counts.numpy()[4]))


@pytest.mark.parametrize("seed", [1, 2])
def test_reinsertion_finds_the_best_of_all_places(seed):
    data = linked(24, seed)
    launch.launch(building.find_targets, len(data.candidates), [data], CPU)
    gains, targets, tree = data.gains.numpy(), data.targets.numpy(), tree_of(data)
    before = tree.cost()
    for start in range(len(gains)):
        if tree.parents[start] < 0:
            assert targets[start] == -1
            continue
        sibling = next(one for one in tree.children[tree.parents[start]] if one != start)
        places = set(range(len(gains))) - {sibling, tree.parents[start], *tree.below(start)}
        best = max([before - tree.moved(start, place) for place in places], default=0.0)
        assert gains[start] == pytest.approx(max(best, 0.0), abs=1e-4 * before)
        if targets[start] >= 0:
            assert before - tree.moved(start, int(targets[start])) == pytest.approx(gains[start], abs=1e-4 * before)
    assert (targets >= 0).sum() > 5  # there was something to find


def test_a_move_lowers_the_cost_by_its_gain_and_a_batch_keeps_the_tree_whole():
    data = linked(40, 5)
    launch.launch(building.find_targets, len(data.candidates), [data], CPU)
    gains, before = data.gains.numpy().copy(), tree_of(data).cost()
    first = int(gains.argmax())
    launch.launch(building.move_nodes, 1, [data, wp.array([first], dtype=wp.int32, device=CPU), 1], CPU)
    after = tree_of(data)
    assert before - after.cost() == pytest.approx(gains[first], rel=1e-4)
    for number in range(2, 6):  # batches whose moves get in each other's way
        launch.launch(building.find_targets, len(gains), [data], CPU)
        order = np.argsort(-data.gains.numpy(), kind="stable").astype(np.int32)
        launch.launch(building.move_nodes, 1, [data, wp.array(order, dtype=wp.int32, device=CPU), number], CPU)
        tree = tree_of(data)
        assert sorted(tree.below(tree.root)) == list(range(len(gains)))
        for n, two in tree.children.items():
            assert tree.parents[two[0]] == tree.parents[two[1]] == n
            np.testing.assert_array_equal(tree.low[n], np.minimum(*tree.low[two]))
            np.testing.assert_array_equal(tree.high[n], np.maximum(*tree.high[two]))
    assert tree.cost() < after.cost()


@pytest.mark.parametrize("quality", ["fast", "high"])
def test_a_tree_holds_every_triangle_once_in_boxes_that_nest(quality):
    points, indices = mixed_soup()
    tree = TriangleBvh(points, indices, quality=quality)
    low, high, children = children_of(tree)
    blocks = tree.data.blocks.numpy().view(np.int32).reshape(-1, layout.BLOCK_WORDS)[:, layout.FACE_WORD :]
    faces = blocks[blocks >= 0]
    assert sorted(faces.tolist()) == list(range(len(indices)))
    corners = points[indices]
    reached, waiting = [], [(0, np.full(3, -np.inf), np.full(3, np.inf))]
    while waiting:
        node, outer_low, outer_high = waiting.pop()
        for lane in np.flatnonzero(children[node] != -1):
            child, inner_low, inner_high = children[node, lane], low[node, lane], high[node, lane]
            assert (inner_low >= outer_low).all() and (inner_high <= outer_high).all()
            if child >= 0:
                waiting.append((child // layout.NODE_STEPS, inner_low, inner_high))
                continue
            block = ~child // layout.BLOCK_STEPS
            inside = corners[blocks[block][blocks[block] >= 0]]
            assert (inside >= inner_low).all() and (inside <= inner_high).all()
            assert tree.data.parents.numpy()[block] == node * layout.NODE_STEPS
            reached.append(block)
    assert sorted(reached) == list(range(1, len(blocks)))


def test_reinsertion_lowers_the_cost_of_rays_and_changes_no_hit():
    points, indices = mixed_soup()
    fast, high = (TriangleBvh(points, indices, quality=quality) for quality in ("fast", "high"))
    assert surface_cost(high) < 0.85 * surface_cost(fast)
    assert high.memory_bytes < 1.1 * fast.memory_bytes
    origins, directions = rays(np.random.default_rng(4), 40000)
    limits = np.random.default_rng(5).uniform(0, 10, 40000).astype(np.float32)
    one, two = (tree.intersect(origins, directions, limits) for tree in (fast, high))
    for name in ("t", "u", "v", "face"):
        assert getattr(one, name).numpy().tobytes() == getattr(two, name).numpy().tobytes()
    blocked = [tree.occluded(origins, directions, limits).numpy() for tree in (fast, high)]
    assert (blocked[0] == blocked[1]).all() and (blocked[0] == (one.face.numpy() >= 0)).all()
    some = slice(0, 1000)
    expected = oracle(points, indices, origins[some], directions[some], limits[some, None])
    face = np.where(np.isfinite(expected.min(1)), expected.argmin(1), -1)
    assert (one.face.numpy()[some] == face).mean() > 0.998


def test_a_tree_that_reinsertion_makes_too_deep_is_built_without(monkeypatch):
    points, indices = mixed_soup()
    fast, high = (TriangleBvh(points, indices, quality=quality) for quality in ("fast", "high"))
    assert high.data.nodes.numpy().tobytes() != fast.data.nodes.numpy().tobytes()
    monkeypatch.setattr(wide_tree, "DEEPEST", 5)
    refused = TriangleBvh(points, indices)
    assert refused.data.nodes.numpy().tobytes() == fast.data.nodes.numpy().tobytes()


def test_equal_boxes_are_chosen_by_index_whatever_their_number():
    areas = np.float32([1, 5, 5, 2, 5, 0, 5])
    assert wide_tree._largest(areas, 3).tolist() == [1, 2, 4]
    assert wide_tree._largest(areas, 5).tolist() == [1, 2, 4, 6, 3]
    assert wide_tree._largest(np.zeros(4, np.float32), 2).tolist() == [0, 1]


def test_quality_is_checked_and_kept():
    points, indices = mixed_soup(count=60)
    with pytest.raises(gi.OptionError, match=r"unknown quality 'hihg'; did you mean 'high'\? \(known: fast, high\)"):
        TriangleBvh(points, indices, quality="hihg")
    tree = TriangleBvh(points, indices, quality="fast")
    assert pickle.loads(pickle.dumps(tree)).quality == "fast"
    assert TriangleBvh(points, indices).quality == "high"
