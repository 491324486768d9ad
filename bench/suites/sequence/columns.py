"""Columns of the suite ``sequence``."""

from warp_gi.bench.harness.columns import COUNT, ERROR, MEMORY, RATE, RATIO, TIME, columns, keys, measured, notes

COLUMNS = columns(
    "sequence",
    keys("pipeline", "pixels", "spp", "scene", "frame number"),
    notes("blender"),
    measured(COUNT, "frames", None, "frames"),
    measured(RATE, "frames/minute", "higher", "frames a minute", "ours frames a minute"),
    measured(RATE, "frames/minute", None, "blender frames a minute"),
    measured(RATIO, "times", "higher", "faster"),
    measured(TIME, "s", "lower", "start s", "load s", "bake s", "compile s"),
    measured(TIME, "s", "lower", "s a frame", "preprocess s a frame", "trace s a frame"),
    measured(TIME, "s", "lower", "denoise s a frame", "write s a frame"),
    measured(TIME, "s", None, "blender load s", "blender s a frame"),
    measured(MEMORY, "MB", "lower", "first MB", "last MB", "MB"),
    measured(MEMORY, "KB", "lower", "KB a frame"),
    measured(ERROR, "share", None, "means differ"),
    measured(ERROR, "", "lower", "relMSE of tiles"),
)
