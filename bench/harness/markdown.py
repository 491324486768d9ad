"""Tables and numbers as Markdown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from warp_gi.bench.harness import records
from warp_gi.cli.report import cell_text


def table(columns: Sequence[str], rows: Sequence[Sequence[Any]], numeric: Sequence[bool] = ()) -> str:
    """Return a table; columns with a number, or for which ``numeric`` says so, stand to the right."""
    right = [any(records.is_number(row[i]) for row in rows) for i in range(len(columns))]
    rule = ["--:" if flag else "---" for flag in numeric or right]
    lines = [columns, *([cell_text(value) for value in row] for row in rows)]
    head, *body = (f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in line)} |" for line in lines)
    return "\n".join([head, f"|{'|'.join(rule)}|", *body])


def significant(value: float, digits: int) -> str:
    """Return a number with at least ``digits`` significant digits, all of those before the point, thousands parted."""
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:,.{decimals(value, digits)}f}"


def with_spread(value: float, spread: float) -> str:
    """Return a value and its spread, as far as the spread's first digit or the value's fourth."""
    count = min(decimals(spread, 1), decimals(value, 4)) if spread else decimals(value, 4)
    return f"{value:,.{count}f} ± {spread:,.{count}f}"


def decimals(value: float, digits: int) -> int:
    """Return how many digits after the point make ``digits`` significant ones; none for what is not finite."""
    if not value or not math.isfinite(value):
        return 0
    exponent = int(f"{value:.{digits - 1}e}".partition("e")[2])
    return max(digits - 1 - exponent, 0)
