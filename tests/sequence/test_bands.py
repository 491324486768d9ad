"""Pictures that are larger than they may be: rendered in bands of rows, and equal to those at once to the last bit."""

from __future__ import annotations

import multiprocessing
import os

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.bands import why_whole
from warp_gi.cli import main as cli
from warp_gi.errors import OptionError
from warp_gi.memory import PLAIN_BYTES
from warp_gi.sequence import banded
from warp_gi.sequence.banded import bands_of
from warp_gi.sequence.exr import read_exr

SIZE = (45, 37)  # no whole number of tiles
SMALL = PLAIN_BYTES * SIZE[0] * 9  # bytes of a band of 8 rows
PIPELINES = {
    "path": gi.Pipeline(spp=3),
    "tent": gi.Pipeline.preset("direct", spp=4, filter="tent", background=False),
    "uniform": gi.Pipeline(spp=1, emitters=gi.UniformLights(), indirect=None),
    "cache": gi.Pipeline.preset("cache", spp=1, indirect=gi.BsdfPaths(ends_in=gi.SurfaceCache(paths=1000))),
}


def scene_of(name) -> gi.Scene:
    scene = gi.builtin_scene("cornell_box")
    scene.environment = gi.SunSky(elevation=30.0)  # the sun is past half's range
    if name in ("path", "tent"):
        block = next(node for node in scene.nodes if node.meshes)
        block.meshes[0].material.alpha_blend, block.meshes[0].material.alpha = True, 0.5
        scene = gi.Scene(scene.nodes, scene.lights, scene.environment, scene.cameras, name="moving")
        scene.animate(scene.nodes[-1].name, [gi.Keyframe(0.0), gi.Keyframe(0.1, (0.3, 0.1, 0.0))])
    return scene


def render(folder, name, **more):
    path = gi.builtin_camera_path("cornell_box").at_resolution(*SIZE)
    where = {"frames": [0, 2], "output": folder / "a.####.exr", "preview": True}
    return list(gi.render(scene_of(name), path, PIPELINES[name], **where | more))


def contents(path):
    buffers, attributes, formats = read_exr(path)
    kept = {name: value for name, value in attributes.items() if "/seconds/" not in name}
    return {name: values.tobytes() for name, values in buffers.items()}, kept, formats


@pytest.mark.parametrize("name", PIPELINES)
def test_bands_are_the_picture_at_once(tmp_path, name):
    """Pixels, metadata, formats and previews; each run takes the other's files for its own."""
    whole, bands = tmp_path / "whole", tmp_path / "bands"
    render(whole, name)
    made = render(bands, name, memory=SMALL)
    for frame in made:
        number = f"a.{frame.index:04d}"
        (pixels, about, formats), wanted = contents(bands / f"{number}.exr"), contents(whole / f"{number}.exr")
        assert pixels == wanted[0] and formats == wanted[2] and list(pixels) == list(wanted[0])
        assert about.keys() == wanted[1].keys()
        assert [key for key in about if not np.array_equal(about[key], wanted[1][key])] == []
        assert (bands / f"{number}.png").read_bytes() == (whole / f"{number}.png").read_bytes()
        assert "BandedFrame" in repr(frame) and frame.numpy("depth").shape == SIZE[::-1]
    assert render(bands, name, resume=True) == render(whole, name, resume=True, memory=SMALL) == []
    assert sorted(path.name for path in bands.iterdir()) == sorted(path.name for path in whole.iterdir())


def test_a_band_holds_no_more_than_its_rows():
    camera = gi.builtin_scene("cornell_box").cameras["main"].at_resolution(*SIZE)
    scheduler = gi.FrameScheduler(scene_of("cache"), camera, PIPELINES["path"], memory=SMALL)
    whole = gi.FrameScheduler(scene_of("cache"), camera, PIPELINES["path"]).frame(0)
    first = 0
    for band in bands_of(scheduler, 0, 0):
        assert band.rows == range(first, min(first + 8, SIZE[1]))
        assert {len(array.band) for array in band._arrays.values()} == {len(band.rows) * SIZE[0]}
        assert (band.numpy("beauty") == whole.numpy("beauty")[band.rows.start : band.rows.stop]).all()
        first = band.rows.stop
    assert first == SIZE[1]


