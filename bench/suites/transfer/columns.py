"""Columns of the suite ``transfer``."""

from warp_gi.bench.harness.columns import (
    COUNT,
    ERROR,
    MEMORY,
    RATIO,
    TIME,
    columns,
    keys,
    measured,
    notes,
    ratios,
    seconds,
)

ERRORS = (
    *measured(ERROR, "share of the mean", "lower", "rel", "floor rel", "thing rel"),
    *measured(ERROR, "%", None, "bias, %", "floor bias, %"),
    *measured(ERROR, "share of the mean", None, "noise of reference"),
    *measured(ERROR, "", "lower", "FLIP"),
)
"""Columns of the errors that ``views.errors`` returns."""

COLUMNS = columns(
    "transfer",
    keys("case", "storage", "form", "size", "pixels", "way", "materials", "term", "sky", "bounces", "rays"),
    keys("resolution", "roughness", "order", "components", "spp"),
    notes("target", "target cpu s", "target rays", "target error", "target bias, %", "target over order 5"),
    notes("target over 16x16", "target over 1x1", "term target", "with primary target", "frame target"),
    ERRORS,
    measured(COUNT, "triangles", None, "triangles", "floor triangles", "paper triangles"),
    measured(COUNT, "", None, "slots", "slots traced", "charts", "seams", "numbers", "texels a metre"),
    # the paper's tables
    measured(TIME, "ms", "lower", "wall ms", "cpu ms"),
    measured(TIME, "ns", "lower", "ns a pixel"),
    ratios("times TP, {}"),
    measured(TIME, "ms", None, "paper ms"),
    measured(MEMORY, "MB", "lower", "MB", "file MB"),
    measured(MEMORY, "MB", None, "paper MB"),
    # vertices
    measured(ERROR, "times", "higher", "times better than 16x16", "times better than 1x1"),
    # bakes
    measured(TIME, "s", "lower", "cpu s for 2^20 slots", "bake cpu s"),
    measured(TIME, "s", "lower", "charts cpu s", "rays cpu s", "bounces cpu s"),
    measured(TIME, "ns", "lower", "ns a ray"),
    measured(COUNT, "rays", "lower", "rays a slot"),
    measured(ERROR, "share of T", "lower", "rel error of T"),
    measured(ERROR, "share", None, "last share", "covered", "backs"),
    # frames
    measured(TIME, "ms", "lower", "term cpu ms", "primary cpu ms", "frame cpu ms"),
    *(ratios(f"{part}: times less, {{}}") for part in ("term", "with primary", "frame")),
    # peers
    seconds(),
    measured(TIME, "s", "lower", "cpu s for its error"),
    measured(RATIO, "times", "higher", "transfer: times less, cpu"),
    # errors
    measured(ERROR, "share of order 5's", "lower", "over order 5"),
    measured(ERROR, "share of light", None, "share of suns"),
    measured(ERROR, "share of the mean", "lower", "jump", "rel error of light"),
    measured(ERROR, "share of the mean", None, "change over half a texel"),
    measured(ERROR, "times", "lower", "jump over change"),
    measured(MEMORY, "bytes", "lower", "transfer bytes", "bounces bytes", "stored bytes", "atlas bytes a texel"),
    measured(COUNT, "slots", "lower", "slots a texel"),
)
