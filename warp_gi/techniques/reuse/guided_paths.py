"""Indirect light by paths that go where light came from: directional quadtrees (temporal_reuse.txt, section 5)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, ClassVar

import warp as wp

from warp_gi import launch
from warp_gi.errors import OptionError, check_whole
from warp_gi.kernels import guided_directions, guided_shares, quadtree, quadtree_adapt
from warp_gi.kernels.reuse_gains import sum_gains
from warp_gi.techniques.paths.estimators import BsdfPaths
from warp_gi.techniques.reuse.rest import GUIDE_COST, Rest, rest_after, wish_for_lesson, woken_by
from warp_gi.techniques.reuse.sample_octree import Lesson, SampleOctree
from warp_gi.techniques.reuse.saved import guide_fault

if TYPE_CHECKING:
    from warp_gi.baking import Bake
    from warp_gi.frame import Frame
    from warp_gi.scene.baked import BakedScene
    from warp_gi.scene.scene import Scene
    from warp_gi.stateful import Service

BITS = (32, 64, 96, 128)


@dataclass(frozen=True)
class GuidedPaths(BsdfPaths):
    """Indirect light by path tracing, whose directions also come from a quadtree that each region learns.

    A quadtree of a few bits holds where light came from in earlier frames. Directions that it proposes and directions
    by the BSDF are combined by the balance heuristic, at every path vertex. Unbiased but for ``max_depth`` and
    ``clamp``.
    """

    term: ClassVar[str] = "indirect"

    bits: int = 128
    """Size of one quadtree in bits: 32, 64, 96 or 128."""
    migrations: int = 8
    """Largest number of leaves of a quadtree that move in a frame; 1 in the paper."""
    significance: float = 0.5
    """A leaf is split, and four others are merged, only if significance * gain > loss, both measured as
    area * radiance^2."""
    fading: float = 0.5
    """Weight of earlier frames in the light that a quadtree adapts to, from 0 (the last frame alone) to below 1; where
    samples are few it is raised."""
    bsdf_share: float = 0.5
    """Probability of sampling a direction by the BSDF. With ``adapts_share`` it is only the initial value."""
    adapts_share: bool = True
    """Whether each region learns the probability with which its samples would have varied least."""
    stratified: bool = True
    """How a direction is drawn from a quadtree: by warping two numbers from the root down, which keeps them stratified
    (True), or by a third number that picks a leaf, as in the paper (False)."""
    samples: int = 2048
    """Largest number of samples that a region learns from in a frame."""
    rests: bool = True
    """Whether frames leave directions to the BSDF, record nothing and learn nothing, while that has less variance for
    its time; a frame in 8, then in 16, ... 128 tries again. False: every frame uses the quadtrees."""

    def validate(self) -> None:
        """Raise OptionError for settings out of range."""
        super().validate()
        if self.bits not in BITS:
            raise OptionError(f"bits must be one of {', '.join(map(str, BITS))}, got {self.bits}")
        for name, least, most in (("bits", 32, 128), ("migrations", 0, 32), ("samples", 1, 1 << 24)):
            check_whole(name, getattr(self, name), least, most)
        if not 0.0 <= self.fading < 1.0:
            raise OptionError(f"fading must be from 0 to below 1, got {self.fading}")
        if not 0.0 <= self.significance <= 1.0:
            raise OptionError(f"significance must be from 0 to 1, got {self.significance}")
        if not 0.02 <= self.bsdf_share <= 0.98:
            raise OptionError(f"bsdf_share must be from 0.02 to 0.98, got {self.bsdf_share}")

    @property
    def services(self) -> tuple[Service, ...]:
        """The octree of regions, which also sorts a frame's samples by region."""
        return (SampleOctree(),)

    def kernels(self, scene: Scene | BakedScene | None = None) -> tuple[wp.Kernel, ...]:
        """Return the kernels of learning."""
        gains = (sum_gains,) if self.rests else ()
        return (guided_shares.adapt_shares, quadtree_adapt.adapt_quadtrees, *gains)

    def samplers(self, scene: Scene | BakedScene | None = None) -> tuple[Any, ...]:
        """Return the guided directions."""
        return (guided_directions.GUIDED_DIRECTIONS,)

    @property
    def saves_state(self) -> bool:
        """True: the quadtrees hold all that earlier frames left."""
        return True

    def bake_key(self, scene: Scene | BakedScene) -> str:
        """Return a hash of all but the sky."""
        return scene.contents_hash

    def start(self, scene: Scene | BakedScene, device: str, bake: Bake | None = None, seed: int = 0) -> GuideState:
        """Return even quadtrees for the eight leaves of the first octree."""
        target = launch.get_device(device)
        guides = _guides(8, self.bits, target)
        guides.trees.fill_(wp.vec4ui(*quadtree.quadtree_uniform(self.bits)))
        guides.shares.fill_(wp.vec2(self.bsdf_share, self.bsdf_share))
        return self._counted(guides, target, Rest())

    def preprocess(self, frame: Frame, state: GuideState) -> GuideState:
        """Let paths draw directions from the quadtrees, unless they rest."""
        state = replace(state, rest=woken_by(frame, state.rest))
        if state.rest.is_resting:
            return state
        data = guided_directions.GuidedDirections()
        data.bits, data.stratified = self.bits, int(self.stratified)
        data.trees, data.shares, data.counts = state.guides.trees, state.guides.shares, state.counts
        data.anchors = state.guides.anchors
        frame.paths.use_directions(guided_directions.GUIDED_DIRECTIONS, data)
        wish_for_lesson(frame, state.rest)
        return state

    def after(self, frame: Frame, state: GuideState) -> GuideState:
        """Return quadtrees that learnt from the samples of the frame, if any were kept, and whether they rest next."""
        lesson = frame.offered(Lesson)
        was_resting = state.rest.is_resting
        state = replace(state, rest=rest_after(frame, lesson, state.rest, self.rests, "directions", GUIDE_COST))
        if lesson is None:
            return state
        if was_resting:
            return self._counted(self._taken_over(lesson, state), lesson.device, state.rest)
        return self.learn(lesson, state)

    def learn(self, lesson: Lesson, state: GuideState) -> GuideState:
        """Return quadtrees for the next frame's leaves, adapted to the samples of this one."""
        device = lesson.device
        if lesson.octree.leaf_count * 4 * self.bits >= 1 << 31:
            raise OptionError(
                f"{lesson.octree.leaf_count:,} leaves are too many for {self.bits} bits; raise octree.split"
            )
        guides = self._taken_over(lesson, state)
        cells = [lesson.octree.octree, lesson.tree]
        samples = lesson.leaf_samples(self.samples)
        inputs = [samples, lesson.records, guides, *cells, self.bsdf_share, int(self.adapts_share)]
        lesson.launch(guided_shares.adapt_shares, inputs)
        adaptation = self._adaptation(guides, device)
        adaptation.octree = lesson.octree.octree
        records = quadtree_adapt.QuadtreeSamples()
        records.starts, records.counts, records.order = samples.starts, samples.counts, samples.order
        for name in ("codes", "directions", "contributions", "pdfs"):
            setattr(records, name, getattr(lesson.records, name))
        lesson.launch(quadtree_adapt.adapt_quadtrees, [records, adaptation])
        return replace(state, guides=guides, counts=adaptation.counts)

    def _taken_over(self, lesson: Lesson, state: GuideState) -> guided_shares.GuideKnowledge:
        """Return what is known, by the leaves of the next frame's tree."""
        guides = _guides(lesson.octree.leaf_count, self.bits, lesson.device)
        uniform = wp.vec4ui(*quadtree.quadtree_uniform(self.bits))
        cells = [lesson.octree.octree, lesson.tree]
        inputs = [lesson.origins, state.guides, guides, uniform, self.bsdf_share, *cells]
        lesson.launch(guided_shares.take_over_guides, inputs)
        return guides

    def _adaptation(self, guides: guided_shares.GuideKnowledge, device: wp.Device) -> quadtree_adapt.QuadtreeAdaptation:
        """Return the settings of an adaptation of quadtrees, with room for its counts."""
        leaves = guides.trees.shape[0]
        adaptation = quadtree_adapt.QuadtreeAdaptation()
        adaptation.bits, adaptation.migrations = self.bits, self.migrations
        adaptation.significance, adaptation.most_samples = self.significance, self.samples
        adaptation.trees, adaptation.anchors = guides.trees, guides.anchors
        adaptation.counts = wp.empty(leaves * self.bits // 4, dtype=wp.uint32, device=device)
        adaptation.energies, adaptation.fading = guides.energies, self.fading
        return adaptation

    def _counted(self, guides: guided_shares.GuideKnowledge, device: wp.Device, rest: Rest) -> GuideState:
        """Return a state of quadtrees as they are, with the counts that follow from them."""
        adaptation = self._adaptation(guides, device)
        none = quadtree_adapt.QuadtreeSamples()
        leaves = guides.trees.shape[0]
        none.starts = none.counts = wp.zeros(leaves, dtype=wp.int32, device=device)
        launch.launch(quadtree_adapt.adapt_quadtrees, leaves, [none, adaptation], device)
        return GuideState(guides, adaptation.counts, rest)


@dataclass
class GuideState:
    """What every region knows of directions. No call changes a state; each returns a new one."""

    guides: guided_shares.GuideKnowledge
    """Quadtrees, shares of directions by the BSDF, and what both are learnt from, by leaf of the octree."""
    counts: wp.array
    """uint32 [leaf * bits / 4]: numbers of leaves below nodes of the quadtrees, which follow from the trees."""
    rest: Rest = field(default_factory=Rest)
    """Whether frames use the quadtrees."""

    def fault(self, before: GuideState, states: Mapping[str, Any]) -> str:
        """Return why a state that was read from a file cannot be; "" if it can."""
        return guide_fault(self, before, states.get(SampleOctree.name))


def _guides(leaves: int, bits: int, device: wp.Device) -> guided_shares.GuideKnowledge:
    """Return arrays for so many leaves of the octree; trees and shares are yet to be filled."""
    guides = guided_shares.GuideKnowledge()
    guides.trees = wp.empty(leaves, dtype=wp.vec4ui, device=device)
    guides.shares = wp.empty(leaves, dtype=wp.vec2, device=device)
    guides.moments = wp.zeros(2 * leaves, dtype=guided_shares.ShareMoments, device=device)
    guides.anchors = wp.zeros(leaves, dtype=wp.vec4, device=device)
    guides.nearness = wp.zeros(leaves, dtype=wp.vec2, device=device)
    guides.energies = wp.zeros(leaves * 4 * bits, dtype=wp.float32, device=device)
    return guides
