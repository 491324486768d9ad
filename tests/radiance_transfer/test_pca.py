"""Bounces in fewer numbers: against the singular values, its error as stated, and what sees nothing."""

from __future__ import annotations

import numpy as np
import pytest
from transfer_bake_tools import court, slow_bake

from warp_gi.errors import OptionError
from warp_gi.scene import harmonics
from warp_gi.techniques.radiance_transfer import pca
from warp_gi.techniques.radiance_transfer.pca import compress_bounces, example_skies, expand_bounces


@pytest.fixture(scope="module")
def bounces():
    return slow_bake(court(), rays=256, resolution=48).bounces


def by_singular_values(rows, components):
    """Return the best approximation of rows [n, 75] by so many components, float64, from NumPy's own SVD."""
    u, s, v = np.linalg.svd(rows.astype(np.float64), full_matrices=False)
    return (u[:, :components] * s[:components]) @ v[:components]


@pytest.mark.parametrize("components", [1, 4, 16])
def test_components_are_the_best_there_are(bounces, components):
    found = compress_bounces(bounces, components)
    seeing = bounces.reshape(-1, 75).any(axis=1)
    values = expand_bounces(found.basis, found.coefficients)[seeing].reshape(-1, 75)
    rows = bounces.reshape(-1, 75)[seeing].astype(np.float64)
    best = by_singular_values(rows, components)
    assert np.abs(values - best).max() < 2e-3 * np.abs(rows).max()  # halves of coefficients
    assert np.linalg.norm(values - rows) < 1.002 * np.linalg.norm(best - rows)
    np.testing.assert_allclose(found.basis @ found.basis.T, np.eye(components), atol=1e-5)
    assert found.coefficients.dtype == np.float16 and found.coefficients.shape == (len(bounces), components)


def test_all_components_are_exact_to_a_half(bounces):
    found = compress_bounces(bounces, 75)
    values = expand_bounces(found.basis, found.coefficients)
    np.testing.assert_allclose(values, bounces.astype(np.float32), atol=1e-3 * np.abs(bounces).max())
    assert found.error < 1e-3


def test_the_error_is_that_of_the_reflected_light(bounces):
    """Written out: RMS over all colours and slots that see anything, over the mean; then the mean over skies."""
    found = compress_bounces(bounces, 8)
    seeing = bounces.reshape(-1, 75).any(axis=1)
    values = expand_bounces(found.basis, found.coefficients)[seeing].astype(np.float64)
    errors = []
    for sky in example_skies():
        true = (bounces[seeing].astype(np.float64) * sky).sum(axis=2)
        errors.append(np.sqrt((((values * sky).sum(axis=2) - true) ** 2).mean()) / true.mean())
    assert found.error == pytest.approx(np.mean(errors), rel=1e-6)


def test_error_falls_and_is_small_at_sixteen(bounces):
    errors = [compress_bounces(bounces, count).error for count in (4, 8, 16, 24)]
    assert errors == sorted(errors, reverse=True) and errors[2] < 0.06, errors


def test_slots_that_see_nothing_do_not_count(bounces):
    """They change neither components nor error, however many there are; and they come back as nothing."""
    padded = np.concatenate([np.zeros((5 * len(bounces), 3, 25), np.float16), bounces])
    alone, found = compress_bounces(bounces, 12), compress_bounces(padded, 12)
    np.testing.assert_allclose(found.basis, alone.basis, atol=1e-4)
    assert found.error == pytest.approx(alone.error, rel=1e-3)
    back = expand_bounces(found.basis, found.coefficients[: len(bounces)])
    assert not back.any()


def test_blocks_do_not_matter(bounces, monkeypatch):
    whole = compress_bounces(bounces, 6)
    monkeypatch.setattr(pca, "BLOCK", 100)
    parts = compress_bounces(bounces, 6)
    np.testing.assert_allclose(parts.basis, whole.basis, atol=1e-5)
    assert parts.error == pytest.approx(whole.error, rel=1e-3)


def test_skies_have_something_in_every_band():
    """RMS of a band's coefficients over that of band 0; of photographed skies about 1, .5, .5, .3, .4."""
    skies = example_skies()
    skies = skies / skies[:, :, :1].mean(axis=1, keepdims=True)
    strengths = [np.sqrt((skies[..., l * l : (l + 1) ** 2] ** 2).mean()) for l in range(5)]
    assert strengths[0] == pytest.approx(1, abs=0.05) and all(0.15 < one < 0.55 for one in strengths[1:]), strengths
    directions, _ = harmonics.sphere(40)
    assert (harmonics.basis(directions, 5) @ skies[1].T).argmax(axis=0) == pytest.approx(np.argmax(directions[:, 1]))


@pytest.mark.parametrize("components", [0, 76, 2.5, True])
def test_a_count_out_of_range_is_one_line(bounces, components):
    with pytest.raises(OptionError, match="components must be a whole number from 1 to 75"):
        compress_bounces(bounces, components)


def test_no_bounces_are_one_line():
    with pytest.raises(OptionError, match="no bounces to compress"):
        compress_bounces(np.zeros((0, 3, 25), np.float16), 4)


def test_all_black_is_all_zero():
    found = compress_bounces(np.zeros((50, 3, 25), np.float16), 4)
    assert not expand_bounces(found.basis, found.coefficients).any() and found.error == 0.0
