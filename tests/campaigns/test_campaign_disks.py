"""A full disk at every write: one line that names file and reason, nothing half-written, and a run that goes on."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from campaign_tools import record, run, size_of

import warp_gi as gi

pytestmark = pytest.mark.slow
TINY = ["cornell_box", "--environment", "1", "--quiet", "--no-cache"]
RENDER = ["render", *TINY, "--resolution", "48x32", "--spp", "1", "--frames", "0-1"]
CLEAN = ["--indirect.ends-in.paths", "2000"]
COMMANDS = {
    "frames, previews and state": [*RENDER, "--preview", *CLEAN],
    "frames in bands": [*RENDER, "--preview", "--pipeline", "path", "--memory", "2e-4"],
    "bake": ["bake", *TINY, "--cell-size", "0.5"],
    "pictures and export of visibility-field": ["--cell-size", "0.5", "--export", "e.exr"],
    "pictures and export of light-field-probes": ["--counts", "2", "2", "2", "--resolution", "16", "--export", "e.exr"],
    "pictures and export of radiance-transfer": [
        *("--resolution", "64", "--rays", "16", "--first-rays", "8", "--export", "e.exr")
    ],
    "pictures and export of surface-cache": ["--paths", "20000", "--export", "e.exr"],
    "pictures and export of visibility-polygons": ["--resolution", "16", "--export", "e.bin"],
}


def arguments(what: str, folder: Path) -> list[str]:
    """Return a command that writes to a folder alone."""
    given = COMMANDS[what]
    if given[0] == "render":
        return [*given, "-o", str(folder / "a.####.exr")]
    if given[0] != "bake":
        technique = ["--technique", what.rsplit(" ", 1)[1], "--show", str(folder / "shown"), "--picture", "24x16"]
        given = ["bake", *TINY, *technique, *given[:-1], str(folder / given[-1])]
    return [*given, "-o", str(folder / "a.safetensors")]


@pytest.mark.parametrize("what", COMMANDS)
def test_files_that_cannot_grow(tmp_path, what):
    """A limit on the size of files (RLIMIT_FSIZE) that falls stands for a disk that fills at each write in turn."""
    from warp_gi.cli import main

    folder = tmp_path / "out"
    command = arguments(what, folder)
    assert main.main(command) == 0  # here: forks have its kernels
    sizes = sorted({path.stat().st_size for path in folder.rglob("*") if path.is_file()})
    # seconds that bakes name have more digits or fewer
    limits = sorted({0, 100, *(max(size - 100, 0) for size in sizes), *(size // 2 for size in sizes)})
    limits = limits[:: -(-len(limits) // size_of("disks", 40))]
    counts: Counter[str] = Counter()
    for most in limits:
        shutil.rmtree(folder)
        done = run(command, most_bytes=most)
        said = [line for line in done.said.splitlines() if "warning:" not in line]
        assert done.code == 1 and len(said) == 1 and str(folder) in said[0], (most, done.code, done.said)
        for path in (path for path in folder.rglob("*") if path.is_file()):
            assert not path.name.startswith(".") and path.suffix != ".part", path
            if path.suffix == ".exr" and command[0] == "render":
                gi.read_frame(path)
            if path.suffix == ".safetensors" and command[0] == "bake":
                gi.load_bake(path)
        counts["refused in one line"] += 1
        if command[0] == "render":
            assert run([*command, "--resume"]).code == 0
            counts["went on with --resume"] += 1
        folder.mkdir(exist_ok=True)
    record(f"full disk: {what}", len(limits), counts)


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="needs /dev/full")
def test_a_full_output(tmp_path):
    counts: Counter[str] = Counter()
    for command in (
        ["info", "cornell_box"],
        ["render", *TINY[:1], "--resolution", "8x8", "--spp", "1", "--frames", "0"],
    ):
        out = ["-o", str(tmp_path / "a.####.exr")] if command[0] == "render" else []
        with Path("/dev/full").open("w") as full:
            done = subprocess.run(
                [sys.executable, "-m", "warp_gi.cli", *command, *out], stdout=full, stderr=subprocess.PIPE, text=True
            )
        assert "Traceback" not in done.stderr and done.stderr.count("\n") <= 1, done.stderr
        counts[f"exit code {done.returncode}"] += 1
    record("full disk: standard output", 2, counts)
