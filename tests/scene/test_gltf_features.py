"""Features of glTF: morph weights, extensions, textures with coordinates of their own, cameras, versions."""

from __future__ import annotations

import io
import json
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scene_tools import GlbBuilder, card, png

import warp_gi as gi
from warp_gi.color import decode_srgb

CASES = Path(__file__).parents[1] / "cases"
WALL = gi.Camera.look_at((0, 0, 3), (0, 0, 0), hfov=30, resolution=(32, 24))
SQUARE = np.float32([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
CORNERS = np.float32([[0, 1], [1, 1], [1, 0], [0, 0]])  # v down: the image stands upright


def picture(scene, camera=WALL, spp=4, sky=1.0):
    scene.environment = sky
    return next(gi.render(scene, camera, gi.Pipeline(spp=spp)))


def square(material=None, uvs=CORNERS, further=None, **extra):
    """Return a builder of a square of a material, with one or two sets of coordinates."""
    glb = GlbBuilder()
    attributes = {"POSITION": glb.accessor(SQUARE), "TEXCOORD_0": glb.accessor(uvs)}
    if further is not None:
        attributes["TEXCOORD_1"] = glb.accessor(further)
    primitive = {"attributes": attributes, "indices": glb.accessor([0, 1, 2, 0, 2, 3], np.uint16), **extra}
    if material is not None:
        primitive["material"] = glb.add("materials", material)
    glb.add("nodes", {"mesh": glb.add("meshes", {"primitives": [primitive]})})
    return glb


def image(glb, pixels, **sampler):
    """Add a texture of uint8 pixels and return its index."""
    number = glb.add("images", {"bufferView": glb.view(png(np.asarray(pixels, np.uint8)))})
    return glb.add("textures", {"source": number, "sampler": glb.add("samplers", sampler)})


def loaded(glb, folder):
    return gi.load_scene(glb.write(folder / "a.glb"))


# ---- cases ----


@pytest.mark.parametrize("name", ["mesh", "node"])
def test_default_morph_weights(name):
    scene = gi.load_scene(CASES / "morph-default-weights" / f"{name}.glb")
    np.testing.assert_array_equal(scene.bounds, [[-1, -1, 1], [1, 1, 1]])


def test_morphed_normals_and_weights_of_one_node_only(tmp_path):
    glb = square()
    primitive = glb.json["meshes"][0]["primitives"][0]
    primitive["attributes"]["NORMAL"] = glb.accessor(np.tile([0, 0, 1], (4, 1)))
    target = {"POSITION": glb.accessor(np.tile([0, 0, 2], (4, 1))), "NORMAL": glb.accessor(np.tile([1, 0, -1], (4, 1)))}
    primitive["targets"] = [target]
    glb.add("nodes", {"mesh": 0, "weights": [0.5], "translation": [5, 0, 0]})
    plain, morphed = (node.meshes[0] for node in loaded(glb, tmp_path).nodes)
    np.testing.assert_array_equal(plain.points, SQUARE)
    np.testing.assert_array_equal(morphed.points, SQUARE + np.float32([0, 0, 1]))
    np.testing.assert_array_equal(morphed.normals, [[0.5, 0, 0.5]] * 4)


def test_specular_glossiness_without_specular_is_lambert():
    frame = picture(gi.load_scene(CASES / "gltf-extensions-dropped" / "spec_gloss.glb"))
    for name in ("albedo", "beauty"):
        np.testing.assert_allclose(frame.numpy(name).reshape(-1, 3), np.tile([0.1, 0.4, 0.1], (768, 1)), atol=1e-5)


def test_specular_glossiness_is_converted(tmp_path):
    old = {"diffuseFactor": [0.8, 0.4, 0.2, 0.5], "specularFactor": [0.5, 0.25, 0.1], "glossinessFactor": 0.75}
    (material,) = loaded(square({"extensions": {"KHR_materials_pbrSpecularGlossiness": old}}), tmp_path).materials
    assert material.base_color == (0.4, 0.2, 0.1) and material.alpha == 0.5
    assert (material.metallic, material.roughness, material.specular) == (0.0, 0.25, 1.0)
    assert material.reflectance == (0.5, 0.25, 0.1)


def test_textures_of_specular_glossiness_are_taken_apart(tmp_path):
    glb = square()
    both = image(glb, np.full((2, 2, 4), (188, 0, 0, 204)))
    diffuse = image(glb, np.full((4, 4, 4), (255, 188, 0, 128)))
    old = {"diffuseTexture": {"index": diffuse}, "specularGlossinessTexture": {"index": both}, "glossinessFactor": 0.5}
    index = glb.add("materials", {"extensions": {"KHR_materials_pbrSpecularGlossiness": old}})
    glb.json["meshes"][0]["primitives"][0]["material"] = index
    material = loaded(glb, tmp_path).materials[-1]
    left = 1.0 - decode_srgb(np.array(188 / 255))
    linear = decode_srgb(material.base_color_texture.pixels[0, 0, :3] / 255.0)
    np.testing.assert_allclose(linear, [left, left * decode_srgb(np.array(188 / 255)), 0.0], atol=4e-3)
    assert material.base_color_texture.pixels[0, 0, 3] == 128
    assert material.metallic_roughness_texture.pixels[0, 0, 1] == 255 - 102  # 1 - 0.5 * 0.8
    assert material.reflectance_texture.pixels[0, 0, 0] == 188 and material.reflectance_texture.srgb


def test_unlit_is_seen_in_the_dark():
    scene = gi.load_scene(CASES / "gltf-extensions-dropped" / "unlit.glb")
    for sky in (None, 1.0):
        beauty = picture(scene, sky=sky).numpy("beauty").reshape(-1, 3)
        np.testing.assert_allclose(beauty, np.tile([0.5, 0.25, 0.1], (768, 1)), rtol=1e-5)


def test_glass_is_seen_through():
    """A clear pane before a red wall: the mean over the layers, without a warning."""
    path = CASES / "gltf-extensions-dropped" / "glass.glb"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = gi.load_scene(path)
    assert (scene.materials[0].transmission, scene.materials[0].roughness) == (1.0, 0.0)
    albedo = picture(scene).numpy("albedo").reshape(-1, 3)
    np.testing.assert_allclose(albedo, np.tile([0.04 + 0.96 * 0.8, 0.04, 0.04], (768, 1)), atol=2e-3)


def test_coloured_glass_tints_what_is_behind(tmp_path):
    """Without a reflection, the sky through it has its base colour."""
    glb = square({"pbrMetallicRoughness": {"baseColorFactor": [0.1, 1, 0.4, 1], "metallicFactor": 0}})
    glb.json["materials"][0]["extensions"] = {
        "KHR_materials_transmission": {"transmissionFactor": 1.0},
        "KHR_materials_specular": {"specularFactor": 0.0},
    }
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = loaded(glb, tmp_path)
    np.testing.assert_allclose(picture(scene).numpy("emission")[12, 16], [0.1, 1.0, 0.4], rtol=1e-3)


@pytest.mark.parametrize("info", [{"texCoord": 1}, {"extensions": {"KHR_texture_transform": {"scale": [0.25, 1]}}}, {}])
def test_transmission_textures_elsewhere_are_named(tmp_path, info):
    """They are looked up where the base colour's texture is; nothing is said where that is the same."""
    glb = square({"pbrMetallicRoughness": {"metallicFactor": 0}}, further=CORNERS[::-1])
    base, share = (image(glb, np.full((2, 2, 4), 255)) for _ in range(2))
    glb.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"] = {"index": base}
    extension = {"transmissionFactor": 1.0, "transmissionTexture": {"index": share, **info}}
    glb.json["materials"][0]["extensions"] = {"KHR_materials_transmission": extension}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        loaded(glb, tmp_path)
    assert [("coordinates of transmission textures" in str(one.message)) for one in caught] == [True] * bool(info)


def test_transmission_textures_without_one_of_the_colour_stand_where_they_say(tmp_path):
    """The right half is clear by the second set, the left half by the first, which is the normal map's."""
    glb = square({"pbrMetallicRoughness": {"metallicFactor": 0}}, further=np.float32([1, 0]) + CORNERS * [-1, 1])
    pixels = np.full((1, 2, 4), 255)
    pixels[0, 1, :3] = 0
    share, bumps = image(glb, pixels), image(glb, np.full((1, 1, 4), [128, 128, 255, 255]))
    glb.json["materials"][0]["normalTexture"] = {"index": bumps}
    extension = {"transmissionFactor": 1.0, "transmissionTexture": {"index": share, "texCoord": 1}}
    glb.json["materials"][0]["extensions"] = {"KHR_materials_transmission": extension}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = loaded(glb, tmp_path)
    low, high = scene.bounds[:, 0]
    rays = np.float32([[low + part * (high - low), 0.1, 5.0] for part in (0.25, 0.75)])
    face = scene.bvh("cpu").intersect(rays, np.float32([[0, 0, -1]] * 2)).face.numpy()
    assert face[0] >= 0 and face[1] < 0


def test_unlit_with_colors_of_vertices(tmp_path):
    glb = square({"extensions": {"KHR_materials_unlit": {}}})
    colors = glb.accessor(np.tile([0.5, 0.25, 1.0], (4, 1)))
    glb.json["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = colors
    scene = loaded(glb, tmp_path)
    np.testing.assert_allclose(picture(scene, sky=None).numpy("beauty")[12, 16], [0.5, 0.25, 1.0], rtol=1e-5)
    white = replace(scene.nodes[0].meshes[0], colors=None)
    share = scene.emitter_powers().sum() / gi.Scene([gi.Node("n", [white])]).emitter_powers().sum()
    assert share == pytest.approx(0.5 * 0.2126 + 0.25 * 0.7152 + 0.0722)


def test_every_instance_is_there():
    scene = gi.load_scene(CASES / "gltf-extensions-dropped" / "instancing.glb")
    assert scene.triangle_count == 6 and len(scene.object_names) == 3
    centers = [np.round(scene.node_box(i, 0.0).mean(axis=0), 6).tolist() for i in range(1, 4)]
    assert sorted(centers) == [[-0.2, 0, 0], [0, 0, 0], [0.2, 0, 0]]


def test_instances_turn_and_scale(tmp_path):
    glb = square()
    half = np.sqrt(0.5)
    given = {
        "ROTATION": glb.accessor([[0, 0, half, half], [0, 0, 0, 1]]),
        "SCALE": glb.accessor([[2, 1, 1], [1, 3, 1]]),
    }
    glb.json["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": given}}
    scene = loaded(glb, tmp_path)
    np.testing.assert_allclose(scene.node_box(1, 0.0)[1], [1, 2, 0], atol=1e-6)
    np.testing.assert_allclose(scene.node_box(2, 0.0)[1], [1, 3, 0], atol=1e-6)
    glb.json["accessors"][given["SCALE"]]["count"] = 1
    with pytest.raises(gi.SceneError, match="its instances have 1 and 2 values"):
        loaded(glb, tmp_path)


# ---- coats ----


def test_the_colour_of_a_coat_and_its_textures(tmp_path):
    """A mirror of a black base that is looked at along its normal shows the sky times its reflectance."""
    glb = square()
    specular = image(glb, np.full((1, 1, 4), (0, 0, 0, 128)))
    color = image(glb, np.full((1, 1, 3), (188, 255, 255)))
    coat = {
        "specularFactor": 0.5,
        "specularColorFactor": [10.0, 5.0, 100.0],
        "specularTexture": {"index": specular},
        "specularColorTexture": {"index": color},
    }
    surface = {"baseColorFactor": [0, 0, 0, 1], "metallicFactor": 0, "roughnessFactor": 0}
    material = {"pbrMetallicRoughness": surface, "extensions": {"KHR_materials_specular": coat}}
    glb.json["meshes"][0]["primitives"][0]["material"] = glb.add("materials", material)
    scene = loaded(glb, tmp_path)
    narrow = gi.Camera.look_at((0, 0, 3), (0, 0, 0), hfov=1, resolution=(4, 4))
    beauty = picture(scene, narrow, spp=64).numpy("beauty").reshape(-1, 3).mean(axis=0)
    red = decode_srgb(np.array(188 / 255))
    np.testing.assert_allclose(beauty, 0.5 * (128 / 255) * np.array([0.4 * red, 0.2, 1.0]), rtol=0.02)


@pytest.mark.parametrize(("ior", "expected"), [(1.5, 0.04), (2.0, 1 / 9), (1.0, 0.0), (0.0, 1.0)])
def test_index_of_refraction(ior, expected, tmp_path):
    glb = square({"extensions": {"KHR_materials_ior": {"ior": ior}}})
    assert loaded(glb, tmp_path).materials[0].reflectance == pytest.approx((expected,) * 3)


# ---- textures ----

RAMP = np.stack(
    [np.tile(np.arange(16) * 16, (16, 1)), np.tile(np.arange(16)[:, None] * 16, (1, 16)), np.zeros((16, 16))], 2
)


def ramp_value(u, v):
    """Return red and green of the ramp at v-down coordinates, 0 to 255, inside of its texels' centres."""
    return np.array([16 * (u * 16 - 0.5), 16 * (v * 16 - 0.5)])


@pytest.mark.parametrize("number", [0, 1])
def test_a_texture_has_coordinates_of_its_own(number, tmp_path):
    """The emission is looked up at offset + rotation * scale of a set, beside a base colour that is not moved."""
    further = np.float32([[0.2, 0.9], [0.8, 0.9], [0.8, 0.3], [0.2, 0.3]])
    glb = square(further=further)
    ramp = image(glb, RAMP)
    transform = {"offset": [0.25, 0.6], "rotation": np.pi / 2, "scale": [0.5, 0.25]}
    emissive = {"index": ramp, "texCoord": number, "extensions": {"KHR_texture_transform": transform}}
    material = {
        "pbrMetallicRoughness": {"baseColorTexture": {"index": ramp}, "metallicFactor": 0},
        "emissiveTexture": emissive,
        "emissiveFactor": [1, 1, 1],
    }
    glb.json["meshes"][0]["primitives"][0]["material"] = glb.add("materials", material)
    frame = picture(loaded(glb, tmp_path), replace(WALL, hfov=20.0), spp=1, sky=None)
    ways = replace(WALL, hfov=20.0).directions(np.array([[10.5, 8.5], [20.5, 15.5]]))
    for way, (x, y) in zip(ways, ((10, 8), (20, 15)), strict=True):
        s, t = (3 * way[0] / -way[2] + 1) / 2, 1 - (3 * way[1] / -way[2] + 1) / 2
        base = decode_srgb(ramp_value(s, t) / 255)
        np.testing.assert_allclose(frame.numpy("albedo")[y, x, :2], base, atol=0.02)
        if number == 1:
            s, t = 0.2 + 0.6 * s, 0.3 + 0.6 * t
        moved = 0.25 + 0.25 * t, 0.6 - 0.5 * s  # rotated by a quarter: (u, v) = (scale v, -scale u)
        np.testing.assert_allclose(frame.numpy("emission")[y, x, :2], decode_srgb(ramp_value(*moved) / 255), atol=0.02)


def test_a_webp_texture_is_read_in_the_place_of_its_stand_in(tmp_path):
    glb, file = square(), io.BytesIO()
    Image.fromarray(np.full((4, 4, 3), (200, 100, 50), np.uint8)).save(file, "WEBP", lossless=True)
    webp = glb.add("images", {"bufferView": glb.view(file.getvalue()), "mimeType": "image/webp"})
    texture = image(glb, np.zeros((4, 4, 3)))
    glb.json["textures"][texture]["extensions"] = {"EXT_texture_webp": {"source": webp}}
    glb.json["extensionsUsed"] = ["EXT_texture_webp"]
    material = glb.add("materials", {"pbrMetallicRoughness": {"baseColorTexture": {"index": texture}}})
    glb.json["meshes"][0]["primitives"][0]["material"] = material
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        (mesh,) = loaded(glb, tmp_path).nodes[0].meshes
    assert (mesh.material.base_color_texture.pixels[..., :3] == (200, 100, 50)).all()


def test_a_normal_map_has_coordinates_of_its_own(tmp_path):
    """A constant normal leans along +u of the texture: turned by a quarter, it leans along another axis."""
    glb = square()
    lean = image(glb, np.full((1, 1, 3), (218, 128, 218)))
    info = {"index": lean, "extensions": {"KHR_texture_transform": {"rotation": np.pi / 2}}}
    color = image(glb, np.full((1, 1, 3), 255))
    surface = {"metallicFactor": 0, "baseColorTexture": {"index": color}}
    index = glb.add("materials", {"normalTexture": info, "pbrMetallicRoughness": surface})
    glb.json["meshes"][0]["primitives"][0]["material"] = index
    scene = loaded(glb, tmp_path)
    moved = picture(scene, spp=1).numpy("normal")[12, 16]
    plain = scene.nodes[0].meshes[0]
    texture = replace(plain.material.normal_texture, transform=None)
    plain = replace(plain, material=replace(plain.material, normal_texture=texture))
    still = picture(gi.Scene([gi.Node("n", [plain])]), spp=1).numpy("normal")[12, 16]
    np.testing.assert_allclose(still, [0.707, 0, 0.707], atol=0.01)
    # u' = v (down), so that +u' is downwards in the picture
    np.testing.assert_allclose(moved, [0, -0.707, 0.707], atol=0.01)


def test_three_sets_are_named(tmp_path):
    glb = square(further=CORNERS)
    glb.json["meshes"][0]["primitives"][0]["attributes"]["TEXCOORD_2"] = glb.accessor(CORNERS)
    ramp = image(glb, RAMP)
    material = {
        "name": "m",
        "pbrMetallicRoughness": {"baseColorTexture": {"index": ramp}},
        "normalTexture": {"index": ramp, "texCoord": 1},
        "emissiveTexture": {"index": ramp, "texCoord": 2},
    }
    glb.json["meshes"][0]["primitives"][0]["material"] = glb.add("materials", material)
    with pytest.warns(gi.UnsupportedWarning, match=r"a third set of texture coordinates \(material 'm'\)"):
        loaded(glb, tmp_path)


def test_nearest_filtering_shows_texels_alone(tmp_path):
    glb = square()
    texels = np.arange(12, dtype=np.uint8).reshape(2, 2, 3) * 20
    sharp = image(glb, texels, magFilter=9728)
    surface = {"baseColorTexture": {"index": sharp}, "metallicFactor": 0}
    index = glb.add("materials", {"pbrMetallicRoughness": surface})
    glb.json["meshes"][0]["primitives"][0]["material"] = index
    scene = loaded(glb, tmp_path)
    assert scene.materials[0].base_color_texture.nearest
    albedo = picture(scene, spp=1).numpy("albedo")
    expected = decode_srgb(texels / 255.0)
    for (y, x), texel in zip(((2, 2), (2, 30), (22, 2), (22, 30)), expected.reshape(-1, 3), strict=True):
        np.testing.assert_allclose(albedo[y, x], texel, atol=1e-6)
    np.testing.assert_allclose(albedo[11, 15], expected[0, 0], atol=1e-6)  # up to the edge of the texel


def test_nearest_filtering_of_masks():
    pixels = np.zeros((1, 2, 4), np.uint8)
    pixels[0, 1] = 255
    texture = gi.Texture("t", pixels, wrap=("clamp", "clamp"), nearest=True)
    mesh = card(material=gi.Material(base_color_texture=texture, alpha_cutoff=0.9, specular=0.0))
    scene = gi.Scene([gi.Node("n", [replace(mesh, uvs=np.float32((mesh.points[:, :2] + 1) / 2))])])
    x = np.float32([-0.9, -0.02, 0.02, 0.9])
    origins = np.column_stack([x, np.full(4, 0.1), np.ones(4)]).astype(np.float32)
    hits = scene.bvh("cpu").intersect(origins, np.float32([[0, 0, -1]] * 4)).face.numpy()
    np.testing.assert_array_equal(hits >= 0, [False, False, True, True])


def test_a_cutoff_above_1_leaves_nothing(tmp_path):
    scene = loaded(square({"alphaMode": "MASK", "alphaCutoff": 1.5}), tmp_path)
    hit = scene.bvh("cpu").intersect(np.float32([[0.3, 0.1, 1]]), np.float32([[0, 0, -1]]))
    assert hit.face.numpy()[0] == -1


# ---- documents ----


@pytest.mark.parametrize("extras", [[1, 2], "text", 3, None, {"a": [{"b": None}]}, True])
def test_notes_of_programs_may_be_any_json(extras, tmp_path):
    glb = square({"extras": extras})
    for part in (glb.json, glb.json["asset"], glb.json["nodes"][0], glb.json["meshes"][0], glb.json["accessors"][0]):
        part["extras"] = extras
    assert loaded(glb, tmp_path).triangle_count == 2


@pytest.mark.parametrize(
    ("asset", "message"),
    [
        ({"version": "1.0"}, "is glTF version 1.0; only version 2.0"),
        ({"version": "2.1", "minVersion": "2.1"}, "needs glTF version 2.1; only version 2.0"),
        ({"version": 2}, "version must be a text such as '2.0', got 2"),
        ({}, "version must be a text such as '2.0', got None"),
    ],
)
def test_versions(asset, message, tmp_path):
    glb = square()
    glb.json["asset"] = asset
    with pytest.raises(gi.SceneError, match=message):
        loaded(glb, tmp_path)


def test_a_newer_version_that_needs_only_this_one(tmp_path):
    glb = square()
    glb.json["asset"] = {"version": "2.3", "minVersion": "2.0"}
    assert loaded(glb, tmp_path).triangle_count == 2


FAULTS = {
    "no asset": (lambda doc: doc.pop("asset"), "has no asset with a version"),
    "nodes": (lambda doc: doc.update(nodes={"a": 1}), "nodes: must be a list of objects"),
    "child": (lambda doc: doc["nodes"][0].update(children=[7]), "node 0: names node 7, and the file has 1 nodes"),
    "scene": (lambda doc: doc.update(scene=3), "the file: names scene 3, and the file has 1 scenes"),
    "accessor": (lambda doc: doc["meshes"][0]["primitives"][0].update(indices=99), "mesh 0: names accessor 99"),
    "kind": (lambda doc: doc["accessors"][0].update(type="VEC9"), "accessor 0: type must be one of SCALAR"),
    "component": (lambda doc: doc["accessors"][0].update(componentType=1), "accessor 0: componentType must be one of"),
    "count": (lambda doc: doc["accessors"][0].pop("count"), "accessor 0: lacks count"),
    "width": (lambda doc: doc["accessors"][0].update(type="VEC2"), "mesh 0: accessor 0 is VEC2, and has to have 3"),
    "view": (lambda doc: doc["accessors"][0].update(bufferView=40), "accessor 0: names buffer view 40"),
    "matrix": (lambda doc: doc["nodes"][0].update(matrix=[1, 2]), "node 0: matrix must be 16 numbers"),
    "turn": (lambda doc: doc["nodes"][0].update(rotation=[0, 0, 0, 0]), "node 0: rotation must be a unit quaternion"),
    "color": (
        lambda doc: doc["materials"][0].update(pbrMetallicRoughness={"baseColorFactor": "red"}),
        "material 0: baseColorFactor must be 4 numbers, got 'red'",
    ),
    "mode": (lambda doc: doc["materials"][0].update(alphaMode="GLASS"), "alphaMode must be OPAQUE, MASK or BLEND"),
    "material": (lambda doc: doc["meshes"][0]["primitives"][0].update(material=5), "mesh 0: names material 5"),
    "uv": (lambda doc: doc["accessors"][1].update(count=3), "has 4 positions and 3 values of TEXCOORD_0"),
}


@pytest.mark.parametrize("case", FAULTS)
def test_a_fault_is_named_as_glTF_names_it(case, tmp_path):
    change, message = FAULTS[case]
    glb = square({})
    glb.bytes()
    change(glb.json)
    document = json.loads(json.dumps(glb.json))
    document["buffers"] = [{"byteLength": len(glb.binary), "uri": "a.bin"}]
    (tmp_path / "a.bin").write_bytes(glb.binary)
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    with pytest.raises(gi.SceneError, match=message) as error:
        gi.load_scene(tmp_path / "a.gltf")
    assert "\n" not in str(error.value) and "Error" not in str(error.value)


# ---- cameras ----


def test_a_camera_without_an_aspect_ratio_keeps_its_yfov():
    (camera,) = gi.load_scene(CASES / "gltf-camera-aspect" / "camera.glb").cameras.values()
    for width, height in ((400, 400), (960, 540), (200, 500)):
        shown = camera.at_resolution(width, height)
        half = np.tan(np.radians(shown.hfov) / 2) * height / width
        assert 2 * np.arctan(half) == pytest.approx(0.8) and shown.resolution == (width, height)
    assert camera.at_resolution(200, 500).at_resolution(*camera.resolution).hfov == pytest.approx(camera.hfov)


def test_a_camera_that_is_a_reflection_is_left_out_with_a_line(tmp_path):
    glb = square()
    glb.add("nodes", {"camera": glb.add("cameras", {"type": "perspective", "perspective": {"yfov": 0.8}})})
    glb.json["nodes"][-1]["scale"] = [-1, 1, 1]
    glb.json["scenes"] = [{"nodes": [0, 1]}]
    with pytest.warns(UserWarning, match="is a reflection.*it is left out"):
        assert not loaded(glb, tmp_path).cameras


def test_an_orthographic_camera_shows_its_xmag_and_ymag():
    (camera,) = gi.load_scene(CASES / "gltf-camera-aspect" / "ortho.glb").cameras.values()
    assert camera.ortho_width == 2.0 and camera.resolution[0] == camera.resolution[1]
    assert camera.half_size == (1.0, 1.0)
    grown = gi.load_scene(CASES / "gltf-camera-aspect" / "ortho.glb", scale=3.0)
    assert next(iter(grown.cameras.values())).ortho_width == 6.0
    beauty = picture(gi.load_scene(CASES / "gltf-camera-aspect" / "ortho.glb"), camera.at_resolution(8, 8)).numpy(
        "beauty"
    )
    np.testing.assert_allclose(beauty, 0.5, atol=1e-3)  # its square fills the picture, at any distance


@pytest.mark.parametrize(("xmag", "what"), [(0.0, "above 0, got 0 and 1"), (-2.0, "above 0, got -2 and 1")])
def test_an_orthographic_camera_without_a_size_is_left_out_with_a_line(tmp_path, xmag, what):
    glb = square()
    lens = {"xmag": xmag, "ymag": 1.0, "znear": 0.0, "zfar": 9.0}
    glb.add("nodes", {"camera": glb.add("cameras", {"type": "orthographic", "orthographic": lens})})
    glb.json["scenes"] = [{"nodes": [0, 1]}]
    with pytest.warns(UserWarning, match=f"{what}; it is left out"):
        assert not loaded(glb, tmp_path).cameras
