"""Files that appear whole or not at all, and files with a number in their name."""

from __future__ import annotations

import contextlib
import errno
import functools
import hashlib
import os
import re
import shutil
import socket
import tempfile
import time
import uuid
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path

from warp_gi.errors import OptionError

OLD = 86_400.0
"""Seconds after which a temporary file of another machine is taken for one of a killed process."""
_in_use: set[str] = set()
"""Names of the temporary files that threads of this process are writing."""
_claim: ContextVar[Path | None] = ContextVar("claim", default=None)
"""File without which nothing is written here (``writing_under``)."""


def user_path(path: str | os.PathLike[str]) -> Path:
    """Return a path whose ``~`` or ``~name`` is the home of the user; of an unknown user it stays as it is."""
    try:
        return Path(path).expanduser()
    except RuntimeError:
        return Path(path)


def check_target(path: Path) -> None:
    """Raise OSError for a file that cannot be written: a folder, a read-only file, or in a folder that takes none.

    Nothing is made or changed, so that it can be asked before the work starts.
    """
    if path.is_dir():
        raise OSError(errno.EISDIR, "is a folder; name a file in it", str(path))
    check_replaceable(path)
    folder = next(parent for parent in path.absolute().parents if parent.exists())
    if not folder.is_dir():
        raise OSError(errno.ENOTDIR, "is a file, expected a folder; give another one", str(folder))
    if not os.access(folder, os.W_OK):
        raise OSError(errno.EACCES, "nothing can be written to this folder; give another one", str(folder))


def check_replaceable(path: Path) -> None:
    """Raise OSError for a file that is there and read-only: renaming another one to it would not ask."""
    if path.is_file() and (not path.stat().st_mode & 0o222 or not os.access(path, os.W_OK)):
        raise OSError(errno.EACCES, "is read-only; give another name, or make it writable", str(path))


@contextlib.contextmanager
def writing_under(claim: Path | None) -> Iterator[None]:
    """Let files appear within the block only as long as the file ``claim`` is there; None asks for none.

    ``replacing`` looks for it when all is written, just before the file gets its name, and raises OSError without it.
    """
    before = _claim.set(claim)
    try:
        yield
    finally:
        _claim.reset(before)


def _check_claim(path: Path) -> None:
    claim = _claim.get()
    if claim is None:
        return
    try:
        os.close(os.open(claim, os.O_RDONLY))  # a network's disk asks its server when a file is opened, not before
    except FileNotFoundError:
        problem = "is left as it is: the run that this frame is of has ended, or another one has taken its place"
        raise OSError(errno.ESTALE, problem, str(path)) from None


