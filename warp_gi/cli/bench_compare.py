"""``warp-gi bench compare``: pipelines against each other on a scene of one's own."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from warp_gi.baking import Bake
from warp_gi.bench.compare import reference as compare_reference
from warp_gi.bench.compare import rows as compare_rows
from warp_gi.bench.compare import run as compare
from warp_gi.bench.compare import setup as compare_setup
from warp_gi.bench.harness import records, runner, tables
from warp_gi.bench.harness.gallery import PictureSet
from warp_gi.cli.bench import exit_code, write_html
from warp_gi.cli.compare_options import CompareBench, Inputs, inputs_of, parse, parse_time, start
from warp_gi.cli.inputs import parse_resolution
from warp_gi.cli.report import Reporter
from warp_gi.errors import OptionError

NAME = "compare"


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse(arguments)
    limit = parse_time(options.time)
    reference = None if options.reference is None else compare_reference.from_file(options.reference)
    if reference is not None:
        height, width = reference.picture.shape[:2]
        options.size = options.size or f"{width}x{height}"
        if parse_resolution(options.size) != (width, height):
            raise OptionError(f"--reference {options.reference} is {width}x{height} and --size {options.size}")
    start(options)
    report = Reporter(quiet=options.json == Path("-"))
    with report.phase("scene"):
        given = inputs_of(options, report)
    setups, bakes = _setups(options, given, arguments, report)
    given = replace(given, pipelines={name: given.pipelines[name] for name in bakes})
    runs = compare.runs_of(
        given.scene, given.camera, given.pipelines, options.device, options.seed, options.frame, bakes
    )
    if reference is None:
        reference = _computed_reference(options, given, report)
    with report.shares("frames") as told:
        found = compare.take_turns(runs, reference, limit, told)
    rows = [_scene_row(options, given, limit), *compare_rows.rows_of(found, limit, setups)]
    _write(options, rows, found, limit)
    return exit_code([name for name in setups if name not in bakes])


def _setups(
    options: CompareBench, given: Inputs, arguments: Sequence[str], report: Reporter
) -> tuple[dict[str, records.Row], dict[str, list[Bake]]]:
    """Return rows of setup by pipeline, and the bakes of those that can be set up; raises OptionError if none can."""
    setups: dict[str, records.Row] = {}
    bakes: dict[str, list[Bake]] = {}
    again = [*arguments, *(["--size", options.size] if options.size else [])]
    for name in given.pipelines:
        with report.phase(f"setup of {name}"), tempfile.TemporaryDirectory() as folder:
            setups[name], baked = compare_setup.setup_of(name, Path(folder), again)
        if "failed" not in setups[name]:
            bakes[name] = baked
    if not bakes:
        raise OptionError(f"no pipeline can be set up: {next(iter(setups.values()))['failed']}")
    return setups, bakes


def _computed_reference(options: CompareBench, given: Inputs, report: Reporter) -> compare_reference.Reference:
    with report.shares(f"reference, {options.reference_spp} samples a pixel") as told:
        return compare_reference.computed(
            given.scene,
            given.camera,
            options.device,
            options.seed,
            options.reference_spp,
            options.frame,
            centred=options.spp == 1,
            told=told,
        )


def _scene_row(options: CompareBench, given: Inputs, limit: float) -> records.Row:
    width, height = given.camera.resolution
    row: records.Row = {"table": "scene", "scene": given.scene.name, "triangles": given.scene.triangle_count}
    row |= {"emitters": given.scene.emitter_count, "sky": Path(options.environment).name or "the scene's own"}
    return row | {"pixels": f"{width}x{height}", "spp": options.spp, "time s": limit, "seed": options.seed}


def _write(options: CompareBench, rows: list[records.Row], found: compare.Comparison, limit: float) -> None:
    stamped = runner.stamped(NAME, rows, False, options.device)
    if options.json == Path("-"):
        print(runner.json_lines(NAME, rows, False, options.device), end="")
    else:
        tables.print_rows(NAME, [row for row in rows if row["table"] != compare_rows.SERIES], is_titled=False)
    if options.json is not None and options.json != Path("-"):
        runner.write_json_lines(options.json, NAME, rows, False, options.device)
        print(f"rows: {options.json}")
    if options.html is not None:
        write_html(options.html, stamped, _pictures(found, limit), quiet=options.json == Path("-"))


def _pictures(found: compare.Comparison, limit: float) -> list[PictureSet]:
    reference = found.reference.picture.astype(np.float32)
    first = {run.name: run.first.astype(np.float32) for run in found.runs if run.first is not None}
    means = {run.name: run.mean.astype(np.float32) for run in found.runs}
    return [
        PictureSet(f"mean of the frames within {limit:g} s", reference, means, NAME),
        PictureSet("first frame", reference, first, NAME),
    ]
