"""Meshes of glTF: primitives with their attributes and morph targets."""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from warp_gi.scene.files.gltf_buffers import Buffers
from warp_gi.scene.files.gltf_compressed import DRACO, draco_attributes
from warp_gi.scene.files.gltf_document import Document, Part
from warp_gi.scene.files.gltf_materials import Coordinates, MaterialReader
from warp_gi.scene.files.gltf_skins import Bones, vertex_joints
from warp_gi.scene.model import Mesh, MorphTarget
from warp_gi.scene.poses import morphed

TRIANGLES, TRIANGLE_STRIP, TRIANGLE_FAN = 4, 5, 6
FURTHER_SET = re.compile(r"(COLOR|TEXCOORD|JOINTS|WEIGHTS)_[1-9]\d*")


class MeshReader:
    """Makes the meshes of a document, each once for each set of morph weights and each skin."""

    def __init__(self, document: Document, buffers: Buffers) -> None:
        self.document, self.buffers = document, buffers
        self.materials = MaterialReader(document, buffers)
        self._meshes: dict[tuple[int, tuple[float, ...] | None, int], list[Mesh]] = {}

    def meshes(
        self, index: int, owner: str, weights: Sequence[float] | None, bones: Bones | None = None, morphs: bool = False
    ) -> list[Mesh]:
        """Return mesh ``index`` as one mesh a primitive; ``weights`` of morph targets replace the mesh's own.

        With ``bones`` the vertices have their joints. ``morphs`` keeps the targets, for weights that change.
        """
        source = self.document.item("meshes", index, owner)
        name = self.document.name("meshes", index)
        if weights is None:
            weights = self.document.weights(source, name) or ()
        blend = None if morphs else tuple(weights) if any(weights) else ()
        key = index, blend, id(bones)
        if key not in self._meshes:
            primitives = self.document.objects(source, "primitives", name)
            if not primitives:
                raise self.document.error(
                    name, "primitives must list at least one" if "primitives" in source else "lacks primitives"
                )
            label = self.document.text(source, "name") or name
            found = (self._primitive(one, name, label, blend, bones) for one in primitives)
            self._meshes[key] = [mesh for mesh in found if mesh is not None]
        return self._meshes[key]

    def _primitive(
        self, source: Part, owner: str, label: str, weights: Sequence[float] | None, bones: Bones | None
    ) -> Mesh | None:
        """Return one primitive as a mesh, or None if it is not made of triangles; no weights keep its targets."""
        document = self.document
        mode = source.get("mode", TRIANGLES)
        if mode not in (TRIANGLES, TRIANGLE_STRIP, TRIANGLE_FAN):
            if mode not in range(TRIANGLES):
                raise document.error(owner, f"mode must be from 0 to 6, got {mode!r:.60}")
            document.findings.add("points and lines", owner)
            return None
        attributes = document.part(source, "attributes", owner)
        if attributes is None:
            raise document.error(owner, "a primitive of it lacks attributes")
        if attributes.get("POSITION") is None:
            document.findings.add("primitives without positions", owner)
            return None
        mode = self._decompressed(source, attributes, owner, mode)
        for what, number in (("POSITION", attributes["POSITION"]), ("indices", source.get("indices"))):
            if number is not None and not self.buffers.has_data(number, owner):
                raise document.error(
                    owner, f"{what} is accessor {number}, which holds no data; export it without compression"
                )
        points = np.ascontiguousarray(self.buffers.accessor(attributes["POSITION"], owner, (3,)), np.float32)
        corners = np.arange(len(points))
        if source.get("indices") is not None:
            corners = self.buffers.accessor(source["indices"], owner, (1,))
            if corners.dtype.kind not in "iu":
                raise document.error(owner, "indices must be whole numbers")
        if mode == TRIANGLES and len(corners) % 3:
            raise document.error(owner, f"has {len(corners)} indices, not a multiple of 3")
        normals = self._attribute(attributes, "NORMAL", owner, len(points), (3,))
        targets = []
        if weights is None or any(weights):
            targets = self._targets(source, owner, len(points), weights)
        if weights is not None:
            points, normals = morphed(Mesh(points, corners, normals=normals, targets=targets), np.array(weights))
            targets, points = [], points.astype(np.float32)
        joints, joint_weights = None, None
        if bones is not None:
            joints, joint_weights = vertex_joints(document, self.buffers, attributes, owner, len(points), bones)
        index = None if source.get("material") is None else document.whole(source, "material", owner)
        material, coordinates = self.materials.material(index, owner)
        self._note(attributes, owner)
        return Mesh(
            points,
            _triangles(corners.astype(np.int64), mode),
            material,
            None if normals is None else np.ascontiguousarray(normals, np.float32),
            self._uvs(attributes, coordinates, owner, len(points)),
            label,
            further_uvs=None
            if coordinates.further is None
            else self._uvs(attributes, Coordinates(coordinates.further, needed=True), owner, len(points)),
            colors=self._colors(attributes, owner, len(points)),
            targets=targets,
            joints=joints,
            joint_weights=joint_weights,
        )

    def _decompressed(self, source: Part, attributes: Part, owner: str, mode: int) -> int:
        """Fill accessors from the primitive's Draco data, if their numbers are there alone; return the mode then."""
        packed = self.document.extension(source, DRACO, owner)
        if packed is None or self.buffers.has_data(attributes["POSITION"], owner):
            return mode
        names = self.document.part(packed, "attributes", owner) or {}
        view = self.buffers.view(packed.get("bufferView"), owner)
        for name, values in draco_attributes(self.document, view, names, owner).items():
            number = source.get("indices") if name == "indices" else attributes.get(name)
            if number is not None:
                self.buffers.fill(number, owner, values.reshape(len(values), -1))
        return TRIANGLES  # whatever they were

    def _attribute(
        self, attributes: Part, name: str, owner: str, count: int, widths: tuple[int, ...]
    ) -> np.ndarray | None:
        """Return an attribute of each vertex, or None."""
        if attributes.get(name) is None:
            return None
        values = self.buffers.accessor(attributes[name], f"{name} of {owner}", widths)
        if len(values) != count:
            raise self.document.error(owner, f"has {count} positions and {len(values)} values of {name}")
        return values

    def _uvs(self, attributes: Part, wanted: Coordinates, owner: str, count: int) -> np.ndarray | None:
        """Return the texture coordinates that a material asks for, v up."""
        uvs = self._attribute(attributes, f"TEXCOORD_{wanted.number}", owner, count, (2,))
        if uvs is None:
            if wanted.needed:
                self.document.findings.add("textures without their coordinates", f"TEXCOORD_{wanted.number} of {owner}")
            return None
        uvs = uvs @ wanted.transform[:2, :2].T.astype(np.float32) + wanted.transform[:2, 2]
        return np.stack([uvs[:, 0], 1.0 - uvs[:, 1]], axis=1).astype(np.float32)

    def _colors(self, attributes: Part, owner: str, count: int) -> np.ndarray | None:
        """Return COLOR_0, linear, from 0 to 1; None if all of it is 1."""
        colors = self._attribute(attributes, "COLOR_0", owner, count, (3, 4))
        if colors is None:
            return None
        if colors.dtype.kind in "iu":  # glTF asks for normalized ones, and some writers forget to say so
            colors = colors / np.float32(np.iinfo(colors.dtype.name).max)
        colors = np.clip(np.nan_to_num(np.asarray(colors, np.float32), nan=1.0), 0.0, 1.0)
        return None if (colors == 1.0).all() else np.ascontiguousarray(colors)

    def _targets(self, source: Part, owner: str, count: int, weights: Sequence[float] | None) -> list[MorphTarget]:
        """Return the morph targets of a primitive; those with a weight of zero are empty."""
        targets = self.document.objects(source, "targets", owner)
        if weights is not None and len(targets) != len(weights):
            raise self.document.error(owner, f"has {len(targets)} morph targets and {len(weights)} weights")
        found = []
        for target, weight in zip(targets, [1.0] * len(targets) if weights is None else weights, strict=True):
            if weight and any(name.startswith(("COLOR_", "TEXCOORD_")) for name in target):
                self.document.findings.add("morph targets of colours and texture coordinates", owner)
            parts = [
                None if values is None or not weight else np.ascontiguousarray(values, np.float32)
                for values in (self._attribute(target, name, owner, count, (3,)) for name in ("POSITION", "NORMAL"))
            ]
            found.append(MorphTarget(*parts))
        return found

    def _note(self, attributes: Part, owner: str) -> None:
        """Note attributes that are not read."""
        findings = self.document.findings
        if attributes.get("TANGENT") is not None:
            findings.add("tangents", owner)
        for name in attributes:
            match = FURTHER_SET.fullmatch(name)
            if match and match[1] == "COLOR":
                findings.add("COLOR_1 and above", owner)


def _triangles(corners: np.ndarray, mode: int) -> np.ndarray:
    """Return int32 [triangle, 3] of a list, strip or fan of vertices."""
    if mode == TRIANGLES:
        return corners.reshape(-1, 3).astype(np.int32)
    count = max(len(corners) - 2, 0)
    first = np.arange(count)
    if mode == TRIANGLE_FAN:
        rows = np.stack([first + 1, first + 2, np.zeros_like(first)], axis=1)
    else:
        odd = first % 2
        rows = np.stack([first, first + 1 + odd, first + 2 - odd], axis=1)
    return corners[rows].reshape(-1, 3).astype(np.int32)
