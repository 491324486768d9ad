"""The surface caches' benchmark: its rows and what documents show of them, on a scene small enough for every run."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

import warp_gi as gi
from warp_gi import launch
from warp_gi.bench import cache_pictures
from warp_gi.bench.harness import path_views, places
from warp_gi.bench.harness.gallery import Gallery
from warp_gi.bench.publish.figures import headlines_text, region_text
from warp_gi.bench.report import suite_plots
from warp_gi.bench.suites.cache import fills, leaks, light, moving, views
from warp_gi.bench.suites.cache.columns import COLUMNS
from warp_gi.bench.suites.cache.regions import HEADLINES, REGIONS

SIZE = (20, 14)


@pytest.fixture(scope="module")
def pictures() -> Gallery:
    return Gallery()


@pytest.fixture(scope="module")
def rows(pictures) -> list[dict]:
    """Rows of the whole suite, of one small place."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(light, "CASES", (replace(views.CASES[0], reference_spp=256),))
        patch.setattr(fills, "PATHS", (50_000, 150_000, 500_000))
        for module in (light, leaks):
            patch.setattr(module, "SIZE", SIZE)
        crate = replace(moving.CASES[0], frames={moving.ALL_ALONG: (1, 2)}, reference_spp=64)
        lamp = replace(moving.CASES[-1], reference_spp=16)
        patch.setattr(moving, "CASES", (crate, lamp))
        patch.setattr(moving, "SIZE", SIZE)
        found = light.light_rows(False, "cpu", pictures) + leaks.leak_rows(False, "cpu")
        found += moving.moving_rows(False, "cpu")
    return found


def named(rows: list[dict], table: str, **values) -> list[dict]:
    return [row for row in rows if row["table"] == table and values.items() <= row.items()]


def test_the_cache_stands_beside_paths(rows, pictures):
    assert COLUMNS.undeclared(rows) == [] and not any("failed" in row for row in rows)
    ours, paths = (named(rows, light.LIGHT, renderer=name, spp=64)[0] for name in (light.CACHE, light.PATHS))
    assert 0.95 < ours["mean / paths"] < 1.05 and ours["RMSE"] < 0.8 * paths["RMSE"]
    assert paths["faster, cpu"] == 1 and paths["FLIP / paths"] == 1
    gains = []
    for spp in (16, 64):
        mine, theirs = (named(rows, light.LIGHT, renderer=name, spp=spp)[0] for name in (light.CACHE, light.PATHS))
        gains.append(mine["faster, cpu"] * (mine["RMSE"] / theirs["RMSE"]) ** 2)
    assert gains[0] == pytest.approx(gains[1]) and gains[0] > 0  # by what is left of it: times, which are of 64 samples
    assert named(rows, light.ALL)[0]["faster, cpu"] == pytest.approx(ours["faster, cpu"])
    corrected = named(rows, light.LIGHT, renderer=light.RESIDUAL, spp=64)[0]
    assert 0.9 < corrected["mean / paths"] < 1.1
    (shown,) = pictures.sets
    told = [paths["mean / paths"], ours["mean / paths"], corrected["mean / paths"]]
    means = [image.mean() / shown.reference.mean() for image in shown.images.values()]
    assert means == pytest.approx(told, rel=0.02)


def test_fills_and_leaks_are_told(rows):
    (fill,) = named(rows, fills.FILL)
    assert 0 < fill["fill cpu s"] < 60 and fill["cells"] > 1000 and fill["MB"] >= fill["cells"] * 40e-6
    by_paths = named(rows, fills.BY_PATHS)
    assert [row["paths"] for row in by_paths] == list(fills.PATHS)
    assert by_paths[0]["samples a cell"] < by_paths[-1]["samples a cell"]
    assert [row["cell m"] for row in named(rows, leaks.LEAKS)][1:] == [0.1, 0.25]
    assert all(row["dark / lit"] < 0.1 for row in named(rows, leaks.LEAKS))


def test_motion_is_told(rows):
    crate = named(rows, moving.MOVING, case="crate slides")
    assert [row["renderer"] for row in crate] == [moving.PATHS, moving.CACHE]
    assert 0.9 < crate[1]["mean / paths"] < 1.1 and crate[1]["RMSE / mean"] < crate[0]["RMSE / mean"]
    lamp = [row for row in named(rows, moving.MOVING, renderer=moving.CACHE) if "lamp" in row["case"]]
    assert [row["case"].split(": ")[1] for row in lamp] == ["before", "that frame", "1 later", "4 later"]
    assert lamp[1]["mean / paths"] > 0.8 and all(row["refresh s"] > 0 for row in lamp)


def test_documents_show_all_of_it(rows):
    stamped = [row | {"suite": "cache", "commit": "abc", "device": "cpu"} for row in rows]
    text = region_text("cache", REGIONS["cache"], stamped)
    assert "| Cornell box |" in text and "`residual=0.3`" in text
    assert "times less CPU time" in headlines_text(HEADLINES, stamped)
    assert all(len(plot.series["Cornell box"]) >= 2 for plot in suite_plots.plots_of("cache", rows))


def test_what_samples_do_not_remove_is_the_bias_alone():
    """Noise of two pictures, and of both halves of a reference, is not in their mean product."""
    rng = np.random.default_rng(3)
    truth = rng.uniform(0.5, 1.5, (200, 100, 3))
    one, other, *halves = (truth + rng.normal(0, 0.2, truth.shape) for _ in range(4))
    assert path_views.mean_product(one + 0.1, other + 0.1, halves) == pytest.approx(0.01, rel=0.1)
    assert path_views.mean_product(one, other, halves) < 5e-4
    assert path_views.mean_squared(one, halves) == pytest.approx(0.04, rel=0.05)


def test_one_thread_is_for_a_while():
    before = launch.thread_count()
    with pytest.raises(gi.OptionError), views.one_thread():
        assert launch.thread_count() == 1
        raise gi.OptionError("no")
    assert launch.thread_count() == before


def test_places_whose_files_are_missing_are_one_row(monkeypatch, tmp_path):
    monkeypatch.setattr(places.scenes, "SCENES", tmp_path)
    monkeypatch.setattr(light, "CASES", tuple(case for case in views.CASES if case.missing))
    rows = light.light_rows(False, "cpu")
    assert len(rows) == 4 and all("WARP_GI_SCENES" in row["skipped"] for row in rows)


def test_pictures_are_one_sheet_and_missing_places_are_passed_over(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(places.scenes, "SCENES", tmp_path)
    monkeypatch.setattr(cache_pictures, "SHOWN", ("cornell_box", "sponza"))
    monkeypatch.setattr(cache_pictures, "SIZE", (24, 16))
    file = tmp_path / "sheet.jpg"
    assert cache_pictures.main(["-o", str(file), "--samples", "4", "--reference-samples", "8"]) == 0
    said = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in said] == ["sponza:", "wrote"] and "WARP_GI_SCENES" in said[0]
    assert Image.open(file).size == (3 * 28 - 4, 16 + 24)
    assert cache_pictures.main(["-o", str(tmp_path), "--samples", "0"]) == 2
