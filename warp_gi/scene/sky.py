"""A clear sky with a sun, by the closed formulas of Preetham, Shirley and Smits,
"A Practical Analytic Model for Daylight" (SIGGRAPH 1999), as a latitude-longitude map.

They end with the sun at the horizon. Below it, the sky of the horizon dims as the light on the ground does in Janiczek
and DeYoung, "Computer Programs for Sun and Moon Illuminance" (USNO Circular 171, 1987), without a change of color.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime

import numpy as np

from warp_gi.color import RGB_FROM_XYZ
from warp_gi.errors import OptionError, check_number
from warp_gi.scene.model import Color
from warp_gi.scene.solar_position import sun_position

EFFICACY = 179.0  # lm/W that turns luminance into the radiance of an RGB channel (equal-energy white)
SUN_ILLUMINANCE = 133_300.0  # lx outside the atmosphere
SUN_TEMPERATURE = 5778.0  # K
SUN_RADIUS = 0.265  # degrees, as it is, to tell how much of it has set
LOWEST_SUN = -6.0  # degrees: the end of civil twilight
# Janiczek and DeYoung: log10 of lx on the ground as a cubic in the sun's elevation / 90 degrees, rising powers; of the
# elevations from -0.8 to -5 degrees, and from there to -12.
TWILIGHT = ((-5.0, (2.88, 21.81, -258.11, -858.36)), (-12.0, (2.70, 12.17, -431.69, -1899.83)))
# Preetham et al., appendix A.2: A to E of each channel's distribution, linear in turbidity ...
DISTRIBUTION = {
    "Y": np.array(
        [[0.1787, -1.4630], [-0.3554, 0.4275], [-0.0227, 5.3251], [0.1206, -2.5771], [-0.0670, 0.3703]],
    ),
    "x": np.array(
        [[-0.0193, -0.2592], [-0.0665, 0.0008], [-0.0004, 0.2125], [-0.0641, -0.8989], [-0.0033, 0.0452]],
    ),
    "y": np.array(
        [[-0.0167, -0.2608], [-0.0950, 0.0092], [-0.0079, 0.2102], [-0.0441, -1.6537], [-0.0109, 0.0529]],
    ),
}
# ... and the chromaticity of the zenith: rows in turbidity^2, turbidity, 1; columns in the sun's angle cubed to 1.
ZENITH = {
    "x": np.array(
        [
            [0.00166, -0.00375, 0.00209, 0.0],
            [-0.02903, 0.06377, -0.03202, 0.00394],
            [0.11693, -0.21196, 0.06052, 0.25886],
        ]
    ),
    "y": np.array(
        [
            [0.00275, -0.00610, 0.00317, 0.0],
            [-0.04214, 0.08970, -0.04153, 0.00516],
            [0.15346, -0.26756, 0.06670, 0.26688],
        ]
    ),
}


class _OfDate(float):
    """An angle that follows from a date, so that ``dataclasses.replace`` may compute it again."""


@dataclass(frozen=True)
class SunSky:
    """A clear sky and its sun over a Lambertian ground, at given angles or at a date and place on earth.

    Raises OptionError for numbers out of range, a date without a time zone or without a place, a place or angles that
    the date makes senseless, and for a sun below -6 degrees.
    """

    elevation: float = 45.0
    """Angle of the sun above the horizon, degrees in [-6, 90]. Below 0 the sky dims to dusk. A date sets it."""
    azimuth: float = 0.0
    """Angle of the sun in degrees, clockwise seen from above, as on a compass: 0 is -z, 90 is +x. A date sets it."""
    turbidity: float = 3.0
    """Haze of the air, from 1.7 to 10: 2 is very clear, 6 is hazy."""
    ground_albedo: Color = (0.2, 0.2, 0.2)
    """Diffuse reflectance of the ground, which fills the lower half."""
    intensity: float = 0.01
    """Factor on the physical radiance (a clear noon is near 500 W/m^2 a channel); 0.01 suits an exposure of 1."""
    sun_intensity: float = 1.0
    """Factor on the radiance of the sun alone; 0 leaves it out."""
    sun_diameter: float = 0.53
    """Apparent diameter of the sun in degrees. A larger one softens shadows and keeps the light's amount."""
    height: int = 512
    """Number of rows of the map; columns are twice as many. The sun is blurred by about one texel, 180 / height
    degrees."""
    date: datetime | None = None
    """Time, with a time zone, at which the sun stands where it does at a place; elevation and azimuth follow."""
    latitude: float | None = None
    """Latitude of the place in degrees, positive north of the equator; goes with a date."""
    longitude: float | None = None
    """Longitude of the place in degrees, positive east of Greenwich; goes with a date."""
    north: float = 0.0
    """Angle of north in degrees, clockwise seen from above: 0 is -z, 90 is +x; goes with a date."""

    def __post_init__(self) -> None:
        self._follow_date()
        for name, low, high in (
            ("elevation", LOWEST_SUN, 90.0),
            ("azimuth", -3600.0, 3600.0),
            ("turbidity", 1.7, 10.0),
            ("intensity", 0.0, math.inf),
            ("sun_intensity", 0.0, math.inf),
            ("sun_diameter", 0.0, 20.0),
            ("height", 16, 4096),
        ):
            value = getattr(self, name)
            check_number(f"SunSky {name}", value)
            if not (low <= value <= high and math.isfinite(value)):
                raise OptionError(f"SunSky {name} must be between {low} and {high}, got {value}")
        if np.shape(self.ground_albedo) != (3,):
            raise OptionError(f"SunSky ground_albedo must be three numbers between 0 and 1, got {self.ground_albedo!r}")
        for albedo in self.ground_albedo:
            check_number("SunSky ground_albedo", albedo)
        if not all(0 <= a <= 1 for a in self.ground_albedo):
            raise OptionError(f"SunSky ground_albedo must be three numbers between 0 and 1, got {self.ground_albedo}")

    def _follow_date(self) -> None:
        """Set elevation and azimuth to where the sun stands, if there is a date."""
        if self.date is None:
            if self.latitude is not None or self.longitude is not None or self.north:
                raise OptionError("SunSky latitude, longitude and north go with a date; give date too")
            return
        if not isinstance(self.date, datetime):
            raise OptionError(
                f"SunSky date must be a datetime.datetime with a time zone, got {self.date!r:.80}; for example"
                " datetime(2024, 6, 21, 12, tzinfo=timezone.utc)"
            )
        if self.date.tzinfo is None or self.date.utcoffset() is None:
            raise OptionError(
                f"SunSky date must have a time zone, got {self.date.isoformat()}; for example"
                f" {self.date.isoformat()}+02:00, or tzinfo=timezone.utc"
            )
        for name, most in (("latitude", 90.0), ("longitude", 180.0), ("north", 360.0)):
            value = getattr(self, name)
            if value is None:
                raise OptionError(f"SunSky date needs a place; give {name} in degrees too")
            check_number(f"SunSky {name}", value)
            if not -most <= value <= most:
                raise OptionError(f"SunSky {name} must be between {-most:g} and {most:g} degrees, got {value}")
        for name in ("elevation", "azimuth"):
            value = getattr(self, name)
            if value != SunSky.__dataclass_fields__[name].default and not isinstance(value, _OfDate):
                raise OptionError(f"SunSky {name} follows from its date; leave one of the two out")
        assert self.latitude is not None and self.longitude is not None
        elevation, azimuth = sun_position(self.date, self.latitude, self.longitude)
        if elevation < LOWEST_SUN:
            raise OptionError(
                f"SunSky: at {self.date.isoformat()} the sun is {-elevation:.1f} degrees below the horizon, and this"
                f" sky ends at {-LOWEST_SUN:g}; take another time, or Environment.constant for the night"
            )
        object.__setattr__(self, "elevation", _OfDate(elevation))
        object.__setattr__(self, "azimuth", _OfDate((azimuth + self.north) % 360.0))

    @staticmethod
    def towards(direction: tuple[float, float, float], **settings: float) -> SunSky:
        """Return a SunSky whose sun stands in a direction (x, y, z), y up; ``settings`` are the other fields."""
        x, y, z = direction
        if not any(direction):
            raise OptionError(f"SunSky: the direction of the sun must not be zero, got {direction}")
        elevation = math.degrees(math.atan2(y, math.hypot(x, z)))
        return SunSky(elevation=elevation, azimuth=math.degrees(math.atan2(x, -z)) % 360.0, **settings)  # type: ignore[arg-type]

    @property
    def direction(self) -> np.ndarray:
        """Unit direction towards the sun, float64 [3]."""
        return _direction(self.elevation, self.azimuth)

    @property
    def sun_irradiance(self) -> np.ndarray:
        """Irradiance of a surface that faces the sun, by what has not set of it, W/m^2 a channel, float64 [3]."""
        scale = self.intensity * self.sun_intensity / EFFICACY * _share_above(self.elevation / SUN_RADIUS)
        return np.maximum(RGB_FROM_XYZ @ _sun_xyz(self._sun_theta, self.turbidity), 0) * scale

    @property
    def _sun_theta(self) -> float:
        """Angle of the sun from the zenith in radians, at most to the horizon, where the formulas end."""
        return math.radians(90 - max(self.elevation, 0.0))

    def pixels(self) -> np.ndarray:
        """Return float32 [height, 2 * height, 3] radiance, oriented as ``Environment`` says."""
        height, width = self.height, 2 * self.height
        theta = np.arange(height) * (math.pi / (height - 1))
        phi = (np.arange(width) + 0.5) * (2 * math.pi / width)
        sky_rows = (height + 1) // 2
        cos_theta, sin_theta = np.cos(theta[:sky_rows, None]), np.sin(theta[:sky_rows, None])
        sun = _direction(max(self.elevation, 0.0), self.azimuth)
        cos_gamma = sin_theta * (np.sin(phi) * sun[0] - np.cos(phi) * sun[2]) + cos_theta * sun[1]
        sky = _preetham(cos_theta, cos_gamma, self._sun_theta, self.turbidity) * _dusk(self.elevation)
        pixels = np.zeros((height, width, 3))
        pixels[:sky_rows] = np.maximum(sky @ RGB_FROM_XYZ.T, 0) * (self.intensity * 1000.0 / EFFICACY)
        areas = node_solid_angles(height, width)
        horizontal = np.einsum("ijc,i->c", pixels[:sky_rows], (areas * np.cos(theta))[:sky_rows])
        horizontal += self.sun_irradiance * sun[1]
        pixels[sky_rows:] = np.array(self.ground_albedo) / math.pi * horizontal
        self._add_sun(pixels, areas)
        return pixels.astype(np.float32)

    def _add_sun(self, pixels: np.ndarray, areas: np.ndarray) -> None:
        """Spread the sun's irradiance over the nodes around its disc, so that the bilinear map holds all of it."""
        height, width = pixels.shape[:2]
        samples = (np.arange(32) + 0.5) / 32
        radius, turn = np.meshgrid(np.sqrt(samples), 2 * math.pi * samples, indexing="ij")
        radius = radius.ravel() * math.radians(self.sun_diameter / 2)
        axis = self.direction
        side = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 0.0, 1.0])
        side /= np.linalg.norm(side)
        across = np.cos(turn.ravel())[:, None] * side + np.sin(turn.ravel())[:, None] * np.cross(axis, side)
        points = np.cos(radius)[:, None] * axis + np.sin(radius)[:, None] * across
        points = points[points[:, 1] >= 0]
        if not len(points) or not self.sun_irradiance.any():
            return
        x = np.arctan2(points[:, 0], -points[:, 2]) / (2 * math.pi) % 1.0 * width - 0.5
        y = np.arccos(np.clip(points[:, 1], -1, 1)) / math.pi * (height - 1)
        column, row = np.floor(x).astype(int), np.minimum(y.astype(int), height - 2)
        s, t = x - column, y - row
        flux = np.zeros((height, width))
        for i, j, weight in ((0, 0, (1 - s) * (1 - t)), (0, 1, s * (1 - t)), (1, 0, (1 - s) * t), (1, 1, s * t)):
            np.add.at(flux, (row + i, (column + j) % width), weight)
        pixels += (flux / len(points) / areas[:, None])[..., None] * self.sun_irradiance


