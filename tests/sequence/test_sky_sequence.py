"""Skies from numbered files: the file of each frame, what is read, resuming, turning, the command, and mistakes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.cli import main as cli
from warp_gi.cli.compare_options import inputs_of, parse
from warp_gi.errors import SceneError
from warp_gi.scene.environment import Environment
from warp_gi.scene.sky_motion import ranges
from warp_gi.sequence import frames as sequence

PIPELINE = gi.Pipeline(emitters=None, indirect=None, spp=2)
RENDER = ["render", "cornell_box", "--pipeline=path,emitters=none,indirect=none", "--spp=2", "--resolution=24x16"]


def write_sky(path, value, peak=3.0):
    import OpenImageIO as oiio

    pixels = np.full((8, 16, 3), value, np.float32)
    pixels[2:4, 3:6] = (peak, 1.0, 0.5)
    oiio.ImageBuf(pixels).write(str(path))


@pytest.fixture
def skies(tmp_path):
    """Skies of the frames 2 to 5; the name of their files."""
    folder = tmp_path / "skies"
    folder.mkdir()
    for number in (2, 3, 4, 5):
        write_sky(folder / f"sky.{number:04d}.exr", 0.1 * number)
    (folder / "sky.8.exr").write_text("of no frame: its number has one digit")
    return folder / "sky.####.exr"


@pytest.fixture
def read(monkeypatch):
    """Names of the files that are read, in order."""
    names, load = [], Environment.load
    monkeypatch.setattr(
        Environment, "load", staticmethod(lambda path, *a, **k: names.append(path.name) or load(path, *a, **k))
    )
    return names


def path():
    return gi.builtin_camera_path("cornell_box").at_resolution(24, 16)


def box(sky):
    scene = gi.builtin_scene("cornell_box")
    scene.environment = sky
    return scene


def contents(frame):
    return frame.numpy("beauty").tobytes(), dict(frame.metadata)


def test_each_frame_has_the_sky_of_its_file(skies, read):
    """As if each was assigned by hand; turned and scaled; and a file is read once, the first one while it is set."""
    camera = path()
    sky = gi.SkySequence(skies, camera.fps, rotation=33.0, scale=2.0)
    scene = box(sky)
    assert scene.is_sky_animated and scene.sky_at is sky and read == ["sky.0002.exr"]
    found = [contents(frame) for frame in gi.render(scene, camera, PIPELINE, range(2, 6))]
    assert read == [f"sky.{n:04d}.exr" for n in (2, 3, 4, 5)]
    scene = box(None)
    by_hand = gi.FrameScheduler(scene, camera, PIPELINE)
    for number, frame in zip(range(2, 6), found, strict=True):
        file = sequence.frame_path(skies, number)
        scene.environment = gi.Environment.load(file, rotation=33.0, scale=2.0)
        assert contents(by_hand.frame(number, max(number - 1, 2) if number > 2 else None)) == frame
    assert len({pixels for pixels, _ in found}) == 4


@pytest.mark.parametrize("fps", [24.0, 23.976, 29.97, 25.0, 49.0])
def test_a_file_is_shown_until_the_next_one(skies, fps):
    sky = gi.SkySequence(skies, fps)
    assert sky.start == 2 / fps
    value = {number: sky(number / fps).pixels[0, 0, 0] for number in (2, 3, 4, 5)}
    assert value == {number: pytest.approx(0.1 * number) for number in value}
    assert sky(3.99 / fps).pixels[0, 0, 0] == value[3] and sky(2.5 / fps).pixels[0, 0, 0] == value[2]


def test_one_sky_is_kept(skies, read):
    sky = gi.SkySequence(skies, fps=1.0)
    assert sky(3.0) is sky(3.2) and sky(4.0) is not sky(3.0)
    assert read == ["sky.0003.exr", "sky.0004.exr", "sky.0003.exr"]
    assert replace(sky, fps=2.0)(1.5) is sky(3.0) and replace(sky, rotation=9.0)(3.0).rotation == 9.0


def test_a_comparison_stands_still(skies):
    """It is of one moment: that of the frame that was asked for."""
    options = parse(["--scene=cornell_box", f"--environment={skies}", "--frame=4"])
    scene = inputs_of(options).scene
    assert not scene.is_sky_animated and scene.environment.pixels[0, 0, 0] == pytest.approx(0.4)


def test_a_sequence_turns(skies):
    turning = gi.TurningSky(gi.SkySequence(skies, fps=24.0, rotation=5.0), degrees=10.0, fps=24.0)
    assert turning.start == 2 / 24 and turning(4 / 24).rotation == 45.0
    assert turning(4 / 24).pixels[0, 0, 0] == pytest.approx(0.4)
    assert box(turning).environment.rotation == 25.0


def test_bakes_and_what_asks_before_any_frame_take_the_first_sky(skies):
    scene = box(gi.SkySequence(skies, fps=24.0))
    assert gi.bake(scene, gi.VisibilityField(cell_size=0.5, resolution=18, rays=64)) is not None
    assert scene.environment.pixels[0, 0, 0] == pytest.approx(0.2)
    gi.FrameScheduler(scene, path(), PIPELINE).bake()


def test_a_sequence_is_resumed(skies, tmp_path):
    """A frame is rendered again if its own file is missing, or the pixels of its sky are others than they were."""
    camera, pattern, frames = path(), tmp_path / "a.####.exr", range(2, 6)

    def render():
        scene = box(gi.SkySequence(skies, camera.fps))
        return list(gi.render(scene, camera, PIPELINE, frames, output=pattern, resume=True))

    wanted = [contents(frame) for frame in render()]
    assert render() == []
    sequence.frame_path(pattern, 4).unlink()
    write_sky(sequence.frame_path(skies, 3), 0.3, peak=4.0)
    plan = gi.plan_sequence(box(gi.SkySequence(skies, camera.fps)), camera, PIPELINE, frames, output=pattern)
    assert plan.frames == (3, 4) and plan.missing == (4,) and plan.reason(3).startswith("scene_hash is ")
    again = [contents(frame) for frame in render()]
    assert again[1] == wanted[2] and again[0][0] != wanted[1][0]


def test_the_command_renders_parts_alone_and_as_a_whole_alike(skies, tmp_path, capsys):
    """As two machines would; turned, too. A frame is that of a still sky of its file."""
    command = [*RENDER, f"--environment={skies}", "--environment-turn=20", "--environment-scale=2", "--resume"]
    whole, parts = tmp_path / "whole.####.exr", tmp_path / "parts.####.exr"
    assert cli.main([*command, "--frames=2-5", "-o", str(whole)]) == 0
    for frames in ("4,5", "2-3"):
        assert cli.main([*command, f"--frames={frames}", "-o", str(parts)]) == 0
    still = [*RENDER, f"--environment={skies.parent}/sky.0004.exr", "--environment-rotation=80", "--frames=4"]
    assert cli.main([*still, "--environment-scale=2", "-o", str(tmp_path / "still.####.exr")]) == 0
    assert "of 2 frames are there" not in capsys.readouterr().out
    a, b = ([sequence.read_frame(sequence.frame_path(p, n)) for n in range(2, 6)] for p in (whole, parts))
    for one, other in zip(a, b, strict=True):
        np.testing.assert_array_equal(one.numpy("beauty"), other.numpy("beauty"))
        assert one.metadata == other.metadata
    alone = sequence.read_frame(tmp_path / "still.0004.exr")
    np.testing.assert_array_equal(alone.numpy("beauty"), a[2].numpy("beauty"))
    assert cli.main([*command, "--frames=2-5", "-o", str(whole)]) == 0
    assert "4 of 4 frames are there already" in capsys.readouterr().out


def test_frames_without_a_sky_are_one_line_before_any_is_rendered(skies, tmp_path, capfd, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for arguments, words in (
        ([f"--environment={skies}", "--frames=3-7"], "frame 6 has no file sky.0006.exr (frames that have: 2-5)"),
        ([f"--environment={skies}"], "frame 0 has no file sky.0000.exr (frames that have: 2-5)"),
        (["--environment=other.####.exr"], "no such files; the first could be other.0000.exr"),
    ):
        assert cli.main([*RENDER, *arguments]) == 2
        error = capfd.readouterr().err
        assert error.startswith("warp-gi: error: ") and error.count("\n") == 1 and words in error
    assert [file.name for file in tmp_path.iterdir()] == ["skies"]


def test_mistakes_are_one_line(skies, tmp_path):
    with pytest.raises(SceneError, match=r"sky\.exr: put #### where the number of the frame is"):
        gi.SkySequence(tmp_path / "sky.exr", 24.0)
    with pytest.raises(SceneError, match="fps of a sequence of skies must be finite and above 0, got 0"):
        gi.SkySequence(skies, 0)
    scene = box(gi.SkySequence(skies, 24.0))
    with pytest.raises(SceneError, match=r"^the sky at 0\.2\d* s: .*frame 6 has no file sky\.0006\.exr .*: 2-5\)$"):
        scene.update_sky(6 / 24)
    sequence.frame_path(skies, 4).write_bytes(b"no image")
    with pytest.raises(SceneError, match=r"sky\.0004\.exr'?: not an image"):
        scene.update_sky(4 / 24)
    with pytest.raises(SceneError, match=r"no such file; give gi\.SkySequence"):
        box(skies)


def test_numbers_are_told_in_ranges():
    assert ranges([]) == "" and ranges([3]) == "3" and ranges([0, 1, 2, 4, 6, 7]) == "0-2, 4, 6-7"
    assert ranges([0, 2, 4, 6, 8, 10]) == "0, 2, 4, 6 ... 10"
