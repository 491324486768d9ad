"""``warp-gi bake``: what an estimator can know before the first frame, to a file."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from warp_gi import launch
from warp_gi.baking import Bake
from warp_gi.camera import CameraPath
from warp_gi.cli_inputs import DEFAULT_SCENE, SceneOptions, find_camera, find_scene, parse_resolution
from warp_gi.cli_options import flag, parse_options
from warp_gi.cli_report import Reporter, start_warp
from warp_gi.errors import OptionError, unknown_name
from warp_gi.files import check_writable, remove_stale_parts
from warp_gi.scheduler import bake
from warp_gi.techniques.visibility_export import check_export_name, export_textures, write_pictures
from warp_gi.techniques.visibility_field import VisibilityField

TECHNIQUES = {"visibility-field": VisibilityField}
SHORT_NAMES = {"visibility-field": "dvf"}
DEFAULT_TECHNIQUE = "visibility-field"

DESCRIPTION = """Compute once what an estimator needs, and save it for `warp-gi render --bake FILE`.

Without SCENE, the built-in atrium as its camera path sees it. The file appears whole or not
at all. A visibility field depends on the geometry alone: one bake serves every sky.

  warp-gi bake hall.glb --cell-size 0.5 --camera path.json
  warp-gi bake hall.glb --everywhere --export out/hall.png -o out/hall.dvf.safetensors
  warp-gi bake atrium --show out/atrium_field"""


@dataclass
class BakeOptions(SceneOptions):
    """What to bake, and how."""

    environment: Annotated[str, flag("SKY", "the scene's own, or white")] = ""
    """The sky of the pictures that --show writes, as in render; the bake itself does not depend on it."""
    technique: Annotated[str, flag("NAME", DEFAULT_TECHNIQUE)] = DEFAULT_TECHNIQUE
    """What to bake for. Its settings are the flags below."""
    everywhere: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Bake all cells, not just those that the camera path sees."""
    picture: Annotated[str, flag("WxH", "the camera's own")] = ""
    """Width and height in pixels at which the camera sees, render's --resolution."""
    seed: int = 1
    """Every random number follows from it."""
    device: str = "cpu"
    """cpu, cuda or cuda:1."""
    threads: Annotated[int | None, flag("N", "every core")] = None
    """Threads on the CPU. The bake does not depend on it."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE", help_behavior_hint="")] = None
    """Where the bake goes (default: out/NAME.dvf.safetensors)."""
    show: Annotated[Path | None, flag("FOLDER", "none")] = None
    """Write pictures of the bake: its maps, labels, how many rays are left to trace, and the error."""
    export: Annotated[Path | None, flag("FILE", "none")] = None
    """Write the field as textures for other programs: a .png for each layer (#### is its number), or one .exr."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print nothing but errors."""
    settings: Annotated[VisibilityField, tyro.conf.arg(name="")] = VisibilityField()


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse(arguments)
    start_warp(options.device)
    if options.threads is not None:
        launch.set_threads(options.threads)
    run(options, Reporter(options.quiet))
    return 0


def parse(arguments: Sequence[str]) -> BakeOptions:
    """Return the options. Raises OptionError for those that are unknown or cannot be read."""
    for index, argument in enumerate(arguments):
        name = argument.partition("=")[2] if argument.startswith("--technique=") else ""
        if argument == "--technique" and index + 1 < len(arguments):
            name = arguments[index + 1]
        if name and name not in TECHNIQUES:
            raise unknown_name("technique", name, TECHNIQUES)
    return parse_options(BakeOptions, "bake", arguments, description=DESCRIPTION, config=(tyro.conf.AvoidSubcommands,))


def run(options: BakeOptions, report: Reporter) -> None:
    """Bake, save, and write what else was asked for."""
    if options.seed < 0:
        raise OptionError(f"seed must be 0 or above, got {options.seed}")
    if options.settings.mode == "traced":
        raise OptionError('mode "traced" uses no bake; choose another, or render with it as it is')
    output = options.output or default_output(options)
    if output.suffix.lower() != ".safetensors":
        raise OptionError(f"cannot write {output.name}: bakes are .safetensors files")
    if options.export is not None:
        check_export_name(options.export)
    resolution = parse_resolution(options.picture) if options.picture else None
    with report.phase("scene"):
        scene = find_scene(options)
        camera = find_camera(options, scene, report)
    if resolution:
        camera = camera.at_resolution(*resolution)
    report.line(f"{scene.name}: {scene.triangle_count:,} triangles")
    options.settings.bake_settings(scene)  # raises for a grid that is too fine
    for file in (output, options.export):
        if file is not None and file.is_dir():
            raise OptionError(f"{file}: is a folder; name a file in it")
    folders = [output.parent, options.show, options.export and options.export.parent]
    for folder in filter(None, folders):
        check_writable(folder)
    remove_stale_parts(output)
    started, compiled = time.perf_counter(), launch.compile_seconds
    with report.shares("bake") as tell:
        result = bake(
            scene,
            options.settings,
            options.device,
            options.seed,
            None if options.everywhere else camera,
            lambda stage, share: tell(share),
        )
    compiled = launch.compile_seconds - compiled
    seconds = time.perf_counter() - started - compiled
    result.save(output)
    if compiled > 0.5:
        report.line(f"{compiled:.1f} s of that compiling kernels")
    if options.export is not None:
        with report.phase("export"):
            files = export_textures(result, options.export)
        report.line(f"textures: {files[0]}{f' to {files[-2].name}' * (len(files) > 2)}, described by {files[-1]}")
    if options.show is not None:
        if scene.environment is None or scene.environment.is_black:
            report.line("there is no sky: the pictures are made under a white one")
            scene.environment = 1.0
        view = camera.camera(0) if isinstance(camera, CameraPath) else camera
        with report.phase("pictures"):
            write_pictures(scene, view, result, options.settings, options.show, options.device, options.seed)
        report.line(f"pictures: {options.show}")
    report.table("bake", ("quantity", "value"), summary(result, seconds, output))
    report.line(f"bake: {output}")


def default_output(options: BakeOptions) -> Path:
    """Return where the bake goes unless told."""
    name = re.sub(r"[^\w.-]+", "_", Path(options.scene or DEFAULT_SCENE).stem) or "scene"
    return Path("out") / f"{name}.{SHORT_NAMES[options.technique]}.safetensors"


def summary(result: Bake, seconds: float, output: Path) -> list[tuple[str, Any]]:
    """Return the rows of the closing table; ``seconds`` without compilation."""
    counts, size = result.counts, output.stat().st_size
    return [
        ("cells", int(counts["cells"])),
        ("cell size [m]", float(result.settings["cell_size"])),
        ("grid", " x ".join(str(n) for n in result.arrays["grid_shape"])),
        ("surface samples", int(counts["samples"])),
        ("rays", int(counts["rays"])),
        ("rays traced", int(counts["rays_traced"])),
        ("seconds", round(seconds, 3)),
        ("million rays a second", counts["rays"] / 1e6 / max(seconds, 1e-9)),
        ("million traced a second", counts["rays_traced"] / 1e6 / max(seconds, 1e-9)),
        ("file [MB]", size / 1e6),
    ]
