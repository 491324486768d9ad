"""Columns of the suite ``rays``."""

from warp_gi.bench.harness.columns import ERROR, MEMORY, RATE, RATIO, TIME, columns, keys, measured

COLUMNS = columns(
    "rays",
    keys("scene", "triangles", "rays", "query"),
    measured(TIME, "s", "lower", "ours build s"),
    measured(TIME, "s", None, "warp build s", "embree build s", "embree robust build s", "embree high build s"),
    measured(RATIO, "times", "higher", "embree / ours", "embree robust / ours", "embree high / ours"),
    measured(MEMORY, "bytes", "lower", "bytes a triangle"),
    measured(RATE, "million rays/s", "higher", "ours Mrays/s", "ours in order Mrays/s", "ours Mrays/wall s"),
    measured(RATE, "million rays/s", "higher", "ours presorted Mrays/s"),
    measured(RATE, "million rays/s", "higher", "ours coherent Mrays/s"),
    measured(RATE, "million rays/s", None, "warp Mrays/s", "embree Mrays/s", "embree robust Mrays/s"),
    measured(RATE, "million rays/s", None, "embree high Mrays/s", "embree packets Mrays/s", "embree presorted Mrays/s"),
    measured(RATIO, "times", "higher", "ours / warp", "ours / embree", "ours / embree robust"),
    measured(RATIO, "times", "higher", "in order / warp", "in order / embree", "in order / embree robust"),
    measured(RATIO, "times", "higher", "ours / embree high", "in order / embree high", "ours / embree packets"),
    measured(RATIO, "times", "higher", "ours / best", "in order / best", "presorted / best"),
    measured(RATIO, "times", "higher", "coherent / ours", "coherent / embree packets"),
    measured(RATIO, "times", "higher", "2 threads faster"),
    measured(RATIO, "times", "lower", "2 threads cpu"),
    measured(ERROR, "share of rays", "higher", "agree"),
)
