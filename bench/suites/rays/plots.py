"""Plots of the suite ``rays``."""

from warp_gi.bench.report.suite_plots import Choice, choices, power_law
from warp_gi.bench.suites.rays.columns import COLUMNS

PLOTS = choices(
    COLUMNS,
    Choice("rays", "Rays a second over triangles", "triangles", ("ours Mrays/s",), ("rays", "query"), True, True),
    power_law("builds", "Building over triangles", "triangles", ("ours build s", "embree build s")),
)
