"""What regions of documents are made of: tables and sentences whose figures are looked up in a suite's results."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from warp_gi.bench.harness import markdown, records
from warp_gi.bench.harness.columns import Columns
from warp_gi.errors import OptionError

Only = Mapping[str, Any]
"""Values that rows must have; one of them, where it is a tuple."""
ENVIRONMENT = ("quick", "commit", "cpu", "threads", "device", "warp-lang", "mitsuba", "embreex")
"""What a region says of how its suite was measured; the page of results says all."""
WIDTH = 120


@dataclass(frozen=True)
class Figure:
    """A value of the results; their range if several rows have one."""

    key: str
    """The column."""
    only: Only = field(default_factory=dict)
    digits: int = 2
    """Significant ones, at least."""
    scale: float = 1.0
    at_least: float | str | None = None
    """Least value that is not bold: a number, or the column that holds it."""
    at_most: float | str | None = None
    table: str | None = None
    """Table of the results, if it is not that of the paragraph or grid."""
    over: str = ""
    """A column that each row's value is divided by."""

    @property
    def names(self) -> list[str]:
        """The columns that it refers to."""
        limits = [limit for limit in (self.at_least, self.at_most) if isinstance(limit, str)]
        return [self.key, *self.only, *limits, *([self.over] if self.over else [])]


@dataclass(frozen=True)
class GridColumn:
    """A column of a table."""

    header: str
    figure: Figure
    unless: Only = field(default_factory=dict)
    """Rows with these values have nothing to show."""


@dataclass(frozen=True)
class Grid:
    """A table of a region."""

    header: str
    """Header of the first column."""
    lines: Mapping[str, Only] | str
    """Cells of the first column, and the rows of the results that each line shows; or the name of a key column, each of
    whose values makes a line."""
    columns: tuple[GridColumn, ...]
    table: str = ""

    @property
    def names(self) -> list[str]:
        """The columns of the results that it refers to."""
        lines = [self.lines] if isinstance(self.lines, str) else [key for only in self.lines.values() for key in only]
        of_columns = [name for column in self.columns for name in (*column.figure.names, *column.unless)]
        return [*lines, *of_columns]


@dataclass(frozen=True)
class Text:
    """A paragraph of a region."""

    words: str
    """Text with names of figures in braces."""
    figures: Mapping[str, Figure]
    table: str = ""

    @property
    def names(self) -> list[str]:
        """The columns of the results that it refers to."""
        return [name for figure in self.figures.values() for name in figure.names]


@dataclass(frozen=True)
class Region:
    """A part of a document that one suite's results make, and a line that tells how they were measured.

    Making one raises OptionError for a column that the suite does not declare.
    """

    columns: Columns
    """The columns of its suite."""
    introduction: str
    """Paragraph above it in the page of results."""
    parts: tuple[Grid | Text, ...]

    def __post_init__(self) -> None:
        for part in self.parts:
            self.columns.require(part.names, f"region of {self.suite!r}, {part.table or 'no table'}")

    @property
    def suite(self) -> str:
        """The suite's name."""
        return self.columns.suite


@dataclass(frozen=True)
class Headline:
    """A line of the README's table of techniques: one result in a few words.

    Making one raises OptionError for a column that the suite does not declare.
    """

    columns: Columns
    technique: str
    """Name of the class."""
    purpose: str
    """What it does, in a few words."""
    text: Text
    title: str
    """Title of its page."""
    page: str
    """File of ``docs/techniques``, without its suffix."""
    paper: str = ""
    is_base: bool = False
    """Whether it is of what techniques stand on; such lines come last."""

    def __post_init__(self) -> None:
        self.columns.require(self.text.names, f"headline of {self.technique!r}")


def region_text(name: str, region: Region, rows: Sequence[records.Row]) -> str:
    """Return a region as Markdown; raises OptionError where the results have no value for a figure."""
    source = _Source.of(name, region.suite, rows)
    parts = [source.grid(part) if isinstance(part, Grid) else wrapped(source.words(part)) for part in region.parts]
    return "\n\n".join([*parts, wrapped(f"<sub>Measured at {source.environment()}.</sub>")])


