"""Writes what the documents say of measurements: ``docs/results.md``, and marked regions of the other documents.

``python -m warp_gi.bench.publish [--check]``. All of it comes from ``bench/results/*.jsonl``. A region of ``README.md``
or of a page of ``docs/`` stands between ``<!-- results: NAME -->`` and ``<!-- end -->``. NAME is ``headlines``, a table
of the techniques, or a region that a suite's folder has in its ``regions.py``. ``--check`` writes nothing, and leaves
with exit code 1 if a file is not what it would write.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path

from warp_gi.bench.harness import catalogue, records
from warp_gi.bench.harness.catalogue import ROOT
from warp_gi.bench.publish.figures import Headline, Region, headlines_text, region_text
from warp_gi.bench.publish.page import page
from warp_gi.errors import GiError, OptionError, unknown_name
from warp_gi.files import replacing

PAGE, README, PAGES = Path("docs/results.md"), Path("README.md"), "docs/**/*.md"
RESULTS = "bench/results"
DEVICE = "cpu"
"""Device whose figures regions show; the tables of the page have all devices."""
HEADLINES = "headlines"
REGION = re.compile(r"(<!-- results: (?P<name>[^\n]*?) -->\n)(?P<text>.*?)(?P<end><!-- end -->|\Z)", re.DOTALL)


@lru_cache
def regions() -> dict[str, Region]:
    """Return the regions of all suites' folders, by name; raises OptionError for a name that two of them have."""
    found: dict[str, Region] = {}
    for suite, module in catalogue.modules("regions"):
        for name, region in module.REGIONS.items():
            if name in found or name == HEADLINES:
                raise OptionError(f"regions.py of suite {suite!r}: another region has the name {name!r}")
            found[name] = region
    return found


@lru_cache
def headlines() -> tuple[Headline, ...]:
    """Return the lines of the table of techniques."""
    return tuple(line for _, module in catalogue.modules("regions") for line in getattr(module, "HEADLINES", ()))


def filled(path: Path, text: str, texts: Mapping[str, str]) -> str:
    """Return a document's text with its regions made anew; raises OptionError for marks that cannot be filled."""

    def fill(match: re.Match[str]) -> str:
        name = match["name"]
        if not match["end"] or "<!-- results:" in match["text"]:
            raise OptionError(f"{path}: <!-- results: {name} --> has no <!-- end -->")
        if name not in texts:
            raise unknown_name(f"region of results in {path}:", name, texts)
        return f"{match[1]}{texts[name]}\n{match['end']}"

    return REGION.sub(fill, text)


def texts_of(rows: Sequence[records.Row]) -> dict[str, str]:
    """Return the texts of regions whose suites have results, by name; raises OptionError for a figure without value."""
    known = {row.get("suite") for row in rows}
    texts = {name: region_text(name, region, rows) for name, region in regions().items() if region.suite in known}
    return texts | {HEADLINES: headlines_text([one for one in headlines() if one.columns.suite in known], rows)}


def pages(root: Path) -> dict[Path, str]:
    """Return what the documents under ``root`` should say; raises OSError or OptionError where results are missing."""
    files = sorted((root / RESULTS).glob("*.jsonl"))
    if not files:
        raise OptionError(f"{root / RESULTS}: no *.jsonl there; `warp-gi bench SUITE --json FILE` writes them")
    rows = records.read(files)
    for suite, found in records.environments(rows).items():
        if len({one.get("quick", False) for one in found}) > 1:
            raise OptionError(f"{root / RESULTS}: quick and full runs of suite {suite!r}; keep the full ones")
        on_cpu = {(one.get("cpu"), one.get("threads")) for one in found if one.get("device") == DEVICE}
        if len(on_cpu) > 1:
            raise OptionError(f"{root / RESULTS}: suite {suite!r} ran on several processors; keep one's")
    texts = texts_of([row for row in rows if row.get("device", DEVICE) == DEVICE])
    others = [path.relative_to(root) for path in sorted(root.glob(PAGES)) if path != root / PAGE]
    short = {name: (regions()[name].introduction, text) for name, text in texts.items() if name != HEADLINES}
    documents = {path: filled(path, (root / path).read_text(encoding="utf-8"), texts) for path in (README, *others)}
    return {PAGE: page(rows, short), **documents}


def publish(root: Path, check: bool = False) -> list[Path]:
    """Write the documents that are not what they should be, or with ``check`` only find them; return their paths."""
    stale = []
    for path, text in pages(root).items():
        file = root / path
        if not file.exists() or file.read_text(encoding="utf-8") != text:
            stale.append(path)
            if not check:
                with replacing(file) as part:
                    part.write_text(text, encoding="utf-8")
    return stale


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, 1 if ``--check`` finds a file that differs, or 2 for results that cannot be used."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--check", action="store_true", help="write nothing; exit code 1 if a file differs")
    options = parser.parse_args(arguments)
    try:
        stale = publish(ROOT, options.check)
    except (GiError, OSError) as error:
        print(f"publish: error: {error}", file=sys.stderr)
        return 2
    for path in stale:
        print(f"{path}: differs; run `python -m warp_gi.bench.publish`" if options.check else f"wrote {path}")
    return int(options.check and bool(stale))


if __name__ == "__main__":
    sys.exit(main())
