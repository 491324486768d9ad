"""Bakes that are sealed and do not hold what they should: a line that names the array, and never a crash or NaN."""

from __future__ import annotations

import json

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import save_file

import warp_gi as gi
from warp_gi import baking
from warp_gi.errors import BakeError, GiError
from warp_gi.layout import Layout, misfit

CAMERA = gi.Camera.look_at((0, 1, 3.2), (0, 1, 0), resolution=(12, 8))
PIPELINES = {
    "VisibilityField": gi.Pipeline.preset("dvf", spp=2, environment=gi.VisibilityField(cell_size=0.6)),
    "LightFieldProbes": gi.Pipeline.preset(
        "probes", spp=1, indirect=gi.LightFieldProbes(counts=(2, 2, 2), resolution=16, rays=1)
    ),
    "SurfaceCache": gi.Pipeline.preset("cache", spp=1, indirect=gi.BsdfPaths(ends_in=gi.SurfaceCache(paths=2000))),
    "RadianceTransfer": gi.Pipeline(
        gi.RadianceTransfer(resolution=64, first_rays=16, rays=16, bounces=1), indirect=None, spp=1
    ),
    "VisibilityPolygons": gi.Pipeline.preset("polygons", spp=1),
}


def box():
    scene = gi.builtin_scene("cornell_box")
    scene.environment = 1.0
    return scene


@pytest.fixture(scope="module")
def bakes():
    """Bakes by their techniques."""
    found = {}
    for pipeline in PIPELINES.values():
        for part in (pipeline.environment, pipeline.indirect, getattr(pipeline.indirect, "ends_in", None)):
            if hasattr(part, "bake_key") and type(part).__name__ in PIPELINES and type(part).__name__ not in found:
                found[type(part).__name__] = gi.bake(box(), part, camera=CAMERA)
    assert set(found) == set(PIPELINES)
    return found


def changed(bake, **arrays):
    """Return a bake with other arrays; None leaves one out."""
    kept = {name: array for name, array in (bake.arrays | arrays).items() if array is not None}
    return gi.Bake(bake.technique, bake.scene_key, dict(bake.settings), kept, dict(bake.counts), bake.scene_name)


def rendered(bake, folder):
    """Render a frame with a bake from its file."""
    bake.save(folder / "a.safetensors")
    bake = gi.load_bake(folder / "a.safetensors")
    return next(gi.render(box(), CAMERA, PIPELINES[bake.technique], bakes=[bake]))


def as_it_was(bake, folder):
    return np.isfinite(rendered(bake, folder).numpy("beauty")).all()


SHAPES = {
    "left out": lambda array: None,
    "of another shape": lambda array: array[None] if array.ndim else array.reshape(1, 1),
    "empty": lambda array: array[:0],
    "twice as long": lambda array: np.concatenate([array, array]),
    "of another type": lambda array: np.zeros(array.shape, np.int8),
}
FREE = {("VisibilityField", "grid_low"), ("VisibilityField", "grid_shape"), ("VisibilityField", "grid_cell_size")}
"""Arrays that are written for other programs alone: the grid follows from scene and settings."""


@pytest.mark.parametrize("technique", PIPELINES)
def test_arrays_of_other_shapes_are_named(bakes, technique, tmp_path):
    """Each array of each bake, changed in each way."""
    bake = bakes[technique]
    assert as_it_was(bake, tmp_path)
    for name, array in bake.arrays.items():
        for what, change in SHAPES.items():
            made = change(array)
            is_same = made is not None and made.shape == array.shape and made.dtype == array.dtype
            if (technique, name) in FREE or is_same:
                continue
            try:
                picture = rendered(changed(bake, **{name: made}), tmp_path).numpy("beauty")
            except BakeError as error:
                assert "\n" not in str(error) and "bake" in str(error), (name, what)
            else:  # what may be so: there is none of it, or more of it
                assert np.isfinite(picture).all(), (name, what)
                is_list = array.ndim and (len(array) == 0 or what in ("empty", "twice as long"))
                assert is_list or name in ("offset",), (name, what)


@pytest.mark.parametrize("technique", PIPELINES)
def test_numbers_of_any_size_crash_nothing(bakes, technique, tmp_path):
    """Indices far out of range, values that are not finite, and bytes by chance."""
    bake, rng = bakes[technique], np.random.default_rng(7)
    for name, array in bake.arrays.items():
        if not array.size or (technique, name) in FREE:
            continue
        kinds = [lambda flat: flat.view(np.uint8).__setitem__(slice(None), rng.integers(0, 256, flat.nbytes))]
        values = [np.nan, np.inf, 3e38, -3e38] if array.dtype.kind == "f" else [np.iinfo(array.dtype).max]
        values += [np.iinfo(array.dtype).min, -1] if array.dtype.kind == "i" else []
        kinds += [lambda flat, value=value: flat.__setitem__(rng.integers(flat.size), value) for value in values]
        for kind in kinds:
            made = array.copy()
            with np.errstate(over="ignore"):
                kind(made.reshape(-1))
            try:
                frame = rendered(changed(bake, **{name: made}), tmp_path)
            except GiError as error:
                assert "\n" not in str(error)
            else:
                assert np.isfinite(frame.numpy("beauty")).all(), name


@pytest.mark.parametrize(
    "settings", [{"paths": "many"}, {"paths": None}, {"paths": [1]}, {"paths": 10**400}, {}, {"paths": -1}]
)
def test_settings_that_cannot_be(bakes, settings, tmp_path):
    """Sealed anew, as somebody would who knows how."""
    bake = bakes["SurfaceCache"]
    bake.save(tmp_path / "a.safetensors")
    with safe_open(tmp_path / "a.safetensors", framework="np") as file:
        record = json.loads(file.metadata()[baking.FORMAT])
    record["settings"] = settings
    del record["sha256"]
    record["sha256"] = baking._seal(record, bake.digest)
    save_file(bake.arrays, tmp_path / "a.safetensors", {baking.FORMAT: json.dumps(record, sort_keys=True)})
    with pytest.raises(GiError) as caught:
        next(gi.render(box(), CAMERA, PIPELINES["SurfaceCache"], bakes=[gi.load_bake(tmp_path / "a.safetensors")]))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("counts", ["9x9x9", "0x1x1", "x", "", "1x1", "-1x2x3", "1000000x1000000x1000000", "2x2x2x2"])
def test_a_bake_that_says_another_grid(bakes, counts):
    bake = bakes["LightFieldProbes"]
    forged = changed(bake)
    forged.settings["counts"] = counts
    with pytest.raises(GiError) as caught:
        next(gi.render(forged, CAMERA))
    assert "\n" not in str(caught.value)


def test_a_layout_says_what_is_wrong():
    arrays = {"a": np.zeros((2, 3), np.float32), "b": np.array([0, 5], np.int32)}
    assert misfit(arrays, {"a": Layout("float32", (None, 3)), "b": Layout("int32 int64", (2,), 0, 5)}) == ""
    for layouts, words in (
        ({"c": Layout("float32", (1,))}, "it has no array 'c'"),
        ({"a": Layout("float32", (3, 3))}, "its array 'a' is float32 [2, 3], expected float32 [3, 3]"),
        ({"a": Layout("int32 int64", (None, 3))}, "expected int32 or int64 [any, 3]"),
        ({"b": Layout("int32", (2,), 0, 4)}, "its array 'b' has values from 0 to 5, expected 0 to 4"),
    ):
        assert words in misfit(arrays, layouts)
    arrays["a"][1, 1] = np.nan
    assert "not finite" in misfit(arrays, {"a": Layout("float32", (2, 3))})
