"""The statistical tools themselves: they accept what is equal and reject what is not."""

from __future__ import annotations

import numpy as np
import pytest
import statistics_tools as st


def _pictures(rng: np.random.Generator, seeds: int, scale: float = 1.0) -> np.ndarray:
    truth = np.linspace(0.2, 2.0, 40 * 64 * 3).reshape(40, 64, 3)
    return scale * truth * rng.gamma(64.0, 1.0 / 64.0, size=(seeds, *truth.shape))


def test_equal_pictures_pass_and_a_small_bias_fails(tmp_path, monkeypatch):
    monkeypatch.setattr(st, "ARTIFACTS", tmp_path)
    rng = np.random.default_rng(1)
    reference = st.mean_and_variance(_pictures(rng, 200))
    st.compare_images("equal", _pictures(rng, 16), *reference, reference_dof=199)
    assert not list(tmp_path.iterdir())
    with pytest.raises(AssertionError, match="whole"):  # 0.5 % of bias under 3 % of noise a pixel
        st.compare_images("biased", _pictures(rng, 16, scale=1.005), *reference, reference_dof=199)
    assert (tmp_path / "biased_p_values.png").stat().st_size > 100


def test_one_wrong_pixel_fails(tmp_path, monkeypatch):
    monkeypatch.setattr(st, "ARTIFACTS", tmp_path)
    rng = np.random.default_rng(2)
    images = _pictures(rng, 16)
    images[:, 7, 11] *= 1.5
    with pytest.raises(AssertionError):
        st.compare_images("pixel", images, *st.mean_and_variance(_pictures(rng, 200)), reference_dof=199)


def test_z_test_rejects_at_its_own_rate():
    rng = np.random.default_rng(3)
    rejected = 0
    for _ in range(400):
        a, b = rng.normal(size=(8, 50)), rng.normal(size=(12, 50))
        test = st.z_test(*st.mean_and_variance(a), *st.mean_and_variance(b), alpha=0.1, dof_a=7, dof_b=11)
        rejected += not test.passed
    assert 15 <= rejected <= 70  # expects 40


def test_chi_squared():
    rng = np.random.default_rng(4)
    expected = np.concatenate([np.full(100, 50.0), np.full(100, 0.5)])
    p = [st.chi_squared(rng.poisson(expected), expected) for _ in range(200)]
    assert 0.4 < np.mean(p) < 0.6
    assert st.chi_squared(rng.poisson(expected * np.linspace(0.8, 1.2, 200)), expected) < 1e-3
    assert st.chi_squared(np.array([1, 99]), np.array([0.0, 100.0])) == 0.0
    assert st.chi_squared(np.array([40, 40]), np.array([40.0, 40.0]), total=100) > 0.9
    assert st.chi_squared(np.array([50, 50]), np.array([40.0, 40.0]), total=100) < 1e-3


def test_sphere_histogram_follows_the_density_it_was_drawn_from():
    rng = np.random.default_rng(5)
    z, phi = np.sqrt(rng.random(200_000)), 2 * np.pi * rng.random(200_000)
    directions = np.stack([np.sqrt(1 - z * z) * np.cos(phi), np.sqrt(1 - z * z) * np.sin(phi), z], axis=-1)
    counts = st.sphere_histogram(directions)
    expected = st.sphere_expectation(lambda d: np.maximum(d[:, 2], 0) / np.pi, len(directions))
    assert expected.sum() == pytest.approx(len(directions), rel=1e-6)
    assert st.chi_squared(counts, expected, total=len(directions)) > 1e-3
    wrong = st.sphere_expectation(lambda d: (d[:, 2] > 0) / (2 * np.pi), len(directions))
    assert st.chi_squared(counts, wrong, total=len(directions)) < 1e-6
