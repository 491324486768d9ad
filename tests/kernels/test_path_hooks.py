"""The hooks of the path tracer: a sky that records how paths leave, and a radiance cache that ends them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import statistics_tools as st
import warp as wp
from path_tools import path_settings, scene_data, trace
from statistics_tools import device, every_device  # noqa: F401

import warp_gi as gi
from warp_gi import launch
from warp_gi.bench.harness.scenes import light, quad, sphere
from warp_gi.kernels.bsdf import lambert
from warp_gi.kernels.bvh import BvhHit
from warp_gi.kernels.emitters import LightChoice
from warp_gi.kernels.environment import UNIFORM_SPHERE_PDF, EnvironmentLookup, EnvironmentSample
from warp_gi.kernels.harmonics import harmonics
from warp_gi.kernels.path_samplers import (
    ALIAS_LIGHTS,
    BSDF_DIRECTIONS,
    NO_CACHE,
    NO_REGIONS,
    SCENE_SKY,
    DirectionSample,
    KnownRadiance,
    PathCache,
    Regions,
    Sky,
)
from warp_gi.kernels.path_trace import NO_PATH, REFERENCE, TERM_INDIRECT, PathSettings, PathTracer, path_tracer
from warp_gi.kernels.surface import Surface, surface_at
from warp_gi.kernels.types import SceneData

wp.set_module_options({"enable_backward": False})

CHECKERS = np.kron([[255, 51], [51, 255]], np.ones((4, 4)))[..., None].repeat(4, axis=-1).astype(np.uint8)
FUNCTIONS = 9  # spherical harmonics of order 3

# ---- a sky that records ----


@wp.struct
class Transfer:
    paths: wp.int32  # of an item
    sampled: wp.int32  # 1: vertices sample the sky too, uniformly
    direct: wp.array2d(dtype=wp.vec3)  # [item, function] sums over paths of weight times the function
    indirect: wp.array2d(dtype=wp.vec3)


@wp.func
def transfer_is_lit(data: Transfer, scene: SceneData) -> wp.bool:
    return True


@wp.func
def transfer_is_sampled(data: Transfer, scene: SceneData) -> wp.bool:
    return data.sampled != 0


@wp.func
def transfer_prefetch(data: Transfer, scene: SceneData, u: wp.vec3, first: wp.bool):
    pass


@wp.func
def transfer_sample(data: Transfer, scene: SceneData, u: wp.vec3, first: wp.bool) -> EnvironmentSample:
    z = 1.0 - 2.0 * u[0]
    ring = wp.sqrt(wp.max(0.0, 1.0 - z * z))
    angle = 2.0 * wp.pi * u[1]
    direction = wp.vec3(ring * wp.cos(angle), ring * wp.sin(angle), z)
    return EnvironmentSample(direction, 0, 0, 0.0, 0.0)


@wp.func
def transfer_arrival(data: Transfer, scene: SceneData, e: EnvironmentSample, first: wp.bool) -> EnvironmentLookup:
    return EnvironmentLookup(wp.vec3(0.0, 0.0, 0.0), UNIFORM_SPHERE_PDF)


@wp.func
def transfer_lookup(data: Transfer, scene: SceneData, direction: wp.vec3, first: wp.bool) -> EnvironmentLookup:
    return EnvironmentLookup(wp.vec3(0.0, 0.0, 0.0), UNIFORM_SPHERE_PDF)


@wp.func
def transfer_radiance(data: Transfer, scene: SceneData, direction: wp.vec3) -> wp.vec3:
    return wp.vec3(0.0, 0.0, 0.0)


@wp.func
def transfer_leave(data: Transfer, path: wp.int64, edges: wp.int32, direction: wp.vec3, weight: wp.vec3):
    item = wp.int32(path / wp.int64(data.paths))
    y = harmonics(direction)
    for j in range(9):
        if edges == 2:
            data.direct[item, j] = data.direct[item, j] + weight * y[j]
        else:
            data.indirect[item, j] = data.indirect[item, j] + weight * y[j]


TRANSFER_SKY = Sky(
    "transfer",
    Transfer,
    transfer_is_lit,
    transfer_is_sampled,
    transfer_prefetch,
    transfer_sample,
    transfer_arrival,
    transfer_lookup,
    transfer_radiance,
    transfer_leave,
)
RECORDER = path_tracer(ALIAS_LIGHTS, BSDF_DIRECTIONS, NO_REGIONS, TRANSFER_SKY)


def court(environment: Any) -> gi.Scene:
    """Return a red and a green wall and a metal ball on a checkered floor, open to the sky."""
    grey, red, green = (gi.Material("m", c, specular=0.0) for c in ((0.7, 0.6, 0.5), (0.8, 0.1, 0.1), (0.1, 0.7, 0.2)))
    shiny = gi.Material("shiny", (0.9, 0.8, 0.7), metallic=1.0, roughness=0.5)
    grey.base_color_texture = gi.Texture("checkers", CHECKERS)
    meshes = [
        quad((-1, 0, 1), (2, 0, 0), (0, 0, -2), grey, "floor"),
        quad((-1, 0, 1), (0, 0, -2), (0, 1.2, 0), red, "left"),
        quad((-1, 0, -1), (2, 0, 0), (0, 1.2, 0), green, "back"),
        sphere((0.3, 0.35, 0.1), 0.35, shiny, rows=8),
    ]
    return gi.Scene([gi.Node("court", meshes)], environment=environment)


def court_camera() -> gi.Camera:
    """Return a camera that sees only surfaces; pictures of width 8 have their items in the order of pixels."""
    return gi.Camera.look_at((0.6, 1.0, 1.0), (-0.2, 0.2, -0.3), hfov=55, resolution=(8, 8))


def recorded(spp: int, seed: int, sampled: int = 0, **settings: Any) -> dict[str, np.ndarray]:
    """Return the transfer of the court's pixels, by term, float64 [height, width, 3, function]."""
    arrays: dict[str, wp.array] = {}

    def fill(samplers: Any, items: int) -> None:
        samplers.sky.paths, samplers.sky.sampled = spp, sampled
        for name in ("direct", "indirect"):
            arrays[name] = wp.zeros((items, FUNCTIONS), dtype=wp.vec3, device=device())
            setattr(samplers.sky, name, arrays[name])

    pictures = trace(court(None), court_camera(), RECORDER, fill, spp, seed, **settings)
    assert not any(picture.any() for picture in pictures.values())  # it gives no light
    return {
        name: array.numpy().astype(np.float64).reshape(8, 8, FUNCTIONS, 3).swapaxes(2, 3) / spp
        for name, array in arrays.items()
    }


