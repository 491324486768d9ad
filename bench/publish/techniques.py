"""The regions of the README that show what the techniques gain: visibility fields, probes, denoisers, reuse."""

from __future__ import annotations

from warp_gi.bench.publish.figures import Column, Figure, Grid, Only, Region, Text

# ---- dvf ----

_VIEWS: dict[str, Only] = {
    "Sponza": {"case": "Sponza"},
    "atrium": {"case": "atrium"},
    "Bistro from above": {"case": "Bistro"},
    "street from its ground": {"case": "street"},
}
_OVER_MITSUBA = 1.8
"""The least that ``dvf_peers.TARGETS`` asks for."""


def _mode(header: str, key: str, mode: str = "three_state", **settings: object) -> Column:
    return Column(header, Figure(key, {"mode": mode}, **settings))


def _over_mitsuba(header: str, sky: str, renderer: str) -> Column:
    only = {"sky": sky, "renderer": renderer}
    return Column(header, Figure("times mitsuba, wall", only, at_least=_OVER_MITSUBA))


DVF = Region(
    "dvf",
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

# ---- probes ----

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


def _default(mode: str) -> tuple[Column, ...]:
    """Return the columns of a mode at default settings; a mean beyond the scene's target is bold."""
    only = {"mode": mode}
    return (
        Column(f"`{mode}`: mean", Figure("mean / paths", only, 3, at_least="least", at_most="most")),
        Column("RMSE / mean", Figure("RMSE / mean", only)),
        Column("µs a pixel", Figure("us a pixel", only)),
    )


def _indirect(header: str, least: float | str, **only: str) -> tuple[Column, ...]:
    """Return the columns of a mode; a mean that is off by more than a twentieth is bold."""
    return (
        Column(f"{header}: mean", Figure("mean / paths", only, 3, at_least=0.95, at_most=1.05)),
        Column("RMSE / mean", Figure("RMSE / mean", only)),
        Column("faster", Figure("faster, wall", only, at_least=least)),
    )


def _agree(texels: int) -> Column:
    return Column(f"{texels} texels a side", Figure("agree", {"resolution": texels}, 3, 100.0))


def _leak(weights: str, relocate: bool) -> Only:
    return {"weights": weights, "relocate": relocate}


def _dark(visibility: str) -> Figure:
    return Figure("dark / lit", {"visibility": visibility}, 2, 100.0, at_most="target", table=_DARK)


PROBES = Region(
    "probes",
    (
        Grid(
            "scene",
            _OWN_MATERIALS,
            (
                Column("probes", Figure("probes")),
                Column("bake, CPU s", Figure("bake cpu s", at_most="bake at most")),
                *_default("irradiance"),
                *_default("hybrid"),
                Column(
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
            "Of the rays through {probes} probes these end where the tree's do, in %, and so many million a second one "
            "thread marches:",
            {"probes": Figure("probes", {"probes": "4 x 4 x 4"})},
            "rays",
        ),
        Grid(
            "scene",
            {case: {"case": case, "probes": "4 x 4 x 4"} for case in ("Cornell box", "living room", "Sponza")},
            (
                *(_agree(texels) for texels in (64, 256, 1024)),
                Column("million a second, 256", Figure("Mrays/s", {"resolution": 256})),
                Column("of the tree's", Figure("of tree", {"resolution": 256})),
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

DENOISERS = Region(
    "probes",
    (
        Grid(
            "scene, rays a pixel",
            {
                f"{label}, {rays}": {"case": case, "pipeline": "paths", "rays a pixel": rays}
                for label, case in (("Cornell box", "cornell_box"), ("atrium", "atrium"))
                for rays in (1, 2, 8)
            },
            (
                Column("noisy", Figure("noisy RMSE")),
                Column("`spatiotemporal`", Figure("ST RMSE")),
                Column("`oidn`", Figure("OIDN RMSE")),
                Column("`spatiotemporal`, ms", Figure("ST ms")),
                Column("`oidn`, ms", Figure("OIDN ms")),
            ),
            "denoise",
        ),
    ),
)

# ---- reuse ----

_LEARNT = "VisibilityLightCache + GuidedPaths"


def _over_baseline(header: str, key: str, unless: Only | None = None) -> Column:
    return Column(header, Figure(key, {"combination": _LEARNT}, at_most=1.0), unless or {})


def _wanted(case: str, combination: str, digits: int) -> dict[str, Figure]:
    """Return what a target asks for and what was reached."""
    name, only = case.rpartition(", ")[2].replace(" ", "_"), {"case": case, "combination": combination}
    return {
        f"{name}_target": Figure("target", only, digits, table="targets"),
        f"{name}_reached": Figure("equal samples", only, table="targets", at_most="target"),
    }


def _pass_share(case: str) -> Figure:
    return Figure("share of the frame", {"case": case, "pass": "all"}, scale=100.0, table="passes")


def _settles(migrations: int) -> Figure:
    only = {"degrees": 36.0, "bits": 128, "migrations": migrations}
    return Figure("frames until settled", only, at_most="target", table="turning")


REUSE = Region(
    "reuse",
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
        Text(
            "Wanted were {warehouse_target} for the warehouse's emitters (the cache alone: {warehouse_reached}), "
            "{one_bounce_target} and {spot_target} for the mine's indirect light (guided paths alone: "
            "{one_bounce_reached} and {spot_reached}). The baseline is strong: in the warehouse, lights by power have "
            "{power} times its error in the emitters' term. At 640x360 learning takes {warehouse} % of a frame in the "
            "warehouse and {mine} % in the mine, and tracing {tracing} times as long as with the hierarchy (the paper: "
            "{paper_tracing}). After a turn of the light by 36 degrees quadtrees of 128 bits settle in {fast} frames, "
            "with one migration a frame in {slow} (the paper: {paper_turn}). A leaf's quadtree takes {leaf} KB.",
            {
                **_wanted("warehouse", "VisibilityLightCache + BsdfPaths", 3),
                **_wanted("mine, spot, one bounce", "LightHierarchy + GuidedPaths", 1),
                **_wanted("mine, spot", "LightHierarchy + GuidedPaths", 1),
                "power": Figure("emitters / baseline", {"case": "warehouse", "combination": "PowerLights + BsdfPaths"}),
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
