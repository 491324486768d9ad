"""Plots of the suite ``compile``."""

from warp_gi.bench.report.suite_plots import Choice, choices
from warp_gi.bench.suites.compile.columns import COLUMNS

PLOTS = choices(
    COLUMNS,
    Choice(
        "modules",
        "Seconds to load a kernel module over its size",
        "object kB",
        ("cold s", "warm s"),
        log_x=True,
        log_y=True,
    ),
)
