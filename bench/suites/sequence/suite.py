"""Whole sequences by `warp-gi render`, from start to written files: frames a minute, stages, memory over the frames."""

from __future__ import annotations

import json
import sys
import tempfile
import time
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from warp_gi import launch
from warp_gi.bench.harness import catalogue, sequences
from warp_gi.bench.harness.gallery import CLOSED, run_parts
from warp_gi.bench.harness.measure import Row, in_process, median_and_spread, peak_memory, resident_memory
from warp_gi.bench.harness.places import PLACES
from warp_gi.bench.peers import blender_peer
from warp_gi.cli.report import Reporter, start_warp

SCENE = str(PLACES["atrium"].source)
CASES: dict[str, sequences.Sequence] = {
    name: case for _, module in catalogue.modules("sequence") for name, case in module.CASES.items()
}
"""Pipelines of the sequence by their names in rows; suites' folders add them."""
MOST_POINTS = 20
STAGES = ("preprocess", "trace", "denoise", "write")
_OTHERS = ("bake", "compile")


@dataclass(frozen=True)
class Size:
    """Size of a sequence."""

    frames: int
    pixels: str
    """Picture size in pixels, such as 240x135."""
    spp: int


FULL_SIZE, QUICK_SIZE = Size(500, "160x90", 4), Size(12, "160x90", 4)


def pipeline_rows(name: str, quick: bool, device: str) -> list[Row]:
    """Return rows of speed, stages and memory of a case."""
    case = CASES[name]
    size, smaller = (QUICK_SIZE, case.smaller) if quick else (FULL_SIZE, ())
    title = f"{name}, {case.smaller_title}" if smaller else name
    return rows_of(title, measure(SCENE, (*case.arguments, *smaller), size, device), size)


def cycles_rows(quick: bool, device: str) -> list[Row]:
    """Return rows of Blender Cycles beside our path tracer; both run on the processor."""
    return blender_peer.rows(blender_peer.QUICK if quick else blender_peer.FULL)


PARTS: dict[str, Callable[..., list[Row]]] = {
    **{name.split()[-1]: partial(pipeline_rows, name) for name in CASES},
    "cycles": cycles_rows,
}
QUICK_PARTS = (*(name.split()[-1] for name, case in CASES.items() if case.is_quick), "cycles")


def run(quick: bool = False, device: str = "cpu", parts: Sequence[str] = ()) -> list[Row]:
    """Return rows of speed, stages and memory for each pipeline, and of Blender Cycles beside the first."""
    return run_parts(PARTS, parts or (QUICK_PARTS if quick else ()), quick, device, CLOSED)


# ---- one sequence ----


