"""Suns of skies: found where they stand, apart without a loss of light, and turned with the sky."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from warp_gi.errors import OptionError
from warp_gi.scene.environment import Environment, SunSky
from warp_gi.scene.sky import node_solid_angles
from warp_gi.scene.sun import MOST_SUNS

SCENES = Path(os.environ.get("WARP_GI_SCENES", Path(__file__).parents[2] / ".." / "shared" / "scenes"))


def direction(row, column, height):
    theta, phi = row * np.pi / (height - 1), (column + 0.5) * np.pi / height
    return np.array([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)])


def light_of(pixels):
    """Integral of radiance over the sphere, float64 [3]."""
    return np.einsum("ijc,i->c", pixels.astype(np.float64), node_solid_angles(*pixels.shape[:2]))


def noise(height=32, seed=0):
    return np.random.default_rng(seed).random((height, 2 * height, 3)).astype(np.float32)


def conserves(sky, split):
    whole = light_of(sky.pixels) * sky.scale
    kept = light_of(split.rest.pixels) * split.rest.scale + split.irradiances.sum(axis=0)
    return kept == pytest.approx(whole, rel=1e-12)


def test_one_texel_is_a_sun():
    pixels = noise()
    pixels[9, 20] = (900.0, 1000.0, 1500.0)
    sky = Environment(pixels=pixels, scale=2.0)
    split = sky.split_sun()
    assert split.directions == pytest.approx(direction(9, 20, 32)[None])
    assert conserves(sky, split)
    limit = 20 * sky.mean_radiance @ [0.2126, 0.7152, 0.0722] / 2.0
    rest = split.rest.pixels[9, 20]
    assert rest @ [0.2126, 0.7152, 0.0722] == pytest.approx(limit, rel=1e-5)
    assert rest / rest[0] == pytest.approx(pixels[9, 20] / 900.0)  # its colour stays
    assert split.irradiances[0] == pytest.approx(2.0 * (pixels[9, 20] - rest) * node_solid_angles(32, 64)[9], rel=1e-5)
    others = np.ones((32, 64), bool)
    others[9, 20] = False
    assert np.array_equal(split.rest.pixels[others], pixels[others])
    assert split.share == pytest.approx(split.irradiances[0, 1] / light_of(pixels * 2)[1], rel=0.1)
    assert np.arccos(split.cos_cones[0]) == pytest.approx(np.hypot(np.pi / 31, np.pi / 32))
    assert split.cos_cones[0] < split.cos_discs[0] < 1


def test_suns_turn_with_the_sky():
    pixels = noise()
    pixels[9, 20] = 1000.0
    sky = Environment(pixels=pixels)
    turned = sky.rotated(90.0).split_sun()
    x, y, z = direction(9, 20, 32)
    assert turned.directions == pytest.approx(np.array([[z, y, -x]]))
    assert turned.rest.rotation == 90.0 and turned.rest._map is sky.split_sun().rest._map
    expected = Environment(pixels=turned.rest.pixels, rotation=90.0).harmonics_of(5)
    assert np.array_equal(turned.rest.harmonics_of(5), expected)


def test_blobs_across_the_edge_and_at_poles():
    pixels = noise()
    pixels[[14, 14, 15], [0, 1, 63]] = 500.0  # across the edge, by a corner
    pixels[0, [3, 30, 50]] = 4e5  # one point, three texels
    pixels[1, 40] = 500.0  # touches that point
    pixels[31, 5] = 9e5
    sky = Environment(pixels=pixels)
    split = sky.split_sun(3.0)
    assert conserves(sky, split)
    towards = split.directions
    assert len(towards) == 3 and split.rest.pixels[1, 40, 0] < 100
    for wanted in (direction(0, 0, 32), direction(31, 0, 32)):
        assert (towards @ wanted).max() == pytest.approx(1.0, abs=1e-5)
    edge = sum(direction(r, c, 32) for r, c in ((14, 0), (14, 1), (15, 63)))
    assert (towards @ (edge / np.linalg.norm(edge))).max() == pytest.approx(1.0, abs=1e-5)
    assert (np.diff(split.irradiances @ [0.2126, 0.7152, 0.0722]) <= 0).all()


def test_cones_hold_their_suns():
    pixels, height = noise(64) * 0.01, 64
    rng = np.random.default_rng(3)
    pixels[20:27, 100:112] = 30.0 * rng.random((7, 12, 1)) + 10
    pixels[24, 105:118] = 30.0
    split = Environment(pixels=pixels).split_sun(10.0)
    assert len(split.directions) == 1
    removed = np.argwhere(pixels[..., 0] > split.rest.pixels[..., 0])
    d = np.array([direction(r, c, height) for r, c in removed])
    assert (d @ split.directions[0]).min() > split.cos_cones[0]
    assert np.arccos(split.cos_cones[0]) < np.arccos((d @ split.directions[0]).min()) + 0.08
    weights = (pixels - split.rest.pixels).astype(float)[..., 1][tuple(removed.T)] * node_solid_angles(64, 128)[
        removed[:, 0]
    ]
    spread = weights @ (1 - (d @ split.directions[0]) ** 2) / weights.sum()
    assert 1 - split.cos_discs[0] ** 2 == pytest.approx(2 * spread, rel=0.03)


@pytest.mark.parametrize("row", [4, 9, 15])
def test_a_texel_is_a_disc_of_its_own_width(row):
    """Its light falls to 0 at the next nodes; towards a pole these are nearer to each other along a row."""
    pixels = np.full((32, 64, 3), 1e-3, np.float32)
    pixels[row, 20] = 1000.0
    split = Environment(pixels=pixels).split_sun()
    steps = np.linspace(-1, 1, 201)
    down, right = np.meshgrid(steps, steps, indexing="ij")
    theta, phi = (row + down) * np.pi / 31, (20.5 + right) * np.pi / 32
    towards = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1)
    weights = (1 - abs(down)) * (1 - abs(right)) * np.sin(theta)
    spread = (weights * (1 - (towards @ split.directions[0]) ** 2)).sum() / weights.sum()
    assert 1 - split.cos_discs[0] ** 2 == pytest.approx(2 * spread, rel=0.03)


def test_blobs_of_any_shape_are_whole():
    """A spiral of one texel's width, and a ring around a texel that is not bright."""
    pixels = np.full((64, 128, 3), 1e-3, np.float32)
    turn = np.linspace(0, 8 * np.pi, 4000)
    pixels[(32 + 0.8 * turn * np.sin(turn)).astype(int), (60 + 0.8 * turn * np.cos(turn)).astype(int)] = 1.0
    pixels[5:8, 10:13] = 1.0
    pixels[6, 11] = 0.0
    split = Environment(pixels=pixels).split_sun(2.0)
    assert len(split.directions) == 2
    assert split.directions[1] @ direction(6, 11, 64) > 0.999


