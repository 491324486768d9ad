"""Directional quadtrees against a decoder that knows cells only: bits, migration, both samplers, adaptation."""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from fractions import Fraction
from functools import cache

import numpy as np
import pytest
import warp as wp
from parallax_tools import has_parallax, seen_from_anchor, unit
from scipy.stats import qmc
from statistics_tools import chi_squared, device, every_device, sphere_expectation, sphere_histogram  # noqa: F401

from warp_gi.kernels import octahedral, quadtree, quadtree_adapt, sampling
from warp_gi.launch import launch, set_threads

wp.set_module_options({"enable_backward": False})

SIZES = (32, 64, 96, 128)
LEVELS = int(quadtree.QUADTREE_LEVELS)


# ---- kernels: a thread is a tree, or a point of one tree ----


# What a tree answers about its nodes.
@wp.kernel
def ask_nodes(
    first: wp.int32,
    bits: wp.int32,
    trees: wp.array(dtype=wp.vec4ui),
    ranks: wp.array2d(dtype=wp.uint8),
    selected: wp.array2d(dtype=wp.uint8),
    places: wp.array2d(dtype=wp.uint32),
):
    i = first + wp.tid()
    tree = trees[i]
    inner = bits / 4 - 1
    for k in range(bits):
        ranks[i, k] = wp.uint8(quadtree.quadtree_rank(tree, k))
        place = quadtree.quadtree_ascend(tree, k)
        # 2^level + column and 2^level + row, which say the level too
        column = wp.uint32((1 << place[2]) + place[0])
        row = wp.uint32((1 << place[2]) + place[1])
        places[i, k] = (column << wp.uint32(16)) | row
        if k < inner:
            selected[i, k] = wp.uint8(quadtree.quadtree_select1(tree, k))
        else:
            selected[i, k] = wp.uint8(quadtree.quadtree_select0(tree, bits, k - inner))


