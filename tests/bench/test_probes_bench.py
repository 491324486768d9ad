"""The light field probes' benchmark: its rows, on scenes small enough for every test run."""

from __future__ import annotations

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.bench.harness import scenes, stages
from warp_gi.bench.harness.gallery import Gallery
from warp_gi.bench.harness.places import PLACES
from warp_gi.bench.publish.figures import Grid
from warp_gi.bench.suites.probes import defaults as probes_defaults
from warp_gi.bench.suites.probes import denoise as probes_denoise
from warp_gi.bench.suites.probes import irradiance as probes_irradiance
from warp_gi.bench.suites.probes import light as probes_light
from warp_gi.bench.suites.probes import rays as probes_rays
from warp_gi.bench.suites.probes import views as probes_views
from warp_gi.bench.suites.probes.columns import COLUMNS
from warp_gi.bench.suites.probes.regions import REGIONS
from warp_gi.techniques.shared.views import camera_rows

pytestmark = pytest.mark.filterwarnings("error::UserWarning")  # of bakes for another camera, or for none

SMALL = {"resolution": 32, "rays": 1}


def assert_published(table, rows):
    """Assert that the rows have every column of their table that the README shows, and by which it finds them."""
    figures = []
    for part in (part for region in REGIONS.values() for part in region.parts):
        of_part = [column.figure for column in part.columns] if isinstance(part, Grid) else part.figures.values()
        figures += [figure for figure in of_part if (figure.table or part.table) == table]
        if isinstance(part, Grid) and part.table == table:
            assert all(set(only) <= set(row) for only in part.lines.values() for row in rows)
    assert figures and {row["table"] for row in rows} == {table}
    assert COLUMNS.undeclared(rows) == []
    for figure in figures:
        limits = {limit for limit in (figure.at_least, figure.at_most) if isinstance(limit, str)}
        assert all({figure.key, *figure.only, *limits} <= set(row) for row in rows), figure
        named = {key: value for key, value in figure.only.items() if key not in ("probes", "resolution")}
        assert any(named.items() <= row.items() for row in rows), figure


@pytest.fixture(scope="module")
def view() -> probes_views.ProbeView:
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
    assert_published("rays", rows)
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
    assert [row["mode"] for row in rows] == ["irradiance", "hybrid", "traced", "traced"]
    assert [row["through"] for row in rows] == ["none", "probes", "probes", "geometry"]
    assert len({tuple(row) for row in rows}) == 1  # one table
    for row in rows:
        assert 0.5 < row["mean / paths"] < 1.5 and row["paths spp for this RMSE"] >= 1 and row["faster, cpu"] > 0
    assert rows[0]["RMSE"] == rows[1]["RMSE"]  # diffuse: "hybrid" has no glossy rays to trace
    assert min(row["ns a pixel"] for row in rows[2:]) > rows[0]["ns a pixel"]
    assert rows[2]["RMSE"] != rows[3]["RMSE"]  # other rays
    assert_published("indirect light", rows)
    (pictures,) = gallery.sets
    means = {mode: image.mean() / pictures.reference.mean() for mode, image in pictures.images.items()}
    told = dict(zip(probes_light.WAYS, (row["mean / paths"] for row in rows), strict=True))
    assert means == pytest.approx(told, rel=5e-3)


def test_a_path_stage_traces_paths(view):
    """Its time would be nothing if it only asked for them."""
    few, many = view.paths(1), view.paths(64)
    taken = stages.race({"few": few, "many": many}, 2, "cpu")
    assert taken["many"].cost > 5 * taken["few"].cost


def test_leaks_cover_lit_and_dark_and_the_cylinders_cover_probes():
    views = probes_views.room_views((24, 16), "cpu", 16)
    ways = ({"weights": "visibility", "relocate": True}, {"weights": "trilinear", "relocate": False})
    rows = [
        probes_light._leak_row(views, SMALL | {"counts": (8, 3, 4), "irradiance_resolution": 16} | way) for way in ways
    ]
    assert rows[0]["dark / lit"] < 0.1 * rows[1]["dark / lit"]
    assert_published("leaks: two_rooms", rows)
    box = probes_views.view_of(stages.Case("cylinders"), (32, 32), "cpu", 64)
    stage = box.stage(1, mode="irradiance", relocate=False, counts=(3, 2, 3), **SMALL)
    assert probes_light.covered(stage) == 6
    row = probes_light.darkened(box, stage)
    assert 0 <= row["below half"] < 0.3 and 0 <= row["above twice"] < 0.3


