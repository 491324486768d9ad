"""Camera paths from JSON: this library's own, and the ``transforms.json`` of nerfstudio and instant-ngp."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from warp_gi.errors import SceneError
from warp_gi.scene.pinhole import Camera

T = TypeVar("T")
Vec3 = tuple[float, float, float]

PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")
"""Camera models of COLMAP that are pinholes, once the distortion is left out."""
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
RESOLUTION = (960, 540)


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
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SceneError(f"camera path {path}: {error.strerror}; give a JSON file with keyframes") from error
    except ValueError as error:
        raise SceneError(f"camera path {path}: not JSON ({error})") from error
    if isinstance(document, dict) and "frames" in document and "keyframes" not in document:
        return naming_file(path, lambda: _transforms(document, path))
    return naming_file(path, lambda: _keyframes(document))


def naming_file(path: Path, read: Callable[[], T]) -> T:
    """Return what ``read`` does; its errors name the file."""
    try:
        return read()
    except KeyError as error:
        raise SceneError(f"camera path {path}: {error} is missing from the path or from a keyframe") from error
    except SceneError:
        raise
    except (TypeError, ValueError, AttributeError) as error:
        raise SceneError(f"camera path {path}: {error}") from error


def _keyframes(document: Mapping[str, Any]) -> CameraFile:
    width, height = (int(size) for size in document.get("resolution", RESOLUTION))
    cameras = [_camera(key, (width, height)) for key in document["keyframes"]]
    times = [float(key.get("time", 0.0)) for key in document["keyframes"]]
    fps = float(document.get("fps", 24.0))
    return CameraFile(cameras, times, fps, [_look(key) if "eye" in key else None for key in document["keyframes"]])


def _camera(key: Mapping[str, Any], resolution: tuple[int, int]) -> Camera:
    """Return the camera of a keyframe."""
    convention = key.get("convention", "opengl")
    if "K" in key:
        if "world_from_camera" in key:
            return Camera.from_intrinsics(key["K"], key["world_from_camera"], resolution, convention)
        return Camera.from_intrinsics(key["K"], Camera.look_at(*_look(key)).world_from_camera, resolution, "opengl")
    if "world_from_camera" in key:
        camera = Camera.from_intrinsics(np.eye(3), key["world_from_camera"], (1, 1), convention)
    else:
        camera = Camera.look_at(*_look(key))
    right, above = (float(shift) for shift in key.get("lens_shift", (0.0, 0.0)))
    camera = replace(
        camera,
        hfov=float(key.get("hfov", 65.0)),
        resolution=resolution,
        lens_shift=(right, above),
        pixel_aspect=float(key.get("pixel_aspect", 1.0)),
    )
    if "vfov" in key and "hfov" in key:
        raise ValueError("a keyframe has both hfov and vfov; leave one out")
    return camera.with_vfov(float(key["vfov"])) if "vfov" in key else camera


def _look(key: Mapping[str, Any]) -> tuple[Vec3, Vec3, Vec3]:
    """Return eye, target and up of a keyframe."""
    return _three(key["eye"]), _three(key["target"]), _three(key.get("up", (0, 1, 0)))


def _transforms(document: Mapping[str, Any], path: Path) -> CameraFile:
    """Return the cameras of a ``transforms.json``, a frame each; axes are OpenGL's, lengths the file's own."""
    cameras: list[Camera] = []
    sizes: list[tuple[int, int]] = []
    distorted: set[str] = set()
    if not document["frames"]:
        raise ValueError("expected frames, found none")
    for number, frame in enumerate(document["frames"]):
        values = {**document, **frame}
        model = values.get("camera_model", "OPENCV")
        if model not in PINHOLES or values.get("is_fisheye"):
            raise ValueError(f"frame {number} has a camera of the model {model}; expected one of {', '.join(PINHOLES)}")
        distorted |= {name for name in DISTORTION if values.get(name)}
        sizes.append((int(values.get("w", RESOLUTION[0])), int(values.get("h", RESOLUTION[1]))))
        if sizes[-1] != sizes[0]:
            (w, h), (width, height) = sizes[-1], sizes[0]
            raise ValueError(f"frame {number} is {w}x{h}, the first {width}x{height}; make a file for each size")
        cameras.append(_transforms_camera(values, sizes[0]))
    if distorted:
        names = ", ".join(sorted(distorted))
        warnings.warn(
            f"camera path {path}: lens distortion ({names}) is not modelled and left out; undistort the pictures to"
            " compare with",
            stacklevel=6,
        )
    return CameraFile(cameras)


def _transforms_camera(values: Mapping[str, Any], resolution: tuple[int, int]) -> Camera:
    width, height = resolution
    if "fl_x" in values:
        fx = float(values["fl_x"])
    elif "camera_angle_x" in values:
        fx = 0.5 * width / math.tan(float(values["camera_angle_x"]) / 2)
    else:
        raise KeyError("fl_x or camera_angle_x")
    fy = float(values.get("fl_y", fx))
    if "fl_y" not in values and "camera_angle_y" in values and "h" in values:
        fy = 0.5 * height / math.tan(float(values["camera_angle_y"]) / 2)
    K = [[fx, 0.0, float(values.get("cx", width / 2))], [0.0, fy, float(values.get("cy", height / 2))], [0.0, 0.0, 1.0]]
    return Camera.from_intrinsics(K, np.array(values["transform_matrix"], np.float64), resolution, "opengl")


def _three(values: Any) -> Vec3:
    x, y, z = (float(v) for v in values)
    return x, y, z
