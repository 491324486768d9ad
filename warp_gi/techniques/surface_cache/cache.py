"""The radiance cache of surface cells: settings, bake and state."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_gi import launch
from warp_gi.baking import Bake
from warp_gi.errors import BakeError, OptionError, SceneError, check_whole
from warp_gi.kernels.surface_cache import SURFACE_CACHE, SurfaceCells
from warp_gi.kernels.surface_cache_fill import fill_cells
from warp_gi.radiance_cache import RadianceCache
from warp_gi.scene.baked import whole_scene
from warp_gi.scene.hashing import light_of
from warp_gi.stateful import Ahead
from warp_gi.techniques.shared.views import ROW, camera_rows, cameras_of, known_rows
from warp_gi.techniques.surface_cache.cells import NOTHING, with_table
from warp_gi.techniques.surface_cache.fill import FillSettings, camera_boxes, empty_grid, fill, grid_at, tell_over
from warp_gi.techniques.surface_cache.state import CacheState, Refresh, followed, is_moving

if TYPE_CHECKING:
    import warp as wp

    from warp_gi.baking import Setting
    from warp_gi.frame import Frame
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.camera import Camera, CameraPath
    from warp_gi.scene.scene import Scene

LEAST_PATHS = 1000
"""Smallest number of paths. With 1000, a closed box of albedo 0.8 is 1 % darker than it should be."""
SAME_VIEW = 1e-4
"""Largest relative difference between a number of a camera and that of a bake's camera for the two to be the same."""
SAME_PLACE = 0.01
"""The same of its position, in sides of the smallest cell; below that cells cannot tell."""
POSITION = np.isin(np.arange(ROW), (3, 7, 11))
"""Which numbers of a row of ``camera_rows`` are the position: the last column of three rows of a matrix."""


