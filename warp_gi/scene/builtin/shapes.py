"""Shapes that built-in scenes are put together from: plain triangle meshes with normals and texture coordinates.

All lengths are in metres, y is up, faces wind counter-clockwise seen from outside, and texture coordinates are
metres along the surface until ``Shape.textured`` scales them.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from warp_gi.scene.model import Material, Mesh
from warp_gi.scene.normals import smooth_mesh

SMALLEST_AREA = 1e-10  # m^2; thinner triangles are left out


@dataclass(frozen=True, eq=False)
class Shape:
    """Triangles; every operation returns a new shape."""

    points: np.ndarray
    """Positions in metres, float64 [vertex, 3]."""
    indices: np.ndarray
    """Vertices of each triangle, int32 [triangle, 3]."""
    uvs: np.ndarray
    """Texture coordinates in metres along the surface, float64 [vertex, 2]."""
    normals: np.ndarray
    """Unit shading normals, float64 [vertex, 3]."""

    @staticmethod
    def of(points: ArrayLike, indices: ArrayLike, uvs: ArrayLike | None = None, crease: float = 40.0) -> Shape:
        """Return the shape of welded vertices, smooth where faces meet at less than ``crease`` degrees."""
        vertices = np.asarray(points, np.float64).reshape(-1, 3)
        faces = np.asarray(indices, np.int32).reshape(-1, 3)
        places = np.zeros((len(vertices), 2)) if uvs is None else np.asarray(uvs, np.float64).reshape(-1, 2)
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        area = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
        mesh = smooth_mesh(Mesh(vertices, faces[area > SMALLEST_AREA], uvs=places), crease)
        assert mesh.uvs is not None and mesh.normals is not None  # smooth_mesh makes both
        return Shape(mesh.points, mesh.indices, mesh.uvs, mesh.normals.astype(np.float64))

    def transformed(self, matrix: np.ndarray) -> Shape:
        """Return the shape after a 4x4 or 3x4 affine ``matrix``; a mirror keeps the outside outside."""
        linear = np.asarray(matrix)[:3, :3]
        normals = self.normals @ np.linalg.inv(linear)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        indices = self.indices if np.linalg.det(linear) > 0 else self.indices[:, ::-1]
        return Shape(self.points @ linear.T + np.asarray(matrix)[:3, 3], indices, self.uvs, normals)

    def moved(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Shape:
        """Return the shape translated."""
        return replace(self, points=self.points + np.array([x, y, z]))

    def turned(self, degrees: float, axis: str = "y") -> Shape:
        """Return the shape turned about a coordinate axis by the right-hand rule."""
        return self.transformed(placement(turn=degrees, axis=axis))

    def scaled(self, x: float, y: float | None = None, z: float | None = None) -> Shape:
        """Return the shape scaled; one number scales all axes."""
        return self.transformed(np.diag([x, x if y is None else y, x if z is None else z, 1.0]))

    def flipped(self) -> Shape:
        """Return the shape with its inside out."""
        return replace(self, indices=self.indices[:, ::-1], normals=-self.normals)

    def textured(self, size: float | tuple[float, float], offset: tuple[float, float] = (0.0, 0.0)) -> Shape:
        """Return the shape with texture coordinates scaled so that a texture covers ``size`` metres."""
        return replace(self, uvs=self.uvs / np.broadcast_to(size, 2) + offset)

    def box_mapped(self) -> Shape:
        """Return the shape with texture coordinates [m] projected along the axis that each normal is nearest to.

        For flat faces: where a smooth surface turns from one axis to the next, the texture is torn.
        """
        axis = np.abs(self.normals).argmax(axis=1)
        x, y, z = self.points.T
        uvs = np.stack([np.choose(axis, [z, x, x]), np.choose(axis, [y, z, y])], axis=1)
        return replace(self, uvs=uvs)

    def repeated(self, matrices: np.ndarray, uv_offsets: np.ndarray | None = None) -> Shape:
        """Return copies of the shape under each of ``matrices`` [k, 4, 4], optionally with shifted uvs [k, 2]."""
        matrices = np.asarray(matrices, np.float64).reshape(-1, 4, 4)
        linear = matrices[:, :3, :3]
        points = np.einsum("kij,nj->kni", linear, self.points) + matrices[:, None, :3, 3]
        normals = np.einsum("kji,nj->kni", np.linalg.inv(linear), self.normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-30)
        mirrored = np.linalg.det(linear) < 0
        faces = np.where(mirrored[:, None, None], self.indices[None, :, ::-1], self.indices[None])
        faces = faces + (np.arange(len(matrices)) * len(self.points))[:, None, None]
        uvs = np.broadcast_to(self.uvs, (len(matrices), *self.uvs.shape))
        if uv_offsets is not None:
            uvs = uvs + np.asarray(uv_offsets)[:, None]
        return Shape(points.reshape(-1, 3), faces.reshape(-1, 3), uvs.reshape(-1, 2), normals.reshape(-1, 3))

    def at(self, positions: Iterable[Sequence[float]]) -> Shape:
        """Return copies of the shape translated to each of ``positions``."""
        return self.repeated(np.stack([placement(p) for p in positions]))

    def mesh(self, material: Material, name: str = "mesh") -> Mesh:
        """Return the shape as a Mesh."""
        normals = self.normals.astype(np.float32)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        points, indices = self.points.astype(np.float32), np.ascontiguousarray(self.indices, np.int32)
        return Mesh(points, indices, material, normals, self.uvs.astype(np.float32), name)


def placement(position: ArrayLike = (0, 0, 0), turn: float = 0.0, axis: str = "y", scale: float = 1.0) -> np.ndarray:
    """Return the float64 [4, 4] that scales, then turns by degrees about a coordinate axis, then translates."""
    angle = math.radians(turn)
    c, s = math.cos(angle), math.sin(angle)
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    matrix = np.eye(4)
    matrix[i, i], matrix[i, j], matrix[j, i], matrix[j, j] = c, -s, s, c
    matrix[:3, :3] *= scale
    matrix[:3, 3] = position
    return matrix


def merge(shapes: Iterable[Shape]) -> Shape:
    """Return all shapes as one; of none, an empty one."""
    empty = Shape(np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 2)), np.zeros((0, 3)))
    shapes = list(shapes) or [empty]
    starts = np.cumsum([0, *(len(s.points) for s in shapes[:-1])])
    indices = np.concatenate([s.indices + start for s, start in zip(shapes, starts, strict=True)])
    points, uvs, normals = (np.concatenate([getattr(s, k) for s in shapes]) for k in ("points", "uvs", "normals"))
    return Shape(points, indices.astype(np.int32), uvs, normals)


def loft(grid: np.ndarray, uvs: np.ndarray | None = None, crease: float = 40.0) -> Shape:
    """Return the surface through a grid of points [rows, columns, 3]; its front is d(row) x d(column).

    ``uvs`` [rows, columns, 2] default to the mean length along columns (u) and along rows (v). Points may
    coincide; triangles without area are left out.
    """
    grid = np.asarray(grid, np.float64)
    rows, columns = grid.shape[:2]
    if uvs is None:
        across = np.linalg.norm(np.diff(grid, axis=1), axis=2).mean(axis=0)
        along = np.linalg.norm(np.diff(grid, axis=0), axis=2).mean(axis=1)
        u, v = (np.concatenate([[0], np.cumsum(length)]) for length in (across, along))
        uvs = np.stack(np.broadcast_arrays(u[None, :], v[:, None]), axis=-1)
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1, 1)
    triangles = np.array([[0, columns, columns + 1], [0, columns + 1, 1]])
    return Shape.of(grid, (corner[:, None, :] + triangles[None]).reshape(-1, 3), uvs, crease)


def quad(corner: ArrayLike, edge_u: ArrayLike, edge_v: ArrayLike) -> Shape:
    """Return the parallelogram whose front is edge_u x edge_v, its uvs in metres from ``corner``."""
    start, u, v = (np.asarray(x, np.float64) for x in (corner, edge_u, edge_v))
    points = np.stack([start, start + u, start + u + v, start + v])
    a, b = float(np.linalg.norm(u)), float(np.linalg.norm(v))
    return Shape.of(points, [[0, 1, 2], [0, 2, 3]], [[0.0, 0.0], [a, 0.0], [a, b], [0.0, b]])


def box(lower: ArrayLike, upper: ArrayLike, bevel: float = 0.0) -> Shape:
    """Return the closed box between two corners, its edges cut off by ``bevel`` metres; uvs are box-mapped."""
    low, high = np.asarray(lower, np.float64), np.asarray(upper, np.float64)
    half, signs = (high - low) / 2, np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    bevel = min(bevel, 0.49 * 2 * half.min())
    faces = []
    index = {tuple(s): k for k, s in enumerate(signs.tolist())}
    # vertex 3 * corner + axis lies on the face across that axis, drawn in by the bevel along the other two
    points = (signs[:, None] * (half - bevel * (1 - np.eye(3)))).reshape(-1, 3)

    def vertex(sign: list[int], axis: int) -> int:
        return 3 * index[tuple(sign)] + axis

    for axis in range(3):
        one, two = (axis + 1) % 3, (axis + 2) % 3
        for side in (-1, 1):
            corners = []
            for s, t in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
                sign = [0, 0, 0]
                sign[axis], sign[one], sign[two] = side, s, t
                corners.append(vertex(sign, axis))
            faces.append(corners if side > 0 else corners[::-1])
        for s in (-1, 1):
            for t in (-1, 1):  # the cut edge along this axis, between the faces across `one` and `two`
                start, end = [0, 0, 0], [0, 0, 0]
                start[axis], start[one], start[two] = -1, s, t
                end[axis], end[one], end[two] = 1, s, t
                corners = [vertex(start, one), vertex(start, two), vertex(end, two), vertex(end, one)]
                faces.append(corners if s * t > 0 else corners[::-1])
    triangles = [t for f in faces for t in ([f[0], f[1], f[2]], [f[0], f[2], f[3]])]
    for k, outwards in enumerate(signs):
        corner = [3 * k, 3 * k + 1, 3 * k + 2]
        triangles.append(corner if outwards.prod() > 0 else corner[::-1])
    return Shape.of(points + (low + high) / 2, triangles, crease=30.0).box_mapped()


def lathe(profile: ArrayLike, segments: int = 24, crease: float = 35.0) -> Shape:
    """Return the surface of revolution about y of ``profile``, (radius, height) pairs from bottom to top.

    Starting and ending at radius 0 closes it.
    """
    line = np.asarray(profile, np.float64)
    angle = np.linspace(0, 2 * math.pi, segments + 1)
    angle[-1] = 0.0  # the seam's points coincide to the last bit
    radius, height = line[:, :1], np.broadcast_to(line[:, 1:], (len(line), segments + 1))
    grid = np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], axis=-1)
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    around = np.linspace(0, 2 * math.pi, segments + 1) * line[:, 0].max()
    return loft(grid, np.stack(np.broadcast_arrays(around[None, :], length[:, None]), axis=-1), crease)


def cylinder(radius: float, height: float, segments: int = 24, bevel: float = 0.0) -> Shape:
    """Return the closed cylinder that stands on y = 0."""
    profile = [
        (0, 0),
        (radius - bevel, 0),
        (radius, bevel),
        (radius, height - bevel),
        (radius - bevel, height),
        (0, height),
    ]
    return lathe(profile, segments)


def uv_sphere(radius: float = 1.0, segments: int = 32, rings: int = 16) -> Shape:
    """Return the sphere of rings and segments around the origin."""
    theta = np.linspace(-math.pi / 2, math.pi / 2, rings + 1)
    profile = radius * np.stack([np.cos(theta), np.sin(theta)], axis=1)
    profile[[0, -1], 0] = 0
    shape = lathe(profile, segments, crease=180.0)
    return replace(shape, normals=shape.points / radius)


def icosphere(radius: float = 1.0, subdivisions: int = 2) -> Shape:
    """Return the sphere of 20 * 4^subdivisions nearly equal triangles around the origin."""
    g = (1 + math.sqrt(5)) / 2
    points = np.array([[s * a, t * b, 0.0] for a, b in ((1, g),) for s in (-1, 1) for t in (-1, 1)])
    points = np.concatenate([points, np.roll(points, 1, axis=1), np.roll(points, 2, axis=1)])
    points /= np.linalg.norm(points[0])
    distance = np.linalg.norm(points[:, None] - points[None], axis=2)
    near = (distance < 1.2) & (distance > 0)
    triples = [
        (i, j, k) for i in range(12) for j in range(i) for k in range(j) if near[i, j] and near[j, k] and near[i, k]
    ]
    faces = np.array([t if np.linalg.det(points[list(t)]) > 0 else t[::-1] for t in triples])
    for _ in range(subdivisions):
        corners = points[faces]
        middles = corners + np.roll(corners, -1, axis=1)
        middles /= np.linalg.norm(middles, axis=2, keepdims=True)
        (a, b, c), (d, e, f) = (x.transpose(1, 0, 2) for x in (corners, middles))
        split = np.stack([np.stack(t, 1) for t in ((a, d, f), (d, b, e), (f, e, c), (d, e, f))], 1).reshape(-1, 3)
        points, faces = np.unique(split, axis=0, return_inverse=True)
        faces = faces.reshape(-1, 3)
    uvs = np.stack([np.arctan2(points[:, 0], points[:, 2]), np.arcsin(np.clip(points[:, 1], -1, 1))], axis=1) * radius
    return Shape(points * radius, faces.astype(np.int32), uvs, points)


def tube(path: np.ndarray, radius: float | np.ndarray, segments: int = 8) -> Shape:
    """Return a closed round tube along ``path`` [k, 3]; ``radius`` may differ by point."""
    path = np.asarray(path, np.float64)
    radii = np.broadcast_to(radius, len(path))
    tangents = np.gradient(path, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    helper = np.eye(3)[np.abs(tangents).sum(axis=0).argmin()]
    side = np.cross(tangents, helper)
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(tangents, side)
    angle = np.linspace(0, 2 * math.pi, segments + 1)
    angle[-1] = 0.0
    ring = side[:, None] * np.cos(angle)[:, None] + up[:, None] * np.sin(angle)[:, None]
    grid = path[:, None] + radii[:, None, None] * ring
    ends = [np.broadcast_to(path[k], (1, segments + 1, 3)) for k in (0, -1)]
    return loft(np.concatenate([ends[0], grid, ends[1]])[:, ::-1])


def arch(width: float, height: float, radius: float, depth: float, segments: int = 24) -> Shape:
    """Return a wall panel with a round opening cut from below, closed all round.

    It spans x = +-width/2, y = 0 to ``height``, z = +-depth/2; the opening is the half disc of ``radius`` around
    the origin.
    """
    angle = np.linspace(math.pi, 0, segments + 1)
    opening = radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    opening[[0, -1], 1] = 0
    low = np.concatenate([[[-width / 2, 0]], opening, [[width / 2, 0]]])
    high = np.stack([low[:, 0], np.full(len(low), height)], axis=1)

    def at(points: np.ndarray, z: float) -> np.ndarray:
        return np.column_stack([points, np.full(len(points), z)])

    # the rows of a closed band: over the front's foot, its top, the back's top, the back's foot, and round again
    front, back = depth / 2, -depth / 2
    band = loft(np.stack([at(low, back), at(low, front), at(high, front), at(high, back), at(low, back)])[:, ::-1])
    ends = []
    for x, direction in ((-width / 2, 1.0), (width / 2, -1.0)):
        corner = (x, 0, -direction * depth / 2)
        ends.append(quad(corner, (0, 0, direction * depth), (0, height, 0)))
    return merge([band, *ends]).box_mapped()


def ribbon_ring(profile: Sequence[Sequence[float]], half_x: float, half_z: float, inward: bool = True) -> Shape:
    """Return a closed moulding around a rectangle of half sizes ``half_x``, ``half_z``, mitred at the corners.

    ``profile`` is a closed polygon of (projection, height), anticlockwise with projection to the right: projection
    runs towards the middle of the rectangle, or away from it if not ``inward``.
    """
    line = np.asarray([*profile, profile[0]], np.float64)
    sign = -1.0 if inward else 1.0
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1], [1, 1]])
    x = corners[:, :1] * (half_x + sign * line[:, 0])
    z = corners[:, 1:] * (half_z + sign * line[:, 0])
    grid = np.stack([x, np.broadcast_to(line[:, 1], x.shape), z], axis=-1)
    shape = loft(grid, crease=30.0)
    return (shape if inward else shape.flipped()).box_mapped()


def cloth_grid(
    width: float, height: float, columns: int = 32, rows: int = 24, seed: int = 0, folds: float = 0.06
) -> np.ndarray:
    """Return points [rows + 1, columns + 1, 3] of cloth that hangs from y = 0 to -height, spread along x around 0.

    Folds run down the cloth, and deepen downwards to about ``folds`` metres.
    """
    rng = np.random.default_rng(seed)
    s, t = np.meshgrid(np.linspace(0, 1, columns + 1), np.linspace(0, 1, rows + 1))
    waves = [(f, rng.uniform(0, 2 * math.pi), a) for f, a in ((3.0, 1.0), (5.0, 0.6), (8.0, 0.35))]
    depth = sum(a * np.sin(2 * math.pi * f * s * width / 1.6 + p + 0.8 * np.sin(3 * t + p)) for f, p, a in waves)
    x = (s - 0.5) * width * (1 - 0.06 * np.sin(math.pi * t) ** 2)
    return np.stack([x, -height * t, folds * depth * (0.35 + 0.65 * t)], axis=-1)


def volume(shape: Shape) -> float:
    """Return the signed volume; positive if a closed shape's faces wind outwards."""
    a, b, c = (shape.points[shape.indices[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)
