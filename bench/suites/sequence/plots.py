"""Plots of the suite ``sequence``."""

from warp_gi.bench.report.suite_plots import Choice, choices
from warp_gi.bench.suites.sequence.columns import COLUMNS

PLOTS = choices(COLUMNS, Choice("memory over frames", "Memory over frames", "frame number", ("MB",), ("pipeline",)))
