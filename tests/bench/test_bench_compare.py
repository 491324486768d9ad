"""`warp-gi bench compare`: errors, turns, equal errors, and the command on a scene small enough for every test run."""

from __future__ import annotations

import json

import numpy as np
import pytest

import warp_gi as gi
from warp_gi import metrics
from warp_gi.bench.compare import rows as compare_rows
from warp_gi.bench.compare import run as compare
from warp_gi.bench.compare.columns import COLUMNS
from warp_gi.bench.compare.reference import Reference, StillFrames, computed, from_file
from warp_gi.bench.compare.run import Point, Run, seconds_to
from warp_gi.bench.compare.setup import baked
from warp_gi.bench.harness import records
from warp_gi.cli import main as cli
from warp_gi.sequence.exr import write_exr

SHAPE = (32, 48, 3)


def noisy(truth: np.ndarray, sigma: float, seed: int) -> np.ndarray:
    return truth + sigma * np.random.default_rng(seed).standard_normal(truth.shape)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    return 0.2 + np.random.default_rng(0).random(SHAPE)


@pytest.fixture(scope="module")
def reference(truth) -> Reference:
    return Reference((noisy(truth, 0.1, 1), noisy(truth, 0.1, 2)))


# ---- errors ----


def test_errors_are_those_of_a_plain_calculation(truth):
    picture = noisy(truth, 0.05, 3)
    found = Reference((truth, truth)).errors(picture)
    assert found["RMSE"] == pytest.approx(metrics.rmse(picture, truth))
    assert found["relMSE"] == pytest.approx(metrics.rel_mse(picture, truth))
    assert found["FLIP"] == pytest.approx(metrics.flip(picture, truth))
    assert found["bad pixels"] == 0


def test_the_references_own_noise_is_taken_out(truth, reference):
    picture = noisy(truth, 0.05, 3)
    assert metrics.rmse(picture, reference.picture) > 1.3 * metrics.rmse(picture, truth)
    assert reference.errors(picture, flip=False)["RMSE"] == pytest.approx(metrics.rmse(picture, truth), rel=0.1)
    assert reference.noise == pytest.approx(metrics.rmse(reference.picture, truth), rel=0.1)
    assert reference.errors(truth, flip=False)["RMSE"] < 0.02


def test_pixels_that_are_not_finite_are_counted_and_left_out(truth):
    picture = truth + 0.1
    picture[0, 0, 1], picture[3, 4], picture[5, 6, 0] = np.nan, np.inf, -np.inf
    found = Reference((truth, truth)).errors(picture)
    assert found["bad pixels"] == 3 and found["RMSE"] == pytest.approx(0.1)
    assert 0 < found["FLIP"] <= 1
    assert np.isnan(Reference((truth, truth)).errors(np.full(SHAPE, np.nan), flip=False)["RMSE"])


def test_a_floor_shows_only_where_frames_are_biased(truth, reference):
    first, second = noisy(truth, 0.1, 5), noisy(truth, 0.1, 6)
    assert reference.floor(first, second) is None
    assert reference.floor(first + 0.1, second + 0.1)[0] == pytest.approx(0.1, rel=0.1)


# ---- turns ----


class Metronome:
    """Stands for frames: they take the seconds that it is told, each the same or one after the other."""

    def __init__(self, name: str, seconds: float | list[float], order: list[str]) -> None:
        self.name, self.seconds, self.order = name, seconds, order

    def run(self, reference: Reference) -> Run:
        run = Run(self.name, gi.Pipeline(spp=4), None)

        def step(against: Reference, limit: float) -> None:
            self.order.append(self.name)
            seconds = self.seconds if isinstance(self.seconds, float) else self.seconds[run.count]
            run.add(np.full(SHAPE, float(run.count)), seconds, 2 * seconds, against, limit)

        run.step = step
        return run


def turns(
    costs: dict[str, float | list[float]], limit: float, reference: Reference
) -> tuple[compare.Comparison, list[str]]:
    order: list[str] = []
    runs = {name: Metronome(name, seconds, order).run(reference) for name, seconds in costs.items()}
    return compare.take_turns(runs, reference, limit), order


