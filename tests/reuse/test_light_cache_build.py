"""Making the tables of the visibility light cache from samples, against NumPy sets and plain loops."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from light_cache_tools import (
    ALONE,
    BLOCKED,
    EXPLORED,
    ITEM,
    LUMINANCE,
    OUTCOMES,
    PLACES,
    VISIBLE,
    array,
    asked,
    choices,
    contents_of,
    deep_lesson,
    entries_of,
    explored,
    keep_lights,
    leaf_samples,
    light_values,
    lists,
    lit_cache,
    lit_scene,
    preprocessed,
    probabilities,
    rate_of,
    rates_of,
    records_of,
    some_tries,
    spots_in,
    table,
    tries_of,
    weigh_lights,
    words,
)
from statistics_tools import device, every_device  # noqa: F401

import warp_gi as gi
from warp_gi.kernels import light_cache, light_cache_build, light_cache_native, octree, samples, types
from warp_gi.launch import copied, launch, set_threads
from warp_gi.techniques.reuse.light_cache import EXPLORES_BY, CacheState

wp.set_module_options({"enable_backward": False})

MOST_LISTED = 1024
MOST_BUCKETS = 64  # beside the first
LEAST_CHANCE = 0.02
MOST_TRIES = 32
FADING = 0.8
PRICE = 0.1  # of exploring
PROBED = 0.5  # of samples that explore alone, those that ask what the cache would do
PAIR_MARGIN = 1.5
LEARNT_TABLES = ("moments", "exploration", "excesses", "alone")
SIGHTINGS = 3
LARGEST = 1e15  # samples beyond say nothing
MAIN = -1.0


# What a light may bring to each of the places (centre, radius).
@wp.kernel
def ask_importances(
    first: wp.int32,
    cache: light_cache.LightCache,
    places: wp.array(dtype=wp.vec4),
    importances: wp.array2d(dtype=wp.float32),
):
    item = first + wp.tid()
    i = item / importances.shape[1]
    emitter = item - i * importances.shape[1]
    place = places[i]
    center = wp.vec3(place[0], place[1], place[2])
    importances[i, emitter] = light_cache_build.region_importance(cache, emitter, center, place[3])


@wp.kernel
def ask_cells(first: wp.int32, cube: octree.Octree, tree: octree.OctreeNodes, cells: wp.array(dtype=wp.vec4)):
    leaf = first + wp.tid()
    cells[leaf] = octree.leaf_cell(cube, tree, leaf)


# ---- lists of lights ----


def listed(grouped, word):
    seen = lists([[]] * grouped.counts.shape[0])
    seen.entries = wp.empty(2 * grouped.order.shape[0], dtype=wp.int32, device=device())
    inputs = [grouped, array(word, wp.uint32), seen]
    launch(light_cache_build.list_seen_lights, grouped.counts.shape[0], inputs, device(), 16)
    return entries_of(seen)


@pytest.mark.parametrize("most", [1, 7, 1000, 1 << 20])
def test_lists_hold_the_lights_that_samples_saw(most):
    rng = np.random.default_rng(most)
    counts = np.array([0, 1, 2, 3, 0, 5, 64, 65, 1000, 4000, 6000, 0])
    total = counts.sum()
    emitters = rng.integers(-1, 40, total)
    emitters[-6000:] = rng.permutation(1 << 20)[:6000]  # more than are listed
    emitters[2:3] = (1 << 23) - 1
    visible = (rng.random(total) < 0.5) & (emitters >= 0)
    visible[[0, 2]] = True
    blind = rng.choice([0, BLOCKED], total)
    word = words(emitters, np.where(visible, VISIBLE | rng.choice([0, EXPLORED], total), blind), rng)
    order = rng.permutation(total)
    slots = np.empty(total, np.int64)
    slots[order] = word
    found = listed(leaf_samples(counts, order, most), slots)
    end = np.cumsum(counts)
    for leaf, count in enumerate(counts):
        looks = min(count, most)
        lights = set()
        for k in range(looks):
            w = int(word[end[leaf] - count + k * count // looks])
            if w & VISIBLE and len(lights) < MOST_LISTED:
                lights.add((w & ITEM) - 1)
        assert found[leaf] == [e << 8 for e in sorted(lights)]
    assert most < 1 << 20 or len(found[10]) == MOST_LISTED


def test_looks_are_spread():
    """Every sample saw another light, so the list says which were looked at."""
    rng = np.random.default_rng(1)
    count, most = 1000, 300
    found = listed(leaf_samples([count], np.arange(count), most), words(np.arange(count), VISIBLE, rng))
    looked = np.array(found[0]) >> 8
    assert len(looked) == most and set(np.diff(looked)) == {3, 4} and looked[0] < 4 and looked[-1] >= count - 4


def test_hash_collisions():
    """Lights whose hashes agree in all bits that a small table uses, up to a table that is half full."""
    rng = np.random.default_rng(2)
    emitters = np.arange(1 << 22)
    hashes = (((emitters << 8) * 0x9E3779B1) & 0xFFFFFFFF) >> 12
    same = emitters[(hashes & 1023) == 1023][:900]
    found = listed(leaf_samples([900], np.arange(900), 900), words(same, VISIBLE, rng))
    assert found[0] == [e << 8 for e in same]


def test_leaves_do_not_disturb_each_other():
    """Threads may run in any order: the places of inner cells must leave alone what the leaves within them write."""
    _, lesson = deep_lesson()
    grouped, leaves = lesson.leaf_samples(1 << 20), np.flatnonzero(lesson.origins.numpy() >= 0)
    assert len(leaves) < lesson.octree.leaf_count
    results = []
    for order in (range(lesson.octree.leaf_count), reversed(range(lesson.octree.leaf_count))):
        seen = lists([[]] * lesson.octree.leaf_count)
        seen.entries = wp.zeros(2 * grouped.order.shape[0], dtype=wp.int32, device=device())
        for leaf in order:
            inputs = [leaf, grouped, lesson.records.lights, seen]
            wp.launch(light_cache_build.list_seen_lights, dim=1, inputs=inputs, device=device(), record_tape=False)
        found = entries_of(seen)
        results.append([found[leaf] for leaf in leaves])
    wrong = sum(a != b for a, b in zip(*results, strict=True))
    assert wrong == 0, f"{wrong} of {len(leaves)} leaves"


# ---- joining ----


def joined(seen, known, tries, neighbours, origins, memory):
    """Return entries of each leaf, and their tries; ``tries`` are those of what is known."""
    out, leaves = lists([[]] * len(seen)), len(seen)
    around = [lists(seen), lists(known, tries), array(np.ravel(neighbours)), array(origins)]
    launch(light_cache_build.bound_lists, leaves, [*around, out.counts], device())
    counts = out.counts.numpy().copy()
    out.offsets = array(np.cumsum(counts) - counts)
    out.entries = wp.full(int(counts.sum()), -7, dtype=wp.int32, device=device())
    out.tries = wp.full(int(counts.sum()), wp.vec2(-7.0, -7.0), dtype=wp.vec2, device=device())
    launch(light_cache_build.join_lights, leaves, [*around, out, memory], device())
    return entries_of(out), tries_of(out)


def expected_join(seen, known, tries, neighbours, origins, memory):
    entries, carried = [], []
    for leaf, origin in enumerate(origins):
        ages, before = {}, {}
        if origin >= 0:
            ages = {e >> 8: (e & 255) + 1 for e in known[origin]}
            before = {e >> 8: list(t) for e, t in zip(known[origin], tries[origin], strict=True)}
            for other in (leaf, *(n for n in neighbours[leaf] if n >= 0)):
                ages |= {e >> 8: 0 for e in seen[other]}
        entries.append([e << 8 | age for e, age in sorted(ages.items()) if age <= memory][:MOST_LISTED])
        carried.append([before.get(e >> 8, [0.0, 0.0]) for e in entries[-1]])
    return entries, carried


@pytest.mark.parametrize("memory", [0, 1, 4, 200])
def test_joined_lists_are_unions(memory):
    rng = np.random.default_rng(memory)
    leaves, places = 60, 25
    pools = [8, 60, 500, 1 << 23]

    def some(ages):
        count = int(rng.choice([0, 1, 2, 10, 200]))
        emitters = np.unique(rng.integers(0, rng.choice(pools), count))
        return [int(e) << 8 | int(rng.integers(0, ages + 1)) for e in emitters]

    seen, known = [some(0) for _ in range(leaves)], [some(memory) for _ in range(places)]
    tries = [some_tries(rng, len(x)).tolist() for x in known]
    neighbours = np.where(rng.random((leaves, 6)) < 0.7, rng.integers(0, leaves, (leaves, 6)), -1)
    origins = np.where(rng.random(leaves) < 0.9, rng.integers(0, places, leaves), -1)
    found = joined(seen, known, tries, neighbours, origins, memory)
    assert found == expected_join(seen, known, tries, neighbours, origins, memory)
    carried = {tuple(t) for x in found[1] for t in x}
    assert (0.0, 0.0) in carried and (memory == 0 or len(carried) > 8)


def test_joined_lists_end():
    """Of more than 1,024 lights the first are kept, of whichever list."""
    own, others, old = range(0, 3000, 3), range(1, 3000, 3), range(2, 3000, 3)
    seen = [[e << 8 for e in own], [e << 8 for e in others]]
    tries = [[(float(k % 8), 8.0) for k in range(len(old))]]
    found, carried = joined(seen, [[e << 8 for e in old]], tries, [[1] + [-1] * 5, [-1] * 6], [0, -1], 4)
    assert [e >> 8 for e in found[0]] == list(range(MOST_LISTED)) and found[1] == []
    assert carried[0] == [[e // 3 % 8, 8] if e % 3 == 2 else [0, 0] for e in range(MOST_LISTED)] and carried[1] == []


# ---- which lights matter most to a region ----


def importances_of(data, places):
    """Kernel: float32 [place, emitter] of places (centre, radius)."""
    out = wp.empty((len(places), data.shapes.shape[0]), dtype=wp.float32, device=device())
    launch(ask_importances, out.size, [data, array(places, wp.vec4), out], device())
    return out.numpy()


def cells_of(lesson):
    cells = wp.empty(lesson.octree.leaf_count, dtype=wp.vec4, device=device())
    launch(ask_cells, cells.size, [lesson.octree.octree, lesson.tree, cells], device())
    return cells.numpy()


def expected_importances(data, places):
    """Float64: irradiance but for the receiver's slant, by lights as if at their middle and a radius farther away."""
    shapes, rows = data.shapes.numpy(), data.emitters.numpy()
    out = np.zeros((len(places), len(rows)))
    for i, (*center, radius) in enumerate(places.astype(np.float64)):
        for k, (shape, row) in enumerate(zip(shapes, rows, strict=True)):
            if row["kind"] == types.EMITTER_TRIANGLE:
                p0, p1, p2 = (shape[name].astype(np.float64) for name in ("p0", "p1", "p2"))
                to_place, normal = center - (p0 + p1 + p2) / 3, np.cross(p1 - p0, p2 - p0)
                area = np.linalg.norm(normal) / 2
                height = to_place @ normal / (2 * area)  # cosine times distance
                height = abs(height) if shape["two_sided"] else max(height, 0)
                out[i, k] = shape["luminance"] * area * (height + radius) / (to_place @ to_place + radius**2) ** 1.5
                continue
            out[i, k] = row["intensity"] @ LUMINANCE
            if row["kind"] != types.EMITTER_DIRECTIONAL:
                out[i, k] /= ((row["position"] - center) ** 2).sum() + radius**2
    return out


