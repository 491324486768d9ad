"""glTF 2.0 and GLB files: hierarchy, meshes, materials, cameras, punctual lights and node animation.

What the format has and this reader does not use (skins, morph targets, vertex colours,
orthographic cameras, unknown extensions) is left out; unknown extensions that a file
requires are an error. ``alphaMode`` BLEND becomes a mask with a cutoff of 0.5. Intensities
of punctual lights are taken as radiometric numbers (W/sr, W/m^2) without conversion.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib

from warp_gi.errors import OptionError, SceneError
from warp_gi.scene.animation import moving_nodes, pose_matrix, world_matrices
from warp_gi.scene.files.gltf_animation import read_keyframes
from warp_gi.scene.files.gltf_buffers import Buffers, split_glb
from warp_gi.scene.files.gltf_materials import MaterialReader, texture_transform
from warp_gi.scene.files.parts import SceneParts
from warp_gi.scene.model import Mesh, Node, PunctualLight
from warp_gi.scene.pinhole import Camera

KNOWN_EXTENSIONS = {
    "KHR_lights_punctual",
    "KHR_materials_emissive_strength",
    "KHR_materials_specular",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
}
CAMERA_HEIGHT = 540  # pixels; a glTF camera has a shape but no resolution
TRIANGLES, TRIANGLE_STRIP, TRIANGLE_FAN = 4, 5, 6


def read_gltf(path: Path) -> SceneParts:
    """Read a .glb or .gltf file; raises SceneError."""
    data = path.read_bytes()
    text, binary = split_glb(memoryview(data), path) if path.suffix.lower() == ".glb" else (data, None)
    document = pygltflib.GLTF2.from_json(text.decode("utf-8-sig"), infer_missing=True)
    unknown = sorted(set(document.extensionsRequired or ()) - KNOWN_EXTENSIONS)
    if unknown:
        raise SceneError(f"{str(path)!r} requires {', '.join(unknown)}, which is not supported; export it without")
    return _Reader(document, Buffers(document, path, binary), path).parts()


class _Reader:
    def __init__(self, document: pygltflib.GLTF2, buffers: Buffers, path: Path) -> None:
        self.document, self.buffers, self.path = document, buffers, path
        self.materials = MaterialReader(document, buffers)
        self.meshes: dict[int, list[Mesh]] = {}

    def parts(self) -> SceneParts:
        """Return nodes in depth-first order, with what hangs on them."""
        keyframes = read_keyframes(self.document, self.buffers)
        nodes: list[Node] = []
        sources: list[pygltflib.Node] = []
        names: set[str] = set()
        pending: list[tuple[int, int | None]] = [(index, None) for index in reversed(self._roots())]
        seen: set[int] = set()
        while pending:
            index, parent = pending.pop()
            if index in seen:
                raise SceneError(f"{str(self.path)!r}: node {index} hangs on two parents or on itself")
            seen.add(index)
            source = self.document.nodes[index]
            name = _unique(source.name or f"node {index}", names)
            meshes = self._mesh(source.mesh) if source.mesh is not None else []
            pending.extend((child, len(nodes)) for child in reversed(source.children or []))
            nodes.append(Node(name, list(meshes), _local_matrix(source), parent, keyframes.get(index)))
            sources.append(source)
        return self._with_lights_and_cameras(nodes, sources)

    def _roots(self) -> list[int]:
        scenes = self.document.scenes
        if scenes:
            return list(scenes[self.document.scene or 0].nodes or [])
        children = {child for node in self.document.nodes for child in node.children or []}
        return [index for index in range(len(self.document.nodes)) if index not in children]

    def _mesh(self, index: int) -> list[Mesh]:
        if index not in self.meshes:
            source = self.document.meshes[index]
            name = source.name or f"mesh {index}"
            meshes = (self._primitive(primitive, name) for primitive in source.primitives)
            self.meshes[index] = [mesh for mesh in meshes if mesh is not None]
        return self.meshes[index]

    def _primitive(self, source: pygltflib.Primitive, name: str) -> Mesh | None:
        """Return one primitive as a mesh, or None if it is not made of triangles."""
        mode = TRIANGLES if source.mode is None else source.mode
        position = getattr(source.attributes, "POSITION", None)
        if mode not in (TRIANGLES, TRIANGLE_STRIP, TRIANGLE_FAN) or position is None:
            return None
        points = np.ascontiguousarray(self.buffers.accessor(position), np.float32)
        corners = np.arange(len(points)) if source.indices is None else self.buffers.accessor(source.indices)
        if mode == TRIANGLES and len(corners) % 3:
            raise SceneError(f"{str(self.path)!r}: mesh {name!r} has {len(corners)} indices, not a multiple of 3")
        uvs = None
        if source.material is not None:
            coordinates, transform = texture_transform(self.document.materials[source.material])
            accessor = getattr(source.attributes, f"TEXCOORD_{coordinates}", None)
            if accessor is not None:
                uvs = self.buffers.accessor(accessor) @ transform[:2, :2].T.astype(np.float32) + transform[:2, 2]
                uvs = np.stack([uvs[:, 0], 1.0 - uvs[:, 1]], axis=1).astype(np.float32)
        normal = getattr(source.attributes, "NORMAL", None)
        return Mesh(
            points,
            _triangles(corners.astype(np.int64), mode),
            self.materials.material(source.material),
            None if normal is None else np.ascontiguousarray(self.buffers.accessor(normal), np.float32),
            uvs,
            name,
        )

    def _with_lights_and_cameras(self, nodes: list[Node], sources: list[pygltflib.Node]) -> SceneParts:
        parts = SceneParts(nodes)
        moving, world = moving_nodes(nodes), world_matrices(nodes, 0.0)
        described = (self.document.extensions or {}).get("KHR_lights_punctual", {}).get("lights", [])
        for index, source in enumerate(sources):
            extension = (source.extensions or {}).get("KHR_lights_punctual")
            if extension is not None:
                light = _light(described[extension["light"]], nodes[index].name)
                parts.lights.append(replace(light, node=index) if moving[index] else _placed(light, world[index]))
            if source.camera is not None and self.document.cameras[source.camera].perspective is not None:
                lens = self.document.cameras[source.camera].perspective
                aspect = lens.aspectRatio or 16.0 / 9.0
                hfov = 2.0 * math.degrees(math.atan(math.tan(lens.yfov / 2.0) * aspect))
                name = self.document.cameras[source.camera].name or nodes[index].name
                name = _unique(name, set(parts.cameras))
                resolution = (max(1, round(CAMERA_HEIGHT * aspect)), CAMERA_HEIGHT)
                try:
                    parts.cameras[name] = Camera(world[index], hfov, resolution, name)
                except OptionError as error:
                    warnings.warn(f"{str(self.path)!r}: {error}; it is left out", stacklevel=2)
                    continue
                parts.camera_nodes[name] = index
        return parts


def _unique(name: str, taken: set[str]) -> str:
    """Return ``name``, with a number if it is taken, and take it."""
    result, number = name, 1
    while result in taken:
        number += 1
        result = f"{name} {number}"
    taken.add(result)
    return result


def _local_matrix(source: pygltflib.Node) -> np.ndarray:
    if source.matrix:
        return np.array(source.matrix, np.float64).reshape(4, 4).T
    rest = (source.translation or (0.0,) * 3, source.rotation or (0.0, 0.0, 0.0, 1.0), source.scale or (1.0,) * 3)
    return pose_matrix(*rest)


def _triangles(corners: np.ndarray, mode: int) -> np.ndarray:
    """Return int32 [triangle, 3] of a list, strip or fan of vertices."""
    if mode == TRIANGLES:
        return corners.reshape(-1, 3).astype(np.int32)
    count = max(len(corners) - 2, 0)
    first = np.arange(count)
    if mode == TRIANGLE_FAN:
        rows = np.stack([first + 1, first + 2, np.zeros_like(first)], axis=1)
    else:
        odd = first % 2
        rows = np.stack([first, first + 1 + odd, first + 2 - odd], axis=1)
    return corners[rows].reshape(-1, 3).astype(np.int32)


def _light(source: Mapping[str, Any], name: str) -> PunctualLight:
    intensity = tuple(float(x) * source.get("intensity", 1.0) for x in source.get("color", (1.0, 1.0, 1.0)))
    spot = source.get("spot", {})
    return PunctualLight(
        source.get("type", "point"),
        intensity,
        inner_cone=spot.get("innerConeAngle", 0.0),
        outer_cone=spot.get("outerConeAngle", math.pi / 4),
        range=source.get("range"),
        name=source.get("name") or name,
    )


def _placed(light: PunctualLight, world_from_node: np.ndarray) -> PunctualLight:
    """Return a light that does not move in world space."""
    direction = -world_from_node[:3, 2] / np.linalg.norm(world_from_node[:3, 2])
    return replace(light, position=tuple(world_from_node[:3, 3].tolist()), direction=tuple(direction.tolist()))
