"""Luminance and sRGB: one formula each, the same on the host and in kernels."""

import numpy as np
import statistics_tools as st
import warp as wp
from statistics_tools import every_device  # noqa: F401

from warp_gi.color import LUMINANCE, SRGB_TO_LINEAR, decode_srgb, encode_srgb
from warp_gi.kernels.bsdf import luminance
from warp_gi.launch import launch

wp.set_module_options({"enable_backward": False})


# Thread: one color.
@wp.kernel
def weigh(first: wp.int32, colors: wp.array(dtype=wp.vec3), out: wp.array(dtype=wp.float32)):
    i = first + wp.tid()
    out[i] = luminance(colors[i])


def test_kernels_weigh_colors_as_the_host_does():
    colors = wp.array(np.eye(3, dtype=np.float32), dtype=wp.vec3, device=st.device())
    out = wp.zeros(3, dtype=wp.float32, device=st.device())
    launch(weigh, 3, [colors, out], st.device())
    assert np.array_equal(out.numpy(), LUMINANCE.astype(np.float32))
    assert LUMINANCE.sum() == 1.0


def test_srgb_is_the_standards_curve():
    x = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(decode_srgb(encode_srgb(x)), x, atol=1e-12)
    np.testing.assert_allclose(decode_srgb(np.array([0, 0.04, 0.5, 1])), [0, 0.04 / 12.92, 0.2140411, 1], rtol=1e-6)
    np.testing.assert_allclose(encode_srgb(np.array([-1.0, 2.0])), [0, 1], atol=1e-15)
    assert decode_srgb(np.float32([0.5])).dtype == np.float32  # as an 8-bit picture of a sky is read
    assert decode_srgb(np.array([0, 1], np.uint8)).dtype == np.float64
    np.testing.assert_allclose(encode_srgb(SRGB_TO_LINEAR) * 255, np.arange(256), atol=1e-3)
