"""The atlas of a scene: pages of texels, and the slots on its surfaces in which something is kept."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_gi.kernels.atlas import SurfaceAtlas
from warp_gi.kernels.atlas_slots import AtlasSlots
from warp_gi.launch import on_device


@dataclass(frozen=True, eq=False)
class Atlas:
    """Where light is kept on the surfaces of a scene; ``kernels/atlas.py`` says how it is read.

    A slot is a place on one side of a surface. Those of the fronts come first.
    """

    corners: np.ndarray
    """Corners of faces in texels of their page, float32 [faces, 3, 2]; empty [0, 3, 2] for vertices."""
    face_pages: np.ndarray
    """Page of each face, int32 [faces]; -1 for faces without texels: degenerate ones, and those that move."""
    charts: np.ndarray
    """Chart of each face, int32 [faces], counted over all pages; -1 without one."""
    pages: np.ndarray
    """First texel, width and height of each page, int32 [pages, 3]."""
    slots: np.ndarray
    """Slot of each texel by side, int32 [2, texels]; -1 where nothing is kept."""
    corner_slots: np.ndarray
    """Slots of the corners of faces by side, int32 [2, faces, 3], for vertices; else empty [0, 0, 3]."""
    slot_faces: np.ndarray
    """Face on which each slot lies, int32 [slots]."""
    slot_points: np.ndarray
    """Barycentric coordinates u, v of each slot in its face, float32 [slots, 2]."""
    slot_sides: np.ndarray
    """Side of each slot, uint8 [slots]: 0 front, 1 back."""

    @property
    def count(self) -> int:
        """Number of slots."""
        return len(self.slot_faces)

    def has_fronts(self) -> np.ndarray:
        """Return whether a fetch in the middle of each face finds slots of its front, bool [faces]."""
        if self.corner_slots.size:
            return np.asarray((self.corner_slots[0] >= 0).any(axis=1))
        result = self.face_pages >= 0
        faces = np.flatnonzero(result)
        first, *size = self.pages[self.face_pages[faces]].T
        last = np.stack(size, axis=1) - 1
        low = np.clip(self.corners[faces].mean(axis=1) - 0.5, 0, last).astype(np.int32)
        high = np.minimum(low + 1, last)
        slots = [
            self.slots[0, first + y * size[0] + x] for y in (low[:, 1], high[:, 1]) for x in (low[:, 0], high[:, 0])
        ]
        result[faces] = np.max(slots, axis=0) >= 0
        return result

    def on(self, device: wp.Device) -> SurfaceAtlas:
        """Return the atlas as kernels read it."""
        result = SurfaceAtlas()
        result.corners = on_device(self.corners, wp.vec2, device)
        result.face_pages = on_device(self.face_pages, wp.int32, device)
        result.pages = on_device(self.pages, wp.vec3i, device)
        result.slots = on_device(self.slots, wp.int32, device)
        result.corner_slots = on_device(self.corner_slots, wp.vec3i, device)
        return result

    def slots_on(self, device: wp.Device) -> AtlasSlots:
        """Return the places of the slots as kernels read them."""
        slots = AtlasSlots()
        slots.faces = on_device(self.slot_faces, wp.int32, device)
        slots.points = on_device(self.slot_points, wp.vec2, device)
        slots.sides = on_device(self.slot_sides, wp.uint8, device)
        return slots


def page_coordinates(atlas: Atlas, faces: np.ndarray, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return where points (u, v) of faces are, each [point]: their page, and coordinates in it, float32 [point, 2].

    They are from 0 to 1, v down; page -1 where a face has none.
    """
    pages, corners = atlas.face_pages[faces], atlas.corners[faces]
    weights = np.stack([1.0 - u - v, u, v], axis=-1)[..., None]
    sizes = atlas.pages[np.maximum(pages, 0), 1:]
    return pages, ((corners * weights).sum(axis=1) / sizes).astype(np.float32)
