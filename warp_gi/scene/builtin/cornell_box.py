"""The Cornell box, 2 m a side, open towards +z."""

from __future__ import annotations

from warp_gi.scene.builtin.materials import lamp, matte
from warp_gi.scene.builtin.shapes import box, merge, quad
from warp_gi.scene.camera import Camera, CameraKey, CameraPath
from warp_gi.scene.model import Node
from warp_gi.scene.scene import Scene

EYE, TARGET, HFOV = (0.0, 1.0, 3.4), (0.0, 1.0, 0.0), 55.0


def scene() -> Scene:
    """Return the box: x and z from -1 to 1, y from 0 to 2; white, red left, green right; a lamp in the ceiling."""
    white, red = matte("white", (0.725, 0.71, 0.68)), matte("red", (0.63, 0.065, 0.05))
    green, light = matte("green", (0.14, 0.45, 0.091)), lamp("lamp", (17.0, 12.0, 4.0))
    shell = merge(
        [
            quad((-1, 0, 1), (2, 0, 0), (0, 0, -2)),
            quad((-1, 2, -1), (2, 0, 0), (0, 0, 2)),
            quad((-1, 0, -1), (2, 0, 0), (0, 2, 0)),
        ]
    )
    left, right = quad((-1, 0, 1), (0, 0, -2), (0, 2, 0)), quad((1, 0, -1), (0, 0, 2), (0, 2, 0))
    short = box((-0.3, 0, -0.3), (0.3, 0.6, 0.3)).turned(-17).moved(0.33, 0, 0.37)
    tall = box((-0.3, 0, -0.3), (0.3, 1.2, 0.3)).turned(18).moved(-0.35, 0, -0.3)
    bulb = quad((-0.25, 1.99, -0.2), (0.5, 0, 0), (0, 0, 0.4))
    nodes = [
        Node("walls", [shell.mesh(white, "white walls"), left.mesh(red, "red wall"), right.mesh(green, "green wall")]),
        Node("short block", [short.mesh(white, "short block")]),
        Node("tall block", [tall.mesh(white, "tall block")]),
        Node("lamp", [bulb.mesh(light, "lamp")]),
    ]
    cameras = {"main": Camera.look_at(EYE, TARGET, hfov=HFOV, resolution=(540, 540))}
    return Scene(nodes, cameras=cameras, name="cornell_box")


def camera_path() -> CameraPath:
    """Return a slow push towards the blocks."""
    keys = (CameraKey(0.0, EYE, TARGET, hfov=HFOV), CameraKey(47 / 24, (0.25, 1.05, 2.9), TARGET, hfov=HFOV))
    return CameraPath(keys, resolution=(540, 540), name="cornell_box")
