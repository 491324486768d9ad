"""Denoisers: what turns a composed, noisy frame into the picture that is shown."""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.errors import OptionError, check_whole, one_line, unknown_name
from warp_gi.kernels import denoise, denoise_edges
from warp_gi.stateful import Ahead, Stateful

if TYPE_CHECKING:
    from warp_gi.baking import Bake
    from warp_gi.frame import Frame
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.scene import Scene

__all__ = ["DENOISERS", "Denoiser", "Oidn", "SpatioTemporal"]

MOST_LEVELS = 8
LONG = 4.0
"""Frames from which on an average knows its variance, if the first one has as many samples as others."""
CLIP = 1.5
"""Standard deviations of the pixels around a pixel, to which the last picture is limited in it."""
QUALITIES = ("high", "balanced", "fast")


@dataclass(frozen=True)
class Denoiser(Stateful):
    """Base of every denoiser; a frozen dataclass of plain settings.

    ``start`` makes the state before the first frame. ``apply`` fills a frame's ``beauty`` and returns the state for
    the next frame, leaving the last one as it is. A denoiser keeps nothing anywhere but in its state.
    """

    wants_lobes: ClassVar[bool] = False
    """Whether ``apply`` reads the guides and the separated light (``Frame.lobes``)."""

    def depends_on_past(self, scene: Scene | BakedScene, ahead: Ahead | None = None) -> bool:
        """Return whether a frame depends on those before it; True, unless a denoiser promises that it does not."""
        return True

    def bake_key(self, scene: Scene | BakedScene) -> str:
        """Return the same for every scene: a denoiser learns of a change from the frames."""
        return "any scene"

    def samples(self, frame: Frame, state: Any) -> int:
        """Return the number of samples a pixel that a frame is to take, from the pipeline's own: ``frame.settings``."""
        return frame.settings.spp

    def apply(self, frame: Frame, state: Any) -> Any:
        """Fill ``frame["beauty"]`` from ``frame["noisy"]`` and the other buffers, and return the new state."""
        raise NotImplementedError


@dataclass(frozen=True)
class History:
    """State of ``SpatioTemporal``: what it keeps of the last frame."""

    index: int
    """Number of the frame."""
    resolution: tuple[int, int]
    """Width and height of the frame in pixels."""
    scene: tuple[Scene | BakedScene, str]
    """Scene and the hash of what must not have changed: ``light_of``."""
    guides: denoise.Guides
    """Geometry and colours of the surfaces in the frame's pixels."""
    average: denoise.Signals
    """Averages over frames of diffuse and glossy light, and the number of frames in them."""
    picture: wp.array | None
    """Average of the reflected light of pictures, vec3 [height * width], if pictures are averaged."""

    def leads_to(self, frame: Frame) -> bool:
        """Return whether the frame's motion is towards the last frame, of the same scene and size."""
        return (
            frame.previous_index == self.index != frame.index
            and frame.camera.resolution == self.resolution
            and frame.scene is self.scene[0]
            and light_of(frame.scene) == self.scene[1]
        )


def light_of(scene: Scene | BakedScene) -> str:
    """Return a hash of a scene's light; of all but the sky where that changes over time, little by little."""
    return scene.contents_hash if scene.is_sky_animated else scene.hash


