"""What a command refuses before it loads a scene, paths from home, and the axis that points up."""

from pathlib import Path

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.cli import main as cli
from warp_gi.errors import SceneError
from warp_gi.files import user_path
from warp_gi.scene.animation import pose_matrix, turned_quaternion
from warp_gi.scene.files.parts import SceneParts
from warp_gi.scene.loading import UPRIGHT

TRIANGLE = "v 0 0 0\nv 2 0 0\nv 0 3 1\nf 1 2 3\n"
SMALL = ["--pipeline=path", "--spp=1", "--resolution=8x8", "--quiet"]


@pytest.fixture
def no_scene(monkeypatch):
    """Fail if a scene is loaded."""
    monkeypatch.setattr("warp_gi.cli.render.find_scene", lambda options: pytest.fail("the scene was loaded"))
    monkeypatch.setattr("warp_gi.cli.bake.find_scene", lambda options: pytest.fail("the scene was loaded"))


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["render", "cornell_box", "--frames=3-1"], "frames '3-1' not understood"),
        (["render", "cornell_box", "-o", "a.jpg"], "cannot write a.jpg: frames are .exr or .png files"),
        (["render", "cornell_box", "-o", "file/a.exr"], "file: is a file, expected a folder; give another one"),
        (["render", "cornell_box", "-o", "folder.exr"], "folder.exr: is a folder; name a file in it"),
        (["render", "cornell_box", "-o", "kept.exr"], "kept.exr: is read-only; give another name, or make it writable"),
        (["render", "cornell_box", "-o", "kept.####.exr", "--frames=1,2"], "kept.0002.exr: is read-only"),
        (["render", "cornell_box", "-o", "a.exr", "--frames=0-3"], "4 frames cannot all go to a.exr; put #### in the"),
        (["render", "cornell_box", "-o", "a.exr", "--hfov=40", "--vfov=30"], "--hfov and --vfov exclude each other"),
        (["render", "cornell_box", "-o", "a.exr", "--vfov=190"], "--vfov must be between 0 and 180 degrees, got 190"),
        (["render", "cornell_box", "-o", "a.exr", "--ortho=0"], "--ortho must be a width above 0 m, got 0"),
        (["bake", "cornell_box", "-o", "kept.safetensors"], "kept.safetensors: is read-only"),
        (["bake", "cornell_box", "-o", "a.safetensors", "--vfov=190"], "--vfov must be between 0 and 180 degrees, got"),
        (["bake", "cornell_box", "-o", "a.safetensors", "--eye", "0", "1", "2"], "--eye and --target go together"),
        (["render", ""], "the argument is empty (a variable that is not set?); give a value, or leave it out"),
        (["render", "cornell_box", "--environment", ""], "the argument after --environment is empty"),
        (["render", "cornell_box", "--environment="], "the argument of --environment is empty"),
        (["bake", ""], "the argument is empty"),
        (["info", ""], "the argument is empty"),
    ],
)
def test_what_is_refused_before_the_scene_is_loaded(tmp_path, monkeypatch, capsys, no_scene, arguments, words):
    monkeypatch.chdir(tmp_path)
    Path("file").write_text("")
    Path("folder.exr").mkdir()
    for name in ("kept.exr", "kept.0002.exr", "kept.safetensors"):
        Path(name).write_text("mine")
        Path(name).chmod(0o444)
    before = sorted(tmp_path.iterdir())
    assert cli.main(arguments) == 2
    error = capsys.readouterr().err
    assert words in error and error.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before
    assert all(path.read_text() == "mine" for path in tmp_path.glob("kept*"))


def test_read_only_files_are_not_replaced_by_any_writer(tmp_path):
    target = tmp_path / "a.exr"
    target.write_text("mine")
    target.chmod(0o444)
    pipeline = gi.Pipeline(spp=1)
    camera = gi.Camera.look_at((0, 1, 3), (0, 1, 0), resolution=(8, 8))
    with pytest.raises(OSError, match="is read-only"):
        next(gi.render(gi.builtin_scene("cornell_box"), camera, pipeline, output=target))
    (frame,) = gi.render(gi.builtin_scene("cornell_box"), camera, pipeline)
    with pytest.raises(OSError, match="is read-only"):
        gi.write_frame(frame, target)
    assert target.read_text() == "mine" and sorted(tmp_path.iterdir()) == [target]