def test_transfer_times_a_constant_sky_is_the_picture_under_it():
    """Both follow the same paths, so they differ by rounding."""
    radiance = np.array([1.2, 0.7, 0.4])
    settings = {"max_depth": 8, "roulette_depth": 3}
    picture = trace(court(tuple(radiance)), court_camera(), REFERENCE, None, 16, 5, **settings)
    transfer = recorded(16, 5, **settings)
    for name, term in (("direct", "environment"), ("indirect", "indirect")):
        relit = transfer[name][..., 0] * radiance / 0.282094792
        assert picture[term].mean() > 0.01
        np.testing.assert_allclose(relit, picture[term], rtol=2e-5, atol=1e-6)


COEFFICIENTS = np.array(  # [function, channel] of a sky of low frequencies, bright above and to one side
    (
        (3.0, 2.5, 2.0),
        (0.9, 0.2, 0.0),
        (0.1, 0.3, 0.0),
        (0.3, -0.4, 0.5),
        (0.1, 0.0, 0.2),
        (-0.2, 0.1, 0.0),
        (0.1, 0.2, 0.1),
        (0.0, 0.2, -0.1),
        (0.2, 0.0, -0.2),
    )
)


def low_sky() -> gi.Environment:
    """Return the sky of COEFFICIENTS as a map."""
    height, width = 64, 128
    theta = np.pi * np.arange(height)[:, None] / (height - 1)
    phi = 2.0 * np.pi * (np.arange(width)[None] + 0.5) / width
    x, y, z = np.sin(theta) * np.sin(phi), np.cos(theta) + 0.0 * phi, -np.sin(theta) * np.cos(phi)
    functions = [0.282094792 + 0.0 * x, 0.488602512 * y, 0.488602512 * z, 0.488602512 * x]
    functions += [1.092548431 * x * y, 1.092548431 * y * z, 0.315391565 * (3.0 * z * z - 1.0)]
    functions += [1.092548431 * x * z, 0.546274215 * (x * x - y * y)]
    pixels = np.stack(functions, axis=-1) @ COEFFICIENTS
    assert pixels.min() > 0.0
    return gi.Environment(pixels=pixels.astype(np.float32))


