"""The built-in scenes that are hard for path tracers: they hold the light that each of them is there for."""

from __future__ import annotations

import math

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.scene.builtin import lamp_wall, plates, shaded_lamp, shapes, white_room


def directions(count: int) -> np.ndarray:
    """Return unit vectors spread evenly over the sphere, float32 [count, 3]."""
    k = np.arange(count) + 0.5
    y, phi = 1 - 2 * k / count, k * math.pi * (3 - math.sqrt(5))
    r = np.sqrt(1 - y * y)
    return np.stack([r * np.cos(phi), y, r * np.sin(phi)], axis=1).astype(np.float32)


def hits(scene: gi.Scene, origins: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return for ``count`` rays from each origin where it begins, its direction, and its length."""
    starts = np.repeat(np.asarray(origins, np.float32).reshape(-1, 3), count, axis=0)
    ways = np.tile(directions(count), (len(starts) // count, 1))
    return starts, ways, scene.bvh("cpu").intersect(starts, ways).t.numpy()


def glowing(scene: gi.Scene) -> list[gi.Mesh]:
    return [mesh for node in scene.nodes for mesh in node.meshes if any(mesh.material.emission)]


def power(mesh: gi.Mesh) -> np.ndarray:
    """Return the power of a lamp that emits on its front, W, float64 [3]."""
    a, b, c = (mesh.points[mesh.indices[:, k]].astype(np.float64) for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2
    return math.pi * area * np.asarray(mesh.material.emission)


# ---- the wall of lamps ----


def test_the_wall_has_3200_lamps_of_many_colours_that_look_into_a_closed_hall():
    scene = gi.builtin_scene("lamp_wall")
    lamps = glowing(scene)
    assert scene.emitter_count == 2 * 3200 == 2 * lamp_wall.COLUMNS * lamp_wall.ROWS
    assert len({mesh.material.emission for mesh in lamps}) == len(lamps) > 30
    centers = np.concatenate([mesh.points[mesh.indices].reshape(-1, 6, 3).mean(axis=1) for mesh in lamps])
    assert len(np.unique(np.round(centers, 3), axis=0)) == 3200
    total = sum(power(mesh) for mesh in lamps)
    most = max(power(mesh).max() / (len(mesh.indices) / 2) for mesh in lamps)  # of a single lamp
    assert most < 0.01 * total.min()  # no lamp is what lights the hall
    for mesh in lamps:
        assert (mesh.normals == (0, 0, 1)).all() and not mesh.material.double_sided
    for camera in scene.cameras.values():
        assert np.isfinite(hits(scene, camera.position, 4096)[2]).all()


def test_the_camera_of_the_wall_sees_no_lamp():
    scene = gi.builtin_scene("lamp_wall")
    camera = scene.cameras["main"].at_resolution(48, 27)
    (frame,) = gi.render(scene, camera, gi.Pipeline.preset("direct", spp=4))
    assert frame.numpy("emission").max() == 0.0 and frame.numpy("emitters").mean() > 0.05


# ---- the plates ----


def test_the_four_lamps_over_the_plates_have_one_power():
    lamps = glowing(gi.builtin_scene("plates"))
    assert len(lamps) == 4 and sum(len(mesh.indices) for mesh in lamps) == 1280
    sizes = [np.ptp(mesh.points[:, 0]) / 2 for mesh in lamps]
    np.testing.assert_allclose(sizes, plates.RADII, rtol=0.01)
    for mesh, tint in zip(lamps, plates.TINTS, strict=True):
        np.testing.assert_allclose(power(mesh) / tint, power(lamps[-1]) / plates.TINTS[-1], rtol=1e-3)


def test_each_plate_mirrors_the_lamps_to_the_eye():
    scene = gi.builtin_scene("plates")
    metals = [m for n in scene.nodes if n.name.startswith("plate") for m in n.meshes]
    np.testing.assert_allclose([m.material.roughness**2 for m in metals], plates.ALPHAS)
    assert all(m.material.metallic == 1.0 for m in metals)
    eye, row = np.array(plates.EYE), np.array([0.0, plates.LAMP_Y, plates.LAMP_Z])
    for mesh, center in zip(metals, plates.CENTERS, strict=True):
        normal = mesh.normals[mesh.normals[:, 1].argmax()]  # of the upper side
        seen = eye - center
        mirrored = 2 * (seen @ normal) * normal - seen
        distance = np.linalg.norm(np.cross(mirrored / np.linalg.norm(mirrored), row - center))
        assert distance < 0.01
        bright = np.array([x - center[0] for x in plates.LAMP_X])
        assert (abs(bright) < plates.WIDTH / 2).all()  # all four are over the plate


# ---- the white room ----


def test_light_enters_the_white_room_by_its_window_alone():
    scene = gi.builtin_scene("white_room")
    inside = np.random.default_rng(1).uniform((-2.4, 0.05, -2.9), (2.4, 2.7, 2.9), (24, 3))
    starts, ways, t = hits(scene, inside, 1024)
    out = np.isinf(t)
    assert 0.002 < out.mean() < 0.05
    leave = (white_room.HALF_X - starts[out, 0]) / ways[out, 0]
    y, z = (starts[out, k] + leave * ways[out, k] for k in (1, 2))
    assert (leave > 0).all()
    assert ((y > white_room.SILL) & (y < white_room.LINTEL)).all()
    assert ((z > white_room.WINDOW_Z[0]) & (z < white_room.WINDOW_Z[1])).all()
    materials = {mesh.material.base_color for node in scene.nodes for mesh in node.meshes}
    assert all(0.85 <= min(color) and max(color) <= 0.9 for color in materials)


def test_the_overcast_sky_lights_the_ground_as_in_closed_form():
    sky = white_room.overcast()
    ways = directions(20_000).astype(np.float64)
    up = ways[ways[:, 1] > 0]
    rows = (np.arccos(up[:, 1]) / math.pi * (len(sky.pixels) - 1)).round().astype(int)
    irradiance = (sky.pixels[rows, 0] * up[:, 1:2]).sum(axis=0) * 4 * math.pi / len(ways)
    tint = sky.pixels[0, 0] / white_room.ZENITH
    np.testing.assert_allclose(irradiance / tint, 7 / 9 * math.pi * white_room.ZENITH, rtol=0.01)
    below = sky.pixels[-1, 0] / tint
    np.testing.assert_allclose(below, white_room.GROUND * 7 / 9 * white_room.ZENITH, rtol=1e-5)


def test_the_white_room_keeps_light_as_an_integrating_sphere_does():
    """Mean radiance of the walls of a closed room: what enters, spread over its area, and reflected again and again."""
    scene = gi.builtin_scene("white_room")
    scene.environment = 1.0
    x, y, z = 2 * white_room.HALF_X, white_room.HEIGHT, 2 * white_room.HALF_Z
    window = (white_room.LINTEL - white_room.SILL) * (white_room.WINDOW_Z[1] - white_room.WINDOW_Z[0])
    area = 2 * (x * y + y * z + z * x)
    albedo = 0.88
    expected = window / area * albedo / (1 - albedo * (1 - window / area))
    pipeline, seen = gi.Pipeline.preset("path", spp=64), []
    for turn in range(0, 360, 90):
        angle = math.radians(turn + 20)
        target = (math.sin(angle), 1.3, math.cos(angle))
        camera = gi.Camera.look_at((0.0, 1.4, 0.6), target, hfov=90.0, resolution=(32, 32))
        (frame,) = gi.render(scene, camera, pipeline)
        seen.append(frame.numpy("beauty") - frame.numpy("emission"))
    found = float(np.mean(seen))
    assert 0.65 * expected < found < 0.95 * expected  # the window's depth and the furniture take some


# ---- lamps behind shades ----


def test_shades_hide_their_bulbs():
    scene = gi.builtin_scene("shaded_lamp")
    bulbs = glowing(scene)
    assert scene.emitter_count == 160 and len(bulbs) == 2
    dark = gi.Scene([node for node in scene.nodes if node.name != "bulbs"], name="without bulbs")
    _, _, t = hits(dark, shaded_lamp.TABLE_LAMP, 8192)
    assert (t < 0.4).mean() > 0.99  # rings, lid and saucer leave no gap
    _, ways, t = hits(dark, shaded_lamp.FLOOR_LAMP, 8192)
    out = t > 0.3
    assert np.isfinite(t).all() and 0.2 < out.mean() < 0.45
    assert ways[out, 1].min() > 0.2  # over the rim of the bowl
    _, _, t = hits(scene, scene.cameras["main"].position, 8192)
    assert np.isfinite(t).all()  # the room is closed


def test_nearly_all_light_of_shaded_lamps_is_indirect():
    scene = gi.builtin_scene("shaded_lamp")
    camera = scene.cameras["main"].at_resolution(64, 36)
    (frame,) = gi.render(scene, camera, gi.Pipeline.preset("path", spp=256), seed=3)
    lower = slice(14, None)  # below what the floor lamp throws at the ceiling
    direct, indirect = (frame.numpy(term)[lower].mean(dtype=np.float64) for term in ("emitters", "indirect"))
    assert frame.numpy("emission").mean() < 0.2 * frame.numpy("beauty").mean()
    assert direct < 0.25 * indirect and indirect > 0.02


@pytest.mark.parametrize("shape", [shaded_lamp.bowl(), shaded_lamp.rings()], ids=["bowl", "rings"])
def test_shades_are_thin_closed_sheets(shape):
    """Their volume is positive and small, as that of a sheet whose outside is outside."""
    area = np.linalg.norm(
        np.cross(
            shape.points[shape.indices[:, 1]] - shape.points[shape.indices[:, 0]],
            shape.points[shape.indices[:, 2]] - shape.points[shape.indices[:, 0]],
        ),
        axis=1,
    ).sum()
    assert 0.0002 < shapes.volume(shape) / (area / 4) < 0.012
