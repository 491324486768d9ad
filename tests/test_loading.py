"""Kernel modules that threads load ahead: which, in what order, who waits, what is said, and forks."""

import logging
import subprocess
import sys
import threading
from types import SimpleNamespace

import pytest
import warp as wp

import warp_gi as gi
from warp_gi import launch, loading
from warp_gi.foretold import kernels_of
from warp_gi.kernels import bvh_build

CPU = wp.get_device("cpu")


class Module:
    """A module that takes as long to load as the test says; ``loaded`` lists who did."""

    def __init__(self, name, loaded, gate=None, error=None):
        self.name, self.loaded, self.gate, self.error = name, loaded, gate, error
        self.begun, self.options = threading.Event(), {"cpu_compiler_flags": None}

    def load(self, device, block):
        self.begun.set()
        if self.gate is not None:
            self.gate.wait(20)
        self.loaded.append((self.name, threading.current_thread()))
        if self.error is not None:
            raise self.error

    def get_module_identifier(self, block):
        return f"{self.name}_hash"


def kernel(*arguments, **more):
    return SimpleNamespace(module=Module(*arguments, **more))


def names(loaded):
    return [name for name, _ in loaded]


@pytest.fixture
def two_threads():
    launch.set_threads(2)
    yield
    launch.set_threads(None)
    while loading._threads:
        threading.Event().wait(0.01)
    assert not loading._jobs and not loading._queue


def test_modules_load_side_by_side_and_a_launch_waits_for_its_own(two_threads):
    loaded, gates = [], [threading.Event() for _ in range(2)]
    kernels = [kernel(f"side_{index}", loaded, gate) for index, gate in enumerate(gates)]
    before = launch.compile_seconds
    launch.load_ahead(kernels, CPU)
    for one in kernels:
        assert one.module.begun.wait(20)  # the second one, too, while the first one is not done
    assert launch.compile_seconds == before  # nobody has waited yet
    gates[1].set()
    launch.load(kernels[1], CPU)
    assert names(loaded) == ["side_1", "side_1"]  # by its thread, then looked at here
    assert loaded[0][1] is not threading.main_thread() and loaded[1][1] is threading.main_thread()
    assert launch.compile_seconds > before
    gates[0].set()
    launch.load(kernels[0], CPU)


def test_who_is_waited_for_comes_next_and_what_is_not_wanted_any_more_never(two_threads):
    loaded, gates = [], [threading.Event() for _ in range(2)]
    busy = [kernel(f"busy_{index}", loaded, gate) for index, gate in enumerate(gates)]
    queued = [kernel(f"queued_{index}", loaded) for index in range(3)]
    launch.load_ahead([*busy, *queued], CPU)
    for one in busy:
        assert one.module.begun.wait(20)
    launch.load_ahead([*busy, queued[0], queued[2]], CPU)
    waiting = threading.Thread(target=launch.load, args=(queued[2], CPU))
    waiting.start()
    while loading._queue[0].name != "queued_2":
        threading.Event().wait(0.01)
    gates[0].set()
    waiting.join(20)
    launch.load(queued[0], CPU)
    gates[1].set()
    launch.load(busy[1], CPU)
    by_threads = [name for name, thread in loaded if thread.name == "warp_gi loading"]
    assert by_threads == ["busy_0", "queued_2", "queued_0", "busy_1"]
    assert "queued_1" not in names(loaded)


def test_an_error_is_raised_where_the_kernel_is_launched(two_threads):
    broken = kernel("broken", [], error=RuntimeError("no such type"))
    launch.load_ahead([broken], CPU)
    with pytest.raises(RuntimeError, match="no such type"):
        launch.load(broken, CPU)


def test_one_thread_loads_nothing_ahead():
    loaded = []
    launch.set_threads(1)
    try:
        launch.load_ahead([kernel("alone", loaded)], CPU)
    finally:
        launch.set_threads(None)
    assert not loading._jobs and not loaded


def test_a_fork_waits_for_those_that_load_and_the_child_has_no_queue(two_threads):
    gate, held = threading.Event(), threading.Event()
    one = kernel("forked", [], gate)
    launch.load_ahead([one], CPU)
    assert one.module.begun.wait(20)

    def fork():
        loading._hold()
        held.set()
        loading._let_go()

    thread = threading.Thread(target=fork)
    thread.start()
    assert not held.wait(0.3)
    gate.set()
    assert held.wait(20)
    thread.join()


