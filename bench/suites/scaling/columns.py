"""Columns of the suite ``scaling``, with those of what other suites add to it."""

from warp_gi.bench.harness import catalogue
from warp_gi.bench.harness.columns import ERROR, MEMORY, RATIO, TIME, columns, keys, measured, notes, seconds

_OWN = (
    *keys("renderer", "rays", "query", "estimator", "pipeline", "work", "what"),
    *keys("triangles", "lights", "Mpixels", "threads used"),
    *notes("target", "says"),
    # growth
    *measured(RATIO, "", "lower", "exponent"),
    *measured(RATIO, "times", "lower", "growth for ten times"),
    # triangles
    *seconds("build "),
    *seconds("embree build ", better=None),
    *measured(MEMORY, "bytes", "lower", "bytes a triangle", "bytes a pixel"),
    *measured(MEMORY, "GB", "lower", "build peak GB"),
    *measured(TIME, "ns", "lower", "ours ns a ray"),
    *measured(TIME, "ns", None, "embree ns a ray"),
    *measured(RATIO, "times", "higher", "ours / embree"),
    *measured(ERROR, "share of rays", "higher", "agree"),
    # frames
    *measured(TIME, "s", "lower", "scene s", "start s"),
    *seconds("frame "),
    *seconds(),
    *measured(ERROR, "share of the mean", "lower", "relative error"),
    *measured(MEMORY, "MB", "lower", "lights MB"),
    *measured(RATIO, "times", "higher", "speed-up", "efficiency"),
)
_ADDED = {
    column.name: column
    for suite, module in catalogue.modules("columns")
    if suite != "scaling"
    for column in getattr(module, "SCALING", ())
}
COLUMNS = columns("scaling", _OWN, _ADDED.values())
