"""``warp-gi render``: a sequence of frames to files."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import tyro

from warp_gi import launch
from warp_gi.baking import load_bake
from warp_gi.cli.inputs import (
    BAKE_SUFFIX,
    DEFAULT_SCENE,
    SceneOptions,
    check_camera_options,
    find_camera,
    find_scene,
    move_sky,
    parse_resolution,
)
from warp_gi.cli.interrupts import stoppable
from warp_gi.cli.json_progress import JsonReporter
from warp_gi.cli.options import flag, parse_options, value_given
from warp_gi.cli.pipelines import find_denoiser, pipeline_named, with_settings_shared
from warp_gi.cli.report import Reporter, run_command
from warp_gi.errors import OptionError
from warp_gi.files import check_target, check_writable, frame_path
from warp_gi.foretold import kernels_of
from warp_gi.frame import Frame
from warp_gi.kept import BakeFolder
from warp_gi.pipeline import DEFAULT, NORMAL, Pipeline
from warp_gi.scene.baked import BakedScene
from warp_gi.scene.camera import Camera, CameraPath
from warp_gi.scene.scene import Scene
from warp_gi.scheduler import FrameScheduler
from warp_gi.sequence.banded import BandedFrame
from warp_gi.sequence.chunks import chunk_of, run_of
from warp_gi.sequence.frame_time import parse_seconds, take_time
from warp_gi.sequence.frames import parse_frames
from warp_gi.sequence.resume import Output, Plan, SequenceRun, Shot, check_frames, shots_of
from warp_gi.sequence.video import Video, check_video

DESCRIPTION = """Render a sequence of frames to EXR files with named layers, and PNG previews.

Without SCENE, the built-in atrium along its camera path. Files appear whole or not at
all: stop with Ctrl-C or kill the process at any time, and carry on with --resume.

