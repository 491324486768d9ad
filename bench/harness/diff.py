"""What changed between two files of results: slower or less accurate, better, or only in one of them."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from warp_gi.bench.harness import records
from warp_gi.bench.harness.runner import ENVIRONMENT
from warp_gi.cli.report import print_table
from warp_gi.errors import OptionError

SETTINGS = frozenset(
    {"spp", "resolution", "rays a pixel", "degrees", "bits", "migrations", "width", "height", "depth"}
    | {"triangles", "lights", "Mpixels", "samples", "threads used"}
)
"""Numbers that say what was measured, as words do, and are no outcome."""
MACHINE = ("cpu", "cores", "threads", "device")
"""Where these differ, times cannot be compared."""
REMARKS = ("target", "targets", "says", "skipped", "failed")
PEERS = ("mitsuba", "embree", "blender")
"""What a row's renderer is called where it is not ours to be slower."""
SPREADS = ("spread", "+-", "±")
SERIES = re.compile(r"[-+.\deE]+(\s+[-+.\deE]+)+")
"""Numbers in words, an outcome."""
SPREADS_APART, LEAST_SHARE = 2.0, 0.03
"""How many of both spreads, half of the middle half each, medians of a few turns may differ by: one of twenty medians
of five turns of the same does by more. The share is what runs of one machine differ by in any case; quick ones have too
few turns to know their spread, and take the share of values without one."""
Identity = tuple[tuple[str, Any], ...]


@dataclass(frozen=True)
class Measure:
    """What a column's name says of it."""

    higher_is_better: bool
    tolerance: float
    """Share that a value may change by where no spread is known."""
    timed: bool
    """Whether it depends on the machine's speed."""


TIME, RATE = Measure(False, 0.15, True), Measure(True, 0.15, True)
ERROR, ACCURACY, MEMORY = Measure(False, 0.05, False), Measure(True, 0.05, False), Measure(False, 0.05, False)

RULES: tuple[tuple[str, Measure | None], ...] = (
    (r"\bpaper|\b(in|for) this\b", None),
    (r"faster|speed-?up|efficiency|^times |(^| )x$|^ratio (wall|cpu|device)$", RATE),
    (r"^(ours|in order) / |/ ours$|/ raw,|^of tree$", RATE),
    (r"^(mitsuba|embree|blender|warp|tree|raw|traced|without)\b", None),  # peers and baselines: not ours to be slower
    (r"/ ?((wall|cpu) )?s$|\ba minute$", RATE),
    (r"\bagree|\bPSNR\b", ACCURACY),
    (r"\bequal time$|\b(time|cost|paths) / baseline$", TIME),
    (r"\bequal samples$|/ baseline$|MSE\b|\b(bad|black) pixels\b|\bFLIP\b|\berrors?\b|\bwrong\b|\bbias\b", ERROR),
    (r"\buntil settled$|^dark / lit$|^peak / settled$", ERROR),
    (r"^(exponent|growth)\b", TIME),
    (r"\b(bytes|[kKMG]i?B)\b", MEMORY),
    (r"(^|[ (])(ns|us|µs|ms|s|seconds|minutes)($|[ ,)])", TIME),
)
"""The first that is found in a column's name tells; a column without a rule is neither better nor worse."""


@dataclass(frozen=True)
class Change:
    """A value that changed by more than its spread."""

    identity: Identity
    column: str
    old: float
    new: float
    limit: float
    """The change that would have been within the spread."""


@dataclass
class Difference:
    """What ``compare`` finds."""

    worse: list[Change] = field(default_factory=list)
    better: list[Change] = field(default_factory=list)
    changed: list[Change] = field(default_factory=list)
    """By name neither better nor worse."""
    only_old: list[tuple[Identity, str]] = field(default_factory=list)
    """Rows, and columns of rows in both; the column of a whole row is empty."""
    only_new: list[tuple[Identity, str]] = field(default_factory=list)
    matched: int = 0
    void: int = 0
    """Times and rates not compared, as their rows are of different machines."""


