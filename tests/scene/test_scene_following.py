"""Edits between frames, as programs make them: poses, points, colours and lamps in loops, motion, and bakes."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest
from scene_tools import triangle

import warp_gi as gi
from warp_gi.errors import BakeError, OptionError, SceneError
from warp_gi.scene.model import Keyframe, Material, Mesh, MorphKeyframe, MorphTarget, Node, PunctualLight, Skin, Texture

SIZE = (16, 12)
CAMERA = gi.Camera.look_at((0.0, 1.0, 4.0), (0.0, 0.6, 0.0), resolution=SIZE)
DIRECT = gi.Pipeline.preset("direct", spp=1)
PATH = gi.Pipeline(spp=1)


def moved(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, 3] = x, y, z
    return matrix


def sheet(material: Material, side: int = 4, size: float = 4.0, name: str = "sheet") -> Mesh:
    """Return a square in the xz plane around the origin, of side * side * 2 triangles that face up."""
    v, u = np.meshgrid(*[np.linspace(0.0, 1.0, side + 1)] * 2, indexing="ij")
    points = np.stack([size * (u - 0.5), 0 * u, size * (0.5 - v)], -1).reshape(-1, 3).astype(np.float32)
    corner = (np.arange(side) + (side + 1) * np.arange(side)[:, None]).ravel()
    faces = [[corner, corner + 1, corner + side + 2], [corner, corner + side + 2, corner + side + 1]]
    indices = np.concatenate([np.stack(face, -1) for face in faces]).astype(np.int32)
    return Mesh(points, indices, material, uvs=np.stack([u, v], -1).reshape(-1, 2).astype(np.float32), name=name)


def robot(**more) -> gi.Scene:
    """Return an arm of two links on a floor, with a lamp in its hand and a light on its shoulder."""
    steel = Material("steel", base_color=(0.6, 0.5, 0.4))
    lamp = Material("lamp", emission=(2.0, 2.0, 1.0))
    nodes = [
        Node("floor", [sheet(Material("floor"))]),
        Node("shoulder", [triangle(steel, name="link")], moved(-0.5, 0.2)),
        Node("elbow", [triangle(replace(steel, name="iron"), name="link")], moved(0.0, 0.5, 0.1), parent=1),
        Node("hand", [triangle(lamp, name="bulb")], moved(0.2, 0.3, 0.2) @ np.diag((0.3, 0.3, 0.3, 1.0)), parent=2),
    ]
    lights = [PunctualLight("point", (1.0, 2.0, 3.0), (0.5, 0.5, 0.5), name="beam", node=1)]
    return gi.Scene(nodes, lights, (0.2, 0.3, 0.4), name="robot", **more)


def fresh(scene: gi.Scene) -> gi.Scene:
    """Return a new scene of what a scene was edited to."""
    return gi.Scene(scene.nodes, scene.lights, scene.environment, name=scene.name)


def assert_same_picture(frame, scene: gi.Scene, pipeline: gi.Pipeline = PATH, names=("beauty", "normal")) -> None:
    truth = next(gi.render(fresh(scene), CAMERA, pipeline, frames=[frame.index]))
    for name in names:
        np.testing.assert_array_equal(frame.numpy(name), truth.numpy(name), err_msg=name)
    assert scene.hash == fresh(scene).hash


# ---- loops ----


def test_a_robot_moves_by_assignments():
    """One generator over all frames: lamps and lights that nodes carry go along."""
    scene, seen = robot(), []
    for frame in gi.render(scene, CAMERA, PATH, frames=range(4)):
        assert_same_picture(frame, scene)
        seen.append(frame.numpy("beauty"))
        scene.nodes[1].parent_from_node = moved(-0.5 + 0.2 * frame.index, 0.2, 0.1)
        scene.nodes[2].parent_from_node[1, 3] += 0.05  # in place
    assert all(not np.array_equal(one, other) for one, other in itertools.pairwise(seen))


@pytest.mark.parametrize("is_alive", [True, False], ids=["one scheduler", "a call each"])
def test_a_color_in_a_loop(is_alive):
    scene = robot()
    scheduler = gi.FrameScheduler(scene, CAMERA, PATH)
    for red in (0.2, 0.5, 0.9):
        scene.materials[0].base_color = (red, 0.5, 0.5)
        scene.nodes[3].meshes[0].material.emission = (red, 1.0, 1.0)
        frame = scheduler.frame(0) if is_alive else next(gi.render(scene, CAMERA, PATH))
        assert_same_picture(frame, scene)


def test_a_lamp_goes_out_and_another_material_begins_to_shine():
    scene = robot()
    next(gi.render(scene, CAMERA, PATH))
    scene.materials[3].emission = (0.0, 0.0, 0.0)
    scene.lights.clear()
    assert_same_picture(next(gi.render(scene, CAMERA, PATH)), scene)
    assert scene.emitter_count == 0
    scene.materials[1].emission = (3.0, 0.0, 0.0)
    assert_same_picture(next(gi.render(scene, CAMERA, PATH)), scene)
    assert scene.emitter_count == 1


def test_lamps_follow_the_size_of_things():
    """One without an area shines no more, and light from afar has a power by the size of the scene."""
    scene = robot()
    scene.lights.append(PunctualLight("directional", (0.3, 0.3, 0.3), direction=(0.0, -1.0, -0.2)))
    pipeline = replace(PATH, emitters=gi.PowerLights())
    scheduler = gi.FrameScheduler(scene, CAMERA, pipeline)
    scheduler.frame(0)
    powers = scene.emitter_powers()
    scene.nodes[0].parent_from_node = np.diag((9.0, 1.0, 9.0, 1.0))
    assert_same_picture(scheduler.frame(0), scene, pipeline)
    assert scene.emitter_powers()[-1] > 9 * powers[-1]
    shown = scene.nodes[3].parent_from_node
    scene.nodes[3].parent_from_node = shown @ np.diag((1e-12, 1e-12, 1e-12, 1.0))
    assert_same_picture(scheduler.frame(0), scene, pipeline)
    assert scene.emitter_count == 2
    scene.nodes[3].parent_from_node = shown
    assert_same_picture(scheduler.frame(0), scene, pipeline)
    assert scene.emitter_count == 3


def test_points_are_set_by_a_call():
    scene = robot()
    floor = scene.nodes[0].meshes[0]
    scheduler = gi.FrameScheduler(scene, CAMERA, PATH)
    scheduler.frame(0)
    waves = floor.points.copy()
    waves[:, 1] += 0.2 * np.sin(3 * waves[:, 0])
    scene.set_points(floor, waves)
    assert_same_picture(scheduler.frame(1), scene)
    normals = np.tile((0.0, 0.8, 0.6), (len(waves), 1))
    scene.set_points(scene.nodes[0], (waves - (0.0, 0.1, 0.0)).tolist(), normals)
    frame = scheduler.frame(2)
    assert_same_picture(frame, scene)
    on_floor = frame.numpy("object_id") == 0
    np.testing.assert_allclose(frame.numpy("normal")[on_floor], [(0.0, 0.8, 0.6)] * on_floor.sum(), atol=1e-6)
    floor.normals = None
    assert_same_picture(scheduler.frame(3), scene)


def test_points_that_do_not_fit_are_refused_and_nothing_has_changed():
    scene = robot()
    floor = scene.nodes[0].meshes[0]
    kept = floor.points
    for target, points, normals, message in (
        (floor, kept[1:], None, r"mesh 'sheet': points must be \[25, 3\] as before, got \[24, 3\]"),
        (floor, np.full_like(kept, np.nan), None, "mesh 'sheet': 25 of 25 vertices are not finite"),
        (floor, kept + 1, kept[1:], r"mesh 'sheet': normals must be \[25, 3\] as before"),
        (floor, "points", None, r"mesh 'sheet': expected numbers \[vertex, 3\], got 'points'"),
        (sheet(Material()), kept, None, "mesh 'sheet' is not in scene 'robot'"),
        ("floor", kept, None, "expected a Mesh or a Node of the scene, got 'floor'"),
        (Node("empty"), kept, None, "node 'empty' has 0 meshes; give the one to move"),
    ):
        with pytest.raises(SceneError, match=message) as caught:
            scene.set_points(target, points, normals)
        assert "\n" not in str(caught.value)
    assert floor.points is kept and floor.normals is None


def test_what_bends_follows():
    """Joints that are moved, weights of morph targets, and their shapes."""
    points = np.float32([[-0.5, 0, 0], [0.5, 0, 0], [0, 1, 0]])
    mesh = Mesh(points, np.int32([[0, 1, 2]]), Material("skin"), np.tile(np.float32([0, 0, 1]), (3, 1)))
    mesh.joints, mesh.joint_weights = np.int32([[0, 1]] * 3), np.float32([[1, 0], [1, 0], [0.3, 0.7]])
    mesh.targets = [MorphTarget(np.float32([[0, 0, 0], [0, 0, 0], [0.5, 0, 0]]))]
    skin = Skin([1, 2], np.stack([np.eye(4)] * 2))
    bent = Node("bent", [mesh], skin=skin, morphs=[MorphKeyframe(0.0, (0.0,))])
    scene = gi.Scene([bent, Node("root"), Node("tip")], environment=1.0, name="bent")
    scheduler = gi.FrameScheduler(scene, CAMERA, DIRECT)
    pictures = [scheduler.frame(0).numpy("position")]
    for edit in (
        lambda: setattr(scene.nodes[2], "parent_from_node", moved(0.4, 0.3)),
        lambda: setattr(scene.nodes[0], "morphs", [MorphKeyframe(0.0, (0.8,))]),
        lambda: mesh.targets[0].points.__setitem__((2, 1), 0.4),
        lambda: mesh.joint_weights.__setitem__(2, (0.9, 0.1)),
        lambda: skin.joint_from_mesh.__setitem__((1, 0, 3), 0.3),
    ):
        edit()
        frame = scheduler.frame(len(pictures))
        assert_same_picture(frame, scene, DIRECT, ("beauty", "position", "normal"))
        assert not np.array_equal(frame.numpy("position"), pictures[-1])
        pictures.append(frame.numpy("position"))


def test_a_node_is_found_by_its_name():
    scene = robot()
    assert scene.node("elbow") is scene.nodes[2]
    with pytest.raises(OptionError, match="unknown node 'elbows'; did you mean 'elbow'"):
        scene.node("elbows")
    scene.nodes[1].name = "elbow"
    with pytest.raises(SceneError, match="2 nodes are named 'elbow'; give the one that is meant a name of its own"):
        scene.node("elbow")


# ---- what lets rays pass ----


def leaves() -> gi.Scene:
    pixels = np.full((4, 4, 4), 255, np.uint8)
    pixels[:2, :, 3] = 0
    leaf = Material("leaf", base_color_texture=Texture("leaf", pixels), alpha_cutoff=0.5)
    pane = Material("pane", base_color=(1.0, 0.5, 0.5), transmission=0.5, roughness=0.0)
    veil = Material("veil", alpha=0.5)
    stand = np.float64([[1, 0, 0, 0], [0, 0, -1, 1], [0, 1, 0, 0], [0, 0, 0, 1]])
    nodes = [
        Node(one.name, [sheet(one, 2, 2.0)], stand @ moved(k - 1.0, 0.3 * k))
        for k, one in enumerate((leaf, pane, veil))
    ]
    return gi.Scene([*nodes, Node("floor", [sheet(Material("floor"))])], environment=(0.2, 0.5, 1.0), name="leaves")


def solid(scene: gi.Scene) -> None:
    for one in scene.materials:
        one.alpha_cutoff, one.transmission = None, 0.0


MASKS = {
    "a cutoff": lambda s: setattr(s.materials[0], "alpha_cutoff", None),
    "texels": lambda s: s.materials[0].base_color_texture.pixels.__setitem__((slice(None), 0, 3), 0),
    "color of glass": lambda s: setattr(s.materials[1], "base_color", (0.2, 0.9, 0.2)),
    "no glass": lambda s: setattr(s.materials[1], "transmission", 0.0),
    "glass": lambda s: setattr(s.materials[3], "transmission", 0.7),
    "blended": lambda s: setattr(s.materials[2], "alpha_blend", True),
    "a texture for glass": lambda s: setattr(s.materials[1], "base_color_texture", s.materials[0].base_color_texture),
    "moved": lambda s: setattr(s.nodes[0], "parent_from_node", s.nodes[0].parent_from_node @ moved(0.4)),
    "opaque": solid,
}


@pytest.mark.parametrize("name", MASKS)
def test_what_lets_rays_pass_follows(name):
    scene = leaves()
    scheduler = gi.FrameScheduler(scene, CAMERA, PATH)
    before = scheduler.frame(0).numpy("beauty")
    MASKS[name](scene)
    frame = scheduler.frame(0)
    assert_same_picture(frame, scene, names=("beauty", "albedo", "emission", "alpha"))
    assert name == "blended" or not np.array_equal(frame.numpy("beauty"), before)
    assert scene.geometry_hash == fresh(scene).geometry_hash


def test_textures_that_share_pixels_and_part_are_told_apart():
    pixels = np.random.default_rng(1).integers(1, 255, (4, 4, 4)).astype(np.uint8)
    materials = [Material(name, base_color_texture=Texture(name, pixels)) for name in "ab"]
    scene = gi.Scene([Node(m.name, [sheet(m, 1, 2.0)], moved(k)) for k, m in enumerate(materials)], environment=1.0)
    scheduler = gi.FrameScheduler(scene, CAMERA, PATH)
    scheduler.frame(0)
    pixels[:, 0] = 7  # of both
    assert_same_picture(scheduler.frame(0), scene, names=("albedo",))
    materials[1].base_color_texture.pixels = pixels[::-1].copy()
    assert_same_picture(scheduler.frame(0), scene, names=("albedo",))


# ---- what is not followed ----


def test_a_mirrored_node_and_one_past_all_bounds_are_errors_and_can_be_undone():
    scene = robot()
    scheduler = gi.FrameScheduler(scene, CAMERA, PATH)
    before = scheduler.frame(0).numpy("beauty")
    for matrix, message in (
        (np.diag((-1.0, 1.0, 1.0, 1.0)), "node 'floor' was mirrored; make a new scene"),
        (moved(1e39), "node 'floor' moves vertices past the range of float32"),
        (np.full((4, 4), np.nan), "node 'floor': parent_from_node must be a finite 4x4 matrix"),
        (np.eye(3), "node 'floor': parent_from_node must be a finite 4x4 matrix"),
    ):
        scene.nodes[0].parent_from_node = matrix
        for _ in range(2):
            with pytest.raises(SceneError, match=message):
                scheduler.frame(0)
        scene.nodes[0].parent_from_node = np.eye(4)
        np.testing.assert_array_equal(scheduler.frame(0).numpy("beauty"), before)


def test_an_edit_that_is_refused_takes_no_other_along():
    scene = robot()
    scheduler = gi.FrameScheduler(scene, CAMERA, PATH)
    scheduler.frame(0)
    hashed, version = scene.hash, scene.version
    scene.materials[0].base_color = (0.1, 0.1, 0.9)
    scene.nodes[1].parent_from_node = moved(0.3)
    kept, scene.nodes[0].meshes[0].indices = scene.nodes[0].meshes[0].indices, np.int32([[0, 1, 2]])
    with pytest.raises(SceneError, match="indices of mesh 'sheet'"):
        scheduler.frame(0)
    assert (scene.hash, scene.version) == (hashed, version)
    scene.nodes[0].meshes[0].indices = kept
    assert_same_picture(scheduler.frame(0), scene)


# ---- what is kept over frames ----


def assert_rests(frame) -> None:
    np.testing.assert_allclose(frame.numpy("motion"), 0.0, atol=1e-4)


def test_motion_leads_to_the_pose_of_the_frame_before():
    """Of an assignment as of keyframes, for a scheduler of its own; none in a first frame, nor where nothing moved."""
    keys = [Keyframe(float(k), (0.1 * k * k, 0.2, 0.0)) for k in range(4)]
    truth = robot()
    truth.animate("shoulder", keys)
    camera = gi.CameraPath.from_cameras([CAMERA] * 4, fps=1.0)
    wanted = gi.FrameScheduler(truth, camera, DIRECT)
    scene = robot()
    ours, late = gi.FrameScheduler(scene, camera, DIRECT), gi.FrameScheduler(scene, camera, DIRECT)
    for index, key in enumerate(keys):
        scene.nodes[1].parent_from_node = moved(*key.translation)
        motion = ours.frame(index).numpy("motion")
        np.testing.assert_allclose(motion, wanted.frame(index).numpy("motion"), atol=1e-4)
        if index in (0, 2):  # two poses at once: it did not see the one between
            motion = late.frame(index, 0).numpy("motion")
            np.testing.assert_allclose(motion, wanted.frame(index, 0).numpy("motion"), atol=1e-4)
        assert (np.abs(motion).max() > 0.1) == (index > 0)
    assert_rests(ours.frame(3, 3))  # the same frame once more
    assert_rests(next(gi.render(scene, camera, DIRECT, frames=[3])))
    assert_rests(list(gi.render(scene, camera, DIRECT, frames=[2, 3]))[1])


def test_motion_leads_to_the_points_of_the_frame_before():
    scene = robot()
    floor = scene.nodes[0].meshes[0]
    scheduler = gi.FrameScheduler(scene, CAMERA, DIRECT)
    scheduler.frame(0)
    scene.set_points(floor, floor.points + np.float32([0.25, 0, 0]))
    moving = scheduler.frame(1)
    on_floor = moving.numpy("object_id") == 0
    other = robot()
    other.animate("floor", [Keyframe(0.0), Keyframe(1.0, (0.25, 0.0, 0.0))])
    camera = gi.CameraPath.from_cameras([CAMERA] * 2, fps=1.0)
    wanted = gi.FrameScheduler(other, camera, DIRECT).frame(1)
    np.testing.assert_allclose(moving.numpy("motion"), wanted.numpy("motion"), atol=1e-4)
    assert np.abs(moving.numpy("motion")[on_floor]).max() > 0.2
    assert_rests(scheduler.frame(2))


def test_motion_of_what_keyframes_move_knows_its_edits_too():
    """Keyframes that are assigned between frames do not move the past."""
    keys = [Keyframe(0.0, (0.0, 0.2, 0.0)), Keyframe(1.0, (0.3, 0.2, 0.0))]
    camera = gi.CameraPath.from_cameras([CAMERA] * 2, fps=1.0)
    truth, scene = robot(), robot()
    for one in (truth, scene):
        one.animate("shoulder", keys)
    wanted = gi.FrameScheduler(truth, camera, DIRECT).frame(1)
    scheduler = gi.FrameScheduler(scene, camera, DIRECT)
    scheduler.frame(0)
    scene.nodes[1].keyframes = [replace(keys[1], time=0.0), keys[1]]  # at its second pose always
    np.testing.assert_allclose(scheduler.frame(1).numpy("motion"), wanted.numpy("motion"), atol=1e-4)
    assert wanted.numpy("motion").any()


CLEAN = gi.Pipeline.preset("clean")
SMALL = replace(CLEAN, indirect=replace(CLEAN.indirect, ends_in=gi.SurfaceCache(paths=1000, refresh=1000)))
"""The default, with few paths in its cells."""


def history(scheduler) -> np.ndarray:
    """Return the number of samples that each pixel's diffuse light is of."""
    return scheduler.state("denoise").average.length.numpy().reshape(*SIZE[::-1], -1)[..., 0]


