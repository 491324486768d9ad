"""What the suite `reuse` looks at: places, pictures without noise, and sequences of frames by several pipelines."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness.measure import Row, Series, Times, cost, timed
from warp_gi.bench.harness.scenes import REFERENCE_DEPTH
from warp_gi.bench.harness.stages import Case
from warp_gi.bench.suites.reuse.columns import TERMS

MEASURED = TERMS
SEED = 11
TOLERANCE = 1.2
"""Factor on the settled error below which errors stay once a sequence has settled."""
_NOT_OF_A_FRAME = ("bake", "compile", "scene")


# ---- places ----

WAREHOUSE = Case("warehouse")
MINE = Case("mine_spot")
MINE_ONE_BOUNCE = Case("mine_spot", "mine, spot, one bounce", settings={"max_depth": 3})
"""All indirect light comes straight from the sun-lit spot, or from what the sky lights around it."""
DRAGON = Case("dragon")
BISTRO = Case("bistro")
HALL = Case("modern_hall")
CORNELL = Case("cornell_box", "cornell_box")
SPHERES = Case("sphere_row")
RING = Case("guiding_ring")
STROBE = Case("strobe")


# ---- truth ----


@dataclass
class Truth:
    """The path tracer's pictures of a frame, twice, independent of each other and of all that is measured.

    Errors against one half times errors against the other: the noise of independent halves has mean 0.
    """

    scene: gi.Scene
    camera: gi.Camera
    device: str = "cpu"
    spp: int = 64
    frame: int = 0
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the paths."""
    _halves: list[dict[str, np.ndarray]] = field(default_factory=list)

    @property
    def halves(self) -> list[dict[str, np.ndarray]]:
        """Two independent pictures by term, float64 [height, width, 3]."""
        if not self._halves:
            paths = gi.BsdfPaths(**{"max_depth": REFERENCE_DEPTH, **self.settings})
            pipeline = gi.Pipeline(indirect=paths, spp=self.spp, camera_samples=1)
            for half in range(2):
                scheduler = gi.FrameScheduler(self.scene, self.camera, pipeline, self.device, seed=SEED + 1000 + half)
                frame = scheduler.frame(self.frame)
                self._halves.append({term: frame.numpy(term).astype(np.float64) for term in MEASURED})
        return self._halves

    def mean(self, term: str) -> np.ndarray:
        """Return the mean of both halves."""
        return (self.halves[0][term] + self.halves[1][term]) / 2

    def quality(self, frame: gi.Frame) -> Row:
        """Return the beauty's relMSE, without the noise of the halves, and FLIP, with it."""
        picture, mean = frame.numpy("beauty"), self.mean("beauty")
        a, b = (half["beauty"] for half in self.halves)
        relative = np.mean((picture - a) * (picture - b) / (mean**2 + gi.metrics.RELATIVE_EPSILON))
        return {"relMSE beauty": max(float(relative), 0.0), "FLIP beauty": gi.metrics.flip(picture, mean)}

    def errors(self, frame: gi.Frame) -> dict[str, float]:
        """Return the mean squared error of each term."""
        a, b = self.halves
        pictures = {term: frame.numpy(term) for term in MEASURED}
        return {term: float(np.mean((p - a[term]) * (p - b[term]))) for term, p in pictures.items()}


# ---- sequences ----


@dataclass
class FrameRun:
    """Frames of one pipeline: errors, times, and the last one."""

    scheduler: gi.FrameScheduler
    errors: dict[str, list[float]] = field(default_factory=lambda: {term: [] for term in MEASURED})
    timings: list[dict[str, float]] = field(default_factory=list)
    times: list[Times] = field(default_factory=list)
    """Wall and CPU seconds of whole frames."""
    frame: gi.Frame = field(init=False)
    """The last frame; there is none before the first ``step``."""

    def step(self, index: int, truth: Truth) -> None:
        """Render a frame and measure it."""
        self.frame, times = timed(lambda: self.scheduler.frame(index))
        self.times.append(times)
        self.timings.append(dict(self.frame.timings))
        for term, error in truth.errors(self.frame).items():
            self.errors[term].append(error)

    def error(self, term: str, first: int) -> float:
        """Return the mean error of the frames from ``first`` on."""
        return max(float(np.mean(self.errors[term][first:])), 0.0)

    def milliseconds(self, prefix: str, first: int) -> float:
        """Return the median wall time of the stages whose names begin so; of all of them for ""."""
        return sum(ms for name, ms in self.stage_milliseconds(first).items() if name.startswith(prefix))

    def stage_milliseconds(self, first: int) -> dict[str, float]:
        """Return the median wall time by stage."""
        kept = self.timings[first:]
        names = [name for name in kept[-1] if name not in _NOT_OF_A_FRAME]
        return {name: 1e3 * float(np.median([timings.get(name, 0.0) for timings in kept])) for name in names}

    def cost(self, first: int, device: str) -> float:
        """Return the median seconds of a frame, of the kind that counts on the device (``measure.cost``)."""
        return cost(tuple(np.median(self.times[first:], axis=0)), device)


def run_sequences(
    scene: gi.Scene,
    camera: gi.Camera,
    pipelines: Mapping[str, gi.Pipeline],
    frames: int,
    truth: Callable[[int], Truth],
    device: str,
    seed: int = SEED,
) -> dict[str, FrameRun]:
    """Return the first ``frames`` frames by each pipeline, which take turns; ``truth`` is what a frame should be."""
    runs = {
        name: FrameRun(gi.FrameScheduler(scene, camera, pipeline, device, seed=seed))
        for name, pipeline in pipelines.items()
    }
    for index in range(frames):
        for run in runs.values():
            run.step(index, truth(index))
    return runs


def mean_series(series: Sequence[Sequence[float]] | np.ndarray) -> np.ndarray:
    """Return the mean of error series over seeds, [frame]."""
    return np.maximum(np.mean(np.asarray(series, np.float64), axis=0), 0.0)


def settled_at(series: Series, settled: Series, window: int = 3) -> int:
    """Return the first frame from which on errors stay within `TOLERANCE` of the mean of ``settled``, errors too.

    A frame's error is noisy: it counts as the mean with the frames after it, ``window`` in all, less the standard
    deviation that such a mean of settled errors has. The length of the series says that it never settles.
    """
    errors, at_last = np.asarray(series, np.float64), np.asarray(settled, np.float64)
    bound = TOLERANCE * at_last.mean() + at_last.std() / window**0.5
    means = np.lib.stride_tricks.sliding_window_view(errors, window).mean(axis=1)
    above = np.flatnonzero(means > bound)
    if not len(above):
        return 0
    return len(series) if above[-1] == len(means) - 1 else int(above[-1]) + 1


def written(series: Series, unit: float = 1.0) -> str:
    """Return numbers as short text, in units of ``unit``."""
    return " ".join(f"{value / max(unit, 1e-30):.2f}" for value in series)


def ratio(a: float, b: float) -> float:
    """Return a / b, or 1 where both are 0."""
    return 1.0 if max(a, b) <= 1e-12 else a / max(b, 1e-30)