def test_turns_alternate_until_each_has_had_its_time(reference):
    found, order = turns({"a": 1.0, "b": 2.0}, 5.0, reference)
    assert order == ["a", "b", "a", "b", "a", "a", "a"]
    assert [run.seconds for run in found.runs] == [5.0, 4.0]
    assert found.equal_frames == 2
    for picture in found.equal_samples.values():
        np.testing.assert_array_equal(picture, 0.5)  # the mean of frames 0 and 1
    np.testing.assert_array_equal(found.runs[0].mean, 2.0)
    np.testing.assert_array_equal(found.runs[0].first, 0.0)


def test_the_first_frame_is_rendered_however_long_it_takes(reference):
    found, order = turns({"a": 9.0, "b": 1.0}, 2.0, reference)
    assert order == ["a", "b", "b"] and found.equal_frames == 1
    rows = compare_rows.rows_of(found, 2.0, {})
    said = {row["pipeline"]: row["says"] for row in rows if row["table"] == "equal time"}
    assert said == {"a": "its only frame took longer than the 2 s it had", "b": ""}


def test_a_frame_that_ends_too_late_does_not_count(reference):
    found, order = turns({"a": [1.0, 1.0, 9.0], "b": 1.0}, 4.0, reference)
    assert order == ["a", "b", "a", "b", "a", "b", "b"] and found.equal_frames == 2
    late, other = found.runs
    assert (late.count, late.seconds, other.count) == (2, 2.0, 4)
    np.testing.assert_array_equal(late.mean, 0.5)


# ---- equal error ----


def line(errors: list[float], seconds: float = 1.0) -> list[Point]:
    return [Point(i + 1, seconds * (i + 1), error) for i, error in enumerate(errors)]


def test_time_to_an_error_follows_a_power_of_time():
    points = [Point(n, n * 0.5, n**-0.5) for n in (1, 4, 16, 64)]
    assert seconds_to(points, 10**-0.5) == pytest.approx(5.0)
    assert seconds_to(points, 0.5) == pytest.approx(2.0)
    assert seconds_to(points, 2.0) == 0.5
    assert seconds_to(points, 0.1) is None
    assert seconds_to(line([1.0, 0.2, 0.6, 0.5]), 0.5) == pytest.approx(4.0)  # it has to stay there
    assert seconds_to(line([1.0, 0.0]), 0.5) == 2.0


def test_equal_error_rows(reference):
    found, _ = turns({"fast": 1.0, "slow": 1.0}, 1.0, reference)
    fast, slow = found.runs
    fast.points, slow.points = line([1.0, 0.5, 0.25]), line([1.0, 0.5, 0.5], 2.0)
    setups = {"fast": {"build s": 1.0, "bake s": 3.0}, "slow": {"failed": "no"}}
    rows = compare_rows.equal_error_rows([fast, slow], setups)
    assert [(row["pipeline"], row["RMSE"], row["reached"], row["render s"]) for row in rows] == [
        ("fast", 0.5, True, 2.0),
        ("slow", 0.5, True, 4.0),
        ("fast", 0.25, True, 3.0),
        ("slow", 0.25, False, None),
    ]
    assert [row["with build and bake s"] for row in rows] == [6.0, None, 7.0, None]
    assert [row["speed-up over fast"] for row in rows] == [1.0, 0.5, 1.0, None]


# ---- frames ----


def test_still_frames_are_independent_and_of_one_moment():
    scene = moving_box()
    camera = gi.Camera.look_at((0, 1, 3.4), (0, 1, 0), resolution=(24, 16))
    frames = StillFrames(scene, camera, gi.Pipeline(spp=2), "cpu", seed=1, moment=6)
    first, second = frames.next(), frames.next()
    assert first.time == second.time == 6 / 24 and first.seed != second.seed
    np.testing.assert_allclose(second.numpy("motion"), 0, atol=1e-4)


def moving_box() -> gi.Scene:
    scene = gi.builtin_scene("cornell_box")
    keys = [gi.Keyframe(0.0, (0.0, 0.0, 0.0)), gi.Keyframe(1.0, (0.2, 0.0, 0.0))]
    nodes = [gi.Node(node.name, node.meshes, keyframes=keys) for node in scene.nodes]
    return gi.Scene(nodes, scene.lights, scene.environment, scene.cameras, scene.name)


