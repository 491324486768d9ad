"""Surface caches: what their cells hold, what paths read there, and when they are refused."""

from dataclasses import replace

import numpy as np
import pytest
import statistics_tools as st
from scene_tools import quad
from statistics_tools import every_device  # noqa: F401
from truth_tools import camera_in_box, closed_box, scene_of

import warp_gi as gi
from warp_gi import launch
from warp_gi.errors import BakeError, OptionError
from warp_gi.kernels.surface_cache_fill import fill_cells
from warp_gi.techniques.surface_cache import fill

SMALL = gi.SurfaceCache(paths=20_000)
TRACED = gi.Pipeline(environment=None, emitters=None, indirect=gi.BsdfPaths(max_depth=24), camera_samples=1)


def ending(cache: gi.SurfaceCache = SMALL, **settings) -> gi.Pipeline:
    return replace(TRACED, indirect=gi.BsdfPaths(ends_in=cache), **settings)


def baked(scene: gi.Scene, camera: gi.Camera | gi.CameraPath, cache: gi.SurfaceCache = SMALL) -> gi.Bake:
    return gi.bake(scene, cache, st.device().alias, camera=camera)


def indirect(scene: gi.Scene, camera: gi.Camera, pipeline: gi.Pipeline, bakes=(), seed: int = 5) -> np.ndarray:
    frame = next(gi.render(scene, camera, pipeline, [0], st.device().alias, seed, bakes=bakes))
    return frame.numpy("indirect").astype(np.float64)


def mean_of(bake: gi.Bake, first: int = 0) -> np.ndarray:
    """Return the mean over samples of irradiance (first 0) or of the exitance of lobes (first 4), float64 [3]."""
    rows = bake.arrays["cells"].astype(np.float64)
    return (rows[:, first : first + 3] * rows[:, 3:4]).sum(axis=0) / rows[:, 3].sum()


def cornell(width: int = 48, height: int = 48) -> tuple[gi.Scene, gi.Camera]:
    return gi.builtin_scene("cornell_box"), gi.builtin_camera_path("cornell_box").camera(0).at_resolution(width, height)


# ---- what cells hold ----


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a_white_furnace(scale):
    """Irradiance is pi / (1 - albedo) in every cell: paths without an end would leave it at 0.59 of that."""
    scene = scene_of(*(replace(mesh, points=mesh.points * np.float32(scale)) for mesh in closed_box(0.8, 1.0)))
    camera = gi.Camera.look_at(np.array([0.2, 0.1, 0.3]) * scale, np.array([1, 0.3, -0.2]) * scale, hfov=100)
    bake = baked(scene, camera, replace(SMALL, paths=60_000))
    np.testing.assert_allclose(mean_of(bake), 5 * np.pi, rtol=0.01)
    rows = bake.arrays["cells"]
    sampled = rows[rows[:, 3] > 1000]
    assert len(sampled) > 20 and np.abs(sampled[:, :3] / (5 * np.pi) - 1).max() < 0.02


@pytest.mark.parametrize(("vertices", "low", "high"), [(8, 0.975, 1.01), (1, 0.37, 0.45)])
def test_the_fewest_paths_leave_a_white_furnace_white(vertices, low, high):
    """Also its first passes have enough paths to fill the cells that later ones read.

    Of paths with one vertex all light but the direct one comes from there, if only of four reflections: with 30 paths a
    pass 0.31 of it arrives, with 250 0.41.
    """
    bake = baked(scene_of(*closed_box(0.8, 1.0)), camera_in_box(), gi.SurfaceCache(paths=1000, vertices=vertices))
    share = mean_of(bake) / (5 * np.pi)
    assert (share > low).all() and (share < high).all()


def test_a_launch_keeps_no_more_records_with_longer_paths(monkeypatch):
    """It takes fewer paths then, and cells do not depend on how many."""
    box, settings = scene_of(*closed_box(0.8, 1.0)), gi.SurfaceCache(paths=2000, vertices=16)
    expected, launched, run = baked(box, camera_in_box(), settings), [], launch.launch

    def counted(kernel, count, inputs, device):
        if kernel is fill_cells:
            launched.append((count, len(inputs[-1].keys)))
        run(kernel, count, inputs, device)

    monkeypatch.setattr(fill.launch, "launch", counted)
    monkeypatch.setattr(fill, "LAUNCH_RECORDS", 4800)
    bake = baked(box, camera_in_box(), settings)
    assert max(records for _, records in launched) == 4800 and sum(paths for paths, _ in launched) == 2000
    np.testing.assert_array_equal(bake.arrays["keys"], expected.arrays["keys"])
    np.testing.assert_allclose(bake.arrays["cells"], expected.arrays["cells"], rtol=1e-5)


