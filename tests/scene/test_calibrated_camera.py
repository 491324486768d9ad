"""Cameras with a principal point off the centre and pixels that are no squares, on the host and in kernels."""

import json
import math

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.cli import main as cli
from warp_gi.errors import OptionError, SceneError
from warp_gi.scene.camera import CameraPath
from warp_gi.sequence.frames import camera_matrices, frame_attributes

SIZE = (48, 32)
K = np.array([[60.0, 0.0, 19.5], [0.0, 45.0, 20.25], [0.0, 0.0, 1.0]])
ONE_SAMPLE = gi.Pipeline.preset("path", spp=1, camera_samples=1, denoise=None)


def placement(angle=0.3, eye=(0.4, 1.1, 2.9)):
    """Return a placement in OpenCV's axes: x right, y down, z forward."""
    c, s = math.cos(angle), math.sin(angle)
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ np.diag([1.0, -1.0, -1.0])
    matrix[:3, 3] = eye
    return matrix


def by_hand(points, intrinsics, world_from_camera):
    """Return pixels of points: K [R | t] x, as books on computer vision have it."""
    local = (np.linalg.inv(world_from_camera) @ np.concatenate([points, np.ones((len(points), 1))], axis=1).T)[:3]
    u, v, w = intrinsics @ local
    return np.stack([u / w, v / w], axis=1)


POINTS = np.random.default_rng(5).uniform((-1, 0, -2), (1, 2, 1), (20, 3))


def test_projection_is_that_of_the_books():
    camera = gi.Camera.from_intrinsics(K, placement(), SIZE)
    assert np.allclose(camera.project(POINTS), by_hand(POINTS, K, placement()), atol=1e-9)
    assert np.allclose(camera.intrinsics, K)
    ways = camera.directions(camera.project(POINTS))
    towards = POINTS - camera.position
    assert np.allclose(ways, towards / np.linalg.norm(towards, axis=1, keepdims=True))
    gl = gi.Camera.from_intrinsics(K, placement() @ np.diag([1.0, -1, -1, 1]), SIZE, convention="opengl")
    assert np.allclose(gl.project(POINTS), camera.project(POINTS))
    assert np.allclose(gi.Camera.from_intrinsics(K, placement()[:3], SIZE).project(POINTS), camera.project(POINTS))


def test_another_resolution_scales_what_is_seen():
    camera = gi.Camera.from_intrinsics(K, placement(), SIZE).at_resolution(96, 64)
    assert np.allclose(camera.project(POINTS), 2 * by_hand(POINTS, K, placement()))


@pytest.mark.parametrize("moved", [False, True])
def test_rays_and_motion_of_pictures(moved):
    """Every pixel shows what lies behind its middle, and says where that was in the picture before."""
    scene = gi.builtin_scene("cornell_box")
    now = gi.Camera.from_intrinsics(K, placement(), SIZE)
    if not moved:
        path = CameraPath.from_cameras([now, now])
        before = now
    else:
        before = gi.Camera.from_intrinsics(K * [[1.1, 1, 0.9], [1, 0.9, 1.2], [1, 1, 1]], placement(0.25), SIZE)
        path = CameraPath.from_cameras([before, now])
    frame = list(gi.render(scene, path, ONE_SAMPLE, frames=[0, 1]))[1]
    hit = frame.numpy("object_id") >= 0
    assert hit.mean() > 0.5
    rows, columns = np.nonzero(hit)
    middles = np.stack([columns, rows], axis=1) + 0.5
    places = frame.numpy("position")[hit].astype(np.float64)
    assert np.abs(by_hand(places, K, placement()) - middles).max() < 2e-3
    assert np.abs(frame.numpy("motion")[hit] - (before.project(places) - middles)).max() < 5e-3
    if not moved:
        assert np.abs(frame.numpy("motion")).max() < 5e-3
    depths = (np.linalg.inv(placement()) @ np.concatenate([places, np.ones((len(places), 1))], axis=1).T)[2]
    assert np.allclose(frame.numpy("depth")[hit], depths, rtol=1e-5)


def test_square_pixels_and_a_centred_point_are_the_plain_camera():
    plain = gi.Camera.look_at((0, 1, 3), (0, 1, 0), hfov=50.0, resolution=SIZE)
    same = gi.Camera.from_intrinsics(plain.intrinsics, plain.world_from_camera, SIZE, "opengl")
    assert same.hfov == pytest.approx(50.0) and same.pixel_aspect == pytest.approx(1.0)
    assert np.allclose(same.lens_shift, 0.0)


