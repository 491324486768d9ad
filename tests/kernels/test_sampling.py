"""The sample sequence: Sobol, nets over pixels and samples, and the warps of the unit square."""

import numpy as np
import pytest
import warp as wp

from warp_gi.kernels import sampling
from warp_gi.launch import launch

CPU = wp.get_device("cpu")


@wp.kernel
def draw_pairs(
    first: wp.int32,
    width: wp.int32,
    spp: wp.int32,
    bits: wp.int32,
    seed: wp.uint32,
    dimension: wp.int32,
    points: wp.array(dtype=wp.vec2),
    singles: wp.array(dtype=wp.float32),
):
    i = first + wp.tid()
    pixel = i / spp
    y = pixel / width
    x = pixel - y * width
    index = sampling.pixel_sample_index(x, y, i - pixel * spp, bits)
    pixel_seed = sampling.pixel_seed(x, y, bits, seed)
    points[i] = sampling.sample_2d(index, pixel_seed, dimension)
    singles[i] = sampling.sample_1d(index, pixel_seed, dimension)


@wp.kernel
def build_frames(first: wp.int32, normals: wp.array(dtype=wp.vec3), frames: wp.array(dtype=wp.mat33)):
    i = first + wp.tid()
    frames[i] = sampling.frame_of(normals[i])


@wp.kernel
def evaluate_circle(first: wp.int32, u: wp.array(dtype=wp.float32), points: wp.array(dtype=wp.vec2)):
    i = first + wp.tid()
    points[i] = sampling.circle(u[i])


def samples(width=8, height=8, spp=4, seed=1, dimension=3, bits=None):
    points = wp.zeros(width * height * spp, dtype=wp.vec2, device=CPU)
    singles = wp.zeros(width * height * spp, dtype=wp.float32, device=CPU)
    bits = (spp - 1).bit_length() if bits is None else bits
    launch(draw_pairs, len(points), [width, spp, bits, seed, dimension, points, singles], CPU)
    return points.numpy().reshape(height, width, spp, 2), singles.numpy().reshape(height, width, spp)


def is_net(points):
    """Whether 2^m points put exactly one in every elementary interval of area 2^-m."""
    m = int(np.log2(len(points)))
    for a in range(m + 1):
        cells = np.floor(points * [2**a, 2 ** (m - a)]).astype(int)
        if len(np.unique(cells[:, 0] * 2 ** (m - a) + cells[:, 1])) != len(points):
            return False
    return True


def test_every_pixel_and_every_aligned_block_is_a_net():
    points, singles = samples()
    assert 0 <= points.min() and points.max() < 1
    for y in range(8):
        for x in range(8):
            assert is_net(points[y, x])
    for size in (2, 4, 8):
        assert is_net(points[:size, :size].reshape(-1, 2))
        strata = np.sort(np.floor(singles[:size, :size].ravel() * size * size * 4))
        assert (strata == np.arange(size * size * 4)).all()


def test_unscrambled_sequence_is_sobol():
    """Random points are no net: the property tested above is not a trivial one."""
    random = np.random.default_rng(0).random((64, 2))
    assert not is_net(random)
    qmc = pytest.importorskip("scipy.stats.qmc")
    assert is_net(qmc.Sobol(2, scramble=False).random(64))


def test_seeds_dimensions_and_far_pixels_are_independent():
    a, _ = samples(seed=1, dimension=3)
    for other in (samples(seed=2, dimension=3)[0], samples(seed=1, dimension=4)[0]):
        correlation = np.corrcoef(a[..., 0].ravel(), other[..., 0].ravel())[0, 1]
        assert abs(correlation) < 0.25  # 256 pairs: four standard deviations
    again, _ = samples(seed=1, dimension=3)
    assert (a == again).all()
    far, _ = samples(bits=28)  # of 32: pixels 4 apart share their place in the sequence
    assert (far[:4, :4] != far[4:, :4]).any(axis=-1).all() and (far[:4, :4] != far[:4, 4:]).any(axis=-1).all()


def test_error_is_blue_over_the_picture():
    """Means of 8x8 blocks of one-sample pixels err far less than random ones would (white: 1 / 8 of a pixel's)."""
    points, _ = samples(width=64, height=64, spp=1)
    f = np.sin(3.0 * points[..., 0, 0]) * points[..., 0, 1]
    blocks = f.reshape(8, 8, 8, 8).mean(axis=(1, 3))
    assert blocks.std() < 0.25 * f.std() / 8


def test_frames_are_rotations():
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(1000, 3))
    normals[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    frames = wp.zeros(len(normals), dtype=wp.mat33, device=CPU)
    launch(build_frames, len(normals), [wp.array(normals, dtype=wp.vec3, device=CPU), frames], CPU)
    matrices = frames.numpy().astype(np.float64)
    assert np.abs(matrices @ matrices.transpose(0, 2, 1) - np.eye(3)).max() < 1e-5
    assert np.abs(np.linalg.det(matrices) - 1).max() < 1e-5
    assert np.abs(matrices[:, :, 2] - normals).max() < 1e-6


def test_circle_is_cosine_and_sine():
    u = np.linspace(0, 1, 100_001).astype(np.float32)
    points = wp.zeros(len(u), dtype=wp.vec2, device=CPU)
    launch(evaluate_circle, len(u), [wp.array(u, device=CPU), points], CPU)
    angle = 2 * np.pi * u.astype(np.float64)
    assert np.abs(points.numpy() - np.stack([np.cos(angle), np.sin(angle)], axis=1)).max() < 2e-7
