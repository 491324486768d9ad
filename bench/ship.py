"""Compiles kernels for a wheel to bring: ``python -m warp_gi.bench.ship [--folder FOLDER] [--check] [NAME ...]``.

Run it before the wheel is built (``warp_gi.shipped`` says what becomes of them). It takes minutes on two cores.
``--check`` compiles nothing, and names what is missing or of another source.
"""

from __future__ import annotations

import argparse
import itertools
import json
import multiprocessing
import shutil
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import warp as wp

from warp_gi import kernel_cache, launch, loading, registry, shipped
from warp_gi.bench.compile_cuda import kernel_modules
from warp_gi.kernels.path_samplers import BSDF_DIRECTIONS, NO_REGIONS, SCENE_SKY, LightSampler, PathCache, Sky
from warp_gi.kernels.path_trace import path_tracer

KEPT = (".o", ".meta")
"""Files of a compiled module that loading reads."""


def shipped_modules() -> list[str]:
    """Return the names of all modules with kernels, path tracers that presets make of several hooks among them."""
    names = kernel_modules()
    found = registry.samplers().values()
    lights = [one for one in found if isinstance(one, LightSampler) and not one.uses_regions]
    skies = [SCENE_SKY, *(one for one in found if isinstance(one, Sky))]
    caches = [one for one in found if isinstance(one, PathCache)]
    tracers = [
        path_tracer(light, BSDF_DIRECTIONS, NO_REGIONS, sky, cache)
        for light, sky, cache in itertools.product(lights, skies, caches)
    ]
    return sorted({*names, *(tracer.trace_paths.module.name for tracer in tracers)})


def place(name: str, folder: Path) -> Path:
    """Return where a module of the present source belongs in a folder of compiled kernels; sets the module's flags."""
    shipped_modules()  # a Warp module is known once its file is imported
    module: Any = wp.get_module(name)
    flags = shipped.flags(loading.FLAG)
    module.options["cpu_compiler_flags"] = flags
    module.mark_modified()
    return folder / wp.get_cpu_kernel_cache_key(cpu_compiler_flags=flags) / module.get_module_identifier(1)


def ship(name: str, folder: Path) -> Path:
    """Compile a module as wheels bring it and put it into a folder of such; return its own folder in that.

    Warp's cache of this process moves to a folder that is gone afterwards.
    """
    kernel_cache.start()  # which names the folder of the cache anew
    target = place(name, folder)
    with tempfile.TemporaryDirectory() as cache:
        wp.config.kernel_cache_dir = cache
        wp.get_module(name).load(wp.get_device("cpu"), 1)
        for old in shipped.versions(name, target.parent):
            shutil.rmtree(old)
        target.mkdir(parents=True)
        for file in (Path(cache) / target.name).iterdir():
            if file.suffix in KEPT:
                shutil.copy(file, target)
    (target / kernel_cache.SUMS).write_text(json.dumps(kernel_cache.sums(target)))
    return target


def main(arguments: Sequence[str] | None = None) -> int:
    """Compile modules on every core, and print size and seconds of each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", help="modules, as warp_gi.kernels.compose; all of them if none is named")
    parser.add_argument("--folder", type=Path, default=shipped.OBJECTS, help="default: the one that the package reads")
    parser.add_argument("--check", action="store_true", help="only say what is missing; exit code 1 if anything is")
    options = parser.parse_args(arguments)
    known = shipped_modules()
    names = options.names or known
    if not shipped.knows_level():
        parser.error("wheels bring kernels for x86-64-v3 on Linux, which this machine is not")
    unknown = sorted({*names} - {*known})
    if unknown and not options.check:
        parser.error(f"no kernel module is called {unknown[0]!r}")
    if options.check:
        missing = [name for name in names if not place(name, options.folder).is_dir()]
        for name in missing:
            print(f"{name}: no machine code of its present source in {options.folder}")
        return int(bool(missing))
    with ProcessPoolExecutor(launch.thread_count(), multiprocessing.get_context("spawn")) as pool:
        for line in pool.map(_shipped, names, [options.folder] * len(names)):
            print(line, flush=True)
    return 0


def _shipped(name: str, folder: Path) -> str:
    """Compile a module in a process of its own, and return what to print."""
    wp.config.log_level = wp.LOG_WARNING
    started = time.perf_counter()
    target = ship(name, folder)
    size = sum(file.stat().st_size for file in target.iterdir())
    return f"{name}: {size / 1e3:.0f} kB, {time.perf_counter() - started:.1f} s"


if __name__ == "__main__":
    raise SystemExit(main())
