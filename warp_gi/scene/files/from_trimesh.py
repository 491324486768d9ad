"""Scenes from trimesh's objects: meshes with their materials and colours, and scenes with their transforms."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from warp_gi.color import decode_srgb
from warp_gi.errors import SceneError
from warp_gi.scene.files.parts import SceneParts
from warp_gi.scene.files.support import Findings
from warp_gi.scene.model import Material, Mesh, Node, Texture

FAR_STEP, FAR_EXTENTS = 0.001, 2
"""Step of float32, and distance in sizes of a mesh, from which a mesh is far from its own origin."""


def is_trimesh(value: object) -> bool:
    """Return whether something is an object of trimesh, without importing it."""
    return any(kind.__module__.split(".")[0] == "trimesh" for kind in type(value).__mro__)


def trimesh_parts(value: Any) -> SceneParts:
    """Return what a ``trimesh.Trimesh`` or ``trimesh.Scene`` holds: a node a placement, in world space.

    Raises SceneError for other objects of trimesh.
    """
    reader = _Reader()
    if hasattr(value, "faces") and hasattr(value, "visual"):
        return SceneParts([Node(_name(value, "mesh"), [reader.mesh(value, "mesh")])], findings=reader.findings)
    if not hasattr(value, "graph") or not hasattr(value, "geometry"):
        raise SceneError(f"expected a trimesh.Trimesh or trimesh.Scene, got a {type(value).__name__}")
    nodes: list[Node] = []
    for name in value.graph.nodes_geometry:
        matrix, key = value.graph.get(name)
        geometry = value.geometry[key]
        if hasattr(geometry, "faces"):
            nodes.append(reader.placed(str(name), reader.mesh(geometry, str(key)), np.array(matrix, np.float64)))
        else:
            reader.findings.add("points and lines", f"geometry {key!r}")
    return SceneParts(nodes, findings=reader.findings)


class _Reader:
    """Makes each mesh, material and texture once."""

    def __init__(self) -> None:
        self.findings = Findings()
        self._meshes: dict[int, Mesh] = {}
        self._near: dict[int, tuple[Mesh, np.ndarray]] = {}
        self._materials: dict[int, Material] = {}
        self._textures: dict[tuple[int, bool], Texture] = {}

    def mesh(self, source: Any, name: str) -> Mesh:
        if id(source) not in self._meshes:
            self._meshes[id(source)] = self._read(source, name)
        return self._meshes[id(source)]

    def placed(self, name: str, mesh: Mesh, placement: np.ndarray) -> Node:
        """Return the node of a mesh, so that points keep their digits when they become float32.

        Of one that lies far from its own origin under a transform, the middle goes into the placement.
        """
        if np.array_equal(placement, np.eye(4)) or not len(mesh.points) or not np.isfinite(mesh.points).all():
            return Node(name, [mesh], placement)
        if id(mesh) not in self._near:
            low, high = mesh.points.min(axis=0), mesh.points.max(axis=0)
            middle = np.round((low + high) / 2)
            farthest = np.abs([low, high]).max()
            is_far = np.spacing(np.float32(farthest)) > FAR_STEP and farthest > FAR_EXTENTS * (high - low).max()
            self._near[id(mesh)] = (replace(mesh, points=mesh.points - middle) if is_far else mesh), middle * is_far
        near, middle = self._near[id(mesh)]
        shift = np.eye(4)
        shift[:3, 3] = middle
        x, y, z = middle.tolist()
        return Node(name, [near], placement @ shift, pivot=(x, y, z))

    def _read(self, source: Any, name: str) -> Mesh:
        visual = source.visual
        points, indices = np.asarray(source.vertices), np.asarray(source.faces)
        normals = _given_normals(source)
        uvs, colors, material = getattr(visual, "uv", None), None, None
        if getattr(visual, "kind", None) == "vertex":
            colors = _linear(visual.vertex_colors)
        elif getattr(visual, "kind", None) == "face":
            points, indices = points[indices].reshape(-1, 3), np.arange(3 * len(indices)).reshape(-1, 3)
            colors, normals = np.repeat(_linear(visual.face_colors), 3, axis=0), None
        elif getattr(visual, "material", None) is not None:
            material = self._material(visual.material, name)
        plain = Material(name, (0.8,) * 3 if colors is None else (1.0,) * 3, specular=0.0)
        if colors is not None and (colors[:, 3] < 1.0).any():
            plain.alpha_blend = True
        if normals is not None and normals.shape != points.shape:
            normals = None
        return Mesh(
            points,
            indices.astype(np.int32),
            material or plain,
            normals,
            None if uvs is None or len(uvs) != len(points) else np.asarray(uvs, np.float32)[:, :2],
            _name(source, name),
            colors=colors,
        )

    def _material(self, source: Any, name: str) -> Material:
        if id(source) not in self._materials:
            physical = source if hasattr(source, "baseColorFactor") else source.to_pbr()
            self._materials[id(source)] = self._convert(physical, str(getattr(source, "name", None) or name))
        return self._materials[id(source)]

    def _convert(self, source: Any, name: str) -> Material:
        """Return a trimesh PBRMaterial, whose factors are 8-bit or from 0 to 1, as a material."""
        red, green, blue, alpha = _factors(source.baseColorFactor, 4)
        emission = _factors(source.emissiveFactor, 3, 0.0 if source.emissiveTexture is None else 1.0)
        mode = source.alphaMode or "OPAQUE"
        cutoff = 0.5 if source.alphaCutoff is None else float(source.alphaCutoff)
        textures = source.metallicRoughnessTexture
        return Material(
            name,
            (red, green, blue),
            alpha,
            metallic=_factor(source.metallicFactor, 0.0 if textures is None else 1.0),
            roughness=_factor(source.roughnessFactor, 1.0),
            emission=(emission[0], emission[1], emission[2]),
            base_color_texture=self._texture(source.baseColorTexture, True),
            metallic_roughness_texture=self._texture(textures, False),
            normal_texture=self._texture(source.normalTexture, False),
            emission_texture=self._texture(source.emissiveTexture, True) if any(emission) else None,
            alpha_cutoff=cutoff if mode == "MASK" else None,
            alpha_blend=mode == "BLEND",
            double_sided=source.doubleSided is not False,
        )

    def _texture(self, image: Any, srgb: bool) -> Texture | None:
        if image is None:
            return None
        if (id(image), srgb) not in self._textures:
            self._textures[id(image), srgb] = Texture("image", np.array(image.convert("RGBA")), srgb)
        return self._textures[id(image), srgb]


def _given_normals(source: Any) -> np.ndarray | None:
    """Return the normals of vertices that a mesh of trimesh was given, float32 [n, 3], or None.

    They lie in its cache, as do those that trimesh computes when somebody looks at ``vertex_normals``; these are
    computed again to tell them apart.
    """
    cache: Any = getattr(source, "_cache", {})
    given = cache["vertex_normals"] if "vertex_normals" in cache else None
    if given is None:
        return None
    from trimesh import Trimesh

    fresh = Trimesh(np.array(source.vertices), np.array(source.faces), process=False).vertex_normals
    if np.shape(given) == np.shape(fresh) and np.allclose(given, fresh, rtol=0.0, atol=1e-12, equal_nan=True):
        return None
    return np.asarray(given, np.float32)


def _name(source: Any, otherwise: str) -> str:
    metadata = getattr(source, "metadata", None)
    found = metadata.get("name") if isinstance(metadata, Mapping) else None
    return str(found or otherwise)


def _linear(colors: Any) -> np.ndarray:
    """Return trimesh's 8-bit sRGB colours as linear ones with coverage, float32 [n, 4]."""
    coded = np.asarray(colors, np.float64) / 255.0
    return np.concatenate([decode_srgb(coded[:, :3]), coded[:, 3:]], axis=1).astype(np.float32)


def _factor(value: Any, default: float) -> float:
    return default if value is None else float(value)


def _factors(values: Any, count: int, default: float = 1.0) -> tuple[float, ...]:
    """Return ``count`` factors, which trimesh keeps as whole numbers up to 255 or as floats up to 1."""
    if values is None:
        return (default,) * count
    given = np.asarray(values)
    numbers = given / 255.0 if given.dtype.kind in "iu" else given.astype(np.float64)
    return tuple([*numbers.tolist(), *[1.0] * count][:count])
