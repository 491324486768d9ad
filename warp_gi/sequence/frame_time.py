"""Samples a pixel by the time that a frame may take.

Few frames along the sequence are timed at half their width and height. The number that is found holds for all frames,
and is in their metadata: a resumed sequence takes it from there, and has the same pixels.
"""

from __future__ import annotations

import logging
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from warp_gi.errors import OptionError, SceneError
from warp_gi.pipeline import MOST_SAMPLES
from warp_gi.sequence.frames import read_frame
from warp_gi.sequence.resume import SequenceRun, Shot

if TYPE_CHECKING:
    from warp_gi.frame import Frame
    from warp_gi.scheduler import FrameScheduler

TRIALS = 3
"""Number of frames that are timed with one sample a pixel; the slowest decides."""
SMALLER = 2
"""Share of the width and the height at which frames are timed."""
LONGEST = 1e6
"""The longest time that a frame may be given, in seconds."""
_LOG = logging.getLogger("warp_gi")
_UNITS = {"": 1.0, "s": 1.0, "ms": 1e-3, "min": 60.0}


def parse_seconds(text: str) -> float:
    """Return the seconds of "0.5s", "500ms", "2min" or "0.5"; raises OptionError for anything else."""
    found = re.fullmatch(r"\s*(\d+\.?\d*|\.\d+)\s*(\w*)\s*", text)
    if not found or found[2] not in _UNITS:
        raise OptionError(f"a frame's time must be seconds, as 0.5s, 500ms or 2min, got {text!r:.40}")
    return check_seconds(float(found[1]) * _UNITS[found[2]])


def check_seconds(seconds: float) -> float:
    """Return the seconds that a frame may take; raises OptionError unless they are above 0 and at most 1e6."""
    if isinstance(seconds, bool) or not isinstance(seconds, int | float) or not 0 < seconds <= LONGEST:
        raise OptionError(f"a frame's time must be a number of seconds above 0 and at most 1e6, got {seconds!r:.40}")
    return float(seconds)


def take_time(run: SequenceRun, seconds: float, resume: bool = False) -> int:
    """Let a run's frames take as many samples a pixel as fit into ``seconds``; return their number.

    It is one for all frames. With ``resume`` it is that of the frames that are there, if they were given as long.
    """
    seconds = check_seconds(seconds)
    run.bake()
    known = _samples_of_files(run, seconds) if resume else None
    samples = known or samples_within(run.scheduler, run.shots, seconds)
    run.scheduler.take_samples(samples, seconds)
    return samples


def samples_within(scheduler: FrameScheduler, shots: Sequence[Shot], seconds: float) -> int:
    """Return how many samples a pixel the slowest of a few frames can take within ``seconds``, 1 at least.

    Numbers are doubled until the time is over, and the last two interpolated. Time to write a file is not in it.
    """
    places = sorted({round(k * (len(shots) - 1) / (TRIALS - 1)) for k in range(TRIALS)})
    times = {place: _frame_seconds(scheduler, shots[place], 1) for place in places}
    slowest = shots[max(times, key=lambda place: times[place])]
    few, least = 1, max(times.values())
    if least > seconds:
        _LOG.info(
            "1 sample a pixel takes about %.3g s a frame, more than the %.3g s given: ask for fewer pixels",
            least,
            seconds,
        )
        return 1
    while few < MOST_SAMPLES:
        many = min(2 * few, MOST_SAMPLES)
        most = _frame_seconds(scheduler, slowest, many)
        if most > seconds:
            return few + math.floor((many - few) * max(0.0, min(1.0, (seconds - least) / (most - least))))
        few, least = many, most
    return few


def _frame_seconds(scheduler: FrameScheduler, shot: Shot, samples: int) -> float:
    """Return the wall seconds of a frame at its full size, by a smaller one that follows the frame before it."""
    width, height = shot.camera.resolution
    size = max(width // SMALLER, 1), max(height // SMALLER, 1)
    frame = scheduler.trial(shot.index, shot.previous, samples, size)
    return _seconds_of(frame) * (width * height) / (size[0] * size[1])


def _seconds_of(frame: Frame) -> float:
    return sum(seconds for stage, seconds in frame.timings.items() if stage not in ("bake", "compile"))


def _samples_of_files(run: SequenceRun, seconds: float) -> int | None:
    """Return the samples a pixel of a file that is as this run would write it, but for them; None if there is none."""
    for shot in run.shots:
        try:
            metadata = read_frame(shot.path).metadata
        except (SceneError, OptionError):  # missing or torn
            continue
        given, samples = metadata.get("frame_time"), int(metadata.get("pipeline.spp", 0))
        if given is None or not math.isclose(float(given), seconds, rel_tol=1e-6) or samples < 1:  # files have float32
            continue
        alike = replace(shot, lineage=str(metadata.get("lineage", "")))
        if run.with_samples(samples, seconds).is_done(alike):
            return samples
    return None
