"""Surface radiance caches: indirect light beside paths at equal error, fills, bias, leaks, motion.

All is of the indirect term alone, at default settings and with the scenes' own materials, on one thread. Seconds of
filling are apart: a fill serves every frame of a camera path.
"""

from __future__ import annotations

from collections.abc import Sequence

from warp_gi.bench.harness.gallery import CLOSED, Gallery, run_parts
from warp_gi.bench.harness.measure import Row
from warp_gi.bench.suites.cache.leaks import leak_rows
from warp_gi.bench.suites.cache.light import light_rows
from warp_gi.bench.suites.cache.moving import moving_rows

PARTS = {"light": light_rows, "leaks": leak_rows, "moving": moving_rows}


def run(quick: bool = False, device: str = "cpu", parts: Sequence[str] = (), gallery: Gallery = CLOSED) -> list[Row]:
    """Return rows of all tables; ``quick`` takes fewer scenes, samples and pixels."""
    return run_parts(PARTS, parts, quick, device, gallery)
