"""Techniques that learn from samples: unbiased in every frame, whatever moves; threads; going on from a file."""

from __future__ import annotations

import numpy as np
import pytest
import statistics_tools as st
from scene_tools import quad, sphere
from statistics_tools import every_device  # noqa: F401

import warp_gi as gi
from warp_gi.errors import BakeError, OptionError
from warp_gi.launch import set_threads
from warp_gi.techniques.reuse.sample_octree import MOST_VERTICES

SIZE = (24, 16)
SPP = 8
OCTREE = gi.SampleOctree(split=192, collapse=96)
TERMS = ("environment", "emitters", "indirect")
CACHED, GUIDED = gi.VisibilityLightCache(rests=False), gi.GuidedPaths(max_depth=5, rests=False)
GLOSSY = gi.Material("glossy", (0.9, 0.7, 0.4), metallic=1.0, roughness=0.3)
COATED = gi.Material("coated", (0.3, 0.5, 0.7), roughness=0.5)


def lamp(x, y, z, color, size=0.2):
    """A square that shines down."""
    glow = gi.Material("glow", (0.0, 0.0, 0.0), emission=color)
    return quad((x, y, z), (size, 0, 0), (0, 0, size), glow)


def hall(moving=False, sky=True):
    """Two rooms with a gap between them, lamps in both, a window, a lamp without size, a metal ball, a coated box."""
    walls = [
        quad((-2, 0, 2), (4, 0, 0), (0, 0, -4), COATED),
        quad((-2, 0, -2), (4, 0, 0), (0, 2, 0)),
        quad((-2, 0, 2), (0, 0, -4), (0, 2, 0)),
        quad((2, 0, -2), (0, 0, 4), (0, 2, 0)),
        quad((-2, 2, -2), (4, 0, 0), (0, 0, 3)),  # a roof that leaves a strip of sky
        quad((0.2, 0, -2), (0, 0, 2.6), (0, 2, 0)),
        quad((0.2, 0, 0.6), (0, 0, -2.6), (0, 2, 0)),
    ]
    lamps = [lamp(-1.8 + 0.45 * i, 1.9, -1.6 + 0.5 * (i % 3), (6.0, 4.0 + i % 2, 3.0)) for i in range(9)]
    keys = [gi.Keyframe(0.0), gi.Keyframe(1.0, (1.2, 0.0, 0.4))] if moving else None
    nodes = [
        gi.Node("walls", walls),
        gi.Node("lamps", lamps[:6]),
        gi.Node("moving lamps", lamps[6:], keyframes=keys and [gi.Keyframe(0.0), gi.Keyframe(1.0, (-1.0, 0.0, 0.5))]),
        gi.Node("ball", [sphere((-1.0, 0.4, 0.3), 0.4, GLOSSY, rows=12)], keyframes=keys),
    ]
    bulb = gi.PunctualLight("point", (0.8, 0.8, 1.2), position=(1.2, 1.0, -1.0))
    spot = gi.PunctualLight("spot", (3.0, 2.0, 1.0), position=(-1.5, 1.5, 1.0), direction=(1, -1, -1), node=3)
    pixels = np.full((16, 32, 3), 0.3, np.float32)
    pixels[2:4, 9:12] = 40.0
    return gi.Scene(nodes, [bulb, spot], environment=gi.Environment(pixels=pixels) if sky else None)


def view():
    return gi.Camera.look_at((-1.6, 1.4, 1.9), (-0.3, 0.5, -0.6), hfov=75, resolution=SIZE)


def pipeline(**settings):
    settings = {"emitters": CACHED, "indirect": GUIDED, **settings}
    return gi.Pipeline(**{"spp": SPP, "octree": OCTREE, **settings})


PLAIN = {"emitters": gi.PowerLights(), "indirect": gi.BsdfPaths(max_depth=5)}


def sequences(scene, chosen, frames, count, seed=1):
    """Return the terms of the last of ``frames`` of ``count`` independent sequences, float64 [count, h, w, 3] each."""
    pictures = {term: [] for term in TERMS}
    for number in range(count):
        path = gi.CameraPath.still(view())
        *_, frame = gi.render(scene, path, chosen, frames, device=st.device().alias, seed=1000 * seed + number)
        for term in TERMS:
            pictures[term].append(frame.numpy(term).astype(np.float64))
    return {term: np.stack(images) for term, images in pictures.items()}


