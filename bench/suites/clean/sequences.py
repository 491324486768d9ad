"""Sequences by the preset ``clean`` beside the path tracer, whose frames take turns: errors, flicker, times."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial

import numpy as np

from warp_gi.bench.harness.gallery import CLOSED, Gallery, PictureSet
from warp_gi.bench.harness.measure import PeakMemory, Row, attempt, median_and_spread
from warp_gi.bench.suites.clean import measures
from warp_gi.bench.suites.clean.cases import BUILT_IN, FROM_FILES, IN_LARGE, MOVING, QUICK, SequenceCase
from warp_gi.bench.suites.clean.contenders import CLEAN, OIDN, PATH, UNBLENDED, Shots, cleans, paths, take_turns
from warp_gi.bench.suites.clean.references import Guides, Truth, truth

SEQUENCES, BESIDE, REFERENCE = "sequences", "clean beside path, OIDN", "references"
QUICK_SIZE, QUICK_LAST, QUICK_SPP = (64, 36), 4, 64
MOST_PATTERN = 0.3
"""Largest "pattern": how much more alike errors are two pixels apart than one. Smooth errors have none."""
MOST_FLICKER = 0.25
"""Largest flicker over that of paths with one sample and OIDN."""
TIMES = 10.0
"""At so many times the seconds of ``clean``, paths with OIDN are to have no lower FLIP."""
MOST_SHOWN = 16
"""Most samples a pixel of pictures in a report."""
SAMPLES, QUICK_SAMPLES = (1, 4, 16, 64), (1, 4)
ONLY_CLEAN = ("fill s", "fill cpu s", "compile s", "peak GB")
LIMITS = ("most FLIP", "most pattern", "most s a frame", "least mean", "most mean")
Truths = Mapping[int, Truth]


def built_in_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return the rows of the built-in scenes."""
    return all_rows(QUICK if quick else BUILT_IN, quick, device, gallery)


def file_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return the rows of the scenes of files; none if ``quick``."""
    return all_rows(() if quick else FROM_FILES, quick, device, gallery)


def large_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return the rows of large pictures; none if ``quick``."""
    return all_rows(() if quick else IN_LARGE, quick, device, gallery)


