"""Plots of the suite ``transfer``."""

from warp_gi.bench.report.suite_plots import Choice, choices
from warp_gi.bench.suites.transfer.columns import COLUMNS

PLOTS = choices(
    COLUMNS,
    Choice(
        "vertices and textures",
        "Error on the floor over memory",
        "MB",
        ("floor rel",),
        ("storage",),
        log_x=True,
        log_y=True,
    ),
    Choice(
        "errors: resolution",
        "Error over texels a metre",
        "texels a metre",
        ("rel",),
        ("term",),
        log_x=True,
        log_y=True,
    ),
    Choice("glossy: smooth sky", "Error over roughness", "roughness", ("rel",), ("order",)),
    Choice(
        "seams",
        "Jumps across seams over texels a side",
        "resolution",
        ("jump", "change over half a texel"),
        ("case",),
        log_x=True,
        log_y=True,
    ),
    Choice("memory: components of bounces", "Error of bounces over components", "components", ("rel",), ("case",)),
)