@pytest.fixture(scope="module")
def references():
    """Plain path traced means and variances, by whether things move and by frame; made when asked for."""
    known = {}

    def ask(moving, frame, count=24, spp=64):
        if (moving, frame) not in known:
            images = sequences(hall(moving), pipeline(**PLAIN, spp=spp), [frame], count, seed=7)
            known[moving, frame] = {term: st.mean_and_variance(x) for term, x in images.items()}
        return known[moving, frame], count * spp, count - 1

    return ask


def same_pictures(name, references, moving, frames, chosen, count=16):
    reference, samples, dof = references(moving, frames[-1] if moving else 0)
    ours = sequences(hall(moving), chosen, frames, count)
    for term in TERMS:
        mean, variance = reference[term]
        ratio = samples / (count * chosen.spp)
        st.compare_images(f"{name}_{term}", ours[term], mean, variance, 1e-4, dof, ratio)


@pytest.mark.parametrize("moving", [False, True], ids=["still", "moving"])
@pytest.mark.parametrize("last", [0, 5, 30])
def test_unbiased_in_every_frame(references, last, moving):
    """Frame 0 knows nothing; in frame 5 all is in motion; by frame 30 a still scene is learnt."""
    if last == 30:
        frames = [*range(24, 31)] if moving else [*range(31)]
    else:
        frames = [*range(last + 1)]
    same_pictures(f"reuse_{last}_{moving}", references, moving, frames, pipeline())


@pytest.mark.parametrize("change", ["paper", "leaf", "table", "indirect alone", "rests"])
def test_other_ways_are_unbiased_too(references, change):
    """The paper's settings; a leaf picked by a third number; exploration by a table; directions without a cache; and
    a frame that tries again after a rest, or is in use."""
    paper = gi.GuidedPaths(max_depth=5, migrations=1, adapts_share=False, stratified=False, bits=32, fading=0.0)
    chosen = {
        "paper": pipeline(indirect=paper),
        "leaf": pipeline(indirect=gi.GuidedPaths(max_depth=5, stratified=False, bits=64)),
        "table": pipeline(emitters=gi.VisibilityLightCache(explores_by="table", capacity=6)),
        "indirect alone": pipeline(emitters=gi.PowerLights(), indirect=gi.GuidedPaths(max_depth=5, bits=96)),
        "rests": pipeline(emitters=gi.VisibilityLightCache(), indirect=gi.GuidedPaths(max_depth=5)),
    }[change]
    same_pictures(f"reuse_{change}", references, False, [*range(16 if change == "rests" else 5)], chosen)


@pytest.mark.parametrize("moving", [False, True], ids=["still", "moving"])
def test_the_hierarchy_is_unbiased(references, moving):
    chosen = pipeline(emitters=gi.LightHierarchy(), indirect=gi.BsdfPaths(max_depth=5))
    same_pictures(f"hierarchy_{moving}", references, moving, [0, 3, 5] if moving else [0], chosen)


def sequence(frames, scene=None, chosen=None, seed=5):
    """Return a scheduler and the buffers of each frame."""
    scheduler = gi.FrameScheduler(
        scene or hall(moving=True), gi.CameraPath.still(view()), chosen or pipeline(), st.device().alias, seed
    )
    return scheduler, [buffers(scheduler.frame(index)) for index in frames]


def buffers(frame):
    return {name: frame.numpy(name).copy() for name in frame.names}


def assert_same(a, b):
    for name in a:
        assert np.array_equal(a[name], b[name]), name


def test_threads_do_not_change_a_bit():
    pictures = []
    try:
        for threads in (1, 2, 5):
            set_threads(threads)
            pictures.append(sequence(range(5))[1])
    finally:
        set_threads(None)
    for others in pictures[1:]:
        for one, other in zip(pictures[0], others, strict=True):
            assert_same(one, other)


@pytest.mark.parametrize("stopped", [0, 2])
def test_a_saved_state_goes_on_bit_for_bit(tmp_path, stopped):
    """With the octree, caches and quadtrees; whatever moves. In another process there is a new scene, too."""
    _, unbroken = sequence(range(5))
    scheduler, _ = sequence(range(stopped + 1))
    scheduler.save_state(tmp_path / "a.safetensors", "frames")
    resumed, _ = sequence([])
    resumed.load_state(tmp_path / "a.safetensors", "frames")
    for index in range(stopped + 1, 5):
        assert_same(buffers(resumed.frame(index)), unbroken[index])


def test_any_indirect_light_goes_with_a_cache(tmp_path):
    """Settings of other kinds than numbers and text are in the state's file, too."""
    chosen = pipeline(indirect=gi.LightFieldProbes(mode="irradiance", counts=(2, 1, 2), resolution=16, rays=1))
    scheduler, _ = sequence([0, 1], hall(), chosen)
    scheduler.save_state(tmp_path / "a.safetensors")
    other, _ = sequence([], hall(), chosen)
    other.load_state(tmp_path / "a.safetensors")
    assert_same(buffers(other.frame(2)), buffers(scheduler.frame(2)))


