"""Compiled kernels that came with the package: copied into Warp's cache, so that the first frame compiles none.

``python -m warp_gi.bench.ship`` writes them, for CPUs that know x86-64-v3 (AVX2, FMA), before a wheel is built; a
checkout has none. A folder of them is named by ``wp.get_cpu_kernel_cache_key``, which holds Warp's version, the system
and the compiler; a module's folder in it by the hash of its source, constants and options. So what an edit has changed,
or another version of Warp, is compiled as ever. Where they are used, all such CPUs run the same machine code.
"""

from __future__ import annotations

import contextlib
import os
import platform
import re
import shutil
import sys
import uuid
from functools import cache
from pathlib import Path
from typing import Any

import warp as wp

OBJECTS = Path(__file__).parent / "objects"
"""Folder of what a wheel brings."""
VARIABLE = "WARP_GI_OBJECTS"
"""Environment variable that names another folder, or none at all where it is empty: kernels are compiled here then."""
NATIVE, LEVEL = "-march=native", "-target-cpu x86-64-v3"
NEEDED = frozenset(("abm", "avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "movbe"))
"""What Linux calls the instructions of x86-64-v3 that older CPUs lack."""


def flags(more: str) -> str:
    """Return the flags that shipped kernels are compiled with, ``more`` among them."""
    return f"{wp.config.cpu_compiler_flags or NATIVE} {more}".replace(NATIVE, LEVEL)


def folder(flags: str) -> Path | None:
    """Return the folder with compiled kernels for this Warp and this machine, or None."""
    named = os.environ.get(VARIABLE)
    root = OBJECTS if named is None else Path(named)
    if named == "" or not root.is_dir() or LEVEL not in flags or not knows_level():
        return None
    found = root / wp.get_cpu_kernel_cache_key(cpu_compiler_flags=flags)
    return found if found.is_dir() else None


def versions(module: str, shipped: Path) -> list[Path]:
    """Return the folders of a module, one a hash, in a folder of compiled kernels."""
    start = f"wp_{module}_"
    return [found for found in shipped.glob(f"{start}*") if re.fullmatch("[0-9a-f]+", found.name[len(start) :])]


@cache
def knows_level() -> bool:
    """Return whether this is Linux on a CPU that knows x86-64-v3."""
    if sys.platform != "linux" or platform.machine() != "x86_64":
        return False
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("flags"):
                return NEEDED <= set(line.partition(":")[2].split())
    return False


def bring(module: Any, more: str) -> bool:
    """Give a Warp module the flags of shipped kernels and copy its machine code into Warp's cache.

    Returns False where none fits, or the cache cannot be written; the module's flags are then to be set anew.
    """
    wanted = flags(more)
    shipped = folder(wanted)
    if shipped is None or not versions(module.name, shipped):
        return False
    module.options["cpu_compiler_flags"] = wanted
    module.mark_modified()
    name = module.get_module_identifier(1)
    if not (shipped / name).is_dir():
        return False
    try:
        _copy(shipped / name, Path(wp.config.kernel_cache_dir or "") / name)
    except OSError:
        return False
    return True


def _copy(source: Path, target: Path) -> None:
    """Copy a folder, so that it appears whole or not at all, unless it is there."""
    part = target.with_name(f".{target.name}.{uuid.uuid4().hex[:8]}")
    try:
        if not target.is_dir():
            part.mkdir()
            for file in source.iterdir():
                shutil.copyfile(file, part / file.name)  # without its mode: an installed file may be read-only
            with contextlib.suppress(FileExistsError, NotADirectoryError):
                part.rename(target)
    except OSError:
        if not target.is_dir():  # else another process was first
            raise
    finally:
        shutil.rmtree(part, ignore_errors=True)