@dataclass(frozen=True)
class SpatioTemporal(Denoiser):
    """An average over frames, then an edge-avoiding filter over pixels that variance guides; diffuse and glossy apart.

    Diffuse light is filtered before it meets the albedo, glossy light before it meets the specular colour.
    Light that estimators do not separate is shared out by reflectance. Sources: Schied et al. 2017,
    "Spatiotemporal Variance-Guided Filtering"; Dammertz et al. 2010, "Edge-Avoiding A-Trous Wavelet Transform".
    What is filtered over pixels is not remembered, unlike in the former.

    The average over frames ends where the surface was not seen, and starts anew after a cut, a change of the
    sky, or frames that do not follow one another. Where a block of pixels has another light than before, earlier
    frames are forgotten. Raises OptionError for settings out of range.
    """

    wants_lobes: ClassVar[bool] = True

    frames: int = 32
    """Most frames in the average of diffuse light, 1 to 1024. 1 is no average over frames."""
    glossy_frames: int = 16
    """Most frames in the average of glossy light, which moves over surfaces as the camera does."""
    levels: int = 4
    """Levels of the filter of diffuse light over pixels, 0 to 8: each reaches twice as far as the one before, and the
    first to the next pixels. 0 is no filter. A frame without a frame before has one more."""
    glossy_levels: int = 2
    """The same of glossy light."""
    luminance: float = 2.0
    """Standard deviations between two pixels' luminances that make their weight 1/e."""
    normal_power: float = 32.0
    """Factor of 1 - the cosine between two pixels' normals in the exponent of their weight."""
    plane_distance: float = 1.0
    """Distance to a pixel's tangent plane that makes a weight 1/e, in widths of a pixel there."""
    lag: float = 3.0
    """Standard deviations by which the light of a block of 8x8 pixels has changed when earlier frames begin to be
    forgotten; at twice as many all are. 0 never forgets."""

    first_samples: int = 4
    """Samples a pixel, at least, of a frame without a frame before, 1 to 65536: the first one, a still, or after a cut.
    There is no average yet that would make up for few."""
    edge_samples: int = 4
    """Camera samples of a pixel whose neighbours show something else, its own among them, 0 to 64. They share the light
    of the pixels around, and cost no light samples. Where neighbours are of one surface and only their colours differ,
    two thirds of the further samples are taken. Frames that have as many in each pixel take no more."""
    blend: float = 0.25
    """Weight of a frame in the average of pictures, above 0 to 1 (temporal antialiasing). Smaller ones flicker less and
    are softer; 1 is no average."""

    def validate(self) -> None:
        """Raise OptionError for settings out of range."""
        check_whole("first_samples", self.first_samples, 1, 1 << 16)
        check_whole("edge_samples", self.edge_samples, 0, 64)
        if not 0 < self.blend <= 1:
            raise OptionError(f"blend must be a weight above 0 and at most 1, got {self.blend}")
        for name in ("frames", "glossy_frames"):
            check_whole(name, getattr(self, name), 1, 1024)
        for name in ("levels", "glossy_levels"):
            check_whole(name, getattr(self, name), 0, MOST_LEVELS)
        for name in ("luminance", "plane_distance", "normal_power"):
            if not 0 < getattr(self, name) < math.inf:
                raise OptionError(f"{name} must be above 0, got {getattr(self, name)}")
        if not 0 <= self.lag < math.inf:
            raise OptionError(f"lag must be 0 or a number of deviations above it, got {self.lag}")

    def samples(self, frame: Frame, state: History | None) -> int:
        """Return ``first_samples`` at least for a frame that no frame leads to."""
        has_history = state is not None and state.leads_to(frame)
        return frame.settings.spp if has_history else max(frame.settings.spp, self.first_samples)

    def apply(self, frame: Frame, state: History | None) -> History:
        """Fill ``frame["beauty"]``; the state is the last frame's History."""
        light, guides, changes = frame.struct(denoise.NoisyLight), frame.struct(denoise.Guides), None
        settings, average = self._settings(frame), self._signals(frame)
        frame.launch(denoise.separate_light, [settings, light, guides, average])
        has_history = state is not None and state.leads_to(frame)
        if state is not None and has_history:
            average, changes = self._accumulated(frame, settings, state, guides, average)
        filtered = self._filtered(frame, settings, guides, average, 0 if has_history else 1)
        frame.launch(denoise.put_back, [light, guides, filtered, frame["beauty"]])
        picture = self._finished(
            frame, settings, guides, filtered, changes, state.picture if state and has_history else None
        )
        scene = (frame.scene, light_of(frame.scene))
        return History(frame.index, frame.camera.resolution, scene, guides, average, picture)

    def _accumulated(
        self,
        frame: Frame,
        settings: denoise.DenoiseSettings,
        state: History,
        guides: denoise.Guides,
        noisy: denoise.Signals,
    ) -> tuple[denoise.Signals, denoise.Changes | None]:
        """Return the average over frames with this one in it, and where light has changed, unless nothing asks."""
        average, changes = self._signals(frame), denoise.Changes()
        frame.launch(denoise.reproject, [settings, guides, state.guides, state.average, average])
        columns, rows = (math.ceil(size / int(denoise.BLOCK)) for size in frame.camera.resolution)
        changes.columns = columns
        changes.diffuse = wp.empty(columns * rows, dtype=wp.float32, device=frame.device)
        changes.glossy = wp.empty_like(changes.diffuse)
        if self.lag > 0:
            frame.launch(denoise.find_changes, [settings, noisy, average, changes], columns * rows)
        frame.launch(denoise.add_frame, [settings, noisy, average, changes, average])
        return average, changes if self.lag > 0 else None

    def _filtered(
        self,
        frame: Frame,
        settings: denoise.DenoiseSettings,
        guides: denoise.Guides,
        average: denoise.Signals,
        more: int,
    ) -> denoise.Filtered:
        """Return the average filtered over pixels, by ``more`` levels than the settings say."""
        count = len(average.length)
        light, spare = denoise.Filtered(), denoise.Filtered()
        for signals in (light, spare):
            signals.diffuse = wp.empty(count, dtype=wp.vec4, device=frame.device)
            signals.glossy = wp.empty_like(signals.diffuse)
        tells = wp.empty(count, dtype=wp.vec2, device=frame.device)
        frame.launch(denoise.estimate_variance, [settings, guides, average, light, tells])
        levels = [levels + more if levels else 0 for levels in (self.levels, self.glossy_levels)]
        for level in range(max(levels)):
            settings.step = 1 << level
            settings.filters_diffuse, settings.filters_glossy = (int(level < most) for most in levels)
            frame.launch(denoise.filter_level, [settings, guides, light, tells, spare])
            light, spare = spare, light
            tells = wp.empty(0, dtype=wp.vec2, device=frame.device)
        return light

    def _finished(
        self,
        frame: Frame,
        settings: denoise.DenoiseSettings,
        guides: denoise.Guides,
        filtered: denoise.Filtered,
        changes: denoise.Changes | None,
        last: wp.array | None,
    ) -> wp.array | None:
        """Give the beauty more camera samples and average it with the last one; return what to keep of it."""
        edges, picture = self._edges(frame), frame.struct(denoise_edges.Picture)
        picture.shining = wp.clone(frame["emission"])
        picture.less = wp.zeros_like(frame["depth"])
        if changes is not None and last is not None:
            frame.launch(denoise_edges.mark_changes, [settings, changes, picture.less])
        if edges.samples > 0:
            inputs = [frame.data, frame.camera_data, settings, edges, guides, filtered, picture]
            frame.launch_tiled(denoise_edges.sample_edges, inputs)
        return self._averaged(frame, settings, edges, picture, last) if self.blend < 1 else None

    def _averaged(
        self,
        frame: Frame,
        settings: denoise.DenoiseSettings,
        edges: denoise_edges.EdgeSettings,
        picture: denoise_edges.Picture,
        last: wp.array | None,
    ) -> wp.array:
        """Average the beauty with the last picture; return its reflected light, which is the next frame's last one."""
        if last is None:
            edges.weight, last = 1.0, wp.empty(0, dtype=wp.vec3, device=frame.device)
        picture.beauty, kept = wp.clone(frame["beauty"]), wp.empty_like(frame["beauty"])
        inputs = [settings, edges, frame.struct(denoise_edges.Seen), picture, last, kept, frame["beauty"]]
        frame.launch(denoise_edges.average_pictures, inputs)
        return kept

    def _settings(self, frame: Frame) -> denoise.DenoiseSettings:
        settings = denoise.DenoiseSettings()
        settings.width, settings.height = frame.camera.resolution
        settings.footprint = 2.0 * math.tan(math.radians(frame.camera.hfov) / 2) / settings.width
        settings.diffuse_frames, settings.glossy_frames = self.frames, self.glossy_frames
        settings.worth = frame.settings.spp / frame.pipeline_samples
        settings.settled = LONG - 1.0 + max(1.0, self.first_samples / frame.pipeline_samples)
        settings.lag, settings.luminance = self.lag, self.luminance
        settings.normal, settings.plane = self.normal_power, self.plane_distance
        return settings

    def _edges(self, frame: Frame) -> denoise_edges.EdgeSettings:
        edges = denoise_edges.EdgeSettings()
        few = frame.settings.camera_samples < self.edge_samples
        edges.own = int(frame.settings.camera_samples == 1)
        edges.samples = self.edge_samples if frame.has_camera_rays and few else 0
        edges.seed, edges.tent = frame.seed, int(frame.settings.filter == "tent")
        edges.weight, edges.clip = self.blend, CLIP
        return edges

    @staticmethod
    def _signals(frame: Frame) -> denoise.Signals:
        width, height = frame.camera.resolution
        signals = denoise.Signals()
        signals.diffuse = wp.empty(width * height, dtype=wp.vec3, device=frame.device)
        signals.glossy = wp.empty_like(signals.diffuse)
        signals.moments = wp.empty(width * height, dtype=wp.vec2, device=frame.device)
        signals.length = wp.empty(width * height, dtype=wp.vec2, device=frame.device)
        return signals


