"""The visibility light cache: its probabilities, how it is made from samples (against NumPy sets), and its pictures."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import statistics_tools as st
import warp as wp
from statistics_tools import chi_squared, device, every_device  # noqa: F401

import warp_gi as gi
from warp_gi.alias import AliasTable
from warp_gi.bench.presets import light, quad
from warp_gi.kernels import (
    bsdf,
    light_cache,
    light_cache_build,
    light_cache_native,
    light_hierarchy,
    ltc,
    octree,
    samples,
    surface,
    types,
)
from warp_gi.kernels.emitters import LightChoice, punctual_light
from warp_gi.launch import copied, launch, set_threads
from warp_gi.techniques.light_tree import EmitterBounds, build_tree, to_device
from warp_gi.techniques.ltc import ltc_table
from warp_gi.techniques.visibility_light_cache import EXPLORES_BY, MOVING_EXPLORATION, CacheState

wp.set_module_options({"enable_backward": False})

VISIBLE, GLOSSY = 1 << 31, 1 << 29
MOST_LISTED = 1024
MOST_BUCKETS = 64  # beside the first
LEAST_CHANCE = 0.05
EXPLORATIONS = np.array([0.05, 0.1, 0.2, 0.4, 0.65, 0.9])
FADING = 0.8
KNEW_NOTHING = 65535  # share of a region that explores only, in 16 bits
MAIN, LEFT_OUT = -1.0, -1.0
ROUNDING = 2e-3, 1.5e-5  # of a weight: relative, and times the light's luminance
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


# ---- kernels: a thread is a point and an emitter, or a point and two random numbers ----


# Points on surfaces, and the regions that they are in.
@wp.struct
class Spots:
    faces: wp.array(dtype=wp.int32)
    views: wp.array(dtype=wp.vec3)  # towards the viewer
    regions: wp.array(dtype=wp.int32)


@wp.kernel
def ask_probabilities(
    first: wp.int32,
    cache: light_cache.LightCache,
    scene: types.SceneData,
    spots: Spots,
    pdfs: wp.array2d(dtype=wp.float32),
):
    item = first + wp.tid()
    i = item / scene.emitters.count
    emitter = item - i * scene.emitters.count
    s = surface.surface_at(scene, spots.faces[i], 0.3, 0.3, spots.views[i])
    wo = wp.transpose(s.shading) * spots.views[i]
    pdfs[i, emitter] = light_cache.cached_light_pdf(cache, scene, spots.regions[i], s, wo, emitter)


@wp.kernel
def choose_lights(
    first: wp.int32,
    cache: light_cache.LightCache,
    scene: types.SceneData,
    spots: Spots,
    numbers: wp.array(dtype=wp.vec2),
    items: wp.array2d(dtype=wp.int32),
    pdfs: wp.array2d(dtype=wp.float32),
    mixtures: wp.array2d(dtype=wp.vec2),
):
    item = first + wp.tid()
    i = item / items.shape[1]
    k = item - i * items.shape[1]
    s = surface.surface_at(scene, spots.faces[i], 0.3, 0.3, spots.views[i])
    wo = wp.transpose(s.shading) * spots.views[i]
    choice = light_cache.cached_light(cache, scene, spots.regions[i], s, wo, numbers[k])
    items[i, k] = choice.item
    pdfs[i, k] = choice.pdf
    mixtures[i, k] = wp.vec2(choice.by_exploring, choice.explores)


# Thread: a slot. Keeps a light sample as paths do.
@wp.kernel
def keep_lights(
    first: wp.int32,
    regions: samples.SampleRegions,
    items: wp.array(dtype=wp.int32),
    mixtures: wp.array(dtype=wp.vec2),
    visible: wp.array(dtype=wp.int32),
    values: wp.array(dtype=wp.float32),
):
    slot = first + wp.tid()
    choice = LightChoice()
    choice.item = items[slot]
    choice.by_exploring = mixtures[slot][0]
    choice.explores = mixtures[slot][1]
    samples.keep_light(regions, slot, choice, visible[slot], values[slot])


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


# Points that see buckets of triangles; a material is metallic, roughness and specular (below 0: plain Lambert).
@wp.struct
class LanePoints:
    origins: wp.array(dtype=wp.vec3)
    shadings: wp.array(dtype=wp.mat33)
    views: wp.array(dtype=wp.vec3)  # in the shading frame
    materials: wp.array(dtype=wp.vec3)
    counts: wp.array(dtype=wp.int32)  # lights of the bucket, which begins at 32 * point + 5
    items: wp.array(dtype=wp.int32)
    shapes: wp.array(dtype=light_cache_native.LightShape)


@wp.func
def lobes_at(points: LanePoints, table: ltc.LtcTable, i: wp.int32) -> ltc.LobeWeights:
    color = wp.vec3(0.8, 0.5, 0.2)
    m = points.materials[i]
    b = bsdf.lambert(color)
    if m[2] >= 0.0:
        b = bsdf.make_bsdf(color, m[0], m[1], m[2])
    return ltc.lobe_weights(table, b, points.views[i])


# Thread: a point.
@wp.kernel
def weigh_in_lanes(first: wp.int32, points: LanePoints, table: ltc.LtcTable, weights: wp.array2d(dtype=wp.float32)):
    i = first + wp.tid()
    w = lobes_at(points, table, i)
    found = light_cache_native.weigh_triangles(
        points.shapes, points.items, 32 * i + 5, points.counts[i], points.origins[i], points.shadings[i], w
    )
    for k in range(points.counts[i]):
        weights[i, k] = found[k]


# Thread: a point and a light of its bucket. `heights` are the lowest and the highest corner above the surface's
# horizon and above the lobe's, as sines; `backs`: positive where the point sees the light's back.
@wp.kernel
def weigh_one_by_one(
    first: wp.int32,
    points: LanePoints,
    table: ltc.LtcTable,
    weights: wp.array2d(dtype=wp.float32),
    heights: wp.array2d(dtype=wp.vec4),
    backs: wp.array2d(dtype=wp.float32),
):
    item = first + wp.tid()
    i = item / 32
    k = item - 32 * i
    shape = points.shapes[points.items[item + 5]]
    w = lobes_at(points, table, i)
    m = wp.transpose(points.shadings[i])
    a = m * (shape.p0 - points.origins[i])
    b = m * (shape.p1 - points.origins[i])
    c = m * (shape.p2 - points.origins[i])
    weights[i, k] = shape.luminance * ltc.triangle_weight(w, a, b, c)
    backs[i, k] = wp.dot(wp.normalize(wp.cross(b - a, c - a)), wp.normalize(a))
    z = wp.vec3(wp.normalize(a)[2], wp.normalize(b)[2], wp.normalize(c)[2])
    p = wp.normalize(w.matrix * a)
    q = wp.normalize(w.matrix * b)
    r = wp.normalize(w.matrix * c)
    heights[i, k] = wp.vec4(wp.min(z), wp.max(z), wp.min(wp.vec3(p[2], q[2], r[2])), wp.max(wp.vec3(p[2], q[2], r[2])))


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
        launch=lambda kernel, inputs, count: launch(kernel, count, inputs, device()),
    )
    return frame, estimator.preprocess(frame, state)


def table(contents):
    """CacheTables of regions: lights of the first bucket, other lights, buckets of these (0: none), exploration."""
    rng = np.random.default_rng(4)
    buckets, offsets, items, chances = [], [], [], []
    for main, others, count, _ in contents:
        held = [sorted(main)] * (len(main) > 0) + [sorted(e for e in others if e % count == k) for k in range(count)]
        parts = np.array([rng.uniform(0.05, 1) if x else 0.0 for x in held])
        sums = np.cumsum(parts) / max(parts.sum(), 1e-30)
        sums[np.cumsum(parts) >= parts.sum()] = 1.0
        buckets.append(len(held))
        offsets.append(len(items))
        items += [*np.cumsum([len(x) for x in held]), *(e for x in held for e in x)]
        chances += [*sums, *[np.nan] * sum(map(len, held))]
        assert all(len(x) <= 32 for x in held)
    tables = light_cache.CacheTables()
    tables.buckets, tables.offsets = array(buckets), array(offsets)
    tables.items, tables.chances = array(np.array(items, np.int32)), array(chances, wp.float32)
    tables.exploration = array([share for *_, share in contents], wp.float32)
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
}
PLACES = [(face, view) for face in (FLOOR, GLOSSY_FLOOR, METAL_FLOOR) for view in VIEWS]
PLACES.append((ROOF, "above"))  # whence the sun is all there is


def lit_cache(explores_by="hierarchy"):
    """A frame, the LightCache of CONTENTS, and PLACES in each of its regions."""
    frame, _ = preprocessed(lit_scene(), gi.VisibilityLightCache(explores_by=explores_by))
    data = frame.lights.data
    data.tables = table(CONTENTS.values())
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
    return asked(ask_probabilities, data, frame, spots)


def explored(frame, data, spots):
    """Probabilities of lights where a sample explores."""
    if data.explores_by_tree:
        return asked(ask_hierarchy, data.tree, frame, spots)
    return np.tile(explored_by_table(frame), (spots.faces.shape[0], 1))


def explored_by_table(frame):
    return frame.data.emitters.alias.numpy()["pdf"].astype(float)


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


def expected_probabilities(frame, data, spots):
    """By Algorithm 1, with weights one at a time; and how much a probability may be off by the rounding of these."""
    weights, explores = asked(weigh_lights, data, frame, spots), explored(frame, data, spots)
    contents, shares = contents_of(data.tables), data.tables.exploration.numpy().astype(np.float64)
    luminances = data.shapes.numpy()["luminance"]
    expected, slack = np.zeros_like(weights), np.zeros_like(weights)
    for row, region in enumerate(spots.regions.numpy()):
        held, chances = contents[region]
        share = shares[region] if held else 1.0
        lambert = PLACES[row % len(PLACES)][0] in (FLOOR, ROOF)
        for lights, chance in zip(held, chances, strict=True):
            unit, weight = (1 - share) * chance, weights[row, lights]
            total = weight.sum()
            expected[row, lights] = unit * (weight / total if total > 0 else 1 / max(len(lights), 1))
            if total > 0:
                error = ROUNDING[0] * weight + (0.0 if lambert else ROUNDING[1]) * luminances[lights]
                least = max(total - error.sum(), 1e-30)
                slack[row, lights] = unit * np.minimum(error / least + weight / total * error.sum() / least, 1.0)
        expected[row] += share * explores[row]
    return expected, slack, weights


def choices(frame, data, spots, numbers):
    shape = spots.faces.shape[0], len(numbers)
    items, pdfs, mixtures = (wp.empty(shape, dtype=t, device=device()) for t in (wp.int32, wp.float32, wp.vec2))
    inputs = [data, frame.data, spots, array(numbers, wp.vec2), items, pdfs, mixtures]
    launch(choose_lights, items.size, inputs, device())
    return items.numpy(), pdfs.numpy(), mixtures.numpy()


# ---- probabilities ----


def learnt_cache(explores_by):
    """A frame, the LightCache after two frames of learning, and PLACES in regions with the most buckets and the least.

    Regions have eight lights a bucket; most know more.
    """
    estimator = gi.VisibilityLightCache(explores_by=explores_by, capacity=8)
    _, state = preprocessed(lit_scene(), estimator)
    for seed in (5, 6):
        state = estimator.learn(deep_lesson(seed)[1], state)
    frame, state = preprocessed(lit_scene(), estimator, state)
    buckets = state.tables.buckets.numpy()
    assert buckets.max() >= 5
    leaves = np.concatenate([np.argsort(-buckets)[:6], [np.flatnonzero(buckets == n)[0] for n in (0, 1, 2)]])
    return frame, frame.lights.data, spots_in(leaves)


CACHES = {"made": lit_cache, "learnt": learnt_cache}
both_ways = pytest.mark.parametrize("explores_by", EXPLORES_BY)
both_caches = pytest.mark.parametrize("kind", CACHES)


@both_ways
@both_caches
def test_probabilities_sum_to_one(kind, explores_by):
    """Or to what the hierarchy's do: it offers nothing where all lights that have a place are below the horizon."""
    frame, data, spots = CACHES[kind](explores_by)
    pdfs, explores = probabilities(frame, data, spots), explored(frame, data, spots)
    assert frame.data.emitters.count == 203
    regions = spots.regions.numpy()
    share = np.where(data.tables.buckets.numpy() > 0, data.tables.exploration.numpy(), 1.0)[regions]
    sums = explores.sum(axis=1)
    whole = np.abs(sums - 1) < 1e-4
    faces = np.array([face for face, _ in PLACES])[np.arange(len(sums)) % len(PLACES)]
    assert np.array_equal(whole, (faces != ROOF) | (explores_by == "table"))
    assert (sums <= 1 + 1e-4).all() and (sums[~whole] < 0.9).all()
    assert np.allclose(pdfs.sum(axis=1), 1 - share * (1 - sums), atol=2e-5)
    assert (pdfs.sum(axis=1) <= 1 + 2e-5).all()
    weights = asked(weigh_lights, data, frame, spots)
    assert (pdfs[weights > 0] > 0).all(), "a light that nothing selects, though it shines there"
    assert explores_by == "hierarchy" or (pdfs > 0).all()


