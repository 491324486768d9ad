"""Orthographic cameras: on the host, in kernels, in files, with denoisers and bakes."""

import json

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.cli import main as cli
from warp_gi.errors import OptionError, SceneError
from warp_gi.scene.camera import CameraPath
from warp_gi.sequence.frames import camera_matrices

SIZE = (48, 32)
EYE, TARGET = (0.3, 1.4, 2.6), (0.0, 0.9, 0.0)
POINTS = np.random.default_rng(5).uniform((-1, 0, -2), (1, 2, 1), (20, 3))
ONE_SAMPLE = gi.Pipeline.preset("path", spp=1, camera_samples=1, denoise=None)


def camera(eye=EYE, target=TARGET, width=2.4, **lens):
    found = gi.Camera.orthographic(eye, target, width=width, resolution=SIZE)
    return gi.Camera(**{**vars(found), **lens})


def by_hand(points, eye=EYE, target=TARGET, width=2.4):
    """Return pixels of points: how far they are right of and above the middle, whatever their distance."""
    back = np.subtract(eye, target) / np.linalg.norm(np.subtract(eye, target))
    right = np.cross((0, 1, 0), back) / np.linalg.norm(np.cross((0, 1, 0), back))
    up = np.cross(back, right)
    per_metre = SIZE[0] / width
    away = np.asarray(points) - eye
    return np.stack([SIZE[0] / 2 + per_metre * (away @ right), SIZE[1] / 2 - per_metre * (away @ up)], axis=1)


def test_projection_keeps_sizes_at_any_distance():
    pixels = camera().project(POINTS)
    np.testing.assert_allclose(pixels, by_hand(POINTS), atol=1e-9)
    towards = POINTS - camera().origins(pixels)
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs((towards * camera().directions(pixels)).sum(axis=1)), 1.0, atol=1e-12)
    shifted = camera(lens_shift=(0.25, -0.5))
    np.testing.assert_allclose(shifted.project(POINTS), by_hand(POINTS) + np.array([-12.0, -16.0]), atol=1e-9)
    larger = camera().at_resolution(96, 64)
    np.testing.assert_allclose(larger.project(POINTS), 2 * by_hand(POINTS), atol=1e-9)
    assert larger.footprint == pytest.approx(2.4 / 96)


@pytest.mark.parametrize("moved", [False, True])
def test_rays_and_motion_of_pictures(moved):
    """Every pixel shows what lies behind its middle, and says where that was in the picture before."""
    scene, now = gi.builtin_scene("cornell_box"), camera()
    before = camera((0.42, 1.37, 2.7), (0.1, 0.9, 0.0), 2.3) if moved else now
    path = CameraPath.from_cameras([before, now])
    frames = list(gi.render(scene, path, ONE_SAMPLE, frames=range(2)))
    position, motion = frames[1].numpy("position"), frames[1].numpy("motion")
    seen = np.isfinite(frames[1].numpy("depth"))
    assert seen.mean() > 0.9
    y, x = np.nonzero(seen)
    pixels = np.stack([x, y], axis=1) + 0.5
    np.testing.assert_allclose(now.project(position[seen]), pixels, atol=2e-3)
    expected = before.project(position[seen]) - pixels
    np.testing.assert_allclose(motion[seen], expected, atol=2e-3)
    assert (np.abs(expected).max() > 1) == moved
    away = (position[seen] - now.position) @ -now.world_from_camera[:3, 2]
    np.testing.assert_allclose(frames[1].numpy("depth")[seen], away, rtol=1e-4)


def test_what_is_behind_the_plane_is_not_seen():
    scene = gi.builtin_scene("cornell_box")
    behind = gi.Camera.orthographic((0, 1, 0), (0, 1, -1), width=0.5, resolution=(8, 8))
    frame = next(gi.render(scene, behind, ONE_SAMPLE))
    assert (frame.numpy("position")[..., 2] < 0).all()


@pytest.mark.parametrize("preset", ["clean", "reuse"])
def test_presets_agree_with_the_path_tracer(preset):
    scene = gi.builtin_scene("cornell_box")
    truth = next(gi.render(scene, camera(), gi.Pipeline.preset("path", spp=256, denoise=None))).numpy("beauty")
    frames = list(gi.render(scene, CameraPath.still(camera()), gi.Pipeline.preset(preset), frames=range(4)))
    shown = frames[-1].numpy("beauty")
    assert shown.mean() == pytest.approx(truth.mean(), rel=0.03)
    if preset == "clean":
        assert np.abs(shown - truth).mean() < 0.15 * truth.mean()


