"""A bake whose arrays do not fit together is told before kernels read past their ends."""

from __future__ import annotations

import numpy as np
import pytest
import statistics_tools as st
from scene_tools import quad

import warp_gi as gi
from warp_gi.techniques.radiance_transfer.bake import bake_transfer, regather
from warp_gi.techniques.radiance_transfer.textures import transfer_textures

GREY = gi.Material("grey", (0.6, 0.6, 0.6), specular=0.0)
SETTINGS = gi.RadianceTransfer(resolution=32, first_rays=16, rays=16, bounce_rays=8).transfer_settings


def floor() -> gi.Scene:
    return gi.Scene([gi.Node("floor", [quad((-1, 0, 1), (2, 0, 0), (0, 0, -2), GREY, "floor")])], environment=1.0)


def baked() -> gi.Bake:
    return bake_transfer(floor(), SETTINGS, st.device().alias)


@pytest.mark.parametrize(
    ("name", "index", "value"),
    [
        ("atlas_slots", (0, 0), 1 << 20),
        ("atlas_slots", (0, 0), -2),
        ("atlas_face_pages", (0,), 7),
        ("atlas_pages", (0, 1), 0),
        ("atlas_pages", (0, 2), 1 << 12),
        ("atlas_slot_faces", (0,), 99),
        ("atlas_corners", (0, 0, 0), np.nan),
        ("atlas_slot_sides", (0,), 3),
    ],
)
def test_indices_that_lead_out_of_arrays(name, index, value):
    bake = baked()
    bake.arrays[name] = bake.arrays[name].copy()
    bake.arrays[name][index] = value
    with pytest.raises(gi.BakeError, match="does not hold transfer textures that fit together"):
        transfer_textures(bake)


@pytest.mark.parametrize("name", ["atlas_corners", "transfer", "lamps"])
def test_arrays_that_are_missing_or_of_another_shape(name):
    for change in (lambda arrays: arrays.pop(name), lambda arrays: arrays.update({name: arrays[name][:, :1]})):
        bake = baked()
        change(bake.arrays)
        if name == "lamps" and "lamps" in bake.arrays and bake.arrays["lamps"].shape == (0, 3):
            continue
        with pytest.raises(gi.BakeError, match="does not hold transfer textures that fit together"):
            transfer_textures(bake)


def test_an_edit_in_place_is_baked(monkeypatch):
    def corner() -> gi.Scene:
        wall = gi.Node("wall", [quad((-1, 0, -1), (2, 0, 0), (0, 2, 0), GREY, "wall")])
        return gi.Scene([*floor().nodes, wall], environment=1.0)

    scene = corner()
    bake = bake_transfer(scene, SETTINGS, st.device().alias, keep_hits=True)
    monkeypatch.setattr(scene.materials[0], "base_color", (0.1, 0.1, 0.9))
    wanted = bake_transfer(corner(), SETTINGS, st.device().alias).arrays
    found = [regather(scene, SETTINGS, bake, st.device().alias), bake_transfer(scene, SETTINGS, st.device().alias)]
    for one in found:
        assert all(np.array_equal(one.arrays[name], array) for name, array in wanted.items())
    assert any(not np.array_equal(bake.arrays[name], array) for name, array in wanted.items())
