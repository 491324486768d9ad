"""What a Python program does with scenes, frames and bakes beside rendering: copies, notebooks, NumPy's numbers."""

from __future__ import annotations

import copy
import dataclasses
import io
import logging
import pickle
import re
import subprocess
import sys

import numpy as np
import pytest
import warp as wp
from PIL import Image

import warp_gi as gi
from warp_gi import launch
from warp_gi.errors import OptionError
from warp_gi.stateful import Stateful

COPIES = {"pickle": lambda thing: pickle.loads(pickle.dumps(thing)), "deepcopy": copy.deepcopy}
SIZE = (24, 16)


def camera():
    return gi.Camera.look_at((0, 1, 3.4), (0, 1, 0), resolution=SIZE)


def rendered(scene, **options):
    return next(gi.render(scene, camera(), gi.Pipeline(spp=1), **options))


def leaf():
    """Return a scene with a mask, a texture and a sky, which moves."""
    pixels = np.full((4, 4, 4), 255, np.uint8)
    pixels[:2, :, 3] = 0
    material = gi.Material("leaf", base_color_texture=gi.Texture("leaf", pixels), alpha_cutoff=0.5)
    points = np.float32([[-1, 0, 0], [1, 0, 0], [1, 2, 0], [-1, 2, 0]])
    mesh = gi.Mesh(points, np.int32([[0, 1, 2], [0, 2, 3]]), material, uvs=np.float32([[0, 0], [1, 0], [1, 1], [0, 1]]))
    keys = [gi.Keyframe(0.0), gi.Keyframe(1.0, translation=(0.5, 0.0, 0.0))]
    return gi.Scene([gi.Node("leaf", [mesh], keyframes=keys)], environment=(1.0, 0.5, 0.2), name="leaves")


# ---- copies ----


@pytest.mark.parametrize("way", COPIES)
@pytest.mark.parametrize("build", [lambda: gi.builtin_scene("cornell_box"), leaf], ids=["cornell box", "leaf"])
def test_a_rendered_scene_can_be_copied(way, build):
    scene = build()
    scene.offset = np.array([10.0, 0.0, 5.0])
    first = rendered(scene)
    again = COPIES[way](scene)
    assert again.hash == scene.hash and again is not scene
    np.testing.assert_array_equal(again.offset, scene.offset)
    np.testing.assert_array_equal(rendered(again).numpy("beauty"), first.numpy("beauty"))
    again.environment = 9.0
    np.testing.assert_array_equal(rendered(scene).numpy("beauty"), first.numpy("beauty"))


@pytest.mark.parametrize("way", COPIES)
def test_a_copied_scene_has_the_edits_of_its_original(way):
    """A material that was edited after the first frame stops the original, and is what the copy is made of."""
    scene = leaf()
    before = rendered(scene).numpy("albedo")
    scene.materials[0].base_color = (0.1, 0.1, 0.1)
    again = COPIES[way](scene)
    assert rendered(again).numpy("albedo").sum() == pytest.approx(0.125 * before.sum(), rel=1e-5)


@pytest.mark.parametrize("way", COPIES)
def test_a_frame_can_be_copied(way, tmp_path):
    frame = rendered(leaf())
    again = COPIES[way](frame)
    assert again.names == frame.names and again.index == frame.index and again.metadata == frame.metadata
    for name in frame.names:
        np.testing.assert_array_equal(again.numpy(name), frame.numpy(name))
        np.testing.assert_array_equal(again[name].numpy(), frame[name].numpy())
    files = [gi.write_frame(one, tmp_path / f"{number}.####.exr") for number, one in enumerate((frame, again))]
    one, other = (gi.read_frame(file) for file in files)
    np.testing.assert_array_equal(one.numpy("beauty"), other.numpy("beauty"))
    assert one.metadata == other.metadata


@pytest.mark.parametrize("way", COPIES)
def test_a_tree_can_be_copied(way):
    """With its masks, and in the pose that it was refitted to."""
    scene = leaf()
    scene.update(1.0)
    tree = scene.bvh("cpu")
    again = COPIES[way](tree)
    rng = np.random.default_rng(1)
    targets = rng.uniform((-1, 0, 0), (2, 2, 0), (500, 3))
    origins = np.full((500, 3), (0.0, 1.0, 3.0))
    hits, same = (one.intersect(origins, targets - origins) for one in (tree, again))
    assert 0 < (hits.face.numpy() >= 0).mean() < 0.6  # the mask's half, and what lies beside
    np.testing.assert_array_equal(same.face.numpy(), hits.face.numpy())
    np.testing.assert_array_equal(same.t.numpy(), hits.t.numpy())


# ---- notebooks ----


def test_a_frame_shows_itself(tmp_path):
    frame = rendered(leaf())
    file = gi.read_frame(gi.write_frame(frame, tmp_path / "a.####.exr"))
    gi.write_frame(frame, tmp_path / "a.####.exr")
    for one in (frame, file):
        assert Image.open(io.BytesIO(one._repr_png_())).size == SIZE
        assert "24x16" in repr(one) and "beauty" in repr(one)


