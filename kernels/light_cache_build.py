"""Making a region's light cache from the last frame's samples (temporal_reuse.txt, section 4.1).

Lights that a region's samples saw are listed once each (`list_seen_lights`), joined with those of its six neighbours
and with what it knew before (`join_lights`), rated by how often samples see them (`weigh_light_samples`), ranked
(`rank_lights`), and spread over buckets (`count_buckets`, `fill_buckets`). Lists are sorted by emitter, so joining is
a merge, and buckets come out sorted. An entry is emitter << 8 | frames since a sample of the region or its neighbours
saw it: a light that is seen rarely stays for some frames, which the paper leaves for future work (section 8).
"""

import warp as wp

from warp_gi.kernels.bsdf import luminance
from warp_gi.kernels.light_cache import MOST_BUCKETS, CacheTables, LightCache
from warp_gi.kernels.light_cache_shares import (
    CacheSettings,
    LightMoments,
    add_light_sample,
    keep_exploration,
    known_exploration,
    learnt_exploration,
    started_exploration,
)
from warp_gi.kernels.octree import NEIGHBOURS, Octree, OctreeNodes, leaf_cell
from warp_gi.kernels.samples import (
    LIGHT_BLOCKED,
    LIGHT_EXPLORED,
    LIGHT_ITEM,
    LIGHT_VISIBLE,
    LeafSamples,
    SampleRecords,
)
from warp_gi.kernels.sampling import spread_place
from warp_gi.kernels.types import EMITTER_DIRECTIONAL, EMITTER_TRIANGLE

wp.set_module_options({"enable_backward": False})

MOST_LISTED = wp.constant(1024)  # largest number of lights in the list of a region
FREE = wp.constant(-1)
LISTS = 8  # number of lists that are joined: a region's, its six neighbours', and that of the last frame
ListEnds = wp.types.vector(length=LISTS, dtype=wp.int32)
LATEST = wp.constant(0x7FFFFFFF)


# Lists of lights by leaf. In every kernel here a thread writes its own leaf's entries alone.
@wp.struct
class LightLists:
    offsets: wp.array(dtype=wp.int32)  # [leaf] start in `entries`
    counts: wp.array(dtype=wp.int32)  # [leaf] number of entries
    entries: wp.array(dtype=wp.int32)
    tries: wp.array(dtype=wp.vec2)  # of each entry: (samples that saw it, all that tried), or empty


# Ascending order, by Shell's method.
@wp.func
def sort_entries(entries: wp.array(dtype=wp.int32), begin: wp.int32, count: wp.int32):
    gap = int(1)
    while gap < count:
        gap = gap * 3 + 1
    while gap > 0:
        for i in range(gap, count):
            value = entries[begin + i]
            j = int(i)
            while j >= gap and entries[begin + j - gap] > value:
                entries[begin + j] = entries[begin + j - gap]
                j -= gap
            entries[begin + j] = value
        gap = gap / 3


# Thread: a leaf. Lists the lights that its samples saw, by way of a hash table. Its room in `entries` begins at twice
# the start of its samples, and is twice as large as their number.
@wp.kernel
def list_seen_lights(first: wp.int32, samples: LeafSamples, lights: wp.array(dtype=wp.uint32), seen: LightLists):
    leaf = first + wp.tid()
    count = samples.counts[leaf]
    begin = 2 * samples.starts[leaf]
    seen.offsets[leaf] = begin
    size = int(1)
    while size * 2 <= 2 * count:
        size = size * 2
    for i in range(size * wp.min(count, 1)):
        seen.entries[begin + i] = FREE
    looks = wp.min(count, samples.most)
    found = int(0)
    for k in range(looks):
        word = lights[samples.order[samples.starts[leaf] + spread_place(k, looks, count)]]
        if (word & LIGHT_VISIBLE) != wp.uint32(0) and found < MOST_LISTED:
            entry = (wp.int32(word & LIGHT_ITEM) - 1) << 8
            place = wp.int32((wp.uint32(entry) * wp.uint32(0x9E3779B1)) >> wp.uint32(12)) & (size - 1)
            while seen.entries[begin + place] != FREE and seen.entries[begin + place] != entry:
                place = (place + 1) & (size - 1)
            if seen.entries[begin + place] == FREE:
                seen.entries[begin + place] = entry
                found += 1
    listed = int(0)
    for i in range(size * wp.min(found, 1)):
        entry = seen.entries[begin + i]
        if entry != FREE:
            seen.entries[begin + listed] = entry
            listed += 1
    sort_entries(seen.entries, begin, found)
    seen.counts[leaf] = found


