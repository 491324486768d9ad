"""Pictures lit through polygons: against rays, without noise, under skies that turn; files, commands and bad input."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from polygon_tools import city
from scene_tools import quad
from statistics_tools import device, every_device  # noqa: F401
from test_polygon_bake import GREY, ball, floor

import warp_gi as gi
from warp_gi.cli import main as cli
from warp_gi.errors import BakeError, SceneError
from warp_gi.techniques.visibility_polygons import pictures
from warp_gi.techniques.visibility_polygons.export import read_polygons

SKY = gi.Environment(pixels=city(64))
POLYGONS = gi.VisibilityPolygons(resolution=32)
CAMERA = gi.Camera.look_at((2.5, 2.2, 2.5), (0, 0.5, 0), hfov=40, resolution=(40, 24))


def stage(material=GREY, environment=SKY, level=2):
    nodes = [gi.Node("floor", [replace(floor(10), material=material)]), gi.Node("ball", [ball(level)])]
    return gi.Scene(nodes, environment=environment)


def rendered(scene, estimator, spp=4, bakes=(), seed=1, camera=CAMERA):
    pipeline = gi.Pipeline(environment=estimator, emitters=None, indirect=None, spp=spp, camera_samples=1)
    return gi.FrameScheduler(scene, camera, pipeline, device().alias, seed, bakes=list(bakes)).frame(0)


def light(*arguments, **more):
    return rendered(*arguments, **more).numpy("environment").astype(np.float64)


def test_light_as_rays_find_it():
    """A ball over a floor under a sky with a sun: sharp shadow and all, at 4 samples against 1024."""
    scene = stage(level=3)
    frame = rendered(scene, POLYGONS)
    truth = light(scene, gi.TracedEnvironment(), 1024)
    surface = frame.numpy("alpha") > 0
    error = (frame.numpy("environment") - truth)[surface].mean(axis=1) / truth[surface].mean()
    assert abs(error.mean()) < 0.01
    assert np.quantile(np.abs(error), 0.5) < 0.02 and np.quantile(np.abs(error), 0.9) < 0.06
    traced = (light(scene, gi.TracedEnvironment(), 4) - truth)[surface].mean(axis=1) / truth[surface].mean()
    assert np.sqrt(np.mean(error**2)) < 0.4 * np.sqrt(np.mean(traced**2))


def test_a_plate_takes_the_light_that_its_form_factor_says():
    """The corner of a plate over the middle of a floor under a sky of 1; the floor's vertices lie around the point."""
    a, b, height = 1.0, 0.8, 1.0
    plate = quad((0, height, 0), (a, 0, 0), (0, 0, b), GREY)
    fine = floor(40)
    scene = gi.Scene([gi.Node("floor", [fine]), gi.Node("plate", [plate])], environment=1.0)
    camera = gi.Camera.look_at((-0.02, 0.5, 0.021), (-0.02, 0.0, 0.0201), hfov=1, up=(0, 0, 1), resolution=(2, 2))
    x, y = a / height, b / height
    factor = sum(p / math.sqrt(1 + p * p) * math.atan(q / math.sqrt(1 + p * p)) for p, q in ((x, y), (y, x))) / (
        2 * math.pi
    )
    got = light(scene, gi.VisibilityPolygons(), camera=camera)
    np.testing.assert_allclose(got[0, 0] / GREY.base_color, 1 - factor, atol=0.006)


def test_no_noise_on_what_is_interpolated():
    scene = stage()
    bake = gi.bake(scene, POLYGONS, device().alias)
    one, two = (rendered(scene, POLYGONS, bakes=[bake], seed=seed) for seed in (1, 2))
    same = (one.numpy("environment") == two.numpy("environment")).all(axis=-1)
    assert same.mean() > 0.8
    states = bake.arrays["states"]
    assert (states == 1).sum() > 0.6 * bake.counts["sides"]
    variance = one.numpy("variance").sum(axis=-1)
    assert (variance[same] == 0).all()


def test_a_glossy_floor_is_the_traced_one_in_the_mean():
    glossy = gi.Material("glossy", (0.5, 0.4, 0.3), roughness=0.4)
    scene = stage(glossy)
    truth, got = light(scene, gi.TracedEnvironment(), 512), light(scene, POLYGONS, 512)
    np.testing.assert_allclose(got.mean(axis=(0, 1)), truth.mean(axis=(0, 1)), rtol=0.015)


@pytest.mark.parametrize("material", [GREY, gi.Material("glossy", (0.5, 0.4, 0.3), roughness=0.4)], ids=["", "glossy"])
@pytest.mark.parametrize("environment", [SKY, gi.Environment(color=(0.5, 1.0, 2.0))], ids=["map", "constant"])
def test_unbiased_is_the_traced_mean_with_less_noise(material, environment):
    """Polygons of a coarse bake, none of them flagged, are the control variate of samples."""
    scene = stage(material, environment)
    coarse = replace(POLYGONS, resolution=16, simplified=4.0, flagged_above=1.0)
    bake = gi.bake(scene, coarse, device().alias)
    truth = light(scene, gi.TracedEnvironment(), 4096)
    biased = light(scene, coarse, 64, [bake])
    frames = np.array([light(scene, replace(coarse, mode="unbiased"), 16, [bake], seed) for seed in range(8)])
    traced = np.array([light(scene, gi.TracedEnvironment(), 16, seed=seed) for seed in range(8)])
    mean, noise, other = frames.mean(axis=0), frames.var(axis=0, ddof=1).mean(), traced.var(axis=0, ddof=1).mean()
    assert noise < 0.5 * other
    assert np.mean((mean - truth) ** 2) < 1.2 * (noise / 8 + other * 16 / 4096)
    sums = frames.mean(axis=(1, 2))
    spread = 4 * sums.std(axis=0, ddof=1) / 8**0.5 + 1e-3 * truth.mean(axis=(0, 1))
    assert (np.abs(sums.mean(axis=0) - truth.mean(axis=(0, 1))) < spread).all()
    assert np.mean((mean - truth) ** 2) < np.mean((biased - truth) ** 2)


