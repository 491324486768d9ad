"""Fills of a surface cache: seconds, size, what more samples do not remove, and all of that by the number of paths."""

from __future__ import annotations

import warp_gi as gi
from warp_gi.bench.harness.measure import Row, median_and_spread
from warp_gi.bench.harness.path_views import SEED, mean_product
from warp_gi.bench.harness.stages import timed_bake
from warp_gi.bench.suites.cache.views import MOST_FILL, SPP, CacheCase, CacheView, one_thread
from warp_gi.techniques.surface_cache.cells import table_nbytes

FILL, BY_PATHS = "fill", "fills by paths"
PATHS, QUICK_PATHS = (50_000, 150_000, 500_000), (2_000, 8_000)


def fill_rows(case: CacheCase, view: CacheView, turns: int, quick: bool) -> list[Row]:
    """Return the row of a fill at default settings, and one for each number of paths."""
    view.scene.data(view.device)  # the tree is no part of a fill
    cache = gi.SurfaceCache()
    with one_thread():
        seconds = [timed_bake(view.scene, cache, view.device, view.camera)[1][1] for _ in range(turns)]
    row: Row = {"table": FILL, "case": case.name, "paths": cache.paths} | median_and_spread("fill cpu s", seconds)
    rows = [row | cells_row(view) | {"most fill s": MOST_FILL, "most floor": case.floor}]
    for paths in QUICK_PATHS if quick else PATHS:
        with one_thread():
            seconds = [view.bake(gi.SurfaceCache(paths=paths))[1][1]]
        quality = view.quality(view.cached(SPP, paths=paths).picture)
        row = {"table": BY_PATHS, "case": case.name, "paths": paths, "spp": SPP, "fill cpu s": seconds[0]}
        row |= cells_row(view, paths=paths)
        rows.append(row | {key: quality[key] for key in ("mean / paths", "RMSE / mean", "FLIP")})
    return rows


def cells_row(view: CacheView, **settings: int) -> Row:
    """Return the cells of a fill, and the error that more samples do not remove, by two pictures that end in it."""
    bake = view.bake(gi.SurfaceCache(**settings))[0]
    one, other = (view.cached(SPP, SEED + 10 + turn, **settings).picture for turn in range(2))
    mean = float(view.reference.mean(dtype=float))
    row: Row = {"cells": bake.counts["cells"], "cell m": side_of(bake)}
    row |= {"samples a cell": bake.counts["samples"] / max(bake.counts["cells"], 1)}
    row |= {"MB": table_nbytes(bake.arrays["keys"]) / 1e6}
    return row | {"floor": mean_product(one, other, view.halves) ** 0.5 / mean}


def side_of(bake: gi.Bake) -> float:
    """Return the side of a cell near the camera in metres, as it was given."""
    return round(float(bake.arrays["side"][0]), 6)
