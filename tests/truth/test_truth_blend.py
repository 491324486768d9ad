"""Blended surfaces: rays pass by chance with the probability 1 - alpha, and guides are means over layers."""

from dataclasses import replace
from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
import statistics_tools as st
from scene_tools import light, quad
from statistics_tools import every_device  # noqa: F401
from truth_tools import ALBEDO, LOW_VIEW, ground, lit_by, scene_of, spot_camera

import warp_gi as gi

CASES = Path(__file__).parent.parent / "cases" / "alpha-blend"
WALL = gi.Camera.look_at((0, 0, 3), (0, 0, 0), hfov=30, resolution=(32, 24))
SKY = np.array([2.0, 3.0, 4.0])
PATH = gi.Pipeline(spp=16, camera_samples=1)


def veil(alpha, color=(0.0, 0.0, 0.0), emission=(0.0, 0.0, 0.0)):
    return gi.Material(f"veil {alpha}", color, alpha=alpha, alpha_blend=True, specular=0.0, emission=emission)


def pane(z, material, half=5.0):
    return quad((-half, -half, z), (2 * half, 0, 0), (0, 2 * half, 0), material, f"pane {z}")


def box(material, half=1.0):
    """Six sides about the origin, which every ray from there passes once."""
    u, sides = 2 * half, []
    for axis in range(3):
        for side in (-half, half):
            corner, edges = np.full(3, -half), np.eye(3)[[axis - 1, axis - 2]] * u
            corner[axis] = side
            sides.append(quad(corner, *edges, material, f"side {axis} {side}"))
    return sides


@pytest.mark.parametrize("spp", [1, 4])
@pytest.mark.parametrize("alpha", [0.25, 0.49, 0.6, 0.9])
def test_guides_are_the_mean_over_layers(alpha, spp):
    scene = gi.load_scene(CASES / f"alpha{alpha * 100:.0f}.glb", environment=1.0)
    frame = next(gi.render(scene, WALL, gi.Pipeline(spp=spp), device=str(st.device())))
    expected = [alpha + (1 - alpha) * 0.8, alpha, alpha]
    np.testing.assert_allclose(frame.numpy("albedo"), np.broadcast_to(expected, (24, 32, 3)), atol=1e-3)
    np.testing.assert_allclose(frame.numpy("alpha"), 1.0, atol=1e-6)
    nearer = frame.numpy("depth") < 3.01  # the pane is before the wall
    assert (nearer == (alpha > 0.5)).all()
    assert ((frame.numpy("object_id") == 0) == (alpha > 0.5)).all()


def test_coverage_emission_and_depth_of_a_veil_before_the_sky():
    glow = np.array([4.0, 2.0, 1.0])
    scene = scene_of(pane(0.0, veil(0.3, emission=tuple(glow))), pane(-1.0, veil(0.5)), environment=tuple(SKY))
    frame = next(gi.render(scene, WALL, gi.Pipeline(spp=1), device=str(st.device())))
    assert np.allclose(frame.numpy("alpha"), 1 - 0.7 * 0.5, atol=1e-6)
    assert np.allclose(frame.numpy("emission"), 0.3 * glow + 0.35 * SKY, atol=1e-4)
    assert np.allclose(frame.numpy("normal"), [0, 0, 0.65], atol=1e-5)
    assert np.allclose(frame.numpy("depth"), 4.0, atol=1e-3)  # 0.35 is more than 0.3