def test_three_integrals_a_pixel_are_the_method_before():
    """Light of three corners, blended: noise-free, near the truth, and one integral is nearer on the whole."""
    scene = stage(level=3)
    truth = light(scene, gi.TracedEnvironment(), 1024)
    bake = gi.bake(scene, POLYGONS, device().alias)
    one, three = (light(scene, replace(POLYGONS, evaluations=count), 64, [bake]) for count in (1, 3))
    errors = [np.abs(image - truth).mean(axis=2)[truth.any(axis=2)] / truth.mean() for image in (one, three)]
    assert abs((three - truth).mean() / truth.mean()) < 0.01 and np.median(errors[1]) < 0.02
    assert 0 < np.median(errors[0]) < np.median(errors[1])
    assert np.mean(errors[0] ** 2) < np.mean(errors[1] ** 2)


def test_a_turning_sky_needs_no_new_bake_and_no_new_table():
    scene = stage()
    bake = gi.bake(scene, POLYGONS, device().alias)
    made = []
    for turn in (0.0, 40.0, 200.0):
        scene.environment = SKY.rotated(turn)
        got = light(scene, POLYGONS, bakes=[bake])
        truth = light(scene, gi.TracedEnvironment(), 256)
        assert np.mean(got) == pytest.approx(np.mean(truth), rel=0.02)
        made.append(scene.environment.once_a_map(("polygons", "adaptive", device().alias), lambda pixels: None))
    assert made[0] is not None and made[0] is made[1] is made[2]
    scene.environment = None
    assert not light(scene, POLYGONS, bakes=[bake]).any()


def test_evaluators_agree_and_a_constant_sky_is_the_share_that_is_seen():
    scene = stage()
    bake = gi.bake(scene, POLYGONS, device().alias)
    images = [light(scene, replace(POLYGONS, evaluator=one), bakes=[bake]) for one in ("adaptive", "exact")]
    np.testing.assert_allclose(images[0].mean(), images[1].mean(), rtol=1e-3)
    white = gi.Environment(pixels=np.ones((16, 32, 3), np.float32))
    scene.environment = white
    as_map = light(scene, POLYGONS, bakes=[bake])
    scene.environment = 1.0
    as_constant = light(scene, POLYGONS, bakes=[bake])
    same = (rendered(scene, POLYGONS, bakes=[bake], seed=2).numpy("environment") == as_constant).all(axis=-1)
    np.testing.assert_allclose(as_map[same], as_constant[same], atol=2e-3)


def test_what_moves_is_refused():
    scene = stage()
    scene.animate("ball", [gi.Keyframe(0.0), gi.Keyframe(1.0, (1, 0, 0))])
    with pytest.raises(SceneError, match="of scenes at rest, and 'ball' move here: take VisibilityField"):
        gi.bake(scene, POLYGONS, device().alias)


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        ({"evaluations": 2}, "evaluations must be 1 or 3, got 2"),
        ({"evaluations": 3, "mode": "unbiased"}, "corrects one integral a pixel, not 3"),
        ({"mode": "biased"}, "unknown mode of visibility polygons 'biased'"),
        ({"evaluator": "vsat"}, "unknown evaluator of visibility polygons 'vsat'"),
        ({"resolution": 4}, "resolution must be a whole number from 8 to 256, got 4"),
        ({"resolution": True}, "resolution must be a whole number from 8 to 256, got True"),
        ({"simplified": -1.0}, "simplified must be a number from 0 to 10, got -1.0"),
        ({"flagged_above": math.nan}, "flagged_above must be a number from 0 to 1, got nan"),
        ({"tolerance": 0.0}, "tolerance must be a number from 1e-06 to 1, got 0.0"),
    ],
)
def test_bad_settings(settings, told):
    with pytest.raises(gi.OptionError, match=told):
        gi.VisibilityPolygons(**settings)


def test_the_command_bakes_shows_and_exports(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(pictures, "REFERENCE_SAMPLES", 4)
    monkeypatch.setattr(pictures, "SHOW_SAMPLES", 1)
    bake, out = tmp_path / "a.polygons.safetensors", tmp_path / "a.bin"
    command = ["bake", "sphere_row", "--technique", "visibility-polygons", "--resolution", "16", "-o", str(bake)]
    assert cli.main([*command, "--export", str(out), "--show", str(tmp_path / "show"), "--quiet"]) == 0
    names = sorted(path.name for path in (tmp_path / "show").iterdir())
    assert names == ["error.png", "polygons.png", "render.png", "states.png"]
    arrays, info = read_polygons(out.with_suffix(".json"))
    kept = gi.load_bake(bake)
    assert set(arrays) == set(kept.arrays) and info["settings"]["resolution"] == 16
    for name, array in arrays.items():
        np.testing.assert_array_equal(array, kept.arrays[name])
    info["arrays"]["points"]["shape"] = [1 << 30, 4]
    out.with_suffix(".json").write_text(json.dumps(info))
    with pytest.raises(BakeError, match="is no export of visibility polygons"):
        read_polygons(out.with_suffix(".json"))
    capsys.readouterr()
    assert cli.main([*command[:-2], "--export", str(tmp_path / "a.png")]) != 0
    assert "polygons are a .bin file" in capsys.readouterr().err
