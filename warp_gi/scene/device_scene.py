"""The buffers of a scene on one device, as kernels read them."""

from __future__ import annotations

import weakref
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_gi.alias import AliasTable
from warp_gi.color import SRGB_TO_LINEAR
from warp_gi.errors import SceneError
from warp_gi.kernels import types
from warp_gi.launch import on_device
from warp_gi.scene import animation, emitters, geometry, textures
from warp_gi.scene.panes import Panes
from warp_gi.scene.poses import Pose, poses

if TYPE_CHECKING:
    from warp_gi.bvh import AlphaMasks, TriangleBvh
    from warp_gi.scene.contents import SceneContents
    from warp_gi.scene.environment import Environment
    from warp_gi.scene.model import Texture


UNKNOWN = Pose(np.full((4, 4), np.nan))
"""A pose that equals none, itself included: vertices are placed anew."""


@dataclass(eq=False)
class Trail:
    """Where a sequence of frames last saw the scene, on one device: its motion vectors lead there."""

    index: int
    """Number of the last frame."""
    poses: Sequence[Pose]
    """Poses of all nodes in it."""
    points: dict[int, np.ndarray] = field(default_factory=dict)
    """Vertices in it of nodes whose meshes got other points since, float32 [vertex, 3], by the node's index."""


class DeviceScene:
    """The buffers of a scene on one device, and the pose they are in."""

    def __init__(self, scene: SceneContents, device: wp.Device) -> None:
        from warp_gi.bvh import TriangleBvh
        from warp_gi.scene.masks import glass_tints

        self.scene, self.device = scene, device
        self.poses: Sequence[Pose] = scene._poses
        self.previous_poses: Sequence[Pose] = self.poses
        self.time = 0.0
        self.trails: weakref.WeakSet[Trail] = weakref.WeakSet()
        self.is_parted = False
        """Whether vertices are copies of the scene's own, which may then move, and previous ones apart from them."""
        self.flat = scene._flat
        self.previous_points = self.flat.points
        data = self.data = types.SceneData()
        data.geometry.points = data.geometry.previous_points = self._array(self.flat.points, wp.vec3)
        data.geometry.normals = self._array(self.flat.normals, wp.vec3)
        if scene.is_animated:
            self.part()
        flat = self.flat
        data.geometry.uvs = self._array(flat.uvs, wp.vec2)
        if flat.further_uvs is not None:
            data.geometry.further_uvs = self._array(flat.further_uvs, wp.vec2)
        if flat.colors is not None:
            data.geometry.colors = self._array(flat.colors, wp.vec4)
        data.geometry.indices = self._array(flat.indices, wp.vec3i)
        data.geometry.materials = self._array(flat.materials, wp.int32)
        data.geometry.objects = self._array(flat.objects, wp.int32)
        self.material_count = len(scene.materials)
        self._tints = glass_tints(scene.materials)
        self._set_textures()
        data.srgb_to_linear = self._array(SRGB_TO_LINEAR.copy(), wp.float32)
        self.relight()
        self.reframe()
        self._masks = self._new_masks()
        self.bvh = TriangleBvh(flat.points, flat.indices, device=device.alias, alpha=self._masks)
        self._static_bvh: TriangleBvh | None = None
        data.bvh = self.bvh.data
        self._set_panes()
        self.set_environment(scene.environment)

    def part(self) -> None:
        """Let vertices move: they become this device's own, and previous ones others than those of now."""
        if self.is_parted:
            return
        flat, target = self.scene._flat, self.data.geometry
        self.flat = replace(flat, points=flat.points.copy(), normals=flat.normals.copy())
        self.previous_points = flat.points.copy()
        target.points = self._array(self.flat.points, wp.vec3)
        target.normals = self._array(self.flat.normals, wp.vec3)
        target.previous_points = self._array(self.previous_points, wp.vec3)
        self.is_parted = True

    # ---- materials ----

    def _set_textures(self) -> None:
        """Make tables of materials and textures, and texels."""
        materials = self.scene.materials[: self.material_count]
        self.images = [*textures.distinct_textures(materials), *self._tints.values()]
        self._layout = _layout(self.images)
        rows, texels = textures.texture_table(self.images)
        self.data.textures = self._array(rows, types.Texture)
        self.data.texels = self._array(texels, wp.uint32)
        self._set_materials()

    def _set_materials(self) -> None:
        table = textures.material_table(self.scene.materials[: self.material_count], self.images)
        self.double_sided = table["double_sided"] != 0
        self.data.materials = self._array(table, types.Material)

    def shade(self, edited: Sequence[Texture], lets_rays_pass: bool) -> None:
        """Take over edits of materials, and of the textures ``edited``.

        ``lets_rays_pass`` says that a material which lets rays pass is among them, or did before.
        """
        from warp_gi.scene.masks import glass_tints

        materials = self.scene.materials[: self.material_count]
        if lets_rays_pass:
            self._tints = glass_tints(materials)
        images = [*textures.distinct_textures(materials), *self._tints.values()]
        is_same = [id(one) for one in images] == [id(one) for one in self.images]
        if is_same and _layout(images) == self._layout:
            self._set_texels(edited)
            self._set_materials()
        else:
            self._set_textures()
            lets_rays_pass |= self._masks is not None  # they look textures up
        if lets_rays_pass:
            self._masks, self._static_bvh = self._new_masks(), None
            self.bvh.set_alpha(self._masks)
            self.data.bvh = self.bvh.data
            self._set_panes()

    def _set_texels(self, edited: Sequence[Texture]) -> None:
        """Write some textures anew where they are; others may show the same pixels in another way."""
        shown = {id(texture.pixels) for texture in edited}
        rows, _ = textures.texture_table(self.images, with_texels=False)
        places = {id(one.pixels): (one, int(row["start"])) for one, row in zip(self.images, rows, strict=True)}
        for image, start in places.values():
            if id(image.pixels) in shown:
                _, texels = textures.texture_table([image])
                self.data.texels[start : start + len(texels)].assign(texels)
        self.data.textures.assign(rows)

    def _new_masks(self) -> AlphaMasks | None:
        from warp_gi.scene.masks import alpha_masks

        data, materials = self.data, self.scene.materials[: self.material_count]
        return alpha_masks(self.flat, materials, self.images, data.textures, data.texels, self._tints)

    def _set_panes(self) -> None:
        self.panes = Panes(self.flat, self.scene.materials[: self.material_count], self.device)
        self.data.panes = self.panes.data

    # ---- lights ----

    def relight(self) -> None:
        """Make all tables of emitters."""
        scene, flat, data = self.scene, self.flat, self.data
        world = animation.world_matrices(scene.nodes, self.time)  # lights need not be where they were when it was made
        self.emitters = emitters.emitter_table(scene._emissive, scene.lights, world)
        emitter_of = np.full(scene.triangle_count, -1, np.int32)
        emitter_of[scene._emissive] = np.arange(len(scene._emissive), dtype=np.int32)
        data.geometry.emitters = self._array(emitter_of, wp.int32)
        self.two_sided = self.double_sided[flat.materials[scene._emissive]]
        data.emitters.count = len(self.emitters)
        data.emitters.emitters = self._array(self.emitters, types.Emitter)
        data.emitters.alias = wp.empty(0, dtype=types.AliasBucket, device=self.device)
        if not scene._devices:
            scene._light_grids.forget()  # materials may have been edited until now
        self.grids = scene._light_grids.get()
        data.emitters.grids = self._array(self.grids.table, types.EmissionGrid)
        data.emitters.cells = self._array(self.grids.cells, types.AliasBucket)
        data.emitters.densities = self._array(self.grids.densities, wp.vec4)
        self._bound_emitters(data.emitters)
        self._light_table: wp.array | None = None

    def reframe(self) -> None:
        """Take over the bounds of the scene."""
        low, high = self.scene.bounds
        self.data.center = wp.vec3(*(float(x) for x in (low.astype(np.float64) + high) / 2.0))
        self.data.radius = self.scene.radius
        self._light_table = None  # lights that are directions have a power by the radius
        self._bound_emitters(self.data.emitters)

    def light_table(self) -> wp.array:
        if self._light_table is None:
            self._light_table = AliasTable.build(self.scene.emitter_powers()).on(self.device)
        return self._light_table

    def static_bvh(self) -> TriangleBvh:
        if not self.scene.is_animated:
            return self.bvh
        if self._static_bvh is None:
            from warp_gi.bvh import TriangleBvh

            never_moves = ~np.isin(self.flat.objects, list(self.scene.moving_objects))
            if not never_moves.any():
                raise SceneError("everything in this scene moves; nothing can be baked")
            masks = self._masks and replace(self._masks, face_mask=self._masks.face_mask[never_moves])
            self._static_bvh = TriangleBvh(self.flat.points, self.flat.indices[never_moves], self.device.alias, masks)
        return self._static_bvh

    def _array(self, values: np.ndarray, dtype: type) -> wp.array:
        return on_device(values, dtype, self.device)

    def placed_emitters(self) -> emitters.PlacedEmitters:
        triangles = self.scene._emissive
        corners = self.flat.points[self.flat.indices[triangles]].astype(np.float64)
        return emitters.PlacedEmitters(self.emitters.copy(), self.grids.lit_corners(corners), self.two_sided)

    def set_environment(self, environment: Environment | None) -> None:
        self.data.environment = types.Environment() if environment is None else environment.data(self.device)

    # ---- what moves ----

    def remember(self, indices: Iterable[int]) -> Trail:
        """Return where everything is before an edit, for ``settle``.

        Meshes of the nodes ``indices`` get other points: they are placed anew, and all trails keep the old ones.
        """
        before = Trail(-1, self.poses)
        now, previous = list(self.poses), list(self.previous_poses)
        for index in indices:
            start, stop = self.flat.vertex_starts[index : index + 2]
            before.points[index] = self.flat.points[start:stop].copy()
            for trail in self.trails:
                trail.points.setdefault(index, before.points[index])
            now[index] = previous[index] = UNKNOWN
        self.poses, self.previous_poses = now, previous
        return before

    def settle(self, before: Trail) -> None:
        """Take over nodes and points of the scene at the time of the last ``move``, as they are after an edit."""
        self._static_bvh = None
        self.reframe()
        self.move(self.time, self.time, before)

    def trail(self, index: int) -> Trail:
        """Return where the frame ``index`` sees the scene, in the pose that it is in: that of its last ``move``."""
        trail = Trail(index, self.poses)
        self.trails.add(trail)
        return trail

    def move(self, time: float, previous_time: float, trail: Trail | None = None) -> bool:
        """Bring points, normals and lights to ``time`` and previous points to ``previous_time``, or to a ``trail``."""
        scene, flat, target = self.scene, self.flat, self.data.geometry
        nodes = scene.nodes
        now = self._poses_at(time)
        before = now if previous_time == time else self._poses_at(previous_time)
        known: dict[int, np.ndarray] = {}
        if trail is not None:
            before, known = trail.poses, trail.points
        was, was_before = self.poses, self.previous_poses
        # No pose is known until everything is moved: the call after an interrupt or a fork then places all nodes.
        unknown: Sequence[Pose] = [UNKNOWN] * len(nodes)
        self.poses = self.previous_poses = unknown
        moved = changed = False
        for index, node in enumerate(nodes):
            start, stop = flat.vertex_starts[index : index + 2]
            if start == stop:
                continue
            if index in known or not _alike(before[index], was_before[index]):
                stood = _alike(before[index], was[index])  # mostly: the frame before was the last one
                points = flat.points[start:stop] if stood else None
                if index in known:
                    points = known[index]
                self.previous_points[start:stop] = (
                    geometry.placed_points(node, before[index]) if points is None else points
                )
                self._upload(target.previous_points, self.previous_points, start, stop)
                changed = True
            if not _alike(now[index], was[index]):
                if now[index] is scene._poses[index] and self.is_parted:
                    flat.points[start:stop] = scene._flat.points[start:stop]
                    flat.normals[start:stop] = scene._flat.normals[start:stop]
                else:
                    geometry.place(flat, node, now[index], start)
                self._upload(target.points, flat.points, start, stop)
                self._upload(target.normals, flat.normals, start, stop)
                moved = True
        if any(light.node is not None for light in scene.lights):
            world = [pose.matrix for pose in now]
            table = emitters.emitter_table(scene._emissive, scene.lights, world)
            changed |= not np.array_equal(table, self.emitters)
            self.emitters[:] = table
            self._upload(self.data.emitters.emitters, self.emitters, len(scene._emissive), len(self.emitters))
        if moved:
            self.bvh.refit(flat.points)
            self.panes.refit(flat.points)
            self._bound_emitters(self.data.emitters)
        self.poses, self.previous_poses, self.time = now, _without(before, known), time
        return moved or changed

    def _poses_at(self, time: float) -> Sequence[Pose]:
        return poses(self.scene.nodes, time) if self.scene.is_animated else self.scene._poses

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


def _alike(a: Pose, b: Pose) -> bool:
    """Return whether two poses place vertices alike; none is like ``UNKNOWN``."""
    return (a is b and a is not UNKNOWN) or np.array_equal(a.key, b.key)


def _layout(images: Sequence[Texture]) -> list[tuple[tuple[int, ...], int]]:
    """Return the size of each image, and the first one that shares its pixels: what decides where texels lie."""
    first: dict[int, int] = {}
    return [(one.pixels.shape, first.setdefault(id(one.pixels), number)) for number, one in enumerate(images)]


def _without(known: Sequence[Pose], others: Iterable[int]) -> Sequence[Pose]:
    """Return poses, but for some nodes ``UNKNOWN``; the same list without any."""
    found = list(known) if others else known
    for index in others:
        found[index] = UNKNOWN  # type: ignore[index]
    return found
