"""The frame scheduler: preprocess, then trace, then compose, frame by frame."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from numbers import Integral
from pathlib import Path
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
import warp as wp

import warp_gi
from warp_gi import launch
from warp_gi.baking import Bake, load_bake
from warp_gi.errors import BakeError, OptionError, unknown_name
from warp_gi.estimator import Ahead, Estimator, SamplerInUse
from warp_gi.kernels import compose, denoise, gbuffer, path_samplers, path_trace, path_tracers, samples, types
from warp_gi.pipeline import TERMS, Pipeline
from warp_gi.scene.baked import BakedScene
from warp_gi.scene.camera import Camera, CameraPath, frame_time
from warp_gi.scene.scene import Scene
from warp_gi.sequence.state import Dependence, state_arrays, with_arrays
from warp_gi.techniques.paths.estimators import BsdfPaths, PowerLights, sky_probability

MOST_VERTICES = 7  # of a path whose samples are kept: each path has room for as many, so more would keep fewer paths
_VEC3_BUFFERS = ("beauty", "emission", *TERMS, "albedo", "normal", "position", "variance", "moment1", "moment2")
BUFFERS = (
    "beauty",
    "emission",
    *TERMS,
    "albedo",
    "normal",
    "position",
    "depth",
    "motion",
    "object_id",
    "material_id",
    "variance",
)
"""Names of a frame's buffers: radiance in W/(m^2 sr), lengths in m, motion in pixels, ids -1 for "nothing"."""


