"""How a table of results is shown, in a page as in a terminal: spreads beside values, what all rows say once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from warp_gi.bench.harness import catalogue, markdown, records
from warp_gi.cli.report import cell_text, print_table

Columns = dict[str, list[Any]]


@dataclass(frozen=True)
class Shown:
    """A table of results as it is shown."""

    said: str
    """Columns whose value is the same in all rows, in words; empty without any."""
    columns: Columns
    """Values by column: numbers, or words."""
    names: list[str]
    """Columns whose values name what a row is about."""
    numeric: frozenset[str]
    """Columns that hold numbers, also those with a spread beside them or in words."""


def shown(table: records.Table) -> Shown:
    """Return a table without columns of spreads, which stand beside their values, and of what all rows say."""
    columns: Columns = {name: [row[i] for row in table.rows] for i, name in enumerate(table.columns)}
    names = _identity(table)
    shared = [name for name in names[1:] if len(table.rows) > 1 and len(set(columns[name])) == 1]
    said = ", ".join(f"{name} {cell_text(columns.pop(name)[0])}" for name in shared)
    numeric = frozenset(name for name, values in columns.items() if any(records.is_number(value) for value in values))
    columns = {name: [_short(value) for value in values] for name, values in _with_spreads(columns).items()}
    return Shown(f"In all rows: {said}." if said else "", columns, [n for n in names if n not in shared], numeric)


def print_rows(suite: str, rows: Sequence[records.Row], is_titled: bool = True) -> None:
    """Print rows of a suite as tables, one for each set of keys, under the names of suite and table."""
    for table in records.tables_of({**row, "suite": suite} for row in rows):
        one = shown(table)
        head = ": ".join(text for text in (suite * is_titled, table.name) if text)
        places = [place for place, column in enumerate(one.columns) if column in one.names]
        body = list(zip(*one.columns.values(), strict=True))
        print_table(f"{head}\n{one.said}" if one.said else head, list(one.columns), body, places)


def _identity(table: records.Table) -> list[str]:
    """Return the columns whose values name what a row is about."""
    columns = catalogue.columns_of(table.suite)
    values = zip(table.columns, zip(*table.rows, strict=True), strict=True)
    found = [name for name, given in values if any(columns.is_key(name, value) for value in given)]
    return found or list(table.columns[:1])


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
    if isinstance(value, str) and records.SERIES.fullmatch(value.strip()):
        series = value.split()
        return f"{series[0]} … {series[-1]} ({len(series)})"
    return value
