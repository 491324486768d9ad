"""The scene: nodes with meshes, lights, an environment, cameras, and the buffers kernels read."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_gi.color import SRGB_TO_LINEAR
from warp_gi.errors import SceneError, unknown_name
from warp_gi.forks import Guard
from warp_gi.kernels import types
from warp_gi.launch import get_device, on_device
from warp_gi.scene import animation, emitters, geometry, textures
from warp_gi.scene.edits import Edits
from warp_gi.scene.model import Keyframe, Material, Node, PunctualLight

if TYPE_CHECKING:
    from warp_gi.scene.camera import Camera
    from warp_gi.scene.environment import Environment

POSES_FOR_BOUNDS = 33
"""Evenly spaced poses, beside those of the keyframes, that the bounds of an animated scene enclose."""


class Scene:
    """Everything that is rendered. Lengths in metres, y up, colours linear Rec. 709.

    Args:
        nodes: Placements of meshes; parents before children. The scene keeps copies of the nodes, not of the meshes.
        lights: Lights without size.
        environment: The sky: a path to a map, an RGB radiance, an Environment, a SunSky, or None for black.
        cameras: Cameras by name, in world space, at time 0.
        name: Shown in reports.
        camera_nodes: Which node carries a camera, by the camera's name, for cameras that move with a node.

    Raises SceneError if anything in it cannot be rendered: one line that names the mesh, material or light.

    What pictures are made from is copied: geometry when the scene is made, and by ``animate``; materials, textures and
    lights when it is first used on a device. An edit after that is a SceneError at the next frame, see
    ``check_unchanged``. What works at any time is ``animate`` and an assignment of ``environment``.
    """

    def __init__(
        self,
        nodes: Sequence[Node],
        lights: Sequence[PunctualLight] = (),
        environment: Any = None,
        cameras: Mapping[str, Camera] | None = None,
        name: str = "scene",
        camera_nodes: Mapping[str, int] | None = None,
    ) -> None:
        self._guard = Guard()
        self.name = name
        self.version = 0
        """Counts up when the environment or the animation is replaced: what was derived from the scene is stale."""
        self.nodes: list[Node] = [replace(node) for node in nodes]
        self.lights: list[PunctualLight] = list(lights)
        self.cameras: dict[str, Camera] = dict(cameras or {})
        self.camera_nodes: dict[str, int] = dict(camera_nodes or {})
        geometry.check_nodes(self.nodes)
        self.materials: list[Material] = geometry.distinct_materials(self.nodes)
        for light in self.lights:
            emitters.check_light(light, self.nodes)
        self._flatten()
        self._environment: Environment | None = None
        self.environment = environment

    def _flatten(self) -> None:
        """Build what follows from the nodes; call again when keyframes change."""
        self.version += 1
        self._moving = animation.moving_nodes(self.nodes)
        self._world = [matrix.copy() for matrix in animation.world_matrices(self.nodes, 0.0)]
        self._flat = geometry.flatten(self.nodes, self.materials, self._world)
        if not np.isfinite(self._flat.points).all():
            raise SceneError(f"scene {self.name!r}: node transforms move vertices past the range of float32")
        self._emissive, self._triangle_powers = emitters.emissive_triangles(self._flat, self.materials)
        self._bounds = self._all_bounds()
        self._devices: dict[str, _DeviceScene] = {}
        self._geometry_hash: str | None = None
        self._contents_hash: str | None = None
        self._edits = Edits(self)

    # ---- what is in it ----

    @property
    def lock(self) -> Any:
        """A re-entrant lock: whoever holds it, as each frame and bake does, is the only one to move or edit the scene.

        Take it around ``update`` and what is read after it, where other threads render.
        """
        return self._guard.lock

    @property
    def environment(self) -> Environment | None:
        """The sky; set it to a path, an RGB radiance, an Environment, a SunSky or None. The geometry stays built."""
        return self._environment

    @environment.setter
    def environment(self, value: Any) -> None:
        if value is not None:
            from warp_gi.scene.environment import as_environment

            value = as_environment(value)
        with self.lock:
            self._environment = value
            self.version += 1
            for device_scene in self._devices.values():
                device_scene.set_environment(value)
            if self._devices:
                self._edits.sky_in_use()

    @property
    def triangle_count(self) -> int:
        """Number of triangles of all nodes together."""
        return len(self._flat.indices)

    @property
    def emitter_count(self) -> int:
        """Number of emissive triangles and punctual lights together."""
        return len(self._emissive) + len(self.lights)

    @property
    def bounds(self) -> np.ndarray:
        """Lowest and highest corner, float32 [2, 3], metres; of an animated scene over all of its time."""
        return self._bounds.copy()

    @property
    def radius(self) -> float:
        """Half the diagonal of the bounds, metres."""
        return float(np.linalg.norm(self._bounds[1].astype(np.float64) - self._bounds[0])) / 2.0

    @property
    def surface_area(self) -> float:
        """Of all triangles at time 0, one side of each [m^2]."""
        return geometry.surface_area(self._flat.points, self._flat.indices)

    @property
    def object_names(self) -> list[str]:
        """Names of the nodes with meshes, by object id."""
        return [node.name for node in self.nodes if node.meshes]

    @property
    def is_animated(self) -> bool:
        """Whether any node has keyframes."""
        return any(self._moving)

    @property
    def duration(self) -> float:
        """Time of the last keyframe in seconds; 0 if nothing moves."""
        return max(animation.key_times(self.nodes), default=0.0)

    @property
    def memory_bytes(self) -> int:
        """Bytes of the geometry, materials and textures on one device, without the ray query tree and the sky."""
        flat = self._flat
        arrays = (flat.points, flat.normals, flat.uvs, flat.indices, flat.materials, flat.objects)
        texels = {id(t.pixels): t.pixels.nbytes for t in textures.distinct_textures(self.materials)}
        per_triangle = 4 * self.triangle_count  # Geometry.emitters
        previous = flat.points.nbytes if self.is_animated else 0
        return sum(a.nbytes for a in arrays) + sum(texels.values()) + per_triangle + previous

    def emitter_powers(self) -> np.ndarray:
        """Return the power of each emitter [W, as luminance], float64 [emitter_count].

        Above zero for every emissive triangle; textures count by their mean under the triangle.
        """
        lights = [emitters.light_power(light, self.radius) for light in self.lights]
        return np.concatenate([self._triangle_powers, lights])

    @property
    def geometry_hash(self) -> str:
        """sha256 of all that decides visibility: triangles, alpha masks, animation."""
        if self._geometry_hash is None:
            digest = hashlib.sha256(b"warp_gi geometry 1")
            flat = self._flat
            masked = np.array([m.alpha_cutoff is not None for m in self.materials])
            _update(digest, flat.points, flat.indices)
            if masked.any():
                triangles = masked[flat.materials]
                _update(digest, triangles, flat.materials[triangles], flat.uvs[flat.indices[triangles]])
                for material in (m for m in self.materials if m.alpha_cutoff is not None):
                    texture = material.base_color_texture
                    _update(digest, np.array([material.alpha, material.alpha_cutoff]))
                    if texture is not None:
                        _update(digest, repr(texture.wrap), texture.pixels[..., 3])
            for index, node in enumerate(self.nodes):
                if self._moving[index]:
                    keys = [asdict(key) for key in node.keyframes or ()]
                    start, stop = self._flat.vertex_starts[index : index + 2]
                    _update(digest, repr((start, stop, node.parent, keys)), np.asarray(node.parent_from_node))
            self._geometry_hash = digest.hexdigest()
        return self._geometry_hash

    @property
    def hash(self) -> str:
        """sha256 of all that decides the pictures but the cameras; equal in every process."""
        digest = hashlib.sha256(self.contents_hash.encode())
        _update(digest, "no sky" if self._environment is None else self._environment.content_hash)
        return digest.hexdigest()

    @property
    def contents_hash(self) -> str:
        """sha256 of all that decides the pictures but cameras and sky.

        Kept: a sky that changes from frame to frame must not cost a pass over all textures.
        """
        if self._contents_hash is None:
            digest = hashlib.sha256(b"warp_gi scene 1" + self.geometry_hash.encode())
            flat = self._flat
            _update(digest, flat.normals, flat.uvs, flat.materials, flat.objects)
            images = textures.distinct_textures(self.materials)
            _update(digest, textures.material_table(self.materials, images))
            for image in images:
                _update(digest, repr((image.srgb, image.wrap)), image.pixels)
            world = animation.world_matrices(self.nodes, 0.0)
            _update(digest, emitters.emitter_table(self._emissive, self.lights, world))
            _update(digest, repr([light.node for light in self.lights]))
            self._contents_hash = digest.hexdigest()
        return self._contents_hash

    # ---- what moves ----

    def animate(self, node: str, keyframes: Sequence[Keyframe]) -> None:
        """Replace the pose of a node (in its parent's space) by keyframes; bakes and device buffers start afresh.

        Raises SceneError for bad keyframes or if several nodes have the name, OptionError if none has.
        """
        matches = [index for index, candidate in enumerate(self.nodes) if candidate.name == node]
        if not matches:
            raise unknown_name("node", node, {candidate.name for candidate in self.nodes})
        if len(matches) > 1:
            raise SceneError(f"{len(matches)} nodes are named {node!r}; give the one to animate a name of its own")
        animation.check_keyframes(keyframes, node)
        geometry.check_nodes(self.nodes)  # they are read anew, with every edit so far
        with self.lock:
            self.nodes[matches[0]].keyframes = list(keyframes)
            self._flatten()

    def moves(self, index: int) -> bool:
        """Return whether node ``index``, or one above it, has keyframes."""
        return self._moving[index]

    @property
    def moving_objects(self) -> dict[int, int]:
        """Node of each object (by object id) that can move."""
        objects = [index for index, node in enumerate(self.nodes) if node.meshes]
        return {number: index for number, index in enumerate(objects) if self._moving[index]}

    def node_box(self, index: int, time: float) -> np.ndarray:
        """Return a box around the meshes of node ``index`` at ``time`` [s]: low and high corner, float64 [2, 3]."""
        matrix, corners = self.world_from_node(index, time), []
        for mesh in self.nodes[index].meshes:
            corners.append(_box_corners(mesh))
        points = np.concatenate(corners).astype(np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
        return np.stack([points.min(axis=0), points.max(axis=0)])

    def world_from_node(self, index: int, time: float) -> np.ndarray:
        """Return the placement of node ``index`` at ``time`` [s], float64 [4, 4]."""
        return animation.world_matrices(self.nodes, time)[index]

    def update(self, time: float, previous_time: float | None = None, device: str | wp.Device | None = None) -> bool:
        """Move the buffers of ``data(device)`` to ``time`` [s]; return whether anything differs from the last call.

        ``previous_points`` get the pose of ``previous_time``, from which motion vectors
        follow; None is ``time``, no motion. Nothing is done for a scene without keyframes,
        and the tree is refit only if a vertex moved.
        """
        if not self.is_animated:
            return False
        with self.lock:
            self.data(device)
            return self._devices[_device(device).alias].move(time, time if previous_time is None else previous_time)

    # ---- what kernels read ----

    def data(self, device: str | wp.Device | None = None) -> types.SceneData:
        """Return the scene on a device, built at the first call and kept; at time 0 until ``update``.

        The alias tables of the emitters are empty: each light sampler fills its own.
        """
        device = _device(device)
        with self.lock:
            if device.alias not in self._devices:
                self._edits.check()
                self._devices[device.alias] = _DeviceScene(self, device)
                if len(self._devices) == 1:
                    self._edits.in_use()
            return self._devices[device.alias].data

    def placed_emitters(self, device: str | wp.Device | None = None) -> emitters.PlacedEmitters:
        """Return where the emitters of ``data(device)`` are, from the copy on the host: nothing is downloaded."""
        with self.lock:
            self.data(device)
            return self._devices[_device(device).alias].placed_emitters()

    def check_unchanged(self) -> None:
        """Raise SceneError if something was edited that pictures would not show: one line that says what, and the cure.

        Called for every frame. It reads all arrays of meshes and textures, and the pixels of the sky.
        """
        self._edits.check()

    def bvh(self, device: str | wp.Device | None = None) -> Any:
        """Return the TriangleBvh behind ``data(device)``."""
        self.data(device)
        return self._devices[_device(device).alias].bvh

    def resting_bvh(self, device: str | wp.Device | None = None) -> Any:
        """Return a TriangleBvh of what never moves; ``bvh`` itself if nothing does."""
        with self.lock:
            self.data(device)
            return self._devices[_device(device).alias].resting_bvh()

    def _all_bounds(self) -> np.ndarray:
        flat = self._flat
        used = np.unique(flat.indices) if len(flat.points) > 3 * len(flat.indices) else slice(None)
        boxes = [flat.points[used].min(axis=0), flat.points[used].max(axis=0)]
        if self.is_animated:
            times = {*np.linspace(0.0, self.duration, POSES_FOR_BOUNDS), *animation.key_times(self.nodes)}
            for world in (animation.world_matrices(self.nodes, time) for time in sorted(times)):
                for node, matrix, moving in zip(self.nodes, world, self._moving, strict=True):
                    for mesh in node.meshes if moving else ():
                        boxes.extend(geometry.transform_points(matrix, _box_corners(mesh)))
        return np.stack([np.min(boxes, axis=0), np.max(boxes, axis=0)]).astype(np.float32)


class _DeviceScene:
    """The buffers of a scene on one device, and the pose they are in."""

    def __init__(self, scene: Scene, device: wp.Device) -> None:
        from warp_gi.bvh import TriangleBvh
        from warp_gi.scene.masks import alpha_masks

        self.scene, self.device = scene, device
        self.world = self.previous_world = scene._world
        flat = scene._flat
        if scene.is_animated:
            flat = replace(flat, points=flat.points.copy(), normals=flat.normals.copy())
        self.flat = flat
        self.previous_points = flat.points.copy() if scene.is_animated else flat.points
        world = animation.world_matrices(scene.nodes, 0.0)  # lights need not be where they were when it was made
        self.emitters = emitters.emitter_table(scene._emissive, scene.lights, world)
        emitter_of = np.full(scene.triangle_count, -1, np.int32)
        emitter_of[scene._emissive] = np.arange(len(scene._emissive), dtype=np.int32)
        images = textures.distinct_textures(scene.materials)
        texture_rows, texels = textures.texture_table(images)

        data = types.SceneData()
        data.geometry.points = self._array(flat.points, wp.vec3)
        data.geometry.previous_points = (
            self._array(self.previous_points, wp.vec3) if scene.is_animated else data.geometry.points
        )
        data.geometry.normals = self._array(flat.normals, wp.vec3)
        data.geometry.uvs = self._array(flat.uvs, wp.vec2)
        data.geometry.indices = self._array(flat.indices, wp.vec3i)
        data.geometry.materials = self._array(flat.materials, wp.int32)
        data.geometry.objects = self._array(flat.objects, wp.int32)
        data.geometry.emitters = self._array(emitter_of, wp.int32)
        materials = textures.material_table(scene.materials, images)
        self.two_sided = materials["double_sided"][flat.materials[scene._emissive]] != 0
        data.materials = self._array(materials, types.Material)
        data.textures = self._array(texture_rows, types.Texture)
        data.texels = self._array(texels, wp.uint32)
        data.srgb_to_linear = self._array(SRGB_TO_LINEAR.copy(), wp.float32)
        data.emitters.count = len(self.emitters)
        data.emitters.emitters = self._array(self.emitters, types.Emitter)
        data.emitters.alias = wp.empty(0, dtype=types.AliasBucket, device=device)
        self._bound_emitters(data.emitters)
        low, high = scene.bounds
        data.center = wp.vec3(*(float(x) for x in (low.astype(np.float64) + high) / 2.0))
        data.radius = scene.radius
        masks = alpha_masks(flat, scene.materials, images, data.textures, data.texels)
        self.bvh = TriangleBvh(flat.points, flat.indices, device=device.alias, alpha=masks)
        self._masks, self._resting_bvh = masks, None
        data.bvh = self.bvh.data
        self.data = data
        self.set_environment(scene.environment)

    def resting_bvh(self) -> Any:
        if not self.scene.is_animated:
            return self.bvh
        if self._resting_bvh is None:
            from warp_gi.bvh import TriangleBvh

            rests = ~np.isin(self.flat.objects, list(self.scene.moving_objects))
            if not rests.any():
                raise SceneError("everything in this scene moves; nothing can be baked")
            masks = self._masks and replace(self._masks, face_mask=self._masks.face_mask[rests])
            self._resting_bvh = TriangleBvh(self.flat.points, self.flat.indices[rests], self.device.alias, masks)
        return self._resting_bvh

    def _array(self, values: np.ndarray, dtype: Any) -> wp.array:
        return on_device(values, dtype, self.device)

    def placed_emitters(self) -> emitters.PlacedEmitters:
        triangles = self.scene._emissive
        corners = self.flat.points[self.flat.indices[triangles]].astype(np.float64)
        return emitters.PlacedEmitters(self.emitters.copy(), corners, self.two_sided)

    def set_environment(self, environment: Environment | None) -> None:
        self.data.environment = types.Environment() if environment is None else environment.data(self.device)

    def move(self, time: float, previous_time: float) -> bool:
        """Bring points, normals and lights to ``time`` and previous points to ``previous_time``."""
        nodes, flat, target = self.scene.nodes, self.flat, self.data.geometry
        world = animation.world_matrices(nodes, time)
        previous_world = animation.world_matrices(nodes, previous_time)
        was, was_before = self.world, self.previous_world
        # until all is moved no pose is known: the next call after an interrupt or a fork places everything
        self.world = self.previous_world = [np.full((4, 4), np.nan)] * len(nodes)
        moved = changed = False
        for index, node in enumerate(nodes):
            start, stop = flat.vertex_starts[index : index + 2]
            if start == stop or not self.scene._moving[index]:
                continue
            if not np.array_equal(previous_world[index], was_before[index]):
                vertex = start
                for mesh in node.meshes:
                    end = vertex + len(mesh.points)
                    self.previous_points[vertex:end] = geometry.transform_points(previous_world[index], mesh.points)
                    vertex = end
                self._upload(target.previous_points, self.previous_points, start, stop)
                changed = True
            if not np.array_equal(world[index], was[index]):
                geometry.place(flat, node, world[index], start)
                self._upload(target.points, flat.points, start, stop)
                self._upload(target.normals, flat.normals, start, stop)
                moved = True
        if any(light.node is not None and self.scene._moving[light.node] for light in self.scene.lights):
            table = emitters.emitter_table(self.scene._emissive, self.scene.lights, world)
            changed |= not np.array_equal(table, self.emitters)
            self.emitters[:] = table
            self._upload(self.data.emitters.emitters, self.emitters, len(self.scene._emissive), len(self.emitters))
        if moved:
            self.bvh.refit(flat.points)
            self._bound_emitters(self.data.emitters)
        self.world, self.previous_world = world, previous_world
        return moved or changed

    def _bound_emitters(self, target: types.Emitters) -> None:
        """Set the box around all emissive triangles, larger by more than rays' rounding near and far of the origin."""
        if len(self.scene._emissive) == 0:
            target.lower, target.upper = wp.vec3(1.0, 1.0, 1.0), wp.vec3(-1.0, -1.0, -1.0)
            return
        corners = self.flat.points[self.flat.indices[self.scene._emissive]].reshape(-1, 3).astype(np.float64)
        margin = 1e-4 * self.scene.radius + 1e-6 * np.abs(corners).max()
        target.lower = wp.vec3(*(corners.min(axis=0) - margin))
        target.upper = wp.vec3(*(corners.max(axis=0) + margin))

    def _upload(self, target: wp.array, source: np.ndarray, start: int, stop: int) -> None:
        """Copy items from ``start`` to ``stop``; on the CPU target and source are the same memory."""
        if not self.device.is_cpu:
            target[start:stop].assign(source[start:stop])


def _box_corners(mesh: Any) -> np.ndarray:
    """Return the corners [8, 3] of the box around a mesh's points, in the space of its node."""
    box = np.stack([mesh.points.min(axis=0), mesh.points.max(axis=0)])
    return np.stack(np.meshgrid(*box.T, indexing="ij"), axis=-1).reshape(8, 3)


def _device(device: str | wp.Device | None) -> wp.Device:
    return device if isinstance(device, wp.Device) else get_device(device)


def _update(digest: Any, *parts: np.ndarray | str) -> None:
    """Add arrays (with their dtype and shape) and texts to a digest."""
    for part in parts:
        if isinstance(part, str):
            digest.update(part.encode())
        else:
            digest.update(repr((part.dtype.str if part.dtype.names is None else "", part.shape)).encode())
            digest.update(np.ascontiguousarray(part).view(np.uint8).reshape(-1).data)
