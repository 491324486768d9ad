"""Visibility fields of some cells each, as one field of all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from warp_gi.baking import Bake
from warp_gi.errors import BakeError
from warp_gi.layout import Layout, check_layout
from warp_gi.techniques.visibility_field.bake import words_of

_COUNTS = ("samples", "rays", "rays_traced", "cells", "seconds")
_GRID = ("grid_low", "grid_shape", "grid_cell_size")


def merged(shards: Sequence[Bake]) -> Bake:
    """Return the bake of the cells of all shards, which rise as in a bake of all. Raises BakeError for damaged ones."""
    for one in shards:
        _check(one, shards[0])
    cells, flags, masks, empty = (
        np.concatenate([one.arrays[name] for one in shards]) for name in ("cells", "flags", "masks", "empty_cells")
    )
    every = np.concatenate([cells, empty])
    if len(np.unique(every)) != len(every):
        raise BakeError(f"shards of the field in {shards[0].scene_name!r} have cells in common; bake them again")
    order = np.argsort(cells)
    arrays = {"cells": cells[order], "flags": flags[order], "masks": masks[order], "empty_cells": np.sort(empty)}
    arrays |= {name: shards[0].arrays[name] for name in _GRID}
    arrays = {name: arrays[name] for name in shards[0].arrays if name in arrays}
    counts = {name: sum(one.counts.get(name, 0) for one in shards) for name in _COUNTS}
    return replace(shards[0], arrays=arrays, counts=counts | {"seconds": round(counts["seconds"], 3)})


def _check(shard: Bake, first: Bake) -> None:
    """Raise BakeError for arrays that are not those of a field on the grid of the first shard."""
    arrays, count = shard.arrays, np.shape(shard.arrays.get("cells", ()))[:1] or (0,)
    words = words_of(int(shard.settings.get("resolution", 0)))
    layouts = {
        "cells": Layout("int32", count, 0),
        "flags": Layout("int32", count, 0),
        "masks": Layout("uint32", (*count, words)),
        "empty_cells": Layout("int32", (None,), 0),
        "grid_low": Layout("float64", (3,)),
        "grid_shape": Layout("int32", (3,), 1),
        "grid_cell_size": Layout("float64", (1,), 0),
    }
    check_layout(f"a shard of the field in {shard.scene_name!r}", arrays, layouts)
    if any(not np.array_equal(arrays[name], first.arrays[name]) for name in _GRID):
        raise BakeError(f"shards of the field in {shard.scene_name!r} have other grids; bake them again")
