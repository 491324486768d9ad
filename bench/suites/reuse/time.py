"""How errors go over frames: from nothing (Fig. 9), after a light turned (Fig. 10), and under strobes (Fig. 13b)."""

from __future__ import annotations

from functools import partial

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness import scenes
from warp_gi.bench.harness.measure import Row
from warp_gi.bench.harness.stages import Case
from warp_gi.bench.suites.reuse.views import (
    RING,
    SEED,
    STROBE,
    TOLERANCE,
    WAREHOUSE,
    FrameRun,
    Truth,
    mean_series,
    ratio,
    run_sequences,
    settled_at,
    written,
)

LAST = 30
"""Number of the last frame whose error is measured."""
PAPER_ADAPTATION = {"first gain, frame": 1, "next gains, frame": 8, "refined until frame": 11}
PAPER_TURNING = {9.0: 10, 36.0: 20}
"""Frames until quadtrees of 128 bits have settled in the paper, by degrees of the turn."""
TARGET_TURNING = {1: 20, 8: 8}
"""Targets: frames until quadtrees of 128 bits have settled, by migrations a frame."""
BITS = (32, 64, 96, 128)


def _pipeline(emitters: gi.Estimator, indirect: gi.Estimator) -> gi.Pipeline:
    return gi.Pipeline(emitters=emitters, indirect=indirect, spp=1, camera_samples=1)


# ---- from nothing ----


def adaptation_rows(quick: bool, device: str) -> list[Row]:
    """Return how errors fall from an empty octree, cache and quadtrees in the warehouse."""
    size, spp, seeds = ((120, 68), 48, 2) if quick else ((240, 135), 192, 6)
    rows = place_adaptation(WAREHOUSE, size, spp, seeds, LAST, device)
    return [*rows, {"table": "adaptation: paper, figure 9", "case": "Quake 2 room", **PAPER_ADAPTATION}]


