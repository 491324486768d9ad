"""A white room with one window under an overcast sky: light comes in through a small part of the sky, and stays long.

The room is 5 m (x) by 6 m (z), 2.8 m high; its surfaces reflect 0.86 to 0.9 of the light.
"""

from __future__ import annotations

import numpy as np

from warp_gi.scene.builtin.materials import matte
from warp_gi.scene.builtin.shapes import box, cylinder, icosphere, merge
from warp_gi.scene.camera import Camera, CameraKey, CameraPath
from warp_gi.scene.environment import Environment
from warp_gi.scene.model import Node
from warp_gi.scene.scene import Scene

HALF_X, HALF_Z, HEIGHT, WALL = 2.5, 3.0, 2.8, 0.25  # m
SILL, LINTEL, WINDOW_Z = 0.9, 2.2, (-1.5, 0.1)
"""The window's lower and upper edge, and where it begins and ends along z, m; it is in the wall at x = ``HALF_X``."""
WHITE, GROUND = 0.88, 0.2
"""Albedo of the walls, and of the ground outside."""
ZENITH = 8.0
"""Radiance of the sky at its zenith, W/(m^2 sr)."""
SKY_ROWS = 128


def overcast(rows: int = SKY_ROWS) -> Environment:
    """Return the CIE overcast sky, (1 + 2 sin(elevation)) / 3 of the zenith's radiance, over a Lambertian ground.

    A horizontal surface outside gets 7/9 pi times the zenith's radiance (Moon and Spencer 1942).
    """
    elevation = np.pi / 2 - np.pi * np.arange(rows) / (rows - 1)
    sky, ground = ZENITH * (1 + 2 * np.sin(elevation)) / 3, GROUND * ZENITH * 7 / 9
    column = np.where(elevation > 0, sky, ground)
    pixels = column[:, None, None] * np.array([0.93, 0.98, 1.06])
    return Environment(pixels=np.broadcast_to(pixels, (rows, 2 * rows, 3)).astype(np.float32), name="overcast sky")


def scene() -> Scene:
    """Return the room with a table, a ball, a column and a shelf, all white; it is closed but for the window."""
    white, floor = matte("white", (WHITE, WHITE, WHITE)), matte("floor", (0.90, 0.88, 0.86))
    x, z, low, high = HALF_X + WALL, HALF_Z + WALL, -WALL, HEIGHT + WALL
    # walls overlap at the edges, so that there is no gap to leak through
    walls = [
        box((-x, HEIGHT, -z), (x, high, z)),
        box((-x, low, -z), (-HALF_X, high, z)),
        box((-x, low, -z), (x, high, -HALF_Z)),
        box((-x, low, HALF_Z), (x, high, z)),
        box((HALF_X, low, -z), (x, SILL, z)),
        box((HALF_X, LINTEL, -z), (x, high, z)),
        box((HALF_X, low, -z), (x, high, WINDOW_Z[0])),
        box((HALF_X, low, WINDOW_Z[1]), (x, high, z)),
    ]
    legs = box((-0.03, 0, -0.03), (0.03, 0.7, 0.03)).at([(a, 0, b) for a in (-0.7, 0.7) for b in (-0.35, 0.35)])
    table = merge([box((-0.8, 0.7, -0.45), (0.8, 0.75, 0.45), 0.01), legs]).turned(20.0).moved(0.4, 0, -1.0)
    things = [
        icosphere(0.22, 3).moved(0.6, 0.97, -1.0),
        box((-0.16, 0, -0.16), (0.16, 0.4, 0.16), 0.01).turned(35.0).moved(0.05, 0.75, -0.85),
        cylinder(0.2, HEIGHT, 32).moved(-1.7, 0, -2.2),
        box((-HALF_X - 0.01, 1.2, -1.2), (-HALF_X + 0.35, 1.25, 1.2)),
        box((-HALF_X + 0.05, 1.25, 0.2), (-HALF_X + 0.3, 1.6, 0.5)),
        icosphere(0.45, 3).moved(-1.2, 0.45, 0.2),
    ]
    nodes = [
        Node("floor", [box((-x, low, -z), (x, 0, z)).mesh(floor, "floor")]),
        Node("walls", [merge(walls).mesh(white, "walls")]),
        Node("furniture", [merge([table, *things]).mesh(matte("furniture", (0.86, 0.86, 0.86)), "furniture")]),
    ]
    cameras = {"main": Camera.look_at((-1.6, 1.6, 2.6), (0.7, 1.0, -1.4), hfov=75.0)}
    return Scene(nodes, environment=overcast(), cameras=cameras, name="white_room")


def camera_path() -> CameraPath:
    """Return a slow walk towards the table."""
    keys = (
        CameraKey(0.0, (-1.6, 1.6, 2.6), (0.7, 1.0, -1.4), hfov=75.0),
        CameraKey(47 / 24, (-1.0, 1.5, 2.0), (0.8, 1.0, -1.4), hfov=75.0),
    )
    return CameraPath(keys, name="white_room")
