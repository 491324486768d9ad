"""How benchmarks measure: contenders take turns in one process; wall, CPU and device seconds; peak memory.

Compilation never counts. On CUDA a contender's time is also taken by events on the device, which leave out what the
host does before and after.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar
from weakref import WeakSet

import numpy as np
import warp as wp

from warp_gi import launch

Row = dict[str, Any]
Series = Sequence[float] | np.ndarray
"""Numbers, one for each turn, frame or case: float [number]."""
Times = tuple[float, float]
"""Wall and CPU seconds."""
T = TypeVar("T")


# ---- time ----


@dataclass
class Taken(Generic[T]):
    """Seconds of the turns of one contender, and results of the first of them."""

    wall: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    device: list[float] = field(default_factory=list)
    """Seconds of each turn by events on a CUDA device; empty on the CPU."""
    results: list[T] = field(default_factory=list)

    @property
    def times(self) -> Times:
        """Medians."""
        return float(np.median(self.wall)), float(np.median(self.cpu))

    @property
    def counting(self) -> list[float]:
        """The seconds that count: the device's own on CUDA, else the CPU's, as others use some of the wall's."""
        return self.device or self.cpu

    @property
    def cost(self) -> float:
        """The median of the seconds that count."""
        return float(np.median(self.counting))

    def row(self, prefix: str = "") -> Row:
        """Return medians and spreads of wall, CPU and, on CUDA, device seconds."""
        kinds = {"wall s": self.wall, "cpu s": self.cpu} | ({"device s": self.device} if self.device else {})
        return {k: v for name, values in kinds.items() for k, v in median_and_spread(prefix + name, values).items()}

    def add(self, work: Callable[[], T], device: str, keep: int) -> None:
        """Do ``work`` once more; its result is kept if fewer than ``keep`` are."""
        result, (wall, cpu), on_device = clocked(work, device)
        self.wall.append(wall)
        self.cpu.append(cpu)
        if on_device is not None:
            self.device.append(on_device)
        if len(self.results) < keep:
            self.results.append(result)


def take_turns(
    contenders: Mapping[str, Callable[[int], T]],
    repetitions: int,
    device: str = "cpu",
    keep: int = 0,
    pause: float = 0.0,
    warm: bool = True,
    host: Collection[str] = (),
) -> dict[str, Taken[T]]:
    """Let each contender do its work ``repetitions`` times, one after the other in each round.

    They are called with the number of the round, from 1 on. ``warm`` calls each with 0 before, uncounted, which
    compiles and fills caches. ``pause`` seconds before a turn let the threads of the one before go to sleep. ``host``
    names those that run on the CPU whatever the device is.
    """
    if warm:
        for work in contenders.values():
            work(0)
    taken: dict[str, Taken[T]] = {name: Taken() for name in contenders}
    for index in range(1, repetitions + 1):
        for name, work in contenders.items():
            time.sleep(pause)
            taken[name].add(partial(work, index), "cpu" if name in host else device, keep)
    return taken


def clocked(work: Callable[[], T], device: str = "cpu") -> tuple[T, Times, float | None]:
    """Return the result of ``work``, its wall and CPU seconds, and on CUDA the seconds between events around it."""
    found = launch.get_device(device)
    events = [wp.Event(found, enable_timing=True) for _ in range(2)] if found.is_cuda else []
    wp.synchronize()
    compiled, wall = launch.compile_seconds, time.perf_counter()
    compiled_cpu, cpu = launch.compile_cpu_seconds, time.process_time()
    if events:
        found.stream.record_event(events[0])
    result = work()
    if events:
        found.stream.record_event(events[1])
    wp.synchronize()
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    compiled, compiled_cpu = launch.compile_seconds - compiled, launch.compile_cpu_seconds - compiled_cpu
    on_device = max(wp.get_event_elapsed_time(events[0], events[1]) / 1e3 - compiled, 0.0) if events else None
    return result, (wall - compiled, cpu - compiled_cpu), on_device


def timed(work: Callable[[], T]) -> tuple[T, Times]:
    """Return the result of ``work``, and its wall and CPU seconds."""
    return clocked(work)[:2]


