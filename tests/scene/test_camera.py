"""Cameras and camera paths: conventions, interpolation, files, errors."""

import json

import numpy as np
import pytest
from scene_tools import GlbBuilder

import warp_gi as gi
from warp_gi.cli.inputs import scene_camera
from warp_gi.cli.render import find_shots, parse
from warp_gi.errors import GiError, OptionError, SceneError
from warp_gi.scene.camera import Camera, CameraKey, CameraPath


def test_project_puts_the_target_in_the_middle_and_up_is_up():
    camera = Camera.look_at((1, 2, 3), (4, 2, -1), hfov=90, resolution=(200, 100))
    target, above, right = (4, 2, -1), (4, 3, -1), (4 + 0.8, 2, -1 + 0.6)
    pixels = camera.project(np.array([target, above, right]))
    assert np.allclose(pixels[0], [100, 50])
    assert np.allclose(pixels[1], [100, 50 - 100 / 5])  # 5 m away, 90 degrees: 100 pixels are 5 m
    assert np.allclose(pixels[2], [100 + 100 / 5, 50])


def test_directions_lead_through_the_pixels_that_points_project_to():
    camera = Camera.look_at((1, 2, 3), (4, 1, -1), hfov=70, resolution=(200, 100))
    pixels = np.array([(0, 0), (200, 100), (13.5, 77.25), (100, 50)])
    directions = camera.directions(pixels)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1)
    assert np.allclose(camera.project(camera.position + 3 * directions), pixels)


def test_axes_are_made_orthonormal():
    camera = Camera(np.diag([2.0, 3.0, 4.0, 1.0]))
    assert np.allclose(camera.world_from_camera, np.eye(4))


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: Camera.look_at((0, 0, 0), (0, 0, 0)), "cannot look at"),
        (lambda: Camera.look_at((0, 0, 0), (0, 1, 0)), "cannot look at"),
        (lambda: Camera(np.eye(4), hfov=180), "hfov"),
        (lambda: Camera(np.eye(4), resolution=(0, 5)), "resolution"),
        (lambda: Camera(np.eye(4), resolution=(1 << 16, 1 << 15)), "resolution must be at most"),
        (lambda: Camera(np.full((4, 4), np.nan)), "finite"),
        (lambda: Camera(np.zeros((4, 4))), "singular"),
        (lambda: CameraPath(()), "at least one"),
        (lambda: CameraPath((CameraKey(1, (0, 0, 0), (1, 0, 0)), CameraKey(1, (0, 0, 0), (1, 0, 0)))), "rise"),
    ],
)
def test_bad_cameras_say_why(make, words):
    with pytest.raises(OptionError, match=words):
        make()


def test_path_passes_through_its_keys_and_is_smooth():
    keys = (
        CameraKey(0.0, (0, 0, 0), (0, 0, -1), hfov=40),
        CameraKey(1.0, (1, 0, 0), (1, 0, -1), hfov=50),
        CameraKey(2.0, (2, 1, 0), (2, 1, -1), hfov=60),
    )
    path = CameraPath(keys, fps=10)
    assert path.frame_count == 21
    for key in keys:
        camera = path.camera_at(key.time)
        assert np.allclose(camera.position, key.eye) and camera.hfov == pytest.approx(key.hfov)
    step = 1e-4
    before = (path.camera_at(1.0).position - path.camera_at(1.0 - step).position) / step
    after = (path.camera_at(1.0 + step).position - path.camera_at(1.0).position) / step
    assert np.allclose(before, after, atol=1e-2)
    assert np.allclose(path.camera_at(-5).position, keys[0].eye)
    assert np.allclose(path.camera_at(99).position, keys[-1].eye)


def test_path_survives_a_file(tmp_path):
    path = CameraPath.orbit((0, 1, 0), radius=3, height=1, seconds=1)
    path.save(tmp_path / "path.json")
    again = CameraPath.load(tmp_path / "path.json")
    assert again == path
    assert np.array_equal(again.camera(7).world_from_camera, path.camera(7).world_from_camera)


