"""Frames over the number of lights, of pixels and of threads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import fields, is_dataclass
from functools import partial
from multiprocessing import get_context
from typing import Any

import numpy as np
import warp as wp

import warp_gi as gi
from warp_gi import launch
from warp_gi.bench.harness import catalogue
from warp_gi.bench.harness.measure import PeakMemory, Row, Taken, ratio_and_spread, take_turns, timed
from warp_gi.bench.harness.places import PLACES
from warp_gi.bench.suites.scaling.fits import Growth
from warp_gi.bench.suites.scaling.mesh import HALL_VIEW, lamp_hall
from warp_gi.cli.report import start_warp

SCENE = "atrium"
SHAPE = 16 / 9
LIGHTS, QUICK_LIGHTS = (10, 100, 1_000, 10_000, 100_000), (10, 100, 1_000)
LIGHT_SIZE, QUICK_LIGHT_SIZE = (160, 90), (80, 45)
LIGHT_TURNS, QUICK_LIGHT_TURNS = 8, 4
BASELINES = {"PowerLights": gi.PowerLights(), "LightHierarchy": gi.LightHierarchy()}
"""Names of the ways to select lights that techniques are compared with."""
MEGAPIXELS, QUICK_MEGAPIXELS = (0.1, 0.3, 1.0, 2.0, 4.0, 8.0), (0.03, 0.3)
BASE = "path"
"""Name of the preset that techniques are compared with."""
MANY_PIXELS = 1.5
"""Megapixels from which on a frame is measured once in place of PIXEL_TURNS times."""
PIXEL_TURNS = 3
THREAD_SIZE, QUICK_THREAD_SIZE = (240, 135), (80, 45)
THREAD_BAKE = gi.VisibilityField(samples=160_000)
THREAD_TURNS, QUICK_THREAD_TURNS = 5, 3


# ---- lights ----


def emitters() -> dict[str, gi.Estimator]:
    """Return the baselines and the techniques that select lights, by name."""
    added = [getattr(module, "EMITTERS", {}) for _, module in catalogue.modules("scaling")]
    return {name: one for group in (BASELINES, *added) for name, one in group.items()}


def light_rows(quick: bool, device: str) -> list[Row]:
    """Return rows of the path tracer with each way to select lights, by the number of lights, and of their growth."""
    counts, size, turns = (
        (QUICK_LIGHTS, QUICK_LIGHT_SIZE, QUICK_LIGHT_TURNS) if quick else (LIGHTS, LIGHT_SIZE, LIGHT_TURNS)
    )
    return light_rows_of(counts, size, turns, device)


def light_rows_of(counts: Sequence[int], size: tuple[int, int], turns: int, device: str) -> list[Row]:
    """Return the rows for halls of ``counts`` lights; their frames take turns."""
    camera = HALL_VIEW.at_resolution(*size)
    pipelines = {name: gi.Pipeline.preset("path", spp=1, emitters=one) for name, one in emitters().items()}
    for pipeline in pipelines.values():
        gi.FrameScheduler(lamp_hall(100), camera, pipeline, device).bake()  # loads what is needed
    schedulers: dict[tuple[str, int], gi.FrameScheduler] = {}
    starts: dict[tuple[str, int], Row] = {}
    for count in counts:
        scene, made = timed(partial(_loaded_hall, count, device))
        for name, pipeline in pipelines.items():
            schedulers[name, count] = scheduler = gi.FrameScheduler(scene, camera, pipeline, device)
            _, baked = timed(scheduler.bake)
            starts[name, count] = {"scene s": made[0], "start s": baked[0]}
    works = {f"{name} {count}": _frame_of(scheduler) for (name, count), scheduler in schedulers.items()}
    taken = take_turns(works, turns, device, keep=turns)
    rows: list[Row] = []
    for (name, count), scheduler in schedulers.items():
        rows.append({"table": "lights", "estimator": name, "lights": scheduler.scene.emitter_count})
        rows[-1] |= starts[name, count] | light_row(scheduler, taken[f"{name} {count}"])
    for name in pipelines:
        said = {"table": "lights: growth", "estimator": name, "what": "frame cost s"}
        rows.append(said | Growth.of(counts, [taken[f"{name} {count}"].counting for count in counts]).row())
        memory = [[row["lights MB"]] for row in rows if row.get("estimator") == name and "lights MB" in row]
        rows.append(said | {"what": "lights MB"} | Growth.of(counts, memory).row())
    return rows


def light_row(scheduler: gi.FrameScheduler, taken: Taken[np.ndarray]) -> Row:
    """Return what frames took, how noisy they are, and the memory that lights have in one more frame."""
    frame = scheduler.frame(len(taken.wall) + 1)
    row = taken.row("frame ") | {"relative error": noise(taken.results)}
    return row | {"lights MB": device_bytes(frame.data.emitters, frame.paths.lights.data) / 1e6}


def _loaded_hall(count: int, device: str) -> gi.Scene:
    """Return a hall with so many lights, its buffers on the device."""
    scene = lamp_hall(count)
    scene.data(device)
    return scene


def _frame_of(scheduler: gi.FrameScheduler) -> Callable[[int], np.ndarray]:
    """Return a function of a frame's number that renders the frame and returns its beauty."""
    return lambda index: scheduler.frame(index).numpy("beauty").copy()


def noise(pictures: Sequence[np.ndarray]) -> float:
    """Return the root of the mean squared error of one picture over the mean of all, from their scatter."""
    stack = np.array(pictures, np.float64)
    return float(np.sqrt(np.mean(np.var(stack, axis=0, ddof=1))) / np.mean(stack))