@both_ways
@both_caches
def test_probabilities_are_those_of_the_weights(kind, explores_by):
    """However many lights are weighed at once, by whatever means; of every sort of light, on every sort of surface."""
    frame, data, spots = CACHES[kind](explores_by)
    pdfs = probabilities(frame, data, spots)
    expected, slack, weights = expected_probabilities(frame, data, spots)
    assert (weights >= 0).all() and (weights > 0).mean() > 0.2
    off = np.abs(pdfs - expected)
    for row in np.flatnonzero((off > 1e-6 + slack).any(axis=1)):
        raise AssertionError((spots.regions.numpy()[row], PLACES[row % len(PLACES)], np.argmax(off[row] - slack[row])))
    metal = np.array([face == METAL_FLOOR for face, _ in PLACES])[np.arange(len(pdfs)) % len(PLACES)]
    assert np.median(slack[~metal] / expected[~metal].clip(1e-9)) < 0.01 and np.median(slack[metal]) < 0.01


@both_ways
@both_caches
def test_choices_follow_the_probabilities(kind, explores_by):
    frame, data, spots = CACHES[kind](explores_by)
    pdfs = probabilities(frame, data, spots)
    rng = np.random.default_rng(2)
    numbers = (rng.integers(0, 1 << 24, (10_000, 2)) / (1 << 24)).astype(np.float32)
    numbers[:3] = [(0.0, 0.0), (1 - 2**-24, 1 - 2**-24), (1 - 2**-24, 0.0)]
    items, chosen, mixtures = choices(frame, data, spots, numbers)
    assert items.min() >= -1 and items.max() < 203
    rows = np.arange(len(items))[:, None]
    assert np.allclose(chosen, np.where(items >= 0, pdfs[rows, items], 0.0), rtol=1e-5)
    buckets, shares = data.tables.buckets.numpy(), data.tables.exploration.numpy().astype(np.float64)
    explores = explored(frame, data, spots)
    nothing = np.zeros(len(items), bool)
    for row, region in enumerate(spots.regions.numpy()):
        found = items[row][items[row] >= 0]
        nothing[row] = len(found) < len(numbers)
        total = len(numbers) if nothing[row] else None
        p = chi_squared(np.bincount(found, minlength=203), pdfs[row] * len(numbers), total)
        assert p > 1e-5, (region, PLACES[row % len(PLACES)])
        share = shares[region] if buckets[region] else 1.0
        by_exploring = share * explores[row] / pdfs[row].clip(1e-30)
        assert (mixtures[row, :, 1] == np.float32(share)).all()
        assert np.allclose(mixtures[row, :, 0], np.where(items[row] >= 0, by_exploring[items[row]], 0.0), rtol=2e-4)
        # of all samples, as many explored as they say
        wrong = abs((numbers[:, 0] < share).mean() - mixtures[row, :, 0].mean() - (items[row] < 0).mean())
        assert wrong < 5 * np.sqrt(share / len(numbers)) + 1e-6
    sums = pdfs.sum(axis=1)
    assert (sums[nothing] < 0.9999).all() and (explores_by == "hierarchy") == nothing.any()


