"""Building the tree of lights that ``warp_gi.kernels.light_hierarchy`` walks.

A binary tree is split level by level by the surface area and orientation heuristic of Conty Estevez and Kulla 2018
(Eq. 1), over bins (Wald 2007), down to single lights; then nodes are collapsed to eight children, opening the child of
the largest cost first. Bounds come last, from the lights up, so that a refit gives what a build of the same topology
does. NumPy does all nodes of a level at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import warp as wp

from warp_gi.alias import AliasTable
from warp_gi.color import LUMINANCE
from warp_gi.errors import OptionError
from warp_gi.kernels import light_hierarchy as kernels
from warp_gi.kernels import types
from warp_gi.launch import on_device
from warp_gi.scene.scene import Scene

LANES = kernels.LANES
EMPTY = np.iinfo(np.int64).min
"""Stands for no child while a tree is built."""
BINS = 12
"""Bins along each axis that a node's lights are sorted into to find its cheapest split."""
FEW_LIGHTS, FEW_BINS = 8, 6
"""Largest number of lights of a node that is split over fewer bins, and the number of those bins."""
USUAL_DEPTH = 40
"""Levels of the binary tree before halves are taken; where that is too deep for a path, halves are taken earlier."""
NARROW_AREA = 1e-2
"""Share of the squared diagonal that counts as area, so that lights on one line are split by cost as well."""
EQUAL_COST = 1e-30
"""Added to a node's cost for each of its lights, so that those without extent are opened evenly."""
CACHE_LINE = 64
"""Bytes of a cache line, on which nodes begin."""
MARGIN = 1e-6
"""Distance by which boxes are larger than their lights, for rounding, as a share of the largest coordinate."""


@dataclass(frozen=True, eq=False)
class EmitterBounds:
    """What a tree knows of each emitter. Of directional lights, only ``directional`` and ``flux`` are read."""

    low: np.ndarray
    """float64 [emitter, 3]: lowest corner of the emitter's box, metres."""
    high: np.ndarray
    """float64 [emitter, 3]: highest corner of the emitter's box, metres."""
    axis: np.ndarray
    """float64 [emitter, 3]: unit vector, the direction that the emitter faces."""
    facing: np.ndarray
    """float64 [emitter]: half angle of the cone of directions that the emitter faces (theta_o), radians."""
    falloff: np.ndarray
    """float64 [emitter]: angle beyond that cone at which the emitter still shines (theta_e), radians."""
    power: np.ndarray
    """float64 [emitter]: luminance of the intensity straight ahead, W/sr; an emitter of 0 is never selected."""
    directional: np.ndarray
    """bool [emitter]: whether the light is directional, without a place."""
    flux: np.ndarray
    """float64 [emitter]: W, which decides between directional lights, and between those and the tree."""

    @property
    def in_tree(self) -> np.ndarray:
        """int64 [light]: emitters that a tree holds."""
        return np.flatnonzero(~self.directional & (self.power.astype(np.float32) > 0.0))


@dataclass(frozen=True, eq=False)
class TreeArrays:
    """A tree on the host: nodes in order of their level, the root first. Lanes past a node's last child are empty."""

    child: np.ndarray
    """int32 [node, 8]: index of a node, or the complement of an emitter's index; 0 in an empty lane."""
    child_count: np.ndarray
    """int64 [node]: number of children."""
    level_starts: np.ndarray
    """int64 [level + 1]: first node of each level, and the number of nodes."""
    paths: np.ndarray
    """int64 [emitter]: way from the root to each emitter, see ``LightTree.paths``."""
    low: np.ndarray
    """float64 [node, 8, 3]: lowest corner of each child's box, metres."""
    high: np.ndarray
    """float64 [node, 8, 3]: highest corner of each child's box, metres."""
    axis: np.ndarray
    """float64 [node, 8, 3]: unit axis of the cone around the directions that each child's lights face."""
    facing: np.ndarray
    """float64 [node, 8]: half angle of that cone, radians."""
    falloff: np.ndarray
    """float64 [node, 8]: largest angle beyond the cone at which a light of the child shines, radians."""
    power: np.ndarray
    """float64 [node, 8]: sum of the powers of each child's lights, W/sr."""
    directional: np.ndarray
    """int32 [number]: indices of directional emitters."""
    directional_flux: np.ndarray
    """float64 [number]: flux of those emitters, W."""
    directional_probability: float
    """Probability of sampling a directional emitter rather than the tree."""


