"""Triangles that let rays pass: with holes, blended, or of glass; and the textures that say where."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import warp as wp

from warp_gi.bvh import AlphaMasks
from warp_gi.color import LUMINANCE
from warp_gi.scene.geometry import FlatGeometry
from warp_gi.scene.model import Material, Texture
from warp_gi.scene.textures import box_means, linear_rgb, texture_coordinates


def alpha_masks(
    flat: FlatGeometry,
    materials: Sequence[Material],
    images: Sequence[Texture],
    textures: wp.array,
    texels: wp.array,
    tints: Mapping[int, Texture],
) -> AlphaMasks | None:
    """Return the masks of the scene's materials, None if all triangles are opaque.

    ``textures`` and ``texels`` hold ``images`` on the tree's device. A triangle of a masked or blended
    material over which no texel falls below the cutoff, or below 1, counts as opaque, which costs rays nothing.
    ``tints`` are those of ``glass_tints``, which are among the images.
    """
    index_of = {id(image): index for index, image in enumerate(images)}
    face_mask = np.full(len(flat.indices), -1, np.int32)
    masks: list[tuple[int, float, float | None]] = []
    glass: dict[int, tuple[float, int, float, float]] = {}
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
            cut = np.arange(256) * (material.alpha * thinnest / 255.0) < whole
            uvs = flat.uvs[flat.indices[triangles]]
            boxes = uvs.min(axis=1), uvs.max(axis=1)
            holed = triangles[box_means(texture.pixels[..., 3:], texture.wrap, *boxes, cut)[:, 0] > 0.0]
        if material.is_glass:
            holed = triangles
            tint = tints.get(index)
            share = _brightest(material) * material.transmission * (1.0 - material.mean_metallic)
            glass[len(masks)] = share, -1 if tint is None else index_of[id(tint)], *_reflectance(material)
        if len(holed):
            face_mask[holed] = len(masks)
            by_alpha = material.alpha_blend or material.alpha_cutoff is not None
            coverage = texture if by_alpha else None
            factor, cutoff = (material.alpha, material.alpha_cutoff) if by_alpha else (1.0, 0.0)
            masks.append((-1 if coverage is None else index_of[id(coverage)], factor, cutoff))
    uvs = _mask_uvs(flat, materials)
    return AlphaMasks(face_mask, masks, uvs, textures, texels, alphas, glass) if masks else None


def _mask_uvs(flat: FlatGeometry, materials: Sequence[Material]) -> np.ndarray:
    """Return where masks and tints are looked up, float32 [vertex, 2]: at the base colour's coordinates.

    Glass without a texture of its colour is looked up where its transmission is. Its vertices are nobody else's.
    """
    uvs = flat.uvs
    for index, material in enumerate(materials):
        share = material.transmission_texture
        if share is None or not material.is_glass or material.base_color_texture is not None:
            continue
        if share.uv_set or share.transform is not None:
            ids = np.unique(flat.indices[flat.materials == index])
            uvs = uvs.copy() if uvs is flat.uvs else uvs
            uvs[ids] = texture_coordinates(share, flat.uvs[ids], _of(flat.further_uvs, ids))
    return uvs


def _of(values: np.ndarray | None, ids: np.ndarray) -> np.ndarray | None:
    return None if values is None else values[ids]


def glass_tints(materials: Sequence[Material]) -> dict[int, Texture]:
    """Return, by the material's index, what textures leave of the light that goes through glass.

    It is the alpha of a texture at the base colour's coordinates, as large as the larger of the two that it is made of:
    the luminance of the base colour over that of its factor, times the transmission. Without a texture of the colour it
    is that of the transmission, at its own coordinates.
    """
    found = {}
    for index, material in enumerate(materials):
        base, share = material.base_color_texture, material.transmission_texture
        used = [one for one in (base, share) if one is not None]
        if not material.is_glass or not used:
            continue
        height, width = (max(one.pixels.shape[axis] for one in used) for axis in (0, 1))
        left = np.ones((height, width))
        if base is not None:
            colors = linear_rgb(base).astype(np.float64) * np.asarray(material.base_color)
            left = _resampled(colors @ LUMINANCE / max(_brightest(material), 1e-12), base, height, width)
        if share is not None:
            place = share if base is not None else replace(share, transform=None)
            left = left * _resampled(share.pixels[..., 0] / 255.0, place, height, width)
        pixels = np.zeros((height, width, 4), np.uint8)
        pixels[..., 3] = np.round(255.0 * np.clip(left, 0.0, 1.0))
        nearest = any(one.nearest for one in used)
        found[index] = Texture(f"tint of {material.name}", pixels, False, used[0].wrap, nearest)
    return found


def _resampled(values: np.ndarray, texture: Texture, height: int, width: int) -> np.ndarray:
    """Return ``values`` of the texels of ``texture`` that are nearest to those of another size, [height, width]."""
    u, v = np.meshgrid((np.arange(width) + 0.5) / width, 1.0 - (np.arange(height) + 0.5) / height)
    uvs = texture_coordinates(replace(texture, uv_set=0), np.stack([u, v], axis=-1), None)
    rows, columns = values.shape
    row = np.floor((1.0 - uvs[..., 1]) % 1.0 * rows).astype(int).clip(0, rows - 1)
    return values[row, np.floor(uvs[..., 0] % 1.0 * columns).astype(int).clip(0, columns - 1)]


def _brightest(material: Material) -> float:
    """Return the luminance of the base colour, without its texture."""
    return float(np.asarray(material.base_color, np.float64) @ LUMINANCE)


def _reflectance(material: Material) -> tuple[float, float]:
    """Return the reflectance at normal incidence and at grazing angles, as make_coated_bsdf of kernels/bsdf.py."""
    dielectric, metallic = 1.0 - material.mean_metallic, material.mean_metallic
    f0 = float(np.minimum(material.reflectance, 1.0) @ LUMINANCE) * material.specular * dielectric
    return f0 + _brightest(material) * metallic, material.specular * dielectric + metallic
