"""What a bake of radiance transfer holds: an atlas, and rows of numbers for its slots."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from warp_gi.baking import Bake
from warp_gi.errors import BakeError
from warp_gi.kernels.transfer_snippets import LIGHT_NUMBERS
from warp_gi.techniques.shared.atlas.atlas import Atlas

TECHNIQUE = "RadianceTransfer"


@dataclass(frozen=True, eq=False)
class TransferTextures:
    """Transfer at each slot of an atlas, as a bake holds it."""

    atlas: Atlas
    transfer: np.ndarray
    """T_j = int V max(n.w, 0) y_j dw [sr], float16 [slots, order^2]."""
    bounces: np.ndarray
    """Sums over bounces of the transfer of reflected light by channel, float16 [slots, 3, 25]; or [0, 3, 25]."""
    lamps: np.ndarray
    """Irradiance by light of the scene's emitters that was reflected before, float32 [slots, 3]; or [0, 3]."""

    def arrays(self) -> dict[str, np.ndarray]:
        """Return all arrays by name, for a Bake."""
        atlas = {f"atlas_{name}": array for name, array in vars(self.atlas).items()}
        return {**atlas, "transfer": self.transfer, "bounces": self.bounces, "lamps": self.lamps}


def transfer_textures(bake: Bake) -> TransferTextures:
    """Return what a bake holds; raises BakeError for a bake of another technique."""
    if bake.technique != TECHNIQUE:
        raise BakeError(f"expected a bake of {TECHNIQUE}, got one of {bake.technique}")
    try:
        atlas = Atlas(**{name: bake.arrays[f"atlas_{name}"] for name in Atlas.__dataclass_fields__})
        textures = TransferTextures(atlas, bake.arrays["transfer"], bake.arrays["bounces"], bake.arrays["lamps"])
        is_whole = _is_whole(textures)
    except (KeyError, IndexError, TypeError, ValueError):
        is_whole = False
    if not is_whole:
        raise BakeError(
            f"this bake of {bake.scene_name!r} does not hold transfer textures that fit together: bake again"
        )
    return textures


def _is_whole(textures: TransferTextures) -> bool:
    """Return whether arrays have their shapes and types, and no index leads out of them."""
    atlas, count = textures.atlas, textures.atlas.count
    faces, pages = len(atlas.face_pages), atlas.pages.astype(np.int64)
    at_vertices = atlas.corner_slots.size > 0
    wanted = {
        "corners": (np.float32, (0 if at_vertices else faces, 3, 2)),
        "face_pages": (np.int32, (faces,)),
        "charts": (np.int32, (faces,)),
        "pages": (np.int32, (len(pages), 3)),
        "slots": (np.int32, (2, atlas.slots.shape[1])),
        "corner_slots": (np.int32, (2, faces, 3) if at_vertices else (0, 0, 3)),
        "slot_faces": (np.int32, (count,)),
        "slot_points": (np.float32, (count, 2)),
        "slot_sides": (np.uint8, (count,)),
    }
    has_shape = all(
        getattr(atlas, name).dtype == dtype and getattr(atlas, name).shape == shape
        for name, (dtype, shape) in wanted.items()
    )
    rows = textures.transfer, textures.bounces, textures.lamps
    has_rows = (
        [array.dtype for array in rows] == [np.float16, np.float16, np.float32]
        and textures.transfer.shape in ((count, 25), (count, 36))
        and textures.bounces.shape in ((count, 3, LIGHT_NUMBERS), (0, 3, LIGHT_NUMBERS))
        and textures.lamps.shape in ((count, 3), (0, 3))
    )
    return (
        has_shape
        and has_rows
        and bool(np.isfinite(atlas.corners).all() and (atlas.slot_sides <= 1).all())
        and _within(atlas.face_pages, -1, len(pages))
        and _within(atlas.slots, -1, count)
        and _within(atlas.corner_slots, -1, count)
        and _within(atlas.slot_faces, 0, faces)
        and bool((pages[:, 1:] > 0).all() and (pages[:, 0] >= 0).all())
        and bool((pages[:, 0] + pages[:, 1] * pages[:, 2] <= atlas.slots.shape[1]).all())
    )


def _within(indices: np.ndarray, low: int, end: int) -> bool:
    """Return whether all indices are at least ``low`` and below ``end``."""
    return indices.size == 0 or bool(indices.min() >= low and indices.max() < end)
