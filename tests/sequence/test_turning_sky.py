"""Skies that are functions of time: frames as with a sky assigned by hand, baking, resuming, and mistakes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.errors import SceneError
from warp_gi.sequence import frames as sequence

TURN = 51.3  # degrees a frame
FPS = 24.0
FRAMES = (2, 3, 5)
PROBES = gi.LightFieldProbes(counts=(2, 2, 2), resolution=16, irradiance_resolution=8, rays=1, bounces=2, update=2)
FIELD = gi.VisibilityField(cell_size=0.5, resolution=18, rays=64, sky="harmonics")
PIPELINES = {
    "path": gi.Pipeline.preset("path", spp=2),
    "dvf": gi.Pipeline.preset("dvf", spp=2, environment=FIELD),
    "probes": gi.Pipeline.preset("probes", spp=2, indirect=PROBES),
    "probes of the first sky": gi.Pipeline.preset("probes", spp=2, indirect=replace(PROBES, update=0)),
    "reuse": gi.Pipeline.preset("reuse", spp=2),
}


def bright_side():
    pixels = np.full((8, 16, 3), 0.2, np.float32)
    pixels[2:4, 3:6] = (8.0, 4.0, 1.0)
    return gi.Environment(pixels=pixels, rotation=17.3, scale=1.5)


def box(sky):
    scene = gi.builtin_scene("cornell_box")
    scene.environment = sky
    return scene


def path(resolution=(24, 16)):
    return gi.builtin_camera_path("cornell_box").at_resolution(*resolution)


def contents(frame):
    """Return all that a frame says: its buffers, and its metadata."""
    return {name: frame.numpy(name).copy() for name in frame.names} | {"metadata": dict(frame.metadata)}


def assert_same(found, wanted):
    assert len(found) == len(wanted)
    for a, b in zip(found, wanted, strict=True):
        assert a.keys() == b.keys() and a["metadata"] == b["metadata"]
        differing = [name for name in b if name != "metadata" and a[name].tobytes() != b[name].tobytes()]
        assert not differing


@pytest.mark.parametrize("fps", [24.0, 25.0, 29.97, 49.0, 23.976, 1.0, 1000 / 7])
@pytest.mark.parametrize("turn", [TURN, -213.7, 0.1, 1e-3, 720.5])
def test_the_angle_of_a_frame_is_that_of_its_number(fps, turn):
    """To the last bit, though it is found from the frame's time."""
    sky = bright_side()
    turning = gi.TurningSky(sky, turn, fps)
    for index in [*range(200), 977, 4801, 123_457]:
        by_hand = sky.rotated(math.fmod(index * turn, 360.0))
        assert turning(index / fps).rotation == by_hand.rotation


def test_between_frames_the_sky_turns_on():
    turning = gi.TurningSky(bright_side(), degrees=30.0)  # per second
    assert turning(0.0).rotation == 17.3
    assert turning(0.5).rotation == pytest.approx(32.3) and turning(13.0).rotation == pytest.approx(47.3)
    assert turning(0.5).pixels is turning(0.0).pixels


@pytest.mark.parametrize("name", PIPELINES)
def test_frames_are_as_with_a_sky_assigned_for_each(name):
    """As ``scene.environment = sky.rotated(...)`` before each frame; baked under the sky of the first one."""
    sky, scene = bright_side(), box(None)
    by_hand = gi.FrameScheduler(scene, path(), PIPELINES[name], seed=3)
    wanted = []
    for before, index in zip([None, *FRAMES], FRAMES, strict=False):
        scene.environment = sky.rotated(math.fmod(index * TURN, 360.0))
        wanted.append(contents(by_hand.frame(index, before)))
    turning = box(gi.TurningSky(sky, TURN, FPS))
    assert_same([contents(frame) for frame in gi.render(turning, path(), PIPELINES[name], FRAMES, seed=3)], wanted)
    assert len({frame["metadata"]["scene_hash"] for frame in wanted}) == len(FRAMES)


def test_two_sequences_of_one_scene_have_the_sky_of_their_own_frames():
    pipeline = PIPELINES["path"]
    alone = [[contents(f) for f in gi.render(box(gi.TurningSky(bright_side(), TURN, FPS)), path(), pipeline, frames)]
             for frames in ((0, 1), (7, 8))]  # fmt: skip
    scene = box(gi.TurningSky(bright_side(), TURN, FPS))
    renderers = [gi.FrameScheduler(scene, path(), pipeline) for _ in range(2)]
    for step in range(2):
        for one, first, wanted in zip(renderers, (0, 7), alone, strict=True):
            previous = first + step - 1 if step else None
            assert_same([contents(one.frame(first + step, previous))], [wanted[step]])


def test_frames_know_that_the_sky_changes_without_being_told():
    def says(sky, name):
        return gi.FrameScheduler(box(sky), path(), PIPELINES[name]).dependence(range(3)).kind

    turning = gi.TurningSky(bright_side(), TURN, FPS)
    assert says(turning, "path") == "independent" and says(turning, "reuse") == "saved"
    assert says(turning, "probes of the first sky") == "unsaved"
    assert says(bright_side(), "probes of the first sky") == "independent"


def test_a_function_of_time_is_asked_once_a_frame_and_baked_anew_only_for_another_sky():
    asked = []

    def morning(seconds):
        asked.append(seconds)
        return 0.5 if seconds < 2 / FPS else 2.0

    scene = box(morning)
    assert scene.is_sky_animated and scene.environment.color == (0.5, 0.5, 0.5)
    light, versions = [], []
    for frame in gi.render(scene, path(), gi.Pipeline(emitters=None, indirect=None, spp=4), range(4)):
        light.append(frame.numpy("environment").mean())
        versions.append(scene.version)
    assert asked == [0.0, 1 / FPS, 2 / FPS, 3 / FPS]
    assert versions[0] == versions[1] < versions[2] == versions[3]
    assert light[2] > 3 * light[1] > 0


