"""Points on emissive triangles are sampled as their texture shines there, and the light stays what it is."""

import numpy as np
import pytest
import warp as wp
from emission_tools import floor, image, looks, panel, reflected, view

import warp_gi as gi
from warp_gi.kernels.emission_grids import emitter_point, emitter_point_density
from warp_gi.kernels.types import SceneData
from warp_gi.scene import emission_grids, emitters

REPEAT, CLAMP, MIRROR = ("repeat", "repeat"), ("clamp", "clamp"), ("mirror", "mirror")
COLORS = np.array([[1, 0, 0], [0, 1, 0], [1, 1, 1], [0.1, 0.2, 1]], np.float32)
TURNED = ((0.6, 0.8, 0.1), (-0.8, 0.6, 0.7))
CASES = {
    "texel": lambda: panel(image("texel"), wrap=CLAMP, emission=4096.0),
    "texel, nearest": lambda: panel(image("texel"), wrap=CLAMP, nearest=True, emission=4096.0),
    "checkered": lambda: panel(image("checkered")),
    "checkered, nearest, turned": lambda: panel(image("checkered", 16), nearest=True, transform=TURNED),
    "gradient": lambda: panel(image("gradient"), wrap=CLAMP),
    "tiles": lambda: panel(image("texel", 16), uv=3.3, wrap=REPEAT, emission=256.0),
    "mirrored": lambda: panel(image("sparse", 32), uv=2.7, wrap=MIRROR, emission=20.0),
    "second set": lambda: panel(image("sparse"), second_set=True, transform=TURNED, emission=100.0),
    "coloured": lambda: panel(image("sparse"), colors=COLORS, emission=100.0),
    "one by one": lambda: panel(image("checkered", 8)[:1, 4:5] + np.uint8(60)),
}
LIGHTS = {"hierarchy": gi.LightHierarchy(), "power": gi.PowerLights(), "even": gi.UniformLights()}


def grids_of(mesh):
    return gi.Scene([gi.Node("panel", [mesh])])._light_grids.get()


@pytest.mark.parametrize("lights", LIGHTS)
@pytest.mark.parametrize("case", CASES)
def test_light_is_that_of_a_quadrature(case, lights):
    mesh = CASES[case]()
    pipeline = gi.Pipeline.preset("direct", emitters=LIGHTS[lights], spp=64)
    pixels = view(mesh, pipeline).reshape(-1, 3)
    right = reflected(mesh)
    error = pixels.std(axis=0, ddof=1) / np.sqrt(len(pixels))
    assert (np.abs(pixels.mean(axis=0) - right) < 4 * error + 3e-4 * right).all(), (pixels.mean(axis=0), right, error)
    assert (error < (0.02 if lights != "even" else 0.05) * right).all()


def test_sparse_lights_in_a_large_texture():
    # more texels than cells: what is sampled is not lost where a cell has one bright texel in it
    mesh = panel(image("sparse", 1300), wrap=CLAMP, nearest=True, emission=40000.0)
    assert grids_of(mesh).table["side"].max() * 4 < 1300
    pixels = view(mesh, gi.Pipeline.preset("direct", spp=64)).reshape(-1, 3)
    right = reflected(mesh, 1300)
    error = pixels.std(axis=0, ddof=1) / np.sqrt(len(pixels))
    assert (np.abs(pixels.mean(axis=0) - right) < 4 * error + 3e-4 * right).all()
    assert (error < 0.08 * right).all()


@pytest.mark.parametrize("lights", LIGHTS)
def test_a_black_texture_gives_no_light(lights):
    black = view(panel(image("black")), gi.Pipeline.preset("direct", emitters=LIGHTS[lights], spp=4))
    assert (black == 0).all()


