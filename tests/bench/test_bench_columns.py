"""Columns are declared once a suite, and what refers to one that is not declared fails; a suite is a folder alone."""

from __future__ import annotations

import importlib
import inspect
import sys

import pytest

import warp_gi as gi
from warp_gi.bench import suites as suites_package
from warp_gi.bench.compare.rows import SERIES
from warp_gi.bench.harness import catalogue, columns, diff, records
from warp_gi.bench.publish import command as publish
from warp_gi.bench.publish.figures import Figure, Grid, GridColumn, Headline, Region, Text
from warp_gi.bench.report import suite_plots
from warp_gi.bench.suites.rays import suite as rays
from warp_gi.cli import main as cli

RESULTS = sorted((catalogue.ROOT / "bench/results").glob("*.jsonl"))
SOME = columns.columns(
    "s",
    columns.keys("case"),
    columns.measured(columns.TIME, "s", "lower", "wall s"),
    columns.measured(columns.RATIO, "times", "higher", "faster than *"),
)


# ---- declarations ----


@pytest.mark.parametrize("path", RESULTS, ids=lambda path: path.stem)
def test_results_have_declared_columns_alone(path):
    """Of every committed row: its columns are declared, and numbers and words are where they should be."""
    rows = records.read([path])
    (suite,) = {row["suite"] for row in rows}
    found = catalogue.columns_of(suite)
    assert found.undeclared(map(records.measured, rows)) == []
    for row in map(records.measured, rows):
        for name, value in row.items():
            if (column := found.get(name)) is not None and column.kind.tolerance is not None:
                assert value is None or value == "" or records.is_number(value), f"{name}: {value!r} is no number"
    assert len({diff.identity_of(row) for row in rows}) == len([row for row in rows if "skipped" not in row])


@pytest.mark.parametrize("suite", [*catalogue.suites(), "compare"])
def test_every_suite_declares_its_columns(suite):
    found = catalogue.columns_of(suite)
    assert found.suite == suite and len(found.by_name) > len(columns.COMMON)
    for column in found.by_name.values():
        assert column.better is None or column.kind.tolerance is not None, f"{column.name}: better, but not compared"
        if column.kind in (columns.TIME, columns.RATE, columns.MEMORY):
            assert column.unit, f"{column.name} has no unit"
            assert column.better in (None, "higher" if column.kind is columns.RATE else "lower"), column.name


@pytest.mark.parametrize("suite", catalogue.suites())
def test_every_suite_has_parts_that_run(suite):
    found = catalogue.module(suite, "suite")
    assert callable(found.run) and catalogue.suites()[suite]
    for name, part in getattr(found, "PARTS", {}).items():
        assert name and (isinstance(part, str) or {"quick", "device"} <= set(inspect.signature(part).parameters))


def test_peers_and_papers_are_not_ours_to_improve():
    for suite in catalogue.suites():
        for name, column in catalogue.columns_of(suite).by_name.items():
            if name.startswith(("mitsuba", "embree ", "warp ", "blender", "raw ", "paper")) and "/ ours" not in name:
                assert column.better is None, f"{suite}: {name}"


def test_a_column_is_found_by_name_spread_or_pattern():
    assert SOME["wall s"].said == "s; lower is better" and SOME["case"].said == ""
    assert SOME["faster than path"].better == "higher" and SOME.get("faster than ") is None
    assert [SOME.is_spread(name) for name in ("wall s spread", "wall s +-", "cpu x spread")] == [True, True, False]
    assert SOME.undeclared([{"wall s": 1, "wall s spread": 0}, {"wal s": 1}, {"other spread": 2}]) == [
        "wal s",
        "other spread",
    ]
    with pytest.raises(gi.OptionError, match=r"suite 's' has no column 'wal s'; did you mean 'wall s'\?"):
        SOME["wal s"]
    with pytest.raises(gi.OptionError, match="declares the column 'case' twice"):
        columns.columns("s", columns.keys("case"), columns.notes("case"))


