"""glTF files of kinds that were read wrongly, or without a word, though they looked well."""

from __future__ import annotations

import base64
import importlib
import json
import math
import struct
import urllib.parse
import warnings

import numpy as np
import pytest
from scene_tools import GlbBuilder, png

import warp_gi as gi
from warp_gi.color import SRGB_TO_LINEAR
from warp_gi.scene.files import gltf_compressed
from warp_gi.scene.files.gltf_buffers import decode_data_uri
from warp_gi.scene.poses import poses
from warp_gi.scene.textures import texture_coordinates

SQUARE = np.float32([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
UVS = np.float32([[0, 1], [1, 1], [1, 0], [0, 0]])
OTHERS = np.float32([[0.1, 0.2], [0.7, 0.3], [0.8, 0.9], [0.2, 0.6]])
"""Second set of coordinates, which is no affine map of the first."""


def square(material=None, **node):
    """Return a builder of a square with two sets of coordinates on a node."""
    glb = GlbBuilder()
    attributes = {"POSITION": SQUARE, "TEXCOORD_0": UVS, "TEXCOORD_1": OTHERS}
    primitive = {
        "attributes": {name: glb.accessor(values) for name, values in attributes.items()},
        "indices": glb.accessor([0, 1, 2, 0, 2, 3], np.uint16),
        "material": glb.add("materials", material or {"name": "m"}),
    }
    glb.add("nodes", {"name": "n", "mesh": glb.add("meshes", {"primitives": [primitive]}), **node})
    return glb


def image(glb, pixels):
    """Add a texture and return its index."""
    return glb.add("textures", {"source": glb.add("images", {"bufferView": glb.view(png(np.uint8(pixels)))})})


def read(path):
    """Return a scene, and the warnings about its file."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        scene = gi.load_scene(path)
    return scene, [str(one.message) for one in caught]


def loaded(glb, folder):
    return read(glb.write(folder / "a.glb"))


def as_text(glb, path, uri):
    """Write a .gltf whose buffer is at ``uri``, which may be a function of its bytes."""
    data = glb.bytes()
    length = struct.unpack("<I", data[12:16])[0]
    document, binary = json.loads(data[20 : 20 + length]), data[28 + length :]
    document["buffers"][0]["uri"] = uri(binary) if callable(uri) else uri
    path.write_text(json.dumps(document))
    return binary


# ---- data URIs and names of files ----


def in_base64(data):
    return base64.b64encode(data).decode()


URIS = {
    "mime": lambda data: "data:application/gltf-buffer;base64," + in_base64(data),
    "no mime": lambda data: "data:;base64," + in_base64(data),
    "charset": lambda data: "data:text/plain;charset=utf-8;base64," + in_base64(data),
    "capitals": lambda data: "DATA:application/octet-stream;BASE64," + in_base64(data),
    "percent-encoded": lambda data: "data:," + "".join(f"%{byte:02X}" for byte in data),
    "both": lambda data: "data:;base64," + urllib.parse.quote(in_base64(data), safe=""),
    "lines": lambda data: "data:;base64," + in_base64(data)[:40] + "\n " + in_base64(data)[40:],
    "not padded": lambda data: "data:;base64," + in_base64(data + b"\0").rstrip("="),
    "for addresses": lambda data: "data:;base64," + base64.urlsafe_b64encode(data).decode(),
}


@pytest.mark.parametrize("kind", URIS)
def test_every_way_to_write_a_data_uri(kind, tmp_path):
    every = np.random.default_rng(0).integers(0, 256, 3000, np.uint8).tobytes()
    assert decode_data_uri(URIS[kind](every), "a buffer")[: len(every)] == every
    as_text(square(), tmp_path / "a.gltf", URIS[kind])
    scene, told = read(tmp_path / "a.gltf")
    np.testing.assert_array_equal(scene._flat.points, SQUARE)
    assert not told


@pytest.mark.parametrize(
    ("uri", "message"),
    [
        ("data:;base64,@@@@", r"buffer 0: its data URI \(data:;base64\) is damaged \(.*\); export it again"),
        ("data:;base64", "buffer 0: its data URI .* has no comma"),
        ("data:;base64,AAAA", "buffer 0 is truncated: it should have .* bytes and has 3"),
    ],
)
def test_data_uris_that_are_damaged(uri, message, tmp_path):
    as_text(square(), tmp_path / "a.gltf", uri)
    with pytest.raises(gi.SceneError, match=message):
        gi.load_scene(tmp_path / "a.gltf")


@pytest.mark.parametrize(
    ("uri", "name"),
    [
        ("my%20buf.bin", "my buf.bin"),
        ("my buf.bin", "my buf.bin"),
        ("a%2520b.bin", "a%20b.bin"),
        ("a%20b.bin", "a%20b.bin"),  # a writer that does not encode
        ("b%C3%BC.bin", "b\u00fc.bin"),
        ("b.bin?v=1", "b.bin"),
    ],
)
def test_names_of_buffers_that_are_encoded_or_not(uri, name, tmp_path):
    (tmp_path / name).write_bytes(as_text(square(), tmp_path / "a.gltf", uri))
    scene, told = read(tmp_path / "a.gltf")
    assert scene.triangle_count == 2 and not told


@pytest.mark.parametrize("is_there", [False, True])
def test_no_spelling_of_a_name_leads_out_of_the_folder(is_there, tmp_path):
    """Encoded it is inside, as it stands outside: whether there is a file is not told."""
    folder = tmp_path / "scene"
    folder.mkdir()
    if is_there:
        (tmp_path / "b.bin").write_bytes(bytes(9999))
    as_text(square(), folder / "a.gltf", "x%2Fy/../../b.bin")
    with pytest.raises(gi.SceneError, match="lies outside of the scene's folder"):
        gi.load_scene(folder / "a.gltf", restrict_paths=True)


def test_meshopt_that_has_other_data_beside_it_needs_no_decoder(tmp_path, monkeypatch):
    glb = square()
    packed = {"buffer": 0, "byteLength": 4, "byteStride": 4, "count": 1, "mode": "ATTRIBUTES"}
    for view in glb.json["bufferViews"]:
        view["extensions"] = {gltf_compressed.MESHOPT: packed}
    glb.json["extensionsUsed"] = [gltf_compressed.MESHOPT]
    there = importlib.import_module

    def missing(name, *rest):
        if name == "meshoptimizer":
            raise ImportError(name)
        return there(name, *rest)

    monkeypatch.setattr(gltf_compressed.importlib, "import_module", missing)
    scene, told = loaded(glb, tmp_path)
    np.testing.assert_array_equal(scene._flat.points, SQUARE)
    assert not told
    glb.json["extensionsRequired"] = [gltf_compressed.MESHOPT]
    with pytest.raises(gi.SceneError, match="needs the package meshoptimizer"):
        loaded(glb, tmp_path)


# ---- nodes ----


def animate(glb, path, values):
    times = glb.accessor(np.arange(len(values)))
    sampler = {"input": times, "output": glb.accessor(values)}
    channel = {"sampler": 0, "target": {"node": 0, "path": path}}
    glb.add("animations", {"name": "w", "samplers": [sampler], "channels": [channel]})


@pytest.mark.parametrize("mirror", [1.0, -1.0])
def test_an_animated_node_with_a_matrix_keeps_what_does_not_move(mirror, tmp_path):
    angle = 0.7
    c, s = math.cos(angle), math.sin(angle)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ np.diag([2.0 * mirror, 3, 4])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, (5, 6, 7)
    glb = square(matrix=matrix.T.ravel().tolist())
    animate(glb, "translation", [[0, 0, 1], [0, 0, 2]])
    scene, (told,) = loaded(glb, tmp_path)
    assert "node 'n' is animated and has a matrix, where it should have translation, rotation and scale" in told
    pose = poses(scene.nodes, 1.0)[0]
    np.testing.assert_allclose(pose.vertices(scene.nodes[0].meshes[0])[0], SQUARE @ turn.T + [0, 0, 2], atol=1e-5)


def test_a_matrix_that_is_a_projection_is_told(tmp_path):
    matrix = np.eye(4)
    matrix[3] = (0, 0, 0.5, 1)
    scene, (told,) = loaded(square(matrix=matrix.T.ravel().tolist()), tmp_path)
    np.testing.assert_array_equal(scene._flat.points, SQUARE)
    assert "the last row of the matrix of node 'n' must be 0 0 0 1, got [0.0, 0.0, 0.5, 1.0]" in told


def test_properties_that_no_animation_can_move_are_told(tmp_path):
    glb = square()
    animate(glb, "colour", [[0, 0, 0], [1, 1, 1]])
    _, (told,) = loaded(glb, tmp_path)
    assert "uses animation of other properties ('colour' of animation 'w'), which is ignored" in told


def instances(**attributes):
    glb = square()
    given = {name: glb.accessor(values) for name, values in attributes.items()}
    glb.json["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": given}}
    return glb


@pytest.mark.parametrize(("name", "is_told"), [("_COLOR_0", True), ("TEXCOORD_0", True), ("_ID", False)])
def test_other_attributes_of_instances_are_told(name, is_told, tmp_path):
    scene, told = loaded(instances(TRANSLATION=[[0, 0, 0], [5, 0, 0]], **{name: np.ones((2, 3))}), tmp_path)
    assert scene.triangle_count == 4
    assert [f"other attributes of instances ({name} of node 'n')" in one for one in told] == [True] * is_told


@pytest.mark.parametrize(
    ("attributes", "message"),
    [({}, "lacks attributes"), ({"ROTATION": [[0, 0, 0, 1], [0, 0, 0, 0]]}, "rotation of instance 1 is zeros")],
)
def test_instances_that_say_nothing(attributes, message, tmp_path):
    with pytest.raises(gi.SceneError, match=f"node 'n': .*{message}"):
        loaded(instances(**attributes), tmp_path)


def test_hidden_nodes_hide_what_is_below_them(tmp_path):
    """Meshes and lights; joints and cameras stay where they are."""
    glb = square()
    hidden = {"KHR_node_visibility": {"visible": False}}
    glb.json["extensions"] = {"KHR_lights_punctual": {"lights": [{"type": "point"}]}}
    camera = glb.add("cameras", {"type": "perspective", "perspective": {"yfov": 0.8}})
    lamp = {"KHR_lights_punctual": {"light": 0}}
    glb.add("nodes", {"name": "below", "mesh": 0, "translation": [0, 0, 5], "camera": camera, "extensions": lamp})
    glb.add("nodes", {"name": "hidden", "children": [1], "extensions": hidden})
    glb.add("nodes", {"name": "shown", "mesh": 0, "extensions": {"KHR_node_visibility": {"visible": True}, **lamp}})
    glb.json["scenes"] = [{"nodes": [0, 2, 3]}]
    glb.json["extensionsUsed"] = ["KHR_node_visibility"]
    scene, told = loaded(glb, tmp_path)
    assert scene.object_names == ["n", "shown"] and len(scene.lights) == 1 and list(scene.cameras) == ["below"]
    assert scene.bounds[1, 2] == 0.0 and not told
    glb.json["nodes"][2]["extensions"]["KHR_node_visibility"]["visible"] = "no"
    with pytest.raises(gi.SceneError, match="node 'hidden': visible of KHR_node_visibility must be true or false"):
        loaded(glb, tmp_path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda mesh: mesh.pop("primitives"), "mesh 0: lacks primitives"),
        (lambda mesh: mesh.update(primitives=[]), "mesh 0: primitives must list at least one"),
        (lambda mesh: mesh["primitives"][0].pop("attributes"), "mesh 0: a primitive of it lacks attributes"),
    ],
)
def test_meshes_without_what_they_must_have(change, message, tmp_path):
    glb = square()
    change(glb.json["meshes"][0])
    with pytest.raises(gi.SceneError, match=message):
        loaded(glb, tmp_path)


@pytest.mark.parametrize(
    ("lens", "message"),
    [
        ({"yfov": 4.0}, "camera 0 must have a yfov between 0 and pi radians, got 4"),
        ({"yfov": 0}, "camera 0 must have a yfov between 0 and pi radians, got 0"),
        ({"yfov": 0.8, "aspectRatio": -1}, "camera 0 must have an aspectRatio above 0, got -1"),
    ],
)
def test_lenses_that_are_none_are_told_in_words_of_the_file(lens, message, tmp_path):
    glb = square()
    glb.json["nodes"][0]["camera"] = glb.add("cameras", {"type": "perspective", "perspective": lens})
    scene, (told,) = loaded(glb, tmp_path)
    assert not scene.cameras and message in told


# ---- textures ----


def placed(index, number=0, **transform):
    return {"index": index, "texCoord": number, "extensions": {"KHR_texture_transform": transform}}


def looked_up(scene, texture):
    """Return where a texture is looked up at the corners, v down."""
    mesh = scene.nodes[0].meshes[0]
    uvs = texture_coordinates(texture, mesh.uvs.astype(np.float64), mesh.further_uvs)
    return uvs * [1, -1] + [0, 1]


def test_a_colour_of_one_point_does_not_take_others_along(tmp_path):
    """A scale of zero leaves one texel of a palette; the normal map has the same set, and a scale of its own."""
    glb = square()
    texture = image(glb, np.zeros((2, 2, 4)))
    glb.json["materials"][0].update(
        pbrMetallicRoughness={"baseColorTexture": placed(texture, offset=[0.3, 0.2], scale=[0, 0])},
        normalTexture=placed(texture, offset=[0.5, 0], scale=[2, 3]),
        emissiveFactor=[1, 1, 1],
        emissiveTexture=placed(texture, offset=[0.3, 0.2], scale=[0, 0]),
    )
    scene, told = loaded(glb, tmp_path)
    material = scene.materials[0]
    np.testing.assert_allclose(looked_up(scene, material.base_color_texture), [[0.3, 0.2]] * 4, atol=1e-6)
    np.testing.assert_allclose(looked_up(scene, material.emission_texture), [[0.3, 0.2]] * 4, atol=1e-6)
    np.testing.assert_allclose(looked_up(scene, material.normal_texture), UVS * [2, 3] + [0.5, 0], atol=1e-6)
    assert not told


def glossy(diffuse, both, **rest):
    glb = square()
    pixels = np.zeros((2, 2, 4), np.uint8)
    pixels[0, :, :3], pixels[..., 3] = 200, 255
    extension = {"specularGlossinessTexture": {"index": image(glb, pixels), **both}}
    if diffuse is not None:
        extension["diffuseTexture"] = {"index": image(glb, np.full((4, 4, 4), 255)), **diffuse}
    glb.json["materials"][0].update(extensions={"KHR_materials_pbrSpecularGlossiness": extension}, **rest)
    return glb, pixels


def test_specular_glossiness_at_coordinates_of_its_own(tmp_path):
    """A diffuse texture cannot be darkened texel by texel by one that stands elsewhere."""
    glb, pixels = glossy({"texCoord": 0}, {"texCoord": 1})
    scene, told = loaded(glb, tmp_path)
    material = scene.materials[0]
    np.testing.assert_allclose(looked_up(scene, material.reflectance_texture), OTHERS, atol=1e-6)
    np.testing.assert_allclose(looked_up(scene, material.base_color_texture), UVS, atol=1e-6)
    share = 1.0 - SRGB_TO_LINEAR[pixels[..., 0]].mean()
    np.testing.assert_allclose(SRGB_TO_LINEAR[material.base_color_texture.pixels[..., :3]], share, atol=5e-3)
    assert any("coordinates of specular-glossiness textures (material 'm'), which is approximated" in x for x in told)


def test_specular_glossiness_alone_comes_before_other_textures(tmp_path):
    glb, _ = glossy(None, {"texCoord": 1}, emissiveFactor=[1, 1, 1])
    glb.json["materials"][0]["emissiveTexture"] = {"index": 0, "texCoord": 0}
    scene, told = loaded(glb, tmp_path)
    material = scene.materials[0]
    for texture in (material.reflectance_texture, material.base_color_texture, material.metallic_roughness_texture):
        np.testing.assert_allclose(looked_up(scene, texture), OTHERS, atol=1e-6)
    np.testing.assert_allclose(looked_up(scene, material.emission_texture), UVS, atol=1e-6)
    assert len(told) == 1  # that it was converted


@pytest.mark.parametrize("extension", ["MSFT_texture_dds", "EXT_texture_avif"])
def test_images_of_other_extensions_are_named(extension, tmp_path):
    glb = square()
    texture = image(glb, np.zeros((2, 2, 4)))
    glb.json["textures"][0] = {"extensions": {extension: {"source": 0}}}
    glb.json["materials"][0]["pbrMetallicRoughness"] = {"baseColorTexture": {"index": texture}}
    with pytest.raises(gi.SceneError, match=f"has its image in {extension} alone, which is not supported"):
        loaded(glb, tmp_path)


def test_what_is_no_image_is_told_in_the_same_words_each_time(tmp_path):
    glb = square()
    texture = glb.add("textures", {"source": glb.add("images", {"bufferView": glb.view(b"no image at all")})})
    glb.json["materials"][0]["pbrMetallicRoughness"] = {"baseColorTexture": {"index": texture}}
    with pytest.raises(gi.SceneError, match=r"cannot be read as an image \(it is in no format of images that is known"):
        loaded(glb, tmp_path)
