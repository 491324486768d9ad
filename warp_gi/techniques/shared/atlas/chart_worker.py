"""The program that cuts meshes into charts and packs them by xatlas, in a process of its own that can be stopped.

``chart_job.py`` runs it, and it imports nothing of this package. It reads ``job.npz`` there, writes
``result.npz``, and prints the share of its work that is done, a line each. ``run`` says what is in them.
"""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import xatlas

SHARE = "share"  # first word of a line that tells one, as in chart_job.py
CUT_TEXELS = 4.0
"""Texels along a side, by the root of the triangles' number, of the page on which xatlas lays out the charts of a part.
Their true size is found afterwards, by ``charts.surface_scales``."""
PADDING = 1
"""Texels between charts, beyond those that a bilinear fetch touches. With none, charts share such texels now and then;
with two, a room of 5,000 charts has a third fewer texels on its surfaces."""
UNITS_A_TEXEL = 64.0
"""Units of uv along about a texel, as xatlas gets them to pack: it drops triangles of an area below 1e-7 units^2."""
NEAR = 0.97
"""Share of the wanted size that a page has to reach."""
MOST_SIDE = 1 << 30
"""Side of a page that is larger than any."""
MOST_PACKS = 10
"""Largest number of times that charts are packed to meet the wanted size."""


