"""Discrete visibility fields: direct light from the sky with most rays never traced (dvf.txt)."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.baking import Bake, Setting
from warp_gi.errors import OptionError, unknown_name
from warp_gi.estimator import Ahead, Estimator
from warp_gi.kernels import harmonics as harmonics_kernels
from warp_gi.kernels import visibility_field as field_kernels
from warp_gi.kernels import visibility_field_bake as bake_kernels
from warp_gi.kernels import visibility_field_trace as trace_kernels
from warp_gi.scene.baked import BakedScene, whole_scene
from warp_gi.scene.camera import Camera, CameraPath, views_hash
from warp_gi.stateful import Forecast
from warp_gi.techniques.visibility_field.bake import field_query, grid_of
from warp_gi.techniques.visibility_field.cost import TOLD_SECONDS, bake_seconds, traced_seconds
from warp_gi.techniques.visibility_field.settings import MaskSettings
from warp_gi.techniques.visibility_field.shards import merged
from warp_gi.techniques.visibility_field.state import (
    RAYS_A_MILLISECOND,
    FieldState,
    cells_on_path,
    corners_of,
    stored_settings,
)

if TYPE_CHECKING:
    from warp_gi.frame import Frame
    from warp_gi.scene.scene import Scene

_MODES = {
    "three_state": field_kernels.MODE_THREE_STATE,
    "unbiased": field_kernels.MODE_UNBIASED,
    "paper": field_kernels.MODE_PAPER,
    "traced": field_kernels.MODE_THREE_STATE,  # without cells every ray is unknown, and traced
}
_SKIES = ("map", "harmonics")
COSINE_SETS = 32
"""Sets of cosine-weighted directions in a frame; each is turned about the normal at random, so few sets will do, and
few stay in the processor's first cache."""
MOST_SET_SIZE = 4096
"""Largest number of directions in a set."""
MOST_SET_SAMPLES = 1 << 16
"""Largest number of sky samples in all sets of a frame, unless there are only 16 sets."""
MOST_RESOLUTION = 512
"""Largest number of texels along a side of a cell's masks."""


