"""The light from infinitely far away: a latitude-longitude map, a constant colour, or an analytic sky.

Orientation: a direction (x, y, z) in the sky's own space (y up) lies at
``u = fract(atan2(x, -z) / 2 pi)``, ``v = acos(y) / pi``. So the left edge of a map looks along -z, a quarter
of the way right is +x, the middle +z, three quarters -x; the top row is the zenith, the bottom row the nadir.
Texel (row i, column j) is a node at ``u = (j + 0.5) / width``, ``v = i / (height - 1)``; between nodes radiance
is bilinear. This is Mitsuba 3's ``envmap`` with an identity ``to_world``.

``rotation`` is in degrees about +y by the right-hand rule: a positive one turns the sky counter-clockwise seen
from above (what was along -z moves towards -x). It is Mitsuba's ``to_world = rotate([0, 1, 0], rotation)``.
"""

from __future__ import annotations

import hashlib
import math
import warnings
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
import warp as wp

from warp_gi.errors import OptionError, SceneError
from warp_gi.kernels import types
from warp_gi.launch import get_device
from warp_gi.scene import harmonics
from warp_gi.scene.files.sky_images import check_size, read_sky, split_layer
from warp_gi.scene.model import Color
from warp_gi.scene.sky import SunSky
from warp_gi.scene.sky_map import SkyMap, SunTables
from warp_gi.scene.sun import LAMPS_SHARE, MOST_SUNS

T = TypeVar("T")

__all__ = ["Environment", "SunSky", "SunSplit", "as_environment"]

LARGEST_RADIANCE = 1e30  # W/(m^2 sr); past it products of what kernels compute with leave float32
NEGLIGIBLE_NEGATIVE = 1e-4  # share of the sum of all pixels; less is set to 0


