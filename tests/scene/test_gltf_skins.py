"""Skins and morph targets of glTF, at rest and animated, against double-precision sums over joints and targets."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pytest
from deforming_tools import (
    BINDS,
    animate,
    bar,
    bar_weights,
    bent,
    placement,
    skinned_bar,
    spline,
    turn,
    turned_at,
)
from scene_tools import GlbBuilder
from scipy.spatial.transform import Rotation

import warp_gi as gi
from warp_gi.errors import SceneError

CASES = Path(__file__).parents[1] / "cases"
WALL = gi.Camera.look_at((0, 0, 3), (0, 0, 0), hfov=30, resolution=(32, 24))
POINTS, NORMALS, FACES = bar()
SHARES = bar_weights(POINTS)


def loaded(glb, folder, **options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return gi.load_scene(glb.write(folder / "a.glb"), **options)


def shape(scene, time=0.0, previous=None):
    """Return points, normals and previous points of a scene on the CPU at a time."""
    scene.update(time, previous, "cpu")
    g = scene.data("cpu").geometry
    return g.points.numpy().copy(), g.normals.numpy().copy(), g.previous_points.numpy().copy()


# ---- skins at rest ----


def test_a_skinned_mesh_is_where_its_joint_is():
    scene = gi.load_scene(CASES / "skinned-mesh" / "skin.glb", environment=1.0)
    np.testing.assert_array_equal(scene.bounds, [[-1, -1, 1], [1, 1, 1]])
    frame = next(gi.render(scene, WALL, gi.Pipeline(spp=4)))
    np.testing.assert_allclose(frame.numpy("depth"), 2.0, rtol=1e-6)
    assert not scene.is_animated


ROOT = {"translation": [0.5, 0, -1], "rotation": turn("z", 30), "scale": [1, 2, 0.5]}
UPPER = {"rotation": turn("x", 70), "scale": [0.8, 1.5, 1]}


def matrices_of(root, upper):
    """Return world from mesh by each joint; the upper one hangs on the root, 1 m up."""
    return np.stack([root @ BINDS[0], root @ placement(translation=(0, 1, 0)) @ upper @ BINDS[1]])


BENT = matrices_of(
    placement(Rotation.from_quat(ROOT["rotation"]).as_matrix(), ROOT["translation"], ROOT["scale"]),
    placement(Rotation.from_quat(UPPER["rotation"]).as_matrix(), scale=UPPER["scale"]),
)


@pytest.mark.parametrize("sets", [1, 2])
@pytest.mark.parametrize("joints", [np.uint8, np.uint16])
@pytest.mark.parametrize(("weights", "error"), [(np.float32, 2e-6), (np.uint8, 6e-3), (np.uint16, 3e-5)])
def test_a_bent_bar(tmp_path, joints, weights, sets, error):
    scene = loaded(skinned_bar(joints, weights, sets, ROOT, UPPER), tmp_path)
    points, normals, _ = shape(scene)
    expected, turned = bent(POINTS, NORMALS, SHARES, BENT)
    np.testing.assert_allclose(points, expected, atol=error)
    np.testing.assert_allclose(normals, turned, atol=4 * error)
    np.testing.assert_array_equal(scene.data("cpu").geometry.indices.numpy(), FACES)


def test_weights_count_relative_to_their_sum(tmp_path):
    """Writers round weights, or leave them unnormalized; a vertex without any follows its first joint."""
    glb = skinned_bar(root=ROOT, upper=UPPER)
    attributes = glb.json["meshes"][0]["primitives"][0]["attributes"]
    weights = np.zeros((len(POINTS), 4))
    weights[:, :2] = SHARES * 0.25
    weights[5] = 0.0
    attributes["JOINTS_0"] = glb.accessor(np.tile([0, 1, 200, 0], (len(POINTS), 1)), np.uint8)  # 200: of no weight
    attributes["WEIGHTS_0"] = glb.accessor(weights)
    points, normals, _ = shape(loaded(glb, tmp_path))
    shares = SHARES.copy()
    shares[5] = (1.0, 0.0)
    expected, turned = bent(POINTS, NORMALS, shares, BENT)
    np.testing.assert_allclose(points, expected, atol=2e-6)
    np.testing.assert_allclose(normals, turned, atol=2e-6)


def test_without_inverse_bind_matrices_they_are_identities(tmp_path):
    glb = skinned_bar(upper=UPPER)
    del glb.json["skins"][0]["inverseBindMatrices"]
    upper = placement(translation=(0, 1, 0)) @ placement(
        Rotation.from_quat(UPPER["rotation"]).as_matrix(), scale=UPPER["scale"]
    )
    expected, _ = bent(POINTS, NORMALS, SHARES, [np.eye(4), upper])
    np.testing.assert_allclose(shape(loaded(glb, tmp_path))[0], expected, atol=2e-6)


def test_two_nodes_of_one_skin_and_one_without(tmp_path):
    glb = skinned_bar(upper=UPPER)
    glb.add("nodes", {"mesh": 0, "skin": 0, "scale": [3, 3, 3]})
    glb.add("nodes", {"mesh": 0, "translation": [1, 2, 3]})
    glb.json["scenes"] = [{"nodes": [0, 1, 3, 4]}]
    a, b, c = np.split(shape(loaded(glb, tmp_path))[0], 3)
    np.testing.assert_array_equal(a, b)
    np.testing.assert_allclose(c, POINTS + np.float32([1, 2, 3]), atol=1e-6)
    assert np.abs(a - POINTS).max() > 0.5


def test_a_mirrored_skeleton_keeps_fronts(tmp_path):
    """The tube's fronts look outwards; behind a mirror they still do."""
    plain, mirrored = (loaded(skinned_bar(root={"scale": [side, 1, 1]}), tmp_path) for side in (1, -1))
    for scene in (plain, mirrored):
        points, normals, _ = shape(scene)
        corners = points[scene.data("cpu").geometry.indices.numpy()]
        fronts = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        outwards = corners.mean(axis=1) * (1, 0, 1)
        assert (np.einsum("fi,fi->f", fronts, outwards) > 0).all()
        assert (np.einsum("vi,vi->v", normals, points * (1, 0, 1)) > 0).all()


