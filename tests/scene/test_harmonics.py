"""Spherical harmonics of a sky: closed forms, orthonormality, projection, rotation, and the light of octets."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scipy import special
from statistics_tools import device, every_device  # noqa: F401

from warp_gi.kernels import harmonics as kernels
from warp_gi.kernels import visibility_field as field
from warp_gi.launch import launch
from warp_gi.scene.environment import Environment
from warp_gi.scene.harmonics import basis, by_coefficient, project, ring_coefficients, ring_pixels, rotate, sphere

wp.set_module_options({"enable_backward": False})


@wp.kernel
def evaluate(
    first: wp.int32,
    directions: wp.array(dtype=wp.vec3),
    plain: wp.array2d(dtype=wp.float32),
    cosine: wp.array2d(dtype=wp.float32),
):
    i = first + wp.tid()
    y = kernels.harmonics(directions[i])
    c = kernels.cosine_harmonics(directions[i])
    for k in range(9):
        plain[i, k] = y[k]
        cosine[i, k] = c[k]


@wp.kernel
def light(
    first: wp.int32,
    sky: kernels.Harmonics,
    octets: wp.array(dtype=field.vec33),
    bits: wp.array(dtype=wp.int32),
    sums: wp.array(dtype=field.vec6),
):
    i = first + wp.tid()
    sums[i] = field.harmonic_light(sky, octets[i], bits[i])


def random_directions(count, seed=1):
    d = np.random.default_rng(seed).standard_normal((count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def random_rotation(seed=2):
    q, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    return q * np.sign(np.linalg.det(q))


def quadrature():
    """Directions and weights that integrate polynomials of degree 31 over the sphere exactly, z up."""
    z, weights = np.polynomial.legendre.leggauss(16)
    phi = np.arange(32) * 2 * np.pi / 32
    z, phi = (grid.ravel() for grid in np.meshgrid(z, phi, indexing="ij"))
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(phi), ring * np.sin(phi), z], axis=-1), np.repeat(weights, 32) * 2 * np.pi / 32


def map_directions(height):
    """Directions of the nodes of a latitude-longitude map [height, 2 height, 3], as scene/environment.py says."""
    v, u = np.meshgrid(np.arange(height) / (height - 1), (np.arange(2 * height) + 0.5) / (2 * height), indexing="ij")
    theta, phi = np.pi * v, 2 * np.pi * u
    return np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1)


def evaluated(directions):
    count = len(directions)
    plain, cosine = (wp.zeros((count, 9), dtype=wp.float32, device=device()) for _ in range(2))
    given = wp.array(directions.astype(np.float32), dtype=wp.vec3, device=device())
    launch(evaluate, count, [given, plain, cosine], device())
    return plain.numpy(), cosine.numpy()


def test_basis_is_that_of_textbooks():
    """Real harmonics from complex ones: m < 0 is sqrt(2) Im, m > 0 is sqrt(2) Re, no Condon-Shortley sign."""
    d = random_directions(500)
    assert np.abs(basis(d) - textbook(d, 3)).max() < 1e-12
    assert np.abs(evaluated(d)[0] - textbook(d, 3)).max() < 1e-6
    assert basis(d.reshape(5, 100, 3)).shape == (5, 100, 9)


@pytest.mark.parametrize("order", [1, 2, 4, 5, 6, 7, 12])
def test_basis_of_any_order(order):
    d = np.concatenate([random_directions(200), np.eye(3), -np.eye(3)])
    y = basis(d, order)
    assert y.shape == (206, order * order)
    assert np.abs(y - textbook(d, order)).max() < 1e-12
    known = min(order, 3) ** 2
    assert np.abs(y[:, :known] - basis(d)[:, :known]).max() < 1e-14
    directions, weights = quadrature()
    y = basis(directions, order)
    assert np.abs(np.einsum("n,ni,nj->ij", weights, y, y) - np.eye(order * order)).max() < 1e-12
    directions, weights = sphere(2 * order - 2)
    y = basis(directions, order)
    assert np.abs(np.einsum("n,ni,nj->ij", weights, y, y) - np.eye(order * order)).max() < 1e-12


def textbook(d, order):
    colatitude, azimuth = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    expected = []
    for l in range(order):
        for m in range(-l, l + 1):
            if hasattr(special, "sph_harm_y"):
                y = special.sph_harm_y(l, abs(m), colatitude, azimuth)
            else:
                y = special.sph_harm(abs(m), l, azimuth, colatitude)
            y = y * (-1) ** m
            expected.append(y.real if m == 0 else np.sqrt(2) * (y.imag if m < 0 else y.real))
    return np.stack(expected, axis=-1)


def test_functions_of_the_fourth_and_fifth_band():
    """Polynomials written out (Sloan, "Stupid Spherical Harmonics Tricks", appendix A2)."""
    x, y, z = (d := random_directions(50)).T
    found = basis(d, 6)
    assert np.allclose(found[:, 20], 3 / 16 / np.sqrt(np.pi) * (35 * z**4 - 30 * z**2 + 3))
    assert np.allclose(found[:, 16], 0.75 * np.sqrt(35 / np.pi) * x * y * (x * x - y * y))
    assert np.allclose(found[:, 30], np.sqrt(11 / np.pi) / 16 * (63 * z**5 - 70 * z**3 + 15 * z))
    assert np.allclose(found[:, 35], 3 / 32 * np.sqrt(154 / np.pi) * x * (x**4 - 10 * x * x * y * y + 5 * y**4))


def test_basis_is_orthonormal():
    directions, weights = quadrature()
    for y in (basis(directions), evaluated(directions)[0].astype(np.float64)):
        assert np.abs(np.einsum("n,ni,nj->ij", weights, y, y) - np.eye(9)).max() < 1e-6


def test_cosine_harmonics_are_what_lambert_reflects():
    normals = np.concatenate([np.eye(3), -np.eye(3), random_directions(30)])
    z, weights = np.polynomial.legendre.leggauss(8)
    z, phi = (g.ravel() for g in np.meshgrid((z + 1) / 2, np.arange(16) * 2 * np.pi / 16, indexing="ij"))
    weights = np.repeat(weights / 2, 16) * 2 * np.pi / 16
    local = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=-1)
    found = evaluated(normals)[1]
    for normal, row in zip(normals, found, strict=True):
        across = np.linalg.svd(normal[None])[2][1:]
        directions = local @ np.stack([*across, normal])
        expected = (weights * z / np.pi) @ basis(directions)
        assert np.abs(row - expected).max() < 1e-6


def test_projection_recovers_a_map_of_harmonics():
    """Up to what bilinear interpolation between the map's nodes takes from the second order."""
    coefficients = np.random.default_rng(0).normal(size=(3, 9))
    errors = []
    for height in (32, 128):
        found = project(basis(map_directions(height)) @ coefficients.T)
        assert found.shape == (3, 9)
        errors.append(np.abs(found - coefficients).max())
    assert errors[0] < 0.02 and errors[1] < errors[0] / 10
    spot = np.zeros((64, 128, 3))
    spot[20, 37] = (1.0, 2.0, 4.0)  # a node among zeros: its harmonics times the solid angle of its weight
    found = project(spot)
    expected = basis(map_directions(64)[20, 37]) * found[0, 0] / basis(np.array([0.0, 1.0, 0.0]))[0]
    assert np.allclose(found, np.outer([1, 2, 4], expected), atol=1e-12)
    assert found[0, 0] == pytest.approx(0.282095 * np.sin(20 * np.pi / 63) * (np.pi / 63) * (2 * np.pi / 128), rel=1e-3)


