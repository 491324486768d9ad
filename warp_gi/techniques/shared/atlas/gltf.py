"""The surfaces of a scene with the coordinates of an atlas, as triangles that other programs draw, and as glTF."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib

from warp_gi.errors import BakeError
from warp_gi.scene.files.gltf_materials import WRAP_MODES
from warp_gi.scene.model import Material, Texture
from warp_gi.scene.scene import Scene
from warp_gi.techniques.shared.atlas.atlas import Atlas

FLOAT, UINT = 5126, 5125
"""Component types of glTF."""
ATTRIBUTES = {
    "POSITION": "points",
    "NORMAL": "normals",
    "TEXCOORD_0": "uvs",
    "TEXCOORD_1": "atlas_uvs",
    "TEXCOORD_2": "further_uvs",
    "COLOR_0": "colors",
}
TEXTURES = {
    "base_color_texture": "baseColorTexture",
    "metallic_roughness_texture": "metallicRoughnessTexture",
    "normal_texture": "normalTexture",
    "emission_texture": "emissiveTexture",
}
COAT_TEXTURES = {"specular_texture": "specularTexture", "reflectance_texture": "specularColorTexture"}
_PNG_LEVEL = 3  # of 9: a third of the time for a twentieth more bytes


@dataclass(frozen=True, eq=False)
class DrawnTriangles:
    """Triangles of one page and one material. Vertices are split where normals or coordinates of two faces differ."""

    page: int
    """Page of the atlas; -1 for faces without texels: what moves, and what has no area."""
    material: int
    """Index in the scene's materials."""
    points: np.ndarray
    """Positions in metres in the world, at time 0, float32 [vertex, 3]."""
    normals: np.ndarray
    """Unit normals, float32 [vertex, 3]; those of the faces where shading is flat."""
    uvs: np.ndarray
    """Texture coordinates of the materials' textures, v down, float32 [vertex, 2]."""
    atlas_uvs: np.ndarray
    """Coordinates in the page, 0 to 1, v down, float32 [vertex, 2]; 0 without a page."""
    colors: np.ndarray | None
    """Linear colours and coverage, float32 [vertex, 4]; None if the scene has none."""
    further_uvs: np.ndarray | None
    """Second set of coordinates of the materials' textures, v down, float32 [vertex, 2]; None if there is none."""
    indices: np.ndarray
    """Vertices of each triangle, uint32 [triangle, 3], counter-clockwise seen from the front."""
    faces: np.ndarray
    """Index in the scene of each triangle, int64 [triangle]."""


def atlas_uvs(atlas: Atlas, faces: np.ndarray) -> np.ndarray:
    """Return coordinates in their page of the corners of faces, v down, float32 [face, 3, 2]; 0 without a page."""
    pages = atlas.face_pages[faces]
    sizes = atlas.pages[np.maximum(pages, 0), 1:].astype(np.float32)
    uvs = np.clip(atlas.corners[faces] / sizes[:, None], 0.0, 1.0)
    return np.where((pages >= 0)[:, None, None], uvs, np.float32(0)).astype(np.float32)


def drawn_triangles(scene: Scene, atlas: Atlas) -> Iterator[DrawnTriangles]:
    """Yield all triangles of a scene by page and material.

    Raises BakeError for an atlas of another scene.
    """
    flat = scene._flat
    if len(atlas.face_pages) != len(flat.indices):
        raise BakeError(
            f"this bake is of a scene of {len(atlas.face_pages):,} triangles, {scene.name!r} has "
            f"{len(flat.indices):,}: bake it again"
        )
    keys = np.stack([atlas.face_pages, flat.materials], axis=1)
    for page, material in np.unique(keys, axis=0):
        faces = np.flatnonzero((atlas.face_pages == page) & (flat.materials == material))
        ids = flat.indices[faces]
        points = flat.points[ids]
        flat_normals = np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0])
        lengths = np.linalg.norm(flat_normals, axis=1, keepdims=True)
        flat_normals = np.where(lengths > 0, flat_normals / np.where(lengths > 0, lengths, 1), (0.0, 1.0, 0.0))
        normals = flat.normals[ids]
        is_smooth = normals.any(axis=2, keepdims=True)
        normals = np.where(is_smooth, normals, flat_normals[:, None]).astype(np.float32)
        uvs = flat.uvs[ids] * np.array((1, -1), np.float32) + np.array((0, 1), np.float32)
        parts = [points, normals, uvs, atlas_uvs(atlas, faces)]
        if flat.colors is not None:
            parts.append(flat.colors[ids])
        if flat.further_uvs is not None:
            parts.append(flat.further_uvs[ids] * np.array((1, -1), np.float32) + np.array((0, 1), np.float32))
        rows = np.concatenate(parts, axis=2).reshape(3 * len(faces), -1)
        rows = np.ascontiguousarray(rows, np.float32) + np.float32(0)  # -0 is 0
        words = rows.view(np.dtype((np.void, rows.itemsize * rows.shape[1]))).ravel()
        _, first, vertices = np.unique(words, return_index=True, return_inverse=True)
        order = np.argsort(first, kind="stable")  # vertices as faces meet them
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        kept = rows[first[order]]
        indices = rank[vertices.reshape(-1, 3)].astype(np.uint32)
        columns = kept[:, :3], kept[:, 3:6], kept[:, 6:8], kept[:, 8:10]
        colors = None if flat.colors is None else kept[:, 10:14]
        further = None if flat.further_uvs is None else kept[:, -2:]
        yield DrawnTriangles(int(page), int(material), *columns, colors, further, indices, faces)


