"""Sequences that go on where they stopped: which frames are there, which are to be rendered, and from which state.

A frame's file is kept if it is whole and says that it was made with just the settings of this run. Where frames depend
on those before (``Dependence``), a file also has to have come from the same frames before it: its *lineage* is a hash
over all that decides it and them. What such a sequence knows after its last frame lies in a state file beside the
frames; where that cannot hold everything, or does not fit, the sequence is rendered from its first frame again.

Lines about what is kept, and why it is not, are logged (logger "warp_gi", level INFO).
"""

from __future__ import annotations

import contextlib
import copy
import hashlib
import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from warp_gi.baking import settings_in
from warp_gi.errors import BakeError, OptionError, unknown_name
from warp_gi.files import check_target, check_writable, frame_path, remove_stale_parts, user_path, writing_under
from warp_gi.scene.camera import Camera, CameraPath, frame_time
from warp_gi.sequence.banded import BandedFrame, render_in_bands
from warp_gi.sequence.exr import Attribute
from warp_gi.sequence.frames import (
    frame_attributes,
    read_frame,
    why_not_whole,
    write_frame,
    write_preview,
)
from warp_gi.sequence.lock import Claim
from warp_gi.sequence.preview import check_exposure, preview_exposure
from warp_gi.sequence.state import Dependence

if TYPE_CHECKING:
    from warp_gi.frame import Frame
    from warp_gi.scheduler import FrameScheduler

MISSING = "missing"
PRECISIONS = ("half", "float")
_LOG = logging.getLogger("warp_gi")


@dataclass(frozen=True)
class Output:
    """Files of a sequence: where they go, and how they are stored.

    Raises OptionError for a kind of file that frames cannot be, or an unknown precision.
    """

    pattern: Path
    """An .exr or .png file; the last run of # in its name becomes the frame's number."""
    precision: Literal["half", "float"] = "half"
    """Storage of colours and normals in EXR files."""
    preview: bool = False
    """Whether a tone-mapped PNG is written beside each EXR file."""
    exposure: float = 0.0
    """Exposure of PNG files in stops."""
    part: str = ""
    """Name of the part of a sequence that is rendered, which has a state file of its own; "" is the whole sequence."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "pattern", user_path(self.pattern))
        if self.pattern.suffix.lower() not in (".exr", ".png"):
            raise OptionError(f"cannot write {self.pattern.name}: frames are .exr or .png files")
        check_exposure(self.exposure)
        if self.precision not in PRECISIONS:
            raise unknown_name("precision", self.precision, PRECISIONS)

    @property
    def is_exr(self) -> bool:
        """Whether files say how they were made, so that a sequence can be resumed."""
        return self.pattern.suffix.lower() == ".exr"

    @property
    def state_path(self) -> Path:
        """File beside the frames that keeps what the sequence knows after its last frame."""
        part = f".{self.part}" if self.part else ""
        return self.pattern.with_name(f"{self.stem}{part}.state.safetensors")

    @property
    def stem(self) -> str:
        """Name of the frames' files without their numbers."""
        return self.pattern.stem.replace("#", "").strip("._-") or "frames"

    def write(self, frame: Frame, path: Path) -> None:
        """Write the preview, then the frame: a whole frame has its preview. Raises OSError."""
        if not self.is_exr:
            write_preview(frame, path, self.exposure)
            return
        if self.preview:
            write_preview(frame, path.with_suffix(".png"), self.exposure)
        write_frame(frame, path, self.precision)


@dataclass(frozen=True)
class Shot:
    """A frame of a sequence, and its file."""

    index: int
    """Number of the frame."""
    previous: int
    """Number of the frame that motion is towards."""
    path: Path
    """File of the frame."""
    time: float
    """Time of the frame in seconds from the first one."""
    camera: Camera
    """Camera of the frame."""
    previous_camera: Camera
    """Camera of the frame that motion is towards."""
    lineage: str = ""
    """Hash of all that decides this frame and those before it; "" where it does not depend on them."""