@both_ways
def test_every_light_can_be_explored(explores_by):
    """Where a thousandth explores, a float32 has a thousandth of its numbers left: too few for many lights."""
    count, share = 1 << 15, 0.001
    frame, data, _ = lit_cache(explores_by)
    data.tables = table([([40], [43], 8, share)])
    frame.data.emitters.count = count
    rng = np.random.default_rng(3)
    if explores_by == "hierarchy":
        places = np.stack([*rng.uniform(-9, 9, (2, count)), rng.uniform(8, 9, count)], axis=1)[:, [0, 2, 1]]
        ones = np.ones(count)
        up = np.tile([0.0, 1.0, 0.0], (count, 1))
        bounds = EmitterBounds(places, places, up, np.pi * ones, ones, ones, np.zeros(count, bool), ones)
        data.tree = to_device(build_tree(bounds), device())
    else:
        frame.data.emitters.alias = AliasTable.build(np.ones(count)).on(device())
    spots = Spots()
    spots.faces, spots.regions = array([FLOOR]), array([0])
    spots.views = array([VIEWS["above"]], wp.vec3)
    pdfs = explored(frame, data, spots)[0]
    assert abs(pdfs.sum() - 1) < 1e-3
    numbers = rng.integers(0, 1 << 24, (1 << 17, 2)) / (1 << 24)
    numbers[:, 0] = np.floor(numbers[:, 0] * share * (1 << 24)) / (1 << 24)
    items, _, _ = choices(frame, data, spots, numbers.astype(np.float32))
    found, expected = len(np.unique(items)) / count, (1 - np.exp(-len(numbers) * pdfs)).mean()
    assert abs(found - expected) < 0.01, f"{found:.1%} of the lights, not {expected:.1%}"


def shares_of_lights(frame, data, spots, row, emitters, exploration):
    """Return the probability of each of ``emitters``, those of a region's only bucket, within it."""
    pdf = probabilities(frame, data, spots)[row, emitters]
    return (pdf - exploration * explored(frame, data, spots)[row, emitters]) / (1 - exploration)


def test_lights_are_selected_by_what_they_reflect():
    """Lambert: emitted radiance times cosines over square distance, by 4,096 points; and lights without size."""
    frame, data, spots = lit_cache()
    emitters = np.array([0, 1, 4, 5, 2, 3, 10, 14, 200, 201, 202])  # down, both sides, turned away; point, spot, sun
    data.tables = table([(emitters, [], 0, 0.1)])
    spots.faces, spots.regions = array([FLOOR]), array([0])
    spots.views = array([VIEWS["above"] / np.linalg.norm(VIEWS["above"])], wp.vec3)
    found = shares_of_lights(frame, data, spots, 0, emitters, 0.1)

    geometry = frame.data.geometry
    points, faces = geometry.points.numpy().astype(float), geometry.indices.numpy()
    corners = points[faces[FLOOR]]
    here = corners[0] * 0.4 + corners[1] * 0.3 + corners[2] * 0.3
    rows = frame.data.emitters.emitters.numpy()
    materials = frame.data.materials.numpy()[geometry.materials.numpy()]
    a, b = np.meshgrid((np.arange(64) + 0.5) / 64, (np.arange(64) + 0.5) / 64)
    root = np.sqrt(a.ravel())
    weights = []
    for emitter in rows[emitters]:
        if emitter["kind"] == types.EMITTER_TRIANGLE:
            p0, p1, p2 = points[faces[emitter["triangle"]]]
            on = p0 + np.outer(root * (1 - b.ravel()), p1 - p0) + np.outer(root * b.ravel(), p2 - p0)
            to_light, cross = on - here, np.cross(p1 - p0, p2 - p0)
            square = (to_light**2).sum(axis=1)
            slant = -to_light @ cross / 2
            material = materials[emitter["triangle"]]
            slant = np.abs(slant) if material["double_sided"] else np.maximum(slant, 0)
            value = (np.maximum(to_light[:, 1], 0) * slant / square**2).mean()
            weights.append(value * (material["emission"] @ LUMINANCE_OF_FLOOR))
            continue
        to_light = emitter["position"] - here
        square = to_light @ to_light
        to_light = to_light / np.sqrt(square)
        strength = 1 / square
        if emitter["kind"] == types.EMITTER_DIRECTIONAL:
            to_light, strength = -emitter["direction"], 1.0
        elif emitter["kind"] == types.EMITTER_SPOT:
            cone = (-to_light @ emitter["direction"] - np.cos(np.pi / 4)) / (1 - np.cos(np.pi / 4))
            strength *= np.clip(cone, 0, 1) ** 2 * (1 - (np.sqrt(square) / 9) ** 4)
        weights.append(strength * to_light[1] * (emitter["intensity"] @ LUMINANCE_OF_FLOOR))
    expected = np.array(weights) / np.sum(weights)
    assert (expected[4:6] == 0).all() and (expected[[0, 2, 8, 9, 10]] > 3e-4).all()
    # the luminance of a product is not the product of luminances: area lights know the latter, up to the colours
    assert np.allclose(found, expected, rtol=0.12, atol=2e-5)
    same = [emitters.tolist().index(e) for e in (0, 1, 10)]
    gray = np.array(weights)[same] / [
        materials[rows[e]["triangle"]]["emission"] @ LUMINANCE_OF_FLOOR for e in (0, 1, 10)
    ]
    gray *= [materials[rows[e]["triangle"]]["emission"] @ LUMINANCE for e in (0, 1, 10)]
    assert np.allclose(found[same] / found[same].sum(), gray / gray.sum(), rtol=3e-3)


LUMINANCE_OF_FLOOR = LUMINANCE * [0.5, 0.4, 0.3]


def test_lights_that_reflect_nothing_are_equal():
    """Not a division by zero: a bucket whose lights are all below the horizon."""
    frame, data, spots = lit_cache("table")
    region = list(CONTENTS).index("turned away")
    emitters = contents_of(data.tables)[region][0][0]
    found = shares_of_lights(frame, data, spots, region * len(PLACES), emitters, 0.1)
    assert np.allclose(found, 1 / len(emitters), atol=1e-5)


# ---- weights, eight at a time ----

SURFACES = {"lambert": (0.0, 1.0, -1.0), "coated": (0.0, 0.3, 1.0), "metal": (1.0, 0.3, 1.0), "mirror": (1.0, 0.1, 1.0)}


def lane_points(count, material):
    """Points of any orientation, and triangles of all sizes around them; every bucket has other lights."""
    rng = np.random.default_rng(6)
    points = LanePoints()
    origins = rng.normal(size=(count, 3))
    rotations = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    rotations *= np.sign(np.linalg.det(rotations))[:, None, None]
    wo = rng.normal(size=(count, 3))
    wo[:, 2] = np.abs(wo[:, 2]) + 0.05
    wo /= np.linalg.norm(wo, axis=1, keepdims=True)
    wo[0] = 0, 0, 1
    size = 32 * count + 5
    away = rng.normal(size=(size, 1, 3))
    distance = 10.0 ** rng.uniform(-1, 1.5, (size, 1, 1))
    away *= distance / np.linalg.norm(away, axis=2, keepdims=True)
    around = np.concatenate([np.zeros((5, 3)), origins.repeat(32, axis=0)])[:, None]
    corners = around + away + rng.normal(size=(size, 3, 3)) * distance * 10.0 ** rng.uniform(-2.5, 0.3, (size, 1, 1))
    shapes = np.zeros(size, light_cache_native.LightShape.numpy_dtype())
    for i, name in enumerate(("p0", "p1", "p2")):
        shapes[name] = corners[:, i]
    shapes["luminance"] = rng.uniform(0.1, 10, size) * (rng.random(size) < 0.9)
    shapes["two_sided"] = rng.integers(0, 2, size)
    order = rng.permutation(size)  # emitters are anywhere
    place = np.empty(size, np.int64)
    place[order] = np.arange(size)
    points.origins, points.shadings = array(origins, wp.vec3), array(rotations, wp.mat33)
    points.views, points.materials = array(wo, wp.vec3), array(np.tile(material, (count, 1)), wp.vec3)
    points.counts, points.items = array(np.arange(count) % 32 + 1), array(place)
    points.shapes = wp.array(shapes[order], dtype=light_cache_native.LightShape, device=device())
    return points, shapes[5:].reshape(count, 32)


