"""``warp-gi render``: a sequence of frames to files."""

from __future__ import annotations

import hashlib
import math
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from warp_gi import launch
from warp_gi.baking import load_bake
from warp_gi.cli.inputs import DEFAULT_SCENE, SceneOptions, find_camera, find_scene, parse_resolution
from warp_gi.cli.options import flag, parse_options, value_given
from warp_gi.cli.report import Reporter, start_warp
from warp_gi.errors import BakeError, OptionError, unknown_name
from warp_gi.files import check_writable, remove_stale_parts
from warp_gi.frame import TERMS, Frame
from warp_gi.pipeline import Pipeline, estimator_named
from warp_gi.scene.baked import BakedScene
from warp_gi.scene.camera import Camera, CameraPath
from warp_gi.scene.environment import Environment
from warp_gi.scene.scene import Scene
from warp_gi.scheduler import FrameScheduler
from warp_gi.sequence.frames import (
    frame_attributes,
    frame_path,
    parse_frames,
    read_frame,
    why_not_whole,
    write_frame,
    write_preview,
)
from warp_gi.sequence.state import Dependence
from warp_gi.techniques.reuse.pictures import check_pictures, reuse_pictures

DESCRIPTION = """Render a sequence of frames to EXR files with named layers, and PNG previews.

Without SCENE, the built-in atrium along its camera path. Files appear whole or not at
all: stop with Ctrl-C or kill the process at any time, and carry on with --resume.

  warp-gi render
  warp-gi render hall.glb --environment city.exr --camera path.json --frames 0-47 --spp 64
  warp-gi render hall.glb --eye 4 1.7 2 --target -3 1.6 -0.5 -o out/still.exr --preview
  warp-gi render hall.glb --pipeline dvf --bake out/hall.dvf.safetensors --environment-turn 2
  warp-gi render hall.glb --pipeline probes --denoise spatiotemporal
  warp-gi render out/hall.probes.safetensors --camera path.json
  warp-gi render warehouse --pipeline reuse --reuse-pictures out/reuse --reuse-pixel 320 300
  warp-gi render cornell_box --pipeline path,emitters=UniformLights --indirect.max-depth 4"""

BAKE_SUFFIX = ".safetensors"


