"""Columns of the suite ``dvf``, and of what its fields add to the suite ``scaling``."""

from warp_gi.bench.harness.columns import (
    COUNT,
    ERROR,
    MEMORY,
    RATE,
    RATIO,
    TIME,
    columns,
    keys,
    measured,
    notes,
    ratios,
    seconds,
)

QUALITY = (
    *measured(ERROR, "W/(m^2 sr)", "lower", "RMSE", "RMSE white"),
    *measured(ERROR, "", "lower", "relMSE", "FLIP"),
    *measured(COUNT, "share of rays", None, "traced share"),
    *measured(ERROR, "rays of a million", "lower", "wrong per million"),
)
"""Columns of the errors that ``views.quality`` returns."""
SIZE = (*measured(COUNT, "cells", None, "cells"), *measured(MEMORY, "MB", "lower", "MB"))
SCALING = (*keys("samples"), *seconds("bake "), *SIZE, *QUALITY)

COLUMNS = columns(
    "dvf",
    keys("case", "mode", "sky", "renderer", "spp", "pixels", "relight", "samples", "cell size", "resolution"),
    notes("target", "targets"),
    seconds(),
    ratios("ratio {}"),
    QUALITY,
    # sweeps of settings, and the paper's figures
    SIZE,
    seconds("bake "),
    seconds("without ", better=None),
    measured(TIME, "s", None, "traced s"),
    measured(RATIO, "times", None, "paper's method, ratio cpu", "paper ratio"),
    measured(TIME, "ms", None, "without ms", "with ms"),
    measured(MEMORY, "MB", "lower", "MB of all cells"),
    measured(MEMORY, "MB", None, "paper MB"),
    measured(COUNT, "samples", None, "bake samples", "samples taken"),
    # equal error
    measured(ERROR, "pixels", "lower", "bad pixels"),
    measured(RATIO, "W/(m^2 sr)", "lower", "RMSE at equal time"),
    measured(TIME, "s", "lower", "wall s to 0.01", "cpu s to 0.01"),
    measured(RATIO, "times", "higher", "times mitsuba, wall", "times mitsuba, cpu"),
    measured(ERROR, "times", None, "mean / traced"),
    # bakes, relighting
    measured(COUNT, "rays", None, "rays asked", "rays traced", "rays", "rays_traced"),
    measured(RATE, "million rays/s", "higher", "Mrays/wall s", "Mrays/cpu s"),
    measured(RATE, "million rays/s", None, "raw Mrays/wall s", "raw Mrays/cpu s"),
    measured(RATIO, "times", "higher", "bake / raw, cpu"),
    measured(COUNT, "frames", None, "frames"),
    measured(MEMORY, "GB", "lower", "peak GB before"),
    measured(MEMORY, "MB", "lower", "file MB"),
    measured(TIME, "s", "lower", "first wall s", "later wall s"),
)
