"""How benchmarks measure: turns, seconds without compilation, device events, peak memory, errors by scatter."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import warp_gi as gi
from warp_gi import launch, metrics
from warp_gi.bench.harness import gallery, measure, scatter, scenes
from warp_gi.bench.harness.places import PLACES
from warp_gi.bench.peers import mitsuba_peer
from warp_gi.bench.suites.path import suite as path

# ---- time ----


def test_contenders_take_turns_after_a_round_that_does_not_count():
    calls = []

    def contender(name):
        return lambda index: calls.append((name, index)) or index * 10

    taken = measure.take_turns({"a": contender("a"), "b": contender("b")}, 3, keep=2)
    assert calls == [(name, index) for index in range(4) for name in "ab"]
    for one in taken.values():
        assert len(one.wall) == len(one.cpu) == 3 and one.results == [10, 20] and one.device == []
    calls.clear()
    measure.take_turns({"a": contender("a")}, 1, warm=False)
    assert calls == [("a", 1)]


def test_compilation_does_not_count(monkeypatch):
    def compiles():
        launch.compile_seconds += 5.0
        launch.compile_cpu_seconds += 3.0

    for name in ("compile_seconds", "compile_cpu_seconds"):
        monkeypatch.setattr(launch, name, getattr(launch, name))
    _, (wall, cpu), on_device = measure.clocked(compiles)
    assert -5.0 < wall < -4.0 and -3.0 < cpu < -2.0 and on_device is None


def test_on_cuda_events_count(monkeypatch):
    recorded = []
    device = SimpleNamespace(is_cuda=True, is_cpu=False, stream=SimpleNamespace(record_event=recorded.append))
    monkeypatch.setattr(launch, "get_device", lambda name: device)
    monkeypatch.setattr(wp, "Event", lambda found, enable_timing: (found, enable_timing, len(recorded)))
    monkeypatch.setattr(wp, "get_event_elapsed_time", lambda start, end: 250.0)
    taken = measure.take_turns({"a": lambda index: len(recorded)}, 2, "cuda", keep=2)["a"]
    assert taken.device == taken.counting == [0.25, 0.25] and taken.cost == 0.25
    assert taken.results == [1, 3] and recorded == [(device, True, 0)] * 2 + [(device, True, 2)] * 2
    assert taken.row()["device s"] == 0.25 and taken.row()["device s spread"] == 0.0


def test_rows_hold_medians_and_spreads():
    taken = measure.Taken(wall=[1.0, 9.0, 3.0, 2.0, 4.0], cpu=[2.0] * 5)
    assert taken.row() == {"wall s": 3.0, "wall s spread": 1.0, "cpu s": 2.0, "cpu s spread": 0.0}
    assert taken.row("ours ").keys() == {"ours wall s", "ours wall s spread", "ours cpu s", "ours cpu s spread"}
    assert taken.times == (3.0, 2.0) and taken.cost == 2.0
    # a slow machine slows both of a round: the ratios are 2, whatever the seconds are
    assert measure.ratio_and_spread("faster", [2.0, 20.0, 4.0], [1.0, 10.0, 2.0]) == {
        "faster": 2.0,
        "faster spread": 0.0,
    }


# ---- memory ----


def _fill(megabytes: int) -> None:
    assert np.ones(megabytes << 17).sum() > 0


def test_the_peak_is_of_what_was_done_since():
    if not measure._forget_peak():
        pytest.skip("the system does not forget the peak")
    outer = measure.PeakMemory()
    _fill(400)
    highest = outer.bytes
    inner = measure.PeakMemory()
    _fill(50)
    assert inner.bytes < highest - 200e6
    assert outer.bytes >= highest  # the inner one made the system forget
    assert inner.row()["peak GB"] == pytest.approx(inner.bytes / 1e9, rel=0.2)


# ---- scatter ----


def _noisy(count: int, sigma: float, seed: int, level: float = 2.0) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [(level + sigma * rng.standard_normal((40, 50, 3))).astype(np.float32) for _ in range(count)]


def test_the_scatter_of_pictures_is_their_error():
    pictures = {"a": _noisy(4, 0.1, 1), "b": _noisy(4, 0.3, 2)}
    found = scatter.errors(pictures, "b")
    assert found["RMSE"] == pytest.approx(0.3, rel=0.02) and found["bad pixels"] == 0
    assert found["relMSE"] == pytest.approx(0.3**2 / (4 + metrics.RELATIVE_EPSILON), rel=0.04)
    others = np.mean([*pictures["a"], *pictures["b"][1:]], axis=0)
    assert found["FLIP"] == pytest.approx(metrics.flip(pictures["b"][0], others), rel=1e-3)
    assert scatter.errors(pictures, "a")["FLIP"] < 0.5 * found["FLIP"]


def test_bad_pixels_are_counted_and_hidden_nowhere():
    pictures = {"a": _noisy(3, 0.1, 1), "b": _noisy(3, 0.1, 2)}
    pictures["a"][1][3, 4, 0] = np.nan
    pictures["a"][2][3, 4, 1] = pictures["a"][2][7, 7, 2] = np.inf
    found = scatter.errors(pictures, "a")
    assert found["bad pixels"] == 2 and np.isnan(found["RMSE"]) and np.isnan(found["relMSE"])


# ---- the suite `path` ----


def test_renderers_are_compared_at_equal_samples_time_and_error():
    def taken(wall: float, sigma: float, seed: int) -> measure.Taken:
        return measure.Taken([wall] * 4, [2 * wall] * 4, [], _noisy(4, sigma, seed))

    rows = path.rows_of("a case", (50, 40), 64, {"ours": taken(1.0, 0.1, 1), "mitsuba x": taken(4.0, 0.2, 2)})
    by = {(row["table"], row.get("renderer", row.get("peer"))): row for row in rows}
    assert len(by) == len(rows) == 7
    ours, theirs = by["equal samples", "ours"], by["equal samples", "mitsuba x"]
    assert (ours["pixels"], ours["spp"], ours["wall s"], theirs["cpu s"]) == ("50x40", 64, 1.0, 8.0)
    share = theirs["relMSE"] / ours["relMSE"]
    assert share == pytest.approx(4.0, rel=0.1)
    assert by["equal time", "ours"]["relMSE"] == ours["relMSE"]
    same_time = by["equal time", "mitsuba x"]
    assert same_time["samples a pixel"] == 64 / 4 and same_time["s"] == 2.0
    assert same_time["relMSE"] == pytest.approx(4 * theirs["relMSE"])
    assert same_time["RMSE"] == pytest.approx(2 * theirs["RMSE"])
    same_error = by["equal error", "mitsuba x"]
    assert same_error["wall s"] == pytest.approx(4 * share) and same_error["relMSE"] == ours["relMSE"]
    assert same_error["samples a pixel"] == pytest.approx(64 * share)
    beside = by["beside peers", "mitsuba x"]
    assert beside["faster, wall"] == beside["faster, cpu"] == 4.0
    assert beside["error ratio"] == pytest.approx(1 / share)
    assert beside["faster at equal error, cpu"] == pytest.approx(4 * share)
    assert abs(beside["means differ"]) < 0.01


def test_mitsuba_is_the_same_in_both_variants():
    scene = scenes.peer_scene(gi.builtin_scene("cornell_box"), diffuse=True)
    camera = PLACES["cornell_box"].camera().at_resolution(24, 16)
    try:
        renderers = [mitsuba_peer.renderer(scene, camera, path._path(3), 64, variant) for variant in path.VARIANTS]
    except mitsuba_peer.PeerMissing as missing:
        pytest.skip(str(missing))
    pictures = [np.array([render(seed) for seed in range(4)]) for _ in range(2) for render in renderers]  # in turns
    np.testing.assert_array_equal(pictures[0], pictures[2])
    llvm, scalar = (picture.mean(axis=(1, 2, 3)) for picture in pictures[:2])
    error = (np.var(llvm, ddof=1) / 4 + np.var(scalar, ddof=1) / 4) ** 0.5
    assert abs(llvm.mean() - scalar.mean()) < 5 * error + 1e-3 * llvm.mean()
    assert pictures[0].shape == (4, 16, 24, 3)


# ---- apart from the rest ----


def test_peers_on_the_host_have_no_device_seconds(monkeypatch):
    asked = []
    monkeypatch.setattr(measure, "clocked", lambda work, device: (asked.append(device), (1.0, 1.0), None))
    measure.take_turns({"a": lambda index: None, "peer": lambda index: None}, 1, "cuda", host=("peer",))
    assert asked == ["cuda", "cpu"]


def test_a_part_that_fails_is_a_row_and_the_rest_goes_on():
    def fails():
        raise RuntimeError("out of\nluck")

    assert measure.attempt({"case": "a"}, fails) == [{"case": "a", "failed": "RuntimeError: out of luck"}]
    assert measure.attempt({"case": "a"}, lambda: [{"x": 1}]) == [{"x": 1}]
    parts = {"one": lambda quick, device: fails(), "two": lambda quick, device: [{"quick": quick}]}
    rows = gallery.run_parts(parts, (), True, "cpu", gallery.CLOSED)
    assert rows == [{"part": "one", "failed": "RuntimeError: out of luck"}, {"quick": True}]
    assert gallery.run_parts(parts, ["two"], False, "cpu", gallery.CLOSED) == [{"quick": False}]


def test_a_process_has_our_threads_and_says_why_it_failed(tmp_path, monkeypatch):
    (tmp_path / "said.py").write_text(
        "import json, os, sys\n"
        "print('first'), print(json.dumps({k: os.environ.get(k) for k in ('WARP_GI_THREADS', 'GIVEN')}))\n"
        "if sys.argv[1:]: print('a line'), sys.exit(sys.argv[1])\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(launch, "_threads", 3)
    assert measure.in_process(["said"], GIVEN="yes") == {"WARP_GI_THREADS": "3", "GIVEN": "yes"}
    assert measure.in_process(["said", "no luck"]) == {"failed": "no luck"}


def test_mitsuba_takes_no_punctual_lights():
    scene = gi.Scene(gi.builtin_scene("cornell_box").nodes, [gi.PunctualLight("point", (1.0, 1.0, 1.0), (0, 1, 0))])
    with pytest.raises(ValueError, match="punctual lights are not converted"):
        mitsuba_peer.to_mitsuba(scene, PLACES["cornell_box"].camera())
