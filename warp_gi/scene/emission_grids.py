"""Grids over emissive triangles, by which points on them are sampled as their texture shines there.

``warp_gi.kernels.emission_grids`` says what a grid is, and samples it. A grid costs memory and a look-up for each
sample, so only triangles get one that hold several texels of differing emission.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warp_gi.alias import AliasTable
from warp_gi.color import LUMINANCE, SRGB_TO_LINEAR
from warp_gi.kernels import types
from warp_gi.scene.emitters import emitting_areas
from warp_gi.scene.geometry import FlatGeometry
from warp_gi.scene.model import Material, Texture
from warp_gi.scene.textures import box_means, texture_coordinates

LEAST_TEXELS = 1.5
"""Texels along the second longest side of a triangle below which it gets no grid."""
LEAST_SPREAD = 1.1
"""Mean square of the emission over the square of its mean below which points are sampled evenly: 1 is even."""
MOST_SIDE = 256
"""Largest number of cells along a side of a triangle."""
MOST_CELLS = 1 << 19
"""Largest number of cells of all grids of a scene together; a cell takes 32 bytes on each device."""
MOST_GRIDS = 4096
"""Largest number of triangles with a grid; those of most power get one."""
BATCH = 1 << 15
"""Cells that are looked at at once, which bounds the memory of building."""
FLOOR = 0.002
"""Part of the mean emission around a cell that its density has at least, whatever the points in it show."""
DARK_POWER = 1e-6
"""Power of a triangle that shines nowhere, over that by the texels around it: emitters have a power above zero."""

_INSET = 0.002
_CORNERS = (_INSET, _INSET), (1 - 2 * _INSET, _INSET), (_INSET, 1 - 2 * _INSET)
_MIDDLES = (0.5 - _INSET, _INSET), (_INSET, 0.5 - _INSET), (0.5 - _INSET, 0.5 - _INSET)
_INNER = (1 / 3, 1 / 3), (1 / 6, 1 / 6), (2 / 3, 1 / 6), (1 / 6, 2 / 3)
_POINTS = np.array([*_CORNERS, *_MIDDLES, *_INNER])
"""Points of a cell at which the emission is looked up, barycentric [point, 2]."""
_SHARES = np.array([1 / 36] * 3 + [1 / 12] * 3 + [1 / 6] * 4)
"""Share of each point in the mean over the cell, [point]."""


@dataclass(frozen=True, eq=False)
class EmissionGrids:
    """How points are sampled on the emissive triangles of a scene, on the host; empty where all are sampled evenly."""

    table: np.ndarray
    """Grids, types.EmissionGrid [emissive triangle]; or [0], where no triangle has one."""
    cells: np.ndarray
    """Alias tables, types.AliasBucket [cell]."""
    densities: np.ndarray
    """Densities over that of uniform points, float32 [cell, 4]: at the three corners, and what is added to all."""
    powers: np.ndarray
    """Powers of the emissive triangles, W as luminance, float64 [emissive triangle]."""

    def lit_corners(self, corners: np.ndarray) -> np.ndarray:
        """Return triangles that hold what shines of triangles with these ``corners``, [emissive triangle, 3, 3]."""
        if len(self.table) == 0:
            return corners
        lit = self.table["lit"].astype(np.float64)
        first, sides = corners[:, :1], corners[:, 1:] - corners[:, :1]
        start = first + np.einsum("ns,nsx->nx", lit[:, :2], sides)[:, None]
        size = (lit[:, 2] - lit[:, 0] - lit[:, 1])[:, None, None]
        return np.concatenate([start, start + sides * size], axis=1)


class LightGrids:
    """The grids of a scene, built when they are first asked for."""

    def __init__(
        self, flat: FlatGeometry, materials: Sequence[Material], triangles: np.ndarray, powers: np.ndarray
    ) -> None:
        self._inputs = flat, materials, triangles, powers
        self._grids: EmissionGrids | None = None

    def get(self) -> EmissionGrids:
        """Return the grids."""
        if self._grids is None:
            self._grids = emission_grids(*self._inputs)
        return self._grids

    def forget(self) -> None:
        """Build them anew when they are asked for again: materials may be edited until they are on a device."""
        self._grids = None


def emission_grids(
    flat: FlatGeometry, materials: Sequence[Material], triangles: np.ndarray, powers: np.ndarray
) -> EmissionGrids:
    """Return grids for the emissive ``triangles`` (int64 [count]) with these powers [W], which grids know better."""
    texels = np.zeros(len(triangles))
    of_material = flat.materials[triangles]
    textured = [index for index in np.unique(of_material).tolist() if materials[index].emission_texture is not None]
    for index in textured:
        mine = np.flatnonzero(of_material == index)
        texture = _texture(materials[index])
        size = np.array(texture.pixels.shape[1::-1])
        uvs = _uvs(flat, texture, triangles[mine])
        lengths = np.linalg.norm((uvs - np.roll(uvs, 1, axis=1)) * size, axis=2)
        texels[mine] = np.sort(lengths, axis=1)[:, 1]
    sides = _affordable_sides(texels, powers)
    powers, found = powers.copy(), {}
    for index in textured:
        mine = np.flatnonzero((of_material == index) & (sides > 0))
        per_cell = texels[mine] / sides[mine]
        steps = np.maximum(np.floor(np.log2(np.maximum(per_cell, 1.0))).astype(np.int64) - 1, 0)
        for step in np.unique(steps).tolist():
            some = mine[steps == step]
            for emitter, grid in zip(
                some, _grids(flat, materials[index], triangles[some], sides[some], 1 << step), strict=True
            ):
                powers[emitter] = grid.power if grid.power > 0.0 else DARK_POWER * powers[emitter]
                if len(grid.densities):
                    found[int(emitter)] = grid
    return _packed(len(triangles), found, powers)


def _affordable_sides(texels: np.ndarray, powers: np.ndarray) -> np.ndarray:
    """Return cells along the sides of triangles with so many ``texels`` along theirs, int64 [count]; 0: no grid.

    Four or two cells for a texel, or else an equal number of texels for each cell: cells do not straddle texels.
    """
    wants = np.flatnonzero(texels > LEAST_TEXELS)
    wants = wants[np.argsort(-powers[wants], kind="stable")[:MOST_GRIDS]]
    sides = np.zeros(len(texels), np.int64)
    most = MOST_SIDE
    while len(wants):
        along = texels[wants]
        coarse = np.ceil(along / np.maximum(np.ceil(along / most - 1e-4), 1.0) - 1e-4)
        for finer in (2.0, 4.0):
            coarse = np.where(finer * along <= most, np.ceil(finer * along - 1e-3), coarse)
        sides[wants] = coarse
        if (sides**2).sum() <= MOST_CELLS:
            break
        most //= 2
    return sides


@dataclass
class _Grid:
    side: int
    densities: np.ndarray  # [cell, 4], or [0, 4] where points are sampled evenly
    buckets: np.ndarray
    lit: np.ndarray
    power: float


def _grids(flat: FlatGeometry, material: Material, triangles: np.ndarray, sides: np.ndarray, step: int) -> list[_Grid]:
    """Return the grids of triangles of one material, whose texture is looked at in blocks of ``step`` texels."""
    texture = _texture(material)
    weights = np.asarray(material.emission, np.float64) * LUMINANCE
    colors = flat.colors[flat.indices[triangles], :3] if material.colors_emit and flat.colors is not None else None
    image = _reduced(texture, weights if colors is None else None, step)
    uvs = _uvs(flat, texture, triangles)
    corners = [_cell_corners(side) for side in sides.tolist()]
    boxes = [_weighted(corner, uv) for corner, uv in zip(corners, uvs, strict=True)]
    low, high = (np.concatenate([reduce(box, axis=1) for box in boxes]) for reduce in (np.min, np.max))
    whole = image if colors is None else image @ (weights / weights.sum())[:, None]
    around = box_means(whole, texture.wrap, low, high)[:, 0] * weights.sum()
    areas = emitting_areas(flat, triangles) * (2.0 if material.double_sided else 1.0)
    result, start = [], 0
    for number, side in enumerate(sides.tolist()):
        mine = around[start : start + side * side]
        start += side * side
        if colors is not None:
            mine = mine * _weighted(corners[number], colors[number]).max(axis=(1, 2))
        emission = _Emission(texture, image, weights, uvs[number], None if colors is None else colors[number], step)
        result.append(_grid(side, corners[number], mine, emission, float(np.pi * areas[number])))
    return result


@dataclass
class _Emission:
    """What a triangle emits."""

    texture: Texture
    image: np.ndarray
    weights: np.ndarray
    uvs: np.ndarray
    colors: np.ndarray | None
    step: int

    def at(self, points: np.ndarray) -> np.ndarray:
        """Return the luminance at barycentric points [..., 2]."""
        nearest = self.texture.nearest and self.step == 1
        texels = _lookup(self.image, self.texture.wrap, nearest, _weighted(points, self.uvs))
        if self.colors is None:
            return texels[..., 0] * self.weights.sum()
        return (texels * _weighted(points, self.colors)) @ self.weights


def _grid(side: int, corners: np.ndarray, around: np.ndarray, emission: _Emission, area: float) -> _Grid:
    """Return the grid of a triangle; ``around`` is the mean emission around each cell, zero only where it is dark."""
    lit = np.flatnonzero(around > 0.0)
    parts, square = np.zeros((side * side, 4)), 0.0
    for begin in range(0, len(lit), BATCH):
        some = lit[begin : begin + BATCH]
        first, edges = corners[some, :1], corners[some, 1:] - corners[some, :1]
        found = emission.at(first + np.einsum("ps,nsx->npx", _POINTS, edges))
        mean = found @ _SHARES
        square += float((found**2 @ _SHARES).sum())
        rise = found[:, :3] * np.minimum(mean / np.maximum(found[:, :3].mean(axis=1), 1e-30), 1.0)[:, None]
        linear = rise @ np.concatenate([1 - _POINTS.sum(axis=1, keepdims=True), _POINTS], axis=1).T
        beyond = np.maximum(found - linear, 0.0) @ _SHARES
        parts[some, :3] = rise
        parts[some, 3] = np.maximum(mean - rise.mean(axis=1), 0.5 * beyond) + FLOOR * around[some]
    masses = parts[:, :3].mean(axis=1) + parts[:, 3]
    mean = float(masses.mean())
    power = mean * area
    if mean <= 0.0 or square / (side * side) < LEAST_SPREAD * mean**2:
        return _Grid(0, np.zeros((0, 4)), np.zeros(0), np.array([0.0, 0.0, 1.0]), power)
    table = AliasTable.build(masses)
    densities = parts * (table.pdf.astype(np.float64) / np.maximum(masses, 1e-300))[:, None] * (side * side)
    held = corners[lit]
    extent = np.array([held[..., 0].min(), held[..., 1].min(), min(held.sum(axis=2).max(), 1.0)])
    return _Grid(side, densities, table.buckets(), extent, power)


def _packed(count: int, grids: dict[int, _Grid], powers: np.ndarray) -> EmissionGrids:
    """Return the grids, by emitter, as kernels read them."""
    bucket = types.AliasBucket.numpy_dtype()
    if not grids:
        none = np.zeros(0, types.EmissionGrid.numpy_dtype())
        return EmissionGrids(none, np.zeros(0, bucket), np.zeros((0, 4), np.float32), powers)
    table = np.zeros(count, types.EmissionGrid.numpy_dtype())
    table["lit"] = (0.0, 0.0, 1.0)
    start = 0
    for emitter, grid in grids.items():
        table[emitter] = (start, grid.side, grid.lit)
        start += grid.side**2
    cells = np.concatenate([grid.buckets for grid in grids.values()])
    densities = np.concatenate([grid.densities for grid in grids.values()]).astype(np.float32)
    return EmissionGrids(table, cells, densities, powers)


def _texture(material: Material) -> Texture:
    assert material.emission_texture is not None
    return material.emission_texture


def _uvs(flat: FlatGeometry, texture: Texture, triangles: np.ndarray) -> np.ndarray:
    """Return where a texture is looked up at the corners of triangles, float64 [triangle, 3, 2]."""
    ids = flat.indices[triangles]
    further = None if flat.further_uvs is None else flat.further_uvs[ids]
    return np.asarray(texture_coordinates(texture, flat.uvs[ids], further), np.float64)


def _weighted(points: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return what ``values`` [3, x] at the corners of a triangle are at barycentric points [..., 2]."""
    return values[0] + points @ (values[1:] - values[0])


