"""Sequences rendered by the workers of a Dask scheduler: equal to one process, whoever is killed."""

from __future__ import annotations

import asyncio
import json
import logging
import random
import re
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import pytest
import trimesh

import warp_gi as gi
from warp_gi.cli import main as cli
from warp_gi.errors import OptionError
from warp_gi.sequence import frames as sequence

pytest.importorskip("distributed")
from cluster_tools import workers

from warp_gi.cli import cluster
from warp_gi.cluster import engine
from warp_gi.cluster.identity import Identity
from warp_gi.cluster.worker import admit

SIZE = (64, 36)
PIPELINES = {
    "path": gi.Pipeline.preset("path", spp=2),
    "denoised": gi.Pipeline.preset("path", spp=2, denoise="spatiotemporal"),
}


def render(output, name, count, **more):
    scene = gi.builtin_scene("cornell_box")
    path = gi.builtin_camera_path("cornell_box").at_resolution(*SIZE)
    return gi.render(scene, path, PIPELINES[name], range(count), seed=3, output=output / "a.####.exr", **more)


def assert_same(folder, wanted, count):
    for index in range(count):
        a, b = (sequence.read_frame(one / f"a.{index:04d}.exr") for one in (folder, wanted))
        assert a.names == b.names and a.metadata == b.metadata
        assert [name for name in a.names if a.numpy(name).tobytes() != b.numpy(name).tobytes()] == [], index


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """A scheduler with two workers."""
    with workers(tmp_path_factory.mktemp("dask"), 2) as running:
        yield running


def test_frames_of_two_workers_are_those_of_one_process(two, tmp_path, capsys):
    """Independent ones in any order, dependent ones as a chain; from Python and by the command."""
    for name, folder in (("path", tmp_path / "p"), ("denoised", tmp_path / "d")):
        whole = tmp_path / f"{name}-whole"
        assert [frame.index for frame in render(whole, name, 3)] == [0, 1, 2]
        assert [frame.index for frame in render(folder, name, 3, cluster=two.address)] == [0, 1, 2]
        assert_same(folder, whole, 3)
        assert list(render(folder, name, 3, cluster=two.address, resume=True)) == []
        assert list(render(folder, name, 3, resume=True)) == [] and not list(folder.glob(".*"))
    command = ["render", "cornell_box", "--resolution=64x36", "--spp=2", "--pipeline=path", "--seed=3", "--frames=0-2"]
    command += ["--cluster", two.address, "--json-progress", "-o", str(tmp_path / "c" / "a.####.exr")]
    capsys.readouterr()  # lines that a command of an earlier test has asked for
    assert cli.main(command) == 0
    told = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert sorted(line["frame"] for line in told[:3]) == [0, 1, 2] and told[3]["event"] == "end"
    assert all(line["worker"].startswith("tcp://") for line in told[:3])
    assert_same(tmp_path / "c", tmp_path / "path-whole", 3)


def test_what_is_not_resumed_is_rendered_anew(two, tmp_path):
    list(render(tmp_path, "path", 2))
    before = [(tmp_path / f"a.{index:04d}.exr").stat().st_mtime_ns for index in range(2)]
    list(render(tmp_path, "path", 2, cluster=two.address))
    after = [(tmp_path / f"a.{index:04d}.exr").stat().st_mtime_ns for index in range(2)]
    assert after[0] > before[0] and after[1] > before[1]


def test_a_scene_that_differs_on_a_worker_is_named(two, tmp_path, capsys, monkeypatch):
    """A file that changed after the command read it: here another one at the time of the worker's reading."""
    path = tmp_path / "box.obj"
    path.write_text(trimesh.creation.box().export(file_type="obj"))
    opened = cluster.job_of

    def job_of(*arguments):
        path.write_text(trimesh.creation.box((1, 1, 2)).export(file_type="obj"))
        return opened(*arguments)

    monkeypatch.setattr(cluster, "job_of", job_of)
    command = ["render", str(path), "--environment=1", "--resolution=8x8", "--spp=1", "--pipeline=path"]
    assert cli.main([*command, "--cluster", two.address, "-o", str(tmp_path / "a.####.exr")]) == 2
    told = capsys.readouterr().err
    assert told.startswith("warp-gi: error: frame 0 failed on worker tcp://") and told.count("\n") == 1
    assert "the scene is not the same: its hash is" in told and not list(tmp_path.glob("*.exr"))