def test_noise_of_one_texel_is_that_of_a_small_square():
    size = 64
    texel = panel(image("texel", size), wrap=CLAMP, emission=float(size * size))
    place = np.array([(size // 2 + 0.5) / size - 0.5, 1.0, 0.5 - (size // 3 + 0.5) / size])
    square = panel(None, emission=float(size * size))
    square.points = (np.array(square.points - [0, 1, 0]) / size + place).astype(np.float32)
    room = gi.Node("floor", [floor(1.5)]), gi.Node("wall", [_wall()])
    camera = gi.Camera.look_at((0.9, 0.8, 1.2), (0, 0.2, 0), resolution=(32, 32))
    noises = []
    for mesh in (texel, square):
        scene = gi.Scene([*room, gi.Node("panel", [mesh])])
        frames = [_reflected(scene, camera, seed) for seed in range(8)]
        noises.append(np.std(frames, axis=0, ddof=1).mean() / np.mean(frames))
    assert noises[0] < 1.5 * noises[1]


def _reflected(scene, camera, seed):
    frame = next(iter(gi.render(scene, camera, gi.Pipeline.preset("path", spp=4), seed=seed)))
    return frame.numpy("emitters") + frame.numpy("indirect")


def _wall():
    points = np.array([[-1.5, 0, -0.6], [1.5, 0, -0.6], [1.5, 2, -0.6], [-1.5, 2, -0.6]], np.float32)
    return gi.Mesh(points, np.array([[0, 1, 2], [0, 2, 3]]), gi.Material("wall", (0.7, 0.6, 0.5), specular=0.0))


# ---- grids ----


@wp.kernel(enable_backward=False)
def draw_points(
    first: wp.int32,
    scene: SceneData,
    emitter: wp.int32,
    numbers: wp.array(dtype=wp.vec2),
    points: wp.array(dtype=wp.vec4),
):
    k = first + wp.tid()
    p = emitter_point(scene, emitter, numbers[k])
    points[k] = wp.vec4(p.b[0], p.b[1], p.density, emitter_point_density(scene, emitter, p.b[0], p.b[1]))


@pytest.mark.parametrize(
    ("case", "emitter"),
    [("texel", 1), ("checkered, nearest, turned", 0), ("gradient", 0), ("gradient", 1), ("coloured", 0)],
)
def test_points_have_the_density_that_is_told(case, emitter):
    device = wp.get_device("cpu")
    scene = gi.Scene([gi.Node("panel", [CASES[case]()])])
    count = 1 << 17
    numbers = wp.array(np.random.default_rng(7).random((count, 2)), dtype=wp.vec2, device=device)
    points = wp.empty(count, dtype=wp.vec4, device=device)
    wp.launch(draw_points, count, inputs=[0, scene.data(device), emitter, numbers, points], device=device)
    u, v, density, told = points.numpy().T.astype(np.float64)
    assert u.min() >= 0 and v.min() >= 0 and (u + v).max() <= 1 + 1e-6
    assert np.mean(np.abs(density - told) > 1e-3 * density) < 1e-3  # but for points on borders of cells
    # moments by samples against those by the density at a grid of points
    at = (np.arange(1500) + 0.5) / 1500
    places = np.stack(np.meshgrid(at, at), axis=-1).reshape(-1, 2)
    places = places[places.sum(axis=1) < 1]
    grid = emission_grids_density(scene, emitter, places)
    assert grid.mean() == pytest.approx(1.0, rel=5e-3)
    for power_u, power_v in ((1, 0), (0, 1), (1, 1), (2, 0), (0, 2)):
        values = u**power_u * v**power_v
        expected = (grid * places[:, 0] ** power_u * places[:, 1] ** power_v).mean()
        assert abs(values.mean() - expected) < 4.5 * values.std() / np.sqrt(count) + 2e-3 * expected


def emission_grids_density(scene, emitter, places):
    """Return the density at barycentric places from the tables, by a look-up of the cell that holds each."""
    grids = scene._light_grids.get()
    start, side = (int(grids.table[emitter][name]) for name in ("start", "side"))
    cells = grids.densities[start : start + side * side].astype(np.float64)
    scaled = places * side
    whole = np.floor(scaled).astype(int)
    rest = scaled - whole
    over = rest.sum(axis=1) > 1
    whole[over], rest[over] = side - 1 - whole[over], 1 - rest[over]
    w = cells[whole[:, 1] * side + whole[:, 0]]
    return w[:, 0] * (1 - rest.sum(axis=1)) + w[:, 1] * rest[:, 0] + w[:, 2] * rest[:, 1] + w[:, 3]


@pytest.mark.parametrize("case", CASES)
def test_density_is_above_zero_where_there_is_light(case):
    mesh = CASES[case]()
    scene = gi.Scene([gi.Node("panel", [mesh])])
    grids = scene._light_grids.get()
    if len(grids.table) == 0:
        return
    places = np.random.default_rng(3).random((200000, 2))
    places = places[places.sum(axis=1) < 1]
    texture = mesh.material.emission_texture
    for emitter, ids in enumerate(mesh.indices[scene._emissive]):
        own = (mesh.uvs if mesh.further_uvs is None else mesh.further_uvs)[ids].astype(np.float64)
        uv = own[0] + places @ (own[1:] - own[0])
        if texture.transform is not None:
            rows = np.asarray(texture.transform)
            uv = uv @ rows[:, :2].T + rows[:, 2]
        light = looks(texture, uv[:, 0], uv[:, 1]).max(axis=1)
        if grids.table["side"][emitter] == 0:
            assert light.max() == 0 or light.std() < 0.4 * light.mean()
            continue
        density = emission_grids_density(scene, emitter, places)
        assert (density[light > 0] > 0).all()
        lit = light > 0.2 * light.max()
        assert (light[lit] / density[lit]).max() < 60 * (light[lit] / density[lit]).mean()


def test_powers_are_those_of_each_triangle():
    mesh = panel(image("texel"), wrap=CLAMP, emission=4096.0)
    powers = grids_of(mesh).powers  # the texel is in one of the two
    assert powers.sum() == pytest.approx(np.pi, rel=0.02) and powers.min() < 1e-3 * powers.max()


def test_what_needs_none_has_none():
    even = image("checkered", 8)
    even[..., :3] = 200
    assert len(grids_of(panel(even)).table) == len(grids_of(panel(None)).table) == 0
    # triangles within a texel: a fine mesh, as most that emit
    small = panel(image("checkered", 8), uv=0.1)
    assert len(grids_of(small).table) == 0


def test_many_large_textures_stay_in_bounds():
    meshes = [panel(image("sparse", 256), emission=100.0) for _ in range(24)]
    grids = gi.Scene([gi.Node("panels", meshes)])._light_grids.get()
    assert len(grids.cells) <= emission_grids.MOST_CELLS and (grids.table["side"] > 0).sum() > 24


def test_a_texture_edited_before_the_first_picture_and_after_is_the_one_that_is_sampled():
    pixels = image("texel")
    mesh = panel(pixels, wrap=CLAMP, emission=4096.0)
    scene = gi.Scene([gi.Node("floor", [floor()]), gi.Node("panel", [mesh])])
    scene.emitter_powers()
    pixels[..., :3] = np.roll(pixels[..., :3], (5, -11), axis=(0, 1))
    camera = gi.Camera.look_at((0, 0.5, 0.001), (0, 0, 0), hfov=0.01, resolution=(16, 16))
    seen = []
    for _ in range(2):
        frame = next(iter(gi.render(scene, camera, gi.Pipeline.preset("direct", spp=64)))).numpy("beauty")
        seen.append(reflected(mesh))
        assert frame.mean(axis=(0, 1)) == pytest.approx(seen[-1], rel=0.01)
        pixels[..., :3] = np.roll(pixels[..., :3], 9, axis=1)
    assert not np.allclose(*seen, rtol=0.05)


def test_materials_that_share_a_texture_share_its_sums(monkeypatch):
    """Powers are those of each material alone, and sums are made once for a picture."""
    rng = np.random.default_rng(8)
    pixels, others = rng.integers(0, 256, (2, 16, 24, 4), dtype=np.uint8)
    shifted = ((0.5, 0.0, 0.2), (0.0, 2.0, 0.1))
    textures = [
        gi.Texture("a", pixels),
        gi.Texture("b", pixels),
        gi.Texture("moved", pixels, transform=shifted),
        gi.Texture("mirrored", pixels, wrap=("mirror", "clamp")),
        gi.Texture("linear", pixels, srgb=False),
        gi.Texture("other", others),
    ]
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    nodes = []
    for number, texture in enumerate(textures):
        material = gi.Material(str(number), emission=(1.0 + number, 2.0, 0.5), emission_texture=texture)
        uvs = rng.uniform(-0.5, 1.5, (4, 2)).astype(np.float32)
        indices = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
        nodes.append(gi.Node(str(number), [gi.Mesh(corners, indices, material, uvs=uvs)]))
    alone = np.concatenate([gi.Scene([node])._light_grids._inputs[3] for node in nodes])
    made = []
    real = emitters.box_means
    monkeypatch.setattr(emitters, "box_means", lambda *which: made.append(which) or real(*which))
    together = gi.Scene(nodes)._light_grids._inputs[3]
    assert np.array_equal(together, alone) and len(set(alone)) > 8
    assert len(made) == 4
