"""Which plots a report draws of a suite's rows: ``plots_of``. A new one is a line in ``PLOTS``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from warp_gi.bench.harness.records import Row
from warp_gi.bench.report.plots import Plot

FRAME = "frame"


@dataclass(frozen=True)
class Choice:
    """Which rows and columns make a plot."""

    suite: str
    table: str
    title: str
    x: str
    """A column; FRAME if y holds a value for each frame, as words."""
    y: tuple[str, ...]
    by: tuple[str, ...]
    """Columns that tell one line from another."""
    log_x: bool = False
    log_y: bool = False
    fit: bool = False
    only: Mapping[str, Any] = field(default_factory=dict)
    """Values that rows must have."""


_BY_FRAME = ("MSE / settled by frame",)


def _power_law(table: str, title: str, x: str, y: tuple[str, ...], by: tuple[str, ...] = ()) -> Choice:
    """Return a plot of the suite ``scaling``."""
    return Choice("scaling", table, title, x, y, by, log_x=True, log_y=True, fit=True)


SCALING = (
    _power_law("triangles: rays", "Time a ray over triangles", "triangles", ("ours ns a ray",), ("rays", "query")),
    _power_law("triangles: rays", "Embree's time a ray", "triangles", ("embree ns a ray",), ("rays", "query")),
    _power_law("triangles", "Building over triangles", "triangles", ("build cpu s", "embree build cpu s")),
    _power_law("triangles", "Bytes a triangle of the tree", "triangles", ("bytes a triangle",)),
    _power_law("triangles", "Memory that building takes at most", "triangles", ("build peak GB",)),
    _power_law("lights", "Seconds a frame over lights", "lights", ("frame cpu s",), ("estimator",)),
    _power_law("lights", "Preparation over lights", "lights", ("start s",), ("estimator",)),
    _power_law("pixels", "Seconds a frame over pixels", "Mpixels", ("frame cpu s",), ("pipeline",)),
    _power_law("pixels", "Peak memory over pixels", "Mpixels", ("peak GB",), ("pipeline",)),
    _power_law("bake samples", "Baking over surface samples", "samples", ("bake cpu s",)),
    _power_law("bake samples", "Error over surface samples", "samples", ("RMSE", "RMSE white")),
    _power_law("probes", "Baking over texels a side of a probe", "resolution", ("bake cpu s",)),
    _power_law("threads", "Speed-up over threads", "threads used", ("speed-up",), ("work",)),
)

PLOTS = (
    Choice("compare", "error over time", "Error over render time", "render s", ("RMSE",), ("pipeline",), True, True),
    Choice("compare", "error over time", "Error over frames", "frames", ("RMSE",), ("pipeline",), True, True),
    Choice(
        "compile",
        "modules",
        "Seconds to load a kernel module over its size",
        "object kB",
        ("cold s", "warm s"),
        (),
        True,
        True,
    ),
    Choice("sequence", "memory over frames", "Memory over frames", "frame number", ("MB",), ("pipeline",)),
    Choice(
        "rays", "rays", "Rays a second over triangles", "triangles", ("ours Mrays/s",), ("rays", "query"), True, True
    ),
    Choice(
        "rays",
        "builds",
        "Building over triangles",
        "triangles",
        ("ours build s", "embree build s"),
        (),
        True,
        True,
        True,
    ),
    *SCALING,
    Choice("dvf", "table 1", "Speed-up over samples a pixel", "spp", ("ratio cpu",), ("case",), True),
    Choice("dvf", "table 1", "Error over samples a pixel", "spp", ("RMSE",), ("case",), True, True, True),
    Choice("probes", "rays", "Rays that agree over texels a side", "resolution", ("agree",), ("case", "probes"), True),
    Choice(
        "probes",
        "denoise",
        "Error over rays a pixel, denoised",
        "rays a pixel",
        ("noisy RMSE", "ST RMSE"),
        ("case",),
        True,
        True,
        only={"pipeline": "paths"},
    ),
    Choice("reuse", "adaptation", "Error over frames after a start", FRAME, _BY_FRAME, ("case", "term"), log_y=True),
    Choice(
        "reuse",
        "turning",
        "Error over frames after a turn of the light, 128 bits",
        FRAME,
        _BY_FRAME,
        ("degrees", "migrations"),
        log_y=True,
        only={"bits": 128},
    ),
    Choice("reuse", "strobe", "Error over frames of a strobe", FRAME, _BY_FRAME, ("case", "combination"), log_y=True),
)


def plots_of(suite: str, rows: Iterable[Row]) -> list[Plot]:
    """Return the plots that a suite's rows allow: those of ``PLOTS`` with lines of two points or more."""
    rows = list(rows)
    plots = [_plot(choice, rows) for choice in PLOTS if choice.suite == suite]
    return [plot for plot in plots if plot.series]


def _plot(choice: Choice, rows: list[Row]) -> Plot:
    lines: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        if row.get("table", "") != choice.table or any(row.get(key) != value for key, value in choice.only.items()):
            continue
        for column in choice.y:
            column = _of_the_device(column, row)
            if column in row:
                lines.setdefault(_line_name(choice, row, column), []).extend(_points(choice, row, column))
    series = {name: tuple(zip(*sorted(points), strict=True)) for name, points in lines.items() if len(points) > 1}
    y_label = ", ".join(choice.y) if choice.x != FRAME else "MSE / settled MSE"
    return Plot(choice.title, choice.x, y_label, series, choice.log_x, choice.log_y, choice.fit, choice.suite)


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