@dataclass
class Render(SceneOptions):
    """What to render, and how."""

    scene: Annotated[str, tyro.conf.Positional, flag("[SCENE]", f"{DEFAULT_SCENE}, with previews")] = ""
    """A GLB, glTF, OBJ or PLY file, the name of a built-in scene, or a bake of probes, .safetensors, to show alone."""
    pipeline: Annotated[str, flag("NAME", "path; probe_view for a bake alone")] = ""
    """Preset, with estimators exchanged after commas: path,indirect=none. Its settings are the flags below."""
    denoise: Annotated[str, flag("NAME", "as the pipeline says: none")] = ""
    """none, oidn or spatiotemporal, whose settings are then flags below."""
    bake: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction, flag("FILE", "none; may be given more than once")] = ()
    """What warp-gi bake saved, for an estimator of the pipeline with the same settings."""
    environment_turn: float = 0.0
    """Degrees by which the sky turns from frame to frame, as --environment-rotation does."""
    frames: Annotated[str, flag("LIST", "every frame of the path; 0 for a still camera")] = ""
    """Frame numbers: 5, 0-47, 0-47:2 or 1,4,9-12."""
    resolution: Annotated[str, flag("WxH", "the camera's own")] = ""
    """Width and height in pixels, as 960x540."""
    seed: int = 1
    """Every random number follows from it, the frame, the pixel and the sample."""
    device: str = "cpu"
    """cpu, cuda or cuda:1."""
    threads: Annotated[int | None, flag("N", "every core")] = None
    """Threads on the CPU. The pictures do not depend on it."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = Path("out/shot.####.exr")
    """Where frames go; #### becomes the frame's number."""
    precision: Literal["half", "float"] = "half"
    """Of colours and normals in EXR files; positions, depth, motion, ids and variance are float always."""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Keep frames that are whole and were made with just these settings; render the others."""
    preview: Annotated[bool, tyro.conf.arg(help_behavior_hint="(default: on without SCENE, else off)")] = False
    """Write a tone-mapped PNG beside each frame."""
    exposure: float = 0.0
    """Of previews, in stops."""
    reuse_pictures: Annotated[Path | None, flag("FOLDER", "none")] = None
    """Write pictures of what the last frame's samples taught: the octree's leaves, samples and lights in them, shares
    of exploration and of the BSDF. The pipeline has to learn, as reuse and hybrid do."""
    reuse_pixel: Annotated[tuple[int, int] | None, flag("X Y", "none")] = None
    """Add the quadtree of what this pixel sees, beside the light that comes there. 0 0 is at the top left."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print nothing but errors."""
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print a table of the time of each stage."""
    settings: Annotated[Pipeline, tyro.conf.arg(name="")] = field(default_factory=Pipeline)


@dataclass
class Shot:
    """A frame to render, and where it goes."""

    index: int
    previous: int
    """The frame that motion is towards."""
    path: Path
    time: float
    """Seconds."""
    camera: Camera
    previous_camera: Camera
    lineage: str = ""
    """Hash of all that decides this frame and those before it, where it depends on them."""


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse(arguments)
    start_warp(options.device)
    if options.threads is not None:
        launch.set_threads(options.threads)
    run(options, Reporter(options.quiet))
    return 0


def parse(arguments: Sequence[str]) -> Render:
    """Return the options; the pipeline named among them decides which settings there are."""
    before = ["", *arguments]
    is_bake = any(a.endswith(BAKE_SUFFIX) and b != "--bake" for a, b in zip(arguments, before, strict=False))
    settings = pipeline_named(value_given(arguments, "--pipeline") or ("probe_view" if is_bake else "path"))
    if denoiser := value_given(arguments, "--denoise"):
        settings = replace(settings, denoise=_denoiser(denoiser))
    default = Render(settings=settings)
    options = parse_options(
        Render,
        "render",
        arguments,
        description=DESCRIPTION,
        default=default,
        config=(tyro.conf.AvoidSubcommands,),
    )
    if not options.scene and not {"--preview", "--no-preview"} & set(arguments):
        options.preview = True
    return options


def pipeline_named(text: str) -> Pipeline:
    """Return the pipeline of "path" or "path,indirect=none,emitters=UniformLights,denoise=SpatioTemporal".

    Raises OptionError for unknown presets, terms, estimators and denoisers.
    """
    name, *changes = text.split(",")
    pipeline = Pipeline.preset(name.strip())
    for change in changes:
        term, _, estimator = (part.strip() for part in change.partition("="))
        if term == "denoise":
            pipeline = replace(pipeline, denoise=_denoiser(estimator))
            continue
        if term not in TERMS:
            raise unknown_name("term of a pipeline", term, (*TERMS, "denoise"))
        if estimator.lower() == "none":
            pipeline = replace(pipeline, **{term: None})
        else:
            pipeline = replace(pipeline, **{term: estimator_named(term, estimator)})
    return pipeline


def _denoiser(name: str) -> str | None:
    """Return what a pipeline takes for "none", "oidn", "SpatioTemporal"."""
    return None if name.lower() == "none" else name.lower()


def run(options: Render, report: Reporter) -> None:
    """Render what the options say."""
    if options.reuse_pixel is not None and options.reuse_pictures is None:
        raise OptionError("--reuse-pixel goes with --reuse-pictures; give that too")
    resolution = parse_resolution(options.resolution) if options.resolution else None
    bakes = [load_bake(path) for path in options.bake]
    with report.phase("scene"):
        scene = BakedScene(load_bake(options.scene)) if options.scene.endswith(BAKE_SUFFIX) else find_scene(options)
        camera = find_camera(options, scene, report)
    if resolution:
        camera = camera.at_resolution(*resolution)
    if isinstance(scene, BakedScene):
        report.line(f"{scene.name}: a bake, without its scene")
        if options.environment:
            raise OptionError("--environment goes with a scene; a bake shows the sky that it was baked under")
        if options.environment_turn or options.smooth is not None or options.scale != 1.0:
            raise OptionError("--environment-turn, --smooth and --scale go with a scene; a bake shows what was baked")
    else:
        report.line(f"{scene.name}: {scene.triangle_count:,} triangles, {scene.emitter_count:,} emitters")
    shots = plan(options, camera)
    sky = scene.environment
    if not math.isfinite(options.environment_turn):
        raise OptionError(f"--environment-turn must be a finite number of degrees, got {options.environment_turn:g}")
    if options.environment_turn and sky is None:
        raise OptionError(f"--environment-turn needs a sky to turn, and {scene.name} has none; give --environment too")
    turn_sky(options, scene, sky, shots[0].index)
    source = scene.bake if isinstance(scene, BakedScene) else scene
    scheduler = FrameScheduler(source, camera, options.settings, options.device, options.seed, report.stage, bakes)
    if options.reuse_pictures is not None:
        check_pictures(scheduler, shots[-1].camera, options.reuse_pixel)
    with report.phase("bake"):
        scheduler.bake()
    dependence = scheduler.dependence([shot.index for shot in shots], sky_changes=bool(options.environment_turn))
    done, before = [], ""
    for shot in shots:
        if options.resume or dependence.on_past:
            turn_sky(options, scene, sky, shot.index)  # what the frame's file has to say
        if dependence.on_past:
            before = shot.lineage = lineage(options, shot, scheduler, before)
        done.append(options.resume and is_done(options, shot, scheduler, report))
    todo = [shot for shot, is_there in zip(shots, done, strict=True) if not is_there]
    if todo and any(done) and dependence.on_past:
        whole = shots[: done.index(False)] if dependence.is_saved else []
        todo = shots[known_frames(options, scheduler, whole) :]
        if len(todo) == len(shots):
            report.line(why_all(dependence))
    if options.reuse_pictures is not None:
        if not todo:
            raise OptionError("--reuse-pictures needs a frame to render, and all are there already; leave --resume out")
        check_writable(options.reuse_pictures)
    if todo:
        check_writable(options.output.parent)
        remove_stale_parts(state_path(options))
    if len(todo) < len(shots):
        report.line(f"{len(shots) - len(todo)} of {len(shots)} frames are there already")
    started = time.perf_counter()
    times: dict[str, list[float]] = {}
    try:
        with stoppable() as stop, report.bar(len(todo)):
            for shot in todo:
                turn_sky(options, scene, sky, shot.index)
                frame, stages = render_shot(options, shot, scheduler, report)
                for stage, seconds in stages.items():
                    times.setdefault(stage, []).append(seconds)
                if dependence.is_saved and shot.path.suffix.lower() == ".exr":  # nothing resumes from others
                    saving = time.perf_counter()
                    scheduler.save_state(state_path(options), shot.lineage)
                    times.setdefault("save state", []).append(time.perf_counter() - saving)
                if options.reuse_pictures is not None and shot is todo[-1]:
                    reuse_pictures(scheduler, frame, options.reuse_pictures, options.reuse_pixel)
                    report.line(f"pictures: {options.reuse_pictures}")
                del frame  # before there is a next one
                if stop.is_set():
                    raise KeyboardInterrupt
    except KeyboardInterrupt:
        raise KeyboardInterrupt("finished frames are kept, --resume renders the others") from None
    count = f"{len(todo)} frame{'s' * (len(todo) != 1)}"
    report.line(f"{count} in {time.perf_counter() - started:.1f} s: {options.output}")
    if options.verbose and todo:
        times["bake"] = times["bake"][:1]  # every frame names the one bake
        rows = [(stage, *(f"{x:.3f}" for x in (v[0], sum(v) / len(v), max(v), sum(v)))) for stage, v in times.items()]
        report.table("seconds by stage", ("stage", "first frame", "mean", "largest", "sum"), rows)


def render_shot(
    options: Render, shot: Shot, scheduler: FrameScheduler, report: Reporter
) -> tuple[Frame, dict[str, float]]:
    """Render a frame and write it; return it, and the seconds of its stages."""
    remove_stale_parts(shot.path)
    started, compiled = time.perf_counter(), launch.compile_seconds
    frame = scheduler.frame(shot.index, shot.previous)
    if shot.lineage:
        frame.metadata["lineage"] = shot.lineage
    rendered = time.perf_counter()
    write_shot(options, frame, shot.path)
    finished = time.perf_counter()
    compiled = launch.compile_seconds - compiled
    seconds = finished - started - compiled
    note = f" and {compiled:.1f} s compiling kernels" if compiled > 0.5 else ""
    report.frame(f"{shot.path} {seconds:.2f} s{note}", seconds)
    return frame, {**frame.timings, "write": finished - rendered}


@contextmanager
def stoppable() -> Iterator[threading.Event]:
    """Yield an event that Ctrl-C sets, besides raising KeyboardInterrupt, which a finaliser may swallow."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return

    def interrupt(number: int, frame: object) -> None:
        stop.set()
        raise KeyboardInterrupt

    def unraisable(report: Any) -> None:
        if not issubclass(report.exc_type, KeyboardInterrupt):
            hook(report)

    hook, sys.unraisablehook = sys.unraisablehook, unraisable
    handler = signal.signal(signal.SIGINT, interrupt)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, handler)
        sys.unraisablehook = hook


