"""Reports: what the file says, and what a browser without a network shows and does with it."""

from __future__ import annotations

import dataclasses
import itertools
import json
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from browser_tools import missing, opened_page, started_browser

import warp_gi as gi
from warp_gi.bench.harness import records
from warp_gi.bench.report import report
from warp_gi.bench.report import suite_plots as report_plots
from warp_gi.bench.report import tables as report_tables
from warp_gi.bench.report.plots import Plot, svg
from warp_gi.cli import main as cli
from warp_gi.color import decode_srgb
from warp_gi.sequence.preview import magma, tone_map

HEIGHT, WIDTH = 24, 40
WRONG = (30, 6)
"""x and y of the one wrong pixel."""
ENVIRONMENT = {"quick": False, "commit": "0123abc", "cpu": "Some CPU", "cores": 2, "threads": 2, "device": "cpu"}
ROWS = [
    {"suite": "speed", **ENVIRONMENT, "table": "times", "case": f"case {i}", "seconds": s, "many": 1.0, "more": 2.0}
    for i, s in enumerate((0.5, 9.25e-5, 100.125))
] + [
    {"suite": "speed", **ENVIRONMENT, "table": "times: paper, RTX", "case": "theirs", "seconds": 3.0},
    {"suite": "other", **ENVIRONMENT, "case": "<b>bold</b>", "skipped": "no scene & no </script> either"},
]
SERIES = " ".join(f"{9 / (i + 1):.2f}" for i in range(30))
LONG = [
    {"suite": "long", **ENVIRONMENT, "table": "over frames", "frame of a sequence": f"a frame of number {i}"}
    | {f"column {k}": 1.0 + k for k in range(9)}
    | {"wall s": w, "wall s spread": 0.05}
    for i, w in enumerate([9.0, 12345.0, 6.1, *np.arange(20.0, 48.0)])
] + [{"suite": "long", **ENVIRONMENT, "table": "learning", "case": "a", "MSE by frame": SERIES}]


def pictures():
    rng = np.random.default_rng(5)
    reference = rng.uniform(0.05, 0.4, (HEIGHT, WIDTH, 3)).astype(np.float32)
    wrong, broken = reference.copy(), reference * 0.5
    wrong[WRONG[1], WRONG[0]] += 1.0
    broken[2, 3] = np.nan
    broken[4, 5:7, 1] = np.inf
    broken[8, 9] = 1e6  # no half float, and yet finite
    return report.PictureSet("room <1>", reference, {"wrong": wrong, "broken": broken})


def plot(**settings):
    x = np.array([1.0, 10.0, 100.0])
    return Plot("error <over> time", "s", "relMSE", {"ours & more": (x, 2.0 * x**-0.5)}, **settings)


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "report.html"
    report.write_report(path, "Title <i> & more", ROWS, [pictures()], [plot(log_x=True, log_y=True, fit=True)])
    return path


# ---- the file ----


class Cells(HTMLParser):
    """Tables of a page, as lists of rows of texts; and all values of attributes that may load something."""

    def __init__(self, text):
        super().__init__()
        self.tables, self.loads, self.tags, self._open = [], [], set(), False
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        self.tags.add(tag)
        self.loads += [value for name, value in attributes if name in ("src", "href", "srcset", "action", "data")]
        if tag == "table":
            self.tables.append([])
        elif tag == "tr":
            self.tables[-1].append([])
        elif tag in ("td", "th"):
            self.tables[-1][-1].append("")
        self._open = tag in ("td", "th", "button") or (self._open and tag not in ("table", "tr"))

    def handle_endtag(self, tag):
        self._open = self._open and tag not in ("td", "th")

    def handle_data(self, data):
        if self._open and self.tables:
            self.tables[-1][-1][-1] += data


def test_the_file_stands_alone(written):
    text = written.read_text(encoding="utf-8")
    page = Cells(text)
    assert [value for value in page.loads if not value.startswith(("data:", "#"))] == []
    assert not re.search(r"url\(|@import|https?://", text)
    assert "link" in page.tags and not page.tags & {"b", "i", "over"}  # the icon is seen; names are escaped
    assert "$" not in re.sub(r"\$\{|<script>.*?</script>", "", text, flags=re.DOTALL)  # no placeholder was left


