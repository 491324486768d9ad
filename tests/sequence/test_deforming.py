"""Meshes that bend and change their shape, in every preset: seen and lit as still ones of the same shapes."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
import statistics_tools as st
from deforming_tools import BINDS, bar, bar_weights, bent, placement, turn, turned_at
from scene_tools import quad
from test_dependence import preset
from truth_tools import camera_in_box, closed_box

import warp_gi as gi
from warp_gi.scene.model import Mesh
from warp_gi.techniques.light_field.estimator import _key as light_of_probes

POINTS, NORMALS, FACES = bar()
SHARES = bar_weights(POINTS)
GREY = gi.Material("grey", (0.6, 0.5, 0.4), specular=0.0)
LAMP = gi.Material("lamp", emission=(8.0, 8.0, 6.0), double_sided=True)
TURNS = [(0.0, turn("z", 0)), (1.0, turn("z", 75))]
FPS = 4.0
SQUARE = quad((-0.35, -0.35, 0), (0.7, 0, 0), (0, 0.7, 0), gi.Material("blob", (0.7, 0.2, 0.2), specular=0.0), "blob")
SHIFT = np.float32([[0, 0, 0], [0.3, 0, 0.2], [0, 0.6, 0.1], [0, 0, 0]])


def room(bar_material=GREY, lamp=True):
    """A floor, a wall and a lamp at rest; a bar that bends over, and a square that changes its shape."""
    rests = [
        quad((-2, 0, 2), (4, 0, 0), (0, 0, -4), GREY),
        quad((-2, 0, -1.5), (4, 0, 0), (0, 3, 0), GREY),
        *([quad((-0.4, 2.8, 0.4), (0.8, 0, 0), (0, 0, -0.8), LAMP, "lamp")] if lamp else []),
    ]
    skin = gi.Skin([2, 3], BINDS)
    tube = Mesh(POINTS, FACES, bar_material, NORMALS, name="bar", joints=np.tile([0, 1], (len(POINTS), 1)))
    tube.joint_weights = SHARES.astype(np.float32)
    blob = replace(SQUARE, targets=[gi.MorphTarget(SHIFT)])
    keys = [gi.Keyframe(time, (0, 1, 0), tuple(rotation)) for time, rotation in TURNS]
    morphs = [gi.MorphKeyframe(0.0, (0.0,)), gi.MorphKeyframe(1.0, (1.0,))]
    nodes = [
        gi.Node("room", rests),
        gi.Node("bar", [tube], placement(translation=(9, 9, 9)), skin=skin),
        gi.Node("lower", parent_from_node=placement(translation=(-0.5, 0, 0))),
        gi.Node("upper", parent=2, keyframes=keys),
        gi.Node("blob", [blob], placement(translation=(0.9, 0.5, 0.2)), morphs=morphs),
    ]
    return gi.Scene(nodes, environment=(0.4, 0.5, 0.6), name="room")


def bar_at(time):
    """Return points and normals of the bar at a time, by sums over joints."""
    upper = placement(turned_at([t for t, _ in TURNS], [q for _, q in TURNS], time), (0, 1, 0))
    root = placement(translation=(-0.5, 0, 0))
    return bent(POINTS, NORMALS, SHARES, [root @ BINDS[0], root @ upper @ BINDS[1]])


def still(time, bar_material=GREY, lamp=True):
    """Return the room with everything as it is at a time, at rest."""
    scene = room(bar_material, lamp)
    points, normals = bar_at(time)
    tube = Mesh(points.astype(np.float32), FACES, bar_material, normals.astype(np.float32), name="bar")
    blob = replace(SQUARE, points=SQUARE.points + np.float32(time) * SHIFT)
    nodes = [scene.nodes[0], gi.Node("bar", [tube]), gi.Node("blob", [blob], scene.nodes[4].parent_from_node)]
    return gi.Scene(nodes, environment=(0.4, 0.5, 0.6), name="still")


def view(size=(24, 16)):
    return gi.Camera.look_at((0.3, 1.3, 4.2), (0.1, 1.0, 0), hfov=50, resolution=size)


def path(size=(24, 16)):
    return gi.CameraPath.from_cameras([view(size)] * 4, fps=FPS)


def test_vertices_and_motion_are_those_of_the_sums():
    scene = room()
    for time, previous in ((0.5, 0.25), (0.25, 1.0)):
        scene.update(time, previous, st.device())
        g = scene.data(st.device()).geometry
        start = len(POINTS)
        mine = slice(4 * 3, 4 * 3 + start)
        np.testing.assert_allclose(g.points.numpy()[mine], bar_at(time)[0], atol=2e-6)
        np.testing.assert_allclose(g.normals.numpy()[mine], bar_at(time)[1], atol=2e-6)
        np.testing.assert_allclose(g.previous_points.numpy()[mine], bar_at(previous)[0], atol=2e-6)


def test_motion_vectors_point_to_where_surfaces_were():
    """A finite difference: what a pixel sees is found in the shape of the frame before, and projected."""
    camera, scene = view((60, 40)), room()
    scheduler = gi.FrameScheduler(scene, path((60, 40)), gi.Pipeline.preset("direct", spp=1), st.device().alias)
    frame = scheduler.frame(2)
    now, before = bar_at(2 / FPS)[0], bar_at(1 / FPS)[0]
    place, motion, ids = (frame.numpy(name) for name in ("position", "motion", "object_id"))
    ys, xs = np.nonzero(ids == 1)
    assert len(ys) > 40 and np.abs(motion[ids == 1]).max() > 1.0
    corners, was = now[FACES], before[FACES]
    for y, x in zip(ys, xs, strict=True):
        p = place[y, x].astype(np.float64)
        edges = np.stack([corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]], axis=2)
        uv = np.einsum("fij,fj->fi", np.linalg.pinv(edges), p - corners[:, 0])
        off = np.linalg.norm(corners[:, 0] + np.einsum("fij,fj->fi", edges, uv) - p, axis=1)
        outside = np.maximum(0, np.maximum(-uv.min(axis=1), uv.sum(axis=1) - 1))
        face = int(np.argmin(off + outside))
        weights = np.array([1 - uv[face].sum(), *uv[face]])
        expected = camera.project((weights @ was[face])[None]) - camera.project(p[None])
        np.testing.assert_allclose(motion[y, x], expected[0], atol=5e-3)
    blob, rests = ids == 2, ids == 0
    assert np.abs(motion[blob]).max() > 0.5 and np.abs(motion[rests]).max() < 1e-3


def test_paths_meet_what_they_would_meet_in_a_still_scene():
    """The same samples: pictures differ by rounding, and where it sends a path elsewhere."""
    pipeline = gi.Pipeline.preset("path", spp=16)
    scenes = room(), still(3 / FPS)
    a, b = (gi.FrameScheduler(one, path(), pipeline, st.device().alias, 8).frame(3) for one in scenes)
    for name in ("beauty", "albedo", "normal", "depth", "position"):
        same = np.isclose(a.numpy(name), b.numpy(name), rtol=1e-3, atol=1e-4)
        assert same.mean() > 0.97, (name, same.mean())


ERRORS = {
    "probes": 0.2,
    "probe_view": 0.25,
    "transfer": 0.25,
    "dvf": 0.05,
    "hybrid": 0.05,
    "cache": 0.04,
    "clean": 0.06,
}
"""Largest relative difference of the mean that is taken for a preset's own bias and noise; 0.04 where none is named."""


