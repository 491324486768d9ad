"""Hashes of what a scene holds: what decides visibility, and what decides the pictures."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import asdict
from typing import TYPE_CHECKING, Protocol

import numpy as np

from warp_gi.scene import animation, emitters, textures
from warp_gi.scene.poses import deforms

if TYPE_CHECKING:
    from warp_gi.scene.contents import SceneContents
    from warp_gi.scene.environment import Environment
    from warp_gi.scene.model import Node, Texture


def geometry_digest(scene: SceneContents) -> hashlib._Hash:
    """Return a SHA-256 of what decides visibility at time 0, for ``with_motion``: triangles and alpha masks."""
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
    return digest


def with_motion(still: hashlib._Hash, scene: SceneContents) -> str:
    """Return the SHA-256 of all that decides visibility: of ``geometry_digest``, and animation as nodes have it."""
    digest = still.copy()
    world = animation.world_matrices(scene.nodes, 0.0) if any(scene._moving) else []
    for index, node in enumerate(scene.nodes):
        if scene._moving[index]:
            keys = [asdict(key) for key in node.keyframes or ()]
            start, stop = scene._flat.vertex_starts[index : index + 2]
            _update(digest, repr((start, stop, node.parent, keys)), np.asarray(node.parent_from_node))
            if deforms(node):
                digest.update(shape_hash(node).encode())
                _update(digest, scene._poses[index].key)
            if not np.array_equal(world[index], scene._poses[index].matrix):  # edited: the triangles are where it was
                _update(digest, world[index])
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


class Digests:
    """Hashes of a scene, each computed when it is asked for; on a device it is kept until what it is of changes.

    A colour in a loop, or a sky that changes from frame to frame, must not cost a pass over all textures. Before
    there is a device, materials and lights may be edited, and nobody looks for that.
    """

    def __init__(self, scene: SceneContents) -> None:
        self._scene = scene
        self._known: dict[str, str] = {}
        self._still: hashlib._Hash | None = None
        self._light: str | None = None

    def forget(self, *names: str) -> None:
        """Compute some anew when they are asked for: "geometry", "normals", "surfaces", "images", "light".

        "motion" is that of the geometry as far as keyframes decide it. That of all contents is computed anew too.
        """
        if "geometry" in names:
            self._still = None
        names = tuple("geometry" if name == "motion" else name for name in names)
        for name in (*names, "contents"):
            self._known.pop(name, None)
        if "light" in names:
            self._light = None

    def geometry(self) -> str:
        """Return the hash of all that decides visibility."""
        return self._once("geometry", self._geometry)

    def contents(self) -> str:
        """Return the hash of all that decides the pictures, except cameras and sky."""
        return self._once("contents", self._contents)

    def light(self) -> str:
        """Return ``contents`` as it was before nodes and points were moved by edits."""
        if self._light is not None:
            return self._light
        found = self.contents()
        if self._scene._devices:
            self._light = found
        return found

    def _once(self, name: str, compute: Callable[[], str]) -> str:
        if name in self._known:
            return self._known[name]
        found = compute()
        if self._scene._devices:
            self._known[name] = found
        return found

    def _geometry(self) -> str:
        still = self._still or geometry_digest(self._scene)
        if self._scene._devices:
            self._still = still
        return with_motion(still, self._scene)

    def _contents(self) -> str:
        scene, flat = self._scene, self._scene._flat
        images = textures.distinct_textures(scene.materials)
        surfaces = [flat.uvs, flat.materials, flat.objects]
        surfaces += [part for part in (flat.colors, flat.further_uvs) if part is not None]
        parts = (
            self._once("normals", lambda: _hash_of(flat.normals)),
            self._once("surfaces", lambda: _hash_of(*surfaces)),
            self._once("images", lambda: _hash_of(*(one for image in images for one in _image_parts(image)))),
        )
        digest = hashlib.sha256(b"warp_gi scene 2" + self.geometry().encode())
        _update(digest, *parts, textures.material_table(scene.materials, images))
        world = animation.world_matrices(scene.nodes, 0.0)
        _update(digest, emitters.emitter_table(scene._emissive, scene.lights, world))
        _update(digest, repr([light.node for light in scene.lights]))
        return digest.hexdigest()


def _image_parts(image: Texture) -> tuple[str, np.ndarray]:
    return repr((image.srgb, image.wrap, image.nearest, image.uv_set, image.transform)), image.pixels


def _hash_of(*parts: np.ndarray | str) -> str:
    digest = hashlib.sha256()
    _update(digest, *parts)
    return digest.hexdigest()


class Lit(Protocol):
    """A scene, or what is left of one, as ``light_of`` sees it."""

    @property
    def light_hash(self) -> str:
        """Hash of all but the sky, as it was before edits moved anything."""
        ...

    @property
    def contents_hash(self) -> str:
        """Hash of all but the sky."""
        ...

    @property
    def environment(self) -> Environment | None:
        """The present sky."""
        ...

    @property
    def is_sky_animated(self) -> bool:
        """Whether the sky changes over time."""
        ...


def light_of(scene: Lit) -> str:
    """Return a hash of a scene's light; of all but the sky where that changes over time, little by little.

    Nodes and points that edits move are left out, as those that keyframes move: what is kept over frames follows them.
    """
    return scene.light_hash if scene.is_sky_animated else with_sky(scene.light_hash, scene.environment)


def light_now(scene: Lit) -> str:
    """Return what ``light_of`` is in a process that makes the scene as it is now, all edits in it."""
    return scene.contents_hash if scene.is_sky_animated else with_sky(scene.contents_hash, scene.environment)


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
