"""A small scene in which something moves, and all of its frames' buffers, for tests with processes and threads."""

from __future__ import annotations

import faulthandler
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.scene.model import Keyframe

FPS = 8
SIZE = (40, 30)
FIELD = gi.VisibilityField(cell_size=0.5, samples=400, rays=16)


def moving_room(seconds: float = 2.0) -> gi.Scene:
    """Return a Cornell box under a sky whose tall block turns and flies, and whose lamp sinks."""
    scene = gi.builtin_scene("cornell_box")
    scene.environment = (0.4, 0.5, 0.7)
    scene.animate("tall block", [Keyframe(0.0), Keyframe(seconds, (0.3, 0.5, 0.4), (0.0, 0.6, 0.0, 0.8))])
    scene.animate("lamp", [Keyframe(0.0), Keyframe(seconds, (0.0, -0.4, 0.0))])
    return scene


def still_path(scene: gi.Scene) -> gi.CameraPath:
    """Return a path of the scene's camera at rest, at ``FPS`` frames a second."""
    camera = scene.cameras["main"].at_resolution(*SIZE)
    return gi.CameraPath(gi.CameraPath.still(camera).keys, fps=FPS, resolution=SIZE)


def pipeline(preset: str = "path") -> gi.Pipeline:
    """Return a preset with two samples a pixel, and a visibility field that is baked soon."""
    made = gi.Pipeline.preset(preset, spp=2)
    return replace(made, environment=FIELD) if preset == "dvf" else made


def scheduler(scene: gi.Scene, preset: str = "path", seed: int = 1, **options: object) -> gi.FrameScheduler:
    """Return what renders the scene from its camera."""
    return gi.FrameScheduler(scene, still_path(scene), pipeline(preset), seed=seed, **options)


def buffers(frame: gi.Frame) -> dict[str, np.ndarray]:
    """Return copies of all buffers of a frame."""
    return {name: frame.numpy(name).copy() for name in frame.names}


def frames(scene: gi.Scene, indices: Iterable[int], preset: str = "path", seed: int = 1) -> list[dict[str, np.ndarray]]:
    """Return the buffers of frames that one scheduler renders one after the other."""
    renderer = scheduler(scene, preset, seed)
    return [buffers(renderer.frame(index)) for index in indices]


def differing(found: list[dict[str, np.ndarray]], wanted: list[dict[str, np.ndarray]]) -> list[str]:
    """Return which buffers of which frames differ in any bit."""
    assert len(found) == len(wanted)
    pairs = enumerate(zip(found, wanted, strict=True))
    return [f"{i}: {name}" for i, (a, b) in pairs for name in b if a[name].tobytes() != b[name].tobytes()]


def run_case(file: str, case: str, *more: str, seconds: float = 90.0) -> None:
    """Run a case of a test file in a process of its own; one that hangs is ended, with all it started, and fails."""
    command = [sys.executable, file, case, *more]
    tools = os.pathsep.join([os.path.dirname(__file__), os.environ.get("PYTHONPATH", "")]).rstrip(os.pathsep)
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": tools},
    )
    try:
        printed, _ = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        pytest.fail(f"{case} hangs: no end after {seconds:.0f} s\n{process.communicate()[0]}")
    assert process.returncode == 0, f"{case} ended with {process.returncode}\n{printed}"


def main(*cases: Callable[..., None]) -> None:
    """Run the case that the command line names; say where it is if it takes a minute."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs start with it ignored
    faulthandler.dump_traceback_later(60)
    {case.__name__: case for case in cases}[sys.argv[1]](*sys.argv[2:])
