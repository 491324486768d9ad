"""The benchmark of radiance transfer: its rows, on scenes small enough for every test run."""

from __future__ import annotations

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.bench.harness import measure
from warp_gi.bench.harness.court import court, court_camera
from warp_gi.bench.harness.stages import Stage
from warp_gi.bench.publish.figures import Grid
from warp_gi.bench.suites.transfer import bakes, errors, frames, memory, paper, seams, shapes, vertices, views
from warp_gi.bench.suites.transfer.columns import COLUMNS
from warp_gi.bench.suites.transfer.regions import REGIONS
from warp_gi.techniques.radiance_transfer.textures import transfer_textures
from warp_gi.techniques.shared.atlas.build import make_atlas

SMALL = {"resolution": 32, "first_rays": 64, "rays": 64}


def assert_published(table, rows):
    """Assert that columns are declared, and that rows have what regions show of their table."""
    assert COLUMNS.undeclared(rows) == [] and table in {row["table"] for row in rows}
    figures = []
    for part in (part for region in REGIONS.values() for part in region.parts):
        of_part = [column.figure for column in part.columns] if isinstance(part, Grid) else part.figures.values()
        figures += [figure for figure in of_part if (figure.table or part.table) == table]
    of_table = [row for row in rows if row["table"] == table]
    for figure in figures:
        assert any({figure.key, *figure.only} <= set(row) for row in of_table), figure
    return of_table


def test_stand_ins_have_the_papers_triangles():
    sizes = {one.name: one for one in shapes.STAND_INS}
    assert shapes.plants(sizes["plants"].size).triangle_count == pytest.approx(18_000, rel=0.01)
    assert shapes.room(sizes["room"].size).triangle_count == pytest.approx(21_000, rel=0.03)
    assert 12 * sizes["TRM"].size ** 2 * 3 == pytest.approx(441_000, rel=0.01)
    assert shapes.heads(5).triangle_count == 3 * 12 * 25 + 2


def test_a_heads_own_uvs_are_taken():
    scene = shapes.heads(5)
    own = gi.RadianceTransfer(**SMALL, charts="own")
    assert make_atlas(scene, own.transfer_settings, "cpu").count > 100
    assert make_atlas(shapes.plants(9), own.transfer_settings, "cpu").count > 100


@pytest.mark.parametrize("storage", ["texture", "vertices"])
def test_forms_of_the_product_agree(storage):
    scene = shapes.heads(6)
    scene.environment = views.own_sky()
    estimator = gi.RadianceTransfer(storage=storage, bounces=0, glossy="transfer", sun=0.0, **SMALL)
    bake = gi.bake(scene, estimator)
    stage = Stage(scene, shapes.STAND_INS[1].camera((48, 32)), estimator, 1, "cpu", bake)
    pictures = {}
    for form in paper.FORMS:
        shader = paper.Shader(stage, bake, form)
        shader()
        pictures[form] = shader.picture.copy()
    size = np.sqrt((pictures["TP"] ** 2).mean())
    assert size > 0.05
    for form in ("TP reordered", "TPFL"):
        assert np.abs(pictures[form] - pictures["TP"]).max() < 2e-5 * size, form


def test_the_papers_rows():
    one = shapes.STAND_INS[3]
    rows = paper.stand_in_rows(one, 9, 32, (48, 32), 1, "cpu")
    assert len(assert_published(paper.TABLE, rows)) == 6
    assert len(assert_published(paper.MEMORY, rows)) == 2
    quoted = paper.quoted(one)
    assert COLUMNS.undeclared(quoted) == []
    assert [row.get("paper ms") for row in quoted[:4]] == pytest.approx([2.753, 0.385, 149.25, 5.942], rel=1e-3)


def test_the_noise_of_the_reference_is_subtracted():
    rng = np.random.default_rng(1)
    truth = rng.uniform(0.5, 1.5, (60, 80, 3))
    halves = [truth + 0.3 * rng.normal(size=truth.shape) for _ in range(2)]
    row = views.errors(truth + 0.1, halves)
    assert row["rel"] == pytest.approx(0.1, rel=0.05) and row["bias, %"] == pytest.approx(10, rel=0.1)
    assert row["noise of reference"] == pytest.approx(0.3 / 2**0.5, rel=0.05)
    assert views.errors(truth, halves)["rel"] < 0.05
    mask = np.zeros((60, 80), bool)
    mask[:, 40:] = True
    half = truth + np.where(mask, 0.4, 0.0)[..., None]
    assert views.errors(half, halves, mask)["rel"] == pytest.approx(0.4, rel=0.05)


def test_textures_are_more_exact_than_corners_alone(monkeypatch):
    monkeypatch.setattr(vertices, "QUICK_SIZE", (48, 32))
    rows = assert_published(vertices.TABLE, vertices.vertex_rows(True, "cpu"))
    assert [row["size"] for row in rows] == ["1x1", "16x16", "128"]
    assert rows[2]["floor rel"] < rows[1]["floor rel"] < rows[0]["floor rel"]
    assert rows[2]["times better than 1x1"] > 5