@pytest.mark.parametrize(
    "text, words",
    [
        ("{", "not JSON"),
        ("{}", "keyframes"),
        ("[]", "path.json"),
        (json.dumps({"keyframes": [{"eye": [0, 0, 0]}]}), "target"),
        (json.dumps({"keyframes": [{"eye": [0, 0], "target": [1, 0, 0]}]}), "path.json"),
        (json.dumps({"keyframes": [{"eye": [0, 0, 0], "target": [0, 0, 0]}]}), "cannot look at"),
        (json.dumps({"keyframes": [{"eye": [0, 0, 1], "target": [0, 0, 0], "time": float("inf")}]}), "finite"),
        (json.dumps({"keyframes": [{"eye": [0, 0, 1], "target": [0, 0, 0], "time": -1}]}), "0 s or later"),
    ],
)
def test_bad_files_are_one_line(tmp_path, text, words):
    (tmp_path / "path.json").write_text(text)
    with pytest.raises(GiError, match=words) as caught:
        CameraPath.load(tmp_path / "path.json")
    assert "\n" not in str(caught.value)


def test_missing_file(tmp_path):
    with pytest.raises(SceneError, match=r"nothing.json"):
        CameraPath.load(tmp_path / "nothing.json")


def test_path_from_gltf_follows_the_camera_node(tmp_path):
    glb = GlbBuilder()
    lens = glb.add("cameras", {"type": "perspective", "perspective": {"yfov": 0.5, "aspectRatio": 2.0, "znear": 0.1}})
    glb.add("nodes", {"name": "wall", "mesh": glb.mesh(glb.add("materials", {"name": "grey"}))})
    glb.add("nodes", {"name": "view", "camera": lens})
    samplers = [{"input": glb.accessor([0.0, 1.0]), "output": glb.accessor([[0, 0, 5], [2, 0, 5]])}]
    glb.add(
        "animations",
        {"samplers": samplers, "channels": [{"sampler": 0, "target": {"node": 1, "path": "translation"}}]},
    )
    glb.json["scenes"] = [{"nodes": [0, 1]}]
    glb.write(tmp_path / "moving.glb")
    path = CameraPath.from_gltf(tmp_path / "moving.glb", fps=10)
    assert path.frame_count == 11
    assert np.allclose(path.camera(5).position, [1, 0, 5], atol=1e-5)
    assert path.camera(5).hfov == pytest.approx(np.degrees(2 * np.arctan(2 * np.tan(0.25))))
    with pytest.raises(OptionError, match="did you mean 'view'"):
        CameraPath.from_gltf(tmp_path / "moving.glb", name="vie")
    scene = gi.load_scene(tmp_path / "moving.glb")
    shots = find_shots(parse([str(tmp_path / "moving.glb")]), scene_camera(scene, "view"))
    assert len(shots) == 25 and np.allclose(shots[12].camera.position, [1, 0, 5], atol=1e-5)


@pytest.mark.parametrize(
    "changes, what",
    [
        ({"up": 60.0}, "up of a camera key must be 3 numbers, got 60.0"),
        ({"eye": (0, 0)}, "eye of a camera key must be 3 numbers"),
        ({"target": "here"}, "target of a camera key must be 3 numbers"),
        ({"lens_shift": 0.1}, "lens_shift of a camera key must be 2 numbers"),
        ({"hfov": "60"}, "hfov of a camera key must be a number"),
        ({"time": None}, "time of a camera key must be a number"),
    ],
)
def test_values_of_keys_are_numbers(changes, what):
    values = {"time": 0.0, "eye": (0, 0, 3), "target": (0, 0, 0)}
    with pytest.raises(OptionError, match=what):
        gi.CameraKey(**values | changes)
    assert gi.CameraKey(0.0, np.zeros(3), [0, 0, 1]) == gi.CameraKey(0.0, (0, 0, 0), (0, 0, 1))
