"""Emissive surfaces and lights of a scene, as bakes look at them."""

from __future__ import annotations

import warp as wp

from warp_gi import launch
from warp_gi.kernels import types
from warp_gi.scene.baked import BakedScene
from warp_gi.scene.scene import Scene


def lamps_move(scene: Scene) -> bool:
    """Return whether an emissive surface or a light of the scene moves, so that its light cannot be baked."""
    moving = set(scene.moving_objects.values())
    shining = any(max(mesh.material.emission) > 0.0 for index in moving for mesh in scene.nodes[index].meshes)
    return shining or any(light.node is not None and scene.moves(light.node) for light in scene.lights)


def lit_data(scene: Scene | BakedScene, device: wp.Device) -> types.SceneData:
    """Return the scene's buffers with emitters picked by power, whatever the pipeline's estimator of them does."""
    data = launch.copied(scene.data(device), types.SceneData)
    data.emitters = launch.copied(data.emitters, types.Emitters)
    if not isinstance(scene, BakedScene) and scene.emitter_count:
        data.emitters.alias = scene.light_table(device)
    return data
