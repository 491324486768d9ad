"""Reads files that are named on stdin and says what became of each: a process of its own, which may die.

A line is "KIND PATH"; the answer is JSON with "outcome" (fine, refused, fault, nan) and "told". "peak" is in bytes.
"""

from __future__ import annotations

import json
import resource
import sys
import warnings
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
import test_forged_states
from test_forged_bakes import PIPELINES
from test_forged_states import PIPELINES as STATES

import warp_gi as gi
from warp_gi.cli.compare import read_image
from warp_gi.cli.inputs import overview
from warp_gi.errors import GiError
from warp_gi.scene.files import images

STILL = gi.Camera.look_at((0, 1, 3.2), (0, 1, 0), resolution=(8, 6))
_kept: dict[str, object] = {}


def box() -> gi.Scene:
    scene = gi.builtin_scene("cornell_box")
    scene.environment = 1.0
    return scene


def picture(scene: gi.Scene, camera: gi.Camera) -> np.ndarray:
    frame = next(gi.render(scene, camera, gi.Pipeline(spp=1)))
    return np.concatenate([frame.numpy(name).ravel() for name in ("beauty", "albedo", "depth")[:2]])


def as_scene(path: Path) -> np.ndarray:
    scene = gi.load_scene(path, environment=1.0)
    for name in [*scene.cameras][:1]:
        gi.CameraPath.from_scene(scene, name).camera(0)
    return picture(scene, overview(scene, 60.0).at_resolution(8, 6))


def as_sky(path: Path) -> np.ndarray:
    scene = gi.builtin_scene("cornell_box")
    scene.environment = gi.Environment.load(path)
    return picture(scene, STILL)


def as_image(path: Path) -> np.ndarray:
    if path.suffix == ".exr":
        gi.read_frame(path)
    read_image(path)
    if path.suffix == ".png":
        images.read_image(path, str(path))
    return as_sky(path) if path.suffix != ".png" else np.zeros(1)


def as_camera(path: Path) -> np.ndarray:
    cameras = gi.CameraPath.load(path)
    scene = _kept.setdefault("box", box())
    shown = [cameras.at_resolution(8, 6).camera(index) for index in (0, 1, cameras.frame_count - 1)]
    return np.concatenate([picture(scene, camera) for camera in shown])


def as_bake(path: Path) -> np.ndarray:
    bake = gi.load_bake(path)
    pipeline = PIPELINES.get(bake.technique, PIPELINES["VisibilityField"])
    return next(gi.render(box(), STILL, pipeline, bakes=[bake])).numpy("beauty")


def as_state(path: Path, name: str) -> np.ndarray:
    scheduler = test_forged_states.scheduler_of(name)
    scheduler.load_state(path, "x")
    return scheduler.frame(2, 1).numpy("beauty")


READERS = {"scene": as_scene, "sky": as_sky, "image": as_image, "camera": as_camera, "bake": as_bake}
READERS |= {f"state-{name}": partial(as_state, name=name) for name in STATES}


def seeds(folder: Path) -> None:
    """Write a bake of each technique and states of several pipelines."""
    parts = [pipeline.environment for pipeline in PIPELINES.values()]
    parts += [pipeline.indirect for pipeline in PIPELINES.values()]
    parts += [getattr(part, "ends_in", None) for part in parts]
    for part in parts:
        name = type(part).__name__
        if name in PIPELINES:
            gi.bake(box(), part, camera=STILL).save(folder / f"{name}.bake.safetensors")
    for name in STATES:
        scheduler = test_forged_states.scheduler_of(name)
        for index in (0, 1):
            scheduler.frame(index)
        scheduler.save_state(folder / f"{name}.state.safetensors", "x")


def answer(kind: str, path: str) -> dict[str, object]:
    try:
        values = READERS[kind](Path(path))
    except (GiError, OSError, MemoryError) as error:
        told = str(error)
        return {"outcome": "fault" if "\n" in told else "refused", "told": f"{type(error).__name__}: {told[:300]}"}
    except BaseException as error:
        import traceback

        where = traceback.extract_tb(error.__traceback__)[-1]
        return {"outcome": "fault", "told": f"{type(error).__name__}: {error} ({where.filename}:{where.lineno})"[:500]}
    return {"outcome": "fine" if np.isfinite(values).all() else "nan", "told": ""}


def main() -> None:
    warnings.simplefilter("ignore")
    if len(sys.argv) > 1:
        seeds(Path(sys.argv[1]))
        return
    for line in sys.stdin:
        kind, _, path = line.rstrip("\n").partition(" ")
        result = answer(kind, path)
        result["peak"] = 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        sys.stdout.write("\x01" + json.dumps(result) + "\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
