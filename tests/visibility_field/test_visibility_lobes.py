"""Glossy samples eight at a time are those of kernels.bsdf one at a time, number by number."""

import numpy as np
import pytest
import warp as wp

from warp_gi.kernels.bsdf import bsdf_evaluate, bsdf_sample, make_bsdf, specular_probability
from warp_gi.kernels.sampling import (
    FIELD_BSDF_DIMENSION,
    FIELD_LOBE_DIMENSION,
    frame_of,
    pair_keys,
    random_1d,
    random_key,
    sample_2d,
)
from warp_gi.kernels.visibility_field import (
    VisibilityGrid,
    direction_texel,
    octet_bits,
    octet_direction,
    octet_texel,
    texel_state,
)
from warp_gi.kernels.visibility_field_lobes import glossy_octet, octet_pdf, octet_sums, octet_weight, octet_weights
from warp_gi.launch import get_device, launch

wp.set_module_options({"enable_backward": False})

SEED, OWN_SEED, RESOLUTION, COUNT = 77, 1234567, 24, 4000
ROWS = 20


# Thread: eight samples of a material. Writes rows of the octet and of samples one at a time: direction, weight, pdf,
# whether it is above the plane, texel, state; the last row holds the octet's sums over its even lanes above the plane.
@wp.kernel
def sample_both_ways(
    first: wp.int32,
    grid: VisibilityGrid,
    materials: wp.array(dtype=wp.vec4),
    views: wp.array(dtype=wp.vec3),
    eight: wp.array2d(dtype=wp.float32),
    one: wp.array2d(dtype=wp.float32),
    sums: wp.array(dtype=wp.vec3),
):
    item = first + wp.tid()
    m = materials[item]
    b = make_bsdf(wp.vec3(0.8, 0.5, 0.1), m[0], m[1], m[2])
    wo = views[item]
    frame = frame_of(wp.normalize(wp.vec3(0.3, -0.5, 0.9)))
    normal = wp.normalize(wp.vec3(0.35, -0.5, 0.8))
    specular = specular_probability(b, wo[2])
    keys = pair_keys(wp.uint32(SEED), FIELD_BSDF_DIMENSION)
    lobe = random_key(wp.uint32(OWN_SEED), FIELD_LOBE_DIMENSION)
    start = item * 8
    octet = glossy_octet(grid, 0, b, specular, wo, frame, normal, keys, wp.uint32(start), lobe, start)
    weights = octet_weights(octet, b, specular, wo, frame)
    bits = octet_bits(octet)
    for lane in range(8):
        k = start + lane
        u_lobe = random_1d(wp.uint32(k), wp.uint32(OWN_SEED), FIELD_LOBE_DIMENSION)
        s = bsdf_sample(b, wo, u_lobe, sample_2d(wp.uint32(k), wp.uint32(SEED), FIELD_BSDF_DIMENSION))
        way = frame * s.wi
        there = octet_direction(octet, lane)
        value = bsdf_evaluate(b, wo, s.wi)
        above = s.pdf > 0.0 and wp.dot(way, normal) > 0.0
        weight = octet_weight(weights, lane)
        texel = direction_texel(grid, there)
        for axis in range(3):
            eight[k, axis] = there[axis]
            one[k, axis] = way[axis]
            eight[k, 3 + axis] = weight[axis]
            if value.pdf > 0.0:
                one[k, 3 + axis] = value.value[axis] / value.pdf
        eight[k, 6] = octet_pdf(weights, lane)
        one[k, 6] = value.pdf
        eight[k, 7] = wp.float32((bits >> (16 + lane)) & 1)
        one[k, 7] = wp.where(above, 1.0, 0.0)
        eight[k, 8] = wp.float32(octet_texel(octet, lane))
        one[k, 8] = wp.float32(texel)
        eight[k, 9] = wp.float32(((bits >> lane) & 1) + 2 * ((bits >> (8 + lane)) & 1))
        one[k, 9] = wp.float32(texel_state(grid, 0, texel))
    total = octet_sums(weights, (bits >> 16) & 85)
    sums[2 * item] = wp.vec3(total[0], total[1], total[2])
    sums[2 * item + 1] = wp.vec3(total[3], total[4], total[5])


@pytest.fixture(scope="module")
def samples():
    """Samples of 500 materials from mirrors to rough metals, seen from above and along the surface."""
    random, items = np.random.default_rng(3), COUNT // 8
    materials = random.random((items, 4), np.float32)
    materials[:, 0] = np.where(random.random(items) < 0.5, 0.0, materials[:, 0])
    materials[:, 1] = np.maximum(materials[:, 1], 0.1)
    views = random.normal(size=(items, 3))
    views[:, 2] = np.abs(views[:, 2]) + 0.02
    views = (views / np.linalg.norm(views, axis=1, keepdims=True)).astype(np.float32)
    device, grid = get_device("cpu"), VisibilityGrid()
    grid.resolution, grid.words = RESOLUTION, RESOLUTION * RESOLUTION // 16
    grid.masks = wp.array(random.integers(0, 2**32, grid.words, np.uint32), dtype=wp.uint32, device=device)
    eight, one = (wp.zeros((COUNT, ROWS), dtype=wp.float32, device=device) for _ in range(2))
    sums = wp.zeros(2 * items, dtype=wp.vec3, device=device)
    inputs = [wp.array(materials, dtype=wp.vec4, device=device), wp.array(views, dtype=wp.vec3, device=device)]
    launch(sample_both_ways, items, [grid, *inputs, eight, one, sums], device)
    return eight.numpy(), one.numpy(), sums.numpy().reshape(items, 6)


def test_samples_are_those_of_the_bsdf(samples):
    eight, one, _ = samples
    differ = eight[:, 7] != one[:, 7]  # a direction may lie in the plane but for rounding
    assert differ.mean() < 1e-3
    kept = (one[:, 7] > 0) & ~differ
    assert 0.5 < kept.mean() < 1.0
    np.testing.assert_allclose(eight[kept, :3], one[kept, :3], atol=2e-5)
    np.testing.assert_allclose(eight[kept, 3:6], one[kept, 3:6], rtol=2e-3, atol=1e-5)
    np.testing.assert_allclose(eight[kept, 6], one[kept, 6], rtol=5e-3)


def test_texels_and_what_is_known_of_them(samples):
    eight, one, _ = samples
    assert (eight[:, 8] == one[:, 8]).mean() > 0.999  # a direction may lie on the border of two texels
    same = eight[:, 8] == one[:, 8]
    np.testing.assert_array_equal(eight[same, 9], one[same, 9])
    assert len(set(eight[:, 9])) == 4


def test_sums_over_lanes(samples):
    eight, _, sums = samples
    lanes = eight.reshape(-1, 8, ROWS)[:, ::2]
    weights = np.where(lanes[:, :, 7:8] > 0, lanes[:, :, 3:6], 0.0)
    expected = np.concatenate([weights.sum(1), (weights**2).sum(1)], axis=1)
    np.testing.assert_allclose(sums, expected, rtol=1e-5, atol=1e-6)