def test_scale_axis_and_offset_of_a_file_take_skins_along(tmp_path):
    far = {"translation": [300000.5, 7.0, -20000.25]}
    glb = skinned_bar(root=far, upper=UPPER)
    here = shape(loaded(skinned_bar(upper=UPPER), tmp_path))[0]
    with pytest.warns(UserWarning, match="recentred by"):
        scene = gi.load_scene(glb.write(tmp_path / "far.glb"))
    np.testing.assert_allclose(shape(scene)[0] + scene.offset, here + np.array(far["translation"]), atol=2e-6)
    small = shape(loaded(skinned_bar(upper=UPPER), tmp_path, scale=0.1))[0]
    np.testing.assert_allclose(small, 0.1 * here, atol=1e-6)
    upright = shape(loaded(skinned_bar(upper=UPPER), tmp_path, up="z"))[0]
    np.testing.assert_allclose(upright, here[:, [0, 2, 1]] * (1, 1, -1), atol=1e-6)


def test_joints_at_the_origin_of_a_file_that_lies_far_away(tmp_path):
    """Roots without placement, of which nothing hangs: their offset is in the inverse bind matrices alone."""
    glb = skinned_bar()
    far = np.array([400000.0, 0, 0])
    matrices = np.stack([placement(translation=far)] * 2).transpose(0, 2, 1).reshape(-1, 16)
    glb.json["skins"][0]["inverseBindMatrices"] = glb.accessor(matrices)
    glb.json["nodes"] = [{"mesh": 0, "skin": 0}, {"name": "a"}, {"name": "b"}]
    glb.json["scenes"] = [{"nodes": [0, 1, 2]}]
    with pytest.warns(UserWarning, match="recentred by"):
        scene = gi.load_scene(glb.write(tmp_path / "far.glb"))
    np.testing.assert_allclose(shape(scene)[0].astype(float) + scene.offset, POINTS + far, atol=1e-6)


