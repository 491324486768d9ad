"""Which lights are below which node of a tree: a binary tree by cost, collapsed to eight children a node.

A node is split by the surface area and orientation heuristic of Conty Estevez and Kulla 2018 (Eq. 1), over bins (Wald
2007), down to single lights. NumPy does all nodes of a level at once.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from warp_gi.kernels.light_hierarchy import LANES
from warp_gi.techniques.light_hierarchy.bounds import EmitterBounds, angles_between, unit_vectors

EMPTY = np.iinfo(np.int64).min
"""Stands for no child while a tree is built."""
BINS = 12
"""Bins along each axis that a node's lights are sorted into to find its cheapest split."""
FEW_LIGHTS, FEW_BINS = 8, 6
"""Largest number of lights of a node that is split over fewer bins, and the number of those bins."""
NARROW_AREA = 1e-2
"""Share of the squared diagonal that counts as area, so that lights on one line are split by cost as well."""
EQUAL_COST = 1e-30
"""Added to a node's cost for each of its lights, so that those without extent are opened evenly."""


def binary_tree(bounds: EmitterBounds, lights: np.ndarray, most_levels: int) -> tuple[np.ndarray, np.ndarray]:
    """Return children (int64 [node, 2]: node, or complement of an emitter) and costs (float64 [node]) of inner nodes.

    Nodes are split in order of their level. Where splitting a node into halves from there on just keeps within
    ``most_levels``, it is split into halves.
    """
    centers = (bounds.low[lights] + bounds.high[lights]) / 2
    # enough for a heuristic, and half the memory traffic
    names = ("low", "high", "axis", "facing", "falloff", "power")
    bounds = replace(bounds, **{name: getattr(bounds, name).astype(np.float32) for name in names})
    if len(lights) == 1:
        return np.array([[~lights[0], EMPTY]]), np.zeros(1)
    order = np.arange(len(lights))
    starts, counts = np.array([0]), np.array([len(lights)])
    children, costs = [], []
    first_child = 0
    level = 0
    while len(starts):
        # the lights of the nodes to split, nodes one after the other
        items = order[_ranges(starts, counts)]
        node = np.repeat(np.arange(len(starts)), counts)
        begin = _starts(counts)
        halves = (counts + 1) // 2
        side, cost = _split(bounds, lights[items], centers[items], node, begin, counts)
        costs.append(cost + EQUAL_COST * counts)
        left = np.add.reduceat(~side, begin, dtype=np.int64)
        height = np.ceil(np.log2(np.maximum(counts, 2)))
        by_count = (left == 0) | (left == counts) | (level + height >= most_levels)
        rank = np.arange(len(items)) - begin[node]
        side = np.where(by_count[node], rank >= halves[node], side)
        left = np.where(by_count, halves, left)
        # a stable partition of each node's lights
        before = np.cumsum(~side) - ~side
        lefts = before - before[begin][node]
        place = begin[node] + np.where(side, left[node] + rank - lefts, lefts)
        partitioned = np.empty_like(items)
        partitioned[place] = items
        order = partitioned

        starts = np.stack([begin, begin + left], axis=1).ravel()
        counts = np.stack([left, counts - left], axis=1).ravel()
        first_child += len(begin)
        single = counts == 1
        child = first_child + np.cumsum(~single) - 1
        child[single] = ~lights[order[starts[single]]]
        children.append(child.reshape(-1, 2))
        starts, counts = starts[~single], counts[~single]
        level += 1
    return np.concatenate(children), np.concatenate(costs)