def test_tables_of_suites(written):
    tables = Cells(written.read_text(encoding="utf-8")).tables
    assert tables[1] == [
        ["case", "seconds", "many", "more"],
        ["case 0", "0.5000", "1", "2"],
        ["case 1", "9.250e-05", "1", "2"],
        ["case 2", "100.1", "1", "2"],
    ]
    assert tables[2] == [["case", "seconds"], ["theirs", "3"]]
    assert tables[3] == [["case", "skipped"], ["<b>bold</b>", "no scene & no </script> either"]]
    text = written.read_text(encoding="utf-8")
    assert text.count('class="table quoted"') == 1 and text.index("times: paper") < text.index('class="table quoted"')
    assert text.count("commit 0123abc, Some CPU, 2 cores, 2 threads, device cpu") == 2


def test_bad_pixels_are_counted_and_left_out_of_the_error(written):
    facts, broken = Cells(written.read_text(encoding="utf-8")).tables[0], pictures()
    assert facts[1] == ["reference", "", "0", "0"]
    assert facts[3][2:] == ["1", "2"]
    good = np.isfinite(broken.images["broken"]).all(axis=2)
    a, r = broken.images["broken"][good].astype(np.float64), broken.reference[good].astype(np.float64)
    assert float(facts[3][1].replace(",", "")) == pytest.approx(np.mean((a - r) ** 2 / (r**2 + 0.01)), rel=1e-3)


def test_what_cannot_be_drawn_leaves_no_file(tmp_path):
    good = np.zeros((2, 3, 3), np.float32)
    path = tmp_path / "r.html"
    for bad in (good[:, :, 0], good[:1], good.astype(np.uint8)):
        with pytest.raises(gi.OptionError, match="'b': expected floats"):
            report.write_report(path, "", [], [report.PictureSet("x", good, {"b": bad})])
    with pytest.raises(gi.OptionError, match="there are none"):
        report.write_report(path, "", [], [report.PictureSet("x", None)])
    with pytest.raises(gi.OptionError, match="give the reference as such"):
        report.write_report(path, "", [], [report.PictureSet("x", None, {"reference": good})])
    with pytest.raises(gi.OptionError, match="2 x but 1 y"):
        report.write_report(path, "", [], plots=[Plot("p", "", "", {"a": ([1, 2], [1])})])
    assert list(tmp_path.iterdir()) == []


def html_of(tmp_path, rows, pictures=(), plots=()):
    report.write_report(tmp_path / "r.html", "r", rows, pictures, plots)
    return (tmp_path / "r.html").read_text(encoding="utf-8")


def test_spreads_stand_beside_their_values(tmp_path):
    text = html_of(tmp_path, LONG)
    (head, *rows), _ = Cells(text).tables
    assert head[-1] == "wall s" and "spread" not in "".join(head)
    assert [row[-1] for row in rows[:3]] == ["9.00 ± 0.05", "12,345 ± 0", "6.10 ± 0.05"]
    assert 'data-value="6.1" title="6.1 ± 0.05"' in text
    alone = html_of(tmp_path, [{"wall s spread": 0.5, "wall s": 2.0}, {"wall s spread": None, "wall s": 3.0}])
    assert Cells(alone).tables == [[["wall s"], ["2.0 ± 0.5"], ["3"]]]
    alone = html_of(tmp_path, [{"wall s": 2.5, "wall s spread": float("nan")}])
    assert Cells(alone).tables == [[["wall s"], ["2.500"]]]
    alone = html_of(tmp_path, [{"case": "a", "angle spread": 0.5}])  # a spread of nothing is a column
    assert Cells(alone).tables == [[["case", "angle spread"], ["a", "0.5000"]]]


def test_long_tables_are_folded(tmp_path):
    text = html_of(tmp_path, LONG)
    assert text.count("<details") == 1 and "<summary>31 rows</summary>" in text
    assert "<details" not in html_of(tmp_path, LONG[1:])