def test_smooth_normals_of_a_skinned_mesh_bend_with_it(tmp_path):
    glb = skinned_bar(root=ROOT, upper=UPPER)
    del glb.json["meshes"][0]["primitives"][0]["attributes"]["NORMAL"]
    points, normals, _ = shape(loaded(glb, tmp_path, smooth=180))
    expected, turned = bent(POINTS, NORMALS, SHARES, BENT)
    order, wanted = (np.lexsort(np.round(one, 4).T) for one in (points, expected))
    np.testing.assert_allclose(points[order], expected[wanted], atol=1e-5)
    inner = np.abs(POINTS[wanted, 1] - 1) < 0.9
    np.testing.assert_allclose(normals[order][inner], turned[wanted][inner], atol=1e-3)


# ---- animation ----

TIMES = [0.5, 1.0, 2.0]
QUATERNIONS = [turn("x", 0), turn("x", 80), turn("xz", [20, 60])]


def test_joints_that_turn(tmp_path):
    glb = skinned_bar(root=ROOT)
    animate(glb, 2, "rotation", TIMES, QUATERNIONS)
    scene = loaded(glb, tmp_path)
    assert scene.is_animated and scene.duration == 2.0 and scene.moves(0) and scene.moving_objects == {0: 0}
    root = placement(Rotation.from_quat(ROOT["rotation"]).as_matrix(), ROOT["translation"], ROOT["scale"])
    seen = {}
    for time, previous in ((0.0, 0.0), (1.7, 0.6), (0.6, 0.0), (1.7, 1.2), (9.0, 1.7)):
        points, normals, before = shape(scene, time, previous)
        for at, found, what in ((time, points, 0), (time, normals, 1), (previous, before, 0)):
            matrices = matrices_of(root, placement(turned_at(TIMES, QUATERNIONS, at)))
            np.testing.assert_allclose(found, bent(POINTS, NORMALS, SHARES, matrices)[what], atol=3e-6)
            assert found.tobytes() == seen.setdefault((at, what), found).tobytes()  # a function of time alone
    low, high = scene.bounds
    assert (points >= low - 1e-6).all() and (points <= high + 1e-6).all()


def test_translations_in_steps_and_cubic_scales(tmp_path):
    tangents = [[[0, 0, 0], [1, 1, 1], [2, 0, 1]], [[1, 1, 0], [2, 1, 0.5], [0, 0, 0]]]
    glb = skinned_bar()
    animate(glb, 1, "translation", [0, 1, 2], [[0, 0, 0], [1, 0, 0], [0, 3, 0]], "STEP")
    animate(glb, 2, "scale", [0, 2], tangents, "CUBICSPLINE")
    scene = loaded(glb, tmp_path)
    for time, move in ((0.4, (0, 0, 0)), (1.0, (1, 0, 0)), (1.9, (1, 0, 0)), (2.5, (0, 3, 0))):
        matrices = matrices_of(placement(translation=move), placement(scale=spline([0, 2], tangents, time)))
        expected, turned = bent(POINTS, NORMALS, SHARES, matrices)
        points, normals, _ = shape(scene, time)
        np.testing.assert_allclose(points, expected, atol=5e-3)  # 16 linear pieces
        np.testing.assert_allclose(normals, turned, atol=1e-2)


def test_a_joint_can_be_animated_from_python(tmp_path):
    scene = loaded(skinned_bar(), tmp_path)
    assert not scene.is_animated
    before = scene.hash, scene.geometry_hash
    scene.animate("upper", [gi.Keyframe(0.0, (0, 1, 0)), gi.Keyframe(1.0, (0, 1, 0), tuple(turn("x", 90)))])
    assert scene.moves(0) and scene.hash != before[0] and scene.geometry_hash != before[1]
    expected, _ = bent(
        POINTS,
        NORMALS,
        SHARES,
        matrices_of(np.eye(4), placement(turned_at([0, 1], [turn("x", 0), turn("x", 90)], 0.5))),
    )
    np.testing.assert_allclose(shape(scene, 0.5)[0], expected, atol=2e-6)


