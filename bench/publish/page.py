"""Makes ``docs/results.md``: results in short by region, then every row as tables that a page has room for."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from warp_gi.bench.harness import catalogue, markdown, records
from warp_gi.bench.harness.tables import shown
from warp_gi.bench.publish.figures import wrapped

MOST_COLUMNS = 12
"""Columns of a table at most; one with more is parted."""
HEAD = (
    "# Results",
    "Generated from `bench/results/*.jsonl` by `python -m warp_gi.bench.publish`; changes made here are lost.",
)
SHORT = (
    "## Results in short",
    "**Bold** marks results that lose to the peer or miss their target.",
)
TABLES = (
    "## All results",
    "Median ± half the range of the middle half, where that was measured. Of a series over frames the first value, the "
    "last and their number; `warp-gi bench --report bench/results/*.jsonl --html FILE` plots it.",
)


def page(rows: Sequence[records.Row], short: Mapping[str, tuple[str, str]]) -> str:
    """Return the page: results in short, then for each suite the machine and commit that measured it, and its tables.

    ``short`` are introductions and texts of regions, by name.
    """
    parts, rows = [*HEAD, *SHORT], records.machines_apart(rows)
    for name, (introduction, text) in short.items():
        parts += [wrapped(introduction), f"<!-- results: {name} -->\n{text}\n<!-- end -->"]
    parts += TABLES
    measures, environments, suite = catalogue.suites(), records.environments(rows), None
    for table in sorted(records.tables_of(rows), key=lambda table: table.suite):
        if table.suite != suite:
            suite = table.suite
            parts += [f"## {suite}", measures.get(suite.partition(catalogue.MACHINE_SEPARATOR)[0], "")]
            parts.append("\n".join(f"- {records.environment_text(one)}" for one in environments.get(suite, [])))
        if table.name:
            parts.append(f"### {table.name}" + (" (the paper's own figures)" if table.is_quoted else ""))
        parts += _tables(table)
    return "\n\n".join(part for part in parts if part) + "\n"


def _tables(table: records.Table) -> list[str]:
    """Return a table of results as Markdown: what all rows say in a line, and one table or more of the rest."""
    one = shown(table)
    parts = [
        markdown.table(
            part, list(zip(*(one.columns[name] for name in part), strict=True)), [name in one.numeric for name in part]
        )
        for part in _parted(list(one.columns), one.names)
    ]
    return [one.said, *parts] if one.said else parts


def _parted(columns: list[str], names: list[str]) -> list[list[str]]:
    """Return columns as those of one table, or of several alike in width that all begin with ``names``."""
    if len(columns) <= MOST_COLUMNS:
        return [columns]
    rest = [column for column in columns if column not in names]
    count = math.ceil(len(rest) / max(MOST_COLUMNS - len(names), 1))
    size = math.ceil(len(rest) / count)
    return [[*names, *rest[start : start + size]] for start in range(0, len(rest), size)]
