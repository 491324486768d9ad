"""The octree of regions, which estimators that learn from samples share, and a frame's samples in it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.errors import OptionError, check_whole
from warp_gi.kernels import octree as octree_kernels
from warp_gi.kernels import samples as sample_kernels
from warp_gi.scene.baked import whole_scene
from warp_gi.stateful import Service
from warp_gi.techniques.reuse.saved import octree_fault

if TYPE_CHECKING:
    from warp_gi.baking import Bake
    from warp_gi.frame import Frame
    from warp_gi.paths import PathRequest
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.scene import Scene

MOST_SAMPLES = 1 << 28
"""Largest number of samples that settings may name."""
MOST_VERTICES = 7
"""Largest number of vertices of a path whose samples are kept. All paths have room for as many, so a larger number
would keep samples of fewer paths."""
SLICES_PER_THREAD = 4
"""Slices a thread of launches over leaves."""
MOST_CELLS = 1 << 24
"""Number of inner cells from which on a tree is refused, as offsets of inner nodes have 24 bits."""


@dataclass(frozen=True)
class SampleOctree(Service):
    """An octree over the points where paths scatter, as fine as there are samples to learn from.

    A cell with more than ``split`` samples of a frame is split, by as many levels at once as that needs; the children
    of a cell with fewer than ``collapse`` are given up (temporal_reuse.txt, section 6).
    """

    name: ClassVar[str] = "octree"

    split: int = 1024
    """Samples of a frame above which a leaf is split."""
    collapse: int = 512
    """Samples of a frame below which an inner node becomes a leaf."""
    most_samples: int = 1 << 20
    """Largest number of samples of a frame that are kept, 40 bytes each; if there would be more, only every second,
    third, ... path is recorded."""

    def validate(self) -> None:
        """Raise OptionError for settings out of range."""
        for name, least in (("split", 1), ("collapse", 1), ("most_samples", 1024)):
            check_whole(f"octree.{name}", getattr(self, name), least, MOST_SAMPLES)
        if self.collapse > self.split:
            raise OptionError(f"octree.collapse must be at most octree.split ({self.split}), got {self.collapse}")

    def kernels(self, scene: Scene | BakedScene | None = None) -> tuple[wp.Kernel, ...]:
        """Return the kernels of the tree, and of lists of samples."""
        return (octree_kernels.augment_leaves, sample_kernels.count_samples)

    def samplers(self, scene: Scene | BakedScene | None = None) -> tuple[Any, ...]:
        """Return the regions."""
        return (sample_kernels.SAMPLE_REGIONS,)

    @property
    def saves_state(self) -> bool:
        """True: the tree is all that earlier frames left."""
        return True

    def bake_key(self, scene: Scene | BakedScene) -> str:
        """Return a hash of all but the sky."""
        return scene.contents_hash

    def start(
        self, scene: Scene | BakedScene, device: str | wp.Device, bake: Bake | None = None, seed: int = 0
    ) -> OctreeState:
        """Return a tree whose root has eight leaves, over a cube around the scene's bounds at all times."""
        device = launch.get_device(str(device))
        low, high = (corner.astype(np.float64) for corner in scene.bounds)
        edge = max(float((high - low).max()), 1e-6) * 1.001
        corner = (low + high) / 2 - edge / 2
        cube = octree_kernels.Octree()
        cube.nodes = launch.on_device(np.array([255], np.uint32), wp.uint32, device)
        cube.low, cube.scale = wp.vec3(*corner), octree_kernels.SIDE / edge
        prefixes, levels = (wp.zeros(1, dtype=dtype, device=device) for dtype in (wp.uint32, wp.int32))
        return OctreeState(cube, prefixes, levels, wp.zeros(8, dtype=wp.int32, device=device))

    def preprocess(self, frame: Frame, state: OctreeState) -> OctreeState:
        """Let samplers find their region in the tree, record samples for ``after``, and tell when lights begin to move.

        Regions are made only where a sampler of the frame uses them.
        """
        frame.paths.use_regions(sample_kernels.SAMPLE_REGIONS, lambda paths: self._regions(frame, state, paths))
        if not frame.scene.is_animated or not frame.scene.emitter_count:
            return state
        placed = whole_scene(frame.scene).placed_emitters(frame.device)
        places = np.concatenate([placed.corners.ravel(), placed.table["position"].ravel()]).astype(np.float64)
        move = len(state.places) == len(places) and not np.array_equal(places, state.places)
        frame.offer(Motion(begins=move and not state.moved))
        return replace(state, places=places, moved=np.asarray(move))

    def _regions(self, frame: Frame, state: OctreeState, paths: PathRequest) -> sample_kernels.SampleRegions:
        """Return the tree, and empty buffers for samples, as path kernels read them."""
        with frame.stage(f"preprocess {self.name}"):
            regions = sample_kernels.SampleRegions()
            regions.octree, regions.moves = state.octree, int(frame.scene.is_animated)
            wish = frame.offered(LessonWish)
            if wish is None or wish.is_wanted:
                vertices = min(paths.max_depth - 1, MOST_VERTICES)
                regions.records = self.records(frame, vertices, state.spare.take())
            else:
                regions.records.stride = 1  # and no vertices
        return regions

    def after(self, frame: Frame, state: OctreeState) -> OctreeState:
        """Return the tree that fits the samples of the frame, and offer a ``Lesson``, if any samples were kept."""
        if frame.paths.regions.sampler is not sample_kernels.SAMPLE_REGIONS:
            return state
        records = frame.paths.regions.data.records
        if not records.vertices:
            return state
        lesson = self.learn(state, records, frame.device)
        frame.offer(lesson)
        lesson.octree.spare.give(records)
        return lesson.octree

    def records(
        self, frame: Frame, vertices: int, previous: sample_kernels.SampleRecords | None
    ) -> sample_kernels.SampleRecords:
        """Return empty buffers for the samples of a frame whose paths have so many ``vertices``.

        The arrays of ``previous`` are used again if they have the right size.
        """
        paths = frame.tiled_items * frame.settings.spp
        stride = max(1, -(-paths * vertices // self.most_samples))
        slots = -(-paths // stride) * vertices
        records = sample_kernels.SampleRecords()
        if previous is not None and previous.codes.shape[0] == slots:
            records = launch.copied(previous, sample_kernels.SampleRecords)
        else:
            for name in ("codes", "lights", "directions", "mixtures"):
                setattr(records, name, wp.empty(slots, dtype=wp.uint32, device=frame.device))
            for name in ("light_values", "rivals", "contributions", "pdfs", "nearness", "carried"):
                setattr(records, name, wp.empty(slots, dtype=wp.float32, device=frame.device))
        records.codes.fill_(0xFFFFFFFF)
        records.vertices, records.stride, records.seed = vertices, stride, frame.seed
        return records

    def learn(self, state: OctreeState, records: sample_kernels.SampleRecords, device: wp.Device) -> Lesson:
        """Return the tree that fits the samples of a frame, and the samples sorted by its leaves."""
        codes, slots = _listed(records, device)
        tree, count = self._build(state, codes, device)
        leaves = 8 * count
        neighbours = wp.empty(leaves * octree_kernels.NEIGHBOURS, dtype=wp.int32, device=device)
        origins = wp.empty(leaves, dtype=wp.int32, device=device)
        launch.launch(octree_kernels.augment_leaves, leaves, [tree, neighbours], device)
        counts = wp.empty(leaves, dtype=wp.int32, device=device)
        launch.launch(octree_kernels.find_origins, leaves, [tree, state.octree.nodes, codes, origins, counts], device)
        cube = launch.copied(state.octree, octree_kernels.Octree)
        cube.nodes = tree.nodes
        grouped = sample_kernels.LeafSamples()
        grouped.starts, grouped.counts, grouped.order = tree.starts, counts, slots
        grown = OctreeState(cube, tree.prefixes, tree.levels, tree.counts, state.places, state.moved)
        return Lesson(grown, tree, records, grouped, neighbours, origins, device)

    def _build(self, state: OctreeState, codes: wp.array, device: wp.Device) -> tuple[octree_kernels.OctreeNodes, int]:
        """Return the nodes of the tree that fits samples with these ``codes``, level by level, and their number."""
        most = 1 + octree_kernels.LEVELS * (codes.shape[0] // self.collapse)
        tree = octree_kernels.OctreeNodes()
        for name in ("nodes", "prefixes"):
            setattr(tree, name, wp.zeros(most, dtype=wp.uint32, device=device))
        for name in ("levels", "previous", "inner"):
            setattr(tree, name, wp.zeros(most, dtype=wp.int32, device=device))
        tree.parents = wp.full(most, -1, dtype=wp.int32, device=device)
        for name in ("starts", "counts"):
            setattr(tree, name, wp.zeros(8 * most, dtype=wp.int32, device=device))
        old = state.octree.nodes
        begin, end = 0, 1
        while begin < end:
            level = end - begin
            inputs = [tree, old, codes, begin, self.split, self.collapse]
            launch.launch(octree_kernels.mark_children, level, inputs, device)
            inner = tree.inner[begin:end]
            wp.utils.array_scan(inner, inner, inclusive=True)
            launch.launch(octree_kernels.place_children, level, [tree, old, begin, end], device)
            begin, end = end, end + int(inner.numpy()[-1])
        if end >= MOST_CELLS:
            raise OptionError(
                f"octree: {end:,} inner cells, more than {MOST_CELLS:,}; raise collapse ({self.collapse})"
            )
        for name in ("nodes", "prefixes", "levels", "parents", "previous"):
            setattr(tree, name, getattr(tree, name)[:end])
        tree.starts, tree.counts = tree.starts[: 8 * end], tree.counts[: 8 * end]
        return tree, end


class SpareRecords:
    """Buffers for samples that a frame is done with, for the next frame to use again.

    They are a cache of memory: what is in it changes no picture, so that states may share it, and a frame may empty
    it. A frame takes the buffers from the state before, and leaves them in the state after. A frame that is
    interrupted, whose last launches may still write there, so leaves none.
    """

    def __init__(self) -> None:
        self.records: sample_kernels.SampleRecords | None = None

    def take(self) -> sample_kernels.SampleRecords | None:
        """Return the buffers, if there are any, and keep them no more."""
        records, self.records = self.records, None
        return records

    def give(self, records: sample_kernels.SampleRecords) -> None:
        """Keep buffers for the next frame."""
        self.records = records


@dataclass
class OctreeState:
    """An octree, and what pictures show of it. No call changes a state but for ``spare``; each returns a new one."""

    octree: octree_kernels.Octree
    """Nodes and cube of the tree as kernels read them."""
    prefixes: wp.array
    """uint32 [node]: lowest code of a point in the node's cell."""
    levels: wp.array
    """int32 [node]: level of the node's cell; the root has 0."""
    counts: wp.array
    """int32 [8 * node + octant]: number of samples of the last frame in each child's cell."""
    places: np.ndarray = field(default_factory=lambda: np.zeros(0))
    """float64: corners and positions of lights in the last frame in metres, one after another, where things move."""
    moved: np.ndarray = field(default_factory=lambda: np.zeros((), bool))
    """bool: whether lights moved in the last frame."""
    spare: SpareRecords = field(default_factory=SpareRecords, metadata={"derived": True})
    """Buffers for the next frame's samples, if the last frame left any."""

    def fault(self, before: OctreeState, states: Mapping[str, Any]) -> str:
        """Return why a state that was read from a file cannot be; "" if it can."""
        return octree_fault(self)

    @property
    def leaf_count(self) -> int:
        """Number of places for leaves: eight a node, those of children that are inner nodes included."""
        return 8 * self.octree.nodes.shape[0]


@dataclass(frozen=True)
class Motion:
    """What the service tells of lights, in scenes where things move."""

    begins: bool
    """Whether lights move in this frame that did not in the last one."""


@dataclass(frozen=True)
class LessonWish:
    """What estimators offer in ``preprocess`` that need not learn from every frame."""

    is_wanted: bool
    """Whether one of them wants to learn from the frame. If not, none of its samples are kept."""


@dataclass
class Lesson:
    """A frame's samples, sorted by the leaves of the tree that fits them, for estimators to learn from."""

    octree: OctreeState
    """State of the tree that fits the samples."""
    tree: octree_kernels.OctreeNodes
    """Nodes of that tree with all that building it found."""
    records: sample_kernels.SampleRecords
    """The samples, in the order of paths and vertices."""
    samples: sample_kernels.LeafSamples
    """Which samples lie in which leaf; ``leaf_samples`` sets how many of them are looked at."""
    neighbours: wp.array
    """int32 [6 * leaf + face]: leaf or node beyond each face of a leaf."""
    origins: wp.array
    """int32 [leaf]: leaf of the last tree whose knowledge a leaf takes over; -1 where the place holds no leaf."""
    device: wp.Device
    """Device of all arrays."""

    def launch(self, kernel: wp.Kernel, inputs: Sequence[object]) -> None:
        """Run a kernel over all leaves, in few slices: kernels are many, and each slice costs tens of microseconds."""
        leaves = self.octree.leaf_count
        smallest_slice = max(16, -(-leaves // (SLICES_PER_THREAD * launch.thread_count())))
        launch.launch(kernel, leaves, inputs, self.device, smallest_slice)

    def leaf_samples(self, most: int) -> sample_kernels.LeafSamples:
        """Return the samples by leaf, of which kernels look at up to ``most`` in each leaf."""
        grouped = launch.copied(self.samples, sample_kernels.LeafSamples)
        grouped.most = most
        return grouped


def running_sums(counts: wp.array) -> tuple[wp.array, int]:
    """Return where each run begins if runs of ``counts`` items stand one after another, and the sum of ``counts``.

    Both arrays are int32 [run]. Raises OptionError for a sum beyond what 32 bits count.
    """
    if counts.shape[0] > MOST_SAMPLES // 1024 and int(counts.numpy().sum(dtype=np.int64)) >= 1 << 31:
        raise OptionError(f"{counts.shape[0]:,} leaves know too many lights together; raise octree.split")
    offsets = wp.empty_like(counts)
    wp.utils.array_scan(counts, offsets, inclusive=False)
    last = slice(counts.shape[0] - 1, counts.shape[0])
    return offsets, int(offsets[last].numpy()[0] + counts[last].numpy()[0])


def _listed(records: sample_kernels.SampleRecords, device: wp.Device) -> tuple[wp.array, wp.array]:
    """Return the codes of all samples in rising order, and their slots."""
    chunks = -(-records.codes.shape[0] // sample_kernels.CHUNK)
    ends = wp.empty(chunks, dtype=wp.int32, device=device)
    launch.launch(sample_kernels.count_samples, chunks, [records, ends], device, 16)
    wp.utils.array_scan(ends, ends, inclusive=True)
    count = int(ends[chunks - 1 : chunks].numpy()[0])
    codes = wp.empty(2 * count, dtype=wp.int32, device=device)  # sorting needs as much again
    slots = wp.empty(2 * count, dtype=wp.int32, device=device)
    if count == 0:
        return codes, slots
    launch.launch(sample_kernels.list_samples, chunks, [records, ends, codes, slots], device, 16)
    wp.utils.radix_sort_pairs(codes, slots, count)
    return codes[:count], slots[:count]
