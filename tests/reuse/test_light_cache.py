"""Sampling lights from the tables of the visibility light cache: probabilities, choices, and weights of lights."""

from __future__ import annotations

import numpy as np
import pytest
import statistics_tools as st
import warp as wp
from light_cache_tools import (
    CONTENTS,
    FLOOR,
    LUMINANCE,
    METAL_FLOOR,
    PLACES,
    ROOF,
    ROUNDING,
    VIEWS,
    Spots,
    alone_at,
    array,
    asked,
    choices,
    contents_of,
    expected_times,
    explored,
    learnt_cache,
    lit_cache,
    probabilities,
    random_cache,
    rates_of,
    spots_in,
    table,
    weigh_lights,
)
from statistics_tools import chi_squared, device, every_device  # noqa: F401

from warp_gi.alias import AliasTable
from warp_gi.kernels import bsdf, light_cache, light_cache_native, ltc, types
from warp_gi.launch import launch
from warp_gi.techniques.light_hierarchy.bounds import EmitterBounds
from warp_gi.techniques.light_hierarchy.tree import build_tree, to_device
from warp_gi.techniques.reuse.light_cache import EXPLORES_BY
from warp_gi.techniques.shared.ltc import ltc_table

wp.set_module_options({"enable_backward": False})

LEFT_OUT = -1.0


