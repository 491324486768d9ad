"""The scenes made by code: geometry that is sound, and of the kind each is there for."""

import math

import numpy as np
import pytest
from scene_tools import loss_by_depth

import warp_gi as gi
from warp_gi.errors import OptionError
from warp_gi.scene.builtin import (
    BUILTIN_SCENES,
    architecture,
    builtin_camera_path,
    materials,
    mine,
    shapes,
    sphere_row,
)
from warp_gi.scene.builtin import textures as tx

TRIANGLES = {
    "atrium": (140_000, 180_000),
    "cornell_box": (30, 60),
    "lamp_wall": (15_000, 20_000),
    "mine": (60_000, 100_000),
    "plates": (1_300, 1_400),
    "shaded_lamp": (5_000, 15_000),
    "sphere_row": (10_000, 40_000),
    "street": (100_000, 150_000),
    "two_rooms": (500, 10_000),
    "warehouse": (20_000, 100_000),
    "white_room": (2_000, 4_000),
}

CLOSED = {
    "box": (shapes.box((0, 0, 0), (1, 2, 3)), 6.0),
    "bevelled box": (shapes.box((0, 0, 0), (1, 1, 1), 0.1), 1 - 12 * 0.005 * 0.8 - 8 * 0.001 * (1 / 2 + 1 / 3)),
    "uv sphere": (shapes.uv_sphere(0.5, 128, 64), 4 / 3 * math.pi / 8),
    "icosphere": (shapes.icosphere(0.5, 4), 4 / 3 * math.pi / 8),
    "cylinder": (shapes.cylinder(1.0, 2.0, 96), 2 * math.pi),
    "tube": (shapes.tube(np.array([[0, 0, 0], [0, 1, 0], [0, 2, 0]]), 0.1, 48), 2 * math.pi * 0.01),
    "arch": (shapes.arch(2.4, 1.6, 0.9, 0.5, 64), 2.4 * 1.6 * 0.5 - math.pi / 2 * 0.81 * 0.5),
    "moulding inwards": (shapes.ribbon_ring([(0, 0), (0.2, 0), (0.2, 0.3), (0, 0.3)], 3, 4), 0.3 * (48 - 5.6 * 7.6)),
    "moulding outwards": (
        shapes.ribbon_ring([(0, 0), (0.2, 0), (0.2, 0.3), (0, 0.3)], 3, 4, inward=False),
        0.3 * (6.4 * 8.4 - 48),
    ),
    "mirrored box": (shapes.box((0, 0, 0), (1, 2, 3)).scaled(-1, 1, 1), 6.0),
    "baluster": (architecture.baluster(0.7, 0.06), None),
    "shaft": (architecture.shaft(0.2, 2.0, 24), None),
    "pot": (architecture.pot(0.4, 0.6)["clay"], None),
    "lantern glow": (architecture.lantern(1.0)["glow"], None),
}


@pytest.fixture(scope="module", params=sorted(BUILTIN_SCENES))
def scene(request):
    return gi.builtin_scene(request.param)


def test_the_default_depth_keeps_the_indirect_light(scene):
    """Half a percent at most is lost to the greatest depth. Paths of one seed differ by their ends alone."""
    assert loss_by_depth(scene, scene.cameras["main"], gi.BsdfPaths()) < 0.005


def triangles(scene: gi.Scene) -> np.ndarray:
    return np.concatenate([m.points[m.indices] for n in scene.nodes for m in n.meshes]).astype(np.float64)


def areas_and_normals(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normal, axis=1)
    return length / 2, normal / length[:, None]


def test_geometry_is_sound(scene):
    low, high = TRIANGLES[scene.name]
    assert low <= len(triangles(scene)) <= high
    for node in scene.nodes:
        for mesh in node.meshes:
            for values in (mesh.points, mesh.normals, mesh.uvs):
                assert values.dtype == np.float32 and np.isfinite(values).all()
            assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-4)
            area, normal = areas_and_normals(mesh.points[mesh.indices].astype(np.float64))
            assert area.min() > 1e-9, mesh.name
            facing = np.einsum("ij,ij->i", normal, mesh.normals[mesh.indices].mean(axis=1))
            assert facing.min() > 0, f"{mesh.name}: shading normals point into the surface"


def test_cameras_and_path(scene):
    assert "main" in scene.cameras
    path = builtin_camera_path(scene.name)
    assert path.frame_count == 48 and path.fps == 24
    first, last = path.camera(0), path.camera(47)
    assert np.allclose(first.position, scene.cameras["main"].position, atol=1.5)
    assert 0.2 < np.linalg.norm(first.position - last.position) < 4.0
    # the eye has room around it on the whole path
    corners = triangles(scene)
    bvh = gi.TriangleBvh(
        corners.reshape(-1, 3).astype(np.float32), np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    )
    directions = fibonacci(256)
    for frame in (0, 12, 24, 36, 47):
        origins = np.repeat(path.camera(frame).position[None].astype(np.float32), len(directions), axis=0)
        assert bvh.intersect(origins, directions).t.numpy().min() > 0.15, f"frame {frame} is too near a surface"


