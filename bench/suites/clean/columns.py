"""Columns of the suite ``clean``."""

from warp_gi.bench.harness.columns import COUNT, ERROR, MEMORY, RATIO, TIME, columns, keys, measured, notes

COLUMNS = columns(
    "clean",
    keys("case", "pixels", "contender", "renderer", "family", "spp", "frame", "frames later", "state"),
    notes("most FLIP", "most s a frame", "most pattern", "least mean", "most mean", "most left"),
    notes(
        "most of flicker",
        "most of FLIP",
        "least faster",
        "least FLIP",
        "most s",
        "most first s",
        "reference",
        "reached",
        "version",
    ),
    # the middle frame against the reference, and others
    measured(ERROR, "", "lower", "FLIP", "FLIP first", "FLIP last", "relMSE"),
    measured(ERROR, "times", None, "mean", "mean first", "mean last", "mean of judged"),
    measured(ERROR, "share of the light", "lower", "flicker", "fine error"),
    measured(ERROR, "", None, "alike at 1", "alike at 2"),
    measured(ERROR, "", "lower", "pattern"),
    measured(ERROR, "share", "lower", "old light left"),
    # time and memory
    measured(TIME, "us", "lower", "us a pixel"),
    measured(TIME, "s", "lower", "s a frame", "first frame s", "fill s", "fill cpu s", "to first frame s"),
    measured(COUNT, "frames", None, "frames"),
    # beside others
    measured(ERROR, "times", "lower", "flicker / OIDN", "FLIP / OIDN"),
    measured(RATIO, "times", "higher", "times less, cpu", "time / clean"),
    measured(ERROR, "times", "higher", "FLIP / clean"),
    # references
    measured(COUNT, "samples", None, "reference spp"),
    measured(ERROR, "", None, "FLIP of its halves", "FLIP of cleaned halves", "flicker of the reference"),
    measured(ERROR, "share", None, "mean error"),
    measured(MEMORY, "GB", "lower", "GB"),
)
