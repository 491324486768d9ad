"""Two closed rooms with a wall of 2 cm between them: whatever shows in the dark one has leaked."""

from __future__ import annotations

from warp_gi.scene.builtin.materials import lamp, matte
from warp_gi.scene.builtin.shapes import box, icosphere, merge, quad
from warp_gi.scene.camera import Camera, CameraKey, CameraPath
from warp_gi.scene.model import Node
from warp_gi.scene.scene import Scene

WALL = 0.02  # m, centred on x = 0


def scene() -> Scene:
    """Return the lit room (x from -4 to 0), the dark room (x from 0 to 4), both 3 m high and 4 m deep."""
    white, grey = matte("white", (0.75, 0.73, 0.70)), matte("grey", (0.4, 0.4, 0.42))
    orange, blue = matte("orange", (0.70, 0.28, 0.07)), matte("blue", (0.10, 0.20, 0.55))
    light = lamp("lamp", (12.0, 11.0, 9.0))
    # walls overlap at the edges, so that there is no gap to leak through
    floor = box((-4.2, -0.2, -2.2), (4.2, 0, 2.2))
    walls = merge(
        [
            box((-4.2, 3, -2.2), (4.2, 3.2, 2.2)),
            box((-4.2, -0.1, -2.2), (-4, 3.1, 2.2)),
            box((4, -0.1, -2.2), (4.2, 3.1, 2.2)),
            box((-4.1, -0.1, -2.2), (4.1, 3.1, -2)),
            box((-4.1, -0.1, 2), (4.1, 3.1, 2.2)),
        ]
    )
    divider = box((-WALL / 2, -0.1, -2.1), (WALL / 2, 3.1, 2.1))
    furniture = [box((0.5, 0, -1.8), (1.7, 0.75, -0.9), 0.02), icosphere(0.4, 3).moved(2.8, 0.4, -0.8)]
    mirrored = [shape.scaled(-1, 1, 1) for shape in furniture]
    bulb = quad((-2.6, 2.98, -0.5), (1.2, 0, 0), (0, 0, 1.0))
    nodes = [
        Node("shell", [floor.mesh(grey, "floor"), walls.mesh(white, "walls")]),
        Node("divider", [divider.mesh(white, "divider")]),
        Node("lit furniture", [mirrored[0].mesh(orange, "chest"), mirrored[1].mesh(blue, "ball")]),
        Node("dark furniture", [furniture[0].mesh(orange, "chest"), furniture[1].mesh(blue, "ball")]),
        Node("lamp", [bulb.mesh(light, "lamp")]),
    ]
    cameras = {
        "main": Camera.look_at((-3.7, 1.7, 1.8), (-1.2, 0.9, -1.2), hfov=75.0),
        "lit": Camera.look_at((-3.7, 1.7, 1.8), (-1.2, 0.9, -1.2), hfov=75.0),
        "dark": Camera.look_at((3.7, 1.7, 1.8), (1.2, 0.9, -1.2), hfov=75.0),
    }
    return Scene(nodes, cameras=cameras, name="two_rooms")


def camera_path() -> CameraPath:
    """Return a pan through the lit room."""
    keys = (
        CameraKey(0.0, (-3.7, 1.7, 1.8), (-1.2, 0.9, -1.2), hfov=75.0),
        CameraKey(47 / 24, (-2.6, 1.6, 1.8), (-1.0, 0.9, -1.2), hfov=75.0),
    )
    return CameraPath(keys, name="two_rooms")
