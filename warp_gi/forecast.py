"""One line before a bake that takes long: what it will cost, and after how many frames it pays at the earliest."""

from __future__ import annotations

import logging
import math
from typing import TYPE_CHECKING

from warp_gi.stateful import Stateful

if TYPE_CHECKING:
    import warp as wp

    from warp_gi.scene.camera import Camera, CameraPath
    from warp_gi.scene.scene import Scene

_LOG = logging.getLogger("warp_gi")


def tell_cost(
    part: Stateful,
    scene: Scene,
    device: wp.Device,
    seed: int,
    camera: Camera | CameraPath,
    samples: int,
    frames: int | None,
) -> None:
    """Log a line about the bake that a part is about to make (logger "warp_gi", level INFO), if it takes long.

    ``samples`` are those of a pixel in each frame; ``frames`` is how many the run has, None being unknown.
    """
    found = part.forecast(scene, device, seed, camera, samples)
    if found is None:
        return
    text = f"bake of {type(part).__name__}: about {found.bake_seconds:.0f} CPU s"
    if found.most_saved > 0:
        least = math.ceil(found.bake_seconds / found.most_saved)
        text += f"; it saves at most {found.most_saved:.2g} CPU s a frame, so it pays after {least} frames or more"
        text += "" if frames is None else f"; this run has {frames}"
    _LOG.info(text)
