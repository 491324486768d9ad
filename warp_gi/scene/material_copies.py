"""Whether materials are still like their copies: in the tables of a device, or in another object."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from warp_gi.scene import textures
from warp_gi.scene.model import Material

if TYPE_CHECKING:
    from warp_gi.kernels import types


def row_edit(material: Material, data: types.SceneData, row: int, hint: str) -> str | None:
    """Return the first field in which a material differs from its row in the tables of a device, or ``hint``."""
    try:
        textures.check_material(material)
    except (ValueError, TypeError, AttributeError):
        return hint
    images = textures.distinct_textures([material])
    new, old = textures.material_table([material], images)[0], data.materials.numpy()[row]
    for field in new.dtype.names or ():
        if field not in textures.TEXTURE_SLOTS:
            if not np.array_equal(new[field], old[field]):
                return field
        elif (new[field] < 0) != (old[field] < 0):
            return field
        elif new[field] >= 0:
            entry, image = data.textures.numpy()[old[field]], images[new[field]]
            table, texels = textures.texture_table([image])
            first, *others = table.dtype.names or ()
            start = int(entry[first])
            is_same = all(np.array_equal(entry[name], table[0][name]) for name in others)
            if not is_same or not np.array_equal(data.texels.numpy()[start : start + len(texels)], texels):
                return f"{field} {image.name!r}"
    return None


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
