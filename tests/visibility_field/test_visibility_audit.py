"""Audits of visibility fields: which rays each mode traces, by hand and in places where the answer is known."""

from __future__ import annotations

import numpy as np
import pytest
import statistics_tools as st
from scene_tools import quad
from statistics_tools import every_device  # noqa: F401

import warp_gi as gi
from warp_gi.kernels import visibility_field as field_kernels
from warp_gi.techniques.visibility_field import audit as visibility_audit

LABELLED = int(field_kernels.SLOT_LABEL)
COUNTS = {
    name: np.array(values, np.int32)
    for name, values in {
        "visible": [10, 10, 10, 0],
        "occluded": [3, 3, 3, 0],
        "mixed": [2, 2, 2, 0],
        "unknown": [1, 1, 1, 0],
        "label": [7, 7 | LABELLED, -1, -1],
    }.items()
}
"""Four pixels: in a cell of label 0, in one of label 1, on a surface without a cell, and on no surface."""


@pytest.mark.parametrize(
    ("mode", "expected"),
    [
        ("traced", [16, 16, 16, 0]),
        ("three_state", [3, 3, 3, 0]),
        ("unbiased", [3 + 13 / 4, 3 + 13 / 4, 3 + 13 / 4, 0]),
        ("paper", [3 + 2, 10 + 2, 16, 0]),  # inside the occlusion mask, inside the visibility mask, all
    ],
)
def test_each_mode_traces_its_part(mode, expected):
    settings = gi.VisibilityField(mode, sky="harmonics" if mode == "paper" else "map", verify=0.25)
    assert visibility_audit.rays_asked(COUNTS).tolist() == [16, 16, 16, 0]
    assert visibility_audit.rays_traced(COUNTS, settings).tolist() == expected
    assert visibility_audit.occlusion_labels(COUNTS).tolist() == [0, 1, -1, -1]


@pytest.mark.parametrize(("roofed", "label"), [(False, 0), (True, 1)], ids=["open", "roofed"])
def test_the_paper_traces_the_smaller_mask(roofed, label):
    """Nothing blocks an open floor, so nothing is traced. Between wide plates only rays near the horizon are.

    The plate below is there because samples are on both sides of the floor, and labels count both.
    """
    grey = gi.Material("grey", (0.5, 0.5, 0.5), specular=0.0)
    meshes = [quad((-2, 0, 2), (4, 0, 0), (0, 0, -4), grey)]
    if roofed:
        meshes += [quad((-4, y, 4), (8, 0, 0), (0, 0, -8), grey) for y in (-0.4, 0.4)]
    scene = gi.Scene([gi.Node("place", meshes)], environment=(1.0, 1.0, 1.0))
    camera = gi.Camera.look_at((0, 0.35, 0.6), (0, 0, 0), hfov=60, resolution=(24, 16))
    settings = gi.VisibilityField("paper", sky="harmonics", cell_size=0.25, resolution=24, samples=4000, rays=128)
    pipeline = gi.Pipeline(environment=settings, emitters=None, indirect=None, spp=32, camera_samples=1)
    scheduler = gi.FrameScheduler(scene, camera, pipeline, st.device().alias)
    counts = visibility_audit.audit(scheduler.frame(0), scheduler.state("environment"))
    asked = visibility_audit.rays_asked(counts)
    assert asked.sum() > 5000 and (visibility_audit.occlusion_labels(counts)[asked > 0] == label).all()
    share = visibility_audit.rays_traced(counts, settings).sum() / asked.sum()
    assert 0.001 < share < 0.3 if roofed else share == 0.0
