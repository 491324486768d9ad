"""Plots of the suite ``scaling``, with those of what other suites add to it."""

from warp_gi.bench.harness import catalogue
from warp_gi.bench.report.suite_plots import choices, power_law
from warp_gi.bench.suites.scaling.columns import COLUMNS

_ADDED = [
    choice
    for suite, module in catalogue.modules("plots")
    if suite != "scaling"
    for choice in getattr(module, "SCALING", ())
]
PLOTS = choices(
    COLUMNS,
    power_law("triangles: rays", "Time a ray over triangles", "triangles", ("ours ns a ray",), ("rays", "query")),
    power_law("triangles: rays", "Embree's time a ray", "triangles", ("embree ns a ray",), ("rays", "query")),
    power_law("triangles", "Building over triangles", "triangles", ("build cpu s", "embree build cpu s")),
    power_law("triangles", "Bytes a triangle of the tree", "triangles", ("bytes a triangle",)),
    power_law("triangles", "Memory that building takes at most", "triangles", ("build peak GB",)),
    power_law("lights", "Seconds a frame over lights", "lights", ("frame cpu s",), ("estimator",)),
    power_law("lights", "Preparation over lights", "lights", ("start s",), ("estimator",)),
    power_law("pixels", "Seconds a frame over pixels", "Mpixels", ("frame cpu s",), ("pipeline",)),
    power_law("pixels", "Peak memory over pixels", "Mpixels", ("peak GB",), ("pipeline",)),
    power_law("threads", "Speed-up over threads", "threads used", ("speed-up",), ("work",)),
    *_ADDED,
)
