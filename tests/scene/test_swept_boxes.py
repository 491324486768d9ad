"""Boxes around all that moves: equal to a slow pass over every pose, whatever moves together."""

from __future__ import annotations

import numpy as np
import pytest
from scene_tools import card, unit

import warp_gi as gi
from warp_gi.scene import animation, hulls
from warp_gi.scene.model import Keyframe, Mesh, Node, Skin
from warp_gi.scene.poses import poses

EVENLY = np.linspace(0.0, 2.0, 5)


def keys(rng, count):
    times = np.sort(rng.random(count)) * 2.0
    return [
        Keyframe(float(t), tuple(rng.normal(size=3)), tuple(unit(rng.normal(size=4))), tuple(rng.uniform(0.5, 2.0, 3)))
        for t in times
    ]


def tree(rng, parents, keyed):
    """Return nodes with these parents, a mesh each; those of ``keyed`` have keys at times of their own."""
    return [
        Node(
            f"n{index}",
            [card(half=0.5)],
            animation.pose_matrix(rng.normal(size=3), unit(rng.normal(size=4)), np.ones(3)),
            parent,
            keys(rng, 4) if index in keyed else None,
        )
        for index, parent in enumerate(parents)
    ]


TREES = {
    "many under one": ([None] + [0] * 9, range(10)),
    "a chain": ([None, *range(9)], range(10)),
    "still ones between": ([None, 0, 1, 2, 0, 4, 4], (0, 2, 6)),
    "two that rest above": ([None, None, 1, 2, 2], (2, 4)),
}


@pytest.mark.parametrize("name", TREES)
def test_boxes_are_those_of_every_pose_that_moves_a_mesh(name):
    parents, keyed = TREES[name]
    nodes = tree(np.random.default_rng(1), parents, keyed)
    moving = animation.moving_nodes(nodes)
    low, high = animation.swept_box(nodes, moving, EVENLY)
    least, most = np.full(3, np.inf), np.full(3, -np.inf)
    for index, node in enumerate(nodes):
        above = [index]
        while nodes[above[-1]].parent is not None:
            above.append(nodes[above[-1]].parent)
        if moving[index]:
            for time in {*EVENLY, *(key.time for one in above for key in nodes[one].keyframes or ())}:
                matrix = animation.world_matrices(nodes, time)[index]
                points = node.meshes[0].points @ matrix[:3, :3].T + matrix[:3, 3]
                least, most = np.minimum(least, points.min(axis=0)), np.maximum(most, points.max(axis=0))
    assert (low <= least + 1e-9).all()
    assert (high >= most - 1e-9).all()
    if name == "many under one":  # else all poses of all are gone through at once, which is cheaper
        np.testing.assert_allclose([low, high], [least, most], atol=1e-9)


def test_poses_of_one_node_are_not_those_of_all():
    rng = np.random.default_rng(2)
    nodes = tree(rng, [None] + [0] * 40, range(41))
    work = animation._cheapest(nodes, list(range(41)), EVENLY)
    assert len(work) == 41
    assert max(len(needed) * len(times) for needed, _, times in work) == 2 * (4 + 4 + len(EVENLY))
    chain = tree(rng, [None, *range(40)], range(41))
    assert len(animation._cheapest(chain, list(range(41)), EVENLY)) == 1


def test_boxes_of_skinned_meshes_are_those_of_every_pose():
    rng = np.random.default_rng(3)
    nodes = tree(rng, [None, 0, 1, 1], range(4))
    skin = Skin(
        [3, 0, 2], np.stack([animation.pose_matrix(rng.normal(size=3), unit(rng.normal(size=4)), np.ones(3))] * 3)
    )
    for count in (5, 9):
        points = rng.normal(size=(count, 3)).astype(np.float32)
        mesh = Mesh(points, np.array([[0, 1, 2]], np.int32), joints=rng.integers(0, 3, (count, 2)))
        mesh.joint_weights = rng.random((count, 2)).astype(np.float32)
        nodes.append(Node("skinned", [mesh], skin=skin))
    moving = [True] * len(nodes)
    found = hulls.hulls_of(nodes, moving)
    each = [hull for one in found.values() for hull in one]
    boxes = []
    for time in {*EVENLY, *animation.key_times(nodes)}:
        placed = poses(nodes, time)[-1].joints[None]
        for hull in each:
            one = hull.box(placed, np.zeros((1, 0)))  # by another way: as with targets
            np.testing.assert_allclose(hull.box(placed, None), one, atol=1e-12)
            boxes.append(one)
    low, high = np.min(boxes, axis=(0, 1)), np.max(boxes, axis=(0, 1))
    np.testing.assert_allclose(hulls.swept_box(nodes, found, EVENLY), [low, high], atol=1e-12)
    for time in animation.key_times(nodes):
        for node, pose in zip(nodes[4:], poses(nodes, time)[4:], strict=True):
            points = pose.vertices(node.meshes[0])[0]
            assert (points >= low - 1e-5).all()
            assert (points <= high + 1e-5).all()


def test_normals_follow_the_inverse_transpose():
    rng = np.random.default_rng(4)
    for sign in (1.0, -1.0):
        matrix = np.eye(4)
        matrix[:3, :3] = rng.normal(size=(3, 3))
        matrix[0, :3] *= sign
        normals = rng.normal(size=(7, 3))
        expected = unit(normals @ np.linalg.inv(matrix[:3, :3]))
        np.testing.assert_allclose(gi.scene.poses.transform_normals(matrix, normals), expected, atol=1e-6)
