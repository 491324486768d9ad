"""Hands frames out to the workers of a Dask scheduler, and says what comes back.

Dask decides which worker gets which frame, and gives the frames of a worker that is killed to others. What is here is
who may render (``admit``), how many frames are under way at once, and what is said when something fails.
"""

from __future__ import annotations

import contextlib
import logging
import os
import queue
import time
import uuid
import warnings
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

from warp_gi.baking import Bake
from warp_gi.cluster.identity import Identity
from warp_gi.cluster.job import Job, SceneSource
from warp_gi.errors import OptionError, one_line
from warp_gi.kept import BakeFolder
from warp_gi.sequence.frames import FrameFile, read_frame
from warp_gi.sequence.resume import Plan, SequenceRun

ANSWER_SECONDS = 10.0
"""Seconds for which a scheduler is waited for."""
PATIENCE_SECONDS = 120.0
"""Seconds for which workers are asked again, if one after another dies meanwhile."""
LOOK_SECONDS = 2.0
"""Seconds between two looks at which workers there are."""
_LOG = logging.getLogger("warp_gi")


def dask() -> Any:
    """Return the module ``distributed``; raises OptionError if it is not installed."""
    try:
        import distributed
    except ImportError:
        raise OptionError("a cluster needs Dask distributed: pip install 'warp-gi[cluster]'") from None
    return distributed


@contextlib.contextmanager
def connected(cluster: object) -> Iterator[Any]:
    """Yield a Dask client of a cluster: a client, an object with a scheduler's address, or that address.

    Raises OptionError for anything else, OSError if no scheduler answers.
    """
    distributed = dask()
    if isinstance(cluster, distributed.Client):
        yield cluster
        return
    address = getattr(cluster, "scheduler_address", cluster)
    if not isinstance(address, str) or not address:
        raise OptionError(f"a cluster must be a dask.distributed.Client or the address of one, got {cluster!r:.80}")
    try:
        client = distributed.Client(address, timeout=ANSWER_SECONDS, set_as_default=False)
    except (OSError, TimeoutError) as error:
        raise OSError(
            f"no Dask scheduler answers at {address} ({one_line(error, 'no answer')}); start one by `dask scheduler`, "
            "or correct the address"
        ) from None
    except ValueError as error:
        raise OptionError(f"{address!r} is no address as tcp://10.0.0.1:8786 ({one_line(error)})") from None
    with client:
        yield client


def job_of(
    run: SequenceRun,
    plan: Plan,
    scene: SceneSource,
    bakes: Sequence[Bake | Path],
    cache: BakeFolder | str | Path | None,
    resume: bool,
) -> Job:
    """Return a job of a run that is planned and prepared: its folder is there."""
    scheduler = run.scheduler
    output = replace(run.output, pattern=run.output.pattern.absolute())
    with TemporaryFile(dir=output.pattern.parent) as file:
        now = os.fstat(file.fileno()).st_mtime_ns
    return Job(
        name=f"warp_gi-{uuid.uuid4().hex[:12]}",
        identity=Identity.mine(),
        scene=scene,
        camera=scheduler.camera,
        pipeline=scheduler.pipeline,
        frames=tuple(shot.index for shot in run.shots),
        output=output,
        device=scheduler.device.alias,
        seed=scheduler.seed,
        bakes=tuple(bakes),
        cache=cache,
        about=tuple(sorted(scheduler.metadata(run.shots[0].time).items())),
        depends=bool(plan.dependence.on_past),
        since=0 if resume else now,
        memory=scheduler.memory,
        permit=run.permit,
    )