# Thread: a leaf. Takes over what its leaf of the last tree knew, whose lists and buckets both read from then on.
@wp.kernel
def take_over_lights(
    first: wp.int32,
    origins: wp.array(dtype=wp.int32),
    known: LightLists,
    known_tables: CacheTables,
    lists: LightLists,
    tables: CacheTables,
):
    leaf = first + wp.tid()
    origin = origins[leaf]
    if origin < 0:  # the arrays hold what is known at first
        return
    lists.offsets[leaf] = known.offsets[origin]
    lists.counts[leaf] = known.counts[origin]
    tables.buckets[leaf] = known_tables.buckets[origin]
    tables.offsets[leaf] = known_tables.offsets[origin]
    tables.exploration[leaf] = known_tables.exploration[origin]
    tables.alone[leaf] = known_tables.alone[origin]
    tables.moments[leaf] = known_tables.moments[origin]
    tables.excesses[leaf] = known_tables.excesses[origin]


# Thread: a leaf. Writes the largest length that its joined list can have.
@wp.kernel
def bound_lists(
    first: wp.int32,
    seen: LightLists,
    known: LightLists,
    neighbours: wp.array(dtype=wp.int32),
    origins: wp.array(dtype=wp.int32),
    bounds: wp.array(dtype=wp.int32),
):
    leaf = first + wp.tid()
    bound = int(0)
    if origins[leaf] >= 0:
        bound = seen.counts[leaf] + known.counts[origins[leaf]]
        for face in range(NEIGHBOURS):
            neighbour = neighbours[leaf * NEIGHBOURS + face]
            if neighbour >= 0:
                bound += seen.counts[neighbour]
    bounds[leaf] = wp.min(bound, MOST_LISTED)


# Thread: a leaf. Joins the lights that it and its neighbours saw with those that it knew. It finds the bound by
# bound_lists in `joined.counts`, and replaces it by the length. A light stays for `memory` frames after it was seen.
@wp.kernel
def join_lights(
    first: wp.int32,
    seen: LightLists,
    known: LightLists,
    neighbours: wp.array(dtype=wp.int32),
    origins: wp.array(dtype=wp.int32),
    joined: LightLists,
    memory: wp.int32,
):
    leaf = first + wp.tid()
    begin = joined.offsets[leaf]
    most = joined.counts[leaf]
    heads = ListEnds()
    ends = ListEnds()
    if most > 0:
        heads[0] = seen.offsets[leaf]
        ends[0] = heads[0] + seen.counts[leaf]
        heads[7] = known.offsets[origins[leaf]]
        ends[7] = heads[7] + known.counts[origins[leaf]]
        for face in range(NEIGHBOURS):
            neighbour = neighbours[leaf * NEIGHBOURS + face]
            if neighbour >= 0:
                heads[1 + face] = seen.offsets[neighbour]
                ends[1 + face] = heads[1 + face] + seen.counts[neighbour]
    count = int(0)
    while count < most:
        entry = int(LATEST)
        for k in range(7):
            if heads[k] < ends[k]:
                entry = wp.min(entry, seen.entries[heads[k]])
        if heads[7] < ends[7]:
            entry = wp.min(entry, known.entries[heads[7]] + 1)
        if entry == LATEST:
            break
        tries = wp.vec2(0.0, 0.0)
        for k in range(7):
            if heads[k] < ends[k] and (seen.entries[heads[k]] >> 8) == (entry >> 8):
                heads[k] = heads[k] + 1
        if heads[7] < ends[7] and (known.entries[heads[7]] >> 8) == (entry >> 8):
            tries = known.tries[heads[7]]
            heads[7] = heads[7] + 1
        if (entry & 255) <= memory:
            joined.entries[begin + count] = entry
            joined.tries[begin + count] = tries
            count += 1
    joined.counts[leaf] = count


MOST_TRIES = wp.constant(wp.float32(32.0))  # largest number of tries of a light that are remembered


# Factor for the weight of a light that `tries` (seen, all) of a region's samples tried. A light that a share r of them
# sees has second moments r times as large there, and the best density goes by their root. Starts from one half.
@wp.func
def visibility_rate(tries: wp.vec2) -> wp.float32:
    return wp.sqrt((tries[0] + 0.5) / (tries[1] + 1.0))


