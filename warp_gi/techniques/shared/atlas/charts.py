"""Charts of a scene's surfaces: cut by xatlas or taken from meshes, and placed side by side on one page."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from warp_gi.errors import OptionError
from warp_gi.techniques.shared.atlas.chart_cache import cached
from warp_gi.techniques.shared.atlas.chart_job import ChartJob, Progress
from warp_gi.techniques.shared.atlas.islands import equal_rows, islands

TRIANGLE_SIZE = 64.0
"""Root of the mean area of a part's triangles as xatlas gets them: it drops those with an area below 1e-7."""
STEP = 64
"""Resolutions that are advised are multiples of it."""
MOST_FACES = 2048
"""Faces of an island that xatlas cuts at once: its time and memory grow faster than their number."""


@dataclass(frozen=True, eq=False)
class Page:
    """Charts side by side."""

    corners: np.ndarray
    """Corners of faces in texels, float32 [face, 3, 2]."""
    charts: np.ndarray
    """Chart of each face, int32 [face]; -1 for faces too thin to be placed."""
    width: int
    """Texels along x."""
    height: int
    """Texels along y."""


def surface_scales(points: np.ndarray, uvs: np.ndarray, charts: np.ndarray) -> np.ndarray:
    """Return by how much to stretch each chart along u and v so that it is as large as its surface, float64 [chart, 2].

    ``points`` [face, 3, 3] and ``uvs`` [face, 3, 2] are corners; 0, 0 for charts without area in uv. xatlas rounds the
    size of charts up to whole texels, each axis apart; the metric tensor, a mean over the faces, tells both factors.
    """
    count = int(charts.max(initial=-1)) + 1
    sides = (points[:, 1:] - points[:, :1]).astype(np.float64)
    flat = (uvs[:, 1:] - uvs[:, :1]).astype(np.float64)
    area = 0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1)
    determinant = flat[:, 0, 0] * flat[:, 1, 1] - flat[:, 0, 1] * flat[:, 1, 0]
    longest = (flat**2).sum(axis=2).max(axis=1)
    good = (charts >= 0) & (np.abs(determinant) > 1e-5 * longest) & (longest > 0.0) & (area > 0.0)
    charts, sides, flat, area = charts[good], sides[good], flat[good], area[good]
    inverse = np.linalg.inv(flat)
    jacobian = inverse @ sides
    tensor = (jacobian**2).sum(axis=2)
    weight = np.bincount(charts, area, count)
    scales = np.stack([np.bincount(charts, area * tensor[:, axis], count) for axis in range(2)], axis=1)
    scales = np.sqrt(np.divide(scales, weight[:, None], out=np.zeros_like(scales), where=weight[:, None] > 0.0))
    flat_area = np.bincount(charts, 0.5 * np.abs(determinant[good]), count) * scales.prod(axis=1)
    scales *= np.sqrt(np.divide(weight, flat_area, out=np.zeros_like(weight), where=flat_area > 0.0))[:, None]
    return scales


def plane_uvs(points: np.ndarray) -> np.ndarray:
    """Return triangles [face, 3, 3] laid flat, float32 [face, 3, 2]: first corner at 0, second on the x axis."""
    sides = (points[:, 1:] - points[:, :1]).astype(np.float64)
    length = np.linalg.norm(sides[:, 0], axis=1)
    along = (sides[:, 0] * sides[:, 1]).sum(axis=1) / length
    across = np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1) / length
    uvs = np.zeros((len(points), 3, 2), np.float32)
    uvs[:, 1, 0], uvs[:, 2, 0], uvs[:, 2, 1] = length, along, across
    return uvs


def cut_charts(
    points: np.ndarray, parts: np.ndarray, job: ChartJob, progress: Progress | None
) -> tuple[np.ndarray, np.ndarray]:
    """Return uv [face, 3, 2] and chart of each face, int32 [face], by xatlas; no chart is of two parts.

    ``points`` float64 [face, 3, 3] are corners of faces that have an area, in any unit; ``parts`` int32 [face] are
    their parts, of which those of more than MOST_FACES faces are split.
    """
    if len(points) == 0:
        return np.zeros((0, 3, 2), np.float32), np.zeros(0, np.int32)
    parts = split_parts(points, parts)
    order = np.argsort(parts, kind="stable")
    points, parts = points[order], parts[order]
    starts = np.searchsorted(parts, np.arange(parts[-1] + 2))
    all_points, all_indices, vertex_starts = [], [], [0]
    for begin, end in itertools.pairwise(starts):
        corners = points[begin:end].reshape(-1, 3)
        sides = points[begin:end, 1:] - points[begin:end, :1]
        size = np.sqrt(0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).mean())
        places = ((corners - corners.min(axis=0)) * (TRIANGLE_SIZE / size)).astype(np.float32)
        vertices, indices = equal_rows(places)
        all_points.append(vertices)
        all_indices.append(indices.reshape(-1, 3).astype(np.uint32))
        vertex_starts.append(vertex_starts[-1] + len(vertices))
    arrays = {
        "points": np.concatenate(all_points),
        "indices": np.concatenate(all_indices),
        "starts": starts,
        "vertex_starts": np.array(vertex_starts),
    }
    result = cached("cut", arrays, lambda: job.run(arrays, progress))
    uvs, charts = np.empty_like(result["uvs"]), np.empty_like(result["charts"])
    uvs[order], charts[order] = result["uvs"], result["charts"]
    return uvs, charts


