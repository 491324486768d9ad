"""glTF materials and textures."""

from __future__ import annotations

import urllib.parse
import warnings
from pathlib import Path

import numpy as np
import pygltflib

from warp_gi.errors import SceneError
from warp_gi.scene.files.gltf_buffers import Buffers, decode_data_uri
from warp_gi.scene.files.images import find_file, read_image
from warp_gi.scene.model import Material, Texture

WRAP_MODES = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
BLEND_CUTOFF = 0.5


class MaterialReader:
    """Makes each material and each texture of a document once."""

    def __init__(self, document: pygltflib.GLTF2, buffers: Buffers) -> None:
        self.document, self.buffers = document, buffers
        self._materials: dict[int | None, Material] = {}
        self._images: dict[int, np.ndarray] = {}
        self._textures: dict[tuple[int, bool], Texture] = {}

    def material(self, index: int | None) -> Material:
        """Return material ``index``; None is glTF's default material."""
        if index not in self._materials:
            self._materials[index] = Material("default", (1.0, 1.0, 1.0), metallic=1.0, double_sided=False)
            if index is not None:
                self._materials[index] = self._read(index)
        return self._materials[index]

    def _read(self, index: int) -> Material:
        source = self.document.materials[index]
        name = source.name or f"material {index}"
        extensions = source.extensions or {}
        surface = source.pbrMetallicRoughness
        red, green, blue, alpha = (surface and surface.baseColorFactor) or (1.0,) * 4
        strength = extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
        cutoffs = {"OPAQUE": None, "MASK": 0.5 if source.alphaCutoff is None else source.alphaCutoff}
        specular = extensions.get("KHR_materials_specular", {})
        emission = [strength * x for x in source.emissiveFactor or (0.0, 0.0, 0.0)]
        normal = source.normalTexture
        return Material(
            name,
            base_color=(red, green, blue),
            alpha=alpha,
            metallic=1.0 if surface is None or surface.metallicFactor is None else surface.metallicFactor,
            roughness=1.0 if surface is None or surface.roughnessFactor is None else surface.roughnessFactor,
            specular=specular.get("specularFactor", 1.0),
            emission=tuple(emission),
            base_color_texture=self._texture(surface and surface.baseColorTexture, True, name),
            metallic_roughness_texture=self._texture(surface and surface.metallicRoughnessTexture, False, name),
            normal_texture=self._texture(normal, False, name),
            emission_texture=self._texture(source.emissiveTexture if any(emission) else None, True, name),
            normal_scale=1.0 if normal is None or normal.scale is None else normal.scale,
            alpha_cutoff=cutoffs.get(source.alphaMode or "OPAQUE", BLEND_CUTOFF),
            double_sided=bool(source.doubleSided),
        )

    def _texture(self, info: pygltflib.TextureInfo | None, srgb: bool, material: str) -> Texture | None:
        if info is None or info.index is None:
            return None
        key = (info.index, srgb)
        if key not in self._textures:
            texture = self.document.textures[info.index]
            if texture.source is None:
                raise SceneError(
                    f"{str(self.buffers.path)!r}: texture {info.index} of material {material!r} has no image"
                )
            wrap: tuple[str, str] = ("repeat", "repeat")
            if texture.sampler is not None:
                sampler = self.document.samplers[texture.sampler]
                u, v = (WRAP_MODES.get(mode or 10497, str(mode)) for mode in (sampler.wrapS, sampler.wrapT))
                wrap = u, v
            image = self.document.images[texture.source]
            name = texture.name or image.name or (image.uri or "")[:80] or f"image {texture.source}"
            if name.startswith("data:"):
                name = f"image {texture.source}"
            self._textures[key] = Texture(name, self._pixels(texture.source, name, material), srgb, wrap)
        return self._textures[key]

    def _pixels(self, index: int, name: str, material: str) -> np.ndarray:
        if index not in self._images:
            image = self.document.images[index]
            what = f"{str(self.buffers.path)!r}: texture {name!r} of material {material!r}"
            if image.bufferView is not None:
                source: Path | bytes | memoryview = self.buffers.view(image.bufferView)
            elif image.uri is None:
                raise SceneError(f"{what} has neither a file nor data")
            elif image.uri.startswith("data:"):
                source = decode_data_uri(image.uri)
            else:
                source = find_file(self.buffers.path.parent, urllib.parse.unquote(image.uri), what)
            self._images[index] = read_image(source, what)
        return self._images[index]


def texture_transform(source: pygltflib.Material) -> tuple[int, np.ndarray]:
    """Return a material's texture coordinate set and its KHR_texture_transform (float64 [3, 3] on v-down uv).

    Textures of one material share one set here: that of the first of base colour,
    emission, normal, metallic-roughness; a warning says so when they differ.
    """
    surface = source.pbrMetallicRoughness
    infos = [surface and surface.baseColorTexture, source.emissiveTexture, source.normalTexture]
    infos = [info for info in (*infos, surface and surface.metallicRoughnessTexture) if info is not None]
    found = []
    for info in infos:
        extension = (info.extensions or {}).get("KHR_texture_transform", {})
        (du, dv), angle = extension.get("offset", (0.0, 0.0)), extension.get("rotation", 0.0)
        su, sv = extension.get("scale", (1.0, 1.0))
        c, s = np.cos(angle), np.sin(angle)
        matrix = np.array([[c * su, s * sv, du], [-s * su, c * sv, dv], [0.0, 0.0, 1.0]])
        found.append((extension.get("texCoord", info.texCoord or 0), matrix))
    if not found:
        return 0, np.eye(3)
    if any(coordinates != found[0][0] or not np.allclose(m, found[0][1]) for coordinates, m in found[1:]):
        warnings.warn(
            f"material {source.name!r}: its textures have different coordinates; those of the first are used for all",
            stacklevel=2,
        )
    return found[0]