Settings of the pipeline are flags by term: --indirect.max-depth 4. Where one estimator serves two terms, as in
transfer, one flag sets both: --environment.resolution 512; give both flags for two values.

  warp-gi render
  warp-gi render hall.glb --environment city.exr --camera path.json --frames 0-47
  warp-gi render hall.glb --eye 4 1.7 2 --target -3 1.6 -0.5 -o out/still.exr --preview
  warp-gi render hall.glb --pipeline dvf --bake out/hall.dvf.safetensors --environment-turn 2
  warp-gi render hall.glb --environment sky.####.exr --camera path.json --frames 0-47
  warp-gi render hall.glb --pipeline probes --denoise spatiotemporal
  warp-gi render out/hall.probes.safetensors --camera path.json
  warp-gi render warehouse --pipeline reuse --reuse-pictures out/reuse --reuse-pixel 320 300
  warp-gi render cornell_box --pipeline path,emitters=UniformLights --indirect.max-depth 4"""


@dataclass
class Render(SceneOptions):
    """What to render, and how."""

    scene: Annotated[str, tyro.conf.Positional, flag("[SCENE]", f"{DEFAULT_SCENE}, with previews")] = ""
    """A GLB, glTF, OBJ or PLY file, the name of a built-in scene, or a bake of probes, .safetensors, to show alone."""
    pipeline: Annotated[str, flag("NAME", f"{DEFAULT}; probe_view for a bake alone")] = ""
    """Preset, with estimators exchanged after commas: path,indirect=none. Its settings are the flags below."""
    quality: Annotated[str, flag("NAME", "normal")] = ""
    """draft, normal or high: the few settings of the pipeline that decide most. What flags say stands above it."""
    frame_time: Annotated[str, flag("TIME", "as long as it takes")] = ""
    """Time that a frame may take, as 0.5s or 500ms: samples a pixel are chosen to fit, one number for all frames."""
    denoise: Annotated[str, flag("NAME", "as the pipeline says: none")] = ""
    """Denoiser: none, oidn or spatiotemporal. Its settings are then flags below."""
    bake: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction, flag("FILE", "none; may be given more than once")] = ()
    """File that warp-gi bake saved, for an estimator of the pipeline with the same settings."""
    environment_turn: float = 0.0
    """Angle in degrees by which the sky turns from frame to frame, as --environment-rotation does."""
    frames: Annotated[str, flag("LIST", "every frame of the path; 0 for a still camera")] = ""
    """Numbers of the frames to render: 5, 0-47, 0-47:2 or 1,4,9-12."""
    chunk: Annotated[str, flag("I/N", "all of them")] = ""
    """Part of these frames to render, as 3/16, beside processes that render the others to the same files."""
    warm_up: Annotated[int | None, flag("N", "all frames before, which is exact")] = None
    """Frames before a part that are rendered and thrown away, where frames depend on those before. Not exact."""
    cluster: Annotated[str, flag("ADDRESS", "this process renders")] = ""
    """Dask scheduler, as tcp://10.0.0.1:8786, whose workers render. All see the scene's files and OUTPUT's folder."""
    resolution: Annotated[str, flag("WxH", "the camera's own")] = ""
    """Width and height of the frames in pixels, as 960x540."""
    seed: int = 1
    """Seed that every random number follows from, with the frame, the pixel and the sample."""
    device: str = "cpu"
    """Device to compute on: cpu, cuda or cuda:1."""
    threads: Annotated[int | None, flag("N", "every core")] = None
    """Number of threads on the CPU. The pictures do not depend on it."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FILE")] = Path("out/shot.####.exr")
    """Name of the frames' files; #### becomes the frame's number."""
    memory: Annotated[float | None, flag("GB", "what is free")] = None
    """Gigabytes that a picture may take. A larger one is rendered in bands of its rows, to the same bits, where the
    pipeline can: path, direct and cache, without a denoiser."""
    precision: Literal["half", "float"] = "half"
    """Storage of colours and normals in EXR files. Positions, depth, motion, ids and variance are always float."""
    resume: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Keep frames that are whole and were made with just these settings; render the others."""
    preview: Annotated[bool, tyro.conf.arg(help_behavior_hint="(default: on without SCENE, else off)")] = False
    """Write a tone-mapped PNG beside each frame."""
    exposure: float = 0.0
    """Exposure of previews in stops."""
    video: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Make a film of the frames when all are there: the files' name without number, .mp4, with EXPOSURE."""
    cache: bool = True
    """Keep bakes that take long, and use them the next time: in the folder WARP_GI_BAKES, or warp_gi/bakes in
    XDG_CACHE_HOME or ~/.cache, at most 2 GiB. Frames are the same."""
    reuse_pictures: Annotated[Path | None, flag("FOLDER", "none")] = None
    """Folder for pictures of what the last frame's samples taught: the octree's leaves, samples and lights in them,
    shares of exploration and of the BSDF. The pipeline has to learn, as reuse and hybrid do."""
    reuse_pixel: Annotated[tuple[int, int] | None, flag("X Y", "none")] = None
    """Pixel x y whose quadtree to draw, beside the light that comes to the point seen there. 0 0 is at the top left."""
    json_progress: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print one JSON object a finished frame on stdout, for programs; other lines go to stderr."""
    quiet: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print nothing but errors."""
    verbose: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Print a table of the time of each stage."""
    settings: Annotated[Pipeline, tyro.conf.arg(name="")] = field(default_factory=lambda: Pipeline.preset(DEFAULT))


def main(arguments: Sequence[str]) -> int:
    """Run the command."""
    options = parse(arguments)
    return run_command(options, run, JsonReporter if options.json_progress else None)


def parse(arguments: Sequence[str]) -> Render:
    """Return the options; the pipeline named among them decides which settings there are."""
    before = ["", *arguments]
    is_bake = any(a.endswith(BAKE_SUFFIX) and b != "--bake" for a, b in zip(arguments, before, strict=False))
    named = value_given(arguments, "--pipeline") or ("probe_view" if is_bake else DEFAULT)
    settings = pipeline_named(named, value_given(arguments, "--quality") or NORMAL)
    if denoiser := value_given(arguments, "--denoise"):
        settings = replace(settings, denoise=find_denoiser(denoiser))
    options = parse_options(Render, "render", arguments, DESCRIPTION, Render(settings=settings))
    options.settings = with_settings_shared(options.settings, arguments)
    if not options.scene and not {"--preview", "--no-preview"} & set(arguments):
        options.preview = True
    return options


def run(options: Render, report: Reporter) -> None:
    """Render what the options say."""
    if options.reuse_pixel is not None and options.reuse_pictures is None:
        raise OptionError("--reuse-pixel goes with --reuse-pictures; give that too")
    resolution = parse_resolution(options.resolution) if options.resolution else None
    frame_time = parse_seconds(options.frame_time) if options.frame_time else None
    chunk = chunk_of(options.chunk, options.warm_up, frame_time)
    if options.cluster and (chunk or frame_time or options.reuse_pictures):
        raise OptionError("--cluster goes without --chunk, --frame-time and --reuse-pictures; leave them out")
    if options.cluster and options.output.suffix.lower() != ".exr":
        raise OptionError(f"--cluster needs .exr files, which say how they were made, got {options.output}")
    if options.video:
        if chunk is not None:
            raise OptionError("--video needs all frames, and a chunk has some; run warp-gi video when all are there")
        check_video(options.output)
    output = find_output(options)
    check_targets(options)
    check_camera_options(options)
    bakes = [load_bake(path) for path in options.bake]
    device = launch.get_device(options.device)
    launch.load_ahead(kernels_of(options.settings), device)
    with report.phase("scene"):
        scene = BakedScene(load_bake(options.scene)) if options.scene.endswith(BAKE_SUFFIX) else find_scene(options)
        camera = find_camera(options, scene, report)
    if resolution:
        camera = camera.at_resolution(*resolution)
    launch.load_ahead(kernels_of(options.settings, scene), device)
    describe(options, scene, report)
    shots = find_shots(options, camera)
    if isinstance(scene, Scene):
        move_sky(scene, options.environment_turn, camera, [shot.index for shot in shots])
    shown = scene.bake if isinstance(scene, BakedScene) else scene
    cache = BakeFolder() if options.cache else None
    memory = None if options.memory is None else 1e9 * options.memory
    scheduler = FrameScheduler(
        shown, camera, options.settings, options.device, options.seed, report.stage, bakes, cache, memory
    )
    if options.reuse_pictures is not None:
        from warp_gi.techniques.reuse.pictures import check_pictures  # its kernels are not for every run

        check_pictures(scheduler, shots[-1].camera, options.reuse_pixel)
    with report.phase("bake"):
        scheduler.bake(shots[0].time, len(shots))
        sequence = run_of(scheduler, shots, output, chunk)
    if frame_time is not None:
        with report.phase("timing of frames"):
            samples = take_time(sequence, frame_time, options.resume)
        report.line(f"{samples} sample{'s' * (samples != 1)} a pixel, as fits into {frame_time:g} s a frame")
    plan = sequence.plan(options.resume)
    if options.reuse_pictures is not None:
        if not plan.todo:
            raise OptionError("--reuse-pictures needs a frame to render, and all are there already; leave --resume out")
        check_writable(options.reuse_pictures)
    started = time.perf_counter()
    try:
        sequence.prepare(plan)
        times: dict[str, list[float]] = {}
        if options.cluster:
            if not plan.todo:
                with report.bar(0):  # its last line, for programs
                    pass
            else:
                from warp_gi.cli.cluster import render_on_cluster, scene_by_path

                source = scene_by_path(options, options.environment_turn, sequence)
                of_run = cache, options.resume, plan, sequence, report
                render_on_cluster(options.cluster, source, options.bake, *of_run)
        else:
            sequence.lead()
            times = render_shots(options, plan, sequence, report)
    except KeyboardInterrupt:
        raise KeyboardInterrupt("finished frames are kept, --resume renders the others") from None
    finally:
        sequence.finish()
    if chunk is not None and not plan.shots:
        report.line(f"chunk {options.chunk} has no frame: there are {len(shots)} in all")
    count = f"{len(plan.todo)} frame{'s' * (len(plan.todo) != 1)}"
    report.line(f"{count} in {time.perf_counter() - started:.1f} s: {options.output}")
    if options.video:
        film = Video(options.output, None, [shot.index for shot in shots], None, options.exposure * output.is_exr)
        with report.shares("video") as tell:
            film.write(tell)
        report.line(f"film: {film.output}")
    if options.verbose and times:
        times["bake"] = times["bake"][:1]  # every frame names the one bake
        rows = [(stage, *(f"{x:.3f}" for x in (v[0], sum(v) / len(v), max(v), sum(v)))) for stage, v in times.items()]
        report.table("seconds by stage", ("stage", "first frame", "mean", "largest", "sum"), rows)


def describe(options: Render, scene: Scene | BakedScene, report: Reporter) -> None:
    """Print what is rendered; raises OptionError for options that do not go with it."""
    if not isinstance(scene, BakedScene):
        report.line(f"{scene.name}: {scene.triangle_count:,} triangles, {scene.emitter_count:,} emitters")
        return
    report.line(f"{scene.name}: a bake, without its scene")
    if options.environment:
        raise OptionError("--environment goes with a scene; a bake shows the sky that it was baked under")
    of_file = options.smooth is not None or options.scale != 1.0 or options.up != "y" or options.recentre
    if options.environment_turn or of_file:
        raise OptionError(
            "--environment-turn, --smooth, --scale, --up and --recentre go with a scene; a bake shows what was baked"
        )


def find_shots(options: Render, camera: Camera | CameraPath) -> list[Shot]:
    """Return the frames that were asked for."""
    if options.frames:
        frames = parse_frames(options.frames)
    else:
        frames = list(range(camera.frame_count)) if isinstance(camera, CameraPath) else [0]
    return shots_of(camera, frames, options.output)


def check_targets(options: Render) -> None:
    """Raise before the scene is loaded, for frames that are none and for files that cannot be written."""
    frames = parse_frames(options.frames) if options.frames else [0]
    check_frames(frames, options.output)
    for index in frames:
        path = frame_path(options.output, index)
        if not options.resume or not path.is_file():  # a whole one is kept
            check_target(path)


def find_output(options: Render) -> Output:
    """Return the files that were asked for."""
    output = Output(options.output, options.precision, options.preview, options.exposure)
    if options.resume and not output.is_exr:
        raise OptionError("--resume needs .exr files, which say how they were made; a .png does not")
    return output


def render_shots(options: Render, plan: Plan, sequence: SequenceRun, report: Reporter) -> dict[str, list[float]]:
    """Render what is to be rendered; return the seconds of each stage, frame by frame."""
    times: dict[str, list[float]] = {}
    with stoppable() as stop, report.bar(len(plan.todo)):
        for shot in plan.todo:
            frame, _ = render_shot(shot, sequence, report)
            sequence.save_state(shot, frame)
            for stage, seconds in frame.timings.items():
                times.setdefault(stage, []).append(seconds)
            if options.reuse_pictures is not None and shot is plan.todo[-1] and isinstance(frame, Frame):
                from warp_gi.techniques.reuse.pictures import reuse_pictures

                reuse_pictures(sequence.scheduler, frame, options.reuse_pictures, options.reuse_pixel)
                report.line(f"pictures: {options.reuse_pictures}")
            del frame  # before there is a next one
            if stop.is_set():
                raise KeyboardInterrupt
    return times


def render_shot(shot: Shot, sequence: SequenceRun, report: Reporter) -> tuple[Frame | BandedFrame, dict[str, float]]:
    """Render a frame and write it; return it, and the seconds of its stages."""
    started, compiled = time.perf_counter(), launch.compile_seconds
    frame = sequence.render(shot)
    compiled = launch.compile_seconds - compiled
    seconds = time.perf_counter() - started - compiled
    note = f" and {compiled:.1f} s compiling kernels" if compiled > 0.5 else ""
    report.frame(f"{shot.path} {seconds:.2f} s{note}", seconds, shot.index, shot.path)
    return frame, frame.timings
