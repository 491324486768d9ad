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
import trimesh
from campaign_tools import Command, record, run, size_of
from deforming_tools import animate
from scene_tools import GlbBuilder

import warp_gi as gi
from warp_gi.pipeline import Pipeline

pytestmark = pytest.mark.slow
FRAMES, SIZE = 4, "24x16"
PRESETS = ("path", "direct", "dvf", "probes", "reuse", "hybrid", "transfer", "cache", "polygons", "clean")
CLI = [sys.executable, "-m", "warp_gi.cli"]
SCENES = ("still", "moving")
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


@pytest.fixture(scope="module")
def moving_scene(tmp_path_factory) -> Path:
    """A room with a lamp, in which a crate moves and turns from frame to frame."""
    glb = GlbBuilder()
    paints = [
        glb.add("materials", {"pbrMetallicRoughness": {"baseColorFactor": [*color, 1], "metallicFactor": 0}})
        for color in ((0.7, 0.7, 0.7), (0.6, 0.2, 0.1))
    ]
    lamp = glb.add("materials", {"emissiveFactor": [1, 1, 1], "pbrMetallicRoughness": {"metallicFactor": 0}})
    boxes = {
        "floor": ((3, 0.1, 3), (0, -0.05, 0), paints[0]),
        "wall": ((3, 2, 0.1), (0, 1, -1.5), paints[1]),
        "side": ((0.1, 2, 3), (-1.5, 1, 0), paints[0]),
        "lamp": ((0.8, 0.05, 0.8), (0, 2, 0), lamp),
        "crate": ((0.5, 0.5, 0.5), (0, 0.25, 0), paints[1]),
    }
    for name, (size, place, paint) in boxes.items():
        box = trimesh.creation.box(size)
        arrays = {"POSITION": glb.accessor(box.vertices)}, glb.accessor(box.faces.ravel(), np.uint16)
        primitive = {"attributes": arrays[0], "indices": arrays[1], "material": paint}
        glb.add("nodes", {"name": name, "mesh": glb.add("meshes", {"primitives": [primitive]}), "translation": place})
    last = FRAMES / 24
    animate(glb, 4, "translation", [0, last], [[-0.6, 0.25, 0], [0.6, 0.25, 0.3]])
    animate(glb, 4, "rotation", [0, last], [[0, 0, 0, 1], [0, 0.6, 0, 0.8]])
    glb.json["scenes"] = [{"nodes": [0, 1, 2, 3, 4]}]
    return glb.write(tmp_path_factory.mktemp("scene") / "room.glb")


def render(folder: Path, preset: str, scene: Path | None, *more: str) -> list[str]:
    """Return the arguments of a render of four small frames under a white sky, of the Cornell box or a file."""
    out = ["-o", str(folder / "a.####.exr"), "--precision", "float", "--quiet", "--threads", "2"]
    sky = ["--environment", "1", "--resolution", SIZE]
    what = ["cornell_box"] if scene is None else [str(scene), "--eye", "0", "1", "4", "--target", "0", "0.7", "0"]
    command = ["render", *what, *sky, "--spp", "1", "--frames", f"0-{FRAMES - 1}", "--pipeline", preset]
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

    def __init__(self, folder: Path, preset: str, scene: Path | None) -> None:
        from warp_gi.cli import main

        assert main.main(render(folder / "whole", preset, scene, "--no-cache")) == 0  # here: forks have its kernels
        self.whole = pictures(folder / "whole")
        started = time.perf_counter()
        timed = run(render(folder / "timed", preset, scene, "--no-cache"))
        self.seconds = time.perf_counter() - started
        assert timed.code == 0 and are_same(pictures(folder / "timed"), self.whole), (preset, scene, timed.said)


@pytest.mark.parametrize("kind", SCENES)
def test_killed_renders_go_on_to_the_same_bits(tmp_path, kind, moving_scene):
    """Each sequence is killed once to three times, anywhere from its start to its end, and then goes on to its end."""
    scene = moving_scene if kind == "moving" else None
    assert set(PRESETS) | {"probe_view"} == set(Pipeline.presets())
    wanted, chance = size_of("kills", 20) // len(SCENES), random.Random(f"{size_of('seed', 1)} {kind}")
    fit = [preset for preset in PRESETS if scene is None or preset != "polygons"]  # which is of scenes at rest
    presets = chance.sample(fit, len(fit))
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
        said = [line for line in done.said.splitlines() if "warning:" not in line]
        if done.code != 0 or left or parts or said:
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
    record(f"kills of renders, {kind} scene, then --resume", counts["killed"], counts, note)
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
            subprocess.Popen([*CLI, *render(folder, "clean", None, "--resume")], stderr=subprocess.PIPE, text=True)
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
