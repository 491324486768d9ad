"""Radiance transfer textures: the paper's tables, errors and bakes, and frames beside tracing the same light.

Errors are over the mean of the reference, two pictures by the path tracer whose noise is subtracted ("rel"). What the
paper measured stands in tables of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

from warp_gi.bench.harness.gallery import CLOSED, Gallery, run_parts
from warp_gi.bench.harness.measure import Row
from warp_gi.bench.suites.transfer.bakes import bake_rows
from warp_gi.bench.suites.transfer.errors import error_rows
from warp_gi.bench.suites.transfer.frames import frame_rows
from warp_gi.bench.suites.transfer.glossy import glossy_rows
from warp_gi.bench.suites.transfer.memory import memory_rows
from warp_gi.bench.suites.transfer.paper import paper_rows
from warp_gi.bench.suites.transfer.peers import peer_rows
from warp_gi.bench.suites.transfer.seams import seam_rows
from warp_gi.bench.suites.transfer.vertices import vertex_rows

PARTS = {
    "paper": paper_rows,
    "vertices": vertex_rows,
    "bakes": bake_rows,
    "frames": frame_rows,
    "peers": peer_rows,
    "errors": error_rows,
    "glossy": glossy_rows,
    "seams": seam_rows,
    "memory": memory_rows,
}


def run(quick: bool = False, device: str = "cpu", parts: Sequence[str] = (), gallery: Gallery = CLOSED) -> list[Row]:
    """Return rows of all tables; ``quick`` takes small scenes, atlases and pictures, and few rays."""
    return run_parts(PARTS, parts, quick, device, gallery)
