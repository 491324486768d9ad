"""Speed of the whole: path tracing and direct light beside Mitsuba 3, LLVM and scalar; first frames; memory.

All renderers get the same triangles, materials without alpha masks, samples and depth, take turns in one process with
as many threads, and have compiled before the clock starts. Our samples share camera rays, see ``CAMERA_SAMPLES``. All
are unbiased (the tests see to that), so the error of a picture is its scatter over repetitions with independent seeds.

``CASES`` are short paths between Lambert surfaces, which both of Mitsuba's variants render. ``SCENES`` are paths of all
lengths, and materials of the scenes' own; Mitsuba's roulette begins there at the depth at which its pictures cost it
least. What the scatter cannot tell, whether the renderers go to the same picture, is measured in them against a
reference of two independent halves.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi.bench.compare import reference
from warp_gi.bench.harness import scatter
from warp_gi.bench.harness.gallery import CLOSED, Gallery, PictureSet, run_parts
from warp_gi.bench.harness.measure import Row, Taken, attempt, in_process, peak_memory, ratios, take_turns
from warp_gi.bench.harness.places import PLACES
from warp_gi.bench.harness.scenes import REFERENCE_DEPTH
from warp_gi.bench.harness.stages import DARK, LAMBERT, PLAIN, Case
from warp_gi.bench.peers import mitsuba_peer
from warp_gi.bench.suites.path import truth

REPETITIONS, QUICK_REPETITIONS = 5, 2
SPP, QUICK_SPP = 64, 16
REFERENCE_SPP, QUICK_REFERENCE_SPP = 512, 64
SIZE, QUICK_SIZE = (320, 180), (160, 90)
PAUSE = 0.2
"""Seconds before a turn, in which the other renderer's threads go to sleep."""
OURS = "ours"
VARIANTS = (mitsuba_peer.LLVM, mitsuba_peer.SCALAR)
REFERENCE_SEED = 7
CAMERA_SAMPLES = 8
"""Camera rays a pixel that our 64 samples share; each of Mitsuba's samples has its own."""


@dataclass(frozen=True)
class Picture(Case):
    """A place that all renderers make a picture of."""

    max_depth: int = 2
    """Number of edges of the longest path from camera to light: 2 is direct light."""
    peer: Mapping[str, Any] = field(default_factory=dict)
    """Settings of Mitsuba's integrator."""
    variants: tuple[str, ...] = VARIANTS
    """Variants of Mitsuba; materials that are not Lambert are for LLVM alone."""
    has_reference: bool = False
    """Whether pictures are measured against a reference as well."""


def _path(depth: int, roulette: int = 1000) -> dict[str, Any]:
    return {"type": "path", "max_depth": depth, "rr_depth": roulette}


def _scene(place: str, name: str, roulette: int) -> Picture:
    """Return a picture of all light; Mitsuba's roulette from 2, 5, 8 or never: its error times its time is least so."""
    return Picture(
        place,
        name,
        materials=_OWN,
        max_depth=REFERENCE_DEPTH,
        peer=_path(REFERENCE_DEPTH, roulette),
        variants=(mitsuba_peer.LLVM,),
        has_reference=True,
    )


_BSDF_ONLY = {"type": "direct", "bsdf_samples": 1, "emitter_samples": 0}

_OPAQUE = {**LAMBERT, "masks": False}
_UNLIT = {**DARK, "masks": False}
_OWN = {**PLAIN, "masks": False}

CASES = (
    Picture("sponza", "Sponza, white sky, depth 4", materials=_OPAQUE, max_depth=4, peer=_path(4)),
    Picture("living_room", "living room, lamp, depth 4", materials=_OPAQUE, max_depth=4, peer=_path(4)),
    Picture("living_room", "living room, lamp, direct", materials=_OPAQUE, peer=_path(2)),
    Picture("sponza", "Sponza, white sky, direct", materials=_OPAQUE, peer=_BSDF_ONLY),
    Picture("living_room_white", "living room, white sky, direct", materials=_UNLIT, peer=_BSDF_ONLY),
    Picture("sponza_courtyard", "Sponza, courtyard sky, direct", materials=_OPAQUE, peer=_path(2)),
    Picture("atrium", "atrium, its sky and lamps, depth 4", materials=_OPAQUE, max_depth=4, peer=_path(4)),
    Picture("cornell_box", "Cornell box, emitters, direct", materials=_OPAQUE, peer=_path(2)),
)
QUICK_CASES = (CASES[0], CASES[2], CASES[5], CASES[7])
SCENES = (
    _scene("shaded_lamp", "lamps behind shades", 2),
    _scene("plates", "four plates, four lamps", 2),
    _scene("white_room", "white room, one window", 8),
    _scene("lamp_wall", "wall of 3,200 lamps", 5),
    _scene("veach_bidir", "Veach's lamps", 5),
    _scene("living_room", "living room, lamp", 5),
    _scene("modern_hall", "modern hall", 5),
)
QUICK_SCENES = SCENES[:4]
FIRST_FRAMES = {"atrium": "atrium", "crytek_sponza.glb": "sponza"}
"""Places whose first frame is timed, by their names in rows."""


