"""The sky: orientation, sampling against its pdf, energy, and what loading refuses."""

import math
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from statistics_tools import chi_squared

from warp_gi import launch
from warp_gi.alias import AliasTable
from warp_gi.errors import OptionError, SceneError
from warp_gi.kernels.alias import alias_choice, alias_position
from warp_gi.kernels.environment import (
    environment_arrival,
    environment_lookup,
    environment_radiance,
    environment_sample,
    lat_long_encode,
)
from warp_gi.kernels.types import AliasBucket
from warp_gi.kernels.types import Environment as EnvironmentData
from warp_gi.scene.environment import Environment, SunSky, as_environment

DEVICES = ["cpu", "cuda"] if wp.is_cuda_available() else ["cpu"]
wp.set_module_options({"enable_backward": False})


@wp.kernel
def sample_directions(
    first: wp.int32,
    env: EnvironmentData,
    numbers: wp.array(dtype=wp.vec3),
    directions: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    pdf: wp.array(dtype=wp.float32),
):
    i = first + wp.tid()
    s = environment_sample(env, numbers[i])
    arrival = environment_arrival(env, s)
    directions[i] = s.direction
    radiance[i] = arrival.radiance
    pdf[i] = arrival.pdf


@wp.kernel
def look_up(
    first: wp.int32,
    env: EnvironmentData,
    directions: wp.array(dtype=wp.vec3),
    radiance: wp.array(dtype=wp.vec3),
    alone: wp.array(dtype=wp.vec3),
    pdf: wp.array(dtype=wp.float32),
):
    i = first + wp.tid()
    looked_up = environment_lookup(env, directions[i])
    radiance[i] = looked_up.radiance
    alone[i] = environment_radiance(env, directions[i])
    pdf[i] = looked_up.pdf


@wp.kernel
def encode(first: wp.int32, directions: wp.array(dtype=wp.vec3), uvs: wp.array(dtype=wp.vec2)):
    uvs[first + wp.tid()] = lat_long_encode(directions[first + wp.tid()])


@wp.kernel
def choose(
    first: wp.int32,
    buckets: wp.array(dtype=AliasBucket),
    numbers: wp.array(dtype=wp.vec2),
    items: wp.array(dtype=wp.int32),
    remainders: wp.array(dtype=wp.float32),
    pdfs: wp.array(dtype=wp.float32),
):
    i = first + wp.tid()
    choice = alias_choice(buckets, buckets.shape[0], numbers[i][0], numbers[i][1])
    items[i] = choice.item
    remainders[i] = choice.remainder
    pdfs[i] = choice.pdf


@wp.kernel
def place(first: wp.int32, count: wp.int32, numbers: wp.array(dtype=wp.vec2), positions: wp.array(dtype=wp.float64)):
    i = first + wp.tid()
    positions[i] = alias_position(count, numbers[i][0], numbers[i][1])


def evaluate(env: Environment, directions: np.ndarray, device: str = "cpu") -> tuple[np.ndarray, np.ndarray]:
    points = wp.array(directions.astype(np.float32), dtype=wp.vec3, device=device)
    radiance, alone = (wp.zeros(len(directions), dtype=wp.vec3, device=device) for _ in range(2))
    pdf = wp.zeros(len(directions), dtype=wp.float32, device=device)
    launch.launch(look_up, len(directions), [env.data(device), points, radiance, alone, pdf], wp.get_device(device))
    assert np.array_equal(radiance.numpy(), alone.numpy())
    return radiance.numpy(), pdf.numpy()