def cut(points: np.ndarray, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return uv [triangle, 3, 2] in texels of some page, and the chart of each triangle, int32, -1 without one."""
    atlas = xatlas.Atlas()
    atlas.add_mesh(points, indices)
    pack = xatlas.PackOptions()
    sides = points[indices[:, 1:]] - points[indices[:, :1]]
    area = float(0.5 * np.linalg.norm(np.cross(sides[:, 0], sides[:, 1]), axis=1).sum())
    pack.texels_per_unit = float(np.clip(CUT_TEXELS * np.sqrt(len(indices)), 64.0, 2048.0) / np.sqrt(area))
    pack.rotate_charts_to_axis = True
    atlas.generate(xatlas.ChartOptions(), pack)
    if atlas.chart_count == 0:
        return np.zeros((len(indices), 3, 2), np.float32), np.full(len(indices), -1, np.int32)
    _, corners, uvs = atlas.get_mesh(0)
    chart_of_vertex = atlas.get_mesh_vertex_assignment(0)[1].astype(np.int32)
    size = np.array([atlas.width, atlas.height], np.float32)
    return uvs[corners] * size, chart_of_vertex[corners[:, 0]]


def pack(uvs: np.ndarray, charts: np.ndarray, size: int, tell: Callable[[float], None]) -> dict[str, np.ndarray]:
    """Return charts with ``uvs`` [triangle, 3, 2] placed side by side on a page whose longer side is near ``size``.

    ``corners`` float32 [triangle, 3, 2] are in texels; ``is_placed`` bool [triangle] is false for those too thin for
    xatlas; ``page`` int32 [2] is the width and height, or 0, 0 if the charts do not fit, however small. ``least``
    int64 is the longer side of the smallest page that any scale needed.
    """
    edges = (uvs[:, 1:] - uvs[:, :1]).astype(np.float64)
    first = size * np.sqrt(0.5 / max(float(0.5 * np.abs(np.linalg.det(edges)).sum()), 1e-30))
    uvs = (uvs * (UNITS_A_TEXEL * first)).astype(np.float32)
    low, high, scale = 0.0, np.inf, 1.0
    best, best_page = (np.zeros_like(uvs), np.zeros(len(uvs), bool)), np.zeros(2, np.int32)
    least = MOST_SIDE
    for attempt in range(MOST_PACKS):
        corners, is_placed, page = _packed(uvs, charts, scale / UNITS_A_TEXEL)
        got = max(page)
        least = min(least, got)
        if got <= size and scale > low:
            low, best, best_page = scale, (corners, is_placed), np.array(page, np.int32)
            if got >= NEAR * size:
                break
        elif got > size:
            high = min(high, scale)
        scale *= 0.99 * size / got
        if not low < scale < high:
            scale = (low + min(high, 4.0 * low)) / 2.0 if low > 0.0 else high / 2.0
        tell((attempt + 1) / MOST_PACKS)
    return {"corners": best[0], "is_placed": best[1], "page": best_page, "least": np.array(least, np.int64)}


def _packed(uvs: np.ndarray, charts: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray, tuple[int, int]]:
    """Return corners, which triangles have some, and width and height of the page at ``scale`` texels a unit."""
    atlas = xatlas.Atlas()
    points, places = _welded(uvs, charts)
    atlas.add_uv_mesh(points, places, charts.astype(np.uint32).reshape(-1, 1))
    options = xatlas.PackOptions()
    options.padding, options.bilinear, options.texels_per_unit = PADDING, True, scale
    atlas.generate(xatlas.ChartOptions(), options)
    _, places, packed = atlas.get_mesh(0)
    has_chart = atlas.get_mesh_vertex_assignment(0)[1].astype(np.int32) >= 0
    size = (atlas.width, atlas.height)
    return packed[places] * np.array(size, np.float32), has_chart[places].all(axis=1), size


def _welded(uvs: np.ndarray, charts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the different places of corners in each chart, float32 [n, 2], and those of each triangle."""
    keys = np.empty(3 * len(uvs), dtype=[("chart", np.int32), ("uv", np.float32, 2)])
    keys["chart"], keys["uv"] = np.repeat(charts, 3), uvs.reshape(-1, 2)
    order = np.lexsort((keys["uv"][:, 1], keys["uv"][:, 0], keys["chart"]))
    ranked = keys[order]
    is_new = np.append(True, ranked[1:] != ranked[:-1])
    places = np.empty(len(keys), np.uint32)
    places[order] = np.cumsum(is_new) - 1
    return np.ascontiguousarray(ranked["uv"][is_new]), places.reshape(-1, 3)


def run(job: Mapping[str, np.ndarray], tell: Callable[[float], None]) -> dict[str, np.ndarray]:
    """Return what a job asks for: all charts on a page where it has a ``size``, otherwise the charts of each part.

    The one has the arguments of ``pack`` and what it returns. The other has ``points`` and ``indices`` of ``cut``, one
    part after another, with the first triangle and vertex of each part and their number in ``starts`` and
    ``vertex_starts``; its result are ``uvs`` and ``charts`` of all triangles.
    """
    if "size" in job:
        return pack(job["uvs"], job["charts"], int(job["size"]), tell)
    starts, vertex_starts = job["starts"], job["vertex_starts"]
    points, indices = job["points"], job["indices"]
    uvs, charts, count = [], [], 0
    for part in range(len(starts) - 1):
        vertices = slice(vertex_starts[part], vertex_starts[part + 1])
        part_uvs, part_charts = cut(points[vertices], indices[starts[part] : starts[part + 1]])
        uvs.append(part_uvs)
        charts.append(np.where(part_charts >= 0, part_charts + count, -1).astype(np.int32))
        count += part_charts.max(initial=-1) + 1
        tell(float(starts[part + 1] / starts[-1]))
    return {"uvs": np.concatenate(uvs), "charts": np.concatenate(charts)}


def main(folder: Path, seconds: float) -> None:
    """Work off the job in a folder; SIGPROF ends the process after ``seconds`` of CPU time, if that is above 0."""
    if seconds > 0.0 and hasattr(signal, "setitimer"):
        signal.signal(signal.SIGPROF, signal.SIG_DFL)
        signal.setitimer(signal.ITIMER_PROF, seconds)
    with np.load(folder / "job.npz") as job:
        result = run(dict(job), lambda share: print(SHARE, share, flush=True))
    result["seconds"] = np.array(time.process_time())
    np.savez(folder / "result.npz", **result)  # type: ignore[arg-type]


if __name__ == "__main__":
    main(Path(sys.argv[2]), float(sys.argv[3]))
