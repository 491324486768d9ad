"""Interrupts at every place of a launch and a frame, and generators that are left: what comes after is right."""

from __future__ import annotations

import _thread
import gc
import signal
import sys
import tempfile
import threading
import time

import numpy as np
import pytest
import warp as wp
from concurrency_tools import buffers, differing, frames, main, moving_room, run_case, scheduler, still_path

import warp_gi as gi
from warp_gi import bvh, launch, workers
from warp_gi.scene import geometry
from warp_gi.scene.device_scene import DeviceScene

COUNT = 5000


@wp.kernel(enable_backward=False)
def count_up(first: wp.int32, out: wp.array(dtype=wp.int32)):
    i = first + wp.tid()
    out[i] = out[i] + 1


def launch_once(out):
    launch.launch(count_up, len(out), [out], launch.get_device("cpu"))


def assert_launches_work():
    """Assert that nobody is in a launch, and that the next one does each item once."""
    assert not workers._open
    out = wp.zeros(COUNT, dtype=wp.int32, device="cpu")
    launch_once(out)
    assert (out.numpy() == 1).all()


def assert_free(*locks):
    """Assert that another thread may take the locks."""
    free = []

    def take():
        for lock in locks:
            if lock.acquire(blocking=False):
                lock.release()
                free.append(lock)

    thread = threading.Thread(target=take)
    thread.start()
    thread.join()
    assert free == list(locks)


class InterruptAt:
    """Raises KeyboardInterrupt in this thread at the n-th place where CPython looks for signals: calls and returns.

    Only within files whose name ends on one of ``files``. ``came`` says whether there were as many.
    """

    def __init__(self, place: int, *files: str) -> None:
        self.left, self.files, self.came = place, files, False

    def __enter__(self):
        sys.setprofile(self.look)
        return self

    def __exit__(self, *_):
        sys.setprofile(None)

    def look(self, frame, event, function):
        if event not in ("call", "c_return") or not frame.f_code.co_filename.endswith(self.files):
            return
        if self.left == 0 and not self.came:
            self.came = True
            raise KeyboardInterrupt
        self.left -= 1


# ---- cases: each runs in a process of its own ----


def interrupt_a_launch_everywhere():
    """At every place in the launcher and what it calls, with workers there already and with none."""
    files = ("launch.py", "workers.py", "context.py", "thread.py", "threading.py", "_base.py")
    assert_launches_work()
    for fresh in (False, True):
        place, interrupts = 0, 0
        while True:
            if fresh:
                workers._forget_workers()  # those of before wait for ever for work that never comes
            out = wp.zeros(COUNT, dtype=wp.int32, device="cpu")
            try:
                with InterruptAt(place, *files) as interrupt:
                    launch_once(out)
            except KeyboardInterrupt:
                interrupts += 1
                after = out.numpy().copy()
                assert after.max() <= 1
            assert_launches_work()
            assert_free(launch._loading)
            if not interrupt.came:
                break
            if interrupts > place:  # it left the launch, so none of it goes on
                assert (out.numpy() == after).all()
            place += 1
        assert (out.numpy() == 1).all()
        assert interrupts == place > 50, (interrupts, place)


def interrupt_the_compiler():
    """At places all over the compilation of a kernel: it compiles the next time, and so do others."""

    def make_kernel(factor):
        @wp.kernel(enable_backward=False, module="unique")
        def multiply(first: wp.int32, out: wp.array(dtype=wp.int32)):
            i = first + wp.tid()
            out[i] = out[i] + i * wp.static(factor)

        return multiply

    files = ("launch.py", "context.py", "build.py", "codegen.py", "tempfile.py", "shutil.py")
    out, cpu = wp.zeros(COUNT, dtype=wp.int32, device="cpu"), launch.get_device("cpu")
    launch.set_threads(1)  # a worker takes as many slices as it comes to, and this thread's places are those left
    with tempfile.TemporaryDirectory() as folder:
        wp.config.kernel_cache_dir = folder
        launch.launch(make_kernel(1), COUNT, [out], cpu)  # makes what all compilations share
        kernel = make_kernel(2)
        with InterruptAt(10**9, *files) as counted:
            launch.launch(kernel, COUNT, [out], cpu)
        places = 10**9 - counted.left
        for factor in range(3, 15):
            kernel = make_kernel(factor)
            with InterruptAt(int(places * (factor - 2.5) / 13), *files), pytest.raises(KeyboardInterrupt):
                launch.launch(kernel, COUNT, [out], cpu)
            out.zero_()
            launch.launch(kernel, COUNT, [out], cpu)
            assert (out.numpy() == factor * np.arange(COUNT)).all(), factor
            assert_free(launch._loading)


def interrupt_the_wait():
    """Once, and again while the first interrupt waits: the exception comes when the worker's slice has ended."""
    for times in (1, 2, 5):
        begun, ended, ran = threading.Event(), threading.Event(), []

        def run(index, begun=begun, ended=ended, ran=ran, times=times):
            ran.append(index)
            if threading.current_thread() is threading.main_thread():
                begun.wait()
                return
            begun.set()
            for _ in range(times):
                time.sleep(0.05)
                _thread.interrupt_main()
            time.sleep(0.05)
            ended.set()

        with pytest.raises(KeyboardInterrupt):
            workers.share(run, 2, 2)
        assert ended.is_set() and sorted(ran) == [0, 1]
        assert_launches_work()


