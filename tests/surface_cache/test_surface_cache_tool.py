"""``warp-gi bake`` of surface caches: what it writes, draws, exports and refuses."""

import json

import numpy as np
import pytest
from PIL import Image

import warp_gi as gi
from warp_gi.cli.main import main
from warp_gi.errors import OptionError
from warp_gi.sequence.frames import read_frame
from warp_gi.techniques.surface_cache.export import FIELDS, cell_points, check_export_name, export_points

BAKE = ["bake", "cornell_box", "--technique=cache", "--paths=3000", "--picture=32x32"]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a bake, its pictures and its export."""
    folder = tmp_path_factory.mktemp("made")
    more = ["-o", str(folder / "a.safetensors"), "--show", str(folder / "show"), "--export", str(folder / "a.ply")]
    assert main([*BAKE, *more]) == 0
    return folder


def test_a_bake_is_rendered_as_it_is(made, tmp_path, capsys):
    command = ["render", "cornell_box", "--spp=1", "--resolution=16x16", "--frames=0", "--quiet", "--pipeline=cache"]
    command += ["--bake", str(made / "a.safetensors"), "-o", str(tmp_path / "a.####.exr")]
    assert main([*command, "--indirect.ends-in.paths=3000"]) == 0
    metadata = read_frame(tmp_path / "a.0000.exr").metadata
    assert metadata["bake.indirect.ends_in"] == gi.load_bake(made / "a.safetensors").digest[:16]
    assert main(command) == 2
    assert "this bake has other settings (paths: bake has 3000, asked for 150000)" in capsys.readouterr().err


def test_pictures_show_cells_samples_and_irradiance(made):
    pictures = {path.stem: np.asarray(Image.open(path).convert("RGB")) for path in (made / "show").iterdir()}
    assert set(pictures) == {"cells", "samples", "irradiance"}
    colors = {tuple(pixel) for pixel in pictures["cells"][:32, :32].reshape(-1, 3)}
    assert len(colors) > 30
    assert pictures["irradiance"][:32, :32].std() > 10 and pictures["samples"][:32, :32].std() > 10


def test_an_export_holds_cells_as_points(made):
    """The middle of a cell lies in the box, within half a cell of a surface that faces as it says."""
    bake = gi.load_bake(made / "a.safetensors")
    head, _, data = (made / "a.ply").read_bytes().partition(b"end_header\n")
    points = np.frombuffer(data, "<f4").reshape(-1, len(FIELDS))
    np.testing.assert_array_equal(points, cell_points(bake))
    assert f"element vertex {len(points)}".encode() in head and head.count(b"property float") == len(FIELDS)
    about = json.loads((made / "a.json").read_text())
    assert about["cells"] == len(points) and about["bake"] == bake.digest and about["fields"] == list(FIELDS)
    columns = dict(zip(FIELDS, points.T, strict=True))
    low, high = gi.builtin_scene("cornell_box").bounds[:, 1]
    on_floor = (columns["ny"] == 1) & (columns["y"] - columns["size"] / 2 <= low)
    assert on_floor.sum() > 10 and (columns["irradiance_g"][on_floor] > 0).mean() > 0.9
    assert (np.abs(points[:, 3:6]).sum(axis=1) == 1).all()
    assert (columns["y"] < high + columns["size"]).all() and (columns["y"] > low - columns["size"]).all()


def test_what_cannot_be_baked_or_exported(tmp_path, capsys):
    for more, told in (
        (["--everywhere"], "a surface cache is of what the camera path needs: omit it"),
        (
            ["--export", str(tmp_path / "a.obj")],
            "cannot export to a.obj: expected .ply for points, or .glb, .gltf or .exr",
        ),
        (["--vertices=0"], "vertices must be a whole number from 1 to 64, got 0"),
    ):
        assert main([*BAKE, "-o", str(tmp_path / "a.safetensors"), *more]) == 2
        assert told in capsys.readouterr().err
    with pytest.raises(OptionError, match="cannot export to cells"):
        check_export_name(tmp_path / "cells")


@pytest.mark.parametrize("name", ["a.ply", "a.json"])
def test_an_export_overwrites_exports_alone(made, tmp_path, name):
    for file in ("a.ply", "a.json"):
        (tmp_path / file).write_bytes((made / file).read_bytes())
    bake = gi.load_bake(made / "a.safetensors")
    assert export_points(bake, tmp_path / "a.ply") == [tmp_path / "a.ply", tmp_path / "a.json"]
    assert (tmp_path / "a.ply").read_bytes() == (made / "a.ply").read_bytes()
    foreign = b'{"format": "ours"}' if name == "a.json" else b"ply\nformat ascii 1.0\ncomment ours\n"
    for content in (foreign, b"", b"[1]", b"\xff"):
        (tmp_path / name).write_bytes(content)
        with pytest.raises(OptionError, match="exists and is not of an earlier export"):
            check_export_name(tmp_path / "a.ply")
        with pytest.raises(OptionError, match="exists and is not of an earlier export"):
            export_points(bake, tmp_path / "a.ply")
        assert (tmp_path / name).read_bytes() == content
    (tmp_path / name).unlink()
    (tmp_path / name).mkdir()
    with pytest.raises(OptionError, match="is a folder"):
        check_export_name(tmp_path / "a.ply")
