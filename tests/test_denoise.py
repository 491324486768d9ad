"""Denoisers: the filters against NumPy, what must not blur or leak, memory over frames, and less error."""

import sys
from dataclasses import dataclass

import numpy as np
import pytest
import warp as wp
from scene_tools import card, quad

import warp_gi as gi
from warp_gi import launch
from warp_gi.denoise import Oidn, SpatioTemporal, spatiotemporal
from warp_gi.errors import OptionError
from warp_gi.kernels import denoise, denoise_edges

CPU = wp.get_device("cpu")
W, H = 15, 11
NO_BLUR = {"levels": 0, "glossy_levels": 0, "edge_samples": 0, "first_samples": 1, "blend": 1.0}
NO_EDGES = SpatioTemporal(edge_samples=0, first_samples=1, blend=1.0)


def filled(struct, **arrays):
    """A kernel struct of arrays [height, width, ...]; those not given stay empty."""
    result = struct()
    for name, values in arrays.items():
        dtype = struct.vars[name].type.dtype
        values = np.ascontiguousarray(values.reshape(W * H, *values.shape[2:]))
        setattr(result, name, wp.array(values, dtype=dtype, device=CPU))
    return result


def image(array, *shape):
    return array.numpy().reshape(*shape, -1)


def plane_guides(**changes):
    """Guides of a plane at z = 0 seen from 1 m, a pixel 1 cm wide."""
    y, x = np.mgrid[:H, :W].astype(np.float32)
    up = np.zeros((H, W, 3), np.float32) + np.float32([0, 0, 1])
    position = np.stack([0.01 * x, -0.01 * y, np.zeros_like(x)], -1)
    guides = {
        "guide_distance": np.ones((H, W), np.float32),
        "guide_position": position,
        "guide_previous": position,
        "guide_motion": np.zeros((H, W, 2), np.float32),
        "guide_normal": up,
        "guide_plane": up,
        "guide_object": np.ones((H, W), np.int32),
    }
    return guides | changes


LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def settings_of(**changes):
    settings = denoise.DenoiseSettings()
    values = {"width": W, "height": H, "footprint": 0.01, "diffuse_frames": 32, "glossy_frames": 16, "lag": 3.0}
    values |= {"worth": 1.0, "settled": 4.0}
    values |= {"step": 1, "normal": 32.0, "plane": 1.0, "luminance": 2.0, "filters_diffuse": 1, "filters_glossy": 1}
    for name, value in (values | changes).items():
        setattr(settings, name, value)
    return settings


def level_of(guides, light, glossy=None, tells=None, **changes):
    """What one level of the filter makes of ``light`` and ``glossy`` [height, width, 4]: both, [height, width, 4]."""
    source = filled(denoise.Filtered, diffuse=light, glossy=light if glossy is None else glossy)
    out = denoise.Filtered()
    out.diffuse, out.glossy = wp.zeros_like(source.diffuse), wp.zeros_like(source.glossy)
    told = wp.empty(0, dtype=wp.vec2, device=CPU)
    if tells is not None:
        told = wp.array(tells.reshape(-1, 2).astype(np.float32), dtype=wp.vec2, device=CPU)
    inputs = [settings_of(**changes), filled(denoise.Guides, **guides), source, told, out]
    launch.launch(denoise.filter_level, W * H, inputs, CPU)
    return image(out.diffuse, H, W), image(out.glossy, H, W)


def blurred(guides, light):
    """What four levels make of ``light`` [height, width, 3] that seems to vary much."""
    now = np.concatenate([light, np.full((H, W, 1), 1e6, np.float32)], axis=-1)
    for level in range(4):
        now[..., 3] = 1e6
        now = level_of(guides, now.astype(np.float32), step=1 << level)[0]
    return now[..., :3]