def device_bytes(*values: Any) -> int:
    """Return the bytes of the Warp arrays that kernel structs and dataclasses hold; shared ones count once."""
    found: dict[int, int] = {}

    def visit(value: Any) -> None:
        if isinstance(value, wp.array):
            found[value.ptr or 0] = value.capacity
        elif hasattr(value, "_cls"):
            for name in value._cls.vars:
                visit(getattr(value, name))
        elif is_dataclass(value):
            for field in fields(value):
                visit(getattr(value, field.name))

    for value in values:
        visit(value)
    return sum(found.values())


# ---- pixels ----


def presets() -> list[str]:
    """Return the names of the presets that are rendered at every size."""
    return [BASE, *(name for _, module in catalogue.modules("scaling") for name in getattr(module, "PIPELINES", ()))]


def pixel_rows(quick: bool, device: str) -> list[Row]:
    """Return rows of a frame at one sample a pixel by its number of pixels, and of their growth."""
    return pixel_rows_of(QUICK_MEGAPIXELS if quick else MEGAPIXELS, device)


def pixel_rows_of(sizes: Sequence[float], device: str) -> list[Row]:
    """Return the rows for pictures of ``sizes`` megapixels, each rendered in a process of its own.

    "bytes a pixel" are what the memory grows by between the two largest.
    """
    rows: list[Row] = []
    for preset in presets():
        seconds, peaks = [], []
        for size in sizes:
            with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
                work = process.submit(picture, preset, size, device, launch.thread_count())
                taken, peak = work.result()
            seconds.append([taken.cost])
            peaks.append([peak])
            row: Row = {"table": "pixels", "pipeline": preset, "Mpixels": size} | taken.row("frame ")
            rows.append(row | {"peak GB": peak / 1e9})
        said = {"table": "pixels: growth", "pipeline": preset}
        rows.append(said | {"what": "frame cost s"} | Growth.of(sizes, seconds).row())
        rows.append(said | {"what": "peak GB"} | Growth.of(sizes, peaks).row())
        slope = (peaks[-1][0] - peaks[-2][0]) / (sizes[-1] - sizes[-2]) / 1e6
        rows.append({"table": "pixels: memory", "pipeline": preset, "bytes a pixel": slope})
    return rows


def picture(preset: str, size: float, device: str, threads: int) -> tuple[Taken, float]:
    """Return what frames of ``size`` megapixels took, and the most bytes of memory.

    A pipeline that learns has one frame before those that count.
    """
    start_warp(device)
    launch.set_threads(threads)
    scene, camera = PLACES[SCENE].scene(), PLACES[SCENE].camera()
    pipeline = gi.Pipeline.preset(preset, spp=1)
    small = gi.FrameScheduler(scene, camera.at_resolution(32, 18), pipeline, device)
    for index in range(2):  # compiles
        render(small, index)
    peak = PeakMemory()
    scheduler = gi.FrameScheduler(scene, camera.at_resolution(*resolution_of(size)), pipeline, device)
    scheduler.bake()
    turns, learns = 1 if size > MANY_PIXELS else PIXEL_TURNS, bool(pipeline.services())
    taken = take_turns({"": lambda index: render(scheduler, index)}, turns, device, warm=learns)[""]
    return taken, peak.bytes


def resolution_of(size: float) -> tuple[int, int]:
    """Return width and height of a picture of ``size`` megapixels."""
    return round((size * 1e6 * SHAPE) ** 0.5), round((size * 1e6 / SHAPE) ** 0.5)


def render(scheduler: gi.FrameScheduler, index: int) -> None:
    """Render a frame and forget it."""
    scheduler.frame(index)


# ---- threads ----


def thread_rows(quick: bool, device: str) -> list[Row]:
    """Return rows of a frame and of a bake by the number of threads."""
    size, turns = (QUICK_THREAD_SIZE, QUICK_THREAD_TURNS) if quick else (THREAD_SIZE, THREAD_TURNS)
    return thread_rows_of(thread_counts(launch.thread_count()), size, turns, device)


def thread_counts(most: int) -> list[int]:
    """Return the powers of two below ``most``, and ``most``."""
    return [2**k for k in range(most.bit_length()) if 2**k < most] + [most]


def thread_rows_of(counts: Sequence[int], size: tuple[int, int], turns: int, device: str) -> list[Row]:
    """Return the rows for ``counts`` threads, the first of which is 1; they take turns."""
    if not launch.get_device(device).is_cpu:
        return [{"table": "threads", "skipped": f"threads are of the CPU, not of {device}"}]
    scene, camera = PLACES[SCENE].scene(), PLACES[SCENE].camera().at_resolution(*size)
    scheduler = gi.FrameScheduler(scene, camera, gi.Pipeline.preset("path", spp=4), device)
    works: dict[str, Callable[[int], Any]] = {
        "path-traced frame": lambda _: render(scheduler, 0),
        "visibility field's bake": lambda _: gi.bake(scene, THREAD_BAKE, device, camera_path=camera),
    }
    return [row for name, work in works.items() for row in speed_up_rows(name, work, counts, turns, device)]


def speed_up_rows(name: str, work: Callable[[int], Any], counts: Sequence[int], turns: int, device: str) -> list[Row]:
    """Return a row for each number of threads; speed-ups are of wall seconds."""

    def with_threads(count: int, turn: int) -> None:
        launch.set_threads(count)
        work(turn)

    before = launch.thread_count()
    try:
        taken = take_turns({str(count): partial(with_threads, count) for count in counts}, turns, device)
    finally:
        launch.set_threads(before)
    rows = []
    for count in counts:
        row: Row = {"table": "threads", "work": name, "threads used": count} | taken[str(count)].row()
        row |= ratio_and_spread("speed-up", taken["1"].wall, taken[str(count)].wall)
        rows.append(row | {"efficiency": row["speed-up"] / count})
    return rows
