"""Finds edits of a scene that its pictures would not show, and says which, and what to do.

A scene copies its geometry when it is made, and materials, textures, lights and sky when it is first used on a
device. What is edited after that is found in two steps: a ``Watch`` tells which fields may have changed, in about the
time in which memory is read; then just these are compared with the copies, so that only an edit that pictures lack is
an error. An equal copy of an array is none, nor is what is read anew for every frame: keyframes of nodes that move,
nodes under them, and all lights if one of them moves.
"""

from __future__ import annotations

import zlib
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from warp_gi.errors import SceneError
from warp_gi.scene import animation, emitters, geometry, textures
from warp_gi.scene.hashing import shape_hash
from warp_gi.scene.material_copies import alike, row_edit
from warp_gi.scene.model import Material, Mesh, MorphTarget, Node, PunctualLight, Skin, Texture
from warp_gi.scene.poses import deforms, joint_matrices
from warp_gi.scene.watching import Change, Owner, Watch

if TYPE_CHECKING:
    from warp_gi.scene.contents import SceneContents
    from warp_gi.scene.sky_map import SkyMap

NEW_SCENE = "make a new scene: gi.Scene(scene.nodes, scene.lights, scene.environment, scene.cameras)"
NEW_SKY = "assign it again: scene.environment = ..."


SHAPE_FIELDS = ("skin", "morphs", "joints", "joint_weights", "targets", "joint_from_mesh")
"""Fields of nodes, meshes and skins that change the shape of meshes."""

Item = TypeVar("Item", Material, Mesh, Node, PunctualLight)


class Edit(NamedTuple):
    """An edit that pictures would not show."""

    what: str
    cure: str = NEW_SCENE


class _Slot(NamedTuple):
    """The place of a node's mesh in the flat geometry."""

    mesh: Mesh
    vertices: slice
    triangles: slice
    row: int
    """Index of the mesh's material in ``Scene.materials``."""


