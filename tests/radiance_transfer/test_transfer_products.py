"""Products of rows of transfer against the same sums in NumPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp
from scipy.special import lpmv
from statistics_tools import device, every_device  # noqa: F401

from warp_gi import launch
from warp_gi.kernels.transfer_products import WIDTHS, bounced_product, environment_product, glossy_product, vec6
from warp_gi.kernels.transfer_snippets import clamped_cosine

wp.set_module_options({"enable_backward": False})

SLOTS, POINTS = 50, 64


def basis(directions, order):
    """Return real spherical harmonics from SciPy's associated Legendre functions, which have (-1)^m in them."""
    x, y, z = directions.T
    azimuth, columns = np.arctan2(y, x), []
    for l in range(order):
        for m in range(-l, l + 1):
            k = abs(m)
            scale = math.sqrt((2 * l + 1) / (4 * math.pi) * math.factorial(l - k) / math.factorial(l + k))
            value = (-1) ** k * scale * lpmv(k, l, z) * (math.sqrt(2) if m else 1)
            columns.append(value * (np.cos(k * azimuth) if m >= 0 else np.sin(k * azimuth)))
    return np.stack(columns, axis=-1)


# Thread: a point. Writes all three products.
@wp.kernel
def products(
    first: wp.int32,
    rows: wp.array2d(dtype=wp.float16),
    bounces: wp.array2d(dtype=wp.float16),
    light: wp.array(dtype=wp.float32),
    matrix: wp.array(dtype=wp.float32),
    points: wp.array(dtype=wp.float32),
    out: wp.array2d(dtype=wp.float32),
):
    i = first + wp.tid()
    at = i * 24
    slots = wp.vec4i(0, 0, 0, 0)
    shares = wp.vec4(0.0, 0.0, 0.0, 0.0)
    lobe = vec6()
    for k in range(4):
        slots[k] = wp.int32(points[at + k])
        shares[k] = points[at + 4 + k]
    for k in range(6):
        lobe[k] = points[at + 8 + k]
    direction = wp.vec3(points[at + 14], points[at + 15], points[at + 16])
    normal = wp.vec3(points[at + 17], points[at + 18], points[at + 19])
    normal_lobe = wp.vec4(points[at + 20], points[at + 21], points[at + 22], points[at + 23])
    a = environment_product(rows, slots, shares, light)
    b = glossy_product(rows, slots, shares, matrix, direction, lobe, normal, normal_lobe)
    d = bounced_product(bounces, slots, shares, light)
    for c in range(3):
        out[i, c] = a[c]
        out[i, 9 + c] = d[c]
    for c in range(6):
        out[i, 3 + c] = b[c]


@pytest.mark.parametrize("order", [5, 6])
def test_products_are_those_of_numpy(order):
    rng, count, width = np.random.default_rng(order), order * order, WIDTHS[order]
    transfer = np.zeros((SLOTS, width), np.float16)
    transfer[:, :count] = rng.normal(size=(SLOTS, count))
    bounces = np.zeros((SLOTS, 3, 32), np.float16)
    bounces[:, :, :25] = rng.normal(size=(SLOTS, 3, 25))
    light = np.zeros((3, width), np.float32)
    light[:, :25] = rng.normal(size=(3, 25))
    bounce_light = np.zeros((3, 32), np.float32)
    bounce_light[:, :25] = light[:, :25]
    matrix = np.zeros((count, 3, width), np.float32)
    matrix[:, :, :count] = rng.normal(size=(count, 3, count))
    slots = rng.integers(0, SLOTS, (POINTS, 4))
    shares = rng.dirichlet(np.ones(4), POINTS)
    shares[::3, 2] = 0.0
    lobe, normal_lobe, vectors = (
        rng.normal(size=(POINTS, 6)),
        rng.normal(size=(POINTS, 4)),
        rng.normal(size=(2, POINTS, 3)),
    )
    vectors /= np.linalg.norm(vectors, axis=-1, keepdims=True)
    points = np.concatenate([slots, shares, lobe, *vectors, normal_lobe], axis=1).astype(np.float32)
    at = device()
    out = wp.zeros((POINTS, 12), dtype=wp.float32, device=at)
    arrays = [
        wp.array(transfer, dtype=wp.float16, device=at),
        wp.array(bounces.reshape(SLOTS, 96), dtype=wp.float16, device=at),
        wp.array(light.ravel(), dtype=wp.float32, device=at),
        wp.array(matrix.ravel(), dtype=wp.float32, device=at),
        wp.array(points.ravel(), dtype=wp.float32, device=at),
        out,
    ]
    launch.launch(products, POINTS, arrays, at)
    blend = np.einsum("pk,pki->pi", shares, transfer.astype(np.float64)[slots])
    np.testing.assert_allclose(out.numpy()[:, :3], blend @ light.T.astype(np.float64), rtol=1e-4, atol=1e-5)
    if order == 5:
        over = np.einsum("pk,pkci,ci->pc", shares, bounces.astype(np.float64)[slots], bounce_light)
        np.testing.assert_allclose(out.numpy()[:, 9:], over, rtol=1e-4, atol=1e-5)
    bands = np.repeat(np.arange(order), 2 * np.arange(order) + 1)
    y, y_normal = (basis(v, order) for v in vectors)
    about_n = np.pad(normal_lobe, ((0, 0), (1, 1)))
    product = np.einsum("pk,kci->pci", lobe[:, bands] * y + about_n[:, bands] * y_normal, matrix.astype(np.float64))
    shaded = np.einsum("pci,pi->pc", product[..., :count], blend[:, :count])
    unshaded = y_normal * np.array(clamped_cosine(order))[bands]
    np.testing.assert_allclose(out.numpy()[:, 3:6], shaded, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(
        out.numpy()[:, 6:9], np.einsum("pci,pi->pc", product[..., :count], unshaded), rtol=1e-4, atol=1e-4
    )


def test_rows_past_two_thousand_million_numbers():
    """The same memory as the end of arrays that begin far before it, which nobody reads: indices need 64 bits."""
    rng, at, far = np.random.default_rng(1), device(), 1 << 26
    points = np.zeros((POINTS, 24), np.float32)
    points[:, :4] = 8 * rng.integers(0, SLOTS, (POINTS, 4))  # whole numbers of float32 behind `far`, too
    points[:, 4:] = rng.normal(size=(POINTS, 20))
    rows, bounces = (
        wp.array(rng.normal(size=(8 * SLOTS, width)), dtype=wp.float16, device=at) for width in (WIDTHS[5], 96)
    )
    light = wp.array(rng.normal(size=96), dtype=wp.float32, device=at)
    matrix = wp.array(rng.normal(size=25 * 96), dtype=wp.float32, device=at)
    found = []
    for start in (0, far):
        points[:, :4] += start
        arrays = [
            wp.array(
                ptr=one.ptr - start * one.strides[0],
                shape=(start + one.shape[0], one.shape[1]),
                dtype=wp.float16,
                device=at,
            )
            for one in (rows, bounces)
        ]
        out = wp.zeros((POINTS, 12), dtype=wp.float32, device=at)
        inputs = [*arrays, light, matrix, wp.array(points.ravel(), dtype=wp.float32, device=at), out]
        launch.launch(products, POINTS, inputs, at)
        found.append(out.numpy())
    assert abs(found[0]).min(axis=0).max() > 0 and (found[0] == found[1]).all()