def test_things_say_what_they_are():
    scene = leaf()
    assert repr(scene).startswith("<Scene 'leaves': 2 triangles, 1 materials, 0 emitters, sky, ")
    assert "1 s of animation" in repr(scene) and "2.5 x 2 x 0 m" in repr(scene)
    assert repr(scene.bvh("cpu")) == "<TriangleBvh: 2 triangles on 'cpu'>"
    bake = gi.Bake("SurfaceCache", "ab" * 32, {"paths": 10}, {"keys": np.zeros(10**6, np.uint64)}, scene_name="leaves")
    assert repr(bake) == "<Bake SurfaceCache(paths=10) of 'leaves', 8 MB: keys [1000000]>"
    assert "TracedEnvironment" in repr(gi.Pipeline())


def test_parts_of_scenes_say_what_they_are_in_one_line():
    """Arrays by their sizes alone."""
    node = leaf().nodes[0]
    mesh = "<Mesh 'mesh': 4 vertices, 2 triangles, material 'leaf', uvs>"
    assert repr(node.meshes[0]) == mesh
    assert repr(node) == f"<Node 'leaf': at (0, 0, 0) m, 2 keyframes, {mesh}>"
    assert repr(gi.Node("b", parent=3)) == "<Node 'b': at (0, 0, 0) m, below node 3>"
    assert repr(node.meshes[0].material.base_color_texture) == "<Texture 'leaf': 4 x 4 pixels, sRGB>"
    sky = gi.Environment(pixels=np.ones((2, 4, 3), np.float32), rotation=30.0)
    assert repr(sky) == "<Environment 'environment': 4 x 2 pixels, rotation 30, scale 1>"
    assert "color (1.0, 0.5, 0.2)" in repr(leaf().environment)
    scheduler = gi.FrameScheduler(leaf(), camera(), gi.Pipeline(indirect=None), seed=3)
    assert repr(scheduler).startswith("<FrameScheduler of scene 'leaves' on cpu, seed 3: environment TracedEnvironment")


class Line(io.StringIO):
    """A stream that may be a terminal."""

    def __init__(self, is_terminal: bool) -> None:
        super().__init__()
        self.isatty = lambda: is_terminal


def test_a_line_shows_progress(monkeypatch):
    """On a terminal and in a notebook, and ends with the frames; nothing is written to a file."""
    shell = type("ZMQInteractiveShell", (), {})()
    notebook = type(sys)("IPython")
    notebook.get_ipython = lambda: shell
    for is_terminal, is_notebook in ((True, False), (False, True), (False, False)):
        stream = Line(is_terminal)
        monkeypatch.setattr(sys, "stderr", stream)
        if is_notebook:
            monkeypatch.setitem(sys.modules, "IPython", notebook)
        else:
            monkeypatch.delitem(sys.modules, "IPython", raising=False)
        path = gi.CameraPath.from_cameras([camera()] * 2)
        frames = gi.render(leaf(), path, gi.Pipeline(spp=1), progress=True)
        next(frames)
        assert "\n" not in stream.getvalue()
        assert len(list(frames)) == 1
        said = stream.getvalue()
        if not (is_terminal or is_notebook):
            assert said == ""
            continue
        assert said.startswith("\r[") and said.endswith("\n") and said.count("\n") == 1
        last = said.rstrip("\n").rpartition("\r")[2].rstrip()
        assert last == f"[{'#' * 30}] 2/2 frames  trace 100 %" and f"\r[{'#' * 15}{' ' * 15}] 1/2 frames" in said


def test_a_bake_shows_its_progress(monkeypatch):
    stream = Line(True)
    monkeypatch.setattr(sys, "stderr", stream)
    gi.bake(gi.builtin_scene("cornell_box"), gi.SurfaceCache(paths=1000), camera=camera(), progress=True)
    assert re.fullmatch(r"(\r\[#* *\]  bake \d+ % *)+\n", stream.getvalue())
    with pytest.raises(OptionError, match=r"progress must be True, or be called with \(stage, share done\), got 'yes'"):
        next(gi.render(leaf(), camera(), gi.Pipeline(spp=1), progress="yes"))


def test_equal_cameras_compare_equal():
    assert camera() == camera() and hash(camera()) == hash(camera())
    named = gi.Camera.look_at((0, 1, 3.4), (0, 1, 0), resolution=SIZE, name="main")
    assert camera() == named
    others = (
        gi.Camera.look_at((0, 1, 3.5), (0, 1, 0), resolution=SIZE),
        camera().at_resolution(24, 17),
        camera().with_vfov(30.0),
        camera().relative_to((1.0, 0.0, 0.0)),
    )
    assert all(camera() != other for other in others) and camera() != "camera"


# ---- NumPy's numbers ----


