"""Exported transfer textures: every number of the files, the reader against the bake and the path tracer, mistakes."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from contextlib import nullcontext
from dataclasses import replace

import numpy as np
import pygltflib
import pytest
from atlas_tools import fetched, random_points
from transfer_bake_tools import bake_of, court, random_bake, slow_bake

import warp_gi as gi
from warp_gi.errors import BakeError, OptionError
from warp_gi.scene import harmonics
from warp_gi.techniques.radiance_transfer import export
from warp_gi.techniques.radiance_transfer.textures import TransferTextures
from warp_gi.techniques.radiance_transfer.transfer_file import read_export
from warp_gi.techniques.radiance_transfer.vertices import vertex_atlas
from warp_gi.techniques.shared.atlas.atlas import Atlas, page_coordinates
from warp_gi.techniques.shared.atlas.gltf import drawn_triangles
from warp_gi.techniques.shared.exr_parts import read_exr_parts

LIGHT = np.random.default_rng(3).normal(size=(3, 25)).astype(np.float32)


@pytest.fixture(scope="module")
def scene():
    return court()


@pytest.fixture(scope="module", params=[5, 6])
def exported(request, scene, tmp_path_factory):
    """Random numbers of an order on two pages, one of them with backs; and the path of their .exr file."""
    textures = random_bake(scene, order=request.param)
    path = tmp_path_factory.mktemp("export") / "court.exr"
    files = export.export_textures(bake_of(textures, scene), path, scene)
    assert [file.name for file in files] == ["court.exr", "court.rgba.exr", "court.glb", "court.json"]
    assert sorted(file.name for file in path.parent.iterdir()) == sorted(file.name for file in files)
    return textures, path


# ---- numbers ----


def test_every_number_comes_back(exported):
    """Each texel that has a slot holds the slot's row, with a mask of 1; the others are 0."""
    textures, path = exported
    file, atlas = read_export(path), textures.atlas
    assert {key[:2] for key in file.images} == {(0, 0), (0, 1), (1, 0)}
    rows = {
        "mask": np.ones((atlas.count, 1)),
        "transfer": textures.transfer,
        "bounces": textures.bounces.reshape(atlas.count, 75),
        "lamps": textures.lamps,
    }
    seen = np.zeros(atlas.count, int)
    for (page, side, kind), image in file.images.items():
        first, width, height = atlas.pages[page]
        assert image.shape[:2] == (height, width)
        for j, i in np.ndindex(height, width):
            slot = atlas.slots[side, first + j * width + i]
            np.testing.assert_array_equal(image[j, i], rows[kind][slot] if slot >= 0 else 0)
        slots = atlas.slots[side, first : first + width * height]
        np.add.at(seen, slots[slots >= 0], 1)
    assert (seen == len(rows) * np.isin(np.arange(atlas.count), atlas.slots)).all() and seen.any()


def test_parts_are_named_as_the_description_says(exported):
    textures, path = exported
    info = json.loads(path.with_suffix(".json").read_text())
    parts, texts = read_exr_parts(path)
    count = textures.transfer.shape[1]
    assert (info["format"], info["version"], info["order"]) == ("warp_gi transfer textures", 1, round(count**0.5))
    assert [part["name"] for part in info["parts"]] == list(parts) and info["bake"] == texts[export.DIGEST]
    transfer = parts["page1.front.transfer"]
    assert sorted(transfer) == [f"T.{j:02d}" for j in range(count)]  # as any reader sorts them
    assert {channel.dtype.name for channel in transfer.values()} == {"float16"}
    assert sorted(parts["page0.back.bounces"])[:2] == ["B.b.00", "B.b.01"] and len(parts["page0.back.bounces"]) == 75
    assert {channel.dtype.name for channel in parts["page0.front.lamps"].values()} == {"float32"}
    assert set(info["how_to_read"]) >= {"shade", "harmonics", "coordinates", "sides", "mask"}


