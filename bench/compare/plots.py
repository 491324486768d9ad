"""Plots of the rows of ``warp-gi bench compare``."""

from warp_gi.bench.compare.columns import COLUMNS
from warp_gi.bench.report.suite_plots import Choice, choices

_TABLE = "error over time"

PLOTS = choices(
    COLUMNS,
    Choice(_TABLE, "Error over render time", "render s", ("RMSE",), ("pipeline",), log_x=True, log_y=True),
    Choice(_TABLE, "Error over frames", "frames", ("RMSE",), ("pipeline",), log_x=True, log_y=True),
)
