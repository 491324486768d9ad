"""A warehouse of twelve rooms: shelves and crates under 576 lamps, of which any one point sees few.

The rooms, 10 m by 8 m and 5 m high, stand in four columns (x) and three rows (z), joined by doorways.
"""

from __future__ import annotations

import numpy as np

from warp_gi.scene.builtin import materials
from warp_gi.scene.builtin.shapes import Shape, box, merge, placement, quad
from warp_gi.scene.camera import Camera, CameraKey, CameraPath
from warp_gi.scene.model import Node
from warp_gi.scene.scene import Scene

COLUMNS, ROWS = 4, 3
WIDTH, LENGTH, HEIGHT = 10.0, 8.0, 5.0  # size of a room in metres
WALL = 0.2
DOOR, DOOR_HEIGHT = 2.4, 3.0
LAMPS_X, LAMPS_Z = 8, 6  # a room
TINTS = ((1.0, 0.93, 0.82), (0.80, 0.92, 1.0), (1.0, 0.72, 0.42), (0.92, 1.0, 0.90))
RADIANCE = 75.0


def corner(column: int, row: int) -> tuple[float, float]:
    """Return x and z where a room begins; the building is centred on the origin."""
    return (column - COLUMNS / 2) * WIDTH, (row - ROWS / 2) * LENGTH


def walls() -> Shape:
    """Return all walls; inner ones have a doorway off their middle."""
    half_x, half_z, t = COLUMNS * WIDTH / 2, ROWS * LENGTH / 2, WALL / 2
    parts = []
    for k in range(COLUMNS + 1):
        for row in range(ROWS):
            x, z = corner(k, row)
            inner = 0 < k < COLUMNS
            parts += _wall(LENGTH, 1.6 + 2.4 * ((k + row) % 2) if inner else None, (x, 0, z), -90.0)
    for k in range(ROWS + 1):
        for column in range(COLUMNS):
            x, z = corner(column, k)
            inner = 0 < k < ROWS
            parts += _wall(WIDTH, 2.0 + 3.4 * ((k + column) % 2) if inner else None, (x, 0, z), 0.0)
    roof = box((-half_x - t, HEIGHT, -half_z - t), (half_x + t, HEIGHT + 0.3, half_z + t))
    return merge([*parts, roof]).box_mapped()


def _wall(length: float, door: float | None, start: tuple[float, float, float], turn: float) -> list[Shape]:
    """Return boxes of a wall from ``start`` along x turned by ``turn``; the doorway begins at ``door``."""
    t = WALL / 2
    spans = [(-t, length + t, 0.0, HEIGHT)]
    if door is not None:
        spans = [
            (-t, door, 0.0, HEIGHT),
            (door + DOOR, length + t, 0.0, HEIGHT),
            (door, door + DOOR, DOOR_HEIGHT, HEIGHT),
        ]
    place = placement(start, turn)
    return [box((a, y0, -t), (b, y1, t)).transformed(place) for a, b, y0, y1 in spans]


def lamps(column: int, row: int) -> tuple[Shape, Shape]:
    """Return the glowing quads and the housings of a room's lamps."""
    x0, z0 = corner(column, row)
    x = x0 + (np.arange(LAMPS_X) + 0.5) * WIDTH / LAMPS_X
    z = z0 + (np.arange(LAMPS_Z) + 0.5) * LENGTH / LAMPS_Z
    y = HEIGHT - 0.6
    places = [(a, y, b) for a in x for b in z]
    glow = quad((-0.2, 0, -0.05), (0.4, 0, 0), (0, 0, 0.1)).at(places)
    housing = merge([box((-0.24, 0.004, -0.09), (0.24, 0.07, 0.09)), box((-0.012, 0.07, -0.012), (0.012, 0.6, 0.012))])
    return glow, housing.at(places)


def rack(length: float, rng: np.random.Generator) -> dict[str, Shape]:
    """Return a rack along x with four shelves, and crates and cartons on it."""
    depth, levels = 1.0, (0.15, 1.2, 2.25, 3.3)
    steel = [
        box((x - 0.04, 0, z - 0.04), (x + 0.04, 3.6, z + 0.04)) for x in (0.0, length / 2, length) for z in (0.0, depth)
    ]
    loads: dict[str, list[Shape]] = {"crates": [], "cartons": []}
    for level in levels:
        steel.append(box((-0.04, level - 0.06, -0.04), (length + 0.04, level, depth + 0.04)))
        x = 0.08
        while x < length - 0.5:
            size = np.array([rng.uniform(0.35, 0.8), rng.uniform(0.3, 0.85), rng.uniform(0.5, 0.85)])
            if x + size[0] > length - 0.05:
                break
            if rng.random() < 0.8:
                kind = "crates" if rng.random() < 0.45 else "cartons"
                z = rng.uniform(0.02, depth - 0.02 - size[2])
                loads[kind].append(box((x, level, z), (x + size[0], level + size[1], z + size[2]), 0.012))
            x += size[0] + rng.uniform(0.03, 0.15)
    return {"steel": merge(steel), **{kind: merge(shapes) for kind, shapes in loads.items()}}


