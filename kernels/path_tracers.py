"""Every path tracer that there is: each light sampler with each direction sampler."""

from warp_gi.kernels.guided_directions import GUIDED_DIRECTIONS
from warp_gi.kernels.light_cache import CACHED_LIGHTS
from warp_gi.kernels.light_hierarchy import HIERARCHY_LIGHTS
from warp_gi.kernels.path_samplers import ALIAS_LIGHTS, BSDF_DIRECTIONS, NO_REGIONS, DirectionSampler, LightSampler
from warp_gi.kernels.path_trace import PathTracer, path_tracer
from warp_gi.kernels.samples import SAMPLE_REGIONS

LIGHTS = (ALIAS_LIGHTS, HIERARCHY_LIGHTS, CACHED_LIGHTS)
DIRECTIONS = (BSDF_DIRECTIONS, GUIDED_DIRECTIONS)


def learns(lights: LightSampler, directions: DirectionSampler) -> bool:
    """Return whether one of the samplers goes by regions, and learns from the samples kept in them."""
    return lights is CACHED_LIGHTS or directions is GUIDED_DIRECTIONS


def tracer(lights: LightSampler, directions: DirectionSampler) -> PathTracer:
    """Return the path tracer of two samplers, with the regions that they need."""
    return path_tracer(lights, directions, SAMPLE_REGIONS if learns(lights, directions) else NO_REGIONS)


def every_tracer() -> list[PathTracer]:
    """Return all of them; each is a Warp module of its own, compiled when it is first launched."""
    return [tracer(lights, directions) for lights in LIGHTS for directions in DIRECTIONS]