def emitter_bounds(scene: Scene, device: str | wp.Device) -> EmitterBounds:
    """Return the bounds of a scene's emitters in the pose that its data on ``device`` are in."""
    placed = scene.placed_emitters(device)
    table = placed.table
    count = len(table)
    kind, flux = table["kind"], scene.emitter_powers()
    low = table["position"].astype(np.float64)
    high, axis = low.copy(), table["direction"].astype(np.float64)
    facing, falloff = np.zeros(count), np.full(count, np.pi / 2)
    power = table["intensity"].astype(np.float64) @ LUMINANCE  # straight ahead

    corners, both = placed.corners, placed.two_sided
    triangles = np.arange(len(corners))
    low[triangles], high[triangles] = corners.min(axis=1), corners.max(axis=1)
    axis[triangles] = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing[triangles[both]] = np.pi
    power[triangles] = flux[triangles] / np.where(both, 2 * np.pi, np.pi)
    points = kind == types.EMITTER_POINT
    facing[points] = np.pi
    spots = kind == types.EMITTER_SPOT
    inner = np.arccos(np.clip(table["cos_inner"][spots].astype(np.float64), -1, 1))
    outer = np.arccos(np.clip(table["cos_outer"][spots].astype(np.float64), -1, 1))
    facing[spots], falloff[spots] = inner, outer - inner
    return EmitterBounds(low, high, _unit(axis), facing, falloff, power, kind == types.EMITTER_DIRECTIONAL, flux)


def build_tree(bounds: EmitterBounds) -> TreeArrays:
    """Return a tree over all emitters; raises OptionError for more of them than paths have room for (millions)."""
    lights = bounds.in_tree
    levels: list[np.ndarray] = []
    for depth in (USUAL_DEPTH, kernels.MOST_LEVELS) if len(lights) else ():
        levels = _collapse(*_binary_tree(bounds, lights, depth))
        if len(levels) <= kernels.MOST_LEVELS:
            break
    if len(levels) > kernels.MOST_LEVELS:
        raise OptionError(
            f"{len(lights)} lights make a tree of {len(levels)} levels; {kernels.MOST_LEVELS} is the most"
        )

    child = np.concatenate(levels or [np.zeros((0, LANES), np.int64)])
    used = child != EMPTY
    level_starts = np.concatenate([[0], np.cumsum([len(level) for level in levels])]).astype(np.int64)
    paths = np.full(len(bounds.power), kernels.NO_PATH, np.int64)
    node_paths = np.zeros(len(child), np.int64)
    for level, (start, stop) in enumerate(pairwise(level_starts)):
        mine = child[start:stop]
        lanes = node_paths[start:stop, None] | (np.arange(LANES, dtype=np.int64) << (3 * level))
        leaf, inner = used[start:stop] & (mine < 0), used[start:stop] & (mine >= 0)
        paths[~mine[leaf]] = lanes[leaf]
        node_paths[mine[inner]] = lanes[inner]

    directional = np.flatnonzero(bounds.directional & (bounds.flux > 0.0))
    paths[directional] = kernels.DIRECTIONAL_PATH - np.arange(len(directional))
    flux = bounds.flux[directional]
    rest = bounds.flux[lights].sum()
    shape = (len(child), LANES)
    empty = TreeArrays(
        child=np.where(used, child, 0).astype(np.int32),
        child_count=used.sum(axis=1),
        level_starts=level_starts,
        paths=paths,
        low=np.full((*shape, 3), np.inf),
        high=np.full((*shape, 3), -np.inf),
        axis=np.zeros((*shape, 3)),
        facing=np.zeros(shape),
        falloff=np.zeros(shape),
        power=np.zeros(shape),
        directional=directional.astype(np.int32),
        directional_flux=flux,
        directional_probability=float(flux.sum() / (flux.sum() + rest)) if len(flux) else 0.0,
    )
    return refit_tree(empty, bounds)