@dataclass(frozen=True)
class Plan:
    """The frames of a sequence that are left to render, and why."""

    shots: tuple[Shot, ...]
    """All frames that were asked for, in order."""
    todo: tuple[Shot, ...]
    """Frames to render, in order."""
    problems: Mapping[int, str] = field(default_factory=dict)
    """Reason, by frame number, why a file cannot be kept: "missing", "not whole", "seed is 1 instead of 2"."""
    restart: str = ""
    """Reason why the sequence is rendered from its first frame though some are there; "" if it is not."""
    dependence: Dependence = Dependence((), ())
    """Dependence of the frames on those before them."""

    @property
    def done(self) -> tuple[Shot, ...]:
        """Frames that are kept, in order."""
        wanted = {shot.index for shot in self.todo}
        return tuple(shot for shot in self.shots if shot.index not in wanted)

    @property
    def frames(self) -> tuple[int, ...]:
        """Numbers of the frames to render, in order."""
        return tuple(shot.index for shot in self.todo)

    @property
    def missing(self) -> tuple[int, ...]:
        """Numbers of the frames without a file, in order."""
        return tuple(index for index, problem in self.problems.items() if problem == MISSING)

    def reason(self, index: int) -> str:
        """Return in words why frame ``index`` is rendered; "" for one that is kept, or was not asked for."""
        if index not in self.frames:
            return ""
        if index in self.problems or self.restart or not self.problems:
            return self.problems.get(index) or self.restart or "files that are there are not to be kept"
        numbers = [shot.index for shot in self.shots]
        is_after = numbers.index(index) > numbers.index(next(iter(self.problems)))
        return "a frame before it is rendered again" if is_after else "the saved state is of a frame before it"


def check_frames(frames: Sequence[int], pattern: Path) -> None:
    """Raise OptionError for several frames that would go to one file."""
    if len(set(frames)) < len(frames):
        twice = sorted(index for index in set(frames) if list(frames).count(index) > 1)
        raise OptionError(f"frame {twice[0]} is asked for twice, and both would go to one file; ask once")
    if len(frames) > 1 and "#" not in pattern.name:
        raise OptionError(f"{len(frames)} frames cannot all go to {pattern}; put #### in the name")


def shots_of(camera: Camera | CameraPath, frames: Sequence[int], pattern: str | Path) -> list[Shot]:
    """Return frames of a camera in order, each with the file that it goes to.

    Raises OptionError for a negative number, or several frames that would go to one file.
    """
    pattern = Path(pattern)
    check_frames(frames, pattern)
    at = camera.camera if isinstance(camera, CameraPath) else lambda index: camera
    previous = [max(frames[0] - 1, 0), *frames] if frames else []
    return [
        Shot(index, before, frame_path(pattern, index), frame_time(camera, index), at(index), at(before))
        for index, before in zip(frames, previous, strict=False)
    ]


