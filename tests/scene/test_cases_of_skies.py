"""Small files on which programs of the field went wrong: skies of several layers, and scenes far from their origin."""

from pathlib import Path

import numpy as np
import pytest

import warp_gi as gi
from warp_gi.cli import main as cli

CASES = Path(__file__).parents[1] / "cases"
SKIES, FAR = CASES / "exr-parts-and-layers", CASES / "georeferenced"
SMALL = ["--resolution=32x24", "--spp=4", "--precision=float", "--pipeline=path", "--quiet"]


@pytest.mark.parametrize("sky", ["parts.exr", "layers.exr", "layers.exr:beauty", "parts.exr:beauty"])
def test_a_wall_under_the_beauty_of_a_file(tmp_path, sky):
    """A sky of radiance 2 gives twice the wall's colour."""
    view = ["--eye", "0", "0", "3", "--target", "0", "0", "0", "--hfov=30"]
    command = ["render", str(SKIES / "base.glb"), *view, f"--environment={SKIES / sky}", *SMALL]
    assert cli.main([*command, "-o", str(tmp_path / "a.exr")]) == 0
    beauty = gi.read_frame(tmp_path / "a.exr").numpy("beauty")[8:16, 12:20]
    assert np.allclose(beauty.mean(axis=(0, 1)), (1.0, 0.5, 0.2), rtol=0.02)


def test_a_data_window_is_a_quarter_of_the_sky():
    pixels = gi.Environment.load(SKIES / "window.exr").pixels
    expected = np.zeros((8, 16, 3))
    expected[2:6, 4:12] = 2.0
    assert np.array_equal(pixels, expected)


@pytest.mark.filterwarnings("ignore:.*recentred by")
@pytest.mark.parametrize(
    "name, by", [("offset_1e5.obj", (100_000.0, 0.0, 100_000.0)), ("utm.obj", (446_123.4, 52.1, 5_411_987.6))]
)
def test_a_stair_far_away(tmp_path, name, by):
    depths = []
    for file, offset in (("local.obj", (0.0, 0.0, 0.0)), (name, by)):
        eye, target = np.add(offset, (2.5, 2.5, 2.5)), np.add(offset, (0.0, 0.6, -1.5))
        view = ["--eye", *map(str, eye.tolist()), "--target", *map(str, target.tolist())]
        out = tmp_path / f"{file}.exr"
        assert cli.main(["render", str(FAR / file), *view, *SMALL, "--environment=1", "-o", str(out)]) == 0
        depths.append(gi.read_frame(out).numpy("depth"))
    assert np.isfinite(depths[0]).sum() > 100
    np.testing.assert_allclose(depths[1], depths[0], atol=0.001)
