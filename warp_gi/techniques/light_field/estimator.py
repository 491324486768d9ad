"""Light field probes: indirect light from octahedral maps that know what they see (light_field_probes.txt)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from warp_gi import launch
from warp_gi.baking import Bake, Setting
from warp_gi.errors import BakeError, OptionError, check_whole, unknown_name
from warp_gi.estimator import Ahead, Estimator
from warp_gi.kernels import gbuffer, light_field_cache
from warp_gi.kernels import light_field as field_kernels
from warp_gi.kernels import light_field_trace as trace_kernels
from warp_gi.primary import Primary
from warp_gi.radiance_cache import RadianceCache
from warp_gi.scene.baked import BakedScene, whole_scene
from warp_gi.scene.camera import Camera, CameraPath
from warp_gi.techniques.light_field.arrays import check_arrays
from warp_gi.techniques.light_field.settings import ProbeSettings
from warp_gi.techniques.light_field.state import ProbeState, path_settings, sky_bytes
from warp_gi.techniques.shared.lamps import lit_data
from warp_gi.techniques.shared.views import camera_rows, cameras_of, known_rows

if TYPE_CHECKING:
    import warp as wp

    from warp_gi.frame import Frame
    from warp_gi.scene.scene import Scene

_MODES = {
    "irradiance": trace_kernels.MODE_IRRADIANCE,
    "hybrid": trace_kernels.MODE_HYBRID,
    "traced": trace_kernels.MODE_TRACED,
}
_THROUGH = {"geometry": trace_kernels.RAYS_GEOMETRY, "probes": trace_kernels.RAYS_PROBES}
VISIBILITIES = {"probes": light_field_cache.VISIBILITY_PROBES, "exact": light_field_cache.VISIBILITY_EXACT}
_PRIMARIES = ("geometry", "probes")
_WEIGHTS = ("visibility", "trilinear")
MOST_RESOLUTION = 1024
"""Largest number of texels along a side of a map."""
UNSEEN_RAYS = 16
"""Least number of rays of a pixel whose surface too few probes see. Such pixels are few, and would look noisy beside
the others."""
SAME_VIEW = 1e-4
"""Largest relative difference between a number of a camera and that of a bake's camera for the two to be the same."""
SETTLED = 0.02
"""Share of the irradiance before a change that may be left in a probe's when it counts as refreshed."""


