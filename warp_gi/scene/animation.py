"""Poses of animated nodes: keyframes to matrices, and matrices down the hierarchy."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from warp_gi.errors import SceneError
from warp_gi.scene.model import Keyframe, Node

CORNERS = np.array(list(itertools.product((0, 1), repeat=3)))
"""Which of low and high each corner of a box has along each axis, int [8, 3]."""
POSES_AT_ONCE = 1 << 18
"""Number of matrices that are held at once while a scene's bounds are found."""


def pose_matrix(translation: ArrayLike, rotation: ArrayLike, scale: ArrayLike) -> np.ndarray:
    """Return float64 [..., 4, 4]: scale first, then the rotation (quaternion x, y, z, w), then the translation."""
    rotation = np.asarray(rotation, np.float64)
    x, y, z, w = np.moveaxis(rotation / np.linalg.norm(rotation, axis=-1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix = np.zeros((*x.shape, 4, 4))
    matrix[..., 3, 3] = 1.0
    for i, row in enumerate(rows):
        for j, value in enumerate(row):
            matrix[..., i, j] = value
    matrix[..., :3, :3] *= np.asarray(scale, np.float64)[..., None, :]
    matrix[..., :3, 3] = translation
    return matrix


def slerp(start: ArrayLike, end: ArrayLike, weight: float | np.ndarray) -> np.ndarray:
    """Return the unit quaternions (x, y, z, w) ``weight`` of the shorter way from ``start`` to ``end``, [..., 4].

    ``weight`` is a number or [..., 1].
    """
    a, b = (np.asarray(one, np.float64) for one in (start, end))
    a, b = (one / np.linalg.norm(one, axis=-1, keepdims=True) for one in (a, b))
    cosine = np.sum(a * b, axis=-1, keepdims=True)
    b, cosine = np.where(cosine < 0.0, -b, b), np.abs(cosine)
    angle = np.arccos(np.minimum(cosine, 1.0))
    near = cosine > 1.0 - 1e-9
    sine = np.where(near, 1.0, np.sin(angle))
    rest = np.where(near, 1.0 - weight, np.sin((1.0 - weight) * angle) / sine)
    part = np.where(near, weight, np.sin(weight * angle) / sine)
    blend = rest * a + part * b
    return blend / np.linalg.norm(blend, axis=-1, keepdims=True)


def keyframe_matrix(keyframes: Sequence[Keyframe], time: float) -> np.ndarray:
    """Return the pose at ``time`` [s], float64 [4, 4]: linear between keys, held outside them."""
    times = [key.time for key in keyframes]
    after = int(np.searchsorted(times, time, side="right"))
    if after == 0 or after == len(keyframes):
        key = keyframes[min(after, len(keyframes) - 1)]
        return pose_matrix(key.translation, key.rotation, key.scale)
    a, b = keyframes[after - 1], keyframes[after]
    weight = (time - a.time) / (b.time - a.time)
    translation = (1.0 - weight) * np.asarray(a.translation) + weight * np.asarray(b.translation)
    scale = (1.0 - weight) * np.asarray(a.scale) + weight * np.asarray(b.scale)
    return pose_matrix(translation, slerp(a.rotation, b.rotation, weight), scale)


def moved_keyframes(keyframes: Sequence[Keyframe], move: np.ndarray) -> list[Keyframe]:
    """Return keyframes with ``move`` [3] added to their translations; the same ones if it is zero."""
    if not move.any():
        return list(keyframes)
    return [replace(key, translation=tuple((np.array(key.translation) + move).tolist())) for key in keyframes]


def turned_quaternion(rotation: np.ndarray, quaternion: ArrayLike) -> tuple[float, float, float, float]:
    """Return the quaternion x, y, z, w of a rotation [3, 3] after that of another quaternion."""
    x, y, z, w = np.asarray(quaternion, np.float64)
    # of the largest of the four: 4 q q^T from the matrix (Shepperd 1978)
    m = rotation
    products = np.array(
        [
            [1 + m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]],
            [m[0, 1] + m[1, 0], 1 - m[0, 0] + m[1, 1] - m[2, 2], m[1, 2] + m[2, 1], m[0, 2] - m[2, 0]],
            [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1 - m[0, 0] - m[1, 1] + m[2, 2], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], 1 + m[0, 0] + m[1, 1] + m[2, 2]],
        ]
    )
    largest = int(np.argmax(np.diag(products)))
    a, b, c, d = products[largest] / np.linalg.norm(products[largest])
    return (
        float(d * x + a * w + b * z - c * y),
        float(d * y - a * z + b * w + c * x),
        float(d * z + a * y - b * x + c * w),
        float(d * w - a * x - b * y - c * z),
    )


