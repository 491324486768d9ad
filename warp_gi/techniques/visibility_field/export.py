"""Baked visibility fields for other programs: texture arrays, and a JSON file that says how to read them.

The texture array is the paper's (dvf.txt, section 4.2 and Fig. 4): 128 visible, 64 occluded, 32 the occlusion label;
a layer is a height of the grid, its octahedral maps padded by one texel and tiled. The paper's z is up, here y is.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from warp_gi.baking import Bake
from warp_gi.errors import BakeError, OptionError
from warp_gi.files import frame_path, replacing
from warp_gi.kernels import visibility_field as field_kernels
from warp_gi.techniques.shared.octahedral import texels_of
from warp_gi.techniques.shared.octahedral_atlas import (
    MAPPING,
    PADDING,
    PADDING_TEXT,
    padded,
    warn_if_too_large,
    write_parts,
)

TEXTURE_VISIBLE, TEXTURE_OCCLUDED, TEXTURE_LABEL = 128, 64, 32
"""Values that a texel is the sum of, for its bits and the label of its cell."""

TEXT = {
    "layers": "Layer k holds the cells of grid y = k. The texel with column c, row r of the map of cell (x, y, z) is "
    "at column x * (resolution + 2 * padding) + padding + c, row z * (resolution + 2 * padding) + padding + r; row 0 "
    "is the first row of the image. Cell (x, y, z) spans grid_low + cell_size * (x, y, z) to grid_low + cell_size * "
    "(x + 1, y + 1, z + 1), in metres, y up, right-handed.",
    "bits": "Texels are whole numbers 0 to 255; read them unfiltered and not as sRGB. visible: some point on the "
    "surfaces in the cell sees the sky that way. occluded: from some point the scene blocks it. Only visible: no ray "
    "needs tracing, it reaches the sky. Only occluded: no ray needs tracing, it is blocked. Both, or none: trace. "
    "label: more than half of the map is occluded; it is the same in all texels of a cell, padding included. Cells "
    "without surfaces, or that were not baked, are 0.",
    "map": MAPPING,
    "position": "Look up the position that rays start from: the surface point moved a little along its normal, to the "
    "side that is seen. A point on the border of two cells otherwise finds the wrong one.",
    "padding": f"{PADDING_TEXT}, so that a lookup that is off by one texel stays in the cell.",
}


def check_export_name(path: str | Path) -> None:
    """Raise OptionError unless ``path`` names a .png or .exr file."""
    if Path(path).suffix.lower() not in (".png", ".exr"):
        raise OptionError(f"cannot write {Path(path).name}: textures are .png files, one a layer, or one .exr file")


def cell_maps(bake: Bake) -> np.ndarray:
    """Return uint8 [cell of the bake, resolution, resolution]: the paper's eight bits of each texel."""
    resolution = map_resolution(bake)
    shifts = np.arange(0, 32, 2, dtype=np.uint32)
    states = (bake.arrays["masks"][:, :, None] >> shifts & 3).astype(np.uint8)
    states = states.reshape(len(states), -1)[:, : resolution**2]
    label = (bake.arrays["flags"] & int(field_kernels.SLOT_LABEL)) != 0
    texels = TEXTURE_VISIBLE * (states & 1) + TEXTURE_OCCLUDED * (states >> 1) + TEXTURE_LABEL * label[:, None]
    return texels.astype(np.uint8).reshape(-1, resolution, resolution)


def map_resolution(bake: Bake) -> int:
    """Return the texels along a side of a cell's map; raises BakeError for bakes of other techniques."""
    if bake.technique != "VisibilityField":
        raise BakeError(f"only bakes of VisibilityField can be exported as textures, this one is of {bake.technique}")
    return int(bake.settings["resolution"])


