"""The visibility light cache in whole frames: its settings, moving lights, the samples that paths keep, pictures."""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import statistics_tools as st
import warp as wp
from light_cache_tools import (
    ALONE,
    BLOCKED,
    EXPLORED,
    GLOSSY,
    ITEM,
    LUMINANCE,
    VISIBLE,
    Spots,
    array,
    ask_hierarchy,
    asked,
    deep_lesson,
    explored_by_table,
    keep_lights,
    lit_scene,
    preprocessed,
    probabilities,
    records_of,
)
from scene_tools import light, quad, triangle
from statistics_tools import device, every_device  # noqa: F401

import warp_gi as gi
from warp_gi.kernels import light_connections, samples, surface, types
from warp_gi.kernels.emitters import LightChoice
from warp_gi.kernels.sampling import EMITTER_DIMENSION, PATH_DIMENSION, VERTEX_DIMENSIONS, random_1d
from warp_gi.launch import launch
from warp_gi.techniques.reuse.light_cache import MOVING_EXPLORATION

wp.set_module_options({"enable_backward": False})


# Thread: an emitter and two random numbers. Connects the middle of the first triangle with it; -1: no emitter.
@wp.kernel
def connect(
    first: wp.int32,
    scene: types.SceneData,
    numbers: wp.array(dtype=wp.vec2),
    arrives: wp.array2d(dtype=wp.int32),
    brings: wp.array2d(dtype=wp.vec2),
):
    item = first + wp.tid()
    i = item / arrives.shape[1]
    k = item - i * arrives.shape[1]
    view = wp.vec3(0.0, 1.0, 0.0)
    s = surface.surface_at(scene, 0, 1.0 / 3.0, 1.0 / 3.0, view)
    choice = LightChoice()
    choice.item = i - 1
    choice.pdf = 0.5
    choice.weight = 1.0
    found = light_connections.connect_emitter(scene, s, wp.transpose(s.shading) * view, choice, numbers[k])
    arrives[i, k] = found.arrives
    brings[i, k] = wp.vec2(found.pdf, wp.max(found.reflected))


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
        assert frame.paths.lights.data.explores_by_tree == 1
        found = asked(ask_hierarchy, frame.paths.lights.data.tree, frame, spots)
        assert np.allclose(
            found, probabilities(frame, frame.paths.lights.data, spots)[0], rtol=1e-5
        )  # nothing is cached
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


# ---- settings ----


def test_exploration_that_does_not_adapt():
    estimator = gi.VisibilityLightCache(exploration=0.7, adapts_exploration=False)
    _, state = preprocessed(lit_scene(), estimator)
    for seed in (1, 2):
        state = estimator.learn(deep_lesson(seed)[1], state)
    assert (state.tables.exploration.numpy() == np.float32(0.7)).all() and state.tables.buckets.numpy().max() > 1


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


# ---- the samples that paths keep ----