def test_pictures_without_exr_files(tmp_path):
    render(tmp_path, "uniform")
    render(tmp_path, "uniform", memory=SMALL, output=tmp_path / "b.####.png", preview=False)
    assert (tmp_path / "a.0002.png").read_bytes() == (tmp_path / "b.0002.png").read_bytes()
    assert not list(tmp_path.glob("b.*.exr"))


def test_what_cannot_be_rendered_in_bands_is_one_line(tmp_path, capfd):
    refused = {
        "render fewer pixels, or without a denoiser": gi.Pipeline(denoise="spatiotemporal"),
        "SampleOctree of octree needs the whole picture": gi.Pipeline.preset("reuse"),
        "0.000 GB may be": gi.Pipeline.preset("dvf"),
    }
    camera = gi.builtin_camera_path("cornell_box").at_resolution(*SIZE)
    for words, pipeline in refused.items():
        with pytest.raises(OptionError, match=words):
            gi.FrameScheduler(scene_of("path"), camera, pipeline, memory=SMALL)
    for memory, words in ((1000.0, "a band of 8 rows takes more"), (0.0, "above 0"), (float("nan"), "above 0")):
        with pytest.raises(OptionError, match=words):
            gi.FrameScheduler(scene_of("path"), camera, PIPELINES["path"], memory=memory)
    with pytest.raises(OptionError, match="give an output: files are written in bands of 8 rows"):
        next(gi.render(scene_of("path"), camera, PIPELINES["path"], memory=SMALL))
    assert "SurfaceCache of indirect" not in why_whole(PIPELINES["cache"], scene_of("cache"))
    assert "depends on the frames before" in why_whole(PIPELINES["cache"], scene_of("path"))
    command = ["render", "cornell_box", "--resolution=45x37", "--spp=1", "--frames=0", "-o", str(tmp_path / "a.exr")]
    assert cli.main([*command, "--pipeline=clean", "--memory=1e-4"]) == 2
    assert capfd.readouterr().err.count("\n") == 1 and not list(tmp_path.iterdir())
    assert cli.main([*command, "--pipeline=path", "--memory=1e-4", "--quiet"]) == 0
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs forks")
def test_a_forked_process_writes_bands_too(tmp_path):
    """OpenImageIO's threads are only in the parent, which has written some."""
    render(tmp_path / "parent", "uniform", memory=SMALL)
    process = multiprocessing.get_context("fork").Process(
        target=render, args=(tmp_path / "child", "uniform"), kwargs={"memory": SMALL}
    )
    process.start()
    process.join(60)
    process.kill()
    assert process.exitcode == 0
    for number in (0, 2):
        name = f"a.{number:04d}.exr"
        assert contents(tmp_path / "child" / name)[0] == contents(tmp_path / "parent" / name)[0]


def test_a_full_disk_leaves_nothing(tmp_path, monkeypatch):
    def full(self, band):
        if band.rows.start:
            raise OSError(28, "No space left on device")
        add(self, band)

    add = banded.Rows.add
    monkeypatch.setattr(banded.Rows, "add", full)
    with pytest.raises(OSError, match="No space left") as caught:
        render(tmp_path, "uniform", memory=SMALL)
    assert caught.value.filename == str(tmp_path / "a.0000.exr") and not list(tmp_path.iterdir())


def test_files_are_looked_through_some_rows_at_a_time(tmp_path, monkeypatch):
    from warp_gi.sequence import exr

    render(tmp_path, "uniform")
    monkeypatch.setattr(exr, "SEEN", 5000)
    path = tmp_path / "a.0000.exr"
    buffers, attributes, _ = read_exr(path, keep=False)
    whole, same, _ = read_exr(path)
    assert {name: values.shape for name, values in buffers.items()} == {name: v.shape for name, v in whole.items()}
    assert attributes.keys() == same.keys() and not any(values.any() for values in buffers.values())
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 3 // 4])
    assert [frame.index for frame in render(tmp_path, "uniform", resume=True, memory=SMALL)] == [0]
