"""Pinhole cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import warp as wp

from warp_gi.errors import OptionError
from warp_gi.kernels import gbuffer

Vector = Sequence[float] | np.ndarray
"""Three numbers, for a position or a direction."""

LARGEST_SIDE = 1 << 16  # pixels; their Morton code has 16 bits an axis
LARGEST_COUNT = 1 << 30  # pixels; kernels count them in int32


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera. It looks along -z of its own space, x is right and y up in the picture.

    Raises OptionError for a field of view outside (0, 180) degrees, an empty
    resolution, or a matrix that is singular or not finite.
    """

    world_from_camera: np.ndarray
    """Placement, float64 [4, 4], acting on column vectors; its axes are made orthonormal."""
    hfov: float = 65.0
    """Horizontal field of view in degrees."""
    resolution: tuple[int, int] = (960, 540)
    """Width and height in pixels."""
    name: str = ""
    """Name in messages and reports."""
    keeps_vertical: bool = False
    """Whether a picture of another shape keeps the vertical field of view, as a glTF camera without an aspect ratio
    asks; else it keeps the horizontal one."""

    def __post_init__(self) -> None:
        matrix = np.array(self.world_from_camera, dtype=np.float64)
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise OptionError(f"camera {self.name!r}: world_from_camera must be a finite 4x4 matrix, got {matrix}")
        if abs(np.linalg.det(matrix[:3, :3])) < 1e-12:
            raise OptionError(f"camera {self.name!r}: world_from_camera is singular; give three independent axes")
        z = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
        y = matrix[:3, 1] - z * (matrix[:3, 1] @ z)
        y /= np.linalg.norm(y)
        matrix[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
        object.__setattr__(self, "world_from_camera", matrix)
        if not 0.0 < self.hfov < 180.0:
            raise OptionError(f"camera {self.name!r}: hfov must be between 0 and 180 degrees, got {self.hfov}")
        try:
            width, height = (int(size) for size in self.resolution)
        except (TypeError, ValueError) as error:
            raise OptionError(f"resolution must be (width, height), got {self.resolution!r}") from error
        if width < 1 or height < 1:
            raise OptionError(f"resolution must be at least 1x1, got {width}x{height}")
        if max(width, height) > LARGEST_SIDE or width * height > LARGEST_COUNT:
            raise OptionError(
                f"resolution must be at most {LARGEST_SIDE} a side and {LARGEST_COUNT:,} pixels, got {width}x{height}"
            )
        object.__setattr__(self, "resolution", (width, height))

    @classmethod
    def look_at(
        cls,
        eye: Vector,
        target: Vector,
        up: Vector = (0.0, 1.0, 0.0),
        hfov: float = 65.0,
        resolution: tuple[int, int] = (960, 540),
        name: str = "",
    ) -> Camera:
        """Return a camera at ``eye`` [m] that looks at ``target`` [m].

        Raises OptionError if eye and target coincide or ``up`` is along the view.
        """
        return cls(_look_at_matrix(eye, target, up), hfov, resolution, name)

    def at_resolution(self, width: int, height: int) -> Camera:
        """Return the same camera with another resolution; see ``keeps_vertical`` for another shape."""
        hfov, (old_width, old_height) = self.hfov, self.resolution
        if self.keeps_vertical and width > 0 and height > 0 and width * old_height != height * old_width:
            half = math.tan(math.radians(hfov) / 2) * old_height / old_width
            hfov = math.degrees(2 * math.atan(half * width / height))
        return replace(self, resolution=(width, height), hfov=hfov)

    @property
    def position(self) -> np.ndarray:
        """Position of the eye in metres, float64 [3]."""
        return self.world_from_camera[:3, 3]

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Return unit vectors float64 [n, 3] from the camera through pixel coordinates [n, 2], as of ``project``."""
        width, height = self.resolution
        scale = 2 * math.tan(math.radians(self.hfov) / 2) / width
        x, y = np.moveaxis((np.asarray(pixels, dtype=np.float64) - (0.5 * width, 0.5 * height)) * scale, -1, 0)
        ways = np.stack([x, -y, np.full_like(x, -1.0)], axis=-1) @ self.world_from_camera[:3, :3].T
        return ways / np.linalg.norm(ways, axis=-1, keepdims=True)

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return pixel coordinates float64 [n, 2] of world ``points`` [n, 3]; (0, 0) is the top left corner."""
        local = (np.asarray(points, dtype=np.float64) - self.position) @ self.world_from_camera[:3, :3]
        width, height = self.resolution
        scale = 0.5 * width / math.tan(math.radians(self.hfov) / 2)
        xy = local[:, :2] / -local[:, 2:] * [scale, -scale]
        return xy + np.array([0.5 * width, 0.5 * height])


def _look_at_matrix(*given: Vector) -> np.ndarray:
    """Return world_from_camera of an eye, a target and a way up, float64 [4, 4]."""
    eye, target, up = (np.asarray(v, dtype=np.float64) for v in given)
    if eye.shape != (3,) or target.shape != (3,) or up.shape != (3,):
        raise OptionError("eye, target and up must be three numbers each")
    back = eye - target
    right = np.cross(up, back)
    if not np.linalg.norm(back) > 0 or not np.linalg.norm(right) > 1e-9 * np.linalg.norm(back) * np.linalg.norm(up):
        raise OptionError(f"camera at {eye.tolist()} cannot look at {target.tolist()} with up {up.tolist()}")
    back /= np.linalg.norm(back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    matrix[:3, 3] = eye
    return matrix


def camera_data(camera: Camera) -> gbuffer.CameraData:
    """Return the camera as kernels read it."""
    width, height = camera.resolution
    right, up, back = camera.world_from_camera[:3, :3].T
    half = math.tan(math.radians(camera.hfov) / 2)
    data = gbuffer.CameraData()
    data.position = wp.vec3(*camera.position)
    data.right = wp.vec3(*(right * half))
    data.up = wp.vec3(*(up * half * height / width))
    data.forward = wp.vec3(*-back)
    data.width, data.height = width, height
    return data