def test_the_footprint_is_the_longer_side_of_a_pixel():
    assert gi.Camera.from_intrinsics(K, placement(), SIZE).footprint == pytest.approx(1 / 45.0)
    assert gi.Camera.from_intrinsics(K[[1, 0, 2]][:, [1, 0, 2]], placement(), SIZE).footprint == pytest.approx(1 / 45.0)


def test_a_lens_shift_moves_the_picture_not_the_view():
    straight = gi.Camera.look_at((0, 1, 3), (0, 1, 0), resolution=SIZE)
    shifted = gi.Camera.look_at((0, 1, 3), (0, 1, 0), resolution=SIZE, lens_shift=(0.25, -0.5))
    moved = shifted.project(POINTS) - straight.project(POINTS)
    assert np.allclose(
        moved, (-0.25 * SIZE[0], -0.5 * SIZE[1])
    )  # the picture went right and down, its content left, up
    assert np.array_equal(shifted.world_from_camera, straight.world_from_camera)


@pytest.mark.parametrize("shape", [(64, 64), (96, 32)])
def test_a_vertical_field_of_view_stays(shape):
    camera = gi.Camera.look_at((0, 1, 3), (0, 1, 0), vfov=40.0, resolution=SIZE).at_resolution(*shape)
    assert camera.vfov == pytest.approx(40.0)
    assert math.tan(math.radians(camera.hfov / 2)) == pytest.approx(math.tan(math.radians(20)) * shape[0] / shape[1])
    path = CameraPath.still(gi.Camera.look_at((0, 1, 3), (0, 1, 0), vfov=40.0, resolution=SIZE)).at_resolution(*shape)
    assert path.camera(0).vfov == pytest.approx(40.0)


REFLECTED = np.diag([-1.0, 1.0, 1.0, 1.0])


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: gi.Camera(REFLECTED), "is a reflection"),
        (lambda: gi.Camera.from_intrinsics(K, REFLECTED, SIZE), "is a reflection"),
        (lambda: gi.Camera.from_intrinsics(K[:2], np.eye(4), SIZE), r"K must be \[\[fx, 0, cx\]"),
        (lambda: gi.Camera.from_intrinsics(K + [[0, 2, 0]] * 3, np.eye(4), SIZE), "K must be"),
        (lambda: gi.Camera.from_intrinsics(-K, np.eye(4), SIZE), "above 0"),
        (lambda: gi.Camera.from_intrinsics(K * math.nan, np.eye(4), SIZE), "finite"),
        (lambda: gi.Camera.from_intrinsics(K, np.eye(3), SIZE), r"4x4 or 3x4, got shape \(3, 3\)"),
        (lambda: gi.Camera.from_intrinsics(K, np.eye(4), SIZE, "opengv"), "did you mean 'opengl'"),
        (lambda: gi.Camera.look_at((0, 0, 1), (0, 0, 0), vfov=180.0), "vfov must be between"),
        (lambda: gi.Camera(np.eye(4), pixel_aspect=0.0), "pixel_aspect"),
        (lambda: gi.Camera(np.eye(4), lens_shift=(math.inf, 0.0)), "lens_shift"),
    ],
)
def test_cameras_that_are_none(make, words):
    with pytest.raises(OptionError, match=words):
        make()


def test_files_of_frames_tell_the_camera(tmp_path):
    camera = gi.Camera.from_intrinsics(K, placement(), SIZE)
    assert len(list(gi.render(gi.builtin_scene("cornell_box"), camera, ONE_SAMPLE, output=tmp_path / "a.exr"))) == 1
    read = gi.read_frame(tmp_path / "a.exr")
    assert np.allclose(read.attributes["K"], K) and np.allclose(read.camera.intrinsics, K, rtol=1e-6)
    assert np.allclose(read.camera.project(POINTS), camera.project(POINTS), atol=1e-3)
    # OpenEXR: the window's middle and width on the plane at 1 m, x right and y up
    assert read.attributes["screenWindowWidth"] == pytest.approx(48 / 60)
    assert np.allclose(read.attributes["screenWindowCenter"], ((24 - 19.5) / 60, (20.25 - 16) / 45))
    assert read.attributes["pixelAspectRatio"] == pytest.approx(45 / 60)
    ndc = np.concatenate([POINTS, np.ones((len(POINTS), 1))], axis=1) @ camera_matrices(camera)[1]
    assert np.allclose(ndc[:, :2] / ndc[:, 3:] * SIZE, camera.project(POINTS), atol=1e-3)
    assert not list(
        gi.render(gi.builtin_scene("cornell_box"), camera, ONE_SAMPLE, output=tmp_path / "a.exr", resume=True)
    )
    centred = gi.Camera.look_at((0, 1, 3), (0, 1, 0), resolution=SIZE)
    assert not frame_attributes(0, 0.0, centred, {})["screenWindowCenter"].any()


