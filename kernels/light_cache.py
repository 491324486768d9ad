"""The visibility light cache: each region's lights that were seen from there lately, sampled by what they reflect.

After temporal_reuse.txt, section 4. The lights that matter most to a region are its first bucket; others are spread
over a power of two of buckets by the last bits of their index. Selecting one picks a bucket by what its lights may
bring to the region, weighs all of them for the very point (ltc.py), and picks one by weight. (The paper has no first
bucket, and picks buckets evenly: in a room of a hundred lamps, the near ones are in the bucket that was not picked.)

The weight of a light has a factor, its rate, for how often it is seen from the region (light_cache_build.py).

With a share of samples, and where the cache has nothing to offer, another light is explored, by the hierarchy over all
lights (or an alias table, the paper's way). Either can yield any light: both are weighed by the power heuristic, so
that estimates are unbiased whatever the cache holds. (Algorithm 1 explores instead, and mixes both probabilities. A
sample that explores in vain is then missing from the estimate: with a share e the relative variance grows by about e,
which was more than half of all there was, and made regions explore too little to find what they did not know.)

Regions that see more lights than their buckets hold leave the choice to exploring alone (light_cache_shares.py).
"""

import warp as wp

from warp_gi.kernels.alias import LARGEST_FLOAT_BELOW_ONE, alias_choice
from warp_gi.kernels.bsdf import bsdf_evaluate, luminance
from warp_gi.kernels.emitters import LightChoice, punctual_light
from warp_gi.kernels.light_cache_native import BucketWeights, LightShape, weigh_triangles
from warp_gi.kernels.light_hierarchy import LightTree, hierarchy_choice, hierarchy_pdf
from warp_gi.kernels.ltc import LobeWeights, LtcTable, lobe_weights, triangle_weight
from warp_gi.kernels.path_samplers import LightSampler
from warp_gi.kernels.surface import Surface, ray_origin, shading_normal
from warp_gi.kernels.types import EMITTER_TRIANGLE, Emitter, SceneData

wp.set_module_options({"enable_backward": False})

MOST_BUCKETS = wp.constant(64)  # largest number of buckets of a region, beside its first


# The lights that every region knows, in buckets. Kernels of light_cache_build write them between frames; paths read.
@wp.struct
class CacheTables:
    buckets: wp.array(dtype=wp.int32)  # [leaf] number of buckets: 0, 1, or 1 and a power of two
    offsets: wp.array(dtype=wp.int32)  # [leaf] start in `items` and `chances`
    items: wp.array(dtype=wp.int32)  # leaf by leaf: ends of its buckets, then emitters bucket by bucket
    rates: wp.array(dtype=wp.float32)  # [as items] factors of the weights of lights
    chances: wp.array(dtype=wp.float32)  # leaf by leaf: chance of its buckets up to this one; 1 for the last
    exploration: wp.array(dtype=wp.float32)  # [leaf] share of samples that explore, beside one of the cache
    alone: wp.array(dtype=wp.int32)  # [leaf] 1: exploring selects the only light, and the cache none
    moments: wp.array(dtype=wp.vec2)  # [leaf] second moments of light samples that do not explore, and that do
    excesses: wp.array(dtype=wp.float32)  # [leaf] excess of their sum over that of exploring alone


@wp.struct
class LightCache:
    shapes: wp.array(dtype=LightShape)  # [emitter]
    emitters: wp.array(dtype=Emitter)  # [emitter] lights of the scene
    ltc: LtcTable
    tables: CacheTables
    explores_by_tree: wp.int32  # 1: `tree`, 0: the alias table of the emitters
    tree: LightTree


# A region, as selecting a light needs it.
@wp.struct
class CacheRegion:
    buckets: wp.int32
    items: wp.int32  # start of its table in CacheTables.items
    explores: wp.float32  # probability of exploring
    alone: wp.bool  # exploring selects the only light


@wp.struct
class Bucket:
    begin: wp.int32  # in CacheTables.items
    count: wp.int32
    chance: wp.float32  # probability of being picked


@wp.func
def cache_region(cache: LightCache, region: wp.int32) -> CacheRegion:
    r = CacheRegion()
    r.buckets = cache.tables.buckets[region]
    r.explores = 1.0
    r.alone = True
    if r.buckets > 0:
        r.items = cache.tables.offsets[region]
        r.alone = cache.tables.alone[region] != 0
        if not r.alone:
            r.explores = cache.tables.exploration[region]
    return r


@wp.func
def bucket_of(tables: CacheTables, region: CacheRegion, number: wp.int32) -> Bucket:
    r = Bucket()
    begin = int(0)
    chance = float(0.0)
    if number > 0:
        begin = tables.items[region.items + number - 1]
        chance = tables.chances[region.items + number - 1]
    r.count = tables.items[region.items + number] - begin
    r.begin = region.items + region.buckets + begin
    r.chance = tables.chances[region.items + number] - chance
    return r


# Bucket and place of a light in a region that knows it.
@wp.struct
class BucketPlace:
    bucket: Bucket
    place: wp.int32  # -1: nowhere


