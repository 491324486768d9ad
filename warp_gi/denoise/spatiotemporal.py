"""A denoiser over frames, then over pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import warp as wp

from warp_gi.denoise.base import Denoiser
from warp_gi.denoise.history import ApartHistory, History, read_guides
from warp_gi.errors import OptionError, check_whole
from warp_gi.kernels import apart_lights, denoise, denoise_apart, denoise_edges, denoise_reflections
from warp_gi.scene.apart import ApartLights, has_apart_lights
from warp_gi.scene.hashing import light_of

if TYPE_CHECKING:
    from warp_gi.baking import Bake
    from warp_gi.frame import Frame
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.scene import Scene

MOST_LEVELS = 8
LONG = 4.0
"""Frames from which on an average knows its variance, if the first one has as many samples as others."""
FIRST_NORMAL, FIRST_LUMINANCE, FIRST_EDGES = 0.25, 2.0, 2
"""Factors of `normal_power`, `luminance` and `edge_samples` in a frame that no frame leads to: few samples, which bumps
of a surface keep apart, leave dots."""
SHIFTS = 4
"""What tells the random numbers of blocks from others of a frame."""
CLIP = 1.5
"""Standard deviations of the pixels around a pixel, to which the last picture is limited in it."""


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
    """Most frames in the average of glossy light. On smooth surfaces it moves as the mirror image does."""
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
    lag: float = 2.0
    """Standard deviations by which the light of a block of 8x8 pixels has changed when earlier frames begin to be
    forgotten; at twice as many all are. 0 never forgets."""

    outliers: float = 6.0
    """Times the root mean square of earlier light around a pixel, in a block of 8x8 and on its surface, above which its
    new light is shared out there: what one ray of many found would stay as a dot. From it no pixel gets more than the
    root mean square itself: above some 70 times of that, light is lost. 0 never shares."""

    first_samples: int = 4
    """Samples a pixel, at least, of a frame without a frame before, 1 to 65536: the first one, a still, or after a cut.
    There is no average yet that would make up for few. Its filter is wider, and edges take twice as many samples."""
    apart_frames: int = 4
    """Most frames in the average of diffuse light from small suns of a sky, and from lights without size if there are
    at most four and no emissive surfaces; 1 to 1024. Each gets a ray of its own, and its shadows are not filtered
    over pixels. 0 leaves it in other light."""
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
        check_whole("apart_frames", self.apart_frames, 0, 1024)
        if not 0 < self.blend <= 1:
            raise OptionError(f"blend must be a weight above 0 and at most 1, got {self.blend}")
        for name in ("frames", "glossy_frames"):
            check_whole(name, getattr(self, name), 1, 1024)
        for name in ("levels", "glossy_levels"):
            check_whole(name, getattr(self, name), 0, MOST_LEVELS)
        for name in ("luminance", "plane_distance", "normal_power"):
            if not 0 < getattr(self, name) < math.inf:
                raise OptionError(f"{name} must be above 0, got {getattr(self, name)}")
        if not 0 <= self.outliers < math.inf:
            raise OptionError(f"outliers must be 0 or a factor above it, got {self.outliers}")
        if not 0 <= self.lag < math.inf:
            raise OptionError(f"lag must be 0 or a number of deviations above it, got {self.lag}")

    @property
    def parts_lights(self) -> bool:
        """Whether there is an average of light that is apart."""
        return self.apart_frames > 0

    @property
    def saves_state(self) -> bool:
        """True: a file holds what the next frame reads, some 74 bytes a pixel."""
        return True

    def kernels(self, scene: Scene | BakedScene | None = None) -> tuple[wp.Kernel, ...]:
        """Return the kernels of the filter, of reflections, of edges, and of light that is apart."""
        reflections = (denoise_reflections.reproject_reflections,) if self.glossy_frames > 1 else ()
        edges = (denoise_edges.sample_edges,) if self.edge_samples or self.blend < 1 else ()
        apart = (denoise_apart.average_apart,) if self.samplers(scene) else ()
        return (denoise.separate_light, *reflections, *edges, *apart)

    def samplers(self, scene: Scene | BakedScene | None = None) -> tuple[Any, ...] | None:
        """Return the lights that paths keep apart, if the scene has any."""
        if scene is None and self.parts_lights:
            return None
        is_parted = scene is not None and self.parts_lights and has_apart_lights(scene)
        return (apart_lights.APART_LIGHTS,) if is_parted else ()

    def start(self, scene: Scene | BakedScene, device: str, bake: Bake | None = None, seed: int = 0) -> History:
        """Return a history of no frame."""
        return History.empty(scene, wp.get_device(device))

    def samples(self, frame: Frame, state: History) -> int:
        """Return ``first_samples`` at least for a frame that no frame leads to."""
        has_history = state.leads_to(frame)
        return frame.settings.spp if has_history else max(frame.settings.spp, self.first_samples)

    def apply(self, frame: Frame, state: History) -> History:
        """Fill ``frame["beauty"]``; the state is the last frame's History."""
        light, guides, changes = frame.struct(denoise.NoisyLight), frame.struct(denoise.Guides), None
        settings, average = self._settings(frame), self._signals(frame)
        frame.launch(denoise.separate_light, [settings, light, guides, average])
        has_history = state.leads_to(frame)
        if has_history:
            average, changes = self._accumulated(frame, settings, state, guides, average)
        else:
            settings.settles = 0
            self._reflect(frame, settings, guides, state, average)
            settings.normal = FIRST_NORMAL * settings.normal
            settings.luminance = FIRST_LUMINANCE * settings.luminance
        filtered = self._filtered(frame, settings, guides, average, 0 if has_history else 1)
        apart = self._apart(frame, settings, state if has_history else None, guides, filtered)
        frame.launch(denoise.put_back, [light, guides, filtered, frame["beauty"]])
        last = state.picture if has_history else None
        picture = self._finished(frame, settings, guides, filtered, changes, last)
        scene = (frame.scene, light_of(frame.scene))
        return History(frame.index, frame.camera.resolution, scene, read_guides(guides), average, apart, picture)

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
        self._reflect(frame, settings, guides, state, average)
        columns, rows = (math.ceil(size / int(denoise.BLOCK)) for size in frame.camera.resolution)
        changes.columns = columns
        changes.diffuse = wp.empty(columns * rows, dtype=wp.float32, device=frame.device)
        changes.glossy = wp.empty_like(changes.diffuse)
        if self.lag > 0:
            frame.launch(denoise.find_changes, [settings, noisy, average, changes], columns * rows)
        self._share(frame, settings, guides, noisy, average, changes)  # after it: shares look like a change of a block
        frame.launch(denoise.add_frame, [settings, noisy, average, changes, average])
        return average, changes if self.lag > 0 else None

    def _share(
        self,
        frame: Frame,
        settings: denoise.DenoiseSettings,
        guides: denoise.Guides,
        noisy: denoise.Signals,
        history: denoise.Signals,
        changes: denoise.Changes,
    ) -> None:
        """Share out light that a single sample found; blocks begin elsewhere in each frame, so that none is seen."""
        if self.outliers > 0:
            block = int(denoise.BLOCK)
            shifts = np.random.default_rng((frame.seed, frame.index, SHIFTS)).integers(0, block, 2)
            settings.outliers, settings.shift_x, settings.shift_y = self.outliers, int(shifts[0]), int(shifts[1])
            width, height = frame.camera.resolution
            count = math.ceil((width + shifts[0]) / block) * math.ceil((height + shifts[1]) / block)
            frame.launch(denoise.share_outliers, [settings, guides, noisy, history, changes], count)

    def _reflect(
        self,
        frame: Frame,
        settings: denoise.DenoiseSettings,
        guides: denoise.Guides,
        state: History,
        average: denoise.Signals,
    ) -> None:
        """Find what smooth surfaces reflect, and let the average of their glossy light move with that."""
        if frame.has_camera_rays and self.glossy_frames > 1:
            views = denoise_reflections.Views()
            views.now, views.before = frame.camera_data, frame.previous_camera_data
            inputs = [frame.data, views, settings, guides, state.guides, state.average, average]
            frame.launch(denoise_reflections.reproject_reflections, inputs)

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

    def _apart(
        self,
        frame: Frame,
        settings: denoise.DenoiseSettings,
        state: History | None,
        guides: denoise.Guides,
        filtered: denoise.Filtered,
    ) -> ApartHistory | None:
        """Add the light of lights that are apart to filtered diffuse light, and return the average over frames."""
        lobes = frame.lobes()
        if frame.apart is None or lobes is None or lobes.apart is None:
            return None
        light = denoise_apart.ApartLight()
        light.noisy, light.frames = lobes.apart, self._apart_frames(frame.apart, state)
        if state is not None and state.apart is not None:
            light.last = state.apart.average
        light.average = wp.empty(len(light.noisy), dtype=wp.vec4, device=frame.device)
        before = guides if state is None else state.guides
        frame.launch(denoise_apart.average_apart, [settings, guides, before, light, filtered])
        return ApartHistory(light.average, frame.apart.directions)

    def _apart_frames(self, lights: ApartLights, state: History | None) -> float:
        """Return the most frames in the average of light that is apart.

        Suns that move take their shadows along: so many frames are of use as they need to move by half their width.
        Shadows of lights without size have no noise.
        """
        if state is None or state.apart is None or len(state.apart.directions) != len(lights.directions):
            return 1.0
        if len(lights.directions) == 0:
            return 1.0
        moved = np.linalg.norm(lights.directions - state.apart.directions, axis=1)
        return min(max(float(np.min(lights.widths / np.maximum(2 * moved, 1e-9))), 1.0), float(self.apart_frames))

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
        if settings.settles == 0:
            edges.samples *= FIRST_EDGES
        if edges.samples > 0:
            inputs = [frame.layer_data, frame.camera_data, settings, edges, guides, filtered, picture]
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
        settings.footprint = frame.camera.footprint
        settings.diffuse_frames, settings.glossy_frames = self.frames, self.glossy_frames
        settings.worth = frame.settings.spp / frame.pipeline_samples
        settings.settled = LONG - 1.0 + max(1.0, self.first_samples / frame.pipeline_samples)
        settings.lag, settings.luminance, settings.settles = self.lag, self.luminance, 1
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
