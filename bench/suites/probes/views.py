"""Views that light field probes are measured on: bakes by their settings, and the path tracer's pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness.measure import Row, Times
from warp_gi.bench.harness.places import PLACES
from warp_gi.bench.harness.scenes import REFERENCE_DEPTH
from warp_gi.bench.harness.stages import LAMBERT, PLAIN, Case, Stage, View
from warp_gi.metrics import RELATIVE_EPSILON

SEED = 7


CORNELL = Case("cornell_box", materials=LAMBERT)
LIVING_ROOM = Case("living_room", target=50.0, materials=LAMBERT)
ROOM = Case("living_room_all", target=50.0, materials=LAMBERT)
"""View that looks the other way, into the living room; that of `LIVING_ROOM` is near its windows."""
GLOSSY_LIVING_ROOM = Case("living_room_all", "living room, its materials", materials=PLAIN)
SPONZA = Case("sponza", target=50.0, materials=LAMBERT)


@dataclass
class ProbeView(View):
    """A view of light field probes, with the path tracer's pictures to compare them with, which are made once."""

    reference_spp: int = 64
    _halves: list[np.ndarray] = field(default_factory=list)

    def stage(self, spp: int, **settings: Any) -> Stage:
        """Return the stage of probes at ``spp`` samples a pixel."""
        estimator = gi.LightFieldProbes(**settings)
        return Stage(self.scene, self.camera, estimator, spp, self.device, self.bake(estimator)[0], SEED)

    def paths(self, spp: int, seed: int = SEED) -> Stage:
        """Return the stage of the path tracer at ``spp`` samples a pixel."""
        return Stage(self.scene, self.camera, gi.BsdfPaths(max_depth=REFERENCE_DEPTH), spp, self.device, seed=seed)

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
        """Return the mean squared error against what the path tracer would give without noise."""
        return mean_squared(picture, self.halves, relative)

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


def view_of(place: Case, size: tuple[int, int], device: str, reference_spp: int) -> ProbeView:
    """Return the view of a place at a size in pixels."""
    return ProbeView(place.scene(), place.camera().at_resolution(*size), device, reference_spp=reference_spp)


def room_views(size: tuple[int, int], device: str, reference_spp: int) -> dict[str, ProbeView]:
    """Return the views of the rooms "lit" and "dark" of two; what one bakes, for both cameras, the other has too."""
    rooms = {"lit": PLACES["two_rooms"], "dark": PLACES["two_rooms_dark"]}
    scene = rooms["lit"].scene()
    cameras = {name: room.camera().at_resolution(*size) for name, room in rooms.items()}
    path, bakes = gi.CameraPath.from_cameras(cameras.values()), dict[str, tuple[gi.Bake, Times]]()
    return {name: ProbeView(scene, camera, device, path, bakes, reference_spp) for name, camera in cameras.items()}


def mean_squared(values: np.ndarray, halves: Sequence[np.ndarray], relative: bool = False) -> float:
    """Return the mean squared error of float [..., 3] against what two halves are noisy estimates of.

    Errors against one half times errors against the other: the noise of independent halves has mean 0.
    """
    a, b = (half.astype(np.float64) for half in halves)
    weight = 1.0 / (((a + b) / 2) ** 2 + RELATIVE_EPSILON) if relative else 1.0
    return max(float(np.mean((values - a) * (values - b) * weight)), 0.0)


def counts_of(stage: Stage) -> str:
    """Return a stage's probes along x, y and z in words."""
    return " x ".join(map(str, stage.state.grid.counts))