class Frame:
    """One picture in the making, then made: named buffers on a device.

    ``frame["beauty"]`` is a wp.array of height * width items in rows from the top (vec3,
    vec2, float32 or int32); ``frame.numpy("beauty")`` the same as an image.
    """

    def __init__(
        self,
        scene: Scene,
        data: types.SceneData,
        camera: Camera,
        previous_camera: Camera,
        pipeline: Pipeline,
        device: wp.Device,
        index: int,
        frame_time: float,
        seed: int,
        previous_index: int,
    ) -> None:
        self.scene, self.data, self.pipeline, self.device = scene, data, pipeline, device
        self.camera, self.previous_camera = camera, previous_camera
        self.index, self.previous_index = index, previous_index
        self.time = frame_time
        """Seconds."""
        self.seed = seed
        """Of this frame: a hash of the sequence's seed and the frame's number."""
        self.timings: dict[str, float] = {}
        """Wall seconds by stage; "compile" is kernel compilation, left out of the others."""
        self.metadata: dict[str, str | int | float] = {}
        self.lights = SamplerInUse(path_samplers.ALIAS_LIGHTS, path_samplers.AliasLights())
        """Which light the vertices of paths sample; set by the estimator of the emitters."""
        self.directions = SamplerInUse(path_samplers.BSDF_DIRECTIONS, path_samplers.BsdfDirections())
        """Which way paths go on; set by the estimator of the indirect light."""
        self.regions = SamplerInUse(path_samplers.NO_REGIONS, path_samplers.NoRegions())
        """What samplers learn in, and from."""
        self._path_terms = 0
        self._paths = BsdfPaths(max_depth=2)
        width, height = camera.resolution
        count = width * height

        def zeros(dtype: Any) -> wp.array:
            return wp.zeros(count, dtype=dtype, device=device)

        self._arrays: dict[str, wp.array] = {name: zeros(wp.vec3) for name in _VEC3_BUFFERS}
        self._arrays |= {
            "depth": zeros(wp.float32),
            "motion": zeros(wp.vec2),
            "object_id": zeros(wp.int32),
            "material_id": zeros(wp.int32),
        }
        if pipeline.denoise is not None and pipeline.denoise.wants_lobes:
            self._arrays |= {name: zeros(guide.type.dtype) for name, guide in denoise.Guides.vars.items()}
        self.hits = gbuffer.PrimaryHits()
        self.hits.direction = zeros(wp.vec3)
        for name in ("t", "u", "v"):
            setattr(self.hits, name, zeros(wp.float32))
        self.hits.face = zeros(wp.int32)
        self.camera_data, self._previous_camera_data = camera_data(camera), camera_data(previous_camera)
        self._sky_probability = sky_probability(scene)
        self.pass_settings = gbuffer.PassSettings()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the buffers: ``BUFFERS``, and with a denoiser "noisy", the beauty before it."""
        return (*BUFFERS, "noisy") if "noisy" in self._arrays else BUFFERS

    def __getitem__(self, name: str) -> wp.array:
        """Return a buffer on the device, [height * width]; raises OptionError if there is none of that name."""
        if name not in self.names:
            raise unknown_name("frame buffer", name, self.names)
        return self._arrays[name]

    def numpy(self, name: str) -> np.ndarray:
        """Return a buffer as an image, [height, width] or [height, width, channels], row 0 at the top."""
        values = self[name].numpy()
        width, height = self.camera.resolution
        return values.reshape(height, width, *values.shape[1:])

    def request_paths(self, term: int, paths: BsdfPaths | None = None) -> None:
        """Ask for a term of the path-tracing launch that this camera sample's estimators share."""
        self._path_terms |= int(term)
        if paths is not None:
            self._paths = paths

    @property
    def wants_paths(self) -> bool:
        """Whether an estimator asked for a term of the path-tracing launch."""
        return self._path_terms != 0

    def launch_paths(self) -> None:
        """Trace the terms that were asked for since the camera sample began, in one launch."""
        paths = path_trace.PathSettings()
        paths.terms = self._path_terms
        paths.max_depth = self._paths.max_depth
        paths.roulette_depth = self._paths.roulette_depth
        paths.clamp = self._paths.clamp
        paths.sky_probability = self._sky_probability
        paths.spp = self.pipeline.spp
        tracer = path_tracers.tracer(self.lights.sampler, self.directions.sampler)
        samplers = tracer.samplers()
        for name in ("lights", "directions", "regions"):
            setattr(samplers, name, getattr(self, name).data)
        buffers = self.struct(path_trace.PathBuffers)
        inputs = [self.data, self.camera_data, self.pass_settings, paths, self.hits, buffers, samplers]
        self.launch_tiled(tracer.trace_paths, inputs)

    def moments(self, name: str) -> tuple[wp.array, wp.array]:
        """Return sums of an independent launch's samples and of their squares, which the variance buffer adds.

        Both are vec3 [height * width]. ``name`` is the term that the samples are of; raises OptionError for others.
        """
        if name not in TERMS:
            raise unknown_name("term", name, TERMS)
        if self._arrays.get(f"{name}_moment1") is None:
            width, height = self.camera.resolution
            for order in (1, 2):
                self._arrays[f"{name}_moment{order}"] = wp.zeros(width * height, dtype=wp.vec3, device=self.device)
        return self._arrays[f"{name}_moment1"], self._arrays[f"{name}_moment2"]

    def lobes(self) -> tuple[wp.array, wp.array] | None:
        """Return sums over samples that an estimator of indirect light may add to, or None: then nobody reads them.

        Both are vec3 [height * width]. The first is diffuse light as it comes in: times the diffuse albedo it is
        the radiance that the diffuse lobe reflects. The second is the radiance that the glossy lobe reflects. What
        is added here is part of the term's own buffer too; the denoiser takes it out of there.
        """
        if "guide_object" not in self._arrays:
            return None
        for name in ("lobe_diffuse", "lobe_glossy"):
            if name not in self._arrays:
                self._arrays[name] = wp.zeros_like(self._arrays["indirect"])
        return self._arrays["lobe_diffuse"], self._arrays["lobe_glossy"]

    def keep_noisy(self) -> None:
        """Make the composed beauty the buffer "noisy", and an empty beauty for a denoiser to fill."""
        self._arrays["noisy"] = self._arrays["beauty"]
        self._arrays["beauty"] = wp.empty_like(self._arrays["noisy"])

    def launch(self, kernel: wp.Kernel, inputs: list[Any], count: int | None = None) -> None:
        """Run a kernel over ``count`` items, or over every pixel."""
        width, height = self.camera.resolution
        launch.launch(kernel, width * height if count is None else count, inputs, self.device)

    @property
    def tiled_items(self) -> int:
        """Items of a launch in tiles: those of pixels, and of what tiles at the border have besides."""
        tiles = [math.ceil(size / gbuffer.TILE) for size in self.camera.resolution]
        return tiles[0] * tiles[1] * gbuffer.TILE**2

    def launch_tiled(self, kernel: wp.Kernel, inputs: list[Any]) -> None:
        """Run a kernel over every pixel in tiles (``kernels.gbuffer.tiled_pixel``)."""
        self.launch(kernel, inputs, self.tiled_items)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the wall time of a block to ``timings[name]``, compilation apart."""
        compiled, started = launch.compile_seconds, time.perf_counter()
        yield
        wp.synchronize_device(self.device)
        compiled = launch.compile_seconds - compiled
        self.timings["compile"] = self.timings.get("compile", 0.0) + compiled
        self.timings[name] = self.timings.get(name, 0.0) + time.perf_counter() - started - compiled

    def struct(self, struct: Any) -> Any:
        """Return a kernel struct whose fields are the buffers of the same names."""
        filled = struct()
        for name in struct.vars:
            setattr(filled, name, self._arrays.get(name))
        return filled


_Arguments = ParamSpec("_Arguments")
_Result = TypeVar("_Result")


def _holds_scene(
    method: Callable[Concatenate[FrameScheduler, _Arguments], _Result],
) -> Callable[Concatenate[FrameScheduler, _Arguments], _Result]:
    """Return a method during which no other thread moves, edits or renders the scene."""

    @wraps(method)
    def holding(self: FrameScheduler, *args: _Arguments.args, **kwargs: _Arguments.kwargs) -> _Result:
        with self.scene.lock:
            return method(self, *args, **kwargs)

    return holding


class FrameScheduler:
    """Renders frames of a scene along a camera path: bake once, then preprocess and trace each frame.

    Args:
        scene: What is rendered; or a Bake that can be rendered without its scene, by the preset "probe_view".
        camera: A Camera, or a CameraPath whose frames are at ``index / fps`` seconds.
        pipeline: The estimators.
        device: "cpu", "cuda", "cuda:1".
        seed: Every random number follows from it, the frame, the pixel and the sample.
        progress: Called with (stage, share done in [0, 1]) while baking and tracing.
        bakes: Bakes made before (``gi.bake``, ``gi.load_bake``), each for the estimator that it names.

    Several may render one scene, in turns or on threads of their own: a frame has the scene to itself until it is
    done. Each is for one thread at a time.

    Raises OptionError for a device that is not there, BakeError for a bake of another scene or other settings.
    """

    def __init__(
        self,
        scene: Scene | Bake,
        camera: Camera | CameraPath,
        pipeline: Pipeline,
        device: str = "cpu",
        seed: int = 0,
        progress: Callable[[str, float], None] | None = None,
        bakes: Iterable[Bake] = (),
    ) -> None:
        if isinstance(scene, Bake):
            scene, pipeline, bakes = BakedScene(scene), _fitting(pipeline, scene), [*bakes, scene]
        for what, value, kinds in (
            ("scene", scene, (Scene, BakedScene)),
            ("camera", camera, (Camera, CameraPath)),
            ("pipeline", pipeline, Pipeline),
            ("seed", seed, Integral),
        ):
            if not isinstance(value, kinds):
                names = " or ".join(kind.__name__ for kind in (kinds if isinstance(kinds, tuple) else (kinds,)))
                names = names.replace("Integral", "whole number").replace("BakedScene", "Bake")
                raise OptionError(f"{what} must be a {names}, got {value!r:.80}")
        if seed < 0:
            raise OptionError(f"seed must be 0 or above, got {seed}")
        self.scene, self.pipeline, self.seed = scene, pipeline, seed
        self.camera = camera
        self.device = launch.get_device(device)
        self._progress = progress or (lambda stage, share: None)
        self._estimators = dict(pipeline.estimators())
        if "emitters" not in self._estimators:
            self._light_sampler = PowerLights()  # next-event estimation along paths needs a distribution anyway
        else:
            self._light_sampler = None
        self._learners = [term for term, estimator in self._estimators.items() if estimator.learns]
        self._records: samples.SampleRecords | None = None
        self._bakes = _bakes_by_term(bakes, self._estimators)
        self._bake_digests = {f"bake.{term}": bake.digest[:16] for term, bake in self._bakes.items()}
        self._states: dict[str, Any] = {}
        if pipeline.denoise is not None:
            self._states["denoise"] = pipeline.denoise.start(self.device)
        self._keys: dict[str, str] = {}
        self._bake_seconds = 0.0
        self._baked_version = -1
        self._scene_hash = ""

    @_holds_scene
    def bake(self) -> None:
        """Let every estimator compute what it can before the first frame; done by the first frame otherwise.

        Done afresh when the scene got another environment or animation, for every estimator that depends on it:
        the others keep their states.
        """
        if self._baked_version == self.scene.version:
            return
        started = time.perf_counter()
        launch.check_fork(self.device)
        self.scene.update(0.0, None, self.device)  # bakes and first states do not depend on who moved the scene before
        self._states.pop("lights", None)
        for term, estimator in self._estimators.items():
            key = estimator.bake_key(self.scene)
            if key and self._keys.get(term) == key:
                continue
            self._states[term], self._keys[term] = self._start(term, estimator), key
        if self._learners and self._keys.get("octree") != self.scene.contents_hash:
            self._states["octree"] = self.pipeline.octree.start(self.scene, self.device)
            self._keys["octree"] = self.scene.contents_hash
        self._scene_hash = self.scene.hash
        self._bake_seconds = time.perf_counter() - started
        self._baked_version = self.scene.version

    def _start(self, term: str, estimator: Any) -> Any:
        """Return an estimator's state before the first frame, from a bake made before or now."""
        device, bake = str(self.device), self._bakes.get(term)
        if bake is None:
            self._progress(f"bake {term}", 0.0)
            told = lambda share: self._progress(f"bake {term}", share)  # noqa: E731
            bake = estimator.bake(self.scene, device, self.seed, told, self.camera)
            if bake is not None:  # what it depends on, the whole camera path for one, decides pixels, too
                self._bake_digests[f"bake.{term}"] = bake.digest[:16]
        elif not isinstance(self.scene, BakedScene):
            settings = estimator.bake_settings(self.scene)
            bake.check(type(estimator).__name__, estimator.bake_key(self.scene), settings, self.scene.name)
            estimator.check_view(bake, self.camera)
        return estimator.start(self.scene, device, bake, self.seed)

    def state(self, term: str) -> Any:
        """Return the state of the estimator of a term, as the last frame left it.

        Raises OptionError for a term without an estimator.
        """
        self.bake()
        if term not in self._states:
            raise unknown_name("term of this pipeline", term, self._states)
        return self._states[term]

    @_holds_scene
    def frame(self, index: int, previous_index: int | None = None) -> Frame:
        """Render frame ``index``; motion is towards frame ``previous_index`` (None: the frame before it, if any).

        A frame that an exception interrupts leaves nothing behind: what is rendered next is as if it had not begun.
        """
        self.scene.check_unchanged()
        self.scene.update_sky(frame_time(self.camera, index))
        self.bake()
        if previous_index is None:
            previous_index = max(index - 1, 0)
        frame = self._new_frame(index, previous_index)
        states, records, self._records = dict(self._states), self._records, None
        for term, estimator in self._estimators.items():
            with frame.stage(f"preprocess {term}"):
                states[term] = estimator.preprocess(frame, states[term])
        if self._light_sampler is not None:
            states["lights"] = self._light_sampler.preprocess(frame, states.get("lights"))
        learns = path_tracers.learns(frame.lights.sampler, frame.directions.sampler)  # not so without any lights
        if learns:
            with frame.stage("preprocess octree"):
                records = self._open_records(frame, states["octree"], records)
        views = self.pipeline.camera_sample_count
        for view in range(views):
            self._trace_view(frame, view, states)
            self._progress("trace", (view + 1) / views)
        with frame.stage("compose"):
            frame.launch(compose.compose_frame, [views, self.pipeline.spp, frame.struct(compose.FrameSums)])
        if learns:
            states |= self._learnt(frame, states, records)
        if self.pipeline.denoise is not None:
            with frame.stage("denoise"):
                frame.keep_noisy()
                states["denoise"] = self.pipeline.denoise.apply(frame, states["denoise"])
        self._states, self._records = states, records  # all or nothing
        return frame

    def _open_records(self, frame: Frame, octree: Any, previous: samples.SampleRecords | None) -> samples.SampleRecords:
        """Let the paths of a frame find regions, and return where they leave samples; ``previous`` is used again."""
        indirect = self.pipeline.indirect
        vertices = min(indirect.max_depth - 1, MOST_VERTICES) if isinstance(indirect, BsdfPaths) else 1
        data = samples.SampleRegions()
        data.octree, data.moves = octree.octree, int(self.scene.is_animated)
        data.records = self.pipeline.octree.records(frame, vertices, previous)
        frame.regions = SamplerInUse(samples.SAMPLE_REGIONS, data)
        return data.records

    def _learnt(self, frame: Frame, states: dict[str, Any], records: samples.SampleRecords | None) -> dict[str, Any]:
        """Return the states of every technique that learns, after what the samples of a frame say."""
        with frame.stage("learn octree"):
            lesson = self.pipeline.octree.learn(states["octree"], records, self.device)
        learnt = {"octree": lesson.octree}
        for term in self._learners:
            with frame.stage(f"learn {term}"):
                learnt[term] = self._estimators[term].learn(lesson, states[term])
        return learnt

    @property
    def learns(self) -> bool:
        """Whether an estimator learns from the samples of frames."""
        return bool(self._learners)

    def dependence(self, frames: Iterable[int] | None = None, sky_changes: bool = False) -> Dependence:
        """Return how ``frames`` (None: every one of the camera's path) depend on those rendered before them.

        ``sky_changes`` says that the scene gets another environment on the way, beside one that is a function of time.
        """
        self.bake()
        if frames is None:
            frames = range(self.camera.frame_count if isinstance(self.camera, CameraPath) else 4)
        views = [(index, self._camera_at(index)) for index in frames]
        depends = {
            term: estimator.depends_on_past(
                self.scene, Ahead(self._states[term], views, sky_changes or self.scene.is_sky_animated)
            )
            for term, estimator in self._estimators.items()
        }
        on_past = [term for term in depends if depends[term]]
        unsaved = [term for term in on_past if not self._estimators[term].saves_state]
        if self.pipeline.denoise is not None and self.pipeline.denoise.depends_on_past():
            on_past, unsaved = [*on_past, "denoiser"], [*unsaved, "denoiser"]
        return Dependence(tuple(on_past), tuple(unsaved))

    def save_state(self, path: str | Path, lineage: str = "") -> Path:
        """Write what is known after the last frame, whole or not at all: ``load_state`` goes on from there.

        What is saved is what estimators with ``saves_state`` keep from frame to frame; ``dependence`` says whether that
        is all that there is. ``lineage`` names the frames before. Raises OSError when the file cannot be written.
        """
        return self._saved_state(lineage, state_arrays(self._to_save())).save(path)

    def load_state(self, path: str | Path, lineage: str = "") -> None:
        """Go on from a file of ``save_state``, as if the frames before had been rendered here: bit for bit.

        Raises BakeError when the file is damaged, or of another scene, other settings or another ``lineage``.
        """
        self.bake()
        saved, wanted = load_bake(path), self._saved_state(lineage, {})
        try:
            saved.check(wanted.technique, wanted.scene_key, wanted.settings, wanted.scene_name)
            self._states = self._states | with_arrays(self._to_save(), saved.arrays, self.device)
        except (BakeError, KeyError, ValueError, RuntimeError) as error:
            raise BakeError(f"{path}: is not the state of this sequence ({error}); delete it") from error

    def _to_save(self) -> dict[str, Any]:
        self.bake()
        names = [term for term, estimator in self._estimators.items() if estimator.saves_state]
        return {name: self._states[name] for name in ["octree"] * bool(self._learners) + names}

    def _saved_state(self, lineage: str, arrays: dict[str, np.ndarray]) -> Bake:
        """Return a file's contents; the sky may differ from that of the frame before."""
        settings = {key: str(value) for key, value in self.metadata().items() if key != "scene_hash"}
        settings |= {"lineage": lineage}
        return Bake("FrameScheduler", self.scene.contents_hash, settings, arrays, scene_name=self.scene.name)

    def _new_frame(self, index: int, previous_index: int) -> Frame:
        fps = self.camera.fps if isinstance(self.camera, CameraPath) else 24.0
        started, compiled = time.perf_counter(), launch.compile_seconds
        self.scene.update(index / fps, previous_index / fps, self.device)
        data = launch.copied(self.scene.data(self.device), types.SceneData)
        data.emitters = launch.copied(data.emitters, types.Emitters)
        frame = Frame(
            self.scene,
            data,
            self._camera_at(index),
            self._camera_at(previous_index),
            self.pipeline,
            self.device,
            index,
            index / fps,
            _mix(self.seed, index),
            previous_index,
        )
        compiled = launch.compile_seconds - compiled
        frame.timings |= {"bake": self._bake_seconds, "compile": compiled}
        frame.timings["scene"] = time.perf_counter() - started - compiled
        frame.metadata |= self.metadata()
        return frame

    def metadata(self) -> dict[str, str | int | float]:
        """Return what decides the pixels beside camera and time; a resumed run checks files against it."""
        self.bake()
        return {
            "seed": self.seed,
            "scene": self.scene.name,
            "scene_hash": self._scene_hash,
            "version": warp_gi.__version__,
            "device": self.device.name if self.device.is_cuda else "cpu",
            **self._bake_digests,
            **{f"pipeline.{key}": value for key, value in self.pipeline.describe().items()},
        }

    def _camera_at(self, index: int) -> Camera:
        return self.camera.camera(index) if isinstance(self.camera, CameraPath) else self.camera

    def _trace_view(self, frame: Frame, view: int, states: dict[str, Any]) -> None:
        pipeline, settings = self.pipeline, frame.pass_settings
        views = pipeline.camera_sample_count
        settings.seed = frame.seed
        settings.camera_sample = view
        settings.camera_samples = views
        settings.camera_bits = (views - 1).bit_length()
        settings.first_sample = pipeline.spp * view // views
        settings.sample_count = pipeline.spp * (view + 1) // views - settings.first_sample
        settings.sample_bits = (pipeline.spp - 1).bit_length()
        settings.tent = int(pipeline.filter == "tent")
        for term, estimator in self._estimators.items():
            if estimator.makes_primary:
                with frame.stage("primary"):
                    estimator.trace_primary(frame, states[term])
                return
        with frame.stage("primary"):
            frame.launch_tiled(gbuffer.trace_primary, [frame.data, frame.camera_data, settings, frame.hits])
            cameras = [frame.camera_data, frame._previous_camera_data]
            buffers = frame.struct(gbuffer.SurfaceBuffers)
            frame.launch(gbuffer.shade_primary, [frame.data, *cameras, settings, frame.hits, buffers])
        frame._path_terms = 0
        for term, estimator in self._estimators.items():
            with frame.stage(term):
                estimator.trace(frame, states[term])
        with frame.stage("paths"):
            frame.launch_paths()