@pytest.fixture(scope="module")
def reference():
    """Return the reference path tracer's frame of the still room at frame 3."""
    pipeline = gi.Pipeline.preset("path", spp=512)
    return gi.FrameScheduler(still(3 / FPS), view(), pipeline, st.device().alias, 8).frame(0)


@pytest.mark.parametrize("name", [name for name in gi.Pipeline.presets() if name != "polygons"])
def test_a_preset_sees_and_lights_what_deforms(name, reference):
    pipeline = preset(name)
    if name != "clean":
        pipeline = replace(pipeline, spp=64)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "baked transfer knows nothing of what moves: 'bar', 'blob'")
        scheduler = gi.FrameScheduler(room(), path(), pipeline, st.device().alias, 3)
        for index in range(4):
            frame = scheduler.frame(index)
    wanted, found = reference.numpy("beauty"), frame.numpy("beauty")
    if name == "direct":
        wanted = sum(reference.numpy(term) for term in ("emission", "environment", "emitters"))
    ids = reference.numpy("object_id")
    for which in (ids >= 0, ids == 1, ids == 2):
        mean, expected = found[which].mean(dtype=np.float64), wanted[which].mean(dtype=np.float64)
        assert mean == pytest.approx(expected, rel=ERRORS.get(name, 0.04))


def test_polygons_refuse_what_deforms():
    with pytest.raises(gi.GiError, match="move") as caught:
        gi.FrameScheduler(room(), path(), preset("polygons"), st.device().alias, 3).frame(0)
    assert "\n" not in str(caught.value)