def write(path, document):
    path.write_text(json.dumps(document))
    return path


def test_keyframes_with_intrinsics(tmp_path):
    pose = placement().tolist()
    keys = [
        {"time": 0, "world_from_camera": pose, "convention": "opencv", "K": K.tolist()},
        {"time": 1, "eye": [0, 1, 3], "target": [0, 1, 0], "vfov": 40, "lens_shift": [0.1, 0.2]},
    ]
    path = CameraPath.load(write(tmp_path / "c.json", {"fps": 1, "resolution": SIZE, "keyframes": keys}))
    assert np.allclose(path.camera(0).project(POINTS), by_hand(POINTS, K, placement()))
    assert path.camera(1).vfov == pytest.approx(40) and path.camera(1).lens_shift == pytest.approx((0.1, 0.2))
    path.save(tmp_path / "again.json")
    again = CameraPath.load(tmp_path / "again.json")
    for frame in range(2):
        assert np.allclose(again.camera(frame).project(POINTS), path.camera(frame).project(POINTS))
    assert again.at_resolution(32, 32).camera(1).vfov == pytest.approx(40)


NERF = {
    "camera_model": "OPENCV",
    "fl_x": 60.0,
    "fl_y": 45.0,
    "cx": 19.5,
    "cy": 20.25,
    "w": SIZE[0],
    "h": SIZE[1],
    "frames": [
        {"file_path": "a.png", "transform_matrix": (placement(a) @ np.diag([1.0, -1, -1, 1])).tolist()}
        for a in (0.3, 0.5)
    ],
}


def test_transforms_of_nerfstudio(tmp_path):
    path = CameraPath.load(write(tmp_path / "transforms.json", NERF))
    assert path.frame_count == 2 and path.resolution == SIZE
    for frame, angle in enumerate((0.3, 0.5)):
        assert np.allclose(path.camera(frame).project(POINTS), by_hand(POINTS, K, placement(angle)))


def test_transforms_of_instant_ngp(tmp_path):
    """An angle for all, and a focal length of one frame's own."""
    short = {name: value for name, value in NERF.items() if name not in ("fl_x", "fl_y", "cx", "cy")}
    frames = [NERF["frames"][0], {**NERF["frames"][1], "fl_x": 80.0}]
    path = CameraPath.load(write(tmp_path / "t.json", {**short, "camera_angle_x": 0.9, "frames": frames}))
    assert math.radians(path.camera(0).hfov) == pytest.approx(0.9)
    assert path.camera(1).intrinsics[0, 0] == pytest.approx(80) and path.camera(1).intrinsics[0, 2] == pytest.approx(24)


def test_distortion_is_left_out_with_a_line(tmp_path):
    with pytest.warns(UserWarning, match=r"lens distortion \(k1, p2\) is not modelled"):
        CameraPath.load(write(tmp_path / "t.json", {**NERF, "k1": 0.1, "k2": 0.0, "p2": -0.01}))
    with pytest.warns(UserWarning, match=r"lens distortion \(k5, k6\) is not modelled"):
        CameraPath.load(write(tmp_path / "t.json", {**NERF, "k5": 0.1, "k6": 0.2}))
    with pytest.warns(UserWarning, match="rolling_shutter is not modelled"):
        CameraPath.load(write(tmp_path / "t.json", {**NERF, "rolling_shutter": [0, 0, 0.1]}))


@pytest.mark.parametrize(
    "change, words",
    [
        ({"camera_model": "OPENCV_FISHEYE"}, "model OPENCV_FISHEYE; expected one of PINHOLE"),
        ({"fl_x": None}, "t.json"),
        ({"frames": []}, "expected frames, found none"),
        (
            {"frames": [{"transform_matrix": np.eye(4).tolist()}, {"transform_matrix": np.eye(4).tolist(), "w": 9}]},
            "is 9x32",
        ),
        ({"frames": [{"file_path": "a.png"}]}, "'transform_matrix' is missing"),
        ({"frames": [{"transform_matrix": REFLECTED.tolist()}]}, "t.json: frame 0: world_from_camera is a reflection"),
        ({"frames": [*NERF["frames"], {**NERF["frames"][0], "fl_x": -5}]}, "t.json: frame 2: K must be"),
    ],
)
def test_transforms_that_cannot_be_used(tmp_path, change, words):
    with pytest.raises(SceneError, match=words):
        CameraPath.load(write(tmp_path / "t.json", NERF | change))


