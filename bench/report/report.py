"""Reports: one self-contained HTML file with tables, plots and pictures to compare.

The page asks the network for nothing. Its parts, ``report.html``, ``report.css`` and ``report*.js``, lie beside this
module.
"""

from __future__ import annotations

import base64
import gzip
import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from warp_gi.bench.harness import records
from warp_gi.bench.harness.gallery import REFERENCE, PictureSet
from warp_gi.bench.report import tables as report_tables
from warp_gi.bench.report.plots import Plot, svg
from warp_gi.files import replacing
from warp_gi.metrics import RELATIVE_EPSILON, rel_mse
from warp_gi.sequence.preview import magma

FOLDER = Path(__file__).parent
SCRIPTS = ("report_tables.js", "report_pictures.js", "report_viewer.js")
HALF_MAXIMUM = float(np.finfo(np.float16).max)


def write_report(
    path: str | Path,
    title: str,
    rows: Sequence[records.Row],
    pictures: Sequence[PictureSet] = (),
    plots: Sequence[Plot] = (),
) -> None:
    """Write a report of benchmark rows; the file appears whole or not at all.

    ``rows`` are as suites return them or as ``records.read`` reads them: those with the same keys make a table,
    "table" names it, "suite" puts it into a section, with the pictures and plots of that suite; tables named "paper"
    hold a paper's own figures.
    Pictures are kept as half floats, so finite values beyond 65504 are shown as 65504.
    Raises OptionError for pictures or plots that cannot be drawn, OSError for a path that cannot be written.
    """
    for picture_set in pictures:
        picture_set.validate()
    sections = _sections(rows, pictures, plots)
    body = _links(list(sections)) + "".join(sections.values())
    page = Template(_part("report.html")).substitute(
        title=escape(title),
        style=_part("report.css"),
        body=body or "<p>No results.</p>",
        script="\n".join(_part(name) for name in SCRIPTS),
        magma=base64.b64encode(magma(np.linspace(0, 1, 256)[None]).tobytes()).decode(),
    )
    with replacing(path) as part:
        part.write_text(page, encoding="utf-8")


def _part(name: str) -> str:
    return (FOLDER / name).read_text(encoding="utf-8")


# ---- sections ----


def _sections(rows: Sequence[records.Row], pictures: Sequence[PictureSet], plots: Sequence[Plot]) -> dict[str, str]:
    """Return the section of each suite, in the order of their rows; what belongs to none comes first."""
    plain = [
        {key: value.item() if isinstance(value, np.generic) else value for key, value in row.items()} for row in rows
    ]
    tables, environments = records.tables_of(plain), records.environments(rows)
    named = [*(one.suite for one in tables), *(one.suite for one in pictures), *(one.suite for one in plots)]
    suites = dict.fromkeys(named)
    return {
        suite: _section(
            suite,
            [f'<p class="environment">{escape(records.environment_text(e))}</p>' for e in environments.get(suite, [])],
            _plots([plot for plot in plots if plot.suite == suite]),
            _viewers([one for one in pictures if one.suite == suite]),
            report_tables.tables_html([table for table in tables if table.suite == suite]),
        )
        for suite in sorted(suites, key=bool)
    }


def _section(suite: str, environments: Sequence[str], plots: str, pictures: str, tables: str) -> str:
    heading = f"<h2>{escape(suite or 'Results')}</h2>"
    return f'<section id="{_anchor(suite)}">{heading}{"".join(environments)}{plots}{pictures}{tables}</section>'


def _links(suites: Sequence[str]) -> str:
    """Return links to the sections, if there are several."""
    if len(suites) < 2:
        return ""
    links = "".join(f'<a href="#{_anchor(suite)}">{escape(suite or "Results")}</a>' for suite in suites)
    return f'<nav aria-label="suites">{links}</nav>'


def _anchor(suite: str) -> str:
    return "suite-" + re.sub(r"\W+", "-", suite)


def _plots(plots: Sequence[Plot]) -> str:
    drawn = "".join(svg(plot) for plot in plots)
    return f'<div class="plots">{drawn}</div>' if drawn else ""


# ---- pictures ----


def _viewers(pictures: Sequence[PictureSet]) -> str:
    """Return the pictures, folded but for the first of several."""
    if not pictures:
        return ""
    folded = "".join(
        f'<details class="case"{" open" * (index == 0)}><summary>{escape(one.case)}</summary>{_viewer(one)}</details>'
        for index, one in enumerate(pictures)
    )
    return f"<h3>Pictures</h3>{folded}"


def _viewer(picture_set: PictureSet) -> str:
    pictures = picture_set.all()
    height, width = next(iter(pictures.values())).shape[:2]
    facts = [_facts(name, picture, picture_set.reference) for name, picture in pictures.items()]
    about = json.dumps({"width": width, "height": height, "exposure": _exposure(pictures), "pictures": facts})
    data = "".join(
        f'<script type="application/octet-stream" class="pixels">{_packed(picture)}</script>'
        for picture in pictures.values()
    )
    note = escape(f": {picture_set.note}" if picture_set.note else "")
    return (
        f'<article class="viewer"><p class="note">{width} x {height} pixels{note}</p>'
        f'<script type="application/json" class="about">{about.replace("<", chr(92) + "u003c")}</script>{data}'
        f"{report_tables.table_html(_facts_table(facts))}</article>"
    )


def _facts(name: str, picture: np.ndarray, reference: np.ndarray | None) -> dict[str, Any]:
    """Return name, error and bad pixels; the error is over pixels that are finite in both."""
    facts: dict[str, Any] = {"name": name, "nan": _pixels(np.isnan(picture)), "infinite": _pixels(np.isinf(picture))}
    if reference is None or name == REFERENCE:
        return facts | {"relMSE": None}
    good = (np.isfinite(picture) & np.isfinite(reference)).all(axis=2)
    error = rel_mse(picture[good][None], reference[good][None], RELATIVE_EPSILON) if good.any() else math.nan
    return facts | {"relMSE": error if math.isfinite(error) else None}


def _exposure(pictures: Mapping[str, np.ndarray]) -> float:
    """Return the stops, in quarters, that bring all but the brightest twentieth of the first picture below white."""
    first = next(iter(pictures.values()))
    values = first[np.isfinite(first).all(axis=2)]
    bright = float(np.percentile(values.max(axis=1), 95)) if len(values) else 0.0
    return min(max(math.floor(-4 * math.log2(bright)) / 4, -8.0), 8.0) if bright > 0 else 0.0


def _pixels(bad: np.ndarray) -> int:
    return int(np.count_nonzero(bad.any(axis=2)))


def _facts_table(facts: Iterable[dict[str, Any]]) -> records.Table:
    columns = ("picture", "relMSE of finite pixels", "NaN pixels", "infinite pixels")
    rows = [[fact["name"], fact["relMSE"], fact["nan"], fact["infinite"]] for fact in facts]
    return records.Table("", "", columns, rows)


def _packed(picture: np.ndarray) -> str:
    """Return half floats, little-endian, red, green and blue of each pixel, zipped, in base64."""
    finite = np.isfinite(picture)
    halves = np.where(finite, np.clip(picture, -HALF_MAXIMUM, HALF_MAXIMUM), picture).astype("<f2")
    return base64.b64encode(gzip.compress(halves.tobytes(), 6, mtime=0)).decode()
