"""The G-buffer of an atlas: which face lies nearest to each texel of its pages, and where on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.kernels import atlas_texels as kernels
from warp_gi.launch import on_device

TILE = int(kernels.TILE)


@dataclass(frozen=True, eq=False)
class CoveredTexels:
    """The texels that bilinear fetches touch, tile by tile."""

    texels: np.ndarray
    """Numbers of texels, counted over all pages, int32 [n]."""
    faces: np.ndarray
    """Face nearest to each, int32 [n]."""
    points: np.ndarray
    """Barycentric coordinates u, v of the point of the face that is nearest, float32 [n, 2]."""


def covered_texels(corners: np.ndarray, face_pages: np.ndarray, pages: np.ndarray, device: wp.Device) -> CoveredTexels:
    """Return the texels less than one texel along each axis from a face; arguments are those of an ``Atlas``.

    Of faces equally near a texel has the lowest. The result is the same, to the bit, on any number of threads.
    """
    tile_pages, tile_starts, faces = _binned(corners, face_pages, pages)
    used = np.flatnonzero(np.diff(tile_starts))
    starts = np.append(tile_starts[used], tile_starts[-1]).astype(np.int32)
    tiles = kernels.AtlasTiles()
    tiles.pages = on_device(np.ascontiguousarray(tile_pages[used, :4]), wp.vec4i, device)
    tiles.starts = on_device(starts, wp.int32, device)
    tiles.faces = on_device(faces, wp.int32, device)
    tiles.corners = on_device(corners, wp.vec2, device)
    count = len(used) * TILE * TILE
    found = kernels.AtlasTexels()
    found.faces = wp.empty(count, dtype=wp.int32, device=device)
    found.points = wp.empty(count, dtype=wp.vec2, device=device)
    launch.launch(kernels.find_texel_faces, count, [tiles, found], device)
    nearest, points = found.faces.numpy(), found.points.numpy()
    items = np.flatnonzero(nearest >= 0)
    page = tile_pages[used[items // (TILE * TILE)]]
    place = items % (TILE * TILE)
    texels = page[:, 4] + (page[:, 3] + place // TILE) * page[:, 0] + page[:, 2] + place % TILE
    return CoveredTexels(texels.astype(np.int32), nearest[items], points[items])


def _binned(
    corners: np.ndarray, face_pages: np.ndarray, pages: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the tiles of all pages, int32 [tile, 5], the first entry of each in the last array, and the faces in them.

    A tile is the page's width and height, its first texel there and the page's first texel.
    """
    columns, rows = -(-pages[:, 1] // TILE), -(-pages[:, 2] // TILE)
    first_tiles = np.append(0, np.cumsum(columns * rows))
    tiles = []
    for (first, width, height), nx, ny in zip(pages, columns, rows, strict=True):
        y, x = (axis.reshape(-1) * TILE for axis in np.indices((ny, nx)))
        full = np.ones_like(x)
        tiles.append(np.stack([full * width, full * height, x, y, full * first], axis=1))
    tile_pages = np.concatenate([np.zeros((0, 5), np.int64), *tiles]).astype(np.int32)
    faces = np.flatnonzero(face_pages >= 0)
    page = face_pages[faces]
    box = corners[faces].astype(np.float64)
    last = np.stack([columns, rows], axis=1)[page] - 1
    low = np.clip(np.floor(box.min(axis=1) - 0.5).astype(np.int64) // TILE, 0, last)
    high = np.clip(np.floor(box.max(axis=1) + 0.5).astype(np.int64) // TILE, 0, last)
    size = high - low + 1
    counts = size.prod(axis=1)
    which = np.repeat(np.arange(len(faces)), counts)
    rank = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
    x, y = low[which, 0] + rank % size[which, 0], low[which, 1] + rank // size[which, 0]
    tile = first_tiles[page[which]] + y * columns[page[which]] + x
    order = np.argsort(tile, kind="stable")
    starts = np.searchsorted(tile[order], np.arange(len(tile_pages) + 1))
    return tile_pages, starts, faces[which[order]].astype(np.int32)