def test_the_command_line(tmp_path, capsys):
    command = ["render", "cornell_box", "--pipeline=path", "--spp=1", "-o", str(tmp_path / "a.exr")]
    view = ["--eye", "0", "1", "3", "--target", "0", "1", "0", "--resolution=32x32"]
    assert cli.main([*command, *view, "--vfov=40"]) == 0
    assert gi.read_frame(tmp_path / "a.exr").camera.hfov == pytest.approx(40, abs=1e-4)
    assert cli.main([*command, *view, "--vfov=40", "--hfov=40"]) == 2
    assert "--hfov and --vfov exclude each other" in capsys.readouterr().err
    file = write(tmp_path / "transforms.json", NERF)
    assert cli.main([*command, "--camera", str(file), "--frames=1"]) == 0
    assert np.allclose(gi.read_frame(tmp_path / "a.exr").camera.intrinsics, K, rtol=1e-5)


SQUARE = {"eye": [0, 1, 3], "target": [0, 1, 0]}


@pytest.mark.parametrize(
    "document, words",
    [
        ({"keyframes": [SQUARE | {"K": K.tolist()}]}, "keyframe 0 has K and the path no resolution; give resolution"),
        (
            {name: value for name, value in NERF.items() if name not in ("w", "h")},
            "frame 0 has fl_x without w and h; give w and h",
        ),
        ({name: value for name, value in NERF.items() if name != "h"}, "frame 0 has fl_x without h"),
        (
            {"camera_angle_x": 0, "frames": NERF["frames"]},
            "camera_angle_x of frame 0 must be an angle in radians between 0 and pi, got 0",
        ),
        (
            {"camera_angle_x": 1, "camera_angle_y": 4, "w": 4, "h": 4, "frames": NERF["frames"]},
            "camera_angle_y of frame 0 must be an angle",
        ),
        ([1, 2], r"expected an object with keyframes or frames, got \[1, 2\]"),
        ({"keyframes": [[1]]}, r"keyframes of the path must be a list of objects, got \[\[1\]\]"),
        ({"keyframes": 5}, "keyframes of the path must be a list of objects, got 5"),
        ({"frames": [7]}, "frames of the file must be a list of objects"),
        ({"keyframes": [SQUARE], "resolution": 5}, "resolution of the path must be width and height in pixels, got 5"),
        ({"keyframes": [SQUARE], "resolution": [5]}, "resolution of the path must be width and height"),
        ({"keyframes": [SQUARE], "resolution": [5, "a"]}, "height of the resolution must be a whole number"),
        ({"keyframes": [SQUARE | {"eye": [1, 2]}]}, r"eye of keyframe 0 must be 3 finite numbers, got \[1, 2\]"),
        ({"keyframes": [SQUARE | {"hfov": "wide"}]}, "hfov of keyframe 0 must be a finite number, got 'wide'"),
        ({"keyframes": [SQUARE | {"lens_shift": 1}]}, "lens_shift of keyframe 0 must be 2 finite numbers, got 1"),
        ({"keyframes": [SQUARE | {"convention": []}]}, r"convention of keyframe 0 must be a text, got \[\]"),
        ({"keyframes": [{"world_from_camera": [[1], 2]}]}, "world_from_camera of keyframe 0 must be a matrix"),
        ({"keyframes": [{"eye": [0, 0, 1]}]}, "'target' is missing from keyframe 0"),
        ({"fps": "fast", "keyframes": [SQUARE]}, "fps of the path must be a finite number, got 'fast'"),
        ({"fps": 10**400, "keyframes": [SQUARE]}, "fps of the path must be a finite number"),
        (NERF | {"k1": "none"}, "k1 of frame 0 must be a finite number"),
    ],
)
def test_files_that_cannot_be_used_say_where_in_one_line(tmp_path, document, words):
    with pytest.raises(SceneError, match=words) as error:
        CameraPath.load(write(tmp_path / "t.json", document))
    assert "t.json: " in str(error.value) and "\n" not in str(error.value) and "object has" not in str(error.value)