def _cell_corners(side: int) -> np.ndarray:
    """Return the corners of all cells, barycentric, float64 [cell, 3, 2], in the order of the kernels."""
    j, i = np.divmod(np.arange(side * side), side)
    upside_down = i + j >= side
    first = np.stack([np.where(upside_down, side - i, i), np.where(upside_down, side - j, j)], axis=1)
    step = np.where(upside_down, -1, 1)[:, None, None] * np.array([[0, 0], [1, 0], [0, 1]])
    return (first[:, None] + step) / side


def _reduced(texture: Texture, weights: np.ndarray | None, step: int) -> np.ndarray:
    """Return means of blocks of ``step`` squared texels, linear, float64 [row, column, channel], row 0 at the top.

    Three channels from 0 to 1; or one, their mean by ``weights``. Rows are read some at a time: the whole image in
    floating point would take six times its memory.
    """
    pixels = texture.pixels
    height, width = pixels.shape[:2]
    rows, columns = (
        np.arange(max(round(size / step), 1)) * size // max(round(size / step), 1) for size in (height, width)
    )
    ends, column_counts = np.append(rows[1:], height), np.diff(np.append(columns, width))
    shades = SRGB_TO_LINEAR.astype(np.float64) if texture.srgb else np.arange(256) / 255.0
    result = np.empty((len(rows), len(columns), 3 if weights is None else 1))
    for row, (begin, end) in enumerate(zip(rows.tolist(), ends.tolist(), strict=True)):
        band = shades[pixels[begin:end, :, :3]]
        if weights is not None:
            band = (band @ (weights / weights.sum()))[..., None]
        result[row] = np.add.reduceat(band.mean(axis=0), columns, axis=0) / column_counts[:, None]
    return np.minimum(result, 1.0)


def _lookup(image: np.ndarray, wrap: tuple[str, str], nearest: bool, uvs: np.ndarray) -> np.ndarray:
    """Return look-ups at ``uvs`` [..., 2] as ``warp_gi.kernels.surface.texture_lookup`` makes them, [..., channel]."""
    places, shares = [], []
    for axis, mode in enumerate(wrap):
        size, u = image.shape[1 - axis], uvs[..., axis]
        folded = {"repeat": u - np.floor(u), "clamp": np.clip(u, 0.0, 1.0)}.get(mode)
        if folded is None:
            folded = np.abs(u - 2.0 * np.floor(0.5 * u + 0.5))
        x = folded * size - 0.5
        x = np.floor(x + 0.5) if nearest else x
        i = np.floor(x).astype(np.int64)
        both = np.stack([i, i + 1])
        places.append(both % size if mode == "repeat" else np.clip(both, 0, size - 1))
        shares.append((x - i)[..., None])
    columns, rows = places[0], image.shape[0] - 1 - places[1]
    bottom, top = (image[row, columns[0]] * (1 - shares[0]) + image[row, columns[1]] * shares[0] for row in rows)
    return bottom * (1 - shares[1]) + top * shares[1]
