"""Renders and bakes that are killed at random moments, then resumed: equal to unbroken ones, bit for bit."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from campaign_tools import record, size_of

import warp_gi as gi
from warp_gi.pipeline import Pipeline

pytestmark = pytest.mark.slow
FRAMES, SIZE = 4, "24x16"
PRESETS = ("path", "direct", "dvf", "probes", "reuse", "hybrid", "transfer", "cache", "polygons", "clean")
SCENES = {"still": "cornell_box", "moving": "warehouse"}
FASTER = {
    "dvf": ["--environment.cell-size", "1", "--environment.samples", "64"],
    "probes": ["--indirect.counts", "2", "2", "2", "--indirect.resolution", "16", "--indirect.rays", "2"],
    "transfer": ["--environment.resolution", "64", "--environment.rays", "8"],
}


def render(folder: Path, preset: str, scene: str, *more: str) -> list[str]:
    out = ["-o", str(folder / "a.####.exr"), "--precision", "float", "--quiet", "--no-cache"]
    command = [sys.executable, "-m", "warp_gi.cli", "render", SCENES[scene], "--environment", "1", "--resolution", SIZE]
    return [*command, "--spp", "1", "--frames", f"0-{FRAMES - 1}", "--pipeline", preset, *out, *more]


def pictures(folder: Path) -> list[dict[str, np.ndarray]]:
    return [gi.read_frame(folder / f"a.{index:04d}.exr").buffers for index in range(FRAMES)]


def test_killed_renders_go_on_to_the_same_bits(tmp_path):
    assert set(PRESETS) | {"probe_view"} == set(Pipeline.presets())
    kills, chance = size_of("kills", 20), random.Random(size_of("seed", 1))
    wholes: dict[tuple[str, str], tuple[list[dict[str, np.ndarray]], float]] = {}
    counts: Counter[str] = Counter()
    bad: list[str] = []
    cases = [(preset, scene) for scene in SCENES for preset in PRESETS]
    chance.shuffle(cases)
    for number in range(kills):
        preset, scene = cases[number % len(cases)]
        if (preset, scene) not in wholes:
            folder = tmp_path / f"{preset} {scene}"
            subprocess.run(render(folder, preset, scene), check=True, timeout=600, capture_output=True)
            started = time.perf_counter()  # again, with compiled kernels
            subprocess.run(render(tmp_path / "timed", preset, scene), check=True, timeout=600, capture_output=True)
            wholes[preset, scene] = pictures(folder), time.perf_counter() - started
        whole, seconds = wholes[preset, scene]
        folder = tmp_path / str(number)
        for _ in range(chance.choice([1, 1, 2])):
            process = subprocess.Popen(render(folder, preset, scene, "--resume"), stderr=subprocess.DEVNULL)
            try:
                process.wait(timeout=seconds * chance.uniform(0.3, 1.0))
                counts["ended before the kill"] += 1
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                counts["killed"] += 1
        done = subprocess.run(render(folder, preset, scene, "--resume"), capture_output=True, text=True, timeout=600)
        same = done.returncode == 0 and all(
            one.keys() == other.keys() and all(np.array_equal(one[name], other[name], equal_nan=True) for name in one)
            for one, other in zip(pictures(folder), whole, strict=True)
        )
        left = [path.name for path in folder.iterdir() if path.name.startswith(".") or path.suffix == ".part"]
        counts["resumed to the same bits" if same else "different"] += 1
        if not same or left:
            bad.append(f"{preset} {scene} {number}: {done.returncode} {done.stderr[-200:]} left: {left}")
    record(
        "kills of renders, then --resume", kills, counts, f"{len(wholes)} pipelines and scenes, {FRAMES} frames each"
    )
    assert not bad, "\n".join(bad)


def test_killed_bakes_leave_no_half_file(tmp_path):
    kills, chance = size_of("bake_kills", 6), random.Random(size_of("seed", 1))
    target = tmp_path / "a.safetensors"
    command = [
        sys.executable,
        "-m",
        "warp_gi.cli",
        "bake",
        "cornell_box",
        "--cell-size",
        "0.2",
        "--no-cache",
        "--quiet",
    ]
    started = time.perf_counter()
    subprocess.run([*command, "-o", str(tmp_path / "whole.safetensors")], check=True, timeout=600)
    seconds, counts = time.perf_counter() - started, Counter()
    for _ in range(kills):
        process = subprocess.Popen([*command, "-o", str(target)])
        try:
            process.wait(timeout=seconds * chance.uniform(0.5, 1.1))
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        counts["whole" if target.exists() else "nothing"] += 1
        if target.exists():
            assert gi.load_bake(target).digest == gi.load_bake(tmp_path / "whole.safetensors").digest
            target.unlink()
    subprocess.run([*command, "-o", str(target)], check=True, timeout=600)
    assert sorted(os.listdir(tmp_path)) == ["a.safetensors", "whole.safetensors"]
    record("kills of bakes", kills, counts)


def test_two_processes_on_one_folder(tmp_path):
    """One writes and the other is refused in one line, or comes after; what is there is whole either way."""
    counts: Counter[str] = Counter()
    rounds = size_of("pairs", 4)
    for number in range(rounds):
        folder = tmp_path / str(number)
        pair = [
            subprocess.Popen(render(folder, "clean", "still", "--resume"), stderr=subprocess.PIPE, text=True)
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