def dimmed_cache():
    """LightCache of lit_scene, in which every tenth light emits nothing."""
    frame, _ = preprocessed(lit_scene())
    data = frame.paths.lights.data
    shapes = data.shapes.numpy().copy()
    shapes["luminance"][::10] = 0.0
    data.shapes = wp.array(shapes, dtype=light_cache_native.LightShape, device=device())
    return data


def test_importance_of_lights():
    """Of every sort, from afar, from near, and around the light itself."""
    data = dimmed_cache()
    rng = np.random.default_rng(8)
    shapes, rows = data.shapes.numpy(), data.emitters.numpy()
    centers = rng.uniform(-6, 6, (60, 3))
    centers[:5], centers[5:8] = shapes["p0"][1:6], rows["position"][[200, 201, 201]]
    places = np.concatenate([centers, 10 ** rng.uniform(-3, 1, (60, 1))], axis=1).astype(np.float32)
    found, expected = importances_of(data, places), expected_importances(data, places)
    assert np.array_equal(expected == 0, found == 0) and (found == 0).sum() == 60 * 20  # 200 is a point light
    assert np.allclose(found, expected, rtol=2e-4, atol=1e-6)
    back = ~shapes["two_sided"].astype(bool) & (rows["kind"] == types.EMITTER_TRIANGLE)
    assert {*rows["kind"]} == {0, 1, 2, 3} and back.any() and (shapes["two_sided"] == 1).any()