def test_a_computed_reference_has_two_independent_halves():
    scene = gi.builtin_scene("cornell_box")
    camera = scene.cameras["main"].at_resolution(24, 16)
    told: list[float] = []
    found = computed(scene, camera, "cpu", 1, 256, told=told.append)
    a, b = found.halves
    assert found.about["spp"] == 256 and told[-1] == 1.0 and 0 < found.noise < 0.2 * a.mean()
    assert "noise is taken out" in found.about["says"]  # to which the row of a noisy one adds
    assert abs(np.corrcoef((a - found.picture).ravel(), (b - found.picture).ravel())[0, 1] + 1) < 1e-9
    assert a.mean() == pytest.approx(b.mean(), rel=0.05)


def test_what_setup_baked_is_not_baked_again(monkeypatch, reference):
    scene = gi.builtin_scene("cornell_box")
    scene.environment = (1.0, 1.0, 1.0)
    camera = scene.cameras["main"].at_resolution(SHAPE[1], SHAPE[0])
    pipelines = {"dvf": gi.Pipeline(environment=gi.VisibilityField(cell_size=1.0), spp=1), "path": gi.Pipeline(spp=1)}
    bakes = {name: baked(scene, camera, pipeline, "cpu", 1) for name, pipeline in pipelines.items()}
    assert [len(bakes[name]) for name in ("dvf", "path")] == [1, 0]

    def bake(*given: object) -> None:
        raise AssertionError("baked again")

    monkeypatch.setattr(gi.VisibilityField, "bake", bake)
    runs = compare.runs_of(scene, camera, pipelines, "cpu", bakes=bakes)
    found = compare.take_turns(runs, reference, 1e-9)
    assert [(run.name, run.count) for run in found.runs] == [("dvf", 1), ("path", 1)]
    assert all(run.mean.mean() > 0.01 and run.wall[0] > 0 for run in found.runs)


# ---- the command ----

SMALL = ["--scene", "cornell_box", "--size", "24x16"]


def test_the_command_writes_tables_plots_and_pictures(tmp_path, capsys):
    page, lines = tmp_path / "c.html", tmp_path / "c.jsonl"
    arguments = [*SMALL, "--pipelines", "path,direct", "--time", "0.4s", "--reference-spp", "256"]
    assert cli.main(["bench", "compare", *arguments, "--html", str(page), "--json", str(lines)]) == 0
    printed = capsys.readouterr().out
    rows = records.read([lines])
    assert COLUMNS.undeclared(map(records.measured, rows)) == []
    tables = {name: [row for row in rows if row["table"] == name] for name in {row["table"] for row in rows}}
    for name in ("setup", "frames", "equal samples", "equal time", "equal error"):
        assert {row["pipeline"] for row in tables[name]} == {"path", "direct"}, name
        assert name in printed
    assert "error over time" in tables and "error over time" not in printed
    assert tables["scene"][0]["pixels"] == "24x16" and tables["reference"][0]["spp"] == 256
    for row in tables["setup"]:
        assert row["peak GB"] > 0.05 and row["build s"] > 0 and row["first frame s"] > 0
    for row in tables["frames"]:
        assert row["frames"] >= 1 and row["wall s"] > 0 and "wall s spread" in row and row["cpu s"] >= 0
    path, direct = tables["equal time"]
    assert path["floor relMSE"] is None and not path["says"]
    assert direct["floor relMSE"] > path["relMSE"] and "floor" in direct["says"]  # it leaves out indirect light
    text = page.read_text(encoding="utf-8")
    assert text.count('class="pixels"') == 6 and "Error over render time" in text and "first frame" in text


def test_a_picture_as_reference_gives_the_size(tmp_path, capsys):
    scene = gi.builtin_scene("cornell_box")
    frame = next(iter(gi.render(scene, scene.cameras["main"].at_resolution(20, 12), gi.Pipeline(spp=64))))
    path = tmp_path / "r.exr"
    gi.write_frame(frame, path, "float")
    np.testing.assert_array_equal(from_file(path).picture, frame.numpy("beauty"))
    arguments = ["--scene", "cornell_box", "--pipelines", "path", "--time", "0.1", "--reference", str(path)]
    assert cli.main(["bench", "compare", *arguments, "--json", "-"]) == 0
    rows = [json.loads(text) for text in capsys.readouterr().out.splitlines()]
    assert rows[0]["pixels"] == "20x12" and "noise" in rows[1]["says"]
    assert cli.main(["bench", "compare", *SMALL, "--reference", str(path)]) == 2
    assert "is 20x12 and --size 24x16" in capsys.readouterr().err


