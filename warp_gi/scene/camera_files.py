"""Camera paths from JSON: this library's own, and the ``transforms.json`` of nerfstudio and instant-ngp."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from warp_gi.errors import SceneError
from warp_gi.scene.pinhole import Camera

T = TypeVar("T")
Vec3 = tuple[float, float, float]

PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")
"""Camera models of COLMAP that are pinholes, once the distortion is left out."""
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
RESOLUTION = (960, 540)
LARGEST = 1e300
"""Magnitude above which a number of a file is a mistake."""


@dataclass
class CameraFile:
    """What a file says of a camera path."""

    cameras: list[Camera]
    """The camera of each key, all of one resolution."""
    times: list[float] | None = None
    """Times of the keys in seconds; None is a frame each."""
    fps: float = 24.0
    """Frames per second."""
    looks: list[tuple[Vec3, Vec3, Vec3] | None] = field(default_factory=list)
    """Eye, target and up of each key as the file has them, or None where it has a matrix; empty if all have."""


def read_camera_file(path: Path) -> CameraFile:
    """Return the cameras of a JSON file, see ``CameraPath.load``; raises SceneError."""
    try:
        document = json.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise SceneError(f"camera path {path}: {error.strerror}; give a JSON file with keyframes") from error
    except (ValueError, RecursionError) as error:
        raise SceneError(f"camera path {path}: not JSON ({error})") from error
    if not isinstance(document, dict):
        raise SceneError(f"camera path {path}: expected an object with keyframes or frames, got {_shown(document)}")
    if "frames" in document and "keyframes" not in document:
        return naming_file(path, lambda: _transforms(document, path))
    return naming_file(path, lambda: _keyframes(document))


def naming_file(path: Path, read: Callable[[], T]) -> T:
    """Return what ``read`` does; its errors name the file."""
    try:
        return read()
    except SceneError:
        raise
    except ValueError as error:
        raise SceneError(f"camera path {path}: {error}") from error


LENS_FIELDS = ("hfov", "vfov", "lens_shift", "pixel_aspect", "ortho_width")
"""Fields of a keyframe that K stands for."""
KEYFRAME_FIELDS = {*LENS_FIELDS, "time", "eye", "target", "up", "K", "world_from_camera", "convention"}
KEYFRAME_FIELDS |= {"name", "comment"}


class _Fields:
    """Fields of an object in the file. Raises ValueError that names the object and the field."""

    def __init__(self, values: Mapping[str, Any], what: str) -> None:
        self.values, self.what = values, what

    def __contains__(self, name: str) -> bool:
        return name in self.values

    def expected(self, name: str, kind: str) -> ValueError:
        """Return an error about a field."""
        if name not in self.values:
            return ValueError(f"{name!r} is missing from {self.what}; expected {kind}")
        return ValueError(f"{name} of {self.what} must be {kind}, got {_shown(self.values[name])}")

    def number(self, name: str, default: float | None = None) -> float:
        """Return a finite number; None as the default says that it must be there."""
        value = self.values.get(name, default)
        if not _is_number(value):
            raise self.expected(name, "a finite number")
        return float(value)

    def numbers(self, name: str, count: int, default: Sequence[float] | None = None) -> tuple[float, ...]:
        """Return a list of finite numbers."""
        values = self.values.get(name, default)
        if not isinstance(values, list | tuple) or len(values) != count or not all(map(_is_number, values)):
            raise self.expected(name, f"{count} finite numbers")
        return tuple(map(float, values))

    def size(self, name: str, default: int | None = None) -> int:
        """Return a whole number of pixels from 1 up; some writers have 960.0."""
        value = self.values.get(name, default)
        if not _is_number(value) or value != int(value) or value < 1:
            raise self.expected(name, "a whole number from 1 up")
        return int(value)

    def matrix(self, name: str) -> list[list[float]]:
        """Return rows of numbers, all of one length."""
        rows: Any = self.values.get(name)
        is_matrix = isinstance(rows, list) and all(isinstance(row, list) for row in rows)
        if not is_matrix or len({len(row) for row in rows}) != 1 or not all(_is_number(x) for row in rows for x in row):
            raise self.expected(name, "a matrix of finite numbers, a list of rows")
        return rows

    def text(self, name: str, default: str) -> str:
        """Return a text."""
        value = self.values.get(name, default)
        if not isinstance(value, str):
            raise self.expected(name, "a text")
        return value

    def objects(self, name: str, singular: str) -> list[_Fields]:
        """Return the fields of each object of a list."""
        values = self.values.get(name)
        if not isinstance(values, list) or not all(isinstance(one, dict) for one in values):
            raise self.expected(name, "a list of objects")
        return [_Fields(one, f"{singular} {number}") for number, one in enumerate(values)]


def _keyframes(document: Mapping[str, Any]) -> CameraFile:
    path = _Fields(document, "the path")
    if "resolution" in path and not isinstance(document["resolution"], list):
        raise path.expected("resolution", "width and height in pixels")
    sides = document.get("resolution", RESOLUTION)
    if len(sides) != 2:
        raise path.expected("resolution", "width and height in pixels")
    both = _Fields({"width": sides[0], "height": sides[1]}, "the resolution")
    size = both.size("width"), both.size("height")
    keys = path.objects("keyframes", "keyframe")
    for key in keys:
        if "K" in key and "resolution" not in path:
            raise ValueError(
                f"{key.what} has K and the path no resolution; give resolution, the width and height in pixels of K"
            )
    cameras = [_named(key, partial(_camera, key, size)) for key in keys]
    times = [key.number("time", 0.0) for key in keys]
    return CameraFile(cameras, times, path.number("fps", 24.0), [_look(key) if "eye" in key else None for key in keys])


def _named(values: _Fields, make: Callable[[], T]) -> T:
    """Return what ``make`` does; errors about a camera without a name say which one it is."""
    try:
        return make()
    except ValueError as error:
        text = str(error).removeprefix("camera '': ").removeprefix("camera ")
        raise ValueError(text if values.what in text else f"{values.what}: {text}") from error


def _camera(key: _Fields, resolution: tuple[int, int]) -> Camera:
    """Return the camera of a keyframe."""
    unknown = sorted(set(key.values) - KEYFRAME_FIELDS)
    if unknown:
        warnings.warn(
            f"{key.what} of a camera path has {', '.join(map(repr, unknown))}, which nothing reads; known are"
            f" {', '.join(sorted(KEYFRAME_FIELDS))}",
            stacklevel=8,
        )
    beside = [name for name in LENS_FIELDS if name in key]
    if "K" in key and beside:
        raise ValueError(f"{key.what} has K and {beside[0]}, which follows from it; leave one out")
    convention: Any = key.text("convention", "opengl")
    if "K" in key:
        K = key.matrix("K")
        if "world_from_camera" in key:
            return Camera.from_intrinsics(K, key.matrix("world_from_camera"), resolution, convention)
        return Camera.from_intrinsics(K, Camera.look_at(*_look(key)).world_from_camera, resolution, "opengl")
    if "world_from_camera" in key:
        camera = Camera.from_intrinsics(np.eye(3), key.matrix("world_from_camera"), (1, 1), convention)
    else:
        camera = Camera.look_at(*_look(key))
    right, above = key.numbers("lens_shift", 2, (0.0, 0.0))
    camera = replace(
        camera,
        hfov=key.number("hfov", 65.0),
        resolution=resolution,
        lens_shift=(right, above),
        pixel_aspect=key.number("pixel_aspect", 1.0),
        ortho_width=key.number("ortho_width", 0.0),
    )
    if camera.is_orthographic and ("vfov" in key or "hfov" in key):
        raise ValueError(f"{key.what} has ortho_width and a field of view; leave one out")
    if "vfov" in key and "hfov" in key:
        raise ValueError(f"{key.what} has both hfov and vfov; leave one out")
    return camera.with_vfov(key.number("vfov")) if "vfov" in key else camera


def _look(key: _Fields) -> tuple[Vec3, Vec3, Vec3]:
    """Return eye, target and up of a keyframe."""
    return _three(key.numbers("eye", 3)), _three(key.numbers("target", 3)), _three(key.numbers("up", 3, (0, 1, 0)))


def _transforms(document: Mapping[str, Any], path: Path) -> CameraFile:
    """Return the cameras of a ``transforms.json``, a frame each; axes are OpenGL's, lengths the file's own."""
    cameras: list[Camera] = []
    sizes: list[tuple[int, int]] = []
    distorted: set[str] = set()
    is_rolling = False
    frames = _Fields(document, "the file").objects("frames", "frame")
    if not frames:
        raise ValueError("expected frames, found none")
    for frame in frames:
        values = _Fields({**document, **frame.values}, frame.what)
        model = values.text("camera_model", "OPENCV")
        if model not in PINHOLES or values.values.get("is_fisheye"):
            raise ValueError(f"{frame.what} has a camera of the model {model}; expected one of {', '.join(PINHOLES)}")
        distorted |= {name for name in DISTORTION if values.number(name, 0.0)}
        sizes.append(_size(values))
        if sizes[-1] != sizes[0]:
            (w, h), (width, height) = sizes[-1], sizes[0]
            raise ValueError(f"{frame.what} is {w}x{h}, the first {width}x{height}; make a file for each size")
        cameras.append(_transforms_camera(values, sizes[0]))
        is_rolling = is_rolling or bool(np.any(np.asarray(values.values.get("rolling_shutter", 0)) != 0))
    if distorted:
        names = ", ".join(sorted(distorted))
        warnings.warn(
            f"camera path {path}: lens distortion ({names}) is not modelled and left out; undistort the pictures to"
            " compare with",
            stacklevel=6,
        )
    if is_rolling:
        warnings.warn(f"camera path {path}: rolling_shutter is not modelled and left out", stacklevel=6)
    return CameraFile(cameras)


def _size(values: _Fields) -> tuple[int, int]:
    """Return width and height of a frame. What is given in pixels, or across alone, has no meaning without them."""
    lacking = [side for side in ("w", "h") if side not in values]
    given = [name for name in ("fl_x", "fl_y", "cx", "cy", "w", "h") if name in values]
    if lacking and given:
        raise ValueError(f"{values.what} has {given[0]} without {' and '.join(lacking)}; give w and h in pixels")
    return values.size("w", RESOLUTION[0]), values.size("h", RESOLUTION[1])


def _transforms_camera(values: _Fields, resolution: tuple[int, int]) -> Camera:
    width, height = resolution
    if "fl_x" in values:
        fx = values.number("fl_x")
    elif "camera_angle_x" in values:
        fx = _focal_length(values, "camera_angle_x", width)
    else:
        raise ValueError(f"fl_x or camera_angle_x is missing from {values.what}; give one of them")
    fy = values.number("fl_y", fx)
    if "fl_y" not in values and "camera_angle_y" in values and "h" in values:
        fy = _focal_length(values, "camera_angle_y", height)
    K = [[fx, 0.0, values.number("cx", width / 2)], [0.0, fy, values.number("cy", height / 2)], [0.0, 0.0, 1.0]]
    placement = values.matrix("transform_matrix")
    return _named(values, partial(Camera.from_intrinsics, K, placement, resolution, "opengl"))


def _focal_length(values: _Fields, name: str, side: int) -> float:
    """Return the focal length in pixels of a field of view."""
    angle = values.number(name)
    if not 0.0 < angle < math.pi:
        raise values.expected(name, "an angle in radians between 0 and pi")
    return 0.5 * side / math.tan(angle / 2)


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and -LARGEST <= value <= LARGEST


def _shown(value: object) -> str:
    return f"{value!r:.60}"


def _three(values: Sequence[float]) -> Vec3:
    x, y, z = values
    return x, y, z
