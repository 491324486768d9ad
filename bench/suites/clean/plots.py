"""Plots of the suite ``clean``."""

from warp_gi.bench.report.suite_plots import Choice, choices
from warp_gi.bench.suites.clean.cases import BUILT_IN, FROM_FILES, IN_LARGE, MOVING
from warp_gi.bench.suites.clean.columns import COLUMNS
from warp_gi.bench.suites.clean.peers import CASES, TABLE
from warp_gi.bench.suites.clean.sequences import SEQUENCES
from warp_gi.bench.suites.clean.switched import TABLE as SWITCHED

_TIME = "us a pixel"


def _over_time(table: str, case: str, error: str, title: str) -> Choice:
    """Return a plot with a line for each renderer, whose points are its settings."""
    return Choice(table, f"{title}, {case}", _TIME, (error,), ("family",), True, True, only={"case": case})


PLOTS = choices(
    COLUMNS,
    *(
        _over_time(SEQUENCES, case.name, "FLIP", "FLIP over CPU time")
        for case in (*BUILT_IN, *FROM_FILES, *MOVING, *IN_LARGE)
    ),
    *(_over_time(SEQUENCES, case.name, "flicker", "Flicker over CPU time") for case in (BUILT_IN[0], FROM_FILES[0])),
    *(_over_time(TABLE, one.sequence.name, "FLIP", "FLIP over CPU time, all renderers") for one in CASES),
    Choice(SWITCHED, "Old light left after a switch", "frames later", ("old light left",), ("case", "renderer")),
)
