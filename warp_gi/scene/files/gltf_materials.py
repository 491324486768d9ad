"""glTF materials and textures."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from warp_gi.color import SRGB_TO_LINEAR, encode_srgb
from warp_gi.errors import SceneError
from warp_gi.scene.files.gltf_buffers import Buffers, decode_data_uri, find_uri, is_data_uri
from warp_gi.scene.files.gltf_document import Document, Part
from warp_gi.scene.files.images import read_image
from warp_gi.scene.model import Color, Material, Texture

WRAP_MODES = {10497: "repeat", 33071: "clamp", 33648: "mirror"}
LEAST_AREA = 1e-12
"""Determinant of a transform of coordinates below which others cannot be told from what it leaves."""
NEAREST = 9728  # the one filter without interpolation between texels


@dataclass(frozen=True, eq=False)
class Coordinates:
    """Texture coordinates that the meshes of a material need."""

    number: int = 0
    """Set of the mesh's own coordinates."""
    transform: np.ndarray = field(default_factory=lambda: np.eye(3))
    """Their transform, v down, float64 [3, 3]."""
    further: int | None = None
    """Second set, or None."""
    needed: bool = False
    """Whether a texture is looked up at them."""


class MaterialReader:
    """Makes each material and each texture of a document once.

    Textures of a material share the coordinates of its meshes: those of the base colour, or of the first texture that
    there is. A texture whose coordinates are others says so itself, see ``Texture.transform``.
    """

    def __init__(self, document: Document, buffers: Buffers) -> None:
        self.document, self.buffers = document, buffers
        self._materials: dict[int | None, tuple[Material, Coordinates]] = {}
        self._images: dict[int, np.ndarray] = {}
        self._textures: dict[tuple[object, ...], Texture] = {}

    def material(self, index: int | None, owner: str) -> tuple[Material, Coordinates]:
        """Return material ``index``, and the coordinates that meshes with it need; None is glTF's default material."""
        if index not in self._materials:
            default = Material("default", (1.0, 1.0, 1.0), metallic=1.0, double_sided=False)
            self._materials[index] = default, Coordinates()
            if index is not None:
                self._materials[index] = self._read(index, owner)
        return self._materials[index]

    def _read(self, index: int, owner: str) -> tuple[Material, Coordinates]:
        document = self.document
        source = document.item("materials", index, owner)
        what = document.name("materials", index)
        old = document.extension(source, "KHR_materials_pbrSpecularGlossiness", what)
        surface = document.part(source, "pbrMetallicRoughness", what) or {}
        coat = document.extension(source, "KHR_materials_specular", what) or {}
        ior = document.extension(source, "KHR_materials_ior", what) or {}
        through = document.extension(source, "KHR_materials_transmission", what) or {}
        normal = document.part(source, "normalTexture", what) or {}
        coordinates = self._coordinates(old or {}, surface, source, coat, through, what)
        slot = _Slots(self, coordinates, what)
        strength = document.extension(source, "KHR_materials_emissive_strength", what) or {}
        red, green, blue, alpha = document.numbers(surface, "baseColorFactor", what, (1.0,) * 4)
        emission = scaled(
            document.numbers(source, "emissiveFactor", what, (0.0,) * 3),
            document.number(strength, "emissiveStrength", what, 1.0),
        )
        reflectance = scaled(
            document.numbers(coat, "specularColorFactor", what, (1.0,) * 3),
            _normal_reflectance(document, ior, what),
        )
        result = Material(
            document.text(source, "name") or what,
            base_color=(red, green, blue),
            alpha=alpha,
            metallic=document.number(surface, "metallicFactor", what, 1.0),
            roughness=document.number(surface, "roughnessFactor", what, 1.0),
            specular=document.number(coat, "specularFactor", what, 1.0),
            reflectance=reflectance,
            emission=emission,
            base_color_texture=slot.texture(surface, "baseColorTexture", True),
            metallic_roughness_texture=slot.texture(surface, "metallicRoughnessTexture", False),
            normal_texture=slot.texture(source, "normalTexture", False),
            emission_texture=slot.texture(source, "emissiveTexture", True) if any(emission) else None,
            specular_texture=slot.texture(coat, "specularTexture", False),
            reflectance_texture=slot.texture(coat, "specularColorTexture", True),
            transmission=document.number(through, "transmissionFactor", what, 0.0),
            transmission_texture=slot.texture(through, "transmissionTexture", False),
            normal_scale=document.number(normal, "scale", what, 1.0),
            alpha_cutoff=self._cutoff(source, what),
            alpha_blend=source.get("alphaMode") == "BLEND",
            double_sided=bool(source.get("doubleSided")),
        )
        if _stands_elsewhere(result.transmission_texture, result.base_color_texture):
            document.findings.add("coordinates of transmission textures", what)
        if old is not None:
            result = self._converted(result, old, slot, what)
        if document.extension(source, "KHR_materials_unlit", what) is not None:
            result = replace(
                result,
                base_color=(0.0, 0.0, 0.0),
                metallic=0.0,
                specular=0.0,
                emission=result.base_color,
                emission_texture=result.base_color_texture,
                metallic_roughness_texture=None,
                normal_texture=None,
                colors_emit=True,
            )
        return result, coordinates

    def _coordinates(self, old: Part, surface: Part, source: Part, coat: Part, through: Part, what: str) -> Coordinates:
        """Return the coordinates of the first texture of a material; note a third set."""
        places = [(old, "diffuseTexture"), (old, "specularGlossinessTexture"), (surface, "baseColorTexture")]
        places += [(source, "emissiveTexture"), (source, "normalTexture"), (surface, "metallicRoughnessTexture")]
        places += [(coat, "specularTexture"), (coat, "specularColorTexture"), (through, "transmissionTexture")]
        infos = [self.document.part(holder, key, what) for holder, key in places]
        found = [texture_transform(self.document, info, what) for info in infos if info is not None]
        if not found:
            return Coordinates()
        first = Coordinates(*found[0], needed=True)
        others = dict.fromkeys(number for number, transform in found if not _reaches(first, number, transform))
        if len(others) > 1:
            self.document.findings.add("a third set of texture coordinates", what)
        return replace(first, further=next(iter(others), None))

    def _converted(self, material: Material, old: Part, slot: _Slots, what: str) -> Material:
        """Return a material with what KHR_materials_pbrSpecularGlossiness says of it.

        Diffuse times 1 - max(specular) becomes the base colour, specular the reflectance at normal incidence, and
        1 - glossiness the roughness; a texture of the two is taken apart. Without specular it is pure Lambert.
        """
        document = self.document
        red, green, blue, alpha = document.numbers(old, "diffuseFactor", what, (1.0,) * 4)
        specular = document.numbers(old, "specularFactor", what, (1.0,) * 3)
        gloss = document.number(old, "glossinessFactor", what, 1.0)
        color = slot.texture(old, "diffuseTexture", True)
        both = slot.texture(old, "specularGlossinessTexture", True)
        share = 1.0 - max(specular) if both is None else 1.0
        roughness, texture = 1.0 - gloss, None
        if both is not None:
            roughness = 1.0
            rough = np.round(255.0 - gloss * both.pixels[..., 3]).astype(np.uint8)
            texture = replace(both, srgb=False, pixels=np.stack([rough, rough, np.zeros_like(rough), rough], axis=2))
            apart = _stands_elsewhere(both, color)
            if apart:
                document.findings.add("coordinates of specular-glossiness textures", what)
            darkened = darker(color, both, max(specular), apart)
            color = replace(color, pixels=darkened) if color is not None else replace(both, pixels=darkened)
        return replace(
            material,
            base_color=(red * share, green * share, blue * share),
            alpha=alpha,
            metallic=0.0,
            roughness=roughness,
            specular=min(max(specular) / 0.04, 1.0),
            reflectance=scaled(specular, 1.0 / max(min(max(specular) / 0.04, 1.0), 1e-6)),
            base_color_texture=color,
            metallic_roughness_texture=texture,
            specular_texture=None,
            reflectance_texture=both,
        )

    def _cutoff(self, source: Part, what: str) -> float | None:
        mode = source.get("alphaMode", "OPAQUE")
        if mode not in ("OPAQUE", "MASK", "BLEND"):
            raise self.document.error(what, f"alphaMode must be OPAQUE, MASK or BLEND, got {mode!r:.60}")
        return self.document.number(source, "alphaCutoff", what, 0.5) if mode == "MASK" else None

    def texture(self, info: Part, srgb: bool, coordinates: Coordinates, what: str, material: str) -> Texture:
        """Return the texture that a material names."""
        index = self.document.whole(info, "index", what)
        number, transform = texture_transform(self.document, info, what)
        relative: tuple[Color, Color] | None = None
        further = not _reaches(coordinates, number, transform)
        if further:
            relative = upward_rows(transform)
        elif not np.allclose(transform, coordinates.transform):
            relative = upward_rows(transform @ np.linalg.inv(coordinates.transform))
        key = index, srgb, further, relative
        if key not in self._textures:
            self._textures[key] = replace(
                self._read_texture(index, srgb, what, material), uv_set=int(further), transform=relative
            )
        return self._textures[key]

    def _read_texture(self, index: int, srgb: bool, what: str, material: str) -> Texture:
        document = self.document
        texture = document.item("textures", index, what)
        source = self._image_of(texture, index, material)
        wrap: tuple[str, str] = ("repeat", "repeat")
        nearest = False
        if texture.get("sampler") is not None:
            sampler = document.item("samplers", texture["sampler"], f"texture {index}")
            u, v = (document.whole(sampler, key, f"texture {index}", 10497) for key in ("wrapS", "wrapT"))
            wrap = WRAP_MODES.get(u, str(u)), WRAP_MODES.get(v, str(v))
            nearest = sampler.get("magFilter") == NEAREST
        image = document.item("images", source, f"texture {index}")
        name = document.text(texture, "name") or document.text(image, "name") or document.text(image, "uri")[:80]
        if not name or is_data_uri(name):
            name = f"image {source}"
        return Texture(name, self._pixels(source, name, material), srgb, wrap, nearest)

    def _image_of(self, texture: Part, index: int, material: str) -> int:
        """Return the image of a texture; a WebP one comes before its stand-in in another format."""
        what = f"texture {index} of {material}"
        webp = self.document.extension(texture, "EXT_texture_webp", what)
        if webp is not None and webp.get("source") is not None:
            return self.document.whole(webp, "source", what)
        if texture.get("source") is None:
            if self.document.extension(texture, "KHR_texture_basisu", what) is not None:
                raise self.document.error(what, "is a KTX2 image, which is not supported; export it as PNG or JPEG")
            names = ", ".join(self.document.part(texture, "extensions", what) or {})
            if names:
                raise self.document.error(
                    what, f"has its image in {names} alone, which is not supported; export it as PNG or JPEG"
                )
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
            elif is_data_uri(uri):
                source = decode_data_uri(uri, what)
            else:
                source = find_uri(self.document.path.parent, uri, what)
            self._images[index] = read_image(source, what)
        return self._images[index]


