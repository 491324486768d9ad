"""How much a region of the light cache explores, and where exploring alone is better than the cache.

A region's points may see more lights than its cache holds: a wall of thousands of equal ones. Then the hierarchy alone
varies less than the cache with exploring beside it, by however much: each of the two choices has the variance of a part
of the light. So a region learns which varies less, and may leave the choice to exploring alone (CacheTables.alone).

Where both choices are made, samples tell both second moments without bias: the density by exploring alone is known of
each, and so is what it would have brought (samples.keep_light). Where exploring is alone, some samples ask for the
density by the cache, and the product of both means is estimated from above.
"""

import warp as wp

from warp_gi.kernels.light_cache import PROBED, CacheTables, choice_weight
from warp_gi.kernels.quadtree_adapt import LARGEST_CONTRIBUTION
from warp_gi.kernels.samples import LIGHT_ALONE, LIGHT_EXPLORED, LIGHT_VISIBLE

wp.set_module_options({"enable_backward": False})

SMALLEST_MOMENT = wp.constant(wp.float32(1.0e-30))
EXPLORATION_PRICE = wp.constant(wp.float32(0.1))  # share of the error that is given for exploring by all samples
FADING = wp.constant(wp.float32(0.8))  # share of moments that stays from frame to frame
PAIR_MARGIN = wp.constant(wp.float32(1.5))  # factor for differences between neighbouring points
SIGHTINGS = wp.constant(3)  # sightings of each light, on average, from which on a region starts with the cache


@wp.struct
class CacheSettings:
    capacity: wp.int32  # largest number of lights in a bucket
    hysteresis: wp.float32  # share of the capacity that must suffice for fewer buckets than before
    first_exploration: wp.float32  # share of samples that explore in regions without knowledge
    least_exploration: wp.float32  # range of that share elsewhere
    most_exploration: wp.float32
    may_be_alone: wp.int32  # 1: regions learn where exploring alone is better


# What a region has learnt about exploring.
@wp.struct
class Exploration:
    has_lights: wp.bool  # its samples could be selected by the cache
    share: wp.float32  # of samples that explore
    alone: wp.int32  # CacheTables.alone
    moments: wp.vec2  # CacheTables.moments
    excess: wp.float32  # CacheTables.excesses


# Sums over the light samples of a region of squared luminances.
@wp.struct
class LightMoments:
    offered: wp.float32  # samples by the cache
    explored: wp.float32  # samples by exploring, of lights that the cache does not offer
    excess: wp.float32  # by how much both choices together exceed exploring alone
    # of samples by exploring alone
    last: wp.float32  # luminance of the last sample
    pairs: wp.float32  # products of luminances of successive samples
    # samples among them that know the density by the cache
    alone: wp.float32  # their second moment
    cached: wp.float32  # second moment of the cache's choice; and the next: of the choice to explore beside it
    beside: wp.float32
    by_cache: wp.float32  # luminance that these two choices would bring
    by_exploring: wp.float32
    probes: wp.float32  # number of those samples


# Share of samples that explore. What exploring brings, of lights that the cache does not offer, varies with moments[1]
# over the share, and the rest with at most moments[0]. The share is that for which the former is EXPLORATION_PRICE
# times the share times the latter: somewhat less than exploring costs, as unknown lights make outliers.
@wp.func
def exploration_share(moments: wp.vec2, settings: CacheSettings) -> wp.float32:
    share = settings.least_exploration
    if moments[1] > 0.0:
        share = wp.sqrt(moments[1] / wp.max(moments[0] * EXPLORATION_PRICE, SMALLEST_MOMENT))
    return wp.clamp(share, settings.least_exploration, settings.most_exploration)


