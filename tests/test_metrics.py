"""Image measures against closed forms, and FLIP against NVIDIA's own implementation."""

import math

import numpy as np
import pytest
import warp as wp

from warp_gi import metrics
from warp_gi.errors import OptionError


def _noisy_pair(seed=0, height=64, width=96):
    rng = np.random.default_rng(seed)
    ramp = np.linspace(0, 3, width)[None, :, None] * np.array([1.0, 0.7, 0.4])
    reference = (ramp * np.where(np.arange(height)[:, None, None] % 16 < 8, 1.0, 0.2)).astype(np.float32)
    image = np.clip(reference * (1 + 0.3 * rng.standard_normal(reference.shape)), 0, None).astype(np.float32)
    return image, reference


def test_closed_forms():
    reference = np.full((4, 5, 3), 2.0, np.float32)
    image = reference + 0.5
    assert metrics.rmse(image, reference) == pytest.approx(0.5)
    assert metrics.psnr(image, reference) == pytest.approx(20 * math.log10(2))
    assert metrics.psnr(image, reference, peak=4.0) == pytest.approx(20 * math.log10(8))
    assert metrics.rel_mse(image, reference) == pytest.approx(0.25 / 4.01)
    assert metrics.rel_mse(image, reference, epsilon=1.0) == pytest.approx(0.25 / 5.0)


def test_equal_images():
    image, _ = _noisy_pair()
    assert metrics.rmse(image, image) == 0
    assert metrics.rel_mse(image, image) == 0
    assert metrics.psnr(image, image) == math.inf
    assert metrics.flip(image, image) < 1e-6  # OpenImageIO filters both in float


def test_integers_are_scaled_by_their_largest_value():
    a, b = np.full((4, 4, 3), 255, np.uint8), np.zeros((4, 4, 3), np.uint8)
    assert metrics.rmse(a, b) == 1.0
    assert metrics.rmse(a.astype(np.uint16) * 257, b.astype(np.uint16)) == 1.0


@pytest.mark.parametrize("hdr", [False, True])
def test_flip_agrees_with_nvidia(hdr):
    flip_evaluator = pytest.importorskip("flip_evaluator", reason="extra 'peers' is not installed")
    image, reference = _noisy_pair()
    if not hdr:
        image, reference = np.clip(image, 0, 1), np.clip(reference, 0, 1)
    theirs, mean, _ = flip_evaluator.evaluate(
        reference, image, "HDR" if hdr else "LDR", inputsRGB=False, applyMagma=False
    )
    ours = metrics.flip_map(image, reference, hdr=hdr)
    assert mean > 0.05
    assert metrics.flip(image, reference, hdr=hdr) == pytest.approx(mean, abs=2e-5)
    assert np.abs(ours - theirs.reshape(ours.shape)).max() < 1e-2


def test_flip_of_coded_bytes_is_ldr():
    image, reference = (np.clip(x, 0, 1) for x in _noisy_pair())
    from warp_gi.color import decode_srgb, encode_srgb
    from warp_gi.sequence.preview import to_bytes

    bytes_a, bytes_b = to_bytes(encode_srgb(image)), to_bytes(encode_srgb(reference))
    linear = metrics.flip(decode_srgb(bytes_a / 255), decode_srgb(bytes_b / 255), hdr=False)
    assert metrics.flip(bytes_a, bytes_b) == pytest.approx(linear, abs=1e-7)


def test_flip_grows_with_noise_and_handles_a_black_reference():
    image, reference = _noisy_pair()
    small = reference + 0.1 * (image - reference)
    assert 0 < metrics.flip(small, reference) < metrics.flip(image, reference) <= 1
    black = np.zeros_like(reference)
    assert metrics.flip(black, black) < 1e-6
    assert metrics.flip(reference, black) > 0.1


def test_warp_arrays_and_dlpack():
    image, reference = _noisy_pair()

    class Exported:
        def __init__(self, array):
            self.array = array

        def __dlpack__(self, **options):
            return self.array.__dlpack__(**options)

        def __dlpack_device__(self):
            return self.array.__dlpack_device__()

    expected = metrics.rmse(image, reference)
    assert metrics.rmse(wp.array(image, dtype=wp.float32), reference) == expected
    assert metrics.rmse(wp.array(image, dtype=wp.vec3), reference) == expected
    assert metrics.rmse(Exported(image), reference) == expected


@pytest.mark.parametrize("measure", [metrics.rmse, metrics.psnr, metrics.rel_mse, metrics.flip])
def test_bad_input(measure):
    good = np.ones((4, 5, 3), np.float32)
    for bad, words in [
        (np.ones((4, 6, 3), np.float32), "6x4 with 3 channels and reference 5x4"),
        (np.where(np.arange(60).reshape(4, 5, 3) == 7, np.nan, good), "1 values that are NaN or infinite"),
        (np.full((4, 5, 3), np.inf), "60 values"),
        (np.ones((4, 5, 3), np.int64), "has no scale"),
        (np.ones(5), "expected an image"),
        ("picture", "expected an image"),
    ]:
        with pytest.raises(OptionError, match=words):
            measure(bad, good)