def contents() -> dict[str, Shape]:
    """Return racks in every room, on both sides of an aisle, and a few loose crates."""
    rng = np.random.default_rng(7)
    parts: dict[str, list[Shape]] = {"steel": [], "crates": [], "cartons": []}
    for column in range(COLUMNS):
        for row in range(ROWS):
            x0, z0 = corner(column, row)
            if (column + row) % 2:
                places = [placement((2.6, 0, 2.2)), placement((2.6, 0, 4.8))]
            else:
                places = [placement((x, 0, 6.4), turn=90.0) for x in (2.4, 4.7, 7.0)]
            for place in places:
                for name, shape in rack(4.8, rng).items():
                    parts[name].append(shape.transformed(placement((x0, 0, z0)) @ place))
            for x, y, z in ((0.8, 0.0, 7.2), (1.75, 0.0, 7.25), (0.75, 0.0, 6.25), (0.85, 0.8, 7.1)):
                size = 0.8 if y == 0 else rng.uniform(0.4, 0.6)
                crate = box((-size / 2, 0, -size / 2), (size / 2, size, size / 2), 0.015).turned(rng.uniform(-12, 12))
                parts["crates"].append(crate.moved(x0 + x, y, z0 + z))
    return {name: merge(shapes).box_mapped() for name, shapes in parts.items()}


def scene() -> Scene:
    """Return the warehouse; it is closed, and lit by its lamps alone."""
    concrete = materials.concrete()
    half_x, half_z = COLUMNS * WIDTH / 2 + WALL / 2, ROWS * LENGTH / 2 + WALL / 2
    floor = box((-half_x, -0.3, -half_z), (half_x, 0, half_z)).textured(4.0)
    goods = contents()
    steel = materials.plain("blue steel", (0.05, 0.12, 0.30), 0.45, 0.0)
    cartons = materials.plain("cardboard", (0.46, 0.31, 0.18), 0.9)
    nodes = [
        Node("floor", [floor.mesh(concrete, "floor")]),
        Node("walls", [walls().textured(4.0).mesh(materials.concrete("painted wall", (0.70, 0.69, 0.65)), "walls")]),
        Node("racks", [goods["steel"].mesh(steel, "racks")]),
        Node(
            "goods",
            [
                goods["crates"].textured(0.8).mesh(materials.crate_wood(), "crates"),
                goods["cartons"].mesh(cartons, "cartons"),
            ],
        ),
    ]
    housing = materials.plain("lamp housing", (0.5, 0.5, 0.5), 0.5)
    tints = [(RADIANCE * r, RADIANCE * g, RADIANCE * b) for r, g, b in TINTS]
    lights = [materials.lamp(f"lamp {k}", tint) for k, tint in enumerate(tints)]
    for column in range(COLUMNS):
        for row in range(ROWS):
            glow, cases = lamps(column, row)
            light = lights[(column + 2 * row) % len(lights)]
            name = f"lamps {column} {row}"
            nodes.append(Node(name, [glow.mesh(light, name), cases.mesh(housing, f"{name} housings")]))
    cameras = {
        "main": Camera.look_at((-9.7, 1.75, -7.85), (0.0, 1.6, -8.35), hfov=75.0),
        "corner": Camera.look_at((19.3, 2.2, 11.3), (10.0, 1.4, 4.0), hfov=75.0),
    }
    return Scene(nodes, cameras=cameras, name="warehouse")


def camera_path() -> CameraPath:
    """Return a walk along an aisle."""
    keys = (
        CameraKey(0.0, (-9.7, 1.75, -7.85), (0.0, 1.6, -8.35), hfov=75.0),
        CameraKey(47 / 24, (-8.2, 1.75, -7.9), (1.5, 1.6, -8.4), hfov=75.0),
    )
    return CameraPath(keys, name="warehouse")
