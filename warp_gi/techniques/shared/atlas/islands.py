"""Which faces hang together."""

from __future__ import annotations

import numpy as np


def equal_rows(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the different ones among ``rows`` [n, m], and of each row which of those it is, int64 [n]."""
    order = np.lexsort(rows.T[::-1])
    ranked = rows[order]
    is_new = np.append(np.ones(min(len(rows), 1), bool), (ranked[1:] != ranked[:-1]).any(axis=1))
    numbers = np.empty(len(rows), np.int64)
    numbers[order] = np.cumsum(is_new) - 1
    return ranked[is_new], numbers


def islands(corners: np.ndarray) -> np.ndarray:
    """Return the island of each face, int32 [face]: faces hang together where a corner of theirs is equal.

    ``corners`` [face, 3, n] are coordinates of any kind, which decide together.
    """
    places = equal_rows(corners.reshape(3 * len(corners), corners.shape[2]))[1].reshape(-1, 3)
    labels = np.arange(places.max(initial=-1) + 1)  # of places: a lower one in the same island
    while True:
        lowest = np.repeat(labels[places].min(axis=1), 3)
        after = labels.copy()
        np.minimum.at(after, labels[places].reshape(-1), lowest)
        after = after[after]
        if np.array_equal(after, labels):
            return np.unique(labels[places[:, 0]], return_inverse=True)[1].astype(np.int32)
        labels = after
