"""What ``warp-gi bench --diff`` takes for the same row, for a change, for worse."""

from __future__ import annotations

import json
import math

import pytest

from warp_gi.bench.harness import catalogue, columns, diff
from warp_gi.cli import main as cli

COLUMNS = columns.columns(
    "s",
    columns.keys("case", "mode", "spp", "masks", "renderer"),
    columns.notes("target", "by frame"),
    columns.measured(columns.TIME, "ms", "lower", "ms"),
    columns.measured(columns.TIME, "s", None, "mitsuba wall s"),
    columns.measured(columns.RATE, "Mrays/s", "higher", "Mrays/s"),
    columns.measured(columns.ERROR, "", "lower", "RMSE"),
    columns.measured(columns.ERROR, "share", "higher", "agree"),
    columns.measured(columns.COUNT, "leaves", None, "leaves"),
    columns.measured(columns.MEMORY, "MB", "lower", "MB"),
)
HOME = {"suite": "s", "quick": False, "commit": "a", "cpu": "One", "cores": 2, "threads": 2, "device": "cpu"}


@pytest.fixture(autouse=True)
def columns_of_s(monkeypatch):
    monkeypatch.setattr(catalogue, "columns_of", lambda suite: COLUMNS if suite == "s" else columns.Columns(suite))


def row(**values):
    return HOME | {"table": "t", "case": "c"} | values


def names(changes):
    return [change.column for change in changes]


@pytest.mark.parametrize("key, value", [("case", "d"), ("mode", "m"), ("spp", 4), ("masks", True), ("quick", True)])
def test_what_tells_rows_apart(key, value):
    assert diff.identity_of(row()) != diff.identity_of(row(**{key: value}))


@pytest.mark.parametrize(
    "key, value",
    [("commit", "b"), ("cpu", "Two"), ("wall s", 1.0), ("by frame", "1.00 0.97 1e-5"), ("target", "4 / 2")],
)
def test_what_does_not_tell_rows_apart(key, value):
    assert diff.identity_of(row()) == diff.identity_of(row(**{key: value}))


@pytest.mark.parametrize(
    "column, new, found",
    [
        ("wall s", 1.149, ""),
        ("wall s", 1.151, "worse"),
        ("wall s", 0.851, ""),
        ("wall s", 0.849, "better"),
        ("RMSE", 1.049, ""),
        ("RMSE", 1.051, "worse"),
        ("RMSE", 0.949, "better"),
        ("RMSE", math.nan, "worse"),
        ("Mrays/s", 1.149, ""),
        ("Mrays/s", 1.151, "better"),
        ("Mrays/s", 0.849, "worse"),
        ("agree", 0.949, "worse"),
        ("leaves", 9, "changed"),
        ("mitsuba wall s", 2.0, "changed"),
    ],
)
def test_a_change_beyond_the_tolerance(column, new, found):
    result = diff.compare([row(**{column: 1.0})], [row(**{column: new})])
    lists = {name: names(getattr(result, name)) for name in ("worse", "better", "changed")}
    assert lists == {name: [column] if name == found else [] for name in lists}


def test_a_given_tolerance_holds_for_all():
    old, new = row(**{"wall s": 1.0, "RMSE": 1.0}), row(**{"wall s": 1.3, "RMSE": 1.3})
    assert names(diff.compare([old], [new], 0.25).worse) == ["wall s", "RMSE"]
    assert names(diff.compare([old], [new], 0.35).worse) == []


@pytest.mark.parametrize("spread", ["spread", "+-"])
def test_spreads_that_touch_are_no_change(spread):
    def with_spread(value, width):
        return row(**{"wall s": value, f"wall s {spread}": width})

    assert diff.compare([with_spread(1.0, 0.3)], [with_spread(1.99, 0.2)]).worse == []
    assert names(diff.compare([with_spread(1.0, 0.3)], [with_spread(2.01, 0.2)]).worse) == ["wall s"]
    assert names(diff.compare([with_spread(1.0, 0.01)], [with_spread(1.05, 0.01)]).worse) == ["wall s"]  # below 15 %
    assert diff.compare([with_spread(1.0, 0.0)], [with_spread(1.02, 0.0)]).worse == []
    quick = [with_spread(value, 0.0) | {"quick": True} for value in (1.0, 1.14, 1.16)]
    assert diff.compare(quick[:1], quick[1:2]).worse == [] and len(diff.compare(quick[:1], quick[2:]).worse) == 1
    assert names(diff.compare([with_spread(1.0, 0.3)], [row(**{"wall s": 1.2})]).worse) == ["wall s"]  # not in both
    assert diff.compare([with_spread(1.0, 0.3)], [with_spread(1.0, 9.0)]).changed == []  # spreads are no values


def test_nothing_from_zero_and_no_news_of_nan():
    assert names(diff.compare([row(RMSE=0.0)], [row(RMSE=1e-9)]).worse) == ["RMSE"]
    assert diff.compare([row(RMSE=0.0)], [row(RMSE=0.0)]).worse == []
    same = diff.compare([row(RMSE=math.nan)], [row(RMSE=math.nan)])
    assert same.worse == same.better == []
    assert names(diff.compare([row(RMSE=math.nan)], [row(RMSE=1.0)]).better) == ["RMSE"]


