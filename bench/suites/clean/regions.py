"""What documents show of the suite ``clean``."""

from __future__ import annotations

from typing import Any

from warp_gi.bench.publish.figures import Figure, Grid, GridColumn, Region, Text
from warp_gi.bench.suites.clean.columns import COLUMNS
from warp_gi.bench.suites.clean.contenders import CLEAN, FILTERED, OIDN, PATH, UNBLENDED
from warp_gi.bench.suites.clean.first import COLD, FIRST, WARM
from warp_gi.bench.suites.clean.peers import TABLE as PEERS
from warp_gi.bench.suites.clean.sequences import BESIDE, REFERENCE, SEQUENCES
from warp_gi.bench.suites.clean.switched import LONG, SOON
from warp_gi.bench.suites.clean.switched import TABLE as SWITCHED


def _of(header: str, key: str, renderer: str, spp: int = 1, digits: int = 2, **more: Any) -> GridColumn:
    return GridColumn(header, Figure(key, {"renderer": renderer, "spp": spp}, digits, **more))


def _beside(header: str, key: str, renderer: str = CLEAN, **more: Any) -> GridColumn:
    return GridColumn(header, Figure(key, {"renderer": renderer}, table=BESIDE, **more))


def _left(renderer: str, later: int, **more: Any) -> GridColumn:
    name = "not averaged, " if renderer == UNBLENDED else ""
    only = {"renderer": renderer, "frames later": later}
    return GridColumn(f"{name}{later} later, %", Figure("old light left", only, scale=100.0, **more))


_ERRORS = Grid(
    "sequence",
    "case",
    (
        _of("clean: FLIP", "FLIP", CLEAN, at_most="most FLIP"),
        _of("not averaged", "FLIP", UNBLENDED),
        _of("path 1, OIDN", "FLIP", OIDN),
        _of("path 16, OIDN", "FLIP", OIDN, 16),
        GridColumn("reference, halves", Figure("FLIP of its halves", table=REFERENCE)),
        GridColumn("cleaned", Figure("FLIP of cleaned halves", table=REFERENCE)),
        _of("clean: mean", "mean of judged", CLEAN, digits=3, at_least="least mean", at_most="most mean"),
        _of("first frame", "mean first", CLEAN, digits=3, at_least="least mean", at_most="most mean"),
        _of("path 1, OIDN", "mean", OIDN, digits=3),
    ),
    SEQUENCES,
)
_TIMES = Grid(
    "sequence",
    "case",
    (
        _of("clean: s a frame", "s a frame", CLEAN, at_most="most s a frame"),
        _of("µs a pixel", "us a pixel", CLEAN),
        _of("first frame, s", "first frame s", CLEAN),
        _of("fill, s", "fill s", CLEAN),
        _of("path 1, µs", "us a pixel", PATH),
        _of("its filter", "us a pixel", FILTERED),
        _of("OIDN", "us a pixel", OIDN),
        _beside("FLIP over OIDN's at 10 times", "FLIP / OIDN", at_most="most of FLIP"),
        _beside("times less for equal FLIP", "times less, cpu"),
    ),
    SEQUENCES,
)
_FLICKER = Grid(
    "sequence",
    "case",
    (
        _of("clean", "flicker", CLEAN),
        _of("not averaged", "flicker", UNBLENDED),
        _of("path 1, filter", "flicker", FILTERED),
        _of("path 1, OIDN", "flicker", OIDN),
        GridColumn("reference", Figure("flicker of the reference", table=REFERENCE)),
        _beside("clean over OIDN", "flicker / OIDN", at_most="most of flicker"),
        _beside("not averaged", "flicker / OIDN", UNBLENDED, at_most="most of flicker"),
    ),
    SEQUENCES,
)

_CLEAN = Region(
    COLUMNS,
    "**Clean sequences**, `warp-gi bench clean`. Whole sequences by the preset `clean`, the camera moving, beside path "
    "tracing without and with denoisers; their frames take turns.",
    (
        Text(
            "Frame 23 of 48. FLIP is against a reference whose own halves differ as told; where these differ by more "
            "than 0.05 it is cleaned by OIDN, as are the halves of the next column. The mean is of frames 0, 23 and "
            '47, and of the first. "Not averaged" is `denoise.blend` 1. How much more alike errors on flat walls are '
            "two pixels apart than one, which is 1 for a grid, 0 for noise and below it for what is smooth: {pattern}.",
            {"pattern": Figure("pattern", {"renderer": CLEAN}, at_most="most pattern")},
            SEQUENCES,
        ),
        _ERRORS,
        Text(
            "Flicker is the mean change along motion over the light; that of the reference is what resampling makes of "
            "one without noise.",
            {},
        ),
        _FLICKER,
        Text(
            "Wall seconds of a frame, and CPU time of a pixel. The fill and the first frame, which takes more samples, "
            "are apart. FLIP of path tracing with OIDN at ten times the time of `clean`, and its time for equal FLIP; "
            "where its 64 samples do not get there, that of these.",
            {},
        ),
        _TIMES,
        Text("A light goes out and on; what is left of the old light, in percent:", {}),
        Grid(
            "light",
            "case",
            (
                _left(CLEAN, 0),
                _left(CLEAN, SOON, at_most="most left"),
                _left(CLEAN, LONG, at_most="most left"),
                _left(UNBLENDED, SOON),
                _left(UNBLENDED, LONG),
            ),
            SWITCHED,
        ),
    ),
)

_FIRST = Region(
    COLUMNS,
    "**The first command**, `warp-gi render`, from start to written files:",
    (
        Text(
            "{frames} frames of the atrium, 640x360: {cold} s with all kernels to compile, {warm} s later; the first "
            "frame after {first} and {again} s. {memory} GB at most.",
            {
                "frames": Figure("frames"),
                "cold": Figure("wall s", {"state": COLD}, at_most="most s"),
                "warm": Figure("wall s", {"state": WARM}, at_most="most s"),
                "first": Figure("to first frame s", {"state": COLD}, at_most="most first s"),
                "again": Figure("to first frame s", {"state": WARM}, at_most="most first s"),
                "memory": Figure("peak GB"),
            },
            FIRST,
        ),
    ),
)

_SHORT = Region(
    COLUMNS,
    "**Clean frames beside path tracing and a denoiser**, in short:",
    (
        Grid(
            "sequence",
            "case",
            (
                _of("`clean`: FLIP", "FLIP", CLEAN),
                _of("s a frame", "s a frame", CLEAN),
                _of("`path`, 1 sample, OIDN: FLIP", "FLIP", OIDN),
                _of("s a frame", "s a frame", OIDN),
                _beside("flicker over its", "flicker / OIDN"),
                _beside("times less for equal FLIP", "times less, cpu"),
            ),
            SEQUENCES,
        ),
    ),
)

_PEERS = Region(
    COLUMNS,
    "**Clean sequences beside other renderers**, `warp-gi bench clean --parts peers`: Lambert materials, 320x180.",
    (
        Text(
            "Each has its own denoiser or Open Image Denoise; LuxCore its photon cache. FLIP and time over those of "
            "`clean` in the same frame:",
            {},
        ),
        Grid(
            "renderer",
            "contender",
            (
                GridColumn("FLIP over ours", Figure("FLIP / clean", at_least="least FLIP")),
                GridColumn("time over ours", Figure("time / clean", at_least="least faster")),
                GridColumn("s a frame", Figure("s a frame")),
                GridColumn("flicker", Figure("flicker")),
            ),
            PEERS,
        ),
    ),
)

REGIONS = {"clean": _CLEAN, "clean short": _SHORT, "clean first": _FIRST, "clean peers": _PEERS}