def test_rotating_coefficients_is_rotating_the_sky():
    coefficients, rotation = np.random.default_rng(1).normal(size=(3, 9)), random_rotation()
    turned = rotate(coefficients, rotation)
    d = random_directions(200)
    assert np.abs(basis(d @ rotation.T) @ turned.T - basis(d) @ coefficients.T).max() < 1e-12
    directions, weights = quadrature()
    values = basis(directions @ rotation) @ coefficients.T
    assert np.abs(turned - np.einsum("n,nc,ni->ci", weights, values, basis(directions))).max() < 1e-12
    assert np.allclose(rotate(coefficients, np.eye(3)), coefficients)
    assert np.allclose(rotate(turned, rotation.T), coefficients)
    assert np.allclose((turned**2).sum(axis=1), (coefficients**2).sum(axis=1))


@pytest.mark.parametrize("order", [2, 5, 6, 7])
def test_any_order_is_projected_and_rotated(order):
    rng = np.random.default_rng(order)
    coefficients, rotation = rng.normal(size=(3, order * order)), random_rotation()
    turned = rotate(coefficients, rotation)
    d = random_directions(200)
    assert np.abs(basis(d @ rotation.T, order) @ turned.T - basis(d, order) @ coefficients.T).max() < 1e-12
    assert np.abs(rotate(turned, rotation.T) - coefficients).max() < 1e-12
    assert np.allclose((turned**2).sum(axis=1), (coefficients**2).sum(axis=1))
    errors = []
    for height in (32, 128):
        found = project(basis(map_directions(height), order) @ coefficients.T, order)
        assert found.shape == (3, order * order)
        errors.append(np.abs(found - coefficients).max())
    assert errors[0] < 0.07 and errors[1] < errors[0] / 10