# Place of an emitter's entry in a leaf's list, -1 if it is not there.
@wp.func
def find_entry(lists: LightLists, leaf: wp.int32, emitter: wp.int32) -> wp.int32:
    low = lists.offsets[leaf]
    end = low + lists.counts[leaf]
    high = int(end)
    while low < high:
        middle = (low + high) / 2
        if (lists.entries[middle] >> 8) < emitter:
            low = middle + 1
        else:
            high = middle
    if low < end and (lists.entries[low] >> 8) == emitter:
        return low
    return -1


# Thread: a leaf. Counts how often each of its lights was tried by its samples, and how often seen; and learns how
# much to explore, and whether to do so alone.
@wp.kernel
def weigh_light_samples(
    first: wp.int32,
    settings: CacheSettings,
    samples: LeafSamples,
    records: SampleRecords,
    joined: LightLists,
    origins: wp.array(dtype=wp.int32),
    known: CacheTables,
    tables: CacheTables,
):
    leaf = first + wp.tid()
    exploration = known_exploration(known, origins[leaf], settings)
    count = samples.counts[leaf]
    looks = wp.min(count, samples.most)
    m = LightMoments()
    sightings = int(0)
    for k in range(looks):
        slot = samples.order[samples.starts[leaf] + spread_place(k, looks, count)]
        word = records.lights[slot]
        m = add_light_sample(m, word, records.light_values[slot], records.rivals[slot], exploration.share)
        was_tried = (word & (LIGHT_VISIBLE | LIGHT_BLOCKED)) != wp.uint32(0)
        if was_tried and (word & LIGHT_EXPLORED) == wp.uint32(0):
            place = find_entry(joined, leaf, wp.int32(word & LIGHT_ITEM) - 1)
            seen = wp.int32((word & LIGHT_VISIBLE) != wp.uint32(0))
            sightings += seen
            if place >= 0:
                joined.tries[place] = joined.tries[place] + wp.vec2(wp.float32(seen), 1.0)
    if exploration.has_lights and count > 0:
        exploration = learnt_exploration(exploration, m, settings)
    elif count > 0:  # all of the light came by exploring, which says nothing of what the cache would do
        exploration = started_exploration(exploration, sightings, joined.counts[leaf], settings)
    keep_exploration(tables, leaf, exploration, settings)
    begin = joined.offsets[leaf]
    for i in range(begin, begin + joined.counts[leaf]):
        tries = joined.tries[i]
        if tries[1] > MOST_TRIES:
            joined.tries[i] = tries * (MOST_TRIES / tries[1])


MAIN = wp.constant(wp.float32(-1.0))  # stands for the importance of lights in the first bucket
LEAST_CHANCE = wp.constant(wp.float32(0.02))  # chance that is shared evenly by all buckets


# Irradiance that a light may bring to surfaces in a region around `center` that face it.
@wp.func
def region_importance(cache: LightCache, emitter: wp.int32, center: wp.vec3, radius: wp.float32) -> wp.float32:
    shape = cache.shapes[emitter]
    if shape.luminance > 0.0:
        cross = wp.cross(shape.p1 - shape.p0, shape.p2 - shape.p0)
        away = center - (shape.p0 + shape.p1 + shape.p2) / 3.0
        square = wp.length_sq(away) + radius * radius
        facing = 0.5 * wp.dot(cross, away)  # area times cosine times distance
        if shape.two_sided != 0:
            facing = wp.abs(facing)
        facing = wp.max(facing, 0.0) + 0.5 * wp.length(cross) * radius
        return shape.luminance * facing / (square * wp.sqrt(square))
    light = cache.emitters[emitter]
    if light.kind == EMITTER_TRIANGLE:
        return 0.0
    if light.kind == EMITTER_DIRECTIONAL:
        return luminance(light.intensity)
    return luminance(light.intensity) / (wp.length_sq(light.position - center) + radius * radius)


