"""Atlases of transfer textures: what a bilinear fetch finds, which backs have slots, and what is kept on disk."""

import dataclasses
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from atlas_tools import (
    box,
    clipped_nearest,
    covered_by,
    fetched,
    points_of,
    random_points,
    settings,
    slot_positions,
    texel_sizes,
)
from scene_tools import GREY, quad, sphere

import warp_gi as gi
from warp_gi import launch
from warp_gi.files import prune
from warp_gi.techniques.radiance_transfer.bake import OTHERWISE
from warp_gi.techniques.shared.atlas import chart_cache, chart_job, chart_worker, charts
from warp_gi.techniques.shared.atlas.atlas import Atlas
from warp_gi.techniques.shared.atlas.build import make_atlas
from warp_gi.techniques.shared.atlas.buried import MARGIN
from warp_gi.techniques.shared.atlas.densities import automatic_factors, density_factors, parse_texel_sets
from warp_gi.techniques.shared.atlas.islands import islands

RUN = charts.ChartJob.run


def run_here(_, job, progress=None):
    """Work off a job in this process, which is a fifth of a second faster."""
    result = chart_worker.run(job, progress or (lambda share: None))
    return {name: array.copy() for name, array in result.items()}


def patched(patch, folder):
    patch.setattr(chart_cache, "cache_folder", lambda name: folder / "charts")
    patch.setattr(charts.ChartJob, "run", run_here)


@pytest.fixture(autouse=True)
def _own_cache(monkeypatch, tmp_path_factory):
    patched(monkeypatch, tmp_path_factory.getbasetemp())


def scene_of(*meshes, **nodes):
    placed = [gi.Node(f"node {k}", [mesh]) for k, mesh in enumerate(meshes)]
    return gi.Scene(placed + [gi.Node(name, [mesh]) for name, mesh in nodes.items()], environment=1.0)


def ball(center=(0, 0, 0), radius=1.0, rings=8):
    return sphere(center, radius, GREY, rows=rings)


FLOOR = quad((-2, -1, 2), (4, 0, 0), (0, 0, -4), name="floor")


def small_scene():
    return scene_of(ball(), floor=FLOOR, crate=box((1.2, -0.99, -1.5), (0.6, 0.8, 0.5)))