def bilinear_coefficients(pixels, order):
    """Coefficients of a map that is bilinear between its nodes, by Gauss quadrature of every patch."""
    height, width = pixels.shape[:2]
    nodes, weights = np.polynomial.legendre.leggauss(8)
    share, weights = (nodes + 1) / 2, weights / 2
    theta = ((np.arange(height - 1)[:, None] + share) * np.pi / (height - 1))[:, None, :, None]
    phi = ((np.arange(width)[:, None] + 0.5 + share) * 2 * np.pi / width)[None, :, None, :]
    t, s = share[:, None, None], share[:, None]
    upper, lower = pixels[:-1, :, None, None], pixels[1:, :, None, None]
    right = np.roll(pixels, -1, axis=1)
    upper = upper * (1 - s) + right[:-1, :, None, None] * s
    lower = lower * (1 - s) + right[1:, :, None, None] * s
    areas = np.sin(theta) * np.outer(weights, weights) * np.pi / (height - 1) * 2 * np.pi / width
    light = (upper * (1 - t) + lower * t) * areas[..., None]
    d = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi, -np.sin(theta) * np.cos(phi)], axis=-1)
    return np.einsum("ijabc,ijabk->ck", light, basis(d, order), optimize=True)


def test_bilinear_maps_are_projected_exactly():
    pixels = np.random.default_rng(8).random((12, 24, 3))
    expected = bilinear_coefficients(pixels, 6)
    assert np.abs(project(pixels, 6) - expected).max() < 2e-5
    assert np.abs(project(pixels) - expected[:, :9]).max() < 0.05  # a sum over nodes
    white = project(np.ones((64, 128, 3), np.float32), 5)
    assert white[:, 0] == pytest.approx(np.sqrt(4 * np.pi)) and np.abs(white[:, 1:]).max() < 1e-9


def test_maps_of_high_orders_go_to_rings_and_back():
    order, rng = 20, np.random.default_rng(5)
    coefficients, errors = rng.normal(size=(25, 3)), []
    for height in (64, 256):
        pixels = basis(map_directions(height), 5) @ coefficients
        rings = ring_coefficients(pixels, order)
        assert rings.shape == (order, order, 3)
        errors.append(np.abs(ring_pixels(rings, height) - pixels).max())
    assert errors[0] < 0.15 and errors[1] < errors[0] / 10
    rings[:, 5:] = 0
    expected = basis(map_directions(16), 5) @ project(pixels, 5).T
    assert expected.shape == (16, 32, 3)
    assert np.abs(ring_pixels(rings, 16) - expected).max() < 1e-12
    assert not ring_coefficients(pixels[:3, :4], 8)[2:].any()  # beyond what four columns can tell


def test_factors_of_bands():
    assert by_coefficient(np.array([1.0, 2.0, 3.0])).tolist() == [1, 2, 2, 2, 3, 3, 3, 3, 3]