def test_the_first_clean_frame_after_edits_is_that_of_a_new_scene():
    scene = robot()
    next(gi.render(scene, CAMERA, SMALL))
    scene.nodes[1].parent_from_node = moved(0.2, 0.3)
    scene.materials[0].base_color = (0.1, 0.8, 0.1)
    scene.lights[0].intensity = (0.0, 2.0, 0.0)
    scene.set_points(scene.nodes[0], scene.nodes[0].meshes[0].points * np.float32([1.1, 1.0, 1.1]))
    assert_same_picture(next(gi.render(scene, CAMERA, SMALL)), scene, SMALL)


def test_clean_frames_follow_a_pose_and_begin_anew_with_a_color():
    """A moved arm keeps what is known of the floor; another colour is other light everywhere."""
    scene = robot()
    scheduler = gi.FrameScheduler(scene, CAMERA, SMALL)
    scheduler.frame(0)
    cells, first = scheduler.state("indirect.ends_in"), history(scheduler).max()
    scene.nodes[1].parent_from_node = moved(-0.45, 0.2)
    frame = scheduler.frame(1)
    assert (history(scheduler)[frame.numpy("object_id") == 0] > first).mean() > 0.8
    followed = scheduler.state("indirect.ends_in")
    assert followed.follows and not cells.follows and len(followed.keys)
    scheduler.frame(2)
    assert history(scheduler).max() > first + 1
    scene.materials[0].base_color = (0.1, 0.8, 0.1)
    frame = scheduler.frame(3)
    assert history(scheduler).max() == first
    assert not scheduler.state("indirect.ends_in").follows
    assert np.isfinite(frame.numpy("beauty")).all()


