"""Resting: a technique that gains less than it costs leaves paths to the plain samplers, and tries again later.

All is decided by what samples tell and by constants, never by a clock, so that frames are the same on any machine.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
import warp as wp

from warp_gi import launch
from warp_gi.kernels import reuse_gains, samples
from warp_gi.techniques.reuse.sample_octree import Lesson, LessonWish, Motion

if TYPE_CHECKING:
    from warp_gi.frame import Frame

CACHE_COST = 2.0
"""Time of a frame with the light cache over one with the hierarchy. Measured in the warehouse by
``warp-gi bench reuse --parts cost``."""
GUIDE_COST = 1.35
"""Time of a frame with guided paths over one with directions by the BSDF, measured likewise."""
FIRST_TRIAL, WOKEN_TRIAL, LATER_TRIAL = 6, 2, 1
"""Frames of the first trial, of one because lights began to move, and of another one, which goes on from what is known.
While the gain may still suffice each takes twice as many, as quadtrees learn for ten frames."""
PROMISING = 0.6
"""Share of the gain that is needed from which on a trial goes on."""
KEPT = 0.7
"""Share of the gain that is needed below which a technique in use rests."""
FIRST_REST, LONGEST_REST, LONGEST_REST_MOVING = 8, 128, 64
"""Frames of the first rest, which double with each, and of the longest, where nothing moves and where things do."""
SETTLED = 10
"""Frames of use from which on only every second one leaves samples to learn from, where nothing moves."""
WAKING = 96
"""Frames of rest that allow for a trial ahead of time, when lights begin to move; the first is given."""
LEARNING_FADING, FADING = 0.5, 0.95
"""Share of sums that stays from frame to frame: in a trial in which gains grow, and else."""
MOST_NUMBER = 1e18  # of a saved state
MOST_GAIN, MOST_LOSS = 2.0, 10.0
"""Largest gain and loss that one frame tells of, over the variance of its picture: what samples say that the picture
does not show would be a few bright pixels in a hundred frames."""


@dataclass(frozen=True)
class Gains:
    """By how much sample reuse lowers the variance of a frame's picture, in squared luminance of one path, W^2/(m^2
    sr)^2, summed over pixels."""

    variance: float
    """What there is: half the mean squared difference of neighbouring pixels, edges within a surface included."""
    lights: float
    """By how much it would be more without the light cache."""
    directions: float
    """By how much it would be more without guided paths."""


def frame_gains(frame: Frame, lesson: Lesson) -> Gains:
    """Return the gains of a frame; worked out once for all who ask."""
    known = frame.offered(Gains)
    if known is not None:
        return known
    (width, height), records = frame.camera.resolution, lesson.records
    rows = wp.empty(height, dtype=wp.vec3, device=frame.device)
    inputs = [width, frame.struct(reuse_gains.VaryingTerms), rows]
    launch.launch(reuse_gains.sum_differences, height, inputs, frame.device, 16)
    squares, pairs, pixels = rows.numpy().sum(axis=0, dtype=np.float64)
    chunks = -(-records.codes.shape[0] // samples.CHUNK)
    sums = wp.empty(chunks, dtype=wp.vec2, device=frame.device)
    launch.launch(reuse_gains.sum_gains, chunks, [records, sums], frame.device, 16)
    spp = frame.settings.spp
    lights, directions = sums.numpy().sum(axis=0, dtype=np.float64) * (records.stride / spp)
    found = Gains(float(spp * 0.5 * squares / max(pairs, 1.0) * pixels), float(lights), float(directions))
    frame.offer(found)
    return found


@dataclass(frozen=True)
class Rest:
    """Whether a technique is tried, in use or at rest. No call changes it; each returns a new one.

    A technique that needs ``cost`` times the time is in use while variance * cost < variance + gain.
    """

    left: int = 0
    """Frames of this rest that are left; 0: it is awake."""
    trial: int = FIRST_TRIAL
    """Frames that this trial takes at least; 0: it is in use."""
    tried: int = 0
    """Frames of this trial or use so far."""
    longest: int = 0
    """Frames of the last rest; 0 before the first one."""
    credit: int = WAKING
    """Frames of rest that allow for trials ahead of time."""
    gain: float = 0.0
    """Gains of the frames that used the technique, summed with fading."""
    variance: float = 0.0
    """The same of their variances."""

    @property
    def is_resting(self) -> bool:
        """Whether frames use the plain samplers."""
        return self.left > 0

    @property
    def is_used(self) -> bool:
        """Whether it has shown that it gains."""
        return self.trial == 0

    @property
    def may_skip(self) -> bool:
        """Whether the frame need not be learnt from, if nothing moves."""
        return self.is_used and self.tried >= SETTLED and self.tried % 2 == 1

    def woken(self) -> Rest:
        """Return a trial in place of a rest, as lights began to move; the same where there were too many trials."""
        if not self.is_resting or self.credit < WAKING:
            return self
        return Rest(trial=WOKEN_TRIAL, longest=self.longest // 2, credit=self.credit - WAKING)  # sums begin anew

    def rested(self) -> Rest:
        """Return the rest after one more frame."""
        return replace(self, left=self.left - 1, credit=min(self.credit + 1, WAKING))

    def skipped(self) -> Rest:
        """Return what follows a frame that used the technique and left no samples."""
        return replace(self, tried=self.tried + 1)

    def judged(self, gain: float, variance: float, cost: float, moves: bool) -> Rest:
        """Return what follows a frame that used the technique.

        Args:
            gain: By how much the variance would be more without it.
            variance: That of the picture with it.
            cost: Time of a frame with it over that of one without.
            moves: Whether anything in the scene moves.
        """
        fading = LEARNING_FADING if self.trial > LATER_TRIAL else FADING
        known = replace(
            self,
            tried=self.tried + 1,
            gain=self.gain * fading + min(max(gain, -MOST_LOSS * variance), MOST_GAIN * variance),
            variance=self.variance * fading + variance,
        )
        needed = (cost - 1.0) * known.variance
        share = known.gain / needed if needed > 0.0 else 0.0
        if self.is_used:
            return known if share >= KEPT else known._resting(moves)
        if known.tried < self.trial:
            return known
        if share >= 1.0:
            return replace(known, trial=0, tried=0, longest=0)
        return known if share >= PROMISING and known.tried < 2 * self.trial else known._resting(moves)

    def _resting(self, moves: bool) -> Rest:
        longest = LONGEST_REST_MOVING if moves else LONGEST_REST
        frames = min(max(2 * self.longest, FIRST_REST), longest)
        return replace(self, left=frames, trial=LATER_TRIAL, tried=0, longest=frames)

    def saved_arrays(self) -> dict[str, np.ndarray]:
        """Return all numbers, float64, for a saved state."""
        return {"numbers": np.array([getattr(self, one.name) for one in fields(self)], np.float64)}

    def with_saved_arrays(self, arrays: Mapping[str, np.ndarray]) -> Rest:
        """Return the rest of a saved state."""
        kinds = (type(getattr(self, one.name)) for one in fields(self))
        numbers = arrays["numbers"]
        if numbers.shape != (len(fields(self)),) or not (np.abs(numbers) < MOST_NUMBER).all():
            raise ValueError(f"{numbers!r:.200} are not the numbers of a rest")
        return Rest(*(kind(value) for kind, value in zip(kinds, arrays["numbers"], strict=True)))


def rest_after(
    frame: Frame, lesson: Lesson | None, rest: Rest, rests: bool, gain: Literal["lights", "directions"], cost: float
) -> Rest:
    """Return what follows a frame: ``lesson`` are its samples, if any were kept, and ``cost`` is that of ``judged``.

    ``gain`` names the technique's in ``Gains``. One that never ``rests`` is not judged.
    """
    if rest.is_resting:
        return rest.rested()
    if lesson is None:
        return rest.skipped()
    if not rests:
        return rest
    gains = frame_gains(frame, lesson)
    return rest.judged(getattr(gains, gain), gains.variance, cost, frame.scene.is_animated)


def woken_by(frame: Frame, rest: Rest) -> Rest:
    """Return the rest for a frame, which ends if lights begin to move in it."""
    motion = frame.offered(Motion) if rest.is_resting else None
    return rest.woken() if motion is not None and motion.begins else rest


def wish_for_lesson(frame: Frame, rest: Rest) -> None:
    """Tell the octree whether the frame is learnt from."""
    wanted = frame.scene.is_animated or not rest.may_skip
    before = frame.offered(LessonWish)
    frame.offer(LessonWish(wanted or (before is not None and before.is_wanted)))
