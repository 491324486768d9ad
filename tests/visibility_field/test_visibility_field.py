"""The visibility field as an estimator: every mode against the path tracer, what moves, what turns, what is kept."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import statistics_tools as st
from scene_tools import quad, sphere
from statistics_tools import every_device  # noqa: F401

import warp_gi as gi
from warp_gi.errors import BakeError, OptionError
from warp_gi.launch import set_threads
from warp_gi.scene import harmonics

SIZE = (32, 24)
SMALL = {"cell_size": 0.25, "resolution": 24, "samples": 4000, "rays": 128}


def courtyard(environment=(1.0, 0.8, 0.6), glossy=False, **settings):
    """A floor, a wall, a canopy and a ball: open, half-open and enclosed places."""
    grey = gi.Material("grey", (0.7, 0.6, 0.5), specular=0.0)
    ball = gi.Material("ball", (0.9, 0.7, 0.4), metallic=1.0, roughness=0.35) if glossy else grey
    rests = [
        quad((-2, 0, 2), (4, 0, 0), (0, 0, -4), grey),
        quad((-2, 0, -2), (4, 0, 0), (0, 2, 0), grey),
        quad((-2, 1.5, -2), (2.5, 0, 0), (0, 0, 2), grey),
    ]
    nodes = [gi.Node("yard", rests), gi.Node("ball", [sphere((0.6, 0.5, 0.2), 0.5, ball, rows=12)])]
    return gi.Scene(nodes, environment=environment, **settings)


def view():
    return gi.Camera.look_at((1.5, 2.2, 4.0), (-0.2, 0.5, 0), hfov=55, resolution=SIZE)


def sky_map(rotation=0.0):
    """A dim gradient with a bright patch: an all-frequency sky."""
    pixels = np.full((32, 64, 3), 0.2, np.float32)
    pixels[:16] += np.linspace(0.8, 0.1, 16)[:, None, None].astype(np.float32)
    pixels[6:9, 20:24] = (30.0, 26.0, 20.0)
    return gi.Environment(pixels=pixels, rotation=rotation)


def smooth_sky(rotation=0.0):
    """A map that nine harmonics hold, positive everywhere."""
    coefficients = np.zeros((3, 9))
    coefficients[:, 0] = np.array([1.0, 0.8, 0.6]) * np.sqrt(4 * np.pi)
    coefficients[:, 1:] = 0.15 * np.random.default_rng(3).normal(size=(3, 8))
    theta = np.arange(128) * np.pi / 127
    phi = (np.arange(256) + 0.5) * 2 * np.pi / 256
    ring, up = np.sin(theta)[:, None], np.cos(theta)[:, None] + 0 * phi
    directions = np.stack([ring * np.sin(phi), up, -ring * np.cos(phi)], axis=-1)
    pixels = harmonics.basis(directions) @ coefficients.T
    assert pixels.min() > 0
    return gi.Environment(pixels=pixels.astype(np.float32), rotation=rotation)


def pipeline(environment, spp=32, **settings):
    return gi.Pipeline(environment=environment, emitters=None, indirect=None, spp=spp, **settings)


def pictures(scene, environment, count=12, spp=32, seed=1):
    return st.renderings(scene, view(), pipeline(environment, spp), count, "environment", seed)


def reference(scene, count=24, spp=64):
    mean, variance = st.mean_and_variance(pictures(scene, gi.TracedEnvironment(), count, spp, seed=99))
    return mean, variance, count - 1


def same_picture(name, scene, environment, count=12, systematic=0.0):
    mean, variance, dof = reference(scene)
    images = pictures(scene, environment, count)
    ratio = 24 * 64 / (count * 32)
    st.compare_images(name, images, mean, variance, 1e-4, dof, ratio, systematic)


SKIES = {"constant": (1.0, 0.8, 0.6), "map": sky_map(40.0), "smooth": smooth_sky(25.0)}


@pytest.mark.parametrize("glossy", [False, True], ids=["lambert", "glossy"])
@pytest.mark.parametrize("sky", SKIES)
def test_every_ray_traced_is_the_path_tracer(sky, glossy):
    same_picture(f"field_traced_{sky}_{glossy}", courtyard(SKIES[sky], glossy), gi.VisibilityField(mode="traced"))


@pytest.mark.parametrize("glossy", [False, True], ids=["lambert", "glossy"])
@pytest.mark.parametrize("sky", SKIES)
def test_unbiased_with_a_bad_bake_is_the_path_tracer(sky, glossy):
    """A hundredth of the samples and a few rays: most of what such a field calls sure is wrong somewhere."""
    bad = gi.VisibilityField("unbiased", cell_size=0.6, resolution=16, samples=40, rays=64, dilation=0, verify=0.3)
    same_picture(f"field_unbiased_{sky}_{glossy}", courtyard(SKIES[sky], glossy), bad)


def test_the_bad_bake_is_bad():
    """What the last test corrects: the same field without correction is far off."""
    scene = courtyard()
    bad = gi.VisibilityField(cell_size=0.6, resolution=16, samples=40, rays=64, dilation=0)
    with pytest.raises(AssertionError, match="mean off"):
        same_picture("field_bad", scene, bad)


@pytest.mark.parametrize("sky", ["constant", "smooth"])
@pytest.mark.parametrize("mode", ["three_state", "paper", "unbiased"])
@pytest.mark.parametrize("glossy", [False, True], ids=["lambert", "glossy"])
def test_harmonic_skies_in_every_mode(sky, mode, glossy):
    """A good bake: what it misses is far below the noise; a harmonic sky is as exact as its map, to 1 in 1000."""
    field = gi.VisibilityField(mode, sky="harmonics", **SMALL)
    same_picture(f"field_{mode}_{sky}_{glossy}", courtyard(SKIES[sky], glossy), field, systematic=1e-3)


@pytest.mark.parametrize("glossy", [False, True], ids=["lambert", "glossy"])
@pytest.mark.parametrize("sky", ["constant", "map"])
def test_three_state_with_sky_maps(sky, glossy):
    field = gi.VisibilityField(**SMALL)
    same_picture(f"field_three_state_{sky}_{glossy}", courtyard(SKIES[sky], glossy), field, systematic=1e-3)


def one(scene, environment, frames=(0,), camera=None, spp=16, **settings):
    camera = camera or gi.CameraPath.still(view())
    found = gi.render(scene, camera, pipeline(environment, spp, **settings), frames=frames, device=st._device)
    return [frame.numpy("environment").copy() for frame in found]


def test_error_falls_with_samples():
    """Same rays with and without the field, so that what differs is what the bake missed."""
    scene = courtyard()
    (truth,) = one(scene, gi.VisibilityField(mode="traced"))
    errors = []
    for samples in (4000, 20_000, 200_000):
        (picture,) = one(scene, gi.VisibilityField(**(SMALL | {"samples": samples, "dilation": 0})))
        errors.append(np.sqrt(np.mean((picture - truth) ** 2)))
    assert errors[0] > 2 * errors[1] > 4 * errors[2] and errors[2] < 2e-3, errors


def test_labels_of_the_paper_trace_the_smaller_part_and_subtract():
    """On an open floor the label is 0: all light comes from the irradiance, and no ray is left to chance."""
    floor = gi.Scene([gi.Node("floor", [quad((-2, 0, 2), (4, 0, 0), (0, 0, -4), gi.Material(specular=0.0))])])
    floor.environment = (1.0, 1.0, 1.0)
    camera = gi.CameraPath.still(gi.Camera.look_at((0, 3, 0.1), (0, 0, 0), hfov=40, resolution=SIZE))
    (picture,) = one(floor, gi.VisibilityField("paper", sky="harmonics", **SMALL), camera=camera)
    assert np.abs(picture - 0.8).max() < 1e-5


def test_variance_is_what_repetitions_scatter():
    for sky in SKIES.values():
        for glossy in (False, True):
            scene, settings = courtyard(sky, glossy), pipeline(gi.VisibilityField(**SMALL), 32, camera_samples=1)
            frames = list(gi.render(scene, gi.CameraPath.still(view()), settings, frames=range(16)))
            claimed = np.mean([frame.numpy("variance") for frame in frames])
            scatter = np.mean(np.var([frame.numpy("environment") for frame in frames], axis=0, ddof=1))
            assert 0.1 * claimed < scatter < 1.2 * claimed  # stratified samples scatter less than independent ones


def test_threads_do_not_change_a_bit():
    scene, images = courtyard(sky_map()), []
    for threads in (1, 2, 5):
        set_threads(threads)
        images += one(scene, gi.VisibilityField(**SMALL))
    set_threads(None)
    assert np.array_equal(images[0], images[1]) and np.array_equal(images[0], images[2])


def test_samples_do_not_depend_on_how_camera_samples_share_them():
    """37 samples in three parts that are no multiples of eight: each counted once."""
    scene = courtyard()
    (parts,) = one(scene, gi.VisibilityField(mode="traced"), spp=37, camera_samples=3)
    open_sky = gi.Scene([gi.Node("card", [quad((-1, -1, 0), (2, 0, 0), (0, 2, 0), gi.Material(specular=0.0))])])
    open_sky.environment = (1.0, 1.0, 1.0)
    camera = gi.CameraPath.still(gi.Camera.look_at((0, 0, 2), (0, 0, 0), hfov=30, resolution=SIZE))
    (card,) = one(open_sky, gi.VisibilityField(mode="traced"), spp=37, camera_samples=3, camera=camera)
    assert np.abs(card - 0.8).max() < 1e-5
    assert parts.max() < 1.0


def test_an_environment_that_turns_needs_no_bake(monkeypatch):
    scene = courtyard(smooth_sky())
    path = gi.CameraPath.still(view())
    scheduler = gi.FrameScheduler(scene, path, pipeline(gi.VisibilityField(**SMALL)), st._device)
    scheduler.frame(0)
    cells = scheduler.state("environment").cells
    monkeypatch.setattr(gi.VisibilityField, "bake", lambda *a, **k: pytest.fail("baked again"))
    scene.environment = smooth_sky(90.0)
    turned = scheduler.frame(1).numpy("environment")
    assert scheduler.state("environment").cells is cells
    monkeypatch.undo()
    fresh = next(gi.render(scene, path, pipeline(gi.VisibilityField(**SMALL)), frames=[1], device=st._device))
    assert np.array_equal(turned, fresh.numpy("environment"))


def test_relighting_a_still_camera_traces_nothing_and_is_exact(monkeypatch):
    scene, path = courtyard(smooth_sky(), glossy=True), gi.CameraPath.still(view())
    field = gi.VisibilityField(sky="harmonics", relight=True, **SMALL)
    scheduler = gi.FrameScheduler(scene, path, pipeline(field, 16), st._device)
    first = scheduler.frame(0).numpy("environment").copy()
    again = scheduler.frame(1).numpy("environment").copy()
    assert np.abs(first - again).max() < 2e-5 and first.max() > 0.2
    from warp_gi.kernels import visibility_field_trace

    traced = []
    launch_tiled = gi.Frame.launch_tiled

    def watched(self, kernel, *arguments):
        traced.append(kernel)
        launch_tiled(self, kernel, *arguments)

    monkeypatch.setattr(gi.Frame, "launch_tiled", watched)
    scene.environment = smooth_sky(120.0)
    relit = scheduler.frame(2).numpy("environment").copy()
    assert visibility_field_trace.trace_field not in traced
    plain = gi.FrameScheduler(scene, path, pipeline(replace(field, relight=False), 16), st._device)
    assert np.abs(relit - plain.frame(0).numpy("environment")).max() < 2e-5  # frame 0: the same samples
    moved = gi.CameraPath.still(replace(view(), hfov=50.0))
    scheduler.camera = moved
    scheduler.frame(3)
    assert visibility_field_trace.trace_field in traced


def test_a_camera_that_leaves_the_baked_cells_bakes_on_within_its_budget():
    scene = courtyard()
    near = gi.Camera.look_at((1.5, 0.6, 1.5), (1.9, 0, 1.4), hfov=30, resolution=SIZE)
    field = gi.VisibilityField(**SMALL, budget=0.2)
    scheduler = gi.FrameScheduler(scene, near, pipeline(field), st._device)
    scheduler.frame(0)
    counts = [len(scheduler.state("environment").cells)]
    scheduler.camera = view()
    for index in range(1, 4):
        picture = scheduler.frame(index).numpy("environment").copy()
        counts.append(len(scheduler.state("environment").cells))
        (truth,) = one(scene, gi.VisibilityField(mode="traced"), frames=[index], spp=32)
        assert np.sqrt(np.mean((picture - truth) ** 2)) < 2e-3
    assert counts == sorted(set(counts)), counts
    wide = gi.FrameScheduler(scene, view(), pipeline(replace(field, lazy=False)), st._device)
    wide.bake()
    assert len(wide.state("environment").cells) > counts[-1]


def moving_scene():
    """A plate that comes to rest above the floor after a second."""
    scene = courtyard()
    grey = gi.Material("plate", (0.6, 0.6, 0.6), specular=0.0)
    node = gi.Node("plate", [quad((-0.5, 0, 0.5), (1, 0, 0), (0, 0, -1), grey)])
    moving = gi.Scene([*scene.nodes, node], environment=scene.environment)
    keys = [gi.Keyframe(0.0, (0.9, 1.6, 0.9)), gi.Keyframe(1.0, (-0.6, 0.7, 0.8))]
    moving.animate("plate", keys)
    return moving


@pytest.mark.parametrize("mode", ["three_state", "unbiased", "paper"])
def test_a_moving_object_is_never_wrong_and_is_baked_again_when_it_rests(mode):
    path = gi.CameraPath.from_cameras([view()], fps=4.0)
    sky = {"sky": "harmonics"} if mode == "paper" else {}
    field = gi.VisibilityField(mode, **(SMALL | {"samples": 40_000}), **sky, budget=50.0)
    scheduler = gi.FrameScheduler(moving_scene(), path, pipeline(field), st._device)
    other = gi.FrameScheduler(moving_scene(), path, pipeline(gi.VisibilityField("traced", **sky)), st._device)
    settled = []
    for index in range(9):
        picture, truth = scheduler.frame(index).numpy("environment"), other.frame(index).numpy("environment")
        settled.append(len(scheduler.state("environment").settled.known))
        if mode != "unbiased":
            assert np.sqrt(np.mean((picture - truth) ** 2)) < 2e-3, index
        else:
            assert abs(picture.mean() / truth.mean() - 1) < 0.01
    assert not any(settled[:5]) and settled[8] >= settled[6] > 0, settled


def test_a_bake_is_used_saved_and_refused(tmp_path):
    scene, field = courtyard(), gi.VisibilityField(**SMALL)
    bake = gi.bake(scene, field, st._device, camera_path=view())
    loaded = gi.load_bake(bake.save(tmp_path / "yard.dvf.safetensors"))
    scheduler = gi.FrameScheduler(scene, view(), pipeline(field), st._device, bakes=[loaded])
    assert np.array_equal(scheduler.frame(0).numpy("environment"), one(scene, field, spp=32)[0])
    assert scheduler.metadata()["bake.environment"] == loaded.digest[:16]  # a resumed run tells bakes apart
    moved = courtyard()
    moved.nodes[1].meshes[0].points += 0.1
    other = gi.Scene(moved.nodes, environment=(1.0, 1.0, 1.0))
    for wrong in (
        lambda: gi.FrameScheduler(other, view(), pipeline(field), bakes=[loaded]).bake(),
        lambda: gi.FrameScheduler(scene, view(), pipeline(replace(field, rays=64)), bakes=[loaded]).bake(),
        lambda: gi.FrameScheduler(scene, view(), pipeline(gi.TracedEnvironment()), bakes=[loaded]),
    ):
        with pytest.raises(BakeError) as caught:
            wrong()
        assert "\n" not in str(caught.value)
    with pytest.raises(OptionError, match="nothing to bake"):
        gi.bake(scene, gi.TracedEnvironment())


def test_a_field_grown_on_the_way_goes_on_bit_for_bit(tmp_path):
    """The state after two frames, saved and loaded, renders the third as an unbroken run does."""
    scene, field = courtyard(), gi.VisibilityField(**SMALL, budget=0.5)
    path = gi.CameraPath.still(view())
    bake = gi.bake(scene, field, st._device, camera_path=replace(view(), hfov=8.0))
    whole = gi.FrameScheduler(scene, path, pipeline(field), st._device, bakes=[bake])
    images = [whole.frame(index).numpy("environment").copy() for index in range(2)]
    saved = gi.load_bake(whole.state("environment").to_bake().save(tmp_path / "two"))
    images.append(whole.frame(2).numpy("environment").copy())
    resumed = gi.FrameScheduler(scene, path, pipeline(field), st._device, bakes=[saved])
    assert np.array_equal(resumed.frame(2).numpy("environment"), images[2])
    assert len(resumed.state("environment").cells) == len(whole.state("environment").cells)


def test_the_preset_and_other_terms_go_together():
    scene = courtyard()
    settings = gi.Pipeline.preset("dvf", spp=4)
    assert isinstance(settings.environment, gi.VisibilityField)
    settings = replace(settings, environment=gi.VisibilityField(**SMALL))
    frame = next(gi.render(scene, view(), settings, device=st._device))
    assert frame.numpy("environment").max() > 0 and frame.numpy("indirect").max() > 0
    total = frame.numpy("emission") + frame.numpy("environment") + frame.numpy("emitters") + frame.numpy("indirect")
    assert np.array_equal(total, frame.numpy("beauty"))


def test_a_black_sky_is_black():
    assert not one(courtyard(None), gi.VisibilityField(**SMALL))[0].any()
