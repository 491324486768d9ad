"""Triangles with holes, and the textures that cut them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from warp_gi.bvh import AlphaMasks
from warp_gi.scene.geometry import FlatGeometry
from warp_gi.scene.model import Material, Texture
from warp_gi.scene.textures import box_means


def alpha_masks(
    flat: FlatGeometry, materials: Sequence[Material], images: Sequence[Texture], textures: wp.array, texels: wp.array
) -> AlphaMasks | None:
    """Return the masks of the scene's materials, None if all triangles are opaque.

    ``textures`` and ``texels`` hold ``images`` on the tree's device. A triangle of a masked or blended
    material over which no texel falls below the cutoff, or below 1, counts as opaque, which costs rays nothing.
    """
    index_of = {id(image): index for index, image in enumerate(images)}
    face_mask = np.full(len(flat.indices), -1, np.int32)
    masks: list[tuple[int, float, float | None]] = []
    alphas = None if flat.colors is None else np.ascontiguousarray(flat.colors[:, 3])
    for index, material in enumerate(materials):
        if not material.lets_rays_pass:
            continue
        whole = 1.0 if material.alpha_cutoff is None else material.alpha_cutoff
        triangles = np.flatnonzero(flat.materials == index)
        texture = material.base_color_texture
        thinnest = 1.0  # coverage of the thinnest vertex; triangles with no hole for this reason are just slower
        if alphas is not None and len(triangles):
            thinnest = float(alphas[flat.indices[triangles]].min())
        if texture is None:
            holed = triangles if material.alpha * thinnest < whole else triangles[:0]
        else:
            cut = texture.pixels[..., 3:] * (material.alpha * thinnest / 255.0) < whole
            uvs = flat.uvs[flat.indices[triangles]]
            holed = triangles[box_means(cut, texture.wrap, uvs.min(axis=1), uvs.max(axis=1))[:, 0] > 0.0]
        if len(holed):
            face_mask[holed] = len(masks)
            masks.append((-1 if texture is None else index_of[id(texture)], material.alpha, material.alpha_cutoff))
    return AlphaMasks(face_mask, masks, flat.uvs, textures, texels, alphas) if masks else None
