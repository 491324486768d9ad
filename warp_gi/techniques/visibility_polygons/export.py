"""Baked visibility polygons for other programs: arrays in one binary file, and a JSON file that says how to read it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from warp_gi.baking import Bake
from warp_gi.errors import BakeError, OptionError, one_line
from warp_gi.files import replacing
from warp_gi.techniques.visibility_polygons.bake import contours_of

FORMAT = "warp_gi visibility polygons"
ALIGNMENT = 16
"""Bytes that the place of an array in the file is a multiple of."""
TEXT = {
    "arrays": "Each is at `offset` bytes in the file, little-endian, in rows of its `shape`.",
    "sets": "What a vertex sees on one side: contours contour_starts[s] to contour_starts[s + 1] - 1. positions in "
    "metres, y up, right-handed; normals unit. Contour c has the points point_starts[c] to point_starts[c + 1] - 1.",
    "points": "(d, w): a unit direction from the vertex p and one over the distance of the occluder there, 0 for the "
    "horizon. From a point s it lies in direction d + w (p - s). What is visible lies to the left, seen from outside.",
    "records": "Fronts of all triangles, then backs. corner_sets are the sets of the corners, -1 where there is none. "
    "states: 0 traced (no set, nothing seen, or contours do not match), 1 interpolated, 2 flagged. errors: the largest "
    "share of light under a uniform sky that was wrong at points of the triangle.",
    "lists": "Record r has the lists list_starts[r] to list_starts[r + 1] - 1, of one contour a corner: list_contours. "
    "The polygon begins at the points list_first of them; each of the steps step_starts[l] to step_starts[l + 1] - 1 "
    "advances the contours whose bits (1, 2, 4) it has by one point, and the last comes back to the start. At each the "
    "polygon's direction is the mean of the three directions by barycentric weights, normalised.",
}


def check_export_name(path: str | Path) -> None:
    """Raise OptionError unless ``path`` names a .bin file."""
    if Path(path).suffix.lower() != ".bin":
        raise OptionError(f"cannot write {Path(path).name}: polygons are a .bin file, with a .json file beside it")


def export_polygons(bake: Bake, path: str | Path) -> list[Path]:
    """Write a bake's arrays and their description; return both paths, the JSON file last.

    Raises OptionError for other names than .bin, BakeError for bakes of other techniques, OSError when nothing can be
    written.
    """
    path = Path(path)
    check_export_name(path)
    contours_of(bake)
    description = path.with_suffix(".json")
    description.unlink(missing_ok=True)  # while files of two exports stand beside each other
    places: dict[str, dict[str, Any]] = {}
    with replacing(path) as part, part.open("wb") as file:
        for name in sorted(bake.arrays):
            array = np.ascontiguousarray(bake.arrays[name], bake.arrays[name].dtype.newbyteorder("<"))
            file.write(b"\0" * (-file.tell() % ALIGNMENT))
            places[name] = {"offset": file.tell(), "dtype": array.dtype.name, "shape": list(array.shape)}
            file.write(array.tobytes())
    text = {"format": FORMAT, "scene": bake.scene_name, "file": path.name, "settings": bake.settings, "arrays": places}
    with replacing(description) as part:
        part.write_text(json.dumps(text | {"how_to_read": TEXT}, indent=2) + "\n")
    return [path, description]


# ---- an example of a reader ----


def read_polygons(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the arrays of an export by name, and its description.

    ``path`` is that of its JSON file. Raises BakeError for other files and damaged ones.
    """
    path = Path(path)
    try:
        info = json.loads(path.read_text())
        if info["format"] != FORMAT:
            raise ValueError(f"its format is {info['format']!r}, expected {FORMAT!r}")
        data = (path.parent / info["file"]).read_bytes()
        arrays = {}
        for name, at in info["arrays"].items():
            count = int(np.prod(at["shape"]))
            arrays[name] = np.frombuffer(data, at["dtype"], count, at["offset"]).reshape(at["shape"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BakeError(
            f"{path}: is no export of visibility polygons ({one_line(error)}); export them again"
        ) from error
    return arrays, info