@dataclass(frozen=True)
class OidnFilter(SpatioTemporal):
    """``SpatioTemporal`` with Open Image Denoise in place of its filter over pixels."""

    library: Any = None
    quality: str = "fast"

    def _filtered(
        self,
        frame: Frame,
        settings: denoise.DenoiseSettings,
        guides: denoise.Guides,
        average: denoise.Signals,
        more: int,
    ) -> denoise.Filtered:
        """Return both averages filtered as pictures, with normals as guides that have no noise."""
        width, height = frame.camera.resolution
        normal, known = guides.guide_normal.numpy().reshape(height, width, 3), average.length.numpy() > 0
        filtered = denoise.Filtered()
        for lobe, name in enumerate(("diffuse", "glossy")):
            light = getattr(average, name).numpy().reshape(height, width, 3)
            white = np.ones_like(light)  # albedo: it takes no normals without
            clean = self.library.denoise(light, white, normal, hdr=True, clean_aux=True, quality=self.quality)
            spread = np.where(known[:, lobe], 0.0, -1.0)  # where light is not known, as in denoise.Filtered
            values = np.concatenate([clean.reshape(-1, 3), spread[:, None]], axis=1).astype(np.float32)
            setattr(filtered, name, launch.on_device(values, wp.vec4, frame.device))
        return filtered