# Thread: a leaf. Writes the irradiance that each of its lights may bring, or MAIN for those that matter most, which go
# to the first bucket; `sums` gets the irradiance of the latter together.
@wp.kernel
def rank_lights(
    first: wp.int32,
    cache: LightCache,
    octree: Octree,
    tree: OctreeNodes,
    joined: LightLists,
    capacity: wp.int32,
    importances: wp.array(dtype=wp.float32),
    sums: wp.array(dtype=wp.float32),
):
    leaf = first + wp.tid()
    count = joined.counts[leaf]
    begin = joined.offsets[leaf]
    cell = leaf_cell(octree, tree, leaf)
    center = wp.vec3(cell[0], cell[1], cell[2])
    for i in range(begin, begin + count):
        importance = region_importance(cache, joined.entries[i] >> 8, center, cell[3])
        importances[i] = importance * visibility_rate(joined.tries[i])
    total = float(0.0)
    if count <= capacity:  # all of them
        for i in range(begin, begin + count):
            total += importances[i]
            importances[i] = MAIN
        count = 0
    for _k in range(wp.min(capacity, count)):
        best = begin
        for i in range(begin, begin + count):
            if importances[i] > importances[best]:
                best = i
        total += importances[best]
        importances[best] = MAIN
    sums[leaf] = total


# Number of lights in the fullest of `buckets` buckets for lights that are not MAIN; the emitter's last bits decide.
@wp.func
def fullest_bucket(
    joined: LightLists, importances: wp.array(dtype=wp.float32), leaf: wp.int32, buckets: wp.int32
) -> wp.int32:
    begin = joined.offsets[leaf]
    most = int(0)
    for bucket in range(buckets):
        held = int(0)
        for i in range(begin, begin + joined.counts[leaf]):
            if importances[i] >= 0.0 and ((joined.entries[i] >> 8) & (buckets - 1)) == bucket:
                held += 1
        most = wp.max(most, held)
    return most


# Thread: a leaf. Writes the number of its buckets, the least that hold its lights, and the size of its table.
@wp.kernel
def count_buckets(
    first: wp.int32,
    settings: CacheSettings,
    joined: LightLists,
    importances: wp.array(dtype=wp.float32),
    origins: wp.array(dtype=wp.int32),
    known: wp.array(dtype=wp.int32),
    buckets: wp.array(dtype=wp.int32),
    sizes: wp.array(dtype=wp.int32),
):
    leaf = first + wp.tid()
    count = joined.counts[leaf]
    chosen = wp.min(count, 1)
    if count > settings.capacity:
        before = known[origins[leaf]] - 1
        others = int(1)
        while others < MOST_BUCKETS:
            limit = settings.capacity
            if others < before:
                limit = wp.max(wp.int32(wp.float32(settings.capacity) * settings.hysteresis), 1)
            if fullest_bucket(joined, importances, leaf, others) <= limit:
                break
            others = others * 2
        chosen = 1 + others
    buckets[leaf] = chosen
    sizes[leaf] = chosen + count


# Thread: a leaf. Spreads its lights over its buckets; lights that do not fit into the last one are left to exploration.
# A bucket's chance follows the irradiance that its lights may bring, but none has a chance of 0.
@wp.kernel
def fill_buckets(
    first: wp.int32,
    settings: CacheSettings,
    joined: LightLists,
    importances: wp.array(dtype=wp.float32),
    sums: wp.array(dtype=wp.float32),
    tables: CacheTables,
):
    leaf = first + wp.tid()
    buckets = tables.buckets[leaf]
    begin = joined.offsets[leaf]
    start = tables.offsets[leaf]
    place = int(0)
    filled = int(0)
    total = float(0.0)
    for bucket in range(buckets):
        held = int(0)
        brought = float(0.0)
        for i in range(begin, begin + joined.counts[leaf]):
            emitter = joined.entries[i] >> 8
            belongs = importances[i] < 0.0
            if bucket > 0:
                belongs = not belongs and (emitter & (buckets - 2)) == bucket - 1
            if belongs and held < settings.capacity:
                tables.items[start + buckets + place] = emitter
                tables.rates[start + buckets + place] = visibility_rate(joined.tries[i])
                place += 1
                held += 1
                brought += wp.max(importances[i], 0.0)
        if bucket == 0:
            brought = sums[leaf]
        tables.items[start + bucket] = place
        tables.chances[start + bucket] = wp.where(held > 0, brought, MAIN)
        filled += wp.min(held, 1)
        total += brought
    sum = float(0.0)
    for bucket in range(buckets):
        brought = tables.chances[start + bucket]
        if brought >= 0.0:
            share = 1.0 / wp.float32(filled)
            if total > 0.0:
                share = LEAST_CHANCE * share + (1.0 - LEAST_CHANCE) * brought / total
            sum += share
        tables.chances[start + bucket] = sum
    # the last bucket that holds anything, and empty ones behind it, end at 1 whatever rounding left
    for bucket in range(buckets):
        if tables.chances[start + bucket] >= sum:
            tables.chances[start + bucket] = 1.0
