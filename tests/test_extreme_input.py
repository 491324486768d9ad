"""Numbers far too large or too small, long times, closed streams: a line or the right picture, never NaN."""

from __future__ import annotations

import errno
import json
import os
import subprocess
import sys

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.cli import main as cli
from warp_gi.errors import OptionError, SceneError
from warp_gi.scene.camera import MOST_BETWEEN, CameraPath, views_hash
from warp_gi.techniques.shared.views import MOST, cameras_of

TINY = ["--resolution", "8x8", "--spp", "1", "--pipeline", "path", "--frames", "0"]
PLACE = ["--eye", "0", "1", "3", "--target", "0", "1", "0"]


def path_file(folder, **fields):
    keys = [{"time": 0, "eye": [0, 1, 3], "target": [0, 1, 0]}, {"time": 10, "eye": [0, 1, 2], "target": [0, 1, 0]}]
    (folder / "p.json").write_text(json.dumps({"keyframes": keys, **fields}))
    return ["--camera", str(folder / "p.json")]


# ---- numbers past float32 ----


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--environment", "1e39"], "radiance must be at most 1e+30"),
        (["--environment", "1e20", "--environment-scale", "1e20"], "radiance must be at most 1e+30"),
        (["--environment", "1,1,1e31"], "radiance must be at most 1e+30"),
        ([*PLACE, "--hfov", "1e-300"], "hfov must be from 0.001 to 179.9999 degrees, got 1e-300"),
        ([*PLACE, "--hfov", "180"], "hfov must be"),
        (["--eye", "1e16", "1", "3", "--target", "0", "1", "0"], "its position must be within 1e+15 m"),
        (["--exposure", "1e6", "--preview"], "exposure must be from -100 to 100 stops, got 1e+06"),
        (["--exposure", "nan", "--preview"], "exposure must be from -100 to 100 stops, got nan"),
        (["--frames", "9" * 12], "numbers must be at most 2,147,483,647"),
        (["--frames", "0-" + "9" * 5000], "not understood"),
        (["--resolution", "99999999999x2"], "resolution must be at most 65536 a side"),
        (["--resolution", "9" * 400 + "x2"], "not understood"),
        (["--resolution", "40000x40000"], "1,073,741,824 pixels, got 40000x40000"),
        (["--memory", "nan"], "memory must be a number of bytes above 0, got nan"),
    ],
)
def test_numbers_that_are_too_large_are_one_line(tmp_path, capfd, options, words):
    out = ["-o", str(tmp_path / "o" / "a.####.exr")]
    assert cli.main(["render", "cornell_box", *TINY, *options, *out]) == 2
    error = capfd.readouterr().err
    assert words in error and error.count("\n") == 1 and not (tmp_path / "o").exists()


@pytest.mark.parametrize(
    ("light", "words"),
    [
        ({"intensity": (1e31, 0, 0)}, "intensity must be at most 1e\\+30, got 1e\\+31"),
        ({"position": (0, 1e31, 0)}, "position must be within 1e\\+30 m"),
    ],
)
def test_lights_that_are_too_large(light, words):
    box = gi.builtin_scene("cornell_box")
    with pytest.raises(SceneError, match=words):
        gi.Scene(box.nodes, [gi.PunctualLight("point", **({"intensity": (1, 1, 1)} | light))])


def test_skies_that_are_too_bright():
    pixels = np.ones((4, 8, 3), np.float32)
    pixels[1, 2] = 1e32
    with pytest.raises(SceneError, match="highest is 1e\\+32"):
        gi.Environment(pixels=pixels)
    with pytest.raises(SceneError, match="got 1e\\+20 times a scale of 1e\\+15"):
        gi.Environment(pixels=np.full((4, 8, 3), 1e20, np.float32), scale=1e15)


@pytest.mark.parametrize("radiance", [1e-30, 1e28])
def test_what_is_allowed_gives_finite_pictures(radiance):
    scene = gi.builtin_scene("cornell_box")
    scene.environment = radiance
    camera = gi.Camera.look_at((0, 1, 3), (0, 1, 0), resolution=(8, 8))
    frame = next(gi.render(scene, camera, gi.Pipeline(spp=4)))
    assert all(np.isfinite(frame.numpy(name)).all() for name in ("beauty", "environment", "indirect"))
    assert frame.numpy("beauty").max() > 0