def glb(scene: Scene, atlas: Atlas, generator: str, extras: dict[str, str] | None = None) -> bytes:
    """Return a scene at time 0 as a binary glTF file, whose TEXCOORD_1 are the coordinates in the atlas.

    A node for each page ("page 0", with the page in its extras), in which there is a primitive for each material;
    faces without a page are in the node "no page". ``generator`` is what the file says that it was made by,
    ``extras`` are those of its scene. Raises BakeError for an atlas of another scene.
    """
    writer = _Writer(pygltflib.GLTF2(asset=pygltflib.Asset(version="2.0", generator=generator), scene=0))
    document = writer.document
    document.materials = [writer.material(material) for material in scene.materials]
    for drawn in drawn_triangles(scene, atlas):
        name = "no page" if drawn.page < 0 else f"page {drawn.page}"
        if not document.nodes or document.nodes[-1].name != name:
            page = {"page": drawn.page} if drawn.page >= 0 else {}
            document.nodes.append(pygltflib.Node(name=name, mesh=len(document.meshes), extras=page))
            document.meshes.append(pygltflib.Mesh(name=name))
        attributes = pygltflib.Attributes()
        for attribute, field in ATTRIBUTES.items():
            values = getattr(drawn, field)
            if values is not None and (drawn.page >= 0 or attribute != "TEXCOORD_1"):
                setattr(attributes, attribute, writer.vertices(values, attribute == "POSITION"))
        indices = writer.accessor(drawn.indices.reshape(-1), UINT, "SCALAR", pygltflib.ELEMENT_ARRAY_BUFFER)
        primitive = pygltflib.Primitive(attributes=attributes, indices=indices, material=drawn.material)
        document.meshes[-1].primitives.append(primitive)
    document.scenes = [pygltflib.Scene(name=scene.name, nodes=list(range(len(document.nodes))), extras=extras or {})]
    return writer.whole()


def transform_record(rows: Sequence[Sequence[float]]) -> dict[str, Any]:
    """Return an affine map of coordinates, v up, as KHR_texture_transform has it, v down; it knows no shear."""
    (a, b, c), (d, e, f) = rows
    m = np.array([[a, -b, b + c], [-d, e, 1.0 - e - f]])  # v down
    angle = float(np.arctan2(-m[1, 0], m[0, 0]))
    along = np.hypot(m[0, 0], m[1, 0])
    across = m[0, 1] * np.sin(angle) + m[1, 1] * np.cos(angle)
    return {"offset": m[:, 2].tolist(), "rotation": angle, "scale": [float(along), float(across)]}


def generator_of(file: Path) -> str:
    """Return what a .glb or .gltf file says that it was made by. What a file that is none raises is any error."""
    with open(file, "rb") as opened:
        head = opened.read(20)  # the header, then the length of the JSON chunk and its type
        if head[:4] == b"glTF":
            said = json.loads(opened.read(int.from_bytes(head[12:16], "little")))
        else:
            said = json.loads(head + opened.read())
    return str(said["asset"]["generator"])