def interrupt_the_slices():
    """The slices that nobody has begun are not begun after an interrupt; those begun end before it leaves."""
    begun, ran, ended = threading.Event(), [], []

    def run(index):
        ran.append(index)
        if threading.current_thread() is threading.main_thread():
            begun.wait()
            raise KeyboardInterrupt
        begun.set()
        time.sleep(0.2)
        ended.append(index)

    with pytest.raises(KeyboardInterrupt):
        workers.share(run, 100, 2)
    assert len(ran) == 2 and len(ended) == 1
    time.sleep(0.3)
    assert len(ran) == 2


def interrupt_frames_at_many_times():
    """A timer's interrupt anywhere in frames of a moving scene; afterwards frames are right to the last bit."""
    scene = moving_room()
    wanted = frames(scene, range(4))
    started = time.perf_counter()
    frames(scene, range(4))
    whole = time.perf_counter() - started
    interrupts, struck = 0, []

    def strike(*_):
        struck.append(True)
        raise KeyboardInterrupt

    signal.signal(signal.SIGALRM, strike)
    for trial in range(120):
        struck.clear()
        used = scene if trial % 2 else moving_room()  # a new one is built in the first frame
        try:
            try:
                signal.setitimer(signal.ITIMER_REAL, max(whole * (trial + 0.5) / 120, 1e-6))
                frames(used, range(4))
            finally:
                signal.setitimer(signal.ITIMER_REAL, 0)
        except (KeyboardInterrupt, RuntimeError):  # NumPy may swallow one where it compares types; Warp then complains
            if not struck:
                raise
            interrupts += 1
        assert not workers._open
        assert_free(used.lock, launch._loading)
        index = trial % 4
        assert differing(frames(used, [index]), [wanted[index]]) == [], trial
    assert interrupts > 10, interrupts


def leave_generators():
    """Left half-way, closed, collected or left by an exception, on the main thread or another."""
    scene = moving_room()
    wanted = frames(scene, range(4))
    kept = []

    def begin():
        found = gi.render(scene, still_path(scene), gi.Pipeline(spp=2), range(4), seed=1)
        return found, [buffers(next(found)), buffers(next(found))]

    def leave():
        found, first = begin()
        kept.append(found)  # never gone on with
        found, second = begin()
        found.close()
        found, third = begin()
        del found
        gc.collect()
        try:
            for frame in gi.render(scene, still_path(scene), gi.Pipeline(spp=2), range(4), seed=1):
                fourth = buffers(frame)
                raise ValueError
        except ValueError:
            pass
        for part in (first, second, third):
            assert differing(part, wanted[:2]) == []
        assert differing([fourth], wanted[:1]) == []

    def guarded():
        try:
            leave()
        except BaseException as error:
            failures.append(error)
            raise

    failures: list[BaseException] = []
    leave()
    thread = threading.Thread(target=guarded)
    thread.start()
    thread.join()
    assert not failures
    assert differing(frames(scene, range(4)), wanted) == []
    rest = [buffers(next(kept[1])), buffers(next(kept[1]))]  # the main thread goes on with what another one began
    assert differing(rest, wanted[2:]) == []


CASES = (
    interrupt_a_launch_everywhere,
    interrupt_the_compiler,
    interrupt_the_wait,
    interrupt_the_slices,
    interrupt_frames_at_many_times,
    leave_generators,
)


# ---- tests ----


@pytest.mark.parametrize("case", [case.__name__ for case in CASES])
def test_interrupts(case):
    if case == "interrupt_frames_at_many_times" and not hasattr(signal, "setitimer"):
        pytest.skip("this system has no interval timer")
    run_case(__file__, case)


@pytest.mark.parametrize(
    "owner, name", [(geometry, "place"), (bvh.TriangleBvh, "refit"), (DeviceScene, "_bound_emitters")]
)
def test_an_interrupt_while_the_scene_moves(monkeypatch, owner, name):
    """Whatever was moved and whatever not, the next frame moves it all."""
    scene = moving_room()
    renderer = scheduler(scene)
    wanted = [buffers(renderer.frame(index)) for index in (0, 6)]
    renderer.frame(0)

    def strike(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(owner, name, strike)
        with pytest.raises(KeyboardInterrupt):
            renderer.frame(6)
    assert differing([buffers(renderer.frame(6))], wanted[1:]) == []
    assert differing([buffers(renderer.frame(0))], wanted[:1]) == []


def test_an_error_in_a_slice_is_raised_once_all_have_ended():
    ran = []

    def run(index):
        ran.append(index)
        time.sleep(0.01)
        if index == 3:
            raise ValueError("slice 3")

    with pytest.raises(ValueError, match="slice 3"):
        workers.share(run, 64, 3)
    count = len(ran)
    assert 4 <= count < 64
    time.sleep(0.05)
    assert len(ran) == count and not workers._open


def test_launches_without_any_further_thread(monkeypatch):
    def refuse(*_):
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(_thread, "start_new_thread", refuse)
    monkeypatch.setattr(workers, "_hired", 0)
    monkeypatch.setattr(workers, "_offers", type(workers._offers)())
    ran = []
    workers.share(ran.append, 10, 4)
    assert ran == list(range(10))


def test_a_launch_keeps_no_arrays():
    """Neither the workers nor offers that none has looked at."""
    out = wp.zeros(COUNT, dtype=wp.int32, device="cpu")
    launch.set_threads(4)
    try:
        launch_once(out)
        held = sys.getrefcount(out)
        for _ in range(20):
            launch_once(out)
    finally:
        launch.set_threads(None)
    deadline = time.monotonic() + 10
    while sys.getrefcount(out) > held and time.monotonic() < deadline:
        time.sleep(0.01)
    assert sys.getrefcount(out) <= held
    assert np.array_equal(out.numpy(), np.full(COUNT, 21))


if __name__ == "__main__":
    launch.set_threads(2)
    main(*CASES)
