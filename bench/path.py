"""Speed of the whole: path tracing and direct sky light beside Mitsuba 3 llvm_ad_rgb; first frames; memory.

``python -m warp_gi.bench.path [--quick]``. Both renderers get the same triangles, Lambert
materials without alpha masks, samples and depth, take turns in one process, and have
compiled before the clock starts. Both are unbiased (the tests see to that), so the error
of a picture is its scatter over repetitions with independent seeds.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi.bench import presets, runner
from warp_gi.bench.mitsuba_peer import PeerMissing, load_mitsuba, to_mitsuba
from warp_gi.metrics import RELATIVE_EPSILON

Row = dict[str, Any]
REPETITIONS = 6
CAMERA_SAMPLES = 8
"""Camera rays a pixel that our 64 samples share; Mitsuba's have one each."""


@dataclass(frozen=True)
class Case:
    """A picture that both renderers make."""

    name: str
    scene: Callable[[], gi.Scene]
    camera: gi.Camera
    max_depth: int
    files: tuple[str, ...]
    peer: dict[str, Any]
    """Mitsuba's integrator."""


def _path(depth: int) -> dict[str, Any]:
    return {"type": "path", "max_depth": depth, "rr_depth": 1000}


_BSDF_ONLY = {"type": "direct", "bsdf_samples": 1, "emitter_samples": 0}
_SPONZA, _LIVING_ROOM = ("crytek_sponza.glb",), ("living_room/living_room.obj",)
_COURTYARD = "environments/courtyard.exr"

_white_sponza = partial(presets.sponza, (1.0, 1.0, 1.0))
_lit_room, _open_room = partial(presets.living_room, lamp=True), partial(presets.living_room, lamp=False)

CASES = (
    Case("Sponza, white sky, depth 4", _white_sponza, presets.SPONZA_VIEW, 4, _SPONZA, _path(4)),
    Case("living room, lamp, depth 4", _lit_room, presets.LIVING_ROOM_VIEW, 4, _LIVING_ROOM, _path(4)),
    Case("Sponza, white sky, direct", _white_sponza, presets.SPONZA_VIEW, 2, _SPONZA, _BSDF_ONLY),
    Case("living room, white sky, direct", _open_room, presets.LIVING_ROOM_VIEW, 2, _LIVING_ROOM, _BSDF_ONLY),
    Case(
        "Sponza, courtyard sky, direct",
        partial(presets.sponza, presets.SCENES / _COURTYARD),
        presets.SPONZA_VIEW,
        2,
        (*_SPONZA, _COURTYARD),
        _path(2),
    ),
)


def run(quick: bool = False, device: str = "cpu") -> list[Row]:
    """Return rows of figures for each case, first frame and memory limit; ``quick`` takes a quarter of the pixels."""
    rows = [row for case in CASES for row in compare(case, quick, device)]
    return [*rows, *first_frames(device), *bistro_memory(device, quick)]


def pipeline(max_depth: int, spp: int) -> gi.Pipeline:
    """Return the path tracer with paths of at most ``max_depth`` edges; 2 is direct light."""
    indirect = gi.BsdfPaths(max_depth=max_depth) if max_depth > 2 else None
    return gi.Pipeline.preset("path", spp=spp, camera_samples=min(CAMERA_SAMPLES, spp), indirect=indirect)


def compare(case: Case, quick: bool, device: str) -> list[Row]:
    """Return a row of seconds and a row of errors for one case, at 64 samples a pixel."""
    missing = [name for name in case.files if not (presets.SCENES / name).exists()]
    if missing:
        return [{"case": case.name, "skipped": f"no {presets.SCENES / missing[0]}; set WARP_GI_SCENES"}]
    spp, size = 64, (240, 135) if quick else (480, 270)
    camera = case.camera.at_resolution(*size)
    scene = presets.peer_scene(case.scene(), diffuse=True, masks=False)
    scheduler = gi.FrameScheduler(scene, gi.CameraPath.still(camera), pipeline(case.max_depth, spp), device)
    renderers = {"ours": lambda i: scheduler.frame(i).numpy("beauty").copy()}
    rows: list[Row] = []
    try:
        mi = load_mitsuba()
        peer, integrator = to_mitsuba(scene, camera), mi.load_dict(case.peer)
        renderers["mitsuba"] = lambda i: np.array(mi.render(peer, integrator=integrator, spp=spp, seed=i))
    except PeerMissing as missing_peer:
        rows.append({"case": case.name, "skipped": str(missing_peer)})
    times, images = measure(renderers)
    mean = np.mean([x for name in images for x in images[name]], axis=0)
    speed: Row = {"case": case.name, "pixels": f"{size[0]}x{size[1]}", "spp": spp}
    error: Row = {"case": case.name}
    for name in renderers:
        speed[f"{name} wall s"], speed[f"{name} cpu s"] = times[name]
        variance = np.var(images[name], axis=0, ddof=1)
        error[f"{name} relMSE"] = float(np.mean(variance / (mean**2 + RELATIVE_EPSILON)))
    if "mitsuba" in renderers:
        speed["faster, wall"] = speed["mitsuba wall s"] / speed["ours wall s"]
        speed["faster, cpu"] = speed["mitsuba cpu s"] / speed["ours cpu s"]
        error["error ratio"] = error["ours relMSE"] / error["mitsuba relMSE"]
        error["faster at equal error, cpu"] = speed["faster, cpu"] / error["error ratio"]
        error["means differ"] = float(np.mean(images["ours"]) / np.mean(images["mitsuba"]) - 1)
    return [*rows, speed, error]


