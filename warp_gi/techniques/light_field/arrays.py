"""What the arrays of a bake of probes have to be."""

from __future__ import annotations

import numpy as np

from warp_gi.baking import Bake
from warp_gi.errors import BakeError
from warp_gi.layout import Layout, check_layout
from warp_gi.techniques.light_field.settings import ProbeSettings, map_resolution
from warp_gi.techniques.shared.views import ROW, known_rows


def check_arrays(bake: Bake, settings: ProbeSettings) -> None:
    """Raise BakeError unless a bake's arrays fit together and to the settings, and no index leads out of them."""
    what, arrays = f"this bake of probes in {bake.scene_name!r}", bake.arrays
    places = {
        "grid_counts": Layout("int32", (3,), 1, 1 << 20),
        "grid_low": Layout("float32 float64", (3,)),
        "grid_spacing": Layout("float32 float64", (3,), 1e-30, 1e30),
        "bounds": Layout("float32 float64", (2, 3)),
        "sky": Layout("uint8", (32,)),
        "cameras": Layout("float32", (None, ROW)),
    }
    if np.ndim(arrays.get("cameras", 0)) == 2:
        arrays = arrays | {"cameras": known_rows(arrays["cameras"])}
    check_layout(what, arrays, places)
    asked, there = settings.counts, arrays["grid_counts"].tolist()
    if any(number not in (0, grid) for number, grid in zip(asked, there, strict=True)):
        raise BakeError(f"{what} says {asked} probes and holds a grid of {there}; bake it again")
    count = int(np.prod(arrays["grid_counts"].astype(np.int64)))
    texels, few = count * map_resolution(settings.resolution, count) ** 2, count * settings.irradiance_resolution**2
    maps = {
        "positions": Layout("float32", (count, 3)),
        "states": Layout("int32", (count,), 0, 1),
        "radiance": Layout("uint32", (texels,)),
        "surfels": Layout("uint32", (texels,)),
        "irradiance": Layout("float32", (few, 3)),
        "moments": Layout("float32", (few, 2)),
        "emission_texels": Layout("int32", (None,), 0, max(texels - 1, 0)),
        "emission": Layout("uint32", np.shape(arrays.get("emission_texels", 0))),
    }
    check_layout(what, arrays, maps | ({"offset": Layout("float64", (3,))} if "offset" in arrays else {}))
    if (np.diff(arrays["emission_texels"]) <= 0).any():
        raise BakeError(f"{what} does not hold what it should: its lit texels are not in order; bake it again")
