"""Slots in awkward places: on the very edge of a face, where rays slip past its neighbour, inside other objects, and
behind surfaces that cut theirs."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.kernels import types
from warp_gi.kernels.atlas_slots import AtlasSlots, SlotLooks, look_around, part_slots
from warp_gi.techniques.shared.atlas.atlas import Atlas

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


def stand_ins(
    data: types.SceneData,
    atlas: Atlas,
    slots: AtlasSlots,
    inside: np.ndarray,
    backs: np.ndarray,
    device: wp.Device,
    dark: np.ndarray | None = None,
) -> np.ndarray:
    """Return for each slot itself, or the slot nearby whose light stands in for its own, int32 [slots].

    A floor's texels below a box are black, and bilinear fetches beside the box read them. The texels of a post below
    a floor see the sky from there, which nobody above does. Rays of both meet backs, and a surface parts both from
    their neighbours outside: no surface parts the floor below a sheet of cloth from the floor beside it, so that stays
    as it is.

    Args:
        data: The scene; its rays meet what rests alone.
        atlas: Its atlas.
        slots: The slots of that.
        inside: Share of each slot's rays that meet what keeps nothing, float32 [slots]. The backs of closed objects do.
        backs: Share of those that meet that or a back, float32 [slots].
        device: Where kernels run.
        dark: Slots that get no light at all, bool [slots]: outside of a room there may be nothing to meet, and its
            floor's texels there are as those behind a surface. None is none.
    """
    dark = np.zeros(atlas.count, bool) if dark is None else dark
    offered = (backs <= CLEAR) & ~dark
    result = _nearest_offered(atlas, inside > BEHIND, offered, REACH_INSIDE)
    behind = (backs > BEHIND) & (inside <= BEHIND)
    result = np.where(behind, _nearest_offered(atlas, behind, offered, REACH_BEHIND), result)
    alone = dark & (result == np.arange(atlas.count))
    result = np.where(alone, _nearest_offered(atlas, alone, ~dark, REACH_BEHIND), result)
    replaced = np.flatnonzero(result != np.arange(atlas.count)).astype(np.int32)
    whole = replaced[~_are_parted(data, slots, replaced, result[replaced], device)]
    result[whole] = whole
    return result


def looks_of_slots(
    data: types.SceneData, atlas: Atlas, slots: AtlasSlots, rays: int, device: wp.Device
) -> tuple[np.ndarray, np.ndarray]:
    """Return ``inside`` and ``backs`` of ``stand_ins`` by rays of each slot, in a scene in which all rests."""
    looks = SlotLooks()
    looks.rays = rays
    looks.inside, looks.backs = (wp.empty(atlas.count, dtype=wp.int32, device=device) for _ in range(2))
    launch.launch(look_around, atlas.count, [data, atlas.on(device), slots, looks], device)
    return tuple(counts.numpy() / np.float32(rays) for counts in (looks.inside, looks.backs))


def _are_parted(
    data: types.SceneData, slots: AtlasSlots, ones: np.ndarray, others: np.ndarray, device: wp.Device
) -> np.ndarray:
    """Return whether a surface lies between the slots of each pair, bool [pairs]."""
    parted = wp.zeros(len(ones), dtype=wp.uint8, device=device)
    pairs = [launch.on_device(numbers, wp.int32, device) for numbers in (ones, others)]
    launch.launch(part_slots, len(ones), [data, slots, *pairs, parted], device)
    return np.asarray(parted.numpy() > 0)


def _nearest_offered(atlas: Atlas, wanted: np.ndarray, offered: np.ndarray, reach: int) -> np.ndarray:
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
