"""Columns of results: what the values in them are, in which unit, and what is better. Each suite declares its own.

``COLUMNS = columns(suite, ...)`` in the ``columns.py`` of a suite's folder is the one place that says so. A run whose
rows have other columns fails; plots and documents that refer to other columns fail as they are imported; ``bench
--diff`` and tables take from it what is better, and what tells rows apart.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from warp_gi.bench.harness.records import SERIES
from warp_gi.errors import OptionError

Better = Literal["lower", "higher"] | None
"""Whether lower or higher values are better; None: neither is, or they are not ours, as another renderer's time."""


@dataclass(frozen=True)
class Kind:
    """What a column's values are, and how ``bench --diff`` compares them."""

    name: str
    tolerance: float | None
    """Share that a value may change by where no spread is known; None: values are not compared."""
    is_timed: bool = False
    """Whether values depend on the machine's speed."""
    is_key: bool = False
    """Whether values name what a row is about, and so tell rows apart."""


KEY = Kind("key", None, is_key=True)
NOTE = Kind("note", None)
"""Targets, remarks and series, which are not compared."""
TIME = Kind("time", 0.15, is_timed=True)
RATE = Kind("rate", 0.15, is_timed=True)
RATIO = Kind("ratio", 0.15, is_timed=True)
"""Ratios of times or rates, and exponents of their growth."""
ERROR = Kind("error", 0.05)
"""Errors, ratios of errors, and shares that are right or wrong."""
COUNT = Kind("count", 0.05)
"""Counts and shares of things."""
MEMORY = Kind("memory", 0.05)
SPREADS = ("spread", "+-", "±")
"""A column's name and one of these names the spread of its values, "wall s spread". New rows have the first."""


@dataclass(frozen=True)
class Column:
    """A column of a suite's rows."""

    name: str
    """The key in rows. May hold one ``*``, which stands for any words: "speed-up over *"."""
    unit: str
    """"s", "MB", "W/(m^2 sr)"; empty for words and plain numbers."""
    better: Better
    kind: Kind

    @property
    def said(self) -> str:
        """Unit and direction of improvement in words, for readers of a table."""
        return "; ".join(text for text in (self.unit, f"{self.better} is better" if self.better else "") if text)


def keys(*names: str) -> list[Column]:
    """Return columns whose values name what a row is about."""
    return [Column(name, "", None, KEY) for name in names]


def notes(*names: str) -> list[Column]:
    """Return columns of targets, remarks and series, which are not compared."""
    return [Column(name, "", None, NOTE) for name in names]


def measured(kind: Kind, unit: str, better: Better, *names: str) -> list[Column]:
    """Return columns of one kind and unit."""
    return [Column(name, unit, better, kind) for name in names]


def seconds(prefix: str = "", better: Better = "lower") -> list[Column]:
    """Return the columns of ``measure.Taken.row``."""
    return measured(TIME, "s", better, *(f"{prefix}{kind} s" for kind in ("wall", "cpu", "device")))


def ratios(name: str) -> list[Column]:
    """Return the columns of ``measure.ratios``; ``name`` has {} for the kind of seconds."""
    return measured(RATIO, "times", "higher", *(name.format(kind) for kind in ("wall", "cpu", "device")))


COMMON = (
    *keys("table"),
    *notes("skipped", "failed", "part"),
    *measured(TIME, "s", "lower", "wall s", "cpu s", "compile s"),
    *measured(MEMORY, "GB", "lower", "peak GB", "peak device GB"),
)
"""What rows of every suite may have: why there are none, and what the whole suite took."""


@dataclass(frozen=True)
class Columns:
    """The columns of a suite's rows."""

    suite: str
    by_name: Mapping[str, Column] = field(default_factory=lambda: {one.name: one for one in COMMON})

    def __getitem__(self, name: str) -> Column:
        """Return the column of that name; raises OptionError that names the suite and the nearest column."""
        if (found := self.get(name)) is None:
            near = difflib.get_close_matches(name, self.by_name, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ";"
            raise OptionError(f"suite {self.suite!r} has no column {name!r}{hint} its columns.py declares them")
        return found

    def get(self, name: str) -> Column | None:
        """Return the column of that name, or None."""
        if name in self.by_name:
            return self.by_name[name]
        for pattern, column in self.by_name.items():
            head, star, tail = pattern.partition("*")
            if star and name.startswith(head) and name.endswith(tail) and len(name) > len(pattern) - 1:
                return column
        return None

    def is_key(self, name: str, value: Any) -> bool:
        """Return whether a value says what its row is of; where the column is not declared, words and yes and no do."""
        if (column := self.get(name)) is not None:
            return column.kind.is_key
        return isinstance(value, bool) or (isinstance(value, str) and not SERIES.fullmatch(value.strip()))

    def undeclared(self, rows: Iterable[Mapping[str, Any]]) -> list[str]:
        """Return names in rows that are not declared, and are no spread of one that is."""
        names = dict.fromkeys(name for row in rows for name in row)
        return [name for name in names if self.get(name) is None and not self.is_spread(name)]

    def is_spread(self, name: str) -> bool:
        """Return whether these are the spreads of a declared column."""
        head, _, last = name.rpartition(" ")
        return last in SPREADS and self.get(head) is not None

    def require(self, names: Iterable[str], by: str) -> None:
        """Raise OptionError if one of the names that ``by`` refers to is not declared."""
        for name in names:
            try:
                self[name]
            except OptionError as error:
                raise OptionError(f"{by}: {error}") from None


def columns(suite: str, *groups: Iterable[Column]) -> Columns:
    """Return a suite's columns with those of every suite; raises OptionError if one is declared twice."""
    found: dict[str, Column] = {}
    for column in (column for group in groups for column in group):
        if column.name in found:
            raise OptionError(f"suite {suite!r} declares the column {column.name!r} twice")
        found[column.name] = column
    return Columns(suite, {one.name: one for one in COMMON} | found)
