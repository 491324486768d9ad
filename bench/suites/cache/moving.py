"""Caches in scenes that move: errors while a crate slides, a sky turns, and a lamp passes slats or vanishes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness import scenes
from warp_gi.bench.harness.measure import Row, attempt, median_and_spread
from warp_gi.bench.harness.path_views import SEED, mean_squared
from warp_gi.bench.harness.scenes import FPS, STROBE_PERIODS, light, quad, shapes
from warp_gi.bench.suites.cache.views import QUICK_SIZE, one_thread

MOVING = "moving"
SPP = 16
SIZE = (96, 64)
PATHS, CACHE = "paths", "cache"
ALL_ALONG = "all along"
TERM = gi.Pipeline(environment=None, emitters=None, camera_samples=1)


@dataclass(frozen=True)
class MovingCase:
    """A scene that moves, and the frames that are measured, by what is said of them."""

    name: str
    scene: Callable[[], gi.Scene]
    camera: Callable[[], gi.Camera | gi.CameraPath]
    frames: dict[str, tuple[int, ...]]
    reference_spp: int = 256


def sliding_crate() -> gi.Scene:
    """A closed room of 6 m with a lamp, through which a red crate slides and turns for 30 frames."""
    grey, red = (
        gi.Material(name, color, specular=0.0) for name, color in (("grey", (0.6,) * 3), ("red", (0.8, 0.2, 0.1)))
    )
    room = [shapes.box((-3, 0, -3), (3, 3, 3)).flipped().mesh(grey, "room")]
    room.append(quad((-0.4, 2.98, -0.4), (0.8, 0, 0), (0, 0, 0.8), light((12.0, 11.0, 10.0)), "lamp"))
    keys = []
    for frame in range(30):
        half = 0.05 * frame
        rotation = (0.0, float(np.sin(half)), 0.0, float(np.cos(half)))
        keys.append(gi.Keyframe(frame / FPS, (-1.8 + 0.15 * frame, 0.01, 0.0), rotation))
    crate = shapes.box((-0.6, 0, -0.6), (0.6, 1.2, 0.6)).mesh(red, "crate")
    return gi.Scene([gi.Node("room", room), gi.Node("crate", [crate], keyframes=keys)], name="crate")


def turning_atrium() -> gi.Scene:
    """The atrium under its sky, which turns by 20 degrees a second."""
    scene = gi.builtin_scene("atrium")
    assert scene.environment is not None
    scene.environment = gi.TurningSky(scene.environment, 20.0)
    return scene


def in_room() -> gi.Camera:
    """Return the camera of the rooms."""
    return gi.Camera.look_at((2.6, 1.6, 2.6), (-0.5, 1.0, -0.5), hfov=75)


_JUMP = STROBE_PERIODS["jump"] // 2
CASES = (
    MovingCase("crate slides", sliding_crate, in_room, {ALL_ALONG: (4, 8, 12, 16, 20)}),
    MovingCase("lamp behind slats", partial(scenes.strobe, "slit"), in_room, {ALL_ALONG: (4, 8, 12, 16, 20)}),
    MovingCase("sky turns", turning_atrium, partial(gi.builtin_camera_path, "atrium"), {ALL_ALONG: (4, 8, 12)}, 512),
    MovingCase(
        "lamp vanishes",
        partial(scenes.strobe, "jump"),
        in_room,
        {"before": (_JUMP - 1,), "that frame": (_JUMP,), "1 later": (_JUMP + 1,), "4 later": (_JUMP + 4,)},
    ),
)


def moving_rows(quick: bool, device: str) -> list[Row]:
    """Return the rows of every scene: of paths, and of paths that end in a cache."""
    rows: list[Row] = []
    for case in CASES[:1] if quick else CASES:
        size = QUICK_SIZE if quick else SIZE
        shown = replace(case, frames={ALL_ALONG: (2, 4)}, reference_spp=32) if quick else case
        rows += attempt({"table": MOVING, "case": case.name}, partial(case_rows, shown, size, device))
    return rows


def case_rows(case: MovingCase, size: tuple[int, int], device: str) -> list[Row]:
    """Return a row for each renderer and kind of frame; CPU seconds are of the samples that a frame adds to cells."""
    wanted = sorted(frame for frames in case.frames.values() for frame in frames)
    halves = [
        _pictures(case, size, device, replace(TERM, spp=case.reference_spp), wanted, wanted, SEED + 1 + half)[0]
        for half in range(2)
    ]
    rows: list[Row] = []
    for name, indirect in ((PATHS, gi.BsdfPaths()), (CACHE, gi.BsdfPaths(ends_in=gi.SurfaceCache()))):
        pipeline = replace(TERM, spp=SPP, indirect=indirect)
        every = range(wanted[-1] + 1) if name == CACHE else wanted
        with one_thread():
            pictures, seconds = _pictures(case, size, device, pipeline, every, wanted, SEED)
        for when, frames in case.frames.items():
            means, errors = [], []
            for frame in frames:
                truth = [half[frame] for half in halves]
                mean = float(np.mean(truth, dtype=np.float64))
                means.append(float(pictures[frame].mean(dtype=np.float64)) / mean)
                errors.append(mean_squared(pictures[frame], truth) / mean**2)
            said = case.name if when == ALL_ALONG else f"{case.name}: {when}"
            row: Row = {"table": MOVING, "case": said, "renderer": name, "spp": SPP}
            row |= {"mean / paths": float(np.mean(means)), "RMSE / mean": float(np.mean(errors)) ** 0.5}
            if name == CACHE:
                row |= median_and_spread("refresh s", seconds[1:])
            rows.append(row)
    return rows


def _pictures(
    case: MovingCase,
    size: tuple[int, int],
    device: str,
    pipeline: gi.Pipeline,
    frames: Sequence[int],
    kept: Sequence[int],
    seed: int,
) -> tuple[dict[int, np.ndarray], list[float]]:
    """Return pictures of the frames that are kept, and seconds that the cache took in each frame."""
    camera = case.camera().at_resolution(*size)
    scheduler = gi.FrameScheduler(case.scene(), camera, pipeline, device, seed)
    found: dict[int, np.ndarray] = {}
    seconds: list[float] = []
    for index in frames:
        frame = scheduler.frame(index)
        seconds.append(frame.timings.get("preprocess indirect.ends_in", 0.0))
        if index in kept:
            found[index] = frame.numpy("indirect")
    return found, seconds
