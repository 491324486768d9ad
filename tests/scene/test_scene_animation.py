"""Moving nodes: poses, points at two times, and what hangs on them."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from scene_tools import card, triangle
from scipy.spatial.transform import Rotation, Slerp

from warp_gi.errors import OptionError, SceneError
from warp_gi.scene.animation import keyframe_matrix, world_matrices
from warp_gi.scene.model import Keyframe, Material, Node, PunctualLight
from warp_gi.scene.scene import Scene

LAMP = Material("lamp", emission=(1.0, 1.0, 1.0))
SLIDE = [Keyframe(0.0), Keyframe(2.0, (4.0, 0.0, 0.0))]


def test_poses_between_keys_agree_with_scipy():
    rng = np.random.default_rng(1)
    rotations = Rotation.from_quat(rng.normal(size=(4, 4)))
    times = np.array([0.0, 0.5, 2.0, 3.0])
    translations, scales = rng.normal(size=(4, 3)), rng.uniform(0.5, 2.0, (4, 3))
    keys = [
        Keyframe(t, tuple(p), tuple(q), tuple(s))
        for t, p, q, s in zip(times, translations, rotations.as_quat(), scales, strict=True)
    ]
    slerp = Slerp(times, rotations)
    for time in (-1.0, 0.0, 0.3, 0.5, 1.9, 3.0, 9.0):
        inside = np.clip(time, 0.0, 3.0)
        expected = np.eye(4)
        scale = [np.interp(inside, times, scales[:, axis]) for axis in range(3)]
        expected[:3, :3] = slerp(inside).as_matrix() * scale
        expected[:3, 3] = [np.interp(inside, times, translations[:, axis]) for axis in range(3)]
        np.testing.assert_allclose(keyframe_matrix(keys, time), expected, atol=1e-12)


def test_children_move_with_their_parents():
    quarter = Keyframe(1.0, rotation=(0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)))
    offset = np.eye(4)
    offset[:3, 3] = [1, 0, 0]
    nodes = [Node("arm", keyframes=[Keyframe(0.0), quarter]), Node("hand", parent_from_node=offset, parent=0)]
    np.testing.assert_allclose(world_matrices(nodes, 1.0)[1][:3, 3], [0, 1, 0], atol=1e-12)


def moving_scene() -> Scene:
    scene = Scene([Node("floor", [triangle()]), Node("lift", [triangle(LAMP)]), Node("cabin", [triangle()], parent=1)])
    scene.animate("lift", SLIDE)
    return scene


def test_update_moves_points_and_keeps_the_previous_ones():
    scene = moving_scene()
    assert scene.is_animated and scene.duration == 2.0
    rest = scene.data("cpu").geometry.points.numpy().copy()
    assert scene.update(1.0, 0.5, "cpu")
    g = scene.data("cpu").geometry
    shift = np.zeros_like(rest)
    shift[3:, 0] = 2.0
    np.testing.assert_allclose(g.points.numpy(), rest + shift, atol=1e-6)
    np.testing.assert_allclose(g.previous_points.numpy(), rest + shift / 2, atol=1e-6)
    assert not scene.update(1.0, 0.5, "cpu")
    assert scene.update(1.0, device="cpu")  # no motion
    np.testing.assert_array_equal(g.previous_points.numpy(), g.points.numpy())
    scene.update(0.0, device="cpu")
    np.testing.assert_array_equal(g.points.numpy(), rest)


def test_rays_meet_moved_triangles():
    scene = moving_scene()
    origin, direction = np.float32([[4.2, 0.2, 1.0]]), np.float32([[0, 0, -1]])
    assert scene.bvh("cpu").intersect(origin, direction).face.numpy()[0] == -1
    scene.update(2.0, 1.9, "cpu")
    assert scene.bvh("cpu").intersect(origin, direction).face.numpy()[0] in (1, 2)
    scene.update(0.0, 0.0, "cpu")
    assert scene.bvh("cpu").intersect(origin, direction).face.numpy()[0] == -1


def test_bounds_enclose_all_of_the_motion():
    np.testing.assert_allclose(moving_scene().bounds, [[0, 0, 0], [5, 1, 0]], atol=1e-6)


def test_normals_turn_with_the_node():
    half = Keyframe(1.0, rotation=(1.0, 0.0, 0.0, 0.0))
    normals = np.tile(np.float32([0, 0, 1]), (3, 1))
    scene = Scene([Node("n", [triangle(normals=normals)], keyframes=[Keyframe(0.0), half])])
    scene.update(1.0, 0.0, "cpu")
    np.testing.assert_allclose(scene.data("cpu").geometry.normals.numpy(), -normals, atol=1e-6)


def test_lights_follow_their_node():
    light = PunctualLight("spot", (1, 1, 1), direction=(0, 0, -1), node=0)
    turn = Keyframe(1.0, (0, 3, 0), rotation=(0, np.sqrt(0.5), 0, np.sqrt(0.5)))
    scene = Scene([Node("head", keyframes=[Keyframe(0.0), turn]), Node("n", [triangle(LAMP)])], [light])
    emitters = scene.data("cpu").emitters.emitters
    np.testing.assert_allclose(emitters.numpy()["direction"][1], [0, 0, -1])
    assert scene.update(1.0, 0.0, "cpu") and not scene.update(1.0, 0.0, "cpu")
    np.testing.assert_allclose(emitters.numpy()["direction"][1], [-1, 0, 0], atol=1e-6)
    np.testing.assert_allclose(emitters.numpy()["position"][1], [0, 3, 0], atol=1e-6)
    assert emitters.numpy()["triangle"][0] == 0


def test_the_box_around_emitters_is_larger_than_rounding():
    far = np.eye(4)
    far[:3, 3] = 1e5, 0, -2e4
    for place in (np.eye(4), far):
        scene = Scene([Node("n", [triangle(LAMP)], place)])
        box, points = scene.data("cpu").emitters, scene.data("cpu").geometry.points.numpy()
        ulp = np.spacing(np.abs(points).max())
        assert (points.min(axis=0) - np.array(box.lower) >= 8 * ulp).all()
        assert (np.array(box.upper) - points.max(axis=0) >= 8 * ulp).all()


def test_a_static_scene_is_not_updated():
    scene = Scene([Node("n", [triangle()])])
    assert not scene.update(3.0, 2.0, "cpu") and scene.duration == 0.0


def test_animating_what_is_not_there_is_an_error():
    scene = Scene([Node("left", [triangle()]), Node("twin", [triangle()]), Node("twin", [triangle()])])
    with pytest.raises(OptionError, match="did you mean 'left'"):
        scene.animate("lefd", SLIDE)
    with pytest.raises(SceneError, match="2 nodes are named 'twin'"):
        scene.animate("twin", SLIDE)
    with pytest.raises(SceneError, match="at least one keyframe"):
        scene.animate("left", [])


def test_emitters_are_placed_without_a_download(monkeypatch):
    """What the host knows of lights is what the device has, to the last bit, in every pose."""
    one, both = (Material("lamp", emission=(0.5, 2.0, 1.0), double_sided=sides) for sides in (False, True))
    nodes = [Node("floor", [triangle()]), Node("lift", [triangle(one)]), Node("cabin", [triangle(both)], parent=1)]
    nodes[2].parent_from_node = np.diag([0.5, 2.0, 1.0, 1.0]).astype(np.float32)
    lights = [PunctualLight("spot", (1.0, 1.0, 1.0), (0.1, 0.2, 0.3), node=1), PunctualLight("point", (2.0, 1.0, 1.0))]
    scene = Scene(nodes, lights)
    scene.animate("lift", [Keyframe(0.0), Keyframe(2.0, (4.0, 1.0, 0.0), (0.0, 0.6, 0.0, 0.8))])
    seen = []
    for device in [device.alias for device in wp.get_devices()]:
        for time in (0.0, 0.7, 2.0):
            scene.update(time, device=device)
            data = scene.data(device)
            table, geometry = data.emitters.emitters.numpy().copy(), data.geometry
            faces = table["triangle"][:2]
            corners = geometry.points.numpy()[geometry.indices.numpy()[faces]].astype(np.float64)
            sides = data.materials.numpy()["double_sided"][geometry.materials.numpy()[faces]] != 0
            with monkeypatch.context() as patch:
                patch.setattr(wp.array, "numpy", lambda self: pytest.fail("an array was downloaded"))
                placed = scene.placed_emitters(device)
            np.testing.assert_array_equal(placed.table, table)
            np.testing.assert_array_equal(placed.corners, corners)
            assert placed.two_sided.tolist() == sides.tolist() == [False, True]
            seen.append(corners[0, 0, 0])
    assert len(set(seen[:3])) == 3


def test_bounds_hold_every_pose_of_a_key():
    """A chain below a node that rests, with clocks of its own and a link without keys."""
    rng = np.random.default_rng(5)
    nodes = [Node("rest", [card()], np.diag([1.0, 2.0, 1.0, 1.0]))]
    for i in range(5):
        rows = zip(np.sort(rng.random(6)) * 3, rng.normal(size=(6, 4)), rng.normal(size=(6, 3)), strict=True)
        keys = [Keyframe(float(t), tuple(p), tuple(q / np.linalg.norm(q)), tuple(np.abs(p) + 0.5)) for t, q, p in rows]
        placement = np.eye(4)
        placement[:3, 3] = rng.normal(size=3)
        nodes.append(Node(f"n{i}", [card(half=0.5)] if i % 2 else [], placement, i, None if i == 3 else keys))
    scene = Scene(nodes)
    times = {*np.linspace(0, scene.duration, 33), *(key.time for node in nodes for key in node.keyframes or ())}
    boxes = [scene.node_box(i, time) for time in times for i, node in enumerate(nodes) if node.meshes]
    np.testing.assert_allclose(scene.bounds, [np.min(boxes, axis=(0, 1)), np.max(boxes, axis=(0, 1))], atol=1e-5)
    still = Scene([nodes[0], Node("lamp", [], np.eye(4), None, nodes[1].keyframes)])
    np.testing.assert_array_equal(still.bounds, [[-1, -2, 0], [1, 2, 0]])  # what moves has no triangles
