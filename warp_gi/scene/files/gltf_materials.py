"""glTF materials and textures."""

from __future__ import annotations

import urllib.parse
from pathlib import Path

import numpy as np

from warp_gi.errors import SceneError
from warp_gi.scene.files.gltf_buffers import Buffers, decode_data_uri
from warp_gi.scene.files.gltf_document import Document, Part
from warp_gi.scene.files.images import find_file, read_image
from warp_gi.scene.model import Color, Material, Texture

WRAP_MODES = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
BLEND_CUTOFF = 0.5


class MaterialReader:
    """Makes each material and each texture of a document once."""

    def __init__(self, document: Document, buffers: Buffers) -> None:
        self.document, self.buffers = document, buffers
        self._materials: dict[int | None, Material] = {}
        self._images: dict[int, np.ndarray] = {}
        self._textures: dict[tuple[int, bool], Texture] = {}

    def material(self, index: int | None, owner: str) -> Material:
        """Return material ``index``; None is glTF's default material."""
        if index not in self._materials:
            self._materials[index] = Material("default", (1.0, 1.0, 1.0), metallic=1.0, double_sided=False)
            if index is not None:
                self._materials[index] = self._read(index, owner)
        return self._materials[index]

    def _read(self, index: int, owner: str) -> Material:
        document = self.document
        source = document.item("materials", index, owner)
        what = document.name("materials", index)
        name = document.text(source, "name") or what
        surface = document.part(source, "pbrMetallicRoughness", what) or {}
        red, green, blue, alpha = document.numbers(surface, "baseColorFactor", what, (1.0,) * 4)
        strength = document.extension(source, "KHR_materials_emissive_strength", what) or {}
        strength_factor = document.number(strength, "emissiveStrength", what, 1.0)
        emission = _color(document.numbers(source, "emissiveFactor", what, (0.0,) * 3), strength_factor)
        specular = document.extension(source, "KHR_materials_specular", what) or {}
        if set(specular) - {"specularFactor", "extras", "extensions"}:
            document.findings.add("KHR_materials_specular", what)
        normal = document.part(source, "normalTexture", what)
        return Material(
            name,
            base_color=(red, green, blue),
            alpha=alpha,
            metallic=document.number(surface, "metallicFactor", what, 1.0),
            roughness=document.number(surface, "roughnessFactor", what, 1.0),
            specular=document.number(specular, "specularFactor", what, 1.0),
            emission=emission,
            base_color_texture=self._texture(surface, "baseColorTexture", True, what),
            metallic_roughness_texture=self._texture(surface, "metallicRoughnessTexture", False, what),
            normal_texture=self._texture(source, "normalTexture", False, what),
            emission_texture=self._texture(source, "emissiveTexture", True, what) if any(emission) else None,
            normal_scale=document.number(normal or {}, "scale", what, 1.0),
            alpha_cutoff=self._cutoff(source, what),
            double_sided=bool(source.get("doubleSided")),
        )

    def _cutoff(self, source: Part, what: str) -> float | None:
        mode = source.get("alphaMode", "OPAQUE")
        if mode not in ("OPAQUE", "MASK", "BLEND"):
            raise self.document.error(what, f"alphaMode must be OPAQUE, MASK or BLEND, got {mode!r:.60}")
        if mode == "BLEND":
            self.document.findings.add("alphaMode BLEND", what)
            return BLEND_CUTOFF
        return self.document.number(source, "alphaCutoff", what, 0.5) if mode == "MASK" else None

    def _texture(self, source: Part, key: str, srgb: bool, material: str) -> Texture | None:
        info = self.document.part(source, key, material)
        if info is None:
            return None
        what = f"{key} of {material}"
        index = self.document.whole(info, "index", what)
        if (index, srgb) not in self._textures:
            self._textures[index, srgb] = self._read_texture(index, srgb, what, material)
        return self._textures[index, srgb]

    def _read_texture(self, index: int, srgb: bool, what: str, material: str) -> Texture:
        document = self.document
        texture = document.item("textures", index, what)
        source = self._image_of(texture, index, material)
        wrap: tuple[str, str] = ("repeat", "repeat")
        if texture.get("sampler") is not None:
            sampler = document.item("samplers", texture["sampler"], f"texture {index}")
            u, v = (document.whole(sampler, key, f"texture {index}", 10497) for key in ("wrapS", "wrapT"))
            wrap = WRAP_MODES.get(u, str(u)), WRAP_MODES.get(v, str(v))
        image = document.item("images", source, f"texture {index}")
        name = document.text(texture, "name") or document.text(image, "name") or document.text(image, "uri")[:80]
        if not name or name.startswith("data:"):
            name = f"image {source}"
        return Texture(name, self._pixels(source, name, material), srgb, wrap)

    def _image_of(self, texture: Part, index: int, material: str) -> int:
        """Return the image of a texture; a WebP one comes before its stand-in in another format."""
        what = f"texture {index} of {material}"
        webp = self.document.extension(texture, "EXT_texture_webp", what)
        if webp is not None and webp.get("source") is not None:
            return self.document.whole(webp, "source", what)
        if texture.get("source") is None:
            if self.document.extension(texture, "KHR_texture_basisu", what) is not None:
                raise self.document.error(what, "is a KTX2 image, which is not supported; export it as PNG or JPEG")
            raise SceneError(f"{str(self.document.path)!r}: {what} has no image")
        return self.document.whole(texture, "source", what)

    def _pixels(self, index: int, name: str, material: str) -> np.ndarray:
        if index not in self._images:
            image = self.document.item("images", index, f"texture {name!r}")
            what = f"{str(self.document.path)!r}: texture {name!r} of {material}"
            uri = self.document.text(image, "uri")
            if image.get("bufferView") is not None:
                source: Path | bytes | memoryview = self.buffers.view(image["bufferView"], f"image {index}")
            elif not uri:
                raise SceneError(f"{what} has neither a file nor data")
            elif uri.startswith("data:"):
                source = decode_data_uri(uri)
            else:
                source = find_file(self.document.path.parent, urllib.parse.unquote(uri), what)
            self._images[index] = read_image(source, what)
        return self._images[index]