def test_environments_of_one_colour_have_one_harmonic():
    sky = Environment(color=(1.0, 2.0, 0.5), scale=3.0)
    assert np.allclose(basis(random_directions(10)) @ sky.harmonics.T, [3.0, 6.0, 1.5])
    assert np.allclose(sky.rotated(77).harmonics, sky.harmonics)
    assert not Environment().harmonics.any()
    white = Environment(pixels=np.full((64, 128, 3), 2.0, np.float32))
    assert np.allclose(white.harmonics, Environment.constant(2.0).harmonics, atol=0.005)
    assert np.allclose(white.harmonics[:, 0] / np.sqrt(4 * np.pi), 2.0)


def test_environments_turn_and_scale():
    height = 64
    pixels = np.random.default_rng(4).random((height, 2 * height, 3)).astype(np.float32)
    pixels[10:20, 30:50] *= 8
    sky = Environment(pixels=pixels)
    assert np.allclose(sky.harmonics, project(pixels))
    assert np.allclose(Environment(pixels=pixels, scale=2.5).harmonics, 2.5 * sky.harmonics)
    for columns in (16, 77):  # a turn by whole columns is a map whose columns are rolled: counter-clockwise to the left
        turned = sky.rotated(columns * 180 / height)
        assert np.allclose(turned.harmonics, project(np.roll(pixels, -columns, axis=1)), atol=1e-9)
        assert not np.allclose(turned.harmonics, sky.harmonics, atol=0.05)
        expected = project(np.roll(pixels, -columns, axis=1), 5)
        assert np.allclose(turned.harmonics_of(5), expected, rtol=0, atol=1e-9)
    assert np.array_equal(sky.harmonics_of(3), sky.harmonics)
    constant = Environment(color=(1.0, 2.0, 0.5)).rotated(30).harmonics_of(6)
    assert constant[:, 0] == pytest.approx(np.array([1.0, 2.0, 0.5]) * np.sqrt(4 * np.pi)) and not constant[:, 1:].any()
    sky.data("cpu")
    pixels[:] = 1.0
    assert np.allclose(sky.renewed().harmonics_of(5), project(pixels, 5))


def test_sky_of_harmonics_lies_as_the_map_does():
    """Bright where the map is: quarter of the way right is +x, middle +z, the top +y."""
    for row, column, towards in ((31, 32, (1, 0, 0)), (31, 64, (0, 0, 1)), (2, 10, (0, 1, 0)), (31, 0, (0, 0, -1))):
        pixels = np.zeros((64, 128, 3), np.float32)
        pixels[row : row + 2, column - 1 : column + 1] = 1000.0
        pixels[row : row + 2, column] = 1000.0
        coefficients = Environment(pixels=pixels).harmonics[0]
        d = random_directions(4000)
        assert d[np.argmax(basis(d) @ coefficients)] @ towards > 0.97


def test_light_of_octets_is_their_sum():
    rng, count = np.random.default_rng(6), 500
    directions = random_directions(8 * count).reshape(count, 8, 3).astype(np.float32)
    coefficients = rng.normal(size=(3, 9)).astype(np.float32)
    bits = rng.integers(0, 256, count).astype(np.int32)
    bits[:10] = [0, 255, *(1 << np.arange(8))]
    octets = np.zeros((count, 33), np.float32)
    octets[:, :24] = directions.transpose(0, 2, 1).reshape(count, 24)
    sums = wp.zeros(count, dtype=field.vec6, device=device())
    given = [wp.array(octets, dtype=field.vec33, device=device()), wp.array(bits, dtype=wp.int32, device=device())]
    high = wp.array(bits | 0xABC00 & ~255, dtype=wp.int32, device=device())  # what else an octet's bits say
    for chosen in (given[1], high):
        launch(light, count, [kernels.Harmonics(*coefficients.ravel()), given[0], chosen, sums], device())
        radiance = basis(directions) @ coefficients.T.astype(np.float64)
        kept = radiance * ((bits[:, None] >> np.arange(8)) & 1)[..., None]
        expected = np.concatenate([kept.sum(axis=1), (kept**2).sum(axis=1)], axis=1)
        assert np.abs(sums.numpy() - expected).max() < 2e-5
    assert not sums.numpy()[0].any()
