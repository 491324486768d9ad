"""Thin glass: straight through by chance, what it reflects and lets through adds up, and windows let the sky in."""

from dataclasses import replace

import numpy as np
import pytest
import statistics_tools as st
from scene_tools import quad
from statistics_tools import every_device  # noqa: F401
from test_truth_blend import box, pane
from truth_tools import ALBEDO, ground, scene_of, spot_camera

import warp_gi as gi

SKY = np.array([2.0, 3.0, 4.0])
PATH = gi.Pipeline(spp=16, camera_samples=16)


def glass(color=(1.0, 1.0, 1.0), transmission=1.0, **fields):
    return gi.Material("glass", color, transmission=transmission, roughness=0.0, **fields)


def schlick(cosine, f0=0.04, f90=1.0):
    return f0 + (f90 - f0) * (1.0 - cosine) ** 5


def seen_through(angle, material, spp=PATH, count=24):
    """Pictures of the sky through a pane, from an angle [degrees] to its normal."""
    eye = 3.0 * np.array([np.sin(np.radians(angle)), 0.0, np.cos(np.radians(angle))])
    camera = gi.Camera.look_at(eye + np.array([0, 0.013, 0]), (0, 0.013, 0), hfov=0.2, resolution=(8, 8))
    return st.renderings(scene_of(pane(0.0, material, 30.0), environment=tuple(SKY)), camera, spp, count)


@pytest.mark.parametrize("angle", [0.0, 45.0, 80.0, 87.0])
def test_clear_glass_is_a_white_furnace(angle):
    st.assert_mean(seen_through(angle, glass()), SKY, tolerance=2e-3)


@pytest.mark.parametrize("angle", [0.0, 60.0, 84.0])
def test_tinted_glass_lets_its_share_through_and_reflects_as_fresnel_says(angle):
    """Grey of 0.5, 0.8 of it glass, over a matt surface of the same grey, all under one sky."""
    fresnel = schlick(np.cos(np.radians(angle)))
    expected = SKY * (fresnel + (1 - fresnel) * 0.8 * 0.5)
    images = seen_through(angle, glass((0.5, 0.5, 0.5), 0.8), count=40)
    matt = replace(glass((0.5, 0.5, 0.5), 0.0), specular=0.0)
    share = (seen_through(angle, matt, count=4) / SKY).mean()  # 0.5
    diffuse = SKY * 0.2 * share * (1 - schlick(1.0))
    st.assert_mean(images, expected + diffuse, tolerance=0.03 if angle > 70 else 0.01)


@pytest.mark.parametrize("angle", [0.0, 70.0, 85.0])
def test_the_sun_through_a_pane_loses_what_the_angle_reflects(angle):
    way = -np.array([np.sin(np.radians(angle)), np.cos(np.radians(angle)), 0.0])
    sun = gi.PunctualLight("directional", (3.0, 2.0, 1.0), direction=tuple(way))
    above = quad((-40, 1, 3), (80, 0, 0), (0, 0, -6), glass((0.6, 0.6, 0.6), 0.9), "pane")
    camera = gi.Camera.look_at((0.02, 0.5, 0.03), (0, 0, 0), up=(0, 0, 1), hfov=0.1, resolution=(4, 4))
    pipeline = gi.Pipeline(spp=1, camera_samples=1, environment=None)
    images = st.renderings(scene_of(ground(size=0.5), above, lights=[sun]), camera, pipeline, 300, "emitters")
    through = 0.9 * 0.6 * (1 - schlick(np.cos(np.radians(angle))))
    light = np.array([3.0, 2.0, 1.0]) * np.cos(np.radians(angle))
    st.assert_mean(images, ALBEDO / np.pi * light * through, tolerance=1e-3)


def test_a_closed_box_with_a_window_is_lit_by_the_sky():
    """A black box with one side of glass above a small ground: form factors with Fresnel's loss, in float64."""
    black = gi.Material("black", (0.0, 0.0, 0.0), specular=0.0)
    sides = box(black)
    window = [replace(one, material=glass((0.8, 0.8, 0.8))) if one.name == "side 1 1.0" else one for one in sides]
    assert sum(one.material.name == "glass" for one in window) == 1
    n = 400
    at = (np.arange(n) + 0.5) / n * 2.0 - 1.0
    x, z = np.meshgrid(at, at)
    cosine = 1.0 / np.sqrt(1.0 + x * x + z * z)
    form = (cosine**4 / np.pi * 0.8 * (1.0 - schlick(cosine))).sum() * (2.0 / n) ** 2
    view = gi.Camera.look_at((0.1, 0.4, 0.05), (0.0, 0.0, 0.0), up=(0, 0, 1), hfov=0.1, resolution=(4, 4))
    scene = scene_of(ground(size=0.02), *window, environment=tuple(SKY))
    st.assert_mean(st.renderings(scene, view, PATH, 80, "environment"), ALBEDO * SKY * form, tolerance=2e-3)


