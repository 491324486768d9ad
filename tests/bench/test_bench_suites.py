"""The suites `compile` and `sequence`, Blender as a peer, and `warp-gi bench all`, at sizes for every test run."""

from __future__ import annotations

import json

import numpy as np
import pytest

import warp_gi as gi
from warp_gi import launch
from warp_gi.bench.harness import catalogue, columns, measure, records, runner, scenes
from warp_gi.bench.harness import gallery as galleries
from warp_gi.bench.harness.gallery import CLOSED, Gallery, PictureSet
from warp_gi.bench.peers import blender_peer
from warp_gi.bench.report import suite_plots as report_plots
from warp_gi.bench.suites.compile import suite as compile
from warp_gi.bench.suites.probes import suite as probes
from warp_gi.bench.suites.rays import suite as rays
from warp_gi.bench.suites.reuse import suite as reuse
from warp_gi.bench.suites.sequence import suite as sequence
from warp_gi.cli import main as cli

# ---- compile ----


def test_a_module_is_compiled_once_with_an_empty_cache():
    row = compile._cold_and_warm("warp_gi.kernels.compose", "cpu")
    assert list(row) == ["cold s", "warm s", "object kB"]
    assert row["cold s"] > 0 and row["warm s"] > 0 and row["object kB"] > 1


def test_the_suite_counts_what_the_first_frame_needs(monkeypatch):
    def measured(name: str, device: str) -> dict:
        needed = ["warp_gi.kernels.compose", "warp_gi.kernels.gbuffer"]
        times = {"cold s": 2.0, "warm s": 0.5, "object kB": 10.0}
        if name == compile.FRAME:
            return {"cold s": 3.0, "warm s": 0.25, "object kB": 20.0, "modules": needed}
        return {"failed": "no compiler"} if name.endswith("bvh_build") else times

    monkeypatch.setattr(compile, "_cold_and_warm", measured)
    quick, full = compile.run(quick=True), compile.run(quick=False)
    assert [row.get("module") for row in quick] == ["compose", "gbuffer", None]
    assert len(full) > 20 and [row["module"] for row in full if "failed" in row] == ["bvh_build"]
    assert catalogue.columns_of("compile").undeclared(full) == []
    for rows in (quick, full):
        last = rows[-1]
        assert last["table"] == "first frame" and last["modules"] == last["measured"] == 2
        assert (last["sum of cold s"], last["sum of warm s"], last["sum of object kB"]) == (4.0, 1.0, 20.0)
        assert (last["in one process, cold s"], last["in one process, warm s"]) == (3.0, 0.25)
    rows = [row | {"object kB": float(i + 1)} for i, row in enumerate(quick[:-1])]
    assert set(report_plots.plots_of("compile", rows)[0].series) == {"cold s", "warm s"}


# ---- sequence ----

SMALL = sequence.Size(6, "24x16", 2)


def test_a_sequence_is_rendered_and_measured():
    found = sequence.measure("cornell_box", ("--denoise", "spatiotemporal"), SMALL, "cpu")
    rows = sequence.rows_of("path", found, SMALL)
    assert catalogue.columns_of("sequence").undeclared(rows) == []
    speed, stages, memory, *series = rows
    assert (
        speed["frames a minute"] == pytest.approx(360 / (speed["wall s"] - stages["compile s"]))
        and speed["peak GB"] > 0.05
    )
    assert speed["s a frame"] > 0 and speed["s a frame spread"] >= 0
    for column in ("start s", "load s", "compile s", "trace s a frame", "denoise s a frame", "write s a frame"):
        assert stages[column] > 0, column
    assert stages["bake s"] >= 0 and stages["preprocess s a frame"] >= 0
    assert memory["first MB"] > 50 and memory["KB a frame"] is not None
    assert [row["frame number"] for row in series] == list(range(6))
    assert list(report_plots.plots_of("sequence", rows)[0].series) == ["path"]


def test_a_sequence_that_fails_is_a_row():
    found = sequence.measure("cornell_box", ("--pipeline", "pth"), SMALL, "cpu")
    (row,) = sequence.rows_of("pth", found, SMALL)
    assert "unknown pipeline 'pth'" in row["failed"]