@pytest.mark.parametrize("edited", ["pixels", "rotation"])
def test_a_function_may_edit_the_sky_that_it_returned_before(edited):
    """It shows in the next frame, as it would in a new Environment."""
    sky = bright_side()
    edits = {"pixels": lambda: sky.pixels.__imul__(0.5), "rotation": lambda: setattr(sky, "rotation", 120.0)}
    scene = box(lambda seconds: (edits[edited](), sky)[1] if seconds == 1 / FPS else sky)
    first, second = (contents(frame) for frame in gi.render(scene, path(), PIPELINES["path"], (0, 1)))
    assert first["metadata"]["scene_hash"] != second["metadata"]["scene_hash"]
    by_hand = box(gi.Environment(sky.pixels.copy(), rotation=sky.rotation, scale=sky.scale))
    assert_same([second], [contents(frame) for frame in gi.render(by_hand, path(), PIPELINES["path"], (1,))])


def test_an_assigned_sky_stands_still():
    scene = box(gi.TurningSky(bright_side(), TURN, FPS))
    assert scene.update_sky(1 / FPS) and not scene.update_sky(1 / FPS)
    assert scene.environment.rotation == pytest.approx(17.3 + TURN)
    scene.environment = 1.0
    assert not scene.is_sky_animated and not scene.update_sky(2 / FPS)
    assert scene.environment.color == (1.0, 1.0, 1.0)


def test_a_bake_is_of_the_sky_at_time_0():
    scene = box(gi.TurningSky(bright_side(), TURN, FPS))
    scene.update_sky(3 / FPS)
    digest = gi.bake(scene, PROBES, camera=path()).digest
    assert digest == gi.bake(box(bright_side()), PROBES, camera=path()).digest


def test_what_is_no_sky_is_one_line():
    with pytest.raises(SceneError, match=r"^the sky at 0 s: environment must be a file"):
        box(lambda seconds: "red" if seconds else (1.0, 2.0))
    scene = box(lambda seconds: (-1.0, 0.0, 0.0) if seconds else 1.0)
    with pytest.raises(SceneError, match=r"^the sky at 0\.04.* s: environment must be a file"):
        scene.update_sky(1 / FPS)
    with pytest.raises(SceneError, match="environment must be a file"):
        box(gi.SunSky)  # a class is no function of time
    with pytest.raises(SceneError, match="finite number of degrees, got nan"):
        gi.TurningSky(1.0, math.nan)
    with pytest.raises(SceneError, match="fps of a turning sky must be finite and above 0, got 0"):
        gi.TurningSky(1.0, 1.0, 0)


def test_a_turning_sky_is_resumed(tmp_path):
    """Each file says the sky of its frame; another speed changes all but frame 0."""
    scene, pipeline, pattern = box(gi.TurningSky(bright_side(), TURN, FPS)), PIPELINES["dvf"], tmp_path / "a.####.exr"
    pipeline = replace(pipeline, environment=replace(FIELD, budget=0.0))
    wanted = [contents(frame) for frame in gi.render(scene, path(), pipeline, range(4), output=pattern)]
    sequence.frame_path(pattern, 2).unlink()
    again = [contents(frame) for frame in gi.render(scene, path(), pipeline, range(4), output=pattern, resume=True)]
    assert_same(again, wanted[2:3])
    scene.environment = gi.TurningSky(bright_side(), TURN + 1.0, FPS)
    plan = gi.plan_sequence(scene, path(), pipeline, range(4), output=pattern)
    assert plan.frames == (1, 2, 3) and plan.missing == ()
    assert plan.reason(1).startswith("scene_hash is ")


def test_a_clean_sequence_under_a_turning_sky_is_resumed(tmp_path):
    """Its cache follows the sky from frame to frame, and its denoiser the frames: both states are saved."""
    scene, pipeline = box(gi.TurningSky(bright_side(), TURN, FPS)), gi.Pipeline.preset("clean")
    wanted = [contents(frame) for frame in gi.render(scene, path(), pipeline, range(4), output=tmp_path / "a.####.exr")]
    for _ in gi.render(scene, path(), pipeline, range(2), output=tmp_path / "b.####.exr"):
        pass
    again = gi.render(scene, path(), pipeline, range(4), output=tmp_path / "b.####.exr", resume=True)
    assert_same([contents(frame) for frame in again], wanted[2:])


def test_probes_under_a_turning_sky_start_over(tmp_path):
    """They begin with the sky of the first frame, also where that need not be rendered."""
    name, pattern = "probes of the first sky", tmp_path / "a.####.exr"
    scene = box(gi.TurningSky(bright_side(), TURN, FPS))
    plain = [contents(frame) for frame in gi.render(scene, path(), PIPELINES[name], FRAMES)]
    scene.update_sky(0.0)  # the sky that the scene has now is of no account
    wanted = [contents(frame) for frame in gi.render(scene, path(), PIPELINES[name], FRAMES, output=pattern)]
    assert all(a["indirect"].tobytes() == b["indirect"].tobytes() for a, b in zip(plain, wanted, strict=True))
    sequence.frame_path(pattern, FRAMES[1]).unlink()
    plan = gi.plan_sequence(scene, path(), PIPELINES[name], FRAMES, output=pattern)
    assert plan.frames == FRAMES and plan.restart == "the indirect light depends on the frames before"
    again = gi.render(scene, path(), PIPELINES[name], FRAMES, output=pattern, resume=True)
    assert_same([contents(frame) for frame in again], wanted)
