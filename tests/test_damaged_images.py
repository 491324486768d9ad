"""Images whose errors are no text, deep images, and names that are not UTF-8."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.cli import main as cli
from warp_gi.errors import SceneError
from warp_gi.scene.files.sky_images import read_sky
from warp_gi.sequence.exr import read_exr, write_exr

TINY = ["--resolution", "8x4", "--spp", "1", "--pipeline", "path"]
NOT_UTF8 = os.fsdecode(b"caf\xe9")


def damage(path):
    """Name a type in the header of an EXR file by bytes that are not UTF-8, which OpenImageIO then quotes."""
    data = path.read_bytes()
    assert b"chlist" in data
    path.write_bytes(data.replace(b"chlist", b"\xff\xfeist", 1))


@pytest.fixture
def damaged(tmp_path):
    write_exr(tmp_path / "bad.exr", {"beauty": np.ones((4, 8, 3))}, {})
    damage(tmp_path / "bad.exr")
    return tmp_path / "bad.exr"


@pytest.mark.parametrize("command", ["render", "compare"])
def test_errors_that_are_no_text_are_one_line(tmp_path, damaged, capfd, command):
    options = {
        "render": ["cornell_box", "--environment", str(damaged), *TINY, "-o", str(tmp_path / "a.exr")],
        "compare": [str(damaged), str(damaged)],
    }[command]
    assert cli.main([command, *options]) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and str(damaged) in error and "Invalid type" in error


def test_a_torn_frame_is_rendered_again(tmp_path, capfd):
    command = ["render", "cornell_box", *TINY, "--frames", "0", "-o", str(tmp_path / "a.####.exr")]
    assert cli.main(command) == 0
    path = tmp_path / "a.0000.exr"
    whole = gi.read_frame(path).numpy("beauty")
    for harm in (damage, lambda p: p.write_bytes(p.read_bytes()[:-40]), deepen, lambda p: p.write_bytes(b"")):
        harm(path)
        assert cli.main([*command, "--resume"]) == 0
        assert "rendered again: not whole" in "".join(capfd.readouterr())
        np.testing.assert_array_equal(gi.read_frame(path).numpy("beauty"), whole)


def test_metadata_that_cannot_be_is_not_whole(tmp_path):
    zeros = np.zeros((4, 4))
    for attributes in ({"worldToCamera": zeros, "hfov": 40.0}, {"frame": "x"}, {"warp_gi/seconds/a": "x"}):
        write_exr(tmp_path / "a.exr", {"beauty": np.ones((4, 8, 3))}, attributes)
        with pytest.raises(SceneError, match=r"a\.exr"):
            gi.read_frame(tmp_path / "a.exr")


def deepen(path):
    import OpenImageIO as oiio

    spec = oiio.ImageSpec(8, 4, 3, "float")
    spec.deep, spec.channelnames = True, ("R", "G", "B")
    data = oiio.DeepData()
    data.init(spec)
    for pixel in range(32):
        data.set_samples(pixel, 2)
    output = oiio.ImageOutput.create("exr")
    assert output.open(str(path), spec) and output.write_deep_image(data) and output.close()


def test_deep_files_are_refused(tmp_path, capfd):
    deepen(tmp_path / "d.exr")
    for read in (read_exr, read_sky):
        with pytest.raises(SceneError, match="deep EXR"):
            read(tmp_path / "d.exr")
    assert cli.main(["compare", str(tmp_path / "d.exr"), str(tmp_path / "d.exr")]) == 2
    assert capfd.readouterr().err.count("\n") == 1


@pytest.mark.skipif(os.name == "nt", reason="names are Unicode there")
def test_ends_of_lines_in_names_of_channels_end_no_line(tmp_path):
    """A sky whose channels are named so, by damage or on purpose; found by the campaign of mutated files."""
    write_exr(tmp_path / "a.exr", {"beauty": np.ones((4, 8, 3))}, {})
    data = (tmp_path / "a.exr").read_bytes()
    assert data.count(b"G\0\1") == 1
    (tmp_path / "a.exr").write_bytes(data.replace(b"G\0\1", b"\n\0\1"))
    with pytest.raises(SceneError, match="no layer has red, green and blue") as caught:
        gi.Environment.load(tmp_path / "a.exr")
    assert len(str(caught.value).splitlines()) == 1


def test_names_that_are_not_utf8(tmp_path, capfd):
    """As the name of a sky, a scene, a camera path, a folder, frames, a bake, and of what is missing."""
    folder = tmp_path / NOT_UTF8
    try:
        folder.mkdir()
    except OSError:
        pytest.skip("this file system takes no such names")
    write_exr(folder / f"{NOT_UTF8}.exr", {"beauty": np.ones((4, 8, 3))}, {})
    path = folder / f"{NOT_UTF8}.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    (folder / f"{NOT_UTF8}.json").write_text('{"keyframes": [{"time": 0, "eye": [0, 0, 3], "target": [0, 0, 0]}]}')
    out = folder / f"{NOT_UTF8}.####.exr"
    options = ["--environment", str(folder / f"{NOT_UTF8}.exr"), "--camera", str(folder / f"{NOT_UTF8}.json")]
    command = ["render", str(path), *options, *TINY, "--frames", "0", "--preview", "-o", str(out)]
    assert cli.main(command) == 0, capfd.readouterr().err
    frame = gi.read_frame(str(out).replace("####", "0000"))
    assert frame.numpy("beauty").max() > 0 and Path(str(out).replace("####.exr", "0000.png")).is_file()
    assert cli.main([*command, "--resume"]) == 0 and "1 of 1 frames are there already" in "".join(capfd.readouterr())
    assert (
        cli.main(
            ["compare", str(out).replace("####", "0000"), str(out).replace("####", "0000"), "-o", str(folder / "d.png")]
        )
        == 0
    )
    assert cli.main(["info", str(path)]) == 0
    for missing in (
        ["render", str(folder / "no.obj")],
        ["info", str(folder / f"{NOT_UTF8}.glb")],
        ["render", str(path), "--environment", str(folder / "no.exr")],
    ):
        capfd.readouterr()
        assert cli.main(missing) == 2
        assert capfd.readouterr().err.count("\n") == 1
