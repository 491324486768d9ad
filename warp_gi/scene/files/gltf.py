"""glTF 2.0 and GLB files: hierarchy, meshes, skins, materials, cameras, punctual lights and animation.

What becomes of each feature of the format is in the table of ``support.py``. What a file uses and is not read in
full is noted there; unknown extensions that a file requires are an error.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from warp_gi.errors import OptionError, SceneError
from warp_gi.scene.animation import moving_nodes, pose_matrix, world_matrices
from warp_gi.scene.files.gltf_animation import read_animations
from warp_gi.scene.files.gltf_buffers import Buffers, split_glb
from warp_gi.scene.files.gltf_compressed import BASISU, INSTALL, decoder
from warp_gi.scene.files.gltf_document import Document, Part
from warp_gi.scene.files.gltf_meshes import MeshReader
from warp_gi.scene.files.gltf_skins import Bones, SkinReader
from warp_gi.scene.files.parts import SceneParts
from warp_gi.scene.files.support import BY_NAME
from warp_gi.scene.model import Node, PunctualLight
from warp_gi.scene.pinhole import Camera

DRAWN = ("mesh", "skin", "weights")
"""Fields of a node that a hidden one has not; its light is left out, too."""
MOST_NODES = 1_000_000  # instances are nodes, too
CAMERA_HEIGHT = 540  # pixels; a glTF camera has a shape but no resolution


def read_gltf(path: Path) -> SceneParts:
    """Read a .glb or .gltf file; raises SceneError."""
    data = path.read_bytes()
    is_binary = path.suffix.lower() == ".glb" or data[:4] == b"glTF"  # whatever its name is
    text, binary = split_glb(memoryview(data), path) if is_binary else (data, None)
    document = Document(text, path)
    _check_extensions(document)
    return _Reader(document, Buffers(document, binary)).parts()


def _check_extensions(document: Document) -> None:
    """Raise SceneError for required extensions that are not supported, and note others that are not read in full."""
    read = {name for name, one in BY_NAME.items() if one.status in ("supported", "approximated")}
    required = set(document.listed_extensions("extensionsRequired"))
    for name in sorted(required & INSTALL.keys()):
        decoder(document, name)  # raises what to install
    if BASISU in required:
        raise SceneError(
            f"{str(document.path)!r} requires {BASISU}, whose KTX2 textures cannot be read; export it with PNG or JPEG"
            " textures, or let gltf-transform turn them into such"
        )
    unknown = sorted(required - read)
    if unknown:
        raise SceneError(
            f"{str(document.path)!r} requires {', '.join(unknown)}, which is not supported; export it without"
        )
    for name, places in document.used_extensions().items():
        feature = BY_NAME.get(name)
        if feature is not None and feature.status in ("supported", "refused"):
            continue  # a file that can do without what is refused has other data beside it
        for place in places or ("",):
            document.findings.add(name, place)


class _Reader:
    def __init__(self, document: Document, buffers: Buffers) -> None:
        self.document, self.buffers, self.path = document, buffers, document.path
        self.meshes, self.skins = MeshReader(document, buffers), SkinReader(document, buffers)
        self.animations = read_animations(document, buffers)

    def parts(self) -> SceneParts:
        """Return nodes in depth-first order, with what hangs on them."""
        nodes: list[Node] = []
        sources: list[tuple[Part, str]] = []
        names = _Names()
        pending: list[tuple[int, int | None, str]] = [(index, None, "the scene") for index in reversed(self._roots())]
        numbers: dict[int, int] = {}
        bent: list[tuple[Node, Bones, str]] = []
        hidden: set[int] = set()
        while pending:
            index, parent, owner = pending.pop()
            source = self.document.item("nodes", index, owner)
            if index in numbers:
                raise SceneError(f"{str(self.path)!r}: node {index} hangs on two parents or on itself")
            numbers[index] = len(nodes)
            owner = self.document.name("nodes", index)
            if parent in hidden or self._is_hidden(source, owner):
                hidden.add(len(nodes))
                source = {key: value for key, value in source.items() if key not in DRAWN}
            children = self.document.indices(source, "children", owner)
            pending.extend((child, len(nodes), owner) for child in reversed(children))
            sources.append((source, owner))
            bones = self._bones(source, owner)
            nodes.append(self._node(source, owner, names, parent, bones, index))
            if bones is not None:
                bent.append((nodes[-1], bones, owner))
            copies = self._instances(source, owner, nodes[-1], names, len(nodes) - 1)
            nodes += copies
            sources += [({}, owner)] * len(copies)
        for node, bones, owner in bent:
            node.skin = bones.placed(self.document, numbers, owner)
        return self._with_lights_and_cameras(nodes, sources, hidden)

    def _is_hidden(self, source: Part, owner: str) -> bool:
        """Return whether KHR_node_visibility hides a node, with all below it; its joints and cameras are there."""
        shown = (self.document.extension(source, "KHR_node_visibility", owner) or {}).get("visible", True)
        if not isinstance(shown, bool):
            raise self.document.error(owner, f"visible of KHR_node_visibility must be true or false, got {shown!r:.60}")
        return not shown

    def _bones(self, source: Part, owner: str) -> Bones | None:
        """Return the skin of a node's meshes, or None."""
        if source.get("skin") is None or source.get("mesh") is None:
            return None
        return self.skins.bones(self.document.whole(source, "skin", owner), owner)

    def _node(
        self, source: Part, owner: str, names: _Names, parent: int | None, bones: Bones | None, index: int
    ) -> Node:
        document = self.document
        weights, morphs = document.weights(source, owner), self.animations.morphs.get(index)
        if morphs is not None and len(morphs) == 1:
            weights, morphs = morphs[0].weights, None
        node = Node(names.unique(document.text(source, "name") or owner), [], self._matrix(source, owner), parent)
        node.keyframes = self.animations.keyframes.get(index)
        if source.get("mesh") is not None:
            number = document.whole(source, "mesh", owner)
            node.meshes = list(self.meshes.meshes(number, owner, weights, bones, morphs is not None))
            node.morphs = morphs
        return node

    def _instances(self, source: Part, owner: str, node: Node, names: _Names, index: int) -> list[Node]:
        """Return the copies of a node's meshes that EXT_mesh_gpu_instancing asks for, and take them from the node."""
        extension = self.document.extension(source, "EXT_mesh_gpu_instancing", owner)
        if extension is None or not node.meshes:
            return []
        if source.get("skin") is not None:
            self.document.findings.add("instances of meshes with a skin", owner)
            return []
        given = self.document.part(extension, "attributes", owner) or {}
        if not given:
            raise self.document.error(owner, "EXT_mesh_gpu_instancing lacks attributes; export it without")
        widths = {"TRANSLATION": 3, "ROTATION": 4, "SCALE": 3}
        for name in given:
            if name not in widths and ("COLOR" in name or not name.startswith("_")):
                self.document.findings.add("other attributes of instances", f"{name} of {owner}")
        for name in (name for name in widths if given.get(name) is not None):
            number = self.document.whole(self.document.item("accessors", given[name], owner), "count", owner)
            if index + number >= MOST_NODES:
                raise self.document.error(
                    owner, f"has {number:,} instances; at most {MOST_NODES:,} nodes are supported"
                )
        values = {
            name: self.buffers.accessor(given[name], f"{name} of {owner}", (width,))
            for name, width in widths.items()
            if given.get(name) is not None
        }
        turns = values.get("ROTATION")
        if turns is not None and not turns.any(axis=1).all():
            raise self.document.error(owner, f"rotation of instance {int(np.argmin(turns.any(axis=1)))} is zeros")
        counts = {len(one) for one in values.values()}
        if len(counts) > 1:
            raise self.document.error(owner, f"its instances have {' and '.join(map(str, sorted(counts)))} values")
        count = counts.pop() if counts else 0
        rest = {"TRANSLATION": (0.0,) * 3, "ROTATION": (0.0, 0.0, 0.0, 1.0), "SCALE": (1.0,) * 3}
        matrices = pose_matrix(*(values.get(name, np.tile(one, (count, 1))) for name, one in rest.items()))
        meshes, morphs, node.meshes, node.morphs = node.meshes, node.morphs, [], None
        return [
            Node(names.unique(f"{node.name} {i + 1}"), list(meshes), one, index, morphs=morphs)
            for i, one in enumerate(matrices)
        ]

    def _matrix(self, source: Part, owner: str) -> np.ndarray:
        if source.get("matrix") is not None:
            if {"translation", "rotation", "scale"} & source.keys():
                self.document.findings.lost.append(
                    f"{str(self.document.path)!r}: {owner} has a matrix, and translation, rotation or scale as well;"
                    " the matrix counts"
                )
            values = self.document.numbers(source, "matrix", owner, (0.0,) * 16)
            matrix = np.array(values, np.float64).reshape(4, 4).T
            if not np.allclose(matrix[3], (0.0, 0.0, 0.0, 1.0), rtol=0.0, atol=1e-6):
                self.document.findings.lost.append(
                    f"{str(self.document.path)!r}: the last row of the matrix of {owner} must be 0 0 0 1, got"
                    f" {matrix[3].tolist()}; it counts as if it were"
                )
            matrix[3] = (0.0, 0.0, 0.0, 1.0)
            return matrix
        rest = {"translation": (0.0,) * 3, "rotation": (0.0, 0.0, 0.0, 1.0), "scale": (1.0,) * 3}
        if not rest.keys() & source.keys():
            return np.eye(4)
        translation, rotation, scale = (self.document.numbers(source, key, owner, one) for key, one in rest.items())
        if not any(rotation):
            raise self.document.error(owner, "rotation must be a unit quaternion, got zeros")
        return pose_matrix(translation, rotation, scale)

    def _roots(self) -> list[int]:
        scenes = self.document.items("scenes")
        if len(scenes) > 1:
            self.document.findings.add("further scenes")
        if scenes:
            number = self.document.whole(self.document.root, "scene", "the file", 0)
            return self.document.indices(self.document.item("scenes", number, "the file"), "nodes", f"scene {number}")
        nodes = self.document.items("nodes")
        children = {
            child for i, node in enumerate(nodes) for child in self.document.indices(node, "children", f"node {i}")
        }
        return [index for index in range(len(nodes)) if index not in children]

    def _with_lights_and_cameras(
        self, nodes: list[Node], sources: list[tuple[Part, str]], hidden: set[int]
    ) -> SceneParts:
        document = self.document
        parts = SceneParts(nodes, findings=document.findings)
        moving, world = moving_nodes(nodes), world_matrices(nodes, 0.0)
        listed = document.extension(document.root, "KHR_lights_punctual", "the file") or {}
        described = document.objects(listed, "lights", "KHR_lights_punctual")
        names = _Names()
        for index, (source, owner) in enumerate(sources):
            extension = document.extension(source, "KHR_lights_punctual", owner)
            if extension is not None and index not in hidden:
                number = document.whole(extension, "light", owner)
                if number >= len(described):
                    raise document.error(owner, f"names light {number}, and the file has {len(described)} lights")
                light = self._light(described[number], nodes[index].name)
                parts.lights.append(replace(light, node=index) if moving[index] else _placed(light, world[index]))
            if source.get("camera") is not None:
                camera = self._camera(document.whole(source, "camera", owner), owner, world[index], nodes[index].name)
                if camera is not None:
                    name = names.unique(camera.name)
                    parts.cameras[name] = replace(camera, name=name)
                    parts.camera_nodes[name] = index
        return parts

    def _camera(self, index: int, owner: str, world_from_node: np.ndarray, node: str) -> Camera | None:
        document = self.document
        source = document.item("cameras", index, owner)
        what = document.name("cameras", index)
        lens = document.part(source, "perspective", what)
        parallel = document.part(source, "orthographic", what)
        name = document.text(source, "name") or node
        try:
            if parallel is not None and (lens is None or source.get("type") == "orthographic"):
                across, up = (document.number(parallel, mag, what) for mag in ("xmag", "ymag"))
                if not (across > 0 and up > 0):
                    raise OptionError(f"{what} must have xmag and ymag above 0, got {across:g} and {up:g}")
                return Camera(world_from_node, resolution=_shape(across / up), name=name, ortho_width=2 * across)
            if lens is None:
                raise OptionError(f"{what} has neither a perspective nor an orthographic lens")
            aspect = document.number(lens, "aspectRatio", what, 16.0 / 9.0)
            vfov = document.number(lens, "yfov", what)
            if not 0.0 < vfov < math.pi:
                raise OptionError(f"{what} must have a yfov between 0 and pi radians, got {vfov:g}")
            if not aspect > 0.0:
                raise OptionError(f"{what} must have an aspectRatio above 0, got {aspect:g}")
            hfov = 2.0 * math.degrees(math.atan(math.tan(vfov / 2.0) * aspect))
            is_free = lens.get("aspectRatio") is None
            return Camera(world_from_node, hfov, _shape(aspect), name, keeps_vertical=is_free)
        except OptionError as error:
            document.findings.lost.append(f"{str(self.path)!r}: {error}; it is left out")
            return None

    def _light(self, source: Part, node: str) -> PunctualLight:
        document = self.document
        name = document.text(source, "name") or node
        owner = f"light {name!r}"
        strength = document.number(source, "intensity", owner, 1.0)
        red, green, blue = (strength * x for x in document.numbers(source, "color", owner, (1.0,) * 3))
        spot = document.part(source, "spot", owner) or {}
        return PunctualLight(
            document.text(source, "type") or "point",
            (red, green, blue),
            inner_cone=document.number(spot, "innerConeAngle", owner, 0.0),
            outer_cone=document.number(spot, "outerConeAngle", owner, math.pi / 4),
            range=None if source.get("range") is None else document.number(source, "range", owner),
            name=name,
        )


class _Names:
    """Gives each part a name of its own."""

    def __init__(self) -> None:
        self.taken: dict[str, int] = {}

    def unique(self, name: str) -> str:
        """Return ``name``, with a number if it is taken, and take it."""
        result = name
        while result in self.taken:
            self.taken[name] += 1
            result = f"{name} {self.taken[name]}"
        self.taken[result] = 1
        return result


def _shape(aspect: float) -> tuple[int, int]:
    """Return a resolution of so many times its height across."""
    return max(1, round(CAMERA_HEIGHT * aspect)), CAMERA_HEIGHT


def _placed(light: PunctualLight, world_from_node: np.ndarray) -> PunctualLight:
    """Return a light that does not move in world space."""
    direction = -world_from_node[:3, 2] / np.linalg.norm(world_from_node[:3, 2])
    return replace(light, position=tuple(world_from_node[:3, 3].tolist()), direction=tuple(direction.tolist()))
