"""Boxes around meshes that change their shape, without a pass over their vertices.

A vertex is a mean of where its joints take it, so it lies in the hull of the boxes of all vertices that follow a joint,
each taken along by its joint.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from warp_gi.scene import animation
from warp_gi.scene.model import Mesh, Node
from warp_gi.scene.poses import Pose, deforms, joint_shares, morph_weights

POSES_AT_ONCE = 1 << 18
"""Number of matrices that are held at once while the bounds of what deforms are found."""


@dataclass(frozen=True, eq=False)
class Hull:
    """Boxes around the vertices of a mesh that follow each joint that is followed; one box where there is no skin."""

    which: np.ndarray
    """Numbers of the joints, int64 [box]; 0 without a skin."""
    ends: np.ndarray
    """Low and high corners in the space of the mesh, float64 [box, 2, 3]."""
    shifts: np.ndarray
    """The least and the most that each morph target adds, float64 [target, box, 2, 3]."""

    @classmethod
    def around(cls, mesh: Mesh, has_skin: bool) -> Hull:
        """Return the boxes of a mesh."""
        points = np.asarray(mesh.points, np.float64)
        if not has_skin:
            which, groups = np.zeros(min(len(points), 1), np.int64), [np.arange(len(points))] * min(len(points), 1)
        else:
            follows = joint_shares(mesh) > 0.0
            vertex = np.nonzero(follows)[0]
            joint = np.asarray(mesh.joints)[follows]
            order = np.argsort(joint, kind="stable")
            which, first = np.unique(joint[order], return_index=True)
            groups = np.split(vertex[order], first[1:]) if len(which) else []
        fields = [points, *(t.points for t in mesh.targets)]
        ends = [
            np.array([_ends(np.zeros_like(points) if one is None else one, group) for group in groups])
            for one in fields
        ]
        shaped = np.array(ends, np.float64).reshape(len(fields), len(groups), 2, 3)
        return cls(which, shaped[0], shaped[1:])

    def box(self, placed: np.ndarray, weights: np.ndarray | None) -> np.ndarray:
        """Return a box around the mesh in world space, low and high corner, float64 [2, 3].

        ``placed`` are the matrices from the mesh by each joint, or its one matrix, [time, joint, 4, 4], and
        ``weights`` those of the targets, [time, target]: the box is around all times.
        """
        if not len(self.which):
            return np.stack([np.full(3, np.inf), np.full(3, -np.inf)])
        if weights is None:
            return self._still_box(placed)
        ends = np.broadcast_to(self.ends, (len(placed), *self.ends.shape))
        for k, shift in enumerate(self.shifts):
            ends = ends + np.sort(weights[:, k, None, None, None] * shift, axis=2)
        middle, half = ends.mean(axis=2), (ends[:, :, 1] - ends[:, :, 0]) / 2
        matrices = placed[:, self.which]
        middle = np.einsum("tjik,tjk->tji", matrices[..., :3, :3], middle) + matrices[..., :3, 3]
        half = np.einsum("tjik,tjk->tji", np.abs(matrices[..., :3, :3]), half)
        return np.stack([(middle - half).min(axis=(0, 1)), (middle + half).max(axis=(0, 1))])

    def _still_box(self, placed: np.ndarray) -> np.ndarray:
        """Return ``box`` without targets. A joint's boxes are looked at one by one only where all in one reach out."""
        joints, first, joint_of = np.unique(self.which, return_index=True, return_inverse=True)
        ends = self.ends[first]
        np.minimum.at(ends[:, 0], joint_of, self.ends[:, 0])
        np.maximum.at(ends[:, 1], joint_of, self.ends[:, 1])
        joint = np.tile(np.arange(len(joints)), len(placed))
        matrices = placed[:, joints].reshape(-1, 4, 4)
        outer = _turned_boxes(matrices, ends[joint])
        if len(joints) == len(self.which):
            return np.stack([outer[:, 0].min(axis=0), outer[:, 1].max(axis=0)])
        rows = [np.flatnonzero(joint_of == one) for one in range(len(joints))]

        def inner(chosen: np.ndarray) -> np.ndarray:
            boxes = [
                _turned_boxes(
                    np.repeat(matrices[some], len(rows[one]), axis=0), np.tile(self.ends[rows[one]], (len(some), 1, 1))
                )
                for one in np.unique(joint[chosen])
                for some in [chosen[joint[chosen] == one]]
            ]
            return _union([np.stack([one[:, 0].min(axis=0), one[:, 1].max(axis=0)]) for one in boxes])

        found = inner(np.concatenate([outer[:, 0].argmin(axis=0), outer[:, 1].argmax(axis=0)]))
        beyond = (outer[:, 0] < found[0]).any(axis=1) | (outer[:, 1] > found[1]).any(axis=1)
        return _union([found, inner(np.flatnonzero(beyond))])