@pytest.mark.parametrize("capacity", [1, 5, 32])
def test_lights_that_matter_most(capacity):
    """By importance times rate, against NumPy's order; lights of equal importance may swap places."""
    data = dimmed_cache()
    _, lesson = deep_lesson()
    rng = np.random.default_rng(capacity)
    places = cells_of(lesson)
    leaves = len(places)
    emitters = [np.sort(rng.choice(203, n, replace=False)) for n in rng.choice([0, 1, 5, 31, 32, 33, 150], leaves)]
    emitters[3] = np.arange(0, 200, 10)  # that emit nothing
    tries = [some_tries(rng, len(x)) for x in emitters]
    given = lists([[int(e) << 8 | 3 for e in x] for x in emitters], tries)
    given.offsets = array(given.offsets.numpy() + 7)
    given.entries = array(np.concatenate([np.full(7, -1), given.entries.numpy()]))
    given.tries = array(np.concatenate([np.full((7, 2), -1), given.tries.numpy()]), wp.vec2)
    out = wp.full(given.entries.shape[0], -5.0, dtype=wp.float32, device=device())
    sums = wp.full(leaves, -5.0, dtype=wp.float32, device=device())
    inputs = [data, lesson.octree.octree, lesson.tree, given, capacity, out, sums]
    launch(light_cache_build.rank_lights, leaves, inputs, device())
    found, expected = out.numpy(), importances_of(data, places)
    assert (found[:7] == -5).all(), "a leaf that wrote into another's place"
    for leaf, offset in enumerate(given.offsets.numpy()):
        here = found[offset : offset + len(emitters[leaf])]
        all_of_them = expected[leaf, emitters[leaf]] * rate_of(tries[leaf])
        main = here == MAIN
        assert main.sum() == min(capacity, len(here))
        assert np.allclose(here[~main], all_of_them[~main], rtol=1e-5)
        if main.any() and not main.all():
            assert all_of_them[main].min() >= all_of_them[~main].max() * (1 - 1e-5)
        assert np.isclose(sums.numpy()[leaf], all_of_them[main].sum(), rtol=1e-5)


# ---- buckets ----


def settings_of(capacity=32, hysteresis=0.75, exploration=(0.1, 0.05, 0.75)):
    s = light_cache_build.CacheSettings()
    s.capacity, s.hysteresis = capacity, hysteresis
    s.may_be_alone = int(exploration[1] < exploration[2])
    s.first_exploration, s.least_exploration, s.most_exploration = exploration
    return s


