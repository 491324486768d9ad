"""What documents show of the suite ``cache``."""

from __future__ import annotations

from typing import Any

from warp_gi.bench.publish.figures import Figure, Grid, GridColumn, Headline, Region, Text
from warp_gi.bench.suites.cache.columns import COLUMNS
from warp_gi.bench.suites.cache.fills import BY_PATHS, FILL
from warp_gi.bench.suites.cache.leaks import LEAKS
from warp_gi.bench.suites.cache.light import ALL, CACHE, CORRECTED, FEW, LIGHT, PATHS, REFERENCE, RESIDUAL
from warp_gi.bench.suites.cache.moving import MOVING
from warp_gi.bench.suites.cache.views import SPP


def _of(key: str, renderer: str, spp: int = SPP, digits: int = 2, **limits: Any) -> Figure:
    return Figure(key, {"renderer": renderer, "spp": spp}, digits, **limits)


def _column(header: str, key: str, renderer: str, spp: int = SPP, digits: int = 2, **limits: Any) -> GridColumn:
    return GridColumn(header, _of(key, renderer, spp, digits, **limits))


def _fill(key: str, digits: int = 2, scale: float = 1.0, **limits: Any) -> Figure:
    return Figure(key, {}, digits, scale, table=FILL, **limits)


def _by_paths(paths: int) -> tuple[GridColumn, ...]:
    only = {"paths": paths}
    return (
        GridColumn(f"{paths:,} paths: CPU s", Figure("fill cpu s", only)),
        GridColumn(f"RMSE of {SPP}, %", Figure("RMSE / mean", only, scale=100.0)),
        GridColumn("that stays, %", Figure("floor", only, scale=100.0)),
    )


_CACHE = Region(
    COLUMNS,
    "**Surface caches**, `warp-gi bench cache`. The indirect term alone, default settings, the scenes' own materials, "
    "160x90, one thread. The reference is the path tracer's, and its noise is not in the errors, but in FLIP.",
    (
        Text(
            '"Mean" is the cache\'s over that of the reference, which RMSE is over, too. "Times less" is the CPU time '
            "that `BsdfPaths` needs for the error that the cache has with {spp} samples, over the cache's; the fill is "
            "apart. {mean} times in the geometric mean.",
            {"spp": Figure("spp", {"renderer": CACHE, "spp": SPP}, table=LIGHT), "mean": Figure("faster, cpu")},
            ALL,
        ),
        Grid(
            "scene",
            "case",
            (
                _column("mean", "mean / paths", CACHE, digits=3, at_least="least mean", at_most="most mean"),
                _column(f"RMSE of {FEW}, %: paths", "RMSE / mean", PATHS, FEW, scale=100.0),
                _column("cache", "RMSE / mean", CACHE, FEW, scale=100.0),
                _column(f"of {SPP}, %: paths", "RMSE / mean", PATHS, scale=100.0),
                _column("cache", "RMSE / mean", CACHE, scale=100.0),
                _column("µs a sample: paths", "us a sample", PATHS),
                _column("cache", "us a sample", CACHE),
                _column("times less", "faster, cpu", CACHE, at_least="least faster"),
            ),
            LIGHT,
        ),
        Text(
            "Fills, what more samples do not remove, and FLIP of {spp} samples. FLIP sees the noise of the reference: "
            '"halves" is that between its two halves, which have twice its own noise.',
            {"spp": Figure("spp", {"renderer": CACHE, "spp": SPP})},
            LIGHT,
        ),
        Grid(
            "scene",
            "case",
            (
                GridColumn("fill, CPU s", _fill("fill cpu s", at_most="most fill s")),
                GridColumn("cells, thousands", _fill("cells", 3, 1e-3)),
                GridColumn("MB", _fill("MB")),
                GridColumn("that stays, %", _fill("floor", scale=100.0, at_most="most floor")),
                _column("FLIP: paths", "FLIP", PATHS),
                _column("cache", "FLIP", CACHE),
                _column("cache over paths", "FLIP / paths", CACHE, at_most="most of FLIP"),
                GridColumn("halves", Figure("FLIP of its halves", table=REFERENCE)),
            ),
            LIGHT,
        ),
        Text(
            "{black} % of the pixels are black where paths find light. The dark one of `two_rooms` has {dark} % of the "
            "light of the lit one, behind a wall of 2 cm, and {large} % with cells of 0.25 m. "
            f"With `residual={CORRECTED}` "
            "the mean is {mean} of the path tracer's, and paths take {residual} times as long for the same error. "
            "Fills of fewer and more paths:",
            {
                "black": Figure("black pixels", {"renderer": CACHE}, scale=100.0, table=LIGHT),
                "dark": Figure("dark / lit", {"cell m": 0.1}, 2, 100.0, at_most="most dark"),
                "large": Figure("dark / lit", {"cell m": 0.25}, 2, 100.0),
                "mean": Figure("mean / paths", {"renderer": RESIDUAL, "spp": SPP}, 3, table=LIGHT),
                "residual": Figure("faster, cpu", {"renderer": RESIDUAL, "spp": SPP}, table=LIGHT),
            },
            LEAKS,
        ),
        Grid("scene", "case", (*_by_paths(50_000), *_by_paths(150_000), *_by_paths(500_000)), BY_PATHS),
        Text(
            "Scenes that move, {spp} samples a pixel: frames all along, and those about the one in which a lamp goes "
            "that gave four fifths of the light. Each frame adds samples to the cells, in {seconds} s of one thread.",
            {"spp": Figure("spp", {"renderer": CACHE}), "seconds": Figure("refresh s", {"renderer": CACHE})},
            MOVING,
        ),
        Grid(
            "scene",
            "case",
            (
                _column("mean", "mean / paths", CACHE, FEW, digits=3),
                _column("RMSE, %: paths", "RMSE / mean", PATHS, FEW, scale=100.0),
                _column("cache", "RMSE / mean", CACHE, FEW, scale=100.0),
            ),
            MOVING,
        ),
    ),
)

REGIONS = {"cache": _CACHE}
HEADLINES = (
    Headline(
        COLUMNS,
        "SurfaceCache",
        "ends paths in small cells of surfaces that know all light there",
        Text(
            "{faster} times less CPU time for indirect light than paths of the same error; a fill takes {fill} CPU s",
            {"faster": _of("faster, cpu", CACHE), "fill": _fill("fill cpu s")},
            LIGHT,
        ),
        "surface cache",
        "surface_cache",
    ),
)
