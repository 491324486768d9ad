"""Light maps for other programs: an EXR image, the surfaces as glTF with its coordinates, and JSON about both."""

from __future__ import annotations

import base64
import json
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

from warp_gi.baking import Bake
from warp_gi.errors import OptionError
from warp_gi.files import replacing
from warp_gi.scene.scene import Scene
from warp_gi.techniques.shared.atlas.gltf import generator_of, glb
from warp_gi.techniques.shared.exports import check_own
from warp_gi.techniques.shared.exr_parts import Part, write_exr_parts
from warp_gi.techniques.shared.octahedral_atlas import warn_if_too_large
from warp_gi.techniques.surface_cache.light_map import LightMap, LightMapSettings

FORMAT, FORMAT_VERSION = "warp_gi light map", 1
SUFFIXES = (".glb", ".gltf", ".exr")
"""Names of an export end in one of them; ".exr" is the same export as ".glb"."""
LARGEST_HALF = float(np.finfo(np.float16).max)
HEAD = 1 << 16
"""Bytes at the start of an EXR file in which it says by whom it is."""
TEXT = {
    "image": "Irradiance in W/m^2, linear Rec. 709, that arrives at the front of surfaces by all light: from lamps and "
    "sky directly, and from other surfaces. A Lambertian surface sends albedo / pi times it, and its own emission "
    "beside. Light that glossy lobes reflect is not in it.",
    "coordinates": "TEXCOORD_1 of the glTF file, (u, v), v down as glTF has it: texel column u * width - 0.5, row "
    "v * height - 0.5, where whole numbers are middles of texels and row 0 is the first row of the image, at the top. "
    "Filter bilinearly. Texels that no surface covers hold the colour of those nearby, for mipmaps.",
    "normals": "The normals of the vertices; normal maps have no part in it.",
    "sides": "Texels hold the light of fronts, from where a triangle's corners run counter-clockwise. Engines show it "
    "on backs, too.",
    "three.js": "material.lightMap with lightMapIntensity 1 (r155 and later), without other lights. EXRLoader turns "
    "the image upside down: lightMap.channel = 1, lightMap.repeat.y = -1, lightMap.offset.y = 1.",
}


def exported_files(path: Path) -> dict[str, Path]:
    """Return the files of an export by what they are called in its description; "description" is the last."""
    surfaces = path.suffix.lower() if path.suffix.lower() != ".exr" else ".glb"
    return {
        "surfaces": path.with_suffix(surfaces),
        "file": path.with_suffix(".exr"),
        "description": path.with_suffix(".json"),
    }


def check_export_name(path: Path) -> None:
    """Raise OptionError for a file of another kind, or where a file that is another's would be overwritten."""
    if path.suffix.lower() not in SUFFIXES:
        raise OptionError(f"cannot export to {path.name}: light maps are .glb, .gltf or .exr files")
    check_own(exported_files(path).values(), _says_so)


def _says_so(file: Path) -> bool:
    if file.suffix == ".json":
        return bool(json.loads(file.read_text(encoding="utf-8"))["format"] == FORMAT)
    if file.suffix == ".exr":
        with open(file, "rb") as opened:
            return FORMAT.encode() in opened.read(HEAD)
    return generator_of(file) == FORMAT


def export_light_map(
    light_map: LightMap, path: Path, scene: Scene, settings: LightMapSettings, bake: Bake
) -> list[Path]:
    """Write NAME.glb (or NAME.gltf), NAME.exr and NAME.json, and return their paths, the description last.

    Args:
        light_map: The light map.
        path: NAME.glb, NAME.gltf or NAME.exr.
        scene: The scene, whose surfaces are in the glTF file.
        settings: Settings of the light map, which the description tells.
        bake: The surface cache in which its paths ended.

    Files of an earlier export stay until all new ones are whole. Raises OptionError for other names, and where a file
    of another's would be overwritten; OSError when nothing can be written.
    """
    check_export_name(path)
    files = exported_files(path)
    description = files.pop("description")
    warn_if_too_large(files["file"].name, *light_map.size, "use a lower resolution")
    image = light_map.image()
    kind = "half" if image.max() <= LARGEST_HALF else "float"
    surfaces = glb(scene, light_map.atlas, FORMAT, {"light_map": files["file"].name})
    text: dict[str, Any] = {"format": FORMAT, "version": FORMAT_VERSION, "scene": bake.scene_name, "bake": bake.digest}
    text |= {name: file.name for name, file in files.items()}
    text |= {"width": light_map.size[0], "height": light_map.size[1], "samples": settings.samples, "type": kind}
    text["how_to_read"] = TEXT
    with ExitStack() as stack:  # it renames in reverse: the description last
        about = stack.enter_context(replacing(description))
        parts = {name: stack.enter_context(replacing(file)) for name, file in files.items()}
        write_exr_parts(
            parts["file"],
            files["file"],
            [Part("", ("R", "G", "B"), light_map.size, lambda: image, kind)],
            {"warp_gi:format": FORMAT, "warp_gi:bake": bake.digest},
        )
        parts["surfaces"].write_bytes(surfaces if files["surfaces"].suffix == ".glb" else _gltf(surfaces))
        about.write_text(json.dumps(text, indent=2) + "\n", encoding="utf-8")
        description.unlink(missing_ok=True)  # while files of two exports may stand beside each other
    return [*files.values(), description]


def _gltf(binary: bytes) -> bytes:
    """Return a binary glTF file as JSON, with its buffer in it."""
    length = int.from_bytes(binary[12:16], "little")  # after 12 bytes of header; then the chunk's type and itself
    document, data = json.loads(binary[20 : 20 + length]), binary[28 + length :]
    uri = f"data:application/octet-stream;base64,{base64.b64encode(data).decode()}"
    document["buffers"] = [{"byteLength": len(data), "uri": uri}]
    return (json.dumps(document) + "\n").encode()
