"""Direct light from emitters that were seen lately: the visibility light cache (temporal_reuse.txt, section 4)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.alias import AliasTable
from warp_gi.errors import OptionError, check_whole, unknown_name
from warp_gi.estimator import Estimator
from warp_gi.kernels import light_cache, light_cache_build, light_cache_native
from warp_gi.kernels.reuse_gains import sum_gains
from warp_gi.scene.baked import BakedScene, whole_scene
from warp_gi.scene.emitters import PlacedEmitters
from warp_gi.techniques.light_hierarchy.estimator import (
    LightHierarchy,
    TreeState,
    first_tree,
    has_choice,
    moved_tree,
)
from warp_gi.techniques.reuse.rest import CACHE_COST, Rest, rest_after, wish_for_lesson, woken_by
from warp_gi.techniques.reuse.sample_octree import Lesson, SampleOctree, running_sums
from warp_gi.techniques.reuse.saved import cache_fault
from warp_gi.techniques.shared.ltc import ltc_table

if TYPE_CHECKING:
    from warp_gi.baking import Bake
    from warp_gi.frame import Frame
    from warp_gi.scene.camera import Camera
    from warp_gi.scene.scene import Scene
    from warp_gi.stateful import Service

EXPLORES_BY = ("hierarchy", "table")
LEAST_EXPLORATION, MOST_EXPLORATION = 0.05, 0.75
"""Range of the probability of exploring that a region learns."""
MOVING_EXPLORATION = 0.3
"""Least probability of exploring in a frame in which lights move."""
MOST_EMITTERS = 1 << 23
"""Largest number of emitters, as entries of lists have 23 bits for them."""


@dataclass(frozen=True)
class VisibilityLightCache(Estimator):
    """Direct light from emitters; each region samples those that it or a neighbouring region saw lately.

    A light is selected in proportion to the light that it would reflect at the very point, by the closed-form cosine
    integral of its triangle and linearly transformed cosines for GGX, times the share of samples in which it was seen.
    With some probability another light is explored. Where a region's points see more lights than its cache can hold,
    as under a wall of thousands of equal ones, it learns that selecting by the hierarchy alone varies less, and does
    so. Every path vertex uses the cache. Unbiased.
    """

    term: ClassVar[str] = "emitters"

    capacity: int = 32
    """Largest number of lights in a bucket, 1 to 32. A region with more lights has more buckets, and each sample
    weighs the lights of one bucket."""
    exploration: float = 0.1
    """Probability in (0, 1) of exploring another light. With ``adapts_exploration`` it is only the initial value, which
    is raised to 0.3 in frames where lights move."""
    adapts_exploration: bool = True
    """Whether each region learns that probability, from 0.05 to 0.75, by the part that explored lights have in the
    second moment of its samples; and explores only, without samples of the cache, where that varies less."""
    memory: int = 8
    """Number of frames that a light stays in a region after it was last seen, 0 to 200."""
    explores_by: Literal["hierarchy", "table"] = "hierarchy"
    """How a light to explore is drawn: by the "hierarchy" over all lights, or from a "table" made of the three weights
    below, as in the paper, the same at every point."""
    energy: float = 1.0
    """Weight of a light's power in the table."""
    change: float = 1.0
    """Weight in the table of the distance that a light moved since the last frame, times its power."""
    distance: float = 1.0
    """Weight in the table of a light's nearness to the camera."""
    samples: int = 2048
    """Largest number of samples that a region learns from in a frame."""
    rests: bool = True
    """Whether frames leave the choice to ``LightHierarchy``, record nothing and learn nothing, while that has less
    variance for its time; a frame in 8, then in 16, ... 128 tries again. False: every frame uses the cache."""

    def validate(self) -> None:
        """Raise OptionError for settings out of range."""
        for name, least, most in (
            ("capacity", 1, light_cache_native.CAPACITY),
            ("memory", 0, 200),
            ("samples", 1, 1 << 24),
        ):
            check_whole(name, getattr(self, name), least, most)
        if not 0.0 < self.exploration < 1.0:
            raise OptionError(f"exploration must be above 0 and below 1, got {self.exploration}")
        if self.explores_by not in EXPLORES_BY:
            raise unknown_name("way to explore", self.explores_by, EXPLORES_BY)
        weights = (self.energy, self.change, self.distance)
        if not (min(weights) >= 0.0 and max(self.energy, self.distance) > 0.0 and np.isfinite(weights).all()):
            raise OptionError(
                f"energy, change and distance must not be negative, and energy or distance above 0, got {weights}"
            )

    @property
    def services(self) -> tuple[Service, ...]:
        """The octree of regions, which also sorts a frame's samples by region."""
        return (SampleOctree(),)

    def kernels(self, scene: Scene | BakedScene | None = None) -> tuple[wp.Kernel, ...]:
        """Return the kernels of lights' shapes, and of learning."""
        gains = (sum_gains,) if self.rests else ()
        return (light_cache.shape_lights, light_cache_build.rank_lights, *gains)

    def samplers(self, scene: Scene | BakedScene | None = None) -> tuple[Any, ...]:
        """Return the cached lights; nothing for a scene without emitters."""
        return (light_cache.CACHED_LIGHTS,) if scene is None or scene.emitter_count else ()

    @property
    def saves_state(self) -> bool:
        """True: the caches hold all that earlier frames left."""
        return True

    def bake_key(self, scene: Scene | BakedScene) -> str:
        """Return a hash of all but the sky."""
        return scene.contents_hash

    def start(
        self, scene: Scene | BakedScene, device: str, bake: Bake | None = None, seed: int = 0
    ) -> CacheState | None:
        """Return empty caches for the eight leaves of the first octree."""
        if scene.emitter_count > MOST_EMITTERS:
            raise OptionError(
                f"VisibilityLightCache takes up to {MOST_EMITTERS:,} emitters, {scene.name} has "
                f"{scene.emitter_count:,}; use LightHierarchy"
            )
        scene, target = whole_scene(scene), launch.get_device(device)
        tree = first_tree(scene, target)
        if tree is None:
            return None
        places, areas = _places(scene.placed_emitters(target))
        radiances = scene.emitter_powers() / (np.pi * np.maximum(areas, 1e-30)) * (areas > 0)
        luminances = launch.on_device(radiances.astype(np.float32), wp.float32, target)
        return CacheState(self._tables(8, target), _lists(8, target), places, tree, luminances)

    def preprocess(self, frame: Frame, state: CacheState | None) -> CacheState | None:
        """Return the state with the shapes and tree of this frame's lights, and let paths sample from the cache."""
        if state is None:
            return None
        scene, device = whole_scene(frame.scene), frame.device
        emitters = frame.data.emitters
        moved = np.zeros(scene.emitter_count)
        if state.shapes is None or scene.is_animated:
            places, _ = _places(scene.placed_emitters(device))
            moved = np.linalg.norm(places - state.places, axis=1)
            shapes = wp.empty(len(places), dtype=light_cache_native.LightShape, device=device)
            frame.launch(light_cache.shape_lights, [frame.data, state.luminances, shapes], len(places))
            state = replace(state, places=places, shapes=shapes, emitters=emitters.emitters)
        state = replace(state, rest=woken_by(frame, state.rest))
        if state.rest.is_resting:
            tree = LightHierarchy().preprocess(frame, state.tree if has_choice(scene) else None)
            return replace(state, tree=tree or state.tree)
        if moved.any() and self.adapts_exploration:  # the cached lights may be the wrong ones
            tables = launch.copied(state.tables, light_cache.CacheTables)
            least = min(max(self.exploration, MOVING_EXPLORATION), MOST_EXPLORATION)
            shares = np.maximum(tables.exploration.numpy(), np.float32(least))
            tables.exploration = launch.on_device(shares, wp.float32, device)
            state = replace(state, tables=tables)
        cache = light_cache.LightCache()
        cache.shapes, cache.emitters = state.shapes, state.emitters
        cache.ltc, cache.tables = ltc_table(device), state.tables
        if self.explores_by == "hierarchy":
            table = None
            state = replace(state, tree=moved_tree(frame, state.tree))
            cache.explores_by_tree, cache.tree = 1, state.tree.data
        else:
            table = AliasTable.build(self._table(scene, frame.camera, moved, state.places[:, :3])).on(device)
        frame.paths.use_lights(light_cache.CACHED_LIGHTS, cache, table)
        wish_for_lesson(frame, state.rest)
        return state

    def _tables(self, leaves: int, device: wp.Device) -> light_cache.CacheTables:
        """Return tables of so many regions that know no light."""
        tables = light_cache.CacheTables()
        for name in ("buckets", "offsets"):
            setattr(tables, name, wp.zeros(leaves, dtype=wp.int32, device=device))
        tables.items = wp.zeros(0, dtype=wp.int32, device=device)
        tables.rates = wp.zeros(0, dtype=wp.float32, device=device)
        tables.chances = wp.zeros(0, dtype=wp.float32, device=device)
        tables.exploration = wp.full(leaves, self.exploration, dtype=wp.float32, device=device)
        tables.alone = wp.full(leaves, int(self.adapts_exploration), dtype=wp.int32, device=device)
        tables.moments = wp.zeros(leaves, dtype=wp.vec2, device=device)
        tables.excesses = wp.zeros(leaves, dtype=wp.float32, device=device)
        return tables

    def _table(self, scene: Scene, camera: Camera, moved: np.ndarray, centers: np.ndarray) -> np.ndarray:
        """Return the relative probability of exploring each light, float64 [emitter] (section 4.3).

        Args:
            scene: Scene of the lights.
            camera: Camera of the frame.
            moved: float64 [emitter], distance since the last frame in metres.
            centers: float64 [emitter, 3], metres.
        """
        powers = scene.emitter_powers()
        away = np.linalg.norm(centers - np.asarray(camera.position, np.float64), axis=1)
        near = 1.0 / (away**2 + (0.02 * scene.radius) ** 2)
        weights = np.zeros(len(powers))
        for share, part in ((self.energy, powers), (self.change, powers * moved), (self.distance, near * (powers > 0))):
            if part.sum() > 0:
                weights += share * part / part.sum()
        return weights

    def trace(self, frame: Frame, state: CacheState | None) -> None:
        """Ask the path tracer for this term."""
        frame.paths.want(self.term)

    def after(self, frame: Frame, state: CacheState | None) -> CacheState | None:
        """Return caches that learnt from the samples of the frame, if any were kept, and whether they rest next."""
        lesson = frame.offered(Lesson)
        if state is None:
            return None
        was_resting = state.rest.is_resting
        state = replace(state, rest=rest_after(frame, lesson, state.rest, self.rests, "lights", CACHE_COST))
        if lesson is None:
            return state
        if was_resting:
            return self._taken_over(lesson, state)
        return self.learn(lesson, state)

    def _taken_over(self, lesson: Lesson, state: CacheState) -> CacheState:
        """Return the caches as they were, by the leaves of the next frame's tree."""
        leaves = lesson.octree.leaf_count
        tables, known = self._tables(leaves, lesson.device), _lists(leaves, lesson.device)
        for name in ("items", "rates", "chances"):
            setattr(tables, name, getattr(state.tables, name))
        known.entries, known.tries = state.known.entries, state.known.tries
        inputs = [lesson.origins, state.known, state.tables, known, tables]
        lesson.launch(light_cache_build.take_over_lights, inputs)
        return replace(state, tables=tables, known=known)

    def learn(self, lesson: Lesson, state: CacheState | None) -> CacheState | None:
        """Return the caches of the next frame, made from the samples of this one."""
        if state is None:
            return None
        device, leaves = lesson.device, lesson.octree.leaf_count
        settings = light_cache_build.CacheSettings()
        settings.capacity = self.capacity
        settings.hysteresis = 0.75
        settings.first_exploration = self.exploration
        adapted = (LEAST_EXPLORATION, MOST_EXPLORATION) if self.adapts_exploration else (self.exploration,) * 2
        settings.least_exploration, settings.most_exploration = adapted
        settings.may_be_alone = int(self.adapts_exploration)
        samples, origins = lesson.leaf_samples(self.samples), lesson.origins

        seen = _lists(leaves, device)
        seen.entries = wp.empty(2 * samples.order.shape[0], dtype=wp.int32, device=device)
        lesson.launch(light_cache_build.list_seen_lights, [samples, lesson.records.lights, seen])
        joined = _lists(leaves, device)
        around = [seen, state.known, lesson.neighbours, origins]
        lesson.launch(light_cache_build.bound_lists, [*around, joined.counts])
        joined.offsets, size = running_sums(joined.counts)
        joined.entries = wp.zeros(size, dtype=wp.int32, device=device)
        joined.tries = wp.zeros(size, dtype=wp.vec2, device=device)
        lesson.launch(light_cache_build.join_lights, [*around, joined, self.memory])
        tables, sizes = (
            self._tables(leaves, device),
            wp.empty(leaves, dtype=wp.int32, device=device),
        )
        inputs = [settings, samples, lesson.records, joined, origins, state.tables, tables]
        lesson.launch(light_cache_build.weigh_light_samples, inputs)

        lights = light_cache.LightCache()
        lights.shapes, lights.emitters = state.shapes, state.emitters
        importances = wp.empty(size, dtype=wp.float32, device=device)
        sums = wp.empty(leaves, dtype=wp.float32, device=device)
        octree = lesson.octree.octree
        inputs = [lights, octree, lesson.tree, joined, self.capacity, importances, sums]
        lesson.launch(light_cache_build.rank_lights, inputs)
        inputs = [settings, joined, importances, origins, state.tables.buckets, tables.buckets, sizes]
        lesson.launch(light_cache_build.count_buckets, inputs)
        tables.offsets, size = running_sums(sizes)
        tables.items = wp.zeros(size, dtype=wp.int32, device=device)
        tables.rates = wp.zeros(size, dtype=wp.float32, device=device)
        tables.chances = wp.zeros(size, dtype=wp.float32, device=device)
        lesson.launch(light_cache_build.fill_buckets, [settings, joined, importances, sums, tables])
        return replace(state, tables=tables, known=joined)


