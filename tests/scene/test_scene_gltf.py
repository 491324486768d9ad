"""glTF and GLB files, written by code: all that is read from them, and damage of every kind."""

from __future__ import annotations

import base64
import json
import struct

import numpy as np
import pytest
from scene_tools import TRIANGLE_POINTS, TRIANGLE_UVS, GlbBuilder, png

import warp_gi as gi
from warp_gi.errors import SceneError

RED = np.full((2, 2, 3), (255, 0, 0), np.uint8)


def rich_glb() -> GlbBuilder:
    """Return a file with a camera, a lamp, a masked and an emissive material, and a moving node."""
    glb = GlbBuilder()
    holes = np.zeros((2, 4, 4), np.uint8)
    holes[0, :, 3] = 255  # the top half is there
    image = glb.add("images", {"bufferView": glb.view(png(holes)), "mimeType": "image/png", "name": "holes"})
    sampler = glb.add("samplers", {"wrapS": 33071, "wrapT": 33648})
    texture = glb.add("textures", {"source": image, "sampler": sampler})
    leaf = glb.add(
        "materials",
        {
            "name": "leaf",
            "pbrMetallicRoughness": {
                "baseColorFactor": [0.5, 0.25, 1.0, 0.75],
                "metallicFactor": 0.25,
                "roughnessFactor": 0.5,
                "baseColorTexture": {"index": texture},
                "metallicRoughnessTexture": {"index": texture},
            },
            "normalTexture": {"index": texture, "scale": 0.5},
            "alphaMode": "MASK",
            "alphaCutoff": 0.25,
            "doubleSided": True,
            "extensions": {"KHR_materials_specular": {"specularFactor": 0.0}},
        },
    )
    lamp = glb.add(
        "materials",
        {
            "name": "lamp",
            "emissiveFactor": [1.0, 0.5, 0.0],
            "alphaMode": "BLEND",
            "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 8.0}},
        },
    )
    lens = glb.add("cameras", {"type": "perspective", "perspective": {"yfov": 0.5, "aspectRatio": 2.0, "znear": 0.1}})
    lights = [{"type": "spot", "color": [1, 0.5, 0.25], "intensity": 4, "range": 9, "spot": {"outerConeAngle": 0.5}}]
    glb.json["extensions"] = {"KHR_lights_punctual": {"lights": lights}}
    half = np.sqrt(0.5)
    glb.add("nodes", {"name": "root", "translation": [0, 1, 0], "scale": [2, 2, 2], "children": [1, 2]})
    glb.add("nodes", {"name": "leaf", "mesh": glb.mesh(leaf)})
    glb.add("nodes", {"name": "lamp", "mesh": glb.mesh(lamp), "translation": [1, 0, 0]})
    glb.add("nodes", {"name": "view", "camera": lens, "translation": [0, 0, 5]})
    glb.add(
        "nodes",
        {"name": "head", "rotation": [half, 0, 0, half], "extensions": {"KHR_lights_punctual": {"light": 0}}},
    )
    samplers = [
        {"input": glb.accessor([0.0, 2.0]), "output": glb.accessor([[1, 0, 0], [3, 0, 0]])},
        {
            "input": glb.accessor([0.0, 1.0]),
            "output": glb.accessor([[1, 1, 1], [2, 2, 2]]),
            "interpolation": "STEP",
        },
    ]
    channels = [
        {"sampler": 0, "target": {"node": 2, "path": "translation"}},
        {"sampler": 1, "target": {"node": 2, "path": "scale"}},
    ]
    glb.add("animations", {"samplers": samplers, "channels": channels})
    glb.json["scenes"] = [{"nodes": [0, 3, 4]}]
    return glb


@pytest.fixture(scope="module")
def rich(tmp_path_factory):
    return gi.load_scene(str(rich_glb().write(tmp_path_factory.mktemp("gltf") / "rich.glb")))


def test_materials(rich):
    leaf, lamp = rich.materials
    assert (leaf.name, leaf.base_color, leaf.alpha) == ("leaf", (0.5, 0.25, 1.0), 0.75)
    assert (leaf.metallic, leaf.roughness, leaf.specular, leaf.normal_scale) == (0.25, 0.5, 0.0, 0.5)
    assert leaf.alpha_cutoff == 0.25 and leaf.double_sided
    assert leaf.base_color_texture.wrap == ("clamp", "mirror") and leaf.base_color_texture.name == "holes"
    assert leaf.base_color_texture.srgb and not leaf.normal_texture.srgb
    assert leaf.normal_texture is leaf.metallic_roughness_texture
    assert leaf.normal_texture.pixels is leaf.base_color_texture.pixels
    assert lamp.emission == (8.0, 4.0, 0.0) and lamp.alpha_cutoff is None and not lamp.double_sided
    assert lamp.alpha_blend and not leaf.alpha_blend
    assert (lamp.metallic, lamp.roughness, lamp.base_color) == (1.0, 1.0, (1.0, 1.0, 1.0))