def bucketed(emitters, importances, before, capacity, tries=None):
    """CacheTables of regions with these emitters, that had ``before`` buckets."""
    settings, leaves = settings_of(capacity), len(emitters)
    given = lists([[int(e) << 8 | 1 for e in x] for x in emitters], tries)
    ranked, sums = [], []
    for values in importances:
        main = most_important(values, capacity)
        sums.append(values[main].sum())
        ranked.append(np.where(main, MAIN, values))
    ranked, sums = array(np.concatenate(ranked), wp.float32), array(sums, wp.float32)
    tables = light_cache.CacheTables()
    known = array(before[::-1])  # origins are in another order
    tables.buckets, sizes = (wp.empty(leaves, dtype=wp.int32, device=device()) for _ in range(2))
    tables.exploration = wp.full(leaves, 0.1, dtype=wp.float32, device=device())
    tables.alone = wp.zeros(leaves, dtype=wp.int32, device=device())
    inputs = [settings, given, ranked, array(range(leaves)[::-1]), known, tables.buckets, sizes]
    launch(light_cache_build.count_buckets, leaves, inputs, device())
    numbers = sizes.numpy().copy()
    assert np.array_equal(numbers, tables.buckets.numpy() + [len(x) for x in emitters])
    tables.offsets = array(np.cumsum(numbers) - numbers)
    tables.items = wp.full(int(numbers.sum()), -7, dtype=wp.int32, device=device())
    tables.rates = wp.full(int(numbers.sum()), -7.0, dtype=wp.float32, device=device())
    tables.chances = wp.full(int(numbers.sum()), -7.0, dtype=wp.float32, device=device())
    launch(light_cache_build.fill_buckets, leaves, [settings, given, ranked, sums, tables], device())
    return tables


def most_important(values, capacity):
    """Which lights belong to the first bucket; of equals the first."""
    main = np.zeros(len(values), bool)
    main[np.argsort(-np.asarray(values), kind="stable")[:capacity]] = True
    return main


def expected_buckets(emitters, importances, before, capacity):
    """The first bucket; others in the least power of two of buckets that holds them; the chance of each."""
    emitters, importances = np.asarray(emitters, int), np.asarray(importances, np.float64)
    main = most_important(importances, capacity)
    held = [emitters[main].tolist()] * (len(emitters) > 0)
    if len(emitters) > capacity:
        count, rest = 1, emitters[~main]
        while count < MOST_BUCKETS:
            limit = max(int(capacity * 0.75), 1) if 1 + count < before else capacity
            if np.bincount(rest % count).max() <= limit:
                break
            count *= 2
        held += [rest[rest % count == k][:capacity].tolist() for k in range(count)]
    of = dict(zip(emitters.tolist(), importances, strict=True))
    brought = np.array([sum(of[e] for e in x) for x in held])
    filled = np.array([len(x) > 0 for x in held])
    chances = filled / max(filled.sum(), 1)
    if brought.sum() > 0:
        chances = LEAST_CHANCE * chances + (1 - LEAST_CHANCE) * brought / brought.sum()
    return held, chances


def importances_for(rng, count):
    """Of widely different sizes; or all equal, or zero but for a few, or all zero."""
    sort = rng.integers(0, 6)
    values = 10 ** rng.uniform(-12, 6, count)
    return np.float32([values * (rng.random(count) < 0.05), values * 0 + 3, values * 0, values][min(sort, 3)])


@pytest.mark.parametrize("capacity", [1, 2, 5, 32])
def test_buckets(capacity):
    """The least power of two that holds the lights; fewer than before only where three quarters hold them.

    Each light has its rate there.
    """
    rng = np.random.default_rng(capacity)
    emitters, before = [], []
    for pool in (40, 300, 5000, 1 << 23):
        for count in (0, 1, 2, 20, 32, 33, 56, 57, 64, 65, 100, 300, 1000):
            for last in (0, 1, 2, 3, 9, 65):
                emitters.append(sorted({int(e) for e in rng.integers(0, pool, count)}))
                before.append(last)
    emitters.append(list(range(0, 64 * 100, 64)))  # all in one bucket of any number
    before.append(0)
    importances = [importances_for(rng, len(x)) for x in emitters]
    tries = [some_tries(rng, len(x)) for x in emitters]
    tables = bucketed(emitters, importances, before, capacity, tries)
    rates = rates_of(tables)
    offsets, ends = tables.offsets.numpy(), tables.chances.numpy()
    for k, (held, chances) in enumerate(contents_of(tables)):
        lights, likely = expected_buckets(emitters[k], importances[k], before[k], capacity)
        assert held == lights, (len(emitters[k]), before[k])
        assert np.allclose(chances, likely, atol=3e-6)
        of = dict(zip(emitters[k], rate_of(tries[k]), strict=True))
        assert np.allclose(list(rates[k].values()), [of[e] for e in rates[k]], rtol=1e-6)
        filled = np.array([len(x) > 0 for x in held], bool)
        assert (chances[~filled] == 0).all() and (chances[filled] >= 0.99 * LEAST_CHANCE / max(len(held), 1)).all()
        if 0 < len(emitters[k]) <= capacity:
            assert chances.tolist() == [1.0]
        if held:
            assert ends[offsets[k] + len(held) - 1] == 1.0


def test_bucket_counts_do_not_flicker():
    counts, before = [], 0
    for lights in (64, 65, 64, 65, 63, 57, 65, 56, 64, 65, 32, 33):
        before = bucketed([list(range(lights))], [np.ones(lights)], [before], 32).buckets.numpy()[0]
        counts.append(int(before))
    assert counts == [2, 3, 3, 3, 3, 3, 3, 2, 2, 3, 1, 2]


