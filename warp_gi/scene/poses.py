"""Where the vertices of nodes are at a time: placed by a matrix, blended between shapes, bent by joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from warp_gi.errors import SceneError
from warp_gi.scene import animation
from warp_gi.scene.model import Mesh, MorphKeyframe, Node, Skin


def transform_points(matrix: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return ``points`` [n, 3] moved by ``matrix`` [4, 4], float32."""
    if np.array_equal(matrix, np.eye(4)):
        return np.asarray(points, np.float32)
    with np.errstate(over="ignore"):  # infinite points are an error of the Scene
        return (np.asarray(points, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]).astype(np.float32)


def transform_normals(matrix: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return unit normals [n, 3] moved by ``matrix``, float32; those without a direction become zero."""
    (a, b, c), (d, e, f), (g, h, i) = np.asarray(matrix, np.float64)[
        :3, :3
    ].tolist()  # np.cross takes ten times as long
    cofactors = np.array(
        [
            [e * i - f * h, f * g - d * i, d * h - e * g],
            [h * c - i * b, i * a - g * c, g * b - h * a],
            [b * f - c * e, c * d - a * f, a * e - b * d],
        ]
    )
    if a * cofactors[0, 0] + b * cofactors[0, 1] + c * cofactors[0, 2] < 0.0:
        cofactors = -cofactors
    moved = np.nan_to_num(np.asarray(normals, np.float64), nan=0.0, posinf=0.0, neginf=0.0) @ cofactors.T
    length = np.linalg.norm(moved, axis=1, keepdims=True)
    return np.divide(moved, length, out=np.zeros_like(moved), where=length > 1e-12).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Pose:
    """What decides where the vertices of a node are at one time."""

    matrix: np.ndarray
    """world_from_node, float64 [4, 4]."""
    joints: np.ndarray | None = None
    """World from mesh by each joint of the node's skin, float64 [joint, 4, 4]; None without a skin."""
    weights: np.ndarray | None = None
    """Weights of morph targets, float64 [target]; None without any."""

    @cached_property
    def key(self) -> np.ndarray:
        """All of these numbers, float64 [number]: where they are the same, the vertices are."""
        parts = [part for part in (self.matrix, self.joints, self.weights) if part is not None]
        return np.concatenate([np.ravel(part) for part in parts])

    def vertices(self, mesh: Mesh) -> tuple[np.ndarray, np.ndarray | None]:
        """Return points and unit normals of a mesh in world space, float32 [vertex, 3]; no normals if it has none."""
        points, normals = morphed(mesh, self.weights)
        if self.joints is None:
            placed = transform_points(self.matrix, points)
            return placed, None if normals is None else transform_normals(self.matrix, normals)
        blend = _blended(mesh, self.joints)
        moved = np.einsum("vij,vj->vi", blend[:, :, :3], points) + blend[:, :, 3]
        with np.errstate(over="ignore"):  # infinite points are an error of the Scene
            return moved.astype(np.float32), None if normals is None else _turned(blend, normals)

    def mirrors(self, mesh: Mesh) -> bool:
        """Return whether a mesh is mirrored, so that its triangles' winding turns; if in part, the larger one."""
        if self.joints is None:
            return bool(np.linalg.det(self.matrix[:3, :3]) < 0.0)
        weights = joint_shares(mesh)
        is_mirrored = np.linalg.det(self.joints[:, :3, :3]) < 0.0
        return bool(weights[is_mirrored[np.asarray(mesh.joints)]].sum() > 0.5 * weights.sum())


def poses(nodes: Sequence[Node], time: float) -> list[Pose]:
    """Return the pose of every node at ``time`` [s]."""
    world = animation.world_matrices(nodes, time)
    return [
        Pose(
            np.array(matrix),
            None if node.skin is None else joint_matrices(node.skin, world),
            None if node.morphs is None else morph_weights(node.morphs, np.array([time]))[0],
        )
        for node, matrix in zip(nodes, world, strict=True)
    ]


def deforms(node: Node) -> bool:
    """Return whether a node's matrix does not tell where its vertices are."""
    return node.skin is not None or node.morphs is not None


def moving_nodes(nodes: Sequence[Node]) -> list[bool]:
    """Return for every node whether it, or one above it, has keyframes, or its meshes change their shape."""
    moving = animation.moving_nodes(nodes)
    return [
        moves
        or (node.morphs is not None and any(key.weights != node.morphs[0].weights for key in node.morphs))
        or (node.skin is not None and any(moving[joint] for joint in node.skin.joints))
        for node, moves in zip(nodes, moving, strict=True)
    ]


def joint_matrices(skin: Skin, world: Sequence[np.ndarray]) -> np.ndarray:
    """Return world from mesh by each joint, float64 [joint, 4, 4]; ``world`` is world_from_node of every node."""
    return np.stack([world[joint] for joint in skin.joints]) @ np.asarray(skin.joint_from_mesh, np.float64)


def morph_weights(keys: Sequence[MorphKeyframe], times: np.ndarray) -> np.ndarray:
    """Return the weights at ``times`` [s], float64 [time, target]."""
    known, values = np.array([key.time for key in keys]), np.array([key.weights for key in keys], np.float64)
    columns = [np.interp(times, known, column) for column in values.T]
    return np.stack(columns, axis=1) if columns else np.zeros((len(times), 0))


def morphed(mesh: Mesh, weights: np.ndarray | None) -> tuple[np.ndarray, np.ndarray | None]:
    """Return points and normals with weighted targets added, float64 [vertex, 3]; as they are without weights."""
    points, normals = mesh.points, mesh.normals
    for target, weight in zip(mesh.targets, () if weights is None else weights, strict=weights is not None):
        if weight and target.points is not None:
            points = points + weight * np.asarray(target.points, np.float64)
        if weight and target.normals is not None and normals is not None:
            normals = normals + weight * np.asarray(target.normals, np.float64)
    return points, normals


def joint_shares(mesh: Mesh) -> np.ndarray:
    """Return the weights of a mesh's joints with a sum of 1 for each vertex, float64 [vertex, influence].

    A vertex without any weight follows its first joint.
    """
    weights = np.asarray(mesh.joint_weights, np.float64)
    total = weights.sum(axis=1, keepdims=True)
    if (total > 0.0).all():
        return weights / total
    first = np.zeros_like(weights)
    first[:, :1] = 1.0
    return np.divide(weights, total, out=first, where=total > 0.0)


def _blended(mesh: Mesh, joints: np.ndarray) -> np.ndarray:
    """Return the weighted mean of each vertex's joint matrices, float64 [vertex, 3, 4]."""
    rows, shares, of = joints[:, :3].reshape(-1, 12), joint_shares(mesh), np.asarray(mesh.joints)
    blend, part = np.empty((len(of), 12)), np.empty((len(of), 12))
    for k in range(of.shape[1]):
        target = part if k else blend
        np.take(rows, of[:, k], axis=0, out=target, mode="clip")  # into a buffer: faster than rows[of[:, k]]
        target *= shares[:, k : k + 1]
        if k:
            blend += part
    return blend.reshape(-1, 3, 4)


def _turned(blend: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Return unit normals turned by a matrix each, float32 [vertex, 3]; see ``transform_normals``."""
    a, b, c = (blend[:, row, :3] for row in range(3))
    n = np.nan_to_num(np.asarray(normals, np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    rows = [_cross(b, c), _cross(c, a), _cross(a, b)]
    moved = np.stack([np.einsum("vi,vi->v", row, n) for row in rows], axis=1)
    moved *= np.where(np.einsum("vi,vi->v", a, rows[0]) < 0.0, -1.0, 1.0)[:, None]
    length = np.sqrt(np.einsum("vi,vi->v", moved, moved))[:, None]
    return np.divide(moved, length, out=np.zeros_like(moved), where=length > 1e-12).astype(np.float32)


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return cross products of rows [n, 3]; np.cross takes three times as long."""
    (x, y, z), (u, v, w) = a.T, b.T
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=1)


# ---- checks ----


def check_deformation(node: Node, nodes: Sequence[Node]) -> None:
    """Raise SceneError for a skin, joints of vertices or morphs that do not fit together."""
    owner = f"node {node.name!r}"
    if node.skin is not None:
        _check_skin(node.skin, nodes, f"skin {node.skin.name!r} of {owner}")
    if node.morphs is not None:
        _check_morphs(node.morphs, owner)
    for mesh in node.meshes:
        name = f"mesh {mesh.name!r} of {owner}"
        if node.skin is not None:
            check_joints(mesh, len(node.skin.joints), name)
        if node.morphs is not None:
            if len(mesh.targets) != len(node.morphs[0].weights):
                raise SceneError(
                    f"{name}: has {len(mesh.targets)} morph targets and {len(node.morphs[0].weights)} weights"
                )
            for number, target in enumerate(mesh.targets):
                for label in ("points", "normals"):
                    values = getattr(target, label)
                    if values is not None and np.shape(values) != (len(mesh.points), 3):
                        raise SceneError(
                            f"{name}: {label} of morph target {number} must be [{len(mesh.points)}, 3],"
                            f" got {list(np.shape(values))}"
                        )
                    if values is not None and not np.isfinite(values).all():
                        raise SceneError(f"{name}: {label} of morph target {number} must be finite")


def _check_skin(skin: Skin, nodes: Sequence[Node], owner: str) -> None:
    matrices = np.asarray(skin.joint_from_mesh)
    if not len(skin.joints) or matrices.shape != (len(skin.joints), 4, 4) or not np.isfinite(matrices).all():
        raise SceneError(
            f"{owner}: needs at least one joint, and a finite 4x4 matrix for each of {len(skin.joints)},"
            f" got joint_from_mesh {list(matrices.shape)}"
        )
    wrong = [joint for joint in skin.joints if not 0 <= joint < len(nodes)]
    if wrong:
        raise SceneError(f"{owner}: joint {wrong[0]} is no node (0 to {len(nodes) - 1})")


def check_joints(mesh: Mesh, joint_count: int, owner: str) -> None:
    """Raise SceneError unless every vertex of a mesh has joints, fewer than ``joint_count``, and weights of them."""
    if mesh.joints is None or mesh.joint_weights is None:
        raise SceneError(f"{owner}: has a skin and needs joints and joint_weights")
    joints, weights = np.asarray(mesh.joints), np.asarray(mesh.joint_weights)
    shape = joints.shape
    if len(shape) != 2 or shape[0] != len(mesh.points) or shape[1] < 1 or joints.dtype.kind not in "iu":
        raise SceneError(
            f"{owner}: joints must be integers [{len(mesh.points)}, influence], got {joints.dtype} {list(shape)}"
        )
    if weights.shape != shape or not (np.isfinite(weights).all() and (weights >= 0.0).all()):
        raise SceneError(f"{owner}: joint_weights must be {list(shape)} finite numbers from 0 up")
    if joints.size and not 0 <= joints.min() <= joints.max() < joint_count:
        wrong = int(joints.min()) if joints.min() < 0 else int(joints.max())
        raise SceneError(f"{owner}: joint {wrong} is out of range, the skin has {joint_count}")


def _check_morphs(morphs: Sequence[MorphKeyframe], owner: str) -> None:
    if not morphs:
        raise SceneError(f"{owner}: expected at least one morph keyframe, got none")
    counts = {len(key.weights) for key in morphs}
    times = np.array([key.time for key in morphs], np.float64)
    if len(counts) > 1:
        raise SceneError(f"{owner}: morph keyframes have {min(counts)} to {max(counts)} weights; expected as many each")
    if not (np.isfinite(times).all() and all(np.isfinite(key.weights).all() for key in morphs)):
        raise SceneError(f"{owner}: times and weights of morph keyframes must be finite")
    if not (np.diff(times) > 0.0).all():
        raise SceneError(f"{owner}: times of morph keyframes must rise")
