"""The benchmark of sample reuse: its rows and figures, on scenes small enough for every test run."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import warp_gi as gi
from warp_gi.bench.harness import scenes
from warp_gi.bench.harness.gallery import Gallery
from warp_gi.bench.suites.reuse import cost as reuse_cost
from warp_gi.bench.suites.reuse import quality as reuse_quality
from warp_gi.bench.suites.reuse import time as reuse_time
from warp_gi.bench.suites.reuse import views as reuse_views
from warp_gi.bench.suites.reuse.columns import COLUMNS
from warp_gi.scene.animation import keyframe_matrix

SIZE = (24, 16)


@pytest.fixture(scope="module")
def box() -> tuple[gi.Scene, gi.Camera]:
    return gi.builtin_scene("cornell_box"), reuse_views.CORNELL.camera().at_resolution(*SIZE)


def pipeline(spp: int = 1) -> gi.Pipeline:
    return gi.Pipeline(spp=spp, camera_samples=1)


# ---- errors ----


def test_the_truth_is_without_noise_on_average(box):
    truth = reuse_views.Truth(*box, "cpu", 64)
    frame = gi.FrameScheduler(*box, pipeline(2048), seed=3).frame(0)
    noise = np.mean((frame.numpy("beauty") - truth.halves[0]["beauty"]) ** 2)
    assert abs(truth.errors(frame)["beauty"]) < 0.3 * noise
    assert set(truth.errors(frame)) == {"emitters", "indirect", "beauty"}


def test_the_truth_of_a_frame_is_that_frames():
    scene, camera = scenes.guiding_ring(90.0, 5), reuse_views.RING.camera().at_resolution(*SIZE)
    truths = [reuse_views.Truth(scene, camera, "cpu", 64, index) for index in (4, 5)]
    before, after = (truth.halves[0]["indirect"] for truth in truths)
    assert np.abs(before - after).mean() > 0.5 * before.mean()


def test_sequences_measure_every_frame_and_take_turns(box):
    choices = {"one": pipeline(1), "sixteen": pipeline(16)}
    asked = []
    truth = reuse_views.Truth(*box, "cpu", 64)

    def which(index: int) -> reuse_views.Truth:
        asked.append(index)
        return truth

    runs = reuse_views.run_sequences(*box, choices, 4, which, "cpu")
    assert asked == [0, 0, 1, 1, 2, 2, 3, 3]
    one, sixteen = runs["one"], runs["sixteen"]
    assert len(one.errors["beauty"]) == len(one.times) == 4
    assert one.error("indirect", 1) > 5 * sixteen.error("indirect", 1)
    assert sixteen.milliseconds("paths", 1) > one.milliseconds("paths", 1) > 0
    stages = sixteen.stage_milliseconds(1)
    assert sixteen.milliseconds("", 1) == pytest.approx(sum(stages.values()))
    assert not {"bake", "compile", "scene"} & set(stages) and {"paths", "primary", "compose"} <= set(stages)
    assert sixteen.cost(1, "cpu") > one.cost(1, "cpu") > 0


def test_settling_is_the_last_time_out_of_bounds():
    settled_at, one = reuse_views.settled_at, [1.0, 1.0]
    assert settled_at([9, 5, 2, 1.1, 1, 1, 1, 1], one, window=1) == 3
    assert settled_at([1, 1, 1, 1.3, 1, 1], one, window=1) == 4  # it was settled, and was not
    assert settled_at([1, 1, 1, 1.3, 1, 1], one, window=3) == 0  # noise of one frame
    assert settled_at([50, 1, 1, 1, 1], one) == 1 and settled_at([3, 3, 3, 1, 1, 1], one) == 3
    assert settled_at([1, 1, 1, 1], one) == 0 and settled_at([1, 1, 3, 3, 3], one) == 5  # never
    assert settled_at([1.5, 1.5, 1.5, 1, 1, 1], one, window=1) == 3
    assert settled_at([1.5, 1.5, 1.5, 1, 1, 1], [0.5, 1.5], window=1) == 0  # no more than what is noise


def test_ratios_of_nothing_are_one():
    assert reuse_views.ratio(0.0, 0.0) == 1.0 and reuse_views.ratio(3.0, 2.0) == 1.5
    assert reuse_views.ratio(1.0, 0.0) > 1e20


# ---- scenes ----


def test_the_ring_is_lit_by_a_spot_on_its_wall():
    scene = scenes.guiding_ring(36.0, 2)
    look = gi.Camera.look_at((0, 6, 0.01), (0, 0, 0), hfov=70.0, resolution=(64, 64))
    scheduler = gi.FrameScheduler(scene, look, pipeline(64))
    angles = []
    for index in (1, 2):
        frame = scheduler.frame(index)
        direct, position = frame.numpy("emitters").mean(axis=-1), frame.numpy("position")
        radius = np.hypot(position[..., 0], position[..., 2])
        on_floor = (radius < scenes.RING_RADIUS) & (np.abs(position[..., 1]) < 0.01)
        assert direct[on_floor].max() == 0 and frame.numpy("indirect")[on_floor].mean() > 0.01
        y, x = np.nonzero(direct > 0)
        assert (radius[y, x] > scenes.RING_RADIUS).all()
        middle = np.average(position[y, x], axis=0, weights=direct[y, x])
        assert 0.3 < middle[1] < 2.0
        angles.append(np.degrees(np.arctan2(-middle[2], middle[0])))
    assert angles[0] == pytest.approx(0.0, abs=2.0) and angles[1] == pytest.approx(36.0, abs=2.0)


def test_strobes_are_where_they_say():
    for kind, period in scenes.STROBE_PERIODS.items():
        scene = scenes.strobe(kind)
        lamp = next(node for node in scene.nodes if node.name == "lamp")
        found: dict[int, set[tuple[float, ...]]] = {}
        for index in range(2 * period):
            matrix = keyframe_matrix(lamp.keyframes, index / scenes.FPS)
            found.setdefault(scenes.strobe_place(kind, index), set()).add(tuple(np.round(matrix[:3, 3], 6)))
        assert all(len(places) == 1 for places in found.values())
        assert len(set.union(*found.values())) == len(found) == {"jump": 2, "slit": period // 2 + 1}[kind]
    steps = np.diff([scenes.strobe_place("slit", index) for index in range(40)])
    assert (np.abs(steps) == 1).all()  # never at rest


def test_a_lamp_in_its_box_lights_nothing():
    scene, camera = scenes.strobe("jump"), reuse_views.STROBE.camera().at_resolution(*SIZE)
    scheduler = gi.FrameScheduler(scene, camera, pipeline(16))
    half = scenes.STROBE_PERIODS["jump"] // 2
    means = [scheduler.frame(index).numpy("beauty").mean() for index in (half - 1, half, 2 * half)]
    assert means[0] > 3 * means[1] and means[2] == pytest.approx(means[0], rel=0.3)


@pytest.mark.skipif(bool(reuse_views.DRAGON.missing), reason="no dragon")
@pytest.mark.slow
def test_the_dragon_stands_under_its_cover():
    scene = scenes.covered_dragon()
    assert scene.emitter_count == 20
    frame = gi.FrameScheduler(scene, reuse_views.DRAGON.camera().at_resolution(64, 48), pipeline()).frame(0)
    names = [node.name for node in scene.nodes]
    seen = frame.numpy("object_id")
    assert (seen == 0).mean() > 0.1 and names[-1] == "lamps"


# ---- rows ----


def test_combinations_stand_beside_the_baseline(box):
    place = reuse_views.CORNELL
    gallery = Gallery()
    rows = reuse_quality.place_rows(place, SIZE, 32, 4, 2, "cpu", gallery)
    errors, times = rows[:6], rows[6:]
    assert COLUMNS.undeclared(rows) == []
    assert len(times) == 6 and len({tuple(row) for row in errors}) == len({tuple(row) for row in times}) == 1
    base = errors[0]
    assert base["combination"] == reuse_quality.BASELINE
    assert base["beauty / baseline"] == base["beauty, equal time"] == times[0]["time / baseline"] == 1
    for row, time in zip(errors, times, strict=True):
        assert row["combination"] == time["combination"]
        assert row["MSE beauty"] > 0 and time["paths ms"] > 0 and 1e3 * time["frame wall s"] > 0.9 * time["paths ms"]
        assert (time["learn ms"] > 0) == ("Cache" in row["combination"] or "Guided" in row["combination"])
        assert row["indirect, equal time"] == pytest.approx(row["indirect / baseline"] * time["time / baseline"])
        assert row["emitters / baseline"] == pytest.approx(row["MSE emitters"] / base["MSE emitters"])
    (pictures,) = gallery.sets
    assert list(pictures.images) == [row["combination"] for row in errors]
    camera, pipeline = place.camera().at_resolution(*SIZE), reuse_quality.pipelines()[reuse_quality.BASELINE]
    last = gi.FrameScheduler(place.scene(), camera, pipeline, "cpu", seed=reuse_views.SEED).frame(3).numpy("beauty")
    np.testing.assert_allclose(pictures.images[reuse_quality.BASELINE], last, rtol=0.02)
    assert pictures.reference.mean() == pytest.approx(last.mean(), rel=0.2)


def test_targets_name_the_worst():
    rows = []
    for k, light in enumerate(reuse_quality.EMITTERS):
        for j, paths in enumerate(reuse_quality.INDIRECT):
            row = {"case": "warehouse", "combination": f"{light} + {paths}", "MSE beauty": 1.0}
            for term in reuse_views.MEASURED:
                row |= {f"{term} / baseline": 1.0 + k + 0.1 * j, f"{term}, equal time": 2.0}
            rows.append(row)
    targets = reuse_quality.target_rows([*rows, {"case": "dragon", "skipped": "no file"}])
    assert COLUMNS.undeclared(targets) == []
    assert targets[0]["target"] == 1 / 8 and targets[0]["equal samples"] == 3.0
    worst = targets[1]
    assert worst["combination"] == "worst: VisibilityLightCache + GuidedPaths" and worst["equal samples"] == 3.1
    assert [row["term"] for row in targets] == ["emitters", *reuse_views.MEASURED]


def test_paths_take_a_places_settings():
    assert reuse_views.MINE_ONE_BOUNCE.settings == {"max_depth": 3}
    for choice in reuse_quality.pipelines(max_depth=3).values():
        assert choice.indirect.max_depth == 3
    assert "one bounce" in reuse_views.MINE_ONE_BOUNCE.name and reuse_views.MINE.name != reuse_views.WAREHOUSE.name


def test_adaptation_starts_from_nothing():
    rows = reuse_time.place_adaptation(reuse_views.CORNELL, SIZE, 32, 1, 5, "cpu")
    assert [row["term"] for row in rows] == ["emitters", "indirect"] and COLUMNS.undeclared(rows) == []
    for row in rows:
        assert len(row["MSE / settled by frame"].split()) == 6 and row["settled MSE"] > 0 and row["target"] == 8


def test_turns_cover_bits_and_migrations():
    rows = reuse_time.turn_rows(36.0, (32, 128), (12, 12), 64, 1, (4, 6), "cpu")
    assert [(row["bits"], row["migrations"]) for row in rows] == [(32, 1), (32, 8), (128, 1), (128, 8)]
    assert [row["target"] for row in rows] == ["", "", 20, 8] and COLUMNS.undeclared(rows) == []
    for row in rows:
        assert len(row["MSE / settled by frame"].split()) == 6 and row["peak / settled"] >= 1
        assert row["frames until settled"] <= 6


def test_strobes_are_rows_by_what_the_lamp_does():
    base = np.ones(32)
    ours = np.where(np.arange(32) % 16 < 4, 4.0, 0.5)
    out, into = reuse_time.strobe_kind_rows("jump", "ours", {"ours": ours, "baseline": base})
    assert COLUMNS.undeclared([out, into]) == []
    assert (out["case"], into["case"]) == ("lamp out of the box", "lamp into the box")
    for row in (out, into):
        assert row["settled MSE"] == 0.5 and row["peak / settled"] == 8 and row["frames until settled"] == 4
        assert row["first frame / baseline"] == 4 and row["frames above baseline"] == 4
        assert row["mean / baseline"] == pytest.approx((4 * 4 + 12 * 0.5) / 16)
    (slit,) = reuse_time.strobe_kind_rows("slit", "ours", {"ours": ours, "baseline": base})
    assert slit["mean / baseline"] == pytest.approx(22 / 16) and slit["frames until settled"] == ""


def test_strobe_series_leave_out_the_first_period(monkeypatch):
    monkeypatch.setitem(scenes.STROBE_PERIODS, "jump", 4)
    series = reuse_time.strobe_series("jump", {"paths": pipeline()}, SIZE, 64, 2, "cpu")["paths"]
    assert series.shape == (4,) and series[:2].mean() > 1.4 * series[2:].mean()
    run = reuse_views.FrameRun(None)
    run.errors["beauty"] = [100.0] * 4 + [1.0, 2.0, 3.0, 4.0] + [3.0, 4.0, 5.0, 6.0]
    assert reuse_time._by_phase(run, 4).tolist() == [2.0, 3.0, 4.0, 5.0]


def test_costs_list_passes_and_memory(box):
    rows = reuse_cost.place_cost(reuse_views.CORNELL, SIZE, 3, 1, "cpu")
    assert COLUMNS.undeclared(rows) == []
    passes = {row["pass"]: row for row in rows if row["table"] == "passes"}
    assert {"learn octree", "learn emitters", "learn indirect", "preprocess emitters", "all"} <= set(passes)
    others = sum(row["ms"] for name, row in passes.items() if name != "all")
    assert passes["all"]["ms"] == pytest.approx(others) and 0 < passes["all"]["share of the frame"] < 1
    tracing = [row for row in rows if row["table"] == "path tracing"]
    assert tracing[0]["combination"] == reuse_cost.BASELINE and tracing[0]["paths / baseline"] == 1
    memory = {row["part"]: row for row in rows if row["table"] == "memory"}
    parts = sum(row["KB"] for name, row in memory.items() if name != "all")
    assert memory["all"]["KB"] == pytest.approx(parts)
    assert memory["quadtrees"]["bytes a leaf"] > 128 / 8 and memory["samples"]["KB"] * 1e3 >= 20 * SIZE[0] * SIZE[1]


def test_bytes_are_those_of_arrays_inside_of_structs():
    records = gi.SampleOctree().start(gi.builtin_scene("cornell_box"), wp.get_device("cpu"))
    expected = sum(array.size * 4 for array in (records.octree.nodes, records.prefixes, records.levels, records.counts))
    assert reuse_cost.nbytes(records) == expected
    assert reuse_cost.nbytes(wp.zeros(3, dtype=wp.vec3, device="cpu")) == 36 and reuse_cost.nbytes(2.0) == 0


def test_missing_scenes_give_rows_that_say_so(monkeypatch, tmp_path):
    monkeypatch.setattr(scenes, "SCENES", tmp_path)
    places = (reuse_views.DRAGON, reuse_views.BISTRO, reuse_views.HALL)
    assert all("WARP_GI_SCENES" in place.missing for place in places)
    monkeypatch.setattr(reuse_quality, "CASES", places)
    rows = reuse_quality.quality_rows(False, "cpu")
    assert [row["case"] for row in rows if "skipped" in row] == [place.name for place in places]
    assert any("paper" in row["table"] for row in rows)
