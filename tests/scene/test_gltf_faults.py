"""glTF files that ask for what is not there, or have something else where a part should be: one line that says where.

What cannot be read is an error, what can be left out a warning.
"""

from __future__ import annotations

import json

import numpy as np
import pytest
from scene_tools import GlbBuilder, png

import warp_gi as gi
from warp_gi.scene.files.gltf import MOST_NODES, read_gltf


def one_triangle():
    glb = GlbBuilder()
    glb.add("nodes", {"name": "n", "mesh": glb.mesh(glb.add("materials", {"name": "m"}))})
    return glb


def primitive(glb):
    return glb.json["meshes"][0]["primitives"][0]


def empty(glb, count, kind="VEC3", component=5126):
    """Add an accessor without data."""
    return glb.add("accessors", {"componentType": component, "count": count, "type": kind})


def loaded(glb, folder):
    return gi.load_scene(glb.write(folder / "a.glb"))


def instanced(glb, count):
    given = {"TRANSLATION": empty(glb, count)}
    glb.json["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": given}}


def animated(glb, channels, samplers):
    glb.add("animations", {"name": "w", "channels": channels, "samplers": samplers})


def morphed(glb, targets, weights):
    primitive(glb)["targets"] = targets
    glb.json["meshes"][0]["weights"] = weights


def camera(glb, lens):
    glb.json["nodes"][0]["camera"] = glb.add("cameras", lens)


def second_buffer(glb):
    glb.json["bufferViews"][0]["buffer"] = 1


CHANNEL = {"sampler": 0, "target": {"node": 0, "path": "translation"}}

FAULTS = {
    "instances": (lambda glb: instanced(glb, 5_000_000), "node 'n': has 5,000,000 instances; at most 1,000,000 nodes"),
    "positions": (
        lambda glb: primitive(glb)["attributes"].update(POSITION=empty(glb, 3)),
        r"mesh 'tri': POSITION is accessor \d, which holds no data; export it without compression",
    ),
    "indices": (
        lambda glb: primitive(glb).update(indices=empty(glb, 3, "SCALAR", 5123)),
        r"mesh 'tri': indices is accessor \d, which holds no data",
    ),
    "targets": (lambda glb: morphed(glb, [None], [1]), r"mesh 'tri': targets must be a list of objects, got \[None\]"),
    "weights of a mesh": (lambda glb: morphed(glb, [], 5), "mesh 'tri': weights must be a list of numbers, got 5"),
    "weights of a node": (
        lambda glb: glb.json["nodes"][0].update(weights=5),
        "node 'n': weights must be a list of numbers, got 5",
    ),
    "channels": (lambda glb: animated(glb, [None], []), "animation 'w': channels must be a list of objects"),
    "samplers": (lambda glb: animated(glb, [CHANNEL], [None]), "animation 'w': samplers must be a list of objects"),
    "lights": (
        lambda glb: glb.json.update(extensions={"KHR_lights_punctual": {"lights": [None]}}),
        "KHR_lights_punctual: lights must be a list of objects",
    ),
    "extensions used": (lambda glb: glb.json.update(extensionsUsed=5), "the file: extensionsUsed must be a list of"),
    "extensions required": (
        lambda glb: glb.json.update(extensionsRequired=[5]),
        "the file: extensionsRequired must be a list of texts",
    ),
    "component": (
        lambda glb: glb.json["accessors"][0].update(componentType=[5126]),
        r"accessor 0: componentType must be one of .*, got \[5126\]",
    ),
    "kind": (lambda glb: glb.json["accessors"][0].update(type=[]), "accessor 0: type must be one of"),
    "aspect": (
        lambda glb: camera(glb, {"perspective": {"yfov": 0.8, "aspectRatio": float("nan")}}),
        "camera 0: aspectRatio must be a number, got nan",
    ),
    "huge": (
        lambda glb: glb.json["nodes"][0].update(translation=[10**400, 0, 0]),
        "node 'n': translation must be 3 numbers",
    ),
    "index of refraction": (
        lambda glb: glb.json["materials"][0].update(extensions={"KHR_materials_ior": {"ior": -1}}),
        "material 'm': ior must be 0 or from 1 up, got -1",
    ),
}