def set_keyframes(node: Node, keyframes: Sequence[Keyframe], offset: np.ndarray) -> None:
    """Give a node keyframes; of those of a root, which are in a file's coordinates, ``offset`` [3] is taken."""
    node.keyframes = moved_keyframes(keyframes, -offset) if node.parent is None else list(keyframes)
    if any(node.pivot):  # exact at the keys, and between them unless they turn
        moved = [pose_matrix(np.zeros(3), key.rotation, key.scale)[:3, :3] @ node.pivot for key in keyframes]
        pairs = zip(node.keyframes, moved, strict=True)
        node.keyframes = [moved_keyframes([key], np.asarray(move))[0] for key, move in pairs]


def world_matrices(nodes: Sequence[Node], time: float) -> list[np.ndarray]:
    """Return world_from_node of every node at ``time`` [s], float64 [4, 4] each."""
    world: list[np.ndarray] = []
    for node in nodes:
        local = keyframe_matrix(node.keyframes, time) if node.keyframes else np.asarray(node.parent_from_node)
        world.append(local if node.parent is None else world[node.parent] @ local)
    return world


def _keyframe_matrices(keyframes: Sequence[Keyframe], times: np.ndarray) -> np.ndarray:
    """Return ``keyframe_matrix`` at each of ``times`` [s], float64 [time, 4, 4]."""
    rows = keyframe_rows(keyframes)
    after = np.searchsorted(rows[:, 0], times, side="right")
    a = rows[np.maximum(after - 1, 0)]
    b = rows[np.minimum(after, len(rows) - 1)]
    span = np.where(b[:, :1] > a[:, :1], b[:, :1] - a[:, :1], 1.0)
    weight = np.clip((times[:, None] - a[:, :1]) / span, 0.0, 1.0)
    mixed = (1.0 - weight) * a + weight * b
    return pose_matrix(mixed[:, 1:4], slerp(a[:, 4:8], b[:, 4:8], weight), mixed[:, 8:11])


def keyframe_rows(keyframes: Sequence[Keyframe]) -> np.ndarray:
    """Return time, translation, rotation and scale of each keyframe, float64 [keyframe, 11]."""
    return np.array([(k.time, *k.translation, *k.rotation, *k.scale) for k in keyframes], np.float64)


def box_corners(node: Node) -> np.ndarray:
    """Return the corners of the boxes around a node's meshes, in its space, float64 [8 * mesh, 3]."""
    corners = []
    for mesh in node.meshes:
        box = np.stack([mesh.points.min(axis=0), mesh.points.max(axis=0)]).astype(np.float64)
        corners.append(box[CORNERS, np.arange(3)])
    return np.concatenate(corners)