def test_fours_hold_the_same_numbers(exported):
    textures, path = exported
    info = json.loads(path.with_suffix(".json").read_text())
    parts, _ = read_exr_parts(path)
    fours, _ = read_exr_parts(path.parent / info["rgba_file"])
    assert [name for part in info["parts"] for name in part["rgba_parts"]] == list(fours)
    expected = {"transfer": -(-textures.transfer.shape[1] // 4), "bounces": 19, "lamps": 1, "mask": 1}
    for part in info["parts"]:
        assert len(part["rgba_parts"]) == expected[part["kind"]]
        values = [fours[name][channel] for name in part["rgba_parts"] for channel in "RGBA"]
        for channel, value in zip(part["channels"], values, strict=False):
            np.testing.assert_array_equal(value, parts[part["name"]][channel])
        assert part["kind"] == "mask" or not any(value.any() for value in values[len(part["channels"]) :])


def test_equal_bakes_are_equal_files(exported, scene, tmp_path):
    textures, path = exported
    for file in export.export_textures(bake_of(textures, scene), tmp_path / "court.exr", scene):
        assert file.read_bytes() == (path.parent / file.name).read_bytes()


# ---- the reader ----


def directly(textures: TransferTextures, faces, u, v, side, light) -> np.ndarray:
    """Return irradiance from the bake's own rows, float64 [point, 3], as kernels fetch them."""
    slots, shares = fetched(textures.atlas, faces, u, v, side)
    shares = np.where(slots < 0, 0, shares)
    shares /= np.maximum(shares.sum(axis=1, keepdims=True), 1e-12)
    rows = lambda values: (values[np.maximum(slots, 0)].astype(np.float64).T * shares.T).T.sum(axis=1)  # noqa: E731
    sky = rows(textures.transfer)[:, :25] @ light.T.astype(np.float64)
    bounced = np.einsum("cj,ncj->nc", light.astype(np.float64), rows(textures.bounces))
    known = shares.sum(axis=1, keepdims=True) > 0
    return np.maximum(sky, 0) + np.maximum(bounced, 0) + np.where(known, rows(textures.lamps), 0)


@pytest.mark.parametrize("side", [0, 1])
def test_the_reader_filters_as_kernels_do(exported, side):
    textures, path = exported
    faces, u, v = random_points(np.arange(len(textures.atlas.face_pages)), 20)
    file = read_export(path.with_suffix(".json"))
    pages, uvs = page_coordinates(textures.atlas, faces, u, v)
    found = file.irradiance(pages, uvs, LIGHT, side)
    wanted = directly(textures, faces, u, v, side, LIGHT)
    np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-3)
    assert (found.any(axis=1) == wanted.any(axis=1)).all() and found.any()
    albedo = np.random.default_rng(1).random((len(faces), 3))
    np.testing.assert_allclose(file.shade(pages, uvs, LIGHT, side, albedo), albedo / np.pi * found, rtol=1e-5)
    assert not file.irradiance(np.full(3, -1), uvs[:3], LIGHT).any()


def glb_corners(path):
    """Return page, TEXCOORD_1 [face, 3, 2], POSITION [face, 3, 3], base colour of the triangles of a GLB file."""
    document = pygltflib.GLTF2().load_binary(str(path))
    data = document.binary_blob()

    def read(index, kind, width):
        accessor = document.accessors[index]
        view = document.bufferViews[accessor.bufferView]
        return np.frombuffer(data, kind, accessor.count * width, view.byteOffset).reshape(accessor.count, width)

    found = []
    for node in document.nodes:
        for primitive in document.meshes[node.mesh].primitives:
            ids = read(primitive.indices, np.uint32, 1).reshape(-1, 3)
            a = primitive.attributes
            color = document.materials[primitive.material].pbrMetallicRoughness.baseColorFactor[:3]
            found.append((
                np.full(len(ids), node.extras.get("page", -1)),
                read(a.TEXCOORD_1, np.float32, 2)[ids],
                read(a.POSITION, np.float32, 3)[ids],
                np.tile(np.array(color), (len(ids), 1)),
            ))  # fmt: skip
    return (np.concatenate(part) for part in zip(*found, strict=True))


def plain_court() -> gi.Scene:
    """Return the court without its texture, under a sky of a few harmonics."""
    nodes = court().nodes
    nodes[0].meshes[0].material.base_color_texture = None
    sky = np.zeros((3, 25))
    sky[:, 0], sky[0, 1], sky[2, 3], sky[1, 6] = 3.0, 1.2, -0.8, 0.4
    theta, phi = np.meshgrid(np.arange(64) * np.pi / 63, (np.arange(128) + 0.5) * 2 * np.pi / 128, indexing="ij")
    around = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1)
    scene = gi.Scene(nodes, name="court", environment=gi.Environment((harmonics.basis(around, 5) @ sky.T).astype("f4")))
    np.testing.assert_allclose(scene.environment.harmonics_of(5), sky, atol=0.01)
    return scene