def run(quick: bool = False, device: str = "cpu", parts: Sequence[str] = (), gallery: Gallery = CLOSED) -> list[Row]:
    """Return rows of figures for each case, first frame and memory limit; ``quick`` takes half of them, smaller."""
    rows = run_parts(PARTS, parts, quick, device, gallery)
    return rows + summary_rows(rows)


def case_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return the rows of all cases of short paths."""
    return _rows_of_all(QUICK_CASES if quick else CASES, quick, device, gallery)


def scene_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return the rows of all scenes with paths of all lengths."""
    return _rows_of_all(QUICK_SCENES if quick else SCENES, quick, device, gallery)


def _rows_of_all(cases: Sequence[Picture], quick: bool, device: str, gallery: Gallery) -> list[Row]:
    return [
        row for case in cases for row in attempt({"case": case.name}, partial(compare, case, quick, device, gallery))
    ]


def summary_rows(rows: Sequence[Row]) -> list[Row]:
    """Return for each peer how much less CPU time we take at equal error over all pictures that it made."""
    key = "faster at equal error, cpu"
    found: dict[str, list[float]] = {}
    for row in rows:
        if row.get("table") == "beside peers":
            found.setdefault(row["peer"], []).append(row[key])
    return [
        {
            "table": "over all pictures",
            "peer": peer,
            "pictures": len(values),
            "least": min(values),
            "geometric mean": float(np.exp(np.mean(np.log(values)))),
            "most": max(values),
        }
        for peer, values in found.items()
    ]


def pipeline(max_depth: int, spp: int) -> gi.Pipeline:
    """Return the path tracer with paths of at most ``max_depth`` edges; 2 is direct light."""
    indirect = gi.BsdfPaths(max_depth=max_depth) if max_depth > 2 else None
    return gi.Pipeline.preset("path", spp=spp, camera_samples=min(CAMERA_SAMPLES, spp), indirect=indirect)