class Cluster:
    """Workers that render the frames of a job.

    Args:
        client: A Dask client.
        job: What is rendered.
    """

    def __init__(self, client: Any, job: Job) -> None:
        self.client, self.job = client, job
        self.workers: set[str] = set()
        """Addresses of the workers that may render."""
        self._refused: set[str] = set()
        self._looked = -LOOK_SECONDS
        self._said_none = False
        self._waiting: deque[int] = deque()
        self._flying: dict[str, tuple[int, Any]] = {}
        self._finished: queue.Queue[Any] = queue.Queue()
        self._shared: Any = None
        self._tries = 0

    def render(self, places: Sequence[int]) -> Iterator[Any]:
        """Yield a ``Done`` for each frame, as they come; frames that depend on those before are rendered one by one.

        Raises OptionError for a frame that no worker can render, OSError for one that failed, or if the scheduler goes
        away: finished frames stay in their files.
        """
        self._waiting = deque(places)
        try:
            self.look()
            self._send_job()
            while self._waiting or self._flying:
                while self._waiting and len(self._flying) < self.most_at_once:
                    self._send(self._waiting.popleft())
                with contextlib.suppress(queue.Empty):
                    future = self._finished.get(timeout=LOOK_SECONDS)
                    done = self._result(future) if future.key in self._flying else None
                    if done is not None:
                        del self._flying[future.key]
                        yield done
                self.look()
        finally:
            if self.client.status == "running":  # the scheduler has not gone
                self.client.cancel([self._shared, *(future for _, future in self._flying.values())], force=True)

    def _send_job(self) -> None:
        from warp_gi.cluster.worker import same

        self._tries += 1
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Sending large graph")  # a scene, once
            name = f"{self.job.name}-job-{self._tries}"
            self._shared = self.client.submit(same, self.job, key=name, resources={self.job.identity.resource: 1e-3})

    def _send(self, place: int) -> None:
        from warp_gi.cluster.worker import render_place

        name = f"{self.job.name}-{self.job.frames[place]}-{self._tries}"
        resources = {self.job.identity.resource: 1}
        future = self.client.submit(render_place, self._shared, place, key=name, resources=resources)
        self._flying[future.key] = place, future
        future.add_done_callback(self._finished.put)

    def _send_again(self) -> None:
        """Send frames anew that no worker has, though there are some.

        Dask asks for a task's resource when a worker comes, which has it a moment later: a task that had to wait for a
        worker, as all had died, would wait for ever.
        """
        taken = {key for keys in self._ask(self.client.processing).values() for key in keys}
        lost = [key for key, (_, future) in self._flying.items() if key not in taken and future.status == "pending"]
        if not lost or not self.workers or self._shared.key in taken:
            return
        dropped = [self._flying.pop(key) for key in lost]
        self._waiting.extendleft(place for place, _ in reversed(dropped))
        self.client.cancel([future for _, future in dropped], force=True)
        self._send_job()

    @property
    def most_at_once(self) -> int:
        """Number of frames to be under way: one that is rendered and one that waits a worker; 1 in a chain."""
        return 1 if self.job.depends else 2 * max(len(self.workers), 1)

    def look(self) -> None:
        """See which workers there are, not more often than every 2 s; a line names those that cannot be used."""
        if time.monotonic() - self._looked < LOOK_SECONDS:
            return
        known = set(self._ask(lambda: self.client.scheduler_info(n_workers=-1)["workers"]))
        fresh = sorted(known - self.workers - self._refused)
        told: dict[str, Any] = {}
        if fresh:
            told = self._ask(lambda: self.client.run(Identity.mine, workers=fresh, on_error="return"))
        self._looked = time.monotonic()
        self.workers &= known
        for address, found in told.items():
            if isinstance(found, OSError | TimeoutError):  # it has just died
                continue
            if isinstance(found, Identity):
                problem = self.job.identity.differences(found)
            else:
                problem = one_line(found, type(found).__name__)
            (self._refused if problem else self.workers).add(address)
            if problem:
                _LOG.info("worker %s is not used: it has %s", address, problem)
        self._admit([address for address in told if address in self.workers])
        if self._flying:
            self._send_again()
        if not self.workers and not self._said_none:
            self._said_none = True
            _LOG.info("no worker that can render is there; waiting for one (dask worker %s)", self._address)

    def _admit(self, workers: Sequence[str]) -> None:
        """Give workers one of the resource that a frame takes."""
        from warp_gi.cluster.worker import admit

        if workers:
            run, resource = self.client.run, self.job.identity.resource
            self._ask(lambda: run(admit, resource, workers=workers, on_error="return"))

    def _ask(self, call: Callable[[], Any]) -> Any:
        """Return what a call returns, again if a worker dies meanwhile; raises OSError if the scheduler is gone."""
        began = connected = time.monotonic()
        while True:
            problem = ""
            try:
                if self.client.status == "running":
                    connected = time.monotonic()
                    return call()
            except (OSError, TimeoutError) as error:  # also of a worker that dies while it is asked
                problem = one_line(error, type(error).__name__)
            now = time.monotonic()
            if self.client.status == "closed" or (not problem and now - connected > ANSWER_SECONDS):
                raise self._gone()
            if now - began > PATIENCE_SECONDS:
                raise OSError(f"the Dask scheduler's workers cannot be asked ({problem}); finished frames are kept")
            time.sleep(0.1)

    @property
    def _address(self) -> str:
        return str(self.client.scheduler.address) if self.client.scheduler is not None else "ADDRESS"

    def _gone(self) -> OSError:
        return OSError("the Dask scheduler has gone; finished frames are kept, --resume renders the others")

    def _result(self, future: Any) -> Any:
        """Return what a worker said of a frame; None if it died before it was asked, and another one is at it.

        Raises OptionError or OSError for a frame that failed.
        """
        frame = self.job.frames[self._flying[future.key][0]]
        if future.status == "finished":
            try:
                done = future.result(timeout=LOOK_SECONDS)
            except TimeoutError:
                done = None
            if done is None:
                future.add_done_callback(self._finished.put)
                return None
            if not done.problem:
                return done
            told = f"frame {frame} failed on worker {done.worker} ({done.host}): {done.problem}"
            raise OptionError(told) if done.is_mistake else OSError(told)
        if future.status == "error":
            error = future.exception()
            last = getattr(getattr(error, "last_worker", None), "address", "")
            if last:
                raise OSError(
                    f"frame {frame} failed: {error.allowed_failures + 1} workers died with it, at last {last}; has it "
                    "enough memory?"
                )
            raise OSError(f"frame {frame} failed: {type(error).__name__}: {one_line(error)}")
        if future.status == "cancelled":
            raise self._gone()
        future.add_done_callback(self._finished.put)
        return None


def frames_on(cluster: object, run: SequenceRun, plan: Plan, job: Job) -> Iterator[FrameFile]:
    """Yield the frames of a plan in order, read from their files, while workers render."""
    todo = {shot.index for shot in plan.todo}
    shots = list(run.shots)
    places = [place for place, shot in enumerate(shots) if shot.index in todo]
    there: set[int] = set()
    left = deque(places)
    with connected(cluster) as client:
        for done in Cluster(client, job).render(places):
            there.add(done.place)
            while left and left[0] in there:
                yield read_frame(shots[left.popleft()].path)
