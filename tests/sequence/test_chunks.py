"""Parts of a sequence, rendered apart: with the bits of one run, or with the error that a warm-up says."""

from __future__ import annotations

import logging
import multiprocessing

import numpy as np
import pytest
from test_dependence import CASES, sky, yard

import warp_gi as gi
from warp_gi.cli import main as cli
from warp_gi.errors import OptionError
from warp_gi.sequence import frames as sequence
from warp_gi.sequence.chunks import Chunk, relative_rmse

COUNT = 7
SIZE = (24, 16)
PIPELINES = {
    "path": gi.Pipeline.preset("path", spp=2),
    "denoised": gi.Pipeline.preset("path", spp=2, denoise="spatiotemporal"),
}


def render(folder, name, **more):
    """Render the sequence, or a part of it; return the numbers of the frames that were rendered."""
    scene = gi.builtin_scene("cornell_box")
    path = gi.builtin_camera_path("cornell_box").at_resolution(*SIZE)
    settings = {"pipeline": PIPELINES[name], "frames": range(COUNT), "seed": 3, "output": folder / "a.####.exr"}
    return [frame.index for frame in gi.render(scene, path, **settings | more)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Folders of whole sequences, by pipeline, each made in one go."""
    folders = {name: tmp_path_factory.mktemp(name) for name in PIPELINES}
    for name, folder in folders.items():
        assert render(folder, name) == list(range(COUNT))
    return folders


def read(folder, index):
    return sequence.read_frame(folder / f"a.{index:04d}.exr")


def assert_same(folder, wanted, frames=range(COUNT)):
    """All buffers and all metadata but the stage times are equal."""
    for index in frames:
        a, b = read(folder, index), read(wanted, index)
        assert a.names == b.names
        assert [name for name in a.names if a.numpy(name).tobytes() != b.numpy(name).tobytes()] == [], index
        assert a.metadata == b.metadata and a.time == b.time
        for key in set(a.attributes) | set(b.attributes):
            assert key.startswith(sequence.TIMES) or np.array_equal(a.attributes[key], b.attributes[key]), key


@pytest.mark.parametrize("in_turns", [False, True])
def test_parts_have_every_frame_once_and_are_of_one_length(in_turns):
    for length, count in ((0, 1), (7, 3), (48, 16), (5, 8), (1000, 7)):
        parts = [Chunk(number, count).places(length, in_turns) for number in range(1, count + 1)]
        assert sorted(place for part in parts for place in part) == list(range(length))
        assert max(map(len, parts)) - min(map(len, parts)) <= 1
    assert list(Chunk(2, 3).places(8, True)) == [1, 4, 7]
    assert [list(Chunk(number, 3).places(7, False)) for number in (1, 2, 3)] == [[0, 1], [2, 3], [4, 5, 6]]


def test_independent_frames_are_dealt_out_in_turns(whole, tmp_path):
    for number, frames in ((3, [2, 5]), (1, [0, 3, 6]), (2, [1, 4])):
        assert render(tmp_path, "path", chunk=(number, 3)) == frames
    assert_same(tmp_path, whole["path"])
    assert len(list(tmp_path.iterdir())) == COUNT


def test_parts_that_depend_on_the_past_are_exact(whole, tmp_path, caplog):
    """In any order: the last one first renders all, a later one goes on from the state of the one before it."""
    caplog.set_level(logging.INFO, "warp_gi")
    told = lambda: [record.getMessage() for record in caplog.records if "before the part" in record.getMessage()]  # noqa: E731
    assert render(tmp_path, "denoised", chunk="3/3") == [4, 5, 6]
    assert told() == ["rendered and thrown away, before the part: frames 0 to 3"]
    assert sorted(path.name for path in tmp_path.glob("*.exr")) == [f"a.{index:04d}.exr" for index in (4, 5, 6)]
    caplog.clear()
    assert render(tmp_path, "denoised", chunk="1/3") == [0, 1]
    assert render(tmp_path, "denoised", chunk="2/3") == [2, 3]
    assert told() == []
    assert_same(tmp_path, whole["denoised"])
    assert {path.name for path in tmp_path.glob("*.safetensors")} == {
        f"a.chunk-{number}-of-3.state.safetensors" for number in (1, 2, 3)
    }
    assert render(tmp_path, "denoised", resume=True) == []  # the whole sequence takes them for its own


def test_a_part_goes_on_where_it_stopped(whole, tmp_path):
    scene = gi.builtin_scene("cornell_box")
    path = gi.builtin_camera_path("cornell_box").at_resolution(*SIZE)
    frames = gi.render(
        scene, path, PIPELINES["denoised"], range(COUNT), seed=3, output=tmp_path / "a.####.exr", chunk=(2, 2)
    )
    assert next(frames).index == 3 and next(frames).index == 4
    frames.close()
    (tmp_path / "a.0004.exr").unlink()  # the state knows it, and is past what is missing
    assert render(tmp_path, "denoised", chunk=(2, 2), resume=True) == [3, 4, 5, 6]
    (tmp_path / "a.0006.exr").write_bytes(b"torn")
    assert render(tmp_path, "denoised", chunk=(1, 2)) == [0, 1, 2]
    assert render(tmp_path, "denoised", chunk=(2, 2), resume=True) == [3, 4, 5, 6]  # from the state of the first part
    assert_same(tmp_path, whole["denoised"])
    assert render(tmp_path, "denoised", chunk=(2, 2), resume=True) == []


def test_a_warm_up_says_its_error(whole, tmp_path):
    """Files say how many frames were before; the first of a part has the difference from half as many."""
    assert render(tmp_path, "denoised", chunk=(3, 3), warm_up=2) == [4, 5, 6]
    exact, warm = read(whole["denoised"], 4), read(tmp_path, 4)
    error = relative_rmse(exact.numpy("beauty"), warm.numpy("beauty"))
    told = warm.attributes[sequence.MEASURED + "warm_up_error"]
    assert warm.metadata["warm_up"] == 2 and warm.metadata["lineage"] != exact.metadata["lineage"]
    assert 0.0 < error < 0.5 and 0.0 < told < 0.5
    assert read(tmp_path, 5).metadata["warm_up"] == 2
    assert sequence.MEASURED + "warm_up_error" not in read(tmp_path, 5).attributes
    assert render(tmp_path, "denoised", chunk=(3, 3), warm_up=2, resume=True) == []
    one = tmp_path / "one"  # with one frame before, and so what "half" was compared with
    assert render(one, "denoised", chunk=(3, 3), warm_up=1) == [4, 5, 6]
    other = relative_rmse(warm.numpy("beauty"), read(one, 4).numpy("beauty"))
    assert told == pytest.approx(other, rel=0.02)  # files have half floats
    assert render(tmp_path, "denoised", chunk=(3, 3), resume=True) == [4, 5, 6]  # it is not taken for an exact one
    assert_same(tmp_path, whole["denoised"], (4, 5, 6))


def test_a_warm_up_that_reaches_the_first_frame_is_exact(whole, tmp_path):
    assert render(tmp_path, "denoised", chunk=(2, 3), warm_up=2) == [2, 3]
    assert_same(tmp_path, whole["denoised"], (2, 3))


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name, case in CASES.items() if not case.alone])
def test_parts_of_every_preset_are_exact(name, tmp_path):
    """Still and moving scenes, skies that turn, bakes that grow; the second part is rendered first."""
    case = CASES[name]

    def parts(folder, **more):
        scene = yard(case.moving)
        if case.turning:
            scene.environment = gi.TurningSky(sky(), 25.0, 4.0)
        bakes = case.bakes() if case.narrow_bake else []
        output = folder / "a.####.exr"
        frames = gi.render(scene, case.path(), case.pipeline, seed=3, bakes=bakes, output=output, **more)
        return [frame.index for frame in frames]

    assert parts(tmp_path / "whole") == list(range(5))
    for number in (2, 1):
        parts(tmp_path / "parts", chunk=(number, 2))
    assert_same(tmp_path / "parts", tmp_path / "whole", range(5))


def in_a_process(folder, number):
    return render(folder, "denoised", chunk=(number, 2))


def test_parts_at_once_in_one_folder(whole, tmp_path):
    """Each claims its own frames, and the whole sequence is refused meanwhile."""
    with multiprocessing.get_context("spawn").Pool(2) as pool:
        assert pool.starmap(in_a_process, [(tmp_path, 1), (tmp_path, 2)]) == [[0, 1, 2], [3, 4, 5, 6]]
    assert_same(tmp_path, whole["denoised"])
    assert not list(tmp_path.glob(".*"))


def test_the_command_renders_a_part(whole, tmp_path, capsys):
    command = ["render", "cornell_box", "--resolution=24x16", "--spp=2", "--pipeline=path", "--seed=3", "--frames=0-6"]
    command += ["-o", str(tmp_path / "a.####.exr")]
    assert cli.main([*command, "--chunk", "3/3"]) == 0
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.0002.exr", "a.0005.exr"]
    assert_same(tmp_path, whole["path"], (2, 5))
    assert cli.main([*command, "--chunk=9/9"]) == 0
    assert "chunk 9/9 has no frame: there are 7 in all" in capsys.readouterr().out


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--chunk=0/3"], "a chunk must be I/N with I from 1 to N"),
        (["--chunk=4/3"], "got 4/3"),
        (["--chunk=three"], "a chunk must be I/N, as 3/16 for the third of sixteen, got 'three'"),
        (["--warm-up=3"], "a warm-up is of a part of a sequence; give a chunk as 3/16 too"),
        (["--chunk=1/3", "--warm-up=-1"], "warm-up must be a number of frames, 0 or above, got -1"),
        (["--chunk=1/3", "--frame-time=1s"], "exclude each other"),
    ],
)
def test_mistakes_are_one_line(arguments, words, tmp_path, capsys):
    assert cli.main(["render", "cornell_box", *arguments, "-o", str(tmp_path / "a.####.exr")]) == 2
    told = capsys.readouterr().err
    assert words in told and len(told.splitlines()) == 1 and not list(tmp_path.iterdir())
    with pytest.raises(OptionError, match="a pair as"):
        render(tmp_path, "path", chunk=3)
