"""Sample reuse: light cache and guided paths by scene, over frames, after changes of the light, and their cost.

One sample a pixel; errors are mean squared, without the reference's
noise. Where other programs run, "equal time" and "cost" count CPU seconds. What the paper measured stands in tables
of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

from warp_gi.bench.harness.gallery import CLOSED, Gallery, run_parts
from warp_gi.bench.harness.measure import Row
from warp_gi.bench.suites.reuse.cost import cost_rows
from warp_gi.bench.suites.reuse.quality import quality_rows
from warp_gi.bench.suites.reuse.time import adaptation_rows, strobe_rows, turning_rows

PARTS = {
    "quality": quality_rows,
    "adaptation": adaptation_rows,
    "turning": turning_rows,
    "cost": cost_rows,
    "strobe": strobe_rows,
}


def run(quick: bool = False, device: str = "cpu", parts: Sequence[str] = (), gallery: Gallery = CLOSED) -> list[Row]:
    """Return rows of all tables; ``quick`` takes fewer pixels, frames and scenes."""
    return run_parts(PARTS, parts, quick, device, gallery)
