"""Denoisers: what turns a composed, noisy frame into the picture that is shown."""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass
from numbers import Integral
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import warp as wp

from warp_gi.errors import OptionError, one_line, unknown_name
from warp_gi.kernels import denoise
from warp_gi.stateful import Ahead, Stateful

if TYPE_CHECKING:
    from warp_gi.baking import Bake
    from warp_gi.frame import Frame
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.scene import Scene

__all__ = ["DENOISERS", "Denoiser", "Oidn", "SpatioTemporal"]

MOST_RADIUS = 64  # pixels
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
    """Scene and its hash: another sky or animation is another light."""
    guides: denoise.Guides
    """Geometry and colours of the surfaces in the frame's pixels."""
    average: denoise.Signals
    """Averages over frames of diffuse and glossy light, and the number of frames in them."""

    def leads_to(self, frame: Frame) -> bool:
        """Return whether the frame's motion is towards the last frame, of the same scene and size."""
        return (
            frame.previous_index == self.index != frame.index
            and frame.camera.resolution == self.resolution
            and frame.scene is self.scene[0]
            and frame.scene.hash == self.scene[1]
        )


@dataclass(frozen=True)
class SpatioTemporal(Denoiser):
    """A filter over frames, then over neighbouring pixels; diffuse and glossy light apart.

    Diffuse light is filtered before it meets the albedo, glossy light before it meets the specular colour.
    Light that estimators do not separate is shared out by reflectance. Blurs shadows and reflections, and
    lags behind light that moves. Source: light_field_probes.txt, section 5.1.

    The average over frames ends where the surface was not seen, and starts anew after a cut, a change of the
    sky, or frames that do not follow one another. Raises OptionError for settings out of range.
    """

    wants_lobes: ClassVar[bool] = True

    diffuse_radius: int = 12
    """Radius in pixels of the filter of diffuse light. 0 is no filter over pixels."""
    diffuse_stride: int = 2
    """Distance in pixels between the taps of the filter of diffuse light."""
    diffuse_hysteresis: float = 0.98
    """Weight of the frames before in the average of diffuse light. 0 is no average over frames."""
    glossy_radius: int = 3
    """Radius in pixels of the filter of glossy light. 0 is no filter over pixels."""
    glossy_stride: int = 1
    """Distance in pixels between the taps of the filter of glossy light."""
    glossy_hysteresis: float = 0.75
    """Weight of the frames before in the average of glossy light."""
    plane_distance: float = 0.02
    """Distance to a pixel's tangent plane that makes another surface, as a share of the distance to the camera."""
    normal_power: float = 8.0
    """Power of the cosine between two pixels' normals that is a factor of their weight."""
    shrink: float = 1.0 / 3.0
    """Power of the number of samples averaged over frames by which the filter over pixels narrows. 0 keeps it."""

    def validate(self) -> None:
        """Raise OptionError for settings out of range."""
        for kind in ("diffuse", "glossy"):
            radius, stride = getattr(self, f"{kind}_radius"), getattr(self, f"{kind}_stride")
            hysteresis = getattr(self, f"{kind}_hysteresis")
            for name, value in (("radius", radius), ("stride", stride)):
                if isinstance(value, bool) or not isinstance(value, Integral):
                    raise OptionError(f"{kind}_{name} must be a whole number of pixels, got {value!r}")
            if not 0 <= radius <= MOST_RADIUS:
                raise OptionError(f"{kind}_radius must be from 0 to {MOST_RADIUS} pixels, got {radius}")
            if stride < 1:
                raise OptionError(f"{kind}_stride must be at least 1 pixel, got {stride}")
            if not 0 <= hysteresis < 1:
                raise OptionError(f"{kind}_hysteresis must be at least 0 and below 1, got {hysteresis}")
        for name in ("plane_distance", "normal_power"):
            if not 0 < getattr(self, name) < math.inf:
                raise OptionError(f"{name} must be above 0, got {getattr(self, name)}")
        if not 0 <= self.shrink <= 1:
            raise OptionError(f"shrink must be from 0 to 1, got {self.shrink}")

    def apply(self, frame: Frame, state: History | None) -> History:
        """Fill ``frame["beauty"]``; the state is the last frame's History."""
        # Over frames first: what is remembered stays sharp, and the more frames there are the less blur is needed.
        # With a constant blur the order makes little difference: relative MSE at 8 spp, moving camera, 0.0061 this way
        # and 0.0066 the other in cornell_box, 0.208 and 0.210 in atrium. With a blur that shrinks 0.0028 and 0.128.
        light, guides = frame.struct(denoise.NoisyLight), frame.struct(denoise.Guides)
        signals = self._signals(frame)
        frame.launch(denoise.separate_light, [light, guides, signals])
        if state is not None and state.leads_to(frame):
            average = self._signals(frame)
            settings = self._temporal_settings(frame)
            inputs = [settings, guides, state.guides, signals, state.average, average]
            frame.launch(denoise.accumulate_frames, inputs)
        else:
            average = signals
        frame.launch(denoise.put_back, [light, guides, self._blurred(frame, guides, average), frame["beauty"]])
        scene = (frame.scene, frame.scene.hash)
        return History(frame.index, frame.camera.resolution, scene, guides, average)

    def _blurred(self, frame: Frame, guides: denoise.Guides, source: denoise.Signals) -> denoise.Signals:
        """Return signals filtered over pixels."""
        filtered = denoise.Signals()
        filtered.length = source.length
        for kind in ("diffuse", "glossy"):
            light = getattr(source, kind)
            if getattr(self, f"{kind}_radius") == 0:
                setattr(filtered, kind, light)
                continue
            setattr(filtered, kind, wp.empty_like(light))
            inputs = [self._spatial_settings(frame, kind), guides, light, source.length, getattr(filtered, kind)]
            frame.launch(denoise.filter_neighbourhood, inputs)
        return filtered

    def _temporal_settings(self, frame: Frame) -> denoise.TemporalSettings:
        settings = denoise.TemporalSettings()
        settings.width, settings.height = frame.camera.resolution
        settings.diffuse_weight = 1.0 - self.diffuse_hysteresis
        settings.glossy_weight = 1.0 - self.glossy_hysteresis
        settings.plane_distance = self.plane_distance
        return settings

    def _spatial_settings(self, frame: Frame, kind: str) -> denoise.SpatialSettings:
        hysteresis = getattr(self, f"{kind}_hysteresis")
        settings = denoise.SpatialSettings()
        settings.width, settings.height = frame.camera.resolution
        settings.radius = getattr(self, f"{kind}_radius")
        settings.stride = getattr(self, f"{kind}_stride")
        settings.deviation = settings.radius / 2
        settings.plane_distance, settings.normal_power = self.plane_distance, self.normal_power
        settings.samples = frame.settings.spp
        settings.longest = (1.0 + hysteresis) / (1.0 - hysteresis)
        settings.shrink = self.shrink
        return settings

    @staticmethod
    def _signals(frame: Frame) -> denoise.Signals:
        width, height = frame.camera.resolution
        signals = denoise.Signals()
        signals.diffuse = wp.empty(width * height, dtype=wp.vec3, device=frame.device)
        signals.glossy = wp.empty_like(signals.diffuse)
        signals.length = wp.empty(width * height, dtype=wp.float32, device=frame.device)
        return signals