def test_numbers_in_words_are_drawn(tmp_path):
    text = html_of(tmp_path, LONG)
    cell = re.search(r'<td class="series">(.*?)</td>', text)[1]
    points = [tuple(map(float, point.split(","))) for point in re.search(r'points="([^"]*)"', cell)[1].split()]
    assert len(points) == 30 and points[0] == (2, 2) and points[-1] == (118, 20)  # from the highest to the lowest
    assert re.sub(r"<svg.*</svg>", "", cell).split() == ["9", "0.3000"] and SERIES in cell
    for words in ("1 2 3", "first 1 2 3 4 5 6", "1-2 3-4 5-6 7-8 9-10 11-12", "12"):
        assert report_tables.series_of(words) is None
    assert report_tables.series_of(" 1 2e-3 3 4 5 -6 ") == [1, 0.002, 3, 4, 5, -6]


def test_a_papers_figures_stand_beside_ours(tmp_path):
    rows = [{"table": "times", "case": "ours", "s": 1.0}, {"table": "memory", "MB": 2.0}]
    rows += [{"table": "times: paper, RTX 3080", "case": "theirs", "s": 9.0}]
    text = html_of(tmp_path, rows)
    beside = re.search(r'<div class="beside">(.*)', text)[1]
    assert beside.index("ours") < beside.index("Quoted from the paper (RTX 3080), not measured here.")
    assert [table[1][0] for table in Cells(text).tables] == ["ours", "theirs", "2"]


def test_pictures_and_plots_stand_with_their_suite(tmp_path):
    shown = [dataclasses.replace(pictures(), suite=suite, note="means of <2>") for suite in ("other", "other", "speed")]
    text = html_of(tmp_path, ROWS, shown, [plot(suite="speed")])
    sections = dict(re.findall(r"<section [^>]*><h2>(.*?)</h2>(.*?)</section>", text, re.DOTALL))
    assert list(sections) == ["speed", "other"]
    assert [section.count('class="viewer"') for section in sections.values()] == [1, 2]
    assert [section.count("<figure") for section in sections.values()] == [1, 0]
    assert sections["other"].count('<details class="case" open>') == 1  # the first
    assert sections["other"].count(f"{WIDTH} x {HEIGHT} pixels: means of &lt;2&gt;") == 2
    targets = re.findall(r'<a href="#(.*?)"', text)
    assert len(targets) == 2 and all(f'<section id="{target}">' in text for target in targets)


# ---- plots ----


def test_a_plot_is_to_scale():
    drawn = svg(plot(log_x=True, log_y=True, fit=True))
    marks = re.findall(r'translate\(([\d.]+) ([\d.]+)\)"><title>([^<]*)', drawn)
    x, y = np.array([[float(a), float(b)] for a, b, _ in marks]).T
    assert x[1] - x[0] == pytest.approx(x[2] - x[1], abs=0.2) and x[0] < x[1]  # decades
    assert y[1] - y[0] == pytest.approx(y[2] - y[1], abs=0.2) and y[0] < y[1]  # a power law falls in a line
    assert marks[2][2] == "ours &amp; more\ns: 100\nrelMSE: 0.2"
    assert "x<sup>-0.50</sup>" in drawn
    ticks = {float(text): float(at) for at, text in re.findall(r'"x tick" x="([\d.]+)"[^>]*>([^<]+)', drawn)}
    assert ticks[10.0] == pytest.approx(x[1], abs=0.1)


def test_points_that_cannot_be_placed_are_told():
    y = [0.0, 1.0, np.nan, np.inf, 2.0]
    assert "3 points are not shown" in svg(Plot("p", "x", "y", {"a": (range(5), y)}, log_y=True))
    assert "2 points are not shown" in svg(Plot("p", "x", "y", {"a": (range(5), y)}))
    assert "no points" in svg(Plot("p", "x", "y", {"a": ([1.0], [np.nan])}))
    with pytest.raises(gi.OptionError, match="needs log_x and log_y"):
        svg(plot(log_x=True, fit=True))