DENOISED = gi.Pipeline(spp=1, denoise="spatiotemporal")


def test_a_history_goes_on_in_a_process_that_begins_with_the_edited_scene(tmp_path):
    """Light is hashed without edits of poses while a process goes on; another one knows nothing of them."""
    scene = robot()
    scheduler = gi.FrameScheduler(scene, CAMERA, DENOISED)
    scheduler.frame(0)
    scene.nodes[1].parent_from_node = moved(-0.45, 0.2)
    scheduler.frame(1)
    scheduler.save_state(tmp_path / "a.safetensors", "x")
    wanted = scheduler.frame(2).numpy("beauty")
    for other in (fresh(scene), scene):
        later = gi.FrameScheduler(other, CAMERA, DENOISED)
        later.load_state(tmp_path / "a.safetensors", "x")
        np.testing.assert_array_equal(later.frame(2).numpy("beauty"), wanted)
    scene.environment = (0.1, 0.3, 0.4)
    late = gi.FrameScheduler(scene, CAMERA, DENOISED)
    late.load_state(tmp_path / "a.safetensors", "x")
    late.frame(2)
    first = gi.FrameScheduler(scene, CAMERA, DENOISED)
    first.frame(2)
    assert history(late).max() == history(first).max()  # another light: it begins anew