def blob(weights=None):
    """Return a file with a square of two morph targets, and the targets."""
    glb = GlbBuilder()
    square = np.float32([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
    rng = np.random.default_rng(5)
    shifts = rng.normal(size=(2, 4, 3)).astype(np.float32)
    bends = 0.3 * rng.normal(size=(2, 4, 3)).astype(np.float32)
    normals = np.tile(np.float32([0, 0, 1]), (4, 1))
    targets = [{"POSITION": glb.accessor(a), "NORMAL": glb.accessor(b)} for a, b in zip(shifts, bends, strict=True)]
    primitive = {
        "attributes": {"POSITION": glb.accessor(square), "NORMAL": glb.accessor(normals)},
        "indices": glb.accessor([0, 1, 2, 0, 2, 3], np.uint16),
        "targets": targets,
    }
    mesh = {"primitives": [primitive], **({} if weights is None else {"weights": weights})}
    glb.add("nodes", {"name": "blob", "mesh": glb.add("meshes", mesh), "translation": [0, 0, 2]})

    def at(w):
        w = np.asarray(w, float)
        points = square + np.einsum("t,tvi->vi", w, shifts) + (0, 0, 2)
        turned = normals + np.einsum("t,tvi->vi", w, bends)
        return points, turned / np.linalg.norm(turned, axis=1, keepdims=True)

    return glb, at


CURVES = {
    "LINEAR": ([[0, 0], [1, 0], [0.5, -1]], lambda t: [np.interp(t, [0, 1, 2], c) for c in ([0, 1, 0.5], [0, 0, -1])]),
    "STEP": ([[0, 0], [1, 0], [0.5, -1]], lambda t: [[0, 0], [1, 0], [0.5, -1]][min(int(t), 2)]),
    "CUBICSPLINE": (
        CUBIC := [[[0, 0], [0, 0], [2, 1]], [[1, 0], [1, 0], [0, 0]], [[0, -3], [0.5, -1], [0, 0]]],
        lambda t: spline([0, 1, 2], CUBIC, t),
    ),
}


@pytest.mark.parametrize("kind", CURVES)
def test_weights_that_change(tmp_path, kind):
    values, weights_at = CURVES[kind]
    glb, at = blob([0.7, 0.7])
    animate(glb, 0, "weights", [0, 1, 2], values, kind)
    scene = loaded(glb, tmp_path)
    assert scene.is_animated and scene.duration == 2.0
    error = 1e-2 if kind == "CUBICSPLINE" else 2e-6
    low, high = scene.bounds
    for time, previous in ((0.3, 0.0), (1.5, 0.3), (2.0, 1.5), (0.3, 2.0)):
        points, normals, before = shape(scene, time, previous)
        expected, turned = at(weights_at(time))
        np.testing.assert_allclose(points, expected, atol=error)
        np.testing.assert_allclose(normals, turned, atol=error)
        np.testing.assert_allclose(before, at(weights_at(previous))[0], atol=error)
        assert (points >= low - 1e-6).all() and (points <= high + 1e-6).all()


def test_weights_that_never_change_are_a_shape_at_rest(tmp_path):
    glb, at = blob([0.1, 0.2])
    animate(glb, 0, "weights", [0, 1], [[0.5, -1], [0.5, -1]])
    scene = loaded(glb, tmp_path)
    assert not scene.is_animated
    np.testing.assert_allclose(shape(scene)[0], at([0.5, -1])[0], atol=1e-6)


def test_a_mesh_morphs_before_it_bends(tmp_path):
    glb = skinned_bar(root=ROOT)
    shift = np.float32([0.5, 0, 0.1])
    target = {"POSITION": glb.accessor(np.tile(shift, (len(POINTS), 1)))}
    glb.json["meshes"][0]["primitives"][0]["targets"] = [target]
    animate(glb, 0, "weights", [0, 1], [[0], [1]])
    animate(glb, 2, "rotation", TIMES, QUATERNIONS)
    scene = loaded(glb, tmp_path)
    root = placement(Rotation.from_quat(ROOT["rotation"]).as_matrix(), ROOT["translation"], ROOT["scale"])
    for time in (0.25, 0.75):
        matrices = matrices_of(root, placement(turned_at(TIMES, QUATERNIONS, time)))
        points, _, _ = shape(scene, time)
        np.testing.assert_allclose(points, bent(POINTS + time * shift, NORMALS, SHARES, matrices)[0], atol=3e-6)
        box = scene.node_box(0, time)
        assert (points >= box[0] - 1e-6).all() and (points <= box[1] + 1e-6).all()
        assert (box[1] - box[0] < 2.5 * np.ptp(points, axis=0) + 0.5).all()


def test_instances_of_a_mesh_that_morphs(tmp_path):
    glb, at = blob()
    animate(glb, 0, "weights", [0, 1], [[0, 0], [1, 1]])
    places = glb.accessor(np.float32([[0, 0, 0], [5, 0, 0]]))
    glb.json["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": places}}}
    glb.json["extensionsUsed"] = ["EXT_mesh_gpu_instancing"]
    first, second = np.split(shape(loaded(glb, tmp_path), 0.5)[0], 2)
    np.testing.assert_allclose(first, at([0.5, 0.5])[0], atol=1e-6)
    np.testing.assert_allclose(second, first + np.float32([5, 0, 0]), atol=1e-6)


