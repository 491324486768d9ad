"""What documents show of the suite ``transfer``."""

from __future__ import annotations

from typing import Any

from warp_gi.bench.publish.figures import Figure, Grid, GridColumn, Headline, Region, Text
from warp_gi.bench.suites.transfer.columns import COLUMNS

_STAND_INS = {f"{name}, stand-in": {"case": name} for name in ("dragon", "TRM", "room", "plants")}
_SCENES = {"Sponza": {"case": "Sponza"}, "living room": {"case": "living room"}}
_BAKED = {"Sponza": {"case": "Sponza"}, "living room": {"case": "living room, white sky"}}
_STAGES = ("charts", "rays", "bounces")
_OWN, _PEERS = "paper, table 1: RTX 3090", "beside Mitsuba at equal error"
_REAL, _SKIES = "glossy: real sky", "errors: real skies"


def _ours(storage: str, form: str, **settings: Any) -> GridColumn:
    return GridColumn(f"{storage}, {form}", Figure("cpu ms", {"storage": storage, "form": form}, **settings))


def _theirs(storage: str, form: str) -> GridColumn:
    figure = Figure("paper ms", {"storage": storage, "form": form}, table=_OWN)
    return GridColumn(f"paper: {storage}, {form}", figure)


_PAPER = Region(
    COLUMNS,
    "**Radiance transfer textures, the paper's scenes**, `warp-gi bench transfer`. Stand-ins of as many triangles, CPU "
    "milliseconds of the glossy product at 960x540 without primary rays; the paper's are of frames at 1920x1080 on an "
    "RTX 3090. TP is its triple product, TPFL that with fixed light. At vertices colours are evaluated, and then "
    "interpolated, as in the paper.",
    (
        Grid(
            "scene",
            _STAND_INS,
            (
                GridColumn("triangles", Figure("triangles")),
                _ours("vertices", "TP"),
                _ours("vertices", "TPFL"),
                _ours("texture", "TP"),
                _ours("texture", "TPFL"),
                GridColumn(
                    "texture: TPFL over TP, times faster",
                    Figure("times TP, cpu", {"storage": "texture", "form": "TPFL"}, at_least="target"),
                ),
                *(_theirs(storage, form) for storage in ("vertices", "texture") for form in ("TP", "TPFL")),
            ),
            "paper, table 1: stand-ins",
        ),
        Text(
            "Rows of transfer take {vertices} MB at vertices and {texture} MB by textures.",
            {
                "vertices": Figure("MB", {"storage": "vertices"}),
                "texture": Figure("MB", {"storage": "texture"}),
            },
            "paper, table 2: stand-ins",
        ),
    ),
)

_VERTICES = Region(
    COLUMNS,
    "**Transfer at vertices and by textures**, `warp-gi bench transfer`: a court whose floor has two triangles under a "
    "texture and more under vertices; direct light of a smooth sky beside the path tracer, errors over the mean.",
    (
        Grid(
            "storage",
            {f"vertices, floor {n}x{n}": {"storage": "vertices", "size": f"{n}x{n}"} for n in (1, 4, 16, 64, 128)}
            | {f"texture of {n}": {"storage": "texture", "size": str(n)} for n in (128, 256, 512, 1024)},
            (
                GridColumn("MB", Figure("MB")),
                GridColumn("error, floor", Figure("floor rel")),
                GridColumn("error, all", Figure("rel")),
                GridColumn("FLIP", Figure("FLIP")),
            ),
            "vertices and textures",
        ),
        Text(
            "On the floor a texture of 256 is {few} times as exact as 16x16 vertices, and {none} times as a corner "
            "each. What is left above 512 is the noise of the bake's rays.",
            {
                "few": Figure("times better than 16x16", {"size": "256"}, at_least="target over 16x16"),
                "none": Figure("times better than 1x1", {"size": "256"}, at_least="target over 1x1"),
            },
            "vertices and textures",
        ),
    ),
)

_BAKE = Region(
    COLUMNS,
    "**Bakes of radiance transfer**, `warp-gi bench transfer`, in CPU seconds at default settings; charts are kept "
    "from one bake to the next, and told apart.",
    (
        Grid(
            "scene",
            _BAKED,
            (
                GridColumn("texels, sides", Figure("slots")),
                GridColumn("whole bake", Figure("cpu s", at_most="target cpu s")),
                *(GridColumn(stage, Figure(f"{stage} cpu s")) for stage in _STAGES),
                GridColumn("bounces, number", Figure("bounces")),
                GridColumn("charts anew", Figure("cpu s", table="bakes: charts")),
                GridColumn("file MB", Figure("file MB")),
            ),
            "bakes: whole, charts known",
        ),
        Text(
            "2^20 texels of 256 rays take {cpu} CPU s, {ns} ns a ray. Adaptive rays are {rays} a texel, with an error "
            "of T of {error}.",
            {
                "cpu": Figure("cpu s for 2^20 slots", at_most="target cpu s"),
                "ns": Figure("ns a ray"),
                "rays": Figure(
                    "rays a slot", {"rays": "defaults"}, at_most="target rays", table="bakes: adaptive rays"
                ),
                "error": Figure(
                    "rel error of T", {"rays": "defaults"}, at_most="target error", table="bakes: adaptive rays"
                ),
            },
            "bakes: 256 rays a slot",
        ),
    ),
)


def _less(part: str, way: str) -> Figure:
    return Figure(f"{part}: times less, cpu", {"way": way}, at_least=f"{part} target")


