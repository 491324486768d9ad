"""The rows of `bench compare`: setup, frames, errors at equal samples and equal time, time at equal error."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from warp_gi.bench.compare.run import Comparison, Run, seconds_to
from warp_gi.bench.harness.measure import Row, median_and_spread

SERIES = "error over time"
"""Table of the points that plots are drawn of; too long to print."""
MOST_POINTS = 24
_TINY = 1e-30


def rows_of(found: Comparison, limit: float, setups: Mapping[str, Row]) -> list[Row]:
    """Return the rows of a comparison; ``setups`` are those of ``compare_setup`` by pipeline, ``limit`` is in seconds.

    Spread is half of the range that the middle half of the frames' times lie in.
    """
    rows: list[Row] = [_reference_row(found)]
    rows += [{"table": "setup", "pipeline": name} | setup for name, setup in setups.items()]
    rows += [_frames_row(run) for run in found.runs]
    for frames in sorted({1, found.equal_frames}):
        rows += [_equal_samples_row(run, frames, found) for run in found.runs]
    rows += [_equal_time_row(run, found, limit) for run in found.runs]
    rows += equal_error_rows(found.runs, setups)
    return rows + [row for run in found.runs for row in _series(run)]


def _reference_row(found: Comparison) -> Row:
    row, noise = {"table": "reference"} | found.reference.about, found.reference.noise
    if noise is not None and noise > min(run.points[-1].rmse for run in found.runs):
        row["says"] = f"noisier than what it is to judge: give more --reference-spp; {row['says']}"
    return row


def _frames_row(run: Run) -> Row:
    row: Row = {"table": "frames", "pipeline": run.name, "frames": run.count, "sum s": run.seconds}
    for name, values in (("wall s", run.wall), ("cpu s", run.cpu)):
        later = values[1:] or values  # the first allocates, and learns from nothing
        row |= median_and_spread(name, later)
    return row


def _equal_samples_row(run: Run, frames: int, found: Comparison) -> Row:
    picture = run.first if frames == 1 and run.first is not None else found.equal_samples[run.name]
    row: Row = {"table": "equal samples", "pipeline": run.name, "spp": run.pipeline.spp * frames, "frames": frames}
    return row | {"render s": run.points[frames - 1].seconds} | found.reference.errors(picture)


def _equal_time_row(run: Run, found: Comparison, limit: float) -> Row:
    row: Row = {"table": "equal time", "pipeline": run.name, "render s": run.seconds, "frames": run.count}
    row |= found.reference.errors(run.mean)
    floor = run.floor(found.reference)
    said = "" if run.seconds <= limit else f"its only frame took longer than the {limit:g} s it had"
    if not said and floor is not None and floor[1] > 0.5 * row["relMSE"]:
        said = "more frames hardly help: most of the error is the floor"
    row |= dict(zip(("floor RMSE", "floor relMSE"), floor or (None, None), strict=True))
    return row | {"says": said}


def equal_error_rows(runs: Sequence[Run], setups: Mapping[str, Row]) -> list[Row]:
    """Return the times after which each pipeline stays below two errors.

    "all" is the lowest error that every pipeline reaches, where the worst ends; "best" is where the best ends.
    """
    last = {run.name: run.points[-1].rmse for run in runs}
    rows = []
    targets = {"all": max(last.values()), "best": min(last.values())}
    if targets["best"] == targets["all"]:
        targets.pop("best")
    for name, target in targets.items():
        base = seconds_to(runs[0].points, target)
        for run in runs:
            seconds = seconds_to(run.points, target)
            row: Row = {"table": "equal error", "error that": _WORDS[name], "pipeline": run.name, "RMSE": target}
            row |= {"reached": seconds is not None, "render s": seconds}
            row["with build and bake s"] = _with_setup(seconds, setups.get(run.name, {}))
            faster = None if seconds is None or base is None else base / max(seconds, _TINY)
            row[f"speed-up over {runs[0].name}"] = faster
            rows.append(row)
    return rows


def _with_setup(seconds: float | None, setup: Row) -> float | None:
    """Return seconds plus those of building the tree and of baking; None if either is not known."""
    if seconds is None or not {"build s", "bake s"} <= setup.keys():
        return None
    return seconds + setup["build s"] + setup["bake s"]


_WORDS = {"all": "all get to", "best": "the best ends with"}


def _series(run: Run) -> list[Row]:
    """Return at most ``MOST_POINTS`` points, evenly in the logarithm of the number of frames."""
    kept = np.unique(np.geomspace(1, run.count, MOST_POINTS).round().astype(int)) - 1
    points = [run.points[index] for index in kept]
    return [
        {"table": SERIES, "pipeline": run.name, "frames": p.frames, "render s": p.seconds, "RMSE": p.rmse}
        for p in points
    ]
