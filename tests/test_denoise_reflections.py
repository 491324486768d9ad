"""The average of glossy light follows what smooth surfaces reflect: against mirror images in closed form."""

from __future__ import annotations

import numpy as np

import warp_gi as gi
from warp_gi.kernels import denoise, denoise_reflections
from warp_gi.scene.builtin.shapes import Shape

W, H = 64, 36
SMOOTH, ROUGH = 0.2, 0.9
WALL, BEHIND = -3.0, 8.0
"""z of the wall that mirrors show, and of one behind the camera."""


def square(points: list[list[float]], name: str, roughness: float = 1.0, move: float = 0.0) -> gi.Node:
    """A square; ``move`` is its way along x in a frame."""
    material = gi.Material(base_color=(0.8, 0.8, 0.8), roughness=roughness, metallic=1.0 - float(roughness == 1.0))
    mesh = gi.Mesh(np.array(points, np.float32), np.array([[0, 1, 2], [0, 2, 3]]), material=material)
    keys = [gi.Keyframe(time, translation=(move * time * 24, 0.0, 0.0)) for time in (0.0, 1.0)] if move else None
    return gi.Node(name, [mesh], keyframes=keys)


def wall(z: float = WALL, move: float = 0.0) -> gi.Node:
    return square([[-60, -60, z], [60, -60, z], [60, 60, z], [-60, 60, z]], "wall", move=move)


def floor(roughness: float) -> gi.Node:
    return square([[-40, 0, 20], [40, 0, 20], [40, 0, -20], [-40, 0, -20]], "floor", roughness)


def ball() -> gi.Node:
    turn = np.linspace(0, 2 * np.pi, 129)[:-1]
    rise = np.linspace(0, np.pi, 65)
    points = [[np.sin(b) * np.sin(a), np.cos(b), np.sin(b) * np.cos(a)] for b in rise for a in turn]
    rows, columns = np.mgrid[:64, :128]
    a, b = (rows * 128 + columns).ravel(), (rows * 128 + (columns + 1) % 128).ravel()
    faces = np.concatenate([np.stack([a, a + 128, b], 1), np.stack([b, a + 128, b + 128], 1)])
    shape = Shape.of(points, faces, crease=180.0)
    material = gi.Material(base_color=(0.8, 0.8, 0.8), roughness=SMOOTH, metallic=1.0)
    return gi.Node("ball", [gi.Mesh(shape.points, shape.indices, normals=shape.normals, material=material)])


def two_frames(nodes: list[gi.Node], eye: tuple[float, float, float], target: tuple[float, float, float], step: float):
    """Frames 0 and 1 of a camera that moves by ``step`` metres along x, with the denoiser's guides."""
    ends = [tuple(np.add(point, (24 * step, 0, 0))) for point in (eye, target)]
    keys = [gi.CameraKey(0.0, eye, target, hfov=50.0), gi.CameraKey(1.0, *ends, hfov=50.0)]
    scene = gi.Scene(nodes, environment=(0.5, 0.5, 0.5))
    pipeline = gi.Pipeline(spp=1, camera_samples=1, denoise=gi.SpatioTemporal())
    return list(gi.render(scene, gi.CameraPath(keys).at_resolution(W, H), pipeline, frames=range(2)))


def reflected(frame: gi.Frame, z: float) -> np.ndarray:
    """Where the mirror rays of a frame's pixels meet the wall at ``z``, [pixel, 3]; nan where they do not."""
    guides = frame.struct(denoise.Guides)
    place, normal = (np.float64(getattr(guides, f"guide_{name}").numpy()) for name in ("position", "normal"))
    view = place - np.float64(frame.camera.position)
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    ray = view - 2 * np.sum(view * normal, axis=1, keepdims=True) * normal
    t = (z - place[:, 2]) / np.where(ray[:, 2] * (z - place[:, 2]) > 1e-6, ray[:, 2], np.nan)
    return place + ray * t[:, None]


def moved_average(frames: list[gi.Frame], last: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Average of glossy light in frame 1 from that of frame 0, by surfaces and by images, [pixel, 3]; its length."""
    before, now = (frame.struct(denoise.Guides) for frame in frames)
    denoiser = gi.SpatioTemporal()
    signals = [denoiser._signals(frame) for frame in frames]
    history, out = signals
    for array in (history.diffuse, history.moments, out.diffuse, out.glossy, out.moments, out.length):
        array.zero_()
    history.glossy.assign(np.float32(last))
    history.length.assign(np.float32(np.where(np.isfinite(last[:, :1]), 16, 0)) * np.float32([1, 1]))
    settings, views = denoiser._settings(frames[1]), denoise_reflections.Views()
    views.now, views.before = frames[1].camera_data, frames[1].previous_camera_data
    frames[1].launch(denoise.reproject, [settings, now, before, history, out])
    by_surface = out.glossy.numpy().copy()
    inputs = [frames[1].data, views, settings, now, before, history, out]
    frames[1].launch(denoise_reflections.reproject_reflections, inputs)
    return by_surface, out.glossy.numpy(), out.length.numpy()[:, 1]


def errors(frames: list[gi.Frame], z: float = WALL, drift: float = 0.0) -> tuple[float, float]:
    """Median errors of the average by surfaces and by images, if the light of the wall's places is where they are.

    ``drift`` is the wall's way along x.
    """
    old, new = (reflected(frame, z) for frame in frames)
    by_surface, by_image, length = moved_average(frames, np.where(np.isfinite(old), old, 0))
    new[:, 0] -= drift
    smooth = frames[1].struct(denoise.Guides).guide_alpha.numpy() < 0.3
    known = np.isfinite(new[:, 0]) & smooth & (length > 4.0) & (frames[1].numpy("object_id").ravel() == 1)
    assert known.sum() > 300
    one, other = (float(np.median(np.abs(found - new)[known].max(axis=1))) for found in (by_surface, by_image))
    return one, other


FLOOR_VIEW = ((0.0, 1.0, 3.0), (0.0, 0.0, 0.0))


def test_mirror_image_of_a_still_wall_stays() -> None:
    frames = two_frames([wall(), floor(SMOOTH)], *FLOOR_VIEW, 0.2)
    by_surface, by_image = errors(frames)
    assert by_image < 2e-3 < 0.1 < by_surface


def test_mirror_image_of_a_moving_wall_moves() -> None:
    frames = two_frames([wall(move=0.3), floor(SMOOTH)], *FLOOR_VIEW, 0.1)
    by_surface, by_image = errors(frames, drift=0.3)
    assert by_image < 2e-3 < 0.1 < by_surface


def test_image_in_a_ball_is_nearer() -> None:
    """Against a flat mirror's motion, and against the surface's: 1/t' = 1/t + 2/R."""
    frames = two_frames([wall(BEHIND), ball()], (0.0, 0.4, 4.0), (0.0, 0.2, 0.0), 0.1)
    by_surface, by_image = errors(frames, BEHIND)
    assert by_image < by_surface / 4, (by_surface, by_image)


def test_rough_surfaces_keep_their_motion() -> None:
    frames = two_frames([wall(), floor(ROUGH)], *FLOOR_VIEW, 0.1)
    by_surface, by_image, length = moved_average(frames, np.nan_to_num(reflected(frames[0], WALL)))
    assert np.array_equal(by_surface, by_image)
    assert not frames[1].struct(denoise.Guides).guide_reflected.numpy().any()
    assert length.max() == 16
