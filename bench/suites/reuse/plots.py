"""Plots of the suite ``reuse``."""

from warp_gi.bench.report.suite_plots import FRAME, Choice, choices
from warp_gi.bench.suites.reuse.columns import COLUMNS

_SERIES = ("MSE / settled by frame",)

PLOTS = choices(
    COLUMNS,
    Choice("adaptation", "Error over frames after a start", FRAME, _SERIES, ("case", "term"), log_y=True),
    Choice(
        "turning",
        "Error over frames after a turn of the light, 128 bits",
        FRAME,
        _SERIES,
        ("degrees", "migrations"),
        log_y=True,
        only={"bits": 128},
    ),
    Choice("strobe", "Error over frames of a strobe", FRAME, _SERIES, ("case", "combination"), log_y=True),
)