def refit_tree(tree: TreeArrays, bounds: EmitterBounds) -> TreeArrays:
    """Return a tree of the same topology around lights that moved.

    The same emitters must have power as when it was built.
    """
    tree = replace(
        tree,
        **{name: getattr(tree, name).copy() for name in ("low", "high", "axis", "facing", "falloff", "power")},
    )
    used = np.arange(LANES) < tree.child_count[:, None]
    for start, stop in reversed(list(pairwise(tree.level_starts))):
        child = tree.child[start:stop]
        leaf, inner = used[start:stop] & (child < 0), used[start:stop] & (child >= 0)
        emitters, nodes = ~child[leaf], child[inner]
        cone_axis, cone_facing = _cones(tree.axis[nodes], tree.facing[nodes], tree.child_count[nodes])
        for values, of_emitters, of_nodes in (
            (tree.low, bounds.low, tree.low[nodes].min(axis=1)),
            (tree.high, bounds.high, tree.high[nodes].max(axis=1)),
            (tree.axis, bounds.axis, cone_axis),
            (tree.facing, bounds.facing, cone_facing),
            (tree.falloff, bounds.falloff, tree.falloff[nodes].max(axis=1)),
            (tree.power, bounds.power, tree.power[nodes].sum(axis=1)),
        ):
            values[start:stop][leaf] = of_emitters[emitters]
            values[start:stop][inner] = of_nodes
    return tree


