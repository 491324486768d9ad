"""Reports: one self-contained HTML file with tables, plots and pictures to compare.

The page asks the network for nothing. Its parts, ``report.html``, ``report.css`` and ``report*.js``, lie beside this
module.
"""

from __future__ import annotations

import base64
import gzip
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import numpy as np

from warp_gi.bench import records
from warp_gi.bench.plots import Plot, svg
from warp_gi.cli_report import cell_text
from warp_gi.errors import OptionError
from warp_gi.files import replacing
from warp_gi.metrics import RELATIVE_EPSILON, rel_mse
from warp_gi.preview import magma

FOLDER = Path(__file__).parent
SCRIPTS = ("report_tables.js", "report_pictures.js", "report_viewer.js")
REFERENCE = "reference"
HALF_MAXIMUM = float(np.finfo(np.float16).max)


@dataclass(frozen=True)
class PictureSet:
    """Pictures of one case by several estimators, to compare with each other. ``validate`` raises OptionError."""

    case: str
    reference: np.ndarray | None
    """Linear radiance, float32 [height, width, 3]; without one there are no error maps."""
    images: Mapping[str, np.ndarray] = field(default_factory=dict)
    """Linear radiance by estimator, each of the reference's shape. May hold NaN and infinities, which are shown."""

    def all(self) -> dict[str, np.ndarray]:
        """Return the reference, if there is one, and the images."""
        return ({} if self.reference is None else {REFERENCE: self.reference}) | dict(self.images)

    def validate(self) -> None:
        """Raise OptionError unless there is a picture, and all are floats [height, width, 3] of one size."""
        if REFERENCE in self.images:
            raise OptionError(f"pictures of {self.case!r}: give the reference as such, not among the images")
        pictures = self.all()
        if not pictures:
            raise OptionError(f"pictures of {self.case!r}: there are none")
        first = next(iter(pictures.values()))
        for name, picture in pictures.items():
            is_image = picture.ndim == 3 and picture.shape[2] == 3 and picture.size and picture.dtype.kind == "f"
            if not is_image or picture.shape != first.shape:
                raise OptionError(
                    f"pictures of {self.case!r}, {name!r}: expected floats [height, width, 3] like the others'"
                    f" {list(first.shape)}, got {picture.dtype} {list(picture.shape)}"
                )


def write_report(
    path: str | Path,
    title: str,
    rows: Sequence[records.Row],
    pictures: Sequence[PictureSet] = (),
    plots: Sequence[Plot] = (),
) -> None:
    """Write a report of benchmark rows; the file appears whole or not at all.

    ``rows`` are as suites return them or as ``records.read`` reads them: those with the same keys make a table,
    "table" names it, "suite" puts it into a section; tables named "paper" hold a paper's own figures.
    Pictures are kept as half floats, so finite values beyond 65504 are shown as 65504.
    Raises OptionError for pictures or plots that cannot be drawn, OSError for a path that cannot be written.
    """
    for picture_set in pictures:
        picture_set.validate()
    sections = [_plots_section(plots), _pictures_section(pictures), *_suite_sections(rows)]
    body = "".join(section for section in sections if section) or "<p>No results.</p>"
    page = Template(_part("report.html")).substitute(
        title=escape(title),
        style=_part("report.css"),
        body=body,
        script="\n".join(_part(name) for name in SCRIPTS),
        magma=base64.b64encode(magma(np.linspace(0, 1, 256)[None]).tobytes()).decode(),
    )
    with replacing(path) as part:
        part.write_text(page, encoding="utf-8")


def _part(name: str) -> str:
    return (FOLDER / name).read_text(encoding="utf-8")


# ---- plots and tables ----


def _plots_section(plots: Sequence[Plot]) -> str:
    drawn = "".join(svg(plot) for plot in plots)
    return f'<section id="plots"><h2>Plots</h2><div class="plots">{drawn}</div></section>' if drawn else ""


def _suite_sections(rows: Sequence[records.Row]) -> list[str]:
    environments = records.environments(rows)
    plain = [
        {key: value.item() if isinstance(value, np.generic) else value for key, value in row.items()} for row in rows
    ]
    tables: dict[str, list[records.Table]] = {}
    for table in records.tables_of(plain):
        tables.setdefault(table.suite, []).append(table)
    sections = []
    for suite, group in tables.items():
        measured = "".join(
            f'<p class="environment">{escape(records.environment_text(environment))}</p>'
            for environment in environments.get(suite, [])
        )
        heading = f"<h2>{escape(suite or 'Results')}</h2>"
        sections.append(f"<section>{heading}{measured}{''.join(map(_table, group))}</section>")
    return sections


def _table(table: records.Table) -> str:
    numeric = [any(records.is_number(row[i]) for row in table.rows) for i in range(len(table.columns))]
    name = table.name or ("skipped" if "skipped" in table.columns else "")
    heading = f"<h3>{escape(name)}</h3>" if name else ""
    if table.is_quoted:
        heading += '<p class="note">The paper\'s own figures, on its hardware.</p>'
    head = "".join(_header(column, is_number) for column, is_number in zip(table.columns, numeric, strict=True))
    body = "".join(f"<tr>{''.join(map(_cell, row, numeric, range(len(row))))}</tr>" for row in table.rows)
    kind = "table quoted" if table.is_quoted else "table"
    label = escape(name or " ".join(table.columns[:3]))
    return (
        f'{heading}<div class="{kind}" tabindex="0" role="region" aria-label="table {label}">'
        f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def _header(column: str, is_number: bool) -> str:
    align = ' class="number"' if is_number else ""
    return f'<th scope="col"{align}><button type="button">{escape(column)}</button></th>'


def _cell(value: Any, is_number: bool, index: int) -> str:
    tag, scope = ("th", ' scope="row"') if index == 0 else ("td", "")
    css = ' class="number"' if is_number else ' class="long"' if len(str(value)) > 40 else ""
    exact = f' data-value="{value!r}" title="{value!r}"' if records.is_number(value) else ""
    return f"<{tag}{scope}{css}{exact}>{escape(_text(value))}</{tag}>"


def _text(value: Any) -> str:
    """Return four digits with their trailing zeros, so that columns line up; whole numbers stay whole."""
    if not isinstance(value, float) or not math.isfinite(value) or value.is_integer():
        return cell_text(value)
    return f"{value:,.0f}" if abs(value) >= 1e4 else f"{value:#.4g}".rstrip(".")


# ---- pictures ----


def _pictures_section(pictures: Sequence[PictureSet]) -> str:
    viewers = "".join(_viewer(picture_set, index) for index, picture_set in enumerate(pictures))
    return f'<section id="pictures"><h2>Pictures</h2>{viewers}</section>' if viewers else ""


def _viewer(picture_set: PictureSet, index: int) -> str:
    pictures = picture_set.all()
    height, width = next(iter(pictures.values())).shape[:2]
    facts = [_facts(name, picture, picture_set.reference) for name, picture in pictures.items()]
    about = json.dumps({"width": width, "height": height, "exposure": _exposure(pictures), "pictures": facts})
    data = "".join(
        f'<script type="application/octet-stream" class="pixels">{_packed(picture)}</script>'
        for picture in pictures.values()
    )
    return (
        f'<article class="viewer" id="viewer-{index}"><h3>{escape(picture_set.case)}</h3>'
        f'<script type="application/json" class="about">{about.replace("<", chr(92) + "u003c")}</script>{data}'
        f"{_table(_facts_table(facts))}</article>"
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
