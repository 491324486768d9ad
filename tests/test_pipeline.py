"""Pipeline, scheduler and frame: settings, buffers, motion, determinism."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from scene_tools import card, sphere

import warp_gi as gi
import warp_gi.frame
import warp_gi.launch
import warp_gi.scheduler
from warp_gi.errors import OptionError
from warp_gi.frame import timed
from warp_gi.kernels.sampling import random_1d
from warp_gi.launch import get_device, set_threads
from warp_gi.scheduler import FrameScheduler

SIZE = (24, 16)


def lit_scene(**settings):
    """A grey card before a wall, under a sky and an emissive card."""
    lamp = gi.Material("lamp", emission=(3.0, 2.0, 1.0))
    aside = np.eye(4)
    aside[:3, 3] = (1.5, 0.8, -1.0)
    nodes = [
        gi.Node("glow", [card(half=0.2, material=lamp)], aside),
        gi.Node("wall", [card(-2.0, 5.0)]),
        gi.Node("card", [card()]),
        gi.Node("lamp", [card(4.0, 0.5, lamp)]),
    ]
    return gi.Scene(nodes, environment=(0.3, 0.4, 0.5), **settings)


def camera(**settings):
    return gi.Camera.look_at((0, 0, 3.5), (0, 0, 0), hfov=60, resolution=SIZE, **settings)


def one_frame(scene=None, view=None, pipeline=None, **settings):
    return next(gi.render(scene or lit_scene(), view or camera(), pipeline or gi.Pipeline(spp=4), **settings))


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: gi.Pipeline(spp=0), "spp"),
        (lambda: gi.Pipeline(spp=1.5), "spp must be a whole number"),
        (lambda: gi.Pipeline(spp=1 << 40), "spp must be at most"),
        (lambda: gi.Pipeline(spp=4, camera_samples=5), "camera_samples"),
        (lambda: gi.Pipeline(filter="gauss"), "pixel filter"),
        (lambda: gi.Pipeline(indirect=gi.PowerLights()), "indirect"),
        (lambda: gi.Pipeline(environment=3), "environment"),
        (lambda: gi.Pipeline.preset("pth"), "did you mean 'path'"),
        (lambda: gi.Pipeline.preset("path", ssp=3), "did you mean 'spp'"),
        (lambda: gi.BsdfPaths(max_depth=1), "max_depth"),
        (lambda: gi.BsdfPaths(roulette_depth=0), "roulette_depth"),
        (lambda: gi.BsdfPaths(clamp=-1.0), "clamp"),
        (lambda: list(gi.render(lit_scene(), camera(), device="cuda:77")), "not available"),
        (lambda: list(gi.render(lit_scene(), camera(), frames=[-1])), "frame numbers"),
        (lambda: list(gi.render(lit_scene(), camera(), seed=-1)), "seed"),
        (lambda: list(gi.render(lit_scene(), camera(), seed=1.5)), "seed must be a whole number"),
        (lambda: list(gi.render(lit_scene(), camera(), "path")), "pipeline must be a Pipeline, got 'path'"),
        (lambda: list(gi.render(lit_scene(), None)), "camera must be a Camera or CameraPath"),
        (lambda: list(gi.render("atrium", camera())), "scene must be a Scene"),
        (lambda: one_frame()["beuty"], "did you mean 'beauty'"),
    ],
)
def test_bad_settings_are_one_line(make, words):
    with pytest.raises(OptionError, match=words) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_terms_add_up_to_beauty_exactly():
    frame = one_frame(pipeline=gi.Pipeline(spp=8))
    terms = [frame.numpy(name) for name in ("emission", "environment", "emitters", "indirect")]
    assert all(term.max() > 0 for term in terms)
    assert np.array_equal(((terms[0] + terms[1]) + terms[2]) + terms[3], frame.numpy("beauty"))


@pytest.mark.parametrize("left_out", ["environment", "emitters", "indirect"])
def test_a_term_left_out_is_black_and_changes_no_other(left_out):
    """Up to the light of other terms that share a path: only the noise may differ, and here not even that."""
    terms = {"emitters": gi.PowerLights()}  # by which paths pick lights if nobody says how
    whole = one_frame(pipeline=gi.Pipeline(spp=4, **terms))
    part = one_frame(pipeline=gi.Pipeline(spp=4, **(terms | {left_out: None})))
    for term in ("environment", "emitters", "indirect"):
        if term == left_out:
            assert not part.numpy(term).any() and whole.numpy(term).any()
        else:
            assert np.array_equal(part.numpy(term), whole.numpy(term))


def test_threads_do_not_change_a_bit_and_seeds_do():
    frames = []
    for threads in (1, 2, 5):
        set_threads(threads)
        frames.append(one_frame(seed=4))
    set_threads(None)
    for name in frames[0].names:
        for other in frames[1:]:
            assert np.array_equal(frames[0].numpy(name), other.numpy(name), equal_nan=True)
    assert not np.array_equal(one_frame(seed=5).numpy("beauty"), frames[0].numpy("beauty"))


def test_frames_of_a_sequence_differ_in_noise_but_not_in_what_comes_before():
    path = gi.CameraPath.still(camera())
    frames = {f.index: f.numpy("beauty") for f in gi.render(lit_scene(), path, gi.Pipeline(spp=4), frames=[0, 1, 2])}
    alone = next(gi.render(lit_scene(), path, gi.Pipeline(spp=4), frames=[2]))
    assert not np.array_equal(frames[0], frames[1])
    assert np.array_equal(alone.numpy("beauty"), frames[2])
    kept = [f.index for f in gi.render(lit_scene(), path, gi.Pipeline(spp=1), frames=[0, 1, 2], skip={1})]
    assert kept == [0, 2]


def test_surface_buffers_at_pixel_centres():
    scene, view = lit_scene(), camera()
    frame = one_frame(scene, view, gi.Pipeline(spp=1, camera_samples=1))
    names = [scene.object_names[i] for i in frame.numpy("object_id").ravel() if i >= 0]
    assert {"wall", "card"} <= set(names)
    middle = (SIZE[1] // 2, SIZE[0] // 2)
    assert names and scene.object_names[frame.numpy("object_id")[middle]] == "card"
    assert frame.numpy("depth")[middle] == pytest.approx(3.5, rel=1e-5)
    assert np.allclose(frame.numpy("normal")[middle], (0, 0, 1))
    assert np.allclose(frame.numpy("albedo")[middle], (0.5, 0.25, 0.125))
    positions = frame.numpy("position").reshape(-1, 3)
    hit = frame.numpy("object_id").ravel() >= 0
    pixels = view.project(positions[hit])
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    assert np.abs(pixels - np.stack([x.ravel(), y.ravel()], 1)[hit]).max() < 1e-3
    depth = frame.numpy("depth").ravel()
    assert np.allclose(depth[hit], 3.5 - positions[hit][:, 2], rtol=1e-5) and np.isinf(depth[~hit]).all()


def test_motion_of_a_moving_camera_points_to_the_last_frame():
    keys = (gi.CameraKey(0.0, (0, 0, 3.5), (0, 0, 0)), gi.CameraKey(1.0, (1, 0.5, 3.5), (0.5, 0, 0)))
    path = gi.CameraPath(keys, fps=2, resolution=SIZE)
    frame = next(gi.render(lit_scene(), path, gi.Pipeline(spp=1, camera_samples=1), frames=[1]))
    hit = frame.numpy("object_id").ravel() >= 0
    positions = frame.numpy("position").reshape(-1, 3)[hit]
    expected = path.camera(0).project(positions) - path.camera(1).project(positions)
    assert np.abs(expected).max() > 1
    assert np.abs(frame.numpy("motion").reshape(-1, 2)[hit] - expected).max() < 1e-3


def test_motion_of_a_moving_object_and_rest_around_it():
    scene = lit_scene()
    scene.animate("card", [gi.Keyframe(0.0), gi.Keyframe(1.0, translation=(0.5, 0.0, 0.0))])
    path = gi.CameraPath.still(camera())
    frame = next(gi.render(scene, path, gi.Pipeline(spp=1, camera_samples=1), frames=[12]))
    ids, motion = frame.numpy("object_id"), frame.numpy("motion")
    card = ids == scene.object_names.index("card")
    pixels_a_metre = SIZE[0] / 2 / np.tan(np.radians(30)) / 3.5
    assert np.abs(motion[card] - [-0.5 / 24 * pixels_a_metre, 0]).max() < 1e-3
    assert np.abs(motion[~card]).max() < 1e-3


def test_motion_of_the_sky_follows_the_turn_of_the_camera():
    """A card far away and small: everything else is sky."""
    keys = (gi.CameraKey(0.0, (0, 0, 9), (0, 0, 0)), gi.CameraKey(1.0, (0, 0, 9), (-1, 0, 0)))
    path = gi.CameraPath(keys, fps=1, resolution=SIZE)
    scene = gi.Scene([gi.Node("card", [card(half=0.1)])], environment=(1.0, 1.0, 1.0))
    frame = next(gi.render(scene, path, gi.Pipeline(spp=1, camera_samples=1), frames=[1]))
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    now = path.camera(1)
    half = np.tan(np.radians(now.hfov) / 2)
    local = np.stack(
        [(2 * x / SIZE[0] - 1) * half, (1 - 2 * y / SIZE[1]) * half * SIZE[1] / SIZE[0], -np.ones_like(x)], axis=-1
    )
    far = local @ now.world_from_camera[:3, :3].T * 1e9 + now.position
    expected = path.camera(0).project(far.reshape(-1, 3)).reshape(SIZE[1], SIZE[0], 2) - np.stack([x, y], -1)
    sky = frame.numpy("object_id") < 0
    assert np.abs(frame.numpy("motion") - expected)[sky].max() < 1e-3


def test_camera_samples_share_out_every_sample_and_filters_blur():
    for spp, views in ((5, 2), (7, 7), (6, 4)):
        frame = one_frame(pipeline=gi.Pipeline(spp=spp, camera_samples=views))
        reference = one_frame(pipeline=gi.Pipeline(spp=256))
        ratio = frame.numpy("environment").mean() / reference.numpy("environment").mean()
        assert ratio == pytest.approx(1.0, abs=0.1)
    edges = [one_frame(pipeline=gi.Pipeline(spp=64, camera_samples=64, filter=name)) for name in ("box", "tent")]
    partial = [int(((f.numpy("albedo") % 0.125) > 1e-3).any(-1).sum()) for f in edges]
    assert partial[1] >= partial[0]


def test_clamp_bounds_each_path():
    scene, pipeline = lit_scene(), gi.Pipeline(spp=4, indirect=gi.BsdfPaths(clamp=0.01))
    assert one_frame(scene, pipeline=pipeline).numpy("indirect").max() <= 0.01 * (1 + 1e-6)
    assert one_frame(scene).numpy("indirect").max() > 0.01


def test_metadata_and_timings_tell_how_it_was_made():
    frame = one_frame(seed=9)
    assert frame.metadata["seed"] == 9
    assert frame.metadata["pipeline.indirect"] == "BsdfPaths"
    assert frame.metadata["pipeline.indirect.max_depth"] == 64
    assert len(frame.metadata["scene_hash"]) == 64
    assert {"bake", "compile", "scene", "primary", "paths", "compose"} <= set(frame.timings)
    assert all(seconds >= 0 for seconds in frame.timings.values())


@pytest.mark.parametrize("preset", ["clean", "reuse", "dvf"])
def test_stages_add_up_and_leave_no_launch_out(monkeypatch, preset):
    """By a clock that ticks at each launch alone: no launch is in two stages, or in none."""
    ticks, run = [0], wp.launch

    def launch_and_tick(*arguments, **settings):
        ticks[0] += 1
        return run(*arguments, **settings)

    scheduler = FrameScheduler(lit_scene(), gi.CameraPath.still(camera()), gi.Pipeline.preset(preset, spp=1))
    set_threads(1)
    try:
        scheduler.frame(0)
        monkeypatch.setattr(wp, "launch", launch_and_tick)
        for module in (warp_gi.scheduler, warp_gi.frame, warp_gi.launch):
            clock = SimpleNamespace(perf_counter=lambda: ticks[0], thread_time=lambda: 0)
            monkeypatch.setattr(module, "time", clock)
        for index in (1, 2):
            before = ticks[0]
            timings = scheduler.frame(index).timings
            del timings["bake"]
            assert sum(timings.values()) == ticks[0] - before > 5
            assert timings["scheduler"] == 0 and timings["compile"] == 0
    finally:
        set_threads(None)


def test_a_stage_within_another_counts_once(monkeypatch):
    now, timings = [0.0], {}
    monkeypatch.setattr(warp_gi.frame, "time", SimpleNamespace(perf_counter=lambda: now[0]))
    device = get_device("cpu")
    with timed(timings, "outer", device):
        now[0] += 1
        with timed(timings, "inner", device):
            now[0] += 3
            monkeypatch.setattr(warp_gi.launch, "compile_seconds", warp_gi.launch.compile_seconds + 2)
        now[0] += 4
    assert timings == pytest.approx({"outer": 5, "inner": 1, "compile": 2})


def test_a_scene_without_light_is_black():
    scene = gi.Scene([gi.Node("wall", [card()])])
    assert not one_frame(scene).numpy("beauty").any()


def test_variance_predicts_the_spread_over_seeds():
    """Of the mean of independent-sample estimates; stratification makes it an upper bound, within reason."""
    nodes = [node for node in lit_scene().nodes if node.name != "glow"]  # its edges are what stratifies best
    scene = gi.Scene(nodes, environment=(0.3, 0.4, 0.5))
    images = [one_frame(scene, seed=s, pipeline=gi.Pipeline(spp=8, camera_samples=8)) for s in range(24)]
    measured = np.var([f.numpy("beauty") for f in images], axis=0, ddof=1).mean()
    predicted = np.mean([f.numpy("variance") for f in images])
    assert 0.3 * predicted < measured < 1.3 * predicted


# Thread: a pixel. Adds samples that are 0 or 1, half of them each.
@wp.kernel(enable_backward=False)
def toss_coins(
    first: wp.int32,
    samples: wp.int32,
    seed: wp.uint32,
    term: wp.array(dtype=wp.vec3),
    moment1: wp.array(dtype=wp.vec3),
    moment2: wp.array(dtype=wp.vec3),
):
    pixel = first + wp.tid()
    for sample in range(samples):
        if random_1d(wp.uint32(pixel), seed, sample) < 0.5:
            one = wp.vec3(1.0, 1.0, 1.0)
            term[pixel] = term[pixel] + one
            moment1[pixel] = moment1[pixel] + one
            moment2[pixel] = moment2[pixel] + one


def trace_coins(estimator, frame, state):
    """Add samples by a launch of their own, as techniques do that are not path traced with the rest."""
    settings = frame.pass_settings
    seed = wp.uint32((frame.seed + settings.camera_sample) & 0xFFFFFFFF)
    inputs = [settings.sample_count, seed, frame[estimator.term], *frame.moments(estimator.term)]
    frame.launch(toss_coins, inputs)


@pytest.mark.parametrize("estimator", [gi.TracedEnvironment(), gi.PowerLights(), gi.BsdfPaths()], ids=lambda e: e.term)
def test_moments_of_every_term_reach_the_variance(estimator, monkeypatch):
    """Coins scatter as the binomial distribution says; path tracing of another term adds its own variance."""
    monkeypatch.setattr(type(estimator), "trace", trace_coins)
    nothing = gi.Pipeline(environment=None, emitters=None, indirect=None, spp=8)
    coins = replace(nothing, **{estimator.term: estimator})
    nodes = [node for node in lit_scene().nodes if node.name != "glow"]  # nothing that emits is in sight
    scene = gi.Scene(nodes, environment=(6.0, 8.0, 10.0))
    frames = list(gi.render(scene, gi.CameraPath.still(camera()), coins, frames=range(48)))
    scatter = np.var([frame.numpy("beauty") for frame in frames], axis=0, ddof=1).mean()
    claimed = np.mean([frame.numpy("variance") for frame in frames])
    assert scatter == pytest.approx(0.25 / 8, rel=0.05) and claimed == pytest.approx(scatter, rel=0.05)
    if estimator.term != "environment":
        sky, both = (
            one_frame(scene, pipeline=replace(one, environment=gi.TracedEnvironment())).numpy("variance").mean()
            for one in (nothing, coins)
        )
        assert both == pytest.approx(sky + 0.25 / 8, rel=0.05) and sky > 0.01


def test_moments_of_an_unknown_term_are_an_error():
    with pytest.raises(OptionError, match="unknown term 'emitter'; did you mean 'emitters'"):
        one_frame().moments("emitter")


def test_a_lamp_that_moved_lights_like_one_that_stands_there():
    """Its triangles, the box around emitters and the tree follow; nothing remembers where it was."""

    def scene(lamp):
        glow = gi.Material("lamp", emission=(3.0, 2.0, 1.0))
        return gi.Scene([gi.Node("wall", [card(-2.0, 5.0)]), gi.Node("card", [card()]), lamp(card(3.0, 0.5, glow))])

    there = np.eye(4)
    there[:3, 3] = (1.0, 2.0, 0.5)
    still = scene(lambda mesh: gi.Node("lamp", [mesh], there))
    moved = scene(lambda mesh: gi.Node("lamp", [mesh]))
    moved.animate("lamp", [gi.Keyframe(0.0), gi.Keyframe(1.0, translation=(1.0, 2.0, 0.5))])
    path = gi.CameraPath.still(camera())
    for pipeline in (gi.Pipeline(spp=4), gi.Pipeline(spp=4, indirect=None)):  # alone, a path's last rays use the box
        at_rest, at_end = gi.render(moved, path, pipeline, frames=[0, 24])
        expected = next(gi.render(still, path, pipeline, frames=[24]))
        assert np.allclose(at_end.numpy("beauty"), expected.numpy("beauty"), rtol=1e-4, atol=1e-6)
        assert not np.allclose(at_rest.numpy("beauty"), expected.numpy("beauty"), rtol=0.1)


def test_a_scheduler_notices_what_is_replaced_in_its_scene():
    scene, pipeline = lit_scene(), gi.Pipeline(spp=4)
    scheduler = gi.FrameScheduler(scene, gi.CameraPath.still(camera()), pipeline)
    hashes = [scheduler.frame(0).metadata["scene_hash"]]
    scene.environment = (1.0, 0.0, 0.0)
    scene.animate("lamp", [gi.Keyframe(0.0, translation=(0.0, 0.5, 0.0))])
    frame, fresh = scheduler.frame(0), one_frame(scene, pipeline=pipeline)
    hashes.append(frame.metadata["scene_hash"])
    assert hashes[0] != hashes[1] == fresh.metadata["scene_hash"]
    assert np.array_equal(frame.numpy("beauty"), fresh.numpy("beauty"))


def test_normals_that_point_to_the_back_of_their_triangles_are_turned():
    mesh = sphere((0, 0, 0), 1.0, gi.Material(roughness=0.4), rows=8)
    turned = replace(mesh, normals=-mesh.normals)
    images = [
        one_frame(gi.Scene([gi.Node("ball", [m])], environment=(1, 1, 1))).numpy("beauty") for m in (mesh, turned)
    ]
    assert images[0][SIZE[1] // 2, SIZE[0] // 2].min() > 0.5
    assert np.array_equal(*images)


def test_variance_of_an_edge_counts_the_sky_beside_it():
    """A black card before a white sky: a pixel's samples are 0 or 1, so its variance follows from its mean."""
    black = gi.Material("black", (0.0, 0.0, 0.0), specular=0.0)
    scene = gi.Scene([gi.Node("card", [card(material=black)])], environment=(1.0, 1.0, 1.0))
    frame = one_frame(scene, pipeline=gi.Pipeline(spp=16, camera_samples=16))
    mean = frame.numpy("beauty").astype(np.float64)
    assert ((mean > 0.1) & (mean < 0.9)).any()
    assert np.allclose(frame.numpy("variance"), mean * (1.0 - mean) / 15.0, atol=1e-6)


def test_qualities_of_a_preset():
    """Presets that say nothing of them take a quarter of their samples, or four times as many."""
    clean = {quality: gi.Pipeline.preset("clean", quality=quality) for quality in ("draft", "normal", "high")}
    assert clean["normal"] == gi.Pipeline.preset("clean")
    samples = [(one.spp, one.denoise.edge_samples, one.denoise.first_samples) for one in clean.values()]
    assert samples == sorted(samples) and len(set(samples)) == 3
    assert [gi.Pipeline.preset("path", quality=quality).spp for quality in clean] == [4, 16, 64]
    assert gi.Pipeline.preset("path", quality="high", spp=2).spp == 2
    with pytest.raises(OptionError, match=r"unknown quality 'best' \(known: draft, high, normal\)"):
        gi.Pipeline.preset("clean", quality="best")