def test_kept_lights():
    """Of two light samples at a vertex the explored one, if it arrives; else the cache's, if there is one."""
    rng = np.random.default_rng(3)
    count = 2000
    items, arrives = rng.integers(-1, 1 << 23, (2, count)), rng.integers(-1, 2, (2, count))
    items[:, :2] = [[-1, (1 << 23) - 1]] * 2
    items[rng.random((2, count)) < 0.3] = -1
    values = np.where(arrives > 0, rng.random((2, count)), 0.0)
    glossy = np.where(rng.random(count) < 0.3, GLOSSY, 0)
    chances = np.float32(rng.uniform(0.1, 1, (2, count, 4)))  # pdf, weight, other, selected
    chances[0, :100, 2] = -1.0  # where exploring is alone: unknown
    alone = np.zeros((2, count), int)
    alone[0, :200] = 1
    items[1, :200] = -1
    regions = samples.SampleRegions()
    regions.records = records_of(glossy, np.full(count, -3.0))
    for k in range(2):
        given = [array(items[k]), k, array(alone[k]), array(chances[k], wp.vec4)]
        given += [array(arrives[k]), array(values[k], wp.float32)]
        launch(keep_lights, count, [regions, *given], device())
    found, kept = regions.records, []
    lights, brought = found.lights.numpy().astype(np.int64), found.light_values.numpy()
    rivals = found.rivals.numpy()
    for slot in range(count):
        expected = 0, -3.0  # as it was
        if items[1, slot] >= 0 and arrives[1, slot] == 1:
            expected = int(items[1, slot]) + 1 | EXPLORED | VISIBLE, values[1, slot]
        elif items[0, slot] >= 0:
            word = int(items[0, slot]) + 1 | {1: VISIBLE, 0: 0, -1: BLOCKED}[arrives[0, slot]] | ALONE * alone[0, slot]
            expected = word, values[0, slot]
        assert (lights[slot], brought[slot]) == (expected[0] | glossy[slot], np.float32(expected[1])), slot
        kept.append(expected[0] & ~ITEM)
        rival = 0.0  # how much the sum of squares of both exceeds what exploring alone would bring
        if alone[0, slot]:
            rival = chances[0, slot, 2] / chances[0, slot, 0] if items[0, slot] >= 0 else 0.0
        else:
            light_of = np.where((items[:, slot] >= 0) & (arrives[:, slot] == 1), values[:, slot], 0.0)
            pdf, weight, other, selected = chances[:, slot].astype(float).T
            # the density of the direction sampler, which may find the light too, stays as it is
            density, times = selected / pdf * other + (1 - selected), weight / pdf
            alone_brings = light_of / weight / density
            rival = light_of.sum() ** 2 - (alone_brings**2 * times * other).sum()
        assert np.isclose(rivals[slot], rival, rtol=1e-4, atol=1e-4), slot
    assert set(kept) == {0, VISIBLE, BLOCKED, VISIBLE | EXPLORED, ALONE, VISIBLE | ALONE, BLOCKED | ALONE}


def test_connections_say_what_is_in_between():
    """1: the light arrives; -1: something is in between; 0: the light would not come this way in any case."""
    grey = gi.Material("grey", (0.5, 0.5, 0.5), specular=0.0)

    def down(x, y, material):
        return quad((x, y, -0.2), (0.4, 0, 0), (0, 0, 0.4), material)

    def up(x, y, material):
        return quad((x, y, -0.2), (0, 0, 0.4), (0.4, 0, 0), material)

    meshes = [
        quad((-0.3, 0, -0.3), (0, 0, 0.6), (0.6, 0, 0), grey),
        down(-2.2, 1.0, grey),  # between the floor and one of the lamps, and a point
        down(-4.2, 2.0, light((1.0, 1.0, 1.0))),
        down(2.0, 2.0, light((2.0, 2.0, 2.0))),
        up(0.0, 2.0, light((3.0, 3.0, 3.0))),  # turned away
        up(0.0, -1.0, light((4.0, 4.0, 4.0))),  # below the floor
    ]
    lights = [
        gi.PunctualLight("point", (1.0, 1.0, 1.0), position=(1.0, 2.0, 1.0)),
        gi.PunctualLight("point", (1.0, 1.0, 1.0), position=(-4.0, 2.0, 0.0)),
        gi.PunctualLight("point", (1.0, 1.0, 1.0), position=(0.0, -2.0, 0.0)),
        gi.PunctualLight("spot", (1.0, 1.0, 1.0), position=(0.0, 3.0, 0.0), direction=(0.0, 1.0, 0.0)),
        gi.PunctualLight("directional", (1.0, 1.0, 1.0), direction=(0.3, -1.0, 0.1)),
    ]
    scene = gi.Scene([gi.Node("all", meshes)], lights)
    data = scene.data(device())
    expected = [0, -1, -1, 1, 1, 0, 0, 0, 0, 1, -1, 0, 0, 1]
    numbers = np.random.default_rng(1).random((50, 2))
    shape = data.emitters.count + 1, len(numbers)
    arrives, brings = (wp.empty(shape, dtype=t, device=device()) for t in (wp.int32, wp.vec2))
    launch(connect, arrives.size, [data, array(numbers, wp.vec2), arrives, brings], device())
    arrives, brings = arrives.numpy(), brings.numpy()
    assert (arrives == np.array(expected)[:, None]).all(), arrives[:, 0]
    assert (brings[arrives == 1] > 0).all() and (brings[arrives != 1] == 0).all()


