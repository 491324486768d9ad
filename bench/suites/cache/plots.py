"""Plots of the suite ``cache``."""

from warp_gi.bench.report.suite_plots import Choice, choices
from warp_gi.bench.suites.cache.columns import COLUMNS
from warp_gi.bench.suites.cache.fills import BY_PATHS

PLOTS = choices(
    COLUMNS,
    Choice(BY_PATHS, "Error of 64 samples over paths of the fill", "paths", ("RMSE / mean",), ("case",), True, True),
    Choice(
        BY_PATHS, "Error that samples do not remove, over paths of the fill", "paths", ("floor",), ("case",), True, True
    ),
)
