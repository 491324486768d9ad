"""Perspective (pinhole) and orthographic cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import warp as wp

from warp_gi.errors import FARTHEST, OptionError, check_number, unknown_name
from warp_gi.kernels import gbuffer

Vector = Sequence[float] | np.ndarray
"""Three numbers, for a position or a direction."""

CONVENTIONS = {"opencv": (1.0, -1.0, -1.0, 1.0), "opengl": (1.0, 1.0, 1.0, 1.0)}
"""Factors on the axes of a camera's space that make it x right, y up, z backward."""
MOST_LEAN = 0.01
"""Largest cosine between two axes of a placement, which may be rounded to a few digits."""

LEAST_FOV, MOST_FOV = 1e-3, 179.9999
"""Degrees of a field of view outside which neighbouring pixels have the same float32 direction."""
LARGEST_SIDE = 1 << 16  # pixels; their Morton code has 16 bits an axis
LARGEST_COUNT = 1 << 30  # pixels; kernels count them in int32


@dataclass(frozen=True, eq=False)
class Camera:
    """A perspective (pinhole) or orthographic camera. It looks along -z of its own space, x is right and y up.

    It has no depth of field and no lens distortion. Raises OptionError for a field of view that is not between
    0.001 and 180 degrees, an empty resolution, or a matrix that is singular, reflected or not finite.
    """

    world_from_camera: np.ndarray
    """Placement, float64 [4, 4], acting on column vectors; its axes are made orthonormal."""
    hfov: float = 65.0
    """Horizontal field of view in degrees; of no meaning in an orthographic camera."""
    resolution: tuple[int, int] = (960, 540)
    """Width and height in pixels."""
    name: str = ""
    """Name in messages and reports."""
    lens_shift: tuple[float, float] = (0.0, 0.0)
    """By how much the middle of the picture is right of the view axis, in widths, and above it, in heights."""
    pixel_aspect: float = 1.0
    """Width of a pixel by its height: the focal length in pixels downwards by that across."""
    keeps_vertical: bool = False
    """Whether the vertical field of view, and not the horizontal one, stays at another resolution."""
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Point in metres of a file's coordinates that ``world_from_camera`` counts from: that of a recentred scene."""
    ortho_width: float = 0.0
    """Width in metres of what an orthographic camera shows; 0 is a perspective camera. See ``orthographic``."""

    def __post_init__(self) -> None:
        try:
            matrix = np.array(self.world_from_camera, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise OptionError(
                f"camera {self.name!r}: world_from_camera must be a 4x4 matrix of numbers,"
                f" got {self.world_from_camera!r:.80}"
            ) from error
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise OptionError(
                f"camera {self.name!r}: world_from_camera must be a finite 4x4 matrix, got {matrix.tolist()!r:.120}"
            )
        # whatever the scale of an axis: a power of 2, which changes no digit
        matrix[:3, :3] = np.ldexp(matrix[:3, :3], -np.frexp(np.abs(matrix[:3, :3]).max(axis=0))[1])
        if abs(np.linalg.det(matrix[:3, :3])) < 1e-12:
            raise OptionError(f"camera {self.name!r}: world_from_camera is singular; give three independent axes")
        check_last_row(matrix, self.name)
        if np.linalg.det(matrix[:3, :3]) < 0:
            raise OptionError(
                f"camera {self.name!r}: world_from_camera is a reflection (its determinant is negative), which no"
                " camera is; negate one of its axes, or say which convention it follows (Camera.from_intrinsics)"
            )
        z = matrix[:3, 2] / np.linalg.norm(matrix[:3, 2])
        y = matrix[:3, 1] - z * (matrix[:3, 1] @ z)
        y /= np.linalg.norm(y)
        matrix[:3, :3] = np.stack([np.cross(y, z), y, z], axis=1)
        object.__setattr__(self, "world_from_camera", matrix)
        check_number(f"camera {self.name!r}: hfov", self.hfov)
        check_number(f"camera {self.name!r}: pixel_aspect", self.pixel_aspect)
        if not LEAST_FOV <= self.hfov <= MOST_FOV:
            raise OptionError(
                f"camera {self.name!r}: hfov must be from {LEAST_FOV:g} to {MOST_FOV:.4f} degrees, got {self.hfov}"
            )
        if not np.abs(matrix[:3, 3]).max() <= FARTHEST:
            raise OptionError(
                f"camera {self.name!r}: its position must be within {FARTHEST:g} m, got {matrix[:3, 3].tolist()}"
            )
        if not (self.pixel_aspect > 0 and math.isfinite(self.pixel_aspect)):
            raise OptionError(f"camera {self.name!r}: pixel_aspect must be finite and above 0, got {self.pixel_aspect}")
        check_number(f"camera {self.name!r}: ortho_width", self.ortho_width)
        if not 0 <= self.ortho_width <= FARTHEST:
            raise OptionError(
                f"camera {self.name!r}: ortho_width must be from 0 to {FARTHEST:g} m, got {self.ortho_width}"
            )
        if np.shape(self.lens_shift) != (2,):
            raise OptionError(f"camera {self.name!r}: lens_shift must be two finite numbers, got {self.lens_shift!r}")
        for shift in self.lens_shift:
            check_number(f"camera {self.name!r}: lens_shift", shift)
        if not all(math.isfinite(shift) for shift in self.lens_shift):
            raise OptionError(f"camera {self.name!r}: lens_shift must be two finite numbers, got {self.lens_shift}")
        object.__setattr__(self, "resolution", checked_resolution(self.resolution))

    def __eq__(self, other: object) -> bool:
        """Return whether another camera makes the same pictures, whatever its name."""
        return self._key == other._key if isinstance(other, Camera) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._key)

    @property
    def _key(self) -> tuple[object, ...]:
        return (self.world_from_camera + 0.0).tobytes(), self.lens, self.keeps_vertical, self.offset  # no -0

    @classmethod
    def look_at(
        cls,
        eye: Vector,
        target: Vector,
        up: Vector = (0.0, 1.0, 0.0),
        hfov: float | None = None,
        resolution: tuple[int, int] = (960, 540),
        name: str = "",
        *,
        vfov: float | None = None,
        lens_shift: tuple[float, float] = (0.0, 0.0),
    ) -> Camera:
        """Return a camera at ``eye`` [m] that looks at ``target`` [m].

        ``hfov`` is the horizontal field of view in degrees, 65 by default. ``vfov`` is the vertical one, in place of
        it, and stays at another resolution. Raises OptionError if eye and target coincide, ``up`` is along the view, or
        both fields of view are given.
        """
        if hfov is not None and vfov is not None:
            raise OptionError(f"camera {name!r}: has both hfov and vfov; leave one out")
        camera = cls(_look_at_matrix(eye, target, up), 65.0 if hfov is None else hfov, resolution, name, lens_shift)
        return camera if vfov is None else camera.with_vfov(vfov)

    @classmethod
    def orthographic(
        cls,
        eye: Vector,
        target: Vector,
        up: Vector = (0.0, 1.0, 0.0),
        width: float = 2.0,
        resolution: tuple[int, int] = (960, 540),
        name: str = "",
    ) -> Camera:
        """Return an orthographic camera, whose rays are parallel.

        It shows ``width`` [m] across, and as much downwards as the resolution says. ``eye`` [m] and ``target`` [m] are
        in the middle of the picture; what is behind the plane through ``eye`` is not seen. Raises OptionError as
        ``look_at``, and for a width that is not above 0.
        """
        check_number(f"camera {name!r}: width", width)
        if not width > 0:
            raise OptionError(f"camera {name!r}: width of an orthographic camera must be above 0 m, got {width}")
        return cls(_look_at_matrix(eye, target, up), resolution=resolution, name=name, ortho_width=width)

    @classmethod
    def from_intrinsics(
        cls,
        K: Sequence[Sequence[float]] | np.ndarray,
        world_from_camera: Sequence[Sequence[float]] | np.ndarray,
        resolution: tuple[int, int],
        convention: Literal["opencv", "opengl"] = "opencv",
        name: str = "",
    ) -> Camera:
        """Return a calibrated camera.

        Args:
            K: ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`` in pixels; (0, 0) is the top left corner of the picture, y goes
                down (COLMAP, nerfstudio). Where (0, 0) is the middle of the first pixel (``cv2.calibrateCamera``), add
                0.5 to cx and cy.
            world_from_camera: Placement, [4, 4] or [3, 4], acting on column vectors; the inverse of "extrinsics".
            resolution: Width and height in pixels that K is for.
            convention: Axes of the camera's space: "opencv" is x right, y down, z forward, "opengl" x right, y up,
                z backward, as in Blender and glTF.
            name: Name in messages and reports.

        Raises OptionError for a K of another form, a skewed one among them, an unknown convention, or a matrix that
        cannot be a placement. Lens distortion is not modelled: undistort the pictures first.
        """
        matrix = np.array(K, np.float64)
        form = "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"
        if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
            raise OptionError(f"camera {name!r}: K must be {form}, finite, got {np.asarray(K).tolist()}")
        (fx, skew, cx), (low, fy, cy), last = matrix
        if abs(skew) > 1e-9 * abs(fx) or low or not np.array_equal(last, (0.0, 0.0, 1.0)) or fx <= 0 or fy <= 0:
            raise OptionError(f"camera {name!r}: K must be {form} with fx and fy above 0, got {matrix.tolist()}")
        if convention not in CONVENTIONS:
            raise unknown_name("camera convention", convention, CONVENTIONS)
        placement = np.eye(4)
        given = np.asarray(world_from_camera, np.float64)
        if given.shape not in ((4, 4), (3, 4)):
            raise OptionError(f"camera {name!r}: world_from_camera must be 4x4 or 3x4, got shape {given.shape}")
        placement[: len(given)] = given
        check_last_row(placement, name)
        check_axes(placement[:3, :3], name)
        width, height = resolution
        if max(fx, fy, abs(cx), abs(cy)) < 4.0 and min(width, height) >= 16:
            raise OptionError(
                f"camera {name!r}: K must be in pixels of {width}x{height}, got {matrix.tolist()}; multiply its"
                " first row by the width and its second by the height if it counts in pictures"
            )
        hfov = 2 * math.degrees(math.atan(0.5 * width / fx))
        shift = (float(0.5 - cx / width), float(cy / height - 0.5))
        axes = np.diag(CONVENTIONS[convention])
        return cls(placement @ axes, hfov, resolution, name, shift, float(fy / fx))

    def with_vfov(self, vfov: float) -> Camera:
        """Return the same camera with a vertical field of view in degrees, which stays at another resolution."""
        if self.is_orthographic:
            raise OptionError(f"camera {self.name!r} is orthographic: it has a width in metres, and no field of view")
        if not 0.0 < vfov < 180.0:
            raise OptionError(f"camera {self.name!r}: vfov must be between 0 and 180 degrees, got {vfov}")
        width, height = self.resolution
        half = math.tan(math.radians(vfov) / 2) * self.pixel_aspect * width / height
        return replace(self, hfov=2 * math.degrees(math.atan(half)), keeps_vertical=True)

    def at_resolution(self, width: int, height: int) -> Camera:
        """Return the same camera with another resolution; see ``keeps_vertical`` for another shape."""
        width, height = checked_resolution((width, height))
        camera = replace(self, resolution=(width, height))
        is_alike = width * self.resolution[1] == height * self.resolution[0]
        is_kept = is_alike or not self.keeps_vertical or self.is_orthographic
        return camera if is_kept else camera.with_vfov(self.vfov)

    @property
    def is_orthographic(self) -> bool:
        """Whether the camera's rays are parallel."""
        return self.ortho_width > 0

    @property
    def vfov(self) -> float:
        """Vertical field of view in degrees; of no meaning in an orthographic camera."""
        return 2 * math.degrees(math.atan(self.half_size[1])) if not self.is_orthographic else self.hfov

    @property
    def intrinsics(self) -> np.ndarray:
        """``K`` of ``from_intrinsics``, float64 [3, 3]: focal lengths and principal point in pixels.

        Of an orthographic camera it has pixels a metre in place of focal lengths.
        """
        (width, height), (across, up), (right, above) = self.resolution, self.half_size, self.lens_shift
        fx, fy = 0.5 * width / across, 0.5 * height / up
        return np.array([[fx, 0.0, (0.5 - right) * width], [0.0, fy, (0.5 + above) * height], [0.0, 0.0, 1.0]])

    @property
    def lens(self) -> tuple[object, ...]:
        """All that decides a picture beside the placement, to compare cameras by."""
        return self.hfov, self.resolution, self.lens_shift, self.pixel_aspect, self.ortho_width

    @property
    def footprint(self) -> float:
        """Longer side of a pixel in metres, at 1 m along the view axis; at any distance of an orthographic camera."""
        return 2.0 * self.half_size[0] / self.resolution[0] * max(1.0, 1.0 / self.pixel_aspect)

    @property
    def half_size(self) -> tuple[float, float]:
        """Half the width and half the height in metres of what is seen at 1 m along the view axis."""
        width, height = self.resolution
        half = self.ortho_width / 2 if self.is_orthographic else math.tan(math.radians(self.hfov) / 2)
        return half, half * height / width / self.pixel_aspect

    def relative_to(self, offset: Vector) -> Camera:
        """Return the same camera, counted from another point of the file's coordinates (as of ``Scene.offset``)."""
        if np.array_equal(self.offset, offset):
            return self
        moved = np.array(self.world_from_camera)
        moved[:3, 3] += np.subtract(self.offset, offset)
        return replace(self, world_from_camera=moved, offset=(float(offset[0]), float(offset[1]), float(offset[2])))

    @property
    def position(self) -> np.ndarray:
        """Position of the eye in metres, counted from ``offset``; float64 [3]."""
        return self.world_from_camera[:3, 3]

    def directions(self, pixels: np.ndarray) -> np.ndarray:
        """Return unit vectors float64 [n, 3] from the camera through pixel coordinates [n, 2], as of ``project``."""
        (fx, _, cx), (_, fy, cy), _ = self.intrinsics
        x, y = np.moveaxis((np.asarray(pixels, dtype=np.float64) - (cx, cy)) / (fx, fy), -1, 0)
        if self.is_orthographic:
            x, y = np.zeros_like(x), np.zeros_like(y)
        ways = np.stack([x, -y, np.full_like(x, -1.0)], axis=-1) @ self.world_from_camera[:3, :3].T
        return ways / np.linalg.norm(ways, axis=-1, keepdims=True)

    def origins(self, pixels: np.ndarray) -> np.ndarray:
        """Return where rays through pixel coordinates [n, 2] begin, float64 [n, 3]: all at the eye, or on its plane."""
        (fx, _, cx), (_, fy, cy), _ = self.intrinsics
        x, y = np.moveaxis((np.asarray(pixels, dtype=np.float64) - (cx, cy)) / (fx, fy), -1, 0)
        local = np.stack([x, -y, np.zeros_like(x)], axis=-1) * self.is_orthographic
        return self.position + local @ self.world_from_camera[:3, :3].T

    def project(self, points: np.ndarray) -> np.ndarray:
        """Return pixel coordinates float64 [n, 2] of ``points`` [n, 3]; (0, 0) is the top left corner."""
        local = (np.asarray(points, dtype=np.float64) - self.position) @ self.world_from_camera[:3, :3]
        (fx, _, cx), (_, fy, cy), _ = self.intrinsics
        depth = np.ones((len(local), 1)) if self.is_orthographic else -local[:, 2:]
        return local[:, :2] / depth * [fx, -fy] + np.array([cx, cy])


