"""RayMeshIntersector: ray queries on a mesh of trimesh, with the interface of trimesh's own intersectors."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh
from trimesh import caching
from trimesh.ray.ray_util import contains_points

from warp_gi.bvh import TriangleBvh

# Lengths below are in units of the mesh's longest side, rounded up to a power of two.
STEP = 1e-6  # a ray goes on so far behind a hit, and what lies between counts as the same hit
BEHIND = 1e-9  # a surface so far behind a ray's origin is hit
ROUNDING = 1e-6  # by so much, at right angles to a triangle, may the tree's float32 distance be off
MARGIN = 0.01  # of the box to which rays are cut


class RayMeshIntersector:
    """Ray queries of trimesh by a ``TriangleBvh``: ``mesh.ray = gi.RayMeshIntersector(mesh)``.

    It answers as ``trimesh.ray.ray_pyembree.RayMeshIntersector``. The tree is built at the first query and again after
    an edit of the mesh. The mesh is moved to the origin and scaled by a power of two, and rays are cut to its box, both
    in float64, so neither large coordinates nor far origins cost digits. Locations are computed in float64.

    Along a ray each triangle is hit once. Hits closer together than 1e-6 of the mesh's longest side count as one: a ray
    through an edge or a vertex that triangles share hits one of them, and of coincident triangles one is hit. A surface
    at the origin of a ray is hit, one behind it is not. Triangles without area are never hit.

    Args:
        geometry: Mesh, a ``trimesh.Trimesh``.
        scale_to_box: Of no effect; trimesh's own intersectors have it.
        device: "cpu", "cuda", "cuda:1"...
        quality: Of the tree, as of ``TriangleBvh``.

    Rays are ``ray_origins`` and ``ray_directions``, both [ray, 3], of any length but 0: with that, or a number that is
    not finite, a ray hits nothing. Raises ValueError on other shapes.
    """

    def __init__(
        self, geometry: trimesh.Trimesh, scale_to_box: bool = True, device: str = "cpu", quality: str = "high"
    ) -> None:
        self.mesh = geometry
        self._given = scale_to_box, device, quality
        self._cache = caching.Cache(id_function=self.mesh.__hash__)

    def __getstate__(self) -> dict[str, Any]:
        return {"mesh": self.mesh, "given": self._given}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["mesh"], *state["given"])  # type: ignore[misc]

    def __copy__(self) -> RayMeshIntersector:
        return RayMeshIntersector(self.mesh, *self._given)

    def __deepcopy__(self, memo: object) -> RayMeshIntersector:
        return self.__copy__()

    def __repr__(self) -> str:
        return f"<RayMeshIntersector: {len(self.mesh.faces):,} triangles on {self._given[1]!r}>"

    def intersects_location(
        self, ray_origins: Any, ray_directions: Any, multiple_hits: bool = True
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return where rays hit, float64 [hit, 3], the index of each hit's ray and of its triangle, int64 [hit]."""
        faces, rays, locations = self._hits(ray_origins, ray_directions, 100 if multiple_hits else 1)
        return locations, rays, faces

    def intersects_id(
        self,
        ray_origins: Any,
        ray_directions: Any,
        multiple_hits: bool = True,
        max_hits: int = 100,
        return_locations: bool = False,
    ) -> tuple[np.ndarray, ...]:
        """Return the index of each hit's triangle and of its ray, int64 [hit], and where it is, float64 [hit, 3].

        Hits are in the order of rays, those of a ray from near to far, at most ``max_hits`` a ray; the closest alone
        unless ``multiple_hits``. Locations come if ``return_locations``.
        """
        faces, rays, locations = self._hits(ray_origins, ray_directions, max_hits if multiple_hits else 1)
        return (faces, rays, locations) if return_locations else (faces, rays)

    def intersects_first(self, ray_origins: Any, ray_directions: Any) -> np.ndarray:
        """Return the index of the closest triangle, int64 [ray]; -1 on a miss."""
        faces, rays, _ = self._hits(ray_origins, ray_directions, 1)
        first = np.full(len(ray_origins), -1, np.int64)
        first[rays] = faces
        return first

    def intersects_any(self, ray_origins: Any, ray_directions: Any) -> np.ndarray:
        """Return whether anything is hit, bool [ray]."""
        return self.intersects_first(ray_origins, ray_directions) >= 0

    def contains_points(self, points: Any) -> np.ndarray:
        """Return whether points [point, 3] are inside of a closed mesh, bool [point], by trimesh's count of hits."""
        return contains_points(self, points)

    @caching.cache_decorator
    def _tree(self) -> tuple[np.ndarray, float, tuple[np.ndarray, np.ndarray], np.ndarray, TriangleBvh]:
        """Centre and scale of the mesh; in the tree's units first corners and unit normals, box, tree."""
        corners = np.array(self.mesh.triangles, np.float64)
        low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
        size = float((high - low).max())
        scale = 2.0 ** np.ceil(np.log2(size)) if size > 0 else 1.0
        centre = 0.5 * (low + high)
        corners = (corners - centre) / scale
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
        points = (np.asarray(self.mesh.vertices, np.float64) - centre) / scale
        used = np.unique(self.mesh.faces)  # a vertex of no triangle may be anywhere
        faces = np.searchsorted(used, self.mesh.faces).astype(np.int32)
        tree = TriangleBvh(points[used].astype(np.float32), faces, self._given[1], quality=self._given[2])
        return centre, scale, (corners[:, 0].copy(), normals), 0.5 * (high - low) / scale + MARGIN, tree

    def _hits(self, origins: Any, directions: Any, most: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return triangles, rays and locations of up to ``most`` hits a ray, by ray and distance."""
        starts, ways = np.array(origins, np.float64), np.array(directions, np.float64)
        if starts.shape != ways.shape or starts.ndim != 2 or starts.shape[1] != 3:
            raise ValueError(
                f"ray origins and directions must both have shape [ray, 3], got {starts.shape} and {ways.shape}"
            )
        if len(self.mesh.faces) == 0 or len(starts) == 0:
            return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3))
        with np.errstate(all="ignore"):
            ways /= np.maximum(np.maximum(*np.abs(ways.T[:2])), np.abs(ways.T[2]))[:, None]  # no square overflows
            ways /= np.sqrt(np.einsum("ij,ij->i", ways, ways))[:, None]
        centre, scale, planes, box, tree = self._tree
        rays, faces, t = _walk(tree, planes, box, (starts - centre) / scale, ways, most)
        order = np.lexsort((t, rays))
        rays, faces = rays[order], faces[order]
        return faces, rays, starts[rays] + ways[rays] * (t[order] * scale)[:, None]


def _walk(
    tree: TriangleBvh,
    planes: tuple[np.ndarray, np.ndarray],
    box: np.ndarray,
    origins: np.ndarray,
    ways: np.ndarray,
    most: int,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rays, triangles and distances of up to ``most`` hits a ray: each query begins behind the hit before."""
    rays, begin, end = _cut(origins, ways, box)
    last: np.ndarray = np.full(len(rays), -np.inf)
    count: np.ndarray = np.zeros(len(rays), np.int64)
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    while len(rays) and most > 0:
        starts = origins[rays] + ways[rays] * begin[:, None]
        hits = tree.intersect(starts.astype(np.float32), ways[rays].astype(np.float32))
        faces = hits.face.numpy().astype(np.int64)
        hit = np.flatnonzero(faces >= 0)
        rays, begin, end, last, count, faces = (one[hit] for one in (rays, begin, end, last, count, faces))
        near = begin + hits.t.numpy()[hit]
        t = _distances(planes[0][faces] - origins[rays], planes[1][faces], ways[rays], near)
        is_new = (t > last + 0.5 * STEP) & (t >= -BEHIND)
        found.append((rays[is_new], faces[is_new], t[is_new]))
        # a hit that was counted already, or is behind the origin: float32 put the start of the query before it
        begin = np.where(is_new, t, near) + STEP
        last = np.where(is_new, t, last)
        count += is_new
        goes_on = (count < most) & (begin < end)
        rays, begin, end, last, count = (one[goes_on] for one in (rays, begin, end, last, count))
    if not found:
        return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0)
    every_ray, every_face, every_t = (np.concatenate(column) for column in zip(*found, strict=True))
    return every_ray, every_face, every_t


def _cut(origins: np.ndarray, ways: np.ndarray, box: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rays that reach the box around 0, and where in it they begin and end."""
    with np.errstate(all="ignore"):
        sides = np.stack([(-box - origins) / ways, (box - origins) / ways])
    (x, y, z), (a, b, c) = np.minimum(*sides).T, np.maximum(*sides).T
    near, far = np.maximum(np.maximum(x, y), z), np.minimum(np.minimum(a, b), c)
    begin = np.maximum(near, -STEP)
    # nan, and no ray, where a number is not finite or the ray runs in a side of the box, which has a margin
    rays = np.flatnonzero(begin < far)
    return rays, begin[rays], far[rays]


def _distances(first: np.ndarray, normals: np.ndarray, ways: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return distances to planes, by a point of each, counted from the ray's origin, and its unit normal.

    They are ``near``, those of the tree, where a triangle is edge-on.
    """
    across = np.einsum("ij,ij->i", ways, normals)
    with np.errstate(all="ignore"):
        t = np.einsum("ij,ij->i", first, normals) / across
        most = ROUNDING * np.maximum(1.0 / np.abs(across), 10.0)
    return np.where(np.isfinite(t) & (np.abs(t - near) <= most), t, near)