def plan(options: Render, camera: Camera | CameraPath) -> list[Shot]:
    """Return the frames that were asked for."""
    if options.frames:
        frames = parse_frames(options.frames)
    else:
        frames = list(range(camera.frame_count)) if isinstance(camera, CameraPath) else [0]
    if len(frames) > 1 and "#" not in options.output.name:
        raise OptionError(f"{len(frames)} frames cannot all go to {options.output}; put #### in the name")
    suffix = options.output.suffix.lower()
    if suffix not in (".exr", ".png"):
        raise OptionError(f"cannot write {options.output.name}: frames are .exr or .png files")
    if suffix == ".png" and options.resume:
        raise OptionError("--resume needs .exr files, which say how they were made; a .png does not")
    path = camera if isinstance(camera, CameraPath) else CameraPath.still(camera)
    at = path.camera if path is camera else lambda index: camera
    previous = [max(frames[0] - 1, 0), *frames]
    return [
        Shot(index, before, frame_path(options.output, index), index / path.fps, at(index), at(before))
        for index, before in zip(frames, previous, strict=False)
    ]


def turn_sky(options: Render, scene: Scene, sky: Environment | None, index: int) -> None:
    """Give the scene the sky of frame ``index``; ``sky`` is that of frame 0."""
    if options.environment_turn and sky is not None:
        turned = sky.rotated(math.fmod(index * options.environment_turn, 360.0))
        if scene.environment is None or turned.rotation != scene.environment.rotation:
            scene.environment = turned


