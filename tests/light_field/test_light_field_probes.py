"""The estimator of light field probes: what is baked, how it is read, and what reaches the picture."""

import math
import re
import warnings
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from scene_tools import light, quad, sphere

import warp_gi as gi
from warp_gi import launch
from warp_gi.kernels import denoise as denoise_kernels
from warp_gi.kernels import light_field as field_kernels
from warp_gi.kernels import light_field_bake as bake_kernels
from warp_gi.kernels import light_field_trace as trace_kernels
from warp_gi.kernels.bsdf import bsdf_sample, make_bsdf
from warp_gi.kernels.sampling import sample_1d, sample_2d
from warp_gi.kernels.surface import Surface
from warp_gi.techniques.light_field import state as light_field_state
from warp_gi.techniques.light_field.export import unpack_distance, unpack_radiance
from warp_gi.techniques.light_field.pictures import draw_seen, probes_in_sight
from warp_gi.techniques.light_field.places import (
    INSET,
    ProbeGrid,
    lit_bounds,
    place_grid,
    probe_grid,
    relocate,
)
from warp_gi.techniques.light_field.settings import map_resolution
from warp_gi.techniques.light_field.state import ProbeState, low_directions
from warp_gi.techniques.shared.lamps import lit_data

wp.set_module_options({"enable_backward": False})

CPU = launch.get_device("cpu")
SMALL = {"counts": (2, 2, 2), "resolution": 32, "irradiance_resolution": 16, "rays": 1}


def walls(material, size=2.0):
    """The six sides of a cube about the origin, fronts inward."""
    h, e = size / 2, size
    corners = (
        ((-h, -h, h), (e, 0, 0), (0, 0, -e)),
        ((-h, h, -h), (e, 0, 0), (0, 0, e)),
        ((-h, -h, -h), (e, 0, 0), (0, e, 0)),
        ((h, -h, h), (-e, 0, 0), (0, e, 0)),
        ((-h, -h, h), (0, 0, -e), (0, e, 0)),
        ((h, -h, -h), (0, 0, e), (0, e, 0)),
    )
    return [quad(*corner, material, f"wall{i}") for i, corner in enumerate(corners)]


def room(albedo, emission, *more, **scene):
    material = gi.Material("wall", (albedo,) * 3, specular=0.0, emission=(emission,) * 3)
    return gi.Scene([gi.Node("room", [*walls(material), *more])], name="room", **scene)


def lamp_room(*more, albedo=0.6, **scene):
    lamp = quad((-0.3, 0.95, -0.3), (0.6, 0, 0), (0, 0, 0.6), light((8.0, 6.0, 4.0)), "lamp")
    return room(albedo, 0.0, lamp, *more, **scene)


def view(resolution=(24, 16)):
    return gi.Camera.look_at((0.1, 0.1, 0.7), (0, -0.1, -1), hfov=70, resolution=resolution)


def indirect_only(spp=1, **settings):
    return gi.Pipeline(environment=None, emitters=None, indirect=gi.LightFieldProbes(**settings), spp=spp)


def indirect(scene, camera=None, spp=1, bakes=(), frames=1, seed=1, **settings):
    scheduler = gi.FrameScheduler(scene, camera or view(), indirect_only(spp, **settings), seed=seed, bakes=bakes)
    return [scheduler.frame(index).numpy("indirect") for index in range(frames)][-1]


# ---- texels ----


@wp.kernel
def repack(
    first: wp.int32,
    colors: wp.array(dtype=wp.vec3),
    distances: wp.array(dtype=wp.float32),
    normals: wp.array(dtype=wp.vec3),
):
    i = first + wp.tid()
    colors[i] = field_kernels.unpack_radiance(field_kernels.pack_radiance(colors[i]))
    surfel = field_kernels.pack_surfel(distances[i], normals[i])
    distances[i] = field_kernels.surfel_distance(surfel)
    normals[i] = field_kernels.surfel_normal(surfel)


