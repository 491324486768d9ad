"""Techniques that learn from samples: unbiased in every frame of their adaptation, whatever moves; threads; resuming."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import statistics_tools as st
from statistics_tools import every_device  # noqa: F401

import warp_gi as gi
from warp_gi.bench.presets import sphere
from warp_gi.errors import OptionError
from warp_gi.kernels import light_cache
from warp_gi.launch import set_threads

SIZE = (24, 16)
SPP = 8
OCTREE = gi.SampleOctree(split=192, collapse=96)
TERMS = ("environment", "emitters", "indirect")
GREY = gi.Material("grey", (0.7, 0.6, 0.5), specular=0.0)
GLOSSY = gi.Material("glossy", (0.9, 0.7, 0.4), metallic=1.0, roughness=0.3)
COATED = gi.Material("coated", (0.3, 0.5, 0.7), roughness=0.5)


def quad(corner, u, v, material=GREY):
    corner, u, v = (np.asarray(x, np.float32) for x in (corner, u, v))
    points = np.stack([corner, corner + u, corner + u + v, corner + v])
    return gi.Mesh(points, np.array([[0, 1, 2], [0, 2, 3]], np.int32), material)


def lamp(x, y, z, color, size=0.2):
    """A square that shines down."""
    glow = gi.Material("glow", (0.0, 0.0, 0.0), emission=color)
    return quad((x, y, z), (size, 0, 0), (0, 0, size), glow)


def hall(moving=False, sky=True):
    """Two rooms with a gap between them, lamps in both, a window, a lamp without size, a metal ball, a coated box."""
    walls = [
        quad((-2, 0, 2), (4, 0, 0), (0, 0, -4), COATED),
        quad((-2, 0, -2), (4, 0, 0), (0, 2, 0)),
        quad((-2, 0, 2), (0, 0, -4), (0, 2, 0)),
        quad((2, 0, -2), (0, 0, 4), (0, 2, 0)),
        quad((-2, 2, -2), (4, 0, 0), (0, 0, 3)),  # a roof that leaves a strip of sky
        quad((0.2, 0, -2), (0, 0, 2.6), (0, 2, 0)),
        quad((0.2, 0, 0.6), (0, 0, -2.6), (0, 2, 0)),
    ]
    lamps = [lamp(-1.8 + 0.45 * i, 1.9, -1.6 + 0.5 * (i % 3), (6.0, 4.0 + i % 2, 3.0)) for i in range(9)]
    keys = [gi.Keyframe(0.0), gi.Keyframe(1.0, (1.2, 0.0, 0.4))] if moving else None
    nodes = [
        gi.Node("walls", walls),
        gi.Node("lamps", lamps[:6]),
        gi.Node("moving lamps", lamps[6:], keyframes=keys and [gi.Keyframe(0.0), gi.Keyframe(1.0, (-1.0, 0.0, 0.5))]),
        gi.Node("ball", [sphere((-1.0, 0.4, 0.3), 0.4, GLOSSY, rows=12)], keyframes=keys),
    ]
    bulb = gi.PunctualLight("point", (0.8, 0.8, 1.2), position=(1.2, 1.0, -1.0))
    spot = gi.PunctualLight("spot", (3.0, 2.0, 1.0), position=(-1.5, 1.5, 1.0), direction=(1, -1, -1), node=3)
    pixels = np.full((16, 32, 3), 0.3, np.float32)
    pixels[2:4, 9:12] = 40.0
    return gi.Scene(nodes, [bulb, spot], environment=gi.Environment(pixels=pixels) if sky else None)


def view():
    return gi.Camera.look_at((-1.6, 1.4, 1.9), (-0.3, 0.5, -0.6), hfov=75, resolution=SIZE)


def pipeline(**settings):
    settings = {"emitters": gi.VisibilityLightCache(), "indirect": gi.GuidedPaths(max_depth=5), **settings}
    return gi.Pipeline(**{"spp": SPP, "octree": OCTREE, **settings})


PLAIN = {"emitters": gi.PowerLights(), "indirect": gi.BsdfPaths(max_depth=5)}


def sequences(scene, chosen, frames, count, seed=1):
    """Return the terms of the last of ``frames`` of ``count`` independent sequences, float64 [count, h, w, 3] each."""
    pictures = {term: [] for term in TERMS}
    for number in range(count):
        path = gi.CameraPath.still(view())
        for frame in gi.render(scene, path, chosen, frames, device=st.device().alias, seed=1000 * seed + number):
            pass
        for term in TERMS:
            pictures[term].append(frame.numpy(term).astype(np.float64))
    return {term: np.stack(images) for term, images in pictures.items()}


@pytest.fixture(scope="module")
def references():
    """Plain path traced means and variances, by whether things move and by frame; made when asked for."""
    known = {}

    def ask(moving, frame, count=24, spp=64):
        if (moving, frame) not in known:
            images = sequences(hall(moving), pipeline(**PLAIN, spp=spp), [frame], count, seed=7)
            known[moving, frame] = {term: st.mean_and_variance(x) for term, x in images.items()}
        return known[moving, frame], count * spp, count - 1

    return ask


def same_pictures(name, references, moving, frames, chosen, count=16):
    reference, samples, dof = references(moving, frames[-1] if moving else 0)
    ours = sequences(hall(moving), chosen, frames, count)
    for term in TERMS:
        mean, variance = reference[term]
        ratio = samples / (count * chosen.spp)
        st.compare_images(f"{name}_{term}", ours[term], mean, variance, 1e-4, dof, ratio)


@pytest.mark.parametrize("moving", [False, True], ids=["still", "moving"])
@pytest.mark.parametrize("last", [0, 5, 30])
def test_unbiased_in_every_frame(references, last, moving):
    """Frame 0 knows nothing; in frame 5 all is in motion; by frame 30 a still scene is learnt."""
    if last == 30:
        frames = [*range(24, 31)] if moving else [*range(31)]
    else:
        frames = [*range(last + 1)]
    same_pictures(f"reuse_{last}_{moving}", references, moving, frames, pipeline())