def test_cells_that_followed_an_edit_are_no_state_of_a_scene_at_rest(tmp_path):
    scene = robot()
    scheduler = gi.FrameScheduler(scene, CAMERA, SMALL)
    scheduler.frame(0)
    scene.nodes[1].parent_from_node = moved(-0.45, 0.2)
    scheduler.frame(1)
    scheduler.save_state(tmp_path / "a.safetensors", "x")
    scheduler.load_state(tmp_path / "a.safetensors", "x")  # its own
    with pytest.raises(BakeError, match=r"this bake has other settings \(bake\.indirect\.ends_in: "):
        gi.FrameScheduler(fresh(scene), CAMERA, SMALL).load_state(tmp_path / "a.safetensors", "x")


def test_cells_know_what_moved_in_the_same_frame_and_past_their_grid():
    scene = robot()
    scheduler = gi.FrameScheduler(scene, CAMERA, SMALL)
    scheduler.frame(0)
    low = scheduler.state("indirect.ends_in").cells.low
    for x in (0.1, -50.0):
        scene.nodes[3].parent_from_node = moved(x, 0.3)
        scheduler.frame(0)
        state = scheduler.state("indirect.ends_in")
        assert state.geometry == scene.geometry_hash and len(state.keys)
    assert state.cells.low[0] < scene.bounds[0, 0] < low[0]