class _Writer:
    """Makes accessors, images and materials of one document, with all data in one buffer."""

    def __init__(self, document: pygltflib.GLTF2) -> None:
        self.document = document
        self.data = bytearray()
        self.textures: dict[int, int] = {}
        self.is_transformed = False

    def view(self, data: bytes, target: int | None = None) -> int:
        self.data += bytes(-len(self.data) % 4)
        view = pygltflib.BufferView(buffer=0, byteOffset=len(self.data), byteLength=len(data), target=target)
        self.document.bufferViews.append(view)
        self.data += data
        return len(self.document.bufferViews) - 1

    def accessor(self, values: np.ndarray, kind: int, shape: str, target: int) -> int:
        view = self.view(np.ascontiguousarray(values).tobytes(), target)
        self.document.accessors.append(
            pygltflib.Accessor(bufferView=view, componentType=kind, count=len(values), type=shape)
        )
        return len(self.document.accessors) - 1

    def vertices(self, values: np.ndarray, has_bounds: bool) -> int:
        index = self.accessor(values, FLOAT, f"VEC{values.shape[1]}", pygltflib.ARRAY_BUFFER)
        if has_bounds:
            self.document.accessors[index].min = values.min(axis=0).tolist()
            self.document.accessors[index].max = values.max(axis=0).tolist()
        return index

    def texture(self, texture: Texture) -> int:
        from PIL import Image

        if id(texture) not in self.textures:
            modes = {name: mode for mode, name in WRAP_MODES.items()}
            wrap_u, wrap_v = (modes[wrap] for wrap in texture.wrap)
            filtering = 9728 if texture.nearest else 9729
            image, data = Image.fromarray(texture.pixels), io.BytesIO()
            (image if (texture.pixels[..., 3] < 255).any() else image.convert("RGB")).save(
                data, format="PNG", compress_level=_PNG_LEVEL
            )
            view = self.view(data.getvalue())
            document = self.document
            document.images.append(pygltflib.Image(name=texture.name, bufferView=view, mimeType="image/png"))
            document.samplers.append(pygltflib.Sampler(wrapS=wrap_u, wrapT=wrap_v, magFilter=filtering))
            last = len(document.images) - 1
            document.textures.append(pygltflib.Texture(name=texture.name, source=last, sampler=last))
            self.textures[id(texture)] = last
        return self.textures[id(texture)]

    def info(self, texture: Texture) -> dict[str, Any]:
        """Return how a material names a texture: which, at which coordinates, and how these are transformed."""
        found: dict[str, Any] = {"index": self.texture(texture), "texCoord": 2 if texture.uv_set else 0}
        if texture.transform is not None:
            self.is_transformed = True
            found["extensions"] = {"KHR_texture_transform": transform_record(texture.transform)}
        return found

    def material(self, source: Material) -> pygltflib.Material:
        surface = pygltflib.PbrMetallicRoughness(
            baseColorFactor=[*map(float, source.base_color), float(source.alpha)],
            metallicFactor=float(source.metallic),
            roughnessFactor=float(source.roughness),
        )
        result = pygltflib.Material(name=source.name, pbrMetallicRoughness=surface, doubleSided=source.double_sided)
        result.alphaMode = "BLEND" if source.alpha_blend else "OPAQUE" if source.alpha_cutoff is None else "MASK"
        result.alphaCutoff = None if source.alpha_cutoff is None else float(source.alpha_cutoff)
        strength = max(*source.emission, 1.0)
        result.emissiveFactor = [float(value) / strength for value in source.emission]
        coat: dict[str, Any] = {"specularFactor": float(source.specular)}
        if source.reflectance != (0.04,) * 3:
            coat["specularColorFactor"] = [float(value) / 0.04 for value in source.reflectance]
        for field, name in COAT_TEXTURES.items():
            if getattr(source, field) is not None:
                coat[name] = self.info(getattr(source, field))
        result.extensions = {"KHR_materials_specular": coat}
        if strength > 1.0:
            result.extensions["KHR_materials_emissive_strength"] = {"emissiveStrength": float(strength)}
        for field, name in TEXTURES.items():
            texture = getattr(source, field)
            if texture is not None:
                info = pygltflib.TextureInfo(**self.info(texture))
                if name == "normalTexture":
                    info = pygltflib.NormalMaterialTexture(**self.info(texture), scale=float(source.normal_scale))
                setattr(surface if hasattr(surface, name) else result, name, info)
        return result

    def whole(self) -> bytes:
        document = self.document
        used = {name for material in document.materials for name in material.extensions}
        document.extensionsUsed = sorted(used | ({"KHR_texture_transform"} if self.is_transformed else set()))
        document.buffers = [pygltflib.Buffer(byteLength=len(self.data))]
        document.set_binary_blob(bytes(self.data))
        return b"".join(document.save_to_bytes())
