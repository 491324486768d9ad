"""Makes ``docs/results.md``: every row of the results as tables that a page has room for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from warp_gi.bench import diff, markdown, records, runner
from warp_gi.cli_report import cell_text

MOST_COLUMNS = 12
"""Of a table; one with more is parted."""
HEAD = (
    "# Results",
    "Generated from `bench/results/*.jsonl` by `python -m warp_gi.bench.publish`; changes made here are lost.",
    "Median ± half the range of the middle half, where that was measured. Of a series over frames the first value, the "
    "last and their number; `warp-gi bench --report bench/results/*.jsonl --html FILE` plots it.",
)
Columns = dict[str, list[Any]]


def page(rows: Sequence[records.Row]) -> str:
    """Return the page: for each suite the hardware and commit that it was measured with, and its tables."""
    parts, rows = list(HEAD), records.machines_apart(rows)
    measures, environments, suite = runner.suites(), records.environments(rows), None
    for table in sorted(records.tables_of(rows), key=lambda table: table.suite):
        if table.suite != suite:
            suite = table.suite
            parts += [f"## {suite}", measures.get(suite.split(", machine")[0], "")]
            parts.append("\n".join(f"- {records.environment_text(one)}" for one in environments.get(suite, [])))
        if table.name:
            parts.append(f"### {table.name}" + (" (the paper's own figures)" if table.is_quoted else ""))
        parts += _tables(table)
    return "\n\n".join(part for part in parts if part) + "\n"


def _tables(table: records.Table) -> list[str]:
    """Return a table of results as Markdown: what all rows say in a line, and one table or more of the rest."""
    columns: Columns = {name: [row[i] for row in table.rows] for i, name in enumerate(table.columns)}
    names = _identity(table)
    shared = [name for name in names[1:] if len(table.rows) > 1 and len(set(columns[name])) == 1]
    said = ", ".join(f"{name} {cell_text(columns.pop(name)[0])}" for name in shared)
    numeric = {name for name, values in columns.items() if any(records.is_number(value) for value in values)}
    columns = {name: [_short(value) for value in values] for name, values in _with_spreads(columns).items()}
    parts = [
        markdown.table(part, list(zip(*(columns[name] for name in part), strict=True)), [n in numeric for n in part])
        for part in _parted(list(columns), [name for name in names if name not in shared])
    ]
    return [f"In all rows: {said}.", *parts] if said else parts


def _identity(table: records.Table) -> list[str]:
    """Return the columns that tell what a row is of."""
    found = {key for row in table.rows for key, _ in diff.identity_of(dict(zip(table.columns, row, strict=True)))}
    return [name for name in table.columns if name in found] or list(table.columns[:1])


def _with_spreads(columns: Columns) -> Columns:
    """Return columns without those of spreads, which stand beside the values that they are of."""
    merged, spreads = {}, {f"{name} spread" for name in columns}
    for name, values in columns.items():
        if of_this := columns.get(f"{name} spread"):
            merged[name] = [_with_spread(*pair) for pair in zip(values, of_this, strict=True)]
        elif name not in spreads:
            merged[name] = values
    return merged


def _with_spread(value: Any, spread: Any) -> Any:
    both = records.is_number(value) and records.is_number(spread)
    return markdown.with_spread(value, spread) if both else value


def _short(value: Any) -> Any:
    """Return a value, or of a series of numbers in words the first, the last and the count."""
    if isinstance(value, str) and diff.SERIES.fullmatch(value.strip()):
        series = value.split()
        return f"{series[0]} … {series[-1]} ({len(series)})"
    return value


def _parted(columns: list[str], names: list[str]) -> list[list[str]]:
    """Return columns as those of one table, or of several alike in width that all begin with ``names``."""
    if len(columns) <= MOST_COLUMNS:
        return [columns]
    rest = [column for column in columns if column not in names]
    count = math.ceil(len(rest) / max(MOST_COLUMNS - len(names), 1))
    size = math.ceil(len(rest) / count)
    return [[*names, *rest[start : start + size]] for start in range(0, len(rest), size)]
