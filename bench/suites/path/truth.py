"""What pictures are against a reference of two independent halves: whether renderers go to the same picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from warp_gi.bench.compare.reference import Reference
from warp_gi.bench.harness import scatter
from warp_gi.bench.harness.measure import Row

Pictures = Mapping[str, Sequence[np.ndarray]]


def best(reference: Reference, reference_spp: int, pictures: Pictures, spp: int) -> np.ndarray:
    """Return the mean of the reference and all pictures by their samples, float64 [height, width, 3].

    It is what relative errors are over. With few samples in it a renderer's fireflies would be divided by themselves,
    and pixels that have had none yet would make the others' errors look large.
    """
    samples = spp * sum(len(group) for group in pictures.values())
    total = reference.picture * reference_spp + scatter.mean_of(pictures) * samples
    return np.asarray(total / (reference_spp + samples))


def rows_of(case: str, reference: Reference, reference_spp: int, pictures: Pictures, true: np.ndarray) -> list[Row]:
    """Return a row of each renderer against the reference, and the reference's own noise.

    relMSE is over ``true`` squared, the mean over a renderer's pictures. The reference's noise is not in it: each
    picture's error against one half is multiplied with that against the other. The standard error is that of "means
    differ".
    """
    first, second = reference.halves
    noise = scatter.relative((first - second) ** 2 / 4, true)
    rows: list[Row] = []
    for name, group in pictures.items():
        found = np.asarray(group, np.float64)
        means, mean = found.mean(axis=(1, 2, 3)), float(reference.picture.mean())
        variance = means.var(ddof=1) / len(means) + (first.mean() - second.mean()) ** 2 / 4
        rows.append(
            {
                "table": "beside the reference",
                "case": case,
                "renderer": name,
                "reference spp": reference_spp,
                "noise relMSE": noise,
                "relMSE": scatter.relative((found - first) * (found - second), true),
                "means differ": float(means.mean()) / mean - 1,
                "standard error": float(variance**0.5) / mean,
            }
        )
    return rows
