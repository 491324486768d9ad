"""Options of ``warp-gi bench compare``, and the scenes and pipelines that they name; its processes share them."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from warp_gi.cli.inputs import (
    BAKE_SUFFIX,
    DEFAULT_SCENE,
    SceneOptions,
    find_camera,
    find_scene,
    move_sky,
    parse_resolution,
)
from warp_gi.cli.options import flag, parse_options
from warp_gi.cli.pipelines import pipeline_named
from warp_gi.cli.report import Reporter, start_warp
from warp_gi.errors import OptionError, check_whole
from warp_gi.files import check_writable
from warp_gi.pipeline import MOST_SAMPLES, Pipeline
from warp_gi.scene.camera import Camera, CameraPath, frame_time
from warp_gi.scene.scene import Scene

DESCRIPTION = """Compare pipelines on a scene: errors at equal samples and at equal time, time at equal error.

The pipelines take turns, a frame each, until each has rendered for --time; a still picture, so frames add up.
Without --reference, the path tracer makes one first.

  warp-gi bench compare --scene my.glb --environment sky.exr --camera c.json --html out/compare.html
  warp-gi bench compare --scene warehouse --pipelines path,reuse --time 2m --size 960x540
  warp-gi bench compare --pipelines path,probes,indirect=none --reference out/reference.exr"""

SIZE = "480x270"
LONGEST = 7 * 24 * 3600.0
_UNITS = {"": 1.0, "s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0}


@dataclass
class CompareBench(SceneOptions):
    """What to compare, and how."""

    scene: Annotated[str, flag("SCENE", DEFAULT_SCENE)] = ""
    """A GLB, glTF, OBJ or PLY file, or the name of a built-in scene."""
    frame: int = 0
    """Number of the frame: of the camera path, and of the scene's animation."""
    size: Annotated[str, flag("WxH", f"the reference's, else {SIZE}", "--resolution")] = ""
    """Width and height of the pictures in pixels."""
    pipelines: Annotated[str, flag("NAMES", "path,dvf,hybrid")] = "path,dvf,hybrid"
    """Presets to compare, as in warp-gi render --pipeline; path,dvf,environment=none are two. Times are relative
    to the first."""
    time: Annotated[str, flag("TIME", "30s")] = "30s"
    """Time that each pipeline may render, as 30s or 2m; setup and compilation are apart."""
    spp: int = 4
    """Samples a pixel of each frame. 1 looks through the middles of pixels only."""
    reference: Annotated[Path | None, flag("FILE", "computed by the path tracer")] = None
    """File of the picture as it should be: EXR, HDR or NPY of linear radiance."""
    reference_spp: Annotated[int, flag("N", "1024")] = 1024
    """Samples a pixel of a reference that is computed."""
    html: Annotated[Path | None, flag("FILE", "none")] = None
    """File for tables, plots and pictures: one HTML file that needs no network."""
    json: Annotated[Path | None, flag("FILE", "none")] = None
    """File for the rows, a line of JSON each; - prints the lines."""
    device: str = "cpu"
    """Device to compute on: cpu, cuda or cuda:1."""
    threads: Annotated[int | None, flag("N", "every core")] = None
    """Number of threads on the CPU."""
    seed: int = 1
    """Seed that every random number follows from."""


@dataclass(frozen=True)
class Inputs:
    """The scene, camera and pipelines that the options name."""

    scene: Scene
    camera: Camera
    pipelines: dict[str, Pipeline]


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
    start_warp(options.device, options.threads)
    for path in (options.html, options.json):
        if path is not None and path != Path("-"):
            check_writable(path.absolute().parent)


def inputs_of(options: CompareBench, report: Reporter | None = None) -> Inputs:
    """Return scene, still camera and pipelines; raises SceneError or OptionError."""
    scene = find_scene(options)
    camera = find_camera(options, scene, report or Reporter(quiet=True))
    if scene.sky_at is not None:  # one moment is compared, its sky stands still
        move_sky(scene, 0.0, camera, [options.frame])
        scene.update_sky(frame_time(camera, options.frame))
        scene.environment = scene.environment
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
