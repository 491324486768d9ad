"""Skins and morph targets of scenes made by code: what is checked, hashed and watched."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scene_tools import card, triangle

import warp_gi as gi
from warp_gi.errors import SceneError
from warp_gi.launch import get_device
from warp_gi.scene import geometry, hulls, poses
from warp_gi.techniques.surface_cache.fill import object_grids

KEYS = [gi.MorphKeyframe(0.0, (0.0,)), gi.MorphKeyframe(2.0, (1.0,))]


def flag():
    """Return nodes: a triangle of two joints with one target, and its joints; the second one turns."""
    mesh = triangle(
        normals=np.tile(np.float32([0, 0, 1]), (3, 1)),
        joints=np.int32([[0, 1]] * 3),
        joint_weights=np.float32([[1, 0], [0.5, 0.5], [0, 1]]),
        targets=[gi.MorphTarget(np.float32([[0, 0, 1]] * 3), np.float32([[0.1, 0, 0]] * 3))],
    )
    skin = gi.Skin([1, 2], np.stack([np.eye(4)] * 2), "pole")
    turns = [gi.Keyframe(0.0), gi.Keyframe(1.0, (0, 1, 0), (0, 0, np.sqrt(0.5), np.sqrt(0.5)))]
    return [
        gi.Node("flag", [mesh], skin=skin, morphs=list(KEYS)),
        gi.Node("low"),
        gi.Node("high", parent=1, keyframes=turns),
        gi.Node("floor", [card(-1.0)]),
    ]


def spoil(**fields):
    """Return a change of the flag's node, or of its mesh or skin by a field "mesh_..." or "skin_..."."""

    def change(nodes):
        for name, value in fields.items():
            kind, _, field = name.rpartition("__")
            owner = {"": nodes[0], "mesh": nodes[0].meshes[0], "skin": nodes[0].skin}[kind]
            setattr(owner, field, value)

    return change