# Place of an emitter in a bucket, -1 if it is not there; they are sorted.
@wp.func
def find_in_bucket(items: wp.array(dtype=wp.int32), bucket: Bucket, emitter: wp.int32) -> wp.int32:
    low = bucket.begin
    high = bucket.begin + bucket.count
    while low < high:
        middle = (low + high) / 2
        if items[middle] < emitter:
            low = middle + 1
        else:
            high = middle
    if low < bucket.begin + bucket.count and items[low] == emitter:
        return low - bucket.begin
    return -1


@wp.func
def find_light(tables: CacheTables, region: CacheRegion, emitter: wp.int32) -> BucketPlace:
    r = BucketPlace()
    r.place = -1
    if region.buckets > 0:
        r.bucket = bucket_of(tables, region, 0)
        r.place = find_in_bucket(tables.items, r.bucket, emitter)
        if r.place < 0 and region.buckets > 1:
            r.bucket = bucket_of(tables, region, 1 + (emitter & (region.buckets - 2)))
            r.place = find_in_bucket(tables.items, r.bucket, emitter)
    return r


# A light that the region need not know. By the hierarchy, whose probabilities depend on the point, an unknown light
# that matters there has a weight that is not far too large when it is found.
@wp.func
def explored_light(cache: LightCache, scene: SceneData, s: Surface, u: wp.vec2) -> LightChoice:
    r = LightChoice()
    if cache.explores_by_tree != 0:
        by_tree = hierarchy_choice(cache.tree, ray_origin(s), shading_normal(s), u[0], u[1])
        r.item = by_tree.item
        r.pdf = by_tree.pdf
    else:
        by_table = alias_choice(scene.emitters.alias, scene.emitters.count, u[0], u[1])
        r.item = by_table.item
        r.pdf = by_table.pdf
    return r


@wp.func
def explored_light_pdf(cache: LightCache, scene: SceneData, s: Surface, emitter: wp.int32) -> wp.float32:
    if cache.explores_by_tree != 0:
        return hierarchy_pdf(cache.tree, ray_origin(s), shading_normal(s), emitter)
    return scene.emitters.alias[emitter].pdf


# Luminance that a surface reflects of an emitter if nothing is in between. `origin` is the point, `w` its lobes.
@wp.func
def light_weight(
    cache: LightCache, s: Surface, wo: wp.vec3, origin: wp.vec3, w: LobeWeights, emitter: wp.int32
) -> wp.float32:
    light = cache.shapes[emitter]
    if light.luminance > 0.0:
        a = light.p0 - origin
        b = light.p1 - origin
        c = light.p2 - origin
        if light.two_sided == 0 and wp.dot(wp.cross(b - a, c - a), a) >= 0.0:
            return 0.0
        to_shading = wp.transpose(s.shading)
        return light.luminance * triangle_weight(w, to_shading * a, to_shading * b, to_shading * c)
    if cache.emitters[emitter].kind == EMITTER_TRIANGLE:
        return 0.0
    sample = punctual_light(cache.emitters[emitter], origin)
    if sample.pdf <= 0.0:
        return 0.0
    f = bsdf_evaluate(s.bsdf, wo, wp.transpose(s.shading) * sample.direction)
    return luminance(wp.cw_mul(f.value, sample.radiance))


# Weights of a bucket's lights and their sum: all equal where none reflects anything.
@wp.struct
class WeighedBucket:
    weights: BucketWeights
    total: wp.float32


@wp.func(inline=False)
def weigh_bucket(cache: LightCache, s: Surface, wo: wp.vec3, bucket: Bucket) -> WeighedBucket:
    r = WeighedBucket()
    w = lobe_weights(cache.ltc, s.bsdf, wo)
    origin = ray_origin(s)
    r.weights = weigh_triangles(
        cache.shapes, cache.tables.items, cache.tables.rates, bucket.begin, bucket.count, origin, s.shading, w
    )
    for k in range(bucket.count):
        if r.weights[k] < 0.0:
            weight = light_weight(cache, s, wo, origin, w, cache.tables.items[bucket.begin + k])
            r.weights[k] = weight * cache.tables.rates[bucket.begin + k]
        r.total += r.weights[k]
    if r.total <= 0.0:
        for k in range(bucket.count):
            r.weights[k] = 1.0
        r.total = wp.float32(bucket.count)
    return r


# The power heuristic's weight of a choice over that of the balance heuristic. `pdf` and `other` are the numbers of
# times that this choice and the other one are expected to select the light: where the cache offers it, exploring hardly
# counts, and so a sample that explores in vain takes nothing from the estimate.
@wp.func
def choice_weight(pdf: wp.float32, other: wp.float32) -> wp.float32:
    larger = wp.max(pdf, other)
    a = pdf / larger
    b = other / larger
    return a * (a + b) / (a * a + b * b)


# Number of times that the cache selects an emitter, a probability; or would, where exploring is alone.
@wp.func
def offered_pdf(cache: LightCache, here: CacheRegion, s: Surface, wo: wp.vec3, emitter: wp.int32) -> wp.float32:
    found = find_light(cache.tables, here, emitter)
    if found.place < 0:
        return 0.0
    weighed = weigh_bucket(cache, s, wo, found.bucket)
    return found.bucket.chance * weighed.weights[found.place] / weighed.total


