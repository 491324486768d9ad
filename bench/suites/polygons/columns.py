"""Columns of the suite ``polygons``."""

from warp_gi.bench.harness.columns import COUNT, ERROR, MEMORY, RATIO, TIME, columns, keys, measured, notes, seconds

COLUMNS = columns(
    "polygons",
    keys("shape", "sky", "evaluator", "renderer", "scene", "spp", "pixels", "walls"),
    notes("target"),
    seconds(),
    # bakes
    measured(COUNT, "vertices", None, "vertices", "paper vertices"),
    measured(COUNT, "triangles", None, "triangles"),
    measured(COUNT, "sets", None, "sets"),
    measured(COUNT, "points", "lower", "points a set"),
    measured(COUNT, "share of sides", "lower", "traced", "flagged"),
    measured(TIME, "s", "lower", "contours cpu s", "correspondence cpu s", "check cpu s"),
    measured(TIME, "s", None, "paper visibility s", "paper correspondence s"),
    measured(MEMORY, "B", "lower", "bytes a set", "bytes a side"),
    measured(MEMORY, "MB", "lower", "visibility MB", "lists MB"),
    measured(MEMORY, "MB", None, "paper visibility MB", "paper lists MB"),
    # evaluators
    measured(COUNT, "polygons", None, "polygons", "turns"),
    measured(TIME, "us", "lower", "us a polygon"),
    measured(TIME, "s", "lower", "tables cpu s"),
    measured(ERROR, "% of the mean irradiance", "lower", "rms %", "p99 %", "max %"),
    # frames
    measured(ERROR, "% of the mean", "lower", "median %", "p95 %", "noise %"),
    measured(ERROR, "% of the mean", None, "mean %"),
    measured(ERROR, "dB", "higher", "PSNR"),
    measured(RATIO, "times", "lower", "time over traced 256"),
    measured(COUNT, "samples", None, "reference spp"),
)
