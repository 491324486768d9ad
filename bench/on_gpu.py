"""One command for whoever has a GPU: installs, tests and measures on it, and writes one results file.

``python3 bench/on_gpu.py`` in the project's folder needs nothing but Python. It makes ``.venv``, runs the tests that
run on every device and the quick suites on ``--device`` (cuda), in turns, and writes ``out/on_gpu.jsonl`` after each.
It takes at most ``--minutes`` (10): in the last fifth of them it starts nothing new, and it says what was left out.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]
PYTHON = ROOT / ".venv" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")
MARK = "every_device"
"""Fixture of tests that run on every device; the device is a part of their ids."""
FIRST_TESTS, LAST_TESTS = "tests/kernels", "tests/truth"
FIRST_SUITES = ("rays", "path")
STARTING_SHARE = 0.8
"""Share of the time after which nothing new is started."""
ASK = """
import json, sys
from warp_gi.bench.harness import catalogue, runner
print(json.dumps([runner.environment(sys.argv[1]), list(catalogue.suites())]))
"""
Row = dict[str, Any]


@dataclass
class Session:
    """Programs that are run within a limit of time, and their results."""

    device: str
    output: Path
    end: float
    """Value of time.monotonic at which the running program is stopped, seconds."""
    last_start: float
    environment: Row = field(default_factory=dict)
    rows: list[Row] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    failed: list[str] = field(default_factory=list)

    @property
    def is_over(self) -> bool:
        """Whether it is too late to start another program."""
        return time.monotonic() >= self.last_start

    def run(self, name: str, command: list[str | Path]) -> tuple[int | None, float]:
        """Run a program with its output in a log; return its exit code, None if it was stopped, and its seconds."""
        print(f"{name} ... ", end="", flush=True)
        started = time.monotonic()
        with open(self.output.with_suffix(".log"), "a", encoding="utf-8") as log:
            log.write(f"\n==== {name}: {' '.join(map(str, command))}\n")
            log.flush()
            child = subprocess.Popen(command, cwd=ROOT, stdout=log, stderr=log, start_new_session=True)
            try:
                code = child.wait(max(self.end - started, 1.0))
            except subprocess.TimeoutExpired:
                code = None
            finally:
                end_all(child)
        seconds = time.monotonic() - started
        print(f"{'stopped' if code is None else 'ok' if code == 0 else 'failed'}, {seconds:.0f} s", flush=True)
        if code != 0:
            self.failed.append(name)
        return code, seconds

    def write(self, rows: list[Row]) -> None:
        """Add rows to the results file."""
        self.rows += rows
        text = "".join(json.dumps(row) + "\n" for row in self.rows)
        self.output.write_text(text, encoding="utf-8")


def main() -> int:
    """Run all tests and suites; return 1 if one failed or was stopped."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cuda", help="cuda, cuda:1, or cpu to try this out")
    parser.add_argument("--minutes", type=float, default=10.0, help="most that all of it takes")
    parser.add_argument("--output", type=Path, default=ROOT / "out/on_gpu.jsonl", help="results, one row a line")
    options = parser.parse_args()
    started, seconds = time.monotonic(), 60.0 * options.minutes
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.with_suffix(".log").unlink(missing_ok=True)
    session = Session(options.device, options.output, started + seconds, started + STARTING_SHARE * seconds)
    if not installed(session):
        return 1
    asked = subprocess.run([PYTHON, "-c", ASK, options.device], cwd=ROOT, capture_output=True, text=True)
    if asked.returncode != 0:
        print(asked.stderr.strip().splitlines()[-1])
        return 1
    session.environment, suites = json.loads(asked.stdout.splitlines()[-1])
    for file, suite in itertools.zip_longest(device_tests(), sorted(suites, key=order_of_suite)):
        if file is not None:
            run_tests(session, file)
        if suite is not None:
            run_suite(session, suite)
    print(f"results: {session.output}\nlog: {session.output.with_suffix('.log')}")
    for label, names in (("left out, as the time was over", session.left_out), ("failed", session.failed)):
        if names:
            print(f"{label}: {', '.join(names)}")
    return int(bool(session.failed))