def random_guides(rng):
    normal = rng.normal((0, 0, 1), 0.3, (H, W, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    guides = plane_guides(guide_normal=normal.astype(np.float32))
    guides["guide_position"] = guides["guide_position"] + rng.normal(0, 0.02, (H, W, 3)).astype(np.float32)
    guides["guide_distance"] = rng.uniform(0.5, 2.0, (H, W)).astype(np.float32)
    guides["guide_object"] = (rng.random((H, W)) < 0.9).astype(np.int32)
    return guides


def inside(y, x):
    return 0 <= y < H and 0 <= x < W


@pytest.mark.parametrize("told", [False, True])
@pytest.mark.parametrize("step", [1, 2])
def test_a_level_of_the_filter_is_the_formula(step, told):
    rng = np.random.default_rng(1)
    guides = random_guides(rng)
    lights = [rng.random((H, W, 4)).astype(np.float32) for _ in range(2)]
    tells = rng.random((H, W, 2)) if told else np.stack([light[..., :3] @ LUMINANCE for light in lights], -1)
    result = level_of(guides, *lights, tells=tells if told else None, step=step, normal=2.0, footprint=0.05)
    position, normal, plane = (guides[f"guide_{name}"].astype(float) for name in ("position", "normal", "plane"))
    seen, taps = guides["guide_object"] > 0, [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1)]
    for kind, light in enumerate(lights):
        expected = light.astype(float).copy()
        for y, x in np.argwhere(seen):
            near = [(y + r, x + c, 0.5 ** (abs(r) + abs(c))) for r, c in taps if inside(y + r, x + c)]
            near = [(ty, tx, w) for ty, tx, w in near if seen[ty, tx]]
            variance = sum(w * light[ty, tx, 3] for ty, tx, w in near) / sum(w for *_, w in near)
            total, color, spread = 0.0, np.zeros(3), 0.0
            for r, c in taps:
                ty, tx = y + step * r, x + step * c
                if not inside(ty, tx) or not seen[ty, tx]:
                    continue
                away = abs(plane[y, x] @ (position[ty, tx] - position[y, x]))
                e = away / (0.05 * guides["guide_distance"][y, x])
                e += 2.0 * (1 - normal[y, x] @ normal[ty, tx])
                if (r, c) == (0, 0):
                    e = 0.0
                if e < 12:
                    off = abs(tells[ty, tx, kind] - tells[y, x, kind])
                    deviation = 2 * np.sqrt(variance) + 1e-3 * tells[y, x, kind]
                    w = 0.5 ** (abs(r) + abs(c)) * np.exp(-e - off / deviation)
                    total, color = total + w, color + w * light[ty, tx, :3]
                    spread += w**2 * light[ty, tx, 3]
            expected[y, x] = [*(color / total), spread / total**2]
        assert np.abs(expected - light).max() > 0.3
        assert np.abs(result[kind] - expected).max() < 2e-5


def test_variance_is_of_the_mean():
    """Of long averages by their moments, of short ones by the pixels around, whose mean tells lights apart, too."""
    rng = np.random.default_rng(4)
    guides, light = random_guides(rng), rng.random((2, H, W, 3)).astype(np.float32)
    guides["guide_plane"] = guides["guide_normal"]
    moments, length = rng.uniform(1.0, 2.0, (H, W, 2)).astype(np.float32), rng.integers(1, 9, (H, W))
    length = np.stack([length, rng.permuted(length, axis=0)], -1)
    length[3:6, 4:7] = 0  # not known
    average = filled(
        denoise.Signals, diffuse=light[0], glossy=light[1], moments=moments, length=length.astype(np.float32)
    )
    out = denoise.Filtered()
    out.diffuse, out.glossy = (wp.zeros(W * H, dtype=wp.vec4, device=CPU) for _ in range(2))
    tells = wp.zeros(W * H, dtype=wp.vec2, device=CPU)
    settings = settings_of(footprint=0.005)
    inputs = [settings, filled(denoise.Guides, **guides), average, out, tells]
    launch.launch(denoise.estimate_variance, W * H, inputs, CPU)
    told, normal, position = image(tells, H, W), guides["guide_normal"], guides["guide_position"].astype(float)
    short = 0
    for kind, result in enumerate((out.diffuse, out.glossy)):
        found, luminance = image(result, H, W), light[kind].astype(float) @ LUMINANCE
        np.testing.assert_array_equal(found[..., :3], light[kind])
        for y, x in np.argwhere(guides["guide_object"] > 0):
            n = length[y, x, kind]
            if n == 0:
                assert found[y, x, 3] < 0
                continue
            reach = 3 if min(m if m else 4 for m in length[y, x]) < 4 else 1
            around = [
                (ty, tx)
                for ty in range(max(y - reach, 0), min(y + reach + 1, H))
                for tx in range(max(x - reach, 0), min(x + reach + 1, W))
                if guides["guide_object"][ty, tx]
                and length[ty, tx, kind]
                and normal[y, x] @ normal[ty, tx] >= 0.85
                and abs(normal[y, x] @ (position[ty, tx] - position[y, x])) < 0.015 * guides["guide_distance"][y, x]
            ]
            l = np.array([luminance[at] for at in around])
            if n < 4:
                short += len(around) > 3
                assert told[y, x, kind] == pytest.approx(l.mean(), rel=1e-4)
                assert found[y, x, 3] == pytest.approx(l.var() * 4 / n, rel=2e-3, abs=1e-5)
            else:
                spread = np.mean([max(moments[at][kind] - luminance[at] ** 2, 0) for at in around])
                assert told[y, x, kind] == pytest.approx(luminance[y, x], rel=1e-4)
                assert found[y, x, 3] == pytest.approx(spread / (n - 1), rel=1e-3)
    assert short > 20


def test_light_below_nothing_is_filtered_too():
    """As it may be where camera samples differ in colour: what is shared out is then less than what was apart."""
    light = np.full((H, W, 4), -0.5, np.float32)
    light[..., 3] = 0.0
    light[4, 5, :3] = -0.3
    both = level_of(plane_guides(), light)
    assert all(np.isfinite(one).all() and np.abs(one[..., :3] - light[..., :3]).max() < 1e-3 for one in both)


@pytest.mark.parametrize("edge", ["normal", "depth"])
def test_edges_do_not_leak(edge):
    guides = plane_guides()
    right = np.arange(W) > W // 2
    if edge == "normal":  # a wall that rises from the plane
        guides["guide_normal"] = np.where(right[None, :, None], np.float32([-1, 0, 0]), guides["guide_normal"])
        guides["guide_plane"] = guides["guide_normal"]
        x = guides["guide_position"][..., 0]
        foot = 0.01 * (W // 2 + 0.5)
        guides["guide_position"] = guides["guide_position"].copy()
        guides["guide_position"][..., 2] = np.where(right, x - foot, 0)
        guides["guide_position"][..., 0] = np.where(right, foot, x)
    else:
        guides["guide_position"] = guides["guide_position"] + np.float32([0, 0, -0.15]) * right[None, :, None]
    light = np.where(right[None, :, None], np.float32([100, 0, 1]), np.float32([0, 1, 1])) + np.zeros((H, 1, 1), "f4")
    result = blurred(guides, light)
    assert np.abs(result - light).max() < (0.1 if edge == "normal" else 1e-4)
    assert np.abs(blurred(plane_guides(), light) - light).max() > 30


@pytest.mark.parametrize("lobes", [False, True])
def test_separated_light_put_back_is_the_light(lobes):
    """Whatever the albedo, and black and Lambert surfaces too; constant light is constant before it meets them."""
    rng = np.random.default_rng(2)
    color = lambda: rng.random((H, W, 3)).astype(np.float32)  # noqa: E731
    diffuse, specular = color(), color() * (rng.random((H, W, 1)) < 0.5)
    diffuse[:, :4], specular[:, :2] = 0, 0
    guides = filled(
        denoise.Guides, guide_diffuse=diffuse, guide_specular=specular, guide_object=np.ones((H, W), np.int32)
    )
    terms = {"emission": color()} | {name: color() for name in ("environment", "emitters", "indirect")}
    reflected = diffuse + specular
    if lobes:
        terms |= {"lobe_diffuse": color(), "lobe_glossy": color() * (specular > 0)}
        terms["indirect"] = terms["indirect"] * reflected + diffuse * terms["lobe_diffuse"] + terms["lobe_glossy"]
    else:
        terms["indirect"] = terms["indirect"] * reflected
    terms["environment"], terms["emitters"] = 2 * reflected, terms["emitters"] * reflected
    light = filled(denoise.NoisyLight, noisy=sum(terms[n] for n in list(terms)[:4]), **terms)
    moments, length = np.ones((H, W, 2), np.float32), np.ones((H, W, 2), np.float32)
    signals = filled(denoise.Signals, diffuse=color(), glossy=color(), moments=moments, length=length)
    launch.launch(denoise.separate_light, W * H, [settings_of(), light, guides, signals], CPU)
    both = {name: image(getattr(signals, name), H, W) for name in ("diffuse", "glossy")}
    squares = np.stack([(values.astype(float) @ LUMINANCE) ** 2 for values in both.values()], -1)
    np.testing.assert_allclose(image(signals.moments, H, W), squares, rtol=1e-4)
    beauty = wp.zeros(W * H, dtype=wp.vec3, device=CPU)
    four = {name: np.pad(values, ((0, 0), (0, 0), (0, 1))) for name, values in both.items()}
    launch.launch(denoise.put_back, W * H, [light, guides, filled(denoise.Filtered, **four), beauty], CPU)
    assert np.allclose(image(beauty, H, W), image(light.noisy, H, W), rtol=1e-5, atol=1e-5)
    if not lobes:
        flat = filled(
            denoise.NoisyLight,
            **{n: np.zeros((H, W, 3), np.float32) for n in ("emission", "emitters", "indirect", "noisy")},
            environment=2 * reflected,
        )
        launch.launch(denoise.separate_light, W * H, [settings_of(), flat, guides, signals], CPU)
        incident, known = image(signals.diffuse, H, W), image(signals.length, H, W) > 0
        np.testing.assert_allclose(incident[diffuse.max(-1) > 1e-6], 2, rtol=1e-5)
        np.testing.assert_array_equal(known[..., 0], diffuse.max(-1) > 1e-6)
        np.testing.assert_array_equal(known[..., 1], specular.max(-1) > 1e-6)


SIZE = (32, 24)


def checkered(metallic=0.0):
    rng = np.random.default_rng(3)
    texture = gi.Texture("checks", rng.integers(0, 255, (8, 8, 4), dtype=np.uint8) | np.uint8([0, 0, 0, 255]))
    return gi.Material(base_color_texture=texture, specular=metallic, metallic=metallic, roughness=1.0)


def scene(environment=(0.3, 0.4, 0.5)):
    """A textured card before a textured wall, and a lamp."""
    lamp = gi.Material("lamp", emission=(9.0, 6.0, 3.0))
    nodes = [
        gi.Node("wall", [card(-2.0, 5.0, checkered())]),
        gi.Node("card", [card(0.0, 0.7, checkered())]),
        gi.Node("lamp", [card(4.0, 0.5, lamp)]),
    ]
    return gi.Scene(nodes, environment=environment)


def still():
    return gi.CameraPath.still(gi.Camera.look_at((0, 0, 3.5), (0, 0, 0), hfov=60, resolution=SIZE))


def sideways(step=0.3):
    keys = (gi.CameraKey(0.0, (0, 0, 3.5), (0, 0, 0)), gi.CameraKey(1.0, (step, 0, 3.5), (step, 0, 0)))
    return gi.CameraPath(keys, fps=1, resolution=SIZE)


def lengths(scheduler):
    return scheduler.state("denoise").average.length.numpy()[:, 0].reshape(SIZE[::-1])


def test_textures_under_even_light_are_not_blurred():
    """One Lambert plane under a constant sky has no noise, so that a denoiser has nothing to change."""
    plane = gi.Scene([gi.Node("wall", [card(-2.0, 9.0, checkered())])], environment=(0.3, 0.4, 0.5))
    scheduler = gi.FrameScheduler(plane, sideways(), gi.Pipeline(spp=4, denoise=NO_EDGES))
    for index in (0, 1):
        frame = scheduler.frame(index)
        assert np.ptp(frame.numpy("noisy")[..., 0]) > 0.1
        assert np.allclose(frame.numpy("beauty"), frame.numpy("noisy"), rtol=1e-4)


@pytest.mark.parametrize("frames", [32, 3])
def test_still_view_is_the_exponential_average(frames):
    settings = SpatioTemporal(frames=frames, lag=0.0, **NO_BLUR)
    scheduler = gi.FrameScheduler(scene(), still(), gi.Pipeline(spp=1, denoise=settings))
    mean = 0.0
    for index in range(8):
        frame = scheduler.frame(index)
        weight = max(1 / frames, 1 / (index + 1))
        mean = (1 - weight) * mean + weight * frame.numpy("noisy")
        assert np.allclose(frame.numpy("beauty"), mean, rtol=1e-3, atol=1e-3)
    assert lengths(scheduler)[frame.numpy("object_id") >= 0].min() == pytest.approx(min(8, frames))


def test_still_view_converges_without_bias():
    """At pixel centres: what camera samples do at outlines and in textures is no light, and stays."""
    reference = next(gi.render(scene(), still(), gi.Pipeline(spp=1024, camera_samples=1), seed=8))
    light = reference.numpy("beauty") - reference.numpy("emission")
    scheduler = gi.FrameScheduler(scene(), still(), gi.Pipeline(spp=2, camera_samples=1, denoise=NO_EDGES))
    errors = []
    for index in range(48):
        frame = scheduler.frame(index)
        errors.append(gi.metrics.rmse(frame.numpy("beauty") - frame.numpy("emission"), light))
    noisy = gi.metrics.rmse(frame.numpy("noisy") - frame.numpy("emission"), light)
    assert errors[0] < 0.6 * noisy
    assert errors[47] < 0.75 * errors[7] < 0.75 * errors[0], errors
    found = (frame.numpy("beauty") - frame.numpy("emission")).mean((0, 1))
    assert np.allclose(found, light.mean((0, 1)), rtol=0.02)


@pytest.mark.parametrize("moves", ["camera", "card"])
def test_no_history_from_other_objects(moves):
    """The average before is replaced by a number for each object: a pixel may only meet that of its own.

    Such a number is no change of the light, which is not looked for.
    """
    shot = scene()
    if moves == "card":
        shot.animate("card", [gi.Keyframe(0.0), gi.Keyframe(1.0, translation=(0.6, 0.0, 0.3))])
    path = sideways(0.8) if moves == "camera" else gi.CameraPath(still().keys, fps=1, resolution=SIZE)
    scheduler = gi.FrameScheduler(shot, path, gi.Pipeline(spp=4, denoise=SpatioTemporal(lag=0.0)))
    scheduler.frame(0)
    state = scheduler.state("denoise")
    state.average.diffuse.assign(np.repeat(1e4 * state.guides.guide_object.numpy()[:, None], 3, 1))
    frame = scheduler.frame(1)
    state, length = scheduler.state("denoise"), lengths(scheduler).ravel()
    objects, average = state.guides.guide_object.numpy(), state.average.diffuse.numpy()
    assert np.array_equal(np.unique(length), [1, 2])
    seen = length == 2
    assert np.abs(average[seen] / 1e4 - 0.5 * objects[seen, None]).max() < 0.01
    assert np.abs(average[~seen]).max() < 100
    card = shot.object_names.index("card")
    new = ~seen & (objects > 0)
    assert new.sum() >= 10 and (objects[new] == shot.object_names.index("wall") + 1).mean() > 0.6
    assert seen[frame.numpy("object_id").ravel() == card].mean() > 0.8


def test_cuts_start_anew():
    shot = scene()
    scheduler = gi.FrameScheduler(shot, still(), gi.Pipeline(spp=1, denoise=NO_EDGES))

    def longest(index, previous=None):
        scheduler.frame(index, previous)
        return lengths(scheduler).max()

    assert [longest(0), longest(1), longest(2)] == [1, 2, 3]
    assert [longest(2), longest(3), longest(7), longest(8)] == [1, 2, 1, 2]
    assert [longest(12, 8), longest(14, 13)] == [3, 1]
    assert longest(15) == 2
    shot.environment = (0.5, 0.5, 0.5)
    assert [longest(16), longest(17)] == [1, 2]
    scheduler.camera = scheduler.camera.at_resolution(20, 12)
    scheduler.frame(18)
    assert set(scheduler.state("denoise").average.length.numpy()[:, 0]) == {1}


def test_light_beside_black_is_not_lost():
    """A plane in even light with tiles that are black, or black in a channel: light there is not known, and not 0."""
    for dark in ((0.0, 0.0, 0.0), (0.8, 0.0, 0.0)):
        pixels = np.full((8, 8, 4), 255, np.uint8)
        pixels[:, ::2, :3] = np.array(dark) * 255
        tiles = gi.Material("tiles", (0.8, 0.8, 0.8), base_color_texture=gi.Texture("tiles", pixels), specular=0.0)
        plane = gi.Scene([gi.Node("wall", [card(-2.0, 9.0, tiles)])], environment=(0.5, 0.4, 0.3))
        scheduler = gi.FrameScheduler(plane, sideways(), gi.Pipeline(spp=1, indirect=None, denoise="spatiotemporal"))
        for index in range(3):
            frame = scheduler.frame(index)
            beauty, noisy = (frame.numpy(name).mean(axis=(0, 1)) for name in ("beauty", "noisy"))
            np.testing.assert_allclose(beauty, noisy, rtol=0.06)


def test_what_is_no_number_stays_where_it_is():
    """A sample that is infinite is no light, in its frame and in those after."""
    scheduler = gi.FrameScheduler(scene(), still(), gi.Pipeline(spp=1, indirect=Broken(), denoise="spatiotemporal"))
    for index in range(4):
        beauty = scheduler.frame(index).numpy("beauty")
        assert np.isfinite(beauty).all() and beauty.max() < 100


@dataclass(frozen=True)
class Broken(gi.BsdfPaths):
    """Indirect light that is infinite, no number, and very bright in a pixel each of frame 1."""

    def trace(self, frame, state):
        """Ask for paths, and add these to the term."""
        super().trace(frame, state)
        if frame.index == 1:
            values = frame["indirect"].numpy()
            values[[330, 400, 460]] = [[np.inf], [np.nan], [1e20]]
            frame["indirect"].assign(values)


@pytest.mark.parametrize("factor", [0.1, 4.0])
def test_light_that_changes_is_followed(factor):
    """Another sky in each frame, as one that turns has: 90 % of the way within three frames, and all of it after."""
    keys = [(0.3, 0.4, 0.5)] * 8 + [(0.3 * factor, 0.4 * factor, 0.5 * factor)] * 8
    shot = scene(lambda time: keys[min(round(time), 15)])
    shot.nodes[2].meshes.clear()
    shot = gi.Scene(shot.nodes[:2], environment=lambda time: keys[min(round(time), 15)])
    path = gi.CameraPath(still().keys, fps=1, resolution=SIZE)
    light = {}
    for lag in (3.0, 0.0):
        scheduler = gi.FrameScheduler(shot, path, gi.Pipeline(spp=4, denoise=SpatioTemporal(lag=lag)))
        light[lag] = [scheduler.frame(index).numpy("beauty").mean() for index in range(16)]
    before, after = light[3.0][7], light[3.0][7] * factor
    share = [(value - before) / (after - before) for value in light[3.0]]
    assert abs(share[6]) < 0.01 and share[10] > 0.9 and share[15] == pytest.approx(1.0, abs=0.01)
    slow = (light[0.0][10] - before) / (after - before)
    assert slow < 0.35


def test_still_light_is_not_forgotten():
    """Noise alone shortens hardly an average, though sixty blocks are looked at in each frame."""
    shot = gi.builtin_scene("cornell_box")
    camera = gi.builtin_camera_path("cornell_box").camera(0).at_resolution(64, 64)
    settings = gi.Pipeline(spp=1, denoise="spatiotemporal")
    scheduler = gi.FrameScheduler(shot, gi.CameraPath.still(camera), settings)
    for index in range(24):
        scheduler.frame(index)
    state = scheduler.state("denoise")
    length = state.average.length.numpy()[state.guides.guide_object.numpy() > 0, 0]
    length = length[length > 0]  # the lamp reflects nothing
    assert np.median(length) == 27 and length.mean() > 26


def test_a_frame_without_a_frame_before_takes_more_samples():
    """The first one, and one after a cut, are those of a pipeline of four samples; others are as asked."""
    only = {"camera_samples": 1, "indirect": None}
    scheduler = gi.FrameScheduler(scene(), sideways(), gi.Pipeline(spp=1, denoise="spatiotemporal", **only))
    spp = {1: gi.Pipeline(spp=1, **only), 4: gi.Pipeline(spp=4, **only)}
    for index, count in ((0, 4), (1, 1), (5, 4)):
        wanted = next(gi.render(scene(), sideways(), spp[count], [index])).numpy("beauty")
        np.testing.assert_array_equal(scheduler.frame(index).numpy("noisy"), wanted)


def test_threads_do_not_change_a_bit():
    frames = []
    for threads in (1, 2):
        launch.set_threads(threads)
        frames.append(list(gi.render(scene(), sideways(), gi.Pipeline(spp=2, denoise="spatiotemporal"), [0, 1])))
    launch.set_threads(None)
    for one, other in zip(*frames, strict=True):
        for name in one.names:
            assert np.array_equal(one.numpy(name), other.numpy(name), equal_nan=True), name


# ---- edges ----


def test_camera_samples_at_edges_are_what_many_would_show():
    """Outlines and textures at one sample a pixel, under light without noise: a fraction of the stairs' error."""
    shot = gi.Scene([gi.Node("wall", [card(-2.0, 5.0, checkered())]), gi.Node("card", [card(0.0, 0.7, checkered())])])
    shot.environment = (0.3, 0.4, 0.5)
    camera = gi.Camera.look_at((0.03, 0.02, 3.5), (0, 0, 0), up=(0.2, 1, 0), hfov=60, resolution=SIZE)
    wanted = next(gi.render(shot, camera, gi.Pipeline(spp=256, camera_samples=256, indirect=None))).numpy("beauty")
    errors = {}
    for samples in (0, 4, 16):
        denoiser = SpatioTemporal(edge_samples=samples)
        frame = next(gi.render(shot, camera, gi.Pipeline(spp=1, indirect=None, denoise=denoiser)))
        errors[samples] = gi.metrics.rmse(frame.numpy("beauty"), wanted)
    assert errors[4] < 0.6 * errors[0] and errors[16] < 0.4 * errors[0], errors


def test_frames_of_many_camera_samples_have_smooth_edges():
    """A pixel of 16 camera samples keeps them: four would be noisier."""
    camera = gi.Camera.look_at((0.03, 0.02, 3.5), (0, 0, 0), up=(0.2, 1, 0), hfov=60, resolution=SIZE)
    beauty = {}
    for samples in (0, 4):
        denoiser = SpatioTemporal(edge_samples=samples)
        frame = next(gi.render(scene(), camera, gi.Pipeline(spp=16, camera_samples=16, denoise=denoiser)))
        beauty[samples] = frame.numpy("beauty")
    np.testing.assert_array_equal(beauty[0], beauty[4])


def test_edges_show_the_sky_and_what_emits():
    """A lamp before the sky, in no other light: its outline is a mean of both."""
    lamp = card(0.0, 0.6, gi.Material("lamp", (0, 0, 0), emission=(4.0, 2.0, 1.0), specular=0.0))
    shot = gi.Scene([gi.Node("lamp", [lamp])], environment=(0.5, 0.5, 0.5))
    pipeline = gi.Pipeline(spp=1, denoise=SpatioTemporal(edge_samples=64))
    frame = next(gi.render(shot, gi.Camera.look_at((0, 0, 3), (0, 0, 0), up=(0.3, 1, 0), hfov=40), pipeline))
    beauty, sees = frame.numpy("beauty"), frame.numpy("object_id") == 0
    outline = (beauty[..., 0] > 0.505) & (beauty[..., 0] < 3.995)
    assert outline.sum() > 50
    share = (beauty[outline, 0] - 0.5) / 3.5
    np.testing.assert_allclose(beauty[outline, 1], 0.5 + 1.5 * share, rtol=1e-3)
    np.testing.assert_allclose(
        beauty[sees & ~outline], np.tile([4.0, 2.0, 1.0], ((sees & ~outline).sum(), 1)), rtol=1e-3
    )
    assert share.mean() == pytest.approx(0.5, abs=0.1)


def averaged(picture, last, motion, depth=None, shining=None, less=0.0, **changes):
    """What ``average_pictures`` makes of pictures [height, width, 3] and a motion [height, width, 2]."""
    vectors = lambda a: wp.array(a.reshape(H * W, 3).astype(np.float32), dtype=wp.vec3, device=CPU)  # noqa: E731
    edges = denoise_edges.EdgeSettings()
    edges.weight, edges.clip = changes.get("weight", 0.25), changes.get("clip", 1e6)
    depth = np.ones((H, W), np.float32) if depth is None else depth
    seen = filled(denoise_edges.Seen, depth=depth, motion=motion.astype(np.float32))
    shining = np.zeros_like(picture) if shining is None else shining
    parts = {"beauty": picture, "shining": shining, "less": np.full((H, W), less)}
    both = filled(denoise_edges.Picture, **{name: values.astype(np.float32) for name, values in parts.items()})
    kept, beauty = (wp.zeros(H * W, dtype=wp.vec3, device=CPU) for _ in range(2))
    inputs = [settings_of(), edges, seen, both, vectors(last), kept, beauty]
    launch.launch(denoise_edges.average_pictures, H * W, inputs, CPU)
    np.testing.assert_allclose(image(kept, H, W), image(beauty, H, W) - shining, rtol=1e-4, atol=1e-4)
    return image(beauty, H, W)


def test_the_last_picture_moves_along():
    """A ramp that moved by a fraction of a pixel is itself again, and keeps a quarter of what is new."""
    y, x = np.mgrid[:H, :W].astype(float)
    ramp = lambda a, b: np.stack([a, b, a + 2 * b], -1)  # noqa: E731
    motion = np.broadcast_to([0.3, -0.6], (H, W, 2))
    result = averaged(ramp(x, y) + 8.0, ramp(x - 0.3, y + 0.6), motion)
    inner = (slice(3, -3), slice(3, -3))
    np.testing.assert_allclose(result[inner], (ramp(x, y) + 2.0)[inner], rtol=1e-4)
    result = averaged(ramp(x, y) + 8.0, ramp(x - 0.3, y + 0.6), motion, less=0.4)  # 0.25 + 0.75 * 0.4 of what is new
    np.testing.assert_allclose(result[inner], (ramp(x, y) + 8.0 * 0.55)[inner], rtol=1e-4)
    result = averaged(ramp(x, y) + 8.0, ramp(x - 0.3, y + 0.6), motion)
    outside = (y - 0.6 < 0) | (x + 0.3 > W - 1)
    np.testing.assert_allclose(result[outside], (ramp(x, y) + 8.0)[outside], rtol=1e-5)


def test_the_last_picture_is_limited_to_what_is_around():
    rng = np.random.default_rng(5)
    picture, motion = rng.random((H, W, 3)), np.zeros((H, W, 2))
    result = averaged(picture, np.full((H, W, 3), 9.0), motion, clip=1.5)
    for y, x in ((0, 0), (5, 7), (H - 1, 3)):
        near = picture[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2].reshape(-1, 3)
        expected = 0.25 * picture[y, x] + 0.75 * (near.mean(0) + 1.5 * near.std(0))
        np.testing.assert_allclose(result[y, x], expected, rtol=1e-3)


def test_what_shines_by_itself_is_in_no_average_of_pictures():
    """A lamp of 90 beside walls of 0.1 that moves by half a pixel a frame: it is where it is, and walls stay dark."""
    picture, shining = np.full((H, W, 3), 0.1), np.zeros((H, W, 3))
    shining[5, 7] = 90.0
    motion = np.broadcast_to([0.5, 0.0], (H, W, 2))
    result = averaged(picture + shining, np.full((H, W, 3), 0.1), motion, shining=shining, clip=1.5)
    np.testing.assert_allclose(result, picture + shining, rtol=1e-4)
    assert averaged(picture + shining, picture + shining, motion, clip=1.5)[5, 6].min() > 5


def test_lamps_do_not_light_the_average_of_pictures():
    """Lamps half a pixel to three pixels wide before nothing: no light beside them, whatever the camera's way."""
    black = {"base_color": (0, 0, 0), "specular": 0.0}
    nodes = []
    for i in range(6):
        lamp = card(0.0, 0.03 * (1 + i), gi.Material("lamp", emission=(90.0, 60.0, 30.0), **black))
        place = np.eye(4)
        place[0, 3] = 0.4 * i - 1.0
        nodes.append(gi.Node(f"lamp {i}", [lamp], place))
    shot, seen = gi.Scene(nodes), {}
    for blend in (1.0, 0.25):
        scheduler = gi.FrameScheduler(shot, sideways(0.7), gi.Pipeline(spp=1, denoise=SpatioTemporal(blend=blend)))
        seen[blend] = [scheduler.frame(index).numpy("beauty") for index in range(6)]
    np.testing.assert_allclose(seen[0.25], seen[1.0], rtol=1e-4, atol=1e-4)
    assert np.max(seen[1.0]) > 10


def test_pixels_of_one_surface_at_an_edge_keep_less_of_the_last_picture():
    """Beside the outline of a card, pixels all of whose samples show the wall; on it, pixels that show both."""
    flat = gi.Material("flat", (0.5, 0.5, 0.5), specular=0.0)
    shot = gi.Scene([gi.Node("wall", [card(-2.0, 9.0, flat)]), gi.Node("card", [card(0.0, 0.7, flat)])])
    shot.environment = (0.3, 0.4, 0.5)
    found = []

    class Looks(SpatioTemporal):
        def _averaged(self, frame, settings, edges, picture, last):
            found.append(picture.less.numpy().reshape(SIZE[::-1]))
            return super()._averaged(frame, settings, edges, picture, last)

    frame = next(gi.render(shot, still(), gi.Pipeline(spp=1, denoise=Looks())))
    less, card_seen = found[0], frame.numpy("object_id") == 1
    assert set(np.unique(less)) == {0.0, np.float32(0.45)}
    near = np.zeros_like(card_seen)
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            near |= np.roll(card_seen, (dy, dx), (0, 1)) != card_seen
    assert (less[~near] == 0).all() and 0.3 < (less[near] > 0).mean() < 0.9


def test_a_picture_that_is_written_to_is_not_that_which_is_averaged():
    scheduler = gi.FrameScheduler(scene(), still(), gi.Pipeline(spp=1, denoise=SpatioTemporal(blend=0.25)))
    other = gi.FrameScheduler(scene(), still(), gi.Pipeline(spp=1, denoise=SpatioTemporal(blend=0.25)))
    scheduler.frame(0)["beauty"].fill_(9.0)
    other.frame(0)
    np.testing.assert_array_equal(scheduler.frame(1).numpy("beauty"), other.frame(1).numpy("beauty"))


def test_an_average_of_pictures_flickers_less():
    shot, path = gi.builtin_scene("cornell_box"), gi.builtin_camera_path("cornell_box")
    camera = gi.CameraPath.still(path.camera(0).at_resolution(48, 48))
    flicker = {}
    for blend in (1.0, 0.25):
        scheduler = gi.FrameScheduler(shot, camera, gi.Pipeline(spp=1, denoise=SpatioTemporal(blend=blend)))
        frames = [scheduler.frame(index).numpy("beauty") for index in range(12)]
        lamp = np.maximum(frames[-1], frames[-2]) > 2  # what shines is in no average
        flicker[blend] = np.abs(frames[-1] - frames[-2])[~lamp].mean()
    assert flicker[0.25] < 0.6 * flicker[1.0], flicker


@dataclass(frozen=True)
class Apart(gi.BsdfPaths):
    """Indirect light that comes in apart: ``diffuse`` alike everywhere, and random ``glossy`` light."""

    diffuse: float = 0.0
    glossy: float = 0.0

    def trace(self, frame, state):
        """Add both to the term and to the lobes."""
        incident, glossy, _ = frame.lobes()
        guides = frame.struct(denoise.Guides)
        rng = np.random.default_rng(frame.seed)
        comes = np.full((SIZE[0] * SIZE[1], 3), self.diffuse)
        leaves = self.glossy * rng.random((len(comes), 3)) * (guides.guide_specular.numpy() > 0)
        incident.assign(incident.numpy() + comes)
        glossy.assign(glossy.numpy() + leaves)
        frame["indirect"].assign(frame["indirect"].numpy() + guides.guide_diffuse.numpy() * comes + leaves)


@pytest.mark.parametrize("roughness", [0.3, 0.7])
def test_paths_part_light_by_lobes(roughness):
    """Under a sky of radiance 1 and a map of it, which is sampled: integrals of both lobes in float64."""
    red, f0, alpha = 0.6, 0.04, roughness**2
    coated = gi.Material("coated", (red, 0.3, 0.1), roughness=roughness, specular=1.0)
    shot = gi.Scene([gi.Node("floor", [quad((-50, 0, 50), (100, 0, 0), (0, 0, -100), coated, "floor")])])
    camera = gi.Camera.look_at((0, 1.0, 1.0), (0, 0, 0), hfov=0.5, resolution=(32, 32))
    c, p = np.stack(np.meshgrid((np.arange(400) + 0.5) / 400, (np.arange(400) + 0.5) / 400 * 2 * np.pi)).reshape(2, -1)
    wi = np.stack([np.sqrt(1 - c**2) * np.cos(p), np.sqrt(1 - c**2) * np.sin(p), c], -1)
    wo = np.array([np.sqrt(0.5), 0, np.sqrt(0.5)])
    half = (wi + wo) / np.linalg.norm(wi + wo, axis=-1, keepdims=True)
    fresnel = f0 + (1 - f0) * (1 - half @ wo) ** 5
    d = alpha**2 / (np.pi * (half[:, 2] ** 2 * (alpha**2 - 1) + 1) ** 2)
    root = lambda z: np.sqrt(alpha**2 + (1 - alpha**2) * z**2)  # noqa: E731
    v = 0.5 / (wo[2] * root(c) + c * root(wo[2]))
    diffuse, glossy = 2 * np.mean((1 - fresnel) * c), 2 * np.pi * np.mean(fresnel * d * v * c)
    for sky in ((1.0, 1.0, 1.0), gi.Environment(pixels=np.ones((8, 16, 3), np.float32))):
        shot.environment = sky
        frame = next(gi.render(shot, camera, gi.Pipeline(spp=64, indirect=None, denoise=NO_EDGES)))
        incident, reflected = (lobe.numpy().mean(axis=0) for lobe in frame.lobes()[:2])
        np.testing.assert_allclose(incident, diffuse, rtol=0.005)
        np.testing.assert_allclose(reflected, glossy, rtol=0.01)
        sums = np.array([red, 0.3, 0.1]) * incident + reflected
        np.testing.assert_allclose(sums, frame.numpy("environment").mean(axis=(0, 1)), rtol=1e-4)


@pytest.mark.parametrize("name", ["cornell_box", "sphere_row"])
def test_lobes_of_paths_are_all_of_their_light(name):
    """At pixel centres, where a pixel has one albedo; with lamps, sky, mirrors and indirect light."""
    camera = gi.builtin_camera_path(name).camera(0).at_resolution(40, 24)
    frame = next(gi.render(gi.builtin_scene(name), camera, gi.Pipeline(spp=4, camera_samples=1, denoise=NO_EDGES)))
    incident, reflected = (lobe.numpy().reshape(24, 40, 3) for lobe in frame.lobes()[:2])
    if frame.lobes().apart is not None:
        incident = incident + frame.lobes().apart.numpy().reshape(24, 40, 3)
    albedo = frame.struct(denoise.Guides).guide_diffuse.numpy().reshape(24, 40, 3)
    light = sum(frame.numpy(term) for term in ("environment", "emitters", "indirect"))
    np.testing.assert_allclose(albedo * incident + reflected, light, rtol=1e-3, atol=1e-4)
    assert (incident > 0).any() and ((reflected > 0).any() or name == "cornell_box")


def test_lobes_that_an_estimator_hands_over():
    view = still()
    only = {"environment": None, "emitters": None, "spp": 1, "denoise": NO_EDGES}
    frame = next(gi.render(scene(), view, gi.Pipeline(indirect=Apart(diffuse=2.0), **only)))
    assert frame.numpy("indirect").max() > 0.5
    assert np.allclose(frame.numpy("beauty"), frame.numpy("noisy"), rtol=1e-5, atol=1e-6)
    metal = gi.Scene([gi.Node("wall", [card(0.0, 9.0, checkered(1.0))])])
    frame = next(gi.render(metal, view, gi.Pipeline(indirect=Apart(glossy=1.0), **only)))
    inner = (slice(4, -4), slice(4, -4))
    spread = [frame.numpy(name)[inner].std() for name in ("noisy", "beauty")]
    assert 0 < spread[1] < spread[0]
    assert frame.numpy("beauty").mean() == pytest.approx(frame.numpy("noisy").mean(), rel=0.1)
    assert next(gi.render(scene(), view, gi.Pipeline(spp=1, denoise=None))).lobes() is None


@pytest.fixture(scope="module")
def moving():
    """By built-in scene: frame 7 at 512 spp, and frames 0 to 7 at 2 spp, of moving cameras."""
    found = {}
    for name in ("cornell_box", "atrium"):
        shot, path = gi.builtin_scene(name), gi.builtin_camera_path(name).at_resolution(64, 36)
        reference = next(gi.render(shot, path, gi.Pipeline(spp=512, camera_samples=64), [7], seed=9))
        frames = list(gi.render(shot, path, gi.Pipeline(spp=2, denoise="spatiotemporal"), range(8)))
        found[name] = reference.numpy("beauty"), frames
    return found


def light_error(frame, reference, buffer):
    return gi.metrics.rmse(frame.numpy(buffer), reference)


@pytest.mark.parametrize("name, share", [("cornell_box", 0.4), ("atrium", 0.8)])
def test_less_error_than_the_noise(moving, name, share):
    reference, frames = moving[name]
    noisy, denoised = (light_error(frames[-1], reference, buffer) for buffer in ("noisy", "beauty"))
    assert denoised < share * noisy, (denoised, noisy)
    terms = [frames[-1].numpy(term) for term in ("emission", "environment", "emitters", "indirect")]
    assert np.array_equal(((terms[0] + terms[1]) + terms[2]) + terms[3], frames[-1].numpy("noisy"))


@pytest.mark.parametrize("accumulate", [True, False])
@pytest.mark.parametrize("name", ["cornell_box", "atrium"])
def test_oidn(moving, name, accumulate):
    """Error of light, emission apart; a sequence of eight frames, or the last one for itself."""
    pytest.importorskip("pyoidn")
    reference, frames = moving[name]
    denoiser = Oidn(accumulate=accumulate, quality="high")
    state = denoiser.start(None, "cpu")
    for frame in frames:
        state = denoiser.apply(frame, state)
    dark = reference.max(axis=-1) < 2  # outlines of lamps are no light
    errors = [gi.metrics.rmse(frame.numpy(buffer)[dark][None], reference[dark][None]) for buffer in ("beauty", "noisy")]
    assert errors[0] < 0.5 * errors[1], errors


def test_oidn_keeps_the_light_of_a_dark_frame():
    """A wall at a radiance of 0.003 whose light is in one of 64 samples: the mean after eight frames."""
    pytest.importorskip("pyoidn")
    wall = gi.Scene([gi.Node("wall", [card(0.0, 9.0, gi.Material("grey", (0.5, 0.5, 0.5), specular=0.0))])])
    only = {"environment": None, "emitters": None, "spp": 1, "camera_samples": 1}
    camera = gi.CameraPath.still(gi.Camera.look_at((0, 0, 2), (0, 0, 0), hfov=60, resolution=(64, 48)))
    mean = {}
    for denoiser in (Oidn(), Oidn(accumulate=False, quality="high")):
        scheduler = gi.FrameScheduler(wall, camera, gi.Pipeline(indirect=Rare(), denoise=denoiser, **only))
        frames = [scheduler.frame(index) for index in range(8)]
        noisy = np.mean([frame.numpy("noisy").mean() for frame in frames])
        mean[denoiser.accumulate] = frames[-1].numpy("beauty").mean() / noisy
    assert mean[True] == pytest.approx(1.0, abs=0.02), mean
    assert abs(mean[False] - 1) > 2 * abs(mean[True] - 1), mean


@dataclass(frozen=True)
class Rare(gi.BsdfPaths):
    """Light that comes in to one of 64 pixels in a frame."""

    def trace(self, frame, state):
        """Fill the term."""
        rng = np.random.default_rng(frame.seed)
        values = 0.003 * 64 * (rng.random(len(frame["indirect"])) < 1 / 64)
        frame["indirect"].assign(np.repeat(values[:, None], 3, axis=1))


def test_oidn_as_part_of_a_pipeline():
    pytest.importorskip("pyoidn")
    frame = next(gi.render(scene(), still(), gi.Pipeline(spp=1, denoise="oidn")))
    assert "denoise" in frame.timings and frame.metadata["pipeline.denoise.quality"] == "fast"
    sky = frame.numpy("object_id") < 0
    assert np.array_equal(frame.numpy("beauty")[sky], frame.numpy("noisy")[sky]) or not sky.any()
    assert not np.array_equal(frame.numpy("beauty"), frame.numpy("noisy"))


def test_oidn_that_is_not_installed(monkeypatch):
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    with pytest.raises(OptionError, match=r"pip install 'warp-gi\[denoise\]'"):
        gi.FrameScheduler(scene(), still(), gi.Pipeline(denoise="oidn"))


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: gi.Pipeline(denoise="spatiotemprl"), "unknown denoiser .* did you mean 'spatiotemporal'"),
        (lambda: gi.Pipeline(denoise=gi.PowerLights()), "denoise must be a Denoiser"),
        (lambda: Oidn(quality="best"), "unknown quality 'best'"),
        (lambda: SpatioTemporal(frames=0), "frames must be a whole number from 1 to 1024, got 0"),
        (lambda: SpatioTemporal(glossy_frames=1.5), "glossy_frames must be a whole number"),
        (lambda: SpatioTemporal(levels=9), "levels must be a whole number from 0 to 8, got 9"),
        (lambda: SpatioTemporal(glossy_levels=-1), "glossy_levels must be a whole number from 0"),
        (lambda: SpatioTemporal(luminance=0.0), "luminance must be above 0"),
        (lambda: SpatioTemporal(plane_distance=0.0), "plane_distance must be above 0"),
        (lambda: SpatioTemporal(normal_power=float("nan")), "normal_power"),
        (lambda: SpatioTemporal(first_samples=0), "first_samples must be a whole number from 1"),
        (lambda: SpatioTemporal(edge_samples=65), "edge_samples must be a whole number from 0 to 64, got 65"),
        (lambda: SpatioTemporal(blend=0.0), "blend must be a weight above 0 and at most 1, got 0"),
        (lambda: SpatioTemporal(lag=-1.0), "lag must be 0 or a number of deviations above it, got -1"),
    ],
)
def test_bad_settings_are_one_line(make, words):
    with pytest.raises(OptionError, match=words) as caught:
        make()
    assert "\n" not in str(caught.value)


