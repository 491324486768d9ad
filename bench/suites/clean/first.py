"""The README's first command in a process of its own: seconds to the first frame and to all, cold and warm, memory."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from warp_gi import launch
from warp_gi.bench.harness.measure import Row

FIRST = "first command"
COMMAND = ("--pipeline", "clean")
QUICK_COMMAND = ("cornell_box", *COMMAND, "--frames", "0-3", "--resolution", "64x36")
COLD, WARM = "cold", "warm"
"""Whether kernels are compiled and caches filled anew, or kept from the run before."""
MOST = {COLD: 60.0, WARM: 45.0}
"""Wall seconds of all frames at most, on two idle cores."""
MOST_FIRST = {COLD: 10.0, WARM: 2.0}
"""Wall seconds to the first frame at most."""
_POLL = 0.02


def first_rows(quick: bool, device: str) -> list[Row]:
    """Return a row of a cold and of a warm run; ``quick`` runs a small one, with whatever kernels are there."""
    if quick:
        return [_row(WARM, timed_run([*QUICK_COMMAND, "--device", device], {}))]
    with tempfile.TemporaryDirectory() as kept:
        places = {"WARP_CACHE_PATH": f"{kept}/kernels", "XDG_CACHE_HOME": f"{kept}/caches"}
        places["WARP_GI_BAKES"] = f"{kept}/bakes"
        return [_row(state, timed_run([*COMMAND, "--device", device], places)) for state in (COLD, WARM)]


def timed_run(arguments: Sequence[str], variables: dict[str, str]) -> Row:
    """Return what `warp-gi render` with these arguments took, or that it failed and its last line.

    Seconds are the wall's, from the command on: until the first file is there, and to the end.
    """
    environment = {**os.environ, "WARP_GI_THREADS": str(launch.thread_count()), **variables}
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile() as said:
        command = [sys.executable, "-m", "warp_gi.cli", "render", *arguments, "-o", f"{folder}/f.####.exr"]
        started, first = time.perf_counter(), 0.0
        process = subprocess.Popen(command, env=environment, stdout=said, stderr=subprocess.STDOUT)
        while True:
            pid, status, used = os.wait4(process.pid, os.WNOHANG)
            if not first and any(Path(folder).glob("f.*.exr")):
                first = time.perf_counter() - started
            if pid:
                break
            time.sleep(_POLL)
        process.returncode = os.waitstatus_to_exitcode(status)
        wall = time.perf_counter() - started
        if process.returncode:
            said.seek(0)
            lines = said.read().decode("utf-8", "replace").strip().splitlines()
            return {"failed": lines[-1] if lines else f"exit code {process.returncode}"}
        frames = len(list(Path(folder).glob("f.*.exr")))
    memory = used.ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0)
    return {
        "frames": frames,
        "to first frame s": first,
        "wall s": wall,
        "cpu s": used.ru_utime + used.ru_stime,
        "peak GB": memory / 1e9,
    }


def _row(state: str, found: Row) -> Row:
    return {"table": FIRST, "state": state} | found | {"most s": MOST[state], "most first s": MOST_FIRST[state]}