class Edits:
    """The objects that a scene was made from. Made anew whenever the scene reads its nodes again."""

    def __init__(self, scene: SceneContents) -> None:
        self.scene = scene
        self.nodes = list(scene.nodes)
        self.slots = _slots(scene)
        self.shapes = {index: _shape_of(node) for index, node in enumerate(scene.nodes) if deforms(node)}
        self.materials = list(scene.materials)
        self.material_count = len(scene.materials)
        self.emissions = _emissions(scene.materials)
        self.watch = Watch(_geometry(scene), bare=True)
        self.light_world: list[np.ndarray] = []
        self.light_list: list[PunctualLight] = []
        self.sky_watch: Watch | None = None
        self.sky_map: SkyMap | None = None

    def in_use(self) -> None:
        """Watch everything from now on: a device holds all that the scene is made of."""
        scene = self.scene
        self.light_world = [matrix.copy() for matrix in animation.world_matrices(scene.nodes, 0.0)]
        self._watch_all()
        self.sky_in_use()

    def _watch_all(self) -> None:
        scene = self.scene
        self.nodes, self.light_list = list(scene.nodes), list(scene.lights)
        self.materials = scene.materials[: self.material_count]
        self.watch = Watch([*_geometry(scene), *_shading(scene)])

    def sky_in_use(self) -> None:
        """Watch the environment that devices hold now."""
        sky = self.scene.environment
        self.sky_map = None if sky is None else sky._map
        self.sky_watch = None if sky is None else Watch([(sky, ("color", "rotation", "scale"))])

    def check(self) -> None:
        """Raise SceneError for the first edit that pictures would not show."""
        changes = self.watch.changes()
        edits = [self._edit(change) for change in changes] + [self._sky_edit()]
        if not self.scene._devices:
            edits.append(self._emission_edit())
        for edit in edits:
            if edit is not None:
                raise SceneError(
                    f"scene {self.scene.name!r}: {edit.what} after the scene was built, "
                    f"and pictures would not show it; {edit.cure}"
                )
        if changes and self.scene._devices:  # these edits do not matter, such as an equal copy of an array
            self._watch_all()

    def _edit(self, change: Change) -> Edit | None:
        owner, field = change
        if field in SHAPE_FIELDS or isinstance(owner, Skin | MorphTarget):
            return self._shape_edit(field)
        if isinstance(owner, Node):
            return self._meshes_edit(owner) if field == "meshes" else self._placement_edit(owner, field)
        if isinstance(owner, Mesh):
            return self._mesh_edit(owner, field)
        if isinstance(owner, Material):
            return self._material_edit(owner, field)
        if isinstance(owner, Texture):
            users = [
                m for m in self.scene.materials if any(getattr(m, slot) is owner for slot in textures.TEXTURE_SLOTS)
            ]
            edit = _first(self._material_edit(material, "a texture") for material in users)
            return edit and Edit(f"{field} of {edit.what}")
        if isinstance(owner, PunctualLight) or field == "lights":
            return self._lights_edit(field)
        return self._nodes_edit() if field == "nodes" else self._materials_edit()

    # ---- geometry ----

    def _nodes_edit(self) -> Edit | None:
        """Return whether nodes were added, removed or replaced."""
        now, old = self.scene.nodes, self.nodes
        if len(now) != len(old):
            is_longer = len(now) > len(old) and not _missing(old, now[: len(old)])
            if is_longer and not self.scene.is_animated and not any(node.meshes for node in now[len(old) :]):
                return None
            return Edit(f"node {_come_or_gone(now, old)}")
        for index, (node, former) in enumerate(zip(now, old, strict=True)):
            if node is not former:
                edit = self._meshes_edit(node) or self._placement_edit(node, "parent_from_node")
                edit = edit or self._shape_edit("skin")
                if edit is not None:
                    return Edit(f"node {index} {former.name!r} was replaced by another", edit.cure)
        return None

    def _placement_edit(self, node: Node, field: str) -> Edit | None:
        """Return whether something that rests is no longer where its copy is, because of a node."""
        scene, nodes = self.scene, self.scene.nodes
        index = _index(nodes, node)
        if index is None or len(nodes) != len(self.nodes):
            return None  # found as an edit of the list
        edit = Edit(
            f"{field} of node {index} {node.name!r} changed",
            f"move it with scene.animate({node.name!r}, keyframes), or {NEW_SCENE}",
        )
        if node.parent is not None and not 0 <= node.parent < index:
            return edit
        world, moving = animation.world_matrices(nodes, 0.0), animation.moving_nodes(nodes)
        lit = {} if _are_lights_read_anew(scene) else {light.node for light in scene.lights if self.light_world}
        under = {index}
        for place in range(index, len(nodes)):
            if nodes[place].parent in under:
                under.add(place)
            if place not in under or scene._moving[place]:
                continue
            is_other = moving[place] or not np.array_equal(world[place], scene._poses[place].matrix)
            if self.slots[place] and nodes[place].skin is None and is_other:
                return edit
            if place in lit and (moving[place] or not np.array_equal(world[place], self.light_world[place])):
                return edit
        for place, one in enumerate(nodes):
            bent = one.skin is not None and self.slots[place] and not scene._moving[place]
            if one.skin is not None and bent and under.intersection(one.skin.joints):
                old = scene._poses[place].joints
                is_same = old is not None and np.array_equal(joint_matrices(one.skin, world), old)
                if not is_same or any(moving[joint] for joint in one.skin.joints):
                    return edit
        return None

    def _shape_edit(self, field: str) -> Edit | None:
        """Return whether what changes the shape of meshes is other than it was."""
        for index, node in enumerate(self.scene.nodes):
            if _shape_of(node) != self.shapes.get(index):
                return Edit(f"{field} of what bends node {index} {node.name!r} changed")
        return None

    def _meshes_edit(self, node: Node) -> Edit | None:
        """Return whether the meshes of a node are others."""
        index = _index(self.scene.nodes, node)
        if index is None or index >= len(self.slots):
            return None
        now, old = node.meshes, [slot.mesh for slot in self.slots[index]]
        if len(now) != len(old):
            return Edit(f"mesh {_come_or_gone(now, old)} (node {index} {node.name!r})")
        for mesh, slot in zip(now, self.slots[index], strict=True):
            if mesh is not slot.mesh and self._slot_edit(mesh, slot, index, "points"):
                return Edit(f"mesh {slot.mesh.name!r} of node {node.name!r} was replaced by mesh {mesh.name!r}")
        return None

    def _mesh_edit(self, mesh: Mesh, hint: str) -> Edit | None:
        """Return whether a mesh is no longer like its copies."""
        for index, candidate, slot in self._meshes():
            field = self._slot_edit(mesh, slot, index, hint) if candidate is mesh else None
            if field:
                return Edit(f"{field} of mesh {mesh.name!r} (node {index} {self.scene.nodes[index].name!r}) changed")
        return None

    def _meshes(self) -> Iterator[tuple[int, Mesh, _Slot]]:
        """Yield the meshes that the nodes have now, with the index of the node and the place of the copy."""
        for index, (node, slots) in enumerate(zip(self.scene.nodes, self.slots, strict=False)):
            for mesh, slot in zip(node.meshes, slots, strict=False):
                yield index, mesh, slot

    def _slot_edit(self, mesh: Mesh, slot: _Slot, index: int, hint: str) -> str | None:
        """Return the first field in which a mesh differs from a copy; ``hint`` where it is no mesh any more."""
        try:
            geometry.check_mesh(mesh, "")
        except (ValueError, TypeError):
            return hint
        flat = self.scene._flat
        part = geometry.flatten([Node("", [mesh])], [mesh.material], [self.scene._poses[index]])
        part.indices += slot.vertices.start
        for field, place in (
            ("points", slot.vertices),
            ("normals", slot.vertices),
            ("uvs", slot.vertices),
            ("further_uvs", slot.vertices),
            ("colors", slot.vertices),
            ("indices", slot.triangles),
        ):
            if not geometry.is_copy(field, getattr(part, field), getattr(flat, field), place):
                return field
        used = len(part.indices) and slot.row < len(self.scene.materials)
        return "material" if used and not alike(mesh.material, self.scene.materials[slot.row]) else None

    # ---- shading ----

    def _materials_edit(self) -> Edit | None:
        """Return whether the list of materials lacks one, or has another instead."""
        scene, now = self.scene, self.scene.materials
        cure = f"give meshes their material (mesh.material = ...), and {NEW_SCENE}"
        if len(now) < self.material_count:
            return Edit(f"material {_come_or_gone(now, self.materials)} in scene.materials", cure)
        if not scene._devices:
            return None  # read later
        data = next(iter(scene._devices.values())).data
        for row, (material, old) in enumerate(zip(now, self.materials, strict=False)):
            if material is not old and row_edit(material, data, row, "a field"):
                return Edit(f"material {row} {old.name!r} was replaced in scene.materials", cure)
        return None

    def _material_edit(self, material: Material, hint: str) -> Edit | None:
        """Return whether a material is no longer like its copies on devices; ``hint`` names the field if need be."""
        scene, field = self.scene, None
        if not scene._devices:
            return None  # read later
        data = next(iter(scene._devices.values())).data
        for row, candidate in enumerate(scene.materials[: self.material_count]):
            if field is None and candidate is material:
                field = row_edit(material, data, row, hint)
        for _, mesh, slot in self._meshes():
            if field is None and mesh.material is material and not alike(material, scene.materials[slot.row]):
                field = hint  # meshes have this material in place of the scene's own
        return None if field is None else Edit(f"{field} of material {material.name!r} changed")

    def _emission_edit(self) -> Edit | None:
        """Return whether other triangles emit than when the scene was made; materials are read later."""
        materials = self.scene.materials
        now = _emissions(materials[: self.material_count])
        if now == self.emissions or len(now) < self.material_count:
            return None
        if np.array_equal(emitters.emissive_triangles(self.scene._flat, materials)[0], self.scene._emissive):
            return None
        row = next(row for row, (a, b) in enumerate(zip(now, self.emissions, strict=True)) if a != b)
        return Edit(f"emission of material {materials[row].name!r} changed")

    # ---- lights and sky ----

    def _lights_edit(self, hint: str) -> Edit | None:
        """Return whether punctual lights are no longer like their copies."""
        scene, old = self.scene, self.light_list
        if len(scene.lights) != len(old):
            return Edit(f"light {_come_or_gone(scene.lights, old)}")
        if _are_lights_read_anew(scene):
            return None
        device = next(iter(scene._devices.values()))
        kept = device.emitters[len(scene._emissive) :]
        for light, row in zip(scene.lights, kept, strict=True):
            try:
                emitters.check_light(light, scene.nodes)
            except (ValueError, TypeError):
                return Edit(f"{hint} of light {light.name!r} changed")
            new = emitters.emitter_table(scene._emissive[:0], [light], self.light_world)[0]
            for field in ("kind", "position", "direction", "intensity", "cos_inner", "cos_outer", "range"):
                if not np.array_equal(row[field], new[field]):
                    field = {"cos_inner": "inner_cone", "cos_outer": "outer_cone"}.get(field, field)
                    return Edit(f"{field} of light {light.name!r} changed")
        return None

    def _sky_edit(self) -> Edit | None:
        """Return whether the environment is no longer like its copies on devices."""
        sky = self.scene.environment
        if sky is None:
            return None
        used = self.sky_map if self.sky_watch else sky._map
        is_other = sky._map is not used
        if used is not None:
            is_other |= used.is_edited()
            pixels = sky.pixels
            is_other |= pixels is None or (pixels is not used.pixels and not np.array_equal(pixels, used.pixels))
        else:
            is_other |= sky.pixels is not None
        if is_other:
            return Edit("pixels of the environment changed", NEW_SKY)
        for _, field in self.sky_watch.changes() if self.sky_watch else ():
            device = next(iter(self.scene._devices.values()))
            old, new = device.data.environment, sky.data(device.device)
            if any(
                np.any(np.asarray(getattr(old, name)) != np.asarray(getattr(new, name)))
                for name in ("kind", "radiance", "environment_from_world")
            ):
                return Edit(f"{field} of the environment changed", NEW_SKY)
        return None