def checked_resolution(resolution: object) -> tuple[int, int]:
    """Return width and height in pixels; raises OptionError for what is no resolution, and for too many pixels."""
    try:
        width, height = (int(size) for size in resolution)  # type: ignore[attr-defined]
    except (TypeError, ValueError, OverflowError) as error:
        raise OptionError(f"resolution must be (width, height), got {resolution!r:.80}") from error
    if width < 1 or height < 1:
        raise OptionError(f"resolution must be at least 1x1, got {width:.6g}x{height:.6g}")
    if max(width, height) > LARGEST_SIDE or width * height > LARGEST_COUNT:
        sizes = "x".join(f"{str(size)[:9]}{'...' * (size >= 10**9)}" for size in (width, height))
        raise OptionError(f"resolution must be at most {LARGEST_SIDE} a side and {LARGEST_COUNT:,} pixels, got {sizes}")
    return width, height


def check_last_row(matrix: np.ndarray, name: str) -> None:
    """Raise OptionError unless ``matrix`` [4, 4] acts on column vectors, and is no projection."""
    if np.isfinite(matrix).all() and not np.array_equal(matrix[3], (0.0, 0.0, 0.0, 1.0)):
        raise OptionError(
            f"camera {name!r}: the last row of world_from_camera must be 0 0 0 1, got {matrix[3].tolist()};"
            " transpose a matrix that acts on row vectors"
        )


