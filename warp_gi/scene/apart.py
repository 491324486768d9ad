"""Lights far brighter than they are large, which get a ray of their own: small suns of a sky, lights without size."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_gi.kernels import apart_lights
from warp_gi.scene.baked import BakedScene

if TYPE_CHECKING:
    from warp_gi.scene.scene import Scene

MOST_LIGHTS = 4
"""Lights without size that get a ray each, if all emitters are. Where there are more, or surfaces that emit, one of all
emitters is selected: by what it contributes, so that its light over its probability has little noise, which a selection
among the others alone would not have."""


@dataclass(frozen=True, eq=False)
class ApartLights:
    """The lights of a scene that are apart in a frame."""

    data: apart_lights.ApartData
    """What kernels read."""
    directions: np.ndarray
    """Unit directions towards the suns in world space, float64 [suns, 3]."""
    widths: np.ndarray
    """Half-angles of even discs as wide as the suns, radians, float64 [suns]."""


def has_apart_lights(scene: Scene | BakedScene) -> bool:
    """Return whether a scene has lights that would be apart; no tables are made."""
    return _light_count(scene) > 0 or (scene.environment is not None and scene.environment.has_small_suns)


def _light_count(scene: Scene | BakedScene) -> int:
    is_few = not isinstance(scene, BakedScene) and scene.emitter_count == len(scene.lights) <= MOST_LIGHTS
    return len(scene.lights) if is_few and not isinstance(scene, BakedScene) else 0


def apart_lights_of(
    scene: Scene | BakedScene, device: wp.Device, of_sky: bool = True, of_emitters: bool = True
) -> ApartLights | None:
    """Return the lights of a scene that are apart, of those of the sky and of emitters; None if there are none.

    The tables of a map are made once a device, for all rotations and scales of it.
    """
    data = apart_lights.ApartData()
    directions, widths = np.zeros((0, 3)), np.zeros(0)
    found = scene.environment.small_suns(device) if of_sky and scene.environment is not None else None
    if found is not None:
        tables, rest = found
        data.rest, data.sun_count = rest.data(device), len(tables.parts.nodes)
        data.suns, data.nodes, data.sums = tables.suns, tables.nodes, tables.sums
        directions = tables.parts.directions @ rest.world_from_environment.T
        widths = np.arccos(tables.parts.cos_discs)
    if of_emitters:
        data.light_count = _light_count(scene)
    if data.sun_count + data.light_count == 0:
        return None
    return ApartLights(data, directions, widths)
