"""Writes what the documents say of measurements: ``docs/results.md``, and the marked regions of ``README.md``.

``python -m warp_gi.bench.publish [--check]``. All of it comes from ``bench/results/*.jsonl``. A region of the README
stands between ``<!-- results: NAME -->`` and ``<!-- end -->``; ``publish_regions.REGIONS`` says what goes there.
``--check`` writes nothing, and leaves with exit code 1 if a file is not what it would write.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path

from warp_gi.bench.harness import records, runner
from warp_gi.bench.publish.figures import region_text
from warp_gi.bench.publish.page import page
from warp_gi.bench.publish.regions import REGIONS
from warp_gi.errors import GiError, OptionError, unknown_name
from warp_gi.files import replacing

ROOT = runner.FOLDER.parent
PAGE, README = Path("docs/results.md"), Path("README.md")
DEVICE = "cpu"
"""Of the figures in the README; the page has all."""
REGION = re.compile(r"(<!-- results: (?P<name>[^\n]*?) -->\n)(?P<text>.*?)(?P<end><!-- end -->|\Z)", re.DOTALL)


def readme(text: str, rows: Sequence[records.Row]) -> str:
    """Return the README's text with its regions made anew; raises OptionError for marks that cannot be filled."""

    def filled(match: re.Match[str]) -> str:
        name = match["name"]
        if not match["end"] or "<!-- results:" in match["text"]:
            raise OptionError(f"README: <!-- results: {name} --> has no <!-- end -->")
        if name not in REGIONS:
            raise unknown_name("region of results", name, REGIONS)
        return f"{match[1]}{region_text(name, REGIONS[name], rows)}\n{match['end']}"

    return REGION.sub(filled, text)


def pages(root: Path) -> dict[Path, str]:
    """Return what the documents under ``root`` should say; raises OSError or OptionError where results are missing."""
    files = sorted((root / "bench/results").glob("*.jsonl"))
    if not files:
        raise OptionError(f"{root / 'bench/results'}: no *.jsonl there; `warp-gi bench SUITE --json FILE` writes them")
    rows = records.read(files)
    for suite, found in records.environments(rows).items():
        if len({one.get("quick", False) for one in found}) > 1:
            raise OptionError(f"{root / 'bench/results'}: quick and full runs of suite {suite!r}; keep the full ones")
        on_cpu = {(one.get("cpu"), one.get("threads")) for one in found if one.get("device") == DEVICE}
        if len(on_cpu) > 1:
            raise OptionError(f"{root / 'bench/results'}: suite {suite!r} ran on several processors; keep one's")
    told = [row for row in rows if row.get("device", DEVICE) == DEVICE]
    return {PAGE: page(rows), README: readme((root / README).read_text(encoding="utf-8"), told)}


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
