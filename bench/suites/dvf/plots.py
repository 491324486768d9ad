"""Plots of the suite ``dvf``, and of what its fields add to the suite ``scaling``."""

from warp_gi.bench.report.suite_plots import Choice, choices, power_law
from warp_gi.bench.suites.dvf.columns import COLUMNS

PLOTS = choices(
    COLUMNS,
    Choice("table 1", "Speed-up over samples a pixel", "spp", ("ratio cpu",), ("case",), log_x=True),
    power_law("table 1", "Error over samples a pixel", "spp", ("RMSE",), ("case",)),
)
SCALING = (
    power_law("bake samples", "Baking over surface samples", "samples", ("bake cpu s",)),
    power_law("bake samples", "Error over surface samples", "samples", ("RMSE", "RMSE white")),
)
