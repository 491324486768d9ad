"""What the benchmarks of estimators share: places that they look at, and stages of a frame that are timed alone."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

import warp_gi as gi
from warp_gi import launch
from warp_gi.bench import presets
from warp_gi.pipeline import TERMS

Row = dict[str, Any]
Times = tuple[float, float]
"""Wall and CPU seconds."""


@dataclass(frozen=True)
class Place:
    """A scene, and where it is seen from."""

    name: str
    scene: Callable[[], gi.Scene]
    camera: Callable[[], gi.Camera]
    target: float = 0.0
    """How many times faster than the baseline the estimator shall be."""
    file: str = ""
    settings: dict[str, Any] = field(default_factory=dict)
    """Of its estimator, where not the defaults."""

    @property
    def missing(self) -> str:
        """What to say if the scene's file is not there, or nothing."""
        path = presets.SCENES / self.file
        return "" if not self.file or path.exists() else f"no {path}; set WARP_GI_SCENES"


class Stage:
    """A frame of one term, which can be traced again and again: primary rays and bake are done.

    Stages of one scene, camera, number of samples and seed draw the same samples, so what differs between their
    pictures is what their estimators make of them. Rays start at what is seen in the middle of a pixel.
    """

    def __init__(
        self, scene: gi.Scene, camera: gi.Camera, estimator: Any, spp: int, device: str, bake: Any = None, seed: int = 0
    ) -> None:
        terms = dict.fromkeys(TERMS) | {estimator.term: estimator}
        pipeline = gi.Pipeline(**terms, spp=spp, camera_samples=1)
        bakes = [bake] if bake is not None else []
        scheduler = gi.FrameScheduler(scene, camera, pipeline, device, seed=seed, bakes=bakes)
        self.estimator, self.spp = estimator, spp
        self.frame = scheduler.frame(0)
        self.state: Any = scheduler.state(estimator.term)
        self.picture = self.frame.numpy(estimator.term).copy()
        self.albedo = self.frame.numpy("albedo").copy()

    def trace(self) -> None:
        """Do the stage once more; its sums are no picture any more."""
        self.estimator.trace(self.frame, self.state)
        if self.frame.wants_paths:
            self.frame.launch_paths()
        wp.synchronize_device(self.frame.device)


def timed(work: Callable[[], Any]) -> tuple[Any, Times]:
    """Return what ``work`` does, and seconds without compilation."""
    compiled, wall, cpu = launch.compile_seconds, time.perf_counter(), time.process_time()
    result = work()
    wp.synchronize()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    compiled = launch.compile_seconds - compiled
    return result, (wall - compiled, max(cpu - compiled, 0.0))


def timed_bake(scene: gi.Scene, estimator: Any, device: str, camera: Any = None) -> tuple[gi.Bake, Times]:
    """Return what the camera, or path, makes the estimator bake, and seconds without compilation."""
    return timed(lambda: gi.bake(scene, estimator, device, camera_path=camera))


def race(stages: Mapping[str, Stage | Callable[[], Any]], repetitions: int) -> dict[str, Times]:
    """Return the median seconds of each stage, or call; they take turns."""
    times: dict[str, list[Times]] = {name: [] for name in stages}
    for repetition in range(repetitions + 1):
        for name, stage in stages.items():
            wall, cpu = time.perf_counter(), time.process_time()
            (stage.trace if isinstance(stage, Stage) else stage)()
            wp.synchronize()
            taken = time.perf_counter() - wall, time.process_time() - cpu
            if repetition:  # the first warms the caches
                times[name].append(taken)
    return {name: tuple(np.median(values, axis=0).tolist()) for name, values in times.items()}


def cost(times: Times, device: str) -> float:
    """Return what counts of ``times``: CPU seconds on a CPU, of which others use some; wall seconds on a GPU."""
    return times[1] if launch.get_device(device).is_cpu else times[0]


def median_and_spread(name: str, values: Sequence[float]) -> Row:
    """Return the median, and half of the range that the middle half of the values lie in."""
    low, middle, high = np.percentile(values, (25, 50, 75))
    return {name: float(middle), f"{name} spread": float(high - low) / 2}


def rmse(a: np.ndarray, b: np.ndarray | float = 0.0) -> float:
    """Return the root of the mean squared difference."""
    return float(np.sqrt(np.mean(np.square(np.asarray(a, np.float64) - b))))
