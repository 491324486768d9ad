"""The BSDF against formulas written anew in float64, its sampling against its density, its energy against 1."""

from __future__ import annotations

import numpy as np
import pytest
import statistics_tools as st
import warp as wp
from statistics_tools import every_device  # noqa: F401
from truth_tools import MATERIALS, albedo, gltf, unit

from warp_gi.kernels.bsdf import average_reflectance, average_specular, bsdf_evaluate, bsdf_sample, make_bsdf
from warp_gi.kernels.sampling import cosine_direction, sample_1d, sample_2d, triangle_barycentrics
from warp_gi.launch import launch

wp.set_module_options({"enable_backward": False})

VIEWS = {"normal": (0.0, 0.0, 1.0), "oblique": (0.6, 0.2, 0.77), "grazing": (-0.3, 0.94, 0.15)}


# Thread: one pair of directions. f * cos and pdf.
@wp.kernel
def evaluate_bsdf(
    first: wp.int32,
    material: wp.array(dtype=wp.float32),
    wo: wp.array(dtype=wp.vec3),
    wi: wp.array(dtype=wp.vec3),
    value: wp.array(dtype=wp.vec4),
):
    i = first + wp.tid()
    b = make_bsdf(wp.vec3(material[0], material[1], material[2]), material[3], material[4], material[5])
    r = bsdf_evaluate(b, wo[i], wi[i])
    value[i] = wp.vec4(r.value[0], r.value[1], r.value[2], r.pdf)


# Thread: one sample, numbered i of the sequence, or the first of sequence i.
@wp.kernel
def sample_bsdf(
    first: wp.int32,
    material: wp.array(dtype=wp.float32),
    wo: wp.vec3,
    wi: wp.array(dtype=wp.vec3),
    weight: wp.array(dtype=wp.vec4),
):
    i = first + wp.tid()
    b = make_bsdf(wp.vec3(material[0], material[1], material[2]), material[3], material[4], material[5])
    seed = wp.uint32(i * 2 + 1)
    r = bsdf_sample(b, wo, sample_1d(wp.uint32(0), seed, 0), sample_2d(wp.uint32(0), seed, 1))
    wi[i] = r.wi
    weight[i] = wp.vec4(r.weight[0], r.weight[1], r.weight[2], r.pdf)


# Thread: one sample from a direction of its own, which is cosine-distributed. What it weighs.
@wp.kernel
def reflect_all(first: wp.int32, material: wp.array(dtype=wp.float32), weight: wp.array(dtype=wp.vec3)):
    i = wp.uint32(first + wp.tid())
    b = make_bsdf(wp.vec3(material[0], material[1], material[2]), material[3], material[4], material[5])
    wo = cosine_direction(sample_2d(i, wp.uint32(11), 0))
    r = bsdf_sample(b, wo, sample_1d(i, wp.uint32(11), 1), sample_2d(i, wp.uint32(11), 2))
    weight[first + wp.tid()] = r.weight


@wp.kernel
def ask_average(first: wp.int32, material: wp.array(dtype=wp.float32), out: wp.array(dtype=wp.vec3)):
    b = make_bsdf(wp.vec3(material[0], material[1], material[2]), material[3], material[4], material[5])
    out[0] = average_specular(b)
    out[1] = average_reflectance(b)


# Thread: one point of the sequence `seeds[i]`, and its warps.
@wp.kernel
def sample_warps(
    first: wp.int32,
    indices: wp.array(dtype=wp.uint32),
    seeds: wp.array(dtype=wp.uint32),
    square: wp.array(dtype=wp.vec2),
    cosine: wp.array(dtype=wp.vec3),
    triangle: wp.array(dtype=wp.vec2),
):
    i = first + wp.tid()
    u = sample_2d(indices[i], seeds[i], 3)
    square[i] = u
    cosine[i] = cosine_direction(u)
    triangle[i] = triangle_barycentrics(u)


def parameters(name: str) -> np.ndarray:
    base, *rest = MATERIALS[name]
    return np.array([*base, *rest], dtype=np.float32)


