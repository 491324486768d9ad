"""Visibility fields: tracing the sky's light with and without them, what settings do, equal error, bakes.

Field and baseline (``mode="traced"``) are one kernel with the same rays, so
a ratio is what the field saves and a difference of their pictures is its error. Seconds are of the sky light's stage
alone, primary rays apart, except where a row says otherwise. What the paper measured stands in columns of its own.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

from warp_gi.bench.harness.gallery import CLOSED, Gallery, PictureSet, run_parts
from warp_gi.bench.harness.measure import Row, Taken, attempt, ratios
from warp_gi.bench.harness.stages import Case, race, rmse
from warp_gi.bench.suites.dvf import peers as dvf_peers
from warp_gi.bench.suites.dvf.views import CASES, QUICK_CASES, QUICK_SIZE, SIZE, FieldStage, FieldView, glossy, quality

SPP = 64
CARD = "RTX 3080"
PAPER = {"mode": "paper", "sky": "harmonics", "resolution": 18, "rays": 128, "dilation": 1, "samples": 10_000_000}
"""The paper's settings."""
QUICK_SAMPLES = 400_000
"""Surface samples that the quick form bakes with the paper's settings."""
PAPER_MS = {16: (6.69, 2.23), 32: (13.79, 4.02), 64: (27.28, 7.81), 128: (55.19, 15.74)}
"""The paper's table 1, Sponza at 1920x1080: milliseconds of a frame without and with the field, by samples a pixel."""
PAPER_GLOSSY_MS = {"Sponza": (54.64, 10.14), "Bistro": (48.75, 27.16)}
"""Milliseconds without and with the field on glossy surfaces: the paper's section 6 and figure 10."""
PAPER_KB = {"Sponza": 49_008, "Bistro": 173_958}
"""Size of the paper's dense fields, with cells of 0.5 and 1 m."""
MODES: dict[str, dict[str, Any]] = {
    "three_state": {"mode": "three_state"},
    "paper": {"mode": "paper", "sky": "harmonics"},
    "unbiased": {"mode": "unbiased"},
}


def run(quick: bool = False, device: str = "cpu", parts: Sequence[str] = (), gallery: Gallery = CLOSED) -> list[Row]:
    """Return rows of all tables; ``quick`` takes two scenes, coarse fields, few pixels and settings."""
    return run_parts(PARTS, parts, quick, device, gallery)


def case_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return the rows of every scene."""
    rows: list[Row] = []
    for case in QUICK_CASES if quick else CASES:
        said = {"table": "modes", "case": case.name}
        rows += attempt(said, partial(place_rows, case, quick, device, gallery))
    return rows


PARTS = {
    "modes": case_rows,
    "equal error": dvf_peers.equal_error_rows,
    "bakes": dvf_peers.bake_rows,
    "relight": dvf_peers.relight_rows,
}


def place_rows(place: Case, quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return the rows of one scene; sweeps are measured in Sponza alone."""
    if place.missing:
        return [{"table": "modes", "case": place.name, "skipped": place.missing}]
    camera = place.camera().at_resolution(*(QUICK_SIZE if quick else SIZE))
    view, repetitions = FieldView(place.scene(), camera, device, settings=place.settings), 2 if quick else 7
    rows = mode_rows(place.name, view, repetitions, place.target, quick, gallery)
    if place.name in PAPER_KB:
        rows += sample_count_rows(place.name, view, repetitions, quick)
        rows += glossy_rows(place.name, view, repetitions)
    if place.name == "Sponza":
        rows += sweep_rows(view, repetitions, quick)
    return rows


def as_paper(quick: bool) -> dict[str, Any]:
    """Return the paper's settings, with fewer surface samples for the quick form."""
    return PAPER | ({"samples": QUICK_SAMPLES} if quick else {})


def _faster(taken: Mapping[str, Taken[Any]], name: str) -> Row:
    return taken[name].row() | ratios("ratio {}", taken["traced"], taken[name])


def mode_rows(
    name: str, view: FieldView, repetitions: int, target: float, quick: bool = False, gallery: Gallery = CLOSED
) -> list[Row]:
    """Return a row for each mode at 64 samples a pixel, and one for all as in the paper."""
    stages: dict[str, FieldStage] = {"traced": view.stage(SPP, mode="traced")}
    stages |= {mode: view.stage(SPP, **settings) for mode, settings in MODES.items()}
    stages["paper, its settings"] = view.stage(SPP, **as_paper(quick))
    taken = race(stages, repetitions, view.device)
    rows: list[Row] = []
    for mode, stage in stages.items():
        if mode != "traced":
            row: Row = {"table": "modes", "case": name, "mode": mode, "traced s": taken["traced"].cost}
            rows.append(row | _faster(taken, mode) | {"target": target} | quality(stage, stages["traced"]))
    pictures = {mode: stage.picture for mode, stage in stages.items()}
    gallery.add(PictureSet(f"{name}: light of the sky, {SPP} samples a pixel", pictures.pop("traced"), pictures))
    return rows


