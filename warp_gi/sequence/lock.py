"""A claim on files of a sequence, so that no other process writes the same ones.

Each process that writes has a small file beside the frames, locked (flock) as long as it lives: the system lets go of
it however the process ends, in a container too. What nobody holds is removed by the next one. A file without which no
frame gets its name: so workers of a cluster whose run has ended write nothing over the frames of the next one, nor does
a process whose lock another machine could not see.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import json
import os
import socket
import time
import uuid
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from warp_gi.errors import OptionError

try:
    import fcntl
except ImportError:  # Windows: nothing is claimed there
    fcntl = None  # type: ignore[assignment]


IN_THE_MAKING = 60.0
"""Seconds for which a claim without its name yet is left alone."""


class Claim:
    """What a process is going to write: frames of a pattern, and whether they need each other.

    Args:
        pattern: Where frames go, with # in the place of their numbers.
        frames: Their numbers.
        is_whole: Whether frames depend on those before, so that the sequence has a state file of its own.

    ``take`` raises OptionError if a living process writes some of them, and names it; ``release`` gives up.
    """

    def __init__(self, pattern: Path, frames: Iterable[int], is_whole: bool) -> None:
        self.pattern = pattern
        self._about: dict[str, Any] = {
            "pattern": pattern.name,
            "frames": sorted(frames),
            "is_whole": is_whole,
            "process": os.getpid(),
            "host": socket.gethostname(),
            "started": time.time(),
            "name": uuid.uuid4().hex[:12],
        }
        self._file: int | None = None

    @property
    def path(self) -> Path:
        """The file of the claim."""
        return self.pattern.with_name(f"{self._prefix}{self._about['name']}.lock")

    @property
    def is_taken(self) -> bool:
        """Whether the claim is there for others to see; not so on disks without locks."""
        return self._file is not None

    @property
    def _prefix(self) -> str:
        return f".{self.pattern.name.replace('#', '_')}."

    def take(self) -> None:
        """Claim the files. Of two that claim at one time the later one fails."""
        if fcntl is None or self._file is not None:
            return
        part = self.path.with_suffix(".claim")
        file = os.open(part, os.O_CREAT | os.O_RDWR, 0o666)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:  # a file system without locks
            os.close(file)
            part.unlink(missing_ok=True)
            return
        about = json.dumps(self._about).encode()
        try:
            if os.write(file, about) != len(about):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.replace(part, self.path)  # nobody sees it before it is locked
        except OSError as error:
            os.close(file)
            part.unlink(missing_ok=True)
            raise OSError(error.errno, f"nothing can be written here ({error.strerror})", str(part.parent)) from error
        self._file = file
        for other in self._others():
            if self._is_against(other):
                self.release()
                since = time.strftime("%H:%M:%S", time.localtime(other["started"]))
                raise OptionError(
                    f"process {other['process']} on {other['host']!r} has been writing to {self.pattern} since {since};"
                    " wait for it, stop it, or give another output or other frames"
                )

    def release(self) -> None:
        """Give the files up. A second time does nothing."""
        if self._file is not None:
            with contextlib.suppress(FileNotFoundError):
                self.path.unlink()
            os.close(self._file)
            self._file = None

    def _others(self) -> Iterator[dict[str, Any]]:
        """Yield what other living processes claim, and remove what dead ones left."""
        for path in sorted(self.pattern.parent.glob(f"{glob.escape(self._prefix)}*")):
            if path.suffix not in (".lock", ".claim") or path == self.path:
                continue
            with contextlib.suppress(OSError, ValueError):  # gone, or of a process that is ending
                if path.suffix == ".claim" and time.time() - path.stat().st_mtime < IN_THE_MAKING:
                    continue
                file = os.open(path, os.O_RDWR)
                try:
                    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    path.unlink()
                except BlockingIOError:
                    about = json.loads(os.read(file, 1 << 24))
                    if path.suffix == ".lock" and about["pattern"] == self.pattern.name:
                        if self._published(path) <= self._published(self.path):  # it may not have seen this claim
                            yield about
                finally:
                    os.close(file)

    @staticmethod
    def _published(path: Path) -> tuple[int, str]:
        """Return when a claim was given its name, by the clock of the file system."""
        return path.stat().st_ctime_ns, path.name

    def _is_against(self, other: dict[str, Any]) -> bool:
        both_whole = bool(other["is_whole"] and self._about["is_whole"])
        return both_whole or not set(other["frames"]).isdisjoint(self._about["frames"])