@dataclass(frozen=True)
class SurfaceCache(RadianceCache):
    """Radiance cache of surface cells in a hash grid, which the camera's own paths fill before the first frame.

    A cell knows all light that arrives at the surfaces in it, so a path that ends there needs no shadow ray. Where
    nothing is known a path goes on. Biased: light is averaged over a cell. It is for scenes in which nothing moves.
    """

    is_per_pixel = True

    paths: int = 150_000
    """Number of paths that fill the cells, from pixels of all frames of the camera's path, at least 1000. More paths
    lower the error that more samples a pixel do not; too few leave pictures dark."""
    vertices: int = 8
    """Vertices of such a path; behind its last one the light comes from the cells."""
    cell: float = 0.0
    """Side in metres of a cell near the camera; 0 is a hundredth of the scene's diagonal, but at most 0.15 m. Light
    leaks through walls that are much thinner."""
    growth: float = 0.03
    """Side of a cell over its distance from the camera's path, where that is more than ``cell``."""
    capacity: int = 1 << 19
    """Largest number of cells, of 80 to 160 bytes each with the empty places of the table. Those with the fewest
    samples find no place, and a warning tells of them."""
    traced_below: float = 0.4
    """Roughness below which the specular lobe of a surface where a path ends is traced by one more ray, not read."""
    residual: float = 0.0
    """Share of paths that go on where others end, and correct what cells say: with any share above 0 pictures are
    unbiased, with more noise the smaller it is. 0 corrects nothing."""

    refresh: int = 15_000
    """Number of paths that each frame adds in a scene that moves, at least 1000; others add none."""
    memory: float = 0.8
    """Weight that a sample has one frame later in a scene that moves, in [0, 0.99]. A larger one has less noise, and
    shows changes of the light later."""

    def validate(self) -> None:
        """Raise OptionError for settings out of range."""
        check_whole("refresh", self.refresh, LEAST_PATHS, 1 << 30)
        if not 0 <= self.memory <= 0.99:
            raise OptionError(f"memory must be a weight from 0 to 0.99, got {self.memory}")
        check_whole("paths", self.paths, LEAST_PATHS, 1 << 30)
        check_whole("vertices", self.vertices, 1, 64)
        check_whole("capacity", self.capacity, 1, 1 << 26)
        for name in ("cell", "growth"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise OptionError(f"{name} must be finite and not negative, got {value}")
        if not 0 <= self.traced_below <= 1:
            raise OptionError(f"traced_below must be a roughness from 0 to 1, got {self.traced_below}")
        if not (self.residual == 0 or 0.01 <= self.residual <= 1):
            raise OptionError(f"residual must be 0 or a share from 0.01 to 1, got {self.residual}")

    @property
    def fill_settings(self) -> FillSettings:
        """The settings that decide the cells."""
        return FillSettings(**{one.name: getattr(self, one.name) for one in fields(FillSettings)})

    def kernels(self, scene: Scene | BakedScene | None = None) -> tuple[wp.Kernel, ...]:
        """Return the kernels of the fill."""
        return (fill_cells,)

    def samplers(self, scene: Scene | BakedScene | None = None) -> tuple[Any, ...]:
        """Return the cells, as paths read them."""
        return (SURFACE_CACHE,)

    # ---- bake ----

    def bake_key(self, scene: Scene | BakedScene) -> str:
        """Return the hash of all of the scene, but not of a sky that changes over time."""
        return scene.contents_hash if scene.is_sky_animated else scene.hash

    def state_key(self, scene: Scene | BakedScene) -> str:
        """Return the hash of the light: cells follow what moves, and are filled anew for other materials and lights."""
        return light_of(scene)

    def bake_settings(self, scene: Scene | BakedScene) -> dict[str, Setting]:
        """Return the settings that a bake depends on."""
        return self.fill_settings.stored()

    def bake(
        self,
        scene: Scene,
        device: str,
        seed: int = 0,
        progress: Callable[[float], None] | None = None,
        camera: Camera | CameraPath | None = None,
    ) -> Bake:
        """Return the cells that paths from every frame of ``camera`` fill; the scene's own cameras stand for None.

        Of a scene that moves the bake has no cells, only where they lie: frames fill them. Raises OptionError without
        a camera.
        """
        cameras = cameras_of(camera, every=True) or list(scene.cameras.values())
        if not cameras:
            raise OptionError(
                "a surface cache is filled from where the scene is seen, and no camera is known: give a camera"
            )
        settings, target = self.fill_settings, launch.get_device(device)
        boxes = camera_boxes(cameras, scene)
        grid, sums, vertices = empty_grid(scene, settings, boxes, target), NOTHING, 0
        if not is_moving(scene):
            sums, vertices = fill(scene, settings, grid, cameras, target, seed, progress)
        cells, over = sums.with_levels().most_sampled(settings.capacity)
        tell_over(over, self.capacity)
        arrays = {
            "keys": cells.keys,
            "cells": cells.means(),
            "low": np.array(grid.low, np.float32),
            "side": np.array([grid.side], np.float32),
            "boxes": boxes,
            "cameras": camera_rows(cameras),
        }
        counts: dict[str, int | float] = {
            "cells": len(cells.keys),
            "cells_over": over,
            "vertices": vertices,
            "samples": int(cells.counts.sum()),
        }
        return Bake("SurfaceCache", self.bake_key(scene), settings.stored(), arrays, counts, scene.name)

    def check_view(self, bake: Bake, camera: Camera | CameraPath) -> None:
        """Warn if a bake was made for another camera path: where it has no cells, paths go on.

        Raises BakeError for arrays that do not fit together.
        """
        _check_arrays(bake)
        made_for, wanted = known_rows(bake.arrays["cameras"]), camera_rows(cameras_of(camera))
        apart = np.abs(wanted[:, None] - made_for)
        turned = SAME_VIEW * np.maximum(np.abs(wanted[:, ~POSITION]).max(axis=1, keepdims=True), 1)
        rounding = 2 * np.finfo(np.float32).eps * np.abs(wanted[:, POSITION]).max(axis=1, keepdims=True)
        moved = np.maximum(SAME_PLACE * bake.arrays["side"][0], rounding)
        known = (apart[..., ~POSITION].max(axis=2) <= turned) & (apart[..., POSITION].max(axis=2) <= moved)
        if not known.any(axis=1).all():
            warnings.warn(
                "this bake of a surface cache is of another camera path: where it has no cells, paths go on, with "
                "noise: bake for this camera",
                stacklevel=2,
            )

    def start(self, scene: Scene | BakedScene, device: str, bake: Bake | None = None, seed: int = 0) -> CacheState:
        """Return the cells on the device; none yet in a scene that moves.

        Raises BakeError for arrays that do not fit together.
        """
        whole, target = whole_scene(scene), launch.get_device(device)
        bake = bake or self.bake(whole, device, seed)
        _check_arrays(bake)
        arrays = bake.arrays
        grid: SurfaceCells = grid_at(arrays["low"], float(arrays["side"][0]), self.growth, arrays["boxes"], target)
        grid.traced_below, grid.residual = self.traced_below, self.residual
        cells = with_table(grid, arrays["keys"], arrays["cells"], target)
        return CacheState(cells, bool(is_moving(whole)), whole.geometry_hash)

    # ---- frames ----

    def preprocess(self, frame: Frame, state: CacheState) -> CacheState:
        """Return the cells of this frame: in a scene that moves they get new samples, and old ones lose weight.

        So they do once an edit has moved something.
        """
        if not state.follows and state.geometry == whole_scene(frame.scene).geometry_hash:
            return state
        return followed(frame, state, self.fill_settings, Refresh(self.refresh, self.memory))

    def depends_on_past(self, scene: Scene | BakedScene, ahead: Ahead | None = None) -> bool:
        """Return whether the scene or its sky moves; of one at rest the bake is all that is kept."""
        return bool(is_moving(scene))

    @property
    def saves_state(self) -> bool:
        """True: cells hold all that earlier frames left."""
        return True

    def give(self, frame: Frame, state: CacheState) -> None:
        """Let paths end in the cells."""
        frame.paths.use_cache(SURFACE_CACHE, state.cells)


def check_still(scene: Scene) -> None:
    """Raise SceneError for a scene in which something moves, or whose sky does: there is nothing to bake."""
    moving = is_moving(scene)
    if moving:
        raise SceneError(
            f"a surface cache is baked of a scene at rest, and here {moving}: there frames fill the cells as they are "
            "rendered; leave the bake out"
        )


def _check_arrays(bake: Bake) -> None:
    """Raise BakeError for a bake whose arrays do not fit together."""
    if not _is_whole(bake.arrays):
        raise BakeError(
            f"this bake of {bake.scene_name!r} does not hold a surface cache that fits together: bake again"
        )


def _is_whole(arrays: dict[str, np.ndarray]) -> bool:
    """Return whether arrays have their shapes and types, keys are in order, and all else is finite."""
    if any(np.ndim(arrays.get(name, 0)) == 0 for name in ("keys", "boxes")) or np.ndim(arrays.get("cameras", 0)) != 2:
        return False
    arrays = arrays | {"cameras": known_rows(arrays["cameras"])}
    count = len(arrays["keys"])
    wanted = {
        "keys": (np.uint64, (count,)),
        "cells": (np.float32, (count, 8)),
        "low": (np.float32, (3,)),
        "side": (np.float32, (1,)),
        "boxes": (np.float32, (len(arrays["boxes"]), 2, 3)),
        "cameras": (np.float32, (len(arrays["cameras"]), ROW)),
    }
    has_shape = all(
        name in arrays and arrays[name].dtype == dtype and arrays[name].shape == shape
        for name, (dtype, shape) in wanted.items()
    )
    if not has_shape or not len(arrays["boxes"]) or not arrays["side"][0] > 0:
        return False
    if not all(np.isfinite(arrays[name]).all() for name in wanted):
        return False
    keys = arrays["keys"]
    return bool((keys[:1] > 0).all() and (keys[1:] > keys[:-1]).all())
