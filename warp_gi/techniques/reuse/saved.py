"""What saved states of the sample octree, the light cache and guided paths have to be, before a kernel follows them.

States are ``Any`` here: their modules import this one.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from warp_gi.kernels import octree as octree_kernels
from warp_gi.kernels import quadtree as quadtree_kernels
from warp_gi.layout import Layout, misfit

MOST = 1e30
"""Largest number of a state."""


def octree_fault(state: Any) -> str:
    """Return why the nodes are no octree, level by level as it is built; "" if they are."""
    nodes = _array(state.octree.nodes)
    count = len(nodes)
    layouts = {
        "nodes": Layout("uint32", (None,)),
        "prefixes": Layout("uint32", (count,), 0, 1 << 30),
        "levels": Layout("int32", (count,), 0, octree_kernels.LEVELS - 1),
        "counts": Layout("int32", (8 * count,), 0),
        "places": Layout("float64", (None,), -MOST, MOST),
        "moved": Layout("bool", ()),
    }
    arrays = {name: _array(getattr(state, name)) for name in list(layouts)[1:]} | {"nodes": nodes}
    if problem := misfit(arrays, layouts):
        return problem
    if not count:
        return "its octree has no root"
    is_inner = ~leaf_places(nodes).reshape(-1, 8)
    inner = is_inner.sum(axis=1)
    before = 1 + np.cumsum(inner) - inner
    parents = np.repeat(np.arange(count), inner)
    levels, prefixes = arrays["levels"].astype(np.int64), arrays["prefixes"].astype(np.int64)
    if len(parents) != count - 1 or ((nodes >> 8) != before)[inner > 0].any() or (parents > np.arange(count - 1)).any():
        return "nodes of its octree lead elsewhere than to their children"
    shifts = int(octree_kernels.TOP_SHIFT) - 3 * levels[parents]
    expected = prefixes[parents] + (np.nonzero(is_inner)[1] << np.maximum(shifts, 0))
    if levels[0] or prefixes[0] or (levels[1:] != levels[parents] + 1).any() or (prefixes[1:] != expected).any():
        return "cells of its octree lie elsewhere than in their parents"
    return ""


def leaf_places(nodes: np.ndarray) -> np.ndarray:
    """Return which of eight places of each node hold a leaf, bool [8 * node + octant]."""
    return ((nodes[:, None] >> np.arange(8, dtype=np.uint32)) & 1).astype(bool).ravel()


def guide_fault(state: Any, before: Any, octree: Any) -> str:
    """Return why quadtrees are none, or do not fit the octree; "" if they do. ``before`` is the state of no frame."""
    if octree is None:
        return "it has no octree"
    leaves, is_leaf = octree.leaf_count, leaf_places(_array(octree.octree.nodes))
    bits = 4 * before.counts.shape[0] // before.guides.trees.shape[0]
    guides = state.guides
    arrays = {name: _array(getattr(guides, name)) for name in ("trees", "shares", "moments", "anchors", "nearness")}
    arrays |= {"energies": _array(guides.energies), "counts": _array(state.counts)}
    layouts = {
        "trees": Layout("uint32", (leaves, 4)),
        "shares": Layout("float32", (leaves, 2), 0, 1),
        "moments": Layout("float32", (2 * leaves, _array(before.guides.moments).shape[1]), -MOST, MOST),
        "anchors": Layout("float32", (leaves, 4), -MOST, MOST),
        "nearness": Layout("float32", (leaves, 2), -MOST, MOST),
        "energies": Layout("float32", (leaves * 4 * bits,), -MOST, MOST),
        "counts": Layout("uint32", (leaves * bits // 4,)),
    }
    shapes = {name: Layout(one.dtypes, one.shape) for name, one in layouts.items() if name in ("trees", "counts")}
    told = {name: _of_leaves(array, is_leaf, leaves) for name, array in arrays.items()}
    values = {
        name: Layout(one.dtypes, np.shape(told[name]), one.low, one.high)
        for name, one in layouts.items()
        if np.shape(arrays[name]) == one.shape
    }
    if problem := misfit(arrays, shapes) or misfit(told, values if len(values) == len(layouts) else layouts):
        return problem
    return _quadtree_fault(told["trees"], told["counts"].reshape(-1, bits // 4), bits)


def _of_leaves(array: np.ndarray, is_leaf: np.ndarray, leaves: int) -> np.ndarray:
    """Return the items of places that hold a leaf: others were never written."""
    if not leaves or len(array) % leaves:
        return array
    return array[np.repeat(is_leaf, len(array) // leaves)]


def _quadtree_fault(trees: np.ndarray, counts: np.ndarray, bits: int) -> str:
    """Return why trees uint32 [leaf, 4] are no quadtrees of so many bits, or ``counts`` not theirs."""
    flags = np.unpackbits(np.ascontiguousarray(trees).view(np.uint8), axis=1, bitorder="little")
    if flags[:, bits:].any() or (flags.sum(axis=1) != bits // 4 - 1).any():
        return "its quadtrees have another number of nodes"
    ranks = np.cumsum(flags, axis=1)
    levels, rows = np.zeros((len(trees), bits // 4), np.int64), np.arange(len(trees))
    for node in range(bits):
        some = rows[flags[:, node] > 0]
        if (ranks[some, node] <= node // 4).any():
            return "nodes of its quadtrees have no parent"
        levels[some, ranks[some, node]] = levels[some, node // 4] + 1
    if len(trees) and levels.max() >= int(quadtree_kernels.QUADTREE_LEVELS):
        return "its quadtrees are too deep"
    below = np.zeros((len(trees), bits // 4), np.int64)
    expected = np.zeros((len(trees), bits // 4), np.int64)
    for node in range(bits - 1, -1, -1):
        number = np.where(flags[:, node] > 0, ranks[:, node], 0)
        size = np.where(number > 0, below[rows, number], 1)
        below[:, node // 4] += size
        expected[:, node // 4] |= size << (8 * (node % 4))
    return "counts of its quadtrees are not theirs" if (expected != counts).any() else ""


def cache_fault(state: Any, before: Any, octree: Any) -> str:
    """Return why lists of lights are none, or do not fit octree and scene; "" if they do."""
    if octree is None:
        return "it has no octree"
    leaves, emitters = octree.leaf_count, len(before.places)
    tables, known = state.tables, state.known
    items, entries = _array(tables.items), _array(known.entries)
    size, listed = len(items), len(entries)
    layouts = {
        "buckets": Layout("int32", (leaves,), 0, 1 << 20),
        "offsets": Layout("int32", (leaves,), 0, size),
        "items": Layout("int32", (size,), 0),
        "rates": Layout("float32", (size,), 0, MOST),
        "chances": Layout("float32", (size,), 0, 1.0001),
        "exploration": Layout("float32", (leaves,), float(np.finfo(np.float32).tiny), 1),
        "alone": Layout("int32", (leaves,), 0, 1),
        "moments": Layout("float32", (leaves, 2), -MOST, MOST),
        "excesses": Layout("float32", (leaves,), -MOST, MOST),
    }
    arrays = {name: _array(getattr(tables, name)) for name in layouts}
    if problem := misfit(arrays, layouts):
        return problem
    lists = {
        "offsets": Layout("int32", (leaves,), 0, listed),
        "counts": Layout("int32", (leaves,), 0, listed),
        "entries": Layout("int32", (listed,), 0, max((emitters << 8) - 1, 0)),
        "tries": Layout("float32", (listed, 2), 0, MOST),
    }
    found = {name: _array(getattr(known, name)) for name in lists}
    places = {"places": state.places}
    if problem := misfit(found, lists) or misfit(places, {"places": Layout("float64", (emitters, 6), -MOST, MOST)}):
        return problem
    if (found["offsets"].astype(np.int64) + found["counts"] > listed).any():
        return "its lists of lights end behind their entries"
    return _bucket_fault(arrays, emitters)


def _bucket_fault(tables: dict[str, np.ndarray], emitters: int) -> str:
    """Return why buckets of lights lead elsewhere than to lights; "" if they do not."""
    regions = np.unique(np.stack([tables["offsets"], tables["buckets"]], axis=1).astype(np.int64), axis=0)
    regions = regions[regions[:, 1] > 0]
    more = regions[:, 1] - 1
    if (more & (more - 1)).any() or (regions.sum(axis=1) > len(tables["items"])).any():
        return "buckets of lights are no power of two, or end behind their table"
    for offset, buckets in regions.tolist():
        ends = tables["items"][offset : offset + buckets].astype(np.int64)
        chances = np.diff(tables["chances"][offset : offset + buckets].astype(np.float64), prepend=0.0)
        counts, first = np.diff(ends, prepend=0), offset + buckets
        lights = tables["items"][first : first + ends[-1]]
        rates = tables["rates"][first : first + ends[-1]]
        if counts.min() < 0 or first + ends[-1] > len(tables["items"]) or (len(lights) and lights.max() >= emitters):
            return "a bucket leads to lights that the scene has not"
        if chances.min() < 0 or (chances[counts == 0] > 0).any() or abs(chances.sum() - 1) > 1e-4 or (rates <= 0).any():
            return "chances of buckets of lights do not add up to 1"
    return ""


def _array(values: Any) -> np.ndarray:
    return np.asarray(values if isinstance(values, np.ndarray) else values.numpy())
