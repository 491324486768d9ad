"""Finds edits of a scene, and takes over those that pictures can follow; others are an error that says what to do.

A scene copies its geometry when it is made, and materials, textures, lights and sky when it is first used on a
device. What is edited after that is found in two steps: a ``Watch`` tells which fields may have changed, in about the
time in which memory is read; then just these are compared with the copies. An equal copy of an array is no edit, nor
is what is read anew for every frame: keyframes of nodes that move, and nodes under them. Placements, points, normals,
materials, textures, lights and the sky are followed (``following``): not other triangles, texture coordinates or nodes.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from warp_gi.errors import SceneError
from warp_gi.scene import animation, emitters, following, geometry, textures, watched
from warp_gi.scene.material_copies import alike, passes_rays, row_edits
from warp_gi.scene.model import Material, Mesh, MorphTarget, Node, PunctualLight, Skin, Texture
from warp_gi.scene.poses import deforms, moving_nodes
from warp_gi.scene.watching import Change, Watch

if TYPE_CHECKING:
    from warp_gi.scene.contents import SceneContents
    from warp_gi.scene.sky_map import SkyMap

NEW_SCENE = "make a new scene: gi.Scene(scene.nodes, scene.lights, scene.environment, scene.cameras)"
NEW_SKY = "assign it again: scene.environment = ..."


SHAPE_FIELDS = ("skin", "morphs", "joints", "joint_weights", "targets", "joint_from_mesh")
"""Fields of nodes, meshes and skins that change the shape of meshes."""

EMITTING = ("emission", "emission_texture", "colors_emit", "double_sided")
"""Fields of materials that decide what emits."""


class Edit(NamedTuple):
    """An edit that pictures do not show yet."""

    what: str
    cure: str = NEW_SCENE
    follow: str = ""
    """What it changes, if pictures can follow: "shape", "materials", "emission", "lights" or "sky"."""


class Edits:
    """The objects that a scene was made from. Made anew whenever the scene reads its nodes again."""

    def __init__(self, scene: SceneContents) -> None:
        self.scene = scene
        self.slots = watched.slots_of(scene)
        self.material_count = len(scene.materials)
        self.pending: set[str] = set()
        """What is to be followed; an interrupt may leave it half done."""
        self.edited_nodes: set[int] = set()
        self.edited_textures: list[Texture] = []
        self.has_other_images = False
        self.lets_rays_pass = False
        self.are_keyframes_others = False
        """Whether nodes that move take another way since they were last taken over."""
        self.watches: dict[str, Watch] = {}
        self.lights: bytes | None = None
        self.sky_watch: Watch | None = None
        self.sky_map: SkyMap | None = None
        self._accept(set())

    def in_use(self) -> None:
        """Watch everything from now on: a device holds all that the scene is made of."""
        self._accept(set())
        self.sky_in_use()

    def _accept(self, changes: set[str]) -> None:
        """Watch again what has changed, by the names of watches; all of them if there are none."""
        scene, is_bare = self.scene, not self.scene._devices
        self.nodes, self.materials = list(scene.nodes), scene.materials[: self.material_count]
        if not changes or changes & {"nodes", "meshes"}:
            self.shapes = {i: watched.shape_of(node) for i, node in enumerate(scene.nodes) if deforms(node)}
        if is_bare:
            self.emissions = watched.emissions(self.materials)
        elif not changes or "lights" in changes:
            self.lights = watched.light_rows(scene.lights)
        owners = watched.geometry(scene) | ({} if is_bare else watched.shading(scene))
        for name in changes or owners:
            self.watches[name] = Watch(owners[name], bare=is_bare)

    def sky_in_use(self) -> None:
        """Watch the environment that devices hold now."""
        sky = self.scene.environment
        self.sky_map = None if sky is None else sky._map
        self.sky_watch = None if sky is None else Watch([(sky, ("color", "rotation", "scale"))])

    def changes(self) -> dict[str, list[Change]]:
        """Return the fields that may have been edited, by the names of watches that saw it; empty if none was."""
        found = {name: watch.changes() for name, watch in self.watches.items()}
        return {name: changes for name, changes in found.items() if changes}

    def check(self) -> None:
        """Take edits over, or raise SceneError for the first that pictures cannot follow; then none is taken over."""
        changes = self.changes()
        if not self.scene._devices:  # materials are read later
            self.scene._digests.forget("geometry", "images", "light")
        if not self.pending:
            self.edited_nodes, self.edited_textures = set(), []
            self.has_other_images = self.lets_rays_pass = False
        edits = [self._edit(change) for some in changes.values() for change in some] + [self._sky_edit()]
        if not self.scene._devices:
            edits.append(self._emission_edit())
        found = [edit for edit in edits if edit is not None]
        for edit in found:
            if not edit.follow:
                raise SceneError(
                    f"scene {self.scene.name!r}: {edit.what} after the scene was built, "
                    f"and pictures would not show it; {edit.cure}"
                )
        self.pending |= {edit.follow for edit in found}
        if self.are_keyframes_others:
            self.scene._digests.forget("motion")
            self.scene.moved += 1
            self.are_keyframes_others = False
        if self.pending:
            self._follow()
        if changes:
            self._accept(watched.stale(changes))
        elif found and not self.scene._devices:
            self.emissions = watched.emissions(self.materials)

    def _follow(self) -> None:
        """Let pictures show all edits that are pending."""
        scene, pending = self.scene, self.pending
        if "shape" in pending:
            following.reshape(scene, self.edited_nodes)
        if pending & {"materials", "emission"}:
            following.shade(scene, self.edited_textures, self.has_other_images, self.lets_rays_pass)
        if pending & {"lights", "emission"}:
            following.relight(scene)
        if "sky" in pending:
            scene.environment = scene.environment
        self.pending = set()

    def _edit(self, change: Change) -> Edit | None:
        owner, field = change
        if field in SHAPE_FIELDS or isinstance(owner, Skin | MorphTarget):
            return self._shape_edit(field)
        if isinstance(owner, Node):
            return self._meshes_edit(owner) if field == "meshes" else self._placement_edit(owner, field)
        if isinstance(owner, Mesh):
            return self._mesh_edit(owner)
        if isinstance(owner, Material):
            return self._material_edit(owner, field)
        if isinstance(owner, Texture):
            users = [
                m for m in self.scene.materials if any(getattr(m, slot) is owner for slot in textures.TEXTURE_SLOTS)
            ]
            edits = [edit for edit in (self._material_edit(material, "a texture") for material in users) if edit]
            return _first(edit for edit in edits if edit.follow == "emission") or _worst(edits)
        if isinstance(owner, PunctualLight) or field == "lights":
            return self._lights_edit(field)
        return self._nodes_edit() if field == "nodes" else self._materials_edit()

    # ---- geometry ----

    def _nodes_edit(self) -> Edit | None:
        """Return whether nodes were added, removed or replaced."""
        now, old = self.scene.nodes, self.nodes
        if len(now) != len(old):
            return Edit(f"node {watched.come_or_gone(now, old)}")
        edits = []
        for index, (node, former) in enumerate(zip(now, old, strict=True)):
            if node is not former:
                some = [
                    self._meshes_edit(node),
                    self._placement_edit(node, "parent_from_node"),
                    self._shape_edit("skin"),
                ]
                edits += [
                    edit._replace(what=f"node {index} {former.name!r} was replaced by another") for edit in some if edit
                ]
        return _worst(edits)

    def _placement_edit(self, node: Node, field: str) -> Edit | None:
        """Return whether something that rests is no longer where its copy is, because of a node."""
        scene, nodes = self.scene, self.scene.nodes
        index = _index(nodes, node)
        if index is None or len(nodes) != len(self.nodes):
            return None  # found as an edit of the list
        what = f"{field} of node {index} {node.name!r} changed"
        geometry.check_placement(node, index)
        world, moving = animation.world_matrices(nodes, 0.0), animation.moving_nodes(nodes)
        carries = {light.node for light in scene.lights}
        under, is_other = {index}, False
        for place in range(index, len(nodes)):
            parent = nodes[place].parent
            if parent in under:
                under.add(place)
            if place not in under:
                continue
            if scene._moving[place]:  # read for every frame; only hashes have to know
                self.are_keyframes_others = True
                continue
            stands = bool(self.slots[place]) and nodes[place].skin is None
            if moving[place] and (stands or place in carries):
                return Edit(what, f"move it with scene.animate({node.name!r}, keyframes), or {NEW_SCENE}")
            is_other |= (stands or place in carries) and not np.array_equal(world[place], scene._poses[place].matrix)
        for place, one in enumerate(nodes):
            bent = one.skin is not None and self.slots[place] and not scene._moving[place]
            if one.skin is not None and bent and under.intersection(one.skin.joints):
                if any(moving[joint] for joint in one.skin.joints):
                    return Edit(what, f"move it with scene.animate({node.name!r}, keyframes), or {NEW_SCENE}")
                is_other = True
        return Edit(what, follow="shape") if is_other else None

    def _shape_edit(self, field: str) -> Edit | None:
        """Return whether what changes the shape of meshes is other than it was."""
        scene, edit = self.scene, None
        for index, node in enumerate(scene.nodes):
            if watched.shape_of(node) != self.shapes.get(index):
                what = f"{field} of what bends node {index} {node.name!r} changed"
                if moving_nodes(scene.nodes) != scene._moving:
                    return Edit(what)
                self.edited_nodes.add(index)
                edit = edit or Edit(what, follow="shape")
        return edit

    def _meshes_edit(self, node: Node) -> Edit | None:
        """Return whether the meshes of a node are others."""
        index = _index(self.scene.nodes, node)
        if index is None or index >= len(self.slots):
            return None
        now, old = node.meshes, [slot.mesh for slot in self.slots[index]]
        if len(now) != len(old):
            return Edit(f"mesh {watched.come_or_gone(now, old)} (node {index} {node.name!r})")
        edits = []
        for mesh, slot in zip(now, self.slots[index], strict=True):
            edit = None if mesh is slot.mesh else self._slot_edit(mesh, slot, index)
            what = f"mesh {slot.mesh.name!r} of node {node.name!r} was replaced by mesh {mesh.name!r}"
            edits += [] if edit is None else [edit._replace(what=what)]
        return _worst(edits)

    def _mesh_edit(self, mesh: Mesh) -> Edit | None:
        """Return whether a mesh is no longer like its copies."""
        edits = (self._slot_edit(mesh, slot, index) for index, candidate, slot in self._meshes() if candidate is mesh)
        return _worst(edit for edit in edits if edit)

    def _meshes(self) -> Iterator[tuple[int, Mesh, watched.Slot]]:
        """Yield the meshes that the nodes have now, with the index of the node and the place of the copy."""
        for index, (node, slots) in enumerate(zip(self.scene.nodes, self.slots, strict=False)):
            for mesh, slot in zip(node.meshes, slots, strict=False):
                yield index, mesh, slot

    def _slot_edit(self, mesh: Mesh, slot: watched.Slot, index: int) -> Edit | None:
        """Return whether a mesh differs from a copy."""
        node = self.scene.nodes[index]
        geometry.check_mesh(mesh, f"mesh {mesh.name!r} of node {node.name!r}")
        of = f"of mesh {mesh.name!r} (node {index} {node.name!r}) changed"
        if len(mesh.points) != slot.vertices.stop - slot.vertices.start:
            return Edit(f"points {of} in number")
        flat, differs = self.scene._flat, []
        part = geometry.flatten([Node("", [mesh])], [mesh.material], [self.scene._poses[index]])
        part.indices += slot.vertices.start
        for field, place in (
            ("uvs", slot.vertices),
            ("further_uvs", slot.vertices),
            ("colors", slot.vertices),
            ("indices", slot.triangles),
            ("points", slot.vertices),
            ("normals", slot.vertices),
        ):
            if not geometry.is_copy(field, getattr(part, field), getattr(flat, field), place):
                differs.append(field)
        used = len(part.indices) and slot.row < len(self.scene.materials)
        if used and not alike(mesh.material, self.scene.materials[slot.row]):
            cure = f"edit the fields of its material, or {NEW_SCENE}"
            return Edit(f"material {of}", cure)
        if not differs:
            return None
        if differs[0] in ("points", "normals"):
            self.edited_nodes.add(index)
            return Edit(f"{differs[0]} {of}", follow="shape")
        return Edit(f"{differs[0]} {of}")

    # ---- shading ----

    def _materials_edit(self) -> Edit | None:
        """Return whether the list of materials lacks one, or has another instead."""
        scene, now = self.scene, self.scene.materials
        cure = f"give meshes their material (mesh.material = ...), and {NEW_SCENE}"
        if len(now) < self.material_count:
            return Edit(f"material {watched.come_or_gone(now, self.materials)} in scene.materials", cure)
        if not scene._devices:
            return None  # read later
        data = next(iter(scene._devices.values())).data
        for row, (material, old) in enumerate(zip(now, self.materials, strict=False)):
            if material is not old and _first(row_edits(material, data, row, "a field")):
                return Edit(f"material {row} {old.name!r} was replaced in scene.materials", cure)
        return None

    def _material_edit(self, material: Material, hint: str) -> Edit | None:
        """Return whether a material is no longer like its copies on devices; ``hint`` names the field if need be."""
        scene = self.scene
        if not scene._devices:
            return None  # read later
        data = next(iter(scene._devices.values())).data
        for row, candidate in enumerate(scene.materials[: self.material_count]):
            if candidate is not material:
                continue
            textures.check_material(material)
            fields = list(row_edits(material, data, row, hint))
            if not fields:
                continue
            self.lets_rays_pass |= passes_rays(data, row) or material.lets_rays_pass
            if any(field.startswith(textures.TEXTURE_SLOTS) for field in fields):
                self.edited_textures += textures.distinct_textures([material])
                self.has_other_images = True
            emits = any(field.startswith(EMITTING) for field in fields)
            return Edit(f"{fields[0]} of {material.name!r}", follow="emission" if emits else "materials")
        for _, mesh, slot in self._meshes():
            if mesh.material is material and not alike(material, scene.materials[slot.row]):
                # meshes have this material in place of the scene's own
                return Edit(f"{hint} of material {material.name!r} changed")
        return None

    def _emission_edit(self) -> Edit | None:
        """Return whether other triangles emit than when the scene was made; materials are read later."""
        materials = self.scene.materials
        if (
            len(materials) < self.material_count
            or watched.emissions(materials[: self.material_count]) == self.emissions
        ):
            return None
        for material in materials:
            textures.check_material(material)
        return Edit("emission changed", follow="lights")

    # ---- lights and sky ----

    def _lights_edit(self, field: str) -> Edit | None:
        """Return whether punctual lights are no longer like their copies."""
        for light in self.scene.lights:
            emitters.check_light(light, self.scene.nodes)
        is_same = self.lights is None or watched.light_rows(self.scene.lights) == self.lights
        return None if is_same else Edit(f"{field} of lights changed", follow="lights")

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
        follow = "" if self.scene.is_sky_animated else "sky"
        if is_other:
            return Edit("pixels of the environment changed", NEW_SKY, follow)
        for _, field in self.sky_watch.changes() if self.sky_watch else ():
            device = next(iter(self.scene._devices.values()))
            old, new = device.data.environment, sky.data(device.device)
            if any(
                np.any(np.asarray(getattr(old, name)) != np.asarray(getattr(new, name)))
                for name in ("kind", "radiance", "environment_from_world")
            ):
                return Edit(f"{field} of the environment changed", NEW_SKY, follow)
        return None


def _index(items: Iterable[object], wanted: object) -> int | None:
    return next((index for index, item in enumerate(items) if item is wanted), None)


def _first(items: Iterable[Any]) -> Any:
    return next(iter(items), None)


def _worst(edits: Iterable[Edit]) -> Edit | None:
    """Return an edit that cannot be followed, if there is one, else the first."""
    known = list(edits)
    return _first(edit for edit in known if not edit.follow) or _first(known)