def test_texels_keep_radiance_distance_and_normal():
    rng = np.random.default_rng(1)
    count = 20000
    colors = (10 ** rng.uniform(-3, 4.5, (count, 1)) * rng.random((count, 3))).astype(np.float32)
    distances = (10 ** rng.uniform(-3, 4.8, count)).astype(np.float32)
    normals = rng.normal(size=(count, 3)).astype(np.float32)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    colors[0], colors[1], distances[:2] = 0, 1e9, (np.inf, 0)
    normals[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    arrays = [wp.array(v, dtype=t, device=CPU) for v, t in ((colors, wp.vec3), (distances, float), (normals, wp.vec3))]
    launch.launch(repack, count, arrays, CPU)
    got_colors, got_distances, got_normals = (array.numpy() for array in arrays)
    error = np.abs(got_colors - colors).max(axis=1) / np.maximum(colors.max(axis=1), 1e-9)
    assert error[2:].max() < 1 / 500 and not got_colors[0].any() and got_colors[1].min() == 65408
    with np.errstate(over="ignore"):
        halves = distances.astype(np.float16).astype(np.float32)
    halves[np.isinf(halves)] = np.where(np.isinf(distances[np.isinf(halves)]), 65536, 65504)
    np.testing.assert_array_equal(got_distances, halves)
    assert np.degrees(np.arccos(np.clip((got_normals * normals).sum(axis=1), -1, 1))).max() < 1.0
    np.testing.assert_allclose(got_normals[:6], normals[:6], atol=1e-6)  # walls and floors are stored as they are


def test_solid_angles_of_texels_fill_the_sphere():
    for resolution in (16, 64):
        table = low_directions(resolution).astype(np.float64)
        np.testing.assert_allclose(np.linalg.norm(table[:, :3], axis=1), 1, atol=1e-6)
        np.testing.assert_allclose(table[:, 3].sum(), 4 * np.pi, rtol=30 / resolution**2)
        np.testing.assert_allclose((table[:, :3] * table[:, 3:]).sum(axis=0), 0, atol=1e-5)


# ---- the grid ----


def test_grid_follows_counts_and_spacing():
    bounds = np.array([[0, 0, 0], [8, 2, 4]], np.float32)
    assert probe_grid(bounds, (3, 1, 2), 0.0, 16).counts == (3, 1, 2)
    assert probe_grid(bounds, (0, 0, 0), 1.0, 16).counts == (8, 2, 4)
    assert probe_grid(bounds, (5, 0, 0), 1.0, 16).counts == (5, 2, 4)
    assert probe_grid(bounds, (4, 0, 0), 0.0, 16, 1).counts == (4, 2, 2)  # what is given is given
    assert probe_grid(bounds, (0, 0, 0), 0.0, 16).counts == (12, 3, 6)  # a twelfth of the longest side
    automatic = probe_grid(bounds, (0, 0, 0), 0.0, 16, 80)
    assert 50 <= automatic.probe_count <= 80 and min(automatic.counts) >= 2
    positions = automatic.positions()
    assert (positions > bounds[0]).all() and (positions < bounds[1]).all()
    np.testing.assert_allclose(positions.mean(axis=0), [4, 1, 2])
    assert (np.diff(positions[: automatic.counts[0], 0]) > 0).all()  # x is fastest
    with pytest.raises(gi.OptionError, match=r"probes of 1024 x 1024 texels are more than"):
        probe_grid(bounds, (0, 0, 0), 0.01, 1024)


def test_probes_inside_of_something_are_left_out_or_moved():
    block = sphere((0.5, 0.5, 0.5), 0.42, gi.Material("block", (0.5, 0.5, 0.5), specular=0.0))
    scene = lamp_room(block)
    kept = gi.bake(scene, gi.LightFieldProbes(**SMALL, relocate=False)).arrays
    assert kept["states"].tolist() == [0] * 7 + [1]
    moved = gi.bake(scene, gi.LightFieldProbes(**SMALL, relocate=True)).arrays
    assert not moved["states"].any()
    home, place = kept["positions"][7], moved["positions"][7]
    assert np.linalg.norm(home - 0.5) < 0.42 < np.linalg.norm(place - 0.5) and np.abs(place).max() < 1
    assert (np.abs(place - home) <= 0.5 * moved["grid_spacing"] + 1e-6).all()


def dark_room_beside():
    """A lit room, and a dark one beside it behind a wall; a shed outside, which only widens the scene's bounds."""
    wall = gi.Material("wall", (0.6,) * 3, specular=0.0)
    dark = [replace(mesh, points=mesh.points + np.float32([2, 0, 0])) for mesh in walls(wall)]
    return [*lamp_room().nodes, gi.Node("dark", dark), gi.Node("shed", [sphere((9, 0, 0), 0.5, wall)])]


def grid_of(scene, camera=None, **settings):
    return place_grid(scene, gi.LightFieldProbes(**settings).probe_settings, camera, CPU)


def box_of(grid, more=0.0):
    """The box that a grid fills, wider by a share of its cells."""
    last = grid.low + grid.spacing * (np.array(grid.counts) - 1)
    return grid.low - (INSET + more) * grid.spacing, last + (INSET + more) * grid.spacing


def test_without_a_camera_the_grid_fills_the_space_that_is_lit():
    nodes = dark_room_beside()
    size = 10.5 / 24  # of a slab along x
    room = lit_bounds(gi.Scene(nodes), CPU)
    assert abs(room[1, 0] - 1) < size + 0.01 and (np.abs(room[:, 1:]) < 1.01).all() and room[0, 0] < -0.99
    carried = gi.Node(
        "lamp", lamp_room().nodes[0].meshes[-1:], keyframes=[gi.Keyframe(0.0), gi.Keyframe(1.0, (2, 0, 0))]
    )
    moving = gi.Scene([*nodes, carried])
    np.testing.assert_allclose(lit_bounds(moving, CPU), moving.bounds)
    unlit = gi.Scene([nodes[1]])
    np.testing.assert_allclose(lit_bounds(unlit, CPU), unlit.bounds)
    grid = grid_of(gi.Scene(nodes))
    np.testing.assert_allclose(box_of(grid), room)
    assert 80 < grid.probe_count <= 128


def test_the_grid_is_where_the_camera_is_over_its_whole_path():
    """In the dark room if it looks there, in both if it goes from one to the other, whichever frames are rendered."""
    nodes = dark_room_beside()
    lit, dark = gi.Camera.look_at((0.1, 0, 0.8), (0, 0, 0)), gi.Camera.look_at((2.1, 0, 0.8), (2, 0, 0))
    low, high = box_of(grid_of(gi.Scene(nodes), dark))
    np.testing.assert_allclose([low, high], [[1, -1, -1], [3, 1, 1]], atol=0.03)
    both = gi.CameraPath.from_cameras([lit, dark], times=[0.0, 4.0])
    low, high = box_of(grid_of(gi.Scene(nodes), both))
    np.testing.assert_allclose([low, high], [[-1, -1, -1], [3, 1, 1]], atol=0.03)
    named = gi.Scene(nodes, cameras={"lit": lit, "dark": dark})  # the scene's own cameras, if none is given
    np.testing.assert_allclose(box_of(grid_of(named)), [low, high], atol=0.03)
    scheduler = gi.FrameScheduler(gi.Scene(nodes), both.at_resolution(8, 6), indirect_only(**SMALL))
    scheduler.frame(0)
    np.testing.assert_allclose(scheduler.state("indirect").grid.low, grid_of(gi.Scene(nodes), both, **SMALL).low)


@pytest.mark.parametrize("zenith", [1.0, 150.0])
@pytest.mark.parametrize("target", [(1.5, 1.2, 0.3), (0.2, 9.0, 0.1)], ids=["across", "up"])
def test_the_grid_holds_all_that_a_camera_on_the_floor_of_a_court_sees(zenith, target):
    """Whatever light there is above: each first hit lies in the box."""
    sides = [mesh for mesh in walls(gi.Material("wall", (0.5,) * 3, specular=0.0)) if mesh.name != "wall1"]
    court = [replace(mesh, points=(mesh.points + np.float32([0, 1, 0])) * np.float32([2, 5, 2])) for mesh in sides]
    sky = np.ones((16, 32, 3), np.float32)
    sky[:2] = zenith
    scene = gi.Scene([gi.Node("court", court)], environment=gi.Environment(pixels=sky))
    camera = gi.Camera.look_at((-1.2, 0.6, -0.9), target, up=(0.1, 1, 0), hfov=70, resolution=(64, 36))
    low, high = box_of(grid_of(scene, camera), 1e-4)
    frame = next(gi.render(scene, camera, gi.Pipeline.preset("direct", spp=1)))
    seen = frame.numpy("position")[np.isfinite(frame.numpy("depth"))]
    assert len(seen) > 500
    assert ((seen > low) & (seen < high)).all()


def test_a_large_ground_does_not_stretch_the_grid():
    """A room with a door on a plane of 222 m: seen from inside, and from outside."""
    wall = gi.Material("wall", (0.6,) * 3, specular=0.0)
    sides = [mesh for mesh in walls(wall, 4.0) if mesh.name != "wall3"]
    door = quad((-2, -2, 2), (3, 0, 0), (0, 4, 0), wall), quad((1, 0.5, 2), (1, 0, 0), (0, 1.5, 0), wall)
    ground = quad((-111, -2.01, 111), (222, 0, 0), (0, 0, -222), wall, "ground")
    scene = gi.Scene([gi.Node("all", [*sides, *door, ground])], environment=1.0)
    inside = grid_of(scene, gi.Camera.look_at((-1, 0, -1.5), (1, -0.2, 1.5)))
    low, high = box_of(inside)
    assert (high - low).max() < 9 and (low < [-1.9, -1.9, -1.9]).all() and inside.probe_count <= 440
    outside = grid_of(scene, gi.Camera.look_at((7, 1, 9), (0, -1, 0)))
    low, high = box_of(outside)
    assert 10 < (high - low).max() < 80 and outside.probe_count <= 440
    assert grid_of(scene).probe_count <= 128


def test_rooms_have_fewer_probes_of_finer_maps():
    court = gi.Scene([gi.Node("court", walls(gi.Material("wall", (0.5,) * 3))[2:])])
    closed, open_ended = grid_of(lamp_room(), view()), grid_of(court, view())
    assert 50 < closed.probe_count <= 100 < open_ended.probe_count <= 440
    assert map_resolution(0, closed.probe_count) == 128 and map_resolution(0, open_ended.probe_count) == 64
    assert map_resolution(32, 8) == 32


def test_telling_what_a_bake_takes_changes_nothing_of_it(monkeypatch):
    """Probes are filled on trial to foretell the seconds; what they hold afterwards is the same to the last bit."""
    settings = gi.LightFieldProbes(counts=(3, 2, 3), resolution=128, irradiance_resolution=8, rays=1, bounces=2)
    told = gi.bake(lamp_room(), settings, camera_path=view())
    monkeypatch.setattr(light_field_state, "ANNOUNCED_TEXELS", math.inf)
    untold = gi.bake(lamp_room(), settings, camera_path=view())
    assert 18 * 128**2 > 1 << 18 and told.digest == untold.digest and told.counts == untold.counts


def test_a_bake_tells_what_it_takes_before_it_starts(caplog):
    told = []
    with caplog.at_level("INFO", "warp_gi"):
        gi.bake(
            lamp_room(),
            gi.LightFieldProbes(rays=1, bounces=1),
            camera_path=view(),
            progress=lambda stage, share: told.append(len(caplog.messages)),
        )
    (line,) = caplog.messages
    assert re.fullmatch(r"probes: 4 x 4 x 4 of 128 x 128 texels, [\d. x]+ m apart; \d+ MB, about \d+ s to bake", line)
    assert told[0] == 1


def test_probes_at_the_border_move_into_the_light():
    """Those in the dark behind a partition come out; by no more than half a cell, and no others move."""
    wall = gi.Material("wall", (0.6,) * 3, specular=0.0)
    sides = quad((0.68, -1, -1), (0, 0, 2), (0, 2, 0), wall), quad((0.72, -1, 1), (0, 0, -2), (0, 2, 0), wall)
    scene = lamp_room(*sides)
    settings = gi.LightFieldProbes(**SMALL)
    state = ProbeState(scene, CPU, settings.probe_settings, 1)
    grid = ProbeGrid(np.array([-0.52, -0.5, -0.5]), np.array([1.4, 1.0, 1.0]), (2, 2, 2))
    state.field.positions = wp.array(grid.positions().astype(np.float32), dtype=wp.vec3, device=CPU)
    relocate(scene, lit_data(scene, CPU), grid, state.field, CPU)
    moved = state.field.positions.numpy() - grid.positions()
    np.testing.assert_allclose(moved[0::2], 0, atol=1e-6)
    assert (moved[1::2, 0] < -0.2).all() and (moved[1::2, 0] >= -0.7 - 1e-6).all()


# ---- what probes hold ----


def test_maps_of_an_empty_room_are_its_walls():
    """Distances are those of a cube, normals point inward, and nothing is reflected of no light."""
    bake = gi.bake(room(0.5, 0.0), gi.LightFieldProbes(**{**SMALL, "counts": (1, 1, 1)}, relocate=False))
    directions = low_directions(32)[:, :3]
    np.testing.assert_allclose(bake.arrays["positions"][0], 0, atol=1e-6)
    expected = 1 / np.abs(directions).max(axis=1)
    surfels = bake.arrays["surfels"]
    distances = (surfels & 0x7FFF).astype(np.uint16).view(np.float16).astype(np.float64)
    np.testing.assert_allclose(distances, expected, rtol=1e-3)
    assert not bake.arrays["radiance"].any() and not bake.arrays["irradiance"].any()


@pytest.mark.parametrize("albedo", [0.3, 0.7])
def test_white_furnace_converges_to_the_geometric_series(albedo):
    """Walls of emission 1: a / (1 - a) is reflected, and a times that is the indirect term."""
    scene = room(albedo, 1.0)
    settings = {**SMALL, "bounces": 200, "tolerance": 1e-4, "rays": 4}
    bake = gi.bake(scene, gi.LightFieldProbes(**settings))
    reflected = albedo / (1 - albedo)
    np.testing.assert_allclose(bake.arrays["irradiance"], np.pi * reflected, rtol=0.02)
    for mode in ("irradiance", "traced"):
        image = indirect(scene, spp=4, bakes=[bake], mode=mode, **settings)
        assert abs(image.mean() / (albedo * reflected) - 1) < 0.02


def test_energy_never_grows_from_bounce_to_bounce():
    bake = gi.bake(lamp_room(albedo=0.9), gi.LightFieldProbes(**SMALL, bounces=12, tolerance=0.0))
    changes = [bake.counts[f"change_{number}"] for number in range(1, 13)]
    assert changes[0] == 1 and (np.diff(changes) < 0).all() and changes[-1] > 0


def test_filters_keep_constants():
    """Moments of a constant distance are that distance and its square; irradiance of constant light is pi times it."""
    scene = room(0.5, 1.0)
    settings = gi.LightFieldProbes(**{**SMALL, "counts": (1, 1, 1)}, bounces=1)
    state = ProbeState(scene, CPU, settings.probe_settings, 1)
    work = state._work(np.array([0]), 1, scene, with_emission=False)
    state._trace(lit_data(scene, CPU), work, np.array([0]))
    work.light.fill_(wp.vec3(0.25, 0.5, 4.0))
    work.distances.fill_(wp.vec2(1.5, 2.25))
    size = settings.irradiance_resolution**2
    for kernel in (bake_kernels.filter_light, bake_kernels.filter_distances):
        launch.launch(kernel, size, [state.field, work], CPU)
    np.testing.assert_allclose(state.field.irradiance.numpy(), np.pi * np.array([[0.25, 0.5, 4.0]] * size), rtol=1e-5)
    np.testing.assert_allclose(state.field.moments.numpy(), [[1.5, 2.25]] * size, rtol=1e-5)


def test_emission_is_kept_apart():
    scene = lamp_room()
    bake = gi.bake(scene, gi.LightFieldProbes(**SMALL))
    texels = bake.arrays["emission_texels"]
    assert len(texels) and (np.diff(texels) > 0).all()
    assert (bake.arrays["surfels"][texels] >> 15 & 1).all()
    assert (bake.arrays["surfels"] >> 15 & 1).sum() == len(texels)
    dark = gi.bake(room(0.5, 0.0), gi.LightFieldProbes(**SMALL))
    assert not len(dark.arrays["emission_texels"])


# ---- what is read between probes ----


@wp.kernel
def weigh(
    first: wp.int32,
    field: field_kernels.LightField,
    positions: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    light: wp.array(dtype=wp.vec3),
):
    i = first + wp.tid()
    light[i] = field_kernels.irradiance_at(field, positions[i], normals[i])


@pytest.mark.parametrize("weights", ["visibility", "trilinear"])
def test_weights_sum_to_one(weights):
    """Where all probes agree, what is read is what they say, everywhere in the room and whatever sees what."""
    block = sphere((0.3, -0.2, 0.1), 0.4, gi.Material("block", (0.5, 0.5, 0.5), specular=0.0))
    settings = gi.LightFieldProbes(**SMALL, weights=weights)
    scene = lamp_room(block)
    state = ProbeState(scene, CPU, settings.probe_settings, 1, gi.bake(scene, settings))
    state.field.irradiance.fill_(wp.vec3(1.0, 2.0, 3.0))
    rng = np.random.default_rng(2)
    normals = rng.normal(size=(2000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    arrays = [wp.array(v.astype("f4"), dtype=wp.vec3, device=CPU) for v in (rng.uniform(-0.9, 0.9, (2000, 3)), normals)]
    light = wp.zeros(2000, dtype=wp.vec3, device=CPU)
    launch.launch(weigh, 2000, [state.field, *arrays, light], CPU)
    values = light.numpy()
    outside = np.linalg.norm(arrays[0].numpy() - [0.3, -0.2, 0.1], axis=1) > 0.45
    seen = values.any(axis=1)
    assert seen[outside].mean() > 0.99
    np.testing.assert_allclose(values[seen], [[1, 2, 3]] * int(seen.sum()), rtol=1e-5)


def test_light_does_not_leak_into_the_dark_room():
    """Visibility keeps the dark room of two dark, where plain trilinear weights light it."""
    scene = gi.builtin_scene("two_rooms")
    means = {}
    for weights in ("visibility", "trilinear"):
        settings = {"weights": weights, "resolution": 64, "rays": 1, "mode": "irradiance", "counts": (8, 3, 4)}
        bake = gi.bake(scene, gi.LightFieldProbes(**settings), seed=1)
        for name in ("lit", "dark"):
            camera = scene.cameras[name].at_resolution(48, 32)
            means[weights, name] = float(indirect(scene, camera, bakes=[bake], **settings).mean())
    assert means["visibility", "dark"] < 0.01 * means["visibility", "lit"]
    assert means["trilinear", "dark"] > 0.1 * means["trilinear", "lit"]


def test_modes_agree_with_the_path_tracer():
    """The error of each mode in a simple room is small, and falls as there are more probes."""
    scene = lamp_room()
    camera = view((32, 24))
    paths = gi.Pipeline(environment=None, emitters=None, indirect=gi.BsdfPaths(max_depth=64), spp=1024)
    reference = next(gi.render(scene, camera, paths, seed=5)).numpy("indirect")
    errors = {}
    for mode in ("irradiance", "traced"):
        for count in (2, 4):
            settings = {**SMALL, "counts": (count,) * 3, "resolution": 64, "mode": mode, "rays": 4}
            image = indirect(scene, camera, spp=256, **settings)
            errors[mode, count] = gi.metrics.rmse(image, reference) / reference.mean()
            assert abs(image.mean() / reference.mean() - 1) < 0.12 / (count / 2) ** 0.5, (mode, count)
    assert errors["irradiance", 2] < 0.2 and errors["irradiance", 4] < 0.8 * errors["irradiance", 2]
    assert errors["traced", 2] < 0.1 and errors["traced", 4] < 0.1


def test_glossy_surfaces_reflect_what_probes_saw():
    """A mirror shows the room's lit floor; the mode "irradiance" cannot."""
    mirror = quad((-0.8, -0.8, -0.95), (1.6, 0, 0), (0, 1.6, 0), gi.Material("m", (1, 1, 1), metallic=1, roughness=0.1))
    scene, camera = lamp_room(mirror), view((32, 24))
    paths = gi.Pipeline(environment=None, emitters=None, indirect=gi.BsdfPaths(max_depth=64), spp=512)
    frame = next(gi.render(scene, camera, paths, seed=5))
    on_mirror = frame.numpy("albedo")[..., 0] > 0.95
    reference = frame.numpy("indirect")[on_mirror]
    settings = {**SMALL, "resolution": 128, "rays": 4}
    errors = {
        mode: gi.metrics.rmse(indirect(scene, camera, spp=64, mode=mode, **settings)[on_mirror], reference)
        for mode in ("irradiance", "hybrid", "traced")
    }
    assert max(errors["hybrid"], errors["traced"]) < 0.5 * errors["irradiance"], errors


@pytest.mark.parametrize("visibility", ["probes", "exact"])
def test_a_room_behind_a_wall_stays_dark_at_default_settings(visibility):
    """One bake for both of two rooms, of which one is lit: mean light of the dark one over that of the other."""
    scene = gi.builtin_scene("two_rooms")
    bake = gi.bake(scene, gi.LightFieldProbes(), seed=1)
    views = {name: scene.cameras[name].at_resolution(64, 40) for name in ("lit", "dark")}
    images = {name: indirect(scene, view, bakes=[bake], visibility=visibility) for name, view in views.items()}
    dark, lit = images["dark"].mean(), images["lit"].mean()
    assert dark < {"probes": 0.015, "exact": 0.006}[visibility] * lit
    paths = gi.Pipeline(environment=None, emitters=None, spp=64)
    truth = next(gi.render(scene, views["lit"], paths, seed=5)).numpy("indirect").mean()
    assert abs(lit / truth - 1) < 0.08


@pytest.mark.parametrize("mode", ["irradiance", "hybrid"])
def test_paths_are_traced_where_no_probe_sees(mode):
    """A bake for one end of a hall, seen at the other: a line says so, and the picture is that of the path tracer."""
    wall = gi.Material("wall", (0.6,) * 3, roughness=0.7)
    hall = [replace(mesh, points=mesh.points * np.float32([1, 1, 12])) for mesh in walls(wall)]
    lamps = [quad((-0.3, 0.95, z), (0.6, 0, 0), (0, 0, 0.6), light((8, 6, 4)), "lamp") for z in (-10.5, 10.0)]
    screen = quad((-1, -1, 0), (2, 0, 0), (0, 2, 0), wall), quad((1, -1, 0.05), (-2, 0, 0), (0, 2, 0), wall)
    scene = gi.Scene([gi.Node("hall", [*hall, *lamps, *screen])])
    here = gi.Camera.look_at((0, 0, 11.5), (0, -0.2, 9), hfov=70, resolution=(16, 12))
    there = gi.Camera.look_at((0, 0, -11.5), (0, -0.2, -9), hfov=70, resolution=(16, 12))
    settings = {"counts": (2, 2, 2), "resolution": 32, "irradiance_resolution": 8, "mode": mode}
    bake = gi.bake(scene, gi.LightFieldProbes(**settings), camera_path=here)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        seen = indirect(scene, here, bakes=[bake], **settings)
    with pytest.warns(UserWarning, match="is of another camera path: where too few of its probes see a surface"):
        unseen = indirect(scene, there, bakes=[bake], spp=256, **settings)
    paths = gi.Pipeline(environment=None, emitters=None, spp=256)
    truth = next(gi.render(scene, there, paths, seed=8)).numpy("indirect")
    assert seen.min() > 0 and unseen.min() > 0
    assert abs(unseen.mean() / truth.mean() - 1) < 0.02
    assert gi.metrics.rmse(unseen, truth) < 0.2 * truth.mean()
    with pytest.warns(UserWarning, match="is of no camera"):
        indirect(scene, there, bakes=[gi.bake(scene, gi.LightFieldProbes(**settings))], **settings)


@pytest.mark.parametrize("mode", ["irradiance", "hybrid"])
def test_where_too_few_probes_see_what_these_know_is_not_added(monkeypatch, mode):
    """Where probes are trusted nowhere, the mean is that of paths."""
    monkeypatch.setattr(light_field_state, "LEAST_SEEN", np.inf)
    scene = lamp_room()
    paths = gi.Pipeline(environment=None, emitters=None, spp=256)
    truth = next(gi.render(scene, view(), paths, seed=5)).numpy("indirect").mean()
    assert abs(indirect(scene, spp=256, mode=mode, **SMALL).mean() / truth - 1) < 0.02


def lamp_in_the_open():
    """A lamp and a wall on open ground, and a camera that sees just these."""
    ground = quad((-50, 0, 50), (100, 0, 0), (0, 0, -100), gi.Material("ground", (0.7,) * 3, specular=0.0))
    lamp = sphere((0, 0.6, 0), 0.3, gi.Material("lamp", (0.7,) * 3, specular=0.0, emission=(20, 20, 20)))
    wall = quad((1.5, 0, 2), (0, 0, -4), (0, 3, 0), gi.Material("wall", (0.7,) * 3, specular=0.0))
    scene = gi.Scene([gi.Node("all", [ground, lamp, wall])])
    return scene, gi.Camera.look_at((-2, 2, 2), (0.5, 0.5, 0), hfov=40, resolution=(16, 12))


def test_surfels_far_from_the_grid_take_none_of_its_light():
    """What probes see of ground 15 m away and more is dark, as it is; not lit like the ground between the probes."""
    scene, near = lamp_in_the_open()
    bake = gi.bake(scene, gi.LightFieldProbes(counts=(3, 2, 3), resolution=64, rays=4), camera_path=near)
    distances = unpack_distance(bake.arrays["surfels"]).astype(np.float64)
    light = unpack_radiance(bake.arrays["radiance"]).mean(axis=-1)
    far = (distances > 15) & np.isfinite(distances)
    assert far.sum() > 500 and light[far].mean() < 0.01 * light[distances < 2].mean()


def test_far_from_the_grid_its_light_counts_for_nothing():
    """Open ground without a wall: a bake for a lamp's surroundings, and the dark ground thirty metres on."""
    scene, near = lamp_in_the_open()
    far = gi.Camera.look_at((-30, 1.5, 1), (-32, 0, 0), hfov=40, resolution=(16, 12))
    settings = {"counts": (3, 2, 3), "resolution": 32, "mode": "irradiance"}
    bake = gi.bake(scene, gi.LightFieldProbes(**settings), camera_path=near)
    with pytest.warns(UserWarning, match="of another camera path"):
        image = indirect(scene, far, bakes=[bake], spp=16, **settings)
    assert image.mean() < 0.01 * indirect(scene, near, bakes=[bake], **settings).mean()


def test_a_bake_for_a_path_fits_each_of_its_frames():
    """Without a word; a bake by an earlier version, which does not know its cameras, is an error."""
    scene = lamp_room()
    path = gi.CameraPath.from_cameras([view((8, 6)), gi.Camera.look_at((0, 0, 0.5), (0, 0, -1))], times=[0.0, 4.0])
    bake = gi.bake(scene, gi.LightFieldProbes(**SMALL), camera_path=path)
    frames = [path.camera(index).at_resolution(8, 6) for index in range(0, path.frame_count, 7)]
    assert path.frame_count > 90
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for camera in (*frames, path):
            indirect_only(**SMALL).indirect.check_view(bake, camera)
    del bake.arrays["cameras"]
    with pytest.raises(gi.BakeError, match="by an earlier version"):
        indirect(scene, view(), bakes=[bake], **SMALL)


def test_nothing_is_black_under_a_stair_that_no_probe_looks_under():
    """A shelf above the floor with a hand's breadth of room: pixels below it are not 0 where paths find light."""
    shelf = quad((-0.9, -0.86, 0.9), (1.8, 0, 0), (0, 0, -1.8), gi.Material("shelf", (0.7,) * 3, specular=0.0))
    under = quad((-0.9, -0.865, -0.9), (1.8, 0, 0), (0, 0, 1.8), gi.Material("shelf", (0.7,) * 3, specular=0.0))
    scene = lamp_room(shelf, under)
    camera = gi.Camera.look_at((0, -0.92, 0.97), (0, -0.93, 0), hfov=70, resolution=(32, 12))
    paths = gi.Pipeline(environment=None, emitters=None, spp=256, camera_samples=1)
    truth = next(gi.render(scene, camera, paths, seed=5)).numpy("indirect").max(axis=-1)
    pipeline = replace(indirect_only(64, mode="irradiance"), camera_samples=1)
    image = next(gi.render(scene, camera, pipeline, seed=1)).numpy("indirect").max(axis=-1)
    lit = truth > 0.05 * truth.mean()
    assert lit.mean() > 0.5 and (image[lit] > 0).all()


@wp.kernel
def split_lobes(
    first: wp.int32,
    roughness: wp.float32,
    outgoing: wp.array(dtype=wp.vec3),
    light: wp.vec3,
    samples: wp.array(dtype=wp.vec4),
    weights: wp.array(dtype=wp.vec3),
    lobes: wp.array(dtype=wp.vec3, ndim=2),
):
    i = first + wp.tid()
    s = Surface()
    s.bsdf = make_bsdf(wp.vec3(0.8, 0.5, 0.2), 0.0, roughness, 1.0)
    index = wp.uint32(i)
    sample = bsdf_sample(s.bsdf, outgoing[i], sample_1d(index, wp.uint32(3), 0), sample_2d(index, wp.uint32(3), 1))
    samples[i] = wp.vec4(sample.wi[0], sample.wi[1], sample.wi[2], sample.pdf)
    weights[i] = sample.weight
    if sample.pdf > 0.0:
        r = trace_kernels.lobes_of(s, outgoing[i], sample, light, trace_kernels.MODE_TRACED)
        lobes[i, 0] = r.diffuse
        lobes[i, 1] = r.glossy


@pytest.mark.parametrize("roughness", [0.2, 0.9])
def test_shares_of_the_lobes_are_those_of_the_bsdf(roughness):
    """Of a sample of both lobes: (1 - F) cos / (pi pdf) of the light reaches the diffuse one, the rest is glossy."""
    count, light = 500, np.array([1.0, 2.0, 4.0])
    rng = np.random.default_rng(4)
    outgoing = rng.normal(size=(count, 3))
    outgoing[:, 2] = np.abs(outgoing[:, 2]) + 0.05
    outgoing /= np.linalg.norm(outgoing, axis=1, keepdims=True)
    samples, weights = wp.zeros(count, dtype=wp.vec4, device=CPU), wp.zeros(count, dtype=wp.vec3, device=CPU)
    lobes = wp.zeros((count, 2), dtype=wp.vec3, device=CPU)
    directions = wp.array(outgoing.astype(np.float32), dtype=wp.vec3, device=CPU)
    launch.launch(split_lobes, count, [roughness, directions, wp.vec3(*light), samples, weights, lobes], CPU)
    drawn = samples.numpy()[:, 3] > 0
    wi, pdf = samples.numpy()[drawn, :3].astype(np.float64), samples.numpy()[drawn, 3:].astype(np.float64)
    half = wi + outgoing[drawn]
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    fresnel = 0.04 + 0.96 * (1 - (half * wi).sum(axis=1, keepdims=True)) ** 5
    diffuse = (1 - fresnel) * wi[:, 2:] / (np.pi * pdf) * light
    got = lobes.numpy()[drawn].astype(np.float64)
    np.testing.assert_allclose(got[:, 0], diffuse, rtol=2e-3, atol=1e-5)
    total = np.array([0.8, 0.5, 0.2]) * got[:, 0] + got[:, 1]
    np.testing.assert_allclose(total, weights.numpy()[drawn] * light, rtol=1e-3, atol=1e-5)


def test_lobes_of_all_modes_agree_where_light_is_the_same_everywhere():
    """In a furnace the diffuse lobe gets what its share of the BSDF is, however the light is found."""
    coat = gi.Material("coat", (0.5, 0.3, 0.2), roughness=0.5, emission=(1.0, 1.0, 1.0))
    scene = gi.Scene([gi.Node("room", walls(coat))])
    means = {}
    for mode in ("irradiance", "hybrid", "traced"):
        settings = gi.LightFieldProbes(**SMALL, mode=mode)
        pipeline = gi.Pipeline(environment=None, emitters=None, indirect=settings, spp=64, denoise="spatiotemporal")
        frame = next(gi.render(scene, view(), pipeline, seed=1))
        means[mode] = np.array([array.numpy().mean(axis=0) for array in frame.lobes()[:2]])
    np.testing.assert_allclose(means["hybrid"][0], means["irradiance"][0], rtol=1e-5)
    np.testing.assert_allclose(means["traced"][0], means["irradiance"][0], rtol=0.03)
    np.testing.assert_allclose(means["hybrid"][1], means["traced"][1], rtol=0.1)


def test_rays_through_the_scene_find_what_rays_through_fine_probes_find():
    """The same term of a room, whose probes march as far as they see it."""
    scene, camera = lamp_room(), view((16, 12))
    settings = {**SMALL, "resolution": 128, "mode": "traced"}
    bake = gi.bake(scene, gi.LightFieldProbes(**settings), camera_path=camera)
    images = [indirect(scene, camera, 256, [bake], through=name, **settings) for name in ("geometry", "probes")]
    assert images[0].mean() > 0 and abs(images[1].mean() / images[0].mean() - 1) < 0.06


def test_the_picture_of_who_sees_what_counts_probes():
    """By shadow rays it is what rays from a pixel's point to the probes of its cage say; by maps it is much alike."""
    block = sphere((0.2, -0.3, 0.1), 0.45, gi.Material("block", (0.5, 0.5, 0.5), specular=0.0))
    settings, counts = gi.LightFieldProbes(**SMALL, relocate=False), {}
    for visibility in ("probes", "exact"):
        pipeline = gi.Pipeline(indirect=replace(settings, visibility=visibility), spp=1)
        scheduler = gi.FrameScheduler(lamp_room(block), view((32, 24)), pipeline, seed=1)
        frame, state = scheduler.frame(0), scheduler.state("indirect")
        counts[visibility] = probes_in_sight(frame, state, visibility)
    points = frame.numpy("position") + 1e-4 * frame.numpy("normal")
    probes = state.field.positions.numpy()
    origins = np.repeat(points.reshape(-1, 3), 8, axis=0).astype(np.float32)
    ways = np.tile(probes, (len(points.reshape(-1, 3)), 1)) - origins
    front = (ways.reshape(24, 32, 8, 3) * frame.numpy("normal")[:, :, None]).sum(axis=-1) > 0
    clear = frame.scene.bvh(CPU).occluded(origins, ways, t_max=1.0).numpy().reshape(24, 32, 8) == 0
    clear &= front
    known = counts["exact"] > 0
    assert known.mean() > 0.9 and counts["exact"].min() < 8  # the block hides some
    assert (counts["exact"] == clear.sum(axis=-1))[known].mean() > 0.95  # rays start a little apart on the sphere
    assert (np.abs(counts["probes"] - counts["exact"])[known] <= 1).mean() > 0.9
    picture = draw_seen(frame, state, "exact")
    assert picture.shape[0] > 24 and picture.shape[2] == 3 and len(np.unique(picture[:24, :32].reshape(-1, 3))) > 4


def test_only_points_left_to_paths_are_shown_as_such():
    """Where no probe has a clear view, yet all together know enough, the picture says 1."""
    grey = gi.Material("shelf", (0.7,) * 3, double_sided=True)
    shelf = quad((-0.9, -0.86, 0.2), (1.8, 0, 0), (0, 0, -1.1), grey)
    camera = gi.Camera.look_at((0, -0.92, 0.97), (0, -0.93, 0), hfov=70, resolution=(32, 12))
    scheduler = gi.FrameScheduler(lamp_room(shelf), camera, indirect_only(**SMALL), seed=1)
    frame, state = scheduler.frame(0), scheduler.state("indirect")
    counts = probes_in_sight(frame, state, "probes")
    assert (counts == 0).any() and counts.max() > 1
    state.field.least_seen = 0.0  # the least that is seen is enough
    assert (probes_in_sight(frame, state, "probes") > 0).all()


# ---- frames ----


def test_threads_do_not_change_a_bit():
    scene = lamp_room()
    results = []
    for threads in (1, 2):
        gi.set_threads(threads)
        try:
            bake = gi.bake(scene, gi.LightFieldProbes(**SMALL), seed=3)
            results.append((bake.digest, indirect(scene, bakes=[bake], spp=2, mode="traced", **SMALL)))
        finally:
            gi.set_threads(None)
    assert results[0][0] == results[1][0]
    np.testing.assert_array_equal(results[0][1], results[1][1])


def test_a_saved_bake_renders_the_same_and_fits_only_its_scene(tmp_path):
    scene = lamp_room(environment=(0.2, 0.2, 0.2))
    bake = gi.bake(scene, gi.LightFieldProbes(**SMALL), seed=1, camera_path=view())
    loaded = gi.load_bake(bake.save(tmp_path / "room.probes.safetensors"))
    assert loaded.digest == bake.digest
    np.testing.assert_array_equal(indirect(scene, bakes=[loaded], **SMALL), indirect(scene, **SMALL))
    with pytest.raises(gi.BakeError, match="bake it again"):
        indirect(lamp_room(albedo=0.5, environment=(0.2, 0.2, 0.2)), bakes=[loaded], **SMALL)
    with pytest.raises(gi.BakeError, match="counts: bake has '2x2x2', asked for '3x2x2'"):
        indirect(scene, bakes=[loaded], **{**SMALL, "counts": (3, 2, 2)})


def test_a_bake_under_another_sky_is_filled_again():
    """Light is then as in a bake of its own, though the bake's sky was dark."""
    floor, *_, front = walls(gi.Material("floor", (0.5,) * 3, specular=0.0))
    scenes = [gi.Scene([gi.Node("all", [floor, front])], environment=sky) for sky in ((0.01,) * 3, (1.0, 0.8, 0.6))]
    settings = {**SMALL, "rays": 4, "mode": "irradiance", "relocate": False}
    camera = gi.Camera.look_at((0, 0.8, 1.5), (0, -1, 0), hfov=60, resolution=(16, 12))
    dim, bright = (gi.bake(scene, gi.LightFieldProbes(**settings)) for scene in scenes)
    again, own = (indirect(scenes[1], camera, bakes=[bake], **settings) for bake in (dim, bright))
    assert own.mean() > 0.01
    np.testing.assert_allclose(again, own, atol=0.1 * own.mean())


def test_more_rays_than_samples_are_rays_of_their_own():
    """64 rays a pixel at one sample are as good as 64 samples: no pixel repeats what its neighbour draws."""
    scene, camera = lamp_room(), view((24, 16))
    settings = {**SMALL, "mode": "traced"}
    bake = gi.bake(scene, gi.LightFieldProbes(**settings))
    truth = indirect(scene, camera, spp=1024, bakes=[bake], seed=9, **settings)
    errors = {}
    for name, (spp, rays) in {"samples": (64, 0), "rays": (1, 64), "few": (4, 64)}.items():
        error = indirect(scene, camera, spp=spp, bakes=[bake], pixel_rays=rays, **settings).mean(axis=-1)
        errors[name] = error - truth.mean(axis=-1)
    power = {name: float(np.mean(error**2)) for name, error in errors.items()}
    assert power["rays"] < 2 * power["samples"] + 1e-9 and power["few"] < 2 * power["samples"]
    for name in ("samples", "rays"):  # neighbours are independent
        pairs = np.mean(errors[name][:, ::2] * errors[name][:, 1::2])
        assert abs(pairs) < 0.3 * power[name], (name, pairs / power[name])


def test_variance_is_that_of_the_rays():
    """As many rays have the same variance, however many samples they are shared out to."""
    scene, camera, told = lamp_room(), view((24, 16)), {}
    bake = gi.bake(scene, gi.LightFieldProbes(**SMALL))
    for spp, rays in ((4, 0), (16, 4), (64, 0), (4, 64)):
        pipeline = replace(indirect_only(spp, mode="traced", pixel_rays=rays, **SMALL), camera_samples=1)
        frames = [gi.FrameScheduler(scene, camera, pipeline, seed=seed, bakes=[bake]).frame(0) for seed in range(8)]
        told[spp, rays] = float(np.mean([frame.numpy("variance") for frame in frames]))
    assert 0.6 < told[16, 4] / told[4, 0] < 1.5 and 0.6 < told[4, 64] / told[64, 0] < 1.5, told
    assert told[64, 0] < 0.2 * told[4, 0]


def test_points_beyond_the_reach_of_moments_are_lit():
    """Far outside of a small grid in an open scene the nearest probes count, not those whose moments spread most."""
    floor = quad((-40, -1, 40), (80, 0, 0), (0, 0, -80), gi.Material("floor", (0.5,) * 3, specular=0.0), "floor")
    ball = sphere((0, -0.4, 0), 0.3, gi.Material("ball", (0.8,) * 3, specular=0.0))
    scene = gi.Scene([gi.Node("all", [floor, ball])], environment=(1.0, 1.0, 1.0))
    settings = gi.LightFieldProbes(**SMALL)
    state = ProbeState(scene, CPU, settings.probe_settings, 1, gi.bake(scene, settings))
    reach = 2 * np.linalg.norm(state.grid.spacing)
    moments = np.full((8, 16**2, 2), (reach, reach**2 * (1 + 1e-5)), np.float32)
    moments[0, :, 1] *= 1.01
    light = np.full((8, 16**2, 3), (1, 2, 3), np.float32)
    light[0] = 0
    state.field.moments = wp.array(moments.reshape(-1, 2), dtype=wp.vec2, device=CPU)
    state.field.irradiance = wp.array(light.reshape(-1, 3), dtype=wp.vec3, device=CPU)
    far = np.array([[300, 0.5, 0], [0, 0.5, 400], [200, 20, 200]], np.float32)
    towards = (-far / np.linalg.norm(far, axis=1, keepdims=True)).astype(np.float32)
    arrays = [wp.array(v, dtype=wp.vec3, device=CPU) for v in (far, towards)]
    found = wp.zeros(len(far), dtype=wp.vec3, device=CPU)
    launch.launch(weigh, len(far), [state.field, *arrays, found], CPU)
    np.testing.assert_allclose(found.numpy(), [[1, 2, 3]] * len(far), rtol=0.02)  # floors of the weights


def test_a_state_without_a_bake_bakes():
    scene, settings = lamp_room(), gi.LightFieldProbes(**SMALL)
    given, made = settings.start(scene, "cpu", gi.bake(scene, settings)), settings.start(scene, "cpu")
    for name in ("positions", "radiance", "surfels", "irradiance", "moments"):
        assert np.array_equal(getattr(given.field, name).numpy(), getattr(made.field, name).numpy()), name


def test_emission_is_refreshed_with_the_probe():
    scene = lamp_room()
    settings = gi.LightFieldProbes(**SMALL)
    state = settings.start(scene, "cpu", gi.bake(scene, settings))
    texels, emission = state.field.emission_texels.numpy(), state.field.emission.numpy()
    assert len(texels)
    state.refresh(scene, lit_data(scene, CPU), np.array([2, 5]))
    np.testing.assert_array_equal(state.field.emission_texels.numpy(), texels)
    np.testing.assert_array_equal(state.field.emission.numpy(), emission)


def test_a_lamp_that_moved_is_in_the_maps_of_refreshed_probes():
    lamp = quad((-0.2, 0.95, -0.2), (0.4, 0, 0), (0, 0, 0.4), light((9.0, 9.0, 9.0)), "lamp")
    keys = [gi.Keyframe(0.0, (-0.7, 0, 0)), gi.Keyframe(1.0, (0.7, 0, 0))]
    scene = gi.Scene([gi.Node("room", walls(gi.Material("wall"))), gi.Node("lamp", [lamp], keyframes=keys)])
    settings = gi.LightFieldProbes(**SMALL)
    state = settings.start(scene, "cpu", gi.bake(scene, settings))
    before = set(state.field.emission_texels.numpy().tolist())
    scene.update(1.0, None, CPU)
    state.refresh(scene, lit_data(scene, CPU), np.array([0, 1, 2, 3]))
    after, emits = state.field.emission_texels.numpy(), state.field.surfels.numpy() >> 15 & 1
    np.testing.assert_array_equal(after, np.flatnonzero(emits))  # sorted, of old probes and of new ones
    assert len(state.field.emission) == len(after) and (state.field.emission.numpy() > 0).all()
    half = 4 * 32**2
    assert {t for t in before if t >= half} == {t for t in after.tolist() if t >= half}
    assert not {t for t in before if t < half} & set(after.tolist())


def test_a_refreshed_map_keeps_part_of_what_it_knew():
    """Where a texel sees the surfel that it saw, its radiance is blended; a probe no longer covered is used again."""
    scene, every = lamp_room(), np.arange(8)
    settings = gi.LightFieldProbes(**SMALL, hysteresis=0.75)
    state = settings.start(scene, "cpu", gi.bake(scene, settings))
    texels = state.field.radiance.shape[0]

    def refreshed(old, hysteresis):
        state.settings = replace(state.settings, hysteresis=hysteresis)
        words = wp.zeros(texels, dtype=wp.uint32, device=CPU)
        words.fill_(old)
        state.field.radiance, state.refreshes = words, 0  # the same rays each time
        state.field.irradiance.fill_(wp.vec3(0.0, 0.0, 0.0))
        state.refresh(scene, lit_data(scene, CPU), every)
        return unpack_radiance(state.field.radiance.numpy())

    one = 256 | 256 << 9 | 256 << 18 | 16 << 27  # 1, 1, 1
    np.testing.assert_array_equal(unpack_radiance(np.uint32([one])), [[1, 1, 1]])
    new, kept = refreshed(one, 0.0), refreshed(one, 0.75)
    np.testing.assert_allclose(kept, 0.75 + 0.25 * new, rtol=0.01, atol=0.005)
    states = state.field.states.numpy()
    states[3] = int(field_kernels.PROBE_COVERED)
    state.field.states = wp.array(states, dtype=wp.int32, device=CPU)
    state.refresh(scene, lit_data(scene, CPU), every)
    assert not state.field.states.numpy().any()


def test_a_still_scene_settles_and_a_changed_sky_is_followed():
    """A few frames after the sky changed, probes are where a new bake would be; then nothing more is traced."""
    settings = {**SMALL, "resolution": 128, "update": 4, "hysteresis": 0.3, "mode": "irradiance"}
    camera = gi.Camera.look_at((0, 1.5, 1.5), (0, -1, 0), hfov=60, resolution=(16, 12))
    ball = sphere((0, -0.4, 0), 0.3, gi.Material("ball", (0.8,) * 3, specular=0.0))
    floor = walls(gi.Material("floor", (0.5,) * 3, specular=0.0))[0]
    open_room = gi.Scene([gi.Node("all", [floor, ball])], environment=(0.5, 0.5, 0.5))
    scheduler = gi.FrameScheduler(open_room, camera, indirect_only(**settings), seed=1)
    before = scheduler.frame(0).numpy("indirect")
    assert scheduler.state("indirect").refreshes == 0
    open_room.environment = (1.5, 1.5, 1.5)
    for index in range(1, 9):
        after = scheduler.frame(index).numpy("indirect")
    settled = scheduler.state("indirect").refreshes
    scheduler.frame(9)
    assert scheduler.state("indirect").refreshes == settled == 8  # 8 probes, 4 a frame, 4 times each
    assert abs(after.mean() / (3 * before.mean()) - 1) < 0.05


def test_a_lamp_that_moves_takes_its_light_along():
    lamp = quad((-0.2, 0.95, -0.2), (0.4, 0, 0), (0, 0, 0.4), light((9.0, 9.0, 9.0)), "lamp")
    keys = [gi.Keyframe(0.0, (-0.7, 0, 0)), gi.Keyframe(1 / 24, (0.7, 0, 0))]
    wall = gi.Material("wall", (0.6,) * 3, specular=0.0)
    scene = gi.Scene([gi.Node("room", walls(wall)), gi.Node("lamp", [lamp], keyframes=keys)])
    path = gi.CameraPath.from_cameras([view((32, 8))] * 8)
    settings = {**SMALL, "update": 8, "hysteresis": 0.0, "mode": "irradiance"}
    scheduler = gi.FrameScheduler(scene, path, indirect_only(**settings), seed=1)
    first, last = scheduler.frame(0).numpy("indirect"), [scheduler.frame(i) for i in range(1, 8)][-1].numpy("indirect")
    sides = lambda image: (image[:, :8].mean(), image[:, -8:].mean())  # noqa: E731
    assert sides(first)[0] > 1.1 * sides(first)[1] and sides(last)[1] > 1.1 * sides(last)[0]


def test_light_falls_on_moving_objects():
    ball = sphere((0, 0, 0), 0.2, gi.Material("ball", (0.8,) * 3, specular=0.0))
    keys = [gi.Keyframe(0.0, (-0.3, 0, -0.3)), gi.Keyframe(1.0, (0.3, 0, -0.3))]
    base = lamp_room()
    scene = gi.Scene([*base.nodes, gi.Node("ball", [ball], keyframes=keys)])
    path = gi.CameraPath.from_cameras([view()] * 24)
    for mode in ("irradiance", "hybrid", "traced"):
        scheduler = gi.FrameScheduler(scene, path, indirect_only(4, **SMALL, mode=mode, update=0), seed=1)
        frame = scheduler.frame(12)
        on_ball = frame.numpy("object_id") == scene.object_names.index("ball")
        assert on_ball.any() and frame.numpy("indirect")[on_ball].min(axis=0).max() > 0


def test_variance_knows_the_noise_of_traced_rays():
    scene = lamp_room()
    steady = gi.FrameScheduler(scene, view(), indirect_only(8, **SMALL, mode="irradiance"), seed=1).frame(0)
    noisy = gi.FrameScheduler(scene, view(), indirect_only(8, **SMALL, mode="traced"), seed=1).frame(0)
    assert noisy.numpy("variance").mean() > 10 * steady.numpy("variance").mean()


def test_fewer_rays_a_pixel_have_the_same_mean():
    scene = lamp_room()
    many = indirect(scene, spp=64, mode="traced", **SMALL)
    few = indirect(scene, spp=64, mode="traced", pixel_rays=8, **SMALL)
    assert abs(few.mean() / many.mean() - 1) < 0.02 and not np.array_equal(few, many)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"mode": "magic"}, "mode of light field probes"),
        ({"resolution": 100}, "multiple of 16"),
        ({"resolution": 2048}, "from 16 to 1024"),
        ({"counts": (2, 2)}, "three whole numbers"),
        ({"counts": (2, 2, -1)}, "counts must be"),
        ({"spacing": float("nan")}, "spacing must be"),
        ({"spacing": 1.0, "counts": (2, 2, 2)}, "contradict"),
        ({"hysteresis": 1.0}, "hysteresis must be"),
        ({"tolerance": -0.1}, "tolerance must be"),
        ({"irradiance_resolution": 256}, "from 4 to 128"),
    ],
)
def test_settings_are_checked(settings, words):
    with pytest.raises(gi.OptionError, match=words):
        gi.LightFieldProbes(**settings)