# Adds a light sample: its word, what it brought, SampleRecords.rivals, and the region's share that explores.
@wp.func
def add_light_sample(
    m: LightMoments, word: wp.uint32, value: wp.float32, rival: wp.float32, share: wp.float32
) -> LightMoments:
    r = m
    square = float(0.0)
    if value < LARGEST_CONTRIBUTION:
        square = value * value
    if (word & LIGHT_ALONE) == wp.uint32(0):
        if (word & LIGHT_EXPLORED) != wp.uint32(0):
            r.explored += square
        elif (word & LIGHT_VISIBLE) != wp.uint32(0):
            r.offered += square
        if wp.abs(rival) < LARGEST_CONTRIBUTION * LARGEST_CONTRIBUTION:
            r.excess += rival
        return r
    if square > 0.0:
        r.pairs += value * m.last
    r.last = wp.sqrt(square)
    if rival >= 0.0:
        r.probes += 1.0
    if rival >= 0.0 and square > 0.0:
        # The cache would select the light `rival` times as often as exploring alone, and exploring beside it `share`
        # times. This part of the light would come by the cache.
        part = choice_weight(rival, share) * rival / (rival + share)
        offered = float(0.0)
        if rival > 0.0:
            offered = square * part * part / rival
        explored = square * (1.0 - part) * (1.0 - part) / share
        r.offered += offered / PROBED
        if share > rival:
            r.explored += explored / PROBED
        r.alone += square / PROBED
        r.cached += offered / PROBED
        r.beside += explored / PROBED
        r.by_cache += value * part
        r.by_exploring += value * (1.0 - part)
    return r


# Excess of the variance of both choices over that of exploring alone.
#
# The variance of two independent choices is larger than the sum of their second moments tells, by twice the product of
# their means. Where exploring is alone, that is at most the root of the product of the moments, and about a product of
# the parts with the square of what a point gets, which two samples next to each other tell.
#
# A frame tells at most that the excess is as large as the moments are. A bright light that nobody knew is known from
# now on; with all that it brings when found, a region would leave the cache for ten frames.
@wp.func
def variance_excess(m: LightMoments, share: wp.float32) -> wp.float32:
    part = m.by_cache / wp.max(m.by_cache + m.by_exploring, SMALLEST_MOMENT)
    beside = m.beside + unmet_moment(m) / share
    product = wp.min(PAIR_MARGIN * part * (1.0 - part) * m.pairs, wp.sqrt(m.cached * beside))
    excess = m.excess + m.cached + beside + 2.0 * product - m.alone
    return wp.min(excess, m.offered + m.explored * share)


# Of lights that the cache does not offer, and which the few samples that asked may all have missed: as if of all that
# are remembered one more had found one.
@wp.func
def unmet_moment(m: LightMoments) -> wp.float32:
    return (1.0 - FADING) * m.alone / wp.max(m.probes, 1.0)


# What the region `origin` of the last frame knew.
@wp.func
def known_exploration(known: CacheTables, origin: wp.int32, settings: CacheSettings) -> Exploration:
    r = Exploration()
    r.share = settings.first_exploration
    r.alone = settings.may_be_alone
    r.has_lights = False
    if origin >= 0:
        r.has_lights = known.buckets[origin] > 0
        r.share = known.exploration[origin]
        r.alone = known.alone[origin]
        r.moments = known.moments[origin]
        r.excess = known.excesses[origin]
    return r


# Of a region that has met its first lights. Where it saw each of them often, few are missing.
@wp.func
def started_exploration(e: Exploration, sightings: wp.int32, lights: wp.int32, settings: CacheSettings) -> Exploration:
    r = e
    if settings.may_be_alone != 0:
        r.alone = wp.where(sightings < SIGHTINGS * lights, 1, 0)
    return r


@wp.func
def learnt_exploration(exploration: Exploration, m: LightMoments, settings: CacheSettings) -> Exploration:
    r = exploration
    r.moments = exploration.moments * FADING + wp.vec2(m.offered, m.explored * exploration.share + unmet_moment(m))
    r.share = exploration_share(r.moments, settings)
    r.excess = exploration.excess * FADING + variance_excess(m, exploration.share)
    if r.excess != 0.0 and settings.may_be_alone != 0:
        r.alone = wp.where(r.excess > 0.0, 1, 0)
    return r


@wp.func
def keep_exploration(tables: CacheTables, leaf: wp.int32, exploration: Exploration, settings: CacheSettings):
    tables.exploration[leaf] = wp.clamp(exploration.share, settings.least_exploration, settings.most_exploration)
    tables.alone[leaf] = exploration.alone
    tables.moments[leaf] = exploration.moments
    tables.excesses[leaf] = exploration.excess