def test_only_the_brightest_leave():
    pixels = noise(64)
    for k in range(12):
        pixels[20 + 2 * (k % 3), 8 * k] = 1000.0 * (k + 1)
    pixels[40, 40] = 12.0
    sky = Environment(pixels=pixels)
    split = sky.split_sun()
    assert len(split.directions) == MOST_SUNS
    assert split.directions[0] == pytest.approx(direction(24, 88, 64))
    assert conserves(sky, split) and split.rest.pixels[20, 0, 0] == 1000.0
    assert len(sky.split_sun(most=3).directions) == 3
    assert len(sky.split_sun(most=0).directions) == 0 and sky.split_sun(most=0).rest is sky
    faint = noise(64)
    faint[40, 40] = 8.0  # bright, and holds nothing
    assert len(Environment(pixels=faint).split_sun(10.0).directions) == 0


def test_skies_of_a_few_lamps_are_told():
    pixels = noise(64)
    pixels[20, 30] = 1000.0
    assert Environment(pixels=pixels).split_sun().warning is None
    pixels[20, 30] = 1e5
    warning = Environment(pixels=pixels, name="studio").split_sun().warning
    assert warning.startswith("studio: 1 small lamps hold 9") and "\n" not in warning


def test_skies_without_a_sun():
    white = Environment(pixels=np.ones((16, 32, 3), np.float32))
    for sky in (
        Environment(),
        Environment.constant(2.0),
        white,
        Environment(pixels=np.zeros((16, 32, 3))),
        Environment(pixels=noise(), scale=0.0),
    ):
        split = sky.split_sun()
        assert split.rest is sky and split.directions.shape == (0, 3) and split.irradiances.shape == (0, 3)
        assert split.share == 0 and split.warning is None and split.cos_cones.shape == (0,)
    for wrong in ({"brighter_than": 1.0}, {"brighter_than": float("nan")}, {"most": -1}):
        with pytest.raises(OptionError, match="split_sun"):
            white.split_sun(**wrong)


def test_edited_skies_are_searched_again():
    pixels = noise()
    sky = Environment(pixels=pixels)
    sky.data("cpu")
    assert len(sky.split_sun().directions) == 0
    pixels[9, 20] = 1000.0
    assert len(sky.renewed().split_sun().directions) == 1


def test_the_sun_of_a_clear_sky():
    sun = SunSky(elevation=37.0, azimuth=200.0, height=256)
    split = Environment(pixels=sun.pixels(), rotation=25.0).split_sun()
    turn = np.radians(25.0)
    x, y, z = sun.direction
    expected = [np.cos(turn) * x + np.sin(turn) * z, y, -np.sin(turn) * x + np.cos(turn) * z]
    assert len(split.directions) == 1 and split.directions[0] @ expected > np.cos(np.radians(0.1))
    assert split.irradiances[0] == pytest.approx(sun.sun_irradiance, rel=0.05)
    assert np.degrees(np.arccos(split.cos_discs[0])) < 1.0


@pytest.mark.slow
def test_suns_of_real_skies():
    folder = SCENES / "environments"
    if not folder.is_dir():
        pytest.skip(f"{folder} is not there; set WARP_GI_SCENES")
    shares = {}
    for path in sorted(folder.glob("*.exr")):
        sky = Environment.load(path)
        split = sky.split_sun()
        assert conserves(sky, split)
        assert split.rest.pixels.min() >= 0
        shares[path.stem] = split.share
        assert (split.warning is not None) == (path.stem == "studio")
    assert shares["city"] == pytest.approx(0.22, abs=0.01) and shares["courtyard"] == pytest.approx(0.03, abs=0.01)
