"""``warp-gi bench``: the suites of ``bench/``, reports of their results, and what changed between two of them."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from warp_gi.bench.harness import catalogue, diff, records, runner, tables
from warp_gi.bench.harness.gallery import Gallery, PictureSet
from warp_gi.cli.options import flag, parse_options
from warp_gi.cli.report import print_table, start_warp
from warp_gi.errors import OptionError
from warp_gi.files import check_writable

ALL = "all"


@dataclass
class Bench:
    """Run a benchmark suite and print its tables. Without SUITE, list the suites.

    warp-gi bench compare, which has options of its own, compares pipelines on a scene that you name.
    --report makes a report of results files, and --diff compares two of them; neither runs anything.
    """

    suite: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SUITE", help_behavior_hint="")] = ""
    """Name of a suite that warp-gi bench lists, or all."""
    parts: Annotated[tuple[str, ...], flag("NAME...", "all of them")] = ()
    """Names of parts of the suite to run; a wrong name tells which there are."""
    quick: bool = False
    """Run smaller inputs, for a first look. Do not quote figures from them."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: none)")] = None
    """File for the rows, a line of JSON each, with commit, versions, processor and settings; - prints the lines."""
    html: Annotated[Path | None, flag("FILE", "none")] = None
    """File for tables, plots and the pictures that suites compare: one HTML file that needs no network."""
    report: Annotated[tuple[Path, ...], flag("RESULTS...", "none")] = ()
    """Results files that --json wrote, to make the --html report of."""
    diff: Annotated[tuple[Path, Path] | None, flag("OLD NEW", "none")] = None
    """Two results files to compare: prints what became worse or better beyond the spread. Exit code 1 if anything
    is worse."""
    tolerance: Annotated[float | None, flag("SHARE", "0.15 for times, 0.05 for errors")] = None
    """Share by which --diff lets values change whose spread is not known."""
    device: str = "cpu"
    """Device to compute on: cpu, cuda or cuda:1."""
    threads: Annotated[int | None, tyro.conf.arg(metavar="N", help_behavior_hint="(default: every core)")] = None
    """Number of threads on the CPU."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    if arguments[:1] == ["compare"]:
        return importlib.import_module("warp_gi.cli.bench_compare").main(arguments[1:])
    options = parse_options(Bench, "bench", arguments)
    _check(options)
    if options.diff is not None:
        return diff.diff_files(*options.diff, options.tolerance)
    if options.report and options.html is not None:  # both, as _check has seen to
        write_html(options.html, records.read(options.report))
    elif options.suite == ALL:
        return _run_all(options)
    elif options.suite:
        return _run(options)
    else:
        others = [(ALL, "Every suite in turn."), ("compare", "Pipelines on a scene of your own; see its --help.")]
        print_table("suites", ("name", "what it measures"), [*sorted(catalogue.suites().items()), *others])
    return 0


def _check(options: Bench) -> None:
    if options.diff is not None and (options.suite or options.report or options.html or options.json):
        raise OptionError("--diff compares two files and goes with --tolerance alone")
    if options.diff is None and options.tolerance is not None:
        raise OptionError("--tolerance is for --diff OLD NEW")
    if options.report and (options.suite or options.json):
        raise OptionError("--report runs nothing: give it results files and --html FILE, without SUITE or --json")
    if options.parts and options.suite in ("", ALL):
        raise OptionError("--parts is for one SUITE; give its name")
    if not options.suite and (options.quick or options.threads is not None or options.device != "cpu"):
        raise OptionError("--quick, --device and --threads are for a SUITE to run; give its name")
    if options.suite == "compare":
        raise OptionError("compare comes first and has options of its own: warp-gi bench compare --help")
    if options.report and options.html is None:
        raise OptionError("--report needs --html FILE, to write the report to")
    if (options.html or options.json) and not (options.suite or options.report):
        raise OptionError("nothing to write: give a SUITE to run, or --report RESULTS... with --html FILE")
    for name, path in (("--html", options.html), ("--json", options.json)):
        if path is not None and path.is_dir():
            raise OptionError(f"{name} {path}: is a folder; give a file")


def _run(options: Bench) -> int:
    """Run a suite; 1 if a part of it failed."""
    _start(options)
    gallery = Gallery(is_open=options.html is not None)
    rows = runner.run_suite(options.suite, options.quick, options.device, gallery, options.parts)
    if options.json != Path("-"):
        tables.print_rows(options.suite, rows)
    if options.json == Path("-"):
        print(runner.json_lines(options.suite, rows, options.quick, options.device), end="")
    elif options.json is not None:
        runner.write_json_lines(options.json, options.suite, rows, options.quick, options.device)
        print(f"rows: {options.json}")
    if options.html is not None:
        stamped = runner.stamped(options.suite, rows, options.quick, options.device)
        write_html(options.html, stamped, gallery.sets, quiet=options.json == Path("-"))
    return exit_code([options.suite] if runner.has_failed(rows) else [])


def exit_code(failed: Sequence[str]) -> int:
    """Say which suites or pipelines failed, and return 1 if any did."""
    if failed:
        print(f"failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def _run_all(options: Bench) -> int:
    """Run every suite; results are written after each, so that they outlive what comes later. 1 if any part failed."""
    _start(options)
    rows, failed, gallery = [], [], Gallery(is_open=options.html is not None)
    for suite, found in runner.run_all(options.quick, options.device, gallery):
        rows += runner.stamped(suite, found, options.quick, options.device)
        failed += [suite] * runner.has_failed(found)
        if options.json != Path("-"):
            tables.print_rows(suite, found)
        if options.json == Path("-"):
            print(runner.json_lines(suite, found, options.quick, options.device), end="")
        elif options.json is not None:
            runner.write_lines(options.json, rows)
    if options.json not in (None, Path("-")):
        print(f"rows: {options.json}")
    if options.html is not None:
        write_html(options.html, rows, gallery.sets, quiet=options.json == Path("-"))
    return exit_code(failed)


def _start(options: Bench) -> None:
    start_warp(options.device, options.threads)
    for path in (options.html, options.json):
        if path not in (None, Path("-")) and options.suite in (*catalogue.suites(), ALL):
            check_writable(path.absolute().parent)


def write_html(path: Path, rows: list[records.Row], pictures: Sequence[PictureSet] = (), quiet: bool = False) -> None:
    """Write a report of stamped rows, with the plots that they allow; raises OSError.

    What different machines measured is kept apart.
    """
    from warp_gi.bench.report import report
    from warp_gi.bench.report import suite_plots as report_plots

    apart = records.machines_apart(rows)
    groups: dict[tuple[str, str], list[records.Row]] = {}
    for row, shown in zip(rows, apart, strict=True):
        groups.setdefault((str(row.get("suite", "")), str(shown.get("suite", ""))), []).append(row)
    plots = [
        replace(plot, suite=shown)
        for (suite, shown), group in groups.items()
        for plot in report_plots.plots_of(suite, group)
    ]
    rows, suites = apart, ", ".join(dict.fromkeys(suite for suite, _ in groups if suite))
    report.write_report(path, f"warp_gi: {suites}" if suites else "warp_gi", rows, pictures, plots)
    if not quiet:
        print(f"report: {path}")