def test_hierarchy_and_v_up(rich):
    assert [node.name for node in rich.nodes] == ["root", "leaf", "lamp", "view", "head"]
    assert [node.parent for node in rich.nodes] == [None, 0, 0, None, None]
    g = rich.data("cpu").geometry
    np.testing.assert_allclose(g.points.numpy()[:3], TRIANGLE_POINTS * 2 + [0, 1, 0])
    np.testing.assert_allclose(g.uvs.numpy()[:3], np.abs(TRIANGLE_UVS - [0, 1]))
    assert not g.normals.numpy().any()  # no normals: flat


def test_camera(rich):
    camera = rich.cameras["view"]
    np.testing.assert_allclose(camera.position, [0, 0, 5])
    assert camera.hfov == pytest.approx(np.degrees(2 * np.arctan(2 * np.tan(0.25))))
    assert camera.resolution == (1080, 540)


def test_punctual_light(rich):
    (light,) = rich.lights
    assert (light.kind, light.range, light.inner_cone, light.outer_cone) == ("spot", 9, 0.0, 0.5)
    np.testing.assert_allclose(light.intensity, [4, 2, 1])
    np.testing.assert_allclose(light.direction, [0, 1, 0], atol=1e-12)
    assert rich.emitter_count == 2


def test_animation(rich):
    assert rich.is_animated and rich.duration == 2.0
    for time, x, scale in ((0.0, 1.0, 1.0), (0.5, 1.5, 1.0), (0.9999, 1.9999, 1.0), (1.0, 2.0, 2.0), (5.0, 3.0, 2.0)):
        rich.update(time, time, "cpu")
        corner = rich.data("cpu").geometry.points.numpy()[3:5]
        np.testing.assert_allclose(corner[0], [2 * x, 1, 0], atol=1e-6)
        np.testing.assert_allclose(corner[1] - corner[0], [2 * scale, 0, 0], atol=1e-6)
    rich.update(0.0, device="cpu")


def test_rays_pass_the_holes_of_a_mask(rich):
    """The image's top half is opaque and glTF's v points down: its top is at small v, which is small y here."""
    origins = np.float32([[0.1, 1.1, 3], [0.1, 2.5, 3]])
    hits = rich.bvh("cpu").intersect(origins, np.float32([[0, 0, -1]] * 2)).face.numpy()
    np.testing.assert_array_equal(hits, [0, -1])


def test_cubic_splines_follow_their_tangents(tmp_path):
    glb = GlbBuilder()
    glb.add("nodes", {"mesh": glb.mesh()})
    ends = [[0, 0, 0], [0, 0, 0], [4, 0, 0], [4, 0, 0], [1, 0, 0], [0, 0, 0]]  # in-tangent, value, out-tangent
    times, values = glb.accessor([0.0, 1.0]), glb.accessor(ends)
    glb.add(
        "animations",
        {
            "samplers": [{"input": times, "output": values, "interpolation": "CUBICSPLINE"}],
            "channels": [{"sampler": 0, "target": {"node": 0, "path": "translation"}}],
        },
    )
    scene = gi.load_scene(glb.write(tmp_path / "cubic.glb"))
    for t in (0.25, 0.5, 0.75):
        hermite = (t**3 - 2 * t**2 + t) * 4 + (3 * t**2 - 2 * t**3) * 1 + (t**3 - t**2) * 4
        assert scene.world_from_node(0, t)[0, 3] == pytest.approx(hermite, abs=1e-6)


def test_strips_fans_and_missing_indices(tmp_path):
    square = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]])
    glb = GlbBuilder()
    primitives = [
        {"attributes": {"POSITION": glb.accessor(square)}, "mode": 5},
        {"attributes": {"POSITION": glb.accessor(square[[0, 1, 3, 2]])}, "mode": 6},
        {"attributes": {"POSITION": glb.accessor(square[:3])}},
        {"attributes": {"POSITION": glb.accessor(square[:2])}, "mode": 1},
    ]
    glb.add("nodes", {"mesh": glb.add("meshes", {"primitives": primitives})})
    scene = gi.load_scene(glb.write(tmp_path / "modes.glb"))
    g = scene.data("cpu").geometry
    corners = g.points.numpy()[g.indices.numpy()].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    np.testing.assert_allclose(normals, np.tile([0, 0, 1], (5, 1)), atol=1e-6)


