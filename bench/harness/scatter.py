"""Errors of unbiased renderers, by the scatter of their pictures: a reference would have noise of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from warp_gi import metrics
from warp_gi.bench.harness.measure import Row
from warp_gi.metrics import RELATIVE_EPSILON

Pictures = Mapping[str, Sequence[np.ndarray]]
"""Two or more pictures with independent noise, float [height, width, 3], by renderer."""


def mean_of(pictures: Pictures) -> np.ndarray:
    """Return the mean of all pictures of all renderers, float64."""
    every = np.stack([picture for group in pictures.values() for picture in group])
    return np.asarray(every.mean(axis=0, dtype=np.float64))


def errors(pictures: Pictures, name: str) -> Row:
    """Return RMSE, relMSE and FLIP of one picture by a renderer, and how many pixels are NaN or infinite in any.

    RMSE and relMSE are of the variance over its own pictures, which is its error as it has no bias; those pixels make
    them NaN. FLIP is the first picture's, against the mean of all others of all renderers.
    """
    own, count = np.asarray(pictures[name], np.float64), sum(len(group) for group in pictures.values())
    with np.errstate(invalid="ignore"):  # pixels that are bad make it NaN
        mean, variance = mean_of(pictures), np.var(own, axis=0, ddof=1)
        others = (mean * count - own[0]) / (count - 1)
    bad = ~np.isfinite(own).all(axis=(0, 3))
    flip = metrics.flip(own[0], others) if np.isfinite(own[0]).all() and np.isfinite(others).all() else float("nan")
    row: Row = {"RMSE": float(np.sqrt(variance.mean())), "relMSE": relative(variance, mean), "FLIP": flip}
    return row | {"bad pixels": int(np.count_nonzero(bad))}


def relative(variance: np.ndarray, mean: np.ndarray) -> float:
    """Return the mean of squared errors over the squared mean."""
    return float(np.mean(variance / (mean**2 + RELATIVE_EPSILON)))
