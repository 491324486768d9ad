"""The suite `scaling`: its generated scenes, its fits and its rows, at sizes for every test run."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import warp as wp

import warp_gi as gi
from warp_gi import launch
from warp_gi.bench.harness import diff, runner
from warp_gi.bench.report import suite_plots as report_plots
from warp_gi.bench.report.plots import exponent
from warp_gi.bench.suites.dvf import scaling as dvf_scaling
from warp_gi.bench.suites.probes import scaling as probes_scaling
from warp_gi.bench.suites.scaling import frames as scaling_frames
from warp_gi.bench.suites.scaling import triangles as scaling_triangles
from warp_gi.bench.suites.scaling.columns import COLUMNS
from warp_gi.bench.suites.scaling.fits import Growth, words
from warp_gi.bench.suites.scaling.mesh import CROWD_VIEW, HALL, LAMP_AREA, SIDE, crowd, lamp_hall
from warp_gi.color import LUMINANCE


def table(rows: list[dict], name: str) -> list[dict]:
    """Return the rows of a table; all of ``rows`` have columns that the suite declares."""
    assert COLUMNS.undeclared(rows) == []
    return [row for row in rows if row["table"] == name]


# ---- fits ----


def test_exponents_of_power_laws():
    x = np.array([1.0, 3.0, 20.0, 1e4])
    assert exponent(x, 7.0 * x**1.5) == pytest.approx(1.5)
    assert exponent(x, x**-0.5) == pytest.approx(-0.5)
    assert exponent([2.0, 2.0], [1.0, 3.0]) is None


def test_growth_is_of_each_turn():
    sizes = [10, 100, 1000]
    slow = np.array([1.0, 4.0])  # the machine, in the second turn
    row = Growth.of(sizes, [slow, 2 * slow, 8 * slow]).row(3.0)
    assert row["exponent"] == pytest.approx(np.log10(8) / 2) and row["exponent spread"] == pytest.approx(0.0, abs=1e-12)
    assert row["growth for ten times"] == pytest.approx(4.0) and row["growth for ten times spread"] < 1e-9
    assert row["target"] == 3.0 and row["says"] == "worst from 100 to 1 K"


def test_growth_of_one_turn_has_no_spread():
    one = Growth.of([1, 10, 100], [[1.0], [3.0], [6.0]]).row()
    assert one["growth for ten times"] == pytest.approx(3.0) and not [key for key in one if "spread" in key]
    mixed = Growth.of([1, 10], [[1.0, 2.0, 9.0], [4.0]]).row()  # of the medians
    assert mixed["growth for ten times"] == pytest.approx(2.0) and "exponent spread" not in mixed


def test_growth_for_ten_times_lies_between_sizes():
    x = np.array([1.0, 4.0, 16.0, 64.0])
    growth = Growth.of(x, [[v] for v in x**0.7])
    assert list(growth.ratios) == [1.0, 4.0] and growth.ratio(4.0) == pytest.approx(10**0.7)
    assert Growth.of([9_840, 97_000], [[1.0], [2.0]]).worst == 9_840  # a little less than ten times
    assert set(Growth.of([1, 2], [[1.0], [2.0]]).row()) == {"exponent"}


def test_sizes_in_words():
    said = [words(x) for x in (0.3, 30, 999.9, 31_600, 316_000, 999_900, 1e6, 9_978_540)]
    assert said == ["0.3", "30", "1 K", "31.6 K", "316 K", "1 M", "1 M", "9.98 M"]


# ---- scenes ----


@pytest.mark.parametrize("count", [10_000, 31_600, 80_000])
def test_the_crowd_is_one_shape(count):
    points, indices = crowd(count)
    assert len(indices) == pytest.approx(count, rel=0.08) and indices.max() < len(points)
    a, b, c = (points[indices[:, k]].astype(np.float64) for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2
    assert areas.min() > 0 and areas.sum() == pytest.approx(785.0, rel=0.03)
    assert np.abs(points[:, [0, 2]]).max() < SIDE / 2 + 0.3
    origins, directions = scaling_triangles.primary_rays(CROWD_VIEW, 4000)
    hits = gi.TriangleBvh(points, indices).intersect(origins, directions)
    t, faces = hits.t.numpy(), hits.face.numpy()
    assert (faces >= 0).all() and t.mean() == pytest.approx(5.3, rel=0.03)  # closed all around, as deep
    front = np.einsum("ij,ij->i", np.cross(b - a, c - a)[faces], directions) < 0
    assert front.mean() > 0.99
    assert np.array_equal(crowd(count)[0], points)


def test_lamps_share_their_light():
    powers = []
    for lights in (10, 200, 2_000):
        scene = lamp_hall(lights)
        assert scene.emitter_count == lights
        powers.append(scene.emitter_powers().sum())
        low, high = scene.bounds
        assert np.allclose(high - low, HALL, atol=0.01)  # the lamps are within
    assert powers[2] == pytest.approx(np.pi * LAMP_AREA * 15.0 * LUMINANCE.sum(), rel=1e-3)
    assert powers[1] == pytest.approx(powers[2], rel=1e-3) and powers[0] == pytest.approx(powers[2], rel=0.3)
    row = scaling_frames.BASELINES["LightHierarchy"]
    picture = next(
        iter(gi.render(lamp_hall(10), scaling_frames.HALL_VIEW.at_resolution(16, 9), gi.Pipeline(emitters=row)))
    )
    assert picture.numpy("emitters").mean() > 1e-3


# ---- triangles ----


@pytest.fixture(scope="module")
def triangles() -> list[dict]:
    return scaling_triangles.rows_of((1_000, 20_000), 2_000, 2, "cpu", builds=2)


def test_rays_of_both_agree(triangles):
    rows = table(triangles, "triangles: rays")
    assert len(rows) == 2 * len(scaling_triangles.KINDS) * 2 and len({tuple(row) for row in rows}) == 1
    for row in rows:
        assert row["ours ns a ray"] > 0 and row["ours ns a ray spread"] >= 0
        if "embree ns a ray" in row:
            assert row["agree"] > 0.995 and row["embree ns a ray"] > 0 and row["ours / embree"] > 0


def test_builds_and_growth_have_rows(triangles):
    for row in table(triangles, "triangles")[:2]:
        assert row["build wall s"] > 0 and row["build cpu s"] > 0 and row["build peak GB"] >= 0
        assert 20 < row["bytes a triangle"] < 120
    (memory,) = table(triangles, "triangles: memory")
    assert memory["bytes a triangle"] == max(r["bytes a triangle"] for r in triangles if "build cpu s" in r)
    assert memory["target"] == 120
    ours = [row for row in table(triangles, "triangles: growth") if row["renderer"] == "ours"]
    assert len(ours) == 8 and {row["target"] for row in ours} == {1.8}
    assert all("the work of diffuse rays grows" in row["says"] for row in ours)
    (growth, *_) = table(triangles, "triangles: build growth")
    assert growth["what"] == "build cost s" and np.isfinite(growth["exponent"])  # its value is the machine's


def test_rays_have_one_thread_and_threads_are_given_back(monkeypatch):
    seen = []
    trace = scaling_triangles.Mesh.trace

    def spied(*arguments):
        seen.append(launch.thread_count())
        return trace(*arguments)

    monkeypatch.setattr(scaling_triangles.Mesh, "trace", spied)
    monkeypatch.setattr(launch, "_threads", 3)
    mesh = scaling_triangles.build(500, 200, "cpu", 1)
    scaling_triangles.race([mesh], "primary", "any", 1, "cpu")
    assert set(seen) == {1} and launch.thread_count() == 3


def test_without_embree_a_row_says_so(monkeypatch):
    def missing(*_, **__):
        raise ImportError

    monkeypatch.setattr(scaling_triangles, "embree_builder", missing)
    rows = scaling_triangles.rows_of((500, 6_000), 200, 1, "cpu", 1)
    assert [row["skipped"] for row in rows if "skipped" in row] == ["embreex is not installed: pip install embreex"]
    assert len(table(rows, "triangles: rays")) == 16 and not [key for row in rows for key in row if "embree" in key]


def test_rays_of_a_cell_follow_each_other():
    rng = np.random.default_rng(1)
    origins, directions = rng.random((5_000, 3)).astype(np.float32), rng.normal(size=(5_000, 3)).astype(np.float32)
    ordered, turned = scaling_triangles.in_cells(origins, directions)
    steps = [np.linalg.norm(np.diff(some, axis=0), axis=1).mean() for some in (origins, ordered)]
    assert steps[1] < 0.2 * steps[0]
    pairs = [sorted(map(tuple, np.hstack(both).tolist())) for both in ((origins, directions), (ordered, turned))]
    assert pairs[0] == pairs[1]


def test_few_rays_are_some_of_the_diffuse():
    points, indices = crowd(1_000)
    batches = scaling_triangles.batches_of(points, indices, 3_000)
    few = np.unique(np.hstack(batches["diffuse, few"]), axis=0)
    assert len(few) == scaling_triangles.FEW
    assert (np.diff(batches["diffuse, few"][0], axis=0) == 0).all(axis=1).mean() > 0.7  # no need to order them
    assert {tuple(ray) for ray in few.tolist()} <= {tuple(ray) for ray in np.hstack(batches["diffuse"]).tolist()}
    assert {len(origins) for kind, (origins, _) in batches.items() if kind != "primary"} == {3_000}


# ---- lights ----


def test_lights_have_a_row_for_each_estimator():
    rows = scaling_frames.light_rows_of((10, 200), (24, 16), 2, "cpu")
    lights, growth = table(rows, "lights"), table(rows, "lights: growth")
    assert len(lights) == 6
    both = [(name, what) for name in scaling_frames.emitters() for what in ("frame cost s", "lights MB")]
    assert [(row["estimator"], row["what"]) for row in growth] == both
    for row in lights:
        assert row["frame cpu s"] >= 0 and row["start s"] >= 0 and row["relative error"] > 0 and row["scene s"] > 0
    sizes = {(row["estimator"], row["lights"]): row["lights MB"] for row in lights}
    for name in scaling_frames.emitters():
        assert sizes[name, 200] > sizes[name, 10]
    assert sizes["VisibilityLightCache", 200] > sizes["LightHierarchy", 200] > sizes["PowerLights", 200]


def test_noise_is_that_of_one_picture():
    rng = np.random.default_rng(2)
    assert scaling_frames.noise(5.0 + 0.5 * rng.normal(size=(8, 40, 40, 3))) == pytest.approx(0.1, rel=0.05)


def test_shared_arrays_count_once():
    @wp.struct
    class Pair:
        a: wp.array(dtype=wp.float32)
        b: wp.array(dtype=wp.float32)

    pair = Pair()
    pair.a, pair.b = wp.zeros(100, dtype=wp.float32, device="cpu"), wp.zeros(50, dtype=wp.float32, device="cpu")
    assert scaling_frames.device_bytes(pair) == 600
    pair.b = pair.a
    assert scaling_frames.device_bytes(pair, pair) == 400


# ---- pixels, bakes, threads ----


def test_pixels_are_rendered_in_processes_of_their_own(monkeypatch):
    begun = []

    class Here(ThreadPoolExecutor):  # a process takes seconds to start
        def __init__(self, workers: int, mp_context: Any) -> None:
            begun.append((workers, mp_context.get_start_method()))
            super().__init__(workers)

    monkeypatch.setattr(scaling_frames, "ProcessPoolExecutor", Here)
    monkeypatch.setattr(scaling_frames, "presets", lambda: ["path"])
    monkeypatch.setattr(scaling_frames, "SCENE", "cornell_box")
    rows = scaling_frames.pixel_rows_of((0.0005, 0.02), "cpu")
    assert begun == [(1, "spawn")] * 2
    small, large = table(rows, "pixels")
    assert large["frame cpu s"] > 3 * small["frame cpu s"] > 0 and large["peak GB"] > 0.05
    cost, memory = table(rows, "pixels: growth")
    assert cost["exponent"] > 0.3 and memory["exponent"] < cost["exponent"]
    assert len(table(rows, "pixels: memory")) == 1


@pytest.mark.parametrize("size", [0.03, 1.0, 8.0])
def test_pictures_have_their_pixels_and_one_shape(size):
    width, height = scaling_frames.resolution_of(size)
    assert width * height == pytest.approx(size * 1e6, rel=0.01) and width / height == pytest.approx(16 / 9, rel=0.01)


def test_bakes_of_more_samples_err_less(monkeypatch):
    box = gi.builtin_scene("sphere_row")
    box.environment = (1.0, 1.0, 1.0)
    view = gi.builtin_camera_path("sphere_row").camera(0)
    monkeypatch.setattr(dvf_scaling, "ATRIUM", SimpleNamespace(scene=lambda: box, camera=lambda: view))
    rows = dvf_scaling.sample_rows_of((300, 30_000), (24, 16), 1, "cpu")
    few, many = table(rows, "bake samples")
    assert many["RMSE"] < few["RMSE"] and few["bake cpu s"] > 0 and few["cells"] == many["cells"] > 0
    cost, error = table(rows, "bake samples: growth")
    assert cost["what"] == "bake cost s" and error["what"] == "RMSE" and error["exponent"] < 0


def test_probes_grow_with_their_texels():
    rows = probes_scaling.probe_rows_of((16, 48), (2, 1, 1), 1, "cpu")
    small, large = table(rows, "probes")
    assert large["MB"] > small["MB"] > 0 and small["bake cpu s"] > 0
    assert [row["what"] for row in table(rows, "probes: growth")] == ["bake cost s", "MB"]


def test_threads_are_powers_of_two_and_all():
    assert [scaling_frames.thread_counts(n) for n in (1, 2, 6, 8)] == [[1], [1, 2], [1, 2, 4, 6], [1, 2, 4, 8]]


def test_speed_up_is_of_wall_seconds(monkeypatch):
    monkeypatch.setattr(launch, "_threads", 2)
    seen: list[int] = []
    rows = scaling_frames.speed_up_rows("frame", lambda _: seen.append(launch.thread_count()), (1, 3), 2, "cpu")
    assert seen == [1, 3] * 3 and launch.thread_count() == 2
    assert [row["threads used"] for row in rows] == [1, 3] and rows[0]["speed-up"] == rows[0]["efficiency"] == 1
    assert rows[1]["efficiency"] == pytest.approx(rows[1]["speed-up"] / 3)


# ---- the suite ----


def test_rows_are_told_apart(triangles):
    again = [{**row, "suite": "scaling"} for row in triangles]
    assert diff.compare(again, again).matched == len({diff.identity_of(row) for row in again if "skipped" not in row})
    assert len({diff.identity_of(row) for row in again}) == len(again)


def test_plots_have_a_line_for_each_kind(triangles):
    plots = {plot.title: plot for plot in report_plots.plots_of("scaling", triangles)}
    assert len(plots["Time a ray over triangles"].series) == 8 and plots["Time a ray over triangles"].fit
    assert list(plots["Bytes a triangle of the tree"].series) == ["bytes a triangle"]


@pytest.mark.slow
def test_the_quick_form_runs():
    rows = runner.run_suite("scaling", True, "cpu")
    assert len(rows) > 60 and not [row for row in rows if "failed" in row]
    assert len(report_plots.plots_of("scaling", rows)) >= 12
