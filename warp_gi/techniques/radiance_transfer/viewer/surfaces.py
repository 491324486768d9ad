"""Triangles of a scene as a page draws them: vertices parted at seams of the atlas, in groups of one material."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from warp_gi.scene.model import Material, Texture
from warp_gi.scene.scene import Scene
from warp_gi.techniques.radiance_transfer.viewer.pages import faces_kept
from warp_gi.techniques.shared.atlas.atlas import Atlas

BLEND_CUTOFF = 0.5
"""Alpha below which the page leaves holes in blended surfaces."""
IMAGE_QUALITY = 88
"""Quality of embedded images, of 100; alpha is kept as it is."""
SMALLEST_IMAGE = 64
"""Images are not made smaller than this [pixels], and those of less are kept without loss."""


@dataclass(frozen=True, eq=False)
class Surfaces:
    """Triangles of both sides on which light is kept."""

    positions: np.ndarray
    """Vertices in metres, float32 [n, 3]."""
    places: np.ndarray
    """Their places in texels of a page, float32 [n, 2]."""
    uvs: np.ndarray
    """Texture coordinates, v up, float32 [n, 2]."""
    triangles: np.ndarray
    """Vertices of triangles, uint32 [m, 3], ordered by group."""
    groups: list[dict[str, Any]]
    """Page, side, material, first triangle and number of triangles of each group."""
    left_out: int
    """Triangles of which nothing is kept on either side."""


def surfaces_of(scene: Scene, atlas: Atlas) -> Surfaces:
    """Return the triangles at time 0."""
    flat = scene._flat
    sides = [faces_kept(atlas, side) for side in range(2)]
    faces = np.flatnonzero(sides[0] | sides[1])
    corners = np.ascontiguousarray(atlas.corners[faces].reshape(-1, 2), np.float32)
    page_of = np.repeat(atlas.face_pages[faces], 3)
    keys = np.column_stack([flat.indices[faces].reshape(-1), corners.view(np.int32), page_of])
    unique, vertices = np.unique(keys, axis=0, return_inverse=True)
    place = np.full(len(sides[0]), -1, np.int64)
    place[faces] = np.arange(len(faces))
    vertices = vertices.reshape(-1, 3).astype(np.uint32)
    parts: list[np.ndarray] = []
    groups: list[dict[str, Any]] = []
    for page in range(len(atlas.pages)):
        for side in range(2):
            here = np.flatnonzero(sides[side] & (atlas.face_pages == page))
            for material in np.unique(flat.materials[here]):
                chosen = here[flat.materials[here] == material]
                first = sum(map(len, parts))
                groups.append(
                    {"page": page, "side": side, "material": int(material), "first": first, "count": len(chosen)}
                )
                parts.append(vertices[place[chosen]])
    return Surfaces(
        positions=flat.points[unique[:, 0]],
        places=np.ascontiguousarray(unique[:, 1:3].astype(np.int32)).view(np.float32),
        uvs=flat.uvs[unique[:, 0]],
        triangles=np.concatenate(parts) if parts else np.zeros((0, 3), np.uint32),
        groups=groups,
        left_out=len(flat.indices) - len(faces),
    )


def material_record(material: Material, images: Sequence[Texture]) -> dict[str, Any]:
    """Return how a material is drawn: matt, of its base colour. ``images`` are those of the page."""

    def number(texture: Texture | None) -> int:
        return -1 if texture is None else next(k for k, one in enumerate(images) if one is texture)

    return {
        "color": list(material.base_color),
        "image": number(material.base_color_texture),
        "alpha": material.alpha,
        "cutoff": BLEND_CUTOFF if material.alpha_blend else material.alpha_cutoff or -1.0,
        "emission": list(material.emission),
        "emissionImage": number(material.emission_texture) if max(material.emission) > 0 else -1,
        "doubleSided": material.double_sided,
    }


def images_of(materials: Sequence[Material]) -> list[Texture]:
    """Return the textures of base colour and emission, each once."""
    found = {}
    for material in materials:
        for texture in (material.base_color_texture, material.emission_texture if max(material.emission) > 0 else None):
            if texture is not None:
                found[id(texture)] = texture
    return list(found.values())


def image_file(texture: Texture, has_alpha: bool, step: int) -> bytes:
    """Return a texture as WebP, its sides divided by ``step`` down to ``SMALLEST_IMAGE``."""
    from PIL import Image

    pixels = texture.pixels if has_alpha else texture.pixels[..., :3]
    image = Image.fromarray(np.ascontiguousarray(pixels))
    size = [max(side // step, min(side, SMALLEST_IMAGE)) for side in image.size]
    if tuple(size) != image.size:
        image = image.resize((size[0], size[1]), Image.Resampling.BOX)
    file = io.BytesIO()
    image.save(file, "WEBP", quality=IMAGE_QUALITY, lossless=max(size) <= SMALLEST_IMAGE, exact=True)
    return file.getvalue()
