"""Light field probes: default settings beside the path tracer, rays, leaks, modes, bakes, and denoisers.

Seconds of a mode are of the indirect stage alone, primary rays apart.
What the paper measured stands in tables of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

from warp_gi.bench.harness.gallery import CLOSED, Gallery, run_parts
from warp_gi.bench.harness.measure import Row
from warp_gi.bench.suites.probes.defaults import default_rows
from warp_gi.bench.suites.probes.denoise import denoise_rows
from warp_gi.bench.suites.probes.light import bake_rows, leak_rows, light_rows
from warp_gi.bench.suites.probes.rays import ray_rows

PARTS = {
    "defaults": default_rows,
    "rays": ray_rows,
    "leaks": leak_rows,
    "light": light_rows,
    "bakes": bake_rows,
    "denoise": denoise_rows,
}


def run(quick: bool = False, device: str = "cpu", parts: Sequence[str] = (), gallery: Gallery = CLOSED) -> list[Row]:
    """Return rows of all tables; ``quick`` takes fewer rays, pixels and grids."""
    return run_parts(PARTS, parts, quick, device, gallery)
