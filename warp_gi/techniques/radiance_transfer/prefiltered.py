"""The sky seen through glossy lobes without occluders: maps of it, prefiltered by roughness, and where to read them.

Coefficients of transfer cut the sky at 25 numbers. The ratio form keeps them for occlusion alone: a pixel's light is
the prefiltered sky, times what transfer says of it with occluders over what it says without.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache

import numpy as np
import warp as wp

from warp_gi.launch import on_device
from warp_gi.scene import harmonics
from warp_gi.scene.environment import Environment
from warp_gi.techniques.radiance_transfer.lobes import COLUMNS, ROUGHNESSES, SMALLEST_ROUGHNESS, ggx_directions

LEVELS = 12
"""Maps of a PrefilteredSky, of roughnesses from SMALLEST_ROUGHNESS to 1 in equal ratios."""
ROWS = 64
"""Rows of each map."""
_ORDER = 64  # of the harmonics that filter; the lobe of the smallest roughness keeps 0.02 of the highest band


@dataclass(frozen=True, eq=False)
class PrefilteredSky:
    """Radiance averaged over the lobe of GGX about each direction, seen along the normal, by roughness."""

    levels: np.ndarray
    """W/(m^2 sr), float32 [LEVELS, ROWS, 2 * ROWS, 3]: latitude-longitude maps as ``Environment`` reads them, in the
    sky's own space and without its scale."""
    _arrays: dict[str, wp.array] = field(default_factory=dict, repr=False)

    def on(self, device: wp.Device) -> wp.array:
        """Return the texels of all levels on a device, vec3 [LEVELS * ROWS * 2 * ROWS]; uploaded once."""
        if device.alias not in self._arrays:
            self._arrays[device.alias] = on_device(self.levels.reshape(-1, 3), wp.vec3, device)
        return self._arrays[device.alias]

    def at(self, directions: np.ndarray, level: np.ndarray | float) -> np.ndarray:
        """Return the radiance at unit directions [..., 3] of the sky's own space, float64 [..., 3], as kernels read it.

        ``level`` [...] is that of a ``sky_lookups`` entry. Linear between levels and between the nodes of a map.
        """
        x, y, z = np.moveaxis(np.asarray(directions, np.float64), -1, 0)
        u = np.arctan2(x, -z) / (2 * np.pi) % 1.0 * (2 * ROWS) - 0.5
        v = np.arctan2(np.hypot(x, z), y) / np.pi * (ROWS - 1)
        level = np.broadcast_to(np.clip(level, 0, LEVELS - 1), u.shape)
        k, i, j = (
            np.minimum(level.astype(int), LEVELS - 2),
            np.clip(v.astype(int), 0, ROWS - 2),
            np.floor(u).astype(int),
        )
        result = np.zeros((*u.shape, 3))
        for a, weight_a in ((0, 1 - (level - k)), (1, level - k)):
            for b, weight_b in ((0, 1 - (v - i)), (1, v - i)):
                for c, weight_c in ((0, 1 - (u - j)), (1, u - j)):
                    weight = (weight_a * weight_b * weight_c)[..., None]
                    result += weight * self.levels[k + a, i + b, (j + c) % (2 * ROWS)]
        return result


def prefiltered(sky: Environment) -> PrefilteredSky:
    """Return the prefiltered maps of a sky, once for all of its rotations and scales; about 0.1 s for 1024x512.

    By spherical harmonics of order 64 about the map's own axis: a lobe about each direction multiplies their bands.
    What swings below 0 beside a bright sun is cut at 0; so take the sky without it (``Environment.split_sun``).
    """
    found = sky.once_a_map("radiance transfer: prefiltered", _prefilter)
    if found is None:
        color = np.array(sky.color or (0.0, 0.0, 0.0), np.float32)
        found = PrefilteredSky(np.broadcast_to(color, (LEVELS, ROWS, 2 * ROWS, 3)).copy())
    return found


@cache
def sky_lookups() -> np.ndarray:
    """Return where to read a PrefilteredSky, float32 [ROUGHNESSES, COLUMNS, 3]: sine, cosine, level.

    Laid out and interpolated as the entries of a LobeTable. The direction (of sine and cosine, as there) is the mean of
    the lobe's, int f cos w, and the level the one whose own lobe is as wide: as long a mean direction. Against the
    lobe's integral (four real skies) errors are 0.3 to 0.7 of those along the mirrored view at roughness 0.6, and 0.6
    to 0.9 at 0.4; a LobeTable's own direction, which is that of f without the cosine, does no better than the mirrored.
    """
    cosines = (1 - np.linspace(0, 1, COLUMNS) ** 2) ** 2
    lengths = np.array([np.linalg.norm(_mean_direction(r, np.ones(1))[0]) for r in level_roughnesses()])
    result = np.empty((ROUGHNESSES, COLUMNS, 3), np.float32)
    for row, roughness in zip(result, np.linspace(SMALLEST_ROUGHNESS, 1, ROUGHNESSES), strict=True):
        mean = _mean_direction(roughness, cosines)
        length = np.linalg.norm(mean, axis=1)
        row[:, :2] = mean[:, [0, 2]] / length[:, None]
        row[:, 2] = np.interp(-length, -lengths, np.arange(LEVELS))
    return result


def level_roughnesses() -> np.ndarray:
    """Return the roughness of each level, float64 [LEVELS]."""
    return SMALLEST_ROUGHNESS ** (1 - np.arange(LEVELS) / (LEVELS - 1))


def level_factors(order: int) -> np.ndarray:
    """Return what each level keeps of each band, float64 [LEVELS, order]: int f cos P_l / int f cos, seen along n."""
    rows = []
    for roughness in level_roughnesses():
        wi, weights, _ = ggx_directions(roughness, np.ones(1), rings=192, spokes=1)
        rows.append(weights[0] @ np.polynomial.legendre.legvander(wi[0, :, 2], order - 1) / weights.sum())
    return np.array(rows)


def _mean_direction(roughness: float, cosines: np.ndarray) -> np.ndarray:
    """Return int f cos w / int f cos in the plane of view and normal, float64 [cosines, 3]."""
    wi, weights, _ = ggx_directions(roughness, cosines)
    mean = np.einsum("cn,cnk->ck", weights, wi) / weights.sum(axis=1, keepdims=True)
    return mean * [1, 0, 1]  # the other half mirrors this one


def _prefilter(pixels: np.ndarray) -> PrefilteredSky:
    rings = harmonics.ring_coefficients(pixels, _ORDER)
    levels = [harmonics.ring_pixels(rings * kept[:, None], ROWS) for kept in level_factors(_ORDER)]
    return PrefilteredSky(np.maximum(levels, 0).astype(np.float32))