CAMERA = gi.Camera.look_at((2.2, 2.5, 2.6), (-0.6, 0.4, -0.6), hfov=50, resolution=(32, 24))


def picture_of_files(path, light, frame):
    """Return what files alone say of the points that a frame of one sample shows, and which pixels show one."""
    pages, uvs, points, colors = glb_corners(path.with_suffix(".glb"))
    directions = frame.numpy("position").reshape(-1, 3).astype(np.float64) - CAMERA.position
    edges = points[:, 1:].astype(np.float64) - points[:, :1]
    p = np.cross(directions[:, None], edges[:, 1])
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = 1 / (p * edges[:, 0]).sum(-1)
        start = CAMERA.position - points[:, 0].astype(np.float64)
        q = np.cross(start, edges[:, 0])
        u, v, t = (p * start).sum(-1) * scale, directions @ q.T * scale, (q * edges[:, 1]).sum(-1) * scale
        t = np.where((u >= -1e-6) & (v >= -1e-6) & (u + v <= 1 + 1e-6) & (t > 0), t, np.inf)
    face, ray = t.argmin(axis=1), np.arange(len(t))
    weights = np.stack([1 - u - v, u, v], axis=-1)[ray, face]
    at = (uvs[face] * weights[..., None]).sum(axis=1)
    normals = np.cross(edges[face, 0], edges[face, 1])
    sides = ((normals * directions).sum(axis=1) > 0).astype(int)
    found = read_export(path).shade(pages[face], np.nan_to_num(at), light, sides, colors[face])
    return found, np.isfinite(frame.numpy("depth").ravel()) & (np.abs(t[ray, face] - 1) < 1e-4)


def test_files_alone_make_the_renderers_own_frame(tmp_path):
    """Rays against the triangles of the glTF file, numbers from EXR and JSON: pixel by pixel what is rendered."""
    scene, path = plain_court(), tmp_path / "court.exr"
    settings = gi.RadianceTransfer(
        resolution=64, first_rays=64, rays=64, bounce_rays=16, bounces=4, tolerance=0.0, sun=0.0
    )
    bake = gi.bake(scene, settings)
    pipeline = gi.Pipeline(environment=settings, indirect=replace(settings, term="indirect"), emitters=None, spp=1)
    frame = next(gi.render(scene, CAMERA, pipeline, bakes=[bake]))
    export.export_textures(bake, path, scene)
    found, is_surface = picture_of_files(path, scene.environment.harmonics_of(5), frame)
    wanted = (frame.numpy("environment") + frame.numpy("indirect")).reshape(-1, 3)
    assert is_surface.sum() > 400 and wanted[is_surface].min() >= 0
    np.testing.assert_allclose(found[is_surface], wanted[is_surface], rtol=2e-3, atol=2e-3)


@pytest.mark.slow
def test_files_alone_make_the_path_tracers_picture(tmp_path):
    """The same with a bake made by NumPy alone, beside the path tracer."""
    scene, path = plain_court(), tmp_path / "court.exr"
    export.export_textures(bake_of(slow_bake(scene, rays=256, bounces=6, resolution=96), scene), path, scene)
    first = next(gi.render(scene, CAMERA, gi.Pipeline.preset("direct", spp=1)))
    found, is_surface = picture_of_files(path, scene.environment.harmonics_of(5), first)
    frame = next(gi.render(scene, CAMERA, gi.Pipeline.preset("path", spp=256)))
    wanted = frame.numpy("beauty").reshape(-1, 3)
    colors = np.abs(frame.numpy("albedo") - first.numpy("albedo")).max(axis=-1).ravel()
    inner = is_surface & (colors < 1e-3)  # one surface in the whole of the pixel
    assert inner.sum() > 350
    error = np.sqrt(((found - wanted)[inner] ** 2).mean()) / wanted[inner].mean()
    assert error < 0.08 and abs(found[inner].mean() / wanted[inner].mean() - 1) < 0.02, error