class _Slots:
    """Reads the textures of one material."""

    def __init__(self, reader: MaterialReader, coordinates: Coordinates, material: str) -> None:
        self.reader, self.coordinates, self.material = reader, coordinates, material

    def texture(self, source: Part, key: str, srgb: bool) -> Texture | None:
        """Return the texture in a field of a part of the material, or None."""
        info = self.reader.document.part(source, key, self.material)
        if info is None:
            return None
        return self.reader.texture(info, srgb, self.coordinates, f"{key} of {self.material}", self.material)


def scaled(values: tuple[float, ...], factor: float) -> Color:
    """Return three numbers times a factor."""
    red, green, blue = (factor * value for value in values)
    return red, green, blue


def _normal_reflectance(document: Document, extension: Part, what: str) -> float:
    """Return the reflectance of KHR_materials_ior at normal incidence; 0 stands for an infinite index of refraction."""
    ior = document.number(extension, "ior", what, 1.5)
    if ior < 0.0:
        raise document.error(what, f"ior must be 0 or from 1 up, got {ior:g}")
    return 0.04 if ior == 1.5 else ((ior - 1.0) / (ior + 1.0)) ** 2


def darker(color: Texture | None, both: Texture, most: float, evenly: bool = False) -> np.ndarray:
    """Return sRGB pixels of a diffuse texture times 1 - max(specular), at the size of the larger of the two.

    ``evenly`` takes the mean of the specular texture, which stands elsewhere.
    """
    from PIL import Image

    base = np.full_like(both.pixels, 255) if color is None else color.pixels
    if evenly:
        specular = SRGB_TO_LINEAR[both.pixels[..., :3]].max(axis=2).mean(dtype=np.float64)
        dark = encode_srgb(SRGB_TO_LINEAR[base[..., :3]] * (1.0 - most * specular))
        return np.dstack([np.round(dark * 255.0).astype(np.uint8), base[..., 3]])
    size = max(base.shape[1], both.pixels.shape[1]), max(base.shape[0], both.pixels.shape[0])

    def resized(pixels: np.ndarray) -> np.ndarray:  # RGBA images would be weighted by their alpha
        return np.asarray(Image.fromarray(np.ascontiguousarray(pixels)).resize(size))

    share = 1.0 - most * SRGB_TO_LINEAR[resized(both.pixels[..., :3])].max(axis=2, keepdims=True)
    dark = encode_srgb(SRGB_TO_LINEAR[resized(base[..., :3])] * share)
    return np.dstack([np.round(dark * 255.0).astype(np.uint8), resized(base[..., 3])])


