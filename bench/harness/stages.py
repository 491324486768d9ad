"""What the benchmarks of estimators share: places that they look at, and stages of a frame that are timed alone."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

import warp_gi as gi
from warp_gi.bench.harness import scenes
from warp_gi.bench.harness.measure import Taken, Times, take_turns, timed
from warp_gi.bench.harness.places import PLACES
from warp_gi.frame import TERMS

LAMBERT: Mapping[str, bool] = {"diffuse": True}
DARK: Mapping[str, bool] = {"diffuse": True, "emission": False}
PLAIN: Mapping[str, bool] = {"diffuse": False}
"""Settings of `scenes.peer_scene`."""


@dataclass(frozen=True)
class Case:
    """A place as a suite measures it."""

    place: str
    """Key in `PLACES`."""
    name: str = ""
    """Name in rows; the place's title if not given."""
    target: float = 0.0
    """Target: how many times faster than the baseline the estimator is to be."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the estimator that are not its defaults."""
    materials: Mapping[str, bool] | None = None
    """Settings of `scenes.peer_scene` for the materials; None leaves them as they are."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.name or PLACES[self.place].title)

    @property
    def missing(self) -> str:
        """Message about the place's files that are missing; empty if none are."""
        return PLACES[self.place].missing

    def scene(self) -> gi.Scene:
        """Return the scene with its materials as they are measured."""
        scene = PLACES[self.place].scene()
        return scene if self.materials is None else scenes.peer_scene(scene, **self.materials)

    def path(self) -> gi.CameraPath:
        """Return the place's camera path."""
        return PLACES[self.place].path()

    def camera(self) -> gi.Camera:
        """Return the camera of the path's first frame."""
        return PLACES[self.place].camera()


class Stage:
    """A frame of one term, which can be traced again and again: primary rays and bake are done.

    Stages of one scene, camera, number of samples and seed draw the same samples, so what differs between their
    pictures is what their estimators make of them. Rays start at what is seen in the middle of a pixel.
    """

    def __init__(
        self, scene: gi.Scene, camera: gi.Camera, estimator: Any, spp: int, device: str, bake: Any = None, seed: int = 0
    ) -> None:
        terms = dict.fromkeys(TERMS) | {estimator.term: estimator}
        pipeline = gi.Pipeline(**terms, spp=spp, camera_samples=1)
        bakes = [bake] if bake is not None else []
        scheduler = gi.FrameScheduler(scene, camera, pipeline, device, seed=seed, bakes=bakes)
        self.estimator, self.spp = estimator, spp
        self.frame = scheduler.frame(0)
        self.state: Any = scheduler.state(estimator.term)
        self.picture = self.frame.numpy(estimator.term).copy()
        self.albedo = self.frame.numpy("albedo").copy()

    def trace(self) -> None:
        """Do the stage once more. The buffers then hold sums of several runs, and no picture."""
        self.estimator.trace(self.frame, self.state)
        if self.frame.paths.is_wanted:
            self.frame.trace_paths()
        wp.synchronize_device(self.frame.device)


@dataclass
class View:
    """A scene from a camera on a device; bakes are made once for all settings that give the same one."""

    scene: gi.Scene
    camera: gi.Camera
    device: str = "cpu"
    path: gi.CameraPath | None = None
    """Camera path that bakes are made for; None for the camera alone."""
    bakes: dict[str, tuple[gi.Bake, Times]] = field(default_factory=dict)
    """Bakes and their seconds, by the settings that they depend on."""

    def bake(self, estimator: Any) -> tuple[gi.Bake, Times]:
        """Return the bake and its seconds without compilation."""
        key = repr(estimator.bake_settings(self.scene))
        if key not in self.bakes:
            self.bakes[key] = timed_bake(self.scene, estimator, self.device, self.path or self.camera)
        return self.bakes[key]


def timed_bake(scene: gi.Scene, estimator: Any, device: str, camera: Any = None) -> tuple[gi.Bake, Times]:
    """Return the estimator's bake for a camera or path, and its seconds without compilation."""
    return timed(lambda: gi.bake(scene, estimator, device, camera_path=camera))


def race(stages: Mapping[str, Stage | Callable[[], Any]], repetitions: int, device: str) -> dict[str, Taken[Any]]:
    """Return times and results of stages, or calls, that take turns."""
    works = {name: stage.trace if isinstance(stage, Stage) else stage for name, stage in stages.items()}
    return take_turns({name: _each_turn(work) for name, work in works.items()}, repetitions, device)


def _each_turn(work: Callable[[], Any]) -> Callable[[int], Any]:
    """Return a call that takes the number of the turn, and does the same in each."""
    return lambda turn: work()


def rmse(a: np.ndarray, b: np.ndarray | float = 0.0) -> float:
    """Return the root of the mean squared difference."""
    return float(np.sqrt(np.mean(np.square(np.asarray(a, np.float64) - b))))
