"""The suite ``path``: what its figures are made of, and that both renderers take its scenes for the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.bench.compare.reference import Reference, computed
from warp_gi.bench.harness import catalogue, scatter, scenes
from warp_gi.bench.harness.measure import Taken
from warp_gi.bench.peers import mitsuba_peer
from warp_gi.bench.suites.path import regions, truth
from warp_gi.bench.suites.path import suite as path
from warp_gi.metrics import RELATIVE_EPSILON

BUILT_IN = ("shaded_lamp", "plates", "white_room", "lamp_wall")
TRUE = np.random.default_rng(0).uniform(0.5, 2.0, (40, 50, 3))


def noisy(count: int, sigma: float, seed: int, true: np.ndarray = TRUE) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [true * (1 + sigma * rng.standard_normal(true.shape)) for _ in range(count)]


# ---- figures ----


def test_the_spread_of_an_error_ratio_is_that_of_repeated_runs():
    found = [
        scatter.error_ratio({"a": noisy(5, 0.1, 2 * k), "b": noisy(5, 0.2, 2 * k + 1)}, "a", "b", TRUE)
        for k in range(24)
    ]
    ratios = np.array([row["error ratio"] for row in found])
    assert ratios.mean() == pytest.approx(0.25, rel=0.02)
    told = np.mean([row["error ratio spread"] for row in found])
    assert told == pytest.approx(scatter.MIDDLE_HALF * ratios.std(ddof=1), rel=0.5)
    two = scatter.error_ratio({"a": noisy(2, 0.1, 1), "b": noisy(2, 0.2, 2)}, "a", "b")
    assert "error ratio spread" not in two


def test_relative_errors_are_over_the_truth_where_there_is_one():
    pictures = {"a": noisy(3, 0.3, 1), "b": noisy(3, 0.3, 2)}
    found = scatter.errors(pictures, "a", 2 * TRUE)["relMSE"]
    variance = np.var(pictures["a"], axis=0, ddof=1)
    assert found == pytest.approx(np.mean(variance / (4 * TRUE**2 + RELATIVE_EPSILON)), rel=1e-6)
    assert scatter.errors(pictures, "a")["relMSE"] > 3 * found


def test_pictures_are_measured_against_a_reference_without_its_noise():
    halves = noisy(2, 0.2, 9)
    reference = Reference((halves[0], halves[1]))
    pictures = {"ours": noisy(4, 0.3, 1), "dim": [0.9 * picture for picture in noisy(4, 0.3, 2)]}
    ours, dim = truth.rows_of("a case", reference, 128, pictures, TRUE)
    scale = np.mean(TRUE**2 / (TRUE**2 + RELATIVE_EPSILON))
    assert ours["relMSE"] == pytest.approx(0.3**2 * scale, rel=0.05)  # 0.02 more with the reference's noise
    assert ours["noise relMSE"] == pytest.approx(0.2**2 / 2 * scale, rel=0.05)
    assert dim["relMSE"] == pytest.approx((0.27**2 + 0.1**2) * scale, rel=0.05)
    assert abs(ours["means differ"]) < 4 * ours["standard error"] < 0.02
    assert dim["means differ"] == pytest.approx(-0.1, abs=0.02)
    assert catalogue.columns_of("path").undeclared([ours, dim]) == []


def test_the_best_picture_weighs_samples():
    one = np.ones((2, 3, 3))
    reference = Reference((one, 3 * one))
    found = truth.best(reference, 100, {"a": [4 * one] * 2, "b": [6 * one] * 2}, 25)
    np.testing.assert_allclose(found, (2 * 100 + 5 * 100) / 200)


def test_the_claim_is_of_all_pictures():
    rows = [
        {"table": "beside peers", "case": case, "peer": peer, "faster at equal error, cpu": faster}
        for case, peer, faster in (("a", "x", 0.5), ("b", "x", 4.0), ("c", "x", 4.0), ("a", "y", 3.0))
    ]
    x, y = path.summary_rows([*rows, {"table": "run", "wall s": 1.0}])
    assert (x["peer"], x["pictures"], x["least"], x["most"]) == ("x", 3, 0.5, 4.0)
    assert x["geometric mean"] == pytest.approx(2.0) and y["pictures"] == 1
    assert catalogue.columns_of("path").undeclared([x, y]) == []
    assert path.summary_rows([]) == []


def test_every_picture_is_in_the_documents():
    shown = {*regions._PICTURES, *regions._SCENES}
    assert shown == {case.name for case in (*path.CASES, *path.SCENES)}
    assert len(shown) == len(path.CASES) + len(path.SCENES)


# ---- scenes ----


def test_scenes_of_others_are_passed_over_where_they_are_missing(monkeypatch, tmp_path):
    monkeypatch.setattr(scenes, "SCENES", tmp_path)
    missing = [case for case in path.SCENES if case.missing]
    assert [case.place for case in path.SCENES[:4]] == list(BUILT_IN)
    assert missing == list(path.SCENES[4:]) and len(missing) == 3
    for case in missing:
        (row,) = path.compare(case, True, "cpu")
        assert row["case"] == case.name and "WARP_GI_SCENES" in row["skipped"]


@pytest.mark.parametrize("place", BUILT_IN)
def test_the_peer_gets_the_lamps_and_the_materials(place):
    case = next(case for case in path.SCENES if case.place == place)
    own, given = gi.builtin_scene(place), case.scene()
    assert (given.triangle_count, given.emitter_count) == (own.triangle_count, own.emitter_count)
    kinds = [{(m.metallic, m.roughness, m.base_color, m.emission) for m in s.materials} for s in (own, given)]
    assert kinds[0] == kinds[1] and not given.lights
    assert not any(m.double_sided for m in given.materials if any(m.emission))
    assert case.peer["max_depth"] == case.max_depth == 64


def test_a_scene_has_rows_at_equal_samples_and_beside_its_reference(monkeypatch):
    monkeypatch.setattr(path, "QUICK_SIZE", (16, 9))
    monkeypatch.setattr(path, "PAUSE", 0.0)
    case = replace(next(case for case in path.SCENES if case.place == "plates"), variants=())
    rows = path.compare(case, True, "cpu")
    assert [row["table"] for row in rows] == ["equal samples", "equal time", "equal error", "beside the reference"]
    assert catalogue.columns_of("path").undeclared(rows) == []
    assert rows[-1]["reference spp"] == path.QUICK_REFERENCE_SPP and rows[0]["relMSE"] > 0


def test_a_reference_takes_an_estimator_of_emitters():
    scene, camera = gi.builtin_scene("plates"), gi.builtin_scene("plates").cameras["main"].at_resolution(16, 9)
    power, hierarchy = (
        computed(scene, camera, "cpu", 1, 64, emitters=emitters) for emitters in (gi.PowerLights(), None)
    )
    assert hierarchy.noise != power.noise
    assert hierarchy.picture.mean() == pytest.approx(power.picture.mean(), rel=0.1)


@pytest.mark.parametrize("place", BUILT_IN)
def test_both_renderers_see_the_same(place):
    """Means of small pictures agree within their scatter and half a percent."""
    case = next(case for case in path.SCENES if case.place == place)
    scene, camera = case.scene(), case.camera().at_resolution(32, 18)
    try:
        theirs = mitsuba_peer.renderer(scene, camera, path._path(4, 1000), 128)
    except mitsuba_peer.PeerMissing as missing:
        pytest.skip(str(missing))
    scheduler = gi.FrameScheduler(scene, gi.CameraPath.still(camera), path.pipeline(4, 128), "cpu")
    pictures = [
        np.array([render(seed) for seed in range(6)], np.float64)
        for render in (theirs, lambda seed: scheduler.frame(seed).numpy("beauty").copy())
    ]
    means = [picture.mean(axis=(1, 2, 3)) for picture in pictures]
    error = np.sqrt(sum(mean.var(ddof=1) / len(mean) for mean in means))
    assert abs(means[0].mean() - means[1].mean()) < 4 * error + 0.005 * means[1].mean()


def test_rows_of_renderers_may_be_over_a_truth():
    def taken(sigma: float, seed: int) -> Taken:
        return Taken([1.0] * 4, [1.0] * 4, [], noisy(4, sigma, seed))

    both = {"ours": taken(0.1, 1), "mitsuba x": taken(0.2, 2)}
    plain, over = (path.rows_of("a case", (50, 40), 64, both, true) for true in (None, 2 * TRUE))
    assert over[0]["relMSE"] == pytest.approx(plain[0]["relMSE"] / 4, rel=0.05)
    assert over[-1]["error ratio"] == pytest.approx(0.25, rel=0.1)
