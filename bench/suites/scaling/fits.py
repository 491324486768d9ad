"""How a measurement grows with a size: the exponent of a power law, and what ten times the size costs at worst."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warp_gi.bench.harness.measure import Row, Series, median_and_spread
from warp_gi.bench.report.plots import exponent

SAME_SIZE = 1.05
"""Factor by which ten times a size may exceed the largest size, as generated sizes are not quite those asked for."""


@dataclass(frozen=True)
class Growth:
    """Exponents and costs of ten times the size, turn by turn, as what slows the machine for a while slows all."""

    exponents: list[float]
    ratios: dict[float, list[float]]
    """Cost of ten times a size over that of the size, by turn, for sizes up to a tenth of the largest."""

    @staticmethod
    def of(sizes: Sequence[float], turns: Sequence[Series]) -> Growth:
        """Return the growth of values measured at two or more rising sizes, in one turn or several.

        Where sizes have had different numbers of turns, that of their medians.
        """
        if len({len(values) for values in turns}) > 1:
            turns = [[np.median(values)] for values in turns]
        x, y = np.log(sizes), np.log(np.array(turns, np.float64))
        ratios = {}
        for i, size in enumerate(sizes):
            if 10 * size <= SAME_SIZE * max(sizes):
                steps = [np.interp(np.log(10 * size), x, turn) - turn[i] for turn in y.T]
                ratios[size] = np.exp(steps).tolist()
        return Growth([exponent(sizes, turn) or 0.0 for turn in np.exp(y).T], ratios)

    def ratio(self, start: float) -> float:
        """Return the median cost of ten times the size ``start``, over that of ``start``."""
        return float(np.median(self.ratios[start]))

    @property
    def worst(self) -> float | None:
        """Size whose tenfold costs most; None if no size is ten times another."""
        return max(self.ratios, key=self.ratio, default=None)

    def row(self, target: float | str = "") -> Row:
        """Return exponent and worst ratio for ten times the size, with spreads if there were several turns."""
        row = _named("exponent", self.exponents)
        if self.worst is not None:
            row |= _named("growth for ten times", self.ratios[self.worst])
            row |= {"target": target, "says": f"worst from {words(self.worst)} to {words(10 * self.worst)}"}
        return row


def words(size: float) -> str:
    """Return a size with K or M for thousands and millions."""
    for unit, name in ((1e6, " M"), (1e3, " K")):
        if size >= 0.9995 * unit:
            return f"{size / unit:.3g}{name}"
    return f"{size:.3g}"


def _named(name: str, values: Sequence[float]) -> Row:
    return median_and_spread(name, values) if len(values) > 1 else {name: float(values[0])}
