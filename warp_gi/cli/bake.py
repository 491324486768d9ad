"""``warp-gi bake``: what an estimator can know before the first frame, to a file."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from warp_gi import launch
from warp_gi.baking import Bake
from warp_gi.cli.inputs import DEFAULT_SCENE, SceneOptions, find_camera, find_scene, has_camera, parse_resolution
from warp_gi.cli.options import flag, parse_options
from warp_gi.cli.report import Reporter, start_warp
from warp_gi.cli.techniques import DEFAULT_TECHNIQUE, TECHNIQUES, Settings, technique_of
from warp_gi.errors import OptionError
from warp_gi.files import check_writable, remove_stale_parts
from warp_gi.rendering import bake
from warp_gi.scene.camera import Camera, CameraPath
from warp_gi.scene.scene import Scene

DESCRIPTION = """Compute once what an estimator needs, and save it for `warp-gi render --bake FILE`.

Without SCENE, the built-in atrium. The file appears whole or not at all. --technique decides
what is baked, and which settings there are; --technique NAME --help lists them.

  visibility-field     Which way the sky is seen, in the cells that the camera path sees.
                       Of the geometry alone: one bake serves every sky.
  light-field-probes   The light all around each point of a grid, under the scene's sky, over
                       the space that paths from the camera reach, wherever it goes.

  warp-gi bake hall.glb --cell-size 0.5 --camera path.json
  warp-gi bake hall.glb --everywhere --export out/hall.png -o out/hall.dvf.safetensors
  warp-gi bake atrium --show out/atrium_field
  warp-gi bake hall.glb --technique light-field-probes --environment city.exr --counts 4 4 4
  warp-gi bake atrium --technique light-field-probes --export out/a.exr --show out/atrium_probes"""


@dataclass
class BakeOptions(SceneOptions):
    """What to bake, and how."""

    environment: Annotated[str, flag("SKY", "the scene's own")] = ""
    """The sky, as in render. Probes hold its light; of a visibility field only the pictures depend on it."""
    technique: Annotated[str, flag("NAME", DEFAULT_TECHNIQUE)] = DEFAULT_TECHNIQUE
    """What to bake for: visibility-field or light-field-probes. Its settings are the flags below."""
    everywhere: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Bake all cells of a visibility field, not just those that the camera path sees."""
    picture: Annotated[str, flag("WxH", "the camera's own")] = ""
    """Width and height in pixels at which the camera sees, render's --resolution."""
    seed: int = 1
    """Every random number follows from it."""
    device: str = "cpu"
    """cpu, cuda or cuda:1."""
    threads: Annotated[int | None, flag("N", "every core")] = None
    """Threads on the CPU. The bake does not depend on it."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE", help_behavior_hint="")] = None
    """Where the bake goes (default: out/NAME.dvf.safetensors; of probes out/NAME.probes.safetensors)."""
    show: Annotated[Path | None, flag("FOLDER", "none")] = None
    """Write pictures of the bake. Of a visibility field: its maps, labels, how many rays are left to trace, and the
    error. Of probes: their maps, their places in the view, and the path of a ray through the maps."""
    export: Annotated[Path | None, flag("FILE", "none")] = None
    """Write the bake as textures for other programs, and a .json that says how to read them. A visibility field: a
    .png for each layer (#### is its number), or one .exr. Probes: atlases NAME.radiance.exr and so on for NAME.exr."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print nothing but errors."""
    settings: Annotated[Settings, tyro.conf.arg(name="")] = field(
        default_factory=TECHNIQUES[DEFAULT_TECHNIQUE].settings
    )


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse(arguments)
    start_warp(options.device)
    if options.threads is not None:
        launch.set_threads(options.threads)
    run(options, Reporter(options.quiet))
    return 0


def parse(arguments: Sequence[str]) -> BakeOptions:
    """Return the options; the technique named among them decides which settings there are.

    Raises OptionError for those that are unknown or cannot be read.
    """
    name = technique_of(arguments)
    default = BakeOptions(technique=name, settings=TECHNIQUES[name].settings())
    config = (tyro.conf.AvoidSubcommands,)
    return parse_options(BakeOptions, "bake", arguments, description=DESCRIPTION, default=default, config=config)


def run(options: BakeOptions, report: Reporter) -> None:
    """Bake, save, and write what else was asked for."""
    technique = TECHNIQUES[options.technique]
    if options.seed < 0:
        raise OptionError(f"seed must be 0 or above, got {options.seed}")
    technique.check(options.settings, options.everywhere)
    output = options.output or default_output(options)
    if output.suffix.lower() != ".safetensors":
        raise OptionError(f"cannot write {output.name}: bakes are .safetensors files")
    if options.export is not None:
        technique.check_export_name(options.export)
    resolution = parse_resolution(options.picture) if options.picture else None
    with report.phase("scene"):
        scene = find_scene(options)
        is_of_view = technique.is_of_view and not (technique.bakes_unseen and not has_camera(options, scene))
        camera = find_camera(options, scene, report) if is_of_view or options.show is not None else None
    if resolution and camera is not None:
        camera = camera.at_resolution(*resolution)
    report.line(f"{scene.name}: {scene.triangle_count:,} triangles")
    technique.check_scene(options.settings, scene)
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
            camera if is_of_view and not options.everywhere else None,
            lambda stage, share: tell(share),
        )
    compiled = launch.compile_seconds - compiled
    seconds = time.perf_counter() - started - compiled
    result.save(output)
    if compiled > 0.5:
        report.line(f"{compiled:.1f} s of that compiling kernels")
    if options.export is not None:
        with report.phase("export"):
            files = technique.export(result, options.export)
        more = f" to {files[-2].name}" * (len(files) > 2)
        report.line(f"{technique.exported}: {files[0]}{more}, described by {files[-1]}")
    if options.show is not None:
        show(options, scene, camera, result, report)
    rows = [*technique.summary(result, seconds), ("file [MB]", output.stat().st_size / 1e6)]
    report.table("bake", ("quantity", "value"), rows)
    technique.report(result, options.settings, report)
    report.line(f"bake: {output}")


def show(options: BakeOptions, scene: Scene, camera: Camera | CameraPath, result: Bake, report: Reporter) -> None:
    """Write pictures of a bake, in the first view of the camera."""
    technique = TECHNIQUES[options.technique]
    if technique.needs_sky and (scene.environment is None or scene.environment.is_black):
        report.line("there is no sky: the pictures are made under a white one")
        scene.environment = 1.0
    view = camera.camera(0) if isinstance(camera, CameraPath) else camera
    with report.phase("pictures"):
        technique.write_pictures(scene, view, result, options.settings, options.show, options.device, options.seed)
    report.line(f"pictures: {options.show}")


def default_output(options: BakeOptions) -> Path:
    """Return where the bake goes unless told."""
    name = re.sub(r"[^\w.-]+", "_", Path(options.scene or DEFAULT_SCENE).stem) or "scene"
    return Path("out") / f"{name}.{TECHNIQUES[options.technique].short_name}.safetensors"