@dataclass(frozen=True)
class Oidn(Denoiser):
    """Intel Open Image Denoise, with albedo and normals as guides; each frame for itself.

    Runs on the CPU, on threads of its own, whatever the frame's device. ``start`` raises OptionError where it is
    not installed.
    """

    quality: str = "high"
    """Quality of Open Image Denoise: "high", "balanced" or "fast"."""

    def validate(self) -> None:
        """Raise OptionError for an unknown quality."""
        if self.quality not in QUALITIES:
            raise unknown_name("quality", self.quality, QUALITIES)

    def depends_on_past(self, scene: Scene | BakedScene, ahead: Ahead | None = None) -> bool:
        """Return False: the state is the library."""
        return False

    def start(self, scene: Scene | BakedScene, device: str, bake: Bake | None = None, seed: int = 0) -> Any:
        """Return the library; raises OptionError where it is not installed."""
        try:
            return importlib.import_module("pyoidn")
        except (ImportError, OSError) as error:
            message = f"Open Image Denoise is not here ({error}); pip install 'warp-gi[denoise]'"
            raise OptionError(one_line(message)) from error

    def apply(self, frame: Frame, state: Any) -> Any:
        """Fill ``frame["beauty"]``: emission as it is, and all other light denoised."""
        emission = frame.numpy("emission")
        noisy = np.maximum(frame.numpy("noisy") - emission, 0.0)
        albedo = np.clip(frame.numpy("albedo"), 0.0, 1.0)
        light = state.denoise(noisy, albedo, frame.numpy("normal"), hdr=True, quality=self.quality)
        frame["beauty"].assign((emission + light).reshape(-1, 3))
        return state


DENOISERS: dict[str, type[Denoiser]] = {"oidn": Oidn, "spatiotemporal": SpatioTemporal}
"""Classes that a pipeline's ``denoise`` may name."""


def denoiser_named(name: str) -> Denoiser:
    """Return the denoiser of that name with its defaults; raises OptionError for an unknown name."""
    if name not in DENOISERS:
        raise unknown_name("denoiser", name, DENOISERS)
    return DENOISERS[name]()
