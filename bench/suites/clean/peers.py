"""Other renderers beside the preset ``clean``: Mitsuba, Blender Cycles and LuxCore, with denoisers, on the CPU.

All get the same Lambert scenes without masks and punctual lights, and the same camera path; they render the middle
frame and the one before it. Each renderer has the machine for itself, one after the other. Seconds are those of a
frame and its denoising, without loading, building and compilation. One that is not installed is a row that says so.
"""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness import scenes
from warp_gi.bench.harness.gallery import CLOSED, Gallery, PictureSet
from warp_gi.bench.harness.measure import Row, attempt
from warp_gi.bench.harness.places import WHITE, Color
from warp_gi.bench.peers.mitsuba_peer import PeerMissing
from warp_gi.bench.suites.clean.cases import FROM_FILES, SIZE, Judged, SequenceCase
from warp_gi.bench.suites.clean.contenders import CLEAN, PATH, Shots, cleans, paths, take_turns
from warp_gi.bench.suites.clean.references import Guides, truth
from warp_gi.bench.suites.clean.renderers import CYCLES, MITSUBA, RENDERERS
from warp_gi.bench.suites.clean.sequences import QUICK_SIZE, QUICK_SPP, steadiness

TABLE, MISSING = "other renderers", "other renderers that are missing"
FASTER = 20.0
"""Least time of ``PeerCase.slower`` over that of ``clean``, which is to have no higher FLIP."""
OWN = "own"
OURS, QUICK_OURS = (1, 4, 16), (1,)


@dataclass(frozen=True)
class PeerCase:
    """A sequence that all renderers render, and their numbers of samples a pixel."""

    sequence: SequenceCase
    sky: Color | str | None
    """Sky in place of the scene's own, which is OWN."""
    samples: tuple[int, ...] = (16, 64)
    slower: tuple[str, int] = ("", 0)
    """A renderer and its samples a pixel that ``clean`` is to be ``FASTER`` than."""

    def scene(self) -> gi.Scene:
        """Return a scene of Lambert materials that every renderer can show."""
        found = self.sequence.scene()
        sky = found.environment if self.sky == OWN else self.sky
        lit = gi.Scene(found.nodes, [], sky, found.cameras, found.name)
        return scenes.peer_scene(lit, diffuse=True, masks=False)


_UNTIL_MIDDLE = Judged(last=Judged().middle)
_LIVING_ROOM = next(case for case in FROM_FILES if case.place == "living_room")
_SPONZA = next(case for case in FROM_FILES if case.place == "sponza_courtyard")
CASES = (
    PeerCase(SequenceCase("atrium_white", judged=_UNTIL_MIDDLE), WHITE, slower=(CYCLES, 16)),
    PeerCase(replace(_LIVING_ROOM, size=SIZE, judged=_UNTIL_MIDDLE), None),
    PeerCase(replace(_SPONZA, judged=_UNTIL_MIDDLE), OWN, slower=(MITSUBA, 64)),
)
QUICK_CASE = PeerCase(SequenceCase("cornell_box"), None, (4,))


def peer_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return the rows of all renderers in all scenes; ``quick`` takes one scene, small."""
    if quick:
        small = replace(QUICK_CASE.sequence.small(QUICK_SIZE, 3, QUICK_SPP), judged=Judged(0, 3, 3))
        return case_rows(replace(QUICK_CASE, sequence=small), device, QUICK_OURS, gallery)
    rows: list[Row] = []
    for case in CASES:
        said: Row = {"table": MISSING, "case": case.sequence.name}
        if case.sequence.missing:
            rows.append(said | {"skipped": case.sequence.missing})
        else:
            rows += attempt(said, partial(case_rows, case, device, OURS, gallery))
    return rows


def case_rows(case: PeerCase, device: str, ours: Sequence[int], gallery: Gallery = CLOSED) -> list[Row]:
    """Return the rows of one scene: of the preset ``clean``, of paths with denoisers, and of every other renderer."""
    sequence, path = case.sequence, case.sequence.path()
    judged = sequence.judged
    shown = (judged.before, judged.middle)
    middle = truth(case.scene, path, judged.middle, sequence.reference_spp, device)
    guides = Guides.of(case.scene(), path, judged.middle, device)
    contenders = [*cleans(judged.count), *paths(judged, ours)]
    shots = [one for one in take_turns(contenders, case.scene(), path, shown, device) if one.renderer != PATH]
    others, missing = other_shots(case, path, shown, device)
    shots += others
    rows: list[Row] = []
    for one in shots:
        row: Row = {"table": TABLE, "case": sequence.name, "pixels": "x".join(map(str, sequence.size))}
        row |= {"contender": f"{one.renderer}, {one.spp} spp"} | one.row
        row |= middle.quality(one.pictures[judged.middle])
        row |= steadiness(one.pictures[judged.middle], one.pictures[judged.before], middle, guides)
        wall, cpu = seconds_of(one)
        rows.append(row | {"s a frame": wall, "us a pixel": cpu / float(np.prod(sequence.size)) * 1e6})
    clean = next(row for row in rows if row["renderer"] == CLEAN)
    for row in rows:
        row |= {"time / clean": row["s a frame"] / clean["s a frame"], "FLIP / clean": row["FLIP"] / clean["FLIP"]}
        is_held = (row["renderer"], row["spp"]) == case.slower
        row |= {"least faster": FASTER if is_held else "", "least FLIP": 1.0 if is_held else ""}
    pictures = {f"{one.renderer}, {one.spp} spp": one.pictures[judged.middle] for one in shots}
    gallery.add(PictureSet(f"{sequence.name}, Lambert: other renderers", middle.shown, pictures))
    return [*rows, *missing]


def other_shots(
    case: PeerCase, path: gi.CameraPath, frames: Sequence[int], device: str
) -> tuple[list[Shots], list[Row]]:
    """Return what other renderers made, and a row for each that is not installed or failed."""
    shots: list[Shots] = []
    missing: list[Row] = []
    for name, render in RENDERERS.items():
        said: Row = {"table": MISSING, "case": case.sequence.name, "renderer": name}
        try:
            shots += [render(case.scene(), path, frames, spp, device) for spp in case.samples]
        except PeerMissing as error:
            missing.append(said | {"skipped": str(error)})
        except subprocess.CalledProcessError as error:
            lines = (error.stderr or "").strip().splitlines()
            missing.append(said | {"failed": lines[-1] if lines else str(error)})
    return shots, missing


def seconds_of(shots: Shots) -> tuple[float, float]:
    """Return the median wall and CPU seconds of a frame; not of the first, which others do not render."""
    later = list(shots.times.values())[1:] or list(shots.times.values())
    wall, cpu = np.median(later, axis=0)
    return float(wall), float(cpu)
