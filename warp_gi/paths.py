"""Requests of a frame to the path tracer: terms of the light, and how paths choose lights and directions."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, TypeVar

import warp as wp

from warp_gi.color import LUMINANCE
from warp_gi.errors import OptionError
from warp_gi.kernels import path_samplers, path_trace, types
from warp_gi.scene.baked import BakedScene

if TYPE_CHECKING:
    from warp_gi.scene.scene import Scene

TERM_BITS = {
    "environment": int(path_trace.TERM_ENVIRONMENT),
    "emitters": int(path_trace.TERM_EMITTERS),
    "indirect": int(path_trace.TERM_INDIRECT),
}


Sampler = TypeVar("Sampler", bound=NamedTuple)


@dataclass(frozen=True, eq=False)
class SamplerInUse(Generic[Sampler]):
    """Functions that paths call, and the data that these functions get in this frame."""

    sampler: Sampler
    """Tuple of functions, one of those in ``kernels.path_samplers``."""
    data: Any
    """Kernel struct of the class that ``sampler.data`` names."""


class PathRequest:
    """Requests of a frame's estimators to its paths, which they share.

    Every path vertex samples lights and directions by what was asked for last. Without a request lights are sampled
    in proportion to their power, and directions by the BSDF.
    """

    def __init__(self, emitters: types.Emitters) -> None:
        self._emitters = emitters
        self.lights = SamplerInUse(path_samplers.ALIAS_LIGHTS, path_samplers.AliasLights())
        self.directions = SamplerInUse(path_samplers.BSDF_DIRECTIONS, path_samplers.BsdfDirections())
        self.regions = SamplerInUse(path_samplers.NO_REGIONS, path_samplers.NoRegions())
        """Regions of space that samplers tell apart. Set by ``prepare``, if a sampler uses regions."""
        self.sky = SamplerInUse(path_samplers.SCENE_SKY, path_samplers.SceneSky())
        """Sky that paths meet where they leave the scene."""
        self.cache = SamplerInUse(path_samplers.NO_CACHE, path_samplers.NoCache())
        """Radiance cache that paths may end in."""
        self.cache_vertex = int(path_trace.CACHE_VERTEX)
        """First vertex at which paths may end in the radiance cache; 1 is the first hit."""
        self.terms = 0
        """Bits of the terms that this camera sample's estimators want, ``path_trace.TERM_*``."""
        self.max_depth = 2
        """Edges of the longest path from the camera to a light; 2 is direct light."""
        self.roulette_depth = 2
        """Number of edges from which on paths end at random."""
        self.clamp = 0.0
        """Largest component of a path's indirect radiance, W/(m^2 sr); 0 is no limit."""
        self._asked: set[str] = set()
        self._regions: tuple[path_samplers.Regions, Callable[[PathRequest], Any]] | None = None

    # ---- requests ----

    def use_lights(self, sampler: path_samplers.LightSampler, data: Any, table: wp.array | None = None) -> None:
        """Let vertices sample lights by ``sampler``.

        ``data`` is its struct. ``table`` is an alias table over the emitters, AliasBucket [emitter], for samplers that
        draw from one; None leaves the scene's, by power. Asked in ``preprocess``. Raises OptionError if another sampler
        was asked for in this frame.
        """
        self._ask("lights", self.lights, sampler)
        self.lights = SamplerInUse(sampler, data)
        if table is not None:
            self._emitters.alias = table

    def use_directions(self, sampler: path_samplers.DirectionSampler, data: Any) -> None:
        """Let paths go on in directions of ``sampler``; ``data`` is its struct.

        Asked in ``preprocess``. Raises OptionError if another sampler was asked for in this frame.
        """
        self._ask("directions", self.directions, sampler)
        self.directions = SamplerInUse(sampler, data)

    def use_regions(self, regions: path_samplers.Regions, data: Callable[[PathRequest], Any]) -> None:
        """Let samplers find regions and leave samples in them.

        ``data`` returns the struct of ``regions``. It is called before the first launch of a frame whose samplers use
        regions, when all else is known.
        """
        self._regions = regions, data

    def _ask(self, what: str, known: SamplerInUse[Any], sampler: Any) -> None:
        if what in self._asked and known.sampler is not sampler:
            raise OptionError(
                f"two estimators sample {what} of paths, by {known.sampler.name!r} and by {sampler.name!r}: leave one "
                "of them out"
            )
        self._asked.add(what)

    def use_sky(self, sky: path_samplers.Sky, data: Any) -> None:
        """Let paths that leave the scene meet ``sky`` in place of the scene's; ``data`` is its struct."""
        self.sky = SamplerInUse(sky, data)

    def use_cache(self, cache: path_samplers.PathCache, data: Any, vertex: int = int(path_trace.CACHE_VERTEX)) -> None:
        """Let paths end in a radiance cache from a vertex on; ``data`` is its struct. 1 is the first hit.

        Raises OptionError for the first hit and a cache that holds direct light, which is a term of its own there.
        """
        if cache.holds_direct and vertex < int(path_trace.CACHE_VERTEX):
            raise OptionError(
                f"the radiance cache {cache.name!r} holds direct light and is read from vertex "
                f"{int(path_trace.CACHE_VERTEX)} on, got {vertex}"
            )
        self.cache, self.cache_vertex = SamplerInUse(cache, data), vertex

    def want(self, term: str, max_depth: int | None = None, roulette_depth: int = 2, clamp: float = 0.0) -> None:
        """Ask for a term of the light in the current camera sample.

        Args:
            term: "environment", "emitters" or "indirect".
            max_depth: Edges of the longest path; None leaves it to the other terms, or 2.
            roulette_depth: Edges from which on paths end at random.
            clamp: Largest component of a path's indirect radiance, W/(m^2 sr); 0 is no limit.
        """
        self.terms |= TERM_BITS[term]
        if max_depth is not None:
            self.max_depth, self.roulette_depth, self.clamp = max_depth, roulette_depth, clamp

    # ---- what the frame does with them ----

    @property
    def is_wanted(self) -> bool:
        """Whether an estimator asked for a term in this camera sample."""
        return self.terms != 0

    def samplers(
        self,
    ) -> tuple[
        path_samplers.LightSampler,
        path_samplers.DirectionSampler,
        path_samplers.Regions,
        path_samplers.Sky,
        path_samplers.PathCache,
    ]:
        """Return the arguments of ``kernels.path_trace.path_tracer``."""
        lights, directions, regions = self.lights.sampler, self.directions.sampler, self.regions.sampler
        return lights, directions, regions, self.sky.sampler, self.cache.sampler

    def begin(self) -> None:
        """Forget the terms of the last camera sample."""
        self.terms = 0

    def prepare(self) -> None:
        """Make the regions, once a frame, if a sampler uses them."""
        uses_regions = self.lights.sampler.uses_regions or self.directions.sampler.uses_regions
        if not uses_regions or self.regions.sampler is not path_samplers.NO_REGIONS:
            return
        if self._regions is None:
            names = f"{self.lights.sampler.name!r} and {self.directions.sampler.name!r}"
            raise OptionError(
                f"the samplers {names} tell regions apart, and no service offers any: return SampleOctree() among the "
                "services of the estimator"
            )
        regions, data = self._regions
        self.regions = SamplerInUse(regions, data(self))

    def finish(self) -> None:
        """Forget what makes the regions: it may hold the frame, which would then be freed late."""
        self._regions = None


def sky_probability(scene: Scene | BakedScene) -> float:
    """Return the probability that a path vertex samples the sky rather than an emitter: by power, from 0.2 to 0.8.

    A sky sends pi radius^2 times its integral over the sphere into the scene; walls keep most of that out of a room.
    """
    environment = scene.environment
    if isinstance(scene, BakedScene) or environment is None or environment.pixels is None:
        return 0.0
    if scene.emitter_count == 0:
        return 1.0
    sky = 4.0 * math.pi**2 * scene.radius**2 * float(environment.mean_radiance @ LUMINANCE)
    emitters = float(scene.emitter_powers().sum())
    return min(max(sky / max(sky + emitters, 1e-30), 0.2), 0.8)
