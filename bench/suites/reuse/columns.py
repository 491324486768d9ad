"""Columns of the suite ``reuse``."""

from warp_gi.bench.harness.columns import COUNT, ERROR, MEMORY, RATIO, TIME, columns, keys, measured, notes, seconds

TERMS = ("emitters", "indirect", "beauty")

COLUMNS = columns(
    "reuse",
    keys("case", "combination", "term", "pass", "part", "degrees", "bits", "migrations"),
    notes("target", "says", "MSE / settled by frame"),
    # combinations
    measured(ERROR, "(W/(m^2 sr))^2", "lower", *(f"MSE {term}" for term in TERMS), "MSE before", "settled MSE"),
    measured(ERROR, "", "lower", "relMSE beauty", "FLIP beauty"),
    measured(ERROR, "times", "lower", *(f"{term} / baseline" for term in TERMS), "equal samples"),
    measured(RATIO, "times", "lower", *(f"{term}, equal time" for term in TERMS), "equal time"),
    measured(RATIO, "times", "higher", "beauty, faster at equal error"),
    seconds("frame "),
    measured(TIME, "ms", "lower", "preprocess ms", "paths ms", "learn ms", "frame ms", "ms"),
    measured(RATIO, "times", "lower", "time / baseline", "paths / baseline", "frame cost / baseline"),
    measured(RATIO, "times", None, "ms / LH"),
    measured(COUNT, "share of the frame", None, "share of the frame"),
    # over frames
    measured(ERROR, "times", None, "frame 0 / settled", "settled / BSDF", "peak / BSDF"),
    measured(ERROR, "times", "lower", "settled / baseline", "peak / settled"),
    measured(ERROR, "times", "lower", "first frame / baseline", "mean / baseline"),
    measured(ERROR, "frames", "lower", "frames until settled"),
    measured(COUNT, "frames", None, "settled from frame", "frames above baseline"),
    measured(COUNT, "frames", None, "first gain, frame", "next gains, frame", "refined until frame"),
    # memory
    measured(COUNT, "leaves", None, "leaves", "leaves at last"),
    measured(MEMORY, "KB", "lower", "KB"),
    measured(MEMORY, "bytes", "lower", "bytes a leaf"),
)
