"""Panes of coloured glass, whose tint rays carry on."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from warp_gi.kernels import types
from warp_gi.launch import on_device
from warp_gi.scene.geometry import FlatGeometry
from warp_gi.scene.model import Material

GREY = 1e-3
"""Largest difference between channels of a tint that counts as none."""


class Panes:
    """The triangles of coloured glass on a device, with a tree of their boxes; ``data`` is what kernels read."""

    def __init__(self, flat: FlatGeometry, materials: Sequence[Material], device: wp.Device) -> None:
        colored = np.array([has_colored_tint(material) for material in materials])
        self._faces = np.flatnonzero(colored[flat.materials]).astype(np.int32)
        self._corners = flat.indices[self._faces]
        self.data = types.Panes()
        self.data.faces = on_device(self._faces, wp.int32, device)
        self.data.count = len(self._faces)
        self._tree: wp.Bvh | None = None
        if len(self._faces):
            low, high = (on_device(side, wp.vec3, device) for side in self._boxes(flat.points))
            self._tree = wp.Bvh(low, high)
            self.data.bvh = self._tree.id

    def refit(self, points: np.ndarray) -> None:
        """Move the panes with the scene's vertices, float32 [vertex, 3]."""
        if self._tree is not None:
            for side, values in zip((self._tree.lowers, self._tree.uppers), self._boxes(points), strict=True):
                side.assign(values)
            self._tree.refit()

    def _boxes(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return lowest and highest corners, float32 [pane, 3], larger than the triangles by more than rounding."""
        corners = points[self._corners]
        low, high = corners.min(axis=1), corners.max(axis=1)
        margin = 1e-5 * (np.abs(corners).max(axis=(1, 2)) + (high - low).max(axis=1))[:, None] + np.float32(1e-9)
        return np.ascontiguousarray(low - margin, np.float32), np.ascontiguousarray(high + margin, np.float32)


def has_colored_tint(material: Material) -> bool:
    """Return whether light that goes through a material has another colour behind it."""
    if not material.is_glass:
        return False
    texture = material.base_color_texture
    colors = np.asarray(material.base_color)
    if texture is not None:
        colors = colors * texture.pixels[..., :3].astype(np.float32) / 255.0
    return bool((np.ptp(colors, axis=-1) > GREY).any())
