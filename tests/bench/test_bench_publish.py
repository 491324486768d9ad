"""What the documents say of measurements is what the results files say."""

from __future__ import annotations

import json
import re

import pytest

import warp_gi as gi
from warp_gi.bench.harness import catalogue, columns, markdown
from warp_gi.bench.publish import command as publish
from warp_gi.bench.publish.figures import Figure, Grid, GridColumn, Headline, Region, Text, headlines_text, region_text
from warp_gi.bench.publish.page import MOST_COLUMNS, page
from warp_gi.bench.suites.compile import suite as compile
from warp_gi.bench.suites.sequence import suite as sequence

MARKED = "before\n<!-- results: path -->\nold\n<!-- end -->\nafter\n"
CASE = {"suite": "path", "commit": "0123abc", "cpu": "Some CPU", "case": "room | lamp"}
ROWS = [
    CASE | {"ours wall s": 10.04, "mitsuba wall s": 5.0, "faster, wall": 0.498},
    CASE | {"error ratio": 0.5, "faster at equal error, cpu": 1.0},
    CASE | {"case": "first frame", "wall s": 2.0, "pixels": "8x8"},
    {"suite": "other", "table": "times: paper, RTX", "case": "theirs", "ms": 3.0},
]
COLUMNS = columns.columns(
    "path",
    columns.keys("case", "pixels"),
    columns.measured(columns.TIME, "s", "lower", "ours wall s"),
    columns.measured(columns.RATIO, "times", "higher", "faster, wall", "faster at equal error, cpu"),
)
SMALL = Region(
    COLUMNS,
    "**Small**:",
    (
        Grid(
            "picture",
            {"room | lamp": {"case": "room | lamp"}},
            (
                GridColumn("ours, s", Figure("ours wall s")),
                GridColumn("faster", Figure("faster, wall", digits=3, at_least=1.0)),
                GridColumn("equal error", Figure("faster at equal error, cpu", digits=3, at_least=1.0)),
            ),
        ),
        Text("The first of {pixels} takes {s} s.", {"pixels": Figure("pixels"), "s": Figure("wall s")}),
    ),
)
"""Stands for the region "path"."""
FIRST = Headline(COLUMNS, "Paths", "traces", Text("first in {s} s", {"s": Figure("wall s")}), "paths", "paths")
SUITES = catalogue.suites()


@pytest.fixture(autouse=True)
def suites_found_once(monkeypatch):
    monkeypatch.setattr(catalogue, "suites", lambda: SUITES)


@pytest.fixture
def root(tmp_path, monkeypatch):
    monkeypatch.setattr(publish, "regions", lambda: {"path": SMALL})
    monkeypatch.setattr(publish, "headlines", lambda: (FIRST,))
    (tmp_path / "bench/results").mkdir(parents=True)
    lines = "".join(json.dumps(row) + "\n" for row in ROWS)
    (tmp_path / "bench/results/path.jsonl").write_text(lines, encoding="utf-8")
    (tmp_path / "README.md").write_text(MARKED, encoding="utf-8")
    return tmp_path


# ---- the files ----


def test_the_documents_of_this_repository_are_up_to_date(capsys):
    assert publish.main(["--check"]) == 0, capsys.readouterr().out
    assert publish.REGION.search((publish.ROOT / publish.README).read_text(encoding="utf-8"))


def test_a_marked_region_is_filled_and_the_rest_stays(root):
    assert publish.publish(root) == [publish.PAGE, publish.README]
    lines = (root / "README.md").read_text(encoding="utf-8").splitlines()
    assert lines[:2] == ["before", "<!-- results: path -->"] and lines[-2:] == ["<!-- end -->", "after"]
    assert lines[2:5] == [
        "| picture | ours, s | faster | equal error |",
        "|---|--:|--:|--:|",
        r"| room \| lamp | 10 | **0.498** | 1.00 |",
    ]
    assert lines[5:-2] == ["", "The first of 8x8 takes 2.0 s.", "", "<sub>Measured at commit 0123abc, Some CPU.</sub>"]
    assert publish.publish(root) == []  # what it wrote is what it would write


