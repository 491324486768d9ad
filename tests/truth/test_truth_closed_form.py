"""Renderings whose answer is known by formula: furnaces, blocked skies, area and punctual lights, their sums."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import statistics_tools as st
from scene_tools import light, loss_by_depth, quad, sphere
from statistics_tools import every_device  # noqa: F401
from truth_tools import (
    ALBEDO,
    GROUND,
    MATERIALS,
    albedo,
    camera_in_box,
    closed_box,
    ground,
    lit_by,
    material_of,
    scene_of,
    spot_camera,
    unit,
)

import warp_gi as gi

WHITE_MAP = np.ones((8, 16, 3), dtype=np.float32)
SKIES = {"constant": (1.0, 1.0, 1.0), "map": gi.Environment(pixels=WHITE_MAP)}


def path(spp: int = 64, max_depth: int = 2, **settings: object) -> gi.Pipeline:
    indirect = gi.BsdfPaths(max_depth=max_depth) if max_depth > 2 else None
    return gi.Pipeline.preset("path", spp=spp, indirect=indirect, **settings)


@pytest.mark.parametrize("sky", SKIES)
@pytest.mark.parametrize("name", MATERIALS)
def test_white_furnace_shows_the_directional_albedo(name, sky):
    """Under a sky of radiance 1 a plane shows its albedo towards the camera; a white Lambert one vanishes."""
    scene = scene_of(ground(material_of(name)), environment=SKIES[sky])
    for view in ((0.1, 1.0, 0.0), (0.9, 0.35, 0.2)):
        direction = unit(view)
        local = np.array([np.hypot(direction[0], direction[2]), 0.0, direction[1]])
        images = st.renderings(scene, spot_camera(view), path(), 12)
        st.assert_mean(images, albedo(name, local), tolerance=2e-3)


def test_white_lambert_is_invisible_in_a_white_furnace():
    material = gi.Material("white", (1.0, 1.0, 1.0), specular=0.0)
    scene = scene_of(sphere((0, 0, 0), 0.5, material), environment=(1.0, 1.0, 1.0))
    camera = gi.Camera.look_at((0, 0.5, 2), (0, 0, 0), hfov=50, resolution=(32, 32))
    image = st.renderings(scene, camera, path(4, max_depth=4), 1)[0]
    assert np.abs(image - 1.0).max() < 1e-5
    flat = replace(sphere((0, 0, 0), 0.5, material), normals=None)
    image = st.renderings(scene_of(flat, environment=(1.0, 1.0, 1.0)), camera, path(4, max_depth=4), 1)[0]
    assert np.abs(image - 1.0).max() < 1e-5


def test_glowing_box_sums_its_bounces():
    """In a closed box that emits 1 and reflects half everywhere, paths of up to n edges carry 2 - 2^(1 - n)."""
    for depth in (2, 3, 4, 10):
        images = st.renderings(scene_of(*closed_box(0.5, 1.0)), camera_in_box(), path(16, depth), 12)
        st.assert_mean(images, 2.0 - 2.0 ** (1 - depth))


@pytest.mark.parametrize("paths", [gi.BsdfPaths(), gi.GuidedPaths()], ids=["bsdf", "guided"])
@pytest.mark.parametrize("white", [0.8, 0.9])
def test_the_default_depth_loses_next_to_nothing_in_a_white_box(paths, white):
    assert loss_by_depth(scene_of(*closed_box(white, 1.0)), camera_in_box(), paths) < 0.005


@pytest.mark.parametrize("sky", SKIES)
def test_all_is_one_radiance_in_equilibrium(sky):
    """A sky of radiance 1 and surfaces that reflect half and emit half: every picture is 1, whatever is in it."""
    glow = gi.Material("glow", (0.5, 0.5, 0.5), specular=0.0, emission=(0.5, 0.5, 0.5))
    walls = [
        quad((-2, 0, -1), (4, 0, 0), (0, 1.5, 0), glow, "back wall"),
        quad((-1, 0, -1), (0, 0, 2), (0, 1, 0), glow, "side wall"),
        replace(
            sphere((0.3, 0.5, 0), 0.4, glow, rows=6), normals=None
        ),  # smooth ones lose 0.1 % where cells are this large
    ]
    scene = scene_of(ground(glow), *walls, environment=SKIES[sky])
    camera = gi.Camera.look_at((0.5, 0.8, 2.5), (0, 0.5, 0), hfov=50, resolution=(24, 16))
    images = st.renderings(scene, camera, path(64, max_depth=18), 12)
    st.assert_mean(images, 1.0, tolerance=1e-4)


@pytest.mark.parametrize("sampler", [gi.PowerLights(), gi.UniformLights()])
def test_lamps_shine_on_the_sides_that_emit(sampler):
    lamp = quad((-0.5, 1.0, -0.75), (1.0, 0, 0), (0, 0, 1.5), light((3.0, 2.0, 1.0)), "lamp")  # its front is down
    upward = quad((-0.5, 1.0, 0.75), (1.0, 0, 0), (0, 0, -1.5), light((3.0, 2.0, 1.0)), "lamp")
    camera = spot_camera((0.9, 0.3, 0.2))
    assert (st.renderings(scene_of(ground(), upward), camera, path(emitters=sampler), 1) == 0).all()
    plate = quad((-1, 0.97, 1), (2, 0, 0), (0, 0, -2), gi.Material("plate", (0, 0, 0), specular=0.0), "plate")
    assert (st.renderings(scene_of(ground(), lamp, plate), camera, path(emitters=sampler), 1) == 0).all()
    both = gi.Material("lamp", (0, 0, 0), specular=0.0, emission=(3.0, 2.0, 1.0), double_sided=True)
    scene = scene_of(ground(), replace(upward, material=both))
    expected = lit_by([lamp], "lambert", (0.9, 0.3, 0.2))
    st.assert_mean(st.renderings(scene, camera, path(emitters=sampler), 12), expected, tolerance=1e-3)


def test_punctual_lights():
    """Inverse squares, cones and suns; without size, so every sample gives the same number."""
    down = (0.0, -1.0, 0.0)
    cases = [
        (gi.PunctualLight("point", (3.0, 2.0, 1.0), position=(0, 2, 0)), 1 / 4),
        (gi.PunctualLight("point", (3.0, 2.0, 1.0), position=(1, 1, 0)), np.sqrt(0.5) / 2),
        (gi.PunctualLight("point", (3.0, 2.0, 1.0), position=(0, 1, 0), range=2.0), 1 - 1 / 16),
        (gi.PunctualLight("directional", (3.0, 2.0, 1.0), direction=(0, -1, 1)), np.sqrt(0.5)),
        (gi.PunctualLight("spot", (3.0, 2.0, 1.0), position=(0, 1, 0), direction=down), 1.0),
        (gi.PunctualLight("spot", (3.0, 2.0, 1.0), position=(0, 1, 0), direction=(0, 1, 0)), 0.0),
        (  # the origin is 0.3 rad off the axis, between the cones
            gi.PunctualLight(
                "spot", (3.0, 2.0, 1.0), (0, 1, 0), (np.sin(0.3), -np.cos(0.3), 0), inner_cone=0.1, outer_cone=0.6
            ),
            ((np.cos(0.3) - np.cos(0.6)) / (np.cos(0.1) - np.cos(0.6))) ** 2,
        ),
    ]
    for punctual, strength in cases:
        image = st.renderings(scene_of(ground(), lights=(punctual,)), spot_camera(), path(4), 1)[0]
        expected = ALBEDO / np.pi * [3.0, 2.0, 1.0] * strength
        assert np.allclose(image, expected, rtol=1e-2), f"{punctual}: {image[0, 0]}, expected {expected}"


def test_bounced_light_of_sky_and_punctual_lights_adds_up():
    """After the first bounce a vertex samples the sky or a light: each must make up for the turns of the other."""
    wall = quad((-2, 0, -1), (4, 0, 0), (0, 2, 0), GROUND, "wall")
    sky = gi.Environment(pixels=np.random.default_rng(4).random((8, 16, 3)).astype(np.float32) ** 4)
    lights = tuple(gi.PunctualLight("point", (1.5, 1.0, 0.5), position=(x, 1.0, 0.5)) for x in (-0.7, 0.9))
    camera = gi.Camera.look_at((0, 1, 3), (0, 0.5, 0), hfov=50, resolution=(12, 8))

    def indirect(seed: int, **settings: object) -> np.ndarray:
        scene = scene_of(ground(), wall, **settings)
        return st.renderings(scene, camera, path(64, 4), 8, "indirect", seed=seed)

    parts = [st.mean_and_variance(images) for images in (indirect(1, environment=sky), indirect(2, lights=lights))]
    total = np.sum(parts, axis=0)
    together = indirect(3, environment=sky, lights=lights)
    st.compare_images("sky_and_lights", together, *total, alpha=1e-4, reference_dof=7)


def small_scene() -> tuple[gi.Scene, gi.Camera]:
    """Every term at work: sky map, lamp, glossy and Lambert surfaces."""
    lamp = quad((-0.5, 1.5, -0.5), (1.0, 0, 0), (0, 0, 1.0), light((4.0, 3.0, 2.0)), "lamp")
    ball = sphere((0.2, 0.5, 0), 0.4, gi.Material("ball", (0.9, 0.6, 0.2), metallic=1.0, roughness=0.3), rows=12)
    wall = quad((-2, 0, -1), (4, 0, 0), (0, 2, 0), gi.Material("wall", (0.2, 0.4, 0.8), roughness=0.5), "wall")
    sky = gi.Environment(pixels=np.random.default_rng(3).random((16, 32, 3)).astype(np.float32) ** 4)
    camera = gi.Camera.look_at((0, 1, 3), (0, 0.6, 0), hfov=50, resolution=(45, 30))
    return scene_of(ground(), lamp, ball, wall, environment=sky), camera


def test_terms_add_up_to_beauty_and_each_stands_alone():
    scene, camera = small_scene()
    frame = next(iter(gi.render(scene, camera, path(8, 4), seed=5, device=str(st.device()))))
    terms = [frame.numpy(name) for name in ("emission", "environment", "emitters", "indirect")]
    assert all(term.max() > 0 for term in terms)
    assert np.array_equal(frame.numpy("beauty"), ((terms[0] + terms[1]) + terms[2]) + terms[3])
    names = ("environment", "emitters", "indirect")
    for kept in names:  # left alone, a term has the same expectation
        alone = replace(path(32, 4), **{name: None for name in names if name != kept})
        images = st.renderings(scene, camera, alone, 8, kept)
        together = st.renderings(scene, camera, path(32, 4), 8, kept, seed=2)
        st.compare_images(f"alone_{kept}", images, *st.mean_and_variance(together), alpha=1e-4, reference_dof=7)


def test_threads_seeds_and_repetition():
    scene, camera = small_scene()

    def image(seed: int, threads: int) -> np.ndarray:
        gi.set_threads(threads)
        try:
            return st.renderings(scene, camera, path(4, 4), 1, seed=seed)[0]
        finally:
            gi.set_threads(None)

    one = image(1, 1)
    assert np.array_equal(one, image(1, 2)) and np.array_equal(one, image(1, 3))
    other = image(2, 2)
    assert (one != other).any(axis=-1).mean() > 0.9
    assert abs(one.mean() / other.mean() - 1) < 0.1


def test_frames_of_a_sequence_are_independent():
    """The noise of frame i and frame j is uncorrelated, as is that of neighbouring seeds."""
    scene, camera = small_scene()
    frames = st.renderings(scene, camera, path(4), 12, seed=3)
    seeds = np.stack([st.renderings(scene, camera, path(4), 1, seed=s)[0] for s in range(12)])
    for images in (frames, seeds):
        noise = (images - images.mean(axis=0)).reshape(12, -1)
        correlation = np.corrcoef(noise)[np.triu_indices(12, 1)]
        assert abs(correlation.mean() + 1 / 11) < 0.01  # -1/11 comes from subtracting the mean of 12


def test_samples_and_filter_keep_the_mean():
    """Camera samples, sample counts that are no powers of two, and roulette change the noise alone."""
    scene, camera = small_scene()
    reference = st.mean_and_variance(st.renderings(scene, camera, path(64, 5), 8, seed=9))
    for name, pipeline in {
        "one_a_sample": path(24, 5, camera_samples=24),
        "three_views": path(20, 5, camera_samples=3),
        "no_roulette": path(24, 5, camera_samples=4).__class__.preset(
            "path", spp=24, indirect=gi.BsdfPaths(max_depth=5, roulette_depth=99)
        ),
    }.items():
        images = st.renderings(scene, camera, pipeline, 12, seed=4)
        st.compare_images(f"mean_{name}", images, *reference, alpha=1e-4, reference_dof=7)


def test_variance_buffer_bounds_the_scatter_of_independent_frames():
    scene, camera = small_scene()
    pipeline = path(16, 4, camera_samples=16)
    images = st.renderings(scene, camera, pipeline, 24)
    claimed = st.renderings(scene, camera, pipeline, 4, "variance").mean()
    scatter = images.var(axis=0, ddof=1).mean()
    assert 0.8 * scatter < claimed < 6.0 * scatter  # samples are stratified, the buffer takes them for independent
