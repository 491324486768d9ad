"""Light field probes on a device: where they stand, how they are filled, and which are out of date."""

from __future__ import annotations

import copy
import logging
import math
import time
from collections.abc import Callable

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.baking import Bake
from warp_gi.kernels import light_field as field_kernels
from warp_gi.kernels import light_field_bake as bake_kernels
from warp_gi.kernels import path_trace, types
from warp_gi.paths import sky_probability
from warp_gi.scene.baked import BakedScene, whole_scene
from warp_gi.scene.camera import Camera, CameraPath
from warp_gi.scene.scene import Scene
from warp_gi.techniques.light_field.arrays import check_arrays
from warp_gi.techniques.light_field.places import (
    ProbeGrid,
    place_grid,
    relocate,
)
from warp_gi.techniques.light_field.settings import ProbeSettings, map_resolution
from warp_gi.techniques.paths.estimators import BsdfPaths
from warp_gi.techniques.shared.lamps import lit_data
from warp_gi.techniques.shared.octahedral import unfolded
from warp_gi.techniques.shared.views import camera_rows, cameras_of

LIGHT_RESOLUTION, DISTANCE_RESOLUTION = 32, 64
"""Texels along a side of the smaller maps that irradiance and moments are filtered from; each is the mean over the
texels of the large map that it covers."""
SHARING_RESOLUTION, LAST_SHARING_RESOLUTION = 64, 128
"""Largest number of texels along a side of a map that look up irradiance for themselves, in all bounces but the last
and in the last; finer maps share one lookup among several texels."""
BIAS = 0.05
"""Distance that a point is moved off its surface before probes are asked whether they see it, as a share of the
smallest distance between probes."""
COVERED_SHARE = 0.5
"""Share of its directions that meet back faces above which a probe counts as inside of something."""
LEAST_SEEN = 0.25
"""Least share of the weights of the eight probes around a point that must come from probes that see it. With less, in
niches and under stairs, they know the light in front of it and not its own, which is then traced."""
BATCH_TEXELS = 1 << 20
"""Texels that are traced between two reports of progress."""
ANNOUNCED_TEXELS, TRIED_PROBES, TYPICAL_BOUNCES = 1 << 18, 8, 10
"""Texels from which on a bake says how long it takes; and the number of probes and of bounces that it reckons with."""
_WORK_BYTES = 9
"""Bytes of ProbeWork a texel, without emission."""
_log = logging.getLogger("warp_gi")


def low_directions(resolution: int) -> np.ndarray:
    """Return float32 [resolution^2, 4]: unit direction and solid angle [sr] of each texel of an octahedral map.

    A point p of the octahedron's face |x| + |y| + |z| = 1 seen from the centre: an area dA of the map (of side 2, so
    that the face lies over it with slope sqrt(3)) has dw = sqrt(3) dA cos / |p|^2 = dA / |p|^3, for the face's normal
    (1, 1, 1) / sqrt(3) makes the angle cos = 1 / (sqrt(3) |p|) with p.
    """
    at = (np.arange(resolution) + 0.5) / resolution
    p = unfolded(np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2))
    length = np.linalg.norm(p, axis=1, keepdims=True)
    return np.concatenate([p / length, (2 / resolution) ** 2 / length**3], axis=1).astype(np.float32)


