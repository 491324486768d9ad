"""Published scenes: what their description says is what is loaded."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene_tools import loss_by_depth
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

import warp_gi as gi

SCENES = Path(os.environ.get("WARP_GI_SCENES", Path(__file__).parents[2] / ".." / "shared" / "scenes"))


def load(name: str) -> gi.Scene:
    path = SCENES / name
    if not path.is_file():
        pytest.skip(f"{path} is not there; set WARP_GI_SCENES")
    return gi.load_scene(path)


def emissive_pieces(scene: gi.Scene) -> int:
    """Return how many connected sets of emissive triangles there are, vertices at one place being one."""
    g = scene.data("cpu").geometry
    triangles = g.indices.numpy()[g.emitters.numpy() >= 0]
    _, welded = np.unique(g.points.numpy()[triangles].reshape(-1, 3), axis=0, return_inverse=True)
    corners = welded.reshape(-1, 3)
    rows, columns = corners[:, [0, 1]].reshape(-1), corners[:, [1, 2]].reshape(-1)
    count = int(welded.max()) + 1
    return connected_components(coo_array((np.ones(len(rows)), (rows, columns)), (count, count)))[0]


@pytest.mark.parametrize(
    ("name", "triangles", "materials"),
    [
        ("crytek_sponza.glb", 262_266, 25),
        ("living_room/living_room.obj", 28_656, 41),
        ("modern_hall.glb", 28_655, 12),
        ("veach_bidir.glb", 11_544, 6),
        pytest.param("bistro_exterior.glb", 1_093_527, 74, marks=pytest.mark.slow),
        pytest.param("stanford_dragon.ply", 871_414, 1, marks=pytest.mark.slow),
    ],
)
def test_counts(name, triangles, materials):
    scene = load(name)
    assert (scene.triangle_count, len(scene.materials)) == (triangles, materials)
    assert np.isfinite(scene.bounds).all() and (scene.emitter_powers() > 0).all()


def test_hall_has_13_lamps_and_a_camera():
    scene = load("modern_hall.glb")
    assert emissive_pieces(scene) == 13
    camera = scene.cameras["camera"]
    assert camera.hfov == pytest.approx(70.0) and (scene.bounds[0] < camera.position).all()
    assert (camera.position < scene.bounds[1]).all()


def test_veach_bidir_has_two_emitters_and_a_camera():
    scene = load("veach_bidir.glb")
    assert scene.emitter_count == 4 and len(scene.cameras) == 1


def test_living_room_is_textured_and_lit():
    scene = load("living_room/living_room.obj")
    assert sum(m.base_color_texture is not None for m in scene.materials) == 16
    assert [m.name for m in scene.materials if max(m.emission) > 0] == ["BackLight"]
    assert next(m for m in scene.materials if m.name == "Walls").specular == 0.0


def test_sponza_has_holes_in_its_leaves():
    scene = load("crytek_sponza.glb")
    masked = [m.name for m in scene.materials if m.alpha_cutoff is not None]
    assert len(masked) == 3 and sum(m.normal_texture is not None for m in scene.materials) == 8
    face_masks = scene.data("cpu").bvh.face_masks.numpy()
    materials = scene.data("cpu").geometry.materials.numpy()
    held = {scene.materials[index].name for index in np.unique(materials[face_masks >= 0])}
    assert held and held <= set(masked)


@pytest.mark.parametrize("paths", [gi.BsdfPaths(), gi.GuidedPaths()], ids=["bsdf", "guided"])
@pytest.mark.parametrize(
    ("name", "sky", "view"),
    [
        ("living_room/living_room.obj", (1.0, 1.0, 1.0), ((0, 1, 4), (0.5, 1.2, 0))),
        ("modern_hall.glb", None, ((4, 1.7, 2), (-3, 1.6, -0.5))),
    ],
)
def test_the_default_depth_keeps_the_light_of_white_rooms(name, sky, view, paths):
    """Half a percent of the indirect light is lost at most, where 8 edges would lose 7 to 10."""
    scene = load(name)
    scene.environment = sky or scene.environment
    camera = gi.Camera.look_at(*view, hfov=60)
    assert loss_by_depth(scene, camera, paths) < 0.005
    assert loss_by_depth(scene, camera, replace(paths, max_depth=8)) > 0.05


@pytest.mark.slow
def test_bistro_has_135_lamps():
    scene = load("bistro_exterior.glb")
    assert scene.emitter_count == 20_772 and emissive_pieces(scene) == 135
