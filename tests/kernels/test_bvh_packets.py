"""Rays that are traced sixteen at once: the hits of single rays."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from ray_tools import rays, soup

from warp_gi.bvh import AlphaMasks, TriangleBvh
from warp_gi.kernels import types

CPU = wp.get_device("cpu")


def camera_rays(count):
    """Return rays whose sixteen neighbours are close, across octants and dominant axes."""
    x, y = np.meshgrid(np.linspace(-1.2, 1.2, count), np.linspace(-1.2, 1.2, count))
    directions = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3).astype(np.float32)
    origins = np.full_like(directions, (0.5, 0.5, -0.4))
    return origins, directions


def agree(tree, origins, directions, limits):
    """Check that packets find what single rays find, and return the share of rays that hit something."""
    single = tree.intersect(origins, directions, limits)
    packet = tree.intersect(origins, directions, limits, coherent=True)
    np.testing.assert_array_equal(packet.face.numpy(), single.face.numpy())
    for name in ("t", "u", "v"):
        np.testing.assert_array_equal(getattr(packet, name).numpy(), getattr(single, name).numpy())
    occluded = tree.occluded(origins, directions, limits).numpy()
    np.testing.assert_array_equal(tree.occluded(origins, directions, limits, coherent=True).numpy(), occluded)
    np.testing.assert_array_equal(occluded != 0, single.face.numpy() >= 0)
    return occluded.mean()


@pytest.mark.parametrize("masked", [False, True])
def test_packets_find_what_single_rays_find(masked):
    rng = np.random.default_rng(41)
    points, indices = soup(rng, 3000, 0.05)
    alpha = None
    if masked:
        nothing = wp.empty(0, dtype=types.Texture, device=CPU), wp.empty(0, dtype=wp.uint32, device=CPU)
        mask = np.arange(3000, dtype=np.int32) % 3 - 1
        alpha = AlphaMasks(mask, [(-1, 0.2, 0.5), (-1, 0.5, None)], np.zeros((9000, 2), np.float32), *nothing)
    tree = TriangleBvh(points, indices, alpha=alpha)
    origins, directions = camera_rays(151)  # no whole number of packets
    limits = rng.uniform(0.2, 3.0, len(origins)).astype(np.float32)
    assert 0.3 < agree(tree, origins, directions, np.inf)
    assert 0.2 < agree(tree, origins, directions, limits)
    assert 0.15 < agree(tree, *rays(rng, 5000), np.inf)  # that go all ways
    assert 0.05 < agree(tree, origins[:, ::-1] + 1e-3 * rng.normal(size=origins.shape), directions[:, ::-1], np.inf)


def test_packets_with_rays_that_are_none_or_extreme():
    rng = np.random.default_rng(42)
    points, indices = soup(rng, 2000, 0.1)
    tree = TriangleBvh(points, indices)
    origins, directions = camera_rays(100)
    limits = np.full(len(origins), np.inf, np.float32)
    directions[3::16] = 0.0
    directions[4::32] *= np.float32(1e-20)
    directions[5::32] *= np.float32(1e20)
    directions[6::32, :2] = np.float32([-0.0, 0.0])
    origins[7::64, 1] = np.nan
    directions[8::64, 2] = np.nan
    origins[9::64, 0] = np.inf
    limits[10::32], limits[11::32], limits[12::32] = 0.0, -1.0, np.nan
    assert 0.3 < agree(tree, origins, directions, limits)
    single, packet = (tree.intersect(origins, directions, 5.0, coherent=one).face.numpy() for one in (False, True))
    np.testing.assert_array_equal(single, packet)


def test_no_packet_leaks_through_a_closed_mesh():
    rng = np.random.default_rng(43)
    side = np.linspace(-1.0, 1.0, 9)
    corner = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    cells = np.arange(81).reshape(9, 9)
    a, b, c, d = cells[:-1, :-1].ravel(), cells[:-1, 1:].ravel(), cells[1:, 1:].ravel(), cells[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    walls = [np.insert(corner, axis, at, axis=1) for axis in range(3) for at in (-1.0, 1.0)]
    points = np.concatenate(walls).astype(np.float32)
    tree = TriangleBvh(points, np.concatenate([faces + 81 * wall for wall in range(6)]).astype(np.int32))
    targets = np.repeat(points[rng.integers(len(points), size=3000)], 16, axis=0)  # vertices, and edges between two
    targets[::3] = (targets[::3] + np.roll(targets, 16, axis=0)[::3]) / 2
    directions = targets + rng.normal(size=targets.shape).astype(np.float32) * np.float32(1e-7)
    origins = np.zeros_like(directions)
    assert (tree.intersect(origins, directions, coherent=True).face.numpy() >= 0).all()
    assert tree.occluded(origins, directions, coherent=True).numpy().all()
