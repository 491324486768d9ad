"""Poses of animated nodes: keyframes to matrices, and matrices down the hierarchy."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from warp_gi.errors import SceneError
from warp_gi.scene.model import Keyframe, Node


def pose_matrix(translation: ArrayLike, rotation: ArrayLike, scale: ArrayLike) -> np.ndarray:
    """Return float64 [4, 4]: scale first, then the rotation (quaternion x, y, z, w), then the translation."""
    x, y, z, w = np.asarray(rotation, np.float64) / np.linalg.norm(np.asarray(rotation))
    matrix = np.eye(4)
    matrix[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    matrix[:3, :3] *= np.asarray(scale, np.float64)
    matrix[:3, 3] = translation
    return matrix


def slerp(start: ArrayLike, end: ArrayLike, weight: float) -> np.ndarray:
    """Return the unit quaternion (x, y, z, w) ``weight`` of the shorter way from ``start`` to ``end``."""
    a, b = (np.asarray(one, np.float64) / np.linalg.norm(np.asarray(one)) for one in (start, end))
    cosine = float(a @ b)
    if cosine < 0.0:
        b, cosine = -b, -cosine
    if cosine > 1.0 - 1e-9:
        blend = a + weight * (b - a)
    else:
        angle = np.arccos(cosine)
        blend = np.sin((1.0 - weight) * angle) * a + np.sin(weight * angle) * b
    return blend / np.linalg.norm(blend)


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


def world_matrices(nodes: Sequence[Node], time: float) -> list[np.ndarray]:
    """Return world_from_node of every node at ``time`` [s], float64 [4, 4] each."""
    world: list[np.ndarray] = []
    for node in nodes:
        local = keyframe_matrix(node.keyframes, time) if node.keyframes else np.asarray(node.parent_from_node)
        world.append(local if node.parent is None else world[node.parent] @ local)
    return world


def moving_nodes(nodes: Sequence[Node]) -> list[bool]:
    """Return for every node whether it, or one above it, has keyframes."""
    moving: list[bool] = []
    for node in nodes:
        moving.append(bool(node.keyframes) or (node.parent is not None and moving[node.parent]))
    return moving


def key_times(nodes: Sequence[Node]) -> list[float]:
    """Return the times of all keyframes, sorted, without repeats [s]."""
    return sorted({key.time for node in nodes for key in node.keyframes or ()})


def check_keyframes(keyframes: Sequence[Keyframe], name: str) -> None:
    """Raise SceneError unless there are keyframes, their times rise, and every number is finite."""
    if not keyframes:
        raise SceneError(f"node {name!r}: expected at least one keyframe, got none")
    for key in keyframes:
        values = np.asarray([key.time, *key.translation, *key.rotation, *key.scale], np.float64)
        if values.shape != (11,) or not np.isfinite(values).all() or not np.linalg.norm(key.rotation) > 1e-6:
            raise SceneError(f"node {name!r}: keyframe needs finite numbers and a unit quaternion, got {key}")
    for a, b in itertools.pairwise(keyframes):
        if not a.time < b.time:
            raise SceneError(f"node {name!r}: keyframe times must rise, got {a.time} s before {b.time} s")
