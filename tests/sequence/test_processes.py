"""Processes that are forked or spawned from one that renders: their pictures are the same, and nothing hangs."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import sys
import tempfile
import threading
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp
from concurrency_tools import buffers, differing, frames, main, moving_room, run_case, scheduler

from warp_gi import forks, launch, workers
from warp_gi.errors import OptionError
from warp_gi.forks import Guard
from warp_gi.sequence.exr import read_exr, write_exr

CPU = "cpu"
needs_fork = pytest.mark.skipif(not hasattr(os, "fork"), reason="this system does not fork")


def make_kernel(factor):
    @wp.kernel(enable_backward=False, module="unique")
    def multiply(first: wp.int32, out: wp.array(dtype=wp.float32)):
        i = first + wp.tid()
        out[i] = wp.float32(i) * wp.static(float(factor))

    return multiply


def launches_right(kernel, factor):
    """Return whether a launch large enough to be shared gives what it should."""
    out = wp.zeros(20_000, dtype=wp.float32, device=CPU)
    launch.launch(kernel, len(out), [out], launch.get_device(CPU))
    return bool((out.numpy() == factor * np.arange(20_000, dtype=np.float32)).all())


def in_fork(work):
    """Return what ``work()`` returns in a process forked now; raises EOFError if that one ends without."""
    reader, writer = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            with os.fdopen(writer, "wb") as pipe:
                pickle.dump(work(), pipe)
        finally:
            os._exit(0)
    os.close(writer)
    with os.fdopen(reader, "rb") as pipe:
        result = pickle.load(pipe)
    os.waitpid(child, 0)
    return result


# ---- cases: each runs in a process of its own ----


def render_in_workers():
    """What a data loader does: workers forked from a process that has rendered; they fork once more."""
    scene = moving_room()
    wanted = frames(scene, range(4))
    assert workers._hired == 1  # the launches above were shared
    with multiprocessing.get_context("fork").Pool(2) as pool:
        parts = [pool.apply_async(frames, (moving_room(), range(4))) for _ in range(4)]
        for part in parts:
            assert differing(part.get(), wanted) == []
    assert differing(in_fork(lambda: frames(scene, range(4))), wanted) == []
    assert differing(in_fork(lambda: in_fork(lambda: frames(scene, range(4)))), wanted) == []
    renderer = scheduler(scene)
    begun = [buffers(renderer.frame(index)) for index in range(2)]
    rest = in_fork(lambda: [buffers(renderer.frame(index)) for index in range(2, 4)])  # the parent's own scheduler
    assert differing(begun + rest, wanted) == []
    assert differing(frames(scene, range(4)), wanted) == []


def render_first_in_the_child():
    """The parent has loaded nothing and started no thread before the child renders."""
    scene = moving_room()
    found = in_fork(lambda: frames(scene, range(3)))
    assert workers._hired == 0
    assert differing(found, frames(scene, range(3))) == []


def compile_in_the_child():
    """Kernels that the child is first to compile, from a parent that has compiled others."""
    with tempfile.TemporaryDirectory() as folder:
        wp.config.kernel_cache_dir = folder
        kernels = {factor: make_kernel(factor) for factor in (2, 3)}
        assert launches_right(kernels[2], 2)
        assert in_fork(lambda: launches_right(kernels[3], 3) and launches_right(kernels[2], 2))
        assert launches_right(kernels[3], 3)


def fork_while_a_thread_compiles():
    """The compiler of the parent has locks that the child cannot open: fork waits for it."""
    with tempfile.TemporaryDirectory() as folder:
        wp.config.kernel_cache_dir = folder
        kernels = {factor: make_kernel(factor) for factor in (2, 3)}
        compiles = threading.Event()
        launch.on_load = lambda name: compiles.set()
        thread = threading.Thread(target=launches_right, args=(kernels[2], 2))
        thread.start()
        compiles.wait()
        assert in_fork(lambda: launches_right(kernels[3], 3))
        thread.join()


def fork_while_modules_load_ahead():
    """The fork waits for what has begun; the child loads by itself what it launches."""
    launch.set_threads(2)
    with tempfile.TemporaryDirectory() as folder:
        wp.config.kernel_cache_dir = folder
        kernels = {factor: make_kernel(factor) for factor in (2, 3, 4)}
        launch.load_ahead(kernels.values(), launch.get_device("cpu"))
        assert in_fork(lambda: all(launches_right(kernels[factor], factor) for factor in (4, 3, 2)))
        assert all(launches_right(kernels[factor], factor) for factor in (2, 3, 4))


def fork_while_a_thread_renders():
    """The child gets a scene that is half moved, and locks that a thread holds which it does not have."""
    scene = moving_room()
    wanted = frames(scene, range(6))
    ends = threading.Event()

    def render_on():
        while not ends.is_set():
            frames(scene, range(6))

    thread = threading.Thread(target=render_on)
    thread.start()
    try:
        for _ in range(8):
            assert in_fork(lambda: differing(frames(scene, (5, 2)), [wanted[5], wanted[2]])) == []
    finally:
        ends.set()
        thread.join()
    assert differing(frames(scene, range(6)), wanted) == []


def fork_in_a_launch():
    """A fork by the thread that launches, as a signal's handler may: its child lacks what a worker was at."""
    begun, forked = threading.Event(), threading.Event()
    results = []

    def run(index):
        if threading.current_thread() is not threading.main_thread():
            begun.set()
            forked.wait()
        elif not results:
            begun.wait()
            child = os.fork()
            results.append(child)
            forked.set()

    try:
        workers.share(run, 8, 2)
    except RuntimeError as error:
        os._exit(7 if results == [0] and "forked in the middle" in str(error) else 1)
    _, status = os.waitpid(results[0], 0)
    assert os.waitstatus_to_exitcode(status) == 7


