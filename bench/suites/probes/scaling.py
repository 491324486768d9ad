"""What light field probes add to the suite ``scaling``: their bake over the resolution of their maps."""

from __future__ import annotations

from collections.abc import Sequence

import warp_gi as gi
from warp_gi.bench.harness.measure import Row, take_turns
from warp_gi.bench.suites.scaling.fits import Growth

RESOLUTIONS, QUICK_RESOLUTIONS = (32, 64, 128, 256, 512), (16, 64, 160)
COUNTS, QUICK_COUNTS = (4, 4, 4), (2, 2, 2)
TURNS, QUICK_TURNS = 3, 2


def probe_rows(quick: bool, device: str) -> list[Row]:
    """Return rows of light field probes by the texels along a side of their maps, and of their growth."""
    resolutions, counts, turns = (
        (QUICK_RESOLUTIONS, QUICK_COUNTS, QUICK_TURNS) if quick else (RESOLUTIONS, COUNTS, TURNS)
    )
    return probe_rows_of(resolutions, counts, turns, device)


def probe_rows_of(resolutions: Sequence[int], counts: tuple[int, int, int], turns: int, device: str) -> list[Row]:
    """Return the rows for probes of ``resolutions``."""
    scene = gi.builtin_scene("cornell_box")
    grids = {side: gi.LightFieldProbes(counts=counts, resolution=side) for side in resolutions}
    works = {str(side): lambda _, probes=probes: gi.bake(scene, probes, device) for side, probes in grids.items()}
    taken = take_turns(works, turns, device, keep=1, warm=False)
    rows: list[Row] = []
    for side in resolutions:
        bakes = taken[str(side)]
        row: Row = {"table": "probes", "resolution": side} | bakes.row("bake ")
        rows.append(row | {"MB": bakes.results[0].counts["bytes"] / 1e6})
    said = {"table": "probes: growth"}
    cost = Growth.of(resolutions, [taken[str(side)].counting for side in resolutions]).row()
    memory = Growth.of(resolutions, [[row["MB"]] for row in rows]).row()
    return [*rows, said | {"what": "bake cost s"} | cost, said | {"what": "MB"} | memory]


PARTS = {"probes": probe_rows}
