"""Transfer textures on a device."""

from __future__ import annotations

import weakref
from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_gi.baking import Bake
from warp_gi.kernels.transfer_light import TransferRows
from warp_gi.kernels.transfer_products import LIGHT_WIDTH, WIDTHS
from warp_gi.launch import get_device, on_device
from warp_gi.scene.scene import Scene
from warp_gi.techniques.radiance_transfer.textures import transfer_textures
from warp_gi.techniques.shared.atlas.build import can_be_charted

LINE = 64
"""Bytes of a cache line."""


@dataclass(frozen=True, eq=False)
class TransferState:
    """A bake as kernels read it. It stays as it is over a sequence: the sky is apart."""

    rows: TransferRows
    """Atlas and rows."""
    bare_faces: np.ndarray
    """Faces whose fronts find no slot, int32 [n]: those that move among them."""
    needs_rays: bool = True
    """Whether a scene has surfaces whose light takes rays: what moves, what has no slots, or sharp lobes."""
    surfaces: str = ""
    """``Scene.light_hash`` of the scene that this is so of."""


_states: weakref.WeakKeyDictionary[Bake, dict[str, TransferState]] = weakref.WeakKeyDictionary()


def transfer_state(bake: Bake, device: str) -> TransferState:
    """Return a bake on a device; made once, for all terms that share it. Raises BakeError for another technique's."""
    known = _states.setdefault(bake, {})
    if device not in known:
        known[device] = _made(bake, get_device(device))
    return known[device]


def needs_rays(scene: Scene, bare_faces: np.ndarray, traced_below: float) -> bool:
    """Return whether something moves, lacks slots, or may be sharper than ``traced_below``.

    Faces without an area, as an atlas counts it, are never seen.
    """
    if scene.is_animated:
        return True
    for one in scene.materials:
        is_sharp = one.roughness < traced_below or one.metallic_roughness_texture is not None
        if traced_below > 0 and is_sharp and (one.specular > 0 or one.metallic > 0):
            return True
    flat = scene._flat
    return bool(can_be_charted(flat.points[flat.indices[bare_faces]].astype(np.float64)).any())


def _made(bake: Bake, device: wp.Device) -> TransferState:
    textures = transfer_textures(bake)
    order = round(textures.transfer.shape[1] ** 0.5)
    rows = TransferRows()
    rows.atlas = textures.atlas.on(device)
    rows.transfer = on_device(_padded(textures.transfer, WIDTHS[order]), wp.float16, device)
    rows.bounces = on_device(_padded(textures.bounces, LIGHT_WIDTH).reshape(-1, 3 * LIGHT_WIDTH), wp.float16, device)
    rows.lamps = on_device(textures.lamps, wp.vec3, device)
    return TransferState(rows, np.flatnonzero(~textures.atlas.has_fronts()).astype(np.int32))


def _padded(values: np.ndarray, width: int) -> np.ndarray:
    """Return ``values`` with zeros behind the last axis up to ``width``; rows of 64 bytes start at cache lines."""
    shape = (*values.shape[:-1], width)
    size = int(np.prod(shape)) * values.itemsize
    room = np.zeros(size + LINE, np.uint8)
    start = -room.ctypes.data % LINE
    result = room[start : start + size].view(values.dtype).reshape(shape)
    result[..., : values.shape[-1]] = values
    return result
