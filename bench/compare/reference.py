"""What `bench compare` measures against: a picture of two independent halves, or one from a file; errors against it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np

import warp_gi as gi
from warp_gi import launch, metrics
from warp_gi.bench.harness.measure import Row
from warp_gi.bench.harness.scenes import REFERENCE_DEPTH
from warp_gi.cli.compare import read_image
from warp_gi.errors import OptionError, SceneError

CHUNK = 32
"""Samples a pixel of one frame of a reference."""
_FAR = 1_000_000_000  # seeds of references are as far from those of what is measured


class StillFrames:
    """Independent frames of one moment by one pipeline; what learns from frames goes on learning.

    In a scene that moves all are of frame ``moment``, with seeds of their own.
    """

    def __init__(
        self,
        scene: gi.Scene,
        camera: gi.Camera,
        pipeline: gi.Pipeline,
        device: str,
        seed: int,
        moment: int = 0,
        bakes: Iterable[gi.Bake] = (),
    ) -> None:
        self.scheduler = gi.FrameScheduler(scene, camera, pipeline, device, seed, bakes=bakes)
        self.moment = moment if scene.is_animated else None
        self.seed, self.count = seed, 0

    def next(self) -> gi.Frame:
        """Render one more frame, and return it."""
        index = self.count
        self.count += 1
        if self.moment is None:
            return self.scheduler.frame(index)
        self.scheduler.seed = self.seed + index
        return self.scheduler.frame(self.moment, self.moment)


@dataclass(frozen=True)
class Reference:
    """What pictures should be, twice, with independent noise, float64 [height, width, 3]; or one picture twice.

    The product of a picture's errors against the two halves has the squared error as its mean: noise of independent
    halves has mean 0. With one picture twice the errors hold its noise too.
    """

    halves: tuple[np.ndarray, np.ndarray]
    about: Row = field(default_factory=dict)
    """How the reference was made, by name: renderer, samples, seconds, noise."""

    @cached_property
    def picture(self) -> np.ndarray:
        """The mean of both halves."""
        return (self.halves[0] + self.halves[1]) / 2

    @property
    def noise(self) -> float | None:
        """The standard error of ``picture``; None if it is not known."""
        a, b = self.halves
        return None if a is b else float(np.sqrt(np.mean((a - b) ** 2) / 4))

    def errors(self, picture: np.ndarray, flip: bool = True) -> Row:
        """Return RMSE, relMSE, FLIP and the number of pixels left out of them, as they are NaN or infinite.

        FLIP is against ``picture``, with its noise; pixels left out count as equal there.
        """
        finite = np.isfinite(picture).all(axis=2)
        a, b, mean = (x[finite] for x in (*self.halves, self.picture))
        product = (picture[finite] - a) * (picture[finite] - b)
        found: Row = {"RMSE": _positive(product) ** 0.5, "relMSE": _positive(product / (mean**2 + _EPSILON))}
        if flip:
            found["FLIP"] = metrics.flip(np.where(finite[..., None], picture, self.picture), self.picture)
        return found | {"bad pixels": int(np.count_nonzero(~finite))}

    def floor(self, first: np.ndarray, second: np.ndarray) -> tuple[float, float] | None:
        """Return the RMSE and relMSE that more samples do not take away, of two means of frames with independent noise.

        The product of their errors, each against a half, has the squared bias as its mean. None if its relative
        form is within three of its standard errors, taken from its scatter over the pixels: a few bright pixels full
        of noise would hide a bias of all others.
        """
        a, b = self.halves
        product = ((first - a) * (second - b) + (first - b) * (second - a)) / 2
        finite = np.isfinite(product).all(axis=2)
        relative = (product / (self.picture**2 + _EPSILON)).mean(axis=2)[finite]
        if relative.size < 2 or relative.mean() <= 3 * relative.std() / relative.size**0.5:
            return None
        return _positive(product[finite]) ** 0.5, float(relative.mean())


_NOISE = "its noise is taken out of RMSE and relMSE in these tables; FLIP, and figures beside pictures, hold it"
_EPSILON = metrics.RELATIVE_EPSILON


def _positive(values: np.ndarray) -> float:
    """Return the mean, or 0 where noise made it less; NaN without values."""
    return max(float(values.mean()), 0.0) if values.size else float("nan")


def computed(
    scene: gi.Scene,
    camera: gi.Camera,
    device: str,
    seed: int,
    spp: int,
    moment: int = 0,
    centred: bool = False,
    emitters: gi.Estimator | None = None,
    told: Callable[[float], None] = lambda share: None,
) -> Reference:
    """Return a reference by the path tracer with ``spp`` samples a pixel, half of them in each half.

    ``centred`` sends rays through the middles of pixels, as pipelines with one sample do. ``emitters`` samples the
    emitters in place of the preset's estimator.
    """
    chunk = min(max(spp // 2, 1), CHUNK)
    count = max(round(spp / 2 / chunk), 1)
    indirect = gi.BsdfPaths(max_depth=REFERENCE_DEPTH)
    pipeline = gi.Pipeline.preset("path", spp=chunk, camera_samples=1 if centred else chunk, indirect=indirect)
    if emitters is not None:
        pipeline = replace(pipeline, emitters=emitters)
    compiled, started, halves = launch.compile_seconds, time.perf_counter(), []
    for half in range(2):
        frames = StillFrames(scene, camera, pipeline, device, seed + (half + 1) * _FAR, moment)
        total = np.zeros((camera.resolution[1], camera.resolution[0], 3))
        for index in range(count):
            total += frames.next().numpy("beauty")
            told((half * count + index + 1) / (2 * count))
        halves.append(total / count)
    seconds = time.perf_counter() - started - (launch.compile_seconds - compiled)
    reference = Reference((halves[0], halves[1]), {"reference": "path tracer", "spp": 2 * chunk * count})
    _check_finite(reference.picture, "the computed reference")
    reference.about.update(
        {"max depth": indirect.max_depth, "seconds": seconds, "noise RMSE": reference.noise, "says": _NOISE}
    )
    return reference


def from_file(path: Path, layer: str = "beauty") -> Reference:
    """Return a reference from an EXR, HDR or NPY file of linear radiance.

    Raises SceneError for a file that cannot be read, OptionError for one that is no picture of three linear channels
    or has values that are not finite.
    """
    try:
        pixels = read_image(path, layer)
    except OSError as error:
        raise SceneError(f"{path}: {error}") from error
    if pixels.dtype.kind != "f" or pixels.ndim != 3 or pixels.shape[2] < 3:
        raise OptionError(f"--reference {path}: expected three channels of linear radiance, as in an EXR file")
    pixels = pixels[..., :3].astype(np.float64)
    _check_finite(pixels, f"--reference {path}")
    return Reference((pixels, pixels), {"reference": str(path), "says": "errors hold the noise of this picture"})


def _check_finite(pixels: np.ndarray, what: str) -> None:
    bad = int(np.count_nonzero(~np.isfinite(pixels).all(axis=2)))
    if bad:
        raise OptionError(f"{what} has {bad} pixels that are NaN or infinite; errors against them say nothing")
