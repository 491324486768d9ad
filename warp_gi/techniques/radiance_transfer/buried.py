"""Slots in awkward places: on the very edge of a face, where rays slip past its neighbour, inside other objects, and
behind surfaces that cut theirs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.kernels.transfer_bake import BLACK, part_slots
from warp_gi.techniques.radiance_transfer.rays import TracedTransfer, TransferWork
from warp_gi.techniques.radiance_transfer.textures import Atlas

MARGIN = 0.02
"""Texels by which a slot keeps away from the edges of its face."""
MOST_MARGIN = 0.3
"""Largest barycentric coordinate that this may take, in faces smaller than a texel."""
BEHIND, CLEAR = 0.2, 0.1
"""Share of a slot's rays that meet backs, above which the slot may lie inside an object or behind a surface that cuts
its own, and share up to which another stands in for it."""
REACH_INSIDE, REACH_BEHIND = 3, 1
"""Texels from a slot in which another stands in for it: inside closed objects, which nobody sees, and behind surfaces
that are open on both sides. Bilinear fetches of points in front read the first."""


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


def without_buried(work: TransferWork, atlas: Atlas, traced: TracedTransfer) -> TracedTransfer:
    """Return what was traced, with that of slots nearby in place of that of slots inside objects or behind surfaces.

    A floor's texels below a box are black, and bilinear fetches beside the box read them. The texels of a post below
    a floor see the sky from there, which nobody above does. Rays of both meet backs, and a surface parts both from
    their neighbours outside: no surface parts the floor below a sheet of cloth from the floor beside it, so that stays
    as it is. Hits of slots that were replaced count as hits of those that stand in for them.
    """
    if atlas.corners.shape[0] == 0 or traced.hits.shape[1] == 0:
        return traced
    inside, backs = back_shares(atlas, traced.hits)
    stands_in = _stand_ins(atlas, inside > BEHIND, backs <= CLEAR, REACH_INSIDE)
    behind = (backs > BEHIND) & (inside <= BEHIND)
    stands_in = np.where(behind, _stand_ins(atlas, behind, backs <= CLEAR, REACH_BEHIND), stands_in)
    replaced = np.flatnonzero(stands_in != np.arange(atlas.count)).astype(np.int32)
    whole = replaced[~_are_parted(work, replaced, stands_in[replaced])]
    stands_in[whole] = whole
    if len(whole) == len(replaced):
        return traced
    hits = traced.hits[stands_in]
    hits = np.where(hits >= 0, stands_in[np.maximum(hits, 0)], hits)
    return replace(traced, transfer=traced.transfer[stands_in], hits=hits)


def back_shares(atlas: Atlas, hits: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the shares of each slot's rays that meet what keeps nothing, and that or a back, float32 [slots] each.

    The backs of closed objects keep nothing.
    """
    inside, backs = (np.zeros(len(hits), np.int32) for _ in range(2))
    for ray in range(hits.shape[1]):
        hit = hits[:, ray]
        inside += hit == BLACK
        backs += (hit >= 0) & (atlas.slot_sides[np.maximum(hit, 0)] == 1)
    rays = np.float32(max(hits.shape[1], 1))
    return inside / rays, (inside + backs) / rays


def _are_parted(work: TransferWork, ones: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return whether a surface lies between the slots of each pair, bool [pairs]."""
    parted = wp.zeros(len(ones), dtype=wp.uint8, device=work.device)
    pairs = [launch.on_device(slots, wp.int32, work.device) for slots in (ones, others)]
    launch.launch(part_slots, len(ones), [work.data, work.slots, *pairs, parted], work.device)
    return np.asarray(parted.numpy() > 0)


def _stand_ins(atlas: Atlas, wanted: np.ndarray, offered: np.ndarray, reach: int) -> np.ndarray:
    """Return for each slot itself or, if it is ``wanted``, the nearest of its chart that is ``offered``, int32 [slots].

    A slot that is wanted and finds none within ``reach`` texels stays itself.
    """
    result = np.where(offered, np.arange(atlas.count), -1).astype(np.int32)
    result[wanted] = -1
    charts = atlas.charts[atlas.slot_faces]
    steps = sorted(((i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j), key=lambda step: abs(step[0] * step[1]))
    for start, width, height in atlas.pages.tolist():
        for side in range(2):
            grid = np.full((height + 2, width + 2), -1, np.int32)
            grid[1:-1, 1:-1] = atlas.slots[side, start : start + width * height].reshape(height, width)
            rows, columns = np.nonzero((grid >= 0) & wanted[np.maximum(grid, 0)])
            slots = grid[rows, columns]
            for _ in range(reach):
                found = np.full(len(slots), -1, np.int32)
                for i, j in steps:
                    near = grid[rows + i, columns + j]
                    fits = (near >= 0) & (charts[np.maximum(near, 0)] == charts[slots])
                    other = np.where(fits, result[np.maximum(near, 0)], -1)
                    found = np.where(found < 0, other, found)
                open_ones = result[slots] < 0
                result[slots[open_ones]] = found[open_ones]
    return np.where(result < 0, np.arange(atlas.count, dtype=np.int32), result)