def node_solid_angles(height: int, width: int) -> np.ndarray:
    """Return float64 [height]: the integral over the sphere of a node's bilinear weight, sr, a row."""
    step = math.pi / (height - 1)
    result = np.sin(np.arange(height) * step) * (2 * (1 - math.cos(step)) / step)
    result[[0, -1]] = 1 - math.sin(step) / step
    return result * (2 * math.pi / width)


def _direction(elevation: float, azimuth: float) -> np.ndarray:
    """Return the unit vector of angles in degrees, float64 [3]."""
    up, turn = math.radians(elevation), math.radians(azimuth)
    return np.array([math.cos(up) * math.sin(turn), math.sin(up), -math.cos(up) * math.cos(turn)])


def _share_above(height: float) -> float:
    """Return the share of a unit disc that is above a line, whose middle is at ``height`` above it."""
    h = min(max(height, -1.0), 1.0)
    return 0.5 + (math.asin(h) + h * math.sqrt(1 - h * h)) / math.pi


def _dusk(elevation: float) -> float:
    """Return the light of the sky with the sun at an elevation in degrees, over that with it at the horizon."""
    if elevation >= 0:
        return 1.0
    terms = next(terms for lowest, terms in TWILIGHT if elevation >= lowest)
    return 10.0 ** (np.polynomial.Polynomial(terms)(elevation / 90.0) - TWILIGHT[0][1][0])


