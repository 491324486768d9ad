"""Light of a sky through polygons: against closed forms, quadrature, and the sky that the other techniques see."""

import numpy as np
import pytest
from polygon_tools import circle_about, city, closed_form, integrate, quadrature, unit
from statistics_tools import every_device  # noqa: F401

import warp_gi as gi
from warp_gi.techniques.visibility_polygons.sky import EXACT_COLUMNS, row_areas, sky_tables

WHITE = gi.Environment(pixels=np.ones((32, 64, 3), np.float32))
EVALUATORS = ("adaptive", "exact")


def bitten(count, kind, bulge, seed):
    """Horizons of which a part was pushed inwards at random, and their normals; ``bulge`` is below the horizon."""
    rng = np.random.default_rng(seed)
    polygons, normals = [], []
    for _ in range(count):
        normal = unit(rng.normal(size=3))
        if kind == "wall":
            normal = unit(normal * (1, 0, 1))
        elif kind == "nearly a wall":
            normal = unit((normal[0], rng.uniform(-0.01, 0.01), normal[2]))
        points = circle_about(normal, np.pi / 2 + bulge, rng.integers(20, 40), rng.uniform(0, 6))
        chosen = (rng.integers(len(points)) + np.arange(rng.integers(len(points) // 2))) % len(points)
        points[chosen] = unit(points[chosen] + normal * rng.uniform(0, 1, (len(chosen), 1)))
        polygons.append([points])
        normals.append(normal)
    return polygons, np.array(normals)


@pytest.mark.parametrize("bulge", [0.0, np.radians(1.0)], ids=["", "bulging"])
@pytest.mark.parametrize("kind", ["any", "wall", "nearly a wall"])
def test_a_white_sky_as_closed_form(kind, bulge):
    """Polygons about poles and over the seam: a map of 1 everywhere is the closed form of a constant sky."""
    polygons, normals = bitten(1500, kind, bulge, 1)
    truth = np.array([closed_form(*one) for one in zip(polygons, normals, strict=True)])
    constant = integrate(gi.Environment.constant(1.0), polygons, normals)
    np.testing.assert_allclose(constant, truth[:, None].repeat(3, 1), atol=1e-5 * np.pi)
    adaptive = integrate(WHITE, polygons, normals)[:, 0] - truth
    assert np.abs(adaptive).max() < 0.005 * np.pi and np.sqrt(np.mean(adaptive**2)) < 0.001 * np.pi
    exact = integrate(WHITE, polygons[:300], normals[:300], "exact")[:, 0] - truth[:300]
    assert np.abs(exact).max() < 0.0002 * np.pi


@pytest.mark.parametrize("evaluator", EVALUATORS)
def test_a_sky_with_a_sun_as_quadrature(evaluator):
    """Convex polygons anywhere, those about zenith and nadir among them, under a sky of bright and dark texels."""
    rng, pixels = np.random.default_rng(2), city()
    axes = [unit(v) for v in ((0, 1, 0), (0.1, 1, 0.05), (0, -1, 0), (0.1, -1, 0.2), (0.02, 0.1, 1), (0, 0, -1))]
    axes += [sun_of(pixels), *unit(rng.normal(size=(6, 3)))]
    normals = [unit(axis + 0.2 * rng.normal(size=3)) for axis in axes]
    contours = [circle_about(axis, rng.uniform(0.2, 0.9), 9, rng.uniform(0, 6)) for axis in axes]
    truth = np.array([quadrature(pixels, *one, 12) for one in zip(contours, normals, strict=True)])
    got = integrate(gi.Environment(pixels=pixels), [[one] for one in contours], normals, evaluator)
    mean = np.pi * gi.Environment(pixels=pixels).mean_radiance
    assert (truth.max(axis=1) > 0.03).all() and truth[6].min() > 3
    np.testing.assert_allclose(got, truth, atol=0.002 * mean.max())


def sun_of(pixels):
    """Direction of the brightest patch of a map."""
    height, width = pixels.shape[:2]
    row, column = np.unravel_index(pixels.sum(axis=2).argmax(), (height, width))
    t, p = np.pi * row / (height - 1), 2 * np.pi * (column + 1) / width
    return np.array([np.sin(t) * np.sin(p), np.cos(t), -np.sin(t) * np.cos(p)])


def test_both_evaluators_agree_as_the_sky_turns():
    polygons, normals = bitten(60, "any", 0.0, 3)
    sky = gi.Environment(pixels=city(64))
    mean = np.pi * sky.mean_radiance.mean()
    errors = []
    for turn in np.linspace(0, 355, 24):
        light = [integrate(sky.rotated(turn), polygons, normals, one) for one in EVALUATORS]
        errors.append((light[0] - light[1]).mean(axis=1) / mean)
    errors = np.abs(errors)
    assert np.sqrt(np.mean(errors**2)) < 0.0015 and errors.max() < 0.012


def test_a_hole_takes_away_what_it_covers():
    normal = unit((0.3, 0.8, -0.2))
    outer, inner = circle_about(normal), circle_about(unit(normal + np.array((0.2, 0.1, 0))), 0.4)
    sky = gi.Environment(pixels=city())
    whole, hole, both = integrate(sky, [[outer], [inner], [outer, inner[::-1]]], [normal] * 3)
    np.testing.assert_allclose(both, whole - hole, rtol=1e-3)


def test_polygons_see_the_sky_that_rays_see():
    """A hemisphere under a sun of one texel, against cosine-weighted samples of the bilinear map: where it is, and how
    much there is of it."""
    from polygon_tools import patches

    pixels = np.full((24, 48, 3), 0.2, np.float32)
    pixels[6, 10] = 300.0
    directions, solid, _ = patches(pixels, 8)
    azimuth = np.arctan2(directions[:, 0], -directions[:, 2]) / (2 * np.pi) * 48 - 0.5
    polar = np.arccos(directions[:, 1]) / np.pi * 23
    tent = np.maximum(1 - np.abs((azimuth - 10 + 24) % 48 - 24), 0) * np.maximum(1 - np.abs(polar - 6), 0)
    radiance = 0.2 + (300.0 - 0.2) * tent
    normals = [unit((0.2, 1, 0.3)), unit((1, 0.4, -0.3)), unit((-0.2, 0.1, -1))]
    truth = [(radiance * np.maximum(directions @ normal, 0) * solid).sum() for normal in normals]
    got = integrate(gi.Environment(pixels=pixels), [[circle_about(n, count=48)] for n in normals], normals)
    np.testing.assert_allclose(got[:, 0], truth, rtol=0.01)


def test_tables_hold_all_light():
    """The last node of the table, with what stands in bands, is the integral of l L over the sphere."""
    pixels = city()
    exact, adaptive = (sky_tables(pixels, one) for one in ("exact", "adaptive"))
    assert len(adaptive.band_sums) < len(exact.band_sums) == EXACT_COLUMNS == 8 * pixels.shape[1]
    assert len(adaptive.bands) == 1 and adaptive.bands[0, 1] - adaptive.bands[0, 0] == len(adaptive.band_sums) == 3
    vertical = adaptive.table[-1, -1, 1] + adaptive.band_sums[:, -1, 1].sum(axis=0) * 2 * np.pi / adaptive.width
    np.testing.assert_allclose(vertical, adaptive.total[1], rtol=1e-4)
    np.testing.assert_allclose(exact.total, adaptive.total, rtol=1e-9)
    np.testing.assert_allclose(
        row_areas(np.array([0.0, np.pi / 2, np.pi])), [[0, 0], [np.pi / 4, 0.5], [np.pi / 2, 0]], atol=1e-12
    )
