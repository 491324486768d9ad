"""Tests of hypotheses for pictures and samplers, and what they leave behind when they fail.

Pictures: two unbiased renderings with known variances must differ by no more
than chance allows, pixel by pixel (`z_test`), in tiles and as a whole
(`compare_images`). Samplers: counts in cells must follow the integrated density
(`chi_squared`, `sphere_histogram`, `sphere_expectation`).
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from scipy import stats

ARTIFACTS = Path(os.environ.get("WARP_GI_ARTIFACTS", Path(__file__).parents[1] / "out" / "test_artifacts"))
"""Where failed tests leave pictures; the folder is ignored by git."""

_device = "cpu"


@pytest.fixture(params=["cpu", "cuda"] if wp.is_cuda_available() else ["cpu"], autouse=True)
def every_device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Run each test of a module that imports this fixture on the CPU, and on CUDA where there is a GPU."""
    monkeypatch.setattr(f"{__name__}._device", request.param)


def device() -> wp.Device:
    """Return the device of the running test."""
    return wp.get_device(_device)


@dataclass(frozen=True)
class ZTest:
    """Result of `z_test`."""

    p: np.ndarray
    """Two-sided p-value of each value, of the shape of the means."""
    p_limit: float
    """The Šidák-corrected limit: the test fails when any p is below it."""

    @property
    def p_min(self) -> float:
        return float(self.p.min())

    @property
    def passed(self) -> bool:
        return self.p_min >= self.p_limit


