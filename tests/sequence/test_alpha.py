"""Coverage of pixels, and pictures without their background."""

import numpy as np
import OpenImageIO as oiio
import pytest

import warp_gi as gi
from warp_gi.cli import main as cli
from warp_gi.errors import OptionError

SIZE = (24, 16)
SAMPLES = 16


def half_plane(slope=0.35):
    """Return a scene whose only surface ends at a slanted line through the middle of the view."""
    points = np.array([[-9, -9, 0], [9, -9, 0], [9, 9 * slope, 0], [-9, -9 * slope, 0]], np.float32)
    mesh = gi.Mesh(
        points, np.array([[0, 1, 2], [0, 2, 3]], np.int32), gi.Material(base_color=(0.5, 0.25, 0.1), specular=0)
    )
    return gi.Scene([gi.Node("half", [mesh])], environment=2.0)


CAMERA = gi.Camera.look_at((0, 0, 3), (0, 0, 0), hfov=40.0, resolution=SIZE)


def picture(**settings):
    pipeline = gi.Pipeline(**{"spp": SAMPLES, "camera_samples": SAMPLES, **settings})
    (frame,) = gi.render(half_plane(), CAMERA, pipeline)
    return {name: frame.numpy(name).copy() for name in ("alpha", "beauty", "emission", "albedo", "depth")}


def coverage(slope=0.35, steps=32):
    """Return the share of each pixel that the half plane covers, by brute force."""
    width, height = SIZE
    x, y = np.meshgrid((np.arange(width * steps) + 0.5) / steps, (np.arange(height * steps) + 0.5) / steps)
    ways = CAMERA.directions(np.stack([x, y], axis=-1).reshape(-1, 2))
    at = CAMERA.position + ways * (CAMERA.position[2] / -ways[:, 2:])
    inside = (at[:, 1] < slope * at[:, 0]).reshape(height, steps, width, steps)
    return inside.mean(axis=(1, 3))


def test_alpha_is_the_share_of_a_pixel_that_is_covered():
    alpha, truth = picture()["alpha"], coverage()
    assert alpha.shape == SIZE[::-1] and 0.2 < truth.mean() < 0.8
    assert set(np.unique(alpha * SAMPLES)) <= set(range(SAMPLES + 1))
    assert (alpha[truth == 0] == 0).all() and (alpha[truth == 1] == 1).all()
    assert np.abs(alpha - truth).max() < 0.2 and abs(alpha.mean() - truth.mean()) < 0.01
    assert ((alpha > 0) & (alpha < 1)).any()


def test_without_a_background_the_beauty_is_light_of_surfaces_alone():
    """And a picture laid over its sky is the one with a background: alpha is of the same samples."""
    full, cut = picture(), picture(background=False)
    assert np.array_equal(full["alpha"], cut["alpha"])
    assert (cut["beauty"][cut["alpha"] == 0] == 0).all() and (full["beauty"][cut["alpha"] == 0] == 2).all()
    over = cut["beauty"] + (1 - cut["alpha"])[..., None] * 2.0
    np.testing.assert_allclose(over, full["beauty"], rtol=1e-5)
    inner = cut["alpha"] == 1
    assert np.array_equal(full["beauty"][inner], cut["beauty"][inner]) and cut["beauty"][inner].min() > 0.1


@pytest.mark.parametrize("samples", [1, 4])
def test_a_denoised_picture_has_no_background_either(samples):
    cut = picture(denoise="spatiotemporal", camera_samples=samples, background=False)
    clear = coverage() == 0
    rows, columns = np.nonzero(clear)
    far = [
        (r, c) for r, c in zip(rows, columns, strict=True) if clear[max(r - 2, 0) : r + 3, max(c - 2, 0) : c + 3].all()
    ]
    assert len(far) > 30 and all((cut["beauty"][place] == 0).all() for place in far)
    covered = coverage() == 1
    assert np.allclose(cut["beauty"][covered], np.array([1.0, 0.5, 0.2]), rtol=0.1)
    edge = ~clear & ~covered
    assert cut["beauty"][edge].max() <= 1.05  # the sky of radiance 2 is not in them


@pytest.mark.parametrize("edge_samples", [0, 4])
def test_the_average_of_pictures_has_no_background_either(edge_samples):
    """Over frames of a camera that moves by half pixels: the last picture is read beside the surface's edge."""
    denoise = gi.SpatioTemporal(blend=0.1, edge_samples=edge_samples)
    pipeline = gi.Pipeline(spp=1, camera_samples=1, denoise=denoise, background=False)
    places = [0.05 * k for k in range(4)]
    cameras = [gi.Camera.look_at((x, x, 3), (x, x, 0), hfov=40.0, resolution=SIZE) for x in places]
    for frame in gi.render(half_plane(), gi.CameraPath.from_cameras(cameras), pipeline):
        beauty = frame.numpy("beauty")
        assert (beauty <= np.array([1.0, 0.5, 0.2]) * 1.05).all()  # the sky's radiance is 2
        assert (beauty[:3, :4] == 0).all() and beauty[-2:, -4:].min() > 0.15


def test_files_have_the_channel_a(tmp_path):
    pipeline = gi.Pipeline(spp=4)
    (frame,) = gi.render(half_plane(), CAMERA, pipeline, output=tmp_path / "a.exr")
    read = gi.read_frame(tmp_path / "a.exr")
    assert np.array_equal(read.numpy("alpha"), frame.numpy("alpha"))
    image = oiio.ImageInput.open(str(tmp_path / "a.exr"))
    assert image.spec().channelnames[:4] == ("R", "G", "B", "A") and image.spec().alpha_channel == 3
    image.close()
    assert list(gi.render(half_plane(), CAMERA, pipeline, output=tmp_path / "a.exr", resume=True)) == []
    cut = gi.Pipeline(spp=4, background=False)
    assert len(list(gi.render(half_plane(), CAMERA, cut, output=tmp_path / "a.exr", resume=True))) == 1


def test_the_command_line(tmp_path):
    command = ["render", "cornell_box", "--environment=1", "--pipeline=path", "--spp=1", "--resolution=24x16"]
    command += ["--eye", "0", "1", "9", "--target", "0", "1", "0"]
    assert cli.main([*command, "--no-background", "-o", str(tmp_path / "a.exr")]) == 0
    read = gi.read_frame(tmp_path / "a.exr")
    missed = read.numpy("alpha") == 0
    assert missed.any() and (read.numpy("beauty")[missed] == 0).all()


def test_bakes_alone_always_show_their_sky():
    with pytest.raises(OptionError, match="always shows the sky of its bake"):
        gi.Pipeline.preset("probe_view", background=False)


def test_a_sky_that_is_not_shown_adds_nothing_to_the_variance():
    """At the edge of a lamp pictures without a background have the variance of a lamp without a sky."""
    lamp = gi.Material(base_color=(0, 0, 0), specular=0, emission=(1.0, 2.0, 3.0))
    variances = []
    for sky, background in ((5.0, False), (None, True), (5.0, True)):
        scene = half_plane()
        scene = gi.Scene(
            [gi.Node("lamp", [gi.Mesh(m.points, m.indices, lamp)]) for m in scene.nodes[0].meshes], environment=sky
        )
        pipeline = gi.Pipeline(spp=SAMPLES, camera_samples=SAMPLES, background=background)
        (frame,) = gi.render(scene, CAMERA, pipeline)
        variances.append(frame.numpy("variance").copy())
    cut, alone, full = variances
    np.testing.assert_allclose(cut, alone, rtol=1e-5, atol=1e-9)
    assert cut.max() > 0 and not np.allclose(cut, full)
