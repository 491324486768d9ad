"""The reference estimators. They share one path-tracing launch (``Frame.request_paths``)."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from warp_gi.alias import AliasTable
from warp_gi.color import LUMINANCE
from warp_gi.errors import OptionError
from warp_gi.estimator import Estimator
from warp_gi.kernels import path_trace


@dataclass(frozen=True)
class TracedEnvironment(Estimator):
    """Direct light from the sky by traced rays: BSDF and sky samples, combined by the balance heuristic.

    A constant sky is sampled by the BSDF alone. Unbiased.
    """

    term: ClassVar[str] = "environment"

    def trace(self, frame: Any, state: Any) -> None:
        """Ask the shared path launch for this term."""
        frame.request_paths(path_trace.TERM_ENVIRONMENT)


@dataclass(frozen=True)
class _SampledLights(Estimator):
    """Direct light from emitters picked by a fixed distribution. Unbiased."""

    term: ClassVar[str] = "emitters"

    def weights(self, scene: Any) -> np.ndarray:
        """Return relative selection probabilities, float64 [emitter_count]."""
        raise NotImplementedError

    def depends_on_past(self, scene: Any, ahead: Any = None) -> bool:
        """Return False: powers stay, so every frame has the same table."""
        return False

    def preprocess(self, frame: Any, state: Any) -> Any:
        """Fill the alias table that every path vertex of the frame uses."""
        if frame.scene.emitter_count == 0:
            return None
        if state is None:
            state = AliasTable.build(self.weights(frame.scene)).on(frame.device)
        frame.data.emitters.alias = state
        return state

    def trace(self, frame: Any, state: Any) -> None:
        """Ask the shared path launch for this term."""
        frame.request_paths(path_trace.TERM_EMITTERS)


@dataclass(frozen=True)
class UniformLights(_SampledLights):
    """Direct light from emissive triangles and punctual lights, each equally likely to be sampled. Unbiased."""

    def weights(self, scene: Any) -> np.ndarray:
        """Return ones."""
        return np.ones(scene.emitter_count)


@dataclass(frozen=True)
class PowerLights(_SampledLights):
    """Direct light from emissive triangles and punctual lights, sampled in proportion to their power. Unbiased."""

    def weights(self, scene: Any) -> np.ndarray:
        """Return each emitter's power."""
        return scene.emitter_powers()


@dataclass(frozen=True)
class BsdfPaths(Estimator):
    """Indirect light by path tracing: BSDF sampling, and next-event estimation at every vertex.

    Unbiased but for ``max_depth`` and ``clamp``.
    """

    term: ClassVar[str] = "indirect"

    max_depth: int = 64
    """Edges of the longest path from camera to light: 2 is direct light only, 3 one bounce. In white rooms 8 loses 7 to
    10 % of the indirect light and 24 loses 0.1 %. Roulette ends nearly all paths sooner, so 64 costs little more than
    8: at most 7 % more time."""
    roulette_depth: int = 5
    """Paths of this many edges and more end at random, by their throughput or the reflectance they met, the larger."""
    clamp: float = 0.0
    """Largest component of one path's radiance, W/(m^2 sr); darkens fireflies. 0 is no limit."""

    def validate(self) -> None:
        """Raise OptionError for depths below 2 or a negative clamp."""
        if self.max_depth < 2:
            raise OptionError(f"max_depth must be at least 2 (direct light), got {self.max_depth}")
        if self.roulette_depth < 2:
            raise OptionError(f"roulette_depth must be at least 2, got {self.roulette_depth}")
        if not self.clamp >= 0:
            raise OptionError(f"clamp must be 0 (no limit) or a radiance above it, got {self.clamp}")

    def trace(self, frame: Any, state: Any) -> None:
        """Ask the shared path launch for this term."""
        frame.request_paths(path_trace.TERM_INDIRECT, self)


def sky_probability(scene: Any) -> float:
    """Return how often a path vertex samples the sky rather than an emitter: by power, but neither under a fifth.

    A sky sends pi radius^2 times its integral over the sphere into the scene; walls keep most of that out of a room.
    """
    environment = scene.environment
    if environment is None or environment.pixels is None:
        return 0.0
    if scene.emitter_count == 0:
        return 1.0
    sky = 4.0 * math.pi**2 * scene.radius**2 * float(environment.mean_radiance @ LUMINANCE)
    emitters = float(scene.emitter_powers().sum())
    return min(max(sky / max(sky + emitters, 1e-30), 0.2), 0.8)
