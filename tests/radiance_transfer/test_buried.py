"""Slots off the edges of faces, and those inside objects."""

from __future__ import annotations

import numpy as np
import pytest
import statistics_tools as st
from scene_tools import quad
from transfer_tools import transfer_settings

import warp_gi as gi
from warp_gi.bench.harness.court import block, court, court_camera
from warp_gi.launch import get_device
from warp_gi.techniques.radiance_transfer.buried import back_shares, without_buried
from warp_gi.techniques.radiance_transfer.rays import trace_slots, transfer_work
from warp_gi.techniques.shared.atlas.build import make_atlas
from warp_gi.techniques.shared.atlas.buried import CLEAR, MARGIN, off_edges

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


def post_in_a_floor(below: float) -> gi.Scene:
    """A post through a floor, under a white sky that is below the floor, too."""
    walls = block((-0.25, -below, -0.25), (0.5, 1.0 + below, 0.5), 0.0, GREY)
    return gi.Scene([gi.Node("all", [quad((-2, 0, 2), (4, 0, 0), (0, 0, -4), GREY, "floor"), *walls])])


def test_slots_behind_a_floor_have_what_is_in_front():
    """The post's texels just below the floor see the sky below; above it nobody sees those, but fetches read them."""
    scene, settings, device = post_in_a_floor(0.985), transfer_settings(resolution=128), get_device("cpu")
    atlas = make_atlas(scene, settings, "cpu")
    work = transfer_work(scene, atlas, settings, device, 0)
    traced = trace_slots(work)
    found = without_buried(work, atlas, traced)
    points = scene._flat.points[scene._flat.indices[atlas.slot_faces]]
    u, v = atlas.slot_points.T[:, :, None]
    places = points[:, 0] * (1 - u - v) + points[:, 1] * u + points[:, 2] * v
    normal = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
    wall = (np.abs(normal[:, 1]) < 1e-6) & (atlas.slot_sides == 0)
    face = atlas.slot_faces[np.flatnonzero(wall)[0]]
    edges = scene._flat.points[scene._flat.indices[face]][:2], atlas.corners[face][:2]
    texel = np.linalg.norm(np.diff(edges[0], axis=0)) / np.linalg.norm(np.diff(edges[1], axis=0))  # m
    below = wall & (places[:, 1] < -0.05 * texel) & (places[:, 1] > -0.95 * texel)
    above = wall & (places[:, 1] > 0.2 * texel) & (places[:, 1] < 1.5 * texel)
    assert below.sum() > 20 and above.sum() > 20
    up = 1  # y of the harmonics: light from above less light from below
    assert traced.transfer[below, up].mean() < -0.3 < 0.3 < traced.transfer[above, up].mean()
    assert (found.transfer[below, up] > 0.1).mean() > 0.95
    assert np.array_equal(found.transfer[above], traced.transfer[above])
    replaced = np.flatnonzero((found.transfer != traced.transfer).any(axis=1))
    assert not np.isin(found.hits, replaced).any()


@pytest.mark.parametrize("height", [0.15, 0.5])
def test_the_shadow_of_a_sheet_stays(height):
    """Floor below the edge of a sheet of cloth sees its back, and floor beside it does not; nothing parts them."""
    cloth = quad((-1, height, 1), (2, 0, 0), (0, 0, -2), GREY, "cloth")
    scene = gi.Scene([gi.Node("all", [cloth, quad((-4, 0, 4), (8, 0, 0), (0, 0, -8), GREY, "floor")])])
    settings = transfer_settings(resolution=64)
    atlas = make_atlas(scene, settings, "cpu")
    work = transfer_work(scene, atlas, settings, get_device("cpu"), 0)
    traced = trace_slots(work)
    _, backs = back_shares(atlas, traced.hits)
    assert backs.max() > 0.5 and np.count_nonzero(backs <= CLEAR) > 100
    assert without_buried(work, atlas, traced) is traced


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