def test_cells_hold_the_light_of_the_glossy_lobe():
    """Under light from everywhere its exitance is the irradiance times the lobe's albedo, averaged by cosine."""
    box = closed_box(0.0, 1.0)
    for mesh in box:
        mesh.material = replace(mesh.material, metallic=1.0, roughness=0.6, base_color=(0.9, 0.6, 0.3))
    bake = baked(scene_of(*box), camera_in_box())
    r, f0 = 0.6, np.array([0.9, 0.6, 0.3])
    scale = (((1.4419665 * r - 2.5984166) * r + 0.6431491) * r - 0.0300414) * r + 0.9512468
    offset = (((-0.2404349 * r + 0.5943225) * r - 0.4491881) * r + 0.0516552) * r + 0.0461039
    np.testing.assert_allclose(mean_of(bake, 4) / mean_of(bake), f0 * scale + offset, rtol=0.02)


def test_both_sides_of_a_sheet():
    """A sheet in sunlight is dark below: each side has cells of its own."""
    sheet = quad((-1, 0, 1), (2, 0, 0), (0, 0, -2))
    scene = scene_of(sheet, lights=[gi.PunctualLight("directional", intensity=(3.0, 2.0, 1.0), direction=(0, -1, 0))])
    views = [gi.Camera.look_at((0, y, 0.1), (0, 0, 0), hfov=60) for y in (2.0, -2.0)]
    bake = baked(scene, gi.CameraPath.from_cameras(views, times=[0.0, 1.0]), gi.SurfaceCache(paths=2_000))
    below = (bake.arrays["keys"] >> np.uint64(4) & np.uint64(1)).astype(bool)
    light = bake.arrays["cells"][:, :3]
    assert below.any() and (light[below] == 0).all()
    np.testing.assert_allclose(light[~below], np.tile([3.0, 2.0, 1.0], ((~below).sum(), 1)), rtol=1e-5)


def test_cells_under_many_lamps_hold_the_sum_of_their_light():
    """A black floor under sixty lamps, a few of which matter at each point: a sum in float64 at each cell's middle."""
    random = np.random.default_rng(8)
    places, powers = random.uniform([-4, 0.4, -4], [4, 1.5, 4], (60, 3)), random.uniform(0.1, 3.0, 60)
    lamps = [gi.PunctualLight("point", (i, i, i), tuple(p)) for p, i in zip(places, powers, strict=True)]
    floor = quad((-4, 0, 4), (8, 0, 0), (0, 0, -8), gi.Material("black", (0, 0, 0), specular=0.0))
    camera = gi.Camera.look_at((0, 9, 0.1), (0, 0, 0), hfov=60)
    bake = baked(scene_of(floor, lights=lamps), camera, gi.SurfaceCache(paths=60_000, cell=0.1, growth=0.0))
    keys, rows = bake.arrays["keys"], bake.arrays["cells"]
    smallest = (keys & np.uint64(15)) == 1
    x, z = (keys[smallest] >> np.uint64(shift) & np.uint64(0xFFFF) for shift in (39, 7))
    at = np.stack([x + 0.5, np.full(len(x), np.nan), z + 0.5], axis=1) * 0.1 + bake.arrays["low"]
    at[:, 1] = 0.0
    to = places - at[:, None]
    wanted = (powers * to[..., 1] / np.linalg.norm(to, axis=2) ** 3).sum(axis=1)
    found = rows[smallest, 0]
    assert len(found) > 3000
    assert found.sum() == pytest.approx(wanted.sum(), rel=0.01)
    assert np.sqrt(((found - wanted) ** 2).mean()) < 0.2 * wanted.mean()  # 0.96 by power alone


@pytest.mark.parametrize("settings", [{}, {"cell": 0.1}, {"capacity": 2000}, {"paths": 2000}])
@pytest.mark.filterwarnings("ignore:the surface cache is full")
def test_thin_walls_keep_light_in(settings):
    """Of two rooms with a wall of 2 cm between them, both in one bake, the dark one stays at 1 % of the lit one.

    So it is where most cells have no place, or hardly a sample.
    """
    scene = gi.builtin_scene("two_rooms")
    lit, dark = (scene.cameras[name].at_resolution(32, 24) for name in ("lit", "dark"))
    cache = gi.SurfaceCache(**{"paths": 60_000, **settings})
    bake = baked(scene, gi.CameraPath.from_cameras([lit, dark], times=[0.0, 1 / 24]), cache)
    light = [indirect(scene, camera, ending(cache, spp=64), [bake]).mean() for camera in (lit, dark)]
    assert light[0] > 0.1 and light[1] <= 0.01 * light[0]


