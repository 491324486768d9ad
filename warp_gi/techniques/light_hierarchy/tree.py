"""Building the tree of lights that ``warp_gi.kernels.light_hierarchy`` walks.

The topology is found first, from the root down (``topology``). Boxes and cones come last, from the lights up, so that a
refit gives what a build of the same topology does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import warp as wp

from warp_gi.alias import AliasTable
from warp_gi.errors import OptionError
from warp_gi.kernels import light_hierarchy as kernels
from warp_gi.launch import on_device
from warp_gi.techniques.light_hierarchy.bounds import EmitterBounds, angles_between, lengths_of, unit_vectors
from warp_gi.techniques.light_hierarchy.topology import EMPTY, binary_tree, collapse

LANES = kernels.LANES
USUAL_DEPTH = 40
"""Levels of the binary tree before halves are taken; where that is too deep for a path, halves are taken earlier."""
CACHE_LINE = 64
"""Bytes of a cache line, on which nodes begin."""
MARGIN = 1e-6
"""Distance by which boxes are larger than their lights, for rounding, as a share of the largest coordinate."""


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


def build_tree(bounds: EmitterBounds) -> TreeArrays:
    """Return a tree over all emitters; raises OptionError for more of them than paths have room for (millions)."""
    lights = bounds.in_tree
    levels: list[np.ndarray] = []
    for depth in (USUAL_DEPTH, kernels.MOST_LEVELS) if len(lights) else ():
        levels = collapse(*binary_tree(bounds, lights, depth))
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
        cone_axis, cone_facing = cones(tree.axis[nodes], tree.facing[nodes], tree.child_count[nodes])
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
    words[:, rows["RADIUS"]] = lengths_of(half) * (1 + MARGIN)
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


def _on_cache_lines(count: int, words: int) -> np.ndarray:
    """Return zeros, float32 [count * words], that start on a cache line."""
    memory = np.zeros(count * words + CACHE_LINE // 4, np.float32)
    start = -memory.ctypes.data % CACHE_LINE // 4
    return memory[start : start + count * words]


# ---- cones ----


def cones(axis: np.ndarray, facing: np.ndarray, count: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
    between = angles_between(axis_a, axis_b)
    holds = np.minimum(between + smaller, np.pi) <= larger
    joint = np.minimum((larger + between + smaller) / 2, np.pi)
    turn = joint - larger
    across = axis_b - axis_a * np.einsum("ni,ni->n", axis_a, axis_b)[:, None]
    length = lengths_of(across)
    across /= np.where(length > 0, length, 1)[:, None]
    turned = axis_a * np.cos(turn)[:, None] + across * np.sin(turn)[:, None]
    # axes that are opposite or equal leave no plane to turn in
    keep = holds | (length < 1e-9)
    joint = np.where(holds, larger, np.where(keep, np.minimum(between + smaller, np.pi), joint))
    joint = np.where(keep, np.maximum(joint, larger), joint)
    return np.where((keep | (joint >= np.pi))[:, None], axis_a, unit_vectors(turned)), joint
