"""Light selection weights against float64: the cosine integral of a triangle, the transformed cosines of the GGX lobe.

Oracles are written anew: a polygon is clipped by Sutherland and Hodgman and summed with atan2, itself held against
plain sums over the triangle; the BRDF is integrated over triangles by quadrature.
"""

from __future__ import annotations

import importlib.util
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from statistics_tools import device, every_device  # noqa: F401

from warp_gi.kernels import ltc
from warp_gi.kernels.bsdf import SMALLEST_ALPHA, lambert, make_bsdf
from warp_gi.launch import launch
from warp_gi.techniques.shared.ltc import ltc_table

wp.set_module_options({"enable_backward": False})

ROOT = Path(__file__).resolve().parents[2]
COLOR = (0.8, 0.5, 0.2)
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


# Thread: one triangle.
@wp.kernel
def cosines(first: wp.int32, corners: wp.array(dtype=wp.vec3), values: wp.array(dtype=wp.float32)):
    i = first + wp.tid()
    values[i] = ltc.triangle_cosine(corners[3 * i], corners[3 * i + 1], corners[3 * i + 2])


# Thread: one triangle and one view. A material is base colour, metallic, roughness, specular (below 0: plain Lambert).
@wp.kernel
def weights(
    first: wp.int32,
    table: ltc.LtcTable,
    material: wp.array(dtype=wp.float32),
    views: wp.array(dtype=wp.vec3),
    corners: wp.array(dtype=wp.vec3),
    values: wp.array(dtype=wp.float32),
    lobes: wp.array(dtype=wp.vec3),
):
    i = first + wp.tid()
    color = wp.vec3(material[0], material[1], material[2])
    b = lambert(color)
    if material[5] >= 0.0:
        b = make_bsdf(color, material[3], material[4], material[5])
    w = ltc.lobe_weights(table, b, views[i])
    values[i] = ltc.triangle_weight(w, corners[3 * i], corners[3 * i + 1], corners[3 * i + 2])
    lobes[i] = wp.vec3(w.diffuse, w.specular, wp.determinant(w.matrix))


# ---- ours ----


def vec3s(values):
    return wp.array(np.asarray(values, np.float32).reshape(-1, 3), dtype=wp.vec3, device=device())


def cosine_of(triangles):
    """triangle_cosine of [n, 3, 3]."""
    values = wp.zeros(len(triangles), dtype=wp.float32, device=device())
    launch(cosines, len(triangles), [vec3s(triangles), values], device())
    return values.numpy().astype(np.float64)


def weight_of(material, views, triangles, table=None):
    """triangle_weight [n], and (diffuse, specular, determinant) [n, 3], of views [3] or [n, 3]."""
    count = len(triangles)
    values, lobes = (wp.zeros(count, dtype=t, device=device()) for t in (wp.float32, wp.vec3))
    constants = wp.array(np.array(material, np.float32), dtype=wp.float32, device=device())
    inputs = [table or ltc_table(device()), constants, vec3s(np.broadcast_to(views, (count, 3)))]
    launch(weights, count, [*inputs, vec3s(triangles), values, lobes], device())
    return values.numpy().astype(np.float64), lobes.numpy().astype(np.float64)


# ---- oracles ----


def clipped(triangles):
    """Polygons [n, 4, 3] of triangles [n, 3, 3] cut at z = 0; corners that are missing repeat another one."""
    out = np.zeros((len(triangles), 4, 3))
    for i, triangle in enumerate(triangles):
        polygon = []
        for p, q in zip(triangle, np.roll(triangle, -1, axis=0), strict=True):
            if p[2] > 0:
                polygon.append(p)
            if (p[2] > 0) != (q[2] > 0):
                polygon.append((p + (q - p) * (p[2] / (p[2] - q[2]))) * [1, 1, 0])
        if polygon:
            out[i] = [*polygon, *[polygon[-1]] * (4 - len(polygon))]
    return out


