"""The regions of the README that are made from results: which figures they show, and beside which words."""

from __future__ import annotations

from warp_gi.bench.publish_figures import Column, Figure, Grid, Region, Text
from warp_gi.bench.publish_techniques import DENOISERS, DVF, PROBES, REUSE

# ---- path ----

_PICTURES = (
    "Sponza, white sky, depth 4",
    "living room, lamp, depth 4",
    "Sponza, white sky, direct",
    "living room, white sky, direct",
    "Sponza, courtyard sky, direct",
)
_ATRIUM, _SPONZA = "first frame of atrium", "first frame of crytek_sponza.glb"
_COLD = (f"{_ATRIUM}, cold kernel cache", f"{_SPONZA}, cold kernel cache")
_WARM = (f"{_ATRIUM}, warm kernel cache", f"{_SPONZA}, warm kernel cache")

_PATH = Region(
    "path",
    (
        Text(
            "Pictures of {pixels} with {spp} samples a pixel:",
            {"pixels": Figure("pixels", {"case": _PICTURES}), "spp": Figure("spp", {"case": _PICTURES})},
        ),
        Grid(
            "picture",
            {case: {"case": case} for case in _PICTURES},
            (
                Column("ours, s", Figure("ours wall s")),
                Column("Mitsuba, s", Figure("mitsuba wall s")),
                Column("faster", Figure("faster, wall", digits=3, at_least=1.0)),
                Column("faster at equal error", Figure("faster at equal error, cpu", digits=3, at_least=1.0)),
                Column("mean off Mitsuba's, %", Figure("means differ", scale=100.0)),
            ),
        ),
        Text(
            "From the shell to the first finished frame of {pixels} at {spp} samples: Sponza {sponza} s, the atrium "
            "{atrium} s; {cold} s while kernels compile for the first time. Bistro at {large} peaks at {memory} GB.",
            {
                "pixels": Figure("pixels", {"case": _COLD + _WARM}),
                "spp": Figure("spp", {"case": _COLD + _WARM}),
                "sponza": Figure("wall s", {"case": f"{_SPONZA}, warm kernel cache"}),
                "atrium": Figure("wall s", {"case": f"{_ATRIUM}, warm kernel cache"}),
                "cold": Figure("wall s", {"case": _COLD}),
                "large": Figure("pixels", {"case": "Bistro at 960x540"}),
                "memory": Figure("peak GB", {"case": "Bistro at 960x540"}),
            },
        ),
    ),
)

# ---- rays ----

_MESHES = {"Living room": "living room", "Sponza": "sponza", "Bistro": "bistro", "Dragon": "dragon"}


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
        ),
        Text(
            "{warp} times Warp's own queries; {threads} times as fast on two threads. Building takes {build} s where "
            "Embree takes {embree} s; {bytes} bytes a triangle. Large incoherent batches are traced in Morton order; "
            "in the order given, as a query inside a kernel is, the dragon's and Bistro's diffuse rays run at {order} "
            "of Embree's fast mode.",
            {
                "warp": Figure("ours / warp"),
                "threads": Figure("2 threads faster", digits=3),
                "build": Figure("ours build s"),
                "embree": Figure("embree build s"),
                "bytes": Figure("bytes a triangle"),
                "order": Figure("in order / embree", {"scene": ("bistro", "dragon"), "rays": "diffuse"}, 3),
            },
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

REGIONS = {
    "path": _PATH,
    "rays": _RAYS,
    "dvf": DVF,
    "probes": PROBES,
    "denoisers": DENOISERS,
    "reuse": REUSE,
    "compile": _COMPILE,
    "sequence": _SEQUENCE,
}
