"""What workers do: one frame at a time, written to its file where it is made.

A worker opens a job once, and keeps it until it gets another one. Where frames depend on those before, it goes on from
what it rendered last if that was the frame before, else from the state file beside the frames.
"""

from __future__ import annotations

import copy
import os
import threading
import time
from dataclasses import dataclass
from typing import Any

from distributed import get_worker

from warp_gi import launch
from warp_gi.cluster.identity import host
from warp_gi.cluster.job import Job
from warp_gi.errors import GiError, is_mistake, one_line
from warp_gi.files import remove_stale_parts
from warp_gi.sequence.chunks import PartRun
from warp_gi.sequence.resume import SequenceRun


@dataclass(frozen=True)
class Done:
    """A frame that is in its file, or the reason why it is not."""

    place: int
    """Place of the frame among those of the job."""
    worker: str
    """Address of the worker."""
    host: str
    """Name of its machine."""
    seconds: float = 0.0
    """Wall seconds, compilation of kernels apart; 0 for a file that was there already."""
    problem: str = ""
    """What went wrong, in one line; "" if nothing did."""
    is_mistake: bool = False
    """Whether another try would fail, too."""


async def admit(resource: str, dask_worker: Any) -> None:
    """Give a worker that makes the same frames one of the resource that a frame takes: so it gets one at a time.

    It is no plugin: Dask would load that on workers that have no warp_gi, and on those of later jobs.
    """
    await dask_worker.set_resources(**{resource: 1.0})


class _Bench:
    """What this process has open: a job, its run before the first frame, and where it stands."""

    def __init__(self, job: Job) -> None:
        self.job, self.run = job, job.begin()
        if job.depends:
            self.run.shots = tuple(self.run.with_lineages(self.run.shots))
            remove_stale_parts(job.output.state_path)
        self.live: tuple[str, SequenceRun] | None = None  # lineage of the frame rendered last, and what goes on from it

    def render(self, place: int) -> bool:
        """Render a frame and write it, and the state after it; return False if it is there already."""
        shot = self.run.shots[place]
        if self.run.is_done(shot):
            return False
        run = self._run_to(place) if self.job.depends else self.run
        self.live = None
        frame = run.render(shot)
        run.save_state(shot, frame)
        self.live = shot.lineage, run
        return True

    def _run_to(self, place: int) -> SequenceRun:
        """Return a run that stands before a frame that depends on those before."""
        if self.live is not None and place and self.live[0] == self.run.shots[place - 1].lineage:
            return self.live[1]
        part = PartRun(copy.copy(self.run.scheduler), self.run.shots, self.job.output, range(place, place + 1))
        part.since, part.permit = self.job.since, self.job.permit
        part.plan()
        return part


_turn = threading.Lock()  # a worker of several threads takes them all for one frame
_open: list[_Bench] = []


def render_place(job: Job, place: int) -> Done:
    """Render a frame of a job on this worker, unless its file is there, and say how it went."""
    worker = get_worker()
    with _turn:
        if "WARP_GI_THREADS" not in os.environ:
            launch.set_threads(worker.state.nthreads)
        try:
            if not _open or _open[0].job.name != job.name:
                _open.clear()
                _open.append(_Bench(job))
            started, compiled = time.perf_counter(), launch.compile_seconds
            is_new = _open[0].render(place)
            seconds = time.perf_counter() - started - (launch.compile_seconds - compiled)
            return Done(place, worker.address, host(), seconds if is_new else 0.0)
        except Exception as error:
            told = str(error) if isinstance(error, GiError | OSError) else f"{type(error).__name__}: {error}"
            return Done(place, worker.address, host(), 0.0, one_line(told), is_mistake(error))


def same(job: Job) -> Job:
    """Return a job, for Dask to keep: workers fetch it from each other."""
    return job
