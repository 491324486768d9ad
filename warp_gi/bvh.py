"""TriangleBvh: any-hit and closest-hit ray queries on triangles, on the CPU and on CUDA."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

import numpy as np
import warp as wp

from warp_gi import launch, wide_tree
from warp_gi.errors import SceneError, check_near, unknown_name
from warp_gi.kernels import bvh_native as layout
from warp_gi.kernels import bvh_packets as packets
from warp_gi.kernels import bvh_rays as batch
from warp_gi.kernels import types

ORDERED_RAYS = 1 << 15  # rays are ordered before they are traced if a batch has at least so many
ORDERED_BYTES = 1 << 25  # and the tree has at least so many bytes
SHARE = 256  # rays that a thread traces on the CPU
NO_GLASS = (0.0, -1, 0.0, 0.0)


@dataclass(eq=False)
class AlphaMasks:
    """Triangles that let rays pass, where bilinear alpha times factor is below a cutoff, or by chance where it is below
    1: with the probability 1 - alpha, which a hash of the ray decides (kernels/bvh_native.py)."""

    face_mask: np.ndarray
    """Index in ``masks`` of each triangle's mask, int32 [triangle]; -1 is opaque."""
    masks: Sequence[tuple[int, float, float | None]]
    """Masks as (index in ``textures``, or -1 for alpha 1; factor on alpha; cutoff, or None for chance)."""
    uvs: np.ndarray
    """Texture coordinates, float32 [vertex, 2], v up."""
    textures: wp.array
    """Textures that masks look up, kernels.types.Texture [texture], on the tree's device."""
    texels: wp.array
    """Texels of all textures, uint32 RGBA8 [texel] with red in the low byte, on the tree's device."""
    alphas: np.ndarray | None = None
    """Coverage of vertices, multiplied with that of textures, float32 [vertex]; None is 1."""
    glass: Mapping[int, tuple[float, int, float, float]] = field(default_factory=dict)
    """Masks, by their index, of surfaces that light goes straight through: (share of it, index of the texture whose
    alpha is a factor on it or -1, reflectance at normal incidence, reflectance at grazing angles)."""

    def __reduce__(self) -> tuple[Any, ...]:
        given = [getattr(self, one.name) for one in fields(self)]
        device = str(self.textures.device)
        return _masks, (device, *(one.numpy() if isinstance(one, wp.array) else one for one in given))


def _masks(device: str, *given: Any) -> AlphaMasks:
    """Return masks on a device, of arrays that were on one."""
    target, names = launch.get_device(device), [one.name for one in fields(AlphaMasks)]
    values = dict(zip(names, given, strict=True))
    values["textures"] = launch.on_device(values["textures"], types.Texture, target)
    values["texels"] = launch.on_device(values["texels"], wp.uint32, target)
    return AlphaMasks(**values)


@dataclass(eq=False)
class Hits:
    """Closest hits, one for each ray. The point is (1 - u - v) p0 + u p1 + v p2 in index-buffer order."""

    t: wp.array
    """Distance along the ray, float32 [ray], in units of the direction's length; t_max on a miss."""
    face: wp.array
    """Index of the triangle that was hit, int32 [ray]; -1 on a miss."""
    u: wp.array
    """Barycentric weight of the triangle's second vertex, float32 [ray]."""
    v: wp.array
    """Barycentric weight of the triangle's third vertex, float32 [ray]."""


