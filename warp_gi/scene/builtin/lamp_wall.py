"""A wall of 3,200 small lamps of many colours above a floor with objects: every point sees them all, each is weak.

80 by 40 square lamps of 4 cm, 10 cm apart, show bands of colour; the brightest have 24 times the power of the dimmest.
"""

from __future__ import annotations

import colorsys
import math

import numpy as np

from warp_gi.scene.builtin.materials import lamp, matte, plain
from warp_gi.scene.builtin.shapes import Shape, box, cylinder, icosphere, merge, quad
from warp_gi.scene.camera import Camera, CameraKey, CameraPath
from warp_gi.scene.model import Color, Node
from warp_gi.scene.scene import Scene

COLUMNS, ROWS = 80, 40
PITCH, SIDE = 0.1, 0.04  # m
BOTTOM, FRONT = 0.4, -2.98  # y where the lamps begin, z of their fronts, m
HUES, LEVELS = 12, (0.125, 0.75, 3.0)
RADIANCE = 30.0
"""Of a lamp of level 1, W/(m^2 sr)."""
HALF_X, BACK, DEPTH, HEIGHT = 4.6, -3.0, 8.0, 5.0  # m; the hall reaches from z = ``BACK`` to ``BACK`` + ``DEPTH``


def colors() -> list[Color]:
    """Return the radiance of each kind of lamp: hues of a level, then those of the next brighter one."""
    found: list[Color] = []
    for level in LEVELS:
        for hue in range(HUES):
            rgb = np.array(colorsys.hsv_to_rgb(hue / HUES, 0.8, 1.0))
            r, g, b = (float(value) for value in RADIANCE * level * rgb)
            found.append((r, g, b))
    return found


def kinds() -> np.ndarray:
    """Return the kind of each lamp, an index into ``colors``, int [row, column]: swirls of hue, a few bright ones."""
    row, column = np.mgrid[:ROWS, :COLUMNS]
    x, y = (column - COLUMNS / 2) / ROWS, (row - ROWS / 2) / ROWS
    hue = (3 * np.sin(2.1 * x + 1.5) + 2 * np.cos(3.4 * y) + 4 * np.hypot(x - 0.3, y + 0.1)) / 4
    bright = np.sin(math.pi * (3 * x + 2 * np.sin(4 * y)))
    level = 1 + (bright > 0.8).astype(int) - (bright < -0.3).astype(int)
    return level * HUES + np.floor((hue % 1.0) * HUES).astype(int)


def lamps() -> dict[int, Shape]:
    """Return the glowing quads of each kind that there is."""
    square = quad((-SIDE / 2, -SIDE / 2, 0), (SIDE, 0, 0), (0, SIDE, 0))
    kind = kinds()
    row, column = np.mgrid[:ROWS, :COLUMNS]
    places = np.stack(
        [(column + 0.5 - COLUMNS / 2) * PITCH, BOTTOM + (row + 0.5) * PITCH, np.full(kind.shape, FRONT)], axis=-1
    )
    return {int(k): square.at(places[kind == k]) for k in np.unique(kind)}


def scene() -> Scene:
    """Return a closed hall, whose back wall carries the lamps; the camera looks away from them."""
    grey, side = matte("panel", (0.08, 0.08, 0.08)), matte("side", (0.5, 0.5, 0.5))
    x, width, front = HALF_X, 2 * HALF_X, BACK + DEPTH
    shell = merge(
        [
            quad((-x, 0, front), (0, 0, -DEPTH), (0, HEIGHT, 0)),
            quad((x, 0, BACK), (0, 0, DEPTH), (0, HEIGHT, 0)),
            quad((-x, HEIGHT, BACK), (width, 0, 0), (0, 0, DEPTH)),
            quad((x, 0, front), (-width, 0, 0), (0, HEIGHT, 0)),
        ]
    )
    floor, back = (
        quad((-x, 0, front), (width, 0, 0), (0, 0, -DEPTH)),
        quad((-x, 0, BACK), (width, 0, 0), (0, HEIGHT, 0)),
    )
    matt = [
        box((-0.5, 0, -0.5), (0.5, 1.0, 0.5), 0.02).turned(25.0).moved(1.5, 0, 0.6),
        cylinder(0.3, 2.2, 32, 0.02).moved(-1.9, 0, 2.6),
        box((-0.9, 0, -0.2), (0.9, 0.35, 0.2), 0.02).turned(-15.0).moved(2.9, 0, 2.6),
    ]
    balls = [icosphere(0.55, 4).moved(0.2, 0.55, 2.3), icosphere(0.35, 4).moved(-0.5, 0.35, 0.6)]
    nodes = [
        Node("shell", [shell.mesh(side, "shell"), back.mesh(grey, "back wall")]),
        Node("floor", [floor.mesh(plain("floor", (0.4, 0.4, 0.4), 0.35), "floor")]),
        Node("blocks", [merge(matt).mesh(matte("blocks", (0.75, 0.75, 0.75)), "blocks")]),
        Node("metal ball", [balls[0].mesh(plain("metal", (0.9, 0.88, 0.85), 0.4, 1.0), "metal ball")]),
        Node("coated ball", [balls[1].mesh(plain("coated", (0.7, 0.7, 0.7), 0.2), "coated ball")]),
    ]
    radiance = colors()
    glow = [shape.mesh(lamp(f"lamps {k}", radiance[k]), f"lamps {k}") for k, shape in lamps().items()]
    nodes.append(Node("lamps", glow))
    cameras = {
        "main": Camera.look_at((-3.6, 2.3, -2.1), (0.9, 0.6, 1.9), hfov=70.0),
        "wall": Camera.look_at((-2.6, 2.1, 4.6), (0.1, 1.3, -1.0), hfov=70.0),
    }
    return Scene(nodes, cameras=cameras, name="lamp_wall")


def camera_path() -> CameraPath:
    """Return a move along the foot of the wall."""
    keys = (
        CameraKey(0.0, (-3.6, 2.3, -2.1), (0.9, 0.6, 1.9), hfov=70.0),
        CameraKey(47 / 24, (-2.4, 2.2, -2.1), (1.0, 0.6, 1.9), hfov=70.0),
    )
    return CameraPath(keys, name="lamp_wall")
