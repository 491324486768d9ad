"""Sample reuse rests where it gains less than it costs: the plain samplers' frames bit for bit, and few trials."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_tools import quad
from statistics_tools import device, every_device  # noqa: F401

import warp_gi as gi
from warp_gi.bench.harness import scenes
from warp_gi.kernels import octree, reuse_gains, samples
from warp_gi.launch import launch, on_device, set_threads
from warp_gi.techniques.reuse import rest
from warp_gi.techniques.reuse.rest import CACHE_COST, GUIDE_COST, Gains, Rest

SIZE = (32, 18)
OCTREE = gi.SampleOctree(split=192, collapse=96)


def room(lamps=1, moves=False):
    """A floor and a wall under one or more lamps that all points see; a lamp that comes from below in frame 40."""
    grey = gi.Material("grey", (0.6, 0.6, 0.6), specular=0.0)
    parts = [quad((-2, 0, 2), (4, 0, 0), (0, 0, -4), grey), quad((-2, 0, -2), (4, 0, 0), (0, 3, 0), grey)]
    glow = scenes.light((8.0, 7.0, 6.0))
    parts += [quad((0.5 * k - 0.25, 2.9, -0.25), (0.4, 0, 0), (0, 0, 0.4), glow) for k in range(lamps)]
    nodes = [gi.Node("room", parts)]
    if moves:
        appears = 40 / gi.builtin_camera_path("cornell_box").fps
        keys = [gi.Keyframe(appears - 0.01, (0.0, -9.0, 0.0)), gi.Keyframe(appears, (0.0, 0.0, 0.0))]
        nodes.append(gi.Node("lamp", [quad((1.2, 2.5, 0.5), (0.3, 0, 0), (0, 0, 0.3), glow)], keyframes=keys))
    return gi.Scene(nodes)


def camera():
    return gi.Camera.look_at((0, 1.5, 3.5), (0.0, 0.9, 0.0), hfov=60, resolution=SIZE)


def box_scheduler(**settings):
    """The Cornell box, where light comes from everywhere and one lamp is seen by all."""
    chosen = {"emitters": gi.VisibilityLightCache(), "indirect": gi.GuidedPaths(max_depth=5), "octree": OCTREE}
    view = gi.builtin_camera_path("cornell_box").at_resolution(*SIZE)
    return gi.FrameScheduler(
        gi.builtin_scene("cornell_box"), view, gi.Pipeline(**{"spp": 2, **chosen, **settings}), device().alias, 3
    )


def scheduler(scene=None, seed=3, **settings):
    chosen = {"emitters": gi.VisibilityLightCache(), "indirect": gi.GuidedPaths(max_depth=5), "octree": OCTREE}
    pipeline = gi.Pipeline(**{"spp": 2, **chosen, **settings})
    return gi.FrameScheduler(scene or room(), gi.CameraPath.still(camera()), pipeline, device().alias, seed)


def used(frame):
    """Names of the samplers of a frame."""
    return frame.paths.lights.sampler.name, frame.paths.directions.sampler.name


def same(a, b):
    return all(np.array_equal(a.numpy(name), b.numpy(name)) for name in a.names)


# ---- frames ----


@pytest.fixture(scope="module")
def fifty():
    """Samplers and pictures of the first 50 frames of the Cornell box."""
    ours = box_scheduler()
    frames = [ours.frame(index) for index in range(50)]
    return [used(frame) for frame in frames], frames


def test_few_lights_are_left_to_the_hierarchy(fifty):
    """The numbers of frames that try are those of rests of 8, 16 and 32 after six frames."""
    names, _ = fifty
    cached = [index for index, (lights, _) in enumerate(names) if lights == "cache"]
    guided = [index for index, (_, directions) in enumerate(names) if directions == "guided"]
    assert cached == guided == [*range(6), 14, 31]


def test_resting_frames_are_those_of_the_plain_samplers(fifty):
    names, frames = fifty
    plain = box_scheduler(emitters=gi.LightHierarchy(), indirect=gi.BsdfPaths(max_depth=5))
    for index in (0, 6, 13, 14, 20, 49):
        resting = names[index] == used(plain.frame(index))
        assert same(frames[index], plain.frame(index)) == resting == (index not in (0, 14)), index


def test_threads_change_no_decision(fifty):
    _, frames = fifty
    try:
        set_threads(3)
        ours = box_scheduler()
        assert all(same(ours.frame(index), frames[index]) for index in range(18))
    finally:
        set_threads(None)


def test_it_may_be_forbidden():
    ours = scheduler(
        emitters=gi.VisibilityLightCache(rests=False), indirect=gi.GuidedPaths(max_depth=5, rests=False), spp=1
    )
    assert {used(ours.frame(index)) for index in range(10)} == {("cache", "guided")}


def test_many_lights_that_few_points_see_keep_the_cache():
    """The warehouse: the cache stays, guiding rests, and what it knows follows the cache's tree.

    Once settled, every second frame leaves no samples.
    """
    path = gi.builtin_camera_path("warehouse").at_resolution(160, 90)
    pipeline = gi.Pipeline.preset("reuse", spp=2)
    ours = gi.FrameScheduler(gi.builtin_scene("warehouse"), path.camera(0), pipeline, device().alias, 3)
    frames = [ours.frame(index) for index in range(28)]
    names = [used(frame) for frame in frames]
    assert {lights for lights, _ in names} == {"cache"}
    assert [directions for _, directions in names] == ["guided"] * 6 + ["bsdf"] * 8 + ["guided"] + ["bsdf"] * 13
    kept = [frame.paths.regions.data.records.vertices > 0 for frame in frames]
    first = kept.index(False)
    assert first > 15 and kept[first:] == [bool(index % 2) for index in range(28 - first)] and first < 25
    leaves = ours.state("octree").leaf_count
    guides = ours.state("indirect").guides
    assert guides.trees.shape == (leaves,) and guides.energies.shape == (leaves * 4 * 128,)
    assert guides.energies.numpy().sum() > 0


def test_caches_follow_the_tree_while_they_rest():
    """Leaf by leaf, through the leaf of the last tree that held it."""
    ours = scheduler(room(lamps=3), indirect=gi.GuidedPaths(max_depth=5, rests=False), spp=8)
    for index in range(4):
        ours.frame(index)
    state = ours._states["emitters"]
    ours._states["emitters"] = replace(state, rest=Rest(left=3, longest=8))
    frame = ours.frame(4)
    assert used(frame) == ("hierarchy", "guided")
    after = ours.state("emitters")
    assert after.rest == Rest(left=2, longest=8)
    counts = state.known.counts.numpy()
    assert set(after.known.counts.numpy()) <= {0, *counts} and after.known.counts.numpy().max() == counts.max() > 0
    assert after.tables.buckets.shape == (ours.state("octree").leaf_count,)
    assert after.known.entries is state.known.entries  # lists are shared, not copied
    for index in range(5, 7):
        ours.frame(index)
    assert used(ours.frame(7)) == ("cache", "guided")


def test_a_light_that_appears_wakes_it():
    """In the very frame, once; the room without it goes on resting."""
    still, moving = scheduler(room(), spp=1), scheduler(room(moves=True), spp=1)
    plain = [used(scheduler(room(moves=moves), emitters=gi.LightHierarchy(), spp=1).frame(0))[0] for moves in (0, 1)]
    names = {one: [used(one.frame(index))[0] for index in range(43)] for one in (still, moving)}
    assert names[still][32:] == [plain[0]] * 11
    assert names[moving][32:] == [plain[1]] * 8 + ["cache"] * 2 + [plain[1]]


@pytest.mark.parametrize("stopped", [9, 14])
def test_a_sequence_goes_on_in_the_middle_of_a_rest(fifty, tmp_path, stopped):
    names, frames = fifty
    first = box_scheduler()
    for index in range(stopped + 1):
        first.frame(index)
    first.save_state(tmp_path / "a.safetensors")
    second = box_scheduler()
    second.load_state(tmp_path / "a.safetensors")
    for index in range(stopped + 1, 18):
        frame = second.frame(index)
        assert used(frame) == names[index] and same(frame, frames[index]), index


# ---- when to rest ----


def days(gain, cost=2.0, frames=600, moves=False, begins=()):
    """Return in which frames the technique is used; ``gain`` is over the variance, by frame."""
    state, awake = Rest(), []
    for index in range(frames):
        state = state.woken() if index in begins else state
        awake.append(not state.is_resting)
        state = state.rested() if state.is_resting else state.judged(3.0 * gain(index), 3.0, cost, moves)
    return np.flatnonzero(awake)


def test_trials_take_few_frames():
    """Six at first, then one after 8, 16, 32, 64 and 128 frames; 128 at most, or 64 where things move."""
    assert list(days(lambda index: 0.0)) == [*range(6), 14, 31, 64, 129, 258, 387, 516]
    moving = days(lambda index: 0.0, moves=True)
    assert list(moving[6:9]) == [14, 31, 64] and set(np.diff(moving[8:])) == {65}
    assert len(moving) < 0.03 * 600
    # and lights that begin to move every few frames wake it for two frames after 96 of rest
    waking = days(lambda index: 0.0, moves=True, begins=range(0, 600, 5))
    assert len(moving) + 8 < len(waking) < 6 + 0.045 * 600


def test_what_gains_more_than_it_costs_stays():
    assert len(days(lambda index: 1.05)) == 600
    assert len(days(lambda index: 0.4, cost=1.35)) == 600
    assert len(days(lambda index: 0.3, cost=1.35)) < 30
    # one frame does not end it, twenty do
    assert len(days(lambda index: 1.5 if index != 40 else -3.0)) == 600
    used_in = days(lambda index: 1.5 if index < 40 else 0.2, frames=64)
    assert 50 < used_in.max() < 60


def test_what_learns_slowly_has_more_time():
    mine = [-0.83, -0.12, -1.39, 0.41, 0.51, 0.61, 0.25, 0.53, 0.35, 0.51]  # guiding in the mine
    assert len(days(lambda index: mine[index] if index < 10 else 0.6, cost=1.35)) == 600
    late = days(lambda index: 0.1 if index < 60 else 1.5, frames=900)
    assert late[-1] == 899 and late[late > 60][0] == 64


def test_what_is_settled_learns_from_every_second_frame():
    state = Rest(trial=0)
    learns = []
    for _ in range(20):
        learns.append(not state.may_skip)
        state = state.judged(2.0, 1.0, 2.0, False) if learns[-1] else state.skipped()
    assert learns == [True] * 10 + [True, False] * 5


def test_one_bright_sample_does_not_decide():
    """A frame tells of twice its variance at most: what no picture shows would be seen in one of hundreds."""
    assert len(days(lambda index: 1000.0 if index == 3 else 0.0)) < 14
    assert Rest().judged(1e30, 1.0, 2.0, False).gain == rest.MOST_GAIN
    assert Rest().judged(-1e30, 1.0, 2.0, False).gain == -rest.MOST_LOSS
    assert Rest(tried=5).judged(0.0, 0.0, 2.0, False).is_resting


def test_rests_are_saved_whole():
    numbers = Rest(left=7, trial=0, tried=5, longest=32, credit=11, gain=0.1, variance=1 / 3)
    assert Rest().with_saved_arrays(numbers.saved_arrays()) == numbers
    assert isinstance(Rest().with_saved_arrays(numbers.saved_arrays()).left, int)


def test_costs_are_above_one():
    assert CACHE_COST > 1.0 and GUIDE_COST > 1.0


# ---- what samples tell ----


def test_gains_of_samples():
    """Against float64: chunks that end early, slots without a sample, and samples where exploring is alone."""
    rng = np.random.default_rng(5)
    count = 2 * int(samples.CHUNK) + 77
    records, target = samples.SampleRecords(), device()
    codes = np.where(rng.random(count) < 0.3, int(octree.EMPTY_CODE), 5)
    alone = rng.random(count) < 0.2
    rivals = rng.normal(size=count).astype(np.float32)
    contributions = np.where(rng.random(count) < 0.2, -1.0, rng.random(count)).astype(np.float32)
    carried, share, posterior = rng.uniform(0.1, 2, count).astype(np.float32), *rng.uniform(0.05, 0.95, (2, count))
    words = np.round(posterior * 65535).astype(np.int64), np.round(share * 65535).astype(np.int64)
    for name, values, dtype in (
        ("codes", codes, np.uint32),
        ("lights", np.where(alone, int(samples.LIGHT_ALONE), 0), np.uint32),
        ("mixtures", words[0] | words[1] << 16, np.uint32),
        ("rivals", rivals, np.float32),
        ("contributions", contributions, np.float32),
        ("carried", carried, np.float32),
    ):
        kind = getattr(samples.SampleRecords.vars[name].type, "dtype")  # noqa: B009
        setattr(records, name, on_device(values.astype(dtype), kind, target))
    chunks = on_device(np.zeros((3, 2), np.float32), reuse_gains.wp.vec2, target)
    launch(reuse_gains.sum_gains, 3, [records, chunks], target)
    there = codes == 5
    brought = (contributions.astype(float) * carried)[there & (contributions > 0)]
    density = (words[0] / words[1])[there & (contributions > 0)]
    expected = -rivals[there & ~alone].astype(float).sum(), (brought**2 * (1 / density - 1)).sum()
    assert np.allclose(chunks.numpy().sum(axis=0), expected, rtol=1e-4)


def test_the_variance_of_a_picture_is_that_of_its_pixels(monkeypatch):
    """On a floor of even light, of which pixels are independent: against the variance over seeds."""
    found = []
    ask = rest.frame_gains
    monkeypatch.setattr(rest, "frame_gains", lambda frame, lesson: found.append(ask(frame, lesson)) or found[-1])
    pictures = []
    for seed in range(24):
        frame = scheduler(seed=seed, spp=1).frame(0)
        pictures.append(frame.numpy("beauty") @ np.array([0.2126, 0.7152, 0.0722]))
    gains = found[::2]
    assert all(isinstance(gain, Gains) for gain in gains) and found[0] is found[1]  # worked out once
    variance = np.var(pictures, axis=0, ddof=1).sum()
    assert np.mean([gain.variance for gain in gains]) == pytest.approx(variance, rel=0.25)


def test_gains_of_the_cache_are_those_of_pictures(monkeypatch):
    """What samples tell is by how much the hierarchy's pictures vary more, where lamps are seen through gaps."""
    found = []
    ask = rest.frame_gains
    monkeypatch.setattr(rest, "frame_gains", lambda *args: found.append(ask(*args)) or found[-1])
    monkeypatch.setattr(Rest, "judged", lambda self, *args: self)
    view = gi.builtin_camera_path("warehouse").at_resolution(64, 36).camera(0)
    scene, variances = gi.builtin_scene("warehouse"), []
    for emitters in (gi.VisibilityLightCache(), gi.LightHierarchy()):
        pipeline = gi.Pipeline(emitters=emitters, indirect=gi.BsdfPaths(max_depth=3), spp=1, octree=OCTREE)
        ours = gi.FrameScheduler(scene, view, pipeline, device().alias, 5)
        frames = [ours.frame(index).numpy("beauty") @ np.array([0.2126, 0.7152, 0.0722]) for index in range(22)]
        variances.append(np.var(frames[10:], axis=0, ddof=1).sum())
    told = np.mean([gain.lights for gain in found[10:]])
    assert told == pytest.approx(variances[1] - variances[0], rel=0.4)
    assert variances[1] > 1.5 * variances[0]
