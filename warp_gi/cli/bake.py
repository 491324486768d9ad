"""``warp-gi bake``: what an estimator can know before the first frame, to a file."""

from __future__ import annotations

import re
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Annotated

import tyro

from warp_gi import launch, registry
from warp_gi.baking import Bake
from warp_gi.cli.inputs import (
    BAKE_SUFFIX,
    DEFAULT_SCENE,
    SceneOptions,
    check_camera_options,
    find_camera,
    find_scene,
    has_camera,
    parse_resolution,
)
from warp_gi.cli.options import flag, parse_options, value_given
from warp_gi.cli.report import Reporter, run_command
from warp_gi.errors import OptionError
from warp_gi.files import check_target, check_writable, remove_stale_parts
from warp_gi.kept import BakeFolder
from warp_gi.rendering import bake
from warp_gi.scene.camera import Camera, CameraPath
from warp_gi.scene.files.sky_images import split_layer
from warp_gi.scene.scene import Scene
from warp_gi.sequence.chunks import chunk_of
from warp_gi.shards import check_shardable
from warp_gi.stateful import Stateful
from warp_gi.techniques.bake_tool import BakeTool, ExportRequest, ExportSettings

BAKEABLE = registry.bakeable()
DEFAULT_TECHNIQUE = next(iter(BAKEABLE))

DESCRIPTION = """Compute once what an estimator needs, and save it for `warp-gi render --bake FILE`.

Without SCENE, the built-in {scene}. The file appears whole or not at all. --technique decides
what is baked, and which settings there are; --technique NAME --help lists them.

{techniques}

{examples}"""


@dataclass
class BakeOptions(SceneOptions):
    """What to bake, and how."""

    environment: Annotated[str, flag("SKY", "the scene's own")] = ""
    """Sky of the scene, as in render. A bake may hold its light, or only the pictures show it; see above."""
    technique: Annotated[str, flag("NAME", DEFAULT_TECHNIQUE)] = DEFAULT_TECHNIQUE
    """Technique to bake for, by its long or short name; see above. The flags below are its settings."""
    chunk: Annotated[str, flag("I/N", "all of it")] = ""
    """Shard of the bake to make, as 3/16, beside processes that make the others; warp-gi merge makes one of all."""
    everywhere: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Bake all of the scene, where a technique otherwise bakes what the camera path sees."""
    picture: Annotated[str, flag("WxH", "the camera's own")] = ""
    """Width and height in pixels of the camera's picture, as 960x540; render's --resolution."""
    seed: int = 1
    """Seed that every random number follows from."""
    device: str = "cpu"
    """Device to compute on: cpu, cuda or cuda:1."""
    threads: Annotated[int | None, flag("N", "every core")] = None
    """Number of threads on the CPU. The bake does not depend on it."""
    output: Annotated[Path | None, tyro.conf.arg(aliases=["-o"], metavar="FILE", help_behavior_hint="")] = None
    """File of the bake (default: out/NAME.SHORT.safetensors, with the short name of the technique; of a shard
    out/NAME.SHORT.chunk-I-of-N.safetensors)."""
    show: Annotated[Path | None, flag("FOLDER", "none")] = None
    """Folder for pictures of the bake; they are described above."""
    export: Annotated[Path | None, flag("FILE", "none")] = None
    """File for the bake as textures for other programs, beside a .json that says how to read them; see above."""
    export_components: Annotated[int, flag("N", "all")] = 0
    """Number of principal components to export in place of all numbers, where a technique can; see above."""
    view: Annotated[Path | None, flag("FILE", "none")] = None
    """Page, .html, that shows the bake in a browser and needs no network, where a technique has one; see above."""
    cache: bool = True
    """Use the bake that an earlier run kept, and keep this one if it takes long; see render."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print nothing but errors."""
    settings: Annotated[Stateful, tyro.conf.arg(name="")] = field(
        default_factory=lambda: tool_of(DEFAULT_TECHNIQUE).settings()
    )
    export_settings: Annotated[ExportSettings, tyro.conf.arg(name="")] = field(
        default_factory=lambda: tool_of(DEFAULT_TECHNIQUE).export_settings()
    )


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    return run_command(parse(arguments), run)


