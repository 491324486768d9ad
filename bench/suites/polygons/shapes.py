"""Stand-ins for the meshes of the paper (visibility_correspondence.txt, Table 1), of about as many vertices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

import warp_gi as gi

GREY = gi.Material("grey", (0.6, 0.6, 0.6), specular=0.0)
Radius = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class StandIn:
    """A mesh in place of one of the paper's, and what the paper says of that."""

    name: str
    build: Callable[[], list[gi.Mesh]]
    paper_vertices: int
    paper_mb: tuple[float, float]
    """Of visibility, and of the lists of what belongs together."""
    paper_s: tuple[float, float]
    """Of its visibility and of its correspondence, on an i5-8400."""


def closed(radius: Radius, rows: int, columns: int, name: str) -> gi.Mesh:
    """Return a closed surface of rows x columns + 2 vertices about the origin, ``radius`` [n] in directions [n, 3]."""
    polar, azimuth = np.pi * (np.arange(rows) + 1) / (rows + 1), 2 * np.pi * np.arange(columns) / columns
    t, p = (grid.ravel() for grid in np.meshgrid(polar, azimuth, indexing="ij"))
    rings = np.stack([np.sin(t) * np.sin(p), np.cos(t), np.sin(t) * np.cos(p)], axis=1)
    directions = np.concatenate([rings, [(0.0, 1.0, 0.0), (0.0, -1.0, 0.0)]])
    one = np.arange(columns)
    next_one, last = (one + 1) % columns, (rows - 1) * columns
    faces = [_between(rows, columns, wraps=True)]
    faces.append(np.stack([np.full(columns, rows * columns), one, next_one], axis=1))
    faces.append(np.stack([np.full(columns, rows * columns + 1), last + next_one, last + one], axis=1))
    return smooth(directions * radius(directions)[:, None], np.concatenate(faces), name)


def tube(path: np.ndarray, radius: float, around: int, name: str) -> gi.Mesh:
    """Return an open tube about a path [n, 3] in the plane z = 0."""
    along = np.gradient(path, axis=0)
    side = np.cross(along / np.linalg.norm(along, axis=1, keepdims=True), (0.0, 0.0, 1.0))
    turn = 2 * np.pi * np.arange(around) / around
    ring = np.cos(turn)[None, :, None] * side[:, None] + np.sin(turn)[None, :, None] * np.array([0.0, 0.0, 1.0])
    points = path[:, None] + radius * ring
    return smooth(points.reshape(-1, 3), _between(len(path), around, wraps=True), name)


def ground(cells: int = 40, size: float = 3.0, height: float = -1.0) -> gi.Mesh:
    """Return a level square of (cells + 1)^2 vertices."""
    edge = np.linspace(-size, size, cells + 1)
    x, z = np.meshgrid(edge, edge, indexing="ij")
    points = np.stack([x, np.full_like(x, height), z], axis=-1).reshape(-1, 3)
    return smooth(points, _between(cells + 1, cells + 1, wraps=False)[:, ::-1], "ground")


def smooth(points: np.ndarray, faces: np.ndarray, name: str) -> gi.Mesh:
    """Return a mesh with the normals of its vertices, weighted by area."""
    a, b, c = (points[faces[:, k]] for k in range(3))
    normals, across = np.zeros_like(points), np.cross(b - a, c - a)
    for k in range(3):
        np.add.at(normals, faces[:, k], across)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return gi.Mesh(
        points.astype(np.float32), faces.astype(np.int32), GREY, normals=normals.astype(np.float32), name=name
    )


def _between(rows: int, columns: int, wraps: bool) -> np.ndarray:
    """Return two triangles for each square between neighbours in a grid of points."""
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(rows - 1), np.arange(columns - (not wraps)), indexing="ij"))
    here, next_one = i * columns + j, i * columns + (j + 1) % columns
    return np.concatenate(
        [np.stack([here, here + columns, next_one + columns], 1), np.stack([here, next_one + columns, next_one], 1)]
    )


def bumpy(rows: int = 40, columns: int = 64) -> gi.Mesh:
    """Return a closed object with deep hollows, of 2,562 vertices."""

    def radius(d: np.ndarray) -> np.ndarray:
        return 0.75 + 0.25 * np.sin(4 * d[:, 0] + 0.5) * np.sin(4 * d[:, 1]) * np.sin(4 * d[:, 2] + 1.0)

    return closed(radius, rows, columns, "bumpy")


def teapot() -> list[gi.Mesh]:
    """Return a body of revolution, and a handle and a spout that pass through it."""
    body = closed(lambda d: 0.8 + 0.12 * np.cos(4 * np.arccos(np.clip(d[:, 1], -1, 1))), 36, 44, "body")
    turn = np.linspace(-1.2, 1.2, 18)
    handle = np.stack([0.75 + 0.4 * np.cos(turn), 0.45 * np.sin(turn), 0 * turn], axis=1)
    along = np.linspace(0.0, 1.0, 18)
    spout = np.stack([-0.6 - 0.6 * along, -0.3 + 0.75 * along**1.5, 0 * along], axis=1)
    return [body, tube(handle, 0.07, 12, "handle"), tube(spout, 0.11, 12, "spout")]


def duck() -> list[gi.Mesh]:
    """Return a body with a head on it, in one."""
    head = np.array([0.4, 0.8, 0.0]) / np.hypot(0.4, 0.8)
    return [closed(lambda d: 0.6 + 0.45 * np.exp(-6 * (1 - d @ head)) + 0.1 * d[:, 0] ** 3, 47, 50, "duck")]


def avocado() -> list[gi.Mesh]:
    """Return a pear's shape."""
    return [closed(lambda d: 0.7 + 0.2 * d[:, 1] + 0.1 * d[:, 1] ** 3, 22, 22, "avocado")]


STAND_INS = (
    StandIn("avocado", avocado, 484, (0.72, 4.03), (11.9, 35.6)),
    StandIn("duck", duck, 2350, (3.66, 21.15), (42.5, 62.3)),
    StandIn("teapot", teapot, 2024, (3.04, 17.07), (46.3, 41.9)),
)
