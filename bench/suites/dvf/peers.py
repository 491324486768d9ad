"""Visibility fields beside Mitsuba at equal error, beside raw rays when they bake, and relighting a still camera."""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness import places, scatter, scenes
from warp_gi.bench.harness.measure import Row, Taken, in_process, peak_memory, take_turns
from warp_gi.bench.harness.stages import LAMBERT, Case, timed_bake
from warp_gi.bench.peers import mitsuba_peer
from warp_gi.bench.suites.dvf.views import CASES, QUICK_CASES, QUICK_SETTINGS, QUICK_SIZE, SIZE
from warp_gi.bench.suites.path import suite as path
from warp_gi.bench.suites.rays import suite as rays
from warp_gi.bvh import TriangleBvh
from warp_gi.scene import harmonics

SPP = 64
RMSE = 0.01
KINDS = ("wall", "cpu")
TARGETS = "4 / 2.5 / 1.8"
OURS: dict[str, Any] = {
    "field, map": gi.VisibilityField(),
    "field, harmonics": gi.VisibilityField(sky="harmonics"),
    "traced": gi.TracedEnvironment(),
}
MITSUBA = {
    "mitsuba, both": {"type": "direct", "bsdf_samples": 1, "emitter_samples": 1},
    "mitsuba, emitter": {"type": "direct", "bsdf_samples": 0, "emitter_samples": 1},
}
FLIGHT = Case("sponza_flight", "Sponza", materials=LAMBERT)


# ---- equal error ----


def smooth_sky(height: int = 64) -> gi.Environment:
    """Return a map of nine harmonics, of mean radiance 1 and nowhere below 0.1."""
    theta = np.arange(height) * np.pi / (height - 1)
    theta, phi = np.meshgrid(theta, (np.arange(2 * height) + 0.5) * np.pi / height, indexing="ij")
    directions = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1)
    coefficients = np.zeros((3, 9))
    coefficients[:, 0] = np.sqrt(4 * np.pi)
    coefficients[:, 1:] = [0.7, 0.3, 0.5, 0.1, -0.1, 0.2, 0.15, 0.1]
    coefficients[:, 1] *= [0.8, 1.0, 1.2]
    return gi.Environment(pixels=harmonics.basis(directions) @ coefficients.T, name="nine harmonics")


def sharp_sky() -> gi.Environment:
    """Return the courtyard, scaled to mean radiance 1."""
    sky = gi.Environment.load(scenes.SCENES / places.COURTYARD)
    return replace(sky, scale=1.0 / float(sky.mean_radiance.mean()))


def equal_error_rows(quick: bool, device: str) -> list[Row]:
    """Return rows of all renderers under a low-frequency sky and an all-frequency one."""
    rows: list[Row] = []
    size, repetitions = (QUICK_SIZE, path.QUICK_REPETITIONS) if quick else (SIZE, path.REPETITIONS)
    skies: dict[str, Callable[[], gi.Environment]] = {"low-frequency": smooth_sky, "courtyard": sharp_sky}
    for place in [case for case in QUICK_CASES if not case.missing][:1] if quick else CASES:
        for name, sky in skies.items():
            if why := place.missing or (places.missing([places.COURTYARD]) if name == "courtyard" else ""):
                rows.append({"table": "equal error", "case": place.name, "sky": name, "skipped": why})
                continue
            scene = scenes.peer_scene(place.scene(), diffuse=True, masks=False, emission=False)
            scene = gi.Scene(scene.nodes, [], sky(), scene.cameras, scene.name)
            rows += equal_error(place, scene, name, place.camera().at_resolution(*size), device, repetitions)
    return rows


