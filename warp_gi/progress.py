"""A line that says how far rendering and baking are: on a terminal, and in a notebook, without further packages."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TextIO

from warp_gi.errors import OptionError

Progress = Callable[[str, float], None]
"""What is called with (stage, share done in [0, 1])."""

SECONDS = 0.1
"""Seconds between two writes of the line, at least."""
WIDTH = 30
"""Characters of the bar."""


class ProgressLine:
    """A line that is written over and over.

    Args:
        frames: Number of frames that will be rendered; 0 is none, where something is baked alone.
        stream: Where it is written; None is stderr, where that is a terminal or a notebook's: nothing is written else.
    """

    def __init__(self, frames: int = 0, stream: TextIO | None = None) -> None:
        shows = stream is not None or _is_terminal() or is_notebook()
        self._stream = (stream or sys.stderr) if shows else None
        self._frames, self._done, self._length = frames, 0, 0
        self._written = -SECONDS

    def __call__(self, stage: str, share: float) -> None:
        """Show how far a stage is; "trace" that is done ends a frame."""
        is_frame = stage == "trace" and share >= 1.0
        self._done += is_frame
        now = time.monotonic()
        if now - self._written >= SECONDS or is_frame:
            self._written = now
            self._write(self.text(stage, share))

    def text(self, stage: str, share: float) -> str:
        """Return the line: a bar over all frames, or over the stage where there are none."""
        within = share if stage == "trace" and share < 1.0 else 0.0
        whole = (self._done + within) / self._frames if self._frames else share
        filled = round(WIDTH * min(max(whole, 0.0), 1.0))
        count = f" {self._done}/{self._frames} frames" if self._frames else ""
        return f"[{'#' * filled}{' ' * (WIDTH - filled)}]{count}  {stage} {100 * share:.0f} %"

    def close(self) -> None:
        """Leave the last line standing, and begin another one below it."""
        if self._stream is not None and self._length:
            self._stream.write("\n")
            self._stream.flush()
            self._length = 0

    def _write(self, text: str) -> None:
        if self._stream is not None:
            self._stream.write("\r" + text.ljust(self._length))
            self._stream.flush()
            self._length = len(text)


@contextmanager
def shown(progress: Progress | bool | None, frames: int = 0) -> Iterator[Progress | None]:
    """Give what is to be called for ``progress``: itself, or a line where it is True, which ends with the block.

    Raises OptionError for what cannot be called.
    """
    if progress is None or progress is False:
        yield None
    elif progress is True:
        line = ProgressLine(frames)
        try:
            yield line
        finally:
            line.close()
    elif callable(progress):
        yield progress
    else:
        raise OptionError(f"progress must be True, or be called with (stage, share done), got {progress!r:.80}")


def is_notebook() -> bool:
    """Return whether a notebook's kernel runs this program, which shows what is written over a line as a terminal."""
    shell = getattr(sys.modules.get("IPython"), "get_ipython", lambda: None)()
    return type(shell).__name__ == "ZMQInteractiveShell"


def _is_terminal() -> bool:
    return sys.stderr is not None and sys.stderr.isatty()
