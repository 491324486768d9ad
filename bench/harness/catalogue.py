"""Finds the suites and what belongs to each of them. A suite is a folder of ``bench/suites``; no list names them.

Files of a suite's folder; only the first two are required:

| file | holds |
|---|---|
| ``suite.py`` | ``run(quick, device, ...) -> rows`` and ``PARTS``; its docstring's first line says what it measures |
| ``columns.py`` | ``COLUMNS``: the columns of its rows |
| ``plots.py`` | ``PLOTS``: the plots that a report draws of its rows |
| ``regions.py`` | ``REGIONS`` of documents, by name, and ``HEADLINES`` of the README, all made from its results |
| ``sequence.py`` | ``CASES``: pipelines that the suite ``sequence`` renders too |
| ``scaling.py`` | ``PARTS``, ``EMITTERS``, ``PIPELINES``: what the suite ``scaling`` measures too |

Columns and plots of what a folder adds to the suite ``scaling`` are ``SCALING`` in its ``columns.py`` and ``plots.py``.
"""

from __future__ import annotations

import ast
import importlib
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from types import ModuleType

from warp_gi.bench.harness.columns import Columns

BENCH = Path(__file__).resolve().parents[1]
ROOT = BENCH.parent
"""The working tree, where there is one."""
FOLDER = BENCH / "suites"
APART = ("compare",)
"""Folders of ``bench`` itself whose rows have columns and plots, as those of a suite do."""
MACHINE_SEPARATOR = ", machine"
"""Stands between a suite's name and a number where several machines ran it."""


def suites() -> dict[str, str]:
    """Return the suites and what they measure, by name, without importing them."""
    found = {}
    for path in sorted(FOLDER.glob("*/suite.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        if any(isinstance(node, ast.FunctionDef) and node.name == "run" for node in tree.body):
            found[path.parent.name] = (ast.get_docstring(tree) or "").partition("\n")[0]
    return found


def module(suite: str, file: str) -> ModuleType | None:
    """Return a module of a suite's folder, such as "columns"; None if there is no such folder or file."""
    folder, package = (BENCH, "warp_gi.bench") if suite in APART else (FOLDER, "warp_gi.bench.suites")
    is_there = suite.isidentifier() and (folder / suite / f"{file}.py").is_file()
    return importlib.import_module(f"{package}.{suite}.{file}") if is_there else None


def modules(file: str) -> Iterator[tuple[str, ModuleType]]:
    """Yield (suite, module) for each suite whose folder has such a file."""
    for path in sorted(FOLDER.glob(f"*/{file}.py")):
        yield path.parent.name, importlib.import_module(f"warp_gi.bench.suites.{path.parent.name}.{file}")


@lru_cache
def columns_of(suite: str) -> Columns:
    """Return the columns of a suite's rows; of one that is unknown, those that every suite has.

    ``suite`` may name a machine too, as ``records.machines_apart`` does.
    """
    found = module(suite.partition(MACHINE_SEPARATOR)[0], "columns")
    return Columns(suite) if found is None else found.COLUMNS
