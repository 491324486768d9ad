"""Bounds of emitters: what a tree of lights knows of each of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_gi.color import LUMINANCE
from warp_gi.kernels import types
from warp_gi.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class EmitterBounds:
    """What a tree knows of each emitter. Of directional lights, only ``directional`` and ``flux`` are read."""

    low: np.ndarray
    """float64 [emitter, 3]: lowest corner of the emitter's box, metres."""
    high: np.ndarray
    """float64 [emitter, 3]: highest corner of the emitter's box, metres."""
    axis: np.ndarray
    """float64 [emitter, 3]: unit vector, the direction that the emitter faces."""
    facing: np.ndarray
    """float64 [emitter]: half angle of the cone of directions that the emitter faces (theta_o), radians."""
    falloff: np.ndarray
    """float64 [emitter]: angle beyond that cone at which the emitter still shines (theta_e), radians."""
    power: np.ndarray
    """float64 [emitter]: luminance of the intensity straight ahead, W/sr; an emitter of 0 is never selected."""
    directional: np.ndarray
    """bool [emitter]: whether the light is directional, without a place."""
    flux: np.ndarray
    """float64 [emitter]: W, which decides between directional lights, and between those and the tree."""

    @property
    def in_tree(self) -> np.ndarray:
        """int64 [light]: emitters that a tree holds."""
        return np.flatnonzero(~self.directional & (self.power.astype(np.float32) > 0.0))


def emitter_bounds(scene: Scene, device: str | wp.Device) -> EmitterBounds:
    """Return the bounds of a scene's emitters in the pose that its data on ``device`` are in."""
    placed = scene.placed_emitters(device)
    table = placed.table
    count = len(table)
    kind, flux = table["kind"], scene.emitter_powers()
    low = table["position"].astype(np.float64)
    high, axis = low.copy(), table["direction"].astype(np.float64)
    facing, falloff = np.zeros(count), np.full(count, np.pi / 2)
    power = table["intensity"].astype(np.float64) @ LUMINANCE  # straight ahead

    corners, both = placed.corners, placed.two_sided
    triangles = np.arange(len(corners))
    low[triangles], high[triangles] = corners.min(axis=1), corners.max(axis=1)
    axis[triangles] = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing[triangles[both]] = np.pi
    power[triangles] = flux[triangles] / np.where(both, 2 * np.pi, np.pi)
    points = kind == types.EMITTER_POINT
    facing[points] = np.pi
    spots = kind == types.EMITTER_SPOT
    inner = np.arccos(np.clip(table["cos_inner"][spots].astype(np.float64), -1, 1))
    outer = np.arccos(np.clip(table["cos_outer"][spots].astype(np.float64), -1, 1))
    facing[spots], falloff[spots] = inner, outer - inner
    return EmitterBounds(low, high, unit_vectors(axis), facing, falloff, power, kind == types.EMITTER_DIRECTIONAL, flux)


# ---- vectors ----


def lengths_of(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("...i,...i->...", vectors, vectors))


def unit_vectors(vectors: np.ndarray) -> np.ndarray:
    """Return vectors of length 1; those of length 0 become +y."""
    length = lengths_of(vectors)
    unit = vectors / np.where(length > 0, length, np.inf)[..., None]
    unit[..., 1] += length == 0
    return unit


def angles_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the angles between unit vectors; exact for small ones too."""
    return 2 * np.arctan2(lengths_of(a - b), lengths_of(a + b))
