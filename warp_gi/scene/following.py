"""Takes edits of a scene over, at the price of what changed: vertices are placed anew, tables written anew.

Pictures are then those of a new scene with the edited values, to the last bit where nothing is kept over frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from warp_gi.errors import SceneError
from warp_gi.scene import animation, emitters, geometry, hulls, poses
from warp_gi.scene.emission_grids import LightGrids
from warp_gi.scene.model import Mesh, Node, Texture

if TYPE_CHECKING:
    from warp_gi.scene.contents import SceneContents

POSES_FOR_BOUNDS = 33
"""Number of evenly spaced poses, beside those of the keyframes, that the bounds of an animated scene enclose."""
POSES_FOR_AREAS = 9
"""Number of evenly spaced poses over which areas of lamps that change their shape are averaged."""


def bounds_of(scene: SceneContents) -> np.ndarray:
    """Return the lowest and highest corner in metres, float32 [2, 3]; of an animated scene over all of its time."""
    flat = scene._flat
    points = flat.points[np.unique(flat.indices)] if len(flat.points) > 3 * len(flat.indices) else flat.points
    boxes = [np.stack([points.min(axis=0), points.max(axis=0)])]
    if scene.is_animated:
        evenly = np.linspace(0.0, scene.duration, POSES_FOR_BOUNDS)
        for swept in (
            animation.swept_box(scene.nodes, scene._moving, evenly),
            hulls.swept_box(scene.nodes, scene._hulls, evenly),
        ):
            boxes += [swept] if np.isfinite(swept).all() else []
    return np.stack([np.min(boxes, axis=(0, 1)), np.max(boxes, axis=(0, 1))]).astype(np.float32)


def lights_of(scene: SceneContents) -> tuple[np.ndarray, LightGrids]:
    """Return which triangles of a scene emit, int64 [count], and how points on them are sampled."""
    triangles, powers = emitters.emissive_triangles(scene._flat, scene.materials)
    return triangles, LightGrids(scene._flat, scene.materials, triangles, powers)


def set_areas(scene: SceneContents) -> None:
    """Find the mean areas of lamps of a scene that change their shape."""
    times = np.linspace(0.0, scene.duration, POSES_FOR_AREAS)
    scene._flat.mean_areas = emitters.mean_areas(scene.nodes, scene._flat, scene._moving, times)


def reshape(scene: SceneContents, edited: Iterable[int]) -> None:
    """Place what stands elsewhere since nodes were edited, and the meshes of nodes ``edited``, which have other points.

    Raises SceneError for what cannot be placed so, before anything changes.
    """
    nodes, old = scene.nodes, scene._poses
    edited = set(edited)
    _check(scene, edited)
    placed = [
        before if np.array_equal(before.key, now.key) else now
        for before, now in zip(old, poses.poses(nodes, 0.0), strict=True)
    ]
    changed = [
        index
        for index, node in enumerate(nodes)
        if node.meshes and (index in edited or placed[index] is not old[index])
    ]
    pieces = {}
    for index in changed:
        node, pose = nodes[index], placed[index]
        for mesh in node.meshes:
            if pose.mirrors(mesh) != old[index].mirrors(mesh):
                raise SceneError(f"scene {scene.name!r}: node {node.name!r} was mirrored; make a new scene for that")
        pieces[index] = [pose.vertices(mesh) for mesh in node.meshes]
        if not all(np.isfinite(points).all() for points, _ in pieces[index]):
            raise SceneError(f"scene {scene.name!r}: node {node.name!r} moves vertices past the range of float32")
    devices = list(scene._devices.values())
    for device in devices:
        device.part()
    before = [device.remember(edited) for device in devices]
    for index in changed:
        geometry.write(scene._flat, pieces[index], scene._flat.vertex_starts[index])
    scene._poses = placed
    if scene._hulls and edited:
        scene._hulls = hulls.hulls_of(nodes, scene._moving)
    is_lit = any(max(mesh.material.emission) > 0.0 for index in changed for mesh in nodes[index].meshes)
    scene._bounds = bounds_of(scene)
    scene._digests.forget("geometry", "normals")
    if is_lit:
        set_areas(scene)
        scene._emissive, scene._light_grids = lights_of(scene)
    for device, trail in zip(devices, before, strict=True):
        if is_lit:
            device.relight()
        device.settle(trail)
    scene.version += 1


def set_points(scene: SceneContents, target: Mesh | Node, points: ArrayLike, normals: ArrayLike | None) -> None:
    """Give a mesh other points; see ``Scene.set_points``."""
    if isinstance(target, Node):
        if len(target.meshes) != 1:
            raise SceneError(f"node {target.name!r} has {len(target.meshes)} meshes; give the one to move")
        (target,) = target.meshes
    if not isinstance(target, Mesh):
        raise SceneError(f"expected a Mesh or a Node of the scene, got {target!r:.80}")
    if not any(mesh is target for node in scene.nodes for mesh in node.meshes):
        raise SceneError(f"mesh {target.name!r} is not in scene {scene.name!r}; give one of its nodes' meshes")
    given = {"points": points} | ({} if normals is None else {"normals": normals})
    fresh: dict[str, Any] = {name: _numbers(values, target) for name, values in given.items()}
    for name, values in fresh.items():
        if values.shape != np.shape(target.points):
            raise SceneError(
                f"mesh {target.name!r}: {name} must be {list(np.shape(target.points))} as before, got "
                f"{list(values.shape)}; other triangles need a new scene"
            )
    geometry.check_mesh(replace(target, **fresh), f"mesh {target.name!r}")
    for name, values in fresh.items():
        setattr(target, name, values)


def _numbers(values: ArrayLike, mesh: Mesh) -> np.ndarray:
    try:
        return np.array(values, np.float32)
    except (TypeError, ValueError) as error:
        raise SceneError(f"mesh {mesh.name!r}: expected numbers [vertex, 3], got {values!r:.80}") from error


def relight(scene: SceneContents) -> None:
    """Take over edits of punctual lights, and of what materials emit.

    Raises SceneError for a light that is none, before anything changes.
    """
    for light in scene.lights:
        emitters.check_light(light, scene.nodes)
    set_areas(scene)
    scene._emissive, scene._light_grids = lights_of(scene)
    scene._digests.forget("light")
    for device in scene._devices.values():
        device.relight()
    scene.version += 1


def shade(scene: SceneContents, edited: Sequence[Texture], has_other_images: bool, lets_rays_pass: bool) -> None:
    """Take over edits of materials and of the textures ``edited``.

    ``has_other_images`` says that textures were edited, added or removed; ``lets_rays_pass`` that a material which lets
    rays pass is among those edited, or did before.
    """
    changed = {"geometry": lets_rays_pass, "images": has_other_images}
    scene._digests.forget("light", *(name for name, is_other in changed.items() if is_other))
    for device in scene._devices.values():
        device.shade(edited, lets_rays_pass)
    scene.version += 1


def _check(scene: SceneContents, edited: set[int]) -> None:
    """Raise SceneError for nodes that cannot be placed, and meshes and skins that do not fit."""
    for index, node in enumerate(scene.nodes):
        geometry.check_placement(node, index)
        if index in edited:
            for mesh in node.meshes:
                geometry.check_mesh(mesh, f"mesh {mesh.name!r} of node {node.name!r}")
            poses.check_deformation(node, scene.nodes)
