"""Several processes that write to one folder: what is for one of them alone is refused to the other."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from PIL import Image

import warp_gi as gi
from warp_gi.cli import main as cli
from warp_gi.errors import OptionError
from warp_gi.sequence.lock import Claim
from warp_gi.sequence.preview import preview_exposure

fcntl = pytest.importorskip("fcntl")
TINY = ["cornell_box", "--resolution", "8x8", "--spp", "1", "--pipeline", "path"]
HOLD = """
import sys, time
from pathlib import Path
from warp_gi.sequence.lock import Claim
claim = Claim(Path(sys.argv[1]), range(int(sys.argv[2]), int(sys.argv[3])), sys.argv[4] == "whole")
claim.take()
print("taken", flush=True)
time.sleep(100)
"""


@pytest.fixture
def holder(tmp_path):
    """Return what starts a process that claims frames of a.####.exr."""
    running = []

    def start(first, last, kind="apart"):
        command = [sys.executable, "-c", HOLD, str(tmp_path / "a.####.exr"), str(first), str(last), kind]
        running.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        assert running[-1].stdout.readline() == "taken\n"
        return running[-1]

    yield start
    for process in running:
        process.kill()
        process.wait()


def hidden(folder):
    return sorted(path.name for path in folder.iterdir() if path.name.startswith("."))


def test_frames_that_another_process_writes_are_refused(tmp_path, capfd, holder):
    other = holder(2, 5)
    out = ["-o", str(tmp_path / "a.####.exr")]
    assert cli.main(["render", *TINY, "--frames", "0-3", *out]) == 2
    error = capfd.readouterr().err
    assert f"process {other.pid} on " in error and error.count("\n") == 1 and "has been writing to" in error
    assert not list(tmp_path.glob("*.exr"))
    assert cli.main(["render", *TINY, "--frames", "0-1,7", *out]) == 0  # others may be shared out
    assert len(list(tmp_path.glob("*.exr"))) == 3
    assert cli.main(["render", *TINY, "--frames", "2", "-o", str(tmp_path / "b.####.exr")]) == 0
    assert len(hidden(tmp_path)) == 1  # the other's claim


def test_frames_that_need_each_other_are_for_one_process(tmp_path, holder):
    """They share the file of the sequence's state."""
    holder(0, 2, "whole")
    with pytest.raises(OptionError, match="give another output or other frames"):
        Claim(tmp_path / "a.####.exr", [5, 6], True).take()
    claim = Claim(tmp_path / "a.####.exr", [5, 6], False)
    claim.take()
    claim.release()
    claim.release()


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_the_claim_of_a_dead_process_is_no_claim(tmp_path, holder, how):
    other = holder(0, 9)
    other.send_signal(how)
    other.wait()
    assert len(hidden(tmp_path)) == 1
    assert cli.main(["render", *TINY, "--frames", "0-1", "-o", str(tmp_path / "a.####.exr")]) == 0
    assert hidden(tmp_path) == []


def test_brackets_in_names_are_no_patterns(tmp_path):
    first, second = (Claim(tmp_path / "[x]a.####.exr", [0], False) for _ in range(2))
    first.take()
    with pytest.raises(OptionError, match="has been writing to"):
        second.take()
    first.release()
    second.take()
    second.release()


def test_files_that_are_no_claims_stop_nothing(tmp_path):
    (tmp_path / ".a.____.exr.0123.lock").write_text("")
    (tmp_path / ".a.____.exr.0124.claim").write_text("{")
    claim = Claim(tmp_path / "a.####.exr", [0], True)
    claim.take()
    assert json.loads(claim.path.read_text())["process"] == os.getpid()
    assert hidden(tmp_path) == sorted([".a.____.exr.0124.claim", claim.path.name])  # one may be in the making
    claim.release()


def race(folder, number, gate, found):
    gate.wait()
    claim = Claim(folder / "a.####.exr", [0, number], False)
    try:
        claim.take()
        found.put(number)
        time.sleep(1.0)
        claim.release()
    except OptionError:
        found.put(-1)


def test_of_many_at_one_time_one_writes(tmp_path):
    context = multiprocessing.get_context("fork")
    gate, found = context.Barrier(6), context.Queue()
    others = [context.Process(target=race, args=(tmp_path, number, gate, found)) for number in range(6)]
    for one in others:
        one.start()
    got = [found.get(timeout=60) for _ in others]
    for one in others:
        one.join()
    assert sum(number >= 0 for number in got) == 1 and hidden(tmp_path) == []


