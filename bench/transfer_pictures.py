"""Renders pictures of docs/techniques/radiance_transfer.md: ``python -m warp_gi.bench.transfer_pictures [NAME...]``.

Each of `SHEETS`, or those that are named, becomes assets/transfer_NAME.jpg: pictures of transfer textures at a limit of
theirs, beside the path tracer's. Skies and the living room are files in WARP_GI_SCENES; sheets whose files are missing
are passed over.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness.catalogue import ROOT
from warp_gi.bench.harness.court import band_limited, court, court_camera
from warp_gi.bench.harness.places import PLACES, missing
from warp_gi.bench.harness.scenes import LIVING_ROOM, SCENES
from warp_gi.bench.previews import write_jpeg
from warp_gi.cli.report import start_warp
from warp_gi.errors import GiError, unknown_name
from warp_gi.files import check_writable
from warp_gi.sequence.preview import tone_map
from warp_gi.techniques.shared.legends import exposure_of, label_font

SIZE = (320, 214)
"""Width and height of a picture, pixels."""
TEXELS = 512
SAMPLES = 16
REFERENCE_SAMPLES = 512
GAP = 4
"""Pixels between pictures."""
LABEL = 24
"""Pixels of a label above a picture."""

Row = list[tuple[str, np.ndarray]]
"""Pictures with their labels: linear radiance, float32 [height, width, 3]. The last one sets the exposure."""


@dataclass(frozen=True)
class Sheet:
    """Pictures in rows."""

    rows: Callable[[str], list[Row]]
    """Renders them on a device."""
    files: tuple[str, ...]
    """Files in `scenes.SCENES` that it reads."""


@cache
def sky(name: str) -> gi.Environment:
    """Return a sky of the scene files."""
    return gi.Environment.load(SCENES / "environments" / f"{name}.exr")


def rendered(scene: gi.Scene, camera: gi.Camera, pipeline: gi.Pipeline, device: str, **more: Any) -> np.ndarray:
    """Return all light of a view."""
    return next(gi.render(scene, camera, pipeline, device=device, **more)).numpy("beauty")


def by_paths(scene: gi.Scene, device: str, camera: gi.Camera | None = None, direct: bool = False) -> np.ndarray:
    """Return the path tracer's picture; ``direct`` leaves out light over other surfaces."""
    pipeline = gi.Pipeline(spp=REFERENCE_SAMPLES)
    return rendered(
        scene, camera or court_camera(SIZE), replace(pipeline, indirect=None) if direct else pipeline, device
    )


def metal(environment: gi.Environment, roughness: float) -> gi.Scene:
    """Return the court in metal."""
    scene = court(environment, specular=1.0, roughness=roughness)
    for material in scene.materials:
        material.metallic = 1.0
    return scene


class Baked:
    """A scene with its bake."""

    def __init__(self, scene: gi.Scene, device: str, camera: gi.Camera | None = None, **settings: Any) -> None:
        self.scene, self.device = scene, device
        self.camera = camera or court_camera(SIZE)
        self.settings = {"resolution": TEXELS, **settings}
        self.bake = gi.bake(scene, gi.RadianceTransfer(**self.settings), device)

    def picture(
        self, environment: gi.Environment | None = None, direct: bool = False, ends_in: bool = False, **settings: Any
    ) -> np.ndarray:
        """Return a picture by transfer.

        Args:
            environment: Another sky.
            direct: Leave out light over other surfaces.
            ends_in: Trace the sky's light, and a first bounce that ends in the textures.
            settings: Settings of RadianceTransfer that are not those of the bake.
        """
        if environment is not None:
            self.scene.environment = environment
        here, over = (gi.RadianceTransfer(**self.settings, **settings, term=t) for t in ("environment", "indirect"))
        pipeline = gi.Pipeline(environment=here, indirect=None if direct else over, spp=SAMPLES)
        if ends_in:
            paths = gi.BsdfPaths(ends_in=over)
            pipeline = gi.Pipeline(indirect=paths, spp=SAMPLES)
        return rendered(self.scene, self.camera, pipeline, self.device, bakes=[self.bake])


def turned(device: str) -> list[Row]:
    """Return a matt court under a sky at three angles, by one bake, above the path tracer's pictures."""
    scene = court(sky("courtyard"))
    baked = Baked(scene, device)
    top, bottom = [], []
    for degrees in (0, 120, 240):
        top.append((f"transfer, sky turned by {degrees}°", baked.picture(sky("courtyard").rotated(degrees))))
        bottom.append(("paths", by_paths(scene, device)))
    return [top, bottom]


def glossy(device: str) -> list[Row]:
    """Return forms of the sky's glossy light at two roughnesses, beside the path tracer."""
    rows = []
    for roughness in (0.7, 0.45):
        scene = metal(sky("courtyard"), roughness)
        baked = Baked(scene, device)
        row = [
            (f"{form}, roughness {roughness}", baked.picture(glossy=form, direct=True))
            for form in ("transfer", "ratio")
        ]
        row.append((f"traced, {SAMPLES} rays", baked.picture(glossy="traced", direct=True)))
        rows.append([*row, ("paths", by_paths(scene, device, direct=True))])
    return rows


