"""A scene of which nothing is left but a bake."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_gi.baking import Bake
from warp_gi.errors import BakeError, OptionError
from warp_gi.forks import Guard
from warp_gi.kernels import types
from warp_gi.layout import Layout, check_layout

if TYPE_CHECKING:
    from warp_gi.scene.pinhole import Camera
    from warp_gi.scene.scene import Scene


class BakedScene:
    """A scene of which only a bake is left. It has no geometry, no lights and no sky, and still can be rendered.

    Raises BakeError for a bake that does not say where its scene was.
    """

    version = moved = 0
    environment = None
    is_animated = False
    is_sky_animated = False
    sky_at = None
    triangle_count = 0
    emitter_count = 0
    nodes: tuple[()] = ()

    def __init__(self, bake: Bake) -> None:
        if "bounds" not in bake.arrays:
            raise BakeError(
                f"a bake of {bake.technique} cannot be rendered without its scene; a bake of LightFieldProbes can"
            )
        places = {"bounds": Layout("float32 float64", (2, 3)), "offset": Layout("float64", (3,))}
        wanted = {name: layout for name, layout in places.items() if name in bake.arrays}
        check_layout(f"this bake of {bake.scene_name!r}", bake.arrays, wanted)
        self._guard = Guard()
        self.bake = bake
        self.name = bake.scene_name
        self.contents_hash = self.light_hash = bake.scene_key
        self.hash = bake.digest
        self.cameras: dict[str, Camera] = {}
        self.offset = np.array(bake.arrays.get("offset", (0.0, 0.0, 0.0)), np.float64)
        """That of the scene, as in ``Scene.offset``."""

    @property
    def lock(self) -> threading.RLock:
        """The re-entrant lock of the scene, as in ``Scene.lock``."""
        return self._guard.lock

    @property
    def bounds(self) -> np.ndarray:
        """Lowest and highest corner of the scene in metres, float32 [2, 3]."""
        return self.bake.arrays["bounds"]

    def update(
        self, time: float, previous_time: float | None = None, device: wp.DeviceLike = None, trail: object = None
    ) -> bool:
        """Return False: nothing moves."""
        return False

    def trail_of(self, index: int, device: wp.DeviceLike = None) -> None:
        """Return None: no frame sees anything move."""

    def update_sky(self, time: float) -> bool:
        """Return False: the sky is that of the bake."""
        return False

    def check_unchanged(self) -> None:
        """Do nothing: there is nothing to edit."""

    def data(self, device: wp.DeviceLike = None) -> types.SceneData:
        """Return buffers that hold nothing."""
        return types.SceneData()


def whole_scene(scene: Scene | BakedScene) -> Scene:
    """Return a scene that has geometry and lights; raises OptionError for one of which only a bake is left."""
    if isinstance(scene, BakedScene):
        raise OptionError(f"only a bake of {scene.name!r} was given, but this needs the scene itself; give the scene")
    return scene