def test_what_a_forked_process_starts_with(monkeypatch):
    for name, value in (
        ("_locks", {"old": 1}),
        ("_queue", [1]),
        ("_jobs", {"old": 1}),
        ("_held", [1]),
        ("_threads", 2),
    ):
        monkeypatch.setattr(loading, name, value)
    monkeypatch.setattr(loading, "_lock", loading._lock)
    loading._start_afresh()
    assert not (loading._locks or loading._queue or loading._jobs or loading._held or loading._threads)


def test_flags_are_set_before_a_module_is_hashed_unless_somebody_set_some():
    module = bvh_build.fill_nodes.module
    loading.prepare(module)
    assert module.options["cpu_compiler_flags"] == f"{wp.config.cpu_compiler_flags} {loading.FLAG}"
    before = module.get_module_hash(1)
    loading.prepare(module)
    assert module.get_module_hash(1) == before
    own = SimpleNamespace(name="warp_gi.kernels.own", options={"cpu_compiler_flags": "-O1"})
    others = SimpleNamespace(name="someone.else", options={"cpu_compiler_flags": None})
    for module, flags in ((own, "-O1"), (others, None)):
        loading.prepare(module)
        assert module.options["cpu_compiler_flags"] == flags


def test_one_line_says_what_is_compiled_for_the_first_time(monkeypatch, tmp_path, caplog, two_threads):
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    (tmp_path / "there_hash").mkdir()
    kernels = [kernel(name, []) for name in ("there", "new", "newer", "new")]
    with caplog.at_level(logging.INFO, "warp_gi"):
        launch.load_ahead(kernels[:1], CPU)
        assert not caplog.messages
        launch.load_ahead(kernels, CPU)
    seconds = int(loading.HEADER_SECONDS + loading.MODULE_SECONDS + 0.5)
    assert caplog.messages == [
        f"compiling kernels for the first time: 2 modules, about {seconds} s; kept in {tmp_path} for next time"
    ]
    for one in kernels:
        launch.load(one, CPU)


@pytest.mark.parametrize("sky", [None, gi.SunSky(elevation=30.0)], ids=["no sky", "sun"])
@pytest.mark.parametrize("preset", ["path", "clean", "reuse"])
def test_the_kernels_that_a_pipeline_foretells_are_those_that_its_frames_launch(monkeypatch, preset, sky):
    """Add what is missing to ``kernels`` or ``samplers`` of the part that launches it; take out what no frame does."""
    scene = gi.builtin_scene("cornell_box")
    scene.environment = sky
    scene.lights = [gi.PunctualLight("point", (0.3, 1.5, 0.2)), gi.PunctualLight("point", (-0.3, 1.5, 0.2))]
    pipeline = gi.Pipeline.preset(preset)
    loaded = set()
    monkeypatch.setattr(launch, "on_load", loaded.add)
    monkeypatch.setattr(launch, "_loaded", set())
    scheduler = gi.FrameScheduler(scene, scene.cameras["main"].at_resolution(16, 12), pipeline, seed=1)
    scheduler.frame(0)
    foretold = {one.module.name for one in kernels_of(scheduler.pipeline, scene)}
    assert foretold == loaded
    early = {one.module.name for one in kernels_of(pipeline)}
    assert early >= {name for name in foretold if "path_trace" not in name and "apart" not in name}


@pytest.mark.parametrize("ends", ["while it loads", "before"])
def test_a_thread_that_renders_after_the_main_one_ended_is_done_in_the_end(ends):
    """Nobody loads ahead any more then, and who waits for a module loads it."""
    script = f"""
import threading, time
import warp_gi as gi
scene, pipeline = gi.builtin_scene("cornell_box"), gi.Pipeline(spp=1)
camera = scene.cameras["main"].at_resolution(16, 12)
scheduler = gi.FrameScheduler(scene, camera, pipeline)
render = gi.render
def work():
    {"time.sleep(0.5)" if ends == "before" else "pass"}
    frame = next(render(scene, camera, pipeline))
    print("done", frame.numpy("beauty").mean() > 0, flush=True)
threading.Thread(target=work).start()
"""
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert "done True" in result.stdout and result.returncode == 0
