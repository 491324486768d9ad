"""Cameras, and the paths that they take."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import warnings
from bisect import bisect_right
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warp_gi.errors import OptionError, SceneError, check_number, unknown_name
from warp_gi.files import user_path
from warp_gi.scene.animation import key_times
from warp_gi.scene.camera_files import naming_file, read_camera_file
from warp_gi.scene.pinhole import Camera, checked_resolution

if TYPE_CHECKING:
    from warp_gi.scene.scene import Scene

__all__ = ["STILL_FPS", "Camera", "CameraKey", "CameraPath", "frame_time"]

Vec3 = tuple[float, float, float]

MOST_BETWEEN, CLOSE = 240, 4
"""Keys of a path between two keyframes of a scene, and frames beside each of these that have a key in any case."""
COARSE = 2e-3
"""Largest step of float32 positions at a camera, in radii of the scene, that goes without a warning."""
LAST_FRAME = 2**31 - 1
"""Largest number of a frame, as files hold it."""
STILL_FPS = 24.0
"""Frames per second of a camera that is no path."""


@dataclass(frozen=True)
class CameraKey:
    """A camera pose at a time. Raises OptionError for values that are not numbers, or not as many as stated."""

    time: float
    """Time of the key in seconds."""
    eye: Vec3
    """Position of the camera in metres."""
    target: Vec3
    """Point in metres that the camera looks at."""
    up: Vec3 = (0.0, 1.0, 0.0)
    """Direction that is up in the picture, of any length."""
    hfov: float = 65.0
    """Horizontal field of view in degrees."""
    lens_shift: tuple[float, float] = (0.0, 0.0)
    """By how much the middle of the picture is right of the view axis, in widths, and above it, in heights."""
    pixel_aspect: float = 1.0
    """Width of a pixel by its height."""
    keeps_vertical: bool = False
    """Whether the vertical field of view, and not the horizontal one, stays at another resolution."""
    ortho_width: float = 0.0
    """Width in metres of what an orthographic camera shows; 0 is a perspective camera."""

    def __post_init__(self) -> None:
        for name, count in (("eye", 3), ("target", 3), ("up", 3), ("lens_shift", 2)):
            object.__setattr__(self, name, _numbers(name, getattr(self, name), count))
        for name in ("time", "hfov", "pixel_aspect", "ortho_width"):
            check_number(f"{name} of a camera key", getattr(self, name))


def _numbers(name: str, value: object, count: int) -> tuple[float, ...]:
    """Return a value of a camera key as a tuple; raises OptionError unless it is so many numbers."""
    try:
        numbers = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError):
        numbers = np.empty(0)
    if numbers.shape != (count,):
        raise OptionError(f"{name} of a camera key must be {count} numbers, got {value!r:.80}")
    return tuple(numbers.tolist())


@dataclass(frozen=True)
class CameraPath:
    """Keyframes in time; eye, target, up and lens follow cubic Hermite curves through the keys.

    Raises OptionError without keys, with times that do not rise, or with perspective and orthographic keys.
    """

    keys: tuple[CameraKey, ...]
    """Poses of the camera, their times rising."""
    fps: float = 24.0
    """Frames per second: frame i is at time ``i / fps``."""
    resolution: tuple[int, int] = (960, 540)
    """Width and height in pixels."""
    name: str = field(default="", compare=False)
    """Name in messages and reports."""
    offset: Vec3 = (0.0, 0.0, 0.0)
    """Point in metres of a file's coordinates that the keys count from: that of a recentred scene."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "keys", tuple(self.keys))
        if not self.keys:
            raise OptionError("a camera path needs at least one keyframe")
        if any(a.time >= b.time for a, b in zip(self.keys, self.keys[1:], strict=False)):
            raise OptionError("the times of a camera path's keyframes must rise")
        if not (all(math.isfinite(key.time) for key in self.keys) and self.keys[-1].time >= 0):
            times = [key.time for key in self.keys]
            raise OptionError(f"keyframe times of a camera path must be finite and end at 0 s or later, got {times}")
        if len({key.ortho_width > 0 for key in self.keys}) > 1:
            raise OptionError("the keyframes of a camera path must be all perspective or all orthographic")
        if not (self.fps > 0 and math.isfinite(self.fps)):
            raise OptionError(f"fps must be finite and above 0, got {self.fps}")

    @property
    def frame_count(self) -> int:
        """Number of frames from time 0 to the last key, both included."""
        return math.floor(self.keys[-1].time * self.fps + 1e-6) + 1

    def camera(self, frame: int) -> Camera:
        """Return the camera of a frame."""
        return self.camera_at(frame / self.fps)

    def camera_at(self, time: float) -> Camera:
        """Return the camera at a time in seconds, held before the first and after the last key."""
        after = bisect_right(self.keys, time, key=lambda key: key.time)
        keys = self.keys[max(after - 2, 0) : after + 2]  # those that decide it
        lenses = ([k.hfov, *k.lens_shift, k.pixel_aspect, k.ortho_width] for k in keys)
        rows = np.array([[*k.eye, *k.target, *k.up, *lens] for k, lens in zip(keys, lenses, strict=True)], np.float64)
        pose = _hermite(np.array([k.time for k in keys]), rows, time)
        camera = Camera.look_at(pose[0:3], pose[3:6], pose[6:9], float(pose[9]), self.resolution, self.name)
        right, above, pixel_aspect, width = pose[10:].tolist()
        width = float(np.clip(width, rows[:, -1].min(), rows[:, -1].max()))  # a curve may pass below 0
        shift = right, above
        return replace(camera, offset=self.offset, lens_shift=shift, pixel_aspect=pixel_aspect, ortho_width=width)

    def relative_to(self, offset: Sequence[float] | np.ndarray) -> CameraPath:
        """Return the same path, counted from another point of the file's coordinates (as of ``Scene.offset``)."""
        if np.array_equal(self.offset, offset):
            return self
        move = np.subtract(self.offset, offset)
        keys = [replace(k, eye=_three(move + k.eye), target=_three(move + k.target)) for k in self.keys]
        return replace(self, keys=tuple(keys), offset=_three(offset))

    def at_resolution(self, width: int, height: int) -> CameraPath:
        """Return the same path with another resolution; fields of view stay as ``CameraKey.keeps_vertical`` says."""
        width, height = checked_resolution((width, height))
        wider = (width / height) / (self.resolution[0] / self.resolution[1])

        def fitted(key: CameraKey) -> CameraKey:
            half = math.tan(math.radians(key.hfov) / 2) * wider
            return replace(key, hfov=2 * math.degrees(math.atan(half))) if key.keeps_vertical else key

        return replace(self, keys=tuple(fitted(key) for key in self.keys), resolution=(width, height))

    @classmethod
    def still(cls, camera: Camera) -> CameraPath:
        """Return a path that stays at ``camera``."""
        return cls.from_cameras([camera])

    @classmethod
    def from_cameras(
        cls, cameras: Iterable[Camera], times: Iterable[float] | None = None, fps: float = 24.0
    ) -> CameraPath:
        """Return a path through ``cameras``, at ``times`` in seconds or one a frame."""
        cameras = list(cameras)
        times = [i / fps for i in range(len(cameras))] if times is None else list(times)
        offset = cameras[0].offset if cameras else (0.0, 0.0, 0.0)
        keys = []
        for camera, time in zip(cameras, times, strict=True):
            matrix = camera.relative_to(offset).world_from_camera
            target = matrix[:3, 3] - matrix[:3, 2]
            lens = camera.hfov, camera.lens_shift, camera.pixel_aspect, camera.keeps_vertical, camera.ortho_width
            keys.append(CameraKey(time, _three(matrix[:3, 3]), _three(target), _three(matrix[:3, 1]), *lens))
        return cls(tuple(keys), fps, cameras[0].resolution if cameras else (960, 540), offset=offset)

    @classmethod
    def orbit(
        cls,
        center: Sequence[float],
        radius: float,
        height: float = 0.0,
        seconds: float = 2.0,
        turns: float = 1.0,
        hfov: float = 65.0,
        resolution: tuple[int, int] = (960, 540),
        fps: float = 24.0,
    ) -> CameraPath:
        """Return a path that circles ``center`` at ``radius`` and ``height`` above it [m], looking at it."""
        count = max(2, math.ceil(abs(turns) * 24) + 1)
        cx, cy, cz = center
        keys = []
        for i in range(count):
            angle = 2 * math.pi * turns * i / (count - 1)
            eye = (cx + radius * math.sin(angle), cy + height, cz + radius * math.cos(angle))
            keys.append(CameraKey(seconds * i / (count - 1), eye, (cx, cy, cz), hfov=hfov))
        return cls(tuple(keys), fps, resolution)

    @classmethod
    def from_gltf(cls, path: str | Path, name: str | None = None, fps: float = 24.0) -> CameraPath:
        """Return the path of a camera in a glTF or GLB file, one key a frame over the animation of its node.

        ``name`` None is the file's first camera. Raises SceneError if the file has no camera, OptionError if it
        has none of that name.
        """
        from warp_gi.scene.loading import load_scene

        scene = load_scene(path)
        if not scene.cameras:
            raise SceneError(f"{path}: expected a glTF camera, found none; give a JSON camera path instead")
        return cls.from_scene(scene, name, fps)

    @classmethod
    def from_scene(cls, scene: Scene, name: str | None = None, fps: float = 24.0) -> CameraPath:
        """Return the path of a scene's camera, one key a frame over the scene's animation; it may stand still.

        Between keyframes of the scene that are far apart it has fewer. ``name`` None is the first camera. Raises
        OptionError if there is none of that name.
        """
        if name is None:
            name = next(iter(scene.cameras), "")
        if name not in scene.cameras:
            raise unknown_name("camera", name, scene.cameras)
        camera = scene.cameras[name]
        node = scene.camera_nodes.get(name)
        if node is None or not scene.moves(node):
            return replace(cls.still(camera), fps=fps)
        frames = _telling_frames(key_times(scene.nodes), fps)
        poses = [replace(camera, world_from_camera=scene.world_from_node(node, i / fps)) for i in frames]
        return cls.from_cameras(poses, [i / fps for i in frames], fps)

    @classmethod
    def load(cls, path: str | Path) -> CameraPath:
        """Read a path from JSON, as ``save`` writes it, or the cameras of a ``transforms.json``, one a frame.

        ``{"fps": 24, "resolution": [960, 540], "keyframes": [{"time": 0, "eye": [x, y, z],
        "target": [x, y, z], "up": [0, 1, 0], "hfov": 65}, ...]}``; up, hfov, fps and resolution may be left out. A
        keyframe may have "vfov" or "ortho_width" in place of hfov, "lens_shift" and "pixel_aspect"; or "K", which needs
        the resolution.
        In place of eye and target it may have "world_from_camera" and "convention", as ``Camera.from_intrinsics``.
        Raises SceneError when the file is missing or not such a path.
        """
        file = user_path(path)
        found = read_camera_file(file)

        def made() -> CameraPath:
            path = cls.from_cameras(found.cameras, found.times, found.fps)
            # as they are: a target further away turns the camera otherwise between keys
            looks = found.looks or [None] * len(path.keys)
            keys = [
                replace(key, eye=look[0], target=look[1], up=look[2]) if look else key
                for key, look in zip(path.keys, looks, strict=True)
            ]
            return replace(path, keys=tuple(keys), name=file.stem)

        return naming_file(file, made)

    def save(self, path: str | Path) -> None:
        """Write the path as JSON, in the file's coordinates."""
        keys: list[dict[str, object]] = []
        for k in self.relative_to((0.0, 0.0, 0.0)).keys:
            key: dict[str, object] = {
                "time": k.time,
                "eye": list(k.eye),
                "target": list(k.target),
                "up": list(k.up),
                "hfov": k.hfov,
            }
            if k.lens_shift != (0.0, 0.0) or k.pixel_aspect != 1.0:
                key |= {"lens_shift": list(k.lens_shift), "pixel_aspect": k.pixel_aspect}
            if k.ortho_width:
                key["ortho_width"] = k.ortho_width
                del key["hfov"]
            elif k.keeps_vertical:
                lens = Camera(np.eye(4), k.hfov, self.resolution, pixel_aspect=k.pixel_aspect)
                key["vfov"] = lens.vfov
                del key["hfov"]
            keys.append(key)
        document = {"fps": self.fps, "resolution": list(self.resolution), "keyframes": keys}
        user_path(path).write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _telling_frames(times: Iterable[float], fps: float) -> list[int]:
    """Return the frames from 0 to the last of ``times`` [s], and between times that are far apart a few of them.

    A pose is a smooth function between the times of keyframes, and may turn sharply at these.
    """
    ends = [0, *(math.floor(time * fps + 1e-6) for time in sorted(times) if time > 0)]
    chosen: set[int] = {0}
    for begin, end in itertools.pairwise(ends):
        if end - begin <= MOST_BETWEEN:
            chosen.update(range(begin, end + 1))
        else:
            chosen.update(np.linspace(begin, end, MOST_BETWEEN).astype(np.int64).tolist())
            chosen.update((*range(begin, begin + CLOSE), *range(end - CLOSE + 1, end + CLOSE)))
    return sorted(frame for frame in chosen if frame <= ends[-1])


