"""Baking a visibility field: where the samples lie, which cells hold them, and the rounds of their rays."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.errors import OptionError
from warp_gi.kernels import types
from warp_gi.kernels import visibility_field as field_kernels
from warp_gi.kernels import visibility_field_bake as bake_kernels
from warp_gi.kernels import visibility_field_pieces as piece_kernels
from warp_gi.scene.geometry import surface_area
from warp_gi.techniques.shared.octahedral import wrapped_texels
from warp_gi.techniques.visibility_field.settings import MaskSettings

DEFAULT_CELLS = 77
"""Cells along the scene's longest axis where no cell size is given, as in the paper's Sponza (50 cm)."""
MOST_CELLS = 1 << 27
"""Largest number of cells of a grid, empty ones included; each takes four bytes."""
CHUNK_SAMPLES = 32
"""Surface samples whose rays one thread of ``bake_masks`` traces."""
ROUND_ENDS = (64, 192, 1 << 30)
"""Samples of a cell after each round. Texels that are settled by then are not traced in the next round."""
BATCH_BYTES = 1 << 24
"""Bytes of the masks of chunks that are held at a time."""
HINTS = 1 << 18
"""Entries of the table of triangles that blocked rays, which are tried first; on the CPU only."""
BAKE_SETS = 16
"""Sets of directions that surface samples draw from."""
SAMPLES_A_CELL = 256
"""Samples on one side of as much surface as a face of a cell has, where their number is not given."""
LEAST_SAMPLES, MOST_SAMPLES = 32, 8192
"""Least and largest number of samples by area in a cell."""
MOST_EDGE_SAMPLES = 64
"""Largest number of samples on the edges of one piece."""
EDGE_SPACINGS = 4.0
"""Extra samples lie this many mean sample distances apart on edges longer than that."""


@dataclass(frozen=True)
class Grid:
    """The uniform grid of a field."""

    low: np.ndarray
    """float64 [3], metres: the lowest corner."""
    cell_size: float
    """Edge of a cell, metres."""
    shape: tuple[int, int, int]
    """Cells along x, y, z."""

    @property
    def cell_count(self) -> int:
        """Cells, empty ones included."""
        return math.prod(self.shape)


def grid_of(bounds: np.ndarray, cell_size: float) -> Grid:
    """Return the grid over ``bounds`` [2, 3]; cell size 0 is a 77th of the longest axis.

    Raises OptionError for a grid that would not fit into memory.
    """
    low, high = bounds.astype(np.float64)
    size = float(cell_size) or float((high - low).max()) / DEFAULT_CELLS
    margin = 0.01 * size  # rays start a little off the outermost surfaces
    counts = _cell_counts(high - low, size)
    if not np.prod(counts) <= MOST_CELLS:
        least = max(size, float((high - low).max()) / MOST_CELLS)
        while np.prod(_cell_counts(high - low, least)) > MOST_CELLS:
            least *= 1.05
        raise OptionError(
            f"cell_size {size:g} m makes a grid of {np.prod(counts):.3g} cells over this scene, at most {MOST_CELLS:,} "
            f"are supported; use {least * 1.01:.3g} m or more"
        )
    nx, ny, nz = (int(n) for n in counts)
    return Grid(low - margin, size, (nx, ny, nz))


def _cell_counts(extent: np.ndarray, size: float) -> np.ndarray:
    """Return float64 [3]: cells along each axis; 1e100 where there are more."""
    return np.floor(np.minimum(extent, 1e100 * size) / size + 0.02) + 1


def field_query(
    device: wp.Device, set_size: int, set_count: int, seed: int, hints: int = 0
) -> field_kernels.FieldQuery:
    """Return the struct that goes with a grid into every kernel: sets of directions, room for hints, and no movers."""
    query = field_kernels.FieldQuery()
    query.mode, query.verify = field_kernels.MODE_THREE_STATE, 1.0
    query.set_size, query.set_count = set_size, set_count
    query.cosines = wp.zeros((3, set_size * set_count + 8), dtype=wp.float32, device=device)
    launch.launch(field_kernels.draw_cosines, set_size * set_count + 8, [seed & 0xFFFFFFFF, query], device)
    query.hints = wp.zeros(hints, dtype=wp.int32, device=device)
    query.boxes = wp.empty(0, dtype=wp.vec3, device=device)
    query.moving = wp.empty(0, dtype=wp.int32, device=device)
    return query


def neighbor_table(resolution: int, dilation: int) -> np.ndarray:
    """Return int32 [texel, (2 dilation + 1)^2]: the texels within ``dilation`` of each, across the map's edges."""
    offsets = np.arange(-dilation, dilation + 1)
    i, j = np.meshgrid(np.arange(resolution), np.arange(resolution))
    dx, dy = (grid.reshape(-1) for grid in np.meshgrid(offsets, offsets))
    return wrapped_texels(i.reshape(-1, 1) + dx, j.reshape(-1, 1) + dy, resolution).astype(np.int32)


