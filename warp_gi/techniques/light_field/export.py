"""Baked light field probes for other programs: EXR atlases, and a JSON file that says how to read them.

The atlas is the paper's (light_field_probes.txt, section 3 and Fig. 2): a square map for each probe, here padded by one
texel. Texels are unpacked to what any reader of EXR files knows: half and float channels R, G, B or Y.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from warp_gi.baking import Bake
from warp_gi.errors import BakeError, OptionError
from warp_gi.files import replacing
from warp_gi.kernels import light_field as field_kernels
from warp_gi.openimageio import open_image, reason
from warp_gi.sequence.exr import HALF_MAX
from warp_gi.techniques.light_field.state import baked_resolution
from warp_gi.techniques.shared.octahedral import decode, encode, texels_of
from warp_gi.techniques.shared.octahedral_atlas import (
    MAPPING,
    PADDING,
    PADDING_TEXT,
    padded_texels,
    warn_if_too_large,
    write_parts,
)

FORMAT = "warp_gi light field probes"
ATLASES = {
    "radiance": ("resolution", "half", "RGB", "W/(m^2 sr)", "nearest"),
    "normal": ("resolution", "half", "RGB", "unit vector", "nearest"),
    "distance": ("resolution", "half", "Y", "m", "nearest"),
    "irradiance": ("irradiance_resolution", "float", "RGB", "W/m^2", "linear"),
    "moments": ("irradiance_resolution", "float", "RGB", "m, m^2, 0", "linear"),
}
"""Atlases by name: the setting that is their maps' resolution, type, channels, units, and how they are filtered."""

TEXT = {
    "probes": "Probe (x, y, z) of the grid has index i = (z * counts.y + y) * counts.x + x. Of the regular grid it "
    "would be at low + spacing * (x, y, z), in metres, y up, right-handed; where it is, for some were moved out of "
    "walls, positions[i] says, and all directions and distances of its maps are about that point. Probes in `covered` "
    "are inside of something: leave them out.",
    "tiles": "The map of probe i is the tile in column i % columns, row i // columns of every atlas, tile row 0 at the "
    "top; columns is a multiple of counts.x. The texel with column c, row r of the map is at pixel column (i % "
    "columns) * (size + 2 * padding) + padding + c and pixel row (i // columns) * (size + 2 * padding) + padding + r, "
    "where size is the atlas's; row 0 is the first row of the image. Tiles without a probe are 0.",
    "map": MAPPING.replace("resolution", "size"),
    "filter": "nearest: the texel that the formula of `map` names. linear: between the middles of texels, where the "
    "middle of the texel with column c, row r is at a + 0.5 = (c + 0.5) / size, b + 0.5 = (r + 0.5) / size.",
    "padding": f"{PADDING_TEXT}, so that linear filtering needs no special case.",
    "radiance": "What arrives at the probe from the texel's direction: reflected by the surface there plus what it "
    "emits, or the sky's where it sees the sky. Linear, Rec. 709; at most 65504. The library reads it unfiltered: a "
    "mean mixes what lies on both sides of an edge.",
    "normal": "Of the surface there, in the world's axes, on the side that the probe sees; towards the probe where it "
    "sees the sky. Read unfiltered: a mean over an edge is the normal of nothing.",
    "distance": "From the probe to the surface along the texel's direction, infinite (the half 0x7C00) where it sees "
    "the sky. Read unfiltered, for the same reason.",
    "irradiance": "On a surface that faces the texel's direction, by light that surfaces reflect: light from the sky "
    "and from emitters themselves is not in it. A Lambertian surface of that normal reflects albedo / pi of it.",
    "moments": "R: mean distance d, G: mean squared distance d2 of what is seen about the texel's direction, weighted "
    "by a power of the cosine; B: 0. A probe sees a point at distance r in that direction if r <= d, otherwise with a "
    "chance of at most v / (v + (r - d)^2), where v = |d^2 - d2|; weigh the eight probes around a point by it (McGuire "
    "et al. 2017, Real-Time Global Illumination using Precomputed Light Field Probes, section 5.2).",
}


# ---- packed texels ----


def unpack_radiance(words: np.ndarray) -> np.ndarray:
    """Return float32 [..., 3] of RGB9E5 words, uint32 [...]; exact."""
    mantissas = np.stack([words & 511, words >> 9 & 511, words >> 18 & 511], axis=-1).astype(np.float32)
    return np.ldexp(mantissas, (words >> 27).astype(np.int32)[..., None] - 24)