def test_whole_numbers_of_numpy():
    scene = gi.builtin_scene("cornell_box")
    path = gi.CameraPath.from_cameras([camera()] * 3)
    plain = list(gi.render(scene, path, gi.Pipeline(spp=2), frames=[1, 2], seed=3))
    pipeline = gi.Pipeline(spp=np.int64(2), camera_samples=np.uint8(2))
    numpy = list(gi.render(scene, path, pipeline, frames=np.arange(1, 3), seed=np.int64(3)))
    assert [frame.index for frame in numpy] == [1, 2]
    for one, other in zip(plain, numpy, strict=True):
        np.testing.assert_array_equal(one.numpy("beauty"), other.numpy("beauty"))
        assert one.metadata == other.metadata
    assert repr(pipeline) == repr(gi.Pipeline(spp=2, camera_samples=2))


def settings_of_numpy():
    """Yield a class, a field, and a value of NumPy's kinds with that which it stands for."""
    for name in gi.__all__:
        kind = getattr(gi, name)
        if not (isinstance(kind, type) and (issubclass(kind, Stateful) or kind is gi.Pipeline)):
            continue
        for one in dataclasses.fields(kind):
            value = one.default
            if isinstance(value, bool):
                yield kind, one.name, np.bool_(value), value
            elif isinstance(value, int):
                yield kind, one.name, np.int64(value), value
                yield kind, one.name, np.array(value), value
            elif isinstance(value, float):
                yield kind, one.name, np.float64(value), value
                yield kind, one.name, np.float32(value), float(np.float32(value))
            elif isinstance(value, tuple) and value:
                yield kind, one.name, np.array(value), value
                yield kind, one.name, tuple(np.array(value)), value


def test_every_setting_takes_numbers_of_numpy():
    found = list(settings_of_numpy())
    assert len(found) > 100 and {gi.Pipeline, gi.RadianceTransfer, gi.SpatioTemporal} <= {kind for kind, *_ in found}
    for kind, name, given, plain in found:
        ours, truth = (kind(**{name: value}) for value in (given, plain))
        assert repr(ours) == repr(truth) and ours == truth, (kind, name)
        assert type(getattr(ours, name)) is type(plain), (kind, name)
    assert gi.Pipeline(spp=np.uint8(3), background=np.bool_(False)) == gi.Pipeline(spp=3, background=False)
    with pytest.raises(OptionError, match="spp must be a whole number, got True"):
        gi.Pipeline(spp=np.bool_(True))
    with pytest.raises(OptionError, match=r"paths must be a whole number .* got 2000.5"):
        gi.SurfaceCache(paths=np.float64(2000.5))


def test_a_bake_by_numbers_of_numpy_is_the_same(tmp_path):
    scene = gi.builtin_scene("cornell_box")
    settings = gi.SurfaceCache(paths=2000)
    one, other = (settings.bake(scene, "cpu", seed, camera=camera()) for seed in (1, np.int64(1)))
    assert one.digest == other.digest and one.settings == other.settings
    other.save(tmp_path / "a.safetensors")


@pytest.mark.parametrize("frames", [[0.5], [True], ["1"]])
def test_what_is_no_whole_number_is_refused(frames):
    with pytest.raises(OptionError, match="frame numbers must be a whole number, got"):
        list(gi.render(leaf(), camera(), gi.Pipeline(spp=1), frames=frames))


# ---- what is said ----


@pytest.fixture
def kept_levels():
    log = logging.getLogger("warp_gi")
    before, handlers, level = wp.config.log_level, list(log.handlers), log.level
    log.handlers[:] = []  # those of commands
    yield
    wp.config.log_level, log.handlers[:] = before, handlers
    log.setLevel(level)


def test_stdout_of_a_program_is_its_own():
    """Neither Warp's greeting nor its lines of modules are on it."""
    text = (
        "import warp_gi as gi\n"
        "next(gi.render(gi.builtin_scene('cornell_box'), gi.Camera.look_at((0, 1, 3), (0, 1, 0), resolution=(8, 8)),"
        " gi.Pipeline(spp=1)))\n"
        "print('mine')"
    )
    done = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, timeout=300, check=True)
    assert done.stdout == "mine\n"


@pytest.mark.usefixtures("kept_levels")
def test_verbosity(capsys):
    gi.set_verbosity("info")
    logging.getLogger("warp_gi").info("kept in a folder")
    assert wp.config.log_level == wp.LOG_WARNING
    gi.set_verbosity("debug")
    assert wp.config.log_level == wp.LOG_DEBUG
    gi.set_verbosity("error")
    logging.getLogger("warp_gi").info("and not this")
    assert wp.config.log_level == wp.LOG_ERROR and launch.thread_count() >= 1
    said = capsys.readouterr()
    assert said.out == "" and "and not this" not in said.err
    with pytest.raises(OptionError, match=r"unknown verbosity 'quite'.*known: debug, error, info, warning"):
        gi.set_verbosity("quite")
