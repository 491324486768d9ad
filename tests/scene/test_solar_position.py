"""The sun at a date and a place against almanacs, and the sky at dusk."""

import math
from dataclasses import replace
from datetime import date, datetime, timedelta, timezone

import numpy as np
import pytest

from warp_gi.cli import main as cli
from warp_gi.color import LUMINANCE
from warp_gi.errors import OptionError
from warp_gi.scene.sky import SunSky, _share_above, node_solid_angles
from warp_gi.scene.solar_position import refraction, solar_coordinates, sun_position

UTC = timezone.utc
TOLERANCE = 0.1  # degrees


def apart(a, b):
    return abs((a - b + 180.0) % 360.0 - 180.0)


@pytest.mark.parametrize(
    "when, ascension, declination",
    [
        # Meeus, Astronomical Algorithms, example 25.a: 13 October 1992, 0 h dynamical time
        (datetime(1992, 10, 12, 23, 59, 1, tzinfo=UTC), 198.38083, -7.78507),
        # equinoxes and solstices (USNO): the sun's right ascension is 0, 90, 180, 270 degrees then
        (datetime(2024, 3, 20, 3, 6, tzinfo=UTC), 0.0, 0.0),
        (datetime(2024, 6, 20, 20, 51, tzinfo=UTC), 90.0, 23.44),
        (datetime(2024, 9, 22, 12, 44, tzinfo=UTC), 180.0, 0.0),
        (datetime(2024, 12, 21, 9, 20, tzinfo=UTC), 270.0, -23.44),
    ],
)
def test_right_ascension_and_declination(when, ascension, declination):
    found = solar_coordinates(when)
    assert apart(found[0], ascension) < 0.01 and abs(found[1] - declination) < 0.01


def test_elevation_and_azimuth_of_the_reference_algorithm():
    """Reda and Andreas, "Solar Position Algorithm for Solar Radiation Applications" (NREL 2008), appendix A.5."""
    when = datetime(2003, 10, 17, 12, 30, 30, tzinfo=timezone(timedelta(hours=-7)))
    elevation, azimuth = sun_position(when, 39.742476, -105.1786)
    assert abs(elevation - 39.888378) < 0.01 and apart(azimuth, 194.340241) < 0.01


@pytest.mark.parametrize(
    "day, minutes",  # of the equation of time: apparent less mean time (Astronomical Almanac, its yearly extremes)
    [((2023, 2, 11), -14.23), ((2023, 5, 14), 3.65), ((2023, 7, 26), -6.54), ((2023, 11, 3), 16.46)],
)
def test_the_sun_is_in_the_south_at_noon_of_the_almanac(day, minutes):
    noon = datetime(*day, 12, tzinfo=UTC) - timedelta(minutes=minutes)
    _, azimuth = sun_position(noon, 51.4779, 0.0)
    assert apart(azimuth, 180.0) < TOLERANCE
    _, azimuth = sun_position(noon, -60.0, 0.0)  # and in the north from there
    assert apart(azimuth, 0.0) < TOLERANCE


def test_mornings_are_in_the_east_and_longitude_counts_eastwards():
    noon = datetime(2023, 3, 21, 12, tzinfo=UTC)
    elevation, azimuth = sun_position(noon, 10.0, -60.0)  # there it is 8 in the morning
    assert 80 < azimuth < 100 and 20 < elevation < 40
    assert sun_position(noon, 10.0, 60.0)[1] > 200


def test_refraction():
    """0.57 degrees at the horizon, 5.3' at 10 degrees (Meeus, chapter 16; 10 degrees C, 1010 mbar)."""
    assert refraction(0.0) == pytest.approx(0.48, abs=0.01)
    assert refraction(10.0) == pytest.approx(5.3 / 60, abs=0.003)
    assert refraction(90.0) == 0.0
    heights = np.linspace(-6.0, 90.0, 2000)
    assert (np.diff([h + refraction(h) for h in heights]) > 0).all()  # nothing is lifted past what is above it


def test_a_sky_of_a_date():
    when = datetime(2003, 10, 17, 12, 30, 30, tzinfo=timezone(timedelta(hours=-7)))
    sky = SunSky(date=when, latitude=39.742476, longitude=-105.1786)
    assert sky.elevation == pytest.approx(39.89, abs=TOLERANCE) and sky.azimuth == pytest.approx(194.34, abs=TOLERANCE)
    assert sky.direction[2] > 0.7  # -z is north, so the noon is at +z
    turned = replace(sky, north=90.0)
    assert np.allclose(turned.direction, [-sky.direction[2], sky.direction[1], sky.direction[0]])
    later = replace(sky, date=when + timedelta(hours=1))
    assert later.azimuth > sky.azimuth + 10
    same = datetime(2003, 10, 17, 19, 30, 30, tzinfo=UTC)
    assert np.array_equal(SunSky(date=same, latitude=39.742476, longitude=-105.1786).direction, sky.direction)


