"""``warp-gi bench``: the suites of ``bench/``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from warp_gi import launch
from warp_gi.bench import runner
from warp_gi.cli_options import parse_options
from warp_gi.cli_report import print_table, start_warp


@dataclass
class Bench:
    """Run a benchmark suite and print its tables. Without SUITE, list the suites."""

    suite: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SUITE", help_behavior_hint="")] = ""
    """Name of a module in bench/."""
    quick: bool = False
    """Smaller inputs, for a first look; not for figures that anyone quotes."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """Also write each row as a line of JSON, with commit, versions, processor and settings; - prints the lines."""
    device: str = "cpu"
    """cpu, cuda or cuda:1."""
    threads: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: every core)")] = None
    """Threads on the CPU."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse_options(Bench, "bench", arguments)
    if not options.suite:
        print_table("suites", ("name", "what it measures"), sorted(runner.suites().items()))
        return 0
    start_warp(options.device)
    if options.threads is not None:
        launch.set_threads(options.threads)
    rows = runner.run_suite(options.suite, options.quick, options.device)
    runner.print_rows(options.suite, rows)
    if options.json == Path("-"):
        print(runner.json_lines(options.suite, rows, options.quick, options.device), end="")
    elif options.json is not None:
        runner.write_json_lines(options.json, options.suite, rows, options.quick, options.device)
        print(f"rows: {options.json}")
    return 0
