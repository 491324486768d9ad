"""Output of commands: a progress bar on a terminal, plain lines elsewhere, tables, or nothing."""

from __future__ import annotations

import ctypes
import logging
import math
import os
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar

import warp as wp

from warp_gi import kernel_cache, launch

LINE_SECONDS = 10.0
RECENT = 8
"""Number of last frames by which the pace is told."""
LOG_WIDTH, LONGEST_WORD, GAP = 200, 24, 3
"""Characters in a table's line where no terminal limits it, in the longest unbroken word, and between columns."""
_M_MMAP_THRESHOLD = -3
_LARGE_BLOCK = 1 << 20


class Reporter:
    """Progress of a run on standard output.

    Args:
        quiet: Print nothing at all.
        terminal: Draw a bar; None asks standard output whether it is a terminal.
    """

    def __init__(self, quiet: bool = False, terminal: bool | None = None) -> None:
        self.quiet = quiet
        self.terminal = not quiet and (sys.stdout.isatty() if terminal is None else terminal)
        self._bar: Any = None
        self._task: Any = None
        self._total = self._done = 0
        self._seconds: list[float] = []
        self.at_once = 1
        """Number of frames that are rendered side by side."""
        self._begin_frame()
        log = logging.getLogger("warp_gi")
        log.handlers[:] = [_Lines(self)]
        log.setLevel(logging.INFO)

    def line(self, text: str) -> None:
        """Print a line, above the bar if there is one."""
        if self.quiet:
            return
        if self._bar is not None:
            self._bar.console.print(text, markup=False, highlight=False, soft_wrap=True)
        else:
            print(text, flush=True)

    @contextmanager
    def phase(self, name: str) -> Iterator[None]:
        """Show that ``name`` is under way: a spinner on a terminal, a line with its seconds elsewhere."""
        started = time.perf_counter()
        if self.terminal and self._bar is None:
            from rich.console import Console

            with Console().status(name):
                yield
        else:
            yield
        self.line(f"{name}: {time.perf_counter() - started:.1f} s")

    @contextmanager
    def shares(self, name: str) -> Iterator[Callable[[float], None]]:
        """Yield a function that takes the share of ``name`` done, and shows it: a bar, or a line every 10 s or more."""
        started = told = time.perf_counter()
        if self.terminal:
            from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

            columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
            with Progress(*columns, transient=True) as shown:
                task = shown.add_task(name, total=1.0)
                yield lambda share: shown.update(task, completed=share)
        else:

            def tell(share: float) -> None:
                nonlocal told
                now = time.perf_counter()
                if now - told > LINE_SECONDS and share < 1.0:
                    left = f", {_clock((now - started) / share * (1.0 - share))} left" if share else ""
                    self.line(f"{name} {share:.0%}{left}")
                    told = now

            yield tell
        self.line(f"{name}: {time.perf_counter() - started:.1f} s")

    @contextmanager
    def bar(self, total: int) -> Iterator[None]:
        """Show progress over ``total`` frames while the block runs."""
        self._total, self._done, self._seconds = total, 0, []
        self._begin_frame()
        if not self.terminal:
            yield
            return
        from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

        columns = (
            BarColumn(),
            MofNCompleteColumn(),
            TextColumn("frames"),
            TimeElapsedColumn(),
            TextColumn("{task.fields[pace]}"),
            TextColumn("{task.fields[left]}"),
            TextColumn("{task.description}", style="dim"),
        )
        with Progress(*columns) as self._bar:
            self._task = self._bar.add_task("", total=total, left="", pace="")
            launch.on_load = lambda module: self.stage(f"compile {module}", 0.0)
            try:
                yield
            finally:
                launch.on_load = None
                self._bar.update(self._task, description="")
                self._bar = None

    def stage(self, name: str, share: float) -> None:
        """Show how far into the current frame the run is; called often, cheap."""
        if self._bar is not None:
            inside = share if name == "trace" else 0.0
            shown = f"{name} {share:.0%}" if share else name
            left = self.time_left(inside)
            self._bar.update(
                self._task,
                completed=self._done + 0.99 * inside,
                description=shown,
                left="" if left is None else f"{_clock(left)} left",
            )

    def frame(self, text: str, seconds: float, index: int | None = None, path: Path | None = None, **more: str) -> None:
        """Report a finished frame that took ``seconds``, compilation apart: its number, file and what else is known."""
        self._count(seconds)
        left, rate = self.time_left(), self.frames_per_minute
        pace = f"{rate:.3g} frames a minute" if rate else ""
        if self._bar is not None:
            self._bar.update(self._task, completed=self._done, left=f"{_clock(left or 0)} left", pace=pace)
        else:
            rest = f", {pace}, {_clock(left)} left" if left else ""
            self.line(f"[{self._done}/{self._total}] {text}{rest}")

    def _count(self, seconds: float) -> None:
        self._done += 1
        self._seconds.append(seconds)
        self._begin_frame()

    @property
    def frames_per_minute(self) -> float | None:
        """Frames a minute, by the mean of the last frames, compilation apart; None before there is one."""
        recent = sum(self._seconds[-RECENT:])
        return 60.0 * self.at_once * len(self._seconds[-RECENT:]) / recent if recent else None

    def time_left(self, share: float = 0.0) -> float | None:
        """Return an estimate of the seconds left, or None before there is one.

        The mean of the last frames, or the ``share`` done of the first, times the frames to go; compilation apart.
        """
        inside = time.perf_counter() - self._frame_started - (launch.compile_seconds - self._compiled)
        if self._seconds:
            recent = self._seconds[-RECENT:]
            return max(sum(recent) / len(recent) * (self._total - self._done) / self.at_once - inside, 0.0)
        return inside / share * (self._total - share) if share else None

    def _begin_frame(self) -> None:
        self._frame_started, self._compiled = time.perf_counter(), launch.compile_seconds

    def table(self, title: str, columns: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
        """Print a table; numbers are set to the right."""
        if not self.quiet:
            print_table(title, columns, rows)


class _Lines(logging.Handler):
    """Prints what the library logs, as lines of a reporter."""

    def __init__(self, reporter: Reporter) -> None:
        super().__init__()
        self.reporter = reporter

    def emit(self, record: logging.LogRecord) -> None:
        self.reporter.line(record.getMessage())


def print_table(
    title: str, columns: Sequence[str], rows: Iterable[Sequence[object]], names: Sequence[int] = (0,)
) -> None:
    """Print a table on standard output, plain enough for a log file.

    One that is wider than the terminal, or than ``LOG_WIDTH`` elsewhere, is parted, so that no number is broken; each
    part begins with the columns ``names``, as far as these fill half of a line.
    """
    from rich import box
    from rich.console import Console
    from rich.table import Table

    texts = [[cell_text(value) for value in row] for row in rows]
    cells = [[row[index] for row in texts] for index in range(len(columns))]
    numeric = [any(map(_is_number, column)) for column in cells]
    widths = [_least_width(*one) for one in zip(columns, cells, numeric, strict=True)]
    console = Console(width=None if sys.stdout.isatty() else LOG_WIDTH, markup=False, highlight=False, emoji=False)
    parts = []
    for part in _parts(widths, names, console.width):
        table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
        room = console.width - sum(widths[index] + GAP for index in part)
        for index in part:
            more = max(min(max(map(len, (columns[index], *cells[index]))) - widths[index], room), 0)
            room -= more
            justify: Literal["left", "right"] = "right" if numeric[index] else "left"
            table.add_column(columns[index], justify=justify, overflow="fold", width=widths[index] + more)
        for row in texts:
            table.add_row(*(row[index] for index in part))
        with console.capture() as printed:
            console.print(table)
        parts.append("\n".join(line.rstrip() for line in printed.get().splitlines() if line.strip()))
    print(f"\n{title}", "\n\n".join(parts), sep="\n")


def _least_width(column: str, cells: Sequence[str], is_numeric: bool) -> int:
    """Return how narrow a column may be: words stay whole, and numbers with what stands beside them."""
    words = [column.split(), *([cell] if is_numeric else cell.split() for cell in cells)]
    return max((min(len(word), LONGEST_WORD) for line in words for word in line), default=1)


def _parts(widths: Sequence[int], names: Sequence[int], limit: int) -> list[list[int]]:
    """Return a table's columns: in one part if they fit, else in parts alike in width that begin with ``names``."""
    spaced = [width + GAP for width in widths]
    if sum(spaced) <= limit:
        return [list(range(len(widths)))]
    names = [index for place, index in enumerate(names) if sum(spaced[i] for i in names[: place + 1]) <= limit / 2]
    rest = [index for index in range(len(widths)) if index not in names]
    begin = sum(spaced[index] for index in names)
    total = sum(spaced[index] for index in rest)
    count = max(math.ceil(total / max(limit - begin, 1)), 1)
    parts: list[list[int]] = []
    used = done = 0
    for index in rest:
        if done >= total * len(parts) / count or used + spaced[index] > limit:
            parts.append([*names])
            used = begin
        parts[-1].append(index)
        used += spaced[index]
        done += spaced[index]
    return parts or [[*names]]


class RunOptions(Protocol):
    """Options that every command that renders or bakes has."""

    device: str
    threads: int | None
    quiet: bool


Options = TypeVar("Options", bound=RunOptions)


def run_command(
    options: Options, run: Callable[[Options, Reporter], None], reporter: type[Reporter] | None = None
) -> int:
    """Start Warp as the options of a command say, run it, and return its exit code."""
    start_warp(options.device, options.threads)
    run(options, (reporter or Reporter)(options.quiet))
    return 0


def start_warp(device: str = "cpu", threads: int | None = None) -> None:
    """Start Warp without its greeting, its module log and its message about CUDA; check that the device is there.

    ``threads`` is how many the CPU may use; None leaves that as it is. Raises OptionError for a device that is not
    there, or a number of threads out of range.
    """
    wp.config.log_level = wp.LOG_WARNING
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)  # native code writes there by itself
        kernel_cache.start()
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)
    _keep_heap_whole()
    launch.get_device(device)
    if threads is not None:
        launch.set_threads(threads)


def _keep_heap_whole() -> None:
    """Have the C library take large arrays from the system and give them back, where it can be told to (glibc).

    It keeps a block of up to 32 MB in its heap once one of that size was freed. Arrays of techniques that learn differ
    in size from frame to frame and leave holes there, by which the process grew by 0.2 MB a frame.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None and "MALLOC_MMAP_THRESHOLD_" not in os.environ:
        mallopt(_M_MMAP_THRESHOLD, _LARGE_BLOCK)


def cell_text(value: object) -> str:
    """Return a value as tables show it: four digits, thousands parted, None as nothing."""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:,.0f}" if abs(value) >= 1e5 else f"{value:.4g}"
    return "" if value is None else str(value)


def _is_number(text: str) -> bool:
    return text[:1].isdigit() or (text[:1] in "-+." and text[1:2].isdigit())


def _clock(seconds: float) -> str:
    seconds = round(seconds)
    if seconds < 60:
        return f"{seconds} s"
    minutes, seconds = divmod(seconds, 60)
    return f"{minutes} min {seconds:02d} s" if minutes < 60 else f"{minutes // 60} h {minutes % 60:02d} min"
