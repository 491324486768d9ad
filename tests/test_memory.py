"""Memory: what large images and pictures take, and one line before what does not fit is begun."""

from __future__ import annotations

import struct
import tracemalloc
import zlib

import numpy as np
import pytest
from PIL import Image

import warp_gi as gi
from warp_gi import memory
from warp_gi.alias import AliasTable
from warp_gi.cli import main as cli
from warp_gi.color import LUMINANCE, luminance_of
from warp_gi.errors import OptionError, SceneError
from warp_gi.kernels import denoise
from warp_gi.scene.files.images import read_image
from warp_gi.scene.files.sky_images import read_sky
from warp_gi.scene.sky_map import SkyMap
from warp_gi.scene.textures import SRGB_TO_LINEAR, box_means
from warp_gi.sequence.exr import read_exr, write_exr


def peak(make, *arguments, **more):
    """Return what a call returns, and the bytes of NumPy that it took at most."""
    tracemalloc.start()
    try:
        result = make(*arguments, **more)
        return result, tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


# ---- skies ----


def test_tables_of_a_large_sky_take_little():
    """A map of 8192x4096 has 34 million texels; here 2 million show what each takes."""
    pixels = np.random.default_rng(0).random((1024, 2048, 3), dtype=np.float32)
    weights, took = peak(luminance_of, pixels)
    assert took < 8 * weights.size + 40e6  # the result, and one band
    np.testing.assert_array_equal(weights, pixels.astype(np.float64) @ LUMINANCE)
    kept = weights.copy()
    table, took = peak(AliasTable.build, weights, overwrite=True)
    assert took < 34 * weights.size + 40e6
    np.testing.assert_allclose(table.pdf, kept.ravel() / kept.sum(), rtol=1e-5)
    sky, took = peak(SkyMap, pixels)
    assert sky.pixels is pixels and took < 1e6
    _, took = peak(lambda: sky.digest)
    assert took < 1e6


def test_weights_that_are_not_to_be_overwritten_stay():
    weights = np.random.default_rng(1).random(5000)
    kept = weights.copy()
    one, two = AliasTable.build(weights), AliasTable.build(kept.copy(), overwrite=True)
    np.testing.assert_array_equal(weights, kept)
    for name in ("probability", "index", "pdf"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))


@pytest.mark.parametrize("kind", ["png", "exr", "hdr"])
def test_a_sky_is_read_some_rows_at_a_time(tmp_path, kind, monkeypatch):
    import OpenImageIO as oiio

    from warp_gi import color

    rng = np.random.default_rng(2)
    pixels = rng.integers(0, 256, (32, 64, 3)).astype(np.uint8) if kind == "png" else rng.random((32, 64, 3))
    image = oiio.ImageBuf(np.ascontiguousarray(pixels, pixels.dtype if kind == "png" else np.float32))
    assert image.write(str(tmp_path / f"a.{kind}"))
    whole = read_sky(tmp_path / f"a.{kind}")
    monkeypatch.setattr(color, "BAND", 300)  # four rows and a rest
    np.testing.assert_array_equal(read_sky(tmp_path / f"a.{kind}"), whole)
    expected = SRGB_TO_LINEAR[pixels] if kind == "png" else pixels
    np.testing.assert_allclose(whole, expected, atol=0.01 if kind == "hdr" else 1e-3)


# ---- textures ----


def png_of(width, height):
    """Return a PNG file of a few bytes that says it is as large as this."""

    def chunk(name, data):
        return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(bytes(100))) + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize(
    ("size", "words"),
    [
        ((13377, 13379), "has 13377x13379 pixels, at most 178,956,970"),
        ((60000, 60000), "is too large: at most 178,956,970"),
    ],
)
def test_a_texture_that_is_too_large_is_refused_by_its_header(size, words, monkeypatch):
    if "is too large" not in words:
        monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", None)  # of a program that has lifted Pillow's own limit
    with pytest.raises(SceneError, match="texture 'a'") as caught:
        read_image(png_of(*size), "texture 'a'")
    assert words in str(caught.value) and "scale it down" in str(caught.value)