@contextlib.contextmanager
def replacing(path: str | Path, own_folder: bool = False) -> Iterator[Path]:
    """Yield a temporary path beside ``path`` to write to; it is renamed to ``path`` if the block succeeds.

    A file at ``path`` stays until the new one is complete and on disk. When the block
    raises, the temporary file is removed. Missing folders are made. ``own_folder`` puts the temporary file in a
    folder of its own, for a writer that makes files beside it: if the process is killed, they are found with it.
    Raises OSError when the folder cannot be written to, or a file at ``path`` is read-only.
    """
    path = user_path(path)
    check_replaceable(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{machine()}-{os.getpid()}-{uuid.uuid4().hex[:8]}.part")
    _in_use.add(part.name)
    file = part / path.name if own_folder else part
    try:
        if own_folder:
            part.mkdir()
        file.write_bytes(b"")
        mode = file.stat().st_mode
        yield file
        file.chmod(mode)  # some writers replace the file by one that its owner alone may read
        with open(file, "rb+") as written:
            os.fsync(written.fileno())
        _check_claim(path)
        os.replace(file, path)
    except BaseException as error:
        _remove(part)
        if isinstance(error, OSError) and error.errno and error.filename in (None, str(part), str(file)):
            raise OSError(error.errno, error.strerror, str(path)) from error  # a full disk: where, and not of what name
        raise
    else:
        if own_folder:
            _remove(part)
    finally:
        _in_use.discard(part.name)


def check_writable(folder: Path) -> None:
    """Make the folder; raises OSError now, not after an hour's work, if nothing can be written there."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        file = next((path for path in (folder, *folder.parents) if path.exists() and not path.is_dir()), None)
        problem = f"this folder cannot be made ({error.strerror}); give another one"
        if file is not None:
            problem = "is a file, expected a folder; give another one"
        raise OSError(error.errno, problem, str(file or folder)) from error
    try:
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise OSError(error.errno, "nothing can be written to this folder", str(folder)) from error


def cache_folder(name: str) -> Path:
    """Return where files that can be made again are kept: ``warp_gi/NAME`` in XDG_CACHE_HOME, or in ~/.cache."""
    root = os.environ.get("XDG_CACHE_HOME")
    try:
        cache = user_path(root) if root else Path.home() / ".cache"
    except RuntimeError:  # a user without a home, as in a container that runs under any number
        cache = Path(tempfile.gettempdir()) / f"warp_gi-{os.getuid() if hasattr(os, 'getuid') else 'user'}"
    return cache / "warp_gi" / name


def prune(folder: Path, pattern: str, most_bytes: int, spared: Path | None = None) -> None:
    """Remove the files that were not used for longest (modified last), until the rest are below ``most_bytes``.

    ``spared`` is the one just written.

    Another process may remove the same files at the same time. Raises OSError for a file that may not be removed.
    """
    files = []
    for path in folder.glob(pattern):
        with contextlib.suppress(FileNotFoundError):
            stat = path.stat()
            files.append((path == spared, stat.st_mtime, stat.st_size, path))
    total = 0
    for is_spared, _, size, path in sorted(files, reverse=True):
        total += size
        if total > most_bytes and not is_spared:
            path.unlink(missing_ok=True)


def remove_stale_parts(path: str | Path) -> None:
    """Remove the temporary files that a killed process left for ``path``; those of living processes stay.

    Of another machine or container, whose processes cannot be asked for, those go that are a day old.
    """
    path = Path(path)
    name = re.compile(rf"\.{re.escape(path.name)}\.([0-9a-f]{{8}})-(\d+)-[0-9a-f]{{8}}\.part")
    if not path.parent.is_dir():
        return
    for candidate in path.parent.iterdir():
        if (match := name.fullmatch(candidate.name)) is None or candidate.name in _in_use:
            continue
        with contextlib.suppress(FileNotFoundError):  # another process has just removed it
            if match[1] != machine():
                is_stale = time.time() - candidate.stat().st_mtime > OLD
            else:
                is_stale = int(match[2]) == os.getpid() or not _is_running(int(match[2]))
            if is_stale:
                _remove(candidate)


@functools.cache
def machine() -> str:
    """Return eight digits that tell machines and containers apart: those whose processes have other numbers."""
    parts = [socket.gethostname()]
    for file in ("/proc/sys/kernel/random/boot_id", "/proc/self/ns/pid"):
        with contextlib.suppress(OSError):
            parts.append(os.readlink(file) if "ns" in file else Path(file).read_text())
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:8]


def frame_path(pattern: str | Path, index: int) -> Path:
    """Return the file of frame ``index``: the last run of ``#`` in the name becomes the zero-padded number.

    A name without ``#`` is returned as it is. Raises OptionError for a negative index.
    """
    if index < 0:
        raise OptionError(f"frame numbers start at 0, got {index}")
    pattern = user_path(pattern)
    runs = list(re.finditer("#+", pattern.name))
    if not runs:
        return pattern
    start, end = runs[-1].span()
    return pattern.with_name(f"{pattern.name[:start]}{index:0{end - start}d}{pattern.name[end:]}")


def frames_there(pattern: str | Path) -> list[int]:
    """Return the numbers, in order, for which ``frame_path`` names a file that is there."""
    pattern = user_path(pattern)
    runs = list(re.finditer("#+", pattern.name))
    if not runs or not pattern.parent.is_dir():
        return []
    start, end = runs[-1].span()
    name = re.compile(rf"{re.escape(pattern.name[:start])}(\d+){re.escape(pattern.name[end:])}")
    found = (name.fullmatch(path.name) for path in pattern.parent.iterdir())
    numbers = {int(match[1]) for match in found if match}
    return sorted(number for number in numbers if frame_path(pattern, number).is_file())


def _remove(part: Path) -> None:
    """Remove a temporary file, or the folder of one."""
    if part.is_dir():
        shutil.rmtree(part)
    else:
        part.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    if os.name == "nt":  # os.kill would end the process there
        return False
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (PermissionError, OverflowError):
        return True
    return True
