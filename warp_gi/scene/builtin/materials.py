"""Materials of the built-in scenes. Each function states how many metres its texture is meant to cover."""

from __future__ import annotations

import numpy as np

from warp_gi.scene.builtin import textures as tx
from warp_gi.scene.model import Color, Material


def matte(name: str, color: Color) -> Material:
    """Return pure Lambert."""
    return Material(name, color, specular=0.0)


def plain(name: str, color: Color, roughness: float = 0.6, metallic: float = 0.0) -> Material:
    """Return one colour throughout."""
    return Material(name, color, roughness=roughness, metallic=metallic)


def lamp(name: str, radiance: Color, double_sided: bool = False) -> Material:
    """Return a black emitter."""
    return Material(name, (0.0, 0.0, 0.0), specular=0.0, emission=radiance, double_sided=double_sided)


def textured(
    name: str, color: np.ndarray, roughness: np.ndarray | float, height: np.ndarray | None = None, size: float = 1.0
) -> Material:
    """Return a material of colour [h, w, 3], roughness (number or [h, w]) and relief [h, w] in m over ``size`` m."""
    material = Material(name, (1.0, 1.0, 1.0), base_color_texture=tx.color_texture(f"{name} colour", color))
    if isinstance(roughness, np.ndarray):
        material.metallic_roughness_texture = tx.roughness_texture(f"{name} roughness", roughness)
    else:
        material.roughness = roughness
    if height is not None:
        material.normal_texture = tx.normal_texture(f"{name} normal", height, size)
    return material


def court_tiles() -> Material:
    """Return polished limestone and slate chequers, 4 x 4 tiles over 3.2 m."""
    light, dark = (0.56, 0.47, 0.35), (0.30, 0.235, 0.175)
    color, height, _ = tx.tiles([light, dark], (0.16, 0.13, 0.10), (4, 4), seed=11, joint_width=1.6, variation=0.07)
    worn = tx.smoothstep(-1.5, 2.0, tx.noise(15, 1.3, 2))
    roughness = 0.85 - height * (0.62 - 0.30 * worn)
    relief = 0.003 * height + 0.00025 * tx.noise(16, 1.2, 3, 60)
    return textured("court tiles", color, roughness, relief, 3.2)


def terracotta_tiles() -> Material:
    """Return small fired tiles, 8 x 8 over 2.4 m."""
    color, height, _ = tx.tiles(
        [(0.42, 0.20, 0.11), (0.36, 0.165, 0.09)], (0.25, 0.20, 0.15), (8, 8), seed=23, joint_width=1.5
    )
    relief = 0.003 * height + 0.0004 * tx.noise(27, 1.3, 3, 80)
    return textured("terracotta tiles", color, 0.8 - 0.32 * height, relief, 2.4)


def ashlar() -> Material:
    """Return coursed limestone blocks, 3 x 6 over 2.4 m."""
    color, height, _ = tx.tiles(
        [(0.60, 0.49, 0.35), (0.55, 0.445, 0.315), (0.64, 0.53, 0.385)],
        (0.33, 0.265, 0.19),
        (3, 6),
        seed=31,
        shift=0.5,
        joint_width=1.4,
        variation=0.05,
    )
    relief = 0.004 * height + 0.0011 * tx.noise(36, 1.1, 4, 120)
    return textured("ashlar", color, 0.85, relief, 2.4)


def limestone() -> Material:
    """Return dressed stone of one piece, over 2 m."""
    stain = tx.smoothstep(-1.0, 2.5, tx.noise(41, 1.7, 1))
    color = tx.blend((0.66, 0.555, 0.415), (0.50, 0.405, 0.285), 0.7 * stain)
    color = color * (1 + 0.06 * tx.noise(42, 0.8, 6))[..., None]
    return textured("limestone", color, 0.78, 0.0012 * tx.noise(43, 1.0, 6, 120), 2.0)


def plaster(name: str, color: Color, worn: Color, seed: int) -> Material:
    """Return old lime plaster, mottled and faded, over 3 m."""
    mottle = tx.smoothstep(-2.0, 2.0, tx.noise(seed, 1.6, 1) + 0.5 * tx.noise(52, 1.0, 5))
    base = tx.blend(color, np.multiply(color, (0.82, 0.76, 0.70)), mottle)
    faded = tx.smoothstep(-0.5, 2.5, tx.noise(seed + 1, 1.5, 2) + 0.2 * tx.noise(52, 1.0, 5))
    return textured(name, tx.blend(base, worn, 0.75 * faded), 0.95, 0.0012 * tx.noise(54, 1.3, 3, 120), 3.0)