def test_the_page_names_hardware_commit_and_every_row(root):
    publish.publish(root)
    page = (root / "docs/results.md").read_text(encoding="utf-8")
    assert "## path\n\nSpeed of the whole" in page and "\n- commit 0123abc, Some CPU\n" in page
    assert "### times: paper, RTX (the paper's own figures)\n\n| case | ms |\n|---|--:|\n| theirs | 3 |" in page
    assert page.index("## other") < page.index("## path")
    assert all(text in page for text in ("| 10.04 |", "| first frame | 2 |", "changes made here are lost"))


def test_check_finds_what_differs_and_writes_nothing(root, monkeypatch, capsys):
    monkeypatch.setattr(publish, "ROOT", root)
    assert publish.main(["--check"]) == 1
    assert capsys.readouterr().out.count("differs") == 2
    assert (root / "README.md").read_text(encoding="utf-8") == MARKED and not (root / "docs").exists()
    assert publish.main([]) == 0 and publish.main(["--check"]) == 0
    text = (root / "README.md").read_text(encoding="utf-8")
    (root / "README.md").write_text(text.replace("10 |", "9 |"), encoding="utf-8")
    capsys.readouterr()
    assert publish.main(["--check"]) == 1
    assert "README.md: differs" in capsys.readouterr().out


@pytest.mark.parametrize(
    "text, words",
    [
        ("<!-- results: pth -->\n<!-- end -->", "did you mean 'path'"),
        ("<!-- results: path -->\nno end", "path --> has no <!-- end -->"),
        ("<!-- results: path -->\n" + MARKED, "has no <!-- end -->"),
    ],
)
def test_marks_that_cannot_be_filled(root, text, words):
    (root / "README.md").write_text(text, encoding="utf-8")
    with pytest.raises(gi.OptionError, match=words):
        publish.publish(root)
    assert (root / "README.md").read_text(encoding="utf-8") == text and not (root / "docs").exists()


def test_results_that_are_missing(root):
    with pytest.raises(gi.OptionError, match=r"'path' have no value of 'faster at equal error, cpu' for case 'room"):
        publish.texts_of(ROWS[:1])
    (root / "bench/results/path.jsonl").unlink()
    with pytest.raises(gi.OptionError, match=r"no \*.jsonl there"):
        publish.publish(root)


def test_the_readme_has_the_processor_s_figures_and_the_page_both(root):
    on_gpu = [row | {"device": "cuda"} | {key: 77.0 for key in row if key.endswith(" s")} for row in ROWS[:3]]
    path = root / "bench/results/path.jsonl"
    (root / "bench/results/path_cuda.jsonl").write_text("".join(json.dumps(row) + "\n" for row in on_gpu))
    path.write_text("".join(json.dumps(row | {"device": "cpu"}) + "\n" for row in ROWS), encoding="utf-8")
    text = publish.pages(root)
    assert "77" not in text[publish.README] and "| 10 |" in text[publish.README]
    parts = text[publish.PAGE].partition("\n## All results")[2].split("\n## ")
    assert [part.partition("\n")[0] for part in parts[1:]] == ["other", "path, machine 1", "path, machine 2"]
    assert (
        ["77" in part for part in parts[2:]] == [False, True]
        and SUITES["path"] in parts[2]
        and SUITES["path"] in parts[3]
    )
    (root / "bench/results/more.jsonl").write_text(json.dumps(ROWS[0] | {"device": "cpu", "cpu": "B"}) + "\n")
    with pytest.raises(gi.OptionError, match="suite 'path' ran on several processors"):
        publish.publish(root)