class WatchedCache(gi.VisibilityLightCache):
    """Remembers what it learnt from."""

    def learn(self, lesson, state):
        """As the other does."""
        watched.append([getattr(lesson.records, n).numpy() for n in ("codes", "lights", "light_values")])
        return super().learn(lesson, state)


watched = []


@pytest.mark.parametrize("exploration", [1e-5, 0.5], ids=["by the cache", "by both"])
def test_samples_remember_what_they_brought_to_the_picture(exploration):
    """Where lights have no size, that is all the light that there is, at whichever vertex of a path.

    But for that of the cache's sample at vertices where another one was explored: of two one is kept.
    """
    grey = gi.Material("grey", (0.7, 0.6, 0.5), specular=0.0)
    walls = [
        quad((-2, 0, -2), (0, 0, 4), (4, 0, 0), grey),
        quad((-2, 0, -2), (4, 0, 0), (0, 3, 0), grey),
        quad((-0.4, 0.5, 0.2), (0.8, 0, 0), (0, 0, 0.6), grey),
    ]
    lights = [gi.PunctualLight("point", (0.5 + k, 1.0, 0.7), position=(k - 1.5, 1.0, 0.5)) for k in range(4)]
    scene = gi.Scene([gi.Node("walls", walls)], lights)
    camera = gi.CameraPath.still(gi.Camera.look_at((0, 1.5, 3.0), (0, 0.8, -1), hfov=50, resolution=SIZE))
    emitters = WatchedCache(exploration=exploration, adapts_exploration=False)
    pipeline = gi.Pipeline(
        environment=None, emitters=emitters, indirect=gi.BsdfPaths(max_depth=3), spp=4, octree=gi.SampleOctree()
    )
    watched.clear()
    for index, frame in enumerate(gi.render(scene, camera, pipeline, frames=range(3), device=str(device()))):
        direct, indirect = (frame.numpy(x).astype(np.float64) for x in ("emitters", "indirect"))
        codes, words_kept, values = watched[-1]
        there = (codes != 0xFFFFFFFF) & ((words_kept & ITEM) > 0)
        word, value = words_kept[there], values[there]
        seen, blocked, explored, alone = ((word & flag) > 0 for flag in (VISIBLE, BLOCKED, EXPLORED, ALONE))
        assert (value[seen] > 0).all() and (value[~seen] == 0).all() and not (seen & blocked).any()
        assert seen[explored].all()
        assert indirect.sum() > 0.03 * direct.sum()
        share = value.sum() / 4 / ((direct + indirect) @ LUMINANCE).sum()
        if index == 0:  # nothing is known
            assert alone.all() and not explored.any() and np.isclose(share, 1, rtol=1e-3)
        elif exploration < 0.1:
            assert not explored.any() and np.isclose(share, 1, rtol=1e-3)
            assert 0.01 < blocked.mean() < seen.mean() and not alone.any()
        else:
            # the cache offers nearly all lights by now, and then its sample is the one to keep
            assert explored.mean() < 0.1 and 0.5 < share < 0.999 and blocked.any() and (seen & ~explored).any()
    assert len(watched) == 3


