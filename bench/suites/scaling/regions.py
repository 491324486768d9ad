"""What documents show of the suite ``scaling``."""

from __future__ import annotations

from warp_gi.bench.publish.figures import Figure, Grid, GridColumn, Region, Text
from warp_gi.bench.suites.scaling.columns import COLUMNS

_GROWTH, _BUILD = "growth for ten times", "build cost s"

_SCALING = Region(
    COLUMNS,
    "**Scaling**, `warp-gi bench scaling`: one shape in ever finer meshes, up to ten million triangles, one thread. "
    '"Ten times the triangles" is the worst tenfold step. "few" repeats the same rays, so nodes stay in the cache and '
    "the figure shows traversal work alone; the other rows include memory.",
    (
        Grid(
            "rays, query",
            {
                f"{rays}, {query} hit": {"rays": rays, "query": query}
                for rays in ("primary", "diffuse", "diffuse, sorted", "diffuse, few")
                for query in ("any", "closest")
            },
            (
                GridColumn("exponent", Figure("exponent", {"renderer": "ours"})),
                GridColumn("ten times the triangles", Figure(_GROWTH, {"renderer": "ours"}, 3, at_most="target")),
                GridColumn("exponent, Embree", Figure("exponent", {"renderer": "embree"})),
                GridColumn("ten times, Embree", Figure(_GROWTH, {"renderer": "embree"}, 3)),
            ),
            "triangles: growth",
        ),
        Text(
            "Targets: a ray takes at most {target} times as long with ten times the triangles, and the tree at most "
            "{most} bytes a triangle; it takes {bytes}. Exponents of growth: of building over triangles {build} "
            "(Embree {embree}), of a frame over lights {lights}, of a frame over pixels {pixels}, of bakes over "
            "samples {samples}. {threads} threads render {faster} times as fast as one.",
            {
                "target": Figure("target", {"renderer": "ours"}),
                "most": Figure("target", table="triangles: memory", digits=3),
                "bytes": Figure("bytes a triangle", table="triangles: memory"),
                "build": Figure("exponent", {"renderer": "ours", "what": _BUILD}, table="triangles: build growth"),
                "embree": Figure("exponent", {"renderer": "embree", "what": _BUILD}, table="triangles: build growth"),
                "lights": Figure("exponent", {"what": "frame cost s"}, table="lights: growth"),
                "pixels": Figure("exponent", {"what": "frame cost s"}, table="pixels: growth"),
                "samples": Figure("exponent", {"what": "bake cost s"}, table="bake samples: growth"),
                "threads": Figure("threads used", {"work": "path-traced frame", "threads used": 2}, table="threads"),
                "faster": Figure("speed-up", {"work": "path-traced frame", "threads used": 2}, 3, table="threads"),
            },
            "triangles: growth",
        ),
    ),
)

REGIONS = {"scaling": _SCALING}