# ---- faults ----


def attributes_of(glb):
    return glb.json["meshes"][0]["primitives"][0]["attributes"]


def drop(name):
    return lambda glb: attributes_of(glb).pop(name)


def set_skin(**fields):
    return lambda glb: glb.json["skins"][0].update(fields)


def set_joints(values, dtype=np.uint8):
    return lambda glb: attributes_of(glb).update(
        JOINTS_0=glb.accessor(np.broadcast_to(values, (len(POINTS), 4)), dtype)
    )


def set_weights(values):
    return lambda glb: attributes_of(glb).update(WEIGHTS_0=glb.accessor(np.broadcast_to(values, (len(POINTS), 4))))


def few_binds(glb):
    glb.json["skins"][0]["inverseBindMatrices"] = glb.accessor(np.eye(4).reshape(1, 16))


def wrong_binds(glb):
    glb.json["skins"][0]["inverseBindMatrices"] = glb.accessor(np.zeros((2, 4)))


def nan_binds(glb):
    values = np.tile(np.eye(4).ravel(), (2, 1))
    values[1, 3] = np.nan
    glb.json["skins"][0]["inverseBindMatrices"] = glb.accessor(values)


FAULTS = {
    "joint is no node": (set_skin(joints=[1, 9]), r"skin 'bones': joints: names node 9, and the file has 3 nodes"),
    "no joints": (set_skin(joints=[]), r"skin 'bones': joints must list at least one node"),
    "joints are texts": (set_skin(joints=["a"]), r"skin 'bones': joints must be a list of whole numbers"),
    "few matrices": (few_binds, r"skin 'bones': has 2 joints and 1 inverse bind matrices"),
    "matrices of 4": (wrong_binds, r"inverseBindMatrices of skin 'bones': accessor \d+ is VEC4"),
    "matrix is no number": (nan_binds, r"inverseBindMatrices of skin 'bones': the matrix of joint 1 is not finite"),
    "no such skin": (
        lambda glb: glb.json["nodes"][0].update(skin=3),
        r"node 'bar': names skin 3, and the file has 1 sk",
    ),
    "no weights": (drop("WEIGHTS_0"), r"mesh 'bar': has JOINTS_0 without WEIGHTS_0, and skin 'bones' needs both"),
    "no joints of vertices": (drop("JOINTS_0"), r"mesh 'bar': has WEIGHTS_0 without JOINTS_0"),
    "neither": (
        lambda glb: (drop("JOINTS_0")(glb), drop("WEIGHTS_0")(glb)),
        r"mesh 'bar': has no JOINTS_0, and skin 'bones' needs both",
    ),
    "joint out of range": (set_joints([0, 2, 0, 0]), r"mesh 'bar': vertex 0 names joint 2, and skin 'bones' has 2"),
    "joints are no whole numbers": (set_joints(0, np.float32), r"mesh 'bar': JOINTS_0 must be whole numbers"),
    "weight below 0": (
        set_weights([1, -1, 0, 0]),
        r"mesh 'bar': weights must be from 0 up, got \[1.0, -1.0, .* vertex 0",
    ),
    "weight is no number": (set_weights([1, np.nan, 0, 0]), r"weights must be from 0 up, got \[1.0, nan"),
    "too few vertices": (
        lambda glb: attributes_of(glb).update(JOINTS_0=glb.accessor(np.zeros((3, 4)), np.uint8)),
        r"mesh 'bar': has 42 positions and 3 values of JOINTS_0",
    ),
    "second set by half": (
        lambda glb: attributes_of(glb).update(JOINTS_1=attributes_of(glb)["JOINTS_0"]),
        r"mesh 'bar': has JOINTS_1 without WEIGHTS_1",
    ),
    "joint outside the scene": (
        lambda glb: glb.json.update(scenes=[{"nodes": [0]}]),
        r"skin 'bones': its joint node 'lower' is not in the scene, as node 'bar' is",
    ),
    "weights without targets": (
        lambda glb: animate(glb, 0, "weights", [0, 1], [[0], [1]]),
        r"animation 0: moves weights of node 'bar', whose mesh has no morph targets",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_skin_is_one_line(tmp_path, fault):
    spoil, message = FAULTS[fault]
    glb = skinned_bar()
    # it is fine without the fault
    assert loaded(glb, tmp_path).triangle_count == len(FACES)
    spoil(glb)
    with pytest.raises(SceneError, match=message) as caught:
        gi.load_scene(glb.write(tmp_path / "a.glb"))
    assert "\n" not in str(caught.value) and "a.glb" in str(caught.value)


def test_weights_of_the_wrong_number_are_told(tmp_path):
    glb, _ = blob()
    animate(glb, 0, "weights", [0, 1], [[0], [1]])
    with pytest.raises(SceneError, match="has 2 times and 2 values of weights; expected 4"):
        loaded(glb, tmp_path)


# ---- edits ----


EDITS = [
    lambda s: s.nodes[0].skin.joint_from_mesh.__setitem__((1, 1, 3), -2.0),
    lambda s: setattr(s.nodes[0], "skin", None),
    lambda s: s.nodes[0].meshes[0].points.__setitem__((3, 0), 0.9),
    lambda s: setattr(s.nodes[2], "parent_from_node", np.eye(4)),
]


@pytest.mark.parametrize("edit", EDITS)
@pytest.mark.parametrize("in_use", [False, True])
def test_edits_of_what_bends_a_mesh_are_followed(tmp_path, edit, in_use):
    scene = loaded(skinned_bar(), tmp_path)
    if in_use:
        scene.data("cpu")
    before = scene.geometry_hash
    edit(scene)
    scene.check_unchanged()
    new = gi.Scene(scene.nodes, environment=scene.environment)
    assert scene.geometry_hash == new.geometry_hash != before


@pytest.mark.parametrize("in_use", [False, True])
def test_a_joint_that_rests_cannot_be_given_keyframes(tmp_path, in_use):
    scene = loaded(skinned_bar(), tmp_path)
    if in_use:
        scene.data("cpu")
    scene.nodes[1].keyframes = [gi.Keyframe(0.0)]
    with pytest.raises(SceneError, match="keyframes of node 1 'lower'"):
        scene.check_unchanged()


@pytest.mark.parametrize("in_use", [False, True])
def test_edits_of_no_account(tmp_path, in_use):
    scene = loaded(skinned_bar(), tmp_path)
    if in_use:
        scene.data("cpu")
    node = scene.nodes[0]
    node.skin.joint_from_mesh = node.skin.joint_from_mesh.copy()
    node.meshes[0].joints = node.meshes[0].joints.astype(np.int64)
    node.parent_from_node = placement(translation=(1, 2, 3))
    scene.check_unchanged()