@pytest.mark.parametrize("sort", ["sun", "small lamp"])
def test_paths_weigh_both_samples(sort):
    """Of the only light, which the cache always selects, and a half of the vertices explore.

    These are expected 1 and 1/2 times, and so by the power heuristic count 1 / (1 + 1/4) and 1/2 / (1 + 1/4).
    """
    share = 0.5
    floor = quad((-2, 0, -2), (0, 0, 4), (4, 0, 0), gi.Material("grey", (0.5, 0.5, 0.5), specular=0.0))
    if sort == "sun":
        lights, meshes, noise = [gi.PunctualLight("directional", (3.0, 3.0, 3.0), direction=(0.2, -1.0, 0.0))], [], 1e-5
    else:  # so far away that the BSDF never meets it, and that all of the floor sees it alike
        corners = np.float32([[0, 400, 0], [1, 400, 0], [0, 400, 1]])
        lamp = light((1e6, 1e6, 1e6))
        meshes, lights, noise = [triangle(lamp, points=corners)], [], 0.03
    scene = gi.Scene([gi.Node("floor", [floor, *meshes])], lights)
    assert scene.emitter_count == 1
    camera = gi.CameraPath.still(gi.Camera.look_at((0, 2, 0.5), (0, 0, 0), hfov=40, resolution=SIZE))
    emitters = WatchedCache(exploration=share, adapts_exploration=False)
    pipeline = gi.Pipeline(environment=None, emitters=emitters, indirect=None, spp=4, octree=gi.SampleOctree())
    watched.clear()
    for index, frame in enumerate(gi.render(scene, camera, pipeline, frames=range(3), device=str(device()))):
        codes, words_kept, values = watched[-1]
        there = codes != 0xFFFFFFFF
        explored, alone = ((words_kept[there] & flag) > 0 for flag in (EXPLORED, ALONE))
        values = values[there]
        assert len(values) == 4 * SIZE[0] * SIZE[1]
        if index == 0:  # nothing is known
            whole = values.mean()
            assert (
                alone.all()
                and not explored.any()
                and np.allclose(frame.numpy("emitters") @ LUMINANCE, whole, rtol=noise)
            )
        else:  # the cache's sample is kept, and four pixels' samples explored zero to four times
            assert not (explored | alone).any() and np.allclose(values, whole / (1.0 + share**2), rtol=noise)
            counted = (frame.numpy("emitters") @ LUMINANCE / whole * (1.0 + share**2) - 1.0) / share * 4
            assert np.abs(counted - counted.round()).max() < 20 * noise
            assert set(counted.round().ravel()) == {0, 1, 2, 3, 4} and abs(counted.mean() - 2) < 0.2


# Thread: a path. The random numbers of all light samples at its first three vertices, but for stratified ones.
@wp.kernel
def ask_numbers(first: wp.int32, numbers: wp.array2d(dtype=wp.float32)):
    i = first + wp.tid()
    index = wp.uint32(i)
    seed = wp.uint32(77)
    for vertex in range(3):
        d = PATH_DIMENSION + vertex * VERTEX_DIMENSIONS
        u = light_connections.explore_3d(index, seed, d)
        v = light_connections.explore_2d(index, seed, d)
        w = light_connections.light_2d(index, seed, d + EMITTER_DIMENSION, False)
        for k in range(3):
            numbers[i, vertex * 9 + k] = u[k]
        for k in range(2):
            numbers[i, vertex * 9 + 3 + k] = v[k]
            numbers[i, vertex * 9 + 5 + k] = w[k]
        numbers[i, vertex * 9 + 7] = light_connections.light_1d(index, seed, d, False)
        numbers[i, vertex * 9 + 8] = random_1d(index, seed, d)


def test_random_numbers_of_light_samples_are_independent():
    """Of both choices and of the points on both lights, from vertex to vertex: each of its own."""
    numbers = wp.empty((20_000, 27), dtype=wp.float32, device=device())
    launch(ask_numbers, len(numbers), [numbers], device())
    numbers = numbers.numpy().astype(np.float64)
    assert numbers.min() >= 0 and numbers.max() < 1
    together = np.corrcoef(numbers.T) - np.eye(27)
    assert np.abs(together).max() < 5 / np.sqrt(len(numbers))
    for column in numbers.T:
        assert st.chi_squared(np.histogram(column, 50, (0, 1))[0], np.full(50, len(numbers) / 50)) > 1e-5


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
    pipeline = gi.Pipeline(emitters=gi.VisibilityLightCache(rests=False), indirect=None, spp=1)
    for frame in gi.render(scene, camera, pipeline, frames=range(2), device=str(device())):
        assert np.allclose(frame.numpy("beauty"), 0.5, rtol=1e-4)


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
    ours = rendered(
        divided_room(moves), gi.VisibilityLightCache(explores_by=explores_by, rests=False), range(1, 25), (0, 5)
    )
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