# ---- default settings ----


def furnace():
    """A closed cube whose walls all emit 1 and reflect a half: they send out 2, of which 1 is reflected."""
    wall = gi.Material("wall", (0.5,) * 3, specular=0.0, emission=(1.0,) * 3)
    corners = (
        ((-1, -1, 1), (2, 0, 0), (0, 0, -2)),
        ((-1, 1, -1), (2, 0, 0), (0, 0, 2)),
        ((-1, -1, -1), (2, 0, 0), (0, 2, 0)),
        ((1, -1, 1), (-2, 0, 0), (0, 2, 0)),
        ((-1, -1, 1), (0, 0, -2), (0, 2, 0)),
        ((1, -1, -1), (0, 0, 2), (0, 2, 0)),
    )
    return gi.Scene([gi.Node("cube", [scenes.quad(*corner, wall, f"wall {i}") for i, corner in enumerate(corners)])])


def test_irradiance_is_that_of_a_furnace():
    """Reflected radiance 1 from everywhere is pi W/m^2, whatever the surface itself reflects; direct light is none."""
    camera = gi.Camera.look_at((0.1, 0.1, 0.7), (0, -0.1, -1), hfov=70, resolution=(12, 8))
    stage = probes_views.ProbeView(furnace(), camera).stage(1, mode="irradiance", counts=(2, 2, 2), **SMALL)
    paths = probes_irradiance.path_traced(stage, 256, 3)
    assert paths.shape == (8, 12, 3) and paths.mean() == pytest.approx(np.pi, rel=0.01)
    np.testing.assert_allclose(paths, np.pi, rtol=0.25)
    ours, seeing = probes_irradiance.of_probes(stage, "probes")
    assert (seeing == 8).mean() > 0.9
    np.testing.assert_allclose(ours[seeing > 0], np.pi, rtol=0.04)


def test_irradiance_is_compared_with_that_of_paths(view):
    case = probes_defaults.DefaultCase("cornell_box")
    rows = probes_defaults.irradiance_rows(case, view, **SMALL, counts=(4, 4, 4))
    assert [row["visibility"] for row in rows] == ["probes", "exact"]
    for row in rows:
        assert 0.9 < row["mean / paths"] < 1.15 and 0 < row["RMSE / mean"] < 0.5 and 0 <= row["left to rays"] < 0.2
        assert row["RMSE"] / row["RMSE / mean"] > 2 * view.reference.mean()  # W/m^2 over radiance: pi / albedo
    assert_published(probes_defaults.IRRADIANCE_TABLE, rows)


def test_points_that_are_left_to_paths_are_counted_and_not_compared(view, monkeypatch):
    """Of four columns one is the sky, one has too few probes, and the others are right."""
    seeing = np.tile(np.int32([-1, 0, 8, 1]), (2, 1))
    ours, paths = np.zeros((2, 4, 3), np.float32), np.full((2, 4, 3), 5.0, np.float32)
    ours[:, 2:] = paths[:, 2:] = 2.0
    monkeypatch.setattr(probes_defaults, "of_probes", lambda stage, visibility: (ours, seeing))
    monkeypatch.setattr(probes_defaults, "path_traced", lambda stage, spp, seed: paths)
    case = probes_defaults.DefaultCase("cornell_box")
    for row in probes_defaults.irradiance_rows(case, view, **SMALL, counts=(4, 4, 4)):
        assert (row["mean / paths"], row["RMSE"], row["left to rays"]) == (1.0, 0.0, 1 / 3)


def test_default_settings_are_measured_in_both_modes(view):
    gallery = Gallery()
    case = probes_defaults.DefaultCase("cornell_box", within=0.1)
    rows = probes_defaults.term_rows(case, view, 1, gallery, **SMALL, counts=(4, 4, 4))
    assert [row["mode"] for row in rows] == ["irradiance", "hybrid"] and all(row["spp"] == 16 for row in rows)
    for row in rows:
        assert (row["least"], row["most"]) == (0.9, 1.1) and row["bake cpu s"] > 0 and row["us a pixel"] > 0
        assert 0.8 < row["mean / paths"] < 1.2 and row["black pixels"] == 0
        assert row["probes"] == "4 x 4 x 4" and row["resolution"] == 32 and 0.1 < row["spacing m"] < 2
    assert_published(probes_defaults.TERM_TABLE, rows)
    assert set(gallery.sets[0].images) == {"irradiance", "hybrid"}