def headlines_text(headlines: Sequence[Headline], rows: Sequence[records.Row]) -> str:
    """Return the table of headlines as Markdown; raises OptionError where the results have no value for a figure."""
    lines = []
    for one in sorted(headlines, key=lambda one: one.is_base):
        words = _Source.of("headlines", one.columns.suite, rows).words(one.text)
        link = f"[{one.title}](docs/techniques/{one.page}.md)"
        lines.append([f"`{one.technique}`", one.purpose, words, f"{link}, after {one.paper}" if one.paper else link])
    return markdown.table(["technique", "what it does", "headline", "page"], lines)


@dataclass(frozen=True)
class _Source:
    """The rows that a region is made from."""

    region: str
    suite: str
    rows: list[records.Row]

    @staticmethod
    def of(region: str, suite: str, rows: Sequence[records.Row]) -> _Source:
        return _Source(region, suite, [row for row in rows if row.get("suite") == suite])

    def grid(self, grid: Grid) -> str:
        chosen = grid.lines
        if isinstance(chosen, str):
            values = [row[chosen] for row in self.rows if _has(row, {"table": grid.table}) and chosen in row]
            chosen = {str(value): {chosen: value} for value in dict.fromkeys(values)}
        lines = [
            [label, *(self._cell(column, grid.table, only) for column in grid.columns)]
            for label, only in chosen.items()
        ]
        headers = [grid.header, *(column.header for column in grid.columns)]
        return markdown.table(headers, lines, [False, *(True for _ in grid.columns)])

    def words(self, text: Text) -> str:
        figures = {key: _shown(figure, self._rows(figure, text.table, {})) for key, figure in text.figures.items()}
        return text.words.format_map(figures)

    def environment(self) -> str:
        """Return what the suite was measured with, each thing once."""
        said: records.Row = {}
        for key in ENVIRONMENT:
            found = [one[key] for one in records.environments(self.rows).get(self.suite, []) if key in one]
            if found:
                said[key] = any(found) if key == "quick" else ", ".join(dict.fromkeys(map(str, found)))
        return records.environment_text(said)

    def _cell(self, column: GridColumn, table: str, only: Only) -> str:
        rows = self._rows(column.figure, table, only)
        if column.unless and all(_has(row, column.unless) for row in rows):
            return "none"
        return _shown(column.figure, rows)

    def _rows(self, figure: Figure, table: str, only: Only) -> list[records.Row]:
        """Return the rows that have a value of the figure; raises OptionError if there is none."""
        wanted = {"table": table if figure.table is None else figure.table, **only, **figure.only}
        found = [
            row for row in self.rows if _has({"table": ""} | row, wanted) and row.get(figure.key) not in (None, "")
        ]
        if not found:
            said = ", ".join(f"{key} {value!r}" for key, value in wanted.items() if value != "") or "any row"
            raise OptionError(
                f"region {self.region!r}: the results of suite {self.suite!r} have no value of {figure.key!r}"
                f" for {said}; `warp-gi bench {self.suite} --json FILE` measures it"
            )
        return found


def _has(row: records.Row, only: Only) -> bool:
    return all(row.get(key) in (value if isinstance(value, tuple) else (value,)) for key, value in only.items())


def _shown(figure: Figure, rows: Sequence[records.Row]) -> str:
    values = [row[figure.key] / row[figure.over] if figure.over else row[figure.key] for row in rows]
    if not all(records.is_number(value) for value in values):
        return ", ".join(dict.fromkeys(map(str, values)))
    if figure.scale != 1.0:
        values = [value * figure.scale for value in values]
    low, high = (markdown.significant(value, figure.digits) for value in (min(values), max(values)))
    text = low if low == high else f"{low} to {high}"
    return f"**{text}**" if any(_is_missed(figure, row) for row in rows) else text


def _is_missed(figure: Figure, row: records.Row) -> bool:
    least, most = (row.get(limit) if isinstance(limit, str) else limit for limit in (figure.at_least, figure.at_most))
    value = row[figure.key]
    return (records.is_number(least) and value < least) or (records.is_number(most) and value > most)


def wrapped(text: str) -> str:
    """Return a paragraph in lines of at most ``WIDTH`` characters."""
    return textwrap.fill(text, WIDTH, break_long_words=False, break_on_hyphens=False)
