"""The buffers of a scene on one device, as kernels read them."""

from __future__ import annotations

from dataclasses import replace
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


class DeviceScene:
    """The buffers of a scene on one device, and the pose they are in."""

    def __init__(self, scene: SceneContents, device: wp.Device) -> None:
        from warp_gi.bvh import TriangleBvh
        from warp_gi.scene.masks import alpha_masks, glass_tints

        self.scene, self.device = scene, device
        self.poses = self.previous_poses = scene._poses
        flat = scene._flat
        if scene.is_animated:
            flat = replace(flat, points=flat.points.copy(), normals=flat.normals.copy())
        self.flat = flat
        self.previous_points = flat.points.copy() if scene.is_animated else flat.points
        world = animation.world_matrices(scene.nodes, 0.0)  # lights need not be where they were when it was made
        self.emitters = emitters.emitter_table(scene._emissive, scene.lights, world)
        emitter_of = np.full(scene.triangle_count, -1, np.int32)
        emitter_of[scene._emissive] = np.arange(len(scene._emissive), dtype=np.int32)
        tints = glass_tints(scene.materials)
        images = [*textures.distinct_textures(scene.materials), *tints.values()]
        texture_rows, texels = textures.texture_table(images)

        data = types.SceneData()
        data.geometry.points = self._array(flat.points, wp.vec3)
        data.geometry.previous_points = (
            self._array(self.previous_points, wp.vec3) if scene.is_animated else data.geometry.points
        )
        data.geometry.normals = self._array(flat.normals, wp.vec3)
        data.geometry.uvs = self._array(flat.uvs, wp.vec2)
        if flat.further_uvs is not None:
            data.geometry.further_uvs = self._array(flat.further_uvs, wp.vec2)
        if flat.colors is not None:
            data.geometry.colors = self._array(flat.colors, wp.vec4)
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
        if not scene._devices:
            scene._light_grids.forget()  # materials may have been edited until now
        self.grids = scene._light_grids.get()
        data.emitters.grids = self._array(self.grids.table, types.EmissionGrid)
        data.emitters.cells = self._array(self.grids.cells, types.AliasBucket)
        data.emitters.densities = self._array(self.grids.densities, wp.vec4)
        self._bound_emitters(data.emitters)
        low, high = scene.bounds
        data.center = wp.vec3(*(float(x) for x in (low.astype(np.float64) + high) / 2.0))
        data.radius = scene.radius
        masks = alpha_masks(flat, scene.materials, images, data.textures, data.texels, tints)
        self.bvh = TriangleBvh(flat.points, flat.indices, device=device.alias, alpha=masks)
        self._masks: AlphaMasks | None = masks
        self._static_bvh: TriangleBvh | None = None
        self._light_table: wp.array | None = None
        data.bvh = self.bvh.data
        self.panes = Panes(flat, scene.materials, device)
        data.panes = self.panes.data
        self.data = data
        self.set_environment(scene.environment)

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

    def move(self, time: float, previous_time: float) -> bool:
        """Bring points, normals and lights to ``time`` and previous points to ``previous_time``."""
        nodes, flat, target = self.scene.nodes, self.flat, self.data.geometry
        now = poses(nodes, time)
        before = now if previous_time == time else poses(nodes, previous_time)
        was, was_before = self.poses, self.previous_poses
        # No pose is known until everything is moved: the call after an interrupt or a fork then places all nodes.
        self.poses = self.previous_poses = [Pose(np.full((4, 4), np.nan))] * len(nodes)
        moved = changed = False
        for index, node in enumerate(nodes):
            start, stop = flat.vertex_starts[index : index + 2]
            if start == stop or not self.scene._moving[index]:
                continue
            if not np.array_equal(before[index].key, was_before[index].key):
                stood = np.array_equal(before[index].key, was[index].key)  # mostly: the frame before was the last one
                points = flat.points[start:stop] if stood else geometry.placed_points(node, before[index])
                self.previous_points[start:stop] = points
                self._upload(target.previous_points, self.previous_points, start, stop)
                changed = True
            if not np.array_equal(now[index].key, was[index].key):
                geometry.place(flat, node, now[index], start)
                self._upload(target.points, flat.points, start, stop)
                self._upload(target.normals, flat.normals, start, stop)
                moved = True
        if any(light.node is not None and self.scene._moving[light.node] for light in self.scene.lights):
            world = [pose.matrix for pose in now]
            table = emitters.emitter_table(self.scene._emissive, self.scene.lights, world)
            changed |= not np.array_equal(table, self.emitters)
            self.emitters[:] = table
            self._upload(self.data.emitters.emitters, self.emitters, len(self.scene._emissive), len(self.emitters))
        if moved:
            self.bvh.refit(flat.points)
            self.panes.refit(flat.points)
            self._bound_emitters(self.data.emitters)
        self.poses, self.previous_poses = now, before
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
