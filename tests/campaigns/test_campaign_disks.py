"""A full disk at every write: one line that names file and reason, nothing half-written, and a run that goes on."""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest
from campaign_tools import record, size_of

import warp_gi as gi

pytestmark = pytest.mark.slow
LIMITED = """
import resource, signal, sys
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
from warp_gi.cli import main
import warp_gi.cli.render, warp_gi.cli.bake
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]), int(sys.argv[1])))
sys.exit(main.main(sys.argv[2:]))
"""
TINY = ["cornell_box", "--environment", "1", "--quiet", "--no-cache"]
COMMANDS = {
    "frames, previews and state": [
        "render",
        *TINY,
        "--resolution",
        "48x32",
        "--spp",
        "1",
        "--frames",
        "0-1",
        "--preview",
    ],
    "bake": ["bake", *TINY, "--cell-size", "0.5"],
    "bake, pictures and export": ["bake", *TINY, "--technique", "light-field-probes", "--counts", "2", "2", "2"],
}


def limited(most: int, arguments: list[str]) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", LIMITED, str(most), *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=600)


@pytest.mark.parametrize("what", COMMANDS)
def test_files_that_cannot_grow(tmp_path, what):
    """A limit on the size of files (RLIMIT_FSIZE) that falls stands for a disk that fills at each write in turn."""
    is_render = COMMANDS[what][0] == "render"
    out = ["-o", str(tmp_path / ("a.####.exr" if is_render else "a.safetensors"))]
    if "export" in what:
        out += ["--export", str(tmp_path / "e.exr")]
    whole = limited(1 << 30, [*COMMANDS[what], *out])
    assert whole.returncode == 0, whole.stderr
    files = sorted(path for path in tmp_path.iterdir())
    sizes = sorted({path.stat().st_size for path in files})
    limits = sorted({0, 100, *(size - 1 for size in sizes), *(size // 2 for size in sizes)})[: size_of("disks", 40)]
    counts: Counter[str] = Counter()
    for most in limits:
        for path in tmp_path.iterdir():
            path.unlink()
        done = limited(most, [*COMMANDS[what], *out])
        assert done.returncode == 1, (most, done.stderr)
        assert done.stderr.count("\n") == 1 and str(tmp_path) in done.stderr, (most, done.stderr)
        for path in tmp_path.iterdir():
            assert path.suffix in (".exr", ".png", ".safetensors", ".json"), path
            if path.suffix == ".exr" and is_render:
                gi.read_frame(path)
        counts["refused in one line"] += 1
        if is_render:
            assert limited(1 << 30, [*COMMANDS[what], *out, "--resume"]).returncode == 0
            counts["went on with --resume"] += 1
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
