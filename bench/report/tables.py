"""Tables of a report, as HTML: spreads beside their values, long tables folded, the paper's figures beside ours."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from html import escape
from typing import Any

from warp_gi.bench.harness import catalogue, markdown, records
from warp_gi.bench.harness.columns import SPREADS, Column
from warp_gi.bench.harness.records import SERIES
from warp_gi.cli.report import cell_text

LONGEST = 30
"""Rows that are shown without being asked for."""
SHORTEST_SERIES = 6
"""Numbers in words that are drawn as a line."""
SPARK = (120, 22)
"""Width and height of that line."""


def tables_html(found: Iterable[records.Table]) -> str:
    """Return tables with their headings; a paper's own stand beside ours of the same name."""
    groups: dict[str, list[records.Table]] = {}
    for table in found:
        groups.setdefault(_group(table), []).append(table)
    return "".join(_beside(group) for group in groups.values())


def _group(table: records.Table) -> str:
    """Return the name of ours that a table stands with: "table 1" of "table 1: paper, RTX 3080"."""
    return table.name.partition(": paper")[0] if table.is_quoted else table.name


def _beside(group: Sequence[records.Table]) -> str:
    if not any(table.is_quoted for table in group):
        return "".join(map(_titled, group))
    ours_first = sorted(group, key=lambda table: table.is_quoted)
    return f'<div class="beside">{"".join(f"<div>{_titled(table)}</div>" for table in ours_first)}</div>'


def _titled(table: records.Table) -> str:
    """Return a table with its heading; one of many rows is folded."""
    name = _title(table)
    heading = f"<h3>{escape(name)}</h3>" if name else ""
    if table.is_quoted:
        where = table.name.partition("paper")[2].strip(" ,:")
        heading += (
            f'<p class="note">Quoted from the paper{escape(f" ({where})" if where else "")}, not measured here.</p>'
        )
    if len(table.rows) <= LONGEST:
        return heading + table_html(table)
    return f'{heading}<details class="fold"><summary>{len(table.rows)} rows</summary>{table_html(table)}</details>'


def _title(table: records.Table) -> str:
    return table.name or ("skipped" if "skipped" in table.columns else "")


def table_html(table: records.Table) -> str:
    """Return a table in a box of its own that scrolls."""
    spreads = _spread_columns(table.columns)
    shown = [index for index in range(len(table.columns)) if index not in spreads.values()]
    numeric = {index: any(records.is_number(row[index]) for row in table.rows) for index in shown}
    columns = catalogue.columns_of(table.suite)
    head = "".join(_header(table.columns[i], columns.get(table.columns[i]), numeric[i]) for i in shown)
    body = ""
    for row in table.rows:
        cells = (
            _cell(row[index], row[spreads[index]] if index in spreads else None, numeric[index], index == shown[0])
            for index in shown
        )
        body += f"<tr>{''.join(cells)}</tr>"
    kind = "table quoted" if table.is_quoted else "table"
    label = escape(_title(table) or " ".join(table.columns[:3]))
    return (
        f'<div class="{kind}" tabindex="0" role="region" aria-label="table {label}">'
        f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def _spread_columns(columns: Sequence[str]) -> dict[int, int]:
    """Return for each column that has a spread the column of the spread."""
    places = {column: index for index, column in enumerate(columns)}
    return {
        index: places[f"{column} {spread}"]
        for column, index in places.items()
        for spread in SPREADS
        if f"{column} {spread}" in places
    }


def _header(name: str, column: Column | None, is_number: bool) -> str:
    """Return a column's head, which says unit and what is better when pointed at."""
    align = ' class="number"' if is_number else ""
    title = f' title="{escape(column.said)}"' if column is not None and column.said else ""
    return f'<th scope="col"{align}{title}><button type="button">{escape(name)}</button></th>'


def _cell(value: Any, spread: Any, is_number: bool, is_first: bool) -> str:
    tag, scope = ("th", ' scope="row"') if is_first else ("td", "")
    css = ' class="number"' if is_number else ' class="long"' if len(str(value)) > 40 else ""
    if (series := series_of(value)) is not None:
        return f'<{tag}{scope} class="series">{_spark(series, str(value))}</{tag}>'
    text, exact = _text(value), ""
    if records.is_number(value):
        said = repr(value)
        if records.is_number(spread) and math.isfinite(value) and math.isfinite(spread):
            text, said = markdown.with_spread(value, spread), f"{value!r} ± {spread!r}"
        exact = f' data-value="{value!r}" title="{said}"'
    return f"<{tag}{scope}{css}{exact}>{escape(text)}</{tag}>"


def _text(value: Any) -> str:
    """Return four digits with their trailing zeros, so that columns line up; whole numbers stay whole."""
    if not isinstance(value, float) or not math.isfinite(value) or value.is_integer():
        return cell_text(value)
    return f"{value:,.0f}" if abs(value) >= 1e4 else f"{value:#.4g}".rstrip(".")


# ---- numbers in words ----


def series_of(value: Any) -> list[float] | None:
    """Return the numbers of a text that holds nothing else and ``SHORTEST_SERIES`` of them or more, or None."""
    if not isinstance(value, str) or not SERIES.fullmatch(value.strip()):
        return None
    try:
        numbers = [float(word) for word in value.split()]
    except ValueError:  # "1-2 3-4" and the like
        return None
    return numbers if len(numbers) >= SHORTEST_SERIES else None


def _spark(series: Sequence[float], text: str) -> str:
    """Return a small line of the numbers over their index, with the first and the last in words."""
    width, height = SPARK
    low, high = min(series), max(series)
    x = [2 + (width - 4) * index / (len(series) - 1) for index in range(len(series))]
    y = [height - 2 - (height - 4) * ((value - low) / (high - low) if high > low else 0.5) for value in series]
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    return (
        f'{escape(_text(series[0]))} <svg class="spark" viewBox="0 0 {width} {height}" width="{width}"'
        f' height="{height}" role="img" aria-label="{len(series)} values: {escape(text)}">'
        f'<title>{escape(text)}</title><polyline points="{points}"/></svg> {escape(_text(series[-1]))}'
    )
