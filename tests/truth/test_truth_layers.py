"""Every preset on small rooms with a blended surface and with windows: their pictures have the path tracer's mean."""

from functools import cache

import numpy as np
import pytest
from test_truth_blend import ROOM_VIEW, glazed_room, veiled_room

import warp_gi as gi

ROOMS = {"veiled": veiled_room, "glazed": glazed_room}
PRESETS = ["path", "dvf", "cache", "clean", "probes", "reuse", "hybrid"]
SLOW = ["transfer"]


@cache
def truth(room):
    frame = next(gi.render(ROOMS[room](), ROOM_VIEW, gi.Pipeline(spp=1024, camera_samples=256)))
    return frame.numpy("beauty")


@pytest.mark.parametrize("room", ROOMS)
@pytest.mark.parametrize("name", [*PRESETS, *(pytest.param(name, marks=pytest.mark.slow) for name in SLOW)])
def test_presets_agree_about_coverage_and_glass(name, room):
    frames = gi.render(ROOMS[room](), gi.CameraPath.still(ROOM_VIEW), gi.Pipeline.preset(name), frames=range(10))
    got = np.mean([frame.numpy("beauty") for frame in list(frames)[2:]], axis=0)
    whole, middle = slice(None), (slice(6, 12), slice(8, 16))
    for part, most in ((whole, 0.04), (middle, 0.08)):
        expected = truth(room)[part].mean(axis=(0, 1))
        np.testing.assert_allclose(got[part].mean(axis=(0, 1)), expected, rtol=most)
