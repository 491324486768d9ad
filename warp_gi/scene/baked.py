"""A scene of which nothing is left but a bake."""

from __future__ import annotations

from typing import Any

import numpy as np

from warp_gi.baking import Bake
from warp_gi.errors import BakeError
from warp_gi.forks import Guard
from warp_gi.kernels import types


class BakedScene:
    """Stands for the scene of a bake that holds enough to be rendered alone: no geometry, no lights, no sky.

    Raises BakeError for a bake that does not say where its scene was.
    """

    version = 0
    environment = None
    is_animated = False
    is_sky_animated = False
    triangle_count = 0
    emitter_count = 0
    nodes: tuple[()] = ()

    def __init__(self, bake: Bake) -> None:
        if "bounds" not in bake.arrays:
            raise BakeError(
                f"a bake of {bake.technique} cannot be rendered without its scene; a bake of LightFieldProbes can"
            )
        self._guard = Guard()
        self.bake = bake
        self.name = bake.scene_name
        self.contents_hash = bake.scene_key
        self.hash = bake.digest
        self.cameras: dict[str, Any] = {}

    @property
    def lock(self) -> Any:
        """A re-entrant lock, as that of a ``Scene``."""
        return self._guard.lock

    @property
    def bounds(self) -> np.ndarray:
        """Lowest and highest corner, float32 [2, 3], metres."""
        return self.bake.arrays["bounds"]

    def update(self, *times: Any) -> bool:
        """Return False: nothing moves."""
        return False

    def update_sky(self, time: float) -> bool:
        """Return False: the sky is that of the bake."""
        return False

    def check_unchanged(self) -> None:
        """Do nothing: there is nothing to edit."""

    def data(self, device: Any = None) -> types.SceneData:
        """Return buffers that hold nothing."""
        return types.SceneData()
