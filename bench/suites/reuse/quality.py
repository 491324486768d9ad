"""Figure 8: errors and time of every combination of techniques for emitters and for indirect light, by scene."""

from __future__ import annotations

from typing import Any

import warp_gi as gi
from warp_gi.bench.harness.gallery import CLOSED, Gallery, PictureSet
from warp_gi.bench.harness.measure import Row, median_and_spread
from warp_gi.bench.harness.stages import Case
from warp_gi.bench.suites.reuse.views import (
    BISTRO,
    CORNELL,
    DRAGON,
    HALL,
    MEASURED,
    MINE,
    MINE_ONE_BOUNCE,
    SPHERES,
    WAREHOUSE,
    FrameRun,
    Truth,
    ratio,
    run_sequences,
)

EMITTERS: dict[str, type] = {
    "LightHierarchy": gi.LightHierarchy,
    "PowerLights": gi.PowerLights,
    "VisibilityLightCache": gi.VisibilityLightCache,
}
INDIRECT: dict[str, type] = {"BsdfPaths": gi.BsdfPaths, "GuidedPaths": gi.GuidedPaths}
BASELINE = "LightHierarchy + BsdfPaths"
CASES = (WAREHOUSE, MINE, MINE_ONE_BOUNCE, DRAGON, BISTRO, HALL, CORNELL, SPHERES)
QUICK_CASES = (WAREHOUSE, MINE, HALL)
TARGETS = (
    (WAREHOUSE.name, "emitters", "VisibilityLightCache + BsdfPaths", 1 / 8),
    (MINE.name, "indirect", "LightHierarchy + GuidedPaths", 1 / 10),
    (MINE_ONE_BOUNCE.name, "indirect", "LightHierarchy + GuidedPaths", 1 / 100),
)
LARGE, SMALL = (480, 270), (240, 135)
"""Pixels of the places that have targets, and of others: regions are finer where there are more samples."""
OURS = (
    "LightHierarchy + GuidedPaths",
    "VisibilityLightCache + BsdfPaths",
    "VisibilityLightCache + GuidedPaths",
)
WORST = 1.2
"""Target: largest ratio of an error of ours to the baseline's."""
PAPER = (
    ("(a) warehouse", "VLC: almost one order of magnitude below SLL and LH; CDQ: no real benefit"),
    ("(b) mine", "VLC: useless, its NEE has no sky; CDQ: much below BRDF sampling where the sun's spot lights"),
    ("(c) dragon under a cover", "VLC + CDQ: slightly better"),
)


def pipelines(**settings: Any) -> dict[str, gi.Pipeline]:
    """Return all six combinations; ``settings`` are those of paths."""
    return {
        f"{light} + {paths}": gi.Pipeline(
            emitters=EMITTERS[light](), indirect=INDIRECT[paths](**settings), spp=1, camera_samples=1
        )
        for light in EMITTERS
        for paths in INDIRECT
    }


def quality_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return rows of all combinations, of the targets, and what the paper says."""
    spp, frames, settled = (48, 14, 8) if quick else (96, 26, 16)
    rows: list[Row] = []
    for place in QUICK_CASES if quick else CASES:
        if place.missing:
            rows.append({"table": "combinations", "case": place.name, "skipped": place.missing})
            continue
        size = (120, 68) if quick else LARGE if place.name in {case for case, *_ in TARGETS} else SMALL
        rows += place_rows(place, size, spp, frames, settled, device, gallery)
    rows += target_rows(rows)
    return [*rows, *({"table": "combinations: paper", "case": case, "says": text} for case, text in PAPER)]


def place_rows(
    place: Case,
    size: tuple[int, int],
    spp: int,
    frames: int,
    settled: int,
    device: str,
    gallery: Gallery = CLOSED,
) -> list[Row]:
    """Return a row for each combination: mean errors of the frames from ``settled`` on, and their time."""
    scene, camera = place.scene(), place.camera().at_resolution(*size)
    truth = Truth(scene, camera, device, spp, settings=place.settings)
    runs = run_sequences(scene, camera, pipelines(**place.settings), frames, lambda index: truth, device)
    pictures = {name: run.frame.numpy("beauty") for name, run in runs.items()}
    gallery.add(PictureSet(f"{place.name}: frame {frames - 1}", truth.mean("beauty"), pictures))
    base = runs[BASELINE]
    rows = [
        combination_row(place.name, name, run, base, settled, device) | truth.quality(run.frame)
        for name, run in runs.items()
    ]
    return rows + [time_row(place.name, name, run, base, settled, device) for name, run in runs.items()]


def slower(run: FrameRun, baseline: FrameRun, first: int, device: str) -> float:
    """Return the time of a frame over the baseline's."""
    return run.cost(first, device) / max(baseline.cost(first, device), 1e-9)


def combination_row(case: str, name: str, run: FrameRun, baseline: FrameRun, first: int, device: str) -> Row:
    """Return errors of one combination, and beside the baseline's.

    "equal time" is error times time over the same of the baseline, as error falls with the number of samples; at equal
    error the ratio of times is the same, turned over.
    """
    row: Row = {"table": "combinations", "case": case, "combination": name}
    row |= {f"MSE {term}": run.error(term, first) for term in MEASURED}
    for term in MEASURED:
        row[f"{term} / baseline"] = ratio(run.error(term, first), baseline.error(term, first))
    for term in MEASURED:
        row[f"{term}, equal time"] = slower(run, baseline, first, device) * row[f"{term} / baseline"]
    return row | {"beauty, faster at equal error": 1.0 / max(row["beauty, equal time"], 1e-9)}


def time_row(case: str, name: str, run: FrameRun, baseline: FrameRun, first: int, device: str) -> Row:
    """Return wall milliseconds of one combination's frames, and what counts of them beside the baseline's."""
    row: Row = {"table": "combinations: time", "case": case, "combination": name}
    row |= {f"{part} ms": run.milliseconds(part, first) for part in ("preprocess", "paths", "learn")}
    row |= median_and_spread("frame wall s", [wall for wall, _ in run.times[first:]])
    row |= median_and_spread("frame cpu s", [cpu for _, cpu in run.times[first:]])
    return row | {"time / baseline": slower(run, baseline, first, device)}


def target_rows(rows: list[Row]) -> list[Row]:
    """Return targets beside the values that the rows of combinations have."""
    found = {(row["case"], row["combination"]): row for row in rows if "MSE beauty" in row}
    result: list[Row] = []

    def add(case: str, what: str, combination: str, term: str, target: float) -> None:
        row = found[case, combination]
        result.append({"table": "targets", "case": case, "term": term, "combination": what, "target": target})
        result[-1] |= {"equal samples": row[f"{term} / baseline"], "equal time": row[f"{term}, equal time"]}

    for case, term, combination, target in TARGETS:
        if (case, combination) in found:
            add(case, combination, combination, term, target)
    for case in dict.fromkeys(case for case, _ in found):
        ours = [name for name in OURS if (case, name) in found]
        for term in MEASURED:
            if ours:
                worst = max(ours, key=lambda name: found[case, name][f"{term} / baseline"])
                add(case, f"worst: {worst}", worst, term, WORST)
    return result