def orders(device: str) -> list[Row]:
    """Return transfer of 25 and of 36 numbers on glossy surfaces under a sky of 25, beside the path tracer."""
    scene = metal(band_limited(sky("courtyard")), 0.5)
    row = [
        (f"order {order}", Baked(scene, device, order=order).picture(glossy="transfer", sun=0.0, direct=True))
        for order in (5, 6)
    ]
    return [[*row, ("paths", by_paths(scene, device, direct=True))]]


def vertices(device: str) -> list[Row]:
    """Return the court's floor by transfer at vertices and in texels, beside the path tracer."""
    light = band_limited(sky("courtyard"))
    row = []
    for cells in (1, 16):
        baked = Baked(court(light, floor=cells), device, storage="vertices")
        row.append((f"vertices, floor {cells} x {cells}", baked.picture(sun=0.0)))
    scene = court(light)
    row.append(("texture 256", Baked(scene, device, resolution=256).picture(sun=0.0)))
    return [[*row, ("paths", by_paths(scene, device))]]


def sun(device: str) -> list[Row]:
    """Return a sunny sky in harmonics alone, and with the sun apart, beside the path tracer."""
    scene = court(sky("city"))
    baked = Baked(scene, device)
    row = [("sun in the harmonics", baked.picture(sun=0.0)), ("sun apart", baked.picture())]
    return [[*row, ("paths", by_paths(scene, device))]]


def losses(device: str) -> list[Row]:
    """Return a sky of a few lamps, an interior, and reflections of other surfaces, beside the path tracer."""
    scene = court(sky("studio"))
    baked = Baked(scene, device)
    studio = [("few lamps, in the harmonics", baked.picture(sun=0.0)), ("few lamps, apart", baked.picture())]
    studio.append(("paths", by_paths(scene, device)))
    place = PLACES["living_room_white"]
    room, camera = place.scene(), place.path().at_resolution(*SIZE).camera(0)
    interior: Row = []
    for resolution in (512, 1024):
        baked = Baked(room, device, camera, resolution=resolution)
        interior.append((f"interior, texture {resolution}", baked.picture()))
    interior.append(("paths", by_paths(room, device, camera)))
    scene = metal(sky("courtyard"), 0.5)
    baked = Baked(scene, device)
    mirrored = [("reflections, ratio", baked.picture()), ("paths that end in it", baked.picture(ends_in=True))]
    mirrored.append(("paths", by_paths(scene, device)))
    return [studio, interior, mirrored]


_COURTYARD = ("environments/courtyard.exr",)
SHEETS = {
    "sky": Sheet(turned, _COURTYARD),
    "glossy": Sheet(glossy, _COURTYARD),
    "orders": Sheet(orders, _COURTYARD),
    "vertices": Sheet(vertices, _COURTYARD),
    "sun": Sheet(sun, ("environments/city.exr",)),
    "losses": Sheet(losses, ("environments/studio.exr", LIVING_ROOM, *_COURTYARD)),
}
"""Sheets by name."""


def drawn(rows: list[Row]) -> np.ndarray:
    """Return rows of pictures of one size with their labels, each row in the exposure of its last.

    The sheet is uint8 [height, width, 3].
    """
    from PIL import Image, ImageDraw

    height, width = rows[0][0][1].shape[:2]
    across, down = width + GAP, height + LABEL
    sheet = Image.new("RGB", (across * max(map(len, rows)) - GAP, down * len(rows)), (255, 255, 255))
    draw = ImageDraw.Draw(sheet)
    for i, row in enumerate(rows):
        exposure = exposure_of(row[-1][1])
        for j, (label, picture) in enumerate(row):
            draw.text((across * j + 2, down * i + 2), label, fill=(0, 0, 0), font=label_font(15))
            sheet.paste(Image.fromarray(tone_map(picture, exposure)), (across * j, down * i + LABEL))
    return np.asarray(sheet)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 for names or settings that cannot be used."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"all by default: {', '.join(SHEETS)}")
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="default: assets", default=ROOT / "assets")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args(arguments)
    try:
        for name in options.names:
            if name not in SHEETS:
                raise unknown_name("picture", name, SHEETS)
        check_writable(options.output)
        start_warp(options.device)
        for name in options.names or SHEETS:
            if absent := missing(SHEETS[name].files):
                print(f"{name}: skipped, {absent}", flush=True)
                continue
            path = options.output / f"transfer_{name}.jpg"
            write_jpeg(path, drawn(SHEETS[name].rows(options.device)))
            print(f"wrote {path}", flush=True)
    except (GiError, OSError) as error:
        print(f"transfer_pictures: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
