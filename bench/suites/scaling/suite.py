"""Scaling: how time and memory grow with triangles, lights, pixels, bake samples, probes and threads.

Tables ": growth" have the exponents of power laws
through all sizes, and what ten times the size costs at worst. Seconds of rays are of one thread; where other programs
run, "cost" is CPU seconds. The meshes, lamps and rays are generated, the same each time.
"""

from __future__ import annotations

from collections.abc import Sequence

from warp_gi.bench.harness import catalogue
from warp_gi.bench.harness.gallery import CLOSED, Gallery, run_parts
from warp_gi.bench.harness.measure import Row
from warp_gi.bench.suites.scaling.frames import light_rows, pixel_rows, thread_rows
from warp_gi.bench.suites.scaling.triangles import triangle_rows

PARTS = {
    "triangles": triangle_rows,
    "lights": light_rows,
    "pixels": pixel_rows,
    "threads": thread_rows,
    **{name: part for _, module in catalogue.modules("scaling") for name, part in getattr(module, "PARTS", {}).items()},
}


def run(quick: bool = False, device: str = "cpu", parts: Sequence[str] = (), gallery: Gallery = CLOSED) -> list[Row]:
    """Return rows of all tables; ``quick`` takes smaller sizes and fewer turns."""
    return run_parts(PARTS, parts, quick, device, gallery)
