"""Loading of kernel modules: a lock for each, and threads that load what will be needed before it is waited for.

A module compiles in seconds and without the interpreter's lock, so several compile side by side, and while the scene is
loaded. Which thread loads a module decides nothing that a kernel computes. A fork waits until no thread is inside the
compiler; the child has none of the threads and nothing in the queue, and loads what it launches by itself.

Processes that share Warp's cache may compile one module at once: Warp builds it in a folder of the process and renames
that to its place, so the cache is whole always. Here the second one waits for the first, and loads what that compiled.
"""

from __future__ import annotations

import _thread
import contextlib
import logging
import math
import os
import threading
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import warp as wp

from warp_gi import shipped

try:
    import fcntl
except ImportError:  # Windows: two processes may compile one module, as Warp has it
    fcntl = None  # type: ignore[assignment]

HEADER_SECONDS, MODULE_SECONDS = 1.5, 2.0
"""CPU seconds of Warp's header, once a thread, and of a module: for the estimate that a message gives."""
MOST_THREADS = 4
"""Largest number of threads that load ahead: each compiles Warp's header for itself."""
FLAG = "-DWP_NO_BFLOAT16="
"""Flag that leaves two fifths of Warp's header out. No kernel here uses ``wp.bfloat16``."""
_PACKAGE = "warp_gi.kernels."
_LOG = logging.getLogger("warp_gi")

_lock = threading.RLock()  # of what is below; never waited for with a module's lock taken
_locks: dict[str, threading.RLock] = {}  # by module
_queue: list[Job] = []  # modules that no thread has begun, in order
_jobs: dict[str, Job] = {}  # modules that a thread has begun or will
_threads = 0


class Job:
    """A module that a thread will load; ``done`` is taken until it has."""

    def __init__(self, kernel: wp.Kernel, load: Callable[[wp.Kernel], None]) -> None:
        self.kernel, self.name = kernel, kernel.module.name
        self._load = load
        self.done = _thread.allocate_lock()
        self.done.acquire()

    def run(self) -> None:
        """Load the module. An error is left to whoever launches the kernel: loading it again raises it again."""
        try:
            with contextlib.suppress(Exception):
                self._load(self.kernel)
        finally:
            self.done.release()


def lock_of(module: str) -> threading.RLock:
    """Return the lock of a module, to be held while it is loaded."""
    with _lock:
        return _locks.setdefault(module, threading.RLock())


def prepare(module: Any) -> None:
    """Set the flags of a module of this package before it is hashed; flags that somebody set stay.

    They are those of compiled kernels that came with the package, if one of them is this module.
    """
    if not module.name.startswith(_PACKAGE) or module.options["cpu_compiler_flags"] is not None:
        return
    if not shipped.bring(module, FLAG):
        module.options["cpu_compiler_flags"] = f"{wp.config.cpu_compiler_flags or shipped.NATIVE} {FLAG}"
        module.mark_modified()


def uncached(kernels: Iterable[wp.Kernel]) -> list[wp.Kernel]:
    """Return the kernels whose modules have no folder in Warp's cache, and so have to be compiled for the CPU."""
    folder = Path(wp.config.kernel_cache_dir or "")
    return [one for one in kernels if not (folder / one.module.get_module_identifier(1)).is_dir()]


@contextlib.contextmanager
def alone(kernel: wp.Kernel, block: int) -> Iterator[None]:
    """Keep other processes from compiling a module, for ``block`` threads a block, that is not in Warp's cache yet.

    Where files cannot be locked nothing is kept from anyone.
    """
    folder, is_ours = Path(wp.config.kernel_cache_dir or ""), kernel.module.name.startswith(_PACKAGE)
    name = kernel.module.get_module_identifier(block) if is_ours else ""
    if fcntl is None or not name or not folder.is_dir() or (folder / name).is_dir():
        yield
        return
    path = folder / f".{name}.compiling"
    with contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):  # a read-only cache, or a disk without locks
            file = held.enter_context(open(path, "ab"))
            fcntl.flock(file, fcntl.LOCK_EX)  # the system lets go of it however the process ends
        yield
        path.unlink(missing_ok=True)  # who waits for it has it open


def load_ahead(kernels: Iterable[wp.Kernel], load: Callable[[wp.Kernel], None], threads: int) -> None:
    """Begin to load modules on up to ``threads`` threads, in order; those in the queue and not among them are left out.

    ``load`` loads one. What has to be compiled is said in one line, with an estimate of the time.
    """
    modules = list({one.module.name: one for one in kernels}.values())
    with _lock:
        known = {name for name, job in _jobs.items() if job not in _queue}
        was_queued = {job.name for job in _queue}
    for one in modules:
        prepare(one.module)
    fresh = [one for one in modules if one.module.name not in known]
    missing = uncached(fresh)  # hashes them all: what is compiled later has no say in that
    threads = min(threads, MOST_THREADS, max(len(missing), 1))
    if missing and not was_queued:
        seconds = math.ceil((HEADER_SECONDS * threads + MODULE_SECONDS * len(missing)) / threads)
        plural = "s" * (len(missing) > 1)
        _LOG.info(
            "compiling kernels for the first time: %d module%s, about %d s; kept in %s for next time",
            len(missing),
            plural,
            seconds,
            wp.config.kernel_cache_dir,
        )
    with _lock:
        _give_up()
        if not threading.main_thread().is_alive():  # its end has been waited for: nobody loads ahead any more
            return
        _queue[:] = [Job(one, load) for one in fresh if one.module.name not in _jobs]
        _jobs.update({job.name: job for job in _queue})
    _hire(threads)


def _give_up() -> None:
    """Take all out of the queue; who waits for one of them loads it."""
    for job in _queue:
        del _jobs[job.name]
        job.done.release()
    _queue.clear()


def wait_for(module: str) -> None:
    """Wait until a thread has loaded a module, if one has begun or there is one that will, next of all."""
    with _lock:
        job = _jobs.get(module)
        if job is not None and job in _queue:
            _queue.remove(job)
            if _threads == 0:
                del _jobs[module]
                job.done.release()
                return
            _queue.insert(0, job)
    if job is not None:
        with job.done:
            pass


def _hire(count: int) -> None:
    """Start threads until there are ``count``, but for those that the system refuses."""
    global _threads
    for _ in range(count):
        with _lock:
            if _threads >= count or not _queue:
                return
            _threads += 1
        try:
            threading.Thread(target=_serve, name="warp_gi loading").start()  # the process waits for it at its end
        except RuntimeError:  # "can't start new thread": who launches a kernel loads it
            with _lock:
                _threads -= 1
            return


def _serve() -> None:
    """Load modules until there are no more, or the main thread has ended."""
    global _threads
    while True:
        with _lock:
            if not threading.main_thread().is_alive():
                _give_up()
            if not _queue:
                _threads -= 1
                return
            job = _queue.pop(0)
        job.run()
        with _lock:
            if _jobs.get(job.name) is job:
                del _jobs[job.name]


_held: list[threading.RLock] = []


def _hold() -> None:
    """Wait until no thread loads, and let none begin."""
    _lock.acquire()
    for lock in _locks.values():
        lock.acquire()
        _held.append(lock)


def _let_go() -> None:
    while _held:
        _held.pop().release()
    _lock.release()


def _start_afresh() -> None:
    """Have free locks, no threads and an empty queue in a process just forked."""
    global _lock, _threads
    _lock, _threads = threading.RLock(), 0
    _held.clear()
    _locks.clear()
    _queue.clear()
    _jobs.clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_hold, after_in_parent=_let_go, after_in_child=_start_afresh)