@dataclass(frozen=True)
class VisibilityField(Estimator):
    """Direct light from the sky, where a baked grid of octahedral masks answers for most rays.

    Biased by what the bake missed, except in the mode "unbiased". The bake depends on the geometry alone: any sky,
    turning or changing, needs no new one. (Xu et al., "Precomputed Discrete Visibility Fields for Real-Time
    Ray-Traced Environment Lighting"; the modes beside "paper" are this library's.)
    """

    term: ClassVar[str] = "environment"

    mode: Literal["three_state", "unbiased", "paper", "traced"] = "three_state"
    """Which rays are traced: "three_state" traces those that the cell calls mixed or unknown; "unbiased" traces a share
    of the other rays too, and corrects for what that finds; "paper" is the paper's one-sided test with labels, and
    needs sky "harmonics"; "traced" traces every ray without any bake, to compare with."""
    sky: Literal["map", "harmonics"] = "map"
    """How the sky is read: "map" samples it as it is, by the BSDF and by its radiance; "harmonics" keeps only its low
    frequencies, in nine coefficients a channel."""
    cell_size: float = 0.0
    """Edge of a cell in metres; 0 is a 77th of the scene's longest axis, as in the paper's Sponza."""
    resolution: int = 84
    """Texels along a side of a cell's masks; the paper has 18."""
    samples: int = 0
    """Surface samples over the whole scene, by area; 0 is 256 for each side of as much surface as a face of a cell."""
    rays: int = 512
    """Rays of a surface sample, rounded up to a multiple of 8; the paper has 128."""
    dilation: int = 1
    """Texels by which the masks of a cell are dilated."""
    verify: float = 0.1
    """Share of the rays that a cell calls visible or occluded which the mode "unbiased" traces all the same."""
    lazy: bool = True
    """Bake only cells that the camera path sees, and others as they come into view; else all before the first frame."""
    budget: float = 100.0
    """Milliseconds a frame for baking cells that come into view, reckoned at 20,000 rays a millisecond on every
    machine, so that pictures do not depend on its speed. 0 bakes none."""
    relight: bool = False
    """Keep what each pixel transfers of every harmonic, and trace nothing while camera and scene stand still and only
    the sky changes; needs sky "harmonics", and 108 bytes a pixel."""

    def validate(self) -> None:
        """Raise OptionError for settings out of range."""
        if self.mode not in _MODES:
            raise unknown_name("mode of a visibility field", self.mode, _MODES)
        if self.sky not in _SKIES:
            raise unknown_name("sky of a visibility field", self.sky, _SKIES)
        if self.mode == "paper" and self.sky != "harmonics":
            raise OptionError('mode "paper" subtracts from the irradiance of harmonics; set sky to "harmonics" too')
        if self.relight and self.sky != "harmonics":
            raise OptionError('relight needs a low-frequency sky; set sky to "harmonics" too')
        for name, least, most in (
            ("resolution", 4, MOST_RESOLUTION),
            ("samples", 0, 1 << 30),
            ("rays", 1, MOST_SET_SIZE),
            ("dilation", 0, 8),
        ):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or not least <= value <= most:
                raise OptionError(f"{name} must be a whole number from {least} to {most}, got {value!r}")
        if 2 * self.dilation + 2 > self.resolution:
            raise OptionError(f"dilation must be below half of the resolution {self.resolution}, got {self.dilation}")
        if not (math.isfinite(self.cell_size) and self.cell_size >= 0):
            raise OptionError(f"cell_size must be 0 (automatic) or metres above it, got {self.cell_size}")
        if not 0 < self.verify <= 1:
            raise OptionError(f"verify must be a share above 0 and at most 1, got {self.verify}")
        if not (math.isfinite(self.budget) and self.budget >= 0):
            raise OptionError(f"budget must be milliseconds of at least 0, got {self.budget}")

    @property
    def uses_cells(self) -> bool:
        """Whether cells are baked and looked up; the mode "traced" traces every ray without any."""
        return self.mode != "traced"

    @property
    def mask_settings(self) -> MaskSettings:
        """The settings that decide the masks."""
        whole = {name: int(getattr(self, name)) for name in ("resolution", "samples", "rays", "dilation")}
        return MaskSettings(cell_size=self.cell_size, **whole)

    # ---- bake ----

    def bake_key(self, scene: Scene | BakedScene) -> str:
        """Return the hash of the geometry: nothing else decides visibility."""
        return whole_scene(scene).geometry_hash

    def bake_settings(self, scene: Scene | BakedScene) -> dict[str, Setting]:
        """Return the settings that decide the masks, with the cell size in metres."""
        settings = self.mask_settings
        return stored_settings(settings, grid_of(scene.bounds, settings.cell_size))

    def bake_identity(self, scene: Scene | BakedScene, camera: Camera | CameraPath | None = None) -> str:
        """Return the hash of the geometry, and of the views if only cells that they see are baked."""
        return f"{self.bake_key(scene)} {views_hash(camera) if self.lazy else 'everywhere'}"

    def forecast(
        self, scene: Scene, device: wp.Device, seed: int, camera: Camera | CameraPath, samples: int
    ) -> Forecast | None:
        """Return the cost of all cells from that of some, and the time of the rays that a frame traces without them.

        A sky that is a map takes two rays a sample, a constant one the BSDF's alone. A field saves less: rays that its
        cells do not decide are traced, and looking others up takes time, too.
        """
        if not self.uses_cells:
            return None
        seconds = bake_seconds(scene, device, self.mask_settings, seed, camera if self.lazy else None)
        if seconds < TOLD_SECONDS:
            return None
        sky, view = scene.environment, camera.camera(0) if isinstance(camera, CameraPath) else camera
        rays = 0 if sky is None or sky.is_black else 1 if sky.pixels is None else 2
        return Forecast(seconds, traced_seconds(scene, device, view, float(rays * samples), seed))

    def bake(
        self,
        scene: Scene,
        device: str,
        seed: int = 0,
        progress: Callable[[float], None] | None = None,
        camera: Camera | CameraPath | None = None,
    ) -> Bake | None:
        """Return the masks of all cells, or, when ``lazy`` and there is a camera, of those that it sees."""
        return self._baked(scene, device, seed, None, progress, camera)

    def bake_shard(
        self,
        scene: Scene,
        device: str,
        seed: int,
        shard: tuple[int, int],
        progress: Callable[[float], None] | None = None,
        camera: Camera | CameraPath | None = None,
    ) -> Bake | None:
        """Return the masks of every N-th of the cells that ``bake`` would look at, beginning with the shard's own."""
        number, count = shard
        return self._baked(scene, device, seed, slice(number - 1, None, count), progress, camera)

    def _baked(
        self,
        scene: Scene,
        device: str,
        seed: int,
        part: slice | None,
        progress: Callable[[float], None] | None,
        camera: Camera | CameraPath | None,
    ) -> Bake | None:
        """Return the masks of the cells to look at, or of a part of them; None if no cells are used."""
        if not self.uses_cells:
            return None
        state = FieldState(scene, launch.get_device(device), self.mask_settings, seed)
        cells = cells_on_path(state, camera) if self.lazy and camera is not None else None
        if part is not None:
            cells = (np.arange(state.grid.cell_count, dtype=np.int32) if cells is None else cells)[part]
        state.bake(cells, progress)
        return state.to_bake()

    @classmethod
    def merge_shards(cls, shards: Sequence[Bake]) -> Bake:
        """Return the masks of the cells of all shards. Raises BakeError for shards of other cells."""
        return merged(shards)

    def start(self, scene: Scene | BakedScene, device: str, bake: Bake | None = None, seed: int = 0) -> FieldState:
        """Return the state of a field with the masks of a bake."""
        scene, target = whole_scene(scene), launch.get_device(device)
        if bake is None:
            return FieldState(scene, target, self.mask_settings, seed)
        return FieldState.from_bake(scene, target, self.mask_settings, seed, bake)

    # ---- frames ----

    def kernels(self, scene: Scene | BakedScene | None = None) -> tuple[wp.Kernel, ...]:
        """Return the kernels of cells and of their light."""
        return (
            bake_kernels.find_cells,
            trace_kernels.trace_field,
        )

    @property
    def saves_state(self) -> bool:
        """Whether a saved state holds all that frames before left. Transfers, 108 bytes a pixel, are not saved."""
        return not self.relight

    @property
    def _grows(self) -> bool:
        return self.uses_cells and self.lazy and self.budget > 0

    def depends_on_past(self, scene: Scene | BakedScene, ahead: Ahead | None = None) -> bool:
        """Return whether a frame may use cells that earlier frames baked, or transfers that they kept.

        No cells are baked on the way if nothing moves and all cells that the frames ahead see are known.
        """
        if self.relight or not self._grows:
            return self.relight
        if ahead is None or ahead.state is None:
            return True
        return bool(whole_scene(scene).moving_objects) or ahead.state.lacks(ahead.views)

    def preprocess(self, frame: Frame, state: FieldState) -> FieldState:
        """Return the state for this frame: new cells within the budget, samples, the sky, and boxes of movers."""
        state = state.copied()
        state.query = self._query(frame)
        state.sky = self._sky(frame)
        if self.uses_cells:
            self._bake_in_view(frame, state)
        else:
            state.upload_nothing()
        if self.relight and not _is_black(frame.scene):
            key = self._relight_key(frame, state)
            state.relights = state.transfer_key == key
            if not state.relights:
                width, height = frame.camera.resolution
                state.transfer = wp.zeros(27 * width * height, dtype=wp.float32, device=frame.device)
                state.transfer_key = key
        return state

    def _bake_in_view(self, frame: Frame, state: FieldState) -> None:
        """Bake cells that the camera sees, within the budget, in a state that is this frame's own."""
        state.move(frame.time)
        most_rays = self.budget * RAYS_A_MILLISECOND
        if self._grows:
            cells = state.cells_in_view(frame.camera, corners_of(frame.index))
            state.bake(cells, None, most_rays)
            if state.movers and state.is_still:
                state.bake_settled(cells, most_rays)
        state.upload()

    def _query(self, frame: Frame) -> field_kernels.FieldQuery:
        size = min(-(-frame.settings.spp // 8) * 8, MOST_SET_SIZE)
        query = field_query(frame.device, size, COSINE_SETS, frame.seed)
        query.mode, query.verify = _MODES[self.mode], self.verify
        return query

    def _sky(self, frame: Frame) -> trace_kernels.FieldSky:
        environment, sky = frame.scene.environment, trace_kernels.FieldSky()
        sky.set_size, sky.set_count = 1, 1
        if environment is None or environment.is_black:
            sky.kind = trace_kernels.SKY_CONSTANT
        elif self.sky == "harmonics":
            sky.kind = trace_kernels.SKY_HARMONIC
            sky.harmonics = harmonics_kernels.Harmonics(*environment.harmonics.reshape(-1))
        elif environment.pixels is None:
            sky.kind = trace_kernels.SKY_CONSTANT
            sky.radiance = wp.vec3(*environment.mean_radiance)
        else:
            sky.kind = trace_kernels.SKY_MAP
            sky.set_size = min(-(-frame.settings.spp // 8) * 8, MOST_SET_SIZE)
            sky.set_count = _set_count(sky.set_size)
            count = sky.set_size * sky.set_count
            sky.directions = wp.empty(count, dtype=wp.vec3, device=frame.device)
            sky.radiances = wp.empty(count, dtype=wp.vec3, device=frame.device)
            sky.pdfs = wp.empty(count, dtype=wp.float32, device=frame.device)
            frame.launch(trace_kernels.sample_sky, [frame.data, frame.seed, sky], count)
        return sky

    def trace(self, frame: Frame, state: FieldState) -> None:
        """Add the light of the current camera sample; where transfers are known, the first one adds that of all."""
        if _is_black(frame.scene):
            return
        if self.relight and state.relights:
            if frame.pass_settings.camera_sample == 0:
                frame.launch(trace_kernels.relight, [state.sky.harmonics, state.transfer, frame["environment"]])
            return
        transfer = state.transfer if self.relight else wp.empty(0, dtype=wp.float32, device=frame.device)
        buffers = trace_kernels.FieldBuffers()
        buffers.environment, buffers.transfer = frame["environment"], transfer
        buffers.moment1, buffers.moment2 = frame.moments("environment")
        field = trace_kernels.Field()
        field.grid, field.query, field.sky = state.data, state.query, state.sky
        inputs = [frame.data, frame.camera_data, frame.pass_settings, field, frame.hits, buffers]
        frame.launch_tiled(trace_kernels.trace_field, inputs)

    def _relight_key(self, frame: Frame, state: FieldState) -> tuple[object, ...]:
        poses = b"" if state.poses is None else state.poses.tobytes()
        camera = frame.camera
        surfaces = frame.scene.contents_hash  # an edit changes albedo or normals
        return surfaces, camera.world_from_camera.tobytes(), camera.lens, poses, len(state.cells)


def _is_black(scene: Scene | BakedScene) -> bool:
    return scene.environment is None or scene.environment.is_black


def _set_count(size: int) -> int:
    """Return how many sets of ``size`` sky samples a frame draws, a power of two."""
    return 1 << max(min(MOST_SET_SAMPLES // size, 256), 16).bit_length() - 1
