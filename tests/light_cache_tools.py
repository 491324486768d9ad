"""What tests of the visibility light cache share: a scene of all sorts of lights, and caches, lists and samples of it.

Tables, lists and samples are made by hand here, as no kernel makes them.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import warp as wp
from scene_tools import quad
from statistics_tools import device

import warp_gi as gi
from warp_gi.kernels import bsdf, light_cache, light_cache_build, light_hierarchy, ltc, samples, surface, types
from warp_gi.kernels.emitters import LightChoice, punctual_light
from warp_gi.launch import copied, launch
from warp_gi.paths import PathRequest

wp.set_module_options({"enable_backward": False})

VISIBLE, BLOCKED, GLOSSY, EXPLORED = 1 << 31, 1 << 30, 1 << 29, 1 << 28
ALONE = 1 << 27
ITEM = (1 << 27) - 1
OUTCOMES = np.array(
    [0, BLOCKED, VISIBLE, VISIBLE | EXPLORED, VISIBLE | ALONE, BLOCKED | ALONE]
)  # of light samples that are kept
ROUNDING = 2e-3, 1.5e-5  # of a weight: relative, and times the light's luminance
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


# ---- kernels: a thread is a point and an emitter, or a point and three random numbers ----


# Points on surfaces, and the regions that they are in.
@wp.struct
class Spots:
    faces: wp.array(dtype=wp.int32)
    views: wp.array(dtype=wp.vec3)  # towards the viewer
    regions: wp.array(dtype=wp.int32)


# How often both choices together select a light, and the cache alone.
@wp.kernel
def ask_probabilities(
    first: wp.int32,
    cache: light_cache.LightCache,
    scene: types.SceneData,
    spots: Spots,
    pdfs: wp.array2d(dtype=wp.float32),
    offered: wp.array2d(dtype=wp.float32),
):
    item = first + wp.tid()
    i = item / scene.emitters.count
    emitter = item - i * scene.emitters.count
    s = surface.surface_at(scene, spots.faces[i], 0.3, 0.3, spots.views[i])
    wo = wp.transpose(s.shading) * spots.views[i]
    region = spots.regions[i]
    pdfs[i, emitter] = light_cache.cached_light_pdf(cache, scene, region, s, wo, emitter)
    offered[i, emitter] = light_cache.offered_pdf(cache, light_cache.cache_region(cache, region), s, wo, emitter)


ChoiceWords = wp.types.vector(length=5, dtype=wp.float32)


# `found`: LightChoice's pdf, weight, explores, alone, other.
@wp.kernel
def choose_lights(
    first: wp.int32,
    cache: light_cache.LightCache,
    scene: types.SceneData,
    spots: Spots,
    explores: wp.int32,
    numbers: wp.array(dtype=wp.vec3),
    items: wp.array2d(dtype=wp.int32),
    found: wp.array2d(dtype=ChoiceWords),
):
    item = first + wp.tid()
    i = item / items.shape[1]
    k = item - i * items.shape[1]
    s = surface.surface_at(scene, spots.faces[i], 0.3, 0.3, spots.views[i])
    wo = wp.transpose(s.shading) * spots.views[i]
    u = numbers[k]
    choice = LightChoice()
    if explores != 0:
        choice = light_cache.another_light(cache, scene, spots.regions[i], s, wo, u)
    else:
        choice = light_cache.cached_light(cache, scene, spots.regions[i], s, wo, wp.vec2(u[0], u[1]))
    items[i, k] = choice.item
    found[i, k] = ChoiceWords(
        choice.pdf, choice.weight, wp.float32(choice.explores), wp.float32(choice.alone), choice.other
    )


# Thread: a slot. Keeps a light sample as paths do; `chances` are LightChoice's pdf, weight, other and selected.
@wp.kernel
def keep_lights(
    first: wp.int32,
    regions: samples.SampleRegions,
    items: wp.array(dtype=wp.int32),
    explores: wp.int32,
    alone: wp.array(dtype=wp.int32),
    chances: wp.array(dtype=wp.vec4),
    arrives: wp.array(dtype=wp.int32),
    values: wp.array(dtype=wp.float32),
):
    slot = first + wp.tid()
    choice = LightChoice()
    choice.item = items[slot]
    choice.explores = explores
    choice.alone = alone[slot]
    choice.pdf = chances[slot][0]
    choice.weight = chances[slot][1]
    choice.other = chances[slot][2]
    choice.selected = chances[slot][3]
    samples.keep_light(regions, slot, choice, arrives[slot], values[slot])


# The hierarchy's probability of each light.
@wp.kernel
def ask_hierarchy(
    first: wp.int32,
    tree: light_hierarchy.LightTree,
    scene: types.SceneData,
    spots: Spots,
    pdfs: wp.array2d(dtype=wp.float32),
):
    item = first + wp.tid()
    i = item / scene.emitters.count
    emitter = item - i * scene.emitters.count
    s = surface.surface_at(scene, spots.faces[i], 0.3, 0.3, spots.views[i])
    pdfs[i, emitter] = light_hierarchy.hierarchy_pdf(tree, surface.ray_origin(s), surface.shading_normal(s), emitter)


# Luminance that a surface reflects of a light, from the scene's triangles one at a time.
@wp.kernel
def weigh_lights(
    first: wp.int32,
    cache: light_cache.LightCache,
    scene: types.SceneData,
    spots: Spots,
    weights: wp.array2d(dtype=wp.float32),
):
    item = first + wp.tid()
    i = item / scene.emitters.count
    emitter = item - i * scene.emitters.count
    s = surface.surface_at(scene, spots.faces[i], 0.3, 0.3, spots.views[i])
    wo = wp.transpose(s.shading) * spots.views[i]
    origin = surface.ray_origin(s)
    row = scene.emitters.emitters[emitter]
    weights[i, emitter] = 0.0
    if row.kind == types.EMITTER_TRIANGLE:
        ids = scene.geometry.indices[row.triangle]
        a = scene.geometry.points[ids[0]] - origin
        b = scene.geometry.points[ids[1]] - origin
        c = scene.geometry.points[ids[2]] - origin
        both = scene.materials[scene.geometry.materials[row.triangle]].double_sided
        if both != 0 or wp.dot(wp.cross(b - a, c - a), a) < 0.0:
            w = ltc.lobe_weights(cache.ltc, s.bsdf, wo)
            m = wp.transpose(s.shading)
            weights[i, emitter] = cache.shapes[emitter].luminance * ltc.triangle_weight(w, m * a, m * b, m * c)
    else:
        sample = punctual_light(row, origin)
        f = bsdf.bsdf_evaluate(s.bsdf, wo, wp.transpose(s.shading) * sample.direction)
        weights[i, emitter] = bsdf.luminance(wp.cw_mul(f.value, sample.radiance))


def array(values, dtype=wp.int32):
    return wp.array(np.asarray(values), dtype=dtype, device=device())


# ---- a scene of lights of all kinds ----

FLOOR, GLOSSY_FLOOR, METAL_FLOOR, ROOF = 0, 2, 4, 6  # first triangle of each
VIEWS = {"above": (0.3, 0.8, 0.2), "slant": (0.95, 0.1, 0.2), "below": (0.1, -0.9, 0.3)}


@cache
def lit_scene():
    """Three floors and a roof, 200 triangles and three lights without size between; lamps of five sorts by turns."""
    rng = np.random.default_rng(1)
    materials = [
        gi.Material("lambert", (0.5, 0.4, 0.3), specular=0.0),
        gi.Material("glossy", (0.3, 0.5, 0.3), roughness=0.3),
        gi.Material("metal", (0.9, 0.8, 0.5), metallic=1.0, roughness=0.15),
    ]
    floors = [quad((-3, 0, 2 * i), (0, 0, 2), (2, 0, 0), material) for i, material in enumerate(materials)]
    floors.append(quad((-3, 20, 0), (0, 0, 2), (2, 0, 0), materials[0]))
    lamps = []
    for i in range(100):
        corner = np.array([rng.uniform(-4, 4), rng.uniform(1, 4), rng.uniform(-2, 6)])
        u, v = rng.normal(size=(2, 3)) * 0.3
        down = np.cross(u, v)[1] < 0
        sort = ("down", "up", "both", "crossing", "underground")[i % 5]
        if sort == "underground":
            corner[1] = -3.0
        elif sort == "crossing":
            corner[1], v = 0.0, np.array([0.1, 0.7, 0.2])
        elif (sort == "down") != down:
            u, v = v, u
        material = gi.Material(f"lamp{i}", (0, 0, 0), specular=0.0, emission=tuple(rng.uniform(0.1, 9, 3)))
        lamps.append(
            quad(corner, u, v, replace(material, double_sided=sort == "both" or (sort == "crossing" and i % 2 == 0)))
        )
    lights = [
        gi.PunctualLight("point", (3.0, 2.0, 1.0), position=(0.0, 1.5, 1.0)),
        gi.PunctualLight("spot", (9.0, 9.0, 9.0), position=(-2.0, 3.0, 1.0), direction=(0.0, -1.0, 0.0), range=9.0),
        gi.PunctualLight("directional", (0.3, 0.3, 0.2), direction=(0.3, -0.9, 0.1)),
    ]
    return gi.Scene([gi.Node("all", [*floors, *lamps])], lights)


def preprocessed(scene, estimator=None, state=None, time=0.0, position=(0.0, 1.0, 0.0)):
    """Return a frame without pixels as ``preprocess`` leaves it, and the state."""
    estimator = estimator or gi.VisibilityLightCache()
    state = state or estimator.start(scene, str(device()), None)
    scene.update(time, time, device())
    data = copied(scene.data(device()), types.SceneData)
    data.emitters = copied(data.emitters, types.Emitters)
    frame = SimpleNamespace(
        scene=scene,
        device=device(),
        data=data,
        camera=SimpleNamespace(position=position),
        paths=PathRequest(data.emitters),
        launch=lambda kernel, inputs, count: launch(kernel, count, inputs, device()),
        offer=lambda thing: None,
        offered=lambda kind: None,
    )
    state = estimator.preprocess(frame, state)
    return frame, state


def table(contents, rates=None, alone=None):
    """CacheTables of regions: lights of the first bucket, other lights, buckets of these (0: none), exploration.

    Rates are at random, unless there is one for every light. Nowhere is exploring alone, unless told.
    """
    rng = np.random.default_rng(4)
    buckets, offsets, items, chances, factors = [], [], [], [], []
    for main, others, count, _ in contents:
        held = [sorted(main)] * (len(main) > 0) + [sorted(e for e in others if e % count == k) for k in range(count)]
        parts = np.array([rng.uniform(0.05, 1) if x else 0.0 for x in held])
        sums = np.cumsum(parts) / max(parts.sum(), 1e-30)
        sums[np.cumsum(parts) >= parts.sum()] = 1.0
        buckets.append(len(held))
        offsets.append(len(items))
        lights = [e for x in held for e in x]
        items += [*np.cumsum([len(x) for x in held]), *lights]
        chances += [*sums, *[np.nan] * len(lights)]
        factors += [np.nan] * len(held)
        factors += rng.uniform(0.12, 1, len(lights)).tolist() if rates is None else [rates[e] for e in lights]
        assert all(len(x) <= 32 for x in held)
    tables = light_cache.CacheTables()
    tables.buckets, tables.offsets = array(buckets), array(offsets)
    tables.items, tables.chances = array(np.array(items, np.int32)), array(chances, wp.float32)
    tables.rates = array(factors, wp.float32)
    tables.exploration = array([share for *_, share in contents], wp.float32)
    tables.alone = array(np.zeros(len(contents)) if alone is None else alone)
    return tables


CONTENTS = {
    "empty": ([], [], 0, 0.1),
    "one light": ([40], [], 0, 0.1),
    "one light beside": ([40], [43], 8, 0.05),
    "a full bucket": (range(32), [], 0, 0.1),
    "two full buckets": (range(5, 37), [*range(5), *range(37, 64)], 1, 0.02),
    "all": (range(0, 203, 7), [e for e in range(203) if e % 7], 8, 0.02),
    "holes": ([5, 6], [*range(0, 200, 8), *range(3, 200, 8)], 8, 0.3),
    "many buckets": (range(90, 100), range(100, 203), 64, 0.1),
    "underground": ([8, 9], [18, 19, 28], 2, 0.1),
    "turned away": ([2, 3, 12, 13, 22, 23], [], 0, 0.1),
    "without size": ([200, 201, 202], [], 0, 0.1),
    "without size, spread": ([200], [201, 202], 4, 0.1),
    "explores only": (range(20), [], 0, 1.0),
    "explores alone": (range(0, 203, 7), [e for e in range(203) if e % 7], 8, 0.1),
}
PLACES = [(face, view) for face in (FLOOR, GLOSSY_FLOOR, METAL_FLOOR) for view in VIEWS]
PLACES.append((ROOF, "above"))  # whence the sun is all there is


def lit_cache(explores_by="hierarchy"):
    """A frame, the LightCache of CONTENTS, and PLACES in each of its regions."""
    frame, _ = preprocessed(lit_scene(), gi.VisibilityLightCache(explores_by=explores_by))
    data = frame.paths.lights.data
    data.tables = table(CONTENTS.values(), alone=[name == "explores alone" for name in CONTENTS])
    return frame, data, spots_in(np.arange(len(CONTENTS)))


def spots_in(regions):
    """All PLACES in each of the regions, one after another."""
    spots = Spots()
    spots.faces = array([face for _ in regions for face, _ in PLACES])
    directions = np.array([VIEWS[view] for _, view in PLACES])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    spots.views = array(np.tile(directions, (len(regions), 1)), wp.vec3)
    spots.regions = array(np.repeat(regions, len(PLACES)))
    return spots


def asked(kernel, data, frame, spots):
    """Return float64 [spot, emitter] of one of the kernels."""
    out = wp.empty((spots.faces.shape[0], frame.data.emitters.count), dtype=wp.float32, device=device())
    launch(kernel, out.size, [data, frame.data, spots, out], device())
    return out.numpy().astype(np.float64)


def probabilities(frame, data, spots):
    """Return float64 [spot, emitter] of both choices together, and of the cache alone."""
    shape = spots.faces.shape[0], frame.data.emitters.count
    pdfs, offered = (wp.empty(shape, dtype=wp.float32, device=device()) for _ in range(2))
    launch(ask_probabilities, pdfs.size, [data, frame.data, spots, pdfs, offered], device())
    return pdfs.numpy().astype(np.float64), offered.numpy().astype(np.float64)


def explored(frame, data, spots):
    """Probabilities of lights where a sample explores."""
    if data.explores_by_tree:
        return asked(ask_hierarchy, data.tree, frame, spots)
    return np.tile(explored_by_table(frame), (spots.faces.shape[0], 1))


def explored_by_table(frame):
    return frame.data.emitters.alias.numpy()["pdf"].astype(float)


def shares_of(data, spots):
    """Float64 [spot] share of samples that explore."""
    shares = np.where(data.tables.buckets.numpy() > 0, data.tables.exploration.numpy(), 1.0).astype(np.float64)
    return shares[spots.regions.numpy()]


def alone_at(data, spots):
    """Bool [spot]: exploring selects the only light."""
    return ((data.tables.buckets.numpy() == 0) | (data.tables.alone.numpy() != 0))[spots.regions.numpy()]


def expected_times(frame, data, spots):
    """Float64 [spot, emitter] how often each of the two choices selects a light."""
    (_, offered), explores = probabilities(frame, data, spots), explored(frame, data, spots)
    alone = alone_at(data, spots)[:, None]
    share = shares_of(data, spots)[:, None]
    return np.where(alone, explores, offered), np.where(alone, 0.0, share * explores)


def contents_of(tables):
    """Of each region the emitters of its buckets, and the chance of each bucket."""
    out = []
    items, chances = tables.items.numpy(), tables.chances.numpy().astype(np.float64)
    for count, offset in zip(tables.buckets.numpy(), tables.offsets.numpy(), strict=True):
        ends = items[offset : offset + count]
        begins = np.concatenate([[0], ends[:-1]]) if count else []
        held = [items[offset + count + b : offset + count + e].tolist() for b, e in zip(begins, ends, strict=True)]
        out.append((held, np.diff(chances[offset : offset + count], prepend=0.0)))
    return out


def rates_of(tables):
    """Of each region {emitter: rate}."""
    items, rates, out = tables.items.numpy(), tables.rates.numpy().astype(np.float64), []
    for count, offset in zip(tables.buckets.numpy(), tables.offsets.numpy(), strict=True):
        begin, size = offset + count, items[offset + count - 1] if count else 0
        out.append(dict(zip(items[begin : begin + size].tolist(), rates[begin : begin + size], strict=True)))
        assert len(out[-1]) == size, "a light that is in two buckets"
    return out


def choices(frame, data, spots, numbers, explores):
    """Return emitters, pdfs, weights, flags (explores, alone) and `other` [spot, number].

    Of the cache's choices, or of those that explore.
    """
    shape = spots.faces.shape[0], len(numbers)
    items, found = (wp.empty(shape, dtype=t, device=device()) for t in (wp.int32, ChoiceWords))
    inputs = [data, frame.data, spots, int(explores), array(numbers, wp.vec3), items, found]
    launch(choose_lights, items.size, inputs, device())
    return items.numpy(), *np.moveaxis(found.numpy(), 2, 0)


# ---- lists of lights, and samples ----


def lists(values, tries=None):
    """LightLists of the entries of each leaf, and the tries of each: none, unless told."""
    out = light_cache_build.LightLists()
    counts = np.array([len(x) for x in values])
    out.offsets, out.counts = array(np.cumsum(counts) - counts), array(counts)
    out.entries = array(np.array([e for x in values for e in x], np.int32))
    pairs = np.zeros((counts.sum(), 2)) if tries is None else [t for x in tries for t in x]
    out.tries = array(np.reshape(pairs, (-1, 2)), wp.vec2)
    return out


def _by_leaf(found, values):
    offsets, counts = found.offsets.numpy(), found.counts.numpy()
    return [values[begin : begin + count].tolist() for begin, count in zip(offsets, counts, strict=True)]


def entries_of(found):
    return _by_leaf(found, found.entries.numpy())


def tries_of(found):
    return _by_leaf(found, found.tries.numpy())


def some_tries(rng, count):
    """(seen, tried) of lights: some that nobody tried, some that nobody saw, at most 32."""
    tried = rng.choice([0.0, 1.0, 5.0, 31.0, 32.0], count)
    return np.stack([np.floor(tried * rng.choice([0.0, 1.0, rng.random()], count)), tried], axis=1).astype(np.float32)


def rate_of(tries):
    """Float64: the root of the share that saw a light, from one half on."""
    seen, tried = np.asarray(tries, np.float64).reshape(-1, 2).T
    return np.sqrt((seen + 0.5) / (tried + 1.0))


def words(emitters, outcomes, rng):
    """What samples remember of lights; -1: none was sampled."""
    emitters = np.asarray(emitters)
    value = (emitters + 1) | np.where(emitters >= 0, outcomes, 0)
    return value | np.where(rng.random(len(value)) < 0.3, GLOSSY, 0)


def light_values(rng, count):
    """What light samples brought."""
    return 10 ** rng.uniform(-2, 1, count) * (rng.random(count) < 0.9)


def leaf_samples(counts, order, most):
    grouped = samples.LeafSamples()
    grouped.starts, grouped.counts = array(np.cumsum(counts) - counts), array(counts)
    grouped.order, grouped.most = array(order), most
    return grouped


def records_of(lights, values, rivals=None):
    records = samples.SampleRecords()
    records.rivals = array(np.zeros(len(lights)) if rivals is None else rivals, wp.float32)
    records.lights, records.light_values = array(lights, wp.uint32), array(values, wp.float32)
    return records


def deep_lesson(seed=3, count=20_000, lights=203):
    """Samples of a cluster on a tree of many levels, each with a light of lit_scene."""
    rng = np.random.default_rng(seed)
    settings = gi.SampleOctree(split=64, collapse=32)
    state = settings.start(SimpleNamespace(bounds=np.array([[0, 0, 0], [1, 1, 1]], np.float32)), device())
    codes = (1 << 29) + (np.abs(rng.normal(size=count)) * 2.0 ** rng.integers(5, 26, count)).astype(np.int64)
    emitters = (rng.integers(0, 20, count) + codes // (1 << 20)) % lights
    records = records_of(
        words(emitters, rng.choice(OUTCOMES, count, p=[0.1, 0.2, 0.3, 0.1, 0.2, 0.1]), rng),
        light_values(rng, count),
        rng.choice([-1.0, 0.0, 1e-3, 1.0, 30.0], count),
    )
    records.codes = array(codes, wp.uint32)
    for name in ("directions", "mixtures"):
        setattr(records, name, wp.zeros(count, dtype=wp.uint32, device=device()))
    records.contributions = wp.zeros(count, dtype=wp.float32, device=device())
    return settings, settings.learn(state, records, device())


def learnt_cache(explores_by):
    """A frame, the LightCache after two frames of learning, and PLACES in regions with the most buckets and the least.

    Regions have eight lights a bucket; most know more. In two of them exploring is alone.
    """
    estimator = gi.VisibilityLightCache(explores_by=explores_by, capacity=8)
    _, state = preprocessed(lit_scene(), estimator)
    for seed in (5, 6):
        state = estimator.learn(deep_lesson(seed)[1], state)
    frame, state = preprocessed(lit_scene(), estimator, state)
    buckets = state.tables.buckets.numpy()
    assert buckets.max() >= 5
    leaves = np.concatenate([np.argsort(-buckets)[:6], [np.flatnonzero(buckets == n)[0] for n in (0, 1, 2)]])
    alone = np.zeros(len(buckets), np.int32)
    alone[leaves[[1, 8]]] = 1
    tables = frame.paths.lights.data.tables
    tables.alone = array(alone)
    frame.paths.lights.data.tables = tables
    return frame, frame.paths.lights.data, spots_in(leaves)


def random_cache(explores_by):
    """A frame, the LightCache of regions with lights, buckets and shares at random, and PLACES in each of them."""
    frame, _ = preprocessed(lit_scene(), gi.VisibilityLightCache(explores_by=explores_by))
    rng = np.random.default_rng(9)
    contents = [([], [], 0, 0.5)]
    for count in (0, 0, 1, 2, 4, 16, 64, 64):
        lights = rng.permutation(203)
        main, others = np.split(lights[: rng.integers(40, 203)], [rng.integers(1, 33)])
        full = [others[others % count == k][:32] for k in range(count)]
        contents.append((main, np.concatenate([*full, []]).astype(int), count, rng.choice([0.02, 0.1, 0.5, 0.75])))
    data = frame.paths.lights.data
    data.tables = table(contents, alone=np.arange(len(contents)) == 3)
    return frame, data, spots_in(np.arange(len(contents)))