BAKED = {
    "dvf": (gi.VisibilityField(samples=200), "environment"),
    "polygons": (gi.VisibilityPolygons(), "environment"),
    "transfer": (gi.RadianceTransfer(resolution=64, first_rays=16, rays=16, bounces=0), "environment"),
    "probes": (gi.LightFieldProbes(counts=(2, 2, 2), rays=1), "indirect"),
    "cache": (gi.SurfaceCache(paths=1000), "ends_in"),
}


def baking(name: str) -> tuple[gi.Stateful, gi.Pipeline]:
    part, place = BAKED[name]
    if place == "ends_in":
        return part, replace(PATH, indirect=gi.BsdfPaths(ends_in=part))
    return part, replace(PATH, **{place: part})


@pytest.mark.parametrize("name", BAKED)
def test_a_bake_that_was_given_is_refused_once_it_does_not_fit(name):
    """By a generator that goes on, and by a call anew; one that was made on the way is made anew."""
    part, pipeline = baking(name)
    scene = robot()
    scene.lights.clear()
    scene.nodes[3].meshes.clear()
    scene = fresh(scene)
    bake = gi.bake(scene, part, camera=CAMERA)
    given, own = (gi.FrameScheduler(scene, CAMERA, pipeline, bakes=bakes) for bakes in ([bake], []))
    np.testing.assert_array_equal(given.frame(0).numpy("beauty"), own.frame(0).numpy("beauty"))
    scene.nodes[1].parent_from_node = moved(0.3, 0.4)
    attempts = [lambda: next(gi.render(scene, CAMERA, pipeline, bakes=[bake]))]
    attempts += [] if name == "cache" else [lambda: given.frame(1)]  # cells follow
    for attempt in attempts:
        with pytest.raises(BakeError, match=r"this bake is of scene 'robot' as it was .*bake it again") as caught:
            attempt()
        assert "\n" not in str(caught.value)
    if name != "cache":
        assert_same_picture(own.frame(1), scene, pipeline)
    scene.nodes[1].parent_from_node = moved(-0.5, 0.2)
    np.testing.assert_array_equal(
        next(gi.render(scene, CAMERA, pipeline, bakes=[bake])).numpy("beauty"),
        next(gi.render(fresh(scene), CAMERA, pipeline, bakes=[bake])).numpy("beauty"),
    )


