"""Inputs of commands: scenes, skies, cameras."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
import tyro

from warp_gi.cli.options import flag
from warp_gi.errors import OptionError, unknown_name
from warp_gi.scene.baked import BakedScene, whole_scene
from warp_gi.scene.builtin import BUILTIN_SCENES, builtin_camera_path, builtin_scene
from warp_gi.scene.camera import STILL_FPS, Camera, CameraPath
from warp_gi.scene.environment import Environment, SunSky, as_environment
from warp_gi.scene.loading import load_scene
from warp_gi.scene.pinhole import checked_resolution
from warp_gi.scene.scene import Scene
from warp_gi.scene.sky_motion import SkySequence, TurningSky

if TYPE_CHECKING:
    from warp_gi.cli.report import Reporter

DEFAULT_SCENE = "atrium"
BAKE_SUFFIX = ".safetensors"


@dataclass
class SceneOptions:
    """What is looked at, under which sky, and from where."""

    scene: Annotated[str, tyro.conf.Positional, flag("[SCENE]", DEFAULT_SCENE)] = ""
    """A GLB, glTF, OBJ or PLY file, or the name of a built-in scene."""
    smooth: Annotated[float | None, flag("DEGREES", "flat, as glTF asks")] = None
    """Crease angle in degrees: meshes of a file without normals get smooth ones, except across edges that bend more."""
    scale: float = 1.0
    """Length in metres of one unit of the file."""
    up: Literal["x", "y", "z"] = "y"
    """Axis of the file that points up; it becomes y, and cameras are given in the turned coordinates."""
    recentre: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Take the middle of the scene from all positions, in double precision. That is done without being asked where
    float32 has steps of more than a millimetre. Cameras stay in the file's coordinates; frames say what was taken."""
    restrict_paths: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Let the scene's file name files in its own folder or below alone, for scenes of strangers."""
    environment: Annotated[str, flag("SKY", "the scene's own; files: none")] = ""
    """Sky of the scene: a latitude-longitude EXR or HDR file, a radiance R,G,B, sun-sky, or none. FILE:layer
    chooses a part or layer of an EXR file. In sky.####.exr the frame's number takes the place of ####, so that each
    frame has a sky of its own."""
    environment_rotation: float = 0.0
    """Angle in degrees by which the sky is turned about +y, counter-clockwise seen from above."""
    environment_scale: float = 1.0
    """Factor on the sky's radiance."""
    sun: SunSky = field(default_factory=SunSky)
    camera: Annotated[str, flag("PATH", "the built-in path, the file's first camera, or one that sees all")] = ""
    """Camera path in JSON, a transforms.json of nerfstudio, name of a camera in the scene, or name of a built-in scene
    whose path to take."""
    eye: Annotated[tuple[float, float, float] | None, flag("X Y Z", "use --camera")] = None
    """Position of a still camera in metres."""
    target: Annotated[tuple[float, float, float] | None, flag("X Y Z", "use --camera")] = None
    """Point in metres that a still camera looks at."""
    hfov: Annotated[float | None, flag("DEGREES", "the camera's own; 65 with --eye")] = None
    """Horizontal field of view of a still camera in degrees."""
    vfov: Annotated[float | None, flag("DEGREES", "as --hfov and the resolution say")] = None
    """Vertical field of view of a still camera in degrees, in place of --hfov."""
    ortho: Annotated[float | None, flag("METRES", "a perspective camera, or as the file has it")] = None
    """Width in metres of what a still camera shows by parallel rays (orthographic), in place of --hfov."""


def open_scene(
    name: str,
    smooth: float | None = None,
    scale: float = 1.0,
    recentre: bool | None = None,
    up: Literal["x", "y", "z"] = "y",
    restrict_paths: bool = False,
) -> Scene:
    """Return a built-in scene by name, or one from a file (the other arguments are those of ``load_scene``)."""
    if name in BUILTIN_SCENES and not Path(name).is_file():
        if smooth is not None or scale != 1.0 or recentre or up != "y":
            raise OptionError(f"--smooth, --scale, --up and --recentre go with a scene from a file; {name} is built in")
        return builtin_scene(name)
    if not Path(name).suffix and not Path(name).exists():
        raise unknown_name("scene", name, BUILTIN_SCENES)
    return load_scene(name, smooth=smooth, scale=scale, recentre=recentre, up=up, restrict_paths=restrict_paths)


