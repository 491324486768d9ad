"""Plots as inline SVG, for reports: axes, lines with markers, tooltips; colours are left to the page's style.

Series differ in colour, dash and marker. ``report.css`` has the colours, for light and dark pages.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape

import numpy as np

from warp_gi.errors import OptionError

WIDTH, HEIGHT = 520, 340
LEFT, RIGHT, TOP, BOTTOM = 66, 14, 12, 50
"""Margins of the axes."""
STYLES = 8
LOG_STEPS = ((1,), (1, 2, 5), (1, 2, 3, 5, 7), (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 9))
"""Numbers to label in each decade, from few to many."""
DASHES = ("", "7 4", "2 3", "9 3 2 3")
MARKERS = (
    "M-4 0a4 4 0 1 0 8 0a4 4 0 1 0 -8 0z",
    "M-3.6 -3.6h7.2v7.2h-7.2z",
    "M0 -5l4.6 8.4h-9.2z",
    "M0 -5l5 5l-5 5l-5 -5z",
    "M0 5l4.6 -8.4h-9.2z",
)


@dataclass(frozen=True)
class Plot:
    """Lines over one axis. ``validate`` raises OptionError for what cannot be drawn."""

    title: str
    x_label: str
    y_label: str
    series: Mapping[str, tuple[Sequence[float], Sequence[float]]] = field(default_factory=dict)
    """x and y of each line, of equal length, in the order in which they are joined."""
    log_x: bool = False
    log_y: bool = False
    fit: bool = False
    """Fit y = a x^k to each series, draw it dotted and tell k; needs both axes logarithmic."""
    suite: str = ""
    """The suite in whose section of the report it stands."""

    def validate(self) -> None:
        """Raise OptionError unless x and y of each series have the same length, and axes are logarithmic for a fit."""
        for name, (x, y) in self.series.items():
            if len(x) != len(y):
                raise OptionError(f"plot {self.title!r}, {name!r}: {len(x)} x but {len(y)} y; give as many of each")
        if self.fit and not (self.log_x and self.log_y):
            raise OptionError(f"plot {self.title!r}: a power law needs log_x and log_y")


@dataclass(frozen=True)
class Axis:
    """One axis: values low to high are shown at pixels first to last."""

    low: float
    high: float
    first: float
    last: float
    log: bool

    def place(self, value: float) -> float:
        """Return the pixel of a value."""
        a, b, v = (math.log10(x) if self.log else x for x in (self.low, self.high, value))
        return self.first + (v - a) / (b - a) * (self.last - self.first)

    def ticks(self) -> list[float]:
        """Return values to label, about four to nine."""
        if not self.log:
            step = _round_step((self.high - self.low) / 7)
            first = math.ceil(self.low / step - 1e-9)
            return [i * step for i in range(first, math.floor(self.high / step + 1e-9) + 1)]
        decades = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
        found: list[float] = []
        for steps in LOG_STEPS:
            values = [m * 10.0**k for k in decades for m in steps]
            found = [v for v in values if self.low * (1 - 1e-9) <= v <= self.high * (1 + 1e-9)]
            if len(found) >= 4:
                break
        return found[:: math.ceil(len(found) / 9)]


def svg(plot: Plot) -> str:
    """Return the plot as an HTML figure with legend and caption; raises OptionError as ``Plot.validate``."""
    plot.validate()
    lines = {name: _drawable(plot, x, y) for name, (x, y) in plot.series.items()}
    missing = sum(len(plot.series[name][0]) - len(points) for name, points in lines.items())
    points = np.concatenate([np.empty((0, 2)), *lines.values()])
    parts, legend = [], []
    if len(points):
        x_axis = _axis(points[:, 0], LEFT + 8, WIDTH - RIGHT - 8, plot.log_x)
        y_axis = _axis(points[:, 1], HEIGHT - BOTTOM - 6, TOP + 6, plot.log_y)
        parts += _grid(x_axis, y_axis)
        for index, (name, line) in enumerate(lines.items()):
            power = exponent(*line.T) if plot.fit else None
            parts += _line(index, name, line, x_axis, y_axis, plot)
            if power is not None:
                parts.append(_fit_line(index, line, power, x_axis, y_axis))
            legend.append(_legend_entry(index, name, power))
    else:
        parts.append(f'<text class="none" x="{WIDTH / 2}" y="{HEIGHT / 2}">no points</text>')
    parts += _frame(plot)
    note = f'<p class="note">{missing} points are not shown: {_why_missing(plot)}.</p>' if missing else ""
    return (
        f'<figure class="plot"><figcaption>{escape(plot.title)}</figcaption>'
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{escape(plot.title)}">{"".join(parts)}</svg>'
        f'<ul class="legend">{"".join(legend)}</ul>{note}</figure>'
    )


def _why_missing(plot: Plot) -> str:
    return "not finite" + (", or not above 0 on a logarithmic axis" if plot.log_x or plot.log_y else "")


def _drawable(plot: Plot, x: Sequence[float], y: Sequence[float]) -> np.ndarray:
    points = np.array([x, y], np.float64).T.reshape(-1, 2)
    good = np.isfinite(points).all(axis=1)
    for column, log in enumerate((plot.log_x, plot.log_y)):
        good &= (points[:, column] > 0) if log else True
    return points[good]


def _axis(values: np.ndarray, first: float, last: float, log: bool) -> Axis:
    low, high = float(values.min()), float(values.max())
    if log:
        if high / low < 1.5:
            low, high = low / 1.5, high * 1.5
    elif low == high:
        low, high = low - (abs(low) or 1.0) * 0.5, high + (abs(high) or 1.0) * 0.5
    elif low > 0 and low < 0.6 * high:
        low = 0.0
    return Axis(low, high, first, last, log)


def _round_step(step: float) -> float:
    power = 10.0 ** math.floor(math.log10(step))
    return next(m * power for m in (1, 2, 2.5, 5, 10) if m * power >= step * (1 - 1e-9))


def exponent(x: Sequence[float], y: Sequence[float]) -> float | None:
    """Return k of the power law through the points by least squares of logarithms; None for fewer than two x."""
    if len(np.unique(x)) < 2:
        return None
    return float(np.polyfit(np.log(x), np.log(y), 1)[0])


def _fit_line(index: int, line: np.ndarray, power: float, x_axis: Axis, y_axis: Axis) -> str:
    x = np.array([line[:, 0].min(), line[:, 0].max()])
    middle_x, middle_y = np.exp(np.log(line).mean(axis=0))
    y = middle_y * (x / middle_x) ** power
    (ax, bx), (ay, by) = map(x_axis.place, x), map(y_axis.place, y)
    return f'<line class="fit s{index % STYLES}" x1="{ax:.1f}" y1="{ay:.1f}" x2="{bx:.1f}" y2="{by:.1f}"/>'


def _line(index: int, name: str, line: np.ndarray, x_axis: Axis, y_axis: Axis, plot: Plot) -> list[str]:
    style, dash = f"s{index % STYLES}", DASHES[index % len(DASHES)]
    places = [(x_axis.place(x), y_axis.place(y)) for x, y in line]
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    parts = [f'<polyline class="line {style}" stroke-dasharray="{dash}" points="{path}"/>']
    for (x, y), (px, py) in zip(line, places, strict=True):
        tip = f"{name}\n{plot.x_label}: {_number(x)}\n{plot.y_label}: {_number(y)}"
        marker = MARKERS[index % len(MARKERS)]
        parts.append(
            f'<path class="mark {style}" d="{marker}" transform="translate({px:.1f} {py:.1f})">'
            f"<title>{escape(tip)}</title></path>"
        )
    return parts


def _legend_entry(index: int, name: str, power: float | None) -> str:
    style, dash, marker = f"s{index % STYLES}", DASHES[index % len(DASHES)], MARKERS[index % len(MARKERS)]
    fitted = "" if power is None else f' <span class="exponent">∝ x<sup>{power:.2f}</sup></span>'
    return (
        f'<li><svg viewBox="0 0 36 12" width="36" height="12" aria-hidden="true">'
        f'<polyline class="line {style}" stroke-dasharray="{dash}" points="1,6 35,6"/>'
        f'<path class="mark {style}" d="{marker}" transform="translate(18 6)"/></svg>{escape(name)}{fitted}</li>'
    )


def _grid(x_axis: Axis, y_axis: Axis) -> list[str]:
    parts = []
    for value in x_axis.ticks():
        x = x_axis.place(value)
        parts.append(f'<line class="grid" x1="{x:.1f}" y1="{TOP}" x2="{x:.1f}" y2="{HEIGHT - BOTTOM}"/>')
        parts.append(f'<text class="x tick" x="{x:.1f}" y="{HEIGHT - BOTTOM + 18}">{_number(value)}</text>')
    for value in y_axis.ticks():
        y = y_axis.place(value)
        parts.append(f'<line class="grid" x1="{LEFT}" y1="{y:.1f}" x2="{WIDTH - RIGHT}" y2="{y:.1f}"/>')
        parts.append(f'<text class="y tick" x="{LEFT - 7}" y="{y + 4.5:.1f}">{_number(value)}</text>')
    return parts


def _frame(plot: Plot) -> list[str]:
    middle_x, middle_y = (LEFT + WIDTH - RIGHT) / 2, (TOP + HEIGHT - BOTTOM) / 2
    return [
        f'<path class="axes" d="M{LEFT} {TOP}V{HEIGHT - BOTTOM}H{WIDTH - RIGHT}"/>',
        f'<text class="label" x="{middle_x}" y="{HEIGHT - 8}">{escape(plot.x_label)}</text>',
        f'<text class="label" transform="translate(14 {middle_y}) rotate(-90)">{escape(plot.y_label)}</text>',
    ]


def _number(value: float) -> str:
    """Four digits, large and small values with an exponent: 2e6, not 2e+06."""
    text = f"{value:.4g}"
    mantissa, e, power = text.partition("e")
    return f"{mantissa}e{int(power)}" if e else text