def test_textures_of_transmission_and_tint():
    """Left half clear, right half opaque; a base colour texture dims by its luminance."""
    share = gi.Texture("t", np.uint8([[[255, 0, 0, 255], [0, 0, 0, 255]]]), False, ("clamp", "clamp"), nearest=True)
    tint = gi.Texture("c", np.uint8([[[128, 128, 128, 255]]]), srgb=False)
    card = quad((-1, -1, 0), (2, 0, 0), (0, 2, 0), glass(transmission_texture=share, specular=0.0), "card")
    scene = scene_of(card, environment=tuple(SKY))
    rays = np.float32([[-0.5, 0.1, 1.0]] * 100 + [[0.5, 0.1, 1.0]] * 100) + np.linspace(0, 0.01, 200)[:, None]
    face = scene.bvh("cpu").intersect(np.float32(rays), np.float32([[0, 0, -1]] * 200)).face.numpy()
    assert (face[:100] == -1).all() and (face[100:] >= 0).all()
    tinted = replace(card, material=glass(transmission_texture=share, base_color_texture=tint, specular=0.0))
    rays = np.random.default_rng(3).uniform([-0.9, -0.9, 1], [-0.1, 0.9, 1.001], (20000, 3)).astype(np.float32)
    bvh = scene_of(tinted).bvh("cpu")
    stopped = (bvh.intersect(rays, np.float32([[0, 0, -1]] * 20000)).face.numpy() >= 0).mean()
    assert abs(stopped - (1 - 128 / 255)) < 0.015


@pytest.mark.parametrize("how", ["second set", "transform", "both"])
def test_textures_of_transmission_have_coordinates_of_their_own(how):
    """Left half clear, right half opaque; the second set or a transform mirrors them. A veil beside keeps its own."""
    mirror = ((-1.0, 0.0, 1.0), (0.0, 1.0, 0.0))
    pixels = np.uint8([[[255, 0, 0, 255], [0, 0, 0, 255]]])
    fields = {"uv_set": int(how != "transform"), "transform": None if how == "second set" else mirror}
    share = gi.Texture("t", pixels, False, ("clamp", "clamp"), nearest=True, **fields)
    normal = gi.Texture("n", np.uint8([[[128, 128, 255, 255]]]), srgb=False)
    material = glass(transmission_texture=share, normal_texture=normal, specular=0.0)
    card = quad((-1, -1, 0), (2, 0, 0), (0, 2, 0), material, "card")
    card.further_uvs = card.uvs * np.float32([-1, 1]) + np.float32([1, 0])
    holes = gi.Texture("h", np.uint8([[[0, 0, 0, 255], [0, 0, 0, 0]]]), False, ("clamp", "clamp"), nearest=True)
    veiled = gi.Material("veil", alpha_blend=True, base_color_texture=holes)
    beside = quad((2, -1, 0), (2, 0, 0), (0, 2, 0), veiled, "beside")
    scene = scene_of(card, beside, environment=tuple(SKY))
    x = np.repeat([-0.5, 0.5, 2.5, 3.5], 50)
    rays = np.stack([x, np.full(200, 0.1), np.ones(200)], axis=1) + np.linspace(0, 0.01, 200)[:, None]
    face = scene.bvh("cpu").intersect(np.float32(rays), np.float32([[0, 0, -1]] * 200)).face.numpy()
    left_is_clear = how == "both"
    assert ((face >= 0).reshape(4, 50) == np.array([[not left_is_clear], [left_is_clear], [True], [False]])).all()
    moved = replace(card, further_uvs=card.further_uvs * np.float32(0.5))
    other = scene_of(moved, beside, environment=tuple(SKY))
    assert (other.geometry_hash != scene.geometry_hash) == (how != "transform")


RED = (0.9, 0.3, 0.1)


def colored(z, size=30.0, **fields):
    return pane(z, glass(RED, **{"specular": 0.0} | fields), size)


