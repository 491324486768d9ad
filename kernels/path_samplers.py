"""What a path asks at every vertex: which light to sample, which way to go on. And what it leaves behind for others.

A path kernel is made for one light sampler, one direction sampler and one set of regions (``path_trace.path_tracer``).
Each is a tuple of Warp functions, and a struct of the data that they get. The baselines stand here: lights by an alias
table, directions by the BSDF, no regions.
"""

from typing import Any, NamedTuple

import warp as wp

from warp_gi.kernels.alias import alias_choice
from warp_gi.kernels.bsdf import Bsdf, bsdf_sample
from warp_gi.kernels.emitters import LightChoice
from warp_gi.kernels.sampling import sample_1d, sample_2d
from warp_gi.kernels.surface import Surface
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})


class LightSampler(NamedTuple):
    """Selects an emitter for a point on a surface."""

    name: str
    data: Any  # struct
    choose: wp.Function  # (data, scene, region, surface, wo, u: vec2) -> LightChoice
    pdf: wp.Function  # (data, scene, region, surface, wo, emitter) -> LightChoice.pdf of that emitter
    explore: wp.Function | None = None  # (the same as `choose`, but u: vec3) -> another LightChoice, or none
    uses_regions: bool = False  # whether it tells regions apart and learns from the samples kept in them


class DirectionSampler(NamedTuple):
    """Selects the way on from a point on a surface."""

    name: str
    data: Any  # struct
    sample: wp.Function  # (data, region, surface, wo, index, seed, dimension) -> DirectionSample
    pdf: wp.Function  # (data, region, surface, wi in the world, pdf of the BSDF) -> pdf of `sample`
    uses_regions: bool = False  # as of a LightSampler


class Regions(NamedTuple):
    """Parts of space that samplers tell apart, and where samples are kept for those who learn from them."""

    name: str
    data: Any  # struct
    find: wp.Function  # (data, scene, surface, face, u, v) -> region
    slot: wp.Function  # (data, path: int64) -> first slot of its samples, or -1: keep none
    at: wp.Function  # (data, slot, vertex) -> slot of a vertex of the path, or -1: keep none
    begin: wp.Function  # (data, slot, surface): a sample at a vertex
    light: wp.Function  # (data, slot, choice, whether it arrives, luminance that it brings to the picture)
    # (data, slot, sample, one over the distance to what it hits, throughput up to the vertex, light of the path so far)
    direction: wp.Function
    end: wp.Function  # (data, slot, vertices, light of the path)


# A direction with its density; `weight` is f cos / pdf but for the colour of a Lambert surface, see sample_weight.
@wp.struct
class DirectionSample:
    wi: wp.vec3  # world space, unit
    weight: wp.vec3
    pdf: wp.float32  # 1/sr; 0 where there is no sample
    bsdf_pdf: wp.float32  # of the BSDF alone
    bsdf_share: wp.float32  # probability of having asked the BSDF
    reflected: wp.vec3  # what the BSDF alone would have left of the light, as `weight`: goes into roulette


# A weight of a sample with the colour of a Lambert material, which may have been looked up since it was drawn.
@wp.func
def sample_weight(b: Bsdf, weight: wp.vec3) -> wp.vec3:
    if b.f90 <= 0.0:
        return wp.cw_mul(b.diffuse, weight)
    return weight


@wp.struct
class AliasLights:
    unused: wp.int32  # the table is SceneData.emitters.alias


@wp.func
def alias_light(
    data: AliasLights, scene: SceneData, region: wp.int32, s: Surface, wo: wp.vec3, u: wp.vec2
) -> LightChoice:
    choice = alias_choice(scene.emitters.alias, scene.emitters.count, u[0], u[1])
    light = LightChoice()
    light.item = choice.item
    light.pdf = choice.pdf
    light.weight = 1.0
    return light


@wp.func
def alias_light_pdf(
    data: AliasLights, scene: SceneData, region: wp.int32, s: Surface, wo: wp.vec3, emitter: wp.int32
) -> wp.float32:
    return scene.emitters.alias[emitter].pdf


# For samplers that make one choice.
@wp.func
def no_light(data: Any, scene: SceneData, region: wp.int32, s: Surface, wo: wp.vec3, u: wp.vec3) -> LightChoice:
    r = LightChoice()
    r.item = -1
    return r


@wp.struct
class BsdfDirections:
    unused: wp.int32


@wp.func
def bsdf_direction(
    data: BsdfDirections,
    region: wp.int32,
    s: Surface,
    wo: wp.vec3,
    index: wp.uint32,
    seed: wp.uint32,
    dimension: wp.int32,
) -> DirectionSample:
    r = DirectionSample()
    u_lobe = float(0.0)
    if s.bsdf.f90 > 0.0:
        u_lobe = sample_1d(index, seed, dimension)
    b = bsdf_sample(s.bsdf, wo, u_lobe, sample_2d(index, seed, dimension + 1))
    r.wi = s.shading * b.wi
    r.pdf = b.pdf
    r.bsdf_pdf = b.pdf
    r.bsdf_share = 1.0
    r.weight = b.weight
    if s.bsdf.f90 <= 0.0:
        r.weight = wp.vec3(1.0, 1.0, 1.0)
    r.reflected = r.weight
    return r


@wp.func
def bsdf_direction_pdf(
    data: BsdfDirections, region: wp.int32, s: Surface, wi: wp.vec3, bsdf_pdf: wp.float32
) -> wp.float32:
    return bsdf_pdf


@wp.struct
class NoRegions:
    unused: wp.int32


@wp.func
def no_region(data: NoRegions, scene: SceneData, s: Surface, face: wp.int32, u: wp.float32, v: wp.float32) -> wp.int32:
    return -1


@wp.func
def no_slot(data: NoRegions, path: wp.int64) -> wp.int32:
    return -1


@wp.func
def no_vertex(data: NoRegions, slot: wp.int32, vertex: wp.int32) -> wp.int32:
    return -1


@wp.func
def keep_no_vertex(data: NoRegions, slot: wp.int32, s: Surface):
    pass


@wp.func
def keep_no_light(data: NoRegions, slot: wp.int32, choice: LightChoice, visible: wp.int32, light: wp.float32):
    pass


@wp.func
def keep_no_direction(
    data: NoRegions,
    slot: wp.int32,
    sample: DirectionSample,
    nearness: wp.float32,
    carried: wp.float32,
    light: wp.float32,
):
    pass


@wp.func
def keep_no_end(data: NoRegions, slot: wp.int32, vertices: wp.int32, light: wp.float32):
    pass


ALIAS_LIGHTS = LightSampler("alias", AliasLights, alias_light, alias_light_pdf)
BSDF_DIRECTIONS = DirectionSampler("bsdf", BsdfDirections, bsdf_direction, bsdf_direction_pdf)
NO_REGIONS = Regions(
    "none", NoRegions, no_region, no_slot, no_vertex, keep_no_vertex, keep_no_light, keep_no_direction, keep_no_end
)