def swept_box(nodes: Sequence[Node], moving: Sequence[bool], evenly: np.ndarray) -> np.ndarray:
    """Return a box around the poses of moving meshes that keep their shape: low and high corner, float64 [2, 3].

    The poses are those at the keys of whatever moves a mesh, and at the times ``evenly`` [s].
    """
    rest, top = world_matrices(nodes, 0.0), list(range(len(nodes)))
    groups: dict[int, list[int]] = {}
    for index, node in enumerate(nodes):
        if node.parent is not None and moving[node.parent]:
            top[index] = top[node.parent]
        if moving[index]:
            groups.setdefault(top[index], []).append(index)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for group in groups.values():
        if any(_is_placed(nodes[index]) for index in group):
            for some, placed, times in _cheapest(nodes, group, evenly):
                step = max(POSES_AT_ONCE // len(some), 16)
                for start in range(0, len(times), step):
                    box = _group_box(nodes, some, placed, rest, times[start : start + step])
                    low, high = np.minimum(low, box[0]), np.maximum(high, box[1])
    return np.stack([low, high])


_Work = tuple[list[int], list[int], np.ndarray]
"""Nodes whose matrices are needed, those of them whose meshes are asked for, and the times [s]."""


def _cheapest(nodes: Sequence[Node], group: list[int], evenly: np.ndarray) -> list[_Work]:
    """Return how to go through the poses of a group that moves together: at once, or by what has keys above a mesh.

    Nodes with keys of their own under one that moves have times of their own; in a chain, all move the last one.
    """
    times = {index: np.array([key.time for key in nodes[index].keyframes or ()]) for index in group}
    above: dict[int, list[int]] = {}
    classes: dict[tuple[int, ...], list[int]] = {}
    for index in group:
        parent = nodes[index].parent
        above[index] = [*above.get(-1 if parent is None else parent, ()), index]
        if _is_placed(nodes[index]):
            classes.setdefault(tuple(one for one in above[index] if nodes[one].keyframes), []).append(index)

    def at(keyed: Sequence[int]) -> np.ndarray:
        return np.unique(np.concatenate([evenly, *(times[one] for one in keyed)]))

    whole: _Work = group, [index for index in group if _is_placed(nodes[index])], at(group)
    parts: list[_Work] = []
    cost = 0
    for keyed, members in classes.items():
        needed = sorted({one for index in members for one in above[index]})
        parts.append((needed, members, at(keyed)))
        cost += len(needed) * len(parts[-1][2])
        if cost > len(group) * len(whole[2]):
            return [whole]
    return parts


def _group_box(
    nodes: Sequence[Node], group: list[int], placed: list[int], rest: list[np.ndarray], times: np.ndarray
) -> np.ndarray:
    """Return a box around the meshes of the nodes ``placed`` of a group at all ``times`` [s].

    ``rest`` places what does not move.
    """
    world = world_at_times(nodes, group, times, rest)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for index in placed:
        matrices = world[index].reshape(-1, 4, 4)
        corners = box_corners(nodes[index])
        points = np.matmul(corners, matrices[:, :3, :3].transpose(0, 2, 1)) + matrices[:, None, :3, 3]
        low, high = np.minimum(low, points.min(axis=(0, 1))), np.maximum(high, points.max(axis=(0, 1)))
    return np.stack([low, high])


def _is_placed(node: Node) -> bool:
    """Return whether a node has meshes that keep their shape."""
    return _is_rigid(node) and any(len(mesh.points) for mesh in node.meshes)


def _is_rigid(node: Node) -> bool:
    """Return whether the meshes of a node keep their shape."""
    return node.skin is None and node.morphs is None


def world_at_times(
    nodes: Sequence[Node], group: Sequence[int], times: np.ndarray, rest: Sequence[np.ndarray] = ()
) -> dict[int, np.ndarray]:
    """Return world_from_node of a group at ``times`` [s], float64 [time, 4, 4], or [4, 4] of a node that rests.

    Parents stand before children in the group; those that are not in it are where ``rest`` has them.
    """
    world: dict[int, np.ndarray] = {}
    for index in group:
        node = nodes[index]
        keys = node.keyframes
        placed = _keyframe_matrices(keys, times) if keys else np.asarray(node.parent_from_node, np.float64)
        if node.parent is not None:
            placed = (world[node.parent] if node.parent in world else rest[node.parent]) @ placed
        world[index] = placed
    return world


def moving_nodes(nodes: Sequence[Node]) -> list[bool]:
    """Return for every node whether it, or one above it, has keyframes."""
    moving: list[bool] = []
    for node in nodes:
        moving.append(bool(node.keyframes) or (node.parent is not None and moving[node.parent]))
    return moving


def key_times(nodes: Sequence[Node]) -> list[float]:
    """Return the times of all keyframes, sorted, without repeats [s]."""
    return sorted({key.time for node in nodes for key in (*(node.keyframes or ()), *(node.morphs or ()))})


def check_keyframes(keyframes: Sequence[Keyframe], name: str) -> None:
    """Raise SceneError unless there are keyframes, their times rise, and every number is finite."""
    if not keyframes:
        raise SceneError(f"node {name!r}: expected at least one keyframe, got none")
    try:
        rows = keyframe_rows(keyframes)
        good = np.isfinite(rows).all(axis=1) & (np.linalg.norm(rows[:, 4:8], axis=1) > 1e-6) & (rows.shape[1] == 11)
    except (TypeError, ValueError, IndexError):
        good = np.array([_is_keyframe(key) for key in keyframes])
    if not good.all():
        wrong = keyframes[int(np.argmin(good))]
        raise SceneError(f"node {name!r}: keyframe needs finite numbers and a unit quaternion, got {wrong}")
    falls = np.flatnonzero(~(np.diff(rows[:, 0]) > 0.0))
    if len(falls):
        a, b = rows[falls[0] : falls[0] + 2, 0].tolist()
        raise SceneError(f"node {name!r}: keyframe times must rise, got {a} s before {b} s")


def _is_keyframe(key: Keyframe) -> bool:
    """Return whether a keyframe holds as many numbers as it should."""
    try:
        return np.asarray([key.time, *key.translation, *key.rotation, *key.scale], np.float64).shape == (11,)
    except (TypeError, ValueError):
        return False