def test_a_generator_that_is_left_lets_go(tmp_path):
    scene, camera = gi.builtin_scene("cornell_box"), gi.Camera.look_at((0, 1, 3), (0, 1, 0), resolution=(8, 8))
    path = gi.CameraPath.from_cameras([camera] * 3)
    frames = gi.render(scene, path, gi.Pipeline(spp=1), output=tmp_path / "a.####.exr")
    next(frames)
    with pytest.raises(OptionError, match=f"process {os.getpid()} "):
        list(gi.render(scene, path, gi.Pipeline(spp=1), output=tmp_path / "a.####.exr"))
    frames.close()
    assert len(list(gi.render(scene, path, gi.Pipeline(spp=1), output=tmp_path / "a.####.exr"))) == 3


@pytest.mark.parametrize("kind", ["frame", "state"])
def test_what_is_left_of_an_ended_run_writes_over_nothing(tmp_path, kind):
    """A worker that nobody could stop, or a process whose lock another machine could not see."""
    scene, camera = gi.builtin_scene("cornell_box"), gi.Camera.look_at((0, 1, 3), (0, 1, 0), resolution=(8, 8))
    path = gi.CameraPath.from_cameras([camera] * 3)
    where = {"output": tmp_path / "a.####.exr"}
    denoise = {"frame": None, "state": "spatiotemporal"}[kind]
    frames = gi.render(scene, path, gi.Pipeline(spp=1, denoise=denoise), seed=1, **where)
    next(frames)
    (claim,) = hidden(tmp_path)
    (tmp_path / claim).unlink()  # as another machine does that takes it for a dead one's
    list(gi.render(scene, path, gi.Pipeline(spp=1, denoise=denoise), seed=2, **where))
    newer = {file: file.read_bytes() for file in tmp_path.iterdir()}
    with pytest.raises(OSError, match="the run that this frame is of has ended, or another one has taken its place"):
        next(frames)
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == newer


def test_workers_of_a_cluster_write_under_the_claim_of_who_asked(tmp_path):
    from warp_gi.cluster.engine import job_of
    from warp_gi.cluster.job import SceneAsItIs
    from warp_gi.cluster.worker import _Bench
    from warp_gi.scheduler import FrameScheduler
    from warp_gi.sequence.resume import Output, SequenceRun, shots_of

    camera = gi.Camera.look_at((0, 1, 3), (0, 1, 0), resolution=(8, 8))
    scheduler = FrameScheduler(gi.builtin_scene("cornell_box"), camera, gi.Pipeline(spp=1))
    output = Output(tmp_path / "a.####.exr")
    run = SequenceRun(scheduler, shots_of(camera, [0, 1], output.pattern), output)
    plan = run.plan(False)
    run.prepare(plan)
    bench = _Bench(job_of(run, plan, SceneAsItIs(scheduler.scene), (), None, False))
    assert bench.render(0) and (tmp_path / "a.0000.exr").exists()
    run.finish()
    with pytest.raises(OSError, match="has ended"):
        bench.render(1)
    assert [file.name for file in tmp_path.iterdir()] == ["a.0000.exr"]


def test_previews_follow_the_exposure(tmp_path):
    """Those of kept frames are made again where their exposure is another one, and left alone where it is not."""
    command = ["render", *TINY, "--frames", "0-1", "-o", str(tmp_path / "a.####.exr"), "--preview"]
    assert cli.main(command) == 0
    first = tmp_path / "a.0000.png"
    dark, written = np.asarray(Image.open(first)).astype(int), first.stat().st_mtime_ns
    assert cli.main([*command, "--resume"]) == 0
    assert first.stat().st_mtime_ns == written and preview_exposure(first) == 0.0
    assert cli.main([*command, "--resume", "--exposure", "2"]) == 0
    assert np.asarray(Image.open(first)).sum() > 1.2 * dark.sum() and preview_exposure(first) == 2.0
    (tmp_path / "a.0001.png").write_bytes(b"torn")
    assert cli.main([*command, "--resume"]) == 0
    np.testing.assert_array_equal(np.asarray(Image.open(first)), dark)
    assert Image.open(tmp_path / "a.0001.png").size == (8, 8)
