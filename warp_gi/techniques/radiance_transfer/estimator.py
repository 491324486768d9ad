"""Light of any sky from radiance transfer textures, directly and over other surfaces."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce
from numbers import Real
from operator import or_
from typing import TYPE_CHECKING, Any, Literal

from warp_gi.errors import OptionError, unknown_name
from warp_gi.estimator import Estimator
from warp_gi.kernels import path_trace, transfer_light, transfer_shade
from warp_gi.kernels.transfer_snippets import ORDERS
from warp_gi.radiance_cache import RadianceCache
from warp_gi.scene.baked import whole_scene
from warp_gi.stateful import Ahead, Service
from warp_gi.techniques.radiance_transfer.bake import bake_transfer, transfer_key
from warp_gi.techniques.radiance_transfer.settings import TransferSettings
from warp_gi.techniques.radiance_transfer.sky import SkyLight, TransferLight
from warp_gi.techniques.radiance_transfer.state import TransferState, needs_rays, transfer_state
from warp_gi.techniques.shared.atlas.densities import parse_texel_sets
from warp_gi.techniques.shared.lamps import lamps_move

if TYPE_CHECKING:
    import warp as wp

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
MOST_EDGES, ROULETTE_EDGES = 64, 2
"""Edges of the longest path from what moves, and number of edges from which on paths end at random."""


@dataclass(frozen=True)
class RadianceTransfer(Estimator, RadianceCache):
    """Light of any sky from textures that keep, for every texel of the surfaces, how light arrives there.

    The bake holds no light: under another sky, turned or changing from frame to frame, a pixel costs a texture fetch
    and a few products, and has no noise. It serves the terms "environment" and "indirect"; one bake serves both.
    Biased: a sky has 25 numbers a channel, and what moves casts no shadow.
    Source: Sirikonda et al., "Precomputed Radiance Transfer Textures" (prt_textures.txt).
    """

    term: str = "environment"  # type: ignore[misc]  # a field: one class serves two terms
    """Term of the light: "environment" is direct light from the sky, "indirect" light that was reflected before."""
    storage: Literal["texture", "vertices"] = "texture"
    """Where transfer is kept: in texels of an atlas ("texture"), or at the vertices of meshes ("vertices"), as a
    baseline."""
    resolution: int = 1024
    """Texels along the longer side of the atlas, which is one page; charts leave a few columns or rows unused."""
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
    first_rays: int = 128
    """Rays a texel before it is known whether it sees both sky and surfaces."""
    rays: int = 512
    """Rays a texel that does."""
    bounce_rays: int = 64
    """Rays a texel that find the surfaces from which light bounces."""
    bounces: int = 16
    """Largest number of bounces."""
    tolerance: float = 0.0005
    """Share of all light that a bounce has to add, or there is no further one."""
    sun: float = 20.0
    """Radiance, in means of the sky, above which light is a sun's: it leaves the harmonics of direct light and gets a
    shadow ray. 0 keeps all light in the harmonics."""
    soft_suns: bool = True
    """Whether suns are discs, with soft shadows by a ray from each camera sample to another point; else points, with
    hard shadows."""
    glossy: Literal["auto", "ratio", "transfer", "traced"] = "auto"
    """How glossy lobes are lit: "transfer" by transfer alone, as in the paper; "ratio" by the sky prefiltered for the
    lobe, of which transfer says how much occluders let through; "traced" by rays; "auto" by transfer down to a
    roughness of ``ratio_below``, by the ratio down to ``traced_below``, and by rays below. "transfer" and "ratio" take
    lobes of a roughness below 0.2 for ones of 0.2."""
    lobe: Literal["ggx", "phong"] = "ggx"
    """Lobe of "transfer" and "ratio": that of the materials ("ggx"), or the paper's ("phong") about the mirrored view,
    (s + 2) / (2 pi) cos^s with s = 2 / roughness^4 - 2, which loses light towards grazing views."""
    ratio_below: float = 0.65
    """Roughness below which the ratio serves glossy lobes: above, the sky's 25 numbers are the smaller error."""
    traced_below: float = 0.45
    """Roughness below which rays are traced for the glossy lobe, one for each of the pipeline's samples."""
    window: float = 0.0
    """Strength of the window on the light of glossy lobes, against ringing: bands l are divided by
    1 + window l^2 (l + 1)^2."""

    def validate(self) -> None:
        """Raise OptionError for settings out of range."""
        choices = (
            ("term", self.term, tuple(TERM_BITS)),
            ("storage", self.storage, ("texture", "vertices")),
            ("charts", self.charts, ("auto", "xatlas", "own")),
            ("lobe", self.lobe, ("ggx", "phong")),
            ("glossy", self.glossy, ("auto", "ratio", "transfer", "traced")),
        )
        for name, value, known in choices:
            if value not in known:
                raise unknown_name(name, value, known)
        parse_texel_sets(self.texel_sets)
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
        if self.term == "indirect" and self.bounces == 0:
            raise OptionError('term "indirect" needs bounces of at least 1, got 0: leave the term out (None)')
        for name in ("chart_seconds", "tolerance", "sun", "ratio_below", "traced_below", "window"):
            value = getattr(self, name)
            if not (isinstance(value, Real) and math.isfinite(value) and float(value) >= 0):
                raise OptionError(f"{name} must be a finite number that is not negative, got {value!r}")
        if 0 < self.sun <= 1:
            raise OptionError(f"sun must be 0 (no suns apart) or a number of means above 1, got {self.sun}")

    @property
    def transfer_settings(self) -> TransferSettings:
        """The settings that decide what is baked."""
        return TransferSettings(**{name: getattr(self, name) for name in TransferSettings.__dataclass_fields__})

    @property
    def _traced_below(self) -> float:
        return {"ratio": 0.0, "transfer": 0.0, "traced": 2.0}.get(self.glossy, self.traced_below)

    @property
    def services(self) -> tuple[Service, ...]:
        """The present sky, which both terms share."""
        return (TransferLight(self.transfer_settings, self.sun, self.window, self.lobe),)

    # ---- the bake ----

    def bake_key(self, scene: Scene | BakedScene) -> str:
        """Return a hash of all that the bake depends on: not of the sky."""
        return transfer_key(whole_scene(scene), self.bounces > 0)

    def kernels(self, scene: Scene | BakedScene | None = None) -> tuple[wp.Kernel, ...]:
        """Return the kernels of light at surfaces."""
        return (transfer_shade.shade_transfer,)

    def samplers(self, scene: Scene | BakedScene | None = None) -> tuple[Any, ...]:
        """Return the transfer, as paths end in it."""
        return (transfer_light.TRANSFER_CACHE,)

    def bake_settings(self, scene: Scene | BakedScene) -> dict[str, Setting]:
        """Return the settings that the bake depends on."""
        return self.transfer_settings.stored()

    def bake_identity(self, scene: Scene | BakedScene, camera: Camera | CameraPath | None = None) -> str:
        """Return the hash of what is baked: never the sky, and no view."""
        return self.bake_key(scene)

    def bake(
        self,
        scene: Scene,
        device: str,
        seed: int = 0,
        progress: Callable[[float], None] | None = None,
        camera: Camera | CameraPath | None = None,
    ) -> Bake:
        """Return transfer textures of the scene at time 0. Raises OptionError, SceneError or BakeError."""
        self._check_lamps(scene)
        return bake_transfer(scene, self.transfer_settings, device, seed, progress)

    def start(self, scene: Scene | BakedScene, device: str, bake: Bake | None = None, seed: int = 0) -> TransferState:
        """Return the bake on the device; terms that share it share its memory.

        Raises OptionError for indirect light of lamps that move.
        """
        scene = whole_scene(scene)
        self._check_lamps(scene)
        state = transfer_state(bake or self.bake(scene, device, seed), device)
        return self._of_surfaces(scene, state)

    def _of_surfaces(self, scene: Scene, state: TransferState) -> TransferState:
        needs = needs_rays(scene, state.bare_faces, self._traced_below)
        return replace(state, needs_rays=needs, surfaces=scene.light_hash)

    def _check_lamps(self, scene: Scene) -> None:
        """Raise OptionError for indirect light of lamps that move."""
        if self.term == "indirect" and lamps_move(scene):
            raise OptionError(
                "lamps of this scene move, and what is baked holds the bounces of lamps that rest; take "
                "indirect=BsdfPaths(ends_in=RadianceTransfer()), which traces the first bounce of their light"
            )

    # ---- frames ----

    def preprocess(self, frame: Frame, state: TransferState) -> TransferState:
        """Return the state for the materials of now: a bake without bounces serves all of them."""
        scene = whole_scene(frame.scene)
        return state if state.surfaces == scene.light_hash else self._of_surfaces(scene, state)

    def depends_on_past(self, scene: Scene | BakedScene, ahead: Ahead | None = None) -> bool:
        """Return False: the state follows from the bake and the materials."""
        return False

    def give(self, frame: Frame, state: TransferState) -> None:
        """Let paths end in what is known of light that was reflected before."""
        frame.paths.use_cache(transfer_light.TRANSFER_CACHE, transfer_cache(state, self._sky(frame)))

    def trace(self, frame: Frame, state: TransferState) -> None:
        """Add the light of the current camera sample, of all terms with these settings at once."""
        own = {term: one for term, one in frame.estimators.items() if isinstance(one, RadianceTransfer)}
        mine = [term for term, one in own.items() if replace(one, term=self.term) == self]
        mine = mine or [self.term]  # a frame that no scheduler made, or an estimator within another
        if mine[0] != self.term:
            return  # the first of them did it
        query, buffers = transfer_shade.TransferQuery(), transfer_shade.TransferBuffers()
        buffers.width, buffers.height = frame.camera.resolution
        query.terms = reduce(or_, (TERM_BITS[term] for term in mine))
        for term in mine:
            setattr(buffers, term, frame[term])
            for order, moment in enumerate(frame.moments(term), 1):
                setattr(buffers, f"{term}_moment{order}", moment)
        query.traced_below = self._traced_below
        query.ratio_below = {"ratio": 2.0, "transfer": 0.0}.get(self.glossy, self.ratio_below)
        query.soft = int(self.soft_suns)
        query.traces = int(state.needs_rays)
        sky = self._sky(frame)
        inputs = [frame.data, frame.pass_settings, state.rows, sky, query, frame.hits, buffers]
        frame.launch_tiled(transfer_shade.shade_transfer, inputs)
        if query.traces:
            self._trace_rays(frame, transfer_cache(state, sky), query, buffers)

    def _trace_rays(
        self,
        frame: Frame,
        cache: transfer_light.TransferCache,
        query: transfer_shade.TransferQuery,
        buffers: transfer_shade.TransferBuffers,
    ) -> None:
        """Add the light of pixels that transfer does not serve."""
        from warp_gi.kernels import transfer_trace  # it has a path tracer in it, which most scenes do without

        samplers = transfer_trace.TransferSamplers()
        samplers.cache = cache
        paths = path_trace.PathSettings()
        paths.terms = int(path_trace.TERM_ENVIRONMENT | path_trace.TERM_INDIRECT)
        paths.max_depth, paths.roulette_depth = MOST_EDGES, ROULETTE_EDGES
        paths.sky_probability, paths.spp = frame.sky_probability, frame.settings.spp
        paths.cache_vertex = int(path_trace.CACHE_VERTEX)
        inputs = [frame.data, frame.pass_settings, samplers, paths, query, frame.hits, buffers]
        frame.launch_tiled(transfer_trace.trace_transfer, inputs)

    def _sky(self, frame: Frame) -> transfer_light.TransferSky:
        light = frame.offered(SkyLight)
        if light is None:
            raise OptionError("the service transfer_light has not seen this frame's sky: list it among the services")
        return light.sky


def transfer_cache(state: TransferState, sky: transfer_light.TransferSky) -> transfer_light.TransferCache:
    """Return textures and sky as paths read them."""
    cache = transfer_light.TransferCache()
    cache.rows, cache.sky = state.rows, sky
    return cache
