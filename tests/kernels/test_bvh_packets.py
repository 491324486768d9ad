"""Rays that are traced sixteen at once: the hits of single rays."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from ray_tools import rays, soup

import warp_gi as gi
from warp_gi import launch
from warp_gi.bvh import AlphaMasks, TriangleBvh
from warp_gi.kernels import camera_rays, gbuffer, types
from warp_gi.kernels import visibility_polygons_bake as maps
from warp_gi.scene.pinhole import camera_data

CPU = wp.get_device("cpu")


def fan(count):
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
    origins, directions = fan(151)  # no whole number of packets
    limits = rng.uniform(0.2, 3.0, len(origins)).astype(np.float32)
    assert 0.3 < agree(tree, origins, directions, np.inf)
    assert 0.2 < agree(tree, origins, directions, limits)
    assert 0.15 < agree(tree, *rays(rng, 5000), np.inf)  # that go all ways
    assert 0.05 < agree(tree, origins[:, ::-1] + 1e-3 * rng.normal(size=origins.shape), directions[:, ::-1], np.inf)


def test_packets_with_rays_that_are_none_or_extreme():
    rng = np.random.default_rng(42)
    points, indices = soup(rng, 2000, 0.1)
    tree = TriangleBvh(points, indices)
    origins, directions = fan(100)
    limits = np.full(len(origins), np.inf, np.float32)
    directions[3::16] = 0.0
    directions[4::32] *= np.float32(1e-20)
    directions[5::32] *= np.float32(1e20)
    directions[6::32, :2] = np.float32([-0.0, 0.0])
    origins[15::64, 2] = np.nan
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


def hits_of(count):
    """Return room for the hits of camera rays."""
    hits = gbuffer.PrimaryHits()
    hits.direction = wp.zeros(count, dtype=wp.vec3, device=CPU)
    hits.t, hits.u, hits.v = (wp.zeros(count, dtype=wp.float32, device=CPU) for _ in range(3))
    hits.face = wp.zeros(count, dtype=wp.int32, device=CPU)
    return hits


@pytest.mark.parametrize("kind", ["perspective", "orthographic"])
def test_camera_rays_find_what_single_rays_find(kind):
    rng = np.random.default_rng(44)
    tree = TriangleBvh(*soup(rng, 2000, 0.05))
    resolution = 37, 21  # no whole number of tiles, nor of packets
    view = {"eye": (0.4, 0.6, 2.5), "target": (0.5, 0.5, 0.5), "resolution": resolution}
    camera = gi.Camera.look_at(**view) if kind == "perspective" else gi.Camera.orthographic(**view, width=1.5)
    scene, hits = types.SceneData(), hits_of(37 * 21)
    scene.bvh = tree.data
    data, settings = camera_data(camera), gbuffer.PassSettings()
    settings.camera_samples, settings.sample_count = 1, 1
    inputs = [scene, data, settings, camera_rays.PACKET, hits]
    launch.launch(camera_rays.trace_primary, 5 * 3 * gbuffer.TILE**2 // camera_rays.PACKET, inputs, CPU)
    x, y = np.meshgrid((np.arange(37) + 0.5) / 37 * 2 - 1, 1 - (np.arange(21) + 0.5) / 21 * 2)
    right, up, forward, position = (np.array(getattr(data, name)) for name in ("right", "up", "forward", "position"))
    plane = (x[..., None] * right + y[..., None] * up).reshape(-1, 3)
    expected = forward + plane * data.spread
    directions = hits.direction.numpy()
    np.testing.assert_allclose(directions, expected / np.linalg.norm(expected, axis=1, keepdims=True), atol=1e-6)
    found = tree.intersect(position + plane * (1.0 - data.spread), directions)
    face = found.face.numpy()
    assert (face >= 0).mean() > 0.3
    same = hits.face.numpy() == face  # origins differ by a rounding
    assert same.mean() > (0.999 if kind == "perspective" else 0.995)
    for name in ("t", "u", "v"):
        np.testing.assert_allclose(getattr(hits, name).numpy()[same], getattr(found, name).numpy()[same], atol=2e-4)


@pytest.mark.parametrize("side", [8, 13])
def test_maps_of_directions_hold_the_distances_of_single_rays(side):
    rng = np.random.default_rng(45)
    points, indices = soup(rng, 300, 0.1)
    tree = TriangleBvh(points, indices)
    batch, scene = maps.ContourBatch(), types.SceneData()
    scene.bvh = tree.data
    batch.start, batch.resolution, batch.offset = 1, side, 0.01
    places = rng.random((3, 3)).astype(np.float32)
    batch.positions = wp.array(places, dtype=wp.vec3, device=CPU)
    normals = np.float32([[0, 0, 1], [0, 1, 0], [0.6, 0, -0.8]])
    batch.normals = wp.array(normals, dtype=wp.vec3, device=CPU)
    batch.distances = wp.full(2 * side * side, -1.0, dtype=wp.float32, device=CPU)
    directions = wp.zeros(side * side, dtype=wp.vec3, device=CPU)
    launch.launch(maps.map_directions, side * side, [side, directions], CPU)
    bands = -(-side // maps.BAND)
    launch.launch(maps.trace_maps, 2 * bands, [scene, batch, maps.BAND, directions], CPU)
    distances = batch.distances.numpy().reshape(2, -1)
    local = directions.numpy()
    assert (local[:, 2] >= 0.0).all() and abs(local.mean(axis=0)[:2]).max() < 1e-6
    for item in (0, 1):
        normal = normals[1 + item].astype(np.float64)
        sign = 1.0 if normal[2] >= 0.0 else -1.0
        first = -1.0 / (sign + normal[2])
        cross = normal[0] * normal[1] * first
        tangent = 1.0 + sign * normal[0] ** 2 * first, sign * cross, -sign * normal[0]
        other = cross, sign + normal[1] ** 2 * first, -normal[1]
        away = local @ np.stack([tangent, other, normal])
        origins = np.tile(places[1 + item] + 0.01 * normal, (side * side, 1))
        expected = tree.intersect(origins, away).t.numpy()
        assert 0.2 < np.isfinite(expected).mean() < 1.0
        same = np.isclose(distances[item], expected, rtol=1e-3) | (np.isinf(distances[item]) & np.isinf(expected))
        assert same.mean() > 0.98  # directions differ by a rounding
