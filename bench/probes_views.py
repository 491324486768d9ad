"""Views that light field probes are measured on: bakes by their settings, and the path tracer's pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi.bench import presets
from warp_gi.bench.measure import Row, Times
from warp_gi.bench.stages import Place, Stage, timed_bake
from warp_gi.metrics import RELATIVE_EPSILON

MAX_DEPTH = 16
"""Of the path tracer that is the truth; probes let light bounce until it changes no more."""
SEED = 7


def _cornell() -> gi.Scene:
    return presets.peer_scene(gi.builtin_scene("cornell_box"), diffuse=True)


CORNELL_VIEW = gi.Camera.look_at((0, 1, 3.4), (0, 1, 0), hfov=55.0)
_LIVING_ROOM, _SPONZA = "living_room/living_room.obj", "crytek_sponza.glb"

CORNELL = Place("Cornell box", _cornell, lambda: CORNELL_VIEW)
LIVING_ROOM = Place(
    "living room", partial(presets.living_room, lamp=True), lambda: presets.LIVING_ROOM_VIEW, 50.0, _LIVING_ROOM
)
ROOM_VIEW = gi.Camera.look_at((0, 1.3, 1.2), (0.3, 1.1, 6), hfov=60.0)
"""The other way, into the living room; `presets.LIVING_ROOM_VIEW` is near its windows."""
ROOM = Place("living room, all", partial(presets.living_room, lamp=True), lambda: ROOM_VIEW, 50.0, _LIVING_ROOM)
GLOSSY_LIVING_ROOM = Place(
    "living room, its materials",
    partial(presets.living_room, lamp=True, diffuse=False),
    lambda: ROOM_VIEW,
    0.0,
    _LIVING_ROOM,
)
SPONZA = Place("Sponza", partial(presets.sponza, (1.0, 1.0, 1.0)), lambda: presets.SPONZA_VIEW, 50.0, _SPONZA)


@dataclass
class View:
    """A scene from a camera on a device. Bakes and the path tracer's pictures are made once."""

    scene: gi.Scene
    camera: gi.Camera
    device: str = "cpu"
    reference_spp: int = 64
    bakes: dict[str, tuple[gi.Bake, Times]] = field(default_factory=dict)
    _halves: list[np.ndarray] = field(default_factory=list)

    def bake(self, estimator: gi.LightFieldProbes) -> tuple[gi.Bake, Times]:
        """Return the bake and what it took, compilation apart."""
        key = repr(estimator.bake_settings(self.scene))
        if key not in self.bakes:
            self.bakes[key] = timed_bake(self.scene, estimator, self.device)
        return self.bakes[key]

    def stage(self, spp: int, **settings: Any) -> Stage:
        """Return the stage of probes at ``spp`` samples a pixel."""
        estimator = gi.LightFieldProbes(**settings)
        return Stage(self.scene, self.camera, estimator, spp, self.device, self.bake(estimator)[0], SEED)

    def paths(self, spp: int, seed: int = SEED) -> Stage:
        """Return the stage of the path tracer at ``spp`` samples a pixel."""
        return Stage(self.scene, self.camera, gi.BsdfPaths(max_depth=MAX_DEPTH), spp, self.device, seed=seed)

    @property
    def halves(self) -> list[np.ndarray]:
        """Two pictures of the path tracer, independent of each other and of all stages' samples."""
        if not self._halves:
            self._halves = [self.paths(self.reference_spp, SEED + 1 + half).picture for half in range(2)]
        return self._halves

    @property
    def reference(self) -> np.ndarray:
        """The mean of both halves."""
        return np.mean(self.halves, axis=0)

    def mean_squared(self, picture: np.ndarray, relative: bool = False) -> float:
        """Return the mean squared error against what the path tracer would give without noise.

        Errors against one half times errors against the other: the noise of independent halves has mean 0.
        """
        a, b = (half.astype(np.float64) for half in self.halves)
        weight = 1.0 / (((a + b) / 2) ** 2 + RELATIVE_EPSILON) if relative else 1.0
        return max(float(np.mean((picture - a) * (picture - b) * weight)), 0.0)

    def quality(self, picture: np.ndarray) -> Row:
        """Return the row of a picture's errors."""
        reference = self.reference
        error = self.mean_squared(picture) ** 0.5
        return {
            "mean / paths": float(picture.mean(dtype=np.float64) / reference.mean(dtype=np.float64)),
            "RMSE": error,
            "RMSE / mean": error / float(reference.mean(dtype=np.float64)),
            "relMSE": self.mean_squared(picture, relative=True),
            "FLIP": gi.metrics.flip(picture, reference),
        }