def test_a_sequence_has_a_part_for_each_pipeline(monkeypatch):
    asked = []

    def measure(scene, arguments, size, device):
        asked.append((arguments, size))
        return {"failed": "asked alone"}

    monkeypatch.setattr(sequence, "measure", measure)
    monkeypatch.setattr(sequence.blender_peer, "rows", lambda job: [{"job": job}])
    assert [row["pipeline"] for row in sequence.run(False)[:-1]] == list(sequence.CASES)
    assert [size for _, size in asked] == [sequence.FULL_SIZE] * 6
    asked.clear()
    *ours, theirs = sequence.run(True)
    assert [row["pipeline"] for row in ours] == ["path", "probes, 4x4x4 of 64x64", "reuse"]
    assert theirs == {"job": sequence.blender_peer.QUICK} and "64" in asked[1][0]
    assert {size for _, size in asked} == {sequence.QUICK_SIZE}
    (row,) = sequence.run(False, parts=["denoised"])
    assert row["pipeline"] == "path, denoised"


def test_memory_growth_is_a_least_squares_line():
    line = 100 + 0.5 * np.arange(40)
    assert sequence.slope(line)["KB a frame"] == pytest.approx(500)
    assert sequence.slope(line)["KB a frame spread"] == pytest.approx(0, abs=1e-6)
    noise = np.random.default_rng(1).standard_normal(400)
    found = sequence.slope(100 + noise)
    assert abs(found["KB a frame"]) < 3 * found["KB a frame spread"]
    assert found["KB a frame spread"] == pytest.approx(1e3 * (12 / 300**3) ** 0.5, rel=0.1)
    filling = np.concatenate([np.arange(10.0), np.full(30, 10.0)])
    assert sequence.slope(filling)["KB a frame"] == pytest.approx(0, abs=1e-9)  # caches fill at first
    assert sequence.slope(np.ones(2))["KB a frame"] is None


def test_stages_are_summed_by_kind():
    sums = dict.fromkeys(sequence.STAGES, 0.0)
    sequence.add_stages(sums, {"bake": 9.0, "compile": 1.0, "preprocess emitters": 1.0, "paths": 2.0, "write": 0.5})
    sequence.add_stages(sums, {"preprocess octree": 1.0, "primary": 1.0, "paths": 1.0, "denoise": 4.0, "write": 0.5})
    assert sums == {"preprocess": 2.0, "trace": 4.0, "denoise": 4.0, "write": 1.0}


# ---- Blender ----


def test_blender_is_a_row_where_it_is_missing(monkeypatch):
    monkeypatch.setattr(blender_peer, "PYTHON", "/nowhere/python")
    (row,) = blender_peer.rows(blender_peer.QUICK)
    assert "pip install '.[blender]'" in row["skipped"] and "3.11" in row["skipped"]


def test_the_exported_file_holds_the_scene(tmp_path):
    scene = scenes.peer_scene(gi.builtin_scene("cornell_box"), diffuse=True)
    blender_peer.write_glb(scene, tmp_path / "s.glb")
    loaded = gi.load_scene(tmp_path / "s.glb")
    assert (loaded.triangle_count, loaded.emitter_count) == (scene.triangle_count, scene.emitter_count)
    np.testing.assert_allclose(loaded.bounds, scene.bounds, atol=1e-6)
    camera = scene.cameras["main"].at_resolution(32, 24)
    a, b = (next(iter(gi.render(s, camera, gi.Pipeline(spp=256)))).numpy("beauty") for s in (scene, loaded))
    assert blender_peer.tiles_differ(a, b) < 1e-3


def test_tiles_differ_by_their_means():
    a = np.ones((19, 17, 3))
    b = a.copy()
    b[::2], b[1::2] = 2.0, 0.0  # the same mean over each tile
    assert blender_peer.tiles_differ(b, a) == 0
    assert blender_peer.tiles_differ(a + 0.1, a) == pytest.approx(0.01 / 1.01)


@pytest.mark.skipif(not blender_peer.is_installed(), reason="no bpy; pip install bpy")
def test_blender_shows_the_same():
    (row,) = blender_peer.rows(blender_peer.QUICK)
    assert abs(row["means differ"]) < 0.03 and row["relMSE of tiles"] < 0.01


# ---- pictures ----


