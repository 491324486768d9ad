"""A light that is switched off and on while the camera moves: how soon frames have the new light, and what is left."""

from __future__ import annotations

from functools import partial

from warp_gi.bench.harness.gallery import CLOSED, Gallery, PictureSet
from warp_gi.bench.harness.measure import Row, attempt
from warp_gi.bench.suites.clean import measures
from warp_gi.bench.suites.clean.cases import OFF, ON, SWITCHED, SequenceCase
from warp_gi.bench.suites.clean.contenders import CLEAN, PATH, Shots, cleans, filtered, take_turns
from warp_gi.bench.suites.clean.references import Truth, truth
from warp_gi.bench.suites.clean.sequences import QUICK_SIZE, QUICK_SPP

TABLE = "light switched"
LATER = (0, 1, 2, 3, 8)
"""Frames after the switch that are judged; 0 is the first frame of the new light."""
SOON, LONG = 3, 8
MOST_SOON, MOST_LONG = 0.1, 0.02
"""Largest share of the old light that is left so many frames later."""
QUICK_LATER = (0, 3)


def switched_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return a row for each switch, renderer and number of frames after it."""
    case = SWITCHED.small(QUICK_SIZE, SWITCHED.judged.last, QUICK_SPP) if quick else SWITCHED
    switches = {"off": OFF} if quick else {"off": OFF, "on": ON}
    later = QUICK_LATER if quick else LATER
    return attempt({"table": TABLE}, partial(case_rows, case, switches, later, device, gallery))


def case_rows(
    case: SequenceCase, switches: dict[str, int], later: tuple[int, ...], device: str, gallery: Gallery = CLOSED
) -> list[Row]:
    """Return the rows; the references of a frame are one with its light and one with that before the switch."""
    path = case.path()
    frames = [at + k for at in switches.values() for k in later]
    contenders = [*cleans(max(frames) + 1), filtered(max(frames) + 1)]
    shots = [one for one in take_turns(contenders, case.scene(), path, frames, device) if one.renderer != PATH]
    rows: list[Row] = []
    for name, at in switches.items():
        for k in later:
            now, before = (
                truth(case.scene, path, at + k, case.reference_spp, device, moment) for moment in (at + k, at - 1)
            )
            rows += [_row(name, k, one, at, now, before) for one in shots]
            pictures = {one.renderer: one.pictures[at + k] for one in shots}
            gallery.add(PictureSet(f"light switched {name}, {k} frames later", now.shown, pictures))
    return rows


def _row(name: str, later: int, shots: Shots, at: int, now: Truth, before: Truth) -> Row:
    picture = shots.pictures[at + later]
    row: Row = {"table": TABLE, "case": f"switched {name}", "renderer": shots.renderer, "frames later": later}
    row |= {"old light left": measures.left_over(picture, now.shown, before.shown)}
    row |= now.quality(picture)
    is_held = shots.renderer == CLEAN and later in (SOON, LONG)
    return row | {"most left": {SOON: MOST_SOON, LONG: MOST_LONG}[later] if is_held else ""}
