"""Texture lookups against a bilinear oracle in float64: colour, emission and coverage, every wrap mode."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import statistics_tools as st
from scene_tools import quad
from statistics_tools import every_device  # noqa: F401

import warp_gi as gi

WRAPS = ("repeat", "clamp", "mirror")
SIZE = (60, 40)


def wrapped(index: np.ndarray, size: int, mode: str) -> np.ndarray:
    if mode == "clamp":
        return np.clip(index, 0, size - 1)
    if mode == "mirror":
        return np.minimum(index % (2 * size), 2 * size - 1 - index % (2 * size))
    return index % size


def lookup(texture: gi.Texture, uv: np.ndarray) -> np.ndarray:
    """RGBA [n, 4] at uv [n, 2]; texel (i, j) from the bottom left is centred at ((i + 0.5) / w, (j + 0.5) / h)."""
    values = texture.pixels[::-1].astype(np.float64) / 255.0
    if texture.srgb:
        color = values[..., :3]
        color[:] = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    height, width = values.shape[:2]
    xy = uv * [width, height] - 0.5
    corner = np.floor(xy).astype(int)
    s, t = (xy - corner).T[:, :, None]
    columns = [wrapped(corner[:, 0] + k, width, texture.wrap[0]) for k in (0, 1)]
    rows = [wrapped(corner[:, 1] + k, height, texture.wrap[1]) for k in (0, 1)]
    bottom = values[rows[0], columns[0]] * (1 - s) + values[rows[0], columns[1]] * s
    top = values[rows[1], columns[0]] * (1 - s) + values[rows[1], columns[1]] * s
    return bottom * (1 - t) + top * t


def picture(material: gi.Material) -> tuple[gi.Frame, np.ndarray]:
    """Return a frame of pixel centres of a square with uvs from -1.3 to 2.1, and their uvs [h, w, 2]."""
    square = quad((-1, -1, 0), (2, 0, 0), (0, 2, 0), material, "square")
    square = replace(square, uvs=(square.uvs * 3.4 - 1.3).astype(np.float32))
    scene = gi.Scene([gi.Node("square", [square])], environment=(1.0, 1.0, 1.0))
    camera = gi.Camera.look_at((0, 0, 1), (0, 0, 0), hfov=80.0, resolution=SIZE)
    pipeline = gi.Pipeline(spp=1, camera_samples=1, indirect=None)
    frame = next(iter(gi.render(scene, camera, pipeline, device=str(st.device()))))
    half = np.tan(np.radians(40.0))
    x = (2 * (np.arange(SIZE[0]) + 0.5) / SIZE[0] - 1) * half
    y = (1 - 2 * (np.arange(SIZE[1]) + 0.5) / SIZE[1]) * half * SIZE[1] / SIZE[0]
    position = np.stack(np.meshgrid(x, y), axis=-1)
    assert np.abs(position).max() < 1
    return frame, (position + 1) / 2 * 3.4 - 1.3


def texture(wrap: tuple[str, str], srgb: bool) -> gi.Texture:
    pixels = np.random.default_rng(11).integers(0, 256, size=(5, 7, 4), dtype=np.uint8)
    return gi.Texture("noise", pixels, srgb=srgb, wrap=wrap)


@pytest.mark.parametrize("wrap", [(u, v) for u in WRAPS for v in WRAPS])
def test_colors_are_bilinear(wrap):
    for srgb in (True, False):
        image = texture(wrap, srgb)
        base, glow = np.array([0.9, 0.5, 0.25]), np.array([4.0, 2.0, 1.0])
        material = gi.Material(
            "m", tuple(base), specular=0.0, base_color_texture=image, emission=tuple(glow), emission_texture=image
        )
        frame, uv = picture(material)
        expected = lookup(image, uv.reshape(-1, 2)).reshape(*uv.shape[:2], 4)[..., :3]
        assert np.abs(frame.numpy("albedo") - expected * base).max() < 2e-5
        assert np.abs(frame.numpy("emission") - expected * glow).max() < 1e-4


@pytest.mark.parametrize("wrap", [(w, w) for w in WRAPS])
def test_coverage_is_bilinear_alpha_against_the_cutoff(wrap):
    image = texture(wrap, True)
    for alpha, cutoff in ((1.0, 0.5), (0.7, 0.3)):
        material = gi.Material("m", specular=0.0, alpha=alpha, alpha_cutoff=cutoff, base_color_texture=image)
        frame, uv = picture(material)
        coverage = alpha * lookup(image, uv.reshape(-1, 2))[:, 3].reshape(uv.shape[:2]) - cutoff
        sure = np.abs(coverage) > 1e-3
        seen = frame.numpy("object_id") == 0
        assert 0.1 < seen.mean() < 0.9
        assert np.array_equal(seen[sure], coverage[sure] >= 0)


@pytest.mark.parametrize("axes", [(1, 1), (-1, 1), (1, -1)], ids=str)
@pytest.mark.parametrize("side", [1, -1])
def test_normal_maps_tilt_along_u_and_v(axes, side):
    """glTF: red is along rising u, green along rising v, mirrored or not; the back shows the front's normal negated."""
    image = gi.Texture("tilt", np.uint8([[[191, 153, 230, 255]]]), srgb=False)
    material = gi.Material("m", specular=0.0, normal_texture=image, normal_scale=0.5)
    square = quad((-1, -1, 0), (2, 0, 0), (0, 2, 0), material, "square")
    square = replace(square, uvs=(square.uvs * axes).astype(np.float32))
    scene = gi.Scene([gi.Node("square", [square])], environment=(1.0, 1.0, 1.0))
    camera = gi.Camera.look_at((0, 0, side), (0, 0, 0), hfov=20.0, resolution=(3, 3))
    pipeline = gi.Pipeline(spp=1, camera_samples=1, indirect=None)
    frame = next(iter(gi.render(scene, camera, pipeline, device=str(st.device()))))
    x, y, z = np.array([191, 153, 230]) / 255.0 * 2.0 - 1.0
    tilted = np.array([0.5 * x * axes[0], 0.5 * y * axes[1], z])
    assert np.allclose(frame.numpy("normal"), side * tilted / np.linalg.norm(tilted), atol=1e-5)


def test_roughness_is_green_and_metallic_is_blue():
    """A texture of one colour looks like the factors it stands for."""
    green, blue = 77, 179
    image = gi.Texture("mr", np.uint8([[[255, green, blue, 255]]]), srgb=False)
    textured = gi.Material("m", (0.9, 0.5, 0.2), metallic=0.8, roughness=0.9, metallic_roughness_texture=image)
    plain = gi.Material("m", (0.9, 0.5, 0.2), metallic=0.8 * blue / 255, roughness=0.9 * green / 255)
    images = [picture(material)[0].numpy("environment") for material in (textured, plain)]
    assert images[0].max() > 0.1
    assert np.allclose(*images, rtol=1e-3, atol=1e-4)