def equal_error(
    place: Case,
    scene: gi.Scene,
    sky: str,
    camera: gi.Camera,
    device: str = "cpu",
    repetitions: int = path.REPETITIONS,
    with_mitsuba: bool = True,
) -> list[Row]:
    """Return a row for each renderer: seconds of whole frames, scatter, and what an RMSE of 0.01 would take.

    The harmonics are another sky than an all-frequency one, so they only take part under the low-frequency one.
    """
    renderers: dict[str, Callable[[int], np.ndarray]] = {}
    rows: list[Row] = []
    for name, estimator in OURS.items():
        if name != "field, harmonics" or sky == "low-frequency":
            if isinstance(estimator, gi.VisibilityField):
                estimator = replace(estimator, **place.settings)
            renderers[name] = _ours(scene, camera, estimator, device)
    if with_mitsuba:
        try:
            for name, integrator in MITSUBA.items():
                renderers[name] = mitsuba_peer.renderer(scene, camera, integrator, SPP)
        except mitsuba_peer.PeerMissing as missing:
            rows.append({"table": "equal error", "case": place.name, "sky": sky, "skipped": str(missing)})
    taken = take_turns(renderers, repetitions, device, keep=repetitions, pause=path.PAUSE, host=MITSUBA)
    return rows + equal_error_table(place.name, sky, taken)


def equal_error_table(case: str, sky: str, taken: Mapping[str, Taken[np.ndarray]]) -> list[Row]:
    """Return a row for each renderer that took turns; squared errors fall as 1/n, so errors at equal time follow.

    Equal time is that of tracing all.
    """
    pictures = {name: one.results for name, one in taken.items()}
    found = {name: scatter.errors(pictures, name) for name in pictures}
    factors = {name: (errors["RMSE"] / RMSE) ** 2 for name, errors in found.items()}
    peers = [name for name in taken if name in MITSUBA]
    best = {kind: min((factors[n] * taken[n].times[i] for n in peers), default=None) for i, kind in enumerate(KINDS)}
    rows: list[Row] = []
    for name, one in taken.items():
        row: Row = {"table": "equal error", "case": case, "sky": sky, "renderer": name, **one.row(), **found[name]}
        row["RMSE at equal time"] = row["RMSE"] * (one.cost / taken["traced"].cost) ** 0.5
        for kind, seconds in zip(KINDS, one.times, strict=True):
            row[f"{kind} s to {RMSE}"] = seconds * factors[name]
        for kind in KINDS if peers else ():
            row[f"times mitsuba, {kind}"] = best[kind] / row[f"{kind} s to {RMSE}"]
        if peers:
            row["targets"] = TARGETS
        row["mean / traced"] = float(np.mean(pictures[name]) / np.mean(pictures["traced"]))
        rows.append(row)
    return rows


def _ours(scene: gi.Scene, camera: gi.Camera, estimator: Any, device: str) -> Callable[[int], np.ndarray]:
    settings: dict[str, Any] = {"emitters": None, "indirect": None, "spp": SPP}  # camera samples: the default
    pipeline = gi.Pipeline(environment=estimator, **settings)
    scheduler = gi.FrameScheduler(scene, gi.CameraPath.still(camera), pipeline, device)
    return lambda index: scheduler.frame(index).numpy("beauty").copy()


# ---- bakes ----


def bake_rows(quick: bool, device: str) -> list[Row]:
    """Return the rate of the bake's rays beside raw any-hit rays, and what a flight through Sponza needs."""
    place = CASES[0]
    if place.missing:
        return [{"table": "bake rate", "case": place.name, "skipped": place.missing}]
    size, count = (QUICK_SIZE, 200_000) if quick else (SIZE, 1_000_000)
    camera = place.camera().at_resolution(*size)
    rate = bake_rate(place.name, place.scene(), camera, device, count, flight_field(quick))
    return [rate, flight_bake((96, 54) if quick else (960, 540), 4 if quick else 48, device, quick)]


def flight_field(quick: bool) -> gi.VisibilityField:
    """Return the field that is baked: the default, or a coarse one."""
    return gi.VisibilityField(**QUICK_SETTINGS if quick else {})