_FRAME = Region(
    COLUMNS,
    "**Frames by radiance transfer**, `warp-gi bench transfer`: direct light of the courtyard's sky at 960x540, as "
    "times less CPU than tracing 64 samples a pixel of the same light. TPFL has all light in the harmonics; with the "
    "sun apart a shadow ray is traced to it.",
    (
        Grid(
            "scene",
            _SCENES,
            (
                GridColumn("TPFL, ms", Figure("term cpu ms", {"way": "TPFL"})),
                GridColumn("the term alone", _less("term", "TPFL")),
                GridColumn("with primary rays", _less("with primary", "TPFL")),
                GridColumn("whole frame", _less("frame", "TPFL")),
                GridColumn("sun apart: term", Figure("term: times less, cpu", {"way": "TPFL and sun"})),
                GridColumn("sun apart, ratio form: term", Figure("term: times less, cpu", {"way": "ratio and sun"})),
                GridColumn("default: term", Figure("term: times less, cpu", {"way": "default"})),
                GridColumn("Lambert: term", Figure("term: times less, cpu", {"way": "diffuse"})),
                GridColumn("TPFL at 1920x1080, ms", Figure("term cpu ms", {"way": "TPFL"}, table="frames: 1920x1080")),
            ),
            "frames: beside 64 samples",
        ),
        Text(
            "Whole frames beside Mitsuba 3 (`scalar_rgb`, no LLVM) at equal error, Lambert, smooth sky: {times} times "
            "less CPU; beside tracing here {traced}.",
            {
                "times": Figure("transfer: times less, cpu", {"way": "Mitsuba scalar_rgb"}),
                "traced": Figure("transfer: times less, cpu", {"way": "traced"}),
            },
            _PEERS,
        ),
    ),
)

_ERROR = Region(
    COLUMNS,
    "**Errors of radiance transfer**, `warp-gi bench transfer`: a court of 4 m beside the path tracer, over the mean; "
    "the reference's noise is subtracted.",
    (
        Grid(
            "texels along a side",
            {str(n): {"resolution": n} for n in (48, 112, 256)},
            (
                GridColumn("texels a metre", Figure("texels a metre", {"term": "environment"})),
                GridColumn("direct", Figure("rel", {"term": "environment"}, at_most=0.1)),
                GridColumn("bias, %", Figure("bias, %", {"term": "environment"})),
                GridColumn("reflected before", Figure("rel", {"term": "indirect"})),
                GridColumn("its bias, %", Figure("bias, %", {"term": "indirect"})),
            ),
            "errors: resolution",
        ),
        Grid(
            "sky",
            {
                name: {"case": "court", "sky": name}
                for name in ("city", "courtyard", "forest", "interior", "night", "studio")
            }
            | {"courtyard, living room": {"case": "living room", "sky": "courtyard"}},
            (
                GridColumn("light of suns, %", Figure("share of suns", {"way": "sun apart"}, scale=100.0)),
                GridColumn("sun apart", Figure("rel", {"way": "sun apart"})),
                GridColumn("`sun=5`", Figure("rel", {"way": "sun apart from 5 means"})),
                GridColumn("all in harmonics", Figure("rel", {"way": "no sun apart"})),
                GridColumn("traced, 16 samples", Figure("rel", {"way": "traced, 16 samples"})),
                GridColumn("traced, 64 samples", Figure("rel", {"way": "traced, 64 samples"})),
            ),
            _SKIES,
        ),
        Grid(
            "roughness of white metal",
            {str(r): {"roughness": r} for r in (0.7, 0.6, 0.5)},
            (
                GridColumn("order 5", Figure("rel", {"order": 5}, at_most="target")),
                GridColumn("order 6", Figure("rel", {"order": 6})),
            ),
            "glossy: smooth sky",
        ),
        Text(
            "On the dragon under the courtyard's sky the ratio form has {half} at roughness 0.5 and {four} at 0.4, "
            "transfer alone {plain} and {plain_four}. Another smooth sky on the same bake has biases of {bias} %. Half "
            "precision costs {halves}, 16 components of 75 for bounces {components}.",
            {
                "half": Figure("rel", {"roughness": 0.5, "way": "ratio"}, at_most="target"),
                "four": Figure("rel", {"roughness": 0.4, "way": "ratio"}, at_most="target"),
                "plain": Figure("rel", {"roughness": 0.5, "way": "transfer"}),
                "plain_four": Figure("rel", {"roughness": 0.4, "way": "transfer"}),
                "bias": Figure("bias, %", table="errors: another smooth sky"),
                "halves": Figure("rel error of light", table="memory: halves"),
                "components": Figure("rel", {"components": 16}, table="memory: components of bounces"),
            },
            _REAL,
        ),
    ),
)

REGIONS = {
    "transfer paper": _PAPER,
    "transfer vertices": _VERTICES,
    "transfer bake": _BAKE,
    "transfer frame": _FRAME,
    "transfer error": _ERROR,
}
HEADLINES = (
    Headline(
        COLUMNS,
        "RadianceTransfer",
        "keeps in textures how light of any sky arrives at surfaces, and over others",
        Text(
            "{less} times less CPU time for the sky's light than 64 traced samples",
            {"less": Figure("term: times less, cpu", {"way": "TPFL"})},
            "frames: beside 64 samples",
        ),
        "radiance transfer",
        "radiance_transfer",
        "Sirikonda et al. 2022",
    ),
)