@pytest.mark.parametrize("values", [[3.0], [0.0, 0.0], [1e-9, 1e9], [-5.0, 7.0], [1e6, 3e6], [0.97, 0.98]])
@pytest.mark.parametrize("log", [False, True])
def test_axes_have_ticks_and_hold_their_points(values, log):
    drawn = svg(Plot("p", "x", "y", {"a": (values, values)}, log_x=log, log_y=log))
    if log and max(values) <= 0:
        assert "no points" in drawn
        return
    ticks = re.findall(r'class="[xy] tick"[^>]*>([^<]+)', drawn)
    assert 4 <= len(ticks) <= 20 and all(np.isfinite(float(text)) for text in ticks)
    for x, y in re.findall(r'class="mark s0"[^>]*translate\(([\d.]+) ([\d.]+)\)"><title', drawn):
        assert 66 <= float(x) <= 506 and 12 <= float(y) <= 290


def test_series_differ_without_their_colours():
    lines = {str(i): ([0, 1], [i, i]) for i in range(8)}
    drawn = svg(Plot("p", "x", "y", lines))
    looks = re.findall(r'<li>.*?stroke-dasharray="([^"]*)".*?d="([^"]*)"', drawn)
    assert len(set(looks)) == len(looks) == 8


def test_plots_of_rows():
    rows = [
        {"table": "rays", "scene": s, "triangles": t, "rays": "diffuse", "query": q, "ours Mrays/s": 10.0 / t}
        for s, t in (("big", 1000), ("small", 10))
        for q in ("any", "closest")
    ]
    others = [{"scene": "gone", "skipped": "no file"}, rows[0] | {"query": "once"}]  # a point is no line
    (drawn,) = report_plots.plots_of("rays", [*rows, *others])
    assert drawn.series == {f"diffuse, {q}": ((10.0, 1000.0), (1.0, 0.01)) for q in ("any", "closest")}
    frames = {"table": "adaptation", "case": "mine", "term": "indirect", "MSE / settled by frame": "3 2 1"}
    (drawn,) = report_plots.plots_of("reuse", [frames])
    assert drawn.series == {"mine, indirect": ((0.0, 1.0, 2.0), (3.0, 2.0, 1.0))}
    assert report_plots.plots_of("rays", []) == report_plots.plots_of("none of ours", rows) == []


# ---- the command ----


def write_lines(path, rows):
    from warp_gi.bench.harness import runner

    runner.write_json_lines(path, "rays", rows, False, "cpu")
    return path