@pytest.mark.parametrize("case", FAULTS)
def test_a_fault_is_one_line_that_names_the_place(case, tmp_path):
    change, message = FAULTS[case]
    glb = one_triangle()
    change(glb)
    with pytest.raises(gi.SceneError, match=message) as error:
        loaded(glb, tmp_path)
    assert "\n" not in str(error.value) and "Error" not in str(error.value) and "object" not in str(error.value)[-8:]


def test_buffers_beside_the_first_are_not_the_binary_chunk(tmp_path):
    glb = one_triangle()
    data = glb.bytes()
    glb.json["buffers"].append({"byteLength": 4})
    second_buffer(glb)
    text = json.dumps(glb.json).encode()
    start = 12 + 8 + int.from_bytes(data[12:16], "little")
    text += b" " * (-len(text) % 4)
    chunks = len(text).to_bytes(4, "little") + b"JSON" + text + data[start:]
    (tmp_path / "a.glb").write_bytes(data[:8] + (12 + len(chunks)).to_bytes(4, "little") + chunks)
    with pytest.raises(gi.SceneError, match="buffer 1: has neither a uri nor a binary chunk"):
        gi.load_scene(tmp_path / "a.glb")


def test_a_binary_file_under_the_name_of_a_text(tmp_path):
    assert gi.load_scene(one_triangle().write(tmp_path / "a.gltf")).triangle_count == 1


def test_many_instances_are_read(tmp_path):
    glb = one_triangle()
    instanced(glb, 20_000)
    nodes = read_gltf(glb.write(tmp_path / "a.glb")).nodes
    assert len(nodes) == 20_001 < MOST_NODES and nodes[-1].name == "n 20000"


@pytest.mark.parametrize("number", [0, 1])
def test_a_texture_without_its_coordinates_is_named(number, tmp_path):
    glb = one_triangle()
    picture = glb.add("images", {"bufferView": glb.view(png(np.full((1, 1, 3), 9, np.uint8)))})
    info = {"index": glb.add("textures", {"source": picture}), "texCoord": number}
    glb.json["materials"][0]["pbrMetallicRoughness"] = {"baseColorTexture": info}
    if number == 0:
        del primitive(glb)["attributes"]["TEXCOORD_0"]
    with pytest.warns(gi.UnsupportedWarning, match=rf"without their coordinates \(TEXCOORD_{number} of mesh 'tri'\)"):
        loaded(glb, tmp_path)


@pytest.mark.parametrize("name", ["COLOR_0", "TEXCOORD_0"])
def test_targets_of_more_than_the_shape_are_named(name, tmp_path):
    glb = one_triangle()
    morphed(glb, [{name: glb.accessor(np.zeros((3, 2)))}], [1.0])
    with pytest.warns(gi.UnsupportedWarning, match=r"morph targets of colours and texture coordinates \(mesh 'tri'\)"):
        loaded(glb, tmp_path)


def test_a_camera_without_a_lens_is_left_out_with_a_line(tmp_path):
    glb = one_triangle()
    camera(glb, {"type": "perspective"})
    with pytest.warns(UserWarning, match="camera 0 has neither .* orthographic lens; it is left out") as caught:
        assert not loaded(glb, tmp_path).cameras
    assert len(caught) == 1


def test_values_that_overlap_are_a_fault(tmp_path):
    glb = one_triangle()
    view = glb.json["accessors"][primitive(glb)["attributes"]["POSITION"]]["bufferView"]
    glb.json["bufferViews"][view]["byteStride"] = 4
    with pytest.raises(gi.SceneError, match="values of 12 bytes overlap: byteStride of its buffer view is 4"):
        loaded(glb, tmp_path)


def test_a_node_with_a_matrix_and_more_is_named(tmp_path):
    glb = one_triangle()
    glb.json["nodes"][0] |= {"matrix": np.diag([2.0, 2, 2, 1]).ravel().tolist(), "translation": [5, 0, 0]}
    with pytest.warns(UserWarning, match="node 'n' has a matrix, and translation, .* the matrix counts"):
        scene = loaded(glb, tmp_path)
    np.testing.assert_array_equal(scene.world_from_node(0, 0.0), np.diag([2.0, 2, 2, 1]))
