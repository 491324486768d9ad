"""Cells of a surface cache for other programs: points with normal and irradiance in a PLY file, described by JSON."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from warp_gi.baking import Bake
from warp_gi.errors import OptionError
from warp_gi.files import replacing
from warp_gi.techniques.shared.exports import check_own

FORMAT, FORMAT_VERSION = "warp_gi surface cache", 1
FIELDS = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *("irradiance_r", "irradiance_g", "irradiance_b", "lobe_r", "lobe_g", "lobe_b"),
    *("size", "samples"),
)
TEXT = {
    "points": "A point is the middle of a cell, in metres, y up, right-handed. A cell is a cube of side `size`; cells "
    "of several sizes lie in each other, and the smallest around a point is the one to read.",
    "normal": "One of six: a cell is of surfaces whose geometric normal, on the side that is seen, is nearest to it.",
    "irradiance": "Mean irradiance in W/m^2 by all light, from lamps and sky directly and from other surfaces, linear "
    "Rec. 709. A Lambertian surface there sends albedo / pi of it.",
    "lobe": "Mean exitance in W/m^2 by the specular lobe of the surfaces there.",
    "samples": "Number of samples of the means.",
}
_HEAD = f"ply\nformat binary_little_endian 1.0\ncomment {FORMAT}\n".encode()
"""Start of a .ply file, in which it says by whom it is."""
_COORDINATE = np.uint64((1 << 16) - 1)


def check_export_name(path: Path) -> None:
    """Raise OptionError unless a file is a .ply, beside which no file of another's would be overwritten.

    An export to hall.ply also writes hall.json; over an earlier export it may write.
    """
    if path.suffix.lower() != ".ply":
        raise OptionError(
            f"cannot export to {path.name}: expected .ply for points, or .glb, .gltf or .exr for a light map"
        )
    check_own((path, path.with_suffix(".json")), _says_so)


def _says_so(file: Path) -> bool:
    if file.suffix == ".json":
        return bool(json.loads(file.read_text(encoding="utf-8"))["format"] == FORMAT)
    with open(file, "rb") as opened:
        return opened.read(len(_HEAD)) == _HEAD


def cell_points(bake: Bake) -> np.ndarray:
    """Return the cells of a bake as points, float32 [cell, 14], in the columns of ``FIELDS``."""
    keys, rows = bake.arrays["keys"], bake.arrays["cells"]
    level = (keys & np.uint64(15)).astype(np.int64) - 1
    side = float(bake.arrays["side"][0]) * 2.0**level
    places = np.stack([(keys >> np.uint64(shift) & _COORDINATE).astype(np.float64) for shift in (39, 23, 7)], axis=1)
    which = (keys >> np.uint64(4) & np.uint64(7)).astype(np.int64)
    normals = np.zeros((len(keys), 3))
    normals[np.arange(len(keys)), which // 2] = 1.0 - 2.0 * (which % 2)
    points = bake.arrays["low"].astype(np.float64) + (places + 0.5) * side[:, None]
    columns = [points, normals, rows[:, :3], rows[:, 4:7], side[:, None], rows[:, 3:4]]
    return np.concatenate(columns, axis=1).astype(np.float32)


def export_points(bake: Bake, path: Path) -> list[Path]:
    """Write NAME.ply, binary, and NAME.json, which says what is in it; return both, the description last.

    Raises OptionError for other names, and where a file of another's would be overwritten.
    """
    check_export_name(path)
    points = cell_points(bake)
    header = [f"element vertex {len(points)}", *(f"property float {name}" for name in FIELDS)]
    description = path.with_suffix(".json")
    text = {"format": FORMAT, "version": FORMAT_VERSION, "scene": bake.scene_name, "file": path.name, **TEXT}
    text |= {"cells": len(points), "fields": FIELDS, "bake": bake.digest}
    with replacing(path) as part:
        part.write_bytes(_HEAD + "\n".join([*header, "end_header\n"]).encode() + points.astype("<f4").tobytes())
    with replacing(description) as part:
        part.write_text(json.dumps(text, indent=2) + "\n", encoding="utf-8")
    return [path, description]
