"""Progress for programs: one JSON object a line on standard output, and all other lines on standard error.

Every object has "event". "frame" is a frame that is done, with "frame" (its number), "file", "seconds" (compilation of
kernels apart), "done" and "total" (frames of this run), "frames_per_minute" and "seconds_left"; with a cluster also
"worker". "end" is the last line, with "done", "total" and "seconds".
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from warp_gi.cli.report import Reporter


class JsonReporter(Reporter):
    """Progress of a run as lines of JSON on standard output; what is for people goes to standard error, or nowhere."""

    def __init__(self, quiet: bool = False) -> None:
        super().__init__(quiet, terminal=False)
        self._started = time.perf_counter()

    def line(self, text: str) -> None:
        """Print a line on standard error."""
        if not self.quiet:
            print(text, file=sys.stderr, flush=True)

    @contextmanager
    def bar(self, total: int) -> Iterator[None]:
        """Count ``total`` frames while the block runs; a line says at its end how many were done."""
        self._started = time.perf_counter()
        with super().bar(total):
            yield
        self._tell("end", done=self._done, total=total, seconds=round(time.perf_counter() - self._started, 3))

    def frame(self, text: str, seconds: float, index: int | None = None, path: Path | None = None, **more: str) -> None:
        """Tell of a finished frame."""
        self._count(seconds)
        rate, left = self.frames_per_minute, self.time_left()
        self._tell(
            "frame",
            frame=index,
            file=None if path is None else str(path),
            seconds=round(seconds, 3),
            done=self._done,
            total=self._total,
            frames_per_minute=None if rate is None else round(rate, 2),
            seconds_left=None if left is None else round(left, 1),
            **more,
        )

    def table(self, title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
        """Leave tables out."""

    def _tell(self, event: str, **values: object) -> None:
        print(json.dumps({"event": event, **values}), flush=True)