def cost(times: Times, device: str) -> float:
    """Return the seconds that count: CPU seconds on a CPU, which other processes share; wall seconds on a GPU."""
    return times[1] if launch.get_device(device).is_cpu else times[0]


def median_and_spread(name: str, values: Series) -> Row:
    """Return the median of values, and as their spread half of the range of the middle half of them."""
    low, middle, high = np.percentile(values, (25, 50, 75))
    return {name: float(middle), f"{name} spread": float(high - low) / 2}


def ratio_and_spread(name: str, above: Series, below: Series) -> Row:
    """Return median and spread of ratios turn by turn, as what slows the machine for a while slows both sides."""
    return median_and_spread(name, np.asarray(above, np.float64) / np.asarray(below, np.float64))


def ratios(name: str, above: Taken[Any], below: Taken[Any]) -> Row:
    """Return ``ratio_and_spread`` of wall, CPU and, on CUDA, device seconds; ``name`` has {} for which of them."""
    kinds = ("wall", "cpu", "device") if above.device and below.device else ("wall", "cpu")
    pairs = ((kind, getattr(above, kind), getattr(below, kind)) for kind in kinds)
    return {k: v for kind, a, b in pairs for k, v in ratio_and_spread(name.format(kind), a, b).items()}


# ---- apart from the rest ----


def in_process(arguments: Sequence[str], **variables: str) -> Row:
    """Return the JSON object that a module of ours prints last, in a process of its own; {"failed": why} if it fails.

    ``arguments`` are a module and what it is given; ``variables`` are of its environment. It has as many threads as
    this process.
    """
    environment = {**os.environ, "WARP_GI_THREADS": str(launch.thread_count()), **variables}
    command = [sys.executable, "-m", *arguments]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    said, found = (text.strip().splitlines() for text in (done.stderr, done.stdout))
    if done.returncode or not found:
        return {"failed": said[-1] if said else f"exit code {done.returncode}, without a word"}
    return json.loads(found[-1])


def attempt(said: Row, work: Callable[[], list[Row]]) -> list[Row]:
    """Return the rows of ``work``, or if it fails the row ``said`` with why: the rest of a suite goes on."""
    try:
        return work()
    except Exception as error:
        if os.environ.get("WARP_GI_DEBUG", "0") != "0":
            traceback.print_exc()
        return [{**said, "failed": f"{type(error).__name__}: {' '.join(str(error).split())}"}]


# ---- memory ----


class PeakMemory:
    """The largest resident memory of this process since the object was made.

    Where the system cannot forget its peak (it is not Linux), it is the largest since the process began.
    """

    _live: ClassVar[WeakSet[PeakMemory]] = WeakSet()
    _seen: float

    def __init__(self) -> None:
        before = peak_memory()
        for other in PeakMemory._live:
            other._seen = max(other._seen, before)
        self._seen = 0.0
        self.is_anew = _forget_peak()
        """Whether the peak is that since the object was made, and not of the whole process."""
        PeakMemory._live.add(self)

    @property
    def bytes(self) -> float:
        """The peak so far."""
        return max(self._seen, peak_memory())

    def row(self) -> Row:
        """Return the peak in GB, and on CUDA that of Warp's memory pools since the process began."""
        found: Row = {"peak GB": self.bytes / 1e9}
        pools = [wp.get_mempool_used_mem_high(d) for d in wp.get_cuda_devices() if wp.is_mempool_enabled(d)]
        return found | ({"peak device GB": sum(pools) / 1e9} if pools else {})


def peak_memory() -> float:
    """Return the most bytes of memory this process has had resident, or since it was last made to forget."""
    try:
        status = Path("/proc/self/status").read_text(encoding="ascii")
        return 1024.0 * int(next(line for line in status.splitlines() if line.startswith("VmHWM")).split()[1])
    except (OSError, StopIteration):  # not Linux; a fork's getrusage may count its parent, which VmHWM does not
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1.0 if sys.platform == "darwin" else 1024.0)


def resident_memory() -> float:
    """Return the bytes of memory that this process has resident; the most it has had where that is not known."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
        return float(pages * os.sysconf("SC_PAGE_SIZE"))
    except OSError:
        return peak_memory()


def _forget_peak() -> bool:
    """Set the high-water mark to what is resident now; False where that cannot be done."""
    try:
        Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    except OSError:
        return False
    return True
