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
from warp_gi.kernels import bsdf, light_cache, light_cache_build, ltc, samples, surface, types
from warp_gi.kernels.emitters import punctual_light
from warp_gi.launch import copied, launch, set_threads
from warp_gi.techniques.visibility_light_cache import CacheState

wp.set_module_options({"enable_backward": False})

VISIBLE, NEW, GLOSSY = 1 << 31, 1 << 30, 1 << 29
MOST_LISTED = 1024
MOST_BUCKETS = 64
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
    is_new: wp.array2d(dtype=wp.int32),
):
    item = first + wp.tid()
    i = item / items.shape[1]
    k = item - i * items.shape[1]
    s = surface.surface_at(scene, spots.faces[i], 0.3, 0.3, spots.views[i])
    wo = wp.transpose(s.shading) * spots.views[i]
    choice = light_cache.cached_light(cache, scene, spots.regions[i], s, wo, numbers[k])
    items[i, k] = choice.item
    pdfs[i, k] = choice.pdf
    is_new[i, k] = choice.is_new


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

FLOOR, GLOSSY_FLOOR, METAL_FLOOR = 0, 2, 4  # first triangle of each
VIEWS = {"above": (0.3, 0.8, 0.2), "slant": (0.95, 0.1, 0.2), "below": (0.1, -0.9, 0.3)}


@cache
def lit_scene():
    """Three floors below 200 triangles and three lights without size; lamps of five sorts by turns."""
    rng = np.random.default_rng(1)
    materials = [
        gi.Material("lambert", (0.5, 0.4, 0.3), specular=0.0),
        gi.Material("glossy", (0.3, 0.5, 0.3), roughness=0.3),
        gi.Material("metal", (0.9, 0.8, 0.5), metallic=1.0, roughness=0.15),
    ]
    floors = [quad((-3, 0, 2 * i), (0, 0, 2), (2, 0, 0), material) for i, material in enumerate(materials)]
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
    state = state or estimator.start(scene, str(device()), None)
    return frame, estimator.preprocess(frame, state)


def table(contents):
    """CacheTables of regions, each (emitters, buckets, exploration), and what they really hold, region by region."""
    buckets, offsets, items, held = [], [], [], []
    for emitters, count, _ in contents:
        lists = [sorted(e for e in emitters if e % count == k)[:32] for k in range(count)]
        buckets.append(count | sum(not x for x in lists) << 16)
        offsets.append(len(items))
        items += [*np.cumsum([len(x) for x in lists]), *(e for x in lists for e in x)]
        held.append({int(e) for x in lists for e in x})
    tables = light_cache.CacheTables()
    tables.buckets, tables.offsets = array(buckets), array(offsets)
    tables.items = array(np.array(items, np.int32))
    tables.exploration = array([share for *_, share in contents], wp.float32)
    return tables, held


CONTENTS = {
    "empty": ([], 0, 0.1),
    "one light": ([40], 1, 0.1),
    "one light of eight buckets": ([43], 8, 0.05),
    "a full bucket": (range(32), 1, 0.1),
    "two full buckets": (range(64), 2, 0.02),
    "all": (range(203), 8, 0.02),
    "holes": ([*range(0, 200, 8), *range(3, 200, 8)], 8, 0.3),
    "many buckets": (range(90, 203), 64, 0.1),
    "underground": ([8, 9, 18, 19, 28], 2, 0.1),
    "turned away": ([2, 3, 12, 13, 22, 23], 1, 0.1),
    "without size": ([200, 201, 202], 1, 0.1),
    "without size, spread": ([200, 201, 202], 4, 0.1),
    "explores only": (range(20), 1, 1.0),
}
PLACES = [(face, view) for face in (FLOOR, GLOSSY_FLOOR, METAL_FLOOR) for view in VIEWS]


def lit_cache():
    frame, _ = preprocessed(lit_scene())
    data = frame.lights.data
    data.tables, held = table(CONTENTS.values())
    spots = Spots()
    spots.faces = array([face for _ in CONTENTS for face, _ in PLACES])
    directions = np.array([VIEWS[view] for _, view in PLACES])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    spots.views = array(np.tile(directions, (len(CONTENTS), 1)), wp.vec3)
    spots.regions = array(np.repeat(np.arange(len(CONTENTS)), len(PLACES)))
    return frame, data, held, spots


