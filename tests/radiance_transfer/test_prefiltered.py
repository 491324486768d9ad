"""Skies prefiltered by roughness: against exact integrals of the lobe, and where to read them."""

from __future__ import annotations

import numpy as np
import pytest

from warp_gi.launch import get_device
from warp_gi.scene.environment import Environment
from warp_gi.scene.harmonics import basis, by_coefficient
from warp_gi.techniques.radiance_transfer.lobes import COLUMNS, ROUGHNESSES, ggx_directions
from warp_gi.techniques.radiance_transfer.prefiltered import (
    LEVELS,
    ROWS,
    level_factors,
    level_roughnesses,
    prefiltered,
    sky_lookups,
)


def random_directions(count, seed=1):
    d = np.random.default_rng(seed).standard_normal((count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def map_directions(height):
    v, u = np.meshgrid(np.arange(height) / (height - 1), (np.arange(2 * height) + 0.5) / (2 * height), indexing="ij")
    theta, phi = np.pi * v, 2 * np.pi * u
    return np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1)


def radiance(d):
    """A sky with a horizon, a bright blob of 0.2 rad and a smooth tint; never negative."""
    blob = np.exp(-((np.arccos(np.clip(d @ [0.6, 0.64, 0.48], -1, 1)) / 0.2) ** 2))
    level = 1 / (1 + np.exp(-12 * d[..., 1]))
    return np.stack([level + 8 * blob, level * (1.2 + d[..., 0]) + 6 * blob, 0.5 + 0 * blob], axis=-1)


def reflected(roughness, cosines, normals, sides):
    """int L f cos / int f cos, float64 [cosines, normals, 3], for views in the plane of normal and side."""
    wi, weights, _ = ggx_directions(roughness, cosines, 48, 48)
    across = np.cross(normals, sides)
    frames = np.stack([sides, across, normals], axis=1)
    rows = []
    for k in range(len(cosines)):
        light = sum(np.einsum("n,mnc->mc", weights[k], radiance(wi[k] * [1, s, 1] @ frames)) for s in (1, -1))
        rows.append(light / 2 / weights[k].sum())
    return np.array(rows)


def frames(count):
    normals = random_directions(count)
    sides = np.cross(normals, random_directions(count, seed=2))
    return normals, sides / np.linalg.norm(sides, axis=1, keepdims=True)


SKY = Environment(pixels=radiance(map_directions(128)).astype(np.float32))


def test_a_sky_of_few_harmonics_is_filtered_exactly():
    coefficients = np.random.default_rng(3).normal(size=(3, 25)) * 0.1
    coefficients[:, 0] = 6.0
    sky = Environment(pixels=(basis(map_directions(256), 5) @ coefficients.T).astype(np.float32))
    found = prefiltered(sky)
    assert found.levels.shape == (LEVELS, ROWS, 2 * ROWS, 3) and found.levels.dtype == np.float32
    factors = level_factors(5)
    assert factors[:, 0] == pytest.approx(1) and (np.diff(factors[:, 1:], axis=0) < 0).all()
    for k in range(LEVELS):
        expected = basis(map_directions(ROWS), 5) @ (coefficients * by_coefficient(factors[k])).T
        assert np.abs(found.levels[k] - expected).max() < 3e-3


def test_levels_are_integrals_of_the_lobe():
    """Seen along the normal, where the lobe is zonal and levels are exact but for their texels."""
    normals, sides = frames(60)
    found = prefiltered(SKY)
    assert found.levels.min() > 0
    for level in (0, 3, 7, LEVELS - 1):
        expected = reflected(level_roughnesses()[level], np.ones(1), normals, sides)[0]
        error = np.sqrt(((found.at(normals, level) - expected) ** 2).mean()) / expected.mean()
        assert error < (0.02 if level == 0 else 0.008)
    between = found.at(normals, 3.25)
    assert between == pytest.approx(0.75 * found.at(normals, 3) + 0.25 * found.at(normals, 4))


def test_lookups_are_near_to_the_lobe_from_all_views():
    table = sky_lookups()
    assert table.shape == (ROUGHNESSES, COLUMNS, 3) and table.dtype == np.float32
    assert np.hypot(table[..., 0], table[..., 1]) == pytest.approx(1, abs=1e-6)
    assert table[..., 2].min() >= 0 and table[..., 2].max() == LEVELS - 1
    normals, sides = frames(60)
    found = prefiltered(SKY)
    cosines = ((1 - np.linspace(0, 1, COLUMNS) ** 2) ** 2)[[0, 3, 6, 9, 12, 14]]
    for row, most in ((6, 0.2), (9, 0.13), (15, 0.06)):  # roughnesses 0.52, 0.68, 1
        expected = reflected(0.2 + 0.8 * row / 15, cosines, normals, sides)
        errors, mirrored = [], []
        for k, column in enumerate((0, 3, 6, 9, 12, 14)):
            sine, cosine, level = table[row, column].astype(float)
            errors.append(found.at(sine * sides + cosine * normals, level) - expected[k])
            along = cosines[k] * normals - np.sqrt(1 - cosines[k] ** 2) * sides
            mirrored.append(
                found.at(along, (np.log(0.2 + 0.8 * row / 15) / np.log(0.2) - 1) * (1 - LEVELS)) - expected[k]
            )
        error, other = (np.sqrt((np.array(e) ** 2).mean()) / expected.mean() for e in (errors, mirrored))
        assert error < most and error < 0.6 * other


def test_skies_are_filtered_once():
    assert prefiltered(SKY.rotated(40.0)) is prefiltered(SKY)
    assert prefiltered(Environment(SKY.pixels, None, 3.0, 2.0, "sky", SKY._map)) is prefiltered(SKY)
    texels = prefiltered(SKY).on(get_device("cpu"))
    assert texels is prefiltered(SKY).on(get_device("cpu")) and texels.shape == (LEVELS * ROWS * 2 * ROWS,)
    assert np.array_equal(texels.numpy().reshape(prefiltered(SKY).levels.shape), prefiltered(SKY).levels)
    again = prefiltered(Environment(pixels=SKY.pixels.copy()))
    assert np.array_equal(again.levels, prefiltered(SKY).levels)


def test_skies_of_one_colour_stay_as_they_are():
    white = prefiltered(Environment(pixels=np.ones((64, 128, 3), np.float32)))
    assert np.abs(white.levels - 1).max() < 1e-4
    assert (prefiltered(Environment.constant((1.0, 2.0, 3.0))).levels == [1.0, 2.0, 3.0]).all()
    assert not prefiltered(Environment()).levels.any()
    assert not prefiltered(Environment(pixels=np.zeros((16, 32, 3)))).levels.any()


def test_a_sun_does_not_ring_below_zero():
    pixels = SKY.pixels.copy()
    pixels[30, 40] = 1e5
    assert prefiltered(Environment(pixels=pixels)).levels.min() >= 0
    rest = Environment(pixels=pixels).split_sun().rest
    assert prefiltered(rest).levels[4:].min() > 0
