"""Glass in scene files."""

import numpy as np

from warp_gi.scene.model import Material

GREY_STEP = 0.02
"""Difference between channels below which a colour is grey."""


def has_colored_tint(material: Material) -> bool:
    """Return whether light that goes through a material should take on a colour."""
    if not material.is_glass:
        return False
    texture = material.base_color_texture
    colors = np.asarray(material.base_color)
    if texture is not None:
        colors = colors * texture.pixels[..., :3].astype(np.float32) / 255.0
    return bool((np.ptp(colors, axis=-1) > GREY_STEP).any())
