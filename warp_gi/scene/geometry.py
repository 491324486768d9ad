"""All triangles of a scene in one set of world-space buffers."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from warp_gi.errors import SceneError
from warp_gi.scene.animation import check_keyframes
from warp_gi.scene.model import Material, Mesh, Node
from warp_gi.scene.poses import Pose, check_deformation
from warp_gi.scene.textures import check_material

LARGEST_UV = 1e9
"""Texture coordinate past which float32 carries no position; infinite ones would make NaN pixels."""


@dataclass(eq=False)
class FlatGeometry:
    """Every node's meshes one after another, in world space."""

    points: np.ndarray
    """Positions in metres, float32 [vertex, 3]."""
    normals: np.ndarray
    """Unit shading normals, or zero for flat shading, float32 [vertex, 3]."""
    uvs: np.ndarray
    """Texture coordinates, v up, float32 [vertex, 2]."""
    indices: np.ndarray
    """Vertices of each triangle, int32 [triangle, 3]."""
    materials: np.ndarray
    """Index in the scene's materials of each triangle's material, int32 [triangle]."""
    objects: np.ndarray
    """Object id of each triangle, int32 [triangle]; it counts the nodes that have meshes."""
    colors: np.ndarray | None
    """Linear colours and coverage, float32 [vertex, 4]; None if no mesh has any."""
    further_uvs: np.ndarray | None
    """Second set of texture coordinates, v up, float32 [vertex, 2]; None if no mesh has one."""
    vertex_starts: list[int]
    """First vertex of each node, and the number of vertices at the end."""
    mean_areas: np.ndarray | None = None
    """Area of each triangle as a mean over time, square metres, float64 [triangle]; None where no lamp changes its
    shape, and those of the points count."""


def check_nodes(nodes: Sequence[Node]) -> None:
    """Raise SceneError for a bad hierarchy, transform, keyframe or mesh, or if there is no triangle at all."""
    checked: set[int] = set()  # of a mesh that stands in many places once
    for index, node in enumerate(nodes):
        check_placement(node, index)
        if node.keyframes is not None:
            check_keyframes(node.keyframes, node.name)
        for mesh in node.meshes:
            if id(mesh) not in checked:
                check_mesh(mesh, f"mesh {mesh.name!r} of node {node.name!r}")
                checked.add(id(mesh))
        check_deformation(node, nodes)
    if not any(len(mesh.indices) for node in nodes for mesh in node.meshes):
        raise SceneError("the scene has no triangles; give at least one mesh with faces")


def check_placement(node: Node, index: int) -> None:
    """Raise SceneError unless a node has a finite matrix, and a parent before it, if any."""
    if node.parent is not None and not 0 <= node.parent < index:
        raise SceneError(f"node {node.name!r}: parent must stand before it (0 to {index - 1}), got {node.parent}")
    matrix = np.asarray(node.parent_from_node)
    if matrix.shape != (4, 4) or matrix.dtype.kind not in "biuf" or not np.isfinite(matrix).all():
        raise SceneError(f"node {node.name!r}: parent_from_node must be a finite 4x4 matrix, got {matrix.tolist()}")


def check_mesh(mesh: Mesh, owner: str) -> None:
    """Raise SceneError for wrong shapes, vertices that are not finite, and indices out of range."""
    points, indices = np.asarray(mesh.points), np.asarray(mesh.indices)
    if points.ndim != 2 or points.shape[1] != 3:
        raise SceneError(f"{owner}: points must be [vertex, 3], got shape {list(points.shape)}")
    if indices.ndim != 2 or indices.shape[1] != 3 or indices.dtype.kind not in "iu":
        raise SceneError(f"{owner}: indices must be integers [triangle, 3], got {indices.dtype} {list(indices.shape)}")
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        bad = int(np.argmin(finite))
        raise SceneError(
            f"{owner}: {np.count_nonzero(~finite)} of {len(points)} vertices are not finite (the first is vertex {bad},"
            f" {points[bad].tolist()}); mend or remove them"
        )
    if indices.size:
        low, high = int(indices.min()), int(indices.max())
        if low < 0 or high >= len(points):
            wrong = low if low < 0 else high
            raise SceneError(f"{owner}: index {wrong} is out of range, there are {len(points)} vertices")
    colors = mesh.colors
    if colors is not None:
        if np.shape(colors) not in ((len(points), 3), (len(points), 4)):
            raise SceneError(f"{owner}: colors must be [{len(points)}, 3] or 4, got {list(np.shape(colors))}")
        if not (np.min(colors, initial=0.0) >= 0.0 and np.max(colors, initial=0.0) <= 1.0):
            raise SceneError(f"{owner}: colors must be from 0 to 1, got {np.min(colors):g} to {np.max(colors):g}")
    for label, width in (("normals", 3), ("uvs", 2), ("further_uvs", 2)):
        values = getattr(mesh, label)
        if values is not None and np.shape(values) != (len(points), width):
            raise SceneError(f"{owner}: {label} must be [{len(points)}, {width}], got {list(np.shape(values))}")