def view_of(place: Place, size: tuple[int, int], device: str, reference_spp: int) -> View:
    """Return the view of a place at a size in pixels."""
    return View(place.scene(), place.camera().at_resolution(*size), device, reference_spp)


# ---- a box with cylinders over probes (light_field_probes.txt, Fig. 10) ----


def cylinder(center: tuple[float, float], radius: float, height: float, material: gi.Material) -> gi.Mesh:
    """Return an upright cylinder with a lid, standing at (x, z) on y = 0, fronts outward."""
    sides = 48
    angle = 2 * np.pi * np.arange(sides) / sides
    ring = np.stack([center[0] + radius * np.sin(angle), 0 * angle, center[1] + radius * np.cos(angle)], axis=1)
    upper_ring, middle = ring + np.array([0, height, 0]), [[center[0], height, center[1]]]
    points = np.concatenate([ring, upper_ring, middle]).astype(np.float32)
    i, j = np.arange(sides), (np.arange(sides) + 1) % sides
    lower, upper = np.stack([i, j, i + sides], axis=1), np.stack([j, j + sides, i + sides], axis=1)
    lid = np.stack([i + sides, j + sides, np.full(sides, 2 * sides)], axis=1)
    return gi.Mesh(points, np.concatenate([lower, upper, lid]).astype(np.int32), material, name="cylinder")


def cylinder_box() -> gi.Scene:
    """Return a box of 6 x 2 x 6 m, open above, with four cylinders; the one in its middle and two more cover probes.

    Probes are at -2.22, 0 and 2.22 along x and z for a grid of 3 x 2 x 3.
    """
    grey = gi.Material("grey", (0.7, 0.7, 0.7), specular=0.0)
    red, blue = (gi.Material(n, c, specular=0.0) for n, c in (("red", (0.7, 0.2, 0.15)), ("blue", (0.15, 0.25, 0.7))))
    walls = [
        presets.quad((-3, 0, 3), (6, 0, 0), (0, 0, -6), grey, "floor"),
        presets.quad((-3, 0, -3), (6, 0, 0), (0, 2, 0), grey, "back"),
        presets.quad((3, 0, 3), (-6, 0, 0), (0, 2, 0), grey, "front"),
        presets.quad((-3, 0, 3), (0, 0, -6), (0, 2, 0), red, "left"),
        presets.quad((3, 0, -3), (0, 0, 6), (0, 2, 0), blue, "right"),
    ]
    places = ((0.0, 0.0, 0.6), (2.2, -2.2, 0.5), (2.2, 0.0, 0.4), (-1.1, 1.2, 0.4))
    columns = [cylinder((x, z), radius, 1.8, grey) for x, z, radius in places]
    lamp = presets.quad((-2.5, 1.95, -2.5), (0.8, 0, 0), (0, 0, 0.8), presets.light((20.0, 20.0, 20.0)), "lamp")
    return gi.Scene([gi.Node("box", [*walls, *columns, lamp])], name="cylinders")


CYLINDERS: Callable[[], gi.Camera] = lambda: gi.Camera.look_at((0, 8.5, 0.01), (0, 0, 0), hfov=42.0)  # noqa: E731
