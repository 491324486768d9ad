"""Every estimator of the registry in every scene whose light is known: what each claims decides how it is tested."""

from __future__ import annotations

import numpy as np
import pytest
import statistics_tools as st
from scene_tools import light, quad
from statistics_tools import every_device  # noqa: F401
from truth_tools import CASES, Case, cube_light, lit_by, quarter_form_factor, sky_nodes

import warp_gi as gi
from warp_gi import registry
from warp_gi.pipeline import made

LEARNING, FRAMES = 4, 12
"""Frames that estimators may learn in, and those that count."""
CLAIMS = {f"{name}-{variant}" if variant else name: (name, claim) for name, variant, claim in registry.claims()}


def known(estimator: gi.Estimator) -> dict[str, Case]:
    """Return the cases that say what the term of an estimator is."""
    return {name: make() for name, make in CASES.items() if estimator.term in make().terms}


def estimator_of(label: str, **settings: object) -> gi.Estimator:
    name, claim = CLAIMS[label]
    return tracing(made((name, {**claim.settings, **settings})))


def tracing(one: gi.Estimator | gi.RadianceCache) -> gi.Estimator:
    """Return an estimator itself, and for a radiance cache paths that end in it."""
    return one if isinstance(one, gi.Estimator) else gi.BsdfPaths(ends_in=one)


def pictures(case: Case, estimator: gi.Estimator) -> dict[str, np.ndarray]:
    """Return frames of an estimator's term, float64 [frame, height, width, 3]; paths use its lights where both terms
    are known."""
    terms = dict.fromkeys(("environment", "emitters", "indirect")) | {estimator.term: estimator}
    if estimator.term == "emitters" and "indirect" in case.terms:
        terms["indirect"] = gi.BsdfPaths()
    pipeline = gi.Pipeline(**terms, spp=case.spp)
    path, numbers = gi.CameraPath.still(case.camera), range(LEARNING + FRAMES)
    found: dict[str, list[np.ndarray]] = {term: [] for term, one in terms.items() if one is not None}
    for frame in gi.render(case.make(), path, pipeline, frames=numbers, device=st._device, seed=3):
        if frame.index >= LEARNING:
            for term, images in found.items():
                images.append(frame.numpy(term).astype(np.float64))
    return {term: np.stack(images) for term, images in found.items()}


def mean_of(truth: np.ndarray) -> np.ndarray:
    return truth.reshape(-1, 3).mean(axis=0)


def error_of_mean(truth: np.ndarray, images: np.ndarray) -> float:
    """Return the largest relative error of the three means of a picture, less what noise may make of it."""
    mean, variance = st.mean_and_variance(images.mean(axis=(1, 2)))
    noise = 4.0 * np.sqrt(variance / mean_of(truth) ** 2).max()
    return max(float(np.abs(mean / mean_of(truth) - 1.0).max() - noise), 0.0)


def error_of_pixels(truth: np.ndarray, images: np.ndarray) -> float:
    """Return the root mean square of the relative error: over pixels where each has its truth, else of the mean."""
    image = images.mean(axis=0) if truth.ndim == 3 else images.mean(axis=(0, 1, 2))
    return float(np.sqrt(np.mean((image / truth - 1.0) ** 2)))


def check_bound(label: str, estimator: gi.Estimator, bound: float) -> None:
    for name, case in known(estimator).items():
        for term, images in pictures(case, estimator).items():
            error = error_of_mean(case.terms[term], images)
            assert error <= bound, f"{label} in {name!r}, {term}: off by {error:.2%}, claimed is {bound:.2%}"


@pytest.mark.parametrize("label", CLAIMS)
def test_pictures_are_as_true_as_claimed(label):
    """Unbiased: no mean is further off than chance allows. Biased: none by more than the bound."""
    claim, estimator = CLAIMS[label][1], estimator_of(label)
    assert known(estimator), f"no scene says what the {estimator.term} are"
    if not claim.unbiased:
        return check_bound(label, estimator, claim.bound)
    for name, case in known(estimator).items():
        for term, images in pictures(case, estimator).items():
            try:
                st.assert_mean(images, mean_of(case.terms[term]), tolerance=case.tolerance)
            except AssertionError as error:
                raise AssertionError(f"{label} in {name!r}, {term}: {error}") from None


@pytest.mark.slow
@pytest.mark.parametrize("label", [label for label, (_, claim) in CLAIMS.items() if not claim.unbiased])
def test_bounds_hold_at_default_resolution(label):
    """Settings of a claim that say no more than how fine a bake is are left out."""
    name, claim = CLAIMS[label]
    sizes = {key for other, one in CLAIMS.values() if other == name for settings in one.resolution for key in settings}
    kept = {key: value for key, value in claim.settings.items() if key not in sizes}
    check_bound(label, tracing(registry.find(name)(**kept)), claim.bound)


@pytest.mark.parametrize("label", [label for label, (_, claim) in CLAIMS.items() if claim.resolution])
def test_errors_fall_with_resolution(label):
    """Where a coarse bake is wrong, each finer one is nearer to the truth, and the last by far."""
    term = estimator_of(label).term
    errors = []
    for settings in CLAIMS[label][1].resolution:
        estimator = estimator_of(label, **settings)
        hard = [case for case in known(estimator).values() if term in case.coarse]
        errors.append([error_of_pixels(case.terms[term], pictures(case, estimator)[term]) for case in hard])
    total = np.sqrt(np.mean(np.square(errors), axis=1))
    assert (np.diff(total) < 0).all() and total[-1] < total[0] / 2, errors


def test_the_sums_have_converged():
    """The numbers of the table agree with closed forms where there are some."""
    lamp = quad((0, 1.0, 0), (0.5, 0, 0), (0, 0, 0.7), light((3.0, 2.0, 1.0)))
    truth = np.array([0.8, 0.5, 0.2]) * [3.0, 2.0, 1.0] * quarter_form_factor(0.5, 0.7)
    np.testing.assert_allclose(lit_by([lamp], "lambert", (0, 1, 0)), truth, rtol=1e-6)
    directions, solid = sky_nodes()
    np.testing.assert_allclose((directions[:, 1:2] * solid).sum(), np.pi, rtol=1e-9)
    coarse, fine = (cube_light(0.5, parts, np.array([[0.0, -1.0, 0.0]]))[:, 0] for parts in (4, 8))
    np.testing.assert_allclose(fine[0], 0.5 * 4 * quarter_form_factor(0.5, 0.5), rtol=1e-9)
    np.testing.assert_allclose(fine[1] + (fine[1] - coarse[1]) / (2**1.5 - 1), 0.077877, rtol=2e-4)  # of 32 parts
