"""Runs benchmark suites and writes their rows as lines of JSON.

A suite is a folder of ``suites`` whose ``suite.py`` has ``run(quick: bool, device: str) -> list[dict]``; see
``catalogue`` for what else it holds. Rows with the same keys make one table. A suite whose ``run`` also takes
``gallery`` adds pictures to it. The last row of each is what the whole suite took.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import time
from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache, partial
from importlib import metadata
from pathlib import Path
from typing import Any

from warp_gi import launch
from warp_gi.bench.harness import catalogue, records
from warp_gi.bench.harness.gallery import CLOSED, Gallery, call
from warp_gi.bench.harness.measure import PeakMemory, attempt
from warp_gi.errors import unknown_name
from warp_gi.files import replacing

WHOLE = "run"
"""Name of the table with the time and memory of a whole suite; all but wall seconds are of this process alone."""


def run_suite(
    name: str, quick: bool, device: str, gallery: Gallery = CLOSED, parts: Sequence[str] = ()
) -> list[dict[str, Any]]:
    """Run a suite and return its rows, the last of them what it took in this process; pictures go to the gallery.

    ``parts`` are names of the suite's ``PARTS``; none are all. Raises OptionError if there is no suite or part of that
    name, or no such device.
    """
    known = catalogue.suites()
    suite = catalogue.module(name, "suite") if name in known else None
    if suite is None:
        raise unknown_name("benchmark suite", name, known)
    launch.get_device(device)
    commit()  # the commit that runs, whatever is committed meanwhile
    for part in parts:
        if part not in (known_parts := getattr(suite, "PARTS", {})):
            raise unknown_name(f"part of suite {name}", part, known_parts)
    compiled, memory = launch.compile_seconds, PeakMemory()
    wall, cpu = time.perf_counter(), time.process_time()
    rows = call(suite.run, quick, device, gallery.of(name), **({"parts": parts} if parts else {}))
    whole = {"table": WHOLE, "wall s": time.perf_counter() - wall, "cpu s": time.process_time() - cpu}
    whole |= {"compile s": launch.compile_seconds - compiled} | memory.row()
    return [*rows, *undeclared_rows(name, rows), whole]


def undeclared_rows(suite: str, rows: Iterable[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row that has failed for each column of ``rows`` that the suite does not declare.

    The measurements stay: they may have taken hours.
    """
    columns = catalogue.columns_of(suite)
    return [
        {"failed": f"column {name!r} of suite {suite!r} is not declared: add it to its columns.py"}
        for name in columns.undeclared(map(records.measured, rows))
    ]


def run_all(quick: bool, device: str, gallery: Gallery = CLOSED) -> Iterator[tuple[str, list[dict[str, Any]]]]:
    """Yield (suite, rows) of every suite in turn; what fails is a row that says why.

    Raises OptionError if there is no such device.
    """
    launch.get_device(device)
    for name in catalogue.suites():
        yield name, attempt({}, partial(run_suite, name, quick, device, gallery))


def has_failed(rows: Iterable[dict[str, Any]]) -> bool:
    """Return whether a row says that something failed."""
    return any("failed" in row for row in rows)


def json_lines(suite: str, rows: Sequence[dict[str, Any]], quick: bool, device: str) -> str:
    """Return each row as a line of JSON, with what is needed to repeat it; ``records.read`` reads them."""
    return _lines(stamped(suite, rows, quick, device))


def stamped(suite: str, rows: Sequence[dict[str, Any]], quick: bool, device: str) -> list[dict[str, Any]]:
    """Return rows with the suite and the environment that they were measured in."""
    common = {"suite": suite, "quick": quick, **environment(device)}
    return [{**common, **row} for row in rows]


def write_json_lines(path: Path, suite: str, rows: Sequence[dict[str, Any]], quick: bool, device: str) -> None:
    """Write ``json_lines`` to a file; raises OSError."""
    write_lines(path, stamped(suite, rows, quick, device))


def write_lines(path: Path, rows: Sequence[dict[str, Any]]) -> None:
    """Write stamped rows to a file, one a line; raises OSError."""
    with replacing(path) as part:
        part.write_text(_lines(rows), encoding="utf-8")


def _lines(rows: Sequence[dict[str, Any]]) -> str:
    return "".join(json.dumps(row, default=float) + "\n" for row in rows)


def environment(device: str) -> dict[str, Any]:
    """Return commit, versions, processor and device that a measurement was made with."""
    import warp_gi

    found = launch.get_device(device)
    return {
        "commit": commit(),
        "warp_gi": warp_gi.__version__,
        "python": platform.python_version(),
        **{package: version for package in records.PACKAGES if (version := _version(package))},
        "cpu": cpu_model(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "threads": launch.thread_count(),
        "device": found.name if found.is_cuda else "cpu",
    }


@lru_cache
def commit() -> str:
    """Return the commit of the working tree, with "+" if it has changes, as it was when this was first asked.

    "unknown" outside of one, also where another project's tree holds this package.
    """
    git = ["git", "-C", str(Path(__file__).parent)]
    if _printed([*git, "ls-files", "--error-unmatch", Path(__file__).name]) is None:
        return "unknown"
    return _printed([*git, "describe", "--always", "--abbrev=12", "--exclude=*", "--dirty=+"]) or "unknown"


def cpu_model() -> str:
    """Return the processor's name."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        return platform.processor() or platform.machine()
    return platform.processor() or platform.machine()


@lru_cache
def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return _blender_version() if package == "bpy" else None


def _blender_version() -> str | None:
    """Return the version of bpy in the Python that is to run Blender, if it is another."""
    python = os.environ.get("WARP_GI_BLENDER_PYTHON")
    return python and _printed([python, "-c", "from importlib import metadata; print(metadata.version('bpy'))"])


def _printed(arguments: Sequence[str]) -> str | None:
    """Return what a program prints, or None if it cannot be run or fails."""
    try:
        result = subprocess.run(arguments, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.SubprocessError):
        return None
    return result.stdout.strip() if result.returncode == 0 else None