def _geometry(scene: SceneContents) -> list[Owner]:
    """Return what the flat geometry of a scene is made from."""
    meshes = {id(mesh): mesh for node in scene.nodes for mesh in node.meshes}
    skins = {id(node.skin): node.skin for node in scene.nodes if node.skin is not None}
    targets = [target for mesh in meshes.values() for target in mesh.targets]
    return [(scene, ("nodes", "materials")), *scene.nodes, *meshes.values(), *skins.values(), *targets]


def _shading(scene: SceneContents) -> list[Owner]:
    """Return materials, textures and lights of a scene."""
    used = [*scene.materials, *(mesh.material for node in scene.nodes for mesh in node.meshes)]
    materials = list({id(material): material for material in used}.values())
    return [(scene, ("lights", "materials")), *materials, *textures.distinct_textures(materials), *scene.lights]


def _shape_of(node: Node) -> str | None:
    """Return what changes the shape of a node's meshes; None if nothing does."""
    try:
        return shape_hash(node) if deforms(node) else None
    except (TypeError, ValueError, AttributeError):
        return "unusable"


def _slots(scene: SceneContents) -> list[list[_Slot]]:
    """Return for each node where its meshes lie in the flat geometry."""
    rows = {id(material): row for row, material in enumerate(scene.materials)}
    vertex = triangle = 0
    slots: list[list[_Slot]] = []
    for node in scene.nodes:
        slots.append([])
        for mesh in node.meshes:
            vertices = slice(vertex, vertex + len(mesh.points))
            triangles = slice(triangle, triangle + len(mesh.indices))
            slots[-1].append(_Slot(mesh, vertices, triangles, rows[id(mesh.material)]))
            vertex, triangle = vertices.stop, triangles.stop
    return slots


