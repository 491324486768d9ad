"""Tables of results, as commands print them."""

from warp_gi.bench.harness import records, tables


def test_rows_are_printed_as_a_table_for_each_set_of_keys(capsys):
    rows = [{"table": "one", "case": case, "s": s} for case, s in (("a", 1.5), ("b", 2.0))]
    tables.print_rows("suite", [*rows, {"table": "two", "other": 1}, {"third": 2}])
    printed = capsys.readouterr().out
    assert [line.strip() for line in printed.splitlines() if "suite" in line] == ["suite: one", "suite: two", "suite"]
    tables.print_rows("suite", rows, is_titled=False)
    assert capsys.readouterr().out.split()[0] == "one"


def test_spreads_stand_beside_values_and_what_all_rows_say_once(capsys):
    rows = [{"case": case, "spp": 64, "s": 1.2345, "s spread": 0.01, "by frame": "3 2 1"} for case in "ab"]
    tables.print_rows("path", rows)
    printed = capsys.readouterr().out
    assert "In all rows: spp 64." in printed and printed.count("1.23 ± 0.01") == 2 and "spread" not in printed
    assert printed.count("3 … 1 (3)") == 2 and "spp" not in printed.split("spp 64.")[1]


def test_what_is_shown_tells_names_from_numbers():
    table = records.Table("compare", "t", ("mode", "spp", "s", "says"), [["a", 1, 0.5, "x"], ["b", 2, 0.25, "y"]])
    one = tables.shown(table)
    assert one.names == ["mode", "spp"] and one.numeric == {"spp", "s"} and list(one.columns) == list(table.columns)
