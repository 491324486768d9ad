"""Procedural textures: small, 8-bit, without seams, from fixed seeds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache

import numpy as np

from warp_gi.color import encode_srgb
from warp_gi.scene.model import Color, Texture

SIZE = 512  # pixels
SRGB_CODES = np.round(255 * encode_srgb(np.linspace(0, 1, 16384))).astype(np.uint8)
"""8-bit sRGB codes of linear values in equal steps from 0 to 1, uint8 [16384]."""


@cache
def noise(seed: int, slope: float = 1.5, low: float = 1.0, high: float = 1e9, stretch: float = 1.0) -> np.ndarray:
    """Return float32 [SIZE, SIZE] periodic noise of mean 0 and deviation 1.

    Its amplitude falls with frequency^-slope between ``low`` and ``high`` cycles a texture. ``stretch`` above 1
    draws it out along x.
    """
    half = SIZE // 2 + 1
    parts = np.random.default_rng(seed).standard_normal((2, SIZE, half), dtype=np.float32)
    spectrum = parts[0] + np.complex64(1j) * parts[1]
    y = np.fft.fftfreq(SIZE, 1 / SIZE)[:, None].astype(np.float32)
    x = np.arange(half, dtype=np.float32)[None]
    frequency = np.hypot(x * stretch, y)
    inside = (frequency >= low) & (frequency <= high)
    spectrum[~inside] = 0
    spectrum[inside] *= frequency[inside] ** np.float32(-slope)
    result = np.fft.irfft2(spectrum, (SIZE, SIZE)).astype(np.float32)
    result = (result - result.mean()) / result.std()
    result.setflags(write=False)
    return result


def warped(image: np.ndarray, dx: np.ndarray, dy: np.ndarray) -> np.ndarray:
    """Return the periodic image looked up at places moved by dx, dy pixels."""
    rows, columns = np.indices(image.shape[:2])
    return image[(rows + dy).astype(int) % image.shape[0], (columns + dx).astype(int) % image.shape[1]]


def smoothstep(low: float, high: float, x: np.ndarray) -> np.ndarray:
    t = np.clip((x - low) / (high - low), 0.0, 1.0)
    return t * t * (3 - 2 * t)


def blend(a: Sequence[float] | np.ndarray, b: Sequence[float] | np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return float32 colours [.., 3] between a and b."""
    a, b = np.asarray(a, np.float32), np.asarray(b, np.float32)
    return a + (b - a) * weight[..., None].astype(np.float32)


def color_texture(name: str, linear: np.ndarray) -> Texture:
    """Return linear reflectances [h, w, 3] as an sRGB texture."""
    return Texture(name, _rgba(SRGB_CODES[(np.clip(linear, 0.0, 1.0) * (len(SRGB_CODES) - 1)).astype(np.int32)]))


def roughness_texture(name: str, roughness: np.ndarray, metallic: float = 0.0) -> Texture:
    """Return perceptual roughness [h, w] as a glTF metallic-roughness texture."""
    channels = np.stack(np.broadcast_arrays(np.float32(1.0), roughness, np.float32(metallic)), axis=-1)
    return Texture(name, _rgba(_bytes(channels)), srgb=False)


def normal_texture(name: str, height: np.ndarray, size: float) -> Texture:
    """Return the normal map of a height field [h, w] in metres that spans ``size`` metres."""
    texel = np.float32(size / height.shape[1])
    height = height.astype(np.float32)
    du = (np.roll(height, -1, 1) - np.roll(height, 1, 1)) / (2 * texel)
    dv = (np.roll(height, 1, 0) - np.roll(height, -1, 0)) / (2 * texel)  # row 0 is the top
    normal = np.stack([-du, -dv, np.ones_like(du)], axis=-1)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    return Texture(name, _rgba(_bytes(normal * 0.5 + 0.5)), srgb=False)


def _bytes(values: np.ndarray) -> np.ndarray:
    return (np.clip(values, 0, 1) * 255 + 0.5).astype(np.uint8)


def _rgba(rgb: np.ndarray) -> np.ndarray:
    pixels = np.full((*rgb.shape[:2], 4), 255, np.uint8)
    pixels[..., :3] = rgb
    return pixels


