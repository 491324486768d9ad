"""Light maps: the irradiance at each texel of an atlas, gathered by paths that end in a surface cache."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.baking import Bake
from warp_gi.errors import OptionError, SceneError, check_whole, unknown_name
from warp_gi.kernels import path_samplers, path_trace
from warp_gi.kernels import surface_cache_lightmap as kernels
from warp_gi.kernels.light_hierarchy import LightTree
from warp_gi.kernels.surface_cache import SurfaceCells
from warp_gi.launch import on_device
from warp_gi.paths import sky_probability
from warp_gi.scene.scene import Scene
from warp_gi.techniques.bake_tool import ExportSettings
from warp_gi.techniques.light_hierarchy.estimator import first_tree
from warp_gi.techniques.paths.estimators import BsdfPaths
from warp_gi.techniques.shared.atlas.atlas import Atlas, page_coordinates
from warp_gi.techniques.shared.atlas.build import NO_SURFACE, make_atlas
from warp_gi.techniques.shared.atlas.buried import looks_of_slots, off_edges, stand_ins
from warp_gi.techniques.shared.atlas.densities import parse_texel_sets
from warp_gi.techniques.shared.atlas.padding import padded
from warp_gi.techniques.shared.atlas.texels import covered_texels
from warp_gi.techniques.shared.lamps import lit_data
from warp_gi.techniques.surface_cache.cache import SurfaceCache, check_still

SIDE = int(kernels.SIDE)
"""Places along a side of a texel at which its light is gathered."""
OFF_PLACE = 0.01
"""Largest distance of a point from its place, in texels of ``SIDE`` a texel, for it to lie on the surface there."""
LOOKS = 16
"""Rays of a texel that tell whether it lies inside of something."""
INSIDE = 0.5
"""Share of them that meet backs of closed objects, above which a texel that none stands in for is known to nobody."""
BATCH = 1 << 14
"""Texels between two reports of progress."""
ATLAS_SHARE = 0.3
"""Share of the work that is done when there is an atlas, for progress alone."""

Progress = Callable[[float], None]
"""Called with the share of the work that is done."""


@dataclass(frozen=True)
class LightMapSettings(ExportSettings):
    """What decides a light map, beside the cells in which its paths end."""

    resolution: int = 1024
    """Texels along the longer side of the light map; charts leave a few columns or rows unused."""
    texel_sets: str = "auto"
    """Densities of the light map's texels: "auto" gives small parts more, "one" is one density for all,
    "NAME=FACTOR,..." is a factor by name of node or mesh."""
    charts: Literal["auto", "xatlas", "own"] = "auto"
    """Where the light map's coordinates come from: "auto" takes a mesh's own where they do not overlap, "xatlas" makes
    all, "own" makes none."""
    chart_seconds: float = 600.0
    """Seconds that making charts may take; 0 is no limit."""
    samples: int = 64
    """Paths from each texel of the light map. Twice as many have 0.7 times the noise."""

    def validate(self) -> None:
        """Raise OptionError for settings out of range."""
        if self.charts not in ("auto", "xatlas", "own"):
            raise unknown_name("charts", self.charts, ("auto", "xatlas", "own"))
        parse_texel_sets(self.texel_sets)
        check_whole("resolution", self.resolution, 16, 16384)
        check_whole("samples", self.samples, 1, 1 << 20)
        if not (np.isfinite(self.chart_seconds) and self.chart_seconds >= 0):
            raise OptionError(f"chart_seconds must be a finite number that is not negative, got {self.chart_seconds!r}")


@dataclass(frozen=True, eq=False)
class LightMap:
    """Irradiance at the texels of an atlas."""

    atlas: Atlas
    """Where the texels are on surfaces: one page, of whose slots the first are those of the fronts."""
    irradiance: np.ndarray
    """Irradiance on the front of each slot by all light, W/m^2, float32 [front slots, 3]."""
    is_known: np.ndarray
    """Whether the slot is not buried inside of something, bool [front slots]."""

    @property
    def size(self) -> tuple[int, int]:
        """Width and height in texels."""
        return int(self.atlas.pages[0, 1]), int(self.atlas.pages[0, 2])

    def image(self) -> np.ndarray:
        """Return the map as a picture, float32 [height, width, 3], row 0 at v = 0 of glTF; no texel of it is empty."""
        width, height = self.size
        slots = self.atlas.slots[0, : width * height].reshape(height, width)
        known = (slots >= 0) & self.is_known[np.maximum(slots, 0)]
        light = np.where(known[..., None], self.irradiance[np.maximum(slots, 0)], np.float32(0))
        return padded(light, known)

    def at(self, faces: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return the irradiance at points of faces, filtered bilinearly as engines do, W/m^2, float64 [point, 3].

        ``faces`` int [point] are those of the scene, ``u`` and ``v`` [point] barycentric. It is 0 on faces without
        texels.
        """
        image, last = self.image().astype(np.float64), np.array(self.size) - 1
        pages, uvs = page_coordinates(self.atlas, faces, u, v)
        at = np.clip(uvs * self.size - 0.5, 0, last)
        low = at.astype(np.int64)
        (x, y), (i, j) = (at - low).T[..., None], np.minimum(low + 1, last).T
        top = image[low[:, 1], low[:, 0]] * (1 - x) + image[low[:, 1], i] * x
        below = image[j, low[:, 0]] * (1 - x) + image[j, i] * x
        return np.where((pages >= 0)[:, None], top * (1 - y) + below * y, 0.0)