def test_preset_and_defaults():
    pipeline = gi.Pipeline.preset("probes", spp=4)
    assert isinstance(pipeline.indirect, gi.LightFieldProbes)
    assert replace(pipeline.indirect, mode="traced").mode == "traced"
    assert pipeline.describe()["indirect.resolution"] == 0


# ---- without geometry ----


def test_a_bake_alone_shows_the_room(tmp_path):
    """Camera rays traced through the probes show emission, reflected light and depth, with no scene in memory."""
    block = sphere((0.4, -0.6, -0.4), 0.35, gi.Material("block", (0.3, 0.6, 0.3), specular=0.0))
    scene = lamp_room(block)
    camera = gi.Camera.look_at((0.1, -0.3, 0.8), (0, 0.2, -0.5), hfov=85, resolution=(48, 32))
    settings = {**SMALL, "resolution": 128, "rays": 8, "counts": (3, 3, 3)}
    path = gi.bake(scene, gi.LightFieldProbes(**settings)).save(tmp_path / "room.safetensors")
    frame = next(gi.render(gi.load_bake(path), camera, gi.Pipeline.preset("probe_view", spp=1)))
    truth = next(gi.render(scene, camera, gi.Pipeline.preset("path", spp=256, camera_samples=1), seed=3))
    seen, expected = frame.numpy("depth"), truth.numpy("depth")
    assert (np.abs(seen / expected - 1) < 0.02).mean() > 0.95
    np.testing.assert_allclose(frame.numpy("beauty"), frame.numpy("emission") + frame.numpy("indirect"), rtol=1e-6)
    assert abs(frame.numpy("beauty").mean() / truth.numpy("beauty").mean() - 1) < 0.09
    assert gi.metrics.rmse(frame.numpy("indirect"), truth.numpy("emitters") + truth.numpy("indirect")) < 0.1
    assert frame.numpy("emission").max() == pytest.approx(8.0, rel=0.01)  # the lamp
    assert (frame.numpy("object_id") == -1).all()