NOON = {"date": datetime(2024, 6, 1, 12, tzinfo=UTC), "latitude": 50.0, "longitude": 10.0}


@pytest.mark.parametrize(
    "settings, words",
    [
        (
            {"date": datetime(2024, 6, 1, 12)},
            r"must have a time zone, got 2024-06-01T12:00:00; for example 2024-06-01T",
        ),
        ({"latitude": None}, "needs a place; give latitude"),
        ({"longitude": None}, "needs a place; give longitude"),
        ({"latitude": 91.0}, "latitude must be between -90 and 90 degrees, got 91"),
        ({"longitude": math.nan}, "longitude must be between -180 and 180 degrees, got nan"),
        ({"elevation": 30.0}, "elevation follows from its date; leave one of the two out"),
        ({"date": None}, "go with a date"),
        ({"date": "2024-06-21"}, r"date must be a datetime.datetime with a time zone, got '2024-06-21'"),
        (
            {"date": date(2024, 6, 21)},
            r"must be a datetime.datetime with a time zone, got datetime.date\(2024, 6, 21\)",
        ),
        ({"latitude": "50"}, "latitude must be a number, got '50'"),
        ({"turbidity": "3"}, "turbidity must be a number, got '3'"),
        ({"ground_albedo": 0.2}, "ground_albedo must be three numbers"),
        ({"ground_albedo": ("a", 0, 0)}, "ground_albedo must be three numbers|ground_albedo must be a number"),
        ({"date": datetime(2024, 6, 1, 0, tzinfo=UTC)}, r"sun is 1\d.\d degrees below the horizon.* ends at 6"),
    ],
)
def test_dates_that_are_refused(settings, words):
    with pytest.raises(OptionError, match=words):
        SunSky(**(NOON | settings))


def illuminance(sky):
    """Return the luminance-weighted irradiance of the ground, from the pixels above the horizon."""
    pixels = sky.pixels() @ LUMINANCE
    rows = (sky.height + 1) // 2
    cosines = np.cos(np.arange(sky.height) * math.pi / (sky.height - 1))
    return float((pixels.sum(axis=1) * node_solid_angles(sky.height, 2 * sky.height) * cosines)[:rows].sum())


def test_dusk_dims_as_measured():
    """Light on the ground: 759 lx with the sun at the horizon, 3.4 lx at -6 degrees (Janiczek and DeYoung, table 4)."""
    ratio = illuminance(SunSky(elevation=-6.0, height=64)) / illuminance(
        SunSky(elevation=0.0, sun_intensity=0, height=64)
    )
    assert ratio == pytest.approx(3.41 / 759, rel=0.02)
    lights = [illuminance(SunSky(elevation=e, height=64)) for e in np.arange(2.0, -6.01, -0.25)]
    steps = np.array(lights[1:]) / lights[:-1]
    assert (steps < 1).all() and (steps > 0.7).all()  # darker from each to the next, and no jump


def test_the_sun_sets():
    red = [SunSky(elevation=e).sun_irradiance[0] for e in (0.27, 0.0, -0.2)]
    assert red[0] > 2 * red[1] > 4 * red[2] > 0  # half of the disc at 0, and more air before it
    y = np.linspace(-1, 1, 200_001)
    widths = np.sqrt(1 - y * y)
    for height in (-0.7, 0.0, 0.3):
        assert _share_above(height) == pytest.approx(widths[y > -height].sum() / widths.sum(), abs=1e-4)
    assert not SunSky(elevation=-0.3).sun_irradiance.any()
    pixels = SunSky(elevation=-3.0, azimuth=90.0, height=64).pixels()
    assert np.isfinite(pixels).all() and (pixels >= 0).all()
    horizon = pixels[30] @ LUMINANCE
    assert abs(int(horizon.argmax()) - 32) <= 1  # +x, a quarter of the way to the right: it glows where the sun set


def test_dates_of_the_command_line(tmp_path, capsys):
    command = ["cornell_box", "--environment", "sun-sky", "--sun.latitude", "50", "--sun.longitude", "10"]
    assert cli.main(["render", *command, "--sun.date", "2024-06-01T12:00"]) == 2
    assert "SunSky date must have a time zone" in capsys.readouterr().err
    assert cli.main(["render", "cornell_box", "--sun.latitude", "50", "--sun.date", "2024-06-01T12:00Z"]) == 2
    assert "longitude" in capsys.readouterr().err
    assert cli.main(["render", "cornell_box", "--sun.elevation", "50"]) == 2
    assert "go with --environment sun-sky" in capsys.readouterr().err
