"""The frame scheduler: preprocess, then trace, then compose, frame by frame. It knows no technique by name."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from numbers import Integral
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import warp_gi
from warp_gi import bands, launch
from warp_gi.baking import Bake, Setting, load_bake
from warp_gi.errors import BakeError, OptionError, unknown_name
from warp_gi.forecast import tell_cost
from warp_gi.forks import holds_scene
from warp_gi.frame import Frame, mixed_seed, timed
from warp_gi.kept import BakeFolder, bakes_by_class, cached_bake
from warp_gi.kernels import compose, types
from warp_gi.pipeline import DENOISER, Pipeline
from warp_gi.primary import CameraRays
from warp_gi.scene.baked import BakedScene, whole_scene
from warp_gi.scene.camera import Camera, CameraPath, frame_time, warn_if_far
from warp_gi.scene.device_scene import Trail
from warp_gi.scene.scene import Scene
from warp_gi.scene.sky_motion import sky_start
from warp_gi.sequence.state import Dependence, loaded_states, state_arrays
from warp_gi.stateful import Ahead, Stateful

_AnyFrame = TypeVar("_AnyFrame", bound=Frame)


class FrameScheduler:
    """Renders frames of a scene along a camera path: bake once, then preprocess and trace each frame.

    Args:
        scene: What is rendered; or a Bake that can be rendered without its scene, by the preset "probe_view".
        camera: A Camera, or a CameraPath whose frames are at ``index / fps`` seconds.
        pipeline: The estimators.
        device: "cpu", "cuda", "cuda:1".
        seed: Every random number follows from it, the frame, the pixel and the sample.
        progress: Called with (stage, share done in [0, 1]) while baking and tracing.
        bakes: Bakes made before (``gi.bake``, ``gi.load_bake``), each for the estimators that it names.
        cache: Folder in which bakes that take long are kept, and found the next time; None keeps none.
        memory: Bytes that a picture may take; a larger one goes to files in bands of ``rows``. None is what is free.

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
        cache: BakeFolder | str | Path | None = None,
        memory: float | None = None,
    ) -> None:
        bakes = list(bakes)
        if isinstance(scene, Bake):
            bakes.append(scene)
        for what, value, kinds in (
            ("scene", scene, (Scene, Bake)),
            ("camera", camera, (Camera, CameraPath)),
            ("pipeline", pipeline, (Pipeline,)),
            ("seed", seed, (Integral,)),
        ):
            if not isinstance(value, kinds):
                names = " or ".join(kind.__name__ for kind in kinds).replace("Integral", "whole number")
                raise OptionError(f"{what} must be a {names}, got {value!r:.80}")
        if seed < 0:
            raise OptionError(f"seed must be 0 or above, got {seed}")
        self.scene = BakedScene(scene) if isinstance(scene, Bake) else scene
        self.pipeline = pipeline.fitting(scene) if isinstance(scene, Bake) else pipeline
        self.camera, self.seed = camera.relative_to(self.scene.offset), int(seed)
        if isinstance(self.scene, Scene):
            warn_if_far(self.camera, self.scene)
        self.device = launch.get_device(device)
        self.memory = memory
        self.rows = bands.band_rows(self.pipeline, self.scene, self.camera.resolution, self.device, memory)
        self._progress = progress or (lambda stage, share: None)
        self._parts = self.pipeline.parts()
        self._bakes = bakes_by_class(bakes, self._parts)
        self._bake_digests: dict[str, str] = {}
        self._cache = cache
        self._made: dict[tuple[str, str, str], Bake] = {}
        self._states: dict[str, Any] = {}
        self._keys: dict[str, str] = {}
        if self.pipeline.denoise is not None:  # first of all: it says if it is not installed
            self._start_part(DENOISER, self.pipeline.denoise)
        self._frames: int | None = None
        self.bake_seconds, self._baked_version, self._moved, self._scene_hash = 0.0, -1, 0, ""
        self._trail: Trail | None = None
        self._sky_time = sky_start(self.scene.sky_at)
        self._frame_time: float | None = None

    def __copy__(self) -> FrameScheduler:
        """Return one that goes on from the same states; what either renders changes nothing in the other."""
        other = object.__new__(type(self))
        other.__dict__ |= self.__dict__
        for name in ("_states", "_keys", "_bake_digests", "_made"):
            setattr(other, name, dict(getattr(self, name)))
        return other

    def __repr__(self) -> str:
        parts = ", ".join(f"{place} {type(part).__name__}" for place, part in self._parts.items())
        return f"<FrameScheduler of scene {self.scene.name!r} on {self.device}, seed {self.seed}: {parts}>"

    # ---- before the first frame ----

    @holds_scene
    def bake(self, sky_time: float | None = None, frames: int | None = None) -> None:
        """Let every part compute what it can before the first frame; done by the first frame otherwise.

        Done afresh when the scene got another environment or animation, for every part that depends on it: the others
        keep their states. ``sky_time`` is the time in seconds of a sky that is a function of time: that of the first
        frame. None is that of the last frame, or the sky's first one before any. ``frames`` is how many will be
        rendered, for a line that says after how many a long bake pays; None is unknown.
        """
        self._frames = frames or self._frames
        self._sky_time = self._sky_time if sky_time is None else sky_time
        self.scene.update_sky(self._sky_time)  # whoever rendered another time of the scene since
        if self._baked_version == self.scene.version:
            if self._moved != self.scene.moved:  # every part follows other keyframes, and so do hashes
                self._keys = {place: self._state_key(part) for place, part in self._parts.items()}
                self._moved, self._scene_hash = self.scene.moved, self.scene.hash
            return
        started = time.perf_counter()
        self._made.clear()
        launch.check_fork(self.device)
        self.scene.update(0.0, None, self.device)  # bakes and first states do not depend on who moved the scene before
        for place, part in self._parts.items():
            self._start_part(place, part)
        self._scene_hash = self.scene.hash
        self.bake_seconds = time.perf_counter() - started
        self._baked_version, self._moved = self.scene.version, self.scene.moved

    def _start_part(self, place: str, part: Stateful) -> None:
        """Start a part, unless all that it depends on is what it was."""
        key = self._state_key(part)
        if self._keys.get(place) != key:
            self._states[place], self._keys[place] = self._start(place, part), key

    def _state_key(self, part: Stateful) -> str:
        return part.state_key(self.scene) or self._key_of(part)

    def _start(self, place: str, part: Stateful) -> Any:
        """Return a part's state before the first frame, from a bake made before or now."""
        device, bake = str(self.device), self._bake_for(part)
        if bake is None and place != DENOISER:
            self._progress(f"bake {place}", 0.0)
            told = lambda share: self._progress(f"bake {place}", share)  # noqa: E731
            identity = self._bake_id(part)

            def make() -> Bake | None:
                whole = whole_scene(self.scene)
                tell_cost(part, whole, self.device, self.seed, self.camera, self.pipeline.spp, self._frames)
                return part.bake(whole, device, self.seed, told, self.camera)

            where = self._cache, part, self.scene, self.camera, self.device, self.seed
            bake = self._made.get(identity) or cached_bake(*where, make)
            if bake is not None and sum(type(one) is type(part) for one in self._parts.values()) > 1:
                self._made[identity] = bake  # for the other places of its class
        elif bake is not None and not isinstance(self.scene, BakedScene):
            settings = part.bake_settings(self.scene)
            bake.check(type(part).__name__, part.bake_key(self.scene), settings, self.scene.name)
            part.check_view(bake, self.camera)
        if bake is not None:  # a bake decides pixels, by all that it depends on: the whole camera path, for example
            self._bake_digests[f"bake.{place}"] = bake.digest[:16]
        return part.start(self.scene, device, bake, self.seed)

    def _key_of(self, part: Stateful) -> str:
        """Return a hash of all in the scene that a part's bake and first state depend on."""
        return part.bake_key(self.scene) or self.scene.hash

    def _bake_id(self, part: Stateful) -> tuple[str, str, str]:
        """Return what decides a part's bake: equal ones have the same."""
        settings = sorted(part.bake_settings(self.scene).items())
        return type(part).__name__, self._key_of(part), repr(settings)

    def _bake_for(self, part: Stateful) -> Bake | None:
        """Return the bake that was given for a part, or None.

        Of several for its class it is one with the part's settings. A bake that fits another part of the class is not
        for this one. One that fits none is returned, for ``Bake.check`` to say why.
        """
        given = self._bakes.get(type(part).__name__, [])
        mine = [bake for bake in given if bake.has(part.bake_settings(self.scene))] or given
        others = [one.bake_settings(self.scene) for one in self._parts.values() if type(one) is type(part)]
        if mine is given and any(bake.has(settings) for bake in given for settings in others):
            return None
        return mine[-1] if mine else None

    def state(self, place: str) -> Any:
        """Return the state of a part of the pipeline as the last frame left it.

        ``place`` is a term, "denoise", the name of a service, or "indirect.ends_in". Raises OptionError for another.
        """
        self.bake()
        if place not in self._states:
            raise unknown_name("term of this pipeline", place, self._states)
        return self._states[place]

    # ---- frames ----

    @holds_scene
    def frame(self, index: int, previous_index: int | None = None) -> Frame:
        """Render frame ``index``; motion is towards frame ``previous_index`` (None: the frame before it, if any).

        A frame that an exception interrupts leaves nothing behind: what is rendered next is as if it had not begun.
        """
        self.rows = bands.whole(self.rows, self.pipeline, self.scene, self.camera.resolution, self.device, self.memory)
        index, began, timings = int(index), time.perf_counter(), {"bake": 0.0, "compile": 0.0}
        with timed(timings, "scene", self.device):
            self.scene.check_unchanged()
        baking = time.perf_counter()
        self.bake(frame_time(self.camera, index))
        began += time.perf_counter() - baking
        if previous_index is None:
            previous_index = max(index - 1, 0)
        with timed(timings, "scene", self.device):
            frame = self._new_frame(index, previous_index, Frame)
        frame.timings = timings
        states = self._traced(frame)
        for place, part in self._parts.items():
            if part.learns:
                with frame.stage(f"learn {place}"):
                    states[place] = part.after(frame, states[place])
        if self.pipeline.denoise is not None:
            with frame.stage("denoise"):
                frame.keep_noisy()
                states[DENOISER] = self.pipeline.denoise.apply(frame, states[DENOISER])
        self._states, self._trail = states, self.scene.trail_of(index, self.device)  # all or nothing
        frame.finish()
        timings["scheduler"] = max(time.perf_counter() - began - sum(timings.values()), 0.0)
        timings["bake"] = self.bake_seconds
        return frame

    def band(self, index: int, previous_index: int, rows: range) -> bands.BandFrame:
        """Return some rows of a frame, as ``sequence.banded`` asks for them."""
        timings: dict[str, float] = {}
        with timed(timings, "scene", self.device):
            frame = self._new_frame(index, previous_index, partial(bands.BandFrame, rows=rows))
        frame.timings = timings
        states = self._traced(frame)
        if rows.stop == self.camera.resolution[1]:
            self._states, self._trail = states, self.scene.trail_of(index, self.device)
        frame.finish()
        return frame

    def _traced(self, frame: Frame) -> dict[str, Any]:
        """Trace and compose a frame; return the states that its parts have in it."""
        states = dict(self._states)
        if self.pipeline.denoise is not None:
            samples = self.pipeline.denoise.samples(frame, states[DENOISER])
            frame.settings = replace(frame.settings, spp=samples)
        for place, part in self._parts.items():
            with frame.stage(f"preprocess {place}"):
                states[place] = part.preprocess(frame, states[place])
        views = frame.settings.camera_samples
        for view in range(views):
            self._trace_view(frame, view, states)
            self._progress("trace", (view + 1) / views)
        with frame.stage("compose"):
            frame.launch(compose.compose_frame, [views, frame.settings.spp, frame.struct(compose.FrameSums)])
        return states

    def take_samples(self, spp: int, frame_time: float | None = None) -> None:
        """Take ``spp`` samples a pixel, and no more camera samples, from the next frame on, as fit into ``frame_time``.

        Raises OptionError for a number that the pipeline cannot take.
        """
        views = self.pipeline.camera_samples
        views = None if views is None else min(views, spp)
        self.pipeline, self._frame_time = replace(self.pipeline, spp=spp, camera_samples=views), frame_time

    def trial(self, index: int, previous_index: int, spp: int, resolution: tuple[int, int]) -> Frame:
        """Render a frame after the one before it with other samples and pixels, and go on as if it had not been.

        Of interest are its ``timings``. Raises OptionError for samples or a resolution out of range.
        """
        self.bake()
        other = copy.copy(self)
        other._progress = lambda stage, share: None
        other.camera, other.rows = self.camera.at_resolution(*resolution), resolution[1]
        other.take_samples(spp)
        if previous_index != index:
            other.frame(previous_index)
        return other.frame(index, previous_index)

    def _new_frame(self, index: int, previous_index: int, make: Callable[..., _AnyFrame]) -> _AnyFrame:
        now = frame_time(self.camera, index)
        follows = self._trail is not None and self._trail.index == previous_index != index
        self.scene.update(now, frame_time(self.camera, previous_index), self.device, self._trail if follows else None)
        data = launch.copied(self.scene.data(self.device), types.SceneData)
        data.emitters, data.bvh = launch.copied(data.emitters, types.Emitters), launch.copied(data.bvh, types.Bvh)
        if self.scene.emitter_count:
            data.emitters.alias = whole_scene(self.scene).light_table(self.device)
        cameras = self._camera_at(index), self._camera_at(previous_index)
        settings, seed = self.pipeline.frame_settings, mixed_seed(self.seed, index)
        frame = make(self.scene, data, *cameras, settings, self.device, index, now, seed, previous_index)
        frame.estimators = dict(self.pipeline.estimators())
        frame.has_camera_rays = isinstance(self.pipeline.primary()[1], CameraRays)
        frame.metadata |= self.metadata()
        return frame

    def _trace_view(self, frame: Frame, view: int, states: dict[str, Any]) -> None:
        frame.begin_view(view)
        owner, primary = self.pipeline.primary()
        with frame.stage("primary"):
            primary.trace(frame, states.get(owner))
        if primary.is_whole:
            return
        with frame.stage("paths"):
            for place, cache in self.pipeline.radiance_caches():
                cache.give(frame, states[place])
        for term, estimator in self.pipeline.estimators():
            with frame.stage(term):
                estimator.trace(frame, states[term])
        with frame.stage("paths"):
            frame.paths.prepare()
            frame.trace_paths()
            frame.end_view()

    def _camera_at(self, index: int) -> Camera:
        return self.camera.camera(index) if isinstance(self.camera, CameraPath) else self.camera

    def metadata(self, sky_time: float | None = None) -> dict[str, str | int | float]:
        """Return what decides the pixels beside camera and time; a resumed run checks files against it.

        ``sky_time`` is the time in seconds of a sky that is a function of time; None is that of the last frame.
        """
        self.bake(sky_time)
        return {
            "seed": self.seed,
            "scene": self.scene.name,
            "scene_hash": self._scene_hash,
            "version": warp_gi.__version__,
            "device": self.device.name if self.device.is_cuda else "cpu",
            **self._bake_digests,
            **{f"pipeline.{key}": value for key, value in self.pipeline.describe().items()},
            **({} if self._frame_time is None else {"frame_time": self._frame_time}),
        }

    # ---- between frames ----

    def dependence(self, frames: Iterable[int] | None = None, sky_changes: bool = False) -> Dependence:
        """Return how ``frames`` (None: every one of the camera's path) depend on those rendered before them.

        ``sky_changes`` says that the scene gets another environment on the way, beside one that is a function of time.
        It is ``Pipeline.dependence`` with what this scheduler knows of the frames to come.
        """
        self.bake()
        if frames is None:
            frames = range(self.camera.frame_count if isinstance(self.camera, CameraPath) else 4)
        views = [(index, self._camera_at(index)) for index in frames]
        sky_changes = sky_changes or self.scene.is_sky_animated
        return self.pipeline.dependence(self.scene, lambda place: Ahead(self._states[place], views, sky_changes))

    def save_state(self, path: str | Path, lineage: str = "") -> Path:
        """Write what is known after the last frame, whole or not at all: ``load_state`` goes on from there.

        What is saved is what parts with ``saves_state`` keep from frame to frame; ``dependence`` says whether that
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
            self._states = self._states | loaded_states(self._to_save(), saved.arrays, self.device)
        except ValueError as error:
            raise BakeError(f"{path}: is not the state of this sequence ({error}); delete it") from error

    def _to_save(self) -> dict[str, Any]:
        self.bake()
        return {place: self._states[place] for place, part in self._parts.items() if part.saves_state}

    def _saved_state(self, lineage: str, arrays: dict[str, np.ndarray]) -> Bake:
        """Return a file's contents; the sky may differ from that of the frame before."""
        settings: dict[str, Setting] = {"lineage": lineage}
        settings |= {key: str(value) for key, value in self.metadata().items() if key != "scene_hash"}
        return Bake("FrameScheduler", self.scene.contents_hash, settings, arrays, scene_name=self.scene.name)
