"""What arrays of a bake have to be, before a kernel follows their indices."""

from __future__ import annotations

import numpy as np

from warp_gi.baking import Bake
from warp_gi.errors import FARTHEST_VERTEX, BakeError
from warp_gi.layout import Layout, check_layout

TECHNIQUE = "VisibilityPolygons"
NEAREST = 1e12
"""Largest one over a distance of an occluder, 1/m."""


def check_arrays(bake: Bake, triangles: int | None = None) -> None:
    """Raise BakeError for another technique's bake, and for arrays that are not polygons of so many triangles."""
    if bake.technique != TECHNIQUE:
        raise BakeError(f"this bake is by {bake.technique!r}, not by {TECHNIQUE!r}: name its own file or bake it again")
    what, arrays = f"this bake of {bake.scene_name!r}", bake.arrays
    count = {name: len(array) if array.ndim else 0 for name, array in arrays.items()}
    sets, points, steps = (count.get(name, 0) for name in ("positions", "points", "steps"))
    contours, lists = count.get("point_starts", 1) - 1, count.get("list_contours", 0)
    records = count.get("corner_sets", 0) if triangles is None else 2 * triangles
    layouts = {
        "positions": Layout("float32", (sets, 3), -FARTHEST_VERTEX, FARTHEST_VERTEX),
        "normals": Layout("float32", (sets, 3), -1.001, 1.001),
        "contour_starts": Layout("int32", (sets + 1,), 0, contours),
        "point_starts": Layout("int32", (max(contours, 0) + 1,), 0, points),
        "points": Layout("float32", (points, 4), -1.001, NEAREST),
        "set_states": Layout("uint8", (sets,)),
        "corner_sets": Layout("int32", (records, 3), -1, sets - 1),
        "states": Layout("uint8", (records,), 0, 2),
        "list_starts": Layout("int32", (records + 1,), 0, lists),
        "list_contours": Layout("int32", (lists, 3), 0, contours - 1),
        "list_first": Layout("int32", (lists, 3), 0),
        "step_starts": Layout("int32", (lists + 1,), 0, steps),
        "steps": Layout("uint8", (steps,), 0, 7),
        "errors": Layout("float16", (records,), 0),
    }
    check_layout(what, arrays, layouts)
    if problem := _inconsistency(arrays):
        raise BakeError(f"{what} does not hold what it should: {problem}; bake it again")


def _inconsistency(arrays: dict[str, np.ndarray]) -> str:
    """Return in words what does not fit together in arrays of the right shapes; "" if all does."""
    ends = {"contour_starts": "point_starts", "list_starts": "step_starts"}
    for name, of in ends.items():
        if arrays[name][0] != 0 or arrays[name][-1] != len(arrays[of]) - 1 or (np.diff(arrays[name]) < 0).any():
            return f"its array {name!r} does not rise from 0 to {len(arrays[of]) - 1}"
    sizes = np.diff(arrays["point_starts"])
    for name, of, least in (("point_starts", "points", 1), ("step_starts", "steps", 0)):
        starts = arrays[name]
        if starts[0] != 0 or starts[-1] != len(arrays[of]) or (np.diff(starts) < least).any():
            return f"its array {name!r} does not rise from 0 to {len(arrays[of])}"
    if (np.abs(arrays["points"][:, :3]) > 1.001).any():
        return "its array 'points' has directions that are no unit vectors"
    if (arrays["list_first"] >= sizes[arrays["list_contours"]]).any():
        return "its array 'list_first' leads past ends of contours"
    matched = arrays["states"] == 1
    return "its matched triangles have corners without polygons" if (arrays["corner_sets"][matched] < 0).any() else ""
