"""Threads that share the slices of a launch with the thread that launches; a fork or an interrupt leaves them usable.

The thread that launches works, too: no launch waits for a slice that nobody runs, even where no other thread is left,
as in a forked process. Locks, queue and threads are those that CPython makes in C. Between taking one of these locks
and the ``with`` block that gives it back no interrupt can strike; inside ``ThreadPoolExecutor`` and
``threading.Condition`` one can, and then the lock stays taken for ever.
"""

from __future__ import annotations

import _thread
import contextlib
import os
import threading
from collections.abc import Callable
from queue import SimpleQueue


class Slices:
    """The slices 0 to ``count`` - 1 of one launch; ``run`` is called once with each, on whichever thread is free."""

    def __init__(self, run: Callable[[int], None], count: int) -> None:
        self.error: BaseException | None = None
        """Exception of the first slice that failed on a worker, or None."""
        self.is_lost = False
        """Whether a fork copied this job, so that some of its slices were on workers that the copy does not have."""
        self._run = run
        self._next, self._count = 0, count
        self._workers = 0  # number of workers that are running a slice
        self._lock = threading.Lock()
        self._workers_at_it = threading.Lock()  # taken while there are any

    def work(self) -> None:
        """Run slices as a worker, as long as there are some; what one raises is kept for the thread that launches."""
        with self._lock:
            if self._next == self._count:
                return
            if self._workers == 0:
                self._workers_at_it.acquire()
            self._workers += 1
        try:
            self.run_all()
        except BaseException as error:
            with self._lock:
                self.error = self.error or error
                self._next = self._count
        finally:
            with self._lock:
                self._workers -= 1
                if self._workers == 0:
                    self._workers_at_it.release()

    def run_all(self) -> None:
        """Run one slice after the other until all are taken."""
        while True:
            with self._lock:
                index = self._next
                if index == self._count:
                    return
                self._next += 1
            self._run(index)

    def settle(self) -> None:
        """Give out no more slices, and wait for the workers in some; raises an interrupt of the wait after it."""
        interrupt: BaseException | None = None
        while True:
            try:
                with self._lock:
                    self._next = self._count
                with self._workers_at_it:
                    break
            except BaseException as error:  # workers write to the caller's arrays until they are done
                interrupt = error
        self._run = _nothing  # offers that no worker has looked at yet keep no arrays
        if interrupt is not None:
            raise interrupt

    def renew(self) -> None:
        """Make this usable in a process just forked, where nobody gives the locks back that workers held."""
        if self._workers:
            self.is_lost, self._workers, self._next = True, 0, self._count
        self._lock, self._workers_at_it = threading.Lock(), threading.Lock()


def _nothing(index: int) -> None:
    pass


_offers: SimpleQueue[Slices] = SimpleQueue()
_hired = 0
_hiring = threading.RLock()  # a signal's handler may launch, too
_open: set[Slices] = set()


def share(run: Callable[[int], None], count: int, threads: int) -> None:
    """Call ``run`` with 0 to ``count`` - 1 on up to ``threads`` threads, this one among them, and wait for all.

    When a call raises, or an interrupt comes, no further ones begin, and the exception leaves here once those
    begun have ended. Raises RuntimeError in a process that was forked in the middle of this.
    """
    slices = Slices(run, count)
    try:
        try:
            _open.add(slices)
            helpers = min(threads, count) - 1
            _hire(helpers)
            for _ in range(helpers):
                _offers.put(slices)
            slices.run_all()
        finally:
            slices.settle()
    finally:
        _open.discard(slices)
        slices.settle()  # a second interrupt may have ended the wait above
    if slices.is_lost:
        raise RuntimeError("this process was forked in the middle of a launch; its arrays are incomplete, launch again")
    if slices.error is not None:
        raise slices.error


def _hire(count: int) -> None:
    """Start workers until there are ``count``; fewer where the system gives no more threads."""
    global _hired
    if _hired >= count:
        return
    with _hiring, contextlib.suppress(RuntimeError):  # "can't start new thread": those that there are do the work
        while _hired < count:
            _thread.start_new_thread(_serve, (_offers,))
            _hired += 1


def _serve(offers: SimpleQueue[Slices]) -> None:
    while True:
        slices = offers.get()
        slices.work()
        del slices  # the slices hold the arrays of the launch


def _forget_workers() -> None:
    """Start afresh in a process just forked, which has none of its parent's threads."""
    global _offers, _hired, _hiring
    _offers, _hired, _hiring = SimpleQueue(), 0, threading.RLock()
    for slices in list(_open):
        slices.renew()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_workers)