def end_all(child: subprocess.Popen[bytes]) -> None:
    """End a program and those that it started, if it still runs."""
    if child.poll() is None:
        if hasattr(os, "killpg"):
            os.killpg(child.pid, signal.SIGKILL)
        else:
            child.kill()
        child.wait()


def installed(session: Session) -> bool:
    """Make the environment and install the project with what its tests need; return whether that worked."""
    if not PYTHON.exists() and session.run("venv", [sys.executable, "-m", "venv", PYTHON.parents[1]])[0] != 0:
        return False
    return session.run("install", [PYTHON, "-m", "pip", "install", "-q", "-e", ".[test]"])[0] == 0


def device_tests() -> Iterator[Path]:
    """Yield the files of tests that run on every device: kernels first, and pictures last, which take long."""
    found = [path for path in (ROOT / "tests").rglob("test_*.py") if MARK in path.read_text(encoding="utf-8")]
    name_of = {path: path.relative_to(ROOT).as_posix() for path in found}
    yield from sorted(
        found,
        key=lambda path: (not name_of[path].startswith(FIRST_TESTS), name_of[path].startswith(LAST_TESTS), path),
    )


def order_of_suite(name: str) -> tuple[int, str]:
    """Return where a suite stands in turn."""
    return FIRST_SUITES.index(name) if name in FIRST_SUITES else len(FIRST_SUITES), name


def run_tests(session: Session, file: Path) -> None:
    """Run a file's tests on the device; a row tells how many passed."""
    name = file.relative_to(ROOT).as_posix()
    if session.is_over:
        session.left_out.append(name)
        return
    report = session.output.with_suffix(".xml")
    report.unlink(missing_ok=True)
    kind = session.device.partition(":")[0]
    command: list[str | Path] = [PYTHON, "-m", "pytest", "-n", "0", "-q", "-k", kind, f"--junitxml={report}", name]
    code, seconds = session.run(name, command)
    row = {"suite": "device tests", "quick": True, **session.environment, "table": "tests", "file": name}
    if report.exists():
        counts = next(ElementTree.parse(report).iter("testsuite")).attrib
        tests, bad = int(counts["tests"]), int(counts["failures"]) + int(counts["errors"])
        row |= {"passed": tests - bad - int(counts["skipped"]), "failures": bad, "skipped": int(counts["skipped"])}
        report.unlink()
    session.write([row | {"wall s": seconds} | ({"failed": "stopped: no time left"} if code is None else {})])


def run_suite(session: Session, suite: str) -> None:
    """Run the quick form of a suite on the device, and keep its rows."""
    name = f"suite {suite}"
    if session.is_over:
        session.left_out.append(name)
        return
    part = session.output.with_suffix(".part")
    part.unlink(missing_ok=True)
    arguments: list[str | Path] = ["bench", suite, "--quick", "--device", session.device, "--json", part]
    code, _ = session.run(name, [PYTHON, "-m", "warp_gi.cli.main", *arguments])
    rows = [json.loads(line) for line in part.read_text(encoding="utf-8").splitlines()] if part.exists() else []
    if code != 0 and not any("failed" in row for row in rows):
        why = "stopped: no time left" if code is None else f"exit code {code}: {last_error(session)}"
        rows.append({"suite": suite, "quick": True, **session.environment, "failed": why})
    part.unlink(missing_ok=True)
    session.write(rows)


def last_error(session: Session) -> str:
    """Return the last line of the log that is not empty."""
    lines = session.output.with_suffix(".log").read_text(encoding="utf-8", errors="replace").splitlines()
    return re.sub(r"\s+", " ", next((line for line in reversed(lines) if line.strip()), ""))[:200]


if __name__ == "__main__":
    sys.exit(main())