@dataclass
class Record(Reporter):
    """A reporter that prints nothing, and keeps the seconds of phases, compilation apart."""

    seconds: dict[str, float] = field(default_factory=dict)

    def __post_init__(self) -> None:
        Reporter.__init__(self, quiet=True)

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Time a phase."""
        compiled, started = launch.compile_seconds, time.perf_counter()
        yield
        self.seconds[name] = time.perf_counter() - started - (launch.compile_seconds - compiled)


def measure(scene: str, arguments: Sequence[str], size: Size, device: str) -> dict[str, Any]:
    """Return what rendering a sequence took, in a process of its own: see ``main``; {"failed": why} if it failed."""
    with tempfile.TemporaryDirectory() as folder:
        frames = ["--frames", f"0-{size.frames - 1}", "--resolution", size.pixels, "--spp", str(size.spp)]
        output = ["--device", device, "--threads", str(launch.thread_count()), "-o", f"{folder}/f.####.exr"]
        started = time.perf_counter()
        found = in_process(["warp_gi.bench.suites.sequence.suite", scene, *arguments, *frames, *output])
        wall = time.perf_counter() - started
        written = len(list(Path(folder).glob("*.exr")))
    if "failed" not in found and written != size.frames:
        return {"failed": f"{written} of {size.frames} frames were written"}
    return found | {"wall s": wall}


def rows_of(name: str, found: dict[str, Any], size: Size) -> list[Row]:
    """Return the rows of a sequence that ``measure`` measured."""
    if "failed" in found:
        return [{"table": "speed", "pipeline": name, "failed": found["failed"]}]
    settings = {"pixels": size.pixels, "spp": size.spp, "frames": size.frames}
    said: Row = {"pipeline": name, **settings}
    seconds = found["wall s"] - found["once"].get("compile s", 0.0)  # the kernel cache held it or not
    speed = {"frames a minute": 60 * size.frames / seconds, "wall s": found["wall s"]}
    speed |= {"cpu s": found["cpu s"], **median_and_spread("s a frame", found["frames"]), "peak GB": found["peak GB"]}
    stages = {"start s": found["wall s"] - found["inside s"], **found["once"], **found["a frame"]}
    memory = np.array(found["memory"]) / 1e6
    kept = np.unique(np.linspace(0, len(memory) - 1, MOST_POINTS).round().astype(int))
    return [
        {"table": "speed", **said, **speed},
        {"table": "stages", "pipeline": name, **stages},
        {"table": "memory", **said, "first MB": memory[0], "last MB": memory[-1], **slope(memory)},
        *({"table": "memory over frames", "pipeline": name, "frame number": int(i), "MB": memory[i]} for i in kept),
    ]


def slope(memory: np.ndarray) -> Row:
    """Return the growth in KB a frame of memory in MB by frame, by least squares, and its standard error.

    The first quarter is left out, where caches fill.
    """
    y = memory[len(memory) // 4 :] * 1e3
    if len(y) < 3:
        return {"KB a frame": None, "KB a frame spread": None}
    (grows, _), covariance = np.polyfit(np.arange(len(y)), y, 1, cov="unscaled")
    rest = y - np.polyval((grows, _), np.arange(len(y)))
    error = np.sqrt(covariance[0, 0] * (rest @ rest) / (len(y) - 2))
    return {"KB a frame": float(grows), "KB a frame spread": float(error)}


# ---- in a process of its own ----


def main(arguments: Sequence[str]) -> int:
    """Do what `warp-gi render` does with these arguments, and print as JSON what it took.

    Seconds by stage, once and as means of the frames; bytes of memory after each frame; seconds of each frame,
    written file included.
    """
    from warp_gi.cli import render as cli_render
    from warp_gi.errors import GiError

    started, memory, frames = time.perf_counter(), array("d"), array("d")
    sums = dict.fromkeys(STAGES, 0.0)
    render_shot = cli_render.render_shot

    def measured(*given: Any) -> Any:
        compiled, begun = launch.compile_seconds, time.perf_counter()
        result = render_shot(*given)
        frames.append(time.perf_counter() - begun - (launch.compile_seconds - compiled))
        memory.append(resident_memory())
        add_stages(sums, result[1])
        return result

    cli_render.render_shot = measured  # type: ignore[assignment]
    report = Record()
    try:
        options = cli_render.parse(arguments)
        start_warp(options.device)
        launch.set_threads(options.threads)
        cli_render.run(options, report)
    except GiError as error:
        print(error, file=sys.stderr)
        return 2
    once = {"load s": report.seconds["scene"], "bake s": report.seconds["bake"], "compile s": launch.compile_seconds}
    each = {f"{stage} s a frame": seconds / len(frames) for stage, seconds in sums.items()}
    found: dict[str, Any] = {"once": once, "a frame": each, "memory": list(memory), "frames": list(frames)}
    found |= {"inside s": time.perf_counter() - started, "cpu s": time.process_time(), "peak GB": peak_memory() / 1e9}
    print(json.dumps(found))
    return 0


def add_stages(sums: Row, timings: dict[str, float]) -> None:
    """Add the seconds of a frame's stages, as the scheduler names them, to those of ``STAGES``.

    Sums, as frames kept for a mean would count as memory that grows.
    """
    for name, seconds in timings.items():
        if name not in _OTHERS:
            kind = name.split()[0]
            sums[kind if kind in STAGES else "trace"] += seconds


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
