"""Light maps as files: what other programs read there, and what ``warp-gi bake --export`` refuses."""

import base64
import json
from dataclasses import replace

import numpy as np
import pygltflib
import pytest
from test_light_map import ABOVE, CACHE, floor, lamp_irradiance, lamp_over

import warp_gi as gi
from warp_gi.cli.main import main
from warp_gi.errors import OptionError
from warp_gi.techniques.shared.atlas.padding import padded
from warp_gi.techniques.shared.exr_parts import read_exr_parts
from warp_gi.techniques.surface_cache import light_map_export as export
from warp_gi.techniques.surface_cache.light_map import LightMapSettings, bake_light_map

SETTINGS = LightMapSettings(resolution=64, samples=256)
NAMES = ("a.glb", "a.exr", "a.json")


@pytest.fixture(scope="module")
def lit():
    """A floor under a lamp: scene, cells and light map."""
    scene = lamp_over(floor())
    bake = gi.bake(scene, CACHE, camera=ABOVE)
    return scene, bake, bake_light_map(scene, bake, CACHE, SETTINGS)


def exported(lit, path):
    scene, bake, light_map = lit
    return export.export_light_map(light_map, path, scene, SETTINGS, bake)


def read_image(path):
    """Return the image of an EXR file as engines get it, float64 [height, width, 3]."""
    parts, _ = read_exr_parts(path)
    (channels,) = parts.values()
    return np.stack([channels[name] for name in "RGB"], axis=2).astype(np.float64)


def read_surfaces(path):
    """Return positions and TEXCOORD_1 of the corners of all triangles of a glTF file, [triangle, 3, ...]."""
    document = pygltflib.GLTF2().load(path)
    uri = document.buffers[0].uri
    data = document.binary_blob() if uri is None else base64.b64decode(uri.partition("base64,")[2])

    def array(index, dtype, columns):
        accessor = document.accessors[index]
        start = document.bufferViews[accessor.bufferView].byteOffset
        return np.frombuffer(data, dtype, accessor.count * columns, start).reshape(-1, columns)

    points, uvs = [], []
    for primitive in (one for mesh in document.meshes for one in mesh.primitives):
        corners = array(primitive.indices, "<u4", 1).reshape(-1, 3)
        points.append(array(primitive.attributes.POSITION, "<f4", 3)[corners])
        uvs.append(array(primitive.attributes.TEXCOORD_1, "<f4", 2)[corners])
    return np.concatenate(points), np.concatenate(uvs), document


def sampled(image, uvs):
    """Return an image at glTF coordinates, bilinearly."""
    at = uvs * image.shape[1::-1] - 0.5
    low = np.floor(at).astype(int)
    (x, y), (i, j) = (at - low).T[..., None], low.T
    rows = [image[j + k, i] * (1 - x) + image[j + k, i + 1] * x for k in (0, 1)]
    return rows[0] * (1 - y) + rows[1] * y


@pytest.mark.parametrize("name", ["a.glb", "a.gltf", "a.exr"])
def test_an_engine_finds_the_light_of_a_point(lit, tmp_path, name):
    """TEXCOORD_1 of points of the floor leads to the integral over the lamp, in float64."""
    surfaces, image, description = exported(lit, tmp_path / name)
    assert surfaces.name == name.replace(".exr", ".glb") and (image.name, description.name) == ("a.exr", "a.json")
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted({surfaces.name, "a.exr", "a.json"})
    points, uvs, document = read_surfaces(surfaces)
    assert uvs.min() >= 0 and uvs.max() <= 1 and len(points) == 4
    weights = np.random.default_rng(0).dirichlet((1, 1, 1), 50)
    for face in np.flatnonzero((points[:, :, 1] == 0).all(axis=1)):
        places = weights @ points[face].astype(np.float64)
        inner = np.abs(places).max(axis=1) < 1.8
        light = sampled(read_image(image), weights[inner] @ uvs[face])
        expected = lamp_irradiance(places[inner])[:, None] * (4.0, 2.0, 1.0)
        assert inner.sum() > 20
        np.testing.assert_allclose(light, expected, rtol=0.05)
    about = json.loads(description.read_text())
    assert document.scenes[0].extras == {"light_map": "a.exr"} and about["file"] == "a.exr"
    assert (about["width"], about["height"]) == lit[2].size and about["type"] == "half" and about["samples"] == 256


def test_surfaces_are_those_of_the_scene(lit, tmp_path):
    scene = gi.load_scene(exported(lit, tmp_path / "a.glb")[0])
    assert scene.triangle_count == lit[0].triangle_count
    assert {material.emission for material in scene.materials} == {(4.0, 2.0, 1.0), (0.0, 0.0, 0.0)}