def test_components_are_exported(scene, tmp_path):
    textures = slow_bake(scene, resolution=48)
    path = tmp_path / "a.exr"
    export.export_textures(bake_of(textures, scene), path, scene, components=16)
    info = json.loads(path.with_suffix(".json").read_text())
    assert info["components"]["count"] == 16 and 0 < info["components"]["error"] < 0.1
    assert np.shape(info["components"]["basis"]) == (16, 75)
    part = next(part for part in info["parts"] if part["kind"] == "bounces")
    assert part["channels"] == [f"P.{i:02d}" for i in range(16)] and len(part["rgba_parts"]) == 4
    faces, u, v = random_points(np.arange(len(textures.atlas.face_pages)), 50)
    pages, uvs = page_coordinates(textures.atlas, faces, u, v)
    whole = tmp_path / "b.exr"
    export.export_textures(bake_of(textures, scene), whole, scene)
    light = LIGHT + np.eye(25)[0] * 8
    few, all_of_them = (read_export(file).irradiance(pages, uvs, light, terms="B") for file in (path, whole))
    assert np.sqrt(((few - all_of_them) ** 2).mean()) < 0.1 * all_of_them.mean()
    assert path.stat().st_size < 0.6 * whole.stat().st_size


# ---- surfaces ----


def test_surfaces_are_the_scenes_with_coordinates_of_the_atlas(exported, scene):
    import trimesh

    textures, path = exported
    atlas = textures.atlas
    surfaces = list(drawn_triangles(scene, atlas))
    faces = np.concatenate([drawn.faces for drawn in surfaces])
    assert sorted(faces) == list(range(scene.triangle_count))
    pages, uvs, points, colors = glb_corners(path.with_suffix(".glb"))
    np.testing.assert_array_equal(pages, atlas.face_pages[faces])
    assert uvs.min() >= 0 and uvs.max() <= 1
    sizes = atlas.pages[atlas.face_pages[faces], None, 1:]
    np.testing.assert_allclose(uvs * sizes, atlas.corners[faces], atol=1e-3)
    np.testing.assert_array_equal(points, scene._flat.points[scene._flat.indices[faces]])
    base = np.array([material.base_color for material in scene.materials])
    np.testing.assert_allclose(colors, base[scene._flat.materials[faces]], rtol=1e-6)
    for drawn in surfaces:
        np.testing.assert_allclose(np.linalg.norm(drawn.normals, axis=1), 1, rtol=1e-5)
        keys = np.concatenate([drawn.points, drawn.normals, drawn.uvs, drawn.atlas_uvs], axis=1)
        assert len(np.unique(keys, axis=0)) == len(keys) < 3 * len(drawn.indices) + 1
    loaded = trimesh.load(path.with_suffix(".glb"))
    triangles = np.concatenate([mesh.triangles for mesh in loaded.geometry.values()])
    order = lambda values: values[np.lexsort(values.reshape(len(values), -1).T)]  # noqa: E731
    np.testing.assert_array_equal(order(triangles), order(points.astype(np.float64)))


def test_surfaces_are_read_back_as_a_scene(exported, scene):
    """Triangles, materials and textures, and coordinates of these textures."""
    _, path = exported
    again = gi.load_scene(path.with_suffix(".glb"))
    assert again.triangle_count == scene.triangle_count
    ours = {material.name: material for material in scene.materials}
    for material in again.materials:
        assert material.base_color == pytest.approx(ours[material.name].base_color)
        assert (material.roughness, material.specular) == (1.0, 0.0)
    ground = next(material for material in again.materials if material.name == "floor")
    np.testing.assert_array_equal(ground.base_color_texture.pixels, ours["floor"].base_color_texture.pixels)
    floor = [mesh for node in again.nodes for mesh in node.meshes if mesh.material is ground]
    corners = {
        (*point, *uv) for mesh in floor for point, uv in zip(mesh.points.tolist(), mesh.uvs.tolist(), strict=True)
    }
    assert corners == {(-2, 0, 2, 0, 0), (2, 0, 2, 2, 0), (2, 0, -2, 2, 2), (-2, 0, -2, 0, 2)}


