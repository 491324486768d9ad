"""Our pictures against Mitsuba's, stored by ``python -m warp_gi.bench.mitsuba_reference``: equal but for chance."""

from __future__ import annotations

import numpy as np
import pytest
import statistics_tools as st
from statistics_tools import every_device  # noqa: F401

import warp_gi as gi
from warp_gi.bench.mitsuba_reference import FOLDER, PICTURES
from warp_gi.sequence.exr import read_exr

SPP, RENDERINGS = 64, 16


@pytest.mark.parametrize("name", PICTURES)
def test_picture_is_mitsubas(name):
    picture = PICTURES[name]
    if picture.missing:
        pytest.skip(picture.missing)
    buffers, attributes, _ = read_exr(FOLDER / f"{name}.exr")
    assert attributes["maxDepth"] == picture.max_depth
    paths = gi.BsdfPaths(max_depth=picture.max_depth, roulette_depth=4)
    pipeline = gi.Pipeline.preset("path", spp=SPP, camera_samples=16, indirect=paths)
    images = st.renderings(picture.scene(), picture.camera(), pipeline, RENDERINGS)
    mean, variance = (buffers[layer].astype(np.float64) for layer in ("beauty", "variance"))
    noise_ratio = attributes["renderings"] * attributes["samples"] / (SPP * RENDERINGS)
    dof = attributes["renderings"] - 1
    line = st.compare_images(
        name, images, mean, variance, reference_dof=dof, noise_ratio=noise_ratio, systematic=picture.peer_error
    )
    print(line)
