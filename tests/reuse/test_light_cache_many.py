"""The light cache where more lights are seen than it holds: there, and only there, the hierarchy alone selects."""

from __future__ import annotations

import numpy as np
import pytest
import statistics_tools as st
import warp as wp
from light_cache_tools import (
    LUMINANCE,
    alone_at,
    array,
    choices,
    expected_times,
    explored,
    keep_lights,
    leaf_samples,
    lists,
    probabilities,
    random_cache,
    records_of,
)
from scene_tools import light, quad
from statistics_tools import device, every_device  # noqa: F401

import warp_gi as gi
from warp_gi.kernels import light_cache, light_cache_build, samples
from warp_gi.launch import launch

SIZE = (48, 27)
SETTLED = range(6, 14)
BOUND = 1.1
"""Times the hierarchy's variance."""
NOISE = 0.05
"""Of a ratio of variances: three standard deviations over the seeds and frames here."""


# ---- scenes ----


def lamps(side, corner, u, v, powers):
    """A grid of ``side`` x ``side`` square lamps, 40 % as wide as they are apart, two triangles each."""
    corner, u, v = (np.array(x, float) for x in (corner, u, v))
    meshes = []
    for power in np.unique(powers):
        rows, columns = np.nonzero(powers.reshape(side, side) == power)
        starts = corner + ((rows + 0.3) / side)[:, None] * u + ((columns + 0.3) / side)[:, None] * v
        square = np.array([0 * u, 0.4 / side * u, 0.4 / side * (u + v), 0.4 / side * v])
        points = (starts[:, None] + square).reshape(-1, 3)
        faces = (4 * np.arange(len(starts)))[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])
        material = light((25.0 * power,) * 3)
        meshes.append(gi.Mesh(points.astype(np.float32), faces.reshape(-1, 3).astype(np.int32), material))
    return meshes


def wall_of_lamps(side, powers="equal", hidden=0.0, roughness=None, above=False):
    """A floor, and behind or above it a wall of lamps, a share of which is behind a screen."""
    rng = np.random.default_rng(3)
    sizes = np.ones(side * side) if powers == "equal" else 10 ** (rng.integers(-4, 5, side * side) / 4)
    floor = gi.Material("floor", (0.5, 0.5, 0.5), specular=0.0)
    if roughness is not None:
        floor = gi.Material("floor", (0.4, 0.4, 0.4), roughness=roughness)
    meshes = [quad((-3, 0, -2), (0, 0, 6), (6, 0, 0), floor)]
    place = ((-3, 3, -2), (6, 0, 0), (0, 0, 6)) if above else ((-3, 0.1, -2), (6, 0, 0), (0, 6, 0))
    meshes += lamps(side, *place, sizes)
    if hidden:
        black = gi.Material("black", (0, 0, 0), specular=0.0)
        meshes.append(quad((-3, 0, -1.9), (6 * hidden, 0, 0), (0, 6.5, 0), black))
    return gi.Scene([gi.Node("all", meshes)])


def two_halls():
    """At the left a wall of 3,200 lamps, at the right 32 lamps of which three quarters are behind a screen."""
    floor = gi.Material("floor", (0.5, 0.5, 0.5), specular=0.0)
    black = gi.Material("black", (0, 0, 0), specular=0.0)
    meshes = [
        quad((-3, 0, -2), (0, 0, 6), (6, 0, 0), floor),
        quad((0, 0, -2), (0, 0, 6), (0, 6, 0), black),
        quad((-0.01, 0, -2), (0, 6, 0), (0, 0, 6), black),
        quad((0.01, 0, -1.8), (2.25, 0, 0), (0, 6, 0), black),
        *lamps(40, (-3, 0.1, -2), (3, 0, 0), (0, 6, 0), np.ones(1600)),
        *lamps(4, (0.01, 0.1, -2), (3, 0, 0), (0, 3, 0), np.ones(16)),
    ]
    return gi.Scene([gi.Node("all", meshes)])


CAMERA = gi.Camera.look_at((0, 3.5, 5.5), (0, 0.2, 0.8), hfov=50, resolution=SIZE)


