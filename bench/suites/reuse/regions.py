"""What documents show of the suite ``reuse``."""

from __future__ import annotations

from warp_gi.bench.publish.figures import Figure, Grid, GridColumn, Headline, Only, Region, Text
from warp_gi.bench.suites.reuse.columns import COLUMNS

_LEARNT = "VisibilityLightCache + GuidedPaths"
_POWER = Figure("emitters / baseline", {"case": "warehouse", "combination": "PowerLights + BsdfPaths"})
_CACHE_ALONE, _GUIDES_ALONE = "VisibilityLightCache + BsdfPaths", "LightHierarchy + GuidedPaths"


def _over_baseline(header: str, key: str, unless: Only | None = None) -> GridColumn:
    return GridColumn(header, Figure(key, {"combination": _LEARNT}, at_most=1.0), unless or {})


def _target(case: str, term: str, combination: str) -> Only:
    return {"case": case, "term": term, "combination": combination}


def _pass_share(case: str) -> Figure:
    return Figure("share of the frame", {"case": case, "pass": "all"}, scale=100.0, table="passes")


def _settles(migrations: int) -> Figure:
    only = {"degrees": 36.0, "bits": 128, "migrations": migrations}
    return Figure("frames until settled", only, at_most="target", table="turning")


_REUSE = Region(
    COLUMNS,
    "**Sample reuse**, `warp-gi bench reuse`; one sample a pixel, frames 16 to 25, warehouse and mine 480x270, others "
    "240x135. Mean squared error of the preset `reuse` over that of `LightHierarchy` and `BsdfPaths` at equal samples, "
    'and times the ratio of CPU times of whole frames ("equal time"). Below 1 is in its favour. Where few lights are '
    "all seen, nothing is left to learn, and the time is lost.",
    (
        Grid(
            "scene",
            {
                "warehouse, many small lamps": {"case": "warehouse"},
                "mine, sun-lit spot, one bounce": {"case": "mine, spot, one bounce"},
                "mine, all bounces": {"case": "mine, spot"},
                "Bistro, lamps of its streets": {"case": "Bistro"},
                "modern hall": {"case": "modern hall"},
                "dragon under a cover": {"case": "dragon"},
                "Cornell box": {"case": "cornell_box"},
                "row of GGX spheres": {"case": "sphere_row"},
            },
            (
                _over_baseline("emitters", "emitters / baseline", {"MSE emitters": 0.0}),
                _over_baseline("indirect", "indirect / baseline"),
                _over_baseline("beauty", "beauty / baseline"),
                _over_baseline("beauty, equal time", "beauty, equal time"),
            ),
            "combinations",
        ),
        Text("Error over the baseline's at equal samples, with one technique alone:", {}),
        Grid(
            "case",
            {
                "warehouse, emitters, light cache": _target("warehouse", "emitters", _CACHE_ALONE),
                "mine, one bounce, indirect, guided paths": _target(
                    "mine, spot, one bounce", "indirect", _GUIDES_ALONE
                ),
                "mine, all bounces, indirect, guided paths": _target("mine, spot", "indirect", _GUIDES_ALONE),
            },
            (
                GridColumn("target", Figure("target", digits=3)),
                GridColumn("reached", Figure("equal samples", at_most="target")),
            ),
            "targets",
        ),
        Text(
            "The baseline is strong: in the warehouse, lights by power have {power} times its error in the emitters' "
            "term. At 640x360 learning takes {warehouse} % of a frame in the warehouse and {mine} % in the mine, and "
            "tracing takes {tracing} times as long as with the hierarchy (the paper: {paper_tracing}). After a turn of "
            "the light by 36 degrees quadtrees of 128 bits settle in {fast} frames, with one migration a frame in "
            "{slow} (the paper: {paper_turn}). A leaf's quadtree takes {leaf} KB.",
            {
                "power": _POWER,
                "warehouse": _pass_share("warehouse"),
                "mine": _pass_share("mine, spot"),
                "tracing": Figure(
                    "paths / baseline", {"case": "warehouse", "combination": _LEARNT}, table="path tracing"
                ),
                "paper_tracing": Figure(
                    "ms / LH", {"combination": "VLC + CDQ"}, table="path tracing: paper, RTX 2080 Ti, 1920x1080"
                ),
                "fast": _settles(8),
                "slow": _settles(1),
                "paper_turn": Figure("frames until settled", {"degrees": 36.0}, table="turning: paper, figure 10"),
                "leaf": Figure("bytes a leaf", {"part": "quadtrees"}, scale=1e-3, table="memory"),
            },
            "combinations",
        ),
    ),
)

REGIONS = {"reuse": _REUSE}


def _at_equal_time(case: str, term: str, combination: str) -> Figure:
    return Figure("equal time", _target(case, term, combination))


HEADLINES = (
    Headline(
        COLUMNS,
        "VisibilityLightCache",
        "samples the lights that earlier frames saw from there",
        Text(
            "warehouse, many small lamps: {error} times the hierarchy's squared error at equal time",
            {"error": _at_equal_time("warehouse", "emitters", _CACHE_ALONE)},
            "targets",
        ),
        "sample reuse",
        "sample_reuse",
        "Dittebrandt et al. 2020",
    ),
    Headline(
        COLUMNS,
        "GuidedPaths",
        "sends paths where light came from in earlier frames",
        Text(
            "mine, one bounce off a sun-lit spot: {error} times the squared error of BSDF sampling at equal time",
            {"error": _at_equal_time("mine, spot, one bounce", "indirect", _GUIDES_ALONE)},
            "targets",
        ),
        "sample reuse",
        "sample_reuse",
        "Dittebrandt et al. 2020",
    ),
    Headline(
        COLUMNS,
        "LightHierarchy",
        "selects one of many lights for each point",
        Text(
            "warehouse, many small lamps: lights by power have {power} times its squared error",
            {"power": _POWER},
            "combinations",
        ),
        "light hierarchy",
        "light_hierarchy",
        is_base=True,
    ),
)
