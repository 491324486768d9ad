"""Ray queries of trimesh and of many cameras at once, against brute force in float64."""

from __future__ import annotations

import copy
import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from ray_tools import oracle, soup

import warp_gi as gi
from warp_gi import camera_rays
from warp_gi.errors import OptionError


def with_rays(mesh):
    mesh.ray = gi.RayMeshIntersector(mesh)
    return mesh


def random_rays(rng, count):
    origins, ways = rng.random((count, 3)) * 2.0 - 0.5, rng.normal(size=(count, 3))
    return origins, ways / np.linalg.norm(ways, axis=1, keepdims=True)


# ---- the interface of trimesh ----


@pytest.mark.parametrize(("scale", "shift"), [(1.0, 0.0), (1e-4, 0.0), (3e5, 0.0), (1.0, 5e5)])
def test_every_hit_is_found_once(scale, shift):
    rng = np.random.default_rng(1)
    points, indices = soup(rng, 300)
    points = points.astype(np.float64) * scale + shift
    mesh = with_rays(trimesh.Trimesh(points, indices, process=False))
    origins, ways = random_rays(rng, 400)
    origins = origins * scale + shift
    wanted = oracle(points, indices, origins, ways)
    faces, rays, at = mesh.ray.intersects_id(origins, ways * 7.0, return_locations=True)
    assert len(faces) > 400
    assert sorted(zip(rays, faces, strict=True)) == sorted(zip(*np.nonzero(np.isfinite(wanted)), strict=True))
    t = ((at - origins[rays]) * ways[rays]).sum(axis=1)
    np.testing.assert_allclose(t, wanted[rays, faces], rtol=1e-9, atol=1e-9 * (scale + shift))
    assert (np.diff(rays) >= 0).all() and (np.diff(t)[np.diff(rays) == 0] > 0).all()

    closest = np.where(np.isfinite(wanted).any(axis=1), wanted.argmin(axis=1), -1)
    np.testing.assert_array_equal(mesh.ray.intersects_first(origins, ways), closest)
    np.testing.assert_array_equal(mesh.ray.intersects_any(origins, ways), closest >= 0)
    one_face, one_ray = mesh.ray.intersects_id(origins, ways, multiple_hits=False)
    np.testing.assert_array_equal(one_face, closest[one_ray])
    first = mesh.ray.intersects_location(origins, ways, multiple_hits=False)
    assert len(first[0]) == (closest >= 0).sum()
    every = np.bincount(rays, minlength=400)
    two = np.bincount(mesh.ray.intersects_id(origins, ways, max_hits=2)[1], minlength=400)
    np.testing.assert_array_equal(two, np.minimum(every, 2))


def test_a_ray_through_shared_edges_and_vertices_hits_a_surface_once():
    sphere = with_rays(trimesh.creation.icosphere(2))
    inside = np.full((len(sphere.vertices) + len(sphere.edges_unique), 3), (0.01, 0.02, -0.03))
    edges = sphere.vertices[sphere.edges_unique] @ np.eye(3)
    targets = np.concatenate([sphere.vertices, 0.3 * edges[:, 0] + 0.7 * edges[:, 1]])
    _, rays = sphere.ray.intersects_id(inside, targets - inside)
    np.testing.assert_array_equal(np.bincount(rays, minlength=len(inside)), 1)
    outside = targets + 5.0 * (targets - inside)  # the same lines from without: in and out
    _, rays = sphere.ray.intersects_id(outside, inside - targets)
    np.testing.assert_array_equal(np.bincount(rays, minlength=len(inside)), 2)


def test_a_surface_at_the_origin_is_hit_and_one_behind_it_is_not():
    box = with_rays(trimesh.creation.box())
    up, down = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
    top = [(0.1, 0.2, 0.5 + lift) for lift in (0.0, 1e-7, -1e-7)]
    assert [len(box.ray.intersects_id([at], [down])[0]) for at in top] == [2, 2, 1]
    assert [len(box.ray.intersects_id([at], [up])[0]) for at in top] == [1, 0, 1]


def test_grazing_rays_neither_stick_nor_count_twice():
    mesh = with_rays(trimesh.creation.box((1.0, 1.0, 1.0)).subdivide().subdivide())
    slopes = 10.0 ** -np.arange(1.0, 7.0)  # 0.1 to 1e-6: the edges of the box in float32 are 3e-8 wide
    origins = np.stack([np.full(6, -0.75), np.full(6, 0.013), 0.5 - 0.001 * slopes + 0.75 * slopes], axis=1)
    ways = np.stack([np.ones(6), np.full(6, 0.001), -slopes], axis=1)
    _, rays = mesh.ray.intersects_id(origins, ways)
    np.testing.assert_array_equal(np.bincount(rays, minlength=6), 2)


