"""Suns of a sky and lights without size, apart from other light: exact sums, sharp shadows, skies that turn."""

import numpy as np
import pytest
import warp as wp
from scene_tools import quad
from statistics_tools import mean_and_variance, z_test
from truth_tools import closed_box, ground, scene_of, unit

import warp_gi as gi
from warp_gi import launch
from warp_gi.denoise import SpatioTemporal
from warp_gi.kernels import denoise, denoise_apart
from warp_gi.scene.apart import MOST_LIGHTS, apart_lights_of
from warp_gi.scene.sky_map import WIDEST

CPU = wp.get_device("cpu")
GREY = gi.Material("grey", (0.6, 0.5, 0.4), specular=0.0)
HEIGHT = 256
NO_FILTER = {"levels": 0, "glossy_levels": 0, "edge_samples": 0, "first_samples": 1}


def sunny_pixels():
    """A sky that is 0.5 to 1.5, with a sun across the edge of the map and another one on the other side."""
    pixels = np.random.default_rng(1).uniform(0.5, 1.5, (HEIGHT, 2 * HEIGHT, 3)).astype(np.float32)
    pixels[60, [-1, 0]] = (6e4, 5e4, 3e4)
    pixels[90, 300] = (2e4, 3e4, 4e4)
    return pixels


def bilinear(pixels, v, u):
    """Radiance of a map at rows v and columns u, float64 [n, 3]."""
    row = np.clip(v.astype(int), 0, len(pixels) - 2)
    left = np.floor(u).astype(int)
    t, s = (v - row)[:, None], (u - left)[:, None]
    width, pixels = pixels.shape[1], pixels.astype(float)
    upper = pixels[row, left % width] * (1 - s) + pixels[row, (left + 1) % width] * s
    lower = pixels[row + 1, left % width] * (1 - s) + pixels[row + 1, (left + 1) % width] * s
    return upper * (1 - t) + lower * t


def irradiance(pixels, rows, columns, count, visible):
    """Integral of radiance times cosine over a part of a map, of what is visible, at an upward point, float64 [3]."""
    v, u = np.arange(*rows, 1 / count) + 0.5 / count, np.arange(*columns, 1 / count) + 0.5 / count
    v, u = (grid.ravel() for grid in np.meshgrid(v, u, indexing="ij"))
    theta, phi = v * np.pi / (HEIGHT - 1), (u + 0.5) * np.pi / HEIGHT
    d = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], -1)
    weight = np.maximum(d[:, 1], 0) * np.sin(theta) * visible(d) * np.pi / (HEIGHT - 1) * np.pi / HEIGHT / count**2
    return weight @ bilinear(pixels, v, u)


def under_a_card(d):
    """Whether a direction from the origin misses a card one metre above, whose edge halves the first sun."""
    x, z = d[:, 0] / np.maximum(d[:, 1], 1e-9), d[:, 2] / np.maximum(d[:, 1], 1e-9)
    return ~((x > 0) & (x < 2) & (z > -2) & (z < -0.2) & (d[:, 1] > 0))


def half_shaded(material):
    card = quad((0, 1, -0.2), (2, 0, 0), (0, 0, -1.8), GREY, "card")
    sky = gi.Environment(pixels=sunny_pixels())
    return scene_of(ground(material), card, environment=sky)


def at_the_origin(towards=(-0.5, 1.0, 0.6)):
    return gi.Camera.look_at(2.0 * unit(towards), (0, 0, 0), up=(0.1, 0.2, 0.97), hfov=0.02, resolution=(8, 8))


def pipeline(spp, **settings):
    return gi.Pipeline(spp=spp, camera_samples=1, indirect=None, denoise=SpatioTemporal(**NO_FILTER | settings))


def frames_of(shot, camera, settings, seeds=range(12)):
    return [next(gi.render(shot, camera, settings, seed=seed)) for seed in seeds]


def means(frames, value):
    return mean_and_variance(np.array([value(frame) for frame in frames]))


def test_what_is_apart_and_the_rest_are_the_sky():
    sky = gi.Environment(pixels=sunny_pixels(), rotation=40.0, scale=2.0)
    tables, rest = sky.small_suns(CPU)
    assert len(tables.parts.nodes) == 2 and rest.rotation == 40.0 and rest.scale == 2.0
    held = np.zeros(sky.pixels.shape[:2], bool)
    for nodes in tables.parts.nodes:
        held.ravel()[nodes] = True
    assert held.sum() == 3
    assert np.array_equal(rest.pixels[~held], sky.pixels[~held]) and (rest.pixels[held] < 0.01 * sky.pixels[held]).all()
    turned = sky.rotated(33.0).small_suns(CPU)
    assert turned[0] is tables and turned[1]._map is rest._map  # nothing is made anew
    assert turned[1].data(CPU).alias.ptr == rest.data(CPU).alias.ptr
    sums = tables.sums.numpy()
    assert sums[:2] == pytest.approx([0.5, 1.0], rel=1e-4) and sums[2] == 1.0