@pytest.mark.parametrize("explores_by", EXPLORES_BY)
def test_buckets_that_overflow_leave_lights_to_exploration(explores_by):
    """Probabilities of the cache sum to one all the same, and exploring finds the others."""
    frame, data, _ = lit_cache(explores_by)
    emitters = [list(range(203)), list(range(0, 203, 64)), list(range(100))]
    rng = np.random.default_rng(1)
    data.tables = bucketed(emitters, [rng.uniform(0, 1, len(x)) for x in emitters], [0, 0, 65], 1)
    held = contents_of(data.tables)[0][0]
    assert len(held) == 1 + MOST_BUCKETS == sum(map(len, held)) < 203
    spots = spots_in(np.arange(3))
    (pdfs, offered), explores = probabilities(frame, data, spots), explored(frame, data, spots)
    assert np.allclose(offered.sum(axis=1), 1, atol=2e-5) and np.allclose(pdfs, offered + 0.1 * explores, rtol=1e-5)
    assert (pdfs[asked(weigh_lights, data, frame, spots) > 0] > 0).all()


# ---- how often lights are seen, and exploration that adapts ----


def exploration_tables(moments, shares, buckets=None, alone=None, excesses=None):
    """CacheTables of regions that hold something and where exploring is not alone, unless told."""
    tables = light_cache.CacheTables()
    tables.moments, tables.exploration = array(moments, wp.vec2), array(shares, wp.float32)
    tables.buckets = array(np.ones(len(shares)) if buckets is None else buckets)
    tables.alone = array(np.zeros(len(shares)) if alone is None else alone)
    tables.excesses = array(np.zeros(len(shares)) if excesses is None else excesses, wp.float32)
    return tables


def weighed(settings, grouped, records, entries, tries, origins, known):
    """Return the tries of each leaf's entries, and of every leaf moments, shares, excesses, and where it is alone."""
    leaves, given = len(origins), lists(entries, tries)
    tables = exploration_tables(np.full((leaves, 2), -7.0), np.full(leaves, -7.0), None, [-7] * leaves, [-7.0] * leaves)
    inputs = [settings, grouped, records, given, array(origins), known, tables]
    launch(light_cache_build.weigh_light_samples, leaves, inputs, device(), 16)
    assert entries_of(given) == entries
    return tries_of(given), *(getattr(tables, name).numpy() for name in LEARNT_TABLES)