def warn_if_far(camera: Camera | CameraPath, scene: Scene) -> None:
    """Warn of a camera so far off that float32 cannot place it as exactly as the scene's size asks for."""
    path = camera if isinstance(camera, CameraPath) else CameraPath.still(camera)
    farthest = max(float(np.abs(path.camera_at(key.time).position).max()) for key in (path.keys[0], path.keys[-1]))
    step = float(np.spacing(np.float32(farthest)))
    if step > COARSE * scene.radius:
        warnings.warn(
            f"the camera is {farthest:.3g} m from the origin, where float32 positions have steps of {step:.2g} m, and"
            f" the scene's radius is {scene.radius:.2g} m: pictures will be wrong; move the camera nearer, or use"
            " recentre for scenes far from the origin",
            stacklevel=3,
        )


def frame_time(camera: Camera | CameraPath, index: int) -> float:
    """Return the time of a frame in seconds: that of the path, or of ``STILL_FPS`` frames a second.

    Raises OptionError for a number past ``LAST_FRAME``.
    """
    if index > LAST_FRAME:
        raise OptionError(f"frame numbers must be at most {LAST_FRAME:,}, got {str(index)[:15]}...")
    return index / (camera.fps if isinstance(camera, CameraPath) else STILL_FPS)


def _three(values: Sequence[float] | np.ndarray) -> Vec3:
    x, y, z = (float(v) for v in values)
    return x, y, z


