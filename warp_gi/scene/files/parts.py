"""The result of a file reader: the arguments of a Scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from warp_gi.scene.animation import moved_keyframes, turned_quaternion
from warp_gi.scene.files.support import Findings
from warp_gi.scene.model import Mesh, Node, PunctualLight
from warp_gi.scene.normals import smooth_mesh
from warp_gi.scene.pinhole import Camera
from warp_gi.scene.poses import deforms, poses, transform_normals


@dataclass(eq=False)
class SceneParts:
    """The contents of one file, before a Scene checks them."""

    nodes: list[Node]
    lights: list[PunctualLight] = field(default_factory=list)
    cameras: dict[str, Camera] = field(default_factory=dict)
    camera_nodes: dict[str, int] = field(default_factory=dict)
    findings: Findings = field(default_factory=Findings)
    """What the file uses and was not read in full."""
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    """What was taken from all positions, float64 [3]."""

    def middle(self) -> np.ndarray:
        """Return a point that half of the triangles lie before along each axis, float64 [3], at time 0."""
        places, _, counts = self._boxes
        if not len(places):
            return np.zeros(3)
        order = np.argsort(places, axis=0, kind="stable")
        sums = np.cumsum(counts[order], axis=0)
        return np.array([places[order[np.searchsorted(s, s[-1] / 2), k], k] for k, s in enumerate(sums.T)])

    def bounds(self) -> np.ndarray:
        """Return the lowest and highest corner around the boxes of all meshes, float64 [2, 3], at time 0."""
        middles, halves, _ = self._boxes
        if not len(middles):
            return np.zeros((2, 3))
        return np.stack([(middles - halves).min(axis=0), (middles + halves).max(axis=0)])

    @cached_property
    def _boxes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return middle and half size of each placed mesh's box, float64 [n, 3], and its triangles [n], at time 0.

        The box is one along the world's axes, around that along the mesh's own.
        """
        boxes: dict[int, np.ndarray] = {}
        found, matrices, counts = [], [], []
        for node, pose in zip(self.nodes, poses(self.nodes, 0.0), strict=True):
            for mesh in node.meshes:
                if deforms(node):
                    box, matrix = _box(mesh, pose.vertices(mesh)[0]), np.eye(4)
                else:
                    if id(mesh) not in boxes:
                        boxes[id(mesh)] = _box(mesh, np.asarray(mesh.points))
                    box, matrix = boxes[id(mesh)], pose.matrix
                if len(box):
                    found.append(box)
                    matrices.append(matrix)
                    counts.append(len(mesh.indices))
        ends, placed = np.array(found).reshape(-1, 2, 3), np.array(matrices).reshape(-1, 4, 4)
        middles = np.einsum("nij,nj->ni", placed[:, :3, :3], ends.mean(axis=1)) + placed[:, :3, 3]
        halves = np.einsum("nij,nj->ni", np.abs(placed[:, :3, :3]), (ends[:, 1] - ends[:, 0]) / 2)
        return middles, halves, np.array(counts)

    def _bare(self) -> set[int]:
        """Return the nodes that stand where their points are, alone, as those of files without a hierarchy do."""
        parents = {node.parent for node in self.nodes}
        joints = {joint for node in self.nodes if node.skin is not None for joint in node.skin.joints}
        return {
            index
            for index, node in enumerate(self.nodes)
            if node.parent is None
            and node.keyframes is None
            and node.skin is None
            and index not in parents
            and index not in joints
            and np.array_equal(node.parent_from_node, np.eye(4))
        }

    def _changed(self, linear: np.ndarray) -> dict[int, Node]:
        """Return the bare nodes with ``linear`` [3, 3], on their points, where keyframes leave it."""
        done: dict[int, Mesh] = {}

        def changed_mesh(mesh: Mesh) -> Mesh:
            if id(mesh) not in done:
                points = (np.asarray(mesh.points, np.float64) @ linear.T).astype(np.float32)
                normals = None if mesh.normals is None else transform_normals(linear, mesh.normals)
                done[id(mesh)] = replace(mesh, points=points, normals=normals)
            return done[id(mesh)]

        found = {}
        for index in self._bare():
            node = self.nodes[index]
            if not any(mesh.targets for mesh in node.meshes):
                x, y, z = (linear @ np.array(node.pivot)).tolist()
                found[index] = replace(node, meshes=[changed_mesh(mesh) for mesh in node.meshes], pivot=(x, y, z))
        return found

    def recentred(self, offset: np.ndarray) -> SceneParts:
        """Return the parts with ``offset`` taken from all positions, in double precision."""
        bare = self._bare()
        back = np.eye(4)
        back[:3, 3] = -offset

        def moved_node(index: int, node: Node) -> Node:
            if node.parent is not None:
                return node
            if index in bare:  # its points may be doubles: they are moved before the cast
                x, y, z = (offset + node.pivot).tolist()
                moved = [replace(mesh, points=mesh.points - offset) for mesh in node.meshes]
                return replace(node, meshes=moved, pivot=(x, y, z))
            keys = moved_keyframes(node.keyframes or (), -offset)
            return replace(node, parent_from_node=back @ node.parent_from_node, keyframes=keys or None)

        def moved_light(light: PunctualLight) -> PunctualLight:
            return (
                light if light.node is not None else replace(light, position=tuple(np.array(light.position) - offset))
            )

        return SceneParts(
            [moved_node(index, node) for index, node in enumerate(self.nodes)],
            [moved_light(light) for light in self.lights],
            {name: camera.relative_to(offset) for name, camera in self.cameras.items()},
            self.camera_nodes,
            self.findings,
            self.offset + offset,
        )

    def single(self) -> SceneParts:
        """Return the parts with points in float32, as meshes have them; readers may give doubles."""
        done: dict[int, Mesh] = {}
        for mesh in (mesh for node in self.nodes for mesh in node.meshes):
            if id(mesh) not in done:
                single = np.asarray(mesh.points).dtype == np.float32
                done[id(mesh)] = mesh if single else replace(mesh, points=np.asarray(mesh.points, np.float32))
        nodes = [replace(node, meshes=[done[id(mesh)] for mesh in node.meshes]) for node in self.nodes]
        return replace(self, nodes=nodes)

    def scaled(self, scale: float) -> SceneParts:
        """Return the parts with all lengths times ``scale``; intensities stay as they are."""
        grow = np.diag([scale, scale, scale, 1.0])
        bare = self._changed(grow[:3, :3])

        def scaled_node(index: int, node: Node) -> Node:
            if index in bare or node.parent is not None:
                return bare.get(index, node)
            keys = [
                replace(k, translation=tuple(scale * np.array(k.translation)), scale=tuple(scale * np.array(k.scale)))
                for k in node.keyframes or ()
            ]
            return replace(node, parent_from_node=grow @ node.parent_from_node, keyframes=keys or None)

        def scaled_light(light: PunctualLight) -> PunctualLight:
            position = light.position if light.node is not None else tuple(scale * np.array(light.position))
            return replace(light, position=position, range=None if light.range is None else scale * light.range)

        def scaled_camera(camera: Camera) -> Camera:
            offset = tuple(scale * np.array(camera.offset))
            width = scale * camera.ortho_width
            return replace(camera, world_from_camera=grow @ camera.world_from_camera, offset=offset, ortho_width=width)

        return SceneParts(
            [scaled_node(index, node) for index, node in enumerate(self.nodes)],
            [scaled_light(light) for light in self.lights],
            {name: scaled_camera(camera) for name, camera in self.cameras.items()},
            self.camera_nodes,
            self.findings,
            scale * self.offset,
        )

    def turned(self, rotation: np.ndarray) -> SceneParts:
        """Return the parts turned about the origin by a rotation [3, 3]."""
        turn = np.eye(4)
        turn[:3, :3] = rotation
        bare = self._changed(rotation)

        def turned_vector(vector: Sequence[float] | np.ndarray) -> tuple[float, float, float]:
            x, y, z = (rotation @ np.array(vector)).tolist()
            return x, y, z

        def turned_node(index: int, node: Node) -> Node:
            if index in bare or node.parent is not None:
                return bare.get(index, node)
            keys = [
                replace(k, translation=turned_vector(k.translation), rotation=turned_quaternion(rotation, k.rotation))
                for k in node.keyframes or ()
            ]
            return replace(node, parent_from_node=turn @ node.parent_from_node, keyframes=keys or None)

        def turned_light(light: PunctualLight) -> PunctualLight:
            if light.node is not None:
                return light
            return replace(light, position=turned_vector(light.position), direction=turned_vector(light.direction))

        def turned_camera(camera: Camera) -> Camera:
            matrix = turn @ camera.world_from_camera
            return replace(camera, world_from_camera=matrix, offset=turned_vector(camera.offset))

        return SceneParts(
            [turned_node(index, node) for index, node in enumerate(self.nodes)],
            [turned_light(light) for light in self.lights],
            {name: turned_camera(camera) for name, camera in self.cameras.items()},
            self.camera_nodes,
            self.findings,
            rotation @ self.offset,
        )

    def smoothed(self, angle: float) -> SceneParts:
        """Return the parts with crease-aware normals on the meshes that have none; see ``smooth_mesh``."""
        done: dict[int, Mesh] = {}

        def smoothed_mesh(mesh: Mesh) -> Mesh:
            if id(mesh) not in done:
                done[id(mesh)] = smooth_mesh(mesh, angle) if mesh.normals is None else mesh
            return done[id(mesh)]

        nodes = [replace(node, meshes=[smoothed_mesh(mesh) for mesh in node.meshes]) for node in self.nodes]
        return replace(self, nodes=nodes)


def _box(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Return low and high corner around the finite points of a mesh's triangles, float64 [2, 3]; [0] without any."""
    used = mesh.indices[(mesh.indices >= 0) & (mesh.indices < len(points))]
    corners = points[used]
    corners = corners[np.isfinite(corners).all(axis=1)]
    return np.array([corners.min(axis=0), corners.max(axis=0)] if len(corners) else [], np.float64)
