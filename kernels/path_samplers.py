"""What a path asks at every vertex: which light to sample, which way to go on, what is known of the light there.

And what it meets beyond the scene, and what it leaves behind for others. A path kernel is made for one light sampler,
one direction sampler, one set of regions, one sky and one radiance cache (``path_trace.path_tracer``). Each is a tuple
of Warp functions, and a struct of the data that they get. The baselines stand here: lights by an alias table,
directions by the BSDF, no regions, the scene's sky, no cache.
"""

from typing import Any, NamedTuple

import warp as wp

from warp_gi.kernels.alias import alias_choice
from warp_gi.kernels.bsdf import Bsdf, bsdf_sample
from warp_gi.kernels.bvh import BvhHit
from warp_gi.kernels.emitters import LightChoice
from warp_gi.kernels.environment import (
    EnvironmentLookup,
    EnvironmentSample,
    environment_arrival,
    environment_lookup,
    environment_prefetch,
    environment_radiance,
    environment_sample,
)
from warp_gi.kernels.sampling import sample_1d, sample_2d
from warp_gi.kernels.surface import Surface
from warp_gi.kernels.types import ENVIRONMENT_MAP, ENVIRONMENT_NONE, SceneData

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


class ApartLights(NamedTuple):
    """Lights far brighter than they are large, which all get a ray of their own at the first vertex.

    Samples of the sky and of emitters leave them out there. Diffuse light of theirs comes by these rays alone, and
    stays apart; glossy light by the direction samples, too.
    """

    count: wp.Function  # (data) -> int
    is_sky: wp.Function  # (data, light) -> bool: whether it is a part of the sky, not an emitter
    sample: wp.Function  # (data, scene, position, light, u: vec2) -> LightSample; radiance over pdf
    lookup: wp.Function  # (data, scene, direction) -> EnvironmentLookup: of those in the sky alone
    holds_emitters: wp.Function  # (data) -> bool: whether all emitters are among them; if not, none is


class Sky(NamedTuple):
    """What a path meets where it leaves the scene: radiance, or someone who records that it came.

    `leave` is called for every way out that counts, with the weight that radiance from there has in the picture: the
    picture is the sum of weight times radiance. It is a product of f cos / pdf over the vertices, of the weight of
    multiple importance sampling, and of what roulette has made of it; radiance is not in it. So a sky that returns
    black and records sums of weight times y_j(direction) records the transfer of each y_j: relit later by any radiance
    sum_j L_j y_j, it gives sum_j L_j times them. Clamping knows nothing of such records.

    One thread at a time follows the paths of one item, in order, so `leave` may add to arrays at a place that follows
    from the path's number, without atomics. In ``trace_paths`` path = item * PathSettings.spp + sample, item being
    that of ``gbuffer.tiled_pixel``; whoever calls ``trace_path`` numbers paths as it likes, NO_PATH records nothing.
    What a camera ray sees of the sky is no path's, and not recorded. A recorder that has no use for emitters
    takes them out of its SceneData (count = 0), or paths sample them in vain.
    """

    name: str
    data: Any  # struct
    is_lit: wp.Function  # (data, scene) -> bool: whether light comes from there, or whoever leaves counts
    # (data, scene) -> bool: whether vertices sample it, too. If not, as of a constant sky, only directions that leave
    # count, with all of their weight.
    is_sampled: wp.Function
    # `first` says whether the vertex is the first one, where lights may be apart
    prefetch: wp.Function  # (data, scene, u: vec3, first): called ahead of `sample` with the same numbers
    sample: wp.Function  # (data, scene, u: vec3, first) -> EnvironmentSample
    # (data, scene, EnvironmentSample, first) -> EnvironmentLookup: asked if nothing stands in between
    arrival: wp.Function
    lookup: wp.Function  # (data, scene, direction, first) -> EnvironmentLookup, whose pdf is that of `sample`
    radiance: wp.Function  # (data, scene, direction) -> all of it, for camera rays that hit nothing
    # (data, path: int64, edges of the path from the camera to the sky: 2 is direct light, direction, weight: vec3)
    leave: wp.Function
    apart: ApartLights | None = None


