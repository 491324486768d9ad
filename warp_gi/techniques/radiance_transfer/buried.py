"""Slots inside objects and behind surfaces that cut theirs get what was traced at slots nearby."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from warp_gi.kernels.transfer_bake import BLACK
from warp_gi.techniques.radiance_transfer.rays import TracedTransfer, TransferWork
from warp_gi.techniques.shared.atlas.atlas import Atlas
from warp_gi.techniques.shared.atlas.buried import stand_ins


def without_buried(work: TransferWork, atlas: Atlas, traced: TracedTransfer) -> TracedTransfer:
    """Return what was traced, with that of slots nearby in place of that of slots inside objects or behind surfaces.

    ``stand_ins`` says which. Hits of slots that were replaced count as hits of those that stand in for them.
    """
    if atlas.corners.shape[0] == 0 or traced.hits.shape[1] == 0:
        return traced
    inside, backs = back_shares(atlas, traced.hits)
    stands_in = stand_ins(work.data, atlas, work.slots, inside, backs, work.device)
    if (stands_in == np.arange(atlas.count)).all():
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
