"""The traversals for CPUs with AVX2, with AVX-512 and for all others: the same hits from each."""

from __future__ import annotations

import functools
import platform
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from ray_tools import rays, soup

from warp_gi.bvh import AlphaMasks, TriangleBvh
from warp_gi.kernels import bvh, types
from warp_gi.kernels.bvh_packets import intersect_packets_native
from warp_gi.kernels.bvh_rays import RayBatch, RayHits
from warp_gi.launch import launch

CPU = wp.get_device("cpu")
NEEDED = {"x86-64": set(), "x86-64-v3": {"avx2", "bmi2", "fma"}, "x86-64-v4": {"avx512vl", "avx512dq", "avx512bw"}}


def has(features: set[str]) -> bool:
    if platform.machine().lower() not in ("x86_64", "amd64"):
        return False
    info = Path("/proc/cpuinfo")
    return not features or (info.exists() and features <= set(info.read_text().split()))


@functools.cache
def kernel_for(march: str) -> wp.Kernel:
    """Return a kernel compiled for a level of x86-64: a thread writes a ray's closest hit and whether it has any."""

    @wp.kernel(enable_backward=False, module="unique", module_options={"cpu_compiler_flags": f"-target-cpu {march}"})
    def both(first: wp.int32, tree: types.Bvh, batch: RayBatch, hits: RayHits, occluded: wp.array(dtype=wp.int32)):
        i = first + wp.tid()
        hit = bvh.wide_intersect(tree, batch.origins[i], batch.directions[i], batch.t_max[i])
        hits.t[i] = hit[0]
        hits.u[i] = hit[1]
        hits.v[i] = hit[2]
        hits.face[i] = wp.cast(hit[3], wp.int32)
        occluded[i] = bvh.wide_occluder(tree, batch.origins[i], batch.directions[i], batch.t_max[i], 0)

    return both


@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize(
    "march", [pytest.param(name, marks=[] if name == "x86-64-v3" else pytest.mark.slow) for name in NEEDED]
)
def test_hits_do_not_depend_on_what_the_cpu_has(march, masked):
    if not has(NEEDED[march]):
        pytest.skip(f"this CPU does not run {march}")
    rng = np.random.default_rng(31)
    points, indices = soup(rng, 1500, 0.08)
    alpha = None
    if masked:
        nothing = wp.empty(0, dtype=types.Texture, device=CPU), wp.empty(0, dtype=wp.uint32, device=CPU)
        mask = np.arange(1500, dtype=np.int32) % 3 - 1
        alpha = AlphaMasks(mask, [(-1, 0.2, 0.5), (-1, 0.5, None)], np.zeros((4500, 2), np.float32), *nothing)
    tree = TriangleBvh(points, indices, alpha=alpha)
    origins, directions = rays(rng, 20000)
    directions[::7, 1] = 0.0
    directions[::11, :2] = np.float32([-0.0, 0.0])
    limits = rng.uniform(0, 10, 20000).astype(np.float32)
    limits[::2] = np.inf
    expected = tree.intersect(origins, directions, limits)
    hits = RayHits()
    hits.t, hits.u, hits.v = (wp.zeros(20000, dtype=wp.float32, device=CPU) for _ in range(3))
    hits.face, occluded = (wp.zeros(20000, dtype=wp.int32, device=CPU) for _ in range(2))
    launch(kernel_for(march), 20000, [tree.data, tree._rays(origins, directions, limits), hits, occluded], CPU)
    face = expected.face.numpy()
    assert (face >= 0).sum() > 3000
    same = hits.face.numpy() == face  # products are fused with sums where the CPU can: a ray at an edge may differ
    assert same.mean() > 0.9998
    for name in ("t", "u", "v"):
        np.testing.assert_allclose(getattr(hits, name).numpy()[same], getattr(expected, name).numpy()[same], atol=1e-5)
    assert ((occluded.numpy() != 0) == (hits.face.numpy() >= 0)).mean() > 0.9999


@functools.cache
def packets_for(march: str) -> wp.Kernel:
    """Return a kernel compiled for a level of x86-64: a thread writes the closest hits of sixteen rays."""

    @wp.kernel(enable_backward=False, module="unique", module_options={"cpu_compiler_flags": f"-target-cpu {march}"})
    def packets(first: wp.int32, tree: types.Bvh, batch: RayBatch, hits: RayHits):
        i = first + wp.tid()
        intersect_packets_native(tree, batch, 16 * i, wp.min(16 * i + 16, batch.origins.shape[0]), hits)

    return packets


@pytest.mark.slow
@pytest.mark.parametrize("march", list(NEEDED))
def test_packets_do_not_depend_on_what_the_cpu_has(march):
    if not has(NEEDED[march]):
        pytest.skip(f"this CPU does not run {march}")
    rng = np.random.default_rng(32)
    tree = TriangleBvh(*soup(rng, 1500, 0.08))
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 99), np.linspace(-1.0, 1.0, 99))
    directions = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3).astype(np.float32)
    origins = np.full_like(directions, (0.5, 0.5, -0.4))
    expected = tree.intersect(origins, directions)
    hits, count = RayHits(), len(origins)
    hits.t, hits.u, hits.v = (wp.zeros(count, dtype=wp.float32, device=CPU) for _ in range(3))
    hits.face = wp.zeros(count, dtype=wp.int32, device=CPU)
    inputs = [tree.data, tree._rays(origins, directions, np.inf), hits]
    launch(packets_for(march), -(-count // 16), inputs, CPU)
    face = expected.face.numpy()
    assert (face >= 0).sum() > 3000
    same = hits.face.numpy() == face
    assert same.mean() > 0.9998
    for name in ("t", "u", "v"):
        np.testing.assert_allclose(getattr(hits, name).numpy()[same], getattr(expected, name).numpy()[same], atol=1e-5)
