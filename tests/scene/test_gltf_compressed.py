"""Meshes of glTF that are compressed by Draco and by meshopt: the same numbers as without, and what a fault says."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from scene_tools import GlbBuilder

import warp_gi as gi
from warp_gi.errors import SceneError
from warp_gi.scene.files.gltf_compressed import DRACO, MESHOPT

RNG = np.random.default_rng(3)
POINTS = RNG.uniform(-1, 1, (30, 3)).astype(np.float32)
UVS = RNG.uniform(0, 1, (30, 2)).astype(np.float32)
FACES = RNG.integers(0, 30, (20, 3)).astype(np.uint32)
NORMALS = (POINTS / np.linalg.norm(POINTS, axis=1, keepdims=True)).astype(np.float32)
MATERIAL = {"pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.2, 0.1, 1.0]}}


def loaded(glb, folder):
    (node,) = (node for node in gi.load_scene(glb.write(folder / "a.glb")).nodes if node.meshes)
    return node.meshes[0]


def shape(glb, values, component, kind):
    """Add an accessor without data and return its index."""
    return glb.add("accessors", {"componentType": component, "count": len(values), "type": kind})


def drawn(glb, primitive, **required):
    glb.add("nodes", {"mesh": glb.add("meshes", {"primitives": [primitive]})})
    glb.json["scenes"] = [{"nodes": [0]}]
    glb.json.update(required)
    return glb


# ---- Draco ----


def draco_file(data=None, names=None, count=30):
    draco = pytest.importorskip("DracoPy")
    if data is None:
        data = draco.encode(
            POINTS, FACES, preserve_order=True, quantization_bits=20, tex_coord=UVS.astype(np.float64),
            normals=NORMALS.astype(np.float64),
        )  # fmt: skip
        order = {one["attribute_type"]: one["unique_id"] for one in draco.decode(data).attributes}
        names = names or {"POSITION": order[0], "NORMAL": order[1], "TEXCOORD_0": order[3]}
    glb = GlbBuilder()
    attributes = {
        "POSITION": shape(glb, range(count), 5126, "VEC3"),
        "NORMAL": shape(glb, range(count), 5126, "VEC3"),
        "TEXCOORD_0": shape(glb, range(count), 5126, "VEC2"),
    }
    packed = {"bufferView": glb.view(data), "attributes": names or {"POSITION": 0}}
    primitive = {
        "attributes": attributes,
        "indices": shape(glb, range(FACES.size), 5123, "SCALAR"),
        "mode": 5,
        "extensions": {DRACO: packed},
    }
    return drawn(glb, primitive, extensionsUsed=[DRACO], extensionsRequired=[DRACO])


def test_draco(tmp_path):
    """Its triangles are a list whatever the mode is, and its numbers those of before, up to 20 bits."""
    mesh = loaded(draco_file(), tmp_path)
    np.testing.assert_array_equal(np.asarray(mesh.indices), FACES)
    np.testing.assert_allclose(mesh.points, POINTS, atol=1e-5)
    np.testing.assert_allclose(mesh.normals, NORMALS, atol=1e-5)
    np.testing.assert_allclose(mesh.uvs, np.stack([UVS[:, 0], 1 - UVS[:, 1]], axis=1), atol=1e-5)


def test_a_file_with_other_data_beside_draco_needs_no_decoder(tmp_path, monkeypatch):
    glb = draco_file()
    glb.json.pop("extensionsRequired")
    primitive = glb.json["meshes"][0]["primitives"][0]
    primitive |= {"attributes": {"POSITION": glb.accessor(POINTS)}, "indices": glb.accessor(FACES.ravel(), np.uint16)}
    primitive.pop("mode")
    monkeypatch.setitem(sys.modules, "DracoPy", None)
    np.testing.assert_array_equal(loaded(glb, tmp_path).points, POINTS)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda: draco_file(b"DRACO and nothing"), "its Draco data is damaged"),
        (lambda: draco_file(names={"POSITION": 77}), "POSITION is attribute 77 of its Draco data, which has none"),
        (lambda: draco_file(names={"POSITION": [1]}), "POSITION is attribute"),
        (lambda: draco_file(count=31), "has 31 of 3 numbers, and its compressed data 30 of 3 numbers"),
    ],
    ids=["damaged", "unknown", "no number", "count"],
)
def test_faults_of_draco(tmp_path, change, message):
    with pytest.raises(SceneError, match=message):
        loaded(change(), tmp_path)


@pytest.mark.parametrize(("extension", "module"), [(DRACO, "DracoPy"), (MESHOPT, "meshoptimizer")])
def test_a_decoder_that_is_not_installed(tmp_path, monkeypatch, extension, module):
    monkeypatch.setitem(sys.modules, module, None)
    glb = GlbBuilder()
    glb.add("nodes", {"mesh": glb.mesh()})
    glb.json.update(extensionsUsed=[extension], extensionsRequired=[extension])
    with pytest.raises(SceneError, match=f"needs the package {module}: pip install .*or export the file without"):
        loaded(glb, tmp_path)


# ---- meshopt ----


def meshopt_file(**changes):
    meshopt = pytest.importorskip("meshoptimizer")
    glb = GlbBuilder()

    def view(packed, count, stride, mode, how="NONE"):
        number = glb.view(bytes(packed))
        source = glb.json["bufferViews"][number]
        about = {"buffer": 0, "byteOffset": source["byteOffset"], "byteLength": source["byteLength"], "mode": mode}
        about |= {"byteStride": stride, "count": count, "filter": how} | changes
        glb.json["bufferViews"][number] = {
            "buffer": 1,  # of the fallback, which is not there
            "byteOffset": 0,
            "byteLength": count * stride,
            "extensions": {MESHOPT: about},
        }
        if mode == "ATTRIBUTES":
            glb.json["bufferViews"][number]["byteStride"] = stride
        return number

    points = meshopt.encode_vertex_buffer(POINTS, len(POINTS), 12)
    faces = meshopt.encode_index_buffer(FACES.ravel(), FACES.size, len(POINTS))
    where = {"bufferView": view(points, 30, 12, "ATTRIBUTES"), "componentType": 5126, "count": 30, "type": "VEC3"}
    corners = {"bufferView": view(faces, FACES.size, 2, "TRIANGLES"), "componentType": 5123, "type": "SCALAR"}
    primitive = {
        "attributes": {"POSITION": glb.add("accessors", where)},
        "indices": glb.add("accessors", corners | {"count": FACES.size}),
    }
    return drawn(glb, primitive, extensionsUsed=[MESHOPT], extensionsRequired=[MESHOPT])


def test_meshopt(tmp_path):
    """Triangles are the same but for where they begin, which the format leaves open."""
    mesh = loaded(meshopt_file(), tmp_path)
    np.testing.assert_array_equal(mesh.points, POINTS)
    turned = np.stack([np.roll(FACES, k, axis=1) for k in range(3)])
    assert (np.asarray(mesh.indices) == turned).all(axis=2).any(axis=0).all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mode": "LINES"}, "mode of EXT_meshopt_compression must be one of ATTRIBUTES, TRIANGLES, INDICES"),
        ({"byteStride": 13}, "byteStride of EXT_meshopt_compression cannot be 13"),
        ({"filter": "OCTAHEDRAL"}, "byteStride of EXT_meshopt_compression cannot be 12 where filter is OCTAHEDRAL"),
        ({"filter": "HEXAGONAL"}, "filter of EXT_meshopt_compression cannot be 'HEXAGONAL'"),
        ({"count": 10**9}, "12000000000 bytes once decoded"),
        ({"byteLength": 9}, "is damaged"),
    ],
    ids=["mode", "stride", "filter's stride", "filter", "count", "cut off"],
)
def test_faults_of_meshopt(tmp_path, changes, message):
    with pytest.raises(SceneError, match=message):
        loaded(meshopt_file(**changes), tmp_path)
