"""Transfer of the sky: known surfaces, slow integrals, counts of rays, threads."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_tools import GREY, quad, sphere
from transfer_tools import face_atlas, face_normals, open_transfer, slow_transfer, sphere_grid, transfer_settings

import warp_gi as gi
from warp_gi import launch
from warp_gi.scene.harmonics import basis
from warp_gi.techniques.radiance_transfer.rays import trace_slots, transfer_work

AWAY, HEIGHT, LONG = 0.7, 1.3, 400.0  # of a point from a wall, of the wall, and how far all goes


def traced(scene, atlas=None, seed=0, **settings):
    atlas = face_atlas(scene) if atlas is None else atlas
    device = launch.get_device("cpu")
    return trace_slots(transfer_work(scene, atlas, transfer_settings(**settings), device, seed))


def wall_scene(normal=(0.0, 1.0, 0.0), point=AWAY):
    """A floor, y = 0, and a wall, x = 0, that stands behind it; slot 0 lies so far from the wall."""
    floor = quad((LONG, 0, -LONG), (-2 * LONG, 0, 0), (0, 0, 2 * LONG))
    floor = replace(floor, points=floor.points.astype(np.float32), normals=np.tile(np.float32(normal), (4, 1)))
    wall = quad((0, 0, -LONG), (0, HEIGHT, 0), (0, 0, 2 * LONG))
    scene = gi.Scene([gi.Node("floor", [floor]), gi.Node("wall", [wall])])
    corners = floor.points[floor.indices[0]].astype(np.float64)
    matrix = np.stack([corners[1] - corners[0], corners[2] - corners[0]], axis=1)[[0, 2]]
    u, v = np.linalg.solve(matrix, np.array([point, -9.0]) - corners[0][[0, 2]])
    assert min(u, v, 1 - u - v) > 0
    return scene, face_atlas(scene, {0: (u, v)})


def past_wall(directions, away=AWAY):
    """Whether a direction passes over the wall, which is as good as endless, and leaves the floor upwards."""
    x, y = directions[:, 0], directions[:, 1]
    return (y > 0) & ((x >= 0) | (y * away >= -x * HEIGHT))


@pytest.mark.parametrize("order", [5, 6])
def test_convex_object_is_exact(order):
    """Nothing is in the way, so T = A_l y(n), to the rounding of halves; the backs see nothing."""
    scene = gi.Scene([gi.Node("ball", [replace(sphere((1, 2, 3), 0.5, GREY, rows=8), normals=None)])])
    result = traced(scene, order=order, bounces=0)
    count = scene.triangle_count
    expected = open_transfer(face_normals(scene), order)
    assert result.transfer.shape == (2 * count, order**2) and result.transfer.dtype == np.float16
    assert np.abs(result.transfer[:count] - expected).max() < 2.0**-10
    assert not result.transfer[count:].any()
    assert (result.rays == 64).all() and result.hits.shape == (2 * count, 64)


@pytest.mark.parametrize("order", [5, 6])
def test_floor_beside_a_wall(order):
    scene, atlas = wall_scene()
    directions, _ = sphere_grid()
    expected = slow_transfer(past_wall(directions), (0, 1, 0), order)
    errors = []
    for seed in range(4):
        result = traced(scene, atlas, seed, order=order, first_rays=4096, rays=4096, bounces=0)
        errors.append(result.transfer[0] - expected)
    assert np.abs(np.mean(errors, axis=0)).max() < 4e-3
    assert np.abs(expected[9:16]).max() > 0.05  # degrees that an open surface has nothing of


def test_shading_normals_give_the_cosine_and_faces_the_horizon():
    normal = np.array([0.6, 0.8, 0.0])
    scene, atlas = wall_scene(normal)
    directions, _ = sphere_grid()
    expected = slow_transfer(past_wall(directions), normal)
    result = traced(scene, atlas, first_rays=4096, rays=4096, bounces=0)
    assert np.abs(result.transfer[0] - expected).max() < 1e-2
    hits = traced(scene, atlas, first_rays=4096, rays=4096, bounces=1, bounce_rays=4096).hits[0]
    assert set(hits.tolist()) == {-3, -1, 2, 3}  # none is a slot of the floor itself
    assert np.mean(hits == -3) == pytest.approx((1 - normal[1]) / 2, abs=0.01)
    back = slow_transfer(directions[:, 1] < 0, -normal)
    assert np.abs(result.transfer[scene.triangle_count] - back).max() < 1e-2


def test_error_falls_with_rays_and_there_is_no_bias():
    scene, atlas = wall_scene()
    expected = slow_transfer(past_wall(sphere_grid()[0]), (0, 1, 0))

    def error(rays):
        found = [traced(scene, atlas, seed, first_rays=rays, rays=rays, bounces=0).transfer[0] for seed in range(24)]
        deviation = np.asarray(found, np.float64) - expected
        return np.sqrt((deviation**2).mean()), np.abs(deviation.mean(axis=0)).max()

    (few, _), (many, bias) = error(64), error(512)
    assert few < 0.06 and many < 0.015 and many < 0.4 * few and bias < 0.01


def test_rays_go_on_where_sky_and_surfaces_are_both_seen():
    scene, atlas = wall_scene()
    result = traced(scene, atlas, first_rays=20, rays=100, bounce_rays=16, bounces=0)  # no whole blocks of 64, nor of 8
    assert result.rays[0] == 100 and set(result.rays.tolist()) == {20, 100}
    expected = slow_transfer(past_wall(sphere_grid()[0]), (0, 1, 0))
    assert np.abs(result.transfer[0] - expected).max() < 0.1
    assert traced(scene, atlas, first_rays=512, rays=64, bounce_rays=16, bounces=0).rays.max() == 64


def test_rays_of_bounces_are_rays_of_transfer():
    """The first rays also find hits; transfer is the same, to the bit, as without them."""
    scene, atlas = wall_scene()
    without, with_hits = traced(scene, atlas, bounces=0), traced(scene, atlas, bounces=1, bounce_rays=40)
    assert np.array_equal(without.transfer, with_hits.transfer)
    hits = with_hits.hits[0]
    assert hits.shape == (40,) and set(hits.tolist()) <= {-1, 2, 3}  # the sky, or the fronts of the wall's two faces
    share = 0.5 * (1 - AWAY / np.hypot(AWAY, HEIGHT))
    assert np.mean(hits >= 0) == pytest.approx(share, abs=0.08)
    assert traced(scene, atlas, first_rays=8, rays=8, bounces=1, bounce_rays=40).rays.min() == 40


def test_hits_are_uncovered_where_nothing_is_kept():
    scene, atlas = wall_scene()
    corner_slots = atlas.corner_slots.copy()
    corner_slots[:, 2:] = -1
    hits = traced(scene, replace(atlas, corner_slots=corner_slots)).hits[0]
    assert set(hits.tolist()) == {-1, -2}


def test_what_moves_casts_nothing_and_faces_keep_their_numbers():
    """The tree of what rests lacks the faces of what moves; hits still name faces of the scene."""
    scene, atlas = wall_scene()
    lid = quad((-LONG, 0.5, -LONG), (2 * LONG, 0, 0), (0, 0, 2 * LONG))
    keys = [gi.Keyframe(0.0), gi.Keyframe(1.0, translation=(0.0, 1.0, 0.0))]
    moving = gi.Scene([gi.Node("lid", [lid], keyframes=keys), *scene.nodes])
    shifted = replace(
        face_atlas(moving), slot_points=np.insert(atlas.slot_points, [0, 0, 4, 4], 1 / 3, axis=0).astype(np.float32)
    )
    rested, moved = (
        traced(scene, atlas, first_rays=4096, rays=4096),
        traced(moving, shifted, first_rays=4096, rays=4096),
    )
    assert np.abs(rested.transfer[0].astype(float) - moved.transfer[2]).max() < 0.02
    assert set(moved.hits[2].tolist()) == {-1, 4, 5}


@pytest.mark.parametrize("threads", [2, 5])
def test_threads_change_no_bit_and_seeds_do(threads):
    scene = gi.Scene(
        [gi.Node("balls", [replace(sphere((x, 0, 0), 0.5, GREY, rows=12), normals=None) for x in (0.0, 1.1)])]
    )
    try:
        launch.set_threads(1)
        one = traced(scene)
        launch.set_threads(threads)
        many = traced(scene)
    finally:
        launch.set_threads(None)
    for name in ("transfer", "hits", "rays"):
        assert np.array_equal(getattr(one, name), getattr(many, name))
    assert not np.array_equal(one.transfer, traced(scene, seed=1).transfer)


def test_sets_of_directions_are_cosine_distributed():
    scene, atlas = wall_scene()
    work = transfer_work(scene, atlas, transfer_settings(), launch.get_device("cpu"), 3)
    directions = work.rays.directions.numpy()[:, :-8].reshape(3, 64, 512).transpose(1, 2, 0).astype(np.float64)
    assert np.abs(np.linalg.norm(directions, axis=-1) - 1).max() < 1e-5 and (directions[..., 2] >= 0).all()
    expected = open_transfer((0, 0, 1))
    whole = np.pi * basis(directions, 5).mean(axis=1) - expected
    first = np.pi * basis(directions[:, :64], 5).mean(axis=1) - expected
    assert np.sqrt((whole**2).mean()) < 0.008 and np.sqrt((first**2).mean()) < 0.06