def test_cells_of_a_surface_cache_are_as_small_wherever_the_camera_looks():
    """What is seen is of one size in the picture, so cells do not grow away from an orthographic camera."""
    scene = gi.builtin_scene("cornell_box")
    far = gi.Camera.orthographic((0, 1, 40), (0, 1, 0), width=2.4, resolution=SIZE)
    near = gi.Camera.orthographic((0, 1, 2.6), (0, 1, 0), width=2.4, resolution=SIZE)
    counts = [len(gi.SurfaceCache(paths=4000).bake(scene, "cpu", camera=one).arrays["keys"]) for one in (far, near)]
    assert counts[0] == pytest.approx(counts[1], rel=0.1)


def test_files(tmp_path):
    """Matrices of a frame's file are OpenEXR's, and reading gives the camera back; so does a path's JSON."""
    moved = camera(lens_shift=(0.1, 0.05))
    _, world_to_ndc = camera_matrices(moved)
    points = np.concatenate([POINTS, np.ones((len(POINTS), 1))], axis=1) @ world_to_ndc
    np.testing.assert_allclose(points[:, :2] / points[:, 3:] * SIZE, moved.project(POINTS), atol=1e-3)
    frame = next(gi.render(gi.builtin_scene("cornell_box"), moved, ONE_SAMPLE))
    read = gi.read_frame(gi.write_frame(frame, tmp_path / "a.####.exr")).camera
    np.testing.assert_allclose(read.project(POINTS), moved.project(POINTS), atol=1e-3)
    assert read.ortho_width == pytest.approx(2.4)
    path = CameraPath.from_cameras([moved, camera(width=3.0)])
    path.save(tmp_path / "path.json")
    again = CameraPath.load(tmp_path / "path.json")
    for index in range(2):
        np.testing.assert_allclose(again.camera(index).project(POINTS), path.camera(index).project(POINTS), atol=1e-9)


def test_bakes_tell_orthographic_cameras_and_lens_shifts_apart():
    scene, settings = gi.builtin_scene("cornell_box"), gi.SurfaceCache(paths=2000)
    bake = settings.bake(scene, "cpu", camera=camera())
    settings.check_view(bake, camera())
    for other in (camera(width=2.0), camera(lens_shift=(0.2, 0.0)), camera(ortho_width=0.0)):
        with pytest.warns(UserWarning, match="another camera path"):
            settings.check_view(bake, other)


def test_a_strong_zoom_keeps_a_width():
    """The curve through the widths of keys would pass below 0."""
    keys = [camera(width=width) for width in (10.0, 1.0, 0.1, 0.1)]
    path = CameraPath.from_cameras(keys, times=[0.0, 1.0, 2.0, 3.0])
    widths = [path.camera_at(time).ortho_width for time in np.linspace(0, 3, 61)]
    assert min(widths) >= 0.1 and max(widths) <= 10.0 and widths[-1] == 0.1


def test_bad_cameras(tmp_path):
    with pytest.raises(OptionError, match="above 0 m, got 0"):
        gi.Camera.orthographic(EYE, TARGET, width=0)
    with pytest.raises(OptionError, match="ortho_width must be from 0 to 1e\\+15 m, got nan"):
        camera(width=1.0, ortho_width=float("nan"))
    with pytest.raises(OptionError, match="no field of view"):
        camera().with_vfov(40)
    with pytest.raises(OptionError, match="all perspective or all orthographic"):
        CameraPath.from_cameras([camera(), camera(ortho_width=0.0)])
    key = {"time": 0, "eye": EYE, "target": TARGET, "ortho_width": 2.0, "hfov": 60}
    (tmp_path / "p.json").write_text(json.dumps({"keyframes": [key]}))
    with pytest.raises(SceneError, match="has ortho_width and a field of view; leave one out"):
        CameraPath.load(tmp_path / "p.json")


def test_the_command_line(tmp_path, capsys):
    view = ["cornell_box", "--eye", "0", "1", "4", "--target", "0", "1", "0", "--resolution", "16x16", "--spp", "1"]
    out = ["-o", str(tmp_path / "a.####.exr"), "--frames", "0", "--pipeline", "path"]
    assert cli.main(["render", *view, *out, "--ortho", "2.5"]) == 0
    assert gi.read_frame(tmp_path / "a.0000.exr").camera.ortho_width == 2.5
    for wrong, message in ((["--ortho", "2", "--hfov", "50"], "no field of view"), (["--ortho", "-1"], "got -1")):
        assert cli.main(["render", *view, *out, *wrong]) == 2
        assert message in capsys.readouterr().err
