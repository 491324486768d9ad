"""Texture coordinates that meshes bring along, as charts: which are fit for it, and why others are not."""

from __future__ import annotations

import numpy as np

MOST_OVERLAP = 0.001
"""Share of the texels of a mesh that may lie in two of its triangles."""
MOST_FLAT = 0.001
"""Share of the area of a mesh's triangles that may have no area in uv."""
OUTSIDE = 1e-4
"""By how much uv may leave 0..1."""
LEAST_RASTER, MOST_RASTER = 128, 1024
"""Texels along a side of the picture in which overlaps are counted: 16 times the root of the number of triangles."""
MARGIN = 1e-4
"""Barycentric coordinate from which on a texel's centre lies within a triangle: neighbours share those at 0."""
FIRST_BATCH, MOST_BATCH = 1 << 14, 1 << 20
"""Texels in boxes of triangles that are looked at together: few at first, as most uv that overlap do so at once."""


def why_unfit(uvs: np.ndarray | None, areas: np.ndarray) -> str | None:
    """Return why uv cannot be charts, None if they can.

    ``uvs`` [face, 3, 2] are those of a mesh's faces, or None, and ``areas`` [face] the faces' areas.
    """
    if uvs is None:
        return "has no uv"
    uvs = uvs.astype(np.float64)
    if not (np.isfinite(uvs).all() and uvs.min() >= -OUTSIDE and uvs.max() <= 1.0 + OUTSIDE):
        return "has uv that leave 0..1"
    edges = uvs[:, 1:] - uvs[:, :1]
    is_flat = np.abs(np.linalg.det(edges)) <= 1e-6 * (edges**2).sum(axis=2).max(axis=1)
    if areas[is_flat].sum() > MOST_FLAT * areas.sum():
        share = areas[is_flat].sum() / areas.sum()
        return f"has uv without an area on {_percent(share)} of its surface"
    share, is_all = overlap(uvs[~is_flat])
    if share > MOST_OVERLAP:
        return f"has uv that overlap on {'' if is_all else 'at least '}{_percent(share)} of the texels they cover"
    return None


def _percent(share: float) -> str:
    return f"{100.0 * share:.3g} %"


def overlap(uvs: np.ndarray) -> tuple[float, bool]:
    """Return the share of covered texels that lie in two triangles of ``uvs`` [n, 3, 2], and if all were looked at.

    The uv's box is a picture of some texels along its longer side. The search ends with the batch of triangles after
    which the share is certain to be above MOST_OVERLAP, whatever the rest covers.
    """
    if len(uvs) == 0:
        return 0.0, True
    side = float(np.clip(16.0 * np.sqrt(len(uvs)), LEAST_RASTER, MOST_RASTER))
    low = uvs.reshape(-1, 2).min(axis=0)
    extent = uvs.reshape(-1, 2).max(axis=0) - low
    corners = (uvs - low) * (side / extent.max())
    width, height = (int(n) for n in np.ceil(extent * (side / extent.max())).clip(1))
    first = np.ceil(corners.min(axis=1) - 0.5).astype(np.int64).clip(0)
    size = np.floor(corners.max(axis=1) - 0.5).astype(np.int64) + 1 - first
    size = np.minimum(size, np.array([width, height]) - first).clip(0)
    counts = size.prod(axis=1)
    ends = np.cumsum(counts)
    covers = np.zeros(width * height, np.uint8)
    begin, batch = 0, FIRST_BATCH
    while begin < len(uvs):
        end = max(int(np.searchsorted(ends, ends[begin] - counts[begin] + batch, side="right")), begin + 1)
        chosen = np.repeat(np.arange(begin, end), counts[begin:end])
        rank = np.arange(len(chosen)) - np.repeat(
            ends[begin:end] - counts[begin:end] - ends[begin] + counts[begin], counts[begin:end]
        )
        x, y = first[chosen, 0] + rank % size[chosen, 0], first[chosen, 1] + rank // size[chosen, 0]
        inside = _is_inside(corners[chosen], np.stack([x, y], axis=1) + 0.5)
        found = np.bincount((y * width + x)[inside], minlength=len(covers))
        covers = np.minimum(covers + np.minimum(found, 2), 2).astype(np.uint8)
        begin, batch = end, min(2 * batch, MOST_BATCH)
        if np.count_nonzero(covers == 2) > MOST_OVERLAP * len(covers):
            break
    covered = np.count_nonzero(covers)
    return (np.count_nonzero(covers == 2) / covered if covered else 0.0), begin >= len(uvs)


def _is_inside(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return whether points [n, 2] lie within triangles [n, 3, 2] by more than MARGIN in barycentric coordinates."""
    a, b, c = (corners[:, k] - points for k in range(3))
    parts = np.stack(
        [
            b[:, 0] * c[:, 1] - b[:, 1] * c[:, 0],
            c[:, 0] * a[:, 1] - c[:, 1] * a[:, 0],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ]
    )
    total = parts.sum(axis=0)
    shares = np.divide(parts, total, out=np.zeros_like(parts), where=total != 0.0)
    return (shares > MARGIN).all(axis=0)
