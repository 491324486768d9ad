"""Emission textures as lights under every technique: the light is that of the reference, also where lights move."""

import numpy as np
import pytest
from emission_tools import floor, image, panel, reflected

import warp_gi as gi

CLAMP = ("clamp", "clamp")


def quad(corners, color):
    material = gi.Material("wall", color, specular=0.0)
    return gi.Mesh(np.array(corners, np.float32), np.array([[0, 1, 2], [0, 2, 3]]), material)


@pytest.fixture(scope="module")
def scene():
    wall = quad([[-1.5, 0, -0.6], [1.5, 0, -0.6], [1.5, 2, -0.6], [-1.5, 2, -0.6]], (0.7, 0.6, 0.5))
    low = np.eye(4)
    low[:3, 3] = 0.3, -0.3, 0.9
    nodes = [
        gi.Node("floor", [floor(1.5)]),
        gi.Node("wall", [wall]),
        gi.Node("sign", [panel(image("sparse"), wrap=CLAMP, emission=100.0)]),
        gi.Node("lamp", [panel(image("texel"), wrap=CLAMP, emission=2000.0)], parent_from_node=low),
    ]
    return gi.Scene(nodes, environment=0.05)


CAMERA = gi.Camera.look_at((0.9, 0.5, 1.9), (0, 0.2, 0), resolution=(48, 32))


def reflected_light(scene, pipeline, frames):
    """Return means of what is reflected in eighths of the picture, [frame, eighth, 3]."""
    found = []
    for frame in gi.render(scene, CAMERA, pipeline, frames=range(frames)):
        light = frame.numpy("beauty").astype(np.float64) - frame.numpy("emission")
        found.append(light.reshape(2, 16, 4, 12, 3).mean(axis=(1, 3)).reshape(8, 3))
    return np.array(found)


@pytest.fixture(scope="module")
def reference(scene):
    return reflected_light(scene, gi.Pipeline.preset("path", spp=512), 2)


@pytest.mark.parametrize(
    "preset",
    ["path", "reuse", "clean"]
    + [pytest.param(name, marks=pytest.mark.slow) for name in ("cache", "dvf", "hybrid", "probes", "transfer")],
)
def test_means_are_those_of_paths(preset, scene, reference):
    light = reflected_light(scene, gi.Pipeline.preset(preset, spp=16), 6).mean(axis=0)
    assert light.mean() == pytest.approx(reference.mean(), rel=0.01)
    assert light == pytest.approx(reference.mean(axis=0), rel=0.06)


@pytest.mark.parametrize("emitters", [gi.LightHierarchy(), gi.VisibilityLightCache(), gi.PowerLights()])
def test_a_sign_that_moves(emitters):
    sign = panel(image("texel"), wrap=CLAMP, emission=4096.0)
    away = gi.Keyframe(0.0, (0.9, 0.4, 0.0), scale=(0.5, 1.0, 1.0)), gi.Keyframe(0.2, (0.0, 0.0, 0.0))
    hidden = gi.PunctualLight("point", (1e-3, 1e-3, 1e-3), position=(0, -5, 0))
    nodes = [gi.Node("floor", [floor()]), gi.Node("sign", [sign], keyframes=away)]
    scene = gi.Scene(nodes, lights=[hidden])
    camera = gi.Camera.look_at((0, 0.5, 0.001), (0, 0, 0), hfov=0.01, resolution=(16, 16))
    pipeline = gi.Pipeline.preset("direct", emitters=emitters, spp=32)
    pixels = list(gi.render(scene, camera, pipeline, frames=range(9)))[-1].numpy("beauty").reshape(-1, 3)
    error = pixels.std(axis=0, ddof=1) / 16
    right = reflected(sign)
    assert (np.abs(pixels.mean(axis=0) - right) < 4 * error + 1e-3 * right).all() and (error < 0.02 * right).all()
