"""Tripling coefficients, products of light, transfer and lobes, and transfer without occluders."""

from __future__ import annotations

import numpy as np
import pytest

from warp_gi.kernels.transfer_snippets import clamped_cosine
from warp_gi.scene.harmonics import basis, by_coefficient
from warp_gi.techniques.radiance_transfer import products


def random_directions(count, seed=1):
    d = np.random.default_rng(seed).standard_normal((count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def grid(rows, columns, low=-1.0):
    """Directions and weights of a quadrature over z in [low, 1], by midpoints in azimuth; not the library's."""
    z, weights = np.polynomial.legendre.leggauss(rows)
    z, weights = low + (z + 1) * (1 - low) / 2, weights * (1 - low) / 2
    phi = 2 * np.pi * np.arange(columns) / columns
    ring = np.sqrt(1 - z * z)[:, None]
    d = np.stack([ring * np.cos(phi), ring * np.sin(phi), z[:, None] + 0 * phi], axis=-1).reshape(-1, 3)
    return d, np.repeat(weights, columns) * 2 * np.pi / columns


@pytest.mark.parametrize("order, light_order, count", [(3, 3, 83), (4, 4, 353), (5, 5, 1158), (6, 6, 2907)])
def test_tripling_coefficients(order, light_order, count):
    table = products.tripling(order, light_order)
    assert table.shape == (light_order**2, order**2, order**2)
    assert np.count_nonzero(table) == count
    assert np.abs(table[table != 0]).min() > 1e-3
    for other in ((0, 2, 1), (1, 0, 2), (2, 1, 0)):
        assert np.abs(table - table.transpose(other)).max() < 1e-14
    assert np.abs(table[0] - np.eye(order**2) / np.sqrt(4 * np.pi)).max() < 1e-14
    directions, weights = grid(24, 48)
    y = basis(directions, order)
    assert np.abs(np.einsum("n,ni,nj,nk->ijk", weights, y, y, y, optimize=True) - table).max() < 1e-13


def test_light_may_have_another_order_than_transfer():
    table = products.tripling(6)
    assert table.shape == (25, 36, 36)
    assert np.abs(table[:, :25, :25] - products.tripling(5)).max() < 1e-14
    assert np.abs(table - products.tripling(6, 6)[:25]).max() < 1e-14
    assert not products.tripling(5).flags.writeable


@pytest.mark.parametrize("order", [5, 6])
def test_all_forms_of_the_product_agree(order):
    rng = np.random.default_rng(order)
    light, transfer, lobe = rng.normal(size=(3, 25)), rng.normal(size=order**2), rng.normal(size=order**2)
    dense = products.triple_product(light, transfer, lobe)
    for other in (
        products.sparse_triple_product,
        products.reordered_triple_product,
        products.fixed_light_product,
    ):
        assert np.abs(other(light, transfer, lobe) - dense).max() < 1e-12 * np.abs(dense).max()
    directions, weights = grid(24, 48)
    sky = basis(directions, 5) @ light.T
    product = sky * (basis(directions, order) @ transfer * (basis(directions, order) @ lobe))[:, None]
    assert np.allclose(dense, weights @ product)
    matrix = products.light_matrix(light, order)
    assert matrix.shape == (3, order**2, order**2)
    assert np.allclose(matrix, matrix.transpose(0, 2, 1))
    single = products.light_matrix(light.astype(np.float32), order).astype(np.float32)
    assert np.abs(lobe @ single @ transfer - dense).max() < 1e-5 * np.abs(dense).max()


def test_light_matrix_multiplies_functions():
    """M T are the coefficients of the product of light and transfer: exact, where the product has no higher bands."""
    rng = np.random.default_rng(3)
    light, transfer = np.zeros((3, 25)), np.zeros(25)
    light[:, :9], transfer[:9] = rng.normal(size=(3, 9)), rng.normal(size=9)
    d = random_directions(50)
    product = (basis(d, 5) @ light.T) * (basis(d, 5) @ transfer)[:, None]
    assert np.abs(basis(d, 5) @ (products.light_matrix(light, 5) @ transfer).T - product).max() < 1e-12


def test_transfer_without_occluders_is_the_clamped_cosine():
    factors = clamped_cosine(9)
    assert factors[:5] == pytest.approx([np.pi, 2 * np.pi / 3, np.pi / 4, 0, -np.pi / 24])
    directions, weights = grid(40, 80, low=0.0)
    expected = (weights * directions[:, 2]) @ basis(directions, 9)
    assert np.abs(products.unoccluded(np.array([0.0, 0.0, 1.0]), 9) - expected).max() < 1e-13
    for normal in random_directions(4):
        across = np.linalg.svd(normal[None])[2][1:]
        turned = directions @ np.stack([*across, normal])
        expected = (weights * (turned @ normal)) @ basis(turned, 6)
        assert np.abs(products.unoccluded(normal, 6) - expected).max() < 1e-12
    assert products.unoccluded(random_directions(6).reshape(2, 3, 3), 5).shape == (2, 3, 25)


def test_zonal_lobes_lie_about_their_axes():
    """(1 + d . w)^3 has four bands; its factors are integrals over x = d . w."""
    axes, d = random_directions(3), random_directions(40, seed=2)
    x, weights = np.polynomial.legendre.leggauss(8)
    factors = [2 * np.pi * weights @ ((1 + x) ** 3 * np.polynomial.legendre.Legendre.basis(l)(x)) for l in range(5)]
    assert abs(factors[4]) < 1e-12
    lobes = products.zonal(axes, np.tile(factors, (3, 1)))
    assert np.abs(basis(d, 5) @ lobes.T - (1 + d @ axes.T) ** 3).max() < 1e-12


def test_window_keeps_the_mean_and_takes_high_bands():
    factors = products.window(5, 0.01)
    assert factors[0] == 1 and factors[1] == pytest.approx(1 / 1.04) and factors[4] == pytest.approx(1 / 5)
    assert (products.window(6, 0.0) == 1).all()
    assert by_coefficient(factors).shape == (25,)