def test_a_suite_of_no_folder_has_the_columns_of_every_suite():
    assert catalogue.module("harness", "columns") is None  # a folder beside, and no suite
    assert set(catalogue.columns_of("nobody's").by_name) == {column.name for column in columns.COMMON}
    assert catalogue.columns_of("rays, machine 2") is catalogue.columns_of("rays")


# ---- what refers to columns ----


def test_rows_with_other_columns_fail_and_stay(monkeypatch, capsys, tmp_path):
    rows = [{"table": "rays", "scene": "a", "ours Mrays/s": 1.0, "ours Mrays/s spread": 0.1, "ours Mray/s": 1.0}]
    monkeypatch.setattr(rays, "run", lambda quick, device: rows)
    assert cli.main(["bench", "rays", "--json", str(tmp_path / "r.jsonl")]) == 1
    first, failed, _ = records.read([tmp_path / "r.jsonl"])
    assert first["ours Mray/s"] == 1.0 and failed["failed"].startswith("column 'ours Mray/s' of suite 'rays' is not")
    assert "failed: rays" in capsys.readouterr().err
    del rows[0]["ours Mray/s"]
    assert cli.main(["bench", "rays"]) == 0


@pytest.mark.parametrize(
    "make",
    [
        lambda: suite_plots.choices(SOME, suite_plots.Choice("t", "p", "case", ("wal s",))),
        lambda: suite_plots.choices(SOME, suite_plots.Choice("t", "p", "case", ("wall s",), only={"wal s": 1})),
        lambda: Region(SOME, "", (Text("{x}", {"x": Figure("wal s")}),)),
        lambda: Region(SOME, "", (Text("{x}", {"x": Figure("wall s", at_least="wal s")}),)),
        lambda: Region(SOME, "", (Text("{x}", {"x": Figure("wall s", over="wal s")}),)),
        lambda: Region(SOME, "", (Grid("", {"a": {"wal s": 1}}, ()),)),
        lambda: Region(SOME, "", (Grid("", "wal s", ()),)),
        lambda: Region(SOME, "", (Grid("", "case", (GridColumn("", Figure("wall s"), {"wal s": 1}),)),)),
        lambda: Headline(SOME, "x", "x", Text("{x}", {"x": Figure("wall s", {"wal s": 1})}), "x", "x"),
    ],
)
def test_a_name_that_is_not_declared_fails_where_it_is_used(make):
    with pytest.raises(gi.OptionError, match="suite 's' has no column 'wal s'; did you mean 'wall s'"):
        make()


@pytest.mark.parametrize("file", ["plots", "regions"])
def test_every_suite_s_plots_and_regions_name_declared_columns(file):
    """They check their names as they are imported."""
    assert len(list(catalogue.modules(file))) >= 7
    assert catalogue.module("compare", "plots").PLOTS[0].table == SERIES


def test_every_plot_has_rows_to_draw():
    for path in RESULTS:
        rows = records.read([path])
        module = catalogue.module(rows[0]["suite"], "plots")
        wanted = [choice.title for choice in module.PLOTS] if module is not None else []
        assert [plot.title for plot in suite_plots.plots_of(rows[0]["suite"], rows)] == wanted


# ---- a suite is a folder alone ----

TOY = {
    "__init__": "",
    "suite": '''"""Measures toys.

More."""
PARTS = {}
def run(quick, device):
    return [{"table": "t", "size": size, "toy s": 1.0 * size} for size in (1, 2)]
''',
    "columns": """from warp_gi.bench.harness.columns import TIME, columns, keys, measured
COLUMNS = columns("toy", keys("size"), measured(TIME, "s", "lower", "toy s"))
""",
    "plots": """from warp_gi.bench.report.suite_plots import Choice, choices
from warp_gi.bench.suites.toy.columns import COLUMNS
PLOTS = choices(COLUMNS, Choice("t", "Toys", "size", ("toy s",)))
""",
    "regions": """from warp_gi.bench.publish.figures import Figure, Grid, GridColumn, Headline, Region, Text
from warp_gi.bench.suites.toy.columns import COLUMNS
REGIONS = {"toy": Region(COLUMNS, "**Toys**:", (Grid("size", "size", (GridColumn("s", Figure("toy s")),), "t"),))}
HEADLINES = (Headline(COLUMNS, "Toy", "plays", Text("{s} s", {"s": Figure("toy s")}, "t"), "toys", "toys"),)
""",
    "sequence": """from warp_gi.bench.harness.sequences import Sequence
CASES = {"toy": Sequence(("--pipeline", "toy"))}
""",
    "scaling": """def rows(quick, device):
    return []
PARTS, PIPELINES = {"toys": rows}, ("toy",)
""",
}


