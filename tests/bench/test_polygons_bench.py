"""The visibility polygons' benchmark: its rows in the quick form, and its stand-ins for the paper's meshes."""

from __future__ import annotations

import numpy as np
import pytest

from warp_gi import launch
from warp_gi.bench.harness.gallery import Gallery
from warp_gi.bench.suites.polygons import frames, suite
from warp_gi.bench.suites.polygons.columns import COLUMNS
from warp_gi.bench.suites.polygons.shapes import STAND_INS, bumpy, ground

KINDS = ("polygons", "three evaluations", "unbiased", "traced")


@pytest.mark.parametrize("one", STAND_INS, ids=lambda one: one.name)
def test_stand_ins_are_as_large_as_the_meshes_of_the_paper(one):
    meshes = one.build()
    assert sum(len(mesh.points) for mesh in meshes) == pytest.approx(one.paper_vertices, rel=0.01)
    for mesh in meshes:
        corners = mesh.points[mesh.indices].astype(np.float64)
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.einsum("ij,ij", across, mesh.normals[mesh.indices[:, 0]]) > 0  # triangles and normals face alike
        assert np.einsum("ij,ij", across, corners[:, 0]) > 0  # outward


def test_a_closed_object_has_no_open_edge():
    mesh = bumpy(10, 16)
    edges = np.sort(mesh.indices[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    assert len(bumpy().points) == 2562 and len(ground().points) == 1681


def test_bakes_have_the_sizes_of_their_arrays():
    (row,) = suite.bake_rows(True, "cpu")
    assert COLUMNS.undeclared([row]) == []
    assert row["sets"] == row["vertices"] == 486 and row["triangles"] == 968
    assert 16 * row["points a set"] < row["bytes a set"] < 16 * row["points a set"] + 100
    assert row["lists MB"] * 1e6 == pytest.approx(968 * row["bytes a side"])
    assert row["cpu s"] > 0 and 0 <= row["flagged"] < 0.2 and row["traced"] == 0


def test_evaluators_agree_with_each_other_and_with_the_closed_form():
    rows = suite.evaluator_rows(True, "cpu")
    assert COLUMNS.undeclared(rows) == []
    (adaptive, exact, paper, steep), white = rows[:4], rows[4:]
    assert max(steep["rms %"], paper["rms %"]) < 5
    assert adaptive["rms %"] < min(steep["rms %"], paper["rms %"])
    assert adaptive["turns"] == exact["turns"] == suite.QUICK_TURNS
    assert 0 < adaptive["rms %"] < 0.2 and adaptive["max %"] < 1 and "rms %" not in exact
    assert adaptive["us a polygon"] > 0 and exact["tables cpu s"] > 0
    assert [(row["walls"], row["evaluator"]) for row in white] == [
        (walls, one) for walls in (False, True) for one in ("adaptive", "exact")
    ]
    for row in white:
        assert row["rms %"] < (0.15 if row["evaluator"] == "adaptive" else 0.01)


def test_a_triangle_has_the_light_of_its_closed_form():
    """The octant of x, y and z, about y, sees a quarter of the light of the upper half."""
    octant = [np.eye(3)]
    assert suite.closed_form(octant, np.array([0.0, 1.0, 0.0])) == pytest.approx(np.pi / 4)
    sky = suite.gi.Environment.constant(1.0)
    found, _ = suite.integrated(sky, "adaptive", 0.0, [octant], np.array([[0.0, 1.0, 0.0]]), launch.get_device("cpu"))
    np.testing.assert_allclose(found, np.pi / 4, rtol=1e-5)


def test_frames_are_measured_against_a_reference():
    gallery = Gallery()
    rows = frames.frame_rows(True, "cpu", gallery)
    assert COLUMNS.undeclared(rows) == []
    assert [(row["scene"], row["renderer"]) for row in rows] == [
        (scene, kind) for scene in ("closed object", "on ground") for kind in KINDS
    ]
    for polygons, three, unbiased, traced in (rows[:4], rows[4:]):
        assert three["rms %"] != polygons["rms %"] and unbiased["noise %"] < 0.9 * traced["noise %"]
        assert polygons["rms %"] < 0.9 * traced["rms %"] and polygons["PSNR"] > traced["PSNR"] + 1
    assert [list(one.images) for one in gallery.sets] == [[f"{kind}, 4" for kind in KINDS]] * 2


def test_errors_of_pixels():
    truth = np.full((100, 3), 2.0)
    pixels = truth.copy()
    pixels[:10] *= 1.5
    found = frames.errors_of(pixels, truth)
    assert found["median %"] == 0 and found["mean %"] == pytest.approx(5) and found["p95 %"] == pytest.approx(50)
    assert found["rms %"] == pytest.approx(50 * 0.1**0.5)
    assert found["PSNR"] == pytest.approx(20 * np.log10(2 / np.sqrt(0.1)))
