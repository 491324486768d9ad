"""How much memory there is, asked before a file or a picture that is too large for it is begun."""

from __future__ import annotations

import contextlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from warp_gi.errors import SceneError

if TYPE_CHECKING:
    import warp as wp

PLAIN_BYTES, DENOISED_BYTES = 245, 470
"""Bytes that a pixel takes at most while a sequence is rendered and written, without and with a denoiser (measured)."""
_GROUPS = (
    ("/sys/fs/cgroup", "memory.max", "memory.current", "file"),
    ("/sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "cache"),
)
"""Folder and files that say what a container may take, and what it has taken, and what of that are copies of
files, which make room when asked: control groups 2 and 1."""


def free_memory() -> int | None:
    """Return the bytes that this process can still take on the CPU's side, None where nothing says so.

    It is the least of what the machine has left, what its container may take (control groups), and what the process may
    (``ulimit -v``).
    """
    return min(_limits(), default=None)


def check_memory(what: str, needed: int) -> None:
    """Raise SceneError where ``what``, which takes ``needed`` bytes, does not fit into the memory that is left."""
    free = free_memory()
    if free is not None and needed > free:
        raise SceneError(
            f"{what} take {gigabytes(needed)} of memory, and {gigabytes(free)} are free; make it smaller, or use a"
            " machine with more"
        )


def picture_bytes(resolution: tuple[int, int], is_denoised: bool) -> int:
    """Return the bytes that a picture takes at most while it is rendered and written."""
    return resolution[0] * resolution[1] * (DENOISED_BYTES if is_denoised else PLAIN_BYTES)


def left_on(device: wp.Device) -> int | None:
    """Return the bytes that are free on a device; None where nothing says so."""
    return device.free_memory if device.is_cuda else free_memory()


def too_large(resolution: tuple[int, int], is_denoised: bool) -> str:
    """Return what a picture takes, in words."""
    needed, each = picture_bytes(resolution, is_denoised), DENOISED_BYTES if is_denoised else PLAIN_BYTES
    size = "x".join(map(str, resolution))
    return f"a picture of {size} takes about {gigabytes(needed)} of memory ({each} bytes a pixel)"


def gigabytes(count: int) -> str:
    """Return a number of bytes as a user reads it, "1.5 GB"."""
    return f"{count / 1e9:,.{1 if count >= 1e8 else 3}f} GB"


def _limits() -> Iterator[int]:
    with contextlib.suppress(OSError, ValueError, StopIteration):
        lines = Path("/proc/meminfo").read_text().splitlines()
        yield 1024 * next(int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    for folder, limit, used, cached in _GROUPS:
        with contextlib.suppress(OSError, ValueError):  # "max" is no number
            most, taken = (int(Path(folder, name).read_text()) for name in (limit, used))
            stat = dict(line.split(maxsplit=1) for line in Path(folder, "memory.stat").read_text().splitlines())
            yield max(most - taken + int(stat.get(cached, 0)), 0)
    if sys.platform != "win32":
        import resource

        most = resource.getrlimit(resource.RLIMIT_AS)[0]
        if most != resource.RLIM_INFINITY:
            with contextlib.suppress(OSError, ValueError):
                pages = int(Path("/proc/self/statm").read_text().split()[0])
                yield max(most - pages * resource.getpagesize(), 0)
