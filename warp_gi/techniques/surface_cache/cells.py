"""Cells of a surface cache on the host: sums by key, the levels above, and the table that kernels read.

Sums are in float64 and in the order of the records, and a cell's slot follows from the set of keys alone. So nothing
depends on the number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.kernels.surface_cache import LEVELS, SurfaceCells

LEAST_SAMPLES = 4
"""Samples of a cell from which on it is read."""
LEAST_BITS = 8
"""Bits of the size of the smallest table."""
_PARENT = np.uint64(0x003FFFBFFFBFFF80)
"""Bits of the coordinates of a key that may be set one level higher."""
_KEPT = np.uint64(0xFF8000000000007F)
"""Bits of the grid's number, the side and the level."""


@dataclass(frozen=True, eq=False)
class Sums:
    """Sums of samples by cell, in the order of the keys."""

    keys: np.ndarray
    """uint64 [cell], ascending, none of them 0."""
    light: np.ndarray
    """Sums of irradiance, of exitance by the GGX lobe, W/m^2, and of the square of the irradiance's luminance, float64
    [cell, 7]."""
    counts: np.ndarray
    """Number of samples, int64 [cell]; or the sum of their weights, float64 [cell]."""

    @staticmethod
    def of(keys: np.ndarray, light: np.ndarray, counts: np.ndarray | None = None) -> Sums:
        """Return the sums of records with keys uint64 [record], light [record, 7] and counts, 1 unless given.

        Records with the key 0, and those that are not finite, are left out.
        """
        counts = np.ones(len(keys), np.int64) if counts is None else counts
        kept = np.flatnonzero((keys != 0) & np.isfinite(light).all(axis=1))
        order = kept[np.argsort(keys[kept], kind="stable")]
        ordered = keys[order]
        starts = np.flatnonzero(np.append(True, ordered[1:] != ordered[:-1])) if len(order) else order
        if not len(order):
            return Sums(ordered, np.zeros((0, 7)), np.zeros(0, np.int64))
        return Sums(
            ordered[starts],
            np.add.reduceat(light[order].astype(np.float64), starts, axis=0),
            np.add.reduceat(counts[order], starts),
        )

    def __add__(self, other: Sums) -> Sums:
        return Sums.all_of([self, other]) if len(self.keys) else other

    @staticmethod
    def all_of(several: Sequence[Sums]) -> Sums:
        """Return the sums of several; cells may be in more than one."""
        return Sums.of(
            np.concatenate([one.keys for one in several]),
            np.concatenate([one.light for one in several]),
            np.concatenate([one.counts for one in several]),
        )

    def without(self, other: Sums) -> Sums:
        """Return the sums of those of these cells that ``other`` has not."""
        kept = np.flatnonzero(~np.isin(self.keys, other.keys, assume_unique=True))
        return Sums(self.keys[kept], self.light[kept], self.counts[kept])

    def above(self, least: float) -> Sums:
        """Return the sums of the cells with at least so many samples."""
        kept = self.counts >= least
        return Sums(self.keys[kept], self.light[kept], self.counts[kept])

    def with_levels(self) -> Sums:
        """Return the sums of these cells, the smallest at each point, and of those of the levels above them."""
        levels = [self]
        for _ in range(int(LEVELS) - 1):
            below = levels[-1]
            levels.append(Sums.of(coarser(below.keys), below.light, below.counts))
        return Sums.all_of(levels)

    def most_sampled(self, capacity: int) -> tuple[Sums, int]:
        """Return the cells with enough samples, at most ``capacity``, and the number of those without a place."""
        kept = np.flatnonzero(self.counts >= LEAST_SAMPLES)
        over = max(len(kept) - capacity, 0)
        if over:
            kept = np.sort(kept[np.argsort(-self.counts[kept], kind="stable")[:capacity]])
        return Sums(self.keys[kept], self.light[kept], self.counts[kept]), over

    def means(self) -> np.ndarray:
        """Return what kernels read of cells, float32 [cell, 8]: irradiance, samples, exitance of the lobe, 0."""
        rows = np.zeros((len(self.keys), 8), np.float32)
        mean = self.light / self.counts[:, None]
        rows[:, :3], rows[:, 3], rows[:, 4:7] = mean[:, :3], self.counts, mean[:, 3:6]
        return rows


NOTHING = Sums.of(np.zeros(0, np.uint64), np.zeros((0, 7)))
"""No cell."""


def coarser(keys: np.ndarray) -> np.ndarray:
    """Return the keys of the cells of the next level around cells, uint64 [cell]; as ``coarser_key`` of kernels."""
    return ((keys >> np.uint64(1)) & _PARENT) + (keys & _KEPT) + np.uint64(1)


def first_slots(keys: np.ndarray, bits: int) -> np.ndarray:
    """Return the first slot in which each key may be, int64 [cell]; as ``first_slot`` of kernels."""
    k = keys * np.uint64(0x9E3779B97F4A7C15)
    k ^= k >> np.uint64(29)
    k *= np.uint64(0xBF58476D1CE4E5B9)
    return (k >> np.uint64(64 - bits)).astype(np.int64)


def hash_table(keys: np.ndarray) -> tuple[int, np.ndarray, int]:
    """Return bits, the slot of each key (int64 [cell]), and the number of slots, the last of which is empty.

    At most half of 2^bits slots are taken. Cells are put in the order of their first slots, each in the first free slot
    from there on: so all slots between its first one and its own are taken, as linear probing needs it.
    """
    bits = max(LEAST_BITS, math.ceil(math.log2(max(2 * len(keys), 1))))
    first = first_slots(keys, bits)
    order, number = np.argsort(first, kind="stable"), np.arange(len(keys))
    slots = np.empty(len(keys), np.int64)
    slots[order] = np.maximum.accumulate(first[order] - number) + number if len(keys) else 0
    return bits, slots, max(1 << bits, int(slots.max(initial=0)) + 1) + 1


def table_nbytes(keys: np.ndarray) -> int:
    """Return the size of the table of cells, in bytes: a key and 8 float32 a slot."""
    return hash_table(keys)[2] * (8 + 8 * 4)


def with_table(cells: SurfaceCells, keys: np.ndarray, rows: np.ndarray, device: wp.Device) -> SurfaceCells:
    """Return cells on a device whose table holds ``rows`` float32 [cell, 8] by their keys; the grid is as it was."""
    bits, slots, count = hash_table(keys)
    all_keys, values = np.zeros(count, np.uint64), np.zeros((count, 8), np.float32)
    all_keys[slots], values[slots] = keys, rows
    result = launch.copied(cells, SurfaceCells)
    result.bits = bits
    result.keys = launch.on_device(all_keys, wp.uint64, device)
    result.values = launch.on_device(values.reshape(-1, 4), wp.vec4, device)
    return result