def measure_of(column: str) -> Measure | None:
    """Return what is better of a column's values, or None if its name does not say."""
    return next((measure for pattern, measure in RULES if re.search(pattern, column)), None)


def identity_of(row: records.Row) -> Identity:
    """Return what a row is of: suite, quick or full, words, yes and no, and settings."""
    left_out = {*ENVIRONMENT, *REMARKS} - {"quick"}
    return tuple(sorted((k, v) for k, v in row.items() if k not in left_out and _names(k, v)))


def _names(key: str, value: Any) -> bool:
    if isinstance(value, str):
        return not SERIES.fullmatch(value.strip())
    return isinstance(value, bool) or (key in SETTINGS and records.is_number(value))


def compare(old: Iterable[records.Row], new: Iterable[records.Row], tolerance: float | None = None) -> Difference:
    """Return what changed; of several rows of one identity the last one's values count.

    ``tolerance`` is the share that values without a known spread may change by; None takes 0.15 for times and
    rates and 0.05 for errors and memory.
    """
    before, after = _by_identity(old), _by_identity(new)
    found = Difference()
    found.only_old = [(identity, "") for identity in before if identity not in after]
    found.only_new = [(identity, "") for identity in after if identity not in before]
    for identity, row in before.items():
        if identity in after:
            found.matched += 1
            _compare_rows(found, identity, row, after[identity], tolerance)
    return found


def _by_identity(rows: Iterable[records.Row]) -> dict[Identity, records.Row]:
    found: dict[Identity, records.Row] = {}
    for row in rows:
        if "skipped" not in row and "failed" not in row:
            identity = identity_of(row)
            found[identity] = found.get(identity, {}) | row
    return found


def _numbers(row: records.Row) -> dict[str, float]:
    left_out = {*SETTINGS, *ENVIRONMENT, *REMARKS, *(f"{key} {spread}" for key in row for spread in SPREADS)}
    return {key: value for key, value in row.items() if records.is_number(value) and key not in left_out}


def _compare_rows(found: Difference, identity: Identity, old: records.Row, new: records.Row, tolerance: Any) -> None:
    before, after = _numbers(old), _numbers(new)
    found.only_old += [(identity, column) for column in before if column not in after]
    found.only_new += [(identity, column) for column in after if column not in before]
    same_machine = all(old.get(key) == new.get(key) for key in MACHINE)
    is_others = "paper" in str(old.get("table", "")).lower() or str(old.get("renderer", "")).startswith(PEERS)
    for column in (column for column in before if column in after):
        measure = None if is_others else measure_of(column)
        if measure and measure.timed and not same_machine:
            found.void += 1
            continue
        change = Change(identity, column, before[column], after[column], _limit(column, old, new, measure, tolerance))
        if _exceeds(change):
            _list_of(found, change, measure).append(change)


def _limit(column: str, old: records.Row, new: records.Row, measure: Measure | None, tolerance: Any) -> float:
    """Return the change that is within the spread: what both spreads allow, or a share of the old value."""
    spreads = [
        [row[f"{column} {s}"] for s in SPREADS if records.is_number(row.get(f"{column} {s}"))] for row in (old, new)
    ]
    usual = measure.tolerance if measure else ERROR.tolerance
    if all(spreads):
        least = usual if old.get("quick") else LEAST_SHARE
        return max(SPREADS_APART * (abs(spreads[0][0]) + abs(spreads[1][0])), least * abs(old[column]))
    return (usual if tolerance is None else tolerance) * abs(old[column])


def _exceeds(change: Change) -> bool:
    if not (math.isfinite(change.old) and math.isfinite(change.new)):
        return str(float(change.old)) != str(float(change.new))  # NaN is no news where it was NaN before
    return abs(change.new - change.old) > change.limit * (1 + 1e-9)


