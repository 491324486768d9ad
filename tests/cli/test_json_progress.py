"""Progress for programs, and the pace that is told to people."""

from __future__ import annotations

import json

import pytest

from warp_gi.cli import main as cli
from warp_gi.cli.json_progress import JsonReporter
from warp_gi.cli.report import Reporter
from warp_gi.sequence.frames import read_frame


def test_every_frame_is_a_line_of_json(tmp_path, capsys):
    command = ["render", "cornell_box", "--resolution=8x8", "--spp=1", "--pipeline=path", "--frames=3-5"]
    assert cli.main([*command, "--json-progress", "--verbose", "-o", str(tmp_path / "a.####.exr")]) == 0
    told = capsys.readouterr()
    *frames, end = [json.loads(line) for line in told.out.splitlines()]
    assert [line["event"] for line in frames] == ["frame"] * 3 and end["event"] == "end"
    assert [line["frame"] for line in frames] == [3, 4, 5] and [line["done"] for line in frames] == [1, 2, 3]
    assert all(read_frame(line["file"]).index == line["frame"] for line in frames)
    assert {line["total"] for line in frames} == {3} and frames[-1]["seconds_left"] == 0.0
    assert (end["done"], end["total"]) == (3, 3) and end["seconds"] > 0
    assert "cornell_box: " in told.err and "3 frames in" in told.err
    assert cli.main([*command, "--json-progress", "--quiet", "-o", str(tmp_path / "a.####.exr"), "--resume"]) == 0
    told = capsys.readouterr()
    assert json.loads(told.out)["done"] == 0 and told.err == ""


@pytest.mark.parametrize(("at_once", "rate", "left"), [(1, 30.0, 12.0), (4, 120.0, 3.0)])
def test_the_pace_is_that_of_the_last_frames(at_once, rate, left, capsys, monkeypatch):
    """Frames of 2 s: 30 a minute; four workers do four times as many."""
    monkeypatch.setattr("time.perf_counter", lambda: 0.0)
    report = Reporter(terminal=False)
    with report.bar(18):
        report.at_once = at_once
        for index in range(12):
            report.frame(f"frame {index}", 100.0 if index < 4 else 2.0)
        assert report.frames_per_minute == rate and report.time_left() == left
    assert f"[12/18] frame 11, {rate:g} frames a minute, {left:g} s left" in capsys.readouterr().out


def test_json_of_a_worker(capsys):
    report = JsonReporter(quiet=True)
    with report.bar(2):
        report.frame("a", 0.5, 7, None, worker="tcp://10.0.0.1:1")
    line = json.loads(capsys.readouterr().out.splitlines()[0])
    assert line["worker"] == "tcp://10.0.0.1:1" and line["file"] is None and line["frames_per_minute"] == 120.0