def write_exr_in_the_child():
    """OpenEXR has threads while it writes, which a child lacks: none stay, and a fork waits until a file is done."""
    launch.set_threads(2)
    values = {"beauty": np.random.default_rng(1).random((96, 128, 3), np.float32)}
    with tempfile.TemporaryDirectory() as folder:
        path, other = Path(folder) / "parent.exr", Path(folder) / "child.exr"
        write_exr(path, values, {}, "float")
        assert in_fork(lambda: [write_exr(other, values, {}, "float") for _ in range(2)]) == [None, None]
        assert path.read_bytes() == other.read_bytes()
        assert np.array_equal(read_exr(other)[0]["beauty"], values["beauty"])
        writer = threading.Thread(target=lambda: [write_exr(path, values, {}, "float") for _ in range(20)])
        writer.start()
        while writer.is_alive():
            assert in_fork(lambda: write_exr(other, values, {}, "float")) is None


def render_in_other_processes(method):
    """Processes that start afresh get a scene that is sent to them."""
    scene = moving_room()
    wanted = frames(scene, range(2))
    with multiprocessing.get_context(method).Pool(1) as pool:
        assert differing(pool.apply(frames, (moving_room(), range(2))), wanted) == []


def ask_for_cuda_in_the_child():
    """CUDA fails in a process forked after it started: an error says so and what to do. No GPU is needed here."""
    cuda = SimpleNamespace(is_cuda=True, is_cpu=False, alias="cuda:0")
    room = moving_room()
    context = sys.modules["warp._src.context"]

    def ask():
        wp.is_cuda_available, wp.get_device = lambda: True, lambda name: cuda
        for render in (lambda: scheduler(room, device="cuda"), lambda: launch.launch(None, 1, [], cuda)):
            try:
                render()
            except OptionError as error:
                assert "'cuda:0' cannot be used here: this process was forked" in str(error) and "'spawn'" in str(error)
            else:
                return False
        return True

    assert not in_fork(lambda: forks.has_lost_cuda)
    context.is_cuda_available = lambda: True  # as where there is a GPU
    assert not in_fork(lambda: forks.has_lost_cuda)  # Warp has not started, so the child may start it
    launch.get_device(CPU)
    assert in_fork(ask)


FORKING = (
    render_in_workers,
    render_first_in_the_child,
    compile_in_the_child,
    fork_while_a_thread_compiles,
    fork_while_modules_load_ahead,
    fork_while_a_thread_renders,
    fork_in_a_launch,
    write_exr_in_the_child,
)


# ---- tests ----


@needs_fork
@pytest.mark.parametrize("case", [case.__name__ for case in FORKING])
def test_forked_processes(case):
    run_case(__file__, case)


@pytest.mark.parametrize("method", ["spawn", "forkserver"])
def test_processes_that_start_afresh(method):
    if method not in multiprocessing.get_all_start_methods():
        pytest.skip(f"this system has no {method}")
    run_case(__file__, "render_in_other_processes", method)


def test_a_lock_is_not_sent_along():
    guard = Guard()
    with guard.lock:
        sent = pickle.loads(pickle.dumps(guard))
        free = []
        thread = threading.Thread(target=lambda: free.append(sent.lock.acquire(blocking=False)))
        thread.start()
        thread.join()
    assert free == [True]


@needs_fork
def test_cuda_after_a_fork_is_an_error():
    run_case(__file__, "ask_for_cuda_in_the_child")


if __name__ == "__main__":
    launch.set_threads(2)
    main(*FORKING, render_in_other_processes, ask_for_cuda_in_the_child)
    sys.exit(0)