@pytest.mark.parametrize("material", SURFACES)
def test_lanes_weigh_as_one_by_one(material):
    """Which lights are left out, which are dark; the others differ by no more than ROUNDING."""
    count = 32 * 40
    points, shapes = lane_points(count, SURFACES[material])
    found = wp.full((count, 32), np.nan, dtype=wp.float32, device=device())
    weights, backs = (wp.empty((count, 32), dtype=wp.float32, device=device()) for _ in range(2))
    heights = wp.empty((count, 32), dtype=wp.vec4, device=device())
    launch(weigh_in_lanes, count, [points, ltc_table(device()), found], device())
    launch(weigh_one_by_one, 32 * count, [points, ltc_table(device()), weights, heights, backs], device())
    found, weights, backs, heights = (x.numpy().astype(np.float64) for x in (found, weights, backs, heights))
    there = np.arange(32) < points.counts.numpy()[:, None]
    assert np.isfinite(found[there]).all() and np.isnan(found[~there]).all()
    if device().is_cuda:
        assert (found[there] == LEFT_OUT).all()
        return
    low, high, lobe_low, lobe_high = np.moveaxis(heights, 2, 0)
    no_size = shapes["luminance"] == 0
    dark = (high <= 0) | ((backs >= 0) & (shapes["two_sided"] == 0))
    crosses = (low <= 0) & (high > 0)
    if material != "lambert":
        crosses |= (lobe_low <= 0) & (lobe_high > 0)
    margin = np.minimum.reduce([np.abs(x) for x in (low, high, lobe_low, lobe_high, backs)])
    sure = there & ((margin > 1e-4) | (material == "lambert") & (np.minimum(np.abs(low), np.abs(high)) > 1e-4))
    sure &= np.abs(backs) > 1e-4
    assert sure[there].mean() > 0.97
    left_out, none = no_size | (crosses & ~dark), ~no_size & dark
    assert (found[sure & left_out] == LEFT_OUT).all() and (found[sure & none] == 0).all()
    weighed = sure & ~left_out & ~none
    assert min((sure & x).sum() for x in (no_size, crosses & ~dark & ~no_size, none, weighed)) > 500
    for width in range(1, 9):  # of the last group of eight
        assert (weighed & (points.counts.numpy() % 8 == width % 8)[:, None]).sum() > 500
    off = np.abs(found - weights)[weighed]
    assert (off <= ROUNDING[0] * weights[weighed] + ROUNDING[1] * shapes["luminance"][weighed]).all()
    assert material != "lambert" or (off < 2e-4 * weights[weighed]).mean() > 0.9
    assert (found[weighed] > 0).all()


# ---- exploration: weights of all lights, moving ones ----


def moving_scene():
    """A floor, a lamp that moves 2 m in the first second, one that stays, and a point light."""
    floor = gi.Node("floor", [quad((-2, 0, -2), (0, 0, 4), (4, 0, 0), gi.Material("f", (0.5, 0.5, 0.5), specular=0.0))])
    keys = [gi.Keyframe(0.0, (0.0, 0.0, 0.0)), gi.Keyframe(1.0, (2.0, 0.0, 0.0)), gi.Keyframe(2.0, (2.0, 0.0, 0.0))]
    lamp = quad((-1.5, 2, 0), (0.3, 0, 0), (0, 0, 0.3), light((9.0, 9.0, 9.0)))
    still = quad((1.0, 1, 1), (0.1, 0, 0), (0, 0, 0.2), light((3.0, 2.0, 1.0)))
    lights = [gi.PunctualLight("point", (0.1, 0.2, 0.3), position=(0.0, 1.0, -1.0))]
    return gi.Scene([floor, gi.Node("moves", [lamp], keyframes=keys), gi.Node("stays", [still])], lights)


def test_exploration_follows_power():
    frame, _ = preprocessed(lit_scene(), gi.VisibilityLightCache(explores_by="table", change=0.0, distance=0.0))
    powers = lit_scene().emitter_powers()
    assert np.allclose(explored_by_table(frame), powers / powers.sum(), rtol=1e-4, atol=1e-7)


def test_exploration_follows_nearness_to_the_camera():
    scene = moving_scene()
    estimator = gi.VisibilityLightCache(explores_by="table", energy=0.0, change=0.0)
    frame, _ = preprocessed(scene, estimator, position=(0.0, 1.0, -0.5))
    found = explored_by_table(frame)
    places = np.array(
        [[-1.3, 2, 0.1], [-1.4, 2, 0.2], [1 + 0.2 / 3, 1, 1 + 0.2 / 3], [1 + 0.1 / 3, 1, 1 + 0.4 / 3], [0, 1, -1]]
    )
    near = 1 / (((places - (0, 1, -0.5)) ** 2).sum(axis=1) + (0.02 * scene.radius) ** 2)
    assert np.allclose(found, near / near.sum(), rtol=1e-4)


def test_exploration_goes_after_lights_that_move():
    scene = moving_scene()
    estimator = gi.VisibilityLightCache(explores_by="table", energy=0.1, change=10.0, distance=0.0, exploration=0.2)
    frame, state = preprocessed(scene, estimator)
    before = explored_by_table(frame)
    state.tables.exploration.fill_(0.03)
    state.tables.moments.fill_(7.0)
    frame, state = preprocessed(scene, estimator, state, 0.5)
    assert explored_by_table(frame)[:2].sum() > 0.98 > before[:2].sum()
    assert np.allclose(state.tables.exploration.numpy(), MOVING_EXPLORATION), "what is known is in doubt"
    assert MOVING_EXPLORATION == 0.3 and (state.tables.moments.numpy() == 7).all(), "and learnt on from there"
    state.tables.exploration.fill_(0.03)
    state.tables.moments.fill_(7.0)
    frame, state = preprocessed(scene, estimator, state, 0.5)  # now it stands still
    assert np.allclose(explored_by_table(frame), before)
    assert np.allclose(state.tables.exploration.numpy(), 0.03) and (state.tables.moments.numpy() == 7).all()
    shapes = state.shapes.numpy()
    assert np.allclose(shapes["p0"][0], (-0.5, 2, 0), atol=1e-5)


@pytest.mark.parametrize(("settings", "expected"), [({"exploration": 0.6}, 0.6), ({"adapts_exploration": False}, 0.03)])
def test_lights_that_move_do_not_lower_exploration(settings, expected):
    """Nor do they change a share that is for the caller to choose."""
    scene, estimator = moving_scene(), gi.VisibilityLightCache(**settings)
    _, state = preprocessed(scene, estimator)
    state.tables.exploration.fill_(0.03)
    given = state.tables
    _, state = preprocessed(scene, estimator, state, 0.5)
    assert np.allclose(state.tables.exploration.numpy(), expected)
    assert np.allclose(given.exploration.numpy(), 0.03), "the state before is another's"


def test_the_hierarchy_follows_lights_that_move():
    scene, estimator = moving_scene(), gi.VisibilityLightCache(exploration=0.2)
    spots = Spots()
    spots.faces, spots.regions, spots.views = array([0]), array([0]), array([(0.0, 1.0, 0.0)], wp.vec3)

    def chances(frame):
        assert frame.lights.data.explores_by_tree == 1
        found = asked(ask_hierarchy, frame.lights.data.tree, frame, spots)
        assert np.allclose(found, probabilities(frame, frame.lights.data, spots), rtol=1e-5)  # nothing is cached
        return found

    frame, state = preprocessed(scene, estimator)
    before = chances(frame)
    state.tables.exploration.fill_(0.03)
    frame, state = preprocessed(scene, estimator, state, 0.5)
    after = chances(frame)
    assert np.allclose(state.tables.exploration.numpy(), MOVING_EXPLORATION), "what is known is in doubt"
    fresh, _ = preprocessed(scene, estimator, None, 0.5)
    assert np.allclose(after, chances(fresh), rtol=1e-3) and not np.allclose(after, before, rtol=5e-3)
    state.tables.exploration.fill_(0.03)
    _, state = preprocessed(scene, estimator, state, 0.5)  # now it stands still
    assert np.allclose(state.tables.exploration.numpy(), 0.03)