def test_quantised_sparse_and_strided_accessors(tmp_path):
    glb = GlbBuilder()
    position = glb.accessor(np.array([[0, 0, 0], [32767, 0, 0], [0, 0, 0]]), np.int16, normalized=True)
    glb.json["accessors"][position]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": glb.view(np.uint16([2]).tobytes()), "componentType": 5123},
        "values": {"bufferView": glb.view(np.int16([0, 32767, 0]).tobytes())},
    }
    interleaved = np.concatenate([TRIANGLE_POINTS, np.tile(np.float32([0, 0, 1]), (3, 1))], axis=1)
    view = glb.view(interleaved.tobytes())
    glb.json["bufferViews"][view]["byteStride"] = 24
    normal = {"bufferView": view, "byteOffset": 12, "componentType": 5126, "count": 3, "type": "VEC3"}
    primitive = {"attributes": {"POSITION": position, "NORMAL": glb.add("accessors", normal)}}
    glb.add("nodes", {"mesh": glb.add("meshes", {"primitives": [primitive]})})
    g = gi.load_scene(glb.write(tmp_path / "q.glb")).data("cpu").geometry
    np.testing.assert_allclose(g.points.numpy(), TRIANGLE_POINTS)
    np.testing.assert_array_equal(g.normals.numpy(), [[0, 0, 1]] * 3)


def test_texture_transforms_move_the_coordinates(tmp_path):
    glb = GlbBuilder()
    texture = glb.add("textures", {"source": glb.add("images", {"bufferView": glb.view(png(RED))})})
    transform = {"offset": [0.25, 0.5], "rotation": np.pi / 2, "scale": [2, 3]}
    info = {"index": texture, "extensions": {"KHR_texture_transform": transform}}
    material = glb.add("materials", {"pbrMetallicRoughness": {"baseColorTexture": info}})
    glb.add("nodes", {"mesh": glb.mesh(material)})
    uvs = gi.load_scene(glb.write(tmp_path / "t.glb")).data("cpu").geometry.uvs.numpy()
    # u' = 0.25 + 3 v, v' = 0.5 - 2 u in glTF's v-down coordinates
    expected = np.array([[0.25, 0.5], [0.25, -1.5], [3.25, 0.5]])
    np.testing.assert_allclose(uvs, np.stack([expected[:, 0], 1 - expected[:, 1]], 1), atol=1e-6)


def test_gltf_with_outside_and_inline_buffers(tmp_path):
    glb = rich_glb()
    glb.bytes()
    document = glb.json
    document["buffers"] = [{"byteLength": len(glb.binary), "uri": "my%20data.bin"}]
    (tmp_path / "my data.bin").write_bytes(glb.binary)
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    inline = "data:application/octet-stream;base64," + base64.b64encode(glb.binary).decode()
    document["buffers"][0]["uri"] = inline
    (tmp_path / "b.gltf").write_text(json.dumps(document))
    scenes = [
        gi.load_scene(glb.write(tmp_path / "c.glb")),
        *(gi.load_scene(tmp_path / n) for n in ("a.gltf", "b.gltf")),
    ]
    assert len({scene.hash for scene in scenes}) == 1


def test_scale_is_metres_a_unit(tmp_path):
    path = rich_glb().write(tmp_path / "rich.glb")
    scene, small = gi.load_scene(path), gi.load_scene(path, scale=0.01)
    np.testing.assert_allclose(small.bounds, scene.bounds * 0.01, rtol=1e-5)
    np.testing.assert_allclose(small.cameras["view"].position, [0, 0, 0.05])
    assert small.lights[0].range == pytest.approx(0.09)
    small.update(2.0, 0.0, "cpu")
    np.testing.assert_allclose(small.data("cpu").geometry.points.numpy()[3], [0.06, 0.01, 0], atol=1e-7)


def edited(change):
    """Return a maker of a one-triangle GLB to whose JSON ``change`` was done."""

    def make(folder):
        glb = GlbBuilder()
        texture = glb.add("textures", {"source": glb.add("images", {"uri": "wood.png"})})
        material = glb.add(
            "materials", {"name": "plank", "pbrMetallicRoughness": {"baseColorTexture": {"index": texture}}}
        )
        glb.add("nodes", {"name": "n", "mesh": glb.mesh(material)})
        (folder / "wood.png").write_bytes(png(RED))
        change(glb, folder)
        return glb.write(folder / "scene.glb")

    return make


def cut(folder):
    path = edited(lambda glb, folder: None)(folder)
    path.write_bytes(path.read_bytes()[:-40])
    return path


def write(name, data):
    def make(folder):
        (folder / name).write_bytes(data)
        return folder / name

    return make


def empty_png() -> bytes:
    """Return a PNG whose header says 0 x 4 pixels."""
    data = bytearray(png(RED))
    data[16:24] = struct.pack(">II", 0, 4)
    return bytes(data)