FAULTS = {
    "no joints": (spoil(skin__joints=[]), "skin 'pole' of node 'flag': needs at least one joint"),
    "matrices": (
        spoil(skin__joint_from_mesh=np.eye(4)[None]),
        r"a finite 4x4 matrix for each of 2, got .* \[1, 4, 4\]",
    ),
    "matrix": (spoil(skin__joint_from_mesh=np.full((2, 4, 4), np.inf)), "a finite 4x4 matrix"),
    "no node": (spoil(skin__joints=[1, 7]), r"skin 'pole' of node 'flag': joint 7 is no node \(0 to 3\)"),
    "no weights": (
        spoil(mesh__joint_weights=None),
        "mesh 'mesh' of node 'flag': has a skin and needs joints and joint_w",
    ),
    "joints of others": (
        spoil(mesh__joints=np.int32([[0, 1]])),
        r"joints must be integers \[3, influence\], got int32 \[1",
    ),
    "joints": (spoil(mesh__joints=np.float32([[0, 1]] * 3)), "joints must be integers"),
    "out of range": (spoil(mesh__joints=np.int32([[0, 2]] * 3)), "joint 2 is out of range, the skin has 2"),
    "negative": (spoil(mesh__joints=np.int32([[0, -1]] * 3)), "joint -1 is out of range"),
    "weights": (spoil(mesh__joint_weights=np.float32([[0, -1]] * 3)), "joint_weights must be .* from 0 up"),
    "shape": (spoil(mesh__joint_weights=np.ones((3, 3))), r"joint_weights must be \[3, 2\]"),
    "no keys": (spoil(morphs=[]), "at least one morph keyframe"),
    "keys": (spoil(morphs=KEYS[::-1]), "node 'flag': times of morph keyframes must rise"),
    "counts": (spoil(morphs=[KEYS[0], gi.MorphKeyframe(1.0, (0, 1))]), "morph keyframes have 1 to 2 weights"),
    "finite": (spoil(morphs=[gi.MorphKeyframe(0.0, (np.nan,))]), "must be finite"),
    "targets": (spoil(mesh__targets=[]), "mesh 'mesh' of node 'flag': has 0 morph targets and 1 weights"),
    "target": (spoil(mesh__targets=[gi.MorphTarget(np.zeros((2, 3)))]), r"points of morph target 0 must be \[3, 3\]"),
    "target normals": (
        spoil(mesh__targets=[gi.MorphTarget(None, np.full((3, 3), np.nan))]),
        "normals of morph target 0 must be finite",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_one_line(fault):
    change, message = FAULTS[fault]
    nodes = flag()
    gi.Scene(nodes)
    change(nodes)
    with pytest.raises(SceneError, match=message) as caught:
        gi.Scene(nodes)
    assert "\n" not in str(caught.value)


CHANGES = {
    "matrix": spoil(skin__joint_from_mesh=np.stack([np.eye(4), np.diag([1, 1, 1.5, 1])])),
    "joints": spoil(skin__joints=[2, 1]),
    "shares": spoil(mesh__joint_weights=np.float32([[1, 0], [0.4, 0.6], [0, 1]])),
    "who": spoil(mesh__joints=np.int32([[0, 0], [0, 1], [0, 1]])),
    "target": spoil(mesh__targets=[gi.MorphTarget(np.float32([[0, 0, 1.5]] * 3), np.float32([[0.1, 0, 0]] * 3))]),
    "normals": spoil(mesh__targets=[gi.MorphTarget(np.float32([[0, 0, 1]] * 3), np.float32([[0.2, 0, 0]] * 3))]),
    "key": spoil(morphs=[KEYS[0], gi.MorphKeyframe(2.0, (0.9,))]),
    "time": spoil(morphs=[KEYS[0], gi.MorphKeyframe(3.0, (1.0,))]),
}


@pytest.mark.parametrize("what", CHANGES)
def test_hashes_hold_all_that_changes_the_shape(what):
    """At time 0 nothing of it shows, but for a joint's number."""
    plain, changed, again = flag(), flag(), flag()
    CHANGES[what](changed)
    a, b, c = (gi.Scene(nodes) for nodes in (plain, changed, again))
    assert a.hash == c.hash and a.geometry_hash == c.geometry_hash
    assert a.hash != b.hash and a.geometry_hash != b.geometry_hash


def assert_like_new(scene):
    """Check that a scene is what a new one of its nodes is, at two times."""
    fresh = gi.Scene(scene.nodes)
    assert scene.hash == fresh.hash and scene.geometry_hash == fresh.geometry_hash
    np.testing.assert_array_equal(scene.bounds, fresh.bounds)
    for time, before in ((0.0, 0.0), (1.5, 0.5)):
        found = []
        for one in (scene, fresh):
            one.update(time, before, "cpu")
            geometry = one.data("cpu").geometry
            found.append([getattr(geometry, name).numpy() for name in ("points", "normals", "previous_points")])
        for ours, truth in zip(*found, strict=True):
            np.testing.assert_array_equal(ours, truth)


@pytest.mark.parametrize("what", CHANGES)
@pytest.mark.parametrize("in_use", [False, True])
def test_edits_are_followed(what, in_use):
    nodes = flag()
    scene = gi.Scene(nodes)
    if in_use:
        scene.update(1.0, 0.0, "cpu")
    scene.check_unchanged()
    version = scene.version
    CHANGES[what](scene.nodes)
    scene.check_unchanged()
    assert scene.version > version
    assert_like_new(scene)


def test_weights_that_begin_to_change_are_told():
    rests = flag()
    rests[2].keyframes, rests[0].morphs = None, [KEYS[1]]
    scene = gi.Scene(rests)
    scene.data("cpu")
    scene.nodes[0].morphs = list(KEYS)
    with pytest.raises(SceneError, match="morphs of what bends node 0 'flag' changed after the scene was built"):
        scene.check_unchanged()


@pytest.mark.parametrize("in_use", [False, True])
def test_a_node_that_is_replaced_by_one_that_bends_otherwise_is_followed(in_use):
    scene = gi.Scene(flag())
    if in_use:
        scene.data("cpu")
    scene.nodes[0] = replace(scene.nodes[0])
    version = scene.version
    scene.check_unchanged()
    assert scene.version == version
    scene.nodes[0] = replace(scene.nodes[0], morphs=[KEYS[0], gi.MorphKeyframe(2.0, (0.9,))])
    scene.check_unchanged()
    assert_like_new(scene)


def test_a_target_that_is_edited_in_place_is_followed():
    scene = gi.Scene(flag())
    scene.data("cpu")
    scene.nodes[0].meshes[0].targets[0].points[1, 2] = 3.0
    scene.check_unchanged()
    assert_like_new(scene)


def test_what_moves():
    moving = gi.Scene(flag())
    assert moving.moving_objects == {0: 0} and moving.duration == 2.0 and moving.moves(2) and not moving.moves(3)
    rests = flag()
    rests[2].keyframes, rests[0].morphs = None, [KEYS[1]]
    still = gi.Scene(rests)
    assert not still.is_animated and still.moving_objects == {}
    np.testing.assert_array_equal(still.data("cpu").geometry.points.numpy()[:3, 2], [1, 1, 1])
    only = flag()
    only[2].keyframes = None
    assert gi.Scene(only).moving_objects == {0: 0}  # by its weights alone


def test_hulls_hold_every_pose():
    """Random skins, weights and times; boxes are no larger than boxes of what follows each joint have to be."""
    rng = np.random.default_rng(3)
    for _ in range(5):
        mesh = replace(
            triangle(),
            points=rng.normal(size=(40, 3)).astype(np.float32),
            joints=rng.integers(0, 4, (40, 3)),
            joint_weights=np.maximum(rng.normal(size=(40, 3)), 0).astype(np.float32),
            targets=[gi.MorphTarget(rng.normal(size=(40, 3)).astype(np.float32)), gi.MorphTarget()],
        )
        for has_skin in (True, False):
            hull = hulls.Hull.around(mesh, has_skin)
            matrices = np.tile(np.eye(4), (6, 4 if has_skin else 1, 1, 1))
            matrices[:, :, :3] += rng.normal(size=(6, len(matrices[0]), 3, 4))
            weights = rng.normal(size=(6, 2))
            low, high = hull.box(matrices, weights)
            for matrix, weight in zip(matrices, weights, strict=True):
                pose = poses.Pose(matrix[0], matrix if has_skin else None, weight)
                points, _ = pose.vertices(mesh)
                one = hulls.pose_box(pose, [hull])
                assert (points >= one[0] - 1e-5).all() and (points <= one[1] + 1e-5).all()
                assert (one[0] >= low - 1e-9).all() and (one[1] <= high + 1e-9).all()


def test_an_interrupted_move_places_everything_anew(monkeypatch):
    scene = gi.Scene(flag())
    scene.update(0.5, 0.25, "cpu")
    wanted = [
        scene.data("cpu").geometry.points.numpy().copy(),
        scene.data("cpu").geometry.previous_points.numpy().copy(),
    ]
    scene.update(1.5, 0.5, "cpu")
    with monkeypatch.context() as patch:
        placed = geometry.place

        def stops(*arguments):
            placed(*arguments)
            raise KeyboardInterrupt

        patch.setattr(geometry, "place", stops)
        with pytest.raises(KeyboardInterrupt):
            scene.update(1.0, 0.5, "cpu")
    assert scene.update(1.5, 0.5, "cpu")  # the pose before the interrupt: it is no longer there
    scene.update(0.5, 0.25, "cpu")
    g = scene.data("cpu").geometry
    np.testing.assert_array_equal(g.points.numpy(), wanted[0])
    np.testing.assert_array_equal(g.previous_points.numpy(), wanted[1])


def test_a_vertex_without_weights_follows_its_first_joint():
    nodes = flag()
    nodes[0].meshes[0].joints = np.int32([[1, 0]] * 3)
    nodes[0].meshes[0].joint_weights = np.zeros((3, 2), np.float32)
    nodes[0].morphs = None
    scene = gi.Scene(nodes)
    scene.update(1.0, None, "cpu")
    points = scene.data("cpu").geometry.points.numpy()[:3]
    np.testing.assert_allclose(points, [[0, 1, 0], [0, 2, 0], [-1, 1, 0]], atol=1e-6)  # a quarter turn, 1 m up


def test_the_placement_of_a_skinned_node_is_of_no_account():
    """Neither for its vertices and bounds, nor for its cells in a surface cache."""
    nodes, moved = flag(), flag()
    moved[0].keyframes = [gi.Keyframe(0.0, (5, 0, 0)), gi.Keyframe(1.0, (0, 9, 0), scale=(3, 3, 3))]
    a, b = gi.Scene(nodes), gi.Scene(moved)
    np.testing.assert_array_equal(a.bounds, b.bounds)
    for scene in (a, b):
        scene.update(0.7, 0.2, "cpu")
        (row,) = (row for row in object_grids(scene, 0.7, get_device("cpu")).numpy() if row["number"])
        np.testing.assert_array_equal(row["rest_from_world"], np.eye(4))
    for name in ("points", "previous_points", "normals"):
        one, other = (getattr(scene.data("cpu").geometry, name).numpy() for scene in (a, b))
        np.testing.assert_array_equal(one, other)
