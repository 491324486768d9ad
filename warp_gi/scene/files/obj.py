"""OBJ files: triangles through trimesh, materials by an own reader of MTL.

How MTL becomes glTF's metallic-roughness: ``Kd`` (times ``map_Kd``) is the base colour, where
a Kd of 0 0 0 beside a ``map_Kd`` counts as white, as its exporters meant it. ``Ks`` is the
reflectance at normal incidence, so the specular factor is max(Ks) / 0.04, at most 1, and Ks 0
is pure Lambert; where every channel of Ks is above 0.25 and above Kd, and there is no
``map_Kd``, it is a metal of colour Ks. ``Ns`` is a Blinn-Phong exponent: the roughness is
(2 / (Ns + 2))^(1/4), and its GGX alpha the square of that. ``Ke`` (times ``map_Ke``) is
emitted radiance. ``map_d`` (or ``d``) is coverage, cut at 0.5. ``norm`` is a normal map;
``bump`` maps hold heights and are ignored. Both sides emit.
"""

from __future__ import annotations

import io
import re
import warnings
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warp_gi.errors import SceneError
from warp_gi.scene.files.images import find_file, read_image
from warp_gi.scene.files.parts import SceneParts
from warp_gi.scene.geometry import triangulated
from warp_gi.scene.model import Material, Mesh, Node, Texture

METAL_SPECULAR = 0.25
OPTION_ARGUMENTS = {"-o": 3, "-s": 3, "-t": 3, "-mm": 2}
"""Number of arguments of MTL map options that take more or fewer than one."""


@dataclass
class _MtlMaterial:
    """The statements of one ``newmtl``, keys in lower case."""

    numbers: dict[str, list[float]] = field(default_factory=dict)
    maps: dict[str, list[str]] = field(default_factory=dict)


def read_obj(path: Path) -> SceneParts:
    """Read an .obj file and the .mtl files it names, one node a material; raises SceneError."""
    from trimesh.exchange.obj import load_obj

    text = _read_text(path)
    statements: dict[str, _MtlMaterial] = {}
    for name in re.findall(r"^[ \t]*mtllib\s+(.+?)\s*$", text, re.MULTILINE):
        try:
            file = find_file(path.parent, name, f"{str(path)!r}: material library")
        except SceneError as error:
            warnings.warn(f"{error}; its materials become plain grey", stacklevel=3)
            continue
        statements.update(_read_mtl(file))
    names = list(dict.fromkeys(re.findall(r"^[ \t]*usemtl\s+(.+?)\s*$", text, re.MULTILINE)))
    unknown = [name for name in names if name not in statements]
    if unknown and statements:
        warnings.warn(f"{str(path)!r}: material {unknown[0]!r} is not in its library; plain grey", stacklevel=3)
    reader = _MaterialReader(path, statements)
    resolver: Any = _NamesOnly(names)  # all of a trimesh Resolver that load_obj calls
    try:
        contents = load_obj(io.StringIO(text), resolver=resolver)
    except IndexError as error:
        raise SceneError(
            f"{str(path)!r}: a face names a vertex, texture coordinate or normal that is out of range ({error})"
        ) from error
    nodes = []
    for geometry_name, geometry in reversed(list(contents.get("geometry", {}).items())):
        visual = geometry.get("visual")
        material_name = getattr(getattr(visual, "material", None), "name", None)
        normals, uvs = geometry.get("vertex_normals"), getattr(visual, "uv", None)
        mesh = Mesh(
            np.asarray(geometry["vertices"], np.float64),
            triangulated(np.asarray(geometry["faces"])),
            reader.material(material_name),
            None if normals is None else np.asarray(normals, np.float32),
            None if uvs is None or not len(uvs) else np.asarray(uvs, np.float32)[:, :2],
            str(geometry_name),
        )
        nodes.append(Node(material_name or str(geometry_name), [mesh]))
    return SceneParts(nodes)


def _read_text(path: Path) -> str:
    """Return the text of a file in UTF-8 or, failing that, Latin-1."""
    data = path.read_bytes()
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError:
        return data.decode("latin-1")


class _NamesOnly:
    """Gives trimesh a library of bare material names, so that it groups faces and reads no textures."""

    def __init__(self, names: list[str]) -> None:
        self.library = "".join(f"newmtl {name}\n" for name in names).encode()

    def get(self, name: str) -> bytes:
        """Return the library, whatever its name."""
        return self.library

    __getitem__ = get


def _read_mtl(path: Path) -> dict[str, _MtlMaterial]:
    materials: dict[str, _MtlMaterial] = {}
    current = _MtlMaterial()
    for line in _read_text(path).splitlines():
        words = line.split("#")[0].split() if not line.lstrip().lower().startswith(("newmtl", "map_")) else line.split()
        if len(words) < 2:
            continue
        key = words[0].lower()
        if key == "newmtl":
            current = materials[" ".join(words[1:])] = _MtlMaterial()
        elif key.startswith("map_") or key in ("norm", "bump", "disp", "refl"):
            current.maps[key] = words[1:]
        else:
            try:
                current.numbers[key] = [float(word) for word in words[1:]]
            except ValueError:
                continue  # statements such as "Kd spectral file.rfl"
    return materials