def test_an_image_that_does_not_fit_is_refused_by_its_header(monkeypatch):
    monkeypatch.setattr(memory, "free_memory", lambda: 10_000_000)
    with pytest.raises(SceneError, match=r"2048x2048 pixels take 0\.038 GB of memory, and 0\.010 GB are free"):
        read_image(png_of(2048, 2048), "texture 'a'")


def test_sums_of_a_large_texture_take_little():
    """Light of emissive triangles is summed exactly, without floating point copies of their texture."""
    rng = np.random.default_rng(3)
    pixels = rng.integers(0, 256, (1500, 1000, 4)).astype(np.uint8)
    low, high = np.array([[0.1, 0.2], [-0.7, 0.0]]), np.array([[0.3, 0.25], [0.9, 1.0]])
    means, took = peak(box_means, pixels[..., :3], ("repeat", "mirror"), low, high, SRGB_TO_LINEAR)
    assert took < 32 * 2**20 * 3  # a band of three channels; a whole image would be 12 times as large at 8192x8192
    image = np.ceil(SRGB_TO_LINEAR[pixels[::-1, :, :3]].astype(np.float64) * 2**24)
    begin, end = np.floor([99.5, 299.5]) - 1, np.floor([299.5, 374.5]) + 3  # a texel around all that is looked up
    columns = np.arange(begin[0], end[0]).astype(int) % 1000
    rows = np.arange(begin[1], end[1]).astype(int)
    np.testing.assert_allclose(means[0], image[np.ix_(rows, columns)].mean(axis=(0, 1)) / 2**24, rtol=1e-12)


# ---- pictures ----


def test_a_picture_that_does_not_fit_is_one_line(tmp_path, monkeypatch, capfd):
    monkeypatch.setattr(memory, "free_memory", lambda: 500_000_000)
    options = ["--resolution", "2000x1000", "--spp", "1", "-o", str(tmp_path / "o" / "a.####.exr")]
    assert cli.main(["render", "cornell_box", *options]) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and not (tmp_path / "o").exists()
    assert (
        "a picture of 2000x1000 takes about 0.9 GB of memory (470 bytes a pixel), and 0.5 GB are free on cpu" in error
    )
    camera = gi.Camera.look_at((0, 1, 3), (0, 1, 0), resolution=(2000, 1100))
    with pytest.raises(OptionError, match=r"245 bytes a pixel.*give an output: files are written in bands of 504 rows"):
        gi.FrameScheduler(gi.builtin_scene("cornell_box"), camera, gi.Pipeline()).frame(0)


def test_a_file_that_does_not_fit_is_one_line(tmp_path, monkeypatch):
    write_exr(tmp_path / "a.exr", {"beauty": np.zeros((100, 100, 3))}, {})
    monkeypatch.setattr(memory, "free_memory", lambda: 200_000)
    with pytest.raises(SceneError, match=r"a\.exr: 100x100 pixels take 0\.000 GB of memory"):
        read_exr(tmp_path / "a.exr")


def test_what_a_container_may_take_counts(tmp_path, monkeypatch):
    (tmp_path / "most").write_text("1000000\n")
    (tmp_path / "used").write_text("700000\n")
    (tmp_path / "memory.stat").write_text("anon 300000\nfile 400000\n")
    monkeypatch.setattr(memory, "_GROUPS", ((str(tmp_path), "most", "used", "file"),))
    assert memory.free_memory() == 700_000
    (tmp_path / "most").write_text("max\n")
    assert memory.free_memory() > 700_000


def test_a_frame_keeps_no_more_than_is_asked_for():
    """Sums of squares go when the variance is there, and guides that no frame reads; hits are for who draws them."""
    scene = gi.builtin_scene("cornell_box")
    camera = gi.Camera.look_at((0, 1, 3), (0, 1, 0), resolution=(8, 8))
    scheduler = gi.FrameScheduler(scene, camera, gi.Pipeline(spp=1, denoise=gi.SpatioTemporal()))
    frame = scheduler.frame(0)
    assert not any("moment" in name for name in frame._arrays)
    assert len(frame.hits.face) == 64
    guides = scheduler.state("denoise").guides
    held = {name for name in denoise.Guides.vars if len(getattr(guides, name))}
    assert held == {"guide_object", "guide_normal", "guide_position", "guide_reflected"}