def test_a_scene_is_the_same_every_time(scene):
    assert gi.builtin_scene(scene.name).hash == scene.hash


def test_unknown_names_are_named():
    for find in (gi.builtin_scene, builtin_camera_path):
        with pytest.raises(OptionError, match=r"unknown built-in scene 'atriun'; did you mean 'atrium'"):
            find("atriun")


@pytest.mark.parametrize("name", CLOSED)
def test_closed_shapes_wind_outwards(name):
    shape, expected = CLOSED[name]
    _, vertex = np.unique(np.round(shape.points, 7), axis=0, return_inverse=True)
    faces = vertex.reshape(-1)[shape.indices]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    found = set(map(tuple, edges.tolist()))
    assert len(found) == len(edges) and all((b, a) in found for a, b in found), "not closed"
    assert shapes.volume(shape) > 0
    if expected is not None:
        assert shapes.volume(shape) == pytest.approx(expected, rel=0.01)


def test_transforms_keep_normals_outside():
    ball = shapes.icosphere(1.0, 2)
    moved = ball.scaled(2, 0.5, -1).turned(30, "x").turned(70).moved(3, 4, 5)
    area, normal = areas_and_normals(moved.points[moved.indices])
    assert (np.einsum("ij,ij->i", normal, moved.normals[moved.indices].mean(axis=1)) > 0).all()
    assert shapes.volume(moved) == pytest.approx(shapes.volume(ball), rel=1e-6) and area.min() > 0
    quarter = shapes.quad((0, 0, 0), (1, 0, 0), (0, 1, 0)).turned(90)
    assert np.allclose(quarter.points[1], [0, 0, -1]) and np.allclose(quarter.normals[0], [1, 0, 0])
    copies = ball.repeated(np.stack([shapes.placement((k, 0, 0), 10.0 * k, scale=0.5) for k in range(3)]))
    assert shapes.volume(copies) == pytest.approx(3 / 8 * shapes.volume(ball))


def fibonacci(count: int) -> np.ndarray:
    k = np.arange(count) + 0.5
    y, phi = 1 - 2 * k / count, k * math.pi * (3 - math.sqrt(5))
    r = np.sqrt(1 - y * y)
    return np.stack([r * np.cos(phi), y, r * np.sin(phi)], axis=1).astype(np.float32)


def bvh_of(scene: gi.Scene, keep=lambda material: True) -> gi.TriangleBvh:
    meshes = [m for n in scene.nodes for m in n.meshes if keep(m.material)]
    points = np.concatenate([m.points[m.indices].reshape(-1, 3) for m in meshes])
    return gi.TriangleBvh(points, np.arange(len(points), dtype=np.int32).reshape(-1, 3))


def test_two_rooms_are_sealed_from_each_other():
    bvh = bvh_of(gi.builtin_scene("two_rooms"))
    rng = np.random.default_rng(0)
    for side in (-1, 1):
        origins = rng.uniform((0.02, 0.02, -1.98), (3.98, 2.98, 1.98), (64, 3)) * [side, 1, 1]
        origins = np.repeat(origins, 512, axis=0).astype(np.float32)
        directions = np.tile(fibonacci(512), (64, 1))
        t = bvh.intersect(origins, directions).t.numpy()
        assert np.isfinite(t).all()
        assert (side * (origins + t[:, None] * directions)[:, 0]).min() > 0


def test_warehouse_lamps_are_many_and_mostly_hidden():
    scene = gi.builtin_scene("warehouse")
    lamps = [m for n in scene.nodes for m in n.meshes if any(m.material.emission)]
    quads = np.concatenate([m.points[m.indices].reshape(-1, 6, 3).mean(axis=1) for m in lamps])
    assert len(quads) >= 500
    walls = bvh_of(scene, lambda material: not any(material.emission))
    for camera in scene.cameras.values():
        eye = camera.position.astype(np.float32)
        to_lamp = quads - eye
        hidden = walls.occluded(
            np.repeat(eye[None], len(quads), axis=0), to_lamp.astype(np.float32), t_max=0.999
        ).numpy()
        assert 0.6 < hidden.mean() < 1.0


@pytest.mark.parametrize("name", ["atrium", "street"])
def test_open_scenes_show_sky_above_only(name):
    scene = gi.builtin_scene(name)
    bvh = bvh_of(scene)
    directions = fibonacci(2000)
    eye = scene.cameras["main"].position.astype(np.float32)
    sky = np.isinf(bvh.intersect(np.repeat(eye[None], 2000, axis=0), directions).t.numpy())
    assert 0.05 < sky.mean() < 0.5
    assert directions[sky, 1].min() > -0.05
    assert scene.environment is not None and not scene.environment.is_black