def parse(arguments: Sequence[str]) -> BakeOptions:
    """Return the options; the technique named among them decides which settings there are.

    Raises OptionError for those that are unknown or cannot be read.
    """
    name = technique_of(arguments)
    tool = tool_of(name)
    default = BakeOptions(technique=name, settings=tool.settings(), export_settings=tool.export_settings())
    options = parse_options(BakeOptions, "bake", arguments, description(), default)
    options.technique = name
    return options


def tool_of(technique: str) -> BakeTool:
    """Return the tool of a technique, by its long name."""
    return registry.bake_tool(technique)


def technique_of(arguments: Sequence[str]) -> str:
    """Return the long name of the technique that the arguments of the command ask for, by its long or short one.

    Raises OptionError for an unknown one, and for a flag that is a setting of another one only.
    """
    given = value_given(arguments, "--technique")
    chosen = DEFAULT_TECHNIQUE if given is None else registry.technique_named(given, BAKEABLE.values()).name
    tools = {name: tool_of(name) for name in BAKEABLE}
    names = {
        name: {field.name for kind in (tool.settings, tool.export_settings) for field in fields(kind)}
        for name, tool in tools.items()
    }
    for argument in arguments:
        flag = argument.partition("=")[0]
        setting = flag.removeprefix("--").removeprefix("no-").replace("-", "_")
        owner = next((name for name in names if setting in names[name]), None)
        if flag.startswith("--") and owner is not None and setting not in names[chosen]:
            raise OptionError(
                f"{flag} is a setting of {owner}, but {chosen} is baked; leave it out, or give --technique {owner}"
            )
    return chosen


def description() -> str:
    """Return the head of the command's help: what each technique bakes, shows and exports, and examples."""
    titles = {name: f"{name}, {one.short}" for name, one in BAKEABLE.items()}
    width = max(map(len, titles.values())) + 3
    lines, examples = [], []
    for name, title in titles.items():
        tool = tool_of(name)
        said = [*tool.summary, *_labelled("--show: ", tool.shows), *_labelled("--export: ", tool.exports)]
        said += _labelled("--view: ", tool.views)
        lines += [f"  {head:<{width}}{line}" for head, line in zip([title, *[""] * len(said)], said, strict=False)]
        asked = "" if name == DEFAULT_TECHNIQUE else f" --technique {name}"
        for example in tool.examples:
            scene, _, settings = example.partition(" ")
            examples.append(f"  warp-gi bake {scene}{asked} {settings}")
    return DESCRIPTION.format(scene=DEFAULT_SCENE, techniques="\n".join(lines), examples="\n".join(examples))


def _labelled(label: str, lines: Sequence[str]) -> list[str]:
    return [f"{label if number == 0 else ''}{line}" for number, line in enumerate(lines)]


