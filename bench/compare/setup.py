"""What one pipeline of `bench compare` does before its first frame, and its peak memory, in a process of its own.

``python -m warp_gi.bench.compare.setup PIPELINE FOLDER OPTIONS...`` with the options of `warp-gi bench compare` prints
a line of JSON, and leaves what was baked in the folder.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import warp_gi as gi
from warp_gi import launch
from warp_gi.bench.compare.reference import StillFrames
from warp_gi.bench.harness.measure import Row, in_process, peak_memory, timed
from warp_gi.errors import GiError

if TYPE_CHECKING:
    from warp_gi.cli.compare_options import CompareBench


def setup_of(pipeline: str, folder: Path, arguments: Sequence[str]) -> tuple[Row, list[gi.Bake]]:
    """Return seconds and peak memory of a pipeline by its name, and its bakes; a row that says so if that fails."""
    row = in_process(["warp_gi.bench.compare.setup", pipeline, str(folder), *arguments])
    bakes = [] if "failed" in row else [gi.load_bake(path) for path in sorted(folder.glob("*.safetensors"))]
    return row, bakes


def main(arguments: Sequence[str]) -> int:
    """Set up the pipeline, render its first frame, and print what that took."""
    from warp_gi.cli.compare_options import parse

    try:
        print(json.dumps(_measured(arguments[0], Path(arguments[1]), parse(arguments[2:]))))
    except GiError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


def _measured(name: str, folder: Path, options: CompareBench) -> Row:
    """Return the seconds of each step of setting up a pipeline, and its peak memory."""
    from warp_gi.cli.compare_options import inputs_of, start

    start(options)
    given, load = timed(lambda: inputs_of(options))
    pipeline, device = given.pipelines[name], options.device
    _, build = timed(lambda: given.scene.data(device))
    bakes, bake = timed(lambda: baked(given.scene, given.camera, pipeline, device, options.seed))
    frames = StillFrames(given.scene, given.camera, pipeline, device, options.seed, options.frame, bakes)
    _, begin = timed(frames.scheduler.bake)
    frame, first = timed(frames.next)
    preprocess = sum(seconds for stage, seconds in frame.timings.items() if stage.startswith("preprocess"))
    row = {"load s": load[0], "build s": build[0], "compile s": launch.compile_seconds, "bake s": bake[0] + begin[0]}
    row |= {"preprocess s": preprocess, "first frame s": first[0], "peak GB": peak_memory() / 1e9}
    for index, one in enumerate(bakes):
        one.save(folder / f"{index}.safetensors")
    return row


def baked(scene: gi.Scene, camera: gi.Camera, pipeline: gi.Pipeline, device: str, seed: int) -> list[gi.Bake]:
    """Return what the estimators of a pipeline bake before its first frame."""
    bakes = [estimator.bake(scene, device, seed, None, camera) for _, estimator in pipeline.estimators()]
    return [bake for bake in bakes if bake is not None]


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
