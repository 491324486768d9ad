"""Views that visibility fields are measured on: one bake for each of their settings, and the stages of a frame."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import warp as wp

import warp_gi as gi
from warp_gi import launch
from warp_gi.bench import presets
from warp_gi.kernels import visibility_field as field_kernels
from warp_gi.kernels import visibility_field_audit as audit_kernels
from warp_gi.techniques.visibility_state import FieldState

Row = dict[str, Any]
Times = tuple[float, float]
"""Wall and CPU seconds."""
WHITE = (1.0, 1.0, 1.0)


@dataclass(frozen=True)
class Place:
    """A scene, diffuse under a white sky, and where it is seen from."""

    name: str
    scene: Callable[[], gi.Scene]
    camera: Callable[[], gi.Camera]
    target: float
    """How many times faster the stage shall be with the field, at 64 samples a pixel."""
    file: str = ""
    settings: dict[str, Any] = field(default_factory=dict)
    """Of its VisibilityField, where not the defaults."""

    @property
    def missing(self) -> str:
        """What to say if the scene's file is not there, or nothing."""
        path = presets.SCENES / self.file
        return "" if not self.file or path.exists() else f"no {path}; set WARP_GI_SCENES"


def _builtin(name: str) -> gi.Scene:
    scene = presets.peer_scene(gi.builtin_scene(name), diffuse=True, emission=False)
    scene.environment = WHITE
    return scene


def _bistro() -> gi.Scene:
    scene = gi.load_scene(presets.SCENES / "bistro_exterior.glb", environment=WHITE)
    return presets.peer_scene(scene, diffuse=True, emission=False)


PLACES = (
    Place("Sponza", lambda: presets.sponza(WHITE), lambda: presets.SPONZA_VIEW, 4.0, "crytek_sponza.glb"),
    Place("atrium", lambda: _builtin("atrium"), lambda: gi.builtin_camera_path("atrium").camera(0), 3.0),
    Place(
        "Bistro",
        _bistro,
        lambda: gi.Camera.look_at((-40, 45, -60), (-10, 0, -10), hfov=60),
        2.0,
        "bistro_exterior.glb",
        {"cell_size": 1.0},
    ),
    Place(
        "street",
        lambda: _builtin("street"),
        lambda: gi.builtin_camera_path("street").camera(0),
        2.0,
        "",
        {"cell_size": 1.0},
    ),
)


def glossy(scene: gi.Scene) -> gi.Scene:
    """Return the scene with every surface coated, of roughness 0.3."""
    nodes = [
        replace(
            node,
            meshes=[
                replace(mesh, material=replace(mesh.material, metallic=0.0, specular=1.0, roughness=0.3))
                for mesh in node.meshes
            ],
        )
        for node in scene.nodes
    ]
    return gi.Scene(nodes, scene.lights, scene.environment, scene.cameras, scene.name)


class Stage:
    """A frame whose sky light can be traced again and again: primary rays and bake are done.

    Stages of one scene, camera and number of samples draw the same samples, so what differs between their pictures
    is what their estimators make of them.
    """

    def __init__(
        self, scene: gi.Scene, camera: gi.Camera, estimator: gi.VisibilityField, spp: int, device: str, bake: Any
    ) -> None:
        pipeline = gi.Pipeline(environment=estimator, emitters=None, indirect=None, spp=spp, camera_samples=1)
        scheduler = gi.FrameScheduler(scene, camera, pipeline, device, bakes=[bake] if bake is not None else [])
        self.estimator, self.spp = estimator, spp
        self.frame = scheduler.frame(0)
        self.state: FieldState = scheduler.state("environment")
        self.picture = self.frame.numpy("environment").copy()
        self.albedo = self.frame.numpy("albedo").copy()

    def trace(self) -> None:
        """Do the stage once more; its sums are no picture any more."""
        self.estimator.trace(self.frame, self.state)
        wp.synchronize_device(self.frame.device)

    @property
    def memory(self) -> int:
        """Bytes of the field on the device."""
        return self.state.masks.nbytes + self.state.slots.nbytes


class View:
    """A scene and a camera; bakes what the camera sees once for each setting that a bake depends on."""

    def __init__(self, scene: gi.Scene, camera: gi.Camera, device: str = "cpu", **settings: Any) -> None:
        self.scene, self.camera, self.device, self.settings = scene, camera, device, settings
        self.bakes: dict[str, gi.Bake] = {}
        self.bake_seconds: dict[str, Times] = {}
        self._cells: dict[float, int] = {}

    def estimator(self, **settings: Any) -> gi.VisibilityField:
        """Return this view's field with other ``settings``."""
        return gi.VisibilityField(**{**self.settings, **settings})

    def with_scene(self, scene: gi.Scene) -> View:
        """Return this view of a scene of the same geometry; the bakes are shared."""
        view = View(scene, self.camera, self.device, **self.settings)
        view.bakes, view.bake_seconds = self.bakes, self.bake_seconds
        return view

    def bake(self, estimator: gi.VisibilityField) -> tuple[gi.Bake, Times]:
        """Return the bake and what it took, compilation apart."""
        key = repr(estimator.bake_settings(self.scene))
        if key not in self.bakes:
            self.bakes[key], self.bake_seconds[key] = timed_bake(self.scene, estimator, self.device, self.camera)
        return self.bakes[key], self.bake_seconds[key]

    def stage(self, spp: int, **settings: Any) -> Stage:
        """Return the stage at ``spp`` samples a pixel."""
        estimator = self.estimator(**settings)
        bake = None if estimator.mode == "traced" else self.bake(estimator)[0]
        return Stage(self.scene, self.camera, estimator, spp, self.device, bake)

    def scene_memory(self, stage: Stage) -> int:
        """Return the bytes of the field if every cell of the scene were baked."""
        size = stage.state.grid.cell_size
        if size not in self._cells:
            state = FieldState(self.scene, launch.get_device(self.device), stage.estimator, 0)
            self._cells[size] = len(state.baker("lasting").find().cells)
        return self._cells[size] * 4 * stage.state.words + stage.state.slots.nbytes


