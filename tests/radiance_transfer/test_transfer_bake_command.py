"""``warp-gi bake --technique radiance-transfer``: files, tables, pictures, and mistakes before the bake."""

from __future__ import annotations

import json

import numpy as np
import pytest
from PIL import Image
from transfer_bake_tools import bake_of, court, random_bake

import warp_gi as gi
from warp_gi.cli import main as cli
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