def test_faces_without_a_page_have_no_coordinates(scene, tmp_path):
    textures = random_bake(scene)
    pages = textures.atlas.face_pages.copy()
    pages[:2] = -1
    atlas = Atlas(**{**vars(textures.atlas), "face_pages": pages})
    textures = TransferTextures(atlas, textures.transfer, textures.bounces[:0], textures.lamps[:0])
    path = tmp_path / "a.exr"
    export.export_textures(bake_of(textures, scene), path, scene)
    document = pygltflib.GLTF2().load_binary(str(path.with_suffix(".glb")))
    assert [node.name for node in document.nodes] == ["no page", "page 0", "page 1"]
    assert document.meshes[0].primitives[0].attributes.TEXCOORD_1 is None
    assert {kind for _, _, kind in read_export(path).images} == {"mask", "transfer"}
    assert gi.load_scene(path.with_suffix(".glb")).triangle_count == scene.triangle_count


# ---- mistakes ----


def damaged(folder, how):
    """Make one mistake with the files of an export named court."""
    exr, text = folder / "court.exr", folder / "court.json"
    info = json.loads(text.read_text())
    if how == "no images":
        exr.unlink()
    elif how == "no description":
        text.unlink()
    elif how.startswith("cut"):
        exr.write_bytes(exr.read_bytes()[: int(how.split()[1])])
    elif how == "end cut":
        exr.write_bytes(exr.read_bytes()[:-7])
    elif how == "a picture":
        from PIL import Image

        Image.new("RGB", (4, 4)).save(exr, format="PNG")
    elif how == "of another export":
        text.write_text(json.dumps({**info, "bake": "ab"}))
    elif how == "newer":
        text.write_text(json.dumps({**info, "version": 2}))
    elif how == "foreign":
        text.write_text('{"format": "something"}')
    elif how == "not JSON":
        text.write_bytes(b"\xff\xfe{")
    elif how == "a list":
        text.write_text("[]")
    elif how == "a part missing":
        info["parts"][0]["name"] = "page9.front.mask"
    elif how == "a channel missing":
        info["parts"][0]["channels"] = ["Z"]
    elif how == "no parts":
        del info["parts"]
    elif how == "no mask":
        info["parts"] = [part for part in info["parts"] if part["kind"] != "mask"]
    elif how == "transfer as mask":
        info["parts"][0] |= {"name": "page0.front.transfer", "channels": ["T.03"]}
    elif how == "another page's mask":
        info["parts"][0]["name"] = "page1.front.mask"
    elif how == "too few channels":
        info["parts"][1]["channels"].pop()
    elif how == "a page too many":
        info["parts"][0]["page"] = 7
    elif how == "a negative page":
        info["parts"][0]["page"] = -1
    elif how == "a kind":
        info["parts"][0]["kind"] = "colour"
    elif how == "a side":
        info["parts"][0]["side"] = "top"
    elif how == "another size":
        info["pages"][0]["width"] = 3
    elif how == "a basis":
        info["components"] = {"basis": [[1.0, 2.0]]}
    elif how.startswith("file "):
        info["file"] = json.loads(how[5:].replace("HERE", str(folder)))
    if text.exists() and how not in ("of another export", "newer", "foreign", "not JSON", "a list"):
        text.write_text(json.dumps(info))


