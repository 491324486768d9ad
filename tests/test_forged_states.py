"""States of sequences that are sealed and do not hold what they should: refused in a line, never a crash or NaN."""

from __future__ import annotations

import os
from functools import cache

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.errors import BakeError, GiError

MUTATIONS = int(os.environ.get("WARP_GI_CAMPAIGN_STATES", "15"))
CAMERA = gi.CameraPath(
    (gi.CameraKey(0.0, (0, 1, 3.2), (0, 1, 0)), gi.CameraKey(1.0, (0.1, 1, 3.1), (0, 1, 0))), resolution=(12, 8)
)
PIPELINES = {
    "reuse": gi.Pipeline.preset("reuse", spp=4),
    "filter": gi.Pipeline.preset("path", spp=1, denoise=gi.SpatioTemporal()),
    "cache": gi.Pipeline.preset(
        "cache", spp=1, indirect=gi.BsdfPaths(ends_in=gi.SurfaceCache(paths=2000, refresh=1000))
    ),
    "field": gi.Pipeline.preset("dvf", spp=2, environment=gi.VisibilityField(cell_size=0.6)),
}


def moving_box():
    scene = gi.builtin_scene("cornell_box")
    scene.environment = 1.0
    scene.animate("tall block", [gi.Keyframe(0.0, (0, 0, 0)), gi.Keyframe(1.0, (0.1, 0, 0))])
    return scene


@cache
def field_bake():
    return gi.bake(moving_box(), PIPELINES["field"].environment, seed=1, camera=CAMERA)


def scheduler_of(name):
    bakes = [field_bake()] if name == "field" else []
    return gi.FrameScheduler(moving_box(), CAMERA, PIPELINES[name], seed=1, bakes=bakes)


@pytest.fixture(scope="module")
def states(tmp_path_factory):
    """State files after two frames, and the frame that follows, by pipeline."""
    found = {}
    for name in PIPELINES:
        scheduler = scheduler_of(name)
        for index in range(3):
            frame = scheduler.frame(index)
            if index == 1:
                path = scheduler.save_state(tmp_path_factory.mktemp("states") / f"{name}.safetensors", "x")
        found[name] = path, frame.numpy("beauty")
    return found


def goes_on(scheduler, bake, folder):
    """Load a state and return the next frame's picture."""
    path = bake.save(folder / "forged.safetensors")
    scheduler.load_state(path, "x")
    return scheduler.frame(2, 1).numpy("beauty")


def forged(bake, arrays):
    kept = {name: array for name, array in arrays.items() if array is not None}
    return gi.Bake(bake.technique, bake.scene_key, dict(bake.settings), kept, dict(bake.counts), bake.scene_name)


def mutations(arrays, rng):
    """Yield arrays with one changed: left out, of another shape or type, or with values out of range."""
    names = sorted(arrays)
    while True:
        name = names[rng.integers(len(names))]
        array = arrays[name].copy()
        kind = rng.integers(9)
        if kind == 0:
            made = None
        elif kind == 1:
            made = array[: len(array) // 2] if array.ndim else array.reshape(1)
        elif kind == 2:
            made = np.concatenate([array, array]) if array.ndim else array.reshape(1, 1)
        elif kind == 3:
            made = array.astype(np.float64 if array.dtype.kind in "iub" else np.int16)
        elif kind == 4:
            made = array[None]
        elif array.size:
            flat = array.reshape(-1)
            if kind in (5, 6) or array.dtype.kind == "b":
                flat.view(np.uint8)[:] = rng.integers(0, 256, flat.nbytes) if kind == 5 else 255
            elif array.dtype.kind == "f":
                flat[rng.integers(flat.size, size=3)] = rng.choice([np.nan, np.inf, -np.inf, 3e38, -1.0])
            else:
                flat[rng.integers(flat.size, size=3)] = rng.choice(
                    [np.iinfo(array.dtype).max, np.iinfo(array.dtype).min, 1, 7]
                )
            made = flat.reshape(array.shape)
        else:
            continue
        yield name, int(kind), arrays | {name: made}


@pytest.mark.parametrize("name", PIPELINES)
def test_states_go_on_as_they_were(states, name, tmp_path):
    path, following = states[name]
    scheduler = scheduler_of(name)
    scheduler.load_state(path, "x")
    np.testing.assert_array_equal(scheduler.frame(2, 1).numpy("beauty"), following)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("name", PIPELINES)
def test_forged_states_crash_nothing(states, name, tmp_path):
    bake, rng = gi.load_bake(states[name][0]), np.random.default_rng(5)
    many, refused = mutations(bake.arrays, rng), 0
    for _ in range(MUTATIONS):
        array, kind, arrays = next(many)
        try:
            picture = goes_on(scheduler_of(name), forged(bake, arrays), tmp_path)
        except GiError as error:
            assert isinstance(error, BakeError) and "\n" not in str(error) and "delete it" in str(error), (array, kind)
            refused += 1
        else:
            assert np.isfinite(picture).all(), (array, kind)
    assert refused > MUTATIONS // 3


def reuse_state(states):
    return gi.load_bake(states["reuse"][0])


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("octree.octree.nodes", lambda a: a.__setitem__(0, (1 << 8) | 0x7F + 0 * a[0]), "octree"),
        ("octree.levels", lambda a: a.__setitem__(slice(None), 3), "octree"),
        ("indirect.guides.trees", lambda a: a.__setitem__(slice(None), 0xFFFFFFFF), "quadtrees"),
        ("indirect.guides.shares", lambda a: a.__setitem__(slice(None), 2.0), "shares"),
        ("emitters.tables.items", lambda a: a.__setitem__(slice(None), 1 << 20), "bucket|chances"),
        ("emitters.tables.offsets", lambda a: a.__setitem__(slice(None), 1 << 20), "offsets"),
        ("emitters.known.entries", lambda a: a.__setitem__(slice(None), 1 << 20), "entries"),
        ("emitters.known.counts", lambda a: a.__setitem__(slice(None), 1 << 20), "counts"),
    ],
)
def test_what_a_kernel_would_follow_is_named(states, tmp_path, name, change, words):
    bake = reuse_state(states)
    assert name in bake.arrays and bake.arrays[name].size
    array = bake.arrays[name].copy()
    change(array)
    with pytest.raises(BakeError, match=words):
        goes_on(scheduler_of("reuse"), forged(bake, bake.arrays | {name: array}), tmp_path)
