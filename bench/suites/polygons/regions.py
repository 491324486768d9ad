"""What documents show of the suite ``polygons``."""

from __future__ import annotations

from warp_gi.bench.publish.figures import Figure, Grid, GridColumn, Headline, Only, Region, Text
from warp_gi.bench.suites.polygons.columns import COLUMNS

_RENDERERS = {
    "`VisibilityPolygons`": ("polygons", 64),
    "`evaluations=3`": ("three evaluations", 64),
    '`mode="unbiased"`, 64': ("unbiased", 64),
    '`mode="unbiased"`, 256': ("unbiased", 256),
    "`TracedEnvironment`, 64": ("traced", 64),
    "`TracedEnvironment`, 256": ("traced", 256),
}
_GROUND = "on ground"
_EVALUATORS: dict[str, Only] = {
    f"{sky}, `{one}`": {"sky": sky, "evaluator": one}
    for sky in ("city", "forest", "courtyard")
    for one in ("adaptive", "vsat, 5.8", "vsat, 163")
}


def _lines(scene: str) -> dict[str, Only]:
    return {name: {"scene": scene, "renderer": kind, "spp": spp} for name, (kind, spp) in _RENDERERS.items()}


def _frames(scene: str) -> Grid:
    return Grid(
        scene,
        _lines(scene),
        (
            GridColumn("CPU s a frame", Figure("cpu s")),
            GridColumn("rms, %", Figure("rms %")),
            GridColumn("median, %", Figure("median %")),
            GridColumn("p95, %", Figure("p95 %")),
            GridColumn("mean, %", Figure("mean %")),
            GridColumn("noise, %", Figure("noise %")),
            GridColumn("PSNR, dB", Figure("PSNR", digits=3)),
        ),
        "frames",
    )


_POLYGONS = Region(
    COLUMNS,
    "**Visibility polygons**, `warp-gi bench polygons`; Lambert materials, skies of 1024x512.",
    (
        Text(
            "A closed object of 2,562 vertices alone, and on a ground of 1,681, the city's sky with its sun, {pixels} "
            "pixels. The reference has {reference} traced samples a pixel, and so about a quarter of the noise of 256. "
            "Errors are of the light of pixels, in % of the mean; noise is by two seeds; PSNR is at the reference's "
            "98th percentile. Flagged triangles are traced with 64 samples.",
            {"pixels": Figure("pixels"), "reference": Figure("reference spp")},
            "frames",
        ),
        _frames("closed object"),
        _frames(_GROUND),
        Text(
            "Bakes of meshes of about as many vertices as the paper's, in CPU seconds and MB; the paper's are seconds "
            "of an i5-8400.",
            {},
            "bakes",
        ),
        Grid(
            "mesh",
            "shape",
            (
                GridColumn("vertices", Figure("vertices", digits=4)),
                GridColumn("seconds", Figure("cpu s")),
                GridColumn("polygons, MB", Figure("visibility MB")),
                GridColumn("lists, MB", Figure("lists MB")),
                GridColumn("bytes a set", Figure("bytes a set", digits=3)),
                GridColumn("bytes a side", Figure("bytes a side", digits=2)),
                GridColumn("traced, %", Figure("traced", scale=100.0)),
                GridColumn("flagged, %", Figure("flagged", scale=100.0)),
                GridColumn("paper: polygons, s", Figure("paper visibility s", digits=3)),
                GridColumn("lists, s", Figure("paper correspondence s", digits=3)),
                GridColumn("polygons, MB", Figure("paper visibility MB", digits=3)),
                GridColumn("lists, MB", Figure("paper lists MB", digits=3)),
            ),
            "bakes",
        ),
        Text(
            "What {polygons} vertices of the object see, as a sky turns {turns} times. `vsat` is the paper's way, by "
            'the slope of its sigmoid. Errors are in % of the mean irradiance and against "exact", a walk over all '
            "texels in {time} us. Tables are made once a sky. Under a sky of 1, against the closed form, "
            '"adaptive" is off by up to {most} % of pi, and "exact" by up to {exact} %.',
            {
                "polygons": Figure("polygons"),
                "turns": Figure("turns"),
                "time": Figure("us a polygon", {"evaluator": "exact"}),
                "most": Figure("max %", {"evaluator": "adaptive"}, table="white sky"),
                "exact": Figure("max %", {"evaluator": "exact"}, table="white sky"),
            },
            "evaluators",
        ),
        Grid(
            "sky, evaluator",
            _EVALUATORS,
            (
                GridColumn("us a polygon", Figure("us a polygon")),
                GridColumn("rms, %", Figure("rms %")),
                GridColumn("p99, %", Figure("p99 %")),
                GridColumn("largest, %", Figure("max %")),
                GridColumn("tables, CPU s", Figure("tables cpu s")),
            ),
            "evaluators",
        ),
    ),
)

REGIONS = {"polygons": _POLYGONS}
HEADLINES = (
    Headline(
        COLUMNS,
        "VisibilityPolygons",
        "integrates the sky along the edges of what a pixel sees of it, blended from vertices",
        Text(
            "object on ground, city with a sun: {psnr} dB in {time} times the time of 256 traced samples, which have "
            "{traced} dB",
            {
                "psnr": Figure("PSNR", {"scene": _GROUND, "renderer": "polygons", "spp": 64}, 3),
                "time": Figure("time over traced 256", {"scene": _GROUND, "renderer": "polygons", "spp": 64}),
                "traced": Figure("PSNR", {"scene": _GROUND, "renderer": "traced", "spp": 256}, 3),
            },
            "frames",
        ),
        "visibility polygons",
        "visibility_polygons",
    ),
)
