"""What of a scene is watched for edits, in groups that are watched anew each by itself; and values to compare it by."""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from warp_gi.scene import emitters, textures
from warp_gi.scene.hashing import shape_hash
from warp_gi.scene.model import Material, Mesh, MorphTarget, Node, PunctualLight, Skin, Texture
from warp_gi.scene.poses import deforms
from warp_gi.scene.watching import Change, Owner

if TYPE_CHECKING:
    from warp_gi.scene.contents import SceneContents


class Slot(NamedTuple):
    """The place of a node's mesh in the flat geometry."""

    mesh: Mesh
    vertices: slice
    triangles: slice
    row: int
    """Index of the mesh's material in ``Scene.materials``."""


Item = TypeVar("Item", Material, Mesh, Node, PunctualLight)

PLACED = ("parent_from_node", "parent", "keyframes", "pivot", "morphs")
"""Fields of nodes that change no list of what there is to watch."""


def geometry(scene: SceneContents) -> dict[str, list[Owner]]:
    """Return what the flat geometry of a scene is made from, by the names of watches."""
    meshes = {id(mesh): mesh for node in scene.nodes for mesh in node.meshes}
    skins = {id(node.skin): node.skin for node in scene.nodes if node.skin is not None}
    targets = [target for mesh in meshes.values() for target in mesh.targets]
    nodes = [(scene, ("nodes", "materials")), *scene.nodes, *skins.values()]
    return {"nodes": nodes, "meshes": [*meshes.values(), *targets]}


def shading(scene: SceneContents) -> dict[str, list[Owner]]:
    """Return materials, textures and lights of a scene, by the names of watches."""
    used = [*scene.materials, *(mesh.material for node in scene.nodes for mesh in node.meshes)]
    materials = list({id(material): material for material in used}.values())
    images = textures.distinct_textures(materials)
    return {
        "materials": [*materials],
        "textures": [*images],
        "lights": [(scene, ("lights", "materials")), *scene.lights],
    }


def stale(changes: dict[str, list[Change]]) -> set[str]:
    """Return the names of watches that do not know what there is any more; none stands for all."""
    for owner, field in (change for some in changes.values() for change in some):
        is_known = isinstance(owner, PunctualLight | Texture | MorphTarget | Skin) or field == "lights"
        is_known |= isinstance(owner, Node) and field in PLACED
        is_known |= isinstance(owner, Mesh) and field in ("points", "normals")
        is_known |= isinstance(owner, Material) and field not in textures.TEXTURE_SLOTS
        if not is_known:
            return set()
    return set(changes)


def light_rows(lights: Sequence[PunctualLight]) -> bytes:
    """Return all that punctual lights are, but for where nodes carry them."""
    count = max((light.node for light in lights if light.node is not None), default=-1) + 1
    table = emitters.emitter_table(np.zeros(0, np.int64), lights, [np.eye(4)] * count)
    return table.tobytes() + repr([(light.node, light.inner_cone, light.outer_cone) for light in lights]).encode()


def shape_of(node: Node) -> str | None:
    """Return what changes the shape of a node's meshes; None if nothing does."""
    try:
        return shape_hash(node) if deforms(node) else None
    except (TypeError, ValueError, AttributeError):
        return "unusable"


def emissions(materials: Sequence[Material]) -> list[list[float]]:
    """Return what decides what triangles emit, by material: factors, sides, and a checksum of the texture."""
    found = [[*np.ravel(one.emission).tolist(), float(one.double_sided), float(one.colors_emit)] for one in materials]
    for material, values in zip(materials, found, strict=True):
        if any(values[:-2]) and material.emission_texture is not None:
            values.append(float(zlib.adler32(np.ascontiguousarray(material.emission_texture.pixels).data)))
    return found


def slots_of(scene: SceneContents) -> list[list[Slot]]:
    """Return for each node where its meshes lie in the flat geometry."""
    rows = {id(material): row for row, material in enumerate(scene.materials)}
    vertex = triangle = 0
    slots: list[list[Slot]] = []
    for node in scene.nodes:
        slots.append([])
        for mesh in node.meshes:
            vertices = slice(vertex, vertex + len(mesh.points))
            triangles = slice(triangle, triangle + len(mesh.indices))
            slots[-1].append(Slot(mesh, vertices, triangles, rows[id(mesh.material)]))
            vertex, triangle = vertices.stop, triangles.stop
    return slots


def missing(items: Iterable[Item], others: Iterable[object]) -> list[Item]:
    """Return the items that are not among others, by identity."""
    known = {id(other) for other in others}
    return [item for item in items if id(item) not in known]


def come_or_gone(now: Sequence[Item], old: Sequence[Item]) -> str:
    """Return the name of the first item that was added or removed, and which of both."""
    if len(now) > len(old):
        return f"{(missing(now, old) or now)[0].name!r} was added"
    return f"{(missing(old, now) or old)[0].name!r} was removed"