def measure(renderers: dict[str, Callable[[int], np.ndarray]]) -> tuple[dict[str, tuple[float, float]], dict[str, Any]]:
    """Return median (wall, CPU) seconds and all pictures of each renderer, which take turns."""
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in renderers}
    images: dict[str, list[np.ndarray]] = {name: [] for name in renderers}
    for name in renderers:
        renderers[name](0)  # compiles
    for index in range(1, REPETITIONS + 1):
        for name, render in renderers.items():
            time.sleep(0.2)  # lets the other's threads go to sleep
            wall, cpu = time.perf_counter(), time.process_time()
            images[name].append(render(index))
            times[name].append((time.perf_counter() - wall, time.process_time() - cpu))
    return {name: tuple(np.median(times[name], axis=0).tolist()) for name in renderers}, images


# ---- in processes of their own ----


def first_frames(device: str) -> list[Row]:
    """Return seconds from the start of Python to a finished 480x270 frame at 16 samples, cold and warm kernel cache."""
    rows = []
    for scene in ("atrium", "crytek_sponza.glb"):
        with tempfile.TemporaryDirectory() as cache:
            for state in ("cold", "warm"):
                row = _child(scene, (480, 270), 16, device, cache)
                rows.append({"case": f"first frame of {scene}, {state} kernel cache"} | row)
    return rows


def bistro_memory(device: str, quick: bool) -> list[Row]:
    """Return the peak resident memory of rendering the Bistro at 960x540."""
    row = _child("bistro_exterior.glb", (960, 540), 2 if quick else 16, device, None)
    return [{"case": "Bistro at 960x540"} | row]


def _child(scene: str, size: tuple[int, int], spp: int, device: str, cache: str | None) -> Row:
    if "." in scene and not (presets.SCENES / scene).exists():
        return {"skipped": f"no {presets.SCENES / scene}"}
    environment = dict(os.environ)
    if cache:
        environment["WARP_CACHE_PATH"] = cache
    started = time.time()
    arguments = [
        sys.executable,
        "-m",
        "warp_gi.bench.path",
        "--child",
        scene,
        str(size[0]),
        str(size[1]),
        str(spp),
        device,
    ]
    done = subprocess.run(arguments, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        return {"failed": (done.stderr.strip().splitlines() or ["no message"])[-1]}
    result = json.loads(done.stdout.strip().splitlines()[-1])
    finished = result.pop("finished")
    row = {"pixels": f"{size[0]}x{size[1]}", "spp": spp, "wall s": finished - started}
    row["start s"] = finished - started - result["scene s"] - result["frame s"]
    return row | result


def _child_main(scene: str, width: str, height: str, spp: str, device: str) -> None:
    import warp as wp

    wp.config.quiet = True
    wp.init()
    started = time.time()
    views = {
        "crytek_sponza.glb": presets.SPONZA_VIEW,
        "bistro_exterior.glb": gi.Camera.look_at((-40, 45, -60), (-10, 0, -10)),
    }
    if "." in scene:
        loaded = gi.load_scene(presets.SCENES / scene, environment=(1.0, 1.0, 1.0))
    else:
        loaded = gi.builtin_scene(scene)
    built = time.time()
    camera = views.get(scene) or next(iter(loaded.cameras.values()))
    camera = replace(camera, resolution=(int(width), int(height)))
    frame = next(iter(gi.render(loaded, camera, gi.Pipeline.preset("path", spp=int(spp)), device=device)))
    frame.numpy("beauty")
    finished = time.time()
    seconds = {"scene s": built - started, "frame s": finished - built}
    seconds |= {"compile s": frame.timings.get("compile", 0.0), "cpu s": time.process_time()}
    print(json.dumps({"finished": finished, **seconds, "peak GB": peak_memory() / 1e9}))


def peak_memory() -> float:
    """Return the most bytes of memory this process has had resident."""
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
        return 1024.0 * int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1])
    except (OSError, StopIteration):  # not Linux; a fork's getrusage may count its parent, which VmHWM does not
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0)


def main() -> None:
    """Print the rows, as tables and as lines of JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="a quarter of the pixels")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--child", nargs=5, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child:
        _child_main(*options.child)
        return
    rows = run(options.quick, options.device)
    runner.print_rows("path", rows)
    print(runner.json_lines("path", rows, options.quick, options.device), end="")


if __name__ == "__main__":
    main()