def find_scene(options: SceneOptions) -> Scene:
    """Return the scene that was asked for, with its sky."""
    name = options.scene or DEFAULT_SCENE
    of_file = options.smooth, options.scale, options.recentre or None, options.up, options.restrict_paths
    scene = open_scene(name, *of_file)
    if options.sun != SunSky() and options.environment != "sun-sky":
        raise OptionError("--sun.elevation and other --sun flags go with --environment sun-sky; give that too")
    if options.environment:
        scene.environment = parse_environment(options)
    elif options.environment_rotation or options.environment_scale != 1.0:
        raise OptionError("--environment-rotation and --environment-scale go with --environment; give that too")
    return scene


def parse_environment(options: SceneOptions) -> Environment | SkySequence:
    """Return the sky that ``--environment`` names."""
    text = options.environment
    if "#" in Path(text).name and not Path(text).is_file():
        return SkySequence(text, STILL_FPS, options.environment_rotation, options.environment_scale)
    numbers = re.split(r"[,\s]+", text.strip())
    if text == "none":
        sky = as_environment(None)
    elif text == "sun-sky":
        sky = as_environment(options.sun)
    elif all(re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?", number, re.I) for number in numbers):
        if len(numbers) not in (1, 3):
            raise OptionError(f"--environment takes 1 or 3 numbers, got {text!r}; for example 1,0.9,0.8")
        values = [float(number) for number in numbers]
        sky = as_environment(tuple(values) if len(values) == 3 else values[0])
    else:
        sky = as_environment(text)
    if options.environment_scale != 1.0:
        sky = replace(sky, scale=sky.scale * options.environment_scale)
    return sky.rotated(options.environment_rotation)


def move_sky(scene: Scene, turn: float, camera: Camera | CameraPath, frames: Iterable[int]) -> None:
    """Let a sky change from frame to frame of a camera: by a file a frame, and turned by ``turn`` degrees a frame.

    Raises OptionError for a turn that cannot be, SceneError for frames that a sequence of skies has no file for.
    """
    if not math.isfinite(turn):
        raise OptionError(f"--environment-turn must be a finite number of degrees, got {turn:g}")
    if turn and scene.environment is None:
        raise OptionError(f"--environment-turn needs a sky to turn, and {scene.name} has none; give --environment too")
    fps = camera.fps if isinstance(camera, CameraPath) else STILL_FPS
    sky = scene.sky_at or scene.environment
    if isinstance(sky, SkySequence):
        sky = replace(sky, fps=fps)
        sky.check(frames)
    if turn or sky is not scene.environment:
        scene.environment = TurningSky(sky, turn, fps) if turn else sky


def check_camera_options(options: SceneOptions) -> None:
    """Raise OptionError for options of a camera that do not go together, before a scene is loaded."""
    for name, angle in (("--hfov", options.hfov), ("--vfov", options.vfov)):
        if angle is not None and not 0.0 < angle < 180.0:
            raise OptionError(f"{name} must be between 0 and 180 degrees, got {angle:g}")
    if options.hfov is not None and options.vfov is not None:
        raise OptionError("--hfov and --vfov exclude each other; give one")
    if (options.eye is None) != (options.target is None):
        raise OptionError("--eye and --target go together; give both")
    if options.eye is not None and options.camera:
        raise OptionError("--camera and --eye exclude each other; give one")
    if options.ortho is not None and (options.hfov is not None or options.vfov is not None):
        raise OptionError("--ortho goes without --hfov and --vfov: parallel rays have no field of view")
    if options.ortho is not None and not (options.ortho > 0 and math.isfinite(options.ortho)):
        raise OptionError(f"--ortho must be a width above 0 m, got {options.ortho:g}")


def find_camera(options: SceneOptions, scene: Scene | BakedScene, report: Reporter) -> Camera | CameraPath:
    """Return the camera or path that was asked for, counted from where the scene's positions are."""
    check_camera_options(options)
    camera = _find_camera(options, scene, report)
    if options.vfov is not None:
        if isinstance(camera, CameraPath):
            raise OptionError("--vfov goes with a still camera; a camera path has its own field of view")
        camera = camera.with_vfov(options.vfov)
    if options.ortho is not None:
        if isinstance(camera, CameraPath):
            raise OptionError("--ortho goes with a still camera; keyframes of a camera path have ortho_width")
        camera = replace(camera, ortho_width=options.ortho, keeps_vertical=False)
    return camera.relative_to(scene.offset)


def _find_camera(options: SceneOptions, scene: Scene | BakedScene, report: Reporter) -> Camera | CameraPath:
    if options.eye is not None and options.target is not None:
        return Camera.look_at(options.eye, options.target, hfov=options.hfov or 65.0)
    camera: Camera | CameraPath
    if options.camera in scene.cameras:
        camera = scene_camera(whole_scene(scene), options.camera)
    elif options.camera.lower().endswith(".json"):
        camera = CameraPath.load(options.camera)
    elif options.camera in BUILTIN_SCENES:
        camera = builtin_camera_path(options.camera)
    elif options.camera:
        raise unknown_name("camera", options.camera, [*scene.cameras, *BUILTIN_SCENES, "a .json file"])
    elif (options.scene or DEFAULT_SCENE) in BUILTIN_SCENES:
        camera = builtin_camera_path(options.scene or DEFAULT_SCENE)
    elif scene.name in BUILTIN_SCENES and isinstance(scene, BakedScene):
        camera = builtin_camera_path(scene.name)
    elif isinstance(scene, BakedScene):
        raise OptionError("a bake has no camera; give --camera or --eye and --target, inside of the scene")
    elif scene.cameras:
        camera = scene_camera(scene, next(iter(scene.cameras)))
    else:
        report.line("the scene has no camera: showing all of it from outside; --camera or --eye choose another view")
        camera = overview(scene, options.hfov or 65.0)
    if options.hfov is not None:
        if isinstance(camera, CameraPath):
            raise OptionError("--hfov goes with a still camera; a camera path has its own field of view")
        camera = replace(camera, hfov=options.hfov, keeps_vertical=False)
    return camera


def has_camera(options: SceneOptions, scene: Scene) -> bool:
    """Return whether a camera was asked for, or the scene brings one: else ``find_camera`` shows it from outside."""
    name = options.scene or DEFAULT_SCENE
    return bool(options.camera or options.eye is not None or scene.cameras or name in BUILTIN_SCENES)


def scene_camera(scene: Scene, name: str) -> Camera | CameraPath:
    """Return a camera of the scene; its path if it moves with a node."""
    path = CameraPath.from_scene(scene, name)
    return path if len(path.keys) > 1 else scene.cameras[name]


def overview(scene: Scene, hfov: float) -> Camera:
    """Return a camera that sees the whole scene from outside, from above a corner."""
    low, high = scene.bounds.astype(np.float64)
    direction = np.array([0.6, 0.45, 0.66]) / np.linalg.norm([0.6, 0.45, 0.66])
    distance = scene.radius / math.sin(math.radians(hfov) / 2)
    center = (low + high) / 2
    camera = Camera.look_at(center + distance * direction, center, hfov=hfov)
    x, y, z = scene.offset.tolist()
    return replace(camera, offset=(x, y, z))


def parse_resolution(text: str) -> tuple[int, int]:
    """Return (width, height) of "960x540"; raises OptionError for anything else."""
    match = re.fullmatch(r"\s*(\d{1,18})\s*[xX×]\s*(\d{1,18})\s*", text)
    if not match or not int(match[1]) or not int(match[2]):
        raise OptionError(f"resolution {text[:80]!r} not understood; write for example 960x540")
    return checked_resolution((match[1], match[2]))