def only_bends():
    """The room without the square, and the bar in it."""
    nodes = room().nodes[:4]
    return gi.Scene(nodes, environment=(0.4, 0.5, 0.6), name="bends")


def test_a_field_knows_that_what_bends_does_not_rest():
    """Cells that are baked with it where it rests must not outlive the frame in which it bends again."""
    scene = only_bends()
    times = gi.CameraPath.from_cameras([view()] * 8, fps=FPS)  # it bends until frame 4
    scheduler = gi.FrameScheduler(scene, times, preset("dvf"), st.device().alias, 3)
    stills, settled = [], []
    for index in (0, 1, 5, 6, 7, 2):
        scheduler.frame(index)
        state = scheduler.state("environment")
        stills.append(state.is_still)
        settled.append(len(state.settled.cells) > 0)
    assert stills == [False, False, False, True, True, False]
    assert settled == [False, False, False, True, True, False]


def test_probes_are_traced_again_while_something_bends():
    scene = only_bends()
    keys = [light_of_probes(scene, time) for time in (0.0, 0.5, 1.0, 2.0)]
    assert keys[0] != keys[1] != keys[2] == keys[3]


def test_a_furnace_stays_white_while_a_bar_bends_in_it():
    """Every cell of the surface cache has the irradiance pi / (1 - albedo) = 2 pi; the bar has cells of its own."""
    sides = closed_box(0.5, 1.0)
    tube = replace(only_bends().nodes[1].meshes[0], material=sides[0].material)
    tube.points = (0.5 * tube.points).astype(np.float32)
    skin = gi.Skin([2, 3], np.stack([np.eye(4), placement(translation=(0, -0.5, 0))]))
    keys = [gi.Keyframe(time, (0, 0.5, 0), tuple(rotation)) for time, rotation in TURNS]
    nodes = [gi.Node("box", sides), gi.Node("bar", [tube], skin=skin)]
    nodes += [gi.Node("low", parent_from_node=placement(translation=(-0.2, -0.8, -0.4)))]
    scene = gi.Scene([*nodes, gi.Node("high", parent=2, keyframes=keys)])
    cache = gi.SurfaceCache(paths=20_000, refresh=4_000)
    ends_in = gi.BsdfPaths(ends_in=cache)
    pipeline = gi.Pipeline(environment=None, emitters=None, indirect=ends_in, camera_samples=1, spp=4)
    camera = gi.CameraPath.from_cameras([camera_in_box((24, 24))] * 4, fps=FPS)
    scheduler = gi.FrameScheduler(scene, camera, pipeline, st.device().alias, 3)
    for index in range(4):
        scheduler.frame(index)
        state = scheduler.state("indirect.ends_in")
        number = state.keys >> np.uint64(55)
        assert set(number) == {0, 2}
        for which in (0, 2):
            mine = number == which
            mean = state.light[mine, :3].sum(axis=0) / state.weights[mine].sum()
            np.testing.assert_allclose(mean, 2 * np.pi, rtol=0.03)


# ---- lamps ----

EMITTERS = {
    "power": gi.PowerLights(),
    "uniform": gi.UniformLights(),
    "hierarchy": gi.LightHierarchy(),
    "cache": gi.VisibilityLightCache(),
}


@pytest.mark.parametrize("name", EMITTERS)
def test_a_lamp_that_bends_lights_as_one_of_that_shape(name):
    pipeline = gi.Pipeline(environment=None, emitters=EMITTERS[name], indirect=None, spp=512)
    reference = gi.Pipeline(environment=None, emitters=gi.PowerLights(), indirect=None, spp=512)
    wanted = gi.FrameScheduler(still(3 / FPS, LAMP, lamp=False), path(), reference, st.device().alias, 3).frame(3)
    scheduler = gi.FrameScheduler(room(LAMP, lamp=False), path(), pipeline, st.device().alias, 3)
    for index in (0, 2, 3):
        frame = scheduler.frame(index)
    ids = wanted.numpy("object_id")
    for which in (ids == 0, ids == 2):
        found, expected = (one.numpy("emitters")[which].mean(dtype=np.float64) for one in (frame, wanted))
        assert found == pytest.approx(expected, rel=0.025)


