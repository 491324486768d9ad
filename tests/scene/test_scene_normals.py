"""Crease-aware normals."""

from __future__ import annotations

import numpy as np
import pytest

from warp_gi.errors import OptionError
from warp_gi.scene.loading import load_scene
from warp_gi.scene.model import Mesh
from warp_gi.scene.normals import smooth_mesh

CUBE_POINTS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], np.float32)
CUBE_QUADS = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
CUBE = Mesh(CUBE_POINTS, np.concatenate([CUBE_QUADS[:, [0, 1, 2]], CUBE_QUADS[:, [0, 2, 3]]]))


def face_normals(mesh: Mesh) -> np.ndarray:
    p0, p1, p2 = np.moveaxis(mesh.points[mesh.indices].astype(np.float64), 1, 0)
    normals = np.cross(p1 - p0, p2 - p0)
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)


def sphere(rings: int = 24, welded: bool = True) -> Mesh:
    """Return a unit sphere of quads split in two, its poles degenerate."""
    theta, phi = np.meshgrid(np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, 2 * rings + 1), indexing="ij")
    points = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], -1)
    points[:, -1] = points[:, 0]
    points[[0, -1]] = [[[0, 1, 0]], [[0, -1, 0]]]
    rows, columns = np.meshgrid(np.arange(rings), np.arange(2 * rings), indexing="ij")
    a = (rows * (2 * rings + 1) + columns).reshape(-1)
    b, c, d = a + 1, a + 2 * rings + 1, a + 2 * rings + 2
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    mesh = Mesh(points.reshape(-1, 3).astype(np.float32), faces)
    if not welded:
        mesh = Mesh(mesh.points[mesh.indices].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3))
    return mesh


def test_a_cube_is_split_at_creases_and_rounded_beyond_them():
    flat = smooth_mesh(CUBE, 30.0)
    assert len(flat.points) == 24
    np.testing.assert_allclose(flat.normals[flat.indices], np.repeat(face_normals(CUBE)[:, None], 3, 1), atol=1e-6)
    round_ = smooth_mesh(CUBE, 100.0)
    assert len(round_.points) == 8
    np.testing.assert_allclose(round_.normals, round_.points / np.sqrt(3), atol=1e-6)
    for mesh in (flat, round_):
        np.testing.assert_array_equal(mesh.points[mesh.indices], CUBE.points[CUBE.indices])


@pytest.mark.parametrize("welded", [True, False])
def test_a_sphere_gets_radial_normals(welded):
    mesh = smooth_mesh(sphere(welded=welded), 40.0)
    proper = np.linalg.norm(np.cross(*np.moveaxis(np.diff(mesh.points[mesh.indices], axis=1), 1, 0)), axis=1) > 1e-9
    used = np.unique(mesh.indices[proper])
    np.testing.assert_allclose(np.linalg.norm(mesh.normals[used], axis=1), 1.0, atol=1e-6)
    assert np.einsum("vx,vx->v", mesh.normals[used], mesh.points[used]).min() > 0.999


def test_seams_of_texture_coordinates_stay():
    uvs = np.random.default_rng(2).random((36, 2)).astype(np.float32)
    soup = Mesh(CUBE.points[CUBE.indices].reshape(-1, 3), np.arange(36).reshape(-1, 3), uvs=uvs)
    mesh = smooth_mesh(soup, 180.0)
    np.testing.assert_array_equal(mesh.uvs[mesh.indices].reshape(-1, 2), uvs)
    np.testing.assert_allclose(mesh.normals, mesh.points / np.sqrt(3), atol=1e-6)


@pytest.mark.parametrize("angle", [-1.0, 181.0, float("nan")])
def test_an_impossible_angle_is_an_error(angle, tmp_path):
    with pytest.raises(OptionError, match="angle from 0 to 180 degrees"):
        smooth_mesh(CUBE, angle)
    file = tmp_path / "a.ply"  # whatever is in it
    file.touch()
    with pytest.raises(OptionError, match="angle from 0 to 180 degrees"):
        load_scene(file, smooth=angle)