def _list_of(found: Difference, change: Change, measure: Measure | None) -> list[Change]:
    if measure is None:
        return found.changed
    if math.isfinite(change.old) != math.isfinite(change.new):
        return found.better if math.isfinite(change.new) else found.worse
    return found.better if (change.new > change.old) == measure.higher_is_better else found.worse


# ---- printing ----


def diff_files(old: Path, new: Path, tolerance: float | None = None) -> int:
    """Print what changed from one results file to another; return 1 if something is worse, else 0.

    Raises OSError or OptionError for files without results, a tolerance that is none, or files that share no row.
    """
    if tolerance is not None and not 0 <= tolerance < math.inf:
        raise OptionError(f"--tolerance: expected a share such as 0.1, got {tolerance}")
    before, after = records.read([old]), records.read([new])
    found = compare(before, after, tolerance)
    notes = _environment_notes(before, after)
    if not found.matched:
        hint = f" ({notes[-1]})" if any(note.startswith("quick") for note in notes) else ""
        raise OptionError(f"no row of {new} is in {old}, so nothing can be compared{hint}")
    for note in [*notes, *_skip_notes("OLD", before), *_skip_notes("NEW", after)]:
        print(note)
    if found.void:
        print(f"the machines differ: {found.void} times and rates are not compared")
    _print_changes("worse", found.worse)
    _print_changes("better", found.better)
    _print_only(found)
    if found.changed:
        columns = ", ".join(sorted({change.column for change in found.changed}))
        print(f"\nchanged, by name neither better nor worse: {len(found.changed)} values of {columns}")
    print(f"\n{found.matched} rows compared: {len(found.worse)} values worse, {len(found.better)} better")
    return int(bool(found.worse))


def _environment_notes(old: list[records.Row], new: list[records.Row]) -> list[str]:
    notes = []
    for key in (*(key for key in ENVIRONMENT if key != "quick"), "quick"):
        before, after = (list(dict.fromkeys(str(row[key]) for row in rows if key in row)) for rows in (old, new))
        if set(before) != set(after):
            if key == "quick":
                notes.append("quick and full runs measure different inputs: their rows are not matched")
            else:
                notes.append(f"{key}: {', '.join(before) or 'not said'} -> {', '.join(after) or 'not said'}")
    return notes


def _skip_notes(name: str, rows: list[records.Row]) -> list[str]:
    reasons = [str(row[key]) for row in rows for key in ("skipped", "failed") if key in row]
    return [f"{name} has {len(reasons)} rows skipped or failed: {'; '.join(dict.fromkeys(reasons))}"] if reasons else []


def _row_text(identity: Identity) -> str:
    said = [(key, value) for key, value in identity if key not in ("suite", "table", "quick")]
    values = (value if isinstance(value, str) else f"{key} {value}" for key, value in said)
    table = dict(identity).get("table")
    return (f"{table}: " if table else "") + ", ".join(values)


def _print_changes(title: str, changes: list[Change]) -> None:
    if not changes:
        print(f"\n{title}: nothing")
        return
    columns = ("suite", "row", "column", "old", "new", "change", "spread")
    rows = []
    for change in changes:
        share = f"{change.new / change.old - 1:+.1%}" if change.old and math.isfinite(change.new / change.old) else ""
        spread = f"{change.limit / abs(change.old):.1%}" if change.old and math.isfinite(change.old) else ""
        suite = dict(change.identity).get("suite", "")
        rows.append((suite, _row_text(change.identity), change.column, change.old, change.new, share, spread))
    print_table(title, columns, rows)


def _print_only(found: Difference) -> None:
    sides = (("OLD", found.only_old), ("NEW", found.only_new))
    rows = [
        (name, dict(identity).get("suite", ""), _row_text(identity), column or "all")
        for name, side in sides
        for identity, column in side
    ]
    if rows:
        print_table("only in one of the files", ("file", "suite", "row", "columns"), rows)
    else:
        print("\nonly in one of the files: nothing")