def test_files_and_flags(tmp_path):
    from warp_gi.cli import main as cli
    from warp_gi.cli.pipelines import pipeline_named

    assert pipeline_named("direct,denoise=SpatioTemporal").denoise == SpatioTemporal()
    assert pipeline_named("path,denoise=none").denoise is None
    command = ["render", "cornell_box", "--resolution", "24x16", "--spp", "2", "--frames", "0-1", "--quiet"]
    command += ["--denoise", "spatiotemporal", "--denoise.levels", "3", "-o", str(tmp_path / "a.####.exr")]
    assert cli.main(command) == 0
    first, second = (gi.read_frame(tmp_path / f"a.{i:04d}.exr") for i in (0, 1))
    assert second.metadata["pipeline.denoise.levels"] == 3
    assert second.numpy("noisy").std() > second.numpy("beauty").std() > 0
    (tmp_path / "a.0000.exr").unlink()
    assert cli.main([*command, "--resume"]) == 0  # all frames: the second goes by the first
    again = [gi.read_frame(tmp_path / f"a.{i:04d}.exr") for i in (0, 1)]
    for one, other in zip((first, second), again, strict=True):
        assert np.array_equal(one.numpy("beauty"), other.numpy("beauty"))


def test_coverage_is_of_the_samples_that_edges_take():
    """A card as bright as what it is laid over is not seen, but for what pictures before leave at its outline."""
    grey = gi.Material("grey", (0.8, 0.8, 0.8), specular=0.0)
    tilted = quad((-0.6, -0.45, 0), (1.2, 0.3, 0), (-0.3, 1.0, 0), grey, "card")
    shot = gi.Scene([gi.Node("card", [tilted])], environment=1.0)
    camera = gi.Camera.look_at((0, 0, 3), (0, 0, 0), hfov=40, resolution=(48, 36))
    for blend, bound in ((1.0, 1e-3), (0.25, 0.2)):
        settings = SpatioTemporal(blend=blend)
        pipeline = gi.Pipeline(spp=1, indirect=None, background=False, denoise=settings)
        for frame in gi.render(shot, gi.CameraPath.still(camera), pipeline, frames=range(3)):
            beauty, alpha = frame.numpy("beauty").mean(-1), frame.numpy("alpha")
        assert 0 < ((alpha > 0) & (alpha < 1)).mean() < 0.2
        np.testing.assert_allclose(beauty + (1 - alpha) * 0.8, 0.8, atol=bound)


def test_a_first_frame_is_filtered_more(monkeypatch):
    """Four samples on bumps and thin things: wider weights and more samples at edges lower its error."""
    shot, camera = gi.builtin_scene("atrium"), gi.builtin_camera_path("atrium").at_resolution(96, 54).camera(0)
    reference = next(gi.render(shot, camera, gi.Pipeline(spp=128, camera_samples=64))).numpy("beauty")
    dark = reference.max(axis=-1) < 2  # outlines of lamps are no light
    errors = []
    for factors in ((0.25, 2.0, 2), (1.0, 1.0, 1)):
        for name, factor in zip(("FIRST_NORMAL", "FIRST_LUMINANCE", "FIRST_EDGES"), factors, strict=True):
            monkeypatch.setattr(spatiotemporal, name, factor)
        pipeline = gi.Pipeline(spp=1, denoise=SpatioTemporal())
        beauty = next(gi.render(shot, camera, pipeline, seed=2)).numpy("beauty")
        errors.append(gi.metrics.rmse(beauty[dark][None], reference[dark][None]))
    assert errors[0] < 0.95 * errors[1], errors