def mean_and_variance(images: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean of ``images`` [seed, ...] and the variance of that mean, from their scatter."""
    images = np.asarray(images, dtype=np.float64)
    return images.mean(axis=0), images.var(axis=0, ddof=1) / len(images)


def z_test(
    mean_a: np.ndarray,
    var_a: np.ndarray,
    mean_b: np.ndarray,
    var_b: np.ndarray,
    alpha: float = 0.01,
    dof_a: float | np.ndarray = np.inf,
    dof_b: float | np.ndarray = np.inf,
) -> ZTest:
    """Test whether two arrays of means are equal, given the variance of each mean.

    ``alpha`` is the chance to reject equal arrays as a whole; the limit of one value
    is corrected for their number after Šidák. ``dof_a`` and ``dof_b`` are the degrees
    of freedom the variances were measured with (images - 1), and turn the normal
    distribution into Student's t after Welch and Satterthwaite.
    """
    mean_a, var_a, mean_b, var_b = (np.asarray(x, dtype=np.float64) for x in (mean_a, var_a, mean_b, var_b))
    difference = np.abs(mean_a - mean_b)
    variance = var_a + var_b
    floor = 1e-5 * np.maximum(np.abs(mean_a), np.abs(mean_b)) + 1e-9  # float32 rounding of either side
    statistic = difference / np.sqrt(variance + floor**2)
    inverse_dof = ((var_a**2 / dof_a) + (var_b**2 / dof_b)) / np.maximum(variance**2, 1e-300)
    with np.errstate(divide="ignore"):
        dof = np.minimum(1.0 / inverse_dof, 1e9)
    p = 2.0 * stats.t.sf(statistic, dof)
    return ZTest(p=p, p_limit=-np.expm1(np.log1p(-alpha) / p.size))


def tiles(image: np.ndarray, size: int) -> np.ndarray:
    """Return the sums over ``size`` x ``size`` tiles of ``image`` [height, width, channels], without a ragged edge."""
    height, width = image.shape[0] // size, image.shape[1] // size
    cropped = image[: height * size, : width * size]
    return cropped.reshape(height, size, width, size, -1).sum(axis=(1, 3))


def compare_images(
    name: str,
    images: np.ndarray,
    reference: np.ndarray,
    reference_variance: np.ndarray,
    alpha: float = 0.001,
    reference_dof: float = np.inf,
    noise_ratio: float = 0.0,
    systematic: float = 0.0,
) -> str:
    """Raise AssertionError unless ``images`` [seed, height, width, channels] have ``reference`` as expectation.

    Three tests, each at ``alpha``: every pixel, every 8 x 8 tile (more power against
    a small bias), and the mean of the whole picture. On failure the p-values
    of the pixels and both pictures are left in `ARTIFACTS`. Returns a line of figures.

    A pixel that light reaches by rare paths has too small a variance whenever it has too
    small a mean, which no t-test allows for. So the variance of ours is taken to be at least
    ``noise_ratio`` times the reference's: samples of the reference over samples of ours.
    ``systematic`` is the relative standard error of the reference that no sample lessens.
    """
    images = np.asarray(images, dtype=np.float64)
    seeds = len(images)
    tests = {}
    for label, size in (("pixels", 1), ("tiles", 8), ("whole", 0)):
        # tiles and the whole take their variance from their own scatter, so that correlation between pixels counts
        sums = [tiles(x, size) if size else x.sum(axis=(0, 1)) for x in (*images, reference, reference_variance)]
        mean, variance = mean_and_variance(np.stack(sums[:seeds]))
        least = noise_ratio * sums[-1]
        dof = np.where(variance > least, seeds - 1, reference_dof)
        known = sums[-1] + (systematic * sums[-2]) ** 2
        tests[label] = z_test(mean, np.maximum(variance, least), sums[-2], known, alpha, dof, reference_dof)
    mean, variance = mean_and_variance(images)
    sigma = np.sqrt(np.maximum(variance, noise_ratio * reference_variance) + reference_variance)
    line = f"{name}: " + ", ".join(f"{k} p {t.p_min:.1e} (limit {t.p_limit:.1e})" for k, t in tests.items())
    bias, noise = mean.mean() / reference.mean() - 1, sigma.mean() / reference.mean()
    line += f"; mean off by {bias:+.3%}, noise of a pixel {noise:.2%}"
    if all(t.passed for t in tests.values()):
        return line
    path = write_p_values(name, tests["pixels"].p, mean, reference, sigma)
    raise AssertionError(f"{line}; see {path}")


def write_p_values(name: str, p: np.ndarray, image: np.ndarray, reference: np.ndarray, sigma: np.ndarray) -> Path:
    """Write a PNG: both pictures, signed difference in sigmas (red: too bright), p-values (white is 1, black 1e-8)."""
    from PIL import Image

    def tone(x: np.ndarray) -> np.ndarray:
        return np.clip(x / max(float(np.percentile(reference, 98)), 1e-9), 0, 1) ** (1 / 2.2)

    difference = ((image - reference) / np.maximum(sigma, 1e-9)).mean(axis=-1, keepdims=True) / 5.0
    signed = np.concatenate([1 - np.clip(-difference, 0, 1), 1 - np.clip(np.abs(difference), 0, 1)], axis=-1)
    signed = np.concatenate([signed, 1 - np.clip(difference, 0, 1)], axis=-1)
    small = np.clip(1.0 + np.log10(np.maximum(p.min(axis=-1, keepdims=True), 1e-30)) / 8.0, 0, 1).repeat(3, axis=-1)
    rows = np.concatenate(
        [np.concatenate([tone(image), tone(reference)], axis=1), np.concatenate([signed, small], axis=1)], axis=0
    )
    pixels = (np.clip(rows, 0, 1) * 255 + 0.5).astype(np.uint8).repeat(4, axis=0).repeat(4, axis=1)
    ARTIFACTS.mkdir(parents=True, exist_ok=True)
    path = ARTIFACTS / f"{name}_p_values.png"
    Image.fromarray(pixels).save(path)
    return path


def chi_squared(counts: np.ndarray, expected: np.ndarray, total: int | None = None, smallest: float = 10.0) -> float:
    """Return the p-value of Pearson's test that ``counts`` follow ``expected`` (both in samples).

    Cells are pooled in order of their expectation until each pool expects ``smallest``.
    With ``total``, the samples that lie in no cell (rejected ones) are one more cell,
    which expects what the others leave. A count where nothing is expected gives 0.
    """
    counts, expected = np.ravel(counts).astype(np.float64), np.ravel(expected).astype(np.float64)
    if total is not None:
        counts = np.append(counts, total - counts.sum())
        expected = np.append(expected, max(total - expected.sum(), 1e-6 * total))
    if np.any(counts[expected <= 0.0] > 0):
        return 0.0
    observed, wanted = [0.0], [0.0]
    for cell in np.argsort(expected, kind="stable"):
        if wanted[-1] >= smallest:
            observed.append(0.0)
            wanted.append(0.0)
        observed[-1] += counts[cell]
        wanted[-1] += expected[cell]
    if len(wanted) < 2:
        return 1.0
    statistic = sum((o - w) ** 2 / w for o, w in zip(observed, wanted, strict=True))
    return float(stats.chi2.sf(statistic, len(wanted) - 1))


def sphere_cells(directions: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Return the cell [n] of unit ``directions`` [n, 3] in a grid of equal solid angle, uniform in z and azimuth."""
    row = np.clip(((1.0 - directions[:, 2]) * 0.5 * rows).astype(int), 0, rows - 1)
    turn = np.arctan2(directions[:, 1], directions[:, 0]) / (2 * np.pi)
    column = np.clip(((turn - np.floor(turn)) * columns).astype(int), 0, columns - 1)
    return row * columns + column


def sphere_histogram(directions: np.ndarray, rows: int = 32, columns: int = 32) -> np.ndarray:
    """Return the counts [rows, columns] of unit ``directions`` [n, 3]; zero vectors (rejected) are not counted."""
    kept = directions[np.linalg.norm(directions, axis=1) > 0.5]
    cells = sphere_cells(kept, rows, columns)
    return np.bincount(cells, minlength=rows * columns).reshape(rows, columns)


def sphere_expectation(
    pdf: Callable[[np.ndarray], np.ndarray], count: int, rows: int = 32, columns: int = 32, points: int = 16
) -> np.ndarray:
    """Return the expected counts [rows, columns] of ``count`` samples of density ``pdf`` (directions [n, 3] to 1/sr).

    Integrates by ``points`` x ``points`` Gauss-Legendre nodes a cell, of which the caller
    takes enough for the density's narrowest peak.
    """
    nodes, weights = np.polynomial.legendre.leggauss(points)
    z = 1.0 - 2.0 * (np.arange(rows)[:, None] + (nodes + 1.0) * 0.5).ravel() / rows
    phi = 2.0 * np.pi * (np.arange(columns)[:, None] + (nodes + 1.0) * 0.5).ravel() / columns
    z, phi = (grid.ravel() for grid in np.meshgrid(z, phi, indexing="ij"))
    ring = np.sqrt(np.maximum(0.0, 1.0 - z * z))
    directions = np.stack([ring * np.cos(phi), ring * np.sin(phi), z], axis=-1)
    density = np.asarray(pdf(directions), dtype=np.float64).reshape(rows, points, columns, points)
    cell_area = 4.0 * np.pi / (rows * columns)
    return np.einsum("rpcq,p,q->rc", density, weights, weights) * 0.25 * cell_area * count


def renderings(
    scene: object,
    camera: object,
    pipeline: object,
    count: int,
    buffer: str = "beauty",
    seed: int = 1,
) -> np.ndarray:
    """Return ``count`` independent renderings of a view on `device`, float64 [count, height, width, channels]."""
    import warp_gi as gi

    path = gi.CameraPath.still(camera)
    frames = gi.render(scene, path, pipeline, frames=range(count), device=_device, seed=seed)
    return np.stack([frame.numpy(buffer).astype(np.float64) for frame in frames])


def assert_mean(images: np.ndarray, expected: object, alpha: float = 1e-4, tolerance: float = 0.0) -> None:
    """Raise AssertionError unless the mean over all pixels of ``images`` [seed, h, w, 3] is ``expected`` (3 numbers).

    ``tolerance`` is what the expectation itself may be off by, relative.
    """
    expected = np.broadcast_to(np.asarray(expected, dtype=np.float64), 3)
    mean, variance = mean_and_variance(images.mean(axis=(1, 2)))
    known = (tolerance * expected / 3.0) ** 2
    test = z_test(mean, variance, expected, known, alpha, len(images) - 1)
    sigma = np.sqrt(variance)
    assert test.passed, f"mean {mean} is not {expected} (sigma {sigma}, p = {test.p_min:.1e})"
