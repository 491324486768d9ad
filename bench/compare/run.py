"""`warp-gi bench compare`: pipelines take turns on one scene, each for the same time; errors over time, and when equal.

The time of a pipeline is that of its frames, without compilation and without what comes before the first frame, which
``compare_setup`` times in processes of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

import warp_gi as gi
from warp_gi.bench.compare.reference import Reference, StillFrames
from warp_gi.bench.harness.measure import timed


@dataclass(frozen=True)
class Point:
    """The error of the mean of a pipeline's frames so far."""

    frames: int
    seconds: float
    """Wall time of these frames, seconds."""
    rmse: float
    """Error of the mean of these frames."""


@dataclass
class Run:
    """Frames of one pipeline: sums, times and errors."""

    name: str
    pipeline: gi.Pipeline
    frames: StillFrames
    wall: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    points: list[Point] = field(default_factory=list)
    sums: list[np.ndarray] = field(default_factory=list)
    """Sums of frames 0, 2, 4, ... and of frames 1, 3, 5, ..., float64 [height, width, 3]."""
    first: np.ndarray | None = None
    """The first frame, float64 [height, width, 3]; None before it."""
    is_done: bool = False

    @property
    def count(self) -> int:
        """Number of frames rendered."""
        return len(self.wall)

    @property
    def seconds(self) -> float:
        """Wall time of all frames, seconds."""
        return sum(self.wall)

    @property
    def mean(self) -> np.ndarray:
        """The mean of all frames."""
        return (self.sums[0] + self.sums[1]) / self.count

    def prepare(self, device: str) -> None:
        """Do what comes before the first frame."""
        self.frames.scheduler.bake()
        self.frames.scheduler.scene.data(device)

    def fits(self, limit: float) -> bool:
        """Return whether one more frame, as long as the last, ends within ``limit`` seconds; the first always does."""
        return not self.is_done and (not self.count or self.seconds + self.wall[-1] <= limit)

    def step(self, reference: Reference, limit: float) -> None:
        """Render a frame, and measure the mean of all; see ``add``."""
        frame, times = timed(self.frames.next)
        self.add(frame.numpy("beauty").astype(np.float64), *times, reference, limit)

    def add(self, picture: np.ndarray, wall: float, cpu: float, reference: Reference, limit: float) -> None:
        """Take over a frame and its seconds. One that ends after ``limit`` is dropped, unless it is the first."""
        if self.count and self.seconds + wall > limit:
            self.is_done = True
            return
        if self.first is None:
            self.first, self.sums = picture, [np.zeros_like(picture), np.zeros_like(picture)]
        self.sums[self.count % 2] += picture
        self.wall.append(wall)
        self.cpu.append(cpu)
        self.points.append(Point(self.count, self.seconds, reference.errors(self.mean, flip=False)["RMSE"]))

    def floor(self, reference: Reference) -> tuple[float, float] | None:
        """Return the RMSE and relMSE that more frames do not take away, or None if they do not show.

        None too for denoisers over frames, whose frames share their noise.
        """
        denoise = self.pipeline.denoise
        if self.count < 2 or (denoise is not None and denoise.depends_on_past(self.frames.scheduler.scene)):
            return None
        if reference.noise is not None and reference.noise > self.points[-1].rmse:
            return None  # relative errors are over a picture that is wrong itself, and would pass for a floor
        return reference.floor(self.sums[0] / ((self.count + 1) // 2), self.sums[1] / (self.count // 2))


@dataclass(frozen=True)
class Comparison:
    """The result of ``take_turns``."""

    runs: list[Run]
    equal_samples: dict[str, np.ndarray]
    """Mean by pipeline of as many frames as all have, float64 [height, width, 3]."""
    equal_frames: int
    reference: Reference


def take_turns(
    runs: Mapping[str, Run], reference: Reference, limit: float, told: Callable[[float], None] = lambda share: None
) -> Comparison:
    """Let the pipelines render one frame each in turn, until none can finish another one within ``limit`` seconds."""
    active, equal, rounds = list(runs.values()), {}, 0
    while active := [run for run in active if run.fits(limit)]:
        for run in active:
            run.step(reference, limit)
            told(min(sum(min(run.seconds / limit, 1.0) for run in runs.values()) / len(runs), 1.0))
        if len(active) == len(runs) and not any(run.is_done for run in active):
            equal, rounds = {run.name: run.mean for run in active}, rounds + 1
    return Comparison(list(runs.values()), equal, rounds, reference)


def runs_of(
    scene: gi.Scene,
    camera: gi.Camera,
    pipelines: Mapping[str, gi.Pipeline],
    device: str,
    seed: int = 1,
    moment: int = 0,
    bakes: Mapping[str, Sequence[gi.Bake]] | None = None,
) -> dict[str, Run]:
    """Return a run of each pipeline, ready for its first frame: baked, with the scene on the device.

    ``bakes`` by pipeline are what was baked before.
    """
    runs = {}
    for name, pipeline in pipelines.items():
        known = (bakes or {}).get(name, ())
        runs[name] = Run(name, pipeline, StillFrames(scene, camera, pipeline, device, seed, moment, known))
        runs[name].prepare(device)
    return runs


def seconds_to(points: list[Point], target: float) -> float | None:
    """Return the seconds after which the error stays below ``target``; None if it ends above.

    Between the last point above and the next, errors are a power of time.
    """
    above = [index for index, point in enumerate(points) if not point.rmse <= target]
    if not above:
        return points[0].seconds if points else None
    if above[-1] == len(points) - 1:
        return None
    before, after = points[above[-1]], points[above[-1] + 1]
    if after.rmse <= 0 or target <= 0 or not np.isfinite(before.rmse):
        return after.seconds
    share = np.log(before.rmse / target) / np.log(before.rmse / after.rmse)
    return float(before.seconds * (after.seconds / before.seconds) ** share)
