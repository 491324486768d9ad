"""Columns of the suite ``compile``."""

from warp_gi.bench.harness.columns import COUNT, MEMORY, TIME, columns, keys, measured

COLUMNS = columns(
    "compile",
    keys("module", "first frame needs it", "pipeline"),
    measured(COUNT, "modules", None, "modules", "measured"),
    measured(TIME, "s", "lower", "cold s", "warm s", "sum of cold s", "sum of warm s"),
    measured(TIME, "s", "lower", "in one process, cold s", "in one process, warm s"),
    measured(MEMORY, "kB", "lower", "object kB", "sum of object kB"),
)