@dataclass(eq=False, repr=False)
class Environment:
    """A sky: a latitude-longitude map, a constant colour, or (neither given) black."""

    pixels: np.ndarray | None = None
    """Radiance map in W/(m^2 sr), float32 [height, width, 3] with width = 2 height, row 0 at the zenith."""
    color: Color | None = None
    """Constant radiance in W/(m^2 sr), RGB; in place of a map."""
    rotation: float = 0.0
    """Angle in degrees about +y; a positive one turns the sky counter-clockwise seen from above."""
    scale: float = 1.0
    """Factor on the radiance."""
    name: str = "environment"
    """Name in error messages."""
    _map: SkyMap | None = field(default=None, repr=False)

    def __repr__(self) -> str:
        shape = None if self.pixels is None else np.shape(self.pixels)
        light = f"color {self.color}" if shape is None else f"{shape[1]} x {shape[0]} pixels"
        return f"<Environment {self.name!r}: {light}, rotation {self.rotation:g}, scale {self.scale:g}>"

    def __post_init__(self) -> None:
        if self.pixels is not None and self.color is not None:
            raise SceneError("environment: give pixels or a color, not both")
        if not math.isfinite(self.rotation):
            raise SceneError(f"environment rotation must be a finite number of degrees, got {self.rotation}")
        if not (math.isfinite(self.scale) and self.scale >= 0):
            raise SceneError(f"environment scale must be finite and not negative, got {self.scale}")
        if self.color is not None:
            self.color = _checked_color(self.color)
            self._check_range(max(self.color))
        if self.pixels is not None and self._map is None:
            self.pixels = _checked_pixels(self.pixels, self.name)
            self._map = SkyMap(self.pixels)
        if self.pixels is not None and self.scale > 1.0:
            self._check_range(float(self.pixels.max()))

    def _check_range(self, peak: float) -> None:
        if not peak * self.scale <= LARGEST_RADIANCE:
            raise SceneError(
                f"{self.name}: radiance must be at most {LARGEST_RADIANCE:g} W/(m^2 sr), which kernels can compute"
                f" with, got {peak:g} times a scale of {self.scale:g}"
            )

    @staticmethod
    def load(path: str | Path, rotation: float = 0.0, scale: float = 1.0, layer: str = "") -> Environment:
        """Read a 2:1 latitude-longitude image (EXR, HDR or what else OpenImageIO reads; integers as sRGB).

        ``layer`` is a part or a layer of an EXR file by name; "FILE:layer" as ``path`` says the same. Without it the
        one is read that has colors, or is the beauty; see ``files.sky_images.read_sky`` for all that is converted.

        Raises SceneError if the file is missing or damaged, deep, not 2:1, or has NaN or infinite pixels; and one
        that lists the layers if none of that name is there, or it is not clear which one is meant.
        Negative pixels, which resampling filters and other primaries leave, are set to 0; with a warning if they
        matter.
        """
        file, named = split_layer(path)
        pixels = read_sky(file, layer or named)
        name = f"environment {str(path)!r}"
        if pixels.min() < 0:
            if -pixels[pixels < 0].sum() > NEGLIGIBLE_NEGATIVE * np.abs(pixels).sum():
                count = int((pixels < 0).any(-1).sum())
                warnings.warn(
                    f"{name}: {count} pixels are negative (lowest {pixels.min():.3g}); set to 0", stacklevel=2
                )
            pixels = np.maximum(pixels, 0)
        return Environment(pixels=pixels, rotation=rotation, scale=scale, name=name)

    @staticmethod
    def constant(rgb: Sequence[float] | np.ndarray | float) -> Environment:
        """Return a sky of one radiance, RGB or grey, in W/(m^2 sr)."""
        return Environment(color=_checked_color(rgb))

    @property
    def is_black(self) -> bool:
        """Whether it emits nothing."""
        return not self.mean_radiance.any()

    @property
    def mean_radiance(self) -> np.ndarray:
        """Radiance averaged over the sphere, W/(m^2 sr), float64 [3]."""
        if self._map is not None:
            return self._map.mean * self.scale
        return np.array(self.color or (0.0, 0.0, 0.0)) * self.scale

    @property
    def harmonics(self) -> np.ndarray:
        """Low frequencies of the sky in world space, W/(m^2 sr), float64 [3, 9]; a row each for red, green, blue.

        Ordered as in ``kernels/harmonics.py``. Beside a sharp bright sun they swing below zero, as a sum of
        nine smooth functions must.
        """
        return self.harmonics_of(3)

    def harmonics_of(self, order: int) -> np.ndarray:
        """Return the spherical harmonics of the sky in world space, W/(m^2 sr), float64 [3, order^2].

        A map is projected once; another rotation or scale of it costs about 0.2 ms.
        """
        if self._map is None:
            result = np.zeros((3, order * order))
            result[:, 0] = self.mean_radiance * math.sqrt(4 * math.pi)
            return result
        return harmonics.rotate(self._map.harmonics_of(order), self.world_from_environment) * self.scale

    def split_sun(self, brighter_than: float = 20.0, most: int = MOST_SUNS) -> SunSplit:
        """Return the suns of this sky and the rest of it; a constant sky has none.

        A map is searched once; another rotation or scale of it costs next to nothing, and so do the rest's harmonics.

        Args:
            brighter_than: A sun is brighter than so many times the sky's mean (by luminance), and is cut off there.
            most: Largest number of suns; the brightest are taken, if they hold a share of ``sun.LEAST_SHARE`` each.

        Raises:
            OptionError: for numbers out of range.
        """
        if not (math.isfinite(brighter_than) and brighter_than > 1):
            raise OptionError(f"split_sun: brighter_than must be a number above 1, got {brighter_than}")
        if most < 0:
            raise OptionError(f"split_sun: most must not be negative, got {most}")
        if self._map is None or self.scale == 0:
            return SunSplit(self, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0), 0.0)
        parts, rest = self._map.split(brighter_than, most)
        directions = parts.directions @ self.world_from_environment.T
        sky = self
        if rest is not self._map:
            sky = Environment(rest.pixels, None, self.rotation, self.scale, self.name, rest)
        irradiances = parts.irradiances * self.scale
        return SunSplit(sky, directions, irradiances, parts.cos_cones, parts.cos_discs, parts.share)

    @property
    def has_small_suns(self) -> bool:
        """Whether there are suns that are worth a ray of their own."""
        return self._map is not None and not self.is_black and bool(self._map.small_suns()[0].nodes)

    def small_suns(self, device: wp.Device) -> tuple[SunTables, Environment] | None:
        """Return the suns that are worth a ray of their own, and the sky without them; None if there are none.

        A map is searched once, and its tables are made once a device: rotations and scales share them.
        """
        tables = None if self._map is None or self.is_black else self._map.sun_tables(device)
        if tables is None:
            return None
        return tables, Environment(tables.rest.pixels, None, self.rotation, self.scale, self.name, tables.rest)

    def once_a_map(self, key: Hashable, make: Callable[[np.ndarray], T]) -> T | None:
        """Return ``make(pixels)``, computed once for all rotations and scales of a map; None for a sky without one.

        ``make`` sees the map in its own space and unscaled. ``key`` tells apart what different callers derive.
        """
        return None if self._map is None else self._map.once(key, make)

    @property
    def content_hash(self) -> str:
        """Hexadecimal SHA-256 of all that determines the radiance."""
        digest = hashlib.sha256(b"environment")
        digest.update(np.array([math.fmod(self.rotation, 360.0), self.scale]).tobytes())
        digest.update(self._map.digest if self._map else np.array(self.color or (0.0, 0.0, 0.0)).tobytes())
        return digest.hexdigest()

    @property
    def appearance(self) -> tuple[object, ...]:
        """Values that determine the radiance to the last bit; equal for skies that look the same."""
        return self.rotation, self.scale, self.color, self._map and self._map.digest

    def rotated(self, degrees: float) -> Environment:
        """Return this sky turned about +y by ``degrees``, counter-clockwise seen from above; pixels are shared."""
        rotation = self.rotation + degrees
        return Environment(self.pixels, self.color, rotation, self.scale, self.name, self._map)

    def renewed(self) -> Environment:
        """Return this sky itself; what was derived from its pixels is forgotten if they were edited since."""
        if self._map is not None and (self.pixels is not self._map.pixels or self._map.is_edited()):
            self.pixels = _checked_pixels(self.pixels, self.name)
            self._map = SkyMap(self.pixels)
        return self

    @property
    def world_from_environment(self) -> np.ndarray:
        """Rotation of the sky's own directions into world space, float64 [3, 3]."""
        angle = math.radians(self.rotation)
        c, s = math.cos(angle), math.sin(angle)
        return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])

    def data(self, device: str | wp.Device | None = None) -> types.Environment:
        """Return the ``kernels.types.Environment`` struct on the device; its arrays are made once a device."""
        target = device if isinstance(device, wp.Device) else get_device(device)
        result = types.Environment()
        result.environment_from_world = wp.mat33(*self.world_from_environment.T.ravel())
        if self.is_black:
            result.kind = types.ENVIRONMENT_NONE
        elif self._map is None:
            result.kind = types.ENVIRONMENT_CONSTANT
            result.radiance = wp.vec3(*self.mean_radiance)
        else:
            result.kind = types.ENVIRONMENT_MAP
            result.radiance = wp.vec3(self.scale, self.scale, self.scale)
            result.height, result.width = self._map.pixels.shape[:2]
            arrays = self._map.on(target)
            result.texels, result.alias, result.row_pdfs = arrays
        return result


