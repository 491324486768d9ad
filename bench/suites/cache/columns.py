"""Columns of the suite ``cache``."""

from warp_gi.bench.harness.columns import COUNT, ERROR, MEMORY, TIME, columns, keys, measured, notes, ratios

COLUMNS = columns(
    "cache",
    keys("case", "renderer", "spp", "paths", "cell m"),
    notes("least mean", "most mean", "most fill s", "most floor", "least faster", "most of FLIP", "most dark"),
    # pictures beside paths
    measured(ERROR, "times", None, "mean / paths", "lit / paths"),
    measured(ERROR, "W/(m^2 sr)", "lower", "RMSE"),
    measured(ERROR, "share of the mean", "lower", "RMSE / mean", "floor"),
    measured(ERROR, "", "lower", "relMSE", "FLIP"),
    measured(ERROR, "times", "lower", "FLIP / paths", "dark / lit"),
    measured(ERROR, "share of pixels", "lower", "black pixels"),
    measured(TIME, "us", "lower", "us a sample"),
    ratios("faster, {}"),
    # fills
    measured(TIME, "s", "lower", "fill cpu s", "refresh s"),
    measured(COUNT, "cells", None, "cells"),
    measured(COUNT, "samples", None, "samples a cell"),
    measured(MEMORY, "MB", "lower", "MB"),
    # the reference
    measured(COUNT, "samples", None, "reference spp"),
    measured(ERROR, "", None, "FLIP of its halves"),
    measured(ERROR, "share of the mean", None, "noise"),
)