def unpack_distance(surfels: np.ndarray) -> np.ndarray:
    """Return float16 [...], metres, of surfels, uint32 [...]; infinite where a texel sees the sky. Exact."""
    return (surfels & 0x7FFF).astype(np.uint16).view(np.float16)


def unpack_normal(surfels: np.ndarray) -> np.ndarray:
    """Return float32 [..., 3], unit vectors, of surfels, uint32 [...]."""
    steps = np.stack([surfels >> 16 & 255, surfels >> 24], axis=-1).astype(np.float32)
    return decode(steps / np.float32(254)).astype(np.float32)


def probe_maps(bake: Bake) -> dict[str, Callable[[int], np.ndarray]]:
    """Return for each of ``ATLASES`` a function of a probe's index.

    It returns the probe's map, float16 or float32 [texel, channel].

    Raises BakeError for bakes of other techniques.
    """
    if bake.technique != "LightFieldProbes":
        raise BakeError(f"only bakes of LightFieldProbes have atlases, this one is of {bake.technique}")
    arrays = bake.arrays
    texels, few = baked_resolution(bake) ** 2, int(bake.settings["irradiance_resolution"]) ** 2

    def part(name: str, probe: int, size: int) -> np.ndarray:
        return arrays[name][probe * size : (probe + 1) * size]

    def radiance(probe: int) -> np.ndarray:
        light = unpack_radiance(part("radiance", probe, texels))
        first, last = np.searchsorted(arrays["emission_texels"], (probe * texels, (probe + 1) * texels))
        light[arrays["emission_texels"][first:last] - probe * texels] += unpack_radiance(arrays["emission"][first:last])
        return np.minimum(light, HALF_MAX).astype(np.float16)

    def moments(probe: int) -> np.ndarray:
        return np.pad(part("moments", probe, few), ((0, 0), (0, 1)))

    return {
        "radiance": radiance,
        "normal": lambda probe: unpack_normal(part("surfels", probe, texels)).astype(np.float16),
        "distance": lambda probe: unpack_distance(part("surfels", probe, texels))[:, None],
        "irradiance": lambda probe: part("irradiance", probe, few),
        "moments": moments,
    }


def atlas_columns(counts: Sequence[int]) -> int:
    """Return the number of tiles side by side in an atlas: whole rows of the grid that make it about square.

    ``counts`` are the probes along x, y and z.
    """
    return counts[0] * max(round(math.sqrt(math.prod(counts)) / counts[0]), 1)


# ---- files ----


def check_export_name(path: str | Path) -> None:
    """Raise OptionError unless ``path`` names an .exr file."""
    if Path(path).suffix.lower() != ".exr":
        raise OptionError(f"cannot write {Path(path).name}: atlases of probes are .exr files; give NAME.exr")


