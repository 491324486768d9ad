"""Lobes of Phong and GGX in spherical harmonics: closed forms, energy, and errors of light reflected by them."""

from __future__ import annotations

import numpy as np
import pytest

from warp_gi.errors import OptionError
from warp_gi.scene.harmonics import basis, sphere
from warp_gi.techniques.radiance_transfer import products
from warp_gi.techniques.radiance_transfer.lobes import (
    COLUMNS,
    ROUGHNESSES,
    SMALLEST_ROUGHNESS,
    fit_ggx,
    ggx_directions,
    lobe_table,
    phong,
)

UP = np.array([0.0, 0.0, 1.0])
COSINES = np.array([0.05, 0.15, 0.3, 0.45, 0.6, 0.75, 0.9, 0.97])


def views(cosines):
    return np.stack([np.sqrt(1 - cosines**2), 0 * cosines, cosines], axis=-1)


def ggx(roughness, wo, wi):
    """D V of kernels/bsdf.py and (1 - V.H)^5, written out; wo [3], wi [..., 3]."""
    a2 = roughness**4
    h = wo + wi
    h /= np.linalg.norm(h, axis=-1, keepdims=True)
    d = a2 / (np.pi * (1 - (1 - a2) * h[..., 2] ** 2) ** 2)
    root_o, root_i = (np.sqrt(a2 + (1 - a2) * w[..., 2] ** 2) for w in (wo, wi))
    v = 0.5 / (wo[2] * root_i + wi[..., 2] * root_o)
    return np.where(wi[..., 2] > 0, d * v, 0), (1 - h @ wo) ** 5


def gauss(panels):
    """Nodes and weights on [0, 1], 4 a panel."""
    nodes, weights = np.polynomial.legendre.leggauss(4)
    return ((np.arange(panels)[:, None] + (nodes + 1) / 2) / panels).ravel(), np.tile(weights / 2 / panels, panels)


