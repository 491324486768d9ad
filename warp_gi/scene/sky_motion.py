"""Skies as functions of time, for ``scene.environment``."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

from warp_gi.errors import SceneError
from warp_gi.scene.environment import Environment, Sky, as_environment

ROUNDING = 1e-12
"""Relative error that a whole number of steps may have, once it was divided by ``fps`` and multiplied by it again."""


@dataclass(frozen=True, eq=False)
class TurningSky:
    """A sky that turns about +y at constant speed: ``scene.environment = gi.TurningSky("city.exr", degrees=30.0)``.

    Called with a time in seconds, it returns the Environment of that moment; the pixels are shared.
    Raises SceneError for a sky that cannot be used, or numbers that are not finite.
    """

    sky: Sky
    """The sky at time 0: a path to a map, an RGB radiance, an Environment or a SunSky."""
    degrees: float
    """Angle in degrees by which the sky turns in ``1 / fps`` seconds; positive is counter-clockwise seen from above."""
    fps: float = 1.0
    """Steps per second. With 1, ``degrees`` is the angle per second; with a camera path's fps, the angle per frame."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "sky", as_environment(self.sky))
        if not math.isfinite(self.degrees):
            raise SceneError(f"a turning sky needs a finite number of degrees, got {self.degrees}")
        if not (math.isfinite(self.fps) and self.fps > 0):
            raise SceneError(f"fps of a turning sky must be finite and above 0, got {self.fps}")

    def __call__(self, time: float) -> Environment:
        """Return the sky at ``time`` [s]."""
        steps = time * self.fps
        whole = round(steps)
        if abs(steps - whole) <= ROUNDING * max(abs(steps), 1.0):
            steps = whole  # the time of a frame: its angle must not depend on fps
        return as_environment(self.sky).rotated(math.fmod(steps * self.degrees, 360.0))


def as_sky(value: Sky) -> Environment | None:
    """Return an environment from what ``Scene.environment`` takes beside functions of time."""
    return None if value is None else as_environment(value)


def sky_at_time(sky_at: Callable[[float], Sky], time: float) -> Environment | None:
    """Return what a function of time says the sky is; a SceneError about it tells the time."""
    try:
        return as_sky(sky_at(time))
    except SceneError as error:
        raise SceneError(f"the sky at {time:g} s: {error}") from error


def appearance(sky: Environment | None) -> tuple[object, ...] | None:
    """Return all that decides how a sky looks, to compare it with another."""
    return None if sky is None else sky.appearance