def test_light_too_strong_for_halves_is_written_in_full(lit, tmp_path):
    scene, bake, light_map = lit
    sun = replace(light_map, irradiance=light_map.irradiance * np.float32(1e6))
    *_, description = export.export_light_map(sun, tmp_path / "a.glb", scene, SETTINGS, bake)
    assert json.loads(description.read_text())["type"] == "float"
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), sun.image().astype(np.float64))


def test_texels_without_a_surface_have_the_colour_of_those_nearby():
    known = np.zeros((5, 7), bool)
    known[0, 0] = known[3, 5] = True
    image = np.where(known[..., None], np.arange(1.0, 36.0).reshape(5, 7, 1), 0)
    filled = padded(image, known)
    assert filled[0, 0] == 1 and filled[3, 5] == 27
    assert (filled[:4, :4] == 1).all() and (filled[:4, 4:] == 27).all()
    assert (filled[4] == 14).all(), "their mean where none is near"
    np.testing.assert_array_equal(padded(image, known & False), image)


def test_mipmaps_are_means_of_what_is_known():
    rng = np.random.default_rng(3)
    known, image = rng.random((12, 20)) < 0.3, rng.random((12, 20, 3))
    filled = padded(np.where(known[..., None], image, 0), known)
    np.testing.assert_array_equal(filled[known], image[known])
    blocks = [one.reshape(6, 2, 10, 2, -1) for one in (filled, np.where(known[..., None], image, 0), known)]
    means, sums, counts = (one.sum(axis=(1, 3)) for one in blocks)
    some = counts[..., 0] > 0
    assert 20 < some.sum() < 60
    np.testing.assert_allclose(means[some] / 4, (sums / np.maximum(counts, 1))[some], rtol=1e-12)


# ---- files of others, and failures ----


@pytest.mark.parametrize("name", ["a.glb", "a.gltf", "a.exr", "a.json"])
def test_an_export_overwrites_exports_alone(lit, tmp_path, name):
    path = tmp_path / ("a.gltf" if name == "a.gltf" else "a.glb")
    files = exported(lit, path)
    before = [file.read_bytes() for file in files]
    assert [file.read_bytes() for file in exported(lit, path)] == before
    for content in (b"", b"another's", b'{"asset": {"generator": "another"}, "format": "ours"}'):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(OptionError, match=f"{name} exists and is not of an earlier export"):
            exported(lit, path)
        assert (tmp_path / name).read_bytes() == content


def test_a_failure_leaves_an_earlier_export(lit, tmp_path, monkeypatch):
    before = {file: file.read_bytes() for file in exported(lit, tmp_path / "a.glb")}

    def full(*arguments):
        raise OSError("no space left on device")

    monkeypatch.setattr(export, "write_exr_parts", full)
    with pytest.raises(OSError, match="no space left"):
        exported(lit, tmp_path / "a.glb")
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == before


BAKE = ["bake", "cornell_box", "--technique=cache", "--paths=1000", "--picture=16x16", "--quiet"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--resolution=64", "--samples=4"], "--resolution, --samples goes with a light map: give --export NAME.glb"),
        (["--export=a.ply", "--samples=4"], "--samples goes with a light map: give --export NAME.glb"),
        (["--export=a.glb", "--resolution=8"], "resolution must be a whole number from 16 to 16384, got 8"),
        (["--export=a.obj"], "cannot export to a.obj"),
        (["--export=old/a.glb"], "old: is a file, expected a folder"),
        (["--export=a.glb", "--export-components=3"], "--export-components goes with --export of radiance-transfer"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(arguments, words, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "old").write_text("a file")
    assert main([*BAKE, "-o=a.safetensors", *arguments]) == 2
    error = capfd.readouterr().err
    assert error.startswith("warp-gi: error: ") and error.count("\n") == 1 and words in error
    assert [path.name for path in tmp_path.iterdir()] == ["old"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--resolution=16"], "resolution 16 is too small for the"),
        (["--charts=own"], 'charts="own": mesh'),
    ],
)
def test_charts_that_fail_leave_no_file_of_an_export(arguments, words, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main([*BAKE, "--export=out/a.glb", "-o=a.safetensors", *arguments]) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and words in error and "vertices" not in error
    assert list((tmp_path / "out").iterdir()) == []


def test_the_command_exports_what_was_baked(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    more = ["--resolution=48", "--samples=2", "--seed=5", "--export=out/a.gltf", "-o=a.safetensors"]
    assert main([*BAKE[:-1], *more]) == 0
    assert "exported: out/a.gltf to a.exr, described by out/a.json" in capsys.readouterr().out
    scene, bake = gi.builtin_scene("cornell_box"), gi.load_bake("a.safetensors")
    expected = bake_light_map(
        scene, bake, gi.SurfaceCache(paths=1000), LightMapSettings(resolution=48, samples=2), seed=5
    ).image()
    np.testing.assert_array_equal(read_image(tmp_path / "out/a.exr"), expected.astype(np.float16).astype(np.float64))