def test_results_without_a_region_s_column_end_in_one_line(root, monkeypatch, capsys):
    monkeypatch.setattr(publish, "ROOT", root)
    (root / "bench/results/path.jsonl").write_text(json.dumps(ROWS[0]) + "\n", encoding="utf-8")
    assert publish.main([]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "region 'path'" in error
    assert (root / "README.md").read_text(encoding="utf-8") == MARKED and not (root / "docs").exists()


# ---- the README's words ----

HAND_TYPED = re.compile(
    r"(?<![\w.])\d[\d.,]*(?: to \d[\d.,]*)? ?(?:%|(?:times|bytes|million|[kKMG]B|n?s|ms|minutes|seconds)\b)"
    r"|(?<![\w.])\d+\.\d+|\b(?:twice|(?:two|three|four|five|six|seven|eight|nine|ten) times)\b|^\|.*\b\d.*$",
    re.MULTILINE,
)
NOT_MEASURED = ("3.10", "3.13", "8 bytes", "40 bytes", "5.1", "2.0", "0.5s")
"""Python's versions, sizes that the code sets, a paper's section, glTF's version, a flag's value."""


def hand_typed(text):
    """Return what looks like a measurement outside of regions and code."""
    for generated in (publish.REGION, re.compile(r"^```.*?^```", re.DOTALL | re.MULTILINE)):
        text = generated.sub("", text)
    return [found for found in HAND_TYPED.findall(text) if found not in NOT_MEASURED]


def test_the_readme_has_no_figure_typed_by_hand():
    assert hand_typed((publish.ROOT / publish.README).read_text(encoding="utf-8")) == []


@pytest.mark.parametrize(
    "figure",
    [
        "takes 11 to 13 s",
        "5 % less",
        "69 bytes",
        "1.1 million",
        "ten times",
        "runs at 1.14",
        "35 times",
        "| room | 34 |",
    ],
)
def test_a_figure_typed_by_hand_is_found(figure):
    assert hand_typed(f"words\n{figure}\n480x270, 64 samples, frames 16 to 25") != []
    assert hand_typed(f"<!-- results: path -->\n{figure}\n<!-- end -->\n```sh\n{figure}\n```\n") == []


# ---- regions ----

OF_S = columns.columns(
    "s", columns.keys("case", "mode", "spp"), columns.notes("aim"), [columns.Column("x", "", None, columns.COUNT)]
)


def text_of(part, rows):
    """Return a region of one part without its last line, on how it was measured."""
    return region_text("r", Region(OF_S, "", (part,)), [{"suite": "s"} | row for row in rows]).rpartition("\n\n")[0]


def cells_of(figure, rows, unless=None):
    """Return the cells of a table of one column, a line for "a" and one for "b"."""
    grid = Grid("case", {case: {"case": case} for case in "ab"}, (GridColumn("x", figure, unless or {}),), "t")
    return [line.split(" | ")[1].removesuffix(" |") for line in text_of(grid, rows).splitlines()[2:]]


AB = [{"table": "t", "case": "a", "x": 0.1234, "aim": 0.2}, {"table": "t", "case": "b", "x": 2.0, "aim": ""}]


def test_cells_are_of_the_rows_that_a_line_and_a_figure_name():
    assert cells_of(Figure("x"), AB) == ["0.12", "2.0"]
    assert cells_of(Figure("x", digits=3, scale=100.0), AB) == ["12.3", "200"]
    other = [row | {"table": "u", "x": 7, "mode": mode} for row in AB for mode in ("m", "n")]
    other[0]["x"] = 9
    assert cells_of(Figure("x", {"mode": "m"}, table="u"), AB + other) == ["9", "7"]
    assert cells_of(Figure("x", {"mode": ("m", "n")}, table="u"), AB + other) == ["7 to 9", "7"]


def test_values_short_of_their_aim_are_bold():
    assert cells_of(Figure("x", at_least=1.0), AB) == ["**0.12**", "2.0"]
    assert cells_of(Figure("x", at_most=1.0), AB) == ["0.12", "**2.0**"]
    assert cells_of(Figure("x", at_least="aim"), AB) == ["**0.12**", "2.0"]
    assert cells_of(Figure("x", at_most="aim"), AB) == ["0.12", "2.0"]
    assert cells_of(Figure("x", at_least=0.1234, at_most=2.0), AB) == ["0.12", "2.0"]


def test_a_figure_may_be_a_ratio_of_columns_and_a_table_have_a_line_for_each_value():
    assert cells_of(Figure("x", over="aim"), [row | {"aim": 0.1} for row in AB]) == ["1.2", "20"]
    grid = Grid("case", "case", (GridColumn("x", Figure("x")),), "t")
    lines = text_of(grid, [*AB[::-1], {"table": "u", "case": "c", "x": 1.0}]).splitlines()
    assert lines[2:] == ["| b | 2.0 |", "| a | 0.12 |"]


def test_headlines_are_lines_of_a_table_and_those_of_the_base_come_last():
    words = Text("{x} of {case}", {"x": Figure("x"), "case": Figure("case")}, "t")
    lines = [Headline(OF_S, name, "does", words, "Page", "page", "A 2020", name == "base") for name in ("base", "top")]
    table = headlines_text(lines, [{"suite": "s"} | row for row in AB[:1]]).splitlines()
    link = "[Page](docs/techniques/page.md), after A 2020"
    assert table[2:] == [f"| `{name}` | does | 0.12 of a | {link} |" for name in ("top", "base")]


def test_a_column_can_have_nothing_to_show():
    assert cells_of(Figure("x"), AB, {"aim": 0.2}) == ["none", "2.0"]


def test_sentences_show_ranges_and_words():
    words = Text("{x}: {case} of {table}.", {key: Figure(key) for key in ("x", "case", "table")}, "t")
    assert text_of(words, AB) == "0.12 to 2.0: a, b of t."
    long = Text("word " * 40 + "{x}", {"x": Figure("x")}, "t")
    lines = text_of(long, AB).splitlines()
    assert len(lines) == 2 and max(map(len, lines)) <= 120


@pytest.mark.parametrize("row", [{"x": 1.0}, {"table": "t"}, {"table": "t", "x": None}, {"table": "t", "x": ""}])
def test_a_value_that_the_results_lack_is_named(row):
    with pytest.raises(gi.OptionError, match="region 'r': the results of suite 's' have no value of 'x' for table 't'"):
        text_of(Text("{x}", {"x": Figure("x")}, "t"), [row])


def test_a_region_names_each_machine_and_commit_once_and_a_quick_run():
    common = {"suite": "s", "x": 1.0, "cpu": "C", "python": "3", "mitsuba": "3.9"}
    rows = [common | {"commit": c, "quick": q} for c, q in (("k", False), ("l", True), ("k", False))]
    text = region_text("r", Region(OF_S, "", (Text("{x}", {"x": Figure("x")}),)), [*rows, {"suite": "o", "x": 2.0}])
    assert text.startswith("1.0\n")
    assert text.endswith("<sub>Measured at commit k, l, C, quick run, not for quoting, mitsuba 3.9.</sub>")


def test_the_suites_compile_and_sequence_have_what_their_regions_show():
    frame = {"cold s": 3.0, "warm s": 0.25}
    module = {"module": "m", "first frame needs it": True, "cold s": 2.0, "warm s": 0.5, "object kB": 10.0}
    rows = [{"suite": "compile", "table": compile.FRAME} | compile.frame_row([module], frame)]
    text = " ".join(region_text("compile", publish.regions()["compile"], rows).split())
    assert "needs 1 kernel modules, 10 kB" in text and "3.0 s to compile and load, 0.25 s from" in text
    found = {
        "wall s": 100.0,
        "inside s": 99.0,
        "cpu s": 190.0,
        "peak GB": 1.0,
        "frames": [0.2] * 8,
        "memory": [1e9 + 2e3 * i for i in range(8)],
        "once": {"load s": 1.0, "bake s": 3.0},
        "a frame": {"trace s a frame": 0.1},
    }
    rows = [row for name in sequence.CASES for row in sequence.rows_of(name, found, sequence.FULL_SIZE)]
    blender = {"table": "Blender", "scene": "atrium", "pixels": "8x8", "spp": 16, "frames": 48, "blender": "5.0"}
    blender |= {"ours frames a minute": 30.0, "blender frames a minute": 60.0, "faster": 0.5, "means differ": -0.001}
    rows = [{"suite": "sequence"} | row for row in [*rows, blender]]
    text = " ".join(region_text("sequence", publish.regions()["sequence"], rows).split())
    assert all(f"| {name} | 300 | 3.0 | 0.10 | 1.0 | 2.0 |" in text for name in sequence.CASES)
    assert "30 frames a minute beside its 60, **0.50** times as many; the mean is -0.10 % off" in text


# ---- the page ----


def tables_of(rows):
    """Return the page's lines that are of tables, or told above one."""
    lines = page([{"suite": "path", "table": "t"} | row for row in rows], {}).partition("### t")[2].splitlines()
    return [line for line in lines if line]


def test_a_spread_stands_beside_its_value():
    rows = [{"a": 6.1449, "a spread": 0.0832, "b": 1.0, "b spread": None, "c spread": 3.0}]
    rows += [rows[0] | {"a": a, "a spread": spread} for a, spread in ((12345.6, 0.0), (0.5, 1e-9))]
    assert tables_of(rows) == [
        "| a | b | c spread |",
        "|--:|--:|--:|",
        "| 6.14 ± 0.08 | 1 | 3 |",
        "| 12,346 ± 0 | 1 | 3 |",
        "| 0.5000 ± 0.0000 | 1 | 3 |",
    ]


def test_a_series_is_shown_by_its_ends():
    assert tables_of([{"case": "a", "by frame": "2.70 1.5 1.01", "targets": "4 / 2.5"}])[2:] == [
        "| a | 2.70 … 1.01 (3) | 4 / 2.5 |"
    ]


def test_what_all_rows_say_stands_above_their_table():
    rows = [{"case": "a", "spp": 64, "s": s} for s in (1.0, 1.0)]
    assert tables_of(rows) == ["In all rows: spp 64.", "| case | s |", "|---|--:|", "| a | 1 |", "| a | 1 |"]
    assert tables_of(rows[:1]) == ["| case | spp | s |", "|---|--:|--:|", "| a | 64 | 1 |"]


@pytest.mark.parametrize("count, widths", [(10, [12]), (11, [8, 7]), (21, [9, 9, 9])])
def test_a_wide_table_is_parted(count, widths):
    rows = [
        {"case": case, "spp": spp} | {f"x{i}": float(i) for i in range(count)} for case, spp in (("a", 1), ("b", 2))
    ]
    heads = [line for line in tables_of(rows) if line.startswith("| case")]
    assert [line.count("|") - 1 for line in heads] == widths and max(widths) <= MOST_COLUMNS
    assert all(line.startswith("| case | spp | x") for line in heads)
    assert re.findall(r"x\d+", " ".join(heads)) == [f"x{i}" for i in range(count)]
    said, head, *_ = tables_of([row | {"spp": 1} for row in rows])
    assert said == "In all rows: spp 1." and head.startswith("| case | x0 |")


@pytest.mark.parametrize(
    "value, digits, text",
    [
        (0.00005288, 2, "0.000053"),
        (9.97, 2, "10"),
        (163.3, 2, "163"),
        (-0.172, 2, "-0.17"),
        (20772, 2, "20,772"),
        (1.0, 3, "1.00"),
        (0.0, 2, "0"),
        (float("inf"), 2, "inf"),
    ],
)
def test_numbers_have_the_digits_that_they_are_given(value, digits, text):
    assert markdown.significant(value, digits) == text
