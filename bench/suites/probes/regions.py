"""What documents show of the suite ``probes``."""

from __future__ import annotations

from warp_gi.bench.publish.figures import Figure, Grid, GridColumn, Headline, Only, Region, Text
from warp_gi.bench.suites.probes.columns import COLUMNS

_OWN_MATERIALS = {
    label: {"case": case}
    for label, case in (
        ("living room, white sky", "living room, white sky"),
        ("modern hall", "modern hall"),
        ("two rooms, the lit one", "two rooms, lit"),
        ("atrium", "atrium"),
        ("Sponza, courtyard sky", "Sponza, courtyard sky"),
        ("Sponza from a gallery, courtyard sky", "Sponza, gallery, courtyard sky"),
        ("Sponza across the floor, courtyard sky", "Sponza, floor, courtyard sky"),
        ("Sponza, white sky", "Sponza, white sky"),
        ("Sponza from a gallery, white sky", "Sponza, gallery, white sky"),
        ("Sponza across the floor, white sky", "Sponza, floor, white sky"),
    )
}
_DARK, _IRRADIANCE = "default settings: dark room of two", "default settings: irradiance at first hits"
_GRIDS = {
    f"{label}, {probes}": {"case": case, "probes": probes}
    for label, case, probes in (
        ("Cornell box", "Cornell box", "4 x 4 x 4"),
        ("Cornell box", "Cornell box", "8 x 8 x 8"),
        ("living room", "living room, all", "4 x 4 x 4"),
        ("living room", "living room, all", "8 x 4 x 8"),
        ("Sponza", "Sponza", "8 x 4 x 4"),
        ("Sponza", "Sponza", "12 x 6 x 6"),
    )
}


def _default(mode: str) -> tuple[GridColumn, ...]:
    """Return the columns of a mode at default settings; a mean beyond the scene's target is bold."""
    only = {"mode": mode}
    return (
        GridColumn(f"`{mode}`: mean", Figure("mean / paths", only, 3, at_least="least", at_most="most")),
        GridColumn("RMSE / mean", Figure("RMSE / mean", only)),
        GridColumn("µs a pixel", Figure("us a pixel", only)),
    )


def _indirect(header: str, least: float | str, **only: str) -> tuple[GridColumn, ...]:
    """Return the columns of a mode; a mean that is off by more than a twentieth is bold."""
    return (
        GridColumn(f"{header}: mean", Figure("mean / paths", only, 3, at_least=0.95, at_most=1.05)),
        GridColumn("RMSE / mean", Figure("RMSE / mean", only)),
        GridColumn("faster", Figure("faster, wall", only, at_least=least)),
    )


def _agree(texels: int) -> GridColumn:
    return GridColumn(f"{texels} texels a side", Figure("agree", {"resolution": texels}, 3, 100.0))


def _leak(weights: str, relocate: bool) -> Only:
    return {"weights": weights, "relocate": relocate}


def _dark(visibility: str) -> Figure:
    return Figure("dark / lit", {"visibility": visibility}, 2, 100.0, at_most="target", table=_DARK)


