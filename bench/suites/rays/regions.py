"""What documents show of the suite ``rays``."""

from __future__ import annotations

from warp_gi.bench.publish.figures import Figure, Grid, GridColumn, Headline, Region, Text
from warp_gi.bench.suites.rays.columns import COLUMNS

_MESHES = {name.capitalize(): name for name in ("living room", "sponza", "bistro", "dragon", "atrium", "street")}


def _hits(query: str) -> tuple[GridColumn, ...]:
    """Return the columns of a query: million rays a second, and over Embree's."""
    only = {"query": query}
    return (
        GridColumn(f"{query} hit, ours", Figure("ours Mrays/s", only, 3)),
        GridColumn("over Embree fast", Figure("ours / embree", only, 3, at_least=1.0)),
        GridColumn("over robust", Figure("ours / embree robust", only, 3, at_least=1.0)),
    )


_RAYS = Region(
    COLUMNS,
    "**Ray queries**, `warp-gi bench rays`, a million rays on one thread beside Embree 4 with trees of medium "
    "quality, its default, in its fast and in its robust (watertight, as ours is) mode. "
    "Million rays a second, and that over Embree's:",
    (
        Grid(
            "scene, rays",
            {
                f"{label}, {rays}": {"scene": scene, "rays": rays}
                for label, scene in _MESHES.items()
                for rays in ("diffuse", "primary")
            },
            (*_hits("any"), *_hits("closest")),
            "rays",
        ),
        Text(
            "{warp} times Warp's own queries; {threads} times as fast on two threads. Building takes {build} s where "
            "Embree takes {embree} s; {bytes} bytes a triangle. Large incoherent batches are traced in Morton order; "
            "in the order given, as a query inside a kernel is, the dragon's and Bistro's diffuse rays run at {order} "
            "of Embree's fast mode.",
            {
                "warp": Figure("ours / warp"),
                "threads": Figure("2 threads faster", digits=3),
                "build": Figure("ours build s", table="builds"),
                "embree": Figure("embree build s", table="builds"),
                "bytes": Figure("bytes a triangle", table="builds"),
                "order": Figure("in order / embree", {"scene": ("bistro", "dragon"), "rays": "diffuse"}, 3),
            },
            "rays",
        ),
    ),
)

REGIONS = {"rays": _RAYS}
HEADLINES = (
    Headline(
        COLUMNS,
        "TriangleBvh",
        "finds what rays hit",
        Text(
            "{fast} times as many rays per second as Embree 4's default tree, {robust} times as many as its watertight "
            "mode",
            {"fast": Figure("ours / embree"), "robust": Figure("ours / embree robust")},
            "rays",
        ),
        "path tracing",
        "path_tracing",
        is_base=True,
    ),
)
