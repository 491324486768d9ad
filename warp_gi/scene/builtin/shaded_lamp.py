"""A closed room with two small lamps, neither of which is seen past its shade: nearly all light is reflected first.

Shades are reflectors, as there is no transmission. A floor lamp's metal bowl throws its light at the ceiling, as in
Veach and Guibas, "Bidirectional Estimators for Light Transport" (Eurographics Rendering Workshop 1994). A table lamp's
bulb stands in rings of white glaze, between which light leaves after one reflection or more, as through opal glass.
"""

from __future__ import annotations

import numpy as np

from warp_gi.scene.builtin.materials import lamp, matte, plain
from warp_gi.scene.builtin.shapes import Shape, box, cylinder, icosphere, lathe, merge
from warp_gi.scene.camera import Camera, CameraKey, CameraPath
from warp_gi.scene.model import Mesh, Node
from warp_gi.scene.scene import Scene

HALF_X, HALF_Z, HEIGHT, WALL = 2.6, 2.4, 2.6, 0.2  # m
FLOOR_LAMP, TABLE_LAMP = (1.7, 1.75, -1.6), (-1.1, 1.13, -1.2)
"""Centres of the bulbs."""
BULB = 0.05  # m, radius
FLOOR_RADIANCE, TABLE_RADIANCE = (400.0, 340.0, 250.0), (220.0, 170.0, 110.0)
RINGS = 5
RING_STEP, RING_IN, RING_OUT, RING_RISE = 0.065, 0.12, 0.20, 0.10
"""Distance of the rings; their inner and outer radius; height of the outer, lower edge below the inner one; m."""


def bowl() -> Shape:
    """Return the floor lamp's bowl about its bulb: it hides the bulb from all that is below its rim."""
    outside = [(0.0, -0.13), (0.08, -0.125), (0.16, -0.09), (0.21, -0.03), (0.235, 0.06)]
    inside = [(radius - 0.006, height + 0.004) for radius, height in outside[:0:-1]]
    return lathe([*outside, *inside, (0.0, -0.12)], 48)


def rings() -> Shape:
    """Return the table lamp's shade about its bulb: cones that overlap, a lid, and a saucer below.

    Seen from the middle of the bulb no gap is left.
    """
    low = -(RINGS - 1) / 2 * RING_STEP + RING_RISE / 2
    parts = []
    for k in range(RINGS):
        top = low + k * RING_STEP
        outside = [(RING_OUT, top - RING_RISE), (RING_IN, top)]
        inside = [(RING_IN - 0.003, top - 0.002), (RING_OUT - 0.003, top - RING_RISE - 0.002)]
        parts.append(lathe([*outside, *inside, outside[0]], 48))
    lid, dish = low + (RINGS - 1) * RING_STEP + 0.03, low - RING_RISE - 0.06
    saucer = [
        (0.0, dish),
        (0.2, dish),
        (0.3, dish + 0.07),
        (0.295, dish + 0.074),
        (0.198, dish + 0.004),
        (0.0, dish + 0.004),
    ]
    parts += [cylinder(0.17, 0.004, 48).moved(0, lid, 0), lathe(saucer, 48)]
    return merge(parts)


