"""The visibility fields' benchmark: its rows, on scenes small enough for every test run."""

from __future__ import annotations

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.bench.harness import scenes, stages
from warp_gi.bench.harness.gallery import Gallery
from warp_gi.bench.suites.dvf import peers as dvf_peers
from warp_gi.bench.suites.dvf import suite as dvf
from warp_gi.bench.suites.dvf import views as dvf_views
from warp_gi.bench.suites.dvf.columns import COLUMNS
from warp_gi.techniques.visibility_field import audit as visibility_audit

SIZE = (24, 16)


@pytest.fixture(scope="module")
def view() -> dvf_views.FieldView:
    scene = scenes.peer_scene(gi.builtin_scene("cornell_box"), diffuse=True, emission=False)
    scene.environment = (1.0, 1.0, 1.0)
    camera = gi.Camera.look_at((0, 1, 3.4), (0, 1, 0), hfov=55.0, resolution=SIZE)
    return dvf_views.FieldView(
        scene, camera, settings={"cell_size": 0.5, "samples": 3000, "rays": 64, "resolution": 18}
    )


def test_mode_rows_hold_ratios_and_errors(view, monkeypatch):
    monkeypatch.setitem(dvf.PAPER, "samples", 3000)
    gallery = Gallery()
    rows = dvf.mode_rows("box", view, 1, 4.0, gallery=gallery)
    assert [row["mode"] for row in rows] == [*dvf.MODES, "paper, its settings"]
    assert len({tuple(row) for row in rows}) == 1  # one table
    assert COLUMNS.undeclared(rows) == []
    for row in rows:
        assert row["ratio wall"] > 0.0 and row["ratio cpu"] > 0.0 and row["target"] == 4.0
        assert 0.0 <= row["RMSE"] < 0.2 and 0.0 < row["traced share"] < 1.0 and row["wrong per million"] >= 0.0
    (pictures,) = gallery.sets
    assert list(pictures.images) == [row["mode"] for row in rows]
    np.testing.assert_allclose(pictures.reference, view.stage(dvf.SPP, mode="traced").picture, rtol=0.02)
    for row, image in zip(rows, pictures.images.values(), strict=True):
        assert stages.rmse(image, pictures.reference) == pytest.approx(row["RMSE"], abs=0.01)


def test_the_audit_counts_exactly_what_the_pictures_differ_by(view):
    coarse = {"rays": 8, "samples": 1, "resolution": 24, "dilation": 0}
    traced, field = view.stage(16, mode="traced"), view.stage(16, **coarse)
    counts = visibility_audit.audit(field.frame, field.state)
    expected = (counts["leaked"] - counts["lost"]) / 16
    assert np.abs(expected).max() > 0.0
    np.testing.assert_allclose(dvf_views.white_error(field, traced), expected, atol=1e-5)
    asked = visibility_audit.rays_asked(counts)
    assert np.array_equal(visibility_audit.rays_traced(counts, traced.estimator), asked) and asked.sum() > 0


def test_settings_sample_counts_and_coats_each_make_a_table(view, monkeypatch):
    monkeypatch.setitem(dvf.PAPER, "samples", 3000)
    swept = dvf.sweep_rows(view, 1, quick=True, spp=8)
    assert {row["table"] for row in swept} >= {"Sponza by samples", "Sponza by cell size", "Sponza by resolution"}
    ours = [row for row in swept if "paper" not in row["table"]]
    assert all(row["MB"] <= row["MB of all cells"] and row["bake samples"] > 0 for row in ours)
    rows = dvf.sample_count_rows("Sponza", view, 1, quick=True) + dvf.glossy_rows("Sponza", view, 1)
    assert COLUMNS.undeclared(swept + rows) == []
    papers = {row["table"] for row in rows if "RTX 3080" in row["table"]}
    assert len(papers) == 2 and not any("RMSE" in row for row in rows if row["table"] in papers)


def test_equal_error_bake_rate_and_relighting(view, monkeypatch):
    monkeypatch.setattr(dvf_peers, "SPP", 8)
    place = stages.Case("cornell_box", "box", settings={"cell_size": 0.5})
    sky = dvf_peers.smooth_sky()
    np.testing.assert_allclose(sky.mean_radiance, 1.0, atol=1e-3)
    assert sky.pixels.min() > 0.1
    scene = gi.Scene(view.scene.nodes, [], sky)
    rows = dvf_peers.equal_error(place, scene, "low-frequency", view.camera, "cpu", 2, with_mitsuba=False)
    assert [row["renderer"] for row in rows] == list(dvf_peers.OURS)
    assert all(0.0 < row["RMSE"] < 1.0 and abs(row["mean / traced"] - 1.0) < 0.1 for row in rows)
    rate = dvf_peers.bake_rate("box", scene, view.camera, "cpu", 2000, view.estimator())
    assert rate["rays asked"] >= rate["rays traced"] > 0 and rate["bake / raw, cpu"] > 0.0
    relit = dvf_peers.relight("box", scene, view.camera, frames=3, cell_size=0.5)
    assert COLUMNS.undeclared([*rows, rate, *relit]) == []
    assert [row["relight"] for row in relit] == [True, False] and all(row["later wall s"] > 0.0 for row in relit)


def test_the_flight_begins_and_ends_in_the_nave():
    nave = dvf_peers.flight((96, 54), 48)
    assert nave.frame_count == 48 and nave.camera(0).resolution == (96, 54)
    np.testing.assert_allclose(nave.camera(0).position, (-11.0, 1.5, -0.3), atol=1e-6)
    np.testing.assert_allclose(nave.camera(47).position, (9.0, 2.0, 0.3), atol=1e-6)


def test_missing_scenes_give_rows_that_say_so(monkeypatch, tmp_path):
    monkeypatch.setattr(scenes, "SCENES", tmp_path)
    missing = tuple(case for case in dvf.CASES if case.missing)
    assert [case.name for case in missing] == ["Sponza", "Bistro"]
    monkeypatch.setattr(dvf_peers, "CASES", missing)
    rows = [dvf.place_rows(place, True, "cpu") for place in missing]
    rows += [dvf_peers.equal_error_rows(False, "cpu"), dvf_peers.bake_rows(True, "cpu")]
    rows.append(dvf_peers.relight_rows(True, "cpu"))
    assert len(rows[2]) == 4
    assert all("WARP_GI_SCENES" in row["skipped"] for table in rows for row in table)