def test_what_is_not_apart():
    even = np.ones((HEIGHT, 2 * HEIGHT, 3), np.float32)
    wide, faint, many = even.copy(), even.copy(), even.copy()
    wide[60:66, 100:106] = 1e4
    faint[60, 100] = 200.0
    for k in range(6):
        many[80, 60 * k + 20] = 1e4 * (k + 1)
    assert gi.Environment(pixels=even).small_suns(CPU) is None
    assert gi.Environment(pixels=wide).small_suns(CPU) is None  # its shadows are soft
    assert gi.Environment(pixels=faint).small_suns(CPU) is None  # brighter by far, but less than 2 % of the light
    assert gi.Environment(pixels=even, scale=0.0).small_suns(CPU) is None
    tables, rest = gi.Environment(pixels=many).small_suns(CPU)
    assert len(tables.parts.nodes) == 4 and rest.pixels[80, 20, 0] == 1e4  # a ray each; the faintest stay
    assert np.arccos(tables.parts.cos_discs).max() < WIDEST
    lamp = gi.PunctualLight("point", (1, 1, 1), position=(0, 1, 0))
    for emission, count, apart in ((0, 0, 0), (0, MOST_LIGHTS, MOST_LIGHTS), (0, MOST_LIGHTS + 1, 0), (1, 1, 0)):
        lights = apart_lights_of(scene_of(*closed_box(0.5, emission), lights=[lamp] * count), CPU)
        assert (0 if lights is None else lights.data.light_count) == apart