def _hermite(times: np.ndarray, rows: np.ndarray, time: float) -> np.ndarray:
    """Cubic Hermite interpolation with finite-difference slopes (non-uniform Catmull-Rom)."""
    if len(times) == 1 or time <= times[0]:
        return rows[0]
    if time >= times[-1]:
        return rows[-1]
    i = int(np.searchsorted(times, time, side="right")) - 1
    steps = np.diff(rows, axis=0) / np.diff(times)[:, None]
    slopes = np.concatenate([steps[:1], 0.5 * (steps[1:] + steps[:-1]), steps[-1:]])
    h = times[i + 1] - times[i]
    s = (time - times[i]) / h
    return (
        (2 * s**3 - 3 * s**2 + 1) * rows[i]
        + (s**3 - 2 * s**2 + s) * h * slopes[i]
        + (3 * s**2 - 2 * s**3) * rows[i + 1]
        + (s**3 - s**2) * h * slopes[i + 1]
    )


def views_hash(camera: Camera | CameraPath | None) -> str:
    """Return a SHA-256 of all that decides the views of a camera, in hexadecimal digits: keys, lenses and sizes."""
    digest = hashlib.sha256(b"warp_gi views 2")
    if isinstance(camera, Camera):
        camera = CameraPath.still(camera)
    if camera is not None:
        numbers = [camera.fps, *camera.resolution, *camera.offset]
        for key in camera.keys:
            numbers += [key.time, *key.eye, *key.target, *key.up]
            numbers += [key.hfov, *key.lens_shift, key.pixel_aspect, key.ortho_width]
        digest.update(np.array(numbers, np.float64).tobytes())
    return digest.hexdigest()