@pytest.mark.parametrize("count", [1, 2])
def test_the_sky_through_coloured_panes_has_their_tints(count):
    """Without a reflection, whatever the angle; it is emission of the pixels, and has no noise of its own."""
    camera = gi.Camera.look_at((0.3, 0.2, 3), (0, 0.013, 0), hfov=5, resolution=(8, 8))
    scene = scene_of(*(colored(0.2 * k) for k in range(count)), environment=tuple(SKY))
    images = st.renderings(scene, camera, PATH, 24)
    st.assert_mean(images, SKY * np.power(RED, count), tolerance=2e-3)


def test_a_coloured_pane_that_is_half_there_tints_half():
    """Alpha of 0.4: the rest of the light passes beside the glass, white."""
    camera = gi.Camera.look_at((0, 0.013, 3), (0, 0.013, 0), hfov=5, resolution=(8, 8))
    scene = scene_of(colored(0.0, alpha=0.4, alpha_blend=True), environment=tuple(SKY))
    st.assert_mean(st.renderings(scene, camera, PATH, 40), SKY * (0.6 + 0.4 * np.array(RED)), tolerance=4e-3)


@pytest.mark.parametrize("kind", ["sun", "lamp", "sky"])
def test_light_through_a_coloured_pane_has_its_tint(kind):
    """On the ground below it: by a light without size, by an emitter, and by the sky; seen from below the pane."""
    above = quad((-40, 1, 40), (80, 0, 0), (0, 0, -80), glass(RED, specular=0.0), "pane")
    camera = gi.Camera.look_at((0.02, 0.5, 0.03), (0, 0, 0), up=(0, 0, 1), hfov=0.1, resolution=(4, 4))
    lamp = quad((-0.2, 2, 0.2), (0.4, 0, 0), (0, 0, -0.4), gi.Material("lamp", (0, 0, 0), emission=(9, 9, 9)), "lamp")
    lights = [gi.PunctualLight("directional", (3.0, 3.0, 3.0), direction=(0, -1, 0))] if kind == "sun" else []
    nodes = [ground(size=0.5), *([lamp] if kind == "lamp" else [])]
    sky = 1.0 if kind == "sky" else None
    pipeline = gi.Pipeline(spp=64, camera_samples=64, indirect=None)
    without, through = (
        st.renderings(scene_of(*nodes, *more, lights=lights, environment=sky), camera, pipeline, 60)
        for more in ([], [above])
    )
    st.assert_mean(through, without.mean(axis=(0, 1, 2)) * np.array(RED), tolerance=0.02)


def test_a_coloured_pane_takes_its_tint_along():
    """It moves before the camera, and its tree with it."""
    keys = [gi.Keyframe(0.0), gi.Keyframe(1 / 24, translation=(20.0, 0.0, 0.0))]
    node = gi.Node("pane", [colored(0.0, 4.0)], keyframes=keys)
    camera = gi.Camera.look_at((0, 0.013, 3), (0, 0.013, 0), hfov=5, resolution=(8, 8))
    path = gi.CameraPath.still(camera)
    frames = gi.render(gi.Scene([node], environment=1.0), path, PATH, frames=[0, 1, 0])
    means = [frame.numpy("emission").mean(axis=(0, 1)) for frame in frames]
    np.testing.assert_allclose(means, [RED, (1, 1, 1), RED], rtol=2e-3)


def test_metal_by_a_texture_alone_is_no_metal_where_that_is_black():
    """glTF's factor is 1 unless a file says otherwise; glass often leaves that to its texture."""
    texture = gi.Texture("mr", np.uint8([[[0, 0, 0, 255]]]), srgb=False)
    material = glass(metallic=1.0, metallic_roughness_texture=texture)
    assert material.is_glass and not glass(metallic=1.0).is_glass
    st.assert_mean(seen_through(45.0, material), SKY, tolerance=2e-3)


def test_guides_show_what_is_behind_a_window():
    red = gi.Material("red", (0.8, 0.0, 0.0), specular=0.0)
    scene = scene_of(pane(0.0, glass()), pane(-1.0, red), environment=(1, 1, 1))
    frame = next(gi.render(scene, spot_camera((0.013, 0.007, 1.0), 4), gi.Pipeline(spp=1), device=str(st.device())))
    assert np.allclose(frame.numpy("albedo"), 0.04 * np.ones(3) + 0.96 * np.array([0.8, 0, 0]), atol=2e-3)
    assert (frame.numpy("object_id") == 0).all() and np.allclose(frame.numpy("depth"), 3.0, atol=1e-2)
    assert scene.geometry_hash != scene_of(pane(0.0, glass((0.5, 0.5, 0.5))), pane(-1.0, red)).geometry_hash