def cells(columns: int, rows: int, shift: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return for a grid of bricks, every other row shifted: distance to the edge in pixels, and (row, column)."""
    y, x = np.indices((SIZE, SIZE)).astype(np.float32) + 0.5
    row = (y * rows / SIZE).astype(int)
    along = (x * columns / SIZE + shift * (row % 2)) % columns
    column = along.astype(int)
    fx, fy = along - column, y * rows / SIZE - row
    edge = np.minimum(np.minimum(fx, 1 - fx) * SIZE / columns, np.minimum(fy, 1 - fy) * SIZE / rows)
    return edge.astype(np.float32), row, column


def tiles(
    colors: Sequence[Color],
    joint: Color,
    count: tuple[int, int],
    seed: int,
    shift: float = 0.0,
    joint_width: float = 2.0,
    variation: float = 0.12,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return colour [.., 3], height (0 joint to 1 face) and edge distance of stone tiles, each from ``colors``.

    Two colours make a chequerboard; each tile is cut from another place of one noise.
    """
    rng = np.random.default_rng(seed)
    edge, row, column = cells(*count, shift=shift)
    edge = edge + 0.8 * noise(seed + 1, 1.0, 8)
    which = (row + column) % len(colors)
    tint = 1 + variation * rng.standard_normal((count[1], count[0])).astype(np.float32)[row, column]
    offset = rng.integers(0, SIZE, (2, count[1], count[0]))
    grain = warped(noise(seed + 2, 1.4, 2), offset[0][row, column], offset[1][row, column])
    face = (
        np.asarray(colors, np.float32)[which]
        * (tint * (1 + 0.10 * grain) * (1 + 0.05 * noise(seed + 3, 0.4, 16)))[..., None]
    )
    height = smoothstep(joint_width * 0.5, joint_width * 0.5 + 4.0, edge)
    return blend(joint, face, smoothstep(0.0, 1.0, height * 2)), height, edge


def marble(light: Color, vein: Color, seed: int) -> np.ndarray:
    """Return the colour [.., 3] of marble: clouds, and thin veins along the zero lines of warped noise."""
    sway = 26 * noise(seed + 1, 1.8, 1, 40), 26 * noise(seed + 2, 1.8, 1, 40)
    field = warped(noise(seed, 1.9, 2, 24), *sway)
    fine = warped(noise(seed + 3, 1.7, 5, 60), *sway)
    veins = 0.75 * np.exp(-np.abs(field) * 14) * smoothstep(-1.0, 1.0, fine) + 0.30 * np.exp(-np.abs(fine) * 16)
    clouds = smoothstep(-2.0, 2.5, noise(seed + 4, 1.8, 1))
    return blend(blend(light, vein, 0.35 * clouds), vein, np.clip(veins, 0, 1))


def weave(threads: int = 64) -> np.ndarray:
    """Return the height 0..1 of plain weave with that many threads a texture."""
    y, x = np.indices((SIZE, SIZE)) * (threads * math.pi / SIZE)
    over = (np.floor(x / math.pi) + np.floor(y / math.pi)) % 2
    return np.where(over == 0, np.abs(np.sin(x)), np.abs(np.sin(y))).astype(np.float32)


def wood(dark: Color, light: Color, seed: int, planks: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Return colour [.., 3] and height 0..1 of planks that run along x."""
    across = (np.arange(SIZE) + 0.5) * planks / SIZE
    row = np.broadcast_to(across.astype(int)[:, None], (SIZE, SIZE))
    offset = np.random.default_rng(seed).integers(0, SIZE, planks)[row]
    grain = warped(noise(seed, 1.2, 3, 200, stretch=8.0), offset, 37 * row)
    rings = 0.5 + 0.5 * np.sin(9 * warped(noise(seed + 1, 1.8, 1, 30, stretch=6.0), offset, 53 * row) + 1.5 * grain)
    joint = smoothstep(0.004 * planks, 0.02 * planks, np.abs((across + 0.5) % 1 - 0.5))[:, None]
    color = blend(dark, light, np.clip(0.25 + 0.45 * rings + 0.16 * grain, 0, 1)) * (0.35 + 0.65 * joint)[..., None]
    return color, joint * (0.9 + 0.1 * rings)
