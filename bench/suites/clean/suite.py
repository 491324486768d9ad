"""Whole sequences by the preset ``clean``: error, flicker, light and time beside paths, denoisers, other renderers.

Parts: ``built-in``, ``files``, ``moving`` and ``large`` sequences; ``switched``, a light that goes off and on;
``first``, the command of the README; ``peers``, other renderers. ``references`` alone makes the references that all of
them compare with; they are kept, and a busy machine can make them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from warp_gi.bench.harness.gallery import CLOSED, Gallery, run_parts
from warp_gi.bench.harness.measure import Row
from warp_gi.bench.suites.clean.first import first_rows
from warp_gi.bench.suites.clean.peers import peer_rows
from warp_gi.bench.suites.clean.sequences import built_in_rows, file_rows, large_rows, moving_rows, reference_part
from warp_gi.bench.suites.clean.switched import switched_rows

MEASURED: dict[str, Callable[..., list[Row]]] = {
    "built-in": built_in_rows,
    "files": file_rows,
    "moving": moving_rows,
    "large": large_rows,
    "switched": switched_rows,
    "first": first_rows,
    "peers": peer_rows,
}
PARTS = {**MEASURED, "references": reference_part}


def run(quick: bool = False, device: str = "cpu", parts: Sequence[str] = (), gallery: Gallery = CLOSED) -> list[Row]:
    """Return rows of all tables; ``quick`` takes fewer scenes, frames, samples and pixels."""
    return run_parts(PARTS, parts or tuple(MEASURED), quick, device, gallery)