def white_marble() -> Material:
    """Return polished white marble with grey veins, over 1.5 m."""
    color = tx.marble((0.80, 0.76, 0.70), (0.36, 0.33, 0.30), seed=61)
    return textured("white marble", color, 0.22)


def rose_marble() -> Material:
    """Return polished red marble with pale veins, over 1.5 m."""
    color = tx.marble((0.40, 0.17, 0.115), (0.70, 0.52, 0.42), seed=71)
    return textured("rose marble", color, 0.25)


def walnut() -> Material:
    """Return waxed dark planks that run along u, 4 over 1.2 m."""
    color, height = tx.wood((0.11, 0.055, 0.027), (0.31, 0.165, 0.08), seed=81)
    return textured("walnut", color, 0.45, 0.003 * height, 1.2)


def fabric(name: str, color: Color, accent: Color, seed: int) -> Material:
    """Return woven cloth with borders and a diamond pattern in a second colour, over 0.8 m."""
    y, x = (np.indices((tx.SIZE, tx.SIZE)) + 0.5) / tx.SIZE
    diamond = np.abs((x * 4) % 1 - 0.5) + np.abs((y * 4) % 1 - 0.5)
    pattern = tx.smoothstep(0.03, 0.0, np.abs(diamond - 0.34)) + tx.smoothstep(0.09, 0.06, diamond)
    threads = tx.weave()
    shade = (0.72 + 0.28 * threads) * (1 + 0.07 * tx.noise(seed, 1.2, 2))
    base = tx.blend(color, accent, 0.8 * np.clip(pattern, 0, 1)) * shade[..., None]
    return textured(name, base, 0.9, 0.0016 * threads, 0.8)


def water() -> Material:
    """Return still water over dark tiles as an opaque gloss with ripples, over 2 m."""
    ripples = 0.004 * tx.noise(91, 2.0, 3, 40)
    return textured("water", np.full((8, 8, 3), (0.012, 0.050, 0.052)), 0.04, ripples, 2.0)


def bronze() -> Material:
    """Return dull bronze."""
    return plain("bronze", (0.43, 0.27, 0.12), roughness=0.38, metallic=1.0)


def concrete(name: str = "concrete", color: Color = (0.42, 0.41, 0.39)) -> Material:
    """Return stained concrete, over 4 m."""
    stain = tx.smoothstep(-1.5, 2.5, tx.noise(111, 1.6, 1))
    shade = 1 + 0.05 * tx.noise(112, 0.6, 8)
    base = tx.blend(color, np.multiply(color, 0.6), stain) * shade[..., None]
    return textured(name, base, (0.9 - 0.35 * stain).astype(np.float32), 0.0008 * tx.noise(113, 1.0, 6, 120), 4.0)


def crate_wood() -> Material:
    """Return pale rough planks that run along u, 4 over 0.8 m."""
    color, height = tx.wood((0.25, 0.15, 0.075), (0.52, 0.36, 0.20), seed=121)
    return textured("crate wood", color, 0.8, 0.004 * height, 0.8)


def asphalt() -> Material:
    """Return asphalt, over 3 m."""
    stain = tx.smoothstep(-2.0, 2.0, tx.noise(131, 1.5, 1))
    base = tx.blend((0.105, 0.10, 0.097), (0.06, 0.058, 0.057), stain) * (1 + 0.18 * tx.noise(132, 0.2, 30))[..., None]
    return textured("asphalt", base, 0.85, 0.0016 * tx.noise(132, 0.2, 30), 3.0)


def paving() -> Material:
    """Return grey paving slabs, 5 x 5 over 2 m."""
    color, height, _ = tx.tiles(
        [(0.40, 0.38, 0.35), (0.36, 0.345, 0.32)], (0.17, 0.16, 0.145), (5, 5), seed=141, shift=0.5, joint_width=1.5
    )
    return textured("paving", color, 0.85, 0.003 * height, 2.0)
