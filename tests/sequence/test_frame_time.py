"""Samples a pixel by the time that a frame may take."""

from types import SimpleNamespace

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.cli import main as cli
from warp_gi.errors import OptionError
from warp_gi.sequence import frame_time
from warp_gi.sequence.frame_time import parse_seconds, samples_within
from warp_gi.sequence.resume import shots_of

SIZE = (24, 16)


def path():
    return gi.builtin_camera_path("cornell_box").at_resolution(*SIZE)


class Clockwork:
    """Stands for a scheduler whose frames take a second for each sample of each pixel, and some more."""

    def __init__(self, base, by_frame):
        self.base, self.by_frame, self.asked = base, by_frame, []

    def trial(self, index, previous, spp, resolution):
        self.asked.append((index, spp))
        seconds = (self.base + self.by_frame(index) * spp) * resolution[0] * resolution[1] / (SIZE[0] * SIZE[1])
        return SimpleNamespace(timings={"paths": 0.75 * seconds, "denoise": 0.25 * seconds, "bake": 99, "compile": 9})


@pytest.mark.parametrize(
    ("seconds", "samples"), [(2.0, 1), (2.99, 1), (3.01, 2), (11.01, 10), (33.5, 32), (1000.5, 999)]
)
def test_as_many_samples_as_fit(seconds, samples):
    """Of frames of 1 + n seconds: bakes and compilation are no part of it, all pixels are."""
    scheduler = Clockwork(1.0, lambda index: 1.0)
    assert samples_within(scheduler, shots_of(path(), range(4), "#.exr"), seconds) == samples
    assert len(scheduler.asked) < 20


def test_the_slowest_of_a_few_frames_decides():
    scheduler = Clockwork(0.0, lambda index: 4.0 if index == 10 else 1.0)
    assert samples_within(scheduler, shots_of(path(), range(21), "#.exr"), 40.1) == 10
    assert {index for index, _ in scheduler.asked} == {0, 10, 20} and (20, 2) not in scheduler.asked


def test_one_sample_is_the_least_and_is_told(caplog):
    scheduler = Clockwork(0.0, lambda index: 5.0)
    with caplog.at_level("INFO", logger="warp_gi"):
        assert samples_within(scheduler, shots_of(path(), [3], "#.exr"), 2.0) == 1
    assert "1 sample a pixel takes about 5 s a frame, more than the 2 s given" in caplog.text


@pytest.mark.parametrize("name", ["clean", "reuse"])
def test_a_trial_leaves_nothing_behind(name):
    frames = []
    for tries in (False, True):
        scheduler = gi.FrameScheduler(gi.builtin_scene("cornell_box"), path(), gi.Pipeline.preset(name, spp=2), seed=3)
        for index in range(2):
            if tries:
                trial = scheduler.trial(2, 1, 3, (12, 8))
                assert trial.settings.spp >= 3 and trial.camera.resolution == (12, 8)
            frames.append(scheduler.frame(index).numpy("beauty").copy())
        assert scheduler.metadata()["pipeline.spp"] == 2 and "frame_time" not in scheduler.metadata()
    np.testing.assert_array_equal(frames[:2], frames[2:])


def test_a_resumed_sequence_repeats_the_number(tmp_path, monkeypatch):
    """And has the pixels of one that was not stopped, though frames would be faster now."""
    scene, found = gi.builtin_scene("cornell_box"), [3]
    monkeypatch.setattr(frame_time, "samples_within", lambda scheduler, shots, seconds: found[-1])
    arguments = {"output": tmp_path / "a.####.exr", "frame_time": 0.3}
    whole = list(gi.render(scene, path(), frames=range(3), **arguments))
    assert all(f.metadata["pipeline.spp"] == 3 and f.metadata["frame_time"] == 0.3 for f in whole)
    (tmp_path / "a.0002.exr").unlink()
    found.append(7)
    plan = gi.plan_sequence(scene, path(), frames=range(3), **arguments)
    assert set(plan.problems) == {2}
    again = list(gi.render(scene, path(), frames=range(3), resume=True, **arguments))
    assert [f.index for f in again] == [0, 1, 2] or [f.index for f in again] == [2]
    np.testing.assert_array_equal(again[-1].numpy("beauty"), whole[-1].numpy("beauty"))
    larger = path().at_resolution(30, 20)  # another run, which takes nothing of this one
    assert next(gi.render(scene, larger, frames=range(3), resume=True, **arguments)).metadata["pipeline.spp"] == 7
    other = list(gi.render(scene, path(), frames=range(3), resume=True, **(arguments | {"frame_time": 0.5})))
    assert [f.metadata["pipeline.spp"] for f in other] == [7, 7, 7]


def test_camera_samples_are_no_more_than_samples():
    scheduler = gi.FrameScheduler(
        gi.builtin_scene("cornell_box"), path(), gi.Pipeline(spp=16, camera_samples=4), seed=3
    )
    assert scheduler.trial(1, 0, 1, (12, 8)).settings.camera_samples == 1
    assert samples_within(scheduler, shots_of(path(), [1], "#.exr"), 0.2) >= 1
    scheduler.take_samples(7)
    assert (scheduler.pipeline.spp, scheduler.pipeline.camera_samples) == (7, 4)


def test_seconds_are_read_with_their_units():
    assert [parse_seconds(text) for text in ("0.5s", "500ms", ".5", " 2 min ", "3")] == [0.5, 0.5, 0.5, 120.0, 3.0]
    for text in ("", "fast", "-1s", "1h", "0", "1e9", "1 s s", "nan", "9999999"):
        with pytest.raises(OptionError, match="a frame's time must be"):
            parse_seconds(text)
    for value in (0, -1.0, float("nan"), float("inf"), True, "1s", None):
        with pytest.raises(OptionError, match="a frame's time must be a number of seconds"):
            frame_time.check_seconds(value)


def test_the_command_says_what_it_took(tmp_path, capsys):
    command = ["render", "cornell_box", "--resolution=24x16", "--frames=0-1", "-o", f"{tmp_path}/a.####.exr"]
    assert cli.main([*command, "--frame-time=20ms"]) == 0
    said = capsys.readouterr().out
    spp = gi.read_frame(tmp_path / "a.0000.exr").metadata["pipeline.spp"]
    assert f"{spp} sample{'s' * (spp != 1)} a pixel, as fits into 0.02 s a frame" in said
    assert cli.main([*command, "--frame-time=soon"]) == 2
    assert "a frame's time must be seconds, as 0.5s, 500ms or 2min, got 'soon'" in capsys.readouterr().err