@pytest.mark.parametrize(
    "how, words",
    [
        ("no images", "court.exr: no such file"),
        ("no description", "court.json: no such file"),
        ("cut 0", "court.exr: not a whole EXR file"),
        ("cut 500", "court.exr: not a whole EXR file"),
        ("cut 20000", "court.exr: not a whole EXR file"),
        ("end cut", "court.exr: not a whole EXR file"),
        ("a picture", "court.exr: not a whole EXR file"),
        ("of another export", "court.exr: is of another export than court.json"),
        ("newer", "is of version 2, this warp_gi reads up to 1"),
        ("foreign", "does not describe warp_gi transfer textures"),
        ("not JSON", "does not describe warp_gi transfer textures"),
        ("a list", "does not describe warp_gi transfer textures"),
        ("a part missing", "court.exr: has no part 'page9.front.mask', which its description names"),
        ("a channel missing", "court.exr: part 'page0.front.mask' has no channel 'Z'"),
        ("no parts", "does not fit its images (has no 'parts')"),
        ("no mask", "there is no part page0.front.mask"),
        ("transfer as mask", "page0.front.mask has numbers other than 0 and 1"),
        ("another page's mask", "page0.front.mask has "),
        ("too few channels", "numbers, expected "),
        ("a page too many", "page7.front.mask is of none of its 2 pages"),
        ("a negative page", "is of none of its 2 pages"),
        ("a kind", "is of no kind that is known (mask, transfer, bounces, lamps)"),
        ("a side", "does not fit its images"),
        ("another size", "numbers, expected 3 x "),
        ("a basis", "the basis of its components is not of 75 finite numbers each"),
        *[
            (f"file {name}", "expected the name of a file beside it")
            for name in (
                '"../court.exr"',
                '"HERE/court.exr"',
                '"a/court.exr"',
                '".."',
                '""',
                "7",
                "null",
                '"..\\\\a.exr"',
            )
        ],
    ],
)
def test_files_that_cannot_be_read_are_one_line(exported, tmp_path, capfd, how, words):
    _, path = exported
    shutil.copytree(path.parent, tmp_path / "copy")
    damaged(tmp_path / "copy", how)
    with pytest.raises(BakeError) as told:
        read_export(tmp_path / "copy" / "court.exr")
    assert words in str(told.value) and "\n" not in str(told.value) and len(str(told.value)) < 300
    assert capfd.readouterr() == ("", "")


def test_what_cannot_be_exported_is_one_line(scene, tmp_path):
    textures = random_bake(scene)
    bake = bake_of(textures, scene)
    for name in ("a.png", "a", "a.json"):
        with pytest.raises(OptionError, match=r"transfer textures are \.exr files; give NAME\.exr"):
            export.export_textures(bake, tmp_path / name, scene)
    with pytest.raises(BakeError, match="expected a bake of RadianceTransfer, got one of LightFieldProbes"):
        export.export_textures(bake_of(textures, scene, "LightFieldProbes"), tmp_path / "a.exr", scene)
    with pytest.raises(BakeError, match=r"this bake is of a scene of \d+ triangles, 'cornell_box' has 36"):
        export.export_textures(bake, tmp_path / "a.exr", gi.builtin_scene("cornell_box"))
    none = TransferTextures(textures.atlas, textures.transfer, textures.bounces[:0], textures.lamps)
    with pytest.raises(OptionError, match="no bounces to compress"):
        export.export_textures(bake_of(none, scene), tmp_path / "a.exr", scene, components=4)
    vertices = vertex_atlas(scene)
    transfer = np.zeros((vertices.count, 25), np.float16)
    at_vertices = TransferTextures(vertices, transfer, textures.bounces[:0], np.zeros((0, 3), np.float32))
    with pytest.raises(OptionError, match="transfer at vertices has no images"):
        export.export_textures(bake_of(at_vertices, scene), tmp_path / "a.exr", scene)
    with pytest.raises(OSError):
        export.export_textures(bake, "/dev/null/a.exr", scene)
    assert list(tmp_path.iterdir()) == []


