"""Surface caches in scenes: sheets with holes, scenes of any size, and published ones beside paths."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import statistics_tools as st
from scene_tools import card, light, quad
from statistics_tools import every_device  # noqa: F401
from truth_tools import closed_box, scene_of

import warp_gi as gi
from warp_gi.bench.harness.path_views import black_share
from warp_gi.bench.suites.cache.views import CASES, CacheCase

TRACED = gi.Pipeline(environment=None, emitters=None, indirect=gi.BsdfPaths(), camera_samples=1)
REAL = [case for case in CASES if case.place in ("living_room_white", "modern_hall", "sponza_courtyard", "sponza")]


def ending(cache: gi.SurfaceCache) -> gi.Pipeline:
    return replace(TRACED, indirect=gi.BsdfPaths(ends_in=cache))


def indirect(scene: gi.Scene, camera: gi.Camera, pipeline: gi.Pipeline, spp: int, bakes=(), seed: int = 5):
    frame = next(gi.render(scene, camera, replace(pipeline, spp=spp), [0], st.device().alias, seed, bakes=bakes))
    return frame.numpy("indirect").astype(np.float64)


# ---- sheets with holes ----


def leaves(opaque: bool = False) -> gi.Material:
    """Return a red material of which every second texel of a fine checker is a hole; on the wall it leaves half."""
    there = np.indices((64, 64)).sum(axis=0) % 2 == 0
    pixels = np.full((64, 64, 4), 255, np.uint8)
    pixels[..., 3] = np.where(there | opaque, 255, 0)
    texture = gi.Texture("leaves", pixels)
    return gi.Material("leaves", (0.6, 0.1, 0.1), specular=0.0, base_color_texture=texture, alpha_cutoff=0.5)


def alley(*sheet: gi.Mesh) -> gi.Scene:
    """Return a lamp at z = 2, which lights towards a wall at z = -1, a floor, and what stands between them."""
    lamp = replace(card(half=0.3, material=light((20.0, 20.0, 20.0))), name="lamp")
    lamp.points = (lamp.points * (1, 1, -1) + (0, 0, 2)).astype(np.float32)
    lamp.indices = lamp.indices[:, ::-1].copy()  # its front to the wall
    wall = card(z=-1.0, half=1.5, material=gi.Material("wall", (0.7, 0.7, 0.7), specular=0.0))
    floor = quad((-1.5, -1, 2), (3, 0, 0), (0, 0, -3), wall.material, "floor")
    return scene_of(lamp, wall, floor, *sheet)


VIEWS = gi.CameraPath.from_cameras(
    [
        gi.Camera.look_at((1.2, 0.4, 1.5), (0, 0, 0), hfov=50, resolution=(24, 18)),  # the sheet from the lamp's side
        gi.Camera.look_at((1.4, 0.3, -0.55), (0, 0, -0.1), hfov=50, resolution=(24, 18)),  # its back
        gi.Camera.look_at((1.4, 0.3, -0.3), (0, 0, -1), hfov=50, resolution=(24, 18)),  # the wall
    ]
)
LEAFY = gi.SurfaceCache(paths=60_000, cell=0.08)


def irradiance_at(bake: gi.Bake, z: float, side: int) -> float:
    """Return the mean irradiance over samples of the smallest cells at a height z that look to a side: 4 +z, 5 -z."""
    keys, rows = bake.arrays["keys"], bake.arrays["cells"].astype(np.float64)
    cell = int((z - bake.arrays["low"][2]) / bake.arrays["side"][0])
    here = (keys >> np.uint64(7) & np.uint64((1 << 19) - 1)) == cell
    here &= (keys >> np.uint64(4) & np.uint64(7)) == side
    here &= (keys & np.uint64(15)) == 1
    assert here.any()
    return float((rows[here, :3].mean(axis=1) * rows[here, 3]).sum() / rows[here, 3].sum())


def test_light_passes_the_holes_of_a_sheet_and_each_side_keeps_its_own():
    """Half of the sheet is holes: half of the light reaches the wall, and the back is lit by the wall alone."""
    found = {}
    for name, sheet in {
        "none": [],
        "holes": [card(material=leaves())],
        "opaque": [card(material=leaves(True))],
    }.items():
        scene = alley(*sheet)
        found[name] = gi.bake(scene, LEAFY, st.device().alias, camera_path=VIEWS)
        if name == "holes":
            for time, camera in enumerate(map(VIEWS.camera, range(3))):
                truth = indirect(scene, camera, TRACED, 1024, seed=9 + time)
                cached = indirect(scene, camera, ending(LEAFY), 64, [found[name]])
                assert cached.mean() == pytest.approx(truth.mean(), rel=0.04), time
    none, holes, opaque = (irradiance_at(found[name], -1.0, 4) for name in ("none", "holes", "opaque"))
    assert opaque < 0.25 * none and 0.45 * (none - opaque) < holes - opaque < 0.57 * (none - opaque)
    front, back = (irradiance_at(found["holes"], 0.0, side) for side in (4, 5))
    assert back < 0.25 * front
    assert irradiance_at(found["opaque"], 0.0, 5) < 0.5 * back


# ---- scenes of any size ----


def test_a_scene_of_any_size_gives_the_same_picture():
    """Cells go by the scene and by the distance from the camera, so a doll's house looks as a city does."""
    pictures = []
    for scale in (1.0, 1e-3, 1e3):
        box = [replace(mesh, points=mesh.points * np.float32(scale)) for mesh in closed_box(0.6, 0.0)]
        for number, mesh in enumerate(box):
            mesh.material = replace(mesh.material, emission=(2.0 if number == 1 else 0.0,) * 3)
        block = card(half=0.4)
        block.points = ((block.points + np.array([0.2, -0.5, -0.4])) * scale).astype(np.float32)
        scene = scene_of(*box, block)
        eye, target = np.array([0.3, 0.1, 0.8]) * scale, np.array([-0.2, -0.3, -0.6]) * scale
        camera = gi.Camera.look_at(eye, target, hfov=90, resolution=(24, 24))
        cache = gi.SurfaceCache(paths=20_000)
        bake = gi.bake(scene, cache, st.device().alias, camera_path=camera)
        pictures.append(indirect(scene, camera, ending(cache), 64, [bake]))
    tiles = [picture.reshape(4, 6, 4, 6, 3).mean(axis=(1, 3, 4)) for picture in pictures]
    for other in tiles[1:]:
        assert other.mean() == pytest.approx(tiles[0].mean(), rel=0.01)
        np.testing.assert_allclose(other, tiles[0], rtol=0.05)


# ---- published scenes ----


@pytest.mark.slow
@pytest.mark.parametrize("case", REAL, ids=lambda case: case.place)
def test_indirect_light_is_that_of_paths(case: CacheCase):
    """The mean of the term is right at default settings, and nothing is black that paths light."""
    if case.missing:
        pytest.skip(case.missing)
    scene, camera = case.scene(), case.camera().at_resolution(160, 90)
    truth = indirect(scene, camera, TRACED, 512, seed=9)
    image = indirect(scene, camera, ending(gi.SurfaceCache()), 64)
    assert abs(image.mean() / truth.mean() - 1) < case.within
    assert black_share(image, truth) == 0