def test_bakes_are_measured():
    rows = bakes.place_rows("court", court(1.0), True, "cpu")
    uniform, *adaptive = assert_published(bakes.UNIFORM, rows) + assert_published(bakes.ADAPTIVE, rows)
    assert uniform["rays"] == 256 * uniform["slots traced"] and uniform["cpu s for 2^20 slots"] > uniform["cpu s"]
    by_way = {row["rays"]: row for row in adaptive}
    assert by_way["256 each"]["rays a slot"] == 256 and by_way["defaults"]["rel error of T"] < 0.05
    (whole,) = assert_published(bakes.WHOLE, rows)
    assert whole["file MB"] > 0.1 and whole["bounces"] > 1
    (charts,) = assert_published(bakes.CHARTS, rows)
    assert 0.2 < charts["covered"] <= 1 and charts["cpu s"] > 0.01


def test_frames_are_measured_by_part():
    scene = court(views.own_sky())
    bake = gi.bake(scene, gi.RadianceTransfer(bounces=0, **SMALL))
    every = {frames.TRACED: frames.OneTerm.of(scene, court_camera((48, 32)), gi.TracedEnvironment(), 64, "cpu", [])}
    estimator = gi.RadianceTransfer(bounces=0, glossy="transfer", sun=0.0, **SMALL)
    every["TPFL"] = frames.OneTerm.of(scene, court_camera((48, 32)), estimator, 64, "cpu", [bake])
    rows = assert_published(frames.TABLE, frames.traced_rows({"case": "court"}, every, 1, "cpu"))
    traced, ours = rows
    assert ours["term: times less, cpu"] > 5 and traced["term: times less, cpu"] == 1
    assert ours["with primary target"] == frames.TARGETS["with primary"] and traced["frame target"] == 0
    row = frames.large_row({"case": "court", "way": "TPFL"}, every["TPFL"], (48, 32), 1, "cpu")
    assert_published(frames.LARGE, [row])
    both = frames.added(measure.Taken([1.0], [2.0], []), measure.Taken([3.0], [4.0], []))
    assert (both.wall, both.cpu, both.device) == ([4.0], [6.0], [])


def test_errors_fall_with_bounces(monkeypatch):
    monkeypatch.setattr(errors, "QUICK_SIZE", (36, 24))
    monkeypatch.setattr(errors, "INDIRECT", gi.RadianceTransfer(term="indirect", **SMALL))
    view = errors.court_view("indirect", views.smooth_sky(), True, "cpu")
    rows = assert_published(errors.BOUNCES, errors.bounce_rows(view, True, "cpu"))
    assert rows[0]["bias, %"] < -20 < rows[1]["bias, %"]
    assert rows[2]["bounces"].startswith("default, ")
    rows = assert_published(errors.RESOLUTION, errors.resolution_rows(view, True, "cpu"))
    assert {row["term"] for row in rows} == {"environment", "indirect"}


def test_density_of_texels():
    scene = court()
    atlas = make_atlas(scene, gi.RadianceTransfer(resolution=64).transfer_settings, "cpu")
    found = errors.texels_a_metre(scene, atlas, "floor")
    doubled = make_atlas(scene, gi.RadianceTransfer(resolution=128).transfer_settings, "cpu")
    assert found > 2 and errors.texels_a_metre(scene, doubled, "floor") == pytest.approx(2 * found, rel=0.2)


def test_seams_are_where_charts_meet():
    scene = shapes.heads(6)
    estimator = gi.RadianceTransfer(bounces=0, charts="xatlas", **{**SMALL, "resolution": 96})
    textures = transfer_textures(gi.bake(scene, estimator))
    one, other = seams.seam_edges(scene, textures.atlas)
    assert len(one) > 20
    geometry = scene.data("cpu").geometry
    points, ids = geometry.points.numpy(), geometry.indices.numpy().reshape(-1, 3)
    ends = [points[ids[edge[:, 0, None], edge[:, 1:]]] for edge in (one, other)]
    np.testing.assert_allclose(*ends, atol=1e-4)
    assert (textures.atlas.charts[one[:, 0]] != textures.atlas.charts[other[:, 0]]).all()
    row = seams.jumps(scene, textures)
    assert COLUMNS.undeclared([row]) == [] and 0.3 < row["jump over change"] < 3


def test_a_fetch_is_bilinear():
    """A function that is linear on the page is read exactly between its texels."""
    atlas = make_atlas(shapes.heads(6), gi.RadianceTransfer(resolution=96).transfer_settings, "cpu")
    first, width, _ = atlas.pages[0]
    texels = np.full(atlas.count, -1)
    texels[atlas.slots[0][atlas.slots[0] >= 0]] = np.flatnonzero(atlas.slots[0] >= 0)
    values = np.stack([(texels - first) % width + 0.5, (texels - first) // width + 0.5], axis=1)
    faces, inside = seams.inner_points(atlas, np.ones(len(atlas.charts), bool), np.random.default_rng(0), 500)
    found, kept = seams.fetched(atlas, values, faces, inside)
    assert kept.mean() > 0.95
    np.testing.assert_allclose(found[kept], inside[kept], atol=1e-3)


def test_memory_is_told():
    rows = memory.memory_rows(True, "cpu")
    five, six = assert_published(memory.BYTES, rows)
    assert (five["transfer bytes"], five["bounces bytes"], six["transfer bytes"]) == (64, 192, 80)
    (halves,) = assert_published(memory.HALVES, rows)
    assert 1e-5 < halves["rel error of T"] < halves["target"]
    components = assert_published(memory.PCA, rows)
    assert [row["components"] for row in components] == [8, 16, 24]
    assert components[2]["rel"] < components[1]["rel"] < components[0]["rel"]