def test_paths_may_be_longer_than_what_is_kept_of_them():
    """Of long paths the first vertices are kept; and nothing of one in the slots of another."""
    closed = hall(sky=False)
    chosen = pipeline(indirect=gi.GuidedPaths(max_depth=40, roulette_depth=40), spp=1)
    scheduler, frames = sequence([0], closed, chosen)
    records = scheduler.state("octree").spare.records
    assert records.vertices == MOST_VERTICES == 7 and records.codes.shape[0] % 7 == 0
    used = (records.codes.numpy().reshape(-1, 7) != 0xFFFFFFFF).sum(axis=1)
    assert used.max() == 7
    assert np.isfinite(frames[0]["beauty"]).all()


# ---- what paths leave behind ----


def court(albedo, wall=0.6):
    """A floor that the camera sees, between three high walls that do not touch it, under a sky of one."""
    floor = gi.Material("floor", (albedo, albedo, albedo), specular=0.0)
    grey = gi.Material("wall", (wall, wall, wall), specular=0.0)
    parts = [
        quad((-2, 0, 2), (4, 0, 0), (0, 0, -4), floor),
        quad((-2, 0.1, -2), (4, 0, 0), (0, 5, 0), grey),
        quad((-2, 0.1, 2), (0, 0, -4), (0, 5, 0), grey),
        quad((2, 0.1, -2), (0, 0, 4), (0, 5, 0), grey),
    ]
    return gi.Scene([gi.Node("court", parts)], environment=1.0)


class Kept:
    """Samples of the first frame of the court by path and vertex, [path, 3]."""

    def __init__(self, albedo, roulette_depth=9):
        camera = gi.Camera.look_at((0, 1.5, 3.5), (0.0, 0.0, 0.0), hfov=40, resolution=SIZE)
        indirect = gi.GuidedPaths(max_depth=4, roulette_depth=roulette_depth)
        scheduler = gi.FrameScheduler(court(albedo), camera, pipeline(indirect=indirect), st.device().alias, seed=5)
        scheduler.frame(0)
        records, cube = scheduler.state("octree").spare.records, scheduler.state("octree").octree
        assert records.vertices == 3 and records.stride == 1

        def column(name):
            return getattr(records, name).numpy().reshape(-1, 3)

        codes = column("codes").astype(np.int64)
        self.there = codes != 0xFFFFFFFF
        places = [sum((codes >> (3 * bit + axis) & 1) << bit for bit in range(10)) for axis in range(3)]
        self.positions = (np.stack(places, axis=-1) + 0.5) / cube.scale + np.array(cube.low)
        self.on_floor = self.there & (self.positions[..., 1] < 0.05)
        contributions = column("contributions")
        self.known = self.there & (contributions >= 0)
        self.contributions, self.carried, self.nearness = (
            np.where(self.known, column(name), 0).astype(np.float64)
            for name in ("contributions", "carried", "nearness")
        )
        mixtures = column("mixtures")
        self.bsdf = (mixtures & 0xFFFF) / 65535 / np.maximum((mixtures >> 16) / 65535, 1e-9)
        """Density of the BSDF over that of the mixture."""


def test_contributions_do_not_count_what_came_before():
    """Throughputs of grey Lambert walls are albedo times the density of the BSDF over that of the mixture."""
    bright, dim = Kept(0.8), Kept(0.1)
    assert np.array_equal(bright.known, dim.known)  # the same paths
    for kept, albedo in ((bright, 0.8), (dim, 0.1)):
        known, color = kept.known, np.where(kept.on_floor, albedo, 0.6)
        assert (kept.carried[known[:, 0], 0] == 1).all()
        throughput = np.cumprod(color * kept.bsdf, axis=1)[:, :-1]
        sure = known[:, 1:] & (throughput > 0.02)  # mixtures have 16 bits
        assert sure.sum() > 500 and np.allclose(kept.carried[:, 1:][sure], throughput[sure], rtol=0.01)
        # of the sky, which a path is sure to see last, the surface reflects as much as if it were the first
        last = known & ~np.pad(kept.there, ((0, 0), (0, 1)))[:, 1:] & (kept.nearness == 0)
        assert np.array_equal(last.sum(axis=0) > 100, [True] * 3)
        assert np.allclose(kept.contributions[last], (color * kept.bsdf)[last], rtol=0.01, atol=1e-4)
    # beyond the floor nothing of it is left, unless the path comes back
    after = bright.known[:, 1:] & bright.on_floor[:, :1] & ~bright.on_floor[:, 1:].any(axis=1)[:, None]
    seen = after & (bright.contributions[:, 1:] > 0)
    assert seen.sum() > 300
    assert np.allclose(bright.contributions[:, 1:][after], dim.contributions[:, 1:][after], rtol=1e-4)
    first = bright.on_floor[:, 0] & (bright.contributions[:, 0] > 0) & ~bright.on_floor[:, 1:].any(axis=1)
    assert first.sum() > 300
    assert np.allclose(bright.contributions[first, 0], 8 * dim.contributions[first, 0], rtol=1e-4)