def test_what_a_bake_leaves_free_follows_at_once():
    """Colours of a visibility field that relights, and surfaces of transfer that become glossy."""
    scene = robot()
    scene = gi.Scene(scene.nodes[:3], (), (0.2, 0.5, 1.0), name="robot")
    field = gi.VisibilityField(samples=200, sky="harmonics", relight=True)
    for part in (field, gi.RadianceTransfer(resolution=64, first_rays=16, rays=16, bounces=0)):
        pipeline = replace(PATH, environment=part, indirect=None)
        scheduler = gi.FrameScheduler(scene, CAMERA, pipeline)
        scheduler.frame(0)
        for number, roughness in enumerate((0.9, 0.05, 0.8)):
            scene.materials[0].base_color = (0.1 + 0.2 * number, 0.3, 0.3)
            scene.materials[0].roughness = roughness
            assert_same_picture(scheduler.frame(0), scene, pipeline)


# ---- an interrupt ----


@pytest.mark.parametrize("where", ["geometry.write", "emitters.emissive_triangles", "Watch"])
def test_an_interrupted_edit_is_taken_over_by_the_next_frame(where, monkeypatch):
    from warp_gi.scene import edits, following

    scene = robot()
    scheduler = gi.FrameScheduler(scene, CAMERA, PATH)
    scheduler.frame(0)
    scene.nodes[1].parent_from_node = moved(0.3, 0.4)
    scene.materials[3].emission = (5.0, 0.0, 0.0)
    scene.materials[0].base_color = (0.5, 0.0, 0.0)
    owner, _, name = where.rpartition(".")
    target = getattr(following, owner) if owner else edits

    def interrupt(*arguments, **more):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(target, name, interrupt)
        with pytest.raises(KeyboardInterrupt):
            scheduler.frame(0)
    assert_same_picture(scheduler.frame(0), scene)