def test_a_camera_far_from_a_small_scene_is_warned_of():
    scene = gi.builtin_scene("cornell_box")
    pipeline = gi.Pipeline(spp=1)
    with pytest.warns(UserWarning, match=r"the camera is 1e\+09 m from the origin, .* steps of 64 m"):
        gi.FrameScheduler(scene, gi.Camera.look_at((1e9, 1, 3), (0, 1, 0), resolution=(8, 8)), pipeline)
    near = gi.Camera.look_at((300, 1, 3), (0, 1, 0), resolution=(8, 8))
    gi.FrameScheduler(scene, near, pipeline)  # a warning is an error in tests that do not expect one


# ---- long times ----


def test_a_path_of_a_thousand_million_frames_renders_the_first(tmp_path, capfd):
    out = ["-o", str(tmp_path / "a.####.exr")]
    assert cli.main(["render", "cornell_box", *TINY, *path_file(tmp_path, fps=1e8), *out]) == 0
    assert (tmp_path / "a.0000.exr").is_file()


def test_cameras_of_a_long_path_are_some_of_them():
    keys = (gi.CameraKey(0.0, (0, 1, 3), (0, 1, 0)), gi.CameraKey(1e6, (0, 1, 2), (0, 1, 0)))
    path = CameraPath(keys, resolution=(8, 8))
    every, some = cameras_of(path, every=True), cameras_of(path)
    assert len(every) <= MOST + len(some) and len(some) == 32
    assert {one.position[2] for one in some} <= {one.position[2] for one in every}
    short = CameraPath((keys[0], gi.CameraKey(1.0, (0, 1, 2), (0, 1, 0))))
    assert len(cameras_of(short, every=True)) == short.frame_count == 25


def test_a_hash_of_views_tells_paths_apart():
    keys = [gi.CameraKey(0.0, (0, 1, 3), (0, 1, 0)), gi.CameraKey(1.0, (0, 1, 2), (0, 1, 0))]
    path = CameraPath(keys)
    assert views_hash(path) == views_hash(CameraPath(keys, name="other"))
    others = [path.at_resolution(20, 20), CameraPath(keys, fps=25.0), CameraPath(keys[:1]), None, path.camera(3)]
    assert len({views_hash(path), *map(views_hash, others)}) == 6
    assert views_hash(path.camera(0)) == views_hash(CameraPath.still(path.camera(0)))


def test_poses_between_keys_are_those_of_all_keys():
    """A pose follows from the two keys before it and the two after it, as of a curve through all."""
    rng = np.random.default_rng(4)
    times = np.sort(rng.uniform(0, 9, 12))
    keys = [gi.CameraKey(t, tuple(rng.uniform(0, 1, 3)), tuple(rng.uniform(5, 6, 3)), hfov=40 + 9 * t) for t in times]
    path = CameraPath(keys)
    eyes = np.array([key.eye for key in keys])
    steps = np.diff(eyes, axis=0) / np.diff(times)[:, None]
    slopes = np.concatenate([steps[:1], 0.5 * (steps[1:] + steps[:-1]), steps[-1:]])
    for time in (*times, *rng.uniform(0, 10, 50), 0.0):
        i = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 2))
        h = times[i + 1] - times[i]
        s = np.clip((time - times[i]) / h, 0, 1)
        weights = (2 * s**3 - 3 * s**2 + 1, s**3 - 2 * s**2 + s, -2 * s**3 + 3 * s**2, s**3 - s**2)
        values = eyes[i], slopes[i] * h, eyes[i + 1], slopes[i + 1] * h
        np.testing.assert_allclose(
            path.camera_at(time).position, sum(w * v for w, v in zip(weights, values, strict=True))
        )


def test_a_camera_of_an_animation_of_hours_has_few_keys():
    """Between keyframes that are far apart a path has some keys, and shows the pose of every frame all the same."""
    box = gi.builtin_scene("cornell_box")
    half = float(np.sqrt(0.5))
    keys = [
        gi.Keyframe(0.0, (0.0, 1.0, 3.0)),
        gi.Keyframe(2.0, (1.0, 1.0, 3.0)),
        gi.Keyframe(10_000.0, (1.0, 1.0, 2.0), (0.0, half, 0.0, half)),
    ]
    nodes = [*box.nodes, gi.Node("rig", [], keyframes=keys)]
    camera = gi.Camera(np.eye(4), resolution=(8, 8))
    scene = gi.Scene(nodes, cameras={"main": camera}, camera_nodes={"main": len(nodes) - 1})
    path = CameraPath.from_scene(scene, "main")
    assert path.frame_count == 240_001 and len(path.keys) < 50 + 2 * MOST_BETWEEN
    for frame in (0, 1, 30, 47, 48, 49, 50, 60, 7777, 120_001, 239_995, 240_000):
        expected = scene.world_from_node(len(nodes) - 1, frame / 24)
        shown = path.camera(frame).world_from_camera
        np.testing.assert_allclose(shown, expected, atol=2e-5)


