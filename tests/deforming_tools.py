"""Meshes that bend and change their shape, made by code, and the slow way to where their vertices are."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from scene_tools import GlbBuilder
from scipy.spatial.transform import Rotation, Slerp

ROWS, SIDES = 7, 6
BAR_HEIGHT = 2.0


def bar() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points and normals [vertex, 3] and triangles of a tube along y from 0 to 2 m, without caps."""
    angle = 2 * np.pi * np.arange(SIDES) / SIDES
    around = np.stack([np.cos(angle), np.zeros(SIDES), np.sin(angle)], axis=1)
    heights = np.linspace(0, BAR_HEIGHT, ROWS)
    points = np.concatenate([0.2 * around + (0, h, 0) for h in heights])
    faces = []
    for row, side in itertools.product(range(ROWS - 1), range(SIDES)):
        a, b = row * SIDES + side, row * SIDES + (side + 1) % SIDES
        faces += [(a, a + SIDES, b), (b, a + SIDES, b + SIDES)]
    return points.astype(np.float32), np.tile(around, (ROWS, 1)).astype(np.float32), np.array(faces, np.int32)


def bar_weights(points: np.ndarray) -> np.ndarray:
    """Return the shares of a lower and an upper joint, float64 [vertex, 2]: a ramp around the middle."""
    upper = np.clip(points[:, 1].astype(np.float64) - 0.5, 0.0, 1.0)
    return np.stack([1.0 - upper, upper], axis=1)


BINDS = np.stack([np.eye(4), np.eye(4)])
BINDS[1, 1, 3] = -1.0
"""From the bar to its joints: the upper one is at y = 1."""


def skinned_bar(
    joints: Any = np.uint8,
    weights: Any = np.float32,
    sets: int = 1,
    root: dict[str, Any] | None = None,
    upper: dict[str, Any] | None = None,
    material: dict[str, Any] | None = None,
) -> GlbBuilder:
    """Return a file with a bar of two joints: node 0 has the mesh and is elsewhere, 1 is the lower joint, 2 the upper.

    ``sets`` is the number of JOINTS and WEIGHTS; with two the influences are spread over both. ``root`` and ``upper``
    place the joints.
    """
    glb = GlbBuilder()
    points, normals, faces = bar()
    shares = np.zeros((len(points), 4 * sets))
    owners = np.zeros((len(points), 4 * sets), int)
    columns = (1, 4 * sets - 1)
    shares[:, columns], owners[:, columns] = bar_weights(points), (0, 1)
    attributes = {"POSITION": glb.accessor(points), "NORMAL": glb.accessor(normals)}
    scale = 1 if weights == np.float32 else np.iinfo(weights).max
    for k in range(sets):
        part = slice(4 * k, 4 * k + 4)
        attributes[f"JOINTS_{k}"] = glb.accessor(owners[:, part], joints)
        attributes[f"WEIGHTS_{k}"] = glb.accessor(
            np.round(scale * shares[:, part]) if scale > 1 else shares[:, part], weights, normalized=scale > 1
        )
    primitive = {"attributes": attributes, "indices": glb.accessor(faces.ravel(), np.uint16)}
    if material is not None:
        primitive["material"] = glb.add("materials", material)
    mesh = glb.add("meshes", {"name": "bar", "primitives": [primitive]})
    glb.add("nodes", {"name": "bar", "mesh": mesh, "skin": 0, "translation": [50, 0, 0]})
    glb.add("nodes", {"name": "lower", "children": [2], **(root or {})})
    glb.add("nodes", {"name": "upper", "translation": [0, 1, 0], **(upper or {})})
    matrices = BINDS.transpose(0, 2, 1).reshape(-1, 16)
    glb.add("skins", {"name": "bones", "joints": [1, 2], "inverseBindMatrices": glb.accessor(matrices), "skeleton": 0})
    glb.json["scenes"] = [{"nodes": [0, 1]}]
    return glb


def animate(glb: GlbBuilder, node: int, path: str, times: Any, values: Any, interpolation: str = "LINEAR") -> None:
    """Add a channel that moves a property of a node, in an animation of its own or in the first one."""
    if "animations" not in glb.json:
        glb.add("animations", {"channels": [], "samplers": []})
    one = glb.json["animations"][0]
    values = np.asarray(values, np.float32)
    output = glb.accessor(values.ravel() if path == "weights" else values.reshape(-1, values.shape[-1]))
    one["samplers"].append({"input": glb.accessor(times), "output": output, "interpolation": interpolation})
    target = {"node": node, "path": path}
    one["channels"].append({"target": target, "sampler": len(one["samplers"]) - 1})


def spline(times: Any, values: Any, time: float) -> np.ndarray:
    """Return a cubic spline of glTF at a time: values [key, 3, width] are in-tangent, value and out-tangent."""
    times, values = np.asarray(times, float), np.asarray(values, float)
    if time <= times[0] or time >= times[-1]:
        return values[0 if time <= times[0] else -1, 1]
    k = int(np.searchsorted(times, time, side="right")) - 1
    d = times[k + 1] - times[k]
    t = (time - times[k]) / d
    return (
        (2 * t**3 - 3 * t**2 + 1) * values[k, 1]
        + d * (t**3 - 2 * t**2 + t) * values[k, 2]
        + (-2 * t**3 + 3 * t**2) * values[k + 1, 1]
        + d * (t**3 - t**2) * values[k + 1, 0]
    )


def turn(axis: str, degrees: float) -> list[float]:
    """Return the quaternion of a turn."""
    return Rotation.from_euler(axis, degrees, degrees=True).as_quat().tolist()


def turned_at(times: Any, quaternions: Any, time: float) -> np.ndarray:
    """Return the rotation matrix at a time between quaternions."""
    return Slerp(times, Rotation.from_quat(quaternions))(np.clip(time, times[0], times[-1])).as_matrix()


def placement(rotation: Any = None, translation: Any = (0, 0, 0), scale: Any = (1, 1, 1)) -> np.ndarray:
    """Return a matrix [4, 4] of a rotation matrix, a translation and a scale."""
    matrix = np.eye(4)
    matrix[:3, :3] = (np.eye(3) if rotation is None else rotation) * np.asarray(scale, float)
    matrix[:3, 3] = translation
    return matrix


def bent(points: Any, normals: Any, shares: Any, matrices: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return points and unit normals bent by joints, one vertex after another; ``shares`` [vertex, joint]."""
    moved, turned = [], []
    for p, n, w in zip(np.asarray(points, float), np.asarray(normals, float), shares, strict=True):
        whole = sum(one * matrix for one, matrix in zip(w, matrices, strict=True)) / sum(w)
        moved.append((whole @ np.append(p, 1.0))[:3])
        normal = np.linalg.inv(whole[:3, :3]).T @ n
        turned.append(normal / np.linalg.norm(normal))
    return np.array(moved), np.array(turned)