def test_a_lamp_that_grows_out_of_nothing_shines():
    """Its area is zero at time 0; by the mean over its time it is chosen as often as it should be."""
    panel = quad((-0.4, 2.0, 0.4), (0.8, 0, 0), (0, 0, -0.8), LAMP, "lamp")
    grown = panel.points.copy()
    panel.points = np.tile(grown[:1], (4, 1))
    panel.targets = [gi.MorphTarget(grown - panel.points)]
    morphs = [gi.MorphKeyframe(0.0, (0.0,)), gi.MorphKeyframe(1.0, (1.0,))]
    floor = quad((-2, 0, 2), (4, 0, 0), (0, 0, -4), GREY)
    scene = gi.Scene([gi.Node("floor", [floor]), gi.Node("lamp", [panel], morphs=morphs)])
    alike = gi.Scene([gi.Node("floor", [floor]), gi.Node("lamp", [replace(panel, points=grown, targets=[])])])
    assert scene.emitter_count == 2
    share = scene.emitter_powers() / alike.emitter_powers()
    np.testing.assert_allclose(share, np.mean(np.linspace(0, 1, 9) ** 2), rtol=1e-5)
    pipeline = gi.Pipeline(environment=None, emitters=gi.PowerLights(), indirect=None, spp=64)
    times = gi.CameraPath.from_cameras([view()] * 5, fps=4)
    wanted, found = (gi.FrameScheduler(one, times, pipeline, st.device().alias, 3) for one in (alike, scene))
    np.testing.assert_allclose(found.frame(4).numpy("beauty"), wanted.frame(4).numpy("beauty"), rtol=0.02, atol=1e-3)
    assert found.frame(0).numpy("beauty").max() == 0.0


@pytest.mark.parametrize("how", ["scaled", "scaled parent", "opens between poses"])
def test_lamps_shine_that_have_no_area_when_the_scene_is_made(how):
    """A panel that is closed at time 0, or at each of the times at which areas are sampled, beside one that rests."""
    panel = quad((-0.4, 2.0, 0.4), (0.8, 0, 0), (0, 0, -0.8), LAMP, "lamp")
    beside = quad((1.0, 2.0, 0.4), (0.8, 0, 0), (0, 0, -0.8), LAMP, "beside")
    still = gi.Node("lamp", [panel])
    lamps = [replace(still)]
    if how == "scaled":
        lamps[0].keyframes = [gi.Keyframe(0.0, scale=(0, 0, 0)), gi.Keyframe(0.3)]
    elif how == "scaled parent":
        keys = [gi.Keyframe(0.0, scale=(1, 1, 0)), gi.Keyframe(0.3, scale=(1, 1, 1))]
        lamps = [gi.Node("parent", keyframes=keys), replace(still, parent=0)]
    else:  # at 0.3 s, between 0.25 and 0.375 s
        shut = replace(panel, points=np.tile(panel.points[:1], (4, 1)))
        shut.targets = [gi.MorphTarget(panel.points - shut.points)]
        keys = [(0.0, 0.0), (0.26, 0.0), (0.29, 1.0), (0.31, 1.0), (0.36, 0.0), (1.0, 0.0)]
        lamps[0] = gi.Node("lamp", [shut], morphs=[gi.MorphKeyframe(time, (weight,)) for time, weight in keys])
    floor = quad((-2, 0, 2), (4, 0, 0), (0, 0, -4), GREY)
    rest = [gi.Node("floor", [floor]), gi.Node("beside", [beside])]
    scene, alike = gi.Scene([*lamps, *rest]), gi.Scene([still, *rest])
    assert scene.emitter_count == alike.emitter_count == 4
    assert (scene.emitter_powers() > 0).all() and scene.emitter_powers()[2:] == pytest.approx(
        alike.emitter_powers()[2:]
    )
    times = gi.CameraPath.from_cameras([view()] * 4, fps=10)
    for lights, spp in ((gi.LightHierarchy(), 64), (gi.PowerLights(), 512)):
        pipeline = gi.Pipeline(environment=None, emitters=lights, indirect=None, spp=spp)
        wanted, found = (gi.FrameScheduler(one, times, pipeline, st.device().alias, 3) for one in (alike, scene))
        expected, got = (one.frame(3).numpy("beauty").mean(axis=(0, 1)) for one in (wanted, found))
        np.testing.assert_allclose(got, expected, rtol=0.02)


def test_transfer_refuses_lamps_that_bend():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        scheduler = gi.FrameScheduler(room(LAMP, lamp=False), path(), preset("transfer"), st.device().alias, 3)
        with pytest.raises(gi.OptionError, match="lamps of this scene move"):
            scheduler.frame(0)
