"""Light field probes at default settings, in scenes with their own materials: the indirect term, and irradiance alone.

What a user gets: how far the term's mean and pixels are from the path tracer's, what a bake takes, and whether anything
is black. Errors of irradiance and of reflectance may cancel in the term, so irradiance is compared by itself, too.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_gi.bench.harness.gallery import CLOSED, Gallery, PictureSet
from warp_gi.bench.harness.measure import Row
from warp_gi.bench.harness.path_views import SEED, black_share, mean_squared
from warp_gi.bench.harness.stages import Case, Stage, race
from warp_gi.bench.suites.probes.irradiance import of_probes, path_traced
from warp_gi.bench.suites.probes.views import ProbeView, counts_of, room_views, view_of

TERM_TABLE = "default settings, the scenes' own materials"
DARK_TABLE = "default settings: dark room of two"
IRRADIANCE_TABLE = "default settings: irradiance at first hits"
MODES = ("irradiance", "hybrid")
SPP = 16
"""Samples a pixel, a pipeline's default; the mode "irradiance" traces them only where too few probes see a point."""
MOST_BAKE = 40.0
"""Largest number of CPU seconds that a bake may take."""
DARK_TARGETS = {"probes": 0.015, "exact": 0.006}
"""Targets for the light of the dark room over that of the lit one, by visibility."""


@dataclass(frozen=True)
class DefaultCase(Case):
    """A place with its own materials, and how far the mean of the indirect term may be from the path tracer's."""

    within: float = 0.08


ROOMS = DefaultCase("two_rooms", "two rooms, lit")
CASES = (
    DefaultCase("living_room_white"),
    DefaultCase("modern_hall"),
    ROOMS,
    DefaultCase("atrium", within=0.12),
    DefaultCase("sponza_courtyard", within=0.12),
    DefaultCase("sponza_gallery_courtyard", within=0.12),
    DefaultCase("sponza_floor_courtyard", within=0.12),
    DefaultCase("sponza", "Sponza, white sky", within=0.12),
    DefaultCase("sponza_gallery", "Sponza, gallery, white sky", within=0.12),
    DefaultCase("sponza_floor", "Sponza, floor, white sky", within=0.12),
)
QUICK_CASES = (DefaultCase("modern_hall"), ROOMS)


def default_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return rows of each place: of both modes, of the dark room beside the lit one, and of irradiance."""
    size, spp, repetitions = ((80, 45), 32, 1) if quick else ((160, 90), 256, 3)
    rows: list[Row] = []
    for case in QUICK_CASES if quick else CASES:
        if case.missing:
            rows.append({"table": TERM_TABLE, "case": case.name, "skipped": case.missing})
            continue
        views = room_views(size, device, spp) if case is ROOMS else {"": view_of(case, size, device, spp)}
        view = next(iter(views.values()))
        rows += term_rows(case, view, repetitions, gallery)
        rows += irradiance_rows(case, view)
        if case is ROOMS:
            rows += dark_rows(views)
    return sorted(rows, key=lambda row: (TERM_TABLE, DARK_TABLE, IRRADIANCE_TABLE).index(row["table"]))


def term_rows(
    case: DefaultCase, view: ProbeView, repetitions: int, gallery: Gallery = CLOSED, **settings: Any
) -> list[Row]:
    """Return the rows of the indirect term, one a mode; ``settings`` are those of the probes that are not defaults."""
    stages = {mode: view.stage(SPP, mode=mode, **settings) for mode in MODES}
    taken = race(stages, repetitions, view.device)
    pixels = float(np.prod(view.camera.resolution))
    rows: list[Row] = []
    for mode, stage in stages.items():
        bake_cpu = view.bake(stage.estimator)[1][1]
        row: Row = {"table": TERM_TABLE, "case": case.name, "mode": mode, "spp": stage.spp}
        row |= _grid_row(stage) | {"bake cpu s": bake_cpu, "bake at most": MOST_BAKE}
        row |= view.quality(stage.picture) | {"least": 1 - case.within, "most": 1 + case.within}
        row |= {"black pixels": black_share(stage.picture, view.reference)}
        rows.append(row | {"us a pixel": taken[mode].cost / pixels * 1e6})
    pictures = {mode: stage.picture for mode, stage in stages.items()}
    name = f"{case.name}: indirect light, default settings, {counts_of(stages['hybrid'])} probes"
    gallery.add(PictureSet(name, view.reference, pictures))
    return rows


def _grid_row(stage: Stage) -> Row:
    spacing = float(stage.state.grid.spacing.max())
    return {"probes": counts_of(stage), "resolution": stage.state.resolution, "spacing m": spacing}


def dark_rows(views: dict[str, ProbeView], **settings: Any) -> list[Row]:
    """Return the light of the dark room over that of the lit one, in one bake for both, by who tells what is seen."""
    rows: list[Row] = []
    paths = float(views["lit"].reference.mean(dtype=np.float64))
    for visibility, target in DARK_TARGETS.items():
        stages = {name: view.stage(SPP, visibility=visibility, **settings) for name, view in views.items()}
        means = {name: float(stage.picture.mean(dtype=np.float64)) for name, stage in stages.items()}
        row: Row = {"table": DARK_TABLE, "visibility": visibility, "mode": stages["lit"].estimator.mode}
        row |= {"probes": counts_of(stages["lit"]), "dark / lit": means["dark"] / means["lit"], "target": target}
        rows.append(row | {"lit / paths": means["lit"] / paths})
    return rows


def irradiance_rows(case: DefaultCase, view: ProbeView, **settings: Any) -> list[Row]:
    """Return what the probes say of the irradiance where camera rays end, where they say something."""
    stage = view.stage(1, mode="irradiance", **settings)
    halves = [path_traced(stage, max(view.reference_spp // 2, 1), SEED + 11 + half) for half in range(2)]
    rows: list[Row] = []
    for visibility in DARK_TARGETS:
        irradiance, probes = of_probes(stage, visibility)
        known = probes > 0
        ours, paths = irradiance[known], [half[known] for half in halves]
        mean = float(np.mean(paths, dtype=np.float64))
        error = mean_squared(ours, paths) ** 0.5
        row: Row = {"table": IRRADIANCE_TABLE, "case": case.name, "visibility": visibility}
        row |= {"probes": counts_of(stage), "left to rays": float((probes == 0).sum() / max((probes >= 0).sum(), 1))}
        row |= {"mean / paths": float(ours.mean(dtype=np.float64)) / mean, "RMSE": error, "RMSE / mean": error / mean}
        rows.append(row)
    return rows