def test_a_gallery_keeps_means_of_blocks():
    image = np.random.default_rng(4).uniform(0.01, 30.0, (7, 2 * galleries.WIDEST + 3, 3)).astype(np.float32)
    broken = image.copy()
    broken[0, 0], broken[3, 3] = np.nan, np.inf
    gallery = Gallery()
    gallery.of("mine").add(PictureSet("case", image, {"broken": broken}))
    (kept,) = gallery.sets
    assert (kept.suite, kept.case) == ("mine", "case") and "means of 3 x 3" in kept.note
    assert kept.reference.shape == (2, image.shape[1] // 3, 3) and kept.reference.dtype == np.float32
    expected = image[3:6, 6:9].mean(axis=(0, 1))
    np.testing.assert_allclose(kept.reference[1, 2], expected, rtol=2.0**-6)
    assert (kept.reference[1, 2] != expected).any()  # rounded, to be small
    assert np.isnan(kept.images["broken"][0, 0]).all() and np.isinf(kept.images["broken"][1, 1]).all()
    with pytest.raises(gi.OptionError, match="expected floats"):
        gallery.add(PictureSet("case", image, {"bad": image[:, :, 0]}))


def test_rounding_is_below_the_error_maps_scale():
    image = np.random.default_rng(5).uniform(1e-3, 100.0, (50, 60, 3)).astype(np.float32)
    gallery = Gallery()
    gallery.add(PictureSet("case", None, {"one": image}))
    (kept,) = gallery.sets
    assert kept.note == "values kept to 1.6%" and gi.metrics.rel_mse(kept.images["one"], image) < 1e-4


def test_a_closed_gallery_keeps_nothing():
    CLOSED.of("mine").add(PictureSet("case", np.ones((2, 3, 3))))
    assert CLOSED.sets == []


def test_parts_of_suites_get_the_gallery_if_they_take_it(monkeypatch):
    gallery = Gallery("mine")
    for suite in (probes, reuse):
        parts = {"with": lambda quick, device, gallery: [gallery], "without": lambda quick, device: [quick, device]}
        monkeypatch.setattr(suite, "PARTS", parts)
        assert suite.run(True, "cpu", gallery=gallery) == [gallery, True, "cpu"]
        assert suite.run(True, "cpu", ["without"]) == [True, "cpu"]


@pytest.mark.parametrize("arguments, is_open", [([], False), (["--html", "r.html"], True)])
def test_pictures_are_kept_for_a_report_alone(arguments, is_open, tmp_path, monkeypatch, capsys):
    seen = []
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(rays, "run", lambda quick, device, gallery: seen.append(gallery) or [{"scene": "one"}])
    assert cli.main(["bench", "rays", *arguments]) == 0
    assert [(gallery.suite, gallery.is_open) for gallery in seen] == [("rays", is_open)]


# ---- what a suite took ----


def test_the_last_row_is_of_the_whole_suite(monkeypatch):
    def run(quick: bool, device: str) -> list[dict]:
        np.ones(40_000_000)  # 320 MB, for a moment
        launch.compile_seconds += 2.0
        return [{"scene": "one"}]

    monkeypatch.setattr(launch, "compile_seconds", 7.0)
    monkeypatch.setattr(rays, "run", run)
    first, whole = runner.run_suite("rays", True, "cpu")
    assert first == {"scene": "one"} and whole["table"] == "run" and whole["compile s"] == pytest.approx(2.0)
    assert 0 < whole["cpu s"] and 0 < whole["wall s"] < 60
    assert whole["peak GB"] > 0.32
    monkeypatch.setattr(rays, "run", lambda quick, device: [])
    if measure._forget_peak():  # where the system can: of this run, not of before
        assert runner.run_suite("rays", True, "cpu")[-1]["peak GB"] < whole["peak GB"] - 0.2
    assert all(columns.Columns("any")[name].better == "lower" for name in whole if name != "table")


def test_versions_of_peers_are_told(monkeypatch):
    def version(package: str) -> str:
        if package == "bpy":
            raise runner.metadata.PackageNotFoundError
        return "1.0"

    monkeypatch.setattr(runner.metadata, "version", version)
    monkeypatch.setenv("WARP_GI_BLENDER_PYTHON", "/nowhere/python")
    runner._version.cache_clear()
    found = runner.environment("cpu")
    assert "bpy" not in found and found["pyoidn"] == found["OpenImageIO"] == "1.0"
    runner._version.cache_clear()
    monkeypatch.setattr(runner, "_printed", lambda arguments: f"4.2 of {arguments[0]}")
    assert runner.environment("cpu")["bpy"] == "4.2 of /nowhere/python"
    runner._version.cache_clear()


# ---- all ----


def test_all_goes_on_after_a_suite_that_fails(tmp_path, monkeypatch, capsys):
    asked = []

    def run_suite(name: str, quick: bool, device: str, gallery: Gallery) -> list[dict]:
        asked.append((name, quick, device))
        gallery.of(name).add(PictureSet(f"case of {name}", np.ones((2, 3, 3))))
        if name == "bad":
            raise RuntimeError("out of\nluck")
        return [{"case": name, "wall s": 1.5}]

    monkeypatch.setattr(catalogue, "suites", lambda: dict.fromkeys(("bad", "first", "last"), "Measures."))
    monkeypatch.setattr(runner, "run_suite", run_suite)
    page, lines = tmp_path / "r.html", tmp_path / "r.jsonl"
    arguments = ["bench", "all", "--quick", "--html", str(page), "--json", str(lines)]
    assert cli.main(arguments) == 1
    assert [name for name, *_ in asked] == ["bad", "first", "last"] and asked[0][1:] == (True, "cpu")
    rows = records.read([lines])
    assert [(row["suite"], row.get("failed"), row.get("wall s")) for row in rows] == [
        ("bad", "RuntimeError: out of luck", None),
        ("first", None, 1.5),
        ("last", None, 1.5),
    ]
    text = page.read_text(encoding="utf-8")
    for suite, section in zip(("bad", "first", "last"), text.split("<section ")[1:], strict=True):
        assert f"<h2>{suite}</h2>" in section and f"case of {suite}" in section  # also what was drawn before it failed
    said = capsys.readouterr()
    assert said.err == "failed: bad\n" and str(lines) in said.out
    monkeypatch.setattr(catalogue, "suites", lambda: {"first": "Measures."})
    assert cli.main(arguments) == 0
    assert [row["suite"] for row in records.read([lines])] == ["first"]


def test_a_part_that_failed_is_exit_code_1(monkeypatch, capsys):
    rows = [{"case": "a", "wall s": 1.0}, {"case": "b", "failed": "no luck"}]
    monkeypatch.setattr(catalogue, "suites", lambda: {"one": "Measures."})
    monkeypatch.setattr(runner, "run_suite", lambda *given: rows)
    assert [cli.main(["bench", name]) for name in ("one", "all")] == [1, 1]
    assert capsys.readouterr().err == "failed: one\n" * 2
    rows.pop()
    assert [cli.main(["bench", name]) for name in ("one", "all")] == [0, 0]


def test_parts_of_a_suite_are_chosen_by_name(monkeypatch, capsys):
    monkeypatch.setitem(reuse.PARTS, "cost", lambda quick, device: [{"case": "a", "bits": 1 + quick}])
    assert cli.main(["bench", "reuse", "--parts", "cost", "--quick", "--json", "-"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]  # lines alone
    assert [row.get("case") for row in rows] == ["a", None] and rows[1]["table"] == "run"
    for arguments, message in (
        (["reuse", "--parts", "csot"], "unknown part of suite reuse 'csot'; did you mean 'cost'"),
        (["compile", "--parts", "cost"], "unknown part of suite compile"),
        (["all", "--parts", "cost"], "--parts is for one SUITE"),
        (["--quick"], "for a SUITE to run"),
        (["--quick", "compare"], "compare comes first"),
    ):
        assert cli.main(["bench", *arguments]) == 2
        said = capsys.readouterr().err
        assert message in said and len(said.splitlines()) == 1


def test_the_commit_is_of_our_own_tree(monkeypatch, tmp_path):
    runner.commit.cache_clear()
    monkeypatch.setattr(runner, "_printed", lambda arguments: None if "ls-files" in arguments else "another's")
    assert runner.commit() == "unknown"
    runner.commit.cache_clear()


def test_all_keeps_what_was_measured_before_an_interrupt(tmp_path, monkeypatch, capsys):
    def run_suite(name: str, quick: bool, device: str, gallery: Gallery) -> list[dict]:
        if name == "second":
            raise KeyboardInterrupt
        return [{"case": name}]

    monkeypatch.setattr(catalogue, "suites", lambda: dict.fromkeys(("first", "second"), ""))
    monkeypatch.setattr(runner, "run_suite", run_suite)
    assert cli.main(["bench", "all", "--json", str(tmp_path / "r.jsonl")]) == 130
    assert [row["suite"] for row in records.read([tmp_path / "r.jsonl"])] == ["first"]
    assert cli.main(["bench", "all", "--json", str(tmp_path)]) == 2
    assert "is a folder" in capsys.readouterr().err


def test_the_list_names_suites_all_and_compare(capsys):
    assert cli.main(["bench"]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in ("compile", "sequence", "all", "compare"))


@pytest.mark.slow
@pytest.mark.parametrize("suite", ["compile", "sequence"])
def test_quick_forms_run(suite):
    rows = runner.run_suite(suite, True, "cpu")
    assert len(rows) > 3 and not [row for row in rows if "failed" in row]