# Points that see buckets of triangles; a material is metallic, roughness and specular (below 0: plain Lambert).
@wp.struct
class LanePoints:
    origins: wp.array(dtype=wp.vec3)
    shadings: wp.array(dtype=wp.mat33)
    views: wp.array(dtype=wp.vec3)  # in the shading frame
    materials: wp.array(dtype=wp.vec3)
    counts: wp.array(dtype=wp.int32)  # lights of the bucket, which begins at 32 * point + 5
    items: wp.array(dtype=wp.int32)
    rates: wp.array(dtype=wp.float32)
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
# Thread: a point.
@wp.kernel
def weigh_in_lanes(first: wp.int32, points: LanePoints, table: ltc.LtcTable, weights: wp.array2d(dtype=wp.float32)):
    i = first + wp.tid()
    w = lobes_at(points, table, i)
    origin = points.origins[i]
    found = light_cache_native.weigh_triangles(
        points.shapes, points.items, points.rates, 32 * i + 5, points.counts[i], origin, points.shadings[i], w
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


@wp.kernel
def weigh_choices(
    first: wp.int32,
    own: wp.array(dtype=wp.float32),
    other: wp.array(dtype=wp.float32),
    weights: wp.array(dtype=wp.float32),
):
    i = first + wp.tid()
    weights[i] = light_cache.choice_weight(own[i], other[i])


# ---- probabilities ----

CACHES = {"made": lit_cache, "random": random_cache, "learnt": learnt_cache}
both_ways = pytest.mark.parametrize("explores_by", EXPLORES_BY)
all_caches = pytest.mark.parametrize("kind", CACHES)


def faces_of(spots):
    return np.array([face for face, _ in PLACES])[np.arange(spots.faces.shape[0]) % len(PLACES)]


def expected_offers(frame, data, spots):
    """Probabilities with which the cache selects lights, by weights one at a time; and these weights.

    In between: how much a probability may be off by the rounding of the weights.
    """
    weights = asked(weigh_lights, data, frame, spots)
    contents, rates = contents_of(data.tables), rates_of(data.tables)
    luminances = data.shapes.numpy()["luminance"]
    expected, slack = np.zeros_like(weights), np.zeros_like(weights)
    lambert = np.isin(faces_of(spots), (FLOOR, ROOF))
    for row, region in enumerate(spots.regions.numpy()):
        for lights, chance in zip(*contents[region], strict=True):
            rate = np.array([rates[region][e] for e in lights])
            weight = weights[row, lights] * rate
            total = weight.sum()
            expected[row, lights] = chance * (weight / total if total > 0 else 1 / max(len(lights), 1))
            if total > 0:
                error = ROUNDING[0] * weight + (0.0 if lambert[row] else ROUNDING[1]) * luminances[lights] * rate
                least = max(total - error.sum(), 1e-30)
                slack[row, lights] = chance * np.minimum(error / least + weight / total * error.sum() / least, 1.0)
    return expected, slack, weights


@both_ways
@all_caches
def test_probabilities_sum_to_one(kind, explores_by):
    """Of the cache where it holds something, else to zero; of exploring always.

    Or to what the hierarchy's do: it offers nothing where all lights that have a place are below the horizon.
    """
    frame, data, spots = CACHES[kind](explores_by)
    (pdfs, offered), explores = probabilities(frame, data, spots), explored(frame, data, spots)
    assert frame.data.emitters.count == 203
    holds = data.tables.buckets.numpy()[spots.regions.numpy()] > 0
    assert np.allclose(offered[holds].sum(axis=1), 1, atol=2e-5) and (offered[~holds] == 0).all()
    assert 0 < holds.mean() < 1 and (offered >= 0).all()
    sums = explores.sum(axis=1)
    whole = np.abs(sums - 1) < 1e-4
    assert np.array_equal(whole, (faces_of(spots) != ROOF) | (explores_by == "table"))
    assert (sums <= 1 + 1e-4).all() and (sums[~whole] < 0.9).all()
    share = np.where(alone_at(data, spots), 1.0, data.tables.exploration.numpy()[spots.regions.numpy()])
    assert np.allclose(pdfs.sum(axis=1), ~alone_at(data, spots) + share * sums, atol=2e-5)
    weights = asked(weigh_lights, data, frame, spots)
    assert (pdfs[weights > 0] > 0).all(), "a light that nothing selects, though it shines there"
    assert explores_by == "hierarchy" or (pdfs > 0).all()


@both_ways
@all_caches
def test_probabilities_are_those_of_both_choices(kind, explores_by):
    """That of the cache, and the share that explores times that of exploring; or that of exploring alone."""
    frame, data, spots = CACHES[kind](explores_by)
    pdfs, _ = probabilities(frame, data, spots)
    first, second = expected_times(frame, data, spots)
    assert np.allclose(pdfs, first + second, rtol=1e-6, atol=0)
    # sums in which each part matters
    for part in (first, second):
        assert ((part > 0.1 * pdfs) & (part < 0.9 * pdfs)).any()


@both_ways
@all_caches
def test_probabilities_are_those_of_the_weights(kind, explores_by):
    """However many lights are weighed at once, by whatever means; of every sort of light, on every sort of surface."""
    frame, data, spots = CACHES[kind](explores_by)
    _, offered = probabilities(frame, data, spots)
    expected, slack, weights = expected_offers(frame, data, spots)
    assert (weights >= 0).all() and (weights > 0).mean() > 0.2
    off = np.abs(offered - expected)
    for row in np.flatnonzero((off > 1e-6 + slack).any(axis=1)):
        raise AssertionError((spots.regions.numpy()[row], PLACES[row % len(PLACES)], np.argmax(off[row] - slack[row])))
    there, metal = expected > 0, (faces_of(spots) == METAL_FLOOR)[:, None]
    of_lambert, of_metal = there & ~metal, there & metal
    assert np.median(slack[of_lambert] / expected[of_lambert]) < 0.01 and np.median(slack[of_metal]) < 0.1


def test_lights_weigh_as_much_as_their_rates():
    """Those weighed eight at a time; those that cross the horizon, which ltc.py weighs; and those without size."""
    frame, data, _ = lit_cache()
    groups = {"eight": [0, 1, 4, 5, 10, 11, 14, 15], "crossing": [6, 7, 16, 17, 26, 27], "no size": [200, 201, 202]}
    emitters = sorted(e for lights in groups.values() for e in lights)
    rates = np.random.default_rng(2).uniform(0.12, 1, 203).astype(np.float32)
    spots = spots_in([0])
    by_rates = []
    for each in (np.ones(203), rates):
        data.tables = table([(emitters, [], 0, 0.1)], each)
        by_rates.append(probabilities(frame, data, spots)[1])
    before, after = by_rates
    floors = faces_of(spots) != ROOF
    for lights in groups.values():
        assert (before[np.ix_(floors, lights)] > 1e-3).any(axis=1).sum() > 5
    expected = before * rates
    expected /= expected.sum(axis=1, keepdims=True)
    assert np.allclose(after, expected, rtol=2e-5, atol=1e-9)


def test_lights_that_reflect_nothing_are_equal():
    """Not a division by zero: a bucket whose lights are all below the horizon, whatever their rates."""
    frame, data, spots = lit_cache("table")
    region = list(CONTENTS).index("turned away")
    emitters = contents_of(data.tables)[region][0][0]
    _, offered = probabilities(frame, data, spots)
    assert np.allclose(offered[region * len(PLACES), emitters], 1 / len(emitters), atol=1e-6)


def test_lights_are_selected_by_what_they_reflect():
    """Lambert: emitted radiance times cosines over square distance, by 4,096 points; and lights without size."""
    frame, data, spots = lit_cache()
    emitters = np.array([0, 1, 4, 5, 2, 3, 10, 14, 200, 201, 202])  # down, both sides, turned away; point, spot, sun
    data.tables = table([(emitters, [], 0, 0.1)], np.ones(203))
    spots.faces, spots.regions = array([FLOOR]), array([0])
    spots.views = array([VIEWS["above"] / np.linalg.norm(VIEWS["above"])], wp.vec3)
    found = probabilities(frame, data, spots)[1][0, emitters]

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


# ---- choices ----


def numbers_for(rng, count):
    """Three random numbers of 24 bits for each choice, and the corners."""
    numbers = (rng.integers(0, 1 << 24, (count, 3)) / (1 << 24)).astype(np.float32)
    last = 1 - 2**-24
    numbers[:4] = [(0, 0, 0), (last, last, last), (last, 0, 0), (0, last, last)]
    return numbers


def power_weights(own, other):
    """Float64 weights of choices, one of which is expected ``own`` times and the other ``other`` times."""
    return (own + other) / own * own**2 / (own**2 + other**2)


@both_ways
@all_caches
def test_choices_follow_the_probabilities(kind, explores_by):
    """Those of the cache, and those that explore: as many as the region's share says."""
    frame, data, spots = CACHES[kind](explores_by)
    pdfs, offered = probabilities(frame, data, spots)
    first, second = expected_times(frame, data, spots)
    by_hierarchy, alone = explored(frame, data, spots), alone_at(data, spots)
    rows = np.arange(len(pdfs))[:, None]
    rng = np.random.default_rng(2)
    for explores, own, other in ((0, first, second), (1, second, first)):
        numbers = numbers_for(rng, 10_000)
        items, chosen, weights, flags, says_alone, others = choices(frame, data, spots, numbers, explores)
        found = items >= 0
        assert items.min() >= -1 and items.max() < 203
        assert (own[rows, items] > 0)[found].all(), "a light that is not among those to choose"
        assert np.allclose(chosen[found], pdfs[rows, items][found], rtol=1e-5)
        expected = power_weights(own[rows, items][found], other[rows, items][found])
        assert np.allclose(weights[found], expected, rtol=1e-4) and (chosen[~found] == 0).all()
        rarely = (own <= other)[rows, items][found]  # the cache offers it more often
        assert np.array_equal(flags[found], np.where(rarely, 2, 1) if explores else np.zeros(found.sum()))
        assert np.array_equal(says_alone[found], np.broadcast_to(alone[:, None], found.shape)[found])
        # the chance of being selected the other way; where exploring is alone, a half asks for that
        told = found & ~alone[:, None]
        assert np.allclose(others[told], by_hierarchy[rows, items][told], rtol=1e-5)
        told = found & alone[:, None] & (numbers[:, 1] < 0.5)
        told &= (data.tables.buckets.numpy() > 0)[spots.regions.numpy()][:, None]
        assert np.allclose(others[told], offered[rows, items][told], rtol=1e-5) and told.any() == (explores == 0)
        assert (others[found & alone[:, None] & ~told] == -1).all()
        for row, region in enumerate(spots.regions.numpy()):
            counts = np.bincount(items[row][found[row]], minlength=203)
            p = chi_squared(counts, own[row] * len(numbers), len(numbers))
            assert p > 1e-5, (explores, region, PLACES[row % len(PLACES)])
        if explores == 0:
            assert found[~alone].all() and found[alone].mean() > 0.8
        else:
            assert not found[alone].any() and 0.04 < found[~alone].mean() < 0.8


@both_ways
@all_caches
def test_choices_are_weighted_without_bias(kind, explores_by):
    """What both ways of finding a light are expected to bring is what there is, of every light that is found."""
    frame, data, spots = CACHES[kind](explores_by)
    first, second = expected_times(frame, data, spots)
    rows = np.arange(len(first))[:, None]
    rng = np.random.default_rng(4)
    parts = []
    for explores, own in ((0, first), (1, second)):
        items, pdfs, weights, *_ = choices(frame, data, spots, numbers_for(rng, 20_000), explores)
        part = np.where(own > 0, np.nan, 0.0)  # not known, until it is found
        found = items >= 0
        part[np.broadcast_to(rows, items.shape)[found], items[found]] = (weights / pdfs.clip(1e-30))[found]
        parts.append(part * own)
    brought = parts[0] + parts[1]
    known = np.isfinite(brought) & (first + second > 0)
    assert np.allclose(brought[known], 1, rtol=1e-4)
    both = known & (first > 0) & (second > 0)
    assert both.sum() > 300 and (known & (first == 0)).sum() > 300
    assert (known & (second == 0)).any()


def test_weights_of_choices():
    """The power heuristic, whatever the sizes: none of the other, as much, far more, far less."""
    sizes = np.concatenate([10.0 ** np.arange(-30, 1, 3), [0.3, 0.7]]).astype(np.float32)
    own, other = (x.ravel() for x in np.meshgrid(sizes, [0.0, *sizes]))
    out = wp.empty(len(own), dtype=wp.float32, device=device())
    launch(weigh_choices, len(own), [array(own, wp.float32), array(other, wp.float32), out], device())
    found = out.numpy().astype(np.float64)
    own, other = np.float64(np.float32(own)), np.float64(np.float32(other))
    assert np.allclose(found, power_weights(own, other), rtol=1e-5, atol=1e-30)
    assert (found[other == 0] == 1).all() and np.allclose(found[own == other], 1, rtol=1e-6)
    assert found.max() < 1.21 and found.min() < 1e-20


@both_ways
def test_estimates_have_the_right_mean(explores_by):
    """Sums over both choices, of a function that some lights are zero of, against the sum over all lights."""
    frame, data, spots = random_cache(explores_by)
    rng = np.random.default_rng(5)
    first, second = expected_times(frame, data, spots)
    # at most so large that no sample brings very much
    brings = (first + explored(frame, data, spots)) * rng.uniform(0, 2, first.shape) * (rng.random(first.shape) < 0.6)
    rows, count = np.arange(len(first))[:, None], 20_000
    mean, variance = np.zeros(len(first)), np.zeros(len(first))
    for turn, own, other in ((0, first, second), (1, second, first)):
        items, pdfs, weights, *_ = choices(frame, data, spots, numbers_for(rng, count), turn)
        found = items >= 0
        values = np.where(found, weights * brings[rows, items] / np.where(found, pdfs, 1), 0.0)
        mean += values.mean(axis=1)
        there = own > 0
        exact = np.zeros_like(own)  # what a sample of each light brings
        exact[there] = power_weights(own[there], other[there]) * (brings[there] / (own + other)[there])
        variance += ((own * exact**2).sum(axis=1) - (own * exact).sum(axis=1) ** 2).clip(0) / count
    test = st.z_test(mean, variance, brings.sum(axis=1), np.zeros(len(mean)), 1e-3)
    assert test.passed, (test.p_min, test.p_limit)
    noise = np.sqrt(variance) / brings.sum(axis=1).clip(1e-9)
    assert np.median(noise) < 0.03


@both_ways
def test_every_light_can_be_explored(explores_by):
    """Where a thousandth explores: it still has all of the numbers that select a light."""
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
    numbers = rng.integers(0, 1 << 24, (1 << 17, 3)) / (1 << 24)
    numbers[:, 0] = np.floor(numbers[:, 0] * share * (1 << 24)) / (1 << 24)
    items, *_ = choices(frame, data, spots, numbers.astype(np.float32), True)
    assert items.min() >= 0
    found, expected = len(np.unique(items)) / count, (1 - np.exp(-len(numbers) * pdfs)).mean()
    assert abs(found - expected) < 0.01, f"{found:.1%} of the lights, not {expected:.1%}"


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
    points.rates = array(rng.uniform(0.1, 1, size), wp.float32)
    points.shapes = wp.array(shapes[order], dtype=light_cache_native.LightShape, device=device())
    return points, shapes[5:].reshape(count, 32)


@pytest.mark.parametrize("material", SURFACES)
def test_lanes_weigh_as_one_by_one(material):
    """Which lights are left out, which are dark; the others, times their rates, differ by no more than ROUNDING."""
    count = 32 * 40
    points, shapes = lane_points(count, SURFACES[material])
    found = wp.full((count, 32), np.nan, dtype=wp.float32, device=device())
    weights, backs = (wp.empty((count, 32), dtype=wp.float32, device=device()) for _ in range(2))
    heights = wp.empty((count, 32), dtype=wp.vec4, device=device())
    launch(weigh_in_lanes, count, [points, ltc_table(device()), found], device())
    launch(weigh_one_by_one, 32 * count, [points, ltc_table(device()), weights, heights, backs], device())
    found, weights, backs, heights = (x.numpy().astype(np.float64) for x in (found, weights, backs, heights))
    rates = points.rates.numpy().astype(np.float64)[5:].reshape(count, 32)
    weights *= rates
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
    assert (off <= ROUNDING[0] * weights[weighed] + (ROUNDING[1] * shapes["luminance"] * rates)[weighed]).all()
    assert material != "lambert" or (off < 2e-4 * weights[weighed]).mean() > 0.9
    assert (found[weighed] > 0).all()