# ---- what paths read ----


def test_pictures_have_the_mean_of_long_paths_and_less_noise():
    scene, camera = cornell()
    bake = baked(scene, camera, gi.SurfaceCache())
    reference = indirect(scene, camera, replace(TRACED, spp=1024), seed=9)
    frames = {}
    for name, pipeline, bakes in (("paths", TRACED, ()), ("cache", ending(gi.SurfaceCache()), [bake])):
        frames[name] = np.stack([indirect(scene, camera, replace(pipeline, spp=16), bakes, seed) for seed in range(8)])
        np.testing.assert_allclose(frames[name].mean(axis=(0, 1, 2)), reference.mean(axis=(0, 1)), rtol=0.04)
    noise = {name: images.var(axis=0, ddof=1).mean() for name, images in frames.items()}
    assert noise["cache"] < 0.5 * noise["paths"], noise


def test_a_mirror_shows_no_cells():
    """The edge of a shadow, seen in a mirror, is as sharp as by paths: cells are not read so near to it."""
    mirror = gi.Material("mirror", (0.9, 0.9, 0.9), metallic=1.0, roughness=0.03)
    floor = quad((-2, 0, 2), (4, 0, 0), (0, 0, -4))
    wall = quad((-2, 0, -1), (4, 0, 0), (0, 3, 0), mirror)
    lid = quad((0, 2, 2), (0, 0, -4), (2, 0, 0))
    sun = gi.PunctualLight("directional", intensity=(3.0, 3.0, 3.0), direction=(0, -1, 0))
    scene = scene_of(floor, wall, lid, lights=[sun])
    camera = gi.Camera.look_at((0, 0.9, 0.8), (0, 0.4, -1), hfov=40, resolution=(32, 24))
    cache = replace(SMALL, cell=0.3)
    bake = baked(scene, camera, cache)
    reference = indirect(scene, camera, replace(TRACED, spp=64))
    found = indirect(scene, camera, ending(cache, spp=64), [bake])
    assert reference[:, :12].mean() > 0.2 > 0.08 > reference[:, 20:].mean()
    assert np.sqrt(((found - reference) ** 2).mean()) < 0.04 * reference.mean()


def test_a_smooth_lobe_over_a_matt_base_is_traced_alone():
    """Plastic: cells know the light of the base, and the lobe's path must not bring it once more."""
    box = closed_box(0.6, 0.0)
    for number, mesh in enumerate(box):
        emission = (2.0 if number == 1 else 0.0,) * 3
        mesh.material = replace(mesh.material, specular=1.0, roughness=0.1, emission=emission)
    scene, camera = scene_of(*box), camera_in_box((24, 24))
    found = indirect(scene, camera, ending(spp=256), [baked(scene, camera)]).mean()
    assert found == pytest.approx(indirect(scene, camera, replace(TRACED, spp=512)).mean(), rel=0.02)


def test_an_empty_cache_changes_no_bit():
    """Where nothing is known paths go on, to the same light."""
    scene, camera = cornell(24, 24)
    bake = baked(scene, camera)
    arrays = bake.arrays | {"keys": bake.arrays["keys"][:0], "cells": bake.arrays["cells"][:0]}
    empty = replace(bake, arrays=arrays)
    found = indirect(scene, camera, ending(), [empty])
    np.testing.assert_array_equal(found, indirect(scene, camera, replace(TRACED, indirect=gi.BsdfPaths())))
    assert found.mean() > 0 and (found != indirect(scene, camera, ending(), [bake])).any()


def test_nothing_depends_on_the_number_of_threads():
    scene, camera = cornell(40, 24)
    found = []
    for threads in (1, 4):
        launch.set_threads(threads)
        try:
            bake = baked(scene, camera)
            found.append((bake.digest, indirect(scene, camera, ending(), [bake])))
        finally:
            launch.set_threads(None)
    assert found[0][0] == found[1][0]
    np.testing.assert_array_equal(found[0][1], found[1][1])


def test_a_saved_bake_gives_the_same_picture(tmp_path):
    scene, camera = cornell(24, 24)
    bake = baked(scene, camera)
    loaded = gi.load_bake(bake.save(tmp_path / "cells.safetensors"))
    np.testing.assert_array_equal(
        indirect(scene, camera, ending(), [loaded]), indirect(scene, camera, ending(), [bake])
    )
    assert ending().dependence(scene).kind == "independent"


def test_the_preset_ends_paths_in_a_surface_cache():
    assert gi.Pipeline.preset("cache").indirect == gi.BsdfPaths(ends_in=gi.SurfaceCache())


