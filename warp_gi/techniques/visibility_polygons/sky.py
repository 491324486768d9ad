"""Tables of a sky, by which the light through a polygon is an integral along its edges."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import warp as wp

from warp_gi.kernels.visibility_polygons_sky import SKY_CONSTANT, SKY_MAP, SKY_NONE, PolygonSky
from warp_gi.launch import on_device
from warp_gi.scene.environment import Environment

Evaluator = Literal["adaptive", "exact", "vsat"]
"""How the sky is integrated; "vsat" is the paper's way, which is measured and not used."""
EVALUATORS: tuple[Evaluator, ...] = ("adaptive", "exact")
"""Those of frames."""
BRIGHT, BRIGHT_MEANS = 1e-3, 8.0
"""Share of the sky's flux above which a texel's excess is integrated exactly, in a band of columns; in means of texels,
if that is more."""
EXACT_COLUMNS = 512
"""Columns of texels at least that "exact" integrates, as it takes arcs for straight within them."""
LEAST_ROWS = 128
"""Rows of the summed-area table at least; it has a quarter of the map's where that is more, and twice as many
columns."""
NUDGE = 1e-4
"""Radians by which polygons are turned before they are integrated: horizons of walls would pass exactly through the
poles of the map, where rounding decides on which side."""


@dataclass(frozen=True, eq=False)
class SkyTables:
    """Tables of a map in its own space and unscaled. Texels are the means of patches between four nodes."""

    table: np.ndarray
    """Integrals of l L over polar angles and azimuths below each node, float32 [rows + 1, columns + 1, 3 axes, 3]."""
    row_areas: np.ndarray
    """(t - sin t cos t) / 2 and sin^2 t / 2 between rows of texels, float32 [height + 1, 2]."""
    bands: np.ndarray
    """First column, the one after the last, and the first one's place in ``band_sums``, int32 [band, 3]."""
    band_sums: np.ndarray
    """Sums of L times both areas above a row, float32 [column, height + 1, 2, 3]."""
    total: np.ndarray
    """Integrals of l L over the sphere, float64 [3 axes, 3]."""
    width: int
    """Columns of texels; "exact" has each of a small map several times."""
    map_width: int
    """Columns of nodes of the map."""