def _color(values: tuple[float, ...], factor: float) -> Color:
    red, green, blue = (factor * value for value in values)
    return red, green, blue


def texture_transform(document: Document, source: Part, what: str) -> tuple[int, np.ndarray]:
    """Return a material's texture coordinate set and its KHR_texture_transform (float64 [3, 3] on v-down uv).

    Textures of one material share one set here: that of the first of base colour,
    emission, normal, metallic-roughness; it is noted where they differ.
    """
    surface = document.part(source, "pbrMetallicRoughness", what) or {}
    places = (surface, "baseColorTexture"), (source, "emissiveTexture"), (source, "normalTexture")
    found = []
    for holder, key in (*places, (surface, "metallicRoughnessTexture")):
        info = document.part(holder, key, what)
        if info is None:
            continue
        extension = document.extension(info, "KHR_texture_transform", what) or {}
        du, dv = document.numbers(extension, "offset", what, (0.0, 0.0))
        su, sv = document.numbers(extension, "scale", what, (1.0, 1.0))
        angle = document.number(extension, "rotation", what, 0.0)
        c, s = np.cos(angle), np.sin(angle)
        matrix = np.array([[c * su, s * sv, du], [-s * su, c * sv, dv], [0.0, 0.0, 1.0]])
        own = document.whole(info, "texCoord", what, 0)
        found.append((document.whole(extension, "texCoord", what, own), matrix))
    if not found:
        return 0, np.eye(3)
    if any(coordinates != found[0][0] for coordinates, _ in found):
        document.findings.add("a second set of texture coordinates", what)
    if any(not np.allclose(matrix, found[0][1]) for _, matrix in found):
        document.findings.add("KHR_texture_transform", what)
    return found[0]
