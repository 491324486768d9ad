"""Renders and bakes that are killed at random moments, then resumed: equal to unbroken ones, bit for bit."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from campaign_tools import Command, record, run, size_of

import warp_gi as gi
from warp_gi.pipeline import Pipeline

pytestmark = pytest.mark.slow
FRAMES, SIZE = 4, "24x16"
PRESETS = ("path", "direct", "dvf", "probes", "reuse", "hybrid", "transfer", "cache", "polygons", "clean")
CLI = [sys.executable, "-m", "warp_gi.cli"]
SCENES = {"still": "cornell_box", "moving": "warehouse"}
FASTER = {
    "dvf": ["--environment.cell-size", "1", "--environment.samples", "64"],
    "probes": ["--indirect.counts", "2", "2", "2", "--indirect.resolution", "16", "--indirect.rays", "2"],
    "transfer": ["--environment.storage", "vertices", "--environment.rays", "16", "--environment.first-rays", "8"],
    "clean": ["--indirect.ends-in.paths", "2000"],
    "cache": ["--indirect.ends-in.paths", "2000"],
    "hybrid": ["--environment.cell-size", "1", "--environment.samples", "64"],
}
BAKES = {
    "visibility-field": ["--cell-size", "0.3"],
    "light-field-probes": ["--counts", "2", "2", "2", "--resolution", "16", "--rays", "16"],
    "radiance-transfer": ["--resolution", "64", "--rays", "16", "--first-rays", "8"],
    "surface-cache": ["--paths", "20000"],
    "visibility-polygons": ["--resolution", "16"],
}


def render(folder: Path, preset: str, scene: str, *more: str) -> list[str]:
    """Return the arguments of a render of four small frames under a white sky."""
    out = ["-o", str(folder / "a.####.exr"), "--precision", "float", "--quiet", "--threads", "2"]
    sky = ["--environment", "1", "--resolution", SIZE]
    command = ["render", SCENES[scene], *sky, "--spp", "1", "--frames", f"0-{FRAMES - 1}", "--pipeline", preset]
    return [*command, *FASTER.get(preset, []), *out, *more]


def pictures(folder: Path) -> list[dict[str, np.ndarray]]:
    return [gi.read_frame(folder / f"a.{index:04d}.exr").buffers for index in range(FRAMES)]


def are_same(one: list[dict[str, np.ndarray]], other: list[dict[str, np.ndarray]]) -> bool:
    return all(
        a.keys() == b.keys() and all(np.array_equal(a[name], b[name], equal_nan=True) for name in a)
        for a, b in zip(one, other, strict=True)
    )


class Case:
    """A preset and a scene: pictures of an unbroken run, and the seconds that one takes."""

    def __init__(self, folder: Path, preset: str, scene: str) -> None:
        from warp_gi.cli import main

        assert main.main(render(folder / "whole", preset, scene, "--no-cache")) == 0  # here: forks have its kernels
        self.whole = pictures(folder / "whole")
        started = time.perf_counter()
        timed = run(render(folder / "timed", preset, scene, "--no-cache"))
        self.seconds = time.perf_counter() - started
        assert timed.code == 0 and are_same(pictures(folder / "timed"), self.whole), (preset, scene, timed.said)


@pytest.mark.parametrize("scene", SCENES)
def test_killed_renders_go_on_to_the_same_bits(tmp_path, scene):
    """Each sequence is killed once to three times, anywhere from its start to its end, and then goes on to its end."""
    assert set(PRESETS) | {"probe_view"} == set(Pipeline.presets())
    wanted, chance = size_of("kills", 20) // len(SCENES), random.Random(f"{size_of('seed', 1)} {scene}")
    presets = chance.sample(PRESETS, len(PRESETS))
    cases: dict[str, Case] = {}
    counts: Counter[str] = Counter({"killed": 0, "frames": 0, "frames that differ": 0, "other faults": 0})
    bad: list[str] = []
    number = 0
    while counts["killed"] < wanted:
        preset = presets[number % len(presets)]
        number += 1
        if preset not in cases:
            cases[preset] = Case(tmp_path / preset, preset, scene)
        case, folder, kept = cases[preset], tmp_path / str(number), tmp_path / f"bakes {number}"
        cache = ("--cache", kept) if chance.random() < 0.5 else ("--no-cache", None)
        for _ in range(chance.choice([1, 1, 2, 3])):
            command = Command(render(folder, preset, scene, "--resume", cache[0]), bakes=cache[1])
            if command.wait(case.seconds * chance.uniform(0.05, 1.1)) is None:
                command.kill()
            counts["killed" if command.code == -signal.SIGKILL else "ended before the kill"] += 1
        done = run(render(folder, preset, scene, "--resume", cache[0]), bakes=cache[1])
        left = sorted(path.name for path in folder.iterdir() if path.name.startswith(".") or path.suffix == ".part")
        parts = sorted(path.name for path in kept.rglob("*.part"))
        if done.code != 0 or left or parts or done.said:
            counts["other faults"] += 1
            bad.append(f"{preset} {number}: exit code {done.code} {done.said[-300:]} left: {left} {parts}")
        if done.code == 0:
            same = [are_same([a], [b]) for a, b in zip(pictures(folder), case.whole, strict=True)]
            counts["frames"] += FRAMES
            counts["frames that differ"] += same.count(False)
            if not all(same):
                bad.append(f"{preset} {number}: of its frames are the same: {same}")
        shutil.rmtree(folder)
        shutil.rmtree(kept, ignore_errors=True)
    note = f"{number} sequences of {FRAMES} frames, {len(cases)} presets"
    record(f"kills of renders, {scene} scene, then --resume", counts["killed"], counts, note)
    assert not bad, "\n".join(bad)


def test_killed_bakes_leave_no_half_file(tmp_path):
    from warp_gi.cli import main

    wanted, chance, counts = size_of("bake_kills", 10), random.Random(size_of("seed", 1)), Counter({"half files": 0})
    for place, (technique, settings) in enumerate(BAKES.items()):
        folder = tmp_path / technique
        target, whole = folder / "a.safetensors", tmp_path / f"{technique}.safetensors"
        command = ["bake", "cornell_box", "--environment", "1", "--technique", technique, *settings, "--quiet"]
        assert main.main([*command, "--no-cache", "-o", str(whole)]) == 0
        started = time.perf_counter()
        assert run([*command, "--no-cache", "-o", str(whole)]).code == 0
        seconds, digest = time.perf_counter() - started, gi.load_bake(whole).digest
        for number in range(wanted * (place + 1) // len(BAKES) - wanted * place // len(BAKES)):
            kept = tmp_path / f"{technique} bakes"
            cache = ("--cache", kept) if number % 2 else ("--no-cache", None)
            process = Command([*command, cache[0], "-o", str(target)], bakes=cache[1])
            if process.wait(seconds * chance.uniform(0.3, 1.2)) is None:
                process.kill()
            counts["killed" if process.code == -signal.SIGKILL else "ended before the kill"] += 1
            counts["file whole" if target.exists() else "no file"] += 1
            if target.exists():
                assert gi.load_bake(target).digest == digest
                target.unlink()
            shutil.rmtree(kept, ignore_errors=True) if chance.random() < 0.3 else None
        done = run([*command, "--cache", "-o", str(target)], bakes=tmp_path / f"{technique} bakes")
        assert done.code == 0 and gi.load_bake(target).digest == digest, done.said
        assert os.listdir(folder) == [target.name]
    record("kills of bakes", wanted, counts, f"{len(BAKES)} techniques")


def test_two_processes_on_one_folder(tmp_path):
    """One writes and the other is refused in one line, or comes after; what is there is whole either way."""
    counts: Counter[str] = Counter()
    rounds = size_of("pairs", 4)
    for number in range(rounds):
        folder = tmp_path / str(number)
        pair = [
            subprocess.Popen([*CLI, *render(folder, "clean", "still", "--resume")], stderr=subprocess.PIPE, text=True)
            for _ in range(2)
        ]
        told = [process.communicate(timeout=600)[1] for process in pair]
        for process, line in zip(pair, told, strict=True):
            counts["wrote or found all" if process.returncode == 0 else "refused in one line"] += 1
            assert process.returncode in (0, 2) and line.count("\n") == (process.returncode == 2), line
        assert any(process.returncode == 0 for process in pair)
        assert len(pictures(folder)) == FRAMES
    record("pairs of processes on one folder", rounds, counts)


def test_memory_is_flat_over_many_frames():
    frames = size_of("frames", 500)
    code = f"""
import resource, warp_gi as gi
scene = gi.builtin_scene("cornell_box"); scene.environment = 1.0
path = gi.builtin_camera_path("cornell_box").at_resolution(32, 24)
used = []
for frame in gi.render(scene, path, gi.Pipeline.preset("clean", spp=1), frames=range({frames})):
    used.append(int(open("/proc/self/statm").read().split()[1]) * resource.getpagesize())
    del frame
third = len(used) // 3
print((max(used[-third:]) - max(used[third : 2 * third])) / third)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=1800)
    grown = float(done.stdout.split()[-1])
    record("frames in one process", frames, Counter({"bytes a frame, last third": round(grown)}))
    assert grown < 4096