def scene() -> Scene:
    """Return the room: a table with the ringed lamp, the floor lamp behind an armchair, a picture on the wall."""
    x, z = HALF_X + WALL, HALF_Z + WALL
    # walls overlap at the edges, so that there is no gap to leak through
    walls = merge(
        [
            box((-x, HEIGHT, -z), (x, HEIGHT + WALL, z)),
            box((-x, -WALL, -z), (-HALF_X, HEIGHT + WALL, z)),
            box((HALF_X, -WALL, -z), (x, HEIGHT + WALL, z)),
            box((-x, -WALL, -z), (x, HEIGHT + WALL, -HALF_Z)),
            box((-x, -WALL, HALF_Z), (x, HEIGHT + WALL, z)),
        ]
    )
    table_x, _, table_z = TABLE_LAMP
    legs = box((-0.03, 0, -0.03), (0.03, 0.7, 0.03)).at([(a, 0, b) for a in (-0.6, 0.6) for b in (-0.35, 0.35)])
    table = merge([box((-0.7, 0.7, -0.42), (0.7, 0.74, 0.42), 0.01), legs]).moved(table_x + 0.2, 0, table_z)
    chair = merge(
        [
            box((-0.4, 0.15, -0.4), (0.4, 0.42, 0.4), 0.04),
            box((-0.4, 0.15, -0.42), (0.4, 0.95, -0.25), 0.04),
            box((-0.48, 0.1, -0.4), (-0.36, 0.6, 0.4), 0.03),
            box((0.36, 0.1, -0.4), (0.48, 0.6, 0.4), 0.03),
        ]
    )
    (floor_x, floor_y, floor_z), (_, table_y, _) = FLOOR_LAMP, TABLE_LAMP
    stem = merge([cylinder(0.14, 0.02, 32), cylinder(0.012, floor_y - 0.135, 16)]).moved(floor_x, 0, floor_z)
    foot = merge([cylinder(0.07, 0.015, 32), cylinder(0.01, table_y - 0.74 - 0.24, 16)]).moved(table_x, 0.74, table_z)
    ball = icosphere(0.09, 4).moved(table_x + 0.55, 0.83, table_z + 0.2)
    bulb = icosphere(BULB, 1)
    brass, glaze = plain("brass", (0.85, 0.66, 0.40), 0.35, 1.0), plain("glaze", (0.88, 0.86, 0.82), 0.25)
    nodes = [
        Node("floor", [box((-x, -WALL, -z), (x, 0, z)).mesh(plain("floor", (0.36, 0.25, 0.16), 0.4), "floor")]),
        Node("walls", [walls.mesh(matte("walls", (0.72, 0.70, 0.66)), "walls")]),
        Node("table", [table.mesh(matte("wood", (0.42, 0.27, 0.15)), "table")]),
        Node("chair", [chair.turned(-35.0).moved(1.0, 0, -0.9).mesh(matte("cloth", (0.15, 0.30, 0.38)), "chair")]),
        Node("picture", [_picture().mesh(matte("picture", (0.55, 0.18, 0.12)), "picture")]),
        Node("ball", [ball.mesh(plain("steel", (0.75, 0.75, 0.77), 0.15, 1.0), "ball")]),
        Node("floor lamp", [bowl().moved(*FLOOR_LAMP).mesh(brass, "bowl"), stem.mesh(brass, "stem")]),
        Node("table lamp", [rings().moved(*TABLE_LAMP).mesh(glaze, "rings"), foot.mesh(brass, "foot")]),
        Node("bulbs", _bulbs(bulb)),
    ]
    cameras = {"main": Camera.look_at((-0.9, 1.45, 2.1), (0.15, 1.05, -1.4), hfov=72.0)}
    return Scene(nodes, cameras=cameras, name="shaded_lamp")


def camera_path() -> CameraPath:
    """Return a slow walk into the room."""
    keys = (
        CameraKey(0.0, (-0.9, 1.45, 2.1), (0.15, 1.05, -1.4), hfov=72.0),
        CameraKey(47 / 24, (-0.4, 1.4, 1.5), (0.15, 1.05, -1.4), hfov=72.0),
    )
    return CameraPath(keys, name="shaded_lamp")


def _picture() -> Shape:
    return box((-0.45, 1.3, -HALF_Z - 0.01), (0.35, 1.9, -HALF_Z + 0.03), 0.005)


def _bulbs(bulb: Shape) -> list[Mesh]:
    kinds = (("floor bulb", FLOOR_LAMP, FLOOR_RADIANCE), ("table bulb", TABLE_LAMP, TABLE_RADIANCE))
    return [bulb.moved(*np.asarray(place)).mesh(lamp(name, color), name) for name, place, color in kinds]