@pytest.mark.parametrize(
    "weights", [{"energy": 0.0, "distance": 0.0}, {"energy": 0.0, "change": 0.0}, {"change": 0.0, "distance": 0.0}]
)
def test_every_light_is_explored_whatever_the_weights(weights):
    """Else estimates are biased: nobody finds a light that stands still. Or such weights are refused."""
    try:
        estimator = gi.VisibilityLightCache(explores_by="table", **weights)
    except gi.OptionError:
        assert "change" not in weights
        return
    scene = moving_scene()
    frame, state = preprocessed(scene, estimator)
    assert (explored_by_table(frame) > 0).all()
    frame, _ = preprocessed(scene, estimator, state, 0.5)
    assert (explored_by_table(frame) > 0).all()


# ---- lists of lights ----


def lists(values):
    """LightLists of the entries of each leaf."""
    out = light_cache_build.LightLists()
    counts = np.array([len(x) for x in values])
    out.offsets, out.counts = array(np.cumsum(counts) - counts), array(counts)
    out.entries = array(np.array([e for x in values for e in x], np.int32))
    return out


def entries_of(found):
    offsets, counts, entries = (x.numpy() for x in (found.offsets, found.counts, found.entries))
    return [entries[begin : begin + count].tolist() for begin, count in zip(offsets, counts, strict=True)]


def words(emitters, visible, rng):
    """What samples remember of lights; -1: none was sampled."""
    value = (np.asarray(emitters) + 1) | np.where(visible, VISIBLE, 0)
    return value | np.where(rng.random(len(value)) < 0.3, GLOSSY, 0)


def leaf_samples(counts, order, most):
    grouped = samples.LeafSamples()
    grouped.starts, grouped.counts = array(np.cumsum(counts) - counts), array(counts)
    grouped.order, grouped.most = array(order), most
    return grouped


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
    word = words(emitters, visible, rng)
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
                lights.add((w & ((1 << 28) - 1)) - 1)
        assert found[leaf] == [e << 8 for e in sorted(lights)]
    assert most < 1 << 20 or len(found[10]) == MOST_LISTED


def test_looks_are_spread():
    """Every sample saw another light, so the list says which were looked at."""
    rng = np.random.default_rng(1)
    count, most = 1000, 300
    found = listed(leaf_samples([count], np.arange(count), most), words(np.arange(count), True, rng))
    looked = np.array(found[0]) >> 8
    assert len(looked) == most and set(np.diff(looked)) == {3, 4} and looked[0] < 4 and looked[-1] >= count - 4


def test_hash_collisions():
    """Lights whose hashes agree in all bits that a small table uses, up to a table that is half full."""
    rng = np.random.default_rng(2)
    emitters = np.arange(1 << 22)
    hashes = (((emitters << 8) * 0x9E3779B1) & 0xFFFFFFFF) >> 12
    same = emitters[(hashes & 1023) == 1023][:900]
    found = listed(leaf_samples([900], np.arange(900), 900), words(same, True, rng))
    assert found[0] == [e << 8 for e in same]


def light_samples(rng, count):
    """What light samples brought, and the shares of exploring in their densities and of samples."""
    values = 10 ** rng.uniform(-2, 1, count) * (rng.random(count) < 0.9)
    shares = rng.choice([0.02, 0.1, 0.4, 0.9, 1.0], count)
    posteriors = np.where(rng.random(count) < 0.3, rng.choice([0.0, 1.0], count), rng.random(count))
    return values, np.rint(posteriors * 65535).astype(np.int64) | np.rint(shares * 65535).astype(np.int64) << 16


