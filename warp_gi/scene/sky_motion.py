"""Skies as functions of time, for ``scene.environment``."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import cast

from warp_gi.errors import SceneError
from warp_gi.files import frame_path, frames_there
from warp_gi.scene.environment import Environment, Sky, as_environment
from warp_gi.scene.files.sky_images import split_layer

ROUNDING = 1e-12
"""Relative error that a whole number of steps may have, once it was divided by ``fps`` and multiplied by it again."""


@dataclass(frozen=True, eq=False)
class TurningSky:
    """A sky that turns about +y at constant speed: ``scene.environment = gi.TurningSky("city.exr", degrees=30.0)``.

    Called with a time in seconds, it returns the Environment of that moment; the pixels are shared.
    Raises SceneError for a sky that cannot be used, or numbers that are not finite.
    """

    sky: Sky | Callable[[float], Sky]
    """The sky at time 0: a path to a map, an RGB radiance, an Environment or a SunSky; or a function of time that is
    turned, as a SkySequence."""
    degrees: float
    """Angle in degrees by which the sky turns in ``1 / fps`` seconds; positive is counter-clockwise seen from above."""
    fps: float = 1.0
    """Steps per second. With 1, ``degrees`` is the angle per second; with a camera path's fps, the angle per frame."""

    def __post_init__(self) -> None:
        if not callable(self.sky):
            object.__setattr__(self, "sky", as_environment(self.sky))
        if not math.isfinite(self.degrees):
            raise SceneError(f"a turning sky needs a finite number of degrees, got {self.degrees}")
        _check_fps("a turning sky", self.fps)

    @property
    def start(self) -> float:
        """First time in seconds at which there is a sky."""
        return sky_start(self.sky)

    def __call__(self, time: float) -> Environment:
        """Return the sky at ``time`` [s]."""
        sky = self.sky(time) if callable(self.sky) else self.sky
        return as_environment(sky).rotated(math.fmod(_steps(time, self.fps) * self.degrees, 360.0))


@dataclass(frozen=True, eq=False)
class SkySequence:
    """A sky with a map a frame, from numbered files: ``scene.environment = gi.SkySequence("sky.####.exr", fps=24)``.

    Called with a time in seconds, it returns the Environment of that moment, whose file it reads then; that of the
    file used last is kept. A file is shown from the time of its frame to that of the next frame. Where frame 0 has no
    file, the scene is under the sky of the first one that has until it is rendered.
    Raises SceneError for a name without #, if no file of that name is there, for numbers that are not finite; and, when
    called, for a frame without a file, and what ``Environment.load`` raises.
    """

    pattern: str | Path
    """Name of the files, 2:1 latitude-longitude images; the last run of # is the frame's number, padded with zeros.
    In "sky.####.exr:beauty" the layer follows, as in ``Environment.load``."""
    fps: float = 24.0
    """Files per second: the fps of the camera path, where each of its frames has a file."""
    rotation: float = 0.0
    """Angle in degrees by which every sky is turned about +y."""
    scale: float = 1.0
    """Factor on the radiance of every sky."""
    layer: str = ""
    """Layer of every file; "" is its only one, or the beauty."""
    _kept: dict[tuple[object, ...], Environment] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        _check_fps("a sequence of skies", self.fps)
        pattern, layer = split_layer(self.pattern)
        object.__setattr__(self, "pattern", pattern)
        object.__setattr__(self, "layer", layer or self.layer)
        if "#" not in Path(self.pattern).name:
            raise SceneError(f"{self.pattern}: put #### where the number of the frame is, as in sky.####.exr")
        if not frames_there(self.pattern):
            raise SceneError(f"{self.pattern}: no such files; the first could be {frame_path(self.pattern, 0).name}")

    @property
    def start(self) -> float:
        """Time in seconds of the first frame that has a file."""
        return next(iter(frames_there(self.pattern)), 0) / self.fps

    def __call__(self, time: float) -> Environment:
        """Return the sky at ``time`` [s]."""
        number = math.floor(_steps(time, self.fps))
        self.check([number])
        what = frame_path(self.pattern, number), self.rotation, self.scale, self.layer
        sky = self._kept.get(what)
        if sky is None:
            sky = Environment.load(*what)
            self._kept.clear()
            self._kept[what] = sky
        return sky

    def check(self, frames: Iterable[int]) -> None:
        """Raise SceneError, which tells what is there, if a file of these frames is not."""
        for number in frames:
            if number < 0 or not frame_path(self.pattern, number).is_file():
                there = ranges(frames_there(self.pattern)) or "none"
                name = f"{self.pattern}: frame {number}"
                raise SceneError(f"{name} has no file{_named(self.pattern, number)} (frames that have: {there})")


def ranges(numbers: Sequence[int], most: int = 4) -> str:
    """Return numbers in order as "0-5, 8, 10-12"; of more than ``most`` such parts the last ones are left out."""
    breaks = [place for place, (a, b) in enumerate(pairwise(numbers), 1) if b != a + 1]
    parts = [numbers[a:b] for a, b in pairwise([0, *breaks, len(numbers)]) if a < b]
    words = [f"{part[0]}-{part[-1]}" if len(part) > 1 else f"{part[0]}" for part in parts[:most]]
    return ", ".join(words) + (f" ... {numbers[-1]}" if len(parts) > most else "")


def sky_start(sky: object) -> float:
    """Return the time in seconds of the first sky of a function of time: its ``start``, if it has one, or 0."""
    return float(getattr(sky, "start", 0.0))


def _check_fps(what: str, fps: float) -> None:
    if not (math.isfinite(fps) and fps > 0):
        raise SceneError(f"fps of {what} must be finite and above 0, got {fps}")


def _named(pattern: str | Path, number: int) -> str:
    return "" if number < 0 else f" {frame_path(pattern, number).name}"


def _steps(time: float, fps: float) -> float:
    """Return how many times ``1 / fps`` a time is; whole for the time of a frame, for any fps."""
    steps = time * fps
    whole = round(steps)
    return whole if abs(steps - whole) <= ROUNDING * max(abs(steps), 1.0) else steps


def as_sky(value: Sky) -> Environment | None:
    """Return an environment from what ``Scene.environment`` takes beside functions of time."""
    return None if value is None else as_environment(value)


def first_sky(
    value: Sky | Callable[[float], Sky],
) -> tuple[Callable[[float], Sky] | None, float, Environment | None]:
    """Return of what ``Scene.environment`` is set to: the function of time that it is, if any, its first time, its sky.

    Raises SceneError for what is no sky.
    """
    if callable(value) and not isinstance(value, type):
        start = sky_start(value)
        return value, start, sky_at_time(value, start)
    return None, 0.0, as_sky(cast("Sky", value))


def sky_at_time(sky_at: Callable[[float], Sky], time: float) -> Environment | None:
    """Return what a function of time says the sky is; a SceneError about it tells the time."""
    try:
        return as_sky(sky_at(time))
    except SceneError as error:
        raise SceneError(f"the sky at {time:g} s: {error}") from error


def appearance(sky: Environment | None) -> tuple[object, ...] | None:
    """Return all that decides how a sky looks, to compare it with another."""
    return None if sky is None else sky.appearance