@pytest.fixture
def toy(tmp_path, monkeypatch):
    """A folder of suites that holds a toy alone, as if it were ``bench/suites``."""
    (tmp_path / "suites/toy").mkdir(parents=True)
    for name, text in TOY.items():
        (tmp_path / f"suites/toy/{name}.py").write_text(text, encoding="utf-8")
    (tmp_path / "suites/helper.py").write_text("def run():\n    pass\n", encoding="utf-8")
    monkeypatch.setattr(catalogue, "FOLDER", tmp_path / "suites")
    monkeypatch.setattr(suites_package, "__path__", [str(tmp_path / "suites"), *suites_package.__path__])
    cached = (catalogue.columns_of, publish.regions, publish.headlines)
    for one in cached:
        one.cache_clear()
    importlib.invalidate_caches()
    yield tmp_path
    for name in [name for name in sys.modules if name.startswith("warp_gi.bench.suites.toy")]:
        del sys.modules[name]
    for one in cached:
        one.cache_clear()


def test_a_suite_is_its_folder(toy, capsys):
    """It is listed, run, compared, drawn and published, and is part of other suites, by what its folder holds."""
    assert catalogue.suites() == {"toy": "Measures toys."}
    file = toy / "bench/results/toy.jsonl"
    file.parent.mkdir(parents=True)
    assert cli.main(["bench", "toy", "--json", str(file), "--html", str(toy / "r.html")]) == 0
    assert 'title="s; lower is better"' in (toy / "r.html").read_text(encoding="utf-8")
    rows = records.read([file])
    assert suite_plots.plots_of("toy", rows)[0].series == {"toy s": ((1.0, 2.0), (1.0, 2.0))}
    slower = [row | ({"toy s": 2 * row["toy s"]} if "toy s" in row else {}) for row in rows]
    assert [change.column for change in diff.compare(rows, slower).worse] == ["toy s"] * 2
    (toy / "README.md").write_text("<!-- results: headlines -->\n<!-- end -->\n", encoding="utf-8")
    assert publish.publish(toy) == [publish.PAGE, publish.README]
    assert "| `Toy` | plays | 1.0 to 2.0 s | [toys](docs/techniques/toys.md) |" in (toy / "README.md").read_text(
        encoding="utf-8"
    )
    page = (toy / "docs/results.md").read_text(encoding="utf-8")
    assert "**Toys**:\n\n<!-- results: toy -->\n| size | s |\n|---|--:|\n| 1 | 1.0 |\n| 2 | 2.0 |\n" in page
    assert [suite for suite, _ in catalogue.modules("sequence")] == ["toy"]


def test_suites_measure_what_folders_add(toy, monkeypatch):
    from warp_gi.bench.suites.scaling import frames
    from warp_gi.bench.suites.scaling import suite as scaling
    from warp_gi.bench.suites.sequence import suite as sequence

    assert frames.presets() == ["path", "toy"] and list(frames.emitters()) == list(frames.BASELINES)
    names = [module.__name__ for module in (sequence, scaling)]
    try:
        assert list(importlib.reload(sequence).CASES) == ["toy"] and "toys" in importlib.reload(scaling).PARTS
    finally:
        monkeypatch.undo()
        for name in names:
            importlib.reload(sys.modules[name])