def polygon_cosine(polygons):
    """Lambert's formula: half the sum over edges of angle times the normal of the edge's plane, over pi."""
    following = np.roll(polygons, -1, axis=1)
    cross = np.cross(polygons, following)
    sine = np.linalg.norm(cross, axis=2)
    angle = np.arctan2(sine, (polygons * following).sum(axis=2))
    return np.abs((angle * cross[:, :, 2] / np.maximum(sine, 1e-300)).sum(axis=1)) / (2 * np.pi)


def exact_cosine(triangles):
    """The cosine integral over pi, [n], of float64 [n, 3, 3]."""
    triangles = np.asarray(triangles, np.float64)
    out = polygon_cosine(clipped(triangles))
    out[triangles[:, :, 2].max(axis=1) <= 0] = 0
    return out


def triangle_points(triangles, count):
    """Directions [n, m, 3] and their solid angles [n, m]: middles of count^2 equal parts of each triangle."""
    i, j = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
    upright, turned = i + j < count, i + j < count - 1
    u = np.concatenate([(i[upright] + 1 / 3) / count, (i[turned] + 2 / 3) / count])
    v = np.concatenate([(j[upright] + 1 / 3) / count, (j[turned] + 2 / 3) / count])
    a, b, c = (triangles[:, k, None] for k in range(3))
    p = a + (b - a) * u[:, None] + (c - a) * v[:, None]
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    r = np.linalg.norm(p, axis=2)
    return p / r[:, :, None], np.abs((p * normal[:, None]).sum(axis=2)) / (2 * count**2 * r**3)


def reflected(material, wo, wi):
    """Luminance of f * cos(wi) of wi [..., 3], glTF's formula; alpha is roughness squared."""
    base, metallic, roughness, specular = np.array(material[:3]), *material[3:6]
    cos_o, cos_i = wo[2], np.maximum(wi[..., 2], 0)
    if specular < 0:
        return base @ LUMINANCE * cos_i / np.pi
    h = wo + wi
    h /= np.linalg.norm(h, axis=-1, keepdims=True)
    f0 = 0.04 * specular * (1 - metallic) + base * metallic
    f90 = specular * (1 - metallic) + metallic
    schlick = (1 - h @ wo) ** 5
    coat = f0 @ LUMINANCE * (1 - schlick) + f90 * schlick
    below = (1 - metallic) * base * LUMINANCE  # Fresnel takes from Lambert channel by channel
    diffuse = below.sum() - below @ f0 * (1 - schlick) - below.sum() * f90 * schlick
    a2 = roughness**4
    d = a2 / (np.pi * (h[..., 0] ** 2 + h[..., 1] ** 2 + a2 * h[..., 2] ** 2) ** 2)
    root = lambda c: np.sqrt(a2 + (1 - a2) * c * c)  # noqa: E731
    visibility = 0.5 / (cos_o * root(cos_i) + cos_i * root(cos_o) + 1e-300)
    return (diffuse / np.pi + coat * d * visibility) * cos_i


def view(cos_o, turn=0.7):
    sin_o = np.sqrt(1 - cos_o**2)
    return np.array([sin_o * np.cos(turn), sin_o * np.sin(turn), cos_o])