def state_path(options: Render) -> Path:
    """Return where a sequence keeps what it has learnt, beside its frames."""
    stem = options.output.stem.replace("#", "").strip("._-") or "frames"
    return options.output.with_name(f"{stem}.state.safetensors")


def lineage(options: Render, shot: Shot, scheduler: FrameScheduler, before: str) -> str:
    """Return a hash of all that decides a frame and those before it, whose hash is ``before``."""
    attributes = frame_attributes(
        shot.index, shot.time, shot.camera, scheduler.metadata(), shot.previous_camera, options.precision
    )
    return hashlib.sha256(f"{before}{shot.camera.resolution}{attributes}".encode()).hexdigest()


def known_frames(options: Render, scheduler: FrameScheduler, whole: list[Shot]) -> int:
    """Return how many of the first frames, which are whole, a saved state knows; the scheduler then goes on from it."""
    lineages = [shot.lineage for shot in whole]
    path = state_path(options)
    if not path.exists():
        return 0
    try:
        known = load_bake(path).settings.get("lineage")
        if known not in lineages:
            return 0
        scheduler.load_state(path, known)
    except BakeError:  # damaged
        return 0
    return lineages.index(known) + 1


def why_all(dependence: Dependence) -> str:
    """Return why every frame is rendered again where some are there already."""
    lights = {"denoiser": "the denoiser"}
    names = [lights.get(name, f"the {name} light") for name in dependence.unsaved or dependence.on_past]
    reason = "" if dependence.unsaved else "no saved state fits, and "
    return (
        f"every frame is rendered again: {reason}{' and '.join(names)} depend{'s' * (len(names) == 1)} "
        "on the frames before"
    )


def is_done(options: Render, shot: Shot, scheduler: FrameScheduler, report: Reporter) -> bool:
    """Return whether the frame's file is whole and made with the same settings; adds a missing preview."""
    metadata = scheduler.metadata() | ({"lineage": shot.lineage} if shot.lineage else {})
    expected = frame_attributes(shot.index, shot.time, shot.camera, metadata, shot.previous_camera, options.precision)
    problem = why_not_whole(shot.path, expected, shot.camera)
    if problem is None:
        preview = shot.path.with_suffix(".png")
        if options.preview and not preview.exists():
            write_preview(read_frame(shot.path), preview, options.exposure)
    elif problem != "missing":
        report.line(f"{shot.path} is rendered again: {problem}")
    return problem is None


def write_shot(options: Render, frame: object, path: Path) -> None:
    """Write the preview, then the frame: a whole frame has its preview."""
    if path.suffix.lower() == ".png":
        write_preview(frame, path, options.exposure)
        return
    if options.preview:
        write_preview(frame, path.with_suffix(".png"), options.exposure)
    write_frame(frame, path, options.precision)