def place_adaptation(place: Case, size: tuple[int, int], spp: int, seeds: int, last: int, device: str) -> list[Row]:
    """Return a row for the emitters' term with the cache, and one for the indirect term with quadtrees."""
    scene, camera = place.scene(), place.camera().at_resolution(*size)
    truth = Truth(scene, camera, device, spp)
    choices = {
        "VisibilityLightCache + GuidedPaths": _pipeline(
            gi.VisibilityLightCache(rests=False), gi.GuidedPaths(rests=False)
        ),
        "baseline": _pipeline(gi.LightHierarchy(), gi.BsdfPaths()),
    }
    runs = [
        run_sequences(scene, camera, choices, last + 1, lambda index: truth, device, SEED + seed)
        for seed in range(seeds)
    ]
    rows: list[Row] = []
    for term in ("emitters", "indirect"):
        ours, base = (mean_series([run[name].errors[term] for run in runs]) for name in choices)
        at_last = ours[2 * len(ours) // 3 :]
        settled = float(at_last.mean())
        row: Row = {"table": "adaptation", "case": place.name, "term": term, "settled MSE": settled}
        row |= {"frame 0 / settled": ratio(float(ours[0]), settled), "settled from frame": settled_at(ours, at_last)}
        row |= {"target": 8, "settled / baseline": ratio(settled, float(base.mean()))}
        leaves = runs[0]["VisibilityLightCache + GuidedPaths"].scheduler.state("octree").leaf_count
        rows.append(row | {"leaves at last": leaves, "MSE / settled by frame": written(ours, settled)})
    return rows


# ---- a light that turns ----


def turning_rows(quick: bool, device: str) -> list[Row]:
    """Return how quadtrees follow a light that turns, by bits, migrations and degrees."""
    size, spp, seeds, before, after = ((48, 48), 256, 2, 16, 24) if quick else ((96, 96), 1024, 6, 32, 40)
    bits = (32, 128) if quick else BITS
    rows: list[Row] = []
    for turn in PAPER_TURNING:
        rows += turn_rows(turn, bits, size, spp, seeds, (before, after), device)
    for turn, frames in PAPER_TURNING.items():
        rows.append(
            {"table": "turning: paper, figure 10", "degrees": turn, "bits": 128, "frames until settled": frames}
        )
    return rows


def turn_rows(
    turn: float,
    bits: tuple[int, ...],
    size: tuple[int, int],
    spp: int,
    seeds: int,
    frames: tuple[int, int],
    device: str,
) -> list[Row]:
    """Return rows of one angle; the light turns after the first of the two numbers of ``frames``."""
    before, after = frames
    scene, camera = scenes.guiding_ring(turn, before), RING.camera().at_resolution(*size)
    truths = [Truth(scene, camera, device, spp, index) for index in (before - 1, before)]
    choices = {"baseline": _pipeline(gi.LightHierarchy(), gi.BsdfPaths())}
    for count in bits:
        for migrations in TARGET_TURNING:
            guided = gi.GuidedPaths(bits=count, migrations=migrations, rests=False)
            choices[f"{count} {migrations}"] = _pipeline(gi.LightHierarchy(), guided)
    runs = [
        run_sequences(
            scene, camera, choices, before + after, lambda index: truths[index >= before], device, SEED + seed
        )
        for seed in range(seeds)
    ]
    series = {name: mean_series([run[name].errors["indirect"] for run in runs]) for name in choices}
    base = float(series["baseline"].mean())
    rows: list[Row] = []
    for count in bits:
        for migrations, target in TARGET_TURNING.items():
            errors = series[f"{count} {migrations}"]
            at_first, later = float(errors[before // 2 : before].mean()), errors[before:]
            at_last = later[after // 2 :]
            settled = float(at_last.mean())
            row: Row = {"table": "turning", "degrees": turn, "bits": count, "migrations": migrations}
            row |= {"MSE before": at_first, "settled MSE": settled, "settled / BSDF": ratio(settled, base)}
            row |= {
                "peak / settled": ratio(float(later.max()), settled),
                "peak / BSDF": ratio(float(later.max()), base),
            }
            row |= {"frames until settled": settled_at(later, at_last), "target": target if count == 128 else ""}
            rows.append(row | {"MSE / settled by frame": written(later, settled)})
    return rows


# ---- light that changes fast ----


def strobe_rows(quick: bool, device: str) -> list[Row]:
    """Return errors over frames with a lamp that jumps in and out of a box, and one that passes slits."""
    size, spp, cycles = ((80, 45), 48, 2) if quick else ((120, 68), 192, 4)
    choices = {
        "VisibilityLightCache + GuidedPaths": _pipeline(
            gi.VisibilityLightCache(rests=False), gi.GuidedPaths(rests=False)
        ),
        "VisibilityLightCache + BsdfPaths": _pipeline(gi.VisibilityLightCache(rests=False), gi.BsdfPaths()),
        "baseline": _pipeline(gi.LightHierarchy(), gi.BsdfPaths()),
    }
    rows: list[Row] = []
    for kind in ("jump",) if quick else tuple(scenes.STROBE_PERIODS):
        series = strobe_series(kind, choices, size, spp, cycles, device)
        rows += [row for name in choices for row in strobe_kind_rows(kind, name, series)]
    return rows


def strobe_series(
    kind: str, choices: dict[str, gi.Pipeline], size: tuple[int, int], spp: int, cycles: int, device: str
) -> dict[str, np.ndarray]:
    """Return the beauty's errors by frame of the period, mean over ``cycles`` of them after a first."""
    period = scenes.STROBE_PERIODS[kind]
    scene, camera = scenes.strobe(kind), STROBE.camera().at_resolution(*size)
    make = partial(Truth, scene, camera, device, spp)
    truths: dict[int, Truth] = {}

    def truth(index: int) -> Truth:
        return truths.setdefault(scenes.strobe_place(kind, index), make(index))

    runs = run_sequences(scene, camera, choices, period * (cycles + 1), truth, device)
    return {name: _by_phase(run, period) for name, run in runs.items()}


def _by_phase(run: FrameRun, period: int) -> np.ndarray:
    return mean_series(np.asarray(run.errors["beauty"]).reshape(-1, period)[1:])


def strobe_kind_rows(kind: str, name: str, series: dict[str, np.ndarray]) -> list[Row]:
    """Return a row for each half of a "jump"'s period, or one for the whole of a "slit"'s."""
    errors, base = series[name], series["baseline"]
    half = len(errors) // 2
    parts = {"lamp out of the box": slice(0, half), "lamp into the box": slice(half, None)}
    if kind != "jump":
        parts = {"lamp passes slits": slice(None)}
    rows: list[Row] = []
    for case, part in parts.items():
        ours, theirs = errors[part], base[part]
        at_last = ours[3 * len(ours) // 4 :] if kind == "jump" else ours
        settled = float(at_last.mean())
        row: Row = {"table": "strobe", "case": case, "combination": name, "settled MSE": settled}
        row |= {"peak / settled": ratio(float(ours.max()), settled)}
        row |= {"frames until settled": settled_at(ours, at_last) if kind == "jump" else ""}
        row |= {"first frame / baseline": ratio(float(ours[0]), float(theirs[0]))}
        row |= {"mean / baseline": ratio(float(ours.mean()), float(theirs.mean()))}
        row["frames above baseline"] = int((ours > TOLERANCE * theirs).sum())
        rows.append(row | {"MSE / settled by frame": written(ours, settled)})
    return rows
