"""What visibility fields add to the suite ``scaling``: their bake and its error over the number of surface samples."""

from __future__ import annotations

from collections.abc import Sequence

import warp_gi as gi
from warp_gi.bench.harness.measure import Row, take_turns
from warp_gi.bench.suites.dvf.views import CASES, FieldStage, quality
from warp_gi.bench.suites.scaling.fits import Growth

ATRIUM = next(case for case in CASES if case.name == "atrium")
SIZE, QUICK_SIZE = (240, 135), (48, 27)
SPP = 16
SAMPLES, QUICK_SAMPLES = (40_000, 160_000, 640_000, 2_560_000), (20_000, 80_000, 320_000)
TURNS, QUICK_TURNS = 3, 2


def sample_rows(quick: bool, device: str) -> list[Row]:
    """Return rows of a visibility field's bake by its samples over the scene, and of their growth."""
    numbers, size, turns = (QUICK_SAMPLES, QUICK_SIZE, QUICK_TURNS) if quick else (SAMPLES, SIZE, TURNS)
    return sample_rows_of(numbers, size, turns, device)


def sample_rows_of(numbers: Sequence[int], size: tuple[int, int], turns: int, device: str) -> list[Row]:
    """Return the rows for bakes of ``numbers`` of samples; errors are against the sky traced with the same rays."""
    scene, camera = ATRIUM.scene(), ATRIUM.camera().at_resolution(*size)
    fields = {number: gi.VisibilityField(samples=number) for number in numbers}
    works = {
        str(n): lambda _, field=field: gi.bake(scene, field, device, camera_path=camera) for n, field in fields.items()
    }
    taken = take_turns(works, turns, device, keep=1, warm=False)
    traced = FieldStage(scene, camera, gi.VisibilityField(mode="traced"), SPP, device)
    rows: list[Row] = []
    for number, field in fields.items():
        bakes = taken[str(number)]
        stage = FieldStage(scene, camera, field, SPP, device, bakes.results.pop())
        row: Row = {"table": "bake samples", "samples": number} | bakes.row("bake ")
        rows.append(row | {"cells": len(stage.state.cells), "MB": stage.memory / 1e6} | quality(stage, traced))
    errors = [[row["RMSE"]] for row in rows]
    said = {"table": "bake samples: growth"}
    rows.append(said | {"what": "bake cost s"} | Growth.of(numbers, [taken[str(n)].counting for n in numbers]).row())
    return [*rows, said | {"what": "RMSE"} | Growth.of(numbers, errors).row()]


PARTS = {"samples": sample_rows}
