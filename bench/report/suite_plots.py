"""Which plots a report draws of a suite's rows: the ``PLOTS`` of ``plots.py`` in the suite's folder."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from warp_gi.bench.harness import catalogue
from warp_gi.bench.harness.columns import Columns
from warp_gi.bench.harness.records import Row
from warp_gi.bench.report.plots import Plot

FRAME = "frame"


@dataclass(frozen=True)
class Choice:
    """Which rows and columns make a plot."""

    table: str
    title: str
    x: str
    """A column; FRAME if y holds a value for each frame, as words."""
    y: tuple[str, ...]
    by: tuple[str, ...] = ()
    """Columns that tell one line from another."""
    log_x: bool = False
    log_y: bool = False
    fit: bool = False
    only: Mapping[str, Any] = field(default_factory=dict)
    """Values that rows must have."""

    @property
    def names(self) -> list[str]:
        """The columns that it refers to."""
        return [name for name in (self.x, *self.y, *self.by, *self.only) if name != FRAME]


def power_law(table: str, title: str, x: str, y: tuple[str, ...], by: tuple[str, ...] = ()) -> Choice:
    """Return a plot with logarithmic axes and the exponent of each line."""
    return Choice(table, title, x, y, by, log_x=True, log_y=True, fit=True)


def choices(columns: Columns, *chosen: Choice) -> tuple[Choice, ...]:
    """Return the plots of a suite; raises OptionError for a column that the suite does not declare."""
    for choice in chosen:
        columns.require(choice.names, f"plot {choice.title!r}")
    return chosen


def plots_of(suite: str, rows: Iterable[Row]) -> list[Plot]:
    """Return the plots that a suite's rows allow: those of its ``PLOTS`` with lines of two points or more."""
    rows, module = list(rows), catalogue.module(suite, "plots")
    plots = [_plot(suite, choice, rows) for choice in (module.PLOTS if module is not None else ())]
    return [plot for plot in plots if plot.series]


def _plot(suite: str, choice: Choice, rows: list[Row]) -> Plot:
    lines: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        if row.get("table", "") != choice.table or any(row.get(key) != value for key, value in choice.only.items()):
            continue
        for column in choice.y:
            column = _of_the_device(column, row)
            if column in row:
                lines.setdefault(_line_name(choice, row, column), []).extend(_points(choice, row, column))
    series = {
        name: (tuple(x for x, _ in sorted(points)), tuple(y for _, y in sorted(points)))
        for name, points in lines.items()
        if len(points) > 1
    }
    y_label = ", ".join(choice.y) if choice.x != FRAME else "MSE / settled MSE"
    return Plot(choice.title, choice.x, y_label, series, choice.log_x, choice.log_y, choice.fit, suite)


def _of_the_device(column: str, row: Row) -> str:
    """Return the column of a CUDA device's own seconds in place of the CPU's, if the row has one."""
    on_device = column.replace("cpu", "device")
    return on_device if on_device in row else column


def _line_name(choice: Choice, row: Row, column: str) -> str:
    said = [value if isinstance(value := row.get(key, ""), str) else f"{key} {value:g}" for key in choice.by]
    return ", ".join([*said, column] if len(choice.y) > 1 or not said else said)


def _points(choice: Choice, row: Row, column: str) -> list[tuple[float, float]]:
    if choice.x == FRAME:
        return [(float(frame), float(value)) for frame, value in enumerate(str(row[column]).split())]
    return [(float(row[choice.x]), float(row[column]))] if choice.x in row else []
