"""Light of any sky from radiance transfer textures, directly and over other surfaces."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

from warp_gi.errors import OptionError, unknown_name
from warp_gi.estimator import Estimator
from warp_gi.kernels import transfer_light, transfer_shade
from warp_gi.kernels.transfer_native import ORDERS
from warp_gi.radiance_cache import RadianceCache
from warp_gi.scene.baked import whole_scene
from warp_gi.stateful import Ahead, Service
from warp_gi.techniques.radiance_transfer.bake import bake_transfer, transfer_key
from warp_gi.techniques.radiance_transfer.settings import TransferSettings
from warp_gi.techniques.radiance_transfer.sky import SkyLight, TransferLight
from warp_gi.techniques.radiance_transfer.state import TransferState, transfer_state

if TYPE_CHECKING:
    from warp_gi.baking import Bake, Setting
    from warp_gi.frame import Frame
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.camera import Camera, CameraPath
    from warp_gi.scene.scene import Scene

TERM_BITS = {
    "environment": int(transfer_shade.WANTS_ENVIRONMENT),
    "indirect": int(transfer_shade.WANTS_INDIRECT),
}
"""Terms that transfer textures know."""


@dataclass(frozen=True)
class RadianceTransfer(Estimator, RadianceCache):
    """Light of any sky from textures that keep, for every texel of the surfaces, how light arrives there.

    The bake holds no light: under another sky, turned or changing from frame to frame, a pixel costs a texture fetch
    and a few products, and has no noise. It serves the terms "environment" and "indirect"; one bake serves both.
    Biased: a sky has 25 numbers a channel, and what moves casts no shadow.
    Source: Sirikonda et al., "Precomputed Radiance Transfer Textures" (prt_textures.txt).
    """

    term: str = "environment"
    """Term of the light: "environment" is direct light from the sky, "indirect" light that was reflected before."""
    storage: Literal["texture", "vertices"] = "texture"
    """Where transfer is kept: in texels of an atlas ("texture"), or at the vertices of meshes ("vertices"), as a
    baseline."""
    resolution: int = 1024
    """Texels along a side of the atlas; several pages share its area."""
    texel_sets: str = "auto"
    """Densities of texels: "auto" gives small parts more, "one" is one density for all, "NAME=FACTOR,..." is a factor
    by name of node or mesh."""
    charts: Literal["auto", "xatlas", "own"] = "auto"
    """Where texture coordinates come from: "auto" takes a mesh's own where they do not overlap, "xatlas" makes all,
    "own" makes none."""
    chart_seconds: float = 600.0
    """Seconds that making charts may take; 0 is no limit."""
    order: int = 5
    """Order of the spherical harmonics of transfer: 5 (25 numbers a texel) or 6 (36), which halves the error of glossy
    light."""
    first_rays: int = 64
    """Rays a texel before it is known whether it sees both sky and surfaces."""
    rays: int = 512
    """Rays a texel that does."""
    bounce_rays: int = 64
    """Rays a texel that find the surfaces from which light bounces."""
    bounces: int = 16
    """Largest number of bounces."""
    tolerance: float = 0.002
    """Share of all light that a bounce has to add, or there is no further one."""
    sun: float = 20.0
    """Radiance, in means of the sky, above which light is a sun's: it leaves the harmonics of direct light and gets a
    shadow ray. 0 keeps all light in the harmonics."""
    window: float = 0.005
    """Strength of the window on the light of glossy lobes, against ringing: bands l are divided by
    1 + window l^2 (l + 1)^2."""

    def validate(self) -> None:
        """Raise OptionError for settings out of range."""
        choices = (
            ("term", self.term, tuple(TERM_BITS)),
            ("storage", self.storage, ("texture", "vertices")),
            ("charts", self.charts, ("auto", "xatlas", "own")),
        )
        for name, value, known in choices:
            if value not in known:
                raise unknown_name(name, value, known)
        if self.order not in ORDERS:
            raise OptionError(f"order must be 5 or 6, got {self.order}")
        for name, low, high in (
            ("resolution", 16, 16384),
            ("first_rays", 4, 4096),
            ("rays", 4, 65536),
            ("bounce_rays", 4, 4096),
            ("bounces", 0, 256),
        ):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
                raise OptionError(f"{name} must be a whole number from {low} to {high}, got {value!r}")
        if self.rays < self.first_rays:
            raise OptionError(f"rays must be at least first_rays ({self.first_rays}), got {self.rays}")
        for name in ("chart_seconds", "tolerance", "sun", "window"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise OptionError(f"{name} must be finite and not negative, got {value}")

    @property
    def transfer_settings(self) -> TransferSettings:
        """The settings that decide what is baked."""
        return TransferSettings(**{name: getattr(self, name) for name in TransferSettings.__dataclass_fields__})

    @property
    def services(self) -> tuple[Service, ...]:
        """The present sky, which both terms share."""
        return (TransferLight(self.transfer_settings, self.sun, self.window),)

    # ---- the bake ----

    def bake_key(self, scene: Scene | BakedScene) -> str:
        """Return a hash of all that the bake depends on: not of the sky."""
        return transfer_key(whole_scene(scene))

    def bake_settings(self, scene: Scene | BakedScene) -> dict[str, Setting]:
        """Return the settings that the bake depends on."""
        return self.transfer_settings.stored()

    def bake(
        self,
        scene: Scene,
        device: str,
        seed: int = 0,
        progress: Callable[[float], None] | None = None,
        camera: Camera | CameraPath | None = None,
    ) -> Bake:
        """Return transfer textures of the scene at time 0. Raises OptionError, SceneError or BakeError."""
        return bake_transfer(scene, self.transfer_settings, device, seed, progress)

    def start(
        self, scene: Scene | BakedScene, device: str, bake: Bake | None = None, seed: int = 0
    ) -> TransferState:
        """Return the bake on the device; terms that share it share its memory."""
        return transfer_state(bake or self.bake(whole_scene(scene), device, seed), device)

    # ---- frames ----

    def depends_on_past(self, scene: Scene | BakedScene, ahead: Ahead | None = None) -> bool:
        """Return False: the bake is all that is kept, and the sky is the frame's own."""
        return False

    def preprocess(self, frame: Frame, state: TransferState) -> TransferState:
        """Let the terms of equal settings know of each other, so that one launch serves them."""
        others = frame.offered(_Together)
        frame.offer(_Together((*(others.estimators if others else ()), self)))
        return state

    def give(self, frame: Frame, state: TransferState) -> None:
        """Let paths end in what is known of light that was reflected before."""
        cache = transfer_light.TransferCache()
        cache.rows, cache.sky = state.rows, self._sky(frame)
        frame.paths.use_cache(transfer_light.TRANSFER_CACHE, cache)

    def trace(self, frame: Frame, state: TransferState) -> None:
        """Add the light of the current camera sample, of all terms with these settings at once."""
        together = frame.offered(_Together)
        alike = [one for one in together.estimators if replace(one, term=self.term) == self] if together else [self]
        if alike[0] is not self:
            return  # the first of them did it
        query, buffers = transfer_shade.TransferQuery(), transfer_shade.TransferBuffers()
        buffers.width, buffers.height = frame.camera.resolution
        for one in alike:
            query.terms |= TERM_BITS[one.term]
            setattr(buffers, one.term, frame[one.term])
            for order, moment in enumerate(frame.moments(one.term), 1):
                setattr(buffers, f"{one.term}_moment{order}", moment)
        inputs = [frame.data, frame.pass_settings, state.rows, self._sky(frame), query, frame.hits, buffers]
        frame.launch_tiled(transfer_shade.shade_transfer, inputs)

    def _sky(self, frame: Frame) -> transfer_light.TransferSky:
        light = frame.offered(SkyLight)
        if light is None:
            raise OptionError("the service transfer_light has not seen this frame's sky: list it among the services")
        return light.sky


@dataclass(frozen=True)
class _Together:
    """Estimators of this class in a frame."""

    estimators: tuple[RadianceTransfer, ...]
