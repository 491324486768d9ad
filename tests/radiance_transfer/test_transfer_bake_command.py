"""``warp-gi bake --technique radiance-transfer``: files, tables, pictures, and mistakes before the bake."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image
from transfer_bake_tools import bake_of, court, random_bake

import warp_gi as gi
from warp_gi.cli import main as cli
from warp_gi.files import machine
from warp_gi.techniques.radiance_transfer import pictures
from warp_gi.techniques.radiance_transfer.bake_tool import TOOL
from warp_gi.techniques.radiance_transfer.textures import transfer_textures
from warp_gi.techniques.radiance_transfer.transfer_file import read_export

BAKE = ["bake", "cornell_box", "--technique=transfer", "--resolution=64", "--first-rays=16", "--rays=16"]
BAKE += ["--bounce-rays=16", "--bounces=2", "--picture=48x32"]


def test_a_bake_is_saved_exported_shown_and_told(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main([*BAKE, "--show=pictures", "--export=a/box.exr", "--export-components=5"]) == 0
    told = capsys.readouterr().out
    files = {path.relative_to(tmp_path).as_posix() for path in tmp_path.rglob("*") if path.is_file()}
    exported = {f"a/box.{end}" for end in ("exr", "rgba.exr", "glb", "json")}
    shown = {f"pictures/{name}.png" for name in ("charts.page0", "sky.page0", "bounces.page0", "view")}
    backs = {f"pictures/{name}.page0.back.png" for name in ("charts", "sky", "bounces")}
    assert files == {"out/cornell_box.transfer.safetensors"} | exported | shown | backs
    assert "textures: a/box.exr to box.glb, described by a/box.json" in told
    bake = gi.load_bake("out/cornell_box.transfer.safetensors")
    textures = transfer_textures(bake)
    rows = dict(TOOL.rows(bake, 2.0))
    assert rows["slots"] == textures.atlas.count and rows["slots of backs"] == textures.atlas.slot_sides.sum()
    assert rows["rays a slot"] == pytest.approx(bake.counts["rays"] / textures.atlas.count)
    assert rows["texels"] == textures.atlas.slots.shape[1] and rows["pages"] == 1 and rows["bounces"] == 2
    lamps = 12 * (len(textures.lamps) > 0)
    assert rows["charts"] > 5 and rows["bytes a slot"] == 2 * (25 + 75) + lamps
    for word in ("charts", "slots of backs", "rays a slot", "share of the last", "seconds by stage", "bytes a slot"):
        assert word in told
    assert "more than the tolerance of 0.0005: give more --bounces than 2" in told
    file = read_export("a/box.json")
    assert file.info["components"]["count"] == 5 and file.images[0, 0, "bounces"].shape[2] == 5
    assert json.loads((tmp_path / "a" / "box.json").read_text())["bake"] == bake.digest
    view = np.asarray(Image.open("pictures/view.png"))
    assert view.shape == (32, 48, 3) and view.mean() > 20


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--everywhere"], "a bake of transfer is always of all surfaces: omit it"),
        (["--export=a.png"], "transfer textures are .exr files; give NAME.exr"),
        (["--export=a.exr", "--storage=vertices"], "transfer at vertices has no images"),
        (
            ["--export=a.exr", "--export-components=76"],
            "--export-components must be a whole number from 1 to 75, got 76",
        ),
        (
            ["--export=a.exr", "--export-components=-1"],
            "--export-components must be a whole number from 1 to 75, got -1",
        ),
        (["--export-components=16"], "--export-components goes with --export of radiance-transfer"),
        (["--bounces=0", "--export=a.exr", "--export-components=4"], "--bounces is 0; leave one of them out"),
        (["--technique=dvf", "--export-components=4", "--export=a.png"], "goes with --export of radiance-transfer"),
    ],
)
def test_mistakes_are_one_line_and_leave_nothing(arguments, words, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert cli.main([*(BAKE[:3] if "dvf" not in arguments[0] else BAKE[:2]), *arguments]) == 2
    error = capfd.readouterr().err
    assert error.startswith("warp-gi: error: ") and error.count("\n") == 1 and words in error
    assert list(tmp_path.iterdir()) == []


FAST = [*BAKE[2:], "--quiet"]


def model(path, points, faces):
    """Write a GLB file of triangles as they are."""
    mesh = trimesh.Trimesh(points, faces, process=False)
    trimesh.Scene({"toy": mesh}).export(path)


CUBE = trimesh.creation.box((1, 1, 1))
MODELS = {
    "plain": (CUBE.vertices, CUBE.faces),
    "tiny": (CUBE.vertices * 1e-6, CUBE.faces),
    "flat": (CUBE.vertices, np.vstack([CUBE.faces, [[0, 0, 1], [0, 1, 1], [2, 2, 2]]])),
    "doubled": (CUBE.vertices, np.vstack([CUBE.faces, CUBE.faces, CUBE.faces[:, ::-1]])),
    "three": (CUBE.vertices, CUBE.faces[:3]),
    "one": (CUBE.vertices, CUBE.faces[:1]),
}


@pytest.mark.parametrize("name", MODELS)
def test_odd_models_are_baked_exported_and_viewed(name, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    model("toy.glb", *MODELS[name])
    arguments = ["--export=out/a.exr", "--view=out/a.html", "--show=out/a", "-o=out/a.safetensors"]
    assert cli.main(["bake", "toy.glb", *FAST, *arguments]) == 0, capfd.readouterr()
    textures = transfer_textures(gi.load_bake("out/a.safetensors"))
    assert np.isfinite(textures.transfer).all() and textures.transfer[:, 0].max() > 0.5
    images = read_export("out/a.exr").images
    assert images[0, 0, "transfer"].any() and (tmp_path / "out" / "a.html").stat().st_size > 10_000


def nothing_to_bake(name):
    """Return points and faces of a model that cannot be baked."""
    points = np.array(CUBE.vertices)
    if name == "NaN":
        points[3] = np.nan
    return points, [[0, 0, 1], [1, 1, 2]] if name == "no area" else CUBE.faces


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["NaN.glb"], "1 of 8 vertices are not finite"),
        (["no area.glb"], "no surface in this scene rests and has an area, so nothing can be baked; give one with"),
        (["no area.glb", "--storage=vertices"], "no surface in this scene rests and has an area"),
        (["none.glb"], "scene file 'none.glb' is missing"),
        (["folder"], "scene file 'folder' is a folder; name a file in it"),
        (["cut.glb"], "'cut.glb' is truncated"),
        (["toy.glb", "--texel-sets=toys=2"], "unknown node or mesh in texel_sets 'toys'; did you mean 'toy'?"),
        (["toy.glb", "--texel-sets=toy"], 'texel_sets must be "auto", "one", or "NAME=FACTOR,..."'),
        (["toy.glb", "--resolution=15"], "resolution must be a whole number from 16 to 16384, got 15"),
        (["toy.glb", "--resolution=1.5"], "--resolution must be a whole number, got '1.5' (see warp-gi bake --help)"),
        (["toy.glb", "--tolerance=x"], "--tolerance must be a number, got 'x' (see"),
        (["toy.glb", "--smooth=x"], "--smooth must be {None}|FLOAT, got ['x'] (see"),
        (["toy.glb", "--order=7"], "order must be 5 or 6, got 7"),
        (["toy.glb", "--export=folder.exr"], "folder.exr: is a folder"),
        (["toy.glb", "--export=beside.exr"], "beside.glb: is a folder"),
        (["toy.glb", "--export=toy.exr"], "toy.glb exists and is not of an earlier export"),
        (["toy.glb", "--view=folder.html"], "folder.html: is a folder"),
        (["toy.glb", "-o=folder.safetensors"], "folder.safetensors: is a folder"),
        (["toy.glb", "--show=a_file", "-o=a.safetensors"], "a_file: is a file, expected a folder; give another one"),
        (
            ["toy.glb", "--export=a_file/deep/a.exr", "-o=a.safetensors"],
            "a_file: is a file, expected a folder; give another one",
        ),
        (["toy.glb", "-o=/dev/null/a.safetensors"], "/dev/null: is a file, expected a folder"),
    ],
)
def test_mistakes_with_files_are_one_line_and_leave_nothing(arguments, words, capfd, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    model("toy.glb", CUBE.vertices, CUBE.faces)
    (tmp_path / "cut.glb").write_bytes((tmp_path / "toy.glb").read_bytes()[:300])
    for name in ("NaN", "no area"):
        model(f"{name}.glb", *nothing_to_bake(name))
    for name in ("folder", "folder.exr", "beside.glb", "folder.html", "folder.safetensors"):
        (tmp_path / name).mkdir()
    (tmp_path / "a_file").write_text("text")
    before = {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")}
    assert cli.main(["bake", arguments[0], *FAST, *arguments[1:]]) == 2
    error = capfd.readouterr().err
    assert error.startswith("warp-gi: error: ") and error.count("\n") == 1 and words in error
    assert {path: path.is_file() and path.read_bytes() for path in tmp_path.rglob("*")} == before


def test_no_file_that_is_read_is_written_over(capfd, tmp_path, monkeypatch):
    """An export is a scene, too: the next one must not take its place while it is read."""
    monkeypatch.chdir(tmp_path)
    model("toy.glb", CUBE.vertices, CUBE.faces)
    assert cli.main(["bake", "toy.glb", *FAST, "--export=a.exr", "-o=a.safetensors"]) == 0
    before = (tmp_path / "a.glb").read_bytes()
    for scene in ("a.glb", str(tmp_path / "a.glb")):
        assert cli.main(["bake", scene, *FAST, "--export=a.exr", "-o=b.safetensors"]) == 2
        assert f"a.glb would be written over {scene}, which is read: give another name" in capfd.readouterr().err
    sky = ["--environment=a.exr", "--export=a.exr"]
    assert cli.main(["bake", "toy.glb", *FAST, *sky, "-o=b.safetensors"]) == 2
    assert capfd.readouterr().err.count("\n") == 1
    assert (tmp_path / "a.glb").read_bytes() == before and not (tmp_path / "b.safetensors").exists()
    assert cli.main(["bake", "toy.glb", *FAST, "--export=a.exr", "-o=b.safetensors"]) == 0


def test_parts_that_a_killed_process_left_are_removed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    left = [
        f".a.{end}.{machine()}-999999999-00000001.part"
        for end in ("exr", "rgba.exr", "glb", "json", "html", "safetensors")
    ]
    for name in left:
        (tmp_path / name).write_text("half")
    assert cli.main([*BAKE[:2], *FAST, "--export=a.exr", "--view=a.html", "-o=a.safetensors"]) == 0
    assert not [path.name for path in tmp_path.iterdir() if path.name.startswith(".")]


RENDER = ["render", "toy.glb", "--pipeline=transfer", "--spp=1", "--resolution=16x12", "--environment=1,1,1"]
RENDER += ["--environment.resolution=64", "--environment.first-rays=16", "--environment.rays=16"]
RENDER += ["--environment.bounce-rays=16", "--environment.bounces=2", "--quiet", "-o=frame.exr"]


@pytest.fixture(scope="module")
def bakes(tmp_path_factory):
    """A folder with a model, its bake, and bakes that do not fit it."""
    folder = tmp_path_factory.mktemp("bakes")
    model(folder / "toy.glb", CUBE.vertices, CUBE.faces)
    model(folder / "other.glb", CUBE.vertices * 2, CUBE.faces)
    made = {"good": ["toy"], "other": ["other"], "order": ["toy", "--order=6"], "direct": ["toy", "--bounces=0"]}
    for name, (scene, *more) in made.items():
        command = ["bake", str(folder / f"{scene}.glb"), *FAST, *more, "-o", str(folder / f"{name}.safetensors")]
        assert cli.main(command) == 0
    whole = (folder / "good.safetensors").read_bytes()
    (folder / "cut.safetensors").write_bytes(whole[: len(whole) // 2])
    for name, change in (
        ("technique", {"technique": "VisibilityField"}),
        ("index", {"arrays": {"atlas_slots": np.full((2, 4096), 1 << 20, np.int32)}}),
    ):
        bake = gi.load_bake(folder / "good.safetensors")
        replace(
            bake, **{key: {**bake.arrays, **value} if key == "arrays" else value for key, value in change.items()}
        ).save(folder / f"{name}.safetensors")
    return folder


@pytest.mark.parametrize(
    "name, words",
    [
        ("good", ""),
        ("other", "not of 'toy'"),
        ("order", "this bake has other settings (order: bake has 6, asked for 5): bake it again or ask for its own"),
        ("direct", "this bake has other settings (bounces: bake has 0, asked for 2): bake it again"),
        ("cut", "cut.safetensors: is truncated, damaged or no bake at all"),
        ("index", "does not hold transfer textures that fit together: bake again"),
        ("technique", "a bake of VisibilityField was given, but the pipeline's estimators are: LightHierarchy, Ra"),
        ("none", "none.safetensors: no such file; bake first, or correct the path"),
    ],
)
def test_bakes_that_do_not_fit_are_one_line(name, words, bakes, capfd, monkeypatch):
    """A setting of the bake is given for one of the two terms that share it."""
    monkeypatch.chdir(bakes)
    code = cli.main([*RENDER, f"--bake={name}.safetensors"])
    error = capfd.readouterr().err
    assert code == (2 if words else 0), error
    assert (error.count("\n") == 1 and words in error) if words else (bakes / "frame.exr").exists()
    (bakes / "frame.exr").unlink(missing_ok=True)


def test_without_bounces_little_is_told():
    textures = random_bake(court())
    bake = bake_of(textures, court())
    bake.counts = {"rays": 1000, "charts_seconds": 2.0, "charts_cpu_seconds": 1.5}
    rows = dict(TOOL.rows(bake, 1.0))
    assert rows["pages"] == 2 and rows["largest page"] == " x ".join(map(str, textures.atlas.pages[1, 1:]))
    assert "bounces" not in rows and TOOL.tables(bake)[0].rows == [("charts", 2.0, 1.5)]
    assert TOOL.advice(bake, gi.RadianceTransfer()) == ""


def test_pages_are_drawn_texel_by_texel():
    textures = random_bake(court())
    atlas = textures.atlas
    slots = pictures.page_slots(textures, 1, 0)
    (first, width, height) = atlas.pages[1]
    np.testing.assert_array_equal(slots.ravel(), atlas.slots[0, first : first + width * height])
    image = pictures.draw_charts(textures, slots)[:height, :width]
    assert (image[slots < 0] == pictures.EMPTY).all()
    charts = atlas.charts[atlas.slot_faces[slots[slots >= 0]]]
    colors = {(chart, *color) for chart, color in zip(charts.tolist(), image[slots >= 0].tolist(), strict=True)}
    assert len(colors) == len({chart for chart, *_ in colors}) == len({tuple(color) for _, *color in colors})


def test_large_pages_are_drawn_in_part(monkeypatch):
    monkeypatch.setattr(pictures, "PAGE_PIXELS", 20)
    textures = random_bake(court())
    assert max(pictures.page_slots(textures, 0, 0).shape) <= 20
