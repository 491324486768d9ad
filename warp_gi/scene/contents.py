"""The protocol by which the buffers on devices, and the watch over edits, read a scene."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from warp_gi.scene.geometry import FlatGeometry
from warp_gi.scene.hulls import Hulls
from warp_gi.scene.model import Material, Node, PunctualLight
from warp_gi.scene.poses import Pose

if TYPE_CHECKING:
    from warp_gi.scene.emission_grids import LightGrids
    from warp_gi.scene.environment import Environment


class Forgetful(Protocol):
    """Hashes that are computed anew after an edit."""

    def forget(self, *names: str) -> None:
        """Compute some of them anew when they are asked for."""
        ...


class SceneContents(Protocol):
    """A ``Scene`` as its own parts see it: the buffers on devices, and the watch over edits."""

    name: str
    version: int
    """Number of changes so far."""
    moved: int
    """Number of edits so far of the way that nodes move, which every frame reads anew."""
    nodes: list[Node]
    lights: list[PunctualLight]
    materials: list[Material]
    _flat: FlatGeometry
    """Copy of the geometry of all nodes at time 0, in world space."""
    _emissive: np.ndarray
    """Indices of the triangles that emit, int64 [emissive triangle]."""
    _light_grids: LightGrids
    """How points on them are sampled."""
    _moving: list[bool]
    """Whether each node moves, by its index."""
    _poses: list[Pose]
    """Pose of each node at time 0."""
    _hulls: Hulls
    """Boxes around what moves and changes its shape."""
    _bounds: np.ndarray
    """Lowest and highest corner in metres, float32 [2, 3]."""

    @property
    def _digests(self) -> Forgetful:
        """Hashes of what the scene holds."""
        ...

    @property
    def _devices(self) -> Mapping[str, Any]:
        """Buffers on each device (``DeviceScene``), by the device's alias."""
        ...

    @property
    def environment(self) -> Environment | None:
        """The present sky."""
        ...

    @environment.setter
    def environment(self, value: Any) -> None: ...

    @property
    def is_sky_animated(self) -> bool:
        """Whether the environment is a function of time."""
        ...

    @property
    def duration(self) -> float:
        """Time of the last keyframe in seconds."""
        ...

    @property
    def is_animated(self) -> bool:
        """Whether any node moves."""
        ...

    @property
    def triangle_count(self) -> int:
        """Number of triangles."""
        ...

    @property
    def bounds(self) -> np.ndarray:
        """Lowest and highest corner in metres, float32 [2, 3]."""
        ...

    @property
    def radius(self) -> float:
        """Half the diagonal of the bounds in metres."""
        ...

    def emitter_powers(self) -> np.ndarray:
        """Return the power of each emitter [W, as luminance], float64 [emitter_count]."""
        ...

    @property
    def moving_objects(self) -> dict[int, int]:
        """Node of each object (by object id) that can move."""
        ...