class TriangleBvh:
    """A tree over triangles for ray queries; ``data`` is the struct that kernels take (see kernels/bvh.py).

    Args:
        points: Vertex positions [m], shape [vertex, 3], float32. NumPy, Warp or anything with ``__dlpack__``.
        indices: Vertices of each triangle, shape [triangle, 3], int32.
        device: "cpu", "cuda", "cuda:1"...
        alpha: Triangles with holes, or None.
        quality: Of the tree on the CPU: "high" improves it by reinsertion, "fast" is built in about half the time, and
            its rays are a tenth slower on average. CUDA has one quality.

    Zero-area triangles are never hit. Raises SceneError when there are no triangles, a vertex is not finite, an
    index is out of range or a shape is wrong, OptionError for an unknown device or quality.
    """

    def __init__(
        self,
        points: object,
        indices: object,
        device: str = "cpu",
        alpha: AlphaMasks | None = None,
        quality: str = "high",
    ) -> None:
        if quality not in wide_tree.QUALITIES:
            raise unknown_name("quality", quality, wide_tree.QUALITIES)
        self.quality = quality
        self.device = launch.get_device(device)
        corners = _checked_indices(indices)
        positions = _checked_points(points)
        low, high = int(corners.min()), int(corners.max())
        if low < 0 or high >= len(positions):
            raise SceneError(
                f"triangle indices must be in 0 to {len(positions) - 1}, got {low if low < 0 else high}: "
                "check the index buffer"
            )
        self.triangle_count = len(corners)
        self.vertex_count = len(positions)
        self.data = types.Bvh()
        self._positions: wp.array = wp.array(positions, dtype=wp.vec3, device=self.device)
        self._indices: wp.array = wp.array(corners.astype(np.int32), dtype=wp.vec3i, device=self.device)
        self._alpha = alpha
        if alpha is not None:
            self._set_alpha(alpha)
        if self.device.is_cpu:
            wide_tree.build(self.data, self._positions, self._indices, quality)
            self._fill()
        else:
            self._mesh = _make_mesh(self._positions, corners, positions)
            self.data.mesh = self._mesh.id

    def __reduce__(self) -> tuple[Any, ...]:
        arrays = self._positions.numpy(), self._indices.numpy()
        return TriangleBvh, (*arrays, self.device.alias, self._alpha, self.quality)

    def __repr__(self) -> str:
        return f"<TriangleBvh: {self.triangle_count:,} triangles on {self.device.alias!r}>"

    @property
    def memory_bytes(self) -> int:
        """Bytes of the tree itself, without vertices, indices and textures."""
        if self.device.is_cpu:
            return self.data.nodes.capacity + self.data.blocks.capacity + self.data.parents.capacity
        return 3 * 32 * self.triangle_count  # wp.Mesh: two binary nodes and the bounds of each triangle

    @property
    def points(self) -> np.ndarray:
        """Vertex positions in metres as of the last refit, float32 [vertex, 3], on the host; only to read."""
        return self._positions.numpy()

    @property
    def indices(self) -> np.ndarray:
        """Vertices of each triangle, int32 [triangle, 3], on the host; only to read."""
        return self._indices.numpy()

    def set_alpha(self, alpha: AlphaMasks | None) -> None:
        """Replace the triangles with holes; None is none. Raises SceneError for masks that do not fit the triangles."""
        self._alpha = alpha
        empty = types.Bvh()
        for name in ("face_masks", "masks", "points", "uvs", "alphas", "indices", "textures", "texels", "chance"):
            setattr(self.data, name, getattr(empty, name))
        if alpha is not None:
            self._set_alpha(alpha)
        if self.device.is_cpu:
            self._fill()

    def refit(self, points: object) -> None:
        """Move the vertices; same shape and triangles. Queries slow down as motion departs from the built pose."""
        positions = _checked_points(points)
        if len(positions) != self.vertex_count:
            raise SceneError(f"refit expects {self.vertex_count} vertices, got {len(positions)}: build a new tree")
        self._positions.assign(positions)
        if self.device.is_cpu:
            self._fill()
        else:
            self._mesh.refit()

    def occluded(self, origins: object, directions: object, t_max: object = np.inf, coherent: bool = False) -> wp.array:
        """Return uint8 [ray]: 1 where something lies at 0 < t < t_max.

        ``origins`` and ``directions`` are float32 [ray, 3], ``t_max`` a number or float32 [ray], in units of the
        direction's length. ``coherent`` says that each sixteen neighbours start near each other and go the same way,
        as camera rays do and shadow rays to a point light: the CPU traces them together, with the same results.
        Raises SceneError on other shapes.
        """
        rays = self._rays(origins, directions, t_max)
        count = len(rays.origins)
        result = wp.empty(count, dtype=wp.uint8, device=self.device)
        self._trace(packets.occluded_packets if coherent else batch.occluded_rays, rays, result)
        return result

    def intersect(self, origins: object, directions: object, t_max: object = np.inf, coherent: bool = False) -> Hits:
        """Return the closest hits at 0 < t < t_max; arguments and errors as ``occluded``."""
        rays = self._rays(origins, directions, t_max)
        count = len(rays.origins)
        hits = batch.RayHits()
        hits.t, hits.u, hits.v = (wp.empty(count, dtype=wp.float32, device=self.device) for _ in range(3))
        hits.face = wp.empty(count, dtype=wp.int32, device=self.device)
        self._trace(packets.intersect_packets if coherent else batch.intersect_rays, rays, hits)
        return Hits(hits.t, hits.face, hits.u, hits.v)

    def _trace(self, kernel: wp.Kernel, rays: batch.RayBatch, found: object) -> None:
        share = SHARE if self.device.is_cpu else 1
        launch.launch(kernel, -(-len(rays.origins) // share), [self.data, rays, share, found], self.device, 1)

    def _rays(self, origins: object, directions: object, t_max: object) -> batch.RayBatch:
        rays = batch.RayBatch()
        rays.origins = _vectors(origins, "ray origins", self.device)
        rays.directions = _vectors(directions, "ray directions", self.device)
        count = len(rays.origins)
        if count != len(rays.directions):
            raise SceneError(f"expected as many ray directions as origins ({count}), got {len(rays.directions)}")
        limits: Any = t_max if isinstance(t_max, wp.array) else np.atleast_1d(_as_numpy(t_max)).astype(np.float32)
        if limits.ndim != 1 or len(limits) not in (1, count):
            raise SceneError(f"t_max must be a number or one for each of {count} rays, got shape {limits.shape}")
        rays.t_max = wp.array(limits, dtype=wp.float32, device=self.device, copy=False)
        if self.device.is_cpu and count >= ORDERED_RAYS and self.memory_bytes >= ORDERED_BYTES:
            rays.order = self._order(rays.origins)
        return rays

    def _order(self, origins: wp.array) -> wp.array | None:
        """Return the rays' order along a Morton curve; None if neighbours mostly start in the same cell already."""
        low, high = self._bounds
        scale = 31.99 / max(float((high - low).max()), 1e-30)
        sample = origins.numpy()[:: max(len(origins) // 2048, 2)], origins.numpy()[1 :: max(len(origins) // 2048, 2)]
        cells = [np.nan_to_num((some[: len(sample[1])] - low) * scale).clip(0, 31).astype(np.int32) for some in sample]
        if (cells[0] == cells[1]).all(axis=1).mean() > 0.5:
            return None
        keys = wp.empty(len(origins), dtype=wp.uint16, device=self.device)
        launch.launch(batch.order_keys, len(origins), [origins, wp.vec3(*low.tolist()), scale, keys], self.device)
        return wp.array(np.argsort(keys.numpy(), kind="stable"), dtype=wp.int64, device="cpu", copy=False)

    def _set_alpha(self, alpha: AlphaMasks) -> None:
        face_mask = np.ascontiguousarray(alpha.face_mask, dtype=np.int32)
        uvs = np.ascontiguousarray(alpha.uvs, dtype=np.float32)
        if face_mask.shape != (self.triangle_count,) or face_mask.max() >= len(alpha.masks):
            raise SceneError(
                f"face_mask must hold {self.triangle_count} indices below {len(alpha.masks)}, got shape "
                f"{face_mask.shape} with maximum {face_mask.max(initial=-1)}"
            )
        if uvs.shape != (self.vertex_count, 2) or not np.isfinite(uvs).all():
            raise SceneError(f"uvs must be {self.vertex_count} finite pairs, got shape {uvs.shape}")
        masks = np.zeros(len(alpha.masks), dtype=types.AlphaMask.numpy_dtype())
        for i, (texture, factor, cutoff) in enumerate(alpha.masks):
            if not -1 <= texture < len(alpha.textures):
                raise SceneError(f"alpha mask {i} names texture {texture}, but there are {len(alpha.textures)}")
            masks[i] = (texture, factor, -1.0 if cutoff is None else cutoff, *alpha.glass.get(i, NO_GLASS))
        self.data.face_masks = wp.array(face_mask, dtype=wp.int32, device=self.device)
        self.data.masks = wp.array(masks, dtype=types.AlphaMask, device=self.device)
        self.data.chance = int(bool((masks["cutoff"] < 0.0).any() or alpha.glass))
        if alpha.glass:
            self.data.points = self._positions
        self.data.uvs = wp.array(uvs, dtype=wp.vec2, device=self.device)
        if alpha.alphas is not None:
            self.data.alphas = wp.array(np.asarray(alpha.alphas, np.float32), dtype=wp.float32, device=self.device)
        self.data.indices = self._indices
        self.data.textures = alpha.textures
        self.data.texels = alpha.texels

    def _fill(self) -> None:
        points = self._positions.numpy()
        self._bounds = points.min(axis=0), points.max(axis=0)
        wide_tree.fill(self.data, self._positions, self._indices)


def _make_mesh(points: wp.array, corners: np.ndarray, positions: np.ndarray) -> wp.Mesh:
    """Return the wp.Mesh of the CUDA path, its zero-area triangles shrunk to a point, which no ray hits."""
    a, b, c = (positions[corners[:, k]].astype(np.float64) for k in range(3))
    flat = np.logical_not(np.cross(b - a, c - a).any(axis=1))
    corners = np.where(flat[:, None], corners[:, :1], corners)
    device = wp.get_device(points.device)
    indices: wp.array = wp.array(np.ascontiguousarray(corners, dtype=np.int32).ravel(), dtype=wp.int32, device=device)
    if device.is_cpu:
        return wp.Mesh(points, indices, bvh_constructor="sah", bvh_leaf_size=4)
    return wp.Mesh(points, indices)


def _as_numpy(value: object) -> np.ndarray:
    if isinstance(value, np.ndarray):
        return value
    if isinstance(value, wp.array):
        return value.numpy()
    if hasattr(value, "__dlpack__"):
        shared: Any = wp.from_dlpack(value)
        return shared.numpy()
    return np.asarray(value)


def _vectors(value: object, name: str, device: wp.Device) -> wp.array:
    if isinstance(value, wp.array) and value.dtype is wp.vec3 and value.ndim == 1 and value.is_contiguous:
        return value.to(device)
    vectors = _as_numpy(value)
    if vectors.ndim != 2 or vectors.shape[1] != 3:
        raise SceneError(f"{name} must have shape [ray, 3], got {list(vectors.shape)}")
    return wp.array(np.ascontiguousarray(vectors, dtype=np.float32), dtype=wp.vec3, device=device, copy=False)


def _checked_points(points: object) -> np.ndarray:
    positions = _as_numpy(points)
    if positions.ndim != 2 or positions.shape[1] != 3:
        raise SceneError(f"points must have shape [vertex, 3], got {list(positions.shape)}")
    if len(positions) == 0:
        raise SceneError("expected at least one vertex, got none")
    positions = np.ascontiguousarray(positions, dtype=np.float32)
    if not np.isfinite(positions).all():
        bad = int(np.flatnonzero(~np.isfinite(positions).all(axis=1))[0])
        raise SceneError(f"vertex positions must be finite, but vertex {bad} is {positions[bad].tolist()}")
    check_near(positions)
    return positions


def _checked_indices(indices: object) -> np.ndarray:
    corners = _as_numpy(indices)
    if corners.size == 0:
        raise SceneError("expected at least one triangle, got none")
    if corners.ndim != 2 or corners.shape[1] != 3 or corners.dtype.kind not in "iu":
        raise SceneError(
            f"indices must be whole numbers of shape [triangle, 3], got {corners.dtype} {list(corners.shape)}"
        )
    if len(corners) >= layout.FACE_MASKED:
        raise SceneError(f"expected fewer than {layout.FACE_MASKED} triangles, got {len(corners)}")
    return np.ascontiguousarray(corners.astype(np.int64))