def _are_lights_read_anew(scene: SceneContents) -> bool:
    """Return whether every frame reads all punctual lights, because one of them moves."""
    moving = scene._moving
    return any(light.node is not None and light.node < len(moving) and moving[light.node] for light in scene.lights)


def _missing(items: Iterable[Item], others: Iterable[object]) -> list[Item]:
    """Return the items that are not among others, by identity."""
    known = {id(other) for other in others}
    return [item for item in items if id(item) not in known]


def _index(items: Iterable[object], wanted: object) -> int | None:
    return next((index for index, item in enumerate(items) if item is wanted), None)


def _come_or_gone(now: Sequence[Item], old: Sequence[Item]) -> str:
    """Return the name of the first item that was added or removed, and which of both."""
    if len(now) > len(old):
        return f"{(_missing(now, old) or now)[0].name!r} was added"
    return f"{(_missing(old, now) or old)[0].name!r} was removed"


def _emissions(materials: Sequence[Material]) -> list[list[float]]:
    """Return what decides which triangles emit, by material: factors, and a checksum of the texture."""
    found = [np.ravel(material.emission).tolist() for material in materials]
    for material, values in zip(materials, found, strict=True):
        if any(values) and material.emission_texture is not None:
            values.append(float(zlib.adler32(np.ascontiguousarray(material.emission_texture.pixels).data)))
    return found


def _first(edits: Iterable[Edit | None]) -> Edit | None:
    return next((edit for edit in edits if edit is not None), None)