PROBED = wp.constant(wp.float32(0.5))  # share of samples that ask what the cache would do, where exploring is alone


# One of all lights, as the hierarchy by itself would select it. Some ask how likely it is by the cache, so that the
# region learns whether that would be better. u[1] only adds digits to u[0].
@wp.func
def light_alone(
    cache: LightCache, scene: SceneData, here: CacheRegion, s: Surface, wo: wp.vec3, u: wp.vec2
) -> LightChoice:
    r = explored_light(cache, scene, s, u)
    r.weight = 1.0
    r.alone = 1
    r.other = -1.0
    if r.item >= 0 and here.buckets > 0 and u[1] < PROBED:
        r.other = offered_pdf(cache, here, s, wo, r.item)
    return r


# One of the lights that the cache offers; or where exploring is alone, one of all.
@wp.func
def cached_light(
    cache: LightCache, scene: SceneData, region: wp.int32, s: Surface, wo: wp.vec3, u: wp.vec2
) -> LightChoice:
    here = cache_region(cache, region)
    if here.alone:
        return light_alone(cache, scene, here, s, wo, u)
    r = LightChoice()
    r.item = -1
    if here.buckets > 0:
        number = int(0)
        while number < here.buckets - 1 and u[0] >= cache.tables.chances[here.items + number]:
            number += 1
        bucket = bucket_of(cache.tables, here, number)
        left = float(u[0])
        if number > 0:
            left = left - cache.tables.chances[here.items + number - 1]
        weighed = weigh_bucket(cache, s, wo, bucket)
        left = wp.clamp(left / bucket.chance, 0.0, LARGEST_FLOAT_BELOW_ONE) * weighed.total
        place = int(-1)
        for k in range(bucket.count):
            if weighed.weights[k] > 0.0:
                place = k  # the last one that can be selected, should rounding leave something
                if left < weighed.weights[k]:
                    break
                left = left - weighed.weights[k]
        r.item = cache.tables.items[bucket.begin + place]
        pdf = bucket.chance * weighed.weights[place] / weighed.total
        r.other = explored_light_pdf(cache, scene, s, r.item)
        explored = here.explores * r.other
        r.pdf = pdf + explored
        r.weight = choice_weight(pdf, explored)
    return r


# With the probability of exploring in the region, one of all lights.
@wp.func
def another_light(
    cache: LightCache, scene: SceneData, region: wp.int32, s: Surface, wo: wp.vec3, u: wp.vec3
) -> LightChoice:
    r = LightChoice()
    r.item = -1
    here = cache_region(cache, region)
    if u[0] < here.explores and not here.alone:
        r = explored_light(cache, scene, s, wp.vec2(u[1], u[2]))
        if r.item >= 0:
            r.other = r.pdf
            explored = here.explores * r.pdf
            pdf = offered_pdf(cache, here, s, wo, r.item)
            r.pdf = pdf + explored
            r.weight = choice_weight(explored, pdf)
            r.explores = wp.where(explored > pdf, 1, 2)
    return r


# Number of times that both together are expected to select an emitter.
@wp.func
def cached_light_pdf(
    cache: LightCache, scene: SceneData, region: wp.int32, s: Surface, wo: wp.vec3, emitter: wp.int32
) -> wp.float32:
    here = cache_region(cache, region)
    pdf = here.explores * explored_light_pdf(cache, scene, s, emitter)
    if not here.alone:
        pdf += offered_pdf(cache, here, s, wo, emitter)
    return pdf


CACHED_LIGHTS = LightSampler("cache", LightCache, cached_light, cached_light_pdf, another_light, uses_regions=True)


# Thread: an emissive triangle. Writes its shape as it is now.
@wp.kernel
def shape_lights(
    first: wp.int32, scene: SceneData, luminances: wp.array(dtype=wp.float32), shapes: wp.array(dtype=LightShape)
):
    emitter = first + wp.tid()
    light = scene.emitters.emitters[emitter]
    shape = LightShape()
    if light.kind == EMITTER_TRIANGLE:
        ids = scene.geometry.indices[light.triangle]
        shape.p0 = scene.geometry.points[ids[0]]
        shape.p1 = scene.geometry.points[ids[1]]
        shape.p2 = scene.geometry.points[ids[2]]
        if scene.emitters.grids.shape[0] > 0:  # the part that shines
            lit = scene.emitters.grids[emitter].lit
            side1 = shape.p1 - shape.p0
            side2 = shape.p2 - shape.p0
            size = lit[2] - lit[0] - lit[1]
            shape.p0 = shape.p0 + side1 * lit[0] + side2 * lit[1]
            shape.p1 = shape.p0 + side1 * size
            shape.p2 = shape.p0 + side2 * size
        shape.luminance = luminances[emitter]
        shape.two_sided = scene.materials[scene.geometry.materials[light.triangle]].double_sided
    shapes[emitter] = shape