def upward_rows(matrix: np.ndarray) -> tuple[Color, Color]:
    """Return a transform [3, 3] of coordinates with v down as rows of one with v up."""
    flip = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 1.0], [0.0, 0.0, 1.0]])
    rows = (flip @ matrix @ flip)[:2].tolist()
    return (rows[0][0], rows[0][1], rows[0][2]), (rows[1][0], rows[1][1], rows[1][2])


def texture_transform(document: Document, info: Part, what: str) -> tuple[int, np.ndarray]:
    """Return the coordinates of a texture: number of the set and KHR_texture_transform [3, 3], v down, float64."""
    extension = document.extension(info, "KHR_texture_transform", what) or {}
    du, dv = document.numbers(extension, "offset", what, (0.0, 0.0))
    su, sv = document.numbers(extension, "scale", what, (1.0, 1.0))
    angle = document.number(extension, "rotation", what, 0.0)
    c, s = np.cos(angle), np.sin(angle)
    matrix = np.array([[c * su, s * sv, du], [-s * su, c * sv, dv], [0.0, 0.0, 1.0]])
    own = document.whole(info, "texCoord", what, 0)
    return document.whole(extension, "texCoord", what, own), matrix


def _reaches(coordinates: Coordinates, number: int, transform: np.ndarray) -> bool:
    """Return whether a texture's coordinates follow from those that a mesh has first, unless they are all one point."""
    if number != coordinates.number:
        return False
    is_flat = abs(np.linalg.det(coordinates.transform)) < LEAST_AREA
    return not is_flat or np.allclose(transform, coordinates.transform)


def _stands_elsewhere(texture: Texture | None, base: Texture | None) -> bool:
    """Return whether a texture has other coordinates, or repeats otherwise, than that of the base colour."""
    if texture is None or base is None:
        return False
    return bool(texture.uv_set) or texture.transform is not None or texture.wrap != base.wrap
