"""MTL files: the materials of OBJ.

How MTL becomes glTF's metallic-roughness: ``Kd`` (times ``map_Kd``) is the base colour, where a Kd of 0 0 0 beside a
``map_Kd`` counts as white, as its exporters meant it. ``Pr`` and ``Pm`` are roughness and metallic factor. Without them
``Ns`` is a Blinn-Phong exponent: the roughness is (2 / (Ns + 2))^(1/4), and its GGX alpha the square of that. ``Ks`` is
the reflectance at normal incidence, so the specular factor is max(Ks) / 0.04, at most 1, and Ks 0 is pure Lambert. It
is the colour of a metal where a metal can be: there is no ``map_Kd``, every channel of Ks is above 0.25 and above Kd,
Kd and Ks add up to 1 or less, and Kd is not coloured beside a grey Ks. ``Ke`` (times ``map_Ke``) is emitted radiance.
``map_d``, or ``d``, or 1 - ``Tr``, is coverage, cut at 0.5; ``Tr 1`` without ``d`` is opaque, as its writers mean it.
``norm`` is a normal map. Both sides emit.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from warp_gi.errors import SceneError
from warp_gi.scene.files.images import find_file, read_image
from warp_gi.scene.files.obj_text import uncommented
from warp_gi.scene.files.support import Findings
from warp_gi.scene.model import Material, Texture

METAL_SPECULAR = 0.25
GREY_STEP = 0.02  # difference between channels below which a colour is grey
OPTION_ARGUMENTS = {"-o": 3, "-s": 3, "-t": 3, "-mm": 2}
"""Number of arguments of MTL map options that take more or fewer than one."""
MAP_FEATURES = {
    "bump": "bump and displacement maps",
    "map_bump": "bump and displacement maps",
    "disp": "bump and displacement maps",
    "map_disp": "bump and displacement maps",
    "map_ks": "maps of the specular colour and exponent",
    "map_ns": "maps of the specular colour and exponent",
    "refl": "reflection maps",
    "map_ps": "sheen, clear coats and anisotropy of MTL",
}
NUMBER_FEATURES = dict.fromkeys(("ps", "pc", "aniso"), "sheen, clear coats and anisotropy of MTL")
GLASS_MODELS = (4, 6, 7, 9)  # values of illum
ELSEWHERE = re.compile(r"[A-Za-z]:[\\/]|\\\\|/|~")


@dataclass
class MtlMaterial:
    """The statements of one ``newmtl``, keys in lower case."""

    folder: Path
    """Folder of its library."""
    numbers: dict[str, list[float]] = field(default_factory=dict)
    maps: dict[str, list[str]] = field(default_factory=dict)


def read_text(path: Path) -> str:
    """Return the text of a file in UTF-8 or, failing that, Latin-1."""
    data = path.read_bytes()
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


def read_mtl(path: Path, findings: Findings) -> dict[str, MtlMaterial]:
    """Return the statements of each material of a library, by its name."""
    materials: dict[str, MtlMaterial] = {}
    current = MtlMaterial(path.parent)
    for line in read_text(path).splitlines():
        words = uncommented(line.split())
        if len(words) < 2 or words[0].startswith("#"):
            continue
        key = words[0].lower()
        if key == "newmtl":
            current = materials[" ".join(words[1:])] = MtlMaterial(path.parent)
        elif key.startswith("map_") or key in ("norm", "bump", "disp", "refl"):
            current.maps[key] = words[1:]
        else:
            try:
                current.numbers[key] = [float(word) for word in words[1:] if key != "d" or word != "-halo"]
            except ValueError:
                if words[1] in ("spectral", "xyz"):
                    findings.add("spectral and XYZ colours", f"{key} {words[1]} in {path.name!r}")
    return materials


class MtlReader:
    """Makes each material and each texture once."""

    def __init__(self, path: Path, statements: dict[str, MtlMaterial], findings: Findings) -> None:
        self.path, self.statements, self.findings = path, statements, findings
        self._materials: dict[str | None, tuple[Material, np.ndarray | None]] = {}
        self._images: dict[Path, np.ndarray] = {}
        self._textures: dict[tuple[object, ...], Texture] = {}

    def material(self, name: str | None, colored: bool) -> tuple[Material, np.ndarray | None]:
        """Return a material, and the transform [2, 3] of its texture coordinates or None.

        What no library has is a plain grey Lambert, or a white one under vertices with colours (``colored``).
        """
        if name not in self._materials:
            found = self.statements.get(name or "")
            if found is not None:
                self._materials[name] = self._convert(str(name), found)
            else:
                color = (1.0, 1.0, 1.0) if colored else (0.8, 0.8, 0.8)
                self._materials[name] = Material(name or "default", color, specular=0.0), None
        return self._materials[name]

    def _convert(self, name: str, source: MtlMaterial) -> tuple[Material, np.ndarray | None]:
        numbers, maps = source.numbers, source.maps
        self._note(name, source)
        diffuse, specular = _color(numbers, "kd", 0.8), _color(numbers, "ks", 0.0)
        color_map = self._color_and_coverage(name, source)
        if "map_kd" in maps and not diffuse.any():
            diffuse = np.full(3, 1.0 if color_map is not None else 0.8)
        emission_map = maps.get("map_ke", maps.get("map_emissive"))
        emission = _color(numbers, "ke", 1.0 if emission_map else 0.0, highest=np.inf)
        coverage = _coverage(numbers)
        shininess = max(_first(numbers, "ns", 0.0), 0.0)
        roughness, metallic = (2.0 / (shininess + 2.0)) ** 0.25, 0.0
        is_physical = any(key in numbers for key in ("pr", "pm")) or "map_pr" in maps or "map_pm" in maps
        factor = min(1.0, float(specular.max()) / 0.04)
        if is_physical:
            roughness = _first(numbers, "pr", 1.0 if "map_pr" in maps else roughness)
            metallic = _first(numbers, "pm", 1.0 if "map_pm" in maps else 0.0)
            factor = factor if "ks" in numbers else 1.0
        elif "map_kd" not in maps and _is_metal(diffuse, specular):
            diffuse, metallic, factor = specular, 1.0, 1.0
        red, green, blue = diffuse.tolist()
        material = Material(
            name,
            base_color=(red, green, blue),
            alpha=coverage,
            metallic=float(np.clip(metallic, 0.0, 1.0)),
            roughness=float(np.clip(roughness, 0.0, 1.0)),
            specular=factor,
            emission=tuple(emission.tolist()),
            base_color_texture=color_map,
            metallic_roughness_texture=self._metal_and_roughness(name, source),
            normal_texture=self._texture(name, source, "norm", srgb=False),
            emission_texture=self._texture(name, source, "map_ke" if "map_ke" in maps else "map_emissive", srgb=True)
            if emission.max() > 0.0
            else None,
            alpha_cutoff=0.5 if "map_d" in maps or coverage < 0.5 else None,
            double_sided=True,
        )
        return material, self._transform(name, source)

    def _note(self, name: str, source: MtlMaterial) -> None:
        """Note statements that are not read in full."""
        what = f"material {name!r}"
        for key in source.maps:
            if key in MAP_FEATURES:
                self.findings.add(MAP_FEATURES[key], what)
        for key, feature in NUMBER_FEATURES.items():
            if _first(source.numbers, key, 0.0) > 0.0:
                self.findings.add(feature, what)
        if int(_first(source.numbers, "illum", 2.0)) in GLASS_MODELS:
            self.findings.add("glass of MTL (illum 4, 6, 7, 9)", what)
        elif "map_d" not in source.maps and 0.0 < _coverage(source.numbers) < 1.0:
            self.findings.add("coverage between 0 and 1", what)

    def _transform(self, name: str, source: MtlMaterial) -> np.ndarray | None:
        """Return ``-s`` and ``-o`` of the first map as [2, 3]; None for the identity."""
        read = ("map_kd", "map_d", "map_ke", "map_emissive", "norm", "map_pr", "map_pm")
        found = [_map_options(source.maps[key])[2] for key in read if key in source.maps]
        if any(not np.array_equal(one, found[0]) for one in found):
            self.findings.add("one scale and offset a map (-s, -o)", f"material {name!r}")
        return found[0] if found and not np.array_equal(found[0], np.eye(2, 3)) else None

    def _texture(self, material: str, source: MtlMaterial, key: str, srgb: bool) -> Texture | None:
        if key not in source.maps:
            return None
        name, wrap, _ = _map_options(source.maps[key])
        pixels = self._image(name, material, source.folder)
        return None if pixels is None else self._once(Texture(name, pixels, srgb, (wrap, wrap)), name, wrap, srgb)

    def _color_and_coverage(self, material: str, source: MtlMaterial) -> Texture | None:
        """Return the base colour texture with coverage in its alpha."""
        color = self._texture(material, source, "map_kd", srgb=True)
        coverage = self._texture(material, source, "map_d", srgb=False)
        if coverage is None:
            return color
        mask = coverage.pixels
        alpha = mask[..., 3] if mask[..., 3].min() < 255 else mask[..., :3].max(axis=2)
        pixels = np.full_like(mask, 255) if color is None else color.pixels.copy()
        pixels[..., 3] = _resized(alpha, pixels.shape[0], pixels.shape[1])
        shown = color or coverage
        return self._once(Texture(shown.name, pixels, True, shown.wrap), id(color), id(coverage))

    def _metal_and_roughness(self, material: str, source: MtlMaterial) -> Texture | None:
        """Return roughness in green and the metallic factor in blue."""
        rough = self._texture(material, source, "map_pr", srgb=False)
        metal = self._texture(material, source, "map_pm", srgb=False)
        shown = rough or metal
        if shown is None:
            return None
        height, width = shown.pixels.shape[:2]
        pixels = np.full((height, width, 4), 255, np.uint8)
        for texture, channel in ((rough, 1), (metal, 2)):
            if texture is not None:
                pixels[..., channel] = _resized(texture.pixels[..., 0], height, width)
        return self._once(Texture(shown.name, pixels, False, shown.wrap), "metal", id(rough), id(metal))

    def _once(self, texture: Texture, *key: object) -> Texture:
        return self._textures.setdefault(key, texture)

    def _image(self, name: str, material: str, folder: Path) -> np.ndarray | None:
        """Return the pixels of a map; None, with a warning, for one that was named by a path of another machine."""
        what = f"{str(self.path)!r}: texture {name!r} of material {material!r}"
        is_elsewhere = ELSEWHERE.match(name) is not None
        bare = re.split(r"[\\/]", name)[-1]
        tries = [(folder, bare)] if is_elsewhere else [(folder, name), (self.path.parent, name), (folder, bare)]
        missing: SceneError | None = None
        for place, candidate in tries:
            try:
                file = find_file(place, candidate, what)
                break
            except SceneError as error:
                missing = missing or error
        else:
            if is_elsewhere:
                self.findings.lost.append(f"{what} is not here: there is no {bare!r} in {str(folder)!r}; plain colour")
                return None
            raise missing or SceneError(f"{what} is missing")
        if file not in self._images:
            self._images[file] = read_image(file, what)
        return self._images[file]


def _is_metal(diffuse: np.ndarray, specular: np.ndarray) -> bool:
    """Return whether a material of these colours can only be meant as a metal."""
    is_colored = np.ptp(diffuse) > GREY_STEP and np.ptp(specular) <= GREY_STEP
    is_bright = specular.min() > METAL_SPECULAR and np.all(specular > diffuse)
    return bool(is_bright and not is_colored and np.all(specular + diffuse <= 1.0 + 1e-6))


def _coverage(numbers: dict[str, list[float]]) -> float:
    """Return the coverage that ``d`` or ``Tr`` say, from 0 to 1."""
    through = _first(numbers, "tr", 0.0)
    coverage = _first(numbers, "d", 1.0 if through >= 1.0 else 1.0 - through)
    return min(max(coverage, 0.0), 1.0)


def _first(numbers: dict[str, list[float]], key: str, default: float) -> float:
    values = numbers.get(key)
    return values[0] if values else default


def _color(numbers: dict[str, list[float]], key: str, default: float, highest: float = 1.0) -> np.ndarray:
    values = numbers.get(key) or [default]
    return np.clip(np.array(values[:3] if len(values) >= 3 else values[:1] * 3), 0.0, highest)


def _map_options(words: list[str]) -> tuple[str, str, np.ndarray]:
    """Return the file name, the wrap mode, and scale and offset [2, 3] of a map statement, whose options come first."""
    wrap, at, transform = "repeat", 0, np.eye(2, 3)
    while at < len(words) - 1 and words[at].startswith("-"):
        option, at = words[at].lower(), at + 1
        if option == "-clamp" and words[at].lower() == "on":
            wrap = "clamp"
        values = []
        for count in range(OPTION_ARGUMENTS.get(option, 1)):
            if at < len(words) - 1 and (count == 0 or _is_number(words[at])):
                values.append(words[at])
                at += 1
        if option in ("-s", "-o") and all(_is_number(value) for value in values):
            for axis, value in enumerate(values[:2]):
                transform[axis, axis if option == "-s" else 2] = float(value)
    return unquoted(" ".join(words[at:])), wrap, transform


def unquoted(name: str) -> str:
    """Return a file name without the quotes around it."""
    return name[1:-1] if len(name) > 1 and name[0] == name[-1] and name[0] in "\"'" else name


def _is_number(word: str) -> bool:
    return re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", word) is not None


def _resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return a uint8 [h, w] image at another size."""
    if image.shape == (height, width):
        return image
    from PIL import Image

    return np.asarray(Image.fromarray(image).resize((width, height)))
