"""The visibility light cache: each region's lights that were seen from there lately, sampled by what they reflect.

After temporal_reuse.txt, section 4. A region's lights are spread over a power of two of buckets by the last bits of
their index. Selecting one picks a bucket at random, weighs all lights in it for the very point (ltc.py), and picks one
by weight. With a small share, and where the cache has nothing to offer, a light is explored instead, from an alias
table over all. Both ways can yield a light, and its probability is that of both together (Algorithm 1), so that
estimates are unbiased whatever the cache holds.
"""

import warp as wp

from warp_gi.kernels.alias import LARGEST_FLOAT_BELOW_ONE, alias_choice
from warp_gi.kernels.bsdf import bsdf_evaluate, luminance
from warp_gi.kernels.emitters import LightChoice, punctual_light
from warp_gi.kernels.light_cache_native import BucketWeights, LightShape, weigh_triangles
from warp_gi.kernels.ltc import LobeWeights, LtcTable, lobe_weights, triangle_weight
from warp_gi.kernels.path_samplers import LightSampler
from warp_gi.kernels.surface import Surface, ray_origin
from warp_gi.kernels.types import EMITTER_TRIANGLE, Emitter, SceneData

wp.set_module_options({"enable_backward": False})

MOST_BUCKETS = wp.constant(64)  # of a region


# The lights of every region.
@wp.struct
class CacheTables:
    buckets: wp.array(dtype=wp.int32)  # [leaf] number of buckets, a power of two or 0; above 16 bits how many are empty
    offsets: wp.array(dtype=wp.int32)  # [leaf] start in `items`
    items: wp.array(dtype=wp.int32)  # of each leaf: where its buckets end, then the emitters bucket by bucket
    exploration: wp.array(dtype=wp.float32)  # [leaf] share of samples that explore


@wp.struct
class LightCache:
    shapes: wp.array(dtype=LightShape)  # [emitter]
    emitters: wp.array(dtype=Emitter)  # [emitter] those of the scene; the rest of it would be much to hand on
    ltc: LtcTable
    tables: CacheTables


# What selection needs to know of a region: where its table is, and the shares of both ways.
@wp.struct
class CacheRegion:
    buckets: wp.int32
    items: wp.int32  # start of its table
    explores: wp.float32  # probability of exploring
    share: wp.float32  # of exploring, with what falls to it from empty buckets


@wp.struct
class Bucket:
    begin: wp.int32  # in LightCache.items
    count: wp.int32


@wp.func
def cache_region(cache: LightCache, region: wp.int32) -> CacheRegion:
    r = CacheRegion()
    word = cache.tables.buckets[region]
    r.buckets = word & 0xFFFF
    r.explores = 1.0
    r.share = 1.0
    if r.buckets > 0:
        r.items = cache.tables.offsets[region]
        r.explores = cache.tables.exploration[region]
        empty = wp.float32(word >> 16) / wp.float32(r.buckets)
        r.share = r.explores + (1.0 - r.explores) * empty
    return r


@wp.func
def bucket_of(cache: LightCache, region: CacheRegion, number: wp.int32) -> Bucket:
    r = Bucket()
    begin = int(0)
    if number > 0:
        begin = cache.tables.items[region.items + number - 1]
    r.count = cache.tables.items[region.items + number] - begin
    r.begin = region.items + region.buckets + begin
    return r


# Luminance that a surface reflects of an emitter, were nothing in between. `origin` is the point, `w` its lobes.
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
    r.weights = weigh_triangles(cache.shapes, cache.tables.items, bucket.begin, bucket.count, origin, s.shading, w)
    for k in range(bucket.count):
        if r.weights[k] < 0.0:
            r.weights[k] = light_weight(cache, s, wo, origin, w, cache.tables.items[bucket.begin + k])
        r.total += r.weights[k]
    if r.total <= 0.0:
        for k in range(bucket.count):
            r.weights[k] = 1.0
        r.total = wp.float32(bucket.count)
    return r


# Place of an emitter in its bucket, -1 if it is not there; they are sorted.
@wp.func
def find_in_bucket(cache: LightCache, bucket: Bucket, emitter: wp.int32) -> wp.int32:
    for k in range(bucket.count):
        if cache.tables.items[bucket.begin + k] == emitter:
            return k
    return -1


# Algorithm 1 of temporal_reuse.txt: either way one bucket is weighed, and once.
@wp.func
def cached_light(
    cache: LightCache, scene: SceneData, region: wp.int32, s: Surface, wo: wp.vec3, u: wp.vec2
) -> LightChoice:
    r = LightChoice()
    here = cache_region(cache, region)
    bucket = Bucket()
    rest = float(0.0)
    explores = u[0] < here.explores
    if explores:
        rest = wp.min(u[0] / here.explores, LARGEST_FLOAT_BELOW_ONE)
    else:
        position = (u[0] - here.explores) / (1.0 - here.explores) * wp.float32(here.buckets)
        number = wp.min(wp.int32(position), here.buckets - 1)
        rest = wp.min(position - wp.float32(number), LARGEST_FLOAT_BELOW_ONE)
        bucket = bucket_of(cache, here, number)
        explores = bucket.count == 0
    place = int(-1)
    if explores:
        choice = alias_choice(scene.emitters.alias, scene.emitters.count, rest, u[1])
        r.item = choice.item
        r.pdf = here.share * choice.pdf
        if here.buckets > 0:
            bucket = bucket_of(cache, here, r.item & (here.buckets - 1))
            place = find_in_bucket(cache, bucket, r.item)
        if place < 0:
            r.is_new = 1
            return r
    weighed = weigh_bucket(cache, s, wo, bucket)
    if not explores:
        left = rest * weighed.total
        for k in range(bucket.count):
            if weighed.weights[k] > 0.0:
                place = k  # the last one that can be selected, should rounding leave something
                if left < weighed.weights[k]:
                    break
                left = left - weighed.weights[k]
        r.item = cache.tables.items[bucket.begin + place]
        r.pdf = here.share * scene.emitters.alias[r.item].pdf
    share = (1.0 - here.explores) / wp.float32(here.buckets)
    r.pdf = r.pdf + share * weighed.weights[place] / weighed.total
    return r


# Probability with which cached_light selects an emitter.
@wp.func
def cached_light_pdf(
    cache: LightCache, scene: SceneData, region: wp.int32, s: Surface, wo: wp.vec3, emitter: wp.int32
) -> wp.float32:
    here = cache_region(cache, region)
    pdf = here.share * scene.emitters.alias[emitter].pdf
    if here.buckets == 0:
        return pdf
    bucket = bucket_of(cache, here, emitter & (here.buckets - 1))
    place = find_in_bucket(cache, bucket, emitter)
    if place >= 0:
        weighed = weigh_bucket(cache, s, wo, bucket)
        pdf = pdf + (1.0 - here.explores) / wp.float32(here.buckets) * weighed.weights[place] / weighed.total
    return pdf


CACHED_LIGHTS = LightSampler("cache", LightCache, cached_light, cached_light_pdf)


# Thread: an emissive triangle. Its shape as it is now.
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
        shape.luminance = luminances[emitter]
        shape.two_sided = scene.materials[scene.geometry.materials[light.triangle]].double_sided
    shapes[emitter] = shape
