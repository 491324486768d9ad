"""The regions of the README that are made from results: which figures they show, and beside which words."""

from __future__ import annotations

from warp_gi.bench.publish.figures import Column, Figure, Grid, Region, Text
from warp_gi.bench.publish.techniques import DENOISERS, DVF, PROBES, REUSE

# ---- path ----

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
_LLVM, _SCALAR = "mitsuba llvm_ad_rgb", "mitsuba scalar_rgb"


def _seconds(renderer: str) -> Figure:
    return Figure("wall s", {"renderer": renderer}, table="equal samples")


def _faster(header: str, key: str, peer: str) -> Column:
    return Column(header, Figure(key, {"peer": peer}, 3, at_least=1.0))


def _first(scene: str | tuple[str, ...], state: str) -> Figure:
    """Return the seconds to the first frame of a scene, or of several."""
    scenes = (scene,) if isinstance(scene, str) else scene
    only = {"case": tuple(f"first frame of {name}, {state} kernel cache" for name in scenes)}
    return Figure("wall s", only, table="first frame")


_PATH = Region(
    "path",
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
                Column("ours, s", _seconds("ours")),
                Column("Mitsuba LLVM, s", _seconds(_LLVM)),
                _faster("faster, wall", "faster, wall", _LLVM),
                _faster("at equal error, CPU", "faster at equal error, cpu", _LLVM),
                _faster("than scalar at equal error, CPU", "faster at equal error, cpu", _SCALAR),
                Column("mean off Mitsuba's, %", Figure("means differ", {"peer": _LLVM}, scale=100.0)),
            ),
            "beside peers",
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

# ---- rays ----

_MESHES = {name.capitalize(): name for name in ("living room", "sponza", "bistro", "dragon", "atrium", "street")}


def _hits(query: str) -> tuple[Column, ...]:
    """Return the columns of a query: million rays a second, and over Embree's."""
    only = {"query": query}
    return (
        Column(f"{query} hit, ours", Figure("ours Mrays/s", only, 3)),
        Column("over Embree fast", Figure("ours / embree", only, 3, at_least=1.0)),
        Column("over robust", Figure("ours / embree robust", only, 3, at_least=1.0)),
    )


_RAYS = Region(
    "rays",
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

# ---- compile, sequence ----

_COMPILE = Region(
    "compile",
    (
        Text(
            "The first frame of the preset `path` needs {modules} kernel modules, {size} kB of objects. They take "
            "{cold} s to compile and load, {warm} s from the cache.",
            {
                "modules": Figure("modules"),
                "size": Figure("sum of object kB"),
                "cold": Figure("in one process, cold s"),
                "warm": Figure("in one process, warm s"),
            },
            "first frame",
        ),
    ),
)


_SEQUENCE = Region(
    "sequence",
    (
        Text(
            "{frames} frames of the atrium, {pixels}, {spp} samples a pixel, written files included:",
            {key: Figure(key) for key in ("frames", "pixels", "spp")},
            "speed",
        ),
        Grid(
            "pipeline",
            {name: {"pipeline": name} for name in ("path", "dvf", "probes", "reuse", "path, denoised")},
            (
                Column("frames a minute", Figure("frames a minute")),
                Column("bake, s", Figure("bake s", table="stages")),
                Column("trace, s a frame", Figure("trace s a frame", table="stages")),
                Column("peak GB", Figure("peak GB")),
                Column("memory grows, KB a frame", Figure("KB a frame", table="memory")),
            ),
            "speed",
        ),
        Text(
            "Blender Cycles {version} on the same CPU, {frames} frames of the {scene} at {pixels} with {spp} samples, "
            "Lambert materials, no denoiser: {ours} frames a minute beside its {theirs}, {faster} times as many; the "
            "mean is {mean} % off.",
            {
                "version": Figure("blender"),
                "frames": Figure("frames"),
                "scene": Figure("scene"),
                "pixels": Figure("pixels"),
                "spp": Figure("spp"),
                "ours": Figure("ours frames a minute"),
                "theirs": Figure("blender frames a minute"),
                "faster": Figure("faster", at_least=1.0),
                "mean": Figure("means differ", scale=100.0),
            },
            "Blender",
        ),
    ),
)

# ---- scaling ----

_GROWTH, _BUILD = "growth for ten times", "build cost s"

_SCALING = Region(
    "scaling",
    (
        Grid(
            "rays, query",
            {
                f"{rays}, {query} hit": {"rays": rays, "query": query}
                for rays in ("primary", "diffuse", "diffuse, sorted", "diffuse, few")
                for query in ("any", "closest")
            },
            (
                Column("exponent", Figure("exponent", {"renderer": "ours"})),
                Column("ten times the triangles", Figure(_GROWTH, {"renderer": "ours"}, 3, at_most="target")),
                Column("exponent, Embree", Figure("exponent", {"renderer": "embree"})),
                Column("ten times, Embree", Figure(_GROWTH, {"renderer": "embree"}, 3)),
            ),
            "triangles: growth",
        ),
        Text(
            "Wanted were {target} times for ten times the triangles, and at most {most} bytes for each: it is {bytes}. "
            "Exponents of the time to build {build} (Embree {embree}), of a frame over the number of lights {lights}, "
            "over pixels {pixels}; of bakes over samples {samples}. {threads} threads render {faster} times as fast.",
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

REGIONS = {
    "path": _PATH,
    "rays": _RAYS,
    "dvf": DVF,
    "probes": PROBES,
    "denoisers": DENOISERS,
    "reuse": REUSE,
    "compile": _COMPILE,
    "sequence": _SEQUENCE,
    "scaling": _SCALING,
}
