"""The ray benchmark's rows, on a mesh small enough for every test run."""

from __future__ import annotations

import numpy as np
import pytest

import warp_gi as gi
from warp_gi import bvh as bvh_module
from warp_gi.bench.harness import runner, scenes
from warp_gi.bench.harness.places import PLACES
from warp_gi.bench.suites.rays import suite as rays
from warp_gi.bench.suites.rays.columns import COLUMNS
from warp_gi.bench.suites.rays.embree import EmbreeScene


def test_rows_hold_every_contender_and_all_agree(monkeypatch):
    rng = np.random.default_rng(3)
    corners = rng.normal(size=(300, 3, 3)) * 0.1 + rng.random((300, 1, 3))
    points, indices = corners.reshape(-1, 3).astype(np.float32), np.arange(900, dtype=np.int32).reshape(-1, 3)
    camera = gi.CameraKey(0.0, (0.5, 0.5, 3.0), (0.5, 0.5, 0.5), hfov=40.0)
    primary = rays.primary_rays(camera, 6000)
    batches = {
        "diffuse": (*rays.diffuse_rays(points, indices, 4000), np.inf),
        "primary": (*primary, np.inf),
        "shadow": rays.shadow_rays(gi.TriangleBvh(points, indices), camera, *primary),
    }
    monkeypatch.setattr(bvh_module, "ORDERED_BYTES", 0)  # as a large tree
    monkeypatch.setattr(bvh_module, "ORDERED_RAYS", 3000)
    build, *races = rays.compare("soup", points, indices, batches, repetitions=1)
    assert COLUMNS.undeclared([build, *races]) == []
    has_peer = "skipped" not in races[0]
    races = races if has_peer else races[1:]
    assert build["triangles"] == 300 and build["ours build s"] > 0.0 and build["bytes a triangle"] > 0.0
    assert [(row["rays"], row["query"]) for row in races] == [
        ("diffuse", "any"),
        ("diffuse", "closest"),
        ("primary", "any"),
        ("primary", "closest"),
        ("shadow", "any"),
    ]
    for row in races:
        assert row["ours Mrays/s"] > 0.0 and row["ours in order Mrays/s"] > 0.0
        assert (row["rays"] == "shadow") == ("ours / warp" not in row)  # its query has no limits here
        assert (row["rays"] == "diffuse") == ("coherent / ours" not in row)
        if has_peer:
            assert (row["rays"] == "diffuse") == ("coherent / embree packets" not in row)
            assert row["agree"] > 0.999 and row["ours / embree"] > 0.0 and row["ours / embree robust"] > 0.0
            assert 0.0 < row["ours / best"] <= min(row["ours / embree"], row["ours / embree high"]) * 1.000001
            assert (row["rays"] == "diffuse") == ("ours / embree packets" not in row)
            assert ("presorted / best" in row) or row["rays"] != "diffuse"


@pytest.mark.parametrize("robust", [False, True])
@pytest.mark.parametrize("quality", ["medium", "high"])
def test_embree_finds_what_we_find_ray_by_ray_and_in_packets(quality, robust):
    pytest.importorskip("embreex")
    rng = np.random.default_rng(8)
    corners = rng.normal(size=(500, 3, 3)) * 0.1 + rng.random((500, 1, 3))
    points, indices = corners.reshape(-1, 3).astype(np.float32), np.arange(1500, dtype=np.int32).reshape(-1, 3)
    origins = rng.random((1001, 3)).astype(np.float32)  # no whole number of packets
    directions = rng.normal(size=(1001, 3)).astype(np.float32)
    limits = rng.uniform(0.0, 1.0, 1001).astype(np.float32)
    tree, scene = gi.TriangleBvh(points, indices), EmbreeScene(points, indices, quality, robust)
    for far in (np.inf, limits):
        for query in ("any", "closest"):
            expected = rays.trace(tree, query, origins, directions, far)
            for packets in (False, True):
                assert (scene.trace(query, origins, directions, far, packets) == expected).mean() > 0.998


def test_rays_start_on_the_surface_and_are_unit():
    points = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    origins, directions = rays.diffuse_rays(points, np.int32([[0, 1, 2]]), 2000)
    assert abs(origins[:, 2]).max() < 1e-4 and origins[:, :2].min() >= 0.0 and origins[:, :2].sum(1).max() < 1.001
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, rtol=1e-5)
    assert (origins[:, 2] * directions[:, 2] > 0.0).all()  # on the side they leave to
    assert abs(directions[:, 2]).mean() == pytest.approx(2.0 / 3.0, abs=0.02)  # cosine-distributed
    origins, directions = rays.primary_rays(PLACES["sponza"].path().keys[0], 15000)
    assert len(directions) == pytest.approx(15000, rel=0.02)
    width = 150
    assert directions[width * 49 + 74] @ directions[width * 50 + 75] > 0.999
    across = np.degrees(np.arccos(directions[width * 50] @ directions[width * 50 + width - 1]))
    assert across == pytest.approx(65.0, abs=1.0)


def test_missing_scenes_give_a_row_and_unknown_ones_an_error(monkeypatch, tmp_path):
    monkeypatch.setattr(scenes, "SCENES", tmp_path)
    monkeypatch.setattr(rays, "QUICK_RAYS", 1000)
    monkeypatch.setitem(rays.CASES, "box", "cornell_box")
    monkeypatch.setattr(rays, "QUICK_SCENES", ("living room", "sponza", "box"))
    rows = rays.run(quick=True)
    missing = [row for row in rows if row.get("skipped") == rays.NO_EMBREE]  # where it is not installed
    rows = [row for row in rows if row not in missing]
    assert [row["scene"] for row in rows] == ["living room", "sponza", *["box"] * 6] and len(missing) <= 1
    assert all("WARP_GI_SCENES" in row["skipped"] for row in rows[:2])
    assert all(row["triangles"] == gi.builtin_scene("cornell_box").triangle_count for row in rows[2:])
    with pytest.raises(gi.OptionError, match="did you mean 'sponza'"):
        runner.run_suite("rays", True, "cpu", parts=["sponsa"])