def export_atlases(bake: Bake, path: str | Path) -> list[Path]:
    """Write probes as atlases NAME.radiance.exr, .normal, .distance, .irradiance and .moments, and NAME.json.

    ``path`` is NAME.exr. Each atlas has a file of its own, as engines read one picture of up to four channels from an
    EXR file. The JSON file says all that is needed to read them; it is the last of the paths returned, and appears
    after the others. Files of an earlier export stay until all new ones are whole. Raises OptionError for other names,
    OSError when nothing can be written, BakeError for bakes of other techniques.
    """
    path = Path(path)
    check_export_name(path)
    makers = probe_maps(bake)
    counts = tuple(int(n) for n in bake.arrays["grid_counts"])
    columns = atlas_columns(counts)
    rows = -(-math.prod(counts) // columns)
    largest = baked_resolution(bake) + 2 * PADDING
    warn_if_too_large(path.name, columns * largest, rows * largest, "use fewer probes or a lower resolution")
    files = {name: path.with_name(f"{path.stem}.{name}.exr") for name in ATLASES}
    description = path.with_name(f"{path.stem}.json")
    with ExitStack() as stack:  # it renames in reverse: the description last
        text = stack.enter_context(replacing(description))
        parts = {name: stack.enter_context(replacing(file)) for name, file in files.items()}
        for name, part in parts.items():
            pixels = _atlas(makers[name], math.prod(counts), columns, rows)
            write_parts(part, files[name], partial(_whole, pixels), ATLASES[name][2])
        text.write_text(_description(bake, columns, rows, files))
        description.unlink(missing_ok=True)  # while atlases of two exports may stand beside each other
    return [*files.values(), description]


def _whole(pixels: np.ndarray, part: int) -> np.ndarray:
    """Return the pixels of a file's only part."""
    return pixels


def _atlas(maker: Callable[[int], np.ndarray], count: int, columns: int, rows: int) -> np.ndarray:
    """Return the maps of all probes, padded, as an image [row, column, channel]."""
    first = maker(0)
    size = math.isqrt(len(first))
    tile, source = size + 2 * PADDING, padded_texels(size)
    image = np.zeros((rows * tile, columns * tile, first.shape[1]), first.dtype)
    for probe in range(count):
        y, x = probe // columns * tile, probe % columns * tile
        image[y : y + tile, x : x + tile] = maker(probe)[source]
    return image


def _description(bake: Bake, columns: int, rows: int, files: dict[str, Path]) -> str:
    """Return the text of an export's JSON file."""
    arrays = bake.arrays
    sizes = {"resolution": baked_resolution(bake), "irradiance_resolution": int(bake.settings["irradiance_resolution"])}

    def per_axis(values: np.ndarray) -> dict[str, float]:
        return dict(zip("xyz", (v.item() for v in values), strict=True))

    info = {
        "format": FORMAT,
        "scene": bake.scene_name,
        "grid": {
            "low": per_axis(arrays["grid_low"]),
            "spacing": per_axis(arrays["grid_spacing"]),
            "counts": per_axis(arrays["grid_counts"]),
        },
        "columns": columns,
        "rows": rows,
        "padding": PADDING,
        "atlases": {
            name: {
                "file": files[name].name,
                "size": sizes[setting],
                "channels": list(channels),
                "type": kind,
                "units": units,
                "filter": read,
            }
            for name, (setting, kind, channels, units, read) in ATLASES.items()
        },
        "covered": np.flatnonzero(arrays["states"] != int(field_kernels.PROBE_USABLE)).tolist(),
        "how_to_read": TEXT,
        "positions": [],
    }
    # a probe a line, where json would write four
    positions = ",\n".join(f"    {json.dumps([float(str(v)) for v in p])}" for p in arrays["positions"])
    return json.dumps(info, indent=2).replace('"positions": []', f'"positions": [\n{positions}\n  ]') + "\n"


# ---- an example of a reader ----


def read_atlases(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the atlases of an export and its description, by the path of its JSON file.

    Atlases are float16 or float32 [row, column, channel] by their names in ``ATLASES``, as they are in the files.
    Raises OSError when a file is missing or torn.
    """
    info = json.loads(Path(path).read_text())
    images = {}
    for name, atlas in info["atlases"].items():
        source = open_image(Path(path).parent / atlas["file"])
        pixels = source.read_image(atlas["type"]) if source else None
        if source is None or pixels is None or source.has_error:
            reason(source)  # taken, so that it is not printed when the program ends
            raise OSError(f"{atlas['file']}: expected a whole EXR file beside {Path(path).name}; export again")
        images[name] = pixels.reshape(*pixels.shape[:2], -1)
    return images, info


def look_up(
    images: dict[str, np.ndarray], info: dict[str, Any], name: str, probes: np.ndarray, directions: np.ndarray
) -> np.ndarray:
    """Return what probes hold in directions, float32 [item, channel].

    Args:
        images: Atlases, as ``read_atlases`` returns them.
        info: Description of the atlases.
        name: Name of an atlas.
        probes: int [item], index of the probe that is asked.
        directions: float [item, 3], of any length above zero.
    """
    image, atlas, padding = images[name], info["atlases"][name], info["padding"]
    size, tile = atlas["size"], atlas["size"] + 2 * padding
    corner = padding + np.stack([probes % info["columns"], probes // info["columns"]], axis=-1) * tile
    if atlas["filter"] == "nearest":
        column, row = np.moveaxis(corner, -1, 0) + texels_of(directions, size)
        return image[row, column].astype(np.float32)
    at = encode(directions) * size - 0.5  # from the middle of the first texel; the padding's is at -1
    low = np.floor(at).astype(int)
    column, row = np.moveaxis(corner + low, -1, 0)
    x, y = np.moveaxis((at - low).astype(np.float32), -1, 0)[:, :, None]
    upper = image[row, column] * (1 - x) + image[row, column + 1] * x
    return upper * (1 - y) + (image[row + 1, column] * (1 - x) + image[row + 1, column + 1] * x) * y
