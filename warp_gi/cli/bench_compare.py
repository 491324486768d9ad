"""``warp-gi bench compare``: pipelines against each other on a scene of one's own."""

from __future__ import annotations

import math
import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np

from warp_gi import launch
from warp_gi.baking import Bake
from warp_gi.bench.compare import reference as compare_reference
from warp_gi.bench.compare import rows as compare_rows
from warp_gi.bench.compare import run as compare
from warp_gi.bench.compare import setup as compare_setup
from warp_gi.bench.harness import records, runner, tables
from warp_gi.bench.harness.gallery import PictureSet
from warp_gi.cli.bench import exit_code, write_html
from warp_gi.cli.inputs import DEFAULT_SCENE, SceneOptions, find_camera, find_scene, parse_resolution
from warp_gi.cli.options import flag, parse_options
from warp_gi.cli.render import BAKE_SUFFIX, pipeline_named
from warp_gi.cli.report import Reporter, start_warp
from warp_gi.errors import OptionError, check_whole
from warp_gi.files import check_writable
from warp_gi.pipeline import MOST_SAMPLES, Pipeline
from warp_gi.scene.camera import Camera, CameraPath
from warp_gi.scene.scene import Scene

DESCRIPTION = """Compare pipelines on a scene: errors at equal samples and at equal time, time at equal error.

The pipelines take turns, a frame each, until each has rendered for --time; a still picture, so frames add up.
Without --reference, the path tracer makes one first.

  warp-gi bench compare --scene my.glb --environment sky.exr --camera c.json --html out/compare.html
  warp-gi bench compare --scene warehouse --pipelines path,reuse --time 2m --size 960x540
  warp-gi bench compare --pipelines path,probes,indirect=none --reference out/reference.exr"""

NAME = "compare"
SIZE = "480x270"
LONGEST = 7 * 24 * 3600.0
_UNITS = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}


@dataclass
class CompareBench(SceneOptions):
    """What to compare, and how."""

    scene: Annotated[str, flag("SCENE", DEFAULT_SCENE)] = ""
    """A GLB, glTF, OBJ or PLY file, or the name of a built-in scene."""
    frame: int = 0
    """Which frame of a camera path, and of what moves."""
    size: Annotated[str, flag("WxH", f"the reference's, else {SIZE}", "--resolution")] = ""
    """Width and height in pixels."""
    pipelines: Annotated[str, flag("NAMES", "path,dvf,hybrid")] = "path,dvf,hybrid"
    """Presets, as in warp-gi render --pipeline: path,dvf,environment=none are two. Times are relative to the first."""
    time: Annotated[str, flag("TIME", "30s")] = "30s"
    """How long each pipeline may render, as 30s or 2m; setup and compilation are apart."""
    spp: int = 4
    """Samples a pixel of a frame. 1 looks through the middles of pixels only."""
    reference: Annotated[Path | None, flag("FILE", "computed by the path tracer")] = None
    """What the picture should be: EXR, HDR or NPY of linear radiance."""
    reference_spp: Annotated[int, flag("N", "1024")] = 1024
    """Samples a pixel of a computed reference."""
    html: Annotated[Path | None, flag("FILE", "none")] = None
    """Write tables, plots and pictures as one HTML file that needs no network."""
    json: Annotated[Path | None, flag("FILE", "none")] = None
    """Write each row as a line of JSON; - prints the lines."""
    device: str = "cpu"
    """cpu, cuda or cuda:1."""
    threads: Annotated[int | None, flag("N", "every core")] = None
    """Threads on the CPU."""
    seed: int = 1
    """Every random number follows from it."""


@dataclass(frozen=True)
class Inputs:
    """What the options name."""

    scene: Scene
    camera: Camera
    pipelines: dict[str, Pipeline]


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


def parse(arguments: Sequence[str]) -> CompareBench:
    """Return the options; raises OptionError for those that make no sense."""
    options = parse_options(CompareBench, "bench compare", arguments, description=DESCRIPTION)
    check_whole("--seed", options.seed, 0, 2**31)
    check_whole("--frame", options.frame, 0, 10**6)
    check_whole("--spp", options.spp, 1, MOST_SAMPLES)
    check_whole("--reference-spp", options.reference_spp, 2, 2**30)
    parse_time(options.time)
    if options.scene.endswith(BAKE_SUFFIX):
        raise OptionError(f"--scene {options.scene}: a bake has no light to compare with; give the scene")
    for name, path in (("--html", options.html), ("--json", options.json)):
        if path is not None and path.is_dir():
            raise OptionError(f"{name} {path}: is a folder; give a file")
    pipelines_named(options.pipelines, options.spp)
    return options


def start(options: CompareBench) -> None:
    """Start Warp as the options say, and see that what is written can be."""
    start_warp(options.device)
    if options.threads is not None:
        launch.set_threads(options.threads)
    for path in (options.html, options.json):
        if path is not None and path != Path("-"):
            check_writable(path.absolute().parent)


def inputs_of(options: CompareBench, report: Reporter | None = None) -> Inputs:
    """Return scene, still camera and pipelines; raises SceneError or OptionError."""
    scene = find_scene(options)
    camera = find_camera(options, scene, report or Reporter(quiet=True))
    if isinstance(camera, CameraPath):
        camera = camera.camera(options.frame)
    camera = camera.at_resolution(*parse_resolution(options.size or SIZE))
    return Inputs(scene, camera, pipelines_named(options.pipelines, options.spp))


def pipelines_named(text: str, spp: int) -> dict[str, Pipeline]:
    """Return the pipelines of "path,dvf,denoise=oidn,hybrid" by name: path, "dvf,denoise=oidn" and hybrid.

    Raises OptionError for one that is unknown, or named twice.
    """
    names: list[str] = []
    for part in (part.strip() for part in text.split(",")):
        if "=" in part and names:
            names[-1] += f",{part}"
        else:
            names.append(part)
    if len(set(names)) != len(names):
        raise OptionError(f"--pipelines {text}: names one twice")
    return {name: replace(pipeline_named(name), spp=spp) for name in names}


def parse_time(text: str) -> float:
    """Return the seconds of "30s", "2m", "1.5h" or "45"; raises OptionError for anything else."""
    match = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*(s|m|min|h|)\s*", text)
    seconds = float(match[1]) * _UNITS[match[2]] if match else math.nan
    if not 0 < seconds <= LONGEST:
        raise OptionError(f"--time {text!r} not understood; write for example 30s or 2m, at most a week")
    return seconds


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
    first = {run.name: run.first.astype(np.float32) for run in found.runs}
    means = {run.name: run.mean.astype(np.float32) for run in found.runs}
    return [
        PictureSet(f"mean of the frames within {limit:g} s", reference, means, NAME),
        PictureSet("first frame", reference, first, NAME),
    ]
