"""Columns of the rows of ``warp-gi bench compare``."""

from warp_gi.bench.harness.columns import COUNT, ERROR, RATIO, TIME, columns, keys, measured, notes, seconds

COLUMNS = columns(
    "compare",
    keys("scene", "sky", "pixels", "pipeline", "spp", "error that", "reached", "reference"),
    notes("says", "seed", "time s", "noise RMSE", "max depth"),
    measured(COUNT, "triangles", None, "triangles"),
    measured(COUNT, "emitters", None, "emitters"),
    measured(COUNT, "frames", None, "frames"),
    measured(TIME, "s", "lower", "load s", "build s", "compile s", "bake s", "preprocess s", "first frame s"),
    seconds(),
    measured(TIME, "s", None, "sum s", "seconds"),
    measured(TIME, "s", "lower", "render s", "with build and bake s"),
    measured(RATIO, "times", "higher", "speed-up over *"),
    measured(ERROR, "W/(m^2 sr)", "lower", "RMSE", "floor RMSE"),
    measured(ERROR, "", "lower", "relMSE", "FLIP", "floor relMSE"),
    measured(ERROR, "pixels", "lower", "bad pixels"),
)