def test_the_last_row_counts():
    runs = [row(**{"wall s": 9.0}), row(**{"wall s": 1.0}), row(case="d", **{"wall s": 5.0})]
    assert diff.compare(runs, [row(**{"wall s": 2.0}), row(case="d", **{"wall s": 5.0})]).worse[0].old == 1.0
    assert diff.compare([row(**{"wall s": 1.0}), row(skipped="no scene")], [row(**{"wall s": 1.0})]).matched == 1


def test_times_of_another_machine_are_void_but_errors_are_not():
    old, new = row(RMSE=1.0, **{"wall s": 1.0, "Mrays/s": 5.0}), row(RMSE=2.0, **{"wall s": 9.0, "Mrays/s": 1.0})
    for key, value in (("cpu", "Two"), ("threads", 1), ("device", "GPU")):
        found = diff.compare([old], [new | {key: value}])
        assert names(found.worse) == ["RMSE"] and found.void == 2
    assert len(diff.compare([old], [new]).worse) == 3


def test_times_of_other_renderers_are_void_too():
    found = diff.compare([row(**{"mitsuba wall s": 1.0})], [row(**{"mitsuba wall s": 2.0}) | {"cpu": "Two"}])
    assert found.void == 1 and found.changed == []


def test_a_column_that_is_not_declared_is_neither_better_nor_worse_and_is_told(tmp_path, capsys):
    old, new = row(**{"old times": 1.0, "way": "a", "series": "1 2 3"}), row(**{"old times": 2.0, "way": "a"})
    found = diff.compare([old], [new])
    assert (found.matched, names(found.changed), found.worse) == (1, ["old times"], [])
    assert diff.compare([old], [new | {"way": "b"}]).matched == 0  # words tell rows apart
    code, printed = run(tmp_path, capsys, [old], [new])
    assert code == 0 and "suite 's' declares no columns old times, way, series" in printed


def test_the_papers_figures_are_never_worse():
    quoted = {"table": "times: paper, RTX 3080"}
    found = diff.compare([row(ms=1.0, **quoted)], [row(ms=2.0, **quoted)])
    assert found.worse == [] and names(found.changed) == ["ms"]


@pytest.mark.parametrize("renderer, is_worse", [("ours", True), ("mitsuba llvm_ad_rgb", False), ("field, map", True)])
def test_other_renderers_are_never_worse(renderer, is_worse):
    found = diff.compare([row(renderer=renderer, RMSE=1.0)], [row(renderer=renderer, RMSE=2.0)])
    assert names(found.worse if is_worse else found.changed) == ["RMSE"]
    assert names(found.changed if is_worse else found.worse) == []


# ---- the command ----


def write(path, *rows):
    path.write_text("".join(json.dumps(one) + "\n" for one in rows), encoding="utf-8")
    return str(path)


def run(tmp_path, capsys, old, new, *more):
    files = [write(tmp_path / "old.jsonl", *old), write(tmp_path / "new.jsonl", *new)]
    code = cli.main(["bench", "--diff", *files, *more])
    return code, " ".join(capsys.readouterr().out.split())


def test_three_tables_and_exit_code_1(tmp_path, capsys):
    old = [row(RMSE=1.0, **{"wall s": 2.0}, leaves=5), row(case="gone", ms=1)]
    new = [row(RMSE=0.5, **{"wall s": 3.0}, leaves=6, MB=1.0), row(case="come", ms=1)]
    code, printed = run(tmp_path, capsys, old, [one | {"commit": "b"} for one in new])
    assert code == 1
    worse, better, only = (printed.index(word) for word in ("worse", "better", "only in one of the files"))
    assert worse < printed.index("s t: c wall s 2 3 +50.0% 15.0%") < better
    assert better < printed.index("s t: c RMSE 1 0.5 -50.0% 5.0%") < only
    for text in ("OLD s t: gone all", "NEW s t: come all", "NEW s t: c MB"):
        assert printed.index(text) > only
    assert "commit: a -> b" in printed and "changed, neither better nor worse: 1 values of leaves" in printed
    assert "1 rows compared: 1 values worse, 1 better" in printed


def test_nothing_worse_is_exit_code_0(tmp_path, capsys):
    code, printed = run(tmp_path, capsys, [row(ms=1.0)], [row(ms=1.1)])
    assert code == 0 and all(f"{word}: nothing" in printed for word in ("worse", "better", "only in one of the files"))
    assert run(tmp_path, capsys, [row(ms=1.0)], [row(ms=1.1)], "--tolerance", "0.05")[0] == 1
    assert run(tmp_path, capsys, [row(ms=1.0)], [row(ms=0.5)])[0] == 0


def test_other_machines_and_skipped_rows_are_told(tmp_path, capsys):
    new = [row(ms=9.0, RMSE=1.0) | {"cpu": "Two"}, row(case="far", skipped="no scene; set it")]
    code, printed = run(tmp_path, capsys, [row(ms=1.0, RMSE=1.0)], new)
    assert code == 0 and "cpu: One -> Two" in printed and "1 times and rates are not compared" in printed
    assert "NEW has 1 rows skipped or failed: no scene; set it" in printed


def test_quick_and_full_are_not_compared(tmp_path, capsys):
    files = [write(tmp_path / "a.jsonl", row(ms=1.0)), write(tmp_path / "b.jsonl", row(ms=1.0, quick=True))]
    assert cli.main(["bench", "--diff", *files]) == 2
    assert "quick and full runs measure different inputs" in capsys.readouterr().err