def compare(case: Picture, quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return rows of one case at equal samples: each renderer's, at equal time and error, and beside peers."""
    if case.missing:
        return [{"case": case.name, "skipped": case.missing}]
    size, spp, repetitions = (QUICK_SIZE, QUICK_SPP, QUICK_REPETITIONS) if quick else (SIZE, SPP, REPETITIONS)
    scene, camera = case.scene(), case.camera().at_resolution(*size)
    scheduler = gi.FrameScheduler(scene, gi.CameraPath.still(camera), pipeline(case.max_depth, spp), device)
    renderers: dict[str, Callable[[int], np.ndarray]] = {
        OURS: lambda index: scheduler.frame(index).numpy("beauty").copy()
    }
    rows: list[Row] = []
    for variant in case.variants:
        try:
            renderers[f"mitsuba {variant}"] = mitsuba_peer.renderer(scene, camera, case.peer, spp, variant)
        except mitsuba_peer.PeerMissing as missing_peer:
            rows.append({"case": case.name, "skipped": str(missing_peer)})
    peers = [name for name in renderers if name != OURS]
    taken = take_turns(renderers, repetitions, device, keep=repetitions, pause=PAUSE, host=peers)
    pictures, name = {name: one.results for name, one in taken.items()}, f"{case.name}, {spp} samples a pixel"
    shown = {name: group[0] for name, group in pictures.items()}
    others = {name: group[1:] for name, group in pictures.items()}
    if not case.has_reference:
        gallery.add(PictureSet(name, scatter.mean_of(others).astype(np.float32), shown))
        return rows + rows_of(case.name, size, spp, taken)
    samples = QUICK_REFERENCE_SPP if quick else REFERENCE_SPP
    found = reference.computed(scene, camera, device, REFERENCE_SEED, samples, emitters=gi.LightHierarchy())
    gallery.add(PictureSet(name, found.picture.astype(np.float32), shown))
    true = truth.best(found, samples, pictures, spp)
    rows += rows_of(case.name, size, spp, taken, true)
    return rows + truth.rows_of(case.name, found, samples, pictures, true)


def rows_of(
    case: str,
    size: tuple[int, int],
    spp: int,
    taken: Mapping[str, Taken[np.ndarray]],
    true: np.ndarray | None = None,
) -> list[Row]:
    """Return rows of renderers that took turns, ours first: equal samples, equal time, equal error, and ratios.

    Relative errors are over ``true``, float [height, width, 3], or the mean of all pictures.
    """
    pictures = {name: one.results for name, one in taken.items()}
    about: Row = {"case": case, "pixels": f"{size[0]}x{size[1]}", "spp": spp}
    equal_samples = {
        name: {"table": "equal samples", **about, "renderer": name, **one.row(), **scatter.errors(pictures, name, true)}
        for name, one in taken.items()
    }
    ours, rows = equal_samples[OURS], list(equal_samples.values())
    for name, row in equal_samples.items():
        rows.append(_equal_time_row(case, name, row, taken[name].cost, taken[OURS].cost))
    for name, row in equal_samples.items():
        rows.append(_equal_error_row(case, name, row, ours["relMSE"]))
    for name in (name for name in taken if name != OURS):
        row = {"table": "beside peers", "case": case, "peer": name}
        row |= ratios("faster, {}", taken[name], taken[OURS])
        row |= scatter.error_ratio(pictures, OURS, name, true)
        for key in [key for key in row if key.startswith("faster, ") and not key.endswith("spread")]:
            row[key.replace("faster", "faster at equal error")] = row[key] / row["error ratio"]
        rows.append(row | {"means differ": float(np.mean(pictures[OURS]) / np.mean(pictures[name]) - 1)})
    return rows


def _equal_time_row(case: str, name: str, row: Row, seconds: float, ours: float) -> Row:
    """Return what a renderer makes of the seconds that our picture takes, by the law that squared errors fall as 1/n.

    Independent samples keep to it; ours are stratified and fall a little faster.
    """
    samples = ours / seconds
    found: Row = {
        "table": "equal time",
        "case": case,
        "renderer": name,
        "s": ours,
        "samples a pixel": row["spp"] * samples,
    }
    return found | {"RMSE": row["RMSE"] / samples**0.5, "relMSE": row["relMSE"] / samples}


def _equal_error_row(case: str, name: str, row: Row, target: float) -> Row:
    """Return what a renderer takes to get to our relMSE, by the same law."""
    samples = row["relMSE"] / target
    found: Row = {"table": "equal error", "case": case, "renderer": name, "relMSE": target}
    found["samples a pixel"] = row["spp"] * samples
    return found | {kind: row[kind] * samples for kind in ("wall s", "cpu s", "device s") if kind in row}


# ---- in processes of their own ----


def first_frames(quick: bool, device: str) -> list[Row]:
    """Return seconds from the start of Python to a finished frame at 16 samples, cold and warm kernel cache."""
    rows = []
    for scene, place in list(FIRST_FRAMES.items())[: 1 if quick else None]:
        with tempfile.TemporaryDirectory() as cache:
            for state in ("cold", "warm"):
                row = _child(place, QUICK_SIZE if quick else SIZE, 16, device, WARP_CACHE_PATH=cache)
                rows.append({"table": "first frame", "case": f"first frame of {scene}, {state} kernel cache"} | row)
    return rows


def bistro_memory(quick: bool, device: str) -> list[Row]:
    """Return the peak resident memory of rendering the Bistro at 960x540."""
    row = _child("bistro_wide", (960, 540), 2 if quick else 16, device)
    return [{"table": "memory", "case": "Bistro at 960x540"} | row]


def _child(place: str, size: tuple[int, int], spp: int, device: str, **variables: str) -> Row:
    if PLACES[place].missing:
        return {"skipped": PLACES[place].missing}
    started = time.time()
    row = in_process(["warp_gi.bench.suites.path.suite", place, *map(str, (*size, spp)), device], **variables)
    if "failed" in row:
        return row
    said = {"pixels": f"{size[0]}x{size[1]}", "spp": spp, "wall s": row.pop("finished") - started}
    return said | {"start s": said["wall s"] - row["scene s"] - row["frame s"]} | row


def _child_main(place: str, width: str, height: str, spp: str, device: str) -> None:
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    wp.init()
    started = time.time()
    loaded = PLACES[place].scene()
    built = time.time()
    camera = PLACES[place].camera().at_resolution(int(width), int(height))
    frame = next(iter(gi.render(loaded, camera, gi.Pipeline.preset("path", spp=int(spp)), device=device)))
    frame.numpy("beauty")
    finished = time.time()
    seconds = {"scene s": built - started, "frame s": finished - built}
    seconds |= {"compile s": frame.timings.get("compile", 0.0), "cpu s": time.process_time()}
    print(json.dumps({"finished": finished, **seconds, "peak GB": peak_memory() / 1e9}))


PARTS = {"pictures": case_rows, "scenes": scene_rows, "first frames": first_frames, "memory": bistro_memory}


if __name__ == "__main__":
    _child_main(*sys.argv[1:])