def deep_lesson(seed=3, count=20_000, lights=203):
    """Samples of a cluster on a tree of many levels, each with a light of lit_scene."""
    rng = np.random.default_rng(seed)
    settings = gi.SampleOctree(split=64, collapse=32)
    state = settings.start(SimpleNamespace(bounds=np.array([[0, 0, 0], [1, 1, 1]], np.float32)), device())
    records = samples.SampleRecords()
    codes = (1 << 29) + (np.abs(rng.normal(size=count)) * 2.0 ** rng.integers(5, 26, count)).astype(np.int64)
    emitters = (rng.integers(0, 20, count) + codes // (1 << 20)) % lights
    word = words(emitters, rng.random(count) < 0.7, rng)
    records.codes, records.lights = array(codes, wp.uint32), array(word, wp.uint32)
    for name in ("directions", "mixtures"):
        setattr(records, name, wp.zeros(count, dtype=wp.uint32, device=device()))
    records.contributions = wp.zeros(count, dtype=wp.float32, device=device())
    values, mixtures = light_samples(rng, count)
    records.light_values, records.light_mixtures = array(values, wp.float32), array(mixtures, wp.uint32)
    return settings, settings.learn(state, records, device())


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


def joined(seen, known, neighbours, origins, memory):
    out, leaves = lists([[]] * len(seen)), len(seen)
    around = [lists(seen), lists(known), array(np.ravel(neighbours)), array(origins)]
    launch(light_cache_build.bound_lists, leaves, [*around, out.counts], device())
    counts = out.counts.numpy().copy()
    out.offsets = array(np.cumsum(counts) - counts)
    out.entries = wp.full(int(counts.sum()), -7, dtype=wp.int32, device=device())
    launch(light_cache_build.join_lights, leaves, [*around, out, memory], device())
    return entries_of(out)


def expected_join(seen, known, neighbours, origins, memory):
    out = []
    for leaf, origin in enumerate(origins):
        ages = {}
        if origin >= 0:
            ages = {e >> 8: (e & 255) + 1 for e in known[origin]}
            for other in (leaf, *(n for n in neighbours[leaf] if n >= 0)):
                ages |= {e >> 8: 0 for e in seen[other]}
        out.append([e << 8 | age for e, age in sorted(ages.items()) if age <= memory][:MOST_LISTED])
    return out


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
    neighbours = np.where(rng.random((leaves, 6)) < 0.7, rng.integers(0, leaves, (leaves, 6)), -1)
    origins = np.where(rng.random(leaves) < 0.9, rng.integers(0, places, leaves), -1)
    found = joined(seen, known, neighbours, origins, memory)
    assert found == expected_join(seen, known, neighbours, origins, memory)


def test_joined_lists_end():
    """Of more than 1,024 lights the first are kept, of whichever list."""
    own, others, old = range(0, 3000, 3), range(1, 3000, 3), range(2, 3000, 3)
    seen = [[e << 8 for e in own], [e << 8 for e in others]]
    found = joined(seen, [[e << 8 for e in old]], [[1] + [-1] * 5, [-1] * 6], [0, -1], 4)
    assert [e >> 8 for e in found[0]] == list(range(MOST_LISTED)) and found[1] == []


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
    data = frame.lights.data
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
    """Against NumPy's order; lights of equal importance may swap places."""
    data = dimmed_cache()
    _, lesson = deep_lesson()
    rng = np.random.default_rng(capacity)
    places = cells_of(lesson)
    leaves = len(places)
    emitters = [np.sort(rng.choice(203, n, replace=False)) for n in rng.choice([0, 1, 5, 31, 32, 33, 150], leaves)]
    emitters[3] = np.arange(0, 200, 10)  # that emit nothing
    given = lists([[int(e) << 8 | 3 for e in x] for x in emitters])
    given.offsets = array(given.offsets.numpy() + 7)
    given.entries = array(np.concatenate([np.full(7, -1), given.entries.numpy()]))
    out = wp.full(given.entries.shape[0], -5.0, dtype=wp.float32, device=device())
    sums = wp.full(leaves, -5.0, dtype=wp.float32, device=device())
    inputs = [data, lesson.octree.octree, lesson.tree, given, capacity, out, sums]
    launch(light_cache_build.rank_lights, leaves, inputs, device())
    found, expected = out.numpy(), importances_of(data, places)
    assert (found[:7] == -5).all(), "a leaf that wrote into another's place"
    for leaf, offset in enumerate(given.offsets.numpy()):
        here, all_of_them = found[offset : offset + len(emitters[leaf])], expected[leaf, emitters[leaf]]
        main = here == MAIN
        assert main.sum() == min(capacity, len(here))
        assert np.allclose(here[~main], all_of_them[~main], rtol=1e-5)
        if main.any() and not main.all():
            assert all_of_them[main].min() >= all_of_them[~main].max() * (1 - 1e-5)
        assert np.isclose(sums.numpy()[leaf], all_of_them[main].sum(), rtol=1e-5)


# ---- buckets ----


def settings_of(capacity=32, hysteresis=0.75):
    s = light_cache_build.CacheSettings()
    s.capacity, s.hysteresis = capacity, hysteresis
    return s


def bucketed(emitters, importances, before, capacity):
    """CacheTables of regions with these emitters, that had ``before`` buckets."""
    settings, leaves = settings_of(capacity), len(emitters)
    given = lists([[int(e) << 8 | 1 for e in x] for x in emitters])
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
    inputs = [settings, given, ranked, array(range(leaves)[::-1]), known, tables.buckets, sizes]
    launch(light_cache_build.count_buckets, leaves, inputs, device())
    numbers = sizes.numpy().copy()
    assert np.array_equal(numbers, tables.buckets.numpy() + [len(x) for x in emitters])
    tables.offsets = array(np.cumsum(numbers) - numbers)
    tables.items = wp.full(int(numbers.sum()), -7, dtype=wp.int32, device=device())
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
    """The least power of two that holds the lights; fewer than before only where three quarters hold them."""
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
    tables = bucketed(emitters, importances, before, capacity)
    offsets, ends = tables.offsets.numpy(), tables.chances.numpy()
    for k, (held, chances) in enumerate(contents_of(tables)):
        lights, likely = expected_buckets(emitters[k], importances[k], before[k], capacity)
        assert held == lights, (len(emitters[k]), before[k])
        assert np.allclose(chances, likely, atol=3e-6)
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


@both_ways
def test_buckets_that_overflow_leave_lights_to_exploration(explores_by):
    """Probabilities sum to one all the same, of all lights."""
    frame, data, _ = lit_cache(explores_by)
    emitters = [list(range(203)), list(range(0, 203, 64)), list(range(100))]
    rng = np.random.default_rng(1)
    data.tables = bucketed(emitters, [rng.uniform(0, 1, len(x)) for x in emitters], [0, 0, 65], 1)
    held = contents_of(data.tables)[0][0]
    assert len(held) == 1 + MOST_BUCKETS == sum(map(len, held)) < 203
    spots = spots_in(np.arange(3))
    pdfs, explores = probabilities(frame, data, spots), explored(frame, data, spots)
    assert np.allclose(pdfs.sum(axis=1), 1.0 - 0.1 * (1 - explores.sum(axis=1)), atol=2e-5)
    assert (pdfs[asked(weigh_lights, data, frame, spots) > 0] > 0).all()


# ---- exploration that adapts ----


def exploration_tables(moments, shares):
    tables = light_cache.CacheTables()
    tables.moments = array(moments, light_cache.ExplorationMoments)
    tables.exploration = array(shares, wp.float32)
    return tables


def records_of(lights, values, mixtures):
    records = samples.SampleRecords()
    records.lights, records.light_values = array(lights, wp.uint32), array(values, wp.float32)
    records.light_mixtures = array(mixtures, wp.uint32)
    return records


def adapted(grouped, records, origins, known, first_share):
    """Return the moments and the shares of every leaf."""
    leaves = len(origins)
    tables = exploration_tables(np.full((leaves, 6), -7.0), np.full(leaves, -7.0))
    inputs = [grouped, records, array(origins), known, tables, first_share]
    launch(light_cache_build.adapt_exploration, leaves, inputs, device(), 16)
    return tables.moments.numpy(), tables.exploration.numpy()


def expected_exploration(grouped, records, origins, known, first_share):
    """Float64 moments, and which shares may be chosen: those whose moments are the least but for rounding."""
    lights, values, mixtures = (getattr(records, n).numpy() for n in ("lights", "light_values", "light_mixtures"))
    starts, counts, order = (getattr(grouped, n).numpy().astype(np.int64) for n in ("starts", "counts", "order"))
    moments, shares = np.zeros((len(origins), 6)), []
    for leaf, origin in enumerate(origins):
        last = [first_share]
        if origin >= 0:
            moments[leaf], last = known.moments.numpy()[origin], [known.exploration.numpy()[origin]]
        looks = min(counts[leaf], grouped.most)
        if looks > 0:
            slots = order[starts[leaf] + np.arange(looks) * counts[leaf] // looks]
            slots = slots[(lights[slots] >= VISIBLE) & (mixtures[slots] >> 16 < KNEW_NOTHING)]
            share = (mixtures[slots] >> 16).clip(1, 65534)[:, None] / 65535
            posterior = (mixtures[slots] & 65535)[:, None] / 65535
            # of the density that the sample had, what the mixture with another share has
            ratios = EXPLORATIONS * posterior / share + (1 - EXPLORATIONS) * (1 - posterior) / (1 - share)
            squares = values[slots, None].astype(np.float64) ** 2
            moments[leaf] = FADING * moments[leaf] + (squares / ratios.clip(1e-6)).sum(axis=0)
            if moments[leaf].max() > 0:
                last = EXPLORATIONS[moments[leaf] <= moments[leaf].min() * (1 + 1e-4)]
        shares.append(last)
    return moments, shares


def check_exploration(found, expected):
    assert np.allclose(found[0], expected[0], rtol=1e-4, atol=0)
    for leaf, (share, possible) in enumerate(zip(found[1], expected[1], strict=True)):
        assert np.isclose(share, possible, rtol=1e-6).any(), (leaf, share, possible)


@pytest.mark.parametrize("most", [1, 30, 1 << 20])
def test_exploration_with_the_least_second_moment(most):
    """Over frames, in each of which leaves have other samples and take over what other leaves knew."""
    rng = np.random.default_rng(most)
    chosen, known = [], exploration_tables(np.zeros((40, 6)), rng.uniform(0.1, 0.9, 40))
    for leaves in (60, 30, 50):
        counts = rng.choice([0, 1, 2, 40, 300], leaves)
        counts[:2] = 0
        total = counts.sum()
        lights = words(rng.integers(-1, 40, total), rng.random(total) < 0.7, rng)
        records = records_of(lights, *light_samples(rng, total))
        grouped = leaf_samples(counts, rng.permutation(total), most)
        origins = rng.integers(0, known.exploration.shape[0], leaves)
        origins[rng.random(leaves) < 0.2] = -1
        origins[:2] = -1, 7
        expected = expected_exploration(grouped, records, origins, known, 0.15)
        found = adapted(grouped, records, origins, known, 0.15)
        check_exploration(found, expected)
        none = counts == 0
        old = none & (origins >= 0)
        assert old.any() and (none & ~old).any()
        assert np.array_equal(found[0][old], known.moments.numpy()[origins[old]])
        assert np.array_equal(found[1][old], known.exploration.numpy()[origins[old]])
        assert (found[1][none & ~old] == np.float32(0.15)).all() and (found[0][none & ~old] == 0).all()
        chosen += found[1][~none].tolist()
        known = exploration_tables(*found)
    found = set(np.float32(chosen))  # one sample wants as much or as little as there is
    assert set(np.float32(EXPLORATIONS if most > 1 else EXPLORATIONS[[0, -1]])) <= found


@pytest.mark.parametrize(
    ("light", "value", "mixture"),
    [(VISIBLE | 5, 3.0, KNEW_NOTHING << 16 | 65535), (5, 3.0, 6554 << 16 | 65535), (VISIBLE | 5, 0.0, 6554 << 16 | 9)],
    ids=["of regions that knew nothing", "that did not arrive", "that brought nothing"],
)
def test_samples_that_say_nothing_of_exploration(light, value, mixture):
    """What was known fades all the same, and the share stays; the first one, where nothing was."""
    known = exploration_tables([[0.0] * 6, [9.0, 8.0, 7.0, 2.0, 3.0, 4.0]], [0.33, 0.4])
    records = records_of([light] * 15, [value] * 15, [mixture] * 15)
    moments, shares = adapted(leaf_samples([5, 5, 5], range(15), 9), records, np.array([0, 1, -1]), known, 0.15)
    assert np.allclose(shares, [0.33, 0.4, 0.15])
    assert np.allclose(moments, [[0.0] * 6, np.multiply(FADING, [9, 8, 7, 2, 3, 4]), [0.0] * 6])


def test_kept_lights():
    """Emitter, whether it was seen, what it brought, and how it came about, of samples as paths keep them."""
    rng = np.random.default_rng(3)
    count = 1000
    items, visible = rng.integers(-1, 1 << 23, count), rng.integers(0, 2, count)
    mixtures, values = rng.random((count, 2)), rng.random(count)
    items[:2], mixtures[:4] = [-1, (1 << 23) - 1], [(0, 0), (1, 1), (1.0001, 1), (0.5, 1 - 2**-24)]
    regions = samples.SampleRegions()
    regions.records = records_of(np.where(rng.random(count) < 0.3, GLOSSY, 0), np.zeros(count), np.zeros(count))
    before = regions.records.lights.numpy().copy()
    given = [array(items), array(mixtures, wp.vec2), array(visible), array(values, wp.float32)]
    launch(keep_lights, count, [regions, *given], device())
    found = regions.records
    assert np.array_equal(found.lights.numpy(), before | (items + 1) | np.where(visible, VISIBLE, 0))
    assert np.array_equal(found.light_values.numpy(), np.float32(values))
    word, most = found.light_mixtures.numpy(), 1 / 65535
    assert np.abs((word & 65535) * most - mixtures[:, 0].clip(0, 1)).max() < 0.51 * most
    assert np.abs((word >> 16) * most - mixtures[:, 1]).max() < 0.51 * most
    assert word[1] >> 16 == KNEW_NOTHING and word[0] == 0


def learnt_exploration(contents, unseen=(), frames=4):
    """Return each PLACE's share after some frames in a region of ``contents``, all of whose lights but some arrive."""
    frame, data, _ = lit_cache("table")
    rng = np.random.default_rng(7)
    places = len(PLACES)
    spots = spots_in([0])
    spots.regions = array(np.arange(places))
    light = asked(weigh_lights, data, frame, spots)
    light[:, list(unseen)] = 0.0
    shares, known = np.full(places, 0.1), exploration_tables(np.zeros((places, 6)), np.full(places, 0.1))
    for _ in range(frames):
        data.tables = table([(*contents, share) for share in shares.tolist()])
        items, pdfs, mixtures = choices(frame, data, spots, rng.random((4000, 2)).astype(np.float32))
        values = light[np.arange(places)[:, None], items] / pdfs
        regions = samples.SampleRegions()
        regions.records = records_of(np.zeros(items.size), np.zeros(items.size), np.zeros(items.size))
        given = [array(items.ravel()), array(mixtures.reshape(-1, 2), wp.vec2), array((values > 0).ravel())]
        launch(keep_lights, items.size, [regions, *given, array(values.ravel(), wp.float32)], device())
        grouped = leaf_samples(np.full(places, 4000), np.arange(items.size), 1 << 20)
        moments, shares = adapted(grouped, regions.records, np.arange(places), known, 0.1)
        known = exploration_tables(moments, shares)
    return shares[light.sum(axis=1) > 0], light


def test_exploration_falls_where_the_cache_holds_all_that_matters():
    """One bucket, weighed for the very point; nothing arrives of the many lights that it does not know."""
    known = [*range(0, 200, 7), 200, 201, 202]
    hidden = np.setdiff1d(np.arange(203), known)
    shares, light = learnt_exploration((known, [], 0), hidden)
    assert len(shares) > 6 and (light > 0).sum(axis=1).max() > 12
    assert np.allclose(shares, 0.05), shares


def test_exploration_rises_where_the_cache_cannot_hold_what_matters():
    """It knows a few of many lights."""
    shares, _ = learnt_exploration(([40, 41], [], 0))
    assert len(shares) > 6 and (shares >= 0.65).mean() > 0.7, shares
    # and a few hidden ones that it takes to be there
    shares, _ = learnt_exploration((range(0, 20), [], 0), range(0, 20))
    assert np.allclose(shares, 0.9), shares


# ---- all of it ----


def test_a_region_knows_what_it_and_its_neighbours_saw():
    """Three frames of learning, each of other samples, against sets."""
    estimator = gi.VisibilityLightCache(memory=1, capacity=8)
    frame, state = preprocessed(lit_scene(), estimator)
    known = [[]] * 8
    settings, lesson = deep_lesson(10)
    for turn in range(3):
        origins, neighbours = lesson.origins.numpy(), lesson.neighbours.numpy().reshape(-1, 6)
        starts, counts, order = (getattr(lesson.samples, n).numpy() for n in ("starts", "counts", "order"))
        word = lesson.records.lights.numpy()
        seen = [[]] * len(origins)
        for leaf in np.flatnonzero(origins >= 0):
            w = word[order[starts[leaf] : starts[leaf] + counts[leaf]]]
            seen[leaf] = [int(e) << 8 for e in np.unique((w[w >= VISIBLE] & ((1 << 28) - 1)).astype(int) - 1)]
        before = state.tables.buckets.numpy()
        shares = expected_exploration(lesson.leaf_samples(2048), lesson.records, origins, state.tables, 0.1)
        state = estimator.learn(lesson, state)
        expected = expected_join(seen, known, neighbours, origins, 1)
        assert entries_of(state.known) == expected
        importances = importances_of(frame.lights.data, cells_of(lesson))
        buckets = []
        for leaf, (found, entries) in enumerate(zip(contents_of(state.tables), expected, strict=True)):
            last = before[origins[leaf]] if origins[leaf] >= 0 else 0
            emitters = [e >> 8 for e in entries]
            held, chances = expected_buckets(emitters, importances[leaf, emitters], last, 8)
            assert found[0] == held
            assert np.allclose(found[1], chances, atol=2e-6)
            buckets.append(len(held))
        assert max(buckets) > 3 and min(buckets) == 0
        assert ((origins >= 0) & (counts == 0)).any()
        check_exploration([x.numpy() for x in (state.tables.moments, state.tables.exploration)], shares)
        known = expected
        _, other = deep_lesson(11 + turn, 20_000 // (turn + 1))
        lesson = settings.learn(lesson.octree, other.records, device())


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
            results.append((used, *(x.numpy().tolist() for x in (t.buckets, t.offsets, t.exploration, t.moments))))
    finally:
        set_threads(None)
    assert results[0] == results[1]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"capacity": 0}, "capacity"),
        ({"capacity": 33}, "capacity"),
        ({"exploration": 0.0}, "exploration"),
        ({"exploration": 1.0}, "exploration"),
        ({"exploration": -0.1}, "exploration"),
        ({"exploration": float("nan")}, "exploration"),
        ({"explores_by": "power"}, "way to explore"),
        ({"memory": -1}, "memory"),
        ({"memory": 201}, "memory"),
        ({"samples": 0}, "samples"),
        ({"samples": (1 << 24) + 1}, "samples"),
        ({"energy": -1.0}, "energy"),
        ({"change": float("inf")}, "energy"),
        ({"distance": float("nan")}, "energy"),
        ({"energy": 0.0, "change": 0.0, "distance": 0.0}, "energy"),
    ],
)
def test_settings_are_checked(settings, message):
    with pytest.raises(gi.OptionError, match=message):
        gi.VisibilityLightCache(**settings)


