"""Colours of vertices: from every format and encoding, in albedo and light, in masks, and in bakes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scene_tools import TRIANGLE_POINTS, GlbBuilder, card

import warp_gi as gi
from warp_gi.color import decode_srgb

CASES = Path(__file__).parents[1] / "cases"
WALL = gi.Camera.look_at((0, 0, 3), (0, 0, 0), hfov=30, resolution=(32, 24))


def wall(path_or_scene, *buffers):
    """Return buffers of a picture of a 2 x 2 m square that fills the view, under a white sky."""
    scene = gi.load_scene(path_or_scene) if isinstance(path_or_scene, str | Path) else path_or_scene
    scene.environment = 1.0
    frame = next(gi.render(scene, WALL, gi.Pipeline(spp=4)))
    return [frame.numpy(name) for name in buffers]


@pytest.mark.parametrize("name", ["float_rgb", "ubyte_rgba", "ushort_rgb_stride8"])
def test_every_encoding_of_gltf_is_the_base_color_times_the_colors(name):
    albedo, beauty = wall(CASES / "gltf-vertex-colours" / f"{name}.glb", "albedo", "beauty")
    for values in (albedo, beauty):
        np.testing.assert_allclose(values.reshape(-1, 3), np.tile([0.2, 0.3, 0.1], (32 * 24, 1)), atol=2e-3)


@pytest.mark.parametrize("name", ["c.obj", "c.ply"])
def test_obj_and_ply_are_red(name):
    albedo, beauty = wall(CASES / "obj-ply-vertex-colours" / name, "albedo", "beauty")
    for values in (albedo, beauty):
        np.testing.assert_allclose(values.reshape(-1, 3), np.tile([1, 0, 0], (32 * 24, 1)), atol=1e-5)


@pytest.mark.parametrize(
    ("kind", "number"),
    [("uchar", 51), ("ushort", 13107), ("uint", 51), ("int", 51), ("short", 51), ("float", 0.2), ("double", 51.0)],
)
def test_ply_colors_of_any_type_are_srgb(kind, number, tmp_path):
    text = (CASES / "obj-ply-vertex-colours" / "c.ply").read_text()
    text = text.replace("uchar red", f"{kind} red").replace("uchar green", f"{kind} green")
    text = text.replace("uchar blue", f"{kind} blue").replace("255 0 0", f"{number} {number} 0")
    (tmp_path / "a.ply").write_text(text)
    colors = gi.load_scene(tmp_path / "a.ply").nodes[0].meshes[0].colors
    np.testing.assert_allclose(colors, np.tile(decode_srgb(np.array([0.2, 0.2, 0.0])), (4, 1)), atol=1e-6)


def colored_card(colors, **material):
    """Return a square whose corners (low left, low right, high right, high left) have colours."""
    mesh = card(material=gi.Material(specular=0.0, **{"base_color": (0.5, 1.0, 0.25), **material}))
    return replace(mesh, colors=np.float32(colors))


def test_colors_are_interpolated():
    """A square of four colours: at the middle of the left edge the mean of two, times the base colour."""
    mesh = card(material=gi.Material(base_color=(0.5, 1.0, 0.25), specular=0.0))
    colors = np.float32((mesh.points + 1.0) / 2.0)  # red grows to the right, green upwards; blue is 0.5
    (albedo,) = wall(gi.Scene([gi.Node("n", [replace(mesh, colors=colors)])]), "albedo")
    ways = WALL.directions(np.stack(np.meshgrid(np.arange(32) + 0.5, np.arange(24) + 0.5), -1).reshape(-1, 2))
    points = 3.0 * ways / -ways[:, 2:]
    expected = np.stack([(points[:, 0] + 1) / 2, (points[:, 1] + 1) / 2, np.full(len(points), 0.5)], 1) * [
        0.5,
        1.0,
        0.25,
    ]
    got = next(gi.render(gi.Scene([gi.Node("n", [replace(mesh, colors=colors)])]), WALL, gi.Pipeline(spp=1)))
    np.testing.assert_allclose(got.numpy("albedo").reshape(-1, 3), expected, atol=1e-5)
    assert albedo.shape == (24, 32, 3)


def test_meshes_without_colors_stay_as_they_are_beside_others():
    plain = card(material=gi.Material(base_color=(0.5, 0.25, 0.125), specular=0.0))
    shifted = replace(colored_card(np.zeros((4, 3))), points=plain.points - np.float32([0, 0, 1]))
    (albedo,) = wall(gi.Scene([gi.Node("a", [plain]), gi.Node("b", [shifted])]), "albedo")
    np.testing.assert_allclose(albedo[12, 16], [0.5, 0.25, 0.125], atol=1e-6)


def test_coverage_of_vertices_cuts_a_mask():
    """Alpha grows from 0 on the left to 1 on the right; 0.5 times 0.8 is reached at x = 0.25."""
    mesh = card(material=gi.Material(base_color=(1, 1, 1), alpha=0.8, alpha_cutoff=0.5, specular=0.0))
    alpha = (mesh.points[:, :1] + 1.0) / 2.0
    colors = np.concatenate([np.ones((len(mesh.points), 3)), alpha], axis=1)
    scene = gi.Scene([gi.Node("n", [replace(mesh, colors=np.float32(colors))])])
    x = np.linspace(-0.95, 0.95, 39)
    origins = np.float32(np.column_stack([x, np.full(39, 0.1), np.full(39, 3.0)]))
    hits = scene.bvh("cpu").intersect(origins, np.float32([[0, 0, -1]] * 39)).face.numpy()
    np.testing.assert_array_equal(hits >= 0, 0.8 * (x + 1) / 2 >= 0.5)
    opaque = gi.Scene([gi.Node("n", [replace(mesh, colors=None)])])
    assert opaque.geometry_hash != scene.geometry_hash


def test_colors_decide_the_hash_and_the_memory():
    plain = gi.Scene([gi.Node("n", [card()])])
    white = gi.Scene([gi.Node("n", [replace(card(), colors=np.ones((4, 3), np.float32))])])
    red = gi.Scene([gi.Node("n", [replace(card(), colors=np.float32([[1, 0, 0]] * 4))])])
    assert len({plain.hash, white.hash, red.hash}) == 3 and plain.geometry_hash == red.geometry_hash
    assert red.memory_bytes - plain.memory_bytes == 4 * 16
    assert plain.data("cpu").geometry.colors is None  # nothing to read


@pytest.mark.parametrize(
    ("colors", "message"),
    [(np.ones((3, 3)), r"colors must be \[4, 3\] or 4, got \[3, 3\]"), (np.full((4, 3), 1.5), "from 0 to 1, got 1.5")],
)
def test_wrong_colors_are_one_line(colors, message):
    with pytest.raises(gi.SceneError, match=message):
        gi.Scene([gi.Node("n", [replace(card(), colors=np.float32(colors))])])


def test_an_edit_of_colors_is_found():
    mesh = replace(card(), colors=np.full((4, 3), 0.5, np.float32))
    scene = gi.Scene([gi.Node("n", [mesh])])
    scene.data("cpu")
    scene.check_unchanged()
    mesh.colors[2, 1] = 0.25
    with pytest.raises(gi.SceneError, match="colors of mesh"):
        scene.check_unchanged()


def test_smoothing_keeps_colors():
    from warp_gi.scene.normals import smooth_mesh

    mesh = replace(card(), colors=np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]))
    smooth = smooth_mesh(mesh, 30.0)
    for old, new in zip(mesh.indices.reshape(-1), smooth.indices.reshape(-1), strict=True):
        np.testing.assert_array_equal(smooth.colors[new], mesh.colors[old])


def test_a_mask_of_gltf_with_colors(tmp_path):
    glb = GlbBuilder()
    material = {"alphaMode": "MASK", "alphaCutoff": 0.5, "pbrMetallicRoughness": {"metallicFactor": 0}}
    index = glb.mesh(glb.add("materials", material))
    alpha = glb.accessor(np.array([[255, 255, 255, 0], [255, 255, 255, 255], [255, 255, 255, 0]]), np.uint8)
    glb.json["accessors"][alpha]["normalized"] = True
    glb.json["meshes"][index]["primitives"][0]["attributes"]["COLOR_0"] = alpha
    glb.add("nodes", {"mesh": index})
    scene = gi.load_scene(glb.write(tmp_path / "a.glb"))
    rays = np.float32([[0.4, 0.2, 1], [0.6, 0.2, 1]])
    np.testing.assert_array_equal(scene.bvh("cpu").intersect(rays, np.float32([[0, 0, -1]] * 2)).face.numpy(), [-1, 0])
    assert TRIANGLE_POINTS[1, 0] == 1.0


@pytest.mark.parametrize(
    "preset", ["path", "cache", *(pytest.param(one, marks=pytest.mark.slow) for one in ("transfer", "probes"))]
)
def test_every_technique_reads_the_colors(preset):
    """A room of white walls with colours is the room of walls that have these colours themselves."""
    reds, whites = gi.builtin_scene("cornell_box"), gi.builtin_scene("cornell_box")
    for node in whites.nodes:
        for mesh in node.meshes:
            color = np.float32(mesh.material.base_color)
            mesh.colors = np.tile(color, (len(mesh.points), 1))
            mesh.material = replace(mesh.material, base_color=(1.0, 1.0, 1.0))
    camera = gi.builtin_camera_path("cornell_box").camera_at(0.0).at_resolution(24, 24)
    pictures = []
    for scene in (reds, gi.Scene(whites.nodes, whites.lights, whites.environment)):
        pictures.append(next(gi.render(scene, camera, gi.Pipeline.preset(preset), seed=1)).numpy("beauty"))
    assert pictures[0].mean() > 0.01
    np.testing.assert_allclose(pictures[1], pictures[0], rtol=2e-3, atol=2e-4)
