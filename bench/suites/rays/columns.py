"""Columns of the suite ``rays``."""

from warp_gi.bench.harness.columns import ERROR, MEMORY, RATE, RATIO, TIME, columns, keys, measured

COLUMNS = columns(
    "rays",
    keys("scene", "triangles", "rays", "query"),
    measured(TIME, "s", "lower", "ours build s"),
    measured(TIME, "s", None, "warp build s", "embree build s", "embree robust build s"),
    measured(RATIO, "times", "higher", "embree / ours", "embree robust / ours"),
    measured(MEMORY, "bytes", "lower", "bytes a triangle"),
    measured(RATE, "million rays/s", "higher", "ours Mrays/s", "ours in order Mrays/s", "ours Mrays/wall s"),
    measured(RATE, "million rays/s", None, "warp Mrays/s", "embree Mrays/s", "embree robust Mrays/s"),
    measured(RATIO, "times", "higher", "ours / warp", "ours / embree", "ours / embree robust"),
    measured(RATIO, "times", "higher", "in order / warp", "in order / embree", "in order / embree robust"),
    measured(RATIO, "times", "higher", "2 threads faster"),
    measured(RATIO, "times", "lower", "2 threads cpu"),
    measured(ERROR, "share of rays", "higher", "agree"),
)
