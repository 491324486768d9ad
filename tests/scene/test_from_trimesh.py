"""Objects of trimesh as scenes: materials, colours and transforms."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from PIL import Image

import warp_gi as gi
from warp_gi.color import decode_srgb


def test_a_mesh_is_a_scene_of_its_triangles():
    box = trimesh.creation.box((2, 4, 6))
    scene = gi.load_scene(box, environment=1.0, scale=0.5)
    assert scene.triangle_count == 12 and scene.environment is not None
    np.testing.assert_allclose(scene.bounds, [[-0.5, -1, -1.5], [0.5, 1, 1.5]])
    assert (scene.materials[0].base_color, scene.materials[0].specular) == ((0.8, 0.8, 0.8), 0.0)


def test_transforms_and_meshes_that_stand_twice():
    box = trimesh.creation.box((1, 1, 1))
    world = trimesh.Scene()
    place = np.eye(4)
    place[:3, 3] = [5, 0, 0]
    world.add_geometry(box, node_name="a", geom_name="box")
    world.graph.update(frame_to="b", frame_from="a", matrix=place, geometry="box")
    turn = trimesh.transformations.rotation_matrix(np.pi / 2, [0, 0, 1])
    world.graph.update(frame_to="c", frame_from="b", matrix=place @ turn, geometry="box")
    scene = gi.load_scene(world)
    assert sorted(scene.object_names) == ["a", "b", "c"] and scene.triangle_count == 36
    np.testing.assert_allclose(scene.bounds, [[-0.5, -0.5, -0.5], [10.5, 0.5, 0.5]], atol=1e-6)
    assert scene.nodes[0].meshes[0] is scene.nodes[1].meshes[0]


def test_materials_of_both_kinds_with_textures():
    image = Image.fromarray(np.full((2, 3, 3), (10, 20, 30), np.uint8))
    physical = trimesh.visual.material.PBRMaterial(
        name="p",
        baseColorFactor=[255, 51, 0, 255],
        metallicFactor=0.25,
        roughnessFactor=0.5,
        baseColorTexture=image,
        alphaMode="MASK",
        alphaCutoff=0.25,
        doubleSided=False,
        emissiveFactor=[1.0, 0.5, 0.0],
    )
    square = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 1, 2]], process=False)
    square.visual = trimesh.visual.TextureVisuals(uv=[[0, 0], [1, 0], [1, 1]], material=physical)
    (material,) = gi.load_scene(square).materials
    assert material.base_color == pytest.approx((1.0, 0.2, 0.0)) and material.emission == (1.0, 0.5, 0.0)
    assert (material.metallic, material.roughness, material.alpha_cutoff) == (0.25, 0.5, 0.25)
    np.testing.assert_array_equal(material.base_color_texture.pixels[0, 0], [10, 20, 30, 255])
    assert not material.double_sided
    np.testing.assert_array_equal(gi.load_scene(square)._flat.uvs, [[0, 0], [1, 0], [1, 1]])
    square.visual.material = trimesh.visual.material.SimpleMaterial(image=image, diffuse=[255, 255, 255, 255])
    assert gi.load_scene(square).materials[0].base_color_texture.pixels.shape == (2, 3, 4)


def test_colors_of_vertices_and_of_faces():
    points, faces = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]]
    vertex = trimesh.Trimesh(points, faces, vertex_colors=[[51, 0, 255, 255]] * 4, process=False)
    mesh = gi.load_scene(vertex).nodes[0].meshes[0]
    np.testing.assert_allclose(mesh.colors, np.tile([decode_srgb(np.array(0.2)), 0, 1, 1], (4, 1)), atol=1e-6)
    assert mesh.material.base_color == (1.0, 1.0, 1.0)
    face = trimesh.Trimesh(points, faces, face_colors=[[255, 0, 0, 255], [0, 255, 0, 255]], process=False)
    flat = gi.load_scene(face)._flat
    np.testing.assert_array_equal(flat.colors[flat.indices][:, :, :3], [[[1, 0, 0]] * 3, [[0, 1, 0]] * 3])


def test_points_are_named_and_other_things_refused():
    world = trimesh.Scene([trimesh.creation.box(), trimesh.PointCloud([[0, 0, 0]])])
    with pytest.warns(gi.UnsupportedWarning, match="the trimesh object' uses points and lines"):
        assert gi.load_scene(world).triangle_count == 12
    with pytest.raises(gi.SceneError, match=r"expected a trimesh\.Trimesh or trimesh\.Scene, got a PointCloud"):
        gi.load_scene(trimesh.PointCloud([[0, 0, 0]]))
    with pytest.raises(gi.OptionError, match="path of a scene file or an object of trimesh, got a int"):
        gi.load_scene(7)
    with pytest.raises(gi.SceneError, match="holds no triangles"):
        gi.load_scene(trimesh.Scene())


def test_looking_at_normals_does_not_make_a_mesh_smooth():
    box = trimesh.creation.box()
    assert np.isfinite(box.vertex_normals).all()
    assert gi.load_scene(box).nodes[0].meshes[0].normals is None
    sphere = trimesh.creation.icosphere(subdivisions=1)
    exact = sphere.vertices / np.linalg.norm(sphere.vertices, axis=1, keepdims=True)
    given = trimesh.Trimesh(sphere.vertices, sphere.faces, vertex_normals=exact.astype(np.float32), process=False)
    np.testing.assert_allclose(gi.load_scene(given).nodes[0].meshes[0].normals, exact, atol=1e-6)


def test_meshes_far_from_their_own_origin_keep_their_digits():
    """One under a transform that brings it back, and one that stays far away and is recentred."""
    place = np.array([446_123.4, 52.1, 5_411_987.6])
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    far = trimesh.Trimesh(box.vertices + place, box.faces, process=False)
    back, half = np.eye(4), np.diag([0.5, 0.5, 0.5, 1.0])
    back[:3, 3] = -place
    world = trimesh.Scene()
    world.add_geometry(far, node_name="near", transform=back)
    np.testing.assert_allclose(gi.load_scene(world).bounds, box.bounds, atol=1e-6)
    world = trimesh.Scene()
    world.add_geometry(far, node_name="a", geom_name="box", transform=half)
    world.graph.update(frame_to="b", frame_from="a", matrix=np.eye(4), geometry="box")
    scene = gi.load_scene(world, recentre=True)
    np.testing.assert_allclose(scene.bounds + scene.offset, (box.bounds + place) / 2, atol=1e-6)
    assert scene.nodes[0].meshes[0] is scene.nodes[1].meshes[0]


@pytest.mark.parametrize("kind", ["vertex_colors", "face_colors"])
def test_coverage_of_colors_is_blended(kind):
    points, faces = [[0, 0, 0], [1, 0, 0], [1, 1, 0]], [[0, 1, 2]]
    count = 3 if kind == "vertex_colors" else 1
    clear = trimesh.Trimesh(points, faces, process=False, **{kind: [[255, 255, 255, 64]] * count})
    scene = gi.load_scene(clear)
    assert scene.materials[0].alpha_blend and scene.materials[0].alpha_cutoff is None
    starts = np.float32(np.column_stack([np.linspace(0.6, 0.8, 4000), np.full(4000, 0.2), np.ones(4000)]))
    stopped = (scene.bvh("cpu").intersect(starts, np.float32([[0, 0, -1]] * 4000)).face.numpy() == 0).mean()
    assert abs(stopped - 64 / 255) < 4 * np.sqrt(0.25 * 0.75 / 4000)
    opaque = trimesh.Trimesh(points, faces, process=False, **{kind: [[255, 255, 255, 255]] * count})
    assert not gi.load_scene(opaque).materials[0].lets_rays_pass