def rendered(scene, emitters, seeds, frames):
    """Float64 [seed, frame, height, width] luminance of the emitters' light of frames, of sequences from 0 on."""
    octree = gi.SampleOctree(split=256, collapse=128)
    pipeline = gi.Pipeline(environment=None, emitters=emitters, indirect=None, spp=1, octree=octree)
    path, out = gi.CameraPath.still(CAMERA), []
    for seed in seeds:
        made = gi.render(scene, path, pipeline, frames=range(max(frames) + 1), device=str(device()), seed=seed)
        out.append([f.numpy("emitters").astype(np.float64) @ LUMINANCE for f in made if f.index in frames])
    return np.array(out)


def ratio(ours, theirs):
    """Variance of all frames and seeds over that of others, mean over pixels."""
    return ours.var(axis=(0, 1)).mean() / theirs.var(axis=(0, 1)).mean()


# ---- variance ----


@pytest.mark.parametrize(
    "settings",
    [{"side": 40}, {"side": 40, "roughness": 0.3, "above": True}, {"side": 40, "powers": "unequal"}, {"side": 10}],
    ids=["3200 equal", "3200 equal, GGX", "3200 unequal", "200 equal"],
)
def test_lights_beyond_the_capacity_vary_no_more_than_by_the_hierarchy(settings):
    """From the third frame on. (With the cache and exploring beside it everywhere: 1.4 to 3.3 times.)"""
    scene, seeds, frames = wall_of_lamps(**settings), range(1, 9), range(3, 14)
    ours, theirs = (
        rendered(scene, e, seeds, frames) for e in (gi.VisibilityLightCache(rests=False), gi.LightHierarchy())
    )
    assert ratio(ours, theirs) <= BOUND + NOISE, ratio(ours, theirs)


@pytest.mark.parametrize("side", [6, 22], ids=["72 lights", "968 lights"])
def test_hidden_lights_are_still_worth_the_cache(side):
    """Half of them is behind a screen."""
    scene, seeds, frames = wall_of_lamps(side, hidden=0.5), range(1, 9), range(16, 22)
    ours, theirs = (
        rendered(scene, e, seeds, frames) for e in (gi.VisibilityLightCache(rests=False), gi.LightHierarchy())
    )
    assert ratio(ours, theirs) < 0.5, ratio(ours, theirs)


