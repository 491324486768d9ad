"""Every preset on small rooms with a blended surface and with windows: their pictures have the path tracer's mean."""

from functools import cache

import numpy as np
import pytest
from test_truth_blend import ROOM_VIEW, glazed_room, veiled_room

import warp_gi as gi

AMBER = (0.9, 0.6, 0.3)
ROOMS = {"veiled": veiled_room, "glazed": glazed_room, "tinted": lambda: glazed_room(AMBER, 1.0)}
PRESETS = ["path", "dvf", "cache", "clean", "probes", "reuse", "hybrid"]
SLOW = ["transfer"]


@cache
def truth(room):
    frame = next(gi.render(ROOMS[room](), ROOM_VIEW, gi.Pipeline(spp=1024, camera_samples=256)))
    return frame.numpy("beauty")


@pytest.mark.parametrize("room", ["veiled", "glazed"])
@pytest.mark.parametrize("name", [*PRESETS, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)])
def test_presets_agree_about_coverage_and_glass(name, room):
    middle = (slice(6, 12), slice(8, 16))
    assert_like_the_path_tracer(name, room, ((slice(None), 0.04), (middle, 0.08)))


@pytest.mark.parametrize("name", ["reuse", "clean", pytest.param("cache", marks=pytest.mark.slow)])
def test_presets_agree_about_coloured_glass(name):
    """Both the window and the pane are amber: the light of the room has their colour."""
    color = truth("tinted").mean(axis=(0, 1)) / truth("glazed").mean(axis=(0, 1))
    assert color[0] > 1.5 * color[1] and color[1] > 1.5 * color[2]
    floor = slice(10, None)  # where denoisers must not take the tint of the pane's light to what is beside it
    assert_like_the_path_tracer(name, "tinted", ((slice(1, 9), 0.04), (floor, 0.04)), spp=4, camera_samples=4)


def assert_like_the_path_tracer(name, room, parts, **settings):
    pipeline = gi.Pipeline.preset(name, **settings)
    frames = gi.render(ROOMS[room](), gi.CameraPath.still(ROOM_VIEW), pipeline, frames=range(10))
    got = np.mean([frame.numpy("beauty") for frame in list(frames)[2:]], axis=0)
    for part, most in parts:
        expected = truth(room)[part].mean(axis=(0, 1))
        np.testing.assert_allclose(got[part].mean(axis=(0, 1)), expected, rtol=most)
