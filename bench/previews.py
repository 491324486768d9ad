"""Renders pictures of places: ``python -m warp_gi.bench.previews [NAME...] [-o FOLDER] [--spp N] [--readme]``.

Each of `PLACES`, or those that are named, becomes FOLDER/NAME.png, at most 480 pixels wide, by the pipeline "path". One
whose files are missing is passed over. ``--readme`` makes the pictures that README.md shows, in their place.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness.catalogue import ROOT
from warp_gi.bench.harness.places import PLACES
from warp_gi.cli.report import start_warp
from warp_gi.errors import GiError, OptionError, unknown_name
from warp_gi.files import check_writable, replacing
from warp_gi.sequence.exr import stored_values
from warp_gi.sequence.preview import tone_map, write_png

WIDTH, SPP = 480, 64
QUALITY = 88


@dataclass(frozen=True)
class ReadmePicture:
    """A picture that README.md shows, of built-in places: one, or several side by side."""

    places: tuple[str, ...]
    """Keys in `PLACES`."""
    size: tuple[int, int]
    """Width and height of each, pixels."""
    spp: int
    frame: int = 0
    columns: int = 1
    pipeline: str = "path"
    """Preset that renders it; one that depends on frames before renders those, too."""


README_PICTURES = {
    "assets/atrium.jpg": ReadmePicture(("atrium",), (960, 540), 1, frame=23, pipeline="clean"),
    "assets/places.jpg": ReadmePicture(("street", "warehouse", "two_rooms", "sphere_row"), (240, 135), 256, columns=4),
}
"""Pictures by file."""


def render(
    name: str, size: tuple[int, int], spp: int, frame: int = 0, device: str = "cpu", preset: str = "path"
) -> np.ndarray:
    """Return a frame of a place, tone-mapped as `warp-gi render` does: uint8 [height, width, 3]."""
    place, pipeline = PLACES[name], gi.Pipeline.preset(preset, spp=spp)
    scheduler = gi.FrameScheduler(place.scene(), place.path().at_resolution(*size), pipeline, device)
    for before in range(frame if scheduler.dependence().on_past else 0):
        scheduler.frame(before)
    return tone_map(stored_values("beauty", scheduler.frame(frame).numpy("beauty")))


def preview_size(resolution: tuple[int, int]) -> tuple[int, int]:
    """Return the resolution, scaled down to at most `WIDTH` pixels across."""
    width, height = resolution
    scale = min(1.0, WIDTH / width)
    return round(width * scale), max(1, round(height * scale))


def write_previews(names: Sequence[str], folder: Path, spp: int = SPP, device: str = "cpu") -> None:
    """Write FOLDER/NAME.png of each place, and print the files; raises OptionError for an unknown name, OSError."""
    for name in names:
        if name not in PLACES:
            raise unknown_name("place", name, PLACES)
    check_writable(folder)
    for name in names:
        if PLACES[name].missing:
            print(f"{name}: skipped, {PLACES[name].missing}", flush=True)
            continue
        path = folder / f"{name}.png"
        write_png(path, render(name, preview_size(PLACES[name].path().resolution), spp, device=device))
        print(f"wrote {path}", flush=True)


def write_readme_pictures(root: Path, spp: int | None = None, device: str = "cpu") -> None:
    """Write `README_PICTURES` under a folder, and print the files; ``spp`` None is each one's own. Raises OSError."""
    for file, picture in README_PICTURES.items():
        pixels = tiled(picture if spp is None else replace(picture, spp=spp), device)
        write_jpeg(root / file, pixels)
        print(f"wrote {root / file}", flush=True)


def tiled(picture: ReadmePicture, device: str = "cpu") -> np.ndarray:
    """Return the places of a picture in rows of ``columns``, uint8 [height, width, 3]."""
    shown = (picture.size, picture.spp, picture.frame, device, picture.pipeline)
    tiles = [render(name, *shown) for name in picture.places]
    rows = [np.hstack(tiles[first : first + picture.columns]) for first in range(0, len(tiles), picture.columns)]
    return np.vstack(rows)


def write_jpeg(path: Path, pixels: np.ndarray) -> None:
    """Write uint8 [height, width, 3] as JPEG; the file appears whole or not at all. Raises OSError."""
    from PIL import Image

    with replacing(path) as part:
        Image.fromarray(pixels).save(part, format="JPEG", quality=QUALITY)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 for names or settings that cannot be used."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"all by default: {', '.join(PLACES)}")
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="default: out/previews")
    parser.add_argument("--spp", type=int, metavar="N", help=f"samples a pixel; {SPP}, or as README_PICTURES says")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--readme", action="store_true", help="make the pictures of README.md instead")
    options = parser.parse_args(arguments)
    try:
        if options.readme and (options.names or options.output):
            raise OptionError("--readme makes the files of README.md, all of them: leave out names and --output")
        start_warp(options.device)
        if options.readme:
            write_readme_pictures(ROOT, options.spp, options.device)
        else:
            spp = SPP if options.spp is None else options.spp
            write_previews(options.names or list(PLACES), options.output or Path("out/previews"), spp, options.device)
    except (GiError, OSError) as error:
        print(f"previews: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