@pytest.fixture(scope="module")
def small(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patched(patch, tmp_path_factory.getbasetemp())
        scene = small_scene()
        return scene, make_atlas(scene, settings(), "cpu")


# ---- what a fetch finds ----


def check_fetches(scene, atlas, texels=2.0):
    """Check that every point of a face on a page finds four slots near it, all on its own chart."""
    faces, u, v = random_points(np.flatnonzero(atlas.face_pages >= 0), 40)
    u[::4], v[1::4] = 0.0, 0.0  # on edges, too
    slots, shares = fetched(atlas, faces, u, v)
    assert np.where(slots < 0, shares, 0.0).max() <= 1e-5
    used = (slots >= 0) & (shares > 1e-3)
    assert (atlas.charts[atlas.slot_faces[slots]] == atlas.charts[faces][:, None])[used].all()
    distances = np.linalg.norm(slot_positions(scene, atlas)[slots] - points_of(scene, faces, u, v)[:, None], axis=2)
    assert (distances <= texels * texel_sizes(scene, atlas)[faces][:, None])[used].all()


def test_fetches_find_near_slots_of_their_chart(small):
    check_fetches(*small)


def test_slots_and_texels_are_one_another(small):
    _, atlas = small
    assert sorted(atlas.slots[atlas.slots >= 0]) == list(range(atlas.count))
    assert (atlas.slot_sides == (np.arange(atlas.count) >= np.count_nonzero(atlas.slots[0] >= 0))).all()
    for side in range(2):
        assert (atlas.slot_sides[atlas.slots[side][atlas.slots[side] >= 0]] == side).all()
    u, v = atlas.slot_points.T
    assert (u >= 0).all() and (v >= 0).all() and (u + v <= 1 + 1e-6).all()


def test_size_is_met(small):
    _, atlas = small
    assert 0.9 * 128 <= atlas.pages[0, 1:].max() <= 128
    assert atlas.corners.min() >= -1e-3 and (atlas.corners <= atlas.pages[0, 1:] + 1e-3).all()


def test_density_is_one(small):
    """Where charts lie flat, texels are equally large in both directions and on every mesh."""
    scene, atlas = small
    flat = scene._flat.objects > 0
    sizes = texel_sizes(scene, atlas)[flat]
    assert sizes.max() / sizes.min() < 1.35  # charts are rounded up to whole texels


def test_gbuffer_is_that_of_the_slow_search(small):
    _, atlas = small
    width = int(atlas.pages[0, 1])
    corners = atlas.corners.astype(np.float64)
    rng = np.random.default_rng(1)
    for texel in rng.choice(atlas.slots.shape[1], 700, replace=False):
        center = np.array([texel % width + 0.5, texel // width + 0.5])
        near = np.flatnonzero((np.abs(corners - center).min(axis=1) < 40).all(axis=1) & (atlas.face_pages >= 0))
        found = {int(face): clipped_nearest(corners[face] - center) for face in near}
        distances = {face: np.linalg.norm(point) for face, point in found.items() if point is not None}
        slot = atlas.slots[0, texel]
        if slot < 0:
            assert not distances or min(np.abs(found[face]).max() for face in distances) > 1 - 1e-3
            continue
        face, (u, v) = int(atlas.slot_faces[slot]), atlas.slot_points[slot]
        point = corners[face].T @ [1 - u - v, u, v] - center
        assert np.abs(point).max() <= 1 + 3 * MARGIN
        if distances:  # the square's edge alone is a matter of rounding
            assert np.linalg.norm(point) == pytest.approx(min(distances.values()), abs=6 * MARGIN)
            equal = [other for other, distance in distances.items() if distance < 1e-9]
            if equal and min(np.abs(found[f]).max() for f in equal) == 0 and covered_by(corners[equal] - center):
                assert face == min(equal)


def test_threads_are_bit_equal(small):
    scene, atlas = small
    for threads in (1, 2):
        launch.set_threads(threads)
        try:
            again = make_atlas(scene, settings(), "cpu")
        finally:
            launch.set_threads(None)
        for field in dataclasses.fields(Atlas):
            assert np.array_equal(getattr(again, field.name), getattr(atlas, field.name)), field.name


# ---- backs ----


def sides_of(atlas, faces):
    """Return whether any slot, and whether all texels of the chart, have a back, for the charts of some faces."""
    chosen = np.isin(atlas.charts, np.unique(atlas.charts[faces]))
    fronts = chosen[atlas.slot_faces[atlas.slots[0]]] & (atlas.slots[0] >= 0)
    return (atlas.slots[1][fronts] >= 0).mean()


def test_closed_surfaces_have_no_backs(small):
    scene, atlas = small
    objects = scene._flat.objects
    for name, share in (("node 0", 0.0), ("floor", 1.0), ("crate", 0.0)):
        faces = np.flatnonzero(objects == scene.object_names.index(name))
        assert sides_of(atlas, faces) == share, name


def test_back_slots_lie_where_the_fronts_do(small):
    _, atlas = small
    both = atlas.slots[1] >= 0
    front, back = atlas.slots[0][both], atlas.slots[1][both]
    assert np.array_equal(atlas.slot_faces[front], atlas.slot_faces[back])
    assert np.array_equal(atlas.slot_points[front], atlas.slot_points[back])


def test_the_inside_of_an_open_box_has_fronts_to_see():
    """A card within a closed box, whose fronts look inwards: its back meets fronts of the box, but no sky."""
    room = box((-2, -2, -2), (4, 4, 4), inwards=True)
    scene = scene_of(room, card=quad((-1, -1, 0), (2, 0, 0), (0, 2, 0)))
    atlas = make_atlas(scene, settings(), "cpu")
    assert sides_of(atlas, np.flatnonzero(scene._flat.objects == 1)) == 1.0
    assert sides_of(atlas, np.flatnonzero(scene._flat.objects == 0)) == 1.0  # the sky is behind the walls


# ---- strange geometry ----


def test_degenerate_triangles_are_on_no_page():
    mesh = quad((0, 0, 0), (1, 0, 0), (0, 1, 0))
    points = np.concatenate([mesh.points, [[0.5, 0.5, 0.0]]]).astype(np.float32)
    indices = np.concatenate([mesh.indices, [[0, 0, 1], [0, 2, 4], [1, 1, 1]]])
    atlas = make_atlas(scene_of(gi.Mesh(points, indices)), settings(resolution=32), "cpu")
    assert atlas.face_pages.tolist() == [0, 0, -1, -1, -1] and atlas.charts.tolist() == [0, 0, -1, -1, -1]


def test_nothing_but_degenerate_triangles():
    scene = scene_of(gi.Mesh(np.zeros((3, 3), np.float32), np.array([[0, 1, 2]])))
    atlas = make_atlas(scene, settings(), "cpu")
    assert atlas.count == 0 and atlas.face_pages.tolist() == [-1] and atlas.slots.shape == (2, 0)
    atlas.on(launch.get_device("cpu"))


@pytest.mark.parametrize("size", [1e-6, 1e4])
def test_any_unit_of_length(size):
    scene = scene_of(ball(radius=size), quad((2 * size, 0, 0), (size, 0, 0), (0, size, 0)))
    atlas = make_atlas(scene, settings(resolution=64), "cpu")
    assert (atlas.face_pages == 0).all()
    check_fetches(scene, atlas)
    assert sides_of(atlas, np.flatnonzero(scene._flat.objects == 0)) == 0.0


def test_duplicated_and_reversed_faces_have_texels_of_their_own():
    mesh = quad((0, 0, 0), (1, 0, 0), (0, 1, 0))
    indices = np.concatenate([mesh.indices, mesh.indices, mesh.indices[:, ::-1]])
    scene = scene_of(gi.Mesh(mesh.points, indices))
    atlas = make_atlas(scene, settings(resolution=64), "cpu")
    check_fetches(scene, atlas)
    assert (atlas.slots[1][atlas.slots[0] >= 0] >= 0).all()
    for face in range(6):
        assert (atlas.slot_faces == face).any()


def test_long_thin_triangles():
    sliver = gi.Mesh(np.array([[0, 0, 0], [1, 0, 0], [1, 1e-5, 0]], np.float32), np.array([[0, 1, 2]]))
    scene = scene_of(sliver, quad((0, 0, 1), (1, 0, 0), (0, 1, 0)))
    atlas = make_atlas(scene, settings(resolution=64), "cpu")
    faces, u, v = random_points(np.flatnonzero(atlas.face_pages >= 0), 40)
    slots, shares = fetched(atlas, faces, u, v)
    assert np.where(slots < 0, shares, 0.0).max() <= 1e-5


def test_what_moves_is_on_no_page():
    keys = [gi.Keyframe(0.0), gi.Keyframe(1.0, translation=(1, 0, 0))]
    nodes = [gi.Node("flyer", [ball((0, 2, 0), 0.5)], keyframes=keys), gi.Node("floor", [FLOOR])]
    scene = gi.Scene(nodes, environment=1.0)
    atlas = make_atlas(scene, settings(resolution=64), "cpu")
    moves = scene._flat.objects == 0
    assert (atlas.face_pages[moves] == -1).all() and (atlas.face_pages[~moves] == 0).all()
    check_fetches(scene, atlas)


def test_everything_moves():
    keys = [gi.Keyframe(0.0), gi.Keyframe(1.0, translation=(1, 0, 0))]
    scene = gi.Scene([gi.Node("flyer", [FLOOR], keyframes=keys)], environment=1.0)
    with pytest.raises(gi.SceneError, match="everything in this scene moves"):
        make_atlas(scene, settings(resolution=64), "cpu")


# ---- own uv ----


def with_uvs(mesh, uvs):
    return dataclasses.replace(mesh, uvs=np.asarray(uvs, np.float32))


SQUARE = [[0, 0], [1, 0], [1, 1], [0, 1]]


def test_own_uv_are_taken_where_fit():
    scene = scene_of(with_uvs(FLOOR, SQUARE), ball((0, 1, 0)))
    atlas = make_atlas(scene, settings(charts="auto"), "cpu")
    check_fetches(scene, atlas)
    own = atlas.corners[:2].reshape(-1, 2)
    assert atlas.charts[0] == atlas.charts[1] and not np.isin(atlas.charts[2:], atlas.charts[0]).any()
    assert np.ptp(own, axis=0).min() > 20


@pytest.mark.parametrize(
    ("uvs", "reason"),
    [
        (None, "has no uv"),
        (np.multiply(SQUARE, 1.2).tolist(), "has uv that leave 0..1"),
        ([[0, 0], [1, 0], [1, 1], [0.9, 0.1]], r"overlap on [0-9.]+ % of the texels"),
        (np.multiply(SQUARE, [1, 0]).tolist(), "uv without an area on 100 % of its surface"),
        ([[0, 0], [np.nan, 0], [1, 1], [0, 1]], "uv without an area on 50 % of its surface"),
    ],
)
def test_unfit_own_uv(uvs, reason):
    floor = dataclasses.replace(FLOOR, uvs=uvs and np.asarray(uvs, np.float32))
    scene = scene_of(ball((0, 1, 0), 0.2), ground=floor)
    with pytest.raises(gi.OptionError, match=rf"mesh 'floor' of node 'ground' .*{reason}"):
        make_atlas(scene_of(ground=floor), settings(charts="own"), "cpu")
    atlas = make_atlas(scene, settings(charts="auto"), "cpu")
    check_fetches(scene, atlas)


def test_own_uv_that_mirror_are_fit():
    scene = scene_of(with_uvs(FLOOR, [[1, 0], [0, 0], [0, 1], [1, 1]]))
    check_fetches(scene, make_atlas(scene, settings(charts="own", resolution=64), "cpu"))


def test_own_uv_with_stretched_islands_are_as_dense_as_others():
    a = quad((0, 0, 0), (1, 0, 0), (0, 1, 0))
    points = np.concatenate([a.points, np.add(a.points, [0, 0, 1])]).astype(np.float32)
    uvs = np.concatenate([np.multiply(SQUARE, [0.4, 0.1]), np.add(np.multiply(SQUARE, 0.3), 0.5)])
    mesh = with_uvs(gi.Mesh(points, np.concatenate([a.indices, a.indices + 4])), uvs)
    scene = scene_of(mesh)
    atlas = make_atlas(scene, settings(charts="own", resolution=64), "cpu")
    check_fetches(scene, atlas)
    sizes = texel_sizes(scene, atlas)
    assert sizes.max() / sizes.min() < 1.2 and atlas.charts.tolist() == [0, 0, 1, 1]


# ---- texel sets ----


def texel_counts(scene, atlas):
    return np.bincount(scene._flat.objects[atlas.slot_faces[atlas.slot_sides == 0]], minlength=len(scene.object_names))


def small_and_large():
    return scene_of(wall=quad((-20, 0, -2), (40, 0, 0), (0, 40, 0)), toy=ball((0, 1, 0), 0.2, rings=12))


def test_automatic_texel_sets_serve_small_parts():
    scene = small_and_large()
    one, auto = (make_atlas(scene, settings(texel_sets=name), "cpu") for name in ("one", "auto"))
    assert texel_counts(scene, auto)[1] > 3 * texel_counts(scene, one)[1]
    assert auto.pages[0, 1:].max() <= 128
    check_fetches(scene, auto)


@pytest.mark.parametrize("name", ["toy", "bit"])
def test_given_texel_sets(name):
    scene = small_and_large()
    scene.nodes[1].meshes[0].name = "bit"
    one, given = (make_atlas(scene, settings(texel_sets=s), "cpu") for s in ("one", f"{name}=4"))
    before, after = texel_sizes(scene, one), texel_sizes(scene, given)
    finer = np.median(before[2:] / after[2:]) / np.median(before[:2] / after[:2])
    assert finer == pytest.approx(4.0, rel=0.3)


@pytest.mark.parametrize(
    "text", ["", "all", "toy=", "toy=0", "toy=1e4", "toy=-1", "toy=nan", "=2", "toy=2,", "toy=2,wall"]
)
def test_bad_texel_sets(text):
    with pytest.raises(gi.OptionError, match="texel_sets must be"):
        parse_texel_sets(text)
    with pytest.raises(gi.OptionError, match="twice"):
        parse_texel_sets("toy=2,toy=3")


def test_unknown_name_in_texel_sets():
    scene = small_and_large()
    with pytest.raises(gi.OptionError, match=r"unknown node or mesh in texel_sets 'toys'.*'toy'.*known: .*wall"):
        density_factors(scene, "toys=2", np.ones(2), np.ones(2, int), 1 << 14)


def test_unknown_names_among_thousands_are_told_in_one_line():
    mesh = quad((0, 0, 0), (1, 0, 0), (0, 0, 1))
    scene = gi.Scene([gi.Node(f"chair {k}", [mesh]) for k in range(500)], environment=1.0)
    with pytest.raises(gi.OptionError, match=r"did you mean 'chair 49.*known: chair .* and [0-9]+ others") as told:
        density_factors(scene, "chairs 49=2", np.ones(500), np.ones(500, int), 1 << 14)
    assert len(str(told.value)) < 300


def test_automatic_factors_keep_to_their_share():
    areas, counts = np.array([100.0, 1.0, 0.0]), np.array([2, 40000, 0])
    factors = automatic_factors(areas, counts, 1 << 16)
    texels = areas * factors**2
    assert factors[0] == factors[2] == 1 and factors[1] > 3
    assert texels[1] / texels.sum() <= 0.3


# ---- time, size and the cache ----


def test_time_limit(monkeypatch):
    monkeypatch.setattr(charts.ChartJob, "run", RUN)
    scene = scene_of(ball(rings=90))
    with pytest.raises(gi.OptionError, match=r'chart_seconds=0.05 .*, take .*charts="own"\), or .*storage="vertices"'):
        make_atlas(scene, settings(chart_seconds=0.05), "cpu", otherwise=OTHERWISE)


def test_a_worker_that_fails(monkeypatch):
    monkeypatch.setattr(charts.ChartJob, "run", RUN)
    with pytest.raises(gi.OptionError, match=r"making charts by xatlas failed \(.+\); take the meshes' own uv"):
        charts.ChartJob(0.0).run({"size": np.array(3)})


def test_time_limit_by_the_clock(monkeypatch):
    """Where the system counts no CPU time, as on Windows, the worker is ended by the clock."""
    monkeypatch.delattr(chart_job.signal, "setitimer")
    monkeypatch.setattr(charts.ChartJob, "run", RUN)
    with pytest.raises(gi.OptionError, match=r"longer than chart_seconds=0\.05"):
        make_atlas(scene_of(ball(rings=90)), settings(chart_seconds=0.05), "cpu")


def test_an_interrupt_ends_the_worker(monkeypatch):
    monkeypatch.setattr(charts.ChartJob, "run", RUN)
    processes = []

    class Listed(subprocess.Popen):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            processes.append(self)

    def interrupt(share):
        raise KeyboardInterrupt

    monkeypatch.setattr(chart_job.subprocess, "Popen", Listed)
    with pytest.raises(KeyboardInterrupt):
        make_atlas(scene_of(ball(rings=6), FLOOR), settings(), "cpu", interrupt)
    assert [process.poll() is not None for process in processes] == [True]


def test_limits_are_shared_by_the_jobs_of_an_atlas(monkeypatch):
    monkeypatch.setattr(charts.ChartJob, "run", RUN)
    job = charts.ChartJob(100.0)
    points = np.random.default_rng(0).random((20, 3, 3))
    charts.cut_charts(points, np.zeros(20, np.int32), job, None)
    assert 0.0 < job.used < 100.0


def test_files_beside_the_worker_are_not_taken_for_modules(monkeypatch, tmp_path):
    """Neither in its folder nor in the one that this process is in, nor in one that a script here imports from."""
    monkeypatch.setattr(charts.ChartJob, "run", RUN)
    for folder in ("worker", "here", "script"):
        (tmp_path / folder).mkdir()
        for name in ("numpy", "types", "signal", "runpy", "xatlas"):
            (tmp_path / folder / f"{name}.py").write_text(f"raise ImportError('{folder}')")
    worker = tmp_path / "worker" / "chart_worker.py"
    worker.write_bytes(chart_job.WORKER.read_bytes())
    monkeypatch.setattr(chart_job, "WORKER", worker)
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.syspath_prepend(tmp_path / "script")
    charts.cut_charts(np.random.default_rng(5).random((4, 3, 3)), np.zeros(4, np.int32), charts.ChartJob(0.0), None)


def test_the_worker_imports_packages_from_where_this_process_does(monkeypatch, tmp_path):
    monkeypatch.setattr(charts.ChartJob, "run", RUN)
    (tmp_path / "xatlas.py").write_text("raise ImportError('found')")
    monkeypatch.setattr(chart_job.importlib.util, "find_spec", lambda name: None)
    assert chart_job._package_folders() == []
    monkeypatch.undo()
    folders = chart_job._package_folders()
    assert all((Path(folder) / "numpy").is_dir() or list(Path(folder).glob("xatlas*")) for folder in folders)
    assert len(folders) == 2


def soup(count):
    """Return a mesh of triangles that hang together nowhere."""
    points = np.random.default_rng(0).random((3 * count, 3)).astype(np.float32)
    return gi.Mesh(points, np.arange(3 * count).reshape(-1, 3))


@pytest.mark.parametrize("size", [16, 80])
def test_charts_that_do_not_fit(size, monkeypatch):
    """The error names a resolution that will do, and leaves charts half of the page."""
    monkeypatch.setattr(charts, "STEP", 4)
    scene = scene_of(soup(300))
    words = rf'resolution {size} is too small for the [0-9]+ charts .*: take about ([0-9]+), or .*charts="own"\)$'
    with pytest.raises(gi.OptionError, match=words) as told:
        make_atlas(scene, settings(resolution=size), "cpu")
    wanted = int(re.search("take about ([0-9]+)", str(told.value))[1])
    assert size < wanted <= 200
    atlas = make_atlas(scene, settings(resolution=wanted), "cpu")
    assert (atlas.face_pages == 0).all() and len(atlas.pages) == 1
    assert np.count_nonzero(atlas.slots[0] >= 0) > 0.4 * atlas.slots.shape[1]


def test_cache(monkeypatch, tmp_path):
    monkeypatch.undo()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    scene = scene_of(ball(rings=5))
    first = make_atlas(scene, settings(resolution=64), "cpu")
    files = sorted((tmp_path / "warp_gi" / "charts").iterdir())
    assert [path.name.split("-")[0] for path in files] == ["cut", "page"]
    with monkeypatch.context() as patch:
        patch.setattr(charts.ChartJob, "run", lambda *_: pytest.fail("the cache was not used"))
        second = make_atlas(scene, settings(resolution=64), "cpu")
    data = bytearray(files[0].read_bytes())
    data[len(data) // 2] ^= 1
    files[0].write_bytes(data)
    files[1].write_bytes(files[1].read_bytes()[:-100])
    with pytest.warns(UserWarning, match="is damaged .*charts are made again"):
        third = make_atlas(scene, settings(resolution=64), "cpu")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        fourth = make_atlas(scene, settings(resolution=64), "cpu")
    for again in (second, third, fourth):
        for field in dataclasses.fields(Atlas):
            assert np.array_equal(getattr(again, field.name), getattr(first, field.name)), field.name


def change(arrays, how):
    """Make one array another than a worker's could be."""
    name, how = how.split(": ")
    if how == "missing":
        del arrays[name]
    elif how == "NaN":
        arrays[name][1, 0] = np.nan
    elif how == "longer":
        arrays[name] = np.concatenate([arrays[name], arrays[name][:1]])
    elif how == "another type":
        arrays[name] = arrays[name].astype(np.float64)
    else:
        arrays[name].reshape(-1)[1] = float(how)


@pytest.mark.parametrize(
    "kind, how",
    [
        *[("cut", f"{name}: {how}") for name in ("uvs", "charts") for how in ("missing", "longer", "another type")],
        *[("page", f"{name}: missing") for name in ("corners", "is_placed", "page", "least")],
        *[("page", f"{name}: another type") for name in ("corners", "is_placed", "page")],
        ("cut", "uvs: NaN"),
        ("page", "corners: NaN"),
        ("page", "corners: 65.5"),
        ("page", "corners: -1"),
        ("page", "page: 100000"),
        ("cut", "charts: -2"),
        ("cut", "charts: 1000000"),
    ],
)
def test_whole_files_with_wrong_contents_are_made_again(monkeypatch, tmp_path, kind, how):
    monkeypatch.setattr(chart_cache, "cache_folder", lambda name: tmp_path)
    scene = scene_of(ball(rings=4))
    first = make_atlas(scene, settings(resolution=64), "cpu")
    (file,) = tmp_path.glob(f"{kind}-*.npz")
    with np.load(file) as stored:
        arrays = {name: array.copy() for name, array in stored.items()}
    change(arrays, how)
    np.savez(file, **arrays)
    with pytest.warns(UserWarning, match="is damaged .*charts are made again"):
        again = make_atlas(scene, settings(resolution=64), "cpu")
    assert np.array_equal(again.corners, first.corners)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_atlas(scene, settings(resolution=64), "cpu")


def test_files_that_another_process_removes_at_once(monkeypatch, tmp_path):
    """As it lists them, and as it removes them."""
    monkeypatch.setattr(chart_cache, "cache_folder", lambda name: tmp_path)
    monkeypatch.setattr(chart_cache, "MOST_BYTES", 10)
    for number in range(2):
        (tmp_path / f"{number}.npz").write_bytes(bytes(90 + number))
    stat, gone = Path.stat, []

    def raced(path, **options):
        found = None if path.name == "0.npz" else stat(path, **options)
        if path.suffix == ".npz" and path.exists() and path.name != "new.npz":
            path.unlink()
            gone.append(path.name)
        return found or stat(path, **options)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "exists", lambda path: os.path.exists(path))
        patch.setattr(Path, "stat", raced)
        prune(tmp_path, "*.npz", chart_cache.MOST_BYTES)
    assert sorted(gone) == ["0.npz", "1.npz"] and not list(tmp_path.iterdir())


def test_two_processes_that_bake_one_scene_at_once(tmp_path):
    """Both have the charts, the cache has them once, and nothing else is left there."""
    script = """
import sys
import numpy as np
from warp_gi.techniques.shared.atlas import charts
print("ready", flush=True)
sys.stdin.readline()
points = np.random.default_rng(0).random((40, 3, 3))
uvs, _ = charts.cut_charts(points, np.zeros(40, np.int32), charts.ChartJob(0.0), None)
print(float(np.abs(uvs).sum()))
"""
    pipe = subprocess.PIPE
    both = [
        subprocess.Popen(
            [sys.executable, "-W", "error", "-c", script], stdin=pipe, stdout=pipe, stderr=pipe, text=True,
            env={**os.environ, "XDG_CACHE_HOME": str(tmp_path)},
        )
        for _ in range(2)
    ]  # fmt: skip
    assert [process.stdout.readline() for process in both] == ["ready\n", "ready\n"]
    for process in both:
        process.stdin.write("go\n")
        process.stdin.flush()
    results = [process.communicate() for process in both]
    assert [process.returncode for process in both] == [0, 0], results
    assert results[0][0] == results[1][0] and float(results[0][0]) > 0
    assert [path.name[:4] for path in (tmp_path / "warp_gi" / "charts").iterdir()] == ["cut-"]


def test_a_cache_that_cannot_be_written(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(chart_cache, "cache_folder", lambda name: tmp_path / "file" / "charts")
    with pytest.warns(UserWarning, match="cannot be kept"):
        assert make_atlas(scene_of(ball(rings=4)), settings(resolution=64), "cpu").count > 0


def test_oldest_files_leave_a_full_cache(monkeypatch, tmp_path):
    monkeypatch.setattr(chart_cache, "cache_folder", lambda name: tmp_path)
    monkeypatch.setattr(chart_cache, "MOST_BYTES", 5000)
    for number in range(4):
        chart_cache.cached("cut", {"n": np.array(number)}, lambda: {"n": np.zeros(500, np.int32)})
    assert len(list(tmp_path.glob("*.npz"))) == 2


def test_progress_rises_to_1():
    told = []
    make_atlas(scene_of(ball(rings=6), FLOOR), settings(resolution=63), "cpu", told.append)
    assert told == sorted(told) and told[-1] == 1.0 and len(told) >= 4


def test_large_islands_are_split(monkeypatch):
    monkeypatch.setattr(charts, "MOST_FACES", 50)
    large, small = ball(rings=12), [ball((3 * k, 5, 0), rings=3) for k in range(5)]
    points = np.concatenate([mesh.points[mesh.indices] for mesh in (large, *small)])
    owner = np.repeat(np.arange(6), [len(mesh.indices) for mesh in (large, *small)])
    split = charts.split_parts(points.astype(np.float64), np.where(owner < 5, 4, 9))
    assert np.array_equal(np.unique(split), np.arange(split.max() + 1)) and np.bincount(split).max() <= 72
    for number in range(1, 6):
        assert len(np.unique(split[owner == number])) == 1
    assert not np.isin(split[owner == 5], split[owner < 5]).any()
    assert np.bincount(split[owner == 0]).max() <= 50


def test_islands():
    corners = np.array([[[0], [1], [2]], [[7], [8], [9]], [[2], [3], [4]], [[4], [5], [6]], [[9], [10], [11]]])
    assert islands(corners).tolist() == [0, 1, 0, 0, 1]
    assert islands(corners[:0]).shape == (0,)
