"""The launcher: slices, threads, and the checks that Warp does not make."""

import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from warp_gi import launch, loading
from warp_gi.errors import OptionError

CPU = wp.get_device("cpu")


@wp.struct
class Pair:
    values: wp.array(dtype=wp.float32)
    factor: wp.float32


@wp.struct
class OtherPair:
    values: wp.array(dtype=wp.float32)
    factor: wp.float32


@wp.kernel(enable_backward=False)
def scale_items(first: wp.int32, pair: Pair, out: wp.array(dtype=wp.float32)):
    i = first + wp.tid()
    out[i] = pair.values[i] * pair.factor + wp.float32(i)


@wp.kernel(enable_backward=False)
def without_first(out: wp.array(dtype=wp.float32)):
    out[wp.tid()] = 1.0


def make_pair(struct=Pair, values=None):
    pair = struct()
    pair.values = wp.array(np.arange(5000, dtype=np.float32), device=CPU) if values is None else values
    pair.factor = 2.0
    return pair


@pytest.fixture(autouse=True)
def default_threads():
    yield
    launch.set_threads(None)


@pytest.mark.parametrize("threads", [1, 2, 3, 7])
def test_every_item_once_on_any_number_of_threads(threads):
    launch.set_threads(threads)
    out = wp.zeros(5000, dtype=wp.float32, device=CPU)
    launch.launch(scale_items, 5000, [make_pair(), out], CPU)
    assert (out.numpy() == 3 * np.arange(5000)).all()


def test_no_items_is_no_launch():
    out = wp.zeros(1, dtype=wp.float32, device=CPU)
    launch.launch(scale_items, 0, [make_pair(), out], CPU)
    assert out.numpy()[0] == 0


def test_wrong_arguments_raise():
    out = wp.zeros(5000, dtype=wp.float32, device=CPU)
    cases = [
        (scale_items, [make_pair(OtherPair), out], "expected struct"),
        (scale_items, [make_pair(), out.numpy()], "expected a wp.array"),
        (scale_items, [make_pair(), wp.zeros(5, dtype=wp.int32, device=CPU)], "expected dtype"),
        (scale_items, [make_pair(), wp.zeros((5, 5), dtype=wp.float32, device=CPU)], "dimensions"),
        (scale_items, [make_pair()], "takes 2 inputs"),
        (without_first, [], "first argument"),
    ]
    for kernel, inputs, words in cases:
        with pytest.raises(TypeError, match=words):
            launch.launch(kernel, 5, inputs, CPU)


@pytest.mark.parametrize("count", [0, -1, "many", 1.5])
def test_bad_thread_counts(count):
    with pytest.raises(OptionError, match="thread count"):
        launch.set_threads(count)


def test_thread_count_from_the_environment(monkeypatch):
    monkeypatch.setenv("WARP_GI_THREADS", "3")
    assert launch.thread_count() == 3
    monkeypatch.setenv("WARP_GI_THREADS", "none")
    with pytest.raises(OptionError):
        launch.thread_count()


def test_missing_device_names_the_ones_there():
    with pytest.raises(OptionError, match="cpu"):
        launch.get_device("cuda:99")


def test_loading_is_timed_on_the_wall_and_the_cores(monkeypatch):
    for name in ("compile_seconds", "compile_cpu_seconds"):
        monkeypatch.setattr(launch, name, 0.0)
    module = SimpleNamespace(name="slow", get_module_identifier=lambda block: "slow")
    module.load = lambda device, block: (time.sleep(0.2), sum(range(10**6)))
    launch.load(SimpleNamespace(module=module), CPU)
    assert launch.compile_seconds > launch.compile_cpu_seconds + 0.1 and launch.compile_cpu_seconds > 0


def test_a_module_is_announced_until_it_is_loaded(monkeypatch):
    told = []

    def fail_once(name):
        told.append(name)
        if len(told) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(launch, "on_load", fail_once)
    module = SimpleNamespace(name="announced", load=lambda device, block: None)
    module.get_module_identifier = lambda block: "announced"
    kernel = SimpleNamespace(module=module)
    with pytest.raises(KeyboardInterrupt):
        launch.load(kernel, CPU)
    for _ in range(2):
        launch.load(kernel, CPU)
    assert told == ["announced"] * 2


def test_the_linker_is_called_under_the_lock_that_a_fork_takes(monkeypatch):
    """A fork while another thread is inside would leave a child that waits for ever when it links."""
    library = wp._src.context.runtime.llvm
    look_up, was_free = library.wp_lookup, []

    def spy(*arguments):
        thread = threading.Thread(target=lambda: was_free.append(launch._loading.acquire(blocking=False)))
        thread.start()
        thread.join()
        return look_up(*arguments)

    @wp.kernel(enable_backward=False, module="unique")
    def count(first: wp.int32, out: wp.array(dtype=wp.int32)):
        out[first + wp.tid()] = first + wp.tid()

    monkeypatch.setattr(library, "wp_lookup", spy)
    out = wp.zeros(5000, dtype=wp.int32, device=CPU)
    launch.launch(count, 5000, [out], CPU)
    assert was_free == [False] and (out.numpy() == np.arange(5000)).all()


def test_of_two_processes_one_compiles_a_module(tmp_path, monkeypatch):
    """The other one waits, and finds the module in the cache; what is no kernel of this package is left alone."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    module = SimpleNamespace(name="warp_gi.kernels.made_up", get_module_identifier=lambda block: f"wp_made_up_{block}")
    order = []

    def compile_it(name, inside):
        with loading.alone(SimpleNamespace(module=module), 1):
            order.append(f"{name} begins, {'found' if (tmp_path / 'wp_made_up_1').is_dir() else 'compiles'}")
            inside()
            (tmp_path / "wp_made_up_1").mkdir(exist_ok=True)
            order.append(f"{name} ends")

    second = threading.Thread(target=compile_it, args=("second", lambda: None))
    compile_it("first", lambda: (second.start(), time.sleep(0.2)))
    second.join()
    compile_it("third", lambda: None)
    parts = [(name, f"{name} ends") for name in ("first", "second", "third")]
    found = ["compiles", "found", "found"]
    assert order == [x for (name, end), what in zip(parts, found, strict=True) for x in (f"{name} begins, {what}", end)]
    assert [path.name for path in tmp_path.iterdir()] == ["wp_made_up_1"]