BAD = [
    (["--pipelines", "path,dvff"], "unknown pipeline 'dvff'; did you mean 'dvf'?"),
    (["--pipelines", "path,path"], "names one twice"),
    (["--pipelines", ""], "the argument after --pipelines is empty"),
    (["--time", "soon"], "--time 'soon' not understood"),
    (["--time", "0s"], "--time '0s' not understood"),
    (["--spp", "0"], "--spp must be a whole number from 1"),
    (["--reference-spp", "1"], "--reference-spp must be"),
    (["--size", "big"], "resolution 'big' not understood"),
    (["--scene", "atriun"], "did you mean 'atrium'?"),
    (["--scene", "a.safetensors"], "give the scene"),
    (["--environment", "none.exr"], "none.exr"),
    (["--reference", "none.exr"], "none.exr: no such file"),
    (["--reference", "gray.exr"], "three channels"),
    (["--reference", "nan.exr"], "1 pixels that are NaN"),
    (["--html", "."], "is a folder"),
    (["--html", "file/c.html"], "file"),
    (["--frames", "3"], "--frame"),
    (["--device", "tpu"], "device 'tpu'"),
]


@pytest.mark.parametrize("arguments, words", BAD, ids=[" ".join(a) for a, _ in BAD])
def test_mistakes_are_one_line(arguments, words, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("")
    bad = np.ones((4, 4, 3), np.float32)
    bad[1, 1, 1] = np.nan
    write_exr(tmp_path / "nan.exr", {"beauty": bad}, {}, precision="float")
    write_exr(tmp_path / "gray.exr", {"depth": np.ones((4, 4), np.float32)}, {}, precision="float")
    before = sorted(path.name for path in tmp_path.iterdir())
    assert cli.main(["bench", "compare", *arguments]) == 2
    error = capfd.readouterr().err
    assert error.startswith("warp-gi: error: ") and error.count("\n") == 1 and words in error
    assert sorted(path.name for path in tmp_path.iterdir()) == before


def test_a_pipeline_that_cannot_be_set_up_is_a_row(monkeypatch, capsys, tmp_path):
    from warp_gi.bench.compare import setup as compare_setup

    real = compare_setup.setup_of
    fails = lambda name, *more: ({"failed": "no memory"}, []) if name == "dvf" else real(name, *more)  # noqa: E731
    monkeypatch.setattr(compare_setup, "setup_of", fails)
    arguments = [*SMALL, "--pipelines", "dvf,direct", "--time", "0.1s", "--reference-spp", "2", "--json", "-"]
    assert cli.main(["bench", "compare", *arguments]) == 1
    printed = capsys.readouterr()
    assert printed.err == "failed: dvf\n"
    rows = [json.loads(text) for text in printed.out.splitlines()]
    assert [row["pipeline"] for row in rows if "failed" in row] == ["dvf"]
    assert {row["pipeline"] for row in rows if row["table"] == "equal time"} == {"direct"}
    arguments[arguments.index("dvf,direct")] = "dvf"
    assert cli.main(["bench", "compare", *arguments]) == 2
    assert "no pipeline can be set up: no memory" in capsys.readouterr().err


def test_a_reference_noisier_than_the_pictures_says_so(truth):
    for sigma, is_noisy in ((1.0, True), (1e-3, False)):
        halves = noisy(truth, sigma, 1), noisy(truth, sigma, 2)
        reference = Reference(halves, {"says": "about"})
        runs = {"a": Metronome("a", 1.0, []).run(reference)}
        found = compare.take_turns(runs, reference, 1.0)
        runs["a"].points[-1] = Point(1, 1.0, 0.1)
        row = compare_rows.rows_of(found, 1.0, {})[0]
        assert row["table"] == "reference" and ("more --reference-spp" in row["says"]) == is_noisy
        # nor does anything count as a floor then
        run = Metronome("b", 1.0, []).run(reference)
        for _ in range(2):
            run.add(noisy(truth, 0.0, 3) + 0.2, 1.0, 1.0, reference, 9.0)
        assert (run.floor(reference) is None) == is_noisy
