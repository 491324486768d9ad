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

from warp_gi.files import cache_folder, prune, replacing
from warp_gi.techniques.shared.atlas.chart_job import WORKER

FORMAT = "warp_gi charts 1"
"""Changes with what a job's arrays mean. Charts by another version of xatlas, or of the worker, are made again, too."""
MOST_BYTES = 2 << 30
"""Bytes of all files, above which those not read for longest are removed."""
ROUNDING = 0.01
"""Texels by which a corner may leave its page."""

Arrays = dict[str, np.ndarray]


def cached(kind: str, job: Arrays, make: Callable[[], Arrays]) -> Arrays:
    """Return the arrays that were kept for a job of this kind; or make them, and keep them.

    A file that is damaged, or whose arrays cannot be those of the job, is made again, with a warning. A folder that
    cannot be written to is only a warning.
    """
    path = cache_folder("charts") / f"{kind}-{_key(kind, job)}.npz"
    found = _read(path, kind, job)
    if found is not None:
        return found
    made = make()
    try:
        with replacing(path) as part, open(part, "wb") as file:
            np.savez(file, **made)  # type: ignore[arg-type]
        prune(path.parent, "*.npz", MOST_BYTES)
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


def _read(path: Path, kind: str, job: Arrays) -> Arrays | None:
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = dict(file)
        _check(kind, job, arrays)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        warnings.warn(f"{str(path)!r} is damaged ({error}); its charts are made again", stacklevel=3)
        return None
    with contextlib.suppress(OSError):  # a folder that others own
        os.utime(path)
    return arrays


def _check(kind: str, job: Arrays, arrays: Arrays) -> None:
    """Raise ValueError unless arrays have the names, types, shapes and ranges of the worker's results for a job."""
    faces = len(job["indices"] if kind == "cut" else job["charts"])
    corners = "uvs" if kind == "cut" else "corners"
    wanted: dict[str, tuple[type, tuple[int, ...]]] = {corners: (np.float32, (faces, 3, 2))}
    if kind == "cut":
        wanted["charts"] = np.int32, (faces,)
    else:
        wanted |= {"is_placed": (np.bool_, (faces,)), "page": (np.int32, (2,)), "least": (np.int64, ())}
    if set(arrays) != set(wanted):
        raise ValueError(f"has the arrays {', '.join(sorted(arrays))}, expected {', '.join(sorted(wanted))}")
    for name, (dtype, shape) in wanted.items():
        if arrays[name].dtype != dtype or arrays[name].shape != shape:
            raise ValueError(f"{name} is {arrays[name].dtype} {arrays[name].shape}, expected {np.dtype(dtype)} {shape}")
    if not np.isfinite(arrays[corners]).all():
        raise ValueError(f"{corners} are not finite")
    if kind == "cut":
        if faces and not (arrays["charts"].min() >= -1 and arrays["charts"].max() < faces):
            raise ValueError("charts are out of range")
        return
    page, placed = arrays["page"], arrays["corners"][arrays["is_placed"]]
    within = (placed >= -ROUNDING).all() and (placed <= page + ROUNDING).all()
    if not (within and (page >= 0).all() and (page <= job["size"]).all()):
        raise ValueError("corners leave the page")