class ProbeState:
    """Probes on a device, and how far they are behind the scene.

    ``bake``, ``fill``, ``refresh`` and ``take_stale`` change the state that they are called on, and are for a state
    that no frame has yet. A frame calls ``take_stale`` and ``refresh`` on its own copy (``copied``), so that the state
    of the last frame stays as it is. ``trace`` changes nothing.

    Args:
        scene: Scene that is rendered; a ``BakedScene`` needs a bake.
        device: Where probes are filled and asked.
        settings: What decides where probes stand and what they hold.
        seed: Seed of all rays.
        bake: Bake whose probes these are; None places them anew, and leaves them empty.
        camera: Camera around whose view probes are placed anew.
    """

    def __init__(
        self,
        scene: Scene | BakedScene,
        device: wp.Device,
        settings: ProbeSettings,
        seed: int,
        bake: Bake | None = None,
        camera: Camera | CameraPath | None = None,
    ) -> None:
        self.device, self.settings, self.seed, self.camera = device, settings, seed, camera
        if bake is None:
            self.grid = place_grid(whole_scene(scene), settings, camera, device)
            bounds = scene.bounds
        else:
            check_arrays(bake, settings)
            arrays = bake.arrays
            nx, ny, nz = (int(n) for n in arrays["grid_counts"])
            self.grid, bounds = ProbeGrid(arrays["grid_low"], arrays["grid_spacing"], (nx, ny, nz)), arrays["bounds"]
        self.resolution = map_resolution(settings.resolution, self.grid.probe_count)
        """Texels along a side of a probe's map."""
        self.changes: list[float] = []
        """Change of the irradiance by each bounce, as a share of it."""
        self.key = ""
        """Hash of the sky and bytes of the poses that the probes were last refreshed for."""
        self.refreshes = 0
        """Number of calls of ``refresh`` so far, which the seed of the next one depends on."""
        self.pending = np.zeros(self.grid.probe_count, np.int32)
        """int32 [probe]: refreshes that each probe still needs."""
        self._cursor = 0
        """Probe whose turn it is to be refreshed."""
        self.field = self._empty_field(bounds.astype(np.float64))
        """Maps and places of the probes as kernels read them."""
        if bake is not None:
            self._load(bake)

    def _empty_field(self, bounds: np.ndarray) -> field_kernels.LightField:
        grid, settings = self.grid, self.settings
        count, texels = grid.probe_count, self.resolution**2
        margin = 1e-3 * float(np.linalg.norm(bounds[1] - bounds[0]))
        field = field_kernels.LightField()
        field.low, field.spacing = wp.vec3(*grid.low), wp.vec3(*grid.spacing)
        field.counts = wp.vec3i(*grid.counts)
        field.resolution, field.irradiance_resolution = self.resolution, settings.irradiance_resolution
        field.bias = BIAS * float(grid.spacing.min())
        field.least_seen = LEAST_SEEN
        field.plain = int(settings.weights == "trilinear")
        field.bounds_low, field.bounds_high = wp.vec3(*(bounds[0] - margin)), wp.vec3(*(bounds[1] + margin))
        field.positions = self._array(grid.positions().astype(np.float32), wp.vec3)
        field.states = wp.zeros(count, dtype=wp.int32, device=self.device)
        for name, dtype, size in (
            ("radiance", wp.uint32, texels),
            ("surfels", wp.uint32, texels),
            ("nearest", wp.float32, (self.resolution // int(field_kernels.BLOCK)) ** 2),
            ("irradiance", wp.vec3, settings.irradiance_resolution**2),
            ("moments", wp.vec2, settings.irradiance_resolution**2),
        ):
            setattr(field, name, wp.zeros(count * size, dtype=dtype, device=self.device))
        field.emission_texels = wp.empty(0, dtype=wp.int32, device=self.device)
        field.emission = wp.empty(0, dtype=wp.uint32, device=self.device)
        return field

    def _array(self, values: np.ndarray, dtype: type) -> wp.array:
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)

    # ---- filling ----

    def bake(self, scene: Scene, progress: Callable[[float], None] | None = None) -> None:
        """Place all probes, and fill them."""
        data = lit_data(scene, self.device)
        if self.settings.relocate:
            relocate(scene, data, self.grid, self.field, self.device)
        self._announce(scene, data)
        self.fill(scene, data, progress)

    def _announce(self, scene: Scene, data: types.SceneData) -> None:
        """Log how many probes there are, and what filling them takes: memory, and seconds if it is not a moment."""
        count, texels = self.grid.probe_count, self.resolution**2
        memory = self.nbytes + count * texels * (_WORK_BYTES + 4 * (scene.emitter_count > 0))
        text = f"probes: {' x '.join(map(str, self.grid.counts))} of {self.resolution} x {self.resolution} texels, "
        text += f"{' x '.join(f'{step:.3g}' for step in self.grid.spacing)} m apart; {memory / 1e6:,.0f} MB"
        if count * texels > ANNOUNCED_TEXELS:
            text += f", about {max(self._seconds(scene, data), 1):.0f} s to bake"
        _log.info(text)

    def _seconds(self, scene: Scene, data: types.SceneData) -> float:
        """Return about how many seconds it takes to fill the probes, by filling some of them once."""
        few = np.unique(np.linspace(0, self.grid.probe_count - 1, TRIED_PROBES).astype(int))
        work = self._work(few, 1, scene, with_emission=False)
        seconds = []
        for step in (lambda: self._trace(data, work, few), lambda: self._bounce(work, len(few))):
            started, compiled = time.perf_counter(), launch.compile_seconds
            step()
            wp.synchronize_device(self.device)
            seconds.append(time.perf_counter() - started - (launch.compile_seconds - compiled))
        self.field.irradiance.zero_()
        all_of = self.grid.probe_count / len(few)
        return all_of * (seconds[0] * self.settings.rays + seconds[1] * min(TYPICAL_BOUNCES, self.settings.bounces))

    def fill(self, scene: Scene, data: types.SceneData, progress: Callable[[float], None] | None = None) -> None:
        """Trace all probes where they stand, and let light bounce between them until it changes no more."""
        settings, told = self.settings, progress or (lambda share: None)
        every = np.arange(self.grid.probe_count)
        work = self._work(every, settings.rays, scene, with_emission=scene.emitter_count > 0)
        self._trace(data, work, every, lambda share: told(0.8 * share))
        self._find_covered(work)
        before, self.changes = np.float64(0), []
        for number in range(settings.bounces):
            self._bounce(work, len(every))
            usable = self.field.states.numpy() == int(field_kernels.PROBE_USABLE)
            after = self.field.irradiance.numpy().reshape(self.grid.probe_count, -1)[usable].astype(np.float64)
            self.changes.append(float(np.abs(after - before).sum() / max(np.abs(after).sum(), 1e-30)))
            before = after
            told(0.8 + 0.2 * (number + 1) / settings.bounces)
            if self.changes[-1] <= settings.tolerance:
                break
        self._bounce(work, len(every), is_last=True)
        self._keep_emission(work)
        self.pending[:] = 0

    def refresh(self, scene: Scene, data: types.SceneData, probes: np.ndarray) -> None:
        """Trace some probes again, int [number], and blend what they gather into their irradiance."""
        work = self._work(probes, 1, scene, with_emission=scene.emitter_count > 0)
        self._trace(data, work, probes)
        self._find_covered(work)
        work.hysteresis = self.settings.hysteresis
        self._bounce(work, len(probes), is_last=True)
        self._keep_emission(work)
        self.refreshes += 1

    def copied(self, with_maps: bool = False) -> ProbeState:
        """Return a copy that ``take_stale`` may change, and ``refresh`` too if it gets maps of its own."""
        state = copy.copy(self)
        state.pending, state.field = self.pending.copy(), launch.copied(self.field, field_kernels.LightField)
        for name in field_kernels.LightField.vars if with_maps else ():
            value = getattr(self.field, name)
            if isinstance(value, wp.array):
                setattr(state.field, name, wp.clone(value))
        return state

    def take_stale(self, most: int) -> np.ndarray:
        """Return up to ``most`` probes that need a refresh, int64 [number], in turns, and count that as done."""
        stale = np.flatnonzero(self.pending)
        stale = np.concatenate([stale[stale >= self._cursor], stale[stale < self._cursor]])[:most]
        self.pending[stale] -= 1
        if len(stale):
            self._cursor = int(stale[-1]) + 1
        return np.sort(stale)

    def _launch(self, kernel: wp.Kernel, count: int, inputs: list[object]) -> None:
        launch.launch(kernel, count, inputs, self.device, smallest_slice=1)

    def _work(self, probes: np.ndarray, rays: int, scene: Scene, with_emission: bool) -> bake_kernels.ProbeWork:
        """Return buffers for tracing some probes, int [number], with so many rays a texel."""
        texels, count = self.resolution**2, len(probes)
        work = bake_kernels.ProbeWork()
        work.probes = self._array(probes.astype(np.int32), wp.int32)
        work.rays = rays
        work.seed = (self.seed * 0x9E3779B1 + self.refreshes * 0x85EBCA77 + 1) & 0xFFFFFFFF
        paths = path_settings(scene)
        for name in ("sky_probability", "max_depth", "roulette_depth"):
            setattr(work, name, getattr(paths, name))
        work.radius = float(field_kernels.MOMENT_REACH) * float(np.linalg.norm(self.grid.spacing))
        for name in ("direct", "albedo"):
            setattr(work, name, wp.empty(count * texels, dtype=wp.uint32, device=self.device))
        work.emission = wp.empty(count * texels * with_emission, dtype=wp.uint32, device=self.device)
        work.back = wp.empty(count * texels, dtype=wp.uint8, device=self.device)
        work.light_low = math.gcd(LIGHT_RESOLUTION, self.resolution)
        work.light_directions = self._array(low_directions(work.light_low), wp.vec4)
        work.light = wp.empty(count * work.light_low**2, dtype=wp.vec3, device=self.device)
        work.distance_low = math.gcd(DISTANCE_RESOLUTION, self.resolution)
        work.distance_directions = self._array(low_directions(work.distance_low), wp.vec4)
        work.distances = wp.empty(count * work.distance_low**2, dtype=wp.vec2, device=self.device)
        return work

    def _trace(
        self,
        data: types.SceneData,
        work: bake_kernels.ProbeWork,
        probes: np.ndarray,
        told: Callable[[float], None] = lambda share: None,
    ) -> None:
        """Trace the texels of some probes, int [number], and filter the distances that they find."""
        texels = self.resolution**2
        step = max(1, BATCH_TEXELS // texels)
        for start in range(0, len(probes), step):
            part = _part(work, start, min(start + step, len(probes)), texels)
            self._launch(bake_kernels.trace_texels, len(part.probes) * texels, [data, self.field, part])
            told((start + len(part.probes)) / len(probes))
        blocks = (self.resolution // int(field_kernels.BLOCK)) ** 2
        self._launch(bake_kernels.find_nearest, len(probes) * blocks, [self.field, work])
        self._launch(bake_kernels.reduce_distances, len(probes) * work.distance_low**2, [self.field, work])
        size = self.settings.irradiance_resolution**2
        self._launch(bake_kernels.filter_distances, len(probes) * size, [self.field, work])

    def _bounce(self, work: bake_kernels.ProbeWork, count: int, is_last: bool = False) -> None:
        """Let light bounce once, and set the radiance of all texels if it is for the last time."""
        work.is_last = int(is_last)
        shared = LAST_SHARING_RESOLUTION if is_last else SHARING_RESOLUTION
        scale = self.resolution // work.light_low
        side = math.gcd(scale, max(self.resolution // shared, 1))
        self._launch(bake_kernels.bounce, count * work.light_low**2, [self.field, work, side])
        size = self.settings.irradiance_resolution**2
        self._launch(bake_kernels.filter_light, count * size, [self.field, work])

    def _find_covered(self, work: bake_kernels.ProbeWork) -> None:
        """Leave out probes that mostly see back faces; if all probes do, the scene's faces are turned, and all stay."""
        probes = work.probes.numpy()
        back = (work.back.numpy() & int(bake_kernels.TEXEL_BACK)).reshape(len(probes), -1).mean(axis=1)
        states = self.field.states.numpy()
        states[probes] = np.where(
            back > COVERED_SHARE, int(field_kernels.PROBE_COVERED), int(field_kernels.PROBE_USABLE)
        )
        if (states == int(field_kernels.PROBE_COVERED)).all():
            states[:] = int(field_kernels.PROBE_USABLE)
        self.field.states = self._array(states, wp.int32)

    def _keep_emission(self, work: bake_kernels.ProbeWork) -> None:
        """Keep the radiance of texels that see an emitter, by their index."""
        if work.emission.shape[0] == 0:
            return
        probes, size = work.probes.numpy(), self.resolution**2
        found = work.emission.numpy()
        slots = np.flatnonzero(found)
        texels, emission = self.field.emission_texels.numpy(), self.field.emission.numpy()
        kept = ~np.isin(texels // size, probes)
        texels = np.concatenate([texels[kept], probes[slots // size].astype(np.int32) * size + slots % size])
        emission = np.concatenate([emission[kept], found[slots]])
        order = np.argsort(texels)
        self.field.emission_texels = self._array(texels[order].astype(np.int32), wp.int32)
        self.field.emission = self._array(emission[order], wp.uint32)

    # ---- bakes ----

    def to_bake(self, scene: Scene) -> Bake:
        """Return the probes of a scene as a bake."""
        field, settings = self.field, self.settings
        names = ("positions", "states", "radiance", "surfels", "irradiance", "moments", "emission_texels", "emission")
        arrays = {name: getattr(field, name).numpy().copy() for name in names}
        arrays |= {
            "grid_low": self.grid.low,
            "grid_spacing": self.grid.spacing,
            "grid_counts": np.array(self.grid.counts, np.int32),
            "bounds": scene.bounds,
            **({"offset": scene.offset} if scene.offset.any() else {}),
            "sky": sky_bytes(scene),
            "cameras": camera_rows(cameras_of(self.camera, every=True) or list(scene.cameras.values())),
        }
        counts = {
            "probes": self.grid.probe_count,
            "covered": int((arrays["states"] != 0).sum()),
            "rays": self.grid.probe_count * self.resolution**2 * settings.rays,
            "bytes": self.nbytes,
            **{f"change_{number + 1}": change for number, change in enumerate(self.changes)},
        }
        return Bake("LightFieldProbes", scene.contents_hash, settings.stored(), arrays, counts, scene.name)

    def _load(self, bake: Bake) -> None:
        """Take over what a bake holds."""
        field = self.field
        dtypes = {"positions": wp.vec3, "irradiance": wp.vec3, "moments": wp.vec2, "states": wp.int32}
        dtypes |= {"emission_texels": wp.int32, "radiance": wp.uint32, "surfels": wp.uint32, "emission": wp.uint32}
        for name, dtype in dtypes.items():
            setattr(field, name, self._array(bake.arrays[name], dtype))
        self.changes = bounce_changes(bake)
        work = bake_kernels.ProbeWork()
        work.probes = self._array(np.arange(self.grid.probe_count, dtype=np.int32), wp.int32)
        blocks = (self.resolution // int(field_kernels.BLOCK)) ** 2
        self._launch(bake_kernels.find_nearest, self.grid.probe_count * blocks, [field, work])

    @property
    def nbytes(self) -> int:
        """Bytes of all maps on the device."""
        field = self.field
        arrays = (field.radiance, field.surfels, field.nearest, field.irradiance, field.moments, field.emission)
        return sum(array.size * wp.types.type_size_in_bytes(array.dtype) for array in arrays)


def bounce_changes(bake: Bake) -> list[float]:
    """Return by how much each bounce changed the irradiance of probes, as a share of it; the first is 1."""
    count = sum(name.startswith("change_") for name in bake.counts)
    return [float(bake.counts.get(f"change_{number + 1}", 0.0)) for number in range(count)]


def path_settings(scene: Scene | BakedScene) -> path_trace.PathSettings:
    """Return the settings of paths that go on where probes know nothing: those of a default BsdfPaths."""
    defaults, paths = BsdfPaths(), path_trace.PathSettings()
    paths.max_depth, paths.roulette_depth = defaults.max_depth, defaults.roulette_depth
    paths.sky_probability = sky_probability(scene)
    return paths


def baked_resolution(bake: Bake) -> int:
    """Return the texels along a side of a probe's map in a bake."""
    return math.isqrt(len(bake.arrays["surfels"]) // len(bake.arrays["positions"]))


def sky_bytes(scene: Scene | BakedScene) -> np.ndarray:
    """Return the hash of the scene's sky, uint8 [32]; zeros if there is none."""
    if scene.environment is None:
        return np.zeros(32, np.uint8)
    return np.frombuffer(bytes.fromhex(scene.environment.content_hash), np.uint8)


def _part(work: bake_kernels.ProbeWork, start: int, stop: int, texels: int) -> bake_kernels.ProbeWork:
    """Return the work of slots ``start`` to ``stop`` - 1 alone, in the same memory."""
    part = launch.copied(work, bake_kernels.ProbeWork)
    part.probes = work.probes[start:stop]
    for name in ("direct", "albedo", "back", "emission"):
        array = getattr(work, name)
        if array.shape[0]:
            setattr(part, name, array[start * texels : stop * texels])
    return part