def test_another_version_is_refused_by_name(two, caplog):
    """By whoever hands frames out, who says so, and by the worker itself, which takes none."""
    caplog.set_level(logging.INFO, "warp_gi")
    other = replace(Identity.mine(), warp="9.9.9", processor="abacus")
    with engine.connected(two.address) as client:
        one = engine.Cluster(client, SimpleNamespace(identity=other, depends=False))
        one.look()
        right = engine.Cluster(client, SimpleNamespace(identity=Identity.mine(), depends=False))
        right.look()
        assert len(right.workers) == 2 and right.most_at_once == 4
    told = [record.getMessage() for record in caplog.records]
    assert not one.workers and len(told) == 3
    for line in told[:2]:
        assert re.match(
            r"worker tcp://\S+ is not used: it has warp \S+ instead of 9.9.9, processor \S+ instead of ", line
        )
    assert told[2].startswith("no worker that can render is there; waiting for one (dask worker tcp://")
    given = []

    async def set_resources(**resources):
        given.append(resources)

    asyncio.run(admit(Identity.mine().resource, SimpleNamespace(set_resources=set_resources)))
    assert given == [{Identity.mine().resource: 1.0}] and other.resource != Identity.mine().resource


@pytest.mark.parametrize(
    ("cluster", "words"),
    [
        (7, "a cluster must be a dask.distributed.Client or the address of one, got 7"),
        ("tcp://127.0.0.1:1", "no Dask scheduler answers at tcp://127.0.0.1:1"),
        ("wasp://x", "is no address as tcp://10.0.0.1:8786"),
    ],
)
def test_what_is_no_cluster_is_one_line(cluster, words, tmp_path, monkeypatch):
    monkeypatch.setattr("warp_gi.cluster.engine.ANSWER_SECONDS", 0.5)
    with pytest.raises((OptionError, OSError)) as error:
        list(render(tmp_path, "path", 1, cluster=cluster))
    assert words in str(error.value) and "\n" not in str(error.value)
    with pytest.raises(OptionError, match="leave chunk, frame_time and skip out"):
        list(render(tmp_path, "path", 1, cluster=cluster, chunk=(1, 2)))
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.parametrize("name", PIPELINES)
def test_killed_workers_lose_nothing(name, tmp_path):
    """Ten are killed at random moments, and others started; no frame is lost, nor written twice."""
    count, rng, seen = 40, random.Random(name), {}
    scene, path = gi.builtin_scene("cornell_box"), gi.builtin_camera_path("cornell_box").at_resolution(160, 90)
    arguments = {"frames": range(count), "seed": 3}
    list(gi.render(scene, path, PIPELINES[name], output=tmp_path / "one" / "a.####.exr", **arguments))
    (tmp_path / "logs").mkdir()
    killed = []
    with workers(tmp_path / "logs", 3) as running:
        ended = threading.Event()

        def kill_at_random():
            for _ in range(10):
                if ended.wait(rng.uniform(1.0, 4.0)):
                    return
                running.kill(rng.randrange(len(running.processes)))
                killed.append(time.monotonic())
                running.start()

        def look():
            while not ended.wait(0.01):
                for file in (tmp_path / "many").glob("*.exr"):
                    seen.setdefault(file.name, file.stat().st_mtime_ns)

        threads = [threading.Thread(target=one) for one in (kill_at_random, look)]
        for thread in threads:
            thread.start()
        try:
            output = tmp_path / "many" / "a.####.exr"
            frames = gi.render(scene, path, PIPELINES[name], output=output, cluster=running.address, **arguments)
            assert [frame.index for frame in frames] == list(range(count))
        finally:
            ended.set()
            for thread in threads:
                thread.join()
    assert killed
    assert_same(tmp_path / "many", tmp_path / "one", count)
    assert {file.name: file.stat().st_mtime_ns for file in (tmp_path / "many").glob("*.exr")} == seen


@pytest.mark.slow
def test_a_scheduler_that_goes_away_is_one_line(tmp_path):
    """What was finished is kept, and a second run elsewhere goes on."""
    (tmp_path / "logs").mkdir()
    with workers(tmp_path / "logs", 1) as running:
        frames = render(tmp_path, "denoised", 400, cluster=running.address)
        assert next(frames).index == 0
        running.scheduler.kill()
        with pytest.raises(OSError, match="the Dask scheduler has gone; finished frames are kept") as error:
            list(frames)
        assert "\n" not in str(error.value)
    there = len(list(tmp_path.glob("*.exr")))
    assert 0 < there < 400
    assert [frame.index for frame in render(tmp_path, "denoised", there + 2, resume=True)][-1] == there + 1
    assert list(render(tmp_path, "denoised", there + 2, resume=True)) == []