def probabilities(frame, data, spots):
    count = frame.data.emitters.count
    pdfs = wp.empty((spots.faces.shape[0], count), dtype=wp.float32, device=device())
    launch(ask_probabilities, pdfs.size, [data, frame.data, spots, pdfs], device())
    return pdfs.numpy().astype(np.float64)


def choices(frame, data, spots, numbers):
    shape = spots.faces.shape[0], len(numbers)
    items, pdfs, new = (wp.empty(shape, dtype=t, device=device()) for t in (wp.int32, wp.float32, wp.int32))
    inputs = [data, frame.data, spots, array(numbers, wp.vec2), items, pdfs, new]
    launch(choose_lights, items.size, inputs, device())
    return items.numpy(), pdfs.numpy(), new.numpy()


# ---- probabilities ----


def test_probabilities_sum_to_one():
    frame, data, _, spots = lit_cache()
    pdfs = probabilities(frame, data, spots)
    assert frame.data.emitters.count == 203
    assert (pdfs > 0).all(), "a light that nothing selects"
    assert np.allclose(pdfs.sum(axis=1), 1.0, atol=2e-5)


def test_probabilities_are_those_of_the_weights():
    """However many lights are weighed at once, by whatever means; of every sort of light, on every sort of surface."""
    frame, data, held, spots = lit_cache()
    pdfs = probabilities(frame, data, spots)
    out = wp.empty(pdfs.shape, dtype=wp.float32, device=device())
    launch(weigh_lights, out.size, [data, frame.data, spots, out], device())
    alias = frame.data.emitters.alias.numpy()["pdf"].astype(float)
    regions = spots.regions.numpy()
    assert (out.numpy() >= 0).all() and (out.numpy() > 0).mean() > 0.2
    for row, weights in enumerate(out.numpy().astype(float)):
        _, buckets, share = list(CONTENTS.values())[regions[row]]
        expected, left = np.zeros(len(alias)), 1.0
        for k in range(buckets):
            lights = [e for e in held[regions[row]] if e % buckets == k]
            if lights:
                total = weights[lights].sum()
                expected[lights] = weights[lights] / total if total > 0 else 1 / len(lights)
                expected[lights] *= (1 - share) / buckets
                left -= (1 - share) / buckets
        face = PLACES[row % len(PLACES)][0]
        if face == METAL_FLOOR:
            continue  # narrow lobes: lights in their tails get what rounding leaves
        slack = (0.002 if face == GLOSSY_FLOOR else 0.0) * (1 - share) / max(buckets, 1)
        assert np.allclose(pdfs[row], expected + left * alias, rtol=2e-3, atol=1e-6 + slack), (
            list(CONTENTS)[regions[row]],
            PLACES[row % len(PLACES)],
        )


def test_choices_follow_the_probabilities():
    frame, data, held, spots = lit_cache()
    pdfs = probabilities(frame, data, spots)
    rng = np.random.default_rng(2)
    numbers = (rng.integers(0, 1 << 24, (20_000, 2)) / (1 << 24)).astype(np.float32)
    numbers[:3] = [(0.0, 0.0), (1 - 2**-24, 1 - 2**-24), (1 - 2**-24, 0.0)]
    items, chosen, new = choices(frame, data, spots, numbers)
    assert items.min() >= 0 and items.max() < 203
    rows = np.arange(len(items))[:, None]
    assert np.allclose(chosen, pdfs[rows, items], rtol=1e-5)
    for row, region in enumerate(spots.regions.numpy()):
        p = chi_squared(np.bincount(items[row], minlength=203), pdfs[row] * len(numbers))
        assert p > 1e-5, (list(CONTENTS)[region], PLACES[row % len(PLACES)])
        unknown = ~np.isin(items[row], list(held[region]))
        assert np.array_equal(new[row] != 0, unknown)