def test_roulette_does_not_change_what_is_expected_of_later_vertices():
    """Paths that survive carry more, and what they bring is over that; up to the second vertex all survive."""
    plain, kept = Kept(0.3), Kept(0.3, roulette_depth=2)
    assert np.array_equal(kept.there[:, 1], plain.there[:, 1])
    assert kept.there[:, 2].sum() < 0.9 * plain.there[:, 2].sum()
    both = plain.known[:, 2] & kept.known[:, 2]
    assert both.sum() > 100 and (kept.carried[both, 2] > 1.15 * plain.carried[both, 2]).mean() > 0.9
    assert np.allclose(kept.contributions[both, 2], plain.contributions[both, 2], rtol=1e-4)


def test_nearness_is_of_what_is_hit():
    """One over the distance to the next vertex, within the cells that positions are known by; 0 of the sky."""
    kept = Kept(0.5)
    distances = np.linalg.norm(np.diff(kept.positions, axis=1), axis=-1)
    follows = kept.known[:, :-1] & kept.there[:, 1:]
    assert follows.sum() > 1000
    cell = 5.1 / 1024 * np.sqrt(3)
    assert np.abs(1 / kept.nearness[:, :-1][follows] - distances[follows]).max() < cell
    ends = kept.known[:, :-1] & ~kept.there[:, 1:]
    assert ends.sum() > 1000 and not kept.nearness[:, :-1][ends].any()


def leaf_of(nodes, code):
    """The octree's leaf that holds a code, one level after another."""
    node, shift = 0, 27
    while True:
        octant, word = (code >> shift) & 7, int(nodes[node])
        if word >> octant & 1:
            return 8 * node + octant
        node, shift = (word >> 8) + (~word & ((1 << octant) - 1)).bit_count(), shift - 3


def test_spheres_stand_where_light_comes_from():
    """After a frame the sphere of a region is as large as the light's distances say, or as the cell demands."""
    scheduler, _ = sequence([0], court(0.5), pipeline(indirect=gi.GuidedPaths(max_depth=5, samples=1 << 20)))
    records, state = scheduler.state("octree").spare.records, scheduler.state("octree")
    contributions, nearness = (
        getattr(records, name).numpy().astype(np.float64) for name in ("contributions", "nearness")
    )
    lit = (records.codes.numpy() != 0xFFFFFFFF) & (contributions > 0)
    guides = scheduler.state("indirect").guides
    sums, anchors = guides.nearness.numpy().astype(np.float64), guides.anchors.numpy()
    cells = 1024 / state.octree.scale / 2.0 ** (state.levels.numpy().repeat(8) + 1)
    most = 0.5 / (cells * np.sqrt(3) / 2)  # no sample counts as nearer than two radii of its cell
    leaves = np.array([leaf_of(state.octree.nodes.numpy(), int(code)) for code in records.codes.numpy()[lit]])
    clamped = np.minimum(nearness[lit], most[leaves])
    for column, values in enumerate((contributions[lit], contributions[lit] * clamped)):
        assert np.allclose(sums[:, column], np.bincount(leaves, values, len(sums)), rtol=1e-4)
    used = sums[:, 0] > 0
    found = sums[used, 1] / sums[used, 0]
    assert np.allclose(anchors[used, 3], found, rtol=1e-5)
    assert (found < 0.9 * most[used]).sum() > 20 and used.sum() > 50
    assert (clamped < nearness[lit]).mean() > 0.02
    assert not anchors[~used, 3].any()
    # anchors are in the middle of cells
    places = (anchors[used, :3] - np.array(state.octree.low)) / cells[used, None]
    assert np.abs(places % 1 - 0.5).max() < 1e-3