def bake_light_map(
    scene: Scene,
    bake: Bake,
    cache: SurfaceCache,
    settings: LightMapSettings,
    device: str = "cpu",
    seed: int = 1,
    progress: Progress | None = None,
) -> LightMap:
    """Return the irradiance that arrives at the fronts of all surfaces, from lamps, sky and other surfaces.

    Texels inside of other objects have the light of those nearby. Emission of a surface itself is not in its texels.

    Args:
        scene: The scene, in which nothing moves.
        bake: Cells of it, a bake for ``cache``.
        cache: Settings of the surface cache.
        settings: Texels, and paths from each.
        device: Where kernels run.
        seed: Decides all random numbers. One seed gives one result, whatever the number of threads.
        progress: Called with the share that is done.

    Raises OptionError where charts fail, SceneError for a scene that moves or has no surface, BakeError for a bake of
    another technique or scene.
    """
    check_still(scene)
    bake.check(type(cache).__name__, cache.bake_key(scene), cache.bake_settings(scene))
    target, tell = launch.get_device(device), progress or (lambda share: None)
    cells = cache.start(scene, device, bake, seed).cells
    with scene.lock:
        scene.check_unchanged()
        atlas = make_atlas(scene, settings, device, lambda share: tell(ATLAS_SHARE * share))
        fronts = int(np.count_nonzero(atlas.slot_sides == 0))
        if fronts == 0:
            raise SceneError(NO_SURFACE)
        data, slots = lit_data(scene, target), atlas.slots_on(target)
        samplers = _samplers(scene, cells, target)
        inside, backs = looks_of_slots(data, atlas, slots, LOOKS, target)
        places = _places(atlas, fronts, settings.samples, seed, target)
        light = wp.zeros(fronts, dtype=wp.vec3, device=target)
        for start in range(0, fronts, BATCH):
            inputs = [start, data, samplers, _paths(scene), places, light]
            launch.launch(kernels.gather_light, min(BATCH, fronts - start), inputs, target, smallest_slice=16)
            tell(ATLAS_SHARE + (1.0 - ATLAS_SHARE) * min(start + BATCH, fronts) / fronts)
        irradiance = light.numpy()
        dark = np.zeros(atlas.count, bool)
        dark[:fronts] = (irradiance == 0).all(axis=1)
        stands_in = stand_ins(data, atlas, slots, inside, backs, target, dark)[:fronts]
    is_known = (inside[:fronts] <= INSIDE) | (stands_in != np.arange(fronts))
    return LightMap(atlas, irradiance[stands_in], is_known)


def _samplers(scene: Scene, cells: SurfaceCells, device: wp.Device) -> kernels.LightMapSamplers:
    samplers, tree = kernels.LightMapSamplers(), first_tree(scene, device)
    samplers.lights = LightTree() if tree is None else tree.data
    samplers.directions = path_samplers.BsdfDirections()
    samplers.regions, samplers.sky = path_samplers.NoRegions(), path_samplers.SceneSky()
    samplers.cache = cells
    return samplers


def _paths(scene: Scene) -> path_trace.PathSettings:
    paths, like = path_trace.PathSettings(), BsdfPaths()
    paths.terms = int(path_trace.TERM_ENVIRONMENT) | int(path_trace.TERM_EMITTERS) | int(path_trace.TERM_INDIRECT)
    paths.max_depth, paths.roulette_depth = like.max_depth, like.roulette_depth
    paths.sky_probability, paths.spp = sky_probability(scene), 1
    paths.cache_vertex = int(path_trace.CACHE_VERTEX)
    return paths


def _places(atlas: Atlas, fronts: int, samples: int, seed: int, device: wp.Device) -> kernels.LightMapPlaces:
    """Return the places of the slots of fronts: middles of ``SIDE`` x ``SIDE`` parts of a texel that lie on its chart.

    A slot without any is its own place: it is a texel that bilinear fetches alone touch.
    """
    width, height = atlas.pages[0, 1:].tolist()
    corners = atlas.corners * np.float32(SIDE)
    found = covered_texels(corners, atlas.face_pages, np.array([[0, SIDE * width, SIDE * height]], np.int32), device)
    y, x = np.divmod(found.texels, SIDE * width)
    u, v = found.points.T
    at = (corners[found.faces] * np.stack([1.0 - u - v, u, v], axis=1)[..., None]).sum(axis=1)
    owner = atlas.slots[0, y // SIDE * width + x // SIDE]
    is_on = (np.abs(at - np.stack([x + 0.5, y + 0.5], axis=1)) < OFF_PLACE).all(axis=1) & (owner >= 0)
    is_on &= atlas.charts[found.faces] == atlas.charts[atlas.slot_faces[np.maximum(owner, 0)]]
    kept = np.flatnonzero(is_on)
    owner, faces = owner[kept], found.faces[kept]
    points = off_edges(atlas.corners[faces].astype(np.float64), found.points[kept].astype(np.float64))
    alone = np.setdiff1d(np.arange(fronts), owner)
    owner = np.concatenate([owner, alone])
    order = np.argsort(owner, kind="stable")
    places = kernels.LightMapPlaces()
    places.faces = on_device(np.concatenate([faces, atlas.slot_faces[alone]])[order], wp.int32, device)
    places.points = on_device(np.concatenate([points, atlas.slot_points[alone]])[order], wp.vec2, device)
    starts = np.append(0, np.cumsum(np.bincount(owner, minlength=fronts))).astype(np.int32)
    places.starts = on_device(starts, wp.int32, device)
    places.samples, places.seed = samples, seed & 0xFFFFFFFF
    return places