def run(options: BakeOptions, report: Reporter) -> None:
    """Bake, save, and write what else was asked for."""
    tool = tool_of(options.technique)
    if options.seed < 0:
        raise OptionError(f"seed must be 0 or above, got {options.seed}")
    tool.check(options.settings, options.everywhere)
    check_chunk(options)
    output = options.output or default_output(options)
    if output.suffix.lower() != BAKE_SUFFIX:
        raise OptionError(f"cannot write {output.name}: bakes are .safetensors files")
    if options.export is not None:
        tool.check_export(options.settings, options.export, options.export_components)
    tool.check_export_settings(options.export_settings, options.export)
    if options.export_components and (options.export is None or not tool.compresses):
        names = " or ".join(name for name in BAKEABLE if tool_of(name).compresses)
        raise OptionError(f"--export-components goes with --export of {names}; leave it out")
    if options.view is not None:
        tool.check_view(options.settings, options.view)
    check_camera_options(options)
    resolution = parse_resolution(options.picture) if options.picture else None
    files = [output, *(tool.exported_files(options.export) if options.export else ()), *filter(None, [options.view])]
    check_files(options, files)
    with report.phase("scene"):
        scene = find_scene(options)
        shows = options.show is not None or options.view is not None
        is_of_view = has_camera(options, scene) or not tool.finds_places
        camera = find_camera(options, scene, report) if is_of_view or shows else None
    if resolution and camera is not None:
        camera = camera.at_resolution(*resolution)
    report.line(f"{scene.name}: {scene.triangle_count:,} triangles")
    tool.check_scene(options.settings, scene)
    folders = [output.parent, options.show, *(file and file.parent for file in (options.export, options.view))]
    for folder in filter(None, folders):
        check_writable(folder)
    for file in files:
        remove_stale_parts(file)
    started, compiled = time.perf_counter(), launch.compile_seconds
    with report.shares("bake") as tell:
        result = bake(
            scene,
            options.settings,
            options.device,
            options.seed,
            camera if is_of_view and not options.everywhere else None,
            lambda stage, share: tell(share),
            cache=BakeFolder() if options.cache else None,
            chunk=options.chunk or None,
        )
    compiled = launch.compile_seconds - compiled
    seconds = time.perf_counter() - started - compiled
    result.save(output)
    if compiled > 0.5:
        report.line(f"{compiled:.1f} s of that compiling kernels")
    if options.export is not None:
        with report.shares("export") as tell:
            asked = options.settings, options.export_settings, options.export_components
            request = ExportRequest(*asked, options.device, options.seed, tell)
            exported = tool.export(result, options.export, scene, request)
        more = f" to {exported[-2].name}" * (len(exported) > 2)
        report.line(f"{tool.exported}: {exported[0]}{more}, described by {exported[-1]}")
    if options.view is not None and camera is not None:
        with report.phase("view"):
            page = tool.view(result, scene, first_view(camera), options.view)
        report.line(f"view: {page}")
    if options.show is not None and camera is not None:
        show(options, options.show, scene, camera, result, report)
    rows = [*tool.rows(result, seconds), ("file [MB]", output.stat().st_size / 1e6)]
    report.table("bake", ("quantity", "value"), rows)
    for table in tool.tables(result):
        report.table(*table)
    if advice := tool.advice(result, options.settings):
        report.line(advice)
    report.line(f"bake: {output}")


def check_chunk(options: BakeOptions) -> None:
    """Raise OptionError for a shard of what has none, and for what is made of whole bakes alone."""
    if not options.chunk:
        return
    chunk_of(options.chunk)
    check_shardable(options.settings)
    for name in ("show", "export", "view"):
        if getattr(options, name) is not None:
            raise OptionError(f"--{name} is of a whole bake, and --chunk makes a shard: leave one of them out")


def check_files(options: BakeOptions, files: Sequence[Path]) -> None:
    """Raise OptionError for files to write that are read, OSError for those that cannot be written."""
    given = {name: split_layer(name)[0] for name in (options.scene, options.environment, options.camera)}
    read = {name: path for name, path in given.items() if path.is_file()}
    for file in files:
        check_target(file)
        for name, path in read.items():
            if file.exists() and file.samefile(path):
                raise OptionError(f"{file} would be written over {name}, which is read: give another name")


def show(
    options: BakeOptions, folder: Path, scene: Scene, camera: Camera | CameraPath, result: Bake, report: Reporter
) -> None:
    """Write pictures of a bake to a folder, in the first view of the camera."""
    tool = tool_of(options.technique)
    if tool.needs_sky and (scene.environment is None or scene.environment.is_black):
        report.line("there is no sky: the pictures are made under a white one")
        scene.environment = 1.0
    with report.phase("pictures"):
        tool.write_pictures(scene, first_view(camera), result, options.settings, folder, options.device, options.seed)
    report.line(f"pictures: {folder}")


def first_view(camera: Camera | CameraPath) -> Camera:
    """Return the camera of the first frame."""
    return camera.camera(0) if isinstance(camera, CameraPath) else camera


def default_output(options: BakeOptions) -> Path:
    """Return where the bake goes unless told."""
    name = re.sub(r"[^\w.-]+", "_", Path(options.scene or DEFAULT_SCENE).stem) or "scene"
    part = chunk_of(options.chunk)
    shard = f".{part.name}" if part else ""
    return Path("out") / f"{name}.{BAKEABLE[options.technique].short}{shard}{BAKE_SUFFIX}"
