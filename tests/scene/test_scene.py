"""Scene: what it makes of nodes, and what it refuses."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scene_tools import TRIANGLE_UVS, triangle

from warp_gi.color import SRGB_TO_LINEAR
from warp_gi.errors import SceneError
from warp_gi.kernels import types
from warp_gi.scene.model import Keyframe, Material, Node, PunctualLight, Texture
from warp_gi.scene.scene import Scene
from warp_gi.scene.textures import box_means, linear_rgb, texture_table


def checker(size: int = 4) -> np.ndarray:
    """Return RGBA pixels that differ everywhere."""
    pixels = np.arange(size * size * 4, dtype=np.uint8).reshape(size, size, 4)
    pixels[..., 3] = 255
    return pixels


def test_nodes_are_flattened_into_world_space():
    red, blue = Material("red"), Material("blue")
    turned = np.eye(4)
    turned[:3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 2]]  # quarter turn about z, z doubled
    turned[:3, 3] = [10, 0, 0]
    normals = np.tile(np.float32([0, 0.6, 0.8]), (3, 1))
    scene = Scene(
        [
            Node("empty", parent_from_node=np.diag([2.0, 2.0, 2.0, 1.0])),
            Node("a", [triangle(red), triangle(blue)], parent=0),
            Node("b", [triangle(red, normals=normals, uvs=TRIANGLE_UVS)], turned),
        ]
    )
    g = scene.data("cpu").geometry
    assert scene.triangle_count == 3 and [m.name for m in scene.materials] == ["red", "blue"]
    assert scene.object_names == ["a", "b"]
    np.testing.assert_array_equal(g.objects.numpy(), [0, 0, 1])
    np.testing.assert_array_equal(g.materials.numpy(), [0, 1, 0])
    np.testing.assert_array_equal(g.indices.numpy(), np.arange(9).reshape(3, 3))
    np.testing.assert_allclose(g.points.numpy()[:3], [[0, 0, 0], [2, 0, 0], [0, 2, 0]])
    np.testing.assert_allclose(g.points.numpy()[6:], [[10, 0, 0], [10, 1, 0], [9, 0, 0]], atol=1e-6)
    np.testing.assert_array_equal(g.normals.numpy()[:6], 0)
    expected = np.array([-0.6, 0, 0.4]) / np.hypot(0.6, 0.4)  # inverse transpose: z halved
    np.testing.assert_allclose(g.normals.numpy()[6:], np.tile(expected, (3, 1)), atol=1e-6)
    np.testing.assert_array_equal(g.uvs.numpy()[6:], TRIANGLE_UVS)
    np.testing.assert_allclose(scene.bounds, [[0, 0, 0], [10, 2, 0]], atol=1e-6)
    assert g.previous_points.ptr == g.points.ptr  # nothing moves: no second copy


def test_a_mirrored_node_keeps_its_front():
    normals = np.tile(np.float32([0, 0, 1]), (3, 1))
    scene = Scene([Node("mirrored", [triangle(normals=normals)], np.diag([-1.0, 1.0, 1.0, 1.0]))])
    g = scene.data("cpu").geometry
    p0, p1, p2 = g.points.numpy()[g.indices.numpy()[0]]
    assert np.cross(p1 - p0, p2 - p0)[2] > 0
    np.testing.assert_allclose(g.normals.numpy(), normals)


def test_unusable_normals_are_shaded_flat():
    normals = np.float32([[0, 0, 0], [np.nan, 0, 1], [0, 0, 3]])
    scene = Scene([Node("n", [triangle(normals=normals)])])
    np.testing.assert_array_equal(scene.data("cpu").geometry.normals.numpy(), [[0, 0, 0], [0, 0, 1], [0, 0, 1]])


def test_unusable_texture_coordinates_become_finite():
    scene = Scene([Node("n", [triangle(uvs=np.float32([[np.nan, 0.5], [np.inf, -np.inf], [3e38, -3e38]]))])])
    np.testing.assert_array_equal(scene.data("cpu").geometry.uvs.numpy(), np.float32([[0, 0.5], [0, 0], [1e9, -1e9]]))


def test_textures_are_packed_bottom_row_first_and_shared_pixels_once():
    pixels = checker()
    color = Texture("c", pixels, True, ("clamp", "mirror"))
    table, texels = texture_table([color, Texture("n", pixels, False)])
    assert len(texels) == 16 and list(table["start"]) == [0, 0] and list(table["srgb"]) == [1, 0]
    assert table["wrap_u"][0] == types.WRAP_CLAMP and table["wrap_v"][0] == types.WRAP_MIRROR
    r, g, b, a = (int(x) for x in pixels[3, 1])
    assert texels[1] == r | g << 8 | b << 16 | a << 24


def test_srgb_table_has_the_values_of_the_standard():
    assert SRGB_TO_LINEAR.dtype == np.float32 and SRGB_TO_LINEAR.shape == (256,)
    np.testing.assert_allclose(SRGB_TO_LINEAR[[0, 10, 188, 255]], [0, 10 / 255 / 12.92, 0.5028865, 1], rtol=1e-6)


def test_materials_reach_the_kernels():
    texture = Texture("t", checker())
    fields = {"emission": (1, 2, 3), "emission_texture": texture, "alpha_cutoff": 0.25}
    material = Material("m", (0.1, 0.2, 0.3), 0.9, 0.4, 0.5, 0.6, **fields)
    row = Scene([Node("n", [triangle(material)])]).data("cpu").materials.numpy()[0]
    np.testing.assert_allclose(row["base_color"], [0.1, 0.2, 0.3])
    np.testing.assert_allclose([row[k] for k in ("alpha", "metallic", "roughness", "specular")], [0.9, 0.4, 0.5, 0.6])
    np.testing.assert_allclose(row["emission"], [1, 2, 3])
    assert row["alpha_cutoff"] == 0.25 and row["double_sided"] == 1
    assert row["emission_texture"] == 0 and row["base_color_texture"] == -1
    opaque = Scene([Node("n", [triangle()])]).data("cpu").materials.numpy()[0]
    assert opaque["alpha_cutoff"] < 0


def test_emitters_come_triangles_first_with_their_powers():
    lamp = Material("lamp", emission=(2.0, 2.0, 2.0), double_sided=False)
    both = Material("both", emission=(2.0, 2.0, 2.0))
    lights = [
        PunctualLight("point", (1.0, 1.0, 1.0), position=(0, 5, 0)),
        PunctualLight("spot", (1.0, 1.0, 1.0), inner_cone=0.0, outer_cone=np.pi / 2),
        PunctualLight("directional", (3.0, 3.0, 3.0), direction=(0, -2, 0)),
    ]
    scene = Scene([Node("n", [triangle(), triangle(lamp), triangle(both)])], lights)
    assert scene.emitter_count == 5
    radius = np.sqrt(2) / 2
    expected = [np.pi * 0.5 * 2, 2 * np.pi * 0.5 * 2, 4 * np.pi, np.pi, np.pi * radius**2 * 3]
    np.testing.assert_allclose(scene.emitter_powers(), expected, rtol=1e-6)
    data = scene.data("cpu")
    assert data.emitters.count == 5 and data.radius == pytest.approx(radius)
    np.testing.assert_array_equal(data.geometry.emitters.numpy(), [-1, 0, 1])
    rows = data.emitters.emitters.numpy()
    kinds = [types.EMITTER_TRIANGLE] * 2 + [types.EMITTER_POINT, types.EMITTER_SPOT, types.EMITTER_DIRECTIONAL]
    np.testing.assert_array_equal(rows["kind"], kinds)
    np.testing.assert_array_equal(rows["triangle"], [1, 2, -1, -1, -1])
    np.testing.assert_allclose(rows["position"][2], [0, 5, 0])
    np.testing.assert_allclose(rows["direction"][4], [0, -1, 0])
    np.testing.assert_allclose(rows["cos_outer"][3], 0, atol=1e-6)


def test_triangles_without_area_or_light_are_no_emitters():
    pixels = np.zeros((8, 8, 4), np.uint8)
    pixels[0, 7, :3] = 255  # only the top right texel shines
    lamp = Material("lamp", emission=(1, 1, 1), emission_texture=Texture("t", pixels, wrap=("clamp", "clamp")))
    line = np.float32([[0, 0, 0], [1, 0, 0], [2, 0, 0]])
    dark = triangle(lamp, uvs=TRIANGLE_UVS * 0.25)
    lit = triangle(lamp, uvs=TRIANGLE_UVS * 0.5 + 0.5)
    flat = triangle(lamp, points=line, uvs=TRIANGLE_UVS)
    scene = Scene([Node("n", [dark, lit, flat])])
    np.testing.assert_array_equal(scene.data("cpu").geometry.emitters.numpy(), [-1, 0, -1])
    assert scene.emitter_powers()[0] > 0


@pytest.mark.parametrize("wrap", ["repeat", "clamp", "mirror"])
def test_box_means_are_zero_only_where_lookups_are(wrap):
    rng = np.random.default_rng(5)
    pixels = np.zeros((8, 16, 4), np.uint8)
    pixels[rng.integers(0, 8, 4), rng.integers(0, 16, 4), :3] = 200
    texture = Texture("t", pixels, wrap=(wrap, wrap))
    low = rng.uniform(-2, 2, (200, 2))
    high = low + rng.uniform(0, 0.4, (200, 2))
    image = linear_rgb(texture)
    means = box_means(image, texture.wrap, low, high)
    whole = box_means(image, texture.wrap, np.array([[-0.5, -0.5]]), np.array([[2.5, 2.5]]))[0]
    image = image[::-1]

    def texel(i, size):
        if wrap == "clamp":
            return np.clip(i, 0, size - 1)
        if wrap == "repeat":
            return i % size
        return np.minimum(i % (2 * size), 2 * size - 1 - i % (2 * size))

    dark = 0
    for a, b, mean in zip(low, high, means, strict=True):
        us, vs = (np.linspace(a[k], b[k], 40) * (16, 8)[k] - 0.5 for k in (0, 1))
        columns = texel(np.unique([np.floor(us), np.floor(us) + 1]).astype(int), 16)
        rows = texel(np.unique([np.floor(vs), np.floor(vs) + 1]).astype(int), 8)
        if image[np.ix_(rows, columns)].max() > 0:
            assert mean.min() > 0
        dark += mean.max() == 0
    assert 5 < dark < 195
    np.testing.assert_allclose(whole, image.mean((0, 1)), rtol=1e-6)


def quad_material(**fields):
    return [Node("n", [triangle(Material("paint", **fields))])]


NAN_POINTS = np.float32([[0, 0, 0], [1, np.nan, 0], [0, 1, 0]])
BAD_SCENES = {
    "nan": (lambda: Scene([Node("hill", [triangle(points=NAN_POINTS)])]), "'hill'.*1 of 3 vertices are not finite"),
    "index": (lambda: Scene([Node("n", [triangle(indices=np.array([[0, 1, 3]]))])]), "index 3 is out of range.*3 vert"),
    "negative index": (lambda: Scene([Node("n", [triangle(indices=np.array([[0, 1, -1]]))])]), "index -1 is out"),
    "float index": (lambda: Scene([Node("n", [triangle(indices=np.eye(3))])]), "indices must be integers"),
    "no triangles": (lambda: Scene([Node("n", [triangle(indices=np.zeros((0, 3), int))])]), "no triangles"),
    "no nodes": (lambda: Scene([]), "no triangles"),
    "normals": (lambda: Scene([Node("n", [triangle(normals=np.zeros((2, 3)))])]), r"normals must be \[3, 3\]"),
    "parent": (lambda: Scene([Node("n", [triangle()], parent=0)]), "parent must stand before"),
    "transform": (lambda: Scene([Node("n", [triangle()], np.full((4, 4), np.nan))]), "finite 4x4"),
    "far": (lambda: Scene([Node("n", [triangle()], np.diag([1e200, 1.0, 1.0, 1.0]))]), "past the range of float32"),
    "empty image": (
        lambda: Scene(quad_material(base_color_texture=Texture("wood", np.zeros((0, 4, 4), np.uint8)))),
        "'paint', texture 'wood'.*at least 1x1 pixels, got 4x0",
    ),
    "pixels": (
        lambda: Scene(quad_material(base_color_texture=Texture("wood", np.zeros((4, 4, 3), np.uint8)))),
        "expected uint8 pixels",
    ),
    "wrap": (
        lambda: Scene(quad_material(normal_texture=Texture("t", checker(), wrap=("repeat", "tile")))),
        "unknown wrap mode 'tile'",
    ),
    "cutoff": (
        lambda: Scene(quad_material(alpha_cutoff=-1.5)),
        "'paint': alpha_cutoff must be from 0 to inf, got -1.5",
    ),
    "roughness": (lambda: Scene(quad_material(roughness=float("nan"))), "roughness must be from 0 to 1"),
    "emission": (lambda: Scene(quad_material(emission=(-1, 0, 0))), "emission must be from 0"),
    "color": (lambda: Scene(quad_material(base_color=(1, 1))), "base_color must be 3 numbers"),
    "light": (lambda: Scene(quad_material(), [PunctualLight("sun", (1, 1, 1))]), "unknown kind 'sun'"),
    "cone": (
        lambda: Scene(quad_material(), [PunctualLight("spot", (1, 1, 1), inner_cone=1.0)]),
        "inner_cone < outer_cone",
    ),
    "direction": (
        lambda: Scene(quad_material(), [PunctualLight("directional", (1, 1, 1), direction=(0, 0, 0))]),
        "direction must not be zero",
    ),
    "keyframes": (
        lambda: Scene([Node("n", [triangle()], keyframes=[Keyframe(1.0), Keyframe(0.5)])]),
        "times must rise, got 1.0 s before 0.5 s",
    ),
}


@pytest.mark.parametrize("case", BAD_SCENES)
def test_bad_scenes_are_one_clear_line(case):
    make, message = BAD_SCENES[case]
    with pytest.raises(SceneError, match=message) as error:
        make()
    assert "\n" not in str(error.value)


def test_only_triangles_with_holes_are_masked():
    pixels = np.full((8, 8, 4), 255, np.uint8)
    pixels[:4, :, 3] = 0  # the upper half is a hole
    holed = Material("holed", base_color_texture=Texture("t", pixels, wrap=("clamp", "clamp")), alpha_cutoff=0.5)
    solid = Material("solid", base_color_texture=holed.base_color_texture)
    gone, there = (Material(alpha=alpha, alpha_cutoff=0.5) for alpha in (0.25, 0.75))
    low, high = TRIANGLE_UVS * [1.0, 0.25], TRIANGLE_UVS
    meshes = [
        triangle(m, uvs=uv) for m, uv in ((holed, low), (holed, high), (solid, high), (gone, high), (there, high))
    ]
    bvh = Scene([Node("n", meshes)]).data("cpu").bvh
    np.testing.assert_array_equal(bvh.face_masks.numpy(), [-1, 0, -1, 1, -1])
    np.testing.assert_array_equal(bvh.masks.numpy()["texture"], [0, -1])
    assert Scene([Node("n", [meshes[0], meshes[2]])]).data("cpu").bvh.face_masks is None


HASH_SCENE = """
import numpy as np
from warp_gi.scene.model import Material, Mesh, Node, Texture
from warp_gi.scene.scene import Scene
pixels = np.arange(64, dtype=np.uint8).reshape(4, 4, 4)
material = Material("m", base_color_texture=Texture("t", pixels), alpha_cutoff=0.5)
points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
scene = Scene([Node("n", [Mesh(points, np.array([[0, 1, 2]], np.int32), material, uvs=points[:, :2])])])
"""


def test_hashes_are_equal_in_every_process():
    names: dict = {}
    exec(HASH_SCENE, names)
    code = HASH_SCENE + "print(scene.geometry_hash, scene.hash)"
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert printed.split()[-2:] == [names["scene"].geometry_hash, names["scene"].hash]


def test_hashes_change_with_what_they_stand_for():
    def build(light=(1.0, 1.0, 1.0), alpha=255, uv=1.0, environment=None, **fields):
        pixels = checker()
        pixels[0, 0, 3] = alpha
        material = Material("m", base_color_texture=Texture("t", pixels), **fields)
        lights = [PunctualLight("point", light)]
        return Scene([Node("n", [triangle(material, uvs=TRIANGLE_UVS * uv)])], lights, environment)

    base = build()
    assert build().hash == base.hash and build().geometry_hash == base.geometry_hash
    for other in (build(emission=(1, 0, 0)), build(light=(2.0, 0, 0)), build(environment=(1, 1, 1)), build(alpha=0)):
        assert other.geometry_hash == base.geometry_hash and other.hash != base.hash
    masked = build(alpha_cutoff=0.5)
    others = [build(alpha_cutoff=0.6), build(alpha=0, alpha_cutoff=0.5), build(uv=0.5, alpha_cutoff=0.5)]
    assert len({scene.geometry_hash for scene in (base, masked, *others)}) == 5
    moving = build()
    moving.animate("n", [Keyframe(0.0), Keyframe(1.0, (1, 0, 0))])
    assert moving.geometry_hash != base.geometry_hash


def test_hashes_follow_edits_until_the_first_frame():
    """A hash that is asked for early must not be that of the scene before an edit: bakes are kept by it."""

    def build(color=(0.5, 0.5, 0.5), cutoff=None, light=1.0, at=0.0):
        pixels = checker()
        material = Material("m", color, base_color_texture=Texture("t", pixels), alpha_cutoff=cutoff)
        lights = [PunctualLight("point", (light,) * 3, position=(at, 0.0, 0.0))]
        return Scene([Node("n", [triangle(material, uvs=TRIANGLE_UVS)])], lights)

    scene = build()
    seen = {(scene.geometry_hash, scene.hash)}
    material = scene.materials[0]
    material.base_color = (0.1, 0.2, 0.3)
    assert (scene.geometry_hash, scene.hash) == (build().geometry_hash, build((0.1, 0.2, 0.3)).hash)
    material.alpha_cutoff = 0.5
    scene.lights[0].intensity = (2.0, 2.0, 2.0)
    other = build((0.1, 0.2, 0.3), 0.5, 2.0)
    seen.add((scene.geometry_hash, scene.hash))
    assert (scene.geometry_hash, scene.hash) == (other.geometry_hash, other.hash)
    material.base_color_texture.pixels[0, 0, 3] = 0
    seen.add((scene.geometry_hash, scene.hash))
    assert len({a for a, _ in seen}) == len({b for _, b in seen}) == 3
    scene.data("cpu")
    assert (scene.geometry_hash, scene.hash) in seen


def test_the_hash_follows_lights_that_frames_read_anew():
    node = Node("lamp", [], keyframes=[Keyframe(0.0), Keyframe(1.0, (1, 0, 0))])
    scene = Scene([node, Node("n", [triangle()])], [PunctualLight("point", (1.0, 1.0, 1.0), node=0)])
    scene.data("cpu")
    before = scene.hash
    scene.lights[0].intensity = (2.0, 1.0, 1.0)
    scene.check_unchanged()
    assert scene.hash != before


def test_the_environment_can_be_changed_without_a_new_build():
    scene = Scene([Node("n", [triangle()])])
    data = scene.data("cpu")
    points, bvh = data.geometry.points.ptr, scene.bvh("cpu")
    assert data.environment.kind == types.ENVIRONMENT_NONE and scene.environment is None
    before = scene.hash
    scene.environment = (0.5, 0.25, 1.0)
    assert scene.hash != before
    assert scene.data("cpu").environment.kind == types.ENVIRONMENT_CONSTANT
    np.testing.assert_allclose(list(scene.data("cpu").environment.radiance), [0.5, 0.25, 1.0])
    assert scene.data("cpu").geometry.points.ptr == points and scene.bvh("cpu") is bvh
    scene.environment = None
    assert scene.data("cpu").environment.kind == types.ENVIRONMENT_NONE and scene.hash == before
    with pytest.raises(SceneError):
        scene.environment = "no/such/sky.exr"


def test_memory_counts_the_buffers():
    texture = Texture("t", checker())
    scene = Scene([Node("n", [triangle(Material(base_color_texture=texture))])])
    data = scene.data("cpu")
    g = data.geometry
    arrays = (g.points, g.normals, g.uvs, g.indices, g.materials, g.objects, g.emitters, data.texels)
    assert scene.memory_bytes == sum(array.capacity for array in arrays)


@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device")
def test_both_devices_hold_the_same():
    material = Material("m", emission=(1, 1, 1), base_color_texture=Texture("t", checker()), alpha_cutoff=0.5)
    scene = Scene([Node("n", [triangle(material, uvs=TRIANGLE_UVS)])], environment=(1, 1, 1))
    cpu, cuda = scene.data("cpu"), scene.data("cuda")
    for name in ("points", "normals", "uvs", "indices", "materials", "objects", "emitters"):
        np.testing.assert_array_equal(getattr(cpu.geometry, name).numpy(), getattr(cuda.geometry, name).numpy())
    for name in ("materials", "textures", "texels", "srgb_to_linear"):
        np.testing.assert_array_equal(getattr(cpu, name).numpy(), getattr(cuda, name).numpy())


def test_a_scene_leaves_the_nodes_it_was_given():
    node = Node("n", [triangle()])
    scene = Scene([node])
    scene.animate("n", [Keyframe(0.0)])
    assert node.keyframes is None and scene.is_animated
    assert not Scene([replace(node)]).is_animated