def split_parts(points: np.ndarray, parts: np.ndarray) -> np.ndarray:
    """Return parts without a gap, int32 [face]: of those with more than MOST_FACES faces, pieces of about that many.

    An island stays whole if it has no more; larger ones are halved at the median of their longest axis, and again.
    ``points`` float64 [face, 3, 3] and ``parts`` int32 [face] are those of the faces.
    """
    result, number = np.empty(len(parts), np.int32), 0
    order = np.argsort(parts, kind="stable")
    for faces in np.split(order, np.flatnonzero(np.diff(parts[order])) + 1):
        if len(faces) <= MOST_FACES:
            result[faces] = number
            number += 1
            continue
        centers = points[faces].mean(axis=1)
        island = islands(points[faces])
        sizes = np.bincount(island)
        small = np.where(sizes <= MOST_FACES, sizes, 0)
        group = np.where(small > 0, (np.cumsum(small) - small) // MOST_FACES, -1)[island]
        chosen = np.flatnonzero(group >= 0)
        groups, group[chosen] = np.unique(group[chosen], return_inverse=True)
        result[faces[chosen]] = number + group[chosen]
        number += len(groups)
        stack = [np.flatnonzero(island == large) for large in np.flatnonzero(small == 0)[::-1]]
        while stack:
            chosen = stack.pop()
            if len(chosen) > MOST_FACES:
                axis = int(np.argmax(np.ptp(centers[chosen], axis=0)))
                by_axis = chosen[np.argsort(centers[chosen, axis], kind="stable")]
                stack += [by_axis[len(chosen) // 2 :], by_axis[: len(chosen) // 2]]
                continue
            result[faces[chosen]] = number
            number += 1
    return result


def surface_sized(points: np.ndarray, uvs: np.ndarray, charts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return uv as large as the surface, and charts: faces of a chart without area in uv get one each."""
    if len(points) == 0:
        return uvs, charts
    scales = surface_scales(points, uvs, charts)
    is_flat = charts < 0
    is_flat[~is_flat] = (scales[charts[~is_flat]] == 0.0).any(axis=1)
    sized, numbers = np.empty_like(uvs, dtype=np.float32), charts.copy()
    rest = ~is_flat
    sized[rest] = uvs[rest] * scales[charts[rest]][:, None]
    sized[is_flat] = plane_uvs(points[is_flat])
    numbers[is_flat] = int(charts.max(initial=-1)) + 1 + np.arange(np.count_nonzero(is_flat))
    return sized, np.unique(numbers, return_inverse=True)[1].astype(np.int32)


def packed(uvs: np.ndarray, charts: np.ndarray, size: int, job: ChartJob, progress: Progress | None) -> Page:
    """Return the charts side by side on a page of at most ``size`` texels a side, and close to it.

    Raises OptionError if they do not fit.
    """
    if len(uvs) == 0:
        return Page(uvs, charts, 0, 0)
    count = int(charts.max(initial=-1)) + 1
    arrays = {"uvs": uvs, "charts": charts, "size": np.array(size)}
    result = cached("page", arrays, lambda: job.run(arrays, progress))
    if not result["page"].any():
        raise OptionError(_too_many(count, size, int(result["least"]), job))
    width, height = (int(n) for n in result["page"])
    return Page(result["corners"], np.where(result["is_placed"], charts, -1).astype(np.int32), width, height)


def _too_many(count: int, size: int, least: int, job: ChartJob) -> str:
    """Return what to do about charts that do not fit on a page of ``size``; the smallest that was tried took ``least``.

    Charts of a texel or two take about that much, however small they are. A page of twice the side has about half of
    its texels to share out by area.
    """
    wanted = -(-2 * least // STEP) * STEP
    return f"resolution {size} is too small for the {count:,} charts of this scene: " + job.advice(
        f"take about {wanted}", 'give the meshes uv of their own in few charts (charts="own")'
    )
