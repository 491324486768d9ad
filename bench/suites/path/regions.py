"""What documents show of the suite ``path``."""

from __future__ import annotations

from warp_gi.bench.publish.figures import Figure, Grid, GridColumn, Headline, Region, Text
from warp_gi.bench.suites.path.columns import COLUMNS

_PICTURES = (
    "Sponza, white sky, depth 4",
    "living room, lamp, depth 4",
    "living room, lamp, direct",
    "Sponza, white sky, direct",
    "living room, white sky, direct",
    "Sponza, courtyard sky, direct",
    "atrium, its sky and lamps, depth 4",
    "Cornell box, emitters, direct",
)
_SCENES = (
    "lamps behind shades",
    "four plates, four lamps",
    "white room, one window",
    "wall of 3,200 lamps",
    "Veach's lamps",
    "living room, lamp",
    "modern hall",
)
_LLVM, _SCALAR = "mitsuba llvm_ad_rgb", "mitsuba scalar_rgb"


def _seconds(renderer: str, kind: str = "wall s") -> Figure:
    return Figure(kind, {"renderer": renderer}, table="equal samples")


def _off_reference(renderer: str) -> Figure:
    return Figure("means differ", {"renderer": renderer}, scale=100.0, table="beside the reference")


def _faster(header: str, key: str, peer: str) -> GridColumn:
    return GridColumn(header, Figure(key, {"peer": peer}, 3, at_least=1.0))


def _first(scene: str | tuple[str, ...], state: str) -> Figure:
    """Return the seconds to the first frame of a scene, or of several."""
    scenes = (scene,) if isinstance(scene, str) else scene
    only = {"case": tuple(f"first frame of {name}, {state} kernel cache" for name in scenes)}
    return Figure("wall s", only, table="first frame")


_PATH = Region(
    COLUMNS,
    "**Path tracing**, `warp-gi bench path`, beside Mitsuba 3's `llvm_ad_rgb` and `scalar_rgb`, as many samples of "
    'both, of which ours share camera rays. "Equal error" is the ratio of times to reach the same relMSE. The first '
    "table is of short paths between Lambert surfaces. The second is of paths of all lengths and the scenes' own "
    "materials, the first four of them scenes that are hard for path tracers; Mitsuba's roulette begins there at the "
    "depth that suits it best.",
    (
        Text(
            "Pictures of {pixels} with {spp} samples a pixel:",
            {k: Figure(k) for k in ("pixels", "spp")},
            "equal samples",
        ),
        Grid(
            "picture",
            {case: {"case": case} for case in _PICTURES},
            (
                GridColumn("ours, s", _seconds("ours")),
                GridColumn("Mitsuba LLVM, s", _seconds(_LLVM)),
                _faster("faster, wall", "faster, wall", _LLVM),
                _faster("at equal error, CPU", "faster at equal error, cpu", _LLVM),
                _faster("than scalar at equal error, CPU", "faster at equal error, cpu", _SCALAR),
                GridColumn("mean off Mitsuba's, %", Figure("means differ", {"peer": _LLVM}, scale=100.0)),
            ),
            "beside peers",
        ),
        Grid(
            "picture, all light",
            {case: {"case": case} for case in _SCENES},
            (
                GridColumn("ours, CPU s", _seconds("ours", "cpu s")),
                GridColumn("Mitsuba LLVM, CPU s", _seconds(_LLVM, "cpu s")),
                GridColumn("our squared error over its", Figure("error ratio", at_most=1.0)),
                _faster("faster, CPU", "faster, cpu", _LLVM),
                _faster("at equal error, CPU", "faster at equal error, cpu", _LLVM),
                GridColumn("mean off the reference's, %", _off_reference("ours")),
                GridColumn("Mitsuba's mean off it, %", _off_reference(_LLVM)),
            ),
            "beside peers",
        ),
        Text(
            "Over all {pictures} pictures Mitsuba's LLVM variant takes {least} to {most} times our CPU time at equal "
            "error, {mean} in the geometric mean.",
            {
                "pictures": Figure("pictures", {"peer": _LLVM}),
                "least": Figure("least", {"peer": _LLVM}, at_least=1.0),
                "most": Figure("most", {"peer": _LLVM}),
                "mean": Figure("geometric mean", {"peer": _LLVM}, at_least=1.0),
            },
            "over all pictures",
        ),
        Text(
            "From the shell to the first finished frame of {pixels} at {spp} samples: Sponza {sponza} s, the atrium "
            "{atrium} s; {cold} s while kernels compile for the first time. Bistro at {large} peaks at {memory} GB.",
            {
                "pixels": Figure("pixels"),
                "spp": Figure("spp"),
                "sponza": _first("crytek_sponza.glb", "warm"),
                "atrium": _first("atrium", "warm"),
                "cold": _first(("crytek_sponza.glb", "atrium"), "cold"),
                "large": Figure("pixels", table="memory"),
                "memory": Figure("peak GB", table="memory"),
            },
            "first frame",
        ),
    ),
)

REGIONS = {"path": _PATH}
HEADLINES = (
    Headline(
        COLUMNS,
        "BsdfPaths",
        "the reference path tracer, checked against Mitsuba 3",
        Text(
            "Mitsuba's LLVM variant takes {least} to {most} times its CPU time at equal error, {mean} in the geometric "
            "mean of {pictures} pictures",
            {
                "least": Figure("least", {"peer": _LLVM}),
                "most": Figure("most", {"peer": _LLVM}),
                "mean": Figure("geometric mean", {"peer": _LLVM}),
                "pictures": Figure("pictures", {"peer": _LLVM}),
            },
            "over all pictures",
        ),
        "path tracing",
        "path_tracing",
        is_base=True,
    ),
)
