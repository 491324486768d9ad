"""Scenes of strangers: with ``restrict_paths`` they may only name files in their own folder."""

from __future__ import annotations

import base64
import json
import os
import struct

import numpy as np
import pytest
from PIL import Image

import warp_gi as gi
from warp_gi.cli import main as cli
from warp_gi.errors import SceneError

POINTS = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)
pytestmark = pytest.mark.filterwarnings("ignore::warp_gi.errors.UnsupportedWarning")
KINDS = ["buffer", "image", "library", "map"]


def scene_naming(folder, kind, name):
    """Return a scene file that names a buffer, a texture, a library or a map of it."""
    if kind in ("library", "map"):
        folder.joinpath("own.mtl").write_text(f"newmtl a\nKd 1 0 0\nmap_Kd {name}\n" if kind == "map" else "newmtl a\n")
        path = folder / "a.obj"
        library = "own.mtl" if kind == "map" else name
        path.write_text(f"mtllib {library}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl a\nf 1/1 2/1 3/1\n")
        return path
    here = "data:application/octet-stream;base64," + base64.b64encode(POINTS).decode()
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}} if kind == "image" else {}}],
        "textures": [{"source": 0}],
        "images": [{"uri": name}],
        "buffers": [{"uri": here if kind == "image" else name, "byteLength": 36}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
    }
    path = folder / "a.gltf"
    path.write_text(json.dumps(document))
    return path


@pytest.fixture
def folder(tmp_path):
    """A scene's folder, with files of each kind in it and beside it."""
    inner = tmp_path / "scene"
    (inner / "below").mkdir(parents=True)
    (tmp_path / "scene-2").mkdir()
    for place in (tmp_path, inner, inner / "below", tmp_path / "scene-2"):
        (place / "x.bin").write_bytes(POINTS)
        (place / "x.mtl").write_text("newmtl a\nKd 0 1 0\n")
        Image.fromarray(np.full((2, 2, 3), 9, np.uint8)).save(place / "x.png")
    return inner


def file_of(kind):
    return {"buffer": "x.bin", "library": "x.mtl"}.get(kind, "x.png")


@pytest.mark.parametrize("kind", KINDS)
def test_files_beside_the_scene_are_refused(folder, kind, capfd):
    file = file_of(kind)
    (folder / f"link{file[1:]}").symlink_to(folder.parent / file)
    (folder / "up").symlink_to(folder.parent)
    outside = [f"../{file}", f"below/../../{file}", f"../scene-2/{file}", str(folder.parent / file), f"link{file[1:]}"]
    outside += [f"up/{file}", f"UP/{file.upper()}", "../not there", "/etc/passwd", f"..\\{file}"]
    for name in outside:
        path = scene_naming(folder, kind, name)
        with pytest.raises(SceneError, match="lies outside of the scene's folder") as caught:
            gi.load_scene(path, restrict_paths=True)
        assert "\n" not in str(caught.value) and str(path) in str(caught.value)
    assert cli.main(["info", str(path), "--restrict-paths"]) == 2
    assert capfd.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("kind", KINDS)
def test_files_of_the_scene_are_read(folder, kind):
    file = file_of(kind)
    (folder / f"link{file[1:]}").symlink_to(folder / "below" / file)
    for name in (file, f"./{file}", f"below/{file}", f"below/../{file}", f"../scene/{file}", f"link{file[1:]}"):
        path = scene_naming(folder, kind, name)
        assert gi.load_scene(path, restrict_paths=True).triangle_count == 1
    os.symlink(folder, folder.parent / "way")  # the folder itself may be reached by a link
    assert gi.load_scene(folder.parent / "way" / path.name, restrict_paths=True).triangle_count == 1


def test_nothing_is_restricted_unless_asked_for(folder):
    path = scene_naming(folder, "image", "../x.png")
    with pytest.raises(SceneError, match="outside"):
        gi.load_scene(path, restrict_paths=True)
    assert gi.load_scene(path).triangle_count == 1  # the refusal before left nothing behind


@pytest.mark.parametrize("command", ["render", "bake", "info"])
def test_every_command_has_the_option(folder, command, capfd):
    path = scene_naming(folder, "buffer", "../x.bin")
    options = (
        []
        if command == "info"
        else ["-o", str(folder / "o" / "a.safetensors" if command == "bake" else folder / "a.exr")]
    )
    assert cli.main([command, str(path), "--restrict-paths", *options]) == 2
    error = capfd.readouterr().err
    assert "lies outside of the scene's folder" in error and error.count("\n") == 1


@pytest.mark.parametrize("is_animated", [False, True])
def test_nodes_nested_deeper_than_any_stack(tmp_path, is_animated):
    """4,000 nodes within one another, each 1 mm along x; 100,000 take 15 s."""
    count, moved = 4000, 0.001
    times, places = struct.pack("<2f", 0, 1), struct.pack("<6f", 0, 0, 0, 1, 0, 0)
    data = POINTS + times + places
    nodes = [{"children": [i + 1], "translation": [moved, 0, 0]} for i in range(count - 1)] + [{"mesh": 0}]
    views = [(0, 36, 3, "VEC3"), (36, 8, 2, "SCALAR"), (44, 24, 2, "VEC3")]
    document = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": nodes,
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "buffers": [
            {"uri": "data:application/octet-stream;base64," + base64.b64encode(data).decode(), "byteLength": 68}
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": at, "byteLength": size} for at, size, _, _ in views],
        "accessors": [
            {"bufferView": i, "componentType": 5126, "count": view[2], "type": view[3]} for i, view in enumerate(views)
        ],
    }
    if is_animated:
        target = {"node": 0, "path": "translation"}
        document["animations"] = [
            {"samplers": [{"input": 1, "output": 2}], "channels": [{"sampler": 0, "target": target}]}
        ]
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    scene = gi.load_scene(tmp_path / "a.gltf")
    start = (count - 2) * moved + (0 if is_animated else moved)
    np.testing.assert_allclose(scene.world_from_node(count - 1, 0.0)[:3, 3], [start, 0, 0], atol=1e-4)
    if is_animated:
        np.testing.assert_allclose(scene.world_from_node(count - 1, 0.5)[:3, 3], [start + 0.5, 0, 0], atol=1e-4)


@pytest.mark.parametrize("name", ["~/../secret.png", "C:/../secret.png", "~secret.png"])
def test_maps_with_names_of_another_machine_are_not_looked_for_outside(tmp_path, monkeypatch, name):
    """Such names are tried from the working directory, where an archive may have brought folders of that name."""
    inside, outside = tmp_path / "scene", tmp_path / "work"
    for folder in (inside, outside, outside / "~", outside / "C:"):
        folder.mkdir()
    for place in (outside / "secret.png", outside / "~secret.png"):
        Image.new("RGB", (2, 2), (255, 0, 0)).save(place)
    path = scene_naming(inside, "map", name)
    monkeypatch.chdir(outside)
    with pytest.raises(SceneError, match="restrict"):
        gi.load_scene(path, restrict_paths=True)


def test_no_program_is_started_for_a_texture(tmp_path):
    """Pillow gives PostScript to Ghostscript; here it is no image, whatever it is called."""
    (tmp_path / "a.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 2 2\n%%EndComments\nshowpage\n")
    with pytest.raises(SceneError, match="cannot be read as an image"):
        gi.load_scene(scene_naming(tmp_path, "map", "a.png"))