@dataclass
class CacheState:
    """The caches of all regions, and the places of lights. No call changes a state; each returns a new one."""

    tables: light_cache.CacheTables
    """Lights of every region in buckets, and the probabilities with which they are sampled."""
    known: light_cache_build.LightLists
    """Lights of every region with the number of frames since each was seen, from which the tables are made."""
    places: np.ndarray
    """float64 [emitter, 6]: position of each emitter in the last frame in metres, and its direction or first corner."""
    tree: TreeState = field(metadata={"derived": True})
    """Hierarchy over all lights, by which others are explored."""
    luminances: wp.array = field(metadata={"derived": True})
    """float32 [emitter]: luminance of the mean radiance of emissive triangles, W/(m^2 sr); 0 for other lights."""
    shapes: wp.array | None = field(default=None, metadata={"derived": True})
    """LightShape [emitter]: lights of this frame as the cache weighs them; None before the first frame."""
    emitters: wp.array | None = field(default=None, metadata={"derived": True})
    """Emitter [emitter]: lights of the scene in this frame; None before the first frame."""
    rest: Rest = field(default_factory=Rest)
    """Whether frames use the caches."""

    def fault(self, before: CacheState, states: Mapping[str, Any]) -> str:
        """Return why a state that was read from a file cannot be; "" if it can."""
        return cache_fault(self, before, states.get(SampleOctree.name))


def _lists(leaves: int, device: wp.Device) -> light_cache_build.LightLists:
    """Return empty lists of lights for so many regions."""
    lists = light_cache_build.LightLists()
    lists.offsets = wp.zeros(leaves, dtype=wp.int32, device=device)
    lists.counts = wp.zeros(leaves, dtype=wp.int32, device=device)
    lists.entries = wp.zeros(0, dtype=wp.int32, device=device)
    lists.tries = wp.zeros(0, dtype=wp.vec2, device=device)
    return lists


def _places(placed: PlacedEmitters) -> tuple[np.ndarray, np.ndarray]:
    """Return the places of emitters, float64 [emitter, 6], and the areas of their emitting sides, float64 [emitter].

    A place is the centre [m] with the direction, of a triangle with its first corner [m]. Lights without size have
    area 0.
    """
    places = np.concatenate([placed.table["position"], placed.table["direction"]], axis=1).astype(np.float64)
    areas = np.zeros(len(places))
    points = placed.corners
    places[: len(points)] = np.concatenate([points.mean(axis=1), points[:, 0]], axis=1)
    sides = np.linalg.norm(np.cross(points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]), axis=1) / 2
    areas[: len(points)] = sides * (1.0 + placed.two_sided)
    return places, areas