def evaluate(name: str, wo: np.ndarray, wi: np.ndarray) -> np.ndarray:
    """Return f * cos and pdf, float32 [n, 4], from the kernel."""
    wo, wi = (np.ascontiguousarray(np.broadcast_to(d, wi.shape), dtype=np.float32) for d in (wo, wi))
    out = wp.empty(len(wi), dtype=wp.vec4, device=st.device())
    arrays = [wp.array(parameters(name), dtype=wp.float32, device=st.device())]
    arrays += [wp.array(d, dtype=wp.vec3, device=st.device()) for d in (wo, wi)]
    launch(evaluate_bsdf, len(wi), [*arrays, out], st.device())
    return out.numpy()


def sample(name: str, wo: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return directions [n, 3] and weights with pdf [n, 4]; a failed sample is all zero."""
    wi, weight = wp.empty(count, dtype=wp.vec3, device=st.device()), wp.empty(count, dtype=wp.vec4, device=st.device())
    material = wp.array(parameters(name), dtype=wp.float32, device=st.device())
    launch(sample_bsdf, count, [material, wp.vec3(*wo), wi, weight], st.device())
    weight = weight.numpy()
    return np.where(weight[:, 3:] > 0, wi.numpy(), 0.0), weight


@pytest.mark.parametrize("name", MATERIALS)
def test_value_is_what_gltf_defines_and_is_reciprocal(name):
    rng = np.random.default_rng(1)
    wo, wi = unit(rng.normal(size=(2, 4000, 3)))
    wo[:, 2] = np.abs(wo[:, 2])
    value = evaluate(name, wo, wi)
    expected = gltf(name, wo, wi)
    assert np.abs(value[:, :3] - expected).max() < 2e-4 * max(expected.max(), 1.0)
    assert (value[wi[:, 2] <= 0] == 0).all()
    assert (evaluate(name, wo * [1, 1, -1], wi) == 0).all()
    upper = np.stack([wi[:, 0], wi[:, 1], np.abs(wi[:, 2])], axis=-1)
    there, back = evaluate(name, wo, upper)[:, :3] / upper[:, 2:], evaluate(name, upper, wo)[:, :3] / wo[:, 2:]
    assert np.allclose(there, back, rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("name", MATERIALS)
def test_sampling_follows_its_density(name, view):
    count = 100_000
    wo = unit(VIEWS[view])
    directions, weight = sample(name, wo, count)
    expected = st.sphere_expectation(lambda d: evaluate(name, wo, d)[:, 3], count, 24, 24, 40)
    p = st.chi_squared(st.sphere_histogram(directions, 24, 24), expected, total=count)
    assert p > 1e-4, f"p = {p:.1e}"
    kept = weight[:, 3] > 0
    again = evaluate(name, wo, directions[kept])  # what the sample says of itself is what evaluation says of it
    assert np.allclose(weight[kept, 3], again[:, 3], rtol=2e-2)
    assert np.allclose(weight[kept, :3] * weight[kept, 3:], again[:, :3], rtol=2e-2, atol=1e-6)


@pytest.mark.parametrize("view", VIEWS)
@pytest.mark.parametrize("name", MATERIALS)
def test_mean_weight_is_the_directional_albedo(name, view):
    wo = unit(VIEWS[view])
    weight = sample(name, wo, 100_000)[1][:, :3].astype(np.float64)
    expected = albedo(name, wo)
    test = st.z_test(weight.mean(0), weight.var(0) / len(weight), expected, np.full(3, (3e-4) ** 2), alpha=1e-4)
    assert test.passed, f"{weight.mean(0)} against {expected}, p = {test.p_min:.1e}"
    if MATERIALS[name][1] == 1.0 or MATERIALS[name][3] == 0.0:
        assert (
            expected <= 1.0 + 1e-3
        ).all()  # glTF's coated Lambert alone may gain: its 1 - F depends on the half vector


def test_lambert_loses_nothing_and_smooth_white_metal_little():
    for view in VIEWS.values():
        assert (albedo("smooth_metal", unit(view)) > 0.93).all()  # the rest is shadowed: GGX has no second bounce
        weight = sample("lambert", unit(view), 1000)[1]
        assert np.allclose(weight[:, :3], MATERIALS["lambert"][0], rtol=1e-6)


def warps(indices: np.ndarray, seeds: np.ndarray) -> list[np.ndarray]:
    count = len(indices)
    inputs = [wp.array(x.astype(np.uint32), dtype=wp.uint32, device=st.device()) for x in (indices, seeds)]
    outputs = [wp.empty(count, dtype=t, device=st.device()) for t in (wp.vec2, wp.vec3, wp.vec2)]
    launch(sample_warps, count, [*inputs, *outputs], st.device())
    return [x.numpy() for x in outputs]


def test_warps_follow_their_densities():
    count = 200_000
    square, cosine, triangle = warps(np.zeros(count), np.arange(count) * 7 + 5)
    flat = np.full(256, count / 256)
    assert st.chi_squared(np.histogram2d(*square.T, bins=16, range=[[0, 1]] * 2)[0], flat) > 1e-4
    expected = st.sphere_expectation(lambda d: np.maximum(d[:, 2], 0) / np.pi, count)
    assert st.chi_squared(st.sphere_histogram(cosine), expected, total=count) > 1e-4
    # uniform over the triangle: of all points, k^2 / 64 lie within k/8 of the first corner; no weight is preferred
    for weight in (triangle[:, 0], triangle[:, 1], 1 - triangle.sum(axis=1)):
        assert weight.min() > -1e-6
        cells = np.histogram(weight, bins=8, range=(0, 1))[0]
        assert st.chi_squared(cells, count * -np.diff((1 - np.arange(9) / 8) ** 2)) > 1e-4


def test_sequence_is_a_net():
    """Any aligned run of 2^m samples has one in every elementary interval of area 2^-m."""
    for start, m, seed in ((0, 8, 1), (256, 8, 1), (4096, 10, 77)):
        points = warps(start + np.arange(2**m), np.full(2**m, seed))[0]
        for a in range(m + 1):
            cells = (points[:, 0] * 2**a).astype(int) * 2 ** (m - a) + (points[:, 1] * 2 ** (m - a)).astype(int)
            assert (np.bincount(cells, minlength=2**m) == 1).all()


# ---- averages over all directions ----


def averages(base: tuple, metallic: float, roughness: float, specular: float) -> np.ndarray:
    """Return what the glossy lobe, and what all of the material is said to reflect, float64 [2, 3]."""
    material = np.array([*base, metallic, roughness, specular], np.float32)
    out = wp.empty(2, dtype=wp.vec3, device=st.device())
    launch(ask_average, 1, [wp.array(material, dtype=wp.float32, device=st.device()), out], st.device())
    return out.numpy().astype(np.float64)


@pytest.mark.parametrize("roughness", [0.03, 0.1, 0.3, 0.5, 0.7, 0.85, 1.0])
@pytest.mark.parametrize(
    "base, metallic, specular", [((0, 0.3, 1), 0.0, 1.0), ((0.9, 0.6, 0.3), 1.0, 1.0), ((0.2, 0.9, 0.5), 0.4, 0.5)]
)
def test_average_reflectance_is_the_mean_of_samples(base, metallic, specular, roughness):
    """Light from everywhere, seen from everywhere: the mean weight of samples from cosine-distributed directions."""
    count = 1 << 18
    material = wp.array(np.array([*base, metallic, roughness, specular], np.float32), device=st.device())
    weight = wp.empty(count, dtype=wp.vec3, device=st.device())
    launch(reflect_all, count, [material, weight], st.device())
    reflected = weight.numpy().astype(np.float64).mean(axis=0)
    np.testing.assert_allclose(averages(base, metallic, roughness, specular)[1], reflected, atol=0.003)


@pytest.mark.parametrize(
    "roughness, albedo", [(0.03, 0.086), (0.28, 0.075), (0.53, 0.050), (0.72, 0.035), (0.9, 0.024)]
)
def test_the_coat_of_rough_dielectrics_reflects_less_than_a_mirror(roughness, albedo):
    """Directional albedo of GGX with f0 = 0.04, averaged by cosine; integrated apart, to three digits."""
    np.testing.assert_allclose(averages((0, 0, 0), 0.0, roughness, 1.0)[0], albedo, atol=0.0012)
