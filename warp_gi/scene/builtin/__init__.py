"""Scenes made by code: no files, fixed seeds, the same every time.

``builtin_scene(name)`` builds one, ``builtin_camera_path(name)`` is the camera path that shows it.
"""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import TYPE_CHECKING

from warp_gi.errors import unknown_name

if TYPE_CHECKING:
    from warp_gi.scene.camera import CameraPath
    from warp_gi.scene.scene import Scene

BUILTIN_SCENES = {
    "atrium": "two storeys of arcades around a sunlit court, about 170K triangles",
    "cornell_box": "the classic test of colour bleeding, in a box of 2 m",
    "lamp_wall": "a wall of 3,200 small lamps of many colours above a floor with objects",
    "mine": "a cavern and tunnels of rock, lit by a sun-lit spot below a shaft, about 80K triangles",
    "plates": "four metal plates of rising roughness under four ball lamps of equal power, after Veach",
    "shaded_lamp": "a closed room with two lamps whose shades hide their bulbs, so that nearly all light is indirect",
    "sphere_row": "metal spheres of rising roughness on a plane",
    "street": "houses with balconies and trees with many leaves, about 130K triangles",
    "two_rooms": "one lit and one dark room with a thin wall between them",
    "warehouse": "rooms of shelves under hundreds of lamps, most of them hidden from any one point",
    "white_room": "a white room with one window under an overcast sky",
}
"""Built-in scenes by name, with a line about each."""


def builtin_scene(name: str) -> Scene:
    """Return the built-in scene of that name, with cameras (at least "main") and its sky.

    Raises OptionError for an unknown name.
    """
    return _module(name).scene()


def builtin_camera_path(name: str) -> CameraPath:
    """Return the camera path, 48 frames at 24 frames a second, that shows the built-in scene of that name.

    Raises OptionError for an unknown name.
    """
    return _module(name).camera_path()


def _module(name: str) -> ModuleType:
    if name not in BUILTIN_SCENES:
        raise unknown_name("built-in scene", name, BUILTIN_SCENES)
    return importlib.import_module(f"warp_gi.scene.builtin.{name}")