def distinct_materials(nodes: Sequence[Node]) -> list[Material]:
    """Return the checked materials of all meshes, each once, in order of first use; raises SceneError."""
    found = list({id(mesh.material): mesh.material for node in nodes for mesh in node.meshes}.values())
    for material in found:
        check_material(material)
    return found


def surface_area(points: np.ndarray, indices: np.ndarray) -> float:
    """Return the area of triangles ``indices`` [n, 3] of ``points`` [m, 3], one side of each."""
    return float(triangle_areas(points, indices).sum())


def triangle_areas(points: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Return the area of each of the triangles ``indices`` [n, 3] of ``points`` [m, 3], float64 [n]."""
    corners = points[indices].astype(np.float64)
    sides = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return 0.5 * np.linalg.norm(sides, axis=1)


def flatten(nodes: Sequence[Node], materials: Sequence[Material], poses: Sequence[Pose]) -> FlatGeometry:
    """Return the triangles of all nodes in their poses.

    A mirroring transform turns its triangles' winding, so that fronts stay fronts.
    """
    vertex_count = sum(len(mesh.points) for node in nodes for mesh in node.meshes)
    triangle_count = sum(len(mesh.indices) for node in nodes for mesh in node.meshes)
    has_colors = any(mesh.colors is not None for node in nodes for mesh in node.meshes)
    has_further = any(mesh.further_uvs is not None for node in nodes for mesh in node.meshes)
    flat = FlatGeometry(
        points=np.empty((vertex_count, 3), np.float32),
        normals=np.zeros((vertex_count, 3), np.float32),
        uvs=np.zeros((vertex_count, 2), np.float32),
        indices=np.empty((triangle_count, 3), np.int32),
        materials=np.empty(triangle_count, np.int32),
        objects=np.empty(triangle_count, np.int32),
        colors=np.ones((vertex_count, 4), np.float32) if has_colors else None,
        further_uvs=np.zeros((vertex_count, 2), np.float32) if has_further else None,
        vertex_starts=[],
    )
    index_of = {id(material): index for index, material in enumerate(materials)}
    vertex = triangle = object_index = 0
    for node, pose in zip(nodes, poses, strict=True):
        flat.vertex_starts.append(vertex)
        for mesh in node.meshes:
            vertices = slice(vertex, vertex + len(mesh.points))
            triangles = slice(triangle, triangle + len(mesh.indices))
            if mesh.uvs is not None:
                flat.uvs[vertices] = _finite_uvs(mesh.uvs)
            if mesh.further_uvs is not None and flat.further_uvs is not None:
                flat.further_uvs[vertices] = _finite_uvs(mesh.further_uvs)
            if mesh.colors is not None and flat.colors is not None:
                flat.colors[vertices, : np.shape(mesh.colors)[1]] = mesh.colors
            flat.indices[triangles] = np.asarray(mesh.indices)[:, ::-1] if pose.mirrors(mesh) else mesh.indices
            flat.indices[triangles] += vertex
            if id(mesh.material) not in index_of:
                raise SceneError(
                    f"mesh {mesh.name!r} of node {node.name!r} has a material that the scene lacks; make a new scene"
                )
            flat.materials[triangles] = index_of[id(mesh.material)]
            flat.objects[triangles] = object_index
            vertex, triangle = vertices.stop, triangles.stop
        place(flat, node, pose, flat.vertex_starts[-1])
        object_index += bool(node.meshes)
    flat.vertex_starts.append(vertex)
    return flat


def is_copy(field: str, values: np.ndarray | None, copy: np.ndarray | None, place: slice) -> bool:
    """Return whether the flat geometry's field ``copy`` holds one mesh's values at a place."""
    none = 1.0 if field == "colors" else 0.0  # what stands there for a mesh without the field, where others have it
    if copy is None:
        return values is None or bool(np.all(values == none))
    return np.array_equal(np.full_like(copy[place], none) if values is None else values, copy[place])


def _finite_uvs(uvs: np.ndarray) -> np.ndarray:
    return np.clip(np.nan_to_num(uvs, nan=0.0, posinf=0.0, neginf=0.0), -LARGEST_UV, LARGEST_UV)


def place(flat: FlatGeometry, node: Node, pose: Pose, vertex: int) -> None:
    """Write points and normals of ``node``'s meshes in a pose from ``vertex`` on."""
    write(flat, (pose.vertices(mesh) for mesh in node.meshes), vertex)


def write(flat: FlatGeometry, pieces: Iterable[tuple[np.ndarray, np.ndarray | None]], vertex: int) -> None:
    """Write points and normals of meshes, one after another, from ``vertex`` on; no normals are flat shading."""
    for points, normals in pieces:
        end = vertex + len(points)
        flat.points[vertex:end] = points
        flat.normals[vertex:end] = 0.0 if normals is None else normals
        vertex = end


def placed_points(node: Node, pose: Pose) -> np.ndarray:
    """Return the points of ``node``'s meshes in a pose, one mesh after another, float32 [vertex, 3]."""
    return np.concatenate([pose.vertices(mesh)[0] for mesh in node.meshes])