def words_of(resolution: int) -> int:
    """Return the 32-bit words of a cell's masks."""
    return -(-resolution * resolution // field_kernels.TEXELS_A_WORD)


def grid_struct(
    grid: Grid, resolution: int, slots: wp.array | None, masks: wp.array | None
) -> field_kernels.VisibilityGrid:
    """Return the kernels' struct of a grid; kernels that look up no slots, or no masks, take None for them."""
    data = field_kernels.VisibilityGrid()
    data.low = wp.vec3(*grid.low)
    data.cell_size = grid.cell_size
    data.nx, data.ny, data.nz = grid.shape
    data.resolution, data.words = resolution, words_of(resolution)
    data.slots, data.masks = slots, masks
    return data


@dataclass
class Pieces:
    """Parts of surfaces in cells, sorted by cell; a piece is one side of a triangle in one cell."""

    cells: np.ndarray
    """int32 [cell]: numbers in the grid of the cells that hold pieces, rising."""
    starts: np.ndarray
    """int64 [cell + 1]: first piece of each cell, and the number of pieces."""
    sides: np.ndarray
    """int32 [piece]: 2 * triangle + side; side 1 is the back."""
    areas: np.ndarray
    """float64 [piece]: area, m^2."""
    edge_counts: np.ndarray
    """int32 [piece]: samples on the piece's edges."""


class FieldBaker:
    """Bakes masks of cells, of the scene as it stands. What a cell gets depends on nothing but the scene around it.

    Args:
        geometry: Triangles as kernels read them.
        bvh: What blocks rays.
        radius: Radius of the scene [m].
        grid: The cells.
        settings: What decides the masks; the cell size is that of ``grid``.
        device: Where kernels run.
        seed: Decides every sample and ray.
        left_out: int32 [object], 1 for objects whose surfaces are not sampled; None samples all.
        area: Area of all triangles [m^2], which decides the density; None is that of ``geometry`` as it is now.
    """

    def __init__(
        self,
        geometry: types.Geometry,
        bvh: types.Bvh,
        radius: float,
        grid: Grid,
        settings: MaskSettings,
        device: wp.Device,
        seed: int = 0,
        left_out: np.ndarray | None = None,
        area: float | None = None,
    ) -> None:
        self.geometry, self.bvh, self.grid, self.settings, self.device = geometry, bvh, grid, settings, device
        self.rays = -(-settings.rays // 8) * 8
        self.words = words_of(settings.resolution)
        self.density = self._density(area)
        """Samples a square metre of one side."""
        self._seed = seed & 0xFFFFFFFF
        self._query = field_query(device, self.rays, BAKE_SETS, seed, 0 if device.is_cuda else HINTS)
        self._neighbors = neighbor_table(settings.resolution, settings.dilation)
        self._quiet = neighbor_table(settings.resolution, settings.dilation + 1)
        search = piece_kernels.PieceSearch()
        search.low, search.cell_size = wp.vec3(*grid.low), grid.cell_size
        search.nx, search.ny, search.nz = grid.shape
        search.radius, search.spacing = radius, EDGE_SPACINGS / math.sqrt(self.density)
        search.left_out = wp.array([] if left_out is None else left_out, dtype=wp.int32, device=device)
        self._search = search
        self.rays_traced = self.rays_asked = self.samples = 0

    @property
    def counts(self) -> dict[str, int]:
        """Samples, their rays, and how many of those were traced, of all bakes so far."""
        return {"samples": self.samples, "rays": self.rays_asked, "rays_traced": self.rays_traced}

    def _density(self, area: float | None) -> float:
        if not self.settings.samples:
            return SAMPLES_A_CELL / self.grid.cell_size**2
        if area is None:
            area = surface_area(self.geometry.points.numpy(), self.geometry.indices.numpy())
        return self.settings.samples / (2.0 * area)

    def find(self, cells: np.ndarray | None = None) -> Pieces:
        """Return the surfaces in ``cells`` (numbers in the grid), or in all of them."""
        search, device = self._search, self.device
        wanted = np.zeros(self.grid.cell_count, np.uint8) if cells is not None else np.ones(self.grid.cell_count, "u1")
        if cells is not None:
            wanted[cells] = 1
        search.wanted = wp.array(wanted, dtype=wp.uint8, device=device)
        search.start = wp.empty(0, dtype=wp.int64, device=device)
        sides = 2 * len(self.geometry.indices)
        counts = wp.zeros(sides, dtype=wp.int32, device=device)
        outputs = [wp.empty(0, dtype=dtype, device=device) for dtype in (wp.int32, wp.float32, wp.int32)]
        launch.launch(piece_kernels.find_pieces, sides, [self.geometry, search, counts, *outputs], device)
        count = counts.numpy()
        starts = np.cumsum(count, dtype=np.int64) - count
        total = int(count.sum(dtype=np.int64))
        if total >= 1 << 31:
            raise OptionError(f"{total:,} pieces of surfaces in cells are too many; use larger cells")
        search.start = wp.array(starts, dtype=wp.int64, device=device)
        outputs = [wp.empty(total, dtype=dtype, device=device) for dtype in (wp.int32, wp.float32, wp.int32)]
        launch.launch(piece_kernels.find_pieces, sides, [self.geometry, search, counts, *outputs], device)
        found, areas, edge_counts = (array.numpy() for array in outputs)
        side = np.repeat(np.arange(sides, dtype=np.int32), count)
        kept = np.flatnonzero(areas > 0.0)
        order = kept[np.argsort(found[kept], kind="stable")]
        present, begins = np.unique(found[order], return_index=True)
        edge_counts = np.minimum(edge_counts[order], MOST_EDGE_SAMPLES)
        return Pieces(present, np.append(begins, len(order)), side[order], areas[order].astype(np.float64), edge_counts)

    def bake(self, pieces: Pieces, progress: Callable[[float], None] | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Return masks, uint32 [cell, words], and flags, int32 [cell] (SLOT_LABEL or 0), of ``pieces.cells``."""
        count = len(pieces.cells)
        masks, flags = np.empty((count, self.words), np.uint32), np.empty(count, np.int32)
        areas = running_sums(pieces.areas, pieces.starts)[pieces.starts[1:] - 1]
        least = 1 if self.settings.samples else LEAST_SAMPLES
        by_area = np.clip(np.ceil(self.density * areas), least, MOST_SAMPLES).astype(np.int64)
        edges = np.append(0, np.cumsum(pieces.edge_counts, dtype=np.int64))
        on_edges = np.minimum(np.diff(edges[pieces.starts]), by_area)
        samples = by_area + on_edges
        chunks = np.cumsum(-(-samples // CHUNK_SAMPLES))
        most = max(BATCH_BYTES // (4 * self.words), 1)
        begin = 0
        while begin < count:
            before = chunks[begin - 1] if begin else 0
            end = max(int(np.searchsorted(chunks, before + most, side="right")), begin + 1)
            part = slice(begin, end)
            surfaces = self._surfaces(pieces, begin, end, by_area[part])
            masks[part], flags[part] = self._bake_batch(surfaces, samples[part])
            begin = end
            if progress is not None:
                progress(float(chunks[end - 1] / chunks[-1]))
        self.samples += int(samples.sum())
        return masks, flags

    def _surfaces(self, pieces: Pieces, begin: int, end: int, by_area: np.ndarray) -> bake_kernels.CellSurfaces:
        """Return the pieces of cells ``begin`` to ``end`` - 1 and how many samples each cell gets, as kernels read."""
        device = self.device
        first, last = pieces.starts[begin], pieces.starts[end]
        starts = pieces.starts[begin : end + 1] - first
        slot = np.repeat(np.arange(end - begin), np.diff(starts))
        edges = np.cumsum(pieces.edge_counts[first:last], dtype=np.int64)
        edges -= (edges - pieces.edge_counts[first:last])[starts[:-1]][slot]
        surfaces = bake_kernels.CellSurfaces()
        surfaces.search, surfaces.seed = self._search, self._seed
        surfaces.cell = wp.array(pieces.cells[begin:end], dtype=wp.int32, device=device)
        surfaces.piece_start = wp.array(starts, dtype=wp.int32, device=device)
        surfaces.side = wp.array(pieces.sides[first:last], dtype=wp.int32, device=device)
        surfaces.area = wp.array(running_sums(pieces.areas[first:last], starts), dtype=wp.float32, device=device)
        surfaces.edges = wp.array(edges, dtype=wp.int32, device=device)
        surfaces.area_count = wp.array(by_area, dtype=wp.int32, device=device)
        surfaces.step = wp.array(_golden_steps(by_area), dtype=wp.int32, device=device)
        return surfaces

    def _bake_batch(self, surfaces: bake_kernels.CellSurfaces, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        count, device = len(samples), self.device
        merge = bake_kernels.MergeCells()
        merge.raw, merge.masks, merge.settled = (
            wp.zeros(count * self.words, dtype=wp.uint32, device=device) for _ in range(3)
        )
        merge.neighbors = wp.array(self._neighbors.reshape(-1), dtype=wp.int32, device=device)
        merge.neighbor_count = self._neighbors.shape[1]
        merge.quiet_neighbors = wp.array(self._quiet.reshape(-1), dtype=wp.int32, device=device)
        merge.quiet_count = self._quiet.shape[1]
        merge.resolution, merge.words = self.settings.resolution, self.words
        merge.flags = wp.empty(count, dtype=wp.int32, device=device)
        settled = grid_struct(self.grid, self.settings.resolution, None, merge.settled)
        first = 0
        for last in ROUND_ENDS:
            round_begins, round_ends = np.minimum(first, samples), np.minimum(last, samples)
            first = last
            counts = -(-(round_ends - round_begins) // CHUNK_SAMPLES)
            total = int(counts.sum())
            if total == 0:
                break
            slots = np.repeat(np.arange(count, dtype=np.int32), counts)
            chunk_start = np.append(0, np.cumsum(counts)).astype(np.int32)
            begins = round_begins[slots] + CHUNK_SAMPLES * (np.arange(total) - chunk_start[slots])
            chunks = bake_kernels.BakeChunks()
            chunks.slot = wp.array(slots, dtype=wp.int32, device=device)
            chunks.begin = wp.array(begins, dtype=wp.int32, device=device)
            chunks.end = wp.array(np.minimum(begins + CHUNK_SAMPLES, round_ends[slots]), dtype=wp.int32, device=device)
            chunks.rays = self.rays
            chunks.partial = wp.empty(total * self.words, dtype=wp.uint32, device=device)
            chunks.traced = wp.zeros(total, dtype=wp.int32, device=device)
            inputs = [self.bvh, self.geometry, surfaces, settled, self._query, chunks]
            launch.launch(bake_kernels.bake_masks, total, inputs, device, smallest_slice=1)
            merge.chunk_start = wp.array(chunk_start, dtype=wp.int32, device=device)
            merge.partial = chunks.partial
            merge.last = int(last >= samples.max())
            launch.launch(bake_kernels.merge_masks, count, [merge], device, smallest_slice=16)
            self.rays_traced += int(chunks.traced.numpy().sum(dtype=np.int64))
            self.rays_asked += int((round_ends - round_begins).sum()) * self.rays
        return merge.masks.numpy().reshape(count, self.words), merge.flags.numpy()


def running_sums(values: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """Return the sum of ``values`` up to each of them within its run, float64 [value]; runs begin at ``starts``.

    Each run is summed alone: the rounding of a cell's sums is the same whichever cells are baked beside it.
    """
    sums = np.empty(len(values), np.float64)
    for first, last in itertools.pairwise(starts.tolist()):
        np.cumsum(values[first:last], out=sums[first:last])
    return sums


def _golden_steps(counts: np.ndarray) -> np.ndarray:
    """Return int64 [cell]: about 0.618 of each count, and without a divisor in common with it."""
    steps = np.maximum(np.round(0.6180339887 * counts), 1).astype(np.int64)
    while (shared := np.gcd(steps, counts) > 1).any():
        steps[shared] += 1
    return steps