def expected_weights(settings, grouped, records, entries, tries, origins, known):
    """The same, one sample after another."""
    lights, values = records.lights.numpy(), records.light_values.numpy().astype(np.float64)
    starts, counts, order = (getattr(grouped, n).numpy().astype(np.int64) for n in ("starts", "counts", "order"))
    rivals = records.rivals.numpy().astype(np.float64)
    tried, moments, shares, excesses, alone = [], [], [], [], []
    for leaf, origin in enumerate(origins):
        counted = {e >> 8: [float(x) for x in t] for e, t in zip(entries[leaf], tries[leaf], strict=True)}
        moment, share, excess = np.zeros(2), settings.first_exploration, 0.0
        is_alone = settings.may_be_alone
        if origin >= 0:
            moment, share = known.moments.numpy()[origin].astype(np.float64), float(known.exploration.numpy()[origin])
            excess, is_alone = float(known.excesses.numpy()[origin]), int(known.alone.numpy()[origin])
        brought = {"offered": 0.0, "explored": 0.0}
        gains, probes, pairs, last, parts, sightings = 0.0, 0, 0.0, 0.0, np.zeros(2), 0
        both = np.zeros(3)
        looks = min(counts[leaf], grouped.most)
        for k in range(looks):
            slot = order[starts[leaf] + k * counts[leaf] // looks]
            word, square = int(lights[slot]), values[slot] ** 2 if values[slot] < LARGEST else 0.0
            emitter, seen = (word & ITEM) - 1, bool(word & VISIBLE)
            if word & EXPLORED:
                brought["explored"] += square
                gains += rivals[slot] if abs(rivals[slot]) < LARGEST**2 else 0.0
                continue
            sightings += seen
            if word & ALONE:
                pairs += last * np.sqrt(square)
                last = np.sqrt(square)
                odds = rivals[slot]
                probes += odds >= 0
                if odds >= 0 and square > 0:
                    # estimates of the two choices' second moments, with the power heuristic's weights
                    own, other = odds**2 / (odds**2 + share**2), share**2 / (odds**2 + share**2)
                    offered = square * own**2 / odds if odds > 0 else 0.0
                    explored_too = square * other**2 / share
                    brought["offered"] += offered / PROBED
                    brought["explored"] += explored_too / PROBED * (share > odds)
                    both += np.array([offered, explored_too, square]) / PROBED
                    parts += np.array([own, other]) * values[slot]
            else:
                brought["offered"] += square * seen
                gains += rivals[slot] if abs(rivals[slot]) < LARGEST**2 else 0.0
            if emitter in counted and (seen or word & BLOCKED):
                counted[emitter][0] += seen
                counted[emitter][1] += 1
        if origin >= 0 and counts[leaf] > 0:
            if known.buckets.numpy()[origin] > 0:
                unmet = (1 - FADING) * both[2] / max(probes, 1)  # as if one had found what the cache lacks
                most = brought["offered"] + brought["explored"] * share
                moment = FADING * moment + (brought["offered"], brought["explored"] * share + unmet)
                both[1] += unmet / share
                # as much as makes the noise of exploring a quarter of the rest's times the share
                share = np.sqrt(moment[1] / max(PRICE * moment[0], 1e-30)) if moment[1] > 0 else 0.0
                part = parts[0] / max(parts.sum(), 1e-30)
                product = min(PAIR_MARGIN * part * (1 - part) * pairs, np.sqrt(both[0] * both[1]))
                excess = FADING * excess + min(gains + both @ [1, 1, -1] + 2 * product, most)
                if settings.may_be_alone and excess != 0:
                    is_alone = int(excess > 0)
            elif settings.may_be_alone:
                is_alone = int(sightings < SIGHTINGS * len(entries[leaf]))
        moments.append(moment)
        excesses.append(excess)
        alone.append(is_alone)
        shares.append(np.clip(share, settings.least_exploration, settings.most_exploration))
        capped = [(n * min(1.0, MOST_TRIES / max(all_, 1)), min(all_, MOST_TRIES)) for n, all_ in counted.values()]
        tried.append(capped)
    return tried, np.array(moments), np.array(shares), np.array(excesses), np.array(alone)


def check_weights(found, expected):
    for here, wanted in zip(found[0], expected[0], strict=True):
        assert np.allclose(here, wanted, rtol=1e-5, atol=1e-6)
    assert np.allclose(found[1], expected[1], rtol=1e-4, atol=0)
    assert np.allclose(found[2], expected[2], rtol=1e-4, atol=0)
    slack = 1e-4 * (np.abs(expected[3]) + np.abs(expected[1]).max())  # of sums of both signs
    assert (np.abs(found[3] - expected[3]) <= slack).all()
    sure = np.abs(expected[3]) > slack
    assert np.array_equal(found[4][sure], expected[4][sure]) and set(found[4]) <= {0, 1}


LEARNT, FIXED = (0.15, 0.05, 0.75), (0.4, 0.4, 0.4)


@pytest.mark.parametrize("exploration", [LEARNT, FIXED], ids=["learnt", "fixed"])
@pytest.mark.parametrize("most", [1, 30, 1 << 20])
def test_samples_are_weighed_as_one_by_one(most, exploration):
    """Over frames, in each of which leaves have other samples and take over what other leaves knew."""
    rng = np.random.default_rng(most)
    settings = settings_of(exploration=exploration)
    known = exploration_tables(np.zeros((40, 2)), rng.uniform(0.1, 0.7, 40), rng.integers(0, 3, 40))
    chosen, blocked, tried = [], 0, []
    for leaves in (60, 30, 50):
        counts = rng.choice([0, 1, 2, 40, 300], leaves)
        counts[:2] = 0
        total = counts.sum()
        outcomes = rng.choice(OUTCOMES, total, p=[0.1, 0.2, 0.3, 0.1, 0.2, 0.1])
        leaf_of = np.repeat(np.arange(leaves), counts)
        outcomes[leaf_of % 5 == 3] &= VISIBLE  # nobody explored
        only_explored = (leaf_of % 5 == 4) & ((outcomes & EXPLORED) == 0)
        outcomes[only_explored] = BLOCKED  # nobody saw anything but by exploring
        values = light_values(rng, total) * np.where(outcomes & EXPLORED, 0.5, 1)
        values[rng.random(total) < 0.02] = 2e15
        order = rng.permutation(total)
        lights = np.empty(total, np.int64)
        lights[order] = words(rng.integers(-1, 40, total), outcomes, rng)
        by_slot = np.empty(total)
        by_slot[order] = values
        is_alone = (lights & ALONE) > 0
        odds = rng.choice([-1.0, 0.0, 1e-3, 0.3, 40.0], total, p=[0.6, 0.1, 0.1, 0.1, 0.1])
        rivals = np.where(is_alone, odds, rng.normal(size=total) * by_slot**2)
        rivals[(by_slot > 1e15) & ~is_alone] = np.inf
        records = records_of(lights, by_slot, np.float32(rivals))
        entries = [[int(e) << 8 | 2 for e in np.flatnonzero(rng.random(45) < rng.random())] for _ in range(leaves)]
        tries = [some_tries(rng, len(x)) for x in entries]
        origins = rng.integers(0, known.exploration.shape[0], leaves)
        origins[rng.random(leaves) < 0.2] = -1
        origins[:2] = -1, 7
        given = [settings, leaf_samples(counts, order, most), records, entries, tries, origins, known]
        found = weighed(*given)
        check_weights(found, expected_weights(*given))
        assert (found[2] >= np.float32(exploration[1])).all() and (found[2] <= np.float32(exploration[2])).all()
        old = (origins >= 0) & ((counts == 0) | (known.buckets.numpy()[origins] == 0))
        assert ((origins >= 0) & (counts == 0)).any() and (old & (counts > 0)).any()
        assert np.array_equal(found[1][old], known.moments.numpy()[origins[old]]), "these fade only where some are new"
        if exploration is LEARNT:
            assert np.array_equal(found[2][old], known.exploration.numpy()[origins[old]].clip(0.05, 0.75))
            assert (found[2][origins < 0] == np.float32(0.15)).all() and (found[1][origins < 0] == 0).all()
        chosen += found[2].tolist()
        blocked += sum(t[1] - t[0] for x in found[0] for t in x) > 0
        tried += [t[1] for x in found[0] for t in x]
        known = exploration_tables(found[1], found[2], rng.integers(0, 3, leaves), found[4], found[3])
    assert blocked and {0, 1, MOST_TRIES} <= set(np.round(tried, 3)) and max(tried) < MOST_TRIES + 1e-3
    least, share, highest = np.float32(sorted(exploration))
    assert {least, share, highest} <= set(np.float32(chosen)) and (exploration is FIXED or len(set(chosen)) > 10)


@pytest.mark.parametrize(
    ("outcome", "tries"),
    [
        (VISIBLE, (14.0, 17.0)),
        (BLOCKED, (4.0, 17.0)),
        (0, (4.0, 7.0)),  # turned away, or dark: says nothing of what is in between
        (VISIBLE | EXPLORED, (4.0, 7.0)),  # found for being seen
    ],
    ids=["seen", "blocked", "neither", "explored"],
)
def test_tries_of_a_light(outcome, tries):
    """Ten samples of light 5, which is known, of 6, which is not, and of none."""
    lights = [6 | outcome] * 10 + [7 | outcome] * 10 + [0] * 10
    given = [[[3 << 8, 5 << 8 | 1, 9 << 8]], [[(1.0, 2.0), (4.0, 7.0), (0.0, 0.0)]], np.array([0])]
    known = exploration_tables([[1.0, 1.0]], [0.5])
    grouped = leaf_samples([30], range(30), 99)
    found, *_ = weighed(settings_of(), grouped, records_of(lights, [1.0] * 30), *given, known)
    assert np.allclose(found[0], [(1, 2), tries, (0, 0)])


def test_few_tries_are_remembered():
    """At most 32: older ones count for less and less; the share that saw the light stays."""
    known = exploration_tables([[1.0, 1.0]], [0.5])
    tries, rates = [[(0.0, 0.0)]], []
    for turn in range(12):
        records = records_of([8 | (VISIBLE if turn < 2 else BLOCKED)] * 24, [1.0] * 24)
        grouped = leaf_samples([24], range(24), 99)
        tries, *_ = weighed(settings_of(), grouped, records, [[7 << 8]], tries, np.array([0]), known)
        seen, tried = tries[0][0]
        rates.append(seen / tried)
        assert np.isclose(tried, min(24 * (turn + 1), MOST_TRIES))
    assert rates[:2] == [1, 1] and np.allclose(np.divide(rates[2:], rates[1:-1]), 32 / 56, rtol=1e-5)


@pytest.mark.parametrize(
    ("light", "value", "buckets", "expected"),
    [
        (VISIBLE | EXPLORED | 5, 3.0, 0, [[0, 0], [9, 0.1], [0, 0]]),
        (BLOCKED | 5, 0.0, 1, [[0, 0], [7.2, 0.08], [0, 0]]),
        (5, 0.0, 1, [[0, 0], [7.2, 0.08], [0, 0]]),
        (VISIBLE | 5, 2e15, 1, [[0, 0], [7.2, 0.08], [0, 0]]),
        (VISIBLE | EXPLORED | 5, float("inf"), 1, [[0, 0], [7.2, 0.08], [0, 0]]),
    ],
    ids=["of regions that knew nothing", "blocked", "that did not arrive", "too bright", "without bounds"],
)
def test_samples_that_say_nothing_of_exploration(light, value, buckets, expected):
    """What was known fades where the region offered lights, and the share is that of what was known."""
    known = exploration_tables([[0.0, 0.0], [9.0, 0.1]], [0.33, 0.4], [buckets] * 2)
    given = [[[]] * 3, [[]] * 3, np.array([0, 1, -1]), known]
    settings = settings_of(exploration=LEARNT)
    grouped, records = leaf_samples([5, 5, 5], range(15), 9), records_of([light] * 15, [value] * 15)
    _, moments, shares, *_ = weighed(settings, grouped, records, *given)
    assert np.allclose(moments, expected)
    by_moments = [0.05, np.sqrt(0.1 / 9 / PRICE), 0.15]  # as little as may be, where nothing was found
    assert np.allclose(shares, by_moments if buckets else [0.33, 0.4, 0.15])


def learnt_exploration(contents, unseen=(), frames=3):
    """Return each PLACE's share after some frames in a region of ``contents``, all of whose lights but some arrive.

    And the light that each place gets of each emitter.
    """
    frame, data, _ = lit_cache("table")
    rng = np.random.default_rng(7)
    places, count = len(PLACES), 4000
    spots = spots_in([0])
    spots.regions = array(np.arange(places))
    light = asked(weigh_lights, data, frame, spots)
    light[:, list(unseen)] = 0.0
    shares = np.full(places, 0.1)
    known = exploration_tables(np.zeros((places, 2)), shares)
    grouped, nothing = leaf_samples(np.full(places, count), np.arange(places * count), 1 << 20), [[]] * places
    for _ in range(frames):
        data.tables = table([(*contents, share) for share in shares.tolist()])
        regions = samples.SampleRegions()
        regions.records = records_of(np.zeros(places * count), np.zeros(places * count))
        for explores in (0, 1):
            numbers = rng.random((count, 3)).astype(np.float32)
            items, pdfs, weights, *_, others = choices(frame, data, spots, numbers, explores)
            there = items >= 0
            values = np.where(there, weights * light[np.arange(places)[:, None], items] / np.where(there, pdfs, 1), 0.0)
            arrives = np.where(values > 0, 1, -1)
            chances = np.stack([pdfs, weights, others, np.ones_like(pdfs)], axis=-1).reshape(-1, 4)
            given = [array(items.ravel()), explores, array(np.zeros(items.size)), array(chances, wp.vec4)]
            given += [array(arrives.ravel()), array(values.ravel(), wp.float32)]
            launch(keep_lights, items.size, [regions, *given], device())
        inputs = [settings_of(), grouped, regions.records, nothing, nothing, np.arange(places), known]
        _, moments, shares, *_ = weighed(*inputs)
        known = exploration_tables(moments, shares)
    return shares[light.sum(axis=1) > 0], light


def test_exploration_falls_where_the_cache_holds_all_that_matters():
    """One bucket, weighed for the very point; nothing arrives of the many lights that it does not know."""
    known = [*range(0, 200, 7), 200, 201, 202]
    hidden = np.setdiff1d(np.arange(203), known)
    shares, light = learnt_exploration((known, [], 0), hidden)
    assert len(shares) > 6 and (light > 0).sum(axis=1).max() > 12
    assert np.allclose(shares, 0.05, atol=0.005), shares


def test_exploration_rises_where_the_cache_cannot_hold_what_matters():
    """It knows a few of many lights."""
    shares, _ = learnt_exploration(([40, 41], [], 0))
    assert len(shares) > 6 and np.allclose(shares, 0.75), shares
    # and a few hidden ones that it takes to be there
    shares, _ = learnt_exploration((range(0, 20), [], 0), range(0, 20))
    assert np.allclose(shares, 0.75), shares


# ---- all of it ----


def test_a_region_knows_what_it_and_its_neighbours_saw():
    """Three frames of learning, each of other samples, against sets."""
    estimator = gi.VisibilityLightCache(memory=1, capacity=8)
    frame, state = preprocessed(lit_scene(), estimator)
    known, tries = [[]] * 8, [[]] * 8
    settings, lesson = deep_lesson(10)
    for turn in range(3):
        origins, neighbours = lesson.origins.numpy(), lesson.neighbours.numpy().reshape(-1, 6)
        starts, counts, order = (getattr(lesson.samples, n).numpy() for n in ("starts", "counts", "order"))
        word = lesson.records.lights.numpy()
        seen = [[]] * len(origins)
        for leaf in np.flatnonzero(origins >= 0):
            w = word[order[starts[leaf] : starts[leaf] + counts[leaf]]]
            seen[leaf] = [int(e) << 8 for e in np.unique((w[w >= VISIBLE] & ITEM).astype(int) - 1)]
        before = state.tables.buckets.numpy()
        expected, carried = expected_join(seen, known, tries, neighbours, origins, 1)
        given = [settings_of(), lesson.leaf_samples(2048), lesson.records, expected, carried, origins, state.tables]
        learnt = expected_weights(*given)
        state = estimator.learn(lesson, state)
        assert entries_of(state.known) == expected
        found = [
            tries_of(state.known),
            *(getattr(state.tables, n).numpy() for n in LEARNT_TABLES),
        ]
        check_weights(found, learnt)
        tries = found[0]
        importances, rates = importances_of(frame.paths.lights.data, cells_of(lesson)), rates_of(state.tables)
        buckets = []
        for leaf, (lights, entries) in enumerate(zip(contents_of(state.tables), expected, strict=True)):
            last = before[origins[leaf]] if origins[leaf] >= 0 else 0
            emitters = [e >> 8 for e in entries]
            of = dict(zip(emitters, rate_of(tries[leaf]).astype(np.float32), strict=True))
            brings = importances[leaf, emitters] * np.float32(list(of.values()))
            held, chances = expected_buckets(emitters, brings, last, 8)
            assert lights[0] == held
            assert np.allclose(lights[1], chances, atol=2e-6)
            assert np.allclose(list(rates[leaf].values()), [of[e] for e in rates[leaf]], rtol=1e-6)
            buckets.append(len(held))
        assert max(buckets) > 3 and min(buckets) == 0
        assert ((origins >= 0) & (counts == 0)).any()
        known = expected
        _, other = deep_lesson(11 + turn, 20_000 // (turn + 1))
        lesson = settings.learn(lesson.octree, other.records, device())
    assert len({r for x in rates for r in x.values()}) > 20


def test_learning_without_samples():
    """A frame that saw nothing but sky forgets no faster than others."""
    estimator = gi.VisibilityLightCache()
    settings, lesson = deep_lesson()
    state = estimator.learn(lesson, preprocessed(lit_scene(), estimator)[1])
    records = copied(lesson.records, samples.SampleRecords)
    records.codes = wp.full(2000, 0xFFFFFFFF, dtype=wp.uint32, device=device())
    after = estimator.learn(settings.learn(lesson.octree, records, device()), state)
    assert isinstance(after, CacheState) and after.tables.buckets.shape[0] == 8
    assert {e & 255 for x in entries_of(after.known) for e in x} == {1}


def test_exploration_that_does_not_adapt():
    estimator = gi.VisibilityLightCache(exploration=0.7, adapts_exploration=False)
    _, state = preprocessed(lit_scene(), estimator)
    for seed in (1, 2):
        state = estimator.learn(deep_lesson(seed)[1], state)
    assert (state.tables.exploration.numpy() == np.float32(0.7)).all() and state.tables.buckets.numpy().max() > 1


def test_threads_do_not_matter():
    results = []
    try:
        for threads in (1, 4):
            set_threads(threads)
            estimator = gi.VisibilityLightCache()
            _, state = preprocessed(lit_scene(), estimator)
            for seed in (1, 2):
                state = estimator.learn(deep_lesson(seed)[1], state)
            t = state.tables
            used = [(held, chances.tolist()) for held, chances in contents_of(t)]
            results.append(
                (
                    used,
                    rates_of(t),
                    tries_of(state.known),
                    *(getattr(t, name).numpy().tolist() for name in ("buckets", "offsets", *LEARNT_TABLES)),
                )
            )
    finally:
        set_threads(None)
    assert results[0] == results[1]