def test_mine_is_closed_but_for_a_shaft_towards_the_sun():
    scene = gi.builtin_scene("mine")
    bvh, directions = bvh_of(scene), fibonacci(4096)
    assert scene.emitter_count == 0 and {"main", "spot", "tunnel"} <= set(scene.cameras)
    for camera in scene.cameras.values():
        origins = np.repeat(camera.position[None].astype(np.float32), len(directions), axis=0)
        t = bvh.intersect(origins, directions).t.numpy()
        assert np.isinf(t).mean() < 0.005
        ends = (origins + t[:, None] * directions)[np.isfinite(t)]
        assert (ends > mine.LOW).all() and (ends < mine.HIGH).all()
    for origin in np.random.default_rng(0).uniform((-4, 0.8, -4), (4, 3, 4), (32, 3)).astype(np.float32):
        sky = np.isinf(bvh.intersect(np.repeat(origin[None], len(directions), axis=0), directions).t.numpy())
        assert sky.mean() < 0.06
        assert (directions[sky] @ mine.to_sun() > 0.5).all()


def test_mine_has_a_small_sunlit_spot():
    bvh = bvh_of(gi.builtin_scene("mine"))
    (center_x, _, center_z), (radius_x, _, radius_z) = mine.CAVERN
    x, z = np.meshgrid(np.arange(-8, 8, 0.1) + center_x, np.arange(-7, 7, 0.1) + center_z)
    inside = np.hypot((x - center_x) / radius_x, (z - center_z) / radius_z) < 0.85
    height = 0.5  # m above the ground
    origins = np.stack([x, np.full_like(x, height), z], axis=-1)[inside].astype(np.float32)
    sun = np.broadcast_to(mine.to_sun().astype(np.float32), origins.shape)
    lit = bvh.occluded(origins, np.ascontiguousarray(sun)).numpy() == 0
    assert 1.0 < lit.sum() * 0.1**2 < 8.0  # m^2
    axis = mine.SPOT + height / mine.to_sun()[1] * mine.to_sun()
    assert (np.linalg.norm(origins[lit] - axis, axis=1) > 2.0).mean() < 0.01  # a few start inside of the rock


def test_rock_faces_where_one_can_be():
    x = np.linspace(-2, 2, 21, dtype=np.float32)
    values = 1.3 - np.sqrt(x[:, None, None] ** 2 + x[:, None] ** 2 + x**2)  # a ball of rock in the air
    points, faces = mine.surface(values, 0.2)
    ball = shapes.Shape.of(points - 2, faces, crease=180.0)
    assert shapes.volume(ball) == pytest.approx(4 / 3 * math.pi * 1.3**3, rel=0.03)
    assert np.allclose(np.linalg.norm(ball.points, axis=1), 1.3, atol=0.03)


def test_sphere_row_takes_its_settings():
    scene = sphere_row.scene(roughnesses=(0.1, 0.7), metallic=0.5, color=(0.2, 0.3, 0.4), environment=1.0)
    balls = [n.meshes[0] for n in scene.nodes if n.name.startswith("sphere")]
    assert [m.material.roughness for m in balls] == [0.1, 0.7]
    assert {m.material.metallic for m in balls} == {0.5} and balls[0].material.base_color == (0.2, 0.3, 0.4)
    assert np.allclose(np.linalg.norm(balls[0].points - balls[0].points.mean(0), axis=1), 0.5, atol=0.01)
    assert np.allclose(scene.environment.mean_radiance, 1.0)


@pytest.mark.parametrize(
    "material", [materials.court_tiles(), materials.ashlar(), materials.rose_marble(), materials.walnut()]
)
def test_textures_have_no_seams(material):
    slots = (material.base_color_texture, material.metallic_roughness_texture, material.normal_texture)
    for texture in filter(None, slots):
        pixels = texture.pixels[..., :3].astype(np.float64)
        for axis in (0, 1):
            steps = np.abs(np.diff(pixels, axis=axis)).mean(axis=(1 - axis, 2))
            seam = np.abs(np.take(pixels, 0, axis) - np.take(pixels, -1, axis)).mean()
            assert seam <= steps.max() * 1.1 + 1.0, f"{texture.name}: seam across axis {axis}"


def test_normal_maps_lean_away_from_rising_height():
    x = np.arange(tx.SIZE) / tx.SIZE
    height = np.broadcast_to(0.01 * np.sin(2 * math.pi * x), (tx.SIZE, tx.SIZE))
    pixels = tx.normal_texture("ramp", height, 1.0).pixels / 255.0 * 2 - 1
    assert pixels[0, 0, 0] < -0.05 and abs(pixels[0, 0, 1]) < 0.01  # rises along u at u = 0
    pixels = tx.normal_texture("ramp", height.T, 1.0).pixels / 255.0 * 2 - 1
    assert pixels[0, 0, 1] > 0.05 and abs(pixels[0, 0, 0]) < 0.01  # rises down the rows, so falls along v
