"""Alias tables for discrete distributions, built without a loop; sampled by ``warp_gi.kernels.alias``."""

from __future__ import annotations

from collections.abc import Iterator
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
    def build(weights: np.ndarray, overwrite: bool = False) -> AliasTable:
        """Return the table that selects item k with probability ``weights[k] / sum(weights)``.

        ``weights`` is [n], finite and not negative; if all are zero, items are equally likely. With ``overwrite`` a
        float64 array of them may be written to, which takes less memory: of n items 40 n bytes at most.
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
        scaled = np.multiply(weights, n / total, out=weights if overwrite else None)
        del weights
        keep = np.ones(n, np.float32)
        index = np.arange(n, dtype=np.int32)
        is_small = scaled < 1
        small, large = index[is_small], index[~is_small]
        if len(small) and len(large):
            taken_before = np.zeros(len(small) + 1)  # by all small ones before; the last is what all of them lack
            spare = np.zeros(len(large))
            for some in _parts(len(small)):
                keep[small[some]] = scaled[small[some]]
                lacking = 1 - scaled[small[some]]
                lacking[0] += taken_before[some.start]
                np.cumsum(lacking, out=taken_before[some.start + 1 : some.stop + 1])
            for some in _parts(len(large)):
                spare[some] = scaled[large[some]] - 1
                spare[some.start] += spare[some.start - 1] if some.start else 0
                np.cumsum(spare[some], out=spare[some])
            del scaled
            before, last = taken_before[:-1], len(large) - 1
            for some in _parts(len(small)):
                index[small[some]] = large[np.minimum(np.searchsorted(spare, before[some], side="right"), last)]
            # A large bucket that gave more than it had to spare is itself filled by the next large one.
            for some in _parts(last):
                taken = taken_before[np.maximum(np.searchsorted(before, spare[some], side="left"), 1)]
                keep[large[some]] = np.clip(1 + spare[some] - taken, 0, 1)
            index[large[:-1]] = large[1:]
            del taken_before, before, spare
        del small, large, is_small
        share = np.zeros(n)
        for some in _parts(n):  # in the order of the buckets, as one pass would add them
            np.add.at(share, index[some], 1 - keep[some].astype(np.float64))
        share += keep
        share /= n
        return AliasTable(keep, index, share.astype(np.float32))


def _parts(count: int) -> Iterator[slice]:
    """Yield slices of ``count`` items, in order, of at most 2^20 each."""
    for start in range(0, count, 1 << 20):
        yield slice(start, min(start + (1 << 20), count))