def test_sun_and_sky_are_the_integrals():
    """A Lambert floor under a card that hides half of a sun: both parts against sums in float64, and their share."""
    shot, camera = half_shaded(GREY), at_the_origin()
    pixels, rest = shot.environment.pixels, shot.environment.small_suns(CPU)[1].pixels
    suns = sum(
        irradiance(pixels.astype(float) - rest, (row - 1, row + 1), columns, 200, under_a_card)
        for row, columns in ((60, (-2, 2)), (90, (299, 301)))
    )
    others = irradiance(rest, (0, HEIGHT // 2), (0, 2 * HEIGHT), 3, under_a_card)
    frames = frames_of(shot, camera, pipeline(64))
    assert frames[0].lobes().apart is not None
    mean, variance = means(frames, lambda frame: frame.lobes().apart.numpy().mean(axis=0))
    assert z_test(mean, variance, suns / np.pi, 0.0, dof_a=11).passed, mean / (suns / np.pi)
    assert np.sqrt(variance).max() < 0.01 * mean.min()
    mean, variance = means(frames, lambda frame: frame.numpy("environment").mean(axis=(0, 1)))
    whole = np.array(GREY.base_color) * (suns + others) / np.pi
    assert z_test(mean, variance, whole, (2e-4 * whole) ** 2, dof_a=11).passed, mean / whole
    mean, variance = means(frames, lambda frame: frame.lobes().diffuse.numpy().mean(axis=0))
    assert z_test(mean, variance, others / np.pi, (2e-4 * others) ** 2, dof_a=11).passed, mean / (others / np.pi)


THETA = 60 * np.pi / (HEIGHT - 1)


@pytest.mark.parametrize(
    ("towards", "roughness"),
    [((0.004, np.cos(THETA), np.sin(THETA)), 0.05), ((-0.5, 1.0, 0.6), 0.25)],
    ids=["in the mirror", "beside it"],
)
def test_glossy_light_of_suns_is_that_of_paths(towards, roughness):
    """Half a sun in a coat whose lobe meets it, by light samples and by directions; and noise, lobes and moments."""
    glossy = gi.Material("glossy", (0.6, 0.3, 0.2), roughness=roughness, specular=1.0)
    shot, camera = half_shaded(glossy), at_the_origin(towards)
    frames = frames_of(shot, camera, pipeline(128))
    plain = frames_of(shot, camera, gi.Pipeline(spp=128, camera_samples=1, indirect=None), range(100, 112))
    light = lambda frame: frame.numpy("environment").mean(axis=(0, 1))  # noqa: E731
    ours, theirs = means(frames, light), means(plain, light)
    assert z_test(*ours, *theirs, dof_a=11, dof_b=11).passed, ours[0] / theirs[0]
    for frame in frames[:2]:
        lobes, albedo = frame.lobes(), frame.struct(denoise.Guides).guide_diffuse.numpy()
        parts = albedo * (lobes.diffuse.numpy() + lobes.apart.numpy()) + lobes.glossy.numpy()
        np.testing.assert_allclose(parts, frame["environment"].numpy(), rtol=1e-4)
        assert np.array_equal(frame.numpy("noisy"), frame.numpy("environment") + frame.numpy("emission"))
    told = means(frames, lambda frame: frame.numpy("variance").mean(axis=(0, 1)))[0]
    assert (ours[1] * 64 < 2 * told).all()  # of the mean of 64 pixels


def test_lights_without_size_are_exact():
    """Two lights over a Lambert floor: their formula in every pixel, from one sample."""
    lights = [
        gi.PunctualLight("point", (3.0, 2.0, 1.0), position=(0.5, 1.5, -0.5)),
        gi.PunctualLight("directional", (0.5, 0.6, 0.7), direction=(0.6, -0.8, 0.0)),
    ]
    shot, camera = scene_of(ground(GREY), lights=lights), at_the_origin()
    frame = frames_of(shot, camera, pipeline(1), [0])[0]
    away = np.array([0.5, 1.5, -0.5])
    square = away @ away
    exact = np.array([3.0, 2.0, 1.0]) * (1.5 / square**1.5) / np.pi + np.array([0.5, 0.6, 0.7]) * 0.8 / np.pi
    np.testing.assert_allclose(frame.lobes().apart.numpy(), np.tile(exact, (64, 1)), rtol=2e-3)
    wanted = np.array(GREY.base_color) * exact
    for name in ("emitters", "noisy", "beauty"):
        np.testing.assert_allclose(frame.numpy(name), np.tile(wanted, (8, 8, 1)), rtol=2e-3)


def test_scenes_without_such_light_are_as_before():
    """A furnace, and a sky without a sun: the same bits as without the setting, and no buffer."""
    even = gi.Environment(pixels=np.ones((16, 32, 3), np.float32))
    for shot in (scene_of(*closed_box(0.9, 0.1)), scene_of(ground(GREY), environment=even)):
        camera = gi.Camera.look_at((0, 0.5, 0), (0.3, 0, 0.2), hfov=60, resolution=(8, 8))
        frames = [frames_of(shot, camera, pipeline(4, apart_frames=count), [3])[0] for count in (0, 4)]
        assert frames[1].lobes().apart is None and frames[1].apart is None
        for name in ("environment", "emitters", "beauty"):
            np.testing.assert_array_equal(frames[0].numpy(name), frames[1].numpy(name))
    frame = frames_of(half_shaded(GREY), at_the_origin(), pipeline(4, apart_frames=0), [3])[0]
    assert frame.lobes().apart is None


# ---- the average ----

SIZE = (48, 32)


def shadow(sky=None, lights=()):
    """A fence of thin posts whose shadows fall on a floor."""
    posts = [quad((0.1 * k - 1, 0.0, 0.0), (0.05, 0, 0), (0, 0.5, 0), GREY, f"post{k}") for k in range(20)]
    return scene_of(ground(GREY), *posts, environment=sky, lights=lights)


def sunny_sky(height=HEIGHT):
    pixels = np.full((height, 2 * height, 3), 0.3, np.float32)
    pixels[height // 4, 10] = 2e4
    return gi.Environment(pixels=pixels)


def path(step=0.0, count=8):
    keys = [gi.CameraKey(float(t), (step * t, 2.0, 2.0), (step * t, 0, 0.2)) for t in (0, count)]
    return gi.CameraPath(tuple(keys), fps=1, resolution=SIZE)


def test_shadows_are_not_filtered_over_pixels():
    """Without noise in it, light is what the rays found: in the first frame and in those of a camera that moves."""
    sun = gi.PunctualLight("directional", (3.0, 3.0, 3.0), direction=(0.2, -1.0, 0.6))
    errors = {}
    for frames in (0, 4):
        settings = SpatioTemporal(edge_samples=0, blend=1.0, apart_frames=frames)
        one = gi.Pipeline(spp=1, indirect=None, denoise=settings)
        scheduler = gi.FrameScheduler(shadow(lights=[sun]), path(0.013), one)
        found = [scheduler.frame(index) for index in range(4)]
        assert np.ptp(found[0].numpy("noisy")[..., 1]) > 0.2
        errors[frames] = max(np.abs(one.numpy("beauty") - one.numpy("noisy")).max() for one in found)
    assert errors[4] < 1e-4 < 0.1 < errors[0], errors


def test_shadows_of_a_sun_are_sharp_and_right():
    """A camera that moves under a sun with a size, at one sample a pixel: less error than filtered, no light lost."""
    many = gi.Pipeline(spp=512, camera_samples=1, indirect=None)
    reference = next(gi.render(shadow(sunny_sky()), path(0.013), many, [7]))
    wanted = reference.numpy("beauty")
    errors, means = {}, {}
    for frames in (0, 4):
        settings = SpatioTemporal(edge_samples=0, blend=1.0, apart_frames=frames)
        one = gi.Pipeline(spp=1, camera_samples=1, indirect=None, denoise=settings)
        scheduler = gi.FrameScheduler(shadow(sunny_sky()), path(0.013), one)
        for index in range(8):
            beauty = scheduler.frame(index).numpy("beauty")
        errors[frames], means[frames] = gi.metrics.rmse(beauty, wanted), beauty.mean()
    assert errors[4] < 0.8 * errors[0], errors
    assert means[4] == pytest.approx(wanted.mean(), rel=0.01)


def test_the_first_frame_is_right():
    wanted = next(gi.render(shadow(sunny_sky()), path(), gi.Pipeline(spp=512, indirect=None))).numpy("beauty")
    scheduler = gi.FrameScheduler(shadow(sunny_sky()), path(), gi.Pipeline.preset("clean", indirect=None))
    frame = scheduler.frame(0)
    assert frame.numpy("beauty").mean() == pytest.approx(wanted.mean(), rel=0.015)
    state = scheduler.state("denoise")
    known = state.guides.guide_object.numpy() > 0
    assert set(state.apart.average.numpy()[known, 3]) == {4.0}  # four samples are worth four frames
    np.testing.assert_array_equal(state.apart.average.numpy()[known, :3], frame.lobes().apart.numpy()[known])


def test_a_sky_that_turns_is_followed_at_once():
    """By more than half of the sun's width a frame: no shadow of frames before is left, and no table is made anew."""
    sky = sunny_sky()
    one = gi.Pipeline(spp=1, indirect=None, denoise=SpatioTemporal(first_samples=1))
    for degrees, most in ((20.0, 1.0), (0.02, 4.0)):
        scheduler = gi.FrameScheduler(shadow(gi.TurningSky(sky, degrees=degrees)), path(), one)
        for index in range(6):
            frame = scheduler.frame(index)
        average, new = scheduler.state("denoise").apart.average.numpy(), frame.lobes().apart.numpy()
        known = average[:, 3] > 0
        assert known.sum() > 500 and set(average[known, 3]) == {most}
        assert np.array_equal(average[known, :3], new[known]) == (most == 1.0)
    assert sky._map.sun_tables(CPU) is sky.rotated(7.0).small_suns(CPU)[0]


def test_threads_do_not_change_a_bit():
    frames = []
    for threads in (1, 2):
        launch.set_threads(threads)
        frames.append(list(gi.render(shadow(sunny_sky()), path(0.05), pipeline(2), [0, 1, 2])))
    launch.set_threads(None)
    for one, other in zip(*frames, strict=True):
        for name in one.names:
            assert np.array_equal(one.numpy(name), other.numpy(name), equal_nan=True), name
        assert np.array_equal(one.lobes().apart.numpy(), other.lobes().apart.numpy())


def test_a_frame_from_an_old_state_is_the_same():
    """The state is all that there is: a scheduler that has gone on, and is given it again, repeats a frame's bits."""
    scheduler = gi.FrameScheduler(shadow(sunny_sky()), path(0.05), pipeline(1))
    scheduler.frame(0)
    before = dict(scheduler._states)
    first, fresh = scheduler.frame(1).numpy("beauty"), gi.FrameScheduler(shadow(sunny_sky()), path(0.05), pipeline(1))
    scheduler.frame(2)
    scheduler._states = before
    np.testing.assert_array_equal(scheduler.frame(1).numpy("beauty"), first)
    assert np.abs(fresh.frame(1).numpy("beauty") - first).max() > 0.01


W, H = 14, 10


def filled(struct, **arrays):
    """A kernel struct of arrays [height, width, ...]."""
    result = struct()
    for name, values in arrays.items():
        dtype = struct.vars[name].type.dtype
        values = np.ascontiguousarray(values.reshape(W * H, *values.shape[2:]))
        setattr(result, name, wp.array(values, dtype=dtype, device=CPU))
    return result


def inside(row, column):
    return 0 <= row < H and 0 <= column < W


def cubic(f):
    """Weights of Catmull-Rom at -1, 0, 1 and 2."""
    return 0.5 * np.array([-f + 2 * f**2 - f**3, 2 - 5 * f**2 + 3 * f**3, f + 4 * f**2 - 3 * f**3, f**3 - f**2])


def test_the_average_is_the_formula():
    rng = np.random.default_rng(2)
    y, x = np.mgrid[:H, :W].astype(np.float32)
    up = np.zeros((H, W, 3), np.float32) + np.float32([0, 0, 1])
    position = np.stack([0.01 * x, -0.01 * y, np.zeros_like(x)], -1)
    objects = (1 + (x > 9) + (x < 0.5) * (y < 4)).astype(np.int32)
    motion = np.where(x[..., None] < 5, np.float32([0.3, -0.4]), np.float32([-1.25, 0.5]))
    diffuse = rng.uniform(0.2, 0.8, (H, W, 3)).astype(np.float32)
    diffuse[5, 3] = 0.0
    guides = {
        "guide_distance": np.ones((H, W), np.float32),
        "guide_position": position,
        "guide_previous": position,
        "guide_motion": motion.astype(np.float32),
        "guide_normal": up,
        "guide_plane": up,
        "guide_object": objects,
        "guide_diffuse": diffuse,
    }
    noisy = rng.random((H, W, 3)).astype(np.float32)
    last = np.concatenate([3 * rng.random((H, W, 3)) - 1, rng.integers(0, 5, (H, W, 1))], -1).astype(np.float32)
    settings = denoise.DenoiseSettings()
    settings.width, settings.height, settings.footprint, settings.worth = W, H, 0.01, 1.0
    light = filled(denoise_apart.ApartLight, noisy=noisy, last=last, average=np.zeros_like(last))
    light.frames = 4.0
    other = filled(denoise.Filtered, diffuse=np.full((H, W, 4), 2.0, np.float32))
    both = filled(denoise.Guides, **guides)
    launch.launch(denoise_apart.average_apart, W * H, [settings, both, both, light, other], CPU)
    found, sharp, plain = light.average.numpy().reshape(H, W, 4), 0, 0
    for row, column in np.ndindex(H, W):
        if row == 5 and column == 3:  # black: nothing is known
            assert not found[row, column].any()
            continue
        px, py = column + float(motion[row, column, 0]), row + float(motion[row, column, 1])
        x0, y0 = int(np.floor(px)), int(np.floor(py))
        same = lambda i, j, own=objects[row, column]: inside(i, j) and objects[i, j] == own  # noqa: E731
        taps = [
            (i, j, (1 - abs(px - j)) * (1 - abs(py - i)))
            for i in (y0, y0 + 1)
            for j in (x0, x0 + 1)
            if same(i, j) and last[i, j, 3] > 0 and (1 - abs(px - j)) * (1 - abs(py - i)) > 0
        ]
        total = sum(w for *_, w in taps)
        new, length, value = noisy[row, column].astype(float), 1.0, np.zeros(4)
        if total >= 0.01:
            near = np.array([last[i, j] for i, j, _ in taps])
            if total > 0.999 and 0 < x0 < W - 2 and 0 < y0 < H - 2:
                across, down, sharp = cubic(px - x0), cubic(py - y0), sharp + 1
                block = last[y0 - 1 : y0 + 3, x0 - 1 : x0 + 3].astype(float)
                value = np.clip(np.einsum("i,j,ijc->c", down, across, block), near.min(0), near.max(0))
            else:
                value, plain = sum(w * last[i, j].astype(float) for i, j, w in taps) / total, plain + 1
            around = [noisy[i, j] for i in range(row - 1, row + 2) for j in range(column - 1, column + 2) if same(i, j)]
            limited = np.clip(value[:3], np.min(around, 0), np.max(around, 0))
            kept = min(value[3], 3.0)
            length, new = 1 + kept, (limited * kept + new) / (1 + kept)
        np.testing.assert_allclose(found[row, column], [*new, length], rtol=1e-4, atol=1e-5)
        summed = other.diffuse.numpy().reshape(H, W, 4)[row, column]
        np.testing.assert_allclose(summed, [*(2 + new), 2.0], rtol=1e-4)
    assert sharp > 20 and plain > 20