def test_deep_files_and_files_with_a_byte_order_mark(tmp_path):
    (tmp_path / "deep.json").write_text("[" * 200_000)
    with pytest.raises(SceneError, match=r"deep.json: not JSON"):
        CameraPath.load(tmp_path / "deep.json")
    (tmp_path / "mark.json").write_text(json.dumps(NERF), encoding="utf-8-sig")
    assert CameraPath.load(tmp_path / "mark.json").frame_count == 2


def test_the_scale_of_a_placement_does_not_count():
    plain = gi.Camera.from_intrinsics(K, placement(), SIZE)
    for scale in (1e-6, 1e-30, 1e30):
        scaled = gi.Camera.from_intrinsics(K, placement() @ np.diag([scale, scale, scale, 1.0]), SIZE)
        np.testing.assert_allclose(scaled.world_from_camera, plain.world_from_camera, atol=1e-12)
    for axes in (np.diag([1.0, 0.0, 1.0, 1.0]), np.diag([1e9, 1.0, 1.0, 1.0]) @ np.outer([1, 1, 1, 1], [1, 2, 3, 4])):
        with pytest.raises(OptionError, match="singular"):
            gi.Camera(axes)


@pytest.mark.parametrize("change", [{"hfov": "a"}, {"pixel_aspect": None}, {"lens_shift": 3}, {"lens_shift": ("a", 0)}])
def test_settings_of_a_camera_have_to_be_numbers(change):
    with pytest.raises(OptionError, match=f"{next(iter(change))} must be"):
        gi.Camera(np.eye(4), **change)
    with pytest.raises(OptionError, match="must be a 4x4 matrix of numbers"):
        gi.Camera([["a"]])


def test_matrices_and_focal_lengths_that_cannot_be_meant_are_refused():
    """A transposed placement would lose its position, a sheared one turn, and a K of pictures see half a sphere."""
    K, size = [[500.0, 0, 320], [0, 500, 240], [0, 0, 1]], (640, 480)
    placed = np.eye(4)
    placed[:3, 3] = 1, 2, 3
    with pytest.raises(gi.OptionError, match=r"last row .* 0 0 0 1, got \[1.0, 2.0, 3.0, 1.0\]; transpose"):
        gi.Camera.from_intrinsics(K, placed.T, size)
    with pytest.raises(gi.OptionError, match="last row"):
        gi.Camera(placed.T, 60.0, size)
    sheared = placed.copy()
    sheared[0, 1] = 0.5
    with pytest.raises(gi.OptionError, match="sheared: its axes must be perpendicular"):
        gi.Camera.from_intrinsics(K, sheared, size)
    rounded = placed.copy()
    rounded[:3, :3] = np.round(np.array([[0.8, -0.6, 0], [0.6, 0.8, 0], [0, 0, 1]]) * 2.0 + 1e-4, 3)
    assert gi.Camera.from_intrinsics(K, rounded, size).position.tolist() == [1, 2, 3]
    with pytest.raises(gi.OptionError, match="K must be in pixels of 640x480"):
        gi.Camera.from_intrinsics([[0.8, 0, 0.5], [0, 1.1, 0.5], [0, 0, 1]], placed, size)
    with pytest.raises(gi.OptionError) as told:
        gi.Camera.from_intrinsics(K, placed * np.nan, size)
    assert "\n" not in str(told.value)


def test_one_field_of_view_is_given():
    with pytest.raises(gi.OptionError, match="both hfov and vfov"):
        gi.Camera.look_at((0, 0, 3), (0, 0, 0), hfov=40, vfov=30)
    assert gi.Camera.look_at((0, 0, 3), (0, 0, 0)).hfov == 65.0


def test_fields_of_keyframes_that_nothing_reads_are_named(tmp_path):
    key = {"time": 0, "eye": [0, 0, 3], "target": [0, 0, 0]}
    document = {"resolution": [640, 480], "keyframes": [key | {"fov": 30}]}
    with pytest.warns(
        UserWarning, match="keyframe 0 of a camera path has 'fov', which nothing reads; known are .*hfov"
    ):
        assert CameraPath.load(write(tmp_path / "a.json", document)).camera(0).hfov == 65.0
    document["keyframes"] = [key | {"K": [[500, 0, 320], [0, 500, 240], [0, 0, 1]], "hfov": 20}]
    with pytest.raises(SceneError, match="keyframe 0 has K and hfov, which follows from it; leave one out"):
        CameraPath.load(write(tmp_path / "a.json", document))