def test_regions_of_one_picture_decide_by_themselves():
    """One hall sees thousands of lights, the other a few of many."""
    ours, theirs = (
        rendered(two_halls(), e, range(1, 9), SETTLED)
        for e in (gi.VisibilityLightCache(rests=False), gi.LightHierarchy())
    )
    many, few = np.s_[..., : SIZE[0] // 2 - 1], np.s_[..., SIZE[0] // 2 + 1 :]
    assert ratio(ours[many], theirs[many]) <= BOUND + NOISE
    assert ratio(ours[few], theirs[few]) < 0.7


@pytest.mark.parametrize("settings", [{"side": 40}, {"side": 22, "hidden": 0.5}], ids=["equal", "hidden"])
def test_means_are_those_of_the_hierarchy(settings):
    """In frames in which nothing is known, in which some regions have changed their way, and in which they rest."""
    scene, frames = wall_of_lamps(**settings), (0, 5, 30)
    ours = rendered(scene, gi.VisibilityLightCache(rests=False), range(1, 13), frames)
    ours = np.stack([in_grey(ours[:, [k]]) for k in range(len(frames))], axis=1)
    mean, variance = st.mean_and_variance(in_grey(rendered(scene, gi.LightHierarchy(), range(101, 109), range(12))))
    for k, index in enumerate(frames):
        st.compare_images(f"many_lights_{index}", ours[:, k], mean, variance, 1e-4, 95, noise_ratio=1.0)


def in_grey(luminances):
    """Frames of all seeds, one after another, as pictures of three channels."""
    return np.repeat(np.concatenate(luminances)[..., None], 3, axis=-1)


def test_the_first_frame_is_the_hierarchys():
    """Nothing is known; the same lights are selected by the same numbers."""
    scene = wall_of_lamps(10)
    ours, theirs = (rendered(scene, e, (3,), (0,)) for e in (gi.VisibilityLightCache(rests=False), gi.LightHierarchy()))
    assert np.allclose(ours, theirs, rtol=1e-4, atol=1e-6) and ours.max() > 0.1


# ---- what regions learn it from ----


@pytest.mark.parametrize("alone", [False, True], ids=["both", "alone"])
def test_excess_is_that_of_the_variances(alone):
    """Of points that see lights at random: the variance of both choices together, less that of exploring alone.

    Exactly; where exploring is alone, the product of the means counts one and a half times.
    """
    frame, data, spots = random_cache("hierarchy")
    tables = data.tables
    tables.alone = array(np.full(tables.buckets.shape[0], alone))
    data.tables = tables
    rng, count = np.random.default_rng(11), 40_000
    (_, offered), explores = probabilities(frame, data, spots), explored(frame, data, spots)
    share = tables.exploration.numpy()[spots.regions.numpy()].astype(float)[:, None]
    # so much that no sample brings very much
    brings = (explores if alone else offered + explores) * rng.uniform(0.5, 1, offered.shape)
    brings[(rng.random(offered.shape) < 0.4) | (explores <= 1e-4)] = 0.0
    own, other = offered**2, (share * explores) ** 2
    part = own / np.maximum(own + other, 1e-30)  # that comes by the cache, by the power heuristic
    cached = divided((part * brings) ** 2, offered)
    beside = divided(((1 - part) * brings) ** 2, share * explores)
    by_hierarchy = divided(brings**2, explores).sum(axis=1)
    # a frame tells at most as much as the moments are, but for what is explored though the cache offers it more often
    most = cached.sum(axis=1) + (share * np.where(offered < share * explores, beside, 0.0)).sum(axis=1)
    cached, beside = cached.sum(axis=1), beside.sum(axis=1)
    product = (part * brings).sum(axis=1) * ((1 - part) * brings).sum(axis=1)
    if alone:
        product = np.minimum(1.5 * product, np.sqrt(cached * beside))
    exact = cached + beside + 2 * product - by_hierarchy
    found, scale = learnt_excess(frame, data, spots, brings, count, rng) / count, cached + beside + by_hierarchy
    shines = (scale > 0) & (tables.buckets.numpy() > 0)[spots.regions.numpy()]
    off = np.abs(found - np.minimum(exact, most))[shines] / scale[shines]
    assert off.max() < (0.06 if alone else 0.05), off.max()
    assert shines.sum() > 50 and (exact[shines] > 0.1 * scale[shines]).any()
    assert alone or (exact[shines] < -0.1 * scale[shines]).any()


def divided(a, b):
    """Quotients, 0 where the divisor is."""
    return np.divide(a, b, out=np.zeros_like(a), where=b > 0)


def learnt_excess(frame, data, spots, brings, count, rng):
    """Float64 [spot] of regions at each of the spots, from ``count`` samples that bring what lights there bring."""
    places = len(brings)
    _, second = expected_times(frame, data, spots)
    assert np.array_equal(alone_at(data, spots), (second == 0).all(axis=1))
    regions = samples.SampleRegions()
    regions.records = records_of(np.zeros(places * count), np.zeros(places * count))
    rows = np.arange(places)[:, None]
    for explores in (0, 1):
        numbers = rng.random((count, 3)).astype(np.float32)
        items, pdfs, weights, _, alone, others = choices(frame, data, spots, numbers, explores)
        there = items >= 0
        values = np.where(there, weights * brings[rows, items] / np.where(there, pdfs, 1), 0.0)
        chances = np.stack([pdfs, weights, others, np.ones_like(pdfs)], axis=-1).reshape(-1, 4)
        given = [array(items.ravel()), explores, array(alone.ravel()), array(chances, wp.vec4)]
        given += [array(np.where(values > 0, 1, -1).ravel()), array(values.ravel(), wp.float32)]
        launch(keep_lights, items.size, [regions, *given], device())
    settings = light_cache_build.CacheSettings()
    settings.first_exploration, settings.least_exploration, settings.most_exploration = 0.1, 0.05, 0.75
    settings.may_be_alone = 1
    known, learnt = (light_cache.CacheTables() for _ in range(2))
    for tables in (known, learnt):
        tables.buckets, tables.alone = array(np.ones(places)), array(np.zeros(places))
        tables.exploration = array(data.tables.exploration.numpy()[spots.regions.numpy()], wp.float32)
        tables.moments, tables.excesses = array(np.zeros((places, 2)), wp.vec2), array(np.zeros(places), wp.float32)
    grouped = leaf_samples(np.full(places, count), np.arange(places * count), 1 << 20)
    inputs = [settings, grouped, regions.records, lists([[]] * places), array(np.arange(places)), known, learnt]
    launch(light_cache_build.weigh_light_samples, places, inputs, device())
    return learnt.excesses.numpy().astype(np.float64)