def test_states_fit_only_their_own(tmp_path):
    scheduler, _ = sequence([0, 1])
    path = scheduler.save_state(tmp_path / "a.safetensors", "frames")
    for other, lineage in (
        (sequence([], scene=hall(moving=False))[0], "frames"),
        (sequence([], chosen=pipeline(spp=4))[0], "frames"),
        (sequence([], seed=6)[0], "frames"),
        (sequence([])[0], "other frames"),
    ):
        with pytest.raises(BakeError, match=r"scene|settings"):
            other.load_state(path, lineage)
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(BakeError, match="truncated"):
        sequence([])[0].load_state(path, "frames")


def test_a_changed_resolution_and_a_cut_camera():
    """What is learnt is of the scene, not of the picture: other records, the same knowledge, and no bias."""
    scene = hall()
    scheduler = gi.FrameScheduler(scene, gi.CameraPath.still(view()), pipeline(), st.device().alias, 3)
    for index in range(3):
        scheduler.frame(index)
    slots = scheduler.state("octree").spare.records.codes.shape[0]
    known = scheduler.state("emitters").known.counts.numpy().sum()
    other = gi.Camera.look_at((1.7, 1.5, 1.8), (0.9, 0.3, -1.5), hfov=70, resolution=(40, 24))
    scheduler.camera = gi.CameraPath.still(other)
    cut = [scheduler.frame(index).numpy("emitters").mean() for index in range(3, 35)]
    assert scheduler.state("octree").spare.records.codes.shape[0] > slots
    assert scheduler.state("emitters").known.counts.numpy().sum() > 0 < known
    plain = gi.FrameScheduler(scene, gi.CameraPath.still(other), pipeline(**PLAIN, spp=64), st.device().alias, 4)
    truth = [plain.frame(index).numpy("emitters").mean() for index in range(32)]
    means, variances = zip(*(st.mean_and_variance(np.asarray(x)[:, None]) for x in (cut, truth)), strict=True)
    assert st.z_test(means[0], variances[0], means[1], variances[1], 1e-4, 31, 31).passed


def test_another_sky_keeps_what_was_learnt():
    scene = hall()
    scheduler, _ = sequence(range(3), scene)
    trees = scheduler.state("indirect").guides.trees
    scene.environment = gi.Environment(pixels=np.full((16, 32, 3), 0.5, np.float32))
    scheduler.bake()
    assert scheduler.state("indirect").guides.trees is trees
    scene.animate("ball", [gi.Keyframe(0.0), gi.Keyframe(1.0, (0.5, 0, 0))])
    scheduler.bake()
    assert scheduler.state("indirect").guides.trees.shape == (8,)


def test_records_stay_within_their_bound():
    chosen = pipeline(octree=gi.SampleOctree(split=192, collapse=96, most_samples=1024))
    scheduler, _ = sequence(range(2), chosen=chosen)
    assert 0 < scheduler.state("octree").spare.records.codes.shape[0] <= 1024 + 4
    assert scheduler.state("octree").counts.numpy()[:8].sum() > 100


def test_caches_and_quadtrees_have_less_noise():
    """The point of it all: where most lamps are hidden, and where light comes from few directions."""
    scene = hall(sky=False)
    learnt = [frames["beauty"] for frames in sequence(range(24), scene)[1][8:]]
    plain = [frames["beauty"] for frames in sequence(range(16), scene, pipeline(**PLAIN))[1]]
    assert np.var(learnt, axis=0).mean() < 0.5 * np.var(plain, axis=0).mean()


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: gi.VisibilityLightCache(capacity=0), "capacity must be a whole number from 1 to 32, got 0"),
        (lambda: gi.VisibilityLightCache(exploration=0.0), "exploration must be above 0"),
        (lambda: gi.VisibilityLightCache(explores_by="tabel"), "did you mean 'table'"),
        (lambda: gi.VisibilityLightCache(explores_by="table", energy=0.0, distance=0.0), "above 0"),
        (lambda: gi.GuidedPaths(bits=128.0), "bits must be a whole number"),
        (lambda: gi.Pipeline(octree=None), "octree must be a SampleOctree"),
        (lambda: gi.GuidedPaths(bits=48), "bits must be one of 32, 64, 96, 128, got 48"),
        (lambda: gi.GuidedPaths(bsdf_share=0.0), "bsdf_share"),
        (lambda: gi.GuidedPaths(fading=1.0), "fading"),
        (lambda: gi.GuidedPaths(max_depth=1), "max_depth"),
        (lambda: gi.SampleOctree(split=10, collapse=20), "collapse must be at most octree.split"),
    ],
)
def test_settings_are_checked(make, words):
    with pytest.raises(OptionError, match=words):
        make()