def _preetham(cos_theta: np.ndarray, cos_gamma: np.ndarray, sun_theta: float, turbidity: float) -> np.ndarray:
    """Return XYZ [..., 3] in kcd/m^2 of the sky, cos_theta >= 0 (Preetham et al., appendix A.2)."""
    coefficients = {name: DISTRIBUTION[name] @ [turbidity, 1.0] for name in DISTRIBUTION}
    chi = (4 / 9 - turbidity / 120) * (math.pi - 2 * sun_theta)
    zenith = {"Y": (4.0453 * turbidity - 4.9710) * math.tan(chi) - 0.2155 * turbidity + 2.4192}
    for name, matrix in ZENITH.items():
        zenith[name] = turbidity ** np.array([2, 1, 0]) @ matrix @ sun_theta ** np.array([3, 2, 1, 0])
    cos_theta = np.maximum(cos_theta, 0.01)  # the formula's pole at the horizon
    cos_gamma = np.clip(cos_gamma, -1.0, 1.0)
    gamma = np.arccos(cos_gamma)

    def perez(c: np.ndarray, cos_t: np.ndarray | float, g: np.ndarray | float) -> np.ndarray:
        return (1 + c[0] * np.exp(c[1] / cos_t)) * (1 + c[2] * np.exp(c[3] * g) + c[4] * np.cos(g) ** 2)

    value = {k: zenith[k] * perez(c, cos_theta, gamma) / perez(c, 1.0, sun_theta) for k, c in coefficients.items()}
    luminance = np.maximum(value["Y"], 0.0)
    x, y = value["x"], value["y"]
    return np.stack([x / y * luminance, luminance, (1 - x - y) / y * luminance], axis=-1)


