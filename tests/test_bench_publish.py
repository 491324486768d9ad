"""What the documents say of measurements is what the results files say."""

from __future__ import annotations

import json

import pytest

import warp_gi as gi
from warp_gi.bench import publish

MARKED = "before\n<!-- results: path -->\nold\n<!-- end -->\nafter\n"
CASE = {"suite": "path", "commit": "0123abc", "cpu": "Some CPU", "case": "room | lamp"}
ROWS = [
    CASE | {"ours wall s": 10.04, "mitsuba wall s": 5.0, "faster, wall": 0.498},
    CASE | {"error ratio": 0.5, "faster at equal error, cpu": 1.0},
    CASE | {"case": "first frame", "wall s": 2.0},
    {"suite": "other", "table": "times: paper, RTX", "case": "theirs", "ms": 3.0},
]


@pytest.fixture
def root(tmp_path):
    (tmp_path / "bench/results").mkdir(parents=True)
    lines = "".join(json.dumps(row) + "\n" for row in ROWS)
    (tmp_path / "bench/results/path.jsonl").write_text(lines, encoding="utf-8")
    (tmp_path / "README.md").write_text(MARKED, encoding="utf-8")
    return tmp_path


def test_the_documents_of_this_repository_are_up_to_date(capsys):
    assert publish.main(["--check"]) == 0, capsys.readouterr().out
    assert publish.REGION.search((publish.ROOT / publish.README).read_text(encoding="utf-8"))


def test_a_marked_table_is_filled_and_the_rest_stays(root):
    assert publish.publish(root) == [publish.PAGE, publish.README]
    lines = (root / "README.md").read_text(encoding="utf-8").splitlines()
    assert lines[:2] == ["before", "<!-- results: path -->"] and lines[-2:] == ["<!-- end -->", "after"]
    assert lines[2].startswith("| picture | ours, s | Mitsuba, s | faster |")
    assert lines[4:-2] == [r"| room \| lamp | 10 | 5.0 | **0.498** | 0.50 | 1.00 |"]
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
    with pytest.raises(gi.OptionError, match=r"no row with all of 'ours wall s'"):
        publish.readme(MARKED, ROWS[:1])
    (root / "bench/results/path.jsonl").unlink()
    with pytest.raises(gi.OptionError, match=r"no \*.jsonl there"):
        publish.publish(root)
