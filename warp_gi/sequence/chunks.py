"""Parts of a sequence, each rendered by a process of its own, with the frames that one process would make.

Frames that do not depend on each other are dealt out in turns: part 2 of 3 takes the frames in the places 2, 5, 8, so
that parts take as long as each other. Frames that do are cut into runs. What the first frame of a run needs is found in
a state file of another part, or rendered and thrown away: from the first frame of the sequence, which is exact, or
from some frames before it, which is not, and is written into the files.
"""

from __future__ import annotations

import copy
import glob
import logging
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warp_gi.errors import OptionError, whole_number
from warp_gi.sequence.banded import BandedFrame
from warp_gi.sequence.resume import Output, Plan, SequenceRun, Shot, why_restart

if TYPE_CHECKING:
    from warp_gi.frame import Frame
    from warp_gi.scheduler import FrameScheduler

WARM_UP = "warm_up"
"""Name in the metadata of frames for the number of frames that were rendered and thrown away before their part."""
WARM_UP_ERROR = "warm_up_error"
"""Name among what files tell as measured, see ``PartRun``."""
MOST_CHUNKS = 1_000_000
_LOG = logging.getLogger("warp_gi")


@dataclass(frozen=True)
class Chunk:
    """One of several parts into which a sequence is cut.

    Raises OptionError for a number out of range.
    """

    number: int
    """Number of the part, from 1."""
    count: int
    """Number of parts."""
    warm_up: int | None = None
    """Number of frames before the part's first one that are rendered and thrown away, where frames depend on those
    before; None is all of them, which is exact."""

    def __post_init__(self) -> None:
        number, count = whole_number("chunk numbers", self.number), whole_number("chunk counts", self.count)
        if not 1 <= number <= count <= MOST_CHUNKS:
            raise OptionError(f"a chunk must be I/N with I from 1 to N, and N at most 1,000,000, got {number}/{count}")
        if self.warm_up is not None and whole_number("warm-up", self.warm_up) < 0:
            raise OptionError(f"warm-up must be a number of frames, 0 or above, got {self.warm_up}")

    @classmethod
    def named(cls, name: str | tuple[int, int], warm_up: int | None = None) -> Chunk:
        """Return the chunk of a text as "3/16", or of a pair as (3, 16); raises OptionError for anything else."""
        if isinstance(name, str):
            found = re.fullmatch(r"\s*(\d{1,9})\s*/\s*(\d{1,9})\s*", name)
            if not found:
                raise OptionError(f"a chunk must be I/N, as 3/16 for the third of sixteen, got {name!r:.40}")
            return cls(int(found[1]), int(found[2]), warm_up)
        if not isinstance(name, tuple) or len(name) != 2:
            raise OptionError(f"a chunk must be text as '3/16' or a pair as (3, 16), got {name!r:.40}")
        return cls(*name, warm_up)

    @property
    def name(self) -> str:
        """The name of the part's state file, as "chunk-3-of-16"."""
        return f"chunk-{self.number}-of-{self.count}"

    def places(self, length: int, in_turns: bool) -> range:
        """Return which of ``length`` frames are in the part: every N-th, or a run whose length differs by 1 at most."""
        if in_turns:
            return range(self.number - 1, length, self.count)
        return range((self.number - 1) * length // self.count, self.number * length // self.count)


def chunk_of(name: str | tuple[int, int] | None, warm_up: int | None = None, frame_time: object = None) -> Chunk | None:
    """Return the part that ``--chunk`` and ``--warm-up`` ask for, None for the whole sequence.

    Raises OptionError for a text that names none, and for what does not go with parts.
    """
    if not name:
        if warm_up is not None:
            raise OptionError("a warm-up is of a part of a sequence; give a chunk as 3/16 too")
        return None
    if frame_time:
        raise OptionError(
            "a frame's time and a chunk exclude each other: each part would time other frames and take other samples; "
            "give samples a pixel (spp)"
        )
    return Chunk.named(name, warm_up)


def run_of(scheduler: FrameScheduler, shots: Sequence[Shot], output: Output, chunk: Chunk | None = None) -> SequenceRun:
    """Return what renders a whole sequence to files, or the part of it that ``chunk`` says."""
    return SequenceRun(scheduler, shots, output) if chunk is None else ChunkRun(scheduler, shots, output, chunk)


class PartRun(SequenceRun):
    """Renders some frames of a sequence to files as ``SequenceRun`` renders all: each is equal to the last bit.

    Args:
        scheduler: What renders; it has rendered no frame yet.
        shots: All frames of the sequence, in order.
        output: Where their files go. Its ``part`` names this part's state file.
        places: Those to render, as their places in ``shots``: a run without gaps if frames depend on those before.
        warm_up: Number of frames to render and throw away in place of all frames before, which is not exact. Files then
            have it in their metadata; and the file of the part's first frame has the difference of its picture from
            that with half of these frames: the RMSE over the mean (``measured/warm_up_error``).
    """

    def __init__(
        self,
        scheduler: FrameScheduler,
        shots: Sequence[Shot],
        output: Output,
        places: range,
        warm_up: int | None = None,
    ) -> None:
        super().__init__(scheduler, shots, output)
        self._places, self._warm_up = places, warm_up
        self._before: list[Shot] = []  # to render and throw away
        self._compared: tuple[Shot, np.ndarray] | None = None  # the part's first frame after half of the warm-up

    def plan(self, resume: bool = True) -> Plan:
        """Return which frames of the part are to be rendered, and find the state from which they go on."""
        self._check_resumable(resume)
        dependence, places = self.dependence, self._places
        if not dependence.on_past:
            own = [self.shots[place] for place in places]
            problems = self._problems(own, resume)
            return Plan(tuple(own), tuple(shot for shot in own if not resume or shot.index in problems), problems)
        begin = self._begin
        line = self.with_lineages(self.shots[begin : places.stop])
        before, own = line[: places.start - begin], line[places.start - begin :]
        problems = self._problems(own, resume)
        gap = next((place for place, shot in enumerate(own) if not resume or shot.index in problems), None)
        if gap is None:
            return Plan(tuple(own), (), dependence=dependence)
        known = self._load_state(line[: len(before) + gap])
        todo = own[max(known - len(before), 0) :]
        self._before, restart = before[known:], ""
        if resume and gap and len(todo) == len(own):
            restart = why_restart(dependence)
            _LOG.info("every frame is rendered again: %s", restart)
        return Plan(tuple(own), tuple(todo), problems, restart, dependence)

    def lead(self) -> None:
        """Render the frames before the first one of the plan that no saved state knows, and throw them away."""
        if not self._before:
            return
        first, last = self._before[0].index, self._before[-1].index
        _LOG.info("rendered and thrown away, before the part: frames %d to %d", first, last)
        if self._is_warmed_up:
            self._compared = self._after_half()
        for shot in self._before:
            self.scheduler.frame(shot.index, shot.previous)
        self._before = []

    def render(self, shot: Shot) -> Frame | BandedFrame:
        """Render a frame of the plan's ``todo`` and write its file; see ``SequenceRun.render``."""
        self.lead()
        return super().render(shot)

    def _rendered(self, shot: Shot) -> Frame:
        frame = super()._rendered(shot)
        if self._compared is not None and self._compared[0].index == shot.index:
            frame.measured[WARM_UP_ERROR] = relative_rmse(frame.numpy("beauty"), self._compared[1])
            self._compared = None
            _LOG.info(
                "warm-up: frame %d differs by %.2g of its mean from one with half of the frames before it",
                shot.index,
                frame.measured[WARM_UP_ERROR],
            )
        return frame

    def _after_half(self) -> tuple[Shot, np.ndarray]:
        """Return the part's first frame, and its picture after half of the frames before it."""
        shot, other = self.shots[self._places.start], copy.copy(self.scheduler)
        count = len(self._before)
        for one in self._before[count - count // 2 :]:
            other.frame(one.index, one.previous)
        return shot, other.frame(shot.index, shot.previous).numpy("beauty").copy()

    @property
    def _begin(self) -> int:
        """Place of the first frame that counts."""
        return 0 if self._warm_up is None else max(self._places.start - self._warm_up, 0)

    @property
    def _is_warmed_up(self) -> bool:
        """Whether frames are not those of the whole sequence: they depend on some before that are left out."""
        return bool(self.dependence.on_past) and self._begin > 0

    def _origin(self, shot: Shot) -> dict[str, str | int | float]:
        more = {WARM_UP: self._warm_up} if self._warm_up is not None and self._is_warmed_up else {}
        return super()._origin(shot) | more

    def _state_paths(self) -> list[Path]:
        """Return the state files of this part, of the others and of the whole sequence: lineages tell what fits."""
        folder, stem = self.output.pattern.parent, glob.escape(self.output.stem)
        others = folder.glob(f"{stem}.*-of-*.state.safetensors")
        paths = {*others, self.output.state_path, replace(self.output, part="").state_path}
        return sorted(path for path in paths if path.exists())


class ChunkRun(PartRun):
    """Renders a chunk of a sequence: which frames are in it follows from how they depend on each other."""

    def __init__(self, scheduler: FrameScheduler, shots: Sequence[Shot], output: Output, chunk: Chunk) -> None:
        SequenceRun.__init__(self, scheduler, shots, output)
        places = chunk.places(len(shots), not self.dependence.on_past)
        super().__init__(scheduler, shots, replace(output, part=chunk.name), places, chunk.warm_up)


def relative_rmse(picture: np.ndarray, other: np.ndarray) -> float:
    """Return the root of the mean square difference of two pictures over the mean of the first; 0 of black ones."""
    picture, other = picture.astype(np.float64), other.astype(np.float64)
    mean = float(np.abs(picture).mean())
    return float(np.sqrt(np.square(picture - other).mean())) / mean if mean else 0.0