def sample(
    env: Environment, count: int, device: str = "cpu", seed: int = 0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    numbers = np.random.default_rng(seed).random((count, 3), dtype=np.float32)
    outputs = [wp.zeros(count, dtype=t, device=device) for t in (wp.vec3, wp.vec3, wp.float32)]
    inputs = [env.data(device), wp.array(numbers, dtype=wp.vec3, device=device), *outputs]
    launch.launch(sample_directions, count, inputs, wp.get_device(device))
    return tuple(x.numpy() for x in outputs)


def random_directions(count: int, seed: int = 1) -> np.ndarray:
    d = np.random.default_rng(seed).standard_normal((count, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


def spotted_map(height: int) -> np.ndarray:
    """Zero over a third of the sphere, noise elsewhere, one texel far brighter, bright spots at both poles."""
    pixels = np.random.default_rng(3).random((height, 2 * height, 3)).astype(np.float32)
    pixels[:, : 2 * height // 3] = 0
    pixels[height // 3, height] = 50.0
    pixels[0, 2 * height - 3] = pixels[-1, 2 * height - 5] = 20.0
    return pixels


def black_map(height: int, *bright: tuple[int, int]) -> np.ndarray:
    """Black but for single bright texels."""
    pixels = np.zeros((height, 2 * height, 3), np.float32)
    for row, column in bright:
        pixels[row, column] = 3.0, 7.0, 1.0
    return pixels


def angles_of(env: Environment, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Polar angle and azimuth in [0, 2 pi) in the sky's own space, float64."""
    local = directions.astype(np.float64) @ env.world_from_environment
    theta = np.arctan2(np.hypot(local[:, 0], local[:, 2]), local[:, 1])
    return theta, np.arctan2(local[:, 0], -local[:, 2]) % (2 * math.pi)


def sphere_grid(env: Environment, parts: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """Midpoints and solid angles of parts x parts pieces of every patch between four nodes, world space.

    In latitude and longitude the pieces are equal, and begin at the first node. There the density is bilinear, so
    midpoints integrate it exactly, piece by piece.
    """
    height, width = env.pixels.shape[:2]
    d_theta, d_phi = math.pi / ((height - 1) * parts), 2 * math.pi / (width * parts)
    theta = (np.arange((height - 1) * parts) + 0.5) * d_theta
    phi = (0.5 * parts + np.arange(width * parts) + 0.5) * d_phi
    theta, phi = (g.ravel() for g in np.meshgrid(theta, phi, indexing="ij"))
    local = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1)
    return local @ env.world_from_environment.T, np.sin(theta) * d_theta * d_phi


def count_in_grid(env: Environment, directions: np.ndarray, parts: int) -> np.ndarray:
    """How many directions are in each piece of `sphere_grid`, [row of patches, part, column, part]."""
    height, width = env.pixels.shape[:2]
    theta, phi = angles_of(env, directions)
    row = np.minimum((theta / math.pi * (height - 1) * parts).astype(int), (height - 1) * parts - 1)
    column = np.floor((phi / (2 * math.pi) * width - 0.5) * parts).astype(int) % (width * parts)
    counts = np.bincount(row * width * parts + column, minlength=(height - 1) * width * parts**2)
    return counts.reshape(height - 1, parts, width, parts)


def expected_pdf(env: Environment, directions: np.ndarray) -> np.ndarray:
    """The density [1/sr] in float64: bilinear luminance, times the sine in the middle of a row over that here."""
    luminance = env.pixels.astype(np.float64) @ [0.2126, 0.7152, 0.0722]
    height, width = luminance.shape
    middles = np.sin((np.arange(height - 1) + 0.5) * math.pi / (height - 1))
    total = 0.0
    for i in range(height - 1):
        for j in range(width):
            corners = [luminance[i + k, (j + m) % width] for k in range(2) for m in range(2)]
            total += np.mean(corners) * middles[i] * (math.pi / (height - 1)) * (2 * math.pi / width)
    theta, phi = angles_of(env, directions)
    x, y = phi / (2 * math.pi) * width - 0.5, theta / math.pi * (height - 1)
    i, j = np.minimum(y.astype(int), height - 2), np.floor(x).astype(int)
    upper, lower = (
        luminance[i + k, j % width] * (1 - x + j) + luminance[i + k, (j + 1) % width] * (x - j) for k in range(2)
    )
    value = upper * (1 - y + i) + lower * (y - i)
    return value * middles[i] / (total * np.sin(theta))


@pytest.mark.parametrize("device", DEVICES)
def test_coordinates_are_latitude_and_longitude(device):
    axes = np.array([[0, 0, -1], [1, 0, 0], [0, 0, 1], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [3e-4, 1, 0], [0, -1, 2e-4]])
    given = np.concatenate([axes / np.linalg.norm(axes, axis=1)[:, None], random_directions(10000)]).astype(np.float32)
    directions = wp.array(given, dtype=wp.vec3, device=device)
    uvs = wp.zeros(len(given), dtype=wp.vec2, device=device)
    launch.launch(encode, len(given), [directions, uvs], wp.get_device(device))
    phi, theta = (uvs.numpy().astype(np.float64) * [2 * math.pi, math.pi]).T
    back = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=1)
    assert np.abs(back - given).max() < 2e-6
    assert np.allclose(uvs.numpy()[:6], [[0, 0.5], [0.25, 0.5], [0.5, 0.5], [0.75, 0.5], [0, 0], [0, 1]], atol=1e-6)


@pytest.mark.parametrize("count", [1, 2, 7, 4000])
def test_alias_table_is_sampled_as_its_pdf_says(count):
    rng = np.random.default_rng(count)
    weights = rng.random(count) ** 4
    weights[rng.random(count) < 0.2] = 0
    weights[0] = 0.5 * count  # one item dominates
    table = AliasTable.build(weights)
    assert np.allclose(table.pdf, weights / weights.sum(), atol=1e-6 / count)
    numbers = rng.random((200_000, 2), dtype=np.float32)
    items = wp.zeros(len(numbers), dtype=wp.int32, device="cpu")
    remainders = wp.zeros(len(numbers), dtype=wp.float32, device="cpu")
    pdfs = wp.zeros(len(numbers), dtype=wp.float32, device="cpu")
    cpu = wp.get_device("cpu")
    inputs = [table.on(cpu), wp.array(numbers, dtype=wp.vec2, device="cpu"), items, remainders, pdfs]
    launch.launch(choose, len(numbers), inputs, cpu)
    chosen, rest = items.numpy(), remainders.numpy()
    counts = np.bincount(chosen, minlength=count)
    assert (counts[weights == 0] == 0).all()
    assert chi_squared(counts, len(numbers) * table.pdf.astype(np.float64)) > 1e-4
    assert np.array_equal(pdfs.numpy(), table.pdf[chosen])
    assert rest.min() >= 0 and rest.max() < 1
    assert chi_squared(np.histogram(rest, 50, (0, 1))[0], np.full(50, len(numbers) / 50)) > 1e-4


def test_alias_table_of_a_large_sky_reaches_every_bucket():
    count = 8192 * 4096  # more than float32 tells apart
    numbers = np.random.default_rng(3).random((100_000, 2), dtype=np.float32)
    positions = wp.zeros(len(numbers), dtype=wp.float64, device="cpu")
    inputs = [count, wp.array(numbers, dtype=wp.vec2, device="cpu"), positions]
    launch.launch(place, len(numbers), inputs, wp.get_device("cpu"))
    buckets = positions.numpy().astype(np.int64)
    assert buckets.min() >= 0 and buckets.max() < count
    assert chi_squared(np.bincount(buckets % 8, minlength=8), np.full(8, len(numbers) / 8)) > 1e-4
    assert chi_squared(np.histogram(positions.numpy() % 1, 50, (0, 1))[0], np.full(50, len(numbers) / 50)) > 1e-4


def test_alias_table_refuses_bad_weights():
    for weights in ([], [1.0, -1.0], [1.0, math.nan]):
        with pytest.raises(ValueError, match="alias table weights"):
            AliasTable.build(np.array(weights))
    assert np.allclose(AliasTable.build(np.zeros(5)).pdf, 0.2)


MAPS = {
    "spotted": lambda: spotted_map(12),
    "lowest": lambda: spotted_map(2),
    "a texel at the seam": lambda: black_map(9, (4, 17)),
    "another at the seam": lambda: black_map(9, (4, 0)),
    "a texel at each pole": lambda: black_map(8, (0, 5), (7, 0)),
    "grey": lambda: np.full((6, 12, 3), 0.5, np.float32),
}


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", MAPS)
def test_map_samples_follow_the_pdf_inside_every_patch(name, device):
    env = Environment(pixels=MAPS[name](), rotation=37.0)
    parts, count = 4, 1_500_000
    counts = count_in_grid(env, sample(env, count, device)[0], parts)
    points, areas = sphere_grid(env, parts)
    _, pdf = evaluate(env, points, device)
    expected = (pdf.astype(np.float64) * areas * count).reshape(counts.shape)
    assert np.isclose(expected.sum(), count, rtol=1e-5)
    # all of them; rows at the poles; patches at the seam. Black patches get none
    for part in (np.s_[:], np.s_[[0, -1]], np.s_[:, :, [0, -1]]):
        assert chi_squared(counts[part], expected[part]) > 1e-4
    black = expected == 0
    assert black.any() == (name not in ("grey", "lowest"))
    assert not counts[black].any()


@pytest.mark.parametrize("device", DEVICES)
def test_constant_sky_is_sampled_uniformly(device):
    env = Environment.constant((1.0, 2.0, 3.0))
    directions, radiance, pdf = sample(env, 200_000, device)
    assert np.allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-6)
    cells = np.histogram2d(directions[:, 1], np.arctan2(directions[:, 0], directions[:, 2]), 16)[0]
    assert chi_squared(cells, np.full((16, 16), len(directions) / 256)) > 1e-4
    assert np.allclose(pdf, 1 / (4 * math.pi)) and np.allclose(radiance, [1, 2, 3])
    looked_up = evaluate(env, directions, device)
    assert np.array_equal(looked_up[0], radiance) and np.array_equal(looked_up[1], pdf)


def test_a_black_sky_yields_nothing():
    for env in (as_environment(None), Environment.constant(0.0), Environment(pixels=np.zeros((4, 8, 3)))):
        _, radiance, pdf = sample(env, 100)
        assert env.is_black and not pdf.any() and not radiance.any()
        looked_up = evaluate(env, random_directions(100))
        assert not looked_up[0].any() and not looked_up[1].any()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("height", [2, 3, 12, 64])
@pytest.mark.parametrize("rotation, scale", [(0.0, 1.0), (-20.0, 2.0), (200.0, 0.01)])
def test_pdf_integrates_to_one_and_covers_all_radiance(rotation, scale, height, device):
    env = Environment(pixels=spotted_map(height), rotation=rotation, scale=scale)
    points, areas = sphere_grid(env)
    radiance, pdf = evaluate(env, points, device)
    assert abs(pdf.astype(np.float64) @ areas - 1) < 1e-5
    assert np.array_equal(pdf > 0, radiance.max(1) > 0)
    assert np.allclose(radiance.T.astype(np.float64) @ areas / (4 * math.pi), env.mean_radiance, rtol=0.01)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("height", [2, 3, 12, 64])
def test_pdf_is_that_of_the_interpolated_luminance(height, device):
    env = Environment(pixels=spotted_map(height), rotation=-20.0, scale=3.0)
    step = math.pi / (height - 1)
    theta = np.repeat([1e-3 * step, 0.3 * step, math.pi - 0.3 * step, math.pi - 1e-3 * step], 500)
    phi = np.tile(np.linspace(0, 2 * math.pi, 500), 4)
    poles = np.stack([np.sin(theta) * np.sin(phi), np.cos(theta), -np.sin(theta) * np.cos(phi)], axis=-1)
    directions = np.concatenate([random_directions(20_000), poles]).astype(np.float32)
    _, pdf = evaluate(env, directions, device)
    expected = expected_pdf(env, directions)
    # float32 tells places in the map apart by 1e-7 of its side, over which the luminance changes by that much
    sine = np.sin(angles_of(env, directions)[0])
    steepest = height * expected_pdf(env, sphere_grid(env, 2)[0]).max()
    assert np.all(np.abs(pdf - expected) < 1e-5 * expected + 1e-6 * steepest / sine)
    assert (expected > 0).mean() > 0.5


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", MAPS)
def test_samples_say_what_a_look_up_says(name, device):
    env = Environment(pixels=MAPS[name](), rotation=100.0, scale=2.5)
    directions, radiance, pdf = sample(env, 200_000, device)
    assert np.abs(np.linalg.norm(directions.astype(np.float64), axis=1) - 1).max() < 1e-6
    looked_up, again = evaluate(env, directions, device)
    assert pdf.min() > 0
    assert np.allclose(radiance, looked_up, rtol=1e-4, atol=1e-5 * radiance.max())
    sine = np.sin(angles_of(env, directions)[0])
    assert np.allclose(pdf * sine, again * sine, rtol=1e-4, atol=1e-5 * (pdf * sine).max())


@pytest.mark.parametrize("height", [2, 12, 64])
def test_weights_vary_by_sines_only(height):
    """Luminance over pdf is its integral, times the sine here over that in the middle of the row."""
    env = Environment(pixels=spotted_map(height), rotation=10.0)
    directions, radiance, pdf = sample(env, 200_000)
    weights = radiance.astype(np.float64) @ [0.2126, 0.7152, 0.0722] / pdf
    theta, _ = angles_of(env, directions)
    row = theta / math.pi * (height - 1)
    middle = np.sin((np.floor(row) + 0.5) * math.pi / (height - 1))
    inside = np.abs(row - np.round(row)) > 1e-4  # float32 may tell them to be in the other row
    ratio = (weights * middle / np.sin(theta))[inside]
    assert inside.mean() > 0.99 and np.ptp(ratio) < 2e-5 * ratio.mean()
    assert np.isclose(ratio.mean(), env.mean_radiance @ [0.2126, 0.7152, 0.0722] * 4 * math.pi, rtol=2 / height)


@pytest.mark.parametrize("elevation", [8.0, 30.0, 75.0])
def test_the_sun_s_irradiance_varies_as_much_as_a_choice_must(elevation):
    """Samples that go to the sun all bring nearly the same, so the variance is that of how many do: binomial."""
    sky = SunSky(elevation=elevation, azimuth=123.0, height=256)
    env = as_environment(sky)
    directions, radiance, pdf = sample(env, 200_000)
    near = directions @ sky.direction > math.cos(math.radians(2.0))
    sun = near & (radiance[:, 1] > 20 * replace(sky, sun_intensity=0.0).pixels()[:, :, 1].max())
    share = sun.mean()
    assert 0.3 < share < 0.95
    irradiance = np.where(sun, radiance[:, 1] / pdf * directions[:, 1], 0).astype(np.float64)
    assert np.isclose(irradiance.mean(), sky.sun_irradiance[1] * sky.direction[1], rtol=0.05)
    relative = irradiance.var() / irradiance.mean() ** 2
    assert 1 - 1e-6 < relative / ((1 - share) / share) < 1.01


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("kind", ["map", "sun"])
def test_sampled_flux_equals_the_integral(kind, device):
    sky = SunSky(elevation=30.0, azimuth=77.0, height=128) if kind == "sun" else Environment(pixels=spotted_map(32))
    env = as_environment(sky).rotated(15.0)
    _, radiance, pdf = sample(env, 400_000, device)
    estimate = radiance / pdf[:, None] / (4 * math.pi)
    error = estimate.std(0, dtype=np.float64) / math.sqrt(len(estimate))
    assert np.all(np.abs(estimate.mean(0, dtype=np.float64) - env.mean_radiance) < 4.5 * error)
    assert np.all(error < 0.002 * env.mean_radiance)  # a uniform choice would be off by far more


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("height", [2, 9, 48])
def test_samples_over_their_pdf_integrate_as_quadrature_does(height, device):
    """One over the pdf has the mean 4 pi where no part is black; cosine lobes have their irradiance."""
    rng = np.random.default_rng(height)
    pixels = (0.2 + rng.random((height, 2 * height, 3))).astype(np.float32)
    pixels[height // 2, height] = 40.0
    env = Environment(pixels=pixels, rotation=63.0)
    directions, radiance, pdf = sample(env, 400_000, device)
    axes = random_directions(8, seed=height)
    points, areas = sphere_grid(env, max(2, 96 // height))
    luminance = np.array([0.2126, 0.7152, 0.0722])
    values = np.maximum(directions.astype(np.float64) @ axes.T, 0) * (radiance @ luminance)[:, None]
    values = np.concatenate([np.ones((len(pdf), 1)), values], axis=1) / pdf[:, None].astype(np.float64)
    lobes = np.maximum(points @ axes.T, 0) * (evaluate(env, points, device)[0] @ luminance)[:, None]
    expected = np.concatenate([[4 * math.pi], areas @ lobes])
    error = values.std(0) / math.sqrt(len(pdf))
    assert np.all(np.abs(values.mean(0) - expected) < 4.5 * error + 3e-4 * expected)
    assert np.all(error < 0.01 * expected)


def test_rotation_turns_counter_clockwise_seen_from_above():
    pixels = np.zeros((16, 32, 3), np.float32)
    pixels[6:10, [31, 0]] = 1.0  # around -z
    env = Environment(pixels=pixels)
    axes = {"-z": [0, 0, -1], "-x": [-1, 0, 0], "+z": [0, 0, 1], "+x": [1, 0, 0]}
    for turn, expected in ((0, "-z"), (90, "-x"), (180, "+z"), (270, "+x")):
        radiance, _ = evaluate(env.rotated(turn), np.array(list(axes.values())))
        assert [name for name, r in zip(axes, radiance, strict=True) if r[0] > 0.9] == [expected]
    d = random_directions(1000)
    turned = env.rotated(33.0)
    assert np.allclose(evaluate(turned, d)[0], evaluate(env, d @ turned.world_from_environment)[0], atol=1e-5)


@pytest.mark.parametrize("rotation", [0.0, 75.0])
def test_radiance_equals_mitsuba(rotation):
    mi = pytest.importorskip("mitsuba", reason="mitsuba is not installed (pip install mitsuba)")
    mi.set_variant("scalar_rgb")
    pixels = np.random.default_rng(5).random((9, 18, 3)).astype(np.float32)
    to_world = mi.ScalarTransform4f().rotate([0, 1, 0], rotation)
    plugin = {"type": "envmap", "bitmap": mi.Bitmap(pixels), "to_world": to_world, "scale": 1.5}
    emitter = mi.load_dict({"type": "scene", "sky": plugin, "shape": {"type": "sphere"}}).environment()
    directions = random_directions(300)
    expected = []
    for d in directions:
        interaction = mi.SurfaceInteraction3f()
        interaction.wi = -mi.Vector3f(*d.tolist())
        expected.append(np.array(emitter.eval(interaction)))
    radiance, _ = evaluate(Environment(pixels=pixels, rotation=rotation, scale=1.5), directions)
    assert np.allclose(radiance, expected, atol=2e-5)


def test_hash_follows_what_is_seen():
    env = Environment(pixels=spotted_map(4))
    others = [
        env.rotated(1),
        Environment(pixels=env.pixels, scale=2),
        Environment(pixels=env.pixels * 2),
        Environment(),
    ]
    others += [Environment.constant(1.0), Environment.constant((1, 1, 2))]
    assert len({e.content_hash for e in [env, *others]}) == 7
    assert env.content_hash == Environment(pixels=spotted_map(4), rotation=360.0).content_hash
    assert env.rotated(90).data("cpu").texels.ptr == env.data("cpu").texels.ptr  # one copy serves all rotations


def write_image(path, pixels):
    oiio = pytest.importorskip("OpenImageIO")
    output = oiio.ImageOutput.create(str(path))
    height, width, channels = pixels.shape
    output.open(str(path), oiio.ImageSpec(width, height, channels, oiio.FLOAT))
    output.write_image(pixels)
    output.close()


@pytest.mark.parametrize("suffix", ["exr", "hdr"])
def test_load_reads_what_was_written(tmp_path, suffix):
    pixels = spotted_map(8)
    write_image(tmp_path / f"sky.{suffix}", pixels)
    env = as_environment(str(tmp_path / f"sky.{suffix}"))
    assert np.allclose(env.pixels, pixels, rtol=0.01, atol=0.02 if suffix == "hdr" else 1e-6)


def test_load_refuses_what_cannot_be_a_sky(tmp_path):
    good = spotted_map(32)
    nan, wide = good.copy(), np.ones((8, 20, 3), np.float32)
    nan[3, 4, 1] = math.nan
    for name, pixels in (("good", good), ("nan", nan), ("wide", wide)):
        write_image(tmp_path / f"{name}.exr", pixels)
    (tmp_path / "cut.exr").write_bytes((tmp_path / "good.exr").read_bytes()[:4000])
    (tmp_path / "empty.exr").write_bytes(b"")
    (tmp_path / "text.exr").write_text("no image")
    for name, message in (
        ("missing", "no such file"),
        ("cut", "damaged or cut short"),
        ("empty", "empty"),
        ("text", "not an image"),
        ("nan", "1 pixels are NaN"),
        ("wide", "twice as wide as high.*20x8"),
    ):
        with pytest.raises(SceneError, match=message) as caught:
            Environment.load(tmp_path / f"{name}.exr")
        assert "\n" not in str(caught.value) and f"{name}.exr" in str(caught.value)


def test_negative_pixels_become_zero_with_a_warning(tmp_path):
    pixels = spotted_map(4)
    pixels[1, 1] = -0.25
    write_image(tmp_path / "ringing.exr", pixels)
    with pytest.warns(UserWarning, match="1 pixels are negative"):
        env = Environment.load(tmp_path / "ringing.exr")
    assert np.array_equal(env.pixels, np.maximum(pixels, 0))


@pytest.mark.parametrize(
    "make",
    [
        lambda: Environment.constant((1, 2)),
        lambda: Environment.constant((1, -1, 0)),
        lambda: Environment.constant((1, math.nan, 0)),
        lambda: as_environment(object()),
        lambda: as_environment(np.ones((4, 4, 3))),
        lambda: Environment(pixels=np.ones((4, 8, 3)), color=(1, 1, 1)),
        lambda: Environment(pixels=np.ones((0, 0, 3))),
        lambda: Environment(pixels=-np.ones((4, 8, 3))),
        lambda: Environment(pixels=np.ones((4, 8))),
        lambda: Environment(scale=-1.0),
        lambda: Environment(rotation=math.inf),
    ],
)
def test_bad_settings_are_one_line_errors(make):
    with pytest.raises(SceneError) as caught:
        make()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("elevation", [2.0, 30.0, 90.0])
def test_the_map_holds_all_of_the_sun_in_its_place(elevation):
    sky = SunSky(elevation=elevation, azimuth=123.0, height=256)
    sun = sky.pixels() - replace(sky, sun_intensity=0.0).pixels()
    sun[128:] = 0  # the ground is lit by the sun as well
    env = Environment(pixels=np.maximum(sun, 0))
    assert np.allclose(env.mean_radiance * 4 * math.pi, sky.sun_irradiance, rtol=1e-3)
    points, areas = sphere_grid(env, 3)
    radiance, _ = evaluate(env, points)
    centre = (radiance[:, 1] * areas) @ points
    assert np.linalg.norm(centre / np.linalg.norm(centre) - sky.direction) < math.radians(0.1)


def test_the_sky_is_physically_plausible():
    sky = SunSky(elevation=60.0, turbidity=2.5, intensity=1.0)
    illuminance = sky.sun_irradiance @ [0.2126, 0.7152, 0.0722] * 179
    assert 80_000 < illuminance < 120_000  # lx, a clear day
    low = SunSky(elevation=5.0).sun_irradiance
    assert low[0] > 2 * low[2]  # red at dusk
    pixels = SunSky(sun_intensity=0).pixels()
    assert pixels.min() >= 0 and np.isfinite(pixels).all()
    assert pixels[0, 0, 2] > 1.5 * pixels[0, 0, 0]  # blue zenith
    assert np.allclose(pixels, pixels[:, ::-1], rtol=1e-4)  # the sun at azimuth 0 is on the plane of symmetry


def test_sun_sky_settings():
    sky = SunSky.towards((1.0, 1.0, 0.0), turbidity=4.0)
    assert sky.azimuth == pytest.approx(90) and sky.elevation == pytest.approx(45) and sky.turbidity == 4.0
    assert np.allclose(sky.direction, [math.sqrt(0.5), math.sqrt(0.5), 0])
    for settings in ({"elevation": -7.0}, {"turbidity": 50.0}, {"height": 3}, {"ground_albedo": (2, 0, 0)}):
        with pytest.raises(OptionError, match=next(iter(settings))):
            SunSky(**settings)
    with pytest.raises(OptionError, match="elevation must be between -6"):
        SunSky.towards((0, -1, 0))
    with pytest.raises(OptionError, match="must not be zero"):
        SunSky.towards((0, 0, 0))