def bake_rate(
    name: str,
    scene: gi.Scene,
    camera: gi.Camera,
    device: str,
    count: int,
    field: gi.VisibilityField,
) -> Row:
    """Return million rays a second of a view's bake and of ``count`` cosine-distributed any-hit rays."""
    geometry = scene.data(device).geometry
    points, indices = geometry.points.numpy(), geometry.indices.numpy().reshape(-1, 3)
    tree = TriangleBvh(points, indices, device)
    origins, directions = rays.diffuse_rays(points, indices, count)
    raw = take_turns({"raw": lambda turn: tree.occluded(origins, directions).numpy()}, 3, device)["raw"]
    raw_wall, raw_cpu = raw.times
    timed_bake(scene, replace(field, samples=1), device, camera.at_resolution(16, 9))  # compiles
    bake, (wall, cpu) = timed_bake(scene, field, device, camera)
    traced = bake.counts["rays_traced"]
    row: Row = {"table": "bake rate", "case": name, "cells": bake.counts["cells"]}
    row |= {"rays asked": bake.counts["rays"], "rays traced": traced, "wall s": wall, "cpu s": cpu}
    row |= {"Mrays/wall s": traced / wall / 1e6, "raw Mrays/wall s": count / raw_wall / 1e6}
    row |= {"Mrays/cpu s": traced / max(cpu, 1e-9) / 1e6, "raw Mrays/cpu s": count / raw_cpu / 1e6}
    return row | {"bake / raw, cpu": row["Mrays/cpu s"] / row["raw Mrays/cpu s"]}


def flight_bake(size: tuple[int, int], frames: int, device: str, quick: bool = False) -> Row:
    """Return seconds, cells, memory and file size of the lazy bake of a flight through Sponza, in its own process."""
    row: Row = {"table": "flight bake", "case": FLIGHT.name, "pixels": f"{size[0]}x{size[1]}", "frames": frames}
    return row | in_process(["warp_gi.bench.suites.dvf.peers", *map(str, (*size, frames)), device, *["quick"] * quick])


def flight(size: tuple[int, int], frames: int) -> gi.CameraPath:
    """Return the path along Sponza's nave in so many frames."""
    nave = FLIGHT.path()
    return replace(nave, fps=(frames - 1) / nave.keys[-1].time, resolution=size)


def _child_main(width: str, height: str, frames: str, device: str, quick: str = "") -> None:
    import warp as wp

    wp.config.log_level = wp.LOG_WARNING
    wp.init()
    scene = FLIGHT.scene()
    scene.data(device)
    before = peak_memory()
    nave = flight((int(width), int(height)), int(frames))
    bake, (wall, cpu) = timed_bake(scene, flight_field(bool(quick)), device, nave)
    row: Row = {"wall s": wall, "cpu s": cpu, "peak GB": peak_memory() / 1e9, "peak GB before": before / 1e9}
    row |= {name: bake.counts[name] for name in ("cells", "rays", "rays_traced")}
    row["samples taken"] = bake.counts["samples"]
    with tempfile.TemporaryDirectory() as folder:
        row["file MB"] = bake.save(Path(folder) / "bake.safetensors").stat().st_size / 1e6
    print(json.dumps(row, default=float))


# ---- relighting ----


def relight_rows(quick: bool, device: str) -> list[Row]:
    """Return seconds of the sky light's stage in Sponza while the sky turns."""
    place = CASES[0]
    if place.missing:
        return [{"table": "relight", "case": place.name, "skipped": place.missing}]
    camera = place.camera().at_resolution(*(QUICK_SIZE if quick else SIZE))
    return relight(place.name, place.scene(), camera, device, 4 if quick else 8)


def relight(
    name: str, scene: gi.Scene, camera: gi.Camera, device: str = "cpu", frames: int = 8, cell_size: float = 0.0
) -> list[Row]:
    """Return seconds of the first frame and of later ones, with transfers kept and without."""
    rows = []
    for kept in (True, False):
        sky = smooth_sky()
        scene.environment = sky
        estimator = gi.VisibilityField(sky="harmonics", relight=kept, cell_size=cell_size)
        settings: dict[str, Any] = {"emitters": None, "indirect": None, "spp": SPP, "camera_samples": 1}
        pipeline = gi.Pipeline(environment=estimator, **settings)
        scheduler = gi.FrameScheduler(scene, gi.CameraPath.still(camera), pipeline, device)
        seconds = []
        for index in range(frames):
            scene.environment = sky.rotated(15.0 * index)
            seconds.append(scheduler.frame(index).timings["environment"])
        row: Row = {"table": "relight", "case": name, "relight": kept, "first wall s": seconds[0]}
        rows.append(row | {"later wall s": float(np.median(seconds[1:])), "frames": frames})
    return rows


if __name__ == "__main__":
    _child_main(*sys.argv[1:])
