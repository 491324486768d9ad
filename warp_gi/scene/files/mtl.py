"""MTL files: the materials of OBJ.

How MTL becomes glTF's metallic-roughness: ``Kd`` (times ``map_Kd``) is the base colour, where a Kd of 0 0 0 beside a
``map_Kd`` counts as white, as its exporters meant it. ``Pr`` and ``Pm`` are roughness and metallic factor. Without them
``Ns`` is a Blinn-Phong exponent: the roughness is (2 / (Ns + 2))^(1/4), and its GGX alpha the square of that. ``Ks`` is
the reflectance at normal incidence, so the specular factor is max(Ks) / 0.04, at most 1, and Ks 0 is pure Lambert. It
is the colour of a metal where a metal can be: there is no ``map_Kd``, every channel of Ks is above 0.25 (one of them,
where Kd is black) and above Kd, Kd and Ks add up to 1 or less, and Kd is not coloured beside a grey Ks. ``Ke`` (times
``map_Ke``) is emitted radiance. ``map_d``, or ``d``, or 1 - ``Tr``, is coverage; ``Tr 1`` without ``d`` is opaque, as
its writers mean it.
``norm`` is a normal map. Both sides emit. A colour of one number is grey.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from warp_gi.errors import SceneError
from warp_gi.scene.files.images import OutsideError, check_inside, find_file, read_image
from warp_gi.scene.files.support import Findings
from warp_gi.scene.files.text import decode, joined, read_bytes, uncommented, without_comment
from warp_gi.scene.model import Material, Texture

GREY_STEP = 0.02  # difference between channels below which a colour is grey
METAL_SPECULAR = 0.25
BLACK = 1e-3  # largest channel of a colour that counts as none
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
    "map_refl": "reflection maps",
    **dict.fromkeys(("map_ps", "map_pc", "map_pcr", "map_aniso"), "sheen, clear coats and anisotropy of MTL"),
}
NUMBER_FEATURES = dict.fromkeys(("ps", "pc", "aniso"), "sheen, clear coats and anisotropy of MTL")
COLORS = ("kd", "ks", "ke", "tf")
HOLE = 24  # of 255, the alpha up to which a texel is one of a hole
MOST_BETWEEN = 0.1  # share of texels that are neither hole nor surface in a map that is cut at 0.5
NUMBERS = {*COLORS, *NUMBER_FEATURES, "ns", "ni", "d", "tr", "pr", "pm", "illum"}
MAPS = ("map_kd", "map_d", "map_ke", "map_emissive", "norm", "map_pr", "map_pm")
"""Maps that are read, in the order in which their scale and offset count."""
UNSEEN = {"ka", "map_ka", "sharpness", "map_aat", "pcr", "anisor"}
"""Statements without a warning: ambient light is computed, and the others change no picture by themselves."""
GLASS_MODELS = (4, 6, 7, 9)  # values of illum
ELSEWHERE = re.compile(r"[A-Za-z]:[\\/]|\\\\|/|~")


@dataclass
class MtlMaterial:
    """The statements of one ``newmtl``, keys in lower case."""

    folder: Path
    """Folder of its library."""
    numbers: dict[str, list[float]] = field(default_factory=dict)
    maps: dict[str, list[str]] = field(default_factory=dict)
    unread: list[tuple[str, str]] = field(default_factory=list)
    """Names of features that are not read, and where they stand."""

    def add(self, words: list[str], where: str) -> None:
        """Add a statement, ``where`` of which is its place."""
        key = words[0].lower()
        if key in MAPS or key in MAP_FEATURES:
            if len(words) > 1:
                self.maps[key] = words[1:]
            else:
                self.unread.append(("maps of MTL without a file", f"{words[0]}, {where}"))
        elif key in NUMBERS:
            words = uncommented(words)
            values = [_number(word) for word in words[1:] if key != "d" or word.lower() != "-halo"]
            if len(words) > 1 and words[1].lower() in ("spectral", "xyz"):
                self.unread.append(("spectral and XYZ colours", f"{' '.join(words[:2])}, {where}"))
            elif not values or not np.isfinite(values).all() or (key in COLORS and len(values) == 2):
                self.unread.append(("statements of MTL without the numbers they need", f"{' '.join(words)!r}, {where}"))
            else:
                self.numbers[key] = values
        elif key not in UNSEEN:
            self.unread.append((f"{words[0]} of MTL", where))


def read_mtl(path: Path) -> dict[str, MtlMaterial]:
    """Return the statements of each material of a library, by its name."""
    materials: dict[str, MtlMaterial] = {}
    current = MtlMaterial(path.parent)
    data, places = joined(read_bytes(path))
    at = 0
    for index, line in enumerate(data.split(b"\n"), 1):
        words = decode(line).split()
        if words and words[0].lower() == "newmtl":
            current = materials[" ".join(words[1:])] = MtlMaterial(path.parent)
        elif words and not words[0].startswith("#"):
            current.add(words, f"line {index + int(np.searchsorted(places, at))} of {path.name!r}")
        at += len(line) + 1
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
            found = None if name is None else self.statements.get(name)
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
        is_cut = "map_d" in maps and coverage == 1.0 and color_map is not None and _is_cut_out(color_map.pixels[..., 3])
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
        if self._is_glass(source):
            return self._glass(name, source), self._transform(name, source)
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
            alpha_cutoff=0.5 if is_cut else None,
            alpha_blend=not is_cut and ("map_d" in maps or coverage < 1.0),
            double_sided=True,
        )
        return material, self._transform(name, source)

    def _is_glass(self, source: MtlMaterial) -> bool:
        is_clear = "map_d" not in source.maps and _coverage(source.numbers) < 1.0 and "tf" in source.numbers
        return is_clear and int(_first(source.numbers, "illum", 2.0)) in GLASS_MODELS

    def _glass(self, name: str, source: MtlMaterial) -> Material:
        """Return a pane that reflects as its index of refraction ``Ni`` says, tinted by ``Tf``."""
        numbers = source.numbers
        red, green, blue = _color(numbers, "tf", 1.0).tolist()
        index = _first(numbers, "ni", 1.5)
        reflectance = ((index - 1.0) / (index + 1.0)) ** 2 if index > 1.0 else 0.04
        shininess = _first(numbers, "ns", np.inf)
        return Material(
            name,
            base_color=(red, green, blue),
            roughness=float((2.0 / (max(shininess, 0.0) + 2.0)) ** 0.25),
            reflectance=(reflectance,) * 3,
            normal_texture=self._texture(name, source, "norm", srgb=False),
            transmission=1.0 - _coverage(numbers),
            emission=tuple(_color(numbers, "ke", 0.0).tolist()),
        )

    def _note(self, name: str, source: MtlMaterial) -> None:
        """Note statements that are not read in full."""
        what = f"material {name!r}"
        for feature, where in source.unread:
            self.findings.add(feature, where)
        for key in source.maps:
            if key in MAP_FEATURES:
                self.findings.add(MAP_FEATURES[key], what)
            for option in _further_options(source.maps[key], key) if key in MAPS else ():
                self.findings.add("other options of maps (-mm, -t, -cc, -imfchan, -bm)", f"{option} of {key} of {what}")
        for key, feature in NUMBER_FEATURES.items():
            if _first(source.numbers, key, 0.0) > 0.0:
                self.findings.add(feature, what)
        if min(_color(source.numbers, "tf", 1.0)) < 1.0 and not self._is_glass(source):
            self.findings.add("Tf of MTL", what)
        if int(_first(source.numbers, "illum", 2.0)) in GLASS_MODELS:
            self.findings.add("glass of MTL (illum 4, 6, 7, 9)", what)

    def _transform(self, name: str, source: MtlMaterial) -> np.ndarray | None:
        """Return ``-s`` and ``-o`` of the first map as [2, 3]; None for the identity."""
        found = [_map_options(source.maps[key])[2] for key in MAPS if key in source.maps]
        if any(not np.array_equal(one, found[0]) for one in found):
            self.findings.add("one scale and offset a map (-s, -o)", f"material {name!r}")
        return found[0] if found and not np.array_equal(found[0], np.eye(2, 3)) else None

    def _texture(self, material: str, source: MtlMaterial, key: str, srgb: bool) -> Texture | None:
        if key not in source.maps:
            return None
        name, wrap, _ = _map_options(source.maps[key])
        file = self._find(name, material, source.folder)
        if file is None:
            return None
        if file not in self._images:
            self._images[file] = read_image(file, self._what(name, material))
        return self._once(Texture(name, self._images[file], srgb, (wrap, wrap)), file, wrap, srgb)

    def _color_and_coverage(self, material: str, source: MtlMaterial) -> Texture | None:
        """Return the base colour texture with coverage in its alpha."""
        color = self._texture(material, source, "map_kd", srgb=True)
        coverage = self._texture(material, source, "map_d", srgb=False)
        if coverage is None:
            if color is not None and _coverage(source.numbers) == 1.0 and color.pixels[..., 3].min() < 255:
                self.findings.add("alpha of map_Kd without map_d", f"material {material!r}")
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

    def _what(self, name: str, material: str) -> str:
        return f"{str(self.path)!r}: texture {name!r} of material {material!r}"

    def _find(self, text: str, material: str, folder: Path) -> Path | None:
        """Return the file of a map, whose name may hold "#" or have a comment behind it.

        None, with a warning, for one that was named by a path of another machine.
        """
        missing: SceneError | None = None
        for name in dict.fromkeys((unquoted(text), unquoted(without_comment(text)))):
            what, bare = self._what(name, material), re.split(r"[\\/]", name)[-1]
            tries = [(folder, name), (self.path.parent, name), (folder, bare)]
            if ELSEWHERE.match(name):
                if os.path.isabs(name):
                    check_inside(Path(name), what)
                if os.path.isfile(name):
                    check_inside(Path(name), what)
                    return Path(name)
                tries = [(folder, bare)]
            for place, candidate in tries:
                try:
                    return find_file(place, candidate, what)
                except OutsideError:
                    raise
                except SceneError as error:
                    missing = missing or error
        if ELSEWHERE.match(name):
            self.findings.lost.append(f"{what} is not here: there is no {bare!r} in {str(folder)!r}; plain colour")
            return None
        raise missing or SceneError(f"{what} is missing")


def _is_metal(diffuse: np.ndarray, specular: np.ndarray) -> bool:
    """Return whether a material of these colours can only be meant as a metal."""
    is_colored = np.ptp(diffuse) > GREY_STEP and np.ptp(specular) <= GREY_STEP
    darkest = specular.max() if diffuse.max() <= BLACK else specular.min()
    is_bright = darkest > METAL_SPECULAR and np.all(specular >= diffuse)
    return bool(is_bright and not is_colored and np.all(specular + diffuse <= 1.0 + 1e-6))


def _is_cut_out(alpha: np.ndarray) -> bool:
    """Return whether a map of coverage, uint8, says hole or surface nearly everywhere, as those of leaves do."""
    return bool(np.mean((alpha > HOLE) & (alpha < 255 - HOLE)) < MOST_BETWEEN)


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


def _options(words: list[str]) -> tuple[list[tuple[str, list[str]]], int]:
    """Return the options of a map statement, which come first, with their arguments; and where its file name begins."""
    found: list[tuple[str, list[str]]] = []
    at = 0
    while at < len(words) - 1 and words[at].startswith("-"):
        option, at = words[at].lower(), at + 1
        values: list[str] = []
        for count in range(OPTION_ARGUMENTS.get(option, 1)):
            if at < len(words) - 1 and (count == 0 or _is_number(words[at])):
                values.append(words[at])
                at += 1
        found.append((option, values))
    return found, at


def _map_options(words: list[str]) -> tuple[str, str, np.ndarray]:
    """Return the file name as it stands, the wrap mode, and scale and offset [2, 3] of a map statement."""
    wrap, transform = "repeat", np.eye(2, 3)
    options, at = _options(words)
    for option, values in options:
        if option == "-clamp" and values and values[0].lower() == "on":
            wrap = "clamp"
        if option in ("-s", "-o") and all(_is_number(value) for value in values):
            for axis, value in enumerate(values[:2]):
                transform[axis, axis if option == "-s" else 2] = float(value)
    return " ".join(words[at:]), wrap, transform


def _further_options(words: list[str], key: str) -> list[str]:
    """Return the options of a map that change what it shows and are not read, such as "-mm 0.2 0.5"."""
    found = []
    for option, values in _options(words)[0]:
        numbers = [float(value) for value in values if _is_number(value)]
        changes = {
            "-mm": numbers not in ([0.0, 1.0], [0.0]),
            "-t": any(numbers),
            "-cc": values[:1] == ["on"],
            "-imfchan": True,
            "-bm": key == "norm" and numbers != [1.0],
        }
        if changes.get(option, False):
            found.append(" ".join([option, *values]))
    return found


def unquoted(name: str) -> str:
    """Return a file name without the quotes around it."""
    return name[1:-1] if len(name) > 1 and name[0] == name[-1] and name[0] in "\"'" else name


def _number(word: str) -> float:
    """Return a number; a word that is none becomes nan."""
    return float(word) if _is_number(word) else np.nan


def _is_number(word: str) -> bool:
    return re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", word) is not None


def _resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return a uint8 [h, w] image at another size."""
    if image.shape == (height, width):
        return image
    from PIL import Image

    return np.asarray(Image.fromarray(image).resize((width, height)))
