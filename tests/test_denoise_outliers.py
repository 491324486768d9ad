"""Light that one sample of many found is shared out among the pixels around; their sum stays, within a bound."""

from dataclasses import dataclass

import numpy as np
import pytest
import warp as wp
from scene_tools import card
from test_denoise import CPU, LUMINANCE, NO_BLUR, H, W, filled, image, random_guides, settings_of

import warp_gi as gi
from warp_gi import launch
from warp_gi.denoise import SpatioTemporal
from warp_gi.kernels import denoise

BLOCK = int(denoise.BLOCK)


def shared(guides, lights, moments, lengths, before, frames, shift, outliers, changed=False):
    """What the kernel makes of both lobes; their squares stay. If ``changed`` glossy light has become another one."""
    noisy = filled(denoise.Signals, diffuse=lights[0], glossy=lights[1], moments=moments, length=lengths)
    history = filled(denoise.Signals, moments=before, length=frames)
    settings = settings_of(footprint=0.05, outliers=outliers, shift_x=shift[0], shift_y=shift[1], lag=float(changed))
    changes = denoise.Changes()
    changes.columns = -(-W // BLOCK)
    shape = changes.columns * -(-H // BLOCK)
    changes.diffuse, changes.glossy = (wp.full(shape, value, dtype=wp.float32, device=CPU) for value in (0.0, 0.1))
    count = -(-(W + shift[0]) // BLOCK) * -(-(H + shift[1]) // BLOCK)
    inputs = [settings, filled(denoise.Guides, **guides), noisy, history, changes]
    launch.launch(denoise.share_outliers, count, inputs, CPU)
    np.testing.assert_array_equal(image(noisy.moments, H, W), moments)
    return [image(noisy.diffuse, H, W), image(noisy.glossy, H, W)]


def expected(guides, light, moments, length, before, frames, shift, outliers):
    """The same of one lobe in float64, and how many pixels were outliers."""
    light, found = light.astype(np.float64), 0
    position, normal, plane = (guides[f"guide_{name}"].astype(float) for name in ("position", "normal", "plane"))
    for top in range(-shift[1], H, BLOCK):
        for left in range(-shift[0], W, BLOCK):
            block = [(y, x) for y in range(top, top + BLOCK) for x in range(left, left + BLOCK)]
            block = [(y, x) for y, x in block if 0 <= y < H and 0 <= x < W]
            for at in block:
                around = [
                    one
                    for one in block
                    if one != at
                    and length[one] > 0
                    and guides["guide_object"][one] == guides["guide_object"][at]
                    and normal[at] @ normal[one] >= 0.85
                    and abs(plane[at] @ (position[one] - position[at])) < 0.15 * guides["guide_distance"][at]
                ]
                known = sum(frames[one] for one in around)
                if len(around) < 8 or known < 256 or moments[at] <= outliers**2 * before[at]:
                    continue
                own = light[at] @ LUMINANCE
                typical = np.sqrt(sum(frames[one] * before[one] for one in around) / known)
                limit = outliers * typical
                alike = sum(moments[one] > limit**2 for one in around)
                if own > limit and alike <= len(around) / 8:
                    part = light[at] / own * min((own - limit) / (len(around) + 1), typical)
                    light[at] = light[at] * limit / own + part
                    for one in around:
                        light[one] += part
                    found += 1
    return light, found


def random_light(rng):
    """Light of two lobes of which one pixel in ten is an outlier, its squares, and of which pixels it is known."""
    lights = rng.exponential(1.0, (2, H, W, 3)) * rng.choice([1, 40], (2, H, W, 1), p=[0.95, 0.05])
    lengths = (rng.random((H, W, 2)) < 0.9).astype(np.float32)
    lights[np.moveaxis(lengths, -1, 0) == 0] = 0
    lights = lights.astype(np.float32)
    return lights, np.stack([(light @ LUMINANCE) ** 2 for light in lights], -1).astype(np.float32), lengths


@pytest.mark.parametrize("shift", [(0, 0), (3, 5)])
def test_outliers_are_shared_out(shift):
    rng = np.random.default_rng(3)
    guides, (lights, moments, lengths) = random_guides(rng), random_light(rng)
    before = rng.exponential(2.0, (H, W, 2)) * rng.choice([1, 400], (H, W, 2), p=[0.95, 0.05])
    before, frames = before.astype(np.float32), rng.integers(0, 33, (H, W, 2)).astype(np.float32)
    results = shared(guides, lights, moments, lengths, before, frames, shift, 4.0)
    for lobe, (light, result) in enumerate(zip(lights, results, strict=True)):
        given = (one[..., lobe] for one in (moments, lengths, before, frames))
        right, found = expected(guides, light, *given, shift, 4.0)
        assert found >= 1
        np.testing.assert_allclose(result, right, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("spared", ["expected", "new"])
def test_light_that_is_as_rare_as_before_and_surfaces_that_are_new_are_left_alone(spared):
    rng = np.random.default_rng(4)
    guides, (lights, moments, lengths) = random_guides(rng), random_light(rng)
    before = np.full((H, W, 2), moments.max() / 64 if spared == "expected" else 1e-3, np.float32)
    frames = np.full((H, W, 2), 32.0 if spared == "expected" else 1.0, np.float32)
    results = shared(guides, lights, moments, lengths, before, frames, (1, 2), 8.0)
    np.testing.assert_array_equal(results, lights)


def test_where_light_has_changed_nothing_is_shared():
    rng = np.random.default_rng(3)
    guides, (lights, moments, lengths) = random_guides(rng), random_light(rng)
    before, frames = np.full((H, W, 2), 1.0, np.float32), np.full((H, W, 2), 32.0, np.float32)
    diffuse, glossy = shared(guides, lights, moments, lengths, before, frames, (1, 2), 4.0, changed=True)
    assert (diffuse != lights[0]).any()
    np.testing.assert_array_equal(glossy, lights[1])


@pytest.mark.parametrize("dark", [0.0, 1.0])
def test_a_light_that_is_switched_on_is_seen_at_once(dark):
    denoiser = SpatioTemporal(lag=0.0, frames=16, **NO_BLUR)
    only = {"environment": None, "emitters": None, "spp": 1, "camera_samples": 1}
    scheduler = gi.FrameScheduler(WALL, STILL, gi.Pipeline(indirect=Switched(dark=dark), denoise=denoiser, **only))
    pictures = [scheduler.frame(index).numpy("beauty") for index in range(9)]
    np.testing.assert_allclose(pictures[8], (8 * dark + 100) / 9, rtol=1e-4)


@dataclass(frozen=True)
class Switched(gi.BsdfPaths):
    """Even light, and a hundred of it from the ninth frame on."""

    dark: float = 0.0

    def trace(self, frame, state):
        """Fill the term."""
        frame["indirect"].fill_(100.0 if frame.index > 7 else self.dark)


@pytest.mark.parametrize(("lamp", "keeps"), [(40.0, True), (4000.0, False)])
def test_a_dot_of_one_ray_does_not_stay(lamp, keeps):
    """One sample of 1,024 finds a lamp: the largest dot over the mean, which stays where the lamp is not too bright."""
    peaks = {}
    for outliers in (0.0, 6.0):
        denoiser = SpatioTemporal(outliers=outliers, lag=0.0, **NO_BLUR)
        only = {"environment": None, "emitters": None, "spp": 1, "camera_samples": 1}
        scheduler = gi.FrameScheduler(WALL, STILL, gi.Pipeline(indirect=Lamp(lamp=lamp), denoise=denoiser, **only))
        frames = [scheduler.frame(index) for index in range(10)]
        picture = frames[-1].numpy("beauty")[8:-8, 8:-8]  # blocks at the border know fewer pixels
        noisy = np.mean([frame.numpy("noisy")[8:-8, 8:-8].mean() for frame in frames])
        peaks[outliers] = picture.max()
        assert (abs(picture.mean() / noisy - 1) < 1e-3) == (keeps or not outliers)
    assert peaks[0.0] > lamp / 12 and peaks[6.0] < 2.5


@dataclass(frozen=True)
class Lamp(gi.BsdfPaths):
    """Light of an even wall of 1, and from the sixth frame on in one of 1,024 pixels that of a small lamp."""

    lamp: float = 40.0

    def trace(self, frame, state):
        """Fill the term."""
        rng = np.random.default_rng(frame.seed + frame.index)
        values, is_rare = rng.uniform(0.5, 1.5, (2, len(frame["indirect"])))
        values += self.lamp * (is_rare < 0.5 + 1 / 1024) * (frame.index > 4)
        frame["indirect"].assign(np.repeat(values[:, None], 3, axis=1))


WALL = gi.Scene([gi.Node("wall", [card(0.0, 9.0, gi.Material("grey", (0.5, 0.5, 0.5), specular=0.0))])])
STILL = gi.CameraPath.still(gi.Camera.look_at((0, 0, 2), (0, 0, 0), hfov=60, resolution=(64, 48)))
