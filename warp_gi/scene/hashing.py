"""Hashes of what a scene holds: what decides visibility, and what decides the pictures."""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np

from warp_gi.scene import animation, emitters, textures
from warp_gi.scene.poses import deforms

if TYPE_CHECKING:
    from warp_gi.scene.contents import SceneContents
    from warp_gi.scene.environment import Environment
    from warp_gi.scene.model import Node


def geometry_hash(scene: SceneContents) -> str:
    """Return the SHA-256 of all that decides visibility: triangles, alpha masks, animation."""
    digest = hashlib.sha256(b"warp_gi geometry 1")
    flat = scene._flat
    masked = np.array([m.lets_rays_pass for m in scene.materials])
    _update(digest, flat.points, flat.indices)
    if masked.any():
        triangles = masked[flat.materials]
        _update(digest, triangles, flat.materials[triangles], flat.uvs[flat.indices[triangles]])
        if flat.colors is not None:
            _update(digest, flat.colors[flat.indices[triangles], 3])
        second = np.array(
            [
                m.is_glass and m.transmission_texture is not None and m.transmission_texture.uv_set != 0
                for m in scene.materials
            ]
        )[flat.materials]
        if flat.further_uvs is not None and second.any():
            _update(digest, flat.further_uvs[flat.indices[second]])
        for material in (m for m in scene.materials if m.lets_rays_pass):
            _update(digest, *textures.visibility_parts(material))
    for index, node in enumerate(scene.nodes):
        if scene._moving[index]:
            keys = [asdict(key) for key in node.keyframes or ()]
            start, stop = flat.vertex_starts[index : index + 2]
            _update(digest, repr((start, stop, node.parent, keys)), np.asarray(node.parent_from_node))
            if deforms(node):
                digest.update(shape_hash(node).encode())
                _update(digest, scene._poses[index].key)
    return digest.hexdigest()


def shape_hash(node: Node) -> str:
    """Return the SHA-256 of all that changes the shape of a node's meshes, but for the poses of its joints."""
    digest = hashlib.sha256(repr([(key.time, *key.weights) for key in node.morphs or ()]).encode())
    if node.skin is not None:
        _update(digest, repr(list(node.skin.joints)), np.asarray(node.skin.joint_from_mesh, np.float64))
    for mesh in node.meshes:
        if node.skin is not None:
            _update(digest, np.asarray(mesh.joints, np.int64), np.asarray(mesh.joint_weights, np.float64))
        for target in mesh.targets if node.morphs else ():
            for values in (target.points, target.normals):
                _update(digest, "none" if values is None else np.asarray(values, np.float64))
        _update(digest, np.asarray(mesh.points), "flat" if mesh.normals is None else np.asarray(mesh.normals))
    return digest.hexdigest()


class Hashes:
    """Hashes of a scene. They are kept once it is on a device: until then its materials and lights may be edited."""

    def __init__(self) -> None:
        self._geometry: str | None = None
        self._surfaces: hashlib._Hash | None = None

    def geometry(self, scene: SceneContents) -> str:
        """Return ``geometry_hash``."""
        found = geometry_hash(scene) if self._geometry is None else self._geometry
        if scene._devices:
            self._geometry = found
        return found

    def contents(self, scene: SceneContents) -> str:
        """Return the SHA-256 of all that decides the pictures, except cameras and sky. Lights are read anew."""
        found = _surfaces(scene, self.geometry(scene)) if self._surfaces is None else self._surfaces
        if scene._devices:
            self._surfaces = found
        return _with_lights(scene, found)


def _surfaces(scene: SceneContents, geometry: str) -> hashlib._Hash:
    """Return the digest of all that surfaces are, from the hash of the geometry."""
    digest = hashlib.sha256(b"warp_gi scene 1" + geometry.encode())
    flat = scene._flat
    _update(digest, flat.normals, flat.uvs, flat.materials, flat.objects)
    _update(digest, *(part for part in (flat.colors, flat.further_uvs) if part is not None))
    images = textures.distinct_textures(scene.materials)
    _update(digest, textures.material_table(scene.materials, images))
    for image in images:
        how = image.srgb, image.wrap, image.nearest, image.uv_set, image.transform
        _update(digest, repr(how), image.pixels)
    return digest


def _with_lights(scene: SceneContents, surfaces: hashlib._Hash) -> str:
    """Return the SHA-256 of surfaces and of the lights as they are now."""
    digest = surfaces.copy()
    world = animation.world_matrices(scene.nodes, 0.0)
    _update(digest, emitters.emitter_table(scene._emissive, scene.lights, world))
    _update(digest, repr([light.node for light in scene.lights]))
    return digest.hexdigest()


def with_sky(contents: str, sky: Environment | None) -> str:
    """Return the SHA-256 of a ``contents_hash`` and a sky; equal in every process."""
    digest = hashlib.sha256(contents.encode())
    _update(digest, "no sky" if sky is None else sky.content_hash)
    return digest.hexdigest()


def _update(digest: hashlib._Hash, *parts: np.ndarray | str) -> None:
    """Add arrays (with their dtype and shape) and texts to a digest."""
    for part in parts:
        if isinstance(part, str):
            digest.update(part.encode())
        else:
            digest.update(repr((part.dtype.str if part.dtype.names is None else "", part.shape)).encode())
            digest.update(np.ascontiguousarray(part).view(np.uint8).reshape(-1).data)
