"""A frame: the buffers of one picture, which estimators and kernels fill."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.errors import unknown_name
from warp_gi.kernels import apart_lights, denoise, gbuffer, path_samplers, path_trace, types
from warp_gi.layers import LobeShares, has_layers, solid_data
from warp_gi.paths import PathRequest, sky_probability
from warp_gi.scene.apart import ApartLights, apart_lights_of
from warp_gi.scene.baked import BakedScene
from warp_gi.scene.camera import Camera
from warp_gi.scene.pinhole import camera_data

if TYPE_CHECKING:
    from warp_gi.scene.scene import Scene

TERMS = ("environment", "emitters", "indirect")
"""Terms of the light that estimators stand for; emission, the fourth, is always exact."""
_COPIED = ("camera", "previous_camera", "index", "previous_index", "time", "seed", "settings", "pipeline_samples")
"""What a copy of a frame has beside its pixels, timings and metadata."""
_VEC3_BUFFERS = ("beauty", "emission", *TERMS, "albedo", "normal", "position", "variance", "moment1", "moment2")
BUFFERS = (
    "beauty",
    "alpha",
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
"""Names of a frame's buffers: radiance in W/(m^2 sr), alpha the share of camera samples that hit, lengths in m, motion
in pixels, ids -1 for "nothing"."""

VIEW_SALT = 0x9E3779B9

Offer = TypeVar("Offer")


@dataclass(frozen=True)
class FrameSettings:
    """Settings of a pipeline that decide how a frame is sampled."""

    spp: int
    """Number of samples a pixel."""
    camera_samples: int
    """Number of camera rays a pixel that the samples are spread over."""
    filter: str = "box"
    """Pixel filter, "box" or "tent"."""
    background: bool = True
    """Whether pictures show the sky where a camera ray hits nothing."""
    wants_lobes: bool = False
    """Whether a denoiser reads guides and the light of each lobe (``Frame.lobes``)."""
    parts_lights: bool = False
    """Whether a denoiser wants the diffuse light of suns and of lights without size apart."""


class Lobes(NamedTuple):
    """Light at the first vertex, parted by the lobe that reflects it: sums over samples, vec3 [height * width]."""

    diffuse: wp.array
    """Diffuse light as it comes in: times the diffuse albedo it is the radiance that the diffuse lobe reflects."""
    glossy: wp.array
    """The radiance that the glossy lobe reflects."""
    apart: wp.array | None
    """As ``diffuse``, and not in it: light of suns and of lights without size. None where there is none."""


class Frame:
    """One picture: named buffers on a device, which estimators add to until the frame is done.

    ``frame["beauty"]`` is a wp.array of height * width items in rows from the top (vec3,
    vec2, float32 or int32); ``frame.numpy("beauty")`` the same as an image.
    """

    def __init__(
        self,
        scene: Scene | BakedScene,
        data: types.SceneData,
        camera: Camera,
        previous_camera: Camera,
        settings: FrameSettings,
        device: wp.Device,
        index: int,
        frame_time: float,
        seed: int,
        previous_index: int,
    ) -> None:
        self.scene, self.data, self.settings, self.device = scene, data, settings, device
        self.seen_data = data if settings.background else launch.copied(data, types.SceneData)
        """The scene as camera rays see it: without its sky, if pictures have no background."""
        if not settings.background:
            self.seen_data.environment = types.Environment()
        self.layer_data = solid_data(self.seen_data)
        """``seen_data`` for kernels that walk through all layers of blended surfaces (``kernels.layers``)."""
        self.lobe_shares: LobeShares | None = None
        """What makes light that is divided by albedo fit such layers; None without any, or without a denoiser."""
        self.camera, self.previous_camera = camera, previous_camera
        self.index, self.previous_index = index, previous_index
        self.time = frame_time
        """Time of the frame in seconds from the first one."""
        self.seed = seed
        """Hash of the sequence's seed and the frame's number."""
        self.timings: dict[str, float] = {}
        """Wall seconds by stage; "compile" is kernel compilation, left out of the others; "scheduler" is none of these.

        All but "bake", which was before, add up to what the frame took; who writes it adds "write" and "save state".
        """
        self.metadata: dict[str, str | int | float] = {}
        """Values by name that decide the pixels, beside camera and time."""
        self.measured: dict[str, float] = {}
        """Values by name that tell of the pixels and do not decide them; files have them too."""
        self.paths = PathRequest(data.emitters)
        """Requests of estimators to the path tracer."""
        self.pipeline_samples = settings.spp
        """Samples a pixel that the pipeline asks for; a denoiser may have asked for more (``settings.spp``)."""
        self.has_camera_rays = False
        """Whether the primary traces camera rays through the scene, so that more of them see the same."""
        self.estimators: dict[str, object] = {}
        """Estimators of the pipeline by their terms; a class that serves several finds its others here."""
        self.sky_probability = sky_probability(scene)
        """Probability of sampling the sky where a path vertex samples either the sky or an emitter."""
        self.apart: ApartLights | None = None
        """Lights whose diffuse light paths keep apart; known once they are traced."""
        self._offers: dict[type, Any] = {}
        zeros = self._zeros
        self._arrays: dict[str, wp.array] = {name: zeros(wp.vec3) for name in _VEC3_BUFFERS}
        self._arrays |= {
            "alpha": zeros(wp.float32),
            "depth": zeros(wp.float32),
            "motion": zeros(wp.vec2),
            "object_id": zeros(wp.int32),
            "material_id": zeros(wp.int32),
        }
        if settings.wants_lobes:
            self._arrays |= {name: zeros(guide.type.dtype) for name, guide in denoise.Guides.vars.items()}
            if has_layers(data):
                self._arrays["guide_ratio"] = zeros(wp.vec3)
                self.lobe_shares = LobeShares(self._arrays["guide_ratio"])
        self.hits = gbuffer.PrimaryHits()
        self.hits.direction = zeros(wp.vec3)
        for name in ("t", "u", "v"):
            setattr(self.hits, name, zeros(wp.float32))
        self.hits.face = zeros(wp.int32)
        self.camera_data, self.previous_camera_data = camera_data(camera), camera_data(previous_camera)
        self.pass_settings = gbuffer.PassSettings()
        """Seed, samples and filter of the current camera sample, as kernels read them."""

    # ---- in Python programs ----

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy has: pixels and what describes them, but no scene and nothing on a device."""
        values = {name: getattr(self, name) for name in (*_COPIED, "timings", "metadata", "measured")}
        return values | {"_arrays": {name: self.numpy(name) for name in self.names}}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Take the pixels of another frame; they are on the CPU."""
        self.__dict__ |= state
        self.device = launch.get_device("cpu")
        kinds = {name: array.shape[2:] for name, array in state["_arrays"].items()}
        flat = {name: array.reshape(-1, *kinds[name]).copy() for name, array in state["_arrays"].items()}
        vectors = {(2,): wp.vec2, (3,): wp.vec3}
        self._arrays = {
            name: launch.on_device(array, vectors.get(kinds[name]) or wp.dtype_from_numpy(array.dtype), self.device)
            for name, array in flat.items()
        }

    def __repr__(self) -> str:
        width, height = self.camera.resolution
        return f"<Frame {self.index}: {width}x{height}, {self.settings.spp} samples a pixel, {', '.join(self.names)}>"

    def _repr_png_(self) -> bytes:
        """Return the picture as a notebook shows it."""
        from warp_gi.sequence.preview import picture_bytes

        return picture_bytes(self.numpy("beauty"))

    # ---- buffers ----

    def _zeros(self, dtype: type) -> wp.array:
        """Return a new buffer of all pixels on the frame's device."""
        width, height = self.camera.resolution
        return wp.zeros(width * height, dtype=dtype, device=self.device)

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

    def struct(self, struct: type[launch.Struct]) -> launch.Struct:
        """Return a kernel struct whose fields are the buffers of the same names."""
        filled = struct()
        for name in launch.fields_of(struct):
            setattr(filled, name, self._arrays.get(name))
        return filled

    def moments(self, name: str) -> tuple[wp.array, wp.array]:
        """Return sums of an independent launch's samples and of their squares, which the variance buffer adds.

        Both are vec3 [height * width]. ``name`` is the term that the samples are of; raises OptionError for others.
        """
        if name not in TERMS:
            raise unknown_name("term", name, TERMS)
        if self._arrays.get(f"{name}_moment1") is None:
            for order in (1, 2):
                self._arrays[f"{name}_moment{order}"] = self._zeros(wp.vec3)
        return self._arrays[f"{name}_moment1"], self._arrays[f"{name}_moment2"]

    def layer_emission(self) -> wp.array:
        """Return the emission of the current camera sample as a mean over layers, which primaries write.

        vec3 [height * width]; paths then take it for that of the surface drawn, in the moments of what they add up.
        """
        if "layer_emission" not in self._arrays:
            self._arrays["layer_emission"] = self._zeros(wp.vec3)
        return self._arrays["layer_emission"]

    def lobes(self) -> Lobes | None:
        """Return sums over samples that estimators may add to, as paths do, or None: then nobody reads them.

        What is added here is part of the terms' own buffers too; the denoiser takes it out of there.
        """
        if not self.settings.wants_lobes:
            return None
        for name in ("lobe_diffuse", "lobe_glossy"):
            if name not in self._arrays:
                self._arrays[name] = self._zeros(wp.vec3)
        return Lobes(self._arrays["lobe_diffuse"], self._arrays["lobe_glossy"], self._arrays.get("lobe_apart"))

    def keep_noisy(self) -> None:
        """Make the composed beauty the buffer "noisy", and an empty beauty for a denoiser to fill."""
        self._forget_moments()
        self._arrays["noisy"] = self._arrays["beauty"]
        self._arrays["beauty"] = wp.empty_like(self._arrays["noisy"])

    # ---- what services hand over ----

    def offer(self, thing: object) -> None:
        """Hand something over to the estimators of this frame; they find it by its class."""
        self._offers[type(thing)] = thing

    def offered(self, kind: type[Offer]) -> Offer | None:
        """Return what a service offered of a class in this frame, or None."""
        return self._offers.get(kind)

    def finish(self) -> None:
        """Forget what was handed over: the frame is done, and whoever keeps it wants its buffers."""
        self._offers.clear()
        self.paths.finish()
        self._forget_moments()

    def _forget_moments(self) -> None:
        """Let go of sums of samples and of their squares, 24 bytes a pixel: the variance is made of them already."""
        for name in [name for name in self._arrays if "moment" in name]:
            del self._arrays[name]

    # ---- camera samples ----

    def begin_view(self, view: int) -> None:
        """Begin camera sample ``view``: 0 to ``settings.camera_samples`` - 1."""
        spp, views, kernel = self.settings.spp, self.settings.camera_samples, self.pass_settings
        kernel.seed = self.seed
        kernel.camera_sample = view
        kernel.camera_samples = views
        kernel.camera_bits = (views - 1).bit_length()
        kernel.first_sample = spp * view // views
        kernel.sample_count = spp * (view + 1) // views - kernel.first_sample
        kernel.sample_bits = (spp - 1).bit_length()
        kernel.tent = int(self.settings.filter == "tent")
        self.data.bvh.salt = (self.seed + view * VIEW_SALT) % 2**32  # of chance, by which rays pass through surfaces
        self.paths.begin()
        lobes = self.lobes()
        if self.lobe_shares is not None and lobes is not None:
            self.lobe_shares.begin(lobes.diffuse, lobes.apart)

    def end_view(self) -> None:
        """End the camera sample: all light of it is there."""
        lobes = self.lobes()
        if self.lobe_shares is not None and lobes is not None:
            self.lobe_shares.end(lobes.diffuse, lobes.apart)

    # ---- launches ----

    def launch(self, kernel: wp.Kernel, inputs: Sequence[object], count: int | None = None) -> None:
        """Run a kernel over ``count`` items, or over every pixel."""
        if count is not None:
            launch.launch(kernel, count, inputs, self.device)
            return
        width, rows = self.camera.resolution[0], self._rows()
        launch.launch(kernel, len(rows) * width, inputs, self.device, first=rows.start * width)

    @property
    def tiled_items(self) -> int:
        """Number of items of a launch in tiles. Tiles at the border also have items outside the picture."""
        tiles = [math.ceil(size / gbuffer.TILE) for size in self.camera.resolution]
        return tiles[0] * tiles[1] * gbuffer.TILE**2

    def launch_tiled(self, kernel: wp.Kernel, inputs: Sequence[object], share: int = 1) -> None:
        """Run a kernel over every pixel in tiles (``kernels.gbuffer.tiled_pixel``), ``share`` pixels in each item."""
        side, rows, least = int(gbuffer.TILE), self._rows(), max(launch.SMALLEST_SLICE // share, 1)
        each = math.ceil(self.camera.resolution[0] / side) * side**2 // share  # items of a row of tiles
        count, first = math.ceil(len(rows) / side) * each, rows.start // side * each
        launch.launch(kernel, count, inputs, self.device, least, first)

    def _rows(self) -> range:
        """Return the rows of the picture that this frame has; the first is a multiple of the height of tiles."""
        return range(self.camera.resolution[1])

    def trace_paths(self) -> None:
        """Trace the terms that estimators asked for in this camera sample, in one launch (``PathRequest``)."""
        request = self.paths
        request.prepare()
        self._part_lights()
        settings = path_trace.PathSettings()
        settings.terms, settings.max_depth = request.terms, request.max_depth
        settings.roulette_depth, settings.clamp = request.roulette_depth, request.clamp
        settings.sky_probability, settings.spp = self.sky_probability, self.settings.spp
        settings.cache_vertex, settings.lobes = request.cache_vertex, int(self.lobes() is not None)
        settings.hides_sky = float(not self.settings.background)
        tracer = path_trace.path_tracer(*request.samplers(), tints=self.data.panes.count > 0)
        samplers = tracer.samplers()
        for name in tracer.samplers.vars:
            setattr(samplers, name, getattr(request, name).data)
        for name in ("moment1", "moment2"):  # a frame that was done has none left
            if name not in self._arrays:
                self._arrays[name] = self._zeros(wp.vec3)
        buffers = self.struct(path_trace.PathBuffers)
        inputs = [self.data, self.camera_data, self.pass_settings, settings, self.hits, buffers, samplers]
        self.launch_tiled(tracer.trace_paths, inputs)

    def _part_lights(self) -> None:
        """Let paths keep the lights apart that are far brighter than they are large, if a denoiser wants that."""
        request = self.paths
        if not self.settings.parts_lights or request.sky.sampler is not path_samplers.SCENE_SKY:
            return
        terms = (bool(request.terms & bit) for bit in (path_trace.TERM_ENVIRONMENT, path_trace.TERM_EMITTERS))
        self.apart = apart_lights_of(self.scene, self.device, *terms)
        if self.apart is not None:
            request.use_sky(apart_lights.APART_LIGHTS, self.apart.data)
            self._arrays["lobe_apart"] = wp.zeros_like(self._arrays["indirect"])

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the wall time of a block to ``timings[name]``, compilation apart."""
        with timed(self.timings, name, self.device):
            yield


@contextmanager
def timed(timings: dict[str, float], name: str, device: wp.Device) -> Iterator[None]:
    """Add the wall time of a block to ``timings[name]``, and what it compiled to ``timings["compile"]``.

    What blocks within it add is left out, so that all timings add up to the time that passed.
    """
    timings.setdefault("compile", 0.0)
    others, compiled = sum(timings.values()), launch.compile_seconds - timings["compile"]
    started = time.perf_counter()
    yield
    wp.synchronize_device(device)
    others = sum(timings.values()) - others
    compiled = launch.compile_seconds - timings["compile"] - compiled
    timings["compile"] += compiled
    timings[name] = timings.get(name, 0.0) + time.perf_counter() - started - compiled - others


def mixed_seed(seed: int, frame: int) -> int:
    """Return a well-mixed 32-bit seed of a frame (splitmix64)."""
    mask = (1 << 64) - 1
    z = (seed * 0x9E3779B97F4A7C15 + frame * 0xD1B54A32D192ED03 + 0x9E3779B97F4A7C15) & mask
    z = ((z ^ (z >> 30)) * 0xBF58476D1CE4E5B9) & mask
    z = ((z ^ (z >> 27)) * 0x94D049BB133111EB) & mask
    return (z ^ (z >> 31)) & 0xFFFFFFFF
