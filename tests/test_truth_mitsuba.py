"""Our pictures against Mitsuba's, stored by ``python -m warp_gi.bench.mitsuba_reference``: equal but for chance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import statistics_tools as st
from statistics_tools import every_device  # noqa: F401

import warp_gi as gi
from warp_gi.bench.presets import PRESETS
from warp_gi.exr import read_exr

FOLDER = Path(__file__).parent / "reference"
SPP, RENDERINGS = 64, 16


@pytest.mark.parametrize("name", PRESETS)
def test_picture_is_mitsubas(name):
    preset = PRESETS[name]
    if preset.missing:
        pytest.skip(f"no {preset.missing}; set WARP_GI_SCENES to the folder of the scene files")
    buffers, attributes, _ = read_exr(FOLDER / f"{name}.exr")
    assert attributes["maxDepth"] == preset.max_depth
    paths = gi.BsdfPaths(max_depth=preset.max_depth, roulette_depth=4)
    pipeline = gi.Pipeline.preset("path", spp=SPP, camera_samples=16, indirect=paths)
    images = st.renderings(preset.build(), preset.camera, pipeline, RENDERINGS)
    mean, variance = (buffers[layer].astype(np.float64) for layer in ("beauty", "variance"))
    noise_ratio = attributes["renderings"] * attributes["samples"] / (SPP * RENDERINGS)
    dof = attributes["renderings"] - 1
    line = st.compare_images(
        name, images, mean, variance, reference_dof=dof, noise_ratio=noise_ratio, systematic=preset.peer_error
    )
    print(line)