def to_device(tree: TreeArrays, device: wp.Device) -> kernels.LightTree:
    """Return a tree as kernels read it."""
    node_count = len(tree.child)
    used = np.arange(LANES) < tree.child_count[:, None]
    low, high = (np.where(used[..., None], corner, 0.0) for corner in (tree.low, tree.high))
    margin = MARGIN * max(np.abs(low).max(initial=0.0), np.abs(high).max(initial=0.0))
    half = (high - low) / 2 * (1 + MARGIN) + margin
    words = _on_cache_lines(node_count, kernels.NODE_WORDS).reshape(node_count, kernels.NODE_WORDS // LANES, LANES)
    rows = kernels.ROWS
    words[:, rows["CENTER"] : rows["CENTER"] + 3] = np.moveaxis((low + high) / 2, 2, 1)
    words[:, rows["HALF"] : rows["HALF"] + 3] = np.moveaxis(half, 2, 1)
    words[:, rows["RADIUS"]] = _length(half) * (1 + MARGIN)
    words[:, rows["AXIS"] : rows["AXIS"] + 3] = np.moveaxis(tree.axis, 2, 1)
    words[:, rows["COS_FACING"]], words[:, rows["SIN_FACING"]] = np.cos(tree.facing), np.sin(tree.facing)
    words[:, rows["COS_FALLOFF"]] = np.cos(tree.falloff)
    words[:, rows["POWER"]] = tree.power
    words[:, rows["CHILD"]] = tree.child.view(np.float32)

    alias = AliasTable.build(tree.directional_flux if len(tree.directional) else np.ones(1))
    data = kernels.LightTree()
    data.node_count = node_count
    data.nodes = on_device(words.reshape(-1), wp.float32, device)
    data.paths = on_device(tree.paths, wp.int64, device)
    data.directional = on_device(tree.directional, wp.int32, device)
    data.directional_alias = alias.on(device)
    data.directional_count = len(tree.directional)
    data.directional_probability = tree.directional_probability
    return data


# ---- the binary tree ----


def _binary_tree(bounds: EmitterBounds, lights: np.ndarray, most_levels: int) -> tuple[np.ndarray, np.ndarray]:
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
    mean = _unit(axis)
    angle = _angle(mean[flat[sort]], bounds.axis[of_light]) + bounds.facing[of_light]
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
    mean = _unit(np.cumsum(axis, axis=2))
    own = np.where(np.isfinite(facing), _angle(_unit(axis), mean) + facing, -np.inf)
    turned = np.zeros_like(own)
    turned[:, :, 1:] = np.cumsum(_angle(mean[:, :, 1:], mean[:, :, :-1]), axis=2)
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


# ---- eight children ----


def _collapse(children: np.ndarray, costs: np.ndarray) -> list[np.ndarray]:
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


def _cones(axis: np.ndarray, facing: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the axis [node, 3] and half angle [node] of a cone around the cones [node, 8] of ``count`` children."""
    total_axis, total = axis[:, 0].copy(), facing[:, 0].copy()
    for lane in range(1, LANES):
        used = lane < count
        joint_axis, joint = _cone_union(total_axis[used], total[used], axis[used, lane], facing[used, lane])
        total_axis[used], total[used] = joint_axis, joint
    return total_axis, total


def _cone_union(
    axis_a: np.ndarray, facing_a: np.ndarray, axis_b: np.ndarray, facing_b: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest cones around pairs of cones (Conty Estevez and Kulla 2018, Algorithm 1)."""
    swap = (facing_b > facing_a)[:, None]
    axis_a, axis_b = np.where(swap, axis_b, axis_a), np.where(swap, axis_a, axis_b)
    larger, smaller = np.maximum(facing_a, facing_b), np.minimum(facing_a, facing_b)
    between = _angle(axis_a, axis_b)
    holds = np.minimum(between + smaller, np.pi) <= larger
    joint = np.minimum((larger + between + smaller) / 2, np.pi)
    turn = joint - larger
    across = axis_b - axis_a * np.einsum("ni,ni->n", axis_a, axis_b)[:, None]
    length = _length(across)
    across /= np.where(length > 0, length, 1)[:, None]
    turned = axis_a * np.cos(turn)[:, None] + across * np.sin(turn)[:, None]
    # axes that are opposite or equal leave no plane to turn in
    keep = holds | (length < 1e-9)
    joint = np.where(holds, larger, np.where(keep, np.minimum(between + smaller, np.pi), joint))
    joint = np.where(keep, np.maximum(joint, larger), joint)
    return np.where((keep | (joint >= np.pi))[:, None], axis_a, _unit(turned)), joint


# ---- small tools ----


def _starts(counts: np.ndarray) -> np.ndarray:
    """Return where each run of items begins if runs of ``counts`` items stand one after another."""
    return np.cumsum(counts) - counts


def _ranges(starts: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return starts[0], starts[0] + 1, ... (counts[0] numbers), starts[1], ..."""
    return np.repeat(starts - _starts(counts), counts) + np.arange(counts.sum())


def _on_cache_lines(count: int, words: int) -> np.ndarray:
    """Return zeros, float32 [count * words], that start on a cache line."""
    memory = np.zeros(count * words + CACHE_LINE // 4, np.float32)
    start = -memory.ctypes.data % CACHE_LINE // 4
    return memory[start : start + count * words]


def _length(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("...i,...i->...", vectors, vectors))


def _unit(vectors: np.ndarray) -> np.ndarray:
    """Return vectors of length 1; those of length 0 become +y."""
    length = _length(vectors)
    unit = vectors / np.where(length > 0, length, np.inf)[..., None]
    unit[..., 1] += length == 0
    return unit


def _angle(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles between unit vectors; exact for small ones too."""
    return 2 * np.arctan2(_length(a - b), _length(a + b))