class SequenceRun:
    """Renders a sequence to files: plan first, then ``prepare``, then ``render`` and ``save_state`` frame by frame.

    Args:
        scheduler: What renders; it has rendered no frame yet.
        shots: The frames, in order.
        output: Where their files go.
    """

    def __init__(self, scheduler: FrameScheduler, shots: Sequence[Shot], output: Output) -> None:
        self.scheduler, self.shots, self.output = scheduler, tuple(shots), output
        self._claim: Claim | None = None
        self.since = 0
        """Time in ns, by the clock of the disk, from which on files are kept by a resumed run; 0 is any time."""
        self.permit: Path | None = None
        """File of the claim on what is written (``Claim.path``): without it no file appears. None asks for none."""

    def bake(self) -> None:
        """Bake under the sky of the sequence's first frame, so that a resumed sequence has the same bake.

        Edits are taken over first: raises SceneError for one that cannot be followed.
        """
        with self.scheduler.scene.lock:
            self.scheduler.scene.check_unchanged()
            self.scheduler.bake(self.shots[0].time, len(self.shots))

    @cached_property
    def dependence(self) -> Dependence:
        """Dependence of the frames on those before them."""
        self.bake()
        return self.scheduler.dependence([shot.index for shot in self.shots])

    def plan(self, resume: bool = True) -> Plan:
        """Return which frames are to be rendered; the scheduler then goes on from the saved state, if one is needed.

        Without ``resume`` that is every frame. Raises OptionError for files that do not say how they were made.
        """
        self._check_resumable(resume)
        dependence, shots = self.dependence, self.with_lineages(self.shots)
        problems = self._problems(shots, resume)
        if not resume:
            return Plan(tuple(shots), tuple(shots), dependence=dependence)
        todo, restart = [shot for shot in shots if shot.index in problems], ""
        if todo and len(todo) < len(shots) and dependence.on_past:
            gap = next(place for place, shot in enumerate(shots) if shot.index in problems)
            todo = shots[self._load_state(shots[:gap]) :]
            if len(todo) == len(shots):
                restart = why_restart(dependence)
                _LOG.info("every frame is rendered again: %s", restart)
        return Plan(tuple(shots), tuple(todo), problems, restart, dependence)

    def _check_resumable(self, resume: bool) -> None:
        if resume and not self.output.is_exr:
            raise OptionError("resume needs .exr files, which say how they were made; a .png does not")

    def with_lineages(self, shots: Sequence[Shot]) -> list[Shot]:
        """Return frames that follow each other with their lineages, where they depend on those before."""
        found, lineage = [], ""
        for shot in shots:
            if self.dependence.on_past:
                lineage = self._lineage(shot, lineage)
                shot = replace(shot, lineage=lineage)
            found.append(shot)
        return found

    def _problems(self, shots: Sequence[Shot], resume: bool) -> dict[int, str]:
        """Return why files cannot be kept, by frame number; nothing without ``resume``, which keeps none."""
        if not resume:
            return {}
        found = {shot.index: self.problem(shot) for shot in shots}
        problems = {index: problem for index, problem in found.items() if problem is not None}
        for shot in shots:
            if problems.get(shot.index, MISSING) != MISSING:
                _LOG.info("%s is rendered again: %s", shot.path, problems[shot.index])
        return problems

    def prepare(self, plan: Plan) -> None:
        """Write previews that kept frames lack, make the folder, and remove what a killed run left there.

        Until ``finish`` no other process may write the same files. Raises OSError now, not after an hour's work, if
        nothing can be written, OptionError if another process is writing them.
        """
        for shot in plan.done:
            preview = shot.path.with_suffix(".png")
            if self.output.preview and preview_exposure(preview) != self.output.exposure:
                write_preview(read_frame(shot.path), preview, self.output.exposure)
        if plan.todo:
            check_writable(self.output.pattern.parent)
            has_state = plan.dependence.is_saved and self.output.is_exr and not self.output.part
            self._claim = Claim(self.output.pattern, plan.frames, has_state)
            self._claim.take()
            self.permit = self._claim.path.absolute() if self._claim.is_taken else None
            remove_stale_parts(self.output.state_path)
        for shot in plan.todo:
            check_target(shot.path)
        if plan.done:
            _LOG.info("%d of %d frames are there already", len(plan.done), len(plan.shots))

    def lead(self) -> None:
        """Render what the first frame of the plan needs and is not in it: nothing, but in a part of a sequence."""

    def finish(self) -> None:
        """Let other processes write the files again."""
        if self._claim is not None:
            self._claim.release()

    def with_samples(self, spp: int, frame_time: float) -> SequenceRun:
        """Return the same run with another number of samples a pixel, to ask about files."""
        scheduler = copy.copy(self.scheduler)
        scheduler.take_samples(spp, frame_time)
        return SequenceRun(scheduler, self.shots, self.output)

    def is_done(self, shot: Shot) -> bool:
        """Return whether the file of a frame is whole, and as this run would write it."""
        return self.problem(shot) is None

    def problem(self, shot: Shot) -> str | None:
        """Return why the file of a frame cannot be kept, in a few words; None if it can."""
        found = why_not_whole(shot.path, self._attributes(shot), shot.camera)
        if found is None and shot.path.stat().st_mtime_ns < self.since:
            return "of an earlier run"
        return found

    def render(self, shot: Shot) -> Frame | BandedFrame:
        """Render a frame of the plan's ``todo`` and write its file; the time it took is the frame's timing "write".

        A picture that is larger than it may is rendered in bands, and what is returned reads its file.
        """
        remove_stale_parts(shot.path)
        if self.scheduler.rows < shot.camera.resolution[1]:
            with writing_under(self.permit):
                where = shot.index, shot.previous, shot.path
                return render_in_bands(self.scheduler, *where, self.output, self._origin(shot))
        frame = self._rendered(shot)
        frame.metadata |= self._origin(shot)
        started = time.perf_counter()
        with writing_under(self.permit):
            self.output.write(frame, shot.path)
        frame.timings["write"] = time.perf_counter() - started
        return frame

    def _rendered(self, shot: Shot) -> Frame:
        return self.scheduler.frame(shot.index, shot.previous)

    def save_state(self, shot: Shot, frame: Frame | BandedFrame) -> None:
        """Save the state after a frame, if later frames depend on it and a file can hold it all.

        Seconds are added to the frame's timings as "save state".
        """
        if self.dependence.is_saved and self.output.is_exr:  # nothing resumes from other files
            started = time.perf_counter()
            with writing_under(self.permit):
                self.scheduler.save_state(self.output.state_path, shot.lineage)
            frame.timings["save state"] = time.perf_counter() - started

    def _attributes(self, shot: Shot) -> dict[str, Attribute]:
        """Return what a frame's file has to say, under the sky of that frame."""
        with self.scheduler.scene.lock:
            metadata = self.scheduler.metadata(shot.time)
        metadata |= self._origin(shot)
        return frame_attributes(
            shot.index, shot.time, shot.camera, metadata, shot.previous_camera, self.output.precision
        )

    def _origin(self, shot: Shot) -> dict[str, str | int | float]:
        """Return metadata that say on which frames a frame depends."""
        return {"lineage": shot.lineage} if shot.lineage else {}

    def _lineage(self, shot: Shot, before: str) -> str:
        """Return a hash of all that decides a frame and those before it, whose hash is ``before``."""
        attributes = self._attributes(replace(shot, lineage=""))
        return hashlib.sha256(f"{before}{shot.camera.resolution}{attributes}".encode()).hexdigest()

    def _load_state(self, whole: Sequence[Shot]) -> int:
        """Let the scheduler go on from a saved state; return the number of frames that need not be rendered again."""
        places = {shot.lineage: place for place, shot in enumerate(whole)}
        found: list[tuple[int, Path]] = []
        for path in self._state_paths() if self.dependence.is_saved and whole else ():
            with contextlib.suppress(BakeError):  # damaged, or another program's
                lineage = settings_in(path).get("lineage")
                if lineage in places:
                    found.append((places[str(lineage)], path))
        for place, path in sorted(found, reverse=True):
            with contextlib.suppress(BakeError):  # damaged, or of other settings
                self.scheduler.bake(whole[place].time)  # the state is of a frame under that sky
                self.scheduler.load_state(path, whole[place].lineage)
                return place + 1
        return 0

    def _state_paths(self) -> list[Path]:
        """Return the state files from which the sequence may go on."""
        return [self.output.state_path] if self.output.state_path.exists() else []


def why_restart(dependence: Dependence) -> str:
    """Return why every frame is rendered again where some are there already."""
    words = {"denoiser": "the denoiser"}
    places = [name.partition(".")[0] for name in dependence.unsaved or dependence.on_past]
    names = [words.get(place, f"the {place} light") for place in places]
    reason = "" if dependence.unsaved else "no saved state fits, and "
    return f"{reason}{' and '.join(names)} depend{'s' * (len(names) == 1)} on the frames before"