def moving_rows(quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return the rows of a sky that turns and a crate that slides."""
    return all_rows(MOVING[1:] if quick else MOVING, quick, device, gallery)


def all_rows(cases: Iterable[SequenceCase], quick: bool, device: str, gallery: Gallery = CLOSED) -> list[Row]:
    """Return the rows of cases, each in its tables; ``quick`` makes them small."""
    rows: list[Row] = []
    for case in cases:
        said: Row = {"table": SEQUENCES, "case": case.name}
        if case.missing:
            rows.append(said | {"skipped": case.missing})
            continue
        small = case.small(QUICK_SIZE, QUICK_LAST, QUICK_SPP) if quick else case
        rows += attempt(said, partial(case_rows, small, device, gallery, QUICK_SAMPLES if quick else SAMPLES))
    return sorted(rows, key=lambda row: (SEQUENCES, BESIDE, REFERENCE).index(row["table"]))


def truths_of(case: SequenceCase, device: str) -> dict[int, Truth]:
    """Return the references of the frames that are judged."""
    path = case.path()
    return {frame: truth(case.scene, path, frame, case.reference_spp, device) for frame in case.judged.all}


def case_rows(case: SequenceCase, device: str, gallery: Gallery, samples: Sequence[int]) -> list[Row]:
    """Return the rows of one case: of every renderer, of ``clean`` beside the others, and of the references."""
    truths, path = truths_of(case, device), case.path()
    guides = Guides.of(case.scene(), path, case.judged.middle, device)
    ours, others = cleans(case.judged.count), paths(case.judged, samples)
    scene = case.scene()
    scene.data(device)  # the tree is no part of a fill
    memory = PeakMemory()
    ours[0].step(scene, path, case.judged.first, case.judged.all, device)
    peak = memory.bytes  # before any other contender has anything in memory
    shots = take_turns([*ours, *others], scene, path, case.judged.all, device)
    found = {(one.renderer, one.spp): shots_row(case, one, truths, guides) for one in shots}
    for one in ours:
        found[one.name, one.pipeline.spp] |= one.row
    found[CLEAN, ours[0].pipeline.spp] |= {"peak GB": peak / 1e9} | wanted(case)
    pictures = {
        f"{one.renderer}, {one.spp} spp": one.pictures[case.judged.middle]
        for one in shots
        if one.renderer != PATH and one.spp <= MOST_SHOWN
    }
    gallery.add(PictureSet(case.name, truths[case.judged.middle].shown, pictures))
    return [*found.values(), *beside_rows(case, found), *reference_rows(case, truths, guides)]


def shots_row(case: SequenceCase, shots: Shots, truths: Truths, guides: Guides) -> Row:
    """Return the row of one renderer: errors of the middle frame, of the first and last, flicker, pattern, seconds."""
    judged, pictures = case.judged, shots.pictures
    pixels = float(np.prod(case.size))
    row: Row = {"table": SEQUENCES, "case": case.name, "pixels": "x".join(map(str, case.size))}
    row |= shots.row
    middle = truths[judged.middle]
    row |= middle.quality(pictures[judged.middle])
    for name, frame in (("first", judged.first), ("last", judged.last)):
        there = truths[frame].quality(pictures[frame]) if frame in pictures else {}
        row |= {f"FLIP {name}": there.get("FLIP", ""), f"mean {name}": there.get("mean", "")}
    told = [row[name] for name in ("mean first", "mean", "mean last")]
    row["mean of judged"] = "" if "" in told else sum(told) / len(told)
    row |= steadiness(pictures[judged.middle], pictures[judged.before], middle, guides)
    later = [frame for frame in shots.times if frame not in (judged.first, min(shots.times))] or list(shots.times)
    wall, cpu = (np.array([shots.times[frame][kind] for frame in later]) for kind in (0, 1))
    row |= median_and_spread("s a frame", wall) | median_and_spread("us a pixel", cpu / pixels * 1e6)
    row["first frame s"] = shots.times[judged.first][0] if judged.first in shots.times else ""
    return row | dict.fromkeys((*ONLY_CLEAN, *LIMITS), "")


def steadiness(picture: np.ndarray, before: np.ndarray, middle: Truth, guides: Guides) -> Row:
    """Return flicker, and likeness and size of fine errors on flat walls."""
    found = measures.pattern(picture, middle.halves, guides.wall)
    names = ("alike at 1", "alike at 2", "fine error")
    row: Row = {"flicker": measures.flicker(picture, before, guides.motion, middle.shown)}
    row |= dict(zip(names, found or ("",) * 3, strict=True))
    return row | {"pattern": found[1] - max(found[0], 0.0) if found else ""}


def wanted(case: SequenceCase) -> Row:
    """Return what is wanted of the preset ``clean``."""
    row: Row = {"most FLIP": "" if case.most_flip is None else case.most_flip, "most pattern": MOST_PATTERN}
    row |= {"most s a frame": "" if case.most_seconds is None else case.most_seconds}
    return row | {"least mean": 1 - case.within, "most mean": 1 + case.within}


def beside_rows(case: SequenceCase, found: Mapping[tuple[str, int], Row]) -> list[Row]:
    """Return rows of ``clean`` over paths with OIDN: flicker, FLIP at ten times the seconds, seconds of equal FLIP."""
    others = [row for (name, _), row in sorted(found.items()) if name == OIDN]
    rows: list[Row] = []
    for name in (CLEAN, UNBLENDED):
        ours = next(row for (one, _), row in found.items() if one == name)
        row: Row = {"table": BESIDE, "case": case.name, "renderer": name}
        if not others:
            return [row | {"skipped": "Open Image Denoise is not installed; pip install 'warp-gi[denoise]'"}]
        row["flicker / OIDN"] = ours["flicker"] / others[0]["flicker"]
        points = [(other["us a pixel"], other["FLIP"]) for other in others]
        row["FLIP / OIDN"] = ours["FLIP"] / at_time(points, TIMES * ours["us a pixel"])
        seconds, reached = time_of(points, ours["FLIP"])
        row |= {"times less, cpu": seconds / ours["us a pixel"], "reached": reached}
        is_small = case.within >= 1
        row |= {"most of flicker": "" if is_small else MOST_FLICKER, "most of FLIP": "" if is_small else 1.0}
        rows.append(row)
    return rows


def at_time(points: Sequence[tuple[float, float]], time: float) -> float:
    """Return the error after a time, of (time, error) with rising times: a power of time between them, held outside."""
    times, errors = np.log(np.array(points, np.float64)).T
    return float(np.exp(np.interp(np.log(time), times, errors)))


def time_of(points: Sequence[tuple[float, float]], error: float) -> tuple[float, bool]:
    """Return the time after which the error is as low, and True; or the longest time, and False where it never is."""
    low = [index for index, point in enumerate(points) if point[1] <= error]
    if not low:
        return points[-1][0], False
    if low[0] == 0:
        return points[0][0], True
    (t0, e0), (t1, e1) = (np.log(points[low[0] - 1 + k]) for k in range(2))
    return float(np.exp(t0 + (t1 - t0) * (e0 - np.log(error)) / (e0 - e1))), True


def reference_rows(case: SequenceCase, truths: Truths, guides: Guides) -> list[Row]:
    """Return rows of the references: FLIP between their halves, and the flicker of the middle one."""
    rows: list[Row] = []
    for frame in (case.judged.first, case.judged.middle, case.judged.last):
        row: Row = {"table": REFERENCE, "case": case.name, "frame": frame, "reference spp": case.reference_spp}
        row |= truths[frame].row()
        if frame == case.judged.middle:
            shown = truths[frame].shown
            before = truths[case.judged.before].shown
            row["flicker of the reference"] = measures.flicker(shown, before, guides.motion, shown)
        else:
            row["flicker of the reference"] = ""
        rows.append(row)
    return rows


def reference_part(quick: bool, device: str) -> list[Row]:
    """Return the rows of the references alone, which are kept from then on: a busy machine can make them."""
    rows: list[Row] = []
    for case in QUICK if quick else (*BUILT_IN, *FROM_FILES, *MOVING, *IN_LARGE):
        if case.missing:
            continue
        small = case.small(QUICK_SIZE, QUICK_LAST, QUICK_SPP) if quick else case
        guides = Guides.of(case.scene(), small.path(), small.judged.middle, device)
        rows += reference_rows(small, truths_of(small, device), guides)
    return rows