_PROBES = Region(
    COLUMNS,
    "**Light field probes**, `warp-gi bench probes`. First default settings and the scenes' own materials, 160x90; "
    '"mean" is the indirect term\'s over the path tracer\'s, "irradiance alone" the diffuse term at the same points. '
    'The second table is of 240x135 and Lambert materials; "faster" is the time that `BsdfPaths` needs to come as near '
    "to the truth (RMSE) over that of the probes, the indirect stage alone, 4 rays a pixel in `traced`.",
    (
        Grid(
            "scene",
            _OWN_MATERIALS,
            (
                GridColumn("probes", Figure("probes")),
                GridColumn("bake, CPU s", Figure("bake cpu s", at_most="bake at most")),
                *_default("irradiance"),
                *_default("hybrid"),
                GridColumn(
                    "irradiance alone: mean", Figure("mean / paths", {"visibility": "probes"}, 3, table=_IRRADIANCE)
                ),
            ),
            "default settings, the scenes' own materials",
        ),
        Text(
            "{black} % of the pixels are black where paths find light. The dark one of `two_rooms` has {dark} % of the "
            'light of the lit one, {exact} % with `visibility="exact"`; with {probes} probes for both it has {leaking} '
            "%, and would have {trilinear} % by trilinear weights. Lambert materials, {texels} texels a side, and rays "
            "through the probes as in the paper:",
            {
                "dark": _dark("probes"),
                "exact": _dark("exact"),
                "probes": Figure("probes", {"probes": "8 x 3 x 4"}),
                "leaking": Figure("dark / lit", {**_leak("visibility", True), "probes": "8 x 3 x 4"}, 2, 100.0),
                "trilinear": Figure("dark / lit", {**_leak("trilinear", False), "probes": "8 x 3 x 4"}, 2, 100.0),
                "black": Figure(
                    "black pixels", scale=100.0, at_most=0.0, table="default settings, the scenes' own materials"
                ),
                "texels": Figure("resolution", {"probes": "8 x 3 x 4"}),
            },
            "leaks: two_rooms",
        ),
        Grid(
            "scene, probes",
            _GRIDS,
            (
                *_indirect("`irradiance`", "target", mode="irradiance"),
                *_indirect("`traced`", 1.0, mode="traced", through="probes"),
                *_indirect("`traced` through the scene", 1.0, mode="traced", through="geometry"),
            ),
            "indirect light",
        ),
        Text(
            "Share of rays through {probes} probes that end where the BVH's do (%), and million rays marched per "
            "second on one thread:",
            {"probes": Figure("probes", {"probes": "4 x 4 x 4"})},
            "rays",
        ),
        Grid(
            "scene",
            {case: {"case": case, "probes": "4 x 4 x 4"} for case in ("Cornell box", "living room", "Sponza")},
            (
                *(_agree(texels) for texels in (64, 256, 1024)),
                GridColumn("million a second, 256", Figure("Mrays/s", {"resolution": 256})),
                GridColumn("of the tree's", Figure("of tree", {"resolution": 256})),
            ),
            "rays",
        ),
        Text(
            "Baking them takes {bake} s and {file} MB for 256 texels a side, {large} s and {large_file} MB for 1024 "
            "(the paper: {paper}); a refresh of the former {update} ms a probe.",
            {
                "bake": Figure("wall s", {"resolution": 256}),
                "file": Figure("MB", {"resolution": 256}),
                "large": Figure("wall s", {"resolution": 1024}),
                "large_file": Figure("MB", {"resolution": 1024}),
                "paper": Figure("all its scenes", table="bakes: paper, GeForce 1080"),
                "update": Figure("update ms a probe, wall", {"resolution": 256}),
            },
            "bakes",
        ),
    ),
)

_DENOISERS = Region(
    COLUMNS,
    "**Denoisers** on a moving camera, 480x270, preset `path`, FLIP of the eighth frame against many camera samples:",
    (
        Grid(
            "scene, rays a pixel",
            {
                f"{label}, {rays}": {"case": case, "pipeline": "paths", "rays a pixel": rays}
                for label, case in (("Cornell box", "cornell_box"), ("atrium", "atrium"))
                for rays in (1, 2, 8)
            },
            (
                GridColumn("noisy", Figure("noisy FLIP")),
                GridColumn("`spatiotemporal`", Figure("ST FLIP")),
                GridColumn("`oidn`", Figure("OIDN FLIP")),
                GridColumn("`spatiotemporal`, ms", Figure("ST ms")),
                GridColumn("`oidn`, ms", Figure("OIDN ms")),
            ),
            "denoise",
        ),
    ),
)

REGIONS = {"probes": _PROBES, "denoisers": _DENOISERS}


def _gain(case: str) -> Figure:
    """Return how many times lower the denoiser makes the error of one ray a pixel."""
    only = {"case": case, "pipeline": "paths", "rays a pixel": 1}
    return Figure("noisy FLIP", only, over="ST FLIP")


HEADLINES = (
    Headline(
        COLUMNS,
        "LightFieldProbes",
        "reads indirect light from a baked grid of probes",
        Text(
            "{faster} times less CPU time for diffuse indirect light than paths of the same error",
            {"faster": Figure("faster, cpu", {"mode": "irradiance"})},
            "indirect light",
        ),
        "light field probes",
        "light_field_probes",
        "McGuire et al. 2017",
    ),
    Headline(
        COLUMNS,
        "SpatioTemporal",
        "denoises over frames and neighbouring pixels",
        Text(
            "one ray a pixel: FLIP {least} times lower in the atrium, {most} times in the Cornell box",
            {"least": _gain("atrium"), "most": _gain("cornell_box")},
            "denoise",
        ),
        "denoising",
        "denoising",
        "Schied et al. 2017",
    ),
)
