"""Rays of many cameras at once through a ``TriangleBvh``: depth, normals and triangles as arrays."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from warp_gi.bvh import TriangleBvh
from warp_gi.errors import OptionError
from warp_gi.scene.pinhole import Camera

RAYS_AT_ONCE = 1 << 22  # 24 bytes each on the way to the tree, and some 100 for the normals of those that hit


@dataclass(eq=False)
class CameraHits:
    """What cameras see at the centres of their pixels."""

    depth: np.ndarray
    """Metres along the view axis, float32 [camera, height, width]; infinite on a miss."""
    normal: np.ndarray
    """Unit normal of the triangle, on the side that is seen, float32 [camera, height, width, 3]; 0 on a miss."""
    face: np.ndarray
    """Index of the triangle, int32 [camera, height, width]; -1 on a miss."""


def trace_cameras(tree: TriangleBvh, cameras: Camera | Sequence[Camera], poses: Any = None) -> CameraHits:
    """Return depth, normals and triangle ids that many cameras see, by the closest hit at the centre of each pixel.

    Args:
        tree: Triangles.
        cameras: Cameras of one resolution; one camera alone with ``poses``. Perspective or orthographic.
        poses: Placements of that camera, [camera, 4, 4], as ``Camera.world_from_camera``; None for the cameras' own.

    The result has 20 bytes a pixel, on the host. Raises OptionError for no camera, different resolutions, ``poses`` of
    another shape or with several cameras, or a matrix that cannot be a placement.
    """
    every = _cameras(cameras, poses)
    width, height = every[0].resolution
    shape = len(every), height, width
    seen = CameraHits(np.empty(shape, np.float32), np.empty((*shape, 3), np.float32), np.empty(shape, np.int32))
    points, corners = tree.points, tree.indices
    for first, last in _shares(len(every), width * height):
        origins, ways = (one.reshape(-1, 3) for one in _rays(every[first:last]))
        hits = tree.intersect(origins, ways, coherent=True)
        face, rows = hits.face.numpy(), (last - first, height, width)
        is_hit = face >= 0
        axes = np.stack([-one.world_from_camera[:3, 2] for one in every[first:last]])
        along = (ways.reshape(last - first, -1, 3) @ axes[:, :, None]).reshape(-1)
        seen.depth[first:last] = np.where(is_hit, hits.t.numpy() * along, np.inf).reshape(rows)
        seen.face[first:last] = face.reshape(rows)
        normals = np.zeros((len(face), 3), np.float32)
        normals[is_hit] = _normals(points[corners[face[is_hit]]].astype(np.float64), ways[is_hit])
        seen.normal[first:last] = normals.reshape(*rows, 3)
    return seen


def _cameras(cameras: Camera | Sequence[Camera], poses: Any) -> list[Camera]:
    """Return the cameras, or the one camera in all poses."""
    every = [cameras] if isinstance(cameras, Camera) else list(cameras)
    if poses is not None:
        matrices = np.asarray(poses, np.float64)
        if len(every) != 1 or matrices.ndim != 3 or matrices.shape[1:] != (4, 4):
            raise OptionError(
                f"poses must have shape [camera, 4, 4] and go with one camera, got {list(matrices.shape)}"
                f" and {len(every)} cameras"
            )
        every = [replace(every[0], world_from_camera=matrix) for matrix in matrices]
    if not every:
        raise OptionError("expected at least one camera, got none")
    sizes = sorted({one.resolution for one in every})
    if len(sizes) > 1:
        raise OptionError(
            f"cameras traced at once must have one resolution, got {sizes[0]} and {sizes[-1]}: trace them apart, or"
            " use Camera.at_resolution"
        )
    return every


def _shares(count: int, pixels: int) -> Iterator[tuple[int, int]]:
    """Yield ranges of cameras that are traced at once."""
    step = max(RAYS_AT_ONCE // pixels, 1)
    for first in range(0, count, step):
        yield first, min(first + step, count)


def _rays(cameras: list[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Return origins and unit directions through the centres of all pixels, float32 [camera, pixel, 3] both."""
    width, height = cameras[0].resolution
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    pixels = np.stack([x.ravel(), y.ravel()], axis=1)
    origins, ways = (np.empty((len(cameras), len(pixels), 3), np.float32) for _ in range(2))
    lenses: dict[tuple[object, ...], tuple[np.ndarray, np.ndarray]] = {}
    for i, camera in enumerate(cameras):
        if camera.lens not in lenses:
            unplaced = replace(camera, world_from_camera=np.eye(4))
            lenses[camera.lens] = unplaced.origins(pixels), unplaced.directions(pixels)
        starts, aims = lenses[camera.lens]
        axes = camera.world_from_camera[:3, :3]
        # einsum takes a tenth of the time of a product of matrices that are three columns wide
        ways[i] = np.einsum("ij,kj->ik", aims, axes)
        is_plane = camera.is_orthographic
        origins[i] = np.einsum("ij,kj->ik", starts, axes) + camera.position if is_plane else camera.position
    return origins, ways


def _normals(corners: np.ndarray, ways: np.ndarray) -> np.ndarray:
    """Return unit normals of triangles [hit, 3, 3] against rays' directions."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals *= np.where((normals * ways).sum(axis=1) > 0.0, -1.0, 1.0)[:, None]
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)
