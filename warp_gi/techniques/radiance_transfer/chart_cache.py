"""Charts that were made before, on disk: they take most of a bake's time, and depend on little."""

from __future__ import annotations

import contextlib
import hashlib
import os
import warnings
import zipfile
import zlib
from collections.abc import Callable
from importlib import metadata
from pathlib import Path

import numpy as np

from warp_gi.files import replacing
from warp_gi.techniques.radiance_transfer.chart_job import WORKER

FORMAT = "warp_gi charts 1"
"""Changes with what a job's arrays mean. Charts by another version of xatlas, or of the worker, are made again, too."""
MOST_BYTES = 2 << 30
"""Bytes of all files, above which those not read for longest are removed."""

Arrays = dict[str, np.ndarray]


def cache_folder() -> Path:
    """Return where charts are kept: ``warp_gi/charts`` in XDG_CACHE_HOME, or in ~/.cache."""
    root = os.environ.get("XDG_CACHE_HOME")
    return (Path(root) if root else Path.home() / ".cache") / "warp_gi" / "charts"


def cached(kind: str, job: Arrays, make: Callable[[], Arrays]) -> Arrays:
    """Return the arrays that were kept for a job of this kind; or make them, and keep them.

    A damaged file is made again, with a warning, and a folder that cannot be written to is only a warning.
    """
    path = cache_folder() / f"{kind}-{_key(kind, job)}.npz"
    found = _read(path)
    if found is not None:
        return found
    made = make()
    try:
        with replacing(path) as part, open(part, "wb") as file:
            np.savez(file, **made)  # type: ignore[arg-type]
        _prune(path.parent)
    except OSError as error:
        warnings.warn(f"charts cannot be kept for the next time: {error}", stacklevel=2)
    return made


def _key(kind: str, job: Arrays) -> str:
    digest = hashlib.sha256(f"{FORMAT} {kind} xatlas {metadata.version('xatlas')}".encode())
    digest.update(WORKER.read_bytes())
    for name in sorted(job):
        array = np.ascontiguousarray(job[name])
        digest.update(repr((name, array.dtype.str, array.shape)).encode())
        digest.update(array.reshape(-1).view(np.uint8).data)
    return digest.hexdigest()


def _read(path: Path) -> Arrays | None:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        warnings.warn(f"{str(path)!r} is damaged ({error}); its charts are made again", stacklevel=3)
        return None
    with contextlib.suppress(OSError):  # a folder that others own
        os.utime(path)
    return arrays


def _prune(folder: Path) -> None:
    """Remove the files that were not read for longest, until the rest are below MOST_BYTES."""
    files = sorted(((p.stat().st_mtime, p.stat().st_size, p) for p in folder.glob("*.npz")), reverse=True)
    total = 0
    for _, size, path in files:
        total += size
        if total > MOST_BYTES:
            path.unlink(missing_ok=True)