def sample_count_rows(name: str, view: FieldView, repetitions: int, quick: bool) -> list[Row]:
    """Return table 1: seconds with and without the field by samples a pixel, with our defaults and the paper's."""
    rows: list[Row] = []
    for spp in (16, 64) if quick else PAPER_MS:
        stages = {"traced": view.stage(spp, mode="traced"), "field": view.stage(spp)}
        stages["paper, its settings"] = view.stage(spp, **as_paper(quick))
        taken = race(stages, repetitions, view.device)
        row: Row = {"table": "table 1", "case": name, "spp": spp}
        row |= taken["traced"].row("without ") | _faster(taken, "field")
        row["RMSE"] = rmse(stages["field"].picture, stages["traced"].picture)
        row["paper's method, ratio cpu"] = taken["traced"].cost / taken["paper, its settings"].cost
        rows.append(row)
        if name == "Sponza":
            without, with_ = PAPER_MS[spp]
            paper: Row = {"table": f"table 1: paper, {CARD}", "case": f"{name} 1920x1080", "spp": spp}
            rows.append(paper | {"without ms": without, "with ms": with_, "paper ratio": without / with_})
    return rows


def glossy_rows(name: str, view: FieldView, repetitions: int) -> list[Row]:
    """Return figure 10: the scene with every surface coated, in two modes, and what the paper says of it."""
    shiny, rows = view.with_scene(glossy(view.scene)), []
    stages = {"traced": shiny.stage(SPP, mode="traced")}
    stages |= {mode: shiny.stage(SPP, **MODES[mode]) for mode in ("three_state", "paper")}
    taken = race(stages, repetitions, view.device)
    for mode in ("three_state", "paper"):
        row = {"table": "glossy", "case": name, "mode": mode, "traced s": taken["traced"].cost} | _faster(taken, mode)
        rows.append(row | {"RMSE": rmse(stages[mode].picture, stages["traced"].picture)})
    without, with_ = PAPER_GLOSSY_MS[name]
    paper: Row = {"table": f"glossy: paper, {CARD}", "case": f"{name} 1920x1080", "without ms": without}
    return [*rows, paper | {"with ms": with_, "paper ratio": without / with_}]


def sweep_rows(view: FieldView, repetitions: int, quick: bool, spp: int = SPP) -> list[Row]:
    """Return a row for each value of the settings that the paper varies, and of the resolution of the masks."""
    numbers: tuple[int, ...] = (80_000, 400_000, 2_000_000, 10_000_000, 0)
    sizes: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0)
    resolutions: tuple[int, ...] = (36, 48, 72, 84, 96)
    if quick:
        numbers, sizes, resolutions = (80_000, 0), (2.0,), (48,)
    sweeps: list[tuple[str, str, dict[str, Any]]] = [
        ("samples", f"{number:,}" if number else "automatic", {"samples": number}) for number in numbers
    ]
    sweeps += [("cell size", f"{size:g} m", {"cell_size": size}) for size in sizes]
    sweeps.append(("resolution", "18, 128 rays", {"resolution": 18, "rays": 128, "dilation": 1}))
    sweeps += [("resolution", f"{resolution}", {"resolution": resolution}) for resolution in resolutions]
    traced, rows = view.stage(spp, mode="traced"), []
    for what, value, settings in sweeps:
        stage = view.stage(spp, **settings)
        bake, (wall, cpu) = view.bake(stage.estimator)
        row: Row = {"table": f"Sponza by {what}", what: value}
        row |= {"bake wall s": wall, "bake cpu s": cpu, "bake samples": bake.counts["samples"]}
        row |= {"cells": len(stage.state.cells), "MB": stage.memory / 1e6}
        row["MB of all cells"] = view.scene_memory(stage) / 1e6
        taken = race({"traced": traced, "field": stage}, repetitions, view.device)
        rows.append(row | _faster(taken, "field") | quality(stage, traced))
    paper = [
        {"table": f"Sponza by cell size: paper, {CARD}", "case": name, "paper MB": kb * 1024e-6}
        for name, kb in PAPER_KB.items()
    ]
    return rows + paper
