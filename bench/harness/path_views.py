"""Views of the indirect term with the path tracer's pictures of it, to compare those of others with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness.measure import Row, Times
from warp_gi.bench.harness.places import PLACES
from warp_gi.bench.harness.scenes import REFERENCE_DEPTH
from warp_gi.bench.harness.stages import Case, Stage, View
from warp_gi.metrics import RELATIVE_EPSILON

SEED = 7
TOO_DARK = 0.05
"""Share of the reference's mean above which a pixel of the reference must not be 0 in ours."""


@dataclass
class PathView(View):
    """A view with the path tracer's pictures of its indirect light, which are made once."""

    reference_spp: int = 64
    _halves: list[np.ndarray] = field(default_factory=list)

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


V = TypeVar("V", bound=PathView)


def view_of(kind: type[V], place: Case, size: tuple[int, int], device: str, reference_spp: int) -> V:
    """Return the view of a place at a size in pixels."""
    return kind(place.scene(), place.camera().at_resolution(*size), device, reference_spp=reference_spp)


def room_views(kind: type[V], size: tuple[int, int], device: str, reference_spp: int) -> dict[str, V]:
    """Return the views of the rooms "lit" and "dark" of two; what one bakes, for both cameras, the other has too."""
    rooms = {"lit": PLACES["two_rooms"], "dark": PLACES["two_rooms_dark"]}
    scene = rooms["lit"].scene()
    cameras = {name: room.camera().at_resolution(*size) for name, room in rooms.items()}
    path, bakes = gi.CameraPath.from_cameras(cameras.values()), dict[str, tuple[gi.Bake, Times]]()
    return {name: kind(scene, camera, device, path, bakes, reference_spp) for name, camera in cameras.items()}


def black_share(picture: np.ndarray, reference: np.ndarray) -> float:
    """Return the share of pixels that are exactly 0 although the reference is not: above ``TOO_DARK`` of its mean."""
    lit = reference.mean(axis=-1) > TOO_DARK * reference.mean()
    return float((lit & (picture.max(axis=-1) <= 0)).mean())


def mean_squared(values: np.ndarray, halves: Sequence[np.ndarray], relative: bool = False) -> float:
    """Return the mean squared error of float [..., 3] against what two halves are noisy estimates of.

    Errors against one half times errors against the other: the noise of independent halves has mean 0.
    """
    return mean_product(values, values, halves, relative)


def mean_product(one: np.ndarray, other: np.ndarray, halves: Sequence[np.ndarray], relative: bool = False) -> float:
    """Return the mean product of the errors of two estimates float [..., 3], 0 at least; see ``mean_squared``.

    Of independent estimates with the same bias it is the squared bias: neither their noise nor that of halves is in it.
    """
    a, b = (half.astype(np.float64) for half in halves)
    weight = 1.0 / (((a + b) / 2) ** 2 + RELATIVE_EPSILON) if relative else 1.0
    crossed = ((one - a) * (other - b) + (one - b) * (other - a)) / 2
    return max(float(np.mean(crossed * weight)), 0.0)