@pytest.mark.parametrize("alphas", list(permutations((0.2, 0.5, 0.7))), ids=str)
def test_a_stack_lets_the_product_through_in_any_order(alphas):
    """Queries for closest hits draw each layer with the share that compositing gives it; any-hit queries agree."""
    from warp_gi.bvh import AlphaMasks, TriangleBvh

    meshes = [pane(-z, veil(alpha)) for z, alpha in enumerate(alphas)]
    tree = scene_of(*meshes).data(str(st.device())).bvh
    assert tree.chance == 1
    points = np.concatenate([mesh.points for mesh in meshes])
    indices = np.concatenate([mesh.indices + 4 * k for k, mesh in enumerate(meshes)])
    masks = AlphaMasks(
        np.repeat(np.arange(3, dtype=np.int32), 2),
        [(-1, alpha, None) for alpha in alphas],
        np.zeros((12, 2), np.float32),
        tree.textures,
        tree.texels,
    )
    rng, count = np.random.default_rng(3), 40_000
    origins = np.column_stack([rng.uniform(-1, 1, (count, 2)), np.full(count, 1.0)]).astype(np.float32)
    ways = np.column_stack([rng.normal(0, 0.2, (count, 2)), np.full(count, -1.0)]).astype(np.float32)
    own = TriangleBvh(points, indices, str(st.device()), masks)
    face = own.intersect(origins, ways).face.numpy()
    a, b, c = alphas
    expected = np.array([a, (1 - a) * b, (1 - a) * (1 - b) * c, (1 - a) * (1 - b) * (1 - c)])
    found = np.bincount(np.where(face < 0, 3, face // 2), minlength=4)
    assert st.chi_squared(found.astype(float), expected * count) > 1e-4
    assert np.array_equal(own.occluded(origins, ways).numpy() == 1, face >= 0)
    backwards = TriangleBvh(points, indices, str(st.device()), masks)
    again = backwards.intersect(origins, ways)
    assert np.array_equal(again.face.numpy(), face)


@pytest.mark.parametrize("kind", ["point", "directional"])
def test_the_shadow_of_a_veil_is_its_alpha_of_the_light(kind):
    """A still camera whose rays repeat from frame to frame: chance must not."""
    lamp = gi.PunctualLight(kind, (3.0, 2.0, 1.0), position=(0, 2, 0), direction=(0, -1, 0))
    above = quad((-3, 1, 3), (6, 0, 0), (0, 0, -6), veil(0.3), "veil")
    scene = scene_of(ground(size=0.5), above, lights=[lamp])
    images = st.renderings(scene, spot_camera(LOW_VIEW, 4), replace(PATH, spp=1, environment=None), 300, "emitters")
    irradiance = np.array([3.0, 2.0, 1.0]) / (4.0 if kind == "point" else 1.0)
    st.assert_mean(images, ALBEDO / np.pi * irradiance * 0.7, tolerance=1e-4)


@pytest.mark.parametrize("roughness", [None, 0.3])
def test_the_sky_through_boxes_of_veils(roughness):
    """Black veils around a ground: by light samples and by BSDF samples the sky is dimmed by (1 - a)(1 - b)."""
    floor = gi.Material("floor", tuple(ALBEDO), specular=0.0)
    if roughness is not None:
        floor = gi.Material("floor", (1.0, 0.8, 0.6), metallic=1.0, roughness=roughness)
    bare = scene_of(ground(floor, 0.02), environment=tuple(SKY))
    veiled = scene_of(ground(floor, 0.02), *box(veil(0.4)), *box(veil(0.25), 2.0), environment=tuple(SKY))
    view = spot_camera((0.3, 0.9, 0.2), 4)
    view = gi.Camera.look_at(np.array(view.world_from_camera[:3, 3]) * 0.3, (0, 0, 0), hfov=0.1, resolution=(4, 4))
    truth = next(gi.render(bare, view, gi.Pipeline(spp=4096, camera_samples=1), device=str(st.device())))
    images = st.renderings(veiled, view, PATH, 60, "environment")
    st.assert_mean(images, truth.numpy("environment").mean(axis=(0, 1)) * 0.6 * 0.75, tolerance=2e-3)


@pytest.mark.parametrize("name", ["lambert", "smooth_metal"])
def test_a_blended_lamp_shines_by_its_alpha(name):
    """By light samples, and where the lobe is narrow by BSDF samples."""
    from truth_tools import material_of

    shining = replace(light((30.0, 20.0, 10.0)), alpha=0.35, alpha_blend=True)
    lamp = quad((-0.5, 1.0, -0.3), (1.0, 0, 0), (0, 0, 0.7), shining, "lamp")
    images = st.renderings(
        scene_of(ground(material_of(name)), lamp), spot_camera(LOW_VIEW, 4), replace(PATH, spp=64), 40, "emitters"
    )
    st.assert_mean(images, 0.35 * lit_by([lamp], name, LOW_VIEW), tolerance=2e-3)


def test_triangles_without_holes_cost_nothing_and_empty_ones_are_not_there():
    texels = np.full((4, 4, 4), 255, np.uint8)
    texels[:, 2:, 3] = 0
    image = gi.Texture("half", texels, wrap=("clamp", "clamp"), nearest=True)
    material = gi.Material("decal", (1, 1, 1), specular=0.0, base_color_texture=image, alpha_blend=True)
    whole = replace(pane(0.0, material), uvs=np.float32([[0, 0], [0.1, 0], [0.1, 1], [0, 1]]))
    gone = replace(pane(1.0, material), uvs=np.float32([[0.9, 0], [1, 0], [1, 1], [0.9, 1]]))
    scene = scene_of(whole, gone, environment=(1, 1, 1))
    assert scene.data("cpu").bvh.face_masks.numpy().tolist() == [-1, -1, 0, 0]
    frame = next(gi.render(scene, WALL, gi.Pipeline(spp=8), device=str(st.device())))
    assert (frame.numpy("object_id") == 0).all() and np.allclose(frame.numpy("depth"), 3.0, atol=1e-4)
    assert np.allclose(frame.numpy("alpha"), 1.0)


def test_opaque_scenes_have_no_masks_and_two_readings_of_alpha_are_refused():
    assert scene_of(pane(0, veil(1.0))).data("cpu").bvh.face_masks is None
    with pytest.raises(gi.SceneError, match="two readings of alpha"):
        scene_of(pane(0, replace(veil(0.5), alpha_cutoff=0.5)))
    hashes = {scene_of(pane(0, one)).geometry_hash for one in (veil(0.5), veil(0.6), veil(1.0))}
    assert len(hashes) == 3


def test_threads_do_not_change_a_bit():
    scene = veiled_room()
    pictures = []
    try:
        for threads in (1, 2):
            gi.set_threads(threads)
            frame = next(gi.render(scene, ROOM_VIEW, gi.Pipeline(spp=8), seed=3))
            pictures.append([frame.numpy(name).copy() for name in ("beauty", "albedo", "depth")])
    finally:
        gi.set_threads(None)
    for one, two in zip(*pictures, strict=True):
        assert one.tobytes() == two.tobytes()


ROOM_VIEW = gi.Camera.look_at((0.0, 1.0, 2.6), (0.0, 0.6, 0.0), hfov=50, resolution=(24, 16))


def veiled_room():
    """A bright floor and a coloured wall behind a veil of another colour, with a lamp and a sky."""
    red = gi.Material("red", (0.8, 0.1, 0.1), specular=0.0)
    blue = gi.Material("blue", (0.2, 0.3, 0.9), alpha=0.5, alpha_blend=True, specular=0.0)
    floor = gi.Material("floor", (0.7, 0.7, 0.7), specular=0.0)
    return scene_of(
        quad((-4, 0, 4), (8, 0, 0), (0, 0, -8), floor, "floor"),
        quad((-4, 0, -2), (8, 0, 0), (0, 4, 0), red, "wall"),
        quad((-0.8, 0.0, 0.3), (1.6, 0, 0), (0, 1.3, 0.0), blue, "veil"),
        quad((-1.0, 2.5, -1.0), (2, 0, 0), (0, 0, 1), light((6.0, 5.0, 4.0)), "lamp"),
        environment=(0.5, 0.6, 0.8),
    )


def glazed_room(color=(0.9, 0.9, 0.9), through=0.9):
    """A room lit by the sky through a window of glass, grey or coloured, with a pane before its red wall."""
    red = gi.Material("red", (0.8, 0.1, 0.1), specular=0.0)
    clear = gi.Material("clear", color, roughness=0.2, transmission=through)
    floor = gi.Material("floor", (0.7, 0.7, 0.7), specular=0.0)
    return scene_of(
        quad((-4, 0, 4), (8, 0, 0), (0, 0, -8), floor, "floor"),
        quad((-4, 0, -2), (8, 0, 0), (0, 4, 0), red, "wall"),
        quad((-4, 3, -4), (8, 0, 0), (0, 0, 8), clear, "window"),
        quad((-0.8, 0.0, 0.3), (1.6, 0, 0), (0, 1.3, 0.0), clear, "pane"),
        environment=(0.5, 0.6, 0.8),
    )


@pytest.mark.parametrize("name", ["clean", "path"])
def test_denoisers_keep_the_mean(name):
    """A green veil in bright light before a dim red wall: light over one albedo is not light over the other."""
    green = gi.Material("green", (0.25, 1.0, 0.25), alpha=0.5, alpha_blend=True, specular=0.0)
    red = gi.Material("red", (1.0, 0.25, 0.25), specular=0.0)
    lamp = gi.PunctualLight("point", (8.0, 8.0, 8.0), position=(0.0, 0.3, 1.0))
    scene = scene_of(pane(0.0, green, 2.0), pane(-3.0, red, 4.0), lights=[lamp])
    view = gi.Camera.look_at((0.013, 0.007, 3.0), (0.013, 0.007, 0.0), hfov=20, resolution=(24, 16))
    pipeline = gi.Pipeline.preset(name, **({"spp": 2, "denoise": gi.SpatioTemporal()} if name == "path" else {}))
    truth = next(gi.render(scene, view, gi.Pipeline(spp=1024, camera_samples=512), device=str(st.device())))
    frames = list(gi.render(scene, gi.CameraPath.still(view), pipeline, frames=range(32), device=str(st.device())))
    got = np.mean([frame.numpy("beauty").mean(axis=(0, 1)) for frame in frames[4:]], axis=0)
    expected = truth.numpy("beauty").mean(axis=(0, 1))
    assert expected[1] > 2 * expected[0]
    np.testing.assert_allclose(got, expected, rtol=0.03)


VEIL = gi.Material("veil", (1, 1, 1), alpha=0.5, alpha_blend=True, specular=0.0)
SOLID = gi.Material("wall", (1, 1, 1), specular=0.0)
THIN = gi.Material("thin", (1, 1, 1), alpha=0.02, alpha_blend=True, specular=0.0)


@pytest.mark.parametrize(
    "nodes",
    [
        [pane(0.0, VEIL), pane(0.0, SOLID)],
        [pane(0.0, SOLID), pane(0.0, VEIL)],
        [pane(1e-5, VEIL), pane(0.0, SOLID)],
        [*(pane(0.01 * k, THIN) for k in range(1, 101)), pane(0.0, SOLID)],
    ],
    ids=["decal", "decal after", "decal close by", "a hundred layers"],
)
def test_no_sky_shines_through_a_wall_behind_layers(nodes):
    """Guides stop at the wall, however close or many the layers before it are: a white furnace all over."""
    camera = gi.Camera.look_at((0, 0.01, 3), (0, 0.01, 0), hfov=30, resolution=(16, 12))
    frame = next(gi.render(scene_of(*nodes, environment=1.0), camera, gi.Pipeline(spp=16, camera_samples=16)))
    for name in ("beauty", "albedo"):
        np.testing.assert_allclose(frame.numpy(name).mean(axis=(0, 1)), 1.0, rtol=2e-3)
    np.testing.assert_allclose(frame.numpy("alpha"), 1.0, rtol=1e-5)


def test_a_lamp_behind_a_decal_shines_through_it():
    black = gi.Material("black", (0, 0, 0), alpha=0.5, alpha_blend=True, specular=0.0)
    lamp = gi.Material("lamp", (0, 0, 0), emission=(2, 2, 2), specular=0.0)
    camera = gi.Camera.look_at((0, 0.01, 3), (0, 0.01, 0), hfov=30, resolution=(16, 12))
    frame = next(gi.render(scene_of(pane(0.0, black), pane(0.0, lamp)), camera, gi.Pipeline(spp=4)))
    np.testing.assert_allclose(frame.numpy("emission"), 1.0, rtol=1e-3)


def test_emission_of_layers_adds_nothing_to_the_variance():
    """It is their mean, whichever the rays drew; a lamp behind a veil has no noise, and the variance says so."""
    lamp = gi.Material("lamp", (0.0, 0.0, 0.0), specular=0.0, emission=(5.0, 2.0, 1.0))
    scene = scene_of(pane(0.0, veil(0.5, emission=(0.0, 1.0, 3.0))), pane(-1.0, lamp))
    frame = next(gi.render(scene, WALL, gi.Pipeline(spp=16, camera_samples=16), device=str(st.device())))
    np.testing.assert_allclose(frame.numpy("beauty"), np.broadcast_to([2.5, 1.5, 2.0], (24, 32, 3)), rtol=1e-5)
    assert frame.numpy("variance").max() < 1e-9
    sky = scene_of(pane(0.0, veil(0.5)), environment=tuple(SKY))
    frame = next(gi.render(sky, WALL, gi.Pipeline(spp=16, camera_samples=16), device=str(st.device())))
    assert frame.numpy("variance").max() < 1e-9
