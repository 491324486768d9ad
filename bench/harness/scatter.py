"""Errors of unbiased renderers, by the scatter of their pictures: a reference would have noise of its own."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from warp_gi import metrics
from warp_gi.bench.harness.measure import Row
from warp_gi.metrics import RELATIVE_EPSILON

MIDDLE_HALF = 0.6745
"""Half of a normal distribution lies within so many standard deviations; spreads are told so."""
Pictures = Mapping[str, Sequence[np.ndarray]]
"""Two or more pictures with independent noise, float [height, width, 3], by renderer."""


def mean_of(pictures: Pictures) -> np.ndarray:
    """Return the mean of all pictures of all renderers, float64."""
    every = np.stack([picture for group in pictures.values() for picture in group])
    return np.asarray(every.mean(axis=0, dtype=np.float64))


def errors(pictures: Pictures, name: str, true: np.ndarray | None = None) -> Row:
    """Return RMSE, relMSE and FLIP of one picture by a renderer, and how many pixels are NaN or infinite in any.

    RMSE and relMSE are of the variance over its own pictures, which is its error as it has no bias; those pixels make
    them NaN. relMSE is over ``true`` squared, float [height, width, 3], or over the mean of all. FLIP is the first
    picture's, against the mean of all others.
    """
    own, count = np.asarray(pictures[name], np.float64), sum(len(group) for group in pictures.values())
    with np.errstate(invalid="ignore"):  # pixels that are bad make it NaN
        mean, variance = mean_of(pictures), np.var(own, axis=0, ddof=1)
        others = (mean * count - own[0]) / (count - 1)
    bad = ~np.isfinite(own).all(axis=(0, 3))
    flip = metrics.flip(own[0], others) if np.isfinite(own[0]).all() and np.isfinite(others).all() else float("nan")
    relmse = relative(variance, mean if true is None else true)
    row: Row = {"RMSE": float(np.sqrt(variance.mean())), "relMSE": relmse, "FLIP": flip}
    return row | {"bad pixels": int(np.count_nonzero(bad))}


def relative(variance: np.ndarray, mean: np.ndarray) -> float:
    """Return the mean of squared errors over the squared mean."""
    return float(np.mean(variance / (mean**2 + RELATIVE_EPSILON)))


def error_ratio(pictures: Pictures, above: str, below: str, true: np.ndarray | None = None) -> Row:
    """Return one renderer's relMSE over another's, with its spread: what half of all such runs would keep within.

    The spread is the standard error by the jackknife over repetitions; None where there are two alone.
    """
    mean = mean_of(pictures) if true is None else true
    kept = {name: np.asarray(pictures[name], np.float64) for name in (above, below)}
    count = min(len(group) for group in kept.values())

    def ratio(leave_out: int | None = None) -> float:
        groups = kept if leave_out is None else {name: np.delete(p, leave_out, axis=0) for name, p in kept.items()}
        found = [relative(np.var(groups[name], axis=0, ddof=1), mean) for name in (above, below)]
        return found[0] / found[1]

    row: Row = {"error ratio": ratio()}
    if count < 3:
        return row
    others = np.array([ratio(index) for index in range(count)])
    deviation = np.sqrt((count - 1) / count * np.sum((others - others.mean()) ** 2))
    return row | {"error ratio spread": float(MIDDLE_HALF * deviation)}
