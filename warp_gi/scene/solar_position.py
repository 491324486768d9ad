"""Where the sun stands at a time and a place on earth.

Low accuracy formulas of J. Meeus, "Astronomical Algorithms" (2nd edition, chapters 12, 13, 22 and 25), as the solar
calculator of NOAA uses them: within 0.02 degrees from 1950 to 2050.
"""

from __future__ import annotations

import math
from datetime import datetime, timezone

J2000 = datetime(2000, 1, 1, 12, tzinfo=timezone.utc)
LEAP_SECONDS = 69.2  # terrestrial time less universal time since 2017; the sun moves 0.0008 degrees in them


def solar_coordinates(when: datetime) -> tuple[float, float]:
    """Return the sun's apparent right ascension and declination in degrees; ``when`` has a time zone."""
    centuries = _days(when, LEAP_SECONDS) / 36525
    mean_longitude = 280.46646 + centuries * (36000.76983 + 0.0003032 * centuries)
    anomaly = math.radians(357.52911 + centuries * (35999.05029 - 0.0001537 * centuries))
    centre = (
        (1.914602 - centuries * (0.004817 + 0.000014 * centuries)) * math.sin(anomaly)
        + (0.019993 - 0.000101 * centuries) * math.sin(2 * anomaly)
        + 0.000289 * math.sin(3 * anomaly)
    )
    node = math.radians(125.04 - 1934.136 * centuries)
    longitude = math.radians(mean_longitude + centre - 0.00569 - 0.00478 * math.sin(node))
    obliquity = math.radians(23.4392911 - 0.0130042 * centuries + 0.00256 * math.cos(node))
    ascension = math.atan2(math.cos(obliquity) * math.sin(longitude), math.cos(longitude))
    declination = math.asin(math.sin(obliquity) * math.sin(longitude))
    return math.degrees(ascension) % 360.0, math.degrees(declination)


def sun_position(when: datetime, latitude: float, longitude: float) -> tuple[float, float]:
    """Return the sun's elevation and azimuth in degrees, as seen through the air; azimuth is clockwise from north.

    Args:
        when: A time with a time zone.
        latitude: Degrees north of the equator.
        longitude: Degrees east of Greenwich.
    """
    ascension, declination = (math.radians(angle) for angle in solar_coordinates(when))
    sidereal = 280.46061837 + 360.98564736629 * _days(when)
    hour_angle = math.radians(sidereal + longitude) - ascension
    phi = math.radians(latitude)
    up = math.sin(phi) * math.sin(declination) + math.cos(phi) * math.cos(declination) * math.cos(hour_angle)
    south = math.cos(hour_angle) * math.sin(phi) * math.cos(declination) - math.sin(declination) * math.cos(phi)
    west = math.sin(hour_angle) * math.cos(declination)
    elevation = math.degrees(math.atan2(up, math.hypot(south, west)))
    azimuth = math.degrees(math.atan2(west, south)) + 180.0
    return elevation + refraction(elevation), azimuth % 360.0


def refraction(elevation: float) -> float:
    """Return by how many degrees the air at sea level lifts what stands at a true elevation (as NOAA computes it)."""
    if elevation > 85.0:
        return 0.0
    tangent = math.tan(math.radians(elevation))
    if elevation > 5.0:
        seconds = 58.1 / tangent - 0.07 / tangent**3 + 0.000086 / tangent**5
    elif elevation > -0.575:
        seconds = 1735.0 + elevation * (-518.2 + elevation * (103.4 + elevation * (-12.79 + elevation * 0.711)))
    else:
        seconds = -20.774 / tangent
    return seconds / 3600.0


def _days(when: datetime, seconds: float = 0.0) -> float:
    """Return days since noon of 1 January 2000 (UTC), and ``seconds`` more."""
    return ((when - J2000).total_seconds() + seconds) / 86400.0
