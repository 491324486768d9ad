"""Poses of animated nodes: keyframes to matrices, and matrices down the hierarchy."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

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
