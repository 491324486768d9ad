"""The only caller of ``wp.launch``: checks arguments, slices CPU launches over threads, times compiles.

Every kernel takes ``first: wp.int32`` as its first argument and owns the item
``first + wp.tid()``. On the CPU a launch becomes slices that ``workers`` share
(a Warp CPU launch is one thread and releases the GIL); on CUDA it is
one launch with ``first = 0``. No kernel uses atomics on the CPU, so the result
does not depend on the slices.

In a forked process launches on the CPU work, of kernels that the parent has loaded
and of others. CUDA does not work there once the parent has started it: an error says so.
"""

from __future__ import annotations

import functools
import itertools
import os
import threading
import time
import weakref
from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeVar

import numpy as np
import warp as wp

from warp_gi import forks, kernel_cache, loading, workers
from warp_gi.errors import OptionError
from warp_gi.verbosity import quieten_warp

quieten_warp()

Struct = TypeVar("Struct")
"""Class of a kernel struct."""

SLICES_PER_THREAD = 16  # enough to balance uneven work, few enough that 30 us a launch vanish
SMALLEST_SLICE = 256  # items
CUDA_BLOCK = 256  # threads

_loading = threading.RLock()  # taken across a fork, so that no thread that only the parent has is inside the linker
_threads: int | None = None
compile_seconds = 0.0
"""Wall seconds that launches of this process have waited for kernel modules to compile or load."""
compile_cpu_seconds = 0.0
"""CPU seconds that all threads of this process have spent compiling or loading kernel modules."""
_counting = threading.RLock()
on_load: Callable[[str], None] | None = None
"""Called with a kernel module's name before its first launch, which may take seconds to compile; for progress."""
_loaded: set[tuple[str, str]] = set()
_bound: weakref.WeakKeyDictionary[wp.Kernel, set[str]] = weakref.WeakKeyDictionary()
"""Devices on which Warp has looked up a kernel's machine code."""


def thread_count() -> int:
    """Return how many threads CPU launches use: ``set_threads``, else WARP_GI_THREADS, else every core allowed."""
    if _threads is not None:
        return _threads
    text = os.environ.get("WARP_GI_THREADS")
    if text:
        return _checked_threads(text)
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def set_threads(count: int | None) -> None:
    """Set how many threads CPU launches use; None goes back to the default.

    Raises OptionError unless ``count`` is a whole number of at least 1.
    """
    global _threads
    _threads = None if count is None else _checked_threads(count)


def _checked_threads(value: object) -> int:
    try:
        count = int(str(value))
    except ValueError:
        count = 0
    if count < 1:
        raise OptionError(f"thread count must be a whole number of at least 1, got {value!r}")
    return count


def get_device(name: str | None) -> wp.Device:
    """Return the Warp device of that name ("cpu", "cuda", "cuda:1").

    Raises OptionError if it is not there, or is CUDA in a process forked after CUDA had started; OSError that names the
    folder of compiled kernels if that cannot be made.
    """
    kernel_cache.start()
    try:
        if name and name.startswith("cuda") and not wp.is_cuda_available():  # Warp would print before it raises
            raise RuntimeError("Warp finds no CUDA driver or GPU")
        device = wp.get_device(name or "cpu")
    except (RuntimeError, ValueError) as error:
        known = ", ".join(device.alias for device in wp.get_devices())
        raise OptionError(f"device {name!r} is not available ({error}); use one of: {known}") from error
    check_fork(device)
    return device


def check_fork(device: wp.Device) -> None:
    """Raise OptionError for a CUDA device in a process that was forked after CUDA had started: it cannot work there."""
    if forks.has_lost_cuda and device.is_cuda:
        raise OptionError(
            f"device {device.alias!r} cannot be used here: this process was forked after CUDA had started; start "
            "processes by the method 'spawn' or 'forkserver' of multiprocessing, or use the device 'cpu'"
        )


def on_device(values: np.ndarray, dtype: type, device: wp.Device) -> wp.array:
    """Return ``values`` as an array of ``dtype`` on a device; on the CPU it is the same memory.

    NumPy asks for huge pages where an array is large (4 MB), which halves the cost of random access; Warp's
    own allocator does not.
    """
    return wp.array(values, dtype=dtype, device=device, copy=not device.is_cpu)


def fields_of(struct: Any) -> Iterable[str]:
    """Return the names of a kernel struct's fields."""
    return struct.vars


def copied(source: Struct, struct: type[Struct]) -> Struct:
    """Return a copy of a kernel struct that shares its arrays."""
    copy = struct()
    for name in fields_of(struct):
        setattr(copy, name, getattr(source, name))
    return copy


def load(kernel: wp.Kernel, device: wp.Device) -> None:
    """Compile or load the kernel's module now, or wait for the thread that does.

    The time is added to ``compile_seconds``, and what this thread spent of it to ``compile_cpu_seconds``.
    """
    global compile_seconds
    started = time.perf_counter()
    module = (kernel.module.name, device.alias)
    if module not in _loaded and on_load is not None:
        on_load(kernel.module.name)
    if device.is_cpu:
        loading.wait_for(kernel.module.name)
    _load_here(kernel, device)
    _loaded.add(module)
    with _counting:
        compile_seconds += time.perf_counter() - started


