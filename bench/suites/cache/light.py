"""Indirect light by paths that end in a cache beside paths: errors at equal samples, time for equal error, fills."""

from __future__ import annotations

from functools import partial

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness.gallery import CLOSED, Gallery, PictureSet
from warp_gi.bench.harness.measure import Row, attempt, median_and_spread, ratios
from warp_gi.bench.harness.path_views import black_share, view_of
from warp_gi.bench.harness.stages import Stage, race
from warp_gi.bench.suites.cache.fills import BY_PATHS, FILL, fill_rows
from warp_gi.bench.suites.cache.views import (
    ALL_FASTER,
    CASES,
    QUICK_CASES,
    QUICK_SIZE,
    SIZE,
    SPP,
    CacheCase,
    CacheView,
    one_thread,
)

LIGHT, ALL, REFERENCE = "indirect light", "indirect light: all places", "reference"
PATHS, CACHE, RESIDUAL = "paths", "cache", "cache, residual"
CORRECTED = 0.3
"""Share of paths that correct what cells say, in the rows of ``RESIDUAL``."""
FEW = 16
"""A pipeline's default number of samples a pixel."""
TURNS = 3


def light_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return the rows of every place, and the geometric mean of how much less time the cache takes."""
    rows: list[Row] = []
    for case in QUICK_CASES if quick else CASES:
        said = {"table": LIGHT, "case": case.name}
        if case.missing:
            rows.append(said | {"skipped": case.missing})
            continue
        size, spp = (QUICK_SIZE, 64) if quick else (SIZE, case.reference_spp)
        rows += attempt(said, partial(place_rows, case, size, spp, quick, device, gallery))
    faster = [row["faster, cpu"] for row in rows if row.get("renderer") == CACHE and row.get("spp") == SPP]
    if faster:
        mean = float(np.exp(np.mean(np.log(faster))))
        rows.append({"table": ALL, "renderer": CACHE, "faster, cpu": mean, "least faster": ALL_FASTER})
    return sorted(rows, key=lambda row: (LIGHT, ALL, FILL, BY_PATHS, REFERENCE).index(row["table"]))


def place_rows(
    case: CacheCase, size: tuple[int, int], reference_spp: int, quick: bool, device: str, gallery: Gallery = CLOSED
) -> list[Row]:
    """Return the rows of one place: of every renderer at two numbers of samples, of fills and of the reference."""
    view = view_of(CacheView, case, size, device, reference_spp)
    a, b = view.halves
    mean = float(view.reference.mean(dtype=np.float64))
    noise = float(np.mean(np.square(a - b, dtype=np.float64))) ** 0.5 / 2 / mean
    turns = 1 if quick else TURNS
    rows = fill_rows(case, view, turns, quick) + renderer_rows(case, view, turns, gallery)
    row: Row = {"table": REFERENCE, "case": case.name, "reference spp": 2 * reference_spp}
    row |= {"noise": noise, "FLIP of its halves": gi.metrics.flip(a, b)}
    return [*rows, row]


def renderer_rows(case: CacheCase, view: CacheView, turns: int, gallery: Gallery = CLOSED) -> list[Row]:
    """Return rows of paths, of paths that end in the cache, and of those that correct it."""
    stages: dict[str, dict[int, Stage]] = {PATHS: {}, CACHE: {}, RESIDUAL: {}}
    for spp in (FEW, SPP):
        stages[PATHS][spp] = view.paths(spp)
        stages[CACHE][spp] = view.cached(spp)
        stages[RESIDUAL][spp] = view.cached(spp, residual=CORRECTED)
    with one_thread():
        taken = race({name: of[SPP] for name, of in stages.items()}, turns, view.device)
    samples = SPP * float(np.prod(view.camera.resolution))
    rows: list[Row] = []
    for name, of in stages.items():
        seconds = median_and_spread("us a sample", np.array(taken[name].counting) / samples * 1e6)
        for spp, stage in of.items():
            row: Row = {"table": LIGHT, "case": case.name, "renderer": name, "spp": spp} | seconds
            row |= view.quality(stage.picture)
            row["black pixels"] = black_share(stage.picture, view.reference)
            base = view.quality(stages[PATHS][spp].picture)
            gain = (base["RMSE"] / max(row["RMSE"], 1e-30)) ** 2
            row |= {key: value * gain for key, value in ratios("faster, {}", taken[PATHS], taken[name]).items()}
            row["FLIP / paths"] = row["FLIP"] / max(base["FLIP"], 1e-30)
            is_held = name == CACHE and spp == SPP
            row |= {"least mean": 1 - case.within, "most mean": 1 + case.within}
            row |= {"least faster": case.faster if is_held else "", "most of FLIP": case.flip if is_held else ""}
            rows.append(row)
    pictures = {f"{name}, {SPP}": of[SPP].picture for name, of in stages.items()}
    gallery.add(PictureSet(f"{case.name}: indirect light", view.reference, pictures))
    return rows
