"""Suns of a sky: the few small bright blobs of a map, apart from the rest of it.

What is brighter than so many times the mean leaves the map, which is cut at that radiance there, and becomes one lamp a
blob of neighbouring texels. The rest is a sky like others: never negative, and smoother.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from warp_gi.color import LUMINANCE, luminance_of
from warp_gi.scene.sky import node_solid_angles

MOST_SUNS = 8
"""Largest number of suns; what is left over stays in the map."""
LEAST_SHARE = 0.002
"""Share of the sky's light that a blob has to hold, or it stays in the map."""
LAMPS_SHARE = 0.5
"""Share of the sky's light that suns hold where a sky counts as one of a few lamps."""


@dataclass(frozen=True, eq=False)
class MapSplit:
    """What ``environment.SunSplit`` is made of: the parts of a map, in its own space and unscaled."""

    pixels: np.ndarray
    """The rest, float32 [height, width, 3]; the map itself where there are no suns."""
    directions: np.ndarray
    irradiances: np.ndarray
    cos_cones: np.ndarray
    cos_discs: np.ndarray
    share: float
    nodes: tuple[np.ndarray, ...] = ()
    """Texels of each sun, row * width + column, int [count]."""


def split_map(
    pixels: np.ndarray, brighter_than: float, most: int, least_share: float = LEAST_SHARE, widest: float = math.pi
) -> MapSplit:
    """Return the suns of a map [height, width, 3] and the rest; ``Environment.split_sun`` says what counts as one.

    Each holds ``least_share`` of the sky's light, and is not wider than a disc of half-angle ``widest`` [rad].
    A texel that is cut keeps its colour. Blobs touch at sides or corners, across the edge of the map, too, and a
    pole is one point that all of the next row touches.
    """
    height, width = pixels.shape[:2]
    areas = node_solid_angles(height, width)
    luminance = luminance_of(pixels)
    whole = float(areas @ luminance.sum(axis=1))
    limit = brighter_than * whole / (4 * math.pi)
    rows, columns = np.nonzero(luminance > limit)
    none = MapSplit(pixels, np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros(0), 0.0)
    if len(rows) == 0 or whole == 0:
        return none
    bright = pixels[rows, columns]
    cut = (bright * (limit / luminance[rows, columns])[:, None]).astype(np.float32)
    light = (bright.astype(np.float64) - cut) * areas[rows, None]
    blobs = _blobs(rows, columns, height, width)
    powers = np.bincount(blobs, light @ LUMINANCE)
    suns = [k for k in np.argsort(-powers, kind="stable") if powers[k] >= least_share * whole]
    rest = pixels.copy()
    theta, phi = rows * (math.pi / (height - 1)), (columns + 0.5) * (2 * math.pi / width)
    towards = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1)
    down, right = math.pi / (height - 1), 2 * math.pi / width
    step = math.hypot(down, right)  # a texel's light reaches to the next, every way; near a pole less far
    spreads = (down**2 + (right * np.sin(theta)) ** 2) / 6  # of a texel's own light
    directions, irradiances, cones, discs, power = [], [], [], [], 0.0
    nodes: list[np.ndarray] = []
    for k in suns:
        held = blobs == k
        weights = light[held] @ LUMINANCE
        axis = weights @ towards[held]
        axis /= np.linalg.norm(axis)
        cosines = np.clip(towards[held] @ axis, -1, 1)
        cone = min(math.acos(cosines.min()) + step, math.pi)
        # the mean of sin^2 over an even disc is half that at its rim
        spread = 2 * (weights @ (1 - cosines**2 + spreads[held]) / weights.sum())
        disc = max(math.sqrt(max(1 - spread, 0.0)), math.cos(cone))
        if len(nodes) == most or disc < math.cos(widest):
            continue
        rest[rows[held], columns[held]] = cut[held]
        nodes.append(rows[held] * width + columns[held])
        power += powers[k]
        directions.append(axis)
        irradiances.append(light[held].sum(axis=0))
        cones.append(math.cos(cone))
        discs.append(disc)
    if not nodes:
        return none
    towards_suns, shapes = (np.array(directions), np.array(irradiances)), (np.array(cones), np.array(discs))
    return MapSplit(rest, *towards_suns, *shapes, float(power / whole), tuple(nodes))


def _blobs(rows: np.ndarray, columns: np.ndarray, height: int, width: int) -> np.ndarray:
    """Return the number of the blob, from 0, to which each texel of a list (in order of the map) belongs, int [n]."""
    count = len(rows)
    place = rows * width + columns
    pairs = []
    for down, right in ((0, 1), (1, -1), (1, 0), (1, 1)):
        wanted = (rows + down) * width + (columns + right) % width
        found = np.minimum(np.searchsorted(place, wanted), count - 1)
        near = (place[found] == wanted) & (rows + down < height)
        pairs.append(np.stack([np.nonzero(near)[0], found[near]]))
    for pole, beside in ((0, 1), (height - 1, height - 2)):  # all texels of a pole are one point
        if (rows == pole).any():
            there = np.nonzero((rows == pole) | (rows == beside))[0]
            pairs.append(np.stack([there[:-1], there[1:]]))
    a, b = np.concatenate(pairs, axis=1)
    label = np.arange(count)
    while True:  # the smallest number wins: along pairs, and then along chains of numbers
        low = np.minimum(label[a], label[b])
        changed = label.copy()
        np.minimum.at(changed, label[a], low)
        np.minimum.at(changed, label[b], low)
        changed = changed[changed]
        if np.array_equal(changed, label):
            return np.unique(label, return_inverse=True)[1].reshape(-1)
        label = changed