@dataclass(frozen=True)
class LightFieldProbes(Estimator, RadianceCache):
    """Indirect light from a grid of probes that hold radiance, normals and distances in all directions.

    Biased: the error depends on the number of probes, on their resolution, and on what they cannot see. (McGuire
    et al. 2017, "Real-Time Global Illumination using Precomputed Light Field Probes".)
    """

    term: ClassVar[str] = "indirect"

    mode: Literal["irradiance", "hybrid", "traced"] = "hybrid"
    """Which light is traced: "irradiance" traces none, reads the probes' filtered irradiance and has no noise; "hybrid"
    does so for the diffuse part and traces rays for the glossy part; "traced" traces rays for both."""
    through: Literal["geometry", "probes"] = "geometry"
    """What rays are traced through. "geometry" is the scene: what rays meet is lit by direct light, which is sampled,
    and by the probes' irradiance. "probes" is their maps alone, as in the paper, which takes many times as long on a
    CPU."""
    visibility: Literal["probes", "exact"] = "probes"
    """How the probes that see a point are found among the eight around it: by their maps ("probes"), or by shadow rays
    ("exact"), which let less light through walls and take two to three times as long. Where too few probes see a
    point, rays are traced."""
    counts: tuple[int, int, int] = (0, 0, 0)
    """Probes along x, y and z of the box that paths from the camera reach; 0 follows from the spacing."""
    spacing: float = 0.0
    """Metres between probes; 0 is a twelfth of the box's longest side, or as much more as keeps the number of probes to
    440, in rooms to 100, and to 128 if no camera is known."""
    resolution: int = 0
    """Texels along a side of a probe's map, a multiple of 16; 0 is 128 for up to 128 probes, 64 for more."""
    irradiance_resolution: int = 32
    """Texels along a side of a probe's map of irradiance; the paper has 32 to 128."""
    rays: int = 2
    """Rays a texel while baking."""
    bounces: int = 16
    """Largest number of passes of light from probes to probes; the first pass is light that was reflected once."""
    tolerance: float = 0.002
    """Relative change of the irradiance below which light bounces no more."""
    relocate: bool = True
    """Move probes out of walls, or away from them, by up to half the distance to the next probe."""
    weights: Literal["visibility", "trilinear"] = "visibility"
    """How the eight probes around a point are blended: "visibility" weighs those that see it; "trilinear" takes all as
    if they did, to compare with."""
    pixel_rays: int = 0
    """Rays a pixel in the modes "hybrid" and "traced", at least one for each camera sample; 0 is one for each of the
    pipeline's samples."""
    update: int = 8
    """Probes that are refreshed in each frame after the sky changed or something moved."""
    hysteresis: float = 0.5
    """Share of its old irradiance that a refreshed probe keeps."""
    primary: Literal["geometry", "probes"] = "geometry"
    """What the camera's rays are traced through: the scene ("geometry"), or the probes' maps ("probes"), which hold all
    light, not only indirect: then a bake is enough and no geometry is needed. "probes" needs a pipeline without other
    terms, as the preset "probe_view"."""

    def validate(self) -> None:
        """Raise OptionError for settings out of range."""
        for name, value, known in (
            ("mode", self.mode, _MODES),
            ("primary", self.primary, _PRIMARIES),
            ("through", self.through, _THROUGH),
            ("visibility", self.visibility, VISIBILITIES),
            ("weights", self.weights, _WEIGHTS),
        ):
            if value not in known:
                raise unknown_name(f"{name} of light field probes", value, known)
        block = int(field_kernels.BLOCK)
        for name, least, most in (
            ("resolution", block if self.resolution else 0, MOST_RESOLUTION),
            ("irradiance_resolution", 4, 128),
            ("rays", 1, 1024),
            ("bounces", 1, 1000),
            ("pixel_rays", 0, 1 << 20),
            ("update", 0, 1 << 20),
        ):
            check_whole(name, getattr(self, name), least, most)
        if self.resolution % block:
            raise OptionError(f"resolution must be a multiple of {block}, or 0 (automatic), got {self.resolution}")
        if not isinstance(self.counts, tuple | list) or len(self.counts) != 3:
            raise OptionError(f"counts must be three whole numbers, along x, y and z, got {self.counts!r}")
        for count in self.counts:
            check_whole("counts", count, 0, 1 << 20)
        if not (math.isfinite(self.spacing) and self.spacing >= 0):
            raise OptionError(f"spacing must be 0 (automatic) or metres above it, got {self.spacing}")
        if self.spacing and all(self.counts):
            raise OptionError("spacing and counts along every axis contradict each other; give one of them")
        if not 0 <= self.tolerance < 1:
            raise OptionError(f"tolerance must be a share of at least 0 and below 1, got {self.tolerance}")
        if not 0 <= self.hysteresis < 1:
            raise OptionError(f"hysteresis must be a share of at least 0 and below 1, got {self.hysteresis}")

    @property
    def probe_settings(self) -> ProbeSettings:
        """The settings that decide where probes stand and what they hold."""
        return ProbeSettings(**{field.name: getattr(self, field.name) for field in fields(ProbeSettings)})

    # ---- bake ----

    def bake_key(self, scene: Scene | BakedScene) -> str:
        """Return the hash of geometry, materials and lights. A changed sky needs no new bake: probes adapt to it.

        They adapt before the first frame, or, if the sky changes from frame to frame, over some frames.
        """
        return scene.contents_hash

    def bake_settings(self, scene: Scene | BakedScene) -> dict[str, Setting]:
        """Return the settings that decide the maps."""
        return self.probe_settings.stored()

    def bake(
        self,
        scene: Scene,
        device: str,
        seed: int = 0,
        progress: Callable[[float], None] | None = None,
        camera: Camera | CameraPath | None = None,
    ) -> Bake:
        """Return the probes' maps, for the scene's sky and its pose at time 0.

        The grid lies over what ``camera`` reaches on its whole path, or the scene's own cameras. The memory and time
        that the bake will take are logged before it starts (logger "warp_gi", level INFO).
        """
        state = ProbeState(scene, launch.get_device(device), self.probe_settings, seed, camera=camera)
        state.bake(scene, progress)
        return state.to_bake(scene)

    def start(self, scene: Scene | BakedScene, device: str, bake: Bake | None = None, seed: int = 0) -> ProbeState:
        """Return the state of probes that hold a bake, one made now if it is None.

        Under another sky than the bake's the probes are filled again.
        """
        if bake is None:
            bake = self.bake(whole_scene(scene), device, seed)
        state = ProbeState(scene, launch.get_device(device), self.probe_settings, seed, bake)
        if scene.triangle_count and not np.array_equal(bake.arrays["sky"], sky_bytes(scene)):
            state.fill(whole_scene(scene), lit_data(scene, state.device))
        state.key = _key(scene, 0.0)
        return state

    def check_view(self, bake: Bake, camera: Camera | CameraPath) -> None:
        """Warn if a bake was made for another camera path: where its probes see nothing, rays are traced.

        Raises BakeError for a bake by a version that did not place probes by cameras.
        """
        if "cameras" not in bake.arrays:
            raise BakeError(
                "this bake of probes is by an earlier version, whose rough surfaces were too bright: bake it again"
            )
        check_arrays(bake, self.probe_settings)
        made_for, wanted = known_rows(bake.arrays["cameras"]), camera_rows(cameras_of(camera))
        known = (
            np.abs(wanted[:, None] - made_for).max(axis=2)
            <= SAME_VIEW * np.maximum(np.abs(wanted).max(axis=1), 1)[:, None]
        )
        if not known.any(axis=1).all():
            warnings.warn(
                f"this bake of probes is {'of another camera path' if len(made_for) else 'of no camera'}: "
                "where too few of its probes see a surface, rays are traced, with noise: bake for this camera",
                stacklevel=2,
            )

    def fitting(self, bake: Bake) -> LightFieldProbes:
        """Return these settings with those that a bake depends on replaced by its own.

        Raises BakeError for a bake of another technique.
        """
        if bake.technique != "LightFieldProbes":
            raise BakeError(f"expected a bake of LightFieldProbes, got one of {bake.technique}")
        baked: dict[str, Any] = {**bake.settings}
        try:
            baked["counts"] = tuple(int(count) for count in baked["counts"].split("x"))
            fitting = replace(self, **baked)
        except (KeyError, TypeError, ValueError, AttributeError) as error:  # an OptionError is a ValueError
            raise BakeError(f"this bake has settings that probes cannot have ({error}); bake it again") from error
        return fitting

    # ---- frames ----

    @property
    def own_primary(self) -> Primary | None:
        """Camera rays through the probes, if ``primary`` is "probes"; else None."""
        return ProbeRays() if self.primary == "probes" else None

    def kernels(self, scene: Scene | BakedScene | None = None) -> tuple[wp.Kernel, ...]:
        """Return the kernels of light at surfaces."""
        return (trace_kernels.trace_probes,)

    def samplers(self, scene: Scene | BakedScene | None = None) -> tuple[Any, ...]:
        """Return the probes, as paths end in them."""
        return (light_field_cache.PROBE_CACHE,)

    def depends_on_past(self, scene: Scene | BakedScene, ahead: Ahead | None = None) -> bool:
        """Return whether frames may show probes that follow a sky or objects, and so what earlier frames refreshed."""
        return ahead is None or ahead.sky_changes or (self.update > 0 and scene.is_animated)

    def preprocess(self, frame: Frame, state: ProbeState) -> ProbeState:
        """Refresh some probes, if the sky or a pose is not what they saw."""
        key = _key(frame.scene, frame.time)
        if key != state.key:
            state = state.copied()
            state.key = key
            state.pending[:] = self.refreshes_to_settle
        if self.update and state.pending.any():
            state = state.copied(with_maps=True)
            probes = state.take_stale(self.update)
            scene = whole_scene(frame.scene)
            state.refresh(scene, lit_data(scene, state.device), probes)
        return state

    @property
    def refreshes_to_settle(self) -> int:
        """Number of refreshes of a probe until less than ``SETTLED`` of its old light is left, at least 4."""
        fading = math.ceil(math.log(SETTLED) / math.log(self.hysteresis)) if self.hysteresis > 0 else 1
        return max(fading, 4)

    def give(self, frame: Frame, state: ProbeState) -> None:
        """Let paths end in what probes know: the light that surfaces reflect, as irradiance."""
        cache = light_field_cache.ProbeCache()
        cache.field, cache.visibility = state.field, VISIBILITIES[self.visibility]
        frame.paths.use_cache(light_field_cache.PROBE_CACHE, cache)

    def trace(self, frame: Frame, state: ProbeState) -> None:
        """Add the light of the current camera sample."""
        settings = frame.pass_settings
        query = trace_kernels.ProbeQuery()
        query.mode, query.through = _MODES[self.mode], _THROUGH[self.through]
        query.visibility = VISIBILITIES[self.visibility]
        query.rays, query.first_ray, query.ray_bits = settings.sample_count, settings.first_sample, settings.sample_bits
        if self.pixel_rays:
            query.rays, query.first_ray, query.ray_bits = _evenly(self.pixel_rays, settings)
        unseen = query.rays, query.first_ray, query.ray_bits
        if (self.pixel_rays or frame.settings.spp) < UNSEEN_RAYS:
            unseen = _evenly(UNSEEN_RAYS, settings)
        query.unseen_rays, query.first_unseen_ray, query.unseen_ray_bits = unseen
        query.paths = path_settings(frame.scene)
        buffers = trace_kernels.ProbeBuffers()
        buffers.indirect = frame["indirect"]
        buffers.moment1, buffers.moment2 = frame.moments("indirect")
        if (lobes := frame.lobes()) is not None:
            buffers.diffuse, buffers.glossy = lobes.diffuse, lobes.glossy
        data = lit_data(frame.scene, state.device)
        inputs = [data, frame.camera_data, settings, state.field, query, frame.hits, buffers]
        frame.launch_tiled(trace_kernels.trace_probes, inputs)


@dataclass(frozen=True)
class ProbeRays(Primary):
    """Camera rays through light field probes, which hold all light: no geometry is needed (paper, Fig. 20)."""

    is_whole: ClassVar[bool] = True

    def trace(self, frame: Frame, state: ProbeState) -> None:
        """Fill the buffers by what camera rays meet in the probes."""
        buffers = frame.struct(trace_kernels.ProbeView)
        inputs = [frame.camera_data, frame.pass_settings, state.field, buffers]
        frame.launch_tiled(trace_kernels.view_probes, inputs)


def _evenly(rays: int, settings: gbuffer.PassSettings) -> tuple[int, int, int]:
    """Return a camera sample's share of a pixel's rays: their number, the first one, and the bits of all numbers."""
    each = -(-rays // settings.camera_samples)
    return each, settings.camera_sample * each, (each * settings.camera_samples - 1).bit_length()


def _key(scene: Scene | BakedScene, time: float) -> str:
    """Return what the light in the probes depends on beside geometry, materials and lights: the sky, and poses."""
    if isinstance(scene, BakedScene):
        return ""
    sky = "" if scene.environment is None else scene.environment.content_hash
    return sky + scene.shape_key(filter(scene.moves, range(len(scene.nodes))), time).tobytes().hex()