def hemisphere(rows, columns):
    z, weights = gauss(rows // 4)
    phi = 2 * np.pi * (np.arange(columns) + 0.5) / columns
    ring = np.sqrt(1 - z * z)[:, None]
    d = np.stack([ring * np.cos(phi), ring * np.sin(phi), z[:, None] + 0 * phi], axis=-1).reshape(-1, 3)
    return d, np.repeat(weights, columns) * 2 * np.pi / columns


def test_phong_factors():
    x, weights = gauss(400)
    for s in (0.0, 0.5, 1.0, 2.0, 4.0, 7.3, 16.0, 300.0):
        lobe = (s + 2) * x**s
        expected = [weights @ (lobe * np.polynomial.legendre.Legendre.basis(l)(x)) for l in range(7)]
        assert phong(s, 7) == pytest.approx(expected, rel=1e-4, abs=1e-6)
    assert phong(4.0, 5) / phong(4.0, 5)[0] == pytest.approx([1, 0.833, 0.571, 0.3125, 0.127], abs=1e-3)
    sharp = phong(1e4, 6)
    assert (np.diff(sharp) < 0).all() and sharp == pytest.approx(1, abs=2e-3)  # 1 - l (l + 1) / 2 s, nearly
    assert phong(np.array([[1.0, 2.0]]), 1).shape == (1, 2, 1)


def test_phong_keeps_the_energy_of_a_white_furnace():
    """int B cos = 1 where the lobe stands on the normal, and light of one band is all there is."""
    for s in (0.0, 1.0, 8.0):
        lobe = products.zonal(UP, phong(s, 7))
        d, weights = hemisphere(60, 16)
        known = (weights * (s + 2) / (2 * np.pi) * d[:, 2] ** (s + 1)).sum()
        assert known == pytest.approx(1.0)
        found = lobe @ products.unoccluded(UP, 7)
        assert found == pytest.approx(known, abs=0.002)


@pytest.mark.parametrize("roughness", [0.35, 0.6, 1.0])
def test_quadrature_of_ggx(roughness):
    d, weights = hemisphere(240, 400)
    cosines = COSINES[1::2]
    wi, found, fresnel = ggx_directions(roughness, cosines)
    for k, wo in enumerate(views(cosines)):
        value, schlick = ggx(roughness, wo, d)
        value *= weights * d[:, 2]
        assert found[k].sum() == pytest.approx(value.sum(), abs=2e-3)
        assert (found[k] * fresnel[k]).sum() == pytest.approx((value * schlick).sum(), abs=2e-3)
        even = [0, 2, 3, 6, 7, 8, 12, 20]
        assert found[k] @ basis(wi[k], 5)[:, even] == pytest.approx(value @ basis(d, 5)[:, even], abs=2e-3)


@pytest.mark.parametrize("order", [5, 6])
def test_table_of_ggx_reflects_a_white_sky_exactly(order):
    table = lobe_table(order)
    assert table.entries.shape == (ROUGHNESSES, COLUMNS, 8 + order) and table.entries.dtype == np.float32
    assert table.order == order and np.isfinite(table.entries).all()
    assert np.abs(table.white(table.entries.astype(float)) - 1).max() < 1e-5
    rng = np.random.default_rng(order)
    roughness, cosine = rng.uniform(SMALLEST_ROUGHNESS, 1, 200), rng.uniform(0, 1, 200)
    lobes = table.at(roughness, cosine)
    normals = rng.normal(size=(200, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    across = np.cross(normals, rng.normal(size=(200, 3)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    wo = cosine[:, None] * normals + np.sqrt(1 - cosine**2)[:, None] * across
    found = (table.coefficients(lobes, normals, wo) * products.unoccluded(normals, order)).sum(axis=1)
    assert np.abs(found - 1).max() < 1e-6
    assert np.isfinite(table.coefficients(lobes, normals, normals)).all()


def test_table_of_ggx_between_its_entries():
    """Directions turn without jumps; neither they nor albedos differ much from those fitted at the same place."""
    table = lobe_table(5)
    angles = np.arctan2(table.entries[..., 0], table.entries[..., 1])
    assert np.abs(np.diff(angles, axis=0)).max() < 0.2 and np.abs(np.diff(angles, axis=1)).max() < 0.3
    assert np.abs(angles[:, 0]).max() < 0.01  # along the normal where the viewer is
    rng = np.random.default_rng(2)
    for roughness in rng.uniform(SMALLEST_ROUGHNESS, 1, 12):
        cosines = rng.uniform(0.02, 1, 8)
        found, expected = table.at(roughness, cosines), fit_ggx(roughness, cosines, 5)
        assert np.abs(np.arctan2(found[:, 0], found[:, 1]) - np.arctan2(expected[:, 0], expected[:, 1])).max() < 0.04
        assert np.abs(found[:, 2:4] - expected[:, 2:4]).max() < 0.025
        raw = table.white(found * [1, 1, 1, 1, *[1] * 9])
        assert raw == pytest.approx(1)
    assert np.allclose(table.at(0.05, 0.5), table.at(SMALLEST_ROUGHNESS, 0.5))


def test_albedo_of_the_table_is_that_of_the_library():
    """Mean over cosines, as ``average_specular`` of kernels/bsdf.py has it in closed form."""
    table = lobe_table(5)
    nodes, weights = np.polynomial.legendre.leggauss(24)
    cosines = (nodes + 1) / 2
    for r in (0.2, 0.4, 0.6, 0.8, 1.0):
        albedo = (weights * cosines) @ table.at(r, cosines)[:, 2:4]
        scale = (((1.4419665 * r - 2.5984166) * r + 0.6431491) * r - 0.0300414) * r + 0.9512468
        offset = (((-0.2404349 * r + 0.5943225) * r - 0.4491881) * r + 0.0516552) * r + 0.0461039
        assert albedo == pytest.approx([scale, offset], abs=4e-3)


class Lit:
    """Points under skies of 25 numbers, behind walls or in the open: what GGX and what lobes reflect there."""

    def __init__(self, count=48):
        rng = np.random.default_rng(7)
        lamps = rng.normal(size=(2, count, 3))
        lamps /= np.linalg.norm(lamps, axis=-1, keepdims=True)
        self.light = 2.0 * basis(lamps, 5).sum(axis=0)
        self.light[:, 0] += 2
        self.walls = rng.normal(size=(count, 3))
        self.walls /= np.linalg.norm(self.walls, axis=1, keepdims=True)
        self.edges = rng.uniform(-0.1, 0.7, count)
        self.edges[::4] = 2  # no wall
        d, weights = sphere(200)
        self.transfer = (((weights * np.maximum(d[:, 2], 0))[:, None] * self.open(d)).T) @ basis(d, 6)

    def open(self, d):
        return d @ self.walls.T < self.edges

    def reflected(self, roughness):
        wi, weights, _ = ggx_directions(roughness, COSINES, 40, 40)
        result = np.zeros((len(COSINES), len(self.light)))
        for side in (1, -1):
            d = wi * [1, side, 1]
            for k in range(len(COSINES)):
                result[k] += weights[k] / 2 @ (basis(d[k], 5) @ self.light.T * self.open(d[k]))
        return result / weights.sum(axis=1, keepdims=True)

    def error(self, lobes, expected, order):
        """RMSE over the mean, of lobes [cosines, order^2]."""
        matrices = products.light_matrix(self.light, order)
        found = lobes @ np.einsum("ckj,cj->kc", matrices, self.transfer[:, : order**2])
        return np.sqrt(((found - expected) ** 2).mean()) / expected.mean()


def about_mirror(roughness, order):
    """The lobe that is nearest to GGX, weighted by the cosine, among those about the mirrored view."""
    d, weights = hemisphere(80, 160)
    values = basis(d, order)
    gram = (values * (weights * d[:, 2])[:, None]).T @ values + 1e-3 * np.eye(order**2)
    rows = []
    for wo in views(COSINES):
        moments = (weights * d[:, 2] * ggx(roughness, wo, d)[0]) @ values
        axis = basis(wo * [-1, -1, 1], order)
        bands = np.stack([np.where(np.arange(order**2) // (l + 1) ** 2 > 0, 0, axis) for l in range(order)], axis=1)
        bands = np.diff(bands, axis=1, prepend=0)
        lobe = bands @ np.linalg.solve(bands.T @ gram @ bands, bands.T @ moments)
        rows.append(lobe / (lobe @ products.unoccluded(UP, order)))
    return np.array(rows)


def test_lobes_of_ggx_are_nearer_than_ones_about_the_mirrored_view():
    lit = Lit()
    errors = {}
    for roughness in (0.5, 0.6, 0.7, 0.9, 1.0):
        expected = lit.reflected(roughness)
        for order in (5, 6):
            table = lobe_table(order)
            lobes = table.coefficients(table.at(roughness, COSINES), UP, views(COSINES))
            errors[roughness, order] = lit.error(lobes, expected, order)
            assert lit.error(about_mirror(roughness, order), expected, order) > 1.25 * errors[roughness, order]
    assert errors[0.7, 5] < 0.05 and errors[0.6, 5] < 0.09 and errors[0.5, 5] < 0.17
    assert errors[0.9, 5] < 0.025 and errors[1.0, 5] < 0.025
    assert errors[0.5, 6] < errors[0.5, 5] and errors[0.6, 6] < errors[0.6, 5]


def test_orders_without_a_table():
    with pytest.raises(OptionError, match="got 3; use 5 or 6"):
        lobe_table(3)