def test_memory_of_trails_is_given_back():
    scene = robot()
    scheduler = gi.FrameScheduler(scene, CAMERA, DIRECT)
    for index in range(3):
        scheduler.frame(index)
        scene.set_points(scene.nodes[0], scene.nodes[0].meshes[0].points + np.float32(0.01))
        list(gi.render(scene, CAMERA, DIRECT))
    assert len(scene._devices["cpu"].trails) == 1


def test_every_owner_of_an_array_is_told_of_its_edit():
    """Two meshes may have one array of points, and two textures one of pixels: all of them show an edit in place."""
    points = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]])
    pixels = np.zeros((2, 2, 4), np.uint8)
    pixels[..., 3] = 255
    first, second = gi.Texture("first", pixels), gi.Texture("second", pixels)
    uvs = np.zeros((3, 2), np.float32)
    plain = gi.Material("plain", base_color_texture=first)
    lamp = gi.Material("lamp", emission=(1, 1, 1), emission_texture=second)
    faces = np.int32([[0, 1, 2]])
    meshes = [gi.Mesh(points, faces, material, uvs=uvs, name=material.name) for material in (plain, lamp)]
    scene = gi.Scene([gi.Node(mesh.name, [mesh]) for mesh in meshes])
    scene.data("cpu")
    pixels[..., :3] = 200
    scene.check_unchanged()
    assert scene.emitter_count == gi.Scene(scene.nodes).emitter_count == 1
    points[1, 0] = 3.0
    scene.check_unchanged()
    assert np.array_equal(scene._flat.points, gi.Scene(scene.nodes)._flat.points)
    assert (scene._flat.points[:, 0] == 3.0).sum() == 2


def test_a_lamp_that_opens_later_and_is_lit_by_an_edit_is_among_the_lights():
    keys = [gi.Keyframe(0.0, scale=(0.0, 0.0, 0.0)), gi.Keyframe(1.0)]
    dark = gi.Material("lamp")
    mesh = gi.Mesh(np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.int32([[0, 1, 2]]), dark)
    scene = gi.Scene([gi.Node("lamp", [mesh], keyframes=keys)])
    scene.data("cpu")
    dark.emission = (5.0, 5.0, 5.0)
    scene.check_unchanged()
    assert scene.emitter_count == 1 and scene.hash == gi.Scene(scene.nodes).hash


def test_nodes_that_come_are_one_line():
    scene = gi.Scene([gi.Node("one", [gi.Mesh(np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.int32([[0, 1, 2]]))])])
    scene.data("cpu")
    scene.nodes.append(gi.Node("empty"))
    with pytest.raises(gi.SceneError, match="node 'empty' was added"):
        scene.check_unchanged()