def sky_tables(pixels: np.ndarray, evaluator: Evaluator) -> SkyTables:
    """Return the tables of a map.

    Args:
        pixels: The map, float32 [height, width, 3].
        evaluator: "exact" keeps all columns of texels, "adaptive" those with bright ones, and a summed-area table of
            the rest; "vsat" has a table of all, of a cell a texel.
    """
    nodes = pixels[:-1].astype(np.float64)
    nodes += pixels[1:]
    texels = np.roll(nodes, -1, axis=1)
    texels += nodes
    texels *= 0.25
    height, width = texels.shape[:2]
    polar = np.linspace(0.0, math.pi, height + 1)
    areas = row_areas(polar)
    if evaluator == "exact":
        texels = np.repeat(texels, -(-EXACT_COLUMNS // width), axis=1)
        width = texels.shape[1]
    whole = _total(texels, areas)
    if evaluator == "exact":
        columns = np.arange(width)
        excess = texels
    elif evaluator == "vsat":
        columns = np.zeros(0, np.int64)
        excess = texels[:, :0]
    else:
        solid = (np.cos(polar[:-1]) - np.cos(polar[1:]))[:, None] * (2 * math.pi / width)
        flux = texels @ np.array((0.2126, 0.7152, 0.0722))
        flux *= solid
        most = max(BRIGHT, BRIGHT_MEANS / flux.size) * flux.sum()
        bright = flux > most
        columns = np.flatnonzero(bright.any(axis=0))
        share = np.maximum(1.0 - most / np.maximum(flux[:, columns], 1e-300), 0.0)
        excess = texels[:, columns] * share[:, :, None]
        texels[:, columns] -= excess
    sums = np.zeros((len(columns), height + 1, 2, 3), np.float32)
    for k in range(2):
        sums[:, 1:, k] = np.cumsum(excess * np.diff(areas[:, k])[:, None, None], axis=0).transpose(1, 0, 2)
    table = np.zeros((0, 0, 3, 3), np.float32)
    if evaluator != "exact":
        rows = height if evaluator == "vsat" else max(LEAST_ROWS, height // 4)
        across = width if evaluator == "vsat" else 2 * rows
        ends = np.linspace(0.0, math.pi, rows + 1), np.linspace(0.0, 2 * math.pi, across + 1)
        table = _summed(texels, polar, areas, *ends).astype(np.float32)
    return SkyTables(table, areas.astype(np.float32), _bands(columns), sums, whole, width, pixels.shape[1])


def row_areas(polar: np.ndarray) -> np.ndarray:
    """Return (t - sin t cos t) / 2 and sin^2 t / 2, float64 [..., 2]: the integrals of sin^2 t and of sin t cos t."""
    sine = np.sin(polar)
    return np.stack([0.5 * (polar - sine * np.cos(polar)), 0.5 * sine**2], axis=-1)


def _bands(columns: np.ndarray) -> np.ndarray:
    """Return runs of neighbours among sorted numbers, int32 [run, 3]: first, the one after the last, place of first."""
    if not len(columns):
        return np.zeros((0, 3), np.int32)
    starts = np.flatnonzero(np.diff(columns, prepend=columns[0] - 2) > 1)
    ends = np.append(starts[1:], len(columns)) - 1
    return np.stack([columns[starts], columns[ends] + 1, starts], axis=1).astype(np.int32)


def _summed(
    texels: np.ndarray, polar: np.ndarray, areas: np.ndarray, rows: np.ndarray, columns: np.ndarray
) -> np.ndarray:
    """Return integrals of l L over polar angles below ``rows`` and azimuths below ``columns``, [row, column, 3, 3].

    They are exact: texels that a row or column cuts count with the part within.
    """
    height, width = texels.shape[:2]
    row = np.minimum((rows / math.pi * height).astype(int), height - 1)
    by_row = []
    for k in range(2):
        parts = texels * np.diff(areas[:, k])[:, None, None]
        below = np.zeros((len(rows), width, 3))
        for at in range(1, len(rows)):
            below[at] = below[at - 1]
            if row[at] > row[at - 1]:
                below[at] += parts[row[at - 1] : row[at]].sum(axis=0)
        by_row.append(below + texels[row] * (row_areas(rows)[:, k] - areas[row, k])[:, None, None])
    azimuths = np.linspace(0.0, 2 * math.pi, width + 1)
    column = np.minimum((columns / (2 * math.pi) * width).astype(int), width - 1)
    result = np.zeros((len(rows), len(columns), 3, 3))
    for axis, (measure, values) in enumerate(zip(_ACROSS, (by_row[0], by_row[1], by_row[0]), strict=True)):
        steps = values * np.diff(measure(azimuths))[None, :, None]
        below = np.concatenate([np.zeros((len(rows), 1, 3)), np.cumsum(steps, axis=1)], axis=1)
        rest = (measure(columns) - measure(azimuths[column]))[None, :, None]
        result[:, :, axis] = below[:, column] + values[:, column] * rest
    return result


def _total(texels: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Return integrals of l L over the sphere, float64 [3 axes, 3]."""
    height, width = texels.shape[:2]
    by_column = (np.diff(areas, axis=0).T @ texels.reshape(height, -1)).reshape(2, width, 3)
    azimuths = np.linspace(0.0, 2 * math.pi, width + 1)
    return np.stack([np.diff(measure(azimuths)) @ by_column[k] for measure, k in zip(_ACROSS, (0, 1, 0), strict=True)])


_ACROSS: tuple[Callable[[np.ndarray], np.ndarray], ...] = (lambda p: -np.cos(p), lambda p: p, lambda p: -np.sin(p))
"""Antiderivatives over the azimuth of what x, y and z of a direction have of it."""


def polygon_sky(
    environment: Environment | None, evaluator: Evaluator, tolerance: float, device: wp.Device
) -> PolygonSky:
    """Return a sky as kernels read it; tables are made once a map, and shared by its rotations and scales.

    Args:
        environment: The sky, or None.
        evaluator: How light through polygons is integrated.
        tolerance: Largest difference of an edge's two bounds, halved, as a share of the mean irradiance.
        device: Where kernels run.
    """
    sky = PolygonSky()
    if environment is None or environment.is_black:
        sky.kind = int(SKY_NONE)
        return sky
    sky.kind = int(SKY_CONSTANT)
    sky.sky_from_world = wp.mat33(*np.eye(3).ravel())
    sky.radiance = wp.vec3(*environment.mean_radiance)
    made = environment.once_a_map(
        ("polygons", evaluator, device.alias), lambda pixels: _on_device(sky_tables(pixels, evaluator), device)
    )
    if made is None:
        return sky
    tables, arrays = made
    sky.kind = int(SKY_MAP)
    sky.radiance = wp.vec3(environment.scale, environment.scale, environment.scale)
    sky.sky_from_world = wp.mat33(*(_own_space(tables.map_width) @ environment.world_from_environment.T).ravel())
    mean = environment.mean_radiance / environment.scale
    sky.tolerance = tolerance * math.pi * float(mean @ (0.2126, 0.7152, 0.0722))
    sky.rows, sky.columns = max(tables.table.shape[0] - 1, 0), max(tables.table.shape[1] - 1, 0)
    sky.height, sky.width = len(tables.row_areas) - 1, tables.width
    sky.table, sky.row_areas, sky.bands, sky.band_sums = arrays
    sky.total_x, sky.total_y, sky.total_z = (wp.vec3(*axis) for axis in tables.total)
    return sky


def _on_device(tables: SkyTables, device: wp.Device) -> tuple[SkyTables, tuple[wp.array, ...]]:
    arrays = (
        on_device(tables.table.reshape(-1, 3), wp.vec3, device),
        on_device(tables.row_areas, wp.vec2, device),
        on_device(tables.bands, wp.vec3i, device),
        on_device(tables.band_sums.reshape(-1, 3), wp.vec3, device),
    )
    return tables, arrays


def _own_space(width: int) -> np.ndarray:
    """Return the rotation from the map's space to that of its patches, float64 [3, 3].

    Patches lie half a texel further on than nodes; a nudge keeps what is upright or level off the poles.
    """
    half = math.pi / width
    about_y = np.array([[math.cos(half), 0.0, math.sin(half)], [0.0, 1.0, 0.0], [-math.sin(half), 0.0, math.cos(half)]])
    axis = np.array([math.cos(1.0), 0.0, math.sin(1.0)])
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    about_axis = np.eye(3) + math.sin(NUDGE) * cross + (1 - math.cos(NUDGE)) * cross @ cross
    return about_axis @ about_y
