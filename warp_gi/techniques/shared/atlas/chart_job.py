"""Runs ``chart_worker.py`` in a process of its own: xatlas cannot be interrupted, a process can be ended."""

from __future__ import annotations

import contextlib
import importlib.util
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from warp_gi.errors import OptionError

SHARE = "share"
"""First word of a line of the worker that tells the share that is done."""
WORKER = Path(__file__).with_name("chart_worker.py")
"""The program."""
START = """import sys
sys.path = [path for path in sys.path if path]
import runpy
sys.path += [path for path in sys.argv[4:] if path not in sys.path]
runpy.run_path(sys.argv[1], run_name="__main__")"""
"""Runs the program that is its first argument, with neither its folder nor the current one among those to import from:
a file there that is named as a module would be taken for it. Arguments from the fourth on are folders to import from,
after all others."""

Progress = Callable[[float], None]
"""Called with the share of the work that is done."""


class ChartJob:
    """The jobs of one atlas, which share a limit of CPU seconds; 0 is no limit.

    The worker has the system end it after so much CPU time. Where the system cannot, as on Windows, wall time counts.
    """

    def __init__(self, seconds: float, otherwise: str = "") -> None:
        self.limit = seconds
        self.otherwise = otherwise
        """What can be done without charts, as the end of an error's advice; "" if nothing can."""
        self.used = 0.0
        """CPU seconds of the jobs so far."""

    def run(self, job: dict[str, np.ndarray], progress: Progress | None = None) -> dict[str, np.ndarray]:
        """Return the worker's result for a job; raises OptionError where the limit is over, or the worker fails."""
        left = max(self.limit - self.used, 1e-3) if self.limit > 0.0 else 0.0
        with tempfile.TemporaryDirectory(prefix="warp_gi_charts_") as name:
            folder = Path(name)
            np.savez(folder / "job.npz", **job)  # type: ignore[arg-type]
            code, is_late, complaint = _worked_off(folder, left, progress)
            if code == 0:
                with np.load(folder / "result.npz") as result:
                    arrays = dict(result)
                self.used += float(arrays.pop("seconds"))
                return arrays
        if is_late:
            raise OptionError(
                f"xatlas took longer than chart_seconds={self.limit:g} to make charts; "
                + self.advice("give chart_seconds more or 0 (no limit)", 'take the meshes\' own uv (charts="own")')
            )
        raise OptionError(
            f"making charts by xatlas failed ({complaint or f'exit code {code}'}); "
            + self.advice('take the meshes\' own uv (charts="own")')
        )

    def advice(self, *ways: str) -> str:
        """Return several ways out, and ``otherwise``, as "one, another, or a third"."""
        *first, last = [*ways, *filter(None, [self.otherwise])]
        return f"{', '.join(first)}, or {last}" if first else last


def _worked_off(folder: Path, seconds: float, progress: Progress | None) -> tuple[int, bool, str]:
    """Run the worker on a folder; return its exit code, whether it ran out of time, and its last complaint."""
    command = [sys.executable, "-c", START, str(WORKER), str(folder), repr(seconds), *_package_folders()]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True) as process:
        complaints: list[str] = []
        listener = threading.Thread(target=lambda: complaints.extend(process.stderr or ()), daemon=True)
        listener.start()
        try:
            with _clock(process, seconds) as is_late:
                for line in process.stdout or ():
                    words = line.split()
                    if progress is not None and len(words) == 2 and words[0] == SHARE:  # xatlas may print others
                        progress(float(words[1]))
                code = process.wait()
        except BaseException:
            process.kill()
            raise
        finally:
            listener.join()
    late = is_late.is_set() or (seconds > 0.0 and code == -getattr(signal, "SIGPROF", 0))
    return code, code != 0 and late, complaints[-1].strip() if complaints else ""


def _package_folders() -> list[str]:
    """Return the folders from which this process imports what the worker needs, which another may not know."""
    found = (importlib.util.find_spec(name) for name in ("numpy", "xatlas"))
    folders = [path.parent for path in (Path(one.origin) for one in found if one and one.origin)]
    return [str(folder.parent if (folder / "__init__.py").is_file() else folder) for folder in folders]


@contextlib.contextmanager
def _clock(process: subprocess.Popen[str], seconds: float) -> Iterator[threading.Event]:
    """End the process after so much wall time, unless it is 0 or the system counts CPU time; yield whether it did."""
    is_late = threading.Event()
    if seconds == 0.0 or hasattr(signal, "setitimer"):
        yield is_late
        return

    def end() -> None:
        is_late.set()
        process.kill()

    timer = threading.Timer(seconds, end)
    timer.start()
    try:
        yield is_late
    finally:
        timer.cancel()