def _fitting(pipeline: Pipeline, bake: Bake) -> Pipeline:
    """Return the pipeline with its settings as those of a bake that is rendered without its scene."""
    indirect = pipeline.indirect
    if indirect is None or not indirect.makes_primary:
        raise OptionError('a bake without its scene is rendered by the preset "probe_view"; give the scene for others')
    return replace(pipeline, indirect=indirect.fitting(bake))


def _bakes_by_term(bakes: Iterable[Bake], estimators: dict[str, Estimator]) -> dict[str, Bake]:
    """Return the bakes by the term whose estimator they are for; raises BakeError for one that nothing uses."""
    terms = {type(estimator).__name__: term for term, estimator in estimators.items()}
    found: dict[str, Bake] = {}
    for one in bakes:
        if one.technique not in terms:
            names = ", ".join(sorted(terms)) or "none"
            raise BakeError(f"a bake of {one.technique} was given, but the pipeline's estimators are: {names}")
        found[terms[one.technique]] = one
    return found


def camera_data(camera: Camera) -> gbuffer.CameraData:
    """Return the camera as kernels read it."""
    width, height = camera.resolution
    right, up, back = camera.world_from_camera[:3, :3].T
    half = math.tan(math.radians(camera.hfov) / 2)
    data = gbuffer.CameraData()
    data.position = wp.vec3(*camera.position)
    data.right = wp.vec3(*(right * half))
    data.up = wp.vec3(*(up * half * height / width))
    data.forward = wp.vec3(*-back)
    data.width, data.height = width, height
    return data


def _mix(seed: int, frame: int) -> int:
    """Return a well-mixed 32-bit seed of a frame (splitmix64)."""
    mask = (1 << 64) - 1
    z = (seed * 0x9E3779B97F4A7C15 + frame * 0xD1B54A32D192ED03 + 0x9E3779B97F4A7C15) & mask
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & mask
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & mask
    return (z ^ (z >> 31)) & 0xFFFFFFFF
