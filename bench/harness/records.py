"""Results of benchmarks: read from files of JSON lines, parted into tables and the environment that they come from."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warp_gi.errors import OptionError

Row = dict[str, Any]
PACKAGES = ("warp-lang", "numpy", "mitsuba", "embreex", "pyoidn", "OpenImageIO", "bpy", "pyluxcore")
ENVIRONMENT = ("quick", "commit", "warp_gi", "python", *PACKAGES, "cpu", "cores", "threads", "device")
"""Keys of a line of results that say how it was measured."""
SERIES = re.compile(r"[-+.\deE]+(\s+[-+.\deE]+)+")
"""Pattern of a text that holds a series of numbers over frames."""
MACHINE = ("cpu", "cores", "threads", "device", "quick")
"""Keys that must be equal in figures of one table; commits and versions may differ from part to part."""


def read(paths: Iterable[Path]) -> list[Row]:
    """Return the rows of results files, as ``runner.write_json_lines`` wrote them; empty lines are passed over.

    Raises OSError for a file that cannot be read and OptionError for one that holds no rows, or a line that is
    not a JSON object.
    """
    rows: list[Row] = []
    for path in paths:
        before = len(rows)
        for number, line in enumerate(Path(path).read_bytes().splitlines(), 1):
            if line.strip():
                rows.append(_parsed(line, f"{path}, line {number}"))
        if len(rows) == before:
            raise OptionError(f"{path}: no results in it; expected a file that `warp-gi bench SUITE --json` wrote")
    return rows


def _parsed(line: bytes, place: str) -> Row:
    try:
        row = json.loads(line)
    except (ValueError, RecursionError):
        raise OptionError(f"{place}: not JSON; expected one object a line") from None
    if not isinstance(row, dict):
        raise OptionError(f"{place}: expected a JSON object, got {type(row).__name__}")
    return row


def measured(row: Row) -> Row:
    """Return a line of results without suite, table, commit, versions, processor, device and settings of the run."""
    return {key: value for key, value in row.items() if key not in ("suite", "table", *ENVIRONMENT)}


@dataclass(frozen=True)
class Table:
    """Rows with the same keys."""

    suite: str
    name: str
    """Value of the rows' key "table"; empty without one."""
    columns: tuple[str, ...]
    rows: list[list[Any]]
    """Values in the order of the columns."""

    @property
    def is_quoted(self) -> bool:
        """Whether the rows are a paper's own figures, not ours."""
        return "paper" in self.name.lower()


def tables_of(rows: Iterable[Row]) -> list[Table]:
    """Return rows, of one suite or of several, as tables in the order of their first rows."""
    found: dict[tuple[str, str, tuple[str, ...]], Table] = {}
    for row in rows:
        values = measured(row)
        key = (str(row.get("suite", "")), str(row.get("table", "")), tuple(values))
        found.setdefault(key, Table(*key, [])).rows.append(list(values.values()))
    return list(found.values())


def is_number(value: Any) -> bool:
    """Return whether a value is a number; True and False are not."""
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def environments(rows: Iterable[Row]) -> dict[str, list[Row]]:
    """Return for each suite the distinct environments of its rows, in the order of their first rows."""
    found: dict[str, list[Row]] = {}
    for row in rows:
        known = found.setdefault(str(row.get("suite", "")), [])
        here = {key: row[key] for key in ENVIRONMENT if key in row}
        if here and here not in known:
            known.append(here)
    return found


def machines_apart(rows: Iterable[Row]) -> list[Row]:
    """Return rows as they are, but for those of a suite that ran on several machines, or quick and in full.

    Their key "suite" becomes "rays, machine 1", "rays, machine 2", ... in the order of their first rows.
    """
    rows, known = list(rows), dict[str, list[Row]]()
    for row in rows:
        found = known.setdefault(str(row.get("suite", "")), [])
        if _machine(row) not in found:
            found.append(_machine(row))
    parted = []
    for row in rows:
        found = known[suite := str(row.get("suite", ""))]
        where = f"machine {found.index(_machine(row)) + 1}"  # see catalogue.MACHINE_SEPARATOR
        parted.append(row | {"suite": f"{suite}, {where}" if suite else where} if len(found) > 1 else row)
    return parted


def _machine(row: Row) -> Row:
    return {key: row[key] for key in MACHINE if key in row}


def environment_text(environment: Row) -> str:
    """Return an environment in words."""
    said = dict(environment)
    parts = [f"commit {said.pop('commit')}"] if "commit" in said else []
    if "cpu" in said:
        parts.append(str(said.pop("cpu")))
    parts += [f"{said.pop(key)} {key}" for key in ("cores", "threads") if key in said]
    if "device" in said:
        parts.append(f"device {said.pop('device')}")
    if "quick" in said and said.pop("quick"):
        parts.append("quick run, not for quoting")
    return ", ".join([*parts, *(f"{key} {value}" for key, value in said.items())])
