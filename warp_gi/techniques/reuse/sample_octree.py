"""The octree that techniques which learn from samples share, and the samples of a frame in it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.errors import OptionError, check_whole
from warp_gi.kernels import octree, samples
from warp_gi.service import Service

if TYPE_CHECKING:
    from warp_gi.baking import Bake
    from warp_gi.frame import Frame
    from warp_gi.paths import PathRequest
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.scene import Scene

MOST_SAMPLES = 1 << 28
MOST_VERTICES = 7  # of a path whose samples are kept: each path has room for as many, so more would keep fewer paths
SLICES_PER_THREAD = 4
MOST_CELLS = 1 << 24  # offsets of inner nodes have 24 bits


@dataclass(frozen=True)
class SampleOctree(Service):
    """An octree over the points where paths scatter, as fine as there are samples to learn from.

    A cell is split where it holds more than ``split`` samples of a frame, by as many levels at once as that needs, and
    given up where it holds fewer than ``collapse`` (temporal_reuse.txt, section 6).
    """

    name: ClassVar[str] = "octree"

    split: int = 1024
    """Samples of a frame above which a leaf is split."""
    collapse: int = 512
    """Samples of a frame below which an inner node becomes a leaf."""
    most_samples: int = 1 << 20
    """Samples that are kept of a frame at most, 40 bytes each; of more paths, every second, third ... is recorded."""

    def validate(self) -> None:
        """Raise OptionError for settings out of range."""
        for name, least in (("split", 1), ("collapse", 1), ("most_samples", 1024)):
            check_whole(f"octree.{name}", getattr(self, name), least, MOST_SAMPLES)
        if self.collapse > self.split:
            raise OptionError(f"octree.collapse must be at most octree.split ({self.split}), got {self.collapse}")

    @property
    def saves_state(self) -> bool:
        """The tree is all that frames before left."""
        return True

    def bake_key(self, scene: Scene | BakedScene) -> str:
        """Return a hash of all but the sky."""
        return scene.contents_hash

    def start(
        self, scene: Scene | BakedScene, device: str | wp.Device, bake: Bake | None = None, seed: int = 0
    ) -> OctreeState:
        """Return a tree whose root has eight leaves, over the cube around the scene's bounds in all of its time."""
        device = launch.get_device(str(device))
        low, high = (corner.astype(np.float64) for corner in scene.bounds)
        edge = max(float((high - low).max()), 1e-6) * 1.001
        corner = (low + high) / 2 - edge / 2
        cube = octree.Octree()
        cube.nodes = launch.on_device(np.array([255], np.uint32), wp.uint32, device)
        cube.low, cube.scale = wp.vec3(*corner), octree.SIDE / edge
        prefixes, levels = (wp.zeros(1, dtype=dtype, device=device) for dtype in (wp.uint32, wp.int32))
        return OctreeState(cube, prefixes, levels, wp.zeros(8, dtype=wp.int32, device=device))

    def preprocess(self, frame: Frame, state: OctreeState) -> OctreeState:
        """Let samplers find regions in the tree, and leave samples for ``after``."""
        frame.paths.use_regions(samples.SAMPLE_REGIONS, lambda paths: self._regions(frame, state, paths))
        return state

    def _regions(self, frame: Frame, state: OctreeState, paths: PathRequest) -> samples.SampleRegions:
        """Return the tree, and empty buffers for samples, as path kernels read them."""
        with frame.stage(f"preprocess {self.name}"):
            regions = samples.SampleRegions()
            regions.octree, regions.moves = state.octree, int(frame.scene.is_animated)
            vertices = min(paths.max_depth - 1, MOST_VERTICES)
            regions.records = self.records(frame, vertices, state.spare.take())
        return regions

    def after(self, frame: Frame, state: OctreeState) -> OctreeState:
        """Return the tree that fits the samples of the frame, and offer a ``Lesson``; nothing if none were kept."""
        if frame.paths.regions.sampler is not samples.SAMPLE_REGIONS:
            return state
        records = frame.paths.regions.data.records
        lesson = self.learn(state, records, frame.device)
        frame.offer(lesson)
        lesson.octree.spare.give(records)
        return lesson.octree

    def records(self, frame: Frame, vertices: int, previous: samples.SampleRecords | None) -> samples.SampleRecords:
        """Return empty buffers for the samples of a frame whose paths have ``vertices``; uses ``previous`` again."""
        paths = frame.tiled_items * frame.settings.spp
        stride = max(1, -(-paths * vertices // self.most_samples))
        slots = -(-paths // stride) * vertices
        records = samples.SampleRecords()
        if previous is not None and previous.codes.shape[0] == slots:
            records = launch.copied(previous, samples.SampleRecords)
        else:
            for name in ("codes", "lights", "directions", "mixtures"):
                setattr(records, name, wp.empty(slots, dtype=wp.uint32, device=frame.device))
            for name in ("light_values", "rivals", "contributions", "pdfs", "nearness", "carried"):
                setattr(records, name, wp.empty(slots, dtype=wp.float32, device=frame.device))
        records.codes.fill_(0xFFFFFFFF)
        records.vertices, records.stride, records.seed = vertices, stride, frame.seed
        return records

    def learn(self, state: OctreeState, records: samples.SampleRecords, device: wp.Device) -> Lesson:
        """Return the tree that fits the samples of a frame, and these sorted by its leaves."""
        codes, slots = _listed(records, device)
        tree, count = self._build(state, codes, device)
        leaves = 8 * count
        neighbours = wp.empty(leaves * octree.NEIGHBOURS, dtype=wp.int32, device=device)
        origins = wp.empty(leaves, dtype=wp.int32, device=device)
        launch.launch(octree.augment_leaves, leaves, [tree, neighbours], device)
        counts = wp.empty(leaves, dtype=wp.int32, device=device)
        launch.launch(octree.find_origins, leaves, [tree, state.octree.nodes, codes, origins, counts], device)
        cube = launch.copied(state.octree, octree.Octree)
        cube.nodes = tree.nodes
        grouped = samples.LeafSamples()
        grouped.starts, grouped.counts, grouped.order = tree.starts, counts, slots
        grown = OctreeState(cube, tree.prefixes, tree.levels, tree.counts)
        return Lesson(grown, tree, records, grouped, neighbours, origins, device)

    def _build(self, state: OctreeState, codes: wp.array, device: wp.Device) -> tuple[octree.OctreeNodes, int]:
        """Return the nodes, level by level, and how many there are."""
        most = 1 + octree.LEVELS * (codes.shape[0] // self.collapse)
        tree = octree.OctreeNodes()
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
            launch.launch(octree.mark_children, level, inputs, device)
            inner = tree.inner[begin:end]
            wp.utils.array_scan(inner, inner, inclusive=True)
            launch.launch(octree.place_children, level, [tree, old, begin, end], device)
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

    A frame takes them from the state before, and leaves them in the state after. So a frame that is interrupted, whose
    last launches may still write there, leaves none.
    """

    def __init__(self) -> None:
        self.records: samples.SampleRecords | None = None

    def take(self) -> samples.SampleRecords | None:
        """Return the buffers, if there are any, and keep them no more."""
        records, self.records = self.records, None
        return records

    def give(self, records: samples.SampleRecords) -> None:
        """Keep buffers for the next frame."""
        self.records = records


@dataclass
class OctreeState:
    """A tree, and what pictures show of it."""

    octree: octree.Octree
    prefixes: wp.array
    """uint32 [node] lowest code of its cell."""
    levels: wp.array
    """int32 [node] 0 is the root's."""
    counts: wp.array
    """int32 [8 node + octant] samples in the cell in the last frame."""
    spare: SpareRecords = field(default_factory=SpareRecords, metadata={"derived": True})

    @property
    def leaf_count(self) -> int:
        """Places for leaves: eight a node, those of inner children included."""
        return 8 * self.octree.nodes.shape[0]


@dataclass
class Lesson:
    """What a frame's samples have to teach: they, sorted by the leaves of the tree that fits them."""

    octree: OctreeState
    tree: octree.OctreeNodes
    records: samples.SampleRecords
    samples: samples.LeafSamples
    """``most`` is for each technique to set."""
    neighbours: wp.array
    """int32 [6 leaf + face]"""
    origins: wp.array
    """int32 [leaf] whose knowledge it takes over; -1: the place holds no leaf."""
    device: wp.Device

    def launch(self, kernel: wp.Kernel, inputs: list[Any]) -> None:
        """Run a kernel over all leaves, in few slices: kernels are many, and a slice costs tens of microseconds."""
        leaves = self.octree.leaf_count
        smallest_slice = max(16, -(-leaves // (SLICES_PER_THREAD * launch.thread_count())))
        launch.launch(kernel, leaves, inputs, self.device, smallest_slice)

    def leaf_samples(self, most: int) -> samples.LeafSamples:
        """Return the samples by leaf, of which ``most`` are looked at in one."""
        grouped = launch.copied(self.samples, samples.LeafSamples)
        grouped.most = most
        return grouped


def running_sums(counts: wp.array) -> tuple[wp.array, int]:
    """Return where each item begins if ``counts`` [int32] of them stand one after another, and the sum.

    Raises OptionError where that is beyond what 32 bits count.
    """
    if counts.shape[0] > MOST_SAMPLES // 1024 and int(counts.numpy().sum(dtype=np.int64)) >= 1 << 31:
        raise OptionError(f"{counts.shape[0]:,} leaves know too many lights together; raise octree.split")
    offsets = wp.empty_like(counts)
    wp.utils.array_scan(counts, offsets, inclusive=False)
    last = slice(counts.shape[0] - 1, counts.shape[0])
    return offsets, int(offsets[last].numpy()[0] + counts[last].numpy()[0])


def _listed(records: samples.SampleRecords, device: wp.Device) -> tuple[wp.array, wp.array]:
    """Return the codes of all samples in rising order, and their slots."""
    chunks = -(-records.codes.shape[0] // samples.CHUNK)
    ends = wp.empty(chunks, dtype=wp.int32, device=device)
    launch.launch(samples.count_samples, chunks, [records, ends], device, 16)
    wp.utils.array_scan(ends, ends, inclusive=True)
    count = int(ends[chunks - 1 : chunks].numpy()[0])
    codes = wp.empty(2 * count, dtype=wp.int32, device=device)  # sorting needs as much again
    slots = wp.empty(2 * count, dtype=wp.int32, device=device)
    if count == 0:
        return codes, slots
    launch.launch(samples.list_samples, chunks, [records, ends, codes, slots], device, 16)
    wp.utils.radix_sort_pairs(codes, slots, count)
    return codes[:count], slots[:count]