# ---- streams and faults ----


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_closed_streams(tmp_path, closed):
    command = (
        f'"{sys.executable}" -m warp_gi.cli render cornell_box {" ".join(TINY)} -o "{tmp_path}/a.####.exr" {closed}'
    )
    done = subprocess.run(command, shell=True, timeout=300, check=False)
    assert done.returncode == 0
    assert np.isfinite(gi.read_frame(tmp_path / "a.0000.exr").numpy("beauty")).all()


FAULTS = [
    OverflowError("too large"),
    RuntimeError("odd"),
    KeyError("x"),
    RecursionError("deep"),
    AssertionError(),
    ZeroDivisionError(),
]


def test_numbers_of_frames_and_pixels_in_programs():
    box, path = gi.builtin_scene("cornell_box"), gi.builtin_camera_path("cornell_box").at_resolution(8, 6)
    with pytest.raises(OptionError, match=r"frame numbers must be at most 2,147,483,647, got 100000000000000\.\.\."):
        next(gi.render(box, path, gi.Pipeline(spp=1), frames=[10**400]))
    for size in ((10**400, 2), (2, 10**12), (1 << 15, 1 << 16), (0, 1), ("a", 1), 5, (float("inf"), 2)):
        for camera in (path, path.camera(0)):
            with pytest.raises(OptionError, match="resolution must be"):
                camera.at_resolution(*(size if isinstance(size, tuple) else (size, 0)))


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_full_standard_output_is_named():
    command = f'"{sys.executable}" -m warp_gi.cli info cornell_box > /dev/full'
    done = subprocess.run(command, shell=True, timeout=300, check=False, capture_output=True, text=True)
    assert done.returncode == 1 and done.stderr == "warp-gi: error: standard output: No space left on device\n"


@pytest.mark.parametrize("command", ["render", "bake", "compare", "info", "bench", "video"])
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: type(fault).__name__)
def test_whatever_a_command_lets_out_is_one_line(monkeypatch, capfd, command, fault):
    module = __import__(f"warp_gi.cli.{command}", fromlist=["main"])

    def fails(arguments):
        raise fault

    monkeypatch.setattr(module, "main", fails)
    monkeypatch.delenv("WARP_GI_DEBUG", raising=False)
    assert cli.main([command]) == 1
    said = capfd.readouterr().err
    assert said.startswith("warp-gi: error: a fault of warp-gi, please report it (" + type(fault).__name__)
    assert said.count("\n") == 1 and "WARP_GI_DEBUG=1" in said
    monkeypatch.setenv("WARP_GI_DEBUG", "1")
    with pytest.raises(type(fault)):
        cli.main([command])


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (OptionError("a setting"), 2),
        (PermissionError(errno.EACCES, "may not be written", "a.exr"), 2),
        (OSError(errno.ENOSPC, "no space left", "a.exr"), 1),
        (OSError("cannot write a.exr: unknown failure"), 1),
        (MemoryError(), 1),
    ],
    ids=repr,
)
def test_exit_codes_tell_mistakes_from_failures(error, code, monkeypatch, capfd):
    """A job scheduler tries again what failed, and leaves alone what can never be."""

    def fails(arguments):
        raise error

    monkeypatch.setattr("warp_gi.cli.render.main", fails)
    assert cli.main(["render"]) == code
    assert capfd.readouterr().err.count("\n") == 1


def test_an_exposure_is_checked_where_pictures_are_made():
    from warp_gi.sequence.preview import tone_map

    with pytest.raises(OptionError, match="exposure must be from -100 to 100 stops"):
        tone_map(np.ones((2, 2, 3)), 1e6)
    assert (tone_map(np.full((2, 2, 3), 1e38), 100.0) == 255).all()
