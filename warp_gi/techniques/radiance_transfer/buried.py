"""Slots in awkward places: on the very edge of a face, where rays slip past its neighbour, and inside other objects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.kernels.transfer_bake import SKY
from warp_gi.kernels.transfer_bounces import spread_reach
from warp_gi.techniques.radiance_transfer.rays import TracedTransfer
from warp_gi.techniques.radiance_transfer.textures import Atlas

MARGIN = 0.1
"""Texels by which a slot keeps away from the edges of its face."""
MOST_MARGIN = 0.3
"""Largest barycentric coordinate that this may take, in faces smaller than a texel."""
REACHED = 0.25
"""Share of a slot's rays that have to end where light gets, for light to get to the slot. Few of those inside an object
may seem to, where the texel that is nearest to what they hit lies outside."""
REACH = 3
"""Texels from a buried slot in which another stands in for it: bilinear fetches of visible points read the first."""


def off_edges(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return barycentric u, v [slots, 2] moved off the edges of faces with ``corners`` [slots, 3, 2] in texels.

    Where a wall stands on a floor, a ray from the wall's lowest edge may pass below the floor.
    """
    edges = np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1)  # of each corner, the one across
    area = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    heights = area[:, None] / np.maximum(np.linalg.norm(edges, axis=2), 1e-20)
    least = np.minimum(MARGIN / np.maximum(heights, 1e-20), MOST_MARGIN)
    weights = np.column_stack([1.0 - points.sum(axis=1), points])
    weights = np.maximum(weights, least)
    return (weights / weights.sum(axis=1, keepdims=True))[:, 1:].astype(np.float32)


def without_buried(
    atlas: Atlas, traced: TracedTransfer, lit: np.ndarray | None = None, device: wp.Device | None = None
) -> TracedTransfer:
    """Return what was traced, with that of the nearest slot in the open in place of that of slots inside objects.

    A floor's texels below a box are black, and bilinear fetches beside the box read them. No light gets there, over
    any number of bounces. Hits of such slots count as hits of those that stand in for them.

    Args:
        atlas: Where the slots are.
        traced: What their rays find.
        lit: Slots that lamps shine on, bool [slots]; None without lamps.
        device: Where kernels run; None is the CPU.
    """
    if atlas.corners.shape[0] == 0 or traced.hits.shape[1] == 0:
        return traced
    buried = ~reached_slots(traced.hits, lit, device)
    if not buried.any():
        return traced
    stands_in = _stand_ins(atlas, buried)
    hits = traced.hits[stands_in]
    hits = np.where(hits >= 0, stands_in[np.maximum(hits, 0)], hits)
    return replace(traced, transfer=traced.transfer[stands_in], hits=hits)


def reached_slots(hits: np.ndarray, lit: np.ndarray | None = None, device: wp.Device | None = None) -> np.ndarray:
    """Return the slots that light gets to, bool [slots]: that see the sky, are lit, or see enough of such slots."""
    target = device or launch.get_device("cpu")
    reached = (hits == SKY).any(axis=1)
    if lit is not None:
        reached |= lit
    needed = int(REACHED * hits.shape[1]) + 1
    rows = launch.on_device(hits, wp.int32, target)
    dark = np.flatnonzero(~reached).astype(np.int32)
    while len(dark):
        known = launch.on_device(reached.astype(np.uint8), wp.uint8, target)
        found = wp.zeros(len(dark), dtype=wp.uint8, device=target)
        inputs = [launch.on_device(dark, wp.int32, target), rows, known, needed, found]
        launch.launch(spread_reach, len(dark), inputs, target)
        more = found.numpy() > 0
        if not more.any():
            break
        reached[dark[more]] = True
        dark = dark[~more]
    return reached


def _stand_ins(atlas: Atlas, buried: np.ndarray) -> np.ndarray:
    """Return for each slot itself or, if it is buried, the nearest one of its chart that is not, int32 [slots]."""
    result = np.where(buried, -1, np.arange(atlas.count)).astype(np.int32)
    charts = atlas.charts[atlas.slot_faces]
    steps = sorted(((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j), key=lambda step: abs(step[0] * step[1]))
    for start, width, height in atlas.pages.tolist():
        for side in range(2):
            grid = np.full((height + 2, width + 2), -1, np.int32)
            grid[1:-1, 1:-1] = atlas.slots[side, start : start + width * height].reshape(height, width)
            rows, columns = np.nonzero((grid >= 0) & buried[np.maximum(grid, 0)])
            slots = grid[rows, columns]
            for _ in range(REACH):
                found = np.full(len(slots), -1, np.int32)
                for i, j in steps:
                    near = grid[rows + i, columns + j]
                    fits = (near >= 0) & (charts[np.maximum(near, 0)] == charts[slots])
                    other = np.where(fits, result[np.maximum(near, 0)], -1)
                    found = np.where(found < 0, other, found)
                open_ones = result[slots] < 0
                result[slots[open_ones]] = found[open_ones]
    return np.where(result < 0, np.arange(atlas.count, dtype=np.int32), result)
