"""Renders the picture of light maps on the page of surface caches: ``python -m warp_gi.bench.light_map_pictures``.

It becomes assets/light_map.jpg: the map of the built-in two rooms, and both rooms by albedo times the map, beside the
path tracer's pictures.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import warp_gi as gi
from warp_gi.bench.harness.catalogue import ROOT
from warp_gi.bench.harness.places import PLACES
from warp_gi.bench.previews import write_jpeg
from warp_gi.bench.transfer_pictures import SIZE, Row, drawn, rendered
from warp_gi.cli.report import start_warp
from warp_gi.errors import GiError
from warp_gi.files import check_writable
from warp_gi.scheduler import FrameScheduler
from warp_gi.techniques.surface_cache.light_map import LightMap, LightMapSettings, bake_light_map

ROOMS = {"two_rooms": "the lit room", "two_rooms_dark": "the dark room"}
SETTINGS = LightMapSettings(resolution=768, samples=128)
CACHE = gi.SurfaceCache(cell=0.05)
REFERENCE_SAMPLES = 128
CAMERA_RAYS = 16
"""Rays a pixel of a view by the map."""


def shaded(scene: gi.Scene, camera: gi.Camera, light_map: LightMap, device: str) -> np.ndarray:
    """Return a view in which matt surfaces send albedo / pi of the map's irradiance, float32 [height, width, 3]."""
    total = np.zeros((SIZE[1] * SIZE[0], 3))
    nothing = gi.Pipeline(environment=None, emitters=None, indirect=None, spp=1, camera_samples=1)
    for seed in range(CAMERA_RAYS):
        frame = FrameScheduler(scene, camera, nothing, device, seed).frame(0)
        face, u, v = (getattr(frame.hits, name).numpy() for name in ("face", "u", "v"))
        hit = np.flatnonzero(face >= 0)
        albedo, emission = (frame.numpy(name).reshape(-1, 3) for name in ("albedo", "emission"))
        total += emission
        total[hit] += albedo[hit] * light_map.at(face[hit], u[hit], v[hit]) / math.pi
    return (total / CAMERA_RAYS).reshape(SIZE[1], SIZE[0], 3).astype(np.float32)


def page_of(light_map: LightMap) -> np.ndarray:
    """Return the map over pi in the size of a picture, every so many texels of it."""
    image = light_map.image()
    step = -(-image.shape[0] // SIZE[1])
    page = np.zeros((SIZE[1], SIZE[0], 3), np.float32)
    small = image[::step, ::step] / np.float32(math.pi)
    page[: small.shape[0], : small.shape[1]] = small
    return page


def rows(device: str) -> list[Row]:
    """Return the map and a room by it, beside the path tracer, for each room."""
    scene = gi.builtin_scene("two_rooms")
    cameras = [PLACES[name].camera().at_resolution(*SIZE) for name in ROOMS]
    path = gi.CameraPath.from_cameras(cameras, times=[0.0, 1.0])
    light_map = bake_light_map(scene, gi.bake(scene, CACHE, device, camera=path), CACHE, SETTINGS, device)
    result: list[Row] = []
    for camera, name in zip(cameras, ROOMS.values(), strict=True):
        traced = rendered(scene, camera, gi.Pipeline(spp=REFERENCE_SAMPLES), device)
        seen = shaded(scene, camera, light_map, device)
        result.append(
            [(f"light map, for {name}", page_of(light_map)), ("albedo times light map", seen), ("paths", traced)]
        )
    return result


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return 0, or 2 for settings that cannot be used."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", type=Path, metavar="FOLDER", help="default: assets", default=ROOT / "assets")
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args(arguments)
    try:
        check_writable(options.output)
        start_warp(options.device)
        path = options.output / "light_map.jpg"
        write_jpeg(path, drawn(rows(options.device)))
        print(f"wrote {path}", flush=True)
    except (GiError, OSError) as error:
        print(f"light_map_pictures: error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
