"""Visibility polygons: noise-free light of any sky from what vertices see (visibility_correspondence.txt)."""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from numbers import Real
from typing import TYPE_CHECKING, ClassVar, Literal

import warp as wp

from warp_gi.errors import OptionError, unknown_name
from warp_gi.estimator import Estimator
from warp_gi.kernels import visibility_polygons as kernels
from warp_gi.kernels import visibility_polygons_corners as corner_kernels
from warp_gi.kernels import visibility_polygons_shade as shade_kernels
from warp_gi.kernels import visibility_polygons_trace as trace_kernels
from warp_gi.kernels import visibility_polygons_unbiased as unbiased_kernels
from warp_gi.launch import get_device
from warp_gi.scene.baked import whole_scene
from warp_gi.techniques.visibility_polygons.arrays import check_arrays
from warp_gi.techniques.visibility_polygons.bake import (
    bake_polygons,
    check_rests,
    contours_of,
    lists_on,
    polygon_key,
    sets_on,
)
from warp_gi.techniques.visibility_polygons.settings import PolygonSettings
from warp_gi.techniques.visibility_polygons.sky import EVALUATORS, polygon_sky

if TYPE_CHECKING:
    from warp_gi.baking import Bake, Setting
    from warp_gi.frame import Frame
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.camera import Camera, CameraPath
    from warp_gi.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class PolygonState:
    """A bake as kernels read it. It stays as it is over a sequence: the sky is apart."""

    sets: kernels.PolygonSets
    """What vertices see."""
    lists: kernels.PolygonLists
    """What of it belongs together over triangles."""


_states: weakref.WeakKeyDictionary[Bake, dict[str, PolygonState]] = weakref.WeakKeyDictionary()


