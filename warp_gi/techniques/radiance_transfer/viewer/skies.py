"""Skies of a page: 25 numbers a channel that light the scene, and a small map behind it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warp_gi.color import LUMINANCE
from warp_gi.kernels.transfer_snippets import LIGHT_ORDER
from warp_gi.scene.environment import Environment
from warp_gi.techniques.radiance_transfer.sky import radiance_range

LARGEST_HEIGHT = 512
"""Rows of the map behind the scene."""
SMALL_HEIGHT = 32
"""Rows of the maps of skies that are made here; they are smooth."""


@dataclass(frozen=True, eq=False)
class PageSky:
    """A sky as a page has it."""

    name: str
    """Its name in the page."""
    light: np.ndarray
    """Harmonics in world space, float64 [3, 25], W/(m^2 sr)."""
    range: tuple[np.ndarray, np.ndarray]
    """Least and most radiance of its parts, float64 [3] each, W/(m^2 sr)."""
    pixels: np.ndarray
    """Map in its own space, as of ``Environment``, float16 [height, 2 * height, 3]."""
    rotation: float
    """Degrees about +y from the map's space to the world."""


def page_skies(sky: Environment | None) -> list[PageSky]:
    """Return ``sky``, unless there is none or it is black, and some of the same mean luminance, or of 1."""
    result, mean = [], 1.0
    if sky is not None and not sky.is_black:
        result.append(page_sky("the scene's own", sky))
        mean = float(LUMINANCE @ sky.mean_radiance)
    for name, pixels in _made().items():
        scale = mean / float(Environment(pixels=pixels).mean_radiance @ LUMINANCE)
        result.append(page_sky(name, Environment(pixels=pixels, scale=scale)))
    return result


def page_sky(name: str, sky: Environment) -> PageSky:
    """Return a sky with its map made small."""
    if sky.pixels is None:
        pixels = np.broadcast_to(sky.mean_radiance, (2, 4, 3))
    else:
        pixels = smaller_map(sky.pixels, min(LARGEST_HEIGHT, len(sky.pixels))) * sky.scale
    halves = np.minimum(pixels, np.finfo(np.float16).max).astype(np.float16)
    return PageSky(name, sky.harmonics_of(LIGHT_ORDER), radiance_range(sky), halves, sky.rotation)


def smaller_map(pixels: np.ndarray, height: int) -> np.ndarray:
    """Return a latitude-longitude map of fewer rows, by a tent as wide as its steps, float64 [height, 2 height, 3]."""
    rows, columns = pixels.shape[:2]
    if height >= rows:
        return pixels.astype(np.float64)
    down = np.arange(height)[:, None] * ((rows - 1) / (height - 1)) - np.arange(rows)
    step = columns / (2 * height)
    along = (np.arange(2 * height)[:, None] + 0.5) * step - 0.5 - np.arange(columns)
    along -= columns * np.round(along / columns)
    row_weights = np.maximum(1 - np.abs(down) / ((rows - 1) / (height - 1)), 0)
    column_weights = np.maximum(1 - np.abs(along) / step, 0)
    row_weights /= row_weights.sum(axis=1, keepdims=True)
    column_weights /= column_weights.sum(axis=1, keepdims=True)
    return np.stack([row_weights @ pixels[..., c] @ column_weights.T for c in range(3)], axis=-1)


def _made() -> dict[str, np.ndarray]:
    """Return maps by name: skies smooth enough that 25 numbers hold nearly all of them."""
    theta = np.arange(SMALL_HEIGHT)[:, None] * math.pi / (SMALL_HEIGHT - 1)
    phi = (np.arange(2 * SMALL_HEIGHT) + 0.5) * math.pi / SMALL_HEIGHT
    x, y, z = np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi, -np.sin(theta) * np.cos(phi)

    def lobe(direction: tuple[float, float, float], color: tuple[float, float, float], sharpness: float) -> np.ndarray:
        axis = np.asarray(direction) / np.linalg.norm(direction)
        cosine = x * axis[0] + y * axis[1] + z * axis[2]
        return np.exp(sharpness * (cosine - 1))[..., None] * color

    above = 1 / (1 + np.exp(-4 * y))[..., None]
    overcast = above * (0.4 + 0.6 * np.maximum(y, 0)[..., None]) * (1.0, 1.0, 1.0) + (1 - above) * 0.1
    evening = above * (0.25, 0.4, 0.75) + (1 - above) * (0.12, 0.1, 0.08) + lobe((1, 0.35, 0.3), (8.0, 4.3, 1.8), 5)
    window = lobe((-1, 0.6, 0.4), (1.0, 1.05, 1.1), 5) + 0.01
    colors = lobe((1, 0.4, 0), (1.0, 0.35, 0.1), 4) + lobe((-1, 0.4, 0), (0.1, 0.35, 1.0), 4) + 0.02
    maps = {"overcast": overcast, "evening": evening, "one window": window, "orange and blue": colors}
    return {name: np.ascontiguousarray(pixels, np.float32) for name, pixels in maps.items()}
