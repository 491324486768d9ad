"""Plots of the suite ``probes``, and of what probes add to the suite ``scaling``."""

from warp_gi.bench.report.suite_plots import Choice, choices, power_law
from warp_gi.bench.suites.probes.columns import COLUMNS

PLOTS = choices(
    COLUMNS,
    Choice("rays", "Rays that agree over texels a side", "resolution", ("agree",), ("case", "probes"), log_x=True),
    Choice(
        "denoise",
        "Error over rays a pixel, denoised",
        "rays a pixel",
        ("noisy RMSE", "ST RMSE"),
        ("case",),
        log_x=True,
        log_y=True,
        only={"pipeline": "paths"},
    ),
)
SCALING = (power_law("probes", "Baking over texels a side of a probe", "resolution", ("bake cpu s",)),)
