"""Columns of the suite ``path``."""

from warp_gi.bench.harness.columns import COUNT, ERROR, RATIO, TIME, columns, keys, measured, ratios, seconds

COLUMNS = columns(
    "path",
    keys("case", "pixels", "spp", "renderer", "peer"),
    seconds(),
    measured(TIME, "s", "lower", "s", "start s", "scene s", "frame s", "compile s"),
    ratios("faster, {}"),
    ratios("faster at equal error, {}"),
    measured(ERROR, "W/(m^2 sr)", "lower", "RMSE"),
    measured(ERROR, "", "lower", "relMSE", "FLIP", "noise relMSE"),
    measured(ERROR, "times", "lower", "error ratio"),
    measured(ERROR, "pixels", "lower", "bad pixels"),
    measured(ERROR, "share", None, "means differ", "standard error"),
    measured(RATIO, "times", "higher", "least", "geometric mean", "most"),
    measured(COUNT, "samples", None, "samples a pixel", "reference spp"),
    measured(COUNT, "", None, "pictures"),
)
