"""Renders the picture of docs/techniques/surface_cache.md: ``python -m warp_gi.bench.cache_pictures``.

It becomes assets/surface_cache.jpg. Whole frames of as many samples by paths and by paths that end in a surface cache,
beside many samples of paths. Places whose files in WARP_GI_SCENES are missing are passed over.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import warp_gi as gi
from warp_gi.bench.harness.catalogue import ROOT
from warp_gi.bench.harness.places import PLACES
from warp_gi.bench.previews import write_jpeg
from warp_gi.bench.transfer_pictures import Row, drawn, rendered
from warp_gi.cli.report import start_warp
from warp_gi.errors import GiError

SHOWN = ("atrium", "modern_hall", "sponza_courtyard")
"""Keys in `PLACES`."""
SIZE = (240, 136)
"""Width and height of a picture, pixels."""
SAMPLES, REFERENCE_SAMPLES = 64, 512
FILE = Path("assets/surface_cache.jpg")


def row_of(name: str, size: tuple[int, int], samples: int, reference_samples: int, device: str) -> Row:
    """Return the pictures of a place: by paths and by the cache with ``samples`` a pixel, and by many paths."""
    place = PLACES[name]
    scene, camera = place.scene(), place.camera().at_resolution(*size)
    row: Row = []
    for preset, spp in (("path", samples), ("cache", samples), ("path", reference_samples)):
        picture = rendered(scene, camera, gi.Pipeline.preset(preset, spp=spp), device, seed=len(row))
        row.append((f"{place.title}: {preset}, {spp}", picture))
    return row


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 for settings that cannot be used."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, metavar="FILE", default=ROOT / FILE, help=f"default: {FILE}")
    parser.add_argument("--samples", type=int, metavar="N", default=SAMPLES)
    parser.add_argument("--reference-samples", type=int, metavar="N", default=REFERENCE_SAMPLES)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args(arguments)
    try:
        start_warp(options.device)
        rows: list[Row] = []
        for name in SHOWN:
            if absent := PLACES[name].missing:
                print(f"{name}: skipped, {absent}", flush=True)
                continue
            rows.append(row_of(name, SIZE, options.samples, options.reference_samples, options.device))
        write_jpeg(options.output, drawn(rows))
        print(f"wrote {options.output}", flush=True)
    except (GiError, OSError) as error:
        print(f"cache_pictures: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