# ---- what is refused, and what is told ----


def test_a_bake_of_another_scene_or_setting_is_refused():
    scene, camera = cornell(8, 8)
    bake = baked(scene, camera)
    with pytest.raises(BakeError, match="this bake has other settings \\(vertices: bake has 8, asked for 4\\)"):
        indirect(scene, camera, ending(replace(SMALL, vertices=4)), [bake])
    scene.environment = 0.5
    with pytest.raises(BakeError, match="what it depends on has changed since; bake it again"):
        indirect(scene, camera, ending(), [bake])


@pytest.mark.parametrize("name", ["keys", "cells", "boxes", "side", "low", "cameras"])
def test_a_bake_that_does_not_fit_together_is_refused(name):
    scene, camera = cornell(8, 8)
    bake = baked(scene, camera)
    array = bake.arrays[name]
    kinds = [array[..., None], array.reshape(-1)[0], array.astype(np.float64)]
    if name != "cameras":  # a bake with the cameras of no frame fits together, if to none
        kinds.append(array[:0])
    if name != "keys":
        for value in (np.nan, np.inf):
            kinds.append(array.copy())
            kinds[-1].reshape(-1)[-1] = value
    without = {other: values for other, values in bake.arrays.items() if other != name}
    for arrays in (without, *(bake.arrays | {name: np.asarray(other)} for other in kinds)):
        broken = replace(bake, arrays=arrays)
        for check in (lambda b: SMALL.check_view(b, camera), lambda b: SMALL.start(scene, st.device().alias, b)):
            with pytest.raises(BakeError, match="does not hold a surface cache that fits together: bake again"):
                check(broken)
        with pytest.raises(BakeError, match="does not hold a surface cache that fits together: bake again"):
            indirect(scene, camera, ending(), [broken])


def test_another_camera_is_told():
    scene, camera = cornell(8, 8)
    bake = baked(scene, camera)
    turned = gi.Camera.look_at(camera.position, (1, 0.5, 0), resolution=(8, 8))
    with pytest.warns(UserWarning, match="of another camera path: where it has no cells, paths go on"):
        indirect(scene, turned, ending(), [bake])


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a_camera_that_moved_by_a_cell_is_told_at_any_scale(scale, recwarn):
    scene = scene_of(*(replace(mesh, points=mesh.points * np.float32(scale)) for mesh in closed_box(0.5, 1.0)))
    at, side = np.array([0.2, 0.1, 0.3]) * scale, 0.0
    bake = gi.Bake("SurfaceCache", "", {}, {})
    for step in (0.0, 0.001, 1.0):
        camera = gi.Camera.look_at(at + step * side, at + step * side + np.array([1, 0.3, -0.2]) * scale, hfov=100)
        if not side:
            bake = baked(scene, camera, gi.SurfaceCache(paths=1000))
            side = float(bake.arrays["side"][0])
        recwarn.clear()
        SMALL.check_view(bake, camera)
        assert len(recwarn) == (step == 1.0)


def test_a_full_cache_says_so_and_keeps_what_was_sampled_most():
    scene, camera = cornell(8, 8)
    with pytest.warns(
        UserWarning, match="is full: it keeps 100 cells, .* blurred over larger cells there, and may leak"
    ):
        bake = baked(scene, camera, replace(SMALL, capacity=100))
    whole = baked(scene, camera).arrays["cells"]
    assert len(bake.arrays["keys"]) == 100
    assert bake.arrays["cells"][:, 3].min() > np.median(whole[:, 3])


def test_a_fill_needs_a_camera():
    scene = scene_of(*closed_box(0.5, 1.0))
    with pytest.raises(OptionError, match="no camera is known: give a camera"):
        gi.bake(scene, SMALL)
    assert len(baked(gi.builtin_scene("cornell_box"), None).arrays["keys"]) > 100  # its own cameras


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"paths": 999}, "paths must be a whole number from 1000 to"),
        ({"vertices": 65}, "vertices must be a whole number from 1 to 64"),
        ({"cell": -1.0}, "cell must be finite and not negative, got -1"),
        ({"growth": float("nan")}, "growth must be finite"),
        ({"refresh": 999}, "refresh must be a whole number from 1000 to"),
        ({"memory": 1.0}, "memory must be a weight from 0 to 0.99, got 1.0"),
        ({"traced_below": 1.5}, "traced_below must be a roughness from 0 to 1, got 1.5"),
    ],
)
def test_settings_out_of_range(settings, told):
    with pytest.raises(OptionError, match=told):
        gi.SurfaceCache(**settings)
