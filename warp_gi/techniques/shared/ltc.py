"""The table of linearly transformed cosines on a device, for `warp_gi.kernels.ltc`; assets/fit_ltc.py made it."""

from __future__ import annotations

from functools import cache
from importlib.resources import files

import numpy as np
import warp as wp

from warp_gi.kernels.ltc import LtcTable
from warp_gi.launch import on_device


def ltc_table(device: wp.Device) -> LtcTable:
    """Return the table on a device; it is put there once."""
    return _table(device.alias)


@cache
def _table(alias: str) -> LtcTable:
    device = wp.get_device(alias)
    table = LtcTable()
    with (files("warp_gi.assets") / "ltc.npz").open("rb") as file, np.load(file) as arrays:
        table.size = len(arrays["matrices"])
        table.matrices = on_device(arrays["matrices"].reshape(-1, 4), wp.vec4, device)
        table.amplitudes = on_device(arrays["amplitudes"].reshape(-1, 2), wp.vec2, device)
    return table