def test_more_lights_than_entries_can_name():
    """An entry has 23 bits for the emitter; beyond, it would be negative."""
    with pytest.raises(gi.OptionError, match="emitters"):
        gi.VisibilityLightCache().start(SimpleNamespace(emitter_count=(1 << 23) + 1, name="stars"), str(device()), None)


# ---- pictures ----

SIZE = (24, 16)


@cache
def divided_room(moves=False):
    """A room with a wall across: lamps behind it are brighter than those before it, whose floor is glossy."""
    white = gi.Material("white", (0.7, 0.7, 0.7), specular=0.0)
    glossy = gi.Material("glossy", (0.4, 0.3, 0.2), roughness=0.35)
    shell = [
        quad((-4, 0, -2), (0, 0, 4), (8, 0, 0), glossy),
        quad((-4, 3, -2), (8, 0, 0), (0, 0, 4), white),
        quad((-4, 0, -2), (8, 0, 0), (0, 3, 0), white),
        quad((-4, 0, -2), (0, 3, 0), (0, 0, 4), gi.Material("red", (0.7, 0.2, 0.2), specular=0.0)),
        quad((0.5, 0, -2), (0, 0, 4), (0, 2.8, 0), white),
        quad((-2.6, 0, -0.8), (0.8, 0, 0), (0, 0.9, 0.3), white),
    ]
    rng = np.random.default_rng(5)
    lamps = []
    for i in range(20):
        hidden = i % 2
        corner = (rng.uniform(1, 3.5) if hidden else rng.uniform(-3.5, 0), 2.9, rng.uniform(-1.5, 1.5))
        emission = tuple(rng.uniform(5, 9, 3) * (8 if hidden else 1))
        lamps.append(quad(corner, (0.25, 0, 0), (0, 0, 0.25), light(emission)))
    lights = [
        gi.PunctualLight("point", (0.5, 0.6, 0.7), position=(-1.0, 1.0, 1.0)),
        gi.PunctualLight("spot", (2.0, 2.0, 2.0), position=(-3.0, 2.5, 0.0), direction=(0.2, -1.0, 0.0)),
    ]
    keys = [gi.Keyframe(0.0, (0.0, 0.0, 0.0)), gi.Keyframe(0.2, (0.6, -0.3, 0.2))] if moves else None
    return gi.Scene([gi.Node("shell", shell), gi.Node("lamps", lamps, keyframes=keys)], lights)