def load_ahead(kernels: Iterable[wp.Kernel], device: wp.Device) -> None:
    """Begin to compile or load the kernels' modules on other threads, where the CPU may use several, and return.

    A launch waits for its own module alone. Kernels that an earlier call named, and this one does not, are left out if
    no thread has begun with them. On CUDA, and with one thread, modules are loaded as they are launched.
    """
    if device.is_cpu and thread_count() > 1:
        wanted = [one for one in kernels if (one.module.name, device.alias) not in _loaded]
        loading.load_ahead(wanted, lambda kernel: _load_here(kernel, device), thread_count())


def _load_here(kernel: wp.Kernel, device: wp.Device) -> None:
    global compile_cpu_seconds
    cpu = time.thread_time()
    with loading.lock_of(kernel.module.name):
        loading.prepare(kernel.module)
        block = 1 if device.is_cpu else CUDA_BLOCK
        if (kernel.module.name, device.alias) in _loaded:
            kernel.module.load(device, block)
        else:
            with loading.alone(kernel, block):
                kernel_cache.load(kernel.module, device, block)
    with _counting:
        compile_cpu_seconds += time.thread_time() - cpu


def launch(
    kernel: wp.Kernel,
    count: int,
    inputs: Sequence[object],
    device: wp.Device,
    smallest_slice: int = SMALLEST_SLICE,
    first: int = 0,
) -> None:
    """Run ``kernel`` over ``count`` items from ``first`` on.

    ``inputs`` are the arguments after ``first``. Raises TypeError when an argument's
    type, dtype, rank or device is not what the kernel declares, OptionError for CUDA in
    a process forked after CUDA had started. After an interrupt nothing of the launch goes on.
    """
    check_fork(device)
    _check(kernel, inputs, device)
    if count <= 0:
        return
    load(kernel, device)
    if device.alias not in _bound.get(kernel, ()):
        with _loading:  # the linker has locks that a fork has to find free
            wp.launch(kernel, dim=1, inputs=[0, *inputs], device=device, record_tape=False, record_cmd=True)
        _bound.setdefault(kernel, set()).add(device.alias)
    if device.is_cuda:
        wp.launch(kernel, dim=count, inputs=[first, *inputs], device=device, record_tape=False)
        return
    threads = thread_count()
    slice_count = min(threads * SLICES_PER_THREAD if threads > 1 else 1, -(-count // smallest_slice))
    bounds = list(itertools.pairwise(first + count * i // slice_count for i in range(slice_count + 1)))

    def run(index: int) -> None:
        begin, end = bounds[index]
        wp.launch(kernel, dim=end - begin, inputs=[begin, *inputs], device=device, record_tape=False)

    if slice_count == 1:
        run(0)
    else:
        workers.share(run, slice_count, threads)


def _check(kernel: wp.Kernel, inputs: Sequence[object], device: wp.Device) -> None:
    arguments = kernel.adj.args
    if arguments[0].label != "first":
        raise TypeError(f"kernel {kernel.key}: the first argument must be `first: wp.int32`")
    if len(inputs) != len(arguments) - 1:
        raise TypeError(f"kernel {kernel.key} takes {len(arguments) - 1} inputs after `first`, got {len(inputs)}")
    for argument, value in zip(arguments[1:], inputs, strict=True):
        problem = _mismatch(argument.type, value, device)
        if problem:
            raise TypeError(f"kernel {kernel.key}, argument {argument.label}: {problem}")


def _mismatch(expected: Any, value: object, device: wp.Device) -> str | None:
    if isinstance(expected, wp.array):
        if value is None:
            return None
        if not isinstance(value, wp.array):
            return f"expected a wp.array, got {type(value).__name__}"
        if value.dtype is not expected.dtype and getattr(value.dtype, "cls", 0) is not getattr(
            expected.dtype, "cls", 1
        ):
            return f"expected dtype {expected.dtype}, got {value.dtype}"
        if value.ndim != expected.ndim:
            return f"expected {expected.ndim} dimensions, got {value.ndim}"
        if value.device != device:
            return f"expected an array on {device}, got one on {value.device}"
        return None
    if hasattr(expected, "vars") and hasattr(expected, "cls"):  # a wp.struct
        struct: Any = getattr(value, "_cls", None)
        if struct is not expected:
            return f"expected struct {expected.key}, got {getattr(struct, 'key', type(value).__name__)}"
        for name, kind, dtype in _arrays_of(expected):
            field = getattr(value, name)
            if dtype is not None and (field is None or (field.dtype is dtype and field.device is device)):
                continue  # Warp compares the rank when a field is set
            problem = _mismatch(kind, field, device)
            if problem:
                return f"field {name}: {problem}"
        return None
    if isinstance(value, np.ndarray | wp.array):
        return f"expected {expected}, got an array"
    return None


@functools.cache
def _arrays_of(struct: Any) -> tuple[tuple[str, Any, type | None], ...]:
    """Return name, type and dtype of the fields that are arrays, and of those that are structs, whose dtype is None."""
    kinds = ((name, variable.type) for name, variable in struct.vars.items())
    return tuple(
        (name, kind, kind.dtype if isinstance(kind, wp.array) else None)
        for name, kind in kinds
        if isinstance(kind, wp.array) or hasattr(kind, "vars")
    )


def _unlock_loading() -> None:
    global _loading, _counting
    _loading, _counting = threading.RLock(), threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(
        before=lambda: _loading.acquire(), after_in_parent=lambda: _loading.release(), after_in_child=_unlock_loading
    )