class PathCache(NamedTuple):
    """What is known of the light at a vertex, so that a path may end there: a radiance cache.

    `lookup` returns what the surface reflects towards `wo` of all light that the vertex's own light and direction
    samples do not hold: of light that was reflected or scattered before, from everywhere. Direct light of emitters and
    of the sky is sampled there as without a cache. A cache that holds that light as well says so by `holds_direct`;
    then nothing is sampled where a path ends, but for the GGX lobe of surfaces for which `lobe` is not 0.
    """

    name: str
    data: Any  # struct
    # (data, scene, surface with its colour, wo in the frame of shading, BvhHit, least density [1/sr] of the directions
    # that led here: how sharply the camera sees the surface, two random numbers) -> KnownRadiance
    lookup: wp.Function
    holds_direct: bool = False  # such a cache is read from the second vertex on
    # (data, surface, wo) -> probability with which a path goes on by the GGX lobe alone, which is not in what is known;
    # 0: it is. Asked where the path would end in a cache that holds direct light.
    lobe: wp.Function | None = None
    # Whether `lookup`, and `lobe` where it tells 0 from more, go by place, geometric normal and BSDF alone. The frame
    # of shading and wo, which are zero there, are then worked out where a path goes on: a third of a surface's time.
    by_place: bool = False


# What a radiance cache says of a vertex.
@wp.struct
class KnownRadiance:
    radiance: wp.vec3  # W/(m^2 sr), reflected towards wo
    validity: wp.float32  # share of paths that end here, in [0, 1]; 0: nothing is known, 1: all of them end
    follow: wp.float32  # of a cache that holds direct light: share of these that go on all the same, and correct it


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


@wp.struct
class SceneSky:
    unused: wp.int32  # the sky is SceneData.environment


@wp.func
def scene_sky_is_lit(data: SceneSky, scene: SceneData) -> wp.bool:
    return scene.environment.kind != ENVIRONMENT_NONE


@wp.func
def scene_sky_is_sampled(data: SceneSky, scene: SceneData) -> wp.bool:
    return scene.environment.kind == ENVIRONMENT_MAP


@wp.func
def scene_sky_prefetch(data: SceneSky, scene: SceneData, u: wp.vec3, first: wp.bool):
    environment_prefetch(scene.environment, u)


@wp.func
def scene_sky_sample(data: SceneSky, scene: SceneData, u: wp.vec3, first: wp.bool) -> EnvironmentSample:
    return environment_sample(scene.environment, u)


@wp.func
def scene_sky_arrival(data: SceneSky, scene: SceneData, e: EnvironmentSample, first: wp.bool) -> EnvironmentLookup:
    return environment_arrival(scene.environment, e)


@wp.func
def scene_sky_lookup(data: SceneSky, scene: SceneData, direction: wp.vec3, first: wp.bool) -> EnvironmentLookup:
    return environment_lookup(scene.environment, direction)


@wp.func
def scene_sky_radiance(data: SceneSky, scene: SceneData, direction: wp.vec3) -> wp.vec3:
    return environment_radiance(scene.environment, direction)


# For skies that keep no record.
@wp.func
def leave_no_record(data: Any, path: wp.int64, edges: wp.int32, direction: wp.vec3, weight: wp.vec3):
    pass


@wp.struct
class NoCache:
    unused: wp.int32


@wp.func
def nothing_known(
    data: NoCache, scene: SceneData, s: Surface, wo: wp.vec3, hit: BvhHit, pdf: wp.float32, u: wp.vec2
) -> KnownRadiance:
    return KnownRadiance()


# For caches that know the light of every lobe.
@wp.func
def no_lobe(data: Any, s: Surface, wo: wp.vec3) -> wp.float32:
    return 0.0


ALIAS_LIGHTS = LightSampler("alias", AliasLights, alias_light, alias_light_pdf)
BSDF_DIRECTIONS = DirectionSampler("bsdf", BsdfDirections, bsdf_direction, bsdf_direction_pdf)
NO_REGIONS = Regions(
    "none", NoRegions, no_region, no_slot, no_vertex, keep_no_vertex, keep_no_light, keep_no_direction, keep_no_end
)
SCENE_SKY = Sky(
    "scene",
    SceneSky,
    scene_sky_is_lit,
    scene_sky_is_sampled,
    scene_sky_prefetch,
    scene_sky_sample,
    scene_sky_arrival,
    scene_sky_lookup,
    scene_sky_radiance,
    leave_no_record,
)
NO_CACHE = PathCache("none", NoCache, nothing_known)