@dataclass(frozen=True, eq=False)
class SunSplit:
    """A sky in two parts, which add up to the whole: its suns, and the rest."""

    rest: Environment
    """The sky without its suns; the sky itself where there are none."""
    directions: np.ndarray
    """Unit directions towards the suns in world space, brightest first, float64 [suns, 3]."""
    irradiances: np.ndarray
    """Irradiance of a surface that faces a sun, W/m^2, float64 [suns, 3]: the integral of what left the map."""
    cos_cones: np.ndarray
    """Cosines of the half-angles of cones that hold all light of each sun, float64 [suns]."""
    cos_discs: np.ndarray
    """Cosines of the half-angles of even discs as wide as each sun (of the same second moment), float64 [suns]."""
    share: float
    """Share of the sky's light (luminance, from all directions) that the suns hold."""

    @property
    def warning(self) -> str | None:
        """One line for those to whom the rest is what counts, where the suns hold most of the light; else None."""
        if self.share <= LAMPS_SHARE:
            return None
        return (
            f"{self.rest.name}: {len(self.directions)} small lamps hold {self.share:.0%} of this sky's light;"
            " as spherical harmonics it is a poor likeness, and is better traced"
        )


Sky = Environment | SunSky | str | Path | float | Sequence[float] | np.ndarray | None
"""What a scene takes for a sky: one made before, a path to a map, a radiance (RGB or grey), or None for black."""


def as_environment(value: Sky) -> Environment:
    """Return an Environment from a path, an RGB triple, a grey number, a SunSky, an Environment, or None (black).

    Raises SceneError for anything else, and what ``Environment.load`` raises.
    """
    if value is None:
        return Environment()
    if isinstance(value, Environment):
        return value.renewed()
    if isinstance(value, SunSky):
        return Environment(pixels=value.pixels(), name="sun and sky")
    if isinstance(value, str | Path):
        return Environment.load(value)
    return Environment.constant(value)


def _checked_color(rgb: object) -> Color:
    try:
        color = np.array(rgb, np.float64)
        if color.ndim == 0:
            color = np.repeat(color, 3)
    except (TypeError, ValueError):
        color = np.zeros(0)
    if color.shape != (3,) or not np.isfinite(color).all() or (color < 0).any():
        got = f"an array of shape {color.shape}" if color.ndim > 1 else repr(rgb)[:100]
        raise SceneError(
            f"environment must be a file, an RGB triple of finite numbers of at least 0, or SunSky(...), got {got}"
        )
    return tuple(color.tolist())


def _checked_pixels(pixels: object, name: str) -> np.ndarray:
    pixels = np.ascontiguousarray(np.asarray(pixels, np.float32))
    if pixels.ndim != 3 or pixels.shape[2] != 3:
        raise SceneError(f"{name}: expected pixels of shape [height, 2 * height, 3], got {list(pixels.shape)}")
    height, width = pixels.shape[:2]
    check_size(name, width, height)
    if not np.isfinite(pixels).all():
        bad = int((~np.isfinite(pixels).all(-1)).sum())
        raise SceneError(f"{name}: {bad} pixels are NaN or infinite; repair the image")
    if pixels.max() > LARGEST_RADIANCE:
        raise SceneError(f"{name}: radiance must be at most {LARGEST_RADIANCE:g}, highest is {pixels.max():.3g}")
    if pixels.min() < 0:
        raise SceneError(f"{name}: radiance must not be negative, lowest is {pixels.min():.3g}")
    return pixels
