"""Light field probes as a radiance cache that ends paths."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import statistics_tools as st
from path_tools import trace
from statistics_tools import device, every_device  # noqa: F401

import warp_gi as gi
from warp_gi.bench.harness.scenes import light, quad
from warp_gi.kernels.light_field_cache import PROBE_CACHE, VISIBILITY_EXACT, VISIBILITY_PROBES
from warp_gi.kernels.path_samplers import ALIAS_LIGHTS, BSDF_DIRECTIONS, NO_REGIONS, SCENE_SKY
from warp_gi.kernels.path_trace import REFERENCE, path_tracer

PROBES = {"counts": (3, 3, 3), "resolution": 64, "irradiance_resolution": 16, "rays": 4}
CACHED = path_tracer(ALIAS_LIGHTS, BSDF_DIRECTIONS, NO_REGIONS, SCENE_SKY, PROBE_CACHE)
SEEDS = range(8)


def lamp_room() -> gi.Scene:
    """Return a closed room of 2 m with a lamp below its ceiling."""
    wall = gi.Material("wall", (0.7, 0.6, 0.5), specular=0.0)
    sides = (
        ((-1, -1, 1), (2, 0, 0), (0, 0, -2)),
        ((-1, 1, -1), (2, 0, 0), (0, 0, 2)),
        ((-1, -1, -1), (2, 0, 0), (0, 2, 0)),
        ((1, -1, 1), (-2, 0, 0), (0, 2, 0)),
        ((-1, -1, 1), (0, 0, -2), (0, 2, 0)),
        ((1, -1, -1), (0, 0, 2), (0, 2, 0)),
    )
    lamp = quad((-0.3, 0.95, -0.3), (0.6, 0, 0), (0, 0, 0.6), light((8.0, 6.0, 4.0)), "lamp")
    return gi.Scene([gi.Node("room", [*(quad(*side, wall) for side in sides), lamp])], name="lamp room")


def camera() -> gi.Camera:
    return gi.Camera.look_at((0.1, 0.1, 0.7), (0, -0.1, -1), hfov=70, resolution=(16, 16))


def cached(field: Any, visibility: int, seed: int, **settings: Any) -> np.ndarray:
    """Return indirect light of paths that end in probes at their second vertex."""

    def fill(samplers: Any, items: int) -> None:
        samplers.cache.field, samplers.cache.visibility = field, visibility

    return trace(lamp_room(), camera(), CACHED, fill, 64, seed, **settings)["indirect"]


@pytest.mark.parametrize("visibility", ["probes", "exact"])
def test_paths_that_end_in_probes_agree_with_rays_that_do(visibility):
    """The mode "traced" follows one ray and asks the probes where it ends: the same light by other random numbers."""
    scene, probes = lamp_room(), gi.LightFieldProbes(mode="traced", visibility=visibility, **PROBES)
    bake = probes.bake(scene, str(device()), 1, camera=camera())
    state = probes.start(scene, str(device()), bake)
    mode = {"probes": VISIBILITY_PROBES, "exact": VISIBILITY_EXACT}[visibility]
    pipeline = gi.Pipeline(environment=None, emitters=None, indirect=probes, spp=64, camera_samples=1)
    path = gi.CameraPath.still(camera())
    frames = gi.render(scene, path, pipeline, frames=SEEDS, device=str(device()), seed=3, bakes=[bake])
    expected = np.stack([frame.numpy("indirect").astype(np.float64) for frame in frames])
    images = np.stack([cached(state.field, mode, seed) for seed in SEEDS])
    mean, variance = st.mean_and_variance(expected)
    st.compare_images(f"probe_cache_{visibility}", images, mean, variance, reference_dof=len(SEEDS) - 1)
    whole = np.stack([trace(scene, camera(), REFERENCE, None, 64, seed)["indirect"] for seed in SEEDS])
    assert abs(images.mean() / whole.mean() - 1.0) < 0.1
    assert images.var(axis=0).mean() < 0.9 * whole.var(axis=0).mean()


def test_where_probes_see_nothing_paths_go_on():
    """Probes far from the room know nothing of it: not one bit differs from paths without them."""
    scene, probes = lamp_room(), gi.LightFieldProbes(**PROBES)
    state = probes.start(scene, str(device()), probes.bake(scene, str(device()), 1, camera=camera()))
    state.field.low = (50.0, 50.0, 50.0)
    expected = trace(scene, camera(), REFERENCE, None, 64, 1)["indirect"]
    np.testing.assert_array_equal(cached(state.field, VISIBILITY_PROBES, 1), expected)