@dataclass(frozen=True)
class VisibilityPolygons(Estimator):
    """Direct light from the sky, without noise: a pixel interpolates what the corners of its triangle see.

    Every vertex keeps what it sees of the sky as polygons in space; over a triangle the polygons of its corners blend,
    point by point, and the sky is integrated along their edges. Shadows of suns are sharp, and the bake knows no sky:
    under one that turns nothing is rebuilt. Triangles over which this was found too wrong are traced, and so are glossy
    lobes. Biased by what is interpolated, up to ``flagged_above``, except in the mode "unbiased". For scenes at rest.
    Source: "Visibility correspondence" (visibility_correspondence.txt).
    """

    term: ClassVar[str] = "environment"

    mode: Literal["interpolated", "unbiased"] = "interpolated"
    """What is made of the light through polygons: "interpolated" takes it as it is; "unbiased" corrects it by samples
    of the sky, of which it is the control variate, with much less noise than theirs."""
    evaluations: Literal[1, 3] = 1
    """Integrals a pixel: 1 of what the corners of its triangle see, blended; 3, as was done before, of what each of
    them sees, moved to the pixel, whose light is blended: slower, and mostly less true. For comparison."""
    evaluator: Literal["adaptive", "exact"] = "adaptive"
    """How the sky is integrated: "adaptive" takes bright texels exactly and the rest from a summed-area table, halving
    edges where that is not enough; "exact" integrates over all texels, and takes several times as long."""
    tolerance: float = 1e-3
    """Share of the sky's mean irradiance by which one edge may be off before "adaptive" halves it."""
    resolution: int = 64
    """Rays along a side of the map of a vertex's hemisphere; gaps that are narrower than 90 degrees over it may be
    missed."""
    simplified: float = 0.5
    """Degrees by which the contours of a vertex may be off once they are simplified; 0 keeps all points."""
    flagged_above: float = 0.05
    """Share of light under a uniform sky that may be wrong at a point of a triangle, by rays of the bake, before the
    triangle is flagged and its pixels are traced."""

    def validate(self) -> None:
        """Raise OptionError for settings out of range."""
        if self.evaluator not in ("adaptive", "exact"):
            raise unknown_name("evaluator of visibility polygons", self.evaluator, ("adaptive", "exact"))
        if self.mode not in ("interpolated", "unbiased"):
            raise unknown_name("mode of visibility polygons", self.mode, ("interpolated", "unbiased"))
        if self.evaluations not in (1, 3) or isinstance(self.evaluations, bool):
            raise OptionError(f"evaluations must be 1 or 3, got {self.evaluations!r}")
        if self.evaluations == 3 and self.mode == "unbiased":
            raise OptionError('mode "unbiased" corrects one integral a pixel, not 3: take evaluations 1')
        size = self.resolution
        if isinstance(size, bool) or not isinstance(size, int) or not 8 <= size <= 256:
            raise OptionError(f"resolution must be a whole number from 8 to 256, got {size!r}")
        for name, low, high in (("tolerance", 1e-6, 1.0), ("simplified", 0.0, 10.0), ("flagged_above", 0.0, 1.0)):
            value = getattr(self, name)
            if not (isinstance(value, Real) and math.isfinite(value) and low <= float(value) <= high):
                raise OptionError(f"{name} must be a number from {low:g} to {high:g}, got {value!r}")

    @property
    def polygon_settings(self) -> PolygonSettings:
        """The settings that decide what is baked."""
        return PolygonSettings(self.resolution, float(self.simplified), float(self.flagged_above))

    # ---- bake ----

    def bake_key(self, scene: Scene | BakedScene) -> str:
        """Return the hash of geometry and normals: nothing else decides a bake."""
        return polygon_key(whole_scene(scene))

    def bake_settings(self, scene: Scene | BakedScene) -> dict[str, Setting]:
        """Return the settings that the bake depends on."""
        return self.polygon_settings.stored()

    def bake_identity(self, scene: Scene | BakedScene, camera: Camera | CameraPath | None = None) -> str:
        """Return the hash of what is baked: never the sky, and no view."""
        return self.bake_key(scene)

    def bake(
        self,
        scene: Scene,
        device: str,
        seed: int = 0,
        progress: Callable[[float], None] | None = None,
        camera: Camera | CameraPath | None = None,
    ) -> Bake:
        """Return the polygons of all vertices. Raises SceneError where something moves, or nothing has an area."""
        return bake_polygons(scene, self.polygon_settings, device, seed, progress)

    def start(self, scene: Scene | BakedScene, device: str, bake: Bake | None = None, seed: int = 0) -> PolygonState:
        """Return the bake on the device. Raises SceneError where something moves."""
        scene = whole_scene(scene)
        check_rests(scene)
        bake = bake or self.bake(scene, device, seed)
        known = _states.setdefault(bake, {})
        if device not in known:
            check_arrays(bake, scene.triangle_count)
            target, arrays = get_device(device), bake.arrays
            sets = sets_on(arrays["positions"], arrays["normals"], contours_of(bake), target)
            known[device] = PolygonState(sets, lists_on(arrays, target))
        return known[device]

    # ---- frames ----

    def kernels(self, scene: Scene | BakedScene | None = None) -> tuple[wp.Kernel, ...]:
        """Return the kernels of light through polygons, and of traced light."""
        known = (self._shading, trace_kernels.trace_polygons)
        if self.mode == "unbiased":
            return (*known, unbiased_kernels.correct_polygons, unbiased_kernels.trace_unbiased)
        return known

    @property
    def _shading(self) -> wp.Kernel:
        return corner_kernels.shade_corners if self.evaluations == 3 else shade_kernels.shade_polygons

    def trace(self, frame: Frame, state: PolygonState) -> None:
        """Add the light of the current camera sample."""
        environment = getattr(frame.scene, "environment", None)
        if environment is None or environment.is_black:
            return
        skies = {}
        for evaluator in EVALUATORS if self.mode == "unbiased" else (self.evaluator,):
            skies[evaluator] = polygon_sky(environment, evaluator, self.tolerance, frame.device)
        sky = skies[self.evaluator]
        buffers = trace_kernels.PolygonBuffers()
        buffers.width, buffers.height = frame.camera.resolution
        buffers.unbiased = int(self.mode == "unbiased")
        buffers.environment = frame["environment"]
        buffers.moment1, buffers.moment2 = frame.moments("environment")
        buffers.known = wp.empty(buffers.width * buffers.height, dtype=wp.vec3, device=frame.device)
        inputs = [frame.data, frame.pass_settings, state.sets, state.lists, sky, frame.hits, buffers]
        frame.launch_tiled(self._shading, inputs)
        frame.launch_tiled(
            trace_kernels.trace_polygons, [frame.data, frame.pass_settings, state.lists, frame.hits, buffers]
        )
        if self.mode == "unbiased":
            if self.evaluator != "exact":
                inputs[4] = skies["exact"]
                frame.launch_tiled(unbiased_kernels.correct_polygons, inputs)
            frame.launch_tiled(unbiased_kernels.trace_unbiased, inputs)