def _split(
    bounds: EmitterBounds,
    emitters: np.ndarray,
    centers: np.ndarray,
    node: np.ndarray,
    begin: np.ndarray,
    counts: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return whether each light lies on the far side of its node's cheapest split, and the cost of nodes unsplit.

    The first is bool [light], the second float [node].
    """
    side = np.zeros(len(emitters), bool)
    cost = np.zeros(len(begin))
    few = counts <= FEW_LIGHTS
    for kind, bins in ((few, FEW_BINS), (~few, BINS)):
        if kind.any():
            mine = kind[node]
            number = np.cumsum(kind) - 1
            side[mine], cost[kind] = _binned_split(
                bounds, emitters[mine], centers[mine], number[node[mine]], _starts(counts[kind]), bins
            )
    return side, cost


def _binned_split(
    bounds: EmitterBounds, emitters: np.ndarray, centers: np.ndarray, node: np.ndarray, begin: np.ndarray, bins: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the same as ``_split`` for nodes that are all split over so many bins."""
    count = len(begin)
    least, most = np.minimum.reduceat(centers, begin), np.maximum.reduceat(centers, begin)
    extent = most - least
    scale = bins / np.where(extent > 0, extent, np.inf)
    place = np.minimum((centers - least[node]) * scale[node], bins - 1).astype(np.int64)  # [light, axis]

    # what lies in each bin, [node, axis, bin]; lights sorted by bin, so that a bin is a run of them
    key = (node[:, None] * 3 + np.arange(3)) * bins + place
    size = count * 3 * bins
    flat = key.T.ravel()
    sort = np.argsort(flat, kind="stable")
    runs, run_starts = np.unique(flat[sort], return_index=True)
    of_light = np.tile(emitters, 3)[sort]

    def gathered(values: np.ndarray, reduce: np.ufunc, empty: float) -> np.ndarray:
        result = np.full((size, *values.shape[1:]), empty, values.dtype)
        result[runs] = reduce.reduceat(values[of_light], run_starts)
        return result

    low, high = gathered(bounds.low, np.minimum, np.inf), gathered(bounds.high, np.maximum, -np.inf)
    power, axis = gathered(bounds.power, np.add, 0.0), gathered(bounds.axis, np.add, 0.0)
    falloff = gathered(bounds.falloff, np.maximum, 0.0)
    mean = unit_vectors(axis)
    angle = angles_between(mean[flat[sort]], bounds.axis[of_light]) + bounds.facing[of_light]
    facing = np.full(size, -np.inf, np.float32)
    facing[runs] = np.maximum.reduceat(angle, run_starts)

    shape = (count, 3, bins)
    parts = [values.reshape(*shape, *values.shape[1:]) for values in (low, high, power, axis, facing, falloff)]
    forward = _running_cost(*parts)
    backward = _running_cost(*(values[:, :, ::-1] for values in parts))[:, :, ::-1]
    filled = (power > 0).reshape(shape)
    upto = np.cumsum(filled, axis=2)
    valid = (upto[:, :, :-1] > 0) & (upto[:, :, :-1] < upto[:, :, -1:])
    longest = extent.max(axis=1, keepdims=True)
    regularizer = longest / np.where(extent > 0, extent, np.inf)  # their Eq. 2; axes without extent have no split
    split_cost = np.where(
        valid, (forward[:, :, :-1] + backward[:, :, 1:]) * np.where(extent > 0, regularizer, 1)[:, :, None], np.inf
    )
    best = split_cost.reshape(count, -1).argmin(axis=1)
    best_axis, best_bin = best // (bins - 1), best % (bins - 1)
    has_split = valid.reshape(count, -1)[np.arange(count), best]
    side = place[np.arange(len(node)), best_axis[node]] > best_bin[node]
    side &= has_split[node]  # all on one side: the caller takes halves
    return side, forward[:, :, -1].min(axis=1)


def _running_cost(
    low: np.ndarray, high: np.ndarray, power: np.ndarray, axis: np.ndarray, facing: np.ndarray, falloff: np.ndarray
) -> np.ndarray:
    """Return the cost of bins 0 to k together, power times area times solid angle, float [node, axis, k].

    The cone of bins 0 to k is about their mean axis; its angle is bounded by how far the axis turned since each bin.
    """
    low, high = np.minimum.accumulate(low, axis=2), np.maximum.accumulate(high, axis=2)
    mean = unit_vectors(np.cumsum(axis, axis=2))
    own = np.where(np.isfinite(facing), angles_between(unit_vectors(axis), mean) + facing, -np.inf)
    turned = np.zeros_like(own)
    turned[:, :, 1:] = np.cumsum(angles_between(mean[:, :, 1:], mean[:, :, :-1]), axis=2)
    cone = turned + np.maximum.accumulate(own - turned, axis=2)
    cone = np.clip(cone, 0.0, np.pi)
    x, y, z = np.moveaxis(np.where(high >= low, high - low, 0.0), -1, 0)
    area = 2 * (x * y + y * z + z * x) + NARROW_AREA * (x * x + y * y + z * z)
    return np.cumsum(power, axis=2) * area * _solid_angle(cone, np.maximum.accumulate(falloff, axis=2))


def _solid_angle(facing: np.ndarray, falloff: np.ndarray) -> np.ndarray:
    """Return the orientation measure M_omega of Conty Estevez and Kulla 2018, Eq. 1."""
    end = np.minimum(facing + falloff, np.pi)
    sine, cosine = np.sin(facing), np.cos(facing)
    beyond = 2 * end * sine - np.cos(facing - 2 * end) - 2 * facing * sine + cosine
    return 2 * np.pi * (1 - cosine) + np.pi / 2 * beyond


def collapse(children: np.ndarray, costs: np.ndarray) -> list[np.ndarray]:
    """Return the children of the nodes of each level, int64 [node, 8], of a binary tree; EMPTY where there is none."""
    levels, roots, first_child = [], np.array([0]), 0
    while len(roots):
        lanes = np.full((len(roots), LANES), EMPTY)
        lanes[:, :2] = children[roots]
        for filled in range(2, LANES):
            inner = lanes >= 0
            largest = np.where(inner, costs[np.maximum(lanes, 0)], -1.0).argmax(axis=1)
            rows = np.flatnonzero(inner.any(axis=1))
            opened = children[lanes[rows, largest[rows]]]
            lanes[rows, largest[rows]] = opened[:, 0]
            lanes[rows, filled] = opened[:, 1]
        inner = lanes >= 0
        roots = lanes[inner]
        first_child += len(lanes)
        lanes[inner] = first_child + np.arange(len(roots))
        levels.append(lanes)
    return levels


def _starts(counts: np.ndarray) -> np.ndarray:
    """Return where each run of items begins if runs of ``counts`` items stand one after another."""
    return np.cumsum(counts) - counts


def _ranges(starts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return starts[0], starts[0] + 1, ... (counts[0] numbers), starts[1], ..."""
    return np.repeat(starts - _starts(counts), counts) + np.arange(counts.sum())
