"""What changed between two files of results: slower or less accurate, better, or only in one of them."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from warp_gi.bench.harness import catalogue, records
from warp_gi.bench.harness.columns import COUNT, SPREADS, Column, Columns
from warp_gi.bench.harness.records import ENVIRONMENT
from warp_gi.cli.report import print_table
from warp_gi.errors import OptionError

MACHINE = ("cpu", "cores", "threads", "device")
"""Columns that must be equal in two rows for their times to be compared."""
PEERS = ("mitsuba", "embree", "blender")
"""Beginnings of the names in the column "renderer" that are other renderers, whose times are not ours to improve."""
SPREADS_APART, LEAST_SHARE = 2.0, 0.03
"""How many of both spreads, half of the middle half each, medians of a few turns may differ by: one of twenty medians
of five turns of the same does by more. The share is what runs of one machine differ by in any case; quick ones have too
few turns to know their spread, and take the share of values without one."""
Identity = tuple[tuple[str, Any], ...]


@dataclass(frozen=True)
class Change:
    """A value that changed by more than its spread."""

    identity: Identity
    column: str
    old: float
    new: float
    limit: float
    """Largest change that would have been within the spread."""


@dataclass
class Difference:
    """Result of ``compare``: changes, and rows that only one side has."""

    worse: list[Change] = field(default_factory=list)
    better: list[Change] = field(default_factory=list)
    changed: list[Change] = field(default_factory=list)
    """Changes in columns of which neither lower nor higher is better."""
    only_old: list[tuple[Identity, str]] = field(default_factory=list)
    """Rows, and columns of rows in both; the column of a whole row is empty."""
    only_new: list[tuple[Identity, str]] = field(default_factory=list)
    matched: int = 0
    void: int = 0
    """Times and rates not compared, as their rows are of different machines."""


def identity_of(row: records.Row) -> Identity:
    """Return what a row is about: its suite, whether it is a quick run, and the values of its suite's keys."""
    columns = catalogue.columns_of(str(row.get("suite", "")))
    kept = [(name, value) for name, value in records.measured(row).items() if columns.is_key(name, value)]
    return tuple(sorted([*kept, *((name, row[name]) for name in ("suite", "table", "quick") if name in row)]))


def compare(old: Iterable[records.Row], new: Iterable[records.Row], tolerance: float | None = None) -> Difference:
    """Return what changed; of several rows of one identity the last one's values count.

    ``tolerance`` is the share that values without a known spread may change by; None takes that of the column's kind.
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


def _numbers(row: records.Row, columns: Columns) -> dict[str, float]:
    """Return the values that are compared, by column: of kinds with a tolerance, and of columns not declared."""
    found = {}
    for name, value in records.measured(row).items():
        column = columns.get(name)
        is_compared = column is None or column.kind.tolerance is not None
        if is_compared and records.is_number(value) and not columns.is_spread(name):
            found[name] = value
    return found


def _compare_rows(found: Difference, identity: Identity, old: records.Row, new: records.Row, tolerance: Any) -> None:
    columns = catalogue.columns_of(str(old.get("suite", "")))
    before, after = _numbers(old, columns), _numbers(new, columns)
    found.only_old += [(identity, name) for name in before if name not in after]
    found.only_new += [(identity, name) for name in after if name not in before]
    same_machine = all(old.get(key) == new.get(key) for key in MACHINE)
    is_others = "paper" in str(old.get("table", "")).lower() or str(old.get("renderer", "")).startswith(PEERS)
    for name in (name for name in before if name in after):
        column = columns.get(name) or Column(name, "", None, COUNT)
        if column.kind.is_timed and not same_machine:
            found.void += 1
            continue
        change = Change(identity, name, before[name], after[name], _limit(column, name, old, new, tolerance))
        if _exceeds(change):
            _list_of(found, change, None if is_others else column.better).append(change)


def _limit(column: Column, name: str, old: records.Row, new: records.Row, tolerance: Any) -> float:
    """Return the change that is within the spread: what both spreads allow, or a share of the old value."""
    spreads = [[row[f"{name} {s}"] for s in SPREADS if records.is_number(row.get(f"{name} {s}"))] for row in (old, new)]
    usual = column.kind.tolerance
    if all(spreads):
        least = usual if old.get("quick") else LEAST_SHARE
        return max(SPREADS_APART * (abs(spreads[0][0]) + abs(spreads[1][0])), least * abs(old[name]))
    return (usual if tolerance is None else tolerance) * abs(old[name])


def _exceeds(change: Change) -> bool:
    if not (math.isfinite(change.old) and math.isfinite(change.new)):
        return str(float(change.old)) != str(float(change.new))  # NaN is no news where it was NaN before
    return abs(change.new - change.old) > change.limit * (1 + 1e-9)


def _list_of(found: Difference, change: Change, better: str | None) -> list[Change]:
    if better is None:
        return found.changed
    if math.isfinite(change.old) != math.isfinite(change.new):
        return found.better if math.isfinite(change.new) else found.worse
    return found.better if (change.new > change.old) == (better == "higher") else found.worse


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
    for note in [
        *notes,
        *_undeclared_notes([*before, *after]),
        *_skip_notes("OLD", before),
        *_skip_notes("NEW", after),
    ]:
        print(note)
    if found.void:
        print(f"the machines differ: {found.void} times and rates are not compared")
    _print_changes("worse", found.worse)
    _print_changes("better", found.better)
    _print_only(found)
    if found.changed:
        columns = ", ".join(sorted({change.column for change in found.changed}))
        print(f"\nchanged, neither better nor worse: {len(found.changed)} values of {columns}")
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


def _undeclared_notes(rows: list[records.Row]) -> list[str]:
    """Return a note for each suite with columns that it does not declare: older or newer ones, or another program's."""
    notes = []
    for suite in dict.fromkeys(str(row.get("suite", "")) for row in rows):
        of_suite = (records.measured(row) for row in rows if str(row.get("suite", "")) == suite)
        if names := catalogue.columns_of(suite).undeclared(of_suite):
            notes.append(f"suite {suite!r} declares no columns {', '.join(names)}: nobody knows what is better of them")
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