def rendered(scene, emitters, seeds, frames):
    """Return {buffer: [frame, seed, height, width, 3]} of sequences that start at frame 0."""
    pipeline = gi.Pipeline(
        environment=None,
        emitters=emitters,
        indirect=gi.BsdfPaths(max_depth=3),
        spp=4,
        octree=gi.SampleOctree(split=64, collapse=32),
    )
    camera = gi.Camera.look_at((-1.2, 1.6, 1.9), (-2.2, 0.6, -1.5), hfov=75, resolution=SIZE)
    path = gi.CameraPath.still(camera)
    out = {"emitters": [], "indirect": []}
    for seed in seeds:
        wanted = range(max(frames) + 1) if isinstance(emitters, gi.VisibilityLightCache) else frames
        made = {f.index: f for f in gi.render(scene, path, pipeline, frames=wanted, device=str(device()), seed=seed)}
        for buffer, images in out.items():
            images.append([made[index].numpy(buffer).astype(np.float64) for index in frames])
    return {buffer: np.swapaxes(images, 0, 1) for buffer, images in out.items()}


def test_scene_without_lights():
    """There is nothing to cache, nor to learn; the sky shines all the same."""
    grey = gi.Material("grey", (0.5, 0.5, 0.5), specular=0.0)
    scene = gi.Scene([gi.Node("floor", [quad((-3, 0, -3), (0, 0, 6), (6, 0, 0), grey)])], environment=(1.0, 1.0, 1.0))
    camera = gi.CameraPath.still(gi.Camera.look_at((0, 1, 0.5), (0, 0, 0), hfov=40, resolution=(16, 16)))
    pipeline = gi.Pipeline(emitters=gi.VisibilityLightCache(), indirect=None, spp=1)
    for frame in gi.render(scene, camera, pipeline, frames=range(2), device=str(device())):
        assert np.allclose(frame.numpy("beauty"), 0.5, rtol=1e-4)


class WatchedCache(gi.VisibilityLightCache):
    """Remembers what it learnt from, and what the samples were taken by."""

    def learn(self, lesson, state):
        """As the other does."""
        values = [getattr(lesson.records, n).numpy() for n in ("codes", "lights", "light_values", "light_mixtures")]
        watched.append((values, state.tables.exploration.numpy()))
        return super().learn(lesson, state)


watched = []


def test_samples_remember_what_they_brought_to_the_picture():
    """Where lights have no size, that is all the light that there is, at whichever vertex of a path."""
    grey = gi.Material("grey", (0.7, 0.6, 0.5), specular=0.0)
    walls = [quad((-2, 0, -2), (0, 0, 4), (4, 0, 0), grey), quad((-2, 0, -2), (4, 0, 0), (0, 3, 0), grey)]
    lights = [gi.PunctualLight("point", (0.5 + k, 1.0, 0.7), position=(k - 1.5, 1.0, 0.5)) for k in range(4)]
    scene = gi.Scene([gi.Node("walls", walls)], lights)
    camera = gi.CameraPath.still(gi.Camera.look_at((0, 1.5, 3.0), (0, 0.8, -1), hfov=50, resolution=SIZE))
    pipeline = gi.Pipeline(
        environment=None, emitters=WatchedCache(), indirect=gi.BsdfPaths(max_depth=3), spp=4, octree=gi.SampleOctree()
    )
    watched.clear()
    shares = set()
    for frame in gi.render(scene, camera, pipeline, frames=range(3), device=str(device())):
        emitters, indirect = (frame.numpy(x).astype(np.float64) for x in ("emitters", "indirect"))
        (codes, words_kept, values, mixtures), exploration = watched[-1]
        there = (codes != 0xFFFFFFFF) & ((words_kept & ((1 << 28) - 1)) > 0)
        seen = words_kept[there] >= VISIBLE
        assert (values[there][seen] > 0).all() and (values[there][~seen] == 0).all() and 0 < seen.mean()
        assert indirect.sum() > 0.03 * emitters.sum()
        assert np.isclose(values[there].sum() / 4, ((emitters + indirect) @ LUMINANCE).sum(), rtol=1e-3)
        kept = set((mixtures[there] >> 16).tolist())
        assert kept <= {KNEW_NOTHING, *np.rint(exploration * 65535.0).astype(int).tolist()}
        shares |= kept
    assert len(watched) == 3 and KNEW_NOTHING in shares and len(shares) > 1


@cache
def by_hierarchy(moves, name):
    """The reference on the device of that name. Nothing has moved in the first frame."""
    if not moves:
        return rendered(divided_room(), gi.LightHierarchy(), range(100, 196), (0, 5))
    sixth = rendered(divided_room(True), gi.LightHierarchy(), range(100, 196), (5,))
    return {buffer: [images[0], sixth[buffer][0]] for buffer, images in by_hierarchy(False, name).items()}


@pytest.mark.parametrize(
    ("moves", "explores_by"),
    [(False, "hierarchy"), (True, "hierarchy"), (True, "table")],
    ids=["still", "moving", "moving-table"],
)
def test_pictures_equal_those_of_the_hierarchy(moves, explores_by):
    """The first frame, in which nothing is known, and the sixth; and the cache is worth it: lamps are hidden."""
    ours = rendered(divided_room(moves), gi.VisibilityLightCache(explores_by=explores_by), range(1, 25), (0, 5))
    theirs = by_hierarchy(moves, device().alias)
    for buffer in ours:
        for k, index in enumerate((0, 5)):
            if index == 0 and explores_by == "table":  # by power alone, which few seeds say little of
                continue
            mean, variance = st.mean_and_variance(theirs[buffer][k])
            name = f"light_cache_{explores_by}_{buffer}_{index}"
            st.compare_images(name, ours[buffer][k], mean, variance, 1e-4, 95, noise_ratio=0.1)
    noise = [np.median(images["emitters"][1].var(axis=0).mean(axis=-1)) for images in (ours, theirs)]
    assert noise[0] < 0.5 * noise[1], noise
