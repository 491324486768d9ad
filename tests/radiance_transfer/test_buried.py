"""Slots off the edges of faces, and those inside objects."""

from __future__ import annotations

import numpy as np
import pytest
import statistics_tools as st
from scene_tools import quad

import warp_gi as gi
from warp_gi.bench.harness.court import block, court, court_camera
from warp_gi.techniques.radiance_transfer.buried import MARGIN, off_edges, reached_slots

GREY = gi.Material("grey", (0.6, 0.6, 0.6), specular=0.0)


def test_points_keep_off_edges_and_others_stay():
    corners = np.array([[[0.0, 0.0], [10.0, 0.0], [0.0, 20.0]]] * 4)
    points = np.array([[0.3, 0.3], [0.0, 0.5], [0.5, 0.5], [1.0, 0.0]])
    moved = off_edges(corners, points)
    np.testing.assert_allclose(moved[0], points[0], atol=1e-7)
    u, v = moved.T
    edge = np.hypot(10.0, 20.0)
    away = np.stack([10.0 * u, 20.0 * v, (1.0 - u - v) * 200.0 / edge])  # texels from each edge
    assert away.min() > 0.95 * MARGIN and away.min(axis=0)[1:].max() < 1.05 * MARGIN


def test_faces_smaller_than_a_texel_keep_their_points_inside():
    corners = np.array([[[0.0, 0.0], [0.01, 0.0], [0.0, 0.01]]])
    u, v = off_edges(corners, np.array([[1.0, 0.0]]))[0]
    assert min(u, v, 1 - u - v) > 0.15


def test_light_gets_along_hits_but_not_by_a_few():
    hits = np.array([[-1, 1, 1, 1], [0, 0, 2, 2], [1, 1, 1, 3], [4, 4, 4, 0], [3, 3, 3, 3], [-2, -2, -2, -2]])
    assert reached_slots(hits).tolist() == [True, True, True, False, False, False]
    lit = np.array([False, False, False, False, True, False])
    assert reached_slots(hits, lit).tolist() == [True, True, True, True, True, False]


@pytest.mark.parametrize("sky", [1.0])
def test_no_black_rim_where_a_box_stands(sky):
    """A box without a bottom on a floor: the floor beside it has the light of paths, not that of what the box hides."""
    meshes = [quad((-2, 0, 2), (4, 0, 0), (0, 0, -4), GREY, "floor"), *block((0, 0, 0), (1, 1, 1), 0.3, GREY)]
    scene = gi.Scene([gi.Node("all", meshes)], environment=sky)
    camera = gi.Camera.look_at((1.2, 1.6, 1.4), (0.3, 0.0, 0.4), hfov=40, resolution=(64, 48))
    used = gi.Pipeline.preset("transfer", environment=gi.RadianceTransfer(resolution=96), indirect=None, spp=16)
    picture = next(gi.render(scene, camera, used, device=st.device().alias))
    truth = next(gi.render(scene, camera, gi.Pipeline(indirect=None, spp=256), device=st.device().alias))
    mine, known = (frame.numpy("environment")[..., 0] for frame in (picture, truth))
    floor = np.abs(truth.numpy("normal")[..., 1] - 1) < 1e-3
    assert floor.sum() > 500
    assert np.abs(mine - known)[floor].max() < 0.25 * known[floor].mean()
    assert np.abs(mine - known)[floor].mean() < 0.03 * known[floor].mean()


def test_no_light_below_the_walls_of_a_court():
    """Rays from the lowest row of a wall's texels do not slip below the floor."""
    scene = court(gi.Environment.constant((1.0, 1.0, 1.0)))
    used = gi.Pipeline.preset("transfer", environment=gi.RadianceTransfer(resolution=128), indirect=None, spp=16)
    mine = next(gi.render(scene, court_camera((96, 64)), used, device=st.device().alias)).numpy("environment")
    truth = next(
        gi.render(scene, court_camera((96, 64)), gi.Pipeline(indirect=None, spp=256), device=st.device().alias)
    )
    known = truth.numpy("environment")
    assert (mine - known).max() < 0.4 * known.mean()
