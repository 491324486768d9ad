"""What documents show of the suite ``dvf``."""

from __future__ import annotations

from typing import Any

from warp_gi.bench.publish.figures import Figure, Grid, GridColumn, Headline, Only, Region, Text
from warp_gi.bench.suites.dvf.columns import COLUMNS

_VIEWS: dict[str, Only] = {
    "Sponza": {"case": "Sponza"},
    "atrium": {"case": "atrium"},
    "Bistro from above": {"case": "Bistro"},
    "street from its ground": {"case": "street"},
}
_OVER_MITSUBA = 1.8
"""Smallest factor over Mitsuba that ``peers.TARGETS`` asks for."""


def _mode(header: str, key: str, mode: str = "three_state", **settings: Any) -> GridColumn:
    return GridColumn(header, Figure(key, {"mode": mode}, **settings))


def _over_mitsuba(header: str, sky: str, renderer: str) -> GridColumn:
    only = {"sky": sky, "renderer": renderer}
    return GridColumn(header, Figure("times mitsuba, wall", only, at_least=_OVER_MITSUBA))


_DVF = Region(
    COLUMNS,
    "**Visibility fields**, `warp-gi bench dvf`; 480x270, 64 samples a pixel, Lambert materials, a white sky, defaults "
    '(Bistro and street: cells of 1 m). "Faster" is the CPU time of the sky\'s stage with every ray traced over that '
    "with the field, same rays, same tree; RMSE is between those two pictures. The mode `unbiased` is wrong nowhere in "
    "expectation.",
    (
        Grid(
            "scene",
            _VIEWS,
            (
                _mode("faster", "ratio cpu", at_least="target"),
                _mode("rays traced, %", "traced share", scale=100.0),
                _mode("RMSE", "RMSE"),
                _mode("wrong rays a million", "wrong per million"),
                _mode("faster, `unbiased`", "ratio cpu", "unbiased"),
                _mode("faster, paper's settings and mode", "ratio cpu", "paper, its settings"),
            ),
            "modes",
        ),
        Text(
            "More samples a pixel gain more (Sponza: {few} at 16, {many} at 128), glossy surfaces less ({sponza} in "
            "Sponza, {bistro} in Bistro). Beside Mitsuba 3 `llvm_ad_rgb`, whole frames, times faster to the same "
            "RMSE:",
            {
                "few": Figure("ratio cpu", {"case": "Sponza", "spp": 16}),
                "many": Figure("ratio cpu", {"case": "Sponza", "spp": 128}),
                "sponza": Figure("ratio cpu", {"case": "Sponza", "mode": "three_state"}, table="glossy"),
                "bistro": Figure("ratio cpu", {"case": "Bistro", "mode": "three_state"}, table="glossy"),
            },
            "table 1",
        ),
        Grid(
            "scene",
            _VIEWS,
            (
                _over_mitsuba("low-frequency sky, `harmonics`", "low-frequency", "field, harmonics"),
                _over_mitsuba("low-frequency sky, `map`", "low-frequency", "field, map"),
                _over_mitsuba("courtyard sky, `map`", "courtyard", "field, map"),
            ),
            "equal error",
        ),
        Text(
            "Baking Sponza for a flight of {frames} frames at {pixels} takes {bake} s, {file} MB and {memory} GB at "
            "most, at {rate} of the raw rate of any-hit queries. Relighting a still camera takes {relight} ms.",
            {
                "frames": Figure("frames"),
                "pixels": Figure("pixels"),
                "bake": Figure("wall s"),
                "file": Figure("file MB"),
                "memory": Figure("peak GB"),
                "rate": Figure("bake / raw, cpu", table="bake rate"),
                "relight": Figure("later wall s", {"relight": True}, scale=1e3, table="relight"),
            },
            "flight bake",
        ),
    ),
)

REGIONS = {"dvf": _DVF}
HEADLINES = (
    Headline(
        COLUMNS,
        "VisibilityField",
        "knows from a baked grid which rays reach the sky",
        Text(
            "{faster} times less CPU time for the sky's light than tracing every ray",
            {"faster": Figure("ratio cpu", {"mode": "three_state"})},
            "modes",
        ),
        "visibility fields",
        "visibility_field",
        "Xu et al. 2022",
    ),
)