class _MaterialReader:
    """Makes each material and each texture once."""

    def __init__(self, path: Path, statements: dict[str, _MtlMaterial]) -> None:
        self.path, self.statements = path, statements
        self._materials: dict[str | None, Material] = {}
        self._images: dict[Path, np.ndarray] = {}
        self._textures: dict[tuple[object, ...], Texture] = {}

    def material(self, name: str | None) -> Material:
        """Return the material; a plain grey Lambert if no library has it."""
        if name not in self._materials:
            found = self.statements.get(name or "")
            grey = Material(name or "default", specular=0.0)
            self._materials[name] = grey if found is None else self._convert(str(name), found)
        return self._materials[name]

    def _convert(self, name: str, source: _MtlMaterial) -> Material:
        numbers, maps = source.numbers, source.maps
        diffuse, specular = _color(numbers, "kd", 0.8), _color(numbers, "ks", 0.0)
        if "map_kd" in maps and not diffuse.any():
            diffuse = np.ones(3)
        emission_map = maps.get("map_ke", maps.get("map_emissive"))
        emission = _color(numbers, "ke", 1.0 if emission_map else 0.0, highest=np.inf)
        coverage = numbers["d"][0] if "d" in numbers else 1.0 - numbers.get("tr", [0.0])[0]
        coverage = min(max(coverage, 0.0), 1.0)
        shininess = max(numbers.get("ns", [0.0])[0], 0.0)
        is_metal = "map_kd" not in maps and min(specular) > METAL_SPECULAR and np.all(specular > diffuse)
        return Material(
            name,
            base_color=tuple((specular if is_metal else diffuse).tolist()),
            alpha=coverage,
            metallic=float(is_metal),
            roughness=(2.0 / (shininess + 2.0)) ** 0.25,
            specular=1.0 if is_metal else min(1.0, float(specular.max()) / 0.04),
            emission=tuple(emission.tolist()),
            base_color_texture=self._color_and_coverage(name, maps.get("map_kd"), maps.get("map_d")),
            normal_texture=self._texture(name, maps.get("norm"), srgb=False),
            emission_texture=self._texture(name, emission_map, srgb=True) if emission.max() > 0.0 else None,
            alpha_cutoff=0.5 if "map_d" in maps or coverage < 0.5 else None,
            double_sided=True,
        )

    def _texture(self, material: str, words: list[str] | None, srgb: bool) -> Texture | None:
        if words is None:
            return None
        name, wrap = _map_name(words)
        pixels = self._image(name, material)
        return self._once(Texture(name, pixels, srgb, (wrap, wrap)), name, wrap, srgb)

    def _color_and_coverage(self, material: str, color: list[str] | None, coverage: list[str] | None) -> Texture | None:
        """Return the base colour texture with coverage in its alpha."""
        if coverage is None:
            return self._texture(material, color, srgb=True)
        coverage_name, wrap = _map_name(coverage)
        mask = self._image(coverage_name, material)
        alpha = mask[..., 3] if mask[..., 3].min() < 255 else mask[..., :3].max(axis=2)
        pixels = np.full_like(mask, 255)
        color_name = ""
        if color is not None:
            color_name, wrap = _map_name(color)
            pixels = self._image(color_name, material).copy()
        pixels[..., 3] = _resized(alpha, pixels.shape[0], pixels.shape[1])
        name = color_name or coverage_name
        return self._once(Texture(name, pixels, True, (wrap, wrap)), color_name, coverage_name, wrap)

    def _once(self, texture: Texture, *key: object) -> Texture:
        return self._textures.setdefault(key, texture)

    def _image(self, name: str, material: str) -> np.ndarray:
        what = f"{str(self.path)!r}: texture {name!r} of material {material!r}"
        file = find_file(self.path.parent, name, what)
        if file not in self._images:
            self._images[file] = read_image(file, what)
        return self._images[file]


def _color(numbers: dict[str, list[float]], key: str, default: float, highest: float = 1.0) -> np.ndarray:
    values = numbers.get(key) or [default]
    return np.clip(np.array(values[:3] if len(values) >= 3 else values[:1] * 3), 0.0, highest)


def _map_name(words: list[str]) -> tuple[str, str]:
    """Return the file name and the wrap mode of a map statement, whose options come first."""
    wrap, at = "repeat", 0
    while at < len(words) - 1 and words[at].startswith("-"):
        option, at = words[at].lower(), at + 1
        if option == "-clamp" and words[at].lower() == "on":
            wrap = "clamp"
        for count in range(OPTION_ARGUMENTS.get(option, 1)):
            if count == 0 or _is_number(words[at]):
                at += at < len(words) - 1
    return " ".join(words[at:]), wrap


def _is_number(word: str) -> bool:
    return re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?", word) is not None


def _resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return a uint8 [h, w] image at another size."""
    if image.shape == (height, width):
        return image
    from PIL import Image

    return np.asarray(Image.fromarray(image).resize((width, height)))
