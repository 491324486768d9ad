"""Alias tables for discrete distributions, built without a loop; sampled by ``warp_gi.kernels.alias``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_gi.kernels import types
from warp_gi.launch import on_device


@dataclass(frozen=True, eq=False)
class AliasTable:
    """A table of n buckets; bucket k yields item k with ``probability[k]`` and item ``index[k]`` otherwise."""

    probability: np.ndarray
    """Probability that a bucket yields its own item, float32 [n]."""
    index: np.ndarray
    """Item that a bucket yields otherwise, int32 [n]."""
    pdf: np.ndarray
    """Probability of each item as the table really samples it, float32 [n]; sums to 1."""

    def buckets(self) -> np.ndarray:
        """Return the buckets that kernels read, types.AliasBucket [n]."""
        buckets = np.empty(len(self.pdf), types.AliasBucket.numpy_dtype())
        buckets["probability"], buckets["index"] = self.probability, self.index
        buckets["pdf"], buckets["index_pdf"] = self.pdf, self.pdf[self.index]
        return buckets

    def on(self, device: wp.Device) -> wp.array:
        """Return the buckets that kernels read, [n] of types.AliasBucket, on a device."""
        return on_device(self.buckets(), types.AliasBucket, device)

    @staticmethod
    def build(weights: np.ndarray) -> AliasTable:
        """Return the table that selects item k with probability ``weights[k] / sum(weights)``.

        ``weights`` is [n], finite and not negative; if all are zero, items are equally likely.
        Raises ValueError for an empty table or other weights.

        Buckets below the mean ("small") are filled up, in order, from those above it ("large"), in order;
        prefix sums of what the small lack and of what the large have to spare tell who fills whom
        (the sequential sweep of Hübschle-Schneider and Sanders, "Parallel Weighted Random Sampling", 2022).
        """
        weights = np.asarray(weights, np.float64).ravel()
        total = weights.sum()
        if weights.size == 0 or not np.isfinite(total) or weights.min() < 0:
            raise ValueError("alias table weights must be finite, not negative, and at least one")
        n = weights.size
        if total == 0:
            weights, total = np.ones(n), float(n)
        scaled = weights * (n / total)
        keep = np.ones(n)
        index = np.arange(n, dtype=np.int32)
        small = np.flatnonzero(scaled < 1)
        large = np.flatnonzero(scaled >= 1)
        if len(small) and len(large):
            lacking = np.cumsum(1 - scaled[small])
            spare = np.cumsum(scaled[large] - 1)
            before = np.concatenate([[0.0], lacking[:-1]])
            giver = np.searchsorted(spare, before, side="right")
            keep[small] = scaled[small]
            index[small] = large[np.minimum(giver, len(large) - 1)]
            # A large bucket that gave more than it had to spare is itself filled by the next large one.
            taken = lacking[np.maximum(np.searchsorted(before, spare, side="left") - 1, 0)]
            keep[large[:-1]] = np.clip(1 + spare[:-1] - taken[:-1], 0, 1)
            index[large[:-1]] = large[1:]
        keep = keep.astype(np.float32)
        share = keep.astype(np.float64)
        pdf = (share + np.bincount(index, 1 - share, minlength=n)) / n
        return AliasTable(keep, index, pdf.astype(np.float32))