def test_paths_from_home(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    (tmp_path / "a.obj").write_text(TRIANGLE)
    assert cli.main(["render", "~/a.obj", *SMALL, "--environment=1", "--output=~/new/a.####.exr"]) == 0
    frame = tmp_path / "new" / "a.0000.exr"
    assert frame.is_file() and gi.read_frame("~/new/a.0000.exr").index == 0
    assert gi.load_scene("~/a.obj").triangle_count == 1
    gi.CameraPath.orbit((0, 0, 0), 2).save("~/path.json")
    assert gi.CameraPath.load("~/path.json").frame_count > 1
    with pytest.raises(SceneError, match="twice as wide"):  # it is found, though it is no sky
        gi.Environment.load("~/new/a.0000.exr")
    assert user_path("~nobody-of-that-name/a") == Path("~nobody-of-that-name/a")


def test_an_empty_name_of_a_scene():
    with pytest.raises(SceneError, match="name of the scene file is empty"):
        gi.load_scene("")


@pytest.mark.parametrize(
    "up, expected",
    [("y", (0, 3, 1)), ("z", (0, 1, -3)), ("x", (-3, 0, 1))],  # of the file's point (0, 3, 1)
)
def test_the_axis_that_points_up(tmp_path, up, expected):
    (tmp_path / "a.obj").write_text(TRIANGLE)
    points = gi.load_scene(tmp_path / "a.obj", up=up)._flat.points
    assert min(np.abs(points - expected).max(axis=1)) < 1e-6
    assert np.linalg.det(UPRIGHT[up]) == pytest.approx(1)
    assert np.array_equal(np.array(UPRIGHT[up]) @ np.eye(3)["xyz".index(up)], (0, 1, 0))


@pytest.mark.parametrize("up", UPRIGHT)
def test_all_of_a_scene_is_turned(up):
    turn = np.array(UPRIGHT[up], float)
    camera = gi.Camera.look_at((1, 2, 3), (0, 0, 1))
    key = gi.Keyframe(0.0, (1.0, 2.0, 3.0), (0.5, -0.5, 0.1, 0.7), (1.0, 2.0, 3.0))
    nodes = [gi.Node("a", keyframes=[key]), gi.Node("b", parent=0)]
    lights = [
        gi.PunctualLight("spot", (1, 1, 1), (4.0, 5.0, 6.0), (0.0, 1.0, 0.0)),
        gi.PunctualLight("point", (1, 1, 1), node=1),
    ]
    parts = SceneParts(nodes, lights, {"c": camera}).turned(turn)
    pose = parts.nodes[0].keyframes[0]
    got = pose_matrix(pose.translation, pose.rotation, pose.scale)
    want = pose_matrix(key.translation, key.rotation, key.scale)
    assert np.allclose(got[:3], turn @ want[:3])
    assert np.array_equal(parts.nodes[1].parent_from_node, np.eye(4))
    assert np.allclose(parts.lights[0].position, turn @ (4, 5, 6)) and np.allclose(
        parts.lights[0].direction, turn[:, 1]
    )
    assert parts.lights[1].position == (0, 0, 0)
    assert np.allclose(parts.cameras["c"].world_from_camera[:3], turn @ camera.world_from_camera[:3])


def test_quaternions_of_half_turns():
    for turn in (np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1])):
        both = pose_matrix((0, 0, 0), turned_quaternion(turn, (0.1, 0.2, 0.3, 0.9)), (1, 1, 1))
        assert np.allclose(both[:3, :3], turn @ pose_matrix((0, 0, 0), (0.1, 0.2, 0.3, 0.9), (1, 1, 1))[:3, :3])


def test_a_far_scene_may_be_turned(tmp_path):
    far = np.array([446_123.0, 5_411_987.0, 52.0])
    lines = [f"v {x!r} {y!r} {z!r}\n" for x, y, z in np.add(far, [[0, 0, 0], [2, 0, 0], [0, 3, 1]]).tolist()]
    (tmp_path / "a.obj").write_text("".join(lines) + "f 1 2 3\n")
    scene = gi.load_scene(tmp_path / "a.obj", up="z", recentre=True)
    points = scene._flat.points + scene.offset
    assert min(np.abs(points - (far[0], far[2] + 1, -far[1] - 3)).max(axis=1)) < 1e-4


def test_the_command_line_turns(tmp_path, capsys):
    (tmp_path / "a.obj").write_text(TRIANGLE)
    command = ["render", str(tmp_path / "a.obj"), *SMALL, "--environment=1", "-o", str(tmp_path / "a.exr")]
    view = ["--eye", "0.5", "9", "-0.5", "--target", "0.5", "0", "-0.6", "--hfov=10"]
    assert cli.main([*command, *view, "--up=z"]) == 0
    assert gi.read_frame(tmp_path / "a.exr").numpy("alpha")[4, 4] == 1
    assert cli.main(["render", "cornell_box", "--up=z"]) == 2
    assert "--up and --recentre go with a scene from a file" in capsys.readouterr().err
