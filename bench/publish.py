"""Writes what the documents say of measurements: ``docs/results.md``, and the marked tables of ``README.md``.

``python -m warp_gi.bench.publish [--check]``. All of it comes from ``bench/results/*.jsonl``. A table of the README
stands between ``<!-- results: NAME -->`` and ``<!-- end -->``; ``REGIONS`` says what goes there. ``--check`` writes
nothing, and leaves with exit code 1 if a file is not what it would write.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warp_gi.bench import records, runner
from warp_gi.cli_report import cell_text
from warp_gi.errors import GiError, OptionError, unknown_name
from warp_gi.files import replacing

ROOT = runner.FOLDER.parent
PAGE, README = Path("docs/results.md"), Path("README.md")
REGION = re.compile(r"(<!-- results: (?P<name>[^\n]*?) -->\n)(?P<text>.*?)(?P<end><!-- end -->|\Z)", re.DOTALL)


@dataclass(frozen=True)
class Column:
    """A column of a README's table."""

    header: str
    key: str
    digits: int = 3
    """Significant ones."""
    bold_below: float = float("-inf")
    """Values below are bold: what is not in our favour."""


@dataclass(frozen=True)
class Region:
    """A table of the README: one row for each value of ``by`` that has all columns, whichever rows they are in."""

    suite: str
    by: str
    header: str
    columns: tuple[Column, ...]
    table: str = ""


REGIONS = {
    "path": Region(
        "path",
        "case",
        "picture",
        (
            Column("ours, s", "ours wall s", 2),
            Column("Mitsuba, s", "mitsuba wall s", 2),
            Column("faster", "faster, wall", bold_below=1.0),
            Column("relMSE, ours / Mitsuba", "error ratio", 2),
            Column("faster at equal error", "faster at equal error, cpu", bold_below=1.0),
        ),
    )
}


def page(rows: Sequence[records.Row]) -> str:
    """Return ``docs/results.md``: for each suite the hardware and commit that it was measured with, and its tables."""
    parts = [
        "# Results",
        "Generated from `bench/results/*.jsonl` by `python -m warp_gi.bench.publish`; changes made here are lost.",
    ]
    measures, environments, suite = runner.suites(), records.environments(rows), None
    for table in sorted(records.tables_of(rows), key=lambda table: table.suite):
        if table.suite != suite:
            suite = table.suite
            parts += [f"## {suite}", measures.get(suite, "")]
            parts.append("\n".join(f"- {records.environment_text(one)}" for one in environments.get(suite, [])))
        if table.name:
            parts.append(f"### {table.name}" + (" (the paper's own figures)" if table.is_quoted else ""))
        parts.append(_markdown(table.columns, table.rows))
    return "\n\n".join(part for part in parts if part) + "\n"


def readme(text: str, rows: Sequence[records.Row]) -> str:
    """Return the README's text with its marked tables made anew; raises OptionError for marks that cannot be filled."""

    def filled(match: re.Match[str]) -> str:
        name = match["name"]
        if not match["end"] or "<!-- results:" in match["text"]:
            raise OptionError(f"README: <!-- results: {name} --> has no <!-- end -->")
        if name not in REGIONS:
            raise unknown_name("table of results", name, REGIONS)
        return f"{match[1]}{region_table(REGIONS[name], rows)}\n{match['end']}"

    return REGION.sub(filled, text)


def region_table(region: Region, rows: Sequence[records.Row]) -> str:
    """Return a README's table as Markdown; raises OptionError if the results have no row for it."""
    merged: dict[Any, records.Row] = {}
    for row in rows:
        if row.get("suite") == region.suite and row.get("table", "") == region.table and region.by in row:
            merged[row[region.by]] = merged.get(row[region.by], {}) | row
    lines = [
        [name, *(_significant(row[column.key], column) for column in region.columns)]
        for name, row in merged.items()
        if all(column.key in row for column in region.columns)
    ]
    if not lines:
        keys = ", ".join(repr(column.key) for column in region.columns)
        raise OptionError(f"README: the results of suite {region.suite!r} have no row with all of {keys}")
    return _markdown([region.header, *(column.header for column in region.columns)], lines)


def _significant(value: float, column: Column) -> str:
    text = f"{value:#.{column.digits}g}".rstrip(".")
    return f"**{text}**" if value < column.bold_below else text


def _markdown(columns: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    rule = ["--:" if any(records.is_number(row[i]) for row in rows) else "---" for i in range(len(columns))]
    lines = [columns, *([cell_text(value) for value in row] for row in rows)]
    head, *body = (f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines)
    return "\n".join([head, f"|{'|'.join(rule)}|", *body])


def pages(root: Path) -> dict[Path, str]:
    """Return what the documents under ``root`` should say; raises OSError or OptionError where results are missing."""
    files = sorted((root / "bench/results").glob("*.jsonl"))
    if not files:
        raise OptionError(f"{root / 'bench/results'}: no *.jsonl there; `warp-gi bench SUITE --json FILE` writes them")
    rows = records.read(files)
    return {PAGE: page(rows), README: readme((root / README).read_text(encoding="utf-8"), rows)}


def publish(root: Path, check: bool = False) -> list[Path]:
    """Write the documents that are not what they should be, or with ``check`` only find them; return their paths."""
    stale = []
    for path, text in pages(root).items():
        file = root / path
        if not file.exists() or file.read_text(encoding="utf-8") != text:
            stale.append(path)
            if not check:
                with replacing(file) as part:
                    part.write_text(text, encoding="utf-8")
    return stale


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 1 if ``--check`` finds a file that differs, or 2 for results that cannot be used."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit code 1 if a file differs")
    options = parser.parse_args(arguments)
    try:
        stale = publish(ROOT, options.check)
    except (GiError, OSError) as error:
        print(f"publish: error: {error}", file=sys.stderr)
        return 2
    for path in stale:
        print(f"{path}: differs; run `python -m warp_gi.bench.publish`" if options.check else f"wrote {path}")
    return int(options.check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
