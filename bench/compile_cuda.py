"""Compiles every kernel for CUDA, without a GPU: ``python -m warp_gi.bench.compile_cuda [ARCH ...]``, default 80 90."""

from __future__ import annotations

import argparse
import importlib
import multiprocessing
import pkgutil
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from types import ModuleType

import warp as wp

import warp_gi.kernels
from warp_gi import launch, registry
from warp_gi.kernels.path_samplers import (
    ALIAS_LIGHTS,
    BSDF_DIRECTIONS,
    NO_CACHE,
    NO_REGIONS,
    SCENE_SKY,
    DirectionSampler,
    LightSampler,
    PathCache,
    Sky,
)
from warp_gi.kernels.path_trace import PathTracer, path_tracer
from warp_gi.kernels.samples import SAMPLE_REGIONS

ARCHITECTURES = (80, 90)


def kernel_modules() -> list[str]:
    """Return the names of all Warp modules with kernels: those of ``kernels/``, and one for each path tracer."""
    names = [info.name for info in pkgutil.iter_modules(warp_gi.kernels.__path__, "warp_gi.kernels.")]
    names = [name for name in names if _has_kernels(importlib.import_module(name))]
    return sorted([*names, *(tracer.trace_paths.module.name for tracer in every_tracer())])


def every_tracer() -> list[PathTracer]:
    """Return the path tracers of the registry: each light sampler with each direction sampler, and each hook once.

    And one with coloured glass.
    """
    found = registry.samplers().values()
    lights = [one for one in found if isinstance(one, LightSampler)]
    directions = [one for one in found if isinstance(one, DirectionSampler)]
    pairs = [(light, direction) for light in lights for direction in directions]
    regions = [
        SAMPLE_REGIONS if light.uses_regions or direction.uses_regions else NO_REGIONS for light, direction in pairs
    ]
    plain = [path_tracer(*pair, region) for pair, region in zip(pairs, regions, strict=True)]
    hooks = [(SCENE_SKY, one) for one in found if isinstance(one, PathCache)]
    hooks += [(one, NO_CACHE) for one in found if isinstance(one, Sky)]
    hooked = [path_tracer(ALIAS_LIGHTS, BSDF_DIRECTIONS, NO_REGIONS, sky, cache) for sky, cache in hooks]
    return [*plain, *hooked, path_tracer(ALIAS_LIGHTS, BSDF_DIRECTIONS, NO_REGIONS, tints=True)]


def compile_module(name: str, architectures: Sequence[int], folder: Path) -> list[Path]:
    """Compile a kernel module for CUDA architectures such as 90 (sm_90); return the files written.

    Raises RuntimeError or Warp's own error when the module does not compile.
    """
    paths = [Path(path) for path in wp.compile_aot_module(name, arch=list(architectures), module_dir=folder)]
    if len(paths) < len(architectures) or not all(path.stat().st_size for path in paths):
        raise RuntimeError(f"{name}: Warp wrote {[path.name for path in paths]} for architectures {architectures}")
    return paths


def main(arguments: Sequence[str] | None = None) -> int:
    """Compile all modules, on every core, and print size and seconds of each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("arch", nargs="*", type=int, default=ARCHITECTURES, help="compute capability, as 90")
    options = parser.parse_args(arguments)
    names = kernel_modules()
    with ProcessPoolExecutor(launch.thread_count(), multiprocessing.get_context("spawn")) as pool:
        for line in pool.map(_compiled, names, [options.arch] * len(names)):
            print(line, flush=True)
    return 0


def _compiled(name: str, architectures: Sequence[int]) -> str:
    """Compile a module in a process of its own, and return what to print."""
    wp.config.log_level = wp.LOG_WARNING
    kernel_modules()  # a Warp module is known once its file is imported
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as folder:
        paths = compile_module(name, architectures, Path(folder))
        size = sum(path.stat().st_size for path in paths)
    return f"{name}: {len(paths)} files, {size / 1e3:.0f} kB, {time.perf_counter() - started:.1f} s"


def _has_kernels(module: ModuleType) -> bool:
    values = vars(module).values()
    return any(isinstance(value, wp.Kernel) and value.module.name == module.__name__ for value in values)


if __name__ == "__main__":
    raise SystemExit(main())
