"""The light field probes' benchmark: its rows, on scenes small enough for every test run."""

from __future__ import annotations

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.bench import presets, probes, probes_denoise, probes_light, probes_rays, probes_views, stages
from warp_gi.bench.gallery import Gallery

SMALL = {"resolution": 32, "rays": 1}


@pytest.fixture(scope="module")
def view() -> probes_views.View:
    return probes_views.view_of(probes_views.CORNELL, (24, 16), "cpu", 64)


def test_the_truth_is_without_noise_on_average(view):
    """The product of errors against two halves says how far a picture is from what neither of them shows."""
    picture = view.paths(2048, seed=50).picture
    against_itself = view.mean_squared(view.reference)
    noise = gi.metrics.rmse(picture, view.reference) ** 2
    assert view.mean_squared(picture) < 0.5 * noise
    assert against_itself <= 1e-12
    shifted = view.mean_squared(picture + 0.1)
    assert abs(shifted / 0.01 - 1) < 0.2


def test_rays_agree_more_as_maps_grow(view, monkeypatch):
    rays = probes_rays.surface_rays(view, 2000)
    assert rays[0].shape == rays[1].shape and len(rays[0]) > 1000
    np.testing.assert_allclose(np.linalg.norm(rays[1], axis=1), 1, atol=1e-5)
    rows = [probes_rays.ray_row(probes_views.CORNELL, view, rays, (2, 2, 2), size, 1) for size in (16, 128)]
    assert rows[0]["agree"] < rows[1]["agree"] and rows[1]["agree"] > 0.97
    assert all(row["tree Mrays/s"] > 0 and row["Mrays/s"] > 0 and row["probes a ray"] >= 1 for row in rows)


def test_agreement_counts_hits_misses_and_the_unknown():
    hits = {
        "results": np.array([1, 1, 0, 0, 2, 2]),
        "t": np.array([1.04, 1.06, 0.0, 0.0, 10.1, 12.0]),
        "counts": np.tile([4, 2, 1], (6, 1)),
    }
    is_hit, t = np.array([True, True, False, True, True, False]), np.array([1.0, 1.0, np.inf, 3.0, 10.0, np.inf])
    row = probes_rays.agreement(hits, is_hit, t)
    assert row["agree"] == 3 / 6 and row["of known"] == 2 / 4 and row["unknown"] == 2 / 6
    assert (row["texels a ray"], row["blocks a ray"], row["probes a ray"]) == (4, 2, 1)


def test_modes_stand_beside_the_path_tracer(view, monkeypatch):
    monkeypatch.setattr(probes_light, "PATH_SPP", 4)
    gallery = Gallery()
    rows = probes_light.mode_rows(probes_views.CORNELL, view, [SMALL | {"counts": (2, 2, 2)}], 1, gallery)
    assert [row["mode"] for row in rows] == ["irradiance", "hybrid", "traced"]
    assert len({tuple(row) for row in rows}) == 1  # one table
    for row in rows:
        assert 0.5 < row["mean / paths"] < 1.5 and row["paths spp for this RMSE"] >= 1 and row["faster, cpu"] > 0
    assert rows[0]["RMSE"] == rows[1]["RMSE"]  # diffuse: "hybrid" has no glossy rays to trace
    assert rows[2]["ns a pixel"] > rows[0]["ns a pixel"]
    (pictures,) = gallery.sets
    means = {mode: image.mean() / pictures.reference.mean() for mode, image in pictures.images.items()}
    assert means == pytest.approx({row["mode"]: row["mean / paths"] for row in rows}, rel=5e-3)


def test_a_path_stage_traces_paths(view):
    """Its time would be nothing if it only asked for them."""
    few, many = view.paths(1), view.paths(64)
    taken = stages.race({"few": few, "many": many}, 2, "cpu")
    assert taken["many"].cost > 5 * taken["few"].cost


def test_leaks_cover_lit_and_dark_and_the_cylinders_cover_probes():
    scene = gi.builtin_scene("two_rooms")
    views = {n: probes_views.View(scene, scene.cameras[n].at_resolution(24, 16), "cpu", 16) for n in ("lit", "dark")}
    common = SMALL | {"counts": (8, 3, 4), "relocate": False}
    rows = [probes_light._leak_row(views, common | {"weights": weights}) for weights in ("visibility", "trilinear")]
    assert rows[0]["dark / lit"] < 0.1 * rows[1]["dark / lit"]
    box = probes_views.view_of(stages.Case("cylinders"), (32, 32), "cpu", 64)
    stage = box.stage(1, mode="irradiance", relocate=False, counts=(3, 2, 3), **SMALL)
    assert probes_light.covered(stage) == 6
    row = probes_light.darkened(box, stage)
    assert 0 <= row["below half"] < 0.3 and 0 <= row["above twice"] < 0.3


def test_bakes_tell_time_memory_and_passes(view):
    row = probes_light.bake_row(probes_views.CORNELL, view, 32)
    assert row["million rays"] == 64 * 32**2 * 4 / 1e6 and row["MB"] > 64 * 32**2 * 8 / 1e6
    assert 1 < row["passes"] <= 16 and row["last change"] <= 0.005 and row["update ms a probe, cpu"] > 0


def test_denoisers_are_compared_with_their_own_pipeline(monkeypatch):
    monkeypatch.setattr(probes_denoise, "FRAME", 2)
    monkeypatch.setattr(probes_denoise, "RAYS", (1,))
    scene = presets.peer_scene(gi.builtin_scene("cornell_box"), diffuse=True)
    path = gi.builtin_camera_path("cornell_box").at_resolution(32, 24)
    gallery = Gallery()
    *skipped, row = probes_denoise.pipeline_rows("box", scene, path, "paths", {}, 32, "cpu", gallery)
    assert row["ST RMSE"] < 0.7 * row["noisy RMSE"] and row["ST ms"] > 0
    if "OIDN RMSE" not in row:
        assert len(skipped) == 1 and "pyoidn" in skipped[0]["skipped"]
    (pictures,) = gallery.sets
    for name, image in pictures.images.items():
        error = row[f"{probes_denoise.DENOISERS.get(name, name)} RMSE"]
        assert gi.metrics.rmse(image, pictures.reference) == pytest.approx(error, rel=0.05)


def test_missing_scenes_give_rows_that_say_so(monkeypatch, tmp_path):
    monkeypatch.setattr(presets, "SCENES", tmp_path)
    for place in (probes_views.LIVING_ROOM, probes_views.SPONZA):
        assert "WARP_GI_SCENES" in place.missing
    assert set(probes.PARTS) == {"rays", "leaks", "light", "bakes", "denoise"}