def test_a_bake_alone_shows_the_sky():
    floor = walls(gi.Material("floor", (0.5,) * 3, specular=0.0))[0]
    ball = sphere((0, -0.4, 0), 0.3, gi.Material("ball", (0.8,) * 3, specular=0.0))
    scene = gi.Scene([gi.Node("all", [floor, ball])], environment=(0.25, 0.5, 1.0))
    camera = gi.Camera.look_at((0.6, -0.7, 0.8), (0, -0.4, 0), hfov=70, resolution=(24, 16))
    bake = gi.bake(scene, gi.LightFieldProbes(**{**SMALL, "resolution": 64}))
    image = next(gi.render(bake, camera, gi.Pipeline.preset("probe_view", spp=1))).numpy("beauty")
    np.testing.assert_allclose(image[0, 0], [0.25, 0.5, 1.0], rtol=0.01)


def test_sky_and_silhouettes_are_seen_from_anywhere():
    """Under a white sky white things have no black pixel: at the edges of things, or looked at from outside."""
    white = gi.Material("white", (0.8,) * 3, specular=0.0)
    scene = gi.Scene([gi.Node("all", [walls(white)[0], sphere((0, -0.4, 0), 0.3, white)])], environment=(1.0, 1.0, 1.0))
    bake = gi.bake(scene, gi.LightFieldProbes(**{**SMALL, "resolution": 64, "rays": 32}))
    for eye, target in (((0.6, -0.7, 0.8), (0, -0.4, 0)), ((3, 1, 3), (0, -0.5, 0)), ((3, 1, 3), (6, 2, 6))):
        camera = gi.Camera.look_at(eye, target, hfov=50, resolution=(96, 64))
        image = next(gi.render(bake, camera, gi.Pipeline.preset("probe_view", spp=1))).numpy("beauty")
        assert image.min() > 0.05, (eye, np.argwhere(image.min(axis=-1) <= 0.05)[:5])


