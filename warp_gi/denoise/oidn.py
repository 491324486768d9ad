"""Intel Open Image Denoise."""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.denoise.base import Denoiser
from warp_gi.denoise.history import History
from warp_gi.denoise.spatiotemporal import SpatioTemporal
from warp_gi.errors import OptionError, one_line, unknown_name
from warp_gi.kernels import denoise
from warp_gi.stateful import Ahead

if TYPE_CHECKING:
    from warp_gi.baking import Bake
    from warp_gi.frame import Frame
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.scene import Scene

QUALITIES = ("high", "balanced", "fast")


@dataclass(frozen=True)
class OidnFilter(SpatioTemporal):
    """``SpatioTemporal`` with Open Image Denoise in place of its filter over pixels."""

    apart_frames: int = 0
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
class OidnState:
    """State of ``Oidn``."""

    library: Any = field(metadata={"derived": True})
    """The module of Open Image Denoise."""
    history: History
    """What it keeps of the last frame, if it accumulates."""

    def fault(self, before: OidnState, states: Mapping[str, Any]) -> str:
        """Return why a state that was read from a file cannot be; "" if it can."""
        return self.history.fault(before.history, states)


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

    @property
    def saves_state(self) -> bool:
        """True: a file holds the average."""
        return True

    def kernels(self, scene: Scene | BakedScene | None = None) -> tuple[wp.Kernel, ...]:
        """Return the kernels of the average and of edges."""
        return OidnFilter().kernels(scene) if self.accumulate else ()

    def start(self, scene: Scene | BakedScene, device: str, bake: Bake | None = None, seed: int = 0) -> OidnState:
        """Return the library and a history of no frame; raises OptionError where it is not installed."""
        try:
            return OidnState(importlib.import_module("pyoidn"), History.empty(scene, wp.get_device(device)))
        except (ImportError, OSError) as error:
            message = f"Open Image Denoise is not here ({error}); pip install 'warp-gi[denoise]'"
            raise OptionError(one_line(message)) from error

    def apply(self, frame: Frame, state: OidnState) -> OidnState:
        """Fill ``frame["beauty"]``: emission as it is, and all other light denoised."""
        if self.accumulate:
            accumulating = OidnFilter(library=state.library, quality=self.quality)
            return replace(state, history=accumulating.apply(frame, state.history))
        emission = frame.numpy("emission")
        noisy = np.maximum(frame.numpy("noisy") - emission, 0.0)
        albedo = np.clip(frame.numpy("albedo"), 0.0, 1.0)
        light = state.library.denoise(noisy, albedo, frame.numpy("normal"), hdr=True, quality=self.quality)
        frame["beauty"].assign((emission + light).reshape(-1, 3))
        return state