def check_axes(axes: np.ndarray, name: str) -> None:
    """Raise OptionError unless the columns of ``axes`` [3, 3] are perpendicular, as those of a placement are."""
    lengths = np.linalg.norm(axes, axis=0)
    units = axes / np.where(lengths > 0.0, lengths, 1.0)  # an axis of no length is an error of the camera
    if np.abs(units.T @ units - np.diag(np.diag(units.T @ units))).max() > MOST_LEAN:
        raise OptionError(f"camera {name!r}: world_from_camera is sheared: its axes must be perpendicular")


def offset_text(offset: Vector) -> str:
    """Return an offset as files say it: three numbers that read back to the last bit."""
    return " ".join(f"{value:.0f}" if float(value).is_integer() else repr(float(value)) for value in offset)


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
    right, up, back = camera.world_from_camera[:3, :3].T
    width, height = camera.resolution
    half, half_height = camera.half_size
    data = gbuffer.CameraData()
    data.position = wp.vec3(*camera.position)
    data.right = wp.vec3(*(right * half))
    data.up = wp.vec3(*(up * half_height))
    data.forward = wp.vec3(*-back)
    data.spread = 0.0 if camera.is_orthographic else 1.0
    data.center = wp.vec2(*(2.0 * shift for shift in camera.lens_shift))
    data.width, data.height = width, height
    return data
