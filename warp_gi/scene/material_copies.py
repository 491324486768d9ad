"""Whether materials are still like their copies: in the tables of a device, or in another object."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np

from warp_gi.scene import textures
from warp_gi.scene.model import Material

if TYPE_CHECKING:
    from warp_gi.kernels import types


FLAGS = ("alpha_cutoff", "alpha_blend", "double_sided", "colors_emit")
"""Fields of materials that are neither numbers nor textures."""


def row_edits(material: Material, data: types.SceneData, row: int, hint: str) -> Iterator[str]:
    """Yield the fields in which a material differs from its row in the tables of a device; ``hint`` if it is none.

    ``hint`` is the field that may be another. Texels are compared unless it is a number.
    """
    try:
        textures.check_material(material)
    except (ValueError, TypeError, AttributeError):
        yield hint
        return
    images = textures.distinct_textures([material])
    new, old = textures.material_table([material], images)[0], data.materials.numpy()[row]
    for field in new.dtype.names or ():
        if field not in textures.TEXTURE_SLOTS:
            if not np.array_equal(new[field], old[field]):
                yield field
        elif (new[field] < 0) != (old[field] < 0):
            yield field
        elif new[field] >= 0 and hint not in (*textures.NUMBERS, *FLAGS):
            entry, image = data.textures.numpy()[old[field]], images[new[field]]
            table, texels = textures.texture_table([image])
            first, *others = table.dtype.names or ()
            start = int(entry[first])
            is_same = all(np.array_equal(entry[name], table[0][name]) for name in others)
            if not is_same or not np.array_equal(data.texels.numpy()[start : start + len(texels)], texels):
                yield f"{field} {image.name!r}"


def passes_rays(data: types.SceneData, row: int) -> bool:
    """Return whether a material lets rays pass by its row in the tables of a device."""
    old = data.materials.numpy()[row]
    return bool(old["alpha_cutoff"] >= 0.0 or old["alpha_blend"] or old["transmission"] > 0.0)


def alike(a: Material, b: Material) -> bool:
    """Return whether two materials look the same."""
    if a is b or not (isinstance(a, Material) and isinstance(b, Material)):
        return a is b
    images = [textures.distinct_textures([material]) for material in (a, b)]
    tables = [textures.material_table([material], own) for material, own in zip((a, b), images, strict=True)]
    return tables[0].tobytes() == tables[1].tobytes() and all(
        x is y or ((x.srgb, x.wrap) == (y.srgb, y.wrap) and np.array_equal(x.pixels, y.pixels))
        for x, y in zip(*images, strict=True)
    )