def test_every_light_can_be_explored():
    """Where a twentieth explores, a float32 has a twentieth of its numbers left: too few for many lights."""
    count, share = 1 << 19, 0.02
    frame, data, _, spots = lit_cache()
    data.tables, _ = table([([40], 1, share), ([43], 8, share)])
    frame.data.emitters.count = count
    frame.data.emitters.alias = AliasTable.build(np.ones(count)).on(device())
    rng = np.random.default_rng(3)
    numbers = rng.integers(0, 1 << 24, (1 << 21, 2)) / (1 << 24)
    numbers[:, 0] = np.floor(numbers[:, 0] * share * (1 << 24)) / (1 << 24)
    spots.faces, spots.regions = array([FLOOR]), array([0])
    spots.views = array([VIEWS["above"]], wp.vec3)
    items, _, _ = choices(frame, data, spots, numbers.astype(np.float32))
    found, expected = len(np.unique(items)) / count, 1 - np.exp(-len(numbers) / count)
    assert abs(found - expected) < 0.01, f"{found:.1%} of the lights, not {expected:.1%}"


def shares_of_lights(frame, data, spots, row, emitters, buckets, exploration):
    """Return the probability of each of ``emitters`` within its bucket."""
    pdf = probabilities(frame, data, spots)[row, emitters]
    alias = frame.data.emitters.alias.numpy()["pdf"][emitters]
    return (pdf - exploration * alias) * buckets / (1 - exploration)


