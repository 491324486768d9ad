"""Building the CPU's eight-wide tree: launches the stages of kernels/bvh_build.py in turn."""

from __future__ import annotations

import contextlib
import mmap

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.kernels import bvh_build as building
from warp_gi.kernels import bvh_native as layout
from warp_gi.kernels import types

SUBTREES = 64  # approximate number of tasks that a build is divided into
MOST_TASKS = 1024
QUALITIES = ("fast", "high")
PASSES = 3  # of reinsertion
SHARE = 0.1  # of the nodes, those with the largest boxes, that a pass tries to move
GROWTH = 0.25  # size of a batch of reinsertions over those before it; the largest boxes move one by one
DEEPEST = 70  # levels of a binary tree, which traversals have room for
HUGE_PAGE = 1 << 21  # bytes
CPU = "cpu"


def build(bvh: types.Bvh, points: wp.array, indices: wp.array, quality: str) -> None:
    """Give ``bvh`` the topology of a tree over triangles: nodes, blocks and the parents of blocks.

    ``points`` is vec3 [vertex], ``indices`` vec3i [triangle], both on the CPU; ``quality`` is one of QUALITIES.
    ``fill`` has to follow.
    """
    device = wp.get_device(CPU)
    data = _binary_tree(points, indices)
    if quality == "high" and len(indices) > layout.LANES and not _reinsert(data):
        data = _binary_tree(points, indices)
    nodes = 2 * len(indices) - 1
    data.costs = wp.empty(8 * nodes, dtype=wp.float32, device=device)
    data.choices = wp.empty(8 * nodes, dtype=wp.uint8, device=device)
    launch.launch(building.cost_nodes, -(-nodes // building.CHUNK_NODES), [data, 0], device, smallest_slice=1)
    launch.launch(building.cost_nodes, 1, [data, 1], device)
    launch.launch(building.widen, 1, [data, None, None], device)
    counts = data.counts.numpy()
    bvh.nodes = _empty_huge(layout.NODE_WORDS * int(counts[2]), wp.uint32)
    bvh.blocks = _empty_huge(layout.BLOCK_WORDS * int(counts[3]), wp.float32)
    launch.launch(building.widen, 1, [data, bvh.nodes, bvh.blocks], device)
    bvh.parents = wp.array(_block_parents(bvh.nodes, int(counts[3])), dtype=wp.int32, device=device)


def fill(bvh: types.Bvh, points: wp.array, indices: wp.array) -> None:
    """Write the geometry of a tree from the vertices: all that a refit needs."""
    device = wp.get_device(CPU)
    blocks, nodes = len(bvh.blocks) // layout.BLOCK_WORDS, len(bvh.nodes) // layout.NODE_WORDS
    block_boxes = wp.empty(building.BOX_WORDS * blocks, dtype=wp.float32, device=device)
    node_boxes = wp.empty(building.BOX_WORDS * nodes, dtype=wp.float32, device=device)
    launch.launch(building.fill_blocks, blocks, [points, indices, bvh.face_masks, bvh.blocks, block_boxes], device)
    launch.launch(building.fill_nodes, 1, [bvh.nodes, block_boxes, node_boxes], device)


def _binary_tree(points: wp.array, indices: wp.array) -> building.BuildData:
    count, device = len(indices), wp.get_device(CPU)
    data = building.BuildData()
    data.refs = wp.empty(8 * count, dtype=wp.float32, device=device)
    data.surfaces = wp.empty(count, dtype=wp.float32, device=device)
    data.nodes = wp.empty(8 * (2 * count - 1), dtype=wp.float32, device=device)
    data.tasks = wp.empty(4 * MOST_TASKS, dtype=wp.int32, device=device)
    data.counts = wp.array([0, 0, -1, 0, 0], dtype=wp.int32, device=device)
    launch.launch(building.bound_triangles, count, [points, indices, data.refs, data.surfaces], device)
    launch.launch(building.split_top, 1, [data, max(count // SUBTREES, 512)], device)
    launch.launch(building.build_subtrees, int(data.counts.numpy()[0]), [data], device, smallest_slice=1)
    return data


def _reinsert(build: building.BuildData) -> bool:
    """Lower the cost of a binary tree by reinsertion; False if it became too deep, and is to be built anew."""
    count, device = len(build.nodes) // 8, wp.get_device(CPU)
    data = building.ReinsertData()
    data.nodes, data.counts = build.nodes, build.counts
    data.parents = wp.empty(count, dtype=wp.int32, device=device)
    data.touched = wp.zeros(count + 1, dtype=wp.int32, device=device)
    areas = wp.empty(count, dtype=wp.float32, device=device)
    launch.launch(building.link_nodes, count, [data], device)
    batches = 0
    for _ in range(PASSES):
        launch.launch(building.node_areas, count, [data.nodes, areas], device)
        chosen = _largest(areas.numpy(), max(int(SHARE * count), 1))
        data.gains = wp.empty(len(chosen), dtype=wp.float32, device=device)
        data.targets = wp.empty(len(chosen), dtype=wp.int32, device=device)
        gains = data.gains.numpy()
        begin = 0
        while begin < len(chosen):
            some = chosen[begin : begin + 1 + int(begin * GROWTH)]
            begin += len(some)
            batches += 1
            data.candidates = wp.array(some, dtype=wp.int32, device=device, copy=False)
            launch.launch(building.find_targets, len(some), [data], device, smallest_slice=32)
            order = np.argsort(-gains[: len(some)], kind="stable").astype(np.int32)
            moves: wp.array = wp.array(order, dtype=wp.int32, device=device, copy=False)
            launch.launch(building.move_nodes, 1, [data, moves, batches], device)
    flat = wp.empty(8 * count, dtype=wp.float32, device=device)
    launch.launch(building.flatten, 1, [data, flat], device)
    build.nodes = flat
    return int(build.counts.numpy()[1]) < DEEPEST


def _largest(areas: np.ndarray, count: int) -> np.ndarray:
    """Return int32 indices of the ``count`` largest, in descending order, the lower index first among equals."""
    least = np.partition(areas, len(areas) - count)[len(areas) - count]
    found = np.flatnonzero(areas >= least)
    return found[np.argsort(-areas[found], kind="stable")][:count].astype(np.int32)


def _block_parents(nodes: wp.array, block_count: int) -> np.ndarray:
    """Return int32 [block]: where the node above each block starts, as children are written."""
    children = nodes.numpy().view(np.int32).reshape(-1, layout.NODE_WORDS)[:, layout.NODE_WORDS - 8 :]
    node, lane = np.nonzero(children < -1)
    parents = np.zeros(block_count, np.int32)
    parents[~children[node, lane] // layout.BLOCK_STEPS] = node * layout.NODE_STEPS
    return parents


def _empty_huge(length: int, dtype: type) -> wp.array:
    """Return an uninitialised CPU array aligned to pages, huge ones where the system has them."""
    size = max(length * np.dtype(wp.dtype_to_numpy(dtype)).itemsize, 1)
    if hasattr(mmap, "MAP_PRIVATE"):
        memory = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
    else:
        memory = mmap.mmap(-1, size)
    if size >= HUGE_PAGE and hasattr(mmap, "MADV_HUGEPAGE"):
        with contextlib.suppress(OSError):  # a hint: without huge pages queries are slower, not wrong
            memory.madvise(mmap.MADV_HUGEPAGE)
    view = np.frombuffer(memory, dtype=wp.dtype_to_numpy(dtype), count=length)
    return wp.array(view, dtype=dtype, device="cpu", copy=False)