@pytest.mark.parametrize("sampled", [0, 1], ids=["directions", "sky samples too"])
def test_transfer_times_a_low_frequency_sky_is_the_picture_under_it(sampled):
    """The picture samples the map by its radiance, the record knows no radiance: they agree on average."""
    scene, seeds = court(low_sky()), range(12)
    pictures = [trace(scene, court_camera(), REFERENCE, None, 256, seed) for seed in seeds]
    settings = {"sky_probability": 1.0} if sampled else {}
    transfers = [recorded(256, 100 + seed, sampled, **settings) for seed in seeds]
    for name, term in (("direct", "environment"), ("indirect", "indirect")):
        relit = np.stack([np.einsum("yxcj,jc->yxc", transfer[name], COEFFICIENTS) for transfer in transfers])
        mean, variance = st.mean_and_variance(np.stack([picture[term] for picture in pictures]))
        label = f"transfer_{name}_{sampled}"
        st.compare_images(label, relit, mean, variance, reference_dof=len(seeds) - 1, systematic=5e-4)


# Thread: a texel, here the middle of a triangle. Its transfer by `paths` paths, as if it were white and Lambert.
@wp.kernel
def bake_transfer(
    first: wp.int32,
    scene: SceneData,
    paths: PathSettings,
    samplers: RECORDER.samplers,
    numbered: wp.int32,
):
    texel = first + wp.tid()
    hit = BvhHit()
    hit.face = texel
    hit.u = 1.0 / 3.0
    hit.v = 1.0 / 3.0
    up = wp.vec3(0.0, 1.0, 0.0)
    s = surface_at(scene, hit.face, hit.u, hit.v, up)
    s.bsdf = lambert(wp.vec3(1.0, 1.0, 1.0))
    for lane in range(samplers.sky.paths):
        path = NO_PATH
        if numbered != 0:
            path = wp.int64(texel) * wp.int64(samplers.sky.paths) + wp.int64(lane)
        RECORDER.trace_path(scene, samplers, hit, s, up, paths, wp.uint32(lane), wp.uint32(texel), path)


def test_transfer_of_an_open_floor_is_that_of_the_cosine():
    """The cosine over pi has the coefficients Y_lm(n) times 1, 2/3 and 1/4; a path without a number leaves nothing."""
    floor = quad((-1, 0, 1), (2, 0, 0), (0, 0, -2), gi.Material("black", (0.0, 0.0, 0.0), specular=0.0), "floor")
    scene, texels, count = gi.Scene([gi.Node("floor", [floor])]), 2, 4096
    samplers = RECORDER.samplers()
    samplers.sky.paths = count
    for name in ("direct", "indirect"):
        setattr(samplers.sky, name, wp.zeros((texels, FUNCTIONS), dtype=wp.vec3, device=device()))
    paths = path_settings(scene, 1)
    for numbered in (0, 1):
        inputs = [scene_data(scene), paths, samplers, numbered]
        launch.launch(bake_transfer, texels, inputs, device())
        transfer = samplers.sky.direct.numpy() / count
        if not numbered:
            assert not transfer.any()
    expected = np.array([0.282094792, 0.488602512 * 2 / 3, 0, 0, 0, 0, -0.315391565 / 4, 0, -0.546274215 / 4])
    np.testing.assert_allclose(transfer, np.tile(expected[:, None], (texels, 1, 3)), atol=2e-3)
    assert not samplers.sky.indirect.numpy().any()


# ---- a radiance cache ----


@wp.struct
class SteadyCache:
    radiance: wp.vec3
    validity: wp.float32
    colored: wp.int32  # 1: times the colour of the surface


