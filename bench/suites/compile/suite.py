"""Seconds that compiling and loading each kernel module takes, with an empty and with a filled cache; object sizes.

Each time is from a process of its own. Quick: the modules that a frame of the preset "path" needs.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import warp as wp

import warp_gi as gi
from warp_gi import launch
from warp_gi.bench.compile_cuda import kernel_modules
from warp_gi.bench.harness.measure import Row, in_process
from warp_gi.bench.harness.places import PLACES

OBJECTS = (".o", ".obj", ".cubin", ".ptx")
FRAME = "first frame"
"""Name that stands, in place of a module's, for all modules that a frame of the default pipeline loads."""
STATES = ("cold", "warm")


def run(quick: bool = False, device: str = "cpu") -> list[Row]:
    """Return a row for each kernel module, and one for the first frame of the default pipeline."""
    frame = _cold_and_warm(FRAME, device)
    if "failed" in frame:
        return [{"table": FRAME} | frame]
    needed = frame.pop("modules")
    rows = [
        {"table": "modules", "module": _short(name), "first frame needs it": name in needed}
        | _cold_and_warm(name, device)
        for name in (needed if quick else kernel_modules())
    ]
    return [
        *rows,
        {"table": FRAME, "pipeline": "path"} | frame_row([r for r in rows if r["first frame needs it"]], frame),
    ]


def frame_row(rows: Sequence[Row], frame: Row) -> Row:
    """Return sums over the modules of a frame, and what the frame took in one process."""
    good = [row for row in rows if "failed" not in row]
    row: Row = {"modules": len(rows), "measured": len(good)}
    row |= {f"sum of {key}": sum(one[key] for one in good) for key in ("cold s", "warm s", "object kB")}
    return row | {f"in one process, {state} s": frame[f"{state} s"] for state in STATES}


def _cold_and_warm(name: str, device: str) -> Row:
    """Return seconds and object size of a module, or the frame, each in a new process and first with an empty cache."""
    row: Row = {}
    with tempfile.TemporaryDirectory() as cache:
        for state in STATES:
            found = in_process(["warp_gi.bench.suites.compile.suite", name, device], WARP_CACHE_PATH=cache)
            if "failed" in found:
                return found
            row[f"{state} s"] = found["seconds"]
        sizes = [path.stat().st_size for path in Path(cache).rglob("*") if path.suffix in OBJECTS]
    row["object kB"] = sum(sizes) / 1e3
    return row | ({"modules": found["modules"]} if name == FRAME else {})


def _short(name: str) -> str:
    return name.removeprefix("warp_gi.kernels.")


def main(arguments: Sequence[str]) -> None:
    """Load a module, or render a small frame, and print as JSON what was loaded and how long that took."""
    name, device = arguments
    wp.config.log_level = wp.LOG_WARNING
    wp.init()
    loaded: list[str] = []
    launch.on_load = loaded.append
    if name == FRAME:
        box = PLACES["cornell_box"]
        next(iter(gi.render(box.scene(), box.camera().at_resolution(8, 8), gi.Pipeline(), device=device)))
    else:
        kernel_modules()  # a Warp module is known once its file is imported
        launch.load(next(iter(wp.get_module(name).kernels.values())), launch.get_device(device))
    print(json.dumps({"seconds": launch.compile_seconds, "modules": loaded}))


if __name__ == "__main__":
    main(sys.argv[1:])