def _sun_xyz(sun_theta: float, turbidity: float) -> np.ndarray:
    """Return XYZ [3] in lx of a surface facing the sun: black body through air and haze (appendix A.1, no ozone)."""
    micrometres = np.arange(0.38, 0.7801, 0.005)
    black_body = micrometres**-5.0 / np.expm1(14387.77 / (micrometres * SUN_TEMPERATURE))
    air_mass = 1 / (math.cos(sun_theta) + 0.15 * (93.885 - math.degrees(sun_theta)) ** -1.253)
    beta = 0.04608365822050 * turbidity - 0.04586025928522
    rayleigh = np.exp(-0.008735 * micrometres**-4.08 * air_mass)
    haze = np.exp(-beta * micrometres**-1.3 * air_mass)
    matching = _color_matching(micrometres * 1000)
    scale = SUN_ILLUMINANCE / (matching[1] @ black_body)
    return matching @ (black_body * rayleigh * haze) * scale


def _color_matching(nanometres: np.ndarray) -> np.ndarray:
    """Return [3, n]: CIE 1931 matching functions (Wyman, Sloan and Shirley, JCGT 2013, multi-lobe fit)."""

    def lobe(peak: float, centre: float, left: float, right: float) -> np.ndarray:
        d = (nanometres - centre) * np.where(nanometres < centre, left, right)
        return peak * np.exp(-0.5 * d * d)

    return np.stack(
        [
            lobe(0.362, 442.0, 0.0624, 0.0374)
            + lobe(1.056, 599.8, 0.0264, 0.0323)
            + lobe(-0.065, 501.1, 0.0490, 0.0382),
            lobe(0.821, 568.8, 0.0213, 0.0247) + lobe(0.286, 530.9, 0.0613, 0.0322),
            lobe(1.217, 437.0, 0.0845, 0.0278) + lobe(0.681, 459.0, 0.0385, 0.0725),
        ]
    )