@wp.func
def steady_lookup(
    data: SteadyCache, scene: SceneData, s: Surface, wo: wp.vec3, hit: BvhHit, pdf: wp.float32, u: wp.vec2
) -> KnownRadiance:
    if data.colored != 0:
        return KnownRadiance(wp.cw_mul(data.radiance, s.base_color), data.validity, 0.0)
    return KnownRadiance(data.radiance, data.validity, 0.0)


STEADY_CACHE = PathCache("steady", SteadyCache, steady_lookup)
CACHED = path_tracer(ALIAS_LIGHTS, BSDF_DIRECTIONS, NO_REGIONS, SCENE_SKY, STEADY_CACHE)


def cached(
    scene: gi.Scene, camera: gi.Camera, radiance: float, validity: float = 1.0, colored: int = 0, **settings: Any
) -> dict[str, np.ndarray]:
    """Return pictures with a cache that says the same everywhere, or the same times the colour of the surface."""

    def fill(samplers: Any, items: int) -> None:
        samplers.cache.colored = colored
        samplers.cache.radiance, samplers.cache.validity = wp.vec3(radiance, radiance, radiance), validity

    return trace(scene, camera, CACHED, fill, **settings)


def furnace(albedo: float) -> gi.Scene:
    """Return a closed cube that emits 1 and reflects ``albedo`` everywhere."""
    glow = gi.Material("glow", (albedo,) * 3, specular=0.0, emission=(1.0, 1.0, 1.0))
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=np.float32)
    faces = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1]]
    faces += [[2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]
    return gi.Scene([gi.Node("furnace", [gi.Mesh(corners, np.array(faces, dtype=np.int32), glow)])])


def camera_inside() -> gi.Camera:
    return gi.Camera.look_at((0.2, 0.1, 0.3), (1, 0.3, -0.2), hfov=100, resolution=(16, 16))


def lit_court() -> tuple[gi.Scene, gi.Camera]:
    """Return the court under a sky map, with a lamp."""
    scene = court(low_sky())
    lamp = quad((-0.3, 1.1, -0.3), (0.6, 0, 0), (0, 0, 0.6), light((8.0, 6.0, 4.0)), "lamp")
    return gi.Scene([*scene.nodes, gi.Node("lamp", [lamp])], environment=low_sky()), court_camera()


def test_a_cache_that_knows_the_answer_gives_it():
    """Light after two reflections is a^2 / (1 - a) in a furnace of albedo a: what a vertex does not sample itself."""
    scene, camera, albedo = furnace(0.6), camera_inside(), 0.6
    known = albedo**2 / (1.0 - albedo)
    at_first = cached(scene, camera, known, cache_vertex=1, spp=4)
    np.testing.assert_allclose(at_first["indirect"], known, rtol=1e-6)
    pictures = {
        "cache": [cached(scene, camera, known, seed=seed) for seed in range(12)],
        "half of it": [cached(scene, camera, known, 0.5, seed=seed) for seed in range(12)],
        "paths": [trace(scene, camera, REFERENCE, seed=seed) for seed in range(12)],
    }
    noise = {}
    for name, several in pictures.items():
        images = np.stack([picture["indirect"] for picture in several])
        st.assert_mean(images, known)
        noise[name] = images.var(axis=0).mean()
    assert noise["cache"] < 0.2 * noise["paths"] and noise["cache"] < noise["half of it"] < noise["paths"], noise


def test_a_cache_that_knows_nothing_changes_no_bit():
    scene, camera = lit_court()
    expected, found = (
        trace(scene, camera, REFERENCE, spp=8, roulette_depth=3),
        cached(scene, camera, 7.0, 0.0, spp=8, roulette_depth=3),
    )
    for name, picture in expected.items():
        np.testing.assert_array_equal(found[name], picture)
        assert picture.any()


@pytest.mark.parametrize("vertex", [1, 2, 3])
def test_the_last_vertex_takes_direct_light(vertex):
    """Paths that end in a cache without light are those of so many edges: the direct terms stay, and no bit differs."""
    scene, camera = lit_court()
    expected = trace(scene, camera, REFERENCE, spp=8, max_depth=vertex + 1)
    for depth in (vertex + 1, 64):  # the cache stands for the rest, however long paths may be
        found = cached(scene, camera, 0.0, spp=8, cache_vertex=vertex, max_depth=depth)
        bright = cached(scene, camera, 1.0, spp=8, cache_vertex=vertex, max_depth=depth)
        for name, picture in expected.items():
            np.testing.assert_array_equal(found[name], picture)
            if name != "indirect":
                np.testing.assert_array_equal(bright[name], picture)
        assert (bright["indirect"] - found["indirect"]).mean() > 0.02


def test_cached_light_is_left_out_with_the_indirect_term():
    scene, camera = lit_court()
    direct = cached(scene, camera, 1.0, spp=2, cache_vertex=1, terms=3)
    assert direct["environment"].any() and not direct["indirect"].any()
    assert cached(scene, camera, 1.0, spp=2, cache_vertex=1, terms=TERM_INDIRECT)["indirect"].min() >= 1.0


def test_a_cache_is_asked_about_a_surface_with_its_colour():
    """Paths from a white ceiling end on a floor whose texture is a fifth everywhere."""
    material = gi.Material("floor", (0.5, 0.25, 1.0), specular=0.0)
    material.base_color_texture = gi.Texture("grey", np.full((4, 4, 4), 51, np.uint8), srgb=False)
    white = gi.Material("white", (1.0, 1.0, 1.0), specular=0.0)
    floor = quad((-9, 0, 9), (18, 0, 0), (0, 0, -18), material, "floor")
    ceiling = quad((-9, 1, -9), (18, 0, 0), (0, 0, 18), white, "ceiling")
    camera = gi.Camera.look_at((0, 0.5, 0), (0, 1, 0.1), up=(0, 0, 1), hfov=60, resolution=(16, 16))
    scene = gi.Scene([gi.Node("room", [floor, ceiling])])
    picture = cached(scene, camera, 2.0, colored=1, spp=1)["indirect"]
    ended = picture[picture.any(axis=-1)]
    assert len(ended) > 200
    np.testing.assert_allclose(ended, np.tile([0.2, 0.1, 0.4], (len(ended), 1)), rtol=1e-5)


def test_clamp_holds_for_cached_light():
    picture = cached(furnace(0.5), camera_inside(), 100.0, spp=1, clamp=0.25)
    np.testing.assert_allclose(picture["indirect"].max(axis=-1), 0.25, rtol=1e-6)


@wp.func
def half_lobe(data: SteadyCache, s: Surface, wo: wp.vec3) -> wp.float32:
    return 0.5


WHOLE = path_tracer(
    *(ALIAS_LIGHTS, BSDF_DIRECTIONS, NO_REGIONS, SCENE_SKY),
    PathCache("whole", SteadyCache, steady_lookup, holds_direct=True),
)
LOBES = path_tracer(
    *(ALIAS_LIGHTS, BSDF_DIRECTIONS, NO_REGIONS, SCENE_SKY),
    PathCache("lobes", SteadyCache, steady_lookup, holds_direct=True, lobe=half_lobe),
)


def test_a_cache_that_holds_direct_light_ends_paths_without_samples():
    """Nothing but what is known arrives from the second vertex: in a furnace, albedo times that."""

    def fill(samplers: Any, items: int) -> None:
        samplers.cache.radiance, samplers.cache.validity = wp.vec3(3.0, 2.0, 1.0), 1.0

    found = trace(furnace(0.6), camera_inside(), WHOLE, fill, spp=2)
    np.testing.assert_allclose(found["indirect"], np.tile([1.8, 1.2, 0.6], (16, 16, 1)), rtol=1e-5)
    assert found["emitters"].mean() == pytest.approx(0.6, rel=0.03)


def test_a_lobe_that_a_cache_does_not_know_is_traced():
    """Where a metal is all lobe, and the cache knows none of it, paths that go on half the time bring all its light."""

    def fill(samplers: Any, items: int) -> None:
        samplers.cache.validity = 1.0

    scene, camera = lit_court()
    for node in scene.nodes:
        for mesh in node.meshes:
            mesh.material.metallic, mesh.material.specular, mesh.material.roughness = 1.0, 1.0, 0.5
    scene = gi.Scene(scene.nodes, environment=low_sky())
    known, found = (
        np.stack([trace(scene, camera, tracer, make, spp=16, seed=seed)["indirect"] for seed in range(24)])
        for tracer, make in ((REFERENCE, None), (LOBES, fill))
    )
    expected, variance = st.mean_and_variance(known.mean(axis=(1, 2)))
    mean, noise = st.mean_and_variance(found.mean(axis=(1, 2)))
    assert (expected > 0.01).all() and (np.abs(mean - expected) < 4 * np.sqrt(variance + noise)).all()
    assert (np.sqrt(variance + noise) < 0.05 * expected).all()


# ---- what learners get of paths that end in a cache ----


@wp.struct
class Log:
    vertices: wp.int32  # slots of a path
    begun: wp.array(dtype=wp.int32)  # [slot] times that a vertex was begun
    lights: wp.array(dtype=wp.int32)  # [slot] light samples
    directions: wp.array(dtype=wp.int32)  # [slot] directions
    before: wp.array(dtype=wp.float32)  # [slot] light of the path before the direction
    ends: wp.array(dtype=wp.float32)  # [path]


@wp.func
def log_region(data: Log, scene: SceneData, s: Surface, face: wp.int32, u: wp.float32, v: wp.float32) -> wp.int32:
    return 0


@wp.func
def log_slot(data: Log, path: wp.int64) -> wp.int32:
    return wp.int32(path) * data.vertices


@wp.func
def log_at(data: Log, slot: wp.int32, vertex: wp.int32) -> wp.int32:
    if slot < 0 or vertex >= data.vertices:
        return -1
    return slot + vertex


@wp.func
def log_begin(data: Log, slot: wp.int32, s: Surface):
    data.begun[slot] = data.begun[slot] + 1


@wp.func
def log_light(data: Log, slot: wp.int32, choice: LightChoice, visible: wp.int32, light: wp.float32):
    data.lights[slot] = data.lights[slot] + 1


@wp.func
def log_direction(
    data: Log,
    slot: wp.int32,
    sample: DirectionSample,
    nearness: wp.float32,
    carried: wp.float32,
    light: wp.float32,
):
    data.directions[slot] = data.directions[slot] + 1
    data.before[slot] = light


@wp.func
def log_end(data: Log, slot: wp.int32, vertices: wp.int32, light: wp.float32):
    data.ends[slot / data.vertices] = light


LOG_REGIONS = Regions("log", Log, log_region, log_slot, log_at, log_begin, log_light, log_direction, log_end)
LOGGED = path_tracer(
    ALIAS_LIGHTS, BSDF_DIRECTIONS, LOG_REGIONS, SCENE_SKY, PathCache("logged", SteadyCache, steady_lookup)
)
LOGGED_LOBES = path_tracer(
    *(ALIAS_LIGHTS, BSDF_DIRECTIONS, LOG_REGIONS, SCENE_SKY),
    PathCache("logged_lobes", SteadyCache, steady_lookup, holds_direct=True, lobe=half_lobe),
)


def logged(
    scene: gi.Scene, camera: gi.Camera, tracer: PathTracer, radiance: float
) -> tuple[dict[str, np.ndarray], Any]:
    """Return pictures of one sample with a cache that says the same everywhere, and the log of 4 vertices a path."""
    logs: list[Any] = []

    def fill(samplers: Any, items: int) -> None:
        samplers.cache.radiance, samplers.cache.validity = wp.vec3(radiance, radiance, radiance), 1.0
        log = samplers.regions
        log.vertices = 4
        for name in ("begun", "lights", "directions"):
            setattr(log, name, wp.zeros(items * 4, dtype=wp.int32, device=device()))
        log.before = wp.zeros(items * 4, dtype=wp.float32, device=device())
        log.ends = wp.zeros(items, dtype=wp.float32, device=device())
        logs.append(log)

    return trace(scene, camera, tracer, fill, spp=1), logs[0]


def test_learners_get_cached_light_as_light_of_the_way_there():
    """No direction at the last vertex, not even one to the sky; what is known there counts for the vertex before."""
    picture, log = logged(*lit_court(), LOGGED, 2.0)
    begun, lights, directions, before = (
        getattr(log, name).numpy().reshape(64, 4) for name in ("begun", "lights", "directions", "before")
    )
    assert (begun[:, 0] == 1).all() and (lights[:, 0] == 1).all()
    second = begun[:, 1] == 1
    assert 0.2 < second.mean() < 0.9 and lights[second, 1].any()
    assert not begun[:, 2:].any() and not directions[:, 1:].any()
    assert (directions[second, 0] == 1).all()
    gathered = (picture["environment"] + picture["indirect"]).reshape(64, 3) @ [0.2126, 0.7152, 0.0722]
    np.testing.assert_allclose(log.ends.numpy(), gathered, rtol=1e-4, atol=1e-6)
    assert (log.ends.numpy() - before[:, 0])[second].min() > 0.02


def test_learners_get_no_light_of_a_lobe_that_is_traced_alone():
    """It is not all that the surface reflects: such a vertex is begun, and no more, as where a path ends."""
    _, log = logged(*lit_court(), LOGGED_LOBES, 2.0)
    begun, lights, directions = (
        getattr(log, name).numpy().reshape(64, 4) for name in ("begun", "lights", "directions")
    )
    assert begun[:, 1].mean() > 0.2 and begun[:, 2].any()
    assert lights[:, 0].all() and directions[:, 0].any()
    assert not lights[:, 1:].any() and not directions[:, 1:].any()


# ---- roulette ----


def survivals(albedo: float, roulette_depth: int, vertices: int) -> np.ndarray:
    """Return the probabilities that a path has a vertex 0, 1, ... in a closed room, float64 [vertices]."""
    there, met = [1.0], 1.0
    for depth in range(2, vertices + 1):
        if depth > 2:
            met *= albedo
        survival = min(max(1.4 * met, 0.05), 1.0) if depth >= roulette_depth else 1.0
        there.append(there[-1] * survival)
        met /= survival
    return np.array(there)


@pytest.mark.parametrize("albedo, roulette_depth", [(0.6, 2), (0.6, 4), (0.9, 2), (0.02, 2)])
def test_paths_survive_by_what_they_met_after_the_first_vertex(albedo, roulette_depth):
    spp, vertices = 32, 8
    scene = furnace(albedo)
    scene.nodes[0].meshes[0].material.base_color = (0.1 * albedo, albedo, 0.5 * albedo)  # the largest counts
    begun: list[wp.array] = []

    def fill(samplers: Any, items: int) -> None:
        log = samplers.regions
        log.vertices = vertices
        arrays = [wp.zeros(items * spp * vertices, dtype=wp.int32, device=device()) for _ in range(3)]
        log.begun, log.lights, log.directions = arrays
        log.before = wp.zeros(items * spp * vertices, dtype=wp.float32, device=device())
        log.ends = wp.zeros(items * spp, dtype=wp.float32, device=device())
        begun.append(log.begun)

    trace(gi.Scene(scene.nodes), camera_inside(), LOGGED, fill, spp=spp, roulette_depth=roulette_depth)
    there = begun[0].numpy().reshape(-1, vertices).mean(axis=0)
    expected = survivals(albedo, roulette_depth, vertices)
    sigma = np.sqrt(expected * (1 - expected) / (256 * spp))
    assert (np.abs(there - expected) < 4.5 * sigma + 2e-4).all(), (there, expected)  # rays graze an edge and end


# ---- one tracer for one combination ----


def test_tracers_are_made_once_and_named_by_what_they_use():
    assert path_tracer(ALIAS_LIGHTS, BSDF_DIRECTIONS, NO_REGIONS, SCENE_SKY, NO_CACHE) is REFERENCE
    tinted = path_tracer(ALIAS_LIGHTS, BSDF_DIRECTIONS, NO_REGIONS, tints=True)
    names = [tracer.trace_paths.module.name.rpartition(".")[2] for tracer in (REFERENCE, RECORDER, CACHED, tinted)]
    assert names == ["alias_bsdf", "alias_bsdf_sky_transfer", "alias_bsdf_cache_steady", "alias_bsdf_tints"]