def unit(count, rng):
    d = rng.standard_normal((count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def random_triangles(count, size, seed, lowest=-1.0, distance=1.0):
    """Float32 triangles whose corners scatter by ``size`` about a centre at ``distance`` with z above ``lowest``."""
    rng = np.random.default_rng(seed)
    centre = unit(4 * count, rng)
    centre = centre[centre[:, 2] > lowest][:count]
    triangles = centre[:, None] + size * rng.standard_normal((len(centre), 3, 3))
    return (distance * triangles).astype(np.float32).astype(np.float64)


# ---- the cosine integral ----


def test_oracles_agree():
    for size in (0.1, 0.5):
        triangles = random_triangles(100, size, 1, lowest=-0.3)
        wi, solid_angle = triangle_points(triangles, 100)
        summed = (np.maximum(wi[:, :, 2], 0) * solid_angle).sum(axis=1) / np.pi
        assert np.abs(summed - exact_cosine(triangles)).max() < 2e-5


@pytest.mark.parametrize(
    "size, lowest, distance",
    [
        *[(1e-5, 0.01, 1), (1e-3, 0, 1), (0.02, -0.05, 1), (0.05, 0, 1e5), (0.1, 0, 1e-5), (0.3, -0.3, 1), (1, -1, 1)],
        *[(10, -1, 1), (100, -1, 1), (0.3, -1, 1e5), (3, -1, 1e-5)],
    ],
)
def test_triangle_cosine(size, lowest, distance):
    """Two to three digits, but for what rounding takes of large triangles seen from the side."""
    triangles = random_triangles(4000, size, 1, lowest, distance)
    values, expected = cosine_of(triangles), exact_cosine(triangles)
    error = np.abs(values - expected)
    assert (error < 2e-3 * expected + min(2e-5 * size**2, 4e-6)).all()
    above = triangles[:, :, 2].max(axis=1) > 0
    seen = above & (expected > 1e-3 * min(size, 1) ** 2)
    assert seen.sum() > 1000 and np.quantile(error[seen] / expected[seen], 0.99) < 1e-3
    assert (values[above] > 0).all() and not values[~above].any()
    assert values.max() <= 1


def test_every_kind_of_clipping_occurs_and_order_does_not_matter():
    triangles = random_triangles(4000, 1.0, 2)
    above = (triangles[:, :, 2] > 0).sum(axis=1)
    expected = exact_cosine(triangles)
    for count in (0, 1, 2, 3):
        chosen = above == count
        assert chosen.sum() > 200
        for order in ((0, 1, 2), (1, 2, 0), (2, 0, 1), (0, 2, 1), (2, 1, 0), (1, 0, 2)):
            values = cosine_of(triangles[chosen][:, order])
            assert (np.abs(values - expected[chosen]) < 1e-3 * expected[chosen] + 4e-6).all()


def test_rotation_and_subdivision():
    triangles = random_triangles(3000, 0.5, 3, lowest=-0.5)
    whole = cosine_of(triangles)
    turn = 1.1
    rotation = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    assert np.abs(cosine_of(triangles @ rotation) - whole).max() < 5e-6
    inside = (triangles * [[0.2], [0.3], [0.5]]).sum(axis=1)
    parts = 0
    for i in range(3):
        part = triangles.copy()
        part[:, i] = inside
        parts = parts + cosine_of(part)
    assert (np.abs(parts - whole) < 1e-3 * whole + 1e-5).all()


OCTANTS = np.array([[[x, 0, 0], [0, y, 0], [0, 0, 1]] for x in (-1.0, 1.0) for y in (-1.0, 1.0)])
"""Triangles that cover the hemisphere."""


def test_closed_forms():
    assert np.abs(cosine_of(OCTANTS) - 0.25).max() < 1e-5
    assert abs(cosine_of(OCTANTS * 1e4).sum() - 1) < 4e-5
    # a small light of area A overhead, at distance r: A / (pi r^2)
    assert np.allclose(cosine_of(np.array([[[0, 0, 3], [0.01, 0, 3], [0, 0.01, 3]]])), 5e-5 / np.pi / 9, rtol=1e-4)
    # a light plane right below its shading point is half of what it sees
    assert np.allclose(cosine_of(np.array([[[-1e4, 0, 1], [1e4, 0, 1], [0, 1e4, 1]]])), 0.5, atol=1e-3)


def test_edge_on_triangles_keep_a_share():
    """Rounding may make nothing of what is seen from the side: its weight ends at a ten-millionth of face on."""
    for size, faces in ((1e-4, 1), (0.01, 1), (0.5, 5)):
        edge_on = np.array([[1, 0, 0.5], [1 + size, 0, 0.5], [1, 0, 0.5 + size]])  # the plane y = 0
        face_on = np.array([[1, 0, 0.5], [1, size, 0.5], [1, 0, 0.5 + size]])
        weak, strong = cosine_of(np.array([edge_on, face_on]))
        assert 1e-8 * strong < weak < 1e-6 * faces * strong


def test_degenerate_triangles_are_finite():
    point, other = [0.3, 0.2, 0.5], [-0.6, 0.1, 0.9]
    cases = [
        [[0, 0, 0], [0, 0, 0], [0, 0, 0]],
        [[0, 0, 0], [1, 0, 1], [0, 1, 1]],  # the shading point on a corner,
        [[-1, 0, 0], [1, 0, 0], [0, 0, 1]],  # on an edge,
        [[-1, 0, -1], [1, 0, -1], [0, 0, 1]],  # inside,
        [point, point, point],
        [point, point, other],
        [point, np.multiply(point, 2), np.multiply(point, 3)],  # all in one direction
        [point, np.multiply(point, -1), other],  # opposite directions
        [[0, 0, 0], point, other],
        [[0, 0, 1e-40], [1, 0, -1e-40], [0, 1, 0]],
        [[1e9, 0, 1], [0, 1e9, 1], [0, 0, 1e9]],
        [[1e-9, 0, 1e-9], [0, 1e-9, 1e-9], [0, 0, 1e-9]],
    ]
    triangles = np.array([np.array(case, np.float64) for case in cases])
    values = cosine_of(triangles)
    assert np.isfinite(values).all() and values.min() >= 0 and values.max() <= 1
    assert (values[triangles[:, :, 2].max(axis=1) > 1e-30] > 0).all() and values[0] == 0
    for material in ((1, 1, 1, 1, 0.0, 1), (*COLOR, 0, 0.5, 1)):
        values, _ = weight_of(material, [0, 0, 1], triangles)
        assert np.isfinite(values).all() and values.min() >= 0


# ---- weights of materials ----


def test_lambert_weights_read_no_table():
    triangles = random_triangles(1000, 0.4, 4, lowest=-0.5)
    wo = view(0.4)
    values, lobes = weight_of((*COLOR, 0, 1, -1), wo, triangles, ltc.LtcTable())
    assert np.allclose(values, (COLOR @ LUMINANCE) * cosine_of(triangles), rtol=1e-6)
    assert not lobes[:, 1].any()
    visible = triangles[triangles[:, :, 2].min(axis=1) > 0][:100]
    wi, solid_angle = triangle_points(visible, 60)
    expected = (reflected((*COLOR, 0, 1, -1), wo, wi) * solid_angle).sum(axis=1)
    assert np.allclose(weight_of((*COLOR, 0, 1, -1), wo, visible)[0], expected, rtol=2e-3)


def lights(cos_o, roughness, size, seed=3):
    """Triangles above the horizon, [n, 3, 3], half of them anywhere, half in and about the highlight."""
    rng = np.random.default_rng(seed)
    centre = view(cos_o) * [-1, -1, 1] + max(2 * roughness**2, 0.02) * rng.standard_normal((120, 3))
    centre /= np.linalg.norm(centre, axis=1, keepdims=True)
    near = (centre[:, None] + size * rng.standard_normal((120, 3, 3))).astype(np.float32).astype(np.float64)
    triangles = np.concatenate([random_triangles(120, size, seed, lowest=0.0), near])
    return triangles[triangles[:, :, 2].min(axis=1) > 0]


# Limits of the mean error over all lights, in units of their mean, about 1.2 times what was measured: by roughness, for
# views of cosine 0.95, 0.6, 0.3, 0.1, the worst of metal and plastic and of lights of size 0.1 and 0.4.
ERRORS = {
    0.15: (0.008, 0.025, 0.07, 0.11),
    0.3: (0.012, 0.05, 0.19, 0.22),
    0.5: (0.047, 0.1, 0.23, 0.5),
    0.7: (0.053, 0.09, 0.19, 0.26),
    1.0: (0.038, 0.053, 0.085, 0.15),
}


@pytest.mark.parametrize("roughness", ERRORS)
def test_ggx_weights(roughness):
    for cos_o, limit in zip((0.95, 0.6, 0.3, 0.1), ERRORS[roughness], strict=True):
        wo = view(cos_o)
        for size in (0.1, 0.4):
            triangles = lights(cos_o, roughness, size)
            wi, solid_angle = triangle_points(triangles, 60)
            for material in ((1, 1, 1, 1, roughness, 1), (*COLOR, 0, roughness, 1)):
                values, _ = weight_of(material, wo, triangles)
                expected = (reflected(material, wo, wi) * solid_angle).sum(axis=1)
                assert np.abs(values - expected).mean() < limit * expected.mean(), (cos_o, size, material)
                # no light is chosen far more rarely than it should be
                assert (values > 0.02 * expected).all(), (cos_o, size, material)


def test_smooth_lobes_stay_in_the_highlight():
    """The lobe of alpha 0.001 to 0.01 lies where the mirror direction is, between the table's cells too."""
    rng = np.random.default_rng(6)
    for roughness, size in ((0.0316, 0.02), (0.06, 0.06), (0.1, 0.15)):
        for cos_o in rng.uniform(0.2, 1, 20):
            wo = view(cos_o, rng.uniform(0, 6))
            mirror = wo * [-1, -1, 1]
            side = np.cross(mirror, view(0.3, 2.0))
            side /= np.linalg.norm(side)
            corners = [np.cos(a) * side + np.sin(a) * np.cross(mirror, side) for a in (0, 2 * np.pi / 3, 4 * np.pi / 3)]
            values, _ = weight_of((1, 1, 1, 1, roughness, 1), wo, (mirror + size * np.array(corners))[None])
            assert 0.9 < values[0] < 1.001, (roughness, cos_o)


@pytest.mark.parametrize("roughness", [0.1, 0.25, 0.5, 0.8, 1.0])
def test_light_from_everywhere_gives_the_albedo(roughness):
    turn, v = (x.ravel() for x in np.meshgrid(*2 * [(np.arange(500) + 0.5) / 500]))
    for cos_o in (1.0, 0.8, 0.45, 0.15):
        wo = view(cos_o)
        # by half vectors, spread as GGX spreads normals: dense in any lobe
        z2 = (1 - v) / (1 + (roughness**4 - 1) * v)
        s = np.sqrt(1 - z2)
        h = np.stack([s * np.cos(2 * np.pi * turn), s * np.sin(2 * np.pi * turn), np.sqrt(z2)], axis=-1)
        cos_h = h @ wo
        wi = 2 * cos_h[:, None] * h - wo
        density = roughness**4 * h[:, 2] / (np.pi * (s**2 + roughness**4 * z2) ** 2) / (4 * np.maximum(cos_h, 1e-9))
        kept = (cos_h > 0) & (wi[:, 2] > 0)
        for material in ((1, 1, 1, 1, roughness, 1), (1, 0.6, 0.3, 1, roughness, 1), (0, 0, 0, 0, roughness, 1)):
            expected = (reflected(material, wo, wi[kept]) / density[kept]).sum() / len(h)
            total = weight_of(material, wo, OCTANTS)[0].sum()
            assert abs(total - expected) < 0.012 * expected + 1e-3, (cos_o, material)
        if roughness >= 0.5:  # plastic, by cosine-weighted directions
            r = np.sqrt(v)
            wi = np.stack([r * np.cos(2 * np.pi * turn), r * np.sin(2 * np.pi * turn), np.sqrt(1 - v)], axis=-1)
            expected = np.mean(reflected((*COLOR, 0, roughness, 1), wo, wi) * np.pi / wi[:, 2])
            assert abs(weight_of((*COLOR, 0, roughness, 1), wo, OCTANTS)[0].sum() - expected) < 0.005, cos_o


def test_weights_turn_with_the_view():
    triangles = random_triangles(500, 0.4, 8, lowest=0.1)
    turn = 2.3
    rotation = np.array([[np.cos(turn), np.sin(turn), 0], [-np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    material = (*COLOR, 1, 0.4, 1)
    values, _ = weight_of(material, view(0.5, 0.2), triangles)
    turned, _ = weight_of(material, view(0.5, 0.2) @ rotation, triangles @ rotation)
    assert np.allclose(values, turned, rtol=1e-3, atol=1e-5)


def test_nothing_comes_from_below():
    above = random_triangles(1000, 0.2, 9, lowest=0.3)
    below = above * [1, 1, -1]
    for material in ((*COLOR, 0, 1, -1), (*COLOR, 0, 0.3, 1), (1, 1, 1, 1, 0.05, 1), (1, 1, 1, 1, 1.0, 1)):
        for cos_o in (1.0, 0.4, 0.02):
            values, _ = weight_of(material, view(cos_o), below)
            assert (values[below[:, :, 2].max(axis=1) <= 0] == 0).all()
            values, _ = weight_of(material, view(cos_o), above)
            assert (values > 0).all()
        values, _ = weight_of(material, view(-0.3), above)
        assert (values == 0).all()


# ---- the table ----


@cache
def fit():
    spec = importlib.util.spec_from_file_location("fit_ltc", ROOT / "assets" / "fit_ltc.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_table_is_physical():
    table = ltc_table(device())
    assert ltc_table(device()) is table
    size = table.size
    m = table.matrices.numpy().reshape(size, size, 4).astype(np.float64)
    amplitudes = table.amplitudes.numpy().reshape(size, size, 2).astype(np.float64)
    assert np.isfinite(m).all() and np.abs(m).max() < 2
    determinant = m[:, :, 0] * m[:, :, 3] - m[:, :, 1] * m[:, :, 2]
    assert determinant.min() > 1e-7
    assert np.abs(np.diff(m, axis=0)).max() < 0.15 and np.abs(np.diff(m, axis=1)).max() < 0.15
    assert amplitudes.min() >= 0
    assert (amplitudes.sum(axis=2) < 1.001).all()  # without Fresnel a lobe reflects no more than it gets
    assert (amplitudes[:3, 0, 0] > 0.99).all() and amplitudes[-1, 0].sum() < 0.35
    assert np.allclose(amplitudes[:, 0, 1], 0, atol=1e-3)  # looking along the normal all is f0
    assert fit().SMALLEST_ALPHA == pytest.approx(float(SMALLEST_ALPHA))


def test_every_view_and_roughness_has_a_lobe():
    rng = np.random.default_rng(10)
    above = random_triangles(400, 0.3, 11, lowest=0.2)
    above = above[above[:, :, 2].min(axis=1) > 0]
    cosines_o = np.concatenate([[1.0, 1e-3, 1e-6], rng.uniform(0, 1, len(above) - 3)])
    views = np.array([view(c, t) for c, t in zip(cosines_o, rng.uniform(0, 6, len(above)), strict=True)])
    for roughness in (0.0, 0.02, 0.04, 0.1, 0.5, 0.99, 1.0):
        values, lobes = weight_of((1, 1, 1, 1, roughness, 1), views, above)
        assert np.isfinite(values).all() and (values > 0).all()
        assert (lobes[:, 2] > 0).all()
        assert (lobes[:, :2].sum(axis=1) < 1.001).all() and (lobes[:, :2] >= 0).all()


@pytest.mark.parametrize("row", [pytest.param(r, marks=pytest.mark.slow) for r in (0, 1, 5, 12, 20)] + [31])
def test_the_table_is_what_its_script_fits(row):
    table = ltc_table(device())
    matrices, amplitudes = fit().fit_row(row, table.size)
    rows = slice(row * table.size, (row + 1) * table.size)
    assert np.allclose(matrices, table.matrices.numpy()[rows], atol=1e-3)
    assert np.allclose(amplitudes, table.amplitudes.numpy()[rows], atol=1e-3)