def cells_at_height(bake: Bake, y: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the entries of a bake whose cells have grid ``y``, and x and z of those cells, each int64 [entry]."""
    nx, ny, _ = (int(n) for n in bake.arrays["grid_shape"])
    cells = bake.arrays["cells"].astype(np.int64)
    chosen = np.flatnonzero(cells // nx % ny == y)
    return chosen, cells[chosen] % nx, cells[chosen] // (nx * ny)


def export_textures(bake: Bake, path: str | Path) -> list[Path]:
    """Write a field as a texture array and a JSON file that says how to read it; return the paths, the JSON file last.

    A .png path makes a file for each layer, NAME.####.png; an .exr path one file with a part for each layer. Raises
    OptionError for other names, OSError when nothing can be written.
    """
    path = Path(path)
    check_export_name(path)
    nx, ny, nz = (int(n) for n in bake.arrays["grid_shape"])
    maps = padded(cell_maps(bake))
    size = maps.shape[-1]
    warn_if_too_large(path.name, nx * size, nz * size, "use larger cells or a lower resolution")

    def pixels(y: int) -> np.ndarray:
        chosen, x, z = cells_at_height(bake, y)
        tiles = np.zeros((nz, nx, size, size), np.uint8)
        tiles[z, x] = maps[chosen]
        return np.ascontiguousarray(tiles.transpose(0, 2, 1, 3)).reshape(nz * size, nx * size)

    is_png = path.suffix.lower() == ".png"
    pattern = path if "#" in path.name or not is_png else path.with_name(f"{path.stem}.####.png")
    name = pattern.stem.replace("#", "").rstrip("._- ") if is_png else path.stem
    description = path.with_name(f"{name or 'layers'}.json")
    description.unlink(missing_ok=True)  # while layers of two exports stand beside each other
    if is_png:
        files = [frame_path(pattern, y) for y in range(ny)]
        for y, file in enumerate(files):
            _write_gray(file, pixels(y))
    else:
        files = [path]
        with replacing(path) as part:  # half floats hold 0 to 255 exactly
            planes = lambda y: pixels(y)[:, :, None].astype(np.float16)  # noqa: E731
            write_parts(part, path, planes, ("Y",), [_part_name(y) for y in range(ny)])
    layers: dict[str, object] = {"files": [file.name for file in files]}
    if not is_png:
        layers = {"file": path.name, "parts": [_part_name(y) for y in range(ny)], "channel": "Y"}
    low = [float(v) for v in bake.arrays["grid_low"]]
    text = {
        "format": "warp_gi visibility field textures",
        "scene": bake.scene_name,
        "grid_low": low,
        "cell_size": float(bake.arrays["grid_cell_size"][0]),
        "grid_shape": {"x": nx, "y": ny, "z": nz},
        "resolution": size - 2 * PADDING,
        "padding": PADDING,
        "bits": {"visible": TEXTURE_VISIBLE, "occluded": TEXTURE_OCCLUDED, "label": TEXTURE_LABEL},
        "layers": layers,
        "how_to_read": TEXT,
    }
    with replacing(description) as part:
        part.write_text(json.dumps(text, indent=2) + "\n")
    return [*files, description]


def _write_gray(path: Path, pixels: np.ndarray) -> None:
    from PIL import Image

    with replacing(path) as part:
        Image.fromarray(pixels).save(part, format="PNG")


def _part_name(y: int) -> str:
    return f"layer{y:04d}"


# ---- an example of a reader ----


def read_textures(path: str | Path) -> tuple[np.ndarray, dict[str, Any]]:
    """Return the layers, uint8 [grid y, row, column], and the description of an export as .png files.

    ``path`` is that of its JSON file.
    """
    from PIL import Image

    info = json.loads(Path(path).read_text())
    return np.stack([np.asarray(Image.open(Path(path).parent / name)) for name in info["layers"]["files"]]), info


def look_up(layers: np.ndarray, info: dict[str, Any], positions: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Return the texel that each ray finds, uint8 [ray]; 0 outside of the grid.

    Args:
        layers: Layers of an export, as ``read_textures`` returns them.
        info: Description of that export.
        positions: float [ray, 3], metres: origins of the rays.
        directions: float [ray, 3], of any length above zero.
    """
    cell = np.floor((positions - info["grid_low"]) / info["cell_size"]).astype(int)
    shape = np.array([info["grid_shape"][axis] for axis in "xyz"])
    inside = ((cell >= 0) & (cell < shape)).all(1)
    x, y, z = np.clip(cell, 0, shape - 1).T
    size, padding = info["resolution"], info["padding"]
    column, row = (at + padding for at in texels_of(directions, size))
    tile = size + 2 * padding
    return np.where(inside, layers[y, z * tile + row, x * tile + column], 0)
