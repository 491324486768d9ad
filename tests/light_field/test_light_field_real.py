"""Light field probes at default settings in published and built-in scenes, beside paths: means and black pixels."""

from __future__ import annotations

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.bench.harness import scenes

COURTYARD, WHITE = scenes.SCENES / "environments" / "courtyard.exr", (1.0, 1.0, 1.0)
NAVE, GALLERY, FLOOR = (
    gi.Camera.look_at(eye, target, hfov=65.0)
    for eye, target in (
        ((-11, 1.5, -0.3), (5, 4, 0)),
        ((-9, 6.2, 4.6), (6, 3, -3)),
        ((8, 0.4, -0.8), (-6, 0.2, 1.5)),
    )
)
VIEWS = {  # scene, its sky, camera, how far the mean may be off
    "atrium": ("atrium", None, None, 0.12),
    "two_rooms": ("two_rooms", None, None, 0.08),
    "living_room": ("living_room/living_room.obj", WHITE, gi.Camera.look_at((0, 1, 4), (0.5, 1.2, 0), hfov=60), 0.08),
    "hall": ("modern_hall.glb", None, gi.Camera.look_at((4, 1.7, 2), (-3, 1.6, -0.5), hfov=60), 0.08),
    "sponza": ("crytek_sponza.glb", COURTYARD, NAVE, 0.12),
    "sponza_white": ("crytek_sponza.glb", WHITE, NAVE, 0.12),
    "gallery": ("crytek_sponza.glb", COURTYARD, GALLERY, 0.12),
    "gallery_white": ("crytek_sponza.glb", WHITE, GALLERY, 0.12),
    "floor": ("crytek_sponza.glb", COURTYARD, FLOOR, 0.12),
    "floor_white": ("crytek_sponza.glb", WHITE, FLOOR, 0.12),
}


def view_of(name: str) -> tuple[gi.Scene, gi.Camera]:
    source, sky, camera, _ = VIEWS[name]
    if camera is None:
        return gi.builtin_scene(source), gi.builtin_camera_path(source).camera(0)
    for file in (scenes.SCENES / source, sky):
        if not isinstance(file, tuple | None) and not file.exists():
            pytest.skip(f"{file} is not there; set WARP_GI_SCENES")
    scene = gi.load_scene(scenes.SCENES / source)
    if sky is not None:
        scene.environment = sky
    return scene, camera


@pytest.mark.slow
@pytest.mark.parametrize("name", VIEWS)
def test_indirect_light_is_that_of_paths(name):
    """The mean of the term is right in the default mode, and nothing is black that paths light."""
    scene, camera = view_of(name)
    camera = camera.at_resolution(96, 54)

    def term(estimator: gi.LightFieldProbes | gi.BsdfPaths, spp: int, seed: int = 0) -> np.ndarray:
        pipeline = gi.Pipeline(environment=None, emitters=None, indirect=estimator, spp=spp, camera_samples=1)
        return next(gi.render(scene, camera, pipeline, seed=seed)).numpy("indirect")

    image, truth = term(gi.LightFieldProbes(), 16), term(gi.BsdfPaths(), 1024, 9)
    assert abs(image.mean() / truth.mean() - 1) < VIEWS[name][-1]
    assert (image.max(axis=-1) > 0)[truth.max(axis=-1) > 0.05 * truth.mean()].all()