def test_lights_are_selected_by_what_they_reflect():
    """Lambert: emitted radiance times cosines over square distance, by 4,096 points; and lights without size."""
    frame, data, _, spots = lit_cache()
    emitters = np.array([0, 1, 4, 5, 2, 3, 10, 14, 200, 201, 202])  # down, both sides, turned away; point, spot, sun
    data.tables, _ = table([(emitters, 1, 0.1)])
    spots.faces, spots.regions = array([FLOOR]), array([0])
    spots.views = array([VIEWS["above"] / np.linalg.norm(VIEWS["above"])], wp.vec3)
    found = shares_of_lights(frame, data, spots, 0, emitters, 1, 0.1)

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
    frame, data, held, spots = lit_cache()
    row = list(CONTENTS).index("turned away") * len(PLACES)
    emitters = sorted(held[row // len(PLACES)])
    found = shares_of_lights(frame, data, spots, row, emitters, 1, 0.1)
    assert np.allclose(found, 1 / len(emitters), atol=1e-5)


# ---- exploration: weights of all lights, moving ones ----


def moving_scene():
    """A floor, a lamp that moves 2 m in the first second, one that stays, and a point light."""
    floor = gi.Node("floor", [quad((-2, 0, -2), (0, 0, 4), (4, 0, 0), gi.Material("f", (0.5, 0.5, 0.5), specular=0.0))])
    keys = [gi.Keyframe(0.0, (0.0, 0.0, 0.0)), gi.Keyframe(1.0, (2.0, 0.0, 0.0)), gi.Keyframe(2.0, (2.0, 0.0, 0.0))]
    lamp = quad((-1.5, 2, 0), (0.3, 0, 0), (0, 0, 0.3), light((9.0, 9.0, 9.0)))
    still = quad((1.0, 1, 1), (0.1, 0, 0), (0, 0, 0.2), light((3.0, 2.0, 1.0)))
    lights = [gi.PunctualLight("point", (0.1, 0.2, 0.3), position=(0.0, 1.0, -1.0))]
    return gi.Scene([floor, gi.Node("moves", [lamp], keyframes=keys), gi.Node("stays", [still])], lights)


def explored(frame):
    return frame.data.emitters.alias.numpy()["pdf"].astype(float)


def test_exploration_follows_power():
    frame, _ = preprocessed(lit_scene(), gi.VisibilityLightCache(change=0.0, distance=0.0))
    powers = lit_scene().emitter_powers()
    assert np.allclose(explored(frame), powers / powers.sum(), rtol=1e-4, atol=1e-7)


def test_exploration_follows_nearness_to_the_camera():
    scene = moving_scene()
    frame, _ = preprocessed(scene, gi.VisibilityLightCache(energy=0.0, change=0.0), position=(0.0, 1.0, -0.5))
    found = explored(frame)
    places = np.array(
        [[-1.3, 2, 0.1], [-1.4, 2, 0.2], [1 + 0.2 / 3, 1, 1 + 0.2 / 3], [1 + 0.1 / 3, 1, 1 + 0.4 / 3], [0, 1, -1]]
    )
    near = 1 / (((places - (0, 1, -0.5)) ** 2).sum(axis=1) + (0.02 * scene.radius) ** 2)
    assert np.allclose(found, near / near.sum(), rtol=1e-4)


def test_exploration_goes_after_lights_that_move():
    scene = moving_scene()
    estimator = gi.VisibilityLightCache(energy=0.1, change=10.0, distance=0.0, exploration=0.2)
    frame, state = preprocessed(scene, estimator)
    before = explored(frame)
    state.tables.exploration.fill_(0.03)
    frame, state = preprocessed(scene, estimator, state, 0.5)
    assert explored(frame)[:2].sum() > 0.98 > before[:2].sum()
    assert np.allclose(state.tables.exploration.numpy(), 0.2), "what is known is in doubt"
    state.tables.exploration.fill_(0.03)
    frame, state = preprocessed(scene, estimator, state, 0.5)  # now it stands still
    assert np.allclose(explored(frame), before)
    assert np.allclose(state.tables.exploration.numpy(), 0.03)
    shapes = state.shapes.numpy()
    assert np.allclose(shapes["p0"][0], (-0.5, 2, 0), atol=1e-5)


@pytest.mark.parametrize(
    "weights", [{"energy": 0.0, "distance": 0.0}, {"energy": 0.0, "change": 0.0}, {"change": 0.0, "distance": 0.0}]
)
def test_every_light_is_explored_whatever_the_weights(weights):
    """Else estimates are biased: nobody finds a light that stands still. Or such weights are refused."""
    try:
        estimator = gi.VisibilityLightCache(**weights)
    except gi.OptionError:
        assert "change" not in weights
        return
    scene = moving_scene()
    frame, state = preprocessed(scene, estimator)
    assert (explored(frame) > 0).all()
    frame, _ = preprocessed(scene, estimator, state, 0.5)
    assert (explored(frame) > 0).all()


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


def words(emitters, visible, new, rng):
    """What samples remember of lights; -1: none was sampled."""
    value = (np.asarray(emitters) + 1) | np.where(visible, VISIBLE, 0) | np.where(new, NEW, 0)
    return value | np.where(rng.random(len(value)) < 0.3, GLOSSY, 0)


def leaf_samples(counts, order, most):
    grouped = light_cache_build.LeafSamples()
    grouped.starts, grouped.counts = array(np.cumsum(counts) - counts), array(counts)
    grouped.order, grouped.most = array(order), most
    return grouped


def listed(grouped, word):
    seen = lists([[]] * grouped.counts.shape[0])
    seen.entries = wp.empty(2 * grouped.order.shape[0], dtype=wp.int32, device=device())
    discoveries = wp.empty(grouped.counts.shape[0], dtype=wp.int32, device=device())
    inputs = [grouped, array(word, wp.uint32), seen, discoveries]
    launch(light_cache_build.list_seen_lights, grouped.counts.shape[0], inputs, device(), 16)
    return entries_of(seen), discoveries.numpy().tolist()


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
    word = words(emitters, visible, rng.random(total) < 0.1, rng)
    order = rng.permutation(total)
    slots = np.empty(total, np.int64)
    slots[order] = word
    found, discoveries = listed(leaf_samples(counts, order, most), slots)
    end = np.cumsum(counts)
    for leaf, count in enumerate(counts):
        looks = min(count, most)
        lights, new = set(), 0
        for k in range(looks):
            w = int(word[end[leaf] - count + k * count // looks])
            if w & VISIBLE and len(lights) < MOST_LISTED:
                lights.add((w & ((1 << 28) - 1)) - 1)
                new += w & NEW != 0
        assert found[leaf] == [e << 8 for e in sorted(lights)]
        assert discoveries[leaf] == new
    assert most < 1 << 20 or len(found[10]) == MOST_LISTED


def test_looks_are_spread():
    """Every sample saw another light, so the list says which were looked at."""
    rng = np.random.default_rng(1)
    count, most = 1000, 300
    found, _ = listed(leaf_samples([count], np.arange(count), most), words(np.arange(count), True, False, rng))
    looked = np.array(found[0]) >> 8
    assert len(looked) == most and set(np.diff(looked)) == {3, 4} and looked[0] < 4 and looked[-1] >= count - 4


def test_hash_collisions():
    """Lights whose hashes agree in all bits that a small table uses, up to a table that is half full."""
    rng = np.random.default_rng(2)
    emitters = np.arange(1 << 22)
    hashes = (((emitters << 8) * 0x9E3779B1) & 0xFFFFFFFF) >> 12
    same = emitters[(hashes & 1023) == 1023][:900]
    found, _ = listed(leaf_samples([900], np.arange(900), 900), words(same, True, False, rng))
    assert found[0] == [e << 8 for e in same]


def deep_lesson(seed=3, count=20_000, lights=300):
    """Samples of a cluster on a tree of many levels, each with a light."""
    rng = np.random.default_rng(seed)
    settings = gi.SampleOctree(split=64, collapse=32)
    state = settings.start(SimpleNamespace(bounds=np.array([[0, 0, 0], [1, 1, 1]], np.float32)), device())
    records = samples.SampleRecords()
    codes = (1 << 29) + (np.abs(rng.normal(size=count)) * 2.0 ** rng.integers(5, 26, count)).astype(np.int64)
    emitters = (rng.integers(0, 20, count) + codes // (1 << 20)) % lights
    word = words(emitters, rng.random(count) < 0.7, rng.random(count) < 0.01, rng)
    records.codes, records.lights = array(codes, wp.uint32), array(word, wp.uint32)
    for name in ("directions", "mixtures"):
        setattr(records, name, wp.zeros(count, dtype=wp.uint32, device=device()))
    records.contributions = wp.zeros(count, dtype=wp.float32, device=device())
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
        discoveries = wp.empty(lesson.octree.leaf_count, dtype=wp.int32, device=device())
        for leaf in order:
            inputs = [leaf, grouped, lesson.records.lights, seen, discoveries]
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


# ---- buckets ----


def settings_of(capacity=32, memory=4, hysteresis=0.75, exploration=0.1, least=0.02):
    s = light_cache_build.CacheSettings()
    s.capacity, s.memory, s.hysteresis = capacity, memory, hysteresis
    s.exploration, s.least_exploration = exploration, least
    return s


def bucketed(emitters, before, capacity):
    """Buckets (count, [emitters of each]) of regions with these emitters, that had ``before`` buckets."""
    settings, leaves = settings_of(capacity), len(emitters)
    given = lists([[e << 8 | 1 for e in x] for x in emitters])
    known, tables = light_cache.CacheTables(), light_cache.CacheTables()
    known.buckets = array([b | 3 << 16 for b in before][::-1])  # origins are in another order
    tables.buckets = wp.empty(leaves, dtype=wp.int32, device=device())
    tables.exploration = wp.full(leaves, 0.1, dtype=wp.float32, device=device())
    sizes = wp.empty(leaves, dtype=wp.int32, device=device())
    origins = array(range(leaves)[::-1])
    inputs = [settings, given, origins, known, tables, sizes]
    launch(light_cache_build.count_buckets, leaves, inputs, device())
    numbers = sizes.numpy().copy()
    tables.offsets = array(np.cumsum(numbers) - numbers)
    tables.items = wp.full(int(numbers.sum()), -7, dtype=wp.int32, device=device())
    launch(light_cache_build.fill_buckets, leaves, [settings, given, tables], device())
    return tables, contents_of(tables)


def contents_of(tables):
    out = []
    items = tables.items.numpy()
    for word, offset in zip(tables.buckets.numpy(), tables.offsets.numpy(), strict=True):
        count = int(word) & 0xFFFF
        ends = items[offset : offset + count]
        begins = np.concatenate([[0], ends[:-1]]) if count else []
        held = [items[offset + count + b : offset + count + e].tolist() for b, e in zip(begins, ends, strict=True)]
        assert int(word) >> 16 == sum(not x for x in held)
        out.append((count, held))
    return out


def expected_buckets(emitters, before, capacity):
    count = 1 if len(emitters) else 0
    while 0 < count < MOST_BUCKETS:
        limit = max(int(capacity * 0.75), 1) if count < before else capacity
        if np.bincount(np.asarray(emitters) % count).max() <= limit:
            break
        count *= 2
    return count, [[int(e) for e in sorted(emitters) if e % count == k][:capacity] for k in range(count)]


@pytest.mark.parametrize("capacity", [1, 2, 5, 32])
def test_buckets(capacity):
    """The least power of two that holds the lights; fewer than before only where three quarters hold them."""
    rng = np.random.default_rng(capacity)
    emitters, before = [], []
    for pool in (40, 300, 5000, 1 << 23):
        for count in (0, 1, 2, 20, 24, 25, 32, 33, 64, 100, 300, 1000):
            for last in (0, 1, 2, 8, 64):
                emitters.append(sorted({int(e) for e in rng.integers(0, pool, count)}))
                before.append(last)
    emitters.append(list(range(0, 64 * 100, 64)))  # all in one bucket of any number
    before.append(0)
    found = bucketed(emitters, before, capacity)[1]
    for lights, last, result in zip(emitters, before, found, strict=True):
        assert result == expected_buckets(lights, last, capacity), (len(lights), last)


def test_bucket_counts_do_not_flicker():
    counts, before = [], 0
    for lights in (32, 33, 32, 33, 31, 25, 33, 24, 32, 33):
        before = bucketed([list(range(lights))], [before], 32)[1][0][0]
        counts.append(before)
    assert counts == [1, 2, 2, 2, 2, 2, 2, 1, 1, 2]


def test_buckets_that_overflow_leave_lights_to_exploration():
    """Probabilities sum to one all the same, of all lights."""
    frame, data, _, spots = lit_cache()
    data.tables, held = bucketed([list(range(203)), list(range(0, 203, 64)), list(range(100))], [0, 0, 64], 1)
    assert held[0][0] == MOST_BUCKETS and sum(map(len, held[0][1])) == MOST_BUCKETS
    spots.regions = array(np.arange(spots.faces.shape[0]) // len(PLACES) % 3)
    pdfs = probabilities(frame, data, spots)
    assert (pdfs > 0).all() and np.allclose(pdfs.sum(axis=1), 1.0, atol=2e-5)


# ---- exploration that adapts ----


def test_exploration_adapts():
    """Twice as much where something was found, a quarter less where not, as it was without samples, in its bounds."""
    cases = [  # samples, discoveries, origin, share before, expected
        (10, 1, 1, 0.03, 0.06),
        (10, 9, 1, 0.04, 0.08),
        (10, 1, 1, 0.08, 0.1),
        (10, 0, 1, 0.08, 0.06),
        (10, 0, 1, 0.022, 0.02),
        (0, 0, 1, 0.07, 0.07),
        (0, 0, -1, 0.07, 0.1),
        (5, 2, -1, 0.03, 0.1),
    ]
    for count, found, origin, before, expected in cases:
        shares = wp.empty(1, dtype=wp.float32, device=device())
        known = array([0.05, before], wp.float32)
        grouped = leaf_samples([count], np.arange(count), 100)
        inputs = [settings_of(), grouped, array([found]), array([origin]), known, shares]
        launch(light_cache_build.adapt_exploration, 1, inputs, device())
        assert np.isclose(shares.numpy()[0], expected)


# ---- all of it ----


def test_a_region_knows_what_it_and_its_neighbours_saw():
    """Three frames of learning, each of other samples, against sets."""
    estimator = gi.VisibilityLightCache(memory=1, capacity=8)
    state = estimator.start(lit_scene(), str(device()), None)
    known = [[]] * 8
    settings, lesson = deep_lesson(10)
    for frame in range(3):
        origins, neighbours = lesson.origins.numpy(), lesson.neighbours.numpy().reshape(-1, 6)
        starts, counts, order = (getattr(lesson.samples, n).numpy() for n in ("starts", "counts", "order"))
        word = lesson.records.lights.numpy()
        seen = [[]] * len(origins)
        for leaf in np.flatnonzero(origins >= 0):
            w = word[order[starts[leaf] : starts[leaf] + counts[leaf]]]
            seen[leaf] = [int(e) << 8 for e in np.unique((w[w >= VISIBLE] & ((1 << 28) - 1)).astype(int) - 1)]
        before = state.tables.buckets.numpy() & 0xFFFF
        shares = state.tables.exploration.numpy()
        state = estimator.learn(lesson, state)
        expected = expected_join(seen, known, neighbours, origins, 1)
        assert entries_of(state.known) == expected
        for leaf, (found, entries) in enumerate(zip(contents_of(state.tables), expected, strict=True)):
            last = before[origins[leaf]] if origins[leaf] >= 0 else 0
            assert found == expected_buckets([e >> 8 for e in entries], last, 8)
        now = state.tables.exploration.numpy()
        kept = (origins >= 0) & (counts == 0)
        assert kept.any() and np.allclose(now[kept], shares[origins[kept]])
        known = expected
        _, other = deep_lesson(11 + frame, 20_000 // (frame + 1))
        lesson = settings.learn(lesson.octree, other.records, device())


def test_learning_without_samples():
    """A frame that saw nothing but sky forgets no faster than others."""
    estimator = gi.VisibilityLightCache()
    settings, lesson = deep_lesson()
    state = estimator.learn(lesson, estimator.start(lit_scene(), str(device()), None))
    records = copied(lesson.records, samples.SampleRecords)
    records.codes = wp.full(2000, 0xFFFFFFFF, dtype=wp.uint32, device=device())
    after = estimator.learn(settings.learn(lesson.octree, records, device()), state)
    assert isinstance(after, CacheState) and after.tables.buckets.shape[0] == 8
    assert {e & 255 for x in entries_of(after.known) for e in x} == {1}


def test_threads_do_not_matter():
    results = []
    try:
        for threads in (1, 4):
            set_threads(threads)
            estimator = gi.VisibilityLightCache()
            state = estimator.start(lit_scene(), str(device()), None)
            for seed in (1, 2):
                state = estimator.learn(deep_lesson(seed)[1], state)
            t = state.tables
            used = [x for _, held in contents_of(t) for x in held]
            results.append((used, *(x.numpy().tolist() for x in (t.buckets, t.offsets, t.exploration))))
    finally:
        set_threads(None)
    assert results[0] == results[1]


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"capacity": 0}, "capacity"),
        ({"capacity": 33}, "capacity"),
        ({"exploration": 0.0}, "exploration"),
        ({"exploration": 1.1}, "exploration"),
        ({"exploration": float("nan")}, "exploration"),
        ({"least_exploration": 0.0}, "least_exploration"),
        ({"least_exploration": 0.2}, "least_exploration"),
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
        gi.VisibilityLightCache().start(SimpleNamespace(emitter_count=(1 << 23) + 1), str(device()), None)


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


@pytest.mark.parametrize("moves", [False, True], ids=["still", "moving"])
def test_pictures_equal_those_by_power(moves):
    """The first frame, in which nothing is known, and the sixth; and the cache is worth it: lamps are hidden."""
    scene = divided_room(moves)
    seeds = range(1, 25)
    ours = rendered(scene, gi.VisibilityLightCache(), seeds, (0, 5))
    theirs = rendered(scene, gi.PowerLights(), range(100, 196), (0, 5))
    for buffer in ours:
        for k, index in enumerate((0, 5)):
            mean, variance = st.mean_and_variance(theirs[buffer][k])
            st.compare_images(
                f"light_cache_{buffer}_{index}", ours[buffer][k], mean, variance, 1e-4, 95, noise_ratio=0.5
            )
    noise = [np.median(images["emitters"][1].var(axis=0).mean(axis=-1)) for images in (ours, theirs)]
    assert noise[0] < 0.05 * noise[1], noise
