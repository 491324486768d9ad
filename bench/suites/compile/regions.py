"""What documents show of the suite ``compile``."""

from __future__ import annotations

from warp_gi.bench.publish.figures import Figure, Region, Text
from warp_gi.bench.suites.compile.columns import COLUMNS

_COMPILE = Region(
    COLUMNS,
    "**Kernel modules**, `warp-gi bench compile`:",
    (
        Text(
            "The first frame of the preset `path` needs {modules} kernel modules, {size} kB of objects. They take "
            "{cold} s to compile and load, {warm} s from the cache.",
            {
                "modules": Figure("modules"),
                "size": Figure("sum of object kB"),
                "cold": Figure("in one process, cold s"),
                "warm": Figure("in one process, warm s"),
            },
            "first frame",
        ),
    ),
)

REGIONS = {"compile": _COMPILE}