def _turned_boxes(matrices: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """Return boxes around the boxes ``ends`` [n, 2, 3], each placed by its matrix [n, 4, 4], float64 [n, 2, 3]."""
    middle, half = ends.mean(axis=1), (ends[:, 1] - ends[:, 0]) / 2
    turned = np.einsum("nik,nk->ni", matrices[:, :3, :3], middle) + matrices[:, :3, 3]
    reach = np.einsum("nik,nk->ni", np.abs(matrices[:, :3, :3]), half)
    return np.stack([turned - reach, turned + reach], axis=1)


def _together(hulls: Sequence[Hull]) -> Hull:
    """Return all boxes of some hulls without targets as one hull, in which a joint may have several."""
    which = np.concatenate([hull.which for hull in hulls])
    return Hull(which, np.concatenate([hull.ends for hull in hulls]), np.zeros((0, len(which), 2, 3)))


Hulls = Mapping[int, Sequence[Hull]]
"""Hulls of the meshes of nodes that change their shape, by the node's index."""


def hulls_of(nodes: Sequence[Node], moving: Sequence[bool]) -> Hulls:
    """Return the hulls of all that moves and changes its shape."""
    found: dict[tuple[int, bool], Hull] = {}
    hulls: dict[int, list[Hull]] = {}
    for index, node in enumerate(nodes):
        if moving[index] and node.meshes and deforms(node):
            for mesh in node.meshes:
                key = id(mesh), node.skin is not None
                if key not in found:
                    found[key] = Hull.around(mesh, key[1])
                hulls.setdefault(index, []).append(found[key])
    return hulls


def pose_box(pose: Pose, hulls: Sequence[Hull]) -> np.ndarray:
    """Return a box around a node's meshes in a pose: low and high corner in world space, float64 [2, 3]."""
    placed = pose.matrix[None, None] if pose.joints is None else pose.joints[None]
    return _union([hull.box(placed, None if pose.weights is None else pose.weights[None]) for hull in hulls])


def swept_box(nodes: Sequence[Node], hulls: Hulls, evenly: np.ndarray) -> np.ndarray:
    """Return a box around all shapes of meshes that deform: low and high corner, float64 [2, 3].

    The poses are those at the keys of all that moves a mesh, and at the times ``evenly`` [s].
    """
    groups: dict[int, list[int]] = {}  # nodes of one skin, or one node
    for index in hulls:
        skin = nodes[index].skin
        groups.setdefault(index if skin is None else -1 - id(skin), []).append(index)
    boxes = []
    for members in groups.values():
        skin = nodes[members[0]].skin
        leaders = members if skin is None else skin.joints
        above = _with_parents(nodes, leaders)
        keys = animation.key_times([nodes[index] for index in {*above, *members}])
        still = [hull for index in members if nodes[index].morphs is None for hull in hulls[index]]
        alike = [_together(still)] if still else []
        times = np.union1d(evenly, keys)
        step = max(POSES_AT_ONCE // len(above), 16)
        for start in range(0, len(times), step):
            some = times[start : start + step]
            world = animation.world_at_times(nodes, above, some)
            shape = (len(some), 4, 4)
            placed = np.stack([np.broadcast_to(world[index], shape) for index in leaders], axis=1)
            if skin is not None:
                placed = placed @ np.asarray(skin.joint_from_mesh, np.float64)
            boxes += [hull.box(placed, None) for hull in alike]
            for index in members:
                morphs = nodes[index].morphs
                if morphs is not None:
                    weights = morph_weights(morphs, some)
                    boxes += [hull.box(placed, weights) for hull in hulls[index]]
    return _union(boxes)


def _ends(values: np.ndarray, group: np.ndarray) -> np.ndarray:
    """Return the least and the most of some rows, float64 [2, 3]."""
    some = np.asarray(values, np.float64)[group]
    return np.stack([some.min(axis=0), some.max(axis=0)])


def _union(boxes: Sequence[np.ndarray]) -> np.ndarray:
    """Return the box around boxes; without any it is turned inside out."""
    both = np.array([np.stack([np.full(3, np.inf), np.full(3, -np.inf)]), *boxes])
    return np.stack([both[:, 0].min(axis=0), both[:, 1].max(axis=0)])


def _with_parents(nodes: Sequence[Node], indices: Sequence[int]) -> list[int]:
    """Return nodes and all those above them, in order."""
    found: set[int] = set()
    for start in indices:
        index: int | None = start
        while index is not None and index not in found:
            found.add(index)
            index = nodes[index].parent
    return sorted(found)
