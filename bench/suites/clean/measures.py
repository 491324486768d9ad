"""Measures of pictures of a sequence against references of two halves: error, flicker, patterns, ghosts.

Pictures are linear radiance, float [height, width, 3]. Errors against one half times errors against the other have no
noise of the reference in their mean, as it is independent.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warp_gi.color import LUMINANCE

RELATIVE = 0.01
"""What ``rel_mse`` adds to the reference's square, over its mean squared: a dark scene is judged as a bright one."""
FLICKER = 0.1
"""What ``flicker`` adds to the reference, over its mean."""
WALL = 2
"""Pixels to each side of a pixel of a flat wall that are of the same wall."""
LEAST_WALL = 200
"""Fewest pixels of flat walls from which ``pattern`` says anything."""


def rel_mse(picture: np.ndarray, halves: Sequence[np.ndarray], shown: np.ndarray) -> float:
    """Return the mean of (picture - reference)^2 / (shown^2 + 1 % of its mean squared), the halves' noise taken out."""
    a, b = (np.asarray(half, np.float64) for half in halves)
    shown = np.asarray(shown, np.float64)
    weight = 1.0 / (shown**2 + RELATIVE * shown.mean() ** 2)
    return max(float(np.mean((picture - a) * (picture - b) * weight)), 0.0)


def moved(picture: np.ndarray, motion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a picture's values where the next frame's pixels were in it, bilinear, and which of them are inside.

    ``motion`` [height, width, 2] is where a pixel's point was, minus where it is: pixels, x right, y down.
    """
    height, width = picture.shape[:2]
    y, x = np.mgrid[:height, :width]
    u, v = x + motion[..., 0], y + motion[..., 1]
    inside = (u >= 0) & (u <= width - 1) & (v >= 0) & (v <= height - 1)
    u, v = np.where(inside, u, 0.0), np.where(inside, v, 0.0)
    left, top = np.minimum(u.astype(int), width - 2), np.minimum(v.astype(int), height - 2)
    s, t = (u - left)[..., None], (v - top)[..., None]
    values = np.asarray(picture, np.float64)
    upper = values[top, left] * (1 - s) + values[top, left + 1] * s
    lower = values[top + 1, left] * (1 - s) + values[top + 1, left + 1] * s
    return upper * (1 - t) + lower * t, inside


def flicker(picture: np.ndarray, before: np.ndarray, motion: np.ndarray, shown: np.ndarray) -> float:
    """Return the mean of |picture - the frame before, moved| / (shown + 10 % of its mean), over what was in it.

    Resampling, edges and what comes into view are in it: compare with that of the reference.
    """
    values, inside = moved(before, motion)
    scale = shown + FLICKER * np.mean(shown, dtype=np.float64)
    return float(np.mean((np.abs(picture - values) / scale)[inside]))


def walls(objects: np.ndarray, normals: np.ndarray, albedo: np.ndarray) -> np.ndarray:
    """Return which pixels are of flat, plain walls: all around are of one object, one normal and one albedo.

    ``objects`` are ids [height, width], -1 for none; the others [height, width, 3].
    """
    flat = objects >= 0
    height, width = flat.shape
    flat[:WALL], flat[height - WALL :], flat[:, :WALL], flat[:, width - WALL :] = False, False, False, False
    for dy in range(-WALL, WALL + 1):
        for dx in range(-WALL, WALL + 1):
            there = (np.roll(values, (dy, dx), (0, 1)) for values in (objects, normals, albedo))
            same, normal, color = there
            flat &= (same == objects) & ((normal * normals).sum(-1) > 0.999)
            flat &= np.abs(color - albedo).max(-1) < 0.02
    return flat


def pattern(picture: np.ndarray, halves: Sequence[np.ndarray], wall: np.ndarray) -> tuple[float, float, float] | None:
    """Return how alike errors on flat walls are one and two pixels apart, -1 to 1, and their size over the light.

    Of errors without what is smooth, the mean of 3x3 pixels. White noise has -0.17 and 0.04; a grid of two pixels'
    period -1 and 1. None where the walls have too few pixels, or no error beyond the reference's noise.
    """
    if np.count_nonzero(wall) < LEAST_WALL:
        return None
    one, other = (_rough((picture - np.asarray(half, np.float64)) @ LUMINANCE) for half in halves)
    if (power := _likeness(one, other, wall, 0)) <= 0:
        return None
    alike = [float(np.clip(_likeness(one, other, wall, step) / power, -1.0, 1.0)) for step in (1, 2)]
    light = float((np.asarray(picture, np.float64) @ LUMINANCE)[wall].mean())
    return alike[0], alike[1], power**0.5 / light


def _rough(values: np.ndarray) -> np.ndarray:
    """Return values minus the mean of the 3x3 around each; those at the edges count twice."""
    padded = np.pad(values, 1, mode="edge")
    height, width = values.shape
    around = sum(padded[dy : dy + height, dx : dx + width] for dy in range(3) for dx in range(3))
    return np.asarray(values - around / 9.0)


def _likeness(one: np.ndarray, other: np.ndarray, wall: np.ndarray, step: int) -> float:
    """Return the mean product of ``one`` with ``other`` so many pixels to the right and below, both on walls."""
    total, count = 0.0, 0
    for axis in (0, 1):
        size = one.shape[axis] - step
        first, second = np.arange(size), np.arange(step, step + size)
        both = wall.take(first, axis) & wall.take(second, axis)
        products = one.take(first, axis) * other.take(second, axis) + other.take(first, axis) * one.take(second, axis)
        total, count = total + float(products[both].sum()) / 2, count + int(np.count_nonzero(both))
    return total / max(count, 1)


def left_over(picture: np.ndarray, now: np.ndarray, before: np.ndarray) -> float:
    """Return the share of a picture's former light that is still in it: 1 before light changes, 0 when all is new.

    ``now`` and ``before`` are references of the same view with the light as it is, and as it was. It is the
    least-squares share of ``before`` - ``now`` in the picture's error, in which noise has mean 0.
    """
    change = np.asarray(before, np.float64) - now
    return float(((picture - now) * change).sum() / max(float((change**2).sum()), 1e-30))