# How many leaves are found by a point in the middle and by points in the four corners.
@wp.kernel
def locate_leaves(first: wp.int32, bits: wp.int32, trees: wp.array(dtype=wp.vec4ui), found: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    count = int(0)
    for leaf in range(quadtree.quadtree_leaf_count(bits)):
        node = quadtree.quadtree_select0(trees[i], bits, leaf)
        place = quadtree.quadtree_ascend(trees[i], node)
        size = 1.0 / wp.float32(1 << place[2])
        left = wp.float32(place[0]) * size
        low = wp.float32(place[1]) * size
        last = size - 5.9604644775390625e-8
        for corner in range(5):
            x = left + wp.where(corner == 4, 0.5 * size, wp.where((corner & 1) == 1, last, 0.0))
            y = low + wp.where(corner == 4, 0.5 * size, wp.where((corner & 2) == 2, last, 0.0))
            other = quadtree.quadtree_locate(trees[i], bits, wp.vec2(x, y))
            if other.node == node and other.x == left and other.y == low and other.size == size:
                count += 1
    found[i] = count


@wp.kernel
def find_level_starts(
    first: wp.int32, bits: wp.int32, trees: wp.array(dtype=wp.vec4ui), starts: wp.array2d(dtype=wp.int32)
):
    i = first + wp.tid()
    for level in range(starts.shape[1]):
        starts[i, level] = quadtree.quadtree_level_start(trees[i], bits, level + 1)


@wp.kernel
def halve_words(
    first: wp.int32, words: wp.array(dtype=wp.uint64), i: wp.array(dtype=wp.int32), out: wp.array(dtype=wp.int32)
):
    k = first + wp.tid()
    out[k] = quadtree.select_by_halves(words[k], i[k])


# Whether all four children of inner node k are leaves.
@wp.func
def is_twig(tree: wp.vec4ui, bits: wp.int32, k: wp.int32) -> wp.bool:
    child = quadtree.quadtree_children(tree, k)
    for i in range(bits / 4 - 1):
        if (quadtree.quadtree_select1(tree, i) & ~3) == child:
            return False
    return True


# Migrates random leaves and writes every tree, with the nodes that were migrated to get it (none: -1).
@wp.kernel
def walk(
    first: wp.int32,
    bits: wp.int32,
    steps: wp.int32,
    tree: wp.vec4ui,
    trees: wp.array(dtype=wp.vec4ui),
    moves: wp.array(dtype=wp.vec2i),
):
    i = first + wp.tid()
    now = wp.vec4ui(tree)
    for step in range(steps):
        a = sampling.random_1d(wp.uint32(i * steps + step), wp.uint32(1), 0)
        b = sampling.random_1d(wp.uint32(i * steps + step), wp.uint32(1), 1)
        leaves = quadtree.quadtree_leaf_count(bits)
        leaf = quadtree.quadtree_select0(now, bits, wp.int32(a * wp.float32(leaves)))
        inner = quadtree.quadtree_select1(now, wp.int32(b * wp.float32(bits / 4 - 1)))
        moves[i * steps + step] = wp.vec2i(-1, -1)
        if (
            is_twig(now, bits, inner)
            and quadtree.quadtree_children(now, inner) != (leaf & ~3)
            and leaf < quadtree.quadtree_level_start(now, bits, quadtree.QUADTREE_LEVELS)
        ):
            now = quadtree.quadtree_migrate(now, bits, leaf, inner)
            moves[i * steps + step] = wp.vec2i(leaf, inner)
        trees[i * steps + step] = now


@wp.kernel
def fill_counts(first: wp.int32, bits: wp.int32, trees: wp.array(dtype=wp.vec4ui), counts: wp.array(dtype=wp.uint32)):
    i = first + wp.tid()
    quadtree.quadtree_counts(trees[i], bits, counts, i * (bits / 4))


# Points (x, y, level), directions and densities of both samplers, and the density of each direction.
@wp.kernel
def draw(
    first: wp.int32,
    bits: wp.int32,
    tree: wp.vec4ui,
    counts: wp.array(dtype=wp.uint32),
    numbers: wp.array(dtype=wp.vec3),
    points: wp.array2d(dtype=wp.vec3),
    directions: wp.array2d(dtype=wp.vec3),
    densities: wp.array2d(dtype=wp.vec2),
):
    i = first + wp.tid()
    u2 = wp.vec2(numbers[i][0], numbers[i][1])
    a = quadtree.quadtree_leaf_point(tree, bits, numbers[i][2], u2)
    b = quadtree.quadtree_warp_point(tree, bits, counts, 0, u2)
    points[0, i] = wp.vec3(a.uv[0], a.uv[1], wp.float32(a.level))
    points[1, i] = wp.vec3(b.uv[0], b.uv[1], wp.float32(b.level))
    c = quadtree.quadtree_sample_leaf(tree, bits, numbers[i][2], u2)
    d = quadtree.quadtree_sample_warp(tree, bits, counts, 0, u2)
    directions[0, i] = c.direction
    directions[1, i] = d.direction
    densities[0, i] = wp.vec2(c.pdf, quadtree.quadtree_pdf(tree, bits, c.direction))
    densities[1, i] = wp.vec2(d.pdf, quadtree.quadtree_pdf(tree, bits, d.direction))


@wp.kernel
def evaluate(
    first: wp.int32,
    bits: wp.int32,
    tree: wp.vec4ui,
    directions: wp.array(dtype=wp.vec3),
    pdf: wp.array(dtype=wp.float32),
    density: wp.array(dtype=wp.float32),
    packed: wp.array(dtype=wp.uint32),
    uvs: wp.array(dtype=wp.vec2),
    unpacked: wp.array(dtype=wp.vec3),
):
    i = first + wp.tid()
    pdf[i] = quadtree.quadtree_pdf(tree, bits, directions[i])
    density[i] = quadtree.octahedral_density(directions[i])
    packed[i] = quadtree_adapt.quadtree_pack_direction(directions[i])
    uvs[i] = octahedral.octahedral_encode(directions[i])
    unpacked[i] = quadtree_adapt.quadtree_unpack_direction(packed[i])


# ---- oracle: a tree is the set of its inner cells (level, column, row), of which (0, 0, 0) is always one ----


def children(cell):
    level, x, y = cell
    return [(level + 1, 2 * x + (q & 1), 2 * y + (q >> 1)) for q in range(4)]


def encoded(inner):
    """The tree as a number, and its nodes' cells in breadth-first order."""
    cells, number = [], 0
    queue = [(0, 0, 0)]
    while queue:
        following = []
        for cell in queue:
            for child in children(cell):
                if child in inner:
                    number |= 1 << len(cells)
                    following.append(child)
                cells.append(child)
        queue = following
    return number, cells


def decoded(number, bits):
    """The cells of a tree's nodes, and the set of its inner cells."""
    cells, inner = children((0, 0, 0)), {(0, 0, 0)}
    for k in range(bits):
        if number >> k & 1:
            inner.add(cells[k])
            cells += children(cells[k])
    assert len(cells) == bits and number >> bits == 0
    return cells, inner


def words(numbers):
    """Trees as an array [tree] of four 32-bit words."""
    values = [[number >> (32 * w) & 0xFFFFFFFF for w in range(4)] for number in numbers]
    return np.array(values, np.uint32).reshape(-1, 4)


def number_of(four):
    return sum(int(word) << (32 * i) for i, word in enumerate(four))


@cache
def random_trees(bits, count, deepest=8, seed=1):
    """Trees that grew by splitting random leaves, some towards a point, as numbers."""
    rng = np.random.default_rng([bits, seed])
    numbers = []
    for i in range(count):
        inner, leaves = {(0, 0, 0)}, children((0, 0, 0))
        target = rng.random(2)
        while len(inner) < bits // 4:
            near = [
                k
                for k, (level, x, y) in enumerate(leaves)
                if level < deepest and (x, y) == tuple((target * 2**level).astype(int))
            ]
            k = near[0] if near and i % 2 and rng.random() < 0.4 else int(rng.integers(len(leaves)))
            if leaves[k][0] < deepest:
                inner.add(leaves[k])
                leaves += children(leaves.pop(k))
        numbers.append(encoded(inner)[0])
    return numbers


def bit_matrix(trees, bits):
    """Bits uint8 [tree, node] of trees [tree, 4]."""
    return np.unpackbits(trees.view(np.uint8), axis=1, bitorder="little")[:, :bits]


def are_valid(trees, bits):
    """Whether each tree has as many inner nodes as it must, each of which is a child of one before it."""
    ones = bit_matrix(trees, bits).astype(np.int32)
    before = np.cumsum(ones, axis=1) - ones
    right = (ones.sum(axis=1) == bits // 4 - 1) & (np.arange(bits) < 4 * (before + 1)).all(axis=1)
    return right & ~trees[:, bits // 32 :].any(axis=1)


@cache
def all_trees():
    """All quadtrees of 32 bits: inner node j, not counting the root, is one of the first 4 (j + 1) nodes."""
    last, numbers = np.array([-1]), np.array([0], np.uint64)
    for j in range(7):
        grown = [(np.full(1, 0), np.full(1, 0, np.uint64))][:0]
        for place in range(4 * (j + 1)):
            chosen = last < place
            grown.append((np.full(chosen.sum(), place), numbers[chosen] | np.uint64(1 << place)))
        last, numbers = (np.concatenate(parts) for parts in zip(*grown, strict=True))
    return np.stack([numbers.astype(np.uint32), *3 * [np.zeros(len(numbers), np.uint32)]], axis=1)


def preimages(number, bits):
    """Of each leaf's cell the rectangle (x0, x1, y0, y1) that quadtree_warp_point maps to it, exactly."""
    _, inner = decoded(number, bits)

    @cache
    def leaves_below(cell):
        return sum(map(leaves_below, children(cell))) if cell in inner else 1

    rectangles = {}

    def divide(cell, x0, x1, y0, y1):
        if cell not in inner:
            rectangles[cell] = (x0, x1, y0, y1)
            return
        four = children(cell)
        n = [leaves_below(child) for child in four]
        x = x0 + (x1 - x0) * Fraction(n[0] + n[2], sum(n))
        for side, (left, right) in enumerate([(x0, x), (x, x1)]):
            y = y0 + (y1 - y0) * Fraction(n[side], n[side] + n[side + 2])
            divide(four[side], left, right, y0, y)
            divide(four[side + 2], left, right, y, y1)

    divide((0, 0, 0), Fraction(0), Fraction(1), Fraction(0), Fraction(1))
    return rectangles


def migrated(number, bits, leaf, inner_node):
    cells, inner = decoded(number, bits)
    return encoded(inner - {cells[inner_node]} | {cells[leaf]})


def chosen(values, sign):
    """Index of the largest (``sign`` 1) or smallest (-1) value, the first of equals; the kernel's float32 must find the
    same one, so no other value may come near without being equal."""
    values = sign * np.array(values)
    best = int(np.argmax(values))
    margin = values[best] - values[values != values[best]]
    assert not len(margin) or margin.min() > 1e-5 * np.abs(values[best]), "a tie that depends on rounding"
    return best


def adapted(number, bits, energies, record, migrations, significance, fading):
    """The tree after one frame, and energies [quadrant] of its leaves by cell (as ``energies``, before), in float64.

    ``record``: packed directions, contributions, densities per sr, as seen from the anchor. Of each sample c^2 p, p
    over the square, counts.
    """
    cells, inner = decoded(number, bits)
    packed, contributions, pdfs = record
    weight = (1 - fading) * min(len(packed) / 256, 1)
    energies = {cell: energies[cell] * (1 - weight) for cell in cells if cell not in inner}
    densities = pdfs / oracle_density(decoded_directions(uv_of(packed)))
    for (x, y), c, p in zip(uv_of(packed), contributions, densities, strict=True):
        cell = (0, 0, 0)
        while cell in inner:
            level = cell[0] + 1
            cell = (level, int(x * 2**level), int(y * 2**level))
        level = cell[0] + 1
        quadrant = int(x * 2**level) % 2 + 2 * (int(y * 2**level) % 2)
        energies[cell][quadrant] += weight / len(packed) * max(c, 0.0) ** 2 * p
    for _ in range(migrations if (contributions >= 0).any() else 0):
        cells = encoded(inner)[1]
        leaves = [c for c in cells if c not in inner and c[0] < LEVELS]
        gains = [0.25 ** c[0] * total(energies[c]) for c in leaves]
        k = chosen(gains, 1)
        leaf, gain = leaves[k], gains[k]
        twigs = [c for c in cells if c in inner and not set(children(c)) & inner and leaf not in children(c)]
        losses = [0.25 ** c[0] * total([total(energies[child]) for child in children(c)]) for c in twigs]
        k = chosen(losses, -1)
        twig, loss = twigs[k], losses[k]
        assert gain * significance == loss or abs(gain * significance / loss - 1 if loss else 1) > 1e-5
        if not gain * significance > loss:
            break
        energies[twig] = np.array([total(energies.pop(child)) for child in children(twig)])
        for child, energy in zip(children(leaf), energies.pop(leaf), strict=True):
            energies[child] = np.full(4, energy / 4)
        inner = inner - {twig} | {leaf}
    return encoded(inner)[0], energies


def total(four):
    """Sum of four; equal ones add up to four times one, so that what was split in quarters is whole again."""
    return (four[0] + four[1]) + (four[2] + four[3])


def decoded_directions(uvs):
    """Unit directions float64 of points of the octahedral map."""
    x, z = (2 * np.asarray(uvs, np.float64) - 1).T
    y = 1 - np.abs(x) - np.abs(z)
    fold = np.maximum(-y, 0)
    q = np.stack([x - np.where(x < 0, -1, 1) * fold, y, z - np.where(z < 0, -1, 1) * fold], axis=-1)
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def oracle_density(directions):
    """Of the octahedral map: d area of the square / d solid angle, as kernels/quadtree.py derives it; float64."""
    d = np.asarray(directions, np.float64)
    return 0.25 * (np.linalg.norm(d, axis=-1) / np.abs(d).sum(axis=-1)) ** 3


def differenced_density(directions):
    """Of the octahedral map, 1 / |(d direction / du) x (d direction / dv)|, by differences in float64."""
    u, v = octahedral_of(np.asarray(directions, np.float64)).T
    h = 1e-6

    def direction(u, v):
        return decoded_directions(np.stack([u, v], axis=-1))

    du = (direction(u + h, v) - direction(u - h, v)) / (2 * h)
    dv = (direction(u, v + h) - direction(u, v - h)) / (2 * h)
    return 1 / np.linalg.norm(np.cross(du, dv), axis=-1)


# ---- the kernels on arrays ----


def on_device(values, dtype):
    return wp.array(values, dtype=dtype, device=device())


def empty(shape, dtype):
    return wp.zeros(shape, dtype=dtype, device=device())


def counts_of(trees, bits):
    counts = empty(len(trees) * bits // 4, wp.uint32)
    launch(fill_counts, len(trees), [bits, on_device(trees, wp.vec4ui), counts], device())
    return counts


def drawn(number, bits, numbers):
    """Points, directions [sampler, i, 3] and densities [sampler, i, 2] of numbers [i, 3]."""
    tree = words([number])
    shape = (2, len(numbers))
    points, directions, densities = (empty(shape, t) for t in (wp.vec3, wp.vec3, wp.vec2))
    inputs = [bits, wp.vec4ui(*map(int, tree[0])), counts_of(tree, bits), on_device(numbers, wp.vec3)]
    launch(draw, len(numbers), [*inputs, points, directions, densities], device())
    return points.numpy(), directions.numpy(), densities.numpy()


def evaluated(number, bits, directions):
    """pdf, octahedral_density, packed directions, octahedral coordinates and the packed directions unpacked."""
    n = len(directions)
    outputs = [empty(n, t) for t in (wp.float32, wp.float32, wp.uint32, wp.vec2, wp.vec3)]
    tree = wp.vec4ui(*map(int, words([number])[0]))
    launch(evaluate, n, [bits, tree, on_device(directions, wp.vec3), *outputs], device())
    return [output.numpy() for output in outputs]


def walked(bits, threads, steps):
    """Trees [thread, step, 4] and moves [thread, step, 2]."""
    trees, moves = empty(threads * steps, wp.vec4ui), empty(threads * steps, wp.vec2i)
    start = wp.vec4ui(*quadtree.quadtree_uniform(bits))
    launch(walk, threads, [bits, steps, start, trees, moves], device(), 1)
    return trees.numpy().reshape(threads, steps, 4), moves.numpy().reshape(threads, steps, 2)


LOW, SCALE = np.array([-3.0, 1.0, 10.0]), 100.0  # corner of the octree's cube, its finest cells per metre


def positions_of(codes):
    """Middles float64 [n, 3] of the finest cells of an octree."""
    codes = np.asarray(codes, np.int64)
    places = [sum((codes >> (3 * bit + axis) & 1) << bit for bit in range(10)) for axis in range(3)]
    return (np.stack(places, axis=-1) + 0.5) / SCALE + LOW


def from_anchor(record, anchor):
    """What `adapted` takes, of a record that has codes of positions: directions and densities at the anchor."""
    packed, contributions, pdfs, codes = record
    anchor = np.asarray(anchor, np.float64)
    seen, stretch = seen_from_anchor(anchor, positions_of(codes), decoded_directions(uv_of(packed) + 0.5 / 65536))
    return packed_of(octahedral_of(seen)), contributions, pdfs / stretch


def octahedral_of(directions):
    """Points of the octahedral map of directions, float64."""
    q = directions / np.abs(directions).sum(axis=-1, keepdims=True)
    x, z, lower = q[:, 0], q[:, 2], q[:, 1] < 0
    u = np.where(lower, np.where(x < 0, -1, 1) * (1 - np.abs(z)), x)
    v = np.where(lower, np.where(z < 0, -1, 1) * (1 - np.abs(x)), z)
    return np.stack([u + 1, v + 1], axis=-1) / 2


def adapt(
    trees, bits, records, migrations=1, most_samples=1 << 30, significance=0.5, fading=0.0, energies=None, anchors=None
):
    """Trees [leaf, 4], counts and energies [leaf, node, quadrant] after one frame; ``energies``: before, none are 0.

    ``records`` is [leaf] of (packed directions, contributions, densities per sr) and, with ``anchors`` [leaf, 4],
    codes of positions.
    """
    if anchors is None:  # positions do not matter then
        anchors = np.zeros((len(trees), 4))
        records = [(*record[:3], np.full(len(record[0]), 7)) for record in records]
    lengths = np.array([len(record[0]) for record in records], np.int32)
    total = int(lengths.sum())
    order = np.random.default_rng(3).permutation(total).astype(np.int32)
    columns = [np.zeros(total + 1, dtype) for dtype in (np.uint32, np.float32, np.float32, np.uint32)]
    for i, column in enumerate(columns):
        column[order] = np.concatenate([record[i] for record in records])
    samples = quadtree_adapt.QuadtreeSamples()
    samples.starts = on_device((np.cumsum(lengths) - lengths).astype(np.int32), wp.int32)
    samples.counts = on_device(lengths, wp.int32)
    samples.order = on_device(np.append(order, 0), wp.int32)
    samples.directions, samples.codes = (on_device(columns[k], wp.uint32) for k in (0, 3))
    samples.contributions, samples.pdfs = (on_device(columns[k], wp.float32) for k in (1, 2))
    adaptation = quadtree_adapt.QuadtreeAdaptation()
    adaptation.bits, adaptation.migrations = bits, migrations
    adaptation.significance, adaptation.fading = significance, fading
    adaptation.most_samples = most_samples
    adaptation.trees = on_device(trees, wp.vec4ui)
    adaptation.anchors = on_device(np.asarray(anchors, np.float32), wp.vec4)
    adaptation.octree.low, adaptation.octree.scale = wp.vec3(*LOW), SCALE
    adaptation.counts = empty(len(trees) * bits // 4, wp.uint32)
    if energies is None:
        energies = np.zeros((len(trees), bits, 4))
    adaptation.energies = on_device(np.asarray(energies, np.float32).ravel(), wp.float32)
    launch(quadtree_adapt.adapt_quadtrees, len(trees), [samples, adaptation], device(), 1)
    after = adaptation.energies.numpy().reshape(len(trees), bits, 4)
    return adaptation.trees.numpy(), adaptation.counts.numpy(), after


def uv_of(packed):
    return np.stack([packed & 0xFFFF, packed >> 16], axis=-1) / 65536.0


def packed_of(uvs):
    x, y = (np.asarray(uvs) * 65536).astype(np.uint32).T
    return x | y << 16


def leaf_masses(number, bits, packed, weights):
    """Sums of the weights of packed directions over leaves, by cell: intervals of Morton codes."""
    cells, inner = decoded(number, bits)

    def morton(x, y):
        return sum((x >> i & 1) << 2 * i | (y >> i & 1) << 2 * i + 1 for i in range(16))

    codes = morton((packed & 0xFFFF).astype(np.int64), (packed >> 16).astype(np.int64))
    order = np.argsort(codes)
    sums = np.append(0, np.cumsum(weights[order], dtype=np.float64))
    leaves = [cell for cell in cells if cell not in inner]
    starts = np.array([morton(x, y) << 2 * (16 - level) for level, x, y in leaves])
    ends = starts + np.array([1 << 2 * (16 - level) for level, _, _ in leaves])
    low, high = (np.searchsorted(codes[order], bounds) for bounds in (starts, ends))
    return dict(zip(leaves, sums[high] - sums[low], strict=True))


def level_grid(number, bits, deepest):
    """Level of the leaf [row, column] of each cell of a grid of 2^deepest x 2^deepest."""
    cells, inner = decoded(number, bits)
    grid = np.zeros((2**deepest, 2**deepest), int)
    for level, x, y in set(cells) - inner:
        size = 2 ** (deepest - level)
        grid[y * size : (y + 1) * size, x * size : (x + 1) * size] = level
    return grid


# ---- bits ----


def check_nodes(trees, bits):
    """Rank, select, ascend and locate of trees [tree, 4] against the bits themselves."""
    n = len(trees)
    ranks, selected = (empty((n, bits), wp.uint8) for _ in range(2))
    places, found = empty((n, bits), wp.uint32), empty(n, wp.int32)
    on = on_device(trees, wp.vec4ui)
    launch(ask_nodes, n, [bits, on, ranks, selected, places], device())
    launch(locate_leaves, n, [bits, on, found], device())
    ones = bit_matrix(trees, bits)
    before = np.cumsum(ones, axis=1, dtype=np.uint8) - ones
    assert np.array_equal(ranks.numpy(), before)
    inner, leaves = (np.nonzero(ones == bit)[1].reshape(n, -1) for bit in (1, 0))
    assert np.array_equal(selected.numpy(), np.concatenate([inner, leaves], axis=1))
    assert (found.numpy() == 5 * leaves.shape[1]).all()
    # children of inner node j are nodes 4 j ..: what a node is, is known once its parent is
    expected = np.zeros((n, bits + 1), np.uint32)
    expected[:, bits] = 1 << 16 | 1  # the root
    rows = np.arange(n)
    for j in range(bits // 4):
        parent = np.full(n, bits) if j == 0 else inner[:, j - 1]
        for q in range(4):
            expected[:, 4 * j + q] = 2 * expected[rows, parent] + ((q & 1) << 16 | q >> 1)
    assert np.array_equal(places.numpy(), expected[:, :bits])


def test_every_tree_of_32_bits():
    trees = all_trees()
    assert len(trees) == 420_732  # binomial(32, 8) / 25
    assert are_valid(trees, 32).all() and len(np.unique(trees[:, 0])) == len(trees)
    for part in np.array_split(trees, 100):
        check_nodes(part, 32)


@pytest.mark.parametrize("bits", SIZES)
def test_random_trees(bits):
    numbers = random_trees(bits, 200)
    trees = words(numbers)
    assert are_valid(trees, bits).all()
    check_nodes(trees, bits)
    starts = empty((len(trees), 14), wp.int32)
    launch(find_level_starts, len(trees), [bits, on_device(trees, wp.vec4ui), starts], device())
    counts = counts_of(trees, bits).numpy().reshape(len(trees), bits // 4)
    for number, levels, packed in zip(numbers, starts.numpy(), counts, strict=True):
        cells, inner = decoded(number, bits)
        assert encoded(inner) == (number, cells)
        assert levels.tolist() == [sum(cell[0] < level for cell in cells) for level in range(1, 15)]
        leaves = [cell for cell in cells if cell not in inner]
        below = [
            sum(
                leaf[1] >> (leaf[0] - level) == x and leaf[2] >> (leaf[0] - level) == y
                for leaf in leaves
                if leaf[0] >= level
            )
            for level, x, y in cells
        ]
        assert packed.view(np.uint8).tolist() == below


def test_select_without_an_instruction():
    rng = np.random.default_rng(1)
    values = rng.integers(1, 1 << 64, 20_000, dtype=np.uint64) & rng.integers(1, 1 << 64, 20_000, dtype=np.uint64)
    values[:3] = 1, 1 << 63, (1 << 64) - 1
    bits = np.unpackbits(values[:, None].view(np.uint8), axis=1, bitorder="little")
    values, bits = values[bits.any(axis=1)], bits[bits.any(axis=1)]
    i = (rng.random(len(values)) * bits.sum(axis=1)).astype(np.int32)
    out = empty(len(values), wp.int32)
    launch(halve_words, len(values), [on_device(values, wp.uint64), on_device(i, wp.int32), out], device())
    assert np.array_equal(out.numpy(), np.argmax(np.cumsum(bits, axis=1) > i[:, None], axis=1))


@pytest.mark.parametrize("bits", SIZES)
def test_uniform_tree(bits):
    cells, inner = decoded(number_of(quadtree.quadtree_uniform(bits)), bits)
    levels = [cell[0] for cell in cells if cell not in inner]
    assert len(levels) == 3 * bits // 4 + 1 and max(levels) - min(levels) <= 1
    with pytest.raises(ValueError, match="33"):
        quadtree.quadtree_uniform(33)


# ---- migration ----


@pytest.mark.parametrize("bits", SIZES)
def test_migrations(bits):
    """Half a million steps keep trees valid; each is what moving cells in a decoded tree and encoding that gives."""
    threads, steps = 256, 2000  # a third of the steps find a twig and a leaf
    trees, moves = walked(bits, threads, steps)
    assert (moves[..., 0] >= 0).sum() > 125_000
    for part in trees.reshape(16, -1, 4):
        assert are_valid(part, bits).all()
    reached = 0
    for thread in range(3):
        number = number_of(quadtree.quadtree_uniform(bits))
        for tree, (leaf, inner) in zip(trees[thread, :500], moves[thread, :500], strict=True):
            if leaf >= 0:
                number, cells = migrated(number, bits, int(leaf), int(inner))
                reached = max(reached, cells[-1][0])  # the last node is on the deepest level
            assert number_of(tree) == number
    assert 4 <= reached <= LEVELS
    check_nodes(trees[:, -1], bits)


def test_a_walk_meets_known_trees_only():
    trees, _ = walked(32, 256, 4000)
    met = np.unique(trees[..., 0])
    assert np.isin(met, all_trees()[:, 0]).all() and len(met) > 100_000


# ---- density ----


def random_directions(count, seed=1):
    d = np.random.default_rng(seed).standard_normal((count, 3))
    return (d / np.linalg.norm(d, axis=1, keepdims=True)).astype(np.float32)


def test_density_is_the_jacobian():
    directions = random_directions(5000)
    density = evaluated(random_trees(64, 2)[0], 64, directions)[1]
    expected = differenced_density(directions)
    smooth = np.abs(directions).min(axis=1) > 1e-4  # differences do not cross a fold
    assert np.allclose(density[smooth], expected[smooth], rtol=2e-5) and smooth.mean() > 0.99
    assert np.allclose(evaluated(0xF, 32, 7 * directions)[1], density, rtol=1e-5)  # of any length
    # uniform directions have density 1 / (4 pi): its mean over them is that of 1 / area in the square
    assert np.isclose((1 / density).mean() / (4 * np.pi), np.mean(1 / (4 * np.pi * expected)), rtol=1e-5)


@pytest.mark.parametrize("bits", SIZES)
def test_pdf(bits):
    """The pdf is that of the leaf's cell, and integrates to one over the sphere."""
    rows, columns = 500, 1000
    z, phi = np.meshgrid(1 - (2 * np.arange(rows) + 1) / rows, 2 * np.pi * (np.arange(columns) + 0.5) / columns)
    ring = np.sqrt(1 - z * z)
    directions = np.stack([ring * np.cos(phi), z, ring * np.sin(phi)], axis=-1).reshape(-1, 3).astype(np.float32)
    for number in random_trees(bits, 6, 6, seed=2):
        pdf, density, _, uvs, _ = evaluated(number, bits, directions)
        column, row = np.minimum((uvs * 64).astype(int), 63).T
        expected = 4.0 ** level_grid(number, bits, 6)[row, column] / (3 * bits / 4 + 1)
        assert np.allclose(pdf, expected * density, rtol=1e-5)
        assert abs(pdf.mean() * 4 * np.pi - 1) < 0.01
    poles = np.concatenate([np.eye(3), -np.eye(3)]).astype(np.float32)
    assert (evaluated(number, bits, poles)[0] > 0).all()


# ---- samplers ----


@pytest.mark.parametrize("bits", SIZES)
def test_samplers_follow_the_pdf(bits):
    rng = np.random.default_rng(bits)
    for number in random_trees(bits, 2, 5, seed=3):
        numbers = rng.random((100_000, 3), dtype=np.float32)
        points, directions, densities = drawn(number, bits, numbers)
        expected = sphere_expectation(lambda d, n=number: evaluated(n, bits, d)[0], len(numbers), 24, 24, 24)
        assert np.isclose(expected.sum(), len(numbers), rtol=3e-3)
        cells, inner = decoded(number, bits)
        leaves = np.array(sorted(set(cells) - inner))
        for sampler in range(2):
            assert np.abs(np.linalg.norm(directions[sampler], axis=1) - 1).max() < 1e-6
            assert chi_squared(sphere_histogram(directions[sampler], 24, 24), expected) > 1e-3
            # a grid of 4 x 4 in each leaf
            level = points[sampler, :, 2].astype(int)
            scaled = points[sampler, :, :2] * 2.0 ** level[:, None]
            keys = (level << 24) + scaled.astype(int) @ [1 << 12, 1]
            known = leaves @ [1 << 24, 1 << 12, 1]
            assert np.isin(keys, known).all()
            fourths = np.searchsorted(known, keys) * 16 + (scaled % 1 * 4).astype(int) @ [1, 4]
            counts = np.bincount(fourths, minlength=16 * len(leaves))
            assert chi_squared(counts, np.full(len(counts), len(numbers) / len(counts))) > 1e-3
            # rounding moves a direction over the border of its leaf, rarely
            pdf, again = densities[sampler].T
            same = np.isclose(pdf, again, rtol=1e-5)
            edge = points[sampler, :, :2] * 2.0 ** points[sampler, :, 2:]
            assert same[(np.abs(edge - np.round(edge)) > 1e-4).all(axis=1)].all() and same.mean() > 0.999


@pytest.mark.parametrize("bits", SIZES)
def test_warp_stretches_equal_areas_over_leaves(bits):
    """Each leaf's rectangle has area 1 / leaves exactly, and its points keep their place in it."""
    inside = np.array([0.001, 0.2, 0.5, 0.7, 0.999])
    grid = np.stack(np.meshgrid(inside, inside), axis=-1).reshape(-1, 2)
    for number in random_trees(bits, 6, 12, seed=4):
        rectangles = preimages(number, bits)
        leaves = 3 * bits // 4 + 1
        assert len(rectangles) == leaves
        assert all((x1 - x0) * (y1 - y0) == Fraction(1, leaves) for x0, x1, y0, y1 in rectangles.values())
        corners = np.array([[float(v) for v in rectangle] for rectangle in rectangles.values()])
        lower, upper = corners[:, None, [0, 2]], corners[:, None, [1, 3]]
        numbers = np.zeros((leaves * len(grid), 3))
        numbers[:, :2] = (lower + grid * (upper - lower)).reshape(-1, 2)
        points = drawn(number, bits, numbers)[0][1].astype(np.float64)
        level, *place = np.array(list(rectangles)).T
        assert np.array_equal(points[:, 2], np.repeat(level, len(grid)))
        relative = points[:, :2] * 2.0 ** points[:, 2:] - np.repeat(np.stack(place, axis=-1), len(grid), axis=0)
        width = (upper - lower).min()
        assert np.abs(relative - np.tile(grid, (leaves, 1))).max() < 1e-3 + 1e-6 / width
        assert ((relative > 0) & (relative < 1)).all()


@pytest.mark.parametrize("bits", SIZES)
def test_warp_is_monotone_and_stays_inside(bits):
    """With one number fixed the point follows the other, also one rounding step beside every border."""
    last = np.float32(1) - np.float32(2.0**-24)
    for number in random_trees(bits, 4, 12, seed=5):
        borders = np.array(
            [[float(v) for v in rectangle] for rectangle in preimages(number, bits).values()], np.float32
        )
        for axis in range(2):
            values = np.unique(borders[:, 2 * axis : 2 * axis + 2])
            steps = [np.nextafter(values, np.float32(side)) for side in (-1, 2)]
            values = np.concatenate([values, *steps, [0, 1e-40, last], np.linspace(0, last, 400, dtype=np.float32)])
            values = np.unique(np.clip(values, 0, last)).astype(np.float32)
            for fixed in (0, 0.123, 0.5, 0.77, last):
                numbers = np.full((len(values), 3), fixed, np.float32)
                numbers[:, axis] = values
                numbers[:, 2] = values
                points, _, densities = drawn(number, bits, numbers)
                assert points[:, :, :2].min() >= 0 and points[:, :, :2].max() < 1
                assert (np.diff(points[1, :, axis]) >= 0).all()
                assert points[1, 0, axis] == 0 and points[1, -1, axis] > 1 - 2.0**-9
                assert np.isfinite(densities).all() and (densities > 0).all()
                cells, inner = decoded(number, bits)
                leaves = set(cells) - inner
                for sampler in range(2):  # rounding within the leaf does not leave it
                    for x, y, level in points[sampler]:
                        assert (int(level), int(x * 2.0**level), int(y * 2.0**level)) in leaves


@pytest.mark.parametrize("bits", SIZES)
def test_warp_keeps_points_stratified(bits):
    """Of 1024 points of a (0, 2)-net each half of the root gets its share within one point, as any interval does;
    leaves, whose rectangles are no elementary intervals, within 5, and with a tenth of the variance of random ones."""
    count, leaves = 1024, 3 * bits // 4 + 1
    variances = []
    for seed, number in enumerate(random_trees(bits, 8, 12, seed=6)):
        numbers = np.zeros((count, 3))
        numbers[:, :2] = np.minimum(qmc.Sobol(2, seed=seed).random(count), 1 - 2.0**-24)
        points = drawn(number, bits, numbers)[0][1]
        cells, inner = decoded(number, bits)
        share = sum(x >> (level - 1) == 0 for level, x, _ in set(cells) - inner) / leaves
        assert abs((points[:, 0] < 0.5).sum() - share * count) < 1
        keys = [(int(level), int(x * 2.0**level), int(y * 2.0**level)) for x, y, level in points]
        counts = np.array([keys.count(cell) for cell in set(cells) - inner])
        assert counts.sum() == count and np.abs(counts - count / leaves).max() < 5
        variances.append(np.mean((counts - count / leaves) ** 2))
    assert np.mean(variances) < 0.1 * count / leaves


# ---- adaptation ----


SPOT = np.array([0.6, 0.64, -0.48])


def spot(count, seed=1, sharpness=300.0):
    """Records of uniform directions: packed, the light of a spot in a given direction over their density, and that."""
    directions = random_directions(count, seed)
    packed = evaluated(0xF, 32, directions)[2]
    light = np.exp(sharpness * (directions @ SPOT - 1))
    return packed, (4 * np.pi * light).astype(np.float32), np.full(count, 0.25 / np.pi, np.float32)


def test_packed_directions():
    directions = np.concatenate([random_directions(5000), np.eye(3), -np.eye(3)]).astype(np.float32)
    _, _, packed, uvs, unpacked = evaluated(0xF, 32, directions)
    assert np.array_equal(packed, packed_of(np.minimum(uvs, 1 - 2.0**-17)))
    assert np.allclose(unpacked, decoded_directions(uv_of(packed) + 0.5 / 65536), atol=1e-6)
    assert np.array_equal(evaluated(0xF, 32, unpacked)[2], packed)


def random_record(rng, count, spread):
    """Packed directions, half of them near a point; contributions, some of them below 0; densities."""
    uvs = rng.random((count, 2))
    uvs[: count // 2] = np.clip(0.3 + spread * rng.standard_normal((count // 2, 2)), 0, 1 - 1e-6)
    contributions = np.where(rng.random(count) < 0.3, -1, rng.exponential(size=count)).astype(np.float32)
    return packed_of(uvs), contributions, rng.uniform(0.05, 5, count).astype(np.float32)


def taken(record, most):
    """What is looked at of a record: at most so many, evenly spread."""
    n = len(record[0])
    chosen = np.arange(n) if n <= most else np.arange(most) * n // most
    return tuple(column[chosen] for column in record)


@pytest.mark.parametrize("bits", SIZES)
@pytest.mark.parametrize("migrations, significance, fading", [(1, 0.5, 0.0), (8, 0.5, 0.8), (8, 4.0, 0.3)])
def test_adaptation_is_that_of_the_oracle(bits, migrations, significance, fading):
    """Tree for tree and leaf for leaf over four frames, energies in float64; the oracle makes sure that no decision is
    one of rounding."""
    rng = np.random.default_rng([bits, 1])
    numbers = random_trees(bits, 12, 12, seed=7)
    trees, energies = words(numbers), np.zeros((len(numbers), bits, 4))
    known = [dict.fromkeys(decoded(number, bits)[0], np.zeros(4)) for number in numbers]
    moved = []
    for _ in range(4):
        records = [random_record(rng, int(rng.integers(1, 600)), 0.02 * (1 + i % 4)) for i in range(len(numbers))]
        trees, counts, energies = adapt(trees, bits, records, migrations, 400, significance, fading, energies)
        before = numbers
        settings = (migrations, significance, fading)
        pairs = [
            adapted(number, bits, e, taken(record, 400), *settings)
            for number, e, record in zip(numbers, known, records, strict=True)
        ]
        numbers, known = zip(*pairs, strict=True)
        assert [number_of(tree) for tree in trees] == list(numbers)
        assert np.array_equal(counts, counts_of(trees, bits).numpy())
        for number, expected, got in zip(numbers, known, energies, strict=True):
            leaves = [(k, cell) for k, cell in enumerate(decoded(number, bits)[0]) if cell in expected]
            assert len(leaves) == len(expected) == 3 * bits // 4 + 1
            wanted = np.array([expected[cell] for _, cell in leaves])
            assert np.allclose(got[[k for k, _ in leaves]], wanted, rtol=2e-5, atol=1e-12 * wanted.max())
        moved += [len(decoded(a, bits)[1] - decoded(b, bits)[1]) for a, b in zip(numbers, before, strict=True)]
    assert max(moved) == migrations or (migrations == 8 and max(moved) >= 4)


def anchored_record(rng, count, anchor):
    """A `random_record` with codes of positions, most of them within the anchor's sphere, some beyond.

    Seen from the anchor no direction is so near to the border of a code that rounding could move it across.
    """
    radius = 1 / anchor[3] if anchor[3] > 0 else 1.0
    away = unit(rng.standard_normal((4 * count, 3))) * (1.1 * radius * rng.random((4 * count, 1)) ** (1 / 3))
    places = np.clip((anchor[:3] + away - LOW) * SCALE, 0, 1023).astype(np.int64)
    codes = sum((places[:, axis] >> bit & 1) << (3 * bit + axis) for bit in range(10) for axis in range(3))
    record = (*random_record(rng, 4 * count, 0.05), codes)
    seen, _ = seen_from_anchor(anchor, positions_of(codes), decoded_directions(uv_of(record[0]) + 0.5 / 65536))
    inside = np.abs(octahedral_of(seen) * 65536 % 1 - 0.5).max(axis=-1) < 0.3
    assert inside.mean() > 0.3
    return tuple(column[inside][:count] for column in record)


@pytest.mark.parametrize("bits", [32, 128])
@pytest.mark.parametrize("migrations, fading", [(0, 0.3), (8, 0.8)])
def test_adaptation_is_as_seen_from_the_anchor(migrations, fading, bits):
    """Quadrants and densities are those of directions from the anchor's sphere, tree for tree over three frames."""
    rng = np.random.default_rng([bits, 11])
    numbers = random_trees(bits, 12, 12, seed=11)
    anchors = np.column_stack([LOW + rng.uniform(4, 6, (12, 3)), 1 / rng.uniform(0.5, 3, 12)]).astype(np.float32)
    anchors[3, 3] = 0  # no sphere
    trees, energies = words(numbers), np.zeros((12, bits, 4))
    known = [dict.fromkeys(decoded(number, bits)[0], np.zeros(4)) for number in numbers]
    for _ in range(3):
        records = [anchored_record(rng, int(rng.integers(1, 400)), anchor) for anchor in anchors.astype(np.float64)]
        trees, counts, energies = adapt(trees, bits, records, migrations, 300, 0.5, fading, energies, anchors)
        records = [from_anchor(taken(record, 300), anchor) for record, anchor in zip(records, anchors, strict=True)]
        pairs = [
            adapted(number, bits, e, record, migrations, 0.5, fading)
            for number, e, record in zip(numbers, known, records, strict=True)
        ]
        numbers, known = zip(*pairs, strict=True)
        assert [number_of(tree) for tree in trees] == list(numbers)
        assert np.array_equal(counts, counts_of(trees, bits).numpy())
        for number, expected, got in zip(numbers, known, energies, strict=True):
            leaves = [(k, cell) for k, cell in enumerate(decoded(number, bits)[0]) if cell in expected]
            wanted = np.array([expected[cell] for _, cell in leaves])
            assert np.allclose(got[[k for k, _ in leaves]], wanted, rtol=1e-4, atol=1e-12 * wanted.max())
    # the positions were on both sides of where parallax ends
    anchor = anchors[0].astype(np.float64)
    inside = has_parallax(anchor, positions_of(anchored_record(rng, 200, anchor)[3]))
    assert 0.1 < inside.mean() < 0.9


@pytest.mark.parametrize("knows", [True, False])
def test_points_all_over_a_region_learn_the_same_of_a_lamp(knows):
    """A lamp on the sphere is in one quadrant of one leaf then, and in many without."""
    rng = np.random.default_rng(12)
    lamp = unit(np.array([0.5, 0.6, -0.4]))
    anchor = np.append(LOW + 5, 0.5)
    codes = rng.integers(0, 1 << 30, 200_000)
    away = positions_of(codes) - anchor[:3]
    codes = codes[np.linalg.norm(away, axis=1) < 1.5]
    ways = unit(anchor[:3] + lamp / anchor[3] - positions_of(codes))
    record = (packed_of(octahedral_of(ways)), *np.ones((2, len(codes)), np.float32), codes)
    number = number_of(quadtree.quadtree_uniform(128))
    anchor[3] *= knows
    _, _, energies = adapt(words([number]), 128, [record], 0, anchors=anchor[None])
    filled = np.argwhere(energies[0] > 0)
    if not knows:
        assert len(codes) > 1000 and len(filled) > 20
        return
    ((node, quadrant),) = filled
    level, x, y = decoded(number, 128)[0][node]
    ((u, v),) = octahedral_of(lamp[None]) * 2 ** (level + 1)
    assert (int(u), int(v)) == (2 * x + (quadrant & 1), 2 * y + (quadrant >> 1))
    _, stretch = seen_from_anchor(anchor, positions_of(codes), ways)
    expected = np.mean(1 / stretch) / oracle_density(lamp[None])[0]
    assert np.isclose(energies[0, node, quadrant], expected, rtol=1e-3)


def test_fading():
    """Of 256 samples or more a frame, energies keep the share `fading`; of fewer, more; of none, all."""
    bits, fading = 64, 0.6
    assert int(quadtree_adapt.ENOUGH_SAMPLES) == 256
    counts = (0, 1, 64, 255, 256, 257, 3000)
    energies = np.random.default_rng(1).exponential(size=(len(counts), bits, 4)).astype(np.float32)
    rng = np.random.default_rng(2)
    dark = [(packed_of(rng.random((n, 2))), np.zeros(n, np.float32), np.ones(n, np.float32)) for n in counts]
    trees = words(random_trees(bits, len(counts), 12, seed=10))
    after = energies
    for frame in range(1, 4):
        same, _, after = adapt(trees, bits, dark, 0, fading=fading, energies=after)
        assert np.array_equal(same, trees)
        kept = [1 - (1 - fading) * min(n / 256, 1) for n in counts]
        assert np.allclose(after / energies, np.array(kept)[:, None, None] ** frame, rtol=1e-5)
    # of those that are looked at, not of all
    _, _, after = adapt(trees, bits, dark, 0, most_samples=64, fading=fading, energies=energies)
    assert np.allclose(after[2:] / energies[2:], 0.9, rtol=1e-5)
    # what a sample adds does not depend on how many there are: the same samples twice over are the same frame
    record = random_record(rng, 400, 0.1)
    twice = tuple(np.tile(column, 2) for column in record)
    _, _, (once, again) = adapt(trees[:2][[0, 0]], bits, [record, twice], 0, fading=fading)
    assert np.allclose(once, again, rtol=1e-4) and once.max() > 0


@pytest.mark.parametrize("migrations", [1, 8])
def test_a_spot_is_refined(migrations):
    """The same samples each frame, and nothing kept of frames before."""
    bits, significance = 128, 0.5
    record = spot(40_000)
    packed, contributions, pdfs = record
    weights = contributions.astype(np.float64) ** 2 * pdfs / oracle_density(decoded_directions(uv_of(packed)))
    tree = words([number_of(quadtree.quadtree_uniform(bits))])
    most, before, energies = [], decoded(number_of(tree[0]), bits)[1], None
    for frame in range(60):
        tree, _, energies = adapt(tree, bits, [record], migrations, significance=significance, energies=energies)
        inner = decoded(number_of(tree[0]), bits)[1]
        assert len(inner - before) <= migrations and (inner != before or frame > 10 // migrations)
        before = inner
        masses = leaf_masses(number_of(tree[0]), bits, packed, weights)
        most.append(max(0.25 ** cell[0] * mass for cell, mass in masses.items()) / weights.sum())
    assert (np.diff(most) <= 1e-6 * most[0]).all() or migrations > 1
    assert most[-1] < most[0] / 50
    # at the end no leaf gains twice what four leaves together would lose that could be given up for it
    twigs = [cell for cell in inner if not set(children(cell)) & inner]
    least = min(0.25 ** cell[0] * sum(masses[c] for c in children(cell)) for cell in twigs)
    assert significance * most[-1] * weights.sum() <= least * (1 + 1e-5)
    again, _, _ = adapt(tree, bits, [record], migrations, significance=significance, energies=energies)
    assert np.array_equal(again, tree)
    # the density has gone to the spot
    centre = SPOT[None].astype(np.float32)
    uniform = number_of(quadtree.quadtree_uniform(bits))
    assert evaluated(number_of(tree[0]), bits, centre)[0] > 8 * evaluated(uniform, bits, centre)[0]


@pytest.mark.parametrize("bits", SIZES)
def test_nothing_to_learn_changes_nothing(bits):
    numbers = random_trees(bits, 4, 12, seed=8)
    packed = packed_of(np.random.default_rng(1).random((50, 2)))
    ones = np.ones(50, np.float32)
    none = (packed[:0], ones[:0], ones[:0])
    rejected, dark = (packed, -ones, ones), (packed, 0 * ones, ones)
    trees, counts, energies = adapt(words(numbers), bits, [none, rejected, dark, none], 8)
    assert [number_of(tree) for tree in trees] == numbers and not energies.any()
    assert np.array_equal(counts, counts_of(trees, bits).numpy())
    # without any sample, what is known moves no leaf
    known = np.random.default_rng(2).random((4, bits, 4)).astype(np.float32)
    trees, _, energies = adapt(words(numbers), bits, [none, rejected, none, none], 8, energies=known)
    assert [number_of(tree) for tree in trees] == numbers
    assert np.array_equal(energies[[0, 2, 3]], known[[0, 2, 3]])


def test_leaves_are_split_to_the_deepest_level_only():
    """A frame of one direction only, and nothing kept of the frames before."""
    tree, energies = words([number_of(quadtree.quadtree_uniform(128))]), None
    record = (packed_of([[0.7001, 0.2003]] * 256), np.ones(256, np.float32), np.ones(256, np.float32))
    levels = []
    for _ in range(12):
        tree, _, energies = adapt(tree, 128, [record], energies=energies)
        levels.append(max(cell[0] for cell in decoded(number_of(tree[0]), 128)[0]))
    assert levels == [min(4 + i, LEVELS) for i in range(12)]  # the leaf was on level 3


def test_siblings_are_not_given_up_for_a_leaf():
    """Not even with a significance above 1 and no other children to give up."""
    chain = [encoded({(level, 0, 0) for level in range(8)})[0]]
    record = (packed_of([[0.0001, 0.0001]]), np.ones(1, np.float32), np.ones(1, np.float32))
    trees, _, _ = adapt(words(chain), 32, [record], 8, significance=4.0)
    assert number_of(trees[0]) == chain[0]


def test_adaptation_does_not_depend_on_threads():
    rng = np.random.default_rng(1)
    numbers = random_trees(64, 100, 12, seed=9)
    records = [random_record(rng, n, 0.1) for n in rng.integers(0, 200, len(numbers))]
    energies = rng.exponential(size=(len(numbers), 64, 4)) * 1e-3
    results = []
    try:
        for threads in (1, 2, 3):
            set_threads(threads)
            results.append(adapt(words(numbers), 64, records, 4, fading=0.8, energies=energies))
    finally:
        set_threads(None)
    assert not np.array_equal(results[0][0], words(numbers))
    for result in results[1:]:
        assert all(np.array_equal(a, b) for a, b in zip(result, results[0], strict=True))


# ---- adaptation to what it samples itself ----


@dataclass(frozen=True, eq=False)
class Target:
    """Light of a spot over a dim background, 1/sr of any unit, as trees see it."""

    centre: tuple[float, float, float]
    squares: tuple[np.ndarray, ...]
    """[level][row, column] integral of f^2 over the cell, f the light as a function on the square."""
    mean: float
    """Integral of f."""

    @staticmethod
    @cache
    def of(centre):
        size = 512
        place = (np.arange(size) + 0.5) / size
        directions = decoded_directions(np.stack(np.meshgrid(place, place), axis=-1).reshape(-1, 2))
        f = (light_of(directions, centre) / oracle_density(directions)).reshape(size, size)
        squares = [f**2 / size**2]
        while len(squares[-1]) > 1:
            n = len(squares[-1]) // 2
            squares.append(squares[-1].reshape(n, 2, n, 2).sum(axis=(1, 3)))
        return Target(centre, tuple(squares[::-1]), float(f.mean()))

    def gain(self, cell):
        """Area times energy of a cell."""
        level, x, y = cell
        return 0.25**level * self.squares[level][y, x]

    def variance(self, number, bits):
        """Of f / p for one sample, p the density of a tree."""
        cells, inner = decoded(number, bits)
        return (3 * bits // 4 + 1) * sum(self.gain(cell) for cell in cells if cell not in inner) - self.mean**2

    def best(self, bits):
        """The tree of least variance: the cell that gains most is split, and the children of none gain more than it."""
        inner, heap = set(), [(-self.gain((0, 0, 0)), (0, 0, 0))]
        while len(inner) < bits // 4:
            cell = heapq.heappop(heap)[1]
            inner.add(cell)
            for child in children(cell):
                heapq.heappush(heap, (-self.gain(child), child))
        return encoded(inner)[0]


def light_of(directions, centre):
    return np.exp(300.0 * (directions @ np.asarray(centre) - 1)) + 0.01


def own_record(number, bits, target, rng, count):
    """Samples drawn from a tree: packed directions, light over density, density per sr."""
    cells, inner = decoded(number, bits)
    leaves = np.array([cell for cell in cells if cell not in inner])
    level, x, y = leaves[rng.integers(len(leaves), size=count)].T
    packed = packed_of((np.stack([x, y], axis=-1) + rng.random((count, 2))) * 0.5 ** level[:, None])
    directions = decoded_directions(uv_of(packed))
    pdfs = 4.0**level / len(leaves) * oracle_density(directions)
    return packed, (light_of(directions, target.centre) / pdfs).astype(np.float32), pdfs.astype(np.float32)


class Learner:
    """Trees that learn from samples of their own, each by itself."""

    def __init__(self, bits, migrations, fading, count=8):
        self.bits, self.settings = bits, {"migrations": migrations, "fading": fading}
        self.numbers = [number_of(quadtree.quadtree_uniform(bits))] * count
        self.energies, self.rng = None, np.random.default_rng(1)

    def learn(self, target, frames, count=2048):
        """Return the variances [frame, tree], in units of the best tree's."""
        least = target.variance(target.best(self.bits), self.bits)
        variances = []
        for _ in range(frames):
            records = [own_record(number, self.bits, target, self.rng, count) for number in self.numbers]
            trees, _, self.energies = adapt(
                words(self.numbers), self.bits, records, energies=self.energies, **self.settings
            )
            self.numbers = [number_of(tree) for tree in trees]
            variances.append([target.variance(number, self.bits) / least for number in self.numbers])
        return np.array(variances)


HERE = tuple(SPOT)
# the same spot 36 degrees higher: it moves by four of its own widths
_SLANT, _TURN = np.arcsin(SPOT[1]), np.radians(36)
THERE = tuple(np.array([0.6, 0, -0.48]) / np.hypot(0.6, 0.48) * np.cos(_SLANT + _TURN) + [0, np.sin(_SLANT + _TURN), 0])


@pytest.mark.parametrize(
    "bits, migrations, fading", [(32, 8, 0.8), (96, 8, 0.8), (128, 1, 0.8), (128, 8, 0.8), (128, 8, 0.5)]
)
def test_trees_converge_and_stay(bits, migrations, fading):
    """After 30 frames, and for 30 more, the variance is within a sixth of the best tree's, and 4 % on average; leaves'
    area times energy is as even as the best tree's within a half."""
    target, learner = Target.of(HERE), Learner(bits, migrations, fading)
    best, uniform = target.best(bits), number_of(quadtree.quadtree_uniform(bits))
    assert target.variance(uniform, bits) > 10 * target.variance(best, bits)
    learner.learn(target, 29)
    variances = learner.learn(target, 31)
    assert variances.min() > 1 - 1e-9
    assert variances.max() < 1.17 and variances.mean() < 1.04
    assert variances[16:].mean() < variances[:15].mean() + 0.02  # no drift

    def unevenness(number):
        cells, inner = decoded(number, bits)
        gains = [target.gain(cell) for cell in cells if cell not in inner]
        losses = [target.gain(cell) for cell in inner if not set(children(cell)) & inner]
        return max(gains) / np.mean(gains), max(gains) / min(losses)

    assert unevenness(best)[1] < 1 + 1e-9  # no migration would better it
    for number in learner.numbers:
        over_mean, over_least = unevenness(number)
        assert over_mean < 1.5 * unevenness(best)[0]
        assert over_least < 2 * 1.2  # 1 / significance, and a fifth for noise


@pytest.mark.parametrize("migrations, fading, frames", [(8, 0.5, 8), (1, 0.5, 20), (8, 0.8, 20), (1, 0.8, 20)])
def test_a_spot_that_jumps_is_followed(migrations, fading, frames):
    """Within so many frames, and from then on, every tree has a variance within 1.2 of what one has that knew nothing
    before. What is remembered of the former place sets the pace with several migrations: fading 0.8 takes 17 frames
    here and up to 23 elsewhere, 0.5 takes 5 (one tree of fifty: 20)."""
    bits = 128
    assert np.isclose(np.dot(HERE, THERE), np.cos(np.radians(36)))
    target, learner = Target.of(THERE), Learner(bits, migrations, fading)
    settled = Learner(bits, migrations, fading).learn(target, 40)[-1].mean()
    assert settled < 1.06
    learner.learn(Target.of(HERE), 30)
    variances = learner.learn(target, 28) / settled
    assert variances[0].min() > 1.5
    assert (variances[frames - 1 :] < 1.2).all()