def test_report_of_results_files_runs_nothing(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("warp_gi.bench.harness.runner.run_suite", None)
    rows = [{"table": "rays", "triangles": t, "rays": "diffuse", "query": "any", "ours Mrays/s": 1.0} for t in (10, 20)]
    files = [str(write_lines(tmp_path / name, rows)) for name in ("a.jsonl", "b.jsonl")]
    assert cli.main(["bench", "--report", *files, "--html", str(tmp_path / "r.html")]) == 0
    assert "r.html" in capsys.readouterr().out
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert len(Cells(text).tables[0]) == 5 and "Rays a second over triangles" in text


def test_what_two_machines_measured_stands_apart(tmp_path):
    row = {"suite": "rays", "table": "rays", "rays": "diffuse", "query": "any", "triangles": 10, "ours Mrays/s": 1.0}
    small = ENVIRONMENT | {"commit": "4567def"}  # another commit on the same machine
    rows = [row | ENVIRONMENT, row | small | {"triangles": 20}]
    rows += [row | ENVIRONMENT | {"cpu": "Other CPU", "triangles": count} for count in (10, 20)]
    rows += [{"suite": "path", **ENVIRONMENT, "case": "alone"}]
    files = [tmp_path / name for name in ("a.jsonl", "b.jsonl")]
    for file, part in zip(files, (rows[:2], rows[2:]), strict=True):
        file.write_text("".join(json.dumps(one) + "\n" for one in part), encoding="utf-8")
    assert cli.main(["bench", "--report", *map(str, files), "--html", str(tmp_path / "r.html")]) == 0
    text = (tmp_path / "r.html").read_text(encoding="utf-8")
    headings = re.findall("<h2>(.*?)</h2>", text)
    assert headings == ["rays, machine 1", "rays, machine 2", "path"] and "<title>warp_gi: rays, path</title>" in text
    assert [len(table) for table in Cells(text).tables] == [3, 3, 2]
    first, second, _ = text.split("<h2>")[1:]
    for part, machine, commits in ((first, "Some CPU", 2), (second, "Other CPU", 1)):
        assert "Rays a second over triangles" in part and part.count(machine) == commits
    assert records.machines_apart(rows[:2]) == rows[:2]
    assert [one["suite"] for one in records.machines_apart([{"cpu": "A"}, {"cpu": "B"}])] == ["machine 1", "machine 2"]


def test_a_suite_writes_its_report(tmp_path, monkeypatch, capsys):
    def run(quick, device, gallery):
        gallery.add(report.PictureSet("a room", np.ones((4, 5, 3))))
        return [{"scene": "one", "wall s": 2.0}]

    monkeypatch.setattr("warp_gi.bench.suites.rays.suite.run", run)
    page, lines = tmp_path / "new" / "r.html", tmp_path / "r.jsonl"
    assert cli.main(["bench", "rays", "--quick", "--html", str(page), "--json", str(lines)]) == 0
    text = page.read_text(encoding="utf-8")
    assert Cells(text).tables[1] == [["scene", "wall s"], ["one", "2"]] and "quick run, not for quoting" in text
    assert "a room" in text.partition("<h2>rays</h2>")[2] and Cells(text).tables[2][0][:2] == ["wall s", "cpu s"]
    assert records.read([lines])[0]["wall s"] == 2.0


BAD = [
    (["--report", "none.jsonl", "--html", "r.html"], "none.jsonl: No such file"),
    (["--report", "text.jsonl", "--html", "r.html"], "text.jsonl, line 2: not JSON"),
    (["--report", "list.jsonl", "--html", "r.html"], "list.jsonl, line 1: expected a JSON object, got list"),
    (["--report", "empty.jsonl", "--html", "r.html"], "empty.jsonl: no results"),
    (["--report", "good.jsonl"], "--report needs --html FILE"),
    (["rays", "--html", "r.html", "--report", "good.jsonl"], "--report runs nothing"),
    (["--html", "r.html"], "give a SUITE"),
    (["--report", "good.jsonl", "--html", "."], "is a folder"),
    (["--report", "good.jsonl", "--html", "good.jsonl/r.html"], "good.jsonl"),
    (["--tolerance", "0.1"], "--tolerance is for --diff"),
    (["rays", "--quick", "--html", "good.jsonl/r.html"], "good.jsonl"),
    (["--diff", "good.jsonl"], "--diff"),
    (["--diff", "good.jsonl", "none.jsonl"], "none.jsonl: No such file"),
    (["--diff", "good.jsonl", "text.jsonl"], "line 2: not JSON"),
    (["--diff", "good.jsonl", "good.jsonl", "--html", "r.html"], "goes with --tolerance alone"),
    (["--diff", "good.jsonl", "good.jsonl", "--tolerance", "-1"], "--tolerance: expected a share"),
    (["--diff", "good.jsonl", "other.jsonl"], "no row of other.jsonl is in good.jsonl"),
]


@pytest.mark.parametrize("arguments, words", BAD, ids=[" ".join(a) for a, _ in BAD])
def test_mistakes_are_one_line(arguments, words, tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("warp_gi.bench.harness.runner.run_suite", None)  # it is told before anything runs
    texts = {"text": '{"a": 1}\nwords', "list": "[1, 2]", "empty": "\n\n", "good": '{"a": 1}', "other": '{"b": "c"}'}
    for name, text in texts.items():
        Path(f"{name}.jsonl").write_text(text)
    assert cli.main(["bench", *arguments]) == 2
    error = capfd.readouterr().err
    assert error.startswith("warp-gi: error: ") and error.count("\n") == 1 and words in error
    assert len(list(tmp_path.iterdir())) == len(texts)


# ---- in a browser ----


def test_a_required_browser_is_no_reason_to_skip(monkeypatch):
    monkeypatch.setenv("WARP_GI_BROWSER", "required")
    with pytest.raises(pytest.fail.Exception, match="no driver"):
        missing("no driver")
    monkeypatch.delenv("WARP_GI_BROWSER")
    with pytest.raises(pytest.skip.Exception, match="no driver"):
        missing("no driver")


@pytest.fixture(scope="module")
def browser():
    with started_browser() as started:
        yield started


@pytest.fixture
def page(browser, written):
    """The report at 1280 pixels."""
    with opened_page(browser, written) as opened:
        opened.locator(".viewer").scroll_into_view_if_needed()
        opened.wait_for_selector(".viewer[data-ready]", timeout=10000)
        set_exposure(opened, 0)
        yield opened


def set_exposure(page, stops):
    page.eval_on_selector(".exposure", "(e, v) => { e.value = v; e.dispatchEvent(new Event('input')) }", stops)


def shown(page, selector=".stage canvas"):
    """What a canvas shows, uint8 [height, width, 3]."""
    size = page.eval_on_selector(selector, "c => [c.height, c.width]")
    read = """c => {
        const copy = new OffscreenCanvas(c.width, c.height).getContext("2d", { willReadFrequently: true });
        copy.drawImage(c, 0, 0);
        return Array.from(copy.getImageData(0, 0, c.width, c.height).data);
    }"""
    return np.array(page.eval_on_selector(selector, read), np.uint8).reshape(*size, 4)[:, :, :3]


def choose(page, left, right):
    page.select_option(".choose-left", label=left)
    page.select_option(".choose-right", label=right)


def hover(page, x, y):
    box = page.locator(".stage canvas").bounding_box()
    page.mouse.move(box["x"] + (x + 0.5) / WIDTH * box["width"], box["y"] + (y + 0.5) / HEIGHT * box["height"])


def half(image):
    return image.astype(np.float16).astype(np.float64)


def test_tone_mapping_is_that_of_previews(page):
    choose(page, "reference", "reference")
    reference = half(pictures().reference)
    coded = np.where(reference <= 0.0031308, 12.92 * reference, 1.055 * reference ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(shown(page), coded * 255, atol=0.6)
    page.select_option(".curve", "filmic")
    set_exposure(page, 1.5)
    assert np.abs(shown(page).astype(int) - tone_map(reference, 1.5)).max() <= 1


def test_exposure_doubles_the_light(page):
    choose(page, "reference", "reference")
    before = decode_srgb(shown(page) / 255.0)
    set_exposure(page, 1)
    after, lit = decode_srgb(shown(page) / 255.0), before > 0.1
    assert lit.mean() > 0.5
    np.testing.assert_allclose(after[lit], 2 * before[lit], rtol=0.05)
    assert page.inner_text(".controls output") == "+1 EV"
    page.click(".controls button")
    start = page.eval_on_selector(".exposure", "e => Number(e.value)")
    bright = np.percentile(pictures().reference.max(axis=2), 95) * 2.0**start
    assert 0.8 < bright <= 1.0


def test_the_slider_wipes_between_two_pictures(page):
    images = pictures()
    choose(page, "reference", "broken")
    left = shown(page)[12]
    handle, box = page.locator(".wipe"), page.locator(".stage canvas").bounding_box()
    start = handle.bounding_box()
    page.mouse.move(start["x"] + start["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.75 * box["width"], box["y"] + box["height"] / 2)
    page.mouse.up()
    tone = shown(page)[12]
    assert (tone[:20] == left[:20]).all() and (tone[20:30] != left[20:30]).any(axis=1).all()
    assert (tone[30:] == left[30:]).all()
    assert handle.get_attribute("aria-valuenow") == "75" and "reference" in handle.get_attribute("aria-valuetext")
    light = decode_srgb(tone / 255.0)
    np.testing.assert_allclose(light[:30], images.reference[12, :30], atol=0.01)
    np.testing.assert_allclose(light[30:], images.images["broken"][12, 30:], atol=0.01)
    for key, value in (("ArrowLeft", 74), ("PageDown", 64), ("Home", 0), ("ArrowLeft", 0), ("End", 100)):
        page.keyboard.press(key)
        assert handle.get_attribute("aria-valuenow") == str(value)
    assert (shown(page)[12, 30:] != tone[30:]).any()


def test_the_heat_map_shows_the_wrong_pixel_at_its_place(page):
    assert not page.is_visible(".key .bar")
    choose(page, "error of wrong", "error of wrong")
    assert page.is_visible(".key .bar") and "(a − r)²" in page.inner_text(".key .bar")
    heat, (x, y) = shown(page), WRONG
    assert (heat[y, x] > 0).any()
    heat[y, x] = 0
    assert heat.sum() == 0
    r = half(pictures().reference[y, x])
    error = np.mean((half(pictures().images["wrong"][y, x]) - r) ** 2 / (r**2 + 0.01))
    share = (np.log10(error) + 4) / 5
    hover(page, x, y)
    assert float(page.inner_text(".value-left")) == pytest.approx(error, rel=1e-3)
    expected = magma(np.array([[round(255 * share) / 255]]))[0, 0]
    np.testing.assert_array_equal(shown(page)[y, x], expected)


def test_bad_pixels_are_loud(page):
    for name in ("broken", "error of broken"):
        choose(page, name, name)
        image = shown(page)
        assert (image[2, 3] == [0, 255, 0]).all() and (image[4, 5:7] == [0, 255, 255]).all()
        loud = (image == [0, 255, 0]).all(axis=2) | (image == [0, 255, 255]).all(axis=2)
        assert loud.sum() == 3  # not where a value is large
    choose(page, "broken", "error of broken")
    hover(page, 3, 2)
    assert page.inner_text(".value-left") == "NaN NaN NaN" and page.inner_text(".value-right") == "NaN"
    hover(page, 5, 4)
    assert "Infinity" in page.inner_text(".value-left") and page.inner_text(".value-right") == "Infinity"


def test_the_magnifier_shows_what_is_under_the_pointer(page):
    choose(page, "wrong", "reference")
    x, y = WRONG
    hover(page, x, y)
    images = pictures()
    for side, image in (("left", images.images["wrong"]), ("right", images.reference)):
        values = [float(text) for text in page.inner_text(f".value-{side}").split()]
        np.testing.assert_allclose(values, half(image[y, x]), rtol=1e-3)
    assert f"pixel {x}, {y}" in page.inner_text(".where")
    patch, edge = shown(page, ".patch-left")[3::12, 3::12], 7 - y
    assert patch.shape == (15, 15, 3) and (patch[7, 7] == 255).all()
    light = decode_srgb(patch[edge:, : 7 + WIDTH - x] / 255.0)
    expected = np.minimum(images.images["wrong"][: y + 8, x - 7 :][: light.shape[0], : light.shape[1]], 1.0)
    np.testing.assert_allclose(light, expected[:, :15], atol=0.01)
    assert (patch[:edge] == 0).all()  # above the picture
    page.focus(".stage canvas")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowUp")
    assert f"pixel {x + 1}, {y - 1}" in page.inner_text(".where")


def test_a_click_on_a_header_sorts(page):
    table = page.locator("table", has_text="seconds").first
    column = lambda: table.locator("tbody tr").evaluate_all("rows => rows.map(row => row.cells[0].textContent)")  # noqa: E731
    assert column() == ["case 0", "case 1", "case 2"]
    button = table.locator("thead button", has_text="seconds")
    button.click()
    assert column() == ["case 1", "case 0", "case 2"]  # as numbers: as words 9.25e-05 would not come first
    button.click()
    assert column() == ["case 2", "case 0", "case 1"]
    assert table.locator("thead th").nth(1).get_attribute("aria-sort") == "descending"


def test_it_is_readable_at_both_widths_in_light_and_dark(page):
    size_of = "t => parseFloat(getComputedStyle(t).fontSize)"
    for width, scheme in itertools.product((1280, 400), ("light", "dark")):
        page.set_viewport_size({"width": width, "height": 900})
        page.emulate_media(color_scheme=scheme)
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), (width, scheme)
        colours = [page.evaluate(f"getComputedStyle(document.body).{name}") for name in ("color", "backgroundColor")]
        ink, paper = (np.mean([int(n) for n in re.findall(r"\d+", colour)[:3]]) for colour in colours)
        assert (ink < 60 and paper > 200) if scheme == "light" else (ink > 200 and paper < 60)
        shrunk = page.eval_on_selector(".plot > svg", "s => s.getBoundingClientRect().width / s.viewBox.baseVal.width")
        assert page.eval_on_selector(".plot .tick", size_of) * shrunk >= 10.5
        assert page.eval_on_selector("tbody td", size_of) >= 12


def test_wide_tables_scroll_within_themselves(page):
    page.set_viewport_size({"width": 300, "height": 900})
    scroller = page.locator(".table", has_text="seconds").first
    first = scroller.locator("tbody th").first
    scroller.evaluate("e => { e.querySelector('table').style.width = '900px'; e.scrollLeft = 200 }")
    assert scroller.evaluate("e => e.scrollLeft") == 200
    assert first.bounding_box()["x"] == pytest.approx(scroller.bounding_box()["x"], abs=2)  # it stays in view
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


@pytest.fixture(scope="module")
def long_report(tmp_path_factory):
    """A report of several suites: a long and wide table, series, a paper's figures, three sets of pictures."""
    path = tmp_path_factory.mktemp("long") / "report.html"
    shown = [
        dataclasses.replace(pictures(), suite="long", case=f"room {i}, at the middle of a long day") for i in range(3)
    ]
    report.write_report(path, "Long", [*LONG, *ROWS], shown, [plot(suite="long")])
    return path


def test_nothing_overflows_a_narrow_page(browser, long_report):
    with opened_page(browser, long_report, 400) as page:
        for summary in page.locator("summary").all():
            if not summary.evaluate("s => s.parentNode.open"):
                summary.click()
        page.locator(".viewer[data-ready]").nth(2).wait_for()
        assert page.evaluate("document.scrollingElement.scrollWidth") <= 400
        scroller = page.locator(".fold .table")
        assert scroller.evaluate("e => e.scrollWidth > e.clientWidth && e.getBoundingClientRect().right <= 400")
        scroller.evaluate("e => { e.scrollLeft = 150 }")
        first = scroller.locator("tbody th").first.bounding_box()
        assert first["x"] == pytest.approx(scroller.bounding_box()["x"], abs=2) and 90 < first["width"] < 200
        outside = "e => !e.closest('.table') && e.getBoundingClientRect().right > 400.5"
        assert page.evaluate(f"Array.from(document.querySelectorAll('main *')).filter({outside}).length") == 0


def test_pictures_are_unpacked_when_they_are_opened(browser, long_report):
    with opened_page(browser, long_report) as page:
        page.wait_for_selector(".viewer[data-ready]")
        ready = "Array.from(document.querySelectorAll('.viewer'), v => 'ready' in v.dataset)"
        page.wait_for_timeout(200)
        assert page.evaluate(ready) == [True, False, False]
        page.locator(".case > summary").nth(1).click()
        page.locator(".viewer[data-ready]").nth(1).wait_for()
        assert page.evaluate(ready) == [True, True, False]


def test_folded_tables_open_and_sort_by_the_value_of_a_spread(browser, long_report):
    with opened_page(browser, long_report) as page:
        table = page.locator(".fold table")
        assert not table.is_visible()
        page.locator(".fold > summary").click()
        table.locator("thead button", has_text="wall s").click()
        shown = table.locator("tbody tr").evaluate_all("rows => rows.map(row => row.cells[10].textContent)")
        assert shown[:2] == ["6.10 ± 0.05", "9.00 ± 0.05"]
        assert shown[-1] == "12,345 ± 0"  # as words it would come before 20.00


def test_a_papers_table_looks_different(browser, long_report):
    with opened_page(browser, long_report) as page:
        look = """e => [getComputedStyle(e).borderTopStyle,
            getComputedStyle(e.querySelector("tbody th")).backgroundColor]"""
        both = [page.locator(f".beside .table{kind}") for kind in (":not(.quoted)", ".quoted")]
        (line, paper), (their_line, their_paper) = (table.evaluate(look) for table in both)
        assert (line, their_line) == ("solid", "dashed") and paper != their_paper
        ours, theirs = (table.bounding_box() for table in both)
        assert theirs["x"] > ours["x"] + ours["width"]  # side by side
