"""Bounces: geometric series in a sphere, a wall with a known form factor, lamps, one fixed sky."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_tools import quad, sphere
from transfer_tools import face_atlas, transfer_settings

import warp_gi as gi
from warp_gi import launch
from warp_gi.errors import OptionError
from warp_gi.scene.harmonics import basis
from warp_gi.techniques.radiance_transfer import bounces as baking
from warp_gi.techniques.radiance_transfer.rays import trace_slots, transfer_work
from warp_gi.techniques.shared.atlas.build import make_atlas

WHITE = np.sqrt(4 * np.pi)  # the first coefficient of a sky of radiance 1; the others are 0
ALBEDO = np.array([0.9, 0.5, 0.2])


def lambert(color, **fields):
    return gi.Material("lambert", tuple(color), specular=0.0, **fields)


def bowl(albedo, opening=0.25, lights=(), **fields):
    """A hollow sphere of radius 2, open at the top, and the share of its surface that is missing.

    In a sphere each point sees every part of the surface by its area. So the share is that of the sky, too.
    """
    ball = replace(sphere((0, 0, 0), 2.0, lambert(albedo, **fields), rows=16), normals=None)
    corners = ball.points[ball.indices]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    is_kept = corners[..., 1].mean(axis=1) < 2.0 * (1 - 2 * opening)
    scene = gi.Scene([gi.Node("bowl", [replace(ball, indices=ball.indices[is_kept])])], lights)
    return scene, area[~is_kept].sum() / area.sum()


def baked(scene, atlas=None, **settings):
    atlas = face_atlas(scene) if atlas is None else atlas
    settings = transfer_settings(**settings)
    work = transfer_work(scene, atlas, settings, launch.get_device("cpu"), 0)
    traced = trace_slots(work)
    reflectance = baking.slot_reflectance(work)
    return work, traced, reflectance, baking.gather_bounces(work, traced, reflectance, settings)


def inside(scene, values):
    """The mean over slots of the back sides, which face inwards, float64."""
    return np.asarray(values, np.float64)[scene.triangle_count :].mean(axis=0)


def test_geometric_series_in_a_bowl():
    scene, opening = bowl(ALBEDO)
    _, traced, reflectance, bounces = baked(scene, bounces=32, tolerance=1e-4)
    assert np.abs(reflectance - ALBEDO).max() < 1e-6
    assert inside(scene, traced.transfer)[0] * WHITE == pytest.approx(np.pi * opening, rel=0.01)
    ratio = ALBEDO * (1 - opening)
    expected = np.pi * opening * ratio / (1 - ratio)
    found = inside(scene, bounces.transfer)[:, 0] * WHITE
    assert found == pytest.approx(expected, rel=0.02)
    assert not bounces.transfer[: scene.triangle_count].any()  # nothing reflects light to the outside
    assert bounces.transfer.shape == (2 * scene.triangle_count, 3, 25) and bounces.transfer.dtype == np.float16
    assert bounces.share < 1e-4 and 10 < bounces.count < 24
    _, _, _, fewer = baked(scene)
    assert 0.001 < fewer.share < 0.002 and fewer.count < bounces.count


@pytest.mark.parametrize("count", [1, 2, 3])
def test_number_of_bounces(count):
    scene, opening = bowl(ALBEDO)
    _, _, _, bounces = baked(scene, bounces=count, tolerance=0.0)
    ratio = ALBEDO * (1 - opening)
    expected = np.pi * opening * sum(ratio**k for k in range(1, count + 1))
    assert bounces.count == count
    assert inside(scene, bounces.transfer)[:, 0] * WHITE == pytest.approx(expected, rel=0.02)
    last = (np.pi * opening * ratio**count).sum() / (
        3 * np.pi * opening + expected.sum() + 3 * np.pi
    )  # the outside: pi
    assert bounces.share == pytest.approx(last, rel=0.05)


def test_white_furnace():
    """White walls in a white sky: irradiance is pi in the bowl, as outside of it."""
    scene, _ = bowl((1, 1, 1), opening=0.5)
    _, traced, _, bounces = baked(scene, tolerance=1e-4)
    total = (traced.transfer[:, None, 0].astype(float) + bounces.transfer[:, :, 0]) * WHITE
    assert total.mean() == pytest.approx(np.pi, rel=0.003)
    assert inside(scene, total) == pytest.approx(3 * [np.pi], rel=0.005)


def test_closed_room_has_no_light_of_the_sky():
    scene, opening = bowl(ALBEDO, opening=0.0)
    assert opening == 0
    _, traced, _, bounces = baked(scene)
    assert not inside(scene, traced.transfer).any() and not inside(scene, bounces.transfer).any()
    buried = replace(face_atlas(scene), slot_sides=np.ones(2 * scene.triangle_count, np.uint8))
    _, traced, _, bounces = baked(scene, buried)
    assert (bounces.count, bounces.share) == (0, 0.0) and not bounces.transfer.any()


def wall_beside_floor():
    """A floor, and a wall of 4 m that is as good as endless; the slot of face 0 lies 2.5 m from it."""
    far = 400.0
    floor = quad((far, 0, -far), (-far, 0, 0), (0, 0, 2 * far), lambert((0, 0, 0)))
    wall = quad((0, 0, -far), (0, 4, 0), (0, 0, 2 * far), lambert(ALBEDO))
    scene = gi.Scene([gi.Node("floor", [floor]), gi.Node("wall", [wall])])
    corners = floor.points[floor.indices[0]].astype(np.float64)
    matrix = np.stack([corners[1] - corners[0], corners[2] - corners[0]], axis=1)[[0, 2]]
    u, v = np.linalg.solve(matrix, np.array([2.5, -390.0]) - corners[0][[0, 2]])
    assert min(u, v, 1 - u - v) > 0
    return scene, face_atlas(scene, {0: (u, v)})


def wall_directions():
    """Directions [n, 3] in which the slot sees the wall, and their solid angles times cosine [n], by quadrature."""
    z, weights_z = np.polynomial.legendre.leggauss(1000)
    y, weights_y = np.polynomial.legendre.leggauss(60)
    y, z = (grid.reshape(-1) for grid in np.meshgrid(2 + 2 * y, 390 + 400 * z, indexing="ij"))
    square = 2.5**2 + y**2 + z**2
    directions = np.stack([-2.5 + 0 * y, y, z], axis=1) / np.sqrt(square)[:, None]
    return directions, np.outer(2 * weights_y, 400 * weights_z).reshape(-1) * y * 2.5 / square**2


def test_bounce_from_a_wall():
    """The wall sees half the sky and has half of pi; of that the floor gets by a known form factor."""
    scene, atlas = wall_beside_floor()
    _, _, _, bounces = baked(scene, atlas, bounces=1, bounce_rays=4096)
    factor = 0.5 * (1 - 2.5 / np.hypot(2.5, 4))
    assert wall_directions()[1].sum() / np.pi == pytest.approx(factor, rel=0.03)  # 10 m from the end of the wall
    assert bounces.transfer[0, :, 0] * WHITE == pytest.approx(ALBEDO * np.pi / 2 * factor, rel=0.04)
    seen = wall_directions()[1].sum() / np.pi
    assert bounces.transfer[0, :, 0] * WHITE == pytest.approx(ALBEDO * np.pi / 2 * seen, rel=0.01)


def test_one_sky_in_the_bake_is_any_sky_times_transfer():
    scene, _ = bowl(ALBEDO)
    work, traced, reflectance, bounces = baked(scene, tolerance=1e-4)
    light = np.random.default_rng(1).normal(size=(3, 25)) + 2 * np.eye(1, 25)
    fixed = baking.fixed_light_bounces(work, traced, reflectance, light, transfer_settings(tolerance=1e-4))
    assert np.abs(fixed.irradiance[0] - traced.transfer.astype(float) @ light.T).max() < 1e-3
    expected = np.einsum("scj,cj->sc", bounces.transfer.astype(float), light)
    deviation = np.sum(fixed.irradiance[1:], axis=0) - expected
    assert np.abs(deviation).max() < 5e-3 * np.abs(expected).max()
    # Degree 0 of the glossy texture is the irradiance by reflected light, one bounce further on.
    assert np.abs(fixed.glossy[:, :, 0] * WHITE - expected).max() < 5e-3 * np.abs(expected).max()
    with pytest.raises(OptionError, match="expected a light of 3 x 25 coefficients, got"):
        baking.fixed_light_bounces(work, traced, reflectance, light[:, :9], transfer_settings())


def test_glossy_light_of_a_wall():
    """I_k = int L cos y_k over the directions in which a wall of known radiance is seen."""
    scene, atlas = wall_beside_floor()
    work, traced, reflectance, _ = baked(scene, atlas, bounces=1, bounce_rays=4096)
    fixed = baking.fixed_light_bounces(
        work, traced, reflectance, np.full((3, 1), WHITE) * np.eye(1, 25), transfer_settings(bounces=1)
    )
    directions, weights = wall_directions()
    expected = (ALBEDO / 2)[:, None] * (weights @ basis(directions, 5))  # radiance: albedo / pi of pi / 2
    assert np.abs(expected[0]).max() > 0.1
    assert np.abs(fixed.glossy[0] - expected).max() < 4e-3


@pytest.mark.parametrize("kind", ["point", "surface"])
def test_lamps_in_a_closed_sphere(kind):
    """All of the sphere is lit alike, and so again by each bounce; what comes straight from lamps is left out."""
    if kind == "point":
        scene, _ = bowl(ALBEDO, 0.0, [gi.PunctualLight("point", (4.0, 2.0, 8.0))])
        direct = np.array([4.0, 2.0, 8.0]) / 2.0**2
    else:
        scene, _ = bowl(ALBEDO, 0.0, emission=(0.5, 1.0, 2.0))
        direct = np.pi * np.array([0.5, 1.0, 2.0])
    work, traced, reflectance, _ = baked(scene)
    found = baking.lamp_irradiance(work, scene, 0)
    assert inside(scene, found) == pytest.approx(direct, rel=0.03)
    gathered = baking.gather_light(work, traced, reflectance, found, 100, 1e-6)
    assert inside(scene, np.sum(gathered, axis=0)) == pytest.approx(direct * ALBEDO / (1 - ALBEDO), rel=0.03)
    assert len(baking.gather_light(work, traced, reflectance, found, 3, 1e-6)) == 3


def test_a_lamp_close_by_lights_no_slot_beyond_what_it_can():
    """A floor 1 mm below a lamp of radiance 1: samples of the lamp vary without bound, and so would all bounces."""
    floor = quad((0, 0, 0), (0, 0, 1), (1, 0, 0), lambert((0.5, 0.5, 0.5)))
    lamp = quad((0, 0.001, 0), (1, 0, 0), (0, 0, 1), lambert((0, 0, 0), emission=(1.0, 1.0, 1.0), double_sided=False))
    cover = quad((0, 5, 0), (1, 0, 0), (0, 0, 1))
    keys = [gi.Keyframe(0.0, (0.0, 0.0, 0.0)), gi.Keyframe(1.0, (0.0, 1.0, 0.0))]
    nodes = [gi.Node("floor", [floor]), gi.Node("lamp", [lamp])]
    for moves in (False, True):
        scene = gi.Scene([*([gi.Node("cover", [cover], keyframes=keys)] if moves else []), *nodes])
        atlas = make_atlas(scene, transfer_settings(resolution=64), "cpu")
        work = transfer_work(scene, atlas, transfer_settings(), launch.get_device("cpu"), 0)
        found = baking.lamp_irradiance(work, scene, 0)[:, 0]
        on_floor = (atlas.slot_faces < 2 + 2 * moves) & (atlas.slot_faces >= 2 * moves) & (atlas.slot_sides == 0)
        assert np.count_nonzero(on_floor) > 100
        assert np.median(found[on_floor]) == pytest.approx(np.pi, rel=0.02)
        assert found.max() < 1.2 * np.pi


def test_texture_of_a_surface_is_averaged_over_its_texel():
    """A chequered floor of 2 x 2 squares a texel reflects the mean everywhere."""
    pixels = np.zeros((2, 2, 4), np.uint8)
    pixels[..., 3] = 255
    pixels[0, 0, :3] = pixels[1, 1, :3] = 255
    texture = gi.Texture("chequers", pixels)
    floor = quad((0, 0, 0), (0, 0, 8), (8, 0, 0), lambert((1, 0.5, 0), base_color_texture=texture))
    floor = replace(floor, uvs=np.float32([[0, 0], [8, 0], [8, 8], [0, 8]]))
    scene = gi.Scene([gi.Node("floor", [floor])])
    # One page of 8 x 8 texels with a corner of the floor at each of its own, and slots at the texels of face 0.
    atlas = face_atlas(scene)
    corners = (floor.uvs[floor.indices]).astype(np.float32)
    atlas = replace(
        atlas,
        corners=corners,
        face_pages=np.zeros(2, np.int32),
        pages=np.int32([[0, 8, 8]]),
        slots=np.full((2, 64), -1, np.int32),
        corner_slots=np.zeros((0, 0, 3), np.int32),
        slot_points=np.float32([[0.3, 0.2], [0.21, 0.33], [0.4, 0.1], [0.1, 0.37]]),
    )
    work = transfer_work(scene, atlas, transfer_settings(), launch.get_device("cpu"), 0)
    assert baking.slot_reflectance(work) == pytest.approx(np.tile([0.5, 0.25, 0], (4, 1)), abs=0.02)


@pytest.mark.parametrize("threads", [2, 5])
def test_threads_change_no_bit(threads):
    scene, _ = bowl(ALBEDO, lights=[gi.PunctualLight("point", (4.0, 2.0, 8.0))])
    results = []
    for number in (1, threads):
        try:
            launch.set_threads(number)
            work, traced, reflectance, bounces = baked(scene)
            direct = baking.lamp_irradiance(work, scene, 0)
            lamps = baking.gather_light(work, traced, reflectance, direct, 4, 0.0)
            results.append([bounces.transfer, np.array(bounces.share), direct, *lamps])
        finally:
            launch.set_threads(None)
    assert all(np.array_equal(a, b) for a, b in zip(*results, strict=True))
