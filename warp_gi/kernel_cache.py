"""Warp's cache of compiled kernels: what is damaged is told and compiled again, what cannot be written is named.

Warp keeps a folder a module. Beside what Warp writes there, ``SUMS`` holds hashes of the machine code, so that bytes
that changed on a disk are found before they run.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import logging
import os
import shutil
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import warp as wp

from warp_gi.errors import one_line

try:
    import fcntl
except ImportError:  # Windows: processes that mend the same folder at once may compile it twice
    fcntl = None  # type: ignore[assignment]

VARIABLE = "WARP_CACHE_PATH"
"""Environment variable by which Warp keeps compiled kernels elsewhere."""
SUMS = "warp_gi.sha256"
"""File with the hashes of a module's machine code."""
LEAST_FREE = 1 << 20
"""Bytes; a disk with less is full."""
_CODE = (".o", ".ptx", ".cubin")
_LOG = logging.getLogger("warp_gi")


def start() -> None:
    """Start Warp. Raises OSError that names the folder of compiled kernels, where it cannot be made."""
    try:
        wp.init()
    except OSError as error:
        raise _unwritable(wp.config.kernel_cache_dir or str(error.filename), error) from error


def load(module: Any, device: wp.Device, block: int) -> None:
    """Load a module, compiled before or now; one that is damaged in the cache is compiled again, and a line says so.

    Of several processes that find the damage at once one compiles, and the others take what it made. Raises OSError
    where what is compiled cannot be kept: Warp runs it from there.
    """
    folder = Path(wp.config.kernel_cache_dir or "") / module.get_module_identifier(block)
    if not _problem(module, device, block, folder):
        return
    with _alone(folder):
        module.failed_builds.clear()
        problem = _problem(module, device, block, folder)
        if not problem:  # another process has mended it
            return
        _LOG.warning("compiled kernels are damaged in %s (%s): they are compiled again", folder, problem)
        _remove(folder)
        module.failed_builds.clear()
        _load(module, device, block, folder)


def _problem(module: Any, device: wp.Device, block: int, folder: Path) -> str:
    """Load a module; return what is damaged in its folder, or "" if it is loaded."""
    problem = _changed(folder)
    if problem:
        return problem
    was_there = folder.is_dir()
    try:
        _load(module, device, block, folder)
    except FileNotFoundError as error:  # another process has just removed it
        return one_line(error)
    except OSError:
        raise
    except Exception as error:
        if not was_there:
            raise
        return one_line(error, type(error).__name__)
    return ""


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Keep other processes from mending the same folder; where there are no locks, do nothing."""
    try:
        file = os.open(folder.with_name(f".{folder.name}.lock"), os.O_CREAT | os.O_RDWR, 0o666)
    except OSError as error:
        raise _unwritable(folder.parent, error) from error
    try:
        with contextlib.suppress(OSError, AttributeError):  # a file system without locks
            fcntl.flock(file, fcntl.LOCK_EX)
        yield
    finally:
        os.close(file)


def _remove(folder: Path) -> None:
    """Remove a folder at once: who looks at it sees all of it, or nothing."""
    aside = folder.with_name(f".{folder.name}.{uuid.uuid4().hex[:8]}.damaged")
    with contextlib.suppress(FileNotFoundError):
        os.rename(folder, aside)
    shutil.rmtree(aside, ignore_errors=True)


def _load(module: Any, device: wp.Device, block: int, folder: Path) -> None:
    with _naming(folder.parent):
        module.load(device, block)
    if folder.is_dir() and not (folder / SUMS).exists():
        with contextlib.suppress(OSError):  # of another user: it is read without
            part = folder / f".{SUMS}.{os.getpid()}"
            part.write_text(json.dumps(sums(folder)))
            os.replace(part, folder / SUMS)


@contextlib.contextmanager
def _naming(folder: Path) -> Iterator[None]:
    """Let errors of a full or read-only disk name the folder, and what moves it."""
    try:
        yield
    except OSError as error:
        raise _unwritable(folder, error) from error
    except Exception as error:
        with contextlib.suppress(OSError):
            if shutil.disk_usage(folder).free < LEAST_FREE:
                raise _unwritable(folder, OSError(28, "No space left on device")) from error
        raise


def _unwritable(folder: object, error: OSError) -> OSError:
    reason = error.strerror or one_line(error)
    problem = f"compiled kernels are kept in this folder, and that failed ({reason}); name another by {VARIABLE}"
    return OSError(error.errno or errno.EIO, problem, str(folder))


def sums(folder: Path) -> dict[str, str]:
    """Return the hashes of a module's machine code, by file."""
    return {
        file.name: hashlib.sha256(file.read_bytes()).hexdigest()
        for file in sorted(folder.iterdir())
        if file.suffix in _CODE
    }


def _changed(folder: Path) -> str:
    """Return which file of a module is not what it was, or ""."""
    try:
        known = json.loads((folder / SUMS).read_text())
        now = sums(folder)
        changed = [name for name, value in known.items() if now.get(name, value) != value]
        return f"{changed[0]} has changed" if changed else ""
    except FileNotFoundError:
        return ""
    except (OSError, ValueError, AttributeError) as error:
        return f"{SUMS}: {one_line(error)}"
