"""Renders the picture of light maps on the page of surface caches: ``python -m warp_gi.bench.light_map_pictures``.

It becomes assets/light_map.jpg: the map of the Cornell box, its charts, and two views by it beside the path tracer's.
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
from warp_gi.bench.previews import write_jpeg
from warp_gi.bench.transfer_pictures import SIZE, Row, drawn, rendered
from warp_gi.cli.report import start_warp
from warp_gi.errors import GiError
from warp_gi.files import check_writable
from warp_gi.scheduler import FrameScheduler
from warp_gi.techniques.surface_cache.light_map import LightMap, LightMapSettings, bake_light_map

SETTINGS = LightMapSettings(resolution=256, samples=256)
CACHE = gi.SurfaceCache()
REFERENCE_SAMPLES = 64
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


def page_of(image: np.ndarray) -> np.ndarray:
    """Return an image of texels in the size of a picture, each pixel of it the nearest texel."""
    height, width = image.shape[:2]
    texels = max(width / SIZE[0], height / SIZE[1])  # a pixel
    y, x = (((np.arange(size) + 0.5) * texels).astype(int) for size in reversed(SIZE))
    inside = (y < height)[:, None] & (x < width)
    page = image[np.minimum(y, height - 1)[:, None], np.minimum(x, width - 1)]
    return np.where(inside[..., None], page, np.float32(0))


def chart_colors(light_map: LightMap) -> np.ndarray:
    """Return the charts of a light map in colours of their own, float32 [height, width, 3]."""
    slots, atlas = light_map.atlas.slots[0].reshape(light_map.size[::-1]), light_map.atlas
    charts = atlas.charts[atlas.slot_faces[np.maximum(slots, 0)]]
    colors = np.random.default_rng(5).random((int(charts.max()) + 1, 3), np.float32)
    return np.where((slots >= 0)[..., None], 0.4 * colors[charts], np.float32(0))


def rows(device: str) -> list[Row]:
    """Return the map and its charts, and two views by it beside the path tracer's."""
    scene = gi.builtin_scene("cornell_box")
    cameras = [gi.builtin_camera_path("cornell_box").camera(0).at_resolution(*SIZE)]
    cameras.append(gi.Camera.look_at((0.85, 1.7, 0.9), (-0.3, 0.4, -0.6), hfov=75, resolution=SIZE))
    path = gi.CameraPath.from_cameras(cameras, times=[0.0, 1.0])
    light_map = bake_light_map(scene, gi.bake(scene, CACHE, device, camera=path), CACHE, SETTINGS, device)
    pages = {"light map": light_map.image() / np.float32(math.pi), "its charts": chart_colors(light_map)}
    result: list[Row] = []
    for camera, (name, page) in zip(cameras, pages.items(), strict=True):
        traced = rendered(scene, camera, gi.Pipeline(spp=REFERENCE_SAMPLES), device)
        seen = shaded(scene, camera, light_map, device)
        result.append([(name, page_of(page)), ("albedo times light map", seen), ("paths", traced)])
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
