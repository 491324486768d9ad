"""The baseline estimators. They share one path-tracing launch (``Frame.paths``)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.alias import AliasTable
from warp_gi.errors import OptionError
from warp_gi.estimator import Ahead, Estimator
from warp_gi.kernels import path_samplers
from warp_gi.radiance_cache import RadianceCache
from warp_gi.scene.baked import whole_scene

if TYPE_CHECKING:
    from warp_gi.baking import Bake
    from warp_gi.frame import Frame
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.scene import Scene


@dataclass(frozen=True)
class TracedEnvironment(Estimator):
    """Direct light from the sky by traced rays: BSDF and sky samples, combined by the balance heuristic.

    A constant sky is sampled by the BSDF alone. Unbiased.
    """

    is_per_pixel = True
    term: ClassVar[str] = "environment"

    def trace(self, frame: Frame, state: None) -> None:
        """Ask the path tracer for this term."""
        frame.paths.want(self.term)


@dataclass(frozen=True)
class _TableLights(Estimator):
    """Base of direct light from emitters picked by a table that stays the same over a sequence. Unbiased."""

    is_per_pixel = True
    term: ClassVar[str] = "emitters"

    def weights(self, scene: Scene) -> np.ndarray:
        """Return relative probabilities of selecting each emitter, float64 [emitter_count]."""
        raise NotImplementedError

    def bake_key(self, scene: Scene | BakedScene) -> str:
        """Return a hash of all but the sky."""
        return scene.contents_hash

    def start(self, scene: Scene | BakedScene, device: str, bake: Bake | None = None, seed: int = 0) -> wp.array | None:
        """Return an alias table over the emitters, AliasBucket [emitter]; None without emitters."""
        if scene.emitter_count == 0:
            return None
        return AliasTable.build(self.weights(whole_scene(scene))).on(launch.get_device(device))

    def depends_on_past(self, scene: Scene | BakedScene, ahead: Ahead | None = None) -> bool:
        """Return False: every frame has the same table."""
        return False

    def preprocess(self, frame: Frame, state: wp.array | None) -> wp.array | None:
        """Let path vertices pick lights by the table."""
        frame.paths.use_lights(path_samplers.ALIAS_LIGHTS, path_samplers.AliasLights(), state)
        return state

    def trace(self, frame: Frame, state: wp.array | None) -> None:
        """Ask the path tracer for this term."""
        frame.paths.want(self.term)


@dataclass(frozen=True)
class UniformLights(_TableLights):
    """Direct light from emissive triangles and punctual lights, each equally likely to be sampled. Unbiased."""

    def weights(self, scene: Scene) -> np.ndarray:
        """Return ones."""
        return np.ones(scene.emitter_count)


@dataclass(frozen=True)
class PowerLights(_TableLights):
    """Direct light from emissive triangles and punctual lights, sampled in proportion to their power. Unbiased."""

    def start(self, scene: Scene | BakedScene, device: str, bake: Bake | None = None, seed: int = 0) -> wp.array | None:
        """Return None: the scene has a table by power; or a table of the weights of a class of its own."""
        if type(self).weights is PowerLights.weights:
            return None
        return super().start(scene, device, bake, seed)

    def weights(self, scene: Scene) -> np.ndarray:
        """Return each emitter's power."""
        return scene.emitter_powers()


@dataclass(frozen=True)
class BsdfPaths(Estimator):
    """Indirect light by path tracing: BSDF sampling, and next-event estimation at every vertex.

    Unbiased but for ``max_depth`` and ``clamp``.
    """

    is_per_pixel = True
    term: ClassVar[str] = "indirect"

    max_depth: int = 64
    """Number of edges of the longest path from camera to light: 2 is direct light only, 3 one bounce. In white rooms 8
    loses 7 to 10 % of the indirect light and 24 loses 0.1 %. Roulette ends nearly all paths sooner, so 64 takes at most
    12 % more time than 8."""
    roulette_depth: int = 2
    """Number of edges from which on a path may end at random (Russian roulette); it goes on with a probability that is
    1.4 times the reflectance that it met after its first vertex, from 0.05 to 1."""
    clamp: float = 0.0
    """Largest component of one path's radiance, W/(m^2 sr), to which fireflies are darkened; 0 is no limit."""
    ends_in: RadianceCache | None = None
    """Radiance cache in which paths end at their second vertex, or None: direct light is sampled there as without
    it, and all other light is what the cache knows. Where it knows nothing a path goes on."""

    def validate(self) -> None:
        """Raise OptionError for depths below 2 or a negative clamp."""
        if self.max_depth < 2:
            raise OptionError(f"max_depth must be at least 2 (direct light), got {self.max_depth}")
        if self.roulette_depth < 2:
            raise OptionError(f"roulette_depth must be at least 2, got {self.roulette_depth}")
        if not self.clamp >= 0:
            raise OptionError(f"clamp must be 0 (no limit) or a radiance above it, got {self.clamp}")
        if not isinstance(self.ends_in, RadianceCache | None):
            raise OptionError(f"ends_in must be a radiance cache or None, got {self.ends_in!r:.80}")

    @property
    def radiance_cache(self) -> RadianceCache | None:
        """The radiance cache that paths end in, or None."""
        return self.ends_in

    def trace(self, frame: Frame, state: None) -> None:
        """Ask the path tracer for this term."""
        frame.paths.want(self.term, self.max_depth, self.roulette_depth, self.clamp)