def test_default_settings_are_those_of_the_class(view, monkeypatch):
    """The rows of defaults set nothing but what they compare, and take materials as they are."""
    asked = []
    monkeypatch.setattr(view, "stage", lambda spp, **settings: asked.append(settings) or 1 / 0)
    for rows in (
        lambda: probes_defaults.term_rows(probes_defaults.ROOMS, view, 1),
        lambda: probes_defaults.irradiance_rows(probes_defaults.ROOMS, view),
        lambda: probes_defaults.dark_rows({"lit": view, "dark": view}),
    ):
        with pytest.raises(ZeroDivisionError):
            rows()
    assert asked == [{"mode": "irradiance"}, {"mode": "irradiance"}, {"visibility": "probes"}]
    assert all(case.materials is None and not case.settings for case in probes_defaults.CASES)


def test_the_readme_shows_every_place_of_default_settings():
    (grid,) = [part for part in REGIONS["probes"].parts if part.table == probes_defaults.TERM_TABLE]
    assert [only["case"] for only in grid.lines.values()] == [case.name for case in probes_defaults.CASES]
    assert probes_defaults.MOST_BAKE == 40
    assert {case.within for case in probes_defaults.CASES if "sponza" in case.place} == {0.12}


def test_the_dark_room_stands_beside_the_lit_one():
    views = probes_views.room_views((24, 16), "cpu", 16)
    rows = probes_defaults.dark_rows(views, **SMALL, counts=(8, 3, 4), irradiance_resolution=16)
    assert [(row["visibility"], row["target"]) for row in rows] == [("probes", 0.015), ("exact", 0.006)]
    assert all(row["dark / lit"] < 2 * row["target"] and 0.9 < row["lit / paths"] < 1.2 for row in rows)
    assert_published(probes_defaults.DARK_TABLE, rows)


def test_black_pixels_are_those_that_should_not_be():
    reference = np.full((2, 4, 3), 1.0)
    reference[0, :2] = [[0.01] * 3, [0.0] * 3]
    picture = np.where(np.arange(8).reshape(2, 4, 1) < 5, 0.0, [0.0, 0.5, 0.0])
    assert probes_defaults.black_share(picture, reference) == 3 / 8
    assert probes_defaults.black_share(np.full((2, 4, 3), 1e-9), reference) == 0


def test_bakes_are_for_the_camera_of_the_view(view):
    """A bake tells which cameras it was made for; that of two rooms is for those of both."""
    bake, _ = view.bake(gi.LightFieldProbes(counts=(2, 2, 2), **SMALL))
    np.testing.assert_allclose(bake.arrays["cameras"], camera_rows([view.camera]), atol=1e-6)
    rooms = probes_views.room_views((24, 16), "cpu", 16)
    settings = gi.LightFieldProbes(counts=(4, 2, 2), **SMALL)
    bake, _ = rooms["dark"].bake(settings)
    cameras = [PLACES[name].camera() for name in ("two_rooms", "two_rooms_dark")]
    np.testing.assert_allclose(bake.arrays["cameras"], camera_rows(cameras), atol=1e-5)
    assert rooms["lit"].bake(settings)[0] is bake


# ---- bakes and denoisers ----


def test_bakes_tell_time_memory_and_passes(view):
    row = probes_light.bake_row(probes_views.CORNELL, view, 32)
    assert row["million rays"] == 64 * 32**2 * 2 / 1e6 and row["MB"] > 64 * 32**2 * 8 / 1e6
    assert 1 < row["passes"] <= 16 and row["last change"] <= 0.005 and row["update ms a probe, cpu"] > 0
    assert_published("bakes", [row])


def test_denoisers_are_compared_with_their_own_pipeline(monkeypatch):
    monkeypatch.setattr(probes_denoise, "FRAME", 2)
    monkeypatch.setattr(probes_denoise, "RAYS", (1,))
    scene = scenes.peer_scene(gi.builtin_scene("cornell_box"), diffuse=True)
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
    monkeypatch.setattr(scenes, "SCENES", tmp_path)
    for place in (probes_views.LIVING_ROOM, probes_views.SPONZA):
        assert "WARP_GI_SCENES" in place.missing
    monkeypatch.setattr(probes_defaults, "QUICK_CASES", (probes_defaults.CASES[0],))
    (row,) = probes_defaults.default_rows(True, "cpu")
    assert row["case"] == "living room, white sky" and "WARP_GI_SCENES" in row["skipped"]