@dataclass(frozen=True)
class Oidn(Denoiser):
    """Intel Open Image Denoise of the average over frames of ``SpatioTemporal``, or of each frame for itself.

    What is filtered of an average is light before it meets the surfaces' colours, diffuse and glossy apart; edges and
    the average of pictures are those of ``SpatioTemporal``. It runs on the CPU, on threads of its own, whatever
    the frame's device. ``start`` raises OptionError where it is not installed.
    """

    wants_lobes: ClassVar[bool] = True

    quality: str = "fast"
    """Quality of Open Image Denoise: "high", "balanced" or "fast". Of a frame for itself "high" pays."""
    accumulate: bool = True
    """Whether it denoises the average over frames. False is each frame for itself, with albedo and normals as guides:
    it flickers more, and loses light in dark frames of few samples."""

    def validate(self) -> None:
        """Raise OptionError for an unknown quality."""
        if self.quality not in QUALITIES:
            raise unknown_name("quality", self.quality, QUALITIES)

    def depends_on_past(self, scene: Scene | BakedScene, ahead: Ahead | None = None) -> bool:
        """Return whether it accumulates; else the state is the library alone."""
        return self.accumulate

    def start(self, scene: Scene | BakedScene, device: str, bake: Bake | None = None, seed: int = 0) -> Any:
        """Return the library and no history; raises OptionError where it is not installed."""
        try:
            return importlib.import_module("pyoidn"), None
        except (ImportError, OSError) as error:
            message = f"Open Image Denoise is not here ({error}); pip install 'warp-gi[denoise]'"
            raise OptionError(one_line(message)) from error

    def apply(self, frame: Frame, state: Any) -> Any:
        """Fill ``frame["beauty"]``: emission as it is, and all other light denoised."""
        library, history = state
        if self.accumulate:
            return library, OidnFilter(library=library, quality=self.quality).apply(frame, history)
        emission = frame.numpy("emission")
        noisy = np.maximum(frame.numpy("noisy") - emission, 0.0)
        albedo = np.clip(frame.numpy("albedo"), 0.0, 1.0)
        light = library.denoise(noisy, albedo, frame.numpy("normal"), hdr=True, quality=self.quality)
        frame["beauty"].assign((emission + light).reshape(-1, 3))
        return state


DENOISERS: dict[str, type[Denoiser]] = {"oidn": Oidn, "spatiotemporal": SpatioTemporal}
"""Classes that a pipeline's ``denoise`` may name."""


def denoiser_named(name: str) -> Denoiser:
    """Return the denoiser of that name with its defaults; raises OptionError for an unknown name."""
    if name not in DENOISERS:
        raise unknown_name("denoiser", name, DENOISERS)
    return DENOISERS[name]()