def test_files_of_two_exports_are_not_taken_for_one(exported, scene, tmp_path, monkeypatch):
    """Where renaming stops half way there is no description; an earlier one would fit neither."""
    _, path = exported
    shutil.copytree(path.parent, tmp_path / "copy")
    replace_file = os.replace

    def stopping(source, target):
        if str(target).endswith(".rgba.exr"):
            raise OSError("pulled out")
        replace_file(source, target)

    monkeypatch.setattr(os, "replace", stopping)
    with pytest.raises(OSError, match="pulled out"):
        export.export_textures(bake_of(random_bake(scene, seed=9), scene), tmp_path / "copy" / "court.exr", scene)
    assert sorted(file.name for file in (tmp_path / "copy").iterdir()) == ["court.exr", "court.glb", "court.rgba.exr"]
    with pytest.raises(BakeError, match=r"court\.json: no such file"):
        read_export(tmp_path / "copy" / "court.exr")


def test_a_full_disk_leaves_the_earlier_export(exported, tmp_path):
    """Whichever file it strikes; without an earlier one nothing is left."""
    pytest.importorskip("resource")
    textures, path = exported
    sizes = sorted(file.stat().st_size for file in path.parent.iterdir())
    shutil.copytree(path.parent, tmp_path / "old")
    before = {file.name: file.read_bytes() for file in (tmp_path / "old").iterdir()}
    script = f"""
import resource, signal, sys
sys.path.insert(0, {os.path.dirname(os.path.dirname(__file__))!r})
from transfer_bake_tools import bake_of, court, random_bake
from warp_gi.techniques.radiance_transfer import export
scene = court()
bake = bake_of(random_bake(scene, {round(textures.transfer.shape[1] ** 0.5)}, seed=6), scene)
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
for size in {[size * 9 // 10 for size in sizes]}:
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    for folder in ("old", "new"):
        try:
            export.export_textures(bake, folder + "/court.exr", scene)
            print("written")
        except OSError as error:
            print(str(error).replace(chr(10), "|"))
"""
    result = subprocess.run([sys.executable, "-c", script], cwd=tmp_path, capture_output=True, text=True)
    lines = [line for line in result.stdout.splitlines() if "written" in line or "court" in line or "Errno" in line]
    assert len(lines) == 8 and "written" not in lines, result
    assert {file.name: file.read_bytes() for file in (tmp_path / "old").iterdir()} == before
    assert list((tmp_path / "new").iterdir()) == []


def test_no_file_of_another_is_overwritten(tmp_path):
    """hall.exr would write hall.glb, which may be the scene."""
    (tmp_path / "hall.glb").write_bytes(b"a scene")
    with pytest.raises(gi.OptionError, match=r"hall\.glb exists and is not of an earlier export"):
        export.check_export_name(tmp_path / "hall.exr")
    export.check_export_name(tmp_path / "other.exr")


@pytest.mark.parametrize(("generator", "told"), [(export.FORMAT, ""), ("another", "is not of an earlier export")])
def test_a_glb_of_many_parts_says_at_its_end_by_whom_it_is(tmp_path, generator, told):
    """Who made it stands behind all accessors, of which there may be more than any fixed number of bytes."""
    text = json.dumps({"accessors": [{"name": "x" * 50}] * 5000, "asset": {"generator": generator}}).encode()
    chunk = len(text).to_bytes(4, "little") + b"JSON" + text
    (tmp_path / "hall.glb").write_bytes(
        b"glTF" + (2).to_bytes(4, "little") + (12 + len(chunk)).to_bytes(4, "little") + chunk
    )
    with pytest.raises(OptionError, match=told) if told else nullcontext():
        export.check_export_name(tmp_path / "hall.exr")


@pytest.mark.parametrize("end", ["exr", "rgba.exr", "glb", "json"])
def test_each_file_that_is_not_of_an_export_is_left_alone(exported, scene, tmp_path, end):
    """Also where the others are of one: a sky may have come in place of what was exported."""
    textures, path = exported
    shutil.copytree(path.parent, tmp_path / "copy")
    copy = tmp_path / "copy" / "court.exr"
    export.check_export_name(copy)
    file = copy.with_name(f"court.{end}")
    file.write_bytes(b"another's")
    with pytest.raises(OptionError, match=rf"court\.{end} exists and is not of an earlier export"):
        export.export_textures(bake_of(textures, scene), copy, scene)
    assert file.read_bytes() == b"another's"
    file.unlink()
    export.export_textures(bake_of(textures, scene), copy, scene)
    assert len(read_export(copy).images) == len(read_export(path).images)