def test_edits_copies_and_bad_rays():
    box = with_rays(trimesh.creation.box())
    ray = [(0.0, 0.0, 3.0)], [(0.0, 0.0, -2.0)]
    assert box.ray.intersects_location(*ray)[0][0, 2] == 0.5
    box.apply_scale(2.0)
    assert box.ray.intersects_location(*ray)[0][0, 2] == 1.0
    for again in (copy.copy(box.ray), copy.deepcopy(box.ray), pickle.loads(pickle.dumps(box.ray))):
        assert again.intersects_any(*ray).tolist() == [True]
    inside = np.random.default_rng(2).random((200, 3)) * 4.0 - 2.0
    np.testing.assert_array_equal(box.contains(inside), (np.abs(inside) < 1.0).all(axis=1))
    bad = [(0, 0, np.nan), (0, 0, 3), (0, 0, np.inf), (0, 0, 3)], [(0, 0, -1), (0, 0, 0), (0, 0, -1), (0, np.nan, -1)]
    assert not box.ray.intersects_any(*bad).any()
    for shapes in (((2, 3), (1, 3)), ((3,), (3,)), ((2, 2), (2, 2))):
        with pytest.raises(ValueError, match=r"shape \[ray, 3\]"):
            box.ray.intersects_first(np.zeros(shapes[0]), np.ones(shapes[1]))
    loose = np.concatenate([box.vertices, [(np.nan, 0, 0), (1e30, 0, 0)]])[::-1]  # vertices of no triangle
    loose = with_rays(trimesh.Trimesh(loose, len(loose) - 1 - box.faces, process=False))
    np.testing.assert_array_equal(loose.ray.intersects_first(inside, inside), box.ray.intersects_first(inside, inside))
    assert gi.RayMeshIntersector(trimesh.Trimesh()).intersects_first(*ray).tolist() == [-1]


# ---- many cameras ----


def test_cameras_at_once_see_what_each_sees_alone(monkeypatch):
    rng = np.random.default_rng(3)
    points, indices = soup(rng, 200)
    tree = gi.TriangleBvh(points, indices)
    size = (9, 7)
    cameras = [
        gi.Camera.look_at((2, 1, 2), (0.5, 0.5, 0.5), hfov=50, resolution=size),
        gi.Camera.orthographic((-1, 0.2, 0.4), (0.5, 0.5, 0.5), width=2.0, resolution=size),
        gi.Camera.look_at((0.5, 3, 0.4), (0.5, 0.5, 0.5), hfov=40, resolution=size, lens_shift=(0.1, -0.2)),
    ]
    monkeypatch.setattr(camera_rays, "RAYS_AT_ONCE", 2 * 63)  # two cameras, then one
    seen = gi.trace_cameras(tree, cameras)
    assert seen.depth.shape == seen.face.shape == (3, 7, 9) and seen.normal.shape == (3, 7, 9, 3)
    pixels = np.stack([np.tile(np.arange(9), 7), np.repeat(np.arange(7), 9)], axis=1) + 0.5
    for i, camera in enumerate(cameras):
        alone = gi.trace_cameras(tree, camera)
        origins, ways = np.broadcast_to(camera.origins(pixels), (63, 3)), camera.directions(pixels)
        t = oracle(points, indices, origins, ways)
        hit, face = np.isfinite(t).any(axis=1), t.argmin(axis=1)
        assert 10 < hit.sum() < 63
        np.testing.assert_array_equal(seen.face[i].ravel(), np.where(hit, face, -1))
        at = origins + np.where(hit, t.min(axis=1), 0.0)[:, None] * ways
        depth = -((at - camera.position) @ camera.world_from_camera[:3, 2])
        np.testing.assert_allclose(seen.depth[i].ravel(), np.where(hit, depth, np.inf), rtol=1e-5)
        a, b, c = points[indices[face[hit]]].astype(np.float64).transpose(1, 0, 2)
        normal = np.cross(b - a, c - a)
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        found = seen.normal[i].reshape(-1, 3)
        assert ((found[hit] * ways[hit]).sum(axis=1) <= 0).all() and not found[~hit].any()
        np.testing.assert_allclose(np.abs((found[hit] * normal).sum(axis=1)), 1.0, rtol=1e-6)
        for name in ("depth", "normal", "face"):
            np.testing.assert_array_equal(getattr(seen, name)[i], getattr(alone, name)[0])
    poses = [camera.world_from_camera for camera in cameras[::2]]
    posed = gi.trace_cameras(tree, cameras[0], poses)
    assert posed.depth.shape == (2, 7, 9)
    np.testing.assert_array_equal(posed.face[0], seen.face[0])


def test_cameras_that_do_not_go_together_are_refused():
    tree = gi.TriangleBvh(np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.int32([[0, 1, 2]]))
    near, far = (gi.Camera.look_at((0, 0, z), (0, 0, 0), resolution=(4, z)) for z in (2, 3))
    for cameras, poses, words in (
        ([], None, "at least one camera"),
        ([near, far], None, "one resolution"),
        (near, np.eye(4), r"\[camera, 4, 4\]"),
        ([near, near], np.eye(4)[None], "one camera"),
    ):
        with pytest.raises(OptionError, match=words):
            gi.trace_cameras(tree, cameras, poses)


# ---- trimesh's own tests ----


@pytest.mark.slow
@pytest.mark.skipif("WARP_GI_TRIMESH" not in os.environ, reason="WARP_GI_TRIMESH names no unpacked source of trimesh")
def test_trimesh_passes_its_own_ray_tests():
    """``pip download trimesh --no-binary trimesh --no-deps``, and the folder of the archive in WARP_GI_TRIMESH."""
    folder = Path(os.environ["WARP_GI_TRIMESH"]) / "tests"
    files = [folder / name for name in ("test_ray.py", "test_ray_upstream.py") if (folder / name).exists()]
    assert files, f"{folder} has no test_ray.py: name the folder that trimesh's sdist unpacks to"
    command = [sys.executable, "-m", "pytest", "-q", "-rs", "-p", "trimesh_tools", "-p", "no:cacheprovider", "-n", "0"]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    result = subprocess.run(
        [*command, "-c", os.devnull, "--rootdir", folder, *files], capture_output=True, text=True, env=environment
    )
    print(result.stdout)
    assert result.returncode == 0 and " passed" in result.stdout, result.stdout + result.stderr