def test_only_probes_can_be_rendered_alone():
    bake = gi.bake(lamp_room(), gi.LightFieldProbes(**SMALL))
    with pytest.raises(gi.OptionError, match="probe_view"):
        next(gi.render(bake, view(), gi.Pipeline.preset("probes")))
    with pytest.raises(gi.OptionError, match="leave the other terms"):
        gi.Pipeline(indirect=gi.LightFieldProbes(primary="probes"))
    field = gi.bake(lamp_room(environment=1.0), gi.VisibilityField(samples=1000, resolution=8))
    with pytest.raises(gi.BakeError, match="cannot be rendered without its scene"):
        next(gi.render(field, view(), gi.Pipeline.preset("probe_view")))


# ---- denoising ----


@pytest.mark.parametrize("mode", ["irradiance", "hybrid", "traced"])
def test_lobes_are_parts_of_the_term(mode):
    """What is handed to a denoiser adds up to the term, and filtering lowers the error of traced rays."""
    coat = gi.Material("coat", (0.5, 0.3, 0.2), roughness=0.4)
    scene = lamp_room(quad((-0.8, -0.8, -0.95), (1.6, 0, 0), (0, 1.6, 0), coat))
    pipeline = replace(indirect_only(4, **SMALL, mode=mode), denoise="spatiotemporal")
    frame = next(gi.render(scene, view(), replace(pipeline, camera_samples=1), seed=1))
    diffuse, glossy = (array.numpy().reshape(16, 24, 3) for array in frame.lobes()[:2])
    albedo = frame.struct(denoise_kernels.Guides).guide_diffuse.numpy().reshape(16, 24, 3)
    np.testing.assert_allclose(albedo * diffuse + glossy, frame.numpy("indirect"), rtol=1e-4, atol=1e-6)
    assert glossy.any() and diffuse.any()