NAN = np.float32([[0, 0, 0], [1, np.nan, 0], [0, 1, 0]])
BROKEN = {
    "truncated": (cut, r"scene\.glb' is truncated: it should have \d+ bytes, it has \d+"),
    "stub": (write("x.glb", b"glTF\2\0\0\0"), "not a GLB file"),
    "not a glb": (write("x.glb", b"PK\3\4 something else"), "does not begin with 'glTF'"),
    "version 1": (write("x.glb", struct.pack("<4sII", b"glTF", 1, 12)), "glTF version 1"),
    "no chunk": (write("x.glb", struct.pack("<4sII", b"glTF", 2, 12)), "must hold a JSON chunk"),
    "not json": (write("x.gltf", b"{ 'asset': }"), "x.gltf' is not glTF: its JSON text is damaged"),
    "missing texture": (
        edited(lambda glb, folder: (folder / "wood.png").rename(folder / "wood_2.png")),
        "texture 'wood.png' of material 'plank' .* is missing; did you mean 'wood_2.png'",
    ),
    "torn texture": (
        edited(lambda glb, folder: (folder / "wood.png").write_bytes(png(RED)[:40])),
        "texture 'wood.png' of material 'plank' cannot be read as an image",
    ),
    "empty texture": (
        edited(lambda glb, folder: (folder / "wood.png").write_bytes(empty_png())),
        "texture 'wood.png' of material 'plank' (has no pixels|cannot be read as an image)",
    ),
    "nan": (
        edited(lambda glb, _: glb.json["nodes"].append({"name": "hill", "mesh": glb.mesh(points=NAN)})),
        "node 'hill': 1 of 3 vertices are not finite",
    ),
    "index": (
        edited(lambda glb, _: glb.json["nodes"].append({"name": "hill", "mesh": glb.mesh(indices=(0, 1, 7))})),
        "node 'hill': index 7 is out of range, there are 3 vertices",
    ),
    "two indices": (
        edited(lambda glb, _: glb.json["nodes"].append({"mesh": glb.mesh(indices=(0, 1))})),
        "has 2 indices, not a multiple of 3",
    ),
    "no triangles": (edited(lambda glb, _: glb.json["nodes"][0].pop("mesh")), "holds no triangles"),
    "short accessor": (
        edited(lambda glb, _: glb.json["accessors"][0].update(count=10**9)),
        r"accessor 0 needs \d+ bytes, its buffer view has 36",
    ),
    "outside view": (
        edited(lambda glb, _: glb.json["bufferViews"][0].update(byteOffset=10**6)),
        "buffer view 0 passes the end",
    ),
    "no such mesh": (
        edited(lambda glb, _: glb.json["nodes"][0].update(mesh=99)),
        "node 'n': names mesh 99, and the file has 1 meshes",
    ),
    "cycle": (edited(lambda glb, _: glb.json["nodes"][0].update(children=[0])), "two parents or on itself"),
    "basisu": (
        edited(lambda glb, _: glb.json.update(extensionsRequired=["KHR_texture_basisu"])),
        "requires KHR_texture_basisu, whose KTX2 textures",
    ),
    "wrap": (
        edited(lambda glb, _: glb.json.update(samplers=[{"wrapS": 7}]) or glb.json["textures"][0].update(sampler=0)),
        "unknown wrap mode '7'",
    ),
    "cutoff": (
        edited(lambda glb, _: glb.json["materials"][0].update(alphaMode="MASK", alphaCutoff=-2.0)),
        "'plank': alpha_cutoff must be from 0 to inf, got -2",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_files_are_one_clear_line(case, tmp_path):
    make, message = BROKEN[case]
    path = make(tmp_path)
    with pytest.raises(SceneError, match=message) as error:
        gi.load_scene(path)
    assert "\n" not in str(error.value)


def test_missing_buffer_file(tmp_path):
    glb = rich_glb()
    glb.bytes()
    for uri, told in (
        (
            "https://example.org/mesh.bin",
            "buffer file 'https://example.org/mesh.bin' is an address, and only files are",
        ),
        ("mesh.bin", r"buffer file '.*mesh\.bin' is missing"),
    ):
        glb.json["buffers"] = [{"byteLength": len(glb.binary), "uri": uri}]
        (tmp_path / "a.gltf").write_text(json.dumps(glb.json))
        with pytest.raises(SceneError, match=told):
            gi.load_scene(tmp_path / "a.gltf")
    with pytest.raises(SceneError, match="is missing"):
        gi.load_scene(tmp_path / "a.gltf")
    (tmp_path / "mesh.bin").write_bytes(glb.binary[:100])
    with pytest.raises(SceneError, match="buffer 0 is truncated: it should have"):
        gi.load_scene(tmp_path / "a.gltf")