def timed_bake(scene: gi.Scene, estimator: Any, device: str, camera: Any) -> tuple[gi.Bake, Times]:
    """Return what the camera, or path, makes the estimator bake, and seconds without compilation."""
    compiled, wall, cpu = launch.compile_seconds, time.perf_counter(), time.process_time()
    bake = gi.bake(scene, estimator, device, camera_path=camera)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    compiled = launch.compile_seconds - compiled
    return bake, (wall - compiled, max(cpu - compiled, 0.0))


def race(stages: dict[str, Stage], repetitions: int) -> dict[str, Times]:
    """Return the median seconds of each stage; they take turns."""
    times: dict[str, list[Times]] = {name: [] for name in stages}
    for repetition in range(repetitions + 1):
        for name, stage in stages.items():
            wall, cpu = time.perf_counter(), time.process_time()
            stage.trace()
            taken = time.perf_counter() - wall, time.process_time() - cpu
            if repetition:  # the first warms the caches
                times[name].append(taken)
    return {name: tuple(np.median(values, axis=0).tolist()) for name, values in times.items()}


def audit(stage: Stage) -> dict[str, np.ndarray]:
    """Return for each pixel how many of its cosine-weighted rays are in which state, and how many sure ones wrong."""
    frame, state, names = stage.frame, stage.state, audit_kernels.AuditBuffers.vars
    buffers, count = audit_kernels.AuditBuffers(), int(np.prod(frame.camera.resolution))
    for name in names:
        setattr(buffers, name, wp.zeros(count, dtype=wp.int32, device=frame.device))
    inputs = [frame.data, frame.camera_data, frame.pass_settings, state.data, state.query, frame.hits, buffers]
    frame.launch_tiled(audit_kernels.audit_field, inputs)
    return {name: getattr(buffers, name).numpy() for name in names}


def traced_share(stage: Stage, counts: dict[str, np.ndarray]) -> float:
    """Return the share of rays that the stage's mode traces."""
    visible, occluded = counts["visible"], counts["occluded"]
    open_, total = counts["mixed"] + counts["unknown"], visible + occluded + counts["mixed"] + counts["unknown"]
    if stage.estimator.mode == "traced":
        return 1.0
    if stage.estimator.mode == "paper":  # inside one of the masks; what neither has is not traced
        label = counts["label"]
        inside = np.where(label & field_kernels.SLOT_LABEL, visible, occluded) + counts["mixed"]
        open_ = np.where(label < 0, total, inside)
    elif stage.estimator.mode == "unbiased":
        open_ = open_ + stage.estimator.verify * (visible + occluded)
    return float(open_.sum() / max(total.sum(), 1))


def white_error(stage: Stage, traced: Stage) -> np.ndarray:
    """Return how the pictures of Lambert surfaces under a white sky would differ if all were white, [pixel]."""
    channel = np.argmax(stage.albedo, axis=-1)[..., None]
    albedo, difference = (np.take_along_axis(a, channel, -1) for a in (stage.albedo, stage.picture - traced.picture))
    return (difference / np.maximum(albedo, 1e-6)).reshape(-1)


def rmse(a: np.ndarray, b: np.ndarray | float = 0.0) -> float:
    """Return the root of the mean squared difference."""
    return float(np.sqrt(np.mean(np.square(np.asarray(a, np.float64) - b))))


def quality(stage: Stage, traced: Stage) -> Row:
    """Return errors of a stage of Lambert surfaces under a white sky, and the share of rays that it traces.

    Wrong rays are those that the field is sure of and wrong about; "unbiased" makes up for them. What the mode
    "paper" gets wrong shows in the picture, as no cell of its errs in both ways; in the others the audit counts it.
    """
    counts = audit(stage)
    total = max(sum(int(counts[name].sum()) for name in ("visible", "occluded", "mixed", "unknown")), 1)
    error, wrong = white_error(stage, traced), counts["lost"] + counts["leaked"]
    if stage.estimator.mode == "three_state":
        error = (counts["leaked"] - counts["lost"]) / stage.spp
    elif stage.estimator.mode == "paper":
        wrong = np.rint(np.abs(error) * stage.spp)
    return {
        "RMSE": rmse(stage.picture, traced.picture),
        "RMSE white": rmse(error),
        "traced share": traced_share(stage, counts),
        "wrong per million": float(wrong.sum() / total * 1e6),
    }
