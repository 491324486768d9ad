"""Octrees over samples against NumPy: codes, layout, when cells split and collapse, neighbours, what is taken over."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from statistics_tools import chi_squared, device, every_device  # noqa: F401

import warp_gi as gi
from warp_gi.kernels import octree, samples
from warp_gi.launch import launch, set_threads
from warp_gi.techniques.reuse import sample_octree

wp.set_module_options({"enable_backward": False})

LEVELS = 10  # of cells below the root's
SIDE = 1 << LEVELS
CODES = SIDE**3
EMPTY = 0xFFFFFFFF
LOW, HIGH = np.array([-3.0, 1.0, 10.0]), np.array([5.0, 4.0, 13.0])  # of the scene; the cube has its longest edge
SMALL = gi.SampleOctree(split=48, collapse=24)


# ---- kernels: a thread is a point, a code or a path ----


@wp.kernel
def encode_points(
    first: wp.int32, tree: octree.Octree, points: wp.array(dtype=wp.vec3), codes: wp.array(dtype=wp.uint32)
):
    i = first + wp.tid()
    codes[i] = octree.cell_code(tree, points[i])


@wp.kernel
def decode_codes(
    first: wp.int32, tree: octree.Octree, codes: wp.array(dtype=wp.uint32), points: wp.array(dtype=wp.vec3)
):
    i = first + wp.tid()
    points[i] = octree.code_position(tree, codes[i])


@wp.kernel
def find_leaves(
    first: wp.int32,
    nodes: wp.array(dtype=wp.uint32),
    codes: wp.array(dtype=wp.uint32),
    leaves: wp.array(dtype=wp.int32),
):
    i = first + wp.tid()
    leaves[i] = octree.octree_leaf(nodes, codes[i])


@wp.kernel
def find_slots(first: wp.int32, regions: samples.SampleRegions, lowest_path: wp.int64, slots: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    slots[i] = samples.sample_slot(regions, lowest_path + wp.int64(i))


# Thread: a leaf, or the place of one.
@wp.kernel
def find_cells(first: wp.int32, cube: octree.Octree, tree: octree.OctreeNodes, cells: wp.array(dtype=wp.vec4)):
    leaf = first + wp.tid()
    cells[leaf] = octree.leaf_cell(cube, tree, leaf)


def encoded(points, cube):
    codes = wp.empty(len(points), dtype=wp.uint32, device=device())
    launch(encode_points, len(points), [cube, wp.array(points, dtype=wp.vec3, device=device()), codes], device())
    return codes.numpy()


def leaves_of(codes, nodes):
    found = wp.empty(len(codes), dtype=wp.int32, device=device())
    launch(find_leaves, len(codes), [nodes, wp.array(codes, dtype=wp.uint32, device=device()), found], device())
    return found.numpy()


# ---- oracle: cells are ranges of codes ----


@dataclass
class Cells:
    """A tree spelled out: its leaves by rising code, and its inner cells."""

    leaves: np.ndarray
    """int [n] index"""
    starts: np.ndarray
    """int [n] lowest code"""
    depths: np.ndarray
    """int [n] 1 is an octant of the root"""
    inner: dict[tuple[int, int], int]
    """(depth, lowest code) to node"""

    def leaf_at(self, codes):
        """Return which of ``leaves`` holds each code."""
        return np.searchsorted(self.starts, codes, side="right") - 1


def cells_of(nodes):
    """Return the cells of a tree, whose layout is checked on the way: breadth first, inner children side by side."""
    leaves, inner, queue, expected = [], {(0, 0): 0}, [(0, 0, 0)], 1
    for depth, start, node in queue:
        offset, mask = int(nodes[node]) >> 8, int(nodes[node]) & 255
        assert offset < 1 << 24
        assert mask == 255 or offset == expected, "inner children do not follow those of the nodes before"
        for octant in range(8):
            cell = depth + 1, start + octant * 8 ** (LEVELS - depth - 1)
            if mask >> octant & 1:
                leaves.append((cell[1], cell[0], 8 * node + octant))
            else:
                assert depth + 1 < LEVELS, "an inner cell below the last level"
                inner[cell] = expected
                queue.append((*cell, expected))
                expected += 1
    assert expected == len(nodes)
    starts, depths, indices = np.array(sorted(leaves), np.int64).T
    return Cells(indices, starts, depths, inner)


def count_in(codes, depth, start):
    return int(np.searchsorted(codes, start + 8 ** (LEVELS - depth)) - np.searchsorted(codes, start))


def expected_inner(codes, before, split, collapse):
    """Return the inner cells (depth, lowest code) by the rule; ``codes`` are sorted, ``before`` the previous ones."""
    found = {(0, 0)}

    def visit(depth, start):
        for octant in range(8):
            cell = depth + 1, start + octant * 8 ** (LEVELS - depth - 1)
            count = count_in(codes, *cell)
            if cell[0] < LEVELS and (count > split or (cell in before and count >= collapse)):
                found.add(cell)
                visit(*cell)

    visit(0, 0)
    return found


def interleaved(places):
    """Morton codes of integer places [n, 3], x in the lowest bit."""
    places = np.asarray(places, np.int64)
    return sum((places[:, axis] >> bit & 1) << (3 * bit + axis) for bit in range(LEVELS) for axis in range(3))


def separated(codes):
    codes = np.asarray(codes, np.int64)
    return np.stack([sum((codes >> (3 * bit + axis) & 1) << bit for bit in range(LEVELS)) for axis in range(3)], axis=1)


def expected_neighbours(cells):
    """Return int [leaf, 6] of ``cells.leaves``: the leaf that holds the same cell one step on, if it is not smaller."""
    found = np.full((len(cells.leaves), 6), -1)
    edges = SIDE >> cells.depths
    for face in range(6):
        places = separated(cells.starts)
        places[:, face // 2] += np.where(face % 2, edges, -edges)
        inside = ((places >= 0) & (places < SIDE)).all(axis=1)
        other = cells.leaf_at(interleaved(places[inside]))
        kept = cells.depths[other] <= cells.depths[inside]
        found[inside, face] = np.where(kept, cells.leaves[other], -1)
    return found


def expected_origins(cells, old, codes):
    """Return int [leaf] of ``cells.leaves``: the previous leaf around it; or in it, down the fullest children."""
    places = old.leaf_at(cells.starts)
    origins = old.leaves[places]
    index_of = dict(zip(zip(old.depths, old.starts, strict=True), old.leaves, strict=True))
    for i in np.flatnonzero(old.depths[places] > cells.depths):
        cell = int(cells.depths[i]), int(cells.starts[i])
        while cell in old.inner:
            children = [(cell[0] + 1, cell[1] + octant * 8 ** (LEVELS - cell[0] - 1)) for octant in range(8)]
            cell = max(children, key=lambda child: count_in(codes, *child))  # the first of equals
        origins[i] = index_of[cell]
    return origins


# ---- trees of a sequence ----


def start(settings=SMALL):
    return settings.start(SimpleNamespace(bounds=np.array([LOW, HIGH], np.float32)), device())


def recorded(codes):
    """Records of the codes by slot, EMPTY where there is no sample."""
    records = samples.SampleRecords()
    records.codes = wp.array(np.asarray(codes, np.uint32), dtype=wp.uint32, device=device())
    for name in ("lights", "directions", "mixtures"):
        setattr(records, name, wp.zeros(len(codes), dtype=wp.uint32, device=device()))
    for name in ("contributions", "pdfs"):
        setattr(records, name, wp.zeros(len(codes), dtype=wp.float32, device=device()))
    records.vertices, records.stride = 1, 1
    return records


def learned(codes, state, settings=SMALL):
    return settings.learn(state, recorded(codes), device())


def random_places(rng, kind, count):
    """Integer places [count, 3] of a distribution."""
    u = rng.random((count, 3))
    if kind == "clusters":
        centres = rng.random((4, 3))
        u = centres[rng.integers(0, 4, count)] + rng.normal(size=(count, 3)) * 10.0 ** -rng.integers(1, 4, (count, 1))
    elif kind == "plane":
        normal = rng.normal(size=3)
        u = u - np.outer((u - 0.5) @ normal, normal) / (normal @ normal)
    elif kind == "corner":
        u = u**8
    elif kind == "cell":
        u = np.broadcast_to(rng.random(3), (count, 3))
    elif kind == "wall":
        u[:, 1] = 0.37
    return np.clip((u * SIDE).astype(np.int64), 0, SIDE - 1)


KINDS = ("uniform", "clusters", "plane", "corner", "cell", "wall")


@dataclass
class Step:
    """A frame: the tree before, the lesson, the codes by slot."""

    before: sample_octree.OctreeState
    lesson: sample_octree.Lesson
    codes: np.ndarray

    @property
    def sorted(self):
        return np.sort(self.codes[self.codes != EMPTY]).astype(np.int64)

    @property
    def old(self):
        return cells_of(self.before.octree.nodes.numpy())

    @property
    def cells(self):
        return cells_of(self.lesson.octree.octree.nodes.numpy())


@cache
def sequence(name):
    """Return twenty frames on the device of that name, each of another distribution and number of samples."""
    rng = np.random.default_rng(7)
    state, steps = start(), []
    for frame in range(20):
        count = int(rng.choice([1, 500, 2500, 6000]) if frame else 4000)
        codes = interleaved(random_places(rng, KINDS[rng.integers(len(KINDS)) if frame % 3 else 1], count))
        slots = np.full(count + int(rng.integers(1, 3000)), EMPTY)
        slots[rng.choice(len(slots), count, replace=False)] = codes
        lesson = learned(slots, state)
        steps.append(Step(state, lesson, slots))
        state = lesson.octree
    return steps


def steps():
    return sequence(device().alias)


def test_sequence_is_worth_testing():
    """Trees grow and shrink by several levels at once, and reach the last."""
    depths = [step.cells.depths.max() for step in steps()]
    changes = np.diff(depths)
    assert max(depths) == LEVELS and changes.max() >= 3 and changes.min() <= -3


# ---- codes ----


def test_codes_of_points():
    """Against bits written one by one; points outside belong to the nearest cell."""
    cube = start().octree
    edge = (HIGH - LOW).max() * 1.001
    corner = (LOW + HIGH) / 2 - edge / 2
    rng = np.random.default_rng(1)
    points = (corner + edge * (rng.random((5000, 3)) * 1.4 - 0.2)).astype(np.float32)
    points = np.concatenate([points, [LOW, HIGH, [-1e30, 2e30, 11.0], [1e9, -1e9, 1e9]]]).astype(np.float32)
    places = (points.astype(np.float64) - corner) / edge * SIDE
    sure = (np.abs(places - np.round(places)) > 1e-2).all(axis=1) | (np.abs(places) > 2 * SIDE).any(axis=1)
    expected = interleaved(np.clip(np.floor(places), 0, SIDE - 1).astype(np.int64))
    codes = encoded(points, cube)
    assert sure.mean() > 0.9 and sure[-2:].all()
    assert np.array_equal(codes[sure], expected[sure])
    assert codes.max() < CODES
    corners = separated(encoded(np.array([LOW, HIGH], np.float32), cube))
    assert corners[0, 0] == 0 and corners[1, 0] == SIDE - 1  # along the longest edge the scene fills the cube
    assert abs(corners[:, 1:].mean(axis=0) - (SIDE - 1) / 2).max() <= 1.0  # and is in its middle along the others


def test_places_of_codes():
    """The middle of the finest cell, whose code is the same."""
    cube = start().octree
    codes = np.append(np.random.default_rng(2).integers(0, CODES, 20_000), [0, 1, 2, 4, CODES - 1])
    points = wp.empty(len(codes), dtype=wp.vec3, device=device())
    launch(decode_codes, len(codes), [cube, wp.array(codes, dtype=wp.uint32, device=device()), points], device())
    expected = (separated(codes) + 0.5) / cube.scale + np.array(cube.low)
    assert np.abs(points.numpy() - expected).max() < 1e-3 / cube.scale
    assert np.array_equal(encoded(points.numpy(), cube), codes)


def test_first_tree_is_eight_leaves():
    state = start()
    assert state.octree.nodes.numpy().tolist() == [255] and state.leaf_count == 8
    assert state.counts.numpy().tolist() == [0] * 8


def test_scene_without_size():
    settings = gi.SampleOctree()
    state = settings.start(SimpleNamespace(bounds=np.ones((2, 3), np.float32)), device())
    assert encoded(np.ones((1, 3), np.float32), state.octree)[0] < CODES


# ---- layout, and where points are ----


def test_leaves_tile_the_cube():
    for step in steps():
        cells = step.cells  # checks the layout
        sizes = 8 ** (LEVELS - cells.depths)
        assert cells.starts[0] == 0
        assert np.array_equal(cells.starts + sizes, np.append(cells.starts[1:], CODES))


def test_points_are_in_the_leaf_around_them():
    rng = np.random.default_rng(2)
    for step in steps():
        cells = step.cells
        codes = np.concatenate([step.sorted, rng.integers(0, CODES, 2000), [0, CODES - 1]])
        assert np.array_equal(leaves_of(codes, step.lesson.octree.octree.nodes), cells.leaves[cells.leaf_at(codes)])


def test_nodes_know_their_cells():
    for step in steps():
        state = step.lesson.octree
        inner = step.cells.inner
        assert list(inner.values()) == list(range(len(inner)))
        assert np.array_equal(state.levels.numpy(), [depth for depth, _ in inner])
        assert np.array_equal(state.prefixes.numpy(), [first for _, first in inner])
        assert state.leaf_count == 8 * len(inner)


def test_places_of_leaves():
    """Centre and half of the diagonal, from codes taken apart bit by bit."""
    edge = (HIGH - LOW).max() * 1.001
    corner, finest = (LOW + HIGH) / 2 - edge / 2, edge / SIDE
    for step in steps():
        cells = step.cells
        found = wp.empty(step.lesson.octree.leaf_count, dtype=wp.vec4, device=device())
        inputs = [step.lesson.octree.octree, step.lesson.tree, found]
        launch(find_cells, found.size, inputs, device())
        found = found.numpy()[cells.leaves].astype(np.float64)
        half = finest * (SIDE >> cells.depths) / 2
        centers = corner + separated(cells.starts) * finest + half[:, None]
        assert np.allclose(found[:, :3], centers, rtol=0, atol=0.01 * finest)
        assert np.allclose(found[:, 3], half * np.sqrt(3), rtol=1e-5)


# ---- samples ----


def test_sample_counts_add_up():
    for step in steps():
        cells, counts = step.cells, step.lesson.octree.counts.numpy()
        assert counts[cells.leaves].sum() == len(step.sorted)
        found = np.bincount(cells.leaf_at(step.sorted), minlength=len(cells.leaves))
        assert np.array_equal(counts[cells.leaves], found)
        counted = step.lesson.samples.counts.numpy()
        assert np.array_equal(counted[cells.leaves], found)
        assert not np.delete(counted, cells.leaves).any()  # places of inner cells have none
        assert np.array_equal(step.lesson.samples.starts.numpy()[cells.leaves], np.cumsum(found) - found)
        sums = counts.reshape(-1, 8).sum(axis=1)
        within = {node: count_in(step.sorted, *cell) for cell, node in cells.inner.items()}
        for cell, node in cells.inner.items():
            below = [cells.inner.get((cell[0] + 1, cell[1] + k * 8 ** (LEVELS - cell[0] - 1))) for k in range(8)]
            for octant, child in enumerate(below):  # places of inner cells hold what is in them, or 0
                assert child is None or counts[8 * node + octant] in (0, within[child])
            left_out = sum(within[child] for k, child in enumerate(below) if child and not counts[8 * node + k])
            assert sums[node] + left_out == within[node]


def test_order_is_a_stable_sort():
    for step in steps():
        order = step.lesson.samples.order.numpy()
        kept = np.flatnonzero(step.codes != EMPTY)
        assert np.array_equal(order, kept[np.argsort(step.codes[kept], kind="stable")])


# ---- growing and shrinking ----


def test_cells_split_and_collapse_by_the_rule():
    for step in steps():
        assert set(step.cells.inner) == expected_inner(step.sorted, step.old.inner, SMALL.split, SMALL.collapse)


@pytest.mark.parametrize(
    ("counts", "inner"),
    [
        ((48,), False),
        ((49,), True),
        ((49, 48), True),
        ((49, 24), True),
        ((49, 23), False),
        ((49, 23, 48), False),
        ((49, 24, 24), True),
        ((49, 0), False),
    ],
)
def test_thresholds(counts, inner):
    """An octant of the root with that many samples a frame, evenly in its octants."""
    state = start()
    for count in counts:
        codes = (5 << 27) + (np.arange(count) % 8 << 24) + np.arange(count)
        state = learned([*codes, EMPTY], state).octree
    assert ((1, 5 << 27) in cells_of(state.octree.nodes.numpy()).inner) is inner
    assert state.octree.nodes.shape[0] == 1 + inner


def test_one_frame_is_enough():
    """Samples that all lie in one of the smallest cells split the first tree down to it; then one is left."""
    code = 0o1234567012
    lesson = learned(np.full(5000, code), start())
    cells = cells_of(lesson.octree.octree.nodes.numpy())
    assert len(cells.inner) == LEVELS and cells.depths.max() == LEVELS
    leaf = cells.leaf_at(code)
    assert cells.starts[leaf] == code and lesson.octree.counts.numpy()[cells.leaves[leaf]] == 5000
    assert set(lesson.origins.numpy()[cells.leaves]) == set(range(8))
    after = learned([code], lesson.octree)
    assert after.octree.octree.nodes.numpy().tolist() == [(1 << 8) | 255]
    assert after.origins.numpy()[1] == cells.leaves[leaf]  # of the octant with the sample


def test_one_sample():
    lesson = learned([EMPTY, 7 << 27, EMPTY], start())
    assert lesson.octree.counts.numpy().tolist() == [0] * 7 + [1]
    assert lesson.samples.order.numpy().tolist() == [1]
    assert lesson.origins.numpy().tolist() == list(range(8))


def test_no_sample():
    """A frame that sees nothing but sky: the tree is given up, and nothing else happens."""
    grown = learned(np.full(5000, 0o1234567012), start()).octree
    for state in (start(), grown):
        lesson = learned(np.full(3000, EMPTY), state)
        assert lesson.octree.leaf_count == 8
        assert lesson.octree.counts.numpy().tolist() == [0] * 8
        assert (lesson.origins.numpy() >= 0).all()


@pytest.mark.parametrize("slots", [1, 1023, 1024, 1025, 4096])
def test_every_slot_counts(slots):
    """Chunks that threads compact have 1,024 slots."""
    rng = np.random.default_rng(slots)
    codes = rng.integers(0, CODES, slots)
    lesson = learned(codes, start())
    assert np.array_equal(lesson.samples.order.numpy(), np.argsort(codes, kind="stable"))


def test_smallest_thresholds():
    """One sample keeps a cell, two split it: the most nodes that samples can have."""
    settings = gi.SampleOctree(split=1, collapse=1)
    state, before = start(settings), {(0, 0): 0}
    codes = np.sort(np.random.default_rng(3).integers(0, CODES, 300).repeat(2))
    for kept in (codes, codes[::2], codes[:10]):
        state = learned(kept, state, settings).octree
        inner = cells_of(state.octree.nodes.numpy()).inner
        assert set(inner) == expected_inner(kept, before, 1, 1)
        before = inner


# ---- neighbours, correspondence ----


def test_neighbours():
    coarser = equal = 0
    for step in steps():
        cells = step.cells
        found = step.lesson.neighbours.numpy().reshape(-1, 6)
        assert np.array_equal(found[cells.leaves], expected_neighbours(cells))
        without = np.delete(np.arange(len(found)), cells.leaves)
        assert (found[without] == -1).all()
        depth = np.zeros(len(found), int)
        depth[cells.leaves] = cells.depths
        leaf, face = np.nonzero(found >= 0)
        other = found[leaf, face]
        same = depth[other] == depth[leaf]
        assert np.array_equal(found[other[same], face[same] ^ 1], leaf[same])  # mutual
        equal, coarser = equal + same.sum(), coarser + (~same).sum()
    assert equal > 1000 and coarser > 1000


def test_origins():
    grown = shrunk = 0
    for step in steps():
        cells, old = step.cells, step.old
        origins = step.lesson.origins.numpy()
        assert np.array_equal(origins[cells.leaves], expected_origins(cells, old, step.sorted))
        assert (np.delete(origins, cells.leaves) == -1).all()
        depth = dict(zip(old.leaves, old.depths, strict=True))
        change = cells.depths - [depth[origin] for origin in origins[cells.leaves]]
        grown, shrunk = grown + (change > 1).sum(), shrunk + (change < -1).sum()
    assert grown > 10 and shrunk > 10


def test_origin_of_a_collapsed_cell_is_the_fullest():
    """Not the first, nor the one that was fullest in the frame before; greedy, so not the fullest leaf of all."""
    first = 3 << 27
    codes = np.concatenate([np.full(60, first), np.full(60, first + (6 << 24))])
    before = learned(codes, start()).octree
    cells = cells_of(before.octree.nodes.numpy())
    # child 6 holds 9 in three cells, child 0 holds 8 in one
    now = np.concatenate([np.full(8, first), [first + (6 << 24) + k for k in (0, 0, 0, 1, 1, 1, 1, 2, 2)]])
    lesson = learned(now, before)
    assert lesson.octree.leaf_count == 8
    assert lesson.origins.numpy()[3] == cells.leaves[cells.leaf_at(first + (6 << 24) + 1)]


# ---- records ----


def opened(resolution, spp, vertices, most, seed=5, previous=None):
    items = math.prod(8 * math.ceil(size / 8) for size in resolution)
    frame = SimpleNamespace(tiled_items=items, settings=SimpleNamespace(spp=spp), device=device(), seed=seed)
    return gi.SampleOctree(most_samples=most).records(frame, vertices, previous)


def paths_of(resolution, spp):
    """Paths with a number: those of pixels of whole tiles."""
    return -(-resolution[0] // 8) * -(-resolution[1] // 8) * 64 * spp


def slots_of(records, paths, lowest_path=0):
    regions = samples.SampleRegions()
    regions.octree, regions.records = start().octree, records
    slots = wp.empty(paths, dtype=wp.int32, device=device())
    launch(find_slots, paths, [regions, lowest_path, slots], device())
    return slots.numpy()


CASES = [
    ((16, 16), 1, 1, 1 << 20),
    ((17, 9), 3, 7, 1 << 20),
    ((100, 60), 4, 7, 1 << 12),
    ((31, 65), 5, 3, 1024),
    ((8, 8), 1, 2000, 1024),  # a path has more vertices than there is room for
    ((64, 64), 1, 1, 4096),
    ((64, 64), 1, 1, 4095),
]


@pytest.mark.parametrize(("resolution", "spp", "vertices", "most"), CASES)
def test_each_recorded_path_has_its_own_slots(resolution, spp, vertices, most):
    records = opened(resolution, spp, vertices, most)
    paths = paths_of(resolution, spp)
    size = records.codes.shape[0]
    assert size < most + vertices and size % vertices == 0
    assert records.stride == 1 or size * records.stride > most - vertices, "thinned more than needed"
    names = ("lights", "light_values", "directions", "contributions", "pdfs", "mixtures", "nearness", "carried")
    for name in names:
        assert getattr(records, name).shape[0] == size
    assert (records.codes.numpy() == EMPTY).all()
    slots = slots_of(records, paths)
    kept = np.flatnonzero(slots >= 0)
    assert (slots[kept] % vertices == 0).all() and slots[kept].max(initial=0) <= size - vertices
    assert len(np.unique(slots[kept])) == len(kept)
    groups = np.bincount(kept // records.stride, minlength=-(-paths // records.stride))
    assert groups.max() == 1 and (groups[: paths // records.stride] == 1).all()


@pytest.mark.parametrize("lowest", [(1 << 31) - 40_000, (1 << 32) - 40_000, 1 << 35])
def test_paths_beyond_32_bits(lowest):
    """As of 8K pictures with 1,024 samples a pixel; of each group one path is recorded, in the place of the group."""
    records = opened((256, 256), 4, 7, 1 << 20)
    records.stride = stride = 20_011
    first = -(-lowest // stride)
    slots = slots_of(records, 8 * stride, first * stride).reshape(8, stride)
    assert ((slots >= 0).sum(axis=1) == 1).all()
    assert np.array_equal(slots.max(axis=1), 7 * (first + np.arange(8)))
    assert len(np.unique(slots.argmax(axis=1))) > 4


@pytest.mark.parametrize("most", [100_000, 30_000, 7000])
def test_thinning_is_fair(most):
    """Each of the paths of a group is recorded equally often, whatever another frame recorded."""
    turns = []
    for seed in (12345, 0xFEDCBA98):
        records = opened((256, 256), 4, 1, most, seed)
        paths = paths_of((256, 256), 4) // records.stride * records.stride
        slots = slots_of(records, paths)
        turns.append(np.flatnonzero(slots >= 0) % records.stride)
    stride, groups = records.stride, len(turns[0])
    assert 3 <= stride <= 38
    for turn in turns:
        assert chi_squared(np.bincount(turn, minlength=stride), np.full(stride, groups / stride)) > 1e-4
        pairs = turn[:-1] * stride + turn[1:]  # groups side by side
        assert chi_squared(np.bincount(pairs, minlength=stride**2), np.full(stride**2, len(pairs) / stride**2)) > 1e-4
    both = np.bincount(turns[0] * stride + turns[1], minlength=stride**2)
    assert chi_squared(both, np.full(stride**2, groups / stride**2)) > 1e-4


def test_records_are_used_again():
    first = opened((64, 64), 2, 3, 1 << 20, seed=1)
    first.codes.fill_(3)
    again = opened((64, 64), 2, 3, 1 << 20, seed=2, previous=first)
    assert again.codes.ptr == first.codes.ptr and again.seed == 2
    assert (again.codes.numpy() == EMPTY).all()
    other = opened((64, 65), 2, 3, 1 << 20, previous=first)
    assert other.codes.shape[0] == paths_of((64, 65), 2) * 3
    # as many slots, but of other paths
    wider = opened((64, 64), 3, 2, 1 << 20, previous=first)
    assert wider.codes.shape[0] == first.codes.shape[0] and (wider.vertices, wider.stride) == (2, 1)


# ---- threads, settings ----


def test_threads_do_not_matter():
    rng = np.random.default_rng(4)
    frames = [interleaved(random_places(rng, kind, 60_000)) for kind in ("clusters", "plane")]
    results = []
    try:
        for threads in (1, 4):
            set_threads(threads)
            state = start()
            for codes in frames:
                lesson = learned(codes, state)
                state = lesson.octree
            arrays = (
                state.octree.nodes,
                state.prefixes,
                state.levels,
                state.counts,
                lesson.samples.starts,
                lesson.samples.order,
                lesson.neighbours,
                lesson.origins,
            )
            results.append([x.numpy().copy() for x in arrays])
    finally:
        set_threads(None)
    assert len(results[0][0]) > 500
    for a, b in zip(*results, strict=True):
        assert np.array_equal(a, b)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"collapse": 0}, "collapse"),
        ({"split": 100}, "collapse"),
        ({"split": 0, "collapse": 0}, "split"),
        ({"collapse": float("nan")}, "collapse"),
        ({"most_samples": 1023}, "most_samples"),
        ({"most_samples": (1 << 28) + 1}, "most_samples"),
        ({"split": (1 << 32) + 1}, "split"),  # kernels would read 1, and nodes would not fit into their arrays
    ],
)
def test_settings_are_checked(settings, message):
    with pytest.raises(gi.OptionError, match=message):
        gi.SampleOctree(**settings)


def test_too_many_cells(monkeypatch):
    monkeypatch.setattr(sample_octree, "MOST_CELLS", 100)
    with pytest.raises(gi.OptionError, match="raise collapse"):
        learned(np.random.default_rng(5).integers(0, CODES, 20_000), start())
