"""The places that suites, truth tests and previews look at: one table of scene, camera path, light and picture size."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import warp_gi as gi
from warp_gi.bench.harness import scenes

Color = tuple[float, float, float]
Point = tuple[float, float, float]

WHITE: Color = (1.0, 1.0, 1.0)
COURTYARD, INTERIOR = "environments/courtyard.exr", "environments/interior.exr"
_SPONZA, _BISTRO = "crytek_sponza.glb", "bistro_exterior.glb"


@dataclass(frozen=True)
class Place:
    """A scene with its light and its camera."""

    title: str
    source: str | Callable[[], gi.Scene]
    """A file in `scenes.SCENES`, the name of a built-in scene, or a function that builds one."""
    view: gi.CameraPath | str = ""
    """Where it is seen from, and at which size: a path, or the name of a camera of the built-in scene; its own path."""
    environment: Color | str | None = None
    """Radiance of a constant sky, or a file in `scenes.SCENES`; None leaves the scene its own sky."""
    reads: tuple[str, ...] = ()
    """Files in `scenes.SCENES` that the function ``source`` reads."""

    @property
    def files(self) -> tuple[str, ...]:
        """Files that must be in `scenes.SCENES`, the geometry first."""
        files = [*self.reads]
        if isinstance(self.source, str) and "." in self.source:
            files.append(self.source)
        if isinstance(self.environment, str):
            files.append(self.environment)
        return tuple(files)

    @property
    def missing(self) -> str:
        """Message about files that are missing; empty if none are."""
        return missing(self.files)

    def scene(self) -> gi.Scene:
        """Build or load the scene; raises SceneError if a file is missing."""
        if not isinstance(self.source, str):
            scene = self.source()
        elif "." in self.source:
            scene = gi.load_scene(scenes.SCENES / self.source)
        else:
            scene = gi.builtin_scene(self.source)
        if isinstance(self.environment, str):
            scene.environment = scenes.SCENES / self.environment
        elif self.environment is not None:
            scene.environment = self.environment
        return scene

    def path(self) -> gi.CameraPath:
        """Return the camera path; it has one key if the camera stands still."""
        if isinstance(self.view, gi.CameraPath):
            return self.view
        if not isinstance(self.source, str):
            raise TypeError("a scene that a function builds needs a camera path as `view`")
        if self.view:
            return gi.CameraPath.from_scene(gi.builtin_scene(self.source), self.view)
        return gi.builtin_camera_path(self.source)

    def camera(self, frame: int = 0) -> gi.Camera:
        """Return the camera of a frame."""
        return self.path().camera(frame)


def missing(files: Iterable[str]) -> str:
    """Return a message about those files that are not in `scenes.SCENES`; empty if all are."""
    absent = ", ".join(str(scenes.SCENES / name) for name in files if not (scenes.SCENES / name).exists())
    return f"no {absent}; set WARP_GI_SCENES to the folder of the scene files" if absent else ""


def _still(eye: Point, target: Point, hfov: float, resolution: tuple[int, int] = (960, 540)) -> gi.CameraPath:
    (x, y, z), (u, v, w) = map(float, eye), map(float, target)
    key = gi.CameraKey(0.0, (x, y, z), (u, v, w), hfov=hfov)
    return gi.CameraPath((key,), resolution=resolution)


_NAVE = _still((-11, 1.5, -0.3), (5, 4, 0), 65.0)
_FLIGHT = gi.CameraPath(
    (
        gi.CameraKey(0.0, (-11.0, 1.5, -0.3), (5.0, 4.0, 0.0)),
        gi.CameraKey(1.0, (-1.0, 1.8, 0.0), (15.0, 4.0, 0.0)),
        gi.CameraKey(2.0, (9.0, 2.0, 0.3), (25.0, 4.0, 0.0)),
    )
)
_GALLERY = _still((-9, 6.2, 4.6), (6, 3, -3), 65.0)
_FLOOR = _still((8, 0.4, -0.8), (-6, 0.2, 1.5), 65.0)
_WINDOWS = _still((0, 1, 4), (0.5, 1.2, 0), 60.0)
_INTO_THE_ROOM = _still((0, 1.3, 1.2), (0.3, 1.1, 6), 60.0)
_ROOFS = _still((-40, 45, -60), (-10, 0, -10), 60.0)
_VEACH = _still((16.2155, 4.05167, 0.0115), (0.0, 3.9759, -0.07), 35.0, (540, 540))
_ROW = _still((0, 1.6, 7), (0, 1.1, 0), 50.0)

PLACES: dict[str, Place] = {
    # built in
    "atrium": Place("atrium", "atrium"),
    "atrium_white": Place("atrium, white sky", "atrium", environment=WHITE),
    "cornell_box": Place("Cornell box", "cornell_box"),
    "lamp_wall": Place("wall of lamps", "lamp_wall"),
    "mine": Place("mine", "mine"),
    "mine_spot": Place("mine, spot", "mine", "spot"),
    "plates": Place("plates", "plates"),
    "shaded_lamp": Place("lamps behind shades", "shaded_lamp"),
    "sphere_row": Place("sphere_row", "sphere_row", "main"),
    "street": Place("street", "street"),
    "street_white": Place("street, white sky", "street", environment=WHITE),
    "two_rooms": Place("two rooms, the lit one", "two_rooms"),
    "two_rooms_dark": Place("two rooms, the dark one", "two_rooms", _still((3.7, 1.7, 1.8), (1.2, 0.9, -1.2), 75.0)),
    "warehouse": Place("warehouse", "warehouse"),
    "white_room": Place("white room", "white_room"),
    # built here
    "cylinders": Place("cylinders", scenes.cylinder_box, _still((0, 8.5, 0.01), (0, 0, 0), 42.0, (540, 540))),
    "guiding_ring": Place("guiding_ring", scenes.guiding_ring, _still((0, 6, 0.01), (0, 0, 0), 26.0, (540, 540))),
    "spheres": Place("spheres, lamp", scenes.spheres, _ROW, (0.2, 0.3, 0.5)),
    "spheres_interior": Place("spheres, interior sky", scenes.spheres, _ROW, INTERIOR),
    "strobe": Place("strobe", scenes.strobe, _still((-1.5, 1.6, 2.8), (0.3, 0.9, -1.0), 75.0)),
    # of files
    "bistro": Place("Bistro", _BISTRO, _ROOFS),
    "bistro_white": Place("Bistro, white sky", _BISTRO, _ROOFS, WHITE),
    "bistro_wide": Place("Bistro, white sky, 65 degrees", _BISTRO, _still((-40, 45, -60), (-10, 0, -10), 65.0), WHITE),
    "dragon": Place(
        "dragon", scenes.covered_dragon, _still((0.6, 1.3, 2.7), (0.0, 0.7, 0.0), 60.0), reads=(scenes.DRAGON,)
    ),
    "dragon_white": Place("dragon, white sky", scenes.DRAGON, _still((0.0, 0.15, 0.45), (0.0, 0.12, 0.0), 30.0), WHITE),
    "living_room": Place("living room", scenes.lit_room, _WINDOWS, reads=(scenes.LIVING_ROOM,)),
    "living_room_all": Place("living room, all", scenes.lit_room, _INTO_THE_ROOM, reads=(scenes.LIVING_ROOM,)),
    "living_room_white": Place("living room, white sky", scenes.LIVING_ROOM, _WINDOWS, WHITE),
    "veach_bidir": Place("Veach's lamps", "veach_bidir.glb", _VEACH),
    "modern_hall": Place("modern hall", "modern_hall.glb", _still((4, 1.7, 2), (-3, 1.6, -0.5), 60.0)),
    "sponza": Place("Sponza", _SPONZA, _NAVE, WHITE),
    "sponza_courtyard": Place("Sponza, courtyard sky", _SPONZA, _NAVE, COURTYARD),
    "sponza_flight": Place("Sponza, flight", _SPONZA, _FLIGHT, WHITE),
    "sponza_floor": Place("Sponza, floor", _SPONZA, _FLOOR, WHITE),
    "sponza_floor_courtyard": Place("Sponza, floor, courtyard sky", _SPONZA, _FLOOR, COURTYARD),
    "sponza_gallery": Place("Sponza, gallery", _SPONZA, _GALLERY, WHITE),
    "sponza_gallery_courtyard": Place("Sponza, gallery, courtyard sky", _SPONZA, _GALLERY, COURTYARD),
}
"""Places by key. Suites name keys, and add what is theirs: targets, settings of estimators, depths, sizes."""
