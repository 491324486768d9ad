"""What light comes through a wall of 2 cm: the dark one of two rooms over the lit one, in one fill for both."""

from __future__ import annotations

import warp_gi as gi
from warp_gi.bench.harness.measure import Row
from warp_gi.bench.harness.path_views import room_views
from warp_gi.bench.suites.cache.fills import side_of
from warp_gi.bench.suites.cache.views import QUICK_SIZE, SIZE, SPP, CacheView

LEAKS = "leaks: two_rooms"
CELLS = (0.0, 0.1, 0.25)
"""Sides of cells in metres; 0 is the default."""
MOST_DARK = 0.01


def leak_rows(quick: bool, device: str) -> list[Row]:
    """Return a row for each side of cells."""
    views = room_views(CacheView, QUICK_SIZE if quick else SIZE, device, 32 if quick else 256)
    paths = float(views["lit"].reference.mean(dtype=float))
    rows: list[Row] = []
    for cell in CELLS[:2] if quick else CELLS:
        bake = views["lit"].bake(gi.SurfaceCache(cell=cell))[0]
        stages = {name: view.cached(SPP, cell=cell) for name, view in views.items()}
        means = {name: float(stage.picture.mean(dtype=float)) for name, stage in stages.items()}
        row: Row = {"table": LEAKS, "cell m": side_of(bake)}
        row |= {"dark / lit": means["dark"] / means["lit"], "lit / paths": means["lit"] / paths}
        rows.append(row | {"most dark": MOST_DARK if cell <= CELLS[1] else ""})
    return rows
